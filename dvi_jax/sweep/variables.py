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
    "a name may contain letters, digits, spaces, _, - and +. It may have single dots, but not at "
    "the beginning or end. The name zarr.json is reserved for a file of the store"
)

RESERVED = ("status", "failed_step", "residual", "stop_t", "t", "q", "p", "save", "q0", "p0")
"""Names that the result itself uses."""


@dataclass(frozen=True)
class Variable:
    """One array of a result: dtype and, after the dimensions of the grid, its own."""

    dtype: str
    shape: tuple[int, ...] = ()
    dims: tuple[str, ...] = ()

    @property
    def bytes(self) -> int:
        """For one trajectory."""
        return int(np.dtype(self.dtype).itemsize * np.prod(self.shape, dtype=int))

    @property
    def fill(self) -> Any:
        """The value of entries that have not been computed."""
        dtype = np.dtype(self.dtype)
        if dtype.kind == "u":
            return int(np.iinfo(dtype).max)
        return np.nan if dtype.kind in "fc" else -1


def variables(sweep: Sweep, shapes: Mapping[str, Any]) -> dict[str, Variable]:
    """The arrays of a result, with names for their own dimensions."""
    leaves = jax.tree.leaves_with_path(sweep.options["observe"], is_leaf=is_observable)
    observables = [(place(path) or "observed", f) for path, f in leaves]
    given = [name for name, _ in observables]
    taken = (*RESERVED, *(d for d in sweep.dims if d not in RESERVED))
    for name in given:
        if given.count(name) > 1:
            raise ValueError(
                f"two observables have the name {name!r}, but each must have its own. The keys of "
                "nested dicts are joined with dots: {'a': {'b': f}} gives 'a.b'. Rename one."
            )
        if not is_array_name(name):
            raise ValueError(f"the observable {name!r} cannot have this name: {ARRAY_NAMES}.")
        if name in taken or name.split(".")[0] in RESERVED:
            raise ValueError(
                f"the observable {name!r} has a reserved name: rename it. It must not have the "
                f"name of an axis ({', '.join(sweep.dims)}). Its name, or the part of it before "
                f"the first dot, must not be one of {', '.join(RESERVED)}."
            )
    # Observables that are not reduced have a row for each step that ends at a save point: one less
    # than states, except for `Save(ts=...)`.
    save = sweep.options["save"]
    rows = "save" if save is not None and save.ts is not None else "saved_step"
    first = {name: rows for name, f in observables if not isinstance(f, Reduction)}
    first |= dict.fromkeys("tqp", "save")
    found = {}
    for name, x in shapes.items():
        own = x.shape[1:] if name in first else x.shape
        dims = own_dims("component" if name in ("q", "p") else f"{name}_dim", own)
        if name in first:
            dims.insert(0, first[name])
        dtype = np.dtype(x.dtype)
        if dtype.kind not in "iufbc":
            raise TypeError(
                f"{name!r} must have a dtype of NumPy (bool, integer, float or complex), got dtype "
                f"{dtype}. If it is an observable, convert its result with .astype(float)."
            )
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
    for what, names, taken in (
        ("the axis {!r} has the name of a dimension of the results", dims, own),
        (
            "the observable {!r} has the name of an axis or argument",
            variables,
            {*own, *coordinates},
        ),
    ):
        if both := [name for name in names if name in taken]:
            raise ValueError(f"{what.format(both[0])}: rename it.")


def own_dims(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names for the dimensions of an array that are not those of the grid."""
    return [name] if len(shape) == 1 else [f"{name}_{i}" for i in range(len(shape))]
