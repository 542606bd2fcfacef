"""Constraints g(q, args) = 0: derivative, velocities along them, and consistent initial states."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

import lanewise
from lanewise.jaxprs.dependence import depends_on
from lanewise.jaxprs.jaxapi import is_traced

from ..base.inputs import as_parameter, as_scalar, start_state
from ..base.printing import printable
from ..base.results import RESULTS
from ..base.types import Args, Interval, Scalar, State
from ..engine.newton import RootInfo, RootSolver, find_root
from ..engine.picard import PicardThenNewton
from ..problem.system import check_system, of_problem, require_constraint
from .step import Equations, no_solve

# A start is consistent up to so many times the round-off of the terms in g and in dg/dt, and of
# the largest coordinate: a component such as q[2] = 0 has no size of its own.
_COMPONENT, _LARGEST = 4096, 64


def gradient(equations: Equations, q: State) -> Array:
    """G = ∂g/∂q, shape (m, n) for n components of q."""
    value, pull = jax.vjp(equations.constraint, q)
    # Not jnp.eye: zeros of the structure stay zeros in generated code.
    return jax.vmap(lambda e: pull(e)[0].ravel())(lanewise.unit_vectors(value.size, q.dtype))


def velocity_at(equations: Equations, t: Scalar, q: State) -> Callable[[State], State]:
    """p → ∂H/∂p(t, q, p), the velocity."""
    # H is H_D on the diagonal t0 = t1, as for the methods of Gauss and Lobatto.
    return partial(equations.position_rate, Interval(t, t, jnp.zeros_like(t)), q)


class Linear(NamedTuple):
    """The derivative G of g at a position, as functions: v → G v, and λ → Gᵀλ."""

    product: Callable[[State], Array]
    transpose: Callable[[Array], State]

    @classmethod
    def of_constraint(cls, equations: Equations, q: State) -> "Linear":
        # Not products with the matrix G: each component of g contains few coordinates, and
        # generated code leaves out the zeros of a chain for as long as it sees g itself.
        pull = jax.vjp(equations.constraint, q)[1]
        return cls(lambda v: jax.jvp(equations.constraint, (q,), (v,))[1], lambda y: pull(y)[0])

    def coupling(self, velocity: Callable[[State], State], p: State, m: int) -> Array:
        """G (∂v/∂p) Gᵀ, shape (m, m): how multipliers change the velocity across the constraint."""
        push = jax.linearize(velocity, p)[1]

        def column(e):
            return self.product(push(self.transpose(e)))

        return jax.vmap(column, out_axes=1)(lanewise.unit_vectors(m, p.dtype))


def own_coupling(G: Array, velocity: Callable[[State], State], p: State) -> Array:
    """The diagonal of G (∂v/∂p) Gᵀ, shape (m,)."""
    # Fewer operations than for the whole matrix, which no step needs at its start.
    push = jax.linearize(velocity, p)[1]
    return jax.vmap(lambda row: row @ push(row.reshape(p.shape)).ravel())(G)


def tangent(
    equations: Equations, t: Scalar, q: State, p: State, weight: Any = 1
) -> tuple[State, RootInfo]:
    """p − w Gᵀμ with the velocity along the constraint, G ∂H/∂p = 0, for a diagonal w."""
    linear, velocity = Linear.of_constraint(equations, q), velocity_at(equations, t, q)
    if not isinstance(weight, int):
        transpose = linear.transpose
        linear = linear._replace(transpose=lambda y: weight * transpose(y))
    normal_velocity = linear.product(velocity(p))
    A = linear.coupling(velocity, p, normal_velocity.size)
    # A velocity that is linear in p needs no iteration.
    if not depends_on(lambda p, v: jax.jvp(velocity, (p,), (v,))[1], 0, p, p):
        return p - linear.transpose(lanewise.solve(A, normal_velocity)), no_solve(p)
    G = lax.stop_gradient(gradient(equations, q))
    units = lax.stop_gradient(jnp.diagonal(A))  # the unknowns are velocities: their scale is known
    scale = jnp.abs(G) @ jnp.abs(velocity(p)).ravel()

    def momentum(y):
        return p - linear.transpose(y / units)

    def residual(y):
        return -linear.product(velocity(momentum(y)))

    y, info = find_root(residual, normal_velocity, scale, root_solver(equations))
    return momentum(y), info


def root_solver(equations: Equations) -> RootSolver:
    """The solver for multipliers: of the default, Newton's method for any number of them."""
    # The Jacobian is that of masses that are coupled, not near the identity as for other methods:
    # fixed points of a chain converge slowly. Newton's elimination is as cheap as it is banded.
    solver = equations.newton
    return solver.newton if isinstance(solver, PicardThenNewton) else solver


class _Defects(NamedTuple):
    """Of a state: g, dg/dt and G; which components of the first two are above round-off, and
    whether the rows of G are independent."""

    g: Array
    rate: Array
    G: Array
    is_off: Array
    is_moving_off: Array
    is_independent: Array


def _defects(equations: Equations, t: Scalar, q: State, p: State) -> _Defects:
    g, G = equations.constraint(q), gradient(equations, q)
    linear = Linear.of_constraint(equations, q)
    v = velocity_at(equations, t, q)(p)
    rate, sizes, eps = linear.product(v), jnp.abs(G), float(jnp.finfo(q.dtype).eps)

    def exceeds(defect, x):
        size = sizes @ (_COMPONENT * jnp.abs(x) + _LARGEST * jnp.max(jnp.abs(x))).ravel()
        return ~(jnp.abs(defect) <= eps * size)

    # For dependent rows of G the solution of G Gᵀ x = b, with rows of length one, is infinite, or
    # as large as round-off allows, unless b is one of a few: a sequence without a pattern.
    A = jax.vmap(lambda row: linear.product(row.reshape(q.shape)))(G)
    length = jnp.sqrt(jnp.diagonal(A))
    b = jnp.asarray(np.modf(0.618 * np.arange(1, g.size + 1))[0] - 0.5, q.dtype)
    x = length * lanewise.solve(A, length * b)
    independent = jnp.all(jnp.abs(x) * (64 * eps) < 1)
    return _Defects(g, rate, G, exceeds(g, q), exceeds(rate, v), independent)


def start_status(equations: Equations, t: Scalar, q: State, p: State) -> RESULTS:
    """`successful` for a consistent state with independent constraints."""
    defects = _defects(equations, t, q, p)
    consistent = ~jnp.any(defects.is_off | defects.is_moving_off)
    status = RESULTS.where(consistent, RESULTS.successful, RESULTS.inconsistent)
    return RESULTS.where(defects.is_independent, status, RESULTS.redundant)


_compiled_defects = eqx.filter_jit(_defects)


def check_start(equations: Equations, t: Scalar, q: State, p: State) -> None:
    """**Raises** `ValueError` for a start with constraints that are violated or redundant."""
    defects = _compiled_defects(equations, t, q, p)
    _require_independent(defects)
    first = (defects.is_off, defects.g, "the constraint")
    second = (defects.is_moving_off, defects.rate, "its rate of change (∂g/∂q) ∂H/∂p")
    for flags, value, quantity in (first, second):
        if np.any(flags):
            i = int(np.argmax(np.where(flags, np.abs(value), -1)))
            raise ValueError(
                f"the initial state is not consistent: {quantity} must be 0 to round-off, but "
                f"component {i} is {float(value[i]):.3g}. Use dvi.project."
            )


def _require_independent(defects: _Defects) -> None:
    if not defects.is_independent:
        # In NumPy: a rank needs singular values, which generated code does not have.
        G, count = np.asarray(defects.G), len(defects.g)
        lengths = np.linalg.norm(G, axis=1, keepdims=True)
        rows = G / np.where(lengths > 0, lengths, 1)
        rank = np.linalg.matrix_rank(rows, tol=8 * np.sqrt(np.finfo(rows.dtype).eps))
        raise ValueError(
            f"the rank of ∂g/∂q at the initial state must be {count}, the number of constraints, "
            f"got {rank}: {count - rank} of them are redundant."
        )


@printable
class Projection(NamedTuple):
    """A consistent state (q, p), and its distances |q − q0| and |p − p0| from the given state."""

    q: State
    p: State
    distance: Array
    kick: Array


def project(
    system, q0: Any = None, p0: Any = None, args: Args = None, *, t0: Any = 0.0, epsilon: Any = 0
) -> Projection:
    r"""The nearest consistent initial state of a constrained system.

        q = q0 − Gᵀ(q) ν,  g(q, args) = 0;      p = p0 − Gᵀ(q) μ,  G(q) ∂H/∂p(t0, q, p) = 0

    with G = ∂g/∂q. q is the point of the manifold nearest to q0; p is for a kinetic energy pᵀM⁻¹p/2
    the momentum nearest to p0 in the metric M⁻¹, so that forces of constraint alone change it.

    **Arguments** `system`: a `System` with a constraint, or a problem of the library, whose q0, p0
    and args are the defaults. `q0`, `p0`, `t0`, `epsilon`, `args`: as for `integrate`.

    **Returns** a `Projection`: q, p and how far they were moved. Differentiable. Under jit, vmap
    and grad it is NaN where the iteration does not converge.

    **Raises** `ValueError` for a system without constraint, redundant constraints (with the rank
    of G), and where no state is found near q0.

    **Accuracy** round-off. **Source** Hairer & Wanner 1996, *Solving ODEs II*, VII.2 (4.14).
    """
    system, q0, p0, _, args = of_problem(system, q0, p0, None, args)
    check_system(system)
    require_constraint("project", system)
    q0, p0 = start_state(q0, p0)
    t0, epsilon = as_scalar("t0", t0, q0.dtype), as_scalar("epsilon", epsilon, q0.dtype)
    args = jax.tree.map(as_parameter, args)
    system.check_shapes(t0, q0, p0, epsilon, args)
    equations = Equations(system, epsilon, args)
    projection, defects, is_projection = _projection(equations, t0, q0, p0)
    if not is_traced(is_projection) and not bool(is_projection):
        _require_independent(defects)
        raise ValueError(
            "no state with g = 0 was found near the one given, where g is "
            f"{np.asarray(defects.g)!s:.80}: give one that fulfils g = 0 more closely."
        )
    return projection


@eqx.filter_jit
def _projection(equations: Equations, t: Scalar, q0: State, p0: State):
    start, n = _defects(equations, t, q0, p0), q0.size

    def residual(x):
        q, nu = x[:n].reshape(q0.shape), x[n:]
        # Stationarity of |q − q0|²/2 + ν·g: q − q0 is normal to the manifold at q, not at q0.
        stationarity = x[:n] - q0.ravel() + nu @ gradient(equations, q)
        return jnp.concatenate([stationarity, equations.constraint(q)])

    guess = jnp.concatenate([q0.ravel(), jnp.zeros_like(start.g)])
    x, of_q = find_root(residual, guess, guess, equations.newton)
    q = x[:n].reshape(q0.shape)
    p, of_p = tangent(equations, t, q, p0)
    is_root = of_q.converged & of_p.converged & jnp.all(jnp.isfinite(p))
    # A factor and not jnp.where(…, x, nan), of which the derivative would be 0 and not NaN.
    q, p = (x * jnp.where(is_root, 1.0, jnp.nan).astype(x.dtype) for x in (q, p))
    distances = (jnp.sqrt(jnp.sum(x * x)) for x in (q - q0, p - p0))
    return Projection(q, p, *distances), start, is_root
