"""Streamed reductions of an observable: constant memory, whatever the number of steps."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._types import Scalar


class Reduction(eqx.Module):
    """Base of the reductions of an observable ``f(t0, t1, q0, p0, q1, p1, args)`` → array.

    A subclass says how its memory starts from the first value, how it takes in the next
    one, and what it makes of its memory in the end. `k` counts the steps from 0; the time
    that belongs to a value is t1, the end of its step.
    """

    function: eqx.AbstractVar[Callable[..., Any]]
    has_running_value: ClassVar[bool] = True

    @abc.abstractmethod
    def start(self, value: Array) -> Any:
        """Memory before the first value (`value` only lends its shape and type)."""

    @abc.abstractmethod
    def update(self, memory: Any, k: Array, t: Scalar, value: Array) -> Any:
        """Memory after step k, which ended at time t with this value."""

    @abc.abstractmethod
    def finish(self, memory: Any) -> Any:
        """The reduced value (real arrays), NaN when there was no step."""

    @abc.abstractmethod
    def pull(
        self, memory: Any, cotangent: Any, k: Array, t: Scalar, value: Array
    ) -> tuple[Array, Array]:
        """Cotangents of t and of the value at step k, given that of the reduced value.

        `memory` is the final one: a reversible gradient asks for the steps in any order.
        """


class MaxDrift(Reduction):
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

    function: Callable[..., Any]
    relative: bool = eqx.field(static=True, default=False)

    def start(self, value):
        return value, jnp.full_like(value, jnp.nan), jnp.zeros(value.shape, jnp.int32)

    def update(self, memory, k, t, value):
        first, farthest, at = memory
        first = jnp.where(k == 0, value, first)
        far = value - first
        # Written so that NaN, once seen, stays.
        larger = (jnp.abs(far) > jnp.abs(farthest)) | jnp.isnan(far) | (k == 0)
        return first, jnp.where(larger, far, farthest), jnp.where(larger, k, at)

    def finish(self, memory):
        first, farthest, _ = memory
        return jnp.abs(farthest / first) if self.relative else jnp.abs(farthest)

    def pull(self, memory, cotangent, k, t, value):
        first, farthest, at = memory
        sign = jnp.sign(farthest)
        slope = jnp.where(k == at, sign, 0) - jnp.where(k == 0, sign, 0)
        if self.relative:
            of_first = jnp.abs(farthest) * jnp.sign(first) / first**2
            slope = slope / jnp.abs(first) - jnp.where(k == 0, of_first, 0)
        return jnp.zeros_like(t), cotangent * slope


class Range(Reduction):
    """Largest value minus smallest value: max_k f_k − min_k f_k, elementwise.

    `function`: an observable ``(t0, t1, q0, p0, q1, p1, args)`` → array.
    """

    function: Callable[..., Any]

    def start(self, value):
        nan, at = jnp.full_like(value, jnp.nan), jnp.zeros(value.shape, jnp.int32)
        return nan, nan, at, at

    def update(self, memory, k, t, value):
        low, high, at_low, at_high = memory
        failed = jnp.isnan(low) & (k > 0)
        lower = ((k == 0) | ~(value >= low)) & ~failed
        higher = ((k == 0) | ~(value <= high)) & ~failed
        return (
            jnp.where(lower, value, low),
            jnp.where(higher, value, high),
            jnp.where(lower, k, at_low),
            jnp.where(higher, k, at_high),
        )

    def finish(self, memory):
        return memory[1] - memory[0]

    def pull(self, memory, cotangent, k, t, value):
        _, _, at_low, at_high = memory
        slope = jnp.where(k == at_high, 1.0, 0.0) - jnp.where(k == at_low, 1.0, 0.0)
        return jnp.zeros_like(t), cotangent * slope


class Trend(Reduction):
    """Least-squares slope of f against time [unit of f / unit of time], elementwise.

        Σ (t_k − t̄)(f_k − f̄) / Σ (t_k − t̄)²

    Means and moments are updated together (Welford 1962), so long runs do not cancel. NaN for
    fewer than two steps.

    `function`: an observable ``(t0, t1, q0, p0, q1, p1, args)`` → array.
    """

    function: Callable[..., Any]

    def start(self, value):
        zero = jnp.zeros_like(value)
        return zero, zero, zero, zero

    def update(self, memory, k, t, value):
        mean_t, mean_f, t_t, t_f = memory
        weight = 1 / jnp.asarray(k + 1, value.dtype)
        before = t - mean_t
        mean_t = mean_t + before * weight
        mean_f = mean_f + (value - mean_f) * weight
        return mean_t, mean_f, t_t + before * (t - mean_t), t_f + before * (value - mean_f)

    def finish(self, memory):
        _, _, t_t, t_f = memory
        return t_f / t_t

    def pull(self, memory, cotangent, k, t, value):
        mean_t, mean_f, t_t, t_f = memory
        from_t = (value - mean_f - 2 * (t_f / t_t) * (t - mean_t)) / t_t
        return jnp.sum(cotangent * from_t), cotangent * (t - mean_t) / t_t


class Mean(Reduction):
    """Mean over the steps: (1/N) Σ f_k, elementwise.

    `function`: an observable ``(t0, t1, q0, p0, q1, p1, args)`` → array.
    """

    function: Callable[..., Any]

    def start(self, value):
        return jnp.full_like(value, jnp.nan), jnp.asarray(0, jnp.int32)

    def update(self, memory, k, t, value):
        mean, _ = memory
        mean = jnp.where(k == 0, jnp.zeros_like(mean), mean)
        return mean + (value - mean) * (1 / jnp.asarray(k + 1, value.dtype)), k + 1

    def finish(self, memory):
        return memory[0]

    def pull(self, memory, cotangent, k, t, value):
        return jnp.zeros_like(t), cotangent / jnp.asarray(memory[1], value.dtype)


class Last(Reduction):
    """The value at the last step.

    `function`: an observable ``(t0, t1, q0, p0, q1, p1, args)`` → array.
    """

    function: Callable[..., Any]

    def start(self, value):
        return jnp.full_like(value, jnp.nan), jnp.asarray(0, jnp.int32)

    def update(self, memory, k, t, value):
        return value, k

    def finish(self, memory):
        return memory[0]

    def pull(self, memory, cotangent, k, t, value):
        return jnp.zeros_like(t), jnp.where(k == memory[1], cotangent, 0)


class Running(eqx.Module):
    """The value of a reduction at every save point: over the steps from the start up to there.

    ``dvi.Running(dvi.MEGNO())`` with ``save=dvi.Save(every=m)`` shows how an indicator settles;
    the values have shape (S − 1, …), like those of an observable that stands alone.

    **Arguments** `reduction`: any but a `Section`, which has a row for each crossing already.

    **Raises** `TypeError` for what is no such reduction.
    """

    reduction: Reduction

    def __check_init__(self):
        if not (isinstance(self.reduction, Reduction) and self.reduction.has_running_value):
            raise TypeError(
                "Running takes a reduction with a value at any time, such as dvi.MEGNO() or "
                f"dvi.Mean(f), got {self.reduction!r}."
            )


def is_observable(x: Any) -> bool:
    """Whether x is a leaf of `observe`: a reduction, or a function."""
    return isinstance(x, Reduction | Running) or callable(x)
