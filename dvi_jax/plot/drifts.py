"""Pictures of what is conserved: drifts, their orders in ε and their causes."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..invariants import DriftOrder, DriftSurface
from .house import (
    COLOURS,
    HATCH,
    MARKERS,
    PALE,
    SHADES,
    ZERO,
    canvas,
    cell_edges,
    in_style,
    legend,
    named,
    stack,
)


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
    - `cumulative`: what has come together since the first of `ts`, Σ rate · step, in place of
      rates: 0 there, and at each later time what the steps before it brought. The last rate has no
      part in it, as nothing says when its step ends.
    - `unit`: of the rates, of what has come together with `cumulative`. `ax`: two `Axes`.

    Areas stand upon one another: what raises the invariant upward from 0, what lowers it downward.
    The line is the drift; below is what it differs from the sum of the causes by.

    **Returns** the `Axes` of the stack and of what is left, shape (2,).

    **Raises** `TypeError` without drift or causes, `ValueError` for shapes that do not fit.
    """
    t, rate, shares = _of_balance(ts, drift, causes)
    if cumulative:
        rate, shares = _summed(t, rate), {name: _summed(t, v) for name, v in shares.items()}
    (top, bottom), new = stack(
        ax, 2, "the stack and what is left", (6.4, 4.6), sharex=True,
        gridspec_kw={"height_ratios": (3, 1)},
    )  # fmt: skip
    up = down = np.zeros(len(t))
    # Hatches, too, tell areas apart where there are no colours.
    looks = zip(itertools.cycle(COLOURS[:-1]), itertools.cycle(_HATCHES))
    for (label, values), (colour, hatch) in zip(shares.items(), looks, strict=False):
        look = {"facecolor": colour, "hatch": hatch, "edgecolor": "#ffffff", "linewidth": 0}
        higher, lower = up + np.maximum(values, 0), down + np.minimum(values, 0)
        top.fill_between(t, up, higher, label=label, **look)
        top.fill_between(t, lower, down, **look)
        up, down = higher, lower
    top.plot(t, rate, color="#000000", linewidth=0.9, label="drift")
    left = rate - sum(shares.values(), np.zeros(len(t)))
    bottom.plot(t, left, color="#000000", linewidth=0.7)
    top.axhline(0, color="#000000", linewidth=0.5)
    what = "change" if cumulative else "rate of change"
    top.set(ylabel=named(what, unit), title=title)
    bottom.set(xlabel=time, ylabel="drift − sum")
    legend(top, new)
    top.figure.align_ylabels([top, bottom])
    return np.asarray([top, bottom])


def _summed(t: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Σ rate · step over the steps before each time."""
    return np.concatenate([[0.0], np.cumsum(rate[:-1] * np.diff(t))])


_HATCHES = ("", "////", "....", "\\\\\\\\", "xxxx", "++++")
_CAUSES = ("symmetry", "work", "lattice")


def _of_balance(
    ts: Any, drift: Any, causes: Mapping[str, Any] | None
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """(times, rate, label → share), checked."""
    if all(hasattr(ts, name) for name in ("ts", "drift", *_CAUSES)):
        causes = {name: getattr(ts, name) for name in _CAUSES} if causes is None else causes
        ts, drift = ts.ts, ts.drift if drift is None else drift
    if drift is None or not causes:
        raise TypeError(
            "balance takes what dvi.noether_balance returns, or times, the drift and its causes."
        )
    t, rate = np.asarray(ts, float), np.asarray(drift, float)
    shares = {name: np.asarray(v, float) for name, v in causes.items()}
    shapes = {"ts": t.shape, "drift": rate.shape, **{n: v.shape for n, v in shares.items()}}
    if t.ndim != 1 or not len(t) or len(set(shapes.values())) > 1:
        raise ValueError(f"balance takes one number of each kind a step, shape (S,), got {shapes}.")
    return t, rate, shares


@in_style
def drift_orders(
    results: Mapping[str, DriftOrder] | Sequence[DriftOrder],
    promised: Sequence[float | None] | float | None = None,
    title: str = "Largest drift against the disturbance",
    ax: Any = None,
) -> Any:
    """Drifts over ε (`drift_order`) beside the orders that were promised.

    - `results`: label → measured order, or a sequence of them.
    - `promised`: z + 1 for each result in turn (None: no promise), or one for all; a grey line
      of that slope goes through the first point of the fit.

    Hollow points are excluded from the fit; bars at the left end mark the drift at ε = 0. Drifts
    that failed stand as crosses at the top, those exactly 0 as triangles at the bottom, and the
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
    slopes = _one_each(promised, len(results))
    axis, new = canvas(ax, (6.4, 4.8))
    left = min(order.epsilons.min() for order in results.values())
    looks = zip(results.items(), slopes, itertools.cycle(COLOURS), MARKERS * 9, strict=False)
    failed = nought = total = left_out = 0
    for (label, order), slope, colour, marker in looks:
        x, y, used = order.epsilons, np.asarray(order.drifts), order.used
        there = np.isfinite(y) & (y > 0)
        text = _slope_text(order)
        if slope is not None:
            text += f", promised {slope:g}"
        axis.loglog(x[used], y[used], marker, color=colour)
        out = there & ~used
        left_out += out.sum()
        axis.loglog(x[out], y[out], marker, color=colour, markerfacecolor="white")
        face = colour if used.any() else "white"
        axis.plot([], [], marker, color=colour, markerfacecolor=face, label=f"{label}: {text}")
        if np.isfinite(order.floor) and order.floor > 0:
            axis.plot(left * 0.7, order.floor, "_", color=colour, markersize=12, markeredgewidth=2)
        # Without a place on this axis: with that at ε = 0, where the bar would stand.
        xs, ys = np.append(x, left * 0.7), np.append(y, order.floor)
        edge = {"transform": axis.get_xaxis_transform(), "color": colour, "linestyle": "none"}
        for here, at, mark in ((~np.isfinite(ys), 0.985, "x"), (ys == 0, 0.015, "v")):
            if here.any():
                axis.plot(xs[here], np.full(here.sum(), at), mark, markersize=6, **edge)
        failed, nought = failed + int(np.sum(~np.isfinite(ys))), nought + int(np.sum(ys == 0))
        total += len(ys)
        if slope is not None and used.any():
            first = np.argmin(np.where(used, x, np.inf))
            ends = np.array([x[first], x.max()])
            guide = y[first] * (ends / x[first]) ** slope
            axis.loglog(ends, guide, color="#888888", linewidth=1, linestyle="--", zorder=1)
    if promised is not None:
        axis.plot([], [], color="#888888", linewidth=1, linestyle="--", label="slope promised")
    if left_out:
        label = "excluded from the fit"
        axis.plot([], [], "o", color="#444444", markerfacecolor="white", label=label)
    axis.plot([], [], "_", color="#444444", markersize=12, markeredgewidth=2, label="at ε = 0")
    axis.set(xscale="log", yscale="log", xlabel="ε", ylabel="largest drift", title=title)
    handles = axis.get_legend_handles_labels()[0]
    for count, mark, what in ((failed, "x", "failed"), (nought, "v", "are exactly 0")):
        if count:
            handles.append(Line2D([], [], color=PALE, marker=mark, linestyle="none",
                                  label=f"{count} of {total} drifts {what}"))  # fmt: skip
    legend(axis, new, handles)
    return axis


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
    (left, right), new = stack(
        ax, 2, "the drifts and their orders", (9.6, 4.2), ncols=2,
        gridspec_kw={"width_ratios": (5, 4)},
    )  # fmt: skip
    drifts = np.asarray(surface.drifts)
    nought, failed = drifts == 0, ~np.isfinite(drifts)
    shown = np.ma.masked_where(nought | failed, drifts)
    edges = cell_edges(surface.epsilons, log=True), cell_edges(surface.hs, log=True)
    norm = LogNorm() if shown.count() else None
    image = left.pcolormesh(*edges, shown.T, norm=norm, cmap=SHADES, rasterized=True)
    left.figure.colorbar(image, ax=left, label="largest drift")
    left.grid(False)
    left.patch.set(**HATCH)
    i, j = np.nonzero(~surface.used & ~failed)
    left.plot(
        surface.epsilons[i], surface.hs[j], "o", color="black", markerfacecolor="white",
        markersize=4, markeredgewidth=0.8, linestyle="none", label="excluded from the fit",
    )  # fmt: skip
    handles = left.get_legend_handles_labels()[0] if len(i) else []
    if nought.any():
        black = np.ma.masked_where(~nought, np.ones(drifts.shape))
        left.pcolormesh(*edges, black.T, cmap=ListedColormap([ZERO]), rasterized=True)
        handles.append(Patch(color=ZERO, label=f"{nought.sum()} of {drifts.size} exactly 0"))
    if failed.any():
        handles.append(Patch(label=f"{failed.sum()} of {drifts.size} failed", **HATCH))
    left.set(xscale="log", yscale="log", xlabel="ε", ylabel="step size h", title=title)
    measured = np.isfinite(surface.slopes)
    resolved = np.array([order.resolved for order in surface.orders])
    low, high = surface.intervals.T
    for here, face, label in (
        (measured & resolved, COLOURS[0], "order for ε → 0, 95 % interval"),
        (measured & ~resolved, "white", "not resolved: slope of the straight line"),
    ):
        if here.any():
            slopes = surface.slopes[here]
            right.errorbar(
                surface.hs[here], slopes, yerr=[slopes - low[here], high[here] - slopes], fmt="o",
                color=COLOURS[0], markerfacecolor=face, capsize=3, label=label,
            )  # fmt: skip
    if promised is not None:
        right.axhline(promised, color="#888888", linewidth=1, linestyle="--", label="promised")
        right.set_ylim(
            min([promised - 0.1, *(low[measured] - 0.05)]),
            max([promised + 0.1, *(high[measured] + 0.05)]),
        )
    for value in surface.hs[~measured]:
        right.annotate(
            "no order", (value, 0.02), xycoords=("data", "axes fraction"), rotation=90,
            ha="center", va="bottom", fontsize=8, color="#555555",
        )  # fmt: skip
    right.set(xscale="log", xlabel="step size h", ylabel="order in ε", title="Order in ε")
    right.set_xlim(*edges[1][[0, -1]])
    orders = right.get_legend_handles_labels()[0]
    if new:
        legend(left, new, handles + orders)
    else:
        legend(left, new, handles)
        legend(right, new, orders)
    return np.asarray([left, right])


def _slope_text(order: DriftOrder) -> str:
    if not np.isfinite(order.slope):
        return "no order"
    if not order.resolved:
        return f"no order resolved, slope of the line {order.slope:.2f}"
    low, high = order.interval
    half = (high - low) / 2
    digits = 3 if not half > 0 else int(np.clip(1 - np.floor(np.log10(half)), 3, 6))
    return f"slope {order.slope:.{digits}f} ± {half:.{digits}f}"


def _one_each(value: Any, count: int) -> list[float | None]:
    values: list[float | None] = [value] * count if not isinstance(value, Sequence) else [*value]
    if len(values) != count:
        raise ValueError(f"promised has {len(values)} orders for {count} results.")
    return values
