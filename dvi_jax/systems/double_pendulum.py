"""Two pendulums, the second attached to the bob of the first."""

import jax.numpy as jnp
import numpy as np

from ._problem import Parameter, Problem, Start, finite, library_problem


def hamiltonian(t0, t1, q0, p1, args):
    r"""Energy in canonical angles and momenta; not separable.

        H_D = [m2 l2² P1² + (m1 + m2) l1² P2² − 2 m2 l1 l2 P1 P2 cos Δ]
              / [2 m2 l1² l2² (m1 + m2 sin² Δ)] − (m1 + m2) g l1 cos q1 − m2 g l2 cos q2

    with (P1, P2) = p1, (q1, q2) = q0, both from the downward vertical, and Δ = q1 − q2.
    """
    m1, m2, l1, l2, g = (args[name] for name in ("m1", "m2", "l1", "l2", "g"))
    (a, b), (A, B) = q0, p1
    c, s = jnp.cos(a - b), jnp.sin(a - b)
    top = m2 * (l2 * A) ** 2 + (m1 + m2) * (l1 * B) ** 2 - 2 * m2 * l1 * l2 * A * B * c
    kinetic = top / (2 * m2 * (l1 * l2) ** 2 * (m1 + m2 * s**2))
    return kinetic - (m1 + m2) * g * l1 * jnp.cos(a) - m2 * g * l2 * jnp.cos(b)


def angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """P1 + P2 at t1: the angular momentum about the hinge, conserved for g = 0 only."""
    return jnp.sum(p1)


def double_pendulum() -> Problem:
    """A chaotic double pendulum: 1 kg on rods of 1 m, from rest at 90° and 60°.

    **Source** Landau & Lifshitz 1976, *Mechanics*, §5, Problem 1; the Legendre transform and
    the initial conditions are ours.
    """
    return library_problem(
        hamiltonian,
        Start("the double pendulum has two angles", (2,)),
        name="double_pendulum",
        q0_p0_h=(np.array([np.pi / 2, np.pi / 3]), np.zeros(2), 0.005),
        parameters={
            "m1": Parameter(1.0, "mass of the upper bob [kg]"),
            "m2": Parameter(1.0, "mass of the lower bob [kg]"),
            "l1": Parameter(1.0, "length of the upper rod [m]"),
            "l2": Parameter(1.0, "length of the lower rod [m]"),
            "g": Parameter(9.81, "gravity [m/s²]", finite),
        },
        observables=[angular_momentum],
        units={"q": "rad", "p": "kg m²/s", "t": "s", "energy": "J"},
        source="Landau & Lifshitz 1976, Mechanics, §5, Problem 1",
    )
