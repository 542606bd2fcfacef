"""Gauge functions that close Noether's identities, found in a basis."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._results import RESULTS
from .._step import Equations, step
from .._system import System
from .._types import Args, Interval
from ..engine.echelon import reduction
from ..engine.newton import Newton
from ..engine.nullspace import toeplitz
from ..engine.taylor import taylor_coefficients
from .basis import AbstractBasis, BoundBasis, bind_basis, check_step_size
from .generators import Generator, LatticePoint
from .noether import noether_identity
from .sampling import as_samples, require_enough, require_steps, require_system, require_time

_CANCELLED = 1e-9
"""An identity below this fraction of its terms is zero up to rounding."""


class BasisGauge(eqx.Module):
    """A gauge G(t, q, p, args) = g·φ(q, p, t); as a formula: `str`."""

    basis: BoundBasis
    coefficients: Array

    def __call__(self, t, q, p, args):
        return self.coefficients @ self.basis(q, p, t)

    def __str__(self) -> str:
        return self.basis.formula(self.coefficients)


class GaugeSolution(NamedTuple):
    """What `solve_gauge` found.

    - `gauges`: one for each order, for `AdiabaticInvariant`.
    - `coefficients`: shape (z + 1, basis size).
    - `residuals`: shape (z + 1,), on held-out points: the residual of the identity with the
      gauge at each order in ε, relative to the identity without gauges, or to its terms if that
      is zero. Round-off: a gauge exists, and the identity closes to that order; of order one: no
      gauge in this basis closes it.
    """

    gauges: tuple[BasisGauge, ...]
    coefficients: np.ndarray
    residuals: np.ndarray


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
    r"""The gauge functions that close Noether's identities on the disturbed map, by least squares.

    With Φ_ε the map (12)–(13), the sum Σ_m ε^m N_m of the identities (28) has to vanish on
    (q, p) → Φ_ε(q, p) up to O(ε^{z+1}). Powers of ε are collected *after* the map is put in:

        n_k + (1/h) Σ_{m≤k} A_{k−m} g_m = 0    for k = 0 … z

    with n_k the Taylor coefficients of the sum without gauges and A_k those of φ(Φ_ε) − φ.
    (Taken order by order with the undisturbed map, as (28) is printed, terms are lost: (34)
    fails by it.)

    On the solutions every generator with ξ0 = 0 has the gauge −ξ·p, whose invariant is 0: where
    the basis holds it, look at the invariant and not at the residual alone. `find_symmetries`
    tells such generators from those that lead to an invariant.

    **Arguments** `generators`: the series, order 0 first; `basis`: φ(q, p), where the gauges are
    looked for; `h`, `t0`, `args`: of the step; `samples`: (qs, ps) at t0, shapes (S, *q.shape),
    or (qs, ps, ts) with the times of the samples, shape (S,); a quarter of them held out.

    **Returns** `gauges`, functions for `AdiabaticInvariant`, one for each order; their
    `coefficients` in the basis, shape (z + 1, basis size); and `residuals`, shape (z + 1,), on
    held-out points: what they leave of the identity at each order, relative to its terms.

    **Raises** `ValueError` for samples of unequal shapes, too few of them, or where the step fails.

    **Source** our own; the identities: the paper, (25) and (28).
    """
    require_system(system, Newton())
    samples = as_samples(samples, t0)
    if isinstance(generators, Generator) or len(generators) == 0:
        raise ValueError(
            "generators must be a list with one Generator for each order, order 0 first; got "
            f"{generators!r}."
        )
    bound, h = bind_basis(basis, samples.q.shape[1:]), check_step_size(h)
    require_enough(samples, bound.size)
    require_time(bound, samples)
    held, order = samples.held_out, len(generators) - 1
    equations = Equations(system, jnp.zeros(()), args)
    terms, sizes, good = _identity_terms(equations, h, list(generators), bound, samples)
    require_steps(good, samples)
    terms = np.asarray(terms)
    n, changes = terms[:, :, 0], terms[:, :, 1:] / h
    size = bound.size

    blocks = toeplitz(changes, order).reshape(order + 1, len(held), -1)
    scale = np.tile(np.sqrt(np.mean(changes[:, 0] ** 2, axis=0)), order + 1)
    scale = 1 / np.where(scale > 0, scale, 1)
    g, free = np.zeros(len(scale)), np.diag(scale)  # solutions so far: g + free @ anything
    for k in range(order + 1):  # a lower order first: a higher one uses the freedom it leaves
        matrix, right = blocks[k, ~held], -n[~held, k]
        U, singular, V = np.linalg.svd(matrix @ free)
        rank = int(np.sum(singular > 1e-9 * max(singular[0], 1e-300)))
        g = g + free @ V[:rank].T @ ((U[:, :rank].T @ (right - matrix @ g)) / singular[:rank])
        free = free @ V[rank:].T
    # What is left free is invariants, which may be added to any gauge: the simplest is taken.
    g = reduction(free, np.tile(bound.complexity, order + 1), size)(g)
    left = blocks[:, held] @ g + n[held].T
    g = g.reshape(order + 1, size)
    largest, terms = np.max(np.abs(n)), np.max(np.asarray(sizes))
    if largest <= _CANCELLED * terms:  # the identity closes by itself: n is rounding
        largest = terms
    largest = np.maximum(largest, np.finfo(float).tiny)
    return GaugeSolution(
        tuple(BasisGauge(bound, jnp.asarray(c)) for c in g),
        g,
        np.max(np.abs(left), axis=1) / largest,
    )


def _weighted(generator: Generator, first: LatticePoint, weights: Array) -> Generator:
    """The generator with components times weights, at the first point and elsewhere, shape
    (2, 2n + 1)."""

    def component(place):
        def function(t, q, p, args):
            value = generator(LatticePoint(t, q, p), args)[place]
            w = jnp.where(t == first.t, weights[0], weights[1])
            return value * jnp.split(w, [1, 1 + q.size])[place].reshape(value.shape)

        return function

    return Generator(*map(component, range(3)))


@eqx.filter_jit
def _identity_terms(equations, h, generators, basis, samples):
    """Taylor coefficients in ε of [Σ ε^m N_m without gauges, φ(Φ_ε) − φ], (S, z + 1, 1 + B); the
    sizes of the terms of N_m at ε = 0 before they cancel, one for each component of the generator
    at both points, (S,); and whether the steps succeed, (S,)."""
    nothing = [None] * len(generators)

    def at_point(q, p, t):
        interval = Interval(t, t + h, jnp.asarray(h, float))

        def of(epsilon):
            here = Equations(equations.system, epsilon, equations.args, Newton())
            q1, p1, info = step(here, interval, q, p)
            first, second = LatticePoint(interval.t0, q, p), LatticePoint(interval.t1, q1, p1)
            total = sum(
                epsilon**m
                * noether_identity(
                    here.system, generators, nothing, m, first, second, epsilon, here.args
                )
                for m in range(len(generators))
            )
            return jnp.append(total, basis(q1, p1, interval.t1) - basis(q, p, interval.t0)), info

        def in_parts(weights):
            """The identities of all orders at ε = 0, linear in weights of the components."""
            here = Equations(equations.system, jnp.zeros(()), equations.args, Newton())
            q1, p1, _ = step(here, interval, q, p)
            first, second = LatticePoint(interval.t0, q, p), LatticePoint(interval.t1, q1, p1)
            weighted = [_weighted(g, first, weights[m]) for m, g in enumerate(generators)]
            return jnp.stack(
                [
                    noether_identity(
                        here.system, weighted, nothing, m, first, second, 0.0, here.args
                    )
                    for m in range(len(generators))
                ]
            )

        parts = jax.jacfwd(in_parts)(jnp.ones((len(generators), 2, 1 + 2 * q.size)))
        size = jnp.max(jnp.sum(jnp.abs(parts), axis=(1, 2, 3)))
        terms = taylor_coefficients(lambda e: of(e)[0], jnp.zeros(()), len(generators) - 1)
        return terms, size, of(jnp.zeros(()))[1].result == RESULTS.successful

    return jax.vmap(at_point)(*samples)
