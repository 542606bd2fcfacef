"""The Kepler problem in the plane, disturbed by −εq."""

import jax.numpy as jnp
import numpy as np

from .._system import System
from ._problem import Problem


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = |p1|²/2 − K²/|q0|, unit mass, attraction (the paper's (37) prints +K²)."""
    return jnp.sum(p1**2) / 2 - args["K"] ** 2 / jnp.sqrt(jnp.sum(q0**2))


def linear_force(t0, t1, q0, p1, args):
    """W = −q0 (the paper, before (44))."""
    return -q0


def energy(t0, t1, q0, p0, q1, p1, args):
    """|p|²/2 − K²/|q| at t1: the continuous energy."""
    return hamiltonian(t0, t1, q1, p1, args)


def mixed_energy(t0, t1, q0, p0, q1, p1, args):
    """H_{k−1}: H_D on the step that ends at t1; the E⁻ of (26) and (29)."""
    return hamiltonian(t0, t1, q0, p1, args)


def angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """L = q_x p_y − q_y p_x at t1, the paper's (42)."""
    return q1[0] * p1[1] - q1[1] * p1[0]


def check_start(q0, p0, args):
    """Refuse a start that is not in the plane, or at the centre, with a `ValueError`."""
    q, p = np.asarray(q0, float), np.asarray(p0, float)
    if q.shape != (2,) or p.shape != (2,):
        raise ValueError(
            f"the Kepler problem here is in the plane: q0 and p0 of shape (2,), got {q.shape} and "
            f"{p.shape}. For more dimensions or bodies take the system n_body."
        )
    if not q.any():
        raise ValueError("the body is on top of the centre, q0 = [0, 0]: the force is infinite.")


def kepler() -> Problem:
    """The paper's Kepler problem with its start and h = 0.1; dimensionless, K = 1."""
    return Problem(
        name="kepler",
        system=System(hamiltonian, force=linear_force),
        q0=[0.0, 1.2],
        p0=[-1.0, -0.6],
        h=0.1,
        args={"K": 1.0},
        observables={
            "energy": energy,
            "mixed_energy": mixed_energy,
            "angular_momentum": angular_momentum,
        },
        units={"q": "1", "p": "1", "t": "1", "energy": "1"},
        source="the paper, Section 5.2",
        check=check_start,
    )
