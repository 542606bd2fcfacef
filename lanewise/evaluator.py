"""A jaxpr evaluated number by number into LLVM IR, for a block of trajectories."""

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .assumed import Assumed
from .jaxprs.jaxapi import ClosedJaxpr, Jaxpr, Literal
from .llvm.ir import TYPES, Num, Unsupported
from .llvm.memory import Buffer, load, load_row, store, store_row
from .llvm.values import MADE, SMALL, Entries, Value, objects
from .module import Module

RULES: dict[str, Callable] = {}
"""Name of a primitive → rule(evaluator, equation, values of its operands, places of its results) →
values of its results. The files of `rules` fill this table."""

SINE_AND_COSINE = "sine and cosine"
"""The name of the rule for sin x or cos x if both are needed. No primitive has this name."""


class Evaluator:
    """One evaluation: numbers go through `b`, memory comes from `module`. It knows no rule."""

    def __init__(self, module: Module):
        self.b, self.module = module.b, module
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
            return Value(array.shape, dtype, buffer=self.module.constant(array))
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
                (known[eqn.outvars[0]],) = RULES[SINE_AND_COSINE](self, eqn, inputs, [None])
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

    def equation(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        """The results of one equation, by the rule of its primitive."""
        rule = RULES.get(eqn.primitive.name)
        if rule is None:
            raise Unsupported(f"no rule compiles the primitive {eqn.primitive.name}")
        return rule(self, eqn, values, places)

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
            return self.module.constant(known)
        place = self.module.scratch(value.shape, value.dtype, value.has_lanes())
        self.write(value, place)
        return place

    def reshaped(self, value: Value, shape: Sequence[int]) -> Buffer:
        """Where an array is in memory with other axes, copied if its strides cannot say that."""
        seen = self.in_memory(value).reshaped(shape)
        if seen is not None:
            return seen
        place = self.module.scratch(value.shape, value.dtype, value.has_lanes())
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
        b, end = self.b, self.module.parameter(length)

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

    # --- arithmetic ------------------------------------------------------------------------------

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


def parts_along(place: Buffer, axis: int, shapes: Sequence[tuple[int, ...]]) -> list[Buffer]:
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
            for v, part in zip(
                eqn.invars, parts_along(place, eqn.params["dimension"], shapes), strict=True
            ):
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


def typed(rule: Callable) -> Callable:
    """A rule for results of the types that are compiled."""

    def checked(e: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
        for v in eqn.outvars:
            if str(v.aval.dtype) not in TYPES:
                types = "float64, float32, bool or integers of 8 to 64 bits"
                raise Unsupported(f"{eqn.primitive.name} must return {types}, got {v.aval.dtype}")
        return rule(e, eqn, values, places)

    return checked
