"""Arrays in memory: operands, results, rows that a loop writes, all seen through strides."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from .ir import TYPES, Builder, Num, Unsupported


@dataclasses.dataclass(frozen=True)
class Buffer:
    """An array of each trajectory, or one for all of them, in memory.

    `base` names a pointer for each vector of a block, to the first trajectory's first element, or
    one pointer where `lane` is None: the array is the same on all trajectories. `lane` is the
    distance between trajectories and `strides` are those of the axes, in elements; a distance is a
    number or the name of an i64. `offset` is added to every index.
    """

    base: tuple[str, ...]
    dtype: str
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    lane: int | str | None
    offset: tuple[Num | int, ...] = ()

    @property
    def size(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def is_contiguous(self) -> bool:
        expected = contiguous(self.shape, self.strides[-1] if self.strides else 1)
        return all(
            s == e or n <= 1 for s, e, n in zip(self.strides, expected, self.shape, strict=True)
        )

    def moved(self, by: Num | int) -> "Buffer":
        return dataclasses.replace(self, offset=(*self.offset, by))

    def row(self, b: Builder, index: Num) -> "Buffer":
        """``self[index]`` of the first axis, by an index that is known when the code runs."""
        by = b.mul(index, b.known(self.strides[0], "int64"))
        return dataclasses.replace(
            self, shape=self.shape[1:], strides=self.strides[1:], offset=(*self.offset, by)
        )

    def reshaped(self, shape: Sequence[int]) -> "Buffer | None":
        """The same elements in row-major order with other axes, if strides can say that."""
        if not self.is_contiguous:
            return None
        step = next((s for s, n in zip(self.strides[::-1], self.shape[::-1], strict=True)
                     if n > 1), 1)  # fmt: skip
        return dataclasses.replace(self, shape=tuple(shape), strides=contiguous(shape, step))

    def seen(self, view: Any) -> "Buffer | None":
        """The buffer as `view` arranges it, a function of NumPy arrays that copies nothing."""
        item = 8
        like = np.lib.stride_tricks.as_strided(
            np.broadcast_to(np.int64(0), ()), self.shape, [s * item for s in self.strides]
        )
        try:
            other = view(like)
        except (TypeError, ValueError):
            return None
        start = like.__array_interface__["data"][0]
        if other.size and not np.may_share_memory(like, other, max_work=0):
            return None
        by = (other.__array_interface__["data"][0] - start) // item
        strides = tuple(s // item for s in other.strides)
        return dataclasses.replace(
            self, shape=other.shape, strides=strides, offset=(*self.offset, int(by))
        )

    def at(self, index: Sequence[int]) -> int:
        return sum(i * s for i, s in zip(index, self.strides, strict=True))


def contiguous(shape: Sequence[int], step: int = 1) -> tuple[int, ...]:
    """The strides of an array in row-major order."""
    strides = []
    for n in reversed(shape):
        strides.append(step)
        step *= max(n, 1)
    return tuple(reversed(strides))


def stored_type(dtype: str) -> str:
    return "i8" if dtype == "bool" else TYPES[dtype]


def _offset(b: Builder, buffer: Buffer, by: Num | int) -> tuple[Num, int]:
    """The offset as (a number, a constant)."""
    total, fixed = b.known(0, "int64"), 0
    for part in (*buffer.offset, by):
        if isinstance(part, int):
            fixed += part
        elif part.known is not None:
            fixed += int(part.known)
        else:
            total = b.add(total, part)
    return total, fixed


def load(b: Builder, buffer: Buffer, by: Num | int = 0) -> Num:
    """The element at `by` elements from the start."""
    t, item = TYPES[buffer.dtype], stored_type(buffer.dtype)
    moving, fixed = _offset(b, buffer, by)
    fixed_num = b.known(fixed, "int64")
    if buffer.lane is None and not moving.vec:
        at = b.ref(b.add(moving, fixed_num), 0, False)
        where = b.new(f"getelementptr {item}, ptr {buffer.base[0]}, i64 {at}")
        return _from_memory(b, b.made([_load(b, item, where)], buffer.dtype, False))
    names = []
    for u in range(b.U):
        names.append(_load_vector(b, buffer, u, moving, fixed, item, t))
    return _from_memory(b, b.made(names, buffer.dtype, True))


def _load_vector(b: Builder, buffer: Buffer, u, moving: Num, fixed: int, item: str, t: str) -> str:
    base = buffer.base[u if buffer.lane is not None else 0]
    vector = f"<{b.W} x {item}>"
    if not moving.vec:
        assert buffer.lane is not None  # else the number is the same on all trajectories
        where = base
        if moving.known is None:
            where = b.new(f"getelementptr {item}, ptr {base}, i64 {moving.names[0]}")
        if fixed:
            where = b.new(f"getelementptr {item}, ptr {where}, i64 {fixed}")
        if b.W == 1:
            return _load(b, item, where)
        if buffer.lane == 1:
            return b.new(f"load {vector}, ptr {where}, align {_bytes(item)}")
        made = "poison"
        for i in range(b.W):
            at = _lane_pointer(b, where, i, buffer.lane, item)
            one = _load(b, item, at)
            made = b.new(f"insertelement {vector} {made}, {item} {one}, i64 {i}")
        return made
    made = "poison"
    index = b.ref(b.add(moving, b.known(fixed, "int64")), u, True)
    if b.W == 1:
        return _load(b, item, b.new(f"getelementptr {item}, ptr {base}, i64 {index}"))
    for i in range(b.W):
        one = b.new(f"extractelement <{b.W} x i64> {index}, i64 {i}")
        at = base if buffer.lane is None else _lane_pointer(b, base, i, buffer.lane, item)
        at = b.new(f"getelementptr {item}, ptr {at}, i64 {one}")
        made = b.new(f"insertelement {vector} {made}, {item} {_load(b, item, at)}, i64 {i}")
    return made


def _lane_pointer(b: Builder, base: str, i: int, lane: int | str, item: str) -> str:
    if i == 0:
        return base
    if isinstance(lane, int):
        return b.new(f"getelementptr {item}, ptr {base}, i64 {i * lane}")
    key = ("lane", lane, i)
    by = b.find(key)
    if by is None:
        by = b.new(f"mul i64 {lane}, {i}")
        b.note(key, by)
    return b.new(f"getelementptr {item}, ptr {base}, i64 {by}")


def _load(b: Builder, item: str, where: str) -> str:
    return b.new(f"load {item}, ptr {where}, align {_bytes(item)}")


def _bytes(item: str) -> int:
    return {"double": 8, "float": 4}.get(item) or int(item[1:]) // 8


def _from_memory(b: Builder, x: Num) -> Num:
    """Truth values take a byte each in memory."""
    if x.dtype != "bool":
        return x
    t = f"<{b.W} x i8>" if x.vec and b.W > 1 else "i8"
    zero = "zeroinitializer" if x.vec and b.W > 1 else "0"
    return b.made([b.new(f"icmp ne {t} {n}, {zero}") for n in x.names], "bool", x.vec)


def store(b: Builder, buffer: Buffer, x: Num, by: Num | int = 0) -> None:
    """Write a number to `by` elements from the start."""
    assert x.dtype == buffer.dtype, (x.dtype, buffer.dtype)
    item = stored_type(buffer.dtype)
    moving, fixed = _offset(b, buffer, by)
    if buffer.lane is None:
        if x.vec or moving.vec:
            raise Unsupported("writing to an array that all trajectories share")
        name, at = b.ref(x, 0, False), b.ref(b.add(moving, b.known(fixed, "int64")), 0, False)
        if x.dtype == "bool":
            name = b.new(f"zext i1 {name} to i8")
        where = b.new(f"getelementptr {item}, ptr {buffer.base[0]}, i64 {at}")
        b.emit(f"store {item} {name}, ptr {where}, align {_bytes(item)}")
        return
    vector = f"<{b.W} x {item}>"
    for u in range(b.U):
        name = b.ref(x, u, True)
        if x.dtype == "bool":
            t = b.type("bool", True)
            name = b.new(f"zext {t} {name} to {vector if b.W > 1 else item}")
        base = buffer.base[u]
        if moving.vec:
            index = b.ref(b.add(moving, b.known(fixed, "int64")), u, True)
            for i in range(b.W):
                one, value = index, name
                if b.W > 1:
                    one = b.new(f"extractelement <{b.W} x i64> {index}, i64 {i}")
                    value = b.new(f"extractelement {vector} {name}, i64 {i}")
                at = _lane_pointer(b, base, i, buffer.lane, item)
                at = b.new(f"getelementptr {item}, ptr {at}, i64 {one}")
                b.emit(f"store {item} {value}, ptr {at}, align {_bytes(item)}")
            continue
        where = base
        if moving.known is None:
            where = b.new(f"getelementptr {item}, ptr {base}, i64 {moving.names[0]}")
        if fixed:
            where = b.new(f"getelementptr {item}, ptr {where}, i64 {fixed}")
        if b.W == 1:
            b.emit(f"store {item} {name}, ptr {where}, align {_bytes(item)}")
        elif buffer.lane == 1:
            b.emit(f"store {vector} {name}, ptr {where}, align {_bytes(item)}")
        else:
            for i in range(b.W):
                value = b.new(f"extractelement {vector} {name}, i64 {i}")
                at = _lane_pointer(b, where, i, buffer.lane, item)
                b.emit(f"store {item} {value}, ptr {at}, align {_bytes(item)}")
