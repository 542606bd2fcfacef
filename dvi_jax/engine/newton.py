"""Roots of small systems of equations: the base of the solvers, and Newton's method."""

import abc
import functools
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Inexact, Int

import lanewise
from lanewise.jaxprs.dependence import depends_on
from lanewise.jaxprs.extent import primitives_in

from ..base.checks import positive, whole

Vector = Inexact[Array, " n"]
Function = Callable[[Vector], Vector]


class Scales(NamedTuple):
    """Scales of the convergence test, per unknown and not negative, next to its own size.

    `size` is that of the value that a step starts from, `represented_size` that of its
    representation. They differ for states relative to an origin only.
    """

    size: Vector
    represented_size: Vector


class RootInfo(NamedTuple):
    """Result of a solver: x, iterations, (largest component of the last correction, its scale), and
    whether the iteration has converged."""

    x: Vector
    iterations: Int[Array, ""]
    # A pair, not their quotient: it is compared without a division, see `worse`.
    residual: Float[Array, "2"]
    converged: Bool[Array, ""]


class RootSolver(eqx.Module):
    """Base class of the root solvers for the equations F(x) = 0 of an implicit step.

    The Jacobian of F tends to the identity as h → 0, and a guess is known. All methods find the
    root to round-off and have the same derivatives, those of the implicit function, to any order;
    they differ in the cost and the number of iterations.
    """

    @abc.abstractmethod
    def solve(self, F: Function, x0: Vector, scales: Scales) -> RootInfo:
        """The root near x0."""

    @abc.abstractmethod
    def solve_tangent(self, linear: Function, rhs: Vector) -> Vector:
        """x with linear(x) = rhs, the Jacobian at a root; NaN if it is not found. It may be
        transposed in `rhs`."""


def check_settings(rtol: float | None, atol: float, max_steps: int) -> None:
    """**Raises** `ValueError` for settings with which no iteration could stop."""
    whole("max_steps", max_steps)
    for name, value in (("rtol", rtol), ("atol", atol)):
        if value is not None:
            positive(name, value, zero=True)
    if rtol == 0 and atol == 0:
        raise ValueError("rtol and atol are both 0: one must be positive.")


class Newton(RootSolver):
    """Newton's method with several corrections for each Jacobian J = ∂F/∂x(x) of autodiff: two, and
    a third where two are not enough (up to 16 unknowns),

        x ← x − J⁻¹ F(x),    x ← x − J⁻¹ F(x),    (x ← x − J⁻¹ F(x)).

    A linear equation, whose J does not depend on x, needs no third one. The ratio |δ'|/|δ| of the
    last two corrections estimates the rate of convergence. The iteration stops once δ' times that
    rate is below round-off in each component, relative to the larger of its known and unknown
    value; or, for components that are only round-off of larger ones, once they are as small as that
    round-off and no longer shrink. So the root is accurate to round-off also where J is not the
    derivative of F; the iteration is then longer. The order is 3 or 4.

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

    is_nested: ClassVar[bool] = False

    def __check_init__(self):
        check_settings(self.rtol, self.atol, self.max_steps)

    def solve(self, F, x0, scales):
        # In a loop in F trajectories of a batch wait for one another in any case.
        waits = self.is_nested or "while" in primitives_in(jax.make_jaxpr(F)(x0).jaxpr)
        # The second correction of a linear equation is round-off already.
        is_linear = not depends_on(lambda x: value_and_jacobian(F, x)[1], 0, x0)
        magnitude, eps = scales.size, float(jnp.finfo(x0.dtype).eps)
        tiny = float(jnp.finfo(x0.dtype).tiny)

        def proceed(state: _Iterate):
            return ~state.converged & state.finite & (state.iterations < self.max_steps)

        def correct(x):
            """(x, |last correction| and its scale per component, maxima of the last two
            corrections) after two corrections with one Jacobian, or three."""
            value, jacobian = value_and_jacobian(F, x)
            first = lanewise.solve(jacobian, value)
            x = x - first
            second = lanewise.solve(jacobian, F(x))
            previous, worst = _largest_of(jnp.abs(first)), _largest_of(jnp.abs(second))
            scale = _larger(magnitude, jnp.abs(x))
            shrinks = worst < previous
            # worst²/previous is the next correction. Only where it would be above round-off is a
            # third evaluation of F worth its time.
            is_large = shrinks & (worst * worst > eps / 16 * previous * _least_of(scale))

            def third():
                nearer = jnp.where(is_large, x - second, x)
                last = jnp.where(is_large, lanewise.solve(jacobian, F(nearer)), second)
                return nearer, last, jnp.where(is_large, worst, previous)

            last = second
            if x0.size <= _THIRD_UP_TO and not is_linear:
                is_needed = lanewise.on_any(is_large, rare=x0.size > _FIRST_APART)
                x, last, previous = lax.cond(is_needed, third, lambda: (x, second, previous))
            worst = _largest_of(jnp.abs(last))
            # A last correction that is larger than the one before is round-off, or divergence.
            x = jnp.where(worst > previous, x, x - last)
            return x, jnp.abs(last), _larger(magnitude, jnp.abs(x)), previous, worst

        def is_root(second, scale, previous, worst):
            if by_rate:
                # With one Jacobian corrections shrink linearly, here by worst/previous: the error
                # is that fraction of the last one. Written as products, since a division by
                # `previous` may be one by zero.
                bound = (eps / 16 * previous) * scale
                # Beyond the range of normal numbers the comparison of products is meaningless.
                in_range = (bound > tiny) & (bound < jnp.inf)
                is_small = in_range & (second * worst <= bound)
                return jnp.all(is_small | (second <= 4 * eps * scale))
            return jnp.all(second <= (self.rtol or 0.0) * scale + self.atol)

        def improve(state: _Iterate):
            x, second, scale, previous, worst = correct(state.x)
            is_accurate, size = is_root(second, scale, previous, worst), _largest_of(scale)
            # A component that is only round-off of the others never settles relative to its own
            # size: it is enough that it is small next to them and no longer shrinks.
            rtol = 4096 * eps if by_rate else self.rtol or 0.0
            small = worst <= rtol * size + self.atol
            is_round_off = small & ((worst >= 0.5 * previous) | (worst >= 0.5 * state.error[0]))
            finite = jnp.all(jnp.isfinite(second))
            error = jnp.stack([worst, size])
            return _Iterate(x, error, finite, is_accurate | is_round_off, state.iterations + 1)

        by_rate = self.rtol is None and self.atol == 0
        yes, nans = jnp.asarray(True), jnp.full((2,), jnp.nan, x0.dtype)
        start = _Iterate(x0, nans, yes, ~yes, jnp.asarray(0, jnp.int32))
        if x0.size <= _FIRST_APART and not waits:
            # Nearly all steps need one Jacobian: the first iteration is in front of the loop, where
            # no trajectory of a batch waits for another.
            x, second, scale, previous_first, worst = correct(x0)
            error = jnp.stack([worst, _largest_of(scale)])
            is_accurate = is_root(second, scale, previous_first, worst)
            start = _Iterate(x, error, yes, is_accurate, jnp.asarray(1, jnp.int32))
        end = lax.while_loop(proceed, improve, start)
        return RootInfo(end.x, end.iterations, end.error, end.converged & end.finite)

    def solve_tangent(self, linear, rhs):
        return lanewise.solve(value_and_jacobian(linear, jnp.zeros_like(rhs))[1], rhs)


class NestedNewton(Newton):
    """Newton's method in an equation of a step, which has a loop around it."""

    is_nested: ClassVar[bool] = True


_FIRST_APART = 4
"""Unknowns up to which the first iteration is written out in front of Newton's loop. For larger
systems the second copy of the elimination would double the code to compile."""

_THIRD_UP_TO = 16
"""Unknowns up to which a third correction is made; larger systems rarely need a second Jacobian."""


class KnownRoot(RootSolver):
    """A root that is already known: only its derivative is solved for, by `solver`."""

    root: Vector
    solver: RootSolver = Newton()

    def solve(self, F, x0, scales):
        return RootInfo(self.root, jnp.int32(1), jnp.zeros(2, x0.dtype), jnp.asarray(True))

    def solve_tangent(self, linear, rhs):
        return self.solver.solve_tangent(linear, rhs)


class _Iterate(NamedTuple):
    """The state of Newton's loop; `error` is as `RootInfo.residual`."""

    x: Vector
    error: Float[Array, "2"]
    finite: Bool[Array, ""]
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]


def find_root(
    function: Function, guess: Vector, size: Vector, solver: RootSolver, represented_size=None
) -> tuple[Vector, RootInfo]:
    """Root x of function(x) = 0 near `guess`, and how it was found.

    The derivative of x with respect to values that `function` closes over is that of the implicit
    function theorem, dx = −(∂F/∂x)⁻¹ dF, in forward and reverse mode and to any order. `size` and
    `represented_size` (`size` if left out) are the `Scales` of the tolerances.
    """
    # Scales decide when to stop, and no iteration is differentiated: no derivative of theirs.
    scales = Scales(size, size if represented_size is None else represented_size)
    scales = jax.tree.map(lambda x: lax.stop_gradient(jnp.abs(x)), scales)

    def solve(F, x0):
        x, *statistics = solver.solve(F, x0, scales)
        return x, statistics

    root, statistics = lanewise.implicit_root(function, guess, solve, solver.solve_tangent)
    return root, RootInfo(root, *statistics)


def value_and_jacobian(F: Function, x: Vector) -> tuple[Vector, Array]:
    value, push = jax.linearize(F, x)
    # Not jnp.eye: machine code uses the structural zeros, and a banded Jacobian stays banded.
    return value, jax.vmap(push, out_axes=1)(lanewise.unit_vectors(x.shape[0], x.dtype))


def largest(x: Vector) -> Float[Array, ""]:
    return jnp.max(jnp.abs(x), initial=0.0)


# For few numbers a chain of comparisons, which is faster in generated code than a reduction. A NaN
# among them may be ignored, so that no decision rests on one.
def _largest_of(x: Vector) -> Float[Array, ""]:
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
    """The larger of two quotients (numerator, denominator); a if b is NaN or does not count."""
    # Cross-multiplied: one division at the end of a run in place of one in every step.
    return jnp.where(counts & (b[0] * a[1] > a[0] * b[1]), b, a)


def no_residual(dtype) -> Float[Array, "2"]:
    """The quotient 0, the initial value for `worse`."""
    return jnp.asarray([0.0, 1.0], dtype)


def relative_size(size: Float[Array, ""], scale: Float[Array, ""]) -> Float[Array, ""]:
    """size / scale, or size itself where the scale is zero."""
    # The inner `where` keeps the derivative finite: 0/0 in the branch not taken would give NaN.
    return jnp.where(scale > 0, size / jnp.where(scale > 0, scale, 1), size)
