"""Work-precision diagrams."""

from collections.abc import Mapping
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
    points, lost = np.hstack(list(runs.values())), np.zeros(2, int)
    for i, (name, (costs, errors)) in enumerate(runs.items()):
        colour = COLOURS[i % len(COLOURS)]
        # The same marker comes back with another colour: 9 and 7 have no common factor.
        marker, dash = MARKERS[i % len(MARKERS)], DASHES[i // len(COLOURS) % len(DASHES)]
        good = np.isfinite(errors) & (errors > 0)
        label = f"{name}: {_slope(costs[good], errors[good])}" if slopes else name
        look = {"color": colour, "marker": marker, "linestyle": dash, "linewidth": 1.2}
        axis.loglog(costs[good], errors[good], label=label, **look)
        lost += without_place(axis, costs, errors, colour)
    axis.set(xscale="log", yscale="log", xlabel=cost, ylabel=error, title=title)
    extra: list[Any] = []
    line = _front(*points)
    if front and len(line):
        look = {"color": "#dcdcdc", "linewidth": 9, "zorder": 0.5}
        axis.plot(*line.T, **look, solid_capstyle="round", solid_joinstyle="round")
        extra.append(Line2D([], [], color="#dcdcdc", linewidth=7, label="front"))
    total = points.shape[1]
    extra += without_place_entries(lost, total, ("runs failed", "runs without error"))
    legend(axis, new, extra)
    return axis


def _checked(name: str, pair: Any) -> tuple[np.ndarray, np.ndarray]:
    """(costs, sizes of errors), in the order of cost."""
    try:
        costs, errors = (np.asarray(x, float) for x in pair)
    except (TypeError, ValueError):
        raise ValueError(f"{name!r} must be (costs, errors), two arrays, got {pair!r}.") from None
    positive = bool((np.isfinite(costs) & (costs > 0)).all())
    if costs.ndim != 1 or costs.shape != errors.shape or not len(costs) or not positive:
        raise ValueError(
            f"{name!r} must have costs and errors of one shape (runs,), and the costs must be "
            f"positive: got {costs.shape} and {errors.shape}, costs {costs}."
        )
    order = np.argsort(costs, kind="stable")
    return costs[order], np.abs(errors[order])


def _slope(costs: np.ndarray, errors: np.ndarray) -> str:
    """The slope of the last runs before round-off, for the legend."""
    costs, place = np.unique(costs, return_inverse=True)
    x, y = np.log(costs), np.bincount(place, np.log(errors)) / np.bincount(place)
    local, n = np.diff(y) / np.diff(x), len(x)
    while n > 1 and (local[n - 2] >= 0 or (n > 2 and local[n - 2] > _FLATTER * local[n - 3])):
        n -= 1
    if n < 2:
        return "no slope"
    part = slice(max(0, n - _LAST), n)
    last = local[part.start : n - 1]
    settled = len(last) > 1 and np.ptp(last) <= _SETTLED * np.abs(last).max()
    about = "" if settled else ", not settled" if len(last) > 1 else " of two runs"
    return f"slope {signed(np.polyfit(x[part], y[part], 1)[0], '.1f')}{about}"


def _front(costs: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Runs that nothing beats in both, shape (count, 2), in the order of cost."""
    good = np.isfinite(errors) & (errors > 0)
    order = np.lexsort((errors[good], costs[good]))
    points = np.stack([costs[good], errors[good]], 1)[order]
    least = np.minimum.accumulate(np.append(np.inf, points[:, 1]))
    return points[points[:, 1] < least[:-1]]
