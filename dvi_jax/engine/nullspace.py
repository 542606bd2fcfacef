"""Null spaces of sampled linear conditions, order by order in a small parameter."""

from typing import NamedTuple

import numpy as np

NULL = 1e-11
"""Without a tolerance, a singular value above this share of the largest is never zero."""

CLEAR = 1e3
"""A gap in the singular values below this is not clear."""

HELD_OUT = 10
"""Held-out samples may leave this many times what fitted ones are allowed to."""

_NOTHING = 1e-250
"""A disturbance that changes a step by less than this share of the step is none."""

UNCLEAR = 1e-6
"""A null vector that changes by less than this share of what its slopes predict, but by more than
rounding, may be an invariant or not."""

RANK = 1e-7
"""Relative size below which a direction counts as dependent on others."""

ROUNDING = 1e-12
"""Rows are weighted so that their rounding is below this; `NULL` stands above it."""

_RESOLVED = 1e-3
"""Rounding may be this share of a change that can be told from none."""

_COEFFICIENTS = 1e-15
"""Errors of the coefficients of a null vector, relative to its length."""


_RARE = 100.0
"""Samples at which functions are so many times larger than at three quarters of them count less."""


def typical_sizes(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How large functions are on samples, root mean square, shape (size,), and weights of the
    samples, shape (S,): 1, and less where functions are larger than at nearly all others.

    `values`: shape (S, size).
    """
    units = np.median(np.abs(values), axis=0)
    units = np.where(units > 0, units, np.max(np.abs(values), axis=0))
    units = np.where(units > 0, units, 1.0)
    relative = values / units
    size = np.max(np.abs(relative), axis=1)
    weights = np.minimum(1, _RARE * np.quantile(size, 0.75) / np.maximum(size, 1.0))
    return units * np.sqrt(np.mean((weights[:, None] * relative) ** 2, axis=0)), weights


class Motion(NamedTuple):
    """How much functions change in the step of each sample, by their slopes, and by rounding.

    - `changes`: ∂φ_b/∂z_i Δz_i of each function and coordinate z = (q, p, t), shape (S, 2n + 1,
      size).
    - `rounding`: the largest rounding error of each function's change, shape (S, size).
    """

    changes: np.ndarray
    rounding: np.ndarray

    def of(self, combinations: np.ndarray) -> "Motion":
        """Of combinations of the functions, columns of shape (size, count)."""
        return Motion(self.changes @ combinations, self.rounding @ np.abs(combinations))

    def at_most(self, spread: float) -> "Motion":
        """The same, with no larger changes than the functions differ by between samples: a step
        that expands goes beyond the range where slopes predict anything."""
        size = np.sqrt(np.sum(self.changes**2, axis=(1, 2), keepdims=True))
        return self._replace(changes=self.changes / np.maximum(size / spread, 1))

    def weights(self) -> np.ndarray:
        """For rows of changes, shape (S,): what functions typically change by becomes 1, where
        that stands far enough above rounding, so that no sample with a large step decides alone."""
        typical = np.sqrt(np.sum(self.changes**2, axis=(1, 2)))
        rounding = np.sqrt(np.sum(self.rounding**2, axis=1))
        return 1 / np.maximum(np.maximum(typical, rounding / ROUNDING), np.finfo(float).tiny)

    def undecided(self) -> int:
        """How many combinations change in the steps by hardly more than rounding."""
        some = slice(None, None, max(1, self.changes[..., 0].size // (8 * self.changes.shape[2])))
        weighted = (self.weights()[:, None, None] * self.changes)[some]
        slopes = np.linalg.svd(triangle(weighted.reshape(-1, weighted.shape[2])), compute_uv=False)
        missing = weighted.shape[2] - len(slopes)
        return missing + int(np.sum(slopes / np.sqrt(len(weighted)) < ROUNDING / _RESOLVED))


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
    - `refused`: how many more there were that held-out conditions or a lower order refuse.
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
    terms: np.ndarray,
    motion: Motion,
    tolerance: float | None = None,
    trivial: np.ndarray | None = None,
) -> list[SeriesSpace]:
    """The null spaces of the Toeplitz matrices of order 0, 1, … as series.

    A vector with a small first block is no series unless it is null for the size of that block,
    nor one whose first block has small slopes: candidates are judged again by their own slopes, on
    all samples, see `_judged`. Those of an order have to lie among those of the order before.

    - `fitted`: weighted rows of A_0 … A_z, shape (rows, z + 1, size). `terms`: the rows of all
      samples without weights; `motion`: what the functions change by there, and its rounding.
    - `trivial`: a first block that is no series, shape (size,): that of a constant.
    """
    size = fitted.shape[2]
    spaces: list[SeriesSpace] = []
    for order in range(fitted.shape[1]):
        matrix = toeplitz(fitted, order)
        space = null_space(matrix, tolerance, 1.0)
        led, free = by_leading(space.columns[:size], max(RANK, tolerance or 0.0))
        leading, shifts = space.columns @ led, space.columns @ free
        if trivial is not None:
            leading = leading @ _orthogonal_to(trivial @ leading[:size])
        found = leading.shape[1]
        leading, unclear = _judged(leading, terms, motion, tolerance)
        refused = found - leading.shape[1]
        if spaces:
            found = leading.shape[1]
            leading = _within(leading, spaces[-1].leading[:size], size)
            refused += found - leading.shape[1]
        spaces.append(
            SeriesSpace(leading, shifts, space.singular_values, space.gap, refused, unclear)
        )
    return spaces


def _judged(leading, terms, motion, tolerance) -> tuple[np.ndarray, int]:
    """The combinations of series that change in a step by no more than rounding, each measured by
    what its own slopes predict, sample by sample; and how many are unclear."""
    count, size = leading.shape[1], terms.shape[2]
    if count == 0:
        return leading, 0
    own = motion.of(leading[:size])
    # The coefficients too are known to some digits only, each to those of the largest one.
    digits = _COEFFICIENTS * np.linalg.norm(terms, axis=(1, 2))[:, None]
    own = own._replace(rounding=own.rounding + digits).at_most(1.0)
    weights = own.weights() / np.sqrt(len(terms))
    changes = weights[:, None, None] * series_changes(terms, leading)
    predicted = (weights[:, None, None] * own.changes).reshape(-1, count)
    slopes, V = singular_vectors(predicted)
    limit = HELD_OUT * (NULL if tolerance is None else tolerance)
    # Where slopes predict little more than rounding, that is what a change is compared with.
    by_slopes = V.T / np.maximum(slopes, HELD_OUT * ROUNDING / limit)
    left, U = singular_vectors(changes.reshape(-1, count) @ by_slopes)
    kept = leading @ by_slopes @ U[left <= limit].T
    unclear = int(np.sum((left > limit) & (left < UNCLEAR)))
    return kept @ np.linalg.inv(triangle(kept[:size])) if kept.size else kept, unclear


def relative_changes(terms, series: np.ndarray, motion: Motion, spread: float) -> np.ndarray:
    """What one series changes by at each order, by the measure of `_judged`: shape (S, z + 1).

    `terms`: (S, z + 1, size); `series`: (z + 1, size); `spread`: of its leading part.
    """
    own = motion.of(series[:1].T).at_most(spread)
    return own.weights()[:, None] * np.abs(series_changes(terms, series.reshape(-1, 1))[..., 0])


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
