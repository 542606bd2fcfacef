"""Common parts of the collocation methods: a base, their integrals, the continuous rates."""

from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..base.types import Interval, Scalar
from ._base import Method
from .step import Equations


class Collocation(Method):
    """Base of the symmetric methods that solve for their s stages together."""

    stages: eqx.AbstractVar[int]

    is_symmetric: ClassVar[bool] = True
    is_symplectic: ClassVar[bool] = True
    is_invertible: ClassVar[bool] = True

    def inverse(self, equations, interval, q1, p1):
        # A symmetric method is its own adjoint, so that the step by −h undoes the step by h.
        return self.step(equations, interval.reversed(), q1, p1)


def exact_nodes(guesses: Iterable[float], slope: Callable) -> list[Fraction]:
    """Zeros x near floating-point numbers, to 48 digits; ``slope(x)`` → (f(x), f'(x))."""
    nodes = []
    for guess in guesses:
        x = Fraction(float(guess))
        for _ in range(3):  # Newton's steps double the digits
            value, derivative = slope(x)
            x = Fraction(round((x - value / derivative) * 2**160), 2**160)
        nodes.append(x)
    # Symmetric, because the reversal of a step depends on it.
    return [(x - y) / 2 for x, y in zip(nodes, reversed(nodes), strict=True)]


def legendre(x: Fraction, degree: int) -> list[Fraction]:
    """P_0(x), …, P_degree(x)."""
    P = [Fraction(1), x]
    for k in range(1, degree):
        P.append(((2 * k + 1) * x * P[k] - k * P[k - 1]) / (k + 1))
    return P[: degree + 1]


def legendre_slope(x: Fraction, degree: int) -> Fraction:
    """P'_degree(x) at an inner x."""
    *_, previous, last = legendre(x, degree)
    return degree * (x * last - previous) / (x * x - 1)


def integrals(x: Sequence[Fraction], b: Sequence[Any], degree: int) -> np.ndarray:
    r"""a_ij = ∫₀^{c_i} ℓ_j of the Lagrange polynomials ℓ_j at c = (x + 1)/2, as fractions.

    With P_k the Legendre polynomials and P_{−1} = −1,

        a_ij = b_j Σ_{k<degree} P_k(x_j) [P_{k+1}(x_i) − P_{k−1}(x_i)] / 2.

    **Source** Hairer & Wanner 1996, *Solving ODEs II*, IV.5 (the W-transformation).
    """
    # The expansion of ℓ_j in Legendre polynomials, integrated term by term. `degree` is s for s
    # Gauss nodes, and s − 1 for s Lobatto nodes, where the integral of the last term vanishes.
    P = np.array([legendre(y, degree) for y in x], object)  # (s, degree + 1)
    lower = np.concatenate([np.full((len(x), 1), -1), P[:, : degree - 1]], axis=1)
    return np.array(b, object) * ((P[:, 1:] - lower) / 2 @ P[:, :degree].T)


def coefficients(exact: np.ndarray, dtype: Any) -> Array:
    """An array of fractions: rounded in floating point, and a pair in `DoubleDouble`."""
    upper = exact.astype(float)
    lower = (exact - np.vectorize(Fraction, otypes=[object])(upper)).astype(float)
    # A sum that floating point rounds to its first term, and pairs of numbers do not.
    return jnp.asarray(upper, dtype) + jnp.asarray(lower, dtype)


def continuous_rates(equations: Equations, like: Scalar) -> tuple[Callable, Callable]:
    """∂H/∂p and −∂H/∂q + εW as functions of (t, q, p), with H(t, q, p) = H_D(t, t, q, p)."""

    # Both times of H_D are t. The rates do not use the h of the interval, which is therefore 0.
    def instant(t: Scalar) -> Interval:
        return Interval(t, t, jnp.zeros_like(like))

    return (
        lambda t, q, p: equations.position_rate(instant(t), q, p),
        lambda t, q, p: equations.momentum_rate(instant(t), q, p),
    )
