"""Whether functions and vector fields change in a step by more than rounding, sample by sample."""

from typing import Any, NamedTuple

import numpy as np

from .nullspace import HELD_OUT, NULL, series_changes, singular_vectors, triangle

# A null vector that changes by less than this share of what its slopes predict, but by more than
# rounding, may be an invariant or not.
UNCLEAR = 1e-6
ROUNDING = 1e-12  # Rows are weighted so that their rounding is below this; `NULL` is above it
_SHARE = 1e-3  # Rounding may be this share of a change that counts as not zero
_COEFFICIENTS = 1e-15  # Errors of the coefficients of a null vector, relative to its length


def times(x: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """x @ matrix as one product: NumPy would make a small one for each sample."""
    return (x.reshape(-1, x.shape[-1]) @ matrix).reshape(*x.shape[:-1], matrix.shape[1])


class Motion(NamedTuple):
    """How much functions change in the step of each sample, by their slopes, and by rounding.

    - `changes`: ∂φ_b/∂z_i Δz_i of each function and coordinate z = (q, p, t), shape (S, 2n + 1,
      size).
    - `rounding`: the largest rounding error of each function's change, shape (S, size).
    """

    changes: np.ndarray
    rounding: np.ndarray

    def subset(self, index: Any) -> "Motion":
        return Motion(*(field[index] for field in self))

    def in_functions(self, combinations: np.ndarray) -> "Motion":
        """Of combinations of the functions, columns of shape (size, count)."""
        return Motion(times(self.changes, combinations), self.rounding @ np.abs(combinations))

    candidates = in_functions

    def with_perturbation(self, terms: np.ndarray, combinations: np.ndarray) -> "Motion":
        """The same, and what the perturbation changes the combinations by, order by order: the
        size that an approximate correction is compared with. Slopes alone predict no change of a
        momentum that the unperturbed step conserves exactly, and no correction would be accepted.

        `terms`: A_0 … A_z of the functions, shape (S, z + 1, …, size).
        """
        perturbations = times(terms[:, 1:], combinations)
        perturbations = perturbations.reshape(len(terms), -1, combinations.shape[1])
        return self._replace(changes=np.concatenate([self.changes, perturbations], axis=1))

    def at_most(self, spread: float) -> "Motion":
        """The same, with no larger changes than the functions differ by between samples: a step
        that expands goes beyond the range where slopes predict anything."""
        size = np.sqrt(np.sum(self.changes**2, axis=(1, 2), keepdims=True))
        return self._replace(changes=self.changes / np.maximum(size / spread, 1))

    def weights(self) -> np.ndarray:
        """For rows of changes, shape (S,): what functions typically change by becomes 1, where
        that is far enough above rounding, so that no sample with a large step decides alone."""
        typical = np.sqrt(np.sum(self.changes**2, axis=(1, 2)))
        rounding = np.sqrt(np.sum(self.rounding**2, axis=1))
        return 1 / np.maximum(np.maximum(typical, rounding / ROUNDING), np.finfo(float).tiny)

    def unclear_count(self) -> int:
        """How many combinations change in the steps by hardly more than rounding."""
        thinning = _thinning(len(self.changes), *self.changes.shape[1:])
        rows = (self.weights()[:, None, None] * self.changes)[thinning]
        slopes = np.linalg.svd(triangle(rows.reshape(-1, rows.shape[2])), compute_uv=False)
        zeros = rows.shape[2] - len(slopes)
        return zeros + int(np.sum(slopes / np.sqrt(len(rows)) < ROUNDING / _SHARE))


class FieldMotion(NamedTuple):
    r"""The same for vector fields X = Σ c_kb φ_b e_k, which the equations F = 0 of a step compare
    at its two points z0 and z1.

    With J_j = ∂F/∂z_j the condition J_1 X(z1) + J_0 X(z0) = 0 is

        J_1 (X(z1) − X(z0)) + (J_0 + J_1) X(z0) = 0,

    and its typical residual for a field with these slopes is the size of the two terms before they
    cancel, with ∂X/∂z_i Δz_i for the difference.

    - `values`: φ at z0, (S, B). `changes`: ∂φ/∂z_i Δz_i, (S, 2n + 1, B).
    - `second`, `total`: lengths of the columns of J_1 and of J_0 + J_1, (S, C).
    - `rounding`: the largest rounding error of the left side for each φ_b e_k, (S, C, B).
    """

    values: np.ndarray
    changes: np.ndarray
    second: np.ndarray
    total: np.ndarray
    rounding: np.ndarray

    def subset(self, index: Any) -> "FieldMotion":
        return FieldMotion(*(field[index] for field in self))

    def in_functions(self, combinations: np.ndarray) -> "FieldMotion":
        """For combinations of the functions φ, columns of shape (B, count)."""
        return self._replace(
            values=self.values @ combinations,
            changes=times(self.changes, combinations),
            rounding=self.rounding @ np.abs(combinations),
        )

    def candidates(self, fields: np.ndarray) -> Motion:
        """Of fields, columns of shape (C · B, count)."""
        X = fields.reshape(self.second.shape[1], self.values.shape[1], -1)
        changes = np.einsum("sdb,cbk->scdk", self.changes, X) * self.second[:, :, None, None]
        total = np.einsum("sb,cbk->sck", self.values, X) * self.total[..., None]
        changes = np.concatenate([changes, total[:, :, None]], axis=2)
        rounding = np.einsum("scb,cbk->sk", self.rounding, np.abs(X))
        return Motion(changes.reshape(len(changes), -1, fields.shape[1]), rounding)

    def divide_by(self, sizes: np.ndarray) -> "FieldMotion":
        """With the equations of each sample divided by a number, shape (S,)."""
        return self._replace(
            second=self.second / sizes[:, None],
            total=self.total / sizes[:, None],
            rounding=self.rounding / sizes[:, None, None],
        )

    def typical(self) -> np.ndarray:
        """The typical residual of all fields together, shape (S,)."""
        changes, values, second, total = (
            np.sum(x.reshape(len(x), -1) ** 2, axis=1)
            for x in (self.changes, self.values, self.second, self.total)
        )
        return np.sqrt(second * changes + total * values)

    def weights(self) -> np.ndarray:
        """For rows of conditions, shape (S,): see `Motion.weights`."""
        rounding = np.sqrt(np.sum(self.rounding**2, axis=(1, 2)))
        largest = np.maximum(self.typical(), rounding / ROUNDING)
        return 1 / np.maximum(largest, np.finfo(float).tiny)

    def unclear_count(self) -> int:
        """How many fields change in the steps by hardly more than rounding."""
        size = self.rounding[0].size
        rows = self.second.shape[1] * (self.changes.shape[1] + 1)
        motion = self.subset(_thinning(len(self.second), rows, size))
        return motion.candidates(np.eye(size)).unclear_count()


def _thinning(samples: int, rows: int, size: int) -> slice:
    """Samples, each with so many rows, that have about eight rows for each of `size` columns."""
    return slice(None, None, max(1, samples * rows // (8 * size)))


def coefficient_errors(terms: np.ndarray) -> np.ndarray:
    """What equal errors of a series of length one change at each sample; `terms`: (S, z + 1, …)."""
    return _COEFFICIENTS * np.linalg.norm(terms.reshape(len(terms), -1), axis=1)


def conserved_series(
    leading: np.ndarray, terms: np.ndarray, motion: Motion | FieldMotion, tolerance: Any = None
) -> tuple[np.ndarray, int]:
    """The combinations of series that change in a step by no more than rounding, each measured by
    what its own slopes predict, sample by sample; and how many are unclear.

    - `leading`: series as columns, shape ((m + 1) · size, count), leading-order terms
      orthonormal.
    - `terms`: A_0 … A_z at all samples, shape (S, z + 1, size), for fields (S, z + 1, rows, size).
    """
    count, size = leading.shape[1], terms.shape[-1]
    if count == 0:
        return leading, 0
    candidates = motion.candidates(leading[:size])
    digits = coefficient_errors(terms)[:, None]
    if tolerance is not None:
        candidates = candidates.with_perturbation(terms, leading[:size])
    candidates = candidates._replace(rounding=candidates.rounding + digits).at_most(1.0)
    weights = candidates.weights() / np.sqrt(len(terms))
    changes = series_changes(terms, leading).reshape(len(terms), -1, count)
    changes, predictions = (weights[:, None, None] * x for x in (changes, candidates.changes))
    predictions = predictions.reshape(-1, count)
    slopes, V = singular_vectors(predictions)
    limit = HELD_OUT * (NULL if tolerance is None else tolerance)
    # Where slopes predict little more than rounding, that is what a change is compared with.
    by_slopes = V.T / np.maximum(slopes, HELD_OUT * ROUNDING / limit)
    left, U = singular_vectors(changes.reshape(-1, count) @ by_slopes)
    series = leading @ by_slopes @ U[left <= limit].T
    unclear = int(np.sum((left > limit) & (left < UNCLEAR)))
    return series @ np.linalg.inv(triangle(series[:size])) if series.size else series, unclear


def relative_changes(
    terms: np.ndarray, series, motion: Motion | FieldMotion, spread, digits, approximately=False
) -> np.ndarray:
    """The change of one series, shape (z + 1, size), at each order, by the measure of
    `conserved_series`: shape (S, z + 1). `spread`: of its leading-order term; `digits`: see
    `coefficient_errors`; `approximately`: see `Motion.with_perturbation`."""
    candidate = motion.candidates(series[:1].T)
    if approximately:
        candidate = candidate.with_perturbation(terms, series[:1].T)
    rounding = candidate.rounding + np.reshape(digits, (-1, 1))
    candidate = candidate._replace(rounding=rounding).at_most(spread)
    changes = series_changes(terms, series.reshape(-1, 1))[..., 0]
    changes = np.linalg.norm(changes.reshape(*changes.shape[:2], -1), axis=2)
    return candidate.weights()[:, None] * changes
