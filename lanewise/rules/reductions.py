"""Sums, products and other reductions along axes; matrix products."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..evaluator import RULES, Evaluator
from ..llvm.ir import NotCompilable, check_size
from ..llvm.values import MOST_ENTRIES, Value, Values, objects
from .moves import CUMULATIVE, REDUCTIONS


def reduction(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    (value,), (out,) = values, eqn.outvars
    op, axes = REDUCTIONS[eqn.primitive.name], tuple(eqn.params["axes"])
    if value.size == 0:
        return [evaluator.constant(np.full(out.aval.shape, neutral(op, value.dtype), value.dtype))]
    rows = np.moveaxis(evaluator.entries(value), axes, range(len(axes)))
    rows = rows.reshape((-1, out.aval.size))
    # From the first row to the last, whatever the batch is: another order has other bits.
    totals = list(rows[0])
    for row in rows[1:]:
        totals = [
            evaluator.combine(op, total, entry) for total, entry in zip(totals, row, strict=True)
        ]
    return [evaluator.value(totals, out.aval)]


def neutral(op: str, dtype: str) -> Any:
    """The result of a reduction of nothing."""
    if op in ("max", "min"):
        if dtype == "bool":
            return op == "min"
        if np.issubdtype(dtype, np.floating):
            return -np.inf if op == "max" else np.inf
        return np.iinfo(dtype).min if op == "max" else np.iinfo(dtype).max
    if op == "and":
        return np.invert(np.zeros((), dtype))
    return 1 if op == "mul" else 0


def running_reduction(evaluator: Evaluator, eqn: Any, values: Values, places: list) -> Values:
    (value,), (out,) = values, eqn.outvars
    axis, reverse = eqn.params["axis"], eqn.params["reverse"]
    if value.size == 0:
        return values
    op = CUMULATIVE[eqn.primitive.name]
    front = np.moveaxis(evaluator.entries(value), axis, 0)
    rows = front.reshape((front.shape[0], -1))
    rows = rows[::-1] if reverse else rows
    totals = [list(rows[0])]
    for row in rows[1:]:
        totals.append([evaluator.combine(op, x, y) for x, y in zip(totals[-1], row, strict=True)])
    flat = [entry for row in (totals[::-1] if reverse else totals) for entry in row]
    entries = np.moveaxis(objects(flat, front.shape), 0, axis)
    return [Value(out.aval.shape, out.aval.dtype, entries)]


def dot(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    (a, c), (out,) = values, eqn.outvars
    (of_a, of_c), (batch_a, batch_c) = eqn.params["dimension_numbers"]
    dtype = str(out.aval.dtype)
    has_one_type = a.dtype == dtype and c.dtype == dtype and dtype != "bool"
    # As `preferred_element_type` requires it.
    is_wider = dtype == "float64" and {a.dtype, c.dtype} <= {"float64", "float32"}
    if not (has_one_type or is_wider):
        raise NotCompilable(
            "a matrix product requires one type of numbers, or float32 arrays and a float64 "
            f"result, got {a.dtype}, {c.dtype} and the result {dtype}"
        )
    terms = math.prod(a.shape[i] for i in of_a)
    # Each term is an instruction of its own: the code, and the time to compile it, grow with them.
    count = out.aval.size * terms
    check_size(count, 8 * MOST_ENTRIES, "terms of a matrix product", a.shape, c.shape)
    x = _as_stack_of_matrices(evaluator.entries(a), batch_a, of_a)
    y = _as_stack_of_matrices(evaluator.entries(c), batch_c, of_c)
    results = []
    for rows, columns in zip(x, y, strict=True):
        for row, column in ((row, column) for row in rows for column in columns):
            # A zero of the structure, which vanishes: the first term needs no addition. The sum
            # over nothing is a zero like any other: times NaN it is NaN.
            total = evaluator.b.const(0, dtype, structural=terms > 0)
            for u, v in zip(row, column, strict=True):
                u, v = evaluator.b.convert(u, dtype), evaluator.b.convert(v, dtype)
                total = evaluator.b.add(total, evaluator.b.mul(u, v))
            results.append(total)
    return [evaluator.value(results, out.aval)]


def _as_stack_of_matrices(x, batch: Sequence[int], inner: Sequence[int]) -> np.ndarray:
    """x as (batch, free, contracted)."""
    free = [i for i in range(x.ndim) if i not in (*batch, *inner)]
    sizes = [math.prod(x.shape[i] for i in axes) for axes in (batch, free, inner)]
    return np.transpose(x, (*batch, *free, *inner)).reshape(sizes)


RULES |= {
    "dot_general": dot,
    **dict.fromkeys(REDUCTIONS, reduction),
    **dict.fromkeys(CUMULATIVE, running_reduction),
}
