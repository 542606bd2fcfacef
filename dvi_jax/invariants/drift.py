"""The order in ε to which something is conserved, measured."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._integrate import integrate
from .._results import RESULTS
from .._solution import Save
from .._system import System
from .._types import Args
from ..methods import Method, TypeII
from ..observe import MaxDrift, Mean


class DriftOrder(NamedTuple):
    """The measured order in ε of a drift.

    - `epsilons`, `drifts`: shape (E,). `floor`: the drift at ε = 0, by mesh and round-off.
    - `used`: which points the fit takes: those at least ten times above the floor.
    - `slope`, `stderr`: d log(drift) / d log(ε) and its standard error; NaN with fewer than
      two points (slope) or three (stderr).
    - `successful`: which trajectories did not fail.
    """

    epsilons: np.ndarray
    drifts: np.ndarray
    floor: float
    used: np.ndarray
    slope: float
    stderr: float
    successful: np.ndarray

    @property
    def interval(self) -> tuple[float, float]:
        """About 95 % confidence: slope ± 2 stderr."""
        return self.slope - 2 * self.stderr, self.slope + 2 * self.stderr


def drift_order(
    system: System,
    invariant: Callable[..., Any],
    q0: Any,
    p0: Any,
    *,
    epsilons: Any,
    h: Any,
    num_steps: int,
    t0: float = 0.0,
    args: Args = None,
    method: Method = TypeII(),
) -> DriftOrder:
    r"""The exponent of ε in the largest drift of a scalar along trajectories.

        max_k |I_ε(k) − I_ε(1)| ∝ ε^slope      (z + 1 for an invariant of order z)

    One batched sweep over ε, reduced on the device; the same run at ε = 0 gives the floor.

    **Arguments**

    - `invariant`: an observable: a function of one step, an `InvariantSeries`, an
      `AdiabaticInvariant`.
    - `q0`, `p0`, `h`, `num_steps`, `t0`, `args`, `method`: as for `integrate`.
    - `epsilons`: strengths, shape (E,), positive.

    **Raises** `ValueError` for epsilons that are not positive and finite, or an observable that
    is not a scalar.
    """
    if not callable(invariant):
        raise TypeError(
            f"invariant must be one observable, got {type(invariant).__name__}. Of a Discovery "
            "take one of its `invariants`."
        )
    epsilons = np.asarray(epsilons, float)
    if (
        epsilons.ndim != 1
        or len(epsilons) == 0
        or not (np.isfinite(epsilons) & (epsilons > 0)).all()
    ):
        raise ValueError(f"epsilons must be a list of positive numbers, got {epsilons.tolist()}.")

    def run(epsilon):
        solution = integrate(
            system,
            q0,
            p0,
            h=h,
            num_steps=num_steps,
            t0=t0,
            epsilon=epsilon,
            args=args,
            method=method,
            save=Save(final=True),
            observe=(MaxDrift(invariant), Mean(invariant)),
            throw=False,
        )
        return solution.observed, solution.result == RESULTS.successful

    (drifts, means), good = jax.jit(jax.vmap(run))(jnp.append(epsilons, 0.0))
    if drifts.ndim != 1:
        raise ValueError(
            f"the invariant must be a scalar, got values of shape {drifts.shape[1:]}: take one "
            "component."
        )
    drifts, good = np.asarray(drifts), np.asarray(good)
    round_off = 1e-15 * abs(float(means[-1]))
    floor = max(float(drifts[-1]), round_off)
    drifts, good = drifts[:-1], good[:-1]
    used = good & (drifts > 10 * floor)
    slope, stderr = _line(np.log(epsilons[used]), np.log(drifts[used]))
    return DriftOrder(epsilons, drifts, floor, used, slope, stderr, good)


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Least-squares slope and its standard error."""
    if len(x) < 2:
        return np.nan, np.nan
    dx = x - x.mean()
    slope = float(dx @ (y - y.mean()) / (dx @ dx))
    if len(x) < 3:
        return slope, np.nan
    rest = y - y.mean() - slope * dx
    return slope, float(np.sqrt(rest @ rest / (len(x) - 2) / (dx @ dx)))
