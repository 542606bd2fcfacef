"""Matrices of which some diagonals are not zero by their structure: they are never written whole.

A derivative by a unit vector is zero where no ``delta`` of its expression is true. That is known
from the expressions, without a number.
"""

from collections.abc import Sequence
from typing import Any

from ..jaxprs.extent import SHORT
from .boxes import Array, Box, Expression, IndexMap, elementwise

Delta = tuple[tuple[int, ...], int]
"""Strides and offset of a ``delta``."""

MOST_DIAGONALS = 40
"""A matrix with more of them is written whole."""

_LINEAR = ("neg", "convert_element_type", "copy", "real", "reduce_precision", "div")


def deltas(node: Expression) -> frozenset[Delta] | None:
    """Deltas of which one is true wherever the expression is not zero; None without such deltas."""
    memory = node.table.deltas
    if node.serial not in memory:
        memory[node.serial] = _deltas(node)
    return memory[node.serial]


def _deltas(node: Expression) -> frozenset[Delta] | None:
    if node.kind == "delta":
        return frozenset([(node.strides, node.offset)])
    if node.kind == "known":
        return None if node.value else frozenset()
    if node.kind != "operation":
        return None
    of = [deltas(arg) for arg in node.args]
    name = node.name.split()[0]
    if name in _LINEAR:
        return of[0]
    if name == "mul" or (name == "and" and node.dtype == "bool"):
        return next((case for case in of if case is not None), None)
    if name in ("add", "add_any", "sub", "or"):
        return _union(of)
    if name == "select_n":
        # A delta chooses between zero and something.
        if of[0] is not None and len(of) == 3 and of[1] is not None:
            return of[1] | (of[0] if of[2] is None else of[2])
        return _union(of[1:])
    return None


def _union(of: Sequence[frozenset[Delta] | None]) -> frozenset[Delta] | None:
    if any(case is None for case in of):
        return None
    return frozenset().union(*of)  # pyright: ignore[reportArgumentType]


def _where_true(node: Expression, delta: Delta, memory: dict[int, Expression | None]):
    """The expression where this delta is true; None for zero."""
    if node.serial not in memory:
        memory[node.serial] = _value_where(node, delta, memory)
    return memory[node.serial]


def _value_where(node: Expression, delta: Delta, memory: dict) -> Expression | None:
    table = node.table
    if node.kind == "delta":
        # Where one is true, others of the same strides are false.
        if node.strides != delta[0]:
            return node
        return table.known(True, "bool") if node.offset == delta[1] else None
    if node.kind == "known" and not node.value:
        return None
    if node.kind != "operation" or deltas(node) is None:
        return node
    args = [_where_true(arg, delta, memory) for arg in node.args]
    present, name = [x for x in args if x is not None], node.name.split()[0]
    is_product = name == "mul" or (name == "and" and node.dtype == "bool")
    if name == "select_n":
        choice = args[0]
        if choice is None or choice.kind == "known":
            return args[1] if choice is None else args[1 + int(choice.value)]
        if len(present) == 1:
            return None
    elif not present or (is_product and len(present) < 2) or (name == "div" and args[0] is None):
        return None
    elif is_product:
        for one, other in (present, present[::-1]):
            if one.kind == "known" and one.value == 1:
                return other
    elif len(present) == 1 and name in ("add", "add_any", "or", "sub"):
        is_negative = name == "sub" and args[0] is None
        return table.operation("neg", {}, present, node.dtype) if is_negative else present[0]
    elif name == "convert_element_type" and present[0].kind == "known":
        return table.known(present[0].value, node.dtype)
    pairs = zip(args, node.args, strict=True)
    new = tuple(table.known(0, old.dtype) if x is None else x for x, old in pairs)
    return table.expression("operation", node.dtype, new, node.name, value=node.value)


def diagonals(matrix: Array) -> dict[int, Array] | None:
    """Offset d → the array of the numbers at (i, i + d), for i = 0, …; zero outside of the matrix.
    None for an array that is no matrix or has no such structure."""
    if len(matrix.shape) != 2 or min(matrix.shape) <= SHORT:
        return None
    n = matrix.shape[0]
    boxes_of: dict[int, list[Box]] = {}
    for (top, left), (bottom, right), node in matrix.boxes:
        of = deltas(node)
        if of is None:
            return None
        for delta in of:
            strides, d = delta
            if strides != (1, -1):  # i − j + d = 0
                return None
            first, end = max(top, left - d), min(bottom, right - d)
            value = _where_true(node, delta, {})
            if first < end and value is not None:
                part = value.moved(IndexMap(1, ((1,), (1,)), (0, d)))
                boxes_of.setdefault(d, []).append(Box((first,), (end,), part))
    if len(boxes_of) > MOST_DIAGONALS:
        return None
    zero = matrix.table.known(0, matrix.dtype)
    return {d: _array_of(boxes, n, zero, matrix) for d, boxes in sorted(boxes_of.items())}


def _array_of(boxes: Sequence[Box], n: int, zero: Expression, like: Array) -> Array:
    """The array of these boxes, with zero between them."""
    parts, end = [], 0
    for box in sorted(boxes, key=lambda box: box.lower):
        if end < box.lower[0]:
            parts.append(Box((end,), box.lower, zero))
        parts.append(box)
        (end,) = box.upper
    if end < n:
        parts.append(Box((end,), (n,), zero))
    return Array(like.table, (n,), like.dtype, parts)


def from_diagonals(of: dict[int, Array], shape: Sequence[int], dtype: str, table: Any) -> Array:
    """The matrix with these diagonals."""
    matrix = Array.uniform(table.known(0, dtype), shape)
    for offset, diagonal in of.items():
        delta = Array.uniform(
            table.expression("delta", "bool", strides=(1, -1), offset=offset), shape
        )
        matrix = elementwise(
            "select_n", {}, [delta, matrix, diagonal.along(shape, [0])], shape, dtype
        )
    return matrix
