"""Streamed reductions of an observable: constant memory, whatever the number of steps."""

import abc
from collections.abc import Callable
from typing import Any

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

    @abc.abstractmethod
    def start(self, value: Array) -> Any:
        """Memory before the first value (`value` only lends its shape and type)."""

    @abc.abstractmethod
    def update(self, memory: Any, k: Array, t: Scalar, value: Array) -> Any:
        """Memory after step k, which ended at time t with this value."""

    @abc.abstractmethod
    def finish(self, memory: Any) -> Array:
        """The reduced value, NaN when there was no step."""


class MaxDrift(Reduction):
    """Largest distance from the first value: max_k |f_k − f_1|, elementwise."""

    function: Callable[..., Any]

    def start(self, value):
        return value, jnp.full_like(value, jnp.nan)

    def update(self, memory, k, t, value):
        first, drift = memory
        first = jnp.where(k == 0, value, first)
        drift = jnp.where(k == 0, jnp.zeros_like(drift), drift)
        return first, jnp.maximum(drift, jnp.abs(value - first))

    def finish(self, memory):
        return memory[1]


class Range(Reduction):
    """Largest value minus smallest value: max_k f_k − min_k f_k, elementwise."""

    function: Callable[..., Any]

    def start(self, value):
        return jnp.full_like(value, jnp.nan), jnp.full_like(value, jnp.nan)

    def update(self, memory, k, t, value):
        low, high = memory
        low = jnp.where(k == 0, value, jnp.minimum(low, value))
        high = jnp.where(k == 0, value, jnp.maximum(high, value))
        return low, high

    def finish(self, memory):
        return memory[1] - memory[0]


class Trend(Reduction):
    """Least-squares slope of f against time [unit of f / unit of time], elementwise.

        Σ (t_k − t̄)(f_k − f̄) / Σ (t_k − t̄)²

    Means and moments are updated together (Welford), so long runs do not cancel. NaN for
    fewer than two steps.
    """

    function: Callable[..., Any]

    def start(self, value):
        zero = jnp.zeros_like(value)
        return zero, zero, zero, zero

    def update(self, memory, k, t, value):
        mean_t, mean_f, t_t, t_f = memory
        count = jnp.asarray(k + 1, value.dtype)
        before = t - mean_t
        mean_t = mean_t + before / count
        mean_f = mean_f + (value - mean_f) / count
        return mean_t, mean_f, t_t + before * (t - mean_t), t_f + before * (value - mean_f)

    def finish(self, memory):
        _, _, t_t, t_f = memory
        return t_f / t_t


class Mean(Reduction):
    """Mean over the steps: (1/N) Σ f_k, elementwise."""

    function: Callable[..., Any]

    def start(self, value):
        return jnp.full_like(value, jnp.nan)

    def update(self, memory, k, t, value):
        mean = jnp.where(k == 0, jnp.zeros_like(memory), memory)
        return mean + (value - mean) / jnp.asarray(k + 1, value.dtype)

    def finish(self, memory):
        return memory


class Last(Reduction):
    """The value at the last step."""

    function: Callable[..., Any]

    def start(self, value):
        return jnp.full_like(value, jnp.nan)

    def update(self, memory, k, t, value):
        return value

    def finish(self, memory):
        return memory
