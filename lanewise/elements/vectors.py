"""Vectors of elements of an array in memory: in a row, with a stride, or at pointers."""

import numpy as np

from ..llvm.builder import Builder
from ..llvm.ir import TYPES, Num
from ..llvm.memory import stored_type
from ..native import machine


def load(b: Builder, where: str, dtype: str, stride: int, mask: str | None = None) -> Num:
    """A vector of elements with a stride, or with stride 0 one element for all."""
    item, W = stored_type(dtype), b.W
    if W == 1 or stride == 0:
        name = b.new(f"load {item}, ptr {where}, align {_bytes(dtype)}")
        if dtype == "bool":  # any byte but 0 counts as true
            name = b.new(f"icmp ne i8 {name}, 0")
        return b.number([name], dtype, False)
    if stride == 1 and mask is None:
        name = b.new(f"load <{W} x {item}>, ptr {where}, align {_bytes(dtype)}")
        return _from_vector(b, name, dtype)
    pointers = where if stride == 1 else _pointers_with_stride(b, where, item, stride)
    return _from_vector(b, _masked_access(b, pointers, stride == 1, dtype, mask), dtype)


def gather(b: Builder, where: str, dtype: str, by: Num, stride: int, mask: str | None) -> Num:
    """Elements at distances that differ within a vector, and a stride in addition."""
    item, distances = stored_type(dtype), b.ref(by, 0, True)
    if stride:
        distances = b.new(f"add <{b.W} x i64> {distances}, {_steps(b, stride)}")
    pointers = b.new(f"getelementptr {item}, ptr {where}, <{b.W} x i64> {distances}")
    return _from_vector(b, _masked_access(b, pointers, False, dtype, mask), dtype)


def store(b: Builder, where: str, x: Num, stride: int, mask: str | None = None) -> None:
    """Write a vector of elements with a stride, or with stride 0 one element."""
    item, is_vector = stored_type(x.dtype), b.W > 1 and stride != 0
    name, kind = b.ref(x, 0, is_vector), f"<{b.W} x {item}>" if is_vector else item
    if x.dtype == "bool":
        name = b.new(f"zext {b.type('bool', is_vector)} {name} to {kind}")
    if not is_vector or (stride == 1 and mask is None):
        # The alignment of one element: a row may begin anywhere.
        b.emit(f"store {kind} {name}, ptr {where}, align {_bytes(x.dtype)}")
        return
    pointers = where if stride == 1 else _pointers_with_stride(b, where, item, stride)
    _masked_access(b, pointers, stride == 1, x.dtype, mask, name)


def first_elements(b: Builder, count: int) -> str:
    """The mask of the first elements of a vector."""
    return f"<{', '.join(f'i1 {str(i < count).lower()}' for i in range(b.W))}>"


def halves(b: Builder, x: Num, width: int) -> list[Num]:
    """The first and the second half of a vector; each sets the length of vectors to its own."""
    name, kind = x.names[0], f"<{width} x {TYPES[x.dtype]}>"
    b.W = width // 2
    if b.W == 1:
        parts = [b.new(f"extractelement {kind} {name}, i64 {i}") for i in range(2)]
    else:
        parts = []
        for first in (0, b.W):
            places = ", ".join(f"i32 {first + i}" for i in range(b.W))
            mask = f"<{b.W} x i32> <{places}>"
            parts.append(b.new(f"shufflevector {kind} {name}, {kind} poison, {mask}"))
    return [b.number([part], x.dtype, b.W > 1) for part in parts]


def _steps(b: Builder, stride: int) -> str:
    return f"<{', '.join(f'i64 {stride * i}' for i in range(b.W))}>"


def _pointers_with_stride(b: Builder, where: str, item: str, stride: int) -> str:
    """Pointers to the elements of a vector."""
    return b.new(f"getelementptr {item}, ptr {where}, <{b.W} x i64> {_steps(b, stride)}")


def _from_vector(b: Builder, name: str, dtype: str) -> Num:
    if dtype == "bool":
        name = b.new(f"icmp ne <{b.W} x i8> {name}, zeroinitializer")
    return b.number([name], dtype, True)


def _masked_access(
    b: Builder, pointers: str, is_row: bool, dtype: str, mask: str | None, value: str = ""
) -> str:
    """LLVM's load or store of a row, or of elements at pointers of their own, where the mask is
    true; `value` is what is stored."""
    item, W = stored_type(dtype), b.W
    # A masked access touches no memory where the mask is false: a row may end at a page.
    words = ("load", "store") if is_row else ("gather", "scatter")
    vector, bits = f"<{W} x {item}>", f"<{W} x i1>"
    short = {"double": "f64", "float": "f32"}.get(item, item)
    pointer, suffix = ("ptr", "p0") if is_row else (f"<{W} x ptr>", f"v{W}p0")
    name = f"@llvm.masked.{words[bool(value)]}.v{W}{short}.{suffix}"
    # From release 22 on LLVM takes the alignment as an attribute of the pointer.
    is_new = machine.start_llvm().llvm_version_info[0] >= 22
    align = _bytes(dtype)
    place = f"{pointer} align {align} {pointers}" if is_new else f"{pointer} {pointers}"
    number, kind_of_number = ([], []) if is_new else ([f"i32 {align}"], ["i32"])
    of_mask, kinds = f"{bits} {mask or 'splat (i1 true)'}", [pointer, *kind_of_number, bits]
    if value:
        b.declare(f"void {name}({', '.join([vector, *kinds])})")
        operands = [f"{vector} {value}", place, *number, of_mask]
        b.emit(f"call void {name}({', '.join(operands)})")
        return ""
    b.declare(f"{vector} {name}({', '.join([*kinds, vector])})")
    operands = [place, *number, of_mask, f"{vector} zeroinitializer"]
    return b.new(f"call {vector} {name}({', '.join(operands)})")


def _bytes(dtype: str) -> int:
    return np.dtype(dtype).itemsize
