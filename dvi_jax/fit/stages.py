"""From a start to a minimum: stages of growing horizon, or segments tied together."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .horizons import suitable_horizon
from .losses import Likelihood
from .optimise import Evaluation, LeastSquaresStage, Position, ScalarStage
from .problem import Problem
from .results import FIT_RESULTS
from .run import Run
from .shooting import Segments
from .solvers import goes_by_optax
from .uncertainty import null_space

MANY = 400
"""Parameters beyond which the default is a gradient method, and no covariance is made: a Jacobian
costs a trajectory each."""

_BEFORE_LAST = 15
"""Steps of a stage that is not the last."""

_IN_SEGMENTS = 40
"""Steps of a stage of multiple shooting."""


class Minimum(NamedTuple):
    """Where a fit ended: u, how, the Jacobian of the residuals there (or a matrix whose square is
    the Hessian), a basis of the directions that constraints leave free, and whitened residuals
    with predictions, as far as they are known."""

    u: np.ndarray
    status: FIT_RESULTS
    jacobian: Any = None
    free: np.ndarray | None = None
    aux: Any = None


def least_squares(run: Run, u: np.ndarray, solver: Any, wanted: Any, check_units: bool) -> Minimum:
    """Stages of growing horizon; u, the Jacobian of the last, and how it ended."""
    problem = run.problem
    stage = LeastSquaresStage(problem.evaluate, solver)
    resume = run.take_resume()
    number, whole = 0, None
    if resume is None:
        # Everything is looked at once; a shorter horizon takes the rows that it needs.
        whole = stage.at(u)
        problem.check_start(whole.aux[1], check_units)
        horizon = _next(problem, wanted, 0, whole.aux[0], 0.0)
    else:
        number, horizon = resume.stage, resume.horizon
    while True:
        is_last = horizon == np.inf
        u, found, status = stage.run(
            u,
            horizon,
            tolerance=run.tolerance if is_last else max(1e-2, run.tolerance),
            degrees=problem.degrees_of_freedom,
            first=None if whole is None else _up_to(problem, whole, horizon),
            **_settings(run, number, resume, None if is_last else _BEFORE_LAST),
        )
        resume = None
        if is_last or status == FIT_RESULTS.not_finite:
            return Minimum(u, status, found.jacobian, None, found.aux if is_last else None)
        number += 1
        whole = stage.at(u)
        if run.left <= 0:  # a piece may have converged, the whole has not
            return Minimum(u, FIT_RESULTS.max_steps_reached, whole.jacobian, None, whole.aux)
        horizon = _next(problem, wanted, number, whole.aux[0], 2 * horizon * (1 - 1e-9))


def _settings(run: Run, number: int, resume: Position | None, most: int | None) -> dict[str, Any]:
    """What every kind of stage takes; `most`: its steps, those before it was resumed included, if
    it is not the last."""
    done = 0 if resume is None else resume.done
    steps = done + run.left
    if most is not None:
        steps = min(max(most, done), steps)
    return {"stage": number, "max_steps": steps, "resume": resume, "watch": run.watch}


def _next(problem: Problem, wanted: Any, number: int, rows: list[Array], at_least: float) -> float:
    if wanted is not None:
        return wanted[min(number, len(wanted) - 1)]
    return suitable_horizon(problem, [np.asarray(r) for r in rows], at_least)


def _up_to(problem: Problem, whole: Evaluation, horizon: float) -> Evaluation:
    """What is known of a horizon from what is known of everything."""
    keep = problem.rows_within(horizon)
    r, J, aux = whole
    return Evaluation(jnp.where(keep, r, 0.0), jnp.where(keep[:, None], J, 0.0), aux)


def by_gradient(run: Run, u: np.ndarray, solver: Any, wanted, batch, seed: int, units: bool):
    """The same by a minimiser of the scalar loss."""
    problem = run.problem
    is_optax = goes_by_optax(solver)

    # Per value, so that a learning rate means the same for any amount of data.
    stage = ScalarStage(problem.core, float(problem.count) if is_optax else 1.0, solver)
    choose = None if batch is None else _draw(problem, batch, seed)
    short = run.max_steps // 8 if is_optax else _BEFORE_LAST
    resume = run.take_resume()
    if resume is None:
        rows, known = problem.whitened(u)
        problem.check_start(known, units)
        number, horizon = 0, _next(problem, wanted, 0, rows, 0.0)
        scale = np.ones(problem.size) if is_optax else _lengths(problem, u)
    else:
        number, horizon, scale = resume.stage, resume.horizon, resume.scale
    while True:
        is_last = horizon == np.inf
        settings = _settings(run, number, resume, None if is_last else short)
        settings |= {"tolerance": run.tolerance, "scale": scale, "choose": choose}
        u, status = stage.run(u, horizon, **settings)
        resume = None
        rows, known = problem.whitened(u)
        if is_last or status == FIT_RESULTS.not_finite:
            break
        if run.left <= 0:
            status = FIT_RESULTS.steps_done if is_optax else FIT_RESULTS.max_steps_reached
            break
        number += 1
        horizon = _next(problem, wanted, number, rows, 2 * horizon * (1 - 1e-9))
    aux = rows, known
    if problem.size > MANY or status == FIT_RESULTS.not_finite:
        return Minimum(u, status, aux=aux)
    if isinstance(problem.loss, Likelihood):
        return Minimum(u, status, _root_of_hessian(problem, u), aux=aux)
    return Minimum(u, status, problem.evaluate(u).jacobian, aux=aux)


def _lengths(problem: Problem, u: np.ndarray) -> np.ndarray:
    """Scales of u in which the residuals change alike."""
    J = np.asarray(problem.evaluate(u).jacobian)
    length = np.linalg.norm(np.where(np.isfinite(J), J, 0.0), axis=0)
    return np.where(length > 0, 1 / np.where(length > 0, length, 1.0), 1.0)


def _draw(problem: Problem, batch: int, seed: int) -> Callable[[int], Any]:
    """Which arcs of each group a step looks at: a function of its number."""

    def choose(step):
        random = np.random.default_rng([seed, step])
        return [
            jnp.asarray(np.sort(random.choice(n, min(batch, n), replace=False)))
            for n in (len(group.arcs) for group in problem.groups)
        ]

    return choose


def _root_of_hessian(problem: Problem, u: np.ndarray) -> np.ndarray:
    """A matrix whose square JᵀJ is the exact Hessian of the loss, NaN if it is not positive."""
    H = np.asarray(problem.hessian(u))
    length = np.sqrt(np.abs(np.diag(H)))
    scale = np.where(length > 0, length, 1.0)
    values, vectors = np.linalg.eigh((H + H.T) / 2 / np.outer(scale, scale))
    values = np.where(np.abs(values) <= 1e-12 * np.abs(values).max(initial=0.0), 0.0, values)
    return np.sqrt(np.where(values >= 0, values, np.nan))[:, None] * vectors.T * scale


def in_segments(run: Run, segments: Segments, u: np.ndarray, solver: Any) -> Minimum:
    """Multiple shooting: Levenberg–Marquardt inside of an augmented Lagrangian."""
    problem, n, gaps = run.problem, run.problem.size, segments.num_gaps
    stage = LeastSquaresStage(eqx.filter_jit(segments.evaluate), solver)
    resume = run.take_resume()
    w, found = segments.begin(u), None
    if resume is None:
        number, multipliers, root = 0, np.zeros(gaps), 1.0
        r, _, c = stage.at(w, np.inf, (jnp.asarray(root), jnp.asarray(multipliers)))
        # Continuity weighs as much as the data to begin with.
        misfit, size = float(np.linalg.norm(r[: len(r) - gaps])), float(np.linalg.norm(c))
        root = max(misfit / max(size, 1e-2), np.sqrt(len(r)))
    else:
        number, (root, multipliers) = resume.stage, (float(resume.extra[0]), resume.extra[1])
    while True:
        settings = _settings(run, number, resume, _IN_SEGMENTS)
        settings |= {"tolerance": run.tolerance, "degrees": max(problem.degrees_of_freedom, 1)}
        extra = jnp.asarray(root), jnp.asarray(multipliers)
        w, found, status = stage.run(w, np.inf, extra=extra, **settings)
        resume = None
        if status == FIT_RESULTS.not_finite:
            break
        c = np.asarray(found.aux)
        met = float(np.abs(c).max()) <= segments.shooting.tolerance
        if (met and status == FIT_RESULTS.converged) or run.left <= 0:
            status = status if met else FIT_RESULTS.discontinuous
            break
        multipliers = multipliers + root**2 * c
        root = root * 10 if number < 3 else root
        number += 1
    J = np.asarray(found.jacobian)
    data, tied = J[: len(J) - gaps], J[len(J) - gaps :]
    free = null_space(tied / root) if np.isfinite(J).all() else None
    return Minimum(w[:n], status, data, free)
