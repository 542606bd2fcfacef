"""The front door: parameters of a model from observations."""

import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, PyTree

from .._compat import x64_enabled
from .horizons import suitable_horizon
from .losses import LeastSquares, Likelihood, Loss
from .observations import Observations, as_arcs
from .optimise import Evaluation, LeastSquaresStage, Position, Record, ScalarStage
from .problem import Problem
from .progress import FitProgress, shown
from .result import FitResult, read_npz, write_npz
from .results import FIT_RESULTS, FitError
from .shooting import MultipleShooting, Segments, SingleShooting
from .uncertainty import Uncertainty, in_words, null_space, uncertainty

_MANY = 400
"""Parameters beyond which the default is a gradient method: a Jacobian costs a trajectory each."""

_BEFORE_LAST = 15
"""Steps of a stage that is not the last."""

_IN_SEGMENTS = 40
"""Steps of a stage of multiple shooting."""

_EVERY = 5.0
"""Seconds between checkpoints."""


def fit(
    model: Callable[..., Any],
    data: Observations | list[Observations] | tuple[Observations, ...],
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
      arguments of `integrate` as a dict: system, q0, p0, h, epsilon, args, method, ….
    - `data`: `Observations`, or a list of them, one for each arc.
    - `params`: a pytree with starting values: floats and floating-point arrays are fitted, what
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
      the same bits as without the interruption; it is removed when the fit is done.
    - `progress`: True shows a bar, False none, None where there is a terminal; or a function of a
      `FitProgress`.
    - `throw`: raise `FitError` when the fit does not converge; it holds what was found. Otherwise
      read ``fit.result``.

    **Returns** a `FitResult`.

    **Raises** `ValueError` or `TypeError` for input that cannot be meant; `FitError`.

    **Source** Levenberg 1944, Marquardt 1963 (by optimistix); Nocedal & Wright 2006, *Numerical
    Optimization*, chapters 10 and 17; the covariance, Bard 1974, *Nonlinear parameter estimation*.
    """
    began = time.monotonic()
    if not x64_enabled():
        raise ValueError(
            'a fit needs double precision: put\n    jax.config.update("jax_enable_x64", True)\n'
            "before the first array is made."
        )
    arcs, many = as_arcs(data)
    problem = Problem(model, arcs, many, params, bounds=bounds, priors=priors, loss=loss)
    if not isinstance(shooting, SingleShooting | MultipleShooting):
        raise TypeError(
            f"shooting must be a dvi.SingleShooting() or a dvi.MultipleShooting(n): {shooting!r}."
        )
    solver = _solver(optimiser, problem)
    is_optax = isinstance(solver, optx.OptaxMinimiser)
    is_vector = isinstance(solver, optx.AbstractGaussNewton)
    if not is_optax:
        problem.check_count()
    if max_steps is None:
        max_steps = 2000 if is_optax else 200
    _check_options(max_steps, tolerance, batch, is_optax)
    if isinstance(shooting, MultipleShooting) and not is_vector:
        raise ValueError("multiple shooting goes with least squares and their solvers alone.")
    wanted = _horizons(horizons)
    u = problem.space.to_u(problem.space.start)
    name = _identity(problem, u, solver, shooting, wanted, batch, seed, tolerance, max_steps)
    with shown(progress) as show:
        run = _Run(problem, max_steps, tolerance, show, began, checkpoint, name)
        if isinstance(shooting, MultipleShooting):
            found = _in_segments(run, Segments(problem, shooting), u, solver)
        elif is_vector:
            found = _least_squares(run, u, solver, wanted, check_units)
        else:
            found = _by_gradient(run, u, solver, wanted, batch, seed, check_units)
    u, known, status, aux = found
    found = _result(run, u, known, status, aux, check_curvature)
    if checkpoint is not None:
        Path(checkpoint).unlink(missing_ok=True)
    if not throw or bool((status == FIT_RESULTS.converged) | (status == FIT_RESULTS.steps_done)):
        return found
    raise FitError(
        f"the fit did not converge ({found.status} after {len(run.records)} steps, loss "
        f"{found.loss:.6g}). {FIT_RESULTS[status]} With throw=False what was found is returned "
        "with its status; here it is the `fit` attribute of this error.",
        found,
    )


class _Run:
    """What is common to all stages of a fit: the steps that are left, the history, its file."""

    def __init__(self, problem: Problem, max_steps, tolerance, show, began, checkpoint, identity):
        self.problem, self.max_steps, self.tolerance = problem, max_steps, tolerance
        self._show, self.began, self._file, self._identity = show, began, checkpoint, identity
        self.records: list[Record] = []
        self.resume: Position | None = None
        self._saved = time.monotonic()
        if checkpoint is not None and Path(checkpoint).exists():
            self.resume, self.records = _read_checkpoint(checkpoint, identity)

    @property
    def left(self) -> int:
        """How many steps may still be taken."""
        return self.max_steps - len(self.records)

    def take_resume(self) -> Position | None:
        """The position to go on from, once."""
        found, self.resume = self.resume, None
        return found

    def watch(self, record: Record, position: Position) -> None:
        """A step was taken."""
        x = np.asarray(self.problem.space.to_x(jnp.asarray(record.x[: self.problem.size])))
        record.x = x
        self.records.append(record)
        if self._file is not None and time.monotonic() - self._saved > _EVERY:
            _write_checkpoint(self._file, self._identity, position, self.records)
            self._saved = time.monotonic()
        if self._show is not None:
            self._show(
                FitProgress(
                    len(self.records), self.max_steps, record.stage, record.horizon, record.loss,
                    x, self.problem.space.names, time.monotonic() - self.began,
                )
            )  # fmt: skip


def _solver(optimiser: Any, problem: Problem) -> Any:
    """The optimistix solver that is meant."""
    residuals = isinstance(problem.loss, Loss)
    if optimiser is None:
        if problem.size > _MANY:
            optimiser = optax.adam(optax.warmup_cosine_decay_schedule(1e-5, 3e-3, 100, 2000, 1e-5))
        elif residuals:
            return optx.LevenbergMarquardt(rtol=1e-14, atol=1e-300)
        else:
            return optx.BFGS(rtol=1e-10, atol=1e-10)
    if isinstance(optimiser, optax.GradientTransformation):
        return optx.OptaxMinimiser(optimiser, rtol=0.0, atol=0.0)
    if isinstance(optimiser, optx.AbstractGaussNewton):
        if not residuals:
            raise ValueError(
                "dvi.Likelihood has no residual vector: take a minimiser such as "
                "optimistix.BFGS(rtol=1e-10, atol=1e-10), or leave optimiser out."
            )
        return optimiser
    if isinstance(optimiser, optx.AbstractMinimiser):
        return optimiser
    raise TypeError(
        "optimiser must be None, a least-squares solver or minimiser of optimistix, or a gradient "
        f"transformation of optax, got {optimiser!r}."
    )


def _check_options(max_steps: Any, tolerance: Any, batch: Any, is_optax: bool) -> None:
    if isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1:
        raise ValueError(f"max_steps must be a positive integer, got {max_steps!r}.")
    if not (isinstance(tolerance, int | float) and 0 < tolerance < 1):
        raise ValueError(f"tolerance must lie between 0 and 1, got {tolerance!r}.")
    if batch is None:
        return
    if not is_optax:
        raise ValueError("batch goes with a stochastic optimiser: optimiser=optax.adam(1e-3), say.")
    if isinstance(batch, bool) or not isinstance(batch, int) or batch < 1:
        raise ValueError(f"batch must be a positive integer, got {batch!r}.")


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


def _least_squares(run: _Run, u: np.ndarray, solver: Any, wanted: Any, check_units: bool):
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
            u, horizon, stage=number, max_steps=_steps(run, is_last, resume),
            tolerance=run.tolerance if is_last else max(1e-2, run.tolerance),
            degrees=problem.degrees_of_freedom, resume=resume, watch=run.watch,
            first=None if whole is None else _up_to(problem, whole, horizon),
        )  # fmt: skip
        resume = None
        if is_last or status == FIT_RESULTS.not_finite or run.left <= 0:
            return u, (found.jacobian, None), status, found.aux if is_last else None
        number += 1
        whole = stage.at(u)
        horizon = _next(problem, wanted, number, whole.aux[0], 2 * horizon * (1 - 1e-9))


def _steps(run: _Run, is_last: bool, resume: Position | None) -> int:
    """How many steps a stage may take, those before it was resumed included."""
    done = 0 if resume is None else resume.done
    return done + run.left if is_last else min(max(_BEFORE_LAST, done), done + run.left)


def _next(problem: Problem, wanted: Any, number: int, rows: list[Array], at_least: float) -> float:
    if wanted is not None:
        return wanted[min(number, len(wanted) - 1)]
    return suitable_horizon(problem, [np.asarray(r) for r in rows], at_least)


def _up_to(problem: Problem, whole: Evaluation, horizon: float) -> Evaluation:
    """What is known of a horizon from what is known of everything."""
    keep = problem.rows_within(horizon)
    r, J, aux = whole
    return Evaluation(jnp.where(keep, r, 0.0), jnp.where(keep[:, None], J, 0.0), aux)


def _by_gradient(run: _Run, u: np.ndarray, solver: Any, wanted, batch, seed: int, units: bool):
    """The same by a minimiser of the scalar loss."""
    problem = run.problem
    is_optax = isinstance(solver, optx.OptaxMinimiser)

    def value(u, horizon, choice):
        # Per value, so that a learning rate means the same for any amount of data.
        return problem.scalar(u, horizon, choice) / (problem.count if is_optax else 1)

    stage = ScalarStage(value, solver)
    look = eqx.filter_jit(problem.whitened)
    choose = None if batch is None else _draw(problem, batch, seed)
    resume = run.take_resume()
    if resume is None:
        rows, known = look(jnp.asarray(u))
        problem.check_start(known, units)
        number, horizon = 0, _next(problem, wanted, 0, rows, 0.0)
        scale = np.ones(problem.size) if is_optax else _lengths(problem, u)
    else:
        number, horizon, scale = resume.stage, resume.horizon, resume.scale
    while True:
        is_last = horizon == np.inf
        some = run.max_steps // 8 if is_optax else _BEFORE_LAST
        done = 0 if resume is None else resume.done
        u, status = stage.run(
            u, horizon, stage=number, tolerance=run.tolerance, scale=scale, choose=choose,
            max_steps=done + run.left if is_last else min(max(some, done), done + run.left),
            resume=resume, watch=run.watch,
        )  # fmt: skip
        resume = None
        rows, known = look(jnp.asarray(u))
        if is_last or status == FIT_RESULTS.not_finite or run.left <= 0:
            break
        number += 1
        horizon = _next(problem, wanted, number, rows, 2 * horizon * (1 - 1e-9))
    if problem.size > _MANY or status == FIT_RESULTS.not_finite:
        return u, None, status, (rows, known)
    if isinstance(problem.loss, Likelihood):
        return u, (_root_of_hessian(problem, u), None), status, (rows, known)
    return (
        u,
        (eqx.filter_jit(problem.evaluate)(jnp.asarray(u)).jacobian, None),
        status,
        (rows, known),
    )


def _lengths(problem: Problem, u: np.ndarray) -> np.ndarray:
    """Scales of u in which the residuals change alike."""
    J = np.asarray(eqx.filter_jit(problem.evaluate)(jnp.asarray(u)).jacobian)
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
    gradient = jax.grad(problem.scalar)
    H = np.asarray(jax.jit(jax.jacfwd(gradient))(jnp.asarray(u)))
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    return np.sqrt(np.where(values > 0, values, np.nan))[:, None] * vectors.T


def _in_segments(run: _Run, segments: Segments, u: np.ndarray, solver: Any):
    """Multiple shooting: Levenberg–Marquardt inside of an augmented Lagrangian."""
    problem, n, gaps = run.problem, run.problem.size, segments.num_gaps
    stage = LeastSquaresStage(segments.evaluate, solver)
    resume = run.take_resume()
    w, found = segments.begin(u), None
    if resume is None:
        number, multipliers, root = 0, np.zeros(gaps), 1.0
        r, _, c = stage.at(w, np.inf, (jnp.asarray(root), jnp.asarray(multipliers)))
        # Continuity weighs as much as the data to begin with.
        misfit, size = float(np.linalg.norm(r[: len(r) - gaps])), float(np.linalg.norm(c))
        root = max(misfit / max(size, 1e-12), np.sqrt(len(r)))
    else:
        number, (root, multipliers) = resume.stage, (float(resume.extra[0]), resume.extra[1])
    while True:
        done = 0 if resume is None else resume.done
        w, found, status = stage.run(
            w, np.inf, stage=number, max_steps=min(max(_IN_SEGMENTS, done), done + run.left),
            tolerance=run.tolerance, degrees=max(problem.degrees_of_freedom, 1),
            extra=(jnp.asarray(root), jnp.asarray(multipliers)), resume=resume, watch=run.watch,
        )  # fmt: skip
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
    return w[:n], (data, free), status, None


def _result(
    run: _Run, u: np.ndarray, known: Any, status: FIT_RESULTS, aux: Any, curvature: bool
) -> FitResult:
    """What is known of the parameters u.

    - `known`: Jacobian, and a basis of what constraints leave free, or None for both. `aux`:
      whitened residuals and predictions at u, if they are known.
    """
    problem, space, n = run.problem, run.problem.space, run.problem.size
    rows, found = eqx.filter_jit(problem.whitened)(jnp.asarray(u)) if aux is None else aux
    x = np.asarray(space.to_x(jnp.asarray(u)))
    if isinstance(problem.loss, Loss):
        loss = float(np.sum(np.asarray(problem.root_rows(jnp.asarray(u), rows)) ** 2) / 2)
    else:
        loss = float(run.records[-1].loss) if run.records else np.nan
    degrees = problem.degrees_of_freedom
    if problem.has_errors or not isinstance(problem.loss, Loss):
        variance = 1.0
    else:
        variance = 2 * loss / degrees if degrees > 0 else np.nan
    covariance, ratio = np.full((n, n), np.nan), None
    words: list[str] = []
    values = np.zeros(0)
    if known is not None and np.isfinite(known[0]).all():
        J = np.asarray(known[0])
        about = uncertainty(J, variance, known[1])
        slope, values = space.slope(u), about.singular_values
        covariance = about.covariance[:n, :n] * np.outer(slope, slope)
        words = [in_words(d[:n], space.names) for d in about.undetermined.T if np.any(d[:n])]
        if curvature and known[1] is None and isinstance(problem.loss, Loss) and n <= 50:
            ratio = _curvature(problem, u, J, about)
    predicted, whitened, trajectories = problem.by_arc(rows, found)
    return FitResult(
        params=space.to_params(jnp.asarray(x)), x=x, names=space.names, covariance=covariance,
        history=_history(run, n), result=status, ts=[a.ts for a in problem.arcs],
        observed=[a.values for a in problem.arcs], predicted=predicted, whitened=whitened,
        loss=loss, degrees_of_freedom=degrees, num_observed=problem.count,
        has_errors=problem.has_errors, undetermined=words, singular_values=values,
        curvature=ratio, at_bounds=space.at_bounds(x), trajectories=trajectories,
        seconds=time.monotonic() - run.began,
    )  # fmt: skip


def _curvature(problem: Problem, u: np.ndarray, J: np.ndarray, about: Uncertainty) -> np.ndarray:
    """Exact second derivative of the loss along each principal direction over Gauss–Newton's."""
    D = about.directions[:, : about.directions.shape[1] - about.undetermined.shape[1]]
    if D.shape[1] == 0:
        return np.zeros(0)

    def second(u, d):
        def loss(t):
            r = problem.residuals(u + t * d)
            return r @ r / 2

        def slope(t):
            return jax.jvp(loss, (t,), (1.0,))[1]

        return jax.jvp(slope, (0.0,), (1.0,))[1]

    exact = jax.jit(jax.vmap(second, in_axes=(None, 0)))(jnp.asarray(u), jnp.asarray(D.T))
    return np.asarray(exact) / np.sum((J @ D) ** 2, axis=0)


def _history(run: _Run, size: int) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {
        name: np.array([getattr(r, name) for r in run.records])
        for name in ("stage", "horizon", "loss", "step", "accepted")
    }
    found["x"] = np.array([r.x for r in run.records]).reshape(-1, size)
    return found


def _identity(problem: Problem, u: np.ndarray, *of: Any) -> str:
    """What a checkpoint is known by: data, names, start and settings."""
    digest = hashlib.sha256(repr((problem.space.names, *of)).encode())
    digest.update(np.ascontiguousarray(u).tobytes())
    for group in problem.groups:
        for array in (group.ts, group.values, group.seen, group.whiten, group.t0):
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(repr((group.num_steps, group.block)).encode())
    return digest.hexdigest()


def _write_checkpoint(path: Any, identity: str, at: Position, records: list[Record]) -> None:
    arrays = {"base": at.base, "scale": at.scale, "z": at.z}
    arrays |= {f"leaf.{i}": x for i, x in enumerate(at.leaves)}
    arrays |= {f"extra.{i}": np.asarray(x) for i, x in enumerate(at.extra)}
    for name in ("stage", "horizon", "loss", "step", "accepted", "x"):
        arrays[f"record.{name}"] = np.array([getattr(r, name) for r in records])
    about = {
        "format": 1, "identity": identity, "stage": at.stage, "horizon": at.horizon,
        "done": at.done, "leaves": len(at.leaves), "extra": len(at.extra),
    }  # fmt: skip
    write_npz(path, about, arrays)


def _read_checkpoint(path: Any, identity: str) -> tuple[Position, list[Record]]:
    about, arrays = read_npz(path, "checkpoint of a fit")
    if about.get("identity") != identity:
        raise ValueError(
            f"the checkpoint {path} is of another fit (data, parameters, their start or settings "
            "differ). Give another file, or remove this one to begin anew."
        )
    position = Position(
        about["stage"], about["horizon"], about["done"], arrays["base"], arrays["scale"],
        arrays["z"], [arrays[f"leaf.{i}"] for i in range(about["leaves"])],
        [arrays[f"extra.{i}"] for i in range(about["extra"])],
    )  # fmt: skip
    columns = [arrays[f"record.{n}"] for n in ("stage", "horizon", "loss", "step", "accepted", "x")]
    records = [
        Record(int(s), float(h), float(value), float(step), bool(a), x)
        for s, h, value, step, a, x in zip(*columns, strict=True)
    ]
    return position, records
