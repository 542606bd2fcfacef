"""Hénon and Heiles' star in the plane of a galaxy."""

import jax.numpy as jnp

from .._system import System
from ._problem import Problem, library_problem
from ._start import Start

ESCAPE_ENERGY = 1 / 6
"""Energy of the three saddles of the potential: orbits below it that start inside stay there."""


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = |p1|²/2 + |q0|²/2 + x² y − y³/3 with q0 = (x, y)."""
    x, y = q0
    return (jnp.sum(p1**2) + jnp.sum(q0**2)) / 2 + x**2 * y - y**3 / 3


def henon_heiles() -> Problem:
    """The Hénon–Heiles system on a regular orbit of energy 1/12; dimensionless.

    Half the energy of escape: most orbits there are regular, and at 1/8 many are chaotic. Start
    and step are ours.

    **Source** Hénon & Heiles 1964, *Astron. J.* 69, 73.
    """
    y, py = 0.1, 0.2
    px = (2 * (1 / 12) - py**2 - y**2 + 2 * y**3 / 3) ** 0.5  # at x = 0, for energy 1/12
    return library_problem(
        System(hamiltonian),
        Start("the Hénon–Heiles system is in the plane", (2,)),
        name="henon_heiles",
        q0=[0.0, y],
        p0=[px, py],
        h=0.1,
        source="Hénon & Heiles 1964, Astron. J. 69, 73",
    )
