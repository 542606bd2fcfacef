"""Common parts of the collocation methods: a base, their integrals, the continuous rates."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import legendre

from .._step import Equations
from .._types import Interval, Scalar, State
from ._base import Method


class Collocation(Method):
    """Base of the symmetric methods that solve for their s stages together."""

    stages: eqx.AbstractVar[int]

    is_symmetric: ClassVar[bool] = True
    is_symplectic: ClassVar[bool] = True
    is_invertible: ClassVar[bool] = True

    def inverse(self, equations, interval, q1, p1):
        # A symmetric method is its own adjoint, so that the step by −h undoes the step by h.
        return self.step(equations, interval.reversed(), q1, p1)

    def inverse_needs_no_solve(self, equations, interval, q) -> bool:
        return self.needs_no_solve(equations, interval, q)


def integrals(x: np.ndarray, b: np.ndarray, degree: int) -> np.ndarray:
    r"""a_ij = ∫₀^{c_i} ℓ_j of the Lagrange polynomials ℓ_j at c = (x + 1)/2, in double precision.

    With P_k the Legendre polynomials and P_{−1} = −1,

        a_ij = b_j Σ_{k<degree} P_k(x_j) [P_{k+1}(x_i) − P_{k−1}(x_i)] / 2.

    **Source** Hairer & Wanner 1996, *Solving ODEs II*, IV.5 (the W-transformation).
    """
    # This is the expansion of ℓ_j in Legendre polynomials, integrated term by term. No digits
    # cancel in it, unlike in a solve with a Vandermonde matrix. `degree` is s for s Gauss nodes,
    # and s − 1 for s Lobatto nodes, where the integral of the last term, a multiple of
    # (1 − x²) P'_{s−1}, vanishes at every node.
    P = legendre.legvander(x, degree)  # (s, degree + 1)
    before = np.concatenate([-np.ones((len(x), 1)), P[:, : degree - 1]], axis=1)
    return b * ((P[:, 1:] - before) / 2 @ P[:, :degree].T)


def continuous_rates(equations: Equations, like: Scalar) -> tuple[Callable, Callable]:
    """∂H/∂p and −∂H/∂q + εW as functions of (t, q, p), with H(t, q, p) = H_D(t, t, q, p)."""

    # Both times of H_D are t. The rates do not use the h of the interval, which is therefore 0.
    def at(t: Scalar) -> Interval:
        return Interval(t, t, jnp.zeros_like(like))

    def position_rate(t: Scalar, q: State, p: State) -> State:
        return equations.position_rate(at(t), q, p)

    def momentum_rate(t: Scalar, q: State, p: State) -> State:
        return equations.momentum_rate(at(t), q, p)

    return position_rate, momentum_rate
