"""Roots of small systems of equations: what solvers have in common, and Newton's method."""

import abc
from collections.abc import Callable
from numbers import Real
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Inexact, Int

import lanewise

Vector = Inexact[Array, " n"]
Function = Callable[[Vector], Vector]


class Scales(NamedTuple):
    """By what the accuracy of each unknown is measured, beside its own size; not negative.

    `known` is the size of the known value that it starts from, and `start` the size of that value
    as it is represented: the same but for states that are told relative to an origin.
    """

    known: Vector
    start: Vector


class Found(NamedTuple):
    """What a solver gives: x, the iterations made, the largest relative correction of the last of
    them, and whether it has converged."""

    x: Vector
    iterations: Int[Array, ""]
    residual: Float[Array, ""]
    converged: Bool[Array, ""]


class RootSolver(eqx.Module):
    """Base of the methods for the implicit part of a step, F(x) = 0: what `newton=` takes.

    F has a Jacobian near the identity, the nearer the smaller h is; a guess is at hand. All
    methods find the root to round-off and have the same derivatives, those of the implicit
    function, to any order; they differ in what an iteration costs and in how many there are.
    """

    @abc.abstractmethod
    def solve(self, F: Function, x0: Vector, scales: Scales) -> Found:
        """The root near x0."""

    @abc.abstractmethod
    def solve_tangent(self, linear: Function, rhs: Vector) -> Vector:
        """x with linear(x) = rhs, the Jacobian at a root; NaN if it is not found. It may be
        transposed in `rhs`."""


def check_settings(rtol: float | None, atol: float, max_steps: int) -> None:
    """Refuse settings by which no iteration could stop, with a `ValueError`."""
    if isinstance(max_steps, bool) or not isinstance(max_steps, int):
        raise ValueError(f"max_steps must be an integer of at least 1, got {max_steps!r}.")
    if max_steps < 1:
        raise ValueError(f"max_steps must be at least 1, got {max_steps}.")
    for name, value in (("rtol", rtol), ("atol", atol)):
        if value is not None and not (isinstance(value, Real) and 0 <= value < float("inf")):
            raise ValueError(f"{name} must be a finite number, not negative, got {value!r}.")
    if rtol == 0 and atol == 0:
        raise ValueError("rtol and atol are both zero: no iteration could ever stop.")


class Newton(RootSolver):
    """Newton's method, x ← x − (∂F/∂x)⁻¹ F(x), its Jacobian by autodiff in each iteration.

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
        check_settings(self.rtol, self.atol, self.max_steps)

    def solve(self, F, x0, scales):
        known, eps = scales.known, jnp.finfo(x0.dtype).eps
        rtol = 4096 * eps if self.rtol is None else self.rtol

        def proceed(state: _Iterate):
            return ~state.converged & state.finite & (state.iterations < self.max_steps)

        def improve(state: _Iterate):
            value, jacobian = value_and_jacobian(F, state.x)
            correction = lanewise.solve(jacobian, value)
            x = state.x - correction
            error, scale = jnp.abs(correction), jnp.maximum(known, jnp.abs(x))
            settled = jnp.all(error <= rtol * scale + self.atol)
            # A component that is all round-off of the others never settles by its own measure: it
            # is enough that it is small beside them and shrinks no more.
            relative = largest(error / jnp.where(scale > 0, scale, 1))
            small = largest(error) <= rtol * largest(scale) + self.atol
            stalled = small & (relative >= 0.5 * state.relative)
            finite = jnp.all(jnp.isfinite(correction))
            return _Iterate(x, relative, finite, settled | stalled, state.iterations + 1)

        no = jnp.asarray(False)
        unknown = jnp.full((), jnp.nan, x0.dtype)  # no comparison with it is true
        start = _Iterate(x0, unknown, ~no, no, jnp.asarray(0, jnp.int32))
        end = lax.while_loop(proceed, improve, start)
        return Found(end.x, end.iterations, end.relative, end.converged & end.finite)

    def solve_tangent(self, linear, rhs):
        _, matrix = value_and_jacobian(linear, jnp.zeros_like(rhs))
        return lanewise.solve(matrix, rhs)


class Known(eqx.Module):
    """A root that is known already: nothing is solved for but its derivative, as by `solver`."""

    root: Vector
    solver: RootSolver = Newton()


class RootInfo(NamedTuple):
    """How a solve went: iterations made, the largest relative correction of the last of them, and
    whether it has converged."""

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
    function: Function,
    guess: Vector,
    known: Vector,
    solver: RootSolver | Known,
    start: Vector | None = None,
) -> tuple[Vector, RootInfo]:
    """Root x of function(x) = 0 near `guess`, and how it was found.

    The derivative of x with respect to anything that `function` closes over is that of the
    implicit function theorem, dx = −(∂F/∂x)⁻¹ dF, in forward and reverse mode and to any
    order: the iteration itself is never differentiated. `known` and `start` (`known` if left out)
    set the scales for the tolerances beside x itself, see `Scales`.
    """
    known = lax.stop_gradient(jnp.abs(known))
    start = known if start is None else lax.stop_gradient(jnp.abs(start))
    scales = Scales(known, start)
    used = solver.solver if isinstance(solver, Known) else solver

    # custom_root gives its auxiliary outputs tangents of the same type, so no integers among them.
    def solve(F, x0):
        zero = jnp.zeros((), x0.dtype)
        if isinstance(solver, Known):
            return solver.root, (zero, zero, zero + 1)
        x, *how = used.solve(F, x0, scales)
        return x, tuple(jnp.asarray(a, x0.dtype) for a in how)

    root, aux = lax.custom_root(function, guess, solve, used.solve_tangent, has_aux=True)
    iterations, residual, converged = map(lax.stop_gradient, aux)
    return root, RootInfo(iterations.astype(jnp.int32), residual, converged > 0)


def value_and_jacobian(F: Function, x: Vector) -> tuple[Vector, Array]:
    value, push = jax.linearize(F, x)
    return value, jax.vmap(push, out_axes=1)(lanewise.unit_vectors(x.shape[0], x.dtype))


def largest(x: Vector) -> Float[Array, ""]:
    return jnp.max(jnp.abs(x), initial=0.0)


def over(size: Float[Array, ""], scale: Float[Array, ""]) -> Float[Array, ""]:
    """size / scale, or size itself where there is no scale."""
    return jnp.where(scale > 0, size / jnp.where(scale > 0, scale, 1), size)
