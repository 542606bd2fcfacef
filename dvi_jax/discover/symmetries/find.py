"""Symmetries as the null space of the determining equations on the iterated map."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ...base.checks import fraction, whole
from ...base.keywords import with_keywords_of
from ...integration.integrate import integrate
from ...methods.step import Equations
from ...problem.system import System, check_system
from ..algebra.motion import typical_sizes
from ..algebra.nullspace import triangle
from ..functions.basis import (
    AbstractBasis,
    Basis,
    BoundBasis,
    Product,
    Sum,
    bind_basis,
    check_step_size,
)
from ..functions.families import TIME, Polynomials, coordinate_names
from ..functions.sampling import (
    SMALL,
    TYPE_2,
    Samples,
    as_samples,
    check_basis,
    check_finite,
    later,
    map_of,
    middle,
    require_enough,
    require_steps,
    require_time,
    spreads,
)
from ..invariants.expansions import at_larger_step, enlarged, in_larger_box
from .conditions import Conditions, at_samples, require_finite_conditions, require_times, values_at
from .found import Symmetries
from .search import rows_of, weigh_conditions

# A step that moves the samples by less than this share of their spread is rounding.
_NO_STEP = 1e-13


@with_keywords_of(integrate, TYPE_2)
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
    **how: Any,
) -> Symmetries:
    r"""The symmetries of order z of the perturbed discrete equations that a basis can express.

    Every component of every X_m, m = 0 … z, is a combination of the basis functions φ(q, p, t).
    With Φ_ε the map (12)–(13), the determining equations

        Σ_m ε^m pr X_m(F)(z, Φ_ε(z)) = O(ε^{z+1})

    are linear in its coefficients; their Taylor coefficients in ε at sampled points z = (q, p)
    are a block-Toeplitz system, whose null space is found by singular values (the basis made
    orthonormal on the samples first). On F = 0 this condition is sufficient: a smooth pointwise
    conformal factor then exists (see `conformal_factor`).

    A symmetry is variational when a gauge closes Noether's identity. On the solutions *any* X
    with ξ0 = 0 closes it, by G = −ξ·p; the criterion is that the identity Σ ε^m N_m and its first
    derivatives with respect to q1 and p0 vanish off the solutions (then X is variational up to a
    trivial symmetry). For ξ0 = 0 that means: X is the Hamiltonian vector field of its invariant
    ξ·p + G. The others are conformal only.

    **Arguments**

    - `basis`: with constants for translations: ``Polynomials(2, constant=True)``.
    - `order`: z ≥ 0. `h`: step size [time].
    - `samples`: (qs, ps) at t0, shapes (S, *q.shape), points of the domain of interest, or (qs,
      ps, ts) with their times, shape (S,), where basis or system depend on t. A quarter is held
      out.
    - `gauges`: basis of the gauges; None for φ times 1 and each coordinate, all quadratic
      polynomials, and t.
    - `time`: whether ξ0 is sought too. Where it depends on the point it changes h.
    - `tolerance`: relative singular value below which a vector is null; None for those below the
      widest gap, at most 1e-11 of the typical residual of vector fields, or rounding.
    - the keywords `t0`, `args`, `root_finder`, `integrator`: as for `integrate`; the
      map is that of `TypeII()`.

    **Returns** `Symmetries`; print it for a report. t in the basis is the time, also of a system
    with ``slow_time=True``.

    **Raises** `ValueError` for too few samples, samples or functions that are not finite, a step
    that fails on them, a basis that is rank-deficient on them, samples of one time where basis or
    system depend on t, an order below 0, a tolerance outside (0, 1), or h = 0; `TypeError` for
    anything but a basis.

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
    one_step = map_of("find_symmetries", system, **how)
    samples, h = as_samples(samples, one_step.t0), check_step_size(h)
    shape = samples.q.shape[1:]
    bound = bind_basis(basis, shape)
    require_time(bound, samples)
    gauge_basis = bind_basis(_enlarged(basis, shape) if gauges is None else gauges, shape)
    at = middle(samples, max(gauge_basis.complexity))
    bound, gauge_basis = bound.about(at, exactly=True)[0], gauge_basis.about(at)[0]
    if gauges is not None:
        require_time(gauge_basis, samples)
    n = int(np.prod(shape, dtype=int))
    require_enough(samples, (2 * n + bool(time)) * bound.size, 2 * n)
    require_enough(samples, gauge_basis.size, 1 + 2 * n)

    q, p, t = (jnp.asarray(x[0]) for x in samples)
    system.check_shapes(t, q, p, jnp.zeros(()), one_step.args)
    equations = Equations(system, jnp.zeros(()), one_step.args, one_step.root_finder)
    for one in (bound, gauge_basis) if gauges is not None else (bound,):
        values = values_at(one, samples)
        check_finite(one, values)
        check_basis(one, typical_sizes(values)[1][:, None] * values)

    functions = bound.unnamed(), gauge_basis.unnamed()

    def conditions(shifts, at=samples, step=h, order=order):
        found = at_samples(equations, jnp.asarray(step), *functions, order, at, shifts)
        return Conditions(*map(np.asarray, found))

    shifts = later(h)
    raw = conditions(shifts)
    require_steps(raw.good[:, 0] == 1, samples)
    require_finite_conditions(raw)
    relative = raw.displacements(samples).relative_step
    if relative < _NO_STEP:
        raise ValueError(
            f"one step must change the samples by at least {_NO_STEP:g} times their spread, got "
            f"{relative:.0e} for h = {h:g}. Smaller changes are close to round-off, so that "
            "symmetries cannot be identified. Take a larger |h|, or samples away from equilibria."
        )
    if relative < SMALL and np.ptp(samples.t) == 0:
        shifts = later(h, relative)
        raw = conditions(shifts)
    require_times(raw, samples, h, shifts[-1])
    independent, places = _independent_gauges(gauge_basis, raw, samples, h)
    raw = raw._replace(gauge=raw.gauge[..., places])
    kind = bool(time), bound, independent, tolerance
    search = weigh_conditions(raw, samples, h, *kind)
    found = search.result()
    if not found.count or tolerance is not None:
        return found

    def count(step, at=samples):
        raw = conditions(shifts, at, step, order=0)
        raw = raw._replace(gauge=raw.gauge[..., places])
        if not all(np.isfinite(x).all() for x in raw) or not raw.good[:, 0].all():
            return None
        return weigh_conditions(raw, at, step, *kind).spaces()[0].leading.shape[1]

    displacements = raw.displacements(samples)

    def steps(step):
        return displacements if step == h else conditions(shifts, step=step).displacements(samples)

    powers, larger = found.powers, at_larger_step(h, steps, count)
    if order == 0:
        at, which = enlarged(samples)
        powers = search.powers(found, conditions(shifts, at), which)
        larger += in_larger_box(
            displacements,
            lambda samples: conditions(shifts, samples).displacements(samples),
            lambda samples: count(h, samples),
        )
    return replace(found, powers=powers, larger=larger)


def _enlarged(basis: AbstractBasis, shape: tuple[int, ...]) -> AbstractBasis:
    """The functions times 1 and the coordinates, all quadratic polynomials, and t."""
    timed = bind_basis(basis, shape).uses_time
    variables = coordinate_names(shape) + (("t",) if timed else ())

    def raised(basis):
        match basis:
            case Polynomials():
                return Polynomials(basis.degree + 1, variables, constant=True)
            case Sum():
                return raised(basis.first) + raised(basis.second)
            case Product(second=Polynomials()):
                return basis.first * raised(basis.second)
            case Product(first=Polynomials()):
                return raised(basis.first) * basis.second
        return basis * Polynomials(1, variables, constant=True)

    return Polynomials(2, variables) + _CLOCK + raised(basis)


# One object, made once: with a new function in each search, each would compile its programs again.
_CLOCK = Basis({TIME[0]: lambda q, p, t: t})


class _Chosen(eqx.Module):
    basis: BoundBasis
    places: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, q, p, t):
        return self.basis(q, p, t)[np.array(self.places, int)]


def _independent_gauges(basis: BoundBasis, raw: Conditions, samples: Samples, h: float):
    """The gauge functions without constants and those that depend on simpler ones, and their
    places."""
    fit = ~samples.held_out
    units = np.append(abs(h), spreads(samples))
    typical = typical_sizes(values_at(basis, samples))[0]
    rows = raw.gauge[fit, 0] * units[:, None] / np.where(typical > 0, typical, abs(h))
    length = np.linalg.norm(rows, axis=(1, 2), keepdims=True)
    columns = triangle(rows_of(rows / np.where(length > 0, length, 1)))
    size = np.linalg.norm(columns, axis=0)
    taken: list[int] = []
    done = np.zeros((len(columns), 0))
    for j in np.argsort(basis.complexity, kind="stable"):
        if size[j] <= 1e-12 * np.max(size):
            continue
        rest = columns[:, j] / size[j]
        for _ in range(2):  # the second time for round-off
            rest = rest - done @ (done.T @ rest)
        if np.linalg.norm(rest) > 1e-9:
            taken.append(int(j))
            done = np.column_stack([done, rest / np.linalg.norm(rest)])
    places = np.array(sorted(taken), int)
    chosen = BoundBasis(
        _Chosen(basis, tuple(places.tolist())),
        tuple(basis.names[j] for j in places),
        tuple(basis.complexity[j] for j in places),
        basis.uses_time,
    )
    return chosen, places
