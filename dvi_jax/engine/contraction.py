"""Stopping rules of iterations that converge linearly, to round-off."""

import abc
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .newton import Function, RootInfo, RootSolver, Scales, Vector, check_settings, largest


class Contraction(RootSolver):
    """Base of the root solvers x ← x − correction(x) that converge linearly."""

    rtol: float | None = eqx.field(static=True, default=None)
    atol: float = eqx.field(static=True, default=0.0)
    max_steps: int = eqx.field(static=True, default=50)

    def __check_init__(self):
        check_settings(self.rtol, self.atol, self.max_steps)

    @abc.abstractmethod
    def correction(self, F: Function, x0: Vector) -> Callable[[Vector], Vector]:
        """x → its correction. Values that depend on the guess x0 only are computed once, here."""

    def solve(self, F, x0, scales):
        return self.contract(self.correction(F, x0), x0, scales)

    def contract(
        self, correction: Callable[[Vector], Vector], x0: Vector, scales: Scales, slowest=math.inf
    ) -> RootInfo:
        """x ← x − correction(x) from x0 until it is good to round-off, or the iteration is stopped:
        after `max_steps`, for a number that is not finite, or once a correction, relative to the
        scales, exceeds `slowest` times the one state."""

        def proceed(state: _Iterate):
            return ~state.converged & state.goes_on & (state.iterations < self.max_steps)

        def improve(state: _Iterate):
            step = correction(state.x)
            x, last = state.x - step, jnp.abs(step)
            k = state.iterations + 1
            good, round_off, scale = self._verdict(x, x0, scales, state, last, k)
            # Round-off of many components fluctuates: all of them are rarely good in one iteration.
            # A component that was good and is round-off still counts as good.
            good = good | (state.good & round_off)
            goes_on, relative = jnp.all(jnp.isfinite(last)), state.relative
            if slowest < math.inf:
                relative = largest(last / jnp.where(scale > 0, scale, 1))
                # Compiled for a batch, the maximum may ignore NaN: no decision may depend on NaN in
                # it.
                is_slow = relative > slowest * state.relative
                goes_on &= ~((k > 1) & is_slow & jnp.any(~(good | round_off)))
            sizes = (largest(scale), relative, state.largest, largest(last))
            return _Iterate(x, last, good, *sizes, k, jnp.all(good), goes_on)

        no, zero = jnp.asarray(False), jnp.asarray(0, jnp.int32)
        # There is no correction before the first one: every comparison with NaN is false.
        nans, scale = jnp.full_like(x0, jnp.nan), scales.represented_size
        size, none = largest(jnp.maximum(scale, jnp.abs(x0))), jnp.zeros(x0.shape, bool)
        zero_size = jnp.zeros_like(size)
        start = _Iterate(x0, nans, none, size, zero_size, zero_size, zero_size, zero, no, ~no)
        end = lax.while_loop(proceed, improve, start)
        # With corrections that shrink by θ = δ_k / δ_{k−1} the sum of all further ones is
        # δ_k θ/(1 − θ), which is the error of x. It is the residual: the Jacobian is near the
        # identity, or the correction has been divided by it.
        shrinks = end.largest < end.previous
        tail = end.largest / jnp.where(shrinks, end.previous - end.largest, 1)
        error = end.largest * jnp.where(shrinks, jnp.minimum(tail, 1), 1)
        residual = jnp.stack([error, end.size])
        return RootInfo(end.x, end.iterations, residual, end.converged)

    def _verdict(self, x: Vector, x0: Vector, scales: Scales, state: "_Iterate", last, iterations):
        """For each component of x after some iterations from x0: is it good, is it only round-off,
        and its scale, from its last correction and what was known before."""
        finfo, previous = jnp.finfo(x.dtype), state.last
        eps = float(finfo.eps)
        scale = jnp.maximum(scales.represented_size, jnp.abs(x))
        tolerance = (eps / 16 if self.rtol is None else self.rtol) * scale
        if self.atol:
            tolerance += self.atol
        # The error δ_k θ/(1 − θ) is at most the tolerance: as products, for a division takes longer
        # than all the rest. Below the range of normal numbers products say zero_size.
        bound = tolerance * (previous - last)
        is_accurate = (bound > float(finfo.tiny)) & (last * last <= bound)
        if self.rtol is not None or self.atol:
            is_accurate |= last <= tolerance
        # Fast is a factor of 8 in each iteration: seven lead from a thousandth to round-off.
        factor = jnp.exp2(-3.0 * jnp.minimum(iterations - 1, 7)).astype(x.dtype)
        was_fast = last <= factor * jnp.abs(x - x0)
        # A correction of one unit in the last place cannot be improved on.
        at_rest = last <= eps * jnp.where((last >= 0.5 * previous) | was_fast, 4, 1) * scale
        # A small component that is coupled to large ones inherits their round-off. It never settles
        # relative to its own size, and is good once it no longer shrinks.
        round_off = last <= 64 * eps * scale + 4 * eps * state.size
        return is_accurate | at_rest | (round_off & (last >= previous)), round_off, scale


class _Iterate(NamedTuple):
    """The state of the iteration: the last correction, which components were good, the largest
    scale, the largest correction relative to its scale, and the largest of the last two corrections
    each."""

    x: Vector
    last: Vector
    good: Bool[Array, " n"]
    size: Float[Array, ""]
    relative: Float[Array, ""]
    previous: Float[Array, ""]
    largest: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]
    goes_on: Bool[Array, ""]
