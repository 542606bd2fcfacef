"""Linear systems of long arrays: a band by its rows, others column by column."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from ..jaxprs.extent import LARGE_SYSTEM, SHORT
from ..linear import by_elimination, column_by_column
from ..llvm.ir import NotCompilable
from . import bands
from .boxes import Array
from .diagonals import diagonals
from .equations import ARRAY_RULES, Translation

WIDEST = 32
"""Diagonals of a band, from the lowest to the highest; a wider one is solved as a full matrix."""

_MOST_UNKNOWNS = 4096  # of a full matrix, in a branch
_MOST_ENTRIES = 10**7  # of a matrix for which another order is searched


class Band(NamedTuple):
    """How a matrix with some diagonals becomes a band: its rows and columns in another order.

    - `order`: row i of the band is row ``order[i]`` of the matrix; None if the order stays.
    - `low`, `high`: diagonals of the band below and above the main one.
    """

    order: np.ndarray | None
    low: int
    high: int

    @property
    def width(self) -> int:
        return self.low + self.high + 1


def band_of(diagonals: dict[int, Array], n: int) -> Band:
    """The order of rows and columns in which the numbers are near the main diagonal."""
    plain = Band(None, max(0, -min(diagonals)), max(0, *diagonals))
    if plain.width <= WIDEST or n * len(diagonals) > _MOST_ENTRIES:
        return plain
    from scipy import sparse  # few programs need it: a part of the import time
    from scipy.sparse import csgraph

    # The stages of a method, or the ends of a ring, are far from each other in the given order.
    pairs = [
        np.stack([row := np.arange(box.lower[0], box.upper[0]), row + offset])
        for offset, diagonal in diagonals.items()
        for box in diagonal.boxes
        if not (box.expression.kind == "known" and not box.expression.value)
    ]
    rows, columns = np.concatenate(pairs, axis=1)
    pattern = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), (n, n))
    pattern = pattern + pattern.T
    orders = [csgraph.reverse_cuthill_mckee(pattern, symmetric_mode=True)]
    # It may begin in the middle, with twice the width: another order begins at an end.
    far = csgraph.breadth_first_order(pattern, orders[0][0], False, False)[-1]
    from_end = csgraph.breadth_first_order(pattern, far, False, False)
    if len(from_end) == n:
        orders.append(from_end)
    return min((_in_order(order, rows, columns) for order in orders), key=lambda band: band.width)


def _in_order(order: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> Band:
    place = np.argsort(order)
    steps = place[columns] - place[rows]
    return Band(order, max(0, -int(steps.min())), max(0, int(steps.max())))


def eliminate(translation: Translation, eqn: Any, matrix: Array, right: Array) -> list[Array]:
    *front, n, _ = matrix.shape
    shape = eqn.outvars[0].aval.shape
    if any(size != 1 for size in (*front, *shape[:-1])):
        raise NotCompilable("several linear systems at once, of long arrays")
    right = right.along((n,), [*[None] * (len(right.shape) - 1), 0])
    if (factors := _factors(translation, matrix)) is not None:
        band, values = factors
        (solution,) = _run(translation, functools.partial(_solution, band), [*values, right])
    else:
        # A branch may be for rare cases, such as Newton's method where a simpler one fails.
        limit = _MOST_UNKNOWNS if translation.branches else LARGE_SYSTEM
        if n > limit:
            raise NotCompilable(f"a full matrix of {n} unknowns (above {limit} LAPACK is faster)")
        square = matrix.along((n, n), [*[None] * len(front), 0, 1])
        solve = by_elimination if n <= SHORT else column_by_column
        (solution,) = _run(translation, solve, [square, right])
    return [solution.along(shape, [len(shape) - 1])]


def _factors(translation: Translation, matrix: Array) -> tuple[Band, list[Array]] | None:
    """The rows of a band and their factors; None for a matrix without one."""
    # Newton's method solves twice with one matrix: its factors are computed once in a block.
    key = id(matrix), id(translation.block)
    if key not in translation.factors:
        *front, n, _ = matrix.shape
        factors = None
        of = diagonals(matrix.along((n, n), [*[None] * len(front), 0, 1])) if n > SHORT else None
        if of and (band := band_of(of, n)).width <= WIDEST:
            function = functools.partial(_band_factors, band, list(of))
            values = _run(translation, function, list(of.values()))
            factors = band, [translation.settle(value) for value in values]
        # With the matrix, so that no other one gets its identity.
        translation.factors[key] = matrix, factors
    return translation.factors[key][1]


def _band_factors(band: Band, offsets: Sequence[int], *of: jax.Array) -> Sequence[jax.Array]:
    rows = bands.rows_of(of, offsets, band.low, band.high, band.order)
    return rows, *bands.factorise(rows, band.low)


def _solution(band: Band, rows, lower, inverse, upper, weak, right) -> list[jax.Array]:
    factors = bands.Factors(lower, inverse, upper, weak)
    if band.order is None:
        return [bands.solve(factors, rows, right[:, None])[:, 0]]
    solution = bands.solve(factors, rows, right[band.order][:, None])[:, 0]
    return [solution[np.argsort(band.order)]]


def _run(translation: Translation, function: Callable, args: Sequence[Array]) -> list[Array]:
    """The results of a function of JAX arrays."""
    shapes = [jax.ShapeDtypeStruct(arg.shape, arg.dtype) for arg in args]
    return translation.evaluate(jax.make_jaxpr(function)(*shapes), args)


ARRAY_RULES |= {"eliminate": eliminate}
