"""Arrays of a store that are read on demand, with unfinished tasks masked."""

import itertools
from typing import Any

import numpy as np
from xarray.backends import BackendArray
from xarray.core import indexing

from .store import Store


def lazy_array(store: Store, name: str) -> Any:
    """One variable of a store for xarray, read part by part."""
    return indexing.LazilyIndexedArray(_StoreArray(store, name))


class _StoreArray(BackendArray):
    """An array of which shards without a record, of interrupted tasks, count as not computed."""

    def __init__(self, store: Store, name: str):
        self.store, self.name = store, name
        array = store.array(name)
        self.shape, self.dtype = array.shape, array.dtype

    def __getitem__(self, key: Any) -> Any:
        support = indexing.IndexingSupport.OUTER
        return indexing.explicit_indexing_adapter(key, self.shape, support, self._get)

    def _get(self, key: tuple[Any, ...]) -> np.ndarray:
        plan, fill = self.store.plan, self.store.variables[self.name].fill
        indices = [
            np.arange(*entry.indices(length)) if isinstance(entry, slice) else np.atleast_1d(entry)
            for entry, length in zip(key, self.shape, strict=True)
        ]
        rows, columns = indices[: len(plan.shape)], indices[len(plan.shape) :]
        values = np.full([*map(len, indices)], fill, self.dtype)
        boxes = [row // size for row, size in zip(rows, plan.chunk, strict=True)]
        for place in itertools.product(*map(np.unique, boxes)):
            number = plan.number(place)
            if self.store.record(number) is None:
                continue
            positions = [np.flatnonzero(b == k) for b, k in zip(boxes, place, strict=True)]
            box = (row[position] for row, position in zip(rows, positions, strict=True))
            target = np.ix_(*positions, *(np.arange(len(column)) for column in columns))
            values[target] = self.store.read(self.name, number, (*box, *columns))
        return values[tuple(0 if isinstance(x, int | np.integer) else slice(None) for x in key)]
