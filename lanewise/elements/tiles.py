"""Sums of products, as in a matrix product: in tiles of rows and columns, sums in registers.

Each number of a row is used for all columns of a tile, and each number of a column for all rows.
The terms of a sum are added in their order, whatever the tile is.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from ..llvm.ir import Num
from .boxes import Expression
from .tree import Reduce, Statement
from .vectors import first_elements, load, store

# `nests` is the object of `lanewise.elements.nests` that writes all groups: it imports this file.

ROWS = 6
"""Of a tile. The sums of 4 vectors of columns fill the registers of AVX-512, of 2 other ones."""

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


def product_of(statement: Statement, node: Expression, shape: Sequence[int]) -> Product | None:
    """How a reduction is computed in tiles, if it is a sum of such products."""
    if not isinstance(statement, Reduce) or statement.op != "add" or node.kind != "operation":
        return None
    columns = len(shape) - 1
    # A costly factor is computed before the loops over the columns, not in each tile.
    if (
        node.name != "mul"
        or columns in statement.axes
        or max(arg.cost for arg in node.args) > _CHEAP
    ):
        return None
    x, y = node.args if depends(node.args[1], columns) else node.args[::-1]
    if depends(x, columns) or not depends(y, columns):
        return None
    # The longest axis gives the fewest tiles that are not full.
    rows = [k for k in range(columns) if k not in statement.axes and not depends(y, k)]
    return Product(
        statement, x, y, max(rows, key=lambda k: shape[k], default=None), max(statement.axes)
    )


def with_one_matrix(products: Sequence[Product]) -> list[list[Product]]:
    """Products that share a tile: their sums are rows of a product of matrices, for short axes are
    written out."""
    groups: dict[tuple, list[Product]] = {}
    for product in products:
        total = product.sum
        key = product.y.serial, product.rows, total.axes, total.strides[-1]
        groups.setdefault(key, []).append(product)
    parts = []
    for members in groups.values():
        count = len(members)
        size = -(-count // -(-count // ROWS))  # 8 as 4 and 4
        parts += [members[i : i + size] for i in range(0, count, size)]
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
        axes = product.sum.axes
        self.nests, self.b, self.products, self.product = nests, nests.b, products, product
        self.rows = 1 if product.rows is None else shape[product.rows]
        self.columns, self.terms = shape[-1], shape[product.terms]
        self.most_terms = TERMS_OF_A_ROW if self.rows * len(products) == 1 else TERMS
        inner = {product.rows, product.terms, len(shape) - 1}
        # Those of the result first.
        outer = sorted({*range(len(shape))} - inner, key=lambda k: k in axes)
        self.outer = [(k, shape[k]) for k in outer]
        self.has_parts = len(axes) > 1 or self.terms > self.most_terms
        """Whether a tile adds a part of a sum to that which is in memory."""

    def write(self) -> None:
        zero = self.b.const(0, "int64")
        self._outer(self.outer, [zero] * (len(self.outer) + 2 + (self.product.rows is not None)))

    def _outer(self, axes: Sequence[tuple[int, int]], index: list[Num]) -> None:
        """Loops over the other axes."""
        if not axes:
            self._in_steps(self.terms, self.most_terms, lambda *part: self._columns(index, *part))
            return
        (axis, length), *inner = axes

        def turn(i: Num) -> None:
            self._outer(inner, [*index[:axis], i, *index[axis + 1 :]])

        self.nests.count(length, turn)

    def _in_steps(self, length: int, step: int, write: Callable[[Num, int], None]) -> None:
        """``write(first, count)`` for parts of `step` elements, and for what remains."""
        b, (parts, remainder) = self.b, divmod(length, step)
        if parts:
            self.nests.count(parts, lambda i: write(b.mul(i, b.const(step, "int64")), step))
        if remainder:
            with self.nests.scope():
                write(b.const(parts * step, "int64"), remainder)

    def _columns(self, index: list[Num], first_term: Num, terms: int) -> None:
        width = self.nests.vector_width
        vectors = -(-self.columns // width)
        # 9 vectors are three tiles of 3, and not two of 4 with a narrow one.
        widths = (4, 3) if width == 8 else (2,)
        widest = max(widths, key=lambda v: (vectors % v or v, v))

        def tiles(first: Num, columns: int) -> None:
            def write(first_row: Num, rows: int) -> None:
                self._tile(index, (first_row, rows), (first, columns), (first_term, terms))

            self._in_steps(self.rows, ROWS // len(self.products), write)

        self._in_steps(self.columns, widest * width, tiles)

    def _tile(self, index: list[Num], *parts: tuple[Num, int]) -> None:
        """One tile: the first row, column and term, and how many of each."""
        (first_row, rows), (first_column, columns), (first_term, terms) = parts
        b, nests, product = self.b, self.nests, self.product
        width, dtype, stride = nests.vector_width, product.y.dtype, product.sum.strides[-1]

        def plus(first: Num, count: int) -> Num:
            return b.add(first, b.const(count, "int64"))

        def position(row: int, vector: int, term: Num) -> list[Num]:
            result = [*index[:-1], plus(first_column, vector * width)]
            result[product.terms] = term
            if product.rows is not None:
                result[product.rows] = plus(first_row, row)
            return result

        def number(node: Expression, row: int, vector: int, term: Num, mask=None) -> Num:
            with nests.scope():  # an expression has another value at each place
                return nests.number(node, position(row, vector, term), mask)

        masks = [None] * (columns // width)
        if remainder := columns % width:
            masks.append(first_elements(b, remainder))
        lines = [(member, row) for member in self.products for row in range(rows)]
        # The sums of a tile: line by line, in each of them vector by vector.
        tile = [(line, v) for line in range(len(lines)) for v in range(len(masks))]
        targets = []
        for (total, *_), row in lines:
            for v in range(len(masks)):
                place = position(row, v, first_term)
                targets.append(nests.address(total.memory, total.strides, total.offset, place))

        def add(sums: Sequence[Num], term: Num) -> list[Num]:
            with nests.scalars():
                xs = [number(member.x, row, 0, term) for member, row in lines]
            ys = [number(product.y, 0, v, term, mask) for v, mask in enumerate(masks)]
            return [
                nests.e.combine("add", total, b.mul(xs[line], ys[v]))
                for total, (line, v) in zip(sums, tile, strict=True)
            ]

        # The numbers that are carried by the loop over the terms: LLVM keeps them in registers.
        sums = [b.const(0, dtype)] * len(tile)
        if self.has_parts:
            pairs = zip(targets, tile, strict=True)
            sums = [load(b, target, dtype, stride, masks[v]) for target, (_, v) in pairs]
        # No loop for a few terms: the tile is short, and its address is computed once.
        if terms <= TERMS_OF_A_ROW:
            for i in range(terms):
                sums = add(sums, plus(first_term, i))
        else:
            sums = b.loop(
                sums,
                [True] * len(sums),
                lambda _, i: b.new(f"icmp slt i64 {i}, {terms}"),
                lambda state, i: add(state, b.add(first_term, b.number([i], "int64", False))),
                count=True,
            )
        for target, total, (_, v) in zip(targets, sums, tile, strict=True):
            store(b, target, total, stride, masks[v])
