"""Primitives of JAX written out in simpler ones, for small arrays of one trajectory."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ..evaluator import RULES, Evaluator, check_types
from ..llvm.ir import NotCompilable, check_size
from ..llvm.values import Value

# Larger matrices are left to XLA, which calls LAPACK; so are stacks that cost more operations than
# one matrix of this size.
MOST_UNKNOWNS = 12

MOST_SORTED = 16  # longer arrays are sorted by XLA


def _square(x: Array, name: str) -> int:
    check_size(x.shape[0], MOST_UNKNOWNS, f"rows of {name}")
    return x.shape[0]


def _of_each_matrix(of_matrix: Callable) -> Callable:
    """A function of matrices, for stacks of them."""

    def of_stacks(*arrays: Array, **parameters: Any) -> Any:
        *front, n, _ = arrays[0].shape
        if not front:
            return of_matrix(*arrays, **parameters)
        count = math.prod(front)
        name = f"matrices × rows³ of {of_matrix.__name__}"
        check_size(count * n**3, MOST_UNKNOWNS**3, name)
        if count == 0 or n == 0:
            raise NotCompilable(f"{name} must be positive, got shape {arrays[0].shape}")
        flat = [x.reshape(count, *x.shape[len(front) :]) for x in arrays]
        results = [of_matrix(*(x[i] for x in flat), **parameters) for i in range(count)]
        return jax.tree.map(lambda *x: jnp.stack(x).reshape(*front, *x[0].shape), *results)

    return of_stacks


def lu(a: Array, **_) -> tuple[Array, Array, Array]:
    """L and U in one matrix, the row that each row was exchanged with, and the permutation."""
    n = _square(a, "lu")
    if a.shape[1] != n:
        raise NotCompilable(f"lu requires a square matrix, got shape {a.shape}")
    rows = [[a[i, j] for j in range(n)] for i in range(n)]
    order, pivots = [jnp.int32(i) for i in range(n)], []
    for c in range(n):
        # Exchanges are selections: the pivot differs between trajectories.
        best, pivot = jnp.abs(rows[c][c]), jnp.int32(c)
        for i in range(c + 1, n):
            larger = jnp.abs(rows[i][c]) > best
            best = lax.select(larger, jnp.abs(rows[i][c]), best)
            pivot = lax.select(larger, jnp.int32(i), pivot)
        pivots.append(pivot)
        for i in range(c + 1, n):
            is_pivot = pivot == i
            for j in range(n):
                upper, lower = rows[c][j], rows[i][j]
                rows[c][j] = lax.select(is_pivot, lower, upper)
                rows[i][j] = lax.select(is_pivot, upper, lower)
            first, second = order[c], order[i]
            order[c], order[i] = (
                lax.select(is_pivot, second, first),
                lax.select(is_pivot, first, second),
            )
        for i in range(c + 1, n):
            factor = rows[i][c] / rows[c][c]
            # As LAPACK: a column of zeros is left as it is.
            rows[i][c] = lax.select(rows[c][c] == 0, rows[i][c], factor)
            for j in range(c + 1, n):
                rows[i][j] = rows[i][j] - rows[i][c] * rows[c][j]
    return jnp.stack([jnp.stack(r) for r in rows]), jnp.stack(pivots), jnp.stack(order)


def triangular_solve(
    a: Array, b: Array, *, left_side: bool, lower: bool, transpose_a: bool, unit_diagonal: bool, **_
) -> Array:
    """X of A X = B, or of X A = B where the matrix is not on the left."""
    n = _square(a, "triangular_solve")
    if transpose_a:
        a, lower = a.T, not lower
    if not left_side:
        a, b, lower = a.T, b.T, not lower
    x: list = [None] * n
    for i in range(n) if lower else reversed(range(n)):
        total = b[i]
        for j in range(i) if lower else range(i + 1, n):
            total = total - a[i, j] * x[j]
        x[i] = total if unit_diagonal else total / a[i, i]
    solution = jnp.stack(x)
    return solution if left_side else solution.T


def cholesky(a: Array, **_) -> Array:
    """The lower triangle of a symmetric positive definite matrix; NaN where it is not definite."""
    n = _square(a, "cholesky")
    rows: list[list] = [[jnp.zeros_like(a[0, 0])] * n for _ in range(n)]
    for j in range(n):
        square = a[j, j] - sum((rows[j][k] ** 2 for k in range(j)), start=jnp.zeros_like(a[0, 0]))
        rows[j][j] = jnp.sqrt(lax.select(square > 0, square, jnp.full_like(square, jnp.nan)))
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total = total - rows[i][k] * rows[j][k]
            rows[i][j] = total / rows[j][j]
    # One pivot that is not positive makes the whole factor NaN, as LAPACK's caller in JAX does.
    zero_or_nan = sum(rows[j][j] * 0 for j in range(n))
    return jnp.stack([jnp.stack([x + zero_or_nan for x in r]) for r in rows])


def sort(*arrays: Array, dimension: int, num_keys: int, **_) -> list[Array]:
    """Arrays in the order of the first `num_keys` of them, by exchanges of neighbours."""
    n = arrays[0].shape[dimension]
    if n == 0:
        return list(arrays)
    check_size(n, MOST_SORTED, "numbers to sort")
    items = [[lax.index_in_dim(x, i, dimension, False) for x in arrays] for i in range(n)]
    # Exchanges at fixed places, whatever the numbers are: odd and even neighbours in turn.
    for turn in range(n):
        for i in range(turn % 2, n - 1, 2):
            a, b = items[i], items[i + 1]
            swap = _precedes(b[:num_keys], a[:num_keys])
            items[i] = [lax.select(swap, y, x) for x, y in zip(a, b, strict=True)]
            items[i + 1] = [lax.select(swap, x, y) for x, y in zip(a, b, strict=True)]
    return [jnp.stack([item[k] for item in items], dimension) for k in range(len(arrays))]


def _precedes(x: Sequence[Array], y: Sequence[Array]) -> Array:
    """Whether x comes before y and not at one place with it; −0 equals 0, NaN is last."""
    # From the last key to the first, which decides unless it is equal.
    is_before = jnp.zeros(x[0].shape, bool)
    for a, b in reversed(list(zip(x, y, strict=True))):
        both_nan = (a != a) & (b != b)
        is_before = (a < b) | ((a == a) & (b != b)) | (((a == b) | both_nan) & is_before)
    return is_before


def _order_key(x: Array) -> Array:
    """Integers in the order of numbers, −NaN < −∞ < … < −0 < 0 < … < ∞ < NaN."""
    if not jnp.issubdtype(x.dtype, jnp.floating):
        return x
    kind = jnp.dtype(f"int{8 * x.dtype.itemsize}")
    bits = lax.bitcast_convert_type(x, kind)
    mask = jnp.asarray(jnp.iinfo(kind).max, kind)
    return lax.select(bits < 0, bits ^ mask, bits)


def nextafter(x: Array, y: Array) -> Array:
    """The number next to x in the direction of y."""
    kind = jnp.dtype(f"int{8 * x.dtype.itemsize}")
    bits = lax.bitcast_convert_type(x, kind)
    is_away = (x < y) == (x > 0)
    # Neighbouring floats have neighbouring bits, in order of their size.
    neighbour = lax.bitcast_convert_type(
        bits + lax.select(is_away, kind.type(1), kind.type(-1)), x.dtype
    )
    smallest = lax.bitcast_convert_type(jnp.ones((), kind), x.dtype)
    # 0 and −0 are one number with two patterns of bits.
    neighbour = lax.select(x == 0, lax.select(y > 0, smallest, -smallest), neighbour)
    neighbour = lax.select(x == y, y, neighbour)
    return lax.select((x != x) | (y != y), x + y, neighbour)


def threefry2x32(*words: Array, **_) -> tuple[Array, Array]:
    """Two words of 32 bits encrypted with a key of two: (key 0, key 1, word 0, word 1).

    **Source** Salmon, Moraes, Dror & Shaw 2011, *Parallel random numbers: as easy as 1, 2, 3*,
    SC11: Threefish with 20 rounds.
    """
    key0, key1, x, y = (w.astype(jnp.uint32) for w in jnp.broadcast_arrays(*words))
    # The constant of Threefish, so that a key of zeros is not a fixed point.
    keys = (key0, key1, key0 ^ key1 ^ np.uint32(0x1BD11BDA))
    x, y = x + key0, y + key1
    for i in range(5):
        for bits in _ROTATIONS[i % 2]:
            x = x + y
            # A rotation to the left, which LLVM recognises.
            left = lax.shift_left(y, jnp.full_like(y, bits))
            y = x ^ (left | lax.shift_right_logical(y, jnp.full_like(y, 32 - bits)))
        # After every four rounds the next pair of the key, and the number of the pair.
        x = x + keys[(i + 1) % 3]
        y = y + keys[(i + 2) % 3] + np.uint32(i + 1)
    return x, y


_ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)


def branch_on(platform: str, platforms: Sequence) -> np.int32:
    """The branch that is taken on a platform; None is any."""
    return np.int32(next(i for i, p in enumerate(platforms) if p is None or platform in p))


def of_this_platform(evaluator: Evaluator, eqn: Any, values: list[Value], places: list):
    return [evaluator.constant(branch_on(evaluator.module.platform, eqn.params["platforms"]))]


# function(*arrays, **parameters of the equation) → the equation's results.
EXPANSIONS: dict[str, Callable] = {
    "lu": _of_each_matrix(lu),
    "triangular_solve": _of_each_matrix(triangular_solve),
    "cholesky": _of_each_matrix(cholesky),
    "sort": sort,
    "nextafter": nextafter,
    "lt_to": lambda x, y: _order_key(x) < _order_key(y),
    "le_to": lambda x, y: _order_key(x) <= _order_key(y),
    "threefry2x32": threefry2x32,
    "platform_index": lambda *, platforms, **_: jnp.asarray(branch_on("cpu", platforms)),
}


def _rule(name: str) -> Callable:
    def rule(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
        body = jax.make_jaxpr(functools.partial(EXPANSIONS[name], **eqn.params))
        return evaluator.evaluate(body(*(var.aval for var in eqn.invars)), values)

    return check_types(rule)


RULES["platform_index"] = of_this_platform
RULES |= {name: _rule(name) for name in EXPANSIONS if name not in RULES}
