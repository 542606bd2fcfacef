"""What was observed: times, values, errors; checked, and laid out for the device."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np

from .._checks import instance
from ..engine.quantities import refuse_unit_or_mask
from ..engine.signature import accepts


def _positions(t, q, p, args):
    return q


def _momenta(t, q, p, args):
    return p


def _state(t, q, p, args):
    return jnp.concatenate([jnp.ravel(q), jnp.ravel(p)])


_RANGE = (1e-140, 1e140)
"""Standard errors relative to the largest value of which a sum of squares can be computed."""

NAMED = {"positions": _positions, "momenta": _momenta, "state": _state}
"""Observables of a state that have a name."""


def accepts_four(function: Any) -> bool:
    """Whether it can be called with (t, q, p, args)."""
    return callable(function) and accepts(function, 4)


@dataclass(frozen=True, eq=False)
class Observations:
    r"""Observed values along one arc of a trajectory.

    - `ts`: times, shape (N,), ascending or descending, no two equal, and all on one side of t0.
      Either order may be combined with either sign of h; a `FitResult` has the order given here.
    - `values`: what was observed at them, shape (N, ...); NaN, or a masked number, where a
      component is missing. Only `values` may be masked.
    - `observe`: what is observed of a state: ``"positions"`` (q, the default), ``"momenta"`` (p),
      ``"state"`` (both in one vector), or a function ``(t, q, p, args)`` that returns an array of
      the shape of one value: a range, an angle, one body of many.
    - `sigma`: standard errors: one number, or an array that broadcasts to `values`. Left out,
      all values have the same error and its size is found from the residuals.
    - `covariance`: instead of sigma, covariances of the K components of one observation in the
      order of ``ravel``: shape (K, K) for all, or (N, K, K).
    - `t0`: time of the arc's start, where the model's q0 and p0 belong; ``ts[0]`` if left out.
      The sign of the model's h must lead from t0 to the observations.

    Observations of several kinds along the same arc are one `observe` that returns them all, at
    the union of their times, with NaN for what was not seen.

    **Raises** `ValueError` or `TypeError` for what cannot be meant: times that are not finite,
    not in order, twice the same or on both sides of t0; values of another shape, infinite, or all
    missing; errors that are zero, negative or NaN; a covariance that is not positive definite.
    """

    ts: Any
    values: Any
    observe: str | Callable[..., Any] = "positions"
    sigma: Any = None
    covariance: Any = None
    t0: float | None = None

    def __post_init__(self):
        values = self.values
        if np.ma.is_masked(values):  # what is masked is missing
            values = np.ma.filled(values.astype(float), np.nan)
        ts, values = _real("ts", self.ts), _real("values", values)
        if not (
            self.observe in NAMED if isinstance(self.observe, str) else accepts_four(self.observe)
        ):
            raise TypeError(
                'observe must be "positions", "momenta", "state" or a function (t, q, p, args) of '
                f"a state, got {self.observe!r}."
            )
        if ts.ndim != 1 or ts.size == 0:
            raise ValueError(f"ts must be a one-dimensional array of times, got shape {ts.shape}.")
        if values.shape[:1] != ts.shape:
            raise ValueError(
                f"values must have one row for each time: ts has shape {ts.shape}, values has "
                f"{values.shape}."
            )
        _check_times(ts)
        if np.isinf(values).any():
            where = _first(np.isinf(values))
            raise ValueError(
                f"values is infinite at index {where}. A missing component is given as NaN."
            )
        if np.isnan(values).all():
            raise ValueError("all values are NaN, which means missing: nothing was observed.")
        t0 = float(ts[0]) if self.t0 is None else _number("t0", self.t0)
        if ts.min() < t0 < ts.max():
            raise ValueError(
                f"t0 = {t0:.17g}, the start of the arc, lies between the times of the observations "
                f"({ts.min():.17g} to {ts.max():.17g}). All must be on one side of it: move t0, or "
                "give the observations before t0 as a second arc, with h < 0."
            )
        checked: dict[str, Any] = {"ts": ts, "values": values, "t0": t0}
        if self.sigma is not None:
            checked["sigma"] = _sigma(self.sigma, values)
        if self.covariance is not None:
            if self.sigma is not None:
                raise ValueError("give sigma or covariance, not both.")
            checked["covariance"] = _covariance(_real("covariance", self.covariance), values)
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @property
    def function(self) -> Callable[..., Any]:
        """`observe` as a function (t, q, p, args)."""
        return NAMED[self.observe] if isinstance(self.observe, str) else self.observe

    def ordered(self) -> "Observations":
        """The same observations in the order in which a run from t0 reaches them."""
        if abs(self.ts[0] - self.t0) <= abs(self.ts[-1] - self.t0):
            return self
        rows = ("ts", "values", "sigma", "covariance")
        given = {name: getattr(self, name) for name in rows}
        return replace(self, **{n: None if x is None else x[::-1] for n, x in given.items()})

    @property
    def components(self) -> int:
        """How many numbers one observation has."""
        return int(np.prod(self.values.shape[1:], dtype=int))

    @property
    def has_errors(self) -> bool:
        """Whether sigma or covariance was given."""
        return self.sigma is not None or self.covariance is not None

    @property
    def errors(self) -> np.ndarray:
        """Standard error of each value, of the shape of `values`; NaN where none was given."""
        if self.covariance is not None:
            return np.sqrt(np.einsum("nii->ni", self.covariance)).reshape(self.values.shape)
        return np.full(self.values.shape, np.nan) if self.sigma is None else self.sigma

    def whitening(self) -> np.ndarray:
        """What residuals are multiplied by to be independent with unit variance.

        Shape (N, K), or (N, K, K) for covariances: with those of what was seen, C = L Lᵀ, it
        is L⁻¹; rows and columns of what is missing are zero.
        """
        flat = self.values.reshape(len(self.ts), -1)
        seen = ~np.isnan(flat)
        if self.covariance is None:
            sigma = 1.0 if self.sigma is None else self.sigma.reshape(flat.shape)
            return np.where(seen, 1 / np.where(seen, sigma, 1.0), 0.0)
        k = flat.shape[1]
        found = np.zeros((len(flat), k, k))
        for i, (C, good) in enumerate(zip(self.covariance, seen, strict=True)):
            if good.any():
                L = np.linalg.cholesky(C[np.ix_(good, good)])
                found[i][np.ix_(good, good)] = np.linalg.solve(L, np.eye(len(L)))
        return found


Data: TypeAlias = Observations | list[Observations] | tuple[Observations, ...]
"""One arc, or several."""


def as_arcs(data: Any) -> tuple[list[Observations], bool]:
    """The arcs, and whether they were given as a list.

    **Raises** `TypeError` for anything but `Observations`, `ValueError` for an empty list and when
    some arcs have errors and some have none.
    """
    if isinstance(data, Observations):
        return [data], False
    instance("data", data, list | tuple, "a dvi.Observations or a list of them, one for each arc")
    if not data:
        raise ValueError("data is an empty list: there is nothing to fit.")
    for i, arc in enumerate(data):
        instance(f"data[{i}]", arc, Observations, "a dvi.Observations")
    if len({arc.has_errors for arc in data}) > 1:
        without = next(i for i, arc in enumerate(data) if not arc.has_errors)
        raise ValueError(
            f"data[{without}] has neither sigma nor covariance while other arcs have: their "
            "weights would be arbitrary. Give errors for all arcs, or for none."
        )
    return list(data), True


def _real(name: str, value: Any) -> np.ndarray:
    refuse_unit_or_mask(name, value)
    try:
        found = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be an array of real numbers ({error}).") from None
    if not (np.issubdtype(found.dtype, np.floating) or np.issubdtype(found.dtype, np.integer)):
        raise TypeError(f"{name} must be an array of real numbers, got dtype {found.dtype}.")
    return found.astype(float)


def _number(name: str, value: Any) -> float:
    found = _real(name, value)
    if found.shape != () or not np.isfinite(found):
        raise ValueError(f"{name} must be one finite number, got {value!r}.")
    return float(found)


def _first(where: np.ndarray) -> list[int]:
    """The first index at which an array is true."""
    return np.argwhere(where)[0].tolist()


def _check_times(ts: np.ndarray) -> None:
    if not np.isfinite(ts).all():
        i = int(np.argmin(np.isfinite(ts)))
        raise ValueError(
            f"ts[{i}] is {ts[i]}: every observation needs its time. Leave out those without one."
        )
    steps = np.diff(ts)
    if (steps == 0).any():
        i = int(np.argmax(steps == 0))
        raise ValueError(
            f"ts[{i}] and ts[{i + 1}] are the same time, {ts[i]:.17g}. Several observations at "
            "one time are one observation with more components (an observe that returns them "
            "all), or their mean with its smaller sigma."
        )
    if not ((steps > 0).all() or (steps < 0).all()):
        up = (steps > 0).sum() >= (steps < 0).sum()
        i = int(np.argmax(steps < 0 if up else steps > 0))
        raise ValueError(
            f"ts is not in order: ts[{i}] = {ts[i]:.17g} is followed by ts[{i + 1}] = "
            f"{ts[i + 1]:.17g}. Sort times and values together: order = np.argsort(ts); "
            "ts[order], values[order]."
        )


def _sigma(sigma: Any, values: np.ndarray) -> np.ndarray:
    sigma = _real("sigma", sigma)
    try:
        full = np.array(np.broadcast_to(sigma, values.shape))
    except ValueError:
        raise ValueError(
            f"sigma of shape {sigma.shape} does not broadcast to values of shape {values.shape}. "
            "For one error at each time give shape (N, 1, ...)."
        ) from None
    seen = ~np.isnan(values)
    bad = ~(np.isfinite(full) & (full > 0)) & seen
    if bad.any():
        raise ValueError(
            f"sigma is {full[bad][0]} for the value at index {_first(bad)}: standard errors must "
            "be positive and finite. A value that is not to count is given as NaN; one that is "
            "known exactly belongs into the model."
        )
    size = np.nanmax(np.abs(values)) or 1.0
    bad = ~((full > _RANGE[0] * size) & (full < _RANGE[1] * size)) & seen
    if bad.any():
        raise ValueError(
            f"sigma is {full[bad][0]:g} for the value at index {_first(bad)}, and the values are "
            f"up to {size:.3g}: squares of their ratio are beyond the range of double precision. "
            "Give the standard errors in the units of the values."
        )
    return full


def _covariance(C: np.ndarray, values: np.ndarray) -> np.ndarray:
    n, k = len(values), int(np.prod(values.shape[1:], dtype=int))
    if C.shape not in ((k, k), (n, k, k)):
        raise ValueError(
            f"covariance must have shape {(k, k)} or {(n, k, k)} for values of shape "
            f"{values.shape}, got {C.shape}."
        )
    full = np.array(np.broadcast_to(C, (n, k, k)))
    variance = np.einsum("nii->ni", full)
    scale = np.sqrt(np.abs(variance))
    skew = np.abs(full - full.swapaxes(1, 2)).max(axis=(1, 2))
    bad = ~(skew <= 1e-10 * (scale.max(axis=1) ** 2 + np.finfo(float).tiny))  # or NaN
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(
            f"the covariance of observation {i} is not symmetric and finite: {full[i]}"
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = full / (scale[:, :, None] * scale[:, None, :])
    good = np.isfinite(unit).all(axis=(1, 2)) & (variance > 0).all(axis=1)
    smallest = np.linalg.eigvalsh(np.where(good[:, None, None], unit, np.eye(k)))[:, 0]
    bad = ~good | (smallest <= 1e-14)
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(
            f"the covariance of observation {i} is not positive definite (smallest eigenvalue of "
            f"its correlations {smallest[i]:.3g}): {full[i].tolist()}. A combination that is known "
            "exactly belongs into the model; an error of zero cannot be weighed."
        )
    return full
