"""How gradients flow back through the scan over the steps."""

import abc
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax


class AbstractAdjoint(eqx.Module):
    """Base of the ways to differentiate a trajectory. All of them give the same derivative,
    that of the discrete map, to round-off; they differ in memory and time."""

    @abc.abstractmethod
    def loop(self, body: Callable, carry: Any, xs: Any) -> tuple[Any, Any]:
        """A scan of `body` over `xs`, differentiable in this adjoint's way."""


class Direct(AbstractAdjoint):
    """Forward and reverse mode straight through the scan.

    Reverse mode stores what each step needs: memory grows with num_steps; fastest for short runs.
    """

    def loop(self, body, carry, xs):
        return lax.scan(body, carry, xs)


class Checkpointed(AbstractAdjoint):
    """Reverse mode with recomputation: memory grows as √num_steps, for one more forward pass.

    - `segments`: pieces that a scan is cut into; None means about √(number of steps).

    Forward mode costs what it costs with `Direct`.
    """

    segments: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.segments is not None and (not isinstance(self.segments, int) or self.segments < 1):
            raise ValueError(f"segments must be a positive integer, got {self.segments!r}.")

    def loop(self, body, carry, xs):
        length = len(jax.tree.leaves(xs)[0])
        segments = self.segments or math.isqrt(length)
        size = length // max(segments, 1)
        if size < 2:
            return lax.scan(body, carry, xs)

        @jax.checkpoint
        def segment(carry, xs):
            return lax.scan(body, carry, xs)

        whole = size * segments
        head = jax.tree.map(lambda x: x[:whole].reshape(segments, size, *x.shape[1:]), xs)
        carry, ys = lax.scan(segment, carry, head)
        ys = jax.tree.map(lambda y: y.reshape(whole, *y.shape[2:]), ys)
        if whole < length:
            carry, rest = segment(carry, jax.tree.map(lambda x: x[whole:], xs))
            ys = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), ys, rest)
        return carry, ys
