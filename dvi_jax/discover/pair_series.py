"""Null spaces of series order by order, with 30 digits, where float64 cannot tell small from zero.

The conditions Σ_{m≤k} B_{k−m} c_m = 0, k = 0 … z, are a block-Toeplitz system. Its null vectors of
order 0 are those of B_0, c_0 = N a_0. The correction c_k of each is the smallest that makes the
left side of order k orthogonal to the range of B_0; the rest of it is a secular term D_k a_0. The
same correction, later by m orders, belongs to c_m = N a_m. What remains is

    Σ_{m<k} D_{k−m} a_m = 0,    k = 1 … z,

a block-Toeplitz system of one order less, with as many unknowns as B_0 has null vectors. Its
leading block D_1 decides which of them survive order 1; and so on.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .._arithmetic import Arithmetic, DoubleDouble, FloatingPoint
from ..engine.pair_matrices import Left, exact, plus, zeros
from ..engine.pairs import Pair, div, power
from .nullspace import HELD_OUT, SeriesSpace, orthogonal_to, singular_vectors, triangle, within

ROUNDING = 2.0**-104  # Relative rounding of pairs
# A singular value counts as zero below so many times the rounding that was seen at lower orders,
# and is undecided below so many.
_ZERO, _UNDECIDED = 1e2, 1e6
_SHARE = 1e-7  # Singular values above this share of the largest are factors of float64
_SWEEPS = 6  # Corrections by factors of float64; each is about 1e-9 times the one before or less


def uses_pairs(arithmetic: Arithmetic, tolerance: float | None) -> bool:
    """Whether a search computes the null space in pairs. **Raises** `ValueError` for other
    arithmetics, and for a tolerance."""
    in_pairs = isinstance(arithmetic, DoubleDouble)
    if not (in_pairs or isinstance(arithmetic, FloatingPoint)):
        raise ValueError(
            "arithmetic of discover_invariants must be dvi.FloatingPoint() or dvi.DoubleDouble(), "
            f"got {arithmetic!r}: other representations of a state do not change one step."
        )
    if in_pairs and tolerance is not None:
        raise ValueError(
            f"tolerance={tolerance!r} is for approximate invariants, arithmetic=dvi.DoubleDouble() "
            "for those that are conserved to 30 digits: give one of the two."
        )
    return in_pairs


class _Stage(NamedTuple):
    """U Σ V of M N, for columns N, without small singular values."""

    basis: Left
    image: Left
    transposed: Left
    singular: np.ndarray
    right: np.ndarray

    def correction(self, x: Pair) -> np.ndarray:
        """−(M N)⁺ x, in float64."""
        return -self.right.T @ ((self.transposed @ x).hi / self.singular[:, None])


class _Split:
    """The null space of a matrix of pairs, and solutions of linear systems with it.

    Factors of float64 resolve singular values down to `_SHARE` of the largest. The matrix on what
    remains has smaller elements, all digits of which are known, and is factored again.
    """

    def __init__(self, matrix: Pair, noise: float):
        self.stages: list[_Stage] = []
        self.null, kept = exact(np.eye(matrix.hi.shape[1])), [np.zeros(0)]
        while True:
            rows, columns = matrix.hi.shape
            U, singular, V = np.linalg.svd(matrix.hi, full_matrices=rows < columns)
            largest = singular.max(initial=0.0)
            if largest <= _ZERO * noise:
                break
            count = int(np.sum(singular > _SHARE * largest))
            rest = exact(V[count:].T)
            factors = Left(U[:, :count].T), singular[:count], V[:count]
            stage = _Stage(Left(self.null), Left(matrix), *factors)
            self.stages.append(stage)
            kept.append(singular[:count])
            rest, matrix = _corrected([stage], rest, stage.image @ rest, inner=True)
            self.null = stage.basis @ rest
        self.zeros = singular
        self.kept = np.concatenate(kept)

    def solved(self, x: Pair) -> tuple[Pair, Pair]:
        """c, for which M c + x is orthogonal to the range of M, and M c + x."""
        return _corrected(self.stages, zeros(len(self.null.hi), x.hi.shape[1]), x)


def _corrected(
    stages: Sequence[_Stage], c: Pair, left: Pair, inner: bool = False
) -> tuple[Pair, Pair]:
    """c and the left side M c + x without the part of it in the range of the stages; `inner`: c in
    terms of the columns of the stage."""
    first = last = None
    for _ in range(_SWEEPS if stages else 0):
        largest = np.zeros(c.hi.shape[1])
        for stage in stages:
            y = stage.correction(left)
            c = plus(c, y if inner else stage.basis @ y)
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

    - `series`: c_0 … c_k one below the other, shape ((k + 1) · size, count), with orthonormal c_0.
    - `kept`, `zeros`: singular values that are not zero, and those that are.
    - `noise`: the largest zero up to this order. `undecided`: how many of `kept` are hardly larger.
    """

    series: Pair
    kept: np.ndarray
    zeros: np.ndarray
    noise: float
    undecided: int


def staircase(blocks: Sequence[Pair], basis: np.ndarray, noise: float) -> list[Step]:
    """The null spaces of all orders.

    - `blocks`: B_0 … B_z, (rows, size). `basis`: columns, (size, size), taken as exact: the series
      are those of B_m · `basis`. `noise`: rounding of the elements of B_0 · `basis`.
    """
    columns: Left | None = Left(basis)
    series: list[Pair] = []
    found: list[Step] = []
    for k in range(len(blocks)):
        split = _Split(Left(blocks[0]) @ basis if columns else blocks[0], noise)
        y, blocks = _next(blocks, columns, split)
        series = _composed(series, y) if k else y
        undecided = int(np.sum(split.kept < _UNDECIDED * noise))
        noise = max(noise, float(split.zeros.max(initial=0.0)))
        stacked = _stacked(series[: k + 1])
        found.append(Step(stacked, split.kept, split.zeros, noise, undecided))
        columns = None
    return found


def _next(
    blocks: Sequence[Pair], columns: Left | None, split: _Split
) -> tuple[list[Pair], list[Pair]]:
    """The series that begins with each null vector of B_0, and its secular terms."""
    lefts = [Left(b) for b in blocks[1:]]
    series, moved, secular = [split.null], [], []
    for k in range(len(lefts)):
        moved.append(columns @ series[-1] if columns else series[-1])
        x = zeros(len(blocks[0].hi), split.null.hi.shape[1])
        for m, c in enumerate(moved):
            x = plus(x, lefts[k - m] @ c)
        c, x = split.solved(x)
        series.append(c)
        secular.append(x)
    return series, secular


def _composed(series: Sequence[Pair], y: Sequence[Pair]) -> list[Pair]:
    """Σ_j c_{k−j} y_j for each order k."""
    lefts, found = [Left(c) for c in series], []
    for k in range(len(series)):
        total = zeros(len(series[0].hi), y[0].hi.shape[1])
        for j in range(min(k + 1, len(y))):
            total = plus(total, lefts[k - j] @ y[j])
        found.append(total)
    return found


def _stacked(matrices: Sequence[Pair], axis: int = 0) -> Pair:
    parts: Any = (np.concatenate(x, axis=axis) for x in zip(*matrices, strict=True))
    return Pair(*parts)


def _block(series: Pair, m: int, size: int) -> Pair:
    """c_m."""
    return Pair(*(x[m * size : (m + 1) * size] for x in series))


def _smallest(steps: Sequence[Step], size: int) -> list[tuple[Pair, Pair]]:
    """For each order the series with the smallest corrections, and orthonormal ones that may be
    added to them: all of the orders below, later in ε."""
    shifts, found = zeros(size, 0), []
    for step in steps:
        c, left = step.series, Left(shifts)
        for _ in range(_SWEEPS // 2):
            c = plus(c, left @ -(shifts.hi.T @ c.hi))
        found.append((c, shifts))
        own = Left(c) @ np.linalg.inv(triangle(np.asarray(c.hi)))
        later = _stacked([own, shifts], axis=1)
        shifts = _stacked([zeros(size, later.hi.shape[1]), later])
    return found


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
    each = row[:, None] * units
    blocks = []
    for m in range(orders):
        block = div(Pair(*(x[:, m] for x in terms)), power(np.float64(scale), m))
        blocks.append(Pair(*(each * np.asarray(x) for x in block)))
    orthonormal = orthonormal / units[:, None]
    # Errors of single numbers are independent of each other.
    errors = np.sqrt((each * rounding) ** 2 @ orthonormal**2)[~held_out]
    noise = float(np.max(np.linalg.norm(errors, axis=0), initial=np.finfo(float).tiny))
    steps = staircase([Pair(*(x[~held_out] for x in b)) for b in blocks], orthonormal, noise)
    series = _smallest(steps, size)
    left = _left_sides(blocks, orthonormal, [c for c, _ in series])
    spaces: list[SeriesSpace] = []
    kept, gap = [], np.inf
    for step, (c, shifts), x in zip(steps, series, left, strict=True):
        kept.append(step.kept)
        gap = min(gap, step.kept.min(initial=1.0) / step.noise)
        # The same conditions on samples that were not fitted.
        changes, V = singular_vectors(x[held_out])
        leading = np.asarray(c.hi) @ V[changes <= HELD_OUT * _ZERO * step.noise].T
        count = leading.shape[1]
        if trivial is not None:
            leading = leading @ orthogonal_to(trivial @ leading[:size])
        if spaces:
            leading = within(leading, spaces[-1].leading[:size])
        singular = np.sort(np.concatenate([*kept, step.zeros]))[::-1]
        refused = c.hi.shape[1] - count
        shifts = np.asarray(shifts.hi)
        spaces.append(SeriesSpace(leading, shifts, singular, float(gap), refused, 0))
    return spaces, sum(step.undecided for step in steps)


def _left_sides(
    blocks: Sequence[Pair], basis: np.ndarray, series: Sequence[Pair]
) -> list[np.ndarray]:
    """The left side of the condition of order k for the series of order k, for each k."""
    size, columns = len(basis), Left(basis)
    ends = np.cumsum([c.hi.shape[1] for c in series])
    total = zeros(len(blocks[0].hi), int(ends[-1]))
    for m, block in enumerate(blocks):
        later = [_block(c, k - m, size) for k, c in enumerate(series) if k >= m]
        before = zeros(size, int(ends[m - 1]) if m else 0)
        c = _stacked([before, *later], axis=1)
        total = plus(total, Left(block) @ (columns @ c))
    return np.split(total.hi, ends[:-1], axis=1)
