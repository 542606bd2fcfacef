"""How each primitive acts on entries. To add one is to add a line to one of these tables.

A primitive that stands in no table is applied to batched arrays, lane axis last.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ._value import ONE, ZERO, Entry, Structural, is_array, number, on_lanes

_NAMES = """
abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp clz complex conj
convert_element_type copy copy_p cos cosh digamma div eq erf erf_inv erfc exp exp2 expm1 floor ge
gt imag integer_pow is_finite le lgamma log log1p log2 logistic lt max min mul mulhi ne neg
nextafter not one_minus_square or population_count pow real
reduce_precision rem round rsqrt select_n shift_left shift_right_arithmetic shift_right_logical
sign sin sinh sqrt square stop_gradient sub tan tanh xor
"""

ELEMENTWISE = frozenset(_NAMES.split())
"""Applied entry by entry; operands without axes go with each entry of the others."""

REDUCTIONS: dict[str, Callable] = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
    "reduce_xor": lax.bitwise_xor,
}
"""Taken from the first entry to the last, by this operation of two."""

CUMULATIVE: dict[str, Callable] = {
    "cumsum": lax.add,
    "cumprod": lax.mul,
    "cummax": lax.max,
    "cummin": lax.min,
}
"""Running reductions along one axis."""


def _broadcast_in_dim(x, *, shape, broadcast_dimensions, **_):
    x = np.transpose(x, np.argsort(broadcast_dimensions))  # they may come in any order
    places = [1] * len(shape)
    for axis, dimension in enumerate(sorted(broadcast_dimensions)):
        places[dimension] = x.shape[axis]
    return np.broadcast_to(x.reshape(places), shape)


def _slice(x, *, start_indices, limit_indices, strides, **_):
    strides = strides or (1,) * x.ndim
    return x[tuple(map(slice, start_indices, limit_indices, strides))]


def _pad(x, fill, *, padding_config, **_):
    shape = [
        low + high + max(size + (size - 1) * inner, 0)
        for size, (low, high, inner) in zip(x.shape, padding_config, strict=True)
    ]
    # Negative padding crops: place the entries on a larger canvas, and cut.
    crops = [(max(-low, 0), max(-high, 0)) for low, high, _ in padding_config]
    canvas = np.empty([s + a + b for s, (a, b) in zip(shape, crops, strict=True)], object)
    for i in np.ndindex(canvas.shape):
        canvas[i] = fill.flat[0]
    places = []
    for size, (low, _high, inner) in zip(x.shape, padding_config, strict=True):
        start = max(low, 0)
        places.append(slice(start, start + max(size + (size - 1) * inner, 0), inner + 1))
    canvas[tuple(places)] = x
    cut = [slice(a, a + s) for s, (a, _) in zip(shape, crops, strict=True)]
    return canvas[tuple(cut)]


def _split(x, *, sizes, axis, **_):
    return tuple(np.split(x, np.cumsum(sizes)[:-1], axis))


def _unstack(x: np.ndarray, *, axis: int, **_: Any) -> tuple[np.ndarray, ...]:
    rows = np.moveaxis(x, axis, 0)
    return tuple(rows[i, ...] for i in range(len(rows)))  # "...": an array, of one entry too


MOVES: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": lambda x, *, new_sizes, **_: x.reshape(new_sizes),
    "squeeze": lambda x, *, dimensions, **_: np.squeeze(x, tuple(dimensions)),
    "expand_dims": lambda x, *, dimensions, **_: np.expand_dims(x, tuple(dimensions)),
    "transpose": lambda x, *, permutation, **_: np.transpose(x, permutation),
    "rev": lambda x, *, dimensions, **_: np.flip(x, tuple(dimensions)),
    "slice": _slice,
    "stack": lambda *xs, axis, **_: np.stack(xs, axis),
    "unstack": _unstack,
    "tile": lambda x, *, reps, **_: np.tile(x, tuple(reps)),
    "concatenate": lambda *xs, dimension, **_: np.concatenate(xs, axis=dimension),
    "pad": _pad,
    "split": _split,
}
"""Where entries go, by NumPy's rules: nothing is computed."""

LABELLED: dict[str, tuple[int, ...]] = {
    "gather": (0,),
    "dynamic_slice": (0,),
    "dynamic_update_slice": (0, 1),
    "scatter": (0, 2),
}
"""Where entries go when the other operands (indices) are known: the primitive moves labels. The
numbers are the places of the operands whose entries are moved."""


def algebra(name: str, entries: list[Entry], params: dict) -> Entry | None:
    """The result where structure or a known neutral element gives it away; else None."""
    a = entries[0]
    if name in ("add", "add_any"):
        b = entries[1]
        if is_zero(a):
            return b
        if is_zero(b):
            return a
    elif name == "sub":
        if is_zero(entries[1]):
            return a
    elif name == "mul":
        b = entries[1]
        if a is ZERO or b is ZERO:
            return ZERO
        if _is_one(a):
            return b
        if _is_one(b):
            return a
    elif name == "div":
        if a is ZERO:
            return ZERO
        if _is_one(entries[1]):
            return a
    elif name in ("neg", "reduce_precision", "real") and a is ZERO:
        return ZERO
    elif name in ("copy", "copy_p", "stop_gradient"):
        return a
    elif name == "convert_element_type" and isinstance(a, Structural):
        return a if np.issubdtype(params["new_dtype"], np.floating) else None
    elif name == "select_n":
        which, *cases = entries
        if not is_array(which):
            return cases[int(number(which, np.int64))]
        if all(case is cases[0] for case in cases):
            return cases[0]
    return None


def is_zero(entry: Entry) -> bool:
    return entry is ZERO or (isinstance(entry, np.generic) and entry == 0)


def _is_one(entry: Entry) -> bool:
    return entry is ONE or (isinstance(entry, np.generic) and entry == 1)


def apply(operation: Callable, entries: list[Entry], dtypes: list[Any]) -> Entry:
    """An elementwise operation on entries that are not all known."""
    arrays = [
        e if is_array(e) else np.asarray(number(e, d)) for e, d in zip(entries, dtypes, strict=True)
    ]
    lanes = [x.shape[0] for x in arrays if x.ndim]
    if lanes:
        arrays = [on_lanes(jnp.asarray(x), lanes[0]) for x in arrays]
    return operation(*arrays)


def fold(primitive: Any, arrays: list[np.ndarray], params: dict) -> list[np.ndarray]:
    """The outputs of a primitive whose inputs are known, computed while tracing."""
    is_same = len({a.shape for a in arrays}) == 1
    is_quotient = primitive.name == "div"  # NumPy's integers divide otherwise
    if primitive.name in _IN_NUMPY and is_same and (not is_quotient or _is_real(arrays[0])):
        with np.errstate(all="ignore"):
            return [np.asarray(_IN_NUMPY[primitive.name](*arrays))]
    with jax.ensure_compile_time_eval():
        out = primitive.bind(*map(jnp.asarray, arrays), **params)
    outs = out if primitive.multiple_results else [out]
    return [np.asarray(x) for x in outs]


def _is_real(x: np.ndarray) -> bool:
    return np.issubdtype(x.dtype, np.floating)


_IN_NUMPY: dict[str, Callable] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "not": np.invert,
}
"""The most common of them, without a compilation."""
