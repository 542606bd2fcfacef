"""Equal steps."""

import jax.numpy as jnp

from .._types import Interval
from ._base import Lattice, check_num_steps


class Uniform(Lattice):
    """The uniform lattice t_k = t0 + k h.

    Times are computed from k, not summed, so they carry no accumulated round-off. h < 0
    runs backwards in time.
    """

    def prepare(self, t0, h, num_steps):
        if h is None or num_steps is None:
            missing = " and ".join(n for n, v in (("h", h), ("num_steps", num_steps)) if v is None)
            raise TypeError(f"a uniform lattice needs h and num_steps; {missing} is missing.")
        return t0, h, check_num_steps(num_steps)

    def interval(self, t0, h, k):
        k = jnp.asarray(k, h.dtype)
        return Interval(t0 + k * h, t0 + (k + 1) * h, h)

    def is_usable(self, t0, h):
        return jnp.isfinite(t0) & jnp.isfinite(h) & (h != 0)
