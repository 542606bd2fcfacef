"""Results with labels: datasets of xarray, and what ArviZ takes."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

import dvi_jax as dvi

from ..base.checks import instance
from ..base.inputs import refuse_unit_or_mask
from ..base.results import STATUS_NAMES, status_code
from .extras import require

_RESERVED_NAMES = ("t", "q", "p", "h", "status", "time", "save", "step")


def to_xarray(
    solution: dvi.Solution,
    *,
    dims: Sequence[str] = (),
    coords: Mapping[str, Any] | None = None,
    observe: Any = None,
    components: Mapping[str, Any] | Sequence[Any] | None = None,
    units: Mapping[str, str] | None = None,
    attrs: Mapping[str, Any] | None = None,
) -> Any:
    """A trajectory, or a batch of them, as an `xarray.Dataset`.

    - `solution`: the result of `integrate`; under `vmap`, with the batch in front.
    - `dims`: names for the dimensions of the batch, in order; `coords`: name → values along one.
    - `observe`: the same as for `integrate`, from which follows which observables have one value
      for each step. Without it none of their dimensions is called "step".
    - `components`: labels along the axes of q and p: ``["x", "y"]`` for one axis, or name → labels
      for each axis, ``{"body": ["Sun", "Jupiter"], "axis": ["x", "y", "z"]}``.
    - `units`: name of a variable → text, such as ``problem.units``; `attrs`: attributes of the
      whole, numbers and text as they are, anything else (a method) as its text.

    **Returns** a dataset with dimensions `dims`, then

    - ``time`` where all trajectories are saved at the same times, which are its coordinate; else
      ``save``, and the times are a variable `t`;
    - ``component`` or the names in `components`;
    - ``step`` for values of the step that ended at a saved time: its index is that of the state at
      its end (for ``Save(ts=...)`` the dimension of the states itself).

    Variables: `q`, `p`, `h`; observables by their place in the pytree, joined by points, one alone
    as ``observed``, the first of a list as ``observed.0``; `status` (int8, with ``flag_values`` and
    ``flag_meanings``); the arrays in ``solution.stats``; ``stop_t``, ``stop_q``, ``stop_p`` for a
    run with a `Stop`. NaN stays NaN.
    ``dataset.to_netcdf(path, engine="h5netcdf")`` writes it (extra ``export``).

    **Raises** `ValueError` for a number of `dims` that is not that of the batch, labels that do not
    fit, an `observe` of another structure, and names that are in use; `TypeError` for another
    object than a solution, and for coords with units (which belong in `units`).
    """
    import xarray as xr

    hint = "For a sweep call sweep.to_xarray(). For a UnitSolution s give s.solution and units=."
    instance("solution", solution, dvi.Solution, "a dvi.Solution", hint)
    dims = (dims,) if isinstance(dims, str) else tuple(dims)
    if solution.result.is_traced():
        raise TypeError(
            "solution must have numbers, got JAX tracers: call to_xarray outside of jit and vmap."
        )
    ts, hs = np.asarray(solution.ts), np.asarray(solution.hs)
    *batch, count = ts.shape
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
        if per_step and own_shape[:1] != hs.shape[-1:]:
            raise ValueError(
                "observe must be the same as for integrate: "
                f"{name!r} has values of {hs.shape[-1]} steps, got shape {own_shape}."
            )
        front = [step] * per_step
        add(name, [*front, *_dims_of(name, own_shape[len(front) :])], value)
    flags: dict[str, Any] = {"flag_values": np.arange(len(STATUS_NAMES), dtype=np.int8)}
    flags |= {"flag_meanings": " ".join(STATUS_NAMES)}
    codes = np.asarray(status_code(solution.result))
    variables["status"] = (dims, codes.astype(np.int8), flags)
    for name, value in solution.stats.items():
        if name != "num_steps":
            add(name, _dims_of(name, np.shape(value)[len(batch) :]), value)
    for name, value in zip("tqp", solution.stop or (), strict=False):
        add(f"stop_{name}", [] if name == "t" else of_state, value)
    for name, values in (coords or {}).items():
        refuse_unit_or_mask(f"coords {name}", values)
    coordinates = {axis: index, **labels, **(coords or {})}
    if step == "step":
        coordinates["step"] = np.arange(1, count)
    attributes: dict[str, Any] = {"software": f"dvi_jax {dvi.__version__}"}
    attributes |= {"num_steps": int(np.ravel(solution.stats["num_steps"])[0])}
    attributes |= {name: _attribute(value) for name, value in (attrs or {}).items()}
    data = xr.Dataset(variables, coordinates, attributes)
    alike_in = {"t": ("t", "time", "h", "stop_t"), "q": ("q", "stop_q"), "p": ("p", "stop_p")}
    for name, text in (units or {}).items():
        for alias in alike_in.get(name, (name,)):
            if alias in data.variables:
                data[alias].attrs["units"] = text
    return data


def to_inference_data(samples: dvi.Samples, observed: Any = None) -> Any:
    """Samples of ``dvi.sample`` as an object of ArviZ.

    - `samples`: a `Samples`. `observed`: the `Observations` that it was drawn for, or a list of
      them, or None.

    **Returns** ArviZ's `InferenceData` for arviz 0.x; an `xarray.DataTree` for arviz 1.x and
    arviz-base. Groups, dimensions chain and draw:

    - ``posterior``: one variable for each name of `samples`;
    - ``sample_stats``: ``diverging``, ``lp`` (log density in the free variables, up to a constant),
      ``n_steps``, ``tree_depth`` (of a tree of so many leapfrog steps), and ``acceptance_rate``,
      the mean of each chain, along chain alone;
    - ``observed_data``, with `observed`: ``values`` (or ``values_0``, … of a list), along ``ts``.

    **Raises** `ImportError` without arviz and arviz-base; `TypeError` for another object.
    """
    import xarray as xr

    hint = "For trajectories use interop.to_xarray."
    instance("samples", samples, dvi.Samples, "a result of dvi.sample", hint)
    try:
        arviz = require("arviz", "interop.to_inference_data")
    except ImportError:
        arviz = require("arviz_base", "interop.to_inference_data")
    tree = samples.to_xarray()
    groups = {name: tree[name].to_dataset() for name in tree.children}
    steps = np.asarray(samples.steps)
    groups["sample_stats"] = groups["sample_stats"].assign(
        tree_depth=(("chain", "draw"), np.ceil(np.log2(steps + 1)).astype(int)),
        acceptance_rate=(("chain",), np.asarray(samples.acceptance)),
    )
    if observed is not None:
        arcs = list(observed) if isinstance(observed, list | tuple) else [observed]
        arrays, where = {}, {}
        for i, arc in enumerate(arcs):
            instance("observed", arc, dvi.Observations, "dvi.Observations, or a list of these")
            end = "" if len(arcs) == 1 else f"_{i}"
            values, name_of_values = np.asarray(arc.values), f"values{end}"
            axes = (f"ts{end}", *_dims_of(name_of_values, values.shape[1:]))
            arrays[name_of_values] = (axes, values)
            where[f"ts{end}"] = np.asarray(arc.ts)
        groups["observed_data"] = xr.Dataset(arrays, where)
    attributes = {"inference_library": "dvi_jax", "inference_library_version": dvi.__version__}
    attributes |= {"sampler": "NUTS of numpyro", "status": samples.status}
    for group in groups.values():
        group.attrs.update(attributes)
    if hasattr(arviz, "InferenceData"):  # version 0.x, later ones take trees
        return arviz.InferenceData(**groups)
    return xr.DataTree.from_dict(groups)


def _check_free(where: str, name: str, is_taken: bool) -> None:
    if is_taken:
        raise ValueError(f"{where} has the name {name!r}, which is already in use: choose another.")


def _components(
    components: Mapping[str, Any] | Sequence[Any] | None, shape: tuple[int, ...]
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Names of the axes of a state, and labels along them."""
    if components is None:
        return tuple(_dims_of("component", shape)), {}
    if not isinstance(components, Mapping):
        components = {"component": components}
    sizes = tuple(len(labels) for labels in components.values())
    if sizes != tuple(shape):
        raise ValueError(
            f"components must have labels of all axes of q, shape {tuple(shape)}, got {sizes}."
        )
    return tuple(components), {name: list(labels) for name, labels in components.items()}


def _dims_of(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names for the dimensions that are a variable's own."""
    word = name if name == "component" else f"{name}_dim"
    return [word] if len(shape) == 1 else [f"{word}_{i}" for i in range(len(shape))]


def _observed(observed: Any, observe: Any) -> list[tuple[str, np.ndarray, bool]]:
    """Name, values and whether there is one for each step, of every array among the observed."""

    def is_observable(x: Any) -> bool:
        return x is None or callable(x) or isinstance(x, dvi.Reduction | dvi.Running)

    def flags_of(observable: Any, values: Any) -> Any:
        return jax.tree.map(
            lambda _: observable is not None and not isinstance(observable, dvi.Reduction), values
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
