"""Gauge functions that close Noether's identities, found in a basis."""

from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...base.results import RESULTS
from ...base.types import Args, Interval
from ...engine.newton import Newton
from ...methods.step import Equations, step
from ...problem.system import System, check_system
from ..algebra.echelon import reduction
from ..algebra.nullspace import series_changes, solve_series
from ..algebra.taylor import taylor_coefficients
from ..functions import sampling
from ..functions.basis import AbstractBasis, BoundBasis, bind_basis, check_step_size
from ..functions.generators import Generator, LatticePoint
from ..functions.sampling import Displacements
from .noether import noether_identity

_ROUNDINGS = 64.0  # An identity below so many roundings of its terms is zero
_UNCLEAR = 1e-6  # Where rounding makes a larger residual, it does not decide whether a gauge exists
_STRONG = 100.0  # An identity so many times larger than at 75 % of the samples is its own scale


class BasisGauge(eqx.Module):
    """A function c·φ(q, p, t) of a basis, as a gauge G(t, q, p, args) or as a component of a
    generator; as a formula: `str`.

    - `coefficients`: c, shape (basis size,), or (*q.shape, basis size) for ξ and η.
    """

    basis: BoundBasis
    coefficients: Array

    def __call__(self, t, q, p, args):
        return self.coefficients @ self.basis(q, p, t)

    def __str__(self) -> str:
        return self.basis.formula(self.coefficients)


class GaugeSolution(eqx.Module):
    """Result of `solve_gauge`; print it for a report. A sequence of its first three fields.

    - `gauges`: one for each order, for `AdiabaticInvariant`.
    - `coefficients`: shape (z + 1, basis size).
    - `residuals`: shape (z + 1,), on held-out points: the largest residual of the identity with the
      gauge at each order in ε, relative to the identity without gauges (or to its terms if that
      is zero). Rounding: a gauge exists, and the identity closes to that order; of order one: no
      gauge in this basis closes it.
    - `rounding`: the residual that rounding alone makes at order 0. Above 1e-6, whether the
      identity closes cannot be decided (`warnings`).
    """

    gauges: tuple[BasisGauge, ...]
    coefficients: np.ndarray
    residuals: np.ndarray
    rounding: float = eqx.field(static=True)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons why the result is not reliable, each with a remedy; empty if it is reliable."""
        if self.rounding <= _UNCLEAR:
            return ()
        return (
            f"rounding alone makes a residual of {self.rounding:.0e}: whether a gauge exists "
            "cannot be decided in this arithmetic; take a larger h, or samples that spread wider",
        )

    def __iter__(self) -> Iterator[Any]:
        return iter((self.gauges, self.coefficients, self.residuals))

    def __getitem__(self, i: int) -> Any:
        return tuple(self)[i]

    def __len__(self) -> int:
        return 3

    def __str__(self) -> str:
        lines = [
            f"order {order}: residual {residual:.1e}, G = {gauge}"
            for order, (gauge, residual) in enumerate(zip(self.gauges, self.residuals, strict=True))
        ]
        return "\n".join([*lines, *self.warnings])


def solve_gauge(
    system: System,
    generators: Sequence[Generator],
    basis: AbstractBasis,
    *,
    h: float,
    samples: Any,
    t0: float = 0.0,
    args: Args = None,
) -> GaugeSolution:
    r"""Gauge functions with which generators satisfy Noether's identities, by least squares.

    With Φ_ε the map (12)–(13), the sum Σ_m ε^m N_m of the identities (28) must be O(ε^{z+1}) on
    each step (q, p) → Φ_ε(q, p). First the perturbed map is inserted, then the coefficient of each
    power of ε must vanish:

        n_k + (1/h) Σ_{m≤k} A_{k−m} g_m = 0    for k = 0 … z

    with n_k the Taylor coefficients of the sum without gauges and A_k those of φ(Φ_ε) − φ.
    (With the unperturbed map, as (28) is printed, terms are lost; this is why (34) fails.)

    On solutions every generator with ξ0 = 0 has the gauge −ξ·p, whose invariant is 0. Therefore
    check also that the invariant is not 0; a small residual is not sufficient. `find_symmetries`
    distinguishes such generators from those that lead to an invariant.

    **Arguments** `generators`: the series, order 0 first; `basis`: φ(q, p) of the gauges; `h`,
    `t0`, `args`: of the step; `samples`: (qs, ps) at t0, shapes (S, *q.shape), or (qs, ps, ts)
    with the times of the samples, shape (S,); a quarter of them is held out. All samples have the
    same weight, whatever the size of the identity.

    **Returns** a `GaugeSolution`.

    **Raises** `ValueError` for samples of unequal shapes, too few of them, or where the step fails.

    **Source** our own; the identities: the paper, (25) and (28).
    """
    check_system(system, "solve_gauge")
    samples = sampling.as_samples(samples, t0)
    single = isinstance(generators, Generator)
    if single or len(generators) == 0:
        raise ValueError(
            "generators must be a list with one Generator for each order, got "
            f"{'a Generator: give [generator]' if single else 'an empty list'}."
        )
    bound, h = bind_basis(basis, samples.q.shape[1:]), check_step_size(h)
    sampling.require_enough(samples, bound.size)
    sampling.require_times(bound.uses_time, samples)
    held_out, order = samples.held_out, len(generators) - 1
    equations = Equations(system, jnp.zeros(()), args)
    arrays = _identity_terms(equations, h, list(generators), bound, samples)
    terms, sizes, displacement, good = map(np.asarray, arrays)
    sampling.require_steps(good, samples)
    n, changes, size = terms[:, :, 0], terms[:, :, 1:] / h, bound.size
    largest = np.max(np.abs(n), axis=1)
    scale = _scale(largest, sizes)
    # An identity that does not close is at least this fraction of its terms.
    relative = np.maximum(largest / np.maximum(sizes, np.finfo(float).tiny), 1e-300)
    relative = np.where(relative > _ROUNDINGS * np.finfo(float).eps, relative, 1e-300)
    relative = np.maximum(relative, Displacements(samples, displacement).relative_step)

    rows, n = changes / scale[:, None, None], n / scale[:, None]
    g, free = solve_series(rows[~held_out], -n[~held_out])
    # Invariants may be added to any gauge: the simplest sum is taken.
    g = reduction(free, np.tile(bound.complexity, order + 1), size)(g)
    residuals = series_changes(rows, g[:, None])[held_out, :, 0] + n[held_out]
    g = g.reshape(order + 1, size)
    return GaugeSolution(
        gauges=tuple(BasisGauge(bound, jnp.asarray(c)) for c in g),
        coefficients=g,
        residuals=np.max(np.abs(residuals), axis=0),
        rounding=min(1.0, float(_ROUNDINGS * np.finfo(float).eps / np.median(relative))),
    )


def _scale(n: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Scale of the residual of each sample, shape (S,): the largest identity `n` without gauges, or
    its own where that is far larger than at most; `sizes`: of its terms before they cancel."""
    if np.mean(n <= _ROUNDINGS * np.finfo(float).eps * sizes) > 0.95:
        n = sizes  # the identity closes by itself: n is rounding
    usual = n <= _STRONG * np.quantile(n, 0.75)
    return np.maximum(np.where(usual, np.max(n[usual], initial=0.0), n), np.finfo(float).tiny)


@eqx.filter_jit
def _identity_terms(equations, h, generators, basis, samples):
    """Taylor coefficients in ε of [Σ ε^m N_m without gauges, φ(Φ_ε) − φ], (S, z + 1, 1 + B); the
    sizes of the terms of N_m at ε = 0 before they cancel, one for each component of the generator
    at both points, (S,); z1 − z, (S, 2n); and whether the steps succeed, (S,)."""
    zero, orders = jnp.zeros(()), range(len(generators))

    def at_point(q, p, t):
        interval = Interval(t, t + h, jnp.asarray(h, float))
        first = LatticePoint(interval.t0, q, p)

        def next_point(epsilon):
            discrete = Equations(equations.system, epsilon, equations.args, Newton())
            q1, p1, info = step(discrete, interval, q, p)
            return LatticePoint(interval.t1, q1, p1), info.result == RESULTS.successful

        def identities(epsilon, second, series):
            problem = equations.system, series, [None for _ in orders]
            points = first, second, epsilon, equations.args
            return [noether_identity(*problem, m, *points) for m in orders]

        def identity_and_change(epsilon):
            second, _ = next_point(epsilon)
            of_order = identities(epsilon, second, generators)
            total = sum(epsilon**m * N for m, N in enumerate(of_order))
            return jnp.append(total, basis(second.q, second.p, second.t) - basis(q, p, first.t))

        second, good = next_point(zero)

        def in_parts(weights):
            """The identities of all orders at ε = 0, linear in weights of the components."""
            pairs = zip(generators, weights, strict=True)
            products = [_times_weights(g, first, w) for g, w in pairs]
            return jnp.stack(identities(0.0, second, products))

        parts = jax.jacfwd(in_parts)(jnp.ones((len(generators), 2, 1 + 2 * q.size)))
        size = jnp.max(jnp.sum(jnp.abs(parts), axis=(1, 2, 3)))
        terms = taylor_coefficients(identity_and_change, zero, len(generators) - 1)
        displacement = jnp.concatenate([(second.q - q).ravel(), (second.p - p).ravel()])
        return terms, size, displacement, good

    return jax.vmap(at_point)(*samples)


def _times_weights(generator: Generator, first: LatticePoint, weights: Array) -> Generator:
    """The generator times weights (2, 2n + 1) of components, at the first point and elsewhere."""

    def component(place):
        def function(t, q, p, args):
            value = generator(LatticePoint(t, q, p), args)[place]
            w = jnp.where(t == first.t, weights[0], weights[1])
            return value * jnp.split(w, [1, 1 + q.size])[place].reshape(value.shape)

        return function

    return Generator(*map(component, range(3)))
