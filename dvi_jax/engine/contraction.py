"""Iterations that converge linearly, to round-off: when to stop, and when to give up."""

import abc
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .newton import (
    Found,
    Function,
    RootSolver,
    Scales,
    Vector,
    check_settings,
    largest,
    over,
)


class _Verdict(NamedTuple):
    """Of each component: whether it is good, or nothing but round-off; the error that is left."""

    good: Bool[Array, " n"]
    round_off: Bool[Array, " n"]
    error: Float[Array, " n"]


def _verdict(
    x: Vector,
    x0: Vector,
    scales: Scales,
    corrections: tuple[Vector, Vector],
    iterations: Int[Array, ""],
    rtol: float | None,
    atol: float,
) -> _Verdict:
    """On x, after so many iterations from x0, by its last two corrections δ_{k−1}, δ_k.

    If a component shrinks by θ = δ_k / δ_{k−1} from one correction to the next, those that are
    not made any more add up to δ_k θ/(1 − θ). A component is good once that is below `rtol` of its
    scale, or the correction itself is, or turns but a last digit; or if it is nothing but
    round-off, its own or that of larger components: small, and no longer, or soon, shrinking.
    """
    eps = float(jnp.finfo(x.dtype).eps)
    before, last = corrections
    scale = jnp.maximum(scales.start, jnp.abs(x))
    allowed = (eps / 16 if rtol is None else rtol) * scale + atol
    shrinks = last < before
    rest = last * (last / jnp.where(shrinks, before - last, 1))
    error = jnp.minimum(last, jnp.where(shrinks, rest, jnp.inf))
    settled = (error <= allowed) | (last <= eps * scale)
    # As fast as by a factor of 8 an iteration, of which seven go from a thousandth to round-off.
    factor = jnp.exp2(-3.0 * jnp.minimum(iterations - 1, 7)).astype(x.dtype)
    was_fast = last <= factor * jnp.abs(x - x0)
    at_rest = (last <= 4 * eps * scale) & (was_fast | (last >= 0.5 * before))
    round_off = last <= 64 * eps * scale + 4 * eps * largest(scale)
    return _Verdict(settled | at_rest | (round_off & (last >= before)), round_off, error)


def contract(
    correction: Callable[[Vector], Vector],
    x0: Vector,
    scales: Scales,
    rtol: float | None,
    atol: float,
    max_steps: int,
    slowest: float = float("inf"),
) -> Found:
    """x ← x − correction(x) from x0 until it is good to round-off, or is given up.

    That is after `max_steps`, for a number that is not finite, or once a correction, each
    component by its scale, is larger than `slowest` times the one before. Of the residual an
    estimate is given, the error that is left: the Jacobian is near the identity, or divided by.
    """

    def proceed(state):
        *_, found, goes_on = state
        return ~found.converged & goes_on & (found.iterations < max_steps)

    def improve(state):
        before, was_good, found, _ = state
        step = correction(found.x)
        x, last = found.x - step, jnp.abs(step)
        k = found.iterations + 1
        good, round_off, error = _verdict(x, x0, scales, (before, last), k, rtol, atol)
        # Round-off of many components goes up and down, each in its own time: once is enough.
        good = good | (was_good & round_off)
        scale = jnp.maximum(scales.start, jnp.abs(x))
        safe = jnp.where(scale > 0, scale, 1)
        is_slow = largest(last / safe) > slowest * largest(before / safe)
        # Compiled for a batch, the largest of numbers may leave NaN out: no test rests on that.
        slow = (k > 1) & is_slow & jnp.any(~(good | round_off))
        goes_on = jnp.all(jnp.isfinite(last)) & ~slow
        residual = over(largest(error), largest(scale))
        return last, good, Found(x, k, residual, jnp.all(good)), goes_on

    no = jnp.asarray(False)
    unknown = jnp.full_like(x0, jnp.nan)  # no comparison with it is true
    start = Found(x0, jnp.asarray(0, jnp.int32), unknown[0], no)
    state = (unknown, jnp.zeros(x0.shape, bool), start, ~no)
    return lax.while_loop(proceed, improve, state)[2]


class Contraction(RootSolver):
    """Base of the root solvers x ← x − correction(x) that converge linearly."""

    rtol: float | None = eqx.field(static=True, default=None)
    atol: float = eqx.field(static=True, default=0.0)
    max_steps: int = eqx.field(static=True, default=50)

    def __check_init__(self):
        check_settings(self.rtol, self.atol, self.max_steps)

    @abc.abstractmethod
    def correction(self, F: Function, x0: Vector) -> Callable[[Vector], Vector]:
        """x → its correction, all that depends on the guess x0 alone computed now."""

    def solve(self, F, x0, scales):
        correction = self.correction(F, x0)
        return contract(correction, x0, scales, self.rtol, self.atol, self.max_steps)
