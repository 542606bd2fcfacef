"""Posterior density of parameters."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..base.checks import one_of
from ..base.precision import require_double
from .checks import enough_values
from .losses import LeastSquares, Likelihood, Loss
from .observations import Data, as_arcs
from .parameters import Space, make_space
from .problem import FitProblem
from .stages import JACOBIAN_LIMIT
from .uncertainty import in_words, uncertainty


class Posterior:
    r"""Density of parameters given observations, in free variables u.

        potential(u) = −log p(data | x) − log p(x) − Σ log |dx/du|,    x = to_x(u),

    up to a constant. The last term is the Jacobian of the bounds' transformation, so that priors
    are densities of x: uniform between the bounds, times `Prior`. Without either the prior is flat.

    −log p(data | x) is

    - ½ Σ ρ(r²) for data with errors, r predicted minus observed in standard errors;
    - (N/2) log Σ r² for N values without sigma: normal errors of one unknown size s, integrated
      over s with Jeffreys' prior 1/s;
    - the value of a `Likelihood`.

    Where a trajectory fails the potential is +inf with slope 0: the density is 0 there, not NaN.

    - `model`, `data`, `params`, `bounds`, `priors`, `loss`: as for `fit`; priors are allowed for
      data without errors too.
    - `gradient`: ``"reverse"``: through the integrator, at the cost of two to four trajectories
      for any number of parameters; ``"forward"``: Jᵀ dU/dr with one tangent for each parameter,
      exact where rebuilt states would be inaccurate. Both give derivatives of any order, by both
      modes.

    It has `names` and `size` of the parameters, and `start`, u at `params`. `potential` can be
    compiled, batched and differentiated, and suits any sampler: ``NUTS(potential_fn=...)`` of
    numpyro, ``log_density`` for those that use the logarithm.

    **Raises** `ValueError` or `TypeError` for invalid input; `ValueError` if the values are fewer
    than the parameters without a prior or two bounds: such a density has no integral.

    **Source** Gelman et al. 2013, *Bayesian Data Analysis*, 3.2 and 10; the Jacobian, Stan
    reference manual, "Constraint transforms".
    """

    def __init__(
        self,
        model: Callable[..., Any],
        data: Data,
        params: PyTree,
        *,
        bounds: PyTree = None,
        priors: PyTree = None,
        loss: Loss | Likelihood = LeastSquares(),
        gradient: str = "reverse",
    ):
        require_double("a posterior")
        one_of("gradient", gradient, ("reverse", "forward"))
        arcs, is_list = as_arcs(data)
        # Priors are added here, so that they also work with errors of unknown size.
        self._problem = FitProblem(model, arcs, is_list, params, bounds=bounds, loss=loss)
        self._core = self._problem.core
        self.space, x = make_space(params, bounds, priors)
        self.names, self.size = list(self.space.names), self.space.size
        self.start = self.space.to_u(x)
        self._has_density = isinstance(loss, Likelihood)
        is_proper = np.asarray(self.space.prior_weight) > 0
        is_proper |= np.array(self.space.has_lower) & self.space.has_upper
        free, count = int((~is_proper).sum()), self._problem.count
        unknown_scale = not (self._problem.has_errors or self._has_density)
        purpose = f"{free} parameters without a prior or two bounds"
        purpose += " and for the size of the errors without sigma" * unknown_scale
        enough_values(count, free + unknown_scale, purpose)
        reverse = jax.value_and_grad(self._value)
        self._slopes = self._forward if gradient == "forward" else reverse
        self._potential = jax.jit(_finite_potential(self._value, self._slopes))
        self._local = jax.jit(self._exact if self._has_density else self._quadratic)

    # ---- the density

    def potential(self, u: Array) -> Array:
        """−log of the posterior density at the free vector u, shape (n,), up to a constant."""
        return self._potential(u)

    def log_density(self, u: Array) -> Array:
        """The negative of `potential`."""
        return -self._potential(u)

    def to_x(self, u: Array) -> Array:
        """Values of the parameters, within their bounds, shape (n,)."""
        return self.space.to_x(u)

    def to_u(self, x: Any) -> np.ndarray:
        """The free vector of x."""
        return self.space.to_u(x)

    def to_params(self, u: Array) -> PyTree:
        """The pytree of parameters at u."""
        return self.space.to_params(self.space.to_x(u))

    def _log_prior(self, u: Array) -> Array:
        """−log of prior and Jacobian."""
        space = self.space
        deviation = (space.to_x(u) - space.prior_mean) * space.prior_weight
        return jnp.sum(deviation**2) / 2 - jnp.sum(log_slope(space, u))

    def _misfit(self, square: Array) -> Array:
        """−log likelihood from Σ of the squared residuals."""
        return square / 2 if self._problem.has_errors else self._problem.count * jnp.log(square) / 2

    def _value(self, u: Array) -> Array:
        if self._has_density:
            return self._core.scalar(u) + self._log_prior(u)
        r = self._core.residuals(u)
        return self._misfit(r @ r) + self._log_prior(u)

    def _forward(self, u: Array) -> tuple[Array, Array]:
        if self._has_density:
            slope, value = jax.jacfwd(lambda u: (self._value(u),) * 2, has_aux=True)(u)
            return value, slope
        value, slope, _ = self._with_jacobian(u)
        return value, slope

    def _with_jacobian(self, u: Array) -> tuple[Array, Array, Array]:
        """Potential and slope by the Jacobian, and the Jacobian with a unit weight."""
        r, J, _ = self._core.evaluate(u)
        data, weight = jax.value_and_grad(self._misfit)(r @ r)
        prior, slope = jax.value_and_grad(self._log_prior)(u)
        return data + prior, 2 * weight * (r @ J) + slope, jnp.sqrt(2 * weight) * J

    # ---- its normal approximation

    def _quadratic(self, u: Array) -> tuple[Array, Array, Array]:
        """Potential, its slope, and A with AᵀA its Gauss–Newton Hessian, priors last."""
        space, unit_vector = self.space, jnp.ones_like(u)
        value, slope, J = self._with_jacobian(u)
        stretch = jax.jvp(space.to_x, (u,), (unit_vector,))[1]
        bend = jax.jvp(jax.grad(lambda u: -jnp.sum(log_slope(space, u))), (u,), (unit_vector,))[1]
        rows = [jnp.diag(space.prior_weight * stretch), jnp.diag(jnp.sqrt(bend))]
        return value, slope, jnp.concatenate([J, *rows])

    def _exact(self, u: Array) -> tuple[Array, Array, Array]:
        """The same with the absolute value of the Hessian itself."""
        value, slope = self._slopes(u)
        H = jax.jacfwd(jax.grad(self._potential))(u)
        values, vectors = jnp.linalg.eigh((H + H.T) / 2)
        return value, slope, jnp.sqrt(jnp.abs(values))[:, None] * vectors.T

    def laplace(self, u: Any = None, max_steps: int = 50) -> tuple[np.ndarray, np.ndarray]:
        """Mode of the density of u, shape (n,), and L with L Lᵀ its covariance there, (n, n).

        By damped Gauss–Newton steps from u (None: `start`). For more than 400 parameters u itself
        and the identity.

        **Raises** `ValueError` where the density is 0 at u, or a direction of the parameters is
        determined by neither data nor priors.
        """
        u = np.array(self.start if u is None else u, float)
        if self.size > JACOBIAN_LIMIT:
            self._check_value(u, float(self._potential(jnp.asarray(u))))
            return u, np.eye(self.size)
        u, _, A = self.descend(u, max_steps)
        spectrum = uncertainty(A, 1.0)
        if spectrum.null_directions.size:
            words = "; ".join(in_words(d, self.names) for d in spectrum.null_directions.T)
            raise ValueError(
                f"neither the data nor priors determine {words} (scaled parameters): give a prior "
                "or bounds on both sides."
            )
        return u, spectrum.directions / spectrum.singular_values

    def _check_value(self, u: np.ndarray, value: float) -> None:
        if not np.isfinite(value):
            x = np.asarray(self.to_x(jnp.asarray(u)))
            raise ValueError(
                f"the posterior density must be positive at the start, got 0 at "
                f"{self.space.in_words(x)}: the trajectory fails there, or the log likelihood is "
                "not finite."
            )

    def descend(self, u: np.ndarray, max_steps: int) -> tuple[np.ndarray, float, np.ndarray]:
        """The mode by Levenberg–Marquardt, until a step would gain less than 1e-8; the potential
        and A there."""
        value, g, A = self.look(u)
        self._check_value(u, value)
        damping = 1e-3
        for _ in range(max_steps):
            length = np.linalg.norm(A, axis=0)
            length = np.where(length > 0, length, 1.0)
            unit = A / length
            matrix = unit.T @ unit + (damping + 1e-14) * np.eye(len(u))
            step = -np.linalg.solve(matrix, g / length) / length
            if not -g @ step > 1e-8:
                break
            new, *derivatives = self.look(u + step)
            if new < value and all(np.isfinite(x).all() for x in derivatives):
                u, value, (g, A), damping = u + step, new, derivatives, damping / 10
            else:
                damping *= 10
        return u, value, A

    def look(self, u: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """The potential, its slope, and A with AᵀA its Gauss–Newton Hessian."""
        value, g, A = self._local(jnp.asarray(u))
        return float(value), np.asarray(g), np.asarray(A)


def log_slope(space: Space, u: Array) -> Array:
    """log |dx/du| of each parameter."""
    has_lower, has_upper = np.array(space.has_lower), np.array(space.has_upper)
    two_sided = has_lower & has_upper
    width = jnp.log(jnp.where(two_sided, space.upper - space.lower, 1.0))
    interior = width + jax.nn.log_sigmoid(u) + jax.nn.log_sigmoid(-u)
    return jnp.where(two_sided, interior, jnp.where(has_lower ^ has_upper, u, 0.0))


def _finite_potential(value: Callable[..., Array], slopes: Callable[..., tuple[Array, Array]]):
    """The potential, +inf with slope 0 where it is not finite, with its derivative by `slopes`."""

    @jax.custom_jvp
    def potential(u):
        result = value(u)
        return jnp.where(jnp.isfinite(result), result, jnp.inf)

    @potential.defjvp
    def _(primals, tangents):
        result, slope = slopes(*primals)
        good = jnp.isfinite(result)
        return jnp.where(good, result, jnp.inf), jnp.where(good, slope, 0.0) @ tangents[0]

    return potential
