"""The problems that methods are measured on, and their reference solutions."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax.systems import Problem
from dvi_jax.systems._problem import at_end

STRENGTH = 0.2
"""ε where the force is on."""

_DEFAULT = dvi.Reversible()


def coupled_hamiltonian(t0, t1, q0, p1, args):
    """H = (1 + |q|²)(1 + |p|²)/2 + a |p|² Σq: not separable, not integrable, bounded below."""
    pp = p1 @ p1
    return (1 + q0 @ q0) * (1 + pp) / 2 + args * jnp.sum(q0) * pp


def damping(t0, t1, q0, p1, args):
    """W = −(1 + |q|²) p + cos t: it damps and drives, and depends on p and t."""
    return -(1 + q0 @ q0) * p1 + jnp.cos(t0)


def central_hamiltonian(t0, t1, q0, p1, args):
    """H = |p|²/2 + |q|²/2 + a |q|⁴/4: a central force whose orbits are rosettes."""
    r2 = q0 @ q0
    return p1 @ p1 / 2 + r2 / 2 + args * r2**2 / 4


def modulation(t0, t1, q0, p1, args):
    """W = −q cos t: a central force too, and explicit."""
    return -q0 * jnp.cos(t0)


central_energy = at_end(central_hamiltonian)
"""H of `CENTRAL` at the end of a step."""


def _problem(name, hamiltonian, force, q0, p0) -> Problem:
    system = dvi.System(hamiltonian, force=force)
    return Problem(name, system, np.array(q0), np.array(p0), h=0.1, args=0.3)


COUPLED = _problem("coupled", coupled_hamiltonian, damping, [0.5, -0.3], [0.2, 0.4])
"""Two degrees of freedom; every step of every method but the explicit ones solves."""

SINGLE = _problem("coupled", coupled_hamiltonian, damping, [0.4], [0.3])
"""The same with one degree of freedom."""

CENTRAL = _problem("central", central_hamiltonian, modulation, [0.5, 0.1], [0.2, 0.6])
"""Separable: compositions of `TypeII` need no solve, so that 100 000 steps are fast."""


def inputs(problem: Problem, t0: float = 0.3) -> dict[str, Any]:
    """All that a run depends on, as arrays; the force is on."""
    x = {"q0": problem.q0, "p0": problem.p0, "t0": t0, "h": problem.h, "epsilon": STRENGTH}
    x = {name: jnp.asarray(value, jnp.float64) for name, value in x.items()}
    return x | {"args": jax.tree.map(jnp.asarray, problem.args)}


def run(problem, method, x, num_steps=1, observe=None, adjoint=_DEFAULT) -> dvi.Solution:
    """The end of a run of `num_steps` steps from the inputs x."""
    options = {"method": method, "observe": observe, "adjoint": adjoint, "throw": False}
    save = dvi.Save(final=True)
    return dvi.integrate(problem.system, **x, num_steps=num_steps, save=save, **options)


def state(solution: dvi.Solution) -> jax.Array:
    """(q, p) at the end, as one vector; NaN if a step failed."""
    return jnp.concatenate([solution.qs[-1].ravel(), solution.ps[-1].ravel()])


def flow(problem: Problem, method: dvi.Method):
    """Compiled ``(x, n)`` → (q, p) after n steps from the inputs x, stacked.

    One program for all numbers of steps: an order is measured with a dozen of them.
    """

    @jax.jit
    def advance(x, n):
        def body(k, qp):
            start = {"q0": qp[0], "p0": qp[1], "t0": x["t0"] + k * x["h"]}
            solution = run(problem, method, x | start)
            return solution.qs[-1], solution.ps[-1]

        return jnp.stack(jax.lax.fori_loop(0, n, body, (x["q0"], x["p0"])))

    return lambda x, n: np.asarray(advance(jax.tree.map(jnp.asarray, x), n))


SPAN = 40
"""Length of time over which orders are measured, as a multiple of the problem's step size."""


@functools.cache
def reference(problem: Problem, epsilon: float) -> tuple[np.ndarray, float]:
    """(q, p) after `SPAN`, and an estimate of its error: the change from half the steps."""
    x = inputs(problem, 0.0) | {"epsilon": epsilon}
    coarse, fine = (most_accurate(problem)(x | {"h": SPAN * problem.h / n}, n) for n in (40, 80))
    return fine, float(np.max(np.abs(fine - coarse)))


@functools.cache
def most_accurate(problem: Problem):
    """`flow` of the Gauss method of order 16, which is independent of every composition."""
    return flow(problem, dvi.GaussLegendre(8))
