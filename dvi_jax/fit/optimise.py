"""One stage of a fit and its status: an optimiser run step by step, watched and resumed."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .checks import same_fit
from .roundoff import STIFFNESS, Evaluation, settle, undamped_step
from .solvers import is_optax
from .uncertainty import inverse_or

_REJECTIONS = 12  # Rejected steps in a row after which no further step is expected to help
# Length of an undamped step in standard errors up to which a third of them are enough.
_SHORT_STEP = 1.0
# Relative change of u that makes as little difference as round-off of the predictions may make.
# Where an undamped step is not larger, one rejected step is enough.
_SMALL = 1e-13
_REJECTED_ON_LINE = 40  # The same for a line search, which halves from an unknown scale
# Length of an undamped step in standard errors below which a loss that no longer decreases is at
# its minimum, up to rounding.
_FLAT = 1e-3


class FIT_RESULTS(eqx.Enumeration):
    """Status of a fit; ``dvi.FIT_RESULTS[fit.result]`` is the text."""

    converged = ""
    steps_done = "The given number of steps was taken; a stochastic optimiser has no other end."
    max_steps_reached = (
        "The optimiser did not converge within max_steps. Likely causes: (a) it needs more steps; "
        "(b) the data do not determine a direction of the parameters: see the singular values of "
        "the result; (c) the start is far away: give a better one, or shorter horizons."
    )
    stalled = (
        "No step along the descent makes the loss smaller, though its gradient is not zero. Likely "
        "causes: (a) the loss is not smooth at this scale: an implicit solve with a loose "
        "tolerance, a trajectory that is chaotic over the arc (take dvi.MultipleShooting(...)); "
        "(b) a trajectory that fails for nearby parameters."
    )
    not_finite = (
        "The residuals, the sum of their squares or their derivatives are not finite. Likely "
        "causes: (a) a trajectory fails at these parameters; (b) a function of the model has no "
        "derivative there; (c) predictions are larger than the standard errors by more than "
        "10¹⁵⁰: the trajectory diverges, or sigma is in other units."
    )
    discontinuous = (
        "The segments of multiple shooting do not meet within the tolerance. Likely causes: (a) "
        "too few steps; (b) segments that are too long for a chaotic trajectory: take more."
    )


NAMES = ("converged", "steps_done", "max_steps_reached", "stalled", "not_finite", "discontinuous")


def name_of(result: FIT_RESULTS) -> str:
    """The short name of a status."""
    return next(name for name in NAMES if bool(result == getattr(FIT_RESULTS, name)))


class FitError(RuntimeError):
    """Raised by `fit` with ``throw=True`` when it did not converge; `fit` is the `FitResult`."""

    def __init__(self, message: str, fit: object = None):
        super().__init__(message)
        self.fit = fit


class Record(NamedTuple):
    """One step of an optimiser: its `stage`, the `loss` (½ Σ r², or the scalar) of the accepted
    point `x`, the `step` to the next trial in standard errors, and whether it was accepted."""

    stage: int
    horizon: float
    loss: float
    step: float
    accepted: bool
    x: np.ndarray


@dataclass
class Position:
    """State of a stage after `done` steps: all that is needed to continue with the same bits.

    - `base`, `scale`, `z`: u = base + scale z. `leaves`: numbers of the optimiser's state; `extra`:
      those of what is minimised. `rejected`, `last`, `still`: rejected steps in a row, the last
      loss, and steps in a row that hardly changed it. `status`: of a stage that has ended.
    """

    stage: int
    horizon: float
    done: int
    base: np.ndarray
    scale: np.ndarray
    z: np.ndarray
    leaves: list[np.ndarray] = field(default_factory=list)
    extra: list[np.ndarray] = field(default_factory=list)
    rejected: int = 0
    last: float = np.inf
    still: int = 0
    status: str = ""

    @property
    def u(self) -> np.ndarray:
        """The free variables."""
        return self.base + self.scale * self.z

    @property
    def reach(self) -> float:
        """Change of the predictions by one of u of its own size."""
        return STIFFNESS * float(np.linalg.norm(self.u / self.scale))


@dataclass(frozen=True)
class StageTask:
    """One stage: its number and horizon, when it ends, and who watches its steps. `max_steps`:
    those before it was resumed included; `resume`: the position to continue from."""

    stage: int
    horizon: float
    max_steps: int
    tolerance: float
    watch: Callable[[Record, Position], None] = lambda *_: None
    resume: Position | None = None

    def begin(self, u: np.ndarray, scale: np.ndarray) -> Position:
        """The position to continue from, or that before the first step."""
        new = Position(self.stage, self.horizon, 0, np.asarray(u), scale, np.zeros(len(u)))
        return self.resume or new


# Optimistix differentiates the residual function itself. Here it gets a function whose value and
# derivative are inputs, so that the one large program, that of both, is called outside of its step.
# (A derivative rule of its own would be lost in second derivatives.)
def _residual(z: Array, linearisation: tuple[Array, Array]) -> Array:
    residual, jacobian = linearisation
    return residual + jacobian @ (z - lax.stop_gradient(z))


def _function(z, linearisation):
    return _residual(z, linearisation), None


def _begin(solver: Any, rows: int, size: int) -> Any:
    """The state of a solver before its first step."""
    try:
        return _cached_state(solver, rows, size)
    except TypeError:  # a solver that holds arrays has no hash
        return _state(solver, rows, size)


def _state(solver: Any, rows: int, size: int) -> Any:
    z, linearisation = jnp.zeros(size), (jnp.zeros(rows), jnp.zeros((rows, size)))
    shape = jax.ShapeDtypeStruct((rows,), linearisation[0].dtype)
    return solver.init(_function, z, linearisation, {}, shape, None, frozenset())


# One object for each solver and shape: a state holds functions, and another one would make the
# step compile again.
_cached_state = functools.lru_cache(maxsize=64)(_state)


@eqx.filter_jit
def _advance(solver: Any, z: Array, linearisation: tuple[Any, Any], state: Any):
    z, state, _ = solver.step(_function, z, linearisation, {}, state, frozenset())
    return z, state


class LeastSquaresStage:
    """Damped Gauss–Newton on the residual vector, in scaled variables.

        u = base + scale z,    the columns of dr/dz have one length at z = 0

    A solver of optimistix needs the residual once in a step, at a point that its state gives
    beforehand: it is computed here, and the solver's own step is a small program.

    - `evaluate`: compiled function ``(u, horizon, extra)`` → `Evaluation`.
    - `solver`: one of optimistix's Gauss–Newton family.
    - `shifts`: changes of u by round-off that the last run has measured, see `roundoff.End`.
    """

    def __init__(self, evaluate: Callable[..., Evaluation], solver: Any):
        self.evaluate, self._solver = evaluate, solver
        self.shifts: np.ndarray | None = None

    def values_at(self, u: np.ndarray, horizon: float = np.inf, extra: Any = None) -> Evaluation:
        """Residual, Jacobian and the rest at u."""
        return self.evaluate(jnp.asarray(u), jnp.asarray(horizon), extra)

    def run(
        self, u: np.ndarray, task: StageTask, degrees: int, first: Any = None, extra: Any = None
    ) -> tuple[np.ndarray, Evaluation, FIT_RESULTS]:
        """u at the minimum, the evaluation there, and the status.

        - `degrees` of freedom. `first`: the evaluation at u if it is known. `extra`: for
          `evaluate`.

        Ends when the step to the next trial moves the predictions by less than `tolerance`
        standard errors, whose size is estimated from the residuals; or when three steps in a row
        decrease Σ r² by less than the square of that. Where steps are rejected again and again,
        `settle` distinguishes a minimum up to round-off from a fit that is stuck.
        """
        horizon, tolerance, self.shifts = task.horizon, task.tolerance, None
        u = u if task.resume is None else task.resume.u
        best = self.values_at(u, horizon, extra) if first is None else first
        trial, state = best, _begin(self._solver, *best.jacobian.shape)
        if task.resume is None:
            square = np.sum(np.square(best.residual))
            if not (np.isfinite(square) and np.isfinite(best.jacobian).all()):
                return u, best, FIT_RESULTS.not_finite
        else:
            trial, state = None, _with_leaves(state, task.resume.leaves)
            _check_same(best.residual, state.f_info.residual)
        length = np.linalg.norm(np.asarray(best.jacobian), axis=0)
        position = task.begin(u, inverse_or(length, 1.0, STIFFNESS))
        base, scale, z = position.base, position.scale, jnp.asarray(position.z)
        while not position.status and position.done < task.max_steps:
            if trial is None:
                trial = self.values_at(base + scale * np.asarray(state.y_eval), horizon, extra)
            linearisation = trial.residual, np.asarray(trial.jacobian) * scale
            z, state = _advance(self._solver, z, linearisation, state)
            has_moved = int(state.num_steps_since_acceptance) == 0
            best, position.rejected = (trial, 0) if has_moved else (best, position.rejected + 1)
            trial = None
            residual = np.asarray(best.residual)
            loss = float(residual @ residual) / 2
            spread = np.sqrt(2 * loss / max(degrees, 1))
            displacement = scale * np.subtract(state.y_eval, z)
            change = float(np.linalg.norm(np.asarray(best.jacobian) @ displacement))
            position.done, position.z = position.done + 1, np.asarray(z)
            position.leaves, position.extra = _leaves(state), _leaves(extra)
            u = position.u
            threshold = tolerance * spread
            if has_moved:  # at a bound the free variable grows for ever, and nothing changes
                is_still = position.last - loss <= threshold**2
                position.still, position.last = position.still + 1 if is_still else 0, loss
            is_end = position.still >= 3 or (change <= threshold and position.rejected < 3)
            if not np.isfinite(change):
                position.status = "stalled"
            elif is_end and undamped_step(best, scale)[1] <= threshold:
                # A step may be small because of its damping: the undamped one decides.
                position.status = "converged"
            elif (
                position.rejected >= _REJECTIONS
                or (position.rejected >= 3 and change <= threshold)
                or (position.rejected and _is_near(position, undamped_step(best, scale)[1], spread))
            ):
                position.status = "stalled"
            in_sigma = change / spread if spread else 0.0
            task.watch(Record(task.stage, horizon, loss, in_sigma, has_moved, u), position)
        status = position.status or "max_steps_reached"
        if status == "stalled" and horizon == np.inf:  # of a part of the data it does not matter
            spread = float(np.linalg.norm(best.residual)) / np.sqrt(max(degrees, 1))
            flat, small = _FLAT * spread, _SMALL * position.reach
            end = settle(lambda u: self.values_at(u, horizon, extra), u, best, scale, flat, small)
            if end is not None:
                u, best, self.shifts = end
                status = "converged"
        return u, best, getattr(FIT_RESULTS, status)


def _is_near(position: Position, size: float, spread: float) -> bool:
    """Whether the undamped step is small enough for round-off to be why steps are rejected."""
    has_rejections = position.rejected >= _REJECTIONS // 3
    return size <= max(_SHORT_STEP * spread * has_rejections, _SMALL * position.reach)


def _scalar_function(core: Any, divisor: float) -> Callable[..., Any]:
    """The scalar loss over `divisor` for optimistix, a function of z and (base, scale, horizon,
    arcs). Its derivative is by reverse mode, whichever mode the solver uses: memory does not grow
    with the number of steps."""

    def value(z, setting):
        base, scale, horizon, choice = setting
        return core.scalar(base + scale * z, horizon, choice) / divisor

    function = eqx.filter_custom_jvp(value)

    @function.def_jvp
    def _(primals, tangents):
        loss, slope = jax.value_and_grad(value)(*primals)
        return loss, slope @ tangents[0]

    return lambda z, setting: (function(z, setting), None)


@eqx.filter_jit
def _descend(solver: Any, core: Any, divisor: float, z: Array, setting: tuple, state: Any):
    function = _scalar_function(core, divisor)
    new, state, _ = solver.step(function, z, setting, {}, state, frozenset())
    is_end, _ = solver.terminate(function, new, setting, {}, state, frozenset())
    return new, state, is_end


class ScalarStage:
    """A minimiser of optimistix or optax on the scalar loss ``core.scalar(u, horizon, choice)``
    over `divisor`, in u = base + scale z."""

    def __init__(self, core: Any, divisor: float, solver: Any):
        self.core, self.divisor, self.solver = core, divisor, solver

    def run(
        self, u: np.ndarray, task: StageTask, scale: np.ndarray, choose: Any = None
    ) -> tuple[np.ndarray, FIT_RESULTS]:
        """u at the end, and the status.

        With optax, or with `choose`, a function of the number of the step → arcs, it ends after
        `max_steps`; else when the loss (−log likelihood) changed by less than tolerance² in each
        of three steps.
        """
        position = task.begin(u, scale)
        base, size, z = (jnp.asarray(x) for x in (position.base, position.scale, position.z))

        def setting():
            return base, size, jnp.asarray(task.horizon), choose and choose(position.done)

        struct = jax.ShapeDtypeStruct((), jnp.result_type(float))
        function = _scalar_function(self.core, self.divisor)
        zero = jnp.zeros(len(u))
        state = self.solver.init(function, zero, setting(), {}, struct, None, frozenset())
        if not (hasattr(state, "f") or hasattr(state, "f_info")):
            raise TypeError(
                "the state of optimiser must have the loss as f or f_info, got optimiser="
                f"{type(self.solver).__name__}: use, for example, optimistix.BFGS(1e-10, 1e-10)."
            )
        if task.resume is not None:
            state = _with_leaves(state, position.leaves)
        fixed_steps = is_optax(self.solver)
        while not position.status and position.done < task.max_steps:
            old = z
            z, state, is_end = _descend(self.solver, self.core, self.divisor, z, setting(), state)
            position.done, position.z = position.done + 1, np.asarray(z)
            position.leaves = _leaves(state)
            loss = float(state.f if fixed_steps else state.f_info.f)
            if not np.isfinite(loss) and position.done == 1:
                return u, FIT_RESULTS.not_finite
            x, length = np.asarray(base + size * z), float(np.linalg.norm(z - old))
            if not np.isfinite(x).all():
                return np.asarray(base + size * old), FIT_RESULTS.not_finite
            if choose is None and not fixed_steps:
                position.rejected = 0 if length > 0 else position.rejected + 1
                if length > 0:
                    is_still = abs(position.last - loss) <= task.tolerance**2
                    position.still, position.last = position.still + 1 if is_still else 0, loss
                if bool(is_end) or position.still >= 3:
                    position.status = "converged"
                elif position.rejected >= _REJECTED_ON_LINE:
                    position.status = "stalled"
            step = loss * self.divisor, length, bool(length > 0), x
            task.watch(Record(task.stage, task.horizon, *step), position)
        usual = "steps_done" if fixed_steps else "max_steps_reached"
        return np.asarray(base + size * z), getattr(FIT_RESULTS, position.status or usual)


def _check_same(residual: Any, reference: Any) -> None:
    """Refuse a checkpoint whose residuals are not those of this model."""
    atol = 1e-6 * float(np.abs(reference).max(initial=0.0))
    difference = np.abs(np.subtract(residual, reference)).max(initial=0.0)
    fits = np.allclose(residual, reference, rtol=1e-6, atol=atol)
    same_fit(fits, f"models, whose residuals (by {difference:.3g}),")


def _leaves(state: Any) -> list[np.ndarray]:
    return [np.asarray(x) for x in jax.tree.leaves(eqx.filter(state, eqx.is_array))]


def _with_leaves(state: Any, leaves: list[np.ndarray]) -> Any:
    """The same state with other numbers."""
    arrays, functions = eqx.partition(state, eqx.is_array)
    old, tree = jax.tree.flatten(arrays)
    same_fit([*map(np.shape, old)] == [*map(np.shape, leaves)], "optimisers or their versions")
    new = [jnp.asarray(x, o.dtype) for x, o in zip(leaves, old, strict=True)]
    return eqx.combine(jax.tree.unflatten(tree, new), functions)
