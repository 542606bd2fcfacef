"""Units from 1e-35 to 1e30, origins far away, outliers, and step sizes from 1e-9 to 100.

What is not in a truth is not conserved: checked in 60 digits.
"""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import numpy as np

import dvi_jax as dvi

from . import case, named
from .integrable import duffing, of_duffing, qrt
from .maps import *


def wild(samples):
    """The samples, one of twenty replaced by normal numbers times 10 to a power from −8 to 8."""

    def draw(rng):
        qs, ps = (np.array(x) for x in samples(rng))
        for x in (qs, ps):
            part = x[::20]
            part[:] = rng.normal(size=part.shape) * 10.0 ** rng.uniform(-8, 8, part.shape)
        return qs, ps

    return draw


def in_plane(n, count, q, p):
    """Samples in boxes of the sizes q and p, each component drawn from −1 to 1 or −p to p."""
    return lambda rng: (rng.uniform(-2, 2, (count, n)) * q, rng.uniform(-p, p, (count, n)))


SUN, EARTH, AU = 1.327e20, 5.97e24, 1.496e11
"""GM of the sun [m³/s²], mass of the Earth [kg], [m]."""

PLANET = system(f"p @ p / (2 * {EARTH}) + {-SUN * EARTH} / sqrt(q @ q)")
MOLECULE = system("p @ p / (2 * 1.67e-27) + 5e2 * (q @ q) / 2")
"""Of hydrogen: mass in kg, stiffness in N/m."""
CHAIN = system(
    "p @ p / (2 * 1e-26) + sum(10 * (q[1:] - q[:-1])**2 / 2 + 1e21 * (q[1:] - q[:-1])**4 / 4)"
)
STRANG = dvi.Strang()
PAIR = separable("cosh(q1 - q2)")
POWERS_OF_DISTANCE = functions(
    *(f"(q1 - 1e6)**{i} * p1**{j}" for i in range(3) for j in range(3 - i) if i + j)
)
FORM_OF_PAIR = poly(1) + poly(2, MOMENTA) * poly(1, ["p1"])


def shifted(c):
    """The oscillator about c, and its quadratic form."""
    form = f"(p1**2 + (q1 - {c})**2 - 0.1 * (q1 - {c}) * p1) / 2"
    return separable(f"(q - {c}) @ (q - {c}) / 2"), form


def unequal(rng):
    return tuple(rng.uniform(-1, 1, (80, 2)) * np.array([1e-10, 1e10]) for _ in "qp")


_UNITS = {
    # p²/m + k q² − (hk/m) q p; p about 1e-23 kg m/s
    "molecule in SI units": case((MOLECULE, poly(4), sized(1, 100, 1e-11, 1e-23), 1e-15),
        f"1e46 * 1.67e-27 * (p1**2 / 1.67e-27 + 5e2 * q1**2 - {1e-15 * 5e2 / 1.67e-27} * q1*p1)"),
    # p about 1e29 kg m/s
    "planet in SI units": case((PLANET, ENERGIES, in_plane(2, 100, AU, 2e29), 86400.0),
        f"1e-40 * ({L})"),
    "planet in SI units, Strang, in space": case((PLANET, poly(2), in_plane(3, 80, AU, 2e29), 1e6),
        (f"1e-40 * ({x})" for x in ANGULAR), method=STRANG),
    # x²y²/s² + x² + y² − 2μxy
    **{f"McMillan's map of size {s:g}": case((additive(lambda q, s=s: 1.4 * q / (1 + (q / s) ** 2)),
        poly(4), box(1, 100, -s, s), 1.0), biquadratic(1.0, 0.0, 1.0, -1.4, 0.0, size=s))
        for s in (1e-30, 1e-6, 1e8, 1e30)},
    "McMillan's map of size 1e-12 with a cubic force": case(
        (additive(lambda q: 1.4 * q / (1 + (1e12 * q) ** 2) + 0.01 * 1e24 * q**3), poly(4),
        box(1, 100, -1e-12, 1e-12), 1.0)),
    # a quadratic form each; q₁ about 1e-10, q₂ about 1e10
    "oscillators of very different sizes": case((spring(1.0, 0.5), poly(2), unequal, 0.3),
        (f"1e20 * {energy(1.0, 0.3, 1)}", f"1e-20 * {energy(0.5, 0.3, 2)}")),
    # H = 1e-60 p²/2 + 1e60 q²/2: p²/m + k q² − (hk/m) q p, h = 0.1
    "momentum of 1e30 and position of 1e-30": case(
        (system("p @ p / (2 * 1e60) + 1e60 * (q @ q) / 2"), poly(4), sized(1, 100, 1e-30, 1e30)),
        "(1e-30 * p1)**2 + (1e30 * q1)**2 - 0.1 * (1e30 * q1) * (1e-30 * p1)"),
    "chain of atoms in SI units": case((CHAIN, poly(2), sized(3, 80, 1e-10, 1e-23), 1e-14),
        "1e23 * sum(p)", method=STRANG),
    "Hénon's map in units of 1e-20": case((separable("sum(0.4 * q**2 + 1e20 * q**3 / 3)"), poly(4),
        box(1, 100, -1e-20, 1e-20), 1.0)),
    # p² + ω²q² − hω² q p
    "frequency of 1e15 and steps of 1e-16": case((separable("1e30 * (q @ q) / 2"), poly(2),
        sized(1, 80, 1e-10, 1e5), 1e-16), "(p1**2 + 1e30 * q1**2 - 1e14 * q1 * p1) / 1e10"),
}  # fmt: skip
_OFFSETS = {
    # the form about the equilibrium, expanded; digits are lost as the square of the offset
    **{f"oscillator about {c:g}": case((shifted(c)[0], poly(2), moved(box(1, 80), q=c)),
        shifted(c)[1]) for c in (3.0, 100.0)},
    "oscillator about 1e6, with functions of the distance from there": case((shifted(1e6)[0],
        POWERS_OF_DISTANCE, moved(box(1, 80), q=1e6)), shifted(1e6)[1]),
    # total momentum, and its powers: the force depends on the difference of the positions
    "pair at 1e8": case((PAIR, FORM_OF_PAIR, moved(box(2, 60), q=1e8)), "p1 + p2"),
    "pair at 1e4, momenta alone": case((PAIR, poly(4, MOMENTA), moved(box(2, 60), q=1e4)),
        "p1 + p2"),
    "free particle at 1e8": case((FREE, poly(1), moved(box(1, 40), q=1e8)), "p1"),
    # angular momentum about the centre, (q − c) ∧ p
    "Kepler about another centre": case((separable("-1 / sqrt((q1 - 300.0)**2 + (q2 + 200.0)**2)"),
        poly(2), moved(shell(2, 100), q=[300.0, -200.0])), "(q1 - 300.0) * p2 - (q2 + 200.0) * p1"),
    # standard map at K = 0.5
    "angles after a thousand turns": case((separable("-0.5 * sum(cos(q))"),
        trig(2, "q", constant=True) * trig(2, "p", constant=True),
        moved(box(1, 100, -3.0, 3.0), q=2000 * np.pi), 1.0)),
    # free motion along the second axis: p₂; the first is an oscillator
    "momenta about 1000": case((spring(1.0, 0.0), poly(2), moved(box(2, 80), p=[0.0, 1000.0])),
        (E, "p2")),
    "times about 1e9": case((VARYING, poly(2), timed(box(2, 80), 1e9, 1e9 + 10)), L),
}  # fmt: skip
_OUTLIERS = {
    **{f"{name}, one sample of twenty {factor:g} times as far": case((system, basis,
        with_outliers(samples, factor), h), truth, points=samples)
        for name, system, basis, samples, truth, h in (("oscillator", OSCILLATOR, poly(4),
        box(1, 120), E, 0.1), ("McMillan's map", MCMILLAN, poly(4), box(1, 120), BIQUADRATIC, 1.0),
        ("central quartic force", CENTRAL, poly(2), box(2, 100), L, 0.1))
        for factor in (30.0, 1e6)},
    "oscillator, one sample of twenty anywhere": case((OSCILLATOR, poly(4), wild(box(1, 200))), E,
        points=box(1, 200)),
    "Kepler, one sample of twenty anywhere": case((KEPLER, ENERGIES, wild(shell(2, 200))), L,
        points=shell(2, 200)),
    "Hénon's map, one sample of twenty anywhere": case((HENON, poly(4), wild(box(1, 200)), 1.0),
        points=box(1, 200)),
    "Hénon's map, one sample of twenty 100 times as far": case((HENON, poly(4),
        with_outliers(box(1, 120), 100.0), 1.0), points=box(1, 120)),
}  # fmt: skip
_STEPS = {
    **{f"oscillator at h = {h:g}": case((OSCILLATOR, poly(4), box(1, 80), h), energy(1.0, h))
        for h in (1e-9, 1e-5, 30.0)},
    **{f"integrable discrete Duffing oscillator at h = {h:g}": case((duffing(1.0, 0.5, h), poly(4),
        box(1, 100), h), of_duffing(1.0, 0.5, h)) for h in (0.01, 3.0)},
    "Kepler at h = 100": case((KEPLER, ENERGIES, shell(2, 100), 100.0), L),
    "Kepler at h = 1e-8, without the energy in the basis": case((KEPLER, poly(2), shell(2, 100),
        1e-8), L),
    # the energy changes in a step by O(h²)
    "quartic oscillator at h = 1e-3 with its energy in the basis": case((QUARTIC, poly(4),
        box(1, 100), 1e-3)),
    "quartic oscillator at h = 3": case((QUARTIC, poly(4), box(1, 100), 3.0)),
    "backwards in time": case((OSCILLATOR, poly(4), box(1, 80), -0.3), energy(1.0, -0.3)),
    # a linear map with λ + 1/λ = 2 + 1e4
    "hyperbolic map with multipliers of 1e4": case((spring(-1e4), poly(4), box(1, 100), 1.0),
        "p1**2 - 1e4 * q1**2 + 1e4 * q1*p1"),
    # the biquadratic, whose quartic term is 1e-6 or 1e6 of the quadratic ones there
    **{f"QRT map in a {name}": case((qrt(1.0, 0.0, 1.0, -1.4, 0.0), poly(4),
        box(1, 100, -size, size), 1.0), BIQUADRATIC)
        for name, size in (("small box about its fixed point", 1e-3), ("large box", 1e3))},
    # a quadratic form each
    "frequencies of 1 and 1e4": case((spring(1.0, 1e8), poly(2), box(2, 80), 1e-4),
        (energy(1.0, 1e-4), f"{energy(1e8, 1e-4, 2)} / 1e8")),
}  # fmt: skip
CASES = (
    *named("units", _UNITS),
    *named("offsets", _OFFSETS),
    *named("outliers", _OUTLIERS),
    *named("small and large steps", _STEPS),
)
