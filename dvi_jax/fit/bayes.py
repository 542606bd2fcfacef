"""Samples of a posterior by NUTS."""

import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..base.checks import fraction, instance, whole
from ..base.keywords import checked_keywords, user_level
from ..base.printing import printable
from ..base.tables import Table
from ._fit import fit
from .checks import package, same_parameters
from .keywords import LossSettings, SampleSettings, select
from .losses import Likelihood
from .maxima import Maximum, explored
from .observations import Data
from .parameters import make_space
from .posterior import Posterior
from .result import FitResult, doubts, with_error
from .stages import JACOBIAN_LIMIT
from .uncertainty import correlations

_R_HAT = 1.01  # Largest R̂ of chains that count as mixed (Vehtari et al. 2021)
_TRUNCATION_LIMIT = 0.01  # Fraction of draws with a truncated path above which a warning is given


@printable
@dataclass(frozen=True, eq=False)
class Samples:
    r"""Samples of a posterior.

    - `names`: the n parameters. `x`: draws, shape (chains, draws, n). `params`: the pytree that
      was given, with (chains, draws) in front of the shape of each of its numbers.
    - `potential`: of the draws, (chains, draws). `diverging`: draws whose path did not conserve its
      energy, (chains, draws). `steps`: leapfrog steps of each path; `acceptance`: mean
      probability of each chain, (chains,).
    - `r_hat`, `ess`: name → split R̂, 1 for chains that agree, and effective number of draws.
    - `maxima`, `shares`: the maxima of the density at which chains started, (k, n), and parts of
      the probability by normal approximations there, (k,); `explored`: as text, how they were
      found. Maxima that were not found have no chain.
    - `status`: ``"mixed"``: the chains agree over what was `explored`; ``"diverging"``: some paths
      diverged, so that a narrow part of the density may be missing; ``"not_mixed"``: some R̂ is
      above 1.01 or NaN, or there are more maxima than chains, so that the draws do not yet
      represent the density. `warnings`: the same as text.
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
    maxima: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    shares: np.ndarray = field(default_factory=lambda: np.zeros(0))
    explored: str = ""

    @property
    def samples(self) -> dict[str, np.ndarray]:
        """Name → draws, shape (chains, draws)."""
        return {name: self.x[..., i] for i, name in enumerate(self.names)}

    @property
    def divergences(self) -> int:
        """Number of `diverging` draws."""
        return int(self.diverging.sum())

    @property
    def status(self) -> str:
        """``"mixed"``, ``"diverging"`` or ``"not_mixed"``, the worst that applies."""
        if len(self.maxima) > len(self.x) or not all(r <= _R_HAT for r in self.r_hat.values()):
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
        names, width = self.names[:40], max(len(n) for n in self.names[:40])
        lines = [f"{self.status}: {chains} chains of {draws} draws, {self.divergences} diverging"]
        for name, mean, sigma in zip(names, self.mean, self.sigma, strict=False):
            low, high = self.quantiles((0.05, 0.95))[name]
            lines.append(
                f"  {name:{width}}  {with_error(mean, sigma)}  90 % in [{low:.8g}, {high:.8g}]  "
                f"R̂ {self.r_hat[name]:.4f}  ESS {self.ess[name]:.0f}"
            )
        if len(self.names) > 40:
            lines.append(f"  … and {len(self.names) - 40} more")
        lines += [f"explored: {self.explored}"] if self.explored else []
        return "\n".join(lines + self.warnings)

    def to_xarray(self) -> Any:
        """A `DataTree` with groups ``posterior`` and ``sample_stats``, dimensions chain and draw,
        in the layout of ArviZ."""
        import xarray as xr

        dims = ("chain", "draw")
        stats = {"diverging": self.diverging, "lp": -self.potential, "n_steps": self.steps}
        coords = {d: np.arange(size) for d, size in zip(dims, self.x.shape[:2], strict=True)}
        groups = {"posterior": self.samples, "sample_stats": stats}
        datasets = {
            group: xr.Dataset({name: (dims, x) for name, x in columns.items()}, coords=coords)
            for group, columns in groups.items()
        }
        return xr.DataTree.from_dict(datasets)

    def to_arviz(self) -> Any:
        """Input for the functions of ArviZ: its `InferenceData`; from ArviZ 1.0 on `to_xarray`.

        **Raises** `ImportError` without arviz.
        """
        arviz = package("arviz", "to_arviz", "arviz")
        tree = self.to_xarray()
        if int(arviz.__version__.split(".")[0]) >= 1:
            return tree
        return arviz.InferenceData(**{name: tree[name].to_dataset() for name in tree.children})


@checked_keywords
def sample(
    model: Callable[..., Any],
    data: Data,
    params: PyTree,
    *,
    num_samples: int = 1000,
    num_warmup: int = 300,
    chains: int = 4,
    seed: int = 0,
    start: FitResult | PyTree = None,
    **settings: Unpack[SampleSettings],
) -> Samples:
    r"""Samples of the posterior of parameters by the No-U-Turn sampler.

    The sampler moves in z, u = mode + L z, where L Lᵀ is the covariance of the normal
    approximation (`Posterior.laplace`): a well-determined posterior is nearly round in z, and needs
    little warm-up. Chains start at draws of such approximations, in turn at each maximum of the
    density: descents from draws of the priors and bounds look for those besides the mode. A narrow
    maximum may be missed: the field `explored` of the result says where it was searched.

    - `model`, `data`, `params`, `bounds`, `priors`, `loss`, `gradient`: as for `Posterior`.
    - `num_samples`, `num_warmup`: draws of each chain that are kept, and draws before them in
      which step size and masses adapt. `chains` are computed together; two or more show whether
      they agree. `seed`: of all draws; the same seed gives the same draws.
    - `start`: a `FitResult` of these parameters, or a pytree like `params`; None: a fit from
      `params`. A parameter that such a fit left at a bound starts at its value in `params`.
    - `target_accept`: acceptance for the step size, by default 0.8; nearer to 1 against
      divergences. `max_tree_depth`: a path has at most 2^max_tree_depth steps, by default 2¹⁰.
    - `explore`: number of draws for that, by default 64; 0: all chains start at the mode.
      Parameters without a prior or two bounds are drawn near the start, as far as twice their size.
    - `progress`: True shows a bar, False none, None where there is a terminal.

    **Returns** `Samples`, with a `UserWarning` and a text in ``warnings`` for chains that do not
    agree, paths that diverged or were truncated, and a fit for the start that did not converge, or
    finds that residuals contradict sigma or priors the data. The standard error of a mean is
    sigma/√ess.

    **Raises** `ImportError` without numpyro, which the extra ``bayes`` installs; `ValueError` or
    `TypeError` for invalid input, a posterior without an integral, or a start at which the
    trajectory fails.

    **Source** Hoffman & Gelman 2014, *J. Mach. Learn. Res.* 15, 1593 (by numpyro); R̂, Gelman et
    al. 2013, *Bayesian Data Analysis*, 11.4.
    """
    infer = _numpyro("infer")
    counts = {"num_warmup": num_warmup, "num_samples": num_samples, "num_chains": chains}
    whole("num_samples", num_samples, 4)
    whole("num_warmup", num_warmup, 0)
    whole("chains", chains)
    whole("seed", seed, 0)
    explore = whole("explore", settings.get("explore", 64), 0)
    depth = whole("max_tree_depth", settings.get("max_tree_depth", 10))
    acceptance = fraction("target_accept", settings.get("target_accept", 0.8))
    progress = settings.get("progress")
    instance("progress", progress, bool | None, "True, False or None")
    terms, gradient = select(settings, LossSettings), settings.get("gradient", "reverse")
    posterior = Posterior(model, data, params, **terms, gradient=gradient)
    notes: list[str] = []
    if start is None:
        has_errors = posterior._problem.has_errors or isinstance(terms.get("loss"), Likelihood)
        of_fit = terms if has_errors else {**terms, "priors": None}
        quiet: dict[str, Any] = {"check_curvature": False, "progress": False, "throw": False}
        start = fit(model, data, params, **of_fit, **quiet)
    if isinstance(start, FitResult):
        if start.status != "converged":
            notes.append(f"the chains start from a fit that did not converge: {start.status}.")
        notes += doubts(start)
    limits = terms.get("bounds"), terms.get("priors")
    mode, root = posterior.laplace(start_of(posterior, start, *limits))
    maxima, text = [Maximum(mode, root, 0.0)], "only the surroundings of the start"
    if explore and posterior.size <= JACOBIAN_LIMIT:
        first = maxima[0]._replace(potential=posterior.look(mode)[0])
        maxima, text = explored(posterior, first, explore, seed)
    centre, L = jnp.asarray(maxima[0].u), jnp.asarray(maxima[0].root)

    def in_z(z):
        return posterior.potential(centre + L @ z)

    kernel = infer.NUTS(potential_fn=in_z, target_accept_prob=acceptance, max_tree_depth=depth)
    shows = sys.stderr.isatty() if progress is None else progress
    mcmc = infer.MCMC(kernel, **counts, chain_method="vectorized", progress_bar=shows)
    begin = _starts(in_z, maxima, chains, seed)
    with jax.numpy_rank_promotion("allow"):  # numpyro's own arithmetic
        mcmc.run(
            jax.random.key(seed),
            init_params=begin if chains > 1 else begin[0],
            extra_fields=("diverging", "num_steps", "potential_energy", "mean_accept_prob"),
        )
    z = mcmc.get_samples(group_by_chain=True)
    x = jax.jit(jax.vmap(jax.vmap(lambda z: posterior.to_x(centre + L @ z))))(z)
    statistics = mcmc.get_extra_fields(group_by_chain=True)
    samples = collect(posterior, x, statistics, notes, 2**depth - 1, maxima, text)
    for text in samples.warnings:
        warnings.warn(text, UserWarning, stacklevel=user_level())
    return samples


def _numpyro(part: str) -> Any:
    return package(f"numpyro.{part}", "dvi.sample", '"dvi-jax[bayes]"')


def start_of(posterior: Posterior, start: Any, bounds: PyTree, priors: PyTree) -> np.ndarray:
    """The free vector of a fit or of a pytree; a number that the fit left at a bound, where u is
    infinite, starts as in `params`. **Raises** `ValueError` for other parameters, or a pytree
    outside of the bounds."""
    is_fit = isinstance(start, FitResult)
    arguments = (start.params,) if is_fit else (start, bounds, priors)
    space, x = make_space(*arguments)
    same_parameters("start", space.names, posterior.names, "params")
    if is_fit:
        at_bounds = np.isin(posterior.names, posterior.space.at_bounds(x, start.sigma))
        x = np.where(at_bounds, posterior.to_x(jnp.asarray(posterior.start)), x)
    return posterior.to_u(x)


def _starts(potential: Callable[[Array], Array], maxima: list[Maximum], chains: int, seed: int):
    """Normal draws (chains, size) around the maxima in turn, halved until their density is
    positive, in z of the first maximum."""
    z = np.random.default_rng(seed).standard_normal((chains, len(maxima[0].u)))
    look, home = jax.jit(jax.vmap(potential)), maxima[0]
    turns = [maxima[i % len(maxima)] for i in range(chains)]
    centres = np.stack([np.linalg.solve(home.root, m.u - home.u) for m in turns])
    maps = [np.linalg.solve(home.root, m.root) for m in turns]
    for _ in range(20):
        points = centres + np.stack([M @ x for M, x in zip(maps, z, strict=True)])
        bad = ~np.isfinite(np.asarray(look(jnp.asarray(points))))
        if not bad.any():
            return jnp.asarray(points)
        z[bad] /= 2
    return jnp.asarray(centres)  # the maxima, where it is positive


def collect(
    posterior: Posterior,
    x: Any,
    statistics: Any,
    notes: list,
    longest: int,
    maxima: Sequence[Maximum] = (),
    text: str = "",
) -> Samples:
    """Draws with their diagnostics."""
    x, diagnostics = np.asarray(x), _numpyro("diagnostics")
    columns = {name: x[..., i] for i, name in enumerate(posterior.names)}
    with np.errstate(invalid="ignore", divide="ignore"):
        r_hat = {n: float(diagnostics.split_gelman_rubin(chain)) for n, chain in columns.items()}
        ess = {n: float(diagnostics.effective_sample_size(chain)) for n, chain in columns.items()}
    samples = Samples(
        names=posterior.names,
        x=x,
        params=_batch_of_params(posterior, x),
        potential=np.asarray(statistics["potential_energy"]),
        diverging=np.asarray(statistics["diverging"]),
        steps=np.asarray(statistics["num_steps"]),
        acceptance=np.asarray(statistics["mean_accept_prob"])[:, -1],
        r_hat=Table(r_hat),
        ess=Table(ess),
        warnings=notes,
        maxima=np.array([np.asarray(posterior.to_x(jnp.asarray(m.u))) for m in maxima]),
        shares=np.array([m.share for m in maxima]),
        explored=text,
    )
    notes += _doubts(samples, longest)
    return samples


def _doubts(samples: Samples, longest: int) -> list[str]:
    notes = []
    excess = {n: np.nan_to_num(r, nan=np.inf) for n, r in samples.r_hat.items() if not r <= _R_HAT}
    if worst := sorted(excess, key=lambda n: -excess[n]):
        examples = ", ".join(f"{n} {samples.r_hat[n]:.3f}" for n in worst[:4])
        notes.append(
            f"the chains do not agree: R̂ is above {_R_HAT} for {len(worst)} of "
            f"{len(samples.names)} parameters ({examples}). Draw more samples after more warm-up; "
            "if R̂ stays large, give priors: the density has several maxima or is not determined."
        )
    if len(samples.maxima) > 1 and samples.status == "not_mixed":
        # The parameters that differ most, in parts of themselves, come first.
        size = np.abs(samples.maxima).max(axis=0) + np.finfo(float).tiny
        order = np.argsort(-np.ptp(samples.maxima, axis=0) / size, stable=True)
        names = [samples.names[i] for i in order]
        pairs = zip(samples.maxima[:, order], samples.shares, strict=True)
        listing = [f"{_in_words(names, x)} ({100 * s:.2g} %)" for x, s in pairs]
        notes.append(
            f"the density has {len(listing)} maxima, with parts of the probability by normal "
            f"approximations: {'; '.join(listing[:8])}. The draws have one part for each chain. "
            "Give bounds or priors that contain one maximum, and weigh the results by these parts."
        )
    if samples.divergences:
        notes.append(
            f"{samples.divergences} of {samples.diverging.size} draws diverged: a narrow part of "
            "the density, or one next to failing trajectories, may be missing. Use a target_accept "
            "nearer to 1, a smaller h, or bounds that exclude failing trajectories."
        )
    cut = float((samples.steps >= longest).mean())
    if cut > _TRUNCATION_LIMIT:
        notes.append(
            f"{100 * cut:.0f} % of the paths were truncated at {longest} steps: the draws are "
            "valid, but correlated. Use more warm-up, or a larger max_tree_depth."
        )
    return notes


def _in_words(names: list[str], x: np.ndarray) -> str:
    return ", ".join(f"{n} = {v:.6g}" for n, v in zip(names[:3], x, strict=False))


def _batch_of_params(posterior: Posterior, x: np.ndarray) -> PyTree:
    """The pytree of parameters with (chains, draws) in front of its numbers."""
    space = posterior.space
    example = posterior.to_params(jnp.asarray(posterior.start))
    constants = eqx.filter(example, eqx.is_inexact_array, inverse=True)
    batch = jax.vmap(jax.vmap(lambda x: eqx.filter(space.to_params(x), eqx.is_inexact_array)))
    return eqx.combine(jax.tree.map(np.asarray, batch(jnp.asarray(x))), constants)
