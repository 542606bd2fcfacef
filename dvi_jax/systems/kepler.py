"""The Kepler problem in the plane with the perturbing force −εq."""

import jax.numpy as jnp

from ..discover.symmetries.library import rotation, scaling
from ..problem.kepler import change
from ._problem import Parameter, Problem, Start, System, library_problem, over_times


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = |p1|²/2 − K²/|q0|, unit mass, attraction (the paper's (37) prints +K²)."""
    return jnp.sum(p1**2) / 2 - args["K"] ** 2 / jnp.sqrt(jnp.sum(q0**2))


def linear_force(t0, t1, q0, p1, args):
    """W = −q0 (the paper, before (44))."""
    return -q0


def mixed_energy(t0, t1, q0, p0, q1, p1, args):
    """H_{k−1}: H_D on the step that ends at t1; the E⁻ of (26) and (29)."""
    return hamiltonian(t0, t1, q0, p1, args)


def angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """L = x p_y − y p_x at t1, the paper's (42)."""
    return q1[0] * p1[1] - q1[1] * p1[0]


@over_times((2,))
def exact(t, q0, p0, args):
    """The state at times t at ε = 0, on an orbit of any eccentricity
    (`dvi_jax.problem.kepler.change`).

    Differentiable in t, q0, p0 and K.
    """
    dq, dp, _ = change(t, q0, p0, args["K"] ** 2)
    return q0 + dq, p0 + dp


def kepler() -> Problem:
    """The paper's Kepler problem with its initial conditions and h = 0.1; dimensionless, K = 1."""
    rule = "the Kepler problem is in the plane (for more dimensions or bodies take n_body)"
    return library_problem(
        System(hamiltonian, linear_force),
        Start(rule, (2,), singular={"the centre": (0, 0)}),
        name="kepler",
        q0_p0_h=([0.0, 1.2], [-1.0, -0.6], 0.1),
        parameters={
            "K": Parameter(1.0, "root of the strength of attraction, K² = GM [length^(3/2)/time]")
        },
        observables=[mixed_energy, angular_momentum],
        of_steps=["mixed_energy"],
        source="the paper, Section 5.2",
        invariants=("angular_momentum",),
        symmetries={"rotation": rotation(), "scaling": scaling(q=1.0, p=-0.5, t=1.5)},
        exact=exact,
    )
