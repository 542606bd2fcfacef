"""Roots of small systems of equations: what solvers have in common, and Newton's method."""

import abc
import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Inexact, Int

import lanewise

from .._checks import positive, whole

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
    """What a solver gives: x, the iterations made, the largest component of the last correction and
    the scale that it is measured by, and whether the iteration has converged."""

    x: Vector
    iterations: Int[Array, ""]
    residual: Float[Array, "2"]
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
    whole("max_steps", max_steps)
    for name, value in (("rtol", rtol), ("atol", atol)):
        if value is not None:
            positive(name, value, zero=True)
    if rtol == 0 and atol == 0:
        raise ValueError("rtol and atol are both zero: no iteration could ever stop.")


class Newton(RootSolver):
    """Newton's method with several corrections for each Jacobian J = ∂F/∂x(x), which autodiff
    gives: two, and a third where two are not enough (up to 16 unknowns),

        x ← x − J⁻¹ F(x),    x ← x − J⁻¹ F(x),    (x ← x − J⁻¹ F(x)).

    The last two of them, δ and δ', show how fast they shrink, by |δ'|/|δ|. The iteration stops once
    δ' times that factor is below round-off in each component, relative to the larger of its known
    and unknown value; or, for components that are nothing but round-off of larger ones, once they
    are as small as the round-off of those and shrink no more. So the root is accurate to round-off
    also where J is not the derivative of F; the iteration then takes longer. Convergence is of
    order 3 or 4.

    **Arguments**

    - `rtol`: relative tolerance of the last correction; None means the rule above.
    - `atol`: absolute tolerance [unit of the unknown].
    - `max_steps`: Jacobians after which the status becomes `not_converged`.

    **Raises** `ValueError` for tolerances that are negative or both zero, or fewer than one step.

    **Source** Traub 1964, *Iterative Methods for the Solution of Equations* (one Jacobian for
    several corrections); the rule for stopping is our own.
    """

    rtol: float | None = eqx.field(static=True, default=None)
    atol: float = eqx.field(static=True, default=0.0)
    max_steps: int = eqx.field(static=True, default=20)

    def __check_init__(self):
        check_settings(self.rtol, self.atol, self.max_steps)

    def solve(self, F, x0, scales):
        known, eps = scales.known, float(jnp.finfo(x0.dtype).eps)
        tiny = float(jnp.finfo(x0.dtype).tiny)

        def proceed(state: _Iterate):
            return ~state.converged & state.finite & (state.iterations < self.max_steps)

        def corrected(x):
            """x after two corrections with one Jacobian, or three where two are not enough; the
            last is left out where it is larger than the one before. The size of each component of
            the last, its scale, and the largest of the one before and of the last."""
            value, jacobian = value_and_jacobian(F, x)
            first = lanewise.solve(jacobian, value)
            x = x - first
            second = lanewise.solve(jacobian, F(x))
            before, worst = _largest_of(jnp.abs(first)), _largest_of(jnp.abs(second))
            scale = _larger(known, jnp.abs(x))
            shrinks = worst < before
            left = shrinks & (worst * worst > eps / 16 * before * _least_of(scale))

            def another():
                nearer = jnp.where(left, x - second, x)
                last = jnp.where(left, lanewise.solve(jacobian, F(nearer)), second)
                return nearer, last, jnp.where(left, worst, before)

            last = second
            if x0.size <= _THIRD_UP_TO:
                asked = lanewise.on_any(left, rare=x0.size > _FIRST_APART)
                x, last, before = lax.cond(asked, another, lambda: (x, second, before))
            worst = _largest_of(jnp.abs(last))
            x = jnp.where(worst > before, x, x - last)
            return x, jnp.abs(last), _larger(known, jnp.abs(x)), before, worst

        def is_root(second, scale, before, worst):
            if by_rate:
                # With one Jacobian corrections shrink linearly, and have been seen to, by a factor
                # of worst/before: what is left is that much of the last one.
                bound = (eps / 16 * before) * scale
                in_range = (bound > tiny) & (bound < jnp.inf)  # else the products say nothing
                left = in_range & (second * worst <= bound)
                settled = jnp.all(left | (second <= 4 * eps * scale))
            else:
                settled = jnp.all(second <= (self.rtol or 0.0) * scale + self.atol)
            return settled

        def improve(state: _Iterate):
            x, second, scale, before, worst = corrected(state.x)
            settled, size = is_root(second, scale, before, worst), _largest_of(scale)
            # A component that is all round-off of the others never settles by its own measure: it
            # is enough that it is small beside them and shrinks no more.
            rtol = 4096 * eps if by_rate else self.rtol or 0.0
            small = worst <= rtol * size + self.atol
            stalled = small & ((worst >= 0.5 * before) | (worst >= 0.5 * state.error[0]))
            finite = jnp.all(jnp.isfinite(second))
            error = jnp.stack([worst, size])
            return _Iterate(x, error, finite, settled | stalled, state.iterations + 1)

        by_rate = self.rtol is None and self.atol == 0
        yes, unknown = jnp.asarray(True), jnp.full((2,), jnp.nan, x0.dtype)
        start = _Iterate(x0, unknown, yes, ~yes, jnp.asarray(0, jnp.int32))
        if x0.size <= _FIRST_APART:
            # Nearly all steps need one Jacobian: the first turn is made in front of the loop, where
            # no trajectory waits for another.
            x, second, scale, before, worst = corrected(x0)
            error = jnp.stack([worst, _largest_of(scale)])
            settled = is_root(second, scale, before, worst)
            start = _Iterate(x, error, yes, settled, jnp.asarray(1, jnp.int32))
        end = lax.while_loop(proceed, improve, start)
        return Found(end.x, end.iterations, end.error, end.converged & end.finite)

    def solve_tangent(self, linear, rhs):
        _, matrix = value_and_jacobian(linear, jnp.zeros_like(rhs))
        return lanewise.solve(matrix, rhs)


_FIRST_APART = 4
"""Unknowns up to which the first turn of Newton's loop is written out in front of it."""


_THIRD_UP_TO = 16
"""Unknowns up to which a third correction is made; of larger systems a second Jacobian is rare."""


class Known(eqx.Module):
    """A root that is known already: nothing is solved for but its derivative, as by `solver`."""

    root: Vector
    solver: RootSolver = Newton()


class RootInfo(NamedTuple):
    """How a solve went: iterations made, the largest component of the last correction and the scale
    that it is measured by, and whether the iteration has converged."""

    iterations: Int[Array, ""]
    residual: Float[Array, "2"]
    converged: Bool[Array, ""]


class _Iterate(NamedTuple):
    """x after some iterations, the last correction's largest component and its scale, verdicts."""

    x: Vector
    error: Float[Array, "2"]
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

    def solve(F, x0):
        if isinstance(solver, Known):
            nothing = jnp.zeros(2, x0.dtype)
            return solver.root, (jnp.int32(1), nothing, jnp.asarray(True))
        x, *how = used.solve(F, x0, scales)
        return x, how

    root, how = lanewise.implicit_root(function, guess, solve, used.solve_tangent)
    return root, RootInfo(*how)


def value_and_jacobian(F: Function, x: Vector) -> tuple[Vector, Array]:
    value, push = jax.linearize(F, x)
    return value, jax.vmap(push, out_axes=1)(lanewise.unit_vectors(x.shape[0], x.dtype))


def largest(x: Vector) -> Float[Array, ""]:
    return jnp.max(jnp.abs(x), initial=0.0)


def _largest_of(x: Vector) -> Float[Array, ""]:
    """The largest of numbers that are not negative; a NaN among them may be left out."""
    if x.size > 16:
        return jnp.max(x, initial=0.0)
    return functools.reduce(lambda a, b: jnp.where(a > b, a, b), [x[i] for i in range(x.size)])


def _least_of(x: Vector) -> Float[Array, ""]:
    if x.size > 16:
        return jnp.min(x)
    return functools.reduce(lambda a, b: jnp.where(a < b, a, b), [x[i] for i in range(x.size)])


def _larger(a: Vector, b: Vector) -> Vector:
    return jnp.where(a > b, a, b)


def worse(
    a: Float[Array, "2"], b: Float[Array, "2"], counts: Bool[Array, ""] | bool = True
) -> Float[Array, "2"]:
    """The larger of two quotients, each given as (numerator, denominator); a, if b is NaN or does
    not count."""
    return jnp.where(counts & (b[0] * a[1] > a[0] * b[1]), b, a)


def no_residual(dtype) -> Float[Array, "2"]:
    """The quotient 0 that `worse` begins with."""
    return jnp.asarray([0.0, 1.0], dtype)


def over(size: Float[Array, ""], scale: Float[Array, ""]) -> Float[Array, ""]:
    """size / scale, or size itself where there is no scale."""
    return jnp.where(scale > 0, size / jnp.where(scale > 0, scale, 1), size)
