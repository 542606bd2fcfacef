"""`integrate`, the function that computes one trajectory."""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Never

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree

import lanewise
from lanewise import Layout
from lanewise.jaxprs.jaxapi import is_traced, manual_axes

from ..base.checks import instance, refuse_unknown
from ..base.inputs import as_parameter, as_scalar, start_state
from ..base.progress import bar_of, reporter
from ..base.reads import reads
from ..base.results import RESULTS, IntegrationError, status_code, status_name
from ..base.types import Interval
from ..engine.newton import RootSolver, relative_size
from ..engine.rounding import each
from ..lattices import Lattice, Place, Run
from ..methods import Method, warn_of_dissipation
from ..methods.constraint import check_start
from ..methods.step import Equations
from ..observe import OfState, RequestedTimes, Section, Stop, is_observable, of_steps
from ..observe._kept import Start
from ..observe.solution import Save, Solution
from ..problem.noise import as_path
from ..problem.system import System, check_system, of_problem
from .adjoints import AbstractAdjoint
from .arithmetic import Arithmetic
from .checks import noise_path
from .dense import Curve, at_times, crossings, requested_times, stopped
from .integrator import Integrator, chosen
from .loop import reduce, run, start, with_start, with_tail
from .outcome import check_observe, observed, with_initial_values
from .plan import Plan, check_memory, make_plan
from .task import Outcome, StepTaken, Task

_PIECES = 100
"""Maximum number of progress reports of a run."""


def integrate(
    system: Any,
    q0: Any = None,
    p0: Any = None,
    *,
    h: Any = None,
    num_steps: int | None = None,
    t0: Any = 0.0,
    t1: Any = None,
    duration: Any = None,
    epsilon: Any = None,
    args: PyTree = None,
    method: Method | str | None = None,
    lattice: Lattice | None = None,
    save: Save = Save(),
    observe: PyTree = None,
    adjoint: AbstractAdjoint | None = None,
    newton: RootSolver | None = None,
    root_finder: RootSolver | None = None,
    arithmetic: Arithmetic | None = None,
    layout: Layout | None = None,
    integrator: Integrator | None = None,
    stop: Stop | None = None,
    path: Any = None,
    throw: bool = True,
    progress: bool | Callable[[int, int], None] | None = None,
    **unknown: Never,
) -> Solution:
    r"""One trajectory of a perturbed discrete Hamiltonian system.

    Iterates the map of `method`, by default (see `Integrator`) the paper's (12)–(13),

        q1 = q0 + h ∂H_D/∂p1,    p1 = p0 − h ∂H_D/∂q0 + h ε W(t0, t1, q0, p1).

    **Arguments**

    - `system`: a `System`; or a problem of the library, such as ``systems.kepler()``, which has
      defaults for q0, p0, h and args.
    - `q0`, `p0`: initial conditions, real arrays of one shape (any: ``(n,)``, ``(bodies, 3)``).
    - `h`: step size [time], not 0; negative to integrate backwards. `num_steps`: number of steps;
      static. In place of it, with equal steps: `t1`, the final time, or `duration`, t1 − t0; both
      are multiples of h, and static.
    - `t0`: initial time. `epsilon`: strength of the perturbation. A system with a force or a
      perturbation needs it (0.0: the unperturbed motion).
    - `args`: pytree that H_D, W and the observables receive.
    - `method`: an object, or its name such as "strang" or "KahanLi8": `TypeII`, `Adjoint`,
      `Strang`, the compositions `Yoshida`, `Suzuki`, `BlanesMoan`, `McLachlan`, `KahanLi`,
      `Composition`; `GaussLegendre`, `LobattoIIIAIIIB`; `RungeKutta4`.
    - `lattice`: the time grid: `Uniform()`; `Given(ts)`, which replaces h, num_steps and t0;
      `AdaptiveReversible(g)` and `TimeTransformed(g)`, with adaptive steps of about h g, explicit
      or implicit; or `Variational()`, whose steps solve (14), and h is the first of them.
    - `save`: the states to save, see `Save`.
    - `observe`: pytree of observables → array: functions ``(q, p)`` or ``(t, q, p, args)`` of the
      state, or ``(t0, t1, q0, p0, q1, p1, args)`` of a step. A function of the state is evaluated
      at every saved state, one of a step on the steps that end at a saved state; in `MaxDrift`,
      `Range`, `Trend`, `Mean`, `Last` it is reduced over every step in constant memory. A
      `Section` finds the crossings of a surface.
    - `layout`: machine code or arrays, see `Layout`.
    - `stop`: a `Stop`, the condition of an early end (a collision, an escape); or None.
    - `adjoint`: the computation of reverse-mode gradients: `Reversible`, `Checkpointed`, `Direct`.
    - `root_finder`, or `newton`: the solver of implicit steps: `PicardThenNewton`, `Newton`,
      `SimplifiedNewton`, `Picard`.
    - `arithmetic`: the representation of the state: `FloatingPoint`; for long runs `Compensated`,
      or `FixedPoint`, whose explicit steps can be undone bit for bit; `DoubleDouble`, 31 digits.
    - `integrator`: an `Integrator` in place of method, lattice, adjoint, newton, arithmetic and
      layout.
    - `path`: of a system with noise: a `Brownian` path, or an integer, the seed of one. The method
      is one for noise: `BAOAB`, `OBABO`, `StochasticEuler`, `StochasticMidpoint`.
    - `throw`: raise an error if the trajectory fails; otherwise read ``solution.result``.
    - `progress`: True shows a progress bar. A function is called as
      ``progress(steps_done, num_steps)`` at save points, at most about a hundred times during the
      run. The numbers are the same, bit for bit. Not under jit, vmap or grad.

    h, t0, epsilon, args, q0, p0 and the times of `Given` are traced: they may be batched by
    `vmap` and differentiated by `grad` and `jvp`. The precision is that of q0 and p0.

    **Returns** a `Solution`; time is the first axis of its saved values.

    **Raises** `ValueError` or `TypeError` for invalid input (shapes, types, values), and for
    results that need more memory than there is;
    `IntegrationError` when the trajectory fails and `throw` is True, with the status, the step
    and the residual (inside jit or vmap an equinox runtime error with the status).

    **Accuracy** order of the method in h. If h is small enough, the energy error of a symplectic
    method without perturbing force is O(h^order) and does not grow over very long times. Gradients
    are those of the discrete map, by the implicit function theorem through each solve.

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
    refuse_unknown("integrate", integrate, unknown)
    system, q0, p0, default_h, args = of_problem(system, q0, p0, h, args)
    check_system(system, noise_allowed=True)
    options = {"method": method, "lattice": lattice, "adjoint": adjoint, "newton": newton}
    options |= {"root_finder": root_finder, "arithmetic": arithmetic, "layout": layout}
    integrator = chosen(integrator, **options)
    # Here and not in `Integrator`: the default method depends on the system.
    method = Integrator.method_for(integrator, system)
    lattice, layout = integrator.lattice, integrator.layout
    instance("save", save, Save, "a dvi.Save(...)", _save_hint(save))
    instance("stop", stop, Stop | None, "a dvi.Stop(g)")
    q0, p0 = start_state(q0, p0)
    if observe is not None:
        observe = of_steps(observe)
    # A method of the class, here and below: equinox takes 20 µs to make a bound method of a module.
    kind = type(lattice)
    h = default_h if kind.takes_h else h  # that of a problem does not count where ts is given
    if t1 is not None or duration is not None:
        num_steps = kind.steps_to(lattice, t0, h, num_steps, t1, duration)
    t0, h, num_steps = kind.prepare(lattice, t0, h, num_steps)
    t0 = as_scalar("t0", t0, q0.dtype)
    h = as_scalar("h", h, q0.dtype, zero_allowed=False)
    epsilon = as_scalar("epsilon", System.strength(system, epsilon), q0.dtype)
    args = jax.tree.map(as_parameter, args)
    # Before anything is compiled: an error in a function of the user would otherwise come from
    # within many frames of tracing.
    System.check_shapes(system, t0, q0, p0, epsilon, args)
    # From here on `system`, `q0`, … may be those of another problem with other variables, whose
    # solution `undo` transforms back.
    given = Run(system, t0, q0, p0, epsilon, args, observe, save, stop)
    driven = noise_path(given, as_path(path), integrator, method, h, num_steps)
    asked, undo = kind.transform(lattice, given)
    kind.check(lattice, method, integrator.arithmetic)
    task, q0, p0 = _task(asked, integrator, method, h)
    task = task if driven is None else dataclasses.replace(task, path=driven)
    plan = make_plan(save, num_steps)
    leaves = jax.tree.leaves((task, q0, p0))
    # An allocation that fails ends the process, or makes the machine swap.
    check_memory(save, plan, q0, check_observe(task, q0, p0), leaves, layout)
    traced = any(is_traced(x) for x in leaves)
    # The warning needs the damping as a number, which is not known of traced values.
    first_interval = functools.partial(Task.first_interval, task)
    if not traced:
        type(method).check(method, task.equations, first_interval, q0, p0)
    if not traced and asked.system.constraint is not None:
        check_start(task.equations, task.t0, q0, p0)
    if not traced and asked.system.force is not None:
        warn_of_dissipation(method, task.equations, first_interval, q0, p0)
    if save.ts is not None:
        # The run itself saves nothing at these times: it stores the steps that contain them, and
        # `_as_solution` evaluates the method between their ends.
        observed = requested_times(asked.save, task, num_steps)
        task = dataclasses.replace(task, observe=observed)
    if progress is None or progress is False:
        solution = _whole(task, plan, asked.observe, q0, p0, integrator.adjoint, layout)
    elif traced:
        raise ValueError(
            "progress cannot be reported inside of jax.jit, jax.vmap, jax.grad or another "
            "transformation of JAX. Leave out progress, or use none of these transformations."
        )
    elif getattr(integrator.adjoint, "report_defect", False):
        raise ValueError(
            "dvi.Reversible(report_defect=True) cannot be combined with progress: leave out "
            "report_defect or progress."
        )
    else:
        with _reported(progress) as report:
            outcome = _in_pieces(task, plan, q0, p0, report, layout)
        solution = _solution(task, plan, asked.observe, outcome, q0, p0, layout)
    solution = undo(solution)
    if observe is not None and save.ts is None:
        watched = jax.tree.leaves(observe, is_leaf=is_observable)
        if any(isinstance(f, OfState) for f in watched):
            solution = _with_initial_values(solution, given, layout)
    return _raise_on_failure(solution, task) if throw else solution


@eqx.filter_jit
def _with_initial_values(solution: Solution, given: Run, layout: Layout) -> Solution:
    values = with_initial_values(given.observe, solution.observed, given, layout)
    return dataclasses.replace(solution, observed=values)


def _columns(done: tuple[int, int]) -> dict[str, Any]:
    return {"completed": done[0], "total": done[1], "steps": f"{done[0]} of {done[1]} steps"}


@contextmanager
def _reported(progress: Any) -> Iterator[Callable[[int, int], Any]]:
    """A context with the function that receives steps done and steps in all."""
    if callable(progress):
        yield progress
        return
    with reporter(progress, bar_of("integrate", ("steps",), _columns)) as report:
        assert report is not None  # `progress` is True here
        yield lambda *done: report(done)


def _save_hint(save: Any) -> str:
    if isinstance(save, int):
        return f"Take dvi.Save(every={save})."
    return "Take dvi.Save(final=True)." if save == "final" else ""


def _task(run: Run, integrator: Integrator, method: Method, h: Array) -> tuple[Task, Array, Array]:
    """The trajectory to compute, and its initial state in the representation of the arithmetic."""
    system, epsilon = run.system, run.epsilon
    is_disturbed = system.force is not None or system.perturbation is not None
    if not (is_disturbed or system.slow_time or is_traced(epsilon)) and float(epsilon) != 0:
        warnings.warn(
            f"epsilon = {float(epsilon):g} has no effect: the system has neither a force nor a "
            "perturbation. Leave epsilon out, or add force= or perturbation= in dvi.System(...).",
            stacklevel=3,
        )
    lattice, arithmetic = integrator.lattice, integrator.arithmetic
    equations = Equations(system, epsilon, run.args, integrator.root_finder)

    def first_interval() -> Interval:
        return Interval(run.t0, run.t0 + h, h)

    kind = type(arithmetic)
    equations, q0, p0 = kind.prepare(arithmetic, method, equations, first_interval, run.q0, run.p0)
    # A part of the key of compiled programs: with another value one is compiled again.
    seen = reads(run.observe, run.stop, lattice)
    task = Task(equations, method, lattice, run.observe, run.t0, h, arithmetic, run.stop, seen)
    return task, q0, p0


# Compiled here, not by the user: a call without jax.jit takes one program, that of its shapes.
@eqx.filter_jit
def _whole(
    task: Task, plan: Plan, observe: PyTree, q0, p0, adjoint: AbstractAdjoint, layout: Layout
) -> Solution:
    outcome = adjoint.rollout(task, plan, q0, p0, layout)
    return _as_solution(task, plan, observe, outcome, q0, p0, layout)


# The parts of a run with progress. Each is compiled for itself; the carry between them has all that
# a step depends on, so that the numbers are those of one run.
@eqx.filter_jit
def _begin(task: Task, q0, p0):
    return start(task, q0, p0)


@eqx.filter_jit
def _piece(task: Task, plan: Plan, carry, layout: Layout):
    arrays, rest = eqx.partition(task, eqx.is_array)

    def piece(arrays, carry):
        carry, saved, tail = run(eqx.combine(arrays, rest), plan, carry, lax.scan)
        return carry, with_tail(plan, saved, tail)

    return lanewise.call(piece, arrays, carry, layout=layout)


def _in_pieces(task: Task, plan: Plan, q0, p0, progress, layout) -> Outcome:
    """The same run as `_whole`, in pieces between save points, with a report after each."""
    # Whole blocks, and as many in each piece (the last one may have fewer): one program serves all.
    blocks = max(1, -(-plan.num_blocks // _PIECES))
    carry, done, parts, is_last = _begin(task, q0, p0), 0, [], False
    while not is_last:
        count = min(blocks, plan.num_blocks - done)
        done += count
        is_last = done >= plan.num_blocks
        tail = (plan.tail, plan.save_tail) if is_last else (0, False)
        carry, saved = _piece(task, Plan(count, plan.block, *tail), carry, layout)
        # JAX computes asynchronously: without waiting all reports would come at the beginning.
        jax.block_until_ready(carry)
        parts.append(saved)
        progress(plan.num_steps if is_last else done * plan.block, plan.num_steps)
    saved = jax.tree.map(lambda *xs: jnp.concatenate(xs), *parts)
    return Outcome(carry, with_start(saved, q0, p0), reduce(task, carry))


def _as_solution(
    task: Task, plan: Plan, observe: PyTree, outcome: Outcome, q0, p0, layout: Layout
) -> Solution:
    """The public `Solution` of a run."""
    carry, saved, reduced, defect = outcome
    curve = Curve.of(task.method, task.equations, layout)
    first = task.first_interval()
    # A batch element without a step to interpolate in uses the first one: its numbers are finite.
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
            ts = reductions[0].ts  # also the times that were not reached
        missed = (result == RESULTS.successful) & ~jnp.all(reached)
        result = RESULTS.where(missed, RESULTS.not_reached, result)
        values, hs = values[1:], ts - starts.t0
        steps = StepTaken(starts.t0, ts, starts.q0, starts.p0, qs, ps)
        own, _ = dataclasses.replace(task, observe=observe).observables()
        alone = each(_observed, (own, task.args), steps, layout=layout)
    else:
        ts = jnp.concatenate([task.t0[None], saved.t])
        qs, ps, hs, alone = saved.q, saved.p, saved.h, saved.observed
    place = Place(task.t0, task.h, carry.k, carry.q, carry.p)
    stats = {
        "num_steps": plan.num_steps,
        "newton_iterations": carry.iterations,
        "max_residual": relative_size(*carry.residual),
        "failed_step": carry.failed_step,
        "failed_residual": relative_size(*carry.failed_residual),
        **task.lattice.report(carry.lattice, task.equations, place),
        **({} if defect is None else {"round_trip_defect": defect}),
    }
    found = observed(observe, alone, values)
    end = None if task.stop is None else stopped(curve, task.stop, carry.stop, safe)
    return Solution(ts, qs, ps, hs, found, result, stats, end)


def _observed(given: tuple[Any, Any], step: StepTaken) -> list[PyTree]:
    observables, args = given
    return [step.value(f, args) for f in observables]


_solution = eqx.filter_jit(_as_solution)


def _raise_on_failure(solution: Solution, task: Task) -> Solution:
    result = solution.result
    if is_traced(status_code(result)):
        # The status is known when the compiled program runs: only an error of equinox can report
        # it, without the solution up to the failure.
        fine = (result == RESULTS.successful) | (result == RESULTS.stopped)
        arrays, rest = eqx.partition(solution, eqx.is_array)
        if not manual_axes(*jax.tree.leaves(arrays)):
            return result.error_if(solution, ~fine)

        # In jax.shard_map the branches of error_if differ in type: form it for one device.
        def check(result, arrays, fine):
            return result.error_if(arrays, ~fine)

        checked = lanewise.call(check, result, arrays, fine, layout=Layout(form="arrays"))
        return eqx.combine(checked, rest)
    if status_name(result) in ("successful", "stopped"):
        return solution
    kept = "The solution is the attribute `solution` of this error. With throw=False it is "
    kept += "returned with its status, without an error."
    if bool(result == RESULTS.not_reached):
        missed = np.isnan(np.asarray(solution.qs)).reshape(len(solution.ts), -1).any(1)
        first = float(solution.ts[missed.argmax()])
        which = f"; the first missing one is t = {first:.17g}" if np.isfinite(first) else ""
        raise IntegrationError(
            f"the run reached {(~missed).sum()} of {missed.size} values of ts in "
            f"dvi.Save(ts=...){which}. {RESULTS[result]} {kept}",
            solution,
        )
    step = int(solution.stats["failed_step"])
    if task.lattice.has_memory:
        at = f"last h = {float(solution.stats['last_h']):g}"
    else:
        at = f"h = {float(task.interval(jnp.asarray(step, jnp.int32)).h):g}"
    solved = int(solution.stats["newton_iterations"]) > 0
    residual = float(solution.stats["failed_residual"])
    how = f" and relative residual {residual:.3g} of the implicit solve" if solved else ""
    raise IntegrationError(
        f"the trajectory failed at step {step} of {solution.stats['num_steps']} (the first step "
        f"has number 0), with {at}{how}. {RESULTS[result]} {kept}",
        solution,
    )
