"""Where the entries of an array go: primitives of JAX that move numbers and compute nothing."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from ..evaluator import RULES, Evaluator, check_types, parts_along
from ..llvm.ir import NotCompilable, check_size
from ..llvm.memory import Buffer
from ..llvm.values import SMALL, Value


def _broadcast_in_dim(x, *, shape, broadcast_dimensions):
    x = np.transpose(x, np.argsort(broadcast_dimensions))  # they may come in any order
    places = [1] * len(shape)
    for axis, dimension in enumerate(sorted(broadcast_dimensions)):
        places[dimension] = x.shape[axis]
    return np.broadcast_to(x.reshape(places), shape)


def _slice(x, *, start_indices, limit_indices, strides):
    strides = strides or (1,) * x.ndim
    return x[tuple(map(slice, start_indices, limit_indices, strides))]


def _unstack(x: np.ndarray, *, axis: int) -> tuple[np.ndarray, ...]:
    rows = np.moveaxis(x, axis, 0)
    return tuple(rows[i, ...] for i in range(len(rows)))  # "...": an array, of one entry too


def _split(x, *, sizes, axis):
    return tuple(np.split(x, np.cumsum(sizes)[:-1], axis))  # NumPy takes the places of the cuts


def _reshape(x, *, new_sizes, dimensions):
    return (x if dimensions is None else np.transpose(x, dimensions)).reshape(new_sizes)


# One array seen with other axes or strides; an array in memory stays where it is.
VIEWS: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "squeeze": lambda x, *, dimensions: np.squeeze(x, tuple(dimensions)),
    "expand_dims": lambda x, *, dimensions: np.expand_dims(x, tuple(dimensions)),
    "transpose": lambda x, *, permutation: np.transpose(x, permutation),
    "rev": lambda x, *, dimensions: np.flip(x, tuple(dimensions)),
    "slice": _slice,
    "split": _split,
    "unstack": _unstack,
}


def _pad(x, fill, *, padding_config):
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


# The same on arrays of entries, and those that make a new array.
MOVES: dict[str, Callable] = {
    **VIEWS,
    "reshape": _reshape,
    "stack": lambda *xs, axis: np.stack(xs, axis),
    "tile": lambda x, *, reps: np.tile(x, tuple(reps)),
    "concatenate": lambda *xs, dimension: np.concatenate(xs, axis=dimension),
    "pad": _pad,
}


def move_entries(name: str, params: dict[str, Any], *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    """The outputs of a primitive that moves numbers.

    **Raises** `NotCompilable` for a parameter that its rule does not know, which might move them
    elsewhere.
    """
    rule, params = MOVES[name], {k: v for k, v in params.items() if k not in _ABOUT_DEVICES}
    # A later release of JAX may add a parameter: better no code than wrong code.
    extra = params.keys() - inspect.signature(rule).parameters.keys()
    if extra:
        names = ", ".join(sorted(extra))
        raise NotCompilable(f"{name} has unknown parameters: {names}")
    out = rule(*arrays, **params)
    return out if isinstance(out, tuple) else (out,)


# They say where an array is, not which number is where.
_ABOUT_DEVICES = frozenset(["sharding", "out_sharding"])

# Calls of one jaxpr whose inputs and outputs are those of the equation.
_CALL_NAMES = (
    "jit pjit closed_call core_call call_hi_primitive eval_jaxpr custom_jvp_call custom_vjp_call "
    "custom_vjp_call_jaxpr implicit_root with_derivative constant_unless checkpoint remat remat2"
)
CALLS = frozenset(_CALL_NAMES.split())

# Taken from the first entry to the last, by this operation of two.
REDUCTIONS = {
    **{"reduce_sum": "add", "reduce_prod": "mul"},
    **{f"reduce_{op}": op for op in ("max", "min", "and", "or", "xor")},
}

# Running reductions along one axis.
CUMULATIVE = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}


def _views(evaluator: Evaluator, eqn: Any, values: list[Value]) -> list[Value] | None:
    """The outputs as other views of an array in memory, if it is there."""
    (value, *_) = values
    if value.entries is not None or value.size <= SMALL:
        return None
    assert value.buffer is not None
    name, params = eqn.primitive.name, eqn.params
    if name == "reshape" and params["dimensions"] is None:
        buffers = [evaluator.reshape(value, params["new_sizes"])]
    else:
        count, view = len(eqn.outvars), value.buffer.view
        buffers = [view(lambda x, i=i: move_entries(name, params, x)[i]) for i in range(count)]
    views = [Value.in_memory(x) for x in buffers if x is not None]
    if len(views) < len(buffers):
        check_size(value.size, SMALL, f"elements that {name} copies", value.shape)
    return views


def _concatenation(
    evaluator: Evaluator, eqn: Any, values: list[Value], place: Buffer | None
) -> Value:
    """Arrays one after the other, in memory."""
    (out,) = eqn.outvars
    axis = eqn.params["dimension"]
    if place is None:
        has_lanes = any(value.has_lanes() for value in values)
        place = evaluator.module.scratch(out.aval.shape, str(out.aval.dtype), has_lanes)
    parts = parts_along(place, axis, [value.shape for value in values])
    for value, part in zip(values, parts, strict=True):
        evaluator.write(value, part)
    return Value.in_memory(place)


def _move(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    name = eqn.primitive.name
    if name == "reshape" or name in VIEWS:
        views = _views(evaluator, eqn, values)
        if views is not None:
            return views
    if name == "concatenate" and any(value.entries is None for value in values):
        return [_concatenation(evaluator, eqn, values, places[0])]
    entries = move_entries(name, eqn.params, *(evaluator.entries(value) for value in values))
    return [
        Value(var.aval.shape, var.aval.dtype, np.asarray(array, object))
        for var, array in zip(eqn.outvars, entries, strict=True)
    ]


def _identity(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    return values


RULES |= dict.fromkeys(MOVES, check_types(_move))
RULES |= dict.fromkeys(["reshard", "sharding_constraint", "mesh_cast"], _identity)
