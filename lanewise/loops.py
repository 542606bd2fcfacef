"""Loops and branches: scan, while, cond; rounds that are first run without rare branches."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .assumed import Assumed, NotAssumable, may_assume, taken_value
from .dependence import fixed_point, reached_outputs
from .ir import Num
from .jaxapi import ClosedJaxpr, Jaxpr, scan_counts
from .memory import Buffer, contiguous, transposed
from .reuse import carried_over
from .values import Value, objects

if TYPE_CHECKING:
    from .components import Evaluator


AGREED = frozenset(["least_over_lanes"])
"""Primitives whose result is the same on all trajectories, whatever goes in."""


_PORTION = 32
"""Rounds of a loop that are run on assumptions before these are looked at."""


class Waiting:
    """Rows of results that wait in fast memory until several are there, and are then written.

    Trajectory after trajectory a result has rows far apart: writing `count` of them at a time fills
    whole cache lines.
    """

    def __init__(self, evaluator: "Evaluator", results: Sequence[Buffer], count: int):
        self.b, self.evaluator, self.results, self.count = evaluator.b, evaluator, results, count
        self.stages = [
            evaluator.kernel.scratch((count, *r.shape[1:]), r.dtype, True) for r in results
        ]

    @classmethod
    def of(cls, evaluator: "Evaluator", results: Sequence[Buffer], length: int) -> "Waiting | None":
        """For results of a loop with `length` rounds, if it is worth while."""
        apart = all(r.lane not in (None, 1) and r.dtype != "bool" for r in results)
        in_order = all(r.strides == contiguous(r.shape) for r in results)
        width = sum(math.prod(r.shape[1:]) for r in results)
        if evaluator.b.W == 1 or not (apart and in_order and 0 < width <= 8):
            return None
        count = 32 if width <= 2 else 16 if width <= 4 else 8
        return cls(evaluator, results, count) if length > count else None

    def rows(self, k: Num, start: Num) -> list[Buffer]:
        """Where round k writes, of a portion that begins with round `start`."""
        b = self.b
        return [s.row(b, b.sub(k, start)) for s in self.stages]

    def write(self, start: Num, stop: Num) -> None:
        """Write the rows start, …, stop − 1 to where they belong."""
        b = self.b
        count = b.known(self.count, "int64")

        def whole() -> list[Num]:
            for stage, result in zip(self.stages, self.results, strict=True):
                transposed(b, stage, result.from_row(b, start))
            return []

        def some() -> list[Num]:
            def row(state, _):
                k = state[0]
                for to, result in zip(self.rows(k, start), self.results, strict=True):
                    value = Value(to.shape, to.dtype, buffer=to)
                    self.evaluator.write(value, result.row(b, k))
                return [b.add(k, b.known(1, "int64"))]

            b.loop(
                [start],
                [False],
                lambda state, _: b.less(state[0], stop),
                row,
            )
            return []

        is_whole = b.compare("eq", b.sub(stop, start), count)
        b.branch(b.ref(is_whole, 0, False), whole, some, [], [])


def _varying(e: "Evaluator", body: Jaxpr, consts, carry, xs) -> list[bool]:
    """Which values that a scan carries, and which that it puts out, differ between
    trajectories, in some round of it."""
    before, after = ([v.has_lanes() for v in values] for values in (consts, xs))

    def outputs(on: list[bool]) -> list[bool]:
        return reached_outputs(body, [*before, *on, *after], AGREED)

    on = fixed_point(lambda on: outputs(on)[: len(on)], [v.has_lanes() for v in carry])
    return [*on, *outputs(on)[len(on) :]]


def _carried(e: "Evaluator", carry: Sequence[Value], on: Sequence[bool]):
    """The numbers of a carry in a row, which of them are vectors, and the way back."""
    numbers, vec, shapes = [], [], []
    for value, lanes in zip(carry, on, strict=True):
        entries = e.entries(value)
        numbers += list(entries.flat)
        vec += [lanes] * value.size
        shapes.append((value.shape, value.dtype, value.size))

    def back(numbers: Sequence[Num]) -> list[Value]:
        values, start = [], 0
        for shape, dtype, size in shapes:
            values.append(Value(shape, dtype, objects(numbers[start : start + size], shape)))
            start += size
        return values

    return numbers, vec, back


def scan(e: "Evaluator", eqn: Any, values: list[Value], places: list) -> list[Value]:
    params, b = eqn.params, e.b
    body: ClosedJaxpr = params["jaxpr"]
    num_consts, num_carry = scan_counts(params)
    length, reverse = params["length"], params["reverse"]
    consts, carry, xs = _cut(values, num_consts, num_carry)
    jaxpr = body.jaxpr
    if length == 0:
        ys = [
            Value(v.aval.shape, v.aval.dtype, np.empty(v.aval.shape, object))
            for v in eqn.outvars[num_carry:]
        ]
        return [*carry, *ys]
    still = [
        o is i
        for o, i in zip(
            jaxpr.outvars[:num_carry],
            jaxpr.invars[num_consts : num_consts + num_carry],
            strict=True,
        )
    ]
    on = _varying(e, jaxpr, consts, carry, xs)
    moving = [c for c, s in zip(carry, still, strict=True) if not s]
    numbers, vec, back = _carried(
        e, moving, [o for o, s in zip(on[:num_carry], still, strict=True) if not s]
    )
    sources = [e.in_memory(x) for x in xs]
    rows = []
    for v, place, o in zip(
        eqn.outvars[num_carry:], places[num_carry:], on[num_carry:], strict=True
    ):
        rows.append(place or e.kernel.scratch(v.aval.shape, str(v.aval.dtype), o))
    end = e.kernel.parameter(length)
    waiting = None if reverse else Waiting.of(e, rows, length)

    def merged(numbers: Sequence[Num]) -> list[Value]:
        of = iter(back(numbers))
        return [c if s else next(of) for c, s in zip(carry, still, strict=True)]

    def round_of(numbers: Sequence[Num], k: Num, start: Num) -> list[Num]:
        if reverse:
            k = b.sub(b.sub(end, b.known(1, "int64")), k)
        slices = []
        for source in sources:
            row = source.row(b, k)
            slices.append(Value(row.shape, source.dtype, buffer=row))
        targets = [r.row(b, k) for r in rows] if waiting is None else waiting.rows(k, start)
        outs = e.jaxpr(
            jaxpr,
            [e.constant(c) for c in body.consts],
            [*consts, *merged(numbers), *slices],
            [*[None] * num_carry, *targets],
        )
        for y, target in zip(outs[num_carry:], targets, strict=True):
            e.write(y, target)
        after = []
        for y, s in zip(outs[:num_carry], still, strict=True):
            if not s:
                after += list(e.entries(y).flat)
        return after

    done = merged(_all_rounds(e, jaxpr, numbers, vec, length, end, round_of, waiting))
    ys = [
        Value(v.aval.shape, v.aval.dtype, buffer=r)
        for v, r in zip(eqn.outvars[num_carry:], rows, strict=True)
    ]
    return [*done, *ys]


def _all_rounds(
    e: "Evaluator",
    jaxpr: Jaxpr,
    numbers: list[Num],
    vec: list[bool],
    length: int,
    end: Num,
    round_of: Callable[[Sequence[Num], Num, Num], list[Num]],
    waiting: Waiting | None,
) -> list[Num]:
    """What is carried after rounds 0, …, end − 1; `round_of(numbers, k, start)` is round k of
    a portion that begins with round `start`."""
    b, zero = e.b, e.b.known(0, "int64")
    with e.assuming(None):
        if length > 1 and may_assume(jaxpr):
            mark = b.mark()
            try:
                return _on_assumptions(e, numbers, vec, length, end, round_of, waiting)
            except NotAssumable:
                b.back_to(mark)
        if waiting is None:
            return _rounds(e, numbers, vec, zero, end, round_of)

        def portion(start: Num, stop: Num, state: Sequence[Num]) -> list[Num]:
            return _rounds(e, state, vec, start, stop, round_of)

        size = b.known(waiting.count, "int64")
        return _portions(e, numbers, vec, size, end, portion, waiting)


def _rounds(e: "Evaluator", numbers, vec, start: Num, end: Num, round_of) -> list[Num]:
    """Rounds start, …, end − 1."""
    b = e.b

    def body(state, _):
        k, *before = state
        return [b.add(k, b.known(1, "int64")), *round_of(before, k, start)]

    return b.loop(
        [start, *numbers], [False, *vec],
        lambda state, _: b.less(state[0], end), body,
    )[1:]  # fmt: skip


def _portions(e: "Evaluator", state, vec, size: Num, end: Num, portion, waiting) -> list[Num]:
    """All rounds, ``portion(start, stop, state)`` by portion, and the rows of each written."""
    b = e.b

    def body(state, _):
        start, *before = state
        stop = b.add(start, size)
        stop = b.select(b.compare("lt", stop, end), stop, end)
        after = portion(start, stop, before)
        if waiting is not None:
            waiting.write(start, stop)
        return [stop, *after]

    return b.loop(
        [b.known(0, "int64"), *state], [False, *vec],
        lambda state, _: b.less(state[0], end), body,
    )[1:]  # fmt: skip


def _on_assumptions(
    e: "Evaluator",
    numbers: list[Num],
    vec: list[bool],
    length: int,
    end: Num,
    round_of: Callable,
    waiting: Waiting | None,
) -> list[Num]:
    """The rounds in portions: first without the branches that are rarely taken; if one should
    have been taken by a trajectory of the block, the portion is repeated with all branches.

    After such a portion, from the second on, some are run with all branches at once.
    """
    b = e.b
    zero, false = b.known(0, "int64"), b.known(False, "bool")
    if waiting is not None:
        size = b.known(waiting.count, "int64")
    else:
        size = e.kernel.parameter(-(-length // -(-length // _PORTION)))
    aside = [e.kernel.scratch((), x.dtype, v).base for x, v in zip(numbers, vec, strict=True)]
    changed: list[bool] = []

    def without_branches(start: Num, stop: Num, numbers: Sequence[Num]) -> list[Num]:
        found = Assumed(b)

        def body(state, _):
            k, failed, *before = state
            with e.assuming(found):
                after = round_of(before, k, start)
            found.leave_to_the_end(before, after)
            changed.extend(x is not y for x, y in zip(before, after, strict=True))
            return [b.add(k, b.known(1, "int64")), found.wrong(failed), *after]

        _, failed, *after = b.loop(
            [start, false, *numbers], [False, False, *vec],
            lambda state, _: b.less(state[0], stop), body,
            carried_over=carried_over,
        )  # fmt: skip
        return [found.wrong_at_the_end(failed, after), *after]

    def portion(start: Num, stop: Num, state: Sequence[Num]) -> list[Num]:
        until, wait, *numbers = state
        tried = b.compare("ge", start, until)
        before_all = len(b.lines)
        all_vec, dtypes = [False, *vec], ["bool", *(x.dtype for x in numbers)]
        failed, *found = b.branch(
            b.ref(tried, 0, False),
            lambda: without_branches(start, stop, numbers),
            lambda: [b.known(True, "bool"), *numbers],
            all_vec, dtypes,
        )  # fmt: skip
        # Numbers that change are stored in memory, so that the rounds have all registers.
        kept = zip(changed, numbers, aside, vec, strict=True)
        b.lines[before_all:before_all] = [
            line for c, x, to, v in kept if c for line in b.set_aside(x, to, v)
        ]

        def again() -> list[Num]:
            kept = zip(changed, numbers, aside, vec, strict=True)
            old = [b.taken_back(x, at, v) if c else x for c, x, at, v in kept]
            return _rounds(e, old, vec, start, stop, round_of)

        found = b.branch(b.ref(failed, 0, False), again, lambda: found, vec, dtypes[1:])
        # After each failure a larger number of rounds is run with all branches.
        has_failed = b.logic("and", tried, failed)
        until = b.select(has_failed, b.add(stop, wait), until)
        wait = b.select(has_failed, b.add(b.add(wait, wait), size), wait)
        return [until, wait, *found]

    both = [False, False, *vec]
    return _portions(e, [zero, zero, *numbers], both, size, end, portion, waiting)[2:]


def while_loop(e: "Evaluator", eqn: Any, values: list[Value], places: list) -> list[Value]:
    """`while`; a condition that is an array says of each of its entries whether that entry of the
    carry, by its leading axes, goes on."""
    params = eqn.params
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    of_test, of_body, carry = _cut(values, params["cond_nconsts"], params["body_nconsts"])
    shape = test.jaxpr.outvars[0].aval.shape
    lanes_of_test = [v.has_lanes() for v in of_test]
    lanes_of_body = [v.has_lanes() for v in of_body]

    def after(on):
        (goes_on,) = reached_outputs(test.jaxpr, [*lanes_of_test, *on], AGREED)
        outs = reached_outputs(body.jaxpr, [*lanes_of_body, *on], AGREED)
        return [goes_on or x for x in outs]

    on = fixed_point(after, [v.has_lanes() for v in carry])
    (per_lane,) = reached_outputs(test.jaxpr, [*lanes_of_test, *on], AGREED)
    numbers, vec, back = _carried(e, carry, on)
    parts = math.prod(shape)
    part = [i * parts // v.size for v in carry for i in range(v.size)]  # of which a number is

    def goes_on(numbers: Sequence[Num]) -> list[Num]:
        (answer,) = e.closed(test, [*of_test, *back(numbers)])
        return list(e.entries(answer).flat)

    def step(numbers: Sequence[Num]) -> list[Num]:
        return [x for v in e.closed(body, [*of_body, *back(numbers)])
                for x in e.entries(v).flat]  # fmt: skip

    if per_lane and e.assumed is not None:
        for going in goes_on(numbers):
            e.assumed.never(going)
        return back([e.b.unrelated(x) for x in numbers])
    with e.assuming(None):
        if per_lane or shape:
            return back(_masked(e, numbers, vec, per_lane, part, goes_on, step))
        end = e.b.loop(
            numbers, vec,
            lambda state, _: e.b.ref(goes_on(state)[0], 0, False),
            lambda state, _: step(state),
        )  # fmt: skip
        return back(end)


def _masked(e: "Evaluator", numbers, vec, per_lane, part, goes_on, step) -> list[Num]:
    """A loop of which every trajectory, or every part of the carry, stops by itself; the block goes
    on while one of them does. `part[i]` is the condition of number i."""
    b = e.b
    first = goes_on(numbers)
    count = len(first)

    def any_goes_on(state, _):
        one = functools.reduce(lambda x, y: b.logic("or", x, y), state[:count])
        return b.any(one) if per_lane else b.ref(one, 0, False)

    def masked(state, _):
        active, numbers = state[:count], state[count:]
        news = step(numbers)
        kept = [
            b.select(active[i], new, old) for i, new, old in zip(part, news, numbers, strict=True)
        ]
        # What a trajectory or a part that has stopped would do next decides nothing.
        of = kept if count > 1 else news
        going = [b.logic("and", x, y) for x, y in zip(active, goes_on(of), strict=True)]
        return [*going, *kept]

    end = b.loop([*first, *numbers], [*[per_lane] * count, *vec], any_goes_on, masked)
    return end[count:]


def cond(e: "Evaluator", eqn: Any, values: list[Value], places: list) -> list[Value]:
    branches = eqn.params["branches"]
    index, operands = values[0], values[1:]
    which = e.entries(index)[()]
    if which.known is not None:
        return e.closed(branches[int(np.clip(which.known, 0, len(branches) - 1))], operands)
    taken = taken_value(which)
    if taken is not None:
        chosen = branches[int(np.clip(taken, 0, len(branches) - 1))]
        return [e.unrelated(v) for v in e.closed(chosen, operands)]
    with e.assuming(None):
        return _branches(e, eqn, which, operands)


def _branches(e: "Evaluator", eqn: Any, which: Num, operands: list[Value]) -> list[Value]:
    branches, b = eqn.params["branches"], e.b
    if which.dtype == "bool":
        which = b.convert(which, "int32")
    flags = [v.has_lanes() for v in operands]
    per_branch = [reached_outputs(x.jaxpr, flags, AGREED) for x in branches]
    on = [which.vec or any(x) for x in zip(*per_branch, strict=True)]
    avals = [v.aval for v in eqn.outvars]
    vec = [o for o, a in zip(on, avals, strict=True) for _ in range(a.size)]
    dtypes = [str(a.dtype) for a in avals for _ in range(a.size)]

    def run(branch):
        def numbers():
            return [x for v in e.closed(branch, operands) for x in e.entries(v).flat]

        return numbers

    last = len(branches) - 1
    takes = []  # whether a branch is taken; the first and the last beyond their index too
    for i in range(len(branches)):
        op = "le" if i == 0 else "ge" if i == last else "eq"
        takes.append(b.compare(op, which, b.known(i, which.dtype)))
    if not which.vec:
        results = _one_of(e, takes, [run(x) for x in branches], vec, dtypes)
    else:
        results: Any = None
        for take, branch in zip(takes, branches, strict=True):
            zeros = [b.known(0, d) for d in dtypes]
            mine = b.branch(b.any(take), run(branch), lambda z=zeros: z, vec, dtypes)
            results = mine if results is None else [
                b.select(take, x, y) for x, y in zip(mine, results, strict=True)
            ]  # fmt: skip
    out, start = [], 0
    for a in avals:
        out.append(e.value(results[start : start + a.size], a))
        start += a.size
    return out


def _one_of(e: "Evaluator", takes, runs, vec, dtypes) -> list[Num]:
    if len(runs) == 1:
        return runs[0]()
    b = e.b
    rest = functools.partial(_one_of, e, takes[1:], runs[1:], vec, dtypes)
    return b.branch(b.ref(takes[0], 0, False), runs[0], rest, vec, dtypes)


def _cut(values: list[Value], first: int, second: int) -> tuple[list, list, list]:
    return values[:first], values[first : first + second], values[first + second :]
