"""Synthetic drifts with a known order: how often the interval of `drift_order` contains it.

Pure powers, sums of two powers, saturation, bends and floors, with noise of 0.1 to 20 %, at 4 to 12
values of ε over one to three decades.
"""

from typing import NamedTuple

import numpy as np

from dvi_jax.discover.drift import exponents


class Curve(NamedTuple):
    """Drifts at some ε, the drift at ε = 0, and the true order for ε → 0."""

    epsilons: np.ndarray
    drifts: np.ndarray
    floor: float
    order: float
    kind: str
    noise: float


class Measured(NamedTuple):
    """Shares of the curves. `covered`, `wrong`: of those resolved, by the interval and by more than
    0.25; `clean_resolved`: of powers with little noise; `covered_by_line`: by a straight line."""

    covered: float
    wrong: float
    resolved: float
    clean_resolved: float
    sums_resolved: float
    covered_by_line: float


def random_curve(rng) -> Curve:
    """A random law with noise."""
    points, decades, largest = rng.integers(4, 13), rng.uniform(1, 3), 10.0 ** rng.uniform(-2, 0)
    x = np.geomspace(10.0**-decades, 1, points)
    s, noise = float(rng.integers(1, 5)), 10 ** rng.uniform(-3, -0.7)
    kind = rng.choice(
        ["power", "sum", "saturation", "bend", "floor"], p=[0.35, 0.25, 0.15, 0.15, 0.1]
    )
    crossover, floor, y = 10 ** rng.uniform(-decades, 0.5), 0.0, x**s
    if kind == "sum":
        second = (x / crossover) ** rng.choice([1, 2, 3, rng.uniform(0.5, 3)])
        y = y * (1 + second) if rng.random() < 0.7 else y * np.hypot(1, second)
    elif kind == "saturation":
        p = rng.choice([1, 2])
        y = y * (1 + (x / crossover) ** p) ** (-s / p)
    elif kind == "bend":
        y = y * (1 + rng.uniform(-0.6, 0.6) * x)
    y = 10 ** rng.uniform(-3, 3) * y * np.exp(noise * rng.standard_normal(points))
    if kind == "floor":
        floor = y[rng.integers(0, points - 3)] / rng.uniform(10, 100)
        y = y + floor * rng.integers(0, 2)
    return Curve(x * largest, y, floor, s, kind, noise)


def measured(seed: int, count: int = 400) -> Measured:
    """What the fits of so many random curves say."""
    rng = np.random.default_rng(seed)
    curves = [random_curve(rng) for _ in range(count)]
    used = [curve.drifts > 10 * curve.floor for curve in curves]
    fits = [
        exponents.small_epsilon_exponent(curve.epsilons[here], curve.drifts[here], curve.floor)
        for curve, here in zip(curves, used, strict=True)
    ]
    order, kind, noise = (np.array([curve[i] for curve in curves]) for i in (3, 4, 5))
    resolved = np.array([fit.resolved for fit in fits])
    slope, intervals = np.array([f.slope for f in fits]), np.array([f.interval for f in fits])
    lines = [exponents.line_interval(f.line_slope, f.line_stderr, f.points) for f in fits]

    def inside(intervals):
        low, high = np.transpose(intervals)
        return (low <= order) & (order <= high)

    points = np.array([here.sum() for here in used])
    clean = (kind == "power") & (points >= 5) & (noise <= 0.05)
    return Measured(
        covered=float(inside(intervals)[resolved].mean()),
        wrong=float((np.abs(slope - order) > 0.25)[resolved].mean()),
        resolved=float(resolved.mean()),
        clean_resolved=float(resolved[clean].mean()),
        sums_resolved=float(resolved[kind == "sum"].mean()),
        covered_by_line=float(inside(lines).mean()),
    )
