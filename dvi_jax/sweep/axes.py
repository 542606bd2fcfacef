"""Axes: what a sweep varies, and its place in the arguments."""

from collections.abc import Iterable, Mapping, Sequence
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
                "the name of an axis or start must be an identifier of ASCII letters, digits and "
                f"_, got {name!r}."
            )
        label = f"the axis {name!r}"
        instance(f"the units of {label}", units, str, "text")
        refuse_unit_or_mask(label, values)
        if isinstance(values, jax.Array):
            values = np.asarray(values)
        if not isinstance(values, np.ndarray):
            values = list(instance(label, values, Iterable, "a list or array"))
            if values and all(isinstance(value, _NUMBERS) for value in values):
                array = np.asarray(values)
                # Numbers of Python have the precision of the process, as in JAX.
                leaves = jax.tree.leaves(values)
                if array.dtype.kind == "f" and all(type(x) in (int, float) for x in leaves):
                    array = array.astype(jnp.result_type(float))
                values = array
        if isinstance(values, np.ndarray):
            if values.ndim == 0:
                raise ValueError(f"{label} must be a list or array, got {values}: give [{values}].")
            if values.dtype.kind not in "iuf":
                raise TypeError(f"{label} must have real numbers, got dtype {values.dtype}.")
            refuse_non_finite(label, values)
        if len(values) == 0:
            raise ValueError(f"{label} has no values: give at least one.")
        for field, value in (("name", name), ("values", values), ("units", units)):
            object.__setattr__(self, field, value)

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        return f"Axis({self.name!r}, {len(self)} values)"


_NUMBERS = (int, float, np.ndarray, np.generic, jax.Array, list, tuple)


def refuse_non_finite(label: str, values: np.ndarray) -> None:
    """**Raises** `ValueError` for an array with an infinite number or NaN."""
    if not np.isfinite(values).all():
        index = np.argwhere(~np.isfinite(values))[0].tolist()
        raise ValueError(f"{label} must be finite, got {values[*index]} at index {index}.")


def is_axis(x: Any) -> bool:
    return isinstance(x, Axis)


def as_axis(name: str, value: Any) -> Any:
    """A number argument: a one-dimensional array of it is an axis of the argument's name."""
    if not isinstance(value, list | tuple | np.ndarray | jax.Array) or np.ndim(value) == 0:
        return value
    if np.ndim(value) > 1:
        raise ValueError(
            f"{name} must be a number or a one-dimensional array, got shape {np.shape(value)}. "
            "Arguments vary together if each is a dvi.Axis of the same name."
        )
    return Axis(name, value)


def axes_in(arguments: Mapping[str, Any]) -> list[tuple[str, Axis]]:
    """Every axis in the arguments with the name of its place: ``epsilon``, ``args.K``, ``q0.1``."""
    axes = []
    for name, argument in arguments.items():
        for path, axis in jax.tree.leaves_with_path(argument, is_leaf=is_axis):
            if not is_axis(axis):
                continue
            location = ".".join(filter(None, (name, place(path))))
            if not isinstance(axis.values, np.ndarray):
                for value in axis.values:
                    label = f"each value of {location}, axis {axis.name!r},"
                    instance(label, value, _NUMBERS, "a number")
            refuse_double_without_x64(f"the axis {axis.name!r}", axis.values.dtype)
            axes.append((location, axis))
    return axes


def place(path: Sequence[Any]) -> str:
    """A path of a pytree in one word."""
    parts = (getattr(k, "key", getattr(k, "name", getattr(k, "idx", k))) for k in path)
    return ".".join(str(p) for p in parts)


def lengths(axes: Sequence[tuple[str, int, str]]) -> dict[str, int]:
    """The dimensions of a grid from (name, length, place) of its axes."""
    dims: dict[str, tuple[int, str]] = {}
    for name, length, location in axes:
        first_length, first_place = dims.setdefault(name, (length, location))
        if first_length != length:
            raise ValueError(
                f"axes of one name must have equal lengths, but {name!r} has {first_length} values "
                f"in {first_place} and {length} in {location}. For a grid use different names."
            )
    return {name: length for name, (length, _) in dims.items()}
