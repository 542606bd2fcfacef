"""Steps between times that the user gives."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lanewise.jaxprs.jaxapi import is_traced

from ..base.inputs import as_times
from ..base.types import Interval
from ._base import Lattice, check_num_steps


def _times(ts: Any) -> Array:
    return as_times("Given(ts)", ts)


class Given(Lattice):
    """The time grid with the given times t_0, t_1, …, t_N.

    **Arguments**

    - `ts`: times, shape (N+1,), strictly increasing or strictly decreasing; differentiable.

    `integrate` then takes t0, h and num_steps from it, and rejects values that contradict it.

    **Raises** `ValueError` for another shape, fewer than one time, or times that are not finite or
    not strictly monotonic (a traced `ts` gives the status `bad_step_size` instead).
    """

    takes_h = False

    ts: Float[Array, " times"] = eqx.field(converter=_times)

    def __check_init__(self):
        if self.ts.ndim != 1 or self.ts.shape[0] < 1:
            raise ValueError(
                "ts in Given(ts) must be a one-dimensional array of at least one time, got shape "
                f"{self.ts.shape}."
            )
        if not is_traced(self.ts):
            steps = np.diff(np.asarray(self.ts))
            bad = ~np.isfinite(steps) | (steps * (np.sign(steps[0]) if steps.size else 1) <= 0)
            if not np.isfinite(np.asarray(self.ts)).all() or bad.any():
                k = int(np.argmax(bad)) if bad.any() else 0
                # The first two times as well: they determine the direction.
                pairs = {i: np.asarray(self.ts)[i : i + 2].tolist() for i in (0, k)}
                raise ValueError(
                    "ts in Given(ts) must be finite times in strictly increasing order, or finite "
                    "times in strictly decreasing order; got "
                    f"{' and '.join(f'ts[{i}:{i + 2}] = {pair}' for i, pair in pairs.items())}. "
                    "np.unique(ts) puts finite times in increasing order and removes equal times."
                )

    def prepare(self, t0, h, num_steps):
        available = self.ts.shape[0] - 1
        if h is not None:
            raise ValueError(
                "h must be left out with lattice=Given(ts), because ts determines the steps; got "
                f"h={h!r}."
            )
        if not is_traced(t0) and not is_traced(self.ts) and t0 != 0.0 and t0 != self.ts[0]:
            raise ValueError(
                f"t0 must be left out with Given(ts), or equal ts[0] = {self.ts[0]}; got t0={t0}."
            )
        if num_steps is not None and check_num_steps(num_steps) != available:
            raise ValueError(
                "num_steps must be left out with Given(ts), or equal len(ts) − 1 = "
                f"{available}; got num_steps={num_steps}."
            )
        return self.ts[0], 1.0, available  # any h: the steps do not depend on it

    def interval(self, t0, h, k):
        start, end = self.ts[k], self.ts[k + 1]
        return Interval(start, end, end - start)

    # Known times have been checked in `__check_init__`; of traced ones this becomes the status.
    def is_usable(self, t0, h):
        steps = jnp.diff(self.ts)
        return jnp.all(jnp.isfinite(self.ts)) & (jnp.all(steps > 0) | jnp.all(steps < 0))
