"""Pictures of a sweep: maps of its numbers, of where it failed, and of orders.

Each takes `xarray` data as `to_xarray` gives them, and returns the `Axes`, one for each panel with
`facet`. Data that lie in a store are read one block at a time: a grid of any size can be drawn.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap

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
    data = panels.checked_array(data, "sweep_map")
    _check_reduce(reduce, REDUCTIONS)
    grid = panels.arrange(data, x, y, facet, over, pixels)
    label = label_of(data, data.name or "value")
    if _is_reduced(grid, data):
        label = f"{REDUCTIONS[reduce]} {label}"
    pictures = [reduced(panel, grid.bins, reduce) for _, panel in grid.panels]
    opens = None if status is None else _open_cells(status, grid, facet)
    return _draw(grid, pictures, label, log, limits, ax, opens, "no number")


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

    data = panels.checked_array(data, "slope_map")
    _check_reduce(reduce, REDUCTIONS)
    dim = dim_of(data, along)
    values, order = _positive(data, along)
    others = [over] if isinstance(over, str) else list(over)
    if any(dim_of(data, name) == dim for name in ([facet] if facet else []) + others):
        raise ValueError(f"slopes along {along!r} leave nothing of it for a facet or for over.")
    x, y = (along if name is not None and dim_of(data, name) == dim else name for name in (x, y))
    local = local or along in (x, y)
    made: dict[str, Any] = {along: None}
    if local:
        if along not in (x, y):
            x, y = _with_along(along, x, y)
        middle = np.sqrt(values[1:] * values[:-1])
        about = data.coords[along].attrs
        made = {along: xr.DataArray(middle, dims=[dim], coords={along: (dim, middle, about)})}
    make = partial(_local_slopes if local else _fitted_slopes, np.log(values), order, floor)
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
    _check_reduce(reduce, ("any", "fraction"))
    codes, names = _flags(status)
    grid = panels.arrange(status, x, y, facet, over, pixels)
    counts = [count_codes(panel, grid.bins, codes) for _, panel in grid.panels]
    if reduce == "fraction":
        pictures = [_failed_share(c, names) for c in counts]
        label = "share of trajectories that failed"
        return _draw(grid, pictures, label, False, (0, 1), ax, None, "not computed")
    axes = panels.make_axes(grid, ax, 1.9 if grid.y is None else None)
    for axis, count in zip(axes, counts, strict=True):
        _draw_statuses(axis, grid, _shown(count, codes, names), codes, names)
    panels.finish(axes, grid)
    total = np.sum([c.reshape(len(codes), -1).sum(1) for c in counts], axis=0)
    entries = [
        flag(_colour(name, i), f"{name.replace('_', ' ')}: {share(int(n), int(total.sum()))}")
        for i, (name, n) in enumerate(zip(names, total, strict=True))
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
    opens: tuple[list[np.ndarray], float] | None,
    what: str,
) -> Any:
    """Numbers in their colours, with a bar and a legend of what has none."""
    scale = panels.make_scale([p.values for p in pictures], log, limits)
    axes = panels.make_axes(grid, ax)
    mesh = None
    for i, (axis, picture) in enumerate(zip(axes, pictures, strict=True)):
        mesh = panels.draw_values(axis, grid, picture.values, scale)
        if opens is not None and grid.y is not None:
            where = opens[0][i] & np.isnan(picture.values)
            flat_cells(axis, grid.x.edges, grid.y.edges, where, NOT_COMPUTED)
    panels.finish(axes, grid)
    panels.colour_bar(axes, mesh, scale, label)
    points = sum(p.points for p in pictures)
    counts = {NO_NUMBER: sum(p.missing for p in pictures)}
    if opens is not None:
        counts[NOT_COMPUTED] = round(opens[1] * points)
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


def _check_reduce(reduce: Any, known: Any) -> None:
    if reduce not in known:
        raise ValueError(f"reduce must be one of {', '.join(map(repr, known))}, got {reduce!r}.")


def _with_along(along: str, x: str | None, y: str | None) -> tuple[str, str | None]:
    """x and y, with the dimension of the slopes for the one that is free."""
    if x is not None and y is not None:
        raise ValueError(f"local slopes are along {along!r}: name it as x or y, or leave one out.")
    return (along, y) if x is None else (x, along)


def _is_reduced(grid: Grid, data: Any) -> bool:
    fewer = any(len(p.centres) < p.bins.size for p in grid.places)
    return fewer or any(data.sizes[d] > 1 for d in grid.over)


def _positive(data: Any, along: str) -> tuple[np.ndarray, np.ndarray]:
    """(positive values of a coordinate, rising; their places along the dimension)."""
    if along not in data.coords:
        raise ValueError(
            f"{along!r} has no values to take a slope along; choose one of {names_of(data)}."
        )
    values = data.coords[along].values
    if values.dtype.kind not in "iuf":
        raise ValueError(f"{along!r} has no numbers to take a slope along: {values.dtype}.")
    order = np.argsort(values, kind="stable")
    order = order[np.isfinite(values[order]) & (values[order] > 0)]
    if len(np.unique(values[order])) < max(2, len(order)):
        raise ValueError(
            f"a slope along {along!r} needs two or more positive values, all different: it has "
            f"{len(order)} positive ones, {len(np.unique(values[order]))} of them different."
        )
    return np.asarray(values[order], float), order


def _logs(order: np.ndarray, floor: float, lines: np.ndarray) -> np.ndarray:
    """Logarithms of what lies above the floor, NaN elsewhere."""
    lines = np.asarray(lines[order], float)
    good = np.isfinite(lines) & (lines > max(floor, 0.0))
    return np.log(np.where(good, lines, np.nan))


def _fitted_slopes(x: np.ndarray, order: np.ndarray, floor: float, lines: np.ndarray) -> np.ndarray:
    """Σ (x − x̄) y / Σ (x − x̄)² over the numbers that are there, shape (1, ...)."""
    y = _logs(order, floor, lines)
    there = ~np.isnan(y)
    x = x.reshape(-1, *(1 for _ in y.shape[1:]))
    with np.errstate(invalid="ignore", divide="ignore"):
        from_mean = np.where(there, x - (there * x).sum(0) / there.sum(0), 0.0)
        slopes = (from_mean * np.where(there, y, 0.0)).sum(0) / (from_mean**2).sum(0)
    return np.where(there.sum(0) > 1, slopes, np.nan)[None]


def _local_slopes(x: np.ndarray, order: np.ndarray, floor: float, lines: np.ndarray) -> np.ndarray:
    """Slopes between neighbours, shape (n − 1, ...)."""
    y = _logs(order, floor, lines)
    return np.diff(y, axis=0) / np.diff(x).reshape(-1, *(1 for _ in y.shape[1:]))


# --- statuses -----------------------------------------------------------------------------------


def _status_of(data: Any) -> Any:
    import xarray as xr

    if isinstance(data, xr.Dataset):
        if "status" not in data:
            held = ", ".join(map(str, data.data_vars))
            raise ValueError(f"the Dataset has no status: it contains {held}.")
        data = data["status"]
    return panels.checked_array(data, "failure_map")


def _flags(status: Any) -> tuple[list[int], list[str]]:
    """(codes, names) of the statuses, rising."""
    values, meanings = (status.attrs.get(name) for name in ("flag_values", "flag_meanings"))
    if values is None or meanings is None or len(values) != len(meanings.split()):
        raise ValueError(
            "the status needs the attributes flag_values and flag_meanings, one name for each "
            "value, as to_xarray() of a sweep gives them."
        )
    pairs = sorted(zip((int(v) for v in values), meanings.split(), strict=True))
    return [code for code, _ in pairs], [name for _, name in pairs]


def _open_cells(status: Any, grid: Grid, facet: str | None) -> tuple[list[np.ndarray], float]:
    """(for each panel: pixels of which nothing is computed; share of trajectories that are not)."""
    status = _status_of(status)
    codes, names = _flags(status)
    wanted = [*grid.bins] + ([dim_of(status, facet)] if facet is not None else [])
    others = [str(d) for d in status.dims if d not in [*wanted, *grid.over] and status.sizes[d] > 1]
    if others or any(d not in status.dims for d in wanted):
        raise ValueError(
            f"the status has the dimensions {names_of(status)}; those of the map are "
            f"{', '.join(wanted)}: select the same of both."
        )
    found, not_computed, points = [], 0, 0
    is_open = np.asarray([name == _OPEN for name in names])
    for i in range(len(grid.panels)):
        panel = status if facet is None else status.isel({dim_of(status, facet): i})
        counts = count_codes(panel, grid.bins, codes)
        found.append(counts[~is_open].sum(0) == 0)
        not_computed, points = not_computed + counts[is_open].sum(), points + counts.sum()
    return found, float(not_computed / points)


def _is_bad(names: list[str]) -> np.ndarray:
    """Which statuses are failures."""
    return np.asarray([name not in (*_GOOD, _OPEN) for name in names])


def _shown(counts: np.ndarray, codes: list[int], names: list[str]) -> np.ndarray:
    """The code of each pixel: its commonest failure, else its commonest status."""
    failures = counts * _is_bad(names).reshape(-1, *(1 for _ in counts.shape[1:]))
    commonest = np.where(failures.any(0), failures.argmax(0), counts.argmax(0))
    return np.asarray(codes)[commonest]


def _failed_share(counts: np.ndarray, names: list[str]) -> Picture:
    is_open = np.asarray([name == _OPEN for name in names])
    computed = counts[~is_open].sum(0)
    values = counts[_is_bad(names)].sum(0) / np.where(computed, computed, np.nan)
    return Picture(values, int(counts[is_open].sum()), int(counts.sum()))


def _draw_statuses(
    axis: Any, grid: Grid, shown: np.ndarray, codes: list[int], names: list[str]
) -> None:
    """Statuses as cells; of one dimension a strip."""
    panels.frame(axis)
    if grid.y is None:
        y, shown = np.asarray([0.0, 1.0]), shown[None]
        axis.set_yticks([])
    else:
        y = grid.y.edges
    colours = ListedColormap([_colour(name, i) for i, name in enumerate(names)])
    norm = BoundaryNorm([*(c - 0.5 for c in codes), codes[-1] + 0.5], len(codes))
    axis.pcolormesh(grid.x.edges, y, shown, cmap=colours, norm=norm, rasterized=True)


def _colour(name: str, place: int) -> str:
    return _STATUS_COLOURS.get(name, COLOURS[place % len(COLOURS)])
