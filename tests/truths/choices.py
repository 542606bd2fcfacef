"""The user's choices: which functions, how many samples, and where they lie.

Where no truth is given the changes of the basis have full rank: checked in 60 digits.
"""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import numpy as np

import dvi_jax as dvi

from . import case, named
from .chaotic import standard
from .maps import *


def half_precision(samples):
    """The samples rounded to float32, and given in it."""
    return lambda rng: tuple(np.asarray(x, np.float32) for x in samples(rng))


def grid(per_side, n=1):
    """A regular grid of 2n dimensions."""
    side = np.linspace(-1, 1, per_side)
    points = np.stack(np.meshgrid(*[side] * (2 * n), indexing="ij"), -1).reshape(-1, 2 * n)
    return lambda rng: (points[:, :n], points[:, n:])


def repeated(samples, times):
    """The samples, each of them several times."""
    return lambda rng: tuple(np.repeat(x, times, axis=0) for x in samples(rng))


def curve(rng):
    """p = sin 3q, and q between −1 and 1."""
    q = rng.uniform(-1, 1, (60, 1))
    return q, np.sin(3 * q)


def orbits(draw, force, length):
    """Orbits of p1 = p + force(q), q1 = q + h p1, from drawn states on; h is the force's."""

    def samples(rng):
        q, p = draw(rng)
        out = []
        for _ in range(length):
            q, p = force(q, p)
            out.append((q, p))
        return tuple(np.concatenate([x[k] for x in out]) for k in (0, 1))

    return samples


def of_oscillator(q, p):
    p = p - 0.1 * q
    return q + 0.1 * p, p


def of_mcmillan(q, p):
    p = p - (2 * q - 1.4 * q / (1 + q**2))
    return q + p, p


def some_at_rest(rng):
    """A quarter of the samples does not move."""
    moving = np.arange(120)[:, None] % 4
    return tuple(np.where(moving, rng.uniform(-1, 1, (120, 1)), 0.0) for _ in "qp")


COUPLED, TWIST = separable("(q1 - q2)**2 / 2"), system("sum(p**2) / 2")
RELATIVE = "(p1 - p2)**2 + 2 * (q1 - q2)**2 - 0.2 * (q1 - q2) * (p1 - p2)"
LX, LY = "q2*p3 - q3*p2", "q3*p1 - q1*p3"
CHEBYSHEV = dvi.Chebyshev(5, "q", (-2.0, 2.0)) * dvi.Chebyshev(5, "p", (-2.0, 2.0))
WAVES = trig(2, "q", constant=True) * trig(2, "p", constant=True)
GAUSSIANS = functions(
    *(f"exp(-((q1 - {a})**2 + p1**2) / 0.02)" for a in (-0.8, -0.4, 0.1, 0.4, 0.8))
)

_BASES = {
    # a constant does not count as an invariant, nor does sin² q + cos² q
    "oscillator with the constant 1 in the basis": case((OSCILLATOR, poly(4, constant=True),
        box(1, 80)), E),
    "quartic oscillator with the constant 1 in the basis": case((QUARTIC, poly(4, constant=True),
        box(1, 80))),
    "oscillator, a constant hidden in sin² + cos²": case((OSCILLATOR,
        QUADRATICS + functions("sin(q1)**2", "cos(q1)**2"), box(1, 80)), E),
    "oscillator, polynomials of degree 10": case((OSCILLATOR, poly(10), box(1, 200)), E),
    "McMillan's map, polynomials of degree 9": case((MCMILLAN, poly(9), box(1, 200), 1.0),
        BIQUADRATIC),
    "quartic oscillator, polynomials of degree 10": case((QUARTIC, poly(10), box(1, 200), 0.5)),
    "McMillan's map in products of Chebyshev polynomials": case((MCMILLAN, CHEBYSHEV,
        box(1, 100, -2.0, 2.0), 1.0), BIQUADRATIC),
    # p is conserved, and three of the four are functions of it
    "functions of momentum alone on a twist map": case((TWIST,
        functions("sin(p1)", "exp(p1)", "p1**3", "q1"), box(1, 60)), "sin(p1)"),
    "squares of sums in place of squares": case((OSCILLATOR,
        functions("(q1 + p1)**2", "(q1 - p1)**2", "(q1 + 2 * p1)**2"), box(1, 60)), E),
    # the condition number is 1e5
    "functions that differ by 1e-5 of them": case((OSCILLATOR,
        functions("q1**2", "q1**2 + 1e-5 * q1 * p1", "p1**2"), box(1, 60)), E),
    "the invariant alone": case((OSCILLATOR, functions(E), box(1, 40)), E),
    "angular momenta alone": case((CENTRAL, functions(LX, LY, L), box(3, 60)), (LX, LY, L)),
    # total momentum, and the quadratic form of the difference of the positions
    "two invariants of three functions": case((COUPLED, functions("p1 + p2", RELATIVE, "q1"),
        box(2, 60)), ("p1 + p2", RELATIVE)),
    "the square of the invariant, but not the invariant": case((OSCILLATOR,
        functions(f"({E})**2", "q1**4", "p1**4", "q1**2"), box(1, 60)), f"({E})**2"),
    "exponential and logarithm of the invariant": case((OSCILLATOR,
        functions(f"exp({E})", f"log(1 + {E})", "q1"), box(1, 60)), f"exp({E})"),
    # no linear function is conserved
    "a basis that is too small": case((OSCILLATOR, poly(1), box(1, 40))),
    # no function of q is conserved
    "positions alone": case((OSCILLATOR, poly(5, ["q"]), box(1, 60))),
    # the map conserves p² + q² − h q p, and the basis has no q p
    "the energy of the flow alone": case((OSCILLATOR, functions("q @ q + p @ p", "q1", "p1"),
        box(1, 40), 1e-4)),
    "the energy of the flow alone, in one function": case((OSCILLATOR, functions("q @ q + p @ p"),
        box(1, 40), 1e-4)),
    "powers of the radius for Kepler's problem": case((KEPLER,
        poly(2) + dvi.Radial((-3, -2, -1, 1, 3)), shell(2, 100)), L),
    "radial functions times polynomials for Kepler's problem": case((KEPLER,
        poly(2) + poly(2) * dvi.Radial((-1,)), shell(2, 120)), L),
    # e^{20 q} is of size 1e8 on the samples
    "a steep function among tame ones": case((OSCILLATOR, QUADRATICS + functions("exp(20 * q1)"),
        box(1, 80)), E),
    "functions with coefficients of 1e40 and 1e-40": case((OSCILLATOR,
        functions("1e40 * q1**2", "1e-40 * p1**2", "q1*p1"), box(1, 60)), E),
    # Gaussians of width 0.1 around five points
    "localised functions": case((OSCILLATOR, GAUSSIANS, box(1, 300))),
    # max(q − 0.9, 0)² is not conserved
    "a function that vanishes on most samples": case((OSCILLATOR,
        QUADRATICS + functions("maximum(q1 - 0.9, 0.0)**2"), box(1, 200)), E),
}  # fmt: skip
_FEW = {
    f"{name}, as few samples as are allowed": case(
        (system, basis, samples, h), truth, points=points
    )
    for name, system, basis, samples, points, truth, h in (
        ("oscillator", OSCILLATOR, poly(4), box(1, 28), box(1, 60), (E,), 0.1),
        ("McMillan's map", MCMILLAN, poly(4), box(1, 28), box(1, 60), (BIQUADRATIC,), 1.0),
        ("Hénon's map", HENON, poly(4), box(1, 28), box(1, 60), (), 1.0),
        (
            *("standard map", standard(0.5), WAVES),
            *(sized(1, 50, 3.1, 3.1), sized(1, 80, 3.1, 3.1), (), 1.0),
        ),
        # three of the four quadratic invariants are independent
        (
            *("isotropic oscillator", ISOTROPIC, poly(2), box(2, 28), box(2, 60)),
            *((*energies(0.1, 1.0, 1.0), L), 0.1),
        ),
        ("central force in the plane", CENTRAL, poly(3), box(2, 68), box(2, 100), (L,), 0.1),
        ("one function", OSCILLATOR, functions("p1"), box(1, 2), box(1, 20), (), 0.1),
    )
}
_WHERE = {
    "oscillator, 5000 samples": case((OSCILLATOR, poly(4), box(1, 5000)), E, points=box(1, 100)),
    # samples are points, and rounded ones are points too
    "McMillan's map, samples in float32": case((MCMILLAN, poly(4), half_precision(box(1, 100)),
        1.0), BIQUADRATIC),
    "Kepler, samples in float32": case((KEPLER, ENERGIES, half_precision(shell(2, 100))), L),
    "oscillator, samples on a grid": case((OSCILLATOR, poly(6), grid(12)), E),
    "Hénon's map, samples on a grid": case((HENON, poly(6), grid(12), 1.0)),
    "central force, samples on a coarse grid": case((CENTRAL, poly(2), grid(4, 2)), L),
    # what one step conserves from a generic curve
    "oscillator, samples on a curve": case((OSCILLATOR, poly(2), curve), E, points=box(1, 60)),
    "quartic oscillator, samples on a curve": case((QUARTIC, poly(2), curve), points=box(1, 60)),
    # an invariant is constant on each orbit, and so are its products with others
    "oscillator, samples on one orbit": case((OSCILLATOR, poly(2),
        orbits(lambda rng: rng.uniform(0.5, 1.0, (2, 1, 1)), of_oscillator, 80)), E,
        points=box(1, 60)),
    "McMillan's map, samples on ten orbits": case((MCMILLAN, poly(4),
        orbits(lambda rng: rng.uniform(-1, 1, (2, 10, 1)), of_mcmillan, 20), 1.0), BIQUADRATIC),
    "oscillator, each sample four times": case((OSCILLATOR, poly(4), repeated(box(1, 40), 4)), E),
    "McMillan's map, samples in one quadrant": case((MCMILLAN, poly(4), box(1, 100, 0.2, 2.0), 1.0),
        BIQUADRATIC),
    "McMillan's map, samples of a Cauchy distribution": case((MCMILLAN, poly(4),
        lambda rng: tuple(rng.standard_cauchy((2, 150, 1))), 1.0), BIQUADRATIC, points=box(1, 100)),
    "oscillator, some samples at rest in the equilibrium": case((OSCILLATOR, poly(4), some_at_rest),
        E),
    "oscillator, a box of 1e-8 about the equilibrium": case((OSCILLATOR, poly(2),
        box(1, 60, -1e-8, 1e-8)), E),
    # the map is nearly a shear there; p changes by 1e-12 h, which is 1e-8 of p
    "quartic oscillator, a box of 1e-4": case((QUARTIC, poly(2), box(1, 60, -1e-4, 1e-4), 1.0)),
}  # fmt: skip
CASES = (*named("bases", _BASES), *named("few samples", _FEW), *named("samples", _WHERE))
