"""A batch as one array program over several devices, of one machine or of many."""

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
    """The batched `function` with its lanes divided between devices, as one array program.

    ``jax.jit(dvi.over_devices(jax.vmap(one)))(q0, p0)`` gives what ``jax.jit(jax.vmap(one))(q0,
    p0)`` does, each device computing its part of the lanes. It is differentiated and compiled like
    any function: for a mean over all trajectories and its gradient, say. Under
    `jax.distributed.initialize` the devices are those of all hosts, which run the same program.
    Independent trajectories are better off with `sweep`, which loses nothing when a host is lost.

    **Arguments**

    - `function`: batched, with lanes that do not depend on each other.
    - `devices`: None means all of `jax.devices()`.
    - `in_axes`: the axis of lanes of all arguments, or of each; None where one has no lanes.
    - `out_axes`: that of every output array.

    **Raises** `ValueError` for numbers of lanes that the devices do not divide; `TypeError` for
    something that is no function.
    """
    check_function("what over_devices takes", function, hint="jax.vmap(one), for example.")
    chosen = np.asarray(jax.devices() if devices is None else list(devices))
    if chosen.size == 0:
        raise ValueError("over_devices needs at least one device.")
    whole("out_axes", out_axes, least=0)
    mesh = jax.sharding.Mesh(chosen, (LANES,), axis_types=(AxisType.Auto,))

    def call(*args: Any) -> Any:
        each = [in_axes] * len(args) if isinstance(in_axes, int | None) else list(in_axes)
        if len(each) != len(args):
            raise ValueError(
                f"in_axes has {len(each)} entries for {len(args)} arguments: give one for each, or "
                "one number for all."
            )
        for axis in each:
            instance("an axis of lanes", axis, int | None, "a whole number or None")
        specs = tuple(
            jax.tree.map(lambda x, axis=axis: _spec(x, axis, chosen.size), argument)
            for argument, axis in zip(args, each, strict=True)
        )
        out = PartitionSpec(*(None,) * out_axes, LANES)
        mapped = jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=out, check_vma=False)
        return mapped(*args)

    return call


def _spec(x: Any, axis: int | None, count: int) -> PartitionSpec:
    if axis is None:
        return PartitionSpec()
    shape = np.shape(x)
    if not -len(shape) <= axis < len(shape):
        raise ValueError(
            f"in_axes says that lanes are along axis {axis}, but an argument has shape {shape}: "
            "give None for arguments without lanes."
        )
    if shape[axis] % count:
        raise ValueError(
            f"{shape[axis]} lanes (shape {shape}, axis {axis}) cannot be divided between {count} "
            "devices: take a multiple of them, or fewer devices."
        )
    return PartitionSpec(*(None,) * (axis % len(shape)), LANES)
