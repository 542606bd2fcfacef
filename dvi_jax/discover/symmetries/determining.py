"""The determining equations of conformal invariance."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...base.types import Args, Interval, Scalar, State
from ...methods.step import Equations
from ...problem.system import System, check_system
from ..functions.generators import Generator, LatticePoint, prolong


def discrete_equations(
    system: System, first: LatticePoint, second: LatticePoint, epsilon: Any = 0.0, args: Args = None
) -> tuple[State, State]:
    r"""The left sides (F^q, F^p) of the discrete equations between two lattice points.

        F^q = (q1 − q0)/h − ∂H_D/∂p1,    F^p = (p1 − p0)/h + ∂H_D/∂q0 − εW,    h = t1 − t0

    Both vanish on a solution. `first`, `second`: the points (t0, q0, p0) and (t1, q1, p1).

    **Source** the paper, (16) and (23).
    """
    check_system(system, "discrete_equations")
    (t0, q0, p0), (t1, q1, p1) = _as_points(first, second)
    h = t1 - t0
    interval = Interval(t0, t1, h)
    equations = Equations(system, jnp.asarray(epsilon), args)
    return (
        (q1 - q0) / h - equations.position_rate(interval, q0, p1),
        (p1 - p0) / h - equations.momentum_rate(interval, q0, p1),
    )


def determining_residual(
    system: System,
    generators: Generator | Sequence[Generator],
    first: LatticePoint,
    second: LatticePoint,
    factor: Float[Array, "2n 2n"] | None = None,
    epsilon: Any = 0.0,
    args: Args = None,
) -> Float[Array, " 2n"]:
    r"""The residual pr X̃(F) − Λ F of the determining equation at a pair of lattice points.

    `factor` is Λ; without it the result is pr X̃(F) alone, which vanishes at the points of a
    solution exactly when the generator is a symmetry. The pair need not lie on a solution:
    conformal invariance, with its Λ, is a condition at all points.

    **Source** the paper, (17) and (24).
    """
    value, change = _equations_and_change(system, generators, first, second, epsilon, args)
    return change if factor is None else change - factor @ value


class ConformalFactor(NamedTuple):
    """Result of `conformal_factor`.

    - `factor`: Λ, shape (2n, 2n); with ``pointwise=True`` one for each sample, (S, 2n, 2n).
    - `residual`: the largest |pr X̃(F) − Λ F| over the samples, relative to the largest term of
      the sum pr X̃(F). Round-off: Λ exists; of order one: it does not.
    - `condition`: of the least-squares problem of Λ; infinite when the samples do not determine it
      (pairs on a solution, or too similar). 1 with ``pointwise=True``.
    """

    factor: Float[Array, "... 2n 2n"]
    residual: Scalar
    condition: Scalar

    @property
    def is_conformal(self) -> Bool[Array, ""]:
        """Whether the generator is a conformal invariance at the samples.

        That is, residual ≤ √eps and condition ≤ 1/√eps, eps the relative precision (2.2e-16 in
        float64). Values that are not finite are not conformal.
        """
        tolerance = jnp.sqrt(jnp.finfo(self.factor.dtype).eps)
        return (self.residual <= tolerance) & (self.condition <= 1 / tolerance)


def conformal_factor(
    system: System,
    generators: Generator | Sequence[Generator],
    first: LatticePoint,
    second: LatticePoint,
    epsilon: Any = 0.0,
    args: Args = None,
    pointwise: bool = False,
) -> ConformalFactor:
    r"""The matrix Λ with pr X̃(F) = Λ F: constant, or a function of the points.

    By default Λ is constant, by least squares over sampled pairs of points off the solutions
    (`random_pairs`), at least 2n of them.

    With ``pointwise=True`` it may differ from point to point. One pair of vectors does not
    determine a matrix; its value on the solutions does follow from the derivatives there,

        Λ = ∂(pr X̃ F)/∂(q1, p0) · (∂F/∂(q1, p0))⁻¹    at F = 0,    ∂F/∂(q1, p0) = diag(1/h, −1/h)

    and by Hadamard's lemma a smooth Λ exists around the solutions exactly when pr X̃(F) vanishes
    on them: that is its `residual`. Each sample gives the solution through its (q0, p1); q1 and
    p0 are not used.

    **Arguments** `generators`: one, or a series in ε, order 0 first; `first`, `second`: points
    with a leading sample axis (S, …).

    **Returns** a `ConformalFactor`.

    **Raises** `ValueError` for fewer than 2n pairs where Λ is constant.

    **Source** the paper, Definitions 1 and 2; the pointwise factor is our own (Hadamard's lemma:
    Olver 1993, Proposition 2.10).
    """
    first, second = _as_points(first, second)
    samples, size = len(first.q), 2 * first.q[0].size
    if not pointwise and samples < size:
        raise ValueError(
            f"first and second must have at least {size} points for a constant conformal factor, "
            f"got {samples}: give more, or pointwise=True."
        )
    problem = system, generators, first, second, jnp.asarray(epsilon), args
    return _conformal_factor(*problem, pointwise)


@eqx.filter_jit
def _conformal_factor(system, generators, first, second, epsilon, args, pointwise):
    def at_sample(first, second):
        if pointwise:
            first, second = _solution_through(system, first, second, epsilon, args)
        problem = system, generators, first, second, epsilon, args
        factor = _pointwise_factor(*problem) if pointwise else jnp.zeros(())
        return factor, *_equations_and_change(*problem), *_sizes(*problem)

    factor, values, changes, of_values, of_changes = jax.vmap(at_sample)(first, second)
    if pointwise:
        residual = _relative(changes, of_changes)
        return ConformalFactor(factor, residual, jnp.ones_like(residual))
    factor = jnp.linalg.lstsq(values, changes)[0].T
    # The columns in units of their terms: an F that is only their round-off determines nothing.
    units = jnp.max(of_values, axis=0, keepdims=True)
    singular = jnp.linalg.svd(values / jnp.where(units > 0, units, 1), compute_uv=False)
    condition = jnp.sqrt(len(values)) / singular[-1]
    return ConformalFactor(factor, _relative(changes - values @ factor.T, of_changes), condition)


def _relative(residuals, sizes):
    """The largest residual over the largest of its terms."""
    largest = jnp.max(sizes)
    return jnp.max(jnp.abs(residuals)) / jnp.where(largest > 0, largest, 1)


def _equations_and_change(system, generators, first, second, epsilon, args):
    equations = _equations(system, epsilon, args)
    first, second = _as_points(first, second)
    change = prolong(generators, equations, (first, second), epsilon, args)
    return equations(first, second), change


def _solution_through(system, first, second, epsilon, args):
    """The points of the solution through (q0, p1): q1 and p0 from the discrete equations."""
    (t0, q0, _), (t1, _, p1) = first, second
    h = t1 - t0
    interval, equations = Interval(t0, t1, h), Equations(system, jnp.asarray(epsilon), args)
    p0 = p1 - h * equations.momentum_rate(interval, q0, p1)
    q1 = q0 + h * equations.position_rate(interval, q0, p1)
    return LatticePoint(t0, q0, p0), LatticePoint(t1, q1, p1)


def _pointwise_factor(system, generators, first, second, epsilon, args):
    """Λ on a solution, from the derivatives of pr X̃(F) that leave it."""

    def change(q1, p0):
        points = first._replace(p=p0), second._replace(q=q1)
        return _equations_and_change(system, generators, *points, epsilon, args)[1]

    by_q1, by_p0 = jax.jacfwd(change, argnums=(0, 1))(second.q, first.p)
    h, size = second.t - first.t, first.q.size
    return h * jnp.concatenate([by_q1.reshape(-1, size), -by_p0.reshape(-1, size)], axis=1)


def _sizes(system, generators, first, second, epsilon, args):
    """How large the terms are that each component of F, and of pr X̃(F), is a sum of."""
    (t0, q0, p0), (t1, q1, p1) = first, second
    h = t1 - t0
    rates = jnp.abs(jnp.concatenate([((q1 - q0) / h).ravel(), ((p1 - p0) / h).ravel()]))
    F = _equations(system, epsilon, args)
    of_F = 2 * rates + jnp.abs(F(first, second))

    series = [generators] if isinstance(generators, Generator) else generators
    at_points = [
        jax.tree.map(lambda *x: sum(epsilon**m * v for m, v in enumerate(x)), *values)
        for values in ([g(point, args) for g in series] for point in (first, second))
    ]
    leaves, structure = jax.tree.flatten(tuple(at_points))
    places = jnp.eye(len(leaves), dtype=rates.dtype)
    alone = [jnp.tensordot(places[i], x, axes=0) for i, x in enumerate(leaves)]
    _, derivative = jax.linearize(F, first, second)
    terms = jax.vmap(derivative)(*jax.tree.unflatten(structure, alone))
    of_change = jnp.sum(jnp.abs(terms), axis=0)
    return of_F, of_change


def _equations(system, epsilon, args):
    def equations(first, second):
        F_q, F_p = discrete_equations(system, first, second, epsilon, args)
        return jnp.concatenate([F_q.ravel(), F_p.ravel()])

    return equations


def _as_points(*points: LatticePoint) -> tuple[LatticePoint, ...]:
    return tuple(LatticePoint(*map(jnp.asarray, point)) for point in points)
