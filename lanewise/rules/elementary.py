"""Elementary functions of float64, as calls of functions of the module."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from .. import elementary as functions
from ..elementary.logarithmic import half_integer_power
from ..evaluator import RULES, SINE_AND_COSINE, Evaluator
from ..jaxprs.jaxapi import ClosedJaxpr
from ..llvm.ir import Num, call_of
from ..llvm.values import Value, Values, objects
from ..module import Module


def elementary(evaluator: Evaluator, name: str, args: Sequence[Num]) -> Num:
    """An elementary function of float64, as a call of a function of the module."""
    vec = any(a.vec for a in args)
    numbers: list[Any] = [a.value for a in args]
    if all(number is not None for number in numbers):
        return evaluator.b.const(
            _at_known(name, tuple(float(number) for number in numbers)), "float64"
        )
    function = _function(evaluator.module, name, len(args), vec)
    return evaluator.b.op(
        f"call {name}", args, "float64", lambda kind, *xs: call_of(function, kind, xs)
    )


def sincos(evaluator: Evaluator, x: Num) -> tuple[Num, ...]:
    """sin x and cos x in one call."""
    b = evaluator.b
    if x.value is not None:
        return elementary(evaluator, "sin", [x]), elementary(evaluator, "cos", [x])

    function, kind = _function(evaluator.module, "sincos", 1, x.vec), b.type("float64", x.vec)
    pair = f"{{{kind}, {kind}}}"

    def write(i: int, _: str, name: str) -> str:
        call = f"call {pair} {function}({kind} {name})"
        return f"extractvalue {pair} {b.find_or_make(call, lambda: b.new(call))}, {i}"

    parts = (functools.partial(write, i) for i in range(2))
    return tuple(b.op(f"call sincos {i}", (x,), "float64", w) for i, w in enumerate(parts))


def _function(module: Module, name: str, count: int, vec: bool) -> str:
    """The name of an elementary function of `count` arguments, which the module then contains."""
    width = module.b.W if vec else 1
    symbol = f"@{name.replace(' ', '_').replace('-', 'm')}_{'v' if width > 1 else 's'}"
    module.add_function((name, width), lambda: _function_text(name, count, width, symbol))
    return symbol


def sine_or_cosine(evaluator: Evaluator, eqn: Any, values: Values, places: list) -> Values:
    """sin x or cos x of an x of which both are needed."""
    index = 0 if eqn.primitive.name == "sin" else 1
    (value,), (out,) = values, eqn.outvars
    if not value.is_small or value.dtype != "float64":
        return evaluator.equation(eqn, values, places)
    return [
        evaluator.value(
            [sincos(evaluator, x)[index] for x in evaluator.entries(value).flat], out.aval
        )
    ]


def _by_name(name: str) -> Callable:
    """An elementary function of scalars by name; that of a power has its argument in the name."""
    if name.startswith("half_integer_power"):
        return half_integer_power(int(name.split()[1]))
    return getattr(functions, name)


@functools.cache
def _jaxpr_of(name: str, count: int) -> ClosedJaxpr:
    """An elementary function as a jaxpr of scalars."""
    with jax.enable_x64(True):
        return jax.make_jaxpr(_by_name(name))(*[jnp.zeros((), jnp.float64)] * count)


@functools.cache
def _function_text(
    name: str, count: int, width: int, symbol: str
) -> tuple[str, frozenset[str], tuple[str, ...]]:
    """An elementary function of vectors of `width`, with what it declares."""
    # A module of its own: its numbers and scopes do not mix with those of the caller.
    inner = Module(width, 1)
    b, evaluator = inner.b, Evaluator(inner)
    args = [b.number([f"%x{i}"], "float64", True) for i in range(count)]
    values = [Value((), "float64", objects([x], ())) for x in args]
    outs = evaluator.evaluate(_jaxpr_of(name, count), values)
    kind = result_type = b.type("float64", True)
    results = [b.ref(evaluator.entries(out)[()], 0, True) for out in outs]
    result = results[0]
    if len(outs) == 2:
        result_type = f"{{{kind}, {kind}}}"
        half = b.new(f"insertvalue {result_type} poison, {kind} {results[0]}, 0")
        result = b.new(f"insertvalue {result_type} {half}, {kind} {results[1]}, 1")
    text = "\n".join([*b.lines, f"  ret {result_type} {result}"])
    data = []
    for line in inner.globals:  # constants of each function have names of their own
        old = line.split(" ", 1)[0]
        new = f"{symbol}.{old[1:]}"
        text = text.replace(old + ",", new + ",")
        data.append(line.replace(old, new, 1))
    parameters = ", ".join(f"{kind} %x{i}" for i in range(count))
    body = f"define internal {result_type} {symbol}({parameters}) {{\nentry:\n{text}\n}}\n"
    return body, frozenset(b.declarations | inner.declarations), tuple(data)


@functools.lru_cache(maxsize=4096)
def _at_known(name: str, args: tuple[float, ...]) -> float:
    """The value at arguments that are known while the code is made.

    XLA would compute it on the default device, and on a CPU with subnormal numbers as zero.
    """
    b, evaluator = (module := Module(1, 1)).b, Evaluator(module)
    values = [Value((), "float64", objects([b.const(x, "float64")], ())) for x in args]
    (out,) = evaluator.evaluate(_jaxpr_of(name, len(args)), values)
    value = evaluator.entries(out)[()].value
    assert value is not None, name  # all their operations are computed where operands are known
    return float(value)


RULES[SINE_AND_COSINE] = sine_or_cosine
