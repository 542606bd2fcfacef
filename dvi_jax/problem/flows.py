"""Hamiltonians whose flow is known: the parts of `dvi.Split` that need no discrete map."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import all_finite
from ..base.signature import check_takes, notes_of
from ..base.types import Args, HamiltonianFn, Scalar, State
from . import kepler as _kepler

Parameter = Any
"""A number, an array, or a function of args that returns one."""


def value_of(parameter: Parameter, args: Args, like: Array) -> Array:
    """The value of a parameter, in the precision of another array."""
    if callable(parameter):
        with notes_of("the function of args that gives a parameter"):
            return jnp.asarray(parameter(args), like.dtype)
    return jnp.asarray(parameter, like.dtype)


class Flow(eqx.Module):
    """Base of the Hamiltonians with a known flow, autonomous ones.

    A flow is called as a discrete Hamiltonian, ``(t0, t1, q0, p1, args)`` → scalar [energy], and
    `change` advances a state by the exact flow.
    """

    def __check_init__(self):
        for name, value in vars(self).items():
            if not (callable(value) or is_traced(value)):
                all_finite(f"{name} of flows.{type(self).__name__}", value, name == "mass")

    @abc.abstractmethod
    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> Scalar:
        """H(q0, p1)."""

    @abc.abstractmethod
    def change(self, h: Scalar, q: State, p: State, args: Args) -> tuple[State, State, Array]:
        """q(h) − q, p(h) − p along the flow, and whether they were found."""


class Known(Flow):
    """A Hamiltonian with a flow that the user knows.

    **Arguments** `H`: function ``(t0, t1, q0, p1, args)`` → scalar [energy]. `flow`: function
    ``(h, q, p, args)`` → (q, p) after the time h, which may be negative.

    **Raises** `TypeError` for functions of other arguments; `ValueError` (in `integrate`, for an
    initial state that is not traced) if the derivative of the flow at h = 0 is not that of H.
    """

    H: HamiltonianFn
    flow: Callable[..., Any]

    def __check_init__(self):
        check_takes("H of flows.Known", self.H, "(t0, t1, q0, p1, args)")
        check_takes("flow of flows.Known", self.flow, "(h, q, p, args)")

    def __call__(self, t0, t1, q0, p1, args):
        return self.H(t0, t1, q0, p1, args)

    def change(self, h, q, p, args):
        q1, p1 = self.flow(h, q, p, args)
        return q1 - q, p1 - p, jnp.asarray(True)


class Kepler(Flow):
    r"""Kepler problems with one centre: H = Σ_i |p_i|²/(2 m_i) − k_i/|q_i|.

    **Arguments** `k`: strength of the attraction [energy length]. `mass`: m [mass]. Numbers, or
    arrays with one entry for each row of q, or functions of args that return them.

    q has the shape (dim,) or (bodies, dim). Orbits of any eccentricity and steps of any length;
    Kepler's equation is solved in universal variables to round-off, and derivatives are those of
    the implicit function theorem. A body at the centre has the status `not_finite`.

    **Source** see `dvi_jax.problem.kepler.change`.
    """

    k: Parameter = 1.0
    mass: Parameter = 1.0

    def __call__(self, t0, t1, q0, p1, args):
        k, mass = value_of(self.k, args, q0), value_of(self.mass, args, q0)
        r = jnp.sqrt(jnp.sum(q0 * q0, -1))
        return jnp.sum(jnp.sum(p1 * p1, -1) / (2 * mass) - k / r)

    def change(self, h, q, p, args):
        mass = jnp.broadcast_to(value_of(self.mass, args, q), q.shape[:-1])
        mu = jnp.broadcast_to(value_of(self.k, args, q), q.shape[:-1]) / mass
        mass = mass[..., None]
        dq, dv, converged = _kepler.change(h, q, p / mass, mu)
        return dq, mass * dv, converged


class Harmonic(Flow):
    """Harmonic oscillators: H = Σ_i p_i²/(2 m_i) + m_i ω_i² q_i²/2.

    **Arguments** `omega`: ω [1/time], also 0. `mass`: m [mass]. Numbers, arrays that broadcast with
    q, or functions of args that return them.
    """

    omega: Parameter = 1.0
    mass: Parameter = 1.0

    def __call__(self, t0, t1, q0, p1, args):
        omega, mass = value_of(self.omega, args, q0), value_of(self.mass, args, q0)
        return jnp.sum(p1 * p1 / mass + mass * (omega * q0) ** 2) / 2

    def change(self, h, q, p, args):
        omega, mass = value_of(self.omega, args, q), value_of(self.mass, args, q)
        x = h * omega
        versine, s = 2 * jnp.sin(x / 2) ** 2, jnp.sin(x)  # less: 1 − cos x, without cancellation
        over_omega = h * jnp.sinc(x / jnp.pi)  # sin(ω h)/ω, also for ω = 0
        dq = over_omega * (p / mass) - versine * q
        return dq, -mass * omega * s * q - versine * p, jnp.asarray(True)


class Rotation(Flow):
    """A rotation in the plane of the first two components: H = Ω (q_1 p_2 − q_2 p_1).

    The flow turns q and p by the angle Ω h, counter-clockwise; in a frame that rotates with the
    rate n the Hamiltonian has this part with Ω = −n.

    **Arguments** `rate`: Ω [1/time], a number or a function of args. q has the shape (…, dim ≥ 2).
    """

    rate: Parameter = 1.0

    def __call__(self, t0, t1, q0, p1, args):
        rate = value_of(self.rate, args, q0)
        return rate * jnp.sum(q0[..., 0] * p1[..., 1] - q0[..., 1] * p1[..., 0])

    def change(self, h, q, p, args):
        angle = h * value_of(self.rate, args, q)
        s, versine = jnp.sin(angle), 2 * jnp.sin(angle / 2) ** 2

        def rotate(u):
            x, y = u[..., 0], u[..., 1]
            plane = jnp.stack([-versine * x - s * y, s * x - versine * y], -1)
            return jnp.concatenate([plane, jnp.zeros_like(u[..., 2:])], -1)

        return rotate(q), rotate(p), jnp.asarray(True)
