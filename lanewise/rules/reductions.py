"""Sums, products and other reductions along axes; matrix products."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..evaluator import RULES, Evaluator
from ..llvm.ir import Unsupported
from ..llvm.values import MADE, Value, objects
from .moves import CUMULATIVE, REDUCTIONS


def reduced(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    (value,), (out,) = values, eqn.outvars
    op, axes = REDUCTIONS[eqn.primitive.name], tuple(eqn.params["axes"])
    if value.size == 0:
        return [e.constant(np.full(out.aval.shape, _neutral(op, value.dtype), value.dtype))]
    rows = np.moveaxis(e.entries(value), axes, range(len(axes)))
    rows = rows.reshape((-1, out.aval.size))
    # From the first row to the last, whatever the batch is: another order has other bits.
    totals = list(rows[0])
    for row in rows[1:]:
        totals = [e.combine(op, a, c) for a, c in zip(totals, row, strict=True)]
    return [e.value(totals, out.aval)]


def _neutral(op: str, dtype: str) -> Any:
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


def accumulated(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    (value,), (out,) = values, eqn.outvars
    axis, reverse = eqn.params["axis"], eqn.params["reverse"]
    if value.size == 0:
        return values
    op = CUMULATIVE[eqn.primitive.name]
    front = np.moveaxis(e.entries(value), axis, 0)
    rows = front.reshape((front.shape[0], -1))
    rows = rows[::-1] if reverse else rows
    done = [list(rows[0])]
    for row in rows[1:]:
        done.append([e.combine(op, a, c) for a, c in zip(done[-1], row, strict=True)])
    flat = [entry for row in (done[::-1] if reverse else done) for entry in row]
    entries = np.moveaxis(objects(flat, front.shape), 0, axis)
    return [Value(out.aval.shape, out.aval.dtype, entries)]


def dot(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    (a, c), (out,) = values, eqn.outvars
    (of_a, of_c), (batch_a, batch_c) = eqn.params["dimension_numbers"]
    dtype = str(out.aval.dtype)
    same = a.dtype == dtype and c.dtype == dtype and dtype != "bool"
    # As `preferred_element_type` requires it.
    wider = dtype == "float64" and {a.dtype, c.dtype} <= {"float64", "float32"}
    if not (same or wider):
        raise Unsupported(
            "a matrix product requires two arrays and a result of the same type, which must not "
            "be bool; only a float64 result may have float32 arrays. Got arrays of type "
            f"{a.dtype} and {c.dtype} and a result of type {dtype}"
        )
    contracted = math.prod(a.shape[i] for i in of_a)
    # Each term is an instruction of its own: the code, and the time to compile it, grow with them.
    if out.aval.size * contracted > 8 * MADE:
        raise Unsupported(
            f"a product must have at most {8 * MADE} terms, got {out.aval.size * contracted} of "
            f"arrays with shapes {a.shape} and {c.shape}"
        )
    x = _as_stack_of_matrices(e.entries(a), batch_a, of_a)
    y = _as_stack_of_matrices(e.entries(c), batch_c, of_c)
    results = []
    for rows, columns in zip(x, y, strict=True):
        for row, column in ((row, column) for row in rows for column in columns):
            # A zero of the structure, which vanishes: the first term needs no addition. The sum
            # over nothing is a zero like any other: times NaN it is NaN.
            total = e.b.known(0, dtype, structural=contracted > 0)
            for u, v in zip(row, column, strict=True):
                u, v = e.b.convert(u, dtype), e.b.convert(v, dtype)
                total = e.b.add(total, e.b.mul(u, v))
            results.append(total)
    return [e.value(results, out.aval)]


def _as_stack_of_matrices(x, batch: Sequence[int], contracted: Sequence[int]) -> np.ndarray:
    """x as (batch, free, contracted)."""
    free = [i for i in range(x.ndim) if i not in (*batch, *contracted)]
    sizes = [math.prod(x.shape[i] for i in axes) for axes in (batch, free, contracted)]
    return np.transpose(x, (*batch, *free, *contracted)).reshape(sizes)


RULES |= {
    "dot_general": dot,
    **dict.fromkeys(REDUCTIONS, reduced),
    **dict.fromkeys(CUMULATIVE, accumulated),
}
