"""The determining equations of conformal invariance."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._step import Equations
from .._system import System
from .._types import Args, Interval, Scalar, State
from .generators import Generator, LatticePoint, prolong


def discrete_equations(
    system: System,
    first: LatticePoint,
    second: LatticePoint,
    epsilon: Any = 0.0,
    args: Args = None,
) -> tuple[State, State]:
    r"""The left sides (F^q, F^p) of the discrete equations between two lattice points.

        F^q = (q1 − q0)/h − ∂H_D/∂p1,    F^p = (p1 − p0)/h + ∂H_D/∂q0 − εW,    h = t1 − t0

    Both vanish on a solution. **Source** the paper, (16) and (23).
    """
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
    conformal invariance, with its Λ, is asked of all points.

    **Source** the paper, (17) and (24).
    """
    value, change = _equations_and_change(system, generators, first, second, epsilon, args)
    return change if factor is None else change - factor @ value


class ConformalFactor(NamedTuple):
    """Λ, the largest residual relative to the largest |pr X̃(F)|, and the condition number of Λ."""

    factor: Float[Array, "2n 2n"]
    residual: Scalar
    condition: Scalar


def conformal_factor(
    system: System,
    generators: Generator | Sequence[Generator],
    first: LatticePoint,
    second: LatticePoint,
    epsilon: Any = 0.0,
    args: Args = None,
) -> ConformalFactor:
    r"""The constant matrix Λ with pr X̃(F) = Λ F, by least squares over sampled pairs of points.

    `first`, `second`: points with a leading sample axis, off the solutions, at least 2n of
    them. The residual says whether such a Λ exists (round-off) or not (of order one).

    **Source** the paper, Definitions 1 and 2.
    """

    def at_sample(first, second):
        return _equations_and_change(system, generators, first, second, epsilon, args)

    first, second = _as_points(first, second)
    values, changes = jax.vmap(at_sample)(first, second)
    samples, size = values.shape
    if samples < size:
        raise ValueError(
            f"a {size}×{size} factor needs at least {size} sampled pairs of points, got {samples}."
        )
    factor = jnp.linalg.lstsq(values, changes)[0].T
    largest = jnp.max(jnp.abs(changes))
    residual = jnp.max(jnp.abs(changes - values @ factor.T))
    residual = residual / jnp.where(largest > 0, largest, 1)
    return ConformalFactor(factor, residual, jnp.linalg.cond(factor))


def _equations_and_change(system, generators, first, second, epsilon, args):
    def equations(first, second):
        F_q, F_p = discrete_equations(system, first, second, epsilon, args)
        return jnp.concatenate([F_q.ravel(), F_p.ravel()])

    first, second = _as_points(first, second)
    change = prolong(generators, equations, (first, second), epsilon, args)
    return equations(first, second), change


def _as_points(*points: LatticePoint) -> tuple[LatticePoint, ...]:
    return tuple(LatticePoint(*map(jnp.asarray, point)) for point in points)
