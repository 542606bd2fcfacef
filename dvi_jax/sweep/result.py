"""What a sweep returns: labelled arrays, in memory or in a store, with a status for each number."""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .._results import STATUS_NAMES
from .layout import STATUS, about_variable
from .plan import Plan
from .sinks import Memory
from .store import Store, StoreError, Verification


class SweepResult:
    """The results of a sweep over a grid.

    - `dims`: name → length of the dimensions.
    - `path`: of the store, or None.
    - `num_tasks`, `tasks_done`: pieces of the grid, and how many of them have been computed.
    - ``result["energy_drift"]``: one variable as a NumPy array, all of it.
    - `to_xarray()`: the labelled whole.

    What has not been computed is NaN (−1 in whole numbers), with the status −1.
    """

    def __init__(self, source: Memory | Store, coordinates: Mapping[str, Any], attributes: Any):
        self._source, self._coordinates = source, dict(coordinates)
        self.attributes = dict(attributes)

    @property
    def _plan(self) -> Plan:
        return self._source.plan

    @property
    def dims(self) -> dict[str, int]:
        """Name of each dimension → its length."""
        return dict(self._plan.dims)

    @property
    def path(self) -> Path | None:
        """The store, or None where the results are in memory."""
        return self._source.path if isinstance(self._source, Store) else None

    @property
    def num_tasks(self) -> int:
        """Into how many tasks the grid is cut."""
        return self._plan.num_tasks

    @property
    def tasks_done(self) -> int:
        """How many of them have their results; of a store all records are read."""
        return len(self._source.done())

    @property
    def is_complete(self) -> bool:
        """Whether all tasks are done."""
        return self.tasks_done == self.num_tasks

    def __getitem__(self, name: str) -> np.ndarray:
        names = (*self._source.variables, *self._coordinates)
        if name not in names:
            raise KeyError(f"{name!r}: there are {', '.join(names)}.")
        if name in self._coordinates:
            return self._coordinates[name][1]
        if isinstance(self._source, Memory):
            return self._source.arrays[name]
        return self.to_xarray()[name].values

    def status_counts(self) -> dict[str, int]:
        """How many trajectories ended with each status, read task by task."""
        counts = np.zeros(len(STATUS_NAMES) + 1, int)
        if isinstance(self._source, Memory):
            counts += np.bincount(self._source.arrays[STATUS].ravel() + 1, minlength=len(counts))
        else:
            for record in self.records():
                for name, count in record["statuses"].items():
                    counts[STATUS_NAMES.index(name) + 1] += count
            counts[0] = self._plan.lanes - counts[1:].sum()
        names = ("not_computed", *STATUS_NAMES)
        return {name: int(n) for name, n in zip(names, counts, strict=True) if n}

    def records(self) -> Iterator[dict[str, Any]]:
        """What a store has on record of each task that is done: `task`, `start` and `size` of its
        box, `statuses`, `seconds` that it took and when it was `finished`, `host`, `pid`, `device`.
        """
        if isinstance(self._source, Store):
            for number in self._source.done():
                record = self._source.record(number)
                if record is not None:
                    yield record

    def verify(self, progress: Callable[[int, int], None] | None = None) -> Verification:
        """Read all of a store again and compare it with the checksums in its records.

        Tasks that are not sound are open again: the next run computes them anew. `progress` is
        called as ``progress(tasks_read, tasks)``.

        **Raises** `StoreError` for results that are in memory.
        """
        if not isinstance(self._source, Store):
            raise StoreError("results in memory have no checksums: only a store can be verified.")
        return self._source.verify(progress)

    def to_xarray(self) -> Any:
        """The result as an `xarray.Dataset`: dimensions with their values, units, and where and how
        it was made in the attributes. Of a store nothing is read before it is asked for; tasks that
        are not done are masked."""
        import xarray as xr

        from .lazy import masked

        data, units = {}, json.loads(self.attributes.get("units", "{}"))
        for name, v in self._source.variables.items():
            dims, about = (*self.dims, *v.dims), about_variable(name, units)
            if isinstance(self._source, Memory):
                data[name] = xr.Variable(dims, self._source.arrays[name], about)
            else:
                chunks = dict(zip(dims, (*self._plan.chunk, *v.shape), strict=True))
                array = masked(self._source, name)
                data[name] = xr.Variable(dims, array, about, {"preferred_chunks": chunks})
        coords = {
            name: xr.Variable(dims, values, about)
            for name, (dims, values, about) in self._coordinates.items()
        }
        about = {k: v for k, v in self.attributes.items() if k != "coordinates"}
        return xr.Dataset(data, coords, about)

    def to_netcdf(self, path: Any, force: bool = False) -> None:
        """Write all of it to a NetCDF 4 file, task by task: memory is that of one task.

        Needs the extra `export`. **Raises** `FileExistsError` for a file that is there, unless
        `force`; `ImportError` without h5netcdf.
        """
        from .export import to_netcdf

        to_netcdf(self.to_xarray(), self._boxes(), path, force)

    def to_parquet(self, path: Any, force: bool = False) -> None:
        """Write a Parquet table, one row a trajectory: the values of its axes, its results, the
        name of its status. Task by task: each is a row group.

        Needs the extra `export`. **Raises** as `to_netcdf`.
        """
        from .export import to_parquet

        to_parquet(self.to_xarray(), self._boxes(), path, force)

    def _boxes(self) -> Iterator[dict[str, slice]]:
        """The parts of the grid that the tasks are."""
        return (dict(zip(self.dims, t.box, strict=True)) for t in self._plan.tasks())

    def __repr__(self) -> str:
        grid = " × ".join(f"{name} {n}" for name, n in self.dims.items())
        done = f"{self.tasks_done} of {self.num_tasks} tasks done"
        names = ", ".join(self._source.variables)
        where = f", in {self.path}" if self.path is not None else ""
        return f"SweepResult({grid}: {names}; {done}{where})"


def open_sweep(path: Any) -> SweepResult:
    """The results in a store, finished or not, while others still write to it or not.

    **Raises** `StoreError` where there is none.
    """
    store = Store.open(path)
    return SweepResult(store, store.coordinates(), store.attributes)
