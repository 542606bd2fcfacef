"""Pictures of a run: each takes arrays and returns a figure; use them inside `style()`."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from .house import COLOURS, DASHES, MARKERS


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
                x[:1], y[:1], MARKERS[i - group[0]], color=colour, markersize=7,
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
            x, y, color=COLOURS[i % len(COLOURS)], linewidth=1.3, marker=MARKERS[i],
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


def _upper_envelope(x: np.ndarray, y: np.ndarray, pieces: int = 100) -> tuple[Any, Any]:
    """Largest value in each of about a hundred pieces: a readable line."""
    if len(x) <= 2 * pieces:
        return x[1:], y[1:]
    parts = np.array_split(np.arange(1, len(x)), pieces)
    return np.array([x[part[-1]] for part in parts]), np.array([y[part].max() for part in parts])
