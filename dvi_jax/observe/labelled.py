"""Trajectories with labels: datasets of xarray, and tables of pandas."""

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..base.inputs import refuse_unit_or_mask
from ..base.results import STATUS_NAMES, status_code, status_name
from ._reductions import Reduction, Running

_RESERVED_NAMES = ("t", "q", "p", "h", "status", "time", "save", "step")


def dataset_of(
    solution: Any,
    *,
    dims: Sequence[str] | str | None = None,
    coords: Mapping[str, Any] | None = None,
    observe: Any = None,
    components: Mapping[str, Any] | Sequence[Any] | None = None,
    units: Mapping[str, str] | None = None,
    attrs: Mapping[str, Any] | None = None,
) -> Any:
    """`Solution.to_xarray`, which see."""
    import xarray as xr

    if solution.result.is_traced():
        raise TypeError(
            "solution must have numbers, got JAX tracers: call to_xarray outside of jit and vmap."
        )
    ts, hs = np.asarray(solution.ts), np.asarray(solution.hs)
    *batch, count = ts.shape
    if dims is None:
        dims = axis_names("trajectory", batch)
    dims = (dims,) if isinstance(dims, str) else tuple(dims)
    if len(dims) != len(batch):
        n, sizes = len(batch), tuple(batch)
        raise ValueError(f"dims must have {n} names, of axes of sizes {sizes}, got {dims}.")
    for name in dims:
        _check_free("dims", name, name in _RESERVED_NAMES or dims.count(name) > 1)
    rows = ts.reshape(-1, count)
    alike = bool(np.isfinite(rows).all() and (rows == rows[:1]).all())
    axis, index = ("time", rows[0]) if alike else ("save", np.arange(count))
    step = axis if hs.shape[-1] == count else "step"
    of_state, labels = _components(components, np.shape(solution.qs)[len(dims) + 1 :])
    variables: dict[str, Any] = {} if alike else {"t": ((*dims, axis), ts)}
    state = ("q", solution.qs), ("p", solution.ps)
    variables |= {name: ((*dims, axis, *of_state), np.asarray(x)) for name, x in state}
    variables["h"] = ((*dims, step), hs)

    def add(name: str, axes: Sequence[str], value: Any) -> None:
        first = name.partition(".")[0]
        is_reserved = first in _RESERVED_NAMES
        is_taken = is_reserved or name in variables
        _check_free("observe of dvi.integrate", first if is_reserved else name, is_taken)
        variables[name] = ((*dims, *axes), np.asarray(value))

    for name, value, per_step in _observed(solution.observed, observe):
        own_shape = value.shape[len(dims) :]
        lengths = {count: axis, hs.shape[-1]: step}
        if per_step and (not own_shape or own_shape[0] not in lengths):
            raise ValueError(
                f"observe must be the same as for integrate: {name!r} has a value for each of "
                f"{count} states or {hs.shape[-1]} steps, got shape {own_shape}."
            )
        front = [lengths[own_shape[0]]] if per_step else []
        add(name, [*front, *axis_names(name, own_shape[len(front) :])], value)
    flags: dict[str, Any] = {"flag_values": np.arange(len(STATUS_NAMES), dtype=np.int8)}
    flags |= {"flag_meanings": " ".join(STATUS_NAMES)}
    codes = np.asarray(status_code(solution.result))
    variables["status"] = (dims, codes.astype(np.int8), flags)
    for name, value in solution.stats.items():
        if name != "num_steps":
            add(name, axis_names(name, np.shape(value)[len(batch) :]), value)
    for name, value in zip("tqp", solution.stop or (), strict=False):
        add(f"stop_{name}", [] if name == "t" else of_state, value)
    jumps = solution.jumps
    for name, value in () if jumps is None else vars(jumps).items():
        add(f"jumps.{name}", ["jumps_dim", *of_state][: np.ndim(value) - len(dims)], value)
    for name, values in (coords or {}).items():
        refuse_unit_or_mask(f"coords {name}", values)
    coordinates = {axis: index, **labels, **(coords or {})}
    if step == "step":
        coordinates["step"] = np.arange(1, count)
    attributes: dict[str, Any] = {"software": f"dvi_jax {version('dvi-jax')}"}
    attributes |= {"num_steps": int(np.ravel(solution.stats["num_steps"])[0])}
    attributes |= {name: _attribute(value) for name, value in (attrs or {}).items()}
    data = xr.Dataset(variables, coordinates, attributes)
    alike_in = {"t": ("t", "time", "h", "stop_t", "jumps.ts")}
    alike_in |= {x: (x, f"stop_{x}", f"jumps.{x}s_before", f"jumps.{x}s_after") for x in "qp"}
    for name, text in (units or {}).items():
        for alias in alike_in.get(name, (name,)):
            if alias in data.variables:
                data[alias].attrs["units"] = text
    return data


def table_of(solution: Any, **labels: Any) -> Any:
    """`Solution.to_dataframe`, which see."""
    import pandas as pd

    data = dataset_of(solution, **labels)
    batch = np.asarray(solution.ts).shape[:-1]
    dims = data.status.dims
    axis = "time" if "time" in data.dims else "save"
    count = data.sizes[axis]
    columns: dict[str, Any] = {}

    def add(name: str, values: Any, is_of_step: bool = False) -> None:
        column: Any = np.broadcast_to(values, (*batch, count)).flatten()
        if is_of_step:  # no step has reached the start; integers and booleans have no NaN
            column = column if column.dtype.kind in "fc" else pd.array(column)
            column[::count] = np.nan if column.dtype.kind in "fc" else pd.NA
        columns[name] = column

    # Reductions and statistics have one value for a run, which is no column of its states.
    add("t", data.time if axis == "time" else data.t)
    for name, variable in data.data_vars.items():
        front = variable.dims[: len(dims) + 1]
        is_of_step = front == (*dims, "step")
        if name == "t" or not (is_of_step or front == (*dims, axis)):
            continue
        values = variable.values
        if is_of_step:  # a row for the start
            values = np.insert(values, 0, 0, axis=len(batch))
        own = variable.dims[len(dims) + 1 :]
        for place in np.ndindex(*values.shape[len(batch) + 1 :]):
            labels_of = [
                data[d].values[i] if d in data.coords else i
                for d, i in zip(own, place, strict=True)
            ]
            add("_".join(map(str, (name, *labels_of))), values[(..., *place)], is_of_step)
    add("status", np.asarray(status_name(solution.result))[..., None])
    index = {d: data[d].values if d in data.coords else np.arange(data.sizes[d]) for d in dims}
    # The state within a trajectory is the last level of the index.
    index["save"] = np.arange(count)
    # One trajectory has no names for its rows: their numbers are those of the states.
    rows = pd.MultiIndex.from_product([*index.values()], names=[*index]) if dims else None
    return pd.DataFrame(columns, rows)


def _check_free(where: str, name: str, is_taken: bool) -> None:
    if is_taken:
        raise ValueError(f"{where} has the name {name!r}, which is already in use: choose another.")


def _components(
    components: Mapping[str, Any] | Sequence[Any] | None, shape: tuple[int, ...]
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Names of the axes of a state, and labels along them."""
    if components is None:
        return tuple(axis_names("component", shape)), {}
    if not isinstance(components, Mapping):
        components = {"component": components}
    sizes = tuple(len(labels) for labels in components.values())
    if sizes != tuple(shape):
        raise ValueError(
            f"components must have labels of all axes of q, shape {tuple(shape)}, got {sizes}."
        )
    return tuple(components), {name: list(labels) for name, labels in components.items()}


def axis_names(name: str, shape: Sequence[int]) -> list[str]:
    """Names for the dimensions that are a variable's own."""
    word = name if name in ("component", "trajectory") else f"{name}_dim"
    return [word] if len(shape) == 1 else [f"{word}_{i}" for i in range(len(shape))]


def _observed(observed: Any, observe: Any) -> list[tuple[str, np.ndarray, bool]]:
    """Name, values and whether there is one for each step, of every array among the observed."""

    def is_observable(x: Any) -> bool:
        return x is None or callable(x) or isinstance(x, Reduction | Running)

    def flags_of(observable: Any, values: Any) -> Any:
        return jax.tree.map(
            lambda _: observable is not None and not isinstance(observable, Reduction), values
        )

    try:
        # Without `observe` one None applies to all.
        flags = jax.tree.map(flags_of, observe, observed, is_leaf=is_observable)
    except ValueError:
        structure = jax.tree.structure(observe, is_leaf=is_observable)
        raise ValueError(
            f"observe must be the same as for integrate, got the structure {structure} for "
            f"{jax.tree.structure(observed)}."
        ) from None
    arrays = jax.tree.leaves_with_path(observed, is_leaf=eqx.is_array)
    names = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in arrays]
    names = [f"observed.{n}".rstrip(".") if not n or n[0].isdigit() else n for n in names]
    rows = zip(names, arrays, jax.tree.leaves(flags), strict=True)
    return [(name, np.asarray(x), flag) for name, (_, x), flag in rows]


def _attribute(value: Any) -> Any:
    """A value that a file can keep as an attribute."""
    if isinstance(value, str | int | float | np.number) and not isinstance(value, bool):
        return value
    array = np.asarray(value) if hasattr(value, "shape") else np.asarray(None)
    return array if array.ndim <= 1 and array.dtype.kind in "if" else str(value)
