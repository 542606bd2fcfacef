"""The target of CPUs: number by number, in vectors of trajectories.

A function of one trajectory becomes a kernel for blocks of them.
"""

from collections.abc import Sequence
from typing import Any

from .. import rules as rules  # each file registers its rules with the evaluator
from ..evaluator import RULES, Evaluator
from ..frame import kernel_text, pointers
from ..jaxprs.extent import (
    calls_of_marked,
    carry_size,
    most_operations,
    operation_count,
    primitives_in,
)
from ..jaxprs.jaxapi import ClosedJaxpr
from ..llvm.ir import check_size, check_that, check_type
from ..llvm.memory import Buffer, contiguous, load_row, stored_type
from ..llvm.values import SMALL, Value, objects
from ..module import Module
from ..native import handler, machine
from .target import Code


def kernel_of(module: Module, function: ClosedJaxpr, lane_flags: Sequence[bool]) -> str:
    """The text of the module; `lane_flags` says which inputs differ between trajectories."""
    b, jaxpr = module.b, function.jaxpr
    for v in (*jaxpr.invars, *jaxpr.outvars):
        check_type(v.aval.dtype, "arguments and results")

    def arrays(source: str, letter: str, variables: Sequence[Any]) -> list[tuple[str, Any]]:
        names = pointers(b, source, letter, len(variables))
        return [(name, var.aval) for name, var in zip(names, variables, strict=True)]

    operands = arrays("%args", "a", jaxpr.invars)
    results = arrays("%rets", "r", jaxpr.outvars)
    # Before the loop over blocks: strides, and operands that all trajectories share, are read once.
    pairs = zip(operands, lane_flags, strict=True)
    lanes = [lane_stride(module, aval) if has_lanes else None for (_, aval), has_lanes in pairs]
    result_lanes = [lane_stride(module, aval) for _, aval in results]
    evaluator = Evaluator(module)
    shared = [
        operand_value(evaluator, array_at(module, *operand, None, "")) if lane is None else None
        for operand, lane in zip(operands, lanes, strict=True)
    ]
    consts = [evaluator.constant(c) for c in function.consts]

    def write_block(i: str) -> None:
        first = b.new(f"add i64 %first, {i}")
        start = b.new(f"mul i64 {first}, {b.W * b.U}")
        # The last block ends with the last trajectory, and computes some of them again: there
        # is no code for a remainder, which could have other bits.
        fits = b.new(f"icmp slt i64 {start}, %last.start")
        start = b.new(f"select i1 {fits}, i64 {start}, i64 %last.start")
        values = [
            value or operand_value(evaluator, array_at(module, *operand, lane, start))
            for operand, lane, value in zip(operands, lanes, shared, strict=True)
        ]
        places = [
            array_at(module, *result, lane, start)
            for result, lane in zip(results, result_lanes, strict=True)
        ]
        outs = evaluator.jaxpr(jaxpr, consts, values, places)
        for value, place in zip(outs, places, strict=True):
            evaluator.write(value, place)

    b.repeat("%count", write_block)
    return kernel_text(module, len(results), [f"  %last.start = sub i64 %lanes, {b.W * b.U}"])


def lane_stride(module: Module, aval: Any) -> int | str:
    """The distance between trajectories in elements; that of long arrays is an input."""
    if aval.size <= SMALL:
        return int(aval.size)
    return module.parameter(aval.size).names[0]


def array_at(module: Module, pointer: str, aval: Any, lane: int | str | None, start: str) -> Buffer:
    """An operand or a result of the block that begins at `start`; a shared one without a lane."""
    b, item = module.b, stored_type(str(aval.dtype))
    bases = [pointer] if lane is None else []
    for u in range(b.U if lane is not None else 0):
        position = start if u == 0 else b.new(f"add i64 {start}, {u * b.W}")
        if lane != 1:
            position = b.new(f"mul i64 {position}, {lane}")
        bases.append(b.new(f"getelementptr {item}, ptr {pointer}, i64 {position}"))
    return Buffer(tuple(bases), str(aval.dtype), aval.shape, contiguous(aval.shape), lane)


def operand_value(evaluator: Evaluator, buffer: Buffer) -> Value:
    value = Value(buffer.shape, buffer.dtype, buffer=buffer)
    if value.size <= SMALL:
        value.entries = objects(load_row(evaluator.b, buffer), buffer.shape)
    return value


_LONG_PROGRAM = 10_000  # operations


class Numbers:
    """Number by number, in vectors of trajectories; it is tried for every program."""

    name = "numbers"

    def suits(self, function: ClosedJaxpr) -> bool:
        return True

    def write(
        self, function: ClosedJaxpr, lane_flags: Sequence[bool], lanes: int, width: int | None
    ) -> Code:
        # Counted before code is written, which would take minutes for the largest functions.
        count = operation_count(function.jaxpr)
        limit = most_operations(function.jaxpr)
        check_size(count, limit, "the number of operations (a loop counts once)")
        # A long program would be written for seconds up to the equation that has no rule.
        missing = primitives_in(function.jaxpr) - RULES.keys() if count > _LONG_PROGRAM else set()
        check_that(not missing, f"there is no rule for the primitive {min(missing, default='')}")
        if width is not None:
            vectors = max(width // machine.width(), 1)
        else:
            # Every number of an argument or a result is moved trajectory by trajectory: most work
            # where there is no loop.
            state = carry_size(function.jaxpr)
            ends = [v.aval.size for v in (*function.jaxpr.invars, *function.jaxpr.outvars)]
            size = sum(n for n in ends if n <= SMALL)
            vectors = vectors_for(state, count) if state or size <= 24 else 1
        module = Module(*variant(lanes, vectors))
        module.b.limit = limit
        module.calls = calls_of_marked(function.jaxpr)
        text = kernel_of(module, function, lane_flags)
        b, values, scratch = module.b, tuple(module.values), module.scratch_bytes
        return Code(text, b.W * b.U, values, (), b.operations, scratch, b.W, b.U)

    def register(self, code: Code) -> str:
        return handler.register(code.module)

    def assembly(self, code: Code) -> str:
        return machine.assembly(code.module)


def variant(lanes: int, limit: int, width: int | None = None) -> tuple[int, int]:
    """(W, U): numbers in a vector, vectors in a block, for so many trajectories."""
    width = machine.width() if width is None else width
    # A block has no more trajectories than the batch: the last block could not end with the last
    # one.
    while width > lanes:
        width //= 2
    vectors = 1
    if lanes >= limit * width:
        return width, limit
    # A power of two here, so that batches of different small sizes share code.
    while 2 * vectors <= limit and 2 * vectors * width <= lanes:
        vectors *= 2
    return width, vectors


def vectors_for(state: int, operations: int) -> int:
    """Vectors in a block: enough to hide latency, few enough that the state stays in registers."""
    # A short step has few independent operations: several vectors hide the latency of its
    # divisions. A long one has many, and more vectors would need more registers than there are.
    if operations < 150:
        return max(1, min(8, 32 // max(state, 1)))
    if operations < 800 and state <= 12:
        return 4
    if operations < 2000:
        return 3 if state <= 12 else 2
    return 2 if operations < 4000 and state <= 12 else 1
