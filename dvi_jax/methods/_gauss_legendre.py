"""The Gauss–Legendre collocation methods."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.checks import whole
from ..base.types import Interval
from ..engine.newton import find_root
from ..problem.implicit import Implicit
from ._collocation import Collocation, coefficients, integrals, legendre, legendre_slope, zeros_near
from .step import Equations, judge

# Order 16: the order conditions are tested up to there.
_MOST_STAGES = 8


@functools.cache
def _table(stages: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r"""Nodes c (s,), weights b (s,) and a (s, s), a_ij = ∫₀^{c_i} ℓ_j, as fractions."""
    # x = 2c − 1 are the zeros of P_s. Therefore the sum in `integrals` telescopes in
    # b_i a_ij + b_j a_ji = b_i b_j, the condition of symplecticity.
    guesses, _ = np.polynomial.legendre.leggauss(stages)
    x = zeros_near(guesses, lambda x: (legendre(x, stages)[-1], legendre_slope(x, stages)))
    b = [1 / ((1 - y * y) * legendre_slope(y, stages) ** 2) for y in x]
    return (np.array(x, object) + 1) / 2, np.array(b, object), integrals(x, b, stages)


class _Inner(NamedTuple):
    """The rates of a system whose H is an `Implicit`, with the inner unknowns y given."""

    implicit: Implicit
    equations: Equations

    def rates(self, interval: Interval, z: Any, y: Any) -> tuple[Any, Any]:
        """(q̇, ṗ) at z = (q, p) and y."""
        system, epsilon, args = self.equations.system, self.equations.epsilon, self.equations.args
        point = (*interval[:2], *self.equations.absolute(*z), y, epsilon, args)
        return _inner_rates(system, self.implicit, *point)

    def _place(self, t: Any, z: Any) -> tuple[Any, ...]:
        """(t, q, p), the arguments of the user's functions before y and args."""
        time, _ = self.equations.system.times(t, t, self.equations.epsilon)
        return time, *self.equations.absolute(*z)

    def defect(self, t: Any, z: Any, y: Any) -> Any:
        return self.implicit.relation(*self._place(t, z), y, self.equations.args)

    def start(self, t: Any, z: Any, stages: int) -> Any:
        """The y of the first point, for each stage."""
        # The guess of the user suffices: Newton's first iteration corrects it with the stages.
        y = self.implicit.guess(*self._place(t, z), self.equations.args)
        return jnp.broadcast_to(y, (stages, *y.shape))


# Jitted, as the rates of other systems: all calls in a step share one trace.
@eqx.filter_jit
def _inner_rates(system, implicit, t0, t1, q, p, y, epsilon, args):
    s, _ = system.times(t0, t1, epsilon)
    rise, velocity = implicit.rates(s, q, p, y, args)
    return velocity, system.disturbing_force(t0, t1, q, p, epsilon, args) - rise


def _inner(equations: Equations) -> _Inner | None:
    H = getattr(equations.system.H_D, "H", None)
    # A perturbation of such a system has an inner solve of its own: then all of it has.
    if not isinstance(H, Implicit) or equations.system.perturbation is not None:
        return None
    return _Inner(H, equations)


class GaussLegendre(Collocation):
    r"""The Gauss–Legendre method of s stages, of order 2s, on the continuous equations.

        q̇ = ∂H/∂p,   ṗ = −∂H/∂q + εW     with H(t, q, p) = H_D(t, t, q, p)

        Q_i = q0 + h Σ_j a_ij ∂H/∂p (t_j, Q_j, P_j)               t_j = t0 + c_j h
        P_i = p0 + h Σ_j a_ij (−∂H/∂q + εW)(t_j, Q_j, P_j)
        q1 = q0 + h Σ_j b_j ∂H/∂p,    p1 = p0 + h Σ_j b_j (−∂H/∂q + εW)

    The energy, a perturbation and the force are evaluated on the diagonal t0 = t1, as in
    `RungeKutta4`; c, b, a are the nodes, weights and integrals of Gauss quadrature. One stage is
    the implicit midpoint rule. Symmetric; without a force symplectic, and every quadratic
    invariant, qᵀBp for instance, is conserved to round-off. Without a force it is the type II map
    (12)–(13) of another discrete Hamiltonian, the value stationary in P_i and V_i of

        Σ_i b_i [H(t_i, Q_i, P_i) − (P_i − p1)·V_i],    Q_i = q0 + h Σ_j a_ij V_j

    Each step solves for all stages at once by `newton`, 2 s n real unknowns for q of n
    components, separable or not: the cost of a high order without substeps backwards in time.

    **Arguments**

    - `stages`: s, from 1 to 8.

    **Raises** `ValueError` for another number of stages. The status reports a solve that fails.

    **Accuracy** order 2s with a force of p and time too. The coefficients hold to round-off.

    **Source** Butcher 1964; Hairer, Lubich & Wanner 2006, *Geometric Numerical Integration*,
    II.1.3, IV.2.1 (quadratic invariants), VI.4 and VI.6 (symplectic, variational); type II: Leok &
    Zhang 2011, *IMA J. Numer. Anal.* 31, 1497.
    """

    stages: int = eqx.field(static=True, default=2)

    def __check_init__(self):
        whole("stages", self.stages, 1, _MOST_STAGES, hint="The order is 2·stages.")

    @property
    def order(self) -> int:
        """The order 2s."""
        return 2 * self.stages

    def step(self, equations, interval, q0, p0):
        t0, t1, h = interval
        c, b, a = (coefficients(part, q0.dtype) for part in _table(self.stages))
        times = t0 + c * (t1 - t0)
        z0 = jnp.stack([q0, p0])
        all_at_start = jnp.broadcast_to(z0, (self.stages, *z0.shape))
        inner = _inner(equations)

        def rates(t, z, y):
            # Both times of H_D are t. The rates do not use the h of the interval.
            instant = Interval(t, t, jnp.zeros_like(h))
            if inner is None:
                return jnp.stack(equations.rates(instant, *z))
            return jnp.stack(inner.rates(instant, z, y))

        def advance(weights, stages, y):
            """z0 + h Σ_j weights_j (q̇, ṗ)_j: shape (2, *q0.shape), with weights' rows in front."""
            change = jnp.tensordot(weights, jax.vmap(rates)(times, stages, y), 1)
            return jnp.broadcast_to(z0, change.shape) + h * change

        # The inner unknowns follow the stages, so that without them nothing is concatenated.
        def split(x):
            """The stages, and the inner unknowns of each stage."""
            stages, y = x[: all_at_start.size], x[all_at_start.size :]
            return stages.reshape(all_at_start.shape), y.reshape((self.stages, -1))

        def residual(x):
            stages, y = split(x)
            implicit = (stages - advance(a, stages, y)).ravel()
            if inner is None:
                return implicit
            return jnp.concatenate([implicit, jax.vmap(inner.defect)(times, stages, y).ravel()])

        # One fixed-point sweep: for one more evaluation of the rates the guess is good to O(h²).
        y0 = jnp.zeros((self.stages, 0), q0.dtype)
        y0 = y0 if inner is None else inner.start(t0, z0, self.stages)
        guess = advance(a, all_at_start, y0)
        # The accuracy of a solve is relative to the whole state, also where increments relative to
        # an origin are solved for, as in compensated summation.
        size = jnp.broadcast_to(jnp.stack(equations.absolute(q0, p0)), all_at_start.shape)
        start = jnp.maximum(jnp.abs(all_at_start), jnp.abs(guess))
        parts = guess, size, start
        guess, size, start = (jnp.concatenate([u.ravel(), y0.ravel()]) for u in parts)
        x, info = find_root(residual, guess, size, equations.newton, start)
        z, y = split(x)
        q1, p1 = advance(b, z, y)
        return q1, p1, judge(info, q1, p1)

    def needs_no_solve(self, equations, interval, q) -> bool:
        return False
