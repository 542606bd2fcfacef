"""Observations: times, values and errors, checked."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np

from ..base.checks import finite, instance
from ..base.inputs import refuse_unit_or_mask
from ..base.printing import printable
from ..base.signature import with_time
from .checks import require_all, require_shape

# Standard errors relative to the largest value for which a sum of squares can be computed.
_RANGE = (1e-140, 1e140)
# Observables of a state that have a name.
OBSERVABLES: dict[str, Callable[..., Any]] = {
    "positions": lambda t, q, p, args: q,
    "momenta": lambda t, q, p, args: p,
    "state": lambda t, q, p, args: jnp.concatenate([jnp.ravel(q), jnp.ravel(p)]),
}


@printable
@dataclass(frozen=True, eq=False)
class Observations:
    r"""Observed values along one arc of a trajectory.

    - `ts`: times, shape (N,), ascending or descending, no two equal, and all on one side of t0.
      Either order may be combined with either sign of h; a `FitResult` has the order given here.
    - `values`: observed values, shape (N, ...), for one component also (N,); NaN, or a masked
      number, where a component is missing. Only `values` may be masked.
    - `observe`: the observable of a state: ``"positions"`` (q, the default), ``"momenta"`` (p),
      ``"state"`` (both in one vector), or a function ``(q, p)`` or ``(t, q, p, args)`` that
      returns an array of the shape of one value: a range, an angle, one body of many.
    - `sigma`: standard errors: one number, or an array that broadcasts to `values`. Without them
      all values have the same error, whose size is estimated from the residuals.
    - `covariance`: instead of sigma, covariances of the K components of one observation in the
      order of ``ravel``: shape (K, K) for all, or (N, K, K).
    - `t0`: time of the arc's start, to which the model's q0 and p0 belong; ``ts[0]`` if left out.
      A fit of a model with a given q0 or p0 warns then, unless ``ts[0]`` is 0.
      The sign of the model's h must lead from t0 to the observations.
    - `period`: of values that are equal modulo it, such as angles (2π, 360): one positive number,
      or an array that broadcasts to one value, infinite for components without. Residuals then
      are between −period/2 and period/2, and the predictions of a result on the branch nearest to
      the observed values.

    Observations of several kinds along one arc are one `observe` that returns them all, at
    the union of their times, with NaN for what was not observed.

    **Raises** `ValueError` or `TypeError` for invalid input: times that are not finite, not in
    order, equal or on both sides of t0; values of another shape, infinite, or all missing; errors
    that are zero, negative or NaN; a covariance that is not positive definite.
    """

    ts: Any
    values: Any
    observe: str | Callable[..., Any] = "positions"
    sigma: Any = None
    covariance: Any = None
    t0: float | None = None
    period: Any = None
    t0_is_given: bool = field(init=False, default=False, repr=False)

    def __post_init__(self):
        values = self.values
        if np.ma.is_masked(values):
            values = np.ma.filled(values.astype(float), np.nan)
        ts, values = _real("ts", self.ts), _real("values", values)
        is_name, observe = isinstance(self.observe, str), self.observe
        if is_name and observe not in OBSERVABLES:
            raise TypeError(
                'observe must be "positions", "momenta", "state" or a function (q, p) or '
                f"(t, q, p, args), got {observe!r:.200}."
            )
        if not is_name:
            hint = 'or "positions", "momenta" or "state"'
            object.__setattr__(self, "observe", with_time(f"observe ({hint})", observe))
        if ts.ndim != 1 or ts.size == 0 or values.shape[:1] != ts.shape:
            raise ValueError(
                "ts must be a one-dimensional array of times, not empty, and values must have one "
                f"row for each, got shapes {ts.shape} and {values.shape}."
            )
        _check_times(ts)
        require_all("values", values, ~np.isinf(values), "finite", "NaN means a missing value.")
        if np.isnan(values).all():
            count = values.size
            raise ValueError(f"values must have at least one number, got {count} values, all NaN.")
        refuse_unit_or_mask("t0", self.t0)
        t0 = finite("t0", ts[0] if self.t0 is None else self.t0)
        if ts.min() < t0 < ts.max():
            raise ValueError(
                f"ts must be on one side of t0 = {t0}, got times from {ts.min()} to {ts.max()}. "
                "Leave out those before t0, or fit the state at the first time: t0=ts[0]."
            )
        fields: dict[str, Any] = {"ts": ts, "values": values, "t0": t0}
        if self.sigma is not None:
            fields["sigma"] = _sigma(self.sigma, values)
        if self.covariance is not None:
            if self.sigma is not None:
                raise ValueError("only one of sigma and covariance can be given, got both.")
            fields["covariance"] = _covariance(self.covariance, values)
        if self.period is not None:
            fields["period"] = _period(self.period, values.shape[1:])
        fields["t0_is_given"] = self.t0 is not None
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def in_columns(self) -> "Observations":
        """The same observations with values of shape (N, 1) in place of (N,)."""
        sigma = None if self.sigma is None else self.sigma[:, None]
        return replace(self, values=self.values[:, None], sigma=sigma)

    @property
    def function(self) -> Callable[..., Any]:
        """`observe` as a function (t, q, p, args)."""
        return OBSERVABLES[self.observe] if isinstance(self.observe, str) else self.observe

    def in_time_order(self) -> "Observations":
        """The same observations in the order in which a run from t0 reaches them."""
        if abs(self.ts[0] - self.t0) <= abs(self.ts[-1] - self.t0):
            return self
        fields = {name: getattr(self, name) for name in ("ts", "values", "sigma", "covariance")}
        return replace(self, **{n: None if x is None else x[::-1] for n, x in fields.items()})

    @property
    def components(self) -> int:
        """Number of components of one observation."""
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
        """Factors by which residuals become independent with unit variance.

        Shape (N, K), or (N, K, K) for covariances: L⁻¹ of C = L Lᵀ of the observed components;
        rows and columns of missing ones are zero.
        """
        flat = self.values.reshape(len(self.ts), -1)
        is_observed = ~np.isnan(flat)
        if self.covariance is None:
            sigma = 1.0 if self.sigma is None else self.sigma.reshape(flat.shape)
            return np.where(is_observed, 1 / np.where(is_observed, sigma, 1.0), 0.0)
        factors = np.zeros((*flat.shape, flat.shape[1]))
        for i, (C, good) in enumerate(zip(self.covariance, is_observed, strict=True)):
            if good.any():
                L = np.linalg.cholesky(C[np.ix_(good, good)])
                factors[i][np.ix_(good, good)] = np.linalg.solve(L, np.eye(len(L)))
        return factors


# One arc, or several.
Data: TypeAlias = Observations | list[Observations] | tuple[Observations, ...]


def as_arcs(data: Any) -> tuple[list[Observations], bool]:
    """The arcs, and whether they were given as a list.

    **Raises** `TypeError` for anything but `Observations`, `ValueError` for an empty list and when
    some arcs have errors and some have none.
    """
    if isinstance(data, Observations):
        return [data], False
    instance("data", data, list | tuple, "a dvi.Observations or a list of them, one for each arc")
    if not data:
        raise ValueError(f"data must contain at least one dvi.Observations, got {data!r}.")
    for i, arc in enumerate(data):
        instance(f"data[{i}]", arc, Observations, "a dvi.Observations")
    flags = [arc.has_errors for arc in data]
    if any(flags) and not all(flags):
        raise ValueError(
            "all arcs must have sigma or covariance, or none of them, got one for "
            f"data[{flags.index(True)}], but not for data[{flags.index(False)}]."
        )
    return list(data), True


def _real(name: str, value: Any) -> np.ndarray:
    refuse_unit_or_mask(name, value)
    try:
        array = np.asarray(value)
        kind = f"dtype {array.dtype}"
    except (TypeError, ValueError) as error:  # rows of unequal length
        array, kind = np.array(None), f"{type(value).__name__}: {str(error).partition(chr(10))[0]}"
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be an array of real numbers, got {kind}.")
    return array.astype(float)


def _first(where: np.ndarray) -> list[int]:
    """The first index at which an array is true; an empty list if it is false everywhere."""
    return np.argwhere(where)[0].tolist() if where.any() else []


def _check_times(ts: np.ndarray) -> None:
    require_all("ts", ts, np.isfinite(ts), "finite")
    steps = np.diff(ts)
    is_up = (steps > 0).sum() >= (steps < 0).sum()
    if index := _first(steps <= 0 if is_up else steps >= 0):
        [i] = index
        raise ValueError(
            "ts must all increase or all decrease, and no two be equal, got "
            f"ts[{i}] = {ts[i]} and ts[{i + 1}] = {ts[i + 1]}. Sort the rows by np.argsort(ts); "
            "give one row for each time."
        )


def _sigma(sigma: Any, values: np.ndarray) -> np.ndarray:
    sigma = _real("sigma", sigma)
    try:
        full = np.array(np.broadcast_to(sigma, values.shape))
    except ValueError:
        raise ValueError(
            f"sigma must broadcast to the shape {values.shape} of values, got shape {sigma.shape}."
        ) from None
    is_missing = np.isnan(values)
    is_valid = np.isfinite(full) & (full > 0) | is_missing
    require_all("sigma", full, is_valid, "positive and finite", "To ignore a value, set it to NaN.")
    largest = np.nanmax(np.abs(values))
    low, high = (factor * (largest or 1.0) for factor in _RANGE)
    rule = f"between {low:.3g} and {high:.3g} for values of up to {largest:.3g}"
    is_valid = (full > low) & (full < high) | is_missing
    require_all("sigma", full, is_valid, rule, "Give sigma in the units of the values.")
    return full


def _period(period: Any, shape: tuple[int, ...]) -> np.ndarray:
    period = _real("period", period)
    try:
        full = np.array(np.broadcast_to(period, shape))
    except ValueError:
        raise ValueError(
            f"period must broadcast to the shape {shape} of one value, got shape {period.shape}."
        ) from None
    hint = "An infinite one is that of a component that is not periodic."
    require_all("period", full, full > 0, "positive", hint)
    return full


def nearest_branch(values: Any, observed: Any, period: Any) -> Any:
    """Predictions shifted by whole periods to the branch nearest to the observed values; `period`:
    infinite for components that are not periodic, or None for all."""
    if period is None:
        return values
    period = jnp.broadcast_to(period, values.shape)
    turns = jnp.round((values - observed) / period)
    return values - jnp.where(jnp.isfinite(period), period, 0.0) * turns


def _covariance(covariance: Any, values: np.ndarray) -> np.ndarray:
    C = _real("covariance", covariance)
    n, k = len(values), int(np.prod(values.shape[1:], dtype=int))
    require_shape("covariance", C, (k, k), (n, k, k))
    full = np.array(np.broadcast_to(C, (n, k, k)))
    variance = np.einsum("nii->ni", full)
    scale = np.sqrt(np.abs(variance))
    skew = np.abs(full - full.swapaxes(1, 2)).max(axis=(1, 2))
    # The comparison is written so that NaN is refused.
    if index := _first(~(skew <= 1e-10 * (scale.max(axis=1) ** 2 + np.finfo(float).tiny))):
        [i] = index
        asymmetry = np.nan_to_num(np.abs(full[i] - full[i].T), nan=np.inf, posinf=np.inf)
        a, b = np.unravel_index(np.argmax(asymmetry), asymmetry.shape)
        hint = "Against round-off give (C + C.T) / 2."
        if not np.isfinite(asymmetry[a, b]):
            hint = "Mark a missing value by NaN in values only."
        raise ValueError(
            f"the covariance of observation {i} must be symmetric and finite, got {full[i, a, b]} "
            f"at [{a}, {b}] and {full[i, b, a]} at [{b}, {a}]. {hint}"
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = full / (scale[:, :, None] * scale[:, None, :])
    good = np.isfinite(unit).all(axis=(1, 2)) & (variance > 0).all(axis=1)
    smallest = np.linalg.eigvalsh(np.where(good[:, None, None], unit, np.eye(k)))[:, 0]
    if index := _first(~good | (smallest <= 1e-14)):
        [i] = index
        description = f"an eigenvalue of {smallest[i]:.3g} of its correlation matrix"
        if not good[i]:  # then the correlation matrix is not defined
            description = f"a variance of {variance[i].min():.3g}"
        raise ValueError(
            f"the covariance of observation {i} must be positive definite, got {description}. "
            "Leave out values or combinations that are known exactly."
        )
    return full
