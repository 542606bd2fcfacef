"""One stage of a fit: an optimiser driven step by step, so that it can be watched and resumed."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .results import FIT_RESULTS
from .solvers import goes_by_optax

_STIFFNESS = 30.0
"""Length of the columns of the scaled Jacobian. Optimistix damps with 1 to begin with, so that
this is Marquardt's 1e-3 of the squared columns."""

_HOPELESS = 12
"""Rejected steps in a row after which no step is expected to help."""

_HOPELESS_LINE = 40
"""The same for a line search that halves: it has no scale to begin with."""

_FLAT = 1e-3
"""Standard errors that an undamped step is worth, below which a loss that no longer falls is a
minimum, known to its rounding."""


@dataclass
class Record:
    """One step of an optimiser: of which `stage`, the `loss` (½ Σ r², or the scalar) of the
    accepted point `x`, the `step` to the next trial in standard errors, whether it was accepted."""

    stage: int
    horizon: float
    loss: float
    step: float
    accepted: bool
    x: np.ndarray


@dataclass
class Position:
    """Where a stage stands: all that is needed to go on with the same bits. `memory` is of how the
    last steps went; `status` is that of a stage that has ended, else empty."""

    stage: int
    horizon: float
    done: int
    base: np.ndarray
    scale: np.ndarray
    z: np.ndarray
    leaves: list[np.ndarray] = field(default_factory=list)
    extra: list[np.ndarray] = field(default_factory=list)
    memory: tuple[float, ...] = ()
    status: str = ""


class _Known(eqx.Module):
    """Inputs of a compiled step of the scalar loss: where z is counted from and in what."""

    base: Array
    scale: Array
    horizon: Array
    extra: Any = None


class Evaluation(NamedTuple):
    """Residual vector (R,), its derivative (R, n), and what else was found on the way."""

    residual: Array
    jacobian: Array
    aux: Any = None


@eqx.filter_custom_jvp
def _residual(z, known):
    return known[0]


@_residual.def_jvp
def _(primals, tangents):
    residual, jacobian = primals[1]
    return residual, jacobian @ tangents[0]


def _function(z, known):
    """The residual of optimistix where it asks for it: known there, with its derivative."""
    return _residual(z, known), None


def _begin(solver: Any, rows: int, size: int) -> Any:
    """The state of a solver before its first step; one object, so that a step is compiled once."""
    try:
        return _kept(solver, rows, size)
    except TypeError:  # a solver that holds arrays has no hash
        return _state(solver, rows, size)


def _state(solver: Any, rows: int, size: int) -> Any:
    z, known = jnp.zeros(size), (jnp.zeros(rows), jnp.zeros((rows, size)))
    shape = jax.ShapeDtypeStruct((rows,), known[0].dtype)
    return solver.init(_function, z, known, {}, shape, None, frozenset())


_kept = functools.lru_cache(maxsize=64)(_state)


@eqx.filter_jit
def _advance(solver: Any, z: Array, known: tuple[Array, Array], state: Any) -> tuple[Array, Any]:
    z, state, _ = solver.step(_function, z, known, {}, state, frozenset())
    return z, state


class LeastSquaresStage:
    """Gauss–Newton with damping on the residual vector, in scaled variables.

        u = base + scale z,    the columns of dr/dz have one length at z = 0

    A solver of optimistix asks for the residual once a step, at a point that its state tells
    beforehand. So the one large program, that of residual and Jacobian, is called here, and the
    solver's step is a small one.

    - `evaluate`: compiled function ``(u, horizon, extra)`` → `Evaluation`.
    - `solver`: one of optimistix's Gauss–Newton family.
    """

    def __init__(self, evaluate: Callable[..., Evaluation], solver: Any):
        self.evaluate, self._solver = evaluate, solver

    def at(self, u: np.ndarray, horizon: float = np.inf, extra: Any = None) -> Evaluation:
        """Residual, Jacobian and the rest at u."""
        return self.evaluate(jnp.asarray(u), jnp.asarray(horizon), extra)

    def run(
        self,
        u: np.ndarray,
        horizon: float,
        *,
        stage: int,
        max_steps: int,
        tolerance: float,
        degrees: int,
        first: Evaluation | None = None,
        extra: Any = None,
        resume: Position | None = None,
        watch: Callable[[Record, Position], None],
    ) -> tuple[np.ndarray, Evaluation, FIT_RESULTS]:
        """u at the minimum, what was found there, and the status.

        - `first`: what is known at u already; `degrees` of freedom; `extra` for `evaluate`.

        Ends when the step to the next trial moves what is predicted by less than `tolerance`
        standard errors, the size of which is found from the residuals; or when three steps in a
        row make Σ r² smaller by less than its square.
        """
        if resume is None:
            best = self.at(u, horizon, extra) if first is None else first
            square = best.residual @ best.residual
            if not (np.isfinite(square) and np.isfinite(best.jacobian).all()):
                return u, best, FIT_RESULTS.not_finite
            length = np.linalg.norm(np.asarray(best.jacobian), axis=0)
            scale = np.where(length > 0, _STIFFNESS / np.where(length > 0, length, 1.0), 1.0)
            at = Position(stage, horizon, 0, np.asarray(u), scale, np.zeros(len(u)))
            at.memory = (0, np.inf, 0)
            state, trial = _begin(self._solver, *best.jacobian.shape), best
        else:
            at, u = resume, resume.base + resume.scale * resume.z
            best, trial = self.at(u, horizon, extra), None
            state = _with_leaves(_begin(self._solver, *best.jacobian.shape), at.leaves)
            _check_same(best.residual, state.f_info.residual)
        base, scale, done, z, status = at.base, at.scale, at.done, jnp.asarray(at.z), at.status
        rejected, last, still = at.memory
        while not status and done < max_steps:
            if trial is None:
                trial = self.at(base + scale * np.asarray(state.y_eval), horizon, extra)
            known = trial.residual, trial.jacobian * scale[None]
            z, state = _advance(self._solver, z, known, state)
            done += 1
            accepted = int(state.num_steps_since_acceptance) == 0
            best, rejected = (trial, 0) if accepted else (best, rejected + 1)
            trial = None
            residual = np.asarray(best.residual)
            loss = float(residual @ residual) / 2
            spread = np.sqrt(2 * loss / max(degrees, 1))
            moved = float(np.linalg.norm(np.asarray(best.jacobian) @ (scale * (state.y_eval - z))))
            u = base + scale * np.asarray(z)
            floor = 1e-13 * _STIFFNESS * float(np.linalg.norm(u / scale))
            least = max(tolerance * spread, floor)
            if accepted:  # at a bound the free variable goes on for ever, and nothing changes
                still = still + 1 if last - loss <= (tolerance * spread) ** 2 else 0
                last = loss
            ended = still >= 3 or (moved <= least and rejected < 3)
            if not np.isfinite(moved):
                status = "stalled"
            elif ended and _undamped(best, scale) <= least:
                # A damped step is small for its damping as well.
                status = "converged"
            elif rejected >= _HOPELESS or (rejected >= 3 and moved <= least):
                flat = _undamped(best, scale) <= max(_FLAT * spread, least)
                status = "converged" if flat else "stalled"
            at = replace(at, done=done, z=np.asarray(z), status=status)
            at.leaves, at.extra, at.memory = _leaves(state), _leaves(extra), (rejected, last, still)
            in_sigma = moved / spread if spread else 0.0
            watch(Record(stage, horizon, loss, in_sigma, accepted, u), at)
        return u, best, getattr(FIT_RESULTS, status or "max_steps_reached")


def _scalar_function(core: Any, per: float) -> Callable[..., Any]:
    """The scalar loss over `per` as optimistix wants it, a function of z and where it is counted
    from; its derivative by reverse mode, whatever the solver takes: memory flat in the number of
    steps."""

    def value(z, known):
        return core.scalar(known.base + known.scale * z, known.horizon, known.extra) / per

    @eqx.filter_custom_jvp
    def function(z, known):
        return value(z, known)

    @function.def_jvp
    def _(primals, tangents):
        loss, slope = jax.value_and_grad(value)(*primals)
        return loss, slope @ tangents[0]

    return lambda z, known: (function(z, known), None)


@eqx.filter_jit
def _descend(
    solver: Any, core: Any, per: float, z: Array, known: _Known, state: Any
) -> tuple[Array, Any, Array]:
    function = _scalar_function(core, per)
    new, state, _ = solver.step(function, z, known, {}, state, frozenset())
    ended, _ = solver.terminate(function, new, known, {}, state, frozenset())
    return new, state, ended


class ScalarStage:
    """A minimiser of optimistix, or one of optax, on the scalar loss, in u = base + scale z.

    - `core`: has ``scalar(u, horizon, choice)``, the loss. `per`: what it is divided by.
    """

    def __init__(self, core: Any, per: float, solver: Any):
        self.core, self.per, self.solver = core, per, solver

    def run(
        self,
        u: np.ndarray,
        horizon: float,
        *,
        stage: int,
        max_steps: int,
        tolerance: float,
        scale: np.ndarray,
        choose: Callable[[int], Any] | None = None,
        resume: Position | None = None,
        watch: Callable[[Record, Position], None],
    ) -> tuple[np.ndarray, FIT_RESULTS]:
        """u at the end, and the status.

        With `choose`, a function of the number of the step → arcs, it ends after `max_steps`;
        else when the loss of a step changed by less than tolerance² (in −log likelihood), three
        times running.
        """
        begin = Position(stage, horizon, 0, u, scale, np.zeros(len(u)), memory=(np.inf, 0, 0))
        at = begin if resume is None else resume
        base, size, z = (jnp.asarray(x) for x in (at.base, at.scale, at.z))
        done = at.done

        def known(step):
            return _Known(base, size, jnp.asarray(horizon), choose and choose(step))

        struct = jax.ShapeDtypeStruct((), jnp.result_type(float))
        function = _scalar_function(self.core, self.per)
        zero = jnp.zeros(len(u))
        state = self.solver.init(function, zero, known(0), {}, struct, None, frozenset())
        if not (hasattr(state, "f") or hasattr(state, "f_info")):
            raise TypeError(f"{type(self.solver).__name__} does not tell the loss of its steps.")
        if resume is not None:
            state = _with_leaves(state, resume.leaves)
        is_optax = goes_by_optax(self.solver)
        (last, still, rejected), status = at.memory, at.status
        while not status and done < max_steps:
            old = z
            z, state, ended = _descend(self.solver, self.core, self.per, z, known(done), state)
            done += 1
            loss = float(state.f if is_optax else state.f_info.f)
            if not np.isfinite(loss) and done == 1:
                return u, FIT_RESULTS.not_finite
            x, moved = np.asarray(base + size * z), float(np.linalg.norm(z - old))
            if not np.isfinite(x).all():
                return np.asarray(base + size * old), FIT_RESULTS.not_finite
            if choose is None and not is_optax:
                rejected = 0 if moved > 0 else rejected + 1
                if moved > 0:
                    still = still + 1 if abs(last - loss) <= tolerance**2 else 0
                    last = loss
                if bool(ended) or still >= 3:
                    status = "converged"
                elif rejected >= _HOPELESS_LINE:
                    status = "stalled"
            at = replace(at, done=done, z=np.asarray(z), status=status)
            at.leaves, at.memory = _leaves(state), (last, still, rejected)
            watch(Record(stage, horizon, loss * self.per, moved, bool(moved > 0), x), at)
        usual = "steps_done" if is_optax else "max_steps_reached"
        return np.asarray(base + size * z), getattr(FIT_RESULTS, status or usual)


def _undamped(at: Evaluation, scale: np.ndarray) -> float:
    """What the undamped step would move what is predicted by, in standard errors; parameters that
    have all but lost their effect (at a bound) left out."""
    J = np.asarray(at.jacobian) * scale
    length = np.linalg.norm(J, axis=0)
    J = J[:, length > 1e-3 * _STIFFNESS]
    if not J.shape[1]:
        return 0.0
    U, s, _ = np.linalg.svd(J / np.linalg.norm(J, axis=0), full_matrices=False)
    return float(np.linalg.norm(U[:, s > 1e-7 * s[0]].T @ np.asarray(at.residual)))


def _check_same(now: Array, then: Array) -> None:
    """Refuse a checkpoint whose residuals are not those of this model."""
    if not np.allclose(now, then, rtol=1e-6, atol=1e-6 * float(np.abs(then).max(initial=0.0))):
        raise ValueError(
            "the checkpoint is of another model: at its parameters this one predicts other values. "
            "Give another file, or remove it to begin anew."
        )


def _leaves(state: Any) -> list[np.ndarray]:
    """The numbers in it."""
    return [np.asarray(x) for x in jax.tree.leaves(eqx.filter(state, eqx.is_array))]


def _with_leaves(state: Any, leaves: list[np.ndarray]) -> Any:
    """The same state with other numbers."""
    arrays, rest = eqx.partition(state, eqx.is_array)
    old, tree = jax.tree.flatten(arrays)
    shapes = [np.shape(x) for x in old]
    if shapes != [np.shape(x) for x in leaves]:
        raise ValueError("the checkpoint is of another fit: its optimiser has another state.")
    new = [jnp.asarray(x, o.dtype) for x, o in zip(leaves, old, strict=True)]
    return eqx.combine(jax.tree.unflatten(tree, new), rest)
