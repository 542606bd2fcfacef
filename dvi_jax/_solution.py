"""What `integrate` returns, and what it is asked to save."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from ._results import RESULTS, status_name
from ._types import State


class Save(eqx.Module):
    """Which states are kept; the start always is.

    - ``Save(every=m)``: the states after m, 2m, 3m, … steps.
    - ``Save(final=True)``: the state after the last step; together with `every`, also when
      num_steps is no multiple of it.
    - ``Save()``: every state.

    **Raises** `ValueError` for an `every` that is not a positive integer.
    """

    every: int | None = eqx.field(static=True, default=None)
    final: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.every is not None and (
            isinstance(self.every, bool) or not isinstance(self.every, int) or self.every < 1
        ):
            raise ValueError(f"Save(every=m) needs a positive integer, got {self.every!r}.")


class Solution(eqx.Module):
    """A computed trajectory.

    - `ts`: saved times, shape (S,); ``ts[0]`` is t0.
    - `qs`, `ps`: saved positions and momenta, shape (S, *q0.shape).
    - `hs`: size of the step that ended at each saved time but the first, shape (S − 1,).
    - `observed`: the pytree given as `observe`; an observable alone becomes its values on the
      steps that ended at ``ts[1:]``, shape (S − 1, …); a reduction becomes one value over all
      steps.
    - `result`: the status, one of `RESULTS`. From the failing step on states and observables
      are NaN.
    - `stats`: `num_steps`; `newton_iterations` (total); `max_residual` (largest relative residual
      of a solve); `failed_step` (number of the failing step from 0, or −1) and
      `failed_residual` (its relative residual, or 0).

    Under `vmap` every field has the batch axis in front.
    """

    ts: Float[Array, "..."]
    qs: State
    ps: State
    hs: Float[Array, "..."]
    observed: Any
    result: RESULTS
    stats: dict[str, Any]

    @property
    def status(self) -> Any:
        """The name of `result`, such as "successful"; an array of names for a batch."""
        return status_name(self.result)
