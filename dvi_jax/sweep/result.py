"""The result of a sweep: labelled arrays, in memory or in a store, with a status for each entry."""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..base.results import STATUS_NAMES
from ..base.tables import Table, unknown_name
from .layout import STATUS, about_variable
from .store import MemorySink, Store, StoreError, Verification


class SweepResult:
    """The results of a sweep over a grid.

    - `dims`: name → length of the dimensions.
    - `path`: of the store, or None.
    - `num_tasks`, `tasks_done`: number of tasks of the grid, and of those that are done.
    - ``result["energy_drift"]``: one variable as a NumPy array.
    - `to_xarray()`: all of it with labels.

    Entries that have not been computed are NaN (−1 in whole numbers, False in booleans) and have
    the status −1.
    """

    def __init__(self, source: MemorySink | Store, coordinates: Mapping[str, Any], attributes: Any):
        self._source, self._coordinates = source, dict(coordinates)
        self._plan = source.plan
        self.attributes = dict(attributes)

    @property
    def dims(self) -> dict[str, int]:
        """Name of each dimension → its length."""
        return Table(self._plan.dims)

    @property
    def path(self) -> Path | None:
        """The store, or None where the results are in memory."""
        return self._source.path if isinstance(self._source, Store) else None

    @property
    def num_tasks(self) -> int:
        """Number of tasks of the grid."""
        return self._plan.num_tasks

    @property
    def tasks_done(self) -> int:
        """Number of finished tasks; all records of a store are read for it."""
        return len(self._source.done_tasks())

    @property
    def is_complete(self) -> bool:
        """Whether all tasks are done."""
        return self.tasks_done == self.num_tasks

    def __getitem__(self, name: str) -> np.ndarray:
        if name in self._coordinates:
            return self._coordinates[name][1]
        if name not in self._source.variables:
            raise unknown_name(name, (*self._source.variables, *self._coordinates))
        if isinstance(self._source, MemorySink):
            return self._source.arrays[name]
        return self.to_xarray()[name].values

    def status_counts(self) -> dict[str, int]:
        """Number of trajectories with each status, counted task by task."""
        names = ("not_computed", *STATUS_NAMES)
        counts = dict.fromkeys(names, 0)
        if isinstance(self._source, MemorySink):
            codes, numbers = np.unique(self._source.arrays[STATUS], return_counts=True)
            counts |= {names[c + 1]: int(n) for c, n in zip(codes, numbers, strict=True)}
        else:
            for record in self.records():
                for name, count in record["statuses"].items():
                    counts[name] += count
            counts["not_computed"] = self._plan.lanes - sum(counts.values())
        return {name: n for name, n in counts.items() if n}

    def records(self) -> Iterator[dict[str, Any]]:
        """The record of each finished task of a store: `task`, `start` and `size` of its box,
        `statuses`, the `seconds` of its computation, when it was `finished`, `host`, `pid`,
        `device`."""
        if isinstance(self._source, Store):
            yield from filter(None, map(self._source.record, self._source.done_tasks()))

    def verify(self, progress: Callable[[int, int], None] | None = None) -> Verification:
        """Read the whole store again and compare it with the checksums in its records.

        Tasks that are damaged count as not done: the next run computes them again. `progress` is
        called as ``progress(tasks_read, tasks)``.

        **Raises** `StoreError` for results that are in memory.
        """
        if not isinstance(self._source, Store):
            raise StoreError(
                "verify() requires results in a store, but these are in memory: give store=PATH."
            )
        return self._source.verify(progress)

    def to_xarray(self) -> Any:
        """The result as an `xarray.Dataset`: dimensions with their values, units, and in the
        attributes how it was made. A store is read on demand; unfinished tasks are masked."""
        import xarray as xr

        from .lazy import lazy_array

        data, units = {}, json.loads(self.attributes.get("units", "{}"))
        for name, variable in self._source.variables.items():
            dims, attributes = (*self.dims, *variable.dims), about_variable(name, units)
            if isinstance(self._source, MemorySink):
                data[name] = xr.Variable(dims, self._source.arrays[name], attributes)
            else:
                chunks = dict(zip(dims, (*self._plan.chunk, *variable.shape), strict=True))
                array = lazy_array(self._source, name)
                data[name] = xr.Variable(dims, array, attributes, {"preferred_chunks": chunks})
        coords = {name: xr.Variable(*c) for name, c in self._coordinates.items()}
        attributes = {k: variable for k, variable in self.attributes.items() if k != "coordinates"}
        return xr.Dataset(data, coords, attributes)

    def to_netcdf(self, path: Any, force: bool = False) -> None:
        """Write a NetCDF 4 file, task by task, so that only one task is in memory.

        Needs the extra `export`. **Raises** `FileExistsError` for a file that is there, unless
        `force`; `ImportError` without h5netcdf.
        """
        from .export import to_netcdf

        to_netcdf(self.to_xarray(), self._boxes(), path, force)

    def to_parquet(self, path: Any, force: bool = False) -> None:
        """Write a Parquet table with one row for each trajectory: the values of its axes, its
        results, the name of its status. Each task is a row group.

        Needs the extra `export`. **Raises** as `to_netcdf`.
        """
        from .export import to_parquet

        to_parquet(self.to_xarray(), self._boxes(), path, force)

    def _boxes(self) -> Iterator[dict[str, slice]]:
        return (dict(zip(self.dims, t.box, strict=True)) for t in self._plan.tasks())

    def __repr__(self) -> str:
        grid = " × ".join(f"{name} {size}" for name, size in self.dims.items())
        tasks = f"{self.tasks_done} of {self.num_tasks} tasks done"
        names = ", ".join(self._source.variables)
        where = f", in {self.path}" if self.path is not None else ""
        return f"SweepResult({grid}: {names}; {tasks}{where})"


def open_sweep(path: Any) -> SweepResult:
    """The results in a store, which may be unfinished and still be written by other processes.

    **Raises** `StoreError` if the path is not a store.
    """
    store = Store.open(path)
    return SweepResult(store, store.coordinates(), store.attributes)
