"""A particle in a double well, with friction and thermal noise."""

import jax.numpy as jnp
import numpy as np

from ._problem import Parameter, Problem, Start, configurational, library_problem, thermal


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = p1²/2 + b (q0² − 1)²."""
    return jnp.sum(p1**2 / 2 + args["barrier"] * (q0**2 - 1) ** 2)


def double_well(temperature: float | None = None, friction: float = 1.0) -> Problem:
    """H = p²/2 + b (q² − 1)², in the right of two wells; with a temperature, Langevin's equation.

    Dimensionless, with b = 1, the height of the barrier. With friction and noise the stationary
    distribution is canonical: q has the density exp(−b (q² − 1)²/T) / Z, p is normal with the
    variance T.

    **Raises** `ValueError` for a temperature or a friction that is not positive.

    **Source** Kramers 1940, *Physica* 7, 284; Leimkuhler & Matthews 2015, *Molecular Dynamics*, 7.
    """
    barrier = Parameter(1.0, "height of the barrier between the wells [energy]")
    return library_problem(
        hamiltonian,
        Start("the particle in a double well has one degree of freedom", (1,)),
        name="double_well",
        q0=np.array([1.2]),
        p0=np.array([0.2]),
        h=0.1,
        observables=[configurational(hamiltonian)],
        source="Kramers 1940, Physica 7, 284",
        **thermal(friction, temperature, barrier=barrier),
    )
