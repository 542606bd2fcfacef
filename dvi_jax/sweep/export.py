"""The results of a sweep as a NetCDF file or a Parquet table, written task by task."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..base.files import user_path
from ..base.results import STATUS_NAMES


@contextlib.contextmanager
def _whole_or_not(path: Any, force: bool, package: str) -> Iterator[Path]:
    """A temporary name next to `path`, renamed once everything is written."""
    path = user_path("path", path)
    if path.exists() and not force:
        raise FileExistsError(
            f"'{path}' already exists: give another path, or force=True to replace it."
        )
    try:
        __import__(package)
    except ImportError:
        text = f'the export requires {package}: pip install "dvi-jax[export]".'
        raise ImportError(text) from None
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def to_netcdf(dataset: Any, boxes: Iterator[dict[str, slice]], path: Any, force: bool) -> None:
    """Write a dataset of a sweep as NetCDF 4, one box of its grid at a time."""
    with _whole_or_not(path, force, "h5netcdf") as temporary:
        import h5netcdf
        import h5py

        auxiliary = [name for name in dataset.coords if name not in dataset.sizes]
        with h5netcdf.File(temporary, "w") as file:
            file.dimensions = dict(dataset.sizes)
            file.attrs.update(dataset.attrs)
            for name, variable in dataset.variables.items():
                is_text = variable.dtype.kind == "U"
                dtype = h5py.string_dtype() if is_text else variable.dtype
                attributes = dict(variable.attrs)
                if variable.dtype.kind == "b":
                    # NetCDF has no booleans: xarray knows them by this attribute.
                    dtype, attributes["dtype"] = np.dtype("int8"), "bool"
                array = file.create_variable(name, variable.dims, dtype)
                array.attrs.update(attributes)
                if name in dataset.coords:
                    array[...] = variable.values.astype(object) if is_text else variable.values
                elif auxiliary:
                    dims = set(variable.dims)
                    names = [x for x in auxiliary if set(dataset[x].dims) <= dims]
                    array.attrs["coordinates"] = " ".join(names) or " "
            for box in boxes:
                for name in dataset.data_vars:
                    part = dataset[name].isel(box)
                    where = tuple(box.get(d, slice(None)) for d in part.dims)
                    file.variables[name][where] = part.values


def to_parquet(dataset: Any, boxes: Iterator[dict[str, slice]], path: Any, force: bool) -> None:
    """Write one row for each trajectory: its axes, results and status. Results with dimensions of
    their own become one column for each entry: ``q_1_0`` is ``q[1, 0]``."""
    with _whole_or_not(path, force, "pyarrow") as temporary, contextlib.ExitStack() as stack:
        import pyarrow as pa
        import pyarrow.parquet as pq

        writer = None
        for box in boxes:
            table = pa.table(_columns(dataset.isel(box), list(box)))
            if writer is None:
                metadata = {k: str(value) for k, value in dataset.attrs.items()}
                schema = table.schema.with_metadata(metadata)
                writer = stack.enter_context(pq.ParquetWriter(temporary, schema))
            writer.write_table(table.replace_schema_metadata(writer.schema.metadata))


def _columns(part: Any, grid: list[str]) -> dict[str, np.ndarray]:
    """The columns of one box."""
    columns: dict[str, np.ndarray] = {}
    for name in (*part.coords, *part.data_vars):
        variable = part[name].variable.to_base_variable()
        other_dims = [dim for dim in variable.dims if dim not in grid]
        sizes = {dim: part.sizes[dim] for dim in (*grid, *other_dims)}
        values = variable.set_dims(sizes).transpose(*sizes).values
        values = np.ascontiguousarray(values).reshape(np.prod([sizes[dim] for dim in grid]), -1)
        # np.ndindex() without dimensions of its own: the name alone
        indices = np.ndindex(*(sizes[dim] for dim in other_dims))
        for index, entries in zip(indices, values.T, strict=True):
            column = "_".join((name, *map(str, index)))
            parts = {column: entries}
            if np.iscomplexobj(entries):
                parts = {f"{column}_re": np.real(entries), f"{column}_im": np.imag(entries)}
            if repeats := [c for c in parts if c in columns]:
                raise ValueError(
                    f"{name!r} and an earlier variable both give the column {repeats[0]!r}: rename "
                    "the observable or axis, or use to_netcdf."
                )
            columns.update(parts)
    names = np.asarray(("not_computed", *STATUS_NAMES))
    columns["status"] = names[columns["status"].astype(int) + 1]
    return columns
