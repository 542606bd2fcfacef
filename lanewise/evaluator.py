"""A jaxpr evaluated number by number into LLVM IR, for a block of trajectories."""

import contextlib
import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from .assumed import Assumed, taken_for
from .jaxprs.jaxapi import ClosedJaxpr, Jaxpr, Literal, bodies
from .llvm.builder import Builder
from .llvm.ir import TYPES, Num, Unsupported
from .llvm.memory import Buffer, load, load_row, store, store_row
from .llvm.values import MADE, SMALL, Entries, Value, objects
from .rules import elimination, indexing, loops, reductions
from .rules.elementwise import ELEMENTWISE
from .rules.moves import CALLS, CUMULATIVE, MOVES, REDUCTIONS, VIEWS, moved
from .rules.written import WRITTEN

if TYPE_CHECKING:
    from .kernel import Module


class Evaluator:
    """One evaluation: numbers go through `b`, memory comes from `kernel`."""

    def __init__(self, b: Builder, kernel: "Module"):
        self.b, self.kernel = b, kernel
        self.assumed: Assumed | None = None

    # --- jaxprs ------------------------------------------------------------------------------

    def closed(self, closed: ClosedJaxpr, values, wanted=None) -> list[Value]:
        return self.jaxpr(closed.jaxpr, [self.constant(c) for c in closed.consts], values, wanted)

    def constant(self, array: Any) -> Value:
        array = np.asarray(array)
        dtype = str(array.dtype)
        if dtype not in TYPES:
            raise Unsupported(f"numbers of type {dtype} are not compiled")
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
        # From the variables of the jaxpr to their values.
        known: dict[Any, Value] = dict(zip(jaxpr.constvars, consts, strict=True))
        known.update(zip(jaxpr.invars, values, strict=True))
        places = _places(jaxpr, wanted or [None] * len(jaxpr.outvars))

        def read(atom: Any) -> Value:
            if isinstance(atom, Literal):
                return self.constant(np.asarray(atom.val, atom.aval.dtype))  # pyright: ignore[reportAttributeAccessIssue]
            return known[atom]

        # One call gives the sine and the cosine of a number, and costs little more than one of
        # them.
        both = _sines_and_cosines(jaxpr)
        for eqn in jaxpr.eqns:
            inputs = [read(v) for v in eqn.invars]
            if id(eqn) in both:
                known[eqn.outvars[0]] = self.sine_or_cosine(eqn, inputs[0])
                continue
            outputs = self.equation(eqn, inputs, [places.get(v) for v in eqn.outvars])
            # A number that is linear in unit vectors is a derivative: its zeros stay zeros, also
            # times infinity.
            if eqn.primitive.name not in _ENDS and any(v.is_tangent for v in inputs):
                outputs = [self.as_tangent(v) for v in outputs]
            known.update(zip(eqn.outvars, outputs, strict=True))
        if self.b.operations > self.b.most:
            raise Unsupported(f"the function has more than {self.b.most} operations")
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
                types = "float64, float32, bool or integers of 8 to 64 bits"
                raise Unsupported(f"{name} must return {types}, got {v.aval.dtype}")
        if name == "reshape" or name in VIEWS:
            seen = self._viewed(eqn, values)
            if seen is not None:
                return seen
        if name == "concatenate" and any(v.entries is None for v in values):
            return [self._joined(eqn, values, places[0])]
        if name in MOVES:
            entries = moved(name, eqn.params, *(self.entries(v) for v in values))
            return [
                Value(v.aval.shape, v.aval.dtype, np.asarray(x, object))
                for v, x in zip(eqn.outvars, entries, strict=True)
            ]
        rule = ELEMENTWISE.get(name)
        if rule is not None:
            return [self._elementwise(eqn, values, rule)]
        # Last, because tracing takes longer than the tables above.
        written = WRITTEN.get(name)
        if written is not None:
            body = jax.make_jaxpr(functools.partial(written, **eqn.params))
            return self.closed(body(*(v.aval for v in eqn.invars)), values)
        raise Unsupported(f"no rule compiles the primitive {name}")

    def by_itself(self, eqn: Any, values: list[Value]) -> list[Value]:
        """A call within a call: no product in it is contracted with a sum outside, nor the other
        way round, so that its numbers have the same bits wherever it is called."""
        program = eqn.params["program"]
        if eqn.params["lanes"] is not None:
            raise Unsupported(
                "the function contains a batch of another lanewise function, made by "
                "lanewise.batched or jax.vmap: make a batch of the outer function only"
            )
        outs = self.closed(program.traced.all_inputs, [self.closed_off(v) for v in values])
        return [self.closed_off(v) for v in outs]

    def unrelated(self, value: Value) -> Value:
        """The same numbers, treated as results of a loop or a branch."""
        return self.value([self.b.unrelated(x) for x in self.entries(value).flat], value)

    def closed_off(self, value: Value) -> Value:
        """The same numbers, of which it is not known how they were made."""
        if value.entries is None:
            return value
        return self.value([self.b.opaque(x) for x in value.entries.flat], value)

    # --- values --------------------------------------------------------------------------------

    def entries(self, value: Value, most: int = MADE) -> Entries:
        """The numbers of an array, read from memory if it is there."""
        if value.entries is not None:
            return value.entries
        buffer = value.buffer
        assert buffer is not None
        if value.size > most:
            rule = f"an operation on single elements is compiled for at most {most} elements"
            raise Unsupported(f"{rule}, got an array of shape {value.shape}")

        def make() -> tuple[Value, Entries]:  # the value as well, so that no other one gets its id
            return value, objects(load_row(self.b, buffer), value.shape)

        return self.b.once(("entries", id(value)), make)[1]

    def in_memory(self, value: Value) -> Buffer:
        """Where an array is in memory, written there if it was not."""
        if value.buffer is not None:
            return value.buffer
        assert value.entries is not None
        # Known numbers go into the module once, and no instruction writes them.
        known = value.known()
        if known is not None:
            return self.kernel.constant(known)
        place = self.kernel.scratch(value.shape, value.dtype, value.has_lanes())
        self.write(value, place)
        return place

    def reshaped(self, value: Value, shape: Sequence[int]) -> Buffer:
        """Where an array is in memory with other axes, copied if its strides cannot say that."""
        seen = self.in_memory(value).reshaped(shape)
        if seen is not None:
            return seen
        place = self.kernel.scratch(value.shape, value.dtype, value.has_lanes())
        self.write(value, place)
        copied = place.reshaped(shape)
        assert copied is not None
        return copied

    def write(self, value: Value, place: Buffer) -> None:
        """Write an array to a place of its shape."""
        if value.buffer == place:
            return
        if value.entries is not None:
            store_row(self.b, place, list(value.entries.flat))
            return
        source = value.buffer
        assert source is not None
        # Few elements are moved one by one; a loop would cost more instructions.
        if value.size <= 16:
            for i in np.ndindex(value.shape):
                store(self.b, place, load(self.b, source, source.at(i)), place.at(i))
            return

        def copy(index: Num) -> None:
            row = Value.in_memory(source.row(self.b, index))
            self.write(row, place.row(self.b, index))

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

    def value(self, entries: Sequence[Num], like: Any) -> Value:
        return Value(like.shape, like.dtype, objects(list(entries), like.shape))

    def as_tangent(self, value: Value) -> Value:
        """A value that is linear in unit vectors: its zeros are zeros by structure."""
        if value.entries is None:
            return value

        def marked(x: Num) -> Num:
            is_zero = x.is_float and x.is_known_as(0)
            return self.b.known(0, x.dtype, structural=True) if is_zero else x

        out = self.value([marked(x) for x in value.entries.flat], value)
        out.is_tangent = True
        return out

    def _viewed(self, eqn: Any, values: list[Value]) -> list[Value] | None:
        """The outputs as other views of an array in memory, if it is there."""
        (value, *_) = values
        if value.entries is not None or value.size <= SMALL:
            return None
        assert value.buffer is not None
        name, params = eqn.primitive.name, eqn.params
        if name == "reshape" and params["dimensions"] is None:
            buffers = [self.reshaped(value, params["new_sizes"])]
        else:
            buffers = [
                value.buffer.seen(lambda x, i=i: moved(name, params, x)[i])
                for i in range(len(eqn.outvars))
            ]
        found = [Value.in_memory(x) for x in buffers if x is not None]
        if len(found) < len(buffers):
            rule = f"{name} with a copy is compiled for at most {SMALL} elements"
            raise Unsupported(f"{rule}, got an array of shape {value.shape}")
        return found

    def _joined(self, eqn: Any, values: list[Value], place: Buffer | None) -> Value:
        """Arrays one after the other, in memory."""
        (out,) = eqn.outvars
        axis = eqn.params["dimension"]
        if place is None:
            on = any(v.has_lanes() for v in values)
            place = self.kernel.scratch(out.aval.shape, str(out.aval.dtype), on)
        for value, part in zip(values, _parts(place, axis, [v.shape for v in values]), strict=True):
            self.write(value, part)
        return Value.in_memory(place)

    # --- arithmetic ------------------------------------------------------------------------------

    def _elementwise(self, eqn: Any, values: list[Value], rule: Callable) -> Value:
        (out,) = eqn.outvars
        shape, params = out.aval.shape, eqn.params
        # Long arrays in a loop over their elements: otherwise the code would be as long as the
        # array.
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
                target.shape[0], lambda i: one([rows(x, i) for x in places], target.row(self.b, i))
            )

        one(sources, place)
        return Value.in_memory(place)

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

    # --- branches that are rarely taken ----------------------------------------------------------

    @contextlib.contextmanager
    def assuming(self, assumed: Any):
        """Write code that assumes that no rare branch is needed; `assumed` collects what for."""
        before, self.assumed = self.assumed, assumed
        try:
            yield assumed
        finally:
            self.assumed = before

    def agreed(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        """The least of an integer over the trajectories of a block."""
        b, x = self.b, self.entries(values[0])[()]
        # Not reduced over the block: the assumption is checked after some rounds.
        if self.assumed is not None and eqn.params["rare"]:
            return [self.value([self.assumed.least(x)], eqn.outvars[0].aval)]
        if not x.vec:
            return values
        # The block runs a branch that some trajectory nearly always needs. Results do not depend on
        # it, because each trajectory selects its own.
        if not eqn.params["rare"]:  # one of several trajectories nearly always needs it
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

    def rounded(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        """The values as they are, in no operation that is contracted with those after them."""
        return [self.closed_off(v) for v in values]

    def same(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        return values


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
    # Backwards, from the outputs: an array that is joined from parts is written part by part to
    # where the whole is wanted, without a copy.
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
            if name == "reshape" and eqn.params["dimensions"] is not None:
                continue
            (v, *_) = eqn.invars
            part = place.reshaped(v.aval.shape)  # pyright: ignore[reportAttributeAccessIssue]
            if part is not None and not isinstance(v, Literal):
                places.setdefault(v, part)
    return places


def _sines_and_cosines(jaxpr: Jaxpr) -> set[int]:
    """The equations that are the sine or the cosine of a variable of which both are taken."""
    taken = [
        (eqn.primitive.name, eqn.invars[0], id(eqn))
        for eqn in jaxpr.eqns
        if eqn.primitive.name in ("sin", "cos") and not isinstance(eqn.invars[0], Literal)
    ]
    sines, cosines = ({x for name, x, _ in taken if name == which} for which in ("sin", "cos"))
    return {eqn for _, x, eqn in taken if x in sines & cosines}


# Linear solves: the result of one is a change of the state and not a derivative any more.
_ENDS = frozenset(["custom_linear_solve", "eliminate"])

_SPECIAL: dict[str, Callable] = {
    "scan": loops.scan,
    "while": loops.while_loop,
    "cond": loops.cond,
    "custom_linear_solve": elimination.linear_solve,
    "unit_vectors": elimination.unit_vectors,
    "least_over_lanes": Evaluator.agreed,
    "eliminate": elimination.eliminate,
    "dot_general": reductions.dot,
    **dict.fromkeys(REDUCTIONS, reductions.reduced),
    **dict.fromkeys(CUMULATIVE, reductions.accumulated),
    "iota": indexing.iota,
    **dict.fromkeys(["empty", "empty2"], indexing.empty),
    "optimization_barrier": Evaluator.rounded,
    **dict.fromkeys(["reshard", "sharding_constraint", "mesh_cast"], Evaluator.same),
    "argmax": indexing.argument_of,
    "argmin": indexing.argument_of,
    "dynamic_slice": indexing.dynamic_slice,
    "dynamic_update_slice": indexing.dynamic_update_slice,
    "gather": indexing.gather,
    **dict.fromkeys(indexing.SCATTERS, indexing.scatter),
}
