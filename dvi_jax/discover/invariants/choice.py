"""The choice of the series that represent invariants: in few functions, with known digits."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..algebra.motion import UNCLEAR, coefficient_errors, times
from ..algebra.nullspace import RANK, compress, in_units_of, singular_vectors, triangle
from .changes import is_exact
from .digits import LinearConditions
from .judging import CLEARLY, Fewest, Judge, clean
from .representatives import Span
from .search import NullSpaces

_FUZZY = 30.0  # Coefficients are known up to this share of the largest, over the gap
_FUZZIEST = 1e-3  # No larger shares than this are taken for errors of others
_AS_GOOD = 10.0  # An invariant with fewer terms may change by so many times more
_ROUND_OFF = 1e-12  # Changes below this need not be smaller


class Choice(NamedTuple):
    """Representatives, shape (count, order + 1, size), and errors of the independent ones; how many
    were rejected, and how many of those are unclear; the blur."""

    coefficients: np.ndarray
    dependent: np.ndarray
    errors: np.ndarray
    exact: tuple[bool, ...]
    rejections: int
    unclear: int
    blur: float


class Chooser(NamedTuple):
    """What representatives are compared by.

    - `null`: the series that are conserved.
    - `judge`, `judge_fitted`: their changes at the held-out and at the fitted samples.
    - `linear`: for digits and errors of coefficients. `fewest`: for order 0.
    - `typical`: change of functions of size 1 in a step.
    """

    null: NullSpaces
    judge: Judge
    judge_fitted: Judge
    linear: LinearConditions
    fewest: Fewest
    typical: float

    def best(self, representative: str) -> Choice:
        """The choice by which fewer series are rejected."""
        # Null vectors are known up to a share of about 1 / gap.
        fuzzy = min(_FUZZY / self.null.spaces[-1].gap, _FUZZIEST)
        if self.null.tolerance is not None:
            return self.choice(max(RANK, np.sqrt(self.null.tolerance)), representative)
        choice = self.choice(max(RANK, fuzzy), representative)
        if choice.rejections and fuzzy > RANK:
            sharp = self.choice(RANK, representative)
            choice = min(sharp, choice, key=lambda choice: choice.rejections)
        return choice

    def choice(self, blur: float, representative: str) -> Choice:
        """One series for each leading-order term, in functions of the basis; `blur`: see `Span`."""
        null, span = self.null, Span(self.null, blur)
        shape = -1, null.order + 1, null.basis.size
        groups, flags = {True: [], False: []}, []
        for series, is_independent in span.representatives():
            coefficients, is_exact_series = self._representative(span, series, representative)
            groups[is_independent].append(_normalise(coefficients, null.conditions.rms))
            flags += [is_exact_series] * is_independent
        coefficients, dependent = (np.array(groups[x]).reshape(shape) for x in (True, False))
        exact, changes = np.array(flags, bool), self.judge.largest(coefficients)
        rejections = np.zeros(0)
        if null.tolerance is None:  # with the digits that the coefficients have in the end
            other_changes = self.judge.largest(dependent)
            good, other_good = changes <= CLEARLY, other_changes <= CLEARLY
            rejections = np.concatenate([changes[~good], other_changes[~other_good]])
            coefficients, exact, changes = (x[good] for x in (coefficients, exact, changes))
            dependent = dependent[other_good]
        terms = np.count_nonzero(coefficients, (1, 2))
        # Conserved to rounding before approximate, at every ε before to an order, then few terms.
        order = np.lexsort((terms, ~exact, ~(changes <= CLEARLY)))
        coefficients, exact = coefficients[order], tuple(exact[order].tolist())
        errors = [self.linear.errors(c * self.null.sizes, null.tolerance) for c in coefficients]
        errors = np.array(errors).reshape(coefficients.shape) / self.null.sizes
        unclear = int(np.sum(rejections < UNCLEAR))
        return Choice(coefficients, dependent, errors, exact, len(rejections), unclear, blur)

    def _representative(self, span: Span, series: np.ndarray, representative: str):
        """Coefficients, shape (order + 1, size), and whether the series is exact."""
        null = self.null
        if null.order == 0:
            shares = self._of_order_0(series[0], span.blur)[None]
            return self._without_rounding(shares) / self.null.sizes, False
        simplest = self._without_rounding(clean(span.simplest(series))) / self.null.sizes
        coefficients, *sizes = map(jnp.asarray, (simplest, self.typical, null.conditions.scale))
        samples = null.of_fit.samples
        samples = samples.subset(slice(None, None, max(1, len(samples.q) // 100)))
        step_map = null.changes.step_map.without_names()
        exact = bool(is_exact(step_map, coefficients, sizes, samples))
        if exact or representative == "simplest":
            return simplest, exact
        return self._without_rounding(clean(span.smallest(series))) / self.null.sizes, exact

    def _without_rounding(self, shares: np.ndarray) -> np.ndarray:
        def change(candidate):
            return self.judge.largest((candidate / self.null.sizes)[None])[0]

        is_exact = self.null.tolerance is None
        return self.linear.without_rounding(shares, change) if is_exact else shares

    def _of_order_0(self, series: np.ndarray, blur: float) -> np.ndarray:
        """Shares of an invariant of order 0, with as few terms and as many digits as can be."""
        if self.null.tolerance is not None:
            return clean(series, blur)

        def changes_of(candidates):
            return self.judge.largest((np.array(candidates) / self.null.sizes[0])[:, None])

        candidates = [clean(self.fewest.represent(clean(series, blur)), blur)]
        if blur > RANK:  # what was taken for errors of others may be a part of it
            candidates += [self.fewest.represent(clean(series)), clean(series)]
        candidates = [shares for shares in candidates if shares.any()] or [series]
        changes = changes_of(candidates)
        if np.min(changes) > CLEARLY:  # rows weighted by what its own slopes predict
            rows = self.judge_fitted.own_rows(series / self.null.sizes[0])
            rows = rows / self.null.conditions.rms
            singular, V = singular_vectors(rows)
            null = V[singular <= CLEARLY * np.sqrt(len(rows))]
            projection = null.T @ (null @ series)
            candidates = [clean(projection, blur), projection, *candidates]
            candidates = [shares for shares in candidates if shares.any()]
            changes = changes_of(candidates)
        good = changes <= max(_AS_GOOD * np.min(changes), _ROUND_OFF)
        return candidates[int(np.argmax(good))]


def chooser(null: NullSpaces) -> Chooser:
    """The `Chooser` for these null spaces."""
    changes, conditions, fit = null.changes, null.conditions, null.fit
    in_units = changes._replace(terms=in_units_of(conditions.scale, changes.terms))
    digits, calm, scale = coefficient_errors(conditions.terms), conditions.calm, conditions.scale
    judge, judge_fitted = (
        Judge(in_units.subset(part), calm[part], scale, digits[part], null.tolerance is not None)
        for part in (~fit, fit)
    )
    linear = LinearConditions.from_terms(times(compress(null.rows), conditions.R))
    fewest = Fewest(conditions.rms, null.of_fit, null.values)
    step = triangle(null.calm[:, None] * conditions.terms[fit, 0]) / np.sqrt(np.sum(fit))
    typical = float(np.linalg.norm(step, 2)) or 1.0
    return Chooser(null, judge, judge_fitted, linear, fewest, typical)


def _normalise(series: np.ndarray, rms: np.ndarray) -> np.ndarray:
    """Scaled so that the coefficient with the largest share is one half, as of an energy."""
    return series / (2 * series[0, np.argmax(np.abs(series[0] * rms))])
