"""Pictures of a fit: residuals, data with the model, the loss of every step, covariances."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.patches import Ellipse

from ..base.checks import instance
from . import axes as draw
from .axes import canvas, counts_text, entry, labels_of, legend, stack
from .states import selected_numbers
from .style import COLOURS, GREY, MARKERS, in_style, sign_text

_PANELS, _PARAMETERS, _WIDE = 6, 12, 3.2
"""Arcs up to which each has a panel of its own; parameters that are drawn without a selection;
standard errors to either side in a panel of a parameter."""


def _check(fit: Any, *needs: str) -> None:
    draw.check_attributes(fit, needs, "fit must be a FitResult, as dvi.fit returns it")


def _dot(number: int, size: float | None = None) -> dict[str, Any]:
    """Marker and colour of a component or of an arc."""
    look = {"marker": MARKERS[number % len(MARKERS)], "c": COLOURS[number % len(COLOURS)]}
    return look | {"ls": "none", "ms": size}


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
      data without errors they are divided by s, the estimated error.
    - `arcs`: numbers of those that are drawn; None: all. Up to six have a panel each, more share
      one. `component`: of the flattened values of one observation; None: all.
    - `axes`: one `Axes` for each panel and one for the distribution; None: a new figure.
    - `names`: of all components of one observation, for the legend.

    Dashed lines are at ±1, dotted ones at ±3 standard errors. Residuals that are not finite, such
    as those of values that were not observed, are counted below the distribution.

    **Returns** the `Axes` of the panels and, last, of the distribution, shape (panels + 1,).
    **Raises** `TypeError` for anything but a fit; `ValueError` for arcs or components that do not
    exist, and another number of axes or names.
    """
    _check(fit, "whitened", "ts", "chi2", "degrees_of_freedom")
    numbers = selected_numbers("arcs", arcs, len(fit.whitened))
    size = 1.0 if fit.has_errors else math.sqrt(fit.chi2 / max(fit.degrees_of_freedom, 1))
    rows = {i: np.asarray(fit.whitened[i]) / (size or 1.0) for i in numbers}
    components = max(r.shape[1] for r in rows.values())
    columns = selected_numbers("component", component, components)
    texts = labels_of(names, components, "components", "names")
    panels = [[i] for i in numbers] if len(numbers) <= _PANELS else [numbers]
    count, new = len(panels), axes is None
    height = 2.6 + 0.9 * (count - 1) + 0.6
    purpose = "one for each panel and one for the distribution"
    places = [[f"panel {i}", "distribution"] for i in range(count)]
    drawn_axes, _ = stack(axes, places, purpose, (7.4, height), width_ratios=(5, 1))
    if new:  # a mosaic lists the distribution after the first panel
        drawn_axes.append(drawn_axes.pop(1))
        for axis in drawn_axes[:count]:
            axis.grid(axis="y", visible=False)
        for axis in drawn_axes[1:count]:
            axis.sharey(drawn_axes[0])
        drawn_axes[-1].tick_params(labelleft=count > 1)
    residuals = [rows[i][:, k] for i in numbers for k in columns if k < rows[i].shape[1]]
    residuals = np.concatenate(residuals)
    finite = residuals[np.isfinite(residuals)]
    furthest = 1.08 * max(3.5, np.abs(finite).max(initial=0.0))
    for axis, panel in zip(drawn_axes, panels, strict=False):
        for i, k in itertools.product(panel, columns):
            if k < rows[i].shape[1]:
                look = _dot(k if len(panel) == 1 else i, 3.5 if len(fit.ts[i]) < 400 else 1.8)
                axis.plot(fit.ts[i], rows[i][:, k], **look, mew=0, alpha=0.85)
        if count > 1:
            axis.set_title(f"arc {panel[0]}", fontsize=9.5)
        _lines(axis, furthest)
        if furthest < 5:
            axis.set_yticks([-3, -1, 1, 3])
    _draw_distribution(drawn_axes[-1], finite, furthest)
    if invalid := residuals.size - finite.size:
        drawn_axes[-1].set_xlabel(f"count\n{invalid} of {residuals.size}\nnot finite")
    unit = "standard errors" if fit.has_errors else f"s = {size:.3g}"
    drawn_axes[(count - 1) // 2].set_ylabel(f"observed − predicted\n[{unit}]")
    drawn_axes[count - 1].set_xlabel("time t")
    if len(panels[0]) == 1 and 1 < len(columns) <= len(COLOURS):
        handles = [entry(texts[k] or f"component {k}", mew=0, **_dot(k)) for k in columns]
        if new:
            look = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "columnspacing": 1.0}
            look |= {"handletextpad": 0.1, "borderaxespad": 0.1, "ncols": min(len(columns), 4)}
            drawn_axes[0].legend(handles=handles, **look)
        else:
            legend(drawn_axes[0], new, handles, artists=False)
    return np.asarray(drawn_axes)


def _lines(axis: Any, furthest: float) -> None:
    """Lines at 0, ±1 and ±3 standard errors."""
    for height, dash in ((0, "-"), (-1, "--"), (1, "--"), (-3, ":"), (3, ":")):
        axis.axhline(height, c=GREY, lw=0.8, ls=dash)
    axis.set_ylim(-furthest, furthest)


def _draw_distribution(axis: Any, r: np.ndarray, furthest: float) -> None:
    """Histogram on its side, with the normal density of the same area."""
    edges = int(np.clip(2.5 * np.sqrt(r.size), 14, 60)) // 2 * 2 + 2
    bins = np.linspace(-furthest, furthest, edges)
    axis.hist(r, bins=bins, orientation="horizontal", color=COLOURS[5], edgecolor="none")
    y = np.linspace(-furthest, furthest, 200)
    density = np.exp(-(y**2) / 2) / np.sqrt(2 * np.pi) * r.size * (bins[1] - bins[0])
    axis.plot(density, y, c="#000000", lw=1.1)
    _lines(axis, furthest)
    axis.grid(visible=False)
    axis.set_xlabel("count")


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

    Data without errors have bars of the estimated error. The predictions are joined by a line where
    that is close to the model's curve (within a hundredth of its range); else they are crosses.

    - `fit`: a `FitResult`. `arc`: its number. `component`: of the flattened values of one
      observation, one or several; None: all, up to seven.
    - `curve`: (times, values) of the model on a finer grid, (T,) and (T, ...), in place of its
      predictions.
    - `names`: of all components of one observation, for the legend.

    **Returns** the `Axes`. **Raises** `TypeError` for anything but a fit; `ValueError` for an arc
    or a component that does not exist, a curve of another shape, or another number of names.
    """
    _check(fit, "ts", "observed", "predicted", "errors")
    (arc,) = selected_numbers("arc", arc, len(fit.ts))
    ts = np.asarray(fit.ts[arc])
    pair = fit.observed[arc], fit.predicted[arc]
    observations, model = (np.asarray(x).reshape(len(ts), -1) for x in pair)
    components = observations.shape[1]
    columns = selected_numbers("component", component, components)
    texts = labels_of(names, components, "components", "names")
    if component is None:
        draw.at_most(len(COLOURS), len(columns), "components", f"component={columns[:3]}")
    fine, curves = (np.asarray(x, float) for x in ((ts, model) if curve is None else curve))
    shapes = f"shapes (T,) and (T, ...), with {components} components"
    fits = fine.ndim == 1 and curves.shape[:1] == fine.shape and curves[:1].size == components
    draw.check_shapes(fits, f"curve must be (times, values), {shapes}", times=fine, values=curves)
    estimate = math.sqrt(fit.chi2 / max(fit.degrees_of_freedom, 1))
    errors = np.asarray(fit.errors[arc]).reshape(observations.shape) if fit.has_errors else estimate
    errors = np.broadcast_to(errors, observations.shape)
    ax, new = canvas(ax, (7.0, 4.0))
    order, curves = np.argsort(fine), curves.reshape(len(fine), -1)
    for k in columns:
        name = texts[k] or (f"component {k}" if components > 1 else "")
        name += ": " if name else ""
        look = _dot(k, 4 if len(ts) < 200 else 2) | {"mfc": "white", "capsize": 0}
        x, y = fine[order], curves[order, k]
        line = {"c": look["c"], "lw": 1.1, "label": f"{name}fit"}
        if curve is None and not _is_smooth(x, y):
            line |= {"ls": "none", "marker": "x", "ms": 5, "zorder": 3}
        ax.plot(x, y, **line)
        look |= {"elinewidth": 0.9, "label": f"{name}observed"}
        ax.errorbar(ts, observations[:, k], yerr=errors[:, k], **look)
    title = f"arc {arc}" if len(fit.ts) > 1 else ""
    ax.set(xlabel="time t", ylabel="observed value", title=title)
    legend(ax, new)
    return ax


def _is_smooth(x: np.ndarray, y: np.ndarray) -> bool:
    """Whether straight lines between the points are within a hundredth of the range of a curve.

    Its distance from them is h²|y″|/8, with y″ from three neighbours.
    """
    x, y = x[np.isfinite(y)], y[np.isfinite(y)]
    if len(x) < 3:
        return False
    h = np.diff(x)
    with np.errstate(divide="ignore", invalid="ignore"):
        bend = np.diff(np.diff(y) / h) * np.maximum(h[1:], h[:-1]) ** 2 / (h[1:] + h[:-1]) / 4
    return bool((np.abs(bend) <= 0.01 * np.ptp(y)).all())


@in_style
def learning_curve(fit: Any, ax: Any = None) -> Any:
    """The loss after each step of a fit: a colour for each stage, a cross for a rejected step.

    `fit`: a `FitResult`, with its `history`. A stage uses the observations up to its horizon, so
    that losses of different stages are not of the same data. The axis is logarithmic unless a loss
    is not positive. Losses that are not finite are crosses at the top, counted in the legend.

    **Returns** the `Axes`. **Raises** `TypeError` for anything but a fit; `ValueError` for one that
    took no step.
    """
    _check(fit, "history")
    columns = ("stage", "loss", "accepted", "horizon")
    stage, loss, is_accepted, horizon = (np.asarray(fit.history[name]) for name in columns)
    draw.check_not_empty("fit.history", loss, "the fit took no step, see fit.status")
    ax, new = canvas(ax)
    steps, finite = np.arange(1, len(loss) + 1), np.isfinite(loss)
    is_accepted = is_accepted.astype(bool)
    looks = zip(np.unique(stage), itertools.cycle(COLOURS[:-1]), itertools.cycle(MARKERS))
    for number, colour, marker in looks:
        rows = stage == number
        end = horizon[rows][0]
        data = "all data" if np.isinf(end) else f"t ≤ t0 + {end:.3g}"
        look = {"c": colour, "label": f"stage {int(number) + 1}: {data}"}
        if rows.sum() <= 100:
            places = np.flatnonzero(is_accepted[rows]).tolist()
            look |= {"marker": marker, "ms": 4, "markevery": places}
        ax.plot(steps[rows], loss[rows], **look)
        if number > stage[0]:
            ax.axvline(steps[rows][0] - 0.5, c=GREY, lw=0.8, ls=":")
    cross: dict[str, Any] = {"c": "#000000", "ms": 6, "mew": 1.3, "zorder": 4}
    if not is_accepted.all():
        rows = ~is_accepted & finite
        ax.plot(steps[rows], loss[rows], "x", label="step rejected", **cross)
    cause = f"of {len(loss)} losses are not finite (at the top)"
    for text in counts_text({cause: np.sum(~finite)}):
        draw.at_edge(ax, steps[~finite], "x", 0.985, label=text, **cross)
    ax.set_yscale("log" if finite.any() and loss[finite].min() > 0 else "linear")
    ax.set(xlabel="step", ylabel="loss")
    ax.xaxis.get_major_locator().set_params(integer=True)
    legend(ax, new)
    return ax


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

    @property
    def limits(self) -> tuple[float, float]:
        """Limits of a panel, in its units."""
        return self(self.value - _WIDE * self.sigma), self(self.value + _WIDE * self.sigma)


@in_style
def fit_corner(
    fit: Any, params: Sequence[str] | None = None, samples: Any = None, axes: Any = None
) -> np.ndarray:
    r"""Covariance of the parameters, pair by pair.

    Below the diagonal the ellipses dᵀC⁻¹d = 1 and 4 about the fit, whose projections on the axes
    are ±1 and ±2 standard errors (they contain 39 % and 86 % of a normal distribution); on the
    diagonal the normal densities; above it the correlations, in colours.

    - `fit`: a `FitResult`, or anything else with `names`, `covariance` and the values `x` (n,) or
      draws `x` with their `mean` (`dvi.Samples`).
    - `params`: names that are drawn, in this order; None: all, up to twelve.
    - `samples`: draws that are shown under the ellipses: `dvi.Samples`, or name → draws of any
      shape.
    - `axes`: array of shape (n, n) of `Axes`; None: a new figure.

    A parameter whose error is much smaller than its size is drawn relative to the fit's value.

    **Returns** the `Axes`, shape (n, n). **Raises** `TypeError` for anything but a fit;
    `ValueError` for one without a covariance, parameters that the data do not determine, and names
    that do not exist.
    """
    rule = "fit must be a FitResult, as dvi.fit returns it, or a dvi.Samples"
    draw.check_attributes(fit, ("names", "x", "covariance"), rule)
    numbers, values = _of_parameters(fit, params)
    C, n = np.asarray(fit.covariance)[np.ix_(numbers, numbers)], len(numbers)
    errors = zip(numbers, np.sqrt(np.diag(C)).tolist(), strict=True)
    scales = [_scale(fit.names[i], float(values[i]), sigma) for i, sigma in errors]
    draws = [None] * n if samples is None else _draws(samples, [scale.name for scale in scales])
    side = 1.3 + max(1.7, 1.9 - 0.05 * n) * n
    purpose = f"in an array of shape {(n, n)} for {n} parameters"
    panels: Any = np.asarray(stack(axes, n * n, purpose, (side, side), ncols=n)[0]).reshape(n, n)
    for i, j in np.ndindex(n, n):
        axis, x, y = panels[i, j], scales[j], scales[i]
        axis.grid(visible=False)
        if i < j:
            _draw_correlation(axis, C[i, j] / (x.sigma * y.sigma))
            continue
        if i == j:
            _draw_marginal(axis, x, draws[j])
        else:
            _draw_pair(axis, x, y, C[np.ix_([j, i], [j, i])], draws[j], draws[i])
            axis.set_ylim(*y.limits)
            axis.locator_params(axis="y", nbins=4)
            axis.tick_params(axis="y", labelleft=j == 0)
            axis.set_ylabel(y.label if j == 0 else "")
        axis.set_xlim(*x.limits)
        axis.locator_params(axis="x", nbins=4)
        axis.tick_params(axis="x", labelbottom=i == n - 1)
        axis.set_xlabel(x.label if i == n - 1 else "")
    panels[0, 0].figure.align_labels()
    return panels


def _of_parameters(fit: Any, params: Sequence[str] | None) -> tuple[list[int], np.ndarray]:
    """(numbers of the parameters that are drawn, values of all), checked."""
    names, variances = list(fit.names), np.diag(np.asarray(fit.covariance))
    pairs = zip(names, variances, strict=True)
    determinate = [name for name, variance in pairs if np.isfinite(variance) and variance > 0]
    if params is None:
        draw.at_most(_PARAMETERS, len(names), "parameters", f"params={names[:3]}")
    params = names if params is None else [params] if isinstance(params, str) else [*params]
    if len(set(params)) < len(params) or not params or not {*params} <= {*names}:
        raise ValueError(f"params must be one or more different names from {names}, got {params}.")
    if indeterminate := [name for name in params if name not in determinate]:
        raise ValueError(
            f"fit.covariance must have a positive and finite variance of {indeterminate[0]!r}, got "
            f"{variances[names.index(indeterminate[0])]}. The fit failed, or the data do not "
            f"determine it: choose params from {determinate}."
        )
    values = np.asarray(fit.x if np.ndim(fit.x) == 1 else fit.mean)
    return [names.index(n) for n in params], values


def _draws(samples: Any, names: list[str]) -> list[np.ndarray]:
    """Draws of each of the names, flat."""
    arrays = getattr(samples, "samples", samples)
    instance("samples", arrays, Mapping, "a dvi.Samples or a dict of names with arrays of draws")
    if absent := [name for name in names if name not in arrays]:
        raise ValueError(
            f"samples must have draws of {absent[0]!r} and of all params, got only {[*arrays]}."
        )
    flat = {name: np.ravel(np.asarray(arrays[name], float)) for name in names}
    rule = "samples must have the same number of draws of each of params"
    draw.check_shapes(len({x.shape for x in flat.values()}) == 1, rule, **flat)
    return list(flat.values())


def _scale(name: str, value: float, sigma: float) -> _Scale:
    """Ticks of few digits: counted from the value where it has many more than its error."""
    has_few_digits = abs(value) < 30 * sigma
    exponent = math.floor(math.log10(_WIDE * sigma + (abs(value) if has_few_digits else 0.0)))
    exponent = 0 if -2 <= exponent <= 2 else exponent
    zero, label = 0.0, name
    if not has_few_digits:
        place = math.floor(math.log10(sigma)) - 1  # that of the last significant digit
        zero, size = round(value, -place), math.floor(math.log10(abs(value)))
        form = f".{max(0, -place)}f" if -4 <= size <= 6 else f".{max(0, size - place)}e"
        label += f" {'−' if zero >= 0 else '+'} {abs(zero):{form}}"
    label += "" if exponent == 0 else f"\n[$10^{{{exponent}}}$]"
    return _Scale(name, value, sigma, zero, 10.0**exponent, label)


def _draw_marginal(axis: Any, scale: _Scale, draws: np.ndarray | None) -> None:
    """The normal density of a parameter over its draws; its value with two digits of the error."""
    centre, sigma = scale(scale.value), scale.sigma / scale.unit
    x = centre + sigma * np.linspace(-_WIDE, _WIDE, 200)
    if draws is not None:
        bins = np.linspace(x[0], x[-1], 33)
        axis.hist(scale(draws), bins=bins, density=True, color="#c8c8c8", edgecolor="none")
    density = np.exp(-(((x - centre) / sigma) ** 2) / 2) / (sigma * np.sqrt(2 * np.pi))
    axis.plot(x, density, c=COLOURS[0])
    for sign in (-1, 1):
        axis.axvline(centre + sign * sigma, c=GREY, lw=0.8, ls="--")
    axis.set_ylim(bottom=0)
    axis.set_yticks([])
    digits = 1 - math.floor(math.log10(scale.sigma))
    size = math.floor(math.log10(abs(scale.value))) if scale.value else 0
    fixed = 0 <= digits <= 7 and size <= 6
    forms = (f".{digits}f",) * 2 if fixed else (f".{max(size + digits, 1)}e", ".1e")
    text = f"{sign_text(scale.value, forms[0])} ± {sign_text(scale.sigma, forms[1])}"
    axis.set_title(f"{scale.name}\n{text}", fontsize=9, loc="center")


def _draw_pair(axis: Any, x: _Scale, y: _Scale, C: np.ndarray, xs: Any, ys: Any) -> None:
    """Ellipses of one pair of parameters over its draws."""
    centre = (x(x.value), y(y.value))
    if xs is not None:
        look: Any = {"c": "#8c8c8c", "alpha": min(1.0, 600 / len(xs)), "zorder": 1}
        axis.plot(x(xs), y(ys), ".", ms=2.5, mew=0, rasterized=True, **look)
    units = np.array([x.unit, y.unit])
    # Half axes of dᵀC⁻¹d = 1 along the eigenvectors, in the units of the panel.
    values, vectors = np.linalg.eigh(C / (units * units[:, None]))
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    look = {"angle": angle, "fill": False, "edgecolor": COLOURS[0], "zorder": 3}
    for size, width, dash in ((1, 1.6, "-"), (2, 1.0, "--")):
        sides = 2 * size * np.sqrt(np.maximum(values[::-1], 0.0))
        axis.add_patch(Ellipse(centre, *sides, lw=width, ls=dash, **look))
    axis.plot(*centre, "+", c=COLOURS[1], ms=7, mew=1.6, zorder=4)


def _draw_correlation(axis: Any, value: float) -> None:
    """A number on a colour from −1 (orange) to 1 (purple)."""
    axis.set_facecolor(colormaps["PuOr"]((1 + 0.6 * value) / 2))
    axis.set(xticks=[], yticks=[])
    axis.spines[:].set_visible(False)
    digits = 2 if abs(value) < 0.995 else 4
    text = sign_text(value, f"+.{digits}f") if abs(value) >= 0.005 else "0.00"
    look: Any = {"ha": "center", "va": "center", "fontsize": 9 + 4 * abs(value)}
    axis.text(0.5, 0.5, text, transform=axis.transAxes, **look)
