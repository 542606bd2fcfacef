"""Constant indices of a traced function that are outside of the array."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from lanewise.jaxprs.jaxapi import ClosedJaxpr, Literal

SMALL = 64
"""Entries of the largest array of indices that is followed."""

_OPERATIONS: dict[str, Any] = {
    "lt": np.less,
    "add": np.add,
    "sub": np.subtract,
    "select_n": lambda condition, no, yes: np.where(condition, yes, no),
    "convert_element_type": lambda x: x,
    "squeeze": np.squeeze,
}
"""Operations that JAX applies to an index before it is used."""


def out_of_bounds(program: ClosedJaxpr) -> Iterator[tuple[int, int]]:
    """(index, size of the axis) of each constant index that is not in its array; JAX moves it to
    the end of the array without an error."""
    constants: dict[Any, Any] = dict(zip(program.jaxpr.constvars, program.consts, strict=True))

    def value(atom: Any) -> np.ndarray | None:
        constant = atom.val if isinstance(atom, Literal) else constants.get(atom)
        try:
            array = None if constant is None else np.asarray(constant)
        except Exception:  # a traced constant has no value
            return None
        return array if array is not None and array.size <= SMALL else None

    for equation in program.jaxpr.eqns:
        name, inputs = equation.primitive.name, [value(x) for x in equation.invars]
        if name in ("pjit", "jit") and "jaxpr" in equation.params:
            yield from out_of_bounds(equation.params["jaxpr"])
        elif name == "dynamic_slice":
            sizes, shape = equation.params["slice_sizes"], equation.invars[0].aval.shape
            for start, size, length in zip(inputs[1:], sizes, shape, strict=True):
                if start is not None and not 0 <= start <= length - size:
                    # JAX has added the length to a negative index.
                    yield int(start if start >= 0 else start - length), length
        elif name == "gather" and inputs[1] is not None:
            axes = equation.params["dimension_numbers"].start_index_map
            shape = equation.invars[0].aval.shape
            for axis, column in zip(axes, np.moveaxis(inputs[1], -1, 0), strict=True):
                violations = column[(column < 0) | (column >= shape[axis])]
                # One wrong index of an array is enough for a message.
                yield from ((int(i), shape[axis]) for i in violations.ravel()[:1])
        elif name == "broadcast_in_dim" and inputs[0] is not None:
            shape, axes = equation.params["shape"], equation.params["broadcast_dimensions"]
            if np.prod(shape) <= SMALL:
                lengths = np.ones(len(shape), int)
                lengths[list(axes)] = inputs[0].shape
                constants[equation.outvars[0]] = np.broadcast_to(inputs[0].reshape(lengths), shape)
        elif name in _OPERATIONS and all(x is not None for x in inputs):
            constants[equation.outvars[0]] = _OPERATIONS[name](*inputs)
