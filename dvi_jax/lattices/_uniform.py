"""Equal steps."""

import jax.numpy as jnp

from .._types import Interval
from ._base import StepSizes


class Uniform(StepSizes):
    """The uniform time grid t_k = t0 + k h. h < 0 runs backwards in time."""

    def interval(self, t0, h, k):
        # From k, not as a running sum: times carry no accumulated round-off.
        k = jnp.asarray(k, h.dtype)
        return Interval(t0 + k * h, t0 + (k + 1) * h, h)
