"""From the result of the loop to the `Solution`, or to the error of a run that has failed."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

import lanewise
from lanewise import Layout
from lanewise.jaxprs.jaxapi import is_traced, manual_axes

from ..base.results import RESULTS, IntegrationError, status_code, status_name
from ..engine.newton import relative_size
from ..engine.rounding import each
from ..lattices import Place, Run
from ..observe import OfState, Reduction, RequestedTimes, Running, Section, is_observable
from ..observe._kept import Start
from ..observe.solution import Solution
from .dense import Curve, at_times, crossings, stopped
from .task import Outcome, Plan, StepTaken, Task


def as_solution(
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


def observed(observe: PyTree, alone: list[Any], reduced: list[Any]) -> PyTree:
    """The pytree `observe` with every observable replaced by its values."""
    # Both lists are in the order of the leaves, in which `Task.observables` has separated them.
    values, lone = iter(reduced), iter(alone)

    def value(f):
        if isinstance(f, Reduction):
            return next(values)
        if isinstance(f, Running):  # its final value is the last of its rows, and not needed
            next(values)
        return next(lone)

    return jax.tree.map(value, observe, is_leaf=is_observable)


def with_initial_values(observe: PyTree, found: PyTree, run: Run, layout: Layout) -> PyTree:
    """The values of functions of the state, with that at the initial state as their first row."""

    def value(f, values):
        if not isinstance(f, OfState):
            return values

        def at_start(t, q, p, args):
            return jnp.asarray(f(t, t, q, p, q, p, args))

        first = lanewise.call(at_start, run.t0, run.q0, run.p0, run.args, layout=layout)
        return jnp.concatenate([first[None].astype(values.dtype), values])

    return jax.tree.map(value, observe, found, is_leaf=is_observable)


def checked(solution: Solution, task: Task) -> Solution:
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
