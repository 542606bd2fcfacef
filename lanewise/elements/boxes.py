"""Arrays as boxes of their index space, each with an expression of the index.

Slices, rolls, pads, concatenations and broadcasts change boxes and index maps; they compute nothing
and write nothing.
"""

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..jaxprs.extent import cost_of
from .axes import short_axes


class NotABoxError(Exception):
    """The result has no boxes: the array must be written to memory first."""


class IndexMap(NamedTuple):
    """i = rows · j + offsets: the index of an old array at the index j of a new one."""

    rank: int  # of the new array
    rows: tuple[tuple[int, ...], ...]
    offsets: tuple[int, ...]


class Expression:
    """A number as a function of the index; equal expressions of a table are one object.

    - ``known``: `value` is the number. ``number``: `value` is an object that holds a number of the
      code, the same for all indices.
    - ``index``: strides · index + offset. ``delta``: whether that is zero.
    - ``load``: an element of the memory `value`, at strides · index + offset, plus the argument if
      there is one.
    - ``operation``: `name` of the arguments, with the parameters `value`.

    `depth`: the number of axes from the first to the last that it depends on. `cost`: operations
    for each element. `height`: of the tree.
    """

    __slots__ = (
        "args",
        "cost",
        "depth",
        "dtype",
        "height",
        "kind",
        "name",
        "offset",
        "serial",
        "strides",
        "table",
        "value",
    )

    table: "Table"
    serial: int
    kind: str
    name: str
    strides: tuple[int, ...]
    offset: int
    args: tuple["Expression", ...]
    dtype: str
    value: Any
    depth: int
    cost: int
    height: int

    def moved(self, index_map: IndexMap) -> "Expression":
        """The expression at the index ``index_map(j)``, as a function of j."""
        # Programs move the same expressions again and again: a chain its neighbours.
        key = (self.serial, index_map)
        if key not in self.table.moves:
            self.table.moves[key] = self._moved(index_map)
        return self.table.moves[key]

    def _moved(self, index_map: IndexMap) -> "Expression":
        if self.kind in ("known", "number"):
            return self
        args = []  # not a generator: its frames would halve the depth that Python allows
        for arg in self.args:
            args.append(arg.moved(index_map))
        strides, offset = self.strides, self.offset
        # strides · (rows · j + offsets) + offset, sorted by j.
        if self.kind != "operation":
            rows, offsets = index_map.rows, index_map.offsets
            columns = range(index_map.rank)
            offset += sum(s * x for s, x in zip(strides, offsets, strict=True))
            strides = tuple(
                sum(s * row[k] for s, row in zip(strides, rows, strict=True)) for k in columns
            )
        return self.table.expression(
            self.kind, self.dtype, tuple(args), self.name, strides, offset, self.value
        )

    def loads(self, visited: set[int]) -> Iterable["Expression"]:
        """The loads and numbers in it that were not visited yet."""
        stack: list[Expression] = [self]
        while stack:
            node = stack.pop()
            if node.serial in visited:
                continue
            visited.add(node.serial)
            if node.kind in ("load", "number"):
                yield node
            stack += node.args


class Table:
    """The expressions of one program."""

    def __init__(self):
        self.moves: dict[Any, Expression] = {}
        self.deltas: dict[int, Any] = {}  # of `diagonals`
        self._expressions: dict[Any, Expression] = {}

    def expression(
        self,
        kind: str,
        dtype: str,
        args: tuple[Expression, ...] = (),
        name: str = "",
        strides: tuple[int, ...] = (),
        offset: int = 0,
        value: Any = None,
        key: Any = None,
    ) -> Expression:
        if kind == "delta":
            # In one form for each condition: those of other offsets exclude each other.
            factor = math.gcd(*strides) if any(strides) else 0
            if offset % factor if factor else offset:
                return self.known(False, dtype)
            if not factor:
                return self.known(True, dtype)
            factor *= 1 if next(filter(None, strides)) > 0 else -1
            strides, offset = tuple(s // factor for s in strides), offset // factor
        # An operation's parameters are part of its name; other values have a key or are objects.
        identity = key if key is not None else None if kind == "operation" else id(value)
        full = (kind, dtype, tuple(a.serial for a in args), name, strides, offset, identity)
        old = self._expressions.get(full)
        if old is not None:
            return old
        new = self._expressions[full] = Expression()
        new.table, new.serial, new.kind, new.dtype = self, len(self._expressions), kind, dtype
        new.args, new.name, new.strides, new.offset, new.value = args, name, strides, offset, value
        own_depth = max((axis + 1 for axis, s in enumerate(strides) if s), default=0)
        new.depth = max([own_depth, *(a.depth for a in args)])
        # What is the same for all elements is computed before the loops over them.
        cost = 0
        if kind == "operation" and new.depth:
            cost = cost_of(name.split()[0])
        new.cost = cost + sum(a.cost for a in args)
        new.height = 1 + max((a.height for a in args), default=0)
        return new

    def known(self, value: Any, dtype: Any) -> Expression:
        number = np.asarray(value, dtype)[()]
        return self.expression("known", str(dtype), value=number, key=number.tobytes())

    def operation(self, name: str, params: dict, args: Sequence[Expression], dtype: Any):
        key = f"{name} {sorted(params.items())!r}" if params else name
        return self.expression("operation", str(dtype), tuple(args), key, value=params)


class Box(NamedTuple):
    """The indices lower ≤ i < upper, and the expression there."""

    lower: tuple[int, ...]
    upper: tuple[int, ...]
    expression: Expression


class Array:
    """Disjoint boxes that fill an index space."""

    def __init__(self, table: Table, shape: Sequence[int], dtype: Any, boxes: Sequence[Box]):
        self.table, self.shape, self.dtype = table, tuple(map(int, shape)), str(dtype)
        self.boxes = list(boxes)

    @classmethod
    def uniform(cls, expression: Expression, shape: Sequence[int]) -> "Array":
        """One expression for all elements."""
        boxes = [Box((0,) * len(shape), tuple(map(int, shape)), expression)]
        size = math.prod(shape)
        return cls(expression.table, shape, expression.dtype, boxes if size else [])

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def expression(self) -> Expression | None:
        """The expression, if it is one for the whole array."""
        return self.only if len(self.boxes) == 1 else None

    @property
    def only(self) -> Expression:
        """The expression of an array that has one."""
        (box,) = self.boxes
        return box.expression

    @property
    def cost(self) -> int:
        return max((box.expression.cost for box in self.boxes), default=0)

    @property
    def height(self) -> int:
        return max((box.expression.height for box in self.boxes), default=0)

    @property
    def is_written_out(self) -> bool:
        """Whether all axes are short: the array is a few numbers."""
        return len(short_axes(self.shape)) == len(self.shape)

    def loads(self) -> list[Expression]:
        """The loads and the numbers in its expressions."""
        visited: set[int] = set()
        return [node for box in self.boxes for node in box.expression.loads(visited)]

    def moved(self, shape: Sequence[int], rows: Sequence[Sequence[int]], offsets) -> "Array":
        """The array whose element j is this one's element rows · j + offsets."""
        rank = len(shape)
        index_map = IndexMap(rank, tuple(tuple(r) for r in rows), tuple(int(x) for x in offsets))
        boxes = []
        for lower, upper, expression in self.boxes:
            low, high, is_empty = [0] * rank, list(map(int, shape)), False
            axes = zip(index_map.rows, index_map.offsets, lower, upper, strict=True)
            for row, offset, first, end in axes:
                # The part of the box that the new axis runs through.
                uses = [(k, s) for k, s in enumerate(row) if s]
                if not uses:
                    is_empty |= not first <= offset < end
                    continue
                ((k, s),) = uses
                if s > 0:
                    start, stop = -((offset - first) // s), -((offset - end) // s)
                else:
                    start, stop = -((end - 1 - offset) // -s), (offset - first) // -s + 1
                low[k], high[k] = max(low[k], start), min(high[k], stop)
            # A box without elements is left out.
            if not is_empty and all(p < q for p, q in zip(low, high, strict=True)):
                boxes.append(Box(tuple(low), tuple(high), expression.moved(index_map)))
        return Array(self.table, shape, self.dtype, boxes)

    def along(self, shape: Sequence[int], axes: Sequence[int | None], offsets=None) -> "Array":
        """The same elements with other axes: axis a of this array is `axes[a]` of the new one, or
        has one index, that in `offsets`, where it is None."""
        rows = [[int(k == axis) for k in range(len(shape))] for axis in axes]
        return self.moved(shape, rows, [0] * len(axes) if offsets is None else offsets)

    def components(self) -> tuple[list[int], list[int], dict[tuple[int, ...], "Array"]]:
        """The short axes, the long ones, and for each index of the short axes the array of the
        long ones."""
        short = short_axes(self.shape)
        long = [a for a in range(len(self.shape)) if a not in short]
        shape, parts = [self.shape[a] for a in long], {}
        for index in itertools.product(*(range(self.shape[a]) for a in short)):
            offsets = [0] * len(self.shape)
            for a, i in zip(short, index, strict=True):
                offsets[a] = i
            axes = [long.index(a) if a in long else None for a in range(len(self.shape))]
            parts[index] = self.along(shape, axes, offsets)
        return short, long, parts


def common_boxes(arrays: Sequence[Array]) -> list[tuple[tuple, tuple, tuple[Expression, ...]]]:
    """The boxes in which every one of some arrays of one shape has one expression."""
    # Each array cuts the boxes further.
    cells: list[Any] = [(lower, upper, (node,)) for lower, upper, node in arrays[0].boxes]
    for array in arrays[1:]:
        new_cells = []
        for lower, upper, nodes in cells:
            for first, end, node in array.boxes:
                low, high = tuple(map(max, lower, first)), tuple(map(min, upper, end))
                if all(p < q for p, q in zip(low, high, strict=True)):
                    new_cells.append((low, high, (*nodes, node)))
        cells = new_cells
    return cells


def joined(boxes: Iterable[Box], rank: int) -> list[Box]:
    """The same array with fewer boxes: neighbours with one expression become one."""
    boxes = list(boxes)
    # Otherwise each shift would double the boxes, and with them the code.
    for axis in range(rank) if len(boxes) > 1 else ():
        rows: dict[Any, list[Box]] = {}
        for box in sorted(boxes, key=lambda box: box.lower):
            lower, upper = list(box.lower), list(box.upper)
            lower[axis] = upper[axis] = 0
            row = rows.setdefault((box.expression.serial, *lower, *upper), [])
            if row and row[-1].upper[axis] == box.lower[axis]:
                row[-1] = Box(row[-1].lower, box.upper, box.expression)
            else:
                row.append(box)
        boxes = [box for row in rows.values() for box in row]
    return boxes


def elementwise(name: str, params: dict, args: Sequence[Array], shape, dtype) -> Array:
    """An operation on each element; axes of length 1 and arrays without axes are repeated."""
    shape = tuple(shape)
    args = [a if a.shape == shape else repeat(a, shape) for a in args]
    table = args[0].table
    boxes = [
        Box(lower, upper, table.operation(name, params, nodes, dtype))
        for lower, upper, nodes in common_boxes(args)
    ]
    return Array(table, shape, dtype, joined(boxes, len(shape)))


def repeat(x: Array, shape: Sequence[int], dimensions: Sequence[int] | None = None) -> Array:
    """`broadcast_in_dim`; without `dimensions` the axes are the first ones."""
    dimensions = range(len(x.shape)) if dimensions is None else dimensions
    # An axis of length 1 has one index, for all indices of the new axis.
    axes = [k if n == shape[k] else None for n, k in zip(x.shape, dimensions, strict=True)]
    return x.along(shape, axes)
