"""Value of a jaxpr, operation by operation, in NumPy; loops and branches are those of Python.

No compiler chooses the order of operations or contracts products into sums here, and a comparison
has one right answer. Primitives without a rule in this file, such as gathers, are computed by JAX,
each alone.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lanewise.jaxprs.jaxapi import ClosedJaxpr, Literal, bodies, scan_counts


def evaluate(function: ClosedJaxpr, *inputs: Any) -> list[np.ndarray]:
    """The outputs of a jaxpr for these inputs."""
    jaxpr = function.jaxpr
    values = dict(zip(jaxpr.constvars, map(np.asarray, function.consts), strict=True))
    values |= dict(zip(jaxpr.invars, map(np.asarray, inputs), strict=True))

    def read(atom: Any) -> np.ndarray:
        if isinstance(atom, Literal):
            return np.asarray(atom.val, atom.aval.dtype)
        return values[atom]

    for eqn in jaxpr.eqns:
        outs = _outputs(eqn, [read(atom) for atom in eqn.invars])
        for var, out in zip(eqn.outvars, outs, strict=True):
            out = np.asarray(out).astype(var.aval.dtype, copy=False)
            assert out.shape == var.aval.shape, (eqn, out.shape)
            values[var] = out
    return [read(atom) for atom in jaxpr.outvars]


def _outputs(eqn: Any, inputs: list[np.ndarray]) -> Sequence[Any]:
    name, params = eqn.primitive.name, eqn.params
    with np.errstate(all="ignore"):
        if name in FUNCTIONS:
            return [FUNCTIONS[name](*inputs)]
        if name in WITH_PARAMETERS:
            out = WITH_PARAMETERS[name](*inputs, **params)
            return out if eqn.primitive.multiple_results else [out]
    functions = list(bodies(eqn))
    # A call of another function: jit, checkpoint, and derivatives that a user has defined.
    if len(functions) == 1 and len(functions[0].jaxpr.invars) == len(inputs):
        return evaluate(functions[0], *inputs)
    out = eqn.primitive.bind(*inputs, **params)
    return out if eqn.primitive.multiple_results else [out]


# Control flow


def _scan(*inputs, jaxpr, length, reverse, **params):
    num_consts, num_carry = scan_counts(params)
    consts, carry = inputs[:num_consts], list(inputs[num_consts : num_consts + num_carry])
    columns, rows = inputs[num_consts + num_carry :], []
    for i in reversed(range(length)) if reverse else range(length):
        outs = evaluate(jaxpr, *consts, *carry, *(x[i] for x in columns))
        carry, row = outs[:num_carry], outs[num_carry:]
        rows.append(row)
    rows = rows[::-1] if reverse else rows
    types = jaxpr.out_avals[num_carry:]
    columns = [
        np.array([row[k] for row in rows], aval.dtype).reshape(length, *aval.shape)
        for k, aval in enumerate(types)
    ]
    return [*carry, *columns]


def _while(*inputs, cond_nconsts, cond_jaxpr, body_nconsts, body_jaxpr, **_):
    of_condition = inputs[:cond_nconsts]
    of_body = inputs[cond_nconsts : cond_nconsts + body_nconsts]
    carry = inputs[cond_nconsts + body_nconsts :]
    while np.any(goes_on := np.asarray(evaluate(cond_jaxpr, *of_condition, *carry)[0])):
        new = evaluate(body_jaxpr, *of_body, *carry)
        # The condition of each element of a batch holds for the first axes of what is carried.
        shapes = [(*goes_on.shape, *[1] * (np.ndim(x) - goes_on.ndim)) for x in new]
        pairs = zip(shapes, new, carry, strict=True)
        carry = [np.where(goes_on.reshape(shape), x, y) for shape, x, y in pairs]
    return carry


def _cond(index, *inputs, branches, **_):
    return evaluate(branches[int(np.clip(index, 0, len(branches) - 1))], *inputs)


# Moves


def _pad(x, value, *, padding_config):
    shape = [
        max(low + n + max(n - 1, 0) * inner + high, 0)
        for n, (low, high, inner) in zip(x.shape, padding_config, strict=True)
    ]
    out = np.full(shape, value, x.dtype)
    # Where each element goes, and which of them a negative padding takes away.
    places = [
        low + np.arange(n) * (inner + 1)
        for n, (low, _, inner) in zip(x.shape, padding_config, strict=True)
    ]
    keep = [(at >= 0) & (at < n) for at, n in zip(places, shape, strict=True)]
    if x.ndim:
        pairs = list(zip(places, keep, strict=True))
        out[np.ix_(*(at[k] for at, k in pairs))] = x[np.ix_(*keep)]
        return out
    return x


def _broadcast(x, *, shape, broadcast_dimensions, **_):
    full = [1] * len(shape)
    for n, axis in zip(x.shape, broadcast_dimensions, strict=True):
        full[axis] = n
    return np.broadcast_to(x.reshape(full), shape)


def _slice(x, *, start_indices, limit_indices, strides):
    steps = strides or [1] * x.ndim
    return x[tuple(map(slice, start_indices, limit_indices, steps))]


def _starts(x, sizes, indices):
    limits = [n - size for n, size in zip(x.shape, sizes, strict=True)]
    return [int(np.clip(i, 0, most)) for i, most in zip(indices, limits, strict=True)]


def _dynamic_slice(x, *indices, slice_sizes, **_):
    starts = _starts(x, slice_sizes, indices)
    return x[tuple(slice(i, i + n) for i, n in zip(starts, slice_sizes, strict=True))]


def _dynamic_update_slice(x, update, *indices):
    starts, out = _starts(x, update.shape, indices), x.copy()
    out[tuple(slice(i, i + n) for i, n in zip(starts, update.shape, strict=True))] = update
    return out


def _split(x, *, sizes, axis):
    return np.split(x, np.cumsum(sizes)[:-1], axis)


# Reductions and products


def _reduction(function: Callable) -> Callable:
    return lambda x, *, axes, **_: function(x, axis=tuple(axes))


def _place(function: Callable) -> Callable:
    return lambda x, *, axes, index_dtype: function(x, axis=axes[0])


def _cumulative(function: np.ufunc) -> Callable:
    def values(x, *, axis, reverse):
        x = np.flip(x, axis) if reverse else x
        out = function.accumulate(x, axis=axis)
        return np.flip(out, axis) if reverse else out

    return values


def _dot_general(x, y, *, dimension_numbers, **_):
    (of_x, of_y), (batch_x, batch_y) = dimension_numbers
    letters = iter("abcdefghijklmnopqrstuvwxyz")
    names_x = [next(letters) for _ in x.shape]
    names_y = [next(letters) for _ in y.shape]
    for i, j in zip((*of_x, *batch_x), (*of_y, *batch_y), strict=True):
        names_y[j] = names_x[i]
    free_x = [c for i, c in enumerate(names_x) if i not in (*of_x, *batch_x)]
    free_y = [c for i, c in enumerate(names_y) if i not in (*of_y, *batch_y)]
    result = "".join([*(names_x[i] for i in batch_x), *free_x, *free_y])
    return np.einsum(f"{''.join(names_x)},{''.join(names_y)}->{result}", x, y)


# Numbers


def _div(x, y):
    if np.issubdtype(x.dtype, np.floating):
        return x / y
    quotient = np.abs(x) // np.where(y == 0, 1, np.abs(y))  # rounded to zero, as in XLA
    return np.where(y == 0, -1, quotient * np.sign(x) * np.sign(y))


def _select(which, *cases):
    return np.choose(np.broadcast_to(which.astype(int), cases[0].shape), cases)


FUNCTIONS: dict[str, Callable] = {
    **{f.__name__: f for f in (np.sign, np.floor, np.ceil, np.sqrt, np.cbrt, np.sin, np.cos, np.tan,
                               np.sinh, np.cosh, np.tanh, np.exp, np.exp2, np.expm1, np.log,
                               np.log1p, np.square)},
    "abs": np.abs,
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": _div, "rem": np.fmod,
    "max": np.maximum, "min": np.minimum, "neg": np.negative, "pow": np.power, "asin": np.arcsin,
    "acos": np.arccos, "atan": np.arctan, "atan2": np.arctan2, "rsqrt": lambda x: 1 / np.sqrt(x),
    "logistic": lambda x: 1 / (1 + np.exp(-x)), "is_finite": np.isfinite, "select_n": _select,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor,
    "not": np.invert, "shift_left": np.left_shift, "shift_right_arithmetic": np.right_shift,
    "clamp": lambda low, x, high: np.minimum(np.maximum(low, x), high),
    "dynamic_update_slice": _dynamic_update_slice, "add_any": np.add, "copy": np.array,
    "copy_p": np.array,
}  # fmt: skip
"""Primitives without parameters, or whose parameters do not matter."""

WITH_PARAMETERS: dict[str, Callable] = {
    "integer_pow": lambda x, *, y: x ** x.dtype.type(y) if y >= 0 else 1 / x**-y,
    "convert_element_type": lambda x, *, new_dtype, **_: x.astype(new_dtype),
    "reduce_precision": lambda x, **_: x,
    "stop_gradient": lambda x, **_: x,
    "iota": lambda *, dtype, shape, dimension, **_: np.broadcast_to(
        np.arange(shape[dimension]).reshape(
            [-1 if i == dimension else 1 for i in range(len(shape))]
        ),
        shape,
    ).astype(dtype),
    "broadcast_in_dim": _broadcast,
    "reshape": lambda x, *, new_sizes, **_: x.reshape(new_sizes),
    "squeeze": lambda x, *, dimensions: np.squeeze(x, tuple(dimensions)),
    "expand_dims": lambda x, *, dimensions: np.expand_dims(x, tuple(dimensions)),
    "transpose": lambda x, *, permutation: np.transpose(x, permutation),
    "rev": lambda x, *, dimensions: np.flip(x, tuple(dimensions)),
    "slice": _slice,
    "dynamic_slice": _dynamic_slice,
    "concatenate": lambda *xs, dimension: np.concatenate(xs, dimension),
    "pad": _pad,
    "split": _split,
    "reduce_sum": _reduction(np.sum),
    "reduce_prod": _reduction(np.prod),
    "reduce_max": _reduction(np.max),
    "reduce_min": _reduction(np.min),
    "reduce_and": _reduction(np.all),
    "reduce_or": _reduction(np.any),
    "argmax": _place(np.argmax),
    "argmin": _place(np.argmin),
    "cumsum": _cumulative(np.add),
    "cumprod": _cumulative(np.multiply),
    "cummax": _cumulative(np.maximum),
    "cummin": _cumulative(np.minimum),
    "dot_general": _dot_general,
    "scan": _scan,
    "while": _while,
    "cond": _cond,
}
