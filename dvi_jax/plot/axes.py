"""Axes of a picture, and what several pictures draw on them: legends, marks, cells, guide lines."""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cbook import normalize_kwargs
from matplotlib.collections import QuadMesh
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatterSciNotation
from matplotlib.transforms import ScaledTranslation

from ..base.checks import instance
from .style import GUIDE, HATCH, PALE, SHADES, figure_of

_PIECE = 20_000
"""Points of one path: Agg cannot draw much longer ones in one piece."""

_LABELS = 36
"""Points below axes that their ticks and their label take."""

_EXTEND = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}


def canvas(ax: Any, size: Any = None, space: bool = False) -> tuple[Any, bool]:
    """(`ax` or the axes of a new figure, whether they are new); three-dimensional for `space`.

    **Raises** `TypeError` for anything but axes, `ValueError` for axes of another dimension.
    """
    if ax is None:
        figure = plt.figure(figsize=size, layout="constrained")
        return figure.add_subplot(projection="3d" if space else None), True
    instance("ax", ax, Axes, "the matplotlib Axes to draw on")
    if space != (ax.name == "3d"):
        raise ValueError(
            f'ax must be Axes {"with" if space else "without"} projection="3d", got "{ax.name}".'
        )
    return ax, False


def stack(
    ax: Any, places: Any, purpose: str, size: tuple[float, float], ncols: int = 1, **layout: Any
) -> tuple[list[Any], bool]:
    """(several axes, whether they are new): `ax`, or those of a new figure.

    `places`: number of axes, which fill rows of `ncols`; or rows of their names, as
    `Figure.subplot_mosaic` takes them. `purpose`: what they are for, in the error message.
    """
    if isinstance(places, int):
        cells = [*range(places), *["."] * (-places % ncols)]
        places = [cells[i : i + ncols] for i in range(0, len(cells), ncols)]
    if ax is None:
        figure = plt.figure(figsize=size, layout="constrained")
        return list(figure.subplot_mosaic(places, **layout).values()), True
    axes = [canvas(axis)[0] for axis in np.ravel(np.asarray(ax, object))]
    count = len({name for row in places for name in row} - {"."})
    if len(axes) != count:
        raise ValueError(
            f"this picture needs {count} Axes, {purpose}, or none (a new figure); got {len(axes)}."
        )
    return axes, False


def check_shapes(fits: Any, rule: str, **arrays: np.ndarray) -> None:
    """**Raises** `ValueError` with what is wanted and with the shapes, unless they fit."""
    if not fits:
        shapes = ", ".join(f"{name} of shape {x.shape}" for name, x in arrays.items())
        raise ValueError(f"{rule}; got {shapes}.")


def at_most(limit: int, count: int, things: str, choice: str) -> None:
    """**Raises** `ValueError` for too many things in one picture, with a way to choose some."""
    if count > limit:
        raise ValueError(f"{count} {things} are too many: choose at most {limit}, e.g. {choice}.")


def check_not_empty(name: str, things: Any, hint: str) -> None:
    """**Raises** `ValueError` if they are missing, with what to give."""
    if not len(things):
        raise ValueError(f"{name} is empty: {hint}.")


def check_real(name: str, values: Any, kinds: str = "biuf") -> None:
    """**Raises** `TypeError` for values that are not real numbers."""
    if values.dtype.kind not in kinds:
        raise TypeError(f"{name} must be real numbers, got dtype {values.dtype}.")


def check_attributes(thing: Any, names: Sequence[str], rule: str) -> None:
    """**Raises** `TypeError` for an object without these attributes."""
    if lacking := ", ".join(name for name in names if not hasattr(thing, name)):
        raise TypeError(f"{rule}; got type {type(thing).__name__} without attributes {lacking}.")


def labels_of(labels: Any, count: int, things: str, name: str = "labels") -> list[str]:
    """`count` labels, empty ones for None. **Raises** `ValueError` for another number of them."""
    if labels is None:
        return [""] * count
    texts = [labels] if isinstance(labels, str) else labels
    if len(texts) != count or isinstance(labels, str):
        raise ValueError(
            f"{name} must be a list of {count} names of {things}, got {labels!r:.200}."
        )
    return [str(label) for label in texts]


def entry(label: str, **look: Any) -> Line2D:
    """An entry of a legend."""
    return Line2D([], [], label=label, **normalize_kwargs(look, Line2D))


def legend(axis: Any, new: bool, extra: Iterable[Any] = (), artists: bool = True) -> Any:
    """A legend below a new figure in as many columns as fit, or inside axes that were given; below
    them if they hold a map, which fills them, and the figure has a layout that makes space.

    `extra`: entries after those of the labelled artists: artists, or texts without a mark.
    """
    handles = axis.get_legend_handles_labels()[0] if artists else []
    handles += [entry(item, ls="none") if isinstance(item, str) else item for item in extra]
    if not handles:
        return None
    figure = figure_of(axis)
    if not new:  # below axes without a layout it would cover their labels, or other axes
        look = {"frameon": True, "framealpha": 0.6, "edgecolor": "none"}
        is_map = any(isinstance(collection, QuadMesh) for collection in axis.collections)
        if is_map and figure.get_layout_engine() is not None:
            below_axes = ScaledTranslation(0, -_LABELS / 72, figure.dpi_scale_trans)
            look = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "borderaxespad": 0.0}
            look["bbox_transform"] = axis.transAxes + below_axes
        return axis.legend(handles=handles, fontsize=8, **look)
    if axis.name == "3d":  # the labels of its axes need the space below
        return figure.legend(handles=handles, loc="upper right")
    # A letter is about 0.066 inch wide; the handle and the space between columns take five more.
    longest = max(len(str(h.get_label())) for h in handles)
    columns = int(np.clip(figure.get_figwidth() / 0.066 // (longest + 6), 1, len(handles)))
    return figure.legend(handles=handles, loc="outside lower center", ncols=columns)


class _FewLabels(LogFormatterSciNotation):
    """Labels of 2 and 5 alone between powers of ten; of at most three ticks on a shorter axis."""

    def set_locs(self, locs: Any = None) -> None:
        low, high = sorted(self.axis.get_view_interval())  # pyright: ignore[reportOptionalMemberAccess]
        x = np.ravel(locs)
        x = x[(low <= x) & (x <= high)]
        if high <= 2.5 * low:  # 1, 2 and 5 may be out of view
            self.shown = x[:: max(1, -(-len(x) // 3))]
        else:
            digits = np.round(x / 10.0 ** np.floor(np.log10(x) + 1e-9))
            self.shown = x[np.isin(digits, (2, 5)) & (high < 20 * low)]

    def __call__(self, x: float, pos: Any = None) -> str:
        return super().__call__(x, pos) if np.isclose(x, self.shown, atol=0).any() else ""


def log_x(*axes: Any) -> None:
    """A logarithmic x axis, whose labels do not touch: 3×10⁻¹ and 4×10⁻¹ would."""
    for axis in axes:
        axis.set_xscale("log")
        axis.xaxis.set_minor_formatter(_FewLabels())


def counts_text(counts: dict[str, Any]) -> list[str]:
    """Legend texts ``"{count} {text}"`` of the counts that are not 0."""
    return [f"{int(count)} {text}" for text, count in counts.items() if count]


def scale_of(
    values: np.ndarray, limits: Any = None, log: bool = False, percentiles: Any = (0, 100)
) -> tuple[Any, str]:
    """(norm of a colour scale, never of zero length; `extend` of its bar, as matplotlib names it).

    `limits`: (low, high); None: these percentiles of the finite values, for `log` positive ones.
    """
    finite = values[np.isfinite(values) & ((values > 0) | (not log))]
    if limits is None:
        limits = np.percentile(finite, percentiles) if finite.size else (0.1 if log else 0.0, 1.0)
    low, high = (float(v) for v in limits)
    ends = _EXTEND[int((finite < low).any()), int((finite > high).any())]
    if high <= low and log:
        low, high = low / 2, high * 2
    elif high <= low:
        half = (abs(low) or 1) / 2
        low, high = low - half, high + half
    return (LogNorm if log else Normalize)(low, high), ends


def path(
    axis: Any, *coordinates: np.ndarray, label: str | None = None, marks: Any = None, **look: Any
) -> None:
    """A line of any length; a long one is drawn as pixels in a vector file.

    `marks`: numbers of the points that have a marker; None: all.
    """
    n = len(coordinates[0])
    long: dict[str, Any] = {"rasterized": True} if n > _PIECE else {}
    for first in range(0, n - 1 if long else 1, _PIECE):
        part = slice(first, first + _PIECE + 1)
        if marks is not None:
            look["markevery"] = [i - first for i in marks if part.start <= i < part.stop]
        axis.plot(*(c[part] for c in coordinates), label=label, **long, **look)
        label = None


def envelope(x: np.ndarray, y: np.ndarray, limit: int = 8000) -> tuple[np.ndarray, np.ndarray]:
    """About `limit` points of a function of x that look like all: extremes, gaps of each piece."""
    if len(x) <= limit:
        return x, y
    keep = {0, len(x) - 1}
    for first, last in itertools.pairwise(np.linspace(0, len(x), limit // 4 + 1).astype(int)):
        finite = np.isfinite(y[first:last])
        if finite.any():
            keep.add(first + int(np.argmin(np.where(finite, y[first:last], np.inf))))
            keep.add(first + int(np.argmax(np.where(finite, y[first:last], -np.inf))))
        if not finite.all():
            keep.add(first + int(np.argmin(finite)))
    numbers = np.array(sorted(keep))
    return x[numbers], y[numbers]


def at_edge(axis: Any, x: np.ndarray, marker: str, height: float = 0.015, **look: Any) -> None:
    """Marks at the edge of the axes, for values that have no place on the y axis."""
    if len(x):
        look = {"ls": "none", "ms": 6} | look
        transform = axis.get_xaxis_transform()
        axis.plot(x, np.full(len(x), height), marker=marker, transform=transform, **look)


def without_place(axis: Any, x: np.ndarray, y: np.ndarray, colour: Any) -> np.ndarray:
    """Crosses at the top for failed values, triangles at the bottom for zeros; returns (2,) counts.

    Neither has a place on a logarithmic axis.
    """
    invalid, zero = ~np.isfinite(y), y == 0
    at_edge(axis, x[invalid], "x", 0.985, color=colour)
    at_edge(axis, x[zero], "v", color=colour)
    return np.array([invalid.sum(), zero.sum()])


def without_place_entries(counts: Any, total: int, invalid: str, zero: str) -> list[Any]:
    """Legend entries of the marks that `without_place` draws."""
    marks = zip(counts, "xv", (invalid, zero), strict=True)
    look: Any = {"color": PALE, "ls": "none"}
    return [entry(f"{n} of {total} {text}", marker=mark, **look) for n, mark, text in marks if n]


def guide(axis: Any, x: Sequence[float], y: float, slope: float, **look: Any) -> None:
    """A dashed grey line of a slope on logarithmic axes, from (x[0], y) to x[1]."""
    ends = np.asarray(x)
    axis.plot(ends, y * (ends / ends[0]) ** slope, **GUIDE | look)


def cell_edges(centres: np.ndarray, log: bool = False) -> np.ndarray:
    """Edges of cells around increasing points, half way between them on the axis."""
    if log and len(centres) > 1:
        return np.exp(cell_edges(np.log(centres)))
    if len(centres) == 1:
        half = 0.5 * abs(centres[0]) or 0.5
        return np.asarray([centres[0] - half, centres[0] + half])
    middle = (centres[1:] + centres[:-1]) / 2
    first, last = 2 * centres[0] - middle[0], 2 * centres[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def cells(axis: Any, x: np.ndarray, y: np.ndarray, values: np.ndarray, norm: Any, cmap: Any) -> Any:
    """A map of values, shape (y, x), between edges `x` and `y`; cells without one are hatched."""
    axis.grid(False)
    axis.patch.set(**HATCH)
    masked_values = np.ma.masked_invalid(values)
    return axis.pcolormesh(x, y, masked_values, norm=norm, cmap=cmap or SHADES, rasterized=True)


def flat_cells(axis: Any, x: np.ndarray, y: np.ndarray, where: np.ndarray, colour: str) -> None:
    """Cells of one colour over a map, where a mask of shape (y, x) is true."""
    if where.any():
        mask = np.ma.masked_where(~where, np.ones(where.shape))
        axis.pcolormesh(x, y, mask, cmap=ListedColormap([colour]), rasterized=True)
