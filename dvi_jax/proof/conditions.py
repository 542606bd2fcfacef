"""Conditions of a function that are the same for all states of a domain.

Comparisons, abs, the largest of some numbers, floor and remainders are decided at points of the
domain. This proves nothing: each decision adds the root of a number to the list, which must be
positive for it. The checker evaluates all operations of a list on every box, so it rejects one with
another decision anywhere in the domain, within the rounding of computed numbers.
"""

import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .scalars import ProgramNumber, ScalarProgram

_COMPARISONS = {name: getattr(operator, name) for name in ("eq", "ne", "lt", "le", "gt", "ge")}
_COMPARISONS |= {"lt_to": operator.lt, "le_to": operator.le}
_EXTREMES = {"max": 1.0, "min": -1.0}
_WHOLE: dict[str, tuple[Callable, Callable]] = {
    "floor": (np.floor, lambda k: (k, k + 1)),
    "ceil": (np.ceil, lambda k: (k - 1, k)),
    "round": (np.round, lambda k: (k - 0.5, k + 0.5)),
    "trunc": (np.trunc, lambda k: (k - (k <= 0), k + (k >= 0))),
}
"""Functions to integers k, and the interval of the numbers that they map to k."""
_AXES = ("reduce_max", "reduce_min", "argmax", "argmin")
CONDITIONS = {*_COMPARISONS, *_EXTREMES, *_WHOLE, *_AXES}
CONDITIONS |= {"abs", "sign", "clamp", "is_finite", "convert_element_type", "rem"}


def decide(program: ScalarProgram, equation: Any, arrays: list[np.ndarray]) -> np.ndarray | None:
    """The output of one of `CONDITIONS`; None if it is not decided."""
    name, output = equation.primitive.name, equation.outvars[0]
    shape, dtype = output.aval.shape, output.aval.dtype
    if name in _AXES:
        axes, sign = equation.params["axes"], _EXTREMES[name[-3:]]
        columns = np.moveaxis(arrays[0], axes, range(len(axes))).reshape(-1, output.aval.size).T
        results: list[Any] = [
            _place(x, sign) if "arg" in name else extreme(*x, sign) for x in columns
        ]
    else:
        rows = zip(*(np.broadcast_to(a, shape).ravel() for a in arrays), strict=True)
        results = [_result(program, name, dtype, row) for row in rows]
    if any(x is None for x in results):
        return None
    if dtype.kind != "f":
        return np.array(results, dtype).reshape(shape)
    out = np.empty(len(results), object)
    out[:] = [x if isinstance(x, ProgramNumber) else program.constant(x) for x in results]
    return out.reshape(shape)


def _result(program: ScalarProgram, name: str, dtype: Any, x: Sequence[ProgramNumber]) -> Any:
    """The result of an operation of scalars; None if it is not decided."""
    if name in _COMPARISONS:
        sign = program.order(*x)
        return None if sign is None else _COMPARISONS[name](sign, 0)
    if name in _EXTREMES:
        return extreme(*x, _EXTREMES[name])
    if name == "clamp":
        return extreme(extreme(*x[:2], 1.0), x[2], -1.0)
    if name in ("abs", "sign") or (name == "convert_element_type" and dtype.kind == "b"):
        sign = program.sign(x[0])
        if name != "abs":
            return sign
        return program.magnitude(x[0]) if sign is None else x[0] * (sign or 1.0)
    if name == "is_finite":
        return None if program.order(*x, *x) is None else True
    if name == "convert_element_type" and dtype in (np.int32, np.int64):
        k = _whole(program, "trunc", x[0])
        return k if k is not None and abs(k) < 2**31 else None
    if name == "rem":
        k = _whole(program, "trunc", x[0] / x[1])
        return None if k is None else x[0] - x[1] * k
    return _whole(program, name, x[0]) if name in _WHOLE else None


def _place(x: Any, sign: float) -> int | None:
    """The place of the largest number, of the least one if `sign` is −1."""
    program = x[0].program
    samples = [sign * np.ravel(program.samples(y))[0] for y in x]
    place = int(np.argmax(np.nan_to_num(samples, nan=-np.inf)))
    orders = [program.order(x[place], y) for y in x]
    return None if any(s is None or not s * sign >= 0 for s in orders) else place


def extreme(*arguments: Any) -> ProgramNumber | None:
    """The largest of some numbers, the least one if the last argument is −1; None if undecided."""
    *x, sign = arguments
    place = None if any(y is None for y in x) else _place(x, sign)
    return None if place is None else x[place]


def _whole(program: ScalarProgram, name: str, x: ProgramNumber) -> float | None:
    """The integer that a number is rounded to."""
    function, interval = _WHOLE[name]
    k = float(function(np.ravel(program.samples(x))[0]))
    if not np.isfinite(k):
        return None
    low, high = interval(k)
    signs = program.sign(x - low), program.sign(high - x)
    # A tie is decided by the kind of rounding.
    return None if any(s is None or s < (name == "round") for s in signs) else k
