"""Methods with one defect: each check must find one, or it could not fail."""

# Abstract variables of equinox stay arguments of a subclass for pyright, though not at run time.
# pyright: reportCallIssue=false

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

import dvi_jax as dvi


class Control(NamedTuple):
    """A broken method and the check that must find its defect."""

    name: str
    check: str
    method: dvi.Method


class AlteredMethod(dvi.Method):
    """A method with another step, inverse or claims."""

    method: dvi.Method
    order: int = eqx.field(static=True)
    is_symmetric: bool = eqx.field(static=True)
    is_symplectic: bool = eqx.field(static=True)
    is_invertible: bool = eqx.field(static=True)
    own_step: Callable[..., Any] = eqx.field(static=True)
    own_inverse: Callable[..., Any] = eqx.field(static=True)

    def step(self, equations, interval, q0, p0):
        return self.own_step(self.method, equations, interval, q0, p0)

    def inverse(self, equations, interval, q1, p1):
        return self.own_inverse(self.method, equations, interval, q1, p1)

    def needs_no_solve(self, equations, interval, q):
        return self.method.needs_no_solve(equations, interval, q)

    def inverse_needs_no_solve(self, equations, interval, q):
        return self.method.inverse_needs_no_solve(equations, interval, q)


def _step(method, equations, interval, q, p):
    return method.step(equations, interval, q, p)


def _inverse(method, equations, interval, q, p):
    return method.inverse(equations, interval, q, p)


def altered(
    method: dvi.Method,
    step: Callable[..., Any] = _step,
    inverse: Callable[..., Any] = _inverse,
    **claims: Any,
) -> AlteredMethod:
    """`method` with another step or inverse, ``(method, equations, interval, q, p)``, or claims."""
    names = ("order", "is_symmetric", "is_symplectic", "is_invertible")
    properties: Any = {name: getattr(method, name) for name in names} | claims
    return AlteredMethod(method=method, **properties, own_step=step, own_inverse=inverse)


def _explicit_euler(method, equations, interval, q, p):
    _, _, info = method.step(equations, interval, q, p)
    rates = equations.position_rate(interval, q, p), equations.momentum_rate(interval, q, p)
    return q + interval.h * rates[0], p + interval.h * rates[1], info


def _with_frozen_time(method, equations, interval, q, p):
    return method.step(equations, interval._replace(t1=interval.t0), q, p)


def _backwards(method, equations, interval, q, p):
    return method.step(equations, interval.reversed(), q, p)


def _inexact(method, equations, interval, q, p):
    q, p, info = method.inverse(equations, interval, q, p)
    return q * (1 + 1e-8), p, info


def _without_slope(method, equations, interval, q, p):
    fixed = interval._replace(h=jax.lax.stop_gradient(interval.h))
    return method.step(equations, fixed, q, p)


_calls = [0]


def _with_a_number_from_python(method, equations, interval, q, p):
    _calls[0] += 1
    q, p, info = method.step(equations, interval, q, p)
    return q * (1 + 1e-9 * _calls[0]), p, info


@jax.custom_batching.custom_vmap
def _identity(q):
    return q


@_identity.def_vmap
def _mixing_rule(axis_size, in_batched, q):
    del axis_size, in_batched
    return q + 1e-9 * jnp.mean(q, axis=0, keepdims=True), True


def _mixing_lanes(method, equations, interval, q, p):
    return method.step(equations, interval, _identity(q), p)


def _hiding_nan(method, equations, interval, q, p):
    q1, p1, _ = method.step(equations, interval, q, p)
    _, _, fine = method.step(equations, interval, jnp.zeros_like(q), jnp.zeros_like(p))
    return jnp.nan_to_num(q1), jnp.nan_to_num(p1), fine


def _with_other_digits() -> dvi.Method:
    c = list(dvi.KahanLi(8).fractions())
    for i, sign in ((0, 1), (2, -1), (-1, 1), (-3, -1)):
        c[i] += sign * 1e-3
    return dvi.Composition(c, order=2)


_first, _second = (partial(altered, base) for base in (dvi.TypeII(), dvi.Strang()))
_RK4 = altered(dvi.RungeKutta4(), is_symplectic=True)
_OTHER_DIGITS = "KahanLi8 with coefficients changed by 1e-3, declared of order 8"
_FIXED_TIME = "Strang with the force at the initial time of the step only"
_COUNTER = "TypeII with a Python counter that changes at each trace"

CONTROLS: tuple[Control, ...] = (
    Control("TypeII declared to be of order 2", "order", _first(order=2)),
    Control("Strang declared to be of order 1", "order", _second(order=1)),
    Control(_OTHER_DIGITS, "order", altered(_with_other_digits(), order=8)),
    Control(_FIXED_TIME, "forced-order", _second(_with_frozen_time)),
    Control("RungeKutta4 declared to be symplectic", "symplecticity", _RK4),
    Control("explicit Euler in place of TypeII", "symplecticity", _first(_explicit_euler)),
    Control("TypeII declared to be symmetric", "reversal", _first(is_symmetric=True)),
    Control("TypeII with the step −h as its inverse", "adjoint", _first(inverse=_backwards)),
    Control("RungeKutta4 declared to be symplectic", "energy", _RK4),
    Control("RungeKutta4 declared to be symplectic", "momentum", _RK4),
    Control("TypeII without the derivative with respect to h", "gradient", _first(_without_slope)),
    Control("TypeII with an inverse that is wrong by 1e-8", "modes", _first(inverse=_inexact)),
    Control(_COUNTER, "jit", _first(_with_a_number_from_python)),
    Control("TypeII with a batching rule that mixes trajectories", "vmap", _first(_mixing_lanes)),
    Control("TypeII that replaces NaN by numbers", "failure", _first(_hiding_nan)),
    Control("TypeII whose instances never compare equal", "traces", _first(partial(_step))),
)
"""Each of them must fail its check by a number that is measured."""
