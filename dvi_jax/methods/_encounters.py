r"""Close encounters of N bodies: which pairs of bodies meet in a step, and the motion of these.

In democratic coordinates the pair (i, j) is moved from the part B to the part A of the Hamiltonian,

    H_A = Σ |P_i|²/(2 m_i) − μ m_i/|Q_i|  −  Σ_close G m_i m_j/|Q_i − Q_j| ,

and at a pericentre all pairs and |Σ P_i|²/(2 m_0), the recoil of the first body. They are chosen
once for a step, so that it is one of a symmetric splitting.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

import lanewise

from ..base.types import Scalar
from ..engine.pairs import Pair, add, sub

_SUBSTEPS = np.arange(1.0, 7.0)
"""Numbers of steps of the leapfrog whose extrapolation to infinitely many has the order 12."""

_TOLERANCE = 256
"""Largest estimate of the error of a substep, in roundings of the distance and of the change of
velocity in it. The estimate is of order 10, the error much smaller."""

_ROWS: Any = np.s_[:, None], np.s_[None]
"""Places of the first and the second body of each pair."""

_MOST = 10_000
"""Substeps in one motion of the part A, after which the status is `not_converged`."""


def _extrapolation(counts: np.ndarray) -> np.ndarray:
    """The weights of results with n steps, whose errors are series in 1/n²."""
    squares = counts * counts
    is_different = ~np.eye(len(counts), dtype=bool)
    differences = np.where(is_different, squares[:, None] - squares, 1)
    return np.where(is_different, squares[:, None] / differences, 1).prod(axis=1)


_WEIGHTS = _extrapolation(_SUBSTEPS)
_OF_ERROR = _WEIGHTS - np.append(0.0, _extrapolation(_SUBSTEPS[1:]))


class Encounters(NamedTuple):
    """The bodies around the first one: their `masses` times G, μ of their Kepler orbits, the square
    of the softening, the matrix `close` of pairs, on its diagonal the bodies at a pericentre."""

    masses: Array
    mu: Array
    softening: Scalar
    close: Bool[Array, "n n"]

    @property
    def has_recoil(self) -> Bool[Array, ""]:
        return jnp.any(jnp.diagonal(self.close))

    @property
    def pairs(self) -> Bool[Array, "n n"]:
        """The pairs in the part A."""
        return (self.close | self.has_recoil) & ~jnp.eye(len(self.masses), dtype=bool)

    @property
    def members(self) -> Bool[Array, "n 1"]:
        """The bodies that are not moved on Kepler orbits."""
        return (jnp.any(self.close, axis=1) | self.has_recoil)[:, None]

    def drift(self, v: Array) -> Array:
        """dx/dt in the part A."""
        recoil = jnp.sum((self.masses / self.mu)[:, None] * v, axis=0, keepdims=True)
        return v + jnp.where(self.has_recoil, recoil, 0)

    def pull(self, difference: Array) -> Array:
        """The accelerations by the attraction of close pairs, from the differences x_i − x_j."""
        square, pairs = jnp.sum(difference * difference, axis=-1) + self.softening, self.pairs
        # Other pairs may be at one place, a body with itself, where the derivative would be NaN.
        square = jnp.where(pairs, square, 1)
        weight = jnp.where(pairs, -self.masses[None] / (square * jnp.sqrt(square)), 0)
        return jnp.sum(weight[..., None] * difference, axis=1)

    def are_apart(self, difference: Array, x: Array, start: Array) -> Array:
        """Whether the distances, also to the first body, are more than 1e-8 of those at first."""
        square = jnp.sum(difference * difference, axis=-1) + self.softening
        limit = float(jnp.finfo(x.dtype).eps) * jnp.sum(start * start, axis=-1, keepdims=True)
        is_central = jnp.sum(x * x, axis=-1, keepdims=True) <= limit
        return ~jnp.any((self.pairs & (square <= limit)) | (self.members & is_central))

    def without_pull(self, x: Array, acceleration: Array) -> Array:
        """The accelerations of all bodies at the positions x, less those by close pairs."""
        difference = x[1:, None] - x[None, 1:]
        return self._if_any(lambda rates: rates.at[1:].add(-self.pull(difference)), acceleration)

    def motion(self, h: Scalar, X: Array, V: Array, kepler: tuple) -> tuple[Array, Array, Array]:
        """(dX, dV, whether they are accurate) of the part A over the time h; `kepler`: those of the
        Kepler orbits, which other bodies move on."""

        def with_pairs(kepler):
            dX, dV, defect = _differentiable(_motion, [*self, h, X, V])
            motion = (
                jnp.where(self.members, *pair) for pair in zip((dX, dV), kepler, strict=False)
            )
            return *motion, kepler[2] & (defect == 0)

        return self._if_any(with_pairs, kepler)

    def _if_any(self, function: Callable, values: Any) -> Any:
        # In most steps no pair is close: a batch skips this work where none of its runs has one.
        return lax.cond(lanewise.on_any(jnp.any(self.close)), function, lambda x: x, values)


def close_pairs(h: Scalar, X: Array, V: Array, radii: Array) -> Bool[Array, "n n"]:
    """The pairs that are close on straight lines during h/2 before and after: nearer than the
    larger of their `radii`, in units of the distance to the first body."""
    x, v = X[:, None] - X[None], V[:, None] - V[None]
    radius = radii * jnp.sqrt(jnp.sum(X * X, axis=-1))
    v2, xv = jnp.sum(v * v, axis=-1), jnp.sum(x * v, axis=-1)
    # The same for (h, V) and (−h, −V): judged at both ends, a step back has the same pairs.
    limit = jnp.abs(h) / 2
    time = jnp.clip(-xv / jnp.where(v2 > 0, v2, 1), -limit, limit)[..., None]
    nearest = jnp.sum((x + time * v) ** 2, axis=-1)
    is_close = nearest < jnp.maximum(radius[:, None], radius[None]) ** 2
    return is_close & ~jnp.eye(len(X), dtype=bool)


def at_pericentre(h: Scalar, X: Array, V: Array, mu: Array, eta: float) -> Bool[Array, " n"]:
    """The bodies for which h is longer than `eta` times the time of Pham, Rein & Spiegel (2024),

    τ² = 2 |a|²/(|a'|² + |a| |a''|), with the derivatives of the acceleration a on a Kepler orbit.
    """
    r2, xv = (jnp.sum(X * y, axis=-1, keepdims=True) for y in (X, V))
    v2, factor = jnp.sum(V * V, axis=-1, keepdims=True), -mu[:, None] / (r2 * jnp.sqrt(r2))
    a = factor * X
    xa, u = factor * r2, xv / r2
    jerk = factor * (V - 3 * u * X)
    snap = factor * (a - 6 * u * V - 3 * ((v2 + xa) / r2 - 5 * u * u) * X)
    a2, jerk2, snap2 = (jnp.sum(x * x, axis=-1) for x in (a, jerk, snap))
    # Even in h and in V: a step back has the same pericentres.
    return h * h * (jerk2 + jnp.sqrt(a2 * snap2)) > 2 * eta * eta * a2


def _motion(*operands: Array) -> list[Array]:
    """The changes by Gragg's extrapolation of the leapfrog, and 0, or 1 if it did not succeed."""
    *constants, h, X, V = operands
    pairs = Encounters(*constants)
    is_member = pairs.members
    V = jnp.where(is_member, V, 0)
    rows = tuple(jnp.asarray(x, X.dtype) for x in (_SUBSTEPS, _WEIGHTS, _OF_ERROR))
    tolerance = _TOLERANCE * float(jnp.finfo(X.dtype).eps)

    def acceleration(x, difference, dx):
        X = x + dx
        radius = jnp.sqrt(jnp.sum(X * X, axis=-1, keepdims=True))
        # Bodies that are close have almost the same x and dx, of which the sum would be rounded.
        pull = pairs.pull(difference + (dx[:, None] - dx[None]))
        return jnp.where(is_member, pull - pairs.mu[:, None] / (radius * radius * radius) * X, 0)

    def leapfrog(number, step, x, difference, v, rate):
        """The changes after a number of steps; the velocity is half a step ahead in between."""

        def advance(state):
            i, dx, dv, _ = state
            dx = dx + step * pairs.drift(v + dv)
            kick = step * acceleration(x, difference, dx)
            return i + 1, dx, dv + kick, kick

        start = jnp.zeros_like(number), jnp.zeros_like(x), step / 2 * rate, jnp.zeros_like(x)
        _, dx, dv, kick = lax.while_loop(lambda state: state[0] < number, advance, start)
        return jnp.stack([dx, dv - kick / 2])

    def attempt(state):
        t, step, dX, dV, _, count = state
        step = jnp.where(jnp.abs(step) < jnp.abs(h - t), step, h - t)
        position, v = add(X, dX), V + dV
        x, difference = position.hi, sub(*(Pair(*(y[i] for y in position)) for i in _ROWS)).hi
        rate = acceleration(x, difference, jnp.zeros_like(x))

        def extrapolate(sums, row):
            number, weight, of_error = row
            change = leapfrog(number, step / number, x, difference, v, rate)
            return (sums[0] + weight * change, sums[1] + of_error * change), None

        zero = jnp.zeros((2, *x.shape), x.dtype)
        (change, error), _ = lax.scan(extrapolate, (zero, zero), rows)
        scale = _size(jnp.stack([pairs.drift(v), rate])) * jnp.abs(step) + _size(change)
        # Of each body relative to its own change: a slow or distant one has small numbers.
        error = jnp.max(_size(error) / jnp.where(scale > 0, scale, 1))
        is_finite = jnp.all(jnp.isfinite(change))
        is_good = is_finite & (error <= tolerance)
        # The estimate has the order 10, so that an error changes with the power 11 of the substep.
        ratio = tolerance / jnp.maximum(error, tolerance / 4.0**11)
        factor = jnp.where(is_finite, jnp.clip(0.9 * ratio ** (1 / 11), 0.1, 4.0), 0.1)
        take = jnp.where(is_good, change, 0)
        # The last substep ends at h, also where the sum of the substeps is not h.
        t = jnp.where(is_good, jnp.where(step == h - t, h, t + step), t)
        # The flow does not depend on the substeps.
        step = lax.stop_gradient(step * factor)
        can_go_on = jnp.all(jnp.isfinite(rate)) & pairs.are_apart(difference, x, X)
        return t, step, add(dX, take[0]), dV + take[1], can_go_on, count + 1

    def proceed(state):
        t, _, _, _, can_go_on, count = state
        return (t != h) & can_go_on & (count < _MOST)

    zero, count = jnp.zeros_like(X), jnp.asarray(0, jnp.int32)
    start = jnp.zeros_like(h), h, Pair(zero, zero), zero, jnp.asarray(True), count
    t, _, dX, dV, _, _ = lax.while_loop(proceed, attempt, start)
    # No difference: where h is a product, h − t would be rounded once, and not be 0.
    return [dX.hi, dV, jnp.where(t == h, 0, 1).astype(X.dtype)]


def _size(x: Array) -> Array:
    return jnp.max(jnp.abs(x), axis=-1)


def _differentiable(function: Callable, operands: Sequence[Any]) -> list[Array]:
    """The list of arrays ``function(*operands)`` with the derivatives of its forward mode, of every
    order, also in reverse mode, which a loop of unknown length does not have."""

    def rule(operands, changes) -> list[Array | None]:
        places = tuple(i for i in changes if jnp.issubdtype(operands[i].dtype, jnp.inexact))

        def jacobians(*operands):
            return jax.tree.leaves(jax.jacfwd(function, argnums=places)(*operands))

        # In the order of the results, and for each in that of the places.
        matrices = iter(_differentiable(jacobians, operands))
        count = len(jax.eval_shape(function, *operands))
        products = [
            [jnp.tensordot(next(matrices), changes[i], changes[i].ndim) for i in places]
            for _ in range(count)
        ]
        return [functools.reduce(jnp.add, terms) for terms in products]

    return lanewise.with_derivative(function, rule, operands)
