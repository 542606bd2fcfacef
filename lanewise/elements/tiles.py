"""Sums of products, as in a matrix product: in tiles of rows and columns, sums in registers.

Each number of a row is used for all columns of a tile, and each number of a column for all rows. The
terms of a sum are added in their order, whatever the tile is.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from ..llvm.ir import Num
from .boxes import Expression
from .tree import Reduce, Statement
from .vectors import first_elements, load, store

# `nests` is the object of `lanewise.elements.nests` that writes all groups: it imports this file.

ROWS = 6
"""Of a tile. With 4 vectors of columns the sums fill the registers of AVX-512, with 2 other ones."""

TERMS = 256
"""Added to a tile before the next one: the numbers of its columns stay in the cache."""

TERMS_OF_A_ROW = 8
"""The same where there is one row: memory is read in its order."""

_CHEAP = 4  # operations of a factor: it is computed again in each tile


class Product(NamedTuple):
    """A sum over products x·y, where x does not depend on the innermost axis, the columns.

    `rows`: an axis of the result on which y does not depend; None without one. `terms`: the
    innermost of the axes that are summed.
    """

    sum: Reduce
    x: Expression
    y: Expression
    rows: int | None
    terms: int


def product_of(s: Statement, node: Expression, shape: Sequence[int]) -> Product | None:
    """How a reduction is computed in tiles, if it is a sum of such products."""
    if not isinstance(s, Reduce) or s.op != "add" or node.kind != "operation":
        return None
    columns = len(shape) - 1
    if node.name != "mul" or columns in s.axes or max(arg.cost for arg in node.args) > _CHEAP:
        return None
    x, y = node.args if depends(node.args[1], columns) else node.args[::-1]
    if depends(x, columns) or not depends(y, columns):
        return None
    rows = [k for k in range(columns) if k not in s.axes and not depends(y, k)]
    return Product(s, x, y, max(rows, key=lambda k: shape[k], default=None), max(s.axes))


def with_one_matrix(products: Sequence[Product]) -> list[list[Product]]:
    """Products that share a tile: their sums are rows of a product of matrices, for short axes are
    written out."""
    groups: dict[tuple, list[Product]] = {}
    for product in products:
        groups.setdefault((product.y, product.rows, product.sum.axes), []).append(product)
    parts = []
    for of in groups.values():
        size = -(-len(of) // -(-len(of) // ROWS))  # 8 as 4 and 4
        parts += [of[i : i + size] for i in range(0, len(of), size)]
    return parts


def depends(node: Expression, axis: int) -> bool:
    """Whether an expression depends on an axis."""
    if node.strides and node.strides[axis]:
        return True
    return any(depends(arg, axis) for arg in node.args)


class Tiles:
    """Writes the loops of products with one `y` over arrays of one shape."""

    def __init__(self, nests: Any, products: Sequence[Product], shape: Sequence[int]):
        product = products[0]
        s = product.sum
        self.nests, self.b, self.products, self.product = nests, nests.b, products, product
        self.rows = 1 if product.rows is None else shape[product.rows]
        self.columns, self.terms = shape[-1], shape[product.terms]
        self.most_terms = TERMS_OF_A_ROW if self.rows * len(products) == 1 else TERMS
        own = (product.rows, product.terms, len(shape) - 1)
        # Those of the result first.
        outer = sorted({*range(len(shape))} - {*own}, key=lambda k: k in s.axes)
        self.outer = [(k, shape[k]) for k in outer]
        self.has_parts = len(s.axes) > 1 or self.terms > self.most_terms
        """Whether a tile adds a part of a sum to that which is in memory."""

    def write(self) -> None:
        zero = self.b.const(0, "int64")
        self._outer(self.outer, [zero] * (len(self.outer) + 2 + (self.product.rows is not None)))

    def _outer(self, axes: Sequence[tuple[int, int]], index: list[Num]) -> None:
        """Loops over the other axes."""
        if not axes:
            self._in_steps(self.terms, self.most_terms, lambda *part: self._columns(index, *part))
            return
        (axis, length), *others = axes
        self.nests.count(length, lambda i: self._outer(others, _with(index, axis, i)))

    def _in_steps(self, length: int, step: int, write: Callable[[Num, int], None]) -> None:
        """``write(first, count)`` for parts of `step` elements, and for what remains."""
        b, (parts, rest) = self.b, divmod(length, step)
        if parts:
            self.nests.count(parts, lambda i: write(b.mul(i, b.const(step, "int64")), step))
        if rest:
            with self.nests.scope():
                write(b.const(parts * step, "int64"), rest)

    def _columns(self, index: list[Num], first_term: Num, terms: int) -> None:
        W = self.nests.vector_width
        vectors = -(-self.columns // W)
        # 9 vectors are three tiles of 3, and not two of 4 with a narrow one.
        widths = (4, 3) if W == 8 else (2,)
        widest = max(widths, key=lambda v: (vectors % v or v, v))

        def tiles(first: Num, columns: int) -> None:
            def write(first_row: Num, rows: int) -> None:
                self._tile(index, (first_row, rows), (first, columns), (first_term, terms))

            self._in_steps(self.rows, ROWS // len(self.products), write)

        self._in_steps(self.columns, widest * W, tiles)

    def _tile(self, index: list[Num], *parts: tuple[Num, int]) -> None:
        """One tile: the first row, column and term, and how many of each."""
        (first_row, rows), (first_column, columns), (first_term, terms) = parts
        b, nests, product = self.b, self.nests, self.product
        W, dtype, stride = nests.vector_width, product.y.dtype, product.sum.strides[-1]

        def at(first: Num, count: int) -> Num:
            return b.add(first, b.const(count, "int64"))

        def place(r: int, v: int, k: Num) -> list[Num]:
            position = _with(index, product.terms, k)
            if product.rows is not None:
                position = _with(position, product.rows, at(first_row, r))
            return _with(position, len(index) - 1, at(first_column, v * W))

        vectors = range(-(-columns // W))
        rest = columns % W
        masks = [first_elements(b, rest) if (v + 1) * W > columns else None for v in vectors]
        lines = [(p, r) for p in self.products for r in range(rows)]
        tile = [(line, v) for line in range(len(lines)) for v in vectors]
        where = []
        for line, v in tile:
            (total_of, *_), r = lines[line]
            position = place(r, v, first_term)
            where.append(
                nests.address(total_of.memory, total_of.strides, total_of.offset, position)
            )
        if self.has_parts:
            sums = [
                load(b, attotal_of, dtype, stride, masks[v])
                for attotal_of, (_, v) in zip(where, tile, strict=True)
            ]
        else:
            sums = [b.const(0, dtype) for _ in tile]

        def number(node: Expression, r: int, v: int, k: Num, mask: str | None = None) -> Num:
            with nests.scope():  # an expression has another value at each place
                return nests.number(node, place(r, v, k), mask)

        def add(sums: Sequence[Num], k: Num) -> list[Num]:
            with nests.scalars():
                of_rows = [number(p.x, r, 0, k) for p, r in lines]
            of_columns = [number(product.y, 0, v, k, masks[v]) for v in vectors]
            return [
                nests.e.combine("add", total, b.mul(of_rows[line], of_columns[v]))
                for total, (line, v) in zip(sums, tile, strict=True)
            ]

        if terms <= TERMS_OF_A_ROW:
            for k in range(terms):
                sums = add(sums, at(first_term, k))
        else:

            def goes_on(_, i: str) -> str:
                return b.new(f"icmp slt i64 {i}, {terms}")

            def turn(sums: list[Num], i: str) -> list[Num]:
                return add(sums, b.add(first_term, b.number([i], "int64", False)))

            sums = b.loop(sums, [True] * len(sums), goes_on, turn, count=True)
        for attotal_of, total, (_, v) in zip(where, sums, tile, strict=True):
            store(b, attotal_of, total, stride, masks[v])


def _with(index: list[Num], axis: int, i: Num) -> list[Num]:
    return [*index[:axis], i, *index[axis + 1 :]]
