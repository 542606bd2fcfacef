"""The house style: colours, dashes, markers, where is drawn, and how a figure is written."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from cycler import cycler
from matplotlib import colormaps
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D

P = ParamSpec("P")
R = TypeVar("R")

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe & Ito's palette (2008), dark ones first; tell lines apart by marker or dash as well."""

DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)), (0, (1, 1)))

MARKS = ("s", "^", "D", "v", "P", "<", ">")
"""On lines that may lie upon one another; no circle, a start, and no cross, an end."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")

SHADES = ListedColormap(colormaps["viridis"](np.linspace(0, 0.88, 256)), "shades")
"""Of numbers on white paper: viridis without the yellow that would not be seen there."""

GREY, PALE = "#777777", "#b8b8b8"
"""Of what is no datum: lines to compare with; what has no value."""

NO_NUMBER, ZERO = "#d0d0d0", "#000000"
"""Of cells that have no place on the scale of colours; the first is hatched as well."""

HATCH: dict[str, Any] = {
    "facecolor": NO_NUMBER, "edgecolor": "#8c8c8c", "hatch": "/////", "linewidth": 0
}  # fmt: skip
"""Of cells without a number."""

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

_asked_for: ContextVar[bool] = ContextVar("asked_for", default=False)


@contextmanager
def style() -> Iterator[None]:
    """The house style, for the figures made inside the block; nothing global is changed.

    The functions of `dvi_jax.plot` draw in it anyway. A block is for figures of one's own, and for
    changes: what ``matplotlib.rc_context`` sets inside of it stays.
    """
    token = _asked_for.set(True)
    try:
        with mpl.rc_context(_STYLE):
            try:
                yield
            finally:
                interactive = mpl.is_interactive()
    finally:
        _asked_for.reset(token)
    # The first figure of a notebook chooses a backend, which is interactive: that is to stay.
    mpl.interactive(interactive)


def in_style(function: Callable[P, R]) -> Callable[P, R]:
    """The function, drawing in the house style unless its caller is within `style()` already."""

    @wraps(function)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> R:
        with nullcontext() if _asked_for.get() else style():
            return function(*args, **kwargs)

    return drawn


@in_style
def save(drawn: Any, path: str | Path) -> Path:
    """Write the figure (type from the suffix) and close it; returns the path.

    - `drawn`: a figure, or axes of one, as every function of `dvi_jax.plot` returns them.

    **Raises** `TypeError` for anything else, `ValueError` for axes of several figures.
    """
    path = Path(path)
    figure = figure_of(drawn)
    figure.savefig(path)
    plt.close(figure)
    return path


def figure_of(drawn: Any) -> Any:
    """The figure of axes, or the figure itself."""
    if hasattr(drawn, "savefig"):
        return drawn
    axes = list(np.ravel(np.asarray(drawn, object)))
    if not axes or not all(hasattr(axis, "figure") for axis in axes):
        raise TypeError(f"save takes a figure or axes, as the plots return them, got {drawn!r}.")
    figures = {id(f): f for f in (_root(axis) for axis in axes)}
    if len(figures) > 1:
        raise ValueError(f"these axes belong to {len(figures)} figures: save one at a time.")
    return next(iter(figures.values()))


def _root(axis: Any) -> Any:
    figure = axis.figure
    while figure.figure is not figure:  # of a SubFigure: what it is part of
        figure = figure.figure
    return figure


# --- where is drawn -----------------------------------------------------------------------------


def canvas(
    ax: Any, size: tuple[float, float] | None = None, space: bool = False
) -> tuple[Any, bool]:
    """(`ax`, or the axes of a new figure; whether it is new), in `space` with three dimensions.

    **Raises** `TypeError` for what are no axes, `ValueError` for those of another dimension.
    """
    if ax is None:
        figure = plt.figure(figsize=size, layout="constrained")
        return figure.add_subplot(projection="3d" if space else None), True
    if not hasattr(ax, "transAxes"):
        raise TypeError(f"ax must be the matplotlib Axes to draw on, got {type(ax).__name__}.")
    if space and ax.name != "3d":
        raise ValueError(
            'an orbit in space needs axes in space: figure.add_subplot(projection="3d"); or choose '
            "two coordinates, coordinates=(0, 1)."
        )
    if ax.name == "3d" and not space:
        raise ValueError("a picture in the plane was given axes in space: leave out projection.")
    return ax, False


def stack(
    ax: Any, count: int, what: str, size: tuple[float, float], **layout: Any
) -> tuple[list[Any], bool]:
    """(`count` axes, whether they are new): those given, or of a new figure, above one another.

    - `layout`: arguments of `plt.subplots`; `ncols` for axes beside one another.

    **Raises** `ValueError` for another number of axes.
    """
    if ax is not None:
        return given(ax, count, what), False
    columns = layout.pop("ncols", 1)
    rows = -(-count // columns)
    figure, axes = plt.subplots(
        rows, columns, squeeze=False, figsize=size, layout="constrained", **layout
    )
    for spare in axes.flat[count:]:
        figure.delaxes(spare)
    return list(axes.flat)[:count], True


def given(axes: Any, count: int, what: str) -> list[Any]:
    """The axes as a list, refused unless there are `count`."""
    found = [canvas(axis)[0] for axis in np.ravel(np.asarray(axes, object))]
    if len(found) != count:
        raise ValueError(f"axes must be {count}, {what}, got {len(found)}.")
    return found


def legend(axis: Any, new: bool, handles: Sequence[Any] | None = None) -> Any:
    """A legend below a new figure in as many columns as fit, or within axes that were given.

    Below given axes it would lie upon their names, or upon the axes beneath.
    """
    if handles is None:
        handles = axis.get_legend_handles_labels()[0]
    if not handles:
        return None
    if not new:
        paper = {"frameon": True, "framealpha": 0.6, "edgecolor": "none"}
        return axis.legend(handles=handles, fontsize=8, **paper)
    figure = _root(axis)
    if axis.name == "3d":  # whose names of axes would be in the way below
        return figure.legend(handles=handles, loc="upper right")
    # About 0.066 inch a letter; the handle and the space between columns take another five.
    longest = max(len(str(h.get_label())) for h in handles)
    fits = int(figure.get_figwidth() / 0.066 // (longest + 6))
    return figure.legend(
        handles=handles, loc="outside lower center", ncols=max(1, min(fits, len(handles)))
    )


def note(text: str) -> Any:
    """A line of a legend that is words alone."""
    return Line2D([], [], linestyle="none", label=text)


def signed(value: float, form: str = "g") -> str:
    """A number with a minus of the length of a plus."""
    return f"{value:{form}}".replace("-", "−")


def named(name: str, unit: str | None) -> str:
    """A label with its unit, where there is one."""
    return name if unit in (None, "", "1") else f"{name} [{unit}]"


# --- what is drawn ------------------------------------------------------------------------------

_PIECE = 20_000
"""Points of one path: longer ones are beyond what Agg draws at a time."""


def path(axis: Any, *coordinates: np.ndarray, label: str | None = None, **look: Any) -> None:
    """A line of any length; pixels in a file of vectors if it is long."""
    n = len(coordinates[0])
    if n <= _PIECE:
        axis.plot(*coordinates, label=label, **look)
        return
    for first in range(0, n - 1, _PIECE):
        part = slice(first, first + _PIECE + 1)
        axis.plot(*(c[part] for c in coordinates), label=label, rasterized=True, **look)
        label = None


def envelope(x: np.ndarray, y: np.ndarray, most: int = 8000) -> tuple[np.ndarray, np.ndarray]:
    """At most about `most` points of a function of x that look like all: extremes of each piece.

    Numbers that are not finite stay where they are, as gaps.
    """
    pieces = most // 4
    if len(x) <= most:
        return x, y
    keep = {0, len(x) - 1}
    edges = np.linspace(0, len(x), pieces + 1).astype(int)
    for first, last in itertools.pairwise(edges):
        part = y[first:last]
        finite = np.isfinite(part)
        if finite.any():
            keep |= {first + int(np.argmin(np.where(finite, part, np.inf)))}
            keep |= {first + int(np.argmax(np.where(finite, part, -np.inf)))}
        if not finite.all():
            keep |= {first + int(np.argmin(finite))}
    chosen = np.array(sorted(keep))
    return x[chosen], y[chosen]


def cell_edges(centres: np.ndarray, log: bool = False) -> np.ndarray:
    """Edges of cells about rising points, half way between them on the axis."""
    if log and len(centres) > 1:
        return np.exp(cell_edges(np.log(centres)))
    if len(centres) == 1:
        half = 0.5 * abs(centres[0]) or 0.5
        return np.asarray([centres[0] - half, centres[0] + half])
    middle = (centres[1:] + centres[:-1]) / 2
    first, last = 2 * centres[0] - middle[0], 2 * centres[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])
