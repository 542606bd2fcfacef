"""The partitioned pair of Lobatto IIIA and IIIB methods."""

import functools
import math
from fractions import Fraction

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..base.checks import whole
from ..engine.newton import find_root
from ._collocation import Collocation, coefficients, integrals, legendre, legendre_slope, zeros_near
from .step import continuous_rates, judge, no_solve

# Order 10: the order conditions are tested up to there.
_MOST_STAGES = 6

# Fixed-point sweeps before Newton's method. They save about one of its three iterations.
_SWEEPS = 3


@functools.cache
def _table(stages: int) -> tuple[np.ndarray, ...]:
    r"""Nodes c, weights b, IIIA's a, IIIB's â and the weights of the last P, as fractions.

    x = 2c − 1 are the ends ∓1 and the zeros of P'_{s−1}; b_i = 1/(s(s − 1) P_{s−1}(x_i)²). Then
    a_ij = ∫₀^{c_i} ℓ_j, whose first row is zero and last row b, and from it, by the condition of
    symplecticity b_i â_ij + b_j a_ji = b_i b_j,

        â_ij = b_j (1 − a_ji / b_i),

    whose first column is b_1 and last column zero.

    **Source** Hairer & Wanner 1996, *Solving ODEs II*, IV.5; Hairer, Lubich & Wanner 2006, II.1.4.
    """
    n = stages - 1

    def slope(x: Fraction) -> tuple[Fraction, Fraction]:
        # P'_n, and P''_n from Legendre's differential equation.
        first = legendre_slope(x, n)
        return first, (2 * x * first - n * stages * legendre(x, n)[-1]) / (1 - x * x)

    guesses = np.polynomial.legendre.Legendre.basis(n).deriv().roots()
    x = [Fraction(-1), *zeros_near(guesses, slope), Fraction(1)]
    b = [1 / (stages * n * legendre(y, n)[-1] ** 2) for y in x]
    a, ratio = integrals(x, b, n), integrals(x, [1] * stages, n)
    # The P_i lie on a polynomial of degree s − 2, so that P_s = Σ_{i<s} last_i P_i: one unknown
    # less to solve for.
    inner = x[:-1]
    last = [math.prod((1 - z) / (y - z) for z in inner if z != y) for y in inner]
    c, b, last = (np.array(part, object) for part in (x, b, last))
    return (c + 1) / 2, b, a, b * (1 - ratio.T), last


class LobattoIIIAIIIB(Collocation):
    r"""The partitioned Lobatto IIIA–IIIB pair of s stages, of order 2s − 2.

        q̇ = ∂H/∂p,   ṗ = −∂H/∂q + εW     with H(t, q, p) = H_D(t, t, q, p)

        Q_i = q0 + h Σ_j a_ij ∂H/∂p (t_j, Q_j, P_j)               t_j = t0 + c_j h
        P_i = p0 + h Σ_j â_ij (−∂H/∂q + εW)(t_j, Q_j, P_j)
        q1 = q0 + h Σ_j b_j ∂H/∂p,    p1 = p0 + h Σ_j b_j (−∂H/∂q + εW)

    The energy, a perturbation and the force are evaluated on the diagonal t0 = t1, as in
    `GaussLegendre`; c, b and a are the nodes, weights and integrals of Lobatto quadrature (IIIA),
    and â_{ij} = b_j (1 − a_{ji} / b_i) (IIIB). Q_1 = q0 and Q_s = q1. Symmetric; without a force
    symplectic, and every invariant that is bilinear in q and p, angular momentum for instance, is
    conserved to round-off. Without a force it is the type II variational map (12)–(13) of another
    discrete Hamiltonian, with the formula of `GaussLegendre`: the action of curves q of degree s by
    Lobatto quadrature. For a regular Lagrangian it is the integrator of that quadrature of ∫L dt.

    Two stages are the generalised leapfrog, Störmer–Verlet (kick, drift, kick) for a separable H:
    the map of `Strang` wherever H_D and W do not depend on t1, and `Strang` has the smaller solves.
    More stages give the order of a composition, without substeps backwards in time.

    Each step solves for the stages at once by Newton's method: (s − 1) n real unknowns for q of n
    components where q does not enter ∂H/∂p, a force in p and t included, and 2 (s − 1) n where it
    does; `GaussLegendre(s − 1)`, of the same order, has 2 (s − 1) n in both cases. Two stages of a
    separable H without a force in p need no solve.

    **Arguments**

    - `stages`: s, from 2 to 6.

    **Raises** `ValueError` for another number of stages. The status reports a solve that fails.

    **Accuracy** order 2s − 2 with a force of p and time too. The coefficients hold to round-off.

    **Source** Jay 1996, *SIAM J. Numer. Anal.* 33, 368; Hairer, Lubich & Wanner 2006, *Geometric
    Numerical Integration*, II.2.2 (order), IV.2.2 (invariants), VI.4, VI.6 (variational).
    """

    stages: int = eqx.field(static=True, default=2)

    def __check_init__(self):
        whole("stages", self.stages, 2, _MOST_STAGES, hint="The order is 2·stages − 2.")

    @property
    def order(self) -> int:
        """The order 2s − 2."""
        return 2 * self.stages - 2

    def step(self, equations, interval, q0, p0):
        t0, t1, h = interval
        s, table = self.stages, _table(self.stages)
        c, b, a, a_hat, last = (coefficients(part, q0.dtype) for part in table)
        times = t0 + c * (t1 - t0)
        velocities, forces = map(jax.vmap, continuous_rates(equations, h))
        # Where q does not enter ∂H/∂p the Q follow from the P, which halves the unknowns.
        momenta_suffice = equations.inverse_is_explicit(interval, q0)

        def positions(Q, P):
            return q0[None] + h * jnp.tensordot(a, velocities(times, Q, P), 1)

        def momenta(Q, P):
            rates = forces(times[:-1], Q[:-1], P[:-1])  # the last column of â is zero
            return p0[None] + h * jnp.tensordot(a_hat[:, :-1], rates, 1)

        def unknowns(Q, P):
            """P_1, …, P_{s−1}, and Q_2, …, Q_s unless they follow from the P."""
            return (P[:-1] if momenta_suffice else jnp.concatenate([P[:-1], Q[1:]])).ravel()

        def at_stages(x):
            x = x.reshape(-1, *q0.shape)
            P = jnp.concatenate([x[: s - 1], jnp.tensordot(last, x[: s - 1], 1)[None]])
            if momenta_suffice:
                return positions(jnp.broadcast_to(q0, P.shape), P), P
            return jnp.concatenate([q0[None], x[s - 1 :]]), P

        def residual(x):
            Q, P = at_stages(x)
            return x - unknowns(positions(Q, P), momenta(Q, P))

        def sweep(_, stages):
            Q = positions(*stages)
            return Q, momenta(Q, stages[1])

        start = tuple(jnp.broadcast_to(z, (s, *z.shape)) for z in (q0, p0))
        if self.needs_no_solve(equations, interval, q0):  # one sweep finds P_1 = P_2
            x = unknowns(*sweep(0, start))
            info = no_solve(q0)
        else:
            guess = lax.fori_loop(0, _SWEEPS, sweep, lax.stop_gradient(start))
            size = (jnp.broadcast_to(z, (s, *z.shape)) for z in equations.absolute(q0, p0))
            x0 = unknowns(*guess)
            represented_size = jnp.maximum(jnp.abs(unknowns(*start)), jnp.abs(x0))
            x, info = find_root(residual, x0, unknowns(*size), equations.newton, represented_size)
        Q, P = at_stages(x)
        q1, p1 = Q[-1], p0 + h * jnp.tensordot(b, forces(times, Q, P), 1)
        return q1, p1, judge(info, q1, p1)

    def needs_no_solve(self, equations, interval, q) -> bool:
        parts = equations.step_is_explicit, equations.inverse_is_explicit
        return self.stages == 2 and all(is_explicit(interval, q) for is_explicit in parts)
