"""Equal steps."""

import math

import jax.numpy as jnp

from ..base.checks import only_one, require
from ..base.types import Interval
from ._base import StepSizes


class Uniform(StepSizes):
    """The uniform time grid t_k = t0 + k h. h < 0 runs backwards in time."""

    def steps_to(self, t0, h, num_steps, t1, duration):
        only_one(num_steps=num_steps, t1=t1, duration=duration)
        span = "duration" if t1 is None else "t1 − t0"
        texts = f"h={h!r}, "
        texts += f"duration={duration!r}" if t1 is None else f"t1={t1!r}, t0={t0!r}"
        require("duration" if t1 is None else "t1", {"h": h})
        try:
            # A sum first: float() alone would accept text.
            length = float(0.0 + duration) if t1 is None else float(0.0 + t1) - float(0.0 + t0)
            # h = 0 has its own message later.
            steps = length / (float(0.0 + h) or 1.0)
        except TypeError:
            raise TypeError(
                f"{span} and h must be numbers that are not traced, got {texts}: give num_steps."
            ) from None
        count = round(steps) if math.isfinite(steps) else -1
        if count < 0:
            raise ValueError(f"{span} and h must be finite and have the same sign, got {texts}.")
        # (t1 − t0)/h has round-off, which is not a remaining part of a step.
        if abs(steps - count) > 1e-9 * max(1, count):
            raise ValueError(
                f"{span} must be a whole multiple of h, got {texts}. Use "
                f"h={length / max(1, count):.12g} or num_steps."
            )
        return count

    def interval(self, t0, h, k):
        # From k, not as a running sum: times carry no accumulated round-off.
        k = jnp.asarray(k, h.dtype)
        return Interval(t0 + k * h, t0 + (k + 1) * h, h)
