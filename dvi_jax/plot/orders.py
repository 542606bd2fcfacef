"""Pictures of orders: drifts and their causes, drift against ε, error against cost."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.patches import Patch

from ..base.checks import instance, one_of
from ..discover import DriftOrder, DriftSurface
from . import axes as draw
from .axes import canvas, counts_text, entry, legend, stack
from .style import COLOURS, DASHES, MARKERS, SMALL, ZERO, in_style, sign_text, with_unit

_HATCHES = ("", "////", "....", "\\\\\\\\", "xxxx", "++++")
_CAUSES = {"symmetry": "symmetry", "work": "work", "lattice": "time grid"}
"""Attribute of a `Balance` → its label."""
_EPSILON = "strength ε of the perturbation"
_BAR: dict[str, Any] = {"marker": "_", "ms": 12, "mew": 2, "ls": "none"}


@in_style
def balance(
    ts: Any,
    drift: Any = None,
    causes: Mapping[str, Any] | None = None,
    time: str = "time t",
    title: str = "",
    cumulative: bool = False,
    unit: str = "",
    ax: Any = None,
) -> Any:
    """The drift of an invariant as a stacked plot of its causes, and the residual of their sum.

    - `ts`: a `dvi.Balance`, as `dvi.noether_balance` returns it; or start of each step, shape (S,),
      with `drift`: rate of change, shape (S,), and `causes`: label → its part of the rate, shape
      (S,).
    - `cumulative`: the sum Σ rate · step over the steps before each of `ts`, in place of rates. The
      last rate is not used, as the end of its step is unknown.
    - `unit`: of the rates, of the sums with `cumulative`. `ax`: two `Axes`.

    Areas of causes that raise the invariant are stacked upward from 0, others downward. The line is
    the drift; below is its difference from the sum of the causes.

    **Returns** the `Axes` of the stack and of the residual, shape (2,). **Raises** `TypeError`
    without drift or causes, `ValueError` for shapes that do not fit.
    """
    if all(hasattr(ts, name) for name in ("ts", "drift", *_CAUSES)):
        if causes is None:
            causes = {label: getattr(ts, name) for name, label in _CAUSES.items()}
        ts, drift = ts.ts, ts.drift if drift is None else drift
    if drift is None or not causes:
        name, value = ("drift", drift) if drift is None else ("causes", causes)
        raise TypeError(
            f"{name} must be given, got {name}={value!r}, unless ts is a dvi.Balance, a result of "
            "dvi.noether_balance."
        )
    inputs = {"ts": ts, "drift": drift, **causes}
    arrays = {name: np.asarray(x, float) for name, x in inputs.items()}
    fits = np.shape(ts) == (np.size(ts),) and len({x.shape for x in arrays.values()}) == 1
    draw.check_shapes(fits, "ts, drift and causes must have the same shape (S,)", **arrays)
    t = arrays.pop("ts")
    if cumulative:
        arrays = {k: np.append(0.0, np.cumsum(x[:-1] * np.diff(t))) for k, x in arrays.items()}
    rate = arrays.pop("drift")
    ratios, purpose = (3, 1), "the stack and the residual"
    (top, bottom), new = stack(ax, 2, purpose, (6.4, 4.6), sharex=True, height_ratios=ratios)
    top_edge = bottom_edge = np.zeros(len(t))
    # Hatches distinguish the areas in print without colours.
    looks = itertools.cycle(zip(COLOURS[:-1], _HATCHES, strict=True))
    for (label, values), (colour, hatch) in zip(arrays.items(), looks, strict=False):
        look = {"facecolor": colour, "hatch": hatch, "edgecolor": "#ffffff", "lw": 0}
        higher, lower = top_edge + np.maximum(values, 0), bottom_edge + np.minimum(values, 0)
        top.fill_between(t, top_edge, higher, label=label, **look)
        top.fill_between(t, lower, bottom_edge, **look)
        top_edge, bottom_edge = higher, lower
    top.plot(t, rate, color="#000000", lw=0.9, label="drift")
    residual = rate - sum(arrays.values(), np.zeros(len(t)))
    bottom.plot(t, residual, color="#000000", lw=0.7)
    top.axhline(0, color="#000000", lw=0.5)
    top.set(ylabel=with_unit("change" if cumulative else "rate of change", unit), title=title)
    bottom.set(xlabel=time, ylabel="drift − sum")
    legend(top, new)
    top.figure.align_ylabels([top, bottom])
    return np.asarray([top, bottom])


@in_style
def drift_orders(
    results: DriftOrder | Mapping[str, DriftOrder] | Sequence[DriftOrder],
    expected: Sequence[float | None] | float | None = None,
    title: str = "Largest drift against the perturbation",
    ax: Any = None,
    *,
    promised: Sequence[float | None] | float | None = None,
) -> Any:
    """Drifts over ε (`drift_order`) and the orders that are expected.

    - `results`: one measured order, label → measured order, or a sequence of them.
    - `expected`: the order z + 1 of each result in turn (None: unknown), or one for all; a grey
      line of that slope is drawn through the first point of the fit. `promised` is an older name.

    Hollow points are excluded from the fit; bars at the left end mark the drift at ε = 0. The
    legend counts drifts that failed, crosses at the top, and those exactly 0, triangles at the
    bottom. **Returns** the `Axes`. **Raises** `TypeError` for anything but a `DriftOrder`.
    """
    expected = _one_of(expected, promised)
    if isinstance(results, DriftOrder):
        results = {"drift": results}
    elif not isinstance(results, Mapping):
        instance("results", results, Sequence, "one dvi.DriftOrder, or a dict or list of them")
        results = {f"observable {i}": order for i, order in enumerate(results, 1)}
    for order in results.values():
        rule = "results must be one dvi.DriftOrder, or a dict or a sequence of them"
        draw.check_attributes(order, ("drifts", "epsilons"), rule)
    slopes = [*expected] if isinstance(expected, Sequence) else [expected] * len(results)
    if len(slopes) != len(results):
        raise ValueError(f"expected must have one order for {len(results)} results, got {slopes}.")
    axis, new = canvas(ax, (6.4, 4.8))
    left = 0.7 * min(order.epsilons.min() for order in results.values())
    looks = zip(results.items(), slopes, itertools.cycle(COLOURS), itertools.cycle(MARKERS))
    outliers, total, has_excluded, has_guide = np.zeros(2, int), 0, False, False
    for (label, order), slope, colour, marker in looks:
        x, y, in_fit = order.epsilons, np.asarray(order.drifts), order.used
        out = np.isfinite(y) & (y > 0) & ~in_fit
        has_excluded |= bool(out.any())
        look = {"ls": "none", "color": colour, "marker": marker}
        axis.loglog(x[in_fit], y[in_fit], **look)
        axis.loglog(x[out], y[out], mfc="white", **look)
        text = f"{label}: {_slope_text(order)}" + ("" if slope is None else f", expected {slope:g}")
        axis.plot([], [], mfc=colour if in_fit.any() else "white", label=text, **look)
        # The drift at ε = 0 is a bar at the left end of the axis.
        if np.isfinite(order.floor) and order.floor > 0:
            axis.plot(left, order.floor, color=colour, **_BAR)
        if slope is not None and in_fit.any():
            first = np.argmin(np.where(in_fit, x, np.inf))
            draw.guide(axis, (x[first], x.max()), y[first], slope, zorder=1)
            has_guide = True
        outliers += draw.without_place(axis, np.append(x, left), np.append(y, order.floor), colour)
        total += len(y) + 1
    draw.log_x(axis)
    axis.set(yscale="log", xlabel=_EPSILON, ylabel="largest drift", title=title)
    marks: Any = {"color": "#444444", "ls": "none"}
    hollow = marks | {"marker": "o", "mfc": "white"}
    extra = [entry("expected slope", **draw.GUIDE)] if has_guide else []
    extra += [entry("excluded from the fit", **hollow)] if has_excluded else []
    extra.append(entry("at ε = 0", **marks | _BAR))
    extra += draw.without_place_entries(outliers, total, "drifts failed", "drifts are exactly 0")
    legend(axis, new, extra)
    return axis


def _one_of(expected: Any, promised: Any) -> Any:
    """The expected order, under either of its names."""
    if expected is not None and promised is not None:
        raise TypeError("expected and promised are two names of one argument: give one.")
    return promised if expected is None else expected


def _slope_text(order: DriftOrder) -> str:
    if not np.isfinite(order.slope):
        return "no order"
    if not order.resolved:
        return f"no order resolved, slope of the line {order.slope:.2f}"
    half = (order.interval[1] - order.interval[0]) / 2
    return f"slope {order.slope:.2f} ± {half:.2f}" if half >= 0.005 else f"slope {order.slope:.2f}"


@in_style
def drift_surface(
    surface: DriftSurface,
    expected: float | None = None,
    title: str = "Largest drift over ε and h",
    ax: Any = None,
    *,
    promised: float | None = None,
) -> Any:
    """Drifts over ε and h (`drift_surface`), and their orders in ε at each h.

    - `surface`: a result of `dvi.drift_surface`. `expected`: the order z + 1 (`promised` is an
      older name).
    - `ax`: two `Axes`, of the drifts and of their orders.

    Dots mark drifts that are excluded from the fits; bars are 95 % intervals, and orders that are
    not resolved are hollow. A logarithmic scale cannot show drifts that are exactly 0: they
    are black. Those that failed are hatched; the legend counts both. **Returns** the `Axes`, shape
    (2,).
    """
    ratios, purpose = (5, 4), "the drifts and their orders"
    (left, right), new = stack(ax, 2, purpose, (9.6, 4.2), ncols=2, width_ratios=ratios)
    edges = draw.cell_edges(surface.epsilons, log=True), draw.cell_edges(surface.hs, log=True)
    entries = _draw_drifts(left, surface, edges)
    draw.log_x(left, right)
    left.set(yscale="log", xlabel=_EPSILON, ylabel="step size h", title=title)
    _draw_orders_in_epsilon(right, surface, _one_of(expected, promised))
    right.set(xlabel="step size h", ylabel="order in ε", title="Order in ε")
    right.set_xlim(*edges[1][[0, -1]])
    orders = right.get_legend_handles_labels()[0]
    legend(left, new, entries + (orders if new else []), artists=False)
    if not new:
        legend(right, new)
    return np.asarray([left, right])


def _draw_drifts(axis: Any, surface: DriftSurface, edges: Any) -> list[Any]:
    """A map of the drifts, with dots where they are excluded from the fits; its legend entries."""
    drifts = np.asarray(surface.drifts)
    zero, invalid = drifts == 0, ~np.isfinite(drifts)
    norm = None if (zero | invalid).all() else LogNorm()
    x, y = edges
    image = draw.cells(axis, x, y, np.where(zero, np.nan, drifts).T, norm, draw.SHADES)
    axis.figure.colorbar(image, ax=axis, label="largest drift")
    draw.flat_cells(axis, x, y, zero.T, ZERO)
    entries: list[Any] = []
    i, j = np.nonzero(~surface.used & ~invalid)
    if len(i):
        look: Any = {"color": "black", "mfc": "white", "ms": 4}
        look |= {"mew": 0.8, "label": "excluded from the fit"}
        entries += axis.plot(surface.epsilons[i], surface.hs[j], "o", **look)
    black: dict[str, Any] = {"color": ZERO}
    for where, text, look in ((zero, "exactly 0", black), (invalid, "failed", draw.HATCH)):
        counts = counts_text({f"of {drifts.size} {text}": where.sum()})
        entries += [Patch(label=label, **look) for label in counts]
    return entries


def _draw_orders_in_epsilon(axis: Any, surface: DriftSurface, order_line: float | None) -> None:
    """The orders in ε at each h with their 95 % intervals."""
    is_finite = np.isfinite(surface.slopes)
    is_resolved = np.array([order.resolved for order in surface.orders])
    low, high = surface.intervals.T
    for rows, face, label in (
        (is_finite & is_resolved, COLOURS[0], "order for ε → 0, 95 % interval"),
        (is_finite & ~is_resolved, "white", "not resolved: slope of the straight line"),
    ):
        if rows.any():
            y = surface.slopes[rows]
            look = {"color": COLOURS[0], "mfc": face, "capsize": 3, "label": label}
            bars = [y - low[rows], high[rows] - y]
            axis.errorbar(surface.hs[rows], y, yerr=bars, fmt="o", **look)
    if order_line is not None:
        axis.axhline(order_line, label="expected", **draw.GUIDE)
        axis.set_ylim(
            np.min(low[is_finite] - 0.05, initial=order_line - 0.1),
            np.max(high[is_finite] + 0.05, initial=order_line + 0.1),
        )
    look = SMALL | {"rotation": 90, "ha": "center", "va": "bottom"}
    for value in surface.hs[~is_finite]:
        axis.annotate("no order", (value, 0.02), xycoords=("data", "axes fraction"), **look)


_FLATTER, _STEADY, _LAST = 0.6, 0.1, 3
"""A line whose slope is below this fraction of the slope before has reached round-off; largest
relative change of a settled slope from one pair of runs to the next; number of runs that determine
a slope, as earlier ones have too long steps."""


@in_style
def drift_bound(
    bound: Any,
    steps: Any,
    values: Any,
    invariant: int = 0,
    title: str = "Proved bound and computed drift",
    ax: Any = None,
) -> Any:
    """The proved line N (per_step + rounding) above computed changes |I(x_N) − I(x_0)|.

    - `bound`: a `DriftBound`. `invariant`: the number k of its I_k.
    - `steps`: numbers of steps N, shape (S,), the first is 0. `values`: I_k after these steps,
      shape (S,) or (..., S) for several trajectories, (0, S) for none; the largest change so far
      is drawn.

    A grey line marks the number of steps within which trajectories are proved to stay in the
    domain. The legend counts changes that are not finite, and those exactly 0. **Returns** the
    `Axes`. **Raises** `ValueError` for shapes that do not fit.
    """
    draw.check_attributes(bound, ("per_step", "rounding"), "bound must be a dvi.DriftBound")
    one_of("invariant", invariant, range(len(bound.per_step)))
    n, v = np.asarray(steps, float), np.asarray(values, float)
    fits = n.ndim == 1 and v.shape[-1:] == n.shape and len(n) > 1
    draw.check_shapes(fits, "values must have one number for each of steps", steps=n, values=v)
    axis, new = canvas(ax, (6.4, 4.4))
    changes = np.abs(v - v[..., :1]).reshape(-1, len(n))[:, 1:]
    for row in np.fmax.accumulate(changes, axis=1):
        axis.plot(n[1:], np.where(row > 0, row, np.nan), color=COLOURS[0], lw=0.7)
    line = n[1:] * (bound.per_step[invariant] + bound.rounding[invariant])
    text = "proved for all initial states in the domain"
    axis.plot(n[1:], line, color=COLOURS[1], ls="--", label=text)
    if bound.level is not None and bound.steps <= n[-1]:
        axis.axvline(bound.steps, **draw.GUIDE)
    draw.log_x(axis)
    axis.set(yscale="log", xlabel="number of steps N", title=title)
    axis.set_ylabel(f"largest |I$_{{{invariant}}}$(N) − I$_{{{invariant}}}$(0)|")
    marks = {
        "changes are not finite": (~np.isfinite(changes)).sum(),
        "changes are exactly 0": (changes == 0).sum(),
    }
    look = entry(f"computed, {len(changes)} trajectories", color=COLOURS[0], lw=1)
    legend(axis, new, [*[look][: len(changes)], *counts_text(marks)])
    return axis


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
    - `front`: a pale band under the runs that no other run beats in both cost and error.

    The legend counts runs whose error is not finite, crosses at the top, and those whose error is
    exactly 0, triangles at the bottom. **Returns** the `Axes`. **Raises** `ValueError` for no
    methods, for shapes that do not fit and for costs that are not positive.
    """
    instance("results", results, Mapping, "a dict such as {'Verlet': (costs, errors)}")
    draw.check_not_empty("results", results, "give {'Verlet': (costs, errors)}")
    axis, new = canvas(ax, (6.4, 4.8))
    runs = {name: _costs_and_errors(name, pair) for name, pair in results.items()}
    points, marks = np.hstack(list(runs.values())), np.zeros(2, int)
    for i, (name, (costs, errors)) in enumerate(runs.items()):
        colour = COLOURS[i % len(COLOURS)]
        # The same marker occurs again with another colour: 9 and 7 have no common factor.
        marker, dash = MARKERS[i % len(MARKERS)], DASHES[i // len(COLOURS) % len(DASHES)]
        good = np.isfinite(errors) & (errors > 0)
        label = f"{name}: {_slope(costs[good], errors[good])}" if slopes else name
        look = {"color": colour, "marker": marker, "ls": dash, "lw": 1.2}
        axis.loglog(costs[good], errors[good], label=label, **look)
        marks += draw.without_place(axis, costs, errors, colour)
    draw.log_x(axis)
    axis.set(yscale="log", xlabel=cost, ylabel=error, title=title)
    extra, total = [], points.shape[1]
    # In the order of cost, a run is in front if its error is below those of all before it.
    finite = points[:, np.isfinite(points[1]) & (points[1] > 0)]
    finite = finite[:, np.lexsort(finite[::-1])]
    line = finite[:, finite[1] < np.minimum.accumulate(np.append(np.inf, finite[1]))[:-1]]
    if front and line.size:
        look = {"color": "#dcdcdc", "lw": 9, "zorder": 0.5}
        axis.plot(*line, **look, solid_capstyle="round", solid_joinstyle="round")
        extra.append(entry("front", color="#dcdcdc", lw=7))
    extra += draw.without_place_entries(marks, total, "runs failed", "runs without error")
    legend(axis, new, extra)
    return axis


def _costs_and_errors(name: str, pair: Any) -> tuple[np.ndarray, np.ndarray]:
    """(costs, sizes of errors), in the order of cost."""
    try:
        costs, errors = (np.asarray(x, float) for x in pair)
    except (TypeError, ValueError):
        costs = errors = np.zeros(0)
    if costs.ndim != 1 or costs.shape != errors.shape or not len(costs):
        raise ValueError(
            f"results[{name!r}] must be (costs, errors), arrays of one shape (runs,), got "
            f"{pair!r:.100}."
        )
    if (bad := ~(np.isfinite(costs) & (costs > 0))).any():
        raise ValueError(
            f"costs in results[{name!r}] must be positive and finite, got {costs[bad][0]}."
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
    is_steady = len(last) > 1 and np.ptp(last) <= _STEADY * np.abs(last).max()
    remark = "" if is_steady else ", not settled" if len(last) > 1 else " of two runs"
    return f"slope {sign_text(np.polyfit(x[part], y[part], 1)[0], '.1f')}{remark}"
