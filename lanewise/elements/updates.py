"""Elements of an array written at places that are computed when the code runs."""

from typing import Any

from ..llvm.ir import Num
from .boxes import Expression, common_boxes
from .schedule import Group
from .tree import Update
from .vectors import first_elements, load, store

# `nests` is the object of `lanewise.elements.nests` that writes all groups: it imports this file.


def write_update(nests: Any, s: Update) -> None:
    """Elements one after the other, or in vectors if all are moved by one distance."""
    distance = s.distance.expression
    is_slice = s.op is None and distance is not None and distance.depth == 0
    nests.group_now = Group(s.array.shape, [s])
    # In the order of the elements, not of the expressions that were made first.
    boxes = sorted(common_boxes([s.array, s.distance]), key=lambda c: c[:2])
    for lower, upper, (node, by) in boxes:
        with nests.scope():
            _write_box(nests, s, (lower, upper), node, by, [], is_slice)


def _write_box(
    nests: Any, s: Update, box, node: Expression, by: Expression, index: list[Num], is_slice: bool
) -> None:
    b, d, (lower, upper) = nests.b, len(index), box
    if d < len(lower) - int(is_slice):
        first = b.const(lower[d], "int64")

        def turn(i: Num) -> None:
            _write_box(nests, s, box, node, by, [*index, b.add(i, first)], is_slice)

        nests.count(upper[d] - lower[d], turn)
    elif not is_slice:
        # In the order of the elements: two of them may have one place.
        with nests.scalars():
            write_element(nests, s, nests.number(by, index), nests.number(node, index), index)
    else:
        _write_row(nests, s, lower[d], upper[d], node, by, index)


def _write_row(
    nests: Any, s: Update, lower: int, upper: int, node: Expression, by: Expression, index
) -> None:
    """A row of a slice, in vectors."""
    b, W = nests.b, nests.vector_width
    with nests.scalars():
        distance = nests.number(by, index)
        nests.hoist([(s, node)], len(index), index)

    def part(start: Num, mask: str | None) -> None:
        position = [*index, start]
        x = nests.number(node, position, mask)
        where = nests.address(s.memory, s.strides, s.offset, position, distance)
        store(b, where, x, s.strides[-1], mask)

    vectors, rest = divmod(upper - lower, W)

    def turn(i: Num) -> None:
        part(b.add(b.mul(i, b.const(W, "int64")), b.const(lower, "int64")), None)

    if vectors:
        nests.count(vectors, turn)
    if rest:
        with nests.scope():
            part(b.const(lower + vectors * W, "int64"), first_elements(b, rest))


def write_element(nests: Any, s: Update, distance: Num, x: Num, index: list[Num]) -> None:
    """One element, combined with the old one if the update has an operation."""
    b = nests.b
    # A slice has been moved inside of the array.
    if s.op is None:
        store(b, nests.address(s.memory, s.strides, s.offset, index, distance), x, 0)
        return
    # A negative distance says that there is no such element: the first one keeps its value.
    zero = b.const(0, "int64")
    is_inside = b.compare("ge", distance, zero)
    where = nests.address(s.memory, s.strides, s.offset, index, b.maximum(distance, zero))
    old = load(b, where, s.array.dtype, 0)
    new = x
    if s.op:
        new = b.sub(old, x) if s.op == "sub" else nests.e.combine(s.op, old, x)
    store(b, where, b.select(is_inside, new, old), 0)
