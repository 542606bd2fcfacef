"""Small dense linear systems, and Jacobians that keep the zeros of their structure."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from .jaxprs.jaxapi import primitive

WRITTEN_OUT = 4  # systems up to this size are eliminated number by number in XLA too

# Batches of systems up to this size are eliminated column by column on a CPU: LAPACK's calls for
# batches share the threads of XLA, and may wait for ever for a thread that waits for them.
IN_A_LOOP = 64


def solve(A: Array, b: Array) -> Array:
    """The solution x of A x = b, for A of shape (n, n) and b of shape (n,).

    Linear in b and differentiable in both. In machine code this is Gaussian elimination in which
    zeros by the structure of A stay zeros (a band stays a band); rows are exchanged on those
    trajectories where a pivot is small compared with the numbers below it. A singular matrix gives
    infinities or NaN, which the caller has to check.
    """
    if A.ndim != 2 or A.shape[0] != A.shape[1] or b.shape != A.shape[:1]:
        raise ValueError(
            f"A and b must have shapes (n, n) and (n,), got {A.shape} and {b.shape}. For several "
            "systems use jax.vmap."
        )
    # It makes the solution differentiable any number of times by solving with the same matrix.
    return lax.custom_linear_solve(
        lambda x: A @ x, b, lambda _, b: _eliminate.bind(A, b), lambda _, b: _eliminate.bind(A.T, b)
    )


def _in_arrays(A: ArrayLike, right: ArrayLike) -> Array:
    """The solutions of systems with the shapes (..., n, n) and (..., n)."""
    A, right = jnp.asarray(A), jnp.asarray(right)
    n, lapack = right.shape[-1], _on_each(jnp.linalg.solve)
    # A loop over columns, or a call of LAPACK, takes longer than so few operations.
    if n <= WRITTEN_OUT:
        return _on_each(by_elimination)(A, right)
    if right.ndim == 1 or n > IN_A_LOOP:
        return lapack(A, right)
    return lax.platform_dependent(A, right, cpu=_on_each(column_by_column), default=lapack)


def _on_each(solve_one: Callable) -> Callable:
    return jnp.vectorize(solve_one, signature="(n,n),(n)->(n)")


def by_elimination(A: Array, b: Array) -> Array:
    """The solution of A x = b by elimination with partial pivoting; exchanges are selections."""
    n = b.shape[0]
    rows = [[A[i, j] for j in range(n)] + [b[i]] for i in range(n)]
    for c in range(n):
        for i in range(c + 1, n):  # bring the larger of rows c and i to place c
            larger = jnp.abs(rows[i][c]) > jnp.abs(rows[c][c])
            pairs = list(zip(rows[c], rows[i], strict=True))
            rows[c] = [jnp.where(larger, y, x) for x, y in pairs]
            rows[i] = [jnp.where(larger, x, y) for x, y in pairs]
        for i in range(c + 1, n):
            factor = rows[i][c] / rows[c][c]
            rows[i] = [y - factor * x for x, y in zip(rows[c], rows[i], strict=True)]
    x: list = [None] * n
    for i in reversed(range(n)):
        total = sum((rows[i][j] * x[j] for j in range(i + 1, n)), start=jnp.zeros_like(b[0]))
        x[i] = (rows[i][n] - total) / rows[i][i]
    return jnp.stack(x)


class _Columns(NamedTuple):
    """The rows (A, b) after some columns; the next column, its pivot's row and that row over the
    pivot; which rows were pivots, and which one for each column."""

    rows: Array
    column: Array
    pivot: Array
    pivot_row: Array
    used: Array
    order: Array


def column_by_column(A: Array, b: Array) -> Array:
    """The solution x of A x = b by Gauss and Jordan's elimination, as a loop.

    In each column the largest number of the rows that were not yet pivots is the pivot; the column
    is then eliminated from all other rows.
    """
    n = b.shape[0]
    numbers = jnp.arange(n)

    def choose(c, rows, used, order):
        # What the next round reads is taken out of the rows, so that they can change in place.
        column = lax.dynamic_index_in_dim(rows, c, 1, False)
        p = jnp.argmax(jnp.where(used, -1.0, jnp.abs(column)))
        pivot_row = lax.dynamic_index_in_dim(rows, p, 0, False) / column[p]
        return _Columns(rows, column, p, pivot_row, used, order)

    def eliminate(c, state: _Columns):
        mask = numbers == state.pivot
        difference = state.rows - state.column[:, None] * state.pivot_row[None]
        rows = jnp.where(mask[:, None], state.pivot_row[None], difference)
        order = jnp.where(numbers == c, state.pivot, state.order)
        return choose(jnp.minimum(c + 1, n - 1), rows, state.used | mask, order)

    rows = jnp.concatenate([A, b[:, None]], axis=1)
    start = choose(0, rows, jnp.zeros(n, bool), jnp.zeros(n, int))
    end = lax.fori_loop(0, n, eliminate, start)
    return end.rows[end.order, n]


def _in_batches(arrays, axes):
    """More systems at once: their axis goes in front, of length 1 for what they share."""
    front_arrays = [
        # One matrix for several right-hand sides stays one: its elimination is shared.
        jnp.expand_dims(x, 0) if axis is None else jnp.moveaxis(jnp.asarray(x), axis, 0)
        for x, axis in zip(arrays, axes, strict=True)
    ]
    return _eliminate.bind(*front_arrays), 0


_eliminate = primitive("eliminate", _in_arrays, _in_batches)


def unit_vectors(n: int, dtype) -> Array:
    """The identity matrix; generated code omits operations with its zeros."""
    return _unit_vectors.bind(n=n, dtype=jnp.dtype(dtype))


_unit_vectors = primitive("unit_vectors", lambda *, n, dtype: jnp.eye(n, dtype=dtype))


def on_any(x: Array, rare: bool = True) -> Array:
    """Whether a condition is true for any of the trajectories that run together.

    It may decide what is computed, as a branch that most trajectories do not need, never what a
    trajectory's result is: that must not depend on its neighbours. Where it is `rare` that the
    answer is yes, steps are first run as if it were no, and repeated where it was not.

    **Raises** `TypeError` unless `x` is one truth value, of one trajectory, and `rare` True or
    False.
    """
    kind = jnp.asarray(x)
    if kind.dtype != bool or kind.shape != ():
        raise TypeError(
            f"x must be one boolean, got dtype {kind.dtype} and shape {kind.shape}. Write x > 0 or "
            "jnp.any(x)."
        )
    if not isinstance(rare, bool):
        raise TypeError(f"rare must be True or False, got {rare!r}.")
    return _minimum.bind(jnp.where(x, jnp.int32(0), jnp.int32(1)), rare=rare) == 0


def _least_of_batch(arrays, axes, *, rare):
    (x,), (axis,) = arrays, axes
    # Without a batch axis, so that a `cond` on it stays a branch and does not become a selection.
    return _minimum.bind(jnp.min(x, axis=axis, initial=1), rare=rare), None


_minimum = primitive("least_over_lanes", lambda x, *, rare: x, _least_of_batch)
