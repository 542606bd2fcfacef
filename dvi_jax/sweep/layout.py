"""A sweep on disk: the arrays of a store in zarr, their names and attributes."""

import contextlib
import json
import math
import os
import shutil
import uuid
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..base.files import TEMPORARY, sync
from ..base.results import STATUS_NAMES
from .identity import FORMAT, digest
from .plan import SweepPlan, SweepTask
from .variables import Variable, check_array_name

TASKS = ".tasks"  # The directory of the records of tasks
STATUS = "status"  # The variable of which the shard is written last
CHUNK_BYTES = 2**22  # An inner chunk of a shard: the least that is read to see one number


class StoreError(Exception):
    """Raised for a store that cannot be used; the message has the reason and a remedy."""


@contextlib.contextmanager
def as_store_error(path: Path, failure: str, remedy: str = "") -> Iterator[None]:
    """Raise an error of the operating system as a `StoreError`: what failed, and what to do."""
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"{path}: {failure} ({error.strerror or error}). Check the path, its permissions and "
            f"the disk space.{remedy}"
        ) from error


def layout(chunk: tuple[int, ...], variable: Variable) -> dict[str, Any]:
    """The options of zarr for an array: a shard for each task, in it chunks of some megabytes."""
    from zarr import codecs

    shard = tuple(max(n, 1) for n in (*chunk, *variable.shape))  # zarr has no chunks of length 0
    inner = list(shard)
    size = math.prod(shard) * np.dtype(variable.dtype).itemsize
    for i, n in enumerate(shard):
        divisors = (d for d in range(1, n + 1) if n % d == 0)
        parts = next(d for d in divisors if d == n or size / d <= CHUNK_BYTES)
        # A prime length, for example, would give tiny chunks, which take long to write.
        if size / parts < CHUNK_BYTES / 16 and i + 1 < len(shard):
            continue
        inner[i] = n // parts
        size //= parts
        if size <= CHUNK_BYTES:
            break
    return {
        "dtype": variable.dtype,
        "shards": shard,
        "chunks": tuple(inner),
        "compressors": [codecs.ZstdCodec(level=1), codecs.Crc32cCodec()],
        "fill_value": variable.fill,
        "config": {"write_empty_chunks": True},
    }


def shard(plan: SweepPlan, variable: Variable, task: SweepTask, values: np.ndarray) -> bytes:
    """The bytes of one shard, made in memory so that they can be written in one piece."""
    if variable.bytes == 0:  # an array without entries has no chunks
        return b""
    import zarr
    from zarr.storage import MemoryStore

    files: dict[str, Any] = {}
    shape = (*plan.chunk, *variable.shape)
    array = zarr.create_array(MemoryStore(files), shape=shape, **layout(plan.chunk, variable))
    array[tuple(slice(size) for size in task.size)] = values
    (content,) = (x for key, x in files.items() if key.startswith("c/"))
    return content.to_bytes()


def make(
    path: Path,
    config: Mapping[str, Any],
    variables: Mapping[str, Variable],
    coordinates: Mapping[str, Any],
    attributes: Mapping[str, Any],
) -> None:
    """Make a store under another name and rename it: it appears as a whole or not at all."""
    for name in (*coordinates, *variables):
        check_array_name("the argument or result", name)
    plan = SweepPlan(dict(config["dims"]), tuple(config["chunk"]))
    attributes = {
        "Conventions": "CF-1.11",
        "dvi_jax_sweep": FORMAT,
        "config": json.dumps(config),
        "config_sha256": digest(config),
        **attributes,
    }
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}{TEMPORARY}")
    try:
        with as_store_error(path, "the store cannot be made"):
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_arrays(temporary, plan, variables, coordinates, attributes)
            (temporary / TASKS).mkdir()
            for file in filter(Path.is_file, temporary.rglob("*")):
                sync(file)
            try:
                os.rename(temporary, path)
            except OSError:
                # Another process may have made it meanwhile; otherwise this is an error.
                if not (path / "zarr.json").exists():
                    raise
            sync(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_arrays(folder: Path, plan: SweepPlan, variables, coordinates, attributes) -> None:
    """The coordinates with their values, the variables without values."""
    import zarr
    from zarr import codecs

    units = json.loads(attributes.get("units", "{}"))
    group = zarr.create_group(folder, attributes=attributes)
    for name, (dims, values, labels) in coordinates.items():
        group.create_array(
            name,
            data=storable(values),
            chunks=values.shape,
            dimension_names=dims,
            attributes=labels,
            compressors=[codecs.ZstdCodec(), codecs.Crc32cCodec()],
            config={"write_empty_chunks": True},
        )
    for name, variable in variables.items():
        group.create_array(
            name,
            shape=(*plan.shape, *variable.shape),
            dimension_names=(*plan.dims, *variable.dims),
            attributes=about_variable(name, units),
            **layout(plan.chunk, variable),
        )
    with warnings.catch_warnings():  # zarr warns that this is not yet a part of the format
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(folder)


def storable(values: np.ndarray) -> np.ndarray:
    """Text as a type of any length, which zarr has; numbers unchanged."""
    return values.astype(np.dtypes.StringDType()) if values.dtype.kind == "U" else values


_ATTRIBUTES = {
    STATUS: {
        "long_name": "how each trajectory ended",
        "flag_values": [-1, *range(len(STATUS_NAMES))],
        "flag_meanings": " ".join(("not_computed", *STATUS_NAMES)),
    },
    "failed_step": {"long_name": "number of the failing step from 0, or -1"},
    "stop_t": {"long_name": "time at which the trajectory stopped, or NaN"},
    "residual": {"long_name": "largest relative residual of an implicit solve"},
}


def about_variable(name: str, units: Mapping[str, str]) -> dict[str, Any]:
    """The attributes of a variable; `units`: those of all variables that have units."""
    return _ATTRIBUTES.get(name, {}) | ({"units": units[name]} if name in units else {})
