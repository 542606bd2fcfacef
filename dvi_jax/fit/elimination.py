"""Terms of a force removed one by one: backward elimination by a criterion."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .library import KEY, ForceLibrary
from .optimise import FIT_RESULTS, Evaluation, LeastSquaresStage, StageTask
from .problem import FitProblem
from .solvers import levenberg_marquardt
from .uncertainty import Uncertainty, in_words, inverse_or, uncertainty

_REFIT = 30  # Steps of a refit, which begins next to its minimum
_PRECISE = 1e-4  # Tolerance of a refit in standard errors: 1e-8 in chi²
_MARGIN = 3.0  # Penalties by which the criterion may exceed the best before the end
_GAIN = 1e-3  # Decrease of the criterion from which on an exchange counts
_ROUNDING = 1e-11  # Least relative error of any data: exact ones have no information below it


@dataclass(frozen=True)
class Removal:
    """One stage of an identification.

    - `removed`: the candidate that was removed, None for the beginning with all of them; `added`:
      the one that was added, in its place or (`removed` is None) to the others.
    - `terms`: the remaining ones. `chi2`: Σ of the squared whitened residuals of their fit.
    - `criterion`: the quantity to minimise. `status`: of the refit.
    """

    removed: str | None
    terms: tuple[str, ...]
    chi2: float
    criterion: float
    status: FIT_RESULTS
    added: str | None = None


def places(problem: FitProblem, library: ForceLibrary) -> np.ndarray:
    """Indices of the coefficients among the free variables."""
    names = list(problem.space.names)
    return np.array([names.index(f"{KEY}.{name}") for name in library.names])


class Elimination:
    """Backward elimination of the terms of a force, then exchanges of single terms.

    - `problem`: with all coefficients, at their minimum, held by a wide prior each.
    - `path`; `best`: the free variables at the least criterion, `keep`: which of them take part.
    """

    def __init__(self, problem: FitProblem, library: ForceLibrary, penalty, has_errors: bool):
        self.problem, self.library, self.has_errors = problem, library, has_errors
        self.where = places(problem, library)
        usual = np.log(problem.count) + 2 * np.log(len(library))
        self.penalty = float(usual if penalty is None else penalty)
        self.stage = LeastSquaresStage(self._evaluate, levenberg_marquardt())
        self.path: list[Removal] = []
        self.combinations: list[str] = []
        self.best = problem.space.to_u(problem.start)
        self.keep, self.minimum = np.ones(problem.size, bool), np.inf
        self.worse: dict[tuple[int | None, int | None], float] = {}

    def _evaluate(self, u: Array, horizon: Any, keep: Array) -> Evaluation:
        """Residual and Jacobian with the variables that are not kept at zero."""
        # The compiled program of the fit itself serves all sets of terms.
        r, J, _ = self.problem.evaluate(jnp.where(keep, u, 0.0), horizon)
        return Evaluation(r, J * keep[None])

    @property
    def terms(self) -> tuple[str, ...]:
        """Candidates of the best set."""
        return self._terms_of(self.keep)

    def _terms_of(self, keep: np.ndarray) -> tuple[str, ...]:
        return tuple(itertools.compress(self.library.names, keep[self.where]))

    def search(self) -> None:
        """Remove terms, then exchange, add or remove single ones while the criterion decreases.

        A term is removed when the others are not yet the right ones, so that the removal may be
        wrong. The derivatives at the minimum propose a change; the refit decides.
        """
        self._eliminate(self.best, self.keep)
        while True:
            for rise, i, k in sorted(self._changes(), key=lambda change: change[0]):
                if rise > -_GAIN:
                    return
                keep, names = (
                    self.keep.copy(),
                    [None if x is None else self.library.names[x] for x in (i, k)],
                )
                for x, is_kept in ((i, False), (k, True)):
                    if x is not None:
                        keep[self.where[x]] = is_kept
                u, evaluation, _ = self._refit(self.best, keep)
                value = self._criterion(evaluation, keep)
                if value < self.minimum - _GAIN:
                    self._eliminate(u, keep, *names)
                    break
                self.worse[i, k] = value - self.minimum
            else:
                return

    def _criterion(self, evaluation: Evaluation, keep: np.ndarray) -> float:
        """The quantity to minimise, ∞ if it is not finite."""
        value = self._misfit(self._chi2(evaluation)) + self.penalty * int(keep[self.where].sum())
        return value if np.isfinite(value) else np.inf

    def _eliminate(self, u: np.ndarray, keep: np.ndarray, name: Any = None, added: Any = None):
        """Remove terms until none is left, or the criterion is far above its minimum."""
        while True:
            u, evaluation, status = self._refit(u, keep)
            value = self._criterion(evaluation, keep)
            numbers = self._chi2(evaluation), value
            self.path.append(Removal(name, self._terms_of(keep), *numbers, status, added))
            if value < self.minimum:
                self.minimum, self.best, self.keep, self.worse = value, u, keep, {}
            is_worse = not np.isfinite(value) or value > self.minimum + _MARGIN * self.penalty
            if is_worse or not keep[self.where].any():
                return
            J = self._of_data(evaluation.jacobian)
            spectrum = uncertainty(J[:, keep], 1.0)
            if len(self.path) == 1:
                names = [n.removeprefix(f"{KEY}.") for n in self.problem.space.names]
                self.combinations = [in_words(d, names) for d in spectrum.null_directions.T]
            i = self._weakest(u, J, keep, spectrum)
            remainder = keep & (np.arange(len(u)) != self.where[i])
            u = _eliminate(u, np.asarray(evaluation.jacobian), self.where[i], remainder)
            keep, name, added = remainder, self.library.names[i], None

    def _refit(self, u: np.ndarray, keep: np.ndarray) -> tuple[Any, Evaluation, FIT_RESULTS]:
        """The minimum near u; where it is worse than no force at all, the minimum near that."""
        u = np.where(keep, u, 0.0)
        if not keep.any():
            return u, self.stage.values_at(u, np.inf, jnp.asarray(keep)), FIT_RESULTS.converged
        task = StageTask(0, np.inf, _REFIT, _PRECISE)
        degrees, extra = self.problem.count - int(keep.sum()), jnp.asarray(keep)
        outcome = self.stage.run(u, task, degrees, extra=extra)
        zero = u.copy()
        zero[self.where] = 0.0
        bare = np.asarray(self.stage.values_at(zero, np.inf, extra).residual)
        r = np.asarray(outcome[1].residual)
        if np.isfinite(bare).all() and not r @ r <= bare @ bare:
            outcome = self.stage.run(zero, task, degrees, extra=extra)
        return outcome

    def _of_data(self, rows: Any) -> np.ndarray:
        """Residuals, or their Jacobian, without the priors that hold the coefficients."""
        rows = np.array(rows)
        rows[len(rows) - self.problem.size + self.where] = 0.0
        return rows

    def _chi2(self, evaluation: Evaluation) -> float:
        return float(np.sum(self._of_data(evaluation.residual) ** 2))

    def _misfit(self, chi2: float) -> float:
        """−2 log likelihood at its maximum over an unknown error, up to a constant."""
        if self.has_errors:
            return chi2
        count = self.problem.count
        size = max(float(np.abs(g.values * g.whiten).max()) for g in self.problem.groups)
        return count * float(np.log(chi2 / count + (_ROUNDING * size) ** 2 + 1e-300))

    def _weakest(self, u: np.ndarray, J, keep, spectrum: Uncertainty) -> int:
        """The number of the term with the least |c|/sigma; of those without an error (in a
        combination that is not determined) the one of least effect."""
        sigma = np.full(len(u), np.inf)
        sigma[keep] = np.sqrt(np.diag(spectrum.covariance))
        strength = np.where(np.isfinite(sigma), np.abs(u) / sigma, 0.0)
        effect = np.abs(u) * np.linalg.norm(J, axis=0)
        terms = [i for i in range(len(self.library)) if keep[self.where[i]]]
        return min(terms, key=lambda i: (strength[self.where[i]], effect[self.where[i]]))

    def alternatives(self) -> dict[str, list[tuple[str, float]]]:
        """For each term the candidates that would raise the criterion by less than a penalty.

        By the derivatives at the minimum, or the refit of those that promised a decrease: exact
        for candidates with the same effect, and those with another effect are far off in any case.
        """
        names, replacements = self.library.names, {}
        for rise, i, k in self._changes():
            if i is not None and k is not None and rise < self.penalty:
                replacements.setdefault(names[i], []).append((names[k], rise))
        return {name: sorted(x, key=lambda pair: pair[1]) for name, x in replacements.items()}

    def _changes(self) -> Iterator[tuple[float, int | None, int | None]]:
        """The rise of the criterion when candidate k takes the place of term i, or is added to the
        terms (i None), or term i is removed (k None), as (rise, i, k)."""
        evaluation = self.stage.values_at(self.best, np.inf, jnp.ones(self.problem.size, bool))
        r, J = self._of_data(evaluation.residual), self._of_data(evaluation.jacobian)
        if not (np.isfinite(r).all() and np.isfinite(J).all()):
            return
        criterion, selection = self._misfit(float(r @ r)), self.keep[self.where]
        for i in [*np.flatnonzero(selection).tolist(), None]:
            remainder, bare, price = self.keep.copy(), r, self.penalty
            if i is not None:  # Its part of the prediction is removed, the rest adapts.
                s, price = self.where[i], 0.0
                remainder[s], bare = False, r - J[:, s] * self.best[s]
            Q, _ = np.linalg.qr(J[:, remainder])
            bare = bare - Q @ (Q.T @ bare)
            if i is not None:
                rise = self._misfit(float(bare @ bare)) - criterion - self.penalty
                yield self.worse.get((i, None), rise), i, None
            for k in np.flatnonzero(~selection).tolist():
                column = J[:, self.where[k]]
                component = column - Q @ (Q.T @ column)
                if component @ component <= 1e-18 * (column @ column):
                    continue
                residual = bare - component * (component @ bare) / (component @ component)
                rise = self._misfit(float(residual @ residual)) - criterion + price
                yield self.worse.get((i, k), rise), i, k


def _eliminate(u: np.ndarray, J: np.ndarray, s: int, remainder: np.ndarray) -> np.ndarray:
    """Variables without number s, the rest moved so that predictions change least (first order)."""
    variables = u.copy()
    variables[s] = 0.0
    if remainder.any():
        scale = inverse_or(np.linalg.norm(J[:, remainder], axis=0), 0.0)
        shift = np.linalg.lstsq(J[:, remainder] * scale, J[:, s] * u[s], rcond=1e-10)[0]
        variables[remainder] += shift * scale
    return variables
