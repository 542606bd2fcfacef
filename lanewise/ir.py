"""A builder of LLVM IR: numbers of one block of trajectories, loops and branches over them.

A number is either the same on all trajectories (a scalar in the IR) or has a value for each (`U`
vectors of `W` elements). What is computed does not depend on `W` and `U`: the builder decides by
itself, on numbers, which products and sums become fused multiply-adds, and LLVM is given no
licence to change an operation.
"""

import itertools
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

TYPES = {
    "float64": "double",
    "float32": "float",
    "bool": "i1",
    **{f"{sign}int{bits}": f"i{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
}
"""NumPy's name of a type → LLVM's."""


class Unsupported(Exception):
    """Something for which no code is generated; the message says what."""


class Num:
    """One number: a constant, a scalar, or one value for each trajectory of a block.

    `op` and `args` say how it was made, where that matters for later numbers. `structural` marks a
    0 or 1 that the structure of the problem makes, whatever the values are: 0·x is 0 for such a 0.
    """

    __slots__ = ("args", "dtype", "known", "names", "op", "serial", "structural", "vec", "write")

    def __init__(self, names, dtype, vec, known=None, op="", args=(), serial=0, structural=False):
        self.names, self.dtype, self.vec = names, dtype, vec
        self.known, self.op, self.args = known, op, args
        self.serial, self.structural = serial, structural
        self.write: Callable[..., str] | None = None

    @property
    def key(self) -> Any:
        if self.known is None:
            return self.serial
        return self.dtype, np.asarray(self.known, self.dtype).tobytes(), self.structural

    @property
    def is_float(self) -> bool:
        return self.dtype in ("float64", "float32")

    def is_known_as(self, value: float) -> bool:
        return self.known is not None and bool(self.known == value)


def literal(value: Any, dtype: str) -> str:
    """A constant as LLVM writes it."""
    if dtype in ("float64", "float32"):
        (bits,) = struct.unpack(">Q", struct.pack(">d", float(value)))
        return f"0x{bits:016X}"
    if dtype == "bool":
        return "true" if value else "false"
    return str(int(value))


class Builder:
    """The body of one function, written line by line."""

    def __init__(self, width: int, vectors: int):
        self.W, self.U = width, vectors
        self.lines: list[str] = []
        self.block = "entry"
        self.operations = 0
        self.scopes: list[dict] = [{}]
        self.declared: set[str] = set()
        self._names, self._serials = itertools.count(), itertools.count(1)
        self.largest_carry = 0

    # --- text --------------------------------------------------------------------------------

    def emit(self, line: str) -> None:
        self.lines.append("  " + line)

    def name(self) -> str:
        return f"%v{next(self._names)}"

    def new(self, instruction: str) -> str:
        name = f"%v{next(self._names)}"
        self.lines.append(f"  {name} = {instruction}")
        return name

    def label(self) -> str:
        return f"L{next(self._names)}"

    def begin(self, label: str) -> None:
        self.lines.append(f"{label}:")
        self.block = label

    def declare(self, line: str) -> None:
        self.declared.add("declare " + line)

    def type(self, dtype: str, vec: bool) -> str:
        return f"<{self.W} x {TYPES[dtype]}>" if vec and self.W > 1 else TYPES[dtype]

    def suffix(self, dtype: str, vec: bool) -> str:
        scalar = {"float64": "f64", "float32": "f32"}.get(dtype) or TYPES[dtype]
        return f"v{self.W}{scalar}" if vec and self.W > 1 else scalar

    # --- scopes: numbers made in a loop or a branch are not known outside of it ------------------

    def find(self, key: Any) -> Any:
        for scope in reversed(self.scopes):
            if key in scope:
                return scope[key]
        return None

    def note(self, key: Any, value: Any) -> None:
        self.scopes[-1][key] = value

    # --- numbers -----------------------------------------------------------------------------

    def known(self, value: Any, dtype: str, structural: bool = False) -> Num:
        if dtype not in TYPES:
            raise Unsupported(f"numbers of type {dtype}")
        value = np.asarray(value, dtype)[()]
        return Num((), dtype, False, known=value, structural=structural)

    def made(self, names: Sequence[str], dtype: str, vec: bool, op: str = "", args=()) -> Num:
        return Num(tuple(names), dtype, vec, op=op, args=args, serial=next(self._serials))

    def opaque(self, x: Num) -> Num:
        """The number itself, without what is known of how it was made."""
        if x.known is not None or not x.op:
            return x
        key = ("opaque", x.serial)
        found = self.find(key)
        if found is None:
            found = self.made(x.names, x.dtype, x.vec, "same", (x,))
            self.note(key, found)
        return found

    def unrelated(self, x: Num) -> Num:
        """The number treated as a result of a loop: not even a constant is known any more."""
        if x.known is None or not x.is_float:
            return self.opaque(x)
        return self.made([literal(x.known, x.dtype)], x.dtype, False)

    def mark(self) -> tuple:
        """The state of the text, for `back_to`."""
        return len(self.lines), self.block, self.operations, len(self.scopes), dict(self.scopes[-1])

    def back_to(self, mark: tuple) -> None:
        """Forget what was written since the mark, which was made in the same function."""
        count, self.block, self.operations, depth, scope = mark
        del self.lines[count:], self.scopes[depth:]
        self.scopes[-1] = scope

    def ref(self, x: Num, u: int, vec: bool) -> str:
        """The name of a number in vector u, as a vector where `vec`."""
        if x.known is not None:
            one = literal(x.known, x.dtype)
            if not vec or self.W == 1:
                return one
            return "<" + ", ".join([f"{TYPES[x.dtype]} {one}"] * self.W) + ">"
        if x.vec:
            return x.names[u]
        return self.splat(x) if vec and self.W > 1 else x.names[0]

    def splat(self, x: Num) -> str:
        key = ("splat", x.serial)
        found = self.find(key)
        if found is None:
            t = self.type(x.dtype, True)
            first = self.new(f"insertelement {t} poison, {TYPES[x.dtype]} {x.names[0]}, i64 0")
            zeros = f"<{self.W} x i32> zeroinitializer"
            found = self.new(f"shufflevector {t} {first}, {t} poison, {zeros}")
            self.note(key, found)
        return found

    def op(
        self, op: str, args: Sequence[Num], dtype: str, write: Callable[..., str], keep: bool = True
    ) -> Num:
        """The number made by the instruction ``write(type of the operands, *names)``."""
        key = (op, dtype, *(a.key for a in args))
        found = self.find(key)
        if found is not None:
            return found
        vec = any(a.vec for a in args)
        t = self.type(args[0].dtype, vec)
        self.operations += 1
        names = [
            self.new(write(t, *(self.ref(a, u, vec) for a in args)))
            for u in range(self.U if vec else 1)
        ]
        made = self.made(names, dtype, vec, op, tuple(args))
        made.write = write
        if keep:
            self.note(key, made)
        return made

    def intrinsic(self, name: str, args: Sequence[Num]) -> Num:
        """``llvm.<name>`` of numbers of one type."""
        dtype, vec = args[0].dtype, any(a.vec for a in args)
        suffix, t = self.suffix(dtype, vec), self.type(dtype, vec)
        full = f"llvm.{name}.{suffix}"
        self.declare(f"{t} @{full}({', '.join([t] * len(args))})")
        return self.op(
            name, args, dtype,
            lambda t, *x: f"call {t} @{full}({', '.join(f'{t} {y}' for y in x)})",
        )  # fmt: skip

    # --- arithmetic ----------------------------------------------------------------------------

    def add(self, a: Num, b: Num) -> Num:
        if a.known is not None and b.known is not None:
            return self._fold(np.add, a, b)
        if not a.is_float:
            if a.is_known_as(0):
                return b
            if b.is_known_as(0):
                return a
            return self._commute("add", a, b, lambda t, x, y: f"add {t} {x}, {y}")
        if a.is_known_as(0):
            return b
        if b.is_known_as(0):
            return a
        for product, other in ((a, b), (b, a)):
            factors = _factors(self, product)
            if factors is not None:
                return self.fma(*factors, other)
        return self._commute("add", a, b, lambda t, x, y: f"fadd {t} {x}, {y}")

    def sub(self, a: Num, b: Num) -> Num:
        if a.known is not None and b.known is not None:
            return self._fold(np.subtract, a, b)
        if b.is_known_as(0):
            return a
        if not a.is_float:
            return self.op("sub", (a, b), a.dtype, lambda t, x, y: f"sub {t} {x}, {y}")
        if a.is_known_as(0):
            return self.neg(b)
        factors = _factors(self, a)
        if factors is not None:
            return self.fma(*factors, self.neg(b))
        factors = _factors(self, b)
        if factors is not None:
            return self.fma(self.neg(factors[0]), factors[1], a)
        return self.op("sub", (a, b), a.dtype, lambda t, x, y: f"fsub {t} {x}, {y}")

    def mul(self, a: Num, b: Num) -> Num:
        if a.known is not None and b.known is not None:
            return self._fold(np.multiply, a, b)
        for x, y in ((a, b), (b, a)):
            joined = self._joined_factors(x, y)
            if joined is not None:
                return self.mul(*joined)
        for x, y in ((a, b), (b, a)):
            if x.structural and x.is_known_as(0):
                return x
            if x.is_known_as(1):
                return y
            if x.is_known_as(-1) and x.is_float:
                return self.neg(y)
        if not a.is_float:
            return self._commute("imul", a, b, lambda t, x, y: f"mul {t} {x}, {y}")
        # (−x)·y = −(x·y) to the bit: the sign goes outward, where a sum takes it for nothing.
        if a.op == "neg" and b.op == "neg":
            return self.mul(a.args[0], b.args[0])
        for x, y in ((a, b), (b, a)):
            if x.op == "neg":
                return self.neg(self.mul(x.args[0], y))
        return self._commute("mul", a, b, lambda t, x, y: f"fmul {t} {x}, {y}")

    def _joined_factors(self, c: Num, x: Num) -> tuple[Num, Num] | None:
        """(c·d, y) for c and x = d·y with c and d known, where c·(d·y) = (c·d)·y to the bit and no
        number leaves the range earlier: one of them is a power of two. x + x counts as 2·x."""
        if c.known is None or not c.is_float or c.structural:
            return None
        if x.op == "add" and x.args[0].key == x.args[1].key:
            d, y = self.known(2, x.dtype), x.args[0]
        elif x.op == "mul" and (x.args[0].known is not None or x.args[1].known is not None):
            d, y = x.args if x.args[0].known is not None else x.args[::-1]
        else:
            return None
        two = _is_power_of_two(c.known) or _is_power_of_two(d.known)
        with np.errstate(all="ignore"):
            both = np.asarray(c.known * d.known, x.dtype)
        normal = np.finfo(x.dtype).tiny <= abs(both) < np.inf
        # A subnormal d·y would have lost digits, which (c·d)·y has.
        return (self.known(both, x.dtype), y) if two and normal else None

    def fma(self, a: Num, b: Num, c: Num) -> Num:
        if a.op == "neg" and b.op == "neg":
            a, b = a.args[0], b.args[0]
        elif b.op == "neg":
            a, b = self.neg(a), b.args[0]
        return self.intrinsic("fma", (a, b, c))

    def div(self, a: Num, b: Num) -> Num:
        if a.known is not None and b.known is not None and a.is_float:
            return self._fold(np.divide, a, b)
        if not a.is_float:
            return self._integer_division("div", a, b)
        if b.is_known_as(1):
            return a
        if b.is_known_as(-1):
            return self.neg(a)
        if a.structural and a.is_known_as(0):
            return a
        if a.op == "neg":
            return self.neg(self.div(a.args[0], b))
        if b.known is not None and _has_exact_reciprocal(b.known):
            return self.mul(a, self.known(1 / b.known, b.dtype))
        # c/x = c·(1/x) to the bit where 1/x cannot leave the range: −1, or x a square root.
        by_reciprocal = b.op == "sqrt" and a.known is not None and _is_power_of_two(a.known)
        if a.is_known_as(-1) or (by_reciprocal and not a.is_known_as(1)):
            return self.mul(a, self.div(self.known(1, a.dtype), b))
        return self.op("div", (a, b), a.dtype, lambda t, x, y: f"fdiv {t} {x}, {y}")

    def neg(self, a: Num) -> Num:
        if a.known is not None:
            with np.errstate(all="ignore"):
                return self.known(-a.known, a.dtype, a.structural and a.known == 0)
        if a.op == "neg":
            return a.args[0]
        if not a.is_float:
            return self.sub(self.known(0, a.dtype), a)
        if a.op == "sub":  # −(x − y) = y − x but for the sign of 0
            pass
        return self.op("neg", (a,), a.dtype, lambda t, x: f"fneg {t} {x}")

    def _commute(self, op: str, a: Num, b: Num, write: Callable[..., str]) -> Num:
        found = self.find((op, a.dtype, b.key, a.key))
        return self.op(op, (a, b), a.dtype, write) if found is None else found

    def _fold(self, function: Callable, *args: Num) -> Num:
        with np.errstate(all="ignore"):
            value = function(*(a.known for a in args))
        structural = all(a.structural for a in args) and value in (0, 1)
        return self.known(value, args[0].dtype, structural)

    def _integer_division(self, op: str, a: Num, b: Num) -> Num:
        """Quotient or remainder; by zero −1 or the dividend, as XLA has it."""
        if a.dtype == "bool":
            raise Unsupported(f"{op} of truth values")
        signed = not a.dtype.startswith("u")
        zero, one = self.known(0, a.dtype), self.known(1, a.dtype)
        by_zero = self.compare("eq", b, zero)
        least = self.known(np.iinfo(a.dtype).min, a.dtype)
        over = self.logic(
            "and", self.compare("eq", a, least), self.compare("eq", b, self.known(-1, a.dtype))
        ) if signed else self.known(False, "bool")  # fmt: skip
        safe = self.select(self.logic("or", by_zero, over), one, b)
        word = ("s" if signed else "u") + ("div" if op == "div" else "rem")
        value = self.op(word, (a, safe), a.dtype, lambda t, x, y: f"{word} {t} {x}, {y}")
        if op == "div":
            at_zero = self.known(-1 if signed else np.iinfo(a.dtype).max, a.dtype)
            value = self.select(over, least, value)
        else:
            at_zero, value = a, self.select(over, zero, value)
        return self.select(by_zero, at_zero, value)

    def rem(self, a: Num, b: Num) -> Num:
        if not a.is_float:
            return self._integer_division("rem", a, b)
        return self.op("frem", (a, b), a.dtype, lambda t, x, y: f"frem {t} {x}, {y}")

    def power(self, x: Num, n: int) -> Num:
        """xⁿ by squaring; of a negative n by that of 1/x."""
        if n < 0:
            return self.power(self.div(self.known(1, x.dtype), x), -n)
        result, square = None, x
        while n:
            if n & 1:
                result = square if result is None else self.mul(result, square)
            n >>= 1
            if n:
                square = self.mul(square, square)
        return self.known(1, x.dtype) if result is None else result

    def sqrt(self, a: Num) -> Num:
        if a.known is not None:
            return self._fold(np.sqrt, a)
        return self.intrinsic("sqrt", (a,))

    def abs(self, a: Num) -> Num:
        if a.known is not None:
            return self._fold(np.abs, a)
        if a.is_float:
            return self.intrinsic("fabs", (a,))
        if a.dtype.startswith("u"):
            return a
        return self.select(self.compare("lt", a, self.known(0, a.dtype)), self.neg(a), a)

    # --- comparisons and choices -----------------------------------------------------------------

    def compare(self, op: str, a: Num, b: Num) -> Num:
        if a.known is not None and b.known is not None:
            return self.known(_COMPARISONS[op](a.known, b.known), "bool")
        if a.op == "select" and b.known is not None and not a.is_float:
            which, yes, no = a.args  # a status that was chosen: compare what it was chosen from
            if yes.known is not None or no.known is not None:
                return self.select(which, self.compare(op, yes, b), self.compare(op, no, b))
        if a.is_float:
            word = "fcmp " + {"eq": "oeq", "ne": "une"}.get(op, "o" + op)
        elif op in ("eq", "ne"):
            word = f"icmp {op}"
        else:
            unsigned = a.dtype.startswith("u") or a.dtype == "bool"
            word = f"icmp {'u' if unsigned else 's'}{op}"
        return self.op(op, (a, b), "bool", lambda t, x, y: f"{word} {t} {x}, {y}")

    def less(self, a: Num, b: Num) -> str:
        """Whether a < b, as a scalar i1, for two scalars."""
        return self.ref(self.compare("lt", a, b), 0, False)

    def logic(self, op: str, a: Num, b: Num) -> Num:
        """and, or, xor of truth values or of bits."""
        if a.known is not None and b.known is not None:
            of = {"and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor}
            return self._fold(of[op], a, b)
        if op == "and" and a.op == b.op == "finite" and a.args[0].dtype == b.args[0].dtype:
            first = self.finite_terms(a)
            return self.all_finite([*first, *self.finite_terms(b)], len(first))
        if a.dtype == "bool" and op != "xor":
            for x, y in ((a, b), (b, a)):
                if x.known is not None:
                    return y if bool(x.known) == (op == "and") else x
            if a.serial == b.serial:
                return a
        return self._commute(op, a, b, lambda t, x, y: f"{op} {t} {x}, {y}")

    def invert(self, a: Num) -> Num:
        if a.known is not None:
            return self._fold(np.invert, a)
        if a.op == "not":
            return a.args[0]
        all_bits = -1
        if a.dtype == "bool":
            all_bits = True
        elif a.dtype.startswith("u"):
            all_bits = np.iinfo(a.dtype).max
        ones = self.known(all_bits, a.dtype)
        made = self.op("not", (a, ones), a.dtype, lambda t, x, y: f"xor {t} {x}, {y}")
        return made

    def select(self, which: Num, yes: Num, no: Num) -> Num:
        if which.known is not None:
            return yes if which.known else no
        if yes is no or yes.key == no.key:
            return no
        if which.op == "not":
            return self.select(which.args[0], no, yes)
        if yes.dtype == "bool":
            if yes.known is not None:
                return self.logic("or", which, no) if yes.known else self.logic(
                    "and", self.invert(which), no
                )  # fmt: skip
            if no.known is not None:
                return self.logic("or", self.invert(which), yes) if no.known else self.logic(
                    "and", which, yes
                )  # fmt: skip
        vec = which.vec or yes.vec or no.vec
        if vec and not which.vec:  # one bit for all trajectories
            t, one = self.type(yes.dtype, True), TYPES["bool"]
            key = ("select1", which.key, yes.key, no.key)
            found = self.find(key)
            if found is None:
                names = [
                    self.new(
                        f"select {one} {which.names[0]}, {t} {self.ref(yes, u, True)}, "
                        f"{t} {self.ref(no, u, True)}"
                    )
                    for u in range(self.U)
                ]
                found = self.made(names, yes.dtype, True, "select", (which, yes, no))
                self.note(key, found)
            return found
        bits, t = self.type("bool", vec), self.type(yes.dtype, vec)
        return self.op(
            "select", (which, yes, no), yes.dtype,
            lambda _, w, x, y: f"select {bits} {w}, {t} {x}, {t} {y}",
        )  # fmt: skip

    def maximum(self, a: Num, b: Num, op: str = "gt") -> Num:
        """The larger (smaller) of two; NaN where one is NaN."""
        if a.known is not None and b.known is not None:
            return self._fold(np.maximum if op == "gt" else np.minimum, a, b)
        if not a.is_float:
            return self.select(self.compare(op, a, b), a, b)
        if b.known is not None:
            a, b = b, a
        # b where the comparison fails, so also where b is NaN.
        larger = self.select(self.compare(op, a, b), a, b)
        if a.known is not None and a.known == a.known:
            return larger
        return self.select(self.is_nan(a), a, larger)

    def _sum(self, dtype: str) -> Callable[..., str]:
        for vec in (False, True):
            t = self.type(dtype, vec)
            self.declare(f"{t} @llvm.fma.{self.suffix(dtype, vec)}({t}, {t}, {t})")

        def write(t: str, x: str, y: str, z: str) -> str:
            suffix = self.suffix(dtype, t.startswith("<"))
            return f"call {t} @llvm.fma.{suffix}({t} {x}, {t} {y}, {t} {z})"

        return write

    def is_nan(self, a: Num) -> Num:
        return self.op("isnan", (a,), "bool", lambda t, x: f"fcmp uno {t} {x}, {x}")

    def is_finite(self, a: Num) -> Num:
        if not a.is_float:
            return self.known(True, "bool")
        if a.known is not None:
            return self.known(np.isfinite(a.known), "bool")
        return self.all_finite([a])

    def all_finite(self, terms: Sequence[Num], known: int = 1) -> Num:
        """Whether all numbers, of one type, are finite: whether Σ 0·x is not NaN.

        A number is left out if another one cannot be finite without it. The first `known` numbers
        are not compared with each other.
        """
        terms = list({x.serial: x for x in terms}.values())
        needed = terms if len(terms) > _FEW else terms[:known]
        for x in terms[len(needed) :]:
            if not self.shown(frozenset([x.serial]), needed):
                others = self.shown(frozenset(y.serial for y in needed), [x])
                needed = [*(y for y in needed if y.serial not in others), x]
        zero = self.known(0, terms[0].dtype)
        total = self.op("0·x", (zero, needed[0]), zero.dtype, _product)
        for x in needed[1:]:
            total = self.op("Σ 0·x", (zero, x, total), zero.dtype, self._sum(zero.dtype))
        flag = self.op("finite", (total,), "bool", lambda t, x: f"fcmp ord {t} {x}, {x}")
        return flag

    def finite_terms(self, flag: Num) -> tuple[Num, ...]:
        """The numbers that a result of `is_finite` or `all_finite` is about."""
        terms, (total,) = [], flag.args
        while total.op == "Σ 0·x":
            terms.append(total.args[1])
            total = total.args[2]
        return (total.args[1], *reversed(terms))

    def shown(self, targets: frozenset[int], by: Sequence[Num]) -> frozenset[int]:
        """Which of `targets`, serials of numbers, are finite for certain where all numbers `by`
        are: those numbers themselves, what they are a sum or a product of, and so on."""
        found: dict[int, frozenset[int]] = {}
        stack = [(x, False) for x in by]
        while stack:
            x, is_seen = stack.pop()
            if x.known is not None or x.serial in found:
                continue
            parts = x.args if x.op in _HANDED_ON else x.args[1:] if x.op == "select" else ()
            if parts and not is_seen and len(found) + len(stack) < _MOST_SEEN:
                stack.append((x, True))
                stack += [(a, False) for a in parts]
                continue
            mine = [found.get(a.serial, frozenset()) for a in parts] or [frozenset()]
            of_parts = mine[0].intersection if x.op == "select" else mine[0].union
            found[x.serial] = of_parts(*mine[1:]) | (frozenset([x.serial]) & targets)
        return frozenset().union(*(found.get(x.serial, frozenset()) for x in by))

    # --- types -----------------------------------------------------------------------------------

    def convert(self, a: Num, dtype: str) -> Num:
        if a.dtype == dtype:
            return a
        if dtype not in TYPES:
            raise Unsupported(f"numbers of type {dtype}")
        to_float = dtype in ("float64", "float32")
        if a.known is not None and (to_float or not a.is_float):
            structural = a.structural and to_float
            return self.known(np.asarray(a.known).astype(dtype), dtype, structural)
        if dtype == "bool":
            return self.compare("ne", a, self.known(0, a.dtype))
        unsigned = a.dtype.startswith("u") or a.dtype == "bool"
        bits, new_bits = (int(TYPES[d][1:]) if d not in _FLOATS else 0 for d in (a.dtype, dtype))
        if a.is_float and to_float:
            word = "fpext" if dtype == "float64" else "fptrunc"
        elif to_float:
            word = "uitofp" if unsigned else "sitofp"
        elif a.is_float:
            return self._to_integer(a, dtype)
        elif new_bits < bits:
            word = "trunc"
        elif new_bits > bits:
            word = "zext" if unsigned else "sext"
        else:
            word = "bitcast"
        vec = a.vec
        out = self.type(dtype, vec)
        return self.op(f"to {word}", (a,), dtype, lambda t, x: f"{word} {t} {x} to {out}")

    def _to_integer(self, a: Num, dtype: str) -> Num:
        """Rounded towards zero, and to the nearest integer there is; NaN to 0."""
        word = "fptoui" if dtype.startswith("u") else "fptosi"
        source, out = self.type(a.dtype, a.vec), self.type(dtype, a.vec)
        full = f"llvm.{word}.sat.{self.suffix(dtype, a.vec)}.{self.suffix(a.dtype, a.vec)}"
        self.declare(f"{out} @{full}({source})")
        return self.op(f"to {dtype}", (a,), dtype, lambda t, x: f"call {out} @{full}({t} {x})")

    def bitcast(self, a: Num, dtype: str) -> Num:
        if a.known is not None:
            return self.known(np.asarray(a.known, a.dtype).view(dtype)[()], dtype)
        if TYPES[a.dtype] == TYPES[dtype]:
            return self.op(f"as {dtype}", (a,), dtype, lambda t, x: f"bitcast {t} {x} to {t}")
        out = self.type(dtype, a.vec)
        return self.op(f"as {dtype}", (a,), dtype, lambda t, x: f"bitcast {t} {x} to {out}")

    def shift(self, op: str, a: Num, by: Num) -> Num:
        """Bits to the left or right; by all of them or more, none is left."""
        bits = int(TYPES[a.dtype][1:])
        word = {
            "shift_left": "shl", "shift_right_logical": "lshr", "shift_right_arithmetic": "ashr",
        }[op]  # fmt: skip
        if by.known is not None and 0 <= by.known < bits:
            return self.op(word, (a, by), a.dtype, lambda t, x, y: f"{word} {t} {x}, {y}")
        most = self.known(bits - 1, by.dtype)
        unsigned = by.dtype.startswith("u")
        inside = self.compare("le", by, most)
        if not unsigned:
            inside = self.logic("and", inside, self.compare("ge", by, self.known(0, by.dtype)))
        safe = self.select(inside, by, most)
        value = self.op(word, (a, safe), a.dtype, lambda t, x, y: f"{word} {t} {x}, {y}")
        if word == "ashr":
            return value
        return self.select(inside, value, self.known(0, a.dtype))

    # --- all trajectories of a block ------------------------------------------------------------

    def any(self, a: Num) -> str:
        """Whether a truth value is true on a trajectory of the block, as a scalar i1."""
        if not a.vec:
            return self.ref(a, 0, False)
        if a.op == "not" and a.args[0].op == "finite":  # one comparison for the block
            (zero,) = a.args[0].args
            t, total = self.type(zero.dtype, True), zero.names[0]
            for other in zero.names[1:]:
                total = self.new(f"fadd {t} {total}, {other}")
            bits = self.new(f"fcmp uno {t} {total}, {total}")
            a = self.made([bits], "bool", True)
        t = self.type("bool", True)
        total = a.names[0]
        for other in a.names[1:]:
            total = self.new(f"or {t} {total}, {other}")
        if self.W == 1:
            return total
        bits = self.new(f"bitcast {t} {total} to i{self.W}")
        return self.new(f"icmp ne i{self.W} {bits}, 0")

    # --- numbers that wait in memory, which the optimiser does not see through --------------------

    def set_aside(self, x: Num, to: Sequence[str], vec: bool) -> list[str]:
        """The lines that write a number of a carry to one pointer for each vector."""
        t = self.type(x.dtype, vec)
        return [
            f"  store volatile {t} {name}, ptr {at}" for name, at in zip(x.names, to, strict=True)
        ]

    def taken_back(self, x: Num, at: Sequence[str], vec: bool) -> Num:
        """The number that was set aside there."""
        t = self.type(x.dtype, vec)
        return self.made([self.new(f"load volatile {t}, ptr {p}") for p in at], x.dtype, vec)

    # --- loops -----------------------------------------------------------------------------------

    def loop(
        self,
        carry: Sequence[Num],
        vec: Sequence[bool],
        test: Callable[[list[Num], str], str],
        body: Callable[[list[Num], str], list[Num]],
        count: bool = False,
        carried_over: Callable[..., list[tuple[Num, Num]]] | None = None,
    ) -> list[Num]:
        """The carry once ``test(carry, i)``, the name of an i1, is false; `i` counts if `count`.

        `carried_over(carry before a round, carry after it)` finds pairs (x, y) where y is what x
        will be in the next round; x is then not computed but carried.
        """
        before = [
            [self.ref(c, u, v) for u in range(self.U if v else 1)]
            for c, v in zip(carry, vec, strict=True)
        ]
        self.largest_carry = max(self.largest_carry, sum(vec))
        entered_from, front = self.block, len(self.lines)
        head, inner, end = self.label(), self.label(), self.label()
        self.emit(f"br label %{head}")
        self.begin(head)
        phis, place = [], len(self.lines)
        for c, v in zip(carry, vec, strict=True):
            names = [self.name() for _ in range(self.U if v else 1)]
            phis.append(self.made(names, c.dtype, v))
        counter = self.name() if count else ""
        self.scopes.append({})
        going = test(phis, counter)
        self.emit(f"br i1 {going}, label %{inner}, label %{end}")
        self.begin(inner)
        after = body(phis, counter)
        assert not any(a.vec and not v for a, v in zip(after, vec, strict=True)), (
            "a carry that varies"
        )
        again = [
            [self.ref(a, u, v) for u in range(self.U if v else 1)]
            for a, v in zip(after, vec, strict=True)
        ]
        following = self.new(f"add nuw nsw i64 {counter}, 1") if count else ""
        self.scopes.pop()
        left_from = self.block
        self.emit(f"br label %{head}")
        lines = []
        for p, olds, news, v in zip(phis, before, again, vec, strict=True):
            t = self.type(p.dtype, v)
            lines += [
                f"  {name} = phi {t} [{old}, %{entered_from}], [{new}, %{left_from}]"
                for name, old, new in zip(p.names, olds, news, strict=True)
            ]
        if count:
            lines.append(f"  {counter} = phi i64 [0, %{entered_from}], [{following}, %{left_from}]")
        first_lines = []
        if carried_over is not None:
            pairs = carried_over(phis, after)
            instead = {
                p.serial: self.made(old, p.dtype, v)
                for p, old, v in zip(phis, before, vec, strict=True)
            }
            count_before = len(self.lines)
            firsts = [self.made_again(x, instead) for x, _ in pairs]
            first_lines = self.lines[count_before:]
            del self.lines[count_before:]
            for (x, y), first in zip(pairs, firsts, strict=True):
                t = self.type(x.dtype, True)
                for u, name in enumerate(x.names):
                    at = next(i for i in range(place, len(self.lines))
                              if self.lines[i].startswith(f"  {name} = "))  # fmt: skip
                    del self.lines[at]
                    old, new = self.ref(first, u, True), y.names[u]
                    lines.append(
                        f"  {name} = phi {t} [{old}, %{entered_from}], [{new}, %{left_from}]"
                    )
        self.lines[place:place] = lines
        self.lines[front:front] = first_lines
        self.begin(end)
        return phis

    def made_again(self, x: Num, instead: dict[int, Num]) -> Num:
        """The number x with other numbers in place of some that it is made of."""
        if x.known is not None or (not x.op and x.serial not in instead):
            return x
        found = instead.get(x.serial)
        if found is None:
            args = [self.made_again(a, instead) for a in x.args]
            if x.op == "same":
                found = args[0]
            else:
                assert x.write is not None
                found = self.op(x.op, args, x.dtype, x.write)
            instead[x.serial] = found
        return found

    def branch(
        self, condition: str, yes: Callable[[], list[Num]], no: Callable[[], list[Num]],
        vec: Sequence[bool], dtypes: Sequence[str],
    ) -> list[Num]:  # fmt: skip
        """The numbers of one branch or of the other; only that one is run."""
        labels = self.label(), self.label()
        end = self.label()
        self.emit(f"br i1 {condition}, label %{labels[0]}, label %{labels[1]}")
        ends, names = [], []
        for label, run in zip(labels, (yes, no), strict=True):
            self.begin(label)
            self.scopes.append({})
            numbers = run()
            names.append(
                [
                    [self.ref(x, u, v) for u in range(self.U if v else 1)]
                    for x, v in zip(numbers, vec, strict=True)
                ]
            )
            self.scopes.pop()
            ends.append(self.block)
            self.emit(f"br label %{end}")
        self.begin(end)
        results = []
        for v, dtype, ones, others in zip(vec, dtypes, *names, strict=True):
            t = self.type(dtype, v)
            results.append(
                self.made(
                    [
                        self.new(f"phi {t} [{a}, %{ends[0]}], [{b}, %{ends[1]}]")
                        for a, b in zip(ones, others, strict=True)
                    ],
                    dtype, v,
                )
            )  # fmt: skip
        return results


def _product(t: str, x: str, y: str) -> str:
    return f"fmul {t} {x}, {y}"


_FLOATS = ("float64", "float32")

_HANDED_ON = frozenset(["add", "sub", "mul", "fma", "neg", "sqrt", "same"])
"""Operations whose result is not finite where an operand is not."""

_MOST_SEEN = 300
"""How many operations are followed back."""

_FEW = 12
"""With more numbers than this each of them is checked."""

_COMPARISONS: dict[str, Callable] = {
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal,
    "gt": np.greater, "ge": np.greater_equal,
}  # fmt: skip


def _factors(builder: Builder, x: Num) -> tuple[Num, Num] | None:
    """The factors of a number that is a product, or the negative of one."""
    if x.op == "mul":
        return x.args
    if x.op == "neg" and x.args[0].op == "mul":
        a, b = x.args[0].args
        return builder.neg(a), b
    return None


def _is_power_of_two(x: Any) -> bool:
    return abs(np.frexp(np.float64(x))[0]) == 0.5


def _has_exact_reciprocal(x: Any) -> bool:
    """Whether a product with 1/x is the quotient, subnormal results included."""
    return _is_power_of_two(x) and 2.0**-100 <= abs(float(x)) <= 2.0**100
