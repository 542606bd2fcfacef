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
    is_long = any(v.entries is None and v.size > SMALL for v in values)
    if is_long or not is_once(eqn):
        return evaluator.evaluate(body, values, places)
    # In a function of its own, no product is contracted with a sum outside: the same everywhere,
    # so that another call, of an observable for example, changes no bit of this one.
    inputs = [evaluator.value([*evaluator.entries(v).flat], v) for v in values]
    for new, old in zip(inputs, values, strict=True):
        new.is_tangent = old.is_tangent
    if evaluator.module.calls.get(body.jaxpr, 1) == 1 or evaluator.module.platform != "cpu":
        outs = evaluator.evaluate(body, [evaluator.opaque(v) for v in inputs])
        return [evaluator.opaque(v) for v in outs]
    # Known numbers are a part of the function: products with zeros and ones are not written.
    numbers = [x for v in inputs for x in evaluator.entries(v).flat]
    kinds = tuple((x.dtype, x.vec) if x.value is None else x.key for x in numbers)
    key = body.jaxpr, kinds, tuple(v.is_tangent for v in inputs)
    written = evaluator.module.written_functions
    if key not in written:
        written[key] = _write(evaluator.module, body, inputs)
    results = iter(_results(evaluator, written[key], numbers))
    avals = [v.aval for v in eqn.outvars]
    return [evaluator.value([next(results) for _ in range(a.size)], a) for a in avals]


def _write(module: Module, body: ClosedJaxpr, inputs: Values) -> _Function:
    """Add a function to the module, of the inputs that are no constants."""
    symbol = f"@function{len(module.functions)}"
    module.functions[symbol, 0] = ""  # its place and name: it may call further functions
    inner = module.of_function()
    b, evaluator = inner.b, Evaluator(inner)
    parameters: list[str] = []

    def argument(x: Num) -> Num:
        if x.value is not None:
            return x
        name = f"%x{len(parameters)}"
        parameters.append(f"{b.type(x.dtype, x.vec)} {name}")
        return b.number([name], x.dtype, x.vec)

    arguments = []
    for value in inputs:
        assert value.entries is not None
        entries = objects([argument(x) for x in value.entries.flat], value.shape)
        arguments.append(Value(value.shape, value.dtype, entries))
        arguments[-1].is_tangent = value.is_tangent
    outs = evaluator.evaluate(body, arguments)
    results = [x for out in outs for x in evaluator.entries(out).flat]
    # In memory, not in a structure: its type would be written again with each of its numbers.
    for k, x in enumerate(x for x in results if x.value is None):
        place = b.pointer("i8", "%scratch", inner.scratch_bytes + k * _SIZE * b.W)
        b.emit(f"store {b.type(x.dtype, x.vec)} {x.names[0]}, ptr {place}")
    parameters += ["ptr %scratch", *(f"i64 %par{i}" for i in range(len(inner.values)))]
    module.declarations |= b.declarations
    head = f"define internal void {symbol}({', '.join(parameters)}) noinline {{\nentry:"
    module.functions[symbol, 0] = "\n".join([head, *b.lines, "  ret void", "}", ""])
    return _Function(symbol, results, inner.values, inner.scratch_bytes, b.operations)


def _results(evaluator: Evaluator, function: _Function, numbers: Sequence[Num]) -> list[Num]:
    """The results of a call, one for each vector of a block."""
    b, module = evaluator.b, evaluator.module
    moving = [x for x in function.results if x.value is None]
    size = function.scratch_bytes // _SIZE + len(moving) * b.W
    memory = module.scratch((size,), "float64", False).base[0]
    counts = [f"i64 {module.parameter(n).names[0]}" for n in function.values]
    # One vector after the other: a long function has enough independent operations.
    names: list[list[str]] = [[] for _ in moving]
    for u in range(b.U if any(x.vec for x in numbers) else 1):
        arguments = [
            f"{b.type(x.dtype, x.vec)} {b.ref(x, u, x.vec)}" for x in numbers if x.value is None
        ]
        b.emit(f"call void {function.symbol}({', '.join([*arguments, f'ptr {memory}', *counts])})")
        # Read before the next call, which writes to the same memory.
        for k, x in enumerate(moving):
            place = b.pointer("i8", memory, function.scratch_bytes + k * _SIZE * b.W)
            names[k].append(b.new(f"load {b.type(x.dtype, x.vec)}, ptr {place}"))
    b.operations += function.operations
    pairs = zip(names, moving, strict=True)
    news = iter([b.number(n if x.vec else n[:1], x.dtype, x.vec) for n, x in pairs])
    return [x if x.value is not None else next(news) for x in function.results]


RULES |= dict.fromkeys(CALLS, _call)
