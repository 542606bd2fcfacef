"""Calls of functions: written as a part of the caller, or as a function of the module."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from ..evaluator import RULES, Evaluator
from ..jaxprs.jaxapi import ClosedJaxpr, bodies, is_once
from ..llvm.ir import Num
from ..llvm.values import SMALL, Value, Values, objects
from ..module import Module
from .moves import CALLS

_SIZE = 8  # bytes of memory for the largest number


@dataclasses.dataclass(frozen=True)
class _Function:
    """A function of one vector for each number. `results` are constants, or numbers that it writes
    to the end of its memory, a vector for each."""

    symbol: str
    results: list[Num]
    values: list[int]
    scratch_bytes: int
    operations: int


def _call(evaluator: Evaluator, eqn: Any, values: Values, places: list) -> Values:
    (body,) = bodies(eqn)
    is_long = any(value.entries is None and value.size > SMALL for value in values)
    if is_long or not is_once(eqn):
        return evaluator.evaluate(body, values, places)
    # In a function of its own, no product is contracted with a sum outside: the same everywhere,
    # so that another call, of an observable for example, changes no bit of this one.
    inputs = [evaluator.value([*evaluator.entries(value).flat], value) for value in values]
    for new, old in zip(inputs, values, strict=True):
        new.is_tangent = old.is_tangent
    if evaluator.module.calls.get(body.jaxpr, 1) == 1 or evaluator.module.platform != "cpu":
        outs = evaluator.evaluate(body, [evaluator.opaque(value) for value in inputs])
        return [evaluator.opaque(value) for value in outs]
    # Known numbers are a part of the function: products with zeros and ones are not written.
    numbers = [number for value in inputs for number in evaluator.entries(value).flat]
    kinds = tuple(
        (number.dtype, number.vec) if number.value is None else number.key for number in numbers
    )
    key = body.jaxpr, kinds, tuple(value.is_tangent for value in inputs)
    written = evaluator.module.written_functions
    if key not in written:
        written[key] = _write(evaluator.module, body, inputs)
    results = iter(_results(evaluator, written[key], numbers))
    avals = [value.aval for value in eqn.outvars]
    return [evaluator.value([next(results) for _ in range(a.size)], a) for a in avals]


def _write(module: Module, body: ClosedJaxpr, inputs: Values) -> _Function:
    """Add a function to the module, of the inputs that are no constants."""
    symbol = f"@function{len(module.functions)}"
    module.functions[symbol, 0] = ""  # its place and name: it may call further functions
    inner = module.of_function()
    b, evaluator = inner.b, Evaluator(inner)
    parameters: list[str] = []

    def argument(number: Num) -> Num:
        if number.value is not None:
            return number
        name = f"%x{len(parameters)}"
        parameters.append(f"{b.type(number.dtype, number.vec)} {name}")
        return b.number([name], number.dtype, number.vec)

    arguments = []
    for value in inputs:
        assert value.entries is not None
        entries = objects([argument(number) for number in value.entries.flat], value.shape)
        arguments.append(Value(value.shape, value.dtype, entries))
        arguments[-1].is_tangent = value.is_tangent
    outs = evaluator.evaluate(body, arguments)
    results = [number for out in outs for number in evaluator.entries(out).flat]
    # In memory, not in a structure: its type would be written again with each of its numbers.
    for row, number in enumerate(number for number in results if number.value is None):
        place = b.pointer("i8", "%scratch", inner.scratch_bytes + row * _SIZE * b.W)
        b.emit(f"store {b.type(number.dtype, number.vec)} {number.names[0]}, ptr {place}")
    parameters += ["ptr %scratch", *(f"i64 %par{i}" for i in range(len(inner.values)))]
    module.declarations |= b.declarations
    head = f"define internal void {symbol}({', '.join(parameters)}) noinline {{\nentry:"
    module.functions[symbol, 0] = "\n".join([head, *b.lines, "  ret void", "}", ""])
    return _Function(symbol, results, inner.values, inner.scratch_bytes, b.operations)


def _results(evaluator: Evaluator, function: _Function, numbers: Sequence[Num]) -> list[Num]:
    """The results of a call, one for each vector of a block."""
    b, module = evaluator.b, evaluator.module
    moving = [number for number in function.results if number.value is None]
    size = function.scratch_bytes // _SIZE + len(moving) * b.W
    memory = module.scratch((size,), "float64", False).base[0]
    counts = [f"i64 {module.parameter(n).names[0]}" for n in function.values]
    # One vector after the other: a long function has enough independent operations.
    names: list[list[str]] = [[] for _ in moving]
    for u in range(b.U if any(number.vec for number in numbers) else 1):
        arguments = [
            f"{b.type(number.dtype, number.vec)} {b.ref(number, u, number.vec)}"
            for number in numbers
            if number.value is None
        ]
        b.emit(f"call void {function.symbol}({', '.join([*arguments, f'ptr {memory}', *counts])})")
        # Read before the next call, which writes to the same memory.
        for row, number in enumerate(moving):
            place = b.pointer("i8", memory, function.scratch_bytes + row * _SIZE * b.W)
            names[row].append(b.new(f"load {b.type(number.dtype, number.vec)}, ptr {place}"))
    b.operations += function.operations
    pairs = zip(names, moving, strict=True)
    news = iter(
        [b.number(n if number.vec else n[:1], number.dtype, number.vec) for n, number in pairs]
    )
    return [number if number.value is not None else next(news) for number in function.results]


RULES |= dict.fromkeys(CALLS, _call)
