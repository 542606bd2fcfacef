"""Equal steps."""

import math

import jax.numpy as jnp

from .._types import Interval
from ._base import StepSizes


class Uniform(StepSizes):
    """The uniform time grid t_k = t0 + k h. h < 0 runs backwards in time."""

    def steps_to(self, t0, h, num_steps, t1, duration):
        given = {"num_steps": num_steps, "t1": t1, "duration": duration}
        names = [name for name, value in given.items() if value is not None]
        if len(names) > 1:
            raise ValueError(f"{' and '.join(names)} cannot be given together: give one of them.")
        try:
            length = float(duration) if t1 is None else float(t1) - float(t0)
            # h = 0 has its own message later.
            steps = length / (float(h) or 1.0)
        except TypeError:
            raise TypeError(
                f"t0, h and {names[0]} must be numbers that are known before compilation, because "
                f"they determine array shapes; got t0={t0!r}, h={h!r}, "
                f"{names[0]}={given[names[0]]!r}. Under jit give num_steps in place of {names[0]}."
            ) from None
        count = round(steps) if math.isfinite(steps) else -1
        if count < 0:
            raise ValueError(
                f"{names[0]}={given[names[0]]!r} cannot be reached from t0={t0!r} with steps of "
                f"h={h!r}. {names[0]} and t0 must be finite. Use h > 0 for a run forwards in time, "
                "h < 0 for a run backwards; a duration has the sign of h."
            )
        # (t1 − t0)/h has round-off, which is not a remaining part of a step.
        if abs(steps - count) > 1e-9 * max(1, count):
            raise ValueError(
                "the number of steps must be a whole number, but "
                f"{names[0]}={given[names[0]]!r} requires {steps:.6g} steps of h={h!r} from "
                f"t0={t0!r}. Use h={length / max(1, count)!r}, "
                f"or give num_steps in place of {names[0]}. For states at times between two steps "
                "use save=dvi.Save(ts=[...])."
            )
        return count

    def interval(self, t0, h, k):
        # From k, not as a running sum: times carry no accumulated round-off.
        k = jnp.asarray(k, h.dtype)
        return Interval(t0 + k * h, t0 + (k + 1) * h, h)
