"""Small dense linear solves, written out so that a batch of them vectorises."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Inexact

from .._compat import primitive

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
    if b.shape[0] > UNROLLED_UP_TO:
        return jnp.linalg.solve(A, b)
    return by_elimination(A, b)


def by_elimination(A: Inexact[Array, "n n"], b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
    """`solve_dense` without the library for any n, written out."""
    n = b.shape[0]
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


def solve_near_identity(
    A: Inexact[Array, "n n"], b: Inexact[Array, " n"], checked: bool = False
) -> Inexact[Array, " n"]:
    """Solution of A x = b where A needs no pivoting: close to the identity, or trusted to be.

    In component form it is an elimination without exchanges that leaves out what is zero by the
    structure of A (a band stays a band); elsewhere `solve_dense`. Whoever trusts must look at the
    result, or have it `checked`: rows are then exchanged where the remainder A x − b asks for it.
    Linear in b and differentiable in both.
    """
    return lax.custom_linear_solve(
        lambda x: A @ x,
        b,
        lambda _, b: _eliminate.bind(A, b, checked=checked),
        lambda _, b: _eliminate.bind(A.T, b, checked=checked),
    )


def _in_arrays(A, b, *, checked: bool):
    return solve_dense(A, b)  # with exchanges: there is nothing to check


_eliminate = primitive("eliminate", _in_arrays)


def unit_vectors(n: int, dtype) -> Inexact[Array, "n n"]:
    """The identity matrix, whose zeros are known to be zeros in component form."""
    return _unit_vectors.bind(n=n, dtype=jnp.dtype(dtype))


_unit_vectors = primitive("unit_vectors", lambda *, n, dtype: jnp.eye(n, dtype=dtype))
