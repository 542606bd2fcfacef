"""A program on long arrays as a tree of statements.

Everything has one value: a memory is written by the statements of one round of one block, and read
after them. Only `places` decides which memories share bytes, so that no other part has to think
about when an array is overwritten.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from .axes import short_axes
from .boxes import Array, Expression, Table

_serials = itertools.count()


class Number:
    """A number of the code, the same for all elements: a sum, or what a loop carries."""

    def __init__(self, dtype: str):
        self.dtype, self.serial = str(dtype), next(_serials)

    def __repr__(self) -> str:
        return f"n{self.serial}"


FIXED = ("operand", "constant")
"""Pointers of memories that are not written."""


class Memory:
    """An array in memory.

    - `strides`: in elements. By default short axes come first, so that a long one is contiguous.
    - `pointer`: what it is if its place is known when the code runs: one of `FIXED`, or a result;
      others get bytes.
    - `whole`, `distance`: the part of another memory that begins after `distance` elements, an
      expression.
    """

    def __init__(
        self,
        shape: Sequence[int],
        dtype: Any,
        strides: Sequence[int] | None = None,
        pointer: str | None = None,
        whole: "Memory | None" = None,
        distance: Expression | None = None,
    ):
        self.shape, self.dtype = tuple(map(int, shape)), str(dtype)
        self.strides = short_first(self.shape) if strides is None else tuple(strides)
        self.pointer, self.whole, self.distance = pointer, whole, distance
        self.serial = next(_serials)

    def __repr__(self) -> str:
        return f"m{self.serial}{self.shape}"

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def root(self) -> "Memory":
        return self if self.whole is None else self.whole.root

    @property
    def place(self) -> "Place":
        return Place(self, self.shape, self.strides, 0)

    def load(self, table: Table) -> Array:
        """The array that is in it."""
        return self.place.load(table)


class Place(NamedTuple):
    """Where an array is in a memory."""

    memory: Memory
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    offset: int

    def load(self, table: Table) -> Array:
        """The array that is there."""
        return Array.uniform(self.target(table, self.strides, self.offset), self.shape)

    def target(self, table: Table, strides: tuple[int, ...], offset: int) -> Expression:
        return table.expression(
            "load", self.memory.dtype, strides=strides, offset=offset, value=self.memory
        )

    def part(self, shape: Sequence[int], offset: int, strides=None) -> "Place":
        """The part of this shape that begins `offset` elements further."""
        strides = self.strides if strides is None else tuple(strides)
        return Place(self.memory, tuple(shape), strides, self.offset + offset)


def short_first(shape: Sequence[int]) -> tuple[int, ...]:
    """Strides: short axes outside, so that the last long one is contiguous."""
    # An array of positions (n, 3) becomes three rows of n, each of which is read in vectors.
    order = short_axes(shape)
    order += [a for a in range(len(shape)) if a not in order]
    strides, step = [0] * len(shape), 1
    for a in reversed(order):
        strides[a] = step
        step *= max(shape[a], 1)
    return tuple(strides)


class Store:
    """memory[strides · i + offset] = array[i], for all i."""

    def __init__(self, memory: Memory, strides: Sequence[int], offset: int, array: Array):
        self.memory, self.strides, self.offset = memory, tuple(strides), offset
        self.array = array
        # Compared by identity: a statement of the same loops that reads it gets the number itself.
        # The load that reads at the index i what is written there.
        self.target = memory.place.target(array.table, self.strides, offset)

    def __repr__(self) -> str:
        return f"{self.memory} = ..."


class Reduce:
    """The elements of an array combined along axes, by the operation `op`.

    The result is a `Number` where no axis is kept, else it goes to a memory as in `Store`, with
    stride 0 for the axes that vanish.
    """

    def __init__(self, result: Number | Memory, strides, offset: int, array: Array, op: str, axes):
        self.result, self.strides, self.offset = result, tuple(strides), offset
        self.array, self.op, self.axes = array, op, frozenset(axes)

    @property
    def memory(self) -> Memory | None:
        return self.result if isinstance(self.result, Memory) else None

    def __repr__(self) -> str:
        return f"{self.result} = {self.op} along {sorted(self.axes)}"


class Update:
    """memory[strides · i + offset + distance[i]] = array[i], one element after the other, where the
    memory has been written before; with an operation `op` the old element is combined with it.

    `distance` is one expression for all elements, or depends on them.
    """

    def __init__(
        self, memory: Memory, strides, offset: int, distance: Array, array: Array, op=None
    ):
        self.memory, self.strides, self.offset = memory, tuple(strides), offset
        self.distance, self.array, self.op = distance, array, op


class Let:
    """A number that is computed here, and not where it is used."""

    def __init__(self, number: Number, expression: Expression):
        self.number, self.array = number, Array.uniform(expression, ())

    memory = None


class Loop:
    """A loop that carries numbers and memories.

    - `numbers`: (number in a round, first expression, expression after the round).
    - `memories`: (memory in a round, memory that becomes it after the round).
    - `length` rounds, or as long as the expression `condition` of `test` is true.
    - `rows`: memories of which each round writes a part.
    """

    def __init__(self, length: int | None = None):
        self.length = length
        self.counter = Number("int64")
        self.numbers: list[tuple[Number, Expression, Expression]] = []
        self.memories: list[tuple[Memory, Memory]] = []
        self.rows: list[Memory] = []
        # `test` has the statements that the condition needs; it stays empty for a known length.
        self.test, self.body = Block(), Block()
        self.condition: Expression | None = None


class Branch:
    """One of some blocks, by an index that is cut to those that exist.

    `numbers`: (result, its expression at the end of each block).
    """

    def __init__(self, index: Expression, count: int):
        self.index = index
        self.blocks = [Block() for _ in range(count)]
        self.numbers: list[tuple[Number, list[Expression]]] = []


Statement = Store | Update | Reduce | Let | Loop | Branch


class Block:
    """Statements in their order; `groups` and control flow once they are scheduled."""

    def __init__(self):
        self.statements: list[Statement] = []
        self.items: list[Any] = []

    def blocks(self) -> Iterator["Block"]:
        """This one and all within it."""
        yield self
        for statement in self.statements:
            if isinstance(statement, Loop):
                yield from statement.test.blocks()
                yield from statement.body.blocks()
            elif isinstance(statement, Branch):
                for block in statement.blocks:
                    yield from block.blocks()
