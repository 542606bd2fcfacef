"""Grids drawn in fewer pixels than they have points: read block by block, reduced on the way."""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

BLOCK = 2**21
"""Numbers of a grid that are in memory at a time, 16 MiB of float64."""

REDUCTIONS = {"max": "largest", "min": "smallest", "mean": "mean", "median": "median"}
"""How the numbers of one pixel become one → the name of the result."""


class Bins(NamedTuple):
    """Which of n points of a dimension belong to which pixel.

    `starts`: where each pixel begins, shape (pixels,). `order`: the points in the order in which
    they are drawn, shape (n,); None: as they are.
    """

    size: int
    starts: np.ndarray
    order: np.ndarray | None = None

    @property
    def ends(self) -> np.ndarray:
        """Where each pixel begins, and where the last one ends."""
        return np.append(self.starts, self.size)

    def points(self, first: int, last: int) -> Any:
        """The points of the pixels from `first` to before `last`, as a slice if possible."""
        a, b = (int(x) for x in self.ends[[first, last]])
        return slice(a, b) if self.order is None else np.sort(self.order[a:b])

    def pixels(self, selection: Any) -> np.ndarray:
        """The pixel of each point of a selection."""
        points = selection
        if isinstance(selection, slice):
            points = np.arange(*selection.indices(self.size))
        if self.order is not None:
            points = np.argsort(self.order)[points]
        return np.searchsorted(self.starts, points, side="right") - 1


def make_bins(size: int, pixels: int, order: np.ndarray | None = None) -> Bins:
    """Pixels with nearly equal counts of points; one point each if there are enough pixels."""
    count = min(size, pixels)
    return Bins(size, np.arange(count) * size // count, order)


class LineFunction(NamedTuple):
    """Function of lines along `dim`, from shape (n, ...) to (m, ...), applied before the reduction.

    If `dim` is a dimension of the result it has m points there; else m = 1.
    """

    dim: str
    function: Callable[[np.ndarray], np.ndarray]


class Picture(NamedTuple):
    """One number for each pixel, NaN without any; how many points have none, and of how many."""

    values: np.ndarray
    absent: int
    points: int


_COMBINE: dict[str, Any] = {"max": np.fmax, "min": np.fmin, "mean": np.add}


def reduce_to_pixels(
    data: Any, bins: Mapping[str, Bins], reduce: str, lines: LineFunction | None = None
) -> Picture:
    """The values of a `xarray.DataArray`, reduced to pixels; one block is read at a time.

    `bins`: dimension → its pixels, for each axis of the result in turn; the other dimensions are
    reduced as a whole. Entries that are not finite are left out.
    """
    shape, points = tuple(len(b.starts) for b in bins.values()), 0
    values = np.full(math.prod(shape), 0.0 if reduce == "mean" else np.nan)
    counts = np.zeros(values.size, np.int64)
    for pixels, block in blocks(data, bins, lines, one_block=reduce == "median"):
        finite = np.isfinite(block)
        points += block.size
        where, numbers = pixels[finite], block[finite]
        counts += np.bincount(where, minlength=counts.size)
        if reduce == "median":  # every pixel lies in one block
            order = np.lexsort((numbers, where))
            places, first, n = np.unique(where[order], return_index=True, return_counts=True)
            middles = order[first + (n - 1) // 2], order[first + n // 2]
            values[places] = sum(numbers[middle] for middle in middles) / 2
        else:
            _COMBINE[reduce].at(values, where, numbers)
    if reduce == "mean":
        values = values / np.where(counts, counts, np.nan)
    return Picture(values.reshape(shape), points - int(counts.sum()), points)


def count_codes(data: Any, bins: Mapping[str, Bins], codes: Sequence[int]) -> np.ndarray:
    """How often each code occurs in each pixel, shape (codes, *pixels); read block by block."""
    shape = tuple(len(b.starts) for b in bins.values())
    counts = np.zeros((len(codes), math.prod(shape)), np.int64)
    for pixels, block in blocks(data, bins):
        for count, code in zip(counts, codes, strict=True):
            count += np.bincount(pixels[block == code], minlength=count.size)
    return counts.reshape(len(codes), *shape)


def blocks(
    data: Any, bins: Mapping[str, Bins], lines: LineFunction | None = None, one_block: bool = False
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(number of the pixel of each point, the points), both of shape (rest, *points).

    `one_block`: every pixel lies in one block, as a median needs it.
    """
    shape = [len(pixels_of.starts) for pixels_of in bins.values()]
    for selection in selections(data, bins, None if lines is None else lines.dim, one_block):
        block = data.variable.isel(selection).values
        names = list(data.dims)
        if lines is not None:
            block = lines.function(np.moveaxis(block, names.index(lines.dim), 0))
            names = [lines.dim, *(dim for dim in names if dim != lines.dim)]
            selection = selection | {lines.dim: slice(None)}
        outer = [i for i, dim in enumerate(names) if dim not in bins]
        block = block.transpose(*outer, *(names.index(dim) for dim in bins))
        block = block.reshape(-1, *block.shape[len(outer) :])
        places = np.ix_(*(pixels_of.pixels(selection[dim]) for dim, pixels_of in bins.items()))
        yield np.broadcast_to(np.ravel_multi_index(places, shape), block.shape), block


def selections(
    data: Any, bins: Mapping[str, Bins], line: str | None = None, one_block: bool = False
) -> Iterator[dict[str, Any]]:
    """Selections of at most a block, last dimension first, that hold whole lines along `line`.

    A block consists of units: single points, chunks if they are known and fit, or all numbers of a
    pixel for `one_block`. **Raises** `ValueError` if a pixel is larger than a block.
    """
    sizes = dict(zip(data.dims, data.shape, strict=True))
    unit = {d: n if d == line or (one_block and d not in bins) else 1 for d, n in sizes.items()}
    if one_block:
        unit |= {d: int(np.diff(b.ends).max()) for d, b in bins.items() if d != line}
        if math.prod(unit.values()) > BLOCK:
            raise ValueError(
                f"reduce='median' needs at most {BLOCK} numbers in a pixel, got "
                f"{math.prod(unit.values())}: use reduce='mean', or more pixels."
            )
    else:
        preferences = data.encoding.get("preferred_chunks") or {}
        lengths = {d: n for d, n in preferences.items() if isinstance(n, int)}
        chunks = {d: min(lengths[d], n) for d, n in sizes.items() if d in lengths}
        chunks |= {line: sizes[line]} if line is not None else {}
        if len(chunks) == len(sizes) and math.prod(chunks.values()) <= BLOCK:
            unit = chunks
    room, parts = max(1, BLOCK // math.prod(unit.values())), {}
    for d in reversed(data.dims):
        size, step = sizes[d], unit[d]
        pixels = bins[d] if one_block and d in bins and d != line else None
        total = -(-size // step) if pixels is None else len(pixels.starts)
        count = min(total, max(room, 1))
        room //= count
        starts = range(0, total, count)
        if pixels is None:
            parts[d] = [slice(i * step, min((i + count) * step, size)) for i in starts]
        else:
            parts[d] = [pixels.points(i, min(i + count, total)) for i in starts]
    for ranges in itertools.product(*(parts[d] for d in data.dims)):
        yield dict(zip(data.dims, ranges, strict=True))
