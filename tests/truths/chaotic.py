"""Chaotic maps and maps that expand. They conserve nothing in any of these bases: checked in 60
digits, the changes of the basis have full rank."""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import dvi_jax as dvi
from dvi_jax import systems

from . import case, named
from .maps import *

ANGLE_AND_MOMENTUM = trig(3, "q", constant=True) * trig(2, "p", constant=True)
BOTH = trig(1, "q1", constant=True) * trig(1, "q2", constant=True)
HEILES, PENDULA = systems.henon_heiles(), systems.double_pendulum()
FROESCHLE = separable("-0.5 * cos(q1) - 0.3 * cos(q2) - 0.1 * cos(q1 + q2)")


def standard(K):
    """p1 = p − K sin q, q1 = q + p1: Chirikov 1979, Phys. Rep. 52, 263."""
    return separable(f"-{K} * sum(cos(q))")


_CASES = {
    **{f"standard map at K = {K:g}": case((standard(K), ANGLE_AND_MOMENTUM,
        sized(1, 200, 3.14, 3.14), 1.0)) for K in (0.1, 0.5, 5.0)},
    "standard map at K = 0.5 with powers of p": case((standard(0.5),
        poly(4, ["p"], constant=True) * trig(2, "q", constant=True), sized(1, 150, 3.14, 2.0),
        1.0)),
    # Hénon 1969. The formal series about a fixed point diverges and is no polynomial: only an
    # expansion that is said to be one may be reported.
    "Hénon's quadratic map": case((HENON, poly(6), box(1, 120), 1.0)),
    "Hénon's quadratic map close to its fixed point": case((HENON, poly(8),
        box(1, 200, -0.005, 0.005), 1.0)),
    "Hénon's quadratic map in a box of middle size": case((HENON, poly(6), box(1, 120, -0.05, 0.05),
        1.0)),
    # Hénon & Heiles 1964: the energy is cubic, and no method conserves it exactly
    **{f"Hénon–Heiles, {name}": case((HEILES.system, poly(degree), box(2, count, -0.5, 0.5), h),
        args=HEILES.args, **method) for name, degree, count, h, method in (("symplectic Euler", 3,
        100, 0.1, {}), ("Strang", 4, 150, 0.2, {"method": dvi.Strang()}),
        ("Gauss–Legendre", 3, 100, 0.2, {"method": dvi.GaussLegendre(2)}))},
    "double pendulum, Strang": case((PENDULA.system,
        poly(2, MOMENTA) + trig(1, "q1") + trig(1, "q2"), box(2, 60), 0.02), method=dvi.Strang(),
        args=PENDULA.args),
    "double pendulum, type II": case((PENDULA.system,
        poly(3, MOMENTA) + trig(2, "q1") + trig(2, "q2"), box(2, 60), 0.05), args=PENDULA.args),
    # Froeschlé 1972; two standard maps with a coupling
    "Froeschlé's map": case((FROESCHLE, poly(2, MOMENTA) + BOTH, box(2, 80, -3.0, 3.0), 1.0)),
    # q₊ + q₋ = 2q − h²(q³ − q)
    "cubic map": case((separable("sum(q**4 / 4 - q**2 / 2)"), poly(8), box(1, 150, -1.5, 1.5),
        0.8)),
    "quartic oscillator with steps that expand": case((QUARTIC, poly(6), box(1, 120, -20.0, 20.0))),
    # the flow is integrable for a coupling of 0, 1/2 and 3/2, not for 0.4
    "two coupled quartic oscillators": case((separable("(q1**4 + q2**4) / 4 + 0.4 * q1**2 * q2**2"),
        poly(3), box(2, 100), 0.5)),
    "Gaussian kicks": case((separable("exp(-(q @ q))"), poly(4) + functions("exp(-(q @ q))"),
        box(1, 100, -2.0, 2.0), 1.0)),
}  # fmt: skip
CASES = named("chaotic", _CASES)
