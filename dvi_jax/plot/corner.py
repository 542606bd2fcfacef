"""Corner plots of fits: the covariance of the parameters, pair by pair."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib import colormaps
from matplotlib.patches import Ellipse

from .._checks import instance
from .axes import given
from .fits import check_fit
from .style import COLOURS, GREY, in_style, signed

_PARAMETERS = 12
"""Largest number of parameters that are drawn without a selection."""

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

    @property
    def limits(self) -> tuple[float, float]:
        """Limits of a panel, in its units."""
        half = _WIDE * self.sigma
        return self(self.value - half), self(self.value + half)


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
    check_fit(fit, "names", "x", "covariance")
    numbers, values = _of_parameters(fit, params)
    C = np.asarray(fit.covariance)[np.ix_(numbers, numbers)]
    scales = [
        _scale(fit.names[i], float(values[i]), math.sqrt(C[k, k])) for k, i in enumerate(numbers)
    ]
    draws = [None] * len(scales)
    if samples is not None:
        draws = _draws(samples, [scale.name for scale in scales])
    axes = _corner_axes(axes, len(scales))
    for i, j in np.ndindex(axes.shape):
        axis = axes[i, j]
        if i == j:
            _draw_marginal(axis, scales[i], draws[i])
        elif i > j:
            _draw_pair(axis, scales[j], scales[i], C[np.ix_([j, i], [j, i])], draws[j], draws[i])
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
    if params is None and len(names) > _PARAMETERS:
        some = f"params={names[:3]}"
        raise ValueError(f"{len(names)} parameters are too many for one picture: choose, {some}.")
    params = names if params is None else [params] if isinstance(params, str) else [*params]
    if len(set(params)) < len(params) or not params or not {*params} <= {*names}:
        raise ValueError(f"params must be different names of {names}, one or more, got {params}.")
    if unknown := [name for name in params if name not in known]:
        raise ValueError(
            f"the data do not determine {unknown[0]}; those that have a variance: params={known}."
        )
    return [names.index(n) for n in params], values


def _draws(samples: Any, names: list[str]) -> list[np.ndarray]:
    """Draws of each of the names, flat."""
    found = getattr(samples, "samples", samples)
    instance("samples", found, Mapping, "a dvi.Samples or a dict of names with arrays of draws")
    if missing := [name for name in names if name not in found]:
        raise ValueError(f"samples has no {missing[0]!r}: there are {', '.join(map(str, found))}.")
    flat = [np.ravel(np.asarray(found[n], float)) for n in names]
    if len({len(f) for f in flat}) > 1:
        raise ValueError("samples must hold the same number of draws for each name.")
    return flat


def _scale(name: str, value: float, sigma: float) -> _Scale:
    """Ticks of few digits: counted from the value where it has many more than its error."""
    near = abs(value) < 30 * sigma
    exponent = math.floor(math.log10(_WIDE * sigma + (abs(value) if near else 0.0)))
    exponent = 0 if -2 <= exponent <= 2 else exponent
    zero, label = 0.0, name
    if not near:
        place = math.floor(math.log10(sigma)) - 1  # that of the last digit that is worth writing
        zero, size = round(value, -place), math.floor(math.log10(abs(value)))
        form = f".{max(0, -place)}f" if -4 <= size <= 6 else f".{max(0, size - place)}e"
        label += f" {'−' if zero >= 0 else '+'} {abs(zero):{form}}"
    label += "" if exponent == 0 else f"\n[$10^{{{exponent}}}$]"
    return _Scale(name, value, sigma, zero, 10.0**exponent, label)


def _corner_axes(axes: Any, n: int) -> np.ndarray:
    if axes is None:
        side = 1.3 + max(1.7, 1.9 - 0.05 * n) * n
        return plt.subplots(n, n, figsize=(side, side), squeeze=False, layout="constrained")[1]
    found = np.asarray(axes, object)
    given(found, found.size, "")  # all of them are axes
    if found.shape != (n, n):
        raise ValueError(f"axes must have shape {(n, n)} for {n} parameters, not {found.shape}.")
    return found


def _draw_marginal(axis: Any, scale: _Scale, draws: np.ndarray | None) -> None:
    centre, sigma = scale(scale.value), scale.sigma / scale.unit
    x = centre + sigma * np.linspace(-_WIDE, _WIDE, 200)
    if draws is not None:
        bins = np.linspace(x[0], x[-1], 33)
        axis.hist(scale(draws), bins=bins, density=True, color="#c8c8c8", edgecolor="none")
    density = np.exp(-(((x - centre) / sigma) ** 2) / 2) / (sigma * np.sqrt(2 * np.pi))
    axis.plot(x, density, color=COLOURS[0])
    for sign in (-1, 1):
        axis.axvline(centre + sign * sigma, color=GREY, linewidth=0.8, linestyle="--")
    axis.set_ylim(bottom=0)


def _draw_pair(
    axis: Any, x: _Scale, y: _Scale, C: np.ndarray, xs: np.ndarray | None, ys: np.ndarray | None
) -> None:
    """Ellipses of one pair of parameters over its draws."""
    centre = (x(x.value), y(y.value))
    if xs is not None and ys is not None:
        look: Any = {"color": "#8c8c8c", "alpha": min(1.0, 600 / len(xs)), "zorder": 1}
        look |= {"markersize": 2.5, "markeredgewidth": 0, "rasterized": True}
        axis.plot(x(xs), y(ys), ".", **look)
    units = np.array([x.unit, y.unit])
    # Half axes of dᵀC⁻¹d = 1 along the eigenvectors, in the units of the panel.
    values, vectors = np.linalg.eigh(C / (units * units[:, None]))
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    look = {"angle": angle, "fill": False, "edgecolor": COLOURS[0], "zorder": 3}
    for size, linewidth, dash in ((1, 1.6, "-"), (2, 1.0, "--")):
        sides = 2 * size * np.sqrt(np.maximum(values[::-1], 0.0))
        axis.add_patch(Ellipse(centre, *sides, linewidth=linewidth, linestyle=dash, **look))
    axis.plot(*centre, "+", color=COLOURS[1], markersize=7, markeredgewidth=1.6, zorder=4)


def _draw_correlation(axis: Any, value: float) -> None:
    """A number on a colour from −1 (orange) to 1 (purple)."""
    axis.set_facecolor(colormaps["PuOr"]((1 + 0.6 * value) / 2))
    digits = 2 if abs(value) < 0.995 else 4
    text = signed(value, f"+.{digits}f") if abs(value) >= 0.005 else "0.00"
    look: Any = {"ha": "center", "va": "center", "fontsize": 9 + 4 * abs(value)}
    axis.text(0.5, 0.5, text, transform=axis.transAxes, **look)


def _dress_corner(axis: Any, i: int, j: int, scales: list[_Scale]) -> None:
    axis.grid(visible=False)
    if i < j:
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
        return
    axis.set_xlim(*scales[j].limits)
    axis.locator_params(axis="x", nbins=4)
    last = i == len(scales) - 1
    axis.tick_params(axis="x", labelbottom=last)
    axis.set_xlabel(scales[j].label if last else "")
    if i == j:
        axis.set_yticks([])
        text = f"{scales[i].name}\n{_with_error(scales[i].value, scales[i].sigma)}"
        axis.set_title(text, fontsize=9, loc="center")
        return
    axis.set_ylim(*scales[i].limits)
    axis.locator_params(axis="y", nbins=4)
    axis.tick_params(axis="y", labelleft=j == 0)
    axis.set_ylabel(scales[i].label if j == 0 else "")


def _with_error(x: float, sigma: float) -> str:
    """``1.00063 ± 0.00002``, with two digits of the error."""
    digits = 1 - math.floor(math.log10(sigma))
    size = math.floor(math.log10(abs(x))) if x else 0
    fixed = 0 <= digits <= 7 and size <= 6
    forms = (f".{digits}f",) * 2 if fixed else (f".{max(size + digits, 1)}e", ".1e")
    return f"{signed(x, forms[0])} ± {signed(sigma, forms[1])}"
