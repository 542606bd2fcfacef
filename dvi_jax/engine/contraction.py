"""Iterations that converge linearly, to round-off: when to stop, and when to give up."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .newton import Found, Scales, Vector, largest, over


class _Verdict(NamedTuple):
    """Whether an iterate is good, whether the next may be, and the error that is left."""

    good: Bool[Array, ""]
    promising: Bool[Array, ""]
    error: Float[Array, ""]


def _verdict(
    last: Vector, before: Vector, scale: Vector, rtol: float | None, atol: float, slowest: float
) -> _Verdict:
    """On an iterate, by the sizes of its last correction δ_k and of the one before, δ_{k−1}.

    If a component shrinks by θ = δ_k / δ_{k−1} from one correction to the next, those that are
    not made any more add up to δ_k θ/(1 − θ). A component is good once that is below `rtol` of its
    scale, or the correction itself is; or if it is nothing but round-off, which is small and does
    not go on shrinking.
    """
    eps = float(jnp.finfo(last.dtype).eps)
    allowed = (eps / 16 if rtol is None else rtol) * scale + atol
    shrinks = last < before
    rest = last * (last / jnp.where(shrinks, before - last, 1))
    error = jnp.minimum(last, jnp.where(shrinks, rest, jnp.inf))
    settled = (last <= allowed) | (error <= allowed)
    round_off = (last <= 4 * eps * scale) & (last >= 0.5 * before)
    of_others = (last <= 64 * eps * scale + 4 * eps * largest(scale)) & (last >= before)
    slow = (last > slowest * before) & (last > 64 * eps * scale + atol)
    return _Verdict(jnp.all(settled | round_off | of_others), ~jnp.any(slow), largest(error))


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

    That is after `max_steps`, for a number that is not finite, or once a correction of a component
    is larger than `slowest` times the one before. Of the residual, near the error where the
    Jacobian is near the identity, an estimate is given.
    """

    def proceed(state):
        *_, found, goes_on = state
        return ~found.converged & goes_on & (found.iterations < max_steps)

    def improve(state):
        before, found, _ = state
        step = correction(found.x)
        x, last = found.x - step, jnp.abs(step)
        scale = jnp.maximum(scales.start, jnp.abs(x))
        good, promising, error = _verdict(last, before, scale, rtol, atol, slowest)
        goes_on = promising & jnp.isfinite(largest(last))
        residual = over(error, largest(scale))
        return last, Found(x, found.iterations + 1, residual, good), goes_on

    no = jnp.asarray(False)
    unknown = jnp.full_like(x0, jnp.nan)  # no comparison with it is true
    start = Found(x0, jnp.asarray(0, jnp.int32), unknown[0], no)
    _, found, _ = lax.while_loop(proceed, improve, (unknown, start, ~no))
    return found


def contract_on_trust(
    correction: Callable[[Vector], Vector],
    x0: Vector,
    scales: Scales,
    rtol: float | None,
    atol: float,
    iterations: Int[Array, ""],
) -> tuple[Vector, Float[Array, ""]]:
    """x after so many of these iterations, and −1 if it is good, else 1."""

    def improve(_, state):
        x, last, _ = state
        step = correction(x)
        return x - step, jnp.abs(step), last

    unknown = jnp.full_like(x0, jnp.nan)
    x, last, before = lax.fori_loop(0, iterations, improve, (x0, unknown, unknown))
    scale = jnp.maximum(scales.start, jnp.abs(x))
    good = _verdict(last, before, scale, rtol, atol, float("inf")).good
    return x, jnp.where(good, -1.0, 1.0).astype(x.dtype)


def linear_iterations(effort: Int[Array, ""]) -> Int[Array, ""]:
    """2, 3, 6, 12, 24 iterations for an effort of 2, 3, 4, 5, 6."""
    return jnp.maximum((3 << (effort - 2)) >> 1, 2)
