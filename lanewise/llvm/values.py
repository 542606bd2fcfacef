"""Arrays while code is written: their numbers, or where they are in memory."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from .ir import Num
from .memory import Buffer

Entries = Any
"""An array of `Num`, with dtype object: the types of NumPy cannot say so."""


SMALL = 128  # arrays of up to so many elements are numbers of their own; larger ones stay in memory


MOST_ENTRIES = 4096  # arrays made of numbers (a Jacobian) may have so many


class Value:
    """An array on every trajectory: its numbers, or where it is in memory."""

    __slots__ = ("buffer", "dtype", "entries", "is_tangent", "shape")

    def __init__(self, shape, dtype, entries=None, buffer: Buffer | None = None):
        self.shape, self.dtype = tuple(shape), str(dtype)
        self.entries: Entries | None = entries
        self.buffer = buffer
        self.is_tangent = False  # linear in unit vectors: its zeros are zeros by structure

    @classmethod
    def in_memory(cls, buffer: Buffer) -> "Value":
        return cls(buffer.shape, buffer.dtype, buffer=buffer)

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def is_small(self) -> bool:
        return self.entries is not None or self.size <= SMALL

    def has_lanes(self) -> bool:
        if self.entries is not None:
            return any(x.vec for x in self.entries.flat)
        assert self.buffer is not None
        # Shared memory at an index that varies gives numbers that vary.
        moving = any(isinstance(x, Num) and x.vec for x in self.buffer.offset)
        return self.buffer.lane is not None or moving

    def constants(self) -> np.ndarray | None:
        """The numbers, if all of them are known now."""
        if self.entries is None or any(x.value is None for x in self.entries.flat):
            return None
        out = np.empty(self.shape, self.dtype)
        for i in np.ndindex(self.shape):
            out[i] = self.entries[i].value
        return out


Values = list[Value]


def objects(entries: Sequence[Any], shape: Sequence[int]) -> Entries:
    """An object array of these entries, in row-major order."""
    flat = np.empty(len(entries), object)
    # Not np.array(entries): it would look for sequences in them.
    for i, entry in enumerate(entries):
        flat[i] = entry
    return flat.reshape(tuple(shape))
