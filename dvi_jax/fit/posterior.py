"""What data say of parameters, as a density."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._checks import one_of
from .._precision import require_double
from .losses import LeastSquares, Likelihood, Loss
from .observations import Data, as_arcs
from .parameters import Space, make_space
from .problem import Problem
from .stages import MANY
from .uncertainty import in_words, uncertainty


class Posterior:
    r"""Density of parameters given observations, in free variables u.

        potential(u) = −log p(data | x) − log p(x) − Σ log |dx/du|,    x = to_x(u),

    up to a constant. With the log-Jacobian of the bounds' transformation, priors are meant in x:
    uniform between the bounds, times `Prior`. Without either the prior is flat, 1.

    −log p(data | x) is

    - ½ Σ ρ(r²) for data with errors, r predicted minus observed in standard errors;
    - (N/2) log Σ r² for N values without sigma: normal errors of one unknown size s, integrated
      over s with Jeffreys' prior 1/s;
    - what a `Likelihood` says.

    Where a trajectory fails the potential is +inf with slope 0: the density is 0 there, no NaN.

    - `model`, `data`, `params`, `bounds`, `priors`, `loss`: as for `fit`. Priors go with data
      without errors too.
    - `gradient`: ``"reverse"``: through the integrator, for two to four trajectories whatever the
      number of parameters; ``"forward"``: Jᵀ dU/dr with one tangent for each parameter, exact
      where rebuilt states would be in doubt. By either, derivatives of any order and both modes.

    It has `names` and `size` of the parameters, and `start`, u at `params`. `potential` can be
    compiled, batched and differentiated, and suits any sampler: ``NUTS(potential_fn=...)`` of
    numpyro, ``log_density`` for those that take the logarithm.

    **Raises** `ValueError` or `TypeError` for input that cannot be meant; `ValueError` for fewer
    values than parameters that neither a prior nor two bounds hold: such a density has no integral.

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
        arcs, many = as_arcs(data)
        # Priors are added here, so that they go with errors of unknown size as well.
        self._problem = Problem(model, arcs, many, params, bounds=bounds, loss=loss)
        self._core = self._problem.core
        self._space, x = make_space(params, bounds, priors)
        self.names, self.size = list(self._space.names), self._space.size
        self.start = self._space.to_u(x)
        self._check_count()
        self._slopes = self._forward if gradient == "forward" else self._reverse
        self._potential = jax.jit(_guarded(self._value, self._slopes))
        self._local = jax.jit(self._exact if isinstance(loss, Likelihood) else self._quadratic)

    def _check_count(self) -> None:
        space, count = self._space, self._problem.count
        held = (np.asarray(space.prior_weight) > 0) | (np.array(space.below) & space.above)
        free = int((~held).sum())
        lost = 0 if self._problem.has_errors or isinstance(self._problem.loss, Likelihood) else 1
        if count < free + lost:
            raise ValueError(
                f"{free} parameters without a prior or two bounds"
                + (", and the size of the errors," if lost else "")
                + f" cannot follow from {count} observed values: the posterior has no integral. "
                "Give priors, bounds on both sides, or more observations."
            )

    # ---- the density

    def potential(self, u: Array) -> Array:
        """−log of the posterior density at the free vector u, shape (n,), up to a constant."""
        return self._potential(u)

    def log_density(self, u: Array) -> Array:
        """`potential` with the other sign."""
        return -self._potential(u)

    def to_x(self, u: Array) -> Array:
        """The parameters' numbers, within their bounds, shape (n,)."""
        return self._space.to_x(u)

    def to_u(self, x: Any) -> np.ndarray:
        """The free vector of x."""
        return self._space.to_u(x)

    def to_params(self, u: Array) -> PyTree:
        """The pytree of parameters at u."""
        return self._space.to_params(self._space.to_x(u))

    def _beside(self, u: Array) -> Array:
        """−log of prior and Jacobian."""
        space = self._space
        off = (space.to_x(u) - space.prior_mean) * space.prior_weight
        return jnp.sum(off**2) / 2 - jnp.sum(log_slope(space, u))

    def _misfit(self, square: Array) -> Array:
        """−log likelihood from Σ of the squared residuals."""
        return square / 2 if self._problem.has_errors else self._problem.count * jnp.log(square) / 2

    def _value(self, u: Array) -> Array:
        if isinstance(self._problem.loss, Likelihood):
            return self._core.scalar(u) + self._beside(u)
        r = self._core.residuals(u)
        return self._misfit(r @ r) + self._beside(u)

    def _reverse(self, u: Array) -> tuple[Array, Array]:
        return jax.value_and_grad(self._value)(u)

    def _forward(self, u: Array) -> tuple[Array, Array]:
        if isinstance(self._problem.loss, Likelihood):
            slope, value = jax.jacfwd(lambda u: (self._value(u),) * 2, has_aux=True)(u)
            return value, slope
        r, J, _ = self._core.evaluate(u)
        data, weight = jax.value_and_grad(self._misfit)(r @ r)
        beside, slope = jax.value_and_grad(self._beside)(u)
        return data + beside, 2 * weight * (r @ J) + slope

    # ---- its normal approximation

    def _quadratic(self, u: Array) -> tuple[Array, Array, Array]:
        """Potential, its slope, and A with AᵀA its Gauss–Newton Hessian, priors last."""
        space = self._space
        r, J, _ = self._core.evaluate(u)
        data, weight = jax.value_and_grad(self._misfit)(r @ r)
        beside, bent = jax.value_and_grad(self._beside)(u)
        ones = jnp.ones_like(u)
        slope = jax.jvp(space.to_x, (u,), (ones,))[1]
        bend = jax.jvp(jax.grad(lambda u: -jnp.sum(log_slope(space, u))), (u,), (ones,))[1]
        rows = [jnp.diag(space.prior_weight * slope), jnp.diag(jnp.sqrt(bend))]
        A = jnp.concatenate([jnp.sqrt(2 * weight) * J, *rows])
        return data + beside, 2 * weight * (r @ J) + bent, A

    def _exact(self, u: Array) -> tuple[Array, Array, Array]:
        """The same with the Hessian itself, its curvatures taken positive."""
        value, slope = self._slopes(u)
        H = jax.jacfwd(jax.grad(self._potential))(u)
        values, vectors = jnp.linalg.eigh((H + H.T) / 2)
        return value, slope, jnp.sqrt(jnp.abs(values))[:, None] * vectors.T

    def laplace(self, u: Any = None, max_steps: int = 50) -> tuple[np.ndarray, np.ndarray]:
        """Mode of the density of u, shape (n,), and L with L Lᵀ its covariance there, (n, n).

        Damped Gauss–Newton steps from u (None: `start`). For more than 400 parameters u itself and
        the identity.

        **Raises** `ValueError` where the density is 0 at u, or a direction of the parameters is
        determined by neither data nor priors.
        """
        u = np.array(self.start if u is None else u, float)
        if self.size > MANY:
            self._check_value(u, float(self._potential(jnp.asarray(u))))
            return u, np.eye(self.size)
        u, A = self._descend(u, max_steps)
        about = uncertainty(A, 1.0)
        if about.undetermined.size:
            words = "; ".join(in_words(d, self.names) for d in about.undetermined.T)
            raise ValueError(
                f"neither the data nor priors determine {words}: the posterior has no integral "
                "along it. Give a prior or bounds on both sides, or sample fewer parameters."
            )
        return u, about.directions / about.singular_values

    def _check_value(self, u: np.ndarray, value: float) -> None:
        if not np.isfinite(value):
            x = np.asarray(self.to_x(jnp.asarray(u)))
            raise ValueError(
                f"the posterior density is 0 at the start ({self._space.in_words(x)}): the "
                "model's trajectory fails, or its misfit is no number. Start from other "
                "parameters, or take a smaller h."
            )

    def _descend(self, u: np.ndarray, max_steps: int) -> tuple[np.ndarray, np.ndarray]:
        """The mode by Levenberg–Marquardt, until a step would gain less than 1e-8, and A there."""
        value, g, A = self._look(u)
        self._check_value(u, value)
        damping = 1e-3
        for _ in range(max_steps):
            length = np.linalg.norm(A, axis=0)
            length = np.where(length > 0, length, 1.0)
            unit = A / length
            left = unit.T @ unit + (damping + 1e-14) * np.eye(len(u))
            step = -np.linalg.solve(left, g / length) / length
            if not -g @ step > 1e-8:
                break
            new, *rest = self._look(u + step)
            if new < value and all(np.isfinite(x).all() for x in rest):
                u, value, (g, A), damping = u + step, new, rest, damping / 10
            else:
                damping *= 10
        return u, A

    def _look(self, u: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        value, g, A = self._local(jnp.asarray(u))
        return float(value), np.asarray(g), np.asarray(A)


def log_slope(space: Space, u: Array) -> Array:
    """log |dx/du| of each parameter: what the bounds' transformation stretches."""
    below, above = np.array(space.below), np.array(space.above)
    both = below & above
    width = jnp.log(jnp.where(both, space.upper - space.lower, 1.0))
    inside = width + jax.nn.log_sigmoid(u) + jax.nn.log_sigmoid(-u)
    return jnp.where(both, inside, jnp.where(below ^ above, u, 0.0))


def _guarded(value: Callable[[Array], Array], slopes: Callable[[Array], tuple[Array, Array]]):
    """The potential, +inf with slope 0 where it is not finite, with its derivative by `slopes`."""

    @jax.custom_jvp
    def potential(u):
        found = value(u)
        return jnp.where(jnp.isfinite(found), found, jnp.inf)

    @potential.defjvp
    def _(primals, tangents):
        found, slope = slopes(*primals)
        good = jnp.isfinite(found)
        return jnp.where(good, found, jnp.inf), jnp.where(good, slope, 0.0) @ tangents[0]

    return potential
