"""Systems with friction and thermal noise: a particle in a double well, a chain of particles."""

import jax.numpy as jnp
import numpy as np

from ..base.checks import whole
from ._problem import Parameter, Problem, Start, configurational, library_problem, thermal


def well(t0, t1, q0, p1, args):
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
    system, parameters = thermal(well, friction, temperature, barrier=barrier)
    return library_problem(
        system,
        Start("the particle in a double well has one degree of freedom", (1,)),
        parameters,
        name="double_well",
        q0_p0_h=(np.array([1.2]), np.array([0.2]), 0.1),
        observables=[configurational(well)],
        source="Kramers 1940, Physica 7, 284",
    )


def bonds(t0, t1, q0, p0, q1, p1, args):
    """Extensions of the springs at t1, q_1 and q_i − q_{i−1}: shape (n,)."""
    return jnp.diff(q1, prepend=0)


def chain(t0, t1, q0, p1, args):
    r"""Energy of unit masses on quartic springs, the first of which is fixed to a wall.

    H_D = Σ_i p1_i²/2 + Σ_i (d_i²/2 + β d_i⁴/4),    d_1 = q0_1,  d_i = q0_i − q0_{i−1}
    """
    d = jnp.diff(q0, prepend=0)
    return jnp.sum(p1**2) / 2 + jnp.sum(d**2 / 2 + args["beta"] * d**4 / 4)


def thermal_chain(n: int = 10, temperature: float | None = None, friction: float = 1.0) -> Problem:
    """A chain of n particles with one free end; with a temperature, Langevin's equation.

    Dimensionless, β = 1. With friction and noise the stationary distribution is canonical: the
    extensions d_i of the springs are independent, each with the density
    exp(−(d²/2 + βd⁴/4)/T) / Z, and each p_i is normal with the variance T.

    **Raises** `ValueError` for fewer than one particle, and for a temperature or a friction that is
    not positive.

    **Source** Lepri, Livi & Politi 2003, *Phys. Rep.* 377, 1 (chains in contact with heat baths).
    """
    n = whole("n", n, hint="The thermal chain is a row of particles.")
    beta = Parameter(1.0, "quartic part of a spring [energy/length⁴]")
    system, parameters = thermal(chain, friction, temperature, beta=beta)
    return library_problem(
        system,
        Start("the thermal chain is a row of particles", (None,)),
        parameters,
        name="thermal_chain",
        q0_p0_h=(np.linspace(0.0, 0.5, n), np.linspace(0.3, -0.3, n), 0.1),
        observables=[bonds, configurational(chain)],
        source="Lepri, Livi & Politi 2003, Phys. Rep. 377, 1",
    )
