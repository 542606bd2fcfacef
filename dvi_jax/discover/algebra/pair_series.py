"""Null spaces of series order by order, with 30 digits, where float64 is not enough.

The conditions Σ_{m≤k} B_{k−m} c_m = 0, k = 0 … z, are a block-Toeplitz system. Series that satisfy
those up to order k − 1 have a correction c_k that makes the left side of order k orthogonal to the
range of B_0; the rest of it is a secular term. A series that was lost at an order m < k, multiplied
by ε^(k−m), has its own secular term at order k and may cancel that of another one. The combinations
of series that have no secular term then survive order k.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...engine.pair_matrices import Left, exact, plus, zeros
from ...engine.pairs import Pair, div, power
from ...integration.arithmetic import Arithmetic, DoubleDouble, FloatingPoint
from .nullspace import HELD_OUT, SeriesSpace, intersection, remove, singular_vectors, triangle

ROUNDING = 2.0**-104  # Relative rounding of pairs
# A singular value counts as zero below so many times the rounding that was seen at lower orders,
# and is undecided below so many.
_ZERO, _NONZERO = 1e2, 1e6
_SHARE = 1e-7  # Singular values above this share of the largest are factors of float64
_SWEEPS = 6  # Corrections by factors of float64; each is about 1e-9 times the one before or less


def uses_pairs(arithmetic: Arithmetic, tolerance: float | None) -> bool:
    """Whether a search computes the null space in pairs. **Raises** `ValueError` for other
    arithmetics, and for a tolerance."""
    in_pairs = isinstance(arithmetic, DoubleDouble)
    if not (in_pairs or isinstance(arithmetic, FloatingPoint)):
        raise ValueError(
            "arithmetic of discover_invariants must be dvi.FloatingPoint() or dvi.DoubleDouble(), "
            f"got {arithmetic!r}."
        )
    if in_pairs and tolerance is not None:
        raise ValueError(
            f"tolerance={tolerance!r} is for approximate invariants, dvi.DoubleDouble() for those "
            "conserved to 30 digits: give one of the two."
        )
    return in_pairs


class _Factors(NamedTuple):
    """U Σ V of M N, for columns N, without small singular values."""

    basis: Left
    image: Left
    adjoint: Left
    singular: np.ndarray
    right: np.ndarray

    def correction(self, x: Pair) -> np.ndarray:
        """−(M N)⁺ x, in float64."""
        return -self.right.T @ ((self.adjoint @ x).hi / self.singular[:, None])


class _StagedSVD:
    """The null space of a matrix of pairs, and solutions of linear systems with it.

    Factors of float64 resolve singular values down to `_SHARE` of the largest. The matrix on what
    remains has smaller elements, all digits of which are known, and is factored again.
    """

    def __init__(self, matrix: Pair, noise: float):
        self.stages: list[_Factors] = []
        self.null, nonzero = exact(np.eye(matrix.hi.shape[1])), [np.zeros(0)]
        while True:
            rows, columns = matrix.hi.shape
            U, singular, V = np.linalg.svd(matrix.hi, full_matrices=rows < columns)
            largest = singular.max(initial=0.0)
            if largest <= _ZERO * noise:
                break
            count = int(np.sum(singular > max(_SHARE * largest, _ZERO * noise)))
            remainder = exact(V[count:].T)
            factors = Left(U[:, :count].T), singular[:count], V[:count]
            stage = _Factors(Left(self.null), Left(matrix), *factors)
            self.stages.append(stage)
            nonzero.append(singular[:count])
            remainder, matrix = _correct([stage], remainder, stage.image @ remainder, inner=True)
            self.null = stage.basis @ remainder
        self.zeros = singular
        self.nonzero = np.concatenate(nonzero)

    def solve(self, x: Pair) -> tuple[Pair, Pair]:
        """c, for which M c + x is orthogonal to the range of M, and M c + x."""
        return _correct(self.stages, zeros(len(self.null.hi), x.hi.shape[1]), x)


def _correct(stages: Sequence[_Factors], c: Pair, left: Pair, inner=False) -> tuple[Pair, Pair]:
    """c and the left side without the part of it in the range of the stages; `inner`: c in terms of
    the columns of the stage."""
    first = last = None
    for _ in range(_SWEEPS if stages else 0):
        largest = np.zeros(c.hi.shape[1])
        for stage in stages:
            y = stage.correction(left)
            c = plus(c, y if inner else _lowest(stage.basis @ y, len(c.hi)))
            left = plus(left, stage.image @ y)
            largest = np.maximum(largest, np.max(np.abs(y), axis=0, initial=0.0))
        first = largest if first is None else first
        # The next correction would be largest²/last.
        if last is not None and (largest * largest <= ROUNDING * first * last).all():
            break
        last = largest
    return c, left


class Step(NamedTuple):
    """The conditions of one order k.

    - `series`: c_0 … c_k one below the other, shape ((k + 1) · size, count), with orthonormal c_0
      and the smallest corrections. `shifts`: orthonormal series that may be added to any of them,
      those of the orders below, later in ε.
    - `nonzero`, `zeros`: singular values that are not zero, and those that are.
    - `noise`: the largest zero up to this order. `unclear`: how many `nonzero` are hardly larger.
    """

    series: Pair
    shifts: Pair
    nonzero: np.ndarray
    zeros: np.ndarray
    noise: float
    unclear: int


def staircase(blocks: Sequence[Pair], basis: np.ndarray, noise: float) -> list[Step]:
    """The null spaces of all orders.

    - `blocks`: B_0 … B_z, (rows, size). `basis`: columns, (size, size), taken as exact: the series
      are those of B_m · `basis`. `noise`: rounding of the elements of B_0 · `basis`.
    """
    size, columns, lefts = len(basis), Left(basis), [Left(b) for b in blocks]
    first = split = _StagedSVD(lefts[0] @ basis, noise)
    c, shifts = split.null, zeros(size, 0)
    stages: list[_Factors] = []
    steps: list[Step] = []
    for k in range(len(blocks)):
        if k:
            x = zeros(len(blocks[0].hi), c.hi.shape[1])
            for m in range(k):
                x = plus(x, lefts[k - m] @ (columns @ _block(c, m, size)))
            last, x = first.solve(x)
            c, x = _correct(stages, _stack([c, last]), x)
            split, series = _StagedSVD(x, noise), Left(c)
            stages += [s._replace(basis=Left(series @ s.basis.matrix)) for s in split.stages]
            c, left = series @ split.null, Left(shifts)
            for _ in range(_SWEEPS // 2):
                c = plus(c, left @ -(shifts.hi.T @ c.hi))
        unclear = int(np.sum(split.nonzero < _NONZERO * noise))
        noise = max(noise, float(split.zeros.max(initial=0.0)))
        steps.append(Step(c, shifts, split.nonzero, split.zeros, noise, unclear))
        orthonormal = Left(c) @ np.linalg.inv(triangle(np.asarray(c.hi)))
        shifts = _lowest(_stack([orthonormal, shifts], axis=1), (k + 2) * size)
    return steps


def _stack(matrices: Sequence[Pair], axis: int = 0) -> Pair:
    parts: Any = (np.concatenate(halves, axis=axis) for halves in zip(*matrices, strict=True))
    return Pair(*parts)


def _lowest(x: Pair, rows: int) -> Pair:
    """Series that begin later in ε, so that there are so many rows."""
    return _stack([zeros(rows - len(x.hi), x.hi.shape[1]), x])


def _block(series: Pair, m: int, size: int) -> Pair:
    """c_m."""
    return Pair(*(x[m * size : (m + 1) * size] for x in series))


def spaces_in_pairs(
    terms: Pair,
    scale: float,
    orthonormal: np.ndarray,
    weights: np.ndarray,
    held_out: np.ndarray,
    rounding: np.ndarray,
    trivial: np.ndarray | None,
) -> tuple[list[SeriesSpace], int]:
    """What `series_spaces` returns for ε · `scale`, from the terms A_0 … A_z in pairs, shape
    (S, z + 1, size); and how many singular values are undecided.

    - `orthonormal`: combinations of the functions that are orthonormal on the samples, as columns.
    - `weights`: of the samples, (S,), rounded to powers of two. `rounding`: largest errors of the
      functions' changes in pairs, (S, size).
    """
    size, orders = len(orthonormal), terms.hi.shape[1]
    # Powers of two, so that products with them are exact.
    row, units = (
        np.exp2(np.round(np.log2(x)))
        for x in (weights / np.sqrt(np.sum(~held_out)), np.max(np.abs(orthonormal), axis=1))
    )
    scales = row[:, None] * units
    blocks = []
    for m in range(orders):
        block = div(Pair(*(x[:, m] for x in terms)), power(np.float64(scale), m))
        blocks.append(Pair(*(scales * np.asarray(x) for x in block)))
    orthonormal = orthonormal / units[:, None]
    # Errors of single numbers are independent of each other.
    errors = np.sqrt((scales * rounding) ** 2 @ orthonormal**2)[~held_out]
    noise = float(np.max(np.linalg.norm(errors, axis=0), initial=np.finfo(float).tiny))
    steps = staircase([Pair(*(x[~held_out] for x in b)) for b in blocks], orthonormal, noise)
    left = _left_sides(blocks, orthonormal, [step.series for step in steps])
    spaces: list[SeriesSpace] = []
    nonzero, gap = [], np.inf
    for step, x in zip(steps, left, strict=True):
        nonzero.append(step.nonzero)
        gap = min(gap, step.nonzero.min(initial=1.0) / step.noise)
        # The same conditions on samples that were not fitted.
        changes, V = singular_vectors(x[held_out])
        leading = np.asarray(step.series.hi) @ V[changes <= HELD_OUT * _ZERO * step.noise].T
        count = leading.shape[1]
        leading = remove(trivial, leading)
        if spaces:
            leading = intersection(leading, spaces[-1].leading[:size])
        singular = np.sort(np.concatenate([*nonzero, step.zeros]))[::-1]
        rejections = step.series.hi.shape[1] - count
        shifts = np.asarray(step.shifts.hi)
        spaces.append(SeriesSpace(leading, shifts, singular, float(gap), rejections, 0))
    return spaces, sum(step.unclear for step in steps)


def _left_sides(blocks: list[Pair], basis: np.ndarray, series: list[Pair]) -> list[np.ndarray]:
    """The left side of the condition of order k for the series of order k, for each k."""
    size, columns = len(basis), Left(basis)
    ends = np.cumsum([c.hi.shape[1] for c in series])
    total = zeros(len(blocks[0].hi), int(ends[-1]))
    for m, block in enumerate(blocks):
        later = [_block(c, k - m, size) for k, c in enumerate(series) if k >= m]
        c = _stack([zeros(size, int(ends[m - 1]) if m else 0), *later], axis=1)
        total = plus(total, Left(block) @ (columns @ c))
    return np.split(total.hi, ends[:-1], axis=1)
