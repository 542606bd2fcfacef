"""The loop over the steps of a time grid, with status, saved states and observables."""

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
from ..engine.newton import no_residual, worse
from ..engine.pairs import rounded
from ..lattices import Place, Uniform
from ..methods.constraint import start_status
from ..observe import Deviations, Pushed, Reduction, has_initial_value
from ..observe._kept import Start, as_row, event
from .plan import Plan, adds_start_outside
from .task import Carry, Outcome, Saved, StepTaken, Task, or_nan

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
        at_start = StepTaken(interval.t0, interval.t0, q0, p0, q0, p0)
        function = task.bound(reduction.function)
        like = eqx.filter_eval_shape(at_start.number, function, task.args)

        def begun(taken):
            begun = reduction.start(jnp.zeros(like.shape, like.dtype))
            if not has_initial_value(reduction.function):
                return begun
            value = taken.number(function, task.args)
            return reduction.update(begun, jnp.asarray(0, jnp.int32), interval.t0, value)

        return task.evaluate(reduction, begun, at_start)

    _, reductions = task.observables()
    failed = result != RESULTS.successful
    # A start that meets the condition of a Stop already has no step at all.
    stop = None
    if task.stop is not None:
        over = ~failed & (event(task.stop.g, task.t0, q0, p0, task.args) >= 0)
        result = RESULTS.where(over, RESULTS.stopped, result)
        stop = as_row(over, Start(task.t0, interval.t1, interval.t1, q0, p0))
    good = result == RESULTS.successful
    # A typed zero: the carry of a scan must not change its type, and a Python integer would.
    zero = jnp.asarray(0, jnp.int32)
    return Carry(
        k=zero,
        q=or_nan(good, q0),
        p=or_nan(good, p0),
        lattice=task.lattice.begin(task.t0, task.h),
        result=result,
        failed_step=jnp.where(failed, zero, -1),
        failed_residual=no_residual(real),
        iterations=zero,
        residual=no_residual(real),
        reductions=[memory(r) for r in reductions],
        beside=task.arithmetic.start(q0, p0),
        stop=stop,
    )


def take_step(
    task: Task, carry: Carry, step: Callable | None = None
) -> tuple[Carry, Interval, StepTaken]:
    """The next step of the trajectory, its status and its reductions; `step`: another one than that
    of the method."""
    place = Place(task.t0, task.h, carry.k, carry.q, carry.p)
    interval, memory, exists = task.lattice.next(carry.lattice, task.equations, place)
    interval = task.in_precision(interval)
    equations = task.equations_at(carry.k, interval)
    step = task.arithmetic.evaluated(step or task.method.step)

    def advance(q, p):
        here, *relative = task.arithmetic.enter(equations, q, p, carry.beside)
        q1, p1, info = step(here, interval, *relative)
        q1, p1, beside = task.arithmetic.leave(q, p, q1, p1)
        return (q1, p1), (beside, rounded(info))

    if task.has_deviations:
        # One linearisation serves all deviation vectors of all reductions.
        (q1, p1), push, (beside, info) = jax.linearize(advance, carry.q, carry.p, has_aux=True)
    else:
        ((q1, p1), (beside, info)), push = advance(carry.q, carry.p), None
    result = info.result if exists is None else first_failure(exists, info.result)
    result, stop = _stop(task, carry, interval, q1, p1, result)
    # After a failure the state is NaN, so that no later step is good: the test of one step is
    # enough, and the loop needs no flag.
    good = result == RESULTS.successful
    residual = lax.stop_gradient(info.residual)
    q1, p1, result, failed_step, failed_residual = _noted(carry, q1, p1, result, good, residual)
    taken = StepTaken(interval.t0, interval.t1, carry.q, carry.p, q1, p1)
    reduced = _reduced(task, carry, taken, beside, push, interval.h)
    if stop is not None:
        # Reductions cover the steps before the one in which the run stopped.
        over = result == RESULTS.stopped
        reduced = jax.tree.map(lambda a, b: jnp.where(over, b, a), reduced, carry.reductions)
    was_good = carry.result == RESULTS.successful
    carry = Carry(
        k=carry.k + 1,
        q=q1,
        p=p1,
        # The memory of the last good step, for the report: that of a failed one may be NaN.
        lattice=jax.tree.map(lambda new, old: jnp.where(good, new, old), memory, carry.lattice),
        result=result,
        failed_step=failed_step,
        failed_residual=failed_residual,
        iterations=carry.iterations + jnp.where(was_good, info.iterations, 0),
        residual=worse(carry.residual, residual, good),
        reductions=reduced,
        beside=beside,
        stop=stop,
    )
    return carry, interval, taken


def _noted(
    carry: Carry, q1: State, p1: State, result: RESULTS, good: Array, residual: Array
) -> tuple[State, State, RESULTS, Array, Array]:
    """State, status, failed step and its residual after a step."""

    def note():
        first = ~good & (carry.result == RESULTS.successful)
        fails = first & (result != RESULTS.stopped)
        return (
            # The state after a failed step is not a result: as NaN it cannot be mistaken for one.
            or_nan(good, q1),
            or_nan(good, p1),
            first_failure(carry.result, result),
            jnp.where(fails, carry.k, carry.failed_step),
            jnp.where(fails, residual, carry.failed_residual),
        )

    def keep():
        return q1, p1, carry.result, carry.failed_step, carry.failed_residual

    # The branch keeps this work out of steps in which nothing fails, which is nearly every step.
    return lax.cond(lanewise.on_any(~good), note, keep)


def _reduced(
    task: Task, carry: Carry, taken: StepTaken, beside: Any, push: Callable | None, h: Scalar
) -> list[Any]:
    """The memories of the reductions after a step with the derivative `push`."""
    _, reductions = task.observables()
    before = task.arithmetic.whole(taken.q0, taken.p0, carry.beside)
    after = task.arithmetic.whole(taken.q1, taken.p1, beside)

    def updated(r: Reduction, memory: Any) -> Any:
        k = number_of(r, carry.k)
        if isinstance(r, Deviations):
            assert push is not None
            return r.update(memory, k, taken.t1, _pushed(push, r.vectors(memory), taken, h))
        function = task.bound(r.function)

        def of(taken, memory):
            return r.update(memory, k, taken.t1, taken.number(function, task.args))

        return task.evaluate(r, of, StepTaken(*taken[:2], *before, *after), memory)

    return [updated(r, memory) for r, memory in zip(reductions, carry.reductions, strict=True)]


def number_of(reduction: Reduction, k: Int[Array, ""]) -> Int[Array, ""]:
    """Number of the value at the end of step k; number 0 is the initial state if it has one."""
    return k + 1 if has_initial_value(reduction.function) else k


def _pushed(push: Callable, vectors: Array, taken: StepTaken, h: Scalar) -> Pushed:
    """Deviation vectors (δq, δp), the rows of `vectors`, after the step; NaN if it has failed."""

    # Vectors are flat, so that observers of deviations need not know the shape of a state.
    def of(vector):
        dq, dp = (x.reshape(taken.q0.shape) for x in jnp.split(vector, 2))
        return jnp.concatenate([x.ravel() for x in push(dq, dp)])

    good = jnp.all(jnp.isfinite(taken.q1)) & jnp.all(jnp.isfinite(taken.p1))
    return Pushed(or_nan(good, jax.vmap(of)(vectors)), h)


def _stop(
    task: Task, carry: Carry, interval: Interval, q1: State, p1: State, result: RESULTS
) -> tuple[RESULTS, Any]:
    """The status and the stored row, after a step that may meet the condition of a `Stop`."""
    if task.stop is None:
        return result, None
    met = event(task.stop.g, interval.t1, q1, p1, task.args) >= 0
    now = (result == RESULTS.successful) & met
    row = as_row(now, Start(interval.t0, interval.t1, interval.t1, carry.q, carry.p))
    return RESULTS.where(now, RESULTS.stopped, result), jnp.where(now, row, carry.stop)


def run(
    task: Task, plan: Plan, carry: Carry, loop: Loop, inner_loop: Callable | None = None
) -> tuple[Carry, Saved, Saved | None]:
    """All steps of `plan`: the carry, the saved values of the blocks, those of the tail (or None).

    `loop` runs over the blocks, `inner_loop` over the steps of one block: the same loop if None,
    else it is given a function as well, the state of a carry.
    """
    alone, _ = task.observables()
    step, opened, closed = _in_loop(task, carry.q)
    carry = opened(carry)

    def over_steps(body, state, count):
        if inner_loop is None:
            return loop(body, state, None, count)
        return inner_loop(body, state, None, count, lambda state: closed(state[0])[1:3])

    has_memory = task.lattice.has_memory

    def last_of(carry, interval, taken):
        # The values of the last step that a save point needs and the carry does not have. Without
        # them the loop has fewer numbers to carry.
        return interval if has_memory else None, (taken.q0, taken.p0) if alone else None

    def body(state, _):
        carry, interval, taken = take_step(task, state[0], step)
        return (carry, last_of(carry, interval, taken)), None

    def steps(carry, _, count=plan.block):
        """The next `count` steps, and the saved values of the last of them."""
        inner, interval = None, task.interval(carry.k + (count - 1))
        if count == 1:  # a loop around one step would take time to compile
            carry, interval, taken = take_step(task, carry, step)
        else:
            before = last_of(carry, interval, StepTaken(*interval[:2], *[carry.q, carry.p] * 2))
            (carry, (now, before)), inner = over_steps(body, (carry, before), count)
            interval = now if has_memory else interval
            q0, p0 = before if alone else (carry.q, carry.p)
            taken = StepTaken(interval.t0, interval.t1, q0, p0, carry.q, carry.p)
        end = closed(carry)
        if end is not carry:
            start = closed(carry._replace(k=carry.k - 1, q=taken.q0, p=taken.p0))
            taken = StepTaken(*taken[:2], start.q, start.p, end.q, end.p)
        observed = task.at_save(carry, taken)
        return carry, Saved(interval.t1, interval.h, end.q, end.p, observed, inner)

    carry, saved = loop(steps, carry, None, plan.num_blocks)
    # The tail is outside of the scan, whose rows all have the same number of steps.
    if not plan.tail:
        return closed(carry), saved, None
    carry, tail = steps(carry, None, plan.tail)
    return closed(carry), saved, tail


def _in_loop(task: Task, q: State) -> tuple[Callable | None, Callable, Callable]:
    """The step in the loop (None: that of the method), and the functions from a carry to that of
    the loop and back."""
    equal = type(task.lattice) is Uniform and task.arithmetic.is_plain and task.stop is None
    quick = None
    # Reductions read the states of all steps.
    if equal and not task.observables()[1]:
        quick = task.method.in_loop(task.equations, task.first_interval(), q)
    if quick is None:
        return None, lambda carry: carry, lambda carry: carry

    def moved(by, carry, k):
        q, p, info = by(task.equations, task.interval(k), carry.q, carry.p)
        good = info.result == RESULTS.successful
        state = _noted(carry, q, p, info.result, good, lax.stop_gradient(info.residual))
        names = "q", "p", "result", "failed_step", "failed_residual"
        return carry._replace(**dict(zip(names, state, strict=True)))

    return (
        quick.step,
        lambda carry: moved(quick.first, carry, carry.k),
        lambda carry: moved(quick.last, carry, carry.k - 1),
    )


def outcome(
    task: Task, plan: Plan, ran: tuple[Carry, Saved, Saved | None], q0: State, p0: State
) -> Outcome:
    """The result of `run`, with the start in front unless `adds_start_outside`."""
    carry, saved, tail = ran
    saved = with_tail(plan, saved, tail)
    if not adds_start_outside(plan):
        saved = with_start(saved, q0, p0)
    return Outcome(carry, saved, reduce(task, carry))


def reduce(task: Task, carry: Carry) -> list[Any]:
    """The reduced values, in tree order."""
    _, reductions = task.observables()
    pairs = zip(reductions, carry.reductions, strict=True)
    return [task.finished(r, memory) for r, memory in pairs]


def with_tail(plan: Plan, saved: Saved, tail: Saved | None) -> Saved:
    """The saved values, those of the end of the tail included if the plan saves it."""
    saved = saved._replace(inner=None)
    if tail is None or not plan.save_tail:
        return saved
    tail = tail._replace(inner=None)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), saved, tail)


def with_start(saved: Saved, q0: State, p0: State) -> Saved:
    """The saved values, the states with the start in front."""
    q, p = (jnp.concatenate([a[None], b]) for a, b in ((q0, saved.q), (p0, saved.p)))
    return saved._replace(q=q, p=p)
