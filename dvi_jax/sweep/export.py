"""The results of a sweep as a NetCDF file or a Parquet table, written task by task."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .._results import STATUS_NAMES


@contextlib.contextmanager
def _whole_or_not(path: Any, force: bool, package: str, extra: str) -> Iterator[Path]:
    """A temporary name beside `path`, renamed once all is written."""
    path = Path(path)
    if path.exists() and not force:
        raise FileExistsError(f"{path} exists: give another path, or force=True to replace it.")
    try:
        __import__(package)
    except ImportError:
        raise ImportError(
            f"this needs {package}: pip install 'dvi-jax[{extra}]' brings it."
        ) from None
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def to_netcdf(dataset: Any, boxes: Iterator[dict[str, slice]], path: Any, force: bool) -> None:
    """Write a dataset of a sweep as NetCDF 4, one box of its grid at a time."""
    with _whole_or_not(path, force, "h5netcdf", "export") as temporary:
        import h5netcdf
        import h5py

        with h5netcdf.File(temporary, "w") as file:
            file.dimensions = dict(dataset.sizes)
            for key, value in dataset.attrs.items():
                file.attrs[key] = value
            for name, variable in dataset.variables.items():
                dtype = h5py.string_dtype() if _is_text(variable) else variable.dtype
                array = file.create_variable(name, variable.dims, dtype)
                for key, value in variable.attrs.items():
                    array.attrs[key] = value
            for name in dataset.coords:
                values = dataset[name].values
                file.variables[name][...] = values.astype(object) if _is_text(values) else values
            beside = [n for n in dataset.coords if n not in dataset.sizes]
            for name in dataset.data_vars:
                dims = set(dataset[name].dims)
                if beside:
                    its = " ".join(n for n in beside if set(dataset[n].dims) <= dims)
                    file.variables[name].attrs["coordinates"] = its or " "
            for box in boxes:
                for name in dataset.data_vars:
                    part = dataset[name].isel(box)
                    where = tuple(box.get(d, slice(None)) for d in part.dims)
                    file.variables[name][where] = part.values


def _is_text(x: Any) -> bool:
    return x.dtype.kind == "U"


def to_parquet(dataset: Any, boxes: Iterator[dict[str, slice]], path: Any, force: bool) -> None:
    """Write one row for each trajectory: the values of its axes, its results and its status.

    Results with dimensions of their own become one column an entry: ``q_1_0`` is ``q[1, 0]``.
    """
    with _whole_or_not(path, force, "pyarrow", "export") as temporary:
        import pyarrow as pa
        import pyarrow.parquet as pq

        writer = None
        try:
            for box in boxes:
                table = pa.table(_columns(dataset.isel(box), list(box)))
                if writer is None:
                    about = {k: str(v) for k, v in dataset.attrs.items()}
                    writer = pq.ParquetWriter(temporary, table.schema.with_metadata(about))
                writer.write_table(table.replace_schema_metadata(writer.schema.metadata))
        finally:
            if writer is not None:
                writer.close()


def _columns(part: Any, grid: list[str]) -> dict[str, np.ndarray]:
    """The columns of one box."""
    shape = tuple(part.sizes[d] for d in grid)
    columns: dict[str, np.ndarray] = {}

    def add(name: str, variable: Any) -> None:
        own = [d for d in variable.dims if d not in grid]
        wanted = {d: part.sizes[d] for d in (*grid, *own)}
        values = variable.to_base_variable().set_dims(wanted).transpose(*wanted).values
        values = np.ascontiguousarray(values).reshape(np.prod(shape, dtype=int), -1)
        # np.ndindex() without dimensions of its own: the name alone
        each = np.ndindex(*(part.sizes[d] for d in own))
        names = ["_".join((name, *map(str, k))) for k in each]
        for column, entries in zip(names, values.T, strict=True):
            parts = {column: entries}
            if np.iscomplexobj(entries):
                parts = {f"{column}_re": np.real(entries), f"{column}_im": np.imag(entries)}
            if taken := [c for c in parts if c in columns]:
                raise ValueError(f"two results give the column {taken[0]!r}: rename one of them.")
            columns.update(parts)

    for name in (*part.coords, *part.data_vars):
        add(name, part[name].variable)
    names = np.asarray(("not_computed", *STATUS_NAMES))
    columns["status"] = names[columns["status"].astype(int) + 1]
    return columns
