"""A batch as one array program over several devices, on one host or on many."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, PartitionSpec

from .._checks import function as check_function, instance, whole

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
    differentiated and compiled like any function: for a mean over all trajectories and its
    gradient, for instance. Under `jax.distributed.initialize` the devices are those of all hosts,
    which run the same program. For independent trajectories use `sweep`, which loses nothing when a
    host fails.

    **Arguments**

    - `function`: batched, with elements that do not depend on each other.
    - `devices`: None means all of `jax.devices()`.
    - `in_axes`: the batch axis of all arguments, or of each; None for an argument without one.
    - `out_axes`: the batch axis of every output array.

    **Raises** `ValueError` for a batch that the number of devices does not divide; `TypeError` for
    an object that is not a function.
    """
    check_function("the argument of over_devices", function, hint="Give jax.vmap(f), for example.")
    chosen = np.asarray(jax.devices() if devices is None else list(devices))
    if chosen.size == 0:
        raise ValueError("devices is empty: give at least one, or leave devices out to use all.")
    whole("out_axes", out_axes, least=0)
    # Auto: shardings of arguments outside are left to JAX, and need not be declared.
    mesh = jax.sharding.Mesh(chosen, (LANES,), axis_types=(AxisType.Auto,))

    def call(*args: Any) -> Any:
        each = [in_axes] * len(args) if isinstance(in_axes, int | None) else list(in_axes)
        if len(each) != len(args):
            raise ValueError(
                f"in_axes has {len(each)} entries, but there are {len(args)} arguments: give one "
                "entry for each argument, or one number for all."
            )
        for axis in each:
            instance("each entry of in_axes", axis, int | None, "a whole number or None")
        specs = tuple(
            jax.tree.map(lambda x, axis=axis: _spec(x, axis, chosen.size), argument)
            for argument, axis in zip(args, each, strict=True)
        )
        out = PartitionSpec(*(None,) * out_axes, LANES)
        # With check_vma=True there would be no reversible gradient, see `_reversible`.
        mapped = jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=out, check_vma=False)
        return mapped(*args)

    return call


def _spec(x: Any, axis: int | None, count: int) -> PartitionSpec:
    if axis is None:
        return PartitionSpec()
    shape = np.shape(x)
    if not -len(shape) <= axis < len(shape):
        raise ValueError(
            f"in_axes has the batch axis {axis}, but an argument has the shape {shape}: give an "
            "axis of this argument, or None if the argument has no batch axis."
        )
    if shape[axis] % count:
        raise ValueError(
            f"{shape[axis]} trajectories (shape {shape}, axis {axis}) cannot be divided equally "
            f"between {count} devices: use a multiple of {count}, or another number of devices."
        )
    return PartitionSpec(*(None,) * (axis % len(shape)), LANES)
