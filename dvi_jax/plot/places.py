"""Positions and tick labels of the points of a dimension along an axis of a picture."""

from typing import Any, NamedTuple

import numpy as np

from .axes import cell_edges
from .blocks import Bins, make_bins

_GREEK = {"epsilon": "ε", "h": "step size h", "start": "number of the start", "t0": "t$_0$"}
_MOST_NAMES = 12
"""Names that are written along an axis."""


class Place(NamedTuple):
    """An axis of a picture.

    - `dim`, `label`: the dimension along it, and what it is called, with units.
    - `bins`: the points of each pixel; `edges`: of the pixels, shape (pixels + 1,).
    - `centres`: of the pixels, shape (pixels,).
    - `log`: whether the axis is logarithmic; `zero`: where on it the value 0 is put, or None.
    - `names`: (positions, texts) of what has no number, or None.
    """

    dim: str
    label: str
    bins: Bins
    edges: np.ndarray
    centres: np.ndarray
    log: bool = False
    zero: float | None = None
    names: tuple[np.ndarray, list[str]] | None = None


def find_place(data: Any, name: str, pixels: int) -> Place:
    """The axis along a dimension, or along a one-dimensional coordinate that has the name.

    Numbers that are all different are put in their order, on a logarithmic axis where they are
    spaced like that; a 0 before such numbers has a place of its own at the left. Anything else has
    its position, with its name as a label.
    """
    dim = dim_of(data, name)
    size = data.sizes[dim]
    values, label = None, label_of(None, name)
    if name in data.coords:  # of others xarray would make 0, 1, 2, … of any length
        values, label = data.coords[name].values, label_of(data.coords[name], name)
    if values is None or not _has_places(values):
        bins, every = make_bins(size, pixels), -(-size // _MOST_NAMES)
        edges = bins.ends - 0.5
        texts = None if values is None else [_short(v) for v in values[::every]]
        names = None if texts is None else (np.arange(0, size, every), texts)
        return Place(dim, label, bins, edges, (edges[1:] + edges[:-1]) / 2, names=names)
    rising = bool((np.diff(values) > 0).all())
    order = None if rising else np.argsort(values, kind="stable")
    bins = make_bins(size, pixels, order)
    x = np.asarray(values if order is None else values[order], float)
    log, zero = is_log(x), None
    if not log and size > 3 and x[0] == 0 and is_log(x[1:]):
        log, zero = True, float(x[1] ** 2 / x[2])
        x = np.asarray([zero, *x[1:]])
    edges = cell_edges(x, log)
    centres = x
    if len(bins.starts) < size:
        last = bins.ends[1:] - 1
        low, high = x[bins.starts], x[last]
        centres = np.sqrt(low) * np.sqrt(high) if log else (low + high) / 2
    return Place(dim, label, bins, edges[bins.ends], centres, log, zero)


def dim_of(data: Any, name: str) -> str:
    """The dimension of a name, which may be a coordinate along it.

    **Raises** `ValueError` if there is none, with those that there are.
    """
    if name in data.dims:
        return name
    if name in data.coords and data.coords[name].ndim == 1:
        return str(data.coords[name].dims[0])
    raise ValueError(f"there is no dimension {name!r}: there are {names_of(data)}.")


def names_of(data: Any) -> str:
    """Names that can be an axis, for an error message."""
    sizes = ", ".join(f"{d} ({n})" for d, n in data.sizes.items())
    others = [str(c) for c in data.coords if c not in data.dims and data.coords[c].ndim == 1]
    return (sizes or "none") + (f", and along them {', '.join(others)}" if others else "")


def label_of(variable: Any, name: Any) -> str:
    """The long name of a variable, or its name as the field writes it, with its units."""
    attributes = variable.attrs if variable is not None else {}
    text = attributes.get("long_name") or _GREEK.get(str(name)) or str(name).replace("_", " ")
    units = attributes.get("units")
    return text if units in (None, "", "1") else f"{text} [{units}]"


def is_log(x: np.ndarray) -> bool:
    """Whether rising numbers are spaced more evenly on a logarithmic axis, over a factor of 4."""
    if len(x) < 3 or x[0] <= 0 or x[-1] < 4 * x[0]:
        return False
    return _unevenness(np.log(x)) < 0.5 * _unevenness(x)


def _unevenness(x: np.ndarray) -> float:
    steps = np.diff(x / np.abs(x).max())
    return float(np.std(steps) / np.mean(steps))


def _has_places(values: np.ndarray) -> bool:
    """Whether these are numbers, finite and all different."""
    numbers = values.dtype.kind in "iuf" and bool(np.isfinite(values).all())
    return numbers and len(np.unique(values)) == len(values)


def _short(value: Any) -> str:
    text = f"{value:g}" if isinstance(value, float | np.floating) else str(value)
    return text if len(text) <= 24 else text[:23] + "…"
