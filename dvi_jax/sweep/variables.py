"""The arrays of a result: names, types, shapes."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from ..observe import Reduction, is_observable
from .axes import place
from .program import Sweep

_NAME = re.compile(r"[\w +-]+(\.[\w +-]+)*")

ARRAY_NAMES = (
    "names are letters, digits, spaces and _ - + with points between them, but not zarr.json, for "
    "they become names in files"
)

RESERVED = ("status", "failed_step", "residual", "t", "q", "p", "save", "q0", "p0")
"""Names in a result that are not the user's to give."""


@dataclass(frozen=True)
class Variable:
    """One array of a result: dtype and, behind the dimensions of the grid, its own."""

    dtype: str
    shape: tuple[int, ...] = ()
    dims: tuple[str, ...] = ()

    @property
    def bytes(self) -> int:
        """For one trajectory."""
        return int(np.dtype(self.dtype).itemsize * np.prod(self.shape, dtype=int))

    @property
    def fill(self) -> Any:
        """What stands where nothing has been computed."""
        dtype = np.dtype(self.dtype)
        if dtype.kind == "u":
            return int(np.iinfo(dtype).max)
        return np.nan if dtype.kind in "fc" else -1


def variables(sweep: Sweep, shapes: Mapping[str, Any]) -> dict[str, Variable]:
    """The arrays of a result, with names for their own dimensions.

    **Raises** `ValueError` for an observable with a name that is taken, `TypeError` for one that
    is not real or complex.
    """
    given = [
        place(path) or "observed"
        for path, _ in jax.tree.leaves_with_path(sweep.options["observe"], is_leaf=is_observable)
    ]
    if twice := [n for n in given if given.count(n) > 1]:
        raise ValueError(f"two observables have the name {twice[0]!r}: give one of them another.")
    if bad := [n for n in given if not is_array_name(n)]:
        raise ValueError(f"the observable {bad[0]!r}: {ARRAY_NAMES}.")
    taken = [n for n in given if n.split(".")[0] in RESERVED or n in sweep.dims]
    if taken:
        raise ValueError(
            f"the observable {taken[0]!r} has a name that the result needs for something else "
            f"({', '.join(dict.fromkeys((*RESERVED, *sweep.dims)))}): give it another."
        )
    found = {}
    alone = _alone(sweep)
    for name, x in shapes.items():
        dims: list[str] = []
        rest = x.shape
        if name in ("t", "q", "p"):
            dims, rest = ["save"], rest[1:]
        elif name in alone:
            dims, rest = [alone[name]], rest[1:]
        if name in ("q", "p"):
            dims += own_dims("component", rest)
        else:
            dims += own_dims(f"{name}_dim", rest)
        dtype = np.dtype(x.dtype)
        if dtype.kind not in "iufbc":
            raise TypeError(f"the observable {name!r} has dtype {dtype}: it must be a number.")
        found[name] = Variable("int8" if dtype.kind == "b" else dtype.name, x.shape, tuple(dims))
    return found


def is_array_name(name: str) -> bool:
    """Whether an array in a store, or in another archive, may have this name."""
    return bool(_NAME.fullmatch(name)) and name.lower() != "zarr.json"


def check_names(
    dims: Mapping[str, int], variables: Mapping[str, Variable], coordinates: Mapping[str, Any]
) -> None:
    """Refuse names that would mean two things in one result."""
    own = {d for v in variables.values() for d in v.dims}
    own |= {d for of, *_ in coordinates.values() for d in of if d not in dims}
    if taken := [name for name in dims if name in own]:
        raise ValueError(
            f"the axis {taken[0]!r} has the name of a dimension of the results: give it another."
        )
    if taken := [name for name in variables if name in coordinates or name in own]:
        raise ValueError(
            f"the observable {taken[0]!r} has the name of what varies in the sweep: give it "
            "another."
        )


def _alone(sweep: Sweep) -> dict[str, str]:
    """The observables that stand alone, and the dimension of their rows: steps that end at a save
    point, one less than states but for ``Save(ts=...)``."""
    save = sweep.options["save"]
    rows = "save" if save is not None and save.ts is not None else "saved_step"
    leaves = jax.tree.leaves_with_path(sweep.options["observe"], is_leaf=is_observable)
    return {place(path) or "observed": rows for path, f in leaves if not isinstance(f, Reduction)}


def own_dims(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names for the dimensions of an array that are not those of the grid."""
    return [name] if len(shape) == 1 else [f"{name}_{i}" for i in range(len(shape))]
