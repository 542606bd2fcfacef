"""Chaotic maps, which conserve nothing in any of these bases, and maps that expand."""

import jax.numpy as jnp

import dvi_jax as dvi
from dvi_jax import systems

from . import Case
from .maps import box, separable, sized

KIND = "chaotic"
NONE = "no invariant: checked in 60 digits, the changes of the basis have full rank"

ANGLE_AND_MOMENTUM = dvi.Trigonometric(3, "q", constant=True) * dvi.Trigonometric(
    2, "p", constant=True
)
HENON = separable(lambda q: jnp.sum(0.4 * q**2 + q**3 / 3))
HENON_HEILES = systems.henon_heiles().system
PENDULA = systems.double_pendulum()
FROESCHLE = separable(
    lambda q: -jnp.sum(jnp.array([0.5, 0.3]) * jnp.cos(q)) - 0.1 * jnp.cos(q[0] + q[1])
)


def standard(K):
    """p1 = p − K sin q, q1 = q + p1."""
    return separable(lambda q: -K * jnp.sum(jnp.cos(q)))


CASES = (
    *(
        Case(
            f"standard map at K = {K:g}",
            KIND,
            "Chirikov 1979, Phys. Rep. 52, 263; " + NONE,
            standard(K),
            ANGLE_AND_MOMENTUM,
            sized(1, 200, 3.14, 3.14),
            h=1.0,
        )
        for K in (0.1, 0.5, 5.0)
    ),
    Case(
        "standard map at K = 0.5 with powers of p",
        KIND,
        NONE,
        standard(0.5),
        dvi.Polynomials(4, ["p"], constant=True) * dvi.Trigonometric(2, "q", constant=True),
        sized(1, 150, 3.14, 2.0),
        h=1.0,
    ),
    Case(
        "Hénon's quadratic map",
        KIND,
        "Hénon 1969; " + NONE,
        HENON,
        dvi.Polynomials(6),
        box(1, 120),
        h=1.0,
    ),
    Case(
        "Hénon's quadratic map close to its fixed point",
        KIND,
        "the formal series about a fixed point diverges and is no polynomial: only an expansion "
        "that is said to be one may be reported",
        HENON,
        dvi.Polynomials(8),
        box(1, 200, -0.005, 0.005),
        h=1.0,
    ),
    Case(
        "Hénon's quadratic map in a box of middle size",
        KIND,
        "as above",
        HENON,
        dvi.Polynomials(6),
        box(1, 120, -0.05, 0.05),
        h=1.0,
    ),
    Case(
        "Hénon–Heiles, symplectic Euler",
        KIND,
        "Hénon & Heiles 1964; " + NONE,
        HENON_HEILES,
        dvi.Polynomials(3),
        box(2, 100, -0.5, 0.5),
        options={"args": systems.henon_heiles().args},
    ),
    Case(
        "Hénon–Heiles, Strang",
        KIND,
        NONE,
        HENON_HEILES,
        dvi.Polynomials(4),
        box(2, 150, -0.5, 0.5),
        h=0.2,
        options={"method": dvi.Strang(), "args": systems.henon_heiles().args},
    ),
    Case(
        "Hénon–Heiles, Gauss–Legendre",
        KIND,
        "the energy is cubic and not conserved exactly; " + NONE,
        HENON_HEILES,
        dvi.Polynomials(3),
        box(2, 100, -0.5, 0.5),
        h=0.2,
        options={"method": dvi.GaussLegendre(2), "args": systems.henon_heiles().args},
    ),
    Case(
        "double pendulum, Strang",
        KIND,
        NONE,
        PENDULA.system,
        dvi.Polynomials(2, ["p1", "p2"]) + dvi.Trigonometric(1, "q1") + dvi.Trigonometric(1, "q2"),
        box(2, 60),
        h=0.02,
        options={"method": dvi.Strang(), "args": PENDULA.args},
    ),
    Case(
        "double pendulum, type II",
        KIND,
        NONE,
        PENDULA.system,
        dvi.Polynomials(3, ["p1", "p2"]) + dvi.Trigonometric(2, "q1") + dvi.Trigonometric(2, "q2"),
        box(2, 60),
        h=0.05,
        options={"args": PENDULA.args},
    ),
    Case(
        "Froeschlé's map",
        KIND,
        "Froeschlé 1972; two standard maps with a coupling; " + NONE,
        FROESCHLE,
        dvi.Polynomials(2, ["p1", "p2"])
        + dvi.Trigonometric(1, "q1", constant=True) * dvi.Trigonometric(1, "q2", constant=True),
        box(2, 80, -3.0, 3.0),
        h=1.0,
    ),
    Case(
        "cubic map",
        KIND,
        "q₊ + q₋ = 2q − h²(q³ − q): " + NONE,
        separable(lambda q: jnp.sum(q**4 / 4 - q**2 / 2)),
        dvi.Polynomials(8),
        box(1, 150, -1.5, 1.5),
        h=0.8,
    ),
    Case(
        "quartic oscillator with steps that expand",
        KIND,
        NONE,
        separable(lambda q: jnp.sum(q**4) / 4),
        dvi.Polynomials(6),
        box(1, 120, -20.0, 20.0),
    ),
    Case(
        "two coupled quartic oscillators",
        KIND,
        "the flow is integrable for a coupling of 0, 1/2 and 3/2, not for 0.4; " + NONE,
        separable(lambda q: (q[0] ** 4 + q[1] ** 4) / 4 + 0.4 * q[0] ** 2 * q[1] ** 2),
        dvi.Polynomials(3),
        box(2, 100),
        h=0.5,
    ),
    Case(
        "Gaussian kicks",
        KIND,
        NONE,
        separable(lambda q: jnp.exp(-(q @ q))),
        dvi.Polynomials(4) + dvi.Basis({"g": lambda q, p: jnp.exp(-(q @ q))}),
        box(1, 100, -2.0, 2.0),
        h=1.0,
    ),
)
