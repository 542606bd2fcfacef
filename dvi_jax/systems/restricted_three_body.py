"""The circular restricted three-body problem in the rotating frame of the two bodies."""

import jax.numpy as jnp
import numpy as np

from ._problem import DIMENSIONLESS, Parameter, Problem, Start, finite, library_problem
from .kepler import angular_momentum

EARTH_MOON = 0.012150585
"""Mass of the Moon over that of Earth and Moon (JPL DE405: Earth/Moon = 81.30056)."""


def potential(q, mu):
    """−(1 − μ)/r1 − μ/r2 with the large body at (−μ, 0, 0), the small one at (1 − μ, 0, 0)."""
    x, y, z = q
    square = y**2 + z**2
    r1, r2 = jnp.sqrt((x + mu) ** 2 + square), jnp.sqrt((x - 1 + mu) ** 2 + square)
    return -(1 - mu) / r1 - mu / r2


def hamiltonian(t0, t1, q0, p1, args):
    r"""Energy in the frame that rotates about z with period 2π; not separable.

        H_D = |p1|²/2 − (x p_y − y p_x) − (1 − μ)/r1 − μ/r2,    q0 = (x, y, z)

    with momenta p = v + ẑ × q, the velocity in the inertial frame.
    """
    x, y, _ = q0
    return jnp.sum(p1**2) / 2 - (x * p1[1] - y * p1[0]) + potential(q0, args["mu"])


def jacobi_constant(t0, t1, q0, p0, q1, p1, args):
    """C = x² + y² + 2(1 − μ)/r1 + 2μ/r2 − |v|² at t1, without a constant μ(1 − μ)."""
    v = velocity(q1, p1)
    return q1[0] ** 2 + q1[1] ** 2 - 2 * potential(q1, args["mu"]) - jnp.sum(v**2)


def velocity(q, p):
    """v = p − ẑ × q in the rotating frame."""
    return p + jnp.stack([q[1], -q[0], jnp.zeros_like(q[2])])


def momentum(q, v):
    """p = v + ẑ × q of a velocity in the rotating frame."""
    return v - jnp.stack([q[1], -q[0], jnp.zeros_like(q[2])])


def _mass_fraction(name, mu):
    if not 0 < finite(name, mu) <= 0.5:
        raise ValueError(f"{name} must satisfy 0 < mu ≤ 1/2, got {mu}.")


def lagrange_points(mu):
    r"""The equilibria L1, …, L5 of the rotating frame: shape (5, 3), NumPy.

    L1, L2, L3 on the line of the bodies: between them, beyond the small one, beyond the large one;
    L4 ahead of the small body by 60°, L5 behind. L1 to L3 are roots of

        x − (1 − μ)(x + μ)/|x + μ|³ − μ (x − 1 + μ)/|x − 1 + μ|³ = 0

    by bisection to the last digits. **Raises** `ValueError` for μ outside 0 < μ ≤ 1/2.
    **Source** Szebehely 1967, *Theory of Orbits*, 4.
    """
    _mass_fraction("mu", mu := float(mu))

    def pull(x):
        a, b = x + mu, x - 1 + mu
        return x - (1 - mu) * a / abs(a) ** 3 - mu * b / abs(b) ** 3

    small, large, line = 1 - mu, -mu, []
    for low, high in ((large, small), (small, 2.0), (-2.0, large)):
        # pull increases from −∞ to ∞ between neighbouring bodies, or a body and infinity
        while (x := (low + high) / 2) not in (low, high):
            low, high = (x, high) if pull(x) < 0 else (low, x)
        line.append([x, 0.0, 0.0])
    side = 3**0.5 / 2
    return np.array([*line, [0.5 - mu, side, 0.0], [0.5 - mu, -side, 0.0]])


def restricted_three_body() -> Problem:
    """A libration about L4 of the Earth–Moon system, in and out of the plane.

    Unit of length: the distance of the two bodies; of time: their period over 2π. Initial
    conditions and step are ours.

    **Source** Szebehely 1967, *Theory of Orbits*, 1 and 4.
    """
    q0 = lagrange_points(EARTH_MOON)[3] + [0.01, 0.0, 0.02]
    bodies = {
        "the large body": _large_body,
        "the small body": _small_body,
    }
    meaning = "share of the small body in the mass of both, at most 1/2 [1]"
    return library_problem(
        hamiltonian,
        Start("the restricted problem has one body in space", (3,), singular=bodies),
        name="restricted_three_body",
        q0_p0_h=(q0, np.array([-q0[1], q0[0], 0.0]), 0.02),
        parameters={"mu": Parameter(EARTH_MOON, meaning, _mass_fraction)},
        observables=[jacobi_constant, angular_momentum],
        units=DIMENSIONLESS | {"q": "distance of the bodies", "t": "period/2π"},
        source="Szebehely 1967, Theory of Orbits, 1 and 4",
        invariants=("jacobi_constant",),
    )


def _large_body(args):
    return -args["mu"], 0.0, 0.0


def _small_body(args):
    return 1 - args["mu"], 0.0, 0.0
