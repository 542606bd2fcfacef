"""Arrays of a store that are read when they are asked for, without what is not done."""

from collections.abc import Iterator
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

    A shard that is there without its record belongs to a task that was cut off while its results
    were being written.
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
        own = len(plan.shape)
        wanted = [
            np.arange(*k.indices(n)) if isinstance(k, slice) else np.atleast_1d(k)
            for k, n in zip(key, self.shape, strict=True)
        ]
        rows, behind = wanted[:own], wanted[own:]
        found = np.full([len(w) for w in wanted], fill, self.dtype)
        places = [w // c for w, c in zip(rows, plan.chunk, strict=True)]
        for place in _boxes(places):
            inside = [np.flatnonzero(p == k) for p, k in zip(places, place, strict=True)]
            number = plan.number(place)
            if self.store.record(number) is None:
                continue
            box = tuple(w[i] for w, i in zip(rows, inside, strict=True))
            to = np.ix_(*inside, *(np.arange(len(b)) for b in behind))
            found[to] = self.store.read(self.name, number, (*box, *behind))
        return found[tuple(0 if isinstance(k, int | np.integer) else slice(None) for k in key)]


def _boxes(places: list[np.ndarray]) -> Iterator[tuple[int, ...]]:
    """Every box that some wanted entry lies in."""
    each = [np.unique(p) for p in places]
    for k in np.ndindex(*(len(e) for e in each)):
        yield tuple(int(e[i]) for e, i in zip(each, k, strict=True))
