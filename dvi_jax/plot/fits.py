"""Pictures of a fit: what is left over, how well parameters are known, data beside the model."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib import colormaps
from matplotlib.patches import Ellipse

from .house import COLOURS, GREY, MARKERS, canvas, given, in_style, legend

_PANELS = 6
"""Arcs up to which each has a panel of its own."""

_PARAMETERS = 12
"""Parameters up to which a corner plot is drawn unasked."""

_LINES = ((1, "--"), (3, ":"))
"""Standard errors that are marked, and how."""

# --- residuals ----------------------------------------------------------------------------------


@in_style
def fit_residuals(
    fit: Any,
    arcs: int | Sequence[int] | None = None,
    component: int | Sequence[int] | None = None,
    axes: Sequence[Any] | None = None,
    names: Sequence[str] | None = None,
) -> np.ndarray:
    """Residuals in standard errors against time, and their distribution beside a normal one.

    - `fit`: a `FitResult`. Its whitened residuals, observed − predicted, are drawn as they are; for
      data without errors they are divided by s, the error that was found.
    - `arcs`: numbers of those that are drawn; None: all. Up to six have a panel each, more share
      one. `component`: of the flattened values of one observation; None: all.
    - `axes`: where to draw: one `Axes` for each panel and one for the distribution.
    - `names`: of all components of one observation, for the legend.

    Dashed lines stand at ±1, dotted ones at ±3 standard errors. Residuals that are no numbers, such
    as those of values that were not observed, are counted below the distribution.

    **Returns** the `Axes` of the panels and, last, of the distribution, shape (panels + 1,).

    **Raises** `TypeError` for what is no fit; `ValueError` for arcs or components that are not
    there, and another number of axes or names.
    """
    _check_fit(fit, "fit_residuals", "whitened", "ts", "chi2", "degrees_of_freedom")
    numbers = _chosen(arcs, len(fit.whitened), "arc")
    size = 1.0 if fit.has_errors else math.sqrt(fit.chi2 / max(fit.degrees_of_freedom, 1))
    rows = {i: np.asarray(fit.whitened[i]) / (size or 1.0) for i in numbers}
    components = max(r.shape[1] for r in rows.values())
    kept, named = _chosen(component, components, "component"), _named(names, components)
    panels = [[i] for i in numbers] if len(numbers) <= _PANELS else [numbers]
    new = axes is None
    axes = _residual_axes(axes, len(panels))
    for axis, those in zip(axes, panels, strict=False):
        for i in those:
            _draw_residuals(axis, fit.ts[i], rows[i], kept, None if len(those) == 1 else i)
        if len(panels) > 1:
            axis.set_title(f"arc {those[0]}", fontsize=9.5)
        _lines(axis)
    every = np.concatenate([_only(r, kept).ravel() for r in rows.values()])
    total = every.size
    every = every[np.isfinite(every)]
    furthest = 1.08 * max(3.5, np.abs(every).max(initial=0.0))
    _draw_distribution(axes[-1], every, furthest)
    if lost := total - every.size:
        axes[-1].set_xlabel(f"count\n{lost} of {total}\nno number")
    unit = "standard errors" if fit.has_errors else f"s = {size:.3g}"
    label = f"observed − predicted\n[{unit}]"
    for axis in axes[:-1]:
        axis.set_ylim(-furthest, furthest)
        if furthest < 5:
            axis.set_yticks([-3, -1, 1, 3])
    axes[(len(panels) - 1) // 2].set_ylabel(label)
    axes[len(panels) - 1].set_xlabel("time t")
    if not any(len(those) > 1 for those in panels) and 1 < len(kept) <= len(COLOURS):
        _legend_of_components(axes[0], {k: named[k] for k in kept}, new)
    return np.asarray(axes)


def _residual_axes(axes: Sequence[Any] | None, count: int) -> list[Any]:
    """`axes` or those of a new figure, the panels shared in time and size."""
    if axes is not None:
        return given(axes, count + 1, "one for each panel and one for the distribution")
    figure = plt.figure(figsize=(7.4, 2.6 + 0.9 * (count - 1) + 0.6), layout="constrained")
    grid = figure.add_gridspec(count, 2, width_ratios=(5, 1))
    first = figure.add_subplot(grid[0, 0])
    panels = [first] + [figure.add_subplot(grid[i, 0], sharey=first) for i in range(1, count)]
    for axis in panels:
        axis.grid(axis="y", visible=False)
    beside = figure.add_subplot(grid[:, 1])
    beside.tick_params(labelleft=count > 1)
    return [*panels, beside]


def _draw_residuals(axis: Any, ts: Any, r: np.ndarray, kept: list[int], arc: int | None) -> None:
    for k in kept:
        if k >= r.shape[1]:
            continue
        number = k if arc is None else arc
        axis.plot(
            ts, r[:, k], MARKERS[number % len(MARKERS)], color=COLOURS[number % len(COLOURS)],
            markersize=3.5 if len(ts) < 400 else 1.8, markeredgewidth=0, alpha=0.85,
        )  # fmt: skip


def _lines(axis: Any) -> None:
    axis.axhline(0, color=GREY, linewidth=0.8)
    for at, dash in _LINES:
        for sign in (-1, 1):
            axis.axhline(sign * at, color=GREY, linewidth=0.8, linestyle=dash)


def _draw_distribution(axis: Any, r: np.ndarray, furthest: float) -> None:
    """Histogram on its side, with the normal density of the same area."""
    bins = np.linspace(
        -furthest, furthest, int(np.clip(2.5 * np.sqrt(r.size), 14, 60)) // 2 * 2 + 2
    )
    axis.hist(r, bins=bins, orientation="horizontal", color=COLOURS[5], edgecolor="none")
    y = np.linspace(-furthest, furthest, 200)
    density = np.exp(-(y**2) / 2) / np.sqrt(2 * np.pi) * r.size * (bins[1] - bins[0])
    axis.plot(density, y, color="#000000", linewidth=1.1)
    _lines(axis)
    axis.set_ylim(-furthest, furthest)
    axis.grid(visible=False)
    axis.set_xlabel("count")


def _named(names: Sequence[str] | None, components: int) -> list[str]:
    """A name for each component."""
    if names is None:
        return [f"component {k}" for k in range(components)]
    if isinstance(names, str) or len(names) != components:
        raise ValueError(f"names must be {components}, one for each component, got {names!r}.")
    return [str(name) for name in names]


def _legend_of_components(axis: Any, names: dict[int, str], new: bool) -> None:
    handles = [
        axis.plot([], [], MARKERS[k % len(MARKERS)], color=COLOURS[k % len(COLOURS)],
                  markeredgewidth=0, label=name)[0]
        for k, name in names.items()
    ]  # fmt: skip
    if not new:
        legend(axis, new, handles)
        return
    axis.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=min(len(names), 4),
        handletextpad=0.1, borderaxespad=0.1, columnspacing=1.0,
    )  # fmt: skip


# --- how well parameters are known --------------------------------------------------------------


_WIDE = 3.2
"""Standard errors that a panel shows to either side."""


class _Scale(NamedTuple):
    """How a parameter is drawn: (x − `zero`) / `unit`, with the label of that axis."""

    name: str
    value: float
    sigma: float
    zero: float
    unit: float
    label: str

    def __call__(self, x: Any) -> Any:
        return (x - self.zero) / self.unit


@in_style
def fit_corner(
    fit: Any,
    params: Sequence[str] | None = None,
    samples: Any = None,
    axes: Any = None,
) -> np.ndarray:
    r"""Covariance of the parameters, pair by pair.

    Below the diagonal the ellipses dᵀC⁻¹d = 1 and 4 about the fit, whose shadows on the axes are
    ±1 and ±2 standard errors (of a normal distribution they hold 39 % and 86 %); on it the normal
    densities; above it the correlations, in colours.

    - `fit`: a `FitResult`, or anything else with `names`, `covariance` and the values `x` (n,) or
      draws `x` with their `mean` (`dvi.Samples`).
    - `params`: names that are drawn, in this order; None: all, up to twelve.
    - `samples`: draws that are shown under the ellipses: `dvi.Samples`, or name → draws of any
      shape.
    - `axes`: array of shape (n, n) of `Axes`; None: a new figure.

    A parameter that is known much better than its size is drawn from the fit's value on.

    **Returns** the `Axes`, shape (n, n).

    **Raises** `TypeError` for what is no fit; `ValueError` for one without a covariance,
    parameters that the data do not determine, and names that are not there.
    """
    _check_fit(fit, "fit_corner", "names", "x", "covariance")
    numbers, values = _of_parameters(fit, params)
    C = np.asarray(fit.covariance)[np.ix_(numbers, numbers)]
    scales = [
        _scale(fit.names[i], float(values[i]), float(np.sqrt(C[k, k])))
        for k, i in enumerate(numbers)
    ]
    draws = None if samples is None else _draws(samples, [s.name for s in scales])
    axes = _corner_axes(axes, len(scales))
    for i, j in np.ndindex(axes.shape):
        axis = axes[i, j]
        if i == j:
            _draw_marginal(axis, scales[i], None if draws is None else draws[i])
        elif i > j:
            pair = C[np.ix_([j, i], [j, i])]
            two = None if draws is None else (draws[j], draws[i])
            _draw_pair(axis, scales[j], scales[i], pair, two)
        else:
            _draw_correlation(axis, C[i, j] / (scales[i].sigma * scales[j].sigma))
        _dress_corner(axis, i, j, scales)
    axes[0, 0].figure.align_labels()
    return axes


def _of_parameters(fit: Any, params: Sequence[str] | None) -> tuple[list[int], np.ndarray]:
    """(numbers of the parameters that are drawn, values of all), checked."""
    C = np.asarray(fit.covariance)
    names = list(fit.names)
    values = np.asarray(fit.x if np.ndim(fit.x) == 1 else fit.mean)
    known = [n for n, v in zip(names, np.diag(C), strict=True) if np.isfinite(v) and v > 0]
    if not known:
        raise ValueError(
            "the fit has no covariance to draw: it had too many parameters for a Jacobian, ended "
            "at a failure, or the data determine none of its parameters."
        )
    if isinstance(params, str):
        params = [params]
    if params is None:
        if len(names) > _PARAMETERS:
            raise ValueError(
                f"{len(names)} parameters are too many for one picture: choose some, "
                f"params={names[:3]}, say."
            )
        params = names
    for name in params:
        if name not in names:
            raise ValueError(f"no parameter is called {name!r}: there are {', '.join(names)}.")
        if name not in known:
            raise ValueError(
                f"the data do not determine {name}: it has no finite variance. Those that have: "
                f"params={known}."
            )
    if len(set(params)) < len(params) or len(params) == 0:
        raise ValueError(f"params must be different names, one or more, got {list(params)}.")
    return [names.index(n) for n in params], values


def _draws(samples: Any, names: list[str]) -> list[np.ndarray]:
    """Draws of each of the names, flat."""
    found = getattr(samples, "samples", samples)
    if not isinstance(found, Mapping):
        raise TypeError(
            "samples must be a dvi.Samples or a dict of names with arrays of draws, got "
            f"{type(samples).__name__}."
        )
    for name in names:
        if name not in found:
            raise ValueError(f"samples has no {name!r}: there are {', '.join(map(str, found))}.")
    flat = [np.ravel(np.asarray(found[n], float)) for n in names]
    if len({len(f) for f in flat}) > 1:
        raise ValueError("samples must hold the same number of draws for each name.")
    return flat


def _scale(name: str, value: float, sigma: float) -> _Scale:
    """Ticks of few digits: counted from the value where it has many more than its error."""
    near = abs(value) < 30 * sigma
    exponent = math.floor(math.log10(_WIDE * sigma + (abs(value) if near else 0.0)))
    exponent = 0 if -2 <= exponent <= 2 else exponent
    unit = "" if exponent == 0 else f"\n[$10^{{{exponent}}}$]"
    if near:
        return _Scale(name, value, sigma, 0.0, 10.0**exponent, name + unit)
    place = math.floor(math.log10(sigma)) - 1  # that of the last digit that is worth writing
    zero, size = round(value, -place), math.floor(math.log10(abs(value)))
    plain = f"{zero:.{max(0, -place)}f}"
    text = plain if -4 <= size <= 6 else f"{zero:.{max(0, size - place)}e}"
    sign = "−" if zero >= 0 else "+"
    return _Scale(
        name, value, sigma, zero, 10.0**exponent, f"{name} {sign} {text.lstrip('-')}{unit}"
    )


def _corner_axes(axes: Any, n: int) -> np.ndarray:
    if axes is not None:
        found = np.asarray(axes, object)
        for axis in found.flat:
            canvas(axis)
        if found.shape != (n, n):
            raise ValueError(
                f"axes must have shape {(n, n)} for {n} parameters, not {found.shape}."
            )
        return found
    side = 1.3 + max(1.7, 1.9 - 0.05 * n) * n
    return plt.subplots(n, n, figsize=(side, side), squeeze=False, layout="constrained")[1]


def _draw_marginal(axis: Any, scale: _Scale, draws: np.ndarray | None) -> None:
    centre, sigma = scale(scale.value), scale.sigma / scale.unit
    x = centre + sigma * np.linspace(-_WIDE, _WIDE, 200)
    if draws is not None:
        axis.hist(
            scale(draws), bins=np.linspace(x[0], x[-1], 33), density=True, color="#c8c8c8",
            edgecolor="none",
        )  # fmt: skip
    density = np.exp(-(((x - centre) / sigma) ** 2) / 2) / (sigma * np.sqrt(2 * np.pi))
    axis.plot(x, density, color=COLOURS[0])
    for sign in (-1, 1):
        axis.axvline(centre + sign * sigma, color=GREY, linewidth=0.8, linestyle="--")
    axis.set_ylim(bottom=0)


def _draw_pair(
    axis: Any, x: _Scale, y: _Scale, C: np.ndarray, draws: tuple[np.ndarray, np.ndarray] | None
) -> None:
    """Ellipses of one pair of parameters over its draws."""
    units = np.array([x.unit, y.unit])
    centre = (x(x.value), y(y.value))
    if draws is not None:
        axis.plot(
            x(draws[0]), y(draws[1]), ".", color="#8c8c8c", alpha=min(1.0, 600 / len(draws[0])),
            markersize=2.5, markeredgewidth=0, rasterized=True, zorder=1,
        )  # fmt: skip
    # Half axes of dᵀC⁻¹d = 1 along the eigenvectors, in the units of the panel.
    values, vectors = np.linalg.eigh(C / np.outer(units, units))
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    for size, look in ((1, {"linewidth": 1.6}), (2, {"linewidth": 1.0, "linestyle": "--"})):
        width, height = 2 * size * np.sqrt(np.maximum(values[::-1], 0.0))
        axis.add_patch(
            Ellipse(centre, width, height, angle=angle, fill=False, edgecolor=COLOURS[0], zorder=3,
                    **look)
        )  # fmt: skip
    axis.plot(*centre, "+", color=COLOURS[1], markersize=7, markeredgewidth=1.6, zorder=4)


def _draw_correlation(axis: Any, value: float) -> None:
    """A number on a colour from −1 (orange) to 1 (purple)."""
    axis.set_facecolor(colormaps["PuOr"]((1 + 0.6 * value) / 2))
    digits = 2 if abs(value) < 0.995 else 4
    text = f"{value:+.{digits}f}" if abs(value) >= 0.005 else "0.00"
    axis.text(
        0.5, 0.5, text.replace("-", "−"), transform=axis.transAxes, ha="center",
        va="center", fontsize=9 + 4 * abs(value),
    )  # fmt: skip


def _dress_corner(axis: Any, i: int, j: int, scales: list[_Scale]) -> None:
    axis.grid(visible=False)
    if i < j:
        axis.set(xticks=[], yticks=[])
        for spine in axis.spines.values():
            spine.set_visible(False)
        return
    limits = [(s(s.value) - _WIDE * s.sigma / s.unit, s(s.value) + _WIDE * s.sigma / s.unit)
              for s in scales]  # fmt: skip
    axis.set_xlim(*limits[j])
    axis.locator_params(axis="x", nbins=4)
    last = i == len(scales) - 1
    axis.tick_params(axis="x", labelbottom=last)
    axis.set_xlabel(scales[j].label if last else "")
    if i == j:
        axis.set_yticks([])
        axis.set_title(
            f"{scales[i].name}\n{_with_error(scales[i].value, scales[i].sigma)}",
            fontsize=9, loc="center",
        )  # fmt: skip
        return
    axis.set_ylim(*limits[i])
    axis.locator_params(axis="y", nbins=4)
    axis.tick_params(axis="y", labelleft=j == 0)
    axis.set_ylabel(scales[i].label if j == 0 else "")


def _with_error(x: float, sigma: float) -> str:
    """``1.00063 ± 0.00002``, with two digits of the error."""
    digits = 1 - math.floor(math.log10(sigma))
    size = math.floor(math.log10(abs(x))) if x else 0
    if 0 <= digits <= 7 and size <= 6:
        text = f"{x:.{digits}f} ± {sigma:.{digits}f}"
    elif size < math.floor(math.log10(sigma)):
        text = f"{x:.1e} ± {sigma:.1e}"
    else:
        text = f"{x:.{max(size + digits, 1)}e} ± {sigma:.1e}"
    return text.replace("-", "−")


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
    """What was observed along one arc, with its errors, and what the fit predicts.

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
    _check_fit(fit, "fit_against_data", "ts", "observed", "predicted", "errors")
    (arc,) = _chosen(arc, len(fit.ts), "arc")
    ts = np.asarray(fit.ts[arc])
    seen, model = (np.asarray(x[arc]).reshape(len(ts), -1) for x in (fit.observed, fit.predicted))
    kept, named = _chosen(component, seen.shape[1], "component"), _named(names, seen.shape[1])
    if component is None and len(kept) > len(COLOURS):
        raise ValueError(
            f"{len(kept)} components are too many for one picture: choose some, "
            f"component={kept[:3]}, say."
        )
    fine = (ts, model) if curve is None else _curve(curve, seen.shape[1])
    found = math.sqrt(fit.chi2 / max(fit.degrees_of_freedom, 1))
    errors = np.asarray(fit.errors[arc]).reshape(seen.shape) if fit.has_errors else found
    errors = np.broadcast_to(errors, seen.shape)
    ax, new = canvas(ax, (7.0, 4.0))
    order = np.argsort(fine[0])
    for k in kept:
        colour = COLOURS[k % len(COLOURS)]
        name = f"{named[k]}: " if seen.shape[1] > 1 or names is not None else ""
        ax.plot(fine[0][order], fine[1][order, k], color=colour, linewidth=1.1,
                label=f"{name}fit")  # fmt: skip
        bars = errors[:, k]
        ax.errorbar(
            ts, seen[:, k], yerr=bars, color=colour,
            fmt=MARKERS[k % len(MARKERS)], markersize=4 if len(ts) < 200 else 2, capsize=0,
            elinewidth=0.9, markerfacecolor="white", label=f"{name}observed",
        )  # fmt: skip
    title = f"arc {arc}" if len(fit.ts) > 1 else ""
    ax.set(xlabel="time t", ylabel="observed value", title=title)
    legend(ax, new)
    return ax


def _curve(curve: Any, components: int) -> tuple[np.ndarray, np.ndarray]:
    ts, values = (np.asarray(x, float) for x in curve)
    if ts.ndim != 1 or values.shape[:1] != ts.shape or values[:1].size != components:
        raise ValueError(
            f"curve must be (times, values) of shapes (T,) and (T, ...) with {components} "
            f"components, got {ts.shape} and {values.shape}."
        )
    return ts, values.reshape(len(ts), -1)


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
    _check_fit(fit, "learning_curve", "history")
    stage, loss, accepted, horizon = (
        np.asarray(fit.history[n]) for n in ("stage", "loss", "accepted", "horizon")
    )
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
        few = here.sum() <= 100
        ax.plot(
            steps[here], loss[here], color=colour, marker=marker if few else None, markersize=4,
            markevery=np.flatnonzero(accepted[here]).tolist() if few else None,
            label=f"stage {int(number) + 1}: {what}",
        )  # fmt: skip
        if number > stage[0]:
            ax.axvline(steps[here][0] - 0.5, color=GREY, linewidth=0.8, linestyle=":")
    rejected = {"color": "#000000", "markersize": 6, "markeredgewidth": 1.3, "linestyle": "none"}
    finite = np.isfinite(loss)
    if not accepted.all():
        here = ~accepted & finite
        ax.plot(steps[here], loss[here], "x", label="step rejected", zorder=4, **rejected)
    if not finite.all():
        where = {"transform": ax.get_xaxis_transform(), "zorder": 4, **rejected}
        ax.plot(
            steps[~finite], np.full(np.sum(~finite), 0.985), "x", markerfacecolor="none",
            label=f"{np.sum(~finite)} of {len(loss)} losses are no numbers (at the top)", **where,
        )  # fmt: skip
    ax.set_yscale("log" if finite.any() and loss[finite].min() > 0 else "linear")
    ax.set(xlabel="step", ylabel="loss")
    ax.xaxis.get_major_locator().set_params(integer=True)
    legend(ax, new)
    return ax


# --- what is taken ------------------------------------------------------------------------------


def _check_fit(fit: Any, who: str, *needs: str) -> None:
    lacking = [name for name in needs if not hasattr(fit, name)]
    if lacking:
        raise TypeError(
            f"{who} takes a FitResult, as dvi.fit returns it, got {type(fit).__name__} without "
            f"{', '.join(lacking)}."
        )


def _chosen(which: Any, count: int, called: str) -> list[int]:
    """Numbers below `count`: all for None."""
    if which is None:
        return list(range(count))
    chosen = [which] if np.ndim(which) == 0 else list(which)
    for i in chosen:
        is_whole = isinstance(i, int | np.integer) and not isinstance(i, bool)
        if not is_whole or not 0 <= i < count:
            raise ValueError(f"there is no {called} {i!r}: they are numbered 0 to {count - 1}.")
    if not chosen:
        raise ValueError(f"choose at least one {called}.")
    return [int(i) for i in chosen]


def _only(r: np.ndarray, kept: list[int]) -> np.ndarray:
    return r[:, [k for k in kept if k < r.shape[1]]]
