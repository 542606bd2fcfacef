"""The loop over the steps of a time grid, with status, saved states and observables."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

import lanewise

from ..base.results import RESULTS, first_failure
from ..base.types import Interval, Scalar, State
from ..engine.guard import all_finite
from ..engine.newton import no_residual, worse
from ..engine.pairs import rounded
from ..lattices import Place, Uniform
from ..methods import InLoop
from ..methods.constraint import start_status
from ..methods.step import info_of
from ..observe import Deviations, Pushed, Reduction, has_initial_value
from ..observe._kept import KeptSteps, StepStart, as_row, event
from .jumps import Part, Record, after_step, first_memory, where, with_jumps, with_row
from .task import Carry, Ends, Outcome, Plan, Rows, Task, adds_start_outside, or_nan

Loop = Callable[[Callable, Any, None, int], tuple[Any, Any]]
"""``(body, carry, None, count) -> (carry, ys)``: `lax.scan`, or one with another derivative."""


def start(task: Task, q0: State, p0: State) -> Carry:
    """The carry before the first step."""
    real = jnp.finfo(q0.dtype).dtype
    finite = jnp.all(jnp.isfinite(q0)) & jnp.all(jnp.isfinite(p0))
    result = RESULTS.where(finite, RESULTS.successful, RESULTS.not_finite)
    usable = task.lattice.is_usable(task.t0, task.h)
    result = RESULTS.where(usable, result, RESULTS.bad_step_size)
    # Known values have been checked with an error of their own; traced ones have a status only.
    if task.equations.system.constraint is not None:
        result = first_failure(result, start_status(task.equations, task.t0, q0, p0))
    interval = task.first_interval()

    def memory(reduction):
        at_start = Ends(interval.t0, interval.t0, q0, p0, q0, p0)
        like = eqx.filter_eval_shape(task.number, reduction, at_start)

        def initial_memory(ends):
            memory = reduction.start(jnp.zeros(like.shape, like.dtype))
            if not has_initial_value(reduction.function):
                return memory
            value = _value(task, ~is_failure, reduction, ends)
            return reduction.update(memory, jnp.asarray(0, jnp.int32), interval.t0, value)

        return task.evaluate(reduction, initial_memory, at_start)

    _, reductions = task.observables()
    is_failure = result != RESULTS.successful
    # A start that meets the condition of a Stop already has no step at all.
    stop = None
    if task.stop is not None:
        value = event(task.stop.g, task.t0, q0, p0, task.args)
        is_end = ~is_failure & (value >= 0)
        result = RESULTS.where(~is_failure & jnp.isnan(value), RESULTS.event_not_finite, result)
        is_failure = is_failure | jnp.isnan(value)
        result = RESULTS.where(is_end, RESULTS.stopped, result)
        row = as_row(is_end, StepStart(task.t0, interval.t1, interval.t1, q0, p0))
        stop = row, jnp.asarray(0, jnp.int32)
    good = result == RESULTS.successful
    # A typed zero: the carry of a scan must not change its type, and a Python integer would.
    zero = jnp.asarray(0, jnp.int32)
    counts = task.method.count(task.equations, interval, *lax.stop_gradient((q0, p0, q0, p0)))
    carry = Carry(
        k=zero,
        q=or_nan(good, q0),
        p=or_nan(good, p0),
        lattice=task.lattice.begin(task.t0, task.h),
        result=result,
        failed_step=jnp.where(is_failure, zero, -1),
        failed_residual=no_residual(real),
        iterations=zero,
        residual=no_residual(real),
        reductions=[memory(r) for r in reductions],
        remainder=task.arithmetic.start(q0, p0),
        stop=stop,
        jumps=first_memory(task, q0, p0) if task.jumps else None,
        args=jax.tree.map(jnp.asarray, task.args) if task.changes_args else None,
        counts=jax.tree.map(jnp.zeros_like, counts),
    )
    in_loop = _in_loop(task, q0)
    if in_loop is None:
        return carry
    entered = _advanced(task, in_loop.first, carry, zero)
    good = entered.result == RESULTS.successful
    q, p = or_nan(good, (carry.q, carry.p))
    return entered._replace(q=q, p=p, method_state=(entered.q, entered.p))


def take_step(
    task: Task, carry: Carry, in_loop: InLoop | None = None
) -> tuple[Carry, Interval, Ends]:
    """The next step, its status and its reductions."""
    task = task.with_args(carry)
    was_good = carry.result == RESULTS.successful

    def next_interval(memory, q, p):
        place = Place(task.t0, task.h, carry.k, q, p)
        return task.lattice.next(memory, task.equations, place)

    interval, memory, exists = task.constant_unless(was_good, next_interval)(
        carry.lattice, carry.q, carry.p
    )
    interval = task.in_precision(interval)
    equations = task.equations_at(carry.k, interval)
    step = task.arithmetic.interpret(task.method.step if in_loop is None else in_loop.step)
    # Maps to the coordinates of the method and back, where the carry has both.
    conversion = None if carry.method_state is None else in_loop
    before = carry.method_state or (carry.q, carry.p)

    def one_step(q, p):
        local, *state = task.arithmetic.enter(equations, q, p, carry.remainder)
        q1, p1, info = step(local, interval, *state)
        q1, p1, remainder = task.arithmetic.leave(q, p, q1, p1)
        info = info_of(task.method, info, q1, p1)
        if task.jumps:
            ends = q, p, q1, p1, info
            part, records = with_jumps(task, equations, interval, carry.jumps, ends)
            return (part.q1, part.p1, None), (remainder, part.info, (part, records))
        if conversion is None:
            return (q1, p1, None), (remainder, rounded(info), None)
        x1, y1, last = conversion.last(local, interval, q1, p1)
        return (x1, y1, (q1, p1)), (remainder, info.then(last), None)

    def has_succeeded(result):
        _, (_, info, _) = result
        return info.result == RESULTS.successful

    advance = task.constant_unless(was_good, one_step, has_succeeded)
    if task.has_deviations:
        # One linearisation serves all deviation vectors of all reductions.
        state, push, (remainder, info, jumps) = jax.linearize(advance, *before, has_aux=True)
        if conversion is not None:
            first, of_method = functools.partial(conversion.first, equations, interval), push
            _, enter = jax.linearize(lambda *state: first(*state)[:2], carry.q, carry.p)
            push = lambda *change: of_method(*enter(*change))  # noqa: E731
    else:
        (state, (remainder, info, jumps)), push = advance(*before), None
    q1, p1, method_state = state
    result = info.result if exists is None else first_failure(exists, info.result)
    # The part of the step without a jump, in which a run may stop.
    last = Ends(interval.t0, interval.t1, carry.q, carry.p, q1, p1)
    if jumps is not None:
        # Observables and a `Stop` receive the parameters after the last jump.
        last = jumps[0].ends
        task = task.with_args(carry := carry._replace(args=jumps[0].args))
    result, stop = _stop(task, carry, last, result)
    # After a failure the state is NaN, so that no later step is good: the test of one step is
    # enough, and the loop needs no flag.
    good = result == RESULTS.successful
    residual = lax.stop_gradient(info.residual)
    carry_after = carry._replace(method_state=method_state)
    new = _with_failure(carry_after, q1, p1, result, good, residual)
    ends, carry_after_jumps, has_jumped = last._replace(q1=new.q, p1=new.p), carry, None
    if jumps is not None:
        has_jumped = jumps[0].number > 0
        carry_after_jumps, new = _after_jumps(task, carry, new, interval.t0, *jumps)
    rest = remainder, push, interval.h, good, has_jumped
    memories = _memories(task, carry_after_jumps, ends, *rest)
    if stop is not None:
        # Reductions cover the steps before the one in which the run stopped.
        is_end = new.result == RESULTS.stopped
        memories = jax.tree.map(lambda a, b: jnp.where(is_end, b, a), memories, carry.reductions)
    states = lax.stop_gradient((carry.q, carry.p, new.q, new.p))
    counts = task.method.count(task.equations, interval, *states)
    new = new._replace(
        k=carry.k + 1,
        # The memory of the last good step, for the report: that of a failed one may be NaN.
        lattice=jax.tree.map(lambda new, old: jnp.where(good, new, old), memory, carry.lattice),
        iterations=carry.iterations + jnp.where(was_good, info.iterations, 0),
        residual=worse(carry.residual, residual, good),
        reductions=memories,
        remainder=remainder,
        stop=stop,
        counts=jax.tree.map(lambda old, x: jnp.where(good, old + x, old), carry.counts, counts),
    )
    return new, interval, Ends(*interval[:2], carry.q, carry.p, new.q, new.p)


def _after_jumps(
    task: Task, carry: Carry, new: Carry, t0: Scalar, part: Part, records: Record | None
) -> tuple[Carry, Carry]:
    """The carries before and after a step, with its jumps, and the parts of the step before them in
    the reductions that keep steps."""
    memory = after_step(carry.jumps, part)
    if records is None:
        return carry, new._replace(jumps=memory._replace(number=memory.number + part.number))
    _, reductions = task.observables()

    def write(state):
        def add(state, record):
            t0, q0, p0, memory, memories = state
            ends = Ends(t0, record.t, q0, p0, *record[3:5])
            for i, reduction in enumerate(reductions):
                if isinstance(reduction, KeptSteps):
                    value = _value(task, record.exists, reduction, ends)
                    k = _start_number(carry.k, memory.number > carry.jumps.number)
                    new_memory = reduction.update(memories[i], k, record.t, value)
                    new_memory = where(record.exists, new_memory, memories[i])
                    memories = [*memories[:i], new_memory, *memories[i + 1 :]]
            start = where(record.exists, (record.t, *record[5:]), (t0, q0, p0))
            return (*start, with_row(memory, record), memories), None

        return lax.scan(add, state, records)[0]

    # Outside of the step itself, whose derivative is zero where it fails: rows of earlier jumps
    # keep theirs. In a branch, because without it the rows would be copied in each step.
    state = t0, carry.q, carry.p, memory, carry.reductions
    state = lax.cond(lanewise.on_any(part.number > 0), write, lambda state: state, state)
    carry_after_jumps = carry._replace(reductions=state[4], jumps=state[3])
    return carry_after_jumps, new._replace(jumps=state[3])


def _start_number(k: Array, has_jumped: Array) -> Array:
    """The number of a step in reductions that keep steps; of a part after a jump that of the first,
    which may begin on a surface without a crossing."""
    return jnp.where(has_jumped, 0, k)


def _with_failure(
    carry: Carry, q1: State, p1: State, result: RESULTS, good: Array, residual: Array
) -> Carry:
    """The carry with the state, the status, the failed step and its residual after a step."""

    def note():
        first = ~good & (carry.result == RESULTS.successful)
        fails = first & (result != RESULTS.stopped)
        return (
            # The state after a failed step is not a result: as NaN it cannot be mistaken for one.
            or_nan(good, q1),
            or_nan(good, p1),
            or_nan(good, carry.method_state),
            first_failure(carry.result, result),
            jnp.where(fails, carry.k, carry.failed_step),
            jnp.where(fails, residual, carry.failed_residual),
        )

    def keep():
        return q1, p1, carry.method_state, carry.result, carry.failed_step, carry.failed_residual

    # The branch keeps this work out of steps in which nothing fails, which is nearly every step.
    values = lax.cond(lanewise.on_any(~good), note, keep)
    names = "q", "p", "method_state", "result", "failed_step", "failed_residual"
    return carry._replace(**dict(zip(names, values, strict=True)))


def _memories(
    task: Task,
    carry: Carry,
    ends: Ends,
    remainder: Any,
    push: Callable | None,
    h: Scalar,
    good: Array,
    has_jumped: Array | None,
) -> list[Any]:
    """The memories of the reductions after a step with the derivative `push`, `good` or failed."""
    _, reductions = task.observables()
    start = task.arithmetic.full_state(ends.q0, ends.p0, carry.remainder)
    end = task.arithmetic.full_state(ends.q1, ends.p1, remainder)

    def update(reduction: Reduction, memory: Any) -> Any:
        k = number_of(reduction, carry.k)
        if has_jumped is not None and isinstance(reduction, KeptSteps):
            k = _start_number(k, has_jumped)
        if isinstance(reduction, Deviations):
            assert push is not None
            vectors = _deviations(push, reduction.vectors(memory), ends, h)
            return reduction.update(memory, k, ends.t1, vectors)

        def with_value(ends, memory):
            value = _value(task, good, reduction, ends)
            return reduction.update(memory, k, ends.t1, value)

        return task.evaluate(reduction, with_value, Ends(*ends[:2], *start, *end), memory)

    return [update(*pair) for pair in zip(reductions, carry.reductions, strict=True)]


def _value(task: Task, good: Array, reduction: Reduction, ends: Ends) -> Array:
    """The value of an observable, a constant where it is not finite or the state is not `good`."""
    return task.constant_unless(good, functools.partial(task.number, reduction), all_finite)(ends)


def number_of(reduction: Reduction, k: Int[Array, ""]) -> Int[Array, ""]:
    """Index of the value at the end of step k; index 0 is the initial value, if there is one."""
    return k + 1 if has_initial_value(reduction.function) else k


def _deviations(push: Callable, vectors: Array, ends: Ends, h: Scalar) -> Pushed:
    """Deviation vectors (δq, δp), the rows of `vectors`, after the step; NaN if it has failed."""

    # Vectors are flat, so that observers of deviations need not know the shape of a state.
    def push_flat(vector):
        dq, dp = (x.reshape(ends.q0.shape) for x in jnp.split(vector, 2))
        return jnp.concatenate([x.ravel() for x in push(dq, dp)[:2]])

    good = jnp.all(jnp.isfinite(ends.q1)) & jnp.all(jnp.isfinite(ends.p1))
    return Pushed(or_nan(good, jax.vmap(push_flat)(vectors)), h)


def _stop(task: Task, carry: Carry, last: Ends, result: RESULTS) -> tuple[RESULTS, Any]:
    """The status, the stored row and its number, after a step that may meet the condition."""
    if task.stop is None:
        return result, None
    value = event(task.stop.g, last.t1, last.q1, last.p1, task.args)
    good = result == RESULTS.successful
    is_end = good & (value >= 0)
    row = as_row(is_end, StepStart(last.t0, last.t1, last.t1, last.q0, last.p0))
    result = RESULTS.where(good & jnp.isnan(value), RESULTS.event_not_finite, result)
    stop = jnp.where(is_end, row, carry.stop[0]), jnp.where(is_end, carry.k, carry.stop[1])
    return RESULTS.where(is_end, RESULTS.stopped, result), stop


def run(
    task: Task, plan: Plan, carry: Carry, loop: Loop, inner_loop: Callable | None = None
) -> tuple[Carry, Rows, Rows | None]:
    """All steps of `plan`: the carry, the rows of the blocks, the row of the tail (or None).

    `loop` runs over the blocks, `inner_loop` over the steps of one block: the same loop if None,
    else it receives a function as well, the state of a carry.
    """
    functions, _ = task.observables()
    in_loop = _in_loop(task, carry.q)
    is_joined = in_loop is not None and in_loop.is_joined

    def leave(carry):
        """The carry with the state in (q, p), at the end of its last step."""
        if in_loop is None or not in_loop.is_joined:
            return carry
        return _advanced(task, in_loop.last, carry, carry.k - 1)

    def over_steps(body, state, count):
        if inner_loop is None:
            return loop(body, state, None, count)
        return inner_loop(body, state, None, count, lambda state: leave(state[0])[1:3])

    has_memory = task.lattice.has_memory

    def last_values(carry, interval, ends):
        # The values of the last step that a save point needs and the carry does not have. Without
        # them the loop has fewer numbers to carry.
        return interval if has_memory else None, (ends.q0, ends.p0) if functions else None

    def body(state, _):
        carry, interval, ends = take_step(task, state[0], in_loop)
        return (carry, last_values(carry, interval, ends)), None

    def steps(carry, _, count=plan.block):
        """The next `count` steps, and the row of the save point at their end."""
        inner, interval = None, task.interval(carry.k + (count - 1))
        if is_joined:  # the state in (q, p) is not needed before the next save point
            q, p = carry.method_state
            carry = carry._replace(q=q, p=p, method_state=None)
        if count == 1:  # a loop around one step would take time to compile
            carry, interval, ends = take_step(task, carry, in_loop)
        else:
            last = last_values(carry, interval, Ends(*interval[:2], *[carry.q, carry.p] * 2))
            (carry, (last_interval, start)), inner = over_steps(body, (carry, last), count)
            interval = last_interval if has_memory else interval
            q0, p0 = start if functions else (carry.q, carry.p)
            ends = Ends(interval.t0, interval.t1, q0, p0, carry.q, carry.p)
        if is_joined:
            # A state that cannot be computed at a save point ends the trajectory.
            start = leave(carry._replace(k=carry.k - 1, q=ends.q0, p=ends.p0))
            end = leave(carry)
            state = or_nan(end.result == RESULTS.successful, (carry.q, carry.p))
            carry = end._replace(method_state=state)
            ends = Ends(*ends[:2], start.q, start.p, end.q, end.p)
        observed = task.with_args(carry).at_save(carry, ends)
        return carry, Rows(interval.t1, interval.h, carry.q, carry.p, observed, inner)

    carry, rows = loop(steps, carry, None, plan.num_blocks)
    # The tail is outside of the scan, whose rows all have the same number of steps.
    if not plan.tail:
        return carry, rows, None
    carry, tail = steps(carry, None, plan.tail)
    return carry, rows, tail


def _in_loop(task: Task, q: State) -> InLoop | None:
    """The step in the loop, and the maps from (q, p) and back; None: that of the method."""
    if not task.arithmetic.is_plain or task.jumps:
        return None
    point = task.equations, task.first_interval(), q
    # Reductions and a `Stop` read the states of all steps.
    reads_all = task.stop is not None or bool(task.observables()[1])
    if type(task.lattice) is Uniform and not reads_all and (joined := task.method.in_loop(*point)):
        return joined
    # Conversions in each step would round the state in one direction.
    coordinates = task.method.in_coordinates(*point)
    if coordinates is None:
        return None
    return InLoop(coordinates.enter, coordinates.method.step, coordinates.leave, is_joined=False)


def _advanced(task: Task, advance: Callable, carry: Carry, k: Array) -> Carry:
    """The carry with the state after `advance`, a part of step k, and with its status."""

    def part(q, p):
        return advance(task.equations, task.interval(k), q, p)

    was_good = carry.result == RESULTS.successful
    q, p, info = task.constant_unless(was_good, part)(carry.q, carry.p)
    good, residual = info.result == RESULTS.successful, lax.stop_gradient(info.residual)
    new = _with_failure(carry._replace(k=k), q, p, info.result, good, residual)
    return new._replace(k=carry.k)


def outcome(
    task: Task, plan: Plan, loop_values: tuple[Carry, Rows, Rows | None], q0: State, p0: State
) -> Outcome:
    """The result of `run`, with the start in front unless `adds_start_outside`."""
    carry, rows, tail = loop_values
    rows = with_tail(plan, rows, tail)
    if not adds_start_outside(plan):
        rows = with_start(rows, q0, p0)
    return Outcome(carry, rows, results_of(task, carry))


def results_of(task: Task, carry: Carry) -> list[Any]:
    """The results of the reductions, in tree order."""
    _, reductions = task.observables()
    pairs = zip(reductions, carry.reductions, strict=True)
    return [task.finish(reduction, memory) for reduction, memory in pairs]


def with_tail(plan: Plan, rows: Rows, tail: Rows | None) -> Rows:
    """The rows, that of the end of the tail included if the plan saves it."""
    rows = rows._replace(inner=None)
    if tail is None or not plan.save_tail:
        return rows
    tail = tail._replace(inner=None)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), rows, tail)


def with_start(rows: Rows, q0: State, p0: State) -> Rows:
    """The rows, with the initial state in front of the states."""
    q, p = (jnp.concatenate([a[None], b]) for a, b in ((q0, rows.q), (p0, rows.p)))
    return rows._replace(q=q, p=p)
