"""Axes of a picture, and what several pictures draw on them: legends, marks, cells, guide lines."""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D

from .._checks import instance
from .style import GREY, HATCH, PALE, SHADES, figure_of

_PIECE = 20_000
"""Points of one path: Agg cannot draw much longer ones in one piece."""

_EXTEND = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}


def canvas(
    ax: Any, size: tuple[float, float] | None = None, space: bool = False
) -> tuple[Any, bool]:
    """(`ax` or the axes of a new figure, whether they are new); three-dimensional for `space`.

    **Raises** `TypeError` for anything but axes, `ValueError` for axes of another dimension.
    """
    if ax is None:
        figure = plt.figure(figsize=size, layout="constrained")
        return figure.add_subplot(projection="3d" if space else None), True
    instance("ax", ax, Axes, "the matplotlib Axes to draw on")
    if space != (ax.name == "3d"):
        raise ValueError(
            'an orbit in space needs axes in space, figure.add_subplot(projection="3d"), one in '
            f'the plane (coordinates=(0, 1), say) axes without a projection: got "{ax.name}".'
        )
    return ax, False


def stack(
    ax: Any, count: int, what: str, size: tuple[float, float], ncols: int = 1, **layout: Any
) -> tuple[list[Any], bool]:
    """(`count` axes, whether they are new): `ax`, or those of a new figure with `ncols` columns."""
    if ax is not None:
        return given(ax, count, what), False
    layout |= {"squeeze": False, "figsize": size, "layout": "constrained"}
    figure, axes = plt.subplots(-(-count // ncols), ncols, **layout)
    for spare in axes.flat[count:]:
        figure.delaxes(spare)
    return list(axes.flat)[:count], True


def given(axes: Any, count: int, what: str) -> list[Any]:
    """The axes as a list. **Raises** `ValueError` unless there are `count`."""
    found = [canvas(axis)[0] for axis in np.ravel(np.asarray(axes, object))]
    if len(found) != count:
        raise ValueError(f"axes must be {count}, {what}, got {len(found)}.")
    return found


def check_shapes(fits: Any, wanted: str, **arrays: np.ndarray) -> None:
    """**Raises** `ValueError` with what is wanted and with the shapes, unless they fit."""
    if not fits:
        got = ", ".join(f"{name} of shape {x.shape}" for name, x in arrays.items())
        raise ValueError(f"{wanted}: got {got}.")


def labels_of(labels: Any, count: int, what: str, name: str = "labels") -> list[str]:
    """`count` labels, empty ones for None. **Raises** `ValueError` for another number of them."""
    found = [""] * count if labels is None else [labels] if isinstance(labels, str) else labels
    if len(found) != count or isinstance(labels, str):
        raise ValueError(f"{name} has {len(found)} names for {count} {what}: give a list of them.")
    return [str(label) for label in found]


# --- legends and colours ------------------------------------------------------------------------


def legend(axis: Any, new: bool, extra: Iterable[Any] = (), labelled: bool = True) -> Any:
    """A legend below a new figure in as many columns as fit, or inside axes that were given.

    Below given axes it would cover their labels, or the axes below.

    - `extra`: entries after those of the labelled artists: artists, or texts without a mark.
    """
    handles = axis.get_legend_handles_labels()[0] if labelled else []
    for one in extra:
        text = isinstance(one, str)
        handles.append(Line2D([], [], linestyle="none", label=one) if text else one)
    if not handles:
        return None
    if not new:
        paper = {"frameon": True, "framealpha": 0.6, "edgecolor": "none"}
        return axis.legend(handles=handles, fontsize=8, **paper)
    figure = figure_of(axis)
    if axis.name == "3d":  # the labels of its axes need the space below
        return figure.legend(handles=handles, loc="upper right")
    # A letter is about 0.066 inch wide; the handle and the space between columns take five more.
    longest = max(len(str(h.get_label())) for h in handles)
    columns = int(np.clip(figure.get_figwidth() / 0.066 // (longest + 6), 1, len(handles)))
    return figure.legend(handles=handles, loc="outside lower center", ncols=columns)


def counted(counts: dict[str, Any]) -> list[str]:
    """Legend texts ``"{count} {text}"`` of the counts that are not 0."""
    return [f"{int(count)} {text}" for text, count in counts.items() if count]


def interval(
    values: np.ndarray, limits: Any = None, percentiles: tuple[float, float] = (0, 100)
) -> tuple[float, float, str]:
    """(low, high, `extend` of a colour bar) of a linear colour scale, never of zero length."""
    known = values[np.isfinite(values)]
    if limits is None:
        limits = np.percentile(known, percentiles) if known.size else (0.0, 1.0)
    low, high = (float(v) for v in limits)
    if high <= low:
        low, high = low - 0.5, high + 0.5
    return low, high, extend(known, low, high)


def extend(values: np.ndarray, low: float, high: float) -> str:
    """At which ends of a colour bar values lie outside, as matplotlib names it."""
    return _EXTEND[int((values < low).any()), int((values > high).any())]


# --- lines and marks ----------------------------------------------------------------------------


def path(axis: Any, *coordinates: np.ndarray, label: str | None = None, **look: Any) -> None:
    """A line of any length; a long one is drawn as pixels in a vector file."""
    n = len(coordinates[0])
    if n <= _PIECE:
        axis.plot(*coordinates, label=label, **look)
        return
    for first in range(0, n - 1, _PIECE):
        part = slice(first, first + _PIECE + 1)
        axis.plot(*(c[part] for c in coordinates), label=label, rasterized=True, **look)
        label = None


def envelope(x: np.ndarray, y: np.ndarray, most: int = 8000) -> tuple[np.ndarray, np.ndarray]:
    """About `most` points of a function of x that look like all: the extremes of each piece.

    Values that are not finite remain as gaps.
    """
    if len(x) <= most:
        return x, y
    keep = {0, len(x) - 1}
    for first, last in itertools.pairwise(np.linspace(0, len(x), most // 4 + 1).astype(int)):
        finite = np.isfinite(y[first:last])
        if finite.any():
            keep.add(first + int(np.argmin(np.where(finite, y[first:last], np.inf))))
            keep.add(first + int(np.argmax(np.where(finite, y[first:last], -np.inf))))
        if not finite.all():
            keep.add(first + int(np.argmin(finite)))
    chosen = np.array(sorted(keep))
    return x[chosen], y[chosen]


def at_edge(axis: Any, x: np.ndarray, marker: str, height: float = 0.015, **look: Any) -> None:
    """Marks at the edge of the axes, for values that have no place on the y axis."""
    if len(x):
        look = {"linestyle": "none", "markersize": 6} | look
        transform = axis.get_xaxis_transform()
        axis.plot(x, np.full(len(x), height), marker=marker, transform=transform, **look)


def without_place(axis: Any, x: np.ndarray, y: np.ndarray, colour: Any) -> np.ndarray:
    """Crosses at the top for failed values, triangles at the bottom for zeros; returns (2,) counts.

    Neither has a place on a logarithmic axis.
    """
    failed, zero = ~np.isfinite(y), y == 0
    at_edge(axis, x[failed], "x", 0.985, color=colour)
    at_edge(axis, x[zero], "v", color=colour)
    return np.array([failed.sum(), zero.sum()])


def without_place_entries(counts: np.ndarray, total: int, texts: Sequence[str]) -> list[Any]:
    """Legend entries of the marks that `without_place` draws."""
    look: dict[str, Any] = {"color": PALE, "linestyle": "none"}
    return [
        Line2D([], [], marker=marker, label=f"{count} of {total} {text}", **look)
        for count, marker, text in zip(counts, "xv", texts, strict=True)
        if count
    ]


def guide(axis: Any, x: Sequence[float], y: float, slope: float, **look: Any) -> None:
    """A dashed grey line of a slope on logarithmic axes, from (x[0], y) to x[1]."""
    ends = np.asarray(x)
    look = {"color": GREY, "linewidth": 1, "linestyle": "--"} | look
    axis.plot(ends, y * (ends / ends[0]) ** slope, **look)


# --- cells --------------------------------------------------------------------------------------


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
    shown = np.ma.masked_invalid(values)
    return axis.pcolormesh(x, y, shown, norm=norm, cmap=cmap or SHADES, rasterized=True)


def flat_cells(axis: Any, x: np.ndarray, y: np.ndarray, where: np.ndarray, colour: str) -> None:
    """Cells of one colour over a map, where a mask of shape (y, x) is true."""
    if where.any():
        shown = np.ma.masked_where(~where, np.ones(where.shape))
        axis.pcolormesh(x, y, shown, cmap=ListedColormap([colour]), rasterized=True)
