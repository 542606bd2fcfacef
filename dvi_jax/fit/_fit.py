"""`fit`: parameters of a model from observations."""

import os
import time
from collections.abc import Callable
from typing import Any, Unpack

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from ..base.checks import fraction, instance, one_of, whole
from ..base.files import user_path
from ..base.keywords import checked_keywords
from ..base.precision import require_double
from .checks import requires
from .keywords import FitSettings, LossSettings, select
from .losses import LeastSquares, Loss
from .observations import Data, as_arcs
from .optimise import FIT_RESULTS, FitError
from .problem import FitProblem
from .result import FitResult
from .run import FitRun, identity, progress_display
from .shooting import MultipleShooting, Segments, SingleShooting
from .solvers import is_gauss_newton, is_optax, solver_for
from .stages import JACOBIAN_LIMIT, Minimum, by_gradient, in_segments, least_squares
from .uncertainty import Uncertainty, conflict_of_priors, in_words, uncertainty

_CURVATURE_LIMIT = 50  # Parameters up to which second derivatives are computed
_SMALL = 1_000_000  # Steps of trajectories that take less time than compiling exact derivatives
_PART = 0.01  # Part of a standard error over which Jacobians are subtracted


@checked_keywords
def fit(
    model: Callable[..., Any],
    data: Data,
    params: PyTree,
    *,
    shooting: SingleShooting | MultipleShooting = SingleShooting(),
    optimiser: Any = None,
    horizons: str | list[float] | None = "auto",
    checkpoint: str | os.PathLike[str] | None = None,
    throw: bool = True,
    **settings: Unpack[FitSettings],
) -> FitResult:
    r"""Parameters of a perturbed system from observed trajectories.

    Minimises ½ Σ ρ(r²) + ½ Σ ((x − mean)/sigma)² over the parameters x, where r is predicted minus
    observed in standard errors. Derivatives are those of the discrete map.

    **Arguments**

    - `model`: a `Model`, or a function ``(params)`` or ``(params, arc)`` that returns the
      arguments of `integrate` as a dict: system, q0, p0, h, epsilon, args, method, …
    - `data`: `Observations`, or a list of them, one for each arc.
    - `params`: a pytree with starting values: numbers and floating-point arrays are fitted, other
      leaves are fixed. For a `Model` a dict with keys among q0, p0, epsilon, args.
    - `bounds`, `priors`: pytrees like params, with `Bounds` and `Prior` in place of numbers;
      entries without one may be left out.
    - `loss`: `LeastSquares()` (default); `SoftL1()`, `Cauchy()` against outliers; `Likelihood(f)`.
    - `shooting`: `SingleShooting()`, or `MultipleShooting(segments)` for long or chaotic arcs.
    - `optimiser`: None uses Levenberg–Marquardt, for more than 400 parameters Adam, for a
      `Likelihood` BFGS; or a solver of optimistix, or a gradient transformation of optax.
    - `max_steps`: in all; None means 200, with optax 2000.
    - `tolerance`: a fit has converged when the next step would change the predictions by less than
      this many standard errors in total, by default 1e-4, or if round-off of the predictions
      prevents that.
    - `horizons`: with ``"auto"``, if the initial guess is poor, the fit uses early data first and
      adds later data step by step. None fits all data at once. With a list of times since t0, the
      fit first uses the data up to each of them, then all data.
    - `batch`: with optax, how many arcs of each group are drawn for each step; `seed` of the draw.
    - `check_units`: reject data that differ from the model by orders of magnitude (default).
    - `check_curvature`: compare the Gauss–Newton errors with second derivatives, for up to 50
      parameters (by default).
    - `checkpoint`: a file that is written every few seconds. The same call continues from it, with
      the same bits as without the interruption, also with more `max_steps`; it is removed when
      the fit has converged.
    - `progress`: True shows a bar, False none, None where there is a terminal; or a function of a
      `FitProgress`.
    - `throw`: raise `FitError`, which holds the result, when the fit does not converge. Otherwise
      read ``fit.result``.

    **Returns** a `FitResult`.

    **Raises** `ValueError` or `TypeError` for invalid input; `FitError`.

    **Source** Levenberg 1944, Marquardt 1963 (by optimistix); Nocedal & Wright 2006, *Numerical
    Optimization*, chapters 10 and 17; the covariance, Bard 1974, *Nonlinear parameter estimation*.

    **Example**

    ```python
    spring = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + args["k"] * (q0 @ q0) / 2)
    model = dvi.Model(spring, h=0.1, q0=[1.0], p0=[0.0], method=dvi.Strang())
    ts = np.linspace(0.5, 10.0, 20)
    seen = np.cos(1.1 * ts) + 0.01 * np.random.default_rng(0).normal(size=20)
    data = dvi.Observations(ts, seen[:, None], sigma=0.01, t0=0.0)
    found = dvi.fit(model, data, {"args": {"k": 1.0}})
    print(found.status, round(float(found.params["args"]["k"]), 2))
    # converged 1.21
    ```
    """
    began = time.monotonic()
    require_double("a fit")
    arcs, is_list = as_arcs(data)
    problem = FitProblem(model, arcs, is_list, params, **select(settings, LossSettings))
    kinds = SingleShooting | MultipleShooting
    instance("shooting", shooting, kinds, "a dvi.SingleShooting() or a dvi.MultipleShooting(n)")
    max_steps, batch = settings.get("max_steps"), settings.get("batch")
    check_units, seed = settings.get("check_units", True), settings.get("seed", 0)
    if max_steps is not None:
        whole("max_steps", max_steps)
    tolerance = fraction("tolerance", settings.get("tolerance", 1e-4))
    has_residuals = isinstance(problem.loss, Loss)
    solver = solver_for(optimiser, has_residuals, problem.size > JACOBIAN_LIMIT, max_steps or 2000)
    uses_optax, is_vector = is_optax(solver), is_gauss_newton(solver)
    if not uses_optax:
        problem.check_count()
    max_steps = max_steps or (2000 if uses_optax else 200)
    if batch is not None:
        whole("batch", batch)
        example = "an optimiser of optax, such as optax.adam(1e-3)"
        requires(uses_optax, "batch", example, type(solver).__name__)
    if isinstance(shooting, MultipleShooting):
        condition = "a loss of residuals and a least-squares optimiser"
        names = f"{type(problem.loss).__name__} and {type(solver).__name__}"
        requires(is_vector, "dvi.MultipleShooting", condition, names)
    stage_horizons = _horizons(horizons)
    u = problem.space.to_u(problem.start)
    name = identity(problem, u, solver, shooting, stage_horizons, batch, seed, tolerance)
    with progress_display(settings.get("progress")) as show:
        run = FitRun(problem, max_steps, tolerance, show, began, checkpoint, name)
        if isinstance(shooting, MultipleShooting):
            minimum = in_segments(run, Segments(problem, shooting), u, solver)
        elif is_vector:
            minimum = least_squares(run, u, solver, stage_horizons, check_units)
        else:
            minimum = by_gradient(run, u, solver, stage_horizons, check_units, batch, seed)
    estimate = _result(run, minimum, settings.get("check_curvature", True))
    status = minimum.status
    fine = bool((status == FIT_RESULTS.converged) | (status == FIT_RESULTS.steps_done))
    if checkpoint is not None and fine:
        user_path("checkpoint", checkpoint).unlink(missing_ok=True)
    if fine or not throw:
        return estimate
    raise FitError(
        f"the fit did not converge (status: {estimate.status}, steps: {len(run.records)}, loss: "
        f"{estimate.loss:.6g}). {FIT_RESULTS[status]} The attribute `fit` is the result; "
        "throw=False returns it.",
        estimate,
    )


def _horizons(horizons: Any) -> list[float] | None:
    """Horizons of the stages; None for those chosen by the misfit."""
    if isinstance(horizons, str):
        one_of("horizons", horizons, ["auto"], "Or give None or a list of times.")
        return None
    if horizons is None:
        return [np.inf]
    times = np.asarray(horizons, float)
    if times.ndim != 1 or not (np.diff(times) > 0).all() or not (times > 0).all():
        rule = "'auto', None or increasing positive times"
        raise ValueError(f"horizons must be {rule}, got {horizons!r:.200}.")
    return [*times.tolist(), np.inf]


def _result(run: FitRun, minimum: Minimum, check_curvature: bool) -> FitResult:
    """Errors, undetermined directions and residuals at a minimum."""
    problem, n = run.problem, run.problem.size
    space, u, has_residuals = problem.space, jnp.asarray(minimum.u), isinstance(problem.loss, Loss)
    rows, predictions = minimum.aux or problem.weighted_residuals(u)
    predictions_by_arc, residuals_in_sigma, trajectories = problem.by_arc(rows, predictions)
    x = np.asarray(space.to_x(u))
    r = problem.root_rows(u, rows)
    loss = float(np.sum(r**2) / 2) if has_residuals else float(problem.core.scalar(u))
    degrees, variance = problem.degrees_of_freedom, 1.0
    covariance, curvature, free_directions, values = np.full((n, n), np.nan), None, [], np.zeros(0)
    rounding, conflict = np.zeros(n), 0.0
    if minimum.jacobian is not None and np.isfinite(minimum.jacobian).all():
        J = np.asarray(minimum.jacobian)
        spectrum = uncertainty(J, 1.0, minimum.free)
        if isinstance(problem.loss, LeastSquares) and minimum.status == FIT_RESULTS.converged:
            conflict = conflict_of_priors(J, r[-n:], minimum.free)
        degrees += spectrum.null_directions.shape[1]  # undetermined directions take no degree
        if has_residuals and not problem.has_errors:
            variance = 2 * loss / degrees if degrees > 0 else np.nan
        slope, values = space.slope(u), spectrum.singular_values
        with np.errstate(invalid="ignore"):  # infinite variance of a parameter without effect
            covariance = variance * spectrum.covariance[:n, :n] * np.outer(slope, slope)
        if minimum.shifts is not None and len(minimum.shifts):
            by_rounding = slope * minimum.shifts
            covariance = covariance + by_rounding.T @ by_rounding / (2 * len(by_rounding))
            rounding = np.sqrt(np.mean(by_rounding**2, axis=0) / 2)
        free_directions = spectrum.null_directions[:n].T
        if check_curvature and minimum.free is None and has_residuals and n <= _CURVATURE_LIMIT:
            curvature = _curvature_ratio(problem, u, r, J, spectrum)
    at_bounds = space.at_bounds(x, np.sqrt(np.diag(covariance)))
    free = ~np.isin(space.names, at_bounds)  # a parameter at its bound is known: it is there
    directions = [d for d in free_directions if np.abs(d[free]).max(initial=0) > 1e-6]
    words = [in_words(d, list(space.names)) for d in directions]
    return FitResult(
        params=space.to_params(jnp.asarray(x)),
        x=x,
        names=list(space.names),
        covariance=covariance,
        history=run.history(),
        result=minimum.status,
        ts=[arc.ts for arc in problem.data],
        observed=[arc.values for arc in problem.data],
        predicted=predictions_by_arc,
        whitened=residuals_in_sigma,
        errors=[arc.errors for arc in problem.data],
        loss=loss,
        degrees_of_freedom=degrees,
        num_observed=problem.count,
        has_errors=problem.has_errors,
        undetermined=words,
        singular_values=values,
        curvature=curvature,
        at_bounds=at_bounds,
        trajectories=trajectories,
        prior_chi2=float(np.sum(r[-n:] ** 2)),
        conflict=conflict,
        priors=[name for name, w in zip(space.names, space.prior_weight, strict=True) if w],
        rounding=rounding,
        start=problem.start_in_words(),
        seconds=time.monotonic() - run.began,
    )


def _curvature_ratio(problem: FitProblem, u: Any, r, J, spectrum: Uncertainty) -> np.ndarray:
    """Second derivative of the loss along each principal direction over Gauss–Newton's, which
    lacks r · r''.

    In a small problem r'' is a difference of Jacobians, whose program exists already; compiling
    one for exact second derivatives takes as long as all else.
    """
    D = spectrum.directions[:, : spectrum.directions.shape[1] - spectrum.null_directions.shape[1]]
    squares = np.sum((J @ D) ** 2, axis=0)
    if 2 * problem.size * (problem.size + 1) * problem.steps > _SMALL:
        return (np.asarray(problem.curvature(u, D.T)) if D.shape[1] else np.zeros(0)) / squares
    t = _PART * np.linalg.norm(r) / np.sqrt(squares * max(problem.degrees_of_freedom, 1))
    ratios = []
    for d, step, square in zip(D.T, t, squares, strict=True):
        points = (u + step * d, u - step * d)
        forward, backward = (np.asarray(problem.evaluate(x).jacobian) for x in points)
        change = r @ ((forward - backward) @ d)
        ratios.append(1 + (change / (2 * step * square) if step > 0 else 0.0))
    return np.array(ratios)
