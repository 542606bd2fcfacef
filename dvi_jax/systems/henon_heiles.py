"""The star of Hénon and Heiles in the potential of a galaxy."""

import jax.numpy as jnp

from ._problem import Problem, Start, library_problem

ESCAPE_ENERGY = 1 / 6
"""Energy of the three saddles of the potential: orbits of less energy between them are bounded."""


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = |p1|²/2 + |q0|²/2 + x² y − y³/3 with q0 = (x, y)."""
    x, y = q0
    return (jnp.sum(p1**2) + jnp.sum(q0**2)) / 2 + x**2 * y - y**3 / 3


def henon_heiles() -> Problem:
    """The Hénon–Heiles system on a regular orbit of energy 1/12; dimensionless.

    Half the escape energy: most orbits are regular; at 1/8 many are chaotic. Initial conditions
    and step are ours.

    **Source** Hénon & Heiles 1964, *Astron. J.* 69, 73.
    """
    y, py = 0.1, 0.2
    px = (2 * (1 / 12) - py**2 - y**2 + 2 * y**3 / 3) ** 0.5  # at x = 0, for energy 1/12
    return library_problem(
        hamiltonian,
        Start("the Hénon–Heiles system is in the plane", (2,)),
        name="henon_heiles",
        q0_p0_h=([0.0, y], [px, py], 0.1),
        source="Hénon & Heiles 1964, Astron. J. 69, 73",
    )
