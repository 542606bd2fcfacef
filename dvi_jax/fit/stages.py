"""From a start to a minimum: stages of growing horizon, or segments tied together.

A stage with a horizon uses only data up to that time after the start of each arc.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .losses import Likelihood
from .model import Group, weigh
from .optimise import FIT_RESULTS, LeastSquaresStage, ScalarStage
from .problem import FitProblem
from .roundoff import Evaluation
from .run import FitRun
from .shooting import Segments
from .solvers import is_optax
from .uncertainty import inverse_or, null_space

# Parameters beyond which the default is a gradient method without a covariance: each column of a
# Jacobian costs a trajectory.
JACOBIAN_LIMIT = 400
_BEFORE_LAST = 15  # Steps of a stage that is not the last
_IN_SEGMENTS = 40  # Steps of a stage of multiple shooting
_LEAST_GROWTH = 1.02  # Least factor between horizons where failing trajectories prevent a double
# Misfit, relative to the scatter of the data, up to which a fit of all data is expected to find the
# nearest minimum: half of it is a sixth of a period's phase.
_MISFIT_LIMIT = 0.5


class Minimum(NamedTuple):
    """Where a fit ended.

    - `u`, `status`. `jacobian` of the residuals there, or a matrix whose square is the Hessian.
    - `free`: a basis of the directions that constraints leave free. `aux`: whitened residuals, and
      predictions with statuses, of all data if they are known. `shifts`: of u by round-off.
    """

    u: np.ndarray
    status: FIT_RESULTS
    jacobian: Any = None
    free: np.ndarray | None = None
    aux: Any = None
    shifts: np.ndarray | None = None


def least_squares(run: FitRun, u: np.ndarray, solver: Any, horizons: Any, check: bool) -> Minimum:
    """Stages of growing horizon with a solver for the residual vector."""
    problem = run.problem
    stage = LeastSquaresStage(problem.evaluate, solver)

    def solve(u, task, evaluation):
        # All data were evaluated at u; a shorter horizon takes the rows that it needs.
        if evaluation is not None:
            keep = problem.rows_within(task.horizon)
            r, J, aux = evaluation
            evaluation = Evaluation(np.where(keep, r, 0.0), np.where(keep[:, None], J, 0.0), aux)
        return stage.run(u, task, problem.degrees_of_freedom, evaluation)

    shorter = _BEFORE_LAST, max(1e-2, run.tolerance), FIT_RESULTS.max_steps_reached
    u, end, status = _stages(run, u, horizons, check, stage.values_at, solve, shorter)
    return Minimum(u, status, end.jacobian, None, end.aux, stage.shifts)


def by_gradient(
    run: FitRun, u: np.ndarray, solver: Any, horizons: Any, check: bool, batch: Any, seed: int
) -> Minimum:
    """The same with a minimiser of the scalar loss."""
    problem, optax = run.problem, is_optax(solver)
    # Per value, so that a learning rate means the same for any amount of data.
    stage = ScalarStage(problem.core, float(problem.count) if optax else 1.0, solver)
    choose = None if batch is None else _draw(problem, batch, seed)
    scale = np.ones(problem.size)
    if run.resume is not None:
        scale = run.resume.scale
    elif not optax:  # scales of u along which the residuals change by equal amounts
        J = np.asarray(problem.evaluate(u).jacobian)
        scale = inverse_or(np.linalg.norm(np.where(np.isfinite(J), J, 0.0), axis=0), 1.0)

    def look(u):
        return Evaluation(jnp.zeros(0), jnp.zeros(0), problem.weighted_residuals(u))

    def solve(u, task, evaluation):
        u, status = stage.run(u, task, scale, choose)
        return u, look(u), status

    cut = FIT_RESULTS.steps_done if optax else FIT_RESULTS.max_steps_reached
    shorter = (run.max_steps // 8 if optax else _BEFORE_LAST), run.tolerance, cut
    u, end, status = _stages(run, u, horizons, check, look, solve, shorter)
    if problem.size > JACOBIAN_LIMIT or status == FIT_RESULTS.not_finite:
        J = None
    elif isinstance(problem.loss, Likelihood):
        J = _root_of_hessian(problem, u)
    else:
        J = problem.evaluate(u).jacobian
    return Minimum(u, status, J, aux=end.aux)


def _stages(
    run: FitRun,
    u: np.ndarray,
    horizons: list[float] | None,
    check_units: bool,
    look: Callable[..., Evaluation],
    solve: Callable[..., tuple[np.ndarray, Evaluation, FIT_RESULTS]],
    before_last: tuple[int, float, FIT_RESULTS],
) -> tuple[np.ndarray, Evaluation, FIT_RESULTS]:
    """Stages up to the one of all data; u, the evaluation there and the status.

    - `look`: u → the evaluation with all data. `solve`: (u, task, that evaluation if it is known) →
      a stage's u, evaluation and status.
    - `before_last`: steps and tolerance of a stage that is not the last, and the status of a fit
      whose steps end there: a piece may have converged, the whole has not.
    """
    problem, evaluation = run.problem, None
    step_limit, tolerance, cut = before_last
    if run.resume is None:
        number, evaluation = 0, look(u)
        problem.check_start(evaluation.aux[1], check_units)
        horizon = _horizon(problem, horizons, 0, evaluation.aux[0], 0.0)
    else:
        number, horizon = run.resume.stage, run.resume.horizon
    while horizon < np.inf:
        task = run.task(number, horizon, tolerance, step_limit)
        u, end, status = solve(u, task, evaluation)
        if status == FIT_RESULTS.not_finite:
            return u, end._replace(aux=None), status
        number, evaluation = number + 1, look(u)
        if run.left <= 0:
            return u, evaluation, cut
        horizon = _horizon(problem, horizons, number, evaluation.aux[0], 2 * horizon * (1 - 1e-9))
    return solve(u, run.task(number, horizon, run.tolerance, None), evaluation)


# ---- horizons


def _horizon(problem: FitProblem, horizons: Any, number: int, rows: list, at_least: float) -> float:
    """The horizon of a stage; infinite for all data.

    Where none are `horizons`: the longest of full, full/2, full/4, … over which the misfit is small
    compared with the scatter of the data; without such a horizon, the shortest with enough data for
    the parameters, but not beyond the first prediction that is not finite.

    - `rows`: whitened residuals (A, N, K) of each group. `at_least`: a horizon to exceed.
    """
    if horizons is not None:
        return horizons[min(number, len(horizons) - 1)]

    def observed_entries(of_groups):
        pairs = zip(of_groups, problem.groups, strict=True)
        return np.concatenate([np.broadcast_to(x, g.mask.shape)[g.mask] for x, g in pairs])

    spans = [np.abs(g.ts - g.t0[:, None]) for g in problem.groups]
    full, shortest = max(float(span.max()) for span in spans), np.inf
    scatter = observed_entries(map(_scatter, problem.groups))
    threshold = _MISFIT_LIMIT * np.sqrt(np.mean(scatter**2))
    times_since_start = observed_entries(span[..., None] for span in spans)
    misfit = observed_entries(map(np.asarray, rows))
    minimum_count = 2 * max(problem.size - problem.space.count_of_priors, 1)
    horizon = full
    while horizon > at_least:
        mask = times_since_start <= horizon * (1 + 1e-12)
        if mask.sum() < minimum_count:
            break
        if np.isfinite(misfit[mask]).all() and np.sqrt(np.mean(misfit[mask] ** 2)) <= threshold:
            return np.inf if horizon == full else horizon
        shortest = horizon
        horizon /= 2
    first_failure = times_since_start[~np.isfinite(misfit)].min(initial=np.inf)
    if shortest >= first_failure > _LEAST_GROWTH * at_least / 2:
        return first_failure * (1 - 1e-9)
    return np.inf if shortest >= full else shortest


def _scatter(group: Group) -> np.ndarray:
    """Observed values minus their mean over the arc, in standard errors, (A, N, K); for times of
    events the standard deviation of a time at random between two of them."""
    count = np.maximum(group.mask.sum(axis=1, keepdims=True), 1)
    mean = np.where(group.mask, group.values, 0).sum(axis=1, keepdims=True) / count
    scatter = group.values - mean
    if group.events is not None:
        scatter[..., -len(group.kinds) :] = group.events[..., 2] / np.sqrt(12)
    return weigh(np.where(group.mask, scatter, 0.0), group.whiten)


# ---- what gradient methods need


def _draw(problem: FitProblem, batch: int, seed: int) -> Callable[[int], Any]:
    """The arcs of each group that a step uses: a function of its number."""

    def choose(step):
        random = np.random.default_rng([seed, step])
        return [
            jnp.asarray(np.sort(random.choice(n, min(batch, n), replace=False)))
            for n in (len(group.arcs) for group in problem.groups)
        ]

    return choose


def _root_of_hessian(problem: FitProblem, u: np.ndarray) -> np.ndarray:
    """A matrix whose square JᵀJ is the exact Hessian of the loss, NaN if it is not positive."""
    H = np.asarray(problem.hessian(u))
    length = np.sqrt(np.abs(np.diag(H)))
    scale = np.where(length > 0, length, 1.0)
    values, vectors = np.linalg.eigh((H + H.T) / 2 / np.outer(scale, scale))
    values = np.where(np.abs(values) <= 1e-12 * np.abs(values).max(initial=0.0), 0.0, values)
    return np.sqrt(np.where(values >= 0, values, np.nan))[:, None] * vectors.T * scale


# ---- multiple shooting


def in_segments(run: FitRun, segments: Segments, u: np.ndarray, solver: Any) -> Minimum:
    """Multiple shooting: Levenberg–Marquardt inside of an augmented Lagrangian."""
    n, gaps, resume = run.problem.size, segments.num_gaps, run.resume
    stage = LeastSquaresStage(eqx.filter_jit(segments.evaluate), solver)
    w = segments.begin(u)
    if resume is None:
        number, multipliers = 0, np.zeros(gaps)
        r, _, c = stage.values_at(w, np.inf, (jnp.asarray(1.0), jnp.asarray(multipliers)))
        # Continuity weighs as much as the data to begin with.
        misfit, size = float(np.linalg.norm(r[: len(r) - gaps])), float(np.linalg.norm(c))
        root = max(misfit / max(size, 1e-2), np.sqrt(len(r)))
    else:
        number, root, multipliers = resume.stage, float(resume.extra[0]), resume.extra[1]
    degrees = max(run.problem.degrees_of_freedom, 1)
    while True:
        task = run.task(number, np.inf, run.tolerance, _IN_SEGMENTS)
        extra = jnp.asarray(root), jnp.asarray(multipliers)
        w, end, status = stage.run(w, task, degrees, extra=extra)
        if status == FIT_RESULTS.not_finite:
            break
        c = np.asarray(end.aux)
        is_continuous = float(np.abs(c).max()) <= segments.shooting.tolerance
        if (is_continuous and status == FIT_RESULTS.converged) or run.left <= 0:
            status = status if is_continuous else FIT_RESULTS.discontinuous
            break
        multipliers = multipliers + root**2 * c
        root = root * 10 if number < 3 else root
        number += 1
    J = np.asarray(end.jacobian)
    data, constraint_rows = J[: len(J) - gaps], J[len(J) - gaps :]
    free = null_space(constraint_rows / root) if np.isfinite(J).all() else None
    shifts = None if stage.shifts is None else stage.shifts[:, :n]
    return Minimum(w[:n], status, data, free, shifts=shifts)
