"""The choice of the series that represent invariants: in few functions, with known digits."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..algebra.motion import UNCLEAR, coefficient_errors, times
from ..algebra.nullspace import RANK, compress, in_units_of, singular_vectors, triangle
from .changes import is_exact
from .digits import Conditions
from .judging import CLEARLY, Fewest, Judge, cleaned
from .representatives import Span
from .search import NullSpaces

# Coefficients are known up to this share of the largest, over the gap in singular values.
_FUZZY = 30.0
_FUZZIEST = 1e-3  # No larger shares than this are taken for errors of others
_AS_GOOD = 10.0  # An invariant with fewer terms may change by so many times more
_ROUND_OFF = 1e-12  # Changes below this need not be smaller


class Choice(NamedTuple):
    """Representatives, shape (count, order + 1, size), and errors of the independent ones; how many
    were refused, and how many of those are unclear; the blur."""

    coefficients: np.ndarray
    dependent: np.ndarray
    errors: np.ndarray
    exact: tuple[bool, ...]
    refused: int
    unclear: int
    blur: float


class Chooser(NamedTuple):
    """What representatives are compared by.

    - `null`: what was found. `sizes`: see `NullSpaces`.
    - `judge`, `judge_fitted`: their changes at the held-out and at the fitted samples.
    - `conditions`: for digits and errors of coefficients. `fewest`: for order 0.
    - `typical`: change of functions of size 1 in a step.
    """

    null: NullSpaces
    sizes: np.ndarray
    judge: Judge
    judge_fitted: Judge
    conditions: Conditions
    fewest: Fewest
    typical: float

    def best(self, representative: str) -> Choice:
        """The choice by which fewer series are rejected."""
        # Null vectors are known up to a share of about 1 / gap.
        fuzzy = min(_FUZZY / self.null.gap, _FUZZIEST)
        if self.null.tolerance is not None:
            return self.chosen(max(RANK, np.sqrt(self.null.tolerance)), representative)
        chosen = self.chosen(max(RANK, fuzzy), representative)
        if chosen.refused and fuzzy > RANK:
            chosen = min(self.chosen(RANK, representative), chosen, key=lambda x: x.refused)
        return chosen

    def chosen(self, blur: float, representative: str) -> Choice:
        """One series for each leading-order term, in functions of the basis; `blur`: see `Span`."""
        span = Span.of(self.null, blur)
        found = span.representatives(self.null.samples, self.null.slopes)
        picked = [
            (*self._representative(span, series, representative), free) for series, free in found
        ]
        size = self.null.order + 1, self.null.basis.size

        def those(independent):
            kept = [(c, exact) for c, exact, f in picked if f == independent]
            series = [_normalised(c, self.null.weighed.rms) for c, _ in kept]
            return np.array(series).reshape(-1, *size), np.array([e for _, e in kept], bool)

        (coefficients, exact), (dependent, _) = those(True), those(False)
        refused, unclear = 0, 0
        if self.null.tolerance is None:  # with the digits that the coefficients have in the end
            kept, others = self.judge.keep(coefficients), self.judge.keep(dependent)
            lost = np.concatenate([coefficients[~kept], dependent[~others]])
            refused = len(lost)
            unclear = int(np.sum(self.judge.largest(lost) < UNCLEAR))
            coefficients, exact, dependent = coefficients[kept], exact[kept], dependent[others]
        # Conserved to rounding before approximate, at every ε before to an order, few terms before
        # many.
        sure, terms = self.judge.keep(coefficients), np.count_nonzero(coefficients, (1, 2))
        place = sorted(range(len(exact)), key=lambda i: (not sure[i], not exact[i], terms[i]))
        place = np.array(place, int)
        coefficients, exact = coefficients[place], tuple(map(bool, exact[place]))
        errors = [self.conditions.errors(c * self.sizes, self.null.tolerance) for c in coefficients]
        errors = np.array(errors).reshape(coefficients.shape) / self.sizes
        return Choice(coefficients, dependent, errors, exact, refused, unclear, blur)

    def _representative(
        self, span: Span, series: np.ndarray, representative: str
    ) -> tuple[np.ndarray, bool]:
        """Coefficients, shape (order + 1, size), and whether the series is exact."""
        if self.null.order == 0:
            shares = self._of_order_0(series[0], span.blur)[None]
            return self._without_rounding(shares) / self.sizes, False
        simplest = self._without_rounding(cleaned(span.simplest(series))) / self.sizes
        given, *sizes = map(jnp.asarray, (simplest, self.typical, self.null.weighed.scale))
        samples = self.null.samples
        samples = samples.at(slice(None, None, max(1, len(samples.q) // 100)))
        exact = bool(is_exact(self.null.changes.stepped.unnamed(), given, sizes, samples))
        if exact or representative == "simplest":
            return simplest, exact
        return self._without_rounding(cleaned(span.least(series))) / self.sizes, exact

    def _without_rounding(self, shares: np.ndarray) -> np.ndarray:
        if self.null.tolerance is not None:
            return shares
        return self.conditions.without_rounding(
            shares, lambda tried: self.judge.largest((tried / self.sizes)[None])[0]
        )

    def _of_order_0(self, series: np.ndarray, blur: float) -> np.ndarray:
        """Shares of an invariant of order 0, with as few terms and as many digits as can be."""
        if self.null.tolerance is not None:
            return cleaned(series, blur)

        def change(shares):
            return self.judge.largest((shares / self.sizes[0])[None, None])[0]

        tried = [cleaned(self.fewest.again(cleaned(series, blur)), blur)]
        if blur > RANK:  # what was taken for errors of others may be a part of it
            tried += [self.fewest.again(cleaned(series)), cleaned(series)]
        tried = [x for x in tried if x.any()] or [series]
        changes = np.array([change(x) for x in tried])
        if np.min(changes) > CLEARLY:  # rows weighted by what its own slopes predict
            rows = self.judge_fitted.own_rows(series / self.sizes[0]) / self.null.weighed.rms
            singular, V = singular_vectors(rows)
            null = V[singular <= CLEARLY * np.sqrt(len(rows))]
            own = null.T @ (null @ series)
            tried = [x for x in (cleaned(own, blur), own, *tried) if x.any()]
            changes = np.array([change(x) for x in tried])
        good = changes <= max(_AS_GOOD * np.min(changes), _ROUND_OFF)
        return tried[int(np.argmax(good))]


def chooser(null: NullSpaces) -> Chooser:
    """The `Chooser` for what was found."""
    changes, weighed, fit = null.changes, null.weighed, null.fit
    in_units = changes._replace(terms=in_units_of(weighed.scale, changes.terms))
    digits, tolerated = coefficient_errors(weighed.terms), null.tolerance is not None
    judge, judge_fitted = (
        Judge(in_units.at(part), weighed.calm[part], weighed.scale, digits[part], tolerated)
        for part in (~fit, fit)
    )
    conditions = Conditions.of(times(compress(null.rows), weighed.R))
    motion, values = changes.motion.at(fit), null.values
    fewest = Fewest(null.basis.complexity, weighed.rms, changes.terms[fit, 0], motion, values)
    step = triangle(null.calm[:, None] * weighed.terms[fit, 0]) / np.sqrt(np.sum(fit))
    typical = float(np.linalg.norm(step, 2)) or 1.0
    return Chooser(null, null.sizes, judge, judge_fitted, conditions, fewest, typical)


def _normalised(series: np.ndarray, rms: np.ndarray) -> np.ndarray:
    """Scaled so that the coefficient with the largest share is one half, as of an energy."""
    return series / (2 * series[0, np.argmax(np.abs(series[0] * rms))])
