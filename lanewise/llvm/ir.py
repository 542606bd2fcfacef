"""The text of one function in LLVM IR, and the numbers in it.

A number is either the same on all trajectories (a scalar in the IR) or has a value for each (`U`
vectors of `W` elements). The operations do not depend on `W` and `U`: `Operations` decides on
numbers which products and sums become fused multiply-adds, and LLVM may not change an operation.
"""

import contextlib
import dataclasses
import itertools
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

MOST_OPERATIONS = 60_000
"""Functions with more operations are left to XLA, loops counted once."""

# NumPy's name of a type → LLVM's.
TYPES = {
    "float64": "double",
    "float32": "float",
    "bool": "i1",
    **{f"{sign}int{bits}": f"i{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
}
FLOATS = ("float64", "float32")


class NotCompilable(Exception):
    """Something for which no code is generated; the message says what."""


class FasterInXlaError(NotCompilable):
    """A program that XLA computes faster than all targets."""


def check_type(dtype: Any, name: str = "numbers") -> str:
    """The name of a type for which code is generated."""
    if str(dtype) not in TYPES:
        types = "float64, float32, bool or integers of 8 to 64 bits"
        raise NotCompilable(f"{name} must be {types}, got {dtype}")
    return str(dtype)


def check_that(condition: bool, reason: str) -> None:
    """Refuse what has no code, with the reason."""
    if not condition:
        raise NotCompilable(reason)


def check_size(size: int, limit: int, name: str, *shapes: Sequence[int]) -> None:
    """Refuse what would become too much code, or too much memory."""
    if size > limit:
        arrays = f" for shapes {', '.join(map(str, shapes))}" if shapes else ""
        raise NotCompilable(f"{name} must be at most {limit}, got {size}{arrays}")


@dataclasses.dataclass(eq=False, slots=True)
class Num:
    """One number: a constant, a scalar, or one value for each trajectory of a block.

    - `names`: of its vectors in the IR, or of its scalar; none for a constant, which has a `value`.
    - `op`, `args`, `write`: how it was made, where that matters for later numbers.
    - `loops`: of so many loops, one within the other, the rounds change it.
    - `structural`: a 0 or 1 that the structure of the problem makes, whatever the values are. Only
      for such a zero 0·x is 0 for every x.
    """

    names: tuple[str, ...]
    dtype: str
    vec: bool
    value: Any = None
    op: str = ""
    args: tuple["Num", ...] = ()
    serial: int = 0
    loops: int = 0
    structural: bool = False
    write: Callable[..., str] | None = None

    @property
    def key(self) -> Any:
        """Equal for two numbers only if they are the same."""
        if self.value is None:
            return self.serial
        # The bytes: 0 and −0 are two numbers, and a NaN is equal to itself here.
        return self.dtype, np.asarray(self.value, self.dtype).tobytes(), self.structural

    @property
    def is_float(self) -> bool:
        return self.dtype in FLOATS

    @property
    def is_unsigned(self) -> bool:
        return self.dtype.startswith("u") or self.dtype == "bool"

    def is_const(self, value: float) -> bool:
        return self.value is not None and bool(self.value == value)


def literal(value: Any, dtype: str) -> str:
    """A constant as LLVM writes it."""
    if dtype in FLOATS:
        # In hexadecimal, as float64 also for float32: LLVM rejects decimals that it has to round.
        (bits,) = struct.unpack(">Q", struct.pack(">d", float(value)))
        return f"0x{bits:016X}"
    if dtype == "bool":
        return "true" if value else "false"
    return str(int(value))


Section = list[Any]
"""Instructions of a block: pairs (name of the result or "", text), and sections among them."""


class Writer:
    """The body of one function: blocks, each with a label and a section of instructions.

    Instructions that belong to an earlier place than the current one, such as a loop's preheader,
    are written to a section that was reserved there.
    """

    def __init__(self, width: int, vectors: int):
        self.W, self.U = width, vectors
        self.block = "entry"
        self.section: Section = []  # where instructions are written
        self.blocks: list[tuple[str, Section]] = [(self.block, self.section)]
        self.operations, self.limit = 0, MOST_OPERATIONS
        self.loops = 0  # around the current place
        # A number that was made in a loop or a branch is not known outside of it: each has a scope.
        self.scopes: list[dict] = [{}]
        self.declarations: set[str] = set()
        self._names, self._serials = itertools.count(), itertools.count(1)

    # --- text --------------------------------------------------------------------------------

    def emit(self, line: str) -> None:
        self.section.append(("", line))

    def name(self) -> str:
        return f"%v{next(self._names)}"

    def new(self, instruction: str) -> str:
        name = f"%v{next(self._names)}"
        self.section.append((name, instruction))
        return name

    def pointer(self, item: str, base: str, count: str | int) -> str:
        """The pointer that is `count` items further."""
        return self.new(f"getelementptr {item}, ptr {base}, i64 {count}") if count != 0 else base

    def label(self) -> str:
        return f"L{next(self._names)}"

    def begin(self, label: str) -> None:
        self.block, self.section = label, []
        self.blocks.append((label, self.section))

    def reserve(self) -> Section:
        """A section at the current place, to be written later."""
        section: Section = []
        self.section.append(section)
        return section

    @contextlib.contextmanager
    def writing(self, section: Section) -> Iterator[None]:
        """Write instructions to a section that was reserved."""
        current, self.section = self.section, section
        try:
            yield
        finally:
            self.section = current

    def remove(self, name: str, block_index: int) -> None:
        """Remove the instruction whose result is `name` from the blocks from `block_index` on."""
        for _, section in self.blocks[block_index:]:
            for i, item in enumerate(section):
                if isinstance(item, tuple) and item[0] == name:
                    del section[i]
                    return
        raise AssertionError(f"no instruction makes {name}")

    @property
    def lines(self) -> list[str]:
        """The text, without the label of the first block."""
        (_, entry), *blocks = self.blocks
        lines = list(_text(entry))
        for label, section in blocks:
            lines += [f"{label}:", *_text(section)]
        return lines

    def declare(self, line: str) -> None:
        self.declarations.add("declare " + line)

    def type(self, dtype: str, vec: bool) -> str:
        return f"<{self.W} x {TYPES[dtype]}>" if vec and self.W > 1 else TYPES[dtype]

    def suffix(self, dtype: str, vec: bool) -> str:
        """The type as it is written in the name of an intrinsic function."""
        scalar = {"float64": "f64", "float32": "f32"}.get(dtype) or TYPES[dtype]
        return f"v{self.W}{scalar}" if vec and self.W > 1 else scalar

    def mark(self) -> tuple:
        """The state of the text, for `back_to`."""
        scope = dict(self.scopes[-1])
        return (
            len(self.blocks),
            len(self.section),
            self.operations,
            self.loops,
            len(self.scopes),
            scope,
        )

    def back_to(self, mark: tuple) -> None:
        """Forget what was written since the mark, which was made in the same function."""
        count, length, self.operations, self.loops, depth, scope = mark
        del self.blocks[count:], self.scopes[depth:]
        self.block, self.section = self.blocks[-1]
        del self.section[length:]
        self.scopes[-1] = scope

    def find(self, key: Any) -> Any:
        for scope in reversed(self.scopes):
            if key in scope:
                return scope[key]
        return None

    def note(self, key: Any, value: Any) -> None:
        self.scopes[-1][key] = value

    def find_or_make(self, key: Any, make: Callable[[], Any]) -> Any:
        """The object that was made under a key; made now if it is missing."""
        item = self.find(key)
        if item is None:
            item = make()
            self.note(key, item)
        return item

    # --- numbers -----------------------------------------------------------------------------

    def const(self, value: Any, dtype: str, structural: bool = False) -> Num:
        check_type(dtype)
        return Num((), dtype, False, np.asarray(value, dtype)[()], structural=structural)

    def number(self, names: Sequence[str], dtype: str, vec: bool, op: str = "", args=()) -> Num:
        loops = max((a.loops for a in args), default=self.loops)
        return Num(tuple(names), dtype, vec, None, op, args, next(self._serials), loops)

    def opaque(self, x: Num) -> Num:
        """The number itself, without what is known of how it was made."""
        if x.value is not None or not x.op:
            return x
        return self.find_or_make(
            ("opaque", x.serial), lambda: self.number(x.names, x.dtype, x.vec, "same", (x,))
        )

    def without_origin(self, x: Num) -> Num:
        """The number treated as a result of a loop: not even a constant is known any more."""
        # Integers stay known: they decide indices and branches, and have no rounding.
        if x.value is None or not x.is_float:
            return self.opaque(x)
        return self.number([literal(x.value, x.dtype)], x.dtype, False)

    def ref(self, x: Num, u: int, vec: bool) -> str:
        """The name of a number in vector u, as a vector where `vec`."""
        if x.value is not None:
            text = literal(x.value, x.dtype)
            if not vec or self.W == 1:
                return text
            return "<" + ", ".join([f"{TYPES[x.dtype]} {text}"] * self.W) + ">"
        if x.vec:
            return x.names[u]
        return self.splat(x) if vec and self.W > 1 else x.names[0]

    def refs(self, x: Num, vec: bool) -> list[str]:
        """The names of all vectors of a number, or of its scalar."""
        return [self.ref(x, u, vec) for u in range(self.U if vec else 1)]

    def splat(self, x: Num) -> str:
        """A vector with a scalar in each element."""

        def make() -> str:
            kind = self.type(x.dtype, True)
            # LLVM has no instruction for it: it recognises this pair as a broadcast.
            first = self.new(f"insertelement {kind} poison, {TYPES[x.dtype]} {x.names[0]}, i64 0")
            zeros = f"<{self.W} x i32> zeroinitializer"
            return self.new(f"shufflevector {kind} {first}, {kind} poison, {zeros}")

        return self.find_or_make(("splat", x.serial), make)

    def op(self, op: str, args: Sequence[Num], dtype: str, write: Callable[..., str]) -> Num:
        """The number made by the instruction ``write(type of the operands, *names)``."""
        # Most of the time of the compiler is spent here: no further function is called.
        key = (op, dtype, *(a.key for a in args))
        old = self.find(key)
        if old is not None:
            return old
        vec = any(a.vec for a in args)
        kind = self.type(args[0].dtype, vec)
        self.operations += 1
        names = [
            self.new(write(kind, *(self.ref(a, u, vec) for a in args)))
            for u in range(self.U if vec else 1)
        ]
        number = self.number(names, dtype, vec, op, tuple(args))
        number.write = write
        self.note(key, number)
        return number

    def instruction(self, word: str, args: Sequence[Num], op: str = "") -> Num:
        """The number made by an instruction of one word, of numbers of one type."""

        dtype = args[0].dtype
        return self.op(op or word, args, dtype, lambda kind, *xs: f"{word} {kind} {', '.join(xs)}")

    def intrinsic(self, name: str, args: Sequence[Num]) -> Num:
        """``llvm.<name>`` of numbers of one type."""
        dtype, vec = args[0].dtype, any(a.vec for a in args)
        kind, full = self.type(dtype, vec), f"llvm.{name}.{self.suffix(dtype, vec)}"
        self.declare(f"{kind} @{full}({', '.join([kind] * len(args))})")

        return self.op(name, args, dtype, lambda kind, *names: call_of(f"@{full}", kind, names))


def call_of(function: str, kind: str, names: Sequence[str]) -> str:
    """The call of a function of numbers of one type, with a result of this type."""
    return f"call {kind} {function}({', '.join(f'{kind} {name}' for name in names)})"


def _text(section: Section) -> Iterator[str]:
    for item in section:
        if isinstance(item, list):
            yield from _text(item)
        else:
            name, instruction = item
            yield f"  {name} = {instruction}" if name else f"  {instruction}"
