"""Billiards: a particle that moves freely between reflections at walls."""

import jax.numpy as jnp

from ..observe import Jump
from ._problem import Parameter, Problem, Start, library_problem


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = |p1|²/2: mass 1."""
    return jnp.sum(p1**2) / 2


def reflection(p, normal):
    """The momentum after an elastic reflection at a wall with this unit normal."""
    return p - 2 * jnp.sum(p * normal) * normal


def billiard(jumps: tuple[Jump, ...], parameters: dict[str, Parameter], start, **fields) -> Problem:
    """A billiard with these walls; `start`: q0, p0 and h."""
    place = Start("a billiard in a plane", (2,))
    return library_problem(hamiltonian, place, parameters, q0_p0_h=start, jumps=jumps, **fields)
