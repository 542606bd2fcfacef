"""Pictures of a sweep: maps of its numbers, of where it failed, and of orders.

Each takes `xarray` data as `to_xarray` gives them, and returns the `Axes`, one for each panel with
`facet`. Data in a store are read one block at a time: a grid of any size can be drawn.
"""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple, Unpack

import numpy as np
from matplotlib.colors import BoundaryNorm, CenteredNorm, ListedColormap, LogNorm
from matplotlib.patches import Patch

from ..base.checks import one_of
from ..base.keywords import checked_keywords
from . import grid as layout
from .axes import at_edge, cells, entry, flat_cells, legend, scale_of
from .blocks import REDUCTIONS, LineFunction, Picture, count_codes, reduce_to_pixels
from .grid import Grid, GridSettings, NumberSettings, arrange, checked_array, dim_of
from .style import COLOURS, GREY, HATCH, NO_NUMBER, SHADES, ZERO, in_style

_NOT_COMPUTED = "#ffffff"
_MARKS = {NO_NUMBER: ("x", GREY), ZERO: ("v", ZERO)}
"""Colour of cells that are not computed; marker and colour of others along a line."""

_BOTH_SIGNS, _DECADES = 0.05, 2
"""Values of both signs have a centred scale if the smaller side exceeds this fraction; positive
numbers over more decades have a logarithmic scale."""

_GOOD = ("successful", "stopped")
_OPEN = "not_computed"
_STATUS_COLOURS = {
    _OPEN: _NOT_COMPUTED,
    "successful": "#d9d9d9",
    "not_converged": COLOURS[0],
    "not_finite": COLOURS[1],
    "bad_step_size": COLOURS[3],
    "no_root": COLOURS[4],
    "out_of_range": COLOURS[6],
    "stopped": COLOURS[5],
    "not_reached": COLOURS[2],
    "step_control_failed": "#F0E442",
    "inconsistent": "#7f7f7f",
    "redundant": "#404040",
    "lost": "#8c564b",
    "event_not_finite": "#bcbd22",
    "not_returned": "#17becf",
    "too_many_jumps": "#e377c2",
}
"""One colour for each status in all pictures, so that they can be compared."""


@checked_keywords
@in_style
def sweep_map(
    data: Any,
    x: str | None = None,
    y: str | None = None,
    reduce: str = "max",
    log: bool | None = None,
    status: Any = None,
    ax: Any = None,
    **settings: Unpack[NumberSettings],
) -> Any:
    """A map of one variable of a sweep, or a line for a sweep of one dimension.

    - `data`: `DataArray`, e.g. ``result.to_xarray()["drift"]``. Nothing is loaded as a whole.
    - `x`, `y`: dimensions, or one-dimensional coordinates along them; None: the first free ones.
    - `facet`: dimension of which each value has a panel. `over`: dimensions that are reduced.
    - `reduce`: "max", "min", "mean" or "median" of the numbers that meet in one pixel: those of
      `over`, and neighbours where there are more points than `pixels`, (width, height): (480, 320)
      at most. Numbers that are not finite are left out; the legend counts them.
    - `log`: scale of the numbers; None: logarithmic for positive numbers over two decades. Then
      exact zeros are black.
    - `status`: that of the same sweep; distinguishes failed from not computed cells.
    - `limits`: (low, high) of the scale. `ax`: where to draw; None: a new figure.

    Axes are logarithmic if that spaces their values more evenly. Pixels without a number are
    hatched grey.

    **Returns** the `Axes`, an array of them with `facet`. **Raises** `TypeError` unless the data
    are an array of numbers; `ValueError` for dimensions that do not exist or are too many, a median
    of more numbers than are read at a time, and other invalid input.
    """
    data = checked_array(data)
    one_of("reduce", reduce, REDUCTIONS)
    grid = arrange(data, x, y, settings)
    label = layout.label_of(data, data.name or "value")
    fewer = any(len(place.centres) < place.bins.size for place in grid.places)
    if fewer or any(data.sizes[dim] > 1 for dim in grid.reduced_dims):
        label = f"{REDUCTIONS[reduce]} {label}"
    pictures = [reduce_to_pixels(panel, grid.bins, reduce) for _, panel in grid.panels]
    counts = None if status is None else _count_beside(status, grid)
    scale = _scale(pictures, log, settings.get("limits"))
    return _draw(grid, pictures, label, "no number", ax, scale, counts)


@checked_keywords
@in_style
def slope_map(
    data: Any,
    along: str = "epsilon",
    x: str | None = None,
    y: str | None = None,
    local: bool = False,
    floor: float = 0.0,
    reduce: str = "mean",
    ax: Any = None,
    **settings: Unpack[NumberSettings],
) -> Any:
    """A map of orders: slopes d log(data) / d log(along), such as that of a drift over ε.

    - `along`: dimension, or coordinate along one, with positive values; a value 0 is left out.
    - `local`: False: the least-squares slope along the dimension, over the others. True, or if
      `along` is `x` or `y`: slopes between neighbours, at the geometric means of their values.
    - `floor`: numbers that are not above it, such as round-off, are left out.
    - `reduce`: of the slopes that meet in one pixel. Other arguments, with `facet`, `over`,
      `pixels` and `limits`, as for `sweep_map`; each block that is read holds whole lines along
      the dimension.

    Pixels without a slope (fewer than two positive numbers) are hatched grey.

    **Returns** the `Axes`, an array of them with `facet`. **Raises** as `sweep_map`; `ValueError`
    for a dimension with fewer than two positive values.
    """
    import xarray as xr

    data = checked_array(data)
    one_of("reduce", reduce, REDUCTIONS)
    dim = dim_of(data, along, "along")
    values, order = _positive(data, along)
    x, y = (along if name is not None and dim_of(data, name) == dim else name for name in (x, y))
    local = local or along in (x, y)
    replacements: dict[str, Any] = {along: None}
    if local:
        if along not in (x, y) and None not in (x, y):
            raise ValueError(f"local=True needs {along!r} as x or y, got x={x!r}, y={y!r}.")
        if along not in (x, y):
            x, y = (along, y) if x is None else (x, along)
        middle = np.sqrt(values[1:] * values[:-1])
        coords = {along: (dim, middle, data.coords[along].attrs)}
        replacements = {along: xr.DataArray(middle, dims=[dim], coords=coords)}
    grid = arrange(data, x, y, settings, replacements)
    lines = LineFunction(dim, partial(_slopes, np.log(values), order, floor, local))
    pictures = [reduce_to_pixels(panel, grid.bins, reduce, lines) for _, panel in grid.panels]
    name = str(data.name or "data").replace("_", " ")
    over_what = layout.label_of(data.coords[along], along).partition(" [")[0]
    label = f"{'local ' if local else ''}exponent s in {name} ∝ {over_what}^s"
    scale = _scale(pictures, False, settings.get("limits"))
    return _draw(grid, pictures, label, "no slope", ax, scale)


@checked_keywords
@in_style
def failure_map(
    data: Any,
    x: str | None = None,
    y: str | None = None,
    reduce: str = "any",
    ax: Any = None,
    **settings: Unpack[GridSettings],
) -> Any:
    """A map of the status of each trajectory of a sweep.

    - `data`: the `Dataset`, or its ``status``, with `flag_values` and `flag_meanings`.
    - `reduce`: "any": a pixel has the colour of its most frequent failure if there is one, so that
      none is hidden; "fraction": the fraction that failed of those that are computed. A run that
      was stopped by its condition has not failed.
    - Other arguments, with `facet`, `over` and `pixels`, as for `sweep_map`.

    The legend counts the trajectories of each status.

    **Returns** the `Axes`, an array of them with `facet`. **Raises** `TypeError` or `ValueError`
    for data without a status, and as `sweep_map`.
    """
    status = _status_of("data", data)
    one_of("reduce", reduce, ("any", "fraction"))
    grid = arrange(status, x, y, settings)
    statuses = _count("data", status, grid, (panel for _, panel in grid.panels))
    codes, names = statuses.codes, statuses.names
    if reduce == "fraction":
        pictures = []
        for c in statuses.counts:
            total_computed = c[~statuses.open].sum(0)
            values = c[statuses.bad].sum(0) / np.where(total_computed, total_computed, np.nan)
            pictures.append(Picture(values, int(c[statuses.open].sum()), int(c.sum())))
        label = "fraction of trajectories that failed"
        return _draw(grid, pictures, label, "not computed", ax, _scale(pictures, False, (0, 1)))
    axes = grid.axes(ax, 1.9 if grid.y is None else None)
    colours = [_STATUS_COLOURS.get(n, COLOURS[i % len(COLOURS)]) for i, n in enumerate(names)]
    norm = BoundaryNorm([*(c - 0.5 for c in codes), codes[-1] + 0.5], len(codes))
    for axis, c in zip(axes, statuses.counts, strict=True):
        # Its most frequent failure, else its most frequent status.
        failures = c * statuses.bad.reshape(-1, *(1,) * (c.ndim - 1))
        commonest = np.where(failures.any(0), failures.argmax(0), c.argmax(0))
        status_codes, edges = np.asarray(codes)[commonest], [place.edges for place in grid.places]
        if grid.y is None:  # a strip
            status_codes, edges = status_codes[None], [np.asarray([0.0, 1.0]), *edges]
            axis.set_yticks([])
        _frame(axis)
        look: Any = {"cmap": ListedColormap(colours), "norm": norm, "rasterized": True}
        axis.pcolormesh(edges[1], edges[0], status_codes, **look)
    total = np.sum([c.reshape(len(codes), -1).sum(1) for c in statuses.counts], axis=0)
    entries = [
        _flag(colour, f"{name.replace('_', ' ')}: {_share(int(n), int(total.sum()))}")
        for colour, name, n in zip(colours, names, total, strict=True)
        if n
    ]
    dressed_axes = grid.dress(axes)
    legend(axes[0], ax is None, entries, artists=False)
    return dressed_axes


def _scale(pictures: Sequence[Picture], log: bool | None, limits: Any) -> tuple[Any, str]:
    """(norm, `extend`) for all panels: logarithmic for positive numbers over decades, with a
    middle for numbers of both signs. **Raises** `ValueError` for a scale that is impossible.
    """
    numbers = np.concatenate([np.ravel(p.values) for p in pictures])
    numbers = numbers[np.isfinite(numbers)]
    positive = numbers[numbers > 0]
    if log is None:
        log = positive.size > 0 and bool((numbers >= 0).all())
        log = log and bool(positive.max() > 10**_DECADES * positive.min())
    if log and (numbers < 0).any():
        raise ValueError(
            f"log=True requires values of at least 0, got {numbers.min():.3g}: draw abs(data)."
        )
    if limits is not None:
        low, high = layout.two_numbers(limits)
        if not low < high or (log and low <= 0):
            rule = "two increasing positive numbers" if log else "two increasing numbers"
            raise ValueError(f"limits must be {rule}, got {limits!r}.")
    elif not log and numbers.size:
        negative, largest = -numbers.min(), numbers.max()
        if min(negative, largest) > _BOTH_SIGNS * max(negative, largest):
            return CenteredNorm(0, max(negative, largest)), "neither"
    return scale_of(numbers, limits, log)


def _draw(
    grid: Grid,
    pictures: list[Picture],
    label: str,
    cause: str,
    ax: Any,
    scale: tuple[Any, str],
    statuses: "_Statuses | None" = None,
) -> Any:
    """Numbers in their colours, with a bar and a legend of cells without a number."""
    norm, ends = scale
    log, signs = isinstance(norm, LogNorm), isinstance(norm, CenteredNorm)
    axes, mesh, line = grid.axes(ax), None, grid.y is None
    for i, (axis, picture) in enumerate(zip(axes, pictures, strict=True)):
        values = picture.values
        zero, invalid = (values == 0) & log, ~np.isfinite(values)
        numbers = np.where(zero | invalid, np.nan, values)
        if grid.y is None:
            # A line, over marks at the bottom where there is no number.
            centres, mark = grid.x.centres, "o" if values.size <= 60 else ""
            axis.plot(centres, numbers, marker=mark, color=COLOURS[0])
            axis.set(yscale="log" if log else "linear", ylabel=label)
            for mask, kind in ((zero, ZERO), (invalid, NO_NUMBER)):
                marker, colour = _MARKS[kind]
                at_edge(axis, centres[mask], marker, 0.025, color=colour, ms=4.5)
            continue
        _frame(axis)
        edges = grid.x.edges, grid.y.edges
        mesh = cells(axis, *edges, numbers, norm, "PuOr_r" if signs else SHADES)
        flat_cells(axis, *edges, zero, ZERO)
        if statuses is not None:
            is_open = statuses.counts[i][~statuses.open].sum(0) == 0
            flat_cells(axis, *edges, is_open & np.isnan(values), _NOT_COMPUTED)
    dressed_axes = grid.dress(axes)
    if mesh is not None:
        axes[0].figure.colorbar(mesh, ax=list(axes), label=label, extend=ends)
    points, invalid = sum(p.points for p in pictures), sum(p.absent for p in pictures)
    open_points = 0
    if statuses is not None:
        share_open = sum(c[statuses.open].sum() for c in statuses.counts) / np.sum(statuses.counts)
        open_points = round(share_open * points)
    counts = {
        (NO_NUMBER, cause): invalid - open_points,
        (_NOT_COMPUTED, "not computed"): open_points,
    }
    entries = [
        _flag(colour, f"{text}: {_share(count, points)}", line)
        for (colour, text), count in counts.items()
        if count > 0
    ]
    if log and any((p.values == 0).any() for p in pictures):
        entries.append(_flag(ZERO, "exactly 0", line))
    legend(axes[0], ax is None, entries, artists=False)
    return dressed_axes


def _frame(axis: Any) -> None:
    """No grid, and a line all around: white cells belong to the map."""
    axis.grid(False)
    axis.spines[:].set_visible(True)


def _flag(colour: str, label: str, line: bool = False) -> Any:
    """An entry of a legend, of a map or of a line."""
    if line and colour in _MARKS:
        marker, colour_of_mark = _MARKS[colour]
        return entry(label, marker=marker, color=colour_of_mark, ls="none")
    plain = {"facecolor": colour, "edgecolor": "#8c8c8c", "lw": 0.6}
    return Patch(label=label, **(HATCH if colour == NO_NUMBER else plain))


def _share(count: int, total: int) -> str:
    """Text "n of N (p %)"."""
    percent = 100 * count / total
    text = "< 0.1" if 0 < percent < 0.1 else f"{percent:.3g}"
    return f"{count} of {total} ({text} %)"


def _positive(data: Any, coordinate: str) -> tuple[np.ndarray, np.ndarray]:
    """(positive values of a coordinate, rising; their places along the dimension)."""
    values = data.coords[coordinate].values if coordinate in data.coords else np.zeros(0)
    order = np.zeros(0, int)
    if values.dtype.kind in "iuf":
        order = np.argsort(values, kind="stable")
        order = order[np.isfinite(values[order]) & (values[order] > 0)]
    if len(order) < 2 or (np.diff(values[order]) == 0).any():
        raise ValueError(
            f"along={coordinate!r} must have as coordinate two or more positive numbers, all "
            f"different, got {values!r:.100}: choose one of {layout.names_of(data)}."
        )
    return np.asarray(values[order], float), order


def _slopes(x: np.ndarray, order: np.ndarray, floor: float, local: bool, lines: np.ndarray) -> Any:
    """Slopes of the numbers above the floor along the first axis: between neighbours, (n − 1, ...).

    Not `local`: Σ (x − x̄) y / Σ (x − x̄)² over these numbers, shape (1, ...).
    """
    lines = np.asarray(lines[order], float)
    valid = np.isfinite(lines) & (lines > max(floor, 0.0))
    y, x = np.log(np.where(valid, lines, np.nan)), x.reshape(-1, *(1,) * (lines.ndim - 1))
    if local:
        return np.diff(y, axis=0) / np.diff(x, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        from_mean = np.where(valid, x - (valid * x).sum(0) / valid.sum(0), 0.0)
        slopes = (from_mean * np.where(valid, y, 0.0)).sum(0) / (from_mean**2).sum(0)
    return np.where(valid.sum(0) > 1, slopes, np.nan)[None]


class _Statuses(NamedTuple):
    """Codes, rising, with their names; which say that nothing is computed, and which are failures;
    for each panel how often each occurs in each pixel, shape (codes, *pixels).
    """

    codes: list[int]
    names: list[str]
    open: np.ndarray
    bad: np.ndarray
    counts: list[np.ndarray]


def _status_of(name: str, data: Any) -> Any:
    import xarray as xr

    if isinstance(data, xr.Dataset):
        if "status" not in data:
            names = ", ".join(map(str, data.data_vars)) or "no variables"
            raise ValueError(f"{name} must contain the variable status, got a Dataset of {names}.")
        data = data["status"]
    return checked_array(data)


def _count(name: str, status: Any, grid: Grid, panels: Iterable[Any]) -> _Statuses:
    """The statuses in the pixels of a map."""
    values, meanings = map(status.attrs.get, ("flag_values", "flag_meanings"))
    if values is None or meanings is None or len(values) != len(meanings.split()):
        raise ValueError(
            f"{name} must have attributes flag_values and flag_meanings, a word for each value, "
            f"got {values!r} and {meanings!r}: give the status of dvi.sweep(...).to_xarray()."
        )
    codes, names = zip(*sorted(zip(map(int, values), meanings.split(), strict=True)), strict=True)
    counts = [count_codes(panel, grid.bins, codes) for panel in panels]
    is_open = np.asarray([name == _OPEN for name in names])
    bad = np.asarray([name not in (*_GOOD, _OPEN) for name in names])
    return _Statuses(list(codes), list(names), is_open, bad, counts)


def _count_beside(status: Any, grid: Grid) -> _Statuses:
    """The statuses in the pixels of a map of other numbers."""
    status = _status_of("status", status)
    facets = [] if grid.facet is None else [dim_of(status, grid.facet)]
    dims = [*grid.bins, *facets]
    map_dims = (*dims, *grid.reduced_dims)
    excess = [dim for dim in status.dims if dim not in map_dims and status.sizes[dim] > 1]
    if excess or any(dim not in status.dims for dim in dims):
        raise ValueError(
            f"status must have the dimensions {', '.join(dims)} of the map and no others, got "
            f"{layout.names_of(status)}: give that of the same sweep and selection."
        )
    selections = (dict.fromkeys(facets, i) for i in range(len(grid.panels)))
    return _count("status", status, grid, (status.isel(selection) for selection in selections))
