"""Null spaces of matrices, by singular values."""

from typing import NamedTuple

import numpy as np

NULL = 1e-11
"""Without a tolerance, a singular value above this share of the largest is never zero."""

CLEAR = 1e3
"""A gap in the singular values below this is not clear."""

HELD_OUT = 10
"""Held-out samples may leave this many times what fitted ones are allowed to."""


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


def singular_vectors(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The singular value of each column's direction, descending, zeros included, shape (columns,);
    and all right singular vectors as rows."""
    rows, columns = matrix.shape
    if matrix.size == 0:
        return np.zeros(columns), np.eye(columns)
    singular, V = np.linalg.svd(triangle(matrix) if rows > columns else matrix)[1:]
    return np.append(singular, np.zeros(columns - len(singular))), V


def by_leading(leading: np.ndarray, above: float = RANK) -> tuple[np.ndarray, np.ndarray]:
    """Combinations of columns whose leading parts are orthonormal, and those without one, up to
    the size `above`. `leading`: the leading parts of the columns, shape (size, count)."""
    singular, V = singular_vectors(leading)
    large = singular > above
    return V[large].T / singular[large], V[~large].T


def null_space(
    matrix: np.ndarray,
    tolerance: float | None = None,
    unit: float | None = None,
    below: float = NULL,
) -> NullSpace:
    """Directions that the matrix takes to zero.

    With a tolerance: all singular values at most that share of the largest. Without: those
    before the widest gap, as long as they are under `below`, in units of `unit` or of the largest.
    """
    size = matrix.shape[1]
    singular, V = singular_vectors(matrix)
    if size == 0 or singular[0] == 0:
        return NullSpace(V.T, np.zeros(size), np.inf)
    unit = singular[0] if unit is None or tolerance is not None else unit
    relative = singular / unit
    # ratio[i]: how far the value i stands below the one before it, the first below the unit
    before = np.append(max(1.0, relative[0]), relative[:-1])
    ratio = before / np.maximum(relative, np.finfo(float).eps)
    if tolerance is not None:
        kept = int(np.sum(relative > tolerance))
    else:
        allowed = relative < below
        kept = int(np.argmax(np.where(allowed, ratio, 0))) if allowed.any() else size
    return NullSpace(V.T[:, kept:], relative, float(ratio[kept]) if kept < size else 1.0)


def orthonormal_range(columns: np.ndarray, above: float = RANK) -> np.ndarray:
    """Orthonormal columns of the same span, directions up to the size `above` left out."""
    if columns.size == 0:
        return columns[:, :0]
    U, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return U[:, singular > above]
