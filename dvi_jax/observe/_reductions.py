"""Streamed reductions of an observable: constant memory for any number of steps."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..base.types import Scalar


class Reduction(eqx.Module):
    """Base of the reductions of an observable ``f(t0, t1, q0, p0, q1, p1, args)`` → array.

    A reduction is four functions. `start` makes its memory, `update` adds the value of the next
    step, `finish` makes the result of the memory of all steps, and `combine` says how that memory
    depends on a single step, for gradients by the reversible adjoint. `k` counts the steps from 0;
    the time t of a value is t1, the end of its step.
    """

    function: eqx.AbstractVar[Callable[..., Any]]
    has_running_value: ClassVar[bool] = True
    keeps_integers: ClassVar[bool] = False
    """Whether `update` receives integers and booleans as they are, not as real numbers."""

    @abc.abstractmethod
    def start(self, value: Array) -> Any:
        """Memory before the first value; only the shape and type of `value` matter."""

    @abc.abstractmethod
    def update(self, memory: Any, k: Array, t: Scalar, value: Array) -> Any:
        """Memory after step k, which ended at time t with this value."""

    @abc.abstractmethod
    def finish(self, memory: Any) -> Any:
        """The reduced value (real arrays, or integers as `Last`), NaN when there was no step."""

    def combine(self, memory: Any, k: Array, t: Scalar, value: Array) -> Any:
        """The memory of all steps as a function of t and value of step k, which is one of them.

        It equals `memory`; only its derivative is used. For a sum it is
        ``memory + self.change(value)``, for the value of one step, of number `at`,
        ``memory + self.change(value, k == at)``.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no method combine(memory, k, t, value), as required for "
            "adjoint=dvi.Reversible(): use adjoint=dvi.Checkpointed()."
        )

    @staticmethod
    def change(x: Array, where: Array | None = None) -> Array:
        """Zero with the derivative of x, for `combine`; a constant zero where `where` is false."""
        difference = x - lax.stop_gradient(x)
        return difference if where is None else jnp.where(where, difference, 0)

    def pull(
        self, memory: Any, cotangent: Any, k: Array, t: Scalar, value: Array
    ) -> tuple[Array, Array]:
        """Cotangents of t and of the value at step k for that of the reduced value."""

        # The reversible adjoint visits the steps in another order and rebuilds their values with
        # rounding, so that `update` cannot be differentiated: a maximum would be found elsewhere.
        def value_of_all(t, value):
            # Integers, such as the numbers of steps, have no cotangent.
            result = self.finish(self.combine(memory, k, t, value))
            return eqx.filter(result, eqx.is_inexact_array)

        return jax.vjp(value_of_all, t, value)[1](cotangent)


def no_value(value: Array) -> Array:
    """NaN; for integers the smallest one of the type, for booleans False."""
    if jnp.issubdtype(value.dtype, jnp.inexact):
        return jnp.full_like(value, jnp.nan)
    # They have no NaN; the status of the run says that nothing was computed.
    return jnp.full_like(value, value.dtype != bool and jnp.iinfo(value.dtype).min)


def _difference(a: Array, b: Array) -> Array:
    """a − b; for integers the real number |a − b|, whose digits are not lost before."""
    if jnp.issubdtype(a.dtype, jnp.inexact):
        return a - b
    # Without a sign, no difference of two integers is too large for the type.
    a, b, is_larger = (*(x.astype(f"uint{8 * x.dtype.itemsize}") for x in (a, b)), a >= b)
    return jnp.where(is_larger, a - b, b - a).astype(float)


class _OfFunction(Reduction):
    """A reduction whose only field is its observable."""

    function: Callable[..., Any]


class MaxDrift(_OfFunction):
    """Largest distance from the first value, max_k |f_k − f_0|, elementwise.

    f_0 is the value at the initial state; for a function of a step, that on the first step.

    - `function`: an observable, see `integrate`.
    - `relative`: whether the distance is divided by |f_0|.

    **Example**

    ```python
    kepler = systems.kepler()
    momentum = dvi.MaxDrift(kepler.observables["angular_momentum"])
    sol = dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.1,
                        num_steps=10_000, observe={"L": momentum}, save=dvi.Save(final=True))
    print(sol.observed["L"] < 1e-13)
    # True
    ```
    """

    relative: bool = eqx.field(static=True, default=False)

    keeps_integers: ClassVar[bool] = True

    def start(self, value):
        nan = jnp.full_like(_difference(value, value), jnp.nan)
        return value, nan, jnp.zeros(value.shape, jnp.int32)

    def update(self, memory, k, t, value):
        first, size, step = memory
        first, size = jnp.where(k == 0, value, first), jnp.where(k == 0, 0, size)
        far = _difference(value, first)
        # A comparison with NaN is false, and the sum is NaN with either: NaN, once stored, stays.
        smaller = jnp.abs(far) <= size
        size = jnp.where(smaller, size, jnp.abs(far) + 0 * size)
        # The complement of a number says that the value has decreased.
        return first, size, jnp.where(smaller, step, jnp.where(far < 0, ~k, k))

    def finish(self, memory):
        first, size, _ = memory
        return jnp.abs(size / first) if self.relative else size

    def combine(self, memory, k, t, value):
        first, size, step = memory
        # The number of the step decides: a rebuilt value is the largest one only up to rounding.
        of_first, sign = self.change(value, k == 0), jnp.where(step < 0, -1, 1)
        change = self.change(value, k == jnp.where(step < 0, ~step, step)) - of_first
        return first + of_first, size + sign * change, step


class Range(_OfFunction):
    """Largest minus smallest value of an observable f, max_k f_k − min_k f_k, elementwise."""

    keeps_integers: ClassVar[bool] = True

    def start(self, value):
        nan, step = no_value(value), jnp.full(value.shape, -1, jnp.int32)
        return nan, nan, step, step

    def update(self, memory, k, t, value):
        low, high, at_low, at_high = memory
        is_nan = jnp.isnan(low) & (k > 0)
        # The negations are true for a NaN value, which is stored in this way and then stays.
        lower = ((k == 0) | ~(value >= low)) & ~is_nan
        higher = ((k == 0) | ~(value <= high)) & ~is_nan
        low, high = jnp.where(lower, value, low), jnp.where(higher, value, high)
        return low, high, jnp.where(lower, k, at_low), jnp.where(higher, k, at_high)

    def finish(self, memory):
        low, high, at_low, _ = memory
        return jnp.where(at_low < 0, jnp.nan, _difference(high, low))

    def combine(self, memory, k, t, value):
        low, high, *steps = memory
        low = low + self.change(value, k == steps[0])
        return low, high + self.change(value, k == steps[1]), *steps


class Trend(_OfFunction):
    """Least-squares slope of an observable f against time [unit of f / time], elementwise.

        Σ (t_k − t̄)(f_k − f̄) / Σ (t_k − t̄)²

    Means and moments are updated together (Welford 1962), so that digits do not cancel in long
    runs. NaN for fewer than two steps.
    """

    def start(self, value):
        zero = jnp.zeros_like(value)
        return zero, zero, zero, zero

    def update(self, memory, k, t, value):
        mean_t, mean_f, t_t, t_f = memory
        weight = 1 / jnp.asarray(k + 1, value.dtype)
        deviation = t - mean_t
        mean_t = mean_t + deviation * weight
        mean_f = mean_f + (value - mean_f) * weight
        # One factor with the old mean and one with the new: exact for the sums about the new mean.
        return mean_t, mean_f, t_t + deviation * (t - mean_t), t_f + deviation * (value - mean_f)

    def finish(self, memory):
        _, _, t_t, t_f = memory
        # 0/0 for fewer than two steps, which is the NaN that the docstring promises.
        return t_f / t_t

    def combine(self, memory, k, t, value):
        mean_t, mean_f, t_t, t_f = memory
        dt, df = self.change(t), self.change(value)
        # The means do not contribute: sums of differences from a mean are stationary in it.
        t_f = t_f + (t - mean_t) * df + (value - mean_f) * dt
        return mean_t, mean_f, t_t + 2 * (t - mean_t) * dt, t_f


class _WithCount(_OfFunction):
    """Base of the reductions with a memory of a value and the number of steps."""

    def start(self, value):
        return no_value(value), jnp.asarray(0, jnp.int32)

    def finish(self, memory):
        return memory[0]


class Mean(_WithCount):
    """Mean of an observable f over the steps, (1/N) Σ f_k, elementwise."""

    def update(self, memory, k, t, value):
        mean, _ = memory
        # NaN stands for a mean of no step, and must not stay in that of the first.
        mean = jnp.where(k == 0, jnp.zeros_like(mean), mean)
        return mean + (value - mean) * (1 / jnp.asarray(k + 1, value.dtype)), k + 1

    def combine(self, memory, k, t, value):
        mean, count = memory
        return mean + self.change(value) / jnp.asarray(count, value.dtype), count


class Last(_WithCount):
    """The value of an observable at the last step, of its own type.

    Integers and booleans have no NaN: without a step, the value is the smallest integer of the
    type, or False.
    """

    keeps_integers: ClassVar[bool] = True

    def update(self, memory, k, t, value):
        return value, k

    def combine(self, memory, k, t, value):
        last, step = memory
        return last + self.change(value, k == step), step


class Running(eqx.Module):
    """The values of a reduction at the saved steps, each over all steps before it.

    ``dvi.Running(dvi.MEGNO())`` with ``save=dvi.Save(every=m)`` shows how an indicator converges;
    the values have shape (S − 1, …), like those of an observable without a reduction.

    **Arguments** `reduction`: any but a `Section`, which has a row for each crossing already.

    **Raises** `TypeError` for anything else.
    """

    reduction: Reduction

    def __check_init__(self):
        if not (isinstance(self.reduction, Reduction) and self.reduction.has_running_value):
            description = getattr(self.reduction, "__name__", f"{self.reduction!r:.200}")
            raise TypeError(
                "reduction of Running must be an object such as dvi.Mean(f), not a function or a "
                f"dvi.Section, got {description}."
            )


def is_observable(leaf: Any) -> bool:
    """Whether x is a leaf of `observe`: a reduction, or a function."""
    return isinstance(leaf, Reduction | Running) or callable(leaf)
