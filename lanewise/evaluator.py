"""A jaxpr evaluated number by number into LLVM IR, for a block of trajectories."""

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .assumed import Assumptions
from .jaxprs.jaxapi import ClosedJaxpr, Jaxpr, Literal, variables
from .llvm.ir import NotCompilable, Num, check_size, check_type
from .llvm.memory import Buffer, load, load_row, store, store_row
from .llvm.values import MOST_ENTRIES, SMALL, Entries, Value, Values, objects
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
        self.assumptions: Assumptions | None = None

    # --- jaxprs ------------------------------------------------------------------------------

    def evaluate(self, function: ClosedJaxpr, values, places=None) -> list[Value]:
        consts = [self.constant(const) for const in function.consts]
        return self.jaxpr(function.jaxpr, consts, values, places)

    def constant(self, array: Any) -> Value:
        array = np.asarray(array)
        dtype = check_type(array.dtype)
        if array.size > SMALL:
            return Value(array.shape, dtype, buffer=self.module.constant(array))
        entries = [self.b.const(number, dtype) for number in array.reshape(-1)]
        return Value(array.shape, dtype, objects(entries, array.shape))

    def jaxpr(
        self,
        jaxpr: Jaxpr,
        consts: Sequence[Value],
        values: Sequence[Value],
        destinations: Sequence[Buffer | None] | None = None,
    ) -> list[Value]:
        """The outputs. `destinations`: where outputs are written if they are in memory."""
        # From the variables of the jaxpr to their values.
        environment: dict[Any, Value] = dict(zip(jaxpr.constvars, consts, strict=True))
        environment.update(zip(jaxpr.invars, values, strict=True))
        places = _places(jaxpr, destinations or [None] * len(jaxpr.outvars))

        def read(atom: Any) -> Value:
            if isinstance(atom, Literal):
                return self.constant(np.asarray(atom.val, atom.aval.dtype))  # pyright: ignore[reportAttributeAccessIssue]
            return environment[atom]

        # One call gives the sine and the cosine of a number, and costs little more than one of
        # them.
        equations = _needed(jaxpr)
        sines_and_cosines = _sines_and_cosines(equations)
        for eqn in equations:
            inputs = [read(v) for v in eqn.invars]
            if id(eqn) in sines_and_cosines:
                (environment[eqn.outvars[0]],) = RULES[SINE_AND_COSINE](self, eqn, inputs, [None])
                continue
            outputs = self.equation(eqn, inputs, [places.get(v) for v in eqn.outvars])
            # A number that is linear in unit vectors is a derivative: its zeros stay zeros, also
            # times infinity.
            if eqn.primitive.name not in _ENDS and any(v.is_tangent for v in inputs):
                outputs = [self.as_tangent(v) for v in outputs]
            environment.update(zip(eqn.outvars, outputs, strict=True))
        check_size(self.b.operations, self.b.limit, "the number of operations")
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn: Any, values: list[Value], places: list) -> list[Value]:
        """The results of one equation, by the rule of its primitive."""
        rule = RULES.get(eqn.primitive.name)
        if rule is None:
            raise NotCompilable(f"there is no rule for the primitive {eqn.primitive.name}")
        return rule(self, eqn, values, places)

    def without_origin(self, value: Value) -> Value:
        """The same numbers, treated as results of a loop or a branch."""
        return self.value([self.b.without_origin(x) for x in self.entries(value).flat], value)

    def opaque(self, value: Value) -> Value:
        """The same numbers, of which it is not known how they were made."""
        if value.entries is None:
            return value
        return self.value([self.b.opaque(x) for x in value.entries.flat], value)

    # --- values --------------------------------------------------------------------------------

    def entries(self, value: Value, limit: int = MOST_ENTRIES) -> Entries:
        """The numbers of an array, read from memory if it is there."""
        if value.entries is not None:
            return value.entries
        buffer = value.buffer
        assert buffer is not None
        check_size(value.size, limit, "elements of an array that are read one by one", value.shape)

        def make() -> tuple[Value, Entries]:  # the value as well, so that no other one gets its id
            return value, objects(load_row(self.b, buffer), value.shape)

        return self.b.find_or_make(("entries", id(value)), make)[1]

    def in_memory(self, value: Value) -> Buffer:
        """Where an array is in memory, written there if it was not."""
        if value.buffer is not None:
            return value.buffer
        assert value.entries is not None
        # Known numbers go into the module once, and no instruction writes them.
        constants = value.constants()
        if constants is not None:
            return self.module.constant(constants)
        place = self.module.scratch(value.shape, value.dtype, value.has_lanes())
        self.write(value, place)
        return place

    def reshape(self, value: Value, shape: Sequence[int]) -> Buffer:
        """Where an array is in memory with other axes, copied if its strides cannot say that."""
        view = self.in_memory(value).reshape(shape)
        if view is not None:
            return view
        place = self.module.scratch(value.shape, value.dtype, value.has_lanes())
        self.write(value, place)
        copy = place.reshape(shape)
        assert copy is not None
        return copy

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
                store(self.b, place, load(self.b, source, source.position(i)), place.position(i))
            return

        def copy(index: Num) -> None:
            row = Value.in_memory(source.row(self.b, index))
            self.write(row, place.row(self.b, index))

        self.count(value.shape[0], copy)

    def count(self, length: int, body: Callable[[Num], None]) -> None:
        """``body(i)`` for i = 0, …, length − 1."""
        (end,) = self.module.parameter(length).names
        self.b.repeat(end, lambda i: body(self.b.number([i], "int64", False)))

    def value(self, entries: Sequence[Num], like: Any) -> Value:
        return Value(like.shape, like.dtype, objects(list(entries), like.shape))

    def as_tangent(self, value: Value) -> Value:
        """A value that is linear in unit vectors: its zeros are zeros by structure."""
        if value.entries is None:
            return value

        def structural_zero(x: Num) -> Num:
            is_zero = x.is_float and x.is_const(0)
            return self.b.const(0, x.dtype, structural=True) if is_zero else x

        out = self.value([structural_zero(x) for x in value.entries.flat], value)
        out.is_tangent = True
        return out

    # --- arithmetic ------------------------------------------------------------------------------

    def combine(self, op: str, x: Num, y: Num) -> Num:
        """An operation of two, by name."""
        b = self.b
        if op in ("max", "min"):
            return b.maximum(x, y, "gt" if op == "max" else "lt")
        if op in ("add", "mul") and x.dtype != "bool":
            return b.add(x, y) if op == "add" else b.mul(x, y)
        return b.logic({"add": "or", "mul": "and"}.get(op, op), x, y)

    # --- branches that are rarely taken ----------------------------------------------------------

    @contextlib.contextmanager
    def assuming(self, assumptions: Any):
        """Write code that assumes that no rare branch is needed; `assumptions` collects them."""
        previous, self.assumptions = self.assumptions, assumptions
        try:
            yield assumptions
        finally:
            self.assumptions = previous


def parts_along(place: Buffer, axis: int, shapes: Sequence[tuple[int, ...]]) -> list[Buffer]:
    """The parts of a place along one axis."""
    parts, start = [], 0
    for shape in shapes:
        front = (slice(None),) * axis
        part = place.view(lambda x, s=start, n=shape[axis], f=front: x[(*f, slice(s, s + n))])
        assert part is not None
        parts.append(part)
        start += shape[axis]
    return parts


def _places(jaxpr: Jaxpr, destinations: Sequence[Buffer | None]) -> dict[Any, Buffer]:
    """Where variables are to be written so that the outputs are at their destinations."""
    places: dict[Any, Buffer] = {}

    def assign(var: Any, place: Buffer | None) -> None:
        if place is not None and not isinstance(var, Literal):
            places.setdefault(var, place)

    for var, place in zip(jaxpr.outvars, destinations, strict=True):
        assign(var, place)
    # Backwards, from the outputs: an array that is joined from parts is written part by part to
    # the destination of the array, without a copy.
    for eqn in reversed(jaxpr.eqns) if places else ():
        place = places.get(eqn.outvars[0]) if len(eqn.outvars) == 1 else None
        if place is None:
            continue
        name, params = eqn.primitive.name, eqn.params
        shapes = [var.aval.shape for var in eqn.invars]  # pyright: ignore[reportAttributeAccessIssue]
        if name == "concatenate":
            parts = parts_along(place, params["dimension"], shapes)
            for var, part in zip(eqn.invars, parts, strict=True):
                assign(var, part)
        elif name in ("squeeze", "expand_dims") or (
            name == "reshape" and params["dimensions"] is None
        ):
            assign(eqn.invars[0], place.reshape(shapes[0]))
    return places


def _needed(jaxpr: Jaxpr) -> list[Any]:
    """The equations from which the outputs follow. A gradient contains those of its value too."""
    needed, equations = set(variables(jaxpr.outvars)), []
    for eqn in reversed(jaxpr.eqns):
        if eqn.effects or not needed.isdisjoint(eqn.outvars):
            needed.update(variables(eqn.invars))
            equations.append(eqn)
    return equations[::-1]


def _sines_and_cosines(equations: Sequence[Any]) -> set[int]:
    """The equations that are the sine or the cosine of a variable of which both are taken."""
    calls = [
        (eqn.primitive.name, eqn.invars[0], id(eqn))
        for eqn in equations
        if eqn.primitive.name in ("sin", "cos") and not isinstance(eqn.invars[0], Literal)
    ]
    sines, cosines = ({x for name, x, _ in calls if name == f} for f in ("sin", "cos"))
    return {eqn for _, x, eqn in calls if x in sines & cosines}


# Linear solves: the result of one is a change of the state and not a derivative any more.
_ENDS = frozenset(["custom_linear_solve", "eliminate"])


def check_types(rule: Callable) -> Callable:
    """A rule for results of the types that are compiled."""

    def rule_with_check(evaluator: Evaluator, eqn: Any, values: Values, places: list) -> Values:
        for var in eqn.outvars:
            check_type(var.aval.dtype, f"results of {eqn.primitive.name}")
        return rule(evaluator, eqn, values, places)

    return rule_with_check
