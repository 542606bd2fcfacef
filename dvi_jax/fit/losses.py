"""What is made small: functions of the residuals in units of their errors."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._checks import positive


class Loss(eqx.Module):
    r"""Base of the losses ½ Σ ρ(r²) of whitened residuals r.

    Robust ones grow slower than r² for large r, so that outliers pull less.
    """

    @abc.abstractmethod
    def root(self, r: Array) -> Array:
        """√ρ(r²) with the sign of r, smooth in r: what Gauss–Newton takes for its residual."""


class LeastSquares(Loss):
    """ρ(s) = s: the likelihood of normally distributed errors."""

    def root(self, r):
        return r


class SoftL1(Loss):
    """ρ(s) = 2 k² (√(1 + s/k²) − 1): like s up to k standard errors, then like 2 k √s.

    s is the square of a residual over its standard error, k is `scale`.
    """

    scale: float = 1.5

    def __check_init__(self):
        positive("scale", self.scale, hint="It counts standard errors.")

    def root(self, r):
        s = (r / self.scale) ** 2
        return r * jnp.sqrt(2 / (jnp.sqrt(1 + s) + 1))


class Cauchy(Loss):
    """ρ(s) = k² log(1 + s/k²): errors with the tails of Cauchy's distribution.

    s is the square of a residual over its standard error, k is `scale`.
    """

    scale: float = 2.4

    def __check_init__(self):
        positive("scale", self.scale, hint="It counts standard errors.")

    def root(self, r):
        s = (r / self.scale) ** 2
        small = s < 1e-6
        safe = jnp.where(small, 1.0, s)
        ratio = jnp.where(small, 1 - s / 2 + s**2 / 3, jnp.log1p(safe) / safe)
        return r * jnp.sqrt(ratio)


class Likelihood(eqx.Module):
    """Any likelihood of the observations.

    - `negative_log_density`: function ``(predicted, observed, sigma, params)`` → −log of the
      density for each value, an array of their shape. `observed` and `sigma` have the shape of
      one arc's values (N, K), flattened in components; sigma is 1 when the data have none.
      Where a value is missing what it returns is not counted.

    Parameters may be those of the errors themselves, a noise level for instance.
    """

    negative_log_density: Callable[..., Any]
