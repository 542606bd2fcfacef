"""Jumps of the state inside of a step, in the order of time."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

import lanewise

from ..base.results import RESULTS, first_failure
from ..base.types import Args, Interval, Scalar, State
from ..engine.bracket import bracketed_root, divide
from ..methods.step import Equations, StepInfo, info_of
from ..observe import Jumps
from ..observe._kept import event
from .task import Ends, Task

LARGEST_NUMBER = 8
"""Maximum number of jumps in one step."""

Numbers = Float[Array, " jumps"]
"""One number for each `Jump` of a run."""


class JumpMemory(NamedTuple):
    """What the loop carries: g at the start of the step, ∞ where its first part is ignored, and
    dg/dt; the number of jumps, and their rows."""

    at_start: Numbers
    slopes: Numbers
    number: Int[Array, ""]
    rows: Array | None


class Part(NamedTuple):
    """The part of a step after its last jump, which begins at a fraction of the step.

    `at_start`, `at_end`: g there; `rises`, `falls`: dg/dt, 0 where it does not
    matter any more. `quiet`: fraction of the step up to which g is ignored. `is_over`: whether a
    `Stop` ends the run at (t1, q1, p1).
    """

    fraction: Scalar
    t0: Scalar
    q0: State
    p0: State
    t1: Scalar
    q1: State
    p1: State
    at_start: Numbers
    at_end: Numbers
    rises: Numbers
    falls: Numbers
    quiet: Numbers
    args: Args
    info: StepInfo
    is_over: Bool[Array, ""]
    number: Int[Array, ""]

    @property
    def ends(self) -> Ends:
        return Ends(self.t0, self.t1, self.q0, self.p0, self.q1, self.p1)

    def status(self, status: RESULTS) -> "Part":
        """The part, with this status if it has no failure."""
        info = self.info._replace(result=first_failure(self.info.result, status))
        return self._replace(info=info)


class Record(NamedTuple):
    """One jump: whether there was one, which, and the point before and after it."""

    exists: Bool[Array, ""]
    which: Int[Array, ""]
    t: Scalar
    q0: State
    p0: State
    q1: State
    p1: State


def first_memory(task: Task, q: State, p: State) -> JumpMemory:
    """The memory before the first step."""
    capacity = sum(jump.capacity for jump in task.jumps)
    rows = jnp.full((capacity, 2 + 4 * q.size), jnp.nan, q.dtype) if capacity else None
    at_start, slopes = _with_slopes(task, task.equations, task.t0, q, p)
    # A start on a surface up to rounding is no jump; one that is clearly below is observed at once.
    is_clear = at_start < -_quiet(q) * jnp.abs(slopes * task.first_interval().h)
    at_start = jnp.where(is_clear, at_start, jnp.inf)
    return JumpMemory(at_start, slopes, jnp.asarray(0, jnp.int32), rows)


def with_jumps(
    task: Task, equations: Equations, interval: Interval, memory: JumpMemory, step: tuple
) -> tuple[Part, Record | None]:
    """The part of a step after its last jump, and the records of its jumps if they are needed;
    `step` is (q0, p0, q1, p1, info) without jumps."""
    q0, p0, q1, p1, info = step
    args, zero = equations.args if task.changes_args else None, jnp.zeros_like(interval.t0)
    at_end, falls = _with_slopes(task, equations, interval.t1, q1, p1)
    quiet = jnp.where(jnp.isinf(memory.at_start), _quiet(q0), 0.0)
    part = Part(
        *(zero, interval.t0, q0, p0, interval.t1, q1, p1),
        *(memory.at_start, at_end, memory.slopes, falls, quiet, args, info),
        *(jnp.asarray(False), jnp.asarray(0, jnp.int32)),
    )
    part = part.status(_of_values(at_end))
    # The times of jumps are fractions of the step: they have no rounding error of a large t, and
    # the sign of h does not matter.
    is_due = functools.partial(_is_due, task, interval)

    def if_due(function):
        """The function, in a branch that most steps do not take."""

        def skip(part):
            records = jax.eval_shape(lambda part: function(part)[1], part)
            return part, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), records)

        return lambda part: lax.cond(lanewise.on_any(is_due(part)), function, skip, part)

    def next_jump(part):
        part, record = _next_jump(task, equations, interval, part)
        return part, record if task.records_jumps else None

    def all_jumps(part):
        part, records = lax.scan(
            lambda part, _: if_due(next_jump)(part), part, None, LARGEST_NUMBER
        )
        remains = RESULTS.where(is_due(part), RESULTS.too_many_jumps, RESULTS.successful)
        return part.status(remains), records

    return if_due(all_jumps)(part)


def after_step(memory: JumpMemory, part: Part) -> JumpMemory:
    """The memory with g of each jump at the end of the step."""
    at_start = jnp.where(part.quiet >= 1, jnp.inf, part.at_end)
    return memory._replace(at_start=at_start, slopes=part.falls)


def with_row(memory: JumpMemory, record: Record) -> JumpMemory:
    """The memory with one jump more, if it exists."""
    rows = memory.rows
    if rows is not None:
        numbers = record.t, record.which.astype(record.t.dtype)
        row = jnp.concatenate([jnp.stack(numbers), *(x.ravel() for x in record[3:])])
        # A place beyond the end is dropped, without a branch.
        place = jnp.where(record.exists, memory.number, len(rows))
        rows = rows.at[place].set(row, mode="drop")
    return memory._replace(number=memory.number + record.exists, rows=rows)


def jumps_of(memory: JumpMemory, q: State) -> Jumps:
    """The result of a run."""
    rows = jnp.zeros((0, 2 + 4 * q.size), q.dtype) if memory.rows is None else memory.rows
    index = jnp.where(jnp.arange(len(rows)) < memory.number, rows[:, 1], -1).astype(jnp.int32)
    q0, p0, q1, p1 = (x.reshape(-1, *q.shape) for x in jnp.split(rows[:, 2:], 4, axis=1))
    return Jumps(rows[:, 0], index, q0, p0, q1, p1, memory.number)


def _quiet(like: State) -> Scalar:
    """The fraction of a step for which g is ignored after a jump."""
    return jnp.asarray(jnp.finfo(like.dtype).eps ** 0.4, like.dtype)


def _values(task: Task, equations: Equations, *point: Any) -> Numbers:
    """g of each jump at a point."""
    return jnp.stack(
        [event(x.g, *point, args=equations.args, name="g of Jump") for x in task.jumps]
    )


def _with_slopes(task: Task, equations: Equations, t, q, p) -> tuple[Numbers, Numbers]:
    """g of each jump at a point, and dg/dt along the motion, which has no derivative."""
    rates = jnp.ones_like(t), *equations.rates(Interval(t, t, jnp.zeros_like(t)), q, p)
    values, slopes = jax.jvp(functools.partial(_values, task, equations), (t, q, p), rates)
    return values, lax.stop_gradient(slopes)


def _of_values(*values: Numbers) -> RESULTS:
    """The status of values of g."""
    is_nan = jnp.any(jnp.isnan(jnp.concatenate(values)))
    return RESULTS.where(is_nan, RESULTS.event_not_finite, RESULTS.successful)


def _peak(a: Numbers, rise: Numbers, b: Numbers, fall: Numbers) -> tuple[Numbers, Array]:
    """Where between 0 and 1 the tangents at the ends meet, and whether a concave g, which is
    below them, may be positive although it is negative at the ends."""
    theta = (b - fall - a) / (rise - fall)
    return theta, (rise > 0) & (fall < 0) & (a < 0) & (b < 0) & (a + rise * theta >= 0)


def _peaks(interval: Interval, part: Part) -> Array:
    """Whether g of each jump may be positive within the part, but not at its ends."""
    h = (1 - part.fraction) * interval.h
    _, is_possible = _peak(part.at_start, h * part.rises, part.at_end, h * part.falls)
    return is_possible & (part.quiet <= part.fraction)


def _highest(evaluate: Callable, part: Part, h: Scalar, flags: Array) -> tuple[Numbers, Numbers]:
    """For each jump with a flag a fraction of the part where g ≥ 0, if there is one, and g there;
    else its end. `evaluate` returns g and dg/dt of all jumps at a fraction of the part."""
    low, high = jnp.zeros_like(part.at_start), jnp.ones_like(part.at_start)
    ends = (low, part.at_start, h * part.rises), (high, part.at_end, h * part.falls)

    def meeting(state):
        (low, a, rise), (high, b, fall) = state
        width = high - low
        theta, is_possible = _peak(a, rise * width, b, fall * width)
        return low + theta * width, flags & is_possible & (width > jnp.finfo(b.dtype).eps)

    def narrow(state):
        (low, *_), (high, top, _) = state
        theta, is_open = meeting(state)
        theta = jnp.max(jnp.where(is_open, theta, 0.0))
        value, slope = evaluate(theta)
        point = jnp.full_like(value, theta), value, h * slope
        is_inside = (low < theta) & (theta < high) & (top < 0)
        is_end = (value >= 0) | (h * slope <= 0)
        # Between the ends: a point where g falls, or is positive, is the new end.
        return where(is_inside & ~is_end, point, state[0]), where(
            is_inside & is_end, point, state[1]
        )

    def search(_, x):
        _, (_, (high, top, _)) = lax.while_loop(
            lambda state: (state[0] < 50) & jnp.any(meeting(state[1])[1]),
            lambda state: (state[0] + 1, narrow(state[1])),
            (0, ends),
        )
        return x, (high, top)

    # The root of x is 0: what its search returns next to it has no derivative.
    return lanewise.implicit_root(lambda x: x, jnp.zeros_like(h), search, divide)[1]


def _waits(part: Part) -> Array:
    """Whether g of a jump is ignored at the start of the part, but not at its end."""
    return (part.quiet > part.fraction) & (part.quiet < 1)


def _is_due(task: Task, interval: Interval, part: Part) -> Array:
    """Whether there may be a jump in the part, or its end must not be reached."""
    returns = np.array([jump.returns for jump in task.jumps])
    is_above = (
        (part.at_end >= 0) & (part.quiet < 1) & (returns | (part.at_start < 0) | _waits(part))
    )
    is_good = (part.info.result == RESULTS.successful) & ~part.is_over
    return jnp.any(is_above | _peaks(interval, part)) & is_good


def _next_jump(
    task: Task, equations: Equations, interval: Interval, part: Part
) -> tuple[Part, Record]:
    """The part after the first jump in this one, and the record of it."""
    is_due, waits = _is_due(task, interval, part), _waits(part)
    equations = _with_args(task, equations, part.args)
    h, unit = (1 - part.fraction) * interval.h, jnp.ones_like(part.t0)
    numbers = np.arange(len(task.jumps))

    def point(theta):
        t = part.t0 + theta * h
        q, p, info = task.method.step(equations, Interval(part.t0, t, theta * h), *part[2:4])
        return (t, q, p), info_of(task.method, info, q, p)

    # A jump that has just been made has g = 0 up to rounding: its g counts from a little later on.
    has_probe = is_due & jnp.any(waits)
    latest = jnp.max(jnp.where(waits, part.quiet, 0.0))
    probe = jnp.where(has_probe, (latest - part.fraction) / (1 - part.fraction), unit)
    values = lax.cond(
        lanewise.on_any(has_probe),
        lambda _: _values(task, equations, *point(probe)[0]),
        lambda _: part.at_start,
        0,
    )
    start = jnp.where(waits, values, part.at_start)
    peaks = is_due & _peaks(interval, part)
    top, at_top = lax.cond(
        lanewise.on_any(jnp.any(peaks)),
        lambda _: _highest(lambda x: _with_slopes(task, equations, *point(x)[0]), part, h, peaks),
        lambda _: (jnp.ones_like(part.at_end), part.at_end),
        0,
    )
    # Candidates are below their surface first and above it later. The largest of their g is
    # negative at the start and reaches zero where the first of them does: one search is enough.
    candidates = is_due & (start < 0) & (at_top >= 0) & (part.quiet < 1)
    exists = jnp.any(candidates)

    def first_of(values):
        """The largest g of the candidates, and its index."""
        index = jnp.argmax(jnp.where(candidates, values, -jnp.inf))
        return jnp.sum(jnp.where(numbers == index, values, 0.0)), index

    def values_at(theta, point):
        values = jnp.where(theta > top, at_top, _values(task, equations, *point))
        return jnp.where(waits & (theta < probe), start, values)

    ends = first_of(start)[0], first_of(at_top)[0]
    theta = bracketed_root(
        lambda theta: first_of(values_at(theta, point(theta)[0]))[0],
        *(0 * unit, ends[0], unit, ends[1], exists),
    )
    (t, q, p), info = point(theta)
    values = values_at(theta, (t, q, p))
    value, index = first_of(values)
    # Above the surface from start to end: it was not left, unless another jump comes before.
    returns = np.array([jump.returns for jump in task.jumps])
    is_left = (
        (start < 0) | (part.at_end < 0) | (part.quiet >= 1) | (waits & exists & (theta < probe))
    )
    is_beyond = is_due & jnp.any(returns & ~is_left)
    has_jump = exists & ~is_beyond & (info.result == RESULTS.successful)
    is_end = _ends(task, equations, t, q, p) & has_jump
    is_made = has_jump & ~is_end
    # Each map is evaluated at the point of its own jump only as far as derivatives matter: in a
    # batch all are, and one may be singular at the point of another.
    new: Any = q, p, part.args
    for i, jump in enumerate(task.jumps):
        mine = is_made & (index == i)
        image = task.constant_unless(mine, functools.partial(_image, task, jump.map))
        new = where(mine, image(t, q, p, equations.args), new)
    equations = _with_args(task, equations, new[2])
    is_new_end = _ends(task, equations, t, *new[:2]) & is_made
    fraction = part.fraction + theta * (1 - part.fraction)
    # Where no jump is made the step from the start of the part is repeated, which is always finite:
    # a step of length zero may not be, and zero times its derivative would be NaN.
    origin: Any = where(is_made, (fraction, t, *new[:2]), part[:4])
    interval_after = Interval(origin[1], interval.t1, (1 - origin[0]) * interval.h)
    q1, p1, last = task.method.step(equations, interval_after, *origin[2:])
    last = info_of(task.method, last, q1, p1)
    at_start, rises = _with_slopes(task, equations, *origin[1:])
    at_end, falls = _with_slopes(task, equations, interval.t1, q1, p1)
    # Of jumps at one time one is made first; the others have g = 0 up to rounding.
    is_next = candidates & (numbers != index) & (at_start >= 0) & (at_start <= value)
    end = where(is_end, (t, q, p), (interval.t1, q1, p1))
    t1, *state = where(is_new_end, (t, *new[:2]), end)
    with_jump = Part(
        *(*origin, t1, *state),  # pyright: ignore[reportCallIssue]
        *(jnp.where(is_next, -jnp.finfo(t.dtype).tiny, at_start), at_end, rises, falls),
        jnp.where(numbers == index, fraction + _quiet(q), part.quiet),  # pyright: ignore[reportCallIssue]
        *(new[2], part.info.then(info).then(last), is_end | is_new_end, part.number + is_made),
    ).status(_of_values(values, at_start, at_end))
    # Without a jump: a point that cannot be computed ends the run; a surface that was passed at the
    # last jump is one that was not reached.
    has_failed = exists & ~is_beyond & ~has_jump
    remainder = part._replace(
        at_start=start,
        quiet=jnp.where(waits, 0.0, part.quiet),
        rises=jnp.where(peaks, 0.0, part.rises),
        info=where(has_failed, part.info.then(info), part.info),
    )
    part = where(has_jump, with_jump, where(is_due, remainder, part))
    # Last, because nothing else may be changed in a trajectory that has passed a wall.
    status = RESULTS.where(is_beyond, RESULTS.not_returned, RESULTS.successful)
    return part.status(status), Record(is_made, index.astype(jnp.int32), t, q, p, *new[:2])


def _ends(task: Task, equations: Equations, *point: Any) -> Array:
    """Whether a `Stop` ends the run at a point."""
    if task.stop is None:
        return jnp.asarray(False)
    return event(task.stop.g, *point, args=equations.args) >= 0


def _with_args(task: Task, equations: Equations, args: Args) -> Equations:
    return dataclasses.replace(equations, args=args) if task.changes_args else equations


def _image(task: Task, map: Callable[..., Any], *point: Any) -> tuple:
    """(q, p, args) after a jump, of the types before it; args are None if no jump changes them."""
    _, q0, p0, args = point
    old = q0, p0, args if task.changes_args else None
    q1, p1, *parameters = map(*point)
    new = q1, p1, parameters[0] if parameters else old[2]
    return jax.tree.map(lambda value, like: jnp.asarray(value, like.dtype), new, old)


def where(flag: Array, x: Any, y: Any) -> Any:
    """x where the flag is true, else y, of pytrees."""
    return jax.tree.map(lambda x, y: jnp.where(flag, x, y), x, y)
