"""Axes: what a sweep varies, and its place in the arguments."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..base.checks import instance
from ..base.inputs import refuse_unit_or_mask
from ..base.precision import refuse_double_without_x64


@dataclass(frozen=True, init=False, eq=False)
class Axis:
    """A named axis of a sweep: the values that one argument takes.

    Axes of different names make a grid, axes of one name vary together (they are zipped).

    **Arguments**

    - `name`: of the dimension in the result, an identifier such as "epsilon".
    - `values`: shape (length, …); what follows the length is the shape of the argument. For
      `method` and `num_steps` a list, each entry of which is compiled.
    - `units`: unit of the values, for labels.

    **Raises** `ValueError` for another name, no values or values that are not finite; `TypeError`
    for values that are not real numbers where numbers are needed.
    """

    name: str
    values: Any
    units: str

    def __init__(self, name: str, values: Any, units: str = ""):
        if not isinstance(name, str) or not (name.isascii() and name.isidentifier()):
            raise ValueError(
                'the name of a dvi.Axis, or of start, must be an identifier such as "epsilon": '
                f"only ASCII letters, digits and _, and no digit at the beginning. Got {name!r}."
            )
        of = f"the axis {name!r}"
        instance(f"the units of {of}", units, str, "text")
        refuse_unit_or_mask(of, values)
        if isinstance(values, jax.Array):
            values = np.asarray(values)
        if not isinstance(values, np.ndarray):
            try:
                values = list(values)
            except TypeError:
                raise TypeError(f"{of} requires a list or array, got {values!r:.200}.") from None
            if values and all(isinstance(v, _NUMBERS) for v in values):
                array = np.asarray(values)
                # Numbers of Python have the precision of the process, as in JAX.
                leaves = jax.tree.leaves(values)
                if array.dtype.kind == "f" and all(type(x) in (int, float) for x in leaves):
                    array = array.astype(jnp.result_type(float))
                values = array
        if isinstance(values, np.ndarray):
            _check(of, values)
        if len(values) == 0:
            raise ValueError(f"{of} has no values: give at least one.")
        for field, value in (("name", name), ("values", values), ("units", units)):
            object.__setattr__(self, field, value)

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        return f"Axis({self.name!r}, {len(self)} values)"


_NUMBERS = (int, float, np.ndarray, np.generic, jax.Array, list, tuple)


def _check(of: str, values: np.ndarray) -> None:
    if values.ndim == 0:
        raise ValueError(f"{of} requires a sequence of values, got only {values}: give [{values}].")
    if values.dtype.kind not in "iuf":
        raise TypeError(f"{of} must have real numbers as values, got dtype {values.dtype}.")
    if not np.isfinite(values).all():
        where = tuple(np.argwhere(~np.isfinite(values))[0].tolist())
        seen = f"{values[where]} at index {list(where)}"
        raise ValueError(f"{of} must have finite values, got {seen}.")


def is_axis(x: Any) -> bool:
    return isinstance(x, Axis)


def as_axis(name: str, value: Any) -> Any:
    """A number argument: a one-dimensional array of it is an axis of the argument's name."""
    if not isinstance(value, list | tuple | np.ndarray | jax.Array) or np.ndim(value) == 0:
        return value
    if np.ndim(value) > 1:
        raise ValueError(
            f"{name} must be a number or a one-dimensional array, got shape {np.shape(value)}. "
            "For a grid, give a one-dimensional array for each argument. For arguments that vary "
            'together, give each argument as dvi.Axis("name", values) with the same name.'
        )
    return Axis(name, value)


def axes_in(arguments: Mapping[str, Any]) -> list[tuple[str, Axis]]:
    """Every axis in the arguments with the name of its place: ``epsilon``, ``args.K``, ``q0.1``."""
    found = []
    for name, argument in arguments.items():
        for path, axis in jax.tree.leaves_with_path(argument, is_leaf=is_axis):
            if not is_axis(axis):
                continue
            where = ".".join(filter(None, (name, place(path))))
            if not isinstance(axis.values, np.ndarray):
                wrong = next(x for x in axis.values if not isinstance(x, _NUMBERS))
                raise TypeError(
                    f"all values of {where} must be numbers, but its axis {axis.name!r} contains "
                    f"{wrong!r:.200} of type {type(wrong).__name__}. Replace or remove this value."
                )
            refuse_double_without_x64(f"the axis {axis.name!r}", axis.values.dtype)
            found.append((where, axis))
    return found


def place(path: Sequence[Any]) -> str:
    """A path of a pytree in one word."""
    parts = (getattr(k, "key", getattr(k, "name", getattr(k, "idx", k))) for k in path)
    return ".".join(str(p) for p in parts)


def lengths(axes: Sequence[tuple[str, int, str]]) -> dict[str, int]:
    """The dimensions of a grid from (name, length, place) of its axes."""
    dims: dict[str, tuple[int, str]] = {}
    for name, length, where in axes:
        known, first = dims.setdefault(name, (length, where))
        if known != length:
            raise ValueError(
                "axes of the same name vary together and must have equal lengths. The axis "
                f"{name!r} has the length {known} in {first}, but {length} in {where}. For a grid, "
                "give the axes different names."
            )
    return {name: length for name, (length, _) in dims.items()}
