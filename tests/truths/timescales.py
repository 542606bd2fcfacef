"""Fast and slow motion together: rates from 1e-1 to 1e-8, in boxes from 1 to 1000.

A slow oscillator, pair or central force conserves what it does at any step. A slow nonlinear
oscillator conserves nothing but an expansion in its small step, and a fast one, or one that moves
by a part of a turn in a step, nothing at all (chaotic; checked at the rate 1 in 60 digits).
"""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import functools
import itertools
import operator

from . import case, named
from .maps import *

FAST = "(p1**2 + q1**2) / 2"
SPRING = "p{0}**2 / 2 + q{0}**4 / 4"
TWIST = "p2**2 / 2 + q2**3 / 3 + q2**4 / 4"
WAVES = poly(4) + functions("cos(q2)", "p2 * sin(q2)", "cos(2 * q2)")
ANGLE = functions("cos(q1)", "p1 * sin(q1)", "sin(q1)", "p1 * cos(q1)")
TWO = [["q1", "p1"], ["q2", "p2"]]
THREE = [*TWO, ["q3", "p3"]]


def alone(*degrees):
    """Polynomials in each degree of freedom alone, and products of two of them."""
    parts = [poly(d, names) for d, names in zip(degrees, THREE, strict=False)]
    pairs = [poly(1, a) * poly(1, b) for a, b in itertools.combinations(THREE[: len(parts)], 2)]
    return functools.reduce(operator.add, parts + pairs)


LOG = "p1**2 / 2 + 2 * 0.5 * (q1**2 - 0.7 * log(1 + q1**2))"
"""McMillan's map at h = 1."""


def slow(rate, H, *faster):
    """The fast oscillator, or others, with a part that is slower by this rate."""
    return system(" + ".join([*(faster or (FAST,)), f"{rate!r} * ({H})"]))


def ellipse(rate, i, h=0.1):
    """Of an oscillator at a rate r: that of a step r h."""
    return energy(1.0, h * rate, i)


def half(i):
    return f"(p{i}**2 + q{i}**2) / 2"


def unlike(count, *sizes):
    """Samples in a box whose size in each degree of freedom is another."""
    sizes = np.array(sizes)
    return lambda rng: tuple(rng.uniform(-1, 1, (count, len(sizes))) * sizes for _ in "qp")


def cube(n, count, size):
    return box(n, count, -size, size)


_QUARTIC = {
    f"quartic oscillator slower by {rate:g} in a box of {size:g}": case(
        (slow(rate, SPRING.format(2)), poly(4), cube(2, 150, size)), f"({E}) / {size**2}")
    for rate, size in ((1e-1, 1.0), (1e-2, 30.0), (1e-3, 1000.0), (1e-4, 1.0), (1e-5, 100.0),
    (1e-6, 1000.0), (1e-8, 10.0))
}  # fmt: skip
_EXACT = {
    **{f"oscillator slower by {rate:g} in a box of {size:g}": case(
        (slow(rate, half(2)), poly(2), cube(2, 80, size)),
        (f"({E}) / {size**2}", f"({ellipse(rate, 2)}) / {size**2}"))
        for rate, size in ((1e-2, 1.0), (1e-5, 100.0), (1e-8, 1000.0))},
    "oscillators at the rates 1, 1e-3 and 1e-6": case(
        (slow(1e-6, half(3), FAST, f"1e-3 * {half(2)}"), poly(2), box(3, 100)),
        (E, ellipse(1e-3, 2), ellipse(1e-6, 3))),
    "McMillan's map with an oscillator slower by 1e-5": case(
        (slow(1e-5, half(2), LOG), poly(4), box(2, 150), 1.0),
        (BIQUADRATIC, ellipse(1e-5, 2, 1.0))),
    "central force slower by 1e-4": case(
        (slow(1e-4, "(p2**2 + p3**2) / 2 + (q2**2 + q3**2)**2 / 4"), poly(2), box(3, 100)),
        (E, "q2*p3 - q3*p2")),
    "central force slower by 1e-7 in a box of 1000": case(
        (slow(1e-7, "(p2**2 + p3**2) / 2 + sqrt(1 + q2**2 + q3**2)"), poly(2), cube(3, 100, 1e3)),
        (f"({E}) / 1e6", "(q2*p3 - q3*p2) / 1e6")),
    "pair slower by 1e-6": case(
        (slow(1e-6, "(p2**2 + p3**2) / 2 + cosh(q2 - q3)"), poly(2), box(3, 100)),
        (E, "p2 + p3")),
    "kicked rotor with an oscillator slower by 1e-3": case(
        (slow(1e-3, half(2), "p1**2 / 2 - 3.0 * cos(q1)"), poly(2) + ANGLE, cube(2, 100, 3.0), 1.0),
        ellipse(1e-3, 2, 1.0)),
}  # fmt: skip
_OTHERS = {
    "cubic and quartic force slower by 1e-3 in a box of 100": case(
        (slow(1e-3, TWIST), poly(4), cube(2, 150, 100.0)), f"({E}) / 1e4"),
    "pendulum slower by 1e-2": case((slow(1e-2, "p2**2 / 2 - cos(q2)"), WAVES, box(2, 160)), E),
    "pendulum slower by 1e-4": case((slow(1e-4, "p2**2 / 2 - cos(q2)"), WAVES, box(2, 160)), E),
    "McMillan's map with a pendulum slower by 1e-6": case(
        (slow(1e-6, "p2**2 / 2 - cos(q2)", LOG), WAVES, box(2, 160), 1.0), BIQUADRATIC),
    "kicked rotor with a quartic oscillator slower by 1e-3": case(
        (slow(1e-3, SPRING.format(2), "p1**2 / 2 - 3.0 * cos(q1)"),
        alone(2, 4) + ANGLE, cube(2, 120, 10.0), 1.0)),
    "three rates, the slowest quartic, in boxes of 1 and 100": case(
        (slow(1e-5, SPRING.format(3), FAST, f"1e-2 * {half(2)}"), alone(2, 2, 4),
        unlike(120, 1.0, 1.0, 100.0)),
        (E, ellipse(1e-2, 2))),
    "Hénon's map slower by 1e-3 in unlike boxes": case(
        (slow(1e-3, "p2**2 / 2 + 0.4 * q2**2 + q2**3 / 3"), poly(4), unlike(150, 1000.0, 1.0)),
        f"({E}) / 1e6"),
    "two quartic oscillators slower by 1e-3 and 1e-6": case(
        (slow(1e-6, SPRING.format(3), FAST, f"1e-3 * ({SPRING.format(2)})"),
        alone(2, 4, 4), cube(3, 160, 10.0)), f"({E}) / 100"),
}  # fmt: skip
CASES = named("fast and slow motion", _QUARTIC | _EXACT | _OTHERS)
