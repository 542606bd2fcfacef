"""Adiabatic invariants as the null space of a linear system on the iterated map."""

import time
import warnings
from typing import Any, Literal, Unpack

import jax.numpy as jnp
import numpy as np

from ...base.checks import fraction, one_of, whole
from ...base.keywords import checked_keywords, user_level
from ...integration.keywords import ArithmeticSettings
from ...problem.system import System, check_system
from ..algebra.nullspace import in_units_of
from ..algebra.pair_series import uses_pairs
from ..functions import sampling
from ..functions.basis import AbstractBasis, bind_basis, check_step_size
from ..functions.manifold import on_manifold
from ..functions.sampling import Displacements, SamplePoints
from .blocks import Block, BlockSearch, blocks_of, search_block
from .changes import Changes, StepMap, checked_changes, terms_in_pairs
from .choice import chooser
from .discovery import Discovery
from .energy import unconserved_energy
from .expansions import Larger, at_larger_sizes, larger_of_block, powers_of_size
from .judging import reach
from .obstructions import drift_laws
from .search import NullSpaces, null_spaces

_RELIABLE = 6  # The largest order that float64 decides reliably


@checked_keywords
def discover_invariants(
    system: System,
    basis: AbstractBasis,
    order: int = 0,
    *,
    h: float,
    samples: Any,
    tolerance: float | None = None,
    representative: Literal["least", "simplest"] = "least",
    **settings: Unpack[ArithmeticSettings],
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

    **Raises** `ValueError` for too few samples, or samples of one time where basis or map depend
    on it; where functions are not finite on them, rank-deficient, or the step fails; for h = 0, a
    tolerance outside (0, 1) or in pairs, another arithmetic. `TypeError` for objects of another
    type, and without x64.

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
    start = time.perf_counter()
    check_system(system)
    one_step = sampling.map_of("discover_invariants", system, settings, "method", "arithmetic")
    samples = sampling.as_samples(samples, one_step.t0)
    order = whole("order", order, low=0)
    in_pairs = uses_pairs(one_step.arithmetic, tolerance)
    if order > _RELIABLE and not in_pairs:
        warnings.warn(
            f"order={order}: above order {_RELIABLE} rounding in float64 can hide an invariant, or "
            "add a false invariant to the result. Use arithmetic=dvi.DoubleDouble().",
            stacklevel=user_level(),
        )
    if tolerance is not None:
        tolerance = fraction("tolerance", tolerance)
    one_of("representative", representative, ("least", "simplest"))
    bound, h = bind_basis(basis, samples.q.shape[1:]), check_step_size(h)
    sampling.require_enough(samples, bound.size)
    sampling.require_times(bound.uses_time, samples)
    equations = one_step.equations(system, samples)
    bound = on_manifold(equations, bound, samples)
    centre = sampling.middle(samples, max(bound.complexity))
    inner, to_basis = bound.recentre(centre)
    step_map = StepMap(equations, np.asarray(h), one_step.method, inner)
    changes = checked_changes(step_map, order, samples)
    terms = terms_in_pairs(step_map, order, samples) if in_pairs else None
    apart, weak = blocks_of(changes) if tolerance is None else ([], [])
    blocks = [search_block(block) for block in apart]
    filters = () if in_pairs else [block.without_false for block in blocks]
    null = null_spaces(changes, tolerance, terms, filters)
    representatives = chooser(null)
    choice, judge = representatives.best(representative), representatives.judge
    coefficients, dependent = choice.coefficients, choice.dependent
    count = null.count if order else len(coefficients) + len(dependent)
    larger = _of_weak_blocks(weak, null)
    if tolerance is None and count:
        larger += _at_larger(changes, order, blocks)
    count += null.constant is not None
    residuals = np.stack([judge.quantiles(coefficients, x) for x in (0.5, 0.95)], axis=-1)
    powers = np.full(len(coefficients), np.nan)
    if order == 0 and tolerance is None:
        # Where fewer are conserved in a larger box, growth is not from errors of coefficients.
        is_expansion = any(x.kind == "box" and x.number < null.count for x in larger)
        columns = null.conditions.orthonormal * (not is_expansion)
        sizes = representatives.judge_fitted.sizes(coefficients)
        powers = powers_of_size(changes, coefficients, residuals[:, 0, 1], sizes, columns)
    moves = bool(np.any(changes.motion.changes)) and not (bound.uses_time or system.slow_time)
    # If so many are conserved each orbit is a finite set of points, or functions are periodic.
    impossible = moves and len(coefficients) == 2 * samples.q[0].size and not (powers == 0).all()
    rejections = null.spaces[-1].rejections + choice.rejections
    if impossible:
        rejections += len(coefficients) + len(dependent)
        coefficients, dependent = coefficients[:0], dependent[:0]
    number, scale = len(coefficients), null.conditions.scale
    unclear = sum(block.unclear for block in blocks)
    if not blocks:
        unclear = max(null.conditions.motion.unclear_count() - count, 0)
    unclear += null.unclear + choice.unclear
    volume = np.max(np.abs(in_units_of(scale, changes.volume)), axis=0)
    parts = null.conditions.orthonormal @ null.spaces[-1].leading[: inner.size]
    return Discovery(
        inner_coefficients=jnp.asarray(coefficients),
        inner_dependent=jnp.asarray(dependent),
        errors=choice.errors[:number],
        exact=choice.exact[:number],
        leading_parts=parts.T @ to_basis,
        survivors=tuple(space.leading.shape[1] for space in null.spaces),
        singular_values=null.spaces[-1].singular_values,
        gap=null.spaces[-1].gap,
        refused=rejections,
        residuals=judge.quantiles(coefficients, 1.0),
        typical_residuals=residuals[:number],
        dependent_residuals=judge.quantiles(dependent, 1.0),
        undecided=unclear,
        impossible=impossible,
        larger=larger,
        powers=powers[:number],
        reach=reach(coefficients, null.values),
        obstructions=drift_laws(null, volume, system.slow_time, choice.blur),
        basis=bound,
        inner=inner,
        middle=centre,
        to_basis=to_basis,
        sizes=null.sizes,
        condition=null.condition,
        scale=scale,
        probe=samples.subset(slice(3)),
        shape=samples.q.shape[1:],
        slow_time=system.slow_time,
        tolerance=tolerance,
        energy=unconserved_energy(null) if tolerance is None else None,
        seconds=time.perf_counter() - start,
    )


def _at_larger(changes: Changes, order: int, blocks: list[BlockSearch]) -> tuple[Larger, ...]:
    """How many are conserved at a larger step and, at order 0, in a larger box: of all functions
    and of those of each block."""
    samples, h = changes.samples, float(changes.step_map.h)

    def recompute(points: SamplePoints, step: float) -> Changes:
        return changes if points is samples and step == h else changes.recompute(points, step)

    is_constrained = changes.step_map.is_constrained
    larger = _larger_of(samples, h, recompute, not blocks, order == 0, is_constrained)
    for search in blocks:
        block, count = search.block, search.null.count
        if count:
            of_block = _larger_of(block.samples, h, block.recompute)
            larger += tuple(x._replace(coordinates=block.text, whole=count) for x in of_block)
    return larger


def _of_weak_blocks(blocks: list[Block], null: NullSpaces) -> tuple[Larger, ...]:
    """The same for blocks that are coupled weakly, with all others held."""
    larger: tuple[Larger, ...] = ()
    for block in blocks:
        number = block.number_inside(null.spaces[0].leading, null.conditions)
        h = float(block.whole.step_map.h)
        tests = _tests(block.recompute)
        larger += larger_of_block(number, block.samples, h, *tests, block.text)
    return larger


def _larger_of(samples, h: float, recompute, equal=True, boxes=True, is_constrained=False):
    """The same for functions whose `Changes` are recompute(samples, h)."""
    kinds = "step" + " box" * boxes + " equal" * (boxes and equal and not is_constrained)
    return at_larger_sizes(samples, h, *_tests(recompute), kinds, is_constrained)


def _tests(recompute):
    """The displacements of a step, and how many functions are conserved."""

    def displacements(points: SamplePoints, step: float) -> Displacements:
        return recompute(points, step).displacements

    def count(points: SamplePoints, step: float) -> int | None:
        other = recompute(points, step)
        return null_spaces(other).count if other.good.all() else None

    return displacements, count
