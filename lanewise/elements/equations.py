"""A jaxpr turned into a tree of statements on long arrays."""

import functools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from ..jaxprs.jaxapi import ClosedJaxpr, Jaxpr, Literal, bodies
from ..llvm.ir import NotCompilable, check_type
from ..rules.elementwise import ELEMENTWISE
from ..rules.moves import CALLS
from .boxes import (
    Array,
    Box,
    Expression,
    NotABoxError,
    Table,
    elementwise,
    joined,
    repeat,
)
from .diagonals import diagonals, from_diagonals
from .moves import BOX_MOVES
from .tree import Block, Let, Memory, Number, Place, Statement, Store

EXPENSIVE = 16
"""An expression of so many operations that is used twice is written to memory."""

_LONG = 64  # parts of so many elements are written to their place in a longer array at once

_TALLEST = 60  # expressions of more levels are written to memory: the code descends recursively

ARRAY_RULES: dict[str, Callable] = {}
"""Name of a primitive → rule(translation, equation, arrays, places) → arrays, of what neither moves
elements nor is elementwise. `reductions`, `indices` and `flow` fill this table."""

_IDENTITIES = frozenset(
    ["reshard", "sharding_constraint", "mesh_cast", "least_over_lanes", "optimization_barrier"]
)
_COPIES = ("copy", "copy_p", "stop_gradient", "real", "conj")


class Token:
    """The result of an equation that is not evaluated yet."""


class BlockScope:
    """Statements go to another block for a while."""

    def __init__(self, translation: "Translation", block: Block):
        self.translation, self.block = translation, block

    def __enter__(self) -> None:
        self.outer, self.translation.block = self.translation.block, self.block

    def __exit__(self, *_: Any) -> None:
        self.translation.block = self.outer


class Translation:
    """The tree of one program; `block` is where statements are added, `root` the outermost one."""

    def __init__(self):
        self.table = Table()
        self.root = self.block = Block()
        self.operands: list[tuple[Memory, np.ndarray]] = []
        self._constants: dict[Any, Array] = {}
        self.factors: dict[Any, Any] = {}  # of linear systems that are solved again
        self.sums: dict[Any, Array] = {}
        self.branches = 0  # around the block

    # --- values --------------------------------------------------------------------------------

    def constant(self, array: Any) -> Array:
        array = np.asarray(array)
        check_type(array.dtype)
        if not array.size:
            return Array(self.table, array.shape, array.dtype, [])
        # One number: its bytes are compared, for NaN and −0 compare otherwise.
        bits = np.ascontiguousarray(array).reshape(-1, 1).view(np.uint8)
        if (bits == bits[0]).all():
            return Array.uniform(self.table.known(array.flat[0], array.dtype), array.shape)
        # Operands of the call, not text: LLVM takes long to parse text of many numbers.
        key = str(array.dtype), array.shape, array.tobytes()
        if key not in self._constants:
            memory = Memory(array.shape, array.dtype, row_major(array.shape), "constant")
            self.operands.append((memory, np.ascontiguousarray(array)))
            self._constants[key] = memory.load(self.table)
        return self._constants[key]

    def number(self, number: Number) -> Expression:
        return self.table.expression("number", number.dtype, value=number)

    def known(self, value: Any, dtype: Any = "int64") -> Array:
        return Array.uniform(self.table.known(value, dtype), ())

    def apply(self, name: str, *args: Array, dtype: str | None = None, **params: Any) -> Array:
        """An elementwise primitive; arrays without axes are repeated."""
        shape = max((a.shape for a in args), key=len)
        return elementwise(name, params, args, shape, dtype or args[0].dtype)

    def convert(self, x: Array, dtype: str) -> Array:
        if x.dtype == dtype:
            return x
        return self.apply("convert_element_type", x, dtype=dtype, new_dtype=np.dtype(dtype))

    def registers(self, shape: Sequence[int], dtype: Any) -> tuple[list[Number], Array]:
        """Numbers of the code for an array that is written out, and the array."""
        numbers = {index: Number(dtype) for index in np.ndindex(*shape)}
        parts = {index: Array.uniform(self.number(x), ()) for index, x in numbers.items()}
        return list(numbers.values()), self.from_components(parts, shape, range(len(shape)))

    def add(self, statement: Statement) -> None:
        self.block.statements.append(statement)

    def store(self, x: Array, place: Place | None = None) -> Array:
        """Write an array to memory: the array that is read from there."""
        place = Memory(x.shape, x.dtype).place if place is None else place
        short, long, parts = x.components()
        for index, part in parts.items():
            offset = sum(place.strides[a] * i for a, i in zip(short, index, strict=True))
            strides = [place.strides[a] for a in long]
            new = Store(place.memory, strides, place.offset + offset, part)
            if part.expression is not new.target:
                self.add(new)
        return place.load(self.table)

    def in_memory(self, x: Array, row_major_order: bool = False) -> Array:
        """The array as one load; `row_major_order` says that the strides have to be those."""
        node = x.expression
        is_load = node is not None and node.kind == "load" and not node.args
        if is_load and (not row_major_order or is_row_major(x.only.strides, x.shape)):
            return x
        return self.store(x, Memory(x.shape, x.dtype, row_major(x.shape)).place)

    def let(self, x: Array) -> Array:
        """A number that is computed here; numbers that are known stay."""
        node = x.expression
        assert node is not None
        if node.kind in ("known", "number"):
            return x
        # Its memory may change later: a number in a register does not.
        number = Number(x.dtype)
        self.add(Let(number, node))
        return Array.uniform(self.number(number), ())

    def settle(self, x: Array) -> Array:
        """The array computed here, if reading it would take operations."""
        if not x.size:
            return x
        # A few numbers go to registers.
        if x.is_written_out:
            return self.each_component(x, self.let)
        nodes = [box.expression for box in x.boxes]
        if all(node.kind in ("known", "number", "load", "index") for node in nodes):
            return x
        short, _, parts = x.components()
        # Matrices with a few diagonals are written as these.
        matrices = {}
        for index, part in parts.items():
            of = diagonals(part)
            if of is None:
                return self.store(x)
            stored = {offset: self.settle(diagonal) for offset, diagonal in of.items()}
            matrices[index] = from_diagonals(stored, part.shape, x.dtype, self.table)
        return self.from_components(matrices, x.shape, short)

    def each_component(self, x: Array, function: Callable[[Array], Array]) -> Array:
        """A written-out array with a function of its numbers."""
        short, _, parts = x.components()
        return self.from_components(
            {index: function(part) for index, part in parts.items()}, x.shape, short
        )

    def from_components(self, parts: dict[tuple, Array], shape, short: Sequence[int]) -> Array:
        """The array that has these parts at the indices of its short axes."""
        long = [a for a in range(len(shape)) if a not in short]
        boxes, dtype = [], ""
        for index, part in parts.items():
            whole = part.along(shape, long)
            for lower, upper, node in whole.boxes:
                low, high = list(lower), list(upper)
                for a, i in zip(short, index, strict=True):
                    low[a], high[a] = i, i + 1
                boxes.append(Box(tuple(low), tuple(high), node))
            dtype = part.dtype
        return Array(self.table, shape, dtype, joined(boxes, len(shape)))

    # --- jaxprs --------------------------------------------------------------------------------

    def flat(self, jaxpr: Jaxpr, consts: Sequence[Any], args: Sequence[Any], equations: list):
        """The equations, calls expanded, with tokens for what they compute."""
        environment = dict(zip(jaxpr.constvars, consts, strict=True))
        environment.update(zip(jaxpr.invars, args, strict=True))

        def read(atom: Any) -> Any:
            if isinstance(atom, Literal):
                return self.constant(np.asarray(atom.val, atom.aval.dtype))  # pyright: ignore[reportAttributeAccessIssue]
            return environment[atom]

        for eqn in jaxpr.eqns:
            inputs, name = [read(v) for v in eqn.invars], eqn.primitive.name
            body = None
            if name == "lanewise":
                if eqn.params["lanes"] is not None:
                    raise NotCompilable("the function contains a batch of another function")
                body = eqn.params["program"].trace.all_inputs
            elif name in CALLS:
                (body,) = bodies(eqn)
            # Of its four functions only the solution is computed.
            elif name == "custom_linear_solve":
                lengths, body = eqn.params["const_lengths"], eqn.params["jaxprs"].solve
                start = lengths.matvec + lengths.vecmat
                rights = inputs[sum(lengths) :]
                inputs = [*inputs[start : start + lengths.solve], *rights]
            if body is not None:
                constants = [self.constant(c) for c in body.consts]
                outs = self.flat(body.jaxpr, constants, inputs, equations)
            else:
                outs = [Token() for _ in eqn.outvars]
                equations.append((eqn, inputs, outs))
            environment.update(zip(eqn.outvars, outs, strict=False))
        return [read(v) for v in jaxpr.outvars]

    def evaluate(
        self, function: ClosedJaxpr, args: Sequence[Array], places: Sequence[Place | None] = ()
    ) -> list[Array]:
        """The outputs; `places` are memories in which they are wanted."""
        equations: list[Any] = []
        constants = [self.constant(c) for c in function.consts]
        outs = self.flat(function.jaxpr, constants, args, equations)
        # What is needed, and how often. From the outputs backwards, so that nothing is computed
        # that nobody reads.
        uses = Counter(out for out in outs if isinstance(out, Token))
        needed = []
        for equation in reversed(equations):
            if any(uses[token] for token in equation[2]):
                needed.append(equation)
                uses.update(x for x in equation[1] if isinstance(x, Token))
        destinations = _destinations(outs, places, needed)
        # What is written anyway: results, and what a branch reads.
        written = {*outs, *(x for eqn, xs, _ in needed if eqn.primitive.name == "cond" for x in xs)}
        values: dict[Token, Array] = {}

        def read(x: Any) -> Array:
            return values[x] if isinstance(x, Token) else x

        for eqn, inputs, tokens in reversed(needed):
            goals = [destinations.get(token) for token in tokens]
            used = [uses[token] > 0 for token in tokens]
            results = self.equation(eqn, [read(x) for x in inputs], goals, used)
            # Cheap expressions are computed again wherever they are read: a load would take as
            # long.
            for token, x in zip(tokens, results, strict=True):
                if not uses[token]:
                    continue
                price = 1 if token in written else EXPENSIVE
                if token in destinations:
                    x = self.store(x, destinations[token])
                elif (x.cost >= price and uses[token] > 1) or x.height > _TALLEST:
                    x = self.settle(x)
                values[token] = x
        return [read(x) for x in outs]

    def equation(self, eqn: Any, args: list[Array], places: list, used: list[bool]) -> list[Array]:
        name, params = eqn.primitive.name, eqn.params
        avals = [v.aval for v in eqn.outvars]
        for aval in avals:
            check_type(aval.dtype, f"results of {name}")
        shape, dtype = avals[0].shape, str(avals[0].dtype)
        # An array that stays the same is not copied: it may be a long table.
        if name in _COPIES or (name == "select_n" and all(x is args[1] for x in args[2:])):
            return [args[-1]]
        if name in ELEMENTWISE:
            return [elementwise(name, params, args, shape, dtype)]
        if name in BOX_MOVES:
            return self.move(name, params, args, shape)
        if name in _IDENTITIES:
            return args
        rule = ARRAY_RULES.get(name)
        if rule is None:
            raise NotCompilable(f"there is no rule for the primitive {name} of long arrays")
        if name in ("scan", "while", "cond"):
            return rule(self, eqn, args, places, used)
        return rule(self, eqn, *args)

    def move(self, name: str, params: dict, args: list[Array], shape) -> list[Array]:
        params = {k: v for k, v in params.items() if k not in ("sharding", "out_sharding")}
        try:
            moved = BOX_MOVES[name](*args, **params)
            return list(moved) if isinstance(moved, tuple) else [moved]
        except NotABoxError:
            pass
        x, *rest = args
        if name == "reshape":
            if params.get("dimensions") is not None:
                (x,) = self.move("transpose", {"permutation": params["dimensions"]}, [x], None)
            if x.is_written_out and math.prod(shape) <= 512:
                # A few numbers are only renamed.
                flat = [part.only for part in x.components()[2].values()]
                parts = {
                    index: Array.uniform(node, ())
                    for index, node in zip(np.ndindex(*shape), flat, strict=True)
                }
                return [self.from_components(parts, shape, range(len(shape)))]
            # Other axes of the same elements, in the order of memory.
            node = self.in_memory(x, row_major_order=True).expression
            assert node is not None
            other = self.table.expression(
                "load", x.dtype, (), "", row_major(shape), node.offset, node.value
            )
            return [Array.uniform(other, shape)]
        return [self._dilate(x, rest[0], params["padding_config"], shape)]

    def _dilate(self, x: Array, fill: Array, padding: Any, shape) -> Array:
        """A pad with gaps between the elements: read at computed indices."""
        index, is_inside = [], None
        for axis, (n, (low, _, gap)) in enumerate(zip(x.shape, padding, strict=True)):
            low, step = int(low), int(gap) + 1
            strides = [int(a == axis) for a in range(len(shape))]
            node = self.table.expression("index", "int64", strides=tuple(strides), offset=-low)
            # Number of the element, if it falls on one and not on a gap.
            i = Array.uniform(node, shape)
            quotient = self.apply("div", i, self.known(step))
            exact = self.apply("eq", self.apply("mul", quotient, self.known(step)), i, dtype="bool")
            clipped = self.apply("clamp", self.known(0), quotient, self.known(n - 1))
            exact = self.apply(
                "and", exact, self.apply("eq", clipped, quotient, dtype="bool"), dtype="bool"
            )
            is_inside = exact if is_inside is None else self.apply("and", is_inside, exact)
            index.append(clipped)
        assert is_inside is not None
        if not x.size:
            return repeat(fill, shape)
        picked = self.picked(x, [0] * len(shape), index)
        return self.apply("select_n", is_inside, fill, picked, dtype=x.dtype)

    def picked(self, x: Array, axes: Sequence[int], index: Sequence[Array]) -> Array:
        """The elements of x at computed indices, one array for each of its axes, which must lie
        inside. `axes[k]`: 1 + the axis of x that axis k of the result runs along, 0 for none."""
        # Elements at any place: they have to be in memory.
        node = self.in_memory(x).expression
        assert node is not None
        total = self.known(0)
        for stride, i in zip(node.strides, index, strict=True):
            total = self.apply("add", total, self.apply("mul", i, self.known(stride)))
        strides = tuple(node.strides[a - 1] if a else 0 for a in axes)
        boxes = [
            Box(
                lower,
                upper,
                self.table.expression(
                    "load", x.dtype, (distance,), "", strides, node.offset, node.value
                ),
            )
            for lower, upper, distance in total.boxes
        ]
        return Array(self.table, total.shape, x.dtype, boxes)


def expand(function: Callable) -> Callable:
    """The rule that evaluates a function of arrays and the parameters of the equation."""

    def rule(translation: Translation, eqn: Any, *args: Array) -> list[Array]:
        body = jax.make_jaxpr(functools.partial(function, **eqn.params))
        return translation.evaluate(body(*(v.aval for v in eqn.invars)), args)

    return rule


def row_major(shape: Sequence[int]) -> tuple[int, ...]:
    strides, step = [], 1
    for n in reversed(shape):
        strides.append(step)
        step *= max(int(n), 1)
    return tuple(reversed(strides))


def is_row_major(strides: Sequence[int], shape: Sequence[int]) -> bool:
    triples = zip(strides, row_major(shape), shape, strict=True)
    return all(n == 1 or s == t for s, t, n in triples)


def _destinations(
    outs: Sequence[Any], places: Sequence[Place | None], needed: Sequence[Any]
) -> dict:
    """Where results are wanted so that the outputs are in their places without a copy."""
    destinations: dict[Token, Place] = {}
    for token, place in zip(outs, places, strict=False):
        if isinstance(token, Token) and place is not None:
            destinations.setdefault(token, place)
    # An array that is joined from parts is written part by part, without a copy: the initial
    # state and the rows of a run, for example.
    for eqn, inputs, tokens in needed if destinations else ():  # from the last one to the first
        place, name = destinations.get(tokens[0]), eqn.primitive.name
        if place is None or not inputs:
            continue
        first = inputs[0]
        shapes = [v.aval.shape for v in eqn.invars]
        if name == "concatenate":
            axis, start = eqn.params["dimension"], 0
            for x, shape in zip(inputs, shapes, strict=True):
                if isinstance(x, Token) and math.prod(shape) > _LONG:
                    destinations.setdefault(x, place.part(shape, start * place.strides[axis]))
                start += shape[axis]
        elif (
            (
                name in ("squeeze", "expand_dims")
                or (name == "reshape" and eqn.params["dimensions"] is None)
            )
            and is_row_major(place.strides, place.shape)
            and isinstance(first, Token)
        ):
            destinations.setdefault(first, place.part(shapes[0], 0, row_major(shapes[0])))
    return destinations
