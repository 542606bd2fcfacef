"""The simple harmonic oscillator with the perturbing force −εq."""

import jax.numpy as jnp

from ..discover.functions.generators import Generator
from ..discover.symmetries.library import scaling
from ._problem import Problem, Start, System, at_end, library_problem, over_times


def _xi(t, q, p, args):
    return p


def _eta(t, q, p, args):
    return -q


PHASE = Generator(xi=_xi, eta=_eta)
"""The rotation of the phase plane, ξ = p, η = −q: the flow of the oscillator."""


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = (|p1|² + |q0|²)/2, unit mass and frequency (the paper, before (32))."""
    return (jnp.sum(p1**2) + jnp.sum(q0**2)) / 2


def linear_force(t0, t1, q0, p1, args):
    """W = −q0: the perturbing force F(q) = −εq of the paper's Section 5.1 (printed as εq)."""
    return -q0


energy = at_end(hamiltonian)


def mixed_energy(t0, t1, q0, p0, q1, p1, args):
    """(p_k² + q_{k−1}²)/2, the paper's I_0: H_D on the step that ends at t_k."""
    return hamiltonian(t0, t1, q0, p1, args)


def map_invariant(t0, t1, q0, p0, q1, p1, args):
    """(|p|² + |q|² − h q·p)/2 at t1, an exact invariant of the unperturbed map (h = t1 − t0).

    Our own: the map is linear with matrix M, and MᵀSM = S for S = [[1, −h/2], [−h/2, 1]].
    """
    return (jnp.sum(p1**2) + jnp.sum(q1**2) - (t1 - t0) * jnp.sum(q1 * p1)) / 2


@over_times()
def exact(t, q0, p0, args):
    """The state at times t at ε = 0: (q, p) rotated clockwise by t; q0 and p0 of any one shape."""
    c, s = jnp.cos(t), jnp.sin(t)
    return q0 * c + p0 * s, p0 * c - q0 * s


def oscillator() -> Problem:
    """The paper's oscillator from q = p = 0.01 with h = 0.1; dimensionless."""
    return library_problem(
        System(hamiltonian, linear_force),
        Start("the oscillator can have any dimension", None),
        name="oscillator",
        q0_p0_h=([0.01], [0.01], 0.1),
        observables=[mixed_energy, map_invariant],
        of_steps=["mixed_energy", "map_invariant"],
        units={"q": "1", "p": "1", "t": "1/ω", "energy": "1"},
        source="the paper, Section 5.1",
        symmetries={"scaling": scaling()},
        flow_symmetries={"phase": PHASE},
        exact=exact,
    )
