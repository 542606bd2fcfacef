"""Stopping rules of iterations that converge linearly, to round-off."""

import abc
import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import lax

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
        scales, exceeds `slowest` times the one before."""

        def proceed(state):
            *_, root, goes_on = state
            return ~root.converged & goes_on & (root.iterations < self.max_steps)

        def improve(state):
            previous, was_good, root, _ = state
            step = correction(root.x)
            x, last = root.x - step, jnp.abs(step)
            k = root.iterations + 1
            good, round_off, error = self._verdict(x, x0, scales, (previous, last), k)
            # Round-off of many components fluctuates: all of them are rarely good in one iteration.
            # A component that was good and is round-off still counts as good.
            good = good | (was_good & round_off)
            scale = jnp.maximum(scales.represented_size, jnp.abs(x))
            safe = jnp.where(scale > 0, scale, 1)
            is_slow = largest(last / safe) > slowest * largest(previous / safe)
            # Compiled for a batch, the maximum may ignore NaN: no decision may depend on NaN in it.
            slow = (k > 1) & is_slow & jnp.any(~(good | round_off))
            goes_on = jnp.all(jnp.isfinite(last)) & ~slow
            # The estimated error stands for the residual: the Jacobian is near the identity, or the
            # correction has been divided by it.
            residual = jnp.stack([largest(error), largest(scale)])
            return last, good, RootInfo(x, k, residual, jnp.all(good)), goes_on

        no = jnp.asarray(False)
        # There is no correction before the first one: every comparison with NaN is false.
        nans = jnp.full_like(x0, jnp.nan)
        start = RootInfo(x0, jnp.asarray(0, jnp.int32), jnp.stack([nans[0]] * 2), no)
        state = (nans, jnp.zeros(x0.shape, bool), start, ~no)
        return lax.while_loop(proceed, improve, state)[2]

    def _verdict(self, x: Vector, x0: Vector, scales: Scales, corrections, iterations):
        """For each component of x after some iterations from x0: is it good, is it only round-off,
        and its estimated error, from the last corrections δ_{k−1}, δ_k."""
        eps = float(jnp.finfo(x.dtype).eps)
        previous, last = corrections
        scale = jnp.maximum(scales.represented_size, jnp.abs(x))
        tolerance = (eps / 16 if self.rtol is None else self.rtol) * scale + self.atol
        # With corrections that shrink by θ = δ_k / δ_{k−1} the sum of all further ones is
        # δ_k θ/(1 − θ), which is the error of x.
        shrinks = last < previous
        tail = last * (last / jnp.where(shrinks, previous - last, 1))
        error = jnp.minimum(last, jnp.where(shrinks, tail, jnp.inf))
        # A correction of one unit in the last place cannot be improved on.
        is_accurate = (error <= tolerance) | (last <= eps * scale)
        # Fast is a factor of 8 in each iteration: seven lead from a thousandth to round-off.
        factor = jnp.exp2(-3.0 * jnp.minimum(iterations - 1, 7)).astype(x.dtype)
        was_fast = last <= factor * jnp.abs(x - x0)
        at_rest = (last <= 4 * eps * scale) & (was_fast | (last >= 0.5 * previous))
        # A small component that is coupled to large ones inherits their round-off. It never settles
        # relative to its own size, and is good once it no longer shrinks.
        round_off = last <= 64 * eps * scale + 4 * eps * largest(scale)
        return is_accurate | at_rest | (round_off & (last >= previous)), round_off, error
