"""How a sweep is laid out on disk: the arrays of a store in zarr, their names and attributes."""

import json
import math
import os
import shutil
import uuid
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .._files import TEMPORARY, sync
from .._results import STATUS_NAMES
from .identity import FORMAT, digest
from .plan import Plan, Task
from .sinks import as_store_error
from .variables import ARRAY_NAMES, Variable, is_array_name

TASKS = ".tasks"
"""The directory of the records of tasks."""

STATUS = "status"
"""The variable whose shard is published after the others."""

CHUNK_BYTES = 2**22
"""Of an inner chunk of a shard: what is read at least to see one number."""


def layout(chunk: tuple[int, ...], variable: Variable) -> dict[str, Any]:
    """What zarr is told of an array: a task is a shard, in it chunks of some megabytes."""
    from zarr import codecs

    shard = (*chunk, *variable.shape)
    inner = list(shard)
    size = math.prod(shard) * np.dtype(variable.dtype).itemsize
    for i, n in enumerate(shard):
        divisors = (d for d in range(1, n + 1) if n % d == 0)
        parts = next(d for d in divisors if d == n or size / d <= CHUNK_BYTES)
        if size / parts < CHUNK_BYTES / 16 and i + 1 < len(shard):
            continue  # a prime, say: crumbs would take long to write
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


def shard(plan: Plan, variable: Variable, task: Task, values: np.ndarray) -> bytes:
    """The bytes of one shard, made in memory."""
    import zarr
    from zarr.storage import MemoryStore

    files: dict[str, Any] = {}
    shape = (*plan.chunk, *variable.shape)
    array = zarr.create_array(MemoryStore(files), shape=shape, **layout(plan.chunk, variable))
    array[tuple(slice(n) for n in task.size)] = values
    (content,) = (x for key, x in files.items() if key.startswith("c/"))
    return content.to_bytes()


def make(
    path: Path,
    config: Mapping[str, Any],
    variables: Mapping[str, Variable],
    coordinates: Mapping[str, Any],
    attributes: Mapping[str, Any],
) -> None:
    """Make a store under another name and rename it: it appears whole or not at all.

    **Raises** `ValueError` for names that no file can have; `StoreError`.
    """
    if bad := [name for name in (*coordinates, *variables) if not is_array_name(name)]:
        raise ValueError(
            f"{bad[0]!r} cannot be the name of an array in a store: {ARRAY_NAMES}. The name comes "
            "from a key of args or from an observable: rename it."
        )
    plan = Plan(dict(config["dims"]), tuple(config["chunk"]))
    about = {
        "Conventions": "CF-1.11",
        "dvi_jax_sweep": FORMAT,
        "config": json.dumps(config),
        "config_sha256": digest(config),
        **attributes,
    }
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}{TEMPORARY}")
    try:
        with as_store_error(path, "cannot be made"):
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_arrays(temporary, plan, variables, coordinates, about)
            (temporary / TASKS).mkdir()
            for file in temporary.rglob("*"):
                if file.is_file():
                    sync(file)
            try:
                os.rename(temporary, path)
            except OSError:  # another process was faster, or the directory holds something
                if not (path / "zarr.json").exists():
                    raise
            sync(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_arrays(folder: Path, plan: Plan, variables, coordinates, attributes) -> None:
    """The coordinates with their values, the variables without any."""
    import zarr
    from zarr import codecs

    units = json.loads(attributes.get("units", "{}"))
    group = zarr.create_group(folder, attributes=attributes)
    for name, (dims, values, about) in coordinates.items():
        group.create_array(
            name,
            data=storable(values),
            chunks=values.shape,
            dimension_names=dims,
            attributes=about,
            compressors=[codecs.ZstdCodec(), codecs.Crc32cCodec()],
            config={"write_empty_chunks": True},
        )
    for name, v in variables.items():
        group.create_array(
            name,
            shape=(*plan.shape, *v.shape),
            dimension_names=(*plan.dims, *v.dims),
            attributes=about_variable(name, units),
            **layout(plan.chunk, v),
        )
    with warnings.catch_warnings():  # of the format: readers without it list the directory
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(folder)


def storable(values: np.ndarray) -> np.ndarray:
    """Names of methods with a type for text of any length, which zarr has; numbers as they are."""
    return values.astype(np.dtypes.StringDType()) if values.dtype.kind == "U" else values


def about_variable(name: str, units: Mapping[str, str]) -> dict[str, Any]:
    """The attributes of a variable; `units` are those of all that have some."""
    if name == STATUS:
        return {
            "long_name": "how each trajectory ended",
            "flag_values": [-1, *range(len(STATUS_NAMES))],
            "flag_meanings": " ".join(("not_computed", *STATUS_NAMES)),
        }
    known = {
        "failed_step": "number of the failing step from 0, or -1",
        "residual": "largest relative residual of an implicit solve",
    }
    found = {"long_name": known[name]} if name in known else {}
    return {**found, "units": units[name]} if name in units else found
