"""Null spaces of sampled linear conditions, order by order in a small parameter."""

from typing import NamedTuple

import numpy as np

NULL = 1e-11
"""Without a tolerance, a singular value above this share of the largest is never zero."""

HELD_OUT = 10
"""Held-out samples may leave this many times what fitted ones are allowed to."""

_NOISE = 1e-14
"""A disturbance that changes a step by less than this share of the step is round-off."""

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


def epsilon_scale(terms: np.ndarray) -> float:
    """s such that A_m s^−m, m ≥ 1, are not larger than A_0 and one is as large; 1 if all vanish.

    With ε in units of 1/s a weak and a strong disturbance are one problem.
    """
    sizes = np.sqrt(np.mean(terms**2, axis=(0, 2)))
    orders = np.arange(1, len(sizes))
    if len(orders) == 0 or sizes[0] == 0:
        return 1.0
    scale = float(np.max((sizes[1:] / sizes[0]) ** (1 / orders)))
    return scale if scale > _NOISE else 1.0


def in_units_of(scale: float, terms: np.ndarray, axis: int = 1) -> np.ndarray:
    """Terms of order m in ε over scale^m: those in ε · scale."""
    shape = [1] * terms.ndim
    shape[axis] = terms.shape[axis]
    return terms / (scale ** np.arange(terms.shape[axis])).reshape(shape)


class SeriesSpace(NamedTuple):
    """Vectors (c_0, …, c_m) in the null space of a Toeplitz matrix, sorted by their first block.

    - `leading`: columns, shape ((m + 1) · size, count), whose first blocks c_0 are orthonormal.
    - `shifts`: orthonormal columns without a first block: what may be added to any of them.
    - `singular_values`, `gap`: of the Toeplitz matrix, see `NullSpace`.
    - `refused`: how many more there were that held-out conditions or a lower order refuse.
    """

    leading: np.ndarray
    shifts: np.ndarray
    singular_values: np.ndarray
    gap: float
    refused: int


def series_spaces(
    fitted: np.ndarray,
    held_out: np.ndarray,
    tolerance: float | None = None,
    trivial: np.ndarray | None = None,
) -> list[SeriesSpace]:
    """The null spaces of the Toeplitz matrices of order 0, 1, … as series.

    A vector with a small first block is no series unless it is null for the size of that block:
    first blocks are made orthonormal and judged again, by fitted and held-out conditions. Those of
    an order have to lie among those of the order before.

    - `fitted`, `held_out`: A_0 … A_z, shapes (rows, z + 1, size). `trivial`: a first block that
      is no series, shape (size,): that of a constant.
    """
    size = fitted.shape[2]
    spaces: list[SeriesSpace] = []
    for order in range(fitted.shape[1]):
        matrix = toeplitz(fitted, order)
        space = null_space(matrix, tolerance)
        leading, shifts = _by_first_block(space.columns, size, tolerance)
        found = leading.shape[1]
        conditions = np.vstack([matrix, toeplitz(held_out, order)])
        leading = _judged(leading, conditions, np.linalg.norm(matrix, 2), tolerance)
        refused = found - leading.shape[1]
        if trivial is not None:
            leading = leading @ _orthogonal_to(trivial @ leading[:size])
        if spaces:
            found = leading.shape[1]
            leading = _within(leading, spaces[-1].leading[:size], size)
            refused += found - leading.shape[1]
        spaces.append(SeriesSpace(leading, shifts, space.singular_values, space.gap, refused))
    return spaces


def _by_first_block(columns, size, tolerance) -> tuple[np.ndarray, np.ndarray]:
    singular, V = np.linalg.svd(columns[:size])[1:]
    large = np.flatnonzero(singular > (RANK if tolerance is None else max(RANK, tolerance)))
    leading = columns @ (V[large].T / singular[large])
    return leading, columns @ np.delete(V, large, axis=0).T


def _judged(leading, conditions, norm, tolerance) -> np.ndarray:
    """The combinations that all conditions take for null."""
    if leading.shape[1] == 0 or norm == 0:
        return leading
    limit = HELD_OUT * (NULL if tolerance is None else tolerance)
    left, V = np.linalg.svd(triangle(conditions @ leading / norm))[1:]
    left = np.append(left, np.zeros(len(V) - len(left)))
    return leading @ V[left <= limit].T


def _within(leading, before, size) -> np.ndarray:
    """The combinations whose first blocks lie in the span of orthonormal columns."""
    if leading.shape[1] == 0 or before.shape[1] == 0:
        return leading[:, :0]
    cosines, V = np.linalg.svd(before.T @ leading[:size])[1:]
    cosines = np.append(cosines, np.zeros(len(V) - len(cosines)))
    return leading @ V[cosines > 0.9].T


def _orthogonal_to(direction) -> np.ndarray:
    """Orthonormal columns of what is orthogonal to a direction, or all where it is outside."""
    length = np.linalg.norm(direction)
    if length < 1e-6:
        return np.eye(len(direction))
    return np.linalg.svd((direction / length)[None])[2][1:].T
