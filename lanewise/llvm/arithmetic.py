"""Operations on numbers: which are written, which are known already, and which are contracted."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .ir import FLOATS, TYPES, Num, Unsupported, Writer

# Operations whose result is not finite where an operand is not.
_HANDED_ON = frozenset(["add", "sub", "mul", "fma", "neg", "sqrt", "same"])
_MOST_SEEN = 300  # operations that are followed back: more would take longer than what they save
_FEW = 12  # with more numbers than this each of them is checked
_COMPARISONS: dict[str, Callable] = {
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
}
_LOGIC = {"and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor}
_SHIFTS = {"shift_left": "shl", "shift_right_logical": "lshr", "shift_right_arithmetic": "ashr"}


class Arithmetic(Writer):
    """The operations of the components of a function."""

    def add(self, a: Num, b: Num) -> Num:
        if a.known is not None and b.known is not None:
            return self._fold(np.add, a, b)
        if a.is_known_as(0):
            return b
        if b.is_known_as(0):
            return a
        if not a.is_float:
            return self._commute("add", a, b, "add")
        # The one rule of contraction: a product that is an operand of a sum, the first one first.
        for product, other in ((a, b), (b, a)):
            factors = self._factors(product)
            if factors is not None:
                return self.fma(*factors, other)
        return self._commute("add", a, b, "fadd")

    def sub(self, a: Num, b: Num) -> Num:
        if a.known is not None and b.known is not None:
            return self._fold(np.subtract, a, b)
        if b.is_known_as(0):
            return a
        if not a.is_float:
            return self.instruction("sub", (a, b))
        if a.is_known_as(0):
            return self.neg(b)
        factors = self._factors(a)
        if factors is not None:
            return self.fma(*factors, self.neg(b))
        factors = self._factors(b)
        if factors is not None:
            return self.fma(self.neg(factors[0]), factors[1], a)
        return self.instruction("fsub", (a, b), "sub")

    def mul(self, a: Num, b: Num) -> Num:
        if a.known is not None and b.known is not None:
            return self._fold(np.multiply, a, b)
        for x, y in ((a, b), (b, a)):
            joined = self._joined_factors(x, y)
            if joined is not None:
                return self.mul(*joined)
        for x, y in ((a, b), (b, a)):
            # Not for every zero: 0·∞ and 0·NaN are NaN, as in IEEE 754.
            if x.structural and x.is_known_as(0):
                return x
            if x.is_known_as(1):
                return y
            if x.is_known_as(-1) and x.is_float:
                return self.neg(y)
        if not a.is_float:
            return self._commute("imul", a, b, "mul")
        # (−x)·y = −(x·y) to the bit: the sign goes outward, where a sum takes it for nothing.
        if a.op == "neg" and b.op == "neg":
            return self.mul(a.args[0], b.args[0])
        for x, y in ((a, b), (b, a)):
            if x.op == "neg":
                return self.neg(self.mul(x.args[0], y))
        return self._commute("mul", a, b, "fmul")

    def _factors(self, x: Num) -> tuple[Num, Num] | None:
        """The factors of a number that is a product, or the negative of one."""
        product = x.args[0] if x.op == "neg" else x
        if product.op != "mul":
            return None
        a, b = product.args
        return (a, b) if product is x else (self.neg(a), b)

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
        two = is_power_of_two(c.known) or is_power_of_two(d.known)
        with np.errstate(all="ignore"):
            both = np.asarray(c.known * d.known, x.dtype)
        # A subnormal d·y would have lost digits, which (c·d)·y has.
        normal = np.finfo(x.dtype).tiny <= abs(both) < np.inf
        return (self.known(both, x.dtype), y) if two and normal else None

    def fma(self, a: Num, b: Num, c: Num) -> Num:
        # fma(−a, b, c) has one instruction, whatever operand the sign belongs to.
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
        # c/x = c·(1/x) to the bit where 1/x cannot leave the range: −1, or x a square root. So that
        # 1/x is computed once for several c.
        by_reciprocal = b.op == "sqrt" and a.known is not None and is_power_of_two(a.known)
        if a.is_known_as(-1) or (by_reciprocal and not a.is_known_as(1)):
            return self.mul(a, self.div(self.known(1, a.dtype), b))
        return self.instruction("fdiv", (a, b), "div")

    def neg(self, a: Num) -> Num:
        if a.known is not None:
            with np.errstate(all="ignore"):
                return self.known(-a.known, a.dtype, a.structural and a.known == 0)
        if a.op == "neg":
            return a.args[0]
        if not a.is_float:
            return self.sub(self.known(0, a.dtype), a)
        # −(x − y) stays: it is y − x but for the sign of a zero.
        return self.instruction("fneg", (a,), "neg")

    def _commute(self, op: str, a: Num, b: Num, word: str) -> Num:
        found = self.find((op, a.dtype, b.key, a.key))
        return self.instruction(word, (a, b), op) if found is None else found

    def _fold(self, function: Callable, *args: Num) -> Num:
        with np.errstate(all="ignore"):
            value = function(*(a.known for a in args))
        structural = all(a.structural for a in args) and value in (0, 1)
        return self.known(value, args[0].dtype, structural)

    def _integer_division(self, op: str, a: Num, b: Num) -> Num:
        """Quotient or remainder; by zero −1 or the dividend, as XLA has it."""
        if a.dtype == "bool":
            raise Unsupported(f"{op} is not compiled for truth values")
        signed = not a.dtype.startswith("u")
        zero, one = self.known(0, a.dtype), self.known(1, a.dtype)
        by_zero = self.compare("eq", b, zero)
        least = self.known(np.iinfo(a.dtype).min, a.dtype)
        over = self.known(False, "bool")
        if signed:
            is_least, minus_1 = self.compare("eq", a, least), self.known(-1, a.dtype)
            over = self.logic("and", is_least, self.compare("eq", b, minus_1))
        # The instruction ends the process for both, also on trajectories that do not need it.
        safe = self.select(self.logic("or", by_zero, over), one, b)
        word = ("s" if signed else "u") + ("div" if op == "div" else "rem")
        value = self.instruction(word, (a, safe))
        if op == "div":
            at_zero = self.known(-1 if signed else np.iinfo(a.dtype).max, a.dtype)
            value = self.select(over, least, value)
        else:
            at_zero, value = a, self.select(over, zero, value)
        return self.select(by_zero, at_zero, value)

    def rem(self, a: Num, b: Num) -> Num:
        if not a.is_float:
            return self._integer_division("rem", a, b)
        return self.instruction("frem", (a, b))

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
        return self.intrinsic("sqrt", (a,)) if a.known is None else self._fold(np.sqrt, a)

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
            return self._fold(_LOGIC[op], a, b)
        if op == "and" and a.op == b.op == "finite" and a.args[0].dtype == b.args[0].dtype:
            first = self.finite_terms(a)
            return self.all_finite([*first, *self.finite_terms(b)], len(first))
        if a.dtype == "bool" and op != "xor":
            for x, y in ((a, b), (b, a)):
                if x.known is not None:
                    return y if bool(x.known) == (op == "and") else x
            if a.serial == b.serial:
                return a
        return self._commute(op, a, b, op)

    def invert(self, a: Num) -> Num:
        if a.known is not None:
            return self._fold(np.invert, a)
        if a.op == "not":
            return a.args[0]
        unsigned = a.dtype.startswith("u")
        ones = True if a.dtype == "bool" else np.iinfo(a.dtype).max if unsigned else -1
        return self.instruction("xor", (a, self.known(ones, a.dtype)), "not")

    def select(self, which: Num, yes: Num, no: Num) -> Num:
        if which.known is not None:
            return yes if which.known else no
        if yes is no or yes.key == no.key:
            return no
        # The same choice as one that may have been made: it is found again by its key.
        if which.op == "not":
            return self.select(which.args[0], no, yes)
        if yes.dtype == "bool":
            if yes.known is not None:
                other = which if yes.known else self.invert(which)
                return self.logic("or" if yes.known else "and", other, no)
            if no.known is not None:
                other = self.invert(which) if no.known else which
                return self.logic("or" if no.known else "and", other, yes)
        vec = which.vec or yes.vec or no.vec
        t = self.type(yes.dtype, vec)
        if not vec or which.vec:
            bits = self.type("bool", vec)
            return self.op(
                "select",
                (which, yes, no),
                yes.dtype,
                lambda _, w, x, y: f"select {bits} {w}, {t} {x}, {t} {y}",
            )

        def make() -> Num:  # one bit for all trajectories, which need not become a vector
            pairs = zip(self.refs(yes, True), self.refs(no, True), strict=True)
            bit = which.names[0]
            names = [self.new(f"select i1 {bit}, {t} {x}, {t} {y}") for x, y in pairs]
            return self.made(names, yes.dtype, True, "select", (which, yes, no))

        return self.once(("select1", which.key, yes.key, no.key), make)

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

    # --- whether numbers are finite --------------------------------------------------------------

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
        total = self.instruction("fmul", (zero, needed[0]), "0·x")
        if len(needed) > 1:
            for vec in (False, True):
                t = self.type(zero.dtype, vec)
                self.declare(f"{t} @llvm.fma.{self.suffix(zero.dtype, vec)}({t}, {t}, {t})")

        def write(t: str, *names: str) -> str:
            suffix = self.suffix(zero.dtype, t.startswith("<"))
            return f"call {t} @llvm.fma.{suffix}({', '.join(f'{t} {x}' for x in names)})"

        for x in needed[1:]:
            total = self.op("Σ 0·x", (zero, x, total), zero.dtype, write)
        return self.op("finite", (total,), "bool", lambda t, x: f"fcmp ord {t} {x}, {x}")

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
        # A stack of our own: chains of operations are longer than the stack of Python allows.
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
            # A selection takes one operand, and it is not known which: only what both show counts.
            of_parts = mine[0].intersection if x.op == "select" else mine[0].union
            found[x.serial] = of_parts(*mine[1:]) | (frozenset([x.serial]) & targets)
        return frozenset().union(*(found.get(x.serial, frozenset()) for x in by))

    # --- types -----------------------------------------------------------------------------------

    def convert(self, a: Num, dtype: str) -> Num:
        if a.dtype == dtype:
            return a
        if dtype not in TYPES:
            raise Unsupported(f"numbers of type {dtype} are not compiled")
        to_float = dtype in FLOATS
        if a.known is not None and (to_float or not a.is_float):
            structural = a.structural and to_float
            return self.known(np.asarray(a.known).astype(dtype), dtype, structural)
        if dtype == "bool":
            return self.compare("ne", a, self.known(0, a.dtype))
        if a.is_float and not to_float:
            return self._to_integer(a, dtype)
        unsigned = a.dtype.startswith("u") or a.dtype == "bool"
        bits, new_bits = (int(TYPES[d][1:]) if d not in FLOATS else 0 for d in (a.dtype, dtype))
        if a.is_float:
            word = "fpext" if dtype == "float64" else "fptrunc"
        elif to_float:
            word = "uitofp" if unsigned else "sitofp"
        elif new_bits == bits:
            word = "bitcast"
        else:
            word = "trunc" if new_bits < bits else "zext" if unsigned else "sext"
        out = self.type(dtype, a.vec)
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
        out = self.type(dtype, a.vec)
        same = TYPES[a.dtype] == TYPES[dtype]
        return self.op(
            f"as {dtype}", (a,), dtype, lambda t, x: f"bitcast {t} {x} to {t if same else out}"
        )

    def shift(self, op: str, a: Num, by: Num) -> Num:
        """Bits to the left or right; all bits are shifted out by their number or more."""
        bits, word = int(TYPES[a.dtype][1:]), _SHIFTS[op]
        if by.known is not None and 0 <= by.known < bits:
            return self.instruction(word, (a, by))
        most = self.known(bits - 1, by.dtype)
        inside = self.compare("le", by, most)
        if not by.dtype.startswith("u"):
            inside = self.logic("and", inside, self.compare("ge", by, self.known(0, by.dtype)))
        # LLVM leaves the result of a larger shift undefined.
        value = self.instruction(word, (a, self.select(inside, by, most)))
        return value if word == "ashr" else self.select(inside, value, self.known(0, a.dtype))


def is_power_of_two(x: Any) -> bool:
    """Whether a product with x is exact, but for subnormal numbers."""
    return abs(np.frexp(np.float64(x))[0]) == 0.5


def _has_exact_reciprocal(x: Any) -> bool:
    """Whether a product with 1/x is the quotient, subnormal results included."""
    return is_power_of_two(x) and 2.0**-100 <= abs(float(x)) <= 2.0**100
