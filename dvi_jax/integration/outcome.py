"""From the result of the loop to the `Solution`, or to the error of a run that has failed."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

import lanewise
from lanewise import Layout
from lanewise.jaxprs.jaxapi import is_traced, manual_axes

from ..base.reads import Reads
from ..base.results import RESULTS, IntegrationError, status_code, status_name, with_auxiliary
from ..engine.guard import all_finite, nan_where_used, without_derivative
from ..engine.newton import relative_size
from ..lattices import Place, Run
from ..observe import Crossings, OfState, Reduction, RequestedTimes, Running, Section, is_observable
from ..observe._kept import StepStart
from ..observe.solution import Solution
from .dense import Curve, at_times, crossings, guarded, stop_point
from .jumps import jumps_of
from .task import Ends, Outcome, Plan, Task


def as_solution(
    task: Task, plan: Plan, observe: PyTree, outcome: Outcome, q0, p0, layout: Layout
) -> Solution:
    """The public `Solution` of a run."""
    carry, rows, values, defect = outcome
    curve = Curve.of_task(task, layout)
    first = task.first_interval()
    # A batch element without a step to interpolate in uses the first one.
    safe = StepStart(first.t0, first.t1, first.t1, q0, p0, jnp.asarray(0, jnp.int32))
    _, reductions = task.observables()
    status, results = carry.result, list(values)
    for i, reduction in enumerate(reductions):
        if isinstance(reduction, Section):
            listed, of_points = crossings(curve, reduction, values[i], safe)
            ts, qs, ps = _of_path(task, (listed.ts, listed.qs, listed.ps))
            results[i] = Crossings(ts, qs, ps, listed.count)
            status = with_auxiliary(status, of_points)
    if reductions and isinstance(request := reductions[0], RequestedTimes):
        is_reached, starts, (ts, qs, ps), of_points = at_times(curve, request, results[0], safe)
        status = with_auxiliary(status, of_points)
        if request.clock is None:
            ts = request.ts  # also the times that were not reached
        else:
            ts, qs, ps = _of_path(task, (ts, qs, ps))
        is_short = (status == RESULTS.successful) & ~jnp.all(is_reached)
        status = RESULTS.where(is_short, RESULTS.not_reached, status)
        results, hs = results[1:], ts - starts.t0
        steps = Ends(starts.t0, ts, starts.q0, starts.p0, qs, ps)
        functions, _ = dataclasses.replace(task, observe=observe).observables()
        has_state = ~jnp.isnan(qs.reshape(len(qs), -1)).any(axis=1)
        columns = jax.vmap(guarded(_values, (functions, task.args), layout))(has_state, steps)
    else:
        ts = jnp.concatenate([task.t0[None], rows.t])
        qs, ps, hs, columns = rows.q, rows.p, rows.h, rows.observed
    place = Place(task.t0, task.h, carry.k, carry.q, carry.p)
    stats = {
        "num_steps": plan.num_steps,
        "newton_iterations": carry.iterations,
        "max_residual": relative_size(*carry.residual),
        "failed_step": carry.failed_step,
        "failed_residual": relative_size(*carry.failed_residual),
        **carry.counts,
        **task.lattice.report(carry.lattice, task.equations, place),
        **({} if defect is None else {"round_trip_defect": defect}),
    }
    observed = observed_values(observe, columns, results)
    end = None
    if task.stop is not None:
        curve = Curve.of_task(task.with_args(carry), layout)
        end, of_point = stop_point(curve, task.stop, carry.stop, safe)
        end = _of_path(task, end)
        status = with_auxiliary(status, of_point)
    jumps = jumps_of(carry.jumps, q0) if task.jumps else None
    return Solution(ts, qs, ps, hs, observed, status, stats, end, jumps)


def _of_path(task: Task, points: Any) -> Any:
    """Points at times that depend on the state."""
    # The time at which a Brownian path has a value is no differentiable function of parameters.
    return points if task.path is None else without_derivative(points)


def _values(observables: tuple[list[Any], Any], ends: Ends) -> list[PyTree]:
    functions, args = observables
    return [ends.value(function, args) for function in functions]


def observed_values(observe: PyTree, columns: list[Any], results: list[Any]) -> PyTree:
    """The pytree `observe` with the values of functions and the results of reductions."""
    # Both lists are in the order of the leaves, in which `Task.observables` has separated them.
    next_column, next_result = iter(columns).__next__, iter(results).__next__

    def value(observable):
        if isinstance(observable, Reduction):
            return next_result()
        if isinstance(observable, Running):  # its final value is the last of its rows
            next_result()
        return next_column()

    return jax.tree.map(value, observe, is_leaf=is_observable)


@eqx.filter_jit
def with_initial_values(solution: Solution, run: Run, layout: Layout, _: Reads = ()) -> Solution:
    """The solution, with values at the initial state in front of those of functions of a state."""

    def with_first_row(observable, values):
        if not isinstance(observable, OfState):
            return values
        observable = observable.bind(run.system, run.epsilon)

        def at_start(_, t, q, p, args):
            return jnp.asarray(observable(t, t, q, p, q, p, args))

        row = run.t0, run.q0, run.p0, run.args
        function = guarded(at_start, None, layout, all_finite)
        first = nan_where_used(function, all_finite(row[1:3]), *row)
        return jnp.concatenate([first[None].astype(values.dtype), values])

    rows = jax.tree.map(with_first_row, run.observe, solution.observed, is_leaf=is_observable)
    return dataclasses.replace(solution, observed=rows)


def raise_on_failure(solution: Solution, task: Task, run: Run) -> Solution:
    """The solution. **Raises** `IntegrationError` if the run has failed; inside a transformation of
    JAX an error of equinox."""
    status = solution.result
    if is_traced(status_code(status)):
        return _when_compiled(solution)
    if status_name(status) in ("successful", "stopped"):
        return solution
    remark = f"{RESULTS[status]} Its attribute `solution` is what throw=False returns."
    if bool(status == RESULTS.not_reached):
        is_missing = np.isnan(np.asarray(solution.qs)).reshape(len(solution.ts), -1).any(1)
        first = float(solution.ts[is_missing.argmax()])
        example = f"; the first missing one is t = {first:.17g}" if np.isfinite(first) else ""
        raise IntegrationError(
            f"the run reached {(~is_missing).sum()} of {is_missing.size} values of ts in "
            f"dvi.Save(ts=...){example}. {remark}",
            solution,
        )
    stats = solution.stats
    step = int(stats["failed_step"])
    if step < 0:
        raise IntegrationError(
            "all steps succeeded, but a point within a step could not be computed: a time of "
            f"Save(ts=...), a crossing of a Section, or the end by a Stop. {remark}",
            solution,
        )
    if task.lattice.has_memory:
        details = f"last h = {float(stats['last_h']):g}"
    else:
        details = f"h = {float(task.interval(jnp.asarray(step, jnp.int32)).h):g}"
    if int(stats["newton_iterations"]) > 0:
        residual = float(stats["failed_residual"])
        details += f" and relative residual {residual:.3g} of the implicit solve"
    if bool(status == RESULTS.not_finite):
        remark = _infinite_derivative(solution, run) + remark
    raise IntegrationError(
        f"the trajectory failed at step {step} of {stats['num_steps']} (the first step has number "
        f"0), with {details}. {remark}",
        solution,
    )


def _infinite_derivative(solution: Solution, run: Run) -> str:
    """A sentence on a derivative of H_D that is not finite at the last finite state that was saved,
    where H_D is; else empty."""
    rows = (np.asarray(x).reshape(len(x), -1) for x in (solution.ts, solution.qs, solution.ps))
    finite = np.flatnonzero(np.isfinite(np.concatenate([*rows], axis=1)).all(axis=1))
    if not finite.size:
        return ""
    t, q, p = (x[finite[-1]] for x in (solution.ts, solution.qs, solution.ps))
    H = jax.value_and_grad(run.system.hamiltonian, (2, 3))
    value, slopes = H(t, t, q, p, run.epsilon, run.args)
    if not np.isfinite(value) or all(np.isfinite(slope).all() for slope in slopes):
        return ""
    name = "q" if not np.isfinite(slopes[0]).all() else "p"
    place = np.array2string(np.asarray(q), threshold=6)
    return (
        f"∂H_D/∂{name} is not finite at t = {float(t):.6g}, q = {place}, where H_D is: a branch of "
        "jnp.where that is undefined there, a norm or a root of zero. Give it another argument, as "
        "in jnp.where(r > 0, f(jnp.where(r > 0, r, 1)), 0) (a double where). "
    )


@jax.custom_batching.custom_vmap
def _largest_of_batch(code: Array) -> Array:
    """The largest code of the batches around this trajectory."""
    # As equinox forms it, but a batch of no trajectories has one as well.
    return code


@_largest_of_batch.def_vmap
def _(_size, _is_batched, code):
    return _largest_of_batch(jnp.max(code, axis=0, initial=0)), False


def _when_compiled(solution: Solution) -> Solution:
    """The solution, whose failure raises an error when the compiled program runs."""
    # Its status is not known before: only an error of equinox can report it, without the solution.
    status = solution.result
    is_failure = (status != RESULTS.successful) & (status != RESULTS.stopped)
    status = jax.tree.map(_largest_of_batch, status)
    arrays, functions = eqx.partition(solution, eqx.is_array)
    if not manual_axes(*jax.tree.leaves(arrays)):
        return status.error_if(solution, is_failure)

    # In jax.shard_map the branches of error_if differ in type: form it for one device.
    def check(status, arrays, is_failure):
        return status.error_if(arrays, is_failure)

    arrays = lanewise.call(check, status, arrays, is_failure, layout=Layout(form="arrays"))
    return eqx.combine(arrays, functions)
