"""A pendulum with a Hamiltonian perturbation that couples position, momentum and time."""

import jax.numpy as jnp

from ._problem import Problem, Start, System, library_problem
from .pendulum import exact as of_pendulum


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = p1²/2 − cos q0."""
    return jnp.sum(p1**2) / 2 - jnp.sum(jnp.cos(q0))


def coupling(t0, t1, q0, p1, args):
    """H1_D = −q0 p1 sin t0, so that H = p²/2 − cos q − ε q p sin t: not separable."""
    return -jnp.sum(q0 * p1) * jnp.sin(t0)


def exact(t, q0, p0, args):
    """The state at times t at ε = 0: see `pendulum.exact`."""
    return of_pendulum(t, q0, p0, {"omega": 1.0})


def perturbed_pendulum() -> Problem:
    """H = p²/2 − cos q − ε q p sin t in a libration; dimensionless.

    The perturbation is Hamiltonian, so that the map is symplectic at every ε; it depends on p, so
    that every variational step is implicit. Perturbation, initial conditions and step are ours.

    **Source** the pendulum: any text.
    """
    return library_problem(
        System(hamiltonian, perturbation=coupling),
        Start("the perturbed pendulum has one angle", (1,)),
        name="perturbed_pendulum",
        q0_p0_h=([0.5], [0.3], 0.1),
        source="our own choice",
        exact=exact,
    )
