"""Arrays of a store that are read on demand, with unfinished tasks masked."""

import itertools
from typing import Any

import numpy as np
from xarray.backends import BackendArray
from xarray.core import indexing

from .store import Store


def masked(store: Store, name: str) -> Any:
    """One variable of a store for xarray, read part by part."""
    return indexing.LazilyIndexedArray(_Masked(store, name))


class _Masked(BackendArray):
    """An array of which shards without a record count as not computed.

    Such a shard belongs to a task that was interrupted while its results were being written.
    """

    def __init__(self, store: Store, name: str):
        self.store, self.name = store, name
        array = store.array(name)
        self.shape, self.dtype = array.shape, array.dtype

    def __getitem__(self, key: Any) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.OUTER, self._get
        )

    def _get(self, key: tuple[Any, ...]) -> np.ndarray:
        plan, fill = self.store.plan, self.store.variables[self.name].fill
        wanted = [
            np.arange(*k.indices(n)) if isinstance(k, slice) else np.atleast_1d(k)
            for k, n in zip(key, self.shape, strict=True)
        ]
        rows, own = wanted[: len(plan.shape)], wanted[len(plan.shape) :]
        found = np.full([len(w) for w in wanted], fill, self.dtype)
        boxes = [w // c for w, c in zip(rows, plan.chunk, strict=True)]
        for place in itertools.product(*map(np.unique, boxes)):
            number = plan.number(place)
            if self.store.record(number) is None:
                continue
            inside = [np.flatnonzero(b == k) for b, k in zip(boxes, place, strict=True)]
            box = (w[i] for w, i in zip(rows, inside, strict=True))
            to = np.ix_(*inside, *(np.arange(len(w)) for w in own))
            found[to] = self.store.read(self.name, number, (*box, *own))
        return found[tuple(0 if isinstance(k, int | np.integer) else slice(None) for k in key)]
