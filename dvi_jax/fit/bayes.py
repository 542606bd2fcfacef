"""What data say of parameters, as a density: the posterior, and draws from it."""

import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._compat import x64_enabled
from ._fit import fit
from .losses import LeastSquares, Likelihood, Loss
from .observations import Observations, as_arcs
from .parameters import Space
from .problem import Problem
from .result import FitResult, with_error
from .results import FIT_RESULTS
from .uncertainty import correlations, in_words, uncertainty

_MANY = 400
"""Parameters beyond which no normal approximation is made: a Jacobian costs a trajectory each."""

_R_HAT = 1.01
"""Largest R̂ of chains that count as mixed (Vehtari et al. 2021)."""

_SATURATED = 0.01
"""Share of draws whose path may be cut short before it is worth a warning."""


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

    **Source** Gelman et al. 2013, *Bayesian Data Analysis*, 3.2 and 10.; the Jacobian, Stan
    reference manual, "Constraint transforms".
    """

    def __init__(
        self,
        model: Callable[..., Any],
        data: Observations | list[Observations] | tuple[Observations, ...],
        params: PyTree,
        *,
        bounds: PyTree = None,
        priors: PyTree = None,
        loss: Loss | Likelihood = LeastSquares(),
        gradient: str = "reverse",
    ):
        if not x64_enabled():
            raise ValueError(
                "a posterior needs double precision: put\n"
                '    jax.config.update("jax_enable_x64", True)\nbefore the first array is made.'
            )
        if gradient not in ("reverse", "forward"):
            raise ValueError(f'gradient must be "reverse" or "forward", got {gradient!r}.')
        arcs, many = as_arcs(data)
        # Priors are added here, so that they go with errors of unknown size as well.
        self._problem = Problem(model, arcs, many, params, bounds=bounds, loss=loss)
        self._space = Space(params, bounds, priors)
        self.names, self.size = list(self._space.names), self._space.size
        self.start = self._space.to_u(self._space.start)
        self._check_count()
        self._slopes = self._forward if gradient == "forward" else self._reverse
        self._potential = jax.jit(_guarded(self._value, self._slopes))
        self._local = jax.jit(self._exact if isinstance(loss, Likelihood) else self._quadratic)

    def _check_count(self) -> None:
        space, count = self._space, self._problem.count
        held = (space.prior_weight > 0) | np.isfinite(space.upper - space.lower)
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
            return self._problem.scalar(u) + self._beside(u)
        r = self._problem.residuals(u)
        return self._misfit(r @ r) + self._beside(u)

    def _reverse(self, u: Array) -> tuple[Array, Array]:
        return jax.value_and_grad(self._value)(u)

    def _forward(self, u: Array) -> tuple[Array, Array]:
        if isinstance(self._problem.loss, Likelihood):
            slope, value = jax.jacfwd(lambda u: (self._value(u),) * 2, has_aux=True)(u)
            return value, slope
        r, J, _ = self._problem.evaluate(u)
        data, weight = jax.value_and_grad(self._misfit)(r @ r)
        beside, slope = jax.value_and_grad(self._beside)(u)
        return data + beside, 2 * weight * (r @ J) + slope

    # ---- its normal approximation

    def _quadratic(self, u: Array) -> tuple[Array, Array, Array]:
        """Potential, its slope, and A with AᵀA its Gauss–Newton Hessian, priors last."""
        space = self._space
        r, J, _ = self._problem.evaluate(u)
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
        if self.size > _MANY:
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
            at = ", ".join(f"{n} = {v:.6g}" for n, v in zip(self.names[:8], x, strict=False))
            raise ValueError(
                f"the posterior density is 0 at the start ({at}): the model's trajectory fails, or "
                "its misfit is no number. Start from other parameters, or take a smaller h."
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
    below, above = np.isfinite(space.lower), np.isfinite(space.upper)
    both = below & above
    width = np.log(np.where(both, np.where(both, space.upper - space.lower, 1.0), 1.0))
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


@dataclass(frozen=True, eq=False)
class Samples:
    r"""Draws from a posterior.

    - `names`: the n parameters. `x`: draws, shape (chains, draws, n). `params`: the pytree that
      was given, with (chains, draws) in front of the shape of each of its numbers.
    - `potential`: of the draws, (chains, draws). `diverging`: which followed a path whose energy
      was lost, (chains, draws). `steps`: leapfrog steps of each path; `acceptance`: mean
      probability of each chain, (chains,).
    - `r_hat`, `ess`: name → split R̂, 1 for chains that agree, and effective number of draws.
    - `status`: ``"mixed"``; ``"diverging"``: a few paths were lost, so that a narrow part of the
      density may be missing; ``"not_mixed"``: some R̂ is above 1.01 or not a number, the draws do
      not stand for the density yet. `warnings`: in words.
    """

    names: list[str]
    x: np.ndarray
    params: PyTree
    potential: np.ndarray
    diverging: np.ndarray
    steps: np.ndarray
    acceptance: np.ndarray
    r_hat: dict[str, float]
    ess: dict[str, float]
    warnings: list[str] = field(default_factory=list)

    @property
    def samples(self) -> dict[str, np.ndarray]:
        """Name → draws, shape (chains, draws)."""
        return {name: self.x[..., i] for i, name in enumerate(self.names)}

    @property
    def divergences(self) -> int:
        """How many draws are `diverging`."""
        return int(self.diverging.sum())

    @property
    def status(self) -> str:
        """``"mixed"``, ``"diverging"`` or ``"not_mixed"``, the worst that applies."""
        if not all(r <= _R_HAT for r in self.r_hat.values()):
            return "not_mixed"
        return "diverging" if self.divergences else "mixed"

    @property
    def mean(self) -> np.ndarray:
        """Means, shape (n,)."""
        return self.x.mean(axis=(0, 1))

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the draws, shape (n, n)."""
        return np.atleast_2d(np.cov(self.x.reshape(-1, len(self.names)).T))

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations, shape (n,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlations(self) -> np.ndarray:
        """Correlations, shape (n, n)."""
        return correlations(self.covariance)

    def quantiles(self, at: Any = (0.05, 0.5, 0.95)) -> dict[str, np.ndarray]:
        """Name → quantiles."""
        return {name: np.quantile(draws, at) for name, draws in self.samples.items()}

    def __str__(self) -> str:
        chains, draws, _ = self.x.shape
        shown, width = self.names[:40], max(len(n) for n in self.names[:40])
        lines = [f"{self.status}: {chains} chains of {draws} draws, {self.divergences} diverging"]
        for name, mean, sigma in zip(shown, self.mean, self.sigma, strict=False):
            low, high = self.quantiles((0.05, 0.95))[name]
            lines.append(
                f"  {name:{width}}  {with_error(mean, sigma)}  90 % in [{low:.8g}, {high:.8g}]  "
                f"R̂ {self.r_hat[name]:.4f}  ESS {self.ess[name]:.0f}"
            )
        if len(self.names) > 40:
            lines.append(f"  … and {len(self.names) - 40} more")
        return "\n".join(lines + self.warnings)

    __repr__ = __str__

    def to_xarray(self) -> Any:
        """A `DataTree` with groups ``posterior`` and ``sample_stats``, dimensions chain and draw,
        as ArviZ lays them out."""
        import xarray as xr

        dims = ("chain", "draw")
        posterior = {name: (dims, draws) for name, draws in self.samples.items()}
        stats = {
            "diverging": (dims, self.diverging),
            "lp": (dims, -self.potential),
            "n_steps": (dims, self.steps),
        }
        coords = {d: np.arange(n) for d, n in zip(dims, self.x.shape[:2], strict=True)}
        groups = {"posterior": posterior, "sample_stats": stats}
        return xr.DataTree.from_dict(
            {name: xr.Dataset(of, coords=coords) for name, of in groups.items()}
        )

    def to_arviz(self) -> Any:
        """What the functions of ArviZ take: its `InferenceData`; from ArviZ 1.0 on `to_xarray`.

        **Raises** `ImportError` without arviz.
        """
        try:
            import arviz  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ImportError(
                "to_arviz needs arviz: pip install arviz. Without it, print(samples) is a summary "
                "and to_xarray() holds the draws in the same layout."
            ) from None
        tree = self.to_xarray()
        if int(arviz.__version__.split(".")[0]) >= 1:
            return tree
        return arviz.InferenceData(**{name: tree[name].to_dataset() for name in tree.children})


def sample(
    model: Callable[..., Any],
    data: Observations | list[Observations] | tuple[Observations, ...],
    params: PyTree,
    *,
    bounds: PyTree = None,
    priors: PyTree = None,
    loss: Loss | Likelihood = LeastSquares(),
    num_samples: int = 1000,
    num_warmup: int = 300,
    chains: int = 4,
    seed: int = 0,
    start: FitResult | PyTree = None,
    gradient: str = "reverse",
    target_accept: float = 0.8,
    max_tree_depth: int = 10,
    progress: bool | None = None,
) -> Samples:
    r"""Draws from the posterior of parameters, by the No-U-Turn sampler.

    The sampler moves in z, u = mode + L z, where L Lᵀ is the covariance of the normal
    approximation (`Posterior.laplace`): a well-determined fit is nearly round in z, so that little
    warm-up is needed. Chains start at draws of that approximation.

    - `model`, `data`, `params`, `bounds`, `priors`, `loss`, `gradient`: as for `Posterior`.
    - `num_samples`, `num_warmup`: draws of each chain that are kept, and before them those in
      which step size and masses adapt. `chains` run side by side; two or more show whether they
      agree. `seed`: of all of it; the same seed, the same draws.
    - `start`: a `FitResult` of these parameters, or a pytree like `params`; None: a fit from
      `params`.
    - `target_accept`: of the step size; nearer to 1 against divergences. `max_tree_depth`: a path
      takes at most 2 to this power steps.
    - `progress`: True shows a bar, False none, None where there is a terminal.

    **Returns** `Samples`. What is doubtful about them is warned of (`UserWarning`) and kept in
    ``warnings``: chains that do not agree, paths that diverged or were cut short, a start that
    did not converge.

    **Errors** Those of a mean are sigma/√ess.

    **Raises** `ImportError` without numpyro, which the extra ``bayes`` brings; `ValueError` or
    `TypeError` for input that cannot be meant, a posterior without an integral, or a start at
    which the trajectory fails.

    **Source** Hoffman & Gelman 2014, *J. Mach. Learn. Res.* 15, 1593 (by numpyro); R̂, Gelman et
    al. 2013, *Bayesian Data Analysis*, 11.4.
    """
    numpyro = _numpyro()
    _check_counts(num_samples, num_warmup, chains, seed, max_tree_depth)
    _check_others(target_accept, progress)
    posterior = Posterior(
        model, data, params, bounds=bounds, priors=priors, loss=loss, gradient=gradient
    )
    notes: list[str] = []
    if start is None:
        known = posterior._problem.has_errors or isinstance(loss, Likelihood)
        start = fit(
            model, data, params, bounds=bounds, priors=priors if known else None, loss=loss,
            check_curvature=False, progress=False, throw=False,
        )  # fmt: skip
    if isinstance(start, FitResult) and not bool(start.result == FIT_RESULTS.converged):
        notes.append(f"the fit that the chains start from did not converge: {start.status}.")
    mode, root = posterior.laplace(_start_of(posterior, start, bounds, priors))
    centre, L = jnp.asarray(mode), jnp.asarray(root)

    def in_z(z):
        return posterior.potential(centre + L @ z)

    kernel = numpyro.infer.NUTS(
        potential_fn=in_z, target_accept_prob=target_accept, max_tree_depth=max_tree_depth
    )
    mcmc = numpyro.infer.MCMC(
        kernel, num_warmup=num_warmup, num_samples=num_samples, num_chains=chains,
        chain_method="vectorized", progress_bar=_shows(progress),
    )  # fmt: skip
    begin = _starts(in_z, chains, posterior.size, seed)
    with jax.numpy_rank_promotion("allow"):  # numpyro's own arithmetic
        mcmc.run(
            jax.random.key(seed),
            init_params=begin if chains > 1 else begin[0],
            extra_fields=("diverging", "num_steps", "potential_energy", "mean_accept_prob"),
        )
    z = mcmc.get_samples(group_by_chain=True)
    x = jax.jit(jax.vmap(jax.vmap(lambda z: posterior.to_x(centre + L @ z))))(z)
    about = mcmc.get_extra_fields(group_by_chain=True)
    found = _collect(numpyro, posterior, x, about, notes, 2**max_tree_depth - 1)
    for text in found.warnings:
        warnings.warn(text, UserWarning, stacklevel=2)
    return found


def _numpyro() -> Any:
    try:
        import numpyro
        import numpyro.diagnostics
        import numpyro.infer
    except ImportError:
        raise ImportError(
            'dvi.sample needs numpyro, which the extra brings: pip install "dvi-jax[bayes]". '
            "(dvi.Posterior does not, for a sampler of your own.)"
        ) from None
    return numpyro


def _check_counts(num_samples, num_warmup, chains, seed, max_tree_depth) -> None:
    least = {"num_samples": 4, "num_warmup": 0, "chains": 1, "seed": 0, "max_tree_depth": 1}
    given = (num_samples, num_warmup, chains, seed, max_tree_depth)
    for (name, low), value in zip(least.items(), given, strict=True):
        if isinstance(value, bool) or not isinstance(value, int) or value < low:
            raise ValueError(f"{name} must be an integer, at least {low}, got {value!r}.")


def _check_others(target_accept: Any, progress: Any) -> None:
    if not (isinstance(target_accept, int | float) and 0 < target_accept < 1):
        raise ValueError(f"target_accept must lie between 0 and 1, got {target_accept!r}.")
    if not (progress is None or isinstance(progress, bool)):
        raise TypeError(f"progress must be True, False or None, got {progress!r}.")


def _shows(progress: bool | None) -> bool:
    return sys.stderr.isatty() if progress is None else progress


def _start_of(posterior: Posterior, start: Any, bounds: PyTree, priors: PyTree) -> np.ndarray:
    """The free vector of a fit or of a pytree.

    **Raises** `ValueError` for one of other parameters, or outside of the bounds.
    """
    space = Space(start.params if isinstance(start, FitResult) else start, bounds, priors)
    if space.names != posterior.names:
        raise ValueError(
            f"start has the parameters {', '.join(space.names[:8])}, those to be sampled are "
            f"{', '.join(posterior.names[:8])}."
        )
    return space.to_u(space.start)


def _starts(potential: Callable[[Array], Array], chains: int, size: int, seed: int) -> Array:
    """Normal draws (chains, size), drawn towards 0 until their density is positive."""
    z = np.random.default_rng(seed).standard_normal((chains, size))
    look = jax.jit(jax.vmap(potential))
    for _ in range(20):
        bad = ~np.isfinite(np.asarray(look(jnp.asarray(z))))
        if not bad.any():
            return jnp.asarray(z)
        z[bad] /= 2
    return jnp.zeros((chains, size))  # the mode, where it is positive


def _collect(
    numpyro: Any, posterior: Posterior, x: Any, about: Any, notes: list[str], longest: int
) -> Samples:
    """Draws with what is to be said of them."""
    x = np.asarray(x)
    columns = {name: x[..., i] for i, name in enumerate(posterior.names)}
    with np.errstate(invalid="ignore", divide="ignore"):
        r_hat = {n: float(numpyro.diagnostics.split_gelman_rubin(c)) for n, c in columns.items()}
        ess = {n: float(numpyro.diagnostics.effective_sample_size(c)) for n, c in columns.items()}
    found = Samples(
        names=posterior.names,
        x=x,
        params=_batched(posterior, x),
        potential=np.asarray(about["potential_energy"]),
        diverging=np.asarray(about["diverging"]),
        steps=np.asarray(about["num_steps"]),
        acceptance=np.asarray(about["mean_accept_prob"])[:, -1],
        r_hat=r_hat,
        ess=ess,
        warnings=notes,
    )
    notes += _doubts(found, longest)
    return found


def _doubts(found: Samples, longest: int) -> list[str]:
    notes = []
    worst = sorted((n for n, r in found.r_hat.items() if not r <= _R_HAT),
                   key=lambda n: -np.nan_to_num(found.r_hat[n], nan=np.inf))  # fmt: skip
    if worst:
        shown = ", ".join(f"{n} {found.r_hat[n]:.3f}" for n in worst[:4])
        notes.append(
            f"the chains do not agree: R̂ is above {_R_HAT} for {len(worst)} of {len(found.names)} "
            f"parameters ({shown}). Draw more samples after more warm-up; if it stays, the density "
            "has several maxima or is not determined: see chains one by one, give priors."
        )
    if found.divergences:
        notes.append(
            f"{found.divergences} of {found.diverging.size} draws diverged: a narrow part of the "
            "density, or one at whose edge trajectories fail, may be missing. Take target_accept "
            "nearer to 1, a smaller h, or bounds that keep off the edge."
        )
    cut = float((found.steps >= longest).mean())
    if cut > _SATURATED:
        notes.append(
            f"{100 * cut:.0f} % of the paths were cut short at {longest} steps: draws are right, "
            "but correlated. Take more warm-up, or a larger max_tree_depth."
        )
    return notes


def _batched(posterior: Posterior, x: np.ndarray) -> PyTree:
    """The pytree of parameters with (chains, draws) in front of its numbers."""
    space = posterior._space
    whole = space.to_params(jnp.asarray(space.start))
    rest = eqx.filter(whole, eqx.is_inexact_array, inverse=True)
    only = jax.vmap(jax.vmap(lambda x: eqx.filter(space.to_params(x), eqx.is_inexact_array)))
    return eqx.combine(jax.tree.map(np.asarray, only(jnp.asarray(x))), rest)
