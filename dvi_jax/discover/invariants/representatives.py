"""The series that represents an invariant: independent leading-order terms and corrections."""

from typing import NamedTuple

import numpy as np

from ..algebra.echelon import reduced, reduction
from ..algebra.motion import Motion
from ..algebra.nullspace import SeriesSpace, orthonormal_range, singular_vectors
from ..algebra.weighing import Weighed
from ..functions.basis import BoundBasis
from ..functions.sampling import Samples, spreads
from .search import NullSpaces


class Span(NamedTuple):
    """All invariants found, as series in a basis that is orthonormal on the samples.

    Coefficients are compared as shares: those of functions scaled to one size on the samples, see
    `Weighed.shares`. `space`: what was found at the highest order. `blur`: size below which shares
    count as none. `constant`: the shares of a constant, None without one.
    """

    basis: BoundBasis
    weighed: Weighed[Motion]
    space: SeriesSpace
    blur: float
    constant: np.ndarray | None

    @classmethod
    def of(cls, null: NullSpaces, blur: float) -> "Span":
        """From what was found."""
        return cls(null.basis, null.weighed, null.spaces[-1], blur, null.constant)

    @property
    def size(self) -> int:
        return self.basis.size

    @property
    def orders(self) -> int:
        return self.space.leading.shape[0] // self.size

    def representatives(
        self, samples: Samples, slopes: np.ndarray
    ) -> list[tuple[np.ndarray, bool]]:
        """One series, shape (order + 1, size), for each leading-order term, the simplest first; and
        whether it is independent of those before it: its differential is, at generic points,
        outside the span of theirs.

        `slopes`: ∂φ/∂(q, p) of the functions at the samples, shape (S, size, 2n).
        """
        found: list[tuple[np.ndarray, bool]] = []
        if self.space.leading.shape[1] == 0:
            return found
        some = slice(None, None, max(1, len(samples.q) // 40))
        # in units of the spread of (q, p), so that their own units do not matter
        gradients = slopes[some] * spreads(samples) / self.weighed.rms[:, None]
        complexity = np.array(self.basis.complexity)
        taken: list[np.ndarray] = []
        done = np.zeros((self.size, 0))
        shares = self.weighed.shares(self.space.leading)
        for level in sorted(set(self.basis.complexity)):
            candidates = self._up_to(level, shares)
            for vector in reduced(candidates, complexity, self.blur).T:
                leading = vector[: self.size]
                rest = leading - done @ (done.T @ leading)
                if np.linalg.norm(rest) <= self.blur * np.linalg.norm(leading):
                    continue  # in the span of those before
                done = orthonormal_range(np.column_stack([done, rest / np.linalg.norm(rest)]))
                d = np.einsum("sbn,b->sn", gradients, leading)
                length = np.linalg.norm(d)
                if length < self.blur * np.linalg.norm(self.weighed.R @ leading):
                    continue  # a constant
                grown = self._rank_of([*taken, d / length]) == len(taken) + 1
                if grown:
                    taken.append(d / length)
                series = self._without_constants(vector.reshape(self.orders, self.size))
                found.append((series, grown))
        return found

    def _up_to(self, level: int, shares: np.ndarray) -> np.ndarray:
        """Those whose leading-order term uses no function above this complexity."""
        leading = shares[: self.size]
        above = leading[np.array(self.basis.complexity) > level]
        singular, V = singular_vectors(above / max(np.linalg.norm(leading, 2), 1e-300))
        return shares @ V[singular < self.blur].T

    def _rank_of(self, differentials: list[np.ndarray]) -> int:
        """The rank of differentials, (points, 2n) each, that most points agree on."""
        stack = np.stack(differentials, axis=1)
        rows = stack / np.maximum(np.linalg.norm(stack, axis=-1, keepdims=True), 1e-300)
        singular = np.linalg.svd(rows, compute_uv=False)
        return int(np.median(np.sum(singular > max(self.blur, 1e-5), axis=-1)))

    def simplest(self, series: np.ndarray) -> np.ndarray:
        """The corrections that use complex functions as little as can be."""
        complexity = np.tile(self.basis.complexity, self.orders)
        simplify = reduction(
            self.weighed.shares(self.space.shifts), complexity, self.size, self.blur
        )
        return simplify(series.reshape(-1)).reshape(series.shape)

    def least(self, series: np.ndarray) -> np.ndarray:
        """The corrections that are smallest on the samples: orthogonal to what may be added."""
        columns = (self.weighed.R @ series[..., None])[..., 0].reshape(-1)
        basis = orthonormal_range(self.space.shifts)
        columns = columns - basis @ (basis.T @ columns)
        return self._without_constants(self.weighed.shares(columns[:, None]).reshape(series.shape))

    def _without_constants(self, series: np.ndarray) -> np.ndarray:
        """The series less the multiple of the constant at each order that makes it simplest."""
        if self.constant is None:
            return series
        j = np.argmax(np.abs(self.constant))
        return series - np.outer(series[:, j] / self.constant[j], self.constant)
