"""Identification of an unknown force, or rate of change, among many candidate terms."""

import functools
import itertools
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Unpack

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from lanewise.jaxprs.dependence import depends_on

from ..base.checks import instance, positive
from ..base.keywords import checked_keywords
from ..base.printing import printable
from ..problem.system import System
from ._fit import fit
from .checks import enough_values, requires
from .elimination import Elimination, Removal, places
from .first_order import by_regression, field_of
from .keywords import OptimiserSettings
from .library import KEY, ForceLibrary, with_force
from .losses import LeastSquares, Loss
from .model import Group, Model, specification
from .observations import Data, Observations, as_arcs
from .optimise import FIT_RESULTS, FitError
from .parameters import Prior, make_space
from .problem import FitProblem
from .result import FitResult, doubts, neighbour_remark, with_error
from .shooting import MultipleShooting, SingleShooting

# Width of a prior: the change of the predictions by the candidate alone, to first order, in
# scatters of the data. It hardly affects terms that the data determine, and holds combinations that
# they do not.
_GUARD = 3.0
_SPAN = 3.0  # Characteristic times, over which the candidate acts in the beginning
_FOLLOWS = 0.5  # Fraction of the variance that a fit which follows the data explains
_PROVISIONAL_ERROR = 1e-3  # Provisional errors of data without any, in scatters of the data
# Keywords of `fit` for the fit of all candidates and for the last one.
_OF_ALL = ("max_steps", "tolerance", "check_units", "progress")


@printable
@dataclass(frozen=True, eq=False)
class Identification:
    r"""Terms of an unknown force that the data support.

    - `terms`: names of those candidates, in the order of the library; `coefficients` and `sigma`:
      theirs, with standard errors, shape (k,). The errors are those of the final fit; they do not
      include that the terms were chosen by the same data.
    - `system`: the model's `System` with the identified force and its coefficients. It belongs to
      the `epsilon` of the model, 1 where that had none; None for `Model.first_order`.
    - `path`: a `Removal` for each set of candidates, largest first, then those after an exchange.
    - `penalty`: the minimum decrease of the criterion for a term to be kept.
    - `alternatives`: for each term, candidates that could replace it, as pairs (name, increase of
      the criterion).
    - `undetermined`: combinations of all candidates that the data do not determine, as text.
    - `fit`: the last `FitResult`; None when no term was found and nothing else was fitted.
    - `full`: the `FitResult` with all candidates. A wide prior holds combinations that the data do
      not determine; data without errors have provisional ones.
    """

    terms: tuple[str, ...]
    coefficients: np.ndarray
    sigma: np.ndarray
    system: System
    epsilon: Any
    path: list[Removal]
    penalty: float
    alternatives: dict[str, list[tuple[str, float]]]
    undetermined: list[str]
    fit: FitResult | None
    full: FitResult

    @property
    def is_unique(self) -> bool:
        """Whether no other candidate explains the data about as well as one of the terms."""
        return not self.alternatives

    def __str__(self) -> str:
        count, all_terms = len(self.full.names), self.path[0]
        lines = [f"{len(self.terms)} of {len(all_terms.terms)} candidates"]
        if not self.terms:
            lines[0] = f"none of {len(all_terms.terms)} candidates: no term was detected"
        width = max((len(name) for name in self.terms), default=0)
        for name, c, s in zip(self.terms, self.coefficients, self.sigma, strict=True):
            lines.append(f"  {name:{width}}  {with_error(float(c), float(s))}")
        # Where the criterion is least, and what the next removal costs.
        index = next(i for i, step in enumerate(self.path) if step.terms == self.terms)
        stage, *removals = self.path[index : index + 2]
        words = f"criterion {all_terms.criterion:.6g} with all, {stage.criterion:.6g} here"
        words += "".join(f", {a.criterion:.6g} without {a.removed}" for a in removals)
        lines.append(words)
        for name, replacements in self.alternatives.items():
            listing = ", ".join(f"{other} (criterion {rise:+.2g})" for other, rise in replacements)
            lines.append(f"not unique: in place of {name} the data allow {listing}")
        lines += [f"not determined among all {count}: {words}" for words in self.undetermined]
        if self.fit is not None:
            chi2 = f", reduced chi² {self.fit.reduced_chi2:.4g}" if self.fit.has_errors else ""
            lines.append(f"rms {self.fit.rms:.4g}, {self.fit.num_observed} values{chi2}")
            lines += filter(None, [*doubts(self.fit), neighbour_remark(self.fit)])
        return "\n".join(lines)


@checked_keywords
def identify(
    model: Callable[..., Any],
    data: Data,
    library: ForceLibrary,
    params: Mapping[str, Any] | None = None,
    *,
    penalty: float | None = None,
    shooting: SingleShooting | MultipleShooting = SingleShooting(),
    horizons: str | list[float] | None = "auto",
    throw: bool = True,
    **settings: Unpack[OptimiserSettings],
) -> Identification:
    r"""Terms of an unknown force or equation x' = f, selected from candidates by observations.

        q1 = q0 + h ∂H_D/∂p1,   p1 = p0 − h ∂H_D/∂q0 + h ε (W + Σ c_i f_i)

    All coefficients are fitted to the trajectories themselves, by `fit`: data are not
    differentiated. Then the term with the smallest |c|/sigma is removed and the rest fitted again
    from its present values, repeatedly; after that single terms are exchanged or added as long as
    this is better. Of these sets the one with the least

        χ² + k λ         (data with errors),      N log(χ²/N) + k λ      (without)

    is the result; k is its number of terms, N that of observed values, λ the `penalty`.

    **Arguments**

    - `model`: a `Model`, or a function ``(params)`` or ``(params, arc)`` that returns the
      arguments of `integrate` as a dict. Its system may have a known force W, to which the library
      is added; where it has none, epsilon may be left out and is 1. args must be a dict or None.
      For an equation x' = f(t, x, args) it is `Model.first_order`; the library is added to f, and
      where q0 is missing it is fitted from the first observation on.
    - `data`: `Observations`, or a list of them.
    - `library`: a `ForceLibrary` without coefficients.
    - `params`: a dict of what else is fitted, with starting values, as in `fit`: unknown initial
      states ``{"q0": ..., "p0": ...}``, entries of args. Coefficients start at 0.
    - `bounds`, `priors`: for params. `loss`: as in `fit`, but not a `Likelihood`.
    - `penalty`: λ; None means log N + 2 log M for M candidates. log N alone is Schwarz's BIC, by
      which one of twenty idle candidates is often kept; 2 log M accounts for the choice among M.
    - `throw`: raise `FitError` when the last fit does not converge.
    - `shooting`, `max_steps`, `tolerance`, `horizons`, `check_units`, `progress`: as in `fit`;
      `check_curvature`: the same, by default False. Multiple shooting and horizons are for the
      fit of all candidates; refits, which begin at a minimum, use single shooting.

    **Returns** an `Identification`. Read its `alternatives` and `undetermined`: the data cannot
    distinguish candidates that are equal along the observed arcs.

    **Raises** `ValueError` or `TypeError` for invalid input; `FitError`.

    **Source** Backward elimination for dynamics: our own, after Brunton, Proctor & Kutz 2016
    (candidates; by derivatives); Schwarz 1978; the term 2 k log M, Foster & George 1994, and
    as a bound of 2 log C(M, k), Chen & Chen 2008.
    """
    params = {} if params is None else params
    arcs, is_list = as_arcs(data)
    if isinstance(params, Mapping):
        params = {**_starts(model, arcs, is_list), **params}
    bounds, priors = settings.get("bounds"), settings.get("priors")
    loss: Any = settings.get("loss", LeastSquares())
    _check_input(library, params, bounds, priors, loss, penalty)
    full_model = _with_library(model, library, is_list, params)
    zeros = {**params, KEY: dict.fromkeys(library.names, 0.0)}
    arcs_with_errors = [_with_errors(arc) for arc in arcs]
    full_problem = full_model, arcs_with_errors, is_list
    unguarded = FitProblem(*full_problem, zeros, bounds=bounds, loss=loss)
    enough_values(unguarded.count, unguarded.size, f"{unguarded.size} candidates and parameters")
    starts = [zeros]
    if field_of(full_model.base_specification(params, 0)["system"]):
        starts.insert(0, {**params, KEY: by_regression(full_model, library, arcs, params)})
    common: dict[str, Any] = {name: x for name, x in settings.items() if name in _OF_ALL}
    observations = arcs_with_errors if is_list else arcs_with_errors[0]

    def guarded(params: Any, span: float) -> dict[str, Any]:
        guard = _guard(unguarded, library, unguarded.space.to_u(make_space(params)[1]), span)
        return {"bounds": bounds, "priors": {**(priors or {}), KEY: guard}, "loss": loss}

    def fit_all(params: Any, setting: dict[str, Any], **options: Any) -> FitResult:
        options = {**common, **setting, **options, "throw": False, "check_curvature": False}
        return fit(full_model, observations, params, **options)

    setting: dict[str, Any] = {}
    full: Any = None
    # The effects over all data bound the terms best. If they are far too large (of a particle at
    # rest, whose force acts for ever), or a fit of the beginning diverges later, the next may not.
    for start, span, path in itertools.product(starts, (np.inf, _SPAN), (horizons, None)):
        trial = guarded(start, span)
        # From a regression a trajectory may diverge: its size does not say that units differ.
        checks = {} if start is zeros else {"check_units": False}
        result = fit_all(start, trial, shooting=shooting, horizons=path, **checks)
        if full is None or full.status == "not_finite" or result.explained > full.explained:
            setting, full = trial, result
        if full.status != "not_finite" and full.explained > _FOLLOWS:
            break
    if full.status == "not_finite":
        text = f"the fit of all terms failed; it is the attribute `fit`. {FIT_RESULTS[full.result]}"
        raise FitError(text, full)
    # Only now is there a trajectory along all data, from which the effects of terms are known.
    refined = guarded(full.params, np.inf)
    again = fit_all(full.params, refined, horizons=None)
    if again.status != "not_finite":
        setting, full = refined, again
    problem = FitProblem(*full_problem, full.params, **setting)
    search = Elimination(problem, library, penalty, arcs[0].has_errors)
    search.search()
    terms = search.terms
    best: Any = problem.space.to_params(problem.space.to_x(jnp.asarray(search.best)))
    values: Any = {**best, KEY: {name: best[KEY][name] for name in terms}}
    final, coefficients, sigma = None, np.zeros(0), np.zeros(0)
    if terms or set(values) != {KEY}:
        # The remaining terms by `fit` itself: errors, residuals, statuses.
        common |= {"bounds": bounds, "priors": priors, "loss": loss, "horizons": None}
        common |= {"check_curvature": settings.get("check_curvature", False), "throw": throw}
        final = fit(full_model, data, values, **common)
        values = final.params
        indices = [final.names.index(f"{KEY}.{name}") for name in terms]
        coefficients, sigma = final.x[indices], final.sigma[indices]
    spec = full_model.base_specification({k: v for k, v in values.items() if k != KEY}, 0)
    system = spec["system"]
    if terms:
        system = with_force(system, library.only(terms).with_coefficients(coefficients))
    return Identification(
        terms=terms,
        coefficients=coefficients,
        sigma=sigma,
        system=system,
        epsilon=spec.get("epsilon"),
        path=search.path,
        penalty=search.penalty,
        alternatives=search.alternatives(),
        undetermined=search.combinations,
        fit=final,
        full=full,
    )


def _check_input(library: Any, params, bounds, priors, loss, penalty) -> None:
    instance("library", library, ForceLibrary, "a dvi.ForceLibrary")
    if library.coefficients is not None:
        raise ValueError(f"library must have no coefficients, got {library.coefficients}.")
    losses = "dvi.LeastSquares(), dvi.SoftL1() or dvi.Cauchy()"
    instance("loss", loss, Loss, losses, "Terms are distinguished from noise by residuals.")
    for name, value in (("params", params), ("bounds", bounds), ("priors", priors)):
        instance(name, {} if value is None else value, Mapping, "a dict or None")
        if value is not None and KEY in value:
            raise ValueError(
                f"{name} must not contain {KEY!r}: dvi.identify adds the coefficients."
            )
    if penalty is not None:
        positive("penalty", penalty)


def _starts(model: Any, arcs: list[Observations], is_list: bool) -> dict[str, Any]:
    """The first observed states, where a model of first order has no initial state."""
    is_open = isinstance(model, Model) and model.fixed["q0"] is None
    if not (is_open and field_of(model.settings["system"])):
        return {}
    rows = [np.atleast_1d(arc.in_time_order().values[0]) for arc in arcs]
    is_usable = all(arc.observe == "positions" for arc in arcs) and len({*map(np.shape, rows)}) == 1
    if not (is_usable and np.isfinite(rows).all()):
        return {}  # the model then reports that q0 is missing
    return {"q0": np.stack(rows) if is_list else rows[0]}


class _ModelWithLibrary(eqx.Module):
    """The user's model with the library's force, for parameters with coefficients; `alone`: whether
    the model leaves ε out, which is then 1 (in compiled code its number is not known)."""

    model: Any
    library: ForceLibrary
    is_list: bool = eqx.field(static=True)
    alone: bool = eqx.field(static=True)

    def base_specification(self, params: Mapping[str, Any], arc: Any) -> dict[str, Any]:
        """The specification of the user's model, its ε included."""
        spec = specification(self.model, params, arc, self.is_list)
        return {**spec, "epsilon": 1.0} if self.alone else spec

    def __call__(self, params: Mapping[str, Any], arc: Any) -> dict[str, Any]:
        coefficients = params[KEY]
        spec = self.base_specification({k: v for k, v in params.items() if k != KEY}, arc)
        if not coefficients:
            return spec
        library = self.library.only(coefficients)
        values = jnp.stack([coefficients[name] for name in library.names])
        args = {**(spec.get("args") or {}), KEY: values}
        return {**spec, "system": with_force(spec["system"], library), "args": args}


def _with_library(model: Any, library: ForceLibrary, is_list: bool, params: Mapping[str, Any]):
    """The model with the library; refuses one to which it cannot be added."""
    spec = specification(model, params, 0, is_list)
    args, system, epsilon = spec.get("args"), spec["system"], spec.get("epsilon", 0.0)
    if not (args is None or (isinstance(args, Mapping) and KEY not in args)):
        rule = f"None or a dict without {KEY!r}"
        raise TypeError(f"args of the model must be {rule}, got {args!r:.200}.")
    field = field_of(system)
    if field is not None:
        time, state = jnp.zeros(()), jnp.asarray(spec["q0"], float)
        rates = functools.partial(library.with_coefficients({}), time, time, state, args=args)
        of_p = depends_on(rates, 0, state)
        requires(not of_p, "a model of first order", "candidates of x, the first state", "one of p")
    is_perturbed = system.force is not None or system.perturbation is not None
    if "epsilon" in params and not is_perturbed:
        raise ValueError(
            "epsilon cannot be fitted if library is the only force, because only their product is "
            "determined: remove epsilon from params."
        )
    is_alone = field is None and not np.any(np.asarray(epsilon)) and "epsilon" not in params
    if is_alone and is_perturbed:
        raise ValueError(
            "the model must have an epsilon other than 0, got epsilon = 0: there is no force then."
        )
    return _ModelWithLibrary(model, library, is_list, is_alone)


def _with_errors(arc: Observations) -> Observations:
    """The arc, with errors much smaller than its scatter if it has none."""
    if arc.has_errors:
        return arc
    scatter = float(np.nanstd(arc.values)) or float(np.nanmax(np.abs(arc.values))) or 1.0
    return replace(arc, sigma=np.full(arc.values.shape, _PROVISIONAL_ERROR * scatter))


def _guard(
    problem: FitProblem, library: ForceLibrary, u: np.ndarray, span: float
) -> dict[str, Prior]:
    """A wide prior for each coefficient, by the candidate's effect on the predictions at u, over
    `span` characteristic times of the data."""

    def in_errors(arc):  # 1 where errors are covariances
        if arc.covariance is not None:
            return np.ones((1, 1))
        return arc.whitening() * np.nan_to_num(arc.values.reshape(len(arc.ts), -1))

    where = places(problem, library)
    _, J, (_, predictions) = problem.evaluate(u)
    pairs = zip(problem.groups, predictions, strict=True)
    rows = [_in_region(group, np.asarray(x), span).ravel() for group, (x, _) in pairs]
    J = np.asarray(J)[: -problem.size][np.concatenate(rows)][:, where]
    size = max(float(np.sqrt(np.mean(in_errors(arc) ** 2))) for arc in problem.arcs)
    effect = np.sqrt(np.mean(J**2, axis=0))
    # A candidate without a finite effect gets any prior: the fit itself reports it.
    good = np.isfinite(effect) & (effect > 0) & (size > 0)
    sigma = np.where(good, _GUARD * size / np.where(good, effect, 1.0), 1.0)
    # Over a long arc a small change of a coefficient is a large one of the phase.
    sigma = np.maximum(sigma, _GUARD * np.abs(u[where]))
    return {name: Prior(0.0, float(x)) for name, x in zip(library.names, sigma, strict=True)}


def _in_region(group: Group, predictions: np.ndarray, span: float) -> np.ndarray:
    """Which values, (A, N, K), were observed within `span` characteristic times of the start and
    before the predictions leave the region of the data, where a candidate such as q³ has an effect
    of any size. The first observation of an arc always is."""
    values = np.where(group.mask, group.values, np.nan)
    with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore"):
        warnings.simplefilter("ignore")  # of components that were never observed
        low, high = np.nanmin(values, 1, keepdims=True), np.nanmax(values, 1, keepdims=True)
        is_near = np.abs(predictions - (low + high) / 2) <= 1.5 * (high - low)
        rate = np.diff(values, axis=1) / np.diff(group.ts, axis=1)[..., None]
        # Of a sine wave this is 1/frequency.
        time = np.nanmax(np.nanstd(values, 1) / np.sqrt(np.nanmean(rate**2, 1)), 1)
    rows = np.logical_and.accumulate((is_near | ~group.mask).all(axis=2), axis=1)
    rows &= ~(np.abs(group.ts - group.t0[:, None]) > span * time[:, None])
    rows[:, 0] = True
    return rows[..., None] & group.mask
