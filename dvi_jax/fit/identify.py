"""Which of many candidates an unknown force is made of."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._system import System
from ._fit import fit
from .library import KEY, ForceLibrary, with_force
from .losses import LeastSquares, Loss
from .model import specification
from .observations import Observations, as_arcs
from .optimise import Evaluation, LeastSquaresStage
from .parameters import Prior
from .problem import Problem
from .result import FitResult, with_error
from .results import FIT_RESULTS, FitError
from .shooting import MultipleShooting, SingleShooting
from .solvers import levenberg_marquardt
from .uncertainty import Uncertainty, in_words, uncertainty

_REFIT = 30
"""Steps of a refit, which begins next to its minimum."""

_PRECISE = 1e-4
"""Standard errors to which a refit is taken: 1e-8 in chi²."""

_BEYOND = 3.0
"""Penalties by which the criterion may exceed the best before terms are no longer removed."""

_GUARD = 3.0
"""Scatters of the data that a single candidate is taken to move predictions by, to first order. A
prior so wide does nothing to terms that are seen, and holds combinations that are not."""

_UNKNOWN = 1e-3
"""Errors against which that prior is weighed where data have none, in scatters of the data."""

_ROUNDING = 1e-11
"""Relative error that any data are taken to have: exact ones say nothing beyond."""


@dataclass(frozen=True)
class Removal:
    """One stage of an identification.

    - `removed`: the candidate that was taken out, None for the beginning with all of them.
    - `terms`: those that are left. `chi2`: Σ of the squared whitened residuals of their fit.
    - `criterion`: what is to be small. `status`: of the refit.
    """

    removed: str | None
    terms: tuple[str, ...]
    chi2: float
    criterion: float
    status: FIT_RESULTS


@dataclass(frozen=True, eq=False)
class Identification:
    r"""Terms of an unknown force that data ask for.

    - `terms`: names of those candidates, in the order of the library; `coefficients` and `sigma`:
      theirs, with standard errors, shape (k,). The errors are those of the final fit: that the
      terms were chosen by the same data is not in them.
    - `system`: the model's `System` with the identified force, numbers included. It belongs to
      the `epsilon` of the model, 1 where that had none.
    - `path`: a `Removal` for each set of candidates that was tried, largest first.
    - `penalty`: by what a term has to lower the criterion.
    - `alternatives`: for each term, candidates that may be meant in its place, as pairs (name, by
      how much the criterion would rise).
    - `undetermined`: combinations of all the candidates that the data say nothing of, in words.
    - `fit`: the last `FitResult`; None when no term was found and nothing else was fitted.
    - `full`: the `FitResult` with all candidates, which a wide prior keeps from running away where
      the data do not determine them; for data without errors with provisional ones.
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
        count = len(self.full.names)
        lines = [f"{len(self.terms)} of {len(self.path[0].terms)} candidates"]
        if not self.terms:
            lines[0] = f"none of {len(self.path[0].terms)} candidates: no force is seen"
        width = max((len(name) for name in self.terms), default=0)
        for name, c, s in zip(self.terms, self.coefficients, self.sigma, strict=True):
            lines.append(f"  {name:{width}}  {with_error(float(c), float(s))}")
        lines += self._path_in_words()
        for name, others in self.alternatives.items():
            these = ", ".join(f"{other} (criterion {rise:+.2g})" for other, rise in others)
            lines.append(f"not unique: in place of {name} the data allow {these}")
        lines += [f"not determined among all {count}: {words}" for words in self.undetermined]
        if self.fit is not None:
            lines.append(
                f"rms {self.fit.rms:.4g}, {self.fit.num_observed} values"
                + (f", reduced chi² {self.fit.reduced_chi2:.4g}" if self.fit.has_errors else "")
            )
        return "\n".join(lines)

    __repr__ = __str__

    def _path_in_words(self) -> list[str]:
        """Where the criterion was least, and what the next removal would have cost."""
        at = next(i for i, step in enumerate(self.path) if step.terms == self.terms)
        words = [
            f"criterion {self.path[0].criterion:.6g} with all, {self.path[at].criterion:.6g} here"
        ]
        if at + 1 < len(self.path):
            after = self.path[at + 1]
            words[0] += f", {after.criterion:.6g} without {after.removed}"
        return words


def identify(
    model: Callable[..., Any],
    data: Observations | list[Observations] | tuple[Observations, ...],
    library: ForceLibrary,
    params: Mapping[str, Any] | None = None,
    *,
    bounds: PyTree = None,
    priors: PyTree = None,
    loss: Loss = LeastSquares(),
    shooting: SingleShooting | MultipleShooting = SingleShooting(),
    penalty: float | None = None,
    max_steps: int = 200,
    tolerance: float = 1e-4,
    horizons: str | list[float] | None = "auto",
    check_units: bool = True,
    check_curvature: bool = False,
    progress: bool | Callable[..., None] | None = None,
    throw: bool = True,
) -> Identification:
    r"""The terms of an unknown force, out of a library of candidates, from trajectories.

        q1 = q0 + h ∂H_D/∂p1,   p1 = p0 − h ∂H_D/∂q0 + h ε (W + Σ c_i f_i)

    All coefficients are fitted to the trajectories themselves, by `fit`: no derivatives of data
    are taken. Then the term with the smallest |c|/sigma is taken out and the rest fitted anew from
    where it stands, again and again, and of the sets so met that with the least

        χ² + k λ         (data with errors),      N log(χ²/N) + k λ      (without)

    is taken, k its number of terms, N that of observed values, λ the `penalty`.

    **Arguments**

    - `model`: a `Model`, or a function ``(params)`` or ``(params, arc)`` that returns the arguments
      of `integrate` as a dict. Its system may have a known force W, to which the library is
      added; where it has none, epsilon may be left out and is 1. args must be a dict or None.
    - `data`: `Observations`, or a list of them.
    - `library`: a `ForceLibrary` without coefficients.
    - `params`: a dict of what else is fitted, with starting values, as in `fit`: unknown starts
      ``{"q0": ..., "p0": ...}``, entries of args. Coefficients start at 0.
    - `bounds`, `priors`: for params.
    - `penalty`: λ; None takes log N + 2 log M for M candidates. log N alone is Schwarz's BIC, by
      which one of twenty idle candidates is kept every few times; 2 log M is for having had M
      to choose from.
    - `loss`, `shooting`, `max_steps`, `tolerance`, `horizons`, `check_units`, `check_curvature`,
      `progress`: as in `fit`. Multiple shooting is for the fit of all candidates; refits, which
      begin at a minimum, go by single shooting.
    - `throw`: raise `FitError` when the last fit does not converge.

    **Returns** an `Identification`. Read its `alternatives` and `undetermined`: candidates that
    are the same along the observed arcs cannot be told apart by them.

    **Raises** `ValueError` or `TypeError` for input that cannot be meant; `FitError`.

    **Source** Backward elimination for dynamics: our own, after Brunton, Proctor & Kutz 2016
    (candidates; by derivatives); Schwarz 1978; the term 2 k log M, Foster & George 1994, and
    as a bound of 2 log C(M, k), Chen & Chen 2008.
    """
    params = {} if params is None else params
    _check_input(library, params, bounds, priors, loss, penalty)
    arcs, many = as_arcs(data)
    common: dict[str, Any] = {
        "bounds": bounds, "priors": priors, "loss": loss, "tolerance": tolerance,
        "check_units": check_units,
        "progress": progress,
    }  # fmt: skip
    whole = _extended(model, library, many, params)
    start = {**params, KEY: dict.fromkeys(library.names, 0.0)}
    weighed = [_with_errors(arc) for arc in arcs]
    guard = _guard(Problem(whole, weighed, many, start, bounds=bounds, loss=loss), library)
    held = {**common, "priors": {**(priors or {}), KEY: guard}}
    full = None
    for through in (horizons, None):
        # What fits the beginning may run away later; without a force nothing does.
        full = fit(
            whole, weighed if many else weighed[0], start, shooting=shooting, horizons=through,
            max_steps=max_steps, check_curvature=False, throw=False, **held,
        )  # fmt: skip
        if not bool(full.result == FIT_RESULTS.not_finite):
            break
    assert full is not None
    if bool(full.result == FIT_RESULTS.not_finite):
        raise FitError(f"the fit of all candidates failed. {FIT_RESULTS[full.result]}", full)
    problem = Problem(
        whole, weighed, many, full.params, bounds=bounds, priors=held["priors"], loss=loss
    )
    search = _Search(problem, library, penalty, arcs[0].has_errors)
    search.eliminate()
    terms = search.terms
    best: Any = problem.space.to_params(problem.space.to_x(jnp.asarray(search.best)))
    params = {**best, KEY: {name: best[KEY][name] for name in terms}}
    found = None
    if terms or set(params) != {KEY}:
        # With the terms that are left, through the front door: errors, residuals, statuses.
        found = fit(
            whole, data, params, horizons=None, check_curvature=check_curvature, throw=throw,
            max_steps=max_steps, **common,
        )  # fmt: skip
    c, sigma = _numbers(found, terms)
    given = found.params if found is not None else params
    spec = whole.known({k: v for k, v in given.items() if k != KEY}, 0)
    system = spec["system"]
    if terms:
        system = with_force(system, library.only(terms).with_coefficients(c))
    return Identification(
        terms, c, sigma, system, spec["epsilon"], search.path, search.penalty,
        search.alternatives(), search.undetermined, found, full,
    )  # fmt: skip


def _check_input(library: Any, params: Any, bounds: Any, priors: Any, loss: Any, penalty: Any):
    if not isinstance(library, ForceLibrary):
        raise TypeError(f"library must be a dvi.ForceLibrary, got {library!r}.")
    if library.coefficients is not None:
        raise ValueError(
            "the library has coefficients already: hand over one without, they are what is found."
        )
    if not isinstance(loss, Loss):
        raise TypeError(
            f"loss must be dvi.LeastSquares(), dvi.SoftL1() or dvi.Cauchy(), got {loss!r}: terms "
            "are told from noise by residuals."
        )
    for name, given in (("params", params), ("bounds", bounds), ("priors", priors)):
        if not (isinstance(given, Mapping) or (given is None and name != "params")):
            raise TypeError(f"{name} must be a dict or None, got {type(given).__name__}.")
        if given is not None and KEY in given:
            raise ValueError(
                f"{name} must have no {KEY!r}: they follow from the library and start at 0."
            )
    if penalty is not None and not (isinstance(penalty, int | float) and 0 < penalty < np.inf):
        raise ValueError(f"penalty must be a positive number or None, got {penalty!r}.")


class _Extended(eqx.Module):
    """The user's model with the library's force, for parameters with coefficients.

    - `alone`: whether the model leaves ε out, which is then 1. Decided beforehand: inside of
      compiled code its number is not known.
    """

    model: Any
    library: ForceLibrary
    many: bool = eqx.field(static=True)
    alone: bool = eqx.field(static=True)

    def known(self, params: Mapping[str, Any], arc: Any) -> dict[str, Any]:
        """What the user's model says, its ε included."""
        spec = specification(self.model, params, arc, self.many)
        return {**spec, "epsilon": 1.0} if self.alone else spec

    def __call__(self, params: Mapping[str, Any], arc: Any) -> dict[str, Any]:
        c = params[KEY]
        spec = self.known({k: v for k, v in params.items() if k != KEY}, arc)
        if not c:
            return spec
        library = self.library.only(c)
        args = {**(spec.get("args") or {}), KEY: jnp.stack([c[n] for n in library.names])}
        return {**spec, "system": with_force(spec["system"], library), "args": args}


def _extended(
    model: Callable[..., Any], library: ForceLibrary, many: bool, params: Mapping[str, Any]
) -> _Extended:
    """The model with the library; refuses one that leaves it no room."""
    if not callable(model):
        raise TypeError(
            "model must be a dvi.Model or a function of the parameters that returns the arguments "
            f"of dvi.integrate, got {model!r}."
        )
    spec = specification(model, params, 0, many)
    args, system, epsilon = spec.get("args"), spec["system"], spec.get("epsilon", 0.0)
    if not (args is None or (isinstance(args, Mapping) and KEY not in args)):
        raise TypeError(
            f"args of the model must be None or a dict without {KEY!r}, into which the "
            f"coefficients are put, got {args!r}."
        )
    is_disturbed = system.force is not None or system.perturbation is not None
    if "epsilon" in params and not is_disturbed:
        raise ValueError(
            "epsilon and the coefficients cannot both be fitted: only their product is in the map. "
            "Leave epsilon out of params."
        )
    alone = not np.any(np.asarray(epsilon)) and "epsilon" not in params
    if alone and is_disturbed:
        raise ValueError(
            "the model has a known disturbance, but epsilon = 0, which would take it and the "
            "library away: give epsilon."
        )
    return _Extended(model, library, many, alone)


def _with_errors(arc: Observations) -> Observations:
    """The arc, with errors much smaller than its scatter if it has none."""
    if arc.has_errors:
        return arc
    scatter = float(np.nanstd(arc.values)) or float(np.nanmax(np.abs(arc.values))) or 1.0
    return replace(arc, sigma=_UNKNOWN * scatter)


def _guard(problem: Problem, library: ForceLibrary) -> dict[str, Prior]:
    """A wide prior for each coefficient, by what the candidate does to the predictions."""
    where = _places(problem, library)
    u = problem.space.to_u(problem.start)
    J = np.asarray(problem.evaluate(u).jacobian)[: -problem.size, where]
    values = [arc.whitening() * np.nan_to_num(arc.values.reshape(len(arc.ts), -1)) if
              arc.covariance is None else np.ones((1, 1)) for arc in problem.arcs]  # fmt: skip
    size = max(float(np.sqrt(np.mean(v**2))) for v in values)
    effect = np.sqrt(np.mean(J**2, axis=0))
    # No finite effect: no candidate of this kind, of which the fit itself will tell.
    good = np.isfinite(effect) & (effect > 0) & (size > 0)
    sigma = np.where(good, _GUARD * size / np.where(good, effect, 1.0), 1.0)
    return {name: Prior(0.0, float(x)) for name, x in zip(library.names, sigma, strict=True)}


def _places(problem: Problem, library: ForceLibrary) -> np.ndarray:
    """Where the coefficients stand among the free variables."""
    names = list(problem.space.names)
    return np.array([names.index(f"{KEY}.{name}") for name in library.names])


class _Search:
    """Backward elimination with one compiled program, in which all terms take part.

    - `path`; `best`: the free variables where the criterion is least; `terms`: names left there.
    """

    def __init__(
        self, problem: Problem, library: ForceLibrary, penalty: float | None, has_errors: bool
    ):
        self.problem, self.library, self.has_errors = problem, library, has_errors
        self.where = _places(problem, library)
        usual = np.log(problem.count) + 2 * np.log(len(library))
        self.penalty = float(usual if penalty is None else penalty)
        self.stage = LeastSquaresStage(self._evaluate, levenberg_marquardt())
        self.path: list[Removal] = []
        self.undetermined: list[str] = []
        self.best = problem.space.to_u(problem.start)
        self.keep = np.ones(problem.size, bool)

    def _evaluate(self, u: Array, horizon: Any, keep: Array) -> Evaluation:
        """Residual and Jacobian; what is not kept is zero, and nothing depends upon it."""
        # The program of the fit itself; what takes part is decided outside of it.
        r, J, _ = self.problem.evaluate(jnp.where(keep, u, 0.0), horizon)
        return Evaluation(r, J * keep[None])

    @property
    def terms(self) -> tuple[str, ...]:
        """Candidates of the best set."""
        return self._kept(self.keep)

    def _kept(self, keep: np.ndarray) -> tuple[str, ...]:
        return tuple(n for n, k in zip(self.library.names, keep[self.where], strict=True) if k)

    def eliminate(self) -> None:
        """Take out terms until the criterion has risen by a few penalties, or none is left."""
        u, keep, removed = self.best, self.keep, None
        least = np.inf
        while True:
            u, found, status = self._refit(u, keep)
            value, chi2 = self._criterion(found, keep)
            self.path.append(Removal(removed, self._kept(keep), chi2, value, status))
            if value < least:
                least, self.best, self.keep = value, u, keep
            if not np.isfinite(value) or value > least + _BEYOND * self.penalty:
                return
            if not keep[self.where].any():
                return
            J = self._of_data(found)
            about = uncertainty(J[:, keep], 1.0)
            if removed is None:
                names = [n.removeprefix(f"{KEY}.") for n in self.problem.space.names]
                self.undetermined = [in_words(d, names) for d in about.undetermined.T]
            i = self._weakest(u, J, keep, about)
            rest = keep & (np.arange(len(u)) != self.where[i])
            u, keep = _without(u, np.asarray(found.jacobian), self.where[i], rest), rest
            removed = self.library.names[i]

    def _refit(self, u: np.ndarray, keep: np.ndarray):
        """From where the rest stands; from no force at all if that leads nowhere."""
        u = np.where(keep, u, 0.0)
        if not keep.any():
            return u, self.stage.at(u, np.inf, jnp.asarray(keep)), FIT_RESULTS.converged
        outcome = self._minimum(u, keep)
        zero = u.copy()
        zero[self.where] = 0.0
        bare = np.asarray(self.stage.at(zero, np.inf, jnp.asarray(keep)).residual)
        r = np.asarray(outcome[1].residual)
        # A refit that ran away, to where no force at all is better, begins anew from there.
        if np.isfinite(bare).all() and not r @ r <= bare @ bare:
            outcome = self._minimum(zero, keep)
        return outcome

    def _minimum(self, u: np.ndarray, keep: np.ndarray):
        degrees = self.problem.count - int(keep.sum())
        return self.stage.run(
            u, np.inf, stage=0, max_steps=_REFIT, tolerance=_PRECISE, degrees=degrees,
            extra=jnp.asarray(keep), watch=lambda record, position: None,
        )  # fmt: skip

    def _of_data(self, found: Evaluation) -> np.ndarray:
        """The Jacobian without the guard of the coefficients."""
        J = np.array(found.jacobian)
        J[len(J) - self.problem.size + self.where] = 0.0
        return J

    def _criterion(self, found: Evaluation, keep: np.ndarray) -> tuple[float, float]:
        """The criterion and χ²."""
        r = np.asarray(found.residual)
        chi2, cost = float(r @ r), self.penalty * int(keep[self.where].sum())
        if not np.isfinite(chi2):
            return np.inf, chi2
        return self._misfit(chi2) + cost, chi2

    def _misfit(self, chi2: float) -> float:
        """−2 log likelihood at its maximum over an unknown error, up to a constant."""
        if self.has_errors:
            return chi2
        count = self.problem.count
        size = max(float(np.abs(g.values * g.whiten).max()) for g in self.problem.groups)
        return count * float(np.log(chi2 / count + (_ROUNDING * size) ** 2 + 1e-300))

    def _weakest(self, u, J: np.ndarray, keep: np.ndarray, about: Uncertainty) -> int:
        """The number of the term with the least |c|/sigma; of those without an error (in a
        combination that is not determined) the one of least effect."""
        place = np.cumsum(keep) - 1
        sigma = np.sqrt(np.diag(about.covariance))
        effect = np.abs(u) * np.linalg.norm(J, axis=0)

        def strength(i):
            j = self.where[i]
            s = sigma[place[j]]
            return (abs(u[j]) / s if np.isfinite(s) else 0.0, effect[j])

        return min((i for i in range(len(self.library)) if keep[self.where[i]]), key=strength)

    def alternatives(self) -> dict[str, list[tuple[str, float]]]:
        """For each term the candidates that would raise the criterion by less than a penalty.

        By the derivatives at the minimum: exact for candidates that do the same, and those that
        do something else are far off in any case.
        """
        every = self.stage.at(self.best, np.inf, jnp.ones(self.problem.size, bool))
        r, J = np.asarray(every.residual), self._of_data(every)
        found: dict[str, list[tuple[str, float]]] = {}
        if not (np.isfinite(r).all() and np.isfinite(J).all()):
            return found
        now = self._misfit(float(r @ r))
        for i in np.flatnonzero(self.keep[self.where]):
            s = self.where[i]
            rest = self.keep & (np.arange(len(self.keep)) != s)
            # Without the term: its part of the prediction is taken away, the rest adapts.
            bare, (Q, _) = r - J[:, s] * self.best[s], np.linalg.qr(J[:, rest])
            bare = bare - Q @ (Q.T @ bare)
            others = []
            for k in np.flatnonzero(~self.keep[self.where]):
                other = J[:, self.where[k]]
                own = other - Q @ (Q.T @ other)
                if own @ own <= 1e-18 * (other @ other):
                    continue
                left = bare - own * (own @ bare) / (own @ own)
                rise = self._misfit(float(left @ left)) - now
                if rise < self.penalty:
                    others.append((self.library.names[k], rise))
            if others:
                found[self.library.names[i]] = sorted(others, key=lambda pair: pair[1])
        return found


def _without(u: np.ndarray, J: np.ndarray, s: int, rest: np.ndarray) -> np.ndarray:
    """Variables without number s, the rest moved so that predictions change least, to first
    order."""
    moved = u.copy()
    moved[s] = 0.0
    if rest.any():
        length = np.linalg.norm(J[:, rest], axis=0)
        scale = np.where(length > 0, 1 / np.where(length > 0, length, 1.0), 0.0)
        shift = np.linalg.lstsq(J[:, rest] * scale, J[:, s] * u[s], rcond=1e-10)[0]
        moved[rest] += shift * scale
    return moved


def _numbers(found: FitResult | None, terms: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the terms and their standard errors."""
    if found is None or not terms:
        return np.zeros(0), np.zeros(0)
    at = np.array([found.names.index(f"{KEY}.{name}") for name in terms])
    return found.x[at], found.sigma[at]
