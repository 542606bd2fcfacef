"""A batch as one array program over several devices, on one host or on many."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, PartitionSpec

from .checks import function as check_function, instance, whole

LANES = "lanes"
"""The name of the axis of devices."""


def over_devices(
    function: Callable[..., Any],
    devices: Sequence[Any] | None = None,
    in_axes: int | Sequence[int | None] | None = 0,
    out_axes: int = 0,
) -> Callable[..., Any]:
    """The batched `function` with its batch divided between devices, as one array program.

    ``jax.jit(dvi.over_devices(jax.vmap(one)))(q0, p0)`` returns the same as
    ``jax.jit(jax.vmap(one))(q0, p0)``; each device computes its part of the batch. It can be
    differentiated and compiled like any function: for the gradient of a mean, for instance. Under
    `jax.distributed.initialize` the devices are those of all hosts, which run the same program. For
    independent trajectories use `sweep`, which keeps all finished results if a host fails.

    **Arguments**

    - `function`: batched, with elements that do not depend on each other.
    - `devices`: None means all of `jax.devices()`.
    - `in_axes`: the batch axis of all arguments, or of each; None for an argument without one.
    - `out_axes`: the batch axis of every output array.

    **Raises** `ValueError` for a batch that the number of devices does not divide; `TypeError` for
    an object that is not a function.
    """
    check_function("the argument of over_devices", function, hint="Give jax.vmap(f), for example.")
    array = np.asarray(jax.devices() if devices is None else list(devices))
    whole("the number of devices", array.size)
    whole("out_axes", out_axes, low=0)
    # Auto: shardings of arguments outside are left to JAX, and need not be declared.
    mesh = jax.sharding.Mesh(array, (LANES,), axis_types=(AxisType.Auto,))

    def call(*args: Any) -> Any:
        axes: Any = in_axes
        entries = list(axes) if isinstance(axes, list | tuple) else [axes] * len(args)
        if len(entries) != len(args):
            raise ValueError(
                f"in_axes must have one entry for {len(args)} arguments, got {in_axes!r}."
            )
        for axis in entries:
            instance("each entry of in_axes", axis, int | None, "a whole number or None")
        specs = tuple(
            jax.tree.map(lambda x, i=i: _spec(x, i, entries[i], array.size), argument)
            for i, argument in enumerate(args)
        )
        out = PartitionSpec(*(None,) * out_axes, LANES)
        # With check_vma=True there would be no reversible gradient: `integration/reversible.py`.
        options: Any = {"in_specs": specs, "out_specs": out, "check_vma": False}
        return jax.shard_map(function, mesh=mesh, **options)(*args)

    return call


def _spec(x: Any, i: int, axis: int | None, count: int) -> PartitionSpec:
    if axis is None:
        return PartitionSpec()
    shape = np.shape(x)
    if not -len(shape) <= axis < len(shape):
        raise ValueError(
            f"in_axes must give an axis of each array, got {axis} for shape {shape} in argument "
            f"{i} (from 0). Use None for an argument without batch axis."
        )
    if shape[axis] % count:
        raise ValueError(
            f"the batch must be a multiple of {count}, the number of devices, got {shape[axis]} "
            f"(axis {axis} of shape {shape} in argument {i}, from 0). Give fewer devices=..., or "
            "another batch."
        )
    return PartitionSpec(*(None,) * (axis % len(shape)), LANES)
