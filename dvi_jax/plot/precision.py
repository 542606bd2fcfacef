"""Work-precision diagrams."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from .axes import canvas, legend, without_place, without_place_entries
from .style import COLOURS, DASHES, MARKERS, in_style, signed

_FLATTER = 0.6
"""A line whose slope is below this share of the slope before has reached round-off."""

_SETTLED = 0.1
"""Largest relative change of a settled slope from one pair of runs to the next."""

_LAST = 3
"""Number of runs that determine a slope: earlier ones have too long steps."""


@in_style
def work_precision(
    results: Mapping[str, tuple[Any, Any]],
    cost: str = "cost",
    error: str = "error",
    slopes: bool = True,
    front: bool = True,
    title: str = "",
    ax: Any = None,
) -> Any:
    """Error against cost, a line for each method, both axes logarithmic.

    - `results`: name of the method → (costs, errors), shape (runs,) each, in any order.
    - `cost`, `error`: labels, with units.
    - `slopes`: report the slope of each line, d log(error)/d log(cost), in the legend: the
      least-squares slope of its last three runs before round-off, "not settled" where it still
      changes by more than a tenth from one pair of them to the next. Round-off begins where the
      error no longer falls, or falls by less than 0.6 of the slope before. Of runs of equal cost
      the geometric mean of the errors counts.
    - `front`: a pale band under the runs than which no other is both cheaper and as exact.
    - `ax`: where to draw.

    A run whose error is not finite is a cross at the top, one whose error is exactly 0 as a
    triangle at the bottom, and the legend counts them.

    **Returns** the `Axes`.

    **Raises** `ValueError` for no methods, for shapes that do not fit and for costs that are not
    positive.
    """
    if not results:
        raise ValueError("work_precision was given no method.")
    axis, new = canvas(ax, (6.4, 4.8))
    runs = {name: _checked(name, pair) for name, pair in results.items()}
    lost = np.zeros(2, int)
    for i, (name, (costs, errors)) in enumerate(runs.items()):
        colour = COLOURS[i % len(COLOURS)]
        # The same marker comes back with another colour: 9 and 7 have no common factor.
        marker, dash = MARKERS[i % len(MARKERS)], DASHES[i // len(COLOURS) % len(DASHES)]
        good = np.isfinite(errors) & (errors > 0)
        slope = _slope(costs[good], errors[good]) if slopes else None
        if slopes:
            steep = "no slope" if slope is None else f"slope {signed(slope[0], '.1f')}{slope[1]}"
            name = f"{name}: {steep}"
        look = {"color": colour, "marker": marker, "linestyle": dash, "linewidth": 1.2}
        axis.loglog(costs[good], errors[good], label=name, **look)
        lost += without_place(axis, costs, errors, colour)
    axis.set(xscale="log", yscale="log", xlabel=cost, ylabel=error, title=title)
    extra: list[Any] = []
    line = _front(list(runs.values()))
    if front and len(line):
        look = {"color": "#dcdcdc", "linewidth": 9, "zorder": 0.5}
        axis.plot(*line.T, **look, solid_capstyle="round", solid_joinstyle="round")
        extra.append(Line2D([], [], color="#dcdcdc", linewidth=7, label="front"))
    total = sum(len(c) for c, _ in runs.values())
    extra += without_place_entries(lost, total, ("runs failed", "runs without error"))
    legend(axis, new, extra)
    return axis


def _checked(name: str, pair: Any) -> tuple[np.ndarray, np.ndarray]:
    """(costs, sizes of errors), in the order of cost."""
    try:
        costs, errors = (np.asarray(x, float) for x in pair)
    except (TypeError, ValueError):
        raise ValueError(f"{name!r} must be (costs, errors), two arrays, got {pair!r}.") from None
    if costs.ndim != 1 or costs.shape != errors.shape or not len(costs):
        raise ValueError(
            f"{name!r} must have costs and errors of one shape (runs,), got {costs.shape} and "
            f"{errors.shape}."
        )
    if not (np.isfinite(costs) & (costs > 0)).all():
        raise ValueError(f"the costs of {name!r} must be positive: got {costs}.")
    order = np.argsort(costs, kind="stable")
    return costs[order], np.abs(errors[order])


def _slope(costs: np.ndarray, errors: np.ndarray) -> tuple[float, str] | None:
    """(slope of the last runs before round-off, what is to be said of it)."""
    costs, place = np.unique(costs, return_inverse=True)
    x, y = np.log(costs), np.bincount(place, np.log(errors)) / np.bincount(place)
    local, n = np.diff(y) / np.diff(x), len(x)
    while n > 1 and (local[n - 2] >= 0 or (n > 2 and local[n - 2] > _FLATTER * local[n - 3])):
        n -= 1
    if n < 2:
        return None
    part = slice(max(0, n - _LAST), n)
    last = local[part.start : n - 1]
    settled = len(last) > 1 and np.ptp(last) <= _SETTLED * np.abs(last).max()
    about = "" if settled else ", not settled" if len(last) > 1 else " of two runs"
    return float(np.polyfit(x[part], y[part], 1)[0]), about


def _front(runs: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Runs that nothing beats in both, shape (count, 2), in the order of cost."""
    points = np.concatenate([np.stack(pair, 1) for pair in runs])
    points = points[np.isfinite(points[:, 1]) & (points[:, 1] > 0)]
    points = points[np.lexsort((points[:, 1], points[:, 0]))]
    least = np.minimum.accumulate(points[:, 1]) if len(points) else points[:, 1]
    better = np.concatenate([[True], points[1:, 1] < least[:-1]]) if len(points) else []
    return points[np.asarray(better, bool)]
