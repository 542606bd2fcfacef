"""Hill's lunar problem: a satellite of a small body that orbits a distant large one."""

import jax.numpy as jnp
import numpy as np

from ._problem import DIMENSIONLESS, Problem, Start, library_problem
from .kepler import angular_momentum
from .restricted_three_body import velocity

LAGRANGE_DISTANCE = 3 ** (-1 / 3)
"""L1 and L2 lie at x = ∓ this, on the line to the large body."""


def hamiltonian(t0, t1, q0, p1, args):
    r"""Energy in the frame that turns about z with the small body; not separable.

        H_D = |p1|²/2 − (x p_y − y p_x) − x² + y²/2 + z²/2 − 1/|q0|,    q0 = (x, y, z)

    x points away from the large body, y along the orbit; p = v + ẑ × q.
    """
    x, y, z = q0
    tide = -(x**2) + (y**2 + z**2) / 2
    r = jnp.sqrt(jnp.sum(q0**2))
    return jnp.sum(p1**2) / 2 - (x * p1[1] - y * p1[0]) + tide - 1 / r


def jacobi_constant(t0, t1, q0, p0, q1, p1, args):
    """Γ = 3x² − z² + 2/r − |v|² at t1; the passages at L1 and L2 are open for Γ < 3^(4/3)."""
    v, r = velocity(q1, p1), jnp.sqrt(jnp.sum(q1**2))
    return 3 * q1[0] ** 2 - q1[2] ** 2 + 2 / r - jnp.sum(v**2)


def hill() -> Problem:
    r"""Hill's problem: an inclined orbit about the small body at a third of the distance of L2.

    Unit of length: (m/M)^(1/3) times the distance of the two bodies of masses M ≫ m; of time: their
    period over 2π. The limit μ → 0 of `restricted_three_body` with lengths over μ^(1/3). Initial
    conditions and step are ours.

    **Source** Hill 1878, *Am. J. Math.* 1, 5; Szebehely 1967, *Theory of Orbits*, 10; scaled as
    in Hénon 1969, *Astron. Astrophys.* 1, 223.
    """
    x, speed = 0.23, 0.23**-0.5
    return library_problem(
        hamiltonian,
        Start("Hill's problem has one body in space", (3,), singular={"the small body": (0, 0, 0)}),
        name="hill",
        q0_p0_h=(np.array([x, 0.0, 0.0]), np.array([0.0, 0.95 * speed + x, 0.3 * speed]), 0.005),
        observables=[jacobi_constant, angular_momentum],
        units=DIMENSIONLESS | {"q": "(m/M)^(1/3) distances of the bodies", "t": "period/2π"},
        source="Hill 1878, Am. J. Math. 1, 5; Hénon 1969, Astron. Astrophys. 1, 223",
        invariants=("jacobi_constant",),
    )
