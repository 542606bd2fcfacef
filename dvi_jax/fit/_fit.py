"""`fit`: parameters of a model from observations."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import PyTree

from .._checks import fraction, instance, whole
from .._precision import require_double
from .losses import LeastSquares, Likelihood, Loss
from .observations import Data, as_arcs
from .outcome import result_of
from .problem import Problem
from .progress import FitProgress, shown
from .result import FitResult
from .results import FIT_RESULTS, FitError
from .run import Run, identity
from .shooting import MultipleShooting, Segments, SingleShooting
from .solvers import goes_by_optax, is_gauss_newton, solver_for
from .stages import MANY, by_gradient, in_segments, least_squares


def fit(
    model: Callable[..., Any],
    data: Data,
    params: PyTree,
    *,
    bounds: PyTree = None,
    priors: PyTree = None,
    loss: Loss | Likelihood = LeastSquares(),
    shooting: SingleShooting | MultipleShooting = SingleShooting(),
    optimiser: Any = None,
    max_steps: int | None = None,
    tolerance: float = 1e-4,
    horizons: str | list[float] | None = "auto",
    batch: int | None = None,
    seed: int = 0,
    check_units: bool = True,
    check_curvature: bool = True,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool | Callable[[FitProgress], None] | None = None,
    throw: bool = True,
) -> FitResult:
    r"""Parameters of a disturbed system from observed trajectories.

    Makes ½ Σ ρ(r²) + ½ Σ ((x − mean)/sigma)² small over the parameters x, where r are the
    predicted minus the observed values in standard errors; derivatives are those of the discrete
    map.

    **Arguments**

    - `model`: a `Model`, or a function ``(params)`` or ``(params, arc)`` that returns the
      arguments of `integrate` as a dict: system, q0, p0, h, epsilon, args, method, …
    - `data`: `Observations`, or a list of them, one for each arc.
    - `params`: a pytree with starting values: numbers and floating-point arrays are fitted, what
      else it holds stays as it is. For a `Model` a dict with keys among q0, p0, epsilon, args.
    - `bounds`, `priors`: like params, with `Bounds` and `Prior` in place of numbers; entries
      without one may be left out.
    - `loss`: `LeastSquares()`; `SoftL1()`, `Cauchy()` against outliers; `Likelihood(f)`.
    - `shooting`: `SingleShooting()`, or `MultipleShooting(segments)` for long or chaotic arcs.
    - `optimiser`: None takes Levenberg–Marquardt, for more than 400 parameters Adam, for a
      `Likelihood` BFGS; or a solver of optimistix, or a gradient transformation of optax.
    - `max_steps`: in all; None means 200, with optax 2000.
    - `tolerance`: a fit has converged when the next step would move what is predicted, taken
      together, by less than this many standard errors.
    - `horizons`: ``"auto"`` fits the beginning of the arcs first where the start is so far off
      that the end would mislead, and goes on to longer pieces; None takes everything at once; or a
      list of times since t0 to go through before the whole.
    - `batch`: with optax, how many arcs of each group are drawn for each step; `seed` of the draw.
    - `check_units`: refuse data that differ from the model by orders of magnitude.
    - `check_curvature`: compare the Gauss–Newton errors with exact second derivatives (for up to
      50 parameters).
    - `checkpoint`: a file that is written every few seconds. The same call goes on from it, with
      the same bits as without the interruption, also with more `max_steps`; it is removed when
      the fit has converged.
    - `progress`: True shows a bar, False none, None where there is a terminal; or a function of a
      `FitProgress`.
    - `throw`: raise `FitError` when the fit does not converge; it holds what was found. Otherwise
      read ``fit.result``.

    **Returns** a `FitResult`.

    **Raises** `ValueError` or `TypeError` for input that cannot be meant; `FitError`.

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
    arcs, many = as_arcs(data)
    problem = Problem(model, arcs, many, params, bounds=bounds, priors=priors, loss=loss)
    kinds = SingleShooting | MultipleShooting
    instance("shooting", shooting, kinds, "a dvi.SingleShooting() or a dvi.MultipleShooting(n)")
    if max_steps is not None:
        whole("max_steps", max_steps)
    fraction("tolerance", tolerance)
    is_residuals = isinstance(problem.loss, Loss)
    solver = solver_for(optimiser, is_residuals, problem.size > MANY, max_steps or 2000)
    is_optax, is_vector = goes_by_optax(solver), is_gauss_newton(solver)
    if not is_optax:
        problem.check_count()
    max_steps = max_steps or (2000 if is_optax else 200)
    if batch is not None:
        whole("batch", batch)
        if not is_optax:
            raise ValueError("batch is for a stochastic optimiser, such as optax.adam(1e-3).")
    if isinstance(shooting, MultipleShooting) and not is_vector:
        raise ValueError("multiple shooting goes with least squares and their solvers alone.")
    wanted = _horizons(horizons)
    u = problem.space.to_u(problem.start)
    name = identity(problem, u, solver, shooting, wanted, batch, seed, tolerance)
    with shown(progress) as show:
        run = Run(problem, max_steps, tolerance, show, began, checkpoint, name)
        if isinstance(shooting, MultipleShooting):
            found = in_segments(run, Segments(problem, shooting), u, solver)
        elif is_vector:
            found = least_squares(run, u, solver, wanted, check_units)
        else:
            found = by_gradient(run, u, solver, wanted, batch, seed, check_units)
    found, status = result_of(run, found, check_curvature), found.status
    fine = bool((status == FIT_RESULTS.converged) | (status == FIT_RESULTS.steps_done))
    if checkpoint is not None and fine:
        Path(checkpoint).unlink(missing_ok=True)
    if fine or not throw:
        return found
    raise FitError(
        f"the fit did not converge ({found.status} after {len(run.records)} steps, loss "
        f"{found.loss:.6g}). {FIT_RESULTS[status]} With throw=False what was found is returned "
        "with its status; here it is the `fit` attribute of this error.",
        found,
    )


def _horizons(horizons: Any) -> list[float] | None:
    """Times to go through; None for those that suit."""
    if isinstance(horizons, str):
        if horizons != "auto":
            raise ValueError(f'horizons must be "auto", None or a list of times, got {horizons!r}.')
        return None
    if horizons is None:
        return [np.inf]
    found = np.asarray(horizons, float)
    if found.ndim != 1 or not (np.diff(found) > 0).all() or not (found > 0).all():
        raise ValueError(f"horizons must be growing positive times, got {horizons!r}.")
    return [*found.tolist(), np.inf]
