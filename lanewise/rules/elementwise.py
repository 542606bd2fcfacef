"""Elementwise primitives: rule(evaluator, parameters of the equation, *numbers) → number."""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ..assumed import assumed_number, assumed_value
from ..evaluator import RULES, Evaluator, check_types
from ..llvm.builder import Builder
from ..llvm.ir import NotCompilable, Num
from ..llvm.memory import Buffer, load, store
from ..llvm.values import MOST_ENTRIES, Value
from . import exact
from .elementary import elementary


def _method(name: str, *first: Any) -> Callable:
    """The rule that calls a method of the builder with the numbers, after some arguments."""
    return lambda e, _, *xs: getattr(e.b, name)(*first, *xs)


def _equal(evaluator: Evaluator, _: Any, x: Num, y: Num) -> Num:
    """A loop's counter equals a given number in one round: taken for rare."""
    is_equal = evaluator.b.compare("eq", x, y)
    # A number that changes and is the same on all trajectories of a batch is a counter.
    is_count = (
        evaluator.b.W > 1
        and assumed_value(is_equal) is None
        and not is_equal.vec
        and not x.is_float
    )
    if (
        evaluator.assumptions is not None
        and is_count
        and (x.value is not None or y.value is not None)
    ):
        evaluator.assumptions.assume_false(is_equal)
        return assumed_number(evaluator.b, 0, "bool")
    return is_equal


def _select(evaluator: Evaluator, _: Any, condition: Num, *cases: Num) -> Num:
    b = evaluator.b
    if condition.dtype == "bool":
        assumption = None if condition.value is not None else assumed_value(condition)
        if assumption is not None:
            return b.without_origin(cases[int(assumption)])
        return b.select(condition, cases[1], cases[0])
    # Indices outside select the first or the last case, as in XLA.
    result = cases[-1]
    for i in reversed(range(len(cases) - 1)):
        result = b.select(b.compare("le", condition, b.const(i, condition.dtype)), cases[i], result)
    return result


def _clamp(evaluator: Evaluator, _: Any, low: Num, x: Num, high: Num) -> Num:
    return evaluator.b.maximum(evaluator.b.maximum(x, low), high, "lt")


def _sign(evaluator: Evaluator, _: Any, x: Num) -> Num:
    b, zero = evaluator.b, evaluator.b.const(0, x.dtype)
    if x.dtype.startswith("u"):
        return b.select(b.compare("eq", x, zero), zero, b.const(1, x.dtype))
    # x itself where it is neither: NaN stays NaN and −0 stays −0.
    sign = b.select(b.compare("gt", x, zero), b.const(1, x.dtype), x)
    return b.select(b.compare("lt", x, zero), b.const(-1, x.dtype), sign)


def _integral(name: str, function: Callable | None) -> Callable:
    """Rounding to an integer by a function of NumPy, if it has one, and LLVM's of that name."""

    def rule(evaluator: Evaluator, _: Any, x: Num) -> Num:
        if not x.is_float:
            return x
        if x.value is not None and function is not None:
            return evaluator.b.const(function(x.value), x.dtype)
        return evaluator.b.intrinsic(name, (x,))

    return rule


def _round(evaluator: Evaluator, params: dict, x: Num) -> Num:
    # NumPy has no function that rounds halves away from zero.
    is_away_from_0 = int(params["rounding_method"]) == 0
    rule = _integral("round", None) if is_away_from_0 else _integral("roundeven", np.rint)
    return rule(evaluator, params, x)


def _pow(evaluator: Evaluator, _: Any, x: Num, y: Num) -> Num:
    if y.value is not None and x.is_float:
        if not y.is_float or float(y.value).is_integer():
            n = int(y.value)
            # More products would have larger errors than the function.
            if abs(n) <= 64:
                return evaluator.b.power(x, n)
        # A root and few products: 1/r³ of a force takes a small part of the operations of pow.
        elif abs(2 * float(y.value)) <= 7 and float(2 * y.value).is_integer():
            name = f"half_integer_power {int(2 * float(y.value))}"
            return _elementary(name)(evaluator, {}, x)
    if not y.is_float:
        y = evaluator.b.convert(y, x.dtype)
    return _elementary("pow")(evaluator, {}, x, y)


def _elementary(name: str) -> Callable:
    def rule(evaluator: Evaluator, _: Any, *xs: Num) -> Num:
        if not xs[0].is_float:
            raise NotCompilable(f"{name} requires floats, got {xs[0].dtype}: use .astype(float)")
        if xs[0].dtype == "float32":
            # Own functions for float32 would be faster, and one more set to test.
            wide = elementary(evaluator, name, [evaluator.b.convert(x, "float64") for x in xs])
            return evaluator.b.convert(wide, "float32")
        return elementary(evaluator, name, xs)

    return rule


def _rem(evaluator: Evaluator, _: Any, x: Num, y: Num) -> Num:
    b = evaluator.b
    if not x.is_float:
        return b.rem(x, y)
    if x.value is not None and y.value is not None:
        with np.errstate(all="ignore"):
            return b.const(np.fmod(x.value, y.value), x.dtype)
    # LLVM's code for its instruction rounds on a GPU, and is a call for each number on a CPU.
    return _elementary("rem")(evaluator, {}, x, y)


def _unit(evaluator: Evaluator, like: Num) -> Num:
    return evaluator.b.const(1, like.dtype)


def _bitcast(evaluator: Evaluator, params: dict, x: Num) -> Num:
    new = np.dtype(params["new_dtype"])
    # Other sizes change the shape of the array, which a rule for one number cannot.
    if new.itemsize != np.dtype(x.dtype).itemsize or "bool" in (x.dtype, str(new)):
        raise NotCompilable(f"bitcast requires numbers of equal size, got {x.dtype} and {new}")
    return evaluator.b.bitcast(x, str(new))


def _combination(op: str) -> Callable:
    return lambda e, _, a, b: e.combine(op, a, b)


def _identity(evaluator: Evaluator, _: Any, x: Num) -> Num:
    return x


def _reduced_precision(evaluator: Evaluator, params: dict, x: Num) -> Num:
    least = {"float64": (11, 52), "float32": (8, 23)}.get(x.dtype, (64, 64))
    bits = params["exponent_bits"], params["mantissa_bits"]
    if bits[0] < least[0] or bits[1] < least[1]:
        names = "exponent_bits and mantissa_bits of reduce_precision"
        raise NotCompilable(f"{names} must be at least {least} for {x.dtype}, got {bits}")
    return x


_FUNCTIONS = (
    "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh "
    "exp exp2 expm1 log log1p log2 cbrt erf erfc erf_inv logistic"
)
_SHIFTS = "left right_logical right_arithmetic"

# Applied number by number; an operand without axes is combined with each number of the others.
ELEMENTWISE: dict[str, Callable] = {
    **{op: _combination(op) for op in ("add", "mul", "max", "min")},
    "add_any": _combination("add"),
    **{name: _method(name) for name in ("sub", "div", "neg", "abs", "sqrt", "is_finite")},
    "sign": _sign,
    "clamp": _clamp,
    "select_n": _select,
    "rsqrt": lambda e, _, x: e.b.div(_unit(e, x), e.b.sqrt(x)),
    "square": lambda e, _, x: e.b.mul(x, x),
    "one_minus_square": lambda e, _, x: e.b.sub(_unit(e, x), e.b.mul(x, x)),
    "integer_pow": lambda e, params, x: e.b.power(x, params["y"]),
    "pow": _pow,
    "floor": _integral("floor", np.floor),
    "ceil": _integral("ceil", np.ceil),
    "round": _round,
    "rem": _rem,
    "convert_element_type": lambda e, params, x: e.b.convert(x, str(np.dtype(params["new_dtype"]))),
    "bitcast_convert_type": _bitcast,
    "reduce_precision": _reduced_precision,
    **dict.fromkeys(["copy", "copy_p", "stop_gradient", "real", "conj"], _identity),
    **{op: _method("logic", op) for op in ("and", "or", "xor")},
    "not": _method("invert"),
    "rounded_product": exact.product_rule,
    "lost_by_product": exact.error_rule,
    "eq": _equal,
    **{op: _method("compare", op) for op in ("ne", "lt", "le", "gt", "ge")},
    **{f"shift_{kind}": _method("shift", f"shift_{kind}") for kind in _SHIFTS.split()},
    **{name: _elementary(name) for name in _FUNCTIONS.split()},
}


def _elementwise(evaluator: Evaluator, eqn: Any, values: list[Value], rule: Callable) -> Value:
    (out,) = eqn.outvars
    shape, params = out.aval.shape, eqn.params
    # An array that stays the same is not copied: it may be long, and the equation in a loop.
    cases = values[1:] if rule is _select else values
    if (rule is _select or rule is _identity) and all(case is cases[0] for case in cases):
        return cases[0]
    # Long arrays in a loop over their elements: otherwise the code would be as long as the
    # array.
    if not all(value.is_small for value in values) or math.prod(shape) > MOST_ENTRIES:
        return _in_a_loop(evaluator, eqn, values, rule)
    operands = [np.broadcast_to(evaluator.entries(value), shape) for value in values]
    results = [rule(evaluator, params, *(x[i] for x in operands)) for i in np.ndindex(*shape)]
    return evaluator.value(results, out.aval)


def _in_a_loop(evaluator: Evaluator, eqn: Any, values: list[Value], rule: Callable) -> Value:
    """An elementwise primitive on arrays that stay in memory."""
    (out,) = eqn.outvars
    shape = out.aval.shape
    has_lanes = any(value.has_lanes() for value in values)
    place = evaluator.module.scratch(shape, str(out.aval.dtype), has_lanes)
    sources = [value if value.shape == () else evaluator.in_memory(value) for value in values]

    def loop_over(places: list, target: Buffer) -> None:
        if not target.shape:
            numbers = [
                evaluator.entries(x)[()] if isinstance(x, Value) else load(evaluator.b, x)
                for x in places
            ]
            store(evaluator.b, target, rule(evaluator, eqn.params, *numbers))
            return
        rows = functools.partial(_row_of, evaluator.b)
        evaluator.count(
            target.shape[0],
            lambda i: loop_over([rows(x, i) for x in places], target.row(evaluator.b, i)),
        )

    loop_over(sources, place)
    return Value.in_memory(place)


def _row_of(b: Builder, x: Any, index: Num) -> Any:
    if isinstance(x, Value):  # one number for all elements
        return x
    if x.shape[0] == 1:
        index = b.const(0, "int64")
    return x.row(b, index)


def _on_arrays(number_rule: Callable) -> Callable:
    """The rule for arrays of a rule for numbers."""

    def rule(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
        return [_elementwise(evaluator, eqn, values, number_rule)]

    return check_types(rule)


RULES |= {name: _on_arrays(number_rule) for name, number_rule in ELEMENTWISE.items()}
