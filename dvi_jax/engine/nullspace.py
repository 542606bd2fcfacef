"""Null spaces of sampled linear conditions, order by order in a small parameter."""

from typing import NamedTuple

import numpy as np

NULL = 1e-9
"""Without a tolerance, a singular value above this share of the largest is never zero."""

RANK = 1e-7
"""Relative size below which a direction counts as dependent on others."""


class NullSpace(NamedTuple):
    """Null vectors as columns; all singular values relative to the largest; ratio at the cut."""

    columns: np.ndarray
    singular_values: np.ndarray
    gap: float


def triangle(matrix: np.ndarray) -> np.ndarray:
    """R of the QR decomposition."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def compress(terms: np.ndarray) -> np.ndarray:
    """Rows with the same inner products of all columns of A_0 … A_z, as few as can be.

    `terms`: shape (rows, z + 1, columns). One orthogonal factor Q for all of them,
    [A_0 … A_z] = Q R, acts on every row block of the Toeplitz matrix alike and changes neither
    its singular values nor its null space.
    """
    rows, orders, size = terms.shape
    if rows <= orders * size:
        return terms / np.sqrt(rows)
    return triangle(terms.reshape(rows, orders * size)).reshape(-1, orders, size) / np.sqrt(rows)


def toeplitz(terms: np.ndarray, order: int) -> np.ndarray:
    """[A_0; A_1 A_0; A_2 A_1 A_0; …] up to A_order, from terms of shape (rows, z + 1, columns)."""
    rows, _, size = terms.shape
    blocks = np.zeros((order + 1, rows, order + 1, size))
    for k in range(order + 1):
        for m in range(k + 1):
            blocks[k, :, m] = terms[:, k - m]
    return blocks.reshape((order + 1) * rows, (order + 1) * size)


def null_space(matrix: np.ndarray, tolerance: float | None = None) -> NullSpace:
    """Directions that the matrix takes to zero.

    With a tolerance: all singular values at most that share of the largest. Without: those
    below the widest gap, as long as they are below `NULL`.
    """
    if matrix.shape[0] > matrix.shape[1]:
        matrix = triangle(matrix)
    singular, V = np.linalg.svd(matrix)[1:]
    size = matrix.shape[1]
    if len(singular) == 0 or singular[0] == 0:
        return NullSpace(V.T, np.zeros(size), np.inf)
    relative = np.append(singular / singular[0], np.zeros(size - len(singular)))
    floor = np.finfo(float).eps
    # ratio[i]: how far the value i stands above the one after it
    ratio = relative / np.maximum(np.append(relative[1:], 0.0), floor)
    if tolerance is not None:
        kept = int(np.sum(relative > tolerance))
    else:
        allowed = np.append(relative[1:] < NULL, False)
        kept = 1 + int(np.argmax(np.where(allowed, ratio, 0))) if allowed.any() else size
    return NullSpace(V.T[:, kept:], relative, float(ratio[kept - 1]) if kept < size else 1.0)


def rank(columns: np.ndarray, above: float = RANK) -> int:
    """Number of directions of a size above `above`."""
    if columns.size == 0:
        return 0
    return int(np.sum(np.linalg.svd(columns, compute_uv=False) > above))


def orthonormal_range(columns: np.ndarray, above: float = RANK) -> np.ndarray:
    """Orthonormal columns of the same span, directions up to the size `above` left out."""
    if columns.size == 0:
        return columns[:, :0]
    U, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return U[:, singular > above]


class SeriesSpace(NamedTuple):
    """Vectors (c_0, …, c_m) in the null space of a Toeplitz matrix, sorted by their first block.

    - `leading`: columns, shape ((m + 1) · size, count), whose first blocks c_0 are orthonormal.
    - `shifts`: orthonormal columns without a first block: what may be added to any of them.
    - `singular_values`, `gap`: of the Toeplitz matrix, see `NullSpace`.
    """

    leading: np.ndarray
    shifts: np.ndarray
    singular_values: np.ndarray
    gap: float


def series_space(terms: np.ndarray, order: int, tolerance: float | None = None) -> SeriesSpace:
    """The null space of the Toeplitz matrix of that order, as series.

    A vector with a small first block is no series unless it is null for the size of that block:
    first blocks are made orthonormal, and judged again.
    """
    matrix = toeplitz(terms, order)
    space = null_space(matrix, tolerance)
    limit = NULL if tolerance is None else 10 * tolerance
    size = terms.shape[2]
    singular, V = np.linalg.svd(space.columns[:size])[1:]
    large = np.flatnonzero(singular > (RANK if tolerance is None else max(RANK, tolerance)))
    leading = space.columns @ (V[large].T / singular[large])
    shifts = space.columns @ np.delete(V, large, axis=0).T
    if leading.shape[1]:
        norm = max(np.linalg.norm(matrix, 2), np.finfo(float).tiny)
        left, W = np.linalg.svd(matrix @ leading / norm)[1:]
        left = np.append(left, np.zeros(len(W) - len(left)))
        leading = leading @ W[left <= limit].T
    return SeriesSpace(leading, shifts, space.singular_values, space.gap)
