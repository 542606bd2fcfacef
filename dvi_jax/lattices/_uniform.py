"""Equal steps."""

import jax.numpy as jnp

from .._types import Interval
from ._base import StepSizes


class Uniform(StepSizes):
    """The uniform lattice t_k = t0 + k h.

    Times are computed from k, not summed, so they carry no accumulated round-off. h < 0
    runs backwards in time.
    """

    def interval(self, t0, h, k):
        k = jnp.asarray(k, h.dtype)
        return Interval(t0 + k * h, t0 + (k + 1) * h, h)
