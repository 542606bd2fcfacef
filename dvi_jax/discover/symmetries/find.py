"""Symmetries as the null space of the determining equations on the iterated map."""

from dataclasses import replace
from typing import Any, Unpack

import jax.numpy as jnp
import numpy as np

from ...base.checks import fraction, whole
from ...base.keywords import checked_keywords
from ...integration.keywords import MapSettings
from ...problem.system import System, check_system
from ..algebra.nullspace import independent_columns, triangle
from ..algebra.weighing import typical_sizes
from ..functions import sampling
from ..functions.basis import AbstractBasis, Basis, BoundBasis, Product, Sum, bind_basis
from ..functions.families import TIME, Polynomials, coordinate_names
from ..functions.sampling import SamplePoints, later, require_times, values_at
from ..invariants.expansions import at_larger_step, in_larger_box, larger_samples
from .blocks import larger_of_blocks
from .conditions import Conditions, at_samples, require_finite_conditions
from .search import SymmetrySearch, rows_of
from .symmetry import Symmetries

_NO_STEP = 1e-13  # A step that moves the samples by less, relative to their spread, is rounding


@checked_keywords
def find_symmetries(
    system: System,
    basis: AbstractBasis,
    order: int = 0,
    *,
    h: float,
    samples: Any,
    gauges: AbstractBasis | None = None,
    time: bool = True,
    tolerance: float | None = None,
    **settings: Unpack[MapSettings],
) -> Symmetries:
    r"""Search for symmetries of order z of the perturbed discrete equations, in a basis.

    Every component of every X_m, m = 0 … z, is a combination of the basis functions φ(q, p, t).
    With Φ_ε the map (12)–(13), the determining equations

        Σ_m ε^m pr X_m(F)(z, Φ_ε(z)) = O(ε^{z+1})

    are linear in the coefficients of these combinations. Their Taylor coefficients in ε at sampled
    points z = (q, p) are a block-Toeplitz system. A singular value decomposition gives its null
    space, in a basis that is orthonormal on the samples. On F = 0 this condition is sufficient: a
    smooth conformal factor then exists at each point (see `conformal_factor`).

    A symmetry is variational if it satisfies Noether's identity with some gauge. On solutions *any*
    X with ξ0 = 0 does, with G = −ξ·p. Therefore the criterion is that Σ ε^m N_m and its first
    derivatives with respect to q1 and p0 vanish for states that are not solutions, too (X is then
    variational up to a trivial symmetry). If ξ0 = 0, X is then the Hamiltonian vector field of its
    invariant ξ·p + G. All other symmetries are conformal only.

    **Arguments**

    - `basis`: with constants for translations: ``Polynomials(2, constant=True)``.
    - `order`: z ≥ 0. `h`: step size [time].
    - `samples`: (qs, ps) at t0, shapes (S, *q.shape), in the domain of interest; or (qs, ps, ts)
      with their times, shape (S,), if the basis or the system depends on t. A quarter is held out.
    - `gauges`: basis of the gauges; None for φ times 1 and each coordinate, all quadratic
      polynomials, and t.
    - `time`: whether ξ0 may be nonzero. A ξ0 that depends on the point changes h.
    - `tolerance`: relative singular value below which a vector is null; None for those below the
      widest gap, at most 1e-11 of the typical residual of vector fields, or rounding.
    - the keywords `t0`, `args`, `root_finder`, `integrator`: as for `integrate`; the
      map is that of `TypeII()`.

    **Returns** `Symmetries`; print it for a report. t in the basis is the time, also of a system
    with ``slow_time=True``.

    **Raises** `ValueError` for too few samples, or samples of one time where basis or map depend
    on it; where functions are not finite on them, rank-deficient, or the step fails; for h = 0, an
    order below 0, a tolerance outside (0, 1). `TypeError` for anything but a basis.

    **Accuracy** round-off of the singular values, times the conditioning of the basis; Taylor
    coefficients by nested forward autodiff, through implicit steps.

    **Source** the paper's (17), (24) and (28), collected in ε on the perturbed map; the null
    space and the test off the solutions are our own (trivial symmetries: Olver 1993, Section
    5.1; symmetries of difference equations: Hydon 2014).

    **Example**

    ```python
    cubic = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2 + (q0 @ q0) ** 2 / 4)
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 200, 2))
    found = dvi.find_symmetries(cubic, dvi.Polynomials(1), h=0.1, samples=samples, time=False)
    print(found)
    # 1 symmetry of order 0 in 4 functions for each component: 1 variational, 0 conformal only…
    #   ξ_q1 = q2, ξ_q2 = −q1, η_p1 = p2, η_p2 = −p1…
    ```
    """
    order = whole("order", order, low=0)
    if tolerance is not None:
        tolerance = fraction("tolerance", tolerance)
    check_system(system, "find_symmetries")
    one_step = sampling.map_of("find_symmetries", system, settings)
    samples, h = sampling.as_samples(samples, one_step.t0), sampling.check_step_size(h)
    shape = samples.q.shape[1:]
    bound = bind_basis(basis, shape)
    gauge_basis = bind_basis(_default_gauges(basis, shape) if gauges is None else gauges, shape)
    user_bases = (bound,) if gauges is None else (bound, gauge_basis)
    require_times(any(basis.uses_time for basis in user_bases), samples)
    centre = sampling.middle(samples, max(gauge_basis.complexity))
    bound, gauge_basis = bound.recentre(centre, exactly=True)[0], gauge_basis.recentre(centre)[0]
    n = int(np.prod(shape, dtype=int))
    sampling.require_enough(samples, (2 * n + bool(time)) * bound.size, 2 * n)
    sampling.require_enough(samples, gauge_basis.size, 1 + 2 * n)
    equations = one_step.equations(system, samples)
    for functions in (bound,) if gauges is None else (bound, gauge_basis):
        values = values_at(functions, samples)
        sampling.check_finite(functions, values)
        sampling.check_basis(functions, typical_sizes(values)[1][:, None] * values)
    unnamed_bases = bound.without_names(), gauge_basis.without_names()

    def conditions(shifts, points=samples, step=h, order=order):
        arrays = at_samples(equations, jnp.asarray(step), *unnamed_bases, order, points, shifts)
        return Conditions(*map(np.asarray, arrays))

    shifts = later(h)
    raw = conditions(shifts)
    sampling.require_steps(raw.good[:, 0] == 1, samples)
    require_finite_conditions(raw)
    relative = raw.displacements(samples).relative_step
    if relative < _NO_STEP:
        raise ValueError(
            f"one step must change the samples by at least {_NO_STEP:g} times their spread, got "
            f"{relative:.0e} for h = {h:g}: take a larger |h|, or samples away from equilibria."
        )
    if relative < sampling.SMALL and np.ptp(samples.t) == 0:
        shifts = later(h, relative)
        raw = conditions(shifts)
    require_times(raw.depends_on_time(samples, h, shifts[-1]), samples, "the map")
    gauge_places = _independent_gauges(gauge_basis, raw, samples, h)
    bases = bound, gauge_basis.select(gauge_places)

    def search(raw, points=samples, step=h):
        raw = raw._replace(gauge=raw.gauge[..., gauge_places])
        return SymmetrySearch(raw, points, step, bool(time), bases, tolerance)

    original = search(raw)
    symmetries = original.result()
    if not symmetries.count or tolerance is not None:
        return symmetries

    def displacements(points, step):
        is_original = points is samples and step == h
        return (raw if is_original else conditions(shifts, points, step)).displacements(points)

    def of_order_0(points, step):
        return conditions(shifts, points, step, order=0)

    def count(points, step):
        larger = of_order_0(points, step)
        return search(larger, points, step).count if larger.all_good else None

    larger = at_larger_step(samples, h, displacements, count)
    larger += larger_of_blocks(original, raw, samples, h, of_order_0)
    if order > 0:
        return replace(symmetries, larger=larger)
    points, factors = larger_samples(samples)
    powers = original.powers(symmetries, conditions(shifts, points), factors)
    larger += in_larger_box(samples, h, displacements, count)
    return replace(symmetries, powers=powers, larger=larger)


def _default_gauges(basis: AbstractBasis, shape: tuple[int, ...]) -> AbstractBasis:
    """The functions times 1 and the coordinates, all quadratic polynomials, and t."""
    variables = coordinate_names(shape) + ("t",) * bind_basis(basis, shape).uses_time

    def products(basis):
        match basis:
            case Polynomials():
                return Polynomials(basis.degree + 1, variables, constant=True)
            case Sum():
                return products(basis.first) + products(basis.second)
            case Product(second=Polynomials()):
                return basis.first * products(basis.second)
            case Product(first=Polynomials()):
                return products(basis.first) * basis.second
        return basis * Polynomials(1, variables, constant=True)

    return Polynomials(2, variables) + _CLOCK + products(basis)


# One object, made once: with a new function in each search, each would compile its programs again.
_CLOCK = Basis({TIME[0]: lambda q, p, t: t})


def _independent_gauges(basis: BoundBasis, raw: Conditions, samples: SamplePoints, h: float):
    """Numbers of the gauge functions that are not constant and do not depend on simpler ones."""
    units = np.append(abs(h), sampling.spreads(samples))
    typical = typical_sizes(values_at(basis, samples))[0]
    rows = raw.gauge[~samples.held_out, 0] * units[:, None]
    rows = rows / np.where(typical > 0, typical, abs(h))
    length = np.linalg.norm(rows, axis=(1, 2), keepdims=True)
    columns = triangle(rows_of(rows / np.where(length > 0, length, 1)))
    size = np.linalg.norm(columns, axis=0)
    columns = np.where(size > 1e-12 * np.max(size), columns, 0.0)
    return independent_columns(columns, basis.complexity, 1e-9)
