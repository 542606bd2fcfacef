"""Series that satisfy linear conditions Σ_{m≤k} A_{k−m} c_m = r_k, one order k after the other.

The matrix is block-Toeplitz and lower triangular, so that one singular value decomposition of A_0
serves all orders: its range is what c_k can correct. The matrix of all orders together has (z + 1)
times as many rows and columns, and singular values that decrease as a power of those of A_0.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# How many singular values, descending and in units of a given one, are not zero.
Cut = Callable[[np.ndarray], int]


def larger_than(share: float) -> Cut:
    """Those above a share of the unit."""
    return lambda relative: int(np.sum(relative > share))


class TruncatedSVD(NamedTuple):
    """M = left · diag(singular) · right up to singular values that count as zero; `null`:
    orthonormal columns that M takes to zero. `spectrum`: singular values, one for each column."""

    left: np.ndarray
    singular: np.ndarray
    right: np.ndarray
    null: np.ndarray
    spectrum: np.ndarray

    @classmethod
    def factor(cls, matrix: np.ndarray, cut: Cut, unit: float | None = None) -> "TruncatedSVD":
        """`unit`: of the singular values; the largest of them if left out."""
        rows, columns = matrix.shape
        if matrix.size == 0:
            empty = np.zeros((rows, 0)), np.zeros(0), np.zeros((0, columns))
            return cls(*empty, np.eye(columns), np.zeros(columns))
        U, singular, V = np.linalg.svd(matrix, full_matrices=rows < columns)
        spectrum = np.append(singular, np.zeros(columns - len(singular)))
        unit = max(spectrum[0] if unit is None else unit, np.finfo(float).tiny)
        rank = min(cut(spectrum / unit), len(singular))
        return cls(U[:, :rank], singular[:rank], V[:rank], V[rank:].T, spectrum)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """The part of columns that is orthogonal to the range."""
        x = x - self.left @ (self.left.T @ x)
        return x - self.left @ (self.left.T @ x)  # once more, for the rounding of the first time

    def solve(self, x: np.ndarray) -> np.ndarray:
        """The smallest y with M y = x, up to what is outside of the range."""
        return self.right.T @ ((self.left.T @ x) / self.singular[:, None])


class Secular(NamedTuple):
    """The conditions that remain of the orders up to k, once c_m has corrected what it can at each
    order m: on coefficients a of the series that begin with a null vector of A_0 at order 0, which
    are the `first`, and later. `later`: the split of the conditions on those that begin later;
    `initial`: of those on the first, outside of the range of the others."""

    conditions: np.ndarray
    first: int
    later: TruncatedSVD
    initial: TruncatedSVD

    @classmethod
    def factor(cls, conditions: np.ndarray, first: int, cut: Cut, unit: float) -> "Secular":
        later = TruncatedSVD.factor(conditions[:, first:], cut, unit)
        initial = TruncatedSVD.factor(later.residual(conditions[:, :first]), cut, unit)
        return cls(conditions, first, later, initial)

    def solve(self, right: np.ndarray, leading: bool = True) -> np.ndarray:
        """a by least squares; without `leading` by the series that begin later alone."""
        a = self.initial.solve(self.later.residual(right))
        a = a if leading else np.zeros_like(a)
        return np.concatenate([a, self.later.solve(right - self.conditions[:, : self.first] @ a)])

    def null(self) -> tuple[np.ndarray, np.ndarray]:
        """a without a secular term, as columns: with an orthonormal first part, and without one."""
        a, shifts = self.initial.null, self.later.null
        later = -self.later.solve(self.conditions[:, : self.first] @ a)
        return np.vstack([a, later]), np.vstack([np.zeros((self.first, shifts.shape[1])), shifts])


class BlockTriangular:
    """The conditions of all orders.

    - `terms`: A_0 … A_z, shape (rows, z + 1, size). `cut`: see `Cut`.
    - `free`: the coefficients that may differ from zero, shape (z + 1, size); all if left out.
    - `unit`: of singular values; the largest of A_0 if left out.
    """

    def __init__(self, terms: np.ndarray, cut: Cut, free: np.ndarray | None = None, unit=None):
        orders, size = terms.shape[1:]
        self.blocks = np.ascontiguousarray(np.moveaxis(terms, 1, 0))
        self.free = np.ones((orders, size), bool) if free is None else free
        self.steps: list[TruncatedSVD] = []
        self.orders: list[Secular] = []
        self.series = np.zeros((0, size, 0))
        conditions, splits = np.zeros((0, 0)), {}
        for k, columns in enumerate(self.free):
            key = columns.tobytes()
            if key not in splits:
                splits[key] = TruncatedSVD.factor(self.blocks[0][:, columns], cut, unit)
            step = splits[key]
            unit = float(step.spectrum.max(initial=0.0)) if unit is None else unit
            defects = self.defects(self.series)
            conditions = np.vstack([conditions, step.residual(defects)])
            # At each order there begins a series with each null vector of A_0.
            corrections = np.hstack([-step.solve(defects), step.null])
            self.series = np.pad(self.series, np.array([(0, 1), (0, 0), (0, step.null.shape[1])]))
            self.series[k, columns] = corrections
            conditions = np.pad(conditions, np.array([(0, 0), (0, step.null.shape[1])]))
            self.steps.append(step)
            self.orders.append(Secular.factor(conditions, self.steps[0].null.shape[1], cut, unit))

    def defects(self, series: np.ndarray) -> np.ndarray:
        """A_k c_0 + … + A_1 c_{k−1} of series of the orders below k, shape (k, size, count)."""
        total = np.zeros((self.blocks.shape[1], series.shape[2]))
        for m, c in enumerate(series):
            total += self.blocks[len(series) - m] @ c
        return total

    def left_sides(self, series: np.ndarray) -> np.ndarray:
        """A_k c_0 + … + A_0 c_k for each order of series, shape (orders, rows, count)."""
        sums = [self.defects(series[:k]) + self.blocks[0] @ c for k, c in enumerate(series)]
        return np.stack(sums)

    def solve(self, right: np.ndarray, leading: bool = True) -> np.ndarray:
        """A solution c, shape (orders, size, count), of the conditions of the first orders, with r
        of shape (orders, rows, count); without `leading` one with c_0 = 0."""
        solution, secular = np.zeros((0, self.blocks.shape[2], right.shape[2])), []
        for step, columns, r in zip(self.steps, self.free, right, strict=False):
            target = r - self.defects(solution)
            secular.append(step.residual(target))
            solution = np.pad(solution, np.array([(0, 1), (0, 0), (0, 0)]))
            solution[-1, columns] = step.solve(target)
        a = self.orders[len(right) - 1].solve(np.concatenate(secular), leading)
        return solution + self.series[: len(right), :, : len(a)] @ a

    def null(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Series that satisfy the conditions up to order k, shape (k + 1, size, count): those with
        orthonormal c_0, and those with c_0 = 0."""
        spaces = []
        for a, leading in zip(self.orders[k].null(), (True, False), strict=True):
            c = self.series[: k + 1, :, : len(a)] @ a
            # Without a correction, rounding grows with each order.
            spaces.append(c - self.solve(self.left_sides(c), leading) if k else c)
        return spaces[0], spaces[1]
