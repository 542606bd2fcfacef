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

# Names that the result itself uses.
RESERVED_NAMES = (
    *("status", "failed_step", "residual", "stop_t", "jumps", "t", "q", "p", "save", "q0", "p0"),
)


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
        return {"f": np.nan, "c": np.nan, "b": False}.get(dtype.kind, -1)


def variables(sweep: Sweep, shapes: Mapping[str, Any]) -> dict[str, Variable]:
    """The arrays of a result, with names for their own dimensions."""
    leaves = jax.tree.leaves_with_path(sweep.options["observe"], is_leaf=is_observable)
    observables = [(place(path) or "observed", observable) for path, observable in leaves]
    names = [name for name, _ in observables]
    for name in names:
        check_array_name("the observable", name)
        if names.count(name) > 1:
            raise ValueError(
                f"two observables have the name {name!r} (keys of nested dicts are joined with "
                "dots): rename one."
            )
        if name in sweep.dims:
            raise ValueError(f"the observable {name!r} has the name of an axis: rename it.")
        refuse_reserved_name("observable", name)
    # Observables that are not reduced have a row for each step that ends at a save point: one less
    # than states, except for `Save(ts=...)`.
    save = sweep.options["save"]
    rows = "save" if save is not None and save.ts is not None else "saved_step"
    first = {name: rows for name, f in observables if not isinstance(f, Reduction)}
    # Functions of a state have a row for the initial state, those of a step have none.
    lengths = {name: shapes[name].shape[0] for name in first}
    if len({*lengths.values()}) > 1:
        first |= {name: "save" for name, n in lengths.items() if n == max(lengths.values())}
    first |= dict.fromkeys("tqp", "save")
    first |= {x: "jumps_dim" for x in shapes if x.startswith("jumps.") and shapes[x].shape}
    arrays = {}
    for name, array in shapes.items():
        shape = array.shape[1:] if name in first else array.shape
        is_state = name in ("q", "p") or (name in first and name.startswith("jumps."))
        dims = own_dims("component" if is_state else f"{name}_dim", shape)
        if name in first:
            dims.insert(0, first[name])
        dtype = np.dtype(array.dtype)
        if dtype.kind not in "iufbc":
            raise TypeError(
                f"{name!r} must have a dtype of NumPy, got {dtype}: convert it by .astype(float)."
            )
        arrays[name] = Variable(dtype.name, array.shape, tuple(dims))
    return arrays


def check_array_name(label: str, name: str) -> None:
    """**Raises** `ValueError` for a name that an array in a store or table cannot have."""
    if not _NAME.fullmatch(name) or name.lower() == "zarr.json":
        raise ValueError(
            f"{label} {name!r} cannot be the name of an array: use letters, digits, spaces, _, -, "
            "+ and single dots inside, but not zarr.json."
        )


def refuse_reserved_name(label: str, name: str) -> None:
    """**Raises** `ValueError` for a name whose first part the result itself uses."""
    if name.split(".")[0] in RESERVED_NAMES:
        raise ValueError(
            f"the {label} {name!r} has a reserved name (or first part): rename it. Reserved are "
            f"{', '.join(RESERVED_NAMES)}."
        )


def check_names(dims: Mapping, variables: Mapping[str, Variable], coordinates: Mapping) -> None:
    """Refuse names that would mean two things in one result."""
    dims_of_results = {dim for variable in variables.values() for dim in variable.dims}
    for dims_of_coordinate, *_ in coordinates.values():
        dims_of_results |= {dim for dim in dims_of_coordinate if dim not in dims}
    for label, names, others in (
        ("axis", dims, dims_of_results),
        ("observable", variables, {*dims_of_results, *coordinates}),
    ):
        for name in names:
            if name in others:
                raise ValueError(
                    f"the {label} {name!r} has the name of another axis, argument or dimension: "
                    "rename it."
                )


def own_dims(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names for the dimensions of an array that are not those of the grid."""
    return [name] if len(shape) == 1 else [f"{name}_{i}" for i in range(len(shape))]
