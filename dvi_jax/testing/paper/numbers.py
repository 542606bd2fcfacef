"""Common parts of all measurements: a run of a problem, and a few statistics."""

from collections.abc import Callable
from typing import Any

import numpy as np

import dvi_jax as dvi
from dvi_jax.systems import Problem

Tick = Callable[[float], None]
"""Called with the fraction of an experiment that is done, from 0 to 1."""


def run(problem: Problem, h: Any, num_steps: int, **options: Any) -> dvi.Solution:
    """`integrate` from the problem's initial conditions with its parameters."""
    options = {"h": h, "num_steps": num_steps, "args": problem.args, **options}
    return dvi.integrate(problem.system, problem.q0, problem.p0, **options)


def largest(values: Any) -> float:
    """Largest absolute value."""
    return float(np.max(np.abs(np.asarray(values))))


def relative_spread(values: np.ndarray) -> np.ndarray:
    """Largest value minus smallest, over the size of the first, along the last axis."""
    values = np.asarray(values)
    return np.ptp(values, axis=-1) / np.abs(values[..., 0])


def slope(x: np.ndarray, y: np.ndarray) -> float:
    """The exponent s of the least-squares power law y ∝ x^s; NaN where y is not positive."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    if not (np.all(np.isfinite(y)) and np.all(y > 0)):
        return float("nan")
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def crossing(x: np.ndarray, y: np.ndarray, level: float) -> float:
    """The x at which y first reaches `level`, interpolated; NaN if it never does."""
    if not (y >= level).any():
        return float("nan")
    k = int(np.argmax(y >= level))
    return float(np.interp(level, y[k - 1 : k + 1], x[k - 1 : k + 1]) if k else x[0])
