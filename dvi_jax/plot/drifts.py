"""Pictures of what is conserved: drifts, their orders in ε and their causes."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..discover import DriftOrder, DriftSurface
from .axes import (
    canvas,
    cell_edges,
    cells,
    check_shapes,
    counted,
    flat_cells,
    guide,
    legend,
    stack,
    without_place,
    without_place_entries,
)
from .style import COLOURS, GREY, HATCH, MARKERS, SHADES, ZERO, in_style, named


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
    """The drift of an invariant as a stack of its causes, and how well they add up.

    - `ts`: a `dvi.Balance`, as `dvi.noether_balance` returns it; or start of each step, shape (S,),
      with `drift`: rate of change, shape (S,), and `causes`: label → its share of the rate, shape
      (S,).
    - `cumulative`: the sum Σ rate · step since the first of `ts`, in place of
      rates: 0 there, and at each later time what the steps before it brought. The last rate has no
      part in it, as nothing says when its step ends.
    - `unit`: of the rates, of the sums with `cumulative`. `ax`: two `Axes`.

    The areas are stacked: causes that raise the invariant upward from 0, others downward.
    The line is the drift; below is what it differs from the sum of the causes by.

    **Returns** the `Axes` of the stack and of what is left, shape (2,).

    **Raises** `TypeError` without drift or causes, `ValueError` for shapes that do not fit.
    """
    if all(hasattr(ts, name) for name in ("ts", "drift", *_CAUSES)):
        causes = {name: getattr(ts, name) for name in _CAUSES} if causes is None else causes
        ts, drift = ts.ts, ts.drift if drift is None else drift
    if drift is None or not causes:
        raise TypeError(
            "balance takes what dvi.noether_balance returns, or times, the drift and its causes."
        )
    given = {"ts": ts, "drift": drift, **causes}
    arrays = {name: np.asarray(x, float) for name, x in given.items()}
    fits = np.shape(ts) == (np.size(ts),) and len({x.shape for x in arrays.values()}) == 1
    check_shapes(fits, "a balance has one number of each kind a step, shape (S,)", **arrays)
    t, rate = arrays.pop("ts"), arrays.pop("drift")
    if cumulative:  # the sum over the steps before each time
        rate, *summed = (
            np.append(0.0, np.cumsum(x[:-1] * np.diff(t))) for x in (rate, *arrays.values())
        )
        arrays = dict(zip(arrays, summed, strict=True))
    ratios = {"height_ratios": (3, 1)}
    what = "the stack and what is left"
    (top, bottom), new = stack(ax, 2, what, (6.4, 4.6), sharex=True, gridspec_kw=ratios)
    up = down = np.zeros(len(t))
    # Hatches distinguish the areas in print without colours.
    looks = itertools.cycle(zip(COLOURS[:-1], _HATCHES, strict=True))
    for (label, values), (colour, hatch) in zip(arrays.items(), looks, strict=False):
        look = {"facecolor": colour, "hatch": hatch, "edgecolor": "#ffffff", "linewidth": 0}
        higher, lower = up + np.maximum(values, 0), down + np.minimum(values, 0)
        top.fill_between(t, up, higher, label=label, **look)
        top.fill_between(t, lower, down, **look)
        up, down = higher, lower
    top.plot(t, rate, color="#000000", linewidth=0.9, label="drift")
    left = rate - sum(arrays.values(), np.zeros(len(t)))
    bottom.plot(t, left, color="#000000", linewidth=0.7)
    top.axhline(0, color="#000000", linewidth=0.5)
    top.set(ylabel=named("change" if cumulative else "rate of change", unit), title=title)
    bottom.set(xlabel=time, ylabel="drift − sum")
    legend(top, new)
    top.figure.align_ylabels([top, bottom])
    return np.asarray([top, bottom])


_HATCHES = ("", "////", "....", "\\\\\\\\", "xxxx", "++++")
_CAUSES = ("symmetry", "work", "lattice")


@in_style
def drift_orders(
    results: Mapping[str, DriftOrder] | Sequence[DriftOrder],
    promised: Sequence[float | None] | float | None = None,
    title: str = "Largest drift against the perturbation",
    ax: Any = None,
) -> Any:
    """Drifts over ε (`drift_order`) and the orders that were promised.

    - `results`: label → measured order, or a sequence of them.
    - `promised`: z + 1 for each result in turn (None: no promise), or one for all; a grey line
      of that slope goes through the first point of the fit.

    Hollow points are excluded from the fit; bars at the left end mark the drift at ε = 0. Drifts
    that failed are crosses at the top, those exactly 0 as triangles at the bottom, and the
    legend counts them. `ax`: where to draw.

    **Returns** the `Axes`.

    **Raises** `TypeError` for what is no `DriftOrder`.
    """
    if not isinstance(results, Mapping):
        results = {f"observable {i}": order for i, order in enumerate(results, 1)}
    for label, order in results.items():
        if not hasattr(order, "drifts"):
            raise TypeError(
                f"drift_orders draws what dvi.drift_order returned, got {order!r:.60} for {label}."
            )
    slopes = [*promised] if isinstance(promised, Sequence) else [promised] * len(results)
    if len(slopes) != len(results):
        raise ValueError(f"promised has {len(slopes)} orders for {len(results)} results.")
    axis, new = canvas(ax, (6.4, 4.8))
    left = 0.7 * min(order.epsilons.min() for order in results.values())
    looks = zip(results.items(), slopes, itertools.cycle(COLOURS), itertools.cycle(MARKERS))
    lost, total, excluded = np.zeros(2, int), 0, False
    for (label, order), slope, colour, marker in looks:
        text = f"{label}: {_slope_text(order)}" + ("" if slope is None else f", promised {slope:g}")
        excluded |= _draw_order(axis, order, text, color=colour, marker=marker)
        # The drift at ε = 0 is a bar at the left end of the axis.
        if np.isfinite(order.floor) and order.floor > 0:
            axis.plot(left, order.floor, color=colour, **_BAR)
        x, y = np.append(order.epsilons, left), np.append(order.drifts, order.floor)
        lost += without_place(axis, x, y, colour)
        total += len(y)
        if slope is not None and order.used.any():
            first = np.argmin(np.where(order.used, order.epsilons, np.inf))
            start = order.epsilons[first], order.epsilons.max()
            guide(axis, start, np.asarray(order.drifts)[first], slope, zorder=1)
    axis.set(xscale="log", yscale="log", xlabel="ε", ylabel="largest drift", title=title)
    extra: list[Any] = []
    if promised is not None:
        dashed: Any = {"color": GREY, "linestyle": "--", "linewidth": 1}
        extra.append(Line2D([], [], label="slope promised", **dashed))
    marks: Any = {"color": "#444444", "linestyle": "none"}
    if excluded:
        look: Any = {"marker": "o", "markerfacecolor": "white", **marks}
        extra.append(Line2D([], [], label="excluded from the fit", **look))
    extra.append(Line2D([], [], label="at ε = 0", **marks | _BAR))
    extra += without_place_entries(lost, total, ("drifts failed", "drifts are exactly 0"))
    legend(axis, new, extra)
    return axis


_BAR: dict[str, Any] = {"marker": "_", "markersize": 12, "markeredgewidth": 2, "linestyle": "none"}


def _draw_order(axis: Any, order: DriftOrder, label: str, **look: Any) -> bool:
    """Drifts over ε, hollow where they are excluded from the fit; whether any are."""
    x, y, used = order.epsilons, np.asarray(order.drifts), order.used
    out = np.isfinite(y) & (y > 0) & ~used
    look = {"linestyle": "none", **look}
    axis.loglog(x[used], y[used], **look)
    axis.loglog(x[out], y[out], markerfacecolor="white", **look)
    face = look["color"] if used.any() else "white"
    axis.plot([], [], markerfacecolor=face, label=label, **look)
    return bool(out.any())


@in_style
def drift_surface(
    surface: DriftSurface,
    promised: float | None = None,
    title: str = "Largest drift over ε and h",
    ax: Any = None,
) -> Any:
    """Drifts over ε and h (`drift_surface`), and their orders in ε at each h.

    - `surface`: what `drift_surface` returned. `promised`: z + 1.
    - `ax`: two `Axes`, of the drifts and of their orders.

    Dots mark what is excluded from the fits; bars are 95 % intervals, and orders that are not
    resolved are hollow. A drift that is exactly 0 has no place on a logarithmic scale: it is black.
    One that failed is hatched; the legend counts both.

    **Returns** the `Axes`, shape (2,).
    """
    ratios = {"width_ratios": (5, 4)}
    what = "the drifts and their orders"
    (left, right), new = stack(ax, 2, what, (9.6, 4.2), ncols=2, gridspec_kw=ratios)
    edges = cell_edges(surface.epsilons, log=True), cell_edges(surface.hs, log=True)
    entries = _draw_drifts(left, surface, edges)
    left.set(xscale="log", yscale="log", xlabel="ε", ylabel="step size h", title=title)
    _draw_orders_in_epsilon(right, surface, promised)
    right.set(xscale="log", xlabel="step size h", ylabel="order in ε", title="Order in ε")
    right.set_xlim(*edges[1][[0, -1]])
    orders = right.get_legend_handles_labels()[0]
    legend(left, new, entries + (orders if new else []), labelled=False)
    if not new:
        legend(right, new)
    return np.asarray([left, right])


def _draw_drifts(axis: Any, surface: DriftSurface, edges: Any) -> list[Any]:
    """A map of the drifts, with dots where they are excluded from the fits; its legend entries."""
    drifts = np.asarray(surface.drifts)
    zero, failed = drifts == 0, ~np.isfinite(drifts)
    norm = None if (zero | failed).all() else LogNorm()
    x, y = edges
    image = cells(axis, x, y, np.where(zero, np.nan, drifts).T, norm, SHADES)
    axis.figure.colorbar(image, ax=axis, label="largest drift")
    flat_cells(axis, x, y, zero.T, ZERO)
    entries: list[Any] = []
    i, j = np.nonzero(~surface.used & ~failed)
    if len(i):
        look: Any = {"color": "black", "markerfacecolor": "white", "markersize": 4}
        look |= {"markeredgewidth": 0.8, "label": "excluded from the fit"}
        entries += axis.plot(surface.epsilons[i], surface.hs[j], "o", **look)
    black: Any = {"color": ZERO}
    for where, text, patch in ((zero, "exactly 0", black), (failed, "failed", HATCH)):
        counts = counted({f"of {drifts.size} {text}": where.sum()})
        entries += [Patch(label=label, **patch) for label in counts]
    return entries


def _draw_orders_in_epsilon(axis: Any, surface: DriftSurface, promised: float | None) -> None:
    """The orders in ε at each h with their 95 % intervals."""
    measured = np.isfinite(surface.slopes)
    resolved = np.array([order.resolved for order in surface.orders])
    low, high = surface.intervals.T
    for here, face, label in (
        (measured & resolved, COLOURS[0], "order for ε → 0, 95 % interval"),
        (measured & ~resolved, "white", "not resolved: slope of the straight line"),
    ):
        if here.any():
            y = surface.slopes[here]
            look = {"color": COLOURS[0], "markerfacecolor": face, "capsize": 3, "label": label}
            bars = [y - low[here], high[here] - y]
            axis.errorbar(surface.hs[here], y, yerr=bars, fmt="o", **look)
    if promised is not None:
        axis.axhline(promised, color=GREY, linewidth=1, linestyle="--", label="promised")
        axis.set_ylim(
            np.min(low[measured] - 0.05, initial=promised - 0.1),
            np.max(high[measured] + 0.05, initial=promised + 0.1),
        )
    look = {"rotation": 90, "ha": "center", "va": "bottom", "fontsize": 8, "color": "#555555"}
    for value in surface.hs[~measured]:
        axis.annotate("no order", (value, 0.02), xycoords=("data", "axes fraction"), **look)


def _slope_text(order: DriftOrder) -> str:
    if not np.isfinite(order.slope):
        return "no order"
    if not order.resolved:
        return f"no order resolved, slope of the line {order.slope:.2f}"
    low, high = order.interval
    half = (high - low) / 2
    digits = 3 if not half > 0 else int(np.clip(1 - np.floor(np.log10(half)), 3, 6))
    return f"slope {order.slope:.{digits}f} ± {half:.{digits}f}"
