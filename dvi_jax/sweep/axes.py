"""What a sweep varies: named axes, and how they lie in its arguments."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._precision import refuse_double_without_x64
from ..engine.quantities import refuse_unit_or_mask

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dataclass(frozen=True, init=False, eq=False)
class Axis:
    """A named axis of a sweep: where it stands in an argument, that argument takes these values.

    Axes of different names make a grid, axes of one name go together (they are zipped).

    **Arguments**

    - `name`: of the dimension in the result, an identifier such as "epsilon".
    - `values`: shape (length, …); what follows the length is the shape of the argument. For
      `method` and `num_steps` a list, each entry of which is compiled.
    - `units`: what they are measured in, for labels.

    **Raises** `ValueError` for another name, no values or values that are not finite; `TypeError`
    for values that are no real numbers where numbers are needed.
    """

    name: str
    values: Any
    units: str

    def __init__(self, name: str, values: Any, units: str = ""):
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise ValueError(f"the name of an axis must be an identifier, got {name!r}.")
        if not isinstance(units, str):
            raise TypeError(f"units of the axis {name!r} must be text, got {units!r}.")
        refuse_unit_or_mask(f"the axis {name!r}", values)
        if isinstance(values, jax.Array):
            values = np.asarray(values)
        if not isinstance(values, np.ndarray):
            try:
                values = list(values)
            except TypeError:
                raise TypeError(
                    f"the axis {name!r} needs a sequence of values, got {values!r}."
                ) from None
            if values and not any(_is_object(v) for v in values):
                array = np.asarray(values)
                # Numbers of Python's have the precision of the process, as in JAX.
                if array.dtype.kind == "f" and all(type(x) in (int, float) for x in _flat(values)):
                    array = array.astype(jnp.result_type(float))
                values = array
        if isinstance(values, np.ndarray):
            values = _checked(name, values)
        if len(values) == 0:
            raise ValueError(f"the axis {name!r} has no values.")
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "units", units)

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        return f"Axis({self.name!r}, {len(self)} values)"


def _flat(values: list[Any]) -> Iterator[Any]:
    for x in values:
        if isinstance(x, list | tuple):
            yield from _flat(list(x))
        else:
            yield x


def _is_object(value: Any) -> bool:
    return not isinstance(value, int | float | np.ndarray | np.generic | jax.Array | list | tuple)


def _checked(name: str, values: np.ndarray) -> np.ndarray:
    if values.ndim == 0:
        raise ValueError(f"the axis {name!r} needs a sequence of values, got the number {values}.")
    if values.dtype.kind not in "iuf":
        raise TypeError(f"the axis {name!r} needs real numbers, got dtype {values.dtype}.")
    if not np.isfinite(values).all():
        where = tuple(np.argwhere(~np.isfinite(values))[0].tolist())
        raise ValueError(f"the axis {name!r} holds {values[where]} at index {list(where)}.")
    return values


@dataclass(frozen=True, eq=False)
class Leaf:
    """One argument that an axis runs through: its name and the axis."""

    name: str
    axis: Axis


def is_axis(x: Any) -> bool:
    return isinstance(x, Axis)


def as_axis(name: str, value: Any) -> Any:
    """A number argument: a one-dimensional array of it is an axis of the argument's name."""
    if not isinstance(value, list | tuple | np.ndarray | jax.Array) or np.ndim(value) == 0:
        return value
    if np.ndim(value) > 1:
        raise ValueError(
            f"{name} must be a number or a one-dimensional array of them, got shape "
            f"{np.shape(value)}: for a grid give the axes one by one, for pairs that go together "
            'dvi.Axis("name", values) of one name.'
        )
    return Axis(name, value)


def leaves_with_axes(arguments: Mapping[str, Any]) -> list[Leaf]:
    """Every axis in the arguments with the name of its place: ``epsilon``, ``args.K``, ``q0.1``."""
    found = []
    for name, argument in arguments.items():
        for path, leaf in jax.tree.leaves_with_path(argument, is_leaf=is_axis):
            if not is_axis(leaf):
                continue
            where = ".".join(filter(None, (name, place(path))))
            if not isinstance(leaf.values, np.ndarray):
                raise TypeError(
                    f"{where} takes numbers, but its axis {leaf.name!r} holds "
                    f"{type(leaf.values[0]).__name__}."
                )
            refuse_double_without_x64(f"the axis {leaf.name!r}", leaf.values.dtype)
            found.append(Leaf(where, leaf))
    return found


def place(path: Sequence[Any]) -> str:
    """A path of a pytree in one word."""
    parts = (getattr(k, "key", getattr(k, "name", getattr(k, "idx", k))) for k in path)
    return ".".join(str(p) for p in parts)


def lengths(axes: Sequence[tuple[str, int, str]]) -> dict[str, int]:
    """The dimensions of a grid from (name, length, place) of its axes.

    **Raises** `ValueError` where axes of one name have different lengths.
    """
    dims: dict[str, tuple[int, str]] = {}
    for name, length, where in axes:
        known, first = dims.setdefault(name, (length, where))
        if known != length:
            raise ValueError(
                f"the axis {name!r} has {known} values in {first} and {length} in {where}: axes of "
                "one name go together and need one length; give them two names for a grid."
            )
    return {name: length for name, (length, _) in dims.items()}
