"""The series that represents an invariant: independent leading-order terms and corrections."""

from typing import NamedTuple

import numpy as np

from ..algebra.echelon import reduced_echelon, reduction
from ..algebra.motion import Motion
from ..algebra.nullspace import SeriesSpace, orthonormal_range, singular_vectors
from ..algebra.weighing import WeightedConditions
from ..functions.sampling import spreads
from .search import NullSpaces


class Span(NamedTuple):
    """All invariants found, as series in a basis that is orthonormal on the samples.

    Coefficients are compared as shares: those of functions scaled to one size on the samples, see
    `WeightedConditions.shares`. `blur`: size below which shares count as zero.
    """

    null: NullSpaces
    blur: float

    @property
    def conditions(self) -> WeightedConditions[Motion]:
        return self.null.conditions

    @property
    def space(self) -> SeriesSpace:
        """That of the highest order."""
        return self.null.spaces[-1]

    @property
    def size(self) -> int:
        return self.null.basis.size

    def representatives(self) -> list[tuple[np.ndarray, bool]]:
        """One series, shape (order + 1, size), for each leading-order term, the simplest first; and
        whether it is independent of those before it: its differential is, at generic points,
        outside the span of theirs."""
        if self.space.leading.shape[1] == 0:
            return []
        changes, representatives = self.null.of_fit, []
        slopes = changes.slopes[:: max(1, len(changes.good) // 40), :, :-1]
        # in units of the spread of (q, p), so that their own units do not matter
        gradients = slopes * spreads(changes.samples) / self.conditions.rms[:, None]
        complexity, span = np.array(self.null.basis.complexity), np.zeros((self.size, 0))
        differentials, shares = [], self.conditions.shares(self.space.leading)
        for level in sorted(set(self.null.basis.complexity)):
            candidates = self._up_to(level, shares)
            for vector in reduced_echelon(candidates, complexity, self.blur).T:
                leading = vector[: self.size]
                remainder = leading - span @ (span.T @ leading)
                distance = np.linalg.norm(remainder)
                if distance <= self.blur * np.linalg.norm(leading):
                    continue  # in the span of those before
                span = orthonormal_range(np.column_stack([span, remainder / distance]))
                d = np.einsum("sbn,b->sn", gradients, leading)
                length = np.linalg.norm(d)
                if length < self.blur * np.linalg.norm(self.conditions.R @ leading):
                    continue  # a constant
                rank = self._rank_of([*differentials, d / length])
                is_independent = rank == len(differentials) + 1
                if is_independent:
                    differentials.append(d / length)
                series = self._without_constants(vector.reshape(self.null.order + 1, self.size))
                representatives.append((series, is_independent))
        return representatives

    def _up_to(self, level: int, shares: np.ndarray) -> np.ndarray:
        """Those whose leading-order term uses no function above this complexity."""
        leading = shares[: self.size]
        complex_part = leading[np.array(self.null.basis.complexity) > level]
        singular, V = singular_vectors(complex_part / max(np.linalg.norm(leading, 2), 1e-300))
        return shares @ V[singular < self.blur].T

    def _rank_of(self, differentials: list[np.ndarray]) -> int:
        """The rank of differentials, (points, 2n) each, that most points agree on."""
        stack = np.stack(differentials, axis=1)
        rows = stack / np.maximum(np.linalg.norm(stack, axis=-1, keepdims=True), 1e-300)
        singular = np.linalg.svd(rows, compute_uv=False)
        return int(np.median(np.sum(singular > max(self.blur, 1e-5), axis=-1)))

    def simplest(self, series: np.ndarray) -> np.ndarray:
        """The corrections that use complex functions as little as can be."""
        complexity = np.tile(self.null.basis.complexity, self.null.order + 1)
        shifts = self.conditions.shares(self.space.shifts)
        simplify = reduction(shifts, complexity, self.size, self.blur)
        return simplify(series.reshape(-1)).reshape(series.shape)

    def smallest(self, series: np.ndarray) -> np.ndarray:
        """The corrections that are smallest on the samples: orthogonal to what may be added."""
        columns = (self.conditions.R @ series[..., None])[..., 0].reshape(-1)
        basis = orthonormal_range(self.space.shifts)
        columns = (columns - basis @ (basis.T @ columns))[:, None]
        return self._without_constants(self.conditions.shares(columns).reshape(series.shape))

    def _without_constants(self, series: np.ndarray) -> np.ndarray:
        """The series less the multiple of the constant at each order that makes it simplest."""
        if self.null.constant is None:
            return series
        j = np.argmax(np.abs(self.null.constant))
        return series - np.outer(series[:, j] / self.null.constant[j], self.null.constant)
