"""Pictures of a sweep: maps of its numbers, of where it failed, and of orders.

Each takes `xarray` data as `to_xarray` gives them, and returns the `Axes`, one for each panel with
`facet`. Data that lie in a store are read one block at a time: a grid of any size can be drawn.
"""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap

from .._checks import one_of
from . import panels
from .axes import flat_cells, legend
from .blocks import REDUCTIONS, Lines, Picture, count_codes, reduced
from .panels import NOT_COMPUTED, Grid, flag, share
from .places import dim_of, label_of, names_of
from .style import COLOURS, NO_NUMBER, ZERO, in_style

PIXELS = (480, 320)
"""Largest number of pixels of a map, in x and y."""

_GOOD = ("successful", "stopped")
_OPEN = "not_computed"
_STATUS_COLOURS = {
    _OPEN: NOT_COMPUTED,
    "successful": "#d9d9d9",
    "not_converged": COLOURS[0],
    "not_finite": COLOURS[1],
    "bad_step_size": COLOURS[3],
    "no_root": COLOURS[4],
    "out_of_range": COLOURS[6],
    "stopped": COLOURS[5],
    "not_reached": COLOURS[2],
}
"""One colour for each status in all pictures, so that they can be compared."""


class _Statuses(NamedTuple):
    """How the trajectories of each panel ended: codes, rising, with their names.

    - `counts`: for each panel how often each occurs in each pixel, shape (codes, *pixels).
    """

    codes: list[int]
    names: list[str]
    counts: list[np.ndarray]

    @property
    def open(self) -> np.ndarray:
        """Which statuses say that nothing is computed."""
        return np.asarray([name == _OPEN for name in self.names])

    @property
    def bad(self) -> np.ndarray:
        """Which statuses are failures."""
        return np.asarray([name not in (*_GOOD, _OPEN) for name in self.names])


@in_style
def sweep_map(
    data: Any,
    x: str | None = None,
    y: str | None = None,
    facet: str | None = None,
    over: str | Sequence[str] = (),
    reduce: str = "max",
    log: bool | None = None,
    status: Any = None,
    limits: tuple[float, float] | None = None,
    ax: Any = None,
    pixels: tuple[int, int] = PIXELS,
) -> Any:
    """A map of one variable of a sweep; of one dimension a line.

    - `data`: `DataArray`, e.g. ``result.to_xarray()["drift"]``. Nothing is loaded as a whole.
    - `x`, `y`: dimensions, or one-dimensional coordinates along them; None: those left, in turn.
    - `facet`: dimension of which each value has a panel. `over`: dimensions that are reduced.
    - `reduce`: "max", "min", "mean" or "median" of the numbers that meet in one pixel: those of
      `over`, and neighbours where there are more points than `pixels`, (width, height). What is
      not finite is left out; the legend says how much that was.
    - `log`: scale of the numbers; None: logarithmic for positive numbers over two decades. Then
      exact zeros are black.
    - `status`: that of the same sweep; distinguishes failed from not computed cells.
    - `limits`: (low, high) of the scale. `ax`: where to draw; None: a new figure.

    Axes are logarithmic where the values are spaced so. Pixels without a number are hatched grey.

    **Returns** the `Axes`, an array of them with `facet`.

    **Raises** `TypeError` for what is no array of numbers; `ValueError` for dimensions that are not
    there or too many, a median of more numbers than are read at a time, and other invalid input.
    """
    data = panels.checked_array(data)
    one_of("reduce", reduce, REDUCTIONS)
    grid = panels.arrange(data, x, y, facet, over, pixels)
    label = label_of(data, data.name or "value")
    fewer = any(len(place.centres) < place.bins.size for place in grid.places)
    if fewer or any(data.sizes[d] > 1 for d in grid.over):
        label = f"{REDUCTIONS[reduce]} {label}"
    pictures = [reduced(panel, grid.bins, reduce) for _, panel in grid.panels]
    found = None if status is None else _count_beside(status, grid, facet)
    return _draw(grid, pictures, label, log, limits, ax, found, "no number")


@in_style
def slope_map(
    data: Any,
    along: str = "epsilon",
    x: str | None = None,
    y: str | None = None,
    facet: str | None = None,
    over: str | Sequence[str] = (),
    local: bool = False,
    floor: float = 0.0,
    reduce: str = "mean",
    limits: tuple[float, float] | None = None,
    ax: Any = None,
    pixels: tuple[int, int] = PIXELS,
) -> Any:
    """A map of orders: slopes d log(data) / d log(along), such as that of a drift over ε.

    - `along`: dimension, or coordinate along one, with positive values; a value 0 is left out.
    - `local`: False: the least-squares slope along the dimension, over the others. True, or if
      `along` is `x` or `y`: slopes between neighbours, at the geometric means of their values.
    - `floor`: numbers that are not above it, such as round-off, are left out.
    - `reduce`: of the slopes that meet in one pixel. Other arguments as for `sweep_map`; each block
      that is read holds whole lines along the dimension.

    Pixels without a slope (fewer than two positive numbers) are hatched grey.

    **Returns** the `Axes`, an array of them with `facet`.

    **Raises** as `sweep_map`; `ValueError` for a dimension with fewer than two positive values.
    """
    import xarray as xr

    data = panels.checked_array(data)
    one_of("reduce", reduce, REDUCTIONS)
    dim = dim_of(data, along)
    values, order = _positive(data, along)
    others = [over] if isinstance(over, str) else list(over)
    if any(dim_of(data, name) == dim for name in ([facet] if facet else []) + others):
        raise ValueError(f"slopes along {along!r} leave nothing of it for a facet or for over.")
    x, y = (along if name is not None and dim_of(data, name) == dim else name for name in (x, y))
    local = local or along in (x, y)
    made: dict[str, Any] = {along: None}
    if local:
        if along not in (x, y) and None not in (x, y):
            raise ValueError(
                f"local slopes are along {along!r}: name it as x or y, or leave one out."
            )
        if along not in (x, y):
            x, y = (along, y) if x is None else (x, along)
        middle = np.sqrt(values[1:] * values[:-1])
        about = data.coords[along].attrs
        made = {along: xr.DataArray(middle, dims=[dim], coords={along: (dim, middle, about)})}
    make = partial(_slopes, np.log(values), order, floor, local)
    grid = panels.arrange(data, x, y, facet, over, pixels, made)
    lines = Lines(dim, make, local)
    pictures = [reduced(panel, grid.bins, reduce, lines) for _, panel in grid.panels]
    name = str(data.name or "data").replace("_", " ")
    over_what = label_of(data.coords[along], along).partition(" [")[0]
    label = f"{'local slope' if local else 'slope'} of log {name} over log {over_what}"
    return _draw(grid, pictures, label, False, limits, ax, None, "no slope")


@in_style
def failure_map(
    data: Any,
    x: str | None = None,
    y: str | None = None,
    facet: str | None = None,
    over: str | Sequence[str] = (),
    reduce: str = "any",
    ax: Any = None,
    pixels: tuple[int, int] = PIXELS,
) -> Any:
    """A map of how the trajectories of a sweep ended.

    - `data`: the `Dataset`, or its ``status``, with `flag_values` and `flag_meanings`.
    - `reduce`: "any": a pixel has the colour of its commonest failure if there is a single one, so
      that none is hidden; "fraction": the share that failed of those that are computed. A run that
      was stopped by its condition has not failed.
    - Other arguments as for `sweep_map`.

    The legend counts the trajectories of each status.

    **Returns** the `Axes`, an array of them with `facet`.

    **Raises** `TypeError` or `ValueError` for data without a status, and as `sweep_map`.
    """
    status = _status_of(data)
    one_of("reduce", reduce, ("any", "fraction"))
    grid = panels.arrange(status, x, y, facet, over, pixels)
    found = _count(status, grid, (panel for _, panel in grid.panels))
    codes, names = found.codes, found.names
    if reduce == "fraction":
        pictures = []
        for c in found.counts:
            computed = c[~found.open].sum(0)
            values = c[found.bad].sum(0) / np.where(computed, computed, np.nan)
            pictures.append(Picture(values, int(c[found.open].sum()), int(c.sum())))
        label = "share of trajectories that failed"
        return _draw(grid, pictures, label, False, (0, 1), ax, None, "not computed")
    axes = panels.make_axes(grid, ax, 1.9 if grid.y is None else None)
    colours = [_STATUS_COLOURS.get(n, COLOURS[i % len(COLOURS)]) for i, n in enumerate(names)]
    norm = BoundaryNorm([*(c - 0.5 for c in codes), codes[-1] + 0.5], len(codes))
    for axis, c in zip(axes, found.counts, strict=True):
        # Its commonest failure, else its commonest status.
        failures = c * found.bad.reshape(-1, *(1,) * (c.ndim - 1))
        commonest = np.where(failures.any(0), failures.argmax(0), c.argmax(0))
        shown, edges = np.asarray(codes)[commonest], [place.edges for place in grid.places]
        if grid.y is None:  # a strip
            shown, edges = shown[None], [np.asarray([0.0, 1.0]), *edges]
            axis.set_yticks([])
        panels.frame(axis)
        look: Any = {"cmap": ListedColormap(colours), "norm": norm, "rasterized": True}
        axis.pcolormesh(edges[1], edges[0], shown, **look)
    panels.finish(axes, grid)
    total = np.sum([c.reshape(len(codes), -1).sum(1) for c in found.counts], axis=0)
    entries = [
        flag(colour, f"{name.replace('_', ' ')}: {share(int(n), int(total.sum()))}")
        for colour, name, n in zip(colours, names, total, strict=True)
        if n
    ]
    legend(axes[0], ax is None, entries, labelled=False)
    return axes[0] if facet is None else np.asarray(axes)


# --- numbers ------------------------------------------------------------------------------------


def _draw(
    grid: Grid,
    pictures: list[Picture],
    label: str,
    log: bool | None,
    limits: Any,
    ax: Any,
    found: _Statuses | None,
    what: str,
) -> Any:
    """Numbers in their colours, with a bar and a legend of what has none."""
    scale = panels.make_scale([p.values for p in pictures], log, limits)
    axes = panels.make_axes(grid, ax)
    mesh = None
    for i, (axis, picture) in enumerate(zip(axes, pictures, strict=True)):
        mesh = panels.draw_values(axis, grid, picture.values, scale)
        if found is not None and grid.y is not None:
            nothing = found.counts[i][~found.open].sum(0) == 0
            where = nothing & np.isnan(picture.values)
            flat_cells(axis, grid.x.edges, grid.y.edges, where, NOT_COMPUTED)
    panels.finish(axes, grid)
    panels.colour_bar(axes, mesh, scale, label)
    points = sum(p.points for p in pictures)
    counts = {NO_NUMBER: sum(p.missing for p in pictures)}
    if found is not None:
        share_open = sum(c[found.open].sum() for c in found.counts) / np.sum(found.counts)
        counts[NOT_COMPUTED] = round(share_open * points)
        counts[NO_NUMBER] -= counts[NOT_COMPUTED]
    names, line = {NO_NUMBER: what, NOT_COMPUTED: "not computed"}, grid.y is None
    entries = [
        flag(colour, f"{names[colour]}: {share(count, points)}", line)
        for colour, count in counts.items()
        if count > 0
    ]
    if scale.log and any((p.values == 0).any() for p in pictures):
        entries.append(flag(ZERO, "exactly 0", line))
    legend(axes[0], ax is None, entries, labelled=False)
    return axes[0] if len(grid.panels) == 1 and not grid.panels[0][0] else np.asarray(axes)


def _positive(data: Any, along: str) -> tuple[np.ndarray, np.ndarray]:
    """(positive values of a coordinate, rising; their places along the dimension)."""
    if along not in data.coords or data.coords[along].dtype.kind not in "iuf":
        raise ValueError(
            f"{along!r} has no numbers to take a slope along; choose one of {names_of(data)}."
        )
    values = data.coords[along].values
    order = np.argsort(values, kind="stable")
    order = order[np.isfinite(values[order]) & (values[order] > 0)]
    different = len(np.unique(values[order]))
    if different < max(2, len(order)):
        raise ValueError(
            f"a slope along {along!r} needs two or more positive values, all different: it has "
            f"{len(order)} positive ones, {different} of them different."
        )
    return np.asarray(values[order], float), order


def _slopes(
    x: np.ndarray, order: np.ndarray, floor: float, local: bool, lines: np.ndarray
) -> np.ndarray:
    """Slopes along the first axis of what lies above the floor: between neighbours, (n − 1, ...).

    Not `local`: Σ (x − x̄) y / Σ (x − x̄)² over the numbers that are there, shape (1, ...).
    """
    lines = np.asarray(lines[order], float)
    there = np.isfinite(lines) & (lines > max(floor, 0.0))
    y, x = np.log(np.where(there, lines, np.nan)), x.reshape(-1, *(1,) * (lines.ndim - 1))
    if local:
        return np.diff(y, axis=0) / np.diff(x, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        from_mean = np.where(there, x - (there * x).sum(0) / there.sum(0), 0.0)
        slopes = (from_mean * np.where(there, y, 0.0)).sum(0) / (from_mean**2).sum(0)
    return np.where(there.sum(0) > 1, slopes, np.nan)[None]


# --- statuses -----------------------------------------------------------------------------------


def _status_of(data: Any) -> Any:
    import xarray as xr

    if isinstance(data, xr.Dataset):
        if "status" not in data:
            held = ", ".join(map(str, data.data_vars))
            raise ValueError(f"the Dataset has no status: it contains {held}.")
        data = data["status"]
    return panels.checked_array(data)


def _count(status: Any, grid: Grid, panels: Iterable[Any]) -> _Statuses:
    """The statuses in the pixels of a map."""
    values, meanings = (status.attrs.get(name) for name in ("flag_values", "flag_meanings"))
    if values is None or meanings is None or len(values) != len(meanings.split()):
        raise ValueError(
            "the status needs the attributes flag_values and flag_meanings, one name for each "
            "value, as to_xarray() of a sweep gives them."
        )
    codes, names = zip(*sorted(zip(map(int, values), meanings.split(), strict=True)), strict=True)
    counts = [count_codes(panel, grid.bins, codes) for panel in panels]
    return _Statuses(list(codes), list(names), counts)


def _count_beside(status: Any, grid: Grid, facet: str | None) -> _Statuses:
    """The statuses in the pixels of a map of other numbers."""
    status = _status_of(status)
    along = [] if facet is None else [dim_of(status, facet)]
    wanted = [*grid.bins, *along]
    others = [d for d in status.dims if d not in (*wanted, *grid.over) and status.sizes[d] > 1]
    if others or any(d not in status.dims for d in wanted):
        raise ValueError(
            f"the status has the dimensions {names_of(status)}; those of the map are "
            f"{', '.join(wanted)}: select the same of both."
        )
    selections = (dict.fromkeys(along, i) for i in range(len(grid.panels)))
    return _count(status, grid, (status.isel(one) for one in selections))
