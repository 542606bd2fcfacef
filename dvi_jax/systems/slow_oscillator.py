"""An oscillator whose frequency changes slowly."""

import jax.numpy as jnp
import numpy as np

from ..discover.symmetries.library import scaling
from ..problem.system import System
from ._problem import Adiabatic, Parameter, Problem, Start, at_end, interval, library_problem
from .oscillator import exact as of_oscillator


def frequency(tau, args):
    """ω(τ) = 1 + d sin τ, |d| < 1, of the slow time τ = εt."""
    return 1 + args["depth"] * jnp.sin(tau)


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = (p1² + ω(τ0)² q0²)/2; the times are slow ones, τ = εt."""
    return (jnp.sum(p1**2) + frequency(t0, args) ** 2 * jnp.sum(q0**2)) / 2


energy = at_end(hamiltonian)


def action(t0, t1, q0, p0, q1, p1, args):
    """J = E/ω at the end of the step: the adiabatic invariant; t1 is the slow time τ1."""
    return energy(t0, t1, q0, p0, q1, p1, args) / frequency(t1, args)


def exact(t, q0, p0, args):
    """The state at times t at ε = 0, where ω = 1."""
    return of_oscillator(t, q0, p0, args)


def slow_oscillator() -> Problem:
    """H = (p² + ω(εt)² q²)/2, ω = 1 + 0.3 sin εt: E is proportional to ω, E/ω oscillates by O(ε).

    Dimensionless. A step map conserves an action of its own, which differs by O(h): see "What is
    conserved". Initial conditions and step are ours.

    **Source** Ehrenfest 1916, *Ann. Phys.* 356, 327; Arnold 1989, *Mathematical Methods of
    Classical Mechanics*, §52.
    """
    depth = Parameter(0.3, "relative change of the frequency [1]", interval(-1, 1))
    return library_problem(
        System(hamiltonian, slow_time=True),
        Start("the slow oscillator has one degree of freedom", (1,)),
        name="slow_oscillator",
        q0_p0_h=(np.array([0.4]), np.array([0.3]), 0.1),
        parameters={"depth": depth},
        observables=[action],
        source="Ehrenfest 1916, Ann. Phys. 356, 327; Arnold 1989, §52",
        invariants=("action",),
        adiabatic={"action": Adiabatic("rate of the change over the frequency", 1)},
        symmetries={"scaling": scaling()},
        exact=exact,
    )
