"""Small dense linear systems, number by number."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..evaluator import RULES, Evaluator
from ..llvm.builder import Builder
from ..llvm.ir import TYPES, Num, Unsupported
from ..llvm.memory import Buffer, load, store
from ..llvm.values import MADE, Entries, Value
from ..module import Module

# Rows are exchanged if a factor is larger: without exchanges errors grow with the factors, and each
# exchange costs a branch.
_LARGEST_FACTOR = 8.0  # of a row that is subtracted from another without an exchange


def linear_solve(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    """custom_linear_solve: what it solves with."""
    lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    start = lengths.matvec + lengths.vecmat
    consts = values[start : start + lengths.solve]
    b = values[sum(lengths) :]
    return e.closed(jaxprs.solve, [*consts, *b])


def eliminate(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    """Dense systems, by elimination; rows are exchanged on trajectories that need it."""
    matrices, vectors = values
    if matrices.size > MADE // 4:
        raise Unsupported(
            f"the matrices of linear systems must have at most {MADE // 4} elements in all, got "
            f"shape {matrices.shape}"
        )
    (out,) = eqn.outvars
    front = out.aval.shape[:-1]
    A = np.broadcast_to(e.entries(matrices), (*front, *matrices.shape[-2:]))
    b = np.broadcast_to(e.entries(vectors), out.aval.shape)
    return [e.value([x for i in np.ndindex(front) for x in _one(e, A[i], b[i])], out.aval)]


def _one(e: Evaluator, matrix: Entries, vector: Entries) -> list[Num]:
    b = e.b
    rows = [[*row, x] for row, x in zip(matrix, vector, strict=True)]
    numbers = [x for row in rows for x in row]
    vec = any(x.vec for x in numbers)
    # Solved without exchanges first: their selections would take more operations than the solution.
    found, weak = solved(b, [list(r) for r in rows])
    if weak.known is not None and not weak.known:
        return found
    if e.assumed is not None:
        e.assumed.never(weak)
        # As results of a branch, so that the bits are those of the version with branches.
        return [b.unrelated(x) for x in found]

    def selected() -> list[Num]:
        # Only where it is needed: other trajectories of the block keep their numbers to the bit.
        others = exchanged(e, numbers, vec)
        return [b.select(weak, x, y) for x, y in zip(others, found, strict=True)]

    n = len(found)
    return b.branch(b.any(weak), selected, lambda: found, [vec] * n, [numbers[0].dtype] * n)


def exchanged(e: Evaluator, numbers: Sequence[Num], vec: bool) -> list[Num]:
    """The solution of a linear system with exchanges of rows, of its numbers row by row (A, b).

    It is needed rarely and takes many operations: a function of the module, by way of memory.
    """
    module, b, dtype = e.module, e.b, numbers[0].dtype
    n = math.isqrt(len(numbers))
    block, calls = (b.W, b.U) if vec else (1, 1)
    called = f"@exchanged_{n}_{TYPES[dtype]}_{'v' if block > 1 else 's'}"
    if (called, block) not in module.functions:
        text, declared = _exchange_text(n, dtype, block, called)
        module.functions[called, block] = text
        module.declared |= declared
    count = len(numbers) + n
    # One trajectory's vector after the other: each call has a piece of memory of its own.
    whole = module.scratch((count * calls,), dtype, False, block)
    item = np.dtype(dtype).itemsize * block * count
    pieces = [b.new(f"getelementptr i8, ptr {whole.base[0]}, i64 {u * item}") for u in range(calls)]
    place = Buffer(tuple(pieces), dtype, (count,), (block,), 1 if vec else None)
    for i, x in enumerate(numbers):
        store(b, place, x, i * block)
    for piece in pieces:
        b.emit(f"call void {called}(ptr {piece})")
    return [load(b, place, (len(numbers) + i) * block) for i in range(n)]


@functools.cache
def _exchange_text(n: int, dtype: str, width: int, called: str) -> tuple[str, frozenset[str]]:
    """A function that solves the system at a pointer, n rows (A, b), and puts x after it."""
    inner = Module(width, 1)
    b = inner.b
    system = Buffer(("%p",), dtype, (n, n + 1), ((n + 1) * width, width), 1)
    solution = Buffer(("%p",), dtype, (n,), (width,), 1, (n * (n + 1) * width,))
    with_exchanges(b, system, solution)
    lines = "\n".join(b.lines)
    text = f"define internal void {called}(ptr %p) noinline {{\nentry:\n{lines}\n  ret void\n}}\n"
    return text, frozenset(b.declared)


def solved(b: Builder, rows: list[list[Num]]) -> tuple[list[Num], Num]:
    """The solution of the system with rows (A, b), zeros of the structure left out and no rows
    exchanged, and whether a pivot was too small for that."""
    n, dtype, weak = len(rows), rows[0][0].dtype, b.known(False, "bool")
    limit = b.known(_LARGEST_FACTOR, dtype)
    for c in range(n):
        one_over = b.div(b.known(1, dtype, structural=True), rows[c][c])
        for i in range(c + 1, n):
            # A zero of the structure stays: a band costs as many operations as it has numbers.
            if rows[i][c].is_known_as(0):
                continue
            factor = b.mul(rows[i][c], one_over)
            # Not "larger than": NaN is weak too.
            fine = b.compare("le", b.abs(factor), limit)
            weak = b.logic("or", weak, b.invert(fine))
            for j in range(c + 1, n + 1):
                rows[i][j] = b.sub(rows[i][j], b.mul(factor, rows[c][j]))
        # The back substitution multiplies: a division takes as long as ten products.
        rows[c][c] = one_over
    x: list[Any] = [None] * n
    for i in reversed(range(n)):
        total = rows[i][n]
        for j in range(i + 1, n):
            total = b.sub(total, b.mul(rows[i][j], x[j]))
        x[i] = b.mul(total, rows[i][i])
    return x, weak


def with_exchanges(b: Builder, system: Buffer, solution: Buffer) -> None:
    """Solve the system with rows (A, b) in memory by partial pivoting, where exchanges are
    selections; the system is overwritten."""
    n, one = system.shape[0], b.known(1, "int64")
    size, width = b.known(n, "int64"), b.known(n + 1, "int64")

    def each(first: Num, last: Num, body: Callable[[Num], None]) -> None:
        def turn(state, _):
            body(state[0])
            return [b.add(state[0], one)]

        b.loop([first], [False], lambda state, _: b.less(state[0], last), turn)

    def at(i: Num, j: Num) -> Buffer:
        return system.row(b, i).row(b, j)

    def column(c: Num) -> None:
        after = b.add(c, one)

        def pivot(i: Num) -> None:  # the larger of rows c and i to place c
            larger = b.compare("gt", b.abs(load(b, at(i, c))), b.abs(load(b, at(c, c))))

            def exchange(j: Num) -> None:
                upper, lower = load(b, at(c, j)), load(b, at(i, j))
                store(b, at(c, j), b.select(larger, lower, upper))
                store(b, at(i, j), b.select(larger, upper, lower))

            each(c, width, exchange)

        each(after, size, pivot)
        one_over = b.div(b.known(1, system.dtype), load(b, at(c, c)))

        def clear(i: Num) -> None:
            factor = b.mul(load(b, at(i, c)), one_over)

            def subtract(j: Num) -> None:
                product = b.mul(factor, load(b, at(c, j)))
                store(b, at(i, j), b.sub(load(b, at(i, j)), product))

            each(after, width, subtract)

        each(after, size, clear)
        store(b, at(c, c), one_over)

    def unknown(k: Num) -> None:
        i = b.sub(b.known(n - 1, "int64"), k)

        def subtract(state, _):
            j, total = state
            product = b.mul(load(b, at(i, j)), load(b, solution.row(b, j)))
            return [b.add(j, one), b.sub(total, product)]

        first, right = b.add(i, one), load(b, at(i, size))
        _, total = b.loop(
            [first, right], [False, True], lambda state, _: b.less(state[0], size), subtract
        )
        store(b, solution.row(b, i), b.mul(total, load(b, at(i, i))))

    zero = b.known(0, "int64")
    each(zero, size, column)
    each(zero, size, unknown)


def unit_vectors(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    n, dtype = eqn.params["n"], str(eqn.params["dtype"])
    numbers = [e.b.known(int(i == j), dtype, structural=True) for i in range(n) for j in range(n)]
    value = e.value(numbers, eqn.outvars[0].aval)
    value.is_tangent = True
    return [value]


RULES |= {"custom_linear_solve": linear_solve, "eliminate": eliminate, "unit_vectors": unit_vectors}
