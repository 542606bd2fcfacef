"""Adiabatic invariants as the null space of a linear system on the iterated map."""

import time
import warnings
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from ...base.checks import fraction, one_of, whole
from ...base.keywords import with_keywords_of
from ...integration.integrate import integrate
from ...methods.step import Equations
from ...problem.system import System, check_system
from ..algebra.motion import UNCLEAR, coefficient_errors, conserved, times, typical_sizes
from ..algebra.nullspace import (
    RANK,
    compress,
    epsilon_scale,
    in_units_of,
    series_spaces,
    singular_vectors,
    triangle,
)
from ..algebra.pair_series import ROUNDING, spaces_in_pairs, uses_pairs
from ..functions.basis import AbstractBasis, bind_basis, check_step_size
from ..functions.manifold import on_manifold
from ..functions.sampling import (
    TYPE_2,
    Samples,
    as_samples,
    check_basis,
    map_of,
    middle,
    relative_step,
    require_enough,
    require_time,
)
from .changes import Changes, Stepped, changes_at, checked_changes, is_exact, terms_in_pairs
from .digits import Conditions
from .energy import unconserved_energy
from .expansions import Larger, at_larger_step, in_larger_box, powers_of_size
from .found import Discovery
from .judging import CLEARLY, Fewest, Judge, cleaned, reach
from .obstructions import drift_laws
from .representatives import Span

# Coefficients are known up to this share of the largest, over the gap in singular values.
_FUZZY = 30.0
_FUZZIEST = 1e-3  # No larger shares than this are taken for errors of others
_AS_GOOD = 10.0  # An invariant with fewer terms may change by so many times more
_ROUND_OFF = 1e-12  # Changes below this need not be smaller
_RELIABLE = 6  # The largest order that float64 decides reliably


@with_keywords_of(integrate, f"{TYPE_2} method arithmetic")
def discover_invariants(
    system: System,
    basis: AbstractBasis,
    order: int = 0,
    *,
    h: float,
    samples: Any,
    tolerance: float | None = None,
    representative: Literal["least", "simplest"] = "least",
    **how: Any,
) -> Discovery:
    r"""Adiabatic invariants of order z in a basis of functions, found from the iterated map.

    With φ the basis, Φ_ε the map of one step, and A_m(q, p, t) the m-th Taylor coefficient in ε
    of φ(Φ_ε(q, p), t + h) − φ(q, p, t), the series Σ ε^m c_m·φ changes by O(ε^{z+1}) in a step
    exactly when

        Σ_{m≤k} A_{k−m} c_m = 0    for k = 0 … z

    at every point: a block-Toeplitz system, whose null space is found order by order by singular
    values on sampled points (basis made orthonormal on them first).

    For a system with ``slow_time=True`` the time of samples and basis is the slow time τ: a step
    goes from τ to τ + εh, and φ(q, p, τ) may change with it.

    **Arguments**

    - `basis`: for example ``Polynomials(6)``, ``Basis([f, g])``, sums and products of bases.
    - `order`: z ≥ 0. `h`: step size [time].
    - `samples`: (qs, ps) at t0, shapes (S, *q.shape), or (qs, ps, ts) with times of shape (S,):
      points of the domain of interest; a quarter is held out. At least twice as many as
      functions in the basis. With a constraint: consistent states. Functions that depend there on
      simpler ones (|γ|² γ₁ on γ₁, for a unit vector γ) are left out of the basis.
    - `tolerance`: for *approximate* invariants: singular values up to that share of the largest
      count as zero. What a method of order r conserves up to O(h^r), such as the energy, has
      singular values and residuals that shrink as h^r. None: only what is below 1e-11.
    - `representative`: an invariant of order z is unique only up to ε times any other invariant.
      "least" takes the corrections that are smallest on the samples (the convention of averaging:
      no component along what order 0 conserves), unless the simplest ones are exact; "simplest"
      takes those of simple functions, which tend to drift less and are easier to read.
    - the keywords `t0`, `args`, `method`, `root_finder`, `integrator`: as for
      `integrate`; only the map of one step is used. `arithmetic`: ``dvi.DoubleDouble()`` decides
      the null space with 30 digits (orders above 6); the default is ``dvi.FloatingPoint()``.

    **Returns** a `Discovery`; print it for a report.

    **Raises** `ValueError` for too few samples, samples or basis functions that are not
    finite there, a step that fails there, a basis that is rank-deficient on them, a basis or a
    map of time with samples of one time, a tolerance outside (0, 1) or in pairs, another
    arithmetic, or h = 0; `TypeError` for anything but a system, basis, method or root finder, and
    for samples without x64.

    **Accuracy** round-off of the singular values, times the conditioning of the basis; Taylor
    coefficients by nested forward autodiff, through implicit steps. Coefficients are float64.

    **Source** our own.

    **Example**

    ```python
    cubic = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2,
                       force=lambda t0, t1, q0, p1, args: -q0**3)
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 400, 1))
    found = dvi.discover_invariants(cubic, dvi.Polynomials(8), order=1, h=0.1, samples=samples,
                                    representative="simplest")
    print(found.invariants[0])
    # 0.5 q² − 0.05 q p + 0.5 p² + ε (0.251256 q⁴ − 0.0502513 q³ p + 0.00251256 q² p²)
    ```
    """
    began = time.perf_counter()
    check_system(system)
    one_step = map_of("discover_invariants", system, **how)
    samples = as_samples(samples, one_step.t0)
    order = whole("order", order, least=0)
    in_pairs = uses_pairs(one_step.arithmetic, tolerance)
    if order > _RELIABLE and not in_pairs:
        warnings.warn(
            f"order={order}: above order {_RELIABLE} rounding in float64 can hide an invariant, or "
            "add a false invariant to the result. Use arithmetic=dvi.DoubleDouble().",
            stacklevel=2,
        )
    if tolerance is not None:
        tolerance = fraction("tolerance", tolerance)
    one_of("representative", representative, ("least", "simplest"))
    bound, h = bind_basis(basis, samples.q.shape[1:]), check_step_size(h)
    require_enough(samples, bound.size)
    require_time(bound, samples)
    q, p, t = (jnp.asarray(x[0]) for x in samples)
    system.check_shapes(t, q, p, jnp.zeros(()), one_step.args)
    equations = Equations(system, jnp.zeros(()), one_step.args, one_step.root_finder)
    bound = on_manifold(equations, bound, samples)
    at = middle(samples, max(bound.complexity))
    inner, to_basis = bound.about(at)
    stepped = Stepped(equations, np.asarray(h), one_step.method, inner)
    changes = checked_changes(stepped, order, samples)
    terms = terms_in_pairs(stepped, order, samples) if in_pairs else None
    found = Search(stepped, changes, samples, order, tolerance, terms)
    chosen = found.best(representative)
    coefficients, dependent, exact = chosen.coefficients, chosen.dependent, chosen.exact
    errors = chosen.errors
    refused = found.spaces[-1].refused + chosen.refused
    known = found.count if order else len(coefficients) + len(dependent)
    larger: tuple[Larger, ...] = ()
    if tolerance is None and known:
        larger = _at_larger(stepped, changes, samples, order)
    energy = None if tolerance is not None else unconserved_energy(stepped, samples, found)
    known += found.constant is not None
    judge = found.judge
    typical_residuals = np.stack([judge.quantiles(coefficients, x) for x in (0.5, 0.95)], axis=-1)
    powers = np.full(len(coefficients), np.nan)
    if order == 0 and tolerance is None:
        # Where fewer are conserved in a larger box, growth is not from errors of coefficients.
        doubted = any(x.kind == "box" and x.conserved < found.count for x in larger)
        most, sizes = typical_residuals[:, 0, 1], found.judge_fitted.sizes(coefficients)
        columns = found.orthonormal * (not doubted)
        powers = powers_of_size(stepped, coefficients, samples, most, sizes, columns)
    everything = len(coefficients) == 2 * samples.q[0].size and not bound.uses_time
    everything = everything and not system.slow_time and bool(np.any(changes.motion.changes))
    # If so many are conserved each orbit is a finite set of points, or functions are periodic.
    impossible = everything and not (powers == 0).all()
    if impossible:
        refused, exact = refused + len(coefficients) + len(dependent), ()
        coefficients, dependent, errors = coefficients[:0], dependent[:0], errors[:0]
        typical_residuals, powers = typical_residuals[:0], powers[:0]
    volume = np.max(np.abs(in_units_of(found.scale, changes.volume)), axis=0)
    return Discovery(
        inner_coefficients=jnp.asarray(coefficients),
        inner_dependent=jnp.asarray(dependent),
        errors=errors,
        exact=exact,
        leading_parts=found.leading_parts @ to_basis,
        survivors=tuple(space.leading.shape[1] for space in found.spaces),
        singular_values=found.spaces[-1].singular_values,
        gap=found.gap,
        refused=refused,
        residuals=judge.quantiles(coefficients, 1.0),
        typical_residuals=typical_residuals,
        dependent_residuals=judge.quantiles(dependent, 1.0),
        undecided=max(found.motion.undecided() - known, 0) + found.unclear + chosen.unclear,
        impossible=impossible,
        larger=larger,
        powers=powers,
        reach=reach(coefficients, found.values),
        obstructions=drift_laws(found, volume, system.slow_time, chosen.blur),
        basis=bound,
        inner=inner,
        middle=at,
        to_basis=to_basis,
        sizes=found.sizes,
        condition=found.condition,
        scale=found.scale,
        probe=samples.at(slice(3)),
        shape=samples.q.shape[1:],
        slow_time=system.slow_time,
        tolerance=tolerance,
        energy=energy,
        seconds=time.perf_counter() - began,
    )


def _at_larger(stepped: Stepped, changes, samples: Samples, order: int) -> tuple[Larger, ...]:
    """How many are conserved at a larger step and, at order 0, in a larger box."""
    h = float(stepped.h)

    def changes_of(step, at):
        if step == h and at is samples:
            return changes
        return changes_at(stepped._replace(h=np.asarray(step)), 0, at)

    def count(step, at=samples):
        found = changes_at(stepped._replace(h=np.asarray(step)), 0, at)
        return Search(stepped, found, at, 0, None).count if found.good.all() else None

    def moved(at, step=h):
        return changes_of(step, at).moved[:, :-1]

    larger = at_larger_step(h, lambda step: relative_step(samples, moved(samples, step)), count)
    if order == 0:
        larger += in_larger_box(samples, moved, lambda at: count(h, at), stepped.is_constrained)
    return larger


class _Chosen(NamedTuple):
    """Representatives, shape (count, order + 1, size), and errors of the independent ones; how many
    were refused, and how many of those are unclear; the blur."""

    coefficients: np.ndarray
    dependent: np.ndarray
    errors: np.ndarray
    exact: tuple[bool, ...]
    refused: int
    unclear: int
    blur: float


class Search:
    """The null space of a search, in functions that are orthonormal on the fitted samples:
    singular values then measure functions, not their scaling."""

    def __init__(
        self, stepped: Stepped, changes: Changes, samples: Samples, order, tolerance, pairs=None
    ):
        self.stepped, self.order, self.tolerance = stepped, order, tolerance
        basis, fit = stepped.basis, ~samples.held_out
        self.basis, self.fitted = basis, samples.at(fit)
        self.rms, calm = typical_sizes(changes.values)
        self.fitted_values, self.calm = changes.values[fit], calm[fit]
        self.values = calm[fit, None] * self.fitted_values
        self.condition = check_basis(basis, self.values)
        self.R = triangle(self.values / self.rms) / np.sqrt(len(self.values))
        terms = np.linalg.solve(self.R.T, (changes.terms / self.rms).reshape(-1, basis.size).T)
        terms = terms.T.reshape(changes.terms.shape)
        self.orthonormal = np.linalg.inv(self.R) / self.rms[:, None]
        self.motion = changes.motion.of(self.orthonormal)
        weights = self.motion.weights()
        self.scale = epsilon_scale(weights[fit, None, None] * terms[fit])
        terms = in_units_of(self.scale, terms)
        self.sizes = self.rms / self.scale ** np.arange(order + 1)[:, None]
        self.slopes = changes.slopes[fit, :, :-1]
        self.constant = _shares_of_constant(self.rms, self.values, calm[fit], self.slopes)
        self.weights, self.rows = weights[fit], weights[fit, None, None] * terms[fit]

        def judge(leading, shifts):
            leading, unclear = conserved(leading, terms, self.motion, tolerance)
            return leading, shifts, unclear

        trivial = None if self.constant is None else self.R @ self.constant
        compressed = compress(self.rows)
        if pairs is None:
            self.spaces, self.undecided = series_spaces(compressed, judge, tolerance, trivial), 0
        else:
            rounding = ROUNDING / np.finfo(float).eps
            self.motion = self.motion._replace(rounding=rounding * self.motion.rounding)
            errors = rounding * changes.motion.rounding
            self.spaces, self.undecided = spaces_in_pairs(
                pairs, self.scale, self.orthonormal, self.motion.weights(), ~fit, errors, trivial
            )
        self.conditions = Conditions.of(times(compressed, self.R))
        step = triangle(calm[fit, None] * terms[fit, 0]) / np.sqrt(len(self.values))
        self.typical = np.linalg.norm(step, 2) or 1.0
        in_units = changes._replace(terms=in_units_of(self.scale, changes.terms))
        digits = coefficient_errors(terms)
        self.judge, self.judge_fitted = (
            Judge(in_units.at(some), calm[some], self.scale, digits[some], tolerance is not None)
            for some in (~fit, fit)
        )
        of_fit = changes.terms[fit, 0], changes.motion.at(fit), self.values
        self.fewest = Fewest(basis.complexity, self.rms, *of_fit)

    @property
    def count(self) -> int:
        """How many are conserved at order 0."""
        return self.spaces[0].leading.shape[1]

    @property
    def gap(self) -> float:
        return self.spaces[-1].gap

    @property
    def leading_parts(self) -> np.ndarray:
        """Order 0 of everything in the null space, in functions of the basis, (count, size)."""
        leading = self.spaces[-1].leading[: self.basis.size]
        return (np.linalg.solve(self.R, leading) / self.rms[:, None]).T

    def best(self, representative: str) -> _Chosen:
        """The choice by which fewer series are rejected."""
        # Null vectors are known up to a share of about 1 / gap.
        fuzzy = min(_FUZZY / self.gap, _FUZZIEST)
        if self.tolerance is not None:
            return self.chosen(max(RANK, np.sqrt(self.tolerance)), representative)
        chosen = self.chosen(max(RANK, fuzzy), representative)
        if chosen.refused and fuzzy > RANK:
            chosen = min(self.chosen(RANK, representative), chosen, key=lambda x: x.refused)
        return chosen

    def chosen(self, blur: float, representative: str) -> _Chosen:
        """One series for each leading-order term, in functions of the basis; `blur`: see `Span`."""
        span = Span(self.basis, self.rms, self.R, self.spaces[-1], blur, self.constant)
        found = span.representatives(self.fitted, self.slopes)
        picked = [(*self._picked(span, series, representative), free) for series, free in found]
        size = self.order + 1, self.basis.size

        def those(independent):
            kept = [(c, exact) for c, exact, f in picked if f == independent]
            series = [_normalised(c, self.rms) for c, _ in kept]
            return np.array(series).reshape(-1, *size), np.array([e for _, e in kept], bool)

        (coefficients, exact), (dependent, _) = those(True), those(False)
        refused, unclear = 0, 0
        if self.tolerance is None:  # with the digits that the coefficients have in the end
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
        errors = [self.conditions.errors(c * self.sizes, self.tolerance) for c in coefficients]
        errors = np.array(errors).reshape(coefficients.shape) / self.sizes
        return _Chosen(coefficients, dependent, errors, exact, refused, unclear, blur)

    def _picked(
        self, span: Span, series: np.ndarray, representative: str
    ) -> tuple[np.ndarray, bool]:
        """Coefficients, shape (order + 1, size), and whether the series is exact."""
        if self.order == 0:
            shares = self._of_order_0(series[0], span.blur)[None]
            return self._without_rounding(shares) / self.sizes, False
        simplest = self._without_rounding(cleaned(span.simplest(series))) / self.sizes
        given, *sizes = map(jnp.asarray, (simplest, self.typical, self.scale))
        some = slice(None, None, max(1, len(self.fitted.q) // 100))
        at = self.fitted.at(some)
        exact = bool(is_exact(self.stepped.unnamed(), given, sizes, at))
        if exact or representative == "simplest":
            return simplest, exact
        return self._without_rounding(cleaned(span.least(series))) / self.sizes, exact

    def _without_rounding(self, shares: np.ndarray) -> np.ndarray:
        if self.tolerance is not None:
            return shares
        return self.conditions.without_rounding(
            shares, lambda tried: self.judge.largest((tried / self.sizes)[None])[0]
        )

    def _of_order_0(self, series: np.ndarray, blur: float) -> np.ndarray:
        """Shares of an invariant of order 0, with as few terms and as many digits as can be."""
        if self.tolerance is not None:
            return cleaned(series, blur)

        def change(shares):
            return self.judge.largest((shares / self.sizes[0])[None, None])[0]

        tried = [cleaned(self.fewest.again(cleaned(series, blur)), blur)]
        if blur > RANK:  # what was taken for errors of others may be a part of it
            tried += [self.fewest.again(cleaned(series)), cleaned(series)]
        tried = [x for x in tried if x.any()] or [series]
        changes = np.array([change(x) for x in tried])
        if np.min(changes) > CLEARLY:  # rows weighted by what its own slopes predict
            rows = self.judge_fitted.own_rows(series / self.sizes[0]) / self.rms
            singular, V = singular_vectors(rows)
            null = V[singular <= CLEARLY * np.sqrt(len(rows))]
            own = null.T @ (null @ series)
            tried = [x for x in (cleaned(own, blur), own, *tried) if x.any()]
            changes = np.array([change(x) for x in tried])
        good = changes <= max(_AS_GOOD * np.min(changes), _ROUND_OFF)
        return tried[int(np.argmax(good))]

    @property
    def unclear(self) -> int:
        """Null vectors of which rounding decides whether they are series."""
        unclear = max(space.unclear for space in self.spaces) + self.undecided
        return unclear if self.tolerance is None else 0


def _shares_of_constant(rms, values, calm, slopes) -> np.ndarray | None:
    """The combination that is 1 everywhere (and not only on these samples), if there is one.

    `values`: of the functions, times the weights `calm` of the samples.
    """
    shares = np.linalg.lstsq(values / rms, calm, rcond=None)[0]
    shares = np.where(np.abs(shares) > 1e-9 * np.max(np.abs(shares)), shares, 0.0)
    terms = np.abs(values / rms) @ np.abs(shares)
    terms = np.maximum(terms, np.finfo(float).tiny)
    if np.max(np.abs(values / rms @ shares - calm) / terms) > 1e4 * np.finfo(float).eps:
        return None
    slopes = slopes / rms[:, None]
    terms = np.abs(slopes) * np.abs(shares)[:, None]
    sums = np.einsum("sbn,b->sn", slopes, shares)
    return shares if np.max(np.abs(sums)) <= 1e-9 * np.max(terms, initial=1.0) else None


def _normalised(series: np.ndarray, rms: np.ndarray) -> np.ndarray:
    """Scaled so that the coefficient with the largest share is one half, as of an energy."""
    return series / (2 * series[0, np.argmax(np.abs(series[0] * rms))])
