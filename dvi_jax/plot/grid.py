"""Axes and panels of a map: assignment of dimensions, positions of their points, tick labels."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypedDict

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import LogFormatterMathtext, LogLocator

from ..base.checks import instance
from .axes import at_most, canvas, cell_edges, check_not_empty, check_real, stack
from .blocks import Bins, make_bins
from .style import with_unit

_PIXELS = 480, 320
"""Largest numbers of pixels in x and y."""

_GREEK = {"epsilon": "ε", "h": "step size h", "start": "initial condition", "t0": "t$_0$"}
_MOST_NAMES, _MOST_PANELS = 12, 16
"""Names that are written along an axis; panels of a figure."""


class GridSettings(TypedDict, total=False):
    """Keywords of all maps.

    - `facet`: dimension of which each value has a panel. `over`: dimensions that are reduced.
    - `pixels`: (width, height), the largest numbers of pixels; by default (480, 320).
    """

    facet: str | None
    over: str | Sequence[str] | None
    pixels: tuple[float, float] | None


class NumberSettings(GridSettings, total=False):
    """The same, and `limits`: (low, high) of the scale of the numbers."""

    limits: tuple[float, float] | None


class GridAxis(NamedTuple):
    """An axis along a dimension, with edges (pixels + 1,) and centres (pixels,) of its pixels.

    `zero`: where on a logarithmic axis the value 0 is put, or None. `names`: (positions, texts) of
    values that are not numbers, or None.
    """

    dim: str
    label: str
    bins: Bins
    edges: np.ndarray
    centres: np.ndarray
    log: bool = False
    zero: float | None = None
    names: tuple[np.ndarray, list[str]] | None = None

    def dress(self, axis: Any, letter: str) -> None:
        """Set the scale, the limits, the label and the ticks of the x or y axis."""
        ticks = getattr(axis, f"set_{letter}ticks")
        if self.log:
            axis.set(**{f"{letter}scale": "log"})
        axis.set(**{f"{letter}lim": tuple(self.edges[[0, -1]]), f"{letter}label": self.label})
        if self.names is not None:
            positions, texts = self.names
            long = letter == "x" and sum(map(len, texts)) > 60
            turn = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"} if long else {}
            ticks(positions, texts, **turn)
        if self.zero is not None:
            low, high = np.sqrt(self.zero * self.centres[1]), self.edges[-1]
            major, minor = (
                [t for t in LogLocator(subs=subs).tick_values(low, high) if low <= t <= high]
                for subs in ((1.0,), tuple(range(2, 10)))
            )
            ticks([self.zero, *major], ["0", *map(LogFormatterMathtext(), major)])
            ticks(minor, minor=True, labels=[""] * len(minor))


def find_axis(data: Any, name: str, pixels: int) -> GridAxis:
    """The axis along a dimension, or along a one-dimensional coordinate that has the name.

    Numbers that are all different are put in their order, on a logarithmic axis if that spaces
    them more evenly; a 0 before such numbers has a place of its own at the left. Anything else has
    its position, with its name as a label.
    """
    dim = dim_of(data, name)
    size = data.sizes[dim]
    values, label = None, label_of(None, name)
    if name in data.coords:  # of others xarray would make 0, 1, 2, … of any length
        values, label = data.coords[name].values, label_of(data.coords[name], name)
    numbers = values is not None and values.dtype.kind in "iuf" and np.isfinite(values).all()
    if values is None or not numbers or len(np.unique(values)) < size:
        bins, stride = make_bins(size, pixels), -(-size // _MOST_NAMES)
        edges = bins.ends - 0.5
        texts = None if values is None else [_short(v) for v in values[::stride]]
        names = None if texts is None else (np.arange(0, size, stride), texts)
        return GridAxis(dim, label, bins, edges, (edges[1:] + edges[:-1]) / 2, names=names)
    rising = bool((np.diff(values) > 0).all())
    order = None if rising else np.argsort(values, kind="stable")
    bins = make_bins(size, pixels, order)
    x = np.asarray(values if order is None else values[order], float)
    log, zero = _is_log(x), None
    if not log and size > 3 and x[0] == 0 and _is_log(x[1:]):
        log, zero = True, float(x[1] ** 2 / x[2])
        x = np.asarray([zero, *x[1:]])
    edges, centres = cell_edges(x, log), x
    if len(bins.starts) < size:
        low, high = x[bins.starts], x[bins.ends[1:] - 1]
        centres = np.sqrt(low) * np.sqrt(high) if log else (low + high) / 2
    return GridAxis(dim, label, bins, edges[bins.ends], centres, log, zero)


def dim_of(data: Any, name: str, role: str = "each of x, y, facet, over and along") -> str:
    """The dimension of a name, which may be a coordinate along it; `role`: its argument.

    **Raises** `ValueError` with this role.
    """
    if name in data.dims:
        return name
    if name in data.coords and data.coords[name].ndim == 1:
        return str(data.coords[name].dims[0])
    raise ValueError(f"{role} must be one of the dimensions {names_of(data)}, got {name!r}.")


def names_of(data: Any) -> str:
    """Names that can be an axis, for an error message."""
    sizes = ", ".join(f"{d} ({n})" for d, n in data.sizes.items())
    coordinates = [str(c) for c in data.coords if c not in data.dims and data.coords[c].ndim == 1]
    tail = f", with the coordinates {', '.join(coordinates)}" if coordinates else ""
    return (sizes or "none") + tail


def label_of(variable: Any, name: Any) -> str:
    """The long name of a variable, or its name as it is usually written, with its units."""
    attributes = variable.attrs if variable is not None else {}
    text = attributes.get("long_name") or _GREEK.get(str(name)) or str(name).replace("_", " ")
    return with_unit(text, attributes.get("units"))


def _is_log(x: np.ndarray) -> bool:
    """Whether rising numbers are spaced more evenly on a logarithmic axis, over a factor of 4."""
    if len(x) < 3 or x[0] <= 0 or x[-1] < 4 * x[0]:
        return False
    logarithms, linear = (np.diff(v / np.abs(v).max()) for v in (np.log(x), x))
    return np.std(logarithms) / np.mean(logarithms) < 0.5 * np.std(linear) / np.mean(linear)


def _short(value: Any) -> str:
    text = f"{value:g}" if isinstance(value, float | np.floating) else str(value)
    return text if len(text) <= 24 else text[:23] + "…"


class Grid(NamedTuple):
    """(title, array) of each panel, and the axes that all panels share; no `y` for a line.

    `reduced_dims`: dimensions of which the numbers meet in a pixel.
    """

    panels: list[tuple[str, Any]]
    x: GridAxis
    y: GridAxis | None
    reduced_dims: tuple[str, ...]
    facet: str | None

    @property
    def places(self) -> list[GridAxis]:
        """The axes in the order of an array that is drawn: y, x."""
        return [self.x] if self.y is None else [self.y, self.x]

    @property
    def bins(self) -> dict[str, Any]:
        return {place.dim: place.bins for place in self.places}

    def axes(self, ax: Any, height: float | None = None) -> list[Any]:
        """One `Axes` for each panel: `ax`, or those of a new figure; `height` of a single one."""
        count = len(self.panels)
        if ax is not None:
            if count > 1:
                raise ValueError(f"facet={self.facet!r} makes a figure of {count} maps: omit ax.")
            return [canvas(ax)[0]]
        if count == 1:
            size = None if height is None else (plt.rcParams["figure.figsize"][0], height)
            return [canvas(None, size)[0]]
        columns = min(count, 3 if count > 4 else 2)
        size = (1.4 + 2.7 * columns, 1.0 + 2.3 * -(-count // columns))
        return stack(None, count, "one for each", size, columns, sharex=True, sharey=True)[0]

    def dress(self, axes: Sequence[Any]) -> Any:
        """Set scales, ticks, labels and titles; returns the axes, an array of them for a facet."""
        for i, ((title, _), axis) in enumerate(zip(self.panels, axes, strict=True)):
            self.x.dress(axis, "x")
            if self.y is not None:
                self.y.dress(axis, "y")
            if title:
                axis.set_title(title)
            if len(axes) > 1:
                columns = axis.get_subplotspec().get_gridspec().ncols
                last = i + columns >= len(axes)
                axis.tick_params(labelbottom=last)
                axis.set_xlabel(axis.get_xlabel() if last else "")
                axis.set_ylabel(axis.get_ylabel() if i % columns == 0 else "")
        return axes[0] if self.facet is None else np.asarray(axes)


def arrange(
    data: Any, x: str | None, y: str | None, settings: Mapping[str, Any], replacements: Any = None
) -> Grid:
    """Assign dimensions to x, y and facets; those that are not named become x and y in turn.

    `replacements`: name → array that replaces that of the data for its axis; None for a
    dimension that does not appear. **Raises** `ValueError` for a dimension that does not exist, is
    named twice, or is in excess.
    """
    facet, reduced_names, pixels = map(settings.get, ("facet", "over", "pixels"))
    reduced_names = reduced_names or ()
    width, height = two_numbers(_PIXELS if pixels is None else pixels)
    if not (width >= 1 and height >= 1):
        raise ValueError(f"pixels must be (width, height), both at least 1, got {pixels!r}.")
    for dimension, size in data.sizes.items():
        check_not_empty(f"data along {dimension!r}", range(size), "change the selection")
    reduced_names = (reduced_names,) if isinstance(reduced_names, str) else tuple(reduced_names)
    replacements = replacements or {}
    roles = {"x": x, "y": y, "facet": facet, **{f"over={name!r}": name for name in reduced_names}}
    roles |= {f"along={name!r}": name for name, array in replacements.items() if array is None}
    roles_of: dict[str, str] = {}
    for role, name in roles.items():
        dim = None if name is None else dim_of(data, name, role.partition("=")[0])
        if dim in roles_of:
            raise ValueError(
                f"{role} and {roles_of[dim]} must use different dimensions, got {dim!r} for both."
            )
        roles_of |= {} if dim is None else {dim: role}
    left = [str(d) for d in data.dims if d not in roles_of]
    free = [d for d in left if data.sizes[d] > 1]
    if x is None:
        x, y = (free.pop(0), y) if free else (y, None)
    if y is None and free:
        y = free.pop(0)
    if x is None:
        raise ValueError(
            "data must have a dimension of size 2 or more for x that is not used otherwise, got "
            f"{names_of(data)}; used: {[*roles_of] or 'none'}."
        )
    if free:
        raise ValueError(
            f"a map has two dimensions, here {x!r} and {y!r}, but data also has "
            f"{', '.join(map(repr, free))}: select data.isel({', '.join(f'{d}=0' for d in free)}), "
            f"reduce with over={[*reduced_names, *free]}, or use facet."
        )
    data = data.isel({d: 0 for d in left if data.sizes[d] == 1})
    arrays: dict[Any, Any] = dict.fromkeys((x, y), data) | replacements
    along_x = find_axis(arrays[x], x, int(width))
    along_y = None if y is None else find_axis(arrays[y], y, int(height))
    dims = tuple(dim_of(data, name) for name in reduced_names)
    return Grid(_panels(data, facet), along_x, along_y, dims, facet)


def two_numbers(values: Any) -> tuple[float, float]:
    """Two numbers; NaN, which fails every comparison, for anything else."""
    try:
        first, second = (float(value) for value in values)
    except (TypeError, ValueError):
        return np.nan, np.nan
    return first, second


def _panels(data: Any, facet: str | None) -> list[tuple[str, Any]]:
    if facet is None:
        return [("", data)]
    dim = dim_of(data, facet)
    count = data.sizes[dim]
    selection = f"data.isel({dim}=slice(None, None, {-(-count // _MOST_PANELS)}))"
    at_most(_MOST_PANELS, count, f"values of facet={facet!r}", selection)
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
    check_real("data", data)
    return data
