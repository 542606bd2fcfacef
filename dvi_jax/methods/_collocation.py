"""Common parts of the collocation methods: a base, and their integrals."""

from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

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


def zeros_near(guesses: Iterable[float], slope: Callable) -> list[Fraction]:
    """Zeros x of f near floating-point numbers, to 48 digits; ``slope(x)`` → (f(x), f'(x))."""
    zeros = []
    for guess in guesses:
        x = Fraction(float(guess))
        for _ in range(3):  # Newton's steps double the digits
            value, derivative = slope(x)
            x = Fraction(round((x - value / derivative) * 2**160), 2**160)
        zeros.append(x)
    # Symmetric, because the reversal of a step depends on it.
    return [(x - y) / 2 for x, y in zip(zeros, reversed(zeros), strict=True)]


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
