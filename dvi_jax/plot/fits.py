"""Pictures of a fit: residuals, data with the model, the loss of every step."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D

from .axes import at_edge, canvas, check_shapes, counted, given, labels_of, legend
from .states import chosen
from .style import COLOURS, GREY, MARKERS, in_style

_PANELS = 6
"""Arcs up to which each has a panel of its own."""

# --- residuals ----------------------------------------------------------------------------------


@in_style
def fit_residuals(
    fit: Any,
    arcs: int | Sequence[int] | None = None,
    component: int | Sequence[int] | None = None,
    axes: Sequence[Any] | None = None,
    names: Sequence[str] | None = None,
) -> np.ndarray:
    """Residuals in standard errors against time, and their distribution with a normal density.

    - `fit`: a `FitResult`. Its whitened residuals, observed − predicted, are drawn as they are; for
      data without errors they are divided by s, the error that was found.
    - `arcs`: numbers of those that are drawn; None: all. Up to six have a panel each, more share
      one. `component`: of the flattened values of one observation; None: all.
    - `axes`: where to draw: one `Axes` for each panel and one for the distribution.
    - `names`: of all components of one observation, for the legend.

    Dashed lines are at ±1, dotted ones at ±3 standard errors. Residuals that are not finite, such
    as those of values that were not observed, are counted below the distribution.

    **Returns** the `Axes` of the panels and, last, of the distribution, shape (panels + 1,).

    **Raises** `TypeError` for what is no fit; `ValueError` for arcs or components that are not
    there, and another number of axes or names.
    """
    check_fit(fit, "whitened", "ts", "chi2", "degrees_of_freedom")
    numbers = chosen("arcs", arcs, len(fit.whitened))
    size = 1.0 if fit.has_errors else math.sqrt(fit.chi2 / max(fit.degrees_of_freedom, 1))
    rows = {i: np.asarray(fit.whitened[i]) / (size or 1.0) for i in numbers}
    components = max(r.shape[1] for r in rows.values())
    kept = chosen("component", component, components)
    named = labels_of(names, components, "components", "names")
    panels, single = [[i] for i in numbers], len(numbers) <= _PANELS
    panels, new = panels if single else [numbers], axes is None
    axes = _residual_axes(axes, len(panels))
    every = np.concatenate(
        [r[:, [k for k in kept if k < r.shape[1]]].ravel() for r in rows.values()]
    )
    known = every[np.isfinite(every)]
    furthest = 1.08 * max(3.5, np.abs(known).max(initial=0.0))
    for axis, those in zip(axes, panels, strict=False):
        for i, k in itertools.product(those, kept):
            if k < rows[i].shape[1]:
                look = _dot(k if len(those) == 1 else i, 3.5 if len(fit.ts[i]) < 400 else 1.8)
                axis.plot(fit.ts[i], rows[i][:, k], **look, markeredgewidth=0, alpha=0.85)
        if len(panels) > 1:
            axis.set_title(f"arc {those[0]}", fontsize=9.5)
        _lines(axis, furthest)
        if furthest < 5:
            axis.set_yticks([-3, -1, 1, 3])
    _draw_distribution(axes[-1], known, furthest)
    if lost := every.size - known.size:
        axes[-1].set_xlabel(f"count\n{lost} of {every.size}\nno number")
    unit = "standard errors" if fit.has_errors else f"s = {size:.3g}"
    axes[(len(panels) - 1) // 2].set_ylabel(f"observed − predicted\n[{unit}]")
    axes[len(panels) - 1].set_xlabel("time t")
    if (single or len(numbers) == 1) and 1 < len(kept) <= len(COLOURS):
        handles = [
            Line2D([], [], markeredgewidth=0, label=named[k] or f"component {k}", **_dot(k))
            for k in kept
        ]
        if new:
            look: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "columnspacing": 1.0}
            look |= {"handletextpad": 0.1, "borderaxespad": 0.1, "ncols": min(len(kept), 4)}
            axes[0].legend(handles=handles, **look)
        else:
            legend(axes[0], new, handles, labelled=False)
    return np.asarray(axes)


def _residual_axes(axes: Sequence[Any] | None, count: int) -> list[Any]:
    """`axes` or those of a new figure, the panels shared in time and size."""
    if axes is not None:
        return given(axes, count + 1, "one for each panel and one for the distribution")
    figure = plt.figure(figsize=(7.4, 2.6 + 0.9 * (count - 1) + 0.6), layout="constrained")
    grid = figure.add_gridspec(count, 2, width_ratios=(5, 1))
    panels: list[Any] = []
    for i in range(count):
        panels.append(figure.add_subplot(grid[i, 0], sharey=panels[0] if panels else None))
        panels[-1].grid(axis="y", visible=False)
    beside = figure.add_subplot(grid[:, 1])
    beside.tick_params(labelleft=count > 1)
    return [*panels, beside]


def _dot(number: int, size: float | None = None) -> dict[str, Any]:
    """Marker and colour of a component or of an arc."""
    look = {"marker": MARKERS[number % len(MARKERS)], "color": COLOURS[number % len(COLOURS)]}
    return look | {"linestyle": "none", "markersize": size}


def _lines(axis: Any, furthest: float) -> None:
    """Lines at 0, ±1 and ±3 standard errors."""
    for at, dash in ((0, "-"), (-1, "--"), (1, "--"), (-3, ":"), (3, ":")):
        axis.axhline(at, color=GREY, linewidth=0.8, linestyle=dash)
    axis.set_ylim(-furthest, furthest)


def _draw_distribution(axis: Any, r: np.ndarray, furthest: float) -> None:
    """Histogram on its side, with the normal density of the same area."""
    edges = int(np.clip(2.5 * np.sqrt(r.size), 14, 60)) // 2 * 2 + 2
    bins = np.linspace(-furthest, furthest, edges)
    axis.hist(r, bins=bins, orientation="horizontal", color=COLOURS[5], edgecolor="none")
    y = np.linspace(-furthest, furthest, 200)
    density = np.exp(-(y**2) / 2) / np.sqrt(2 * np.pi) * r.size * (bins[1] - bins[0])
    axis.plot(density, y, color="#000000", linewidth=1.1)
    _lines(axis, furthest)
    axis.grid(visible=False)
    axis.set_xlabel("count")


# --- data and model -----------------------------------------------------------------------------


@in_style
def fit_against_data(
    fit: Any,
    arc: int = 0,
    component: int | Sequence[int] | None = None,
    curve: tuple[Any, Any] | None = None,
    ax: Any = None,
    names: Sequence[str] | None = None,
) -> Any:
    """Observations along one arc, with their errors, and the predictions of the fit.

    Data without errors have bars of the error that was found.

    - `fit`: a `FitResult`. `arc`: its number. `component`: of the flattened values of one
      observation, one or several; None: all, up to seven.
    - `curve`: (times, values) of the model on a finer grid, (T,) and (T, ...), in place of the
      straight lines between its predictions.
    - `ax`: where to draw; None: a new figure.
    - `names`: of all components of one observation, for the legend.

    **Returns** the `Axes`.

    **Raises** `TypeError` for what is no fit; `ValueError` for an arc or a component that is not
    there, a curve of another shape, or another number of names.
    """
    check_fit(fit, "ts", "observed", "predicted", "errors")
    (arc,) = chosen("arc", arc, len(fit.ts))
    ts = np.asarray(fit.ts[arc])
    seen, model = (np.asarray(x[arc]).reshape(len(ts), -1) for x in (fit.observed, fit.predicted))
    components = seen.shape[1]
    kept = chosen("component", component, components)
    named = labels_of(names, components, "components", "names")
    if component is None and len(kept) > len(COLOURS):
        raise ValueError(
            f"{len(kept)} components are too many for one picture: choose some, "
            f"component={kept[:3]}, say."
        )
    fine, curves = (np.asarray(x, float) for x in ((ts, model) if curve is None else curve))
    wanted = (
        f"curve must be (times, values), shapes (T,) and (T, ...), with {components} components"
    )
    fits = fine.ndim == 1 and curves.shape[:1] == fine.shape and curves[:1].size == components
    check_shapes(fits, wanted, times=fine, values=curves)
    found = math.sqrt(fit.chi2 / max(fit.degrees_of_freedom, 1))
    errors = np.asarray(fit.errors[arc]).reshape(seen.shape) if fit.has_errors else found
    errors = np.broadcast_to(errors, seen.shape)
    ax, new = canvas(ax, (7.0, 4.0))
    order, curves = np.argsort(fine), curves.reshape(len(fine), -1)
    for k in kept:
        name = named[k] or (f"component {k}" if components > 1 else "")
        name += ": " if name else ""
        look = _dot(k, 4 if len(ts) < 200 else 2) | {"markerfacecolor": "white", "capsize": 0}
        line = {"color": look["color"], "linewidth": 1.1, "label": f"{name}fit"}
        ax.plot(fine[order], curves[order, k], **line)
        look |= {"elinewidth": 0.9, "label": f"{name}observed"}
        ax.errorbar(ts, seen[:, k], yerr=errors[:, k], **look)
    title = f"arc {arc}" if len(fit.ts) > 1 else ""
    ax.set(xlabel="time t", ylabel="observed value", title=title)
    legend(ax, new)
    return ax


# --- how it went --------------------------------------------------------------------------------


@in_style
def learning_curve(fit: Any, ax: Any = None) -> Any:
    """The loss after each step of a fit, its stages in colours, rejected steps crossed.

    - `fit`: a `FitResult`, with its `history`. `ax`: where to draw; None: a new figure.

    A stage looks at what was observed up to its horizon; losses of different stages are not of the
    same data. The axis is logarithmic unless a loss is not positive. A loss that is no number has a
    cross at the top, and the legend counts them.

    **Returns** the `Axes`.

    **Raises** `TypeError` for what is no fit; `ValueError` for one that took no step.
    """
    check_fit(fit, "history")
    columns = ("stage", "loss", "accepted", "horizon")
    stage, loss, accepted, horizon = (np.asarray(fit.history[name]) for name in columns)
    if loss.size == 0:
        raise ValueError("the fit took no step: there is no history to draw.")
    ax, new = canvas(ax)
    steps = np.arange(1, len(loss) + 1)
    accepted = accepted.astype(bool)
    looks = zip(np.unique(stage), itertools.cycle(COLOURS[:-1]), itertools.cycle(MARKERS))
    for number, colour, marker in looks:
        here = stage == number
        until = horizon[here][0]
        what = "all data" if np.isinf(until) else f"up to {until:.3g} after the start"
        look = {"color": colour, "label": f"stage {int(number) + 1}: {what}"}
        if here.sum() <= 100:
            every = np.flatnonzero(accepted[here]).tolist()
            look |= {"marker": marker, "markersize": 4, "markevery": every}
        ax.plot(steps[here], loss[here], **look)
        if number > stage[0]:
            ax.axvline(steps[here][0] - 0.5, color=GREY, linewidth=0.8, linestyle=":")
    rejected: dict[str, Any] = {"color": "#000000", "markersize": 6, "markeredgewidth": 1.3}
    finite = np.isfinite(loss)
    if not accepted.all():
        here, look = ~accepted & finite, {"linestyle": "none", "zorder": 4, **rejected}
        ax.plot(steps[here], loss[here], "x", label="step rejected", **look)
    for text in counted({f"of {len(loss)} losses are no numbers (at the top)": np.sum(~finite)}):
        at_edge(ax, steps[~finite], "x", 0.985, label=text, zorder=4, **rejected)
    ax.set_yscale("log" if finite.any() and loss[finite].min() > 0 else "linear")
    ax.set(xlabel="step", ylabel="loss")
    ax.xaxis.get_major_locator().set_params(integer=True)
    legend(ax, new)
    return ax


# --- what is taken ------------------------------------------------------------------------------


def check_fit(fit: Any, *needs: str) -> None:
    lacking = [name for name in needs if not hasattr(fit, name)]
    if lacking:
        raise TypeError(
            f"fit must be a FitResult, as dvi.fit returns it, got {type(fit).__name__} without "
            f"{', '.join(lacking)}."
        )
