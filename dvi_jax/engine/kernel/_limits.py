"""What a kernel may be made of."""

import numpy as np

from ..._compat import Jaxpr, Literal, aval, bodies
from ..lanes._evaluate import _CALLS


class NotInKernelError(Exception):
    """The function does not go into a kernel; the message says why."""


KEPT_AS = {
    "float32": np.dtype("float32"),
    "float64": np.dtype("float64"),
    "int32": np.dtype("int32"),
    "int64": np.dtype("int64"),
    "bool": np.dtype("int32"),
}
"""The types of numbers that go into a kernel, and the type by which memory holds them."""

_FLOATS = """
abs acos acosh add add_any asin asinh atan atan2 atanh cbrt ceil cos cosh div exp exp2 expm1 floor
integer_pow is_finite log log1p logistic mul neg pow rsqrt sign sin sinh sqrt square sub tan tanh
eq ge gt le lt ne
"""
_INTEGERS = """
abs add add_any and clamp div integer_pow max min mul neg not or rem shift_left
shift_right_arithmetic shift_right_logical sign square sub xor eq ge gt le lt ne
reduce_max reduce_min
"""
_TRUTHS = "and not or xor eq ne"
_MOVES = ("broadcast_in_dim", "convert_element_type", "select_n")

LOWERED: dict[str, frozenset[str]] = {
    kind: frozenset((*names.split(), *_MOVES))
    for kind, names in {"f": _FLOATS, "i": _INTEGERS, "b": _TRUTHS}.items()
}
"""Primitives that Triton lowers and that give the numbers XLA gives, by the kind of their first
operand. Not max and min of real numbers: they lose NaN."""

_OF_CONSTANTS = ("mul", "or", "broadcast_in_dim", "convert_element_type", "select_n")


def refuse_what_does_not_go_in(jaxpr: Jaxpr, block: int) -> None:
    """Raise an error if the program of a block is not made of what goes into a kernel."""
    for eqn in jaxpr.eqns:
        name, dtypes = eqn.primitive.name, [aval(v).dtype for v in eqn.invars]
        if name in _CALLS | {"scan", "while", "cond"}:
            for body in bodies(eqn):
                if name not in _CALLS and any(isinstance(v, Literal) for v in body.jaxpr.outvars):
                    raise NotInKernelError(f"{name} gives a constant.")
                refuse_what_does_not_go_in(body.jaxpr, block)
            continue
        kinds = [d.kind for d in dtypes]
        of = kinds[1] if name == "select_n" and kinds[0] == "b" else kinds[0] if kinds else ""
        if name not in LOWERED.get(of, ()) or (name == "select_n" and kinds[0] != "b"):
            raise NotInKernelError(f"{name} of {dtypes[0] if dtypes else 'nothing'}.")
        if name not in _OF_CONSTANTS and all(isinstance(v, Literal) for v in eqn.invars):
            raise NotInKernelError(f"{name} of constants.")
        for out in eqn.outvars:
            if aval(out).shape not in ((), (block,)):
                raise NotInKernelError(f"{name} makes an array of shape {aval(out).shape}.")
            if aval(out).dtype.name not in KEPT_AS:
                raise NotInKernelError(f"{name} makes numbers of type {aval(out).dtype}.")
