"""Sums and other reductions of long arrays, matrix products, running sums."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from ..jaxprs.extent import SHORT
from ..llvm.ir import NotCompilable
from ..rules.moves import CUMULATIVE, REDUCTIONS
from ..rules.reductions import neutral
from .boxes import Array, Box, Expression, elementwise
from .equations import ARRAY_RULES, BlockScope, Translation, expand, row_major
from .tree import FIXED, Memory, Number, Reduce

_SHORT_ROW = 32  # terms


def reduction(translation: Translation, eqn: Any, x: Array) -> list[Array]:
    op, (out,) = REDUCTIONS[eqn.primitive.name], eqn.outvars
    return [reduction_of(translation, x, op, eqn.params["axes"], out.aval.shape)]


def reduction_of(translation: Translation, x: Array, op: str, axes: Sequence[int], shape) -> Array:
    """The elements combined along some axes."""
    if not x.size:
        return Array.uniform(translation.table.known(neutral(op, x.dtype), x.dtype), shape)
    # Every step of a run asks whether its state is finite.
    if op == "and" and all(_is_finiteness(box) for box in x.boxes):
        return _all_finite(translation, x, axes, shape)
    short, long, parts = x.components()
    kept = [a for a in range(len(x.shape)) if a not in axes]
    # Short axes first.
    terms: dict[tuple, list[Array]] = {}
    for index, part in parts.items():
        key = tuple(i for a, i in zip(short, index, strict=True) if a not in axes)
        terms.setdefault(key, []).append(part)
    totals = {key: _combine_all(op, of) for key, of in terms.items()}
    short_kept = [kept.index(a) for a in short if a not in axes]
    vanish = [k for k, a in enumerate(long) if a in axes]
    if not vanish:
        return translation.from_components(totals, shape, short_kept)
    if len(vanish) == len(long):
        totals = {key: _sum(translation, op, part) for key, part in totals.items()}
        return translation.from_components(totals, shape, short_kept)
    # Some axes are kept: the sums are elements of an array.
    memory = Memory(shape, x.dtype)
    order = _order(totals.values(), len(long))
    for key, part in totals.items():
        offset = sum(memory.strides[a] * i for a, i in zip(short_kept, key, strict=True))
        strides = [0 if k in vanish else memory.strides[kept.index(long[k])] for k in order]
        view = part.along(
            [part.shape[k] for k in order], [order.index(k) for k in range(len(long))]
        )
        axes_of_turned = [order.index(k) for k in vanish]
        translation.add(Reduce(memory, strides, offset, view, op, axes_of_turned))
    return memory.load(translation.table)


def _sum(translation: Translation, op: str, part: Array) -> Array:
    """All elements combined, once in a block: several tests ask whether one state is finite."""
    boxes = [(lower, upper, node.serial) for lower, upper, node in part.boxes]
    key = translation.block, op, part.dtype, *boxes
    if key not in translation.sums:
        number, rank = Number(part.dtype), len(part.shape)
        translation.add(Reduce(number, [0] * rank, 0, part, op, range(rank)))
        translation.sums[key] = Array.uniform(translation.number(number), ())
    return translation.sums[key]


def _order(parts, rank: int) -> list[int]:
    """The axes, with the one last along which most operands are contiguous."""
    strides = [node.strides for part in parts for node in part.loads() if node.kind == "load"]

    def contiguous(k: int) -> tuple[int, int]:
        steps = [s[k] for s in strides if len(s) == rank]
        return sum(s == 1 for s in steps) - sum(s > 1 for s in steps), k

    # Vectors are loads of neighbours then, and not gathers.
    last = max(range(rank), key=contiguous)
    return [k for k in range(rank) if k != last] + [last]


def _combine_all(op: str, parts: list[Array]) -> Array:
    # Neighbours first: an expression of few levels, for its rules are recursive.
    while len(parts) > 1:
        pairs = [combine_arrays(op, *pair) for pair in zip(parts[::2], parts[1::2], strict=False)]
        parts = pairs + parts[2 * len(pairs) :]
    return parts[0]


def combine_arrays(op: str, x: Array, y: Array) -> Array:
    return elementwise(op, {}, [x, y], x.shape, x.dtype)


def _is_finiteness(box: Box) -> bool:
    node = box.expression
    return node.kind == "operation" and node.name == "is_finite"


def _all_finite(translation: Translation, x: Array, axes: Sequence[int], shape) -> Array:
    # The sum of 0·x is NaN if an element is not finite: one operation for each, no comparison.
    table, boxes = x.table, []
    dtype = x.boxes[0].expression.args[0].dtype
    for lower, upper, node in x.boxes:
        (arg,) = node.args
        zero = table.known(0, arg.dtype)
        boxes.append(Box(lower, upper, table.operation("mul", {}, [arg, zero], arg.dtype)))
    total = reduction_of(translation, Array(table, x.shape, dtype, boxes), "add", axes, shape)
    return elementwise("is_finite", {}, [total], shape, "bool")


def matrix_product(translation: Translation, eqn: Any, x: Array, y: Array) -> list[Array]:
    (of_x, of_y), (batch_x, batch_y) = eqn.params["dimension_numbers"]
    (out,) = eqn.outvars
    dtype = str(out.aval.dtype)
    if dtype == "bool":
        raise NotCompilable("a matrix product of truth values")
    # Sums of float32 are computed in the type of the result.
    x, y = translation.convert(x, dtype), translation.convert(y, dtype)
    free_x = [a for a in range(len(x.shape)) if a not in (*of_x, *batch_x)]
    free_y = [a for a in range(len(y.shape)) if a not in (*of_y, *batch_y)]
    shape = [*(x.shape[a] for a in (*batch_x, *free_x)), *(y.shape[a] for a in free_y)]
    x, y = _read_often(translation, x, y, free_x, free_y)
    sums = [x.shape[a] for a in of_x]
    is_written_out = math.prod(sums) <= SHORT
    frame = shape if is_written_out else [*shape, *sums]
    axes_x: list[int | None] = [None] * len(x.shape)
    axes_y: list[int | None] = [None] * len(y.shape)
    for k, a in enumerate((*batch_x, *free_x)):
        axes_x[a] = k
    for k, a in enumerate((*batch_y, *free_y)):
        axes_y[a] = k if k < len(batch_y) else k + len(free_x)
    # A loop over a few terms, and joining its sums, would take longer than the terms.
    if is_written_out:
        terms = []
        for index in np.ndindex(*sums):
            offsets_x, offsets_y = [0] * len(x.shape), [0] * len(y.shape)
            for a, c, i in zip(of_x, of_y, index, strict=True):
                offsets_x[a] = offsets_y[c] = i
            pair = x.along(frame, axes_x, offsets_x), y.along(frame, axes_y, offsets_y)
            terms.append(combine_arrays("mul", *pair))
        zero = Array.uniform(translation.table.known(0, dtype), shape)
        return [_combine_all("add", terms) if terms else zero]
    for k, (a, c) in enumerate(zip(of_x, of_y, strict=True)):
        axes_x[a] = axes_y[c] = len(shape) + k
    # All products as one array that is summed over its last axes. It is never written.
    product = combine_arrays("mul", x.along(frame, axes_x), y.along(frame, axes_y))
    return [reduction_of(translation, product, "add", range(len(shape), len(frame)), shape)]


def _read_often(
    translation: Translation, x: Array, y: Array, free_x: list[int], free_y: list[int]
) -> list[Array]:
    """The operands of a product of matrices, computed before it where each element is used often,
    and one of them with neighbours along an axis of the result."""
    frees = free_x, free_y
    # Each element is used so often: once for each element of the other one's own axes.
    repeats = [math.prod(a.shape[k] for k in free) for a, free in ((y, free_y), (x, free_x))]
    pair = [
        translation.settle(a) if a.cost and count > SHORT else a
        for a, count in zip((x, y), repeats, strict=True)
    ]
    terms = x.size // max(math.prod(x.shape[k] for k in free_x), 1)
    # What does not change is turned once, before all loops.
    fixed = [i for i in (0, 1) if all(_is_fixed(node) for node in pair[i].loads())]
    if min(repeats) > SHORT:
        if any(map(_has_neighbours, pair, frees)):
            return pair
        number = fixed[0] if fixed else int(x.size > y.size)
    else:
        # A matrix times a vector: joining the partial sums of a short row takes most of the time.
        matrices = [i for i in fixed if frees[i] and not _has_neighbours(pair[i], frees[i])]
        if not SHORT < terms <= _SHORT_ROW or translation.block is translation.root:
            matrices = []
        if not matrices:
            return pair
        number = matrices[0]
    pair[number] = _copy_in_rows(translation, pair[number], frees[number][-1], number in fixed)
    return pair


def _copy_in_rows(translation: Translation, x: Array, axis: int, is_fixed: bool) -> Array:
    """An array in other memory, where neighbours along an axis are neighbours."""
    order = [*(a for a in range(len(x.shape)) if a != axis), axis]
    places = [order.index(a) for a in range(len(order))]
    copy = x.along([x.shape[a] for a in order], places)
    memory = Memory(copy.shape, copy.dtype, row_major(copy.shape))
    with BlockScope(translation, translation.root if is_fixed else translation.block):
        return translation.store(copy, memory.place).along(x.shape, order)


def _is_fixed(node: Expression) -> bool:
    """Whether a load reads the same all the time."""
    return node.kind == "load" and not node.args and node.value.pointer in FIXED


def _reads(x: Array) -> list[Expression]:
    return [node for node in x.loads() if node.kind == "load"]


def _has_neighbours(x: Array, axes: Sequence[int]) -> bool:
    """Whether all that an array reads lies in a row of memory along one of some axes."""
    return any(all(node.strides[a] in (0, 1) for node in _reads(x)) for a in axes)


def _running(op: str) -> Callable:
    operations: dict[str, Callable] = {"add": jnp.add, "mul": jnp.multiply}
    operations |= {"max": jnp.maximum, "min": jnp.minimum}

    def function(x, *, axis, reverse):
        rows = jnp.moveaxis(x, axis, 0)
        start = jnp.full(rows.shape[1:], neutral(op, str(x.dtype)), x.dtype)

        def step(total, row):
            total = operations[op](total, row)
            return total, total

        _, totals = lax.scan(step, start, rows, reverse=reverse)
        return jnp.moveaxis(totals, 0, axis)

    return function


def argument(is_largest: bool) -> Callable:
    """argmax, argmin: the first of the largest, or the first NaN."""

    def function(x, *, axes, index_dtype):
        (axis,) = axes
        best = (jnp.max if is_largest else jnp.min)(x, axis, keepdims=True)
        # The largest of numbers with a NaN is NaN, and equal to none of them.
        hits = (x == best) | ((x != x) & (best != best))
        places = lax.broadcasted_iota(index_dtype, x.shape, axis)
        largest = np.iinfo(index_dtype).max
        return jnp.min(jnp.where(hits, places, jnp.asarray(largest, index_dtype)), axis)

    return function


ARRAY_RULES |= dict.fromkeys(REDUCTIONS, reduction)
ARRAY_RULES |= {"dot_general": matrix_product}
ARRAY_RULES |= {name: expand(_running(op)) for name, op in CUMULATIVE.items()}
ARRAY_RULES |= {"argmax": expand(argument(True)), "argmin": expand(argument(False))}
