"""Linear systems with a band matrix, as loops over its rows.

Row i of `rows` has A[i, i − low], …, A[i, i + high], with `low` diagonals below
the main one and `high` above it; those outside of A are zero.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

LARGEST_FACTOR = 8.0
"""Of a row that is subtracted from another; with a larger one rows are exchanged, since errors
grow with the factors."""


class Factors(NamedTuple):
    """A = L U without exchanges.

    - `lower`: of shape (n, low), the numbers of L below its diagonal of ones.
    - `inverse`: of shape (n,), one over the diagonal of U.
    - `upper`: of shape (n, high), the other numbers of U, each row times its `inverse`.
    - `weak`: whether a number of L is large, or not finite.
    """

    lower: Array
    inverse: Array
    upper: Array
    weak: Array


def factorise(rows: Array, low: int) -> Factors:
    """The factors of a band matrix, row by row."""
    high = rows.shape[1] - low - 1

    def step(carry, row):
        # The last rows of U, before they are multiplied, and one over their pivots.
        upper, inverse, weak = carry
        entries, lower = [row[j] for j in range(low + high + 1)], []
        for m in range(low):
            factor = entries[m] * inverse[m]
            lower.append(factor)
            # Not "larger than": NaN is weak too.
            weak |= ~(jnp.abs(factor) <= LARGEST_FACTOR)
            for j in range(high):
                entries[m + 1 + j] = entries[m + 1 + j] - factor * upper[m, j]
        one_over = 1 / entries[low]
        row_of_u = jnp.stack(entries[low + 1 :]) if high else jnp.zeros(0, rows.dtype)
        carry = (_next_window(upper, row_of_u), _next_window(inverse, one_over), weak)
        return carry, (
            jnp.stack(lower) if low else row_of_u[:0],
            one_over,
            row_of_u * one_over,
        )

    dtype = rows.dtype
    start = (
        jnp.zeros((low, high), dtype),
        jnp.zeros(low, dtype),
        jnp.asarray(False),
    )
    (_, _, weak), (lower, inverse, upper) = lax.scan(step, start, rows)
    return Factors(lower, inverse, upper, weak)


def substitute(factors: Factors, right: Array) -> Array:
    """The solutions of L U x = b for the columns of `right`, of shape (n, k)."""
    lower, inverse, upper, _ = factors
    low, high, columns = lower.shape[1], upper.shape[1], right.shape[1]

    def forward(last, row):
        factors_of_row, one_over, value = row
        for m in range(low):
            value = value - factors_of_row[m] * last[m]
        return _next_window(last, value), value * one_over

    def backward(last, row):
        numbers, value = row
        for j in range(high):
            value = value - numbers[j] * last[high - 1 - j]
        return _next_window(last, value), value

    start = jnp.zeros((low, columns), right.dtype)
    _, y = lax.scan(forward, start, (lower, inverse, right))
    start = jnp.zeros((high, columns), right.dtype)
    return lax.scan(backward, start, (upper, y), reverse=True)[1]


def _next_window(last: Array, new: Array) -> Array:
    """The last few rows, with a new one at the end."""
    return jnp.concatenate([last[1:], new[None]]) if last.shape[0] else last


def with_exchanges(rows: Array, right: Array, low: int) -> Array:
    """The solutions by partial pivoting: in each column the largest of its numbers."""
    width = rows.shape[1]
    columns = right.shape[1]
    # A window of low + 1 rows moves down, and one column to the right each time. After the last
    # row come zeros, which are no pivots if there is another number.
    rows = jnp.concatenate([rows, jnp.zeros((low + 1, width), rows.dtype)])
    right = jnp.concatenate([right, jnp.zeros((low + 1, columns), right.dtype)])
    first = [
        jnp.concatenate([rows[m, low - m :], jnp.zeros(low - m, rows.dtype)])
        for m in range(low + 1)
    ]

    def step(window, new):
        A, b = window
        # With NaN in it, the first NaN.
        p = jnp.argmax(jnp.abs(A[:, 0]))
        mask = jnp.arange(low + 1) == p
        pivot, y = (jnp.sum(jnp.where(mask[:, None], x, 0), 0) for x in (A, b))
        A, b = (jnp.where(mask[:, None], x[:1], x) for x in (A, b))
        factors = A[1:, 0] / pivot[0]
        A = A[1:, 1:] - factors[:, None] * pivot[None, 1:]
        b = b[1:] - factors[:, None] * y[None]
        A = jnp.concatenate([A, jnp.zeros((low, 1), A.dtype)], 1)
        window = (jnp.concatenate([A, new[0][None]]), jnp.concatenate([b, new[1][None]]))
        return window, (pivot, y)

    start = (jnp.stack(first), right[: low + 1])
    _, (upper, y) = lax.scan(step, start, (rows[low + 1 :], right[low + 1 :]))

    def backward(last, row):
        numbers, value = row
        for j in range(width - 1):
            value = value - numbers[j + 1] * last[width - 2 - j]
        value = value / numbers[0]
        return _next_window(last, value), value

    start = jnp.zeros((width - 1, columns), right.dtype)
    return lax.scan(backward, start, (upper, y), reverse=True)[1]


def solve(factors: Factors, rows: Array, right: Array) -> Array:
    """The solutions by the factors, or with exchanges where they are weak."""
    low = factors.lower.shape[1]
    return lax.cond(
        factors.weak,
        lambda: with_exchanges(rows, right, low),
        lambda: substitute(factors, right),
    )


def rows_of(
    diagonals: Sequence[Array],
    offsets: Sequence[int],
    low: int,
    high: int,
    order=None,
) -> Array:
    """The rows of the matrix that has ``diagonals[k][i]`` at (i, i + offsets[k]); with `order`
    those of the matrix in which row i and column i are the old ones ``order[i]``."""
    n, columns = len(diagonals[0]), range(-low, high + 1)
    if order is None:
        zero, of = jnp.zeros_like(diagonals[0]), dict(zip(offsets, diagonals, strict=True))
        return jnp.stack([of.get(d, zero) for d in columns], axis=1)
    # For each number of a row of the band its diagonal in the old matrix, or the row of zeros.
    table = np.full((n, len(columns)), len(offsets))
    for j, step in enumerate(columns):
        rows = np.arange(max(0, -step), min(n, n - step))
        distance = order[rows + step] - order[rows]
        for k, d in enumerate(offsets):
            table[rows[distance == d], j] = k
    values = jnp.stack([*diagonals, jnp.zeros_like(diagonals[0])])
    return values[table, order[:, None]]
