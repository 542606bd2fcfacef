"""What is made of a minimum: errors, what is not determined, residuals."""

import time

import jax.numpy as jnp
import numpy as np

from .losses import Loss
from .problem import Problem
from .result import FitResult
from .run import Run
from .stages import Minimum
from .uncertainty import Uncertainty, in_words, uncertainty

_FEW = 50
"""Parameters up to which exact second derivatives are taken."""


def result_of(run: Run, minimum: Minimum, check_curvature: bool) -> FitResult:
    """Errors and residuals at a minimum, as the user sees them."""
    problem, u, n = run.problem, minimum.u, run.problem.size
    space, has_residuals = problem.space, isinstance(problem.loss, Loss)
    aux = minimum.aux or problem.whitened(u)
    predicted, whitened, trajectories = problem.by_arc(*aux)
    x = np.asarray(space.to_x(jnp.asarray(u)))
    if has_residuals:
        loss = float(np.sum(np.asarray(problem.core.root_rows(jnp.asarray(u), aux[0])) ** 2) / 2)
    else:
        loss = float(problem.core.scalar(jnp.asarray(u)))
    degrees = problem.degrees_of_freedom
    off = np.asarray(problem.core.prior_rows(jnp.asarray(u)))
    variance = 1.0
    covariance, curvature, lost, values = np.full((n, n), np.nan), None, [], np.zeros(0)
    if minimum.jacobian is not None and np.isfinite(minimum.jacobian).all():
        J = np.asarray(minimum.jacobian)
        about = uncertainty(J, 1.0, minimum.free)
        degrees += about.undetermined.shape[1]  # what is not determined takes no degree
        if has_residuals and not problem.has_errors:
            variance = 2 * loss / degrees if degrees > 0 else np.nan
        slope, values = space.slope(u), about.singular_values
        with np.errstate(invalid="ignore"):  # infinite variance, of a parameter without effect
            covariance = variance * about.covariance[:n, :n] * np.outer(slope, slope)
        lost = about.undetermined[:n].T
        if check_curvature and minimum.free is None and has_residuals and n <= _FEW:
            curvature = _curvature_ratio(problem, u, J, about)
    at_bounds = space.at_bounds(x, np.sqrt(np.diag(covariance)))
    free = ~np.isin(space.names, at_bounds)  # a parameter at its bound is known: it is there
    words = [in_words(d, list(space.names)) for d in lost if np.abs(d[free]).max(initial=0) > 1e-6]
    return FitResult(
        params=space.to_params(jnp.asarray(x)), x=x, names=list(space.names), covariance=covariance,
        history=run.history(), result=minimum.status, ts=[a.ts for a in problem.given],
        observed=[a.values for a in problem.given], predicted=predicted, whitened=whitened,
        errors=[a.errors for a in problem.given], loss=loss, degrees_of_freedom=degrees,
        num_observed=problem.count, prior_chi2=float(np.sum(off**2)),
        has_errors=problem.has_errors, undetermined=words, singular_values=values,
        curvature=curvature, at_bounds=at_bounds,
        trajectories=trajectories, seconds=time.monotonic() - run.began,
    )  # fmt: skip


def _curvature_ratio(problem: Problem, u: np.ndarray, J: np.ndarray, about: Uncertainty):
    """Exact second derivative of the loss along each principal direction over Gauss–Newton's."""
    D = about.directions[:, : about.directions.shape[1] - about.undetermined.shape[1]]
    exact = np.asarray(problem.curvature(u, D.T)) if D.shape[1] else np.zeros(0)
    return exact / np.sum((J @ D) ** 2, axis=0)
