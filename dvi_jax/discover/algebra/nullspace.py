"""The null-space algebra of all searches: by singular values, order by order in a small parameter.

A search has sampled linear conditions Σ_{m≤k} A_{k−m} c_m = 0, k = 0 … z, on a series of
coefficients c_0 … c_z: a block-Toeplitz matrix.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .block_triangular import BlockTriangular

NULL = 1e-11  # Without a tolerance, a singular value above this share of the largest is never zero
CLEAR = 1e3  # A gap in the singular values below this is not clear
HELD_OUT = 10  # Held-out samples may leave this many times what fitted ones are allowed to
RANK = 1e-7  # Relative size below which a direction counts as dependent on others
DENSE = 1000  # Coefficients up to which all orders are solved together
_FREE = 1e-9  # Directions of a least-squares problem below this relative size are free
# A perturbation that changes a step by less than this share of the step counts as zero.
_NO_PERTURBATION = 1e-250


class NullSpace(NamedTuple):
    """Null vectors as columns; all singular values relative to the largest; ratio at the cut."""

    columns: np.ndarray
    singular_values: np.ndarray
    gap: float


def triangle(matrix: np.ndarray) -> np.ndarray:
    """R of the QR decomposition."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def singular_vectors(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Singular values, descending, one for each column, and all right singular vectors as rows."""
    rows, columns = matrix.shape
    if matrix.size == 0:
        return np.zeros(columns), np.eye(columns)
    # R has the singular values of the matrix, and far fewer rows.
    singular, V = np.linalg.svd(triangle(matrix) if rows > columns else matrix)[1:]
    return np.append(singular, np.zeros(columns - len(singular))), V


def by_leading(leading: np.ndarray, threshold: float = RANK) -> tuple[np.ndarray, np.ndarray]:
    """Combinations of columns whose leading-order terms are orthonormal, and those without one, up
    to the size `threshold`. `leading`: those of the columns, shape (size, count)."""
    singular, V = singular_vectors(leading)
    large = singular > threshold
    return V[large].T / singular[large], V[~large].T


def null_space(matrix: np.ndarray, tolerance: float | None = None, unit=None, limit=NULL):
    """The `NullSpace` of directions that the matrix takes to zero.

    With a tolerance: all singular values at most that share of the largest. Without: those
    before the widest gap, as long as they are under `limit`, in units of `unit` or of the largest.
    """
    size = matrix.shape[1]
    singular, V = singular_vectors(matrix)
    if size == 0 or singular[0] == 0:
        return NullSpace(V.T, np.zeros(size), np.inf)
    relative = singular / (singular[0] if unit is None or tolerance is not None else unit)
    rank, gap = _cut(relative, tolerance, limit)
    return NullSpace(V.T[:, rank:], relative, gap)


def _cut(relative: np.ndarray, tolerance: float | None, limit: float = NULL) -> tuple[int, float]:
    """How many singular values, descending, are not zero, and the ratio at the cut."""
    if len(relative) == 0:
        return 0, np.inf
    # ratio[i]: how far the value i is below the one before it, the first one below the unit
    previous = np.append(max(1.0, relative[0]), relative[:-1])
    ratio = previous / np.maximum(relative, np.finfo(float).eps)
    if tolerance is not None:
        rank = int(np.sum(relative > tolerance))
    else:
        is_small = relative < limit
        rank = int(np.argmax(np.where(is_small, ratio, 0))) if is_small.any() else len(relative)
    return rank, float(ratio[rank]) if rank < len(relative) else 1.0


def _spaces_of_orders(terms: np.ndarray, tolerance: float | None) -> list[NullSpace]:
    """The null space of the Toeplitz matrix of each order: by its own singular values up to `DENSE`
    columns and with a tolerance, else by those of A_0 and of the secular terms."""
    if tolerance is not None or terms.shape[1] * terms.shape[2] <= DENSE:
        return [null_space(toeplitz(terms, k), tolerance, 1.0) for k in range(terms.shape[1])]
    system, spaces = BlockTriangular(terms, lambda relative: _cut(relative, None)[0], unit=1.0), []
    for k, (step, order) in enumerate(zip(system.steps, system.orders, strict=True)):
        leading, shifts = (c.reshape((k + 1) * terms.shape[2], -1) for c in system.null(k))
        shifts = np.linalg.qr(shifts)[0]
        nonzero, null = [step.singular], [step.spectrum[len(step.singular) :]]
        for columns, split in ((leading, order.initial), (shifts, order.later)):
            # Singular values of the residuals, which may be less than the rounding on the way.
            left = system.left_sides(columns.reshape(k + 1, terms.shape[2], -1))
            null.append(singular_vectors(np.concatenate(left))[0])
            nonzero.append(split.singular)
        ratios = [
            large.min(initial=1.0) / small.max(initial=np.finfo(float).eps)
            for large, small in zip(nonzero, null, strict=True)
        ]
        gap = float(min(ratios)) if sum(map(len, null)) else 1.0
        singular = np.sort(np.concatenate(nonzero + null))[::-1]
        spaces.append(NullSpace(np.hstack([leading, shifts]), singular, gap))
    return spaces


def orthonormal_range(columns: np.ndarray, threshold: float = RANK) -> np.ndarray:
    """Orthonormal columns of the same span, directions up to the size `threshold` left out."""
    if columns.size == 0:
        return columns[:, :0]
    U, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return U[:, singular > threshold]


def independent_columns(columns: np.ndarray, complexity: Any, threshold: float) -> np.ndarray:
    """Numbers of the columns of which more than `threshold` is orthogonal to simpler ones."""
    places, span = [], np.zeros((len(columns), 0))
    for j in np.argsort(complexity, kind="stable"):
        remainder = columns[:, j] / max(np.linalg.norm(columns[:, j]), 1e-300)
        for _ in range(2):  # the second time removes the rounding of the first
            remainder = remainder - span @ (span.T @ remainder)
        if (size := np.linalg.norm(remainder)) > threshold:
            places.append(int(j))
            span = np.column_stack([span, remainder / size])
    return np.sort(np.array(places, int))


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
    return scale if scale > _NO_PERTURBATION else 1.0


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
    - `rejections`: how many more there were that the judge or a lower order rejects.
    - `unclear`: how many of them change by less than `UNCLEAR`, but by more than rounding.
    """

    leading: np.ndarray
    shifts: np.ndarray
    singular_values: np.ndarray
    gap: float
    rejections: int
    unclear: int


def series_spaces(
    rows: np.ndarray,
    judge: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, int]],
    tolerance: float | None = None,
    trivial: np.ndarray | None = None,
) -> list[SeriesSpace]:
    """The null spaces of the Toeplitz matrices of order 0, 1, … as series.

    A vector with a small first block is not a series unless it is null for the size of that block:
    candidates are judged again. Those of an order have to lie among those of the order before.

    - `rows`: weighted rows of A_0 … A_z, shape (rows, z + 1, size).
    - `judge`: (leading, shifts) → those combinations of them that are null by the measure of the
      search, on samples that were not fitted too, and how many are unclear.
    - `tolerance`: see `null_space`.
    - `trivial`: a first block to leave out, shape (size,): that of a constant.
    """
    size = rows.shape[2]
    spaces: list[SeriesSpace] = []
    for space in _spaces_of_orders(rows, tolerance):
        first, free = by_leading(space.columns[:size], max(RANK, tolerance or 0.0))
        leading, shifts = space.columns @ first, space.columns @ free
        leading = remove(trivial, leading)
        count = leading.shape[1] + shifts.shape[1]
        leading, shifts, unclear = judge(leading, shifts)
        if spaces:
            leading = intersection(leading, spaces[-1].leading[:size])
        rejections = count - leading.shape[1] - shifts.shape[1]
        fields = space.singular_values, space.gap, rejections, unclear
        spaces.append(SeriesSpace(leading, shifts, *fields))
    return spaces


def intersection(leading: np.ndarray, span: np.ndarray) -> np.ndarray:
    """The combinations whose first blocks lie in the span of orthonormal columns."""
    if leading.shape[1] == 0 or span.shape[1] == 0:
        return leading[:, :0]
    cosines, V = singular_vectors(span.T @ leading[: len(span)])
    return leading @ V[cosines > 0.9].T


def remove(direction: np.ndarray | None, leading: np.ndarray) -> np.ndarray:
    """The combinations whose first blocks are orthogonal to a direction; all where it is outside of
    their span, or None."""
    shares = np.zeros(0) if direction is None else direction @ leading[: len(direction)]
    length = np.linalg.norm(shares)
    if length < 1e-6:
        return leading
    return leading @ np.linalg.svd((shares / length)[None])[2][1:].T


def solve_series(terms: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Σ_{m≤k} A_{k−m} g_m = r_k for k = 0 … z by least squares, a lower order before a higher one,
    which uses the freedom that the lower leaves.

    - `terms`: A_0 … A_z, shape (rows, z + 1, size); `right`: r, shape (rows, z + 1).

    **Returns** g, shape ((z + 1) · size,), and what may be added to it, as columns.
    """
    system = compress(np.concatenate([terms, right[..., None]], axis=2))
    terms, right = system[..., :-1], system[..., -1]
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
