"""Null spaces of sampled linear conditions, order by order in a small parameter."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .nullspace import NULL, RANK, by_leading, null_space, singular_vectors, triangle

_FREE = 1e-9
"""Directions of a least-squares problem below this relative size are free."""

_NOTHING = 1e-250
"""A disturbance that changes a step by less than this share of the step is none."""


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


def epsilon_scale(terms: np.ndarray) -> float:
    """s such that A_m s^−m, m ≥ 1, are not larger than A_0 and one is as large; 1 if all vanish.

    With ε in units of 1/s a weak and a strong disturbance are one problem.
    """
    sizes = np.sqrt(np.mean(terms**2, axis=(0, 2)))
    orders = np.arange(1, len(sizes))
    if len(orders) == 0 or sizes[0] == 0:
        return 1.0
    scale = float(np.max((sizes[1:] / sizes[0]) ** (1 / orders)))
    return scale if scale > _NOTHING else 1.0


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
    - `refused`: how many more there were that the judge or a lower order refuses.
    - `unclear`: how many of them change by less than `UNCLEAR`, but by more than rounding.
    """

    leading: np.ndarray
    shifts: np.ndarray
    singular_values: np.ndarray
    gap: float
    refused: int
    unclear: int


def series_spaces(
    fitted: np.ndarray,
    judge: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, int]],
    tolerance: float | None = None,
    unit: float | None = None,
    below: float = NULL,
    trivial: np.ndarray | None = None,
) -> list[SeriesSpace]:
    """The null spaces of the Toeplitz matrices of order 0, 1, … as series.

    Used by every search: for invariants, for symmetries, and for the gauges that close them. A
    vector with a small first block is no series unless it is null for the size of that block:
    candidates are judged again. Those of an order have to lie among those of the order before.

    - `fitted`: weighted rows of A_0 … A_z, shape (rows, z + 1, size).
    - `judge`: (leading, shifts) → those combinations of them that are null by the measure of the
      search, on samples that were not fitted too, and how many are unclear.
    - `tolerance`, `unit`, `below`: see `null_space`.
    - `trivial`: a first block that is no series, shape (size,): that of a constant.
    """
    size = fitted.shape[2]
    spaces: list[SeriesSpace] = []
    for order in range(fitted.shape[1]):
        space = null_space(toeplitz(fitted, order), tolerance, unit, below)
        led, free = by_leading(space.columns[:size], max(RANK, tolerance or 0.0))
        leading, shifts = space.columns @ led, space.columns @ free
        if trivial is not None:
            leading = leading @ _orthogonal_to(trivial @ leading[:size])
        found = leading.shape[1] + shifts.shape[1]
        leading, shifts, unclear = judge(leading, shifts)
        if spaces:
            leading = _within(leading, spaces[-1].leading[:size], size)
        refused = found - leading.shape[1] - shifts.shape[1]
        spaces.append(
            SeriesSpace(leading, shifts, space.singular_values, space.gap, refused, unclear)
        )
    return spaces


def solve_series(terms: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Σ_{m≤k} A_{k−m} g_m = r_k for k = 0 … z by least squares, a lower order before a higher one,
    which uses the freedom that the lower leaves.

    - `terms`: A_0 … A_z, shape (rows, z + 1, size); `right`: r, shape (rows, z + 1).

    **Returns** g, shape ((z + 1) · size,), and what may be added to it, as columns.
    """
    both = compress(np.concatenate([terms, right[..., None]], axis=2))
    terms, right = both[..., :-1], both[..., -1]
    rows, orders, size = terms.shape
    blocks = toeplitz(terms, orders - 1).reshape(orders, rows, -1)
    scale = np.tile(np.sqrt(np.mean(terms[:, 0] ** 2, axis=0)), orders)
    g, free = np.zeros(orders * size), np.diag(1 / np.where(scale > 0, scale, 1))
    for k in range(orders):
        U, singular, V = np.linalg.svd(blocks[k] @ free)
        count = int(np.sum(singular > _FREE * max(singular[0], np.finfo(float).tiny)))
        left = U[:, :count].T @ (right[:, k] - blocks[k] @ g)
        g = g + free @ V[:count].T @ (left / singular[:count])
        free = free @ V[count:].T
    return g, free


def series_changes(terms: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Σ_{m≤k} A_{k−m} c_m for k = 0 … z, of series as columns: shape (S, z + 1, …, count).

    `terms`: A, shape (S, z + 1, …, size); `series`: shape ((z + 1) · size, count).
    """
    size = terms.shape[-1]
    blocks = series.reshape(-1, size, series.shape[1])
    sums = [sum(terms[:, k - m] @ blocks[m] for m in range(k + 1)) for k in range(len(blocks))]
    return np.stack(sums, axis=1)


def _within(leading, before, size) -> np.ndarray:
    """The combinations whose first blocks lie in the span of orthonormal columns."""
    if leading.shape[1] == 0 or before.shape[1] == 0:
        return leading[:, :0]
    cosines, V = singular_vectors(before.T @ leading[:size])
    return leading @ V[cosines > 0.9].T


def _orthogonal_to(direction) -> np.ndarray:
    """Orthonormal columns of what is orthogonal to a direction, or all where it is outside."""
    length = np.linalg.norm(direction)
    if length < 1e-6:
        return np.eye(len(direction))
    return np.linalg.svd((direction / length)[None])[2][1:].T
