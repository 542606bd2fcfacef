"""What was watched along a run: values at the start, along the way, changes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from ..systems.n_body import linear_momentum
from ._setup import Setup


@dataclass(frozen=True)
class Watched:
    """One observable of a run.

    - `start`: its value at the start. `values`: at the saved times, the start first, shape
      (S, …), for one that stands alone; the reduced value for one in a reduction.
    - `scale`: what changes of it are compared with; 1 when the start gives nothing to compare.
    - `reduction`: name of the reduction, or "".
    """

    start: np.ndarray
    values: np.ndarray
    scale: float
    reduction: str

    @property
    def is_relative(self) -> bool:
        return self.scale != 1.0

    def change(self) -> np.ndarray:
        """Change since the start over `scale`, shape (S,): with its sign, or as a length."""
        change = self.values - self.start
        if change.ndim == 1:
            return change / self.scale
        return np.linalg.norm(change.reshape(len(change), -1), axis=-1) / self.scale

    def summary(self) -> dict[str, Any]:
        """What the report says of it."""
        if self.reduction:
            said = {"reduction": self.reduction, "value": self.values}
            if self.reduction in ("MaxDrift", "Range"):
                said["relative"] = float(np.linalg.norm(self.values)) / self.scale
        else:
            change = np.abs(self.change())
            finite = change[np.isfinite(change)]
            said = {
                "start": self.start,
                "end": self.values[-1],
                "largest_saved_change": float(finite.max()) if finite.size else np.nan,
            }
        return said | {"scale": self.scale}


def watch(
    setup: Setup, observables: Mapping[str, Any], observed: Mapping[str, Any]
) -> dict[str, Watched]:
    """Every observable of a run with its start and scale.

    The scale is the size of the start value; of a linear momentum, whose total may be all
    but zero, the sum Σ|p_i| over the bodies.
    """
    q0, p0 = jnp.asarray(setup.q0), jnp.asarray(setup.p0)
    t0 = jnp.asarray(setup.t0, q0.dtype)
    watched = {}
    for name, observable in observables.items():
        alone = not isinstance(observable, dvi.Reduction)
        function: Any = observable if alone else observable.function
        if hasattr(function, "bind"):  # it has to know the system and ε of the run
            function = function.bind(setup.system, setup.epsilon)
        # A step that goes nowhere stands for the start.
        start = np.asarray(function(t0, t0, q0, p0, q0, p0, setup.args))
        scale = float(np.linalg.norm(start))
        if function is linear_momentum:
            scale = float(np.linalg.norm(setup.p0, axis=-1).sum())
        if not np.isfinite(scale) or scale == 0:
            scale = 1.0
        values = np.asarray(observed[name])
        if alone:
            values = np.concatenate([start[None], values])
        reduction = "" if alone else type(observable).__name__
        watched[name] = Watched(start, values, scale, reduction)
    return watched
