"""Whether invariants are exact or an expansion: larger samples, and a larger step."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..algebra.motion import ROUNDING, coefficient_errors
from ..algebra.nullspace import CLEAR
from ..functions.sampling import LEAST_STEP, SMALL, Displacements, SamplePoints
from .changes import Changes
from .judging import CLEARLY, Judge

_LARGER = (2.0, 4.0, 8.0)  # Sizes of the samples on which an exact invariant is conserved too
_MODERATE = 0.03  # Relative size of the larger step at which invariants are counted again
_NONLINEAR, _WIDEST = 0.3, 1e3  # Nonlinearity of the map on larger samples; their largest factor
_LINEAR = 1e-9  # A map that differs by less from a linear one may be linear
_LAST = 1e30  # A map that does not move at a step so many times larger does not move at all
_UNEQUAL = 30.0  # A step that moves q by so many times more of its spread than p, or p than q
_SIMILAR = 3.0  # A ratio at which they are moved by similar shares
_HARDLY = 2.0  # A step, or samples, larger by a smaller factor say nothing new

# (samples, h) → displacements in a step h; and how many are conserved, None where it is undefined
DisplacementFunction = Callable[[SamplePoints, float], Displacements]
CountFunction = Callable[[SamplePoints, float], int | None]


def powers_of_size(
    fit: Changes,
    coefficients: np.ndarray,
    changes: np.ndarray,
    sizes: np.ndarray,
    orthonormal: np.ndarray,
) -> np.ndarray:
    """The power of the samples' size by which changes grow, shape (count,): 0 for an invariant that
    is conserved on samples several times as large (an expansion about their middle is not); NaN
    where the map or a function is not defined there.

    `fit`: changes of the functions on the samples; `changes`: those of the invariants; `sizes`: of
    the invariants there, (count,); `orthonormal`: orthonormal combinations of the functions, as
    columns, or 0 if coefficients are exact.
    """
    if len(coefficients) == 0:
        return np.zeros(0)
    samples, factors = larger_samples(fit.samples, fit.step_map.is_constrained)
    larger = fit.recompute(samples)

    def larger_changes(index):
        subset = larger.subset(index)
        digits = coefficient_errors(subset.terms @ orthonormal)
        judge = Judge(subset, np.ones(np.sum(index)), digits=digits)
        return judge.quantiles(coefficients, 0.95, sizes)[:, 0]

    return growth(changes, factors, larger.good, larger_changes)


def larger_samples(samples: SamplePoints, is_constrained=False) -> tuple[SamplePoints, np.ndarray]:
    """The samples, each farther from their median, and by which of the factors `_LARGER`."""
    factors = np.resize(_LARGER, len(samples.q))
    return farther(samples, factors, is_constrained), factors


def farther(samples: SamplePoints, factors: Any, is_constrained: bool = False) -> SamplePoints:
    """Samples so many times as far from their median, or on a manifold so many times as fast:
    positions stay on it, and multiples of momenta along it are along it."""
    if is_constrained:
        factors = np.reshape(factors, (-1, *[1] * (samples.p.ndim - 1)))
        return samples._replace(p=factors * samples.p)

    def stretch(x):
        centre = np.median(x, axis=0)
        return centre + np.reshape(factors, (-1, *[1] * (x.ndim - 1))) * (x - centre)

    return samples._replace(q=stretch(samples.q), p=stretch(samples.p))


def growth(
    changes: np.ndarray,
    factors: np.ndarray,
    good: np.ndarray,
    larger_changes: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """See `powers_of_size`; `larger_changes`: those on some of the larger samples; `factors`,
    `good`: by what each of these is larger, and whether it can be used."""
    rows, sizes = [changes], [1.0]
    for factor in _LARGER:
        index = good & (factors == factor)
        if np.sum(index) < 0.5 * np.sum(factors == factor):
            break
        rows.append(larger_changes(index))
        sizes.append(factor)
    if len(rows) < 2:
        return np.full(len(changes), np.nan)
    powers = np.zeros(len(changes))
    for i, row in enumerate(np.stack(rows, axis=1)):
        is_large = row > 10 * CLEARLY
        if is_large.any():
            k = max(np.argmax(is_large), 1)
            ratio = np.log(row[k] / max(row[k - 1], ROUNDING))
            powers[i] = ratio / np.log(sizes[k] / sizes[k - 1])
    return powers


class _Kind(NamedTuple):
    """What is small, what is conserved there besides invariants, a remedy, and a larger one."""

    small: str
    expansion: str
    remedy: str
    where: str
    condition: str = ""


_KINDS = {
    "step": _Kind(
        "the step is small",
        "an expansion in h",
        "a larger h",
        "at a step {} times as large",
        " (or H_D is made for this h)",
    ),
    "box": _Kind(
        "the samples lie close to their median",
        "an expansion about it",
        "samples that spread wider",
        "on samples {} times as far from it",
    ),
} | {
    x: _Kind(
        f"the samples of {x} lie close to their median, compared with those of {y}",
        "an expansion about it",
        f"samples whose {x} spread wider",
        "on samples {} times as far from it",
    )
    for x, y in ("qp", "pq")
}


class Larger(NamedTuple):
    """How many are conserved at a `factor` times larger "step", or on samples of which all
    coordinates ("box") or those of one kind ("q", "p") are so many times as far from their median;
    NaN if no larger one could be tried. `coordinates`: of a block that is searched alone, and
    `whole`: how many of its functions are conserved as given."""

    kind: str
    factor: float
    number: int
    coordinates: str = ""
    whole: int | None = None

    def warning(self, count: int) -> str | None:
        """Why `count` that are conserved at a small step, or in a small box, may not be exact."""
        count = count if self.whole is None else self.whole
        if self.number >= count:
            return None
        kind, block = _KINDS[self.kind], self.coordinates
        small = f"for {block} alone, {kind.small}" if block else kind.small
        if np.isnan(self.factor):
            return (
                f"{small}, and no larger one can be tried: an invariant cannot be distinguished "
                f"from {kind.expansion}; take {kind.remedy}"
            )
        return (
            f"{small}: {count} functions are conserved to rounding, and {self.number} of them "
            f"{kind.where.format(f'{self.factor:.2g}')}; each of the others is {kind.expansion}"
            f"{kind.condition}"
        )


def common_warnings(result: Any, remedy: str, subject: str) -> list[str]:
    """Reasons not to rely on a result; `remedy`: of an unclear gap; `subject`: what is sought."""
    reasons, count = [], result.survivors[0]
    if count and result.gap < CLEAR:
        reasons.append(f"the gap is not clear: {remedy}")
    if result.undecided:
        reasons.append(
            f"{result.undecided} {subject} cannot be decided in this arithmetic; take another h, "
            "samples that spread wider, or an origin among them"
        )
    return reasons + [text for larger in result.larger if (text := larger.warning(count))]


def growth_note(subject: str, power: float) -> list[str]:
    """The line of a report on a power that is not 0; `subject`: "changes grow"."""
    if not power > 0:
        return []
    return [
        f"      not exact: with the size of the samples {subject} as its power {power:.2g}, as "
        "those of an expansion about their middle do"
    ]


def in_equal_steps(
    samples: SamplePoints, h: float, step: DisplacementFunction, count: CountFunction
) -> tuple[SamplePoints, tuple[Larger, ...]]:
    """Samples of which a step moves q and p by similar shares of their spread, and how many are
    conserved there: where it moves one by far more than the other, they lie close to a curve, and
    all that changes slowly along it is conserved, or a step is small that moves one of them far."""
    steps = step(samples, h).relative_steps
    if not LEAST_STEP < steps.min() < steps.max() / _UNEQUAL:
        return samples, ()
    i, factor, wider = int(np.argmax(steps)), 1.0, samples
    while steps[i] > _SIMILAR * steps[1 - i] and factor < _LAST:
        factor *= float(np.sqrt(steps[i] / steps[1 - i]))
        wider = _stretch_one(samples, i, factor)
        steps = step(wider, h).relative_steps
        if not steps.min() > LEAST_STEP:
            return samples, ()

    def number(factor):
        return count(_stretch_one(samples, i, factor), h)

    larger = _larger("qp"[i], factor, number)
    return (samples if np.isnan(larger.factor) else wider), (larger,)


def _stretch_one(samples: SamplePoints, i: int, factor: float) -> SamplePoints:
    """The samples with only q (i = 0) or p (1) so many times as far from its median."""
    name = "qp"[i]
    return samples._replace(**{name: getattr(farther(samples, factor), name)})


def at_larger_step(
    samples: SamplePoints, h: float, step: DisplacementFunction, count: CountFunction
) -> tuple[Larger, ...]:
    """How many are conserved at a larger step; empty where the step is not small, so that an
    expansion in h would be seen."""
    ratio, relative = 1.0, step(samples, h).relative_step
    while relative < LEAST_STEP:  # or the map moves nothing at any step
        ratio *= 1e3
        if ratio > _LAST:
            return ()
        relative = step(samples, ratio * h).relative_step
    if ratio == 1 and not relative < SMALL:
        return ()
    factor = ratio * _MODERATE / relative if np.isfinite(relative) else ratio
    return (_larger("step", factor, lambda factor: count(samples, factor * h)),)


def in_larger_box(
    samples: SamplePoints,
    h: float,
    step: DisplacementFunction,
    count: CountFunction,
    is_constrained: bool = False,
) -> tuple[Larger, ...]:
    """How many are conserved on samples that spread wider; empty where a map is not nearly linear
    on those given, or linear on all."""

    def box(factor):
        return farther(samples, factor, is_constrained)

    nonlinearity, factor = step(samples, h).nonlinearity, _WIDEST
    if nonlinearity >= SMALL:
        return ()
    if nonlinearity >= _LINEAR:
        factor = min(_NONLINEAR / nonlinearity, _WIDEST)
    else:
        values = step(box(factor), h).values / factor
        if np.isfinite(values).all() and Displacements(samples, values).nonlinearity < _LINEAR:
            return ()
    return (_larger("box", factor, lambda factor: count(box(factor), h)),)


def _larger(kind: str, factor: float, count: Callable[[float], int | None]) -> Larger:
    while factor > _HARDLY:
        number = count(factor)
        if number is not None:
            return Larger(kind, factor, number)
        factor /= 10
    return Larger(kind, np.nan, 0)


def at_larger_sizes(
    samples: SamplePoints,
    h: float,
    step: DisplacementFunction,
    count: CountFunction,
    kinds: str = "equal step box",
    is_constrained: bool = False,
) -> tuple[Larger, ...]:
    """How many are conserved in equal steps of q and p, at a larger step and in a larger box; of
    these the `kinds`."""
    larger: tuple[Larger, ...] = ()
    if "equal" in kinds:
        samples, larger = in_equal_steps(samples, h, step, count)
    larger += at_larger_step(samples, h, step, count)
    if "box" in kinds:
        larger += in_larger_box(samples, h, step, count, is_constrained)
    return larger


def larger_of_block(
    number: int,
    samples: SamplePoints,
    h: float,
    step: DisplacementFunction,
    count: CountFunction,
    coordinates: str,
) -> tuple[Larger, ...]:
    """The same for some degrees of freedom with all others held, where `number` functions of them
    are conserved by the whole map."""
    if not number or (alone := count(samples, h)) is None:
        return ()
    if alone < number and step(samples, h).relative_step < SMALL:
        # Where their own motion does not show the same, it says nothing on a larger step.
        return (Larger("step", np.nan, 0, coordinates, number),)
    larger = at_larger_sizes(samples, h, step, count) if alone else ()
    whole = min(number, alone)
    return tuple(x._replace(coordinates=coordinates, whole=whole) for x in larger)
