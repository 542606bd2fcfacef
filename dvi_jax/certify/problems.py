"""The problems that methods are measured on, and a reference solution."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi


def coupled(t0, t1, q0, p1, args):
    """H = (1 + |q|²)(1 + |p|²)/2 + a |p|² Σq: not separable, not integrable, bounded below."""
    pp = p1 @ p1
    return (1 + q0 @ q0) * (1 + pp) / 2 + args * jnp.sum(q0) * pp


def damping(t0, t1, q0, p1, args):
    """W = −(1 + |q|²) p + cos t: it damps and drives, and depends on p and t."""
    return -(1 + q0 @ q0) * p1 + jnp.cos(t0)


COUPLED = dvi.System(coupled, force=damping)
"""With one degree of freedom or two; every step of every method but the explicit ones solves."""

A = 0.3
"""The parameter `args` of `COUPLED` and of `CENTRAL`."""

FORCED = 0.2
"""ε where the force is on."""

TWO = (np.array([0.5, -0.3]), np.array([0.2, 0.4]))
ONE = (np.array([0.4]), np.array([0.3]))
"""Starts (q, p) of `COUPLED`."""


def central(t0, t1, q0, p1, args):
    """H = |p|²/2 + |q|²/2 + a |q|⁴/4: a central force whose orbits are rosettes."""
    r2 = q0 @ q0
    return p1 @ p1 / 2 + r2 / 2 + args * r2**2 / 4


def swing(t0, t1, q0, p1, args):
    """W = −q cos t: a central force too, and explicit."""
    return -q0 * jnp.cos(t0)


CENTRAL = dvi.System(central, force=swing)
"""Separable: compositions of `TypeII` need no solve, so that 100 000 steps cost little."""

ROSETTE = (np.array([0.5, 0.1]), np.array([0.2, 0.6]))
"""Start (q, p) of `CENTRAL`, of angular momentum 0.28."""


def central_energy(t0, t1, q0, p0, q1, p1, args):
    """H of `CENTRAL` at the end of a step."""
    return central(t1, t1, q1, p1, args)


def angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """q × p at the end of a step."""
    return q1[0] * p1[1] - q1[1] * p1[0]


def one_step(system, method, q, p, t, h, epsilon, args):
    """(q, p) after one step; NaN if it failed."""
    solution = dvi.integrate(
        system,
        q,
        p,
        h=h,
        num_steps=1,
        t0=t,
        epsilon=epsilon,
        args=args,
        method=method,
        save=dvi.Save(final=True),
        throw=False,
    )
    return solution.qs[-1], solution.ps[-1]


def flow(system, method):
    """Compiled ``(q, p, t0, h, epsilon, args, n)`` → (q, p) after n steps, n a number like others.

    One program for all numbers of steps: orders are measured with a dozen of them.
    """

    @jax.jit
    def run(q, p, t0, h, epsilon, args, n):
        def body(k, state):
            q, p = state
            return one_step(system, method, q, p, t0 + k * h, h, epsilon, args)

        return jax.lax.fori_loop(0, n, body, (q, p))

    def advanced(q, p, t0, h, epsilon, args, n):
        q, p, t0, h, epsilon, args = map(jnp.asarray, (q, p, t0, h, epsilon, args))
        return np.stack(run(q, p, t0, h, epsilon, args, n))

    return advanced


SPAN = 4.0
"""Length of time over which orders are measured."""


@functools.cache
def reference(epsilon: float) -> tuple[np.ndarray, float]:
    """(q, p) of `COUPLED` at `SPAN` from `TWO`, and an estimate of its error.

    From the Gauss method of order 16, independent of every composition; the estimate is what
    half as many steps change.
    """
    advance = _most_accurate()
    few, many = (advance(*TWO, 0.0, SPAN / n, epsilon, A, n) for n in (40, 80))
    return many, float(np.max(np.abs(many - few)))


@functools.cache
def _most_accurate():
    return flow(COUPLED, dvi.GaussLegendre(8))
