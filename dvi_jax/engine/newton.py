"""Newton's method for small systems of equations, with the implicit derivative."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Inexact, Int

from .linear import solve_dense, solve_near_identity, unit_vectors

Vector = Inexact[Array, " n"]


class Newton(eqx.Module):
    """Settings of Newton's method for the implicit part of a step.

    The iteration stops once the correction of each component is at most ``rtol * scale +
    atol``, `scale` being the larger of that component's known and unknown value; or, for
    components that are nothing but round-off of larger ones, once they are as small beside those
    and shrink no more. Convergence being quadratic, the accepted iterate, which includes that
    last correction, is then accurate to round-off.

    **Arguments**

    - `rtol`: relative tolerance; None means 4096 units of round-off (9e-13 in float64).
    - `atol`: absolute tolerance [unit of the unknown].
    - `max_steps`: iterations after which the status becomes `not_converged`.

    **Raises** `ValueError` for tolerances that are negative or both zero, or fewer than one step.
    """

    rtol: float | None = eqx.field(static=True, default=None)
    atol: float = eqx.field(static=True, default=0.0)
    max_steps: int = eqx.field(static=True, default=20)

    def __check_init__(self):
        if isinstance(self.max_steps, bool) or not isinstance(self.max_steps, int):
            raise ValueError(f"max_steps must be an integer of at least 1, got {self.max_steps!r}.")
        if self.max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {self.max_steps}.")
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < float("inf"):
                raise ValueError(f"{name} must be finite and not negative, got {value!r}.")
        if self.rtol == 0 and self.atol == 0:
            raise ValueError("rtol and atol are both zero: no iteration could ever stop.")


class Trusted(eqx.Module):
    """So many iterations of Newton's method, without looking at how they go.

    The verdict comes as a number in place of the residual: how much the last correction of a
    component exceeds what is allowed. At most zero means that the root is good to round-off: the
    correction was below √ε of its component, hence, convergence being quadratic, the next would be
    below round-off; or it was nothing but round-off of larger components. NaN and positive numbers
    mean that the solve is to be made again with care.
    """

    newton: Newton
    iterations: Int[Array, ""]

    def excess(self, correction: Vector, x: Vector, known: Vector) -> Float[Array, ""]:
        eps = float(jnp.finfo(x.dtype).eps)
        rtol = max(self.newton.rtol or 0.0, 0.25 * eps**0.5)
        scale = jnp.maximum(known, jnp.abs(x))
        floor = 64 * eps * jnp.max(scale, initial=0.0) + self.newton.atol
        return jnp.max(jnp.abs(correction) - rtol * scale - floor, initial=-jnp.inf)


class Known(eqx.Module):
    """A root that is known already: nothing is solved for but its derivative."""

    root: Vector


class RootInfo(NamedTuple):
    """How a solve went: iterations made, ‖F‖ at the end over the scale, and its verdict."""

    iterations: Int[Array, ""]
    residual: Float[Array, ""]
    converged: Bool[Array, ""]


class _Iterate(NamedTuple):
    """x after some iterations, the largest relative correction of a component, and verdicts."""

    x: Vector
    relative: Float[Array, ""]
    finite: Bool[Array, ""]
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]


def find_root(
    function: Callable[[Vector], Vector],
    guess: Vector,
    known: Vector,
    options: Newton | Trusted | Known,
) -> tuple[Vector, RootInfo]:
    """Root x of function(x) = 0 near `guess`, and how it was found.

    The derivative of x with respect to anything that `function` closes over is that of the
    implicit function theorem, dx = −(∂F/∂x)⁻¹ dF, in forward and reverse mode and to any
    order: the iteration itself is never differentiated. `known` sets the scale for the
    relative tolerance beside x itself. The Jacobian comes from autodiff.
    """
    known = lax.stop_gradient(jnp.abs(known))
    if isinstance(options, Trusted):
        return _trusted_root(function, guess, known, options)
    if isinstance(options, Known):
        root = lax.custom_root(function, guess, lambda F, x0: options.root, _tangent_solve)
        zero = jnp.asarray(0, jnp.int32)
        return root, RootInfo(zero, jnp.zeros((), guess.dtype), jnp.asarray(True))
    rtol = 4096 * jnp.finfo(guess.dtype).eps if options.rtol is None else options.rtol

    def solve(F, x0):
        def proceed(state: _Iterate):
            return ~state.converged & state.finite & (state.iterations < options.max_steps)

        def improve(state: _Iterate):
            value, jacobian = _value_and_jacobian(F, state.x)
            correction = solve_dense(jacobian, value)
            x = state.x - correction
            error, scale = jnp.abs(correction), jnp.maximum(known, jnp.abs(x))
            settled = jnp.all(error <= rtol * scale + options.atol)
            # A component that is all round-off of the others never settles by its own measure: it
            # is enough that it is small beside them and shrinks no more.
            relative = jnp.max(error / jnp.where(scale > 0, scale, 1), initial=0.0)
            small = _norm(error) <= rtol * _norm(scale) + options.atol
            stalled = small & (relative >= 0.5 * state.relative)
            finite = jnp.isfinite(_norm(correction))
            return _Iterate(x, relative, finite, settled | stalled, state.iterations + 1)

        no = jnp.asarray(False)
        unknown = jnp.full((), jnp.nan, x0.dtype)  # no comparison with it is true
        start = _Iterate(x0, unknown, ~no, no, jnp.asarray(0, jnp.int32))
        end = lax.while_loop(proceed, improve, start)
        scale = jnp.maximum(_norm(known), _norm(end.x))
        residual = _norm(F(end.x))
        relative = jnp.where(scale > 0, residual / jnp.where(scale > 0, scale, 1), residual)
        converged = end.converged & jnp.isfinite(residual)
        # custom_root gives its auxiliary output tangents of the same type, so no integers here.
        return end.x, tuple(jnp.asarray(a, x0.dtype) for a in (end.iterations, relative, converged))

    def tangent_solve(linear, rhs):
        _, matrix = _value_and_jacobian(linear, jnp.zeros_like(rhs))
        return solve_dense(matrix, rhs)

    root, aux = lax.custom_root(function, guess, solve, tangent_solve, has_aux=True)
    iterations, residual, converged = map(lax.stop_gradient, aux)
    return root, RootInfo(iterations.astype(jnp.int32), residual, converged > 0)


def _trusted_root(function, guess: Vector, known: Vector, options: Trusted):
    def solve(F, x0):
        def improve(_, state):
            x, _ = state
            value, jacobian = _value_and_jacobian(F, x)
            correction = solve_near_identity(jacobian, value)
            return x - correction, correction

        x, correction = lax.fori_loop(0, options.iterations, improve, (x0, x0))
        return x, options.excess(correction, x, known)

    root, excess = lax.custom_root(function, guess, solve, _tangent_solve, has_aux=True)
    return root, RootInfo(options.iterations, lax.stop_gradient(excess), jnp.asarray(True))


def _tangent_solve(linear: Callable[[Vector], Vector], rhs: Vector) -> Vector:
    """By the Jacobian at a root that was found without pivoting, or with it."""
    _, matrix = _value_and_jacobian(linear, jnp.zeros_like(rhs))
    return solve_near_identity(matrix, rhs, checked=True)  # nobody looks at a gradient


def _value_and_jacobian(F: Callable[[Vector], Vector], x: Vector) -> tuple[Vector, Array]:
    value, push = jax.linearize(F, x)
    return value, jax.vmap(push, out_axes=1)(unit_vectors(x.shape[0], x.dtype))


def _norm(x: Vector) -> Float[Array, ""]:
    return jnp.max(jnp.abs(x), initial=0.0)
