"""Pictures: one house style, readable in print and by colour-blind eyes."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from cycler import cycler
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from .invariants import DriftOrder, DriftSurface

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe & Ito's palette (2008), dark ones first; tell lines apart by marker or dash as well."""

DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)), (0, (1, 1)))

_STYLE: Any = {
    "figure.figsize": (6.4, 4.0),
    "figure.dpi": 110,
    "savefig.dpi": 160,
    "figure.constrained_layout.use": True,
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#d9d9d9",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.5,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "axes.prop_cycle": cycler(color=COLOURS),
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": True,
}


@contextmanager
def style() -> Iterator[None]:
    """The house style, for the figures made inside the block; nothing global is changed."""
    with mpl.rc_context(_STYLE):
        yield


def save(figure: Any, path: str | Path) -> Path:
    """Write the figure (type from the suffix) and close it."""
    path = Path(path)
    figure.savefig(path)
    plt.close(figure)
    return path


# Pictures of a run: each takes arrays and returns a figure; use them inside `style()`.


def changes(ts: Any, series: Mapping[str, Any], time: str, title: str) -> Figure:
    """How quantities change along a run, one panel above another.

    - `ts`: times, shape (S,). `series`: label → changes, shape (S,). `time`: label of the axis.
    """
    figure, axes = plt.subplots(
        len(series), 1, sharex=True, squeeze=False, figsize=(6.4, 1.2 + 1.35 * len(series))
    )
    for axis, (label, values), colour in zip(
        axes[:, 0], series.items(), itertools.cycle(COLOURS), strict=False
    ):
        axis.plot(ts, values, color=colour, linewidth=1.1)
        axis.set_ylabel(label, fontsize=9)
    axes[0, 0].set_title(title)
    axes[-1, 0].set_xlabel(time)
    figure.align_ylabels()
    return figure


def conserved(ts: Any, series: Mapping[str, Any], time: str, title: str) -> Figure:
    """Sizes of relative changes of conserved quantities, on one logarithmic axis."""
    figure, axis = plt.subplots()
    for (label, values), colour in zip(series.items(), itertools.cycle(COLOURS), strict=False):
        # The start itself, where the change is 0, has no place on this axis.
        axis.semilogy(ts[1:], np.asarray(values)[1:], color=colour, linewidth=0.9, label=label)
    axis.axhline(np.finfo(float).eps, color="#777777", linewidth=1, linestyle=":")
    axis.annotate(
        "rounding of one operation", (1, np.finfo(float).eps), xycoords=("axes fraction", "data"),
        ha="right", va="bottom", fontsize=8, color="#555555",
    )  # fmt: skip
    axis.set(xlabel=time, ylabel="relative change since the start", title=title)
    legend = figure.legend(loc="outside lower center", ncols=len(series))
    for line in legend.get_lines():
        line.set_linewidth(2.5)
    return figure


def trajectory(
    ts: Any, qs: Any, ps: Any, time: str, position: str | None, momentum: str | None, title: str
) -> Figure:
    """A trajectory as its shape suggests.

    One degree of freedom: (q, p). Two, or bodies in the plane or in space: orbits in the first
    two coordinates. More: every position against time. `position`, `momentum`: units or None.

    - `ts`: times, shape (S,); `qs`, `ps`: shape (S, n) or (S, bodies, dim).
    """
    ts, qs, ps = np.asarray(ts), np.asarray(qs), np.asarray(ps)
    unit = f" [{position}]" if position not in (None, "", "1") else ""
    p_unit = f" [{momentum}]" if momentum not in (None, "", "1") else ""
    figure, axis = plt.subplots(figsize=(5.6, 4.8))
    bodies = qs if qs.ndim == 3 and qs.shape[-1] in (2, 3) else None
    if qs.ndim == 2 and qs.shape[1] == 2:
        bodies = qs[:, None, :]
    if bodies is not None:
        for i, colour in zip(range(bodies.shape[1]), itertools.cycle(COLOURS), strict=False):
            x, y = bodies[:, i, 0], bodies[:, i, 1]
            axis.plot(x, y, color=colour, linewidth=0.8, alpha=0.85, linestyle=DASHES[i % 7])
            axis.plot(x[:1], y[:1], "o", color=colour, markerfacecolor="white", zorder=3)
        axis.plot([], [], "o", color="#444444", markerfacecolor="white", label="start")
        axis.set(xlabel=f"q$_1${unit}", ylabel=f"q$_2${unit}")
        axis.set_aspect("equal", adjustable="datalim")
        figure.legend(loc="outside lower right")
    elif qs.ndim >= 1 and qs[0].size == 1:
        q, p = qs.reshape(len(ts)), ps.reshape(len(ts))
        axis.plot(q, p, ".", color=COLOURS[0], markersize=2.5)
        axis.plot(q[:1], p[:1], "o", color=COLOURS[1], markerfacecolor="white", label="start")
        axis.set(xlabel=f"q{unit}", ylabel=f"p{p_unit}")
        figure.legend(loc="outside lower right")
    else:
        flat = qs.reshape(len(ts), -1)
        for i in range(flat.shape[1]):
            style = {"color": COLOURS[i % len(COLOURS)], "linestyle": DASHES[i % 7]}
            axis.plot(ts, flat[:, i], linewidth=1, label=f"q$_{{{i + 1}}}$", **style)
        axis.set(xlabel=time, ylabel=f"q{unit}")
        if flat.shape[1] <= 12:
            figure.legend(loc="outside right upper")
    axis.set_title(title)
    return figure


def planet_orbits(positions: Any, names: Sequence[str]) -> Figure:
    """Heliocentric orbits on the ecliptic [au], the inner four beside the rest.

    - `positions`: shape (times, planets, 3); `names` of the planets.
    """
    positions = np.asarray(positions)
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 5.4))
    groups = (range(min(4, len(names))), range(min(4, len(names)), len(names)))
    for axis, group, title in zip(axes, groups, ("Inner planets", "Outer planets"), strict=True):
        for i in group:
            x, y = positions[:, i, 0], positions[:, i, 1]
            colour = COLOURS[(i - group[0]) % len(COLOURS)]
            axis.plot(x, y, ".", markersize=1, color=colour, alpha=0.35, rasterized=True)
            axis.plot(
                x[:1], y[:1], _MARKERS[i - group[0]], color=colour, markersize=7,
                markeredgecolor="black", markeredgewidth=0.7, label=names[i], linestyle="none",
            )  # fmt: skip
        axis.plot(0, 0, "*", color="#E69F00", markersize=11, markeredgecolor="black")
        axis.set(xlabel="x [au]", ylabel="y [au]", title=title)
        axis.set_aspect("equal", adjustable="datalim")
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, handletextpad=0.2)
    figure.suptitle(
        "Heliocentric orbits on the ecliptic of J2000; marks: places at the start", fontsize=10
    )
    return figure


def ephemeris_comparison(
    years: Any,
    errors: Any,
    names: Sequence[str],
    perihelion: Any,
    slope: float,
    intercept: float,
) -> Figure:
    """Position errors of the planets, and Mercury's perihelion, beside an ephemeris.

    - `years`: since the start, shape (T,). `errors`: [km], shape (T, planets).
    - `perihelion`: ephemeris minus integration [″], shape (T,); `slope` [″/century] and
      `intercept` [″] of its fitted line.
    """
    years, errors, perihelion = np.asarray(years), np.asarray(errors), np.asarray(perihelion)
    figure = plt.figure(figsize=(10.4, 5.2))
    grid = figure.add_gridspec(2, 2, height_ratios=(3, 1))
    left, right = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    below = figure.add_subplot(grid[1, 1], sharex=right)
    for i, name in enumerate(names):
        x, y = _upper_envelope(years, errors[:, i])
        left.semilogy(
            x, y, color=COLOURS[i % len(COLOURS)], linewidth=1.3, marker=_MARKERS[i],
            markevery=(i * 2 % 12, 12), label=name, linestyle="-" if i < len(COLOURS) else "--",
        )  # fmt: skip
    left.set(
        xlabel="years since the start",
        ylabel="distance from the ephemeris [km]",
        title="Heliocentric position, integration − DE421",
    )
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)
    right.plot(years, perihelion, ".", color=COLOURS[0], markersize=2, label="osculating orbits")
    line = intercept + slope * years / 100
    if np.isfinite(slope):
        right.plot(
            years, line, color=COLOURS[1], linewidth=1.2, linestyle="--",
            label=f"line: {slope:.2f}″ per century",
        )  # fmt: skip
        below.plot(years, perihelion - line, color=COLOURS[0], linewidth=0.5)
        below.axhline(0, color=COLOURS[1], linewidth=1.2, linestyle="--")
    right.set(
        ylabel="ϖ(DE421) − ϖ(integration) [″]",
        title="Mercury's perihelion, DE421 − integration",
    )
    right.legend(loc="best", markerscale=3)
    right.tick_params(labelbottom=False)
    below.set(xlabel="years since the start", ylabel="minus the line [″]")
    figure.align_ylabels([right, below])
    return figure


_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")


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
    looks = zip(results.items(), slopes, itertools.cycle(COLOURS), _MARKERS * 9, strict=False)
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
        _cell_edges(surface.epsilons), _cell_edges(surface.hs), drifts.T, norm=norm, cmap="cividis",
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
    right.set_xlim(*_cell_edges(surface.hs)[[0, -1]])
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


def _cell_edges(centres: np.ndarray) -> np.ndarray:
    """Edges of cells about `centres`, half way between them on a logarithmic axis."""
    x = np.log(centres)
    middle = (x[1:] + x[:-1]) / 2
    first, last = (x[0] - middle[0], middle[-1] - x[-1]) if len(x) > 1 else (-0.3, -0.3)
    return np.exp(np.concatenate([[x[0] + first], middle, [x[-1] - last]]))


def _upper_envelope(x: np.ndarray, y: np.ndarray, pieces: int = 100) -> tuple[Any, Any]:
    """Largest value in each of about a hundred pieces: a readable line."""
    if len(x) <= 2 * pieces:
        return x[1:], y[1:]
    parts = np.array_split(np.arange(1, len(x)), pieces)
    return np.array([x[part[-1]] for part in parts]), np.array([y[part].max() for part in parts])
