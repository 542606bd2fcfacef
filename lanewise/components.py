"""A jaxpr evaluated number by number into LLVM IR, for a block of trajectories."""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .assumed import Assumed, NotAssumable, may_assume, taken_for, taken_value
from .dependence import fixed_point, reached_outputs
from .ir import TYPES, Builder, Num, Unsupported
from .jaxapi import ClosedJaxpr, Jaxpr, Literal, bodies, scan_counts
from .memory import Buffer, contiguous, load, load_row, store, store_row, transposed
from .reuse import carried_over
from .rules import CALLS, CUMULATIVE, MOVES, REDUCTIONS, VIEWS

Entries = Any
"""An array of `Num`, with dtype object: the types of NumPy cannot say so."""

SMALL = 128
"""Arrays of up to so many elements are numbers of their own; larger ones stay in memory."""

MADE = 4096
"""Arrays made of numbers (a Jacobian) may have so many."""

AGREED = frozenset(["least_over_lanes"])
"""Primitives whose result is the same on all trajectories, whatever goes in."""

_PORTION = 32
"""Rounds of a loop that are run on assumptions before these are looked at."""

MOST_OPERATIONS = 60_000
"""More operations than this are left to XLA, loops counted once."""


class Value:
    """An array on every trajectory: its numbers, or where it is in memory."""

    __slots__ = ("buffer", "dtype", "entries", "is_tangent", "shape")

    def __init__(self, shape, dtype, entries=None, buffer: Buffer | None = None):
        self.shape, self.dtype = tuple(shape), str(dtype)
        self.entries: Entries | None = entries
        self.buffer = buffer
        self.is_tangent = False

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def is_small(self) -> bool:
        return self.entries is not None or self.size <= SMALL

    def has_lanes(self) -> bool:
        if self.entries is not None:
            return any(x.vec for x in self.entries.flat)
        assert self.buffer is not None
        moving = any(isinstance(x, Num) and x.vec for x in self.buffer.offset)
        return self.buffer.lane is not None or moving

    def known(self) -> np.ndarray | None:
        """The numbers, if all of them are known now."""
        if self.entries is None or any(x.known is None for x in self.entries.flat):
            return None
        out = np.empty(self.shape, self.dtype)
        for i in np.ndindex(self.shape):
            out[i] = self.entries[i].known
        return out


def objects(entries: Sequence[Any], shape: Sequence[int]) -> Entries:
    """An object array of these entries, in row-major order."""
    flat = np.empty(len(entries), object)
    for i, entry in enumerate(entries):
        flat[i] = entry
    return flat.reshape(tuple(shape))


class Kernel:
    """What an evaluation needs of the function around it; see `machine`."""

    def scratch(self, shape: Sequence[int], dtype: str, on: bool) -> Buffer:
        raise NotImplementedError

    def constant(self, array: np.ndarray) -> Buffer:
        raise NotImplementedError

    def parameter(self, value: int) -> Num:
        raise NotImplementedError

    def elementary(self, name: str, args: Sequence[Num]) -> Num:
        raise NotImplementedError

    def sincos(self, x: Num) -> tuple[Num, Num]:
        raise NotImplementedError

    def exchanged(self, numbers: Sequence[Num], vec: bool) -> list[Num]:
        raise NotImplementedError


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
        b = evaluator.b
        if (
            b.W == 1
            or not results
            or any(r.lane in (None, 1) or r.dtype == "bool" for r in results)
        ):
            return None
        width = sum(math.prod(r.shape[1:]) for r in results)
        if not all(r.strides == contiguous(r.shape) for r in results) or not 0 < width <= 8:
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


class Evaluator:
    """One evaluation: numbers go through `b`, memory comes from `kernel`."""

    def __init__(self, b: Builder, kernel: Kernel):
        self.b, self.kernel = b, kernel
        self.assumed: Assumed | None = None

    # --- jaxprs ------------------------------------------------------------------------------

    def closed(self, closed: ClosedJaxpr, values, wanted=None) -> list[Value]:
        return self.jaxpr(closed.jaxpr, [self.constant(c) for c in closed.consts], values, wanted)

    def constant(self, array: Any) -> Value:
        array = np.asarray(array)
        dtype = str(array.dtype)
        if dtype not in TYPES:
            raise Unsupported(f"numbers of type {dtype}")
        if array.size > SMALL:
            return Value(array.shape, dtype, buffer=self.kernel.constant(array))
        entries = [self.b.known(x, dtype) for x in array.reshape(-1)]
        return Value(array.shape, dtype, objects(entries, array.shape))

    def jaxpr(
        self,
        jaxpr: Jaxpr,
        consts: Sequence[Value],
        values: Sequence[Value],
        wanted: Sequence[Buffer | None] | None = None,
    ) -> list[Value]:
        """The outputs. `wanted` says where outputs should be written if they are in memory."""
        known: dict[Any, Value] = dict(zip(jaxpr.constvars, consts, strict=True))
        known.update(zip(jaxpr.invars, values, strict=True))
        places = _places(jaxpr, wanted or [None] * len(jaxpr.outvars))

        def read(atom: Any) -> Value:
            if isinstance(atom, Literal):
                return self.constant(np.asarray(atom.val, atom.aval.dtype))  # pyright: ignore[reportAttributeAccessIssue]
            return known[atom]

        both = _sines_and_cosines(jaxpr)
        for eqn in jaxpr.eqns:
            inputs = [read(v) for v in eqn.invars]
            if eqn.primitive.name in ("sin", "cos") and eqn.invars[0] in both:
                outputs = [self.sine_or_cosine(eqn, inputs[0])]
                known.update(zip(eqn.outvars, outputs, strict=True))
                continue
            outputs = self.equation(eqn, inputs, [places.get(v) for v in eqn.outvars])
            if eqn.primitive.name not in _ENDS and any(v.is_tangent for v in inputs):
                outputs = [self.as_tangent(v) for v in outputs]
            known.update(zip(eqn.outvars, outputs, strict=True))
        if self.b.operations > MOST_OPERATIONS:
            raise Unsupported(f"more than {MOST_OPERATIONS} operations a step")
        return [read(v) for v in jaxpr.outvars]

    def sine_or_cosine(self, eqn: Any, value: Value) -> Value:
        """sin x or cos x of an x of which both are needed."""
        which = 0 if eqn.primitive.name == "sin" else 1
        (out,) = eqn.outvars
        if not value.is_small or value.dtype != "float64":
            return self._elementwise(eqn, [value], ELEMENTWISE[eqn.primitive.name])
        found = [self.kernel.sincos(x)[which] for x in self.entries(value).flat]
        return self.value(found, out.aval)

    def equation(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        name = eqn.primitive.name
        special = _SPECIAL.get(name)
        if special is not None:
            return special(self, eqn, values, places)
        if name in CALLS:
            (body,) = bodies(eqn)
            return self.closed(body, values, places)
        if name == "lanewise":
            return self.by_itself(eqn, values)
        for v in eqn.outvars:
            if str(v.aval.dtype) not in TYPES:
                raise Unsupported(f"{name} of type {v.aval.dtype}")
        if name == "reshape" or name in VIEWS:
            seen = self._viewed(eqn, values)
            if seen is not None:
                return seen
        if name == "concatenate" and any(v.entries is None for v in values):
            return [self._joined(eqn, values, places[0])]
        if name in MOVES:
            moved = MOVES[name](*(self.entries(v) for v in values), **eqn.params)
            return self._outputs(eqn, moved if isinstance(moved, tuple) else [moved])
        if name in REDUCTIONS:
            return [self._reduce(eqn, values[0])]
        if name in CUMULATIVE:
            return [self._accumulate(eqn, values[0])]
        rule = ELEMENTWISE.get(name)
        if rule is not None:
            return [self._elementwise(eqn, values, rule)]
        raise Unsupported(f"the primitive {name}")

    def by_itself(self, eqn: Any, values: list[Value]) -> list[Value]:
        """A call within a call: no product in it is contracted with a sum outside, nor the other
        way round, so that its numbers have the same bits wherever it is called."""
        program = eqn.params["program"]
        if eqn.params["lanes"] is not None:
            raise Unsupported("a batch within the function of one trajectory")
        outs = self.closed(program.traced.all_inputs, [self.closed_off(v) for v in values])
        return [self.closed_off(v) for v in outs]

    def unrelated(self, value: Value) -> Value:
        """The same numbers, as they come out of a loop or a branch."""
        new = [self.b.unrelated(x) for x in self.entries(value).flat]
        return Value(value.shape, value.dtype, objects(new, value.shape))

    def closed_off(self, value: Value) -> Value:
        """The same numbers, of which it is not known how they were made."""
        if value.entries is None:
            return value
        new = objects([self.b.opaque(x) for x in value.entries.flat], value.shape)
        return Value(value.shape, value.dtype, new)

    # --- values --------------------------------------------------------------------------------

    def entries(self, value: Value, most: int = MADE) -> Entries:
        """The numbers of an array, read from memory if it is there."""
        if value.entries is not None:
            return value.entries
        buffer = value.buffer
        assert buffer is not None
        if value.size > most:
            raise Unsupported(f"an array of {value.size} elements, which is not taken apart")
        key = ("entries", id(value))
        found = self.b.find(key)
        if found is None:
            found = objects(load_row(self.b, buffer), value.shape)
            self.b.note(key, found)
            self.b.note(("kept", id(value)), value)  # so that no other value gets its id
        return found

    def in_memory(self, value: Value) -> Buffer:
        """Where an array is in memory, written there if it was not."""
        if value.buffer is not None:
            return value.buffer
        assert value.entries is not None
        known = value.known()
        if known is not None:
            return self.kernel.constant(known)
        place = self.kernel.scratch(value.shape, value.dtype, value.has_lanes())
        self.write(value, place)
        return place

    def write(self, value: Value, place: Buffer) -> None:
        """Write an array to a place of its shape."""
        if value.buffer == place:
            return
        if value.entries is not None:
            store_row(self.b, place, list(value.entries.flat))
            return
        source = value.buffer
        assert source is not None
        if value.size <= 16:
            for i in np.ndindex(value.shape):
                store(self.b, place, load(self.b, source, source.at(i)), place.at(i))
            return

        def copy(index: Num) -> None:
            a, c = source.row(self.b, index), place.row(self.b, index)
            self.write(Value(a.shape, value.dtype, buffer=a), c)

        self.count(value.shape[0], copy)

    def count(self, length: int, body: Callable[[Num], None]) -> None:
        """``body(i)`` for i = 0, …, length − 1."""
        b, end = self.b, self.kernel.parameter(length)

        def test(_, i):
            return b.new(f"icmp slt i64 {i}, {end.names[0]}")

        def inner(_, i):
            body(b.made([i], "int64", False))
            return []

        b.loop([], [], test, inner, count=True)

    def _outputs(self, eqn: Any, entries: Sequence[np.ndarray]) -> list[Value]:
        return [
            Value(v.aval.shape, v.aval.dtype, np.asarray(e, object))
            for v, e in zip(eqn.outvars, entries, strict=True)
        ]

    def value(self, entries: Sequence[Num], like: Any) -> Value:
        return Value(like.shape, like.dtype, objects(list(entries), like.shape))

    def as_tangent(self, value: Value) -> Value:
        """A value that is linear in unit vectors: its zeros are zeros by structure."""
        if value.entries is None:
            return value
        b = self.b
        new = objects(
            [
                b.known(0, x.dtype, structural=True) if x.is_float and x.is_known_as(0) else x
                for x in value.entries.flat
            ],
            value.shape,
        )
        out = Value(value.shape, value.dtype, new)
        out.is_tangent = True
        return out

    def _viewed(self, eqn: Any, values: list[Value]) -> list[Value] | None:
        """The outputs as other views of an array in memory, if it is there."""
        (value, *_) = values
        if value.entries is not None or value.size <= SMALL:
            return None
        assert value.buffer is not None
        if eqn.primitive.name == "reshape":
            seen = value.buffer.reshaped(eqn.params["new_sizes"])
            buffers = [seen] if seen is not None else None
        elif eqn.primitive.name in ("split", "unstack"):
            count = len(eqn.outvars)
            buffers = [
                value.buffer.seen(lambda x, i=i: VIEWS[eqn.primitive.name](x, **eqn.params)[i])
                for i in range(count)
            ]
        else:
            buffers = [value.buffer.seen(lambda x: VIEWS[eqn.primitive.name](x, **eqn.params))]
        if buffers is None or any(x is None for x in buffers):
            raise Unsupported(f"{eqn.primitive.name} of an array in memory")
        return [
            Value(v.aval.shape, v.aval.dtype, buffer=x)
            for v, x in zip(eqn.outvars, buffers, strict=True)
        ]

    def _joined(self, eqn: Any, values: list[Value], place: Buffer | None) -> Value:
        """Arrays one after the other, in memory."""
        (out,) = eqn.outvars
        axis = eqn.params["dimension"]
        if place is None:
            on = any(v.has_lanes() for v in values)
            place = self.kernel.scratch(out.aval.shape, str(out.aval.dtype), on)
        for value, part in zip(values, _parts(place, axis, [v.shape for v in values]), strict=True):
            self.write(value, part)
        return Value(out.aval.shape, out.aval.dtype, buffer=place)

    # --- arithmetic ------------------------------------------------------------------------------

    def _elementwise(self, eqn: Any, values: list[Value], rule: Callable) -> Value:
        (out,) = eqn.outvars
        shape, params = out.aval.shape, eqn.params
        if not all(v.is_small for v in values) or math.prod(shape) > MADE:
            return self._in_a_loop(eqn, values, rule)
        operands = [np.broadcast_to(self.entries(v), shape) for v in values]
        results = [rule(self, params, *(x[i] for x in operands)) for i in np.ndindex(*shape)]
        return self.value(results, out.aval)

    def _in_a_loop(self, eqn: Any, values: list[Value], rule: Callable) -> Value:
        """An elementwise primitive on arrays that stay in memory."""
        (out,) = eqn.outvars
        shape = out.aval.shape
        on = any(v.has_lanes() for v in values)
        place = self.kernel.scratch(shape, str(out.aval.dtype), on)
        sources = [v if v.shape == () else self.in_memory(v) for v in values]

        def one(places: list, target: Buffer) -> None:
            if not target.shape:
                numbers = [
                    self.entries(x)[()] if isinstance(x, Value) else load(self.b, x) for x in places
                ]
                store(self.b, target, rule(self, eqn.params, *numbers))
                return
            rows = functools.partial(_row_of, self.b)
            self.count(
                target.shape[0],
                lambda i: one([rows(x, i) for x in places], target.row(self.b, i)),
            )

        one(sources, place)
        return Value(shape, out.aval.dtype, buffer=place)

    def combine(self, op: str, a: Num, b: Num) -> Num:
        """An operation of two, by name."""
        builder = self.b
        if op == "add":
            return builder.logic("or", a, b) if a.dtype == "bool" else builder.add(a, b)
        if op == "mul":
            return builder.logic("and", a, b) if a.dtype == "bool" else builder.mul(a, b)
        if op in ("max", "min"):
            return builder.maximum(a, b, "gt" if op == "max" else "lt")
        return builder.logic(op, a, b)

    def _reduce(self, eqn: Any, value: Value) -> Value:
        (out,) = eqn.outvars
        op, axes = REDUCTIONS[eqn.primitive.name], tuple(eqn.params["axes"])
        if value.size == 0:
            empty = np.empty((0, out.aval.size), value.dtype)
            with np.errstate(all="ignore"):
                neutral = _NEUTRAL[op](value.dtype)
            return self.constant(np.full(out.aval.shape, neutral, empty.dtype))
        rows = np.moveaxis(self.entries(value), axes, range(len(axes)))
        rows = rows.reshape((-1, out.aval.size))
        totals = list(rows[0])
        for row in rows[1:]:
            totals = [self.combine(op, a, c) for a, c in zip(totals, row, strict=True)]
        return self.value(totals, out.aval)

    def _accumulate(self, eqn: Any, value: Value) -> Value:
        (out,) = eqn.outvars
        axis, reverse = eqn.params["axis"], eqn.params["reverse"]
        if value.size == 0:
            return value
        op = CUMULATIVE[eqn.primitive.name]
        front = np.moveaxis(self.entries(value), axis, 0)
        rows = front.reshape((front.shape[0], -1))
        rows = rows[::-1] if reverse else rows
        done = [list(rows[0])]
        for row in rows[1:]:
            done.append([self.combine(op, a, c) for a, c in zip(done[-1], row, strict=True)])
        flat = [entry for row in (done[::-1] if reverse else done) for entry in row]
        return Value(
            out.aval.shape, out.aval.dtype, np.moveaxis(objects(flat, front.shape), 0, axis)
        )

    def dot(self, eqn: Any, values: list[Value], _) -> list[Value]:
        a, c = values
        (out,) = eqn.outvars
        (of_a, of_c), (batch_a, batch_c) = eqn.params["dimension_numbers"]
        dtype = str(out.aval.dtype)
        if a.dtype != dtype or c.dtype != dtype or dtype == "bool":
            raise Unsupported(f"a product of {a.dtype} and {c.dtype} arrays")
        contracted = math.prod(a.shape[i] for i in of_a)
        if out.aval.size * contracted > MADE:
            raise Unsupported(f"a product of {out.aval.size * contracted} terms")
        x = _as_stack_of_matrices(self.entries(a), batch_a, of_a)
        y = _as_stack_of_matrices(self.entries(c), batch_c, of_c)
        results = []
        for rows, columns in zip(x, y, strict=True):
            for row in rows:
                for column in columns:
                    total = self.b.known(0, dtype, structural=contracted > 0)
                    for u, v in zip(row, column, strict=True):
                        total = self.b.add(total, self.b.mul(u, v))
                    results.append(total)
        return [self.value(results, out.aval)]

    # --- loops -------------------------------------------------------------------------------

    def varying(self, body: Jaxpr, consts, carry, xs) -> list[bool]:
        """Which values that a scan carries, and which that it puts out, differ between
        trajectories, in some round of it."""
        before, after = ([v.has_lanes() for v in values] for values in (consts, xs))

        def outputs(on: list[bool]) -> list[bool]:
            return reached_outputs(body, [*before, *on, *after], AGREED)

        on = fixed_point(lambda on: outputs(on)[: len(on)], [v.has_lanes() for v in carry])
        return [*on, *outputs(on)[len(on) :]]

    def _carried(self, carry: Sequence[Value], on: Sequence[bool]):
        """The numbers of a carry in a row, which of them are vectors, and the way back."""
        numbers, vec, shapes = [], [], []
        for value, lanes in zip(carry, on, strict=True):
            entries = self.entries(value)
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

    def scan(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        params, b = eqn.params, self.b
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
        on = self.varying(jaxpr, consts, carry, xs)
        moving = [c for c, s in zip(carry, still, strict=True) if not s]
        numbers, vec, back = self._carried(
            moving, [o for o, s in zip(on[:num_carry], still, strict=True) if not s]
        )
        sources = [self.in_memory(x) for x in xs]
        rows = []
        for v, place, o in zip(
            eqn.outvars[num_carry:], places[num_carry:], on[num_carry:], strict=True
        ):
            rows.append(place or self.kernel.scratch(v.aval.shape, str(v.aval.dtype), o))
        end = self.kernel.parameter(length)
        waiting = None if reverse else Waiting.of(self, rows, length)

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
            outs = self.jaxpr(
                jaxpr,
                [self.constant(c) for c in body.consts],
                [*consts, *merged(numbers), *slices],
                [*[None] * num_carry, *targets],
            )
            for y, target in zip(outs[num_carry:], targets, strict=True):
                self.write(y, target)
            after = []
            for y, s in zip(outs[:num_carry], still, strict=True):
                if not s:
                    after += list(self.entries(y).flat)
            return after

        done = merged(self.rounds(jaxpr, numbers, vec, length, end, round_of, waiting))
        ys = [
            Value(v.aval.shape, v.aval.dtype, buffer=r)
            for v, r in zip(eqn.outvars[num_carry:], rows, strict=True)
        ]
        return [*done, *ys]

    def rounds(
        self, jaxpr: Jaxpr, numbers: list[Num], vec: list[bool], length: int, end: Num,
        round_of: Callable[[Sequence[Num], Num, Num], list[Num]], waiting: Waiting | None,
    ) -> list[Num]:  # fmt: skip
        """What is carried after rounds 0, …, end − 1; `round_of(numbers, k, start)` is round k of
        a portion that begins with round `start`."""
        b, zero = self.b, self.b.known(0, "int64")
        with self.assuming(None):
            if length > 1 and may_assume(jaxpr):
                mark = b.mark()
                try:
                    return self._on_assumptions(numbers, vec, length, end, round_of, waiting)
                except NotAssumable:
                    b.back_to(mark)
            if waiting is None:
                return self._rounds(numbers, vec, zero, end, round_of)

            def portion(start: Num, stop: Num, state: Sequence[Num]) -> list[Num]:
                return self._rounds(state, vec, start, stop, round_of)

            size = b.known(waiting.count, "int64")
            return self._portions(numbers, vec, size, end, portion, waiting)

    def _rounds(self, numbers, vec, start: Num, end: Num, round_of) -> list[Num]:
        """Rounds start, …, end − 1."""
        b = self.b

        def body(state, _):
            k, *before = state
            return [b.add(k, b.known(1, "int64")), *round_of(before, k, start)]

        return b.loop(
            [start, *numbers], [False, *vec],
            lambda state, _: b.less(state[0], end), body,
        )[1:]  # fmt: skip

    def _portions(self, state, vec, size: Num, end: Num, portion, waiting) -> list[Num]:
        """All rounds, ``portion(start, stop, state)`` by portion, and the rows of each written."""
        b = self.b

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
        self, numbers: list[Num], vec: list[bool], length: int, end: Num, round_of: Callable,
        waiting: Waiting | None,
    ) -> list[Num]:  # fmt: skip
        """The rounds in portions: first without the branches that are rarely taken; if one should
        have been taken by a trajectory of the block, the portion is repeated with all branches.

        After such a portion, from the second on, some are run with all branches at once.
        """
        b = self.b
        zero, false = b.known(0, "int64"), b.known(False, "bool")
        if waiting is not None:
            size = b.known(waiting.count, "int64")
        else:
            size = self.kernel.parameter(-(-length // -(-length // _PORTION)))
        aside = [
            self.kernel.scratch((), x.dtype, v).base for x, v in zip(numbers, vec, strict=True)
        ]
        changed: list[bool] = []

        def without_branches(start: Num, stop: Num, numbers: Sequence[Num]) -> list[Num]:
            found = Assumed(b)

            def body(state, _):
                k, failed, *before = state
                with self.assuming(found):
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
            # Numbers that change wait in memory: registers are for the rounds.
            kept = zip(changed, numbers, aside, vec, strict=True)
            b.lines[before_all:before_all] = [
                line for c, x, to, v in kept if c for line in b.set_aside(x, to, v)
            ]

            def again() -> list[Num]:
                kept = zip(changed, numbers, aside, vec, strict=True)
                old = [b.taken_back(x, at, v) if c else x for c, x, at, v in kept]
                return self._rounds(old, vec, start, stop, round_of)

            found = b.branch(b.ref(failed, 0, False), again, lambda: found, vec, dtypes[1:])
            # After a failure more rounds each time are run with all branches.
            has_failed = b.logic("and", tried, failed)
            until = b.select(has_failed, b.add(stop, wait), until)
            wait = b.select(has_failed, b.add(b.add(wait, wait), size), wait)
            return [until, wait, *found]

        both = [False, False, *vec]
        return self._portions([zero, zero, *numbers], both, size, end, portion, waiting)[2:]

    @contextlib.contextmanager
    def assuming(self, assumed: Any):
        """Take branches that are rarely needed for not needed, and note that in `assumed`."""
        before, self.assumed = self.assumed, assumed
        try:
            yield assumed
        finally:
            self.assumed = before

    def while_loop(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        params, b = eqn.params, self.b
        test, body = params["cond_jaxpr"], params["body_jaxpr"]
        of_test, of_body, carry = _cut(values, params["cond_nconsts"], params["body_nconsts"])
        if test.jaxpr.outvars[0].aval.shape:
            raise Unsupported("a while loop with an array for a condition")
        lanes_of_test = [v.has_lanes() for v in of_test]
        lanes_of_body = [v.has_lanes() for v in of_body]

        def after(on):
            (goes_on,) = reached_outputs(test.jaxpr, [*lanes_of_test, *on], AGREED)
            outs = reached_outputs(body.jaxpr, [*lanes_of_body, *on], AGREED)
            return [goes_on or x for x in outs]

        on = fixed_point(after, [v.has_lanes() for v in carry])
        (per_lane,) = reached_outputs(test.jaxpr, [*lanes_of_test, *on], AGREED)
        numbers, vec, back = self._carried(carry, on)

        def goes_on(carry: list[Value]) -> Num:
            (answer,) = self.closed(test, [*of_test, *carry])
            return self.entries(answer)[()]

        def step(carry: list[Value]) -> list[Num]:
            return [x for v in self.closed(body, [*of_body, *carry])
                    for x in self.entries(v).flat]  # fmt: skip

        if per_lane and self.assumed is not None:
            self.assumed.never(goes_on(back(numbers)))
            return back([b.unrelated(x) for x in numbers])
        with self.assuming(None):
            return back(self._while(numbers, vec, per_lane, back, goes_on, step))

    def _while(self, numbers, vec, per_lane: bool, back, goes_on, step) -> list[Num]:
        b = self.b
        if not per_lane:
            return b.loop(
                numbers, vec,
                lambda state, _: b.ref(goes_on(back(state)), 0, False),
                lambda state, _: step(back(state)),
            )  # fmt: skip

        # Every trajectory stops by itself; the block goes on while one of them does.
        def masked(state, _):
            active, numbers = state[0], state[1:]
            news = step(back(numbers))
            going = b.logic("and", active, goes_on(back(news)))
            kept = [b.select(active, new, old) for new, old in zip(news, numbers, strict=True)]
            return [going, *kept]

        first = goes_on(back(numbers))
        end = b.loop([first, *numbers], [True, *vec], lambda state, _: b.any(state[0]), masked)
        return end[1:]

    def cond(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        branches = eqn.params["branches"]
        index, operands = values[0], values[1:]
        which = self.entries(index)[()]
        if which.known is not None:
            return self.closed(branches[int(np.clip(which.known, 0, len(branches) - 1))], operands)
        taken = taken_value(which)
        if taken is not None:
            chosen = branches[int(np.clip(taken, 0, len(branches) - 1))]
            return [self.unrelated(v) for v in self.closed(chosen, operands)]
        with self.assuming(None):
            return self._branches(eqn, which, operands)

    def _branches(self, eqn: Any, which: Num, operands: list[Value]) -> list[Value]:
        branches, b = eqn.params["branches"], self.b
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
                return [x for v in self.closed(branch, operands) for x in self.entries(v).flat]

            return numbers

        last = len(branches) - 1
        takes = []  # whether a branch is taken; the first and the last beyond their index too
        for i in range(len(branches)):
            op = "le" if i == 0 else "ge" if i == last else "eq"
            takes.append(b.compare(op, which, b.known(i, which.dtype)))
        if not which.vec:
            results = self._one_of(takes, [run(x) for x in branches], vec, dtypes)
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
            out.append(self.value(results[start : start + a.size], a))
            start += a.size
        return out

    def _one_of(self, takes, runs, vec, dtypes) -> list[Num]:
        if len(runs) == 1:
            return runs[0]()
        b = self.b
        rest = functools.partial(self._one_of, takes[1:], runs[1:], vec, dtypes)
        return b.branch(b.ref(takes[0], 0, False), runs[0], rest, vec, dtypes)

    # --- linear systems ---------------------------------------------------------------------------

    def linear_solve(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        """custom_linear_solve: what it solves with."""
        lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
        start = lengths.matvec + lengths.vecmat
        consts = values[start : start + lengths.solve]
        b = values[sum(lengths) :]
        return self.closed(jaxprs.solve, [*consts, *b])

    def eliminate(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        """A dense system, by elimination; rows are exchanged on trajectories that need it."""
        b, (matrix, vector) = self.b, values
        if matrix.size > MADE // 4:
            raise Unsupported(f"a linear system with {vector.size} unknowns")
        rows = [
            [*row, x] for row, x in zip(self.entries(matrix), self.entries(vector), strict=True)
        ]
        numbers = [x for row in rows for x in row]
        vec = any(x.vec for x in numbers)
        found, weak = self._without_exchanges([list(r) for r in rows])
        if weak.known is not None and not weak.known:
            return [self.value(found, eqn.outvars[0].aval)]
        if self.assumed is not None:
            self.assumed.never(weak)
            return [self.value([b.unrelated(x) for x in found], eqn.outvars[0].aval)]

        def exchanged() -> list[Num]:
            others = self.kernel.exchanged(numbers, vec)
            return [b.select(weak, x, y) for x, y in zip(others, found, strict=True)]

        n = len(found)
        chosen = b.branch(b.any(weak), exchanged, lambda: found, [vec] * n, [vector.dtype] * n)
        return [self.value(chosen, eqn.outvars[0].aval)]

    def _without_exchanges(self, rows: list[list[Num]]) -> tuple[list[Num], Num]:
        """The solution, zeros of the structure left out, and whether a pivot was too small."""
        b, n = self.b, len(rows)
        weak = b.known(False, "bool")
        dtype = rows[0][0].dtype
        limit = b.known(_LARGEST_FACTOR, dtype)
        for c in range(n):
            one_over = b.div(b.known(1, dtype, structural=True), rows[c][c])
            for i in range(c + 1, n):
                if rows[i][c].is_known_as(0):
                    continue
                factor = b.mul(rows[i][c], one_over)
                # Not "larger than": NaN is weak too.
                fine = b.compare("le", b.abs(factor), limit)
                weak = b.logic("or", weak, b.invert(fine))
                for j in range(c + 1, n + 1):
                    rows[i][j] = b.sub(rows[i][j], b.mul(factor, rows[c][j]))
            rows[c][c] = one_over
        x: list[Any] = [None] * n
        for i in reversed(range(n)):
            total = rows[i][n]
            for j in range(i + 1, n):
                total = b.sub(total, b.mul(rows[i][j], x[j]))
            x[i] = b.mul(total, rows[i][i])
        return x, weak

    def with_exchanges(self, rows: list[list[Num]]) -> list[Num]:
        """The solution by elimination with partial pivoting, exchanges by selection."""
        b, n = self.b, len(rows)
        for c in range(n):
            for i in range(c + 1, n):
                larger = b.compare("gt", b.abs(rows[i][c]), b.abs(rows[c][c]))
                for j in range(c, n + 1):
                    upper, lower = rows[c][j], rows[i][j]
                    rows[c][j] = b.select(larger, lower, upper)
                    rows[i][j] = b.select(larger, upper, lower)
            for i in range(c + 1, n):
                factor = b.div(rows[i][c], rows[c][c])
                for j in range(c + 1, n + 1):
                    rows[i][j] = b.sub(rows[i][j], b.mul(factor, rows[c][j]))
        x: list[Any] = [None] * n
        for i in reversed(range(n)):
            total = rows[i][n]
            for j in range(i + 1, n):
                total = b.sub(total, b.mul(rows[i][j], x[j]))
            x[i] = b.div(total, rows[i][i])
        return x

    def unit_vectors(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        n, dtype = eqn.params["n"], str(eqn.params["dtype"])
        numbers = [
            self.b.known(int(i == j), dtype, structural=True) for i in range(n) for j in range(n)
        ]
        value = self.value(numbers, eqn.outvars[0].aval)
        value.is_tangent = True
        return [value]

    def agreed(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        """The least of an integer over the trajectories of a block."""
        b, x = self.b, self.entries(values[0])[()]
        if self.assumed is not None and eqn.params["rare"]:
            return [self.value([self.assumed.least(x)], eqn.outvars[0].aval)]
        if not x.vec:
            return values
        if not eqn.params["rare"]:  # one of so many will need it
            return [self.value([taken_for(b, 0, x.dtype)], eqn.outvars[0].aval)]
        t, full = b.type(x.dtype, True), b.suffix(x.dtype, True)
        total = x.names[0]
        for other in x.names[1:]:
            less = b.new(f"icmp slt {t} {total}, {other}")
            bits = b.type("bool", True)
            total = b.new(f"select {bits} {less}, {t} {total}, {t} {other}")
        if b.W > 1:
            b.declare(f"{TYPES[x.dtype]} @llvm.vector.reduce.smin.{full}({t})")
            total = b.new(f"call {TYPES[x.dtype]} @llvm.vector.reduce.smin.{full}({t} {total})")
        return [self.value([b.made([total], x.dtype, False)], eqn.outvars[0].aval)]

    # --- numbers, indices -------------------------------------------------------------------------

    def iota(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        params = eqn.params
        shape, axis = params["shape"], params["dimension"]
        line = np.arange(shape[axis], dtype=params["dtype"])
        other = [1] * len(shape)
        other[axis] = shape[axis]
        return [self.constant(np.broadcast_to(line.reshape(other), shape))]

    def same(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        return values

    def argument_of(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        """argmax, argmin: the first of the largest, or the first NaN."""
        (value,), b = values, self.b
        (out,) = eqn.outvars
        (axis,) = eqn.params["axes"]
        op = "gt" if eqn.primitive.name == "argmax" else "lt"
        rows = np.moveaxis(self.entries(value), axis, 0).reshape((value.shape[axis], -1))
        dtype, results = str(out.aval.dtype), []
        for column in rows.T:
            best, where = column[0], b.known(0, dtype)
            for i, x in enumerate(column[1:], 1):
                better = b.compare(op, x, best)
                if x.is_float:  # a NaN is larger than all, and the first of them stays
                    nan = b.logic("and", b.is_nan(x), b.invert(b.is_nan(best)))
                    better = b.logic("or", better, nan)
                best = b.select(better, x, best)
                where = b.select(better, b.known(i, dtype), where)
            results.append(where)
        return [self.value(results, out.aval)]

    def index(self, x: Num) -> Num:
        return self.b.convert(x, "int64")

    def clipped(self, x: Num, most: int) -> Num:
        b = self.b
        low = b.maximum(x, b.known(0, "int64"))
        return b.maximum(low, b.known(most, "int64"), "lt")

    def pick(self, value: Value, index: Num) -> Num:
        """The element at a row-major index that lies inside of the array."""
        b = self.b
        if index.known is not None and value.entries is not None:
            return value.entries.flat[int(index.known)]
        if value.entries is not None and value.size <= 8:
            result = value.entries.flat[0]
            for i in range(1, value.size):
                here = b.compare("eq", index, b.known(i, "int64"))
                result = b.select(here, value.entries.flat[i], result)
            return result
        buffer = self.in_memory(value)
        flat = buffer.reshaped((buffer.size,))
        if flat is None:
            raise Unsupported("an index into an array that is not contiguous in memory")
        return load(b, flat, b.mul(index, b.known(flat.strides[0], "int64")))

    def dynamic_slice(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        value, *starts = values
        (out,) = eqn.outvars
        b, sizes = self.b, eqn.params["slice_sizes"]
        at = [
            self.clipped(self.index(self.entries(s)[()]), n - m)
            for s, n, m in zip(starts, value.shape, sizes, strict=True)
        ]
        if value.entries is None and not value.is_small:
            buffer = value.buffer
            assert buffer is not None
            for start, stride in zip(at, buffer.strides, strict=True):
                buffer = buffer.moved(b.mul(start, b.known(stride, "int64")))
            buffer = dataclasses.replace(buffer, shape=tuple(sizes))
            return [Value(sizes, value.dtype, buffer=buffer)]
        value = Value(value.shape, value.dtype, self.entries(value), value.buffer)
        strides = contiguous(value.shape)
        results = []
        for i in np.ndindex(tuple(sizes)):
            total = b.known(0, "int64")
            for start, k, stride in zip(at, i, strides, strict=True):
                place = b.add(start, b.known(k, "int64"))
                total = b.add(total, b.mul(place, b.known(stride, "int64")))
            results.append(self.pick(value, total))
        return [self.value(results, out.aval)]

    def dynamic_update_slice(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        value, update, *starts = values
        b = self.b
        at = [
            self.clipped(self.index(self.entries(s)[()]), n - m)
            for s, n, m in zip(starts, value.shape, update.shape, strict=True)
        ]
        entries = self.entries(value).copy()
        if value.size * update.size > MADE:
            raise Unsupported(f"an update at a traced index of {value.size} elements")
        news = self.entries(update)
        for i in np.ndindex(value.shape):
            for k in np.ndindex(update.shape):
                if any(not 0 <= x - y <= n - m for x, y, n, m in
                       zip(i, k, value.shape, update.shape, strict=True)):  # fmt: skip
                    continue
                here = b.known(True, "bool")
                for start, x, y in zip(at, i, k, strict=True):
                    here = b.logic("and", here, b.compare("eq", start, b.known(x - y, "int64")))
                entries[i] = b.select(here, news[k], entries[i])
        return [Value(value.shape, value.dtype, entries)]

    def gather(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        value, indices = values
        (out,) = eqn.outvars
        b, params = self.b, eqn.params
        dims, sizes = params["dimension_numbers"], params["slice_sizes"]
        mode, shape = str(params["mode"]), out.aval.shape
        starts = self.entries(indices)
        collapsed = (*dims.collapsed_slice_dims, *dims.operand_batching_dims)
        window = [d for d in range(len(value.shape)) if d not in collapsed]
        batch = [d for d in range(len(shape)) if d not in dims.offset_dims]
        strides = contiguous(value.shape)
        small = Value(value.shape, value.dtype, value.entries, value.buffer)
        if value.is_small:
            small.entries = self.entries(value)
        fill = params["fill_value"]
        if fill is None:
            fill = np.nan if np.issubdtype(value.dtype, np.floating) else (
                True if value.dtype == "bool" else
                np.iinfo(value.dtype).min if np.issubdtype(value.dtype, np.signedinteger)
                else np.iinfo(value.dtype).max
            )  # fmt: skip
        results = []
        for o in np.ndindex(*shape):
            where = tuple(o[d] for d in batch)
            total, inside = b.known(0, "int64"), b.known(True, "bool")
            for d, offset in zip(window, (o[d] for d in dims.offset_dims), strict=True):
                total = b.add(total, b.known(offset * strides[d], "int64"))
            for d, k in zip(dims.operand_batching_dims, dims.start_indices_batching_dims,
                            strict=True):  # fmt: skip
                total = b.add(total, b.known(where[k] * strides[d], "int64"))
            for j, d in enumerate(dims.start_index_map):
                start, most = self.index(starts[(*where, j)]), value.shape[d] - sizes[d]
                clipped = self.clipped(start, most)
                if "fill" in mode.lower():
                    inside = b.logic("and", inside, b.compare("eq", clipped, start))
                total = b.add(total, b.mul(clipped, b.known(strides[d], "int64")))
            number = self.pick(small, total)
            results.append(b.select(inside, number, b.known(fill, value.dtype)))
        return [self.value(results, out.aval)]

    def scatter(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        value, indices, updates = values
        b, params = self.b, eqn.params
        dims, mode = params["dimension_numbers"], str(params["mode"]).lower()
        op = {"scatter": None, "scatter-add": "add", "scatter_add": "add", "scatter-sub": "sub",
              "scatter_mul": "mul", "scatter-mul": "mul", "scatter_max": "max",
              "scatter-max": "max", "scatter_min": "min", "scatter-min": "min",
              }[eqn.primitive.name]  # fmt: skip
        entries, news = self.entries(value).copy(), self.entries(updates)
        starts = self.entries(indices)
        inserted = (*dims.inserted_window_dims, *dims.operand_batching_dims)
        window = [d for d in range(len(value.shape)) if d not in inserted]
        batch = [d for d in range(len(updates.shape)) if d not in dims.update_window_dims]
        sizes = dict.fromkeys(range(len(value.shape)), 1)
        for d, k in zip(window, dims.update_window_dims, strict=True):
            sizes[d] = updates.shape[k]
        if value.size * updates.size > 4 * MADE:
            raise Unsupported(f"a scatter into {value.size} elements")

        def updated(old: Num, new: Num) -> Num:
            if op is None:
                return new
            return b.sub(old, new) if op == "sub" else self.combine(op, old, new)

        for k in np.ndindex(updates.shape):
            where = tuple(k[d] for d in batch)
            fixed = dict.fromkeys(range(len(value.shape)), 0)
            for d, offset in zip(window, (k[d] for d in dims.update_window_dims), strict=True):
                fixed[d] = offset
            for d, j in zip(dims.operand_batching_dims, dims.scatter_indices_batching_dims,
                            strict=True):  # fmt: skip
                fixed[d] = where[j]
            moving, inside = {}, b.known(True, "bool")
            for j, d in enumerate(dims.scatter_dims_to_operand_dims):
                start, most = self.index(starts[(*where, j)]), value.shape[d] - sizes[d]
                clipped = self.clipped(start, most)
                if "clip" not in mode:
                    inside = b.logic("and", inside, b.compare("eq", clipped, start))
                moving[d] = clipped
            if inside.known is not None and not inside.known:
                continue
            for i in np.ndindex(value.shape):
                here = inside
                for d, x in enumerate(i):
                    at = b.known(x - fixed[d], "int64")
                    start = moving.get(d, b.known(0, "int64"))
                    here = b.logic("and", here, b.compare("eq", start, at))
                    if here.known is not None and not here.known:
                        break
                else:
                    entries[i] = b.select(here, updated(entries[i], news[k]), entries[i])
        return [Value(value.shape, value.dtype, entries)]


_NEUTRAL: dict[str, Callable[[str], Any]] = {
    "add": lambda dtype: np.zeros((), dtype),
    "mul": lambda dtype: np.ones((), dtype),
    "max": lambda dtype: _limit(dtype, "min"),
    "min": lambda dtype: _limit(dtype, "max"),
    "and": lambda dtype: np.invert(np.zeros((), dtype)),
    "or": lambda dtype: np.zeros((), dtype),
    "xor": lambda dtype: np.zeros((), dtype),
}
"""What a reduction of nothing gives."""


def _limit(dtype: str, which: str) -> Any:
    if dtype == "bool":
        return which == "max"
    if np.issubdtype(dtype, np.floating):
        return np.inf if which == "max" else -np.inf
    return getattr(np.iinfo(dtype), which)


_LARGEST_FACTOR = 8.0
"""Of a row that is subtracted from another without an exchange."""


def _row_of(b: Builder, x: Any, index: Num) -> Any:
    if isinstance(x, Value):  # one number for all elements
        return x
    if x.shape[0] == 1:
        index = b.known(0, "int64")
    return x.row(b, index)


def _parts(place: Buffer, axis: int, shapes: Sequence[tuple[int, ...]]) -> list[Buffer]:
    """The parts of a place along one axis."""
    parts, start = [], 0
    for shape in shapes:
        front = (slice(None),) * axis
        part = place.seen(lambda x, s=start, n=shape[axis], f=front: x[(*f, slice(s, s + n))])
        assert part is not None
        parts.append(part)
        start += shape[axis]
    return parts


def _places(jaxpr: Jaxpr, wanted: Sequence[Buffer | None]) -> dict[Any, Buffer]:
    """Where variables are to be written so that the outputs are where they are wanted."""
    places: dict[Any, Buffer] = {}
    for v, place in zip(jaxpr.outvars, wanted, strict=True):
        if place is not None and not isinstance(v, Literal):
            places.setdefault(v, place)
    if not places:
        return places
    for eqn in reversed(jaxpr.eqns):
        place = places.get(eqn.outvars[0]) if len(eqn.outvars) == 1 else None
        if place is None:
            continue
        name = eqn.primitive.name
        if name == "concatenate":
            shapes = [v.aval.shape for v in eqn.invars]  # pyright: ignore[reportAttributeAccessIssue]
            parts = _parts(place, eqn.params["dimension"], shapes)
            for v, part in zip(eqn.invars, parts, strict=True):
                if not isinstance(v, Literal):
                    places.setdefault(v, part)
        elif name in ("reshape", "squeeze", "expand_dims"):
            (v, *_) = eqn.invars
            part = place.reshaped(v.aval.shape)  # pyright: ignore[reportAttributeAccessIssue]
            if part is not None and not isinstance(v, Literal):
                places.setdefault(v, part)
    return places


def _cut(values: list[Value], first: int, second: int) -> tuple[list, list, list]:
    return values[:first], values[first : first + second], values[first + second :]


def _as_stack_of_matrices(x, batch: Sequence[int], contracted: Sequence[int]) -> np.ndarray:
    """x as (batch, free, contracted)."""
    free = [i for i in range(x.ndim) if i not in (*batch, *contracted)]
    sizes = [math.prod(x.shape[i] for i in axes) for axes in (batch, free, contracted)]
    return np.transpose(x, (*batch, *free, *contracted)).reshape(sizes)


def _sines_and_cosines(jaxpr: Jaxpr) -> set[Any]:
    """The variables of which a jaxpr takes the sine and the cosine."""
    of = {
        name: {e.invars[0] for e in jaxpr.eqns if e.primitive.name == name}
        for name in ("sin", "cos")
    }
    return of["sin"] & of["cos"]


_ENDS = frozenset(["custom_linear_solve", "eliminate"])
"""What uses a Jacobian up: its result is no tangent any more."""

_SPECIAL: dict[str, Callable] = {
    "scan": Evaluator.scan,
    "while": Evaluator.while_loop,
    "cond": Evaluator.cond,
    "custom_linear_solve": Evaluator.linear_solve,
    "unit_vectors": Evaluator.unit_vectors,
    "least_over_lanes": Evaluator.agreed,
    "eliminate": Evaluator.eliminate,
    "dot_general": Evaluator.dot,
    "iota": Evaluator.iota,
    "optimization_barrier": Evaluator.same,
    **dict.fromkeys(
        ["lanes_in_front", "reshard", "sharding_constraint", "mesh_cast"], Evaluator.same
    ),
    "argmax": Evaluator.argument_of,
    "argmin": Evaluator.argument_of,
    "dynamic_slice": Evaluator.dynamic_slice,
    "dynamic_update_slice": Evaluator.dynamic_update_slice,
    "gather": Evaluator.gather,
    **dict.fromkeys(
        ["scatter", "scatter-add", "scatter_add", "scatter-sub", "scatter_mul", "scatter-mul",
         "scatter_max", "scatter-max", "scatter_min", "scatter-min"],
        Evaluator.scatter,
    ),
}  # fmt: skip


# --- elementwise primitives: rule(evaluator, parameters, *numbers) → number ----------------------


def _binary(method: str) -> Callable:
    return lambda e, _, a, b: getattr(e.b, method)(a, b)


def _compared(op: str) -> Callable:
    return lambda e, _, a, b: e.b.compare(op, a, b)


def _equal(e: Evaluator, _: Any, x: Num, y: Num) -> Num:
    """A loop's counter equals a given number in one round: taken for rare."""
    same = e.b.compare("eq", x, y)
    # What is the same on all trajectories of a batch and changes is a counter.
    is_count = e.b.W > 1 and taken_value(same) is None and not same.vec and not x.is_float
    if e.assumed is not None and is_count and (x.known is not None or y.known is not None):
        e.assumed.never(same)
        return taken_for(e.b, 0, "bool")
    return same


def _select(e: Evaluator, _: Any, which: Num, *cases: Num) -> Num:
    b = e.b
    if which.dtype == "bool":
        taken = None if which.known is not None else taken_value(which)
        if taken is not None:
            return b.unrelated(cases[int(taken)])
        return b.select(which, cases[1], cases[0])
    result = cases[-1]
    for i in reversed(range(len(cases) - 1)):
        result = b.select(b.compare("le", which, b.known(i, which.dtype)), cases[i], result)
    return result


def _clamp(e: Evaluator, _: Any, low: Num, x: Num, high: Num) -> Num:
    return e.b.maximum(e.b.maximum(x, low), high, "lt")


def _sign(e: Evaluator, _: Any, x: Num) -> Num:
    b, zero = e.b, e.b.known(0, x.dtype)
    if x.dtype.startswith("u"):
        return b.select(b.compare("eq", x, zero), zero, b.known(1, x.dtype))
    one = b.select(b.compare("gt", x, zero), b.known(1, x.dtype), x)
    return b.select(b.compare("lt", x, zero), b.known(-1, x.dtype), one)


def _rounded(e: Evaluator, params: dict, x: Num) -> Num:
    if not x.is_float:
        return x
    away = int(params["rounding_method"]) == 0
    if x.known is not None and not away:
        return e.b.known(np.rint(x.known), x.dtype)
    return e.b.intrinsic("round" if away else "roundeven", (x,))


def _integral(name: str, function: Callable) -> Callable:
    def rule(e: Evaluator, _: Any, x: Num) -> Num:
        if not x.is_float:
            return x
        if x.known is not None:
            return e.b.known(function(x.known), x.dtype)
        return e.b.intrinsic(name, (x,))

    return rule


def _power(e: Evaluator, params: dict, x: Num) -> Num:
    return e.b.power(x, params["y"])


def _pow(e: Evaluator, _: Any, x: Num, y: Num) -> Num:
    if y.known is not None and x.is_float:
        if not y.is_float or float(y.known).is_integer():
            n = int(y.known)
            if abs(n) <= 64:
                return e.b.power(x, n)
        elif abs(2 * float(y.known)) <= 7 and float(2 * y.known).is_integer():
            name = f"half_integer_power {int(2 * float(y.known))}"
            return _elementary(name)(e, {}, x)
    if not y.is_float:
        y = e.b.convert(y, x.dtype)
    return _elementary("pow")(e, {}, x, y)


def _elementary(name: str) -> Callable:
    def rule(e: Evaluator, _: Any, *xs: Num) -> Num:
        if not xs[0].is_float:
            raise Unsupported(f"{name} of {xs[0].dtype}")
        if xs[0].dtype == "float32":
            wide = e.kernel.elementary(name, [e.b.convert(x, "float64") for x in xs])
            return e.b.convert(wide, "float32")
        return e.kernel.elementary(name, xs)

    return rule


def _one(e: Evaluator, like: Num) -> Num:
    return e.b.known(1, like.dtype)


def _convert(e: Evaluator, params: dict, x: Num) -> Num:
    return e.b.convert(x, str(np.dtype(params["new_dtype"])))


def _bitcast(e: Evaluator, params: dict, x: Num) -> Num:
    new = np.dtype(params["new_dtype"])
    if new.itemsize != np.dtype(x.dtype).itemsize or "bool" in (x.dtype, str(new)):
        raise Unsupported(f"the bits of {x.dtype} as {new}")
    return e.b.bitcast(x, str(new))


def _add(e: Evaluator, _: Any, a: Num, b: Num) -> Num:
    return e.combine("add", a, b)


def _mul(e: Evaluator, _: Any, a: Num, b: Num) -> Num:
    return e.combine("mul", a, b)


def _reduced_precision(e: Evaluator, params: dict, x: Num) -> Num:
    wide = {"float64": (11, 52), "float32": (8, 23)}.get(x.dtype)
    if wide is None or params["exponent_bits"] < wide[0] or params["mantissa_bits"] < wide[1]:
        raise Unsupported("reduce_precision to fewer bits")
    return x


ELEMENTWISE: dict[str, Callable] = {
    "add": _add,
    "add_any": _add,
    "sub": _binary("sub"),
    "mul": _mul,
    "div": _binary("div"),
    "rem": _binary("rem"),
    "neg": lambda e, _, x: e.b.neg(x),
    "abs": lambda e, _, x: e.b.abs(x),
    "sign": _sign,
    "max": lambda e, _, a, b: e.combine("max", a, b),
    "min": lambda e, _, a, b: e.combine("min", a, b),
    "clamp": _clamp,
    "select_n": _select,
    "sqrt": lambda e, _, x: e.b.sqrt(x),
    "rsqrt": lambda e, _, x: e.b.div(_one(e, x), e.b.sqrt(x)),
    "square": lambda e, _, x: e.b.mul(x, x),
    "one_minus_square": lambda e, _, x: e.b.sub(_one(e, x), e.b.mul(x, x)),
    "integer_pow": _power,
    "pow": _pow,
    "floor": _integral("floor", np.floor),
    "ceil": _integral("ceil", np.ceil),
    "round": _rounded,
    "is_finite": lambda e, _, x: e.b.is_finite(x),
    "convert_element_type": _convert,
    "bitcast_convert_type": _bitcast,
    "reduce_precision": _reduced_precision,
    "copy": lambda e, _, x: x,
    "copy_p": lambda e, _, x: x,
    "stop_gradient": lambda e, _, x: x,
    "real": lambda e, _, x: x,
    "conj": lambda e, _, x: x,
    "and": lambda e, _, a, b: e.b.logic("and", a, b),
    "or": lambda e, _, a, b: e.b.logic("or", a, b),
    "xor": lambda e, _, a, b: e.b.logic("xor", a, b),
    "not": lambda e, _, x: e.b.invert(x),
    "eq": _equal,
    **{op: _compared(op) for op in ("ne", "lt", "le", "gt", "ge")},
    **{
        op: (lambda e, _, a, b, op=op: e.b.shift(op, a, b))
        for op in ("shift_left", "shift_right_logical", "shift_right_arithmetic")
    },
    **{
        name: _elementary(name)
        for name in (
            "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh",
            "asinh", "acosh", "atanh", "exp", "exp2", "expm1", "log", "log1p", "log2", "cbrt",
            "erf", "erfc", "logistic",
        )
    },
}  # fmt: skip
"""Applied number by number; an operand without axes goes with each number of the others."""
