"""Whether what is conserved is exact or an expansion: larger samples, and a larger step."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..algebra.motion import ROUNDING, coefficient_errors
from ..functions.sampling import SMALL, UNSEEN, Displacements, Samples
from .changes import Changes
from .judging import CLEARLY, Judge

# Sizes of the samples, about their middle, on which an exact invariant is conserved too.
_LARGER = (2.0, 4.0, 8.0)
# Relative size of the larger step at which the number of invariants is counted again.
_MODERATE = 0.03

# Nonlinearity of the map on larger samples, and how many times larger they are at most.
_CURVED, _WIDEST = 0.3, 1e3
_LINEAR = 1e-9  # A map that differs by less from a linear one may be linear
# A map that moves nothing, to rounding, at a step so many times larger moves nothing at all.
_LAST = 1e30
_HARDLY = 2.0  # A step, or samples, larger by a smaller factor say nothing new


def powers_of_size(
    fitted: Changes,
    coefficients: np.ndarray,
    most: np.ndarray,
    sizes: np.ndarray,
    orthonormal: np.ndarray,
) -> np.ndarray:
    """The power of the samples' size by which changes grow, shape (count,): 0 for an invariant that
    is conserved on samples several times as large (an expansion about their middle is not); NaN
    where the map or a function is not defined there.

    `fitted`: changes on the samples; `most`: those of the invariants; `sizes`: of the functions
    there, (count,); `orthonormal`: orthonormal combinations of them, as columns, or 0 if
    coefficients are exact.
    """
    if len(coefficients) == 0:
        return np.zeros(0)
    at, which = enlarged(fitted.samples, fitted.stepped.is_constrained)
    found = fitted.elsewhere(at)

    def changes(some):
        there = found.at(some)
        digits = coefficient_errors(there.terms @ orthonormal)
        judge = Judge(there, np.ones(np.sum(some)), digits=digits)
        return judge.quantiles(coefficients, 0.95, sizes)[:, 0]

    return growth(most, which, found.good, changes)


def enlarged(samples: Samples, constrained: bool = False) -> tuple[Samples, np.ndarray]:
    """The samples, each farther from their median, and which of the sizes `_LARGER` it has."""
    which = np.arange(len(samples.q)) % len(_LARGER)
    return farther(samples, np.array(_LARGER)[which], constrained), which


def farther(samples: Samples, factors: np.ndarray | float, constrained: bool = False) -> Samples:
    """Samples so many times as far from their median, or `constrained` ones so many times as fast:
    positions stay on the manifold, and multiples of momenta along it are along it."""
    if constrained:
        factors = np.reshape(factors, (-1, *[1] * (samples.p.ndim - 1)))
        return samples._replace(p=factors * samples.p)

    def moved(x):
        centre = np.median(x, axis=0)
        return centre + np.reshape(factors, (-1, *[1] * (x.ndim - 1))) * (x - centre)

    return samples._replace(q=moved(samples.q), p=moved(samples.p))


def growth(
    most: np.ndarray,
    which: np.ndarray,
    good: np.ndarray,
    changes: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """See `powers_of_size`; `changes`: those on some of the larger samples; `which`, `good`: the
    size of each larger sample, and whether it can be used."""
    rows, sizes = [most], [1.0]
    for k, factor in enumerate(_LARGER):
        some = good & (which == k)
        if np.sum(some) < 0.5 * np.sum(which == k):
            break
        rows.append(changes(some))
        sizes.append(factor)
    if len(rows) < 2:
        return np.full(len(most), np.nan)
    powers = np.zeros(len(most))
    for i, row in enumerate(np.stack(rows, axis=1)):
        above = np.flatnonzero(row > 10 * CLEARLY)
        if len(above):
            k = max(above[0], 1)
            grows = np.log(row[k] / max(row[k - 1], ROUNDING))
            powers[i] = grows / np.log(sizes[k] / sizes[k - 1])
    return powers


class Larger(NamedTuple):
    """How many are conserved at a `factor` times larger "step", or on samples that are so many
    times as far from their median ("box"); NaN if no larger one could be tried."""

    kind: str
    factor: float
    conserved: int

    def warning(self, count: int) -> str | None:
        """Why `count` that are conserved at a small step, or in a small box, may not be exact."""
        if self.conserved >= count:
            return None
        step = self.kind == "step"
        small = "the step is small" if step else "the samples lie close to their median"
        what = "an expansion in h" if step else "an expansion about it"
        if np.isnan(self.factor):
            other = "a larger h" if step else "samples that spread wider"
            return (
                f"{small}, and no larger one can be tried: an invariant cannot be distinguished "
                f"from {what}; take {other}"
            )
        where = "at a step {} times as large" if step else "on samples {} times as far from it"
        made = " (or H_D is made for this h)" if step else ""
        return (
            f"{small}: {count} functions are conserved to rounding, and {self.conserved} of them "
            f"{where.format(f'{self.factor:.2g}')}; each of the others is {what}{made}"
        )


def grown(what: str, power: float) -> list[str]:
    """The line of a report on a power that is not 0; `what`: "changes grow"."""
    if not power > 0:
        return []
    return [
        f"      not exact: with the size of the samples {what} as its power {power:.2g}, as those "
        "of an expansion about their middle do"
    ]


def at_larger_step(
    h: float, step: Callable[[float], Displacements], count: Callable[[float], int | None]
) -> tuple[Larger, ...]:
    """How many are conserved at a larger step; empty where the step is not small, so that an
    expansion in h would be seen.

    `step`: displacements of the samples for an h; `count`: how many are conserved, None where the
    map is not defined there.
    """
    ratio, relative = 1.0, step(h).relative_step
    while relative < UNSEEN:  # or the map moves nothing at any step
        ratio *= 1e3
        if ratio > _LAST:
            return ()
        relative = step(ratio * h).relative_step
    if ratio == 1 and not relative < SMALL:
        return ()
    factor = ratio * _MODERATE / relative if np.isfinite(relative) else ratio
    return (_larger("step", factor, lambda factor: count(factor * h)),)


def in_larger_box(
    displacements: Displacements,
    step: Callable[[Samples], Displacements],
    count: Callable[[Samples], int | None],
    constrained: bool = False,
) -> tuple[Larger, ...]:
    """How many are conserved on samples that spread wider; empty where a map is not nearly linear
    on those given, or linear on all. `step`: displacements of other samples."""
    samples, near = displacements.samples, displacements.nonlinearity
    if near >= SMALL:
        return ()
    factor = _WIDEST
    if near >= _LINEAR:
        factor = min(_CURVED / near, _WIDEST)
    else:
        values = step(farther(samples, factor, constrained)).values / factor
        if np.isfinite(values).all() and Displacements(samples, values).nonlinearity < _LINEAR:
            return ()
    return (_larger("box", factor, lambda factor: count(farther(samples, factor, constrained))),)


def _larger(kind: str, factor: float, count: Callable[[float], int | None]) -> Larger:
    while factor > _HARDLY:
        found = count(factor)
        if found is not None:
            return Larger(kind, factor, found)
        factor /= 10
    return Larger(kind, np.nan, 0)
