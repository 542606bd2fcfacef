"""Indices, known and traced: slices, gather, scatter, argmax."""

import dataclasses
from typing import Any

import numpy as np

from ..evaluator import RULES, Evaluator
from ..llvm.builder import Builder
from ..llvm.ir import Num, Unsupported
from ..llvm.memory import contiguous, load
from ..llvm.values import MADE, Value

# Name of a primitive → operation on an element and its update; releases of JAX differ in names.
SCATTERS = {
    "scatter": None,
    **{f"scatter{mark}{op}": op for op in ("add", "sub", "mul", "max", "min") for mark in "-_"},
}


def iota(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    params = eqn.params
    shape, axis = params["shape"], params["dimension"]
    line = np.arange(shape[axis], dtype=params["dtype"])
    other = [1] * len(shape)
    other[axis] = shape[axis]
    return [e.constant(np.broadcast_to(line.reshape(other), shape))]


def empty(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    """An array that is written before it is read."""
    (out,) = eqn.outvars
    return [e.constant(np.zeros(out.aval.shape, out.aval.dtype))]


def argument_of(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    """argmax, argmin: the first of the largest, or the first NaN."""
    (value,), b = values, e.b
    (out,) = eqn.outvars
    (axis,) = eqn.params["axes"]
    op = "gt" if eqn.primitive.name == "argmax" else "lt"
    rows = np.moveaxis(e.entries(value), axis, 0).reshape((value.shape[axis], -1))
    dtype, results = str(out.aval.dtype), []
    for column in rows.T:
        best, where = column[0], b.known(0, dtype)
        for i, x in enumerate(column[1:], 1):
            better = b.compare(op, x, best)
            if x.is_float:  # a NaN is larger than all, and the first of them stays
                nan = b.logic("and", b.is_nan(x), b.invert(b.is_nan(best)))
                better = b.logic("or", better, nan)
            best = b.select(better, x, best)
            where = b.select(better, b.known(i, dtype), where)
        results.append(where)
    return [e.value(results, out.aval)]


def _clipped(b: Builder, x: Num, most: int) -> Num:
    """The index of type int64 that is nearest to x, 0 ≤ index ≤ most."""
    low = b.maximum(b.convert(x, "int64"), b.known(0, "int64"))
    return b.maximum(low, b.known(most, "int64"), "lt")


def _starts(e: Evaluator, starts: list[Value], shape: Any, sizes: Any) -> list[Num]:
    """Where a part of `sizes` begins in an array of `shape`, inside of it."""
    return [
        _clipped(e.b, e.entries(s)[()], n - m) for s, n, m in zip(starts, shape, sizes, strict=True)
    ]


def _pick(e: Evaluator, value: Value, index: Num) -> Num:
    """The element at a row-major index that lies inside of the array."""
    b = e.b
    if index.known is not None and value.entries is not None:
        return value.entries.flat[int(index.known)]
    # Selections among a few numbers in registers take less time than a way through memory.
    if value.entries is not None and value.size <= 8:
        result = value.entries.flat[0]
        for i in range(1, value.size):
            here = b.compare("eq", index, b.known(i, "int64"))
            result = b.select(here, value.entries.flat[i], result)
        return result
    flat = e.reshaped(value, (value.size,))
    return load(b, flat, b.mul(index, b.known(flat.strides[0], "int64")))


def dynamic_slice(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    value, *starts = values
    (out,) = eqn.outvars
    b, sizes = e.b, eqn.params["slice_sizes"]
    at = _starts(e, starts, value.shape, sizes)
    if value.entries is None and not value.is_small:
        # A long array stays in memory, and only its pointer moves.
        buffer = value.buffer
        assert buffer is not None
        for start, stride in zip(at, buffer.strides, strict=True):
            buffer = buffer.moved(b.mul(start, b.known(stride, "int64")))
        buffer = dataclasses.replace(buffer, shape=tuple(sizes))
        return [Value(sizes, value.dtype, buffer=buffer)]
    value = Value(value.shape, value.dtype, e.entries(value), value.buffer)
    strides = contiguous(value.shape)
    results = []
    for i in np.ndindex(tuple(sizes)):
        total = b.known(0, "int64")
        for start, k, stride in zip(at, i, strides, strict=True):
            place = b.add(start, b.known(k, "int64"))
            total = b.add(total, b.mul(place, b.known(stride, "int64")))
        results.append(_pick(e, value, total))
    return [e.value(results, out.aval)]


def dynamic_update_slice(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    value, update, *starts = values
    b = e.b
    at = _starts(e, starts, value.shape, update.shape)
    entries = e.entries(value).copy()
    # Each element is compared with each start: the code grows with the product of the sizes.
    if value.size * update.size > MADE:
        raise Unsupported(
            f"size of array × size of update must be at most {MADE} for an update at a computed "
            f"index, got shapes {value.shape} and {update.shape}"
        )
    news = e.entries(update)
    for i in np.ndindex(value.shape):
        for k in np.ndindex(update.shape):
            # The start that puts element k of the update to place i; none may lie outside.
            first = [x - y for x, y in zip(i, k, strict=True)]
            limits = zip(first, value.shape, update.shape, strict=True)
            if not all(0 <= x <= n - m for x, n, m in limits):
                continue
            here = b.known(True, "bool")
            for start, x in zip(at, first, strict=True):
                here = b.logic("and", here, b.compare("eq", start, b.known(x, "int64")))
            entries[i] = b.select(here, news[k], entries[i])
    return [Value(value.shape, value.dtype, entries)]


def gather(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    value, indices = values
    (out,) = eqn.outvars
    b, params = e.b, eqn.params
    dims, sizes = params["dimension_numbers"], params["slice_sizes"]
    mode, shape = str(params["mode"]), out.aval.shape
    starts = e.entries(indices)
    collapsed = (*dims.collapsed_slice_dims, *dims.operand_batching_dims)
    window = [d for d in range(len(value.shape)) if d not in collapsed]
    batch = [d for d in range(len(shape)) if d not in dims.offset_dims]
    strides = contiguous(value.shape)
    small = Value(value.shape, value.dtype, value.entries, value.buffer)
    if value.is_small:
        small.entries = e.entries(value)
    fill = params["fill_value"]
    if fill is None:
        fill = _default_fill(value.dtype)
    results = []
    for o in np.ndindex(*shape):
        where = tuple(o[d] for d in batch)
        total, inside = b.known(0, "int64"), b.known(True, "bool")
        for d, offset in zip(window, (o[d] for d in dims.offset_dims), strict=True):
            total = b.add(total, b.known(offset * strides[d], "int64"))
        batching = dims.operand_batching_dims, dims.start_indices_batching_dims
        for d, k in zip(*batching, strict=True):
            total = b.add(total, b.known(where[k] * strides[d], "int64"))
        for j, d in enumerate(dims.start_index_map):
            start = b.convert(starts[(*where, j)], "int64")
            clipped = _clipped(b, start, value.shape[d] - sizes[d])
            # The load itself has to be inside of the array; the result is replaced afterwards.
            if "fill" in mode.lower():
                inside = b.logic("and", inside, b.compare("eq", clipped, start))
            total = b.add(total, b.mul(clipped, b.known(strides[d], "int64")))
        number = _pick(e, small, total)
        results.append(b.select(inside, number, b.known(fill, value.dtype)))
    return [e.value(results, out.aval)]


def _default_fill(dtype: str) -> Any:
    """The value that JAX returns for elements outside of an array."""
    if np.issubdtype(dtype, np.floating):
        return np.nan
    if dtype == "bool":
        return True
    return np.iinfo(dtype).min if np.issubdtype(dtype, np.signedinteger) else np.iinfo(dtype).max


def scatter(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    value, indices, updates = values
    b, params = e.b, eqn.params
    dims, mode = params["dimension_numbers"], str(params["mode"]).lower()
    op = SCATTERS[eqn.primitive.name]
    entries, news = e.entries(value).copy(), e.entries(updates)
    starts = e.entries(indices)
    inserted = (*dims.inserted_window_dims, *dims.operand_batching_dims)
    window = [d for d in range(len(value.shape)) if d not in inserted]
    batch = [d for d in range(len(updates.shape)) if d not in dims.update_window_dims]
    sizes = dict.fromkeys(range(len(value.shape)), 1)
    for d, k in zip(window, dims.update_window_dims, strict=True):
        sizes[d] = updates.shape[k]
    if value.size * updates.size > 4 * MADE:
        raise Unsupported(
            f"size of array × size of update must be at most {4 * MADE} for {eqn.primitive.name}, "
            f"got shapes {value.shape} and {updates.shape}"
        )

    def updated(old: Num, new: Num) -> Num:
        if op is None:
            return new
        return b.sub(old, new) if op == "sub" else e.combine(op, old, new)

    for k in np.ndindex(updates.shape):
        where = tuple(k[d] for d in batch)
        fixed = dict.fromkeys(range(len(value.shape)), 0)
        for d, offset in zip(window, (k[d] for d in dims.update_window_dims), strict=True):
            fixed[d] = offset
        batching = dims.operand_batching_dims, dims.scatter_indices_batching_dims
        for d, j in zip(*batching, strict=True):
            fixed[d] = where[j]
        moving, inside = {}, b.known(True, "bool")
        for j, d in enumerate(dims.scatter_dims_to_operand_dims):
            start = b.convert(starts[(*where, j)], "int64")
            clipped = _clipped(b, start, value.shape[d] - sizes[d])
            # In the other modes JAX drops an update outside of the array.
            if "clip" not in mode:
                inside = b.logic("and", inside, b.compare("eq", clipped, start))
            moving[d] = clipped
        # An update that is known to lie outside writes no code.
        if inside.known is not None and not inside.known:
            continue
        for i in np.ndindex(value.shape):
            here = inside
            for d, x in enumerate(i):
                at = b.known(x - fixed[d], "int64")
                start = moving.get(d, b.known(0, "int64"))
                here = b.logic("and", here, b.compare("eq", start, at))
                if here.known is not None and not here.known:
                    break
            else:
                entries[i] = b.select(here, updated(entries[i], news[k]), entries[i])
    return [Value(value.shape, value.dtype, entries)]


RULES |= {
    "iota": iota,
    "empty": empty,
    "empty2": empty,
    "argmax": argument_of,
    "argmin": argument_of,
}
RULES |= {"dynamic_slice": dynamic_slice, "dynamic_update_slice": dynamic_update_slice}
RULES |= {"gather": gather, **dict.fromkeys(SCATTERS, scatter)}
