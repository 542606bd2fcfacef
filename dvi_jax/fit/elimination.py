"""Terms of a force removed one by one: backward elimination by a criterion."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .library import KEY, ForceLibrary
from .optimise import Evaluation, LeastSquaresStage
from .problem import Problem
from .results import FIT_RESULTS
from .solvers import levenberg_marquardt
from .uncertainty import Uncertainty, in_words, uncertainty

_REFIT = 30
"""Steps of a refit, which begins next to its minimum."""

_PRECISE = 1e-4
"""Standard errors to which a refit is taken: 1e-8 in chi²."""

_BEYOND = 3.0
"""Penalties by which the criterion may exceed the best before terms are no longer removed."""

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


def places(problem: Problem, library: ForceLibrary) -> np.ndarray:
    """Where the coefficients stand among the free variables."""
    names = list(problem.space.names)
    return np.array([names.index(f"{KEY}.{name}") for name in library.names])


class Elimination:
    """Backward elimination with one compiled program, in which all terms take part.

    - `path`; `best`: the free variables where the criterion is least; `terms`: names left there.
    """

    def __init__(
        self, problem: Problem, library: ForceLibrary, penalty: float | None, has_errors: bool
    ):
        self.problem, self.library, self.has_errors = problem, library, has_errors
        self.where = places(problem, library)
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
        of_stage: dict[str, Any] = {"stage": 0, "max_steps": _REFIT, "watch": lambda *_: None}
        of_stage |= {"tolerance": _PRECISE, "degrees": degrees, "extra": jnp.asarray(keep)}
        return self.stage.run(u, np.inf, **of_stage)

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
