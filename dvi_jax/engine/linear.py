"""Small dense linear solves, written out so that a batch of them vectorises."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

UNROLLED_UP_TO = 4
"""Systems up to this size are eliminated in components; larger ones go to LAPACK."""


@jax.jit
def solve_dense(A: Inexact[Array, "n n"], b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
    """Solution x of A x = b, linear in b and differentiable in both.

    For n ≤ `UNROLLED_UP_TO` this is Gaussian elimination with partial pivoting on scalars,
    the row exchanges done by selection: under `vmap` every operation is elementwise over
    the batch, where `jnp.linalg.solve` would call LAPACK once a lane. A singular matrix
    gives infinities or NaN, for the caller's status to report.
    """
    n = b.shape[0]
    if n > UNROLLED_UP_TO:
        return jnp.linalg.solve(A, b)
    rows = [[A[i, j] for j in range(n)] + [b[i]] for i in range(n)]
    for c in range(n):
        for i in range(c + 1, n):  # bring the larger of rows c and i to place c
            larger = jnp.abs(rows[i][c]) > jnp.abs(rows[c][c])
            exchanged = [
                (jnp.where(larger, y, x), jnp.where(larger, x, y))
                for x, y in zip(rows[c], rows[i], strict=True)
            ]
            rows[c] = [e[0] for e in exchanged]
            rows[i] = [e[1] for e in exchanged]
        for i in range(c + 1, n):
            factor = rows[i][c] / rows[c][c]
            rows[i] = [y - factor * x for x, y in zip(rows[c], rows[i], strict=True)]
    x: list = [None] * n
    for i in reversed(range(n)):
        known = sum((rows[i][j] * x[j] for j in range(i + 1, n)), start=jnp.zeros_like(b[0]))
        x[i] = (rows[i][n] - known) / rows[i][i]
    return jnp.stack(x)
