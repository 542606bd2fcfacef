"""The front door: one trajectory."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree

import lanewise
from lanewise import Layout
from lanewise.jaxapi import batch_size, is_traced, manual_axes
from lanewise.primitive import generates

from ._adjoints import AbstractAdjoint, Outcome
from ._arithmetic import Arithmetic, FixedPoint
from ._dense import Curve, at_times, crossings, stopped
from ._extended import run_extended
from ._integrator import Integrator, chosen
from ._memory import results_memory
from ._precision import refuse_double_without_x64
from ._results import RESULTS, IntegrationError, status_code, status_name
from ._reversible import Reversible
from ._rollout import (
    Plan,
    StepTaken,
    Task,
    counted_scan,
    is_observable,
    make_plan,
    observed,
    reduce,
    run,
    start,
    with_start,
    with_tail,
)
from ._solution import Save, Solution
from ._step import Equations
from ._system import System, check_system
from ._types import Interval
from .engine.newton import RootSolver, over
from .engine.quantities import refuse_unit_or_mask
from .engine.reads import reads
from .engine.rounding import each
from .lattices import Lattice, TimeTransformed, Variational
from .methods import Method, TypeII, goes_backwards, warn_of_dissipation
from .observe import Deviations, Range, Reduction, RequestedTimes, Running, Section, Stop
from .observe._kept import Start

_STEP = "(t0, t1, q0, p0, q1, p1, args)"

_PIECES = 100
"""Pieces that a run with progress is cut into."""


def integrate(
    system: System,
    q0: Any,
    p0: Any,
    *,
    h: Any = None,
    num_steps: int | None = None,
    t0: Any = 0.0,
    epsilon: Any = 0.0,
    args: PyTree = None,
    method: Method | None = None,
    lattice: Lattice | None = None,
    save: Save = Save(),
    observe: PyTree = None,
    adjoint: AbstractAdjoint | None = None,
    newton: RootSolver | None = None,
    arithmetic: Arithmetic | None = None,
    layout: Layout | None = None,
    integrator: Integrator | None = None,
    stop: Stop | None = None,
    throw: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Solution:
    r"""One trajectory of a disturbed discrete Hamiltonian system.

    Iterates the map of `method`, by default (see `Integrator`) the paper's (12)–(13),

        q1 = q0 + h ∂H_D/∂p1,    p1 = p0 − h ∂H_D/∂q0 + h ε W(t0, t1, q0, p1).

    **Arguments**

    - `system`: a `System`.
    - `q0`, `p0`: start, real arrays of one shape (any: ``(n,)``, ``(bodies, 3)``).
    - `h`: step size [time], not 0; negative runs backwards. `num_steps`: how many; static.
    - `t0`: time of the start. `epsilon`: strength of the disturbance.
    - `args`: pytree handed to H_D, W and the observables.
    - `method`: `TypeII`, `Adjoint`, `Strang`, the compositions `Yoshida`, `Suzuki`, `BlanesMoan`,
      `McLachlan`, `KahanLi`, `Composition`; `GaussLegendre`, `LobattoIIIAIIIB`; `RungeKutta4`.
    - `lattice`: `Uniform()`; `Given(ts)`, which replaces h, num_steps and t0;
      `TimeTransformed(g)`, whose steps adapt, and h is in its fictitious time; or
      `Variational()`, whose steps solve (14), and h is the first of them.
    - `save`: which states are kept, see `Save`.
    - `observe`: pytree of observables, functions of one step
      ``(t0, t1, q0, p0, q1, p1, args)`` → array. Alone, one is evaluated on the steps that end at
      a save point; in `MaxDrift`, `Range`, `Trend`, `Mean`, `Last` it is reduced over every step
      in constant memory. A `Section` finds the crossings of a surface.
    - `layout`: how the arithmetic is laid out, see `Layout`.
    - `stop`: a `Stop`, where the run ends early (a collision, an escape); or None.
    - `adjoint`: how reverse-mode gradients go, see `Reversible`, `Checkpointed`, `Direct`.
    - `newton`: how implicit steps are solved: `PicardThenNewton`, `Newton`, `SimplifiedNewton`,
      `Picard`.
    - `arithmetic`: how the state is kept: `FloatingPoint`; for long runs `Compensated`, or
      `FixedPoint`, whose explicit steps go back bit for bit.
    - `integrator`: an `Integrator` in place of method, lattice, adjoint, newton, arithmetic and
      layout.
    - `throw`: raise if the trajectory fails; otherwise read ``solution.result``.
    - `progress`: called as ``progress(steps_done, num_steps)`` at save points, at most about a
      hundred times during the run, which then goes in pieces (same numbers, bit for bit). Not
      under jit, vmap or grad.

    h, t0, epsilon, args, q0, p0 and the times of `Given` are traced: they may be batched by
    `vmap` and differentiated by `grad` and `jvp`. The arithmetic is in the precision of q0, p0.

    **Returns** a `Solution`; time is the first axis of what it saved.

    **Raises** `ValueError` or `TypeError` for input that cannot be meant (shapes, types, values),
    and for results that need more memory than there is;
    `IntegrationError` when the trajectory fails and `throw` is True, with the status, the step
    and the residual (inside jit or vmap an equinox runtime error with the status).

    **Accuracy** order of the method in h. Symplectic methods keep the map's own invariants
    to round-off and energy to O(h^order) without drift. Gradients are those of the discrete
    map, by the implicit function theorem through each solve.

    **Example**

    ```python
    kepler = systems.kepler()                                # a library of systems brings its start
    sol = dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.1,
                        num_steps=1000, epsilon=0.01, method=dvi.Strang(), save=dvi.Save(every=10),
                        observe={"drift": dvi.MaxDrift(kepler.observables["energy"])})
    print(sol.status, sol.ts.shape, sol.qs.shape)
    # successful (101,) (101, 2)
    print(round(float(sol.observed["drift"]), 4))
    # 0.0633
    ```
    """
    check_system(system)
    integrator = chosen(
        integrator, method=method, lattice=lattice, adjoint=adjoint, root_finder=newton,
        arithmetic=arithmetic, layout=layout,
    )  # fmt: skip
    method, lattice, adjoint = integrator.method_for(system), integrator.lattice, integrator.adjoint
    newton, arithmetic, layout = integrator.root_finder, integrator.arithmetic, integrator.layout
    if not isinstance(save, Save):
        hint = " (is a pair of parentheses missing?)" if isinstance(save, type) else ""
        raise TypeError(f"save must be a Save, got {save!r}{hint}.")
    if not (stop is None or isinstance(stop, Stop)):
        raise TypeError(f"stop must be a dvi.Stop(g), got {stop!r}.")

    q0, p0 = start_state(q0, p0)
    t0, h, num_steps = lattice.prepare(t0, h, num_steps)
    t0 = as_scalar("t0", t0, q0.dtype)
    h = as_scalar("h", h, q0.dtype, zero_allowed=False)
    epsilon = as_scalar("epsilon", epsilon, q0.dtype)
    args = jax.tree.map(as_parameter, args)
    # By the class: a bound method of an equinox module takes 20 µs to make.
    System.check_shapes(system, t0, q0, p0, epsilon, args)
    if isinstance(lattice, TimeTransformed):
        return run_extended(
            integrate, system, lattice, q0, p0, t0, epsilon, args, observe, is_observable, h=h,
            num_steps=num_steps, method=method, save=save, adjoint=adjoint, newton=newton,
            arithmetic=arithmetic, layout=layout, stop=stop, throw=throw, progress=progress,
        )  # fmt: skip
    if isinstance(lattice, Variational) and not isinstance(method, TypeII):
        raise ValueError(
            f"the lattice Variational() goes with method=dvi.TypeII() only, got {method!r}: (14) "
            "is the variation of that map's action. For a higher order take an H_D of higher "
            "order, dvi.discretise(H, order=2)."
        )
    if isinstance(lattice, Variational) and isinstance(arithmetic, FixedPoint):
        raise ValueError(
            "the steps of Variational() are solved for, and a solve cannot be undone bit for bit: "
            "take arithmetic=dvi.Compensated(), or another lattice."
        )
    equations = Equations(system, epsilon, args, newton)
    is_disturbed = system.force is not None or system.perturbation is not None
    if not (is_disturbed or system.slow_time or is_traced(epsilon)) and float(epsilon) != 0:
        warnings.warn(
            f"epsilon = {float(epsilon):g} has no effect: the system has neither a force nor a "
            "perturbation.",
            stacklevel=2,
        )
    equations, q0, p0 = arithmetic.prepare(method, equations, Interval(t0, t0 + h, h), q0, p0)
    seen = reads(observe, stop, lattice)
    task = Task(equations, method, lattice, observe, t0, h, arithmetic, stop, seen)
    beside = _check_observe(task, q0, p0)
    plan = make_plan(save, num_steps)
    leaves = jax.tree.leaves((task, q0, p0))
    _check_memory(save, plan, q0, beside, leaves, layout)
    if save.ts is not None:
        task = eqx.tree_at(
            lambda task: task.observe, task, _with_times(save, task, num_steps),
            is_leaf=lambda x: x is None,
        )  # fmt: skip
    traced = any(is_traced(x) for x in leaves)
    if not traced and system.force is not None and goes_backwards(method):
        first = task.interval(jnp.asarray(0, jnp.int32))
        warn_of_dissipation(method, equations, first, q0, p0)
    if progress is None:
        solution = _whole(task, plan, observe, q0, p0, num_steps, adjoint, layout)
        return _raise_on_failure(solution, task) if throw else solution
    if traced:
        raise ValueError("progress cannot be reported under jit, vmap or grad: leave progress out.")
    if isinstance(adjoint, Reversible) and adjoint.report_defect:
        raise ValueError(
            "report_defect=True cannot be reported with progress: leave one of them out."
        )
    outcome = _in_pieces(task, plan, q0, p0, num_steps, progress, layout)
    solution = _solution(task, observe, outcome, q0, p0, num_steps, layout)
    return _raise_on_failure(solution, task) if throw else solution


@eqx.filter_jit
def _whole(
    task: Task, plan: Plan, observe: PyTree, q0, p0, num_steps: int, adjoint: AbstractAdjoint,
    layout: Layout,
) -> Solution:  # fmt: skip
    outcome = adjoint.rollout(task, plan, q0, p0, layout)
    return _as_solution(task, observe, outcome, q0, p0, num_steps, layout)


@eqx.filter_jit
def _begin(task: Task, q0, p0):
    return start(task, q0, p0)


@eqx.filter_jit
def _piece(task: Task, plan: Plan, carry, first, layout: Layout):
    arrays, rest = eqx.partition(task, eqx.is_array)

    def piece(arrays, carry, first):
        task = eqx.combine(arrays, rest)
        carry, saved, tail = run(task, plan, carry, counted_scan, first=first)
        return carry, with_tail(plan, saved, tail)

    return lanewise.call(piece, arrays, carry, first, layout=layout)


def _in_pieces(task: Task, plan: Plan, q0, p0, num_steps, progress, layout) -> Outcome:
    """The same scan as `_whole`, cut between save points, with a call after each piece."""
    blocks = max(1, -(-plan.num_blocks // _PIECES))
    carry, done, parts = _begin(task, q0, p0), 0, []
    while True:
        count = min(blocks, plan.num_blocks - done)
        is_last = done + count >= plan.num_blocks
        tail = (plan.tail, plan.save_tail) if is_last else (0, False)
        first = jnp.asarray(done * plan.block, jnp.int32)
        carry, saved = _piece(task, Plan(count, plan.block, *tail), carry, first, layout)
        jax.block_until_ready(carry)
        parts.append(saved)
        done += count
        progress(num_steps if is_last else done * plan.block, num_steps)
        if is_last:
            break
    saved = jax.tree.map(lambda *xs: jnp.concatenate(xs), *parts)
    return Outcome(carry, with_start(saved, q0, p0), reduce(task, carry))


def _with_times(save: Save, task: Task, num_steps: int) -> tuple[RequestedTimes, PyTree]:
    """What is observed along the run when states are saved at requested times: no observables that
    stand alone, which are evaluated at those times afterwards."""
    if task.has_running_values:
        raise ValueError(
            "Running tells a reduction at lattice points, and Save(ts=...) asks for other times: "
            "take save=dvi.Save(every=m)."
        )
    kept = jax.tree.map(
        lambda f: f if isinstance(f, Reduction) else None, task.observe, is_leaf=is_observable
    )
    ts = jnp.asarray(save.ts, task.t0.dtype)
    due = lax.stop_gradient(ts)
    if save.clock is None and not task.lattice.has_memory and num_steps > 0:
        eps = jnp.finfo(ts.dtype).eps
        end = task.interval(jnp.asarray(num_steps - 1, jnp.int32)).t1
        for known in (task.t0, end):  # N·(T/N) need not be T to the last digit
            size = jnp.maximum(jnp.abs(task.t0), jnp.abs(known))
            near = jnp.abs(ts - known) <= 16 * eps * size
            ts = jnp.where(near, ts + lax.stop_gradient(known - ts), ts)
        # Nor is t0 + k h, compiled in a loop, the same to the last digit as it is here.
        slack = 4 * eps * (jnp.abs(task.t0) + jnp.abs(ts))
        due = lax.stop_gradient(ts - jnp.where(end >= task.t0, slack, -slack))
    return RequestedTimes(ts=ts, due=due, ordered=jnp.sort(due), clock=save.clock), kept


def _as_solution(
    task: Task, observe: PyTree, outcome: Outcome, q0, p0, num_steps: int, layout: Layout
) -> Solution:
    """What a run has left behind, as its user sees it."""
    carry, saved, reduced, defect = outcome
    curve = Curve.of(task.method, task.equations, layout)
    first = task.interval(jnp.asarray(0, jnp.int32))
    safe = Start(first.t0, first.t1, first.t1, q0, p0)
    _, reductions = task.observables()
    values: list[Any] = [
        crossings(curve, r, value, safe) if isinstance(r, Section) else value
        for r, value in zip(reductions, reduced, strict=True)
    ]
    result = carry.result
    if reductions and isinstance(reductions[0], RequestedTimes):
        reached, starts, (ts, qs, ps) = at_times(curve, reductions[0], values[0], safe)
        if reductions[0].clock is None:
            ts = reductions[0].ts  # also those that were not reached
        missed = (result == RESULTS.successful) & ~jnp.all(reached)
        result = RESULTS.where(missed, RESULTS.not_reached, result)
        values, hs = values[1:], ts - starts.t0
        steps = StepTaken(starts.t0, ts, starts.q0, starts.p0, qs, ps)
        own, _ = dataclasses.replace(task, observe=observe).observables()
        alone = each(_observed, (own, task.args), steps, layout=layout)
    else:
        ts = jnp.concatenate([task.t0[None], saved.t])
        qs, ps, hs, alone = saved.q, saved.p, saved.h, saved.observed
    return Solution(
        ts=ts,
        qs=qs,
        ps=ps,
        hs=hs,
        observed=observed(observe, alone, values),
        result=result,
        stats={
            "num_steps": num_steps,
            "newton_iterations": carry.iterations,
            "max_residual": over(*carry.residual),
            "failed_step": carry.failed_step,
            "failed_residual": over(*carry.failed_residual),
            **task.lattice.report(carry.lattice),
            **({} if defect is None else {"round_trip_defect": defect}),
        },
        stop=None if task.stop is None else stopped(curve, task.stop, carry.stop, safe),
    )


def _observed(given: tuple[Any, Any], step: StepTaken) -> list[PyTree]:
    observables, args = given
    return [step.value(f, args) for f in observables]


_solution = eqx.filter_jit(_as_solution)


def _raise_on_failure(solution: Solution, task: Task) -> Solution:
    result = solution.result
    if is_traced(status_code(result)):
        fine = (result == RESULTS.successful) | (result == RESULTS.stopped)
        arrays, rest = eqx.partition(solution, eqx.is_array)
        if not manual_axes(*jax.tree.leaves(arrays)):
            return result.error_if(solution, ~fine)
        # In jax.shard_map the branches of error_if differ in type: form it for one device.
        checked = lanewise.call(
            lambda result, arrays, fine: result.error_if(arrays, ~fine),
            result, arrays, fine, layout=Layout(form="arrays"),
        )  # fmt: skip
        return eqx.combine(checked, rest)
    if status_name(result) in ("successful", "stopped"):
        return solution
    kept = "With throw=False the solution up to there is returned with its status; here it is the "
    kept += "`solution` attribute of this error."
    if bool(result == RESULTS.not_reached):
        missed = np.isnan(np.asarray(solution.qs)).reshape(len(solution.ts), -1).any(1)
        first = float(solution.ts[missed.argmax()])
        which = f", the first at t = {first:.17g}" if np.isfinite(first) else ""
        raise IntegrationError(
            f"{missed.sum()} of {missed.size} requested states were not reached{which}. "
            f"{RESULTS[result]} {kept}",
            solution,
        )
    step = int(solution.stats["failed_step"])
    if task.lattice.has_memory:
        at = f"last h = {float(solution.stats['last_h']):g}"
    else:
        at = f"h = {float(task.interval(jnp.asarray(step, jnp.int32)).h):g}"
    solved = int(solution.stats["newton_iterations"]) > 0
    residual = float(solution.stats["failed_residual"])
    how = f"; relative residual of the implicit solve {residual:.3g}" if solved else ""
    raise IntegrationError(
        f"the trajectory failed at step {step} of {solution.stats['num_steps']} ({at}{how}). "
        f"{RESULTS[result]} {kept}",
        solution,
    )


def _check_memory(
    save: Save, plan: Plan, q0: Array, beside: int, leaves: list[Any], layout: Layout
) -> None:
    """Refuse results that no memory can hold; `beside`: bytes of observables at a save point."""
    memory = results_memory()
    saved = plan.num_blocks + 1 + plan.save_tail if save.ts is None else save.ts.shape[0]
    each = (2 * q0.size + 2) * q0.dtype.itemsize + beside  # q, p, t and h
    count, is_compiled = batch_size(leaves)
    if memory is None or count * saved * each <= memory:
        return
    if is_compiled and (layout.form == "arrays" or not generates()):
        return  # XLA does not compute results that the function around this one does not use
    batch = f" of each of {count} trajectories" if count > 1 else ""
    raise ValueError(
        f"the results need {count * saved * each / 2**30:.3g} GiB of memory ({saved} saved states"
        f"{batch}), and there are {memory / 2**30:.3g} GiB. Save fewer states: "
        "save=dvi.Save(every=m), dvi.Save(final=True) or dvi.Save(ts=times). A reduction such as "
        "dvi.MaxDrift(function) observes every step in constant memory"
        + (", and dvi.sweep(store=...) writes results of many trajectories to disk." if batch
           else ".")
    )  # fmt: skip


def start_state(q0: Any, p0: Any) -> tuple[Array, Array]:
    """A start as real arrays of one shape and precision, or an error that says what is wrong."""
    q, p = _real_array("q0", q0), _real_array("p0", p0)
    if q.shape != p.shape:
        raise ValueError(
            f"q0 and p0 must have one shape, got q0 {q.shape} and p0 {p.shape}. Each position "
            "needs its momentum."
        )
    if q.size == 0:
        raise ValueError(f"q0 is empty (shape {q.shape}): there is nothing to integrate.")
    if q.dtype != p.dtype:
        dtype = jnp.result_type(q.dtype, p.dtype)
        q, p = q.astype(dtype), p.astype(dtype)
    if q.dtype.itemsize < 4:
        raise TypeError(f"q0 and p0 must be float32 or float64, got {q.dtype}: too few digits.")
    return q, p


def _real_array(name: str, value: Any) -> Array:
    if isinstance(value, list | tuple) and any(is_traced(x) for x in jax.tree.leaves(value)):
        value = jnp.asarray(value)
    if isinstance(value, jax.Array) and is_traced(value):
        kind = value.dtype
    else:
        # In NumPy: under jit, jax.numpy would give tracers even for values that are known.
        value = _as_numpy(name, value)
        kind = value.dtype
        refuse_double_without_x64(name, kind)
    if kind.kind == "c":
        raise TypeError(
            f"{name} must be real, got dtype {kind}. Write a complex variable as its real and "
            "imaginary parts (a canonical pair, up to a factor)."
        )
    if not _is_real(kind):
        raise TypeError(f"{name} must be a real array, got dtype {kind}.")
    if isinstance(value, np.ndarray) and not np.isfinite(value).all():
        where = tuple(np.argwhere(~np.isfinite(value))[0].tolist())
        raise ValueError(
            f"{name} holds a value that is not finite at index {list(where)}: {value[where]}. "
            "Every component of the start must be a number."
        )
    array = jnp.asarray(value)
    return array.astype(jnp.result_type(float)) if kind.kind in "iu" else array


def _is_real(dtype: Any) -> bool:
    """Whether numbers of this type are real; NumPy does not know those of two bytes."""
    return dtype.kind in "fiu" or jnp.issubdtype(dtype, jnp.floating)


def as_scalar(name: str, value: Any, dtype: Any, zero_allowed: bool = True) -> Array:
    """A number of this precision, or an error that names it."""
    known = None if is_traced(value) else _as_numpy(name, value)
    if isinstance(value, np.ndarray | np.generic) and value.dtype == np.float64:
        refuse_double_without_x64(name, value.dtype)
    kind, shape = (value.dtype, value.shape) if known is None else (known.dtype, known.shape)
    if not _is_real(kind):
        raise TypeError(f"{name} must be a real number, got {value!r}.")
    if shape != ():
        raise ValueError(
            f"{name} must be one number, got shape {shape}. For several values use "
            f"jax.vmap over {name}" + (", or lattice=dvi.Given(ts)." if name == "h" else ".")
        )
    if known is not None and not np.isfinite(known):
        raise ValueError(f"{name} must be finite, got {known}.")
    if known is not None and not zero_allowed and known == 0:
        raise ValueError(
            f"{name} must not be zero: no step would advance time. Give a positive h (forward) "
            "or a negative one (backward)."
        )
    return jnp.asarray(value, dtype) if known is None else jnp.asarray(known.astype(dtype))


def _as_numpy(name: str, value: Any) -> np.ndarray:
    refuse_unit_or_mask(name, value)
    try:
        return np.asarray(value)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be made of real numbers, got {value!r} ({error}).") from None


def as_parameter(leaf: Any) -> Any:
    """A leaf of args: floats become arrays, so that a new value needs no new compilation."""
    if isinstance(leaf, np.ndarray | np.generic):
        refuse_unit_or_mask("args", leaf)
        leaf = np.asarray(leaf)
        refuse_double_without_x64("args", leaf.dtype)
        if leaf.dtype.kind in "OMm":
            raise TypeError(f"args holds an array of dtype {leaf.dtype}: numbers are needed.")
        return jnp.asarray(leaf)
    if not isinstance(leaf, jax.Array):
        try:
            hash(leaf)
        except TypeError:
            raise TypeError(
                f"args holds a {type(leaf).__name__}, which is neither an array nor hashable: "
                f"{leaf!r:.80}. Give arrays and numbers, in dicts, lists and tuples."
            ) from None
    return jnp.asarray(leaf) if isinstance(leaf, float) else leaf


def _check_deviations(leaf: Deviations, task: Task, q0: Array, p0: Array) -> None:
    """Refuse deviation vectors along steps whose derivative is not that of the method alone."""
    name = type(leaf).__name__
    if task.lattice.has_memory:
        raise ValueError(
            f"{name} needs steps whose size does not depend on the state, and those of "
            f"{task.lattice!r} do: take lattice=dvi.Uniform() or dvi.Given(ts)."
        )
    eqx.filter_eval_shape(leaf.start, jnp.zeros(2 * q0.size, q0.dtype))  # counts and units


def _check_observe(task: Task, q0: Array, p0: Array) -> int:
    """Refuse observables that are not functions of a step with an array for a value.

    **Returns** the bytes of those that stand alone, at one save point.
    """
    size = 0
    for leaf in jax.tree.leaves(task.observe, is_leaf=is_observable):
        if isinstance(leaf, type) and issubclass(leaf, Deviations | Running):
            raise TypeError(
                f"observe holds the class {leaf.__name__}: give it what it takes, as in "
                "dvi.MEGNO() or dvi.Running(dvi.MEGNO())."
            )
        if isinstance(leaf, type) and issubclass(leaf, Reduction):
            raise TypeError(
                f"observe holds the class {leaf.__name__}: give it what it is to reduce, "
                f"dvi.{leaf.__name__}(function), a function {_STEP}."
            )
        if not is_observable(leaf):
            raise TypeError(
                f"observe must be a pytree of functions {_STEP} or "
                f"reductions such as dvi.MaxDrift(function); it holds {leaf!r}."
            )
        if isinstance(leaf, Running):
            leaf = leaf.reduction
        if isinstance(leaf, Deviations):
            _check_deviations(leaf, task, q0, p0)
            continue
        function = leaf.function if isinstance(leaf, Reduction) else leaf
        called = getattr(function, "__name__", type(function).__name__)
        if not callable(function):
            raise TypeError(f"{type(leaf).__name__} takes a function {_STEP}, got {function!r}.")
        t0, bound = task.t0, task.bound(function)
        try:
            out = eqx.filter_eval_shape(bound, t0, t0, q0, p0, q0, p0, task.args)
        except Exception as error:
            error.add_note(f"(in the observable {called}, called with {_STEP})")
            raise
        if not hasattr(out, "shape") and not isinstance(out, int | float):
            raise TypeError(
                f"an observable {_STEP} must return one array; "
                f"{called} returned {type(out).__name__}."
            )
        if isinstance(leaf, Range) and jnp.issubdtype(jnp.result_type(out), jnp.complexfloating):
            raise TypeError(
                f"Range compares values, which complex numbers have no order for; {called} returns "
                "them. Take the real and imaginary parts, or the absolute value."
            )
        if not isinstance(leaf, Reduction):
            size += int(np.prod(np.shape(out), dtype=int)) * jnp.result_type(out).itemsize
    return size
