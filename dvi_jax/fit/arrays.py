"""Arrays of observations, checked: times, standard errors, periods, covariances."""

from typing import Any

import numpy as np

from ..base.inputs import refuse_unit_or_mask
from .checks import require_all, require_shape

# Standard errors relative to the largest value for which a sum of squares can be computed.
_RANGE = (1e-140, 1e140)


def real_array(name: str, value: Any) -> np.ndarray:
    """An array of numbers, as float64."""
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


def check_times(ts: np.ndarray, name: str = "ts") -> None:
    """**Raises** `ValueError` for times that are not finite, not in order or equal."""
    require_all(name, ts, np.isfinite(ts), "finite")
    steps = np.diff(ts)
    is_up = (steps > 0).sum() >= (steps < 0).sum()
    if index := _first(steps <= 0 if is_up else steps >= 0):
        [i] = index
        raise ValueError(
            f"{name} must all increase or all decrease, and no two be equal, got {name}[{i}] = "
            f"{ts[i]} and {name}[{i + 1}] = {ts[i + 1]}. Sort the rows by np.argsort({name}); give "
            "one row for each time."
        )


def sigma_of(sigma: Any, values: np.ndarray) -> np.ndarray:
    """Standard errors of the shape of `values`."""
    sigma = real_array("sigma", sigma)
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


def period_of(period: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Periods of the shape of one value."""
    period = real_array("period", period)
    try:
        full = np.array(np.broadcast_to(period, shape))
    except ValueError:
        raise ValueError(
            f"period must broadcast to the shape {shape} of one value, got shape {period.shape}."
        ) from None
    hint = "An infinite one is that of a component that is not periodic."
    require_all("period", full, full > 0, "positive", hint)
    return full


def covariance_of(covariance: Any, values: np.ndarray) -> np.ndarray:
    """Covariances, one for each row of `values`."""
    C = real_array("covariance", covariance)
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
