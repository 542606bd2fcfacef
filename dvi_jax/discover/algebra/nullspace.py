"""The null-space algebra of all searches: by singular values, order by order in a small parameter.

A search has sampled linear conditions Σ_{m≤k} A_{k−m} c_m = 0, k = 0 … z, on a series of
coefficients c_0 … c_z: a block-Toeplitz matrix.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .block_triangular import BlockTriangular

NULL = 1e-11  # Without a tolerance, a singular value above this share of the largest is never zero
CLEAR = 1e3  # A gap in the singular values below this is not clear
HELD_OUT = 10  # Held-out samples may leave this many times what fitted ones are allowed to
RANK = 1e-7  # Relative size below which a direction counts as dependent on others
DENSE = 1000  # Coefficients up to which all orders are solved together
_FREE = 1e-9  # Directions of a least-squares problem below this relative size are free
# A perturbation that changes a step by less than this share of the step counts as zero.
_NOTHING = 1e-250


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
    # R has the singular values of the matrix, and far fewer rows.
    singular, V = np.linalg.svd(triangle(matrix) if rows > columns else matrix)[1:]
    return np.append(singular, np.zeros(columns - len(singular))), V


def by_leading(leading: np.ndarray, above: float = RANK) -> tuple[np.ndarray, np.ndarray]:
    """Combinations of columns whose leading-order terms are orthonormal, and those without one, up
    to the size `above`. `leading`: the leading-order terms of the columns, shape (size, count)."""
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
    relative = singular / (singular[0] if unit is None or tolerance is not None else unit)
    kept, gap = _cut(relative, tolerance, below)
    return NullSpace(V.T[:, kept:], relative, gap)


def _cut(relative: np.ndarray, tolerance: float | None, below: float = NULL) -> tuple[int, float]:
    """How many singular values, descending, are not zero, and the ratio at the cut."""
    if len(relative) == 0:
        return 0, np.inf
    # ratio[i]: how far the value i is below the one before it, the first one below the unit
    before = np.append(max(1.0, relative[0]), relative[:-1])
    ratio = before / np.maximum(relative, np.finfo(float).eps)
    if tolerance is not None:
        kept = int(np.sum(relative > tolerance))
    else:
        allowed = relative < below
        kept = int(np.argmax(np.where(allowed, ratio, 0))) if allowed.any() else len(relative)
    return kept, float(ratio[kept]) if kept < len(relative) else 1.0


def _spaces_of_orders(terms: np.ndarray, tolerance: float | None) -> list[NullSpace]:
    """The null space of the Toeplitz matrix of each order: by its own singular values up to `DENSE`
    columns and with a tolerance, else by those of A_0 and of the secular terms."""
    if tolerance is not None or terms.shape[1] * terms.shape[2] <= DENSE:
        orders = range(terms.shape[1])
        return [null_space(toeplitz(terms, k), tolerance, 1.0) for k in orders]
    system, spaces = BlockTriangular(terms, lambda relative: _cut(relative, None)[0], unit=1.0), []
    for k, (step, order) in enumerate(zip(system.steps, system.orders, strict=True)):
        leading, shifts = (c.reshape((k + 1) * terms.shape[2], -1) for c in system.null(k))
        shifts = np.linalg.qr(shifts)[0]
        kept, null = [step.singular], [step.every[len(step.singular) :]]
        for columns, split in ((leading, order.rest), (shifts, order.later)):
            # Singular values of the residuals, which may be less than the rounding on the way.
            left = system.left_sides(columns.reshape(k + 1, terms.shape[2], -1))
            null.append(singular_vectors(np.concatenate(left))[0])
            kept.append(split.singular)
        ratios = [
            above.min(initial=1.0) / below.max(initial=np.finfo(float).eps)
            for above, below in zip(kept, null, strict=True)
        ]
        gap = float(min(ratios)) if sum(map(len, null)) else 1.0
        singular = np.sort(np.concatenate(kept + null))[::-1]
        spaces.append(NullSpace(np.hstack([leading, shifts]), singular, gap))
    return spaces


def orthonormal_range(columns: np.ndarray, above: float = RANK) -> np.ndarray:
    """Orthonormal columns of the same span, directions up to the size `above` left out."""
    if columns.size == 0:
        return columns[:, :0]
    U, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return U[:, singular > above]


# --- series --------------------------------------------------------------------------


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
    `terms`: shape (rows, z + 1, columns).

    With ε in units of 1/s a weak and a strong perturbation are one problem.
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
    - `refused`: how many more there were that the judge or a lower order rejects.
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
    trivial: np.ndarray | None = None,
) -> list[SeriesSpace]:
    """The null spaces of the Toeplitz matrices of order 0, 1, … as series.

    A vector with a small first block is not a series unless it is null for the size of that block:
    candidates are judged again. Those of an order have to lie among those of the order before.

    - `fitted`: weighted rows of A_0 … A_z, shape (rows, z + 1, size).
    - `judge`: (leading, shifts) → those combinations of them that are null by the measure of the
      search, on samples that were not fitted too, and how many are unclear.
    - `tolerance`: see `null_space`.
    - `trivial`: a first block to leave out, shape (size,): that of a constant.
    """
    size = fitted.shape[2]
    spaces: list[SeriesSpace] = []
    for space in _spaces_of_orders(fitted, tolerance):
        led, free = by_leading(space.columns[:size], max(RANK, tolerance or 0.0))
        leading, shifts = space.columns @ led, space.columns @ free
        if trivial is not None:
            leading = leading @ orthogonal_to(trivial @ leading[:size])
        found = leading.shape[1] + shifts.shape[1]
        leading, shifts, unclear = judge(leading, shifts)
        if spaces:
            leading = within(leading, spaces[-1].leading[:size])
        refused = found - leading.shape[1] - shifts.shape[1]
        spaces.append(
            SeriesSpace(leading, shifts, space.singular_values, space.gap, refused, unclear)
        )
    return spaces


def within(leading: np.ndarray, before: np.ndarray) -> np.ndarray:
    """The combinations whose first blocks lie in the span of orthonormal columns."""
    if leading.shape[1] == 0 or before.shape[1] == 0:
        return leading[:, :0]
    cosines, V = singular_vectors(before.T @ leading[: len(before)])
    return leading @ V[cosines > 0.9].T


def orthogonal_to(direction: np.ndarray) -> np.ndarray:
    """Orthonormal columns orthogonal to a direction, or all of them where it is outside."""
    length = np.linalg.norm(direction)
    if length < 1e-6:
        return np.eye(len(direction))
    return np.linalg.svd((direction / length)[None])[2][1:].T


def solve_series(terms: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Σ_{m≤k} A_{k−m} g_m = r_k for k = 0 … z by least squares, a lower order before a higher one,
    which uses the freedom that the lower leaves.

    - `terms`: A_0 … A_z, shape (rows, z + 1, size); `right`: r, shape (rows, z + 1).

    **Returns** g, shape ((z + 1) · size,), and what may be added to it, as columns.
    """
    both = compress(np.concatenate([terms, right[..., None]], axis=2))
    terms, right = both[..., :-1], both[..., -1]
    rows, orders, _ = terms.shape
    blocks = toeplitz(terms, orders - 1).reshape(orders, rows, -1)
    scale = np.tile(np.sqrt(np.mean(terms[:, 0] ** 2, axis=0)), orders)
    g, free = np.zeros(len(scale)), np.diag(1 / np.where(scale > 0, scale, 1))
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
    blocks = series.reshape(-1, terms.shape[-1], series.shape[1])
    sums = [sum(terms[:, k - m] @ blocks[m] for m in range(k + 1)) for k in range(len(blocks))]
    return np.stack(sums, axis=1)
