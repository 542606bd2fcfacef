"""Steps between times that the user gives."""

from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import in_order
from ..base.inputs import as_times
from ..base.types import Interval
from ._base import Lattice, check_num_steps


class Given(Lattice):
    """The time grid with the given times t_0, t_1, …, t_N.

    **Arguments**

    - `ts`: times, shape (N+1,), strictly increasing or strictly decreasing; differentiable.

    `integrate` then takes t0, h and num_steps from it, and rejects values that contradict it.

    **Raises** `ValueError` for another shape, fewer than one time, or times that are not finite or
    not strictly monotonic (a traced `ts` gives the status `bad_step_size` instead).
    """

    takes_h = False

    ts: Float[Array, " times"] = eqx.field(converter=partial(as_times, "Given(ts)"))

    def __check_init__(self):
        if not is_traced(self.ts):
            in_order("ts in Given(ts)", self.ts, strictly=True, hint="np.unique(ts) is.")

    def prepare(self, t0, h, num_steps):
        count = self.ts.shape[0] - 1
        t0_is_known = not is_traced(t0) and not is_traced(self.ts)
        contradictions = {
            f"h={h!r}": h is not None,
            f"t0={t0}": t0_is_known and t0 != 0.0 and t0 != self.ts[0],
            f"num_steps={num_steps}": num_steps is not None and check_num_steps(num_steps) != count,
        }
        texts = [text for text, is_so in contradictions.items() if is_so]
        if texts:
            raise ValueError(
                "h, t0 and num_steps must be left out with lattice=Given(ts), whose ts determine "
                f"the {count} steps from t = {self.ts[0]}, got {', '.join(texts)}."
            )
        return self.ts[0], 1.0, count  # any h: the steps do not depend on it

    def interval(self, t0, h, k):
        start, end = self.ts[k], self.ts[k + 1]
        return Interval(start, end, end - start)

    # Known times have been checked in `__check_init__`; of traced ones this becomes the status.
    def is_usable(self, t0, h):
        steps = jnp.diff(self.ts)
        return jnp.all(jnp.isfinite(self.ts)) & (jnp.all(steps > 0) | jnp.all(steps < 0))
