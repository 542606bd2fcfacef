"""PTX run on a CPU: a translator to LLVM IR, for tests of GPU code where there is no GPU.

Only what LLVM writes for the kernels of `lanewise.targets.threads` is understood, and everything
else is an error. A floating-point instruction that rounds must say ``.rn``: without it the
assembler of a GPU may contract a product with a sum. An access must be aligned, as a GPU requires:
arrays are placed where they have the alignment that PTX declares, and no larger one.
"""

import ctypes
import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partialmethod
from typing import Any

import numpy as np

from lanewise.llvm.ptx import PtxKernel
from lanewise.native import machine

FLOATS = {"f64": ("double", "i64"), "f32": ("float", "i32")}
ROUNDED = frozenset(["add", "sub", "mul", "fma", "div", "rcp", "sqrt"])

# Comparisons of PTX → those of LLVM, of floating-point numbers; a trailing u: true for NaN.
COMPARISONS = {
    **{op: f"o{op}" for op in ("eq", "ne", "lt", "le", "gt", "ge")},
    **{f"{op}u": f"u{op}" for op in ("eq", "ne", "lt", "le", "gt", "ge")},
    "num": "ord",
    "nan": "uno",
}

# Registers that are read only: number of the thread in its block, and so on.
SPECIAL = {"%tid.x": "%tid", "%ntid.x": "%ntid", "%ctaid.x": "%ctaid"}
GRID = ", ".join(f"i32 {name}" for name in SPECIAL.values())


def integer_type(word: str) -> str:
    """The type of LLVM for a type of PTX, as bits."""
    return "i1" if word == "pred" else f"i{int(word[1:])}"


def bits_of(kind: str) -> int:
    return int(kind[1:])


class Function:
    """A function of a PTX module, and its text in LLVM IR."""

    def __init__(self, module: "Translation", name: str, params: Sequence[str], body: str):
        self.module, self.name, self.params = module, name, params
        self.kinds: dict[str, str] = {}  # register, or its letters → type
        self.registers: dict[str, str] = {}
        self.memory: dict[str, int] = {}
        self.arguments: dict[str, str] = {}  # of the call that is being prepared
        self.lines: list[str] = []
        self.count = 0
        self._read(body)

    def _read(self, body: str) -> None:
        following = 0
        # Statements end with a semicolon, labels with a colon; braces open a scope.
        body = re.sub(r"^\s*[{}]\s*$", "", body, flags=re.M)
        for part in re.findall(r"\s*([$\w]+:|[^;]+;)", body):
            text = " ".join(part.split()).rstrip(";").strip()
            if text.endswith(":"):
                label = text[:-1].replace("$", "")
                self.emit(f"br label %{label}")
                self.lines.append(f"{label}:")
            elif text.startswith("."):
                self.declare(text)
            else:
                following += 1
                self.instruction(text, f"after{following}")
        self.lines.append("  ret void")

    @property
    def text(self) -> str:
        parameters = ", ".join([*(f"i64 %{p}" for p in self.params), GRID])
        allocated = [f"  {self.place(r)} = alloca {kind}" for r, kind in self.registers.items()]
        for m, (n, align) in self.memory.items():
            allocated.append(f"  %{m}.0 = alloca [{n + align} x i8], align {2 * align}")
            allocated.append(f"  %{m} = getelementptr i8, ptr %{m}.0, i64 {align}")
        head = f"define internal void @{self.name}({parameters}) {{\nentry:"
        return "\n".join([head, *allocated, *self.lines, "}\n"])

    def emit(self, line: str) -> None:
        self.lines.append(f"  {line}")

    def new(self, instruction: str) -> str:
        self.count += 1
        self.emit(f"%t{self.count} = {instruction}")
        return f"%t{self.count}"

    def call(self, name: str, kind: str, values: Sequence[str], suffix: str) -> str:
        """A call of an intrinsic function of numbers of one type."""
        types = ", ".join([kind] * len(values))
        self.module.declarations.add(f"declare {kind} @llvm.{name}.{suffix}({types})")
        passed = ", ".join(f"{kind} {value}" for value in values)
        return self.new(f"call {kind} @llvm.{name}.{suffix}({passed})")

    def declare(self, text: str) -> None:
        if match := re.fullmatch(r"\.reg \.(\w+) (%[A-Za-z]+)(?:<\d+>)?", text):
            self.kinds[match[2]] = integer_type(match[1])
        elif match := re.fullmatch(r"\.local \.align (\d+) \.b8 (\w+)\[(\d+)\]", text):
            self.memory[match[2]] = int(match[3]), int(match[1])
        else:
            assert text.startswith((".param ", ".pragma ")), text  # of a call; no instruction

    # --- operands ------------------------------------------------------------------------------

    def kind_of(self, register: str) -> str:
        match = re.match(r"%[A-Za-z]+", register)
        assert match
        return self.kinds[match[0]]

    def place(self, register: str) -> str:
        self.registers.setdefault(register, self.kind_of(register))
        return "%R." + register[1:]

    def resized(self, value: str, old: str, new: str, word: str = "zext") -> str:
        if old == new:
            return value
        word = word if bits_of(old) < bits_of(new) else "trunc"
        return self.new(f"{word} {old} {value} to {new}")

    def read(self, operand: str, kind: str) -> str:
        """An operand as bits of this type."""
        if operand in SPECIAL:
            return self.resized(SPECIAL[operand], "i32", kind)
        if operand.startswith("%"):
            place, own = self.place(operand), self.kind_of(operand)
            return self.resized(self.new(f"load {own}, ptr {place}"), own, kind)
        if operand[:2] in ("0d", "0f"):
            return str(int(operand[2:], 16))
        if operand in self.memory or operand in self.module.data:
            if operand in self.memory:
                return self.new(f"ptrtoint ptr %{operand} to {kind}")
            start = self.new(f"ptrtoint ptr @{operand} to {kind}")
            return self.new(f"add {kind} {start}, {self.module.data[operand][0]}")
        number = int(operand.rstrip("U"), 0)
        return ("true" if number else "false") if kind == "i1" else str(number)

    def write(self, register: str, value: str, kind: str, word: str = "zext") -> None:
        if register == "_":
            return
        place, own = self.place(register), self.kind_of(register)
        self.emit(f"store {own} {self.resized(value, kind, own, word)}, ptr {place}")

    def read_float(self, operand: str, f: str) -> str:
        kind, bits = FLOATS[f]
        return self.new(f"bitcast {bits} {self.read(operand, bits)} to {kind}")

    def write_float(self, register: str, value: str, f: str) -> None:
        kind, bits = FLOATS[f]
        self.write(register, self.new(f"bitcast {kind} {value} to {bits}"), bits)

    def address(self, text: str) -> tuple[str, int]:
        match = re.fullmatch(r"\[(%?[\w$]+)(?:\+(-?\d+))?\]", text)
        assert match, text
        return match[1], int(match[2] or 0)

    def pointers(self, text: str, size: int, count: int) -> list[str]:
        base, offset = self.address(text)
        start = self.read(base, "i64")
        rest = self.new(f"urem i64 {self.new(f'add i64 {start}, {offset}')}, {size * count}")
        total = self.new(f"or i64 {rest}, {self.new('load i64, ptr @misaligned')}")
        self.emit(f"store i64 {total}, ptr @misaligned")
        ends = [self.new(f"add i64 {start}, {offset + size * i}") for i in range(count)]
        return [self.new(f"inttoptr i64 {end} to ptr") for end in ends]

    # --- instructions --------------------------------------------------------------------------

    def instruction(self, text: str, following: str) -> None:
        guard = re.match(r"@(!?)(%p\d+) (.*)", text)
        word, _, rest = (guard[3] if guard else text).partition(" ")
        operands = [x.strip() for x in re.split(r",(?![^({\[]*[)}\]])", rest) if x.strip()]
        name, *parts = word.split(".")
        self.module.counts[word] += 1
        assert not {"ftz", "approx", "full", "sat", "cc"} & {*parts}, text
        if parts and parts[-1] in FLOATS and name in ROUNDED:
            assert "rn" in parts, text
        if name == "bra":
            label = operands[0].replace("$", "")
            if guard:
                labels = (following, label) if guard[1] else (label, following)
                condition = self.read(guard[2], "i1")
                self.emit(f"br i1 {condition}, label %{labels[0]}, label %{labels[1]}")
            else:
                self.emit(f"br label %{label}")
            self.lines.append(f"{following}:")
            return
        assert not guard, text
        getattr(self, f"do_{name}")(parts, operands)
        if name == "ret":
            self.lines.append(f"{following}:")

    def do_ret(self, parts: list[str], x: list[str]) -> None:
        self.emit("ret void")

    def _values(self, parts: list[str], x: list[str]) -> tuple[str, list[str]]:
        """The type of an instruction as bits, and its operands."""
        kind = integer_type(parts[-1])
        return kind, [self.read(y, kind) for y in x[1:]]

    def _of_floats(self, f: str, x: list[str], function: Callable[..., str]) -> None:
        values = [self.read_float(y, f) for y in x[1:]]
        self.write_float(x[0], function(FLOATS[f][0], *values), f)

    def _arithmetic(self, of_floats: str, of_integers: str, parts: list[str], x: list[str]) -> None:
        if parts[-1] in FLOATS:
            write = lambda kind, a, b: self.new(f"{of_floats} {kind} {a}, {b}")  # noqa: E731
            return self._of_floats(parts[-1], x, write)
        kind, (a, b) = self._values(parts, x)
        return self.write(x[0], self.new(f"{of_integers} {kind} {a}, {b}"), kind)

    do_add = partialmethod(_arithmetic, "fadd", "add")
    do_sub = partialmethod(_arithmetic, "fsub", "sub")

    def do_div(self, parts: list[str], x: list[str]) -> None:
        self._arithmetic("fdiv", f"{parts[-1][0]}div", parts, x)

    def do_rem(self, parts: list[str], x: list[str]) -> None:
        assert parts[-1] not in FLOATS  # there is no such instruction
        self._arithmetic("", f"{parts[-1][0]}rem", parts, x)

    def do_mul(self, parts: list[str], x: list[str]) -> None:
        if parts[0] not in ("wide", "hi"):
            return self._arithmetic("fmul", "mul", parts, x)
        kind, values = self._values(parts, x)
        wide, word = f"i{2 * bits_of(kind)}", "sext" if parts[-1][0] == "s" else "zext"
        a, b = (self.resized(y, kind, wide, word) for y in values)
        product = self.new(f"mul {wide} {a}, {b}")
        if parts[0] == "hi":
            product = self.new(f"lshr {wide} {product}, {bits_of(kind)}")
        return self.write(x[0], product, wide)

    def do_mad(self, parts: list[str], x: list[str]) -> None:
        assert parts[0] == "lo", parts
        kind, (a, b, c) = self._values(parts, x)
        self.write(x[0], self.new(f"add {kind} {self.new(f'mul {kind} {a}, {b}')}, {c}"), kind)

    def _intrinsic(self, name: str, parts: list[str], x: list[str]) -> None:
        f = parts[-1]
        self._of_floats(f, x, lambda kind, *values: self.call(name, kind, values, f))

    do_fma, do_sqrt = partialmethod(_intrinsic, "fma"), partialmethod(_intrinsic, "sqrt")

    def do_rcp(self, parts: list[str], x: list[str]) -> None:
        self._of_floats(parts[-1], x, lambda kind, a: self.new(f"fdiv {kind} 1.0, {a}"))

    def do_abs(self, parts: list[str], x: list[str]) -> None:
        if parts[-1] in FLOATS:
            return self._intrinsic("fabs", parts, x)
        kind, (a,) = self._values(parts, x)
        negative = self.new(f"sub {kind} 0, {a}")
        is_negative = self.new(f"icmp slt {kind} {a}, 0")
        return self.write(
            x[0], self.new(f"select i1 {is_negative}, {kind} {negative}, {kind} {a}"), kind
        )

    def do_neg(self, parts: list[str], x: list[str]) -> None:
        if parts[-1] in FLOATS:
            write = lambda kind, a: self.new(f"fneg {kind} {a}")  # noqa: E731
            return self._of_floats(parts[-1], x, write)
        kind, (a,) = self._values(parts, x)
        return self.write(x[0], self.new(f"sub {kind} 0, {a}"), kind)

    def do_copysign(self, parts: list[str], x: list[str]) -> None:
        self._intrinsic("copysign", parts, [x[0], x[2], x[1]])  # the sign comes first in PTX

    def _extreme(self, op: str, of_zeros: str, parts: list[str], x: list[str]) -> None:
        """The smaller or the larger of two: a NaN is left out, −0 is below 0."""
        kind, (a, b) = self._values(parts, x)
        f = parts[-1]
        if f not in FLOATS:
            is_first = self.new(f"icmp {'s' if f[0] == 's' else 'u'}{op} {kind} {a}, {b}")
            result = self.new(f"select i1 {is_first}, {kind} {a}, {kind} {b}")
            return self.write(x[0], result, kind)
        real, (c, d) = FLOATS[f][0], [self.read_float(y, f) for y in x[1:]]
        for test, bits in (
            (f"{'olt' if op == 'lt' else 'ogt'} {real} {c}, {d}", a),
            (f"uno {real} {d}, {d}", a),
            (f"oeq {real} {c}, {d}", self.new(f"{of_zeros} {kind} {a}, {b}")),
        ):
            b = self.new(f"select i1 {self.new(f'fcmp {test}')}, {kind} {bits}, {kind} {b}")
        return self.write(x[0], b, kind)

    do_min = partialmethod(_extreme, "lt", "or")
    do_max = partialmethod(_extreme, "gt", "and")

    def do_setp(self, parts: list[str], x: list[str]) -> None:
        op, f = parts
        if f in FLOATS:
            a, b = (self.read_float(y, f) for y in x[1:])
            result = self.new(f"fcmp {COMPARISONS[op]} {FLOATS[f][0]} {a}, {b}")
        else:
            kind, (a, b) = self._values(parts, x)
            sign = "" if op in ("eq", "ne") else "s" if f[0] == "s" else "u"
            result = self.new(f"icmp {sign}{op} {kind} {a}, {b}")
        self.write(x[0], result, "i1")

    def do_selp(self, parts: list[str], x: list[str]) -> None:
        kind, (a, b) = self._values(parts, x[:3])
        chosen = self.read(x[3], "i1")
        self.write(x[0], self.new(f"select i1 {chosen}, {kind} {a}, {kind} {b}"), kind)

    def _logic(self, word: str, parts: list[str], x: list[str]) -> None:
        kind, (a, b) = self._values(parts, x)
        self.write(x[0], self.new(f"{word} {kind} {a}, {b}"), kind)

    do_and, do_or = partialmethod(_logic, "and"), partialmethod(_logic, "or")
    do_xor = partialmethod(_logic, "xor")

    def do_not(self, parts: list[str], x: list[str]) -> None:
        kind, (a,) = self._values(parts, x)
        self.write(x[0], self.new(f"xor {kind} {a}, -1"), kind)

    def _shift(self, word: str, parts: list[str], x: list[str]) -> None:
        """A shift by an unsigned number of 32 bits; a larger one shifts everything out."""
        kind, by = integer_type(parts[-1]), self.read(x[2], "i32")
        size, value = bits_of(kind), self.read(x[1], kind)
        is_large = self.new(f"icmp uge i32 {by}, {size}")
        by = self.new(f"select i1 {is_large}, i32 {size - 1}, i32 {by}")
        shifted = self.new(f"{word} {kind} {value}, {self.resized(by, 'i32', kind)}")
        if word != "ashr":
            shifted = self.new(f"select i1 {is_large}, {kind} 0, {kind} {shifted}")
        self.write(x[0], shifted, kind)

    do_shl = partialmethod(_shift, "shl")

    def do_shr(self, parts: list[str], x: list[str]) -> None:
        self._shift("ashr" if parts[-1][0] == "s" else "lshr", parts, x)

    def do_shf(self, parts: list[str], x: list[str]) -> None:
        assert parts[1:] == ["wrap", "b32"], parts
        low, high, by = (self.read(y, "i32") for y in x[1:])
        name = {"l": "fshl", "r": "fshr"}[parts[0]]
        self.write(x[0], self.call(name, "i32", [high, low, by], "i32"), "i32")

    def do_prmt(self, parts: list[str], x: list[str]) -> None:
        """Four bytes, each the one of eight that a digit of the last operand selects."""
        assert parts == ["b32"], parts
        low, high = (self.resized(self.read(y, "i32"), "i32", "i64") for y in x[1:3])
        both, total = self.new(f"or i64 {low}, {self.new(f'shl i64 {high}, 32')}"), "0"
        for i, digit in enumerate(reversed(f"{int(x[3].rstrip('U'), 0):04x}")):
            assert digit in "01234567", x  # others repeat a sign
            byte = self.new(f"and i64 {self.new(f'lshr i64 {both}, {8 * int(digit)}')}, 255")
            total = self.new(f"or i64 {total}, {self.new(f'shl i64 {byte}, {8 * i}')}")
        self.write(x[0], total, "i64")

    def do_bfe(self, parts: list[str], x: list[str]) -> None:
        kind, is_signed = integer_type(parts[-1]), parts[-1][0] == "s"
        size, start, count = bits_of(kind), int(x[2]), int(x[3])
        left = self.new(f"shl {kind} {self.read(x[1], kind)}, {size - start - count}")
        word = "ashr" if is_signed else "lshr"
        self.write(x[0], self.new(f"{word} {kind} {left}, {size - count}"), kind)

    def do_cvt(self, parts: list[str], x: list[str]) -> None:
        new, old = parts[-2:]
        mode = parts[0] if len(parts) > 2 else ""
        if new in FLOATS and old in FLOATS:
            (kind, _), number = FLOATS[new], self.read_float(x[1], old)
            if new == old:
                name = {"rni": "roundeven", "rmi": "floor", "rpi": "ceil", "rzi": "trunc"}[mode]
                number = self.call(name, kind, [number], new)
            else:
                assert mode == ("rn" if new == "f32" else ""), parts
                word = "fptrunc" if new == "f32" else "fpext"
                number = self.new(f"{word} {FLOATS[old][0]} {number} to {kind}")
            return self.write_float(x[0], number, new)
        if new in FLOATS:
            assert mode == "rn", parts
            kind = integer_type(old)
            word = "sitofp" if old[0] == "s" else "uitofp"
            value = self.read(x[1], kind)
            return self.write_float(
                x[0], self.new(f"{word} {kind} {value} to {FLOATS[new][0]}"), new
            )
        if old in FLOATS:
            return self._to_integer(new, old, mode, x)
        kind, wide = integer_type(old), integer_type(new)
        word = "sext" if old[0] == "s" else "zext"
        value = self.resized(self.read(x[1], kind), kind, wide, word)
        return self.write(x[0], value, wide, "sext" if new[0] == "s" else "zext")

    def _to_integer(self, new: str, old: str, mode: str, x: list[str]) -> None:
        """The nearest integer that the type has; of NaN the highest bit, or 0."""
        assert mode == "rzi", (new, old, mode)
        kind, (real, _) = integer_type(new), FLOATS[old]
        number = self.read_float(x[1], old)
        name = f"fpto{'s' if new[0] == 's' else 'u'}i.sat.{kind}"
        self.module.declarations.add(f"declare {kind} @llvm.{name}.{old}({real})")
        value = self.new(f"call {kind} @llvm.{name}.{old}({real} {number})")
        is_long = old == "f64" or kind == "i64"
        of_nan = str(-(1 << (bits_of(kind) - 1))) if is_long else "0"
        is_nan = self.new(f"fcmp uno {real} {number}, {number}")
        self.write(x[0], self.new(f"select i1 {is_nan}, {kind} {of_nan}, {kind} {value}"), kind)

    def do_cvta(self, parts: list[str], x: list[str]) -> None:
        self.write(x[0], self.read(x[1], "i64"), "i64")

    def do_mov(self, parts: list[str], x: list[str]) -> None:
        kind = integer_type(parts[-1])
        if x[0].startswith("{"):
            pieces, value = x[0].strip("{} ").split(","), self.read(x[1], kind)
            size = bits_of(kind) // len(pieces)
            for i, piece in enumerate(pieces):
                part = self.new(f"lshr {kind} {value}, {size * i}")
                self.write(piece.strip(), self.resized(part, kind, f"i{size}"), f"i{size}")
            return
        if not x[1].startswith("{"):
            return self.write(x[0], self.read(x[1], kind), kind)
        pieces, total = x[1].strip("{} ").split(","), "0"
        size = bits_of(kind) // len(pieces)
        for i, piece in enumerate(pieces):
            part = self.resized(self.read(piece.strip(), f"i{size}"), f"i{size}", kind)
            total = self.new(f"or {kind} {total}, {self.new(f'shl {kind} {part}, {size * i}')}")
        return self.write(x[0], total, kind)

    def do_ld(self, parts: list[str], x: list[str]) -> None:
        kind = integer_type(parts[-1])
        if "param" in parts:
            return self.write(x[0], f"%{self.address(x[1])[0]}", "i64")
        registers = [r.strip() for r in x[0].strip("{} ").split(",")]
        pointers = self.pointers(x[1], bits_of(kind) // 8, len(registers))
        # All are read before one is written: an address may be in a register among them.
        values = [self.new(f"load {kind}, ptr {p}, align 1") for p in pointers]
        word = "sext" if parts[-1][0] == "s" else "zext"
        for register, value in zip(registers, values, strict=True):
            self.write(register, value, kind, word)

    def do_st(self, parts: list[str], x: list[str]) -> None:
        kind = integer_type(parts[-1])
        if "param" in parts:
            self.arguments[self.address(x[0])[0]] = self.read(x[1], "i64")
            return
        registers = [r.strip() for r in x[1].strip("{} ").split(",")]
        pointers = self.pointers(x[0], bits_of(kind) // 8, len(registers))
        for register, pointer in zip(registers, pointers, strict=True):
            self.emit(f"store {kind} {self.read(register, kind)}, ptr {pointer}, align 1")

    def do_call(self, parts: list[str], x: list[str]) -> None:
        name, names = x[0], [n.strip() for n in x[1].strip("() ").split(",")]
        passed = ", ".join([*(f"i64 {self.arguments[n]}" for n in names), GRID])
        self.emit(f"call void @{name}({passed})")


class Translation:
    """A PTX module as LLVM IR: `@launch(parameters, blocks, threads)` runs its kernel."""

    def __init__(self, text: str):
        self.declarations: set[str] = set()
        self.counts: Counter = Counter()
        self.data: dict[str, tuple[int, str]] = {}  # alignment, and text
        text = re.sub(r"//.*", "", text)
        array = (
            r"^\.(?:visible )?global \.align (\d+) \.[bfu](\d+) (\w+)\[(\d+)\](?: = \{(.*?)\})?;"
        )
        for align, bits, name, size, numbers in re.findall(array, text, re.M | re.S):
            values = [int(re.sub("^0[df]", "0x", n.strip()), 0) for n in numbers.split(",") if n]
            values += [0] * (int(size) - len(values))  # zeros at the end are left out
            listed = ", ".join(f"i{bits} {n}" for n in values)
            kinds, values = f"[{align} x i8]", f"[{size} x i{bits}]"
            self.data[name] = (
                int(align),
                (
                    f"@{name} = constant <{{{kinds}, {values}}}> "
                    f"<{{{kinds} zeroinitializer, {values} [{listed}]}}>, align {2 * int(align)}"
                ),
            )
        pattern = r"^(?:\.visible )?\.(?:func|entry) +(\w+)\((.*?)\)[^{;]*\{(.*?)^\}"
        self.functions = {}
        for name, params, body in re.findall(pattern, text, re.M | re.S):
            names = [p.split()[-1] for p in params.split(",") if p.strip()]
            self.functions[name] = Function(self, name, names, body)
        self.kernel = list(self.functions)[-1]
        bodies = [function.text for function in self.functions.values()]
        arrays = [declared for _, declared in self.data.values()]
        parts = [
            "@misaligned = global i64 0",
            *arrays,
            *sorted(self.declarations),
            *bodies,
            self._launch(),
        ]
        self.text = "\n".join(parts)

    def _launch(self) -> str:
        params = self.functions[self.kernel].params
        loads = []
        for i in range(len(params)):
            loads.append(f"  %at{i} = getelementptr i64, ptr %params, i64 {i}")
            loads.append(f"  %p{i} = load i64, ptr %at{i}")
        passed = ", ".join([*(f"i64 %p{i}" for i in range(len(params))), GRID])
        lines = "\n".join(loads)
        return f"""
define void @launch(ptr %params, i32 %blocks, i32 %ntid) {{
entry:
{lines}
  %count = mul i32 %blocks, %ntid
  br label %head
head:
  %i = phi i32 [0, %entry], [%next, %body]
  %more = icmp ult i32 %i, %count
  br i1 %more, label %body, label %over
body:
  %ctaid = udiv i32 %i, %ntid
  %tid = urem i32 %i, %ntid
  call void @{self.kernel}({passed})
  %next = add i32 %i, 1
  br label %head
over:
  ret void
}}
"""


_launches: dict[str, Any] = {}


def launch_of(text: str) -> Any:
    """(launch as a function, counts of instructions) of a PTX module, compiled once."""
    if text not in _launches:
        llvm = machine.start_llvm()
        cpu, features = machine.host()
        host = llvm.Target.from_default_triple().create_target_machine(
            cpu=cpu, features=features, opt=0, jit=True
        )
        translation = Translation(text)
        module = llvm.parse_assembly(translation.text)
        module.verify()
        engine = llvm.create_mcjit_compiler(module, host)
        engine.finalize_object()
        kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32)
        run = kind(engine.get_function_address("launch"))
        misaligned = ctypes.c_int64.from_address(engine.get_global_value_address("misaligned"))

        def launch(*arguments: Any) -> None:
            misaligned.value = 0
            run(*arguments)
            assert misaligned.value == 0, "an address is not a multiple of the bytes of its access"

        _launches[text] = engine, launch, translation.counts
    return _launches[text][1:]


def run(kernel: PtxKernel, operands: Sequence[Any], shapes: Sequence[Any], lanes: int, threads=64):
    """The results of a kernel for a batch, on this machine's CPU."""
    launch, _ = launch_of(kernel.text)
    arrays = [np.ascontiguousarray(x) for x in operands]
    # Filled with a number, so that one that is not written shows; longer than the batch, so that a
    # thread shows that writes beyond it.
    full = [np.full((lanes + threads, *x.shape[1:]), 77).astype(x.dtype) for x in shapes]
    addresses = [x.ctypes.data for x in (*arrays, *full)]
    parameters = np.asarray([*addresses, lanes, *kernel.values], np.int64)
    launch(parameters.ctypes.data, -(-lanes // threads), threads)
    for x in full:
        np.testing.assert_array_equal(x[lanes:], np.asarray(77).astype(x.dtype))
    return [x[:lanes] for x in full]
