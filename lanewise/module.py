"""An LLVM module while it is written: its parameters, constants, scratch memory and functions."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .llvm.builder import Builder
from .llvm.ir import Num, check_size, literal
from .llvm.memory import Buffer, contiguous, stored_type


class Module:
    """A kernel, the functions that it calls, and its constants.

    Rules write instructions through `b`; for everything else they ask the module, so that a target
    can answer in its own way (see `lanewise.targets`).
    """

    largest = 64 * 2**20
    """Bytes that a block may take for arrays that are not results."""
    platform = "cpu"

    def __init__(self, width: int, vectors: int):
        self.b = Builder(width, vectors)
        self.values: list[int] = []
        self.globals: list[str] = []
        self.functions: dict[tuple[str, int], str] = {}
        self.calls: dict[Any, int] = {}  # of the jaxprs of functions marked by `once`
        self.written_functions: dict[Any, Any] = {}
        self.declarations: set[str] = set()
        self.scratch_bytes = 0
        self._constants: dict[bytes, str] = {}

    def of_function(self) -> "Module":
        """The module of a function that is called: its memory and inputs are its own."""
        inner = type(self)(self.b.W, 1)
        inner.globals, inner.functions = self.globals, self.functions
        inner.declarations, inner._constants = self.declarations, self._constants
        inner.calls = self.calls
        inner.written_functions = self.written_functions
        inner.b.limit = self.b.limit
        return inner

    def parameter(self, value: int) -> Num:
        """A whole number that is an input of the machine code: another one needs no new code."""
        # So a run of other length, or with longer arrays, finds its code in the cache.
        name = f"%par{len(self.values)}"
        self.values.append(int(value))
        return self.b.number([name], "int64", False)

    def scratch(self, shape: Sequence[int], dtype: str, has_lanes: bool, copies: int = 1) -> Buffer:
        """Memory for an array of each trajectory of the block; for a shared one without lanes."""
        size = int(np.prod(shape, dtype=np.int64))
        block = self.b.W * self.b.U if has_lanes else copies
        start = self.scratch_bytes
        # Whole cache lines, so that no vector lies in two of them.
        self.scratch_bytes += (size * block * 8 + 63) // 64 * 64
        check_size(self.scratch_bytes, self.largest, "bytes of intermediate arrays of a block")
        item = np.dtype(dtype).itemsize
        bases = tuple(
            self.b.new(f"getelementptr i8, ptr %scratch, i64 {start + u * self.b.W * item}")
            for u in range(self.b.U if has_lanes else 1)
        )
        return Buffer(
            bases, dtype, tuple(shape), contiguous(shape, block), 1 if has_lanes else None
        )

    def constant(self, array: np.ndarray) -> Buffer:
        """A known array in the module."""
        array = np.ascontiguousarray(array)
        dtype = str(array.dtype)
        item = stored_type(dtype)
        key = dtype.encode() + str(array.shape).encode() + array.tobytes()
        if key not in self._constants:
            name = f"@data{len(self._constants)}"
            self._constants[key] = name
            stored_dtype = "int8" if dtype == "bool" else dtype
            numbers = ", ".join(
                f"{item} {literal(x, stored_dtype)}" for x in array.astype(stored_dtype).reshape(-1)
            )
            # LLVM reads a longer array in vectors of 16 bytes, but for GPUs declares the alignment
            # of one number.
            kind = f"[{array.size} x {item}]"
            line = f"{name} = private unnamed_addr constant {kind} [{numbers}], align 16"
            self.globals.append(line)
        name = self._constants[key]
        return Buffer((name,), dtype, array.shape, contiguous(array.shape), None)

    def add_function(self, key: tuple[str, int], write: Callable[[], tuple]) -> None:
        """Add a function that is not there yet; ``write()`` → (text, declarations, constants)."""
        if key not in self.functions:
            self.functions[key] = ""  # its place: a function comes after those it calls
            self.functions[key], declarations, constants = write()
            self.declarations |= declarations
            self.globals += [line for line in constants if line not in self.globals]

    # Numbers that wait in memory while a loop runs. Without "volatile" the optimiser would keep
    # them in registers, which the loop needs.

    def set_aside(self, x: Num, pointers: Sequence[str], vec: bool) -> None:
        """Write a number of a carry to one pointer for each vector."""
        kind = self.b.type(x.dtype, vec)
        for name, pointer in zip(x.names, pointers, strict=True):
            self.b.emit(f"store volatile {kind} {name}, ptr {pointer}")

    def taken_back(self, x: Num, pointers: Sequence[str], vec: bool) -> Num:
        """The number that was set aside there."""
        b = self.b
        kind = b.type(x.dtype, vec)
        names = [b.new(f"load volatile {kind}, ptr {pointer}") for pointer in pointers]
        return b.number(names, x.dtype, vec)
