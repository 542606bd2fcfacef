"""Loss functions: functions of the residuals in units of their standard errors."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..base.checks import positive


class Loss(eqx.Module):
    r"""Base of the losses ½ Σ ρ(r²) of whitened residuals r.

    Robust losses grow more slowly than r² for large r, so that outliers have less influence.
    """

    @abc.abstractmethod
    def root(self, r: Array) -> Array:
        """√ρ(r²) with the sign of r, smooth in r: the residual of Gauss–Newton steps."""


class LeastSquares(Loss):
    """ρ(s) = s: the likelihood of normally distributed errors."""

    def root(self, r):
        return r


class _Robust(Loss):
    """A loss with a scale, in standard errors."""

    scale: eqx.AbstractVar[float]

    def __check_init__(self):
        positive("scale", self.scale, hint="Its unit is the standard error.")


class SoftL1(_Robust):
    """ρ(s) = 2 k² (√(1 + s/k²) − 1): like s up to k standard errors, then like 2 k √s.

    s is the square of a residual over its standard error, k is `scale`.
    """

    scale: float = 1.5

    def root(self, r):
        s = (r / self.scale) ** 2
        return r * jnp.sqrt(2 / (jnp.sqrt(1 + s) + 1))


class Cauchy(_Robust):
    """ρ(s) = k² log(1 + s/k²): errors with the tails of Cauchy's distribution.

    s is the square of a residual over its standard error, k is `scale`.
    """

    scale: float = 2.4

    def root(self, r):
        s = (r / self.scale) ** 2
        # log1p(s)/s is 0/0 at s = 0, and so is its derivative: the series is used there.
        small = s < 1e-6
        safe = jnp.where(small, 1.0, s)
        ratio = jnp.where(small, 1 - s / 2 + s**2 / 3, jnp.log1p(safe) / safe)
        return r * jnp.sqrt(ratio)


class Likelihood(eqx.Module):
    """A user-defined likelihood of the observations; its parameters may include a noise level.

    - `negative_log_density`: function ``(predicted, observed, sigma, params)`` → −log of the
      density for each value, an array of their shape. `observed` and `sigma` have the shape (N, K)
      of one arc's values, flattened in components; sigma is 1 for data without errors. Results for
      missing values are ignored.
    """

    negative_log_density: Callable[..., Any]
