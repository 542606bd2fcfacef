"""Equal steps."""

import math

import jax.numpy as jnp

from ..base.types import Interval
from ._base import StepSizes


class Uniform(StepSizes):
    """The uniform time grid t_k = t0 + k h. h < 0 runs backwards in time."""

    def steps_to(self, t0, h, num_steps, t1, duration):
        given = {"num_steps": num_steps, "t1": t1, "duration": duration}
        names = [name for name, value in given.items() if value is not None]
        if len(names) > 1:
            got = ", ".join(f"{name}={given[name]!r}" for name in names)
            raise ValueError(
                f"only one of num_steps, t1 and duration can be given, got {got}. Keep one of them "
                "and leave out the others."
            )
        name, span = ("duration", "duration") if t1 is None else ("t1", "t1 − t0")
        seen = f"h={h!r}, {name}={given[name]!r}" + ("" if t1 is None else f", t0={t0!r}")
        if h is None:
            raise TypeError(
                f"h must be given with {name}, because h determines the number of steps."
            )
        try:
            length = float(duration) if t1 is None else float(t1) - float(t0)
            # h = 0 has its own message later.
            steps = length / (float(h) or 1.0)
        except TypeError:
            raise TypeError(
                f"{span} and h must be numbers that are not traced, because they determine the "
                f"number of steps; got {seen}. Under jax.jit, jax.vmap or jax.grad with respect to "
                f"one of them give num_steps in place of {name}."
            ) from None
        count = round(steps) if math.isfinite(steps) else -1
        if count < 0:
            raise ValueError(
                f"{span} and h must be finite and have the same sign, got {seen}. For a run "
                "forwards in time both are positive; for a run backwards both are negative."
            )
        # (t1 − t0)/h has round-off, which is not a remaining part of a step.
        if abs(steps - count) > 1e-9 * max(1, count):
            raise ValueError(
                f"{span} must be a whole multiple of h, got {seen}. Use "
                f"h={length / max(1, count):.12g}, or give num_steps in place of {name}. For "
                "states at times between two steps use save=dvi.Save(ts=[...])."
            )
        return count

    def interval(self, t0, h, k):
        # From k, not as a running sum: times carry no accumulated round-off.
        k = jnp.asarray(k, h.dtype)
        return Interval(t0 + k * h, t0 + (k + 1) * h, h)
