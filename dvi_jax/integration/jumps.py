"""Jumps of the state inside of a step, in the order of time."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

import lanewise

from ..base.results import RESULTS, first_failure
from ..base.types import Args, Interval, Scalar, State
from ..engine.bracket import bracketed_root, divide
from ..methods.step import Equations, StepInfo, info_of
from ..observe import Jump, Jumps
from ..observe._kept import event
from .task import Ends, Task

MOST = 8
"""Maximum number of jumps in one step."""

_ROUNDS = 50
"""Maximum number of evaluations of a search for a maximum of g."""


class JumpMemory(NamedTuple):
    """What the loop carries: g of each jump before the step, ∞ where its first part is ignored, and
    dg/dt; the number of jumps, and their rows."""

    before: list[Scalar]
    slopes: list[Scalar]
    count: Int[Array, ""]
    rows: Array | None


class Part(NamedTuple):
    """The part of a step after its last jump, which begins at a fraction of the step.

    `before`, `after`: g of each jump at its start and end; `rises`, `falls`: dg/dt there, 0 where
    it does not matter any more. `quiet`: fraction of the step up to which g is ignored. `is_over`:
    whether a `Stop` ends the run at (t1, q1, p1).
    """

    fraction: Scalar
    t0: Scalar
    q0: State
    p0: State
    t1: Scalar
    q1: State
    p1: State
    before: list[Scalar]
    after: list[Scalar]
    rises: list[Scalar]
    falls: list[Scalar]
    quiet: list[Scalar]
    args: Args
    info: StepInfo
    is_over: Bool[Array, ""]
    count: Int[Array, ""]

    @property
    def ends(self) -> Ends:
        return Ends(self.t0, self.t1, self.q0, self.p0, self.q1, self.p1)


class Record(NamedTuple):
    """One jump: whether there was one, which, and the point before and after it."""

    exists: Bool[Array, ""]
    index: Int[Array, ""]
    t: Scalar
    q0: State
    p0: State
    q1: State
    p1: State

    def row(self) -> Array:
        states = (x.ravel() for x in self[3:])
        return jnp.concatenate([self.t[None], self.index.astype(self.t.dtype)[None], *states])


def first_memory(task: Task, q: State) -> JumpMemory:
    """The memory before the first step."""
    capacity = sum(jump.capacity for jump in task.jumps)
    rows = jnp.full((capacity, 2 + 4 * q.size), jnp.nan, q.dtype) if capacity else None
    zero = jnp.asarray(0, jnp.int32)
    before, slopes = ([jnp.asarray(x, q.dtype)] * len(task.jumps) for x in (jnp.inf, 0))
    return JumpMemory(before, slopes, zero, rows)


def with_jumps(
    task: Task, equations: Equations, interval: Interval, memory: JumpMemory, step: tuple
) -> tuple[Part, Record | None]:
    """The part of a step after its last jump, and the records of its jumps if they are needed;
    `step` is (q0, p0, q1, p1, info) without jumps."""
    q0, p0, q1, p1, info = step
    args, zero = equations.args if task.changes_args else None, jnp.zeros_like(interval.t0)
    after, falls = _with_slopes(task, equations, interval.t1, q1, p1)
    quiet = [jnp.where(jnp.isinf(x), _quiet(q0), 0.0) for x in memory.before]
    part = Part(
        *(zero, interval.t0, q0, p0, interval.t1, q1, p1),
        *(memory.before, after, memory.slopes, falls, quiet, args, _with_nan(info, after)),
        *(jnp.asarray(False), jnp.asarray(0, jnp.int32)),
    )
    advance = functools.partial(_next_jump, task, equations, interval)
    has_records = task.records_jumps

    def no_jump(part):
        zeros = jax.eval_shape(lambda part: advance(part)[1], part)
        return part, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), zeros)

    def round_of(part, _):
        part, record = lax.cond(
            lanewise.on_any(_is_due(task, interval, part)), advance, no_jump, part
        )
        return part, record if has_records else None

    def jumps(part):
        part, records = lax.scan(round_of, part, None, MOST)
        status = RESULTS.where(
            _is_due(task, interval, part), RESULTS.too_many_jumps, RESULTS.successful
        )
        return _judged(part, status), records

    def none(part):
        records = jax.eval_shape(lambda part: jumps(part)[1], part)
        return part, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), records)

    return lax.cond(lanewise.on_any(_is_due(task, interval, part)), jumps, none, part)


def after_step(memory: JumpMemory, part: Part) -> JumpMemory:
    """The memory with g of each jump at the end of the step."""
    pairs = zip(part.after, part.quiet, strict=True)
    before = [jnp.where(quiet >= 1, jnp.inf, value) for value, quiet in pairs]
    return memory._replace(before=before, slopes=part.falls)


def with_row(memory: JumpMemory, record: Record) -> JumpMemory:
    """The memory with one jump more, if it exists."""
    rows = memory.rows
    if rows is not None:
        # A place beyond the end is dropped, without a branch.
        place = jnp.where(record.exists, memory.count, len(rows))
        rows = rows.at[place].set(record.row(), mode="drop")
    return memory._replace(count=memory.count + record.exists, rows=rows)


def jumps_of(memory: JumpMemory, q: State) -> Jumps:
    """The result of a run."""
    rows = memory.rows
    if rows is None:
        rows = jnp.zeros((0, 2 + 4 * q.size), q.dtype)
    index = jnp.where(jnp.arange(len(rows)) < memory.count, rows[:, 1], -1).astype(jnp.int32)
    states = [x.reshape(-1, *q.shape) for x in jnp.split(rows[:, 2:], 4, axis=1)]
    return Jumps(rows[:, 0], index, *states, memory.count)


def _quiet(like: State) -> float:
    return float(jnp.finfo(like.dtype).eps) ** 0.4


def _values(task: Task, t: Scalar, q: State, p: State, args: Args) -> list[Scalar]:
    args = args if task.changes_args else task.args
    return [event(jump.g, t, q, p, args, "g of Jump") for jump in task.jumps]


def _with_slopes(
    task: Task, equations: Equations, t: Scalar, q: State, p: State
) -> tuple[list[Scalar], list[Scalar]]:
    """g of each jump at a point, and dg/dt along the motion, without a derivative."""
    point, args = (t, q, p), equations.args
    rates = jnp.ones_like(t), *equations.rates(Interval(t, t, jnp.zeros_like(t)), q, p)
    pairs = [
        jax.jvp(lambda *point, g=jump.g: event(g, *point, args, "g of Jump"), point, rates)
        for jump in task.jumps
    ]
    values, slopes = map(list, zip(*pairs, strict=True))
    return values, lax.stop_gradient(slopes)


def _peak(a: Scalar, rise: Scalar, b: Scalar, fall: Scalar) -> tuple[Scalar, Array]:
    """Where between 0 and 1 the tangents at the ends meet, and whether a concave g, which is
    below them, may be positive although it is negative at the ends."""
    theta = (b - fall - a) / (rise - fall)
    is_possible = (rise > 0) & (fall < 0) & (a < 0) & (b < 0) & (a + rise * theta >= 0)
    return theta, is_possible


def _peaks(interval: Interval, part: Part) -> list[Array]:
    """Whether g of each jump may be positive within the part, but not at its ends."""
    length = (1 - part.fraction) * interval.h
    rows = zip(part.before, part.rises, part.after, part.falls, part.quiet, strict=True)
    return [
        _peak(a, length * rise, b, length * fall)[1] & (quiet <= part.fraction)
        for a, rise, b, fall, quiet in rows
    ]


def _highest(evaluate: Callable, part: Part, length: Scalar, flags: list[Array]) -> Any:
    """For each jump with a flag a point of the part where g ≥ 0, if there is one, and g there; else
    its end. `evaluate` returns g and dg/dt of all jumps at a fraction of the part."""
    unit = jnp.ones_like(length)
    brackets = [
        (0 * unit, a, length * rise, unit, b, length * fall)
        for a, rise, b, fall in zip(part.before, part.rises, part.after, part.falls, strict=True)
    ]

    def meets(flag, bracket):
        low, a, rise, high, b, fall = bracket
        width = high - low
        theta, is_possible = _peak(a, rise * width, b, fall * width)
        return low + theta * width, flag & is_possible & (width > jnp.finfo(b.dtype).eps)

    def proceeds(state):
        n, brackets = state
        return (n < _ROUNDS) & _any(meets(*x)[1] for x in zip(flags, brackets, strict=True))

    def narrow(state):
        n, brackets = state
        theta = unit
        for flag, bracket in zip(flags, brackets, strict=True):
            here, is_open = meets(flag, bracket)
            theta = jnp.where(is_open, here, theta)
        values, slopes = evaluate(theta)
        new = []
        for bracket, value, slope in zip(brackets, values, slopes, strict=True):
            low, _, _, high, b, _ = bracket
            point = theta, value, slope * length
            is_inside = (low < theta) & (theta < high) & (b < 0)
            is_right = (value >= 0) | (slope * length <= 0)
            left = where(is_inside & ~is_right, point, bracket[:3])
            new.append((*left, *where(is_inside & is_right, point, bracket[3:])))
        return n + 1, new

    def search(_, x):
        _, ends = lax.while_loop(proceeds, narrow, (0, brackets))
        return x, ([bracket[3] for bracket in ends], [bracket[4] for bracket in ends])

    # A root of nothing: what its search returns next to it has no derivative.
    return lanewise.implicit_root(lambda x: x, 0 * unit, search, divide)[1]


def _with_nan(info: StepInfo, values: list[Scalar]) -> StepInfo:
    is_nan = _any(jnp.isnan(x) for x in values)
    status = RESULTS.where(is_nan, RESULTS.event_not_finite, RESULTS.successful)
    return info._replace(result=first_failure(info.result, status))


def _judged(part: Part, status: RESULTS) -> Part:
    return part._replace(info=part.info._replace(result=first_failure(part.info.result, status)))


def _any(flags: Any) -> Array:
    return functools.reduce(jnp.logical_or, flags)


def _waits(part: Part) -> list[Array]:
    """Whether g of a jump is ignored at the start of the part, but not at its end."""
    return [(quiet > part.fraction) & (quiet < 1) for quiet in part.quiet]


def _is_due(task: Task, interval: Interval, part: Part) -> Array:
    """Whether there may be a jump in the part, or its end must not be reached."""
    flags = []
    each = zip(task.jumps, part.before, part.after, part.quiet, _waits(part), strict=True)
    for jump, before, after, quiet, waits in each:
        is_above = (after >= 0) & (quiet < 1)
        flags.append(is_above if jump.returns else is_above & ((before < 0) | waits))
    is_good = part.info.result == RESULTS.successful
    flags += _peaks(interval, part)
    return _any(flags) & is_good & ~part.is_over


def _next_jump(
    task: Task, equations: Equations, interval: Interval, part: Part
) -> tuple[Part, Record]:
    """The part after the first jump in this one, and the record of it."""
    is_due, waits = _is_due(task, interval, part), _waits(part)
    equations = _with_args(task, equations, part.args)
    length = (1 - part.fraction) * interval.h

    def point(theta):
        h = theta * length
        t = part.t0 + h
        q, p, info = task.method.step(equations, Interval(part.t0, t, h), part.q0, part.p0)
        return (t, q, p), info_of(task.method, info, q, p)

    # A jump that has just been made has g = 0 up to rounding: its g counts from a little later on.
    has_probe = is_due & _any(waits)
    ends = [jnp.where(wait, quiet, 0.0) for wait, quiet in zip(waits, part.quiet, strict=True)]
    latest = functools.reduce(jnp.maximum, ends)
    unit = jnp.ones_like(part.t0)
    probe = jnp.where(has_probe, (latest - part.fraction) / (1 - part.fraction), unit)

    def at_probe(_):
        return _values(task, *point(probe)[0], part.args)

    values = lax.cond(lanewise.on_any(has_probe), at_probe, lambda x: x, part.before)
    starts = [jnp.where(*x) for x in zip(waits, values, part.before, strict=True)]
    peaks = [is_due & flag for flag in _peaks(interval, part)]

    def evaluate(theta):
        return _with_slopes(task, equations, *point(theta)[0])

    def no_peak(_):
        return [unit] * len(peaks), part.after

    tops, at_tops = lax.cond(
        lanewise.on_any(_any(peaks)), lambda _: _highest(evaluate, part, length, peaks), no_peak, 0
    )
    each = zip(starts, at_tops, part.quiet, strict=True)
    candidates = [is_due & (x < 0) & (y >= 0) & (quiet < 1) for x, y, quiet in each]
    exists = _any(candidates)

    def largest(values):
        """The largest g of the candidates, and its index."""
        largest, index = jnp.asarray(-jnp.inf, part.t0.dtype), jnp.asarray(0, jnp.int32)
        for i, (is_candidate, x) in enumerate(zip(candidates, values, strict=True)):
            is_larger = is_candidate & (x > largest)
            largest, index = jnp.where(is_larger, x, largest), jnp.where(is_larger, i, index)
        return largest, index

    def values_at(theta, point):
        each = zip(waits, starts, tops, at_tops, _values(task, *point, part.args), strict=True)
        return [
            jnp.where(wait & (theta < probe), x, jnp.where(theta > end, z, y))
            for wait, x, end, z, y in each
        ]

    def first_of_all(theta):
        return largest(values_at(theta, point(theta)[0]))[0]

    at_ends = largest(starts)[0], largest(at_tops)[0]
    theta = bracketed_root(first_of_all, 0 * unit, at_ends[0], unit, at_ends[1], exists)
    (t, q, p), info = point(theta)
    reached = values_at(theta, (t, q, p))
    value, index = largest(reached)
    # Above the surface from start to end: it was not left, unless another jump comes before.
    blocked = [jnp.asarray(False)]
    for jump, wait, x, y, quiet in zip(
        task.jumps, waits, starts, part.after, part.quiet, strict=True
    ):
        if jump.returns:
            is_early = wait & exists & (theta < probe)
            blocked.append((x >= 0) & (y >= 0) & (quiet < 1) & ~is_early)
    is_blocked = is_due & _any(blocked)
    has_jump = exists & ~is_blocked & (info.result == RESULTS.successful)
    stops = [False, False]
    if task.stop is not None:
        stops[0] = has_jump & (event(task.stop.g, t, q, p, equations.args) >= 0)
    is_made = has_jump & ~jnp.asarray(stops[0])
    new = q, p, part.args
    for i, jump in enumerate(task.jumps):
        mine = is_made & (index == i)
        image = task.constant_unless(mine, functools.partial(_image, task, jump))(
            t, q, p, equations.args
        )
        new = where(mine, image, new)
    q_new, p_new, args = new
    equations = _with_args(task, equations, args)
    if task.stop is not None:
        stops[1] = is_made & (event(task.stop.g, t, q_new, p_new, equations.args) >= 0)
    fraction = part.fraction + theta * (1 - part.fraction)
    start = where(is_made, (fraction, t, q_new, p_new), (part.fraction, *part[1:4]))
    remaining = Interval(start[1], interval.t1, (1 - start[0]) * interval.h)
    q1, p1, last = task.method.step(equations, remaining, *start[2:])
    last = info_of(task.method, last, q1, p1)
    end = interval.t1, q1, p1
    is_over = jnp.asarray(stops[0]) | stops[1]
    end = where(is_over, (t, *where(jnp.asarray(stops[1]), (q_new, p_new), (q, p))), end)
    before, rises = _with_slopes(task, equations, *start[1:])
    # Of jumps at one time one is made first; the others have g = 0 up to rounding.
    below = -jnp.finfo(value.dtype).tiny
    for i, (is_candidate, x) in enumerate(zip(candidates, before, strict=True)):
        is_next = is_candidate & (index != i) & (x >= 0) & (x <= value)
        before[i] = jnp.where(is_next, below, x)
    quiet = [jnp.where(index == i, fraction + _quiet(q), x) for i, x in enumerate(part.quiet)]
    after, falls = _with_slopes(task, equations, interval.t1, q1, p1)
    new_part = Part(
        *(*start, *end, before, after, rises, falls, quiet, args),
        _with_nan(part.info.then(info).then(last), [*reached, *before, *after]),
        is_over,
        part.count + is_made,
    )
    # A state within the step that cannot be computed ends the run.
    failed = part._replace(info=part.info.then(info))
    has_failed = exists & ~is_blocked & ~has_jump
    # A surface that was passed at the last jump: nothing remains to be done in this part.
    settled = [jnp.where(wait, 0.0, x) for wait, x in zip(waits, part.quiet, strict=True)]
    rises = [jnp.where(flag, 0.0, x) for flag, x in zip(peaks, part.rises, strict=True)]
    passed = part._replace(before=starts, quiet=settled, rises=rises)
    chosen = where(has_failed, failed, where(is_due & ~exists, passed, part))
    chosen = where(has_jump, new_part, chosen)
    status = RESULTS.where(is_blocked, RESULTS.not_returned, RESULTS.successful)
    record = Record(is_made, index, t, q, p, q_new, p_new)
    return _judged(chosen, status), record


def _with_args(task: Task, equations: Equations, args: Args) -> Equations:
    return dataclasses.replace(equations, args=args) if task.changes_args else equations


def _image(task: Task, jump: Jump, t: Scalar, q: State, p: State, args: Args) -> tuple:
    """(q, p, args) after a jump, of the types before it; args are None if no jump changes them."""
    q1, p1, *rest = jump.map(t, q, p, args)
    old = q, p, args if task.changes_args else None
    new = q1, p1, rest[0] if rest else old[2]
    return jax.tree.map(lambda x, y: jnp.asarray(x, y.dtype), new, old)


def where(flag: Array, x: Any, y: Any) -> Any:
    """x where the flag is true, else y, of pytrees."""
    return jax.tree.map(lambda x, y: jnp.where(flag, x, y), x, y)
