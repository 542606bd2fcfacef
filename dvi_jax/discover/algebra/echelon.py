"""Spans of coefficient vectors in their simplest form."""

from collections.abc import Callable

import numpy as np

from .nullspace import RANK


def echelon(columns: np.ndarray, complexity: np.ndarray, threshold: float = RANK):
    """Pivot rows, and columns of the same span: in the pivot row of one those after it are zero.

    Rows are gone through from the most complex function to the simplest. An entry up to the share
    `threshold` of the largest in its column is taken for zero.
    """
    rows = np.argsort(complexity, kind="stable")[::-1]
    work, pivots, out = columns.copy(), [], []
    smallest = RANK * np.max(np.abs(columns), initial=0.0)

    def eliminate(row: int, j: int) -> None:
        nonlocal work
        pivot = work[:, j]
        remainder = np.delete(work, j, axis=1)
        work = remainder - np.outer(pivot, remainder[row] / pivot[row])
        pivots.append(int(row))
        out.append(pivot)

    for row in rows:
        if work.shape[1] == 0:
            break
        size = np.max(np.abs(work), axis=0)
        shares = np.where(size > smallest, np.abs(work[row]) / np.maximum(size, 1e-300), 0.0)
        j = int(np.argmax(shares))
        if shares[j] > threshold:
            eliminate(row, j)
    while work.size and np.max(np.abs(work)) > smallest:  # columns without a clear pivot
        row, j = np.unravel_index(np.argmax(np.abs(work)), work.shape)
        eliminate(int(row), int(j))
    return pivots, np.stack(out, axis=1) if out else columns[:, :0]


def reduced_echelon(columns: np.ndarray, complexity: np.ndarray, threshold: float = RANK):
    """Basis of the same span whose leading-order terms are in reduced echelon form.

    Each column has one pivot. Rows of `columns` below the leading-order term are combined in the
    same way.
    """
    pivots = echelon(columns[: len(complexity)], complexity, threshold)[0][::-1]  # simplest first
    return columns @ np.linalg.pinv(columns[pivots]) if pivots else columns[:, :0]


def reduction(
    columns: np.ndarray, complexity: np.ndarray, size: int, threshold: float = RANK
) -> Callable[[np.ndarray], np.ndarray]:
    """A function that adds multiples of `columns` to a vector until it is as simple as can be.

    The most complex functions go first, those of the lowest order in ε before the others.
    """
    order = np.repeat(np.arange(len(complexity) // size), size)
    pivots, forms = echelon(columns, complexity - (1 + np.max(complexity)) * order, threshold)

    def simplify(vector: np.ndarray) -> np.ndarray:
        for row, column in zip(pivots, forms.T, strict=True):
            vector = vector - vector[row] / column[row] * column
            vector[row] = 0.0
        return vector

    return simplify
