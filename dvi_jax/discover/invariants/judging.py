"""How well invariants are conserved: sample by sample, by size, and in how few functions."""

from typing import NamedTuple

import numpy as np

from ..algebra.motion import Motion, relative_changes
from ..algebra.nullspace import RANK, null_space, triangle
from .changes import Changes

CLEARLY = 1e-9  # Changes of an invariant, by the measure of `Motion`, for nearly all samples
_DIFFERENCE = 1e-3  # Two functions that differ by this share are one, with and without errors
_ROUND_OFF = 1e-13  # Shares below this of the largest are not there


class Judge(NamedTuple):
    """Changes of the functions at some samples in units of ε · `scale`, their weights, (S,), and
    `coefficient_errors` of functions of size one, (S,); whether the search has a tolerance."""

    changes: Changes
    calm: np.ndarray
    scale: float = 1.0
    digits: np.ndarray | float = 0.0
    approximately: bool = False

    def quantiles(self, coefficients: np.ndarray, share: float, sizes=None) -> np.ndarray:
        """The change that the given share of the samples stays below, shape (count, z + 1);
        `sizes`: of the leading-order terms on the samples that were fitted, if these are others."""
        out = np.zeros(coefficients.shape[:2])
        sizes = self.sizes(coefficients) if sizes is None else sizes
        for i, c in enumerate(coefficients):
            series = c / self.scale ** np.arange(len(c))[:, None]
            terms, motion, spread = self.changes.terms, self.changes.motion, self._spread(c[0])
            digits = sizes[i] * self.digits
            changes = relative_changes(terms, series, motion, spread, digits, self.approximately)
            out[i] = np.quantile(changes, share, axis=0)
        return out

    def sizes(self, coefficients: np.ndarray) -> np.ndarray:
        """Root mean squares of the leading-order terms, shape (count,)."""
        return np.sqrt(self._squares @ (self.changes.values @ coefficients[:, 0].T) ** 2)

    @property
    def _squares(self) -> np.ndarray:
        return self.calm**2 / np.sum(self.calm**2)

    def _spread(self, leading: np.ndarray) -> float:
        calm, values = self._squares, self.changes.values @ leading
        spread = np.sqrt(calm @ (values - calm @ values) ** 2)
        size = self.sizes(leading[None, None])[0]
        return float(max(spread, 1e-6 * size, np.finfo(float).tiny))

    def own_rows(self, leading: np.ndarray) -> np.ndarray:
        """What functions change by at order 0, weighted by what the slopes of one of their
        combinations predict, shape (S, size)."""
        motion = self.changes.motion.in_functions(leading[:, None]).at_most(self._spread(leading))
        return motion.weights()[:, None] * self.changes.terms[:, 0]

    def largest(self, coefficients: np.ndarray) -> np.ndarray:
        """The change of nearly all samples, the largest of all orders, shape (count,)."""
        return np.max(self.quantiles(coefficients, 0.95), axis=1, initial=0.0)


class Fewest:
    """Invariants of order 0 found again, to more digits, in the functions up to the lowest
    complexity that represent them: coefficients of all others are only errors."""

    def __init__(self, rms: np.ndarray, changes: Changes, values: np.ndarray):
        self.complexity = np.array(changes.step_map.basis.complexity)
        self.rms, self.values = rms, values
        self.changes, self.motion = changes.terms[:, 0], changes.motion
        self.levels: dict[int, tuple[np.ndarray, np.ndarray] | None] = {}

    def up_to(self, level: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Invariants in the functions up to a complexity: columns of coefficients, and values."""
        is_simple = self.complexity <= level
        R = triangle(self.values[:, is_simple] / self.rms[is_simple]) / np.sqrt(len(self.values))
        if len(R) < np.sum(is_simple) or np.linalg.cond(R) > 1 / RANK**2:
            return None
        orthonormal = np.linalg.inv(R) / self.rms[is_simple][:, None]
        motion = Motion(self.motion.changes[..., is_simple], self.motion.rounding[:, is_simple])
        rows = self.changes[:, is_simple] @ orthonormal
        rows = motion.in_functions(orthonormal).weights()[:, None] * rows / np.sqrt(len(rows))
        columns = orthonormal @ null_space(rows, unit=1.0).columns
        return columns, self.values[:, is_simple] @ columns

    def represent(self, shares: np.ndarray) -> np.ndarray:
        """The shares of an invariant, in as few functions as can be."""
        target = self.values @ (shares / self.rms)
        for level in sorted(set(self.complexity)):
            if level not in self.levels:
                self.levels[level] = self.up_to(level)
            invariants = self.levels[level]
            if invariants is None or invariants[0].shape[1] == 0:
                continue
            columns, values = invariants
            combination = np.linalg.lstsq(values, target)[0]
            distance = np.linalg.norm(values @ combination - target)
            if distance <= _DIFFERENCE * np.linalg.norm(target):
                out, is_simple = np.zeros(len(shares)), self.complexity <= level
                out[is_simple] = (columns @ combination) * self.rms[is_simple]
                return clean(out)
        return shares


def clean(shares: np.ndarray, blur: float = RANK) -> np.ndarray:
    """The shares without what is round-off of the others."""
    threshold = _ROUND_OFF if blur <= RANK else blur
    return np.where(np.abs(shares) > threshold * np.max(np.abs(shares)), shares, 0.0)


def reach(coefficients: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The smallest ε with a correction as large as the leading-order term, shape (count,)."""
    out = np.full(len(coefficients), np.inf)
    for i, c in enumerate(coefficients):
        sizes = np.sqrt(np.mean((values @ c.T) ** 2, axis=0))
        for m in range(1, len(c)):
            if sizes[m] > 0:
                out[i] = min(out[i], (sizes[0] / sizes[m]) ** (1 / m))
    return out
