"""Linear systems of long arrays: a band by its rows, others column by column."""

from collections.abc import Callable, Sequence
from typing import Any

import jax

from ..linear import by_elimination, column_by_column
from ..llvm.ir import NotCompilable
from . import bands
from .boxes import SHORT, Array
from .diagonals import diagonals
from .equations import ARRAY_RULES, Translation

WIDEST = 12
"""Diagonals of a band, from the lowest to the highest; a wider one is solved as a full matrix."""

_MOST_UNKNOWNS = 4096


def eliminate(translation: Translation, eqn: Any, matrix: Array, right: Array) -> list[Array]:
    *front, n, _ = matrix.shape
    (out,) = eqn.outvars
    if any(size != 1 for size in (*front, *out.aval.shape[:-1])):
        raise NotCompilable("several linear systems at once, of long arrays")
    A = matrix.along((n, n), [*[None] * len(front), 0, 1])
    b = right.along((n,), [*[None] * (len(right.shape) - 1), 0])
    of = diagonals(A)
    if n > SHORT and of and max(0, *of) - min(0, *of) < WIDEST:
        x = _of_band(translation, matrix, of, b)
    elif n <= SHORT:
        (x,) = _run(translation, by_elimination, [A, b])
    else:
        if n > _MOST_UNKNOWNS:
            raise NotCompilable(f"a full matrix of {n} unknowns (at most {_MOST_UNKNOWNS})")
        (x,) = _run(translation, column_by_column, [A, b])
    shape = out.aval.shape
    return [x.along(shape, [len(shape) - 1])]


def _of_band(
    translation: Translation, matrix: Array, of: dict[int, Array], b: Array
) -> Array:
    # Newton's method solves twice with one matrix: its factors are computed once in a block.
    key = id(matrix), id(translation.block)
    if key not in translation.factors:
        offsets = list(of)
        below = max(0, -min(offsets))

        def factors(*diagonals):
            rows, _ = bands.rows_of(diagonals, offsets)
            return rows, *bands.factorise(rows, below)

        values = _run(translation, factors, list(of.values()))
        # With the matrix, so that no other one gets its identity.
        translation.factors[key] = matrix, below, [translation.settle(x) for x in values]

    _, below, (rows, *factors) = translation.factors[key]

    def solve(rows, *rest):
        *factors, b = rest
        return bands.solve(bands.Factors(*factors), rows, b[:, None], below)[:, 0]

    (x,) = _run(translation, solve, [rows, *factors, b])
    return x


def _run(translation: Translation, function: Callable, args: Sequence[Array]) -> list[Array]:
    """The results of a function of JAX arrays."""
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args]
    return translation.evaluate(jax.make_jaxpr(function)(*shapes), args)


ARRAY_RULES |= {"eliminate": eliminate}
