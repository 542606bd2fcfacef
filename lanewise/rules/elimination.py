"""Small dense linear systems, number by number."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..evaluator import RULES, Evaluator
from ..jaxprs.dependence import cut
from ..llvm.builder import Builder
from ..llvm.ir import TYPES, Num, check_size
from ..llvm.memory import Buffer, load, store
from ..llvm.values import MOST_ENTRIES, Entries, Value
from ..module import Module

# Rows are exchanged if a factor is larger: without exchanges errors grow with the factors, and each
# exchange costs a branch.
_LARGEST_FACTOR = 8.0  # of a row that is subtracted from another without an exchange


def linear_solve(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    """custom_linear_solve: what it solves with."""
    lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    _, consts, _ = cut(values, lengths.matvec + lengths.vecmat, lengths.solve)
    return evaluator.evaluate(jaxprs.solve, [*consts, *values[sum(lengths) :]])


def eliminate(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    """Dense systems, by elimination; rows are exchanged on trajectories that need it."""
    matrices, vectors = values
    check_size(matrices.size, MOST_ENTRIES // 4, "elements of the matrices", matrices.shape)
    (out,) = eqn.outvars
    front = out.aval.shape[:-1]
    A = np.broadcast_to(evaluator.entries(matrices), (*front, *matrices.shape[-2:]))
    b = np.broadcast_to(evaluator.entries(vectors), out.aval.shape)
    return [
        evaluator.value(
            [x for i in np.ndindex(front) for x in _solution(evaluator, A[i], b[i])], out.aval
        )
    ]


def _solution(evaluator: Evaluator, matrix: Entries, vector: Entries) -> list[Num]:
    b = evaluator.b
    rows = [[*row, x] for row, x in zip(matrix, vector, strict=True)]
    numbers = [x for row in rows for x in row]
    vec = any(x.vec for x in numbers)
    # Solved without exchanges first: their selections would take more operations than the solution.
    solution, weak = eliminate_in_order(b, [list(r) for r in rows])
    if weak.value is not None and not weak.value:
        return solution
    if evaluator.assumptions is not None:
        evaluator.assumptions.assume_false(weak)
        # As results of a branch, so that the bits are those of the version with branches.
        return [b.without_origin(x) for x in solution]

    def selection() -> list[Num]:
        # Only where it is needed: other trajectories of the block keep their numbers to the bit.
        exact_solution = solve_with_exchanges(evaluator, numbers, vec)
        return [b.select(weak, x, y) for x, y in zip(exact_solution, solution, strict=True)]

    flags, dtypes = [vec] * len(rows), [numbers[0].dtype] * len(rows)
    return b.branch(b.any_lane(weak), selection, lambda: solution, flags, dtypes)


def solve_with_exchanges(evaluator: Evaluator, numbers: Sequence[Num], vec: bool) -> list[Num]:
    """The solution of the system with these rows (A, b) by a function with exchanges of rows."""
    module, b, dtype = evaluator.module, evaluator.b, numbers[0].dtype
    n = math.isqrt(len(numbers))
    block, calls = (b.W, b.U) if vec else (1, 1)
    symbol = f"@exchanged_{n}_{TYPES[dtype]}_{'v' if block > 1 else 's'}"
    module.add_function((symbol, block), lambda: _exchange_text(n, dtype, block, symbol))
    count = len(numbers) + n
    # One trajectory's vector after the other: each call has a piece of memory of its own.
    memory = module.scratch((count * calls,), dtype, False, block)
    size, (base,) = np.dtype(dtype).itemsize * block * count, memory.base
    pieces = [b.new(f"getelementptr i8, ptr {base}, i64 {u * size}") for u in range(calls)]
    place = Buffer(tuple(pieces), dtype, (count,), (block,), 1 if vec else None)
    for i, x in enumerate(numbers):
        store(b, place, x, i * block)
    for piece in pieces:
        b.emit(f"call void {symbol}(ptr {piece})")
    return [load(b, place, (len(numbers) + i) * block) for i in range(n)]


@functools.cache
def _exchange_text(
    n: int, dtype: str, width: int, symbol: str
) -> tuple[str, frozenset[str], tuple]:
    """A function that solves the system at a pointer, n rows (A, b), and puts x after it."""
    inner = Module(width, 1)
    b = inner.b
    system = Buffer(("%p",), dtype, (n, n + 1), ((n + 1) * width, width), 1)
    solution = Buffer(("%p",), dtype, (n,), (width,), 1, (n * (n + 1) * width,))
    with_exchanges(b, system, solution)
    lines = "\n".join(b.lines)
    text = f"define internal void {symbol}(ptr %p) noinline {{\nentry:\n{lines}\n  ret void\n}}\n"
    return text, frozenset(b.declarations), ()


def eliminate_in_order(b: Builder, rows: list[list[Num]]) -> tuple[list[Num], Num]:
    """The solution of the system with rows (A, b) without exchanges; whether a pivot is small."""
    n, dtype, weak = len(rows), rows[0][0].dtype, b.const(False, "bool")
    limit = b.const(_LARGEST_FACTOR, dtype)
    for c in range(n):
        one_over = b.div(b.const(1, dtype, structural=True), rows[c][c])
        for i in range(c + 1, n):
            # A zero of the structure stays: a band costs as many operations as it has numbers.
            if rows[i][c].is_const(0):
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
    """Solve the system with rows (A, b) in memory by partial pivoting; exchanges are selections."""
    n, unit = system.shape[0], b.const(1, "int64")
    size, width = b.const(n, "int64"), b.const(n + 1, "int64")

    def count(first: Num, last: Num, body: Callable[[Num], None]) -> None:
        def turn(i: Num) -> list[Num]:
            body(i)
            return [b.add(i, unit)]

        b.loop_below(last, [first], [False], turn)

    def element(i: Num, j: Num) -> Buffer:
        return system.row(b, i).row(b, j)

    def column(c: Num) -> None:
        next_column = b.add(c, unit)

        def pivot(i: Num) -> None:  # the larger of rows c and i to place c
            larger = b.compare("gt", b.abs(load(b, element(i, c))), b.abs(load(b, element(c, c))))

            def exchange(j: Num) -> None:
                upper, lower = load(b, element(c, j)), load(b, element(i, j))
                store(b, element(c, j), b.select(larger, lower, upper))
                store(b, element(i, j), b.select(larger, upper, lower))

            count(c, width, exchange)

        count(next_column, size, pivot)
        one_over = b.div(b.const(1, system.dtype), load(b, element(c, c)))

        def clear(i: Num) -> None:
            factor = b.mul(load(b, element(i, c)), one_over)

            def subtract(j: Num) -> None:
                product = b.mul(factor, load(b, element(c, j)))
                store(b, element(i, j), b.sub(load(b, element(i, j)), product))

            count(next_column, width, subtract)

        count(next_column, size, clear)
        store(b, element(c, c), one_over)

    def substitute(k: Num) -> None:
        i = b.sub(b.const(n - 1, "int64"), k)

        def subtract(j: Num, total: Num) -> list[Num]:
            product = b.mul(load(b, element(i, j)), load(b, solution.row(b, j)))
            return [b.add(j, unit), b.sub(total, product)]

        first, right = b.add(i, unit), load(b, element(i, size))
        _, total = b.loop_below(size, [first, right], [False, True], subtract)
        store(b, solution.row(b, i), b.mul(total, load(b, element(i, i))))

    zero = b.const(0, "int64")
    count(zero, size, column)
    count(zero, size, substitute)


def unit_vectors(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    n, dtype = eqn.params["n"], str(eqn.params["dtype"])
    numbers = [
        evaluator.b.const(int(i == j), dtype, structural=True) for i in range(n) for j in range(n)
    ]
    value = evaluator.value(numbers, eqn.outvars[0].aval)
    value.is_tangent = True
    return [value]


RULES |= {"custom_linear_solve": linear_solve, "eliminate": eliminate, "unit_vectors": unit_vectors}
