"""Euler's problem: a body attracted by two fixed centres, in space."""

import jax.numpy as jnp
import numpy as np

from ..discover.symmetries.library import rotation
from ._problem import Parameter, Problem, Start, finite, library_problem
from .oblate_kepler import axial_angular_momentum


def distances(q, args):
    """r1 and r2, from the centres at z = +d and z = −d."""
    x, y, z = q
    d, square = args["d"], x**2 + y**2
    return jnp.sqrt(square + (z - d) ** 2), jnp.sqrt(square + (z + d) ** 2)


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = |p1|²/2 − μ1/r1 − μ2/r2, unit mass; centres at (0, 0, ±d)."""
    r1, r2 = distances(q0, args)
    return jnp.sum(p1**2) / 2 - args["mu1"] / r1 - args["mu2"] / r2


def euler_integral(t0, t1, q0, p0, q1, p1, args):
    r"""Euler's third integral at t1.

        G = L1·L2 + 2d (μ2 cos θ2 − μ1 cos θ1),    L_i = (q − c_i) × p,  cos θ_i = (z ∓ d)/r_i

    L1·L2 = |L|² − d² (p_x² + p_y²). At d = 0 it is |L|². **Source** Erikson & Hill 1949, *Phys.
    Rev.* 75, 29; its sign checked by the Poisson bracket with H.
    """
    r1, r2 = distances(q1, args)
    d, z = args["d"], q1[2]
    momenta = jnp.sum(jnp.cross(q1, p1) ** 2) - d**2 * jnp.sum(p1[:2] ** 2)
    return momenta + 2 * d * (args["mu2"] * (z + d) / r2 - args["mu1"] * (z - d) / r1)


def angular_momentum_squared(t0, t1, q0, p0, q1, p1, args):
    """|q × p|² at t1, conserved by one centre but not by two."""
    return jnp.sum(jnp.cross(q1, p1) ** 2)


def two_centres() -> Problem:
    """An orbit about two fixed unequal centres of attraction; dimensionless.

    Initial conditions and step are ours.

    **Source** Euler 1760; Whittaker 1937, *Analytical Dynamics*, §53; Erikson & Hill 1949, *Phys.
    Rev.* 75, 29.
    """
    centres = {
        "the first centre": _first_centre,
        "the second centre": _second_centre,
    }
    return library_problem(
        hamiltonian,
        Start("the problem of two centres is in space", (3,), singular=centres),
        name="two_centres",
        q0_p0_h=(np.array([2.0, 0.0, 0.5]), np.array([0.1, 0.6, 0.5]), 0.02),
        parameters={
            "mu1": Parameter(1.0, "strength of the centre at z = d [length³/time²]", finite),
            "mu2": Parameter(0.6, "strength of the centre at z = −d [length³/time²]", finite),
            "d": Parameter(0.5, "half the distance of the centres [length]"),
        },
        observables=[axial_angular_momentum, euler_integral, angular_momentum_squared],
        source="Whittaker 1937, Analytical Dynamics, §53; Erikson & Hill 1949, Phys. Rev. 75, 29",
        invariants=("axial_angular_momentum", "euler_integral"),
        symmetries={"rotation": rotation(0, 1)},
    )


def _first_centre(args):
    return 0.0, 0.0, args["d"]


def _second_centre(args):
    return 0.0, 0.0, -args["d"]
