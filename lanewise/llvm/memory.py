"""Arrays in memory: operands, results, rows that a loop writes, all seen through strides."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from .builder import Builder
from .ir import TYPES, NotCompilable, Num


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
        strides = contiguous(self.shape, self.strides[-1] if self.strides else 1)
        pairs = zip(self.strides, strides, strict=True)
        return all(n <= 1 or len({*pair}) == 1 for n, pair in zip(self.shape, pairs, strict=True))

    def shift(self, distance: Num | int) -> "Buffer":
        return dataclasses.replace(self, offset=(*self.offset, distance))

    def row(self, b: Builder, index: Num) -> "Buffer":
        """``self[index]`` of the first axis, by an index that is known when the code runs."""
        row = self.from_row(b, index)
        return dataclasses.replace(row, shape=self.shape[1:], strides=self.strides[1:])

    def from_row(self, b: Builder, index: Num) -> "Buffer":
        """The array from row `index` on; the length of its first axis is not adjusted."""
        return self.shift(b.mul(index, b.const(self.strides[0], "int64")))

    def reshape(self, shape: Sequence[int]) -> "Buffer | None":
        """The same elements in row-major order with other axes, if strides can say that."""
        if not self.is_contiguous:
            return None
        long = [s for s, n in zip(self.strides, self.shape, strict=True) if n > 1]
        step = long[-1] if long else 1  # the stride of an axis of length 1 may be anything
        return dataclasses.replace(self, shape=tuple(shape), strides=contiguous(shape, step))

    def view(self, arrangement: Callable) -> "Buffer | None":
        """The buffer as a function of NumPy arrays that copies nothing arranges it."""
        item = 8
        # NumPy computes the strides of a view without reading the array: the memory of one number
        # is enough.
        like = np.lib.stride_tricks.as_strided(
            np.broadcast_to(np.int64(0), ()), self.shape, [s * item for s in self.strides]
        )
        try:
            other = arrangement(like)
        except (TypeError, ValueError):
            return None
        start = like.__array_interface__["data"][0]
        # A copy has elements in an order that no strides of this buffer describe.
        if other.size and not np.may_share_memory(like, other, max_work=0):
            return None
        distance = (other.__array_interface__["data"][0] - start) // item
        strides = tuple(s // item for s in other.strides)
        view = dataclasses.replace(self, shape=other.shape, strides=strides)
        return view.shift(int(distance))

    def position(self, index: Sequence[int]) -> int:
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


def _offset(b: Builder, buffer: Buffer, distance: Num | int) -> tuple[Num, int]:
    """The offset as (a number, a constant)."""
    # Constants are added while the code is written; the rest is one addition in it.
    total, fixed = b.const(0, "int64"), 0
    for part in (*buffer.offset, distance):
        if isinstance(part, int):
            fixed += part
        elif part.value is not None:
            fixed += int(part.value)
        else:
            total = b.add(total, part)
    return total, fixed


def load(b: Builder, buffer: Buffer, distance: Num | int = 0) -> Num:
    """The element at `distance` elements from the start."""
    item = stored_type(buffer.dtype)
    moving, fixed = _offset(b, buffer, distance)
    # Shared memory at a shared index: one number for all trajectories.
    if buffer.lane is None and not moving.vec:
        where = _pointer_at(b, buffer.base[0], moving, fixed, item)
        return _from_memory(b, b.number([_load(b, item, where)], buffer.dtype, False))
    names = []
    for u in range(b.U):
        if b.W > 1 and buffer.lane == 1 and not moving.vec:
            # Neighbours in memory are neighbours in the vector.
            where = _pointer_at(b, buffer.base[u], moving, fixed, item)
            names.append(_load(b, _vector(b, item), where, item))
            continue
        pointers = _pointers(b, buffer, u, moving, fixed, item)
        elements = [_load(b, item, pointer) for pointer in pointers]
        names.append(_vector_of(b, elements, item))
    return _from_memory(b, b.number(names, buffer.dtype, True))


def _vector(b: Builder, item: str, count: int = 1) -> str:
    """The type of a vector with `count` elements of each trajectory."""
    return f"<{b.W * count} x {item}>" if b.W * count > 1 else item


def _vector_of(b: Builder, elements: Sequence[str], item: str) -> str:
    if b.W == 1:
        return elements[0]
    vector = "poison"
    for i, element in enumerate(elements):
        vector = b.new(f"insertelement {_vector(b, item)} {vector}, {item} {element}, i64 {i}")
    return vector


def _element(b: Builder, vector: str, i: int, item: str) -> str:
    return vector if b.W == 1 else b.new(f"extractelement {_vector(b, item)} {vector}, i64 {i}")


def store(b: Builder, buffer: Buffer, x: Num, distance: Num | int = 0) -> None:
    """Write a number to `distance` elements from the start."""
    assert x.dtype == buffer.dtype, (x.dtype, buffer.dtype)
    item = stored_type(buffer.dtype)
    moving, fixed = _offset(b, buffer, distance)
    if buffer.lane is None:
        if x.vec or moving.vec:
            # Which trajectory wrote last would decide.
            raise NotCompilable(
                f"an array of shape {buffer.shape} that all trajectories share is written with a "
                "value or an index that differs between them"
            )
        where = _pointer_at(b, buffer.base[0], moving, fixed, item)
        _store(b, item, _to_memory(b, x, 0, False), where)
        return
    for u in range(b.U):
        name = _to_memory(b, x, u, True)
        if b.W > 1 and buffer.lane == 1 and not moving.vec:
            where = _pointer_at(b, buffer.base[u], moving, fixed, item)
            _store(b, _vector(b, item), name, where, item)
            continue
        for i, pointer in enumerate(_pointers(b, buffer, u, moving, fixed, item)):
            _store(b, item, _element(b, name, i, item), pointer)


def _pointer_at(b: Builder, base: str, moving: Num, fixed: int, item: str) -> str:
    """A pointer moved by so many elements."""
    where = b.pointer(item, base, moving.names[0] if moving.value is None else 0)
    return b.pointer(item, where, fixed)


def _pointers(
    b: Builder, buffer: Buffer, u: int, moving: Num, fixed: int, item: str
) -> Iterator[str]:
    """Where the element is, for each trajectory of vector u."""
    base = buffer.base[u if buffer.lane is not None else 0]
    if not moving.vec:
        assert buffer.lane is not None  # else the number is the same on all trajectories
        where = _pointer_at(b, base, moving, fixed, item)
        for i in range(b.W):
            yield _lane_pointer(b, where, i, buffer.lane, item)
        return
    index = b.ref(b.add(moving, b.const(fixed, "int64")), u, True)
    for i in range(b.W):
        element_index = _element(b, index, i, "i64")
        start = base if buffer.lane is None else _lane_pointer(b, base, i, buffer.lane, item)
        yield b.pointer(item, start, element_index)


def _lane_pointer(b: Builder, base: str, i: int, lane: int | str, item: str) -> str:
    if i == 0 or isinstance(lane, int):
        return b.pointer(item, base, i and i * lane)
    distance = b.find_or_make(("lane", lane, i), lambda: b.new(f"mul i64 {lane}, {i}"))
    return b.pointer(item, base, distance)


def _load(b: Builder, kind: str, where: str, item: str = "") -> str:
    # The alignment of one element, not of the vector: a row may begin anywhere.
    return b.new(f"load {kind}, ptr {where}, align {_bytes(item or kind)}")


def _store(b: Builder, kind: str, name: str, where: str, item: str = "") -> None:
    b.emit(f"store {kind} {name}, ptr {where}, align {_bytes(item or kind)}")


def _bytes(item: str) -> int:
    return {"double": 8, "float": 4}.get(item) or int(item[1:]) // 8


def _from_memory(b: Builder, x: Num) -> Num:
    """Truth values take a byte each in memory."""
    if x.dtype != "bool":
        return x
    # Any byte but 0 counts as true.
    is_vector = x.vec and b.W > 1
    kind, zero = ("i8", "0") if not is_vector else (_vector(b, "i8"), "zeroinitializer")
    return b.number([b.new(f"icmp ne {kind} {name}, {zero}") for name in x.names], "bool", x.vec)


def _to_memory(b: Builder, x: Num, u: int, vec: bool) -> str:
    name = b.ref(x, u, vec)
    if x.dtype != "bool":
        return name
    kind = _vector(b, "i8") if vec else "i8"
    return b.new(f"zext {b.type('bool', vec)} {name} to {kind}")


# --- whole rows: the numbers of a trajectory are neighbours, those of a vector are not ------------


def load_row(b: Builder, buffer: Buffer) -> list[Num]:
    """All elements in row-major order."""
    if not _is_row(b, buffer):
        return [load(b, buffer, buffer.position(i)) for i in np.ndindex(buffer.shape)]
    item, moving, fixed = TYPES[buffer.dtype], *_offset(b, buffer, 0)
    names: list[list[str]] = [[] for _ in range(buffer.size)]
    for u in range(b.U):
        where = _start_of_row(b, buffer, u, moving, item)
        for first, count in _pieces(buffer.size, buffer.lane):
            of_lanes = _load_lanes(b, buffer, where, fixed + first, count, item)
            for j in range(count):
                names[first + j].append(_pick(b, of_lanes, j, count, item))
    return [b.number(of_u, buffer.dtype, True) for of_u in names]


def store_row(b: Builder, buffer: Buffer, numbers: Sequence[Num]) -> None:
    """Write all elements, given in row-major order."""
    if not _is_row(b, buffer):
        for i, x in zip(np.ndindex(buffer.shape), numbers, strict=True):
            store(b, buffer, x, buffer.position(i))
        return
    item, moving, fixed = TYPES[buffer.dtype], *_offset(b, buffer, 0)
    for u in range(b.U):
        where = _start_of_row(b, buffer, u, moving, item)
        for first, count in _pieces(buffer.size, buffer.lane):
            vectors = [b.ref(x, u, True) for x in numbers[first : first + count]]
            _store_lanes(b, buffer, where, fixed + first, vectors, item)


# A piece of four is loaded by one instruction for each trajectory, and its transposition takes few
# shuffles; longer rows are cut.
_LONGEST_PIECE = 4


def _pieces(size: int, lane: Any) -> list[tuple[int, int]]:
    """A row cut into pieces that are moved as a whole: (first, count)."""
    if lane == size and size <= _LONGEST_PIECE:
        return [(0, size)]
    pieces, first = [], 0
    while first < size:
        # Vectors of other lengths are taken apart by LLVM, slowly.
        count = next(c for c in (4, 2, 1) if c <= size - first)
        pieces.append((first, count))
        first += count
    return pieces


def _is_row(b: Builder, buffer: Buffer) -> bool:
    """Whether the elements of one trajectory are neighbours, and those of a vector are not."""
    if b.W == 1 or buffer.lane in (None, 1) or buffer.dtype == "bool" or buffer.size < 2:
        return False
    moves = any(isinstance(x, Num) and x.vec for x in buffer.offset)
    return not moves and buffer.strides == contiguous(buffer.shape)


def _start_of_row(b: Builder, buffer: Buffer, u: int, moving: Num, item: str) -> str:
    return b.pointer(item, buffer.base[u], moving.names[0] if moving.value is None else 0)


def _load_lanes(b: Builder, buffer: Buffer, where: str, first: int, count: int, item: str) -> str:
    """One vector with `count` neighbours of each trajectory, one trajectory after the other."""
    assert buffer.lane is not None
    where = b.pointer(item, where, first)
    if buffer.lane == count:
        return _load(b, f"<{b.W * count} x {item}>", where, item)
    parts = []
    for i in range(b.W):
        pointer = _lane_pointer(b, where, i, buffer.lane, item)
        parts.append(_load(b, f"<{count} x {item}>", pointer, item))
    return _join(b, parts, count, item)


def _store_lanes(
    b: Builder, buffer: Buffer, where: str, first: int, vectors: list[str], item: str
) -> None:
    """Write one vector for each of some neighbours."""
    assert buffer.lane is not None
    count, where = len(vectors), b.pointer(item, where, first)
    vector = _join(b, vectors, b.W, item)
    if buffer.lane == count:
        order = [j * b.W + i for i in range(b.W) for j in range(count)]
        row_major = _shuffle(b, vector, b.W * count, order, item)
        _store(b, f"<{b.W * count} x {item}>", row_major, where, item)
        return
    for i in range(b.W):
        row = _shuffle(b, vector, b.W * count, [j * b.W + i for j in range(count)], item)
        pointer = _lane_pointer(b, where, i, buffer.lane, item)
        _store(b, f"<{count} x {item}>", row, pointer, item)


def _pick(b: Builder, vector: str, j: int, count: int, item: str) -> str:
    """Number j of each trajectory, of `count` that lie next to each other."""
    return _shuffle(b, vector, b.W * count, [i * count + j for i in range(b.W)], item)


def _join(b: Builder, parts: list[str], length: int, item: str) -> str:
    """Vectors of one length, one after the other."""
    # A shuffle joins two vectors of one length: fill up to a power of two.
    padding = (1 << (len(parts) - 1).bit_length()) - len(parts)
    count = len(parts) * length
    parts = [*parts, *["poison"] * padding]
    while len(parts) > 1:
        parts = [
            _shuffle_two(b, x, y, length, range(2 * length), item) if x != "poison" else x
            for x, y in zip(parts[::2], parts[1::2], strict=True)
        ]
        length *= 2
    return parts[0] if length == count else _shuffle(b, parts[0], length, range(count), item)


def _shuffle(b: Builder, vector: str, length: int, order: Sequence[int], item: str) -> str:
    if list(order) == list(range(length)):
        return vector
    return _shuffle_two(b, vector, "poison", length, order, item)


def _shuffle_two(b: Builder, x: str, y: str, length: int, order: Sequence[int], item: str) -> str:
    """The elements of two vectors of this length with the numbers in `order`."""
    kind, indices = f"<{length} x {item}>", ", ".join(f"i32 {k}" for k in order)
    return b.new(f"shufflevector {kind} {x}, {kind} {y}, <{len(order)} x i32> <{indices}>")


def copy_transposed(b: Builder, source: Buffer, target: Buffer) -> None:
    """Copy `source`, with contiguous vectors, to the first elements of `target`, in which those of
    one trajectory are neighbours. The size is a multiple of the width."""
    item, W = TYPES[source.dtype], b.W
    moving, fixed = _offset(b, target, 0)
    start = b.pointer(item, _start_of_row(b, target, 0, moving, item), fixed)
    lane = target.lane
    assert lane is not None
    block = b.U * W  # the vectors of one element
    by_vector = f"{lane * W}" if isinstance(lane, int) else b.new(f"mul i64 {lane}, {W}")

    def copy_vector(u: str) -> None:
        first = b.new(f"mul i64 {u}, {W}")
        of_source = b.pointer(item, source.base[0], first)
        of_target = b.pointer(item, start, b.new(f"mul i64 {u}, {by_vector}"))

        def copy_square(c: str) -> None:
            corner = b.pointer(item, of_source, b.new(f"mul i64 {c}, {W * block}"))
            vectors = []
            for j in range(W):
                where = b.new(f"getelementptr {item}, ptr {corner}, i64 {j * block}")
                vectors.append(_load(b, f"<{W} x {item}>", where, item))
            destination = b.pointer(item, of_target, b.new(f"mul i64 {c}, {W}"))
            for i, row in enumerate(_square_transposed(b, vectors, item)):
                where = _lane_pointer(b, destination, i, lane, item)
                _store(b, f"<{W} x {item}>", row, where, item)

        # Squares of W elements of W trajectories: each is transposed in registers.
        b.repeat(source.size // W, copy_square)

    b.repeat(b.U, copy_vector)


def _square_transposed(b: Builder, rows: list[str], item: str) -> list[str]:
    """W vectors of W as rows of a matrix → its columns, by exchanging halves, quarters, …"""
    W, rows = len(rows), list(rows)
    half = W // 2
    while half:
        for i in (i for i in range(W) if not i & half):
            x, y = rows[i], rows[i + half]
            low = [k if not k & half else W + k - half for k in range(W)]
            high = [k + half if not k & half else W + k for k in range(W)]
            rows[i] = _shuffle_two(b, x, y, W, low, item)
            rows[i + half] = _shuffle_two(b, x, y, W, high, item)
        half //= 2
    return rows
