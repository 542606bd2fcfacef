"""The null space of a search for invariants."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ...engine.pairs import Pair
from ..algebra.motion import Motion, conserved_series
from ..algebra.nullspace import SeriesSpace, compress, series_spaces
from ..algebra.pair_series import ROUNDING, spaces_in_pairs
from ..algebra.weighing import WeightedConditions, times_weights, typical_sizes, weigh
from ..functions.basis import BoundBasis
from ..functions.sampling import check_basis
from .changes import Changes


@dataclass(frozen=True)
class NullSpaces:
    """The series that samples show to be conserved, order by order.

    - `changes`, `tolerance`: what was searched, and how.
    - `conditions`: see `WeightedConditions`; `spaces`: their null spaces of order 0 … z.
    - `pair_unclear`: how many singular values are hardly above rounding, in pairs of numbers.
    - `constant`: the shares of a constant, None without one. `condition`: of the basis.
    """

    changes: Changes
    tolerance: float | None
    conditions: WeightedConditions[Motion]
    spaces: list[SeriesSpace]
    pair_unclear: int
    constant: np.ndarray | None
    condition: float

    @property
    def basis(self) -> BoundBasis:
        return self.changes.step_map.basis

    @property
    def order(self) -> int:
        return len(self.spaces) - 1

    @property
    def fit(self) -> np.ndarray:
        """Which samples are fitted."""
        return ~self.changes.samples.held_out

    @functools.cached_property
    def of_fit(self) -> Changes:
        """The changes at these; so `calm`, `values`, `weights`, `rows`."""
        return self.changes.subset(self.fit)

    @property
    def calm(self) -> np.ndarray:
        return self.conditions.calm[self.fit]

    @property
    def values(self) -> np.ndarray:
        """The functions, times the weights `calm`."""
        return self.calm[:, None] * self.of_fit.values

    @property
    def weights(self) -> np.ndarray:
        return self.conditions.weights[self.fit]

    @property
    def rows(self) -> np.ndarray:
        """The weighed conditions, shape (samples, z + 1, size)."""
        return times_weights(self.conditions.terms[self.fit], self.weights)

    @property
    def sizes(self) -> np.ndarray:
        """Of a term with coefficient 1, shape (z + 1, size)."""
        return self.conditions.rms / self.conditions.scale ** np.arange(self.order + 1)[:, None]

    @property
    def count(self) -> int:
        """How many are conserved at order 0."""
        return self.spaces[0].leading.shape[1]

    @property
    def unclear(self) -> int:
        """Null vectors of which rounding decides whether they are series."""
        unclear = max(space.unclear for space in self.spaces) + self.pair_unclear
        return unclear if self.tolerance is None else 0


def null_spaces(
    changes: Changes,
    tolerance=None,
    pairs: Pair | None = None,
    filters: Sequence[Callable[[np.ndarray, WeightedConditions[Motion]], np.ndarray]] = (),
) -> NullSpaces:
    """The null spaces of all orders; `pairs`: the terms in pairs of numbers, to decide by them;
    `filters`: (leading, conditions) → those series that other tests of order 0 leave."""
    fit = ~changes.samples.held_out
    calm = typical_sizes(changes.values)[1][fit]
    values = calm[:, None] * changes.values[fit]
    condition = check_basis(changes.step_map.basis, values)
    conditions = weigh(changes.values, changes.terms, changes.motion, fit)
    constant = _shares_of_constant(conditions.rms, values, calm, changes.slopes[fit, :, :-1])
    trivial = None if constant is None else conditions.R @ constant
    if pairs is None:

        def judge(leading, shifts):
            terms, motion = conditions.terms, conditions.motion
            leading, unclear = conserved_series(leading, terms, motion, tolerance)
            for leave in filters if len(leading) == terms.shape[2] else ():
                leading = leave(leading, conditions)
            return leading, shifts, unclear

        rows = compress(times_weights(conditions.terms, conditions.weights)[fit])
        spaces, pair_unclear = series_spaces(rows, judge, tolerance, trivial), 0
    else:
        rounding, motion = ROUNDING / np.finfo(float).eps, conditions.motion
        motion = motion._replace(rounding=rounding * motion.rounding)
        conditions = conditions._replace(motion=motion)
        errors = rounding * changes.motion.rounding
        problem = pairs, conditions.scale, conditions.orthonormal, motion.weights(), ~fit
        spaces, pair_unclear = spaces_in_pairs(*problem, errors, trivial)
    return NullSpaces(changes, tolerance, conditions, spaces, pair_unclear, constant, condition)


def _shares_of_constant(rms, values, calm, slopes) -> np.ndarray | None:
    """The combination that is 1 everywhere (and not only on these samples), if there is one;
    `values`: of the functions, times the weights `calm` of the samples."""
    shares = np.linalg.lstsq(values / rms, calm, rcond=None)[0]
    shares = np.where(np.abs(shares) > 1e-9 * np.max(np.abs(shares)), shares, 0.0)
    terms = np.maximum(np.abs(values / rms) @ np.abs(shares), np.finfo(float).tiny)
    if np.max(np.abs(values / rms @ shares - calm) / terms) > 1e4 * np.finfo(float).eps:
        return None
    slopes = slopes / rms[:, None]
    terms = np.abs(slopes) * np.abs(shares)[:, None]
    sums = np.einsum("sbn,b->sn", slopes, shares)
    return shares if np.max(np.abs(sums)) <= 1e-9 * np.max(terms, initial=1.0) else None
