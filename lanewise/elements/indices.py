"""Long arrays at indices that are known when the code runs: slices, gather, scatter."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..llvm.ir import NotCompilable
from ..rules.indexing import SCATTERS, default_fill
from ..rules.written import EXPANSIONS
from .boxes import Array, repeat
from .equations import ARRAY_RULES, Translation, expand
from .tree import Memory, Update


def iota(translation: Translation, eqn: Any, *_: Array) -> list[Array]:
    params = eqn.params
    shape, axis, dtype = params["shape"], params["dimension"], str(np.dtype(params["dtype"]))
    strides = tuple(int(a == axis) for a in range(len(shape)))
    if all(n == 1 for n in shape):
        return [Array.uniform(translation.table.known(0, dtype), shape)]
    return [Array.uniform(translation.table.expression("index", dtype, strides=strides), shape)]


def empty(translation: Translation, eqn: Any, *_: Array) -> list[Array]:
    aval = eqn.outvars[0].aval
    return [Array.uniform(translation.table.known(0, aval.dtype), aval.shape)]


def unit_vectors(translation: Translation, eqn: Any) -> list[Array]:
    n, dtype = eqn.params["n"], str(eqn.params["dtype"])
    node = translation.table.expression("delta", "bool", strides=(1, -1))
    return [translation.convert(Array.uniform(node, (n, n)), dtype)]


def _clip_index(translation: Translation, x: Array, largest: int) -> Array:
    x = translation.convert(x, "int64")
    return translation.apply("clamp", translation.known(0), x, translation.known(largest))


def _distance(translation: Translation, starts: Sequence[Array], shape, sizes, strides) -> Array:
    """How many elements from the first one a part begins, moved inside of the array."""
    total = translation.known(0)
    for start, n, m, stride in zip(starts, shape, sizes, strides, strict=True):
        i = _clip_index(translation, start, n - m)
        total = translation.apply(
            "add", total, translation.apply("mul", i, translation.known(stride))
        )
    return total


def dynamic_slice(translation: Translation, eqn: Any, x: Array, *starts: Array) -> list[Array]:
    sizes = eqn.params["slice_sizes"]
    clipped = [
        _clip_index(translation, start, n - m)
        for start, n, m in zip(starts, x.shape, sizes, strict=True)
    ]
    index = [repeat(start, sizes) for start in clipped]
    return [translation.picked(x, [a + 1 for a in range(len(sizes))], index)]


def dynamic_update_slice(
    translation: Translation, eqn: Any, x: Array, update: Array, *starts: Array
) -> list[Array]:
    # A copy, of which `places` makes nothing if the old array is not read any more.
    memory = Memory(x.shape, x.dtype)
    translation.store(x, memory.place)
    distance = _distance(translation, starts, x.shape, update.shape, memory.strides)
    distance = translation.let(distance)
    _add_update(translation, memory, memory.strides, distance, update)
    return [memory.load(translation.table)]


def _add_update(
    translation: Translation, memory: Memory, strides, distance: Array, update: Array, op=None
) -> None:
    """`Update` statements for the components of an update."""
    short, long, parts = update.components()
    distances = repeat(distance, update.shape).components()[2]
    for index, part in parts.items():
        offset = sum(strides[a] * i for a, i in zip(short, index, strict=True))
        kept = [strides[a] for a in long]
        translation.add(Update(memory, kept, offset, distances[index], part, op))


def _batch_index(translation: Translation, indices: Array, j: int, batch, shape) -> Array:
    """Component j of the index vectors, along the axes `batch` of an array of a shape."""
    # The last axis of the indices is that of their components.
    rank = len(indices.shape) - 1
    axes = [batch[k] for k in range(rank)] + [None]
    x = indices.along(shape, axes, [0] * rank + [j])
    return translation.convert(x, "int64")


def gather(translation: Translation, eqn: Any, x: Array, indices: Array) -> list[Array]:
    params, shape = eqn.params, eqn.outvars[0].aval.shape
    dims, sizes = params["dimension_numbers"], params["slice_sizes"]
    if not x.size or 0 in shape:
        raise NotCompilable("gather of an array without elements")
    dropped = (*dims.collapsed_slice_dims, *dims.operand_batching_dims)
    window = [d for d in range(len(x.shape)) if d not in dropped]
    batch = [d for d in range(len(shape)) if d not in dims.offset_dims]
    zero = Array.uniform(translation.table.known(0, "int64"), shape)
    index = [zero] * len(x.shape)
    axes = [0] * len(shape)
    for d, k in zip(window, dims.offset_dims, strict=True):
        axes[k] = d + 1
    pairs = zip(dims.operand_batching_dims, dims.start_indices_batching_dims, strict=True)
    for d, k in pairs:
        axes[batch[k]] = d + 1
    is_inside = None
    for j, d in enumerate(dims.start_index_map):
        # XLA moves a part that would reach beyond the end inside.
        start = _batch_index(translation, indices, j, batch, shape)
        index[d] = _clip_index(translation, start, x.shape[d] - sizes[d])
        if "fill" in str(params["mode"]).lower():
            test = translation.apply("eq", index[d], start, dtype="bool")
            is_inside = test if is_inside is None else translation.apply("and", is_inside, test)
    picked = translation.picked(x, axes, index)
    if is_inside is None:
        return [picked]
    fill = params["fill_value"]
    fill = translation.known(default_fill(x.dtype) if fill is None else fill, x.dtype)
    return [translation.apply("select_n", is_inside, fill, picked, dtype=x.dtype)]


def scatter(
    translation: Translation, eqn: Any, x: Array, indices: Array, updates: Array
) -> list[Array]:
    params, shape = eqn.params, updates.shape
    dims = params["dimension_numbers"]
    op = SCATTERS[eqn.primitive.name]
    if not x.size or 0 in shape:
        return [x]
    dropped = (*dims.inserted_window_dims, *dims.operand_batching_dims)
    window = [d for d in range(len(x.shape)) if d not in dropped]
    batch = [d for d in range(len(shape)) if d not in dims.update_window_dims]
    sizes = [1] * len(x.shape)
    for d, k in zip(window, dims.update_window_dims, strict=True):
        sizes[d] = shape[k]
    memory = Memory(x.shape, x.dtype)
    translation.store(x, memory.place)
    strides = [0] * len(shape)
    for d, k in zip(window, dims.update_window_dims, strict=True):
        strides[k] = memory.strides[d]
    for d, k in zip(dims.operand_batching_dims, dims.scatter_indices_batching_dims, strict=True):
        strides[batch[k]] = memory.strides[d]
    distance = Array.uniform(translation.table.known(0, "int64"), shape)
    is_inside = None
    for j, d in enumerate(dims.scatter_dims_to_operand_dims):
        start = _batch_index(translation, indices, j, batch, shape)
        nearest = _clip_index(translation, start, x.shape[d] - sizes[d])
        if "clip" not in str(params["mode"]).lower():
            test = translation.apply("eq", nearest, start, dtype="bool")
            is_inside = test if is_inside is None else translation.apply("and", is_inside, test)
        step = translation.apply("mul", nearest, translation.known(memory.strides[d]))
        distance = translation.apply("add", distance, step)
    if is_inside is not None:
        # JAX drops it, except in the mode that moves it to the nearest place.
        # An update outside of the array goes to no place: −1, after the offset is taken off.
        distance = translation.apply(
            "select_n", is_inside, translation.known(-1), distance, dtype="int64"
        )
    _add_update(translation, memory, strides, distance, updates, op or "")
    return [memory.load(translation.table)]


ARRAY_RULES |= {"iota": iota, "empty": empty, "empty2": empty, "unit_vectors": unit_vectors}
ARRAY_RULES |= {"dynamic_slice": dynamic_slice, "dynamic_update_slice": dynamic_update_slice}
ARRAY_RULES |= {"gather": gather, **dict.fromkeys(SCATTERS, scatter)}
_NUMBER_BY_NUMBER = ("nextafter", "lt_to", "le_to", "threefry2x32", "platform_index")
ARRAY_RULES |= {name: expand(EXPANSIONS[name]) for name in _NUMBER_BY_NUMBER}
