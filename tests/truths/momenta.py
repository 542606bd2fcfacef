"""Momentum maps: what symmetries conserve, in any method that has them.

The source is Noether's theorem for H_D with the same symmetry (Marsden & West 2001, 1.3.3), for
Gauss–Legendre methods that they conserve linear and quadratic invariants (Hairer, Lubich & Wanner
2006, IV.2.1).
"""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from . import case, named
from .maps import *

MASSES = np.array([1.0, 2.0, 3.0])


def bodies(soft=0.1):
    """Three bodies in the plane that attract each other, positions of shape (3, 2)."""

    def H_D(t0, t1, q, p, args):
        V = sum(
            -MASSES[i] * MASSES[j] / jnp.sqrt(jnp.sum((q[i] - q[j]) ** 2) + soft**2)
            for i, j in [(0, 1), (0, 2), (1, 2)]
        )
        return jnp.sum(p**2 / MASSES[:, None]) / 2 + V

    return dvi.System(H_D)


def of_bodies(*masses):
    """Total momentum, Σ x p_y − y p_x, and the angular momentum (Σ m q) ∧ P of the centre of mass,
    which moves at the constant P/Σm."""
    m = np.array(masses)[:, None]

    def value(q, p, t):
        centre, momentum = jnp.sum(m * q, axis=0), jnp.sum(p, axis=0)
        return centre[0] * momentum[1] - centre[1] * momentum[0]

    spin = "sum(q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0])"
    return "sum(p[:, 0])", "sum(p[:, 1])", spin, value


def bilinear(n, d=2):
    """The momenta, and every product of a position and a momentum."""
    names, momenta = ([f"{v}{i + 1}" for i in range(n * d)] for v in "qp")
    return poly(1, momenta) + (poly(1, names) * poly(1, momenta))


SPHERE = system("p1**2 / 2 + p2**2 / (2 * sin(q1)**2) + cos(q1)")
ON_SPHERE = moved(box(2, 80), q=[1.5, 0.0])
PAIR = system("sum(p**2) / 2 - 1 / sqrt(sum((q[0] - q[1])**2) + 0.1)")
ANGLES = poly(3, MOMENTA) + trig(1, "q1") + trig(1, "q2")
KINETIC = "((p1 + q2/2)**2 / 2 + (p2 - q1/2)**2 / 2)"
PENDULA = system("(p1**2 + 2 * p2**2 - 2 * p1 * p2 * cos(q1 - q2)) / (2 * (1 + sin(q1 - q2)**2))")
CHAIN = "[q1 - q4, q2 - q1, q3 - q2, q4 - q3]"
GAUSS = dvi.GaussLegendre(2)

_CASES = {
    **{f"three bodies in the plane, {name}": case((bodies(), bilinear(3), box((3, 2), 110), 0.05),
        of_bodies(*MASSES), method=method) for name, method in (("type II", dvi.TypeII()),
        ("Strang", dvi.Strang()), ("Yoshida", dvi.Yoshida(4)), ("adjoint", dvi.Adjoint()))},
    "two bodies in the plane, Gauss–Legendre": case((PAIR, bilinear(2), box((2, 2), 60), 0.05),
        of_bodies(1, 1), method=GAUSS),
    # Galilei boosts: m₁q₁ + m₂q₂ − t (p₁ + p₂), since q1 = q + h p1/m and the total momentum is
    # constant
    "centre of mass of two bodies on a line": case((system("p1**2 / 2 + p2**2 / 4 + cosh(q1 - q2)"),
        poly(2, ["q1", "q2", "p1", "p2", "t"]), timed(box(2, 80))),
        ("p1 + p2", "q1 + 2 * q2 - t * (p1 + p2)")),
    "central force in the plane, quartic": case((CENTRAL, poly(4), box(2, 150), 0.3), L),
    "central force in space": case((CENTRAL, poly(2), box(3, 80), 0.3), ANGULAR),
    "central force in space, Gauss–Legendre": case((CENTRAL, poly(2), box(3, 80), 0.2), ANGULAR,
        method=GAUSS),
    "Kepler in space, adjoint": case((KEPLER, ENERGIES, shell(3, 80)), ANGULAR,
        method=dvi.Adjoint()),
    "Kepler in space, Yoshida": case((KEPLER, ENERGIES, shell(3, 80), 0.3), ANGULAR,
        method=dvi.Yoshida(4)),
    # H does not depend on q₂, so that p₂ is conserved
    "cyclic coordinate with a mass that varies": case(
        (system("p1**2 / 2 + p2**2 / (2 * (1 + q1**2)) + q1**4"), poly(3), box(2, 100)), "p2"),
    # the azimuth is cyclic; type II solves for p_θ alone
    "spherical pendulum in angles": case((SPHERE,
        poly(3, MOMENTA) + trig(2, "q1") + (poly(1, MOMENTA) * trig(1, "q1")), ON_SPHERE, 0.05),
        "p2"),
    "spherical pendulum in angles, Strang": case((SPHERE, poly(3, MOMENTA) + trig(2, "q1"),
        ON_SPHERE, 0.05), "p2", method=dvi.Strang()),
    # turning both arms: p₁ + p₂, for the kinetic energy depends on q₁ − q₂
    "double pendulum without gravity": case((PENDULA, ANGLES, box(2, 80), 0.05), "p1 + p2",
        method=dvi.Strang()),
    # translations; Fermi, Pasta, Ulam & Tsingou 1955
    "periodic chain of four masses": case((separable(
        f"sum(array({CHAIN})**2 / 2 + 0.25 * array({CHAIN})**3 / 3)"), poly(2), box(4, 110)),
        "sum(p)", method=dvi.Strang()),
    # x cos z + y sin z is invariant under turns about z by α with shifts of z by α: L₃ + p₃
    "screw symmetry": case((separable("q1 * cos(q3) + q2 * sin(q3)"), poly(2), box(3, 80), 0.3),
        f"{L} + p3"),
    # linear map: p₁ − q₂/2, p₂ + q₁/2 (translations) and the kinetic energy; L depends on them
    "magnetic field, symmetric gauge": case((system(KINETIC), poly(2), box(2, 80)),
        ("p1 - q2/2", "p2 + q1/2", KINETIC)),
    # Froeschlé's map with the coupling cos(q₁ + q₂) alone: p₁ − p₂
    "coupled standard maps with one sum of angles": case((separable("-0.8 * cos(q1 + q2)"), ANGLES,
        box(2, 80, -3.0, 3.0), 1.0), "p1 - p2"),
    # potential of q₁² + q₂² and q₃: L₃ only, in space
    "two springs with equal constants, and a third axis": case(
        (separable("(q1**2 + q2**2)**2 / 4 + q3**4 / 4 + q3 * (q @ q)"), poly(2), box(3, 80)), L),
}  # fmt: skip
CASES = named("momentum maps", _CASES)
