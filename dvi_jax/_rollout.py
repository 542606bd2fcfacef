"""The loop over the steps of a time grid, with status, saved states and observables."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

import lanewise

from ._arithmetic import Arithmetic, FloatingPoint
from ._constraint import start_status
from ._plan import Plan as Plan, make_plan as make_plan, piece_length as piece_length
from ._results import RESULTS, first_failure
from ._step import Equations
from ._types import Args, Bindable, Interval, Scalar, State
from .engine.newton import no_residual, worse
from .engine.pairs import rounded
from .engine.reads import Reads
from .lattices import Lattice, Place
from .methods import Method
from .observe import (
    Deviations,
    Pushed,
    Reduction,
    Running,
    Stop,
    has_initial_value,
    is_observable,
)
from .observe._kept import Start, as_row, event

Loop = Callable[[Callable, Any, None, int], tuple[Any, Any]]
"""``(body, carry, None, count) -> (carry, ys)``: `lax.scan`, or one with another derivative."""


class Task(eqx.Module):
    """The constants of a trajectory."""

    equations: Equations
    method: Method
    lattice: Lattice
    observe: PyTree
    t0: Scalar
    h: Scalar
    arithmetic: Arithmetic = FloatingPoint()
    stop: Stop | None = None
    reads: Reads = eqx.field(static=True, default=())

    @property
    def args(self) -> Args:
        return self.equations.args

    def interval(self, k: Int[Array, ""]) -> Interval:
        """The interval of step k; of a lattice with a memory, of the first step only."""
        return self.in_precision(self.lattice.interval(self.t0, self.h, k))

    def first_interval(self) -> Interval:
        """The interval of step 0."""
        return self.interval(jnp.asarray(0, jnp.int32))

    def in_precision(self, interval: Interval) -> Interval:
        # The times of a user may be float64 where the state is float32, which sets the precision.
        return Interval(*(x.astype(self.h.dtype) for x in interval))

    def observables(self) -> tuple[list[Callable], list[Reduction]]:
        """The functions without a reduction, and the reductions, in tree order."""
        alone = [self.bound(f) for f in self._leaves() if not isinstance(f, Reduction | Running)]
        found = [f.reduction if isinstance(f, Running) else f for f in self._leaves()]
        return alone, [f for f in found if isinstance(f, Reduction)]

    def at_save(self, carry: "Carry", taken: "StepTaken | None") -> list[Any]:
        """The values of functions without a reduction and the running values of reductions, in tree
        order, at a save point after the step `taken`."""
        # A running value is NaN after a failure: the reduction still has that of the steps before.
        memories, values = iter(carry.reductions), []
        for f in self._leaves():
            if isinstance(f, Running):
                value = self.finished(f.reduction, next(memories))
                values.append(_or_nan(carry.result == RESULTS.successful, value))
            elif isinstance(f, Reduction):
                next(memories)
            else:
                assert taken is not None
                values.append(taken.value(self.bound(f), self.args))
        return values

    def evaluate(self, reduction: Reduction, function: Callable, *args: Any) -> Any:
        """``function(*args)``, a part of the reduction, in the arithmetic of the run."""
        # Deviation vectors and recorded steps are values in floating point.
        if isinstance(reduction, Deviations) or not reduction.has_running_value:
            return function(*rounded(args))
        return self.arithmetic.evaluated(function)(*args)

    def finished(self, reduction: Reduction, memory: Any) -> Any:
        """The reduced value of a memory."""
        return rounded(self.evaluate(reduction, reduction.finish, memory))

    def _leaves(self) -> list[Any]:
        return jax.tree.leaves(self.observe, is_leaf=is_observable)

    @property
    def has_running_values(self) -> bool:
        """Whether a reduction has a value at every save point."""
        return any(isinstance(f, Running) for f in self._leaves())

    @property
    def has_deviations(self) -> bool:
        """Whether a reduction follows deviation vectors, for which steps are differentiated."""
        return any(isinstance(r, Deviations) for r in self.observables()[1])

    def bound(self, observable: Callable) -> Callable:
        """The observable, bound to the system and ε if it requires them."""
        if isinstance(observable, Bindable):
            return observable.bind(self.equations.system, self.equations.epsilon)
        return observable


class Carry(NamedTuple):
    """State between steps; k is the number of the next one."""

    k: Int[Array, ""]
    q: State
    p: State
    lattice: Any
    result: RESULTS
    failed_step: Int[Array, ""]
    failed_residual: Float[Array, "2"]
    iterations: Int[Array, ""]
    residual: Float[Array, "2"]
    reductions: list[Any]
    beside: Any = None  # memory of the arithmetic
    stop: Any = None  # with a `Stop`: the last step, as a row


class StepTaken(NamedTuple):
    """One step, the arguments of an observable."""

    t0: Scalar
    t1: Scalar
    q0: State
    p0: State
    q1: State
    p1: State

    def value(self, observable: Callable, args: Args) -> Array:
        return jnp.asarray(observable(*self, args))

    def number(self, observable: Callable, args: Args) -> Array:
        """The value for a reduction, as real numbers also if it is integer or boolean."""
        value = self.value(observable, args)
        if not jnp.issubdtype(value.dtype, jnp.inexact):
            value = value.astype(self.q1.dtype)
        # The barrier keeps a product in the value from being contracted (FMA) with the difference
        # in a reduction: equal values would then have a drift of one rounding error.
        return lax.optimization_barrier(value)


class Saved(NamedTuple):
    """The saved values of a step."""

    t: Array
    h: Array
    q: Array
    p: Array
    observed: list[Any]
    inner: Any = None  # checkpoints since the save point before, for a reversible gradient


class Outcome(NamedTuple):
    """Result of the loop: last carry, saved states with the start in front, reduced observables,
    and the largest error of a reconstructed state if it was requested."""

    carry: Carry
    saved: Saved
    reduced: list[Any]
    round_trip_defect: Array | None = None


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
        q=_or_nan(good, q0),
        p=_or_nan(good, p0),
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


def take_step(task: Task, carry: Carry) -> tuple[Carry, Interval, StepTaken]:
    """The next step of the trajectory, its status and its reductions."""
    place = Place(task.t0, task.h, carry.k, carry.q, carry.p)
    interval, memory, exists = task.lattice.next(carry.lattice, task.equations, place)
    interval = task.in_precision(interval)

    step = task.arithmetic.evaluated(task.method.step)

    def advance(q, p):
        here, *relative = task.arithmetic.enter(task.equations, q, p, carry.beside)
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
            _or_nan(good, q1),
            _or_nan(good, p1),
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
    return Pushed(_or_nan(good, jax.vmap(of)(vectors)), h)


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
    task: Task, plan: Plan, carry: Carry, loop: Loop, inner_loop: Loop | None = None
) -> tuple[Carry, Saved, Saved | None]:
    """All steps of `plan`: the carry, the saved values of the blocks, those of the tail (or None).

    `loop` runs over the blocks, `inner_loop` (the same if None) over the steps of one block.
    """
    inner_loop = loop if inner_loop is None else inner_loop
    alone, _ = task.observables()
    has_memory = task.lattice.has_memory

    def last_of(carry, interval, taken):
        # The values of the last step that a save point needs and the carry does not have. Without
        # them the loop has fewer numbers to carry.
        return interval if has_memory else None, (taken.q0, taken.p0) if alone else None

    def body(state, _):
        carry, interval, taken = take_step(task, state[0])
        return (carry, last_of(carry, interval, taken)), None

    def steps(carry, _, count=plan.block):
        """The next `count` steps, and the saved values of the last of them."""
        inner, interval = None, task.interval(carry.k + (count - 1))
        if count == 1:  # a loop around one step would take time to compile
            carry, interval, taken = take_step(task, carry)
        else:
            before = last_of(carry, interval, StepTaken(*interval[:2], *[carry.q, carry.p] * 2))
            (carry, (now, before)), inner = inner_loop(body, (carry, before), None, count)
            interval = now if has_memory else interval
            q0, p0 = before if alone else (carry.q, carry.p)
            taken = StepTaken(interval.t0, interval.t1, q0, p0, carry.q, carry.p)
        observed = task.at_save(carry, taken)
        return carry, Saved(interval.t1, interval.h, carry.q, carry.p, observed, inner)

    carry, saved = loop(steps, carry, None, plan.num_blocks)
    # The tail is outside of the scan, whose rows all have the same number of steps.
    if not plan.tail:
        return carry, saved, None
    carry, tail = steps(carry, None, plan.tail)
    return carry, saved, tail


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


def adds_start_outside(plan: Plan) -> bool:
    """Whether the start is added to the saved states after the compiled run, not in it."""
    # Among few states the start is a large fraction, which need not be written for a user who reads
    # the last state only. Among many it is a small fraction, and adding it later copies them all.
    return plan.num_blocks <= 4


def with_start(saved: Saved, q0: State, p0: State) -> Saved:
    """The saved values, the states with the start in front."""
    q, p = (jnp.concatenate([a[None], b]) for a, b in ((q0, saved.q), (p0, saved.p)))
    return saved._replace(q=q, p=p)


def _or_nan(good, x):
    return jax.tree.map(lambda x: jnp.where(good, x, jnp.full_like(x, jnp.nan)), x)
