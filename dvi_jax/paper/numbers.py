"""The few statistics that every measurement here is made of."""

import numpy as np


def spread(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Largest value minus smallest, along `axis`."""
    return np.ptp(np.asarray(values), axis=axis)


def relative_spread(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """`spread` divided by the size of the first value, along `axis`."""
    values = np.asarray(values)
    return spread(values, axis) / np.abs(np.take(values, 0, axis))


def max_drift(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Largest distance from the first value, along `axis`."""
    values = np.asarray(values)
    first = np.expand_dims(np.take(values, 0, axis), axis)
    return np.max(np.abs(values - first), axis=axis)


def slope(x: np.ndarray, y: np.ndarray) -> float:
    """The exponent s of the least-squares power law y ∝ x^s; NaN where y is not positive."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    if not (np.all(np.isfinite(y)) and np.all(y > 0)):
        return float("nan")
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def crossing(x: np.ndarray, y: np.ndarray, level: float) -> float:
    """The x at which y first reaches `level`, interpolated; NaN if it never does."""
    above = np.flatnonzero(y >= level)
    if not above.size:
        return float("nan")
    k = int(above[0])
    if k == 0:
        return float(x[0])
    part = (level - y[k - 1]) / (y[k] - y[k - 1])
    return float(x[k - 1] + part * (x[k] - x[k - 1]))
