"""Loops over the elements of arrays: the code of one group of statements.

The lanes of a vector are neighbours along the innermost axis. Numbers are computed by the rules of
`lanewise.rules.elementwise`, those of a value that is the same for all elements as scalars.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence

from ..evaluator import Evaluator
from ..llvm.ir import Num
from ..llvm.memory import stored_type
from ..rules.elementwise import ELEMENTWISE
from ..rules.reductions import neutral
from .boxes import Array, Expression, common_boxes
from .schedule import Group, arrays
from .tiles import Tiles, product_of, with_one_matrix
from .tree import Let, Memory, Number, Reduce, Statement, Store, Update
from .updates import write_element, write_update
from .vectors import first_elements, gather, halves, load, store

PARTIAL_SUMS = 32
"""Element k of a row is added to partial sum k mod 32, whatever the length of a vector is."""

_CHEAP = (
    40  # bodies of so many operations are repeated until one vector of each partial sum is done
)
_SHORT_ROW = 4  # columns of fewer elements are computed one by one


class Nests:
    """Writes groups. `pointers` and `numbers` hold what is known by name in the code so far."""

    def __init__(self, evaluator: Evaluator, places: dict[Memory, int], dead: set[Memory]):
        self.e, self.b = evaluator, evaluator.b
        self.vector_width = self.b.W
        self.places, self.dead = places, dead
        self.pointers: dict[Memory, str] = {}
        self.numbers: dict[Number, Num] = {}
        self.head: list[str] = []  # lines of the entry of the function
        self.loops = self.stores = 0  # innermost loops, and arrays that they write
        self._sums: dict[Reduce, str] = {}
        self._direct: set[Reduce] = set()
        self.group_now = Group((), [])

    # --- groups ----------------------------------------------------------------------------------

    def group(self, group: Group) -> None:
        statements = group.statements
        if not group.shape:
            with self.scalars(), self.scope():  # what is stored here may be updated later
                self.scalar_statements(statements)
            return
        if isinstance(statements[0], Update):
            write_update(self, statements[0])
            return
        # The common boxes of all statements, one nest of loops for each.
        of_each = [arrays(s)[-1] for s in statements]
        cells = []
        for lower, upper, nodes in sorted(common_boxes(of_each), key=lambda c: c[:2]):
            items = list(zip(statements, nodes, strict=True))
            if items := [(s, node) for s, node in items if not self.is_in_place(s, node)]:
                cells.append((lower, upper, items))
        if not cells:
            return
        self.group_now = group
        cells = self.without_products(group, cells)
        reductions = dict.fromkeys(
            s for *_, items in cells for s, _ in items if isinstance(s, Reduce)
        )
        with self.scope():
            for s in reductions:
                self.begin_reduction(s, group.shape, cells)
            for lower, upper, items in cells:
                with self.scope():
                    self.nest(lower, upper, items, [])
            # The partial sums run through all boxes: they are joined once.
            for s in reductions:
                if isinstance(s.result, Number):
                    self.numbers[s.result] = self.total(s)

    def without_products(self, group: Group, cells: list) -> list:
        """Write the sums of products that are one box in tiles: the cells of the other statements.

        They come before these: what they read may be written over, and they read no result of
        their group.
        """
        if len(cells) != 1:
            return cells
        ((lower, upper, items),) = cells
        products, remainder = [], []
        for s, node in items:
            product = product_of(s, node, group.shape)
            if product is None or any(group.is_handed_on(x) for x in node.loads(set())):
                remainder.append((s, node))
            else:
                products.append(product)
        # A product of a few rows is a few sums, for short axes are written out.
        for of_matrix in with_one_matrix(products):
            with self.scope():
                tiles = Tiles(self, of_matrix, group.shape)
                for product in of_matrix if tiles.has_parts else ():
                    self.begin_reduction(product.sum, group.shape, cells)
                tiles.write()
        return [(lower, upper, remainder)] if remainder else []

    def is_in_place(self, s: Statement, node: Expression) -> bool:
        """Whether a statement would copy an element to where it is."""
        if not isinstance(s, Store) or node.kind != "load" or node.args or s.memory in self.dead:
            return False
        if node is s.target:
            return True
        mine, other = self.places.get(s.memory), self.places.get(node.value)
        is_same = mine is not None and mine == other and s.memory.dtype == node.dtype
        return is_same and (node.strides, node.offset) == (s.strides, s.offset)

    def scalar_statements(self, statements: Sequence[Statement]) -> None:
        b, results = self.b, []
        # All loads before all stores, as in `body`: elements may be written over one another.
        for s in statements:
            x = self.number(arrays(s)[-1].boxes[0].expression, [])
            if isinstance(s, Let):
                self.numbers[s.number] = b.opaque(x)
            elif isinstance(s, Update):
                write_element(self, s, self.number(s.distance.boxes[0].expression, []), x, [])
            elif isinstance(s, Store):
                b.note(("node", s.target.serial), b.opaque(x))
                results.append((s, x))
            else:
                raise AssertionError("a reduction without axes")
        for s, x in results:
            if s.memory not in self.dead:
                store(b, self.address(s.memory, s.strides, s.offset, []), x, 0)

    def nest(self, lower, upper, items, index: list[Num]) -> None:
        """Loops over the axes from number len(index) on."""
        b, d, rank = self.b, len(index), len(lower)
        # What does not depend on the inner loops is computed before them, as scalars.
        with self.scalars():
            self.hoist(items, d, index)
        sums = [s for s, _ in items if isinstance(s, Reduce) and self.first_summed(s) == d > 0]
        for s in sums:
            # A row of a matrix that is summed over its last axes has sums of its own.
            self.clear(s)
        if d < rank - 1:
            first = b.const(lower[d], "int64")

            def turn(i: Num) -> None:
                self.nest(lower, upper, items, [*index, b.add(i, first)])

            self.count(upper[d] - lower[d], turn)
        else:
            self.innermost(lower[d], upper[d], items, index)
        for s in sums:
            with self.scope():
                total = self.total(s)
                with self.scalars():
                    where = self.address(s.memory, s.strides, s.offset, index)  # pyright: ignore[reportArgumentType]
                    # A row that consists of several boxes is summed in several parts.
                    if s not in self._direct:
                        total = self.e.combine(s.op, load(b, where, s.array.dtype, 0), total)
                    store(b, where, total, 0)

    def innermost(self, lower: int, upper: int, items, index: list[Num]) -> None:
        """The loop over the innermost axis, in vectors."""
        b, count, W = self.b, upper - lower, self.vector_width
        self.loops += 1
        self.stores += sum(isinstance(s, Store) and s.memory not in self.dead for s, _ in items)

        def at(i: Num, step: int, first: int) -> Num:
            return b.add(b.mul(i, b.const(step, "int64")), b.const(lower + first, "int64"))

        # Ends of a chain, columns of a field: one by one. Not by the length of a vector, on which
        # bits must not depend.
        if count < _SHORT_ROW:
            with self.scalars():
                for k in range(count):
                    with self.scope():
                        self.body(items, [*index, b.const(lower + k, "int64")], None, k)
            return
        sums = [s for s, _ in items if isinstance(s, Reduce) and self.first_summed(s) is not None]
        cost = sum(node.cost for _, node in items)
        vectors, rest = divmod(count, W)
        # With sums, a round does one vector of each partial sum, so that the sums stay in
        # registers, and the latency of an addition does not count. A long body is not repeated:
        # it would fill the cache of instructions, and its own latency is longer.
        repeats = PARTIAL_SUMS // W if sums and cost < _CHEAP else 1
        rounds = vectors // repeats
        if rounds:

            def turn(i: Num) -> None:
                for u in range(repeats):
                    k = b.const(u * W, "int64")
                    if sums and repeats == 1:  # a long body: its partial sum by a computed index
                        k = b.mul(
                            b.logic("and", i, b.const(PARTIAL_SUMS // W - 1, "int64")),
                            b.const(W, "int64"),
                        )
                    with self.scope():
                        self.body(items, [*index, at(i, repeats * W, u * W)], None, k)

            self.count(rounds, turn)
        for v in range(rounds * repeats, vectors):
            with self.scope():
                start = b.const(lower + v * W, "int64")
                self.body(items, [*index, start], None, v * W % PARTIAL_SUMS)
        # The last elements with a mask: number by number they would take as long as all others.
        if rest:
            with self.scope():
                start, mask = b.const(lower + vectors * W, "int64"), first_elements(b, rest)
                self.body(items, [*index, start], mask, vectors * W % PARTIAL_SUMS)

    def body(self, items, index: list[Num], mask: str | None, k: "Num | int") -> None:
        """All statements at one place of the loops; `k`: where a row's partial sum is."""
        b = self.b
        # All loads before all stores: an array may be written over another one.
        results = []
        for s, node in items:
            x = self.number(node, index, mask)
            results.append((s, x))
            if isinstance(s, Store):
                # Later statements read it from the register. What is written is closed off: a
                # product is not contracted with a sum that reads it, so that bits do not depend
                # on which statements share loops.
                b.note(("node", s.target.serial), b.opaque(x))
        for s, x in results:
            if isinstance(s, Store):
                if s.memory not in self.dead:
                    where = self.address(s.memory, s.strides, s.offset, index)
                    store(b, where, x, s.strides[-1], mask)
                continue
            # The innermost axis is kept: each element has a sum in memory.
            if self.first_summed(s) is None:
                assert s.memory is not None
                where, stride = self.address(s.memory, s.strides, s.offset, index), s.strides[-1]
                old = load(b, where, s.array.dtype, stride, mask)
                store(b, where, self.e.combine(s.op, old, x), stride, mask)
                continue
            dtype = s.array.dtype
            where = b.new(
                f"getelementptr {stored_type(dtype)}, ptr {self._sums[s]}, i64 {self.ref(k)}"
            )
            old = load(b, where, dtype, 1)
            new = self.e.combine(s.op, old, x)
            if mask is not None:
                kind, bits = b.type(dtype, True), b.type("bool", True)
                names = b.ref(new, 0, True), b.ref(old, 0, True)
                selection = b.new(f"select {bits} {mask}, {kind} {names[0]}, {kind} {names[1]}")
                new = b.number([selection], dtype, True)
            store(b, where, new, 1)

    def ref(self, k: "Num | int") -> str:
        return str(k) if isinstance(k, int) else self.b.ref(k, 0, False)

    def hoist(self, items, depth: int, index: list[Num]) -> None:
        """Compute what depends on the loops that are opened so far and on no others."""
        visited: set[int] = set()

        def visit(node: Expression) -> None:
            if node.serial in visited:
                return
            visited.add(node.serial)
            if node.depth > depth:
                for arg in node.args:
                    visit(arg)
            elif node.kind not in ("known", "number") and not self.group_now.is_handed_on(node):
                self.number(node, index)

        for _, node in items:
            visit(node)

    # --- reductions ------------------------------------------------------------------------------

    def first_summed(self, s: Reduce) -> int | None:
        """The axis from which on all axes vanish: their sums are kept in registers. None if the
        innermost axis is kept."""
        d = len(s.strides)
        while d > 0 and d - 1 in s.axes:
            d -= 1
        return d if d < len(s.strides) else None

    def begin_reduction(self, s: Reduce, shape, cells) -> None:
        item = stored_type(s.array.dtype)
        if self.first_summed(s) is not None and s not in self._sums:
            name = f"%sums{len(self._sums)}"
            self.head.append(f"  {name} = alloca [{PARTIAL_SUMS} x {item}], align 64")
            self._sums[s] = name
        # All axes vanish: one sum for all boxes.
        if isinstance(s.result, Number):
            self.clear(s)
            return
        # A row that is one cell gives the result at once.
        d = self.first_summed(s)
        if (
            d is not None
            and s.axes == set(range(d, len(shape)))
            and all(
                low[d:] == (0,) * (len(shape) - d) and up[d:] == tuple(shape[d:])
                for low, up, _ in cells
            )
        ):
            self._direct.add(s)
            return
        kept = [k for k in range(len(shape)) if k not in s.axes]
        start = Array.uniform(
            s.array.table.known(neutral(s.op, s.array.dtype), s.array.dtype),
            [shape[k] for k in kept],
        )
        fill = Store(s.result, [s.strides[k] for k in kept], s.offset, start)
        group, self.group_now = self.group_now, Group(start.shape, [fill])
        for lower, upper, node in start.boxes:
            with self.scope():
                self.nest(lower, upper, [(fill, node)], [])
        self.group_now = group

    def clear(self, s: Reduce) -> None:
        """All partial sums of nothing."""
        dtype = s.array.dtype
        x = self.b.const(neutral(s.op, dtype), dtype)
        for k in range(0, PARTIAL_SUMS, self.vector_width):
            where = self.b.new(f"getelementptr {stored_type(dtype)}, ptr {self._sums[s]}, i64 {k}")
            store(self.b, where, x, 1)

    def total(self, s: Reduce) -> Num:
        """The partial sums combined by halves: in one order for all lengths of vectors."""
        b, dtype, W = self.b, s.array.dtype, self.vector_width
        item, vectors = stored_type(dtype), []
        for k in range(0, PARTIAL_SUMS, W):
            where = b.new(f"getelementptr {item}, ptr {self._sums[s]}, i64 {k}")
            vectors.append(load(b, where, dtype, 1))
        while len(vectors) > 1:
            half = len(vectors) // 2
            vectors = [
                self.e.combine(s.op, x, y)
                for x, y in zip(vectors[:half], vectors[half:], strict=True)
            ]
        total = vectors[0]
        with self.scalars():
            while W > 1:
                total = self.e.combine(s.op, *halves(b, total, W))
                W //= 2
        return b.opaque(total)

    # --- numbers ---------------------------------------------------------------------------------

    @contextlib.contextmanager
    def scope(self) -> Iterator[None]:
        self.b.scopes.append({})
        yield
        self.b.scopes.pop()

    @contextlib.contextmanager
    def scalars(self) -> Iterator[None]:
        """Code without vectors; its numbers are good for vectors too."""
        before, self.b.W = self.b.W, 1
        yield
        self.b.W = before

    def count(self, length: int, turn: Callable[[Num], None]) -> None:
        """``turn(i)`` for i = 0, …, length − 1."""
        b = self.b
        if length == 1:
            with self.scope():
                turn(b.const(0, "int64"))
            return
        b.repeat(length, lambda i: turn(b.number([i], "int64", False)))

    def number(self, node: Expression, index: Sequence[Num], mask: str | None = None) -> Num:
        """The value of an expression, at an index of which the last part begins a vector."""
        b = self.b
        if node.kind == "number":
            return self.numbers[node.value]
        if node.kind == "known":
            return b.const(node.value, node.dtype)
        # Equal expressions are one object: each is computed once in a scope.
        key = ("node", node.serial)
        x = b.find(key)
        if x is not None:
            return x
        varies = b.W > 1 and bool(node.strides) and len(index) == len(node.strides)
        varies = varies and node.strides[-1] != 0
        if node.kind == "operation":
            args = [self.number(arg, index, mask) for arg in node.args]
            x = ELEMENTWISE[node.name.split()[0]](self.e, node.value or {}, *args)
        elif node.kind == "load":
            by = self.number(node.args[0], index, mask) if node.args else None
            # An index of its own for each element.
            if by is not None and by.vec:
                where = self.address(node.value, node.strides, node.offset, index)
                stride = node.strides[-1] if varies else 0
                x = gather(b, where, node.dtype, by, stride, mask)
            else:
                where = self.address(node.value, node.strides, node.offset, index, by)
                x = load(b, where, node.dtype, node.strides[-1] if varies else 0, mask)
        else:
            x = self.linear(node.strides, node.offset, index)
            # Neighbours along the innermost axis.
            if varies:
                steps = ", ".join(f"i64 {node.strides[-1] * i}" for i in range(b.W))
                name = b.new(f"add {b.type('int64', True)} {b.ref(x, 0, True)}, <{steps}>")
                x = b.number([name], "int64", True)
            is_delta = node.kind == "delta"
            x = b.compare("eq", x, b.const(0, "int64")) if is_delta else b.convert(x, node.dtype)
        b.note(key, x)
        return x

    def linear(self, strides: Sequence[int], offset: int, index: Sequence[Num]) -> Num:
        b, total = self.b, self.b.const(offset, "int64")
        for stride, i in zip(strides, index, strict=False):
            if stride:
                total = b.add(b.mul(i, b.const(stride, "int64")), total)
        return total

    def pointer(self, memory: Memory) -> str:
        """The first element of a memory."""
        if memory.whole is not None:
            whole = self.pointer(memory.whole)
            # The row of a round.
            assert memory.distance is not None
            with self.scalars():
                distance = self.number(memory.distance, [])
            return self.b.pointer(stored_type(memory.dtype), whole, self.b.ref(distance, 0, False))
        if memory not in self.pointers:
            name = f"%memory{len(self.pointers)}"
            start = self.places[memory]
            self.head.append(f"  {name} = getelementptr i8, ptr %scratch, i64 {start}")
            self.pointers[memory] = name
        return self.pointers[memory]

    def address(self, memory: Memory, strides, offset: int, index, by: Num | None = None) -> str:
        b = self.b
        distance = self.linear(strides, offset, index)
        if by is not None:
            distance = b.add(distance, by)
        return b.pointer(stored_type(memory.dtype), self.pointer(memory), b.ref(distance, 0, False))
