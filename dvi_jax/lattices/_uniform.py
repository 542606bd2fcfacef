"""Equal steps."""

import math

import jax.numpy as jnp

from ..base.types import Interval
from ._base import StepSizes


class Uniform(StepSizes):
    """The uniform time grid t_k = t0 + k h. h < 0 runs backwards in time."""

    def steps_to(self, t0, h, num_steps, t1, duration):
        values = {"num_steps": num_steps, "t1": t1, "duration": duration}
        names = [name for name, value in values.items() if value is not None]
        if len(names) > 1:
            text = ", ".join(f"{name}={values[name]!r}" for name in names)
            raise ValueError(f"only one of num_steps, t1 and duration can be given, got {text}.")
        name, span = ("duration", "duration") if t1 is None else ("t1", "t1 − t0")
        arguments = f"h={h!r}, {name}={values[name]!r}" + ("" if t1 is None else f", t0={t0!r}")
        if h is None:
            raise TypeError(f"h must be given with {name}: it determines the number of steps.")
        try:
            length = float(duration) if t1 is None else float(t1) - float(t0)
            # h = 0 has its own message later.
            steps = length / (float(h) or 1.0)
        except TypeError:
            raise TypeError(
                f"{span} and h must be numbers that are not traced, got {arguments}. Under "
                "jax.jit or jax.vmap give num_steps."
            ) from None
        count = round(steps) if math.isfinite(steps) else -1
        if count < 0:
            raise ValueError(
                f"{span} and h must be finite and have the same sign, got {arguments}."
            )
        # (t1 − t0)/h has round-off, which is not a remaining part of a step.
        if abs(steps - count) > 1e-9 * max(1, count):
            raise ValueError(
                f"{span} must be a whole multiple of h, got {arguments}. Use "
                f"h={length / max(1, count):.12g}, num_steps=..., or dvi.Save(ts=[...])."
            )
        return count

    def interval(self, t0, h, k):
        # From k, not as a running sum: times carry no accumulated round-off.
        k = jnp.asarray(k, h.dtype)
        return Interval(t0 + k * h, t0 + (k + 1) * h, h)
