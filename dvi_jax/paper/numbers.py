"""What every measurement uses: a run of a problem, and a few statistics."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax.systems import Problem

Tick = Callable[[float], None]
"""Called with the part of an experiment that is done, from 0 to 1."""


def run(problem: Problem, h: Any, num_steps: int, **options: Any) -> dvi.Solution:
    """`integrate` from the problem's initial conditions with its parameters."""
    options = {"args": problem.args, **options}
    return dvi.integrate(
        problem.system, problem.q0, problem.p0, h=h, num_steps=num_steps, **options
    )


def over(values: np.ndarray, function: Callable[[Any], Any]) -> Any:
    """The function of each value, as one batch."""
    return jax.vmap(function)(jnp.asarray(values))


def largest(values: Any) -> float:
    """Largest absolute value."""
    return float(np.max(np.abs(np.asarray(values))))


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
