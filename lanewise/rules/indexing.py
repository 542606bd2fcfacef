"""Indices, known and traced: slices, gather, scatter, argmax."""

import dataclasses
from typing import Any

import numpy as np

from ..evaluator import RULES, Evaluator
from ..llvm.builder import Builder
from ..llvm.ir import Num, check_size
from ..llvm.memory import contiguous, load
from ..llvm.values import MOST_ENTRIES, Value, Values

# Name of a primitive → operation on an element and its update; releases of JAX differ in names.
SCATTERS = {
    "scatter": None,
    **{f"scatter{mark}{op}": op for op in ("add", "sub", "mul", "max", "min") for mark in "-_"},
}


def iota(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    params = eqn.params
    shape, axis = params["shape"], params["dimension"]
    numbers = np.arange(shape[axis], dtype=params["dtype"])
    rows = np.broadcast_to(numbers, (*shape[:axis], *shape[axis + 1 :], shape[axis]))
    return [evaluator.constant(np.moveaxis(rows, -1, axis))]


def empty(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    """An array that is written before it is read."""
    (out,) = eqn.outvars
    return [evaluator.constant(np.zeros(out.aval.shape, out.aval.dtype))]


def argument_of(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    """argmax, argmin: the first of the largest, or the first NaN."""
    (value,), b = values, evaluator.b
    (out,) = eqn.outvars
    (axis,) = eqn.params["axes"]
    op = "gt" if eqn.primitive.name == "argmax" else "lt"
    rows = np.moveaxis(evaluator.entries(value), axis, 0).reshape((value.shape[axis], -1))
    dtype, results = str(out.aval.dtype), []
    for column in rows.T:
        best, where = column[0], b.const(0, dtype)
        for i, x in enumerate(column[1:], 1):
            better = b.compare(op, x, best)
            if x.is_float:  # a NaN is larger than all, and the first of them stays
                nan = b.logic("and", b.is_nan(x), b.invert(b.is_nan(best)))
                better = b.logic("or", better, nan)
            best = b.select(better, x, best)
            where = b.select(better, b.const(i, dtype), where)
        results.append(where)
    return [evaluator.value(results, out.aval)]


def _clip(b: Builder, x: Num, largest: int) -> Num:
    """The index of type int64 that is nearest to x, 0 ≤ index ≤ most."""
    low = b.maximum(b.convert(x, "int64"), b.const(0, "int64"))
    return b.maximum(low, b.const(largest, "int64"), "lt")


def _starts(evaluator: Evaluator, starts: list[Value], shape: Any, sizes: Any) -> list[Num]:
    """Where a part of `sizes` begins in an array of `shape`, inside of it."""
    triples = zip(starts, shape, sizes, strict=True)
    return [_clip(evaluator.b, evaluator.entries(start)[()], n - m) for start, n, m in triples]


def _pick(evaluator: Evaluator, value: Value, index: Num) -> Num:
    """The element at a row-major index that lies inside of the array."""
    b = evaluator.b
    if index.value is not None and value.entries is not None:
        return value.entries.flat[int(index.value)]
    # Selections among a few numbers in registers take less time than a way through memory.
    if value.entries is not None and value.size <= 8:
        result = value.entries.flat[0]
        for i in range(1, value.size):
            is_index = b.compare("eq", index, b.const(i, "int64"))
            result = b.select(is_index, value.entries.flat[i], result)
        return result
    flat = evaluator.reshape(value, (value.size,))
    return load(b, flat, b.mul(index, b.const(flat.strides[0], "int64")))


def dynamic_slice(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    value, *starts = values
    (out,) = eqn.outvars
    b, sizes = evaluator.b, eqn.params["slice_sizes"]
    offsets = _starts(evaluator, starts, value.shape, sizes)
    if value.entries is None and not value.is_small:
        # A long array stays in memory, and only its pointer moves.
        buffer = evaluator.in_memory(value)
        for start, stride in zip(offsets, buffer.strides, strict=True):
            buffer = buffer.shift(b.mul(start, b.const(stride, "int64")))
        return [Value.in_memory(dataclasses.replace(buffer, shape=tuple(sizes)))]
    value = Value(value.shape, value.dtype, evaluator.entries(value), value.buffer)
    strides = contiguous(value.shape)
    results = []
    for i in np.ndindex(tuple(sizes)):
        total = b.const(0, "int64")
        for start, k, stride in zip(offsets, i, strides, strict=True):
            place = b.add(start, b.const(k, "int64"))
            total = b.add(total, b.mul(place, b.const(stride, "int64")))
        results.append(_pick(evaluator, value, total))
    return [evaluator.value(results, out.aval)]


def _check_update(value: Value, update: Value, limit: int) -> None:
    size, shapes = value.size * update.size, (value.shape, update.shape)
    check_size(size, limit, "size of array × size of update", *shapes)


def dynamic_update_slice(evaluator: Evaluator, eqn: Any, values: Values, places: list) -> Values:
    value, update, *starts = values
    b = evaluator.b
    offsets = _starts(evaluator, starts, value.shape, update.shape)
    entries = evaluator.entries(value).copy()
    # Each element is compared with each start: the code grows with the product of the sizes.
    _check_update(value, update, MOST_ENTRIES)
    news = evaluator.entries(update)
    for i in np.ndindex(value.shape):
        for k in np.ndindex(update.shape):
            # The start that puts element k of the update to place i; none may lie outside.
            first = [x - y for x, y in zip(i, k, strict=True)]
            limits = zip(first, value.shape, update.shape, strict=True)
            if not all(0 <= x <= n - m for x, n, m in limits):
                continue
            is_target = b.const(True, "bool")
            for start, x in zip(offsets, first, strict=True):
                is_target = b.logic("and", is_target, b.compare("eq", start, b.const(x, "int64")))
            entries[i] = b.select(is_target, news[k], entries[i])
    return [Value(value.shape, value.dtype, entries)]


def gather(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    value, indices = values
    (out,) = eqn.outvars
    b, params = evaluator.b, eqn.params
    dims, sizes = params["dimension_numbers"], params["slice_sizes"]
    mode, shape = str(params["mode"]), out.aval.shape
    starts = evaluator.entries(indices)
    dropped_axes = (*dims.collapsed_slice_dims, *dims.operand_batching_dims)
    window = [d for d in range(len(value.shape)) if d not in dropped_axes]
    batch = [d for d in range(len(shape)) if d not in dims.offset_dims]
    strides = contiguous(value.shape)
    entries = evaluator.entries(value) if value.is_small else None
    small = Value(value.shape, value.dtype, entries, value.buffer)
    fill = params["fill_value"]
    fill = b.const(default_fill(value.dtype) if fill is None else fill, value.dtype)
    results = []
    for o in np.ndindex(*shape):
        where = tuple(o[d] for d in batch)
        total, is_inside = b.const(0, "int64"), b.const(True, "bool")
        for d, offset in zip(window, (o[d] for d in dims.offset_dims), strict=True):
            total = b.add(total, b.const(offset * strides[d], "int64"))
        batching = dims.operand_batching_dims, dims.start_indices_batching_dims
        for d, k in zip(*batching, strict=True):
            total = b.add(total, b.const(where[k] * strides[d], "int64"))
        for j, d in enumerate(dims.start_index_map):
            start = b.convert(starts[(*where, j)], "int64")
            nearest = _clip(b, start, value.shape[d] - sizes[d])
            # The load itself has to be inside of the array; the result is replaced afterwards.
            if "fill" in mode.lower():
                is_inside = b.logic("and", is_inside, b.compare("eq", nearest, start))
            total = b.add(total, b.mul(nearest, b.const(strides[d], "int64")))
        results.append(b.select(is_inside, _pick(evaluator, small, total), fill))
    return [evaluator.value(results, out.aval)]


def default_fill(dtype: str) -> Any:
    """The value that JAX returns for elements outside of an array."""
    if np.issubdtype(dtype, np.floating):
        return np.nan
    if dtype == "bool":
        return True
    return np.iinfo(dtype).min if np.issubdtype(dtype, np.signedinteger) else np.iinfo(dtype).max


def scatter(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    value, indices, updates = values
    b, params = evaluator.b, eqn.params
    dims, mode = params["dimension_numbers"], str(params["mode"]).lower()
    op = SCATTERS[eqn.primitive.name]
    entries, news = evaluator.entries(value).copy(), evaluator.entries(updates)
    starts = evaluator.entries(indices)
    dropped_axes = (*dims.inserted_window_dims, *dims.operand_batching_dims)
    window = [d for d in range(len(value.shape)) if d not in dropped_axes]
    batch = [d for d in range(len(updates.shape)) if d not in dims.update_window_dims]
    sizes = dict.fromkeys(range(len(value.shape)), 1)
    for d, k in zip(window, dims.update_window_dims, strict=True):
        sizes[d] = updates.shape[k]
    _check_update(value, updates, 4 * MOST_ENTRIES)

    def new_entry(old: Num, new: Num) -> Num:
        if op is None:
            return new
        return b.sub(old, new) if op == "sub" else evaluator.combine(op, old, new)

    for k in np.ndindex(updates.shape):
        where = tuple(k[d] for d in batch)
        fixed = dict.fromkeys(range(len(value.shape)), 0)
        for d, offset in zip(window, (k[d] for d in dims.update_window_dims), strict=True):
            fixed[d] = offset
        batching = dims.operand_batching_dims, dims.scatter_indices_batching_dims
        for d, j in zip(*batching, strict=True):
            fixed[d] = where[j]
        moving, is_inside = {}, b.const(True, "bool")
        for j, d in enumerate(dims.scatter_dims_to_operand_dims):
            start = b.convert(starts[(*where, j)], "int64")
            nearest = _clip(b, start, value.shape[d] - sizes[d])
            # In the other modes JAX drops an update outside of the array.
            if "clip" not in mode:
                is_inside = b.logic("and", is_inside, b.compare("eq", nearest, start))
            moving[d] = nearest
        # An update that is known to lie outside writes no code.
        if is_inside.value is not None and not is_inside.value:
            continue
        for i in np.ndindex(value.shape):
            is_target = is_inside
            for d, x in enumerate(i):
                index = b.const(x - fixed[d], "int64")
                start = moving.get(d, b.const(0, "int64"))
                is_target = b.logic("and", is_target, b.compare("eq", start, index))
                if is_target.value is not None and not is_target.value:
                    break
            else:
                entries[i] = b.select(is_target, new_entry(entries[i], news[k]), entries[i])
    return [Value(value.shape, value.dtype, entries)]


RULES |= {"iota": iota, "gather": gather, **dict.fromkeys(SCATTERS, scatter)}
RULES |= {"dynamic_slice": dynamic_slice, "dynamic_update_slice": dynamic_update_slice}
RULES |= {"empty": empty, "empty2": empty, "argmax": argument_of, "argmin": argument_of}
