"""Panels of a map: assignment of dimensions, axes, colours, legends."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import CenteredNorm, LogNorm, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogFormatterMathtext, LogLocator

from .._checks import instance
from .axes import at_edge, canvas, cells, extend, flat_cells, stack
from .places import Place, dim_of, find_place, label_of, names_of
from .style import COLOURS, GREY, HATCH, NO_NUMBER, SHADES, ZERO

NOT_COMPUTED = "#ffffff"
"""Colour of cells that are not computed."""

_MARKS = {NO_NUMBER: ("x", GREY), ZERO: ("v", ZERO)}
"""Marker and colour of the same along a line."""

_MOST_PANELS = 16
_BOTH_SIGNS = 0.05
"""Values of both signs have a centred scale if the smaller side exceeds this share."""

_DECADES = 2
"""Positive numbers that reach over more of them get a logarithmic scale."""


class Grid(NamedTuple):
    """One array for each panel, and the axes that all panels share.

    - `panels`: (title, array) of each. `x`, `y`: axes; no `y` for a line.
    - `over`: dimensions of which the numbers meet in a pixel.
    """

    panels: list[tuple[str, Any]]
    x: Place
    y: Place | None
    over: tuple[str, ...]

    @property
    def places(self) -> list[Place]:
        """The axes in the order of an array that is drawn: y, x."""
        return [self.x] if self.y is None else [self.y, self.x]

    @property
    def bins(self) -> dict[str, Any]:
        return {place.dim: place.bins for place in self.places}


def arrange(
    data: Any,
    x: str | None,
    y: str | None,
    facet: str | None,
    over: str | Sequence[str],
    pixels: Any,
    made: Mapping[str, Any] | None = None,
) -> Grid:
    """Assign dimensions to x, y and facets; those that are not named become x and y in turn.

    - `made`: name → array that stands for that of the data where its axis is found; None for a
      dimension that does not appear.

    **Raises** `ValueError` for a dimension that is not there, is named twice, or is one too many.
    """
    width, height = _two(pixels)
    if not (width >= 1 and height >= 1):
        raise ValueError(f"pixels must be (width, height), two positive numbers, got {pixels!r}.")
    if empty := [str(d) for d, n in data.sizes.items() if n == 0]:
        raise ValueError(f"there is nothing to draw: {', '.join(empty)} has no values.")
    over = (over,) if isinstance(over, str) else tuple(over)
    roles = {"x": x, "y": y, "facet": facet, **{f"over={name!r}": name for name in over}}
    taken: dict[str, str] = {}
    named = {role: dim_of(data, name) for role, name in roles.items() if name is not None}
    for role, dim in named.items():
        if dim in taken:
            raise ValueError(f"{role} and {taken[dim]} are both along {dim!r}: name another.")
        taken[dim] = role
    made = made or {}
    gone = [dim_of(data, name) for name, stand_in in made.items() if stand_in is None]
    left = [str(d) for d in data.dims if d not in taken and d not in gone]
    free = [d for d in left if data.sizes[d] > 1]
    if x is None:
        x, y = (free.pop(0), y) if free else (y, None)
    if y is None and free:
        y = free.pop(0)
    if x is None:
        raise ValueError("there is nothing to draw: no dimension has more than one value.")
    if free:
        raise ValueError(
            f"a map has two dimensions, {x!r} and {y!r} here; {', '.join(map(repr, free))} "
            f"{'is' if len(free) == 1 else 'are'} left of {names_of(data)}. Select one value, "
            f"data.isel({free[0]}=0), reduce them, over={free[0]!r}, or draw one map each, "
            f"facet={free[0]!r}."
        )
    data = data.isel({d: 0 for d in left if data.sizes[d] == 1})
    places: list[Any] = [None, None]
    for i, (name, size) in enumerate(((x, width), (y, height))):
        if name is not None:
            stand_in = made.get(name)
            places[i] = find_place(data if stand_in is None else stand_in, name, int(size))
    dims = tuple(dim_of(data, name) for name in over)
    return Grid(_panels(data, facet), places[0], places[1], dims)


def _two(values: Any) -> tuple[float, float]:
    """Two numbers, NaN for anything else, which fails every comparison."""
    try:
        first, second = (float(v) for v in values)
    except (TypeError, ValueError):
        return math.nan, math.nan
    return first, second


def _panels(data: Any, facet: str | None) -> list[tuple[str, Any]]:
    if facet is None:
        return [("", data)]
    dim = dim_of(data, facet)
    count = data.sizes[dim]
    if count > _MOST_PANELS:
        raise ValueError(
            f"facet {facet!r} has {count} values, and there is room for {_MOST_PANELS} panels: "
            f"select some, data.isel({dim}=slice(None, None, {-(-count // _MOST_PANELS)}))."
        )
    coordinate = data.coords.get(facet)
    name, _, units = label_of(coordinate, facet).partition(" [")
    values = np.arange(count) if coordinate is None else coordinate.values
    texts = [f"{v:.4g}" if np.issubdtype(type(v), np.number) else str(v) for v in values]
    tail = f" {units.rstrip(']')}" if units else ""
    return [(f"{name} = {t}{tail}", data.isel({dim: i})) for i, t in enumerate(texts)]


def checked_array(data: Any) -> Any:
    """A `DataArray` of numbers, or an error that shows how to get one."""
    import xarray as xr

    hint = 'Take one variable of a Dataset, such as result.to_xarray()["drift"].'
    if isinstance(data, xr.Dataset):
        hint += f" There are {', '.join(map(str, data.data_vars))}."
    instance("data", data, xr.DataArray, "an xarray.DataArray", hint)
    if data.dtype.kind not in "biuf":
        raise TypeError(f"data must be real numbers, got an array of {data.dtype}.")
    return data


# --- axes ---------------------------------------------------------------------------------------


def make_axes(grid: Grid, ax: Any, height: float | None = None) -> list[Any]:
    """One `Axes` for each panel: `ax`, or those of a new figure, of one panel of this height."""
    count = len(grid.panels)
    if ax is not None:
        if count > 1:
            raise ValueError("a facet has a figure of its own: leave out ax, or facet.")
        return [canvas(ax)[0]]
    if count == 1:
        size = None if height is None else (plt.rcParams["figure.figsize"][0], height)
        return [canvas(None, size)[0]]
    columns = min(count, 3 if count > 4 else 2)
    size = (1.4 + 2.7 * columns, 1.0 + 2.3 * -(-count // columns))
    return stack(None, count, "one for each", size, columns, sharex=True, sharey=True)[0]


def finish(axes: Sequence[Any], grid: Grid) -> None:
    """Scales, ticks, labels and titles."""
    for i, ((title, _), axis) in enumerate(zip(grid.panels, axes, strict=True)):
        _dress(axis, "x", grid.x)
        if grid.y is not None:
            _dress(axis, "y", grid.y)
        if title:
            axis.set_title(title)
        if len(axes) > 1:
            columns = axis.get_subplotspec().get_gridspec().ncols
            last = i + columns >= len(axes)
            axis.tick_params(labelbottom=last)
            axis.set_xlabel(axis.get_xlabel() if last else "")
            axis.set_ylabel(axis.get_ylabel() if i % columns == 0 else "")


def _dress(axis: Any, which: str, place: Place) -> None:
    ticks, limits = getattr(axis, f"set_{which}ticks"), tuple(place.edges[[0, -1]])
    if place.log:
        axis.set(**{f"{which}scale": "log"})
    axis.set(**{f"{which}lim": limits, f"{which}label": place.label})
    if place.names is not None:
        positions, texts = place.names
        long = which == "x" and sum(map(len, texts)) > 60
        turn = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"} if long else {}
        ticks(positions, texts, **turn)
    if place.zero is not None:
        low, high = np.sqrt(place.zero * place.centres[1]), place.edges[-1]
        major, minor = (
            [t for t in LogLocator(subs=subs).tick_values(low, high) if low <= t <= high]
            for subs in ((1.0,), tuple(range(2, 10)))
        )
        ticks([place.zero, *major], ["0", *map(LogFormatterMathtext(), major)])
        ticks(minor, minor=True, labels=[""] * len(minor))


# --- colours ------------------------------------------------------------------------------------


class Scale(NamedTuple):
    """The colours of numbers: `log`, and how far the numbers go beyond the scale."""

    norm: Any
    cmap: Any
    log: bool
    extend: str


def make_scale(values: Sequence[np.ndarray], log: bool | None, limits: Any) -> Scale:
    """Colours for all panels: logarithmic for positive numbers over decades, with a middle for
    numbers of both signs.

    **Raises** `ValueError` for a logarithmic scale of negative numbers, and for `limits` that are
    no interval.
    """
    found = np.concatenate([np.ravel(v) for v in values])
    found = found[np.isfinite(found)]
    positive = found[found > 0]
    if log is None:
        log = positive.size > 0 and bool((found >= 0).all())
        log = log and bool(positive.max() > 10**_DECADES * positive.min())
    if log and (found < 0).any():
        raise ValueError(
            f"a logarithmic scale has no place for the {np.sum(found < 0)} pixels below 0: leave "
            "out log=True, or draw abs(data)."
        )
    inside = positive if log else found
    low, high = (inside.min(), inside.max()) if inside.size else (0.1 if log else 0.0, 1.0)
    if limits is not None:
        low, high = _two(limits)
        if not low < high or (log and low <= 0):
            wanted = "two rising positive numbers" if log else "two rising numbers"
            raise ValueError(f"limits must be {wanted}, got {limits!r}.")
    ends = extend(inside, low, high)
    if log:
        wide = 1.0 if high > low else 2.0
        return Scale(LogNorm(low / wide, high * wide), SHADES, True, ends)
    if limits is None and min(-low, high) > _BOTH_SIGNS * max(-low, high):
        return Scale(CenteredNorm(0, max(-low, high)), "PuOr_r", False, ends)
    if high == low:
        low, high = low - (abs(low) or 1) / 2, high + (abs(high) or 1) / 2
    return Scale(Normalize(low, high), SHADES, False, ends)


def draw_values(axis: Any, grid: Grid, values: np.ndarray, scale: Scale) -> Any:
    """A map of numbers, or a line; what has no number is left to the background.

    A line is drawn over marks at the bottom where there is none. Returns what has the colours, or
    None.
    """
    zero = (values == 0) & scale.log
    if grid.y is not None:
        frame(axis)
        x, y = grid.x.edges, grid.y.edges
        mesh = cells(axis, x, y, np.where(zero, np.nan, values), scale.norm, scale.cmap)
        flat_cells(axis, x, y, zero, ZERO)
        return mesh
    missing = ~np.isfinite(values)
    mark = "o" if values.size <= 60 else ""
    shown = np.where(zero | missing, np.nan, values)
    axis.plot(grid.x.centres, shown, marker=mark, color=COLOURS[0])
    axis.set_yscale("log" if scale.log else "linear")
    for where, kind in ((zero, ZERO), (missing, NO_NUMBER)):
        marker, colour = _MARKS[kind]
        at_edge(axis, grid.x.centres[where], marker, 0.025, color=colour, markersize=4.5)
    return None


def frame(axis: Any) -> None:
    """No grid, and a line all around: white cells belong to the map."""
    axis.grid(False)
    axis.spines[:].set_visible(True)


def colour_bar(axes: Sequence[Any], mesh: Any, scale: Scale, label: str) -> None:
    """One bar for all panels, or the name of the y axis of lines."""
    if mesh is None:
        for axis in axes:
            axis.set_ylabel(label)
    else:
        axes[0].figure.colorbar(mesh, ax=list(axes), label=label, extend=scale.extend)


def flag(colour: str, label: str, line: bool = False) -> Any:
    """An entry of a legend, of a map or of a line."""
    if line and colour in _MARKS:
        marker, shown = _MARKS[colour]
        return Line2D([], [], label=label, marker=marker, color=shown, linestyle="none")
    if colour == NO_NUMBER:
        return Patch(label=label, **HATCH)
    return Patch(facecolor=colour, edgecolor="#8c8c8c", linewidth=0.6, label=label)


def share(count: int, total: int) -> str:
    """Text "n of N (p %)"."""
    percent = 100 * count / total
    text = "< 0.1" if 0 < percent < 0.1 else f"{percent:.3g}"
    return f"{count} of {total} ({text} %)"
