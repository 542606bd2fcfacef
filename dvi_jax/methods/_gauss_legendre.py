"""The Gauss–Legendre collocation methods."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._checks import whole
from .._step import judge
from ..engine.newton import find_root
from ._collocation import (
    Collocation,
    coefficients,
    continuous_rates,
    exact_nodes,
    integrals,
    legendre,
    legendre_slope,
)

# Order 16: the order conditions are tested up to there.
_MOST_STAGES = 8


@functools.cache
def _table(stages: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r"""Nodes c (s,), weights b (s,) and a (s, s), a_ij = ∫₀^{c_i} ℓ_j, as fractions."""
    # x = 2c − 1 are the zeros of P_s. Therefore the sum in `integrals` telescopes in
    # b_i a_ij + b_j a_ji = b_i b_j, the condition of symplecticity.
    x = exact_nodes(
        np.polynomial.legendre.leggauss(stages)[0],
        lambda x: (legendre(x, stages)[-1], legendre_slope(x, stages)),
    )
    b = [1 / ((1 - y * y) * legendre_slope(y, stages) ** 2) for y in x]
    return (np.array(x, object) + 1) / 2, np.array(b, object), integrals(x, b, stages)


class GaussLegendre(Collocation):
    r"""The Gauss–Legendre method of s stages, of order 2s, on the continuous equations.

        q̇ = ∂H/∂p,   ṗ = −∂H/∂q + εW     with H(t, q, p) = H_D(t, t, q, p)

        Q_i = q0 + h Σ_j a_ij ∂H/∂p (t_j, Q_j, P_j)               t_j = t0 + c_j h
        P_i = p0 + h Σ_j a_ij (−∂H/∂q + εW)(t_j, Q_j, P_j)
        q1 = q0 + h Σ_j b_j ∂H/∂p,    p1 = p0 + h Σ_j b_j (−∂H/∂q + εW)

    The energy, a perturbation and the force are evaluated on the diagonal t0 = t1, as in
    `RungeKutta4`; c, b, a are the nodes, weights and integrals of Gauss quadrature. One stage is
    the implicit midpoint rule. Symmetric; without a force symplectic, and every quadratic
    invariant, qᵀBp for instance, is conserved to round-off. Without a force it is the type II
    variational map (12)–(13) of another discrete Hamiltonian, the value that is stationary in P_i
    and V_i of

        Σ_i b_i [H(t_i, Q_i, P_i) − (P_i − p1)·V_i],    Q_i = q0 + h Σ_j a_ij V_j

    Each step solves for all stages at once by `newton`, 2 s n real unknowns for q of n
    components, separable or not: the cost of a high order without substeps backwards in time.

    **Arguments**

    - `stages`: s, from 1 to 8.

    **Raises** `ValueError` for any other number of stages. The status of the step reports a solve
    that fails.

    **Accuracy** order 2s with a force too, which may depend on p and on time. The coefficients
    hold to round-off.

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

        position_rate, momentum_rate = continuous_rates(equations, h)

        def rates(t, z):
            return jnp.stack([position_rate(t, *z), momentum_rate(t, *z)])

        def advanced(weights, stages):
            """z0 + h Σ_j weights_j (q̇, ṗ)_j: shape (2, *q0.shape), with weights' rows in front."""
            change = jnp.tensordot(weights, jax.vmap(rates)(times, stages), 1)
            return jnp.broadcast_to(z0, change.shape) + h * change

        def residual(x):
            return x - advanced(a, x.reshape(all_at_start.shape)).ravel()

        # One fixed-point sweep: for one more evaluation of the rates the guess is good to O(h²).
        guess = advanced(a, all_at_start)
        # The accuracy of a solve is relative to the whole state, also where increments relative to
        # an origin are solved for, as in compensated summation.
        known = jnp.broadcast_to(jnp.stack(equations.absolute(q0, p0)), all_at_start.shape)
        represented = jnp.maximum(jnp.abs(all_at_start), jnp.abs(guess)).ravel()
        x, info = find_root(residual, guess.ravel(), known.ravel(), equations.newton, represented)
        q1, p1 = advanced(b, x.reshape(all_at_start.shape))
        return q1, p1, judge(info, q1, p1)

    def needs_no_solve(self, equations, interval, q) -> bool:
        return False
