"""Pictures of what is conserved: drifts, their orders in ε and their causes."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from ..invariants import DriftOrder, DriftSurface
from .house import COLOURS, DASHES, MARKERS, cell_edges


def balance(
    ts: Any, drift: Any, causes: Mapping[str, Any], time: str = "time t", title: str = ""
) -> Figure:
    """The drift of an invariant and its causes (`noether_balance`), and how well they add up.

    - `ts`: start of each step, shape (S,); `drift`: rate of change, shape (S,).
    - `causes`: label → its share of the rate, shape (S,); drawn on one axis with the drift, and
      below them what the sum leaves.
    """
    figure, (top, bottom) = plt.subplots(
        2, 1, sharex=True, figsize=(6.4, 4.6), height_ratios=(3, 1)
    )
    looks = zip(causes.items(), itertools.cycle(COLOURS[:-1]), DASHES[1:], strict=False)
    for (label, values), colour, dash in looks:
        top.plot(ts, values, color=colour, linestyle=dash, label=label)
    top.plot(ts, drift, color="#000000", linewidth=0.9, label="drift")
    left = np.asarray(drift) - sum(np.asarray(v) for v in causes.values())
    bottom.plot(ts, left, color="#000000", linewidth=0.7)
    top.set(ylabel="rate of change", title=title)
    bottom.set(xlabel=time, ylabel="drift − sum")
    figure.legend(loc="outside lower center", ncols=len(causes) + 1)
    figure.align_ylabels()
    return figure


def drift_orders(
    results: Mapping[str, DriftOrder] | Sequence[DriftOrder],
    promised: Sequence[float | None] | float | None = None,
    title: str = "Largest drift against the disturbance",
) -> Figure:
    """Drifts over ε (`drift_order`) beside the orders that were promised.

    - `results`: label → measured order, or a sequence of them.
    - `promised`: z + 1 for each result in turn (None: no promise), or one for all; a grey line
      of that slope goes through the first point of the fit.

    Hollow points are excluded from the fit; bars at the left end mark the drift at ε = 0.
    """
    if not isinstance(results, Mapping):
        results = {f"observable {i}": order for i, order in enumerate(results, 1)}
    slopes = _one_each(promised, len(results))
    figure, axis = plt.subplots(figsize=(6.4, 4.8), layout="constrained")
    left = min(order.epsilons.min() for order in results.values())
    looks = zip(results.items(), slopes, itertools.cycle(COLOURS), MARKERS * 9, strict=False)
    for (label, order), slope, colour, marker in looks:
        x, y, used = order.epsilons, order.drifts, order.used
        text = _slope_text(order)
        if slope is not None:
            text += f", promised {slope:g}"
        axis.loglog(x[used], y[used], marker, color=colour)
        axis.loglog(x[~used], y[~used], marker, color=colour, markerfacecolor="white")
        face = colour if used.any() else "white"
        axis.plot([], [], marker, color=colour, markerfacecolor=face, label=f"{label}: {text}")
        axis.plot(left * 0.7, order.floor, "_", color=colour, markersize=12, markeredgewidth=2)
        if slope is not None and used.any():
            first = np.argmin(np.where(used, x, np.inf))
            ends = np.array([x[first], x.max()])
            guide = y[first] * (ends / x[first]) ** slope
            axis.loglog(ends, guide, color="#888888", linewidth=1, linestyle="--", zorder=1)
    if promised is not None:
        axis.plot([], [], color="#888888", linewidth=1, linestyle="--", label="slope promised")
    axis.plot([], [], "o", color="#444444", markerfacecolor="white", label="excluded from the fit")
    axis.plot([], [], "_", color="#444444", markersize=12, markeredgewidth=2, label="at ε = 0")
    axis.set(xlabel="ε", ylabel="largest drift", title=title)
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def drift_surface(
    surface: DriftSurface,
    promised: float | None = None,
    title: str = "Largest drift over ε and h",
) -> Figure:
    """Drifts over ε and h (`drift_surface`), and their orders in ε at each h.

    - `promised`: z + 1. Dots mark what is excluded from the fits; bars are 95 % intervals.
    """
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(9.6, 4.2), width_ratios=(5, 4), layout="constrained"
    )
    drifts = np.ma.masked_invalid(surface.drifts)
    norm = LogNorm() if drifts.count() and drifts.min() > 0 else None
    image = left.pcolormesh(
        cell_edges(surface.epsilons), cell_edges(surface.hs), drifts.T, norm=norm, cmap="cividis",
        rasterized=True,
    )  # fmt: skip
    figure.colorbar(image, ax=left, label="largest drift")
    left.grid(False)
    left.set_facecolor("#d0d0d0")
    i, j = np.nonzero(~surface.used & np.isfinite(surface.drifts))
    left.plot(
        surface.epsilons[i], surface.hs[j], "o", color="black", markerfacecolor="white",
        markersize=4, markeredgewidth=0.8, label="excluded from the fit",
    )  # fmt: skip
    left.plot([], [], "s", color="#d0d0d0", markersize=8, label="failed")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    left.set(xscale="log", yscale="log", xlabel="ε", ylabel="step size h", title=title)
    measured = np.isfinite(surface.slopes)
    h, slopes = surface.hs[measured], surface.slopes[measured]
    low, high = surface.intervals[measured].T
    right.errorbar(
        h, slopes, yerr=[slopes - low, high - slopes], fmt="o", color=COLOURS[0], capsize=3,
        label="fit, 95 % interval",
    )  # fmt: skip
    limits = np.array([order.limit for order in surface.orders])
    right.plot(
        surface.hs, limits, "s", color=COLOURS[1], markerfacecolor="none", label="limit for ε → 0"
    )
    if promised is not None:
        right.axhline(promised, color="#888888", linewidth=1, linestyle="--", label="promised")
        right.set_ylim(min([promised - 0.1, *(low - 0.05)]), max([promised + 0.1, *(high + 0.05)]))
    for value in surface.hs[~measured]:
        right.annotate(
            "no order", (value, 0.02), xycoords=("data", "axes fraction"), rotation=90,
            ha="center", va="bottom", fontsize=8, color="#555555",
        )  # fmt: skip
    right.set(xscale="log", xlabel="step size h", ylabel="order in ε", title="Order in ε")
    right.set_xlim(*cell_edges(surface.hs)[[0, -1]])
    right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, columnspacing=1)
    return figure


def _slope_text(order: DriftOrder) -> str:
    if not np.isfinite(order.slope):
        return "no order"
    low, high = order.interval
    return f"slope {order.slope:.3f} ± {(high - low) / 2:.3f}"


def _one_each(value: Any, count: int) -> list[float | None]:
    values: list[float | None] = [value] * count if not isinstance(value, Sequence) else [*value]
    if len(values) != count:
        raise ValueError(f"promised has {len(values)} orders for {count} results.")
    return values
