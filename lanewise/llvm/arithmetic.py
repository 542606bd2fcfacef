"""Operations on numbers: which are written, which are known already, and which are contracted."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from .finite import Finiteness
from .ir import FLOATS, TYPES, NotCompilable, Num, check_type

_COMPARISONS: dict[str, Callable] = {"eq": np.equal, "ne": np.not_equal, "lt": np.less}
_COMPARISONS |= {"le": np.less_equal, "gt": np.greater, "ge": np.greater_equal}
_LOGIC = {"and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor}
_SHIFTS = {"shift_left": "shl", "shift_right_logical": "lshr", "shift_right_arithmetic": "ashr"}


class Operations(Finiteness):
    """The operations of the components of a function."""

    def add(self, a: Num, b: Num) -> Num:
        if a.value is not None and b.value is not None:
            return self._fold(np.add, a, b)
        if a.is_const(0):
            return b
        if b.is_const(0):
            return a
        if not a.is_float:
            return self._commute("add", a, b, "add")
        # The one rule of contraction: a product that is an operand of a sum, the first one first.
        for product, other in ((a, b), (b, a)):
            if factors := self._factors(product):
                return self.fma(*factors, other)
        return self._commute("add", a, b, "fadd")

    def sub(self, a: Num, b: Num) -> Num:
        if a.value is not None and b.value is not None:
            return self._fold(np.subtract, a, b)
        if b.is_const(0):
            return a
        if not a.is_float:
            return self.instruction("sub", (a, b))
        if a.is_const(0):
            return self.neg(b)
        if factors := self._factors(a):
            return self.fma(*factors, self.neg(b))
        if factors := self._factors(b):
            return self.fma(self.neg(factors[0]), factors[1], a)
        return self.instruction("fsub", (a, b), "sub")

    def mul(self, a: Num, b: Num) -> Num:
        if a.value is not None and b.value is not None:
            return self._fold(np.multiply, a, b)
        for x, y in ((a, b), (b, a)):
            if factors := self._joined_factors(x, y):
                product = self.mul(*factors)
                # With a power of two c, c·x has the rounding of x, which a sum must not take away:
                # alone and in a batch not the same numbers are known before the loop.
                is_rounded = x.value is not None and is_power_of_two(x.value)
                return self.opaque(product) if is_rounded else product
        for x, y in ((a, b), (b, a)):
            # Not for every zero: 0·∞ and 0·NaN are NaN, as in IEEE 754.
            if x.structural and x.is_const(0):
                return x
            if x.is_const(1):
                return y
            if x.is_const(-1) and x.is_float:
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
        """(c·d, y) for c and x = d·y with c and d known before all loops, where c·(d·y) = (c·d)·y
        to the bit and no number leaves the range earlier: one of them is a power of two. x + x
        counts as 2·x."""
        if not c.is_float or c.structural or c.loops > 0:
            return None
        if x.op == "add" and x.args[0].key == x.args[1].key:
            d, y = self.const(2, x.dtype), x.args[0]
        elif x.op == "mul" and any(factor.loops == 0 for factor in x.args):
            d, y = x.args if x.args[0].loops == 0 else x.args[::-1]
        else:
            return None
        values = [factor.value for factor in (c, d) if factor.value is not None]
        powers = [value for value in values if is_power_of_two(value)]
        if len(values) < 2:
            # Computed before the loop, which must be worth it; near 1, it does not leave the range.
            is_worth_it = powers and y.loops > 0 and 1 / 16 <= abs(powers[0]) <= 16
            return (self.mul(c, d), y) if is_worth_it else None
        with np.errstate(all="ignore"):
            product = np.asarray(c.value * d.value, x.dtype)
        # A subnormal d·y would have lost digits, which (c·d)·y has.
        normal = np.finfo(x.dtype).tiny <= abs(product) < np.inf
        return (self.const(product, x.dtype), y) if powers and normal else None

    def fma(self, a: Num, b: Num, c: Num) -> Num:
        # fma(−a, b, c) has one instruction, whatever operand the sign belongs to.
        if a.op == "neg" and b.op == "neg":
            a, b = a.args[0], b.args[0]
        elif b.op == "neg":
            a, b = self.neg(a), b.args[0]
        return self.intrinsic("fma", (a, b, c))

    def div(self, a: Num, b: Num) -> Num:
        if a.value is not None and b.value is not None and a.is_float:
            return self._fold(np.divide, a, b)
        if not a.is_float:
            return self._integer_division("div", a, b)
        if b.is_const(1):
            return a
        if b.is_const(-1):
            return self.neg(a)
        if a.structural and a.is_const(0):
            return a
        if a.op == "neg":
            return self.neg(self.div(a.args[0], b))
        if b.value is not None and _has_exact_reciprocal(b.value):
            return self.mul(a, self.const(1 / b.value, b.dtype))
        # c/x = c·(1/x) to the bit where 1/x cannot leave the range: −1, or x a square root. So that
        # 1/x is computed once for several c.
        by_reciprocal = b.op == "sqrt" and a.value is not None and is_power_of_two(a.value)
        if a.is_const(-1) or (by_reciprocal and not a.is_const(1)):
            return self.mul(a, self.div(self.const(1, a.dtype), b))
        if b.loops == 0 < a.loops:
            return self.find_or_make(("quotient", a.key, b.key), lambda: self._by_reciprocal(a, b))
        return self.instruction("fdiv", (a, b), "div")

    def _by_reciprocal(self, a: Num, b: Num) -> Num:
        """a/b in a loop, by 1/b, which LLVM computes before the loop: a division of vectors takes
        as long as 16 products.

        With r = 1/b and q = a·r, both rounded, and the exact error e = a − q·b, q + e·r rounds to
        the bits of a/b. But where e has lost digits, for numbers below 1e-290, or a/b is the
        largest number, it may be its neighbour; |b| counts as 0 below 5.6e-309, and as infinite
        above 4.5e307.

        **Source** Markstein 1990, *IBM J. Res. Dev.* 34, 111; Brisebarre, Muller & Raina 2004,
        *IEEE Trans. Comput.* 53, 1069.
        """
        reciprocal = self.instruction("fdiv", (self.const(1, a.dtype), b), "div")
        product = self.instruction("fmul", (a, reciprocal), "mul")
        error = self.intrinsic("fma", (self.neg(product), b, a))
        result = self.intrinsic("fma", (error, reciprocal, product))
        # A zero has the sign of q. Where b or q is infinite, or b = 0, q is right, the result NaN.
        is_number = self.op("one", (result, self.const(0, a.dtype)), "bool", _write_differ)
        return self.select(is_number, result, product)

    def neg(self, a: Num) -> Num:
        if a.value is not None:
            with np.errstate(all="ignore"):
                return self.const(-a.value, a.dtype, a.structural and a.value == 0)
        if a.op == "neg":
            return a.args[0]
        if not a.is_float:
            return self.sub(self.const(0, a.dtype), a)
        # −(x − y) stays: it is y − x but for the sign of a zero.
        return self.instruction("fneg", (a,), "neg")

    def _commute(self, op: str, a: Num, b: Num, word: str) -> Num:
        number = self.find((op, a.dtype, b.key, a.key))
        return self.instruction(word, (a, b), op) if number is None else number

    def _fold(self, function: Callable, *args: Num) -> Num:
        with np.errstate(all="ignore"):
            value = function(*(a.value for a in args))
        structural = all(a.structural for a in args) and value in (0, 1)
        return self.const(value, args[0].dtype, structural)

    def _integer_division(self, op: str, a: Num, b: Num) -> Num:
        """Quotient or remainder; by zero −1 or the dividend, as XLA has it."""
        if a.dtype == "bool":
            raise NotCompilable(f"{op} requires numbers, got bool")
        zero, unit = self.const(0, a.dtype), self.const(1, a.dtype)
        by_zero = self.compare("eq", b, zero)
        smallest = self.const(np.iinfo(a.dtype).min, a.dtype)
        overflow = self.const(False, "bool")
        if not a.is_unsigned:
            is_smallest, minus_1 = self.compare("eq", a, smallest), self.const(-1, a.dtype)
            overflow = self.logic("and", is_smallest, self.compare("eq", b, minus_1))
        # The instruction ends the process for both, also on trajectories that do not need it.
        safe = self.select(self.logic("or", by_zero, overflow), unit, b)
        word = ("u" if a.is_unsigned else "s") + ("div" if op == "div" else "rem")
        value = self.instruction(word, (a, safe))
        if op == "div":
            at_zero = self.const(np.iinfo(a.dtype).max if a.is_unsigned else -1, a.dtype)
            value = self.select(overflow, smallest, value)
        else:
            at_zero, value = a, self.select(overflow, zero, value)
        return self.select(by_zero, at_zero, value)

    def rem(self, a: Num, b: Num) -> Num:
        """The remainder of integers."""
        return self._integer_division("rem", a, b)

    def power(self, x: Num, n: int) -> Num:
        """xⁿ by squaring; of a negative n by that of 1/x."""
        if n < 0:
            return self.power(self.div(self.const(1, x.dtype), x), -n)
        result, square = None, x
        while n:
            if n & 1:
                result = square if result is None else self.mul(result, square)
            n >>= 1
            if n:
                square = self.mul(square, square)
        return self.const(1, x.dtype) if result is None else result

    def sqrt(self, a: Num) -> Num:
        return self.intrinsic("sqrt", (a,)) if a.value is None else self._fold(np.sqrt, a)

    def abs(self, a: Num) -> Num:
        if a.value is not None:
            return self._fold(np.abs, a)
        if a.is_float:
            return self.intrinsic("fabs", (a,))
        if a.is_unsigned:
            return a
        return self.select(self.compare("lt", a, self.const(0, a.dtype)), self.neg(a), a)

    # --- comparisons and choices -----------------------------------------------------------------

    def compare(self, op: str, a: Num, b: Num) -> Num:
        if a.value is not None and b.value is not None:
            return self.const(_COMPARISONS[op](a.value, b.value), "bool")
        if a.op == "select" and b.value is not None and not a.is_float:
            condition, yes, no = a.args  # a status that was chosen: compare what it was chosen from
            if any(x.value is not None or x.op == "select" for x in (yes, no)):
                return self.select(condition, self.compare(op, yes, b), self.compare(op, no, b))
        if a.is_float:
            word = "fcmp " + {"eq": "oeq", "ne": "une"}.get(op, "o" + op)
        elif op in ("eq", "ne"):
            word = f"icmp {op}"
        else:
            word = f"icmp {'u' if a.is_unsigned else 's'}{op}"
        return self.op(op, (a, b), "bool", lambda kind, x, y: f"{word} {kind} {x}, {y}")

    def logic(self, op: str, a: Num, b: Num) -> Num:
        """and, or, xor of truth values or of bits."""
        if a.value is not None and b.value is not None:
            return self._fold(_LOGIC[op], a, b)
        if op == "and" and a.op == b.op == "finite" and a.args[0].dtype == b.args[0].dtype:
            first = self.finite_terms(a)
            return self.all_finite([*first, *self.finite_terms(b)], len(first))
        if a.dtype == "bool" and op != "xor":
            for x, y in ((a, b), (b, a)):
                if x.value is not None:
                    return y if bool(x.value) == (op == "and") else x
            if a.serial == b.serial:
                return a
        return self._commute(op, a, b, op)

    def invert(self, a: Num) -> Num:
        if a.value is not None:
            return self._fold(np.invert, a)
        if a.op == "not":
            return a.args[0]
        mask = True if a.dtype == "bool" else np.iinfo(a.dtype).max if a.is_unsigned else -1
        return self.instruction("xor", (a, self.const(mask, a.dtype)), "not")

    def select(self, condition: Num, yes: Num, no: Num) -> Num:
        if condition.value is not None:
            return yes if condition.value else no
        if yes is no or yes.key == no.key:
            return no
        # The same choice as one that may have been made: it is found again by its key.
        if condition.op == "not":
            return self.select(condition.args[0], no, yes)
        if yes.dtype == "bool":
            yes, no = self._where(condition, yes, True), self._where(condition, no, False)
            if yes.value is not None:
                other = condition if yes.value else self.invert(condition)
                return self.logic("or" if yes.value else "and", other, no)
            if no.value is not None:
                other = self.invert(condition) if no.value else condition
                return self.logic("or" if no.value else "and", other, yes)
        vec = condition.vec or yes.vec or no.vec
        kind = self.type(yes.dtype, vec)
        if not vec or condition.vec:
            bits = self.type("bool", vec)

            def write(_, c: str, x: str, y: str) -> str:
                return f"select {bits} {c}, {kind} {x}, {kind} {y}"

            return self.op("select", (condition, yes, no), yes.dtype, write)

        def make() -> Num:  # one bit for all trajectories, which need not become a vector
            pairs = zip(self.refs(yes, True), self.refs(no, True), strict=True)
            bit = condition.names[0]
            names = [self.new(f"select i1 {bit}, {kind} {x}, {kind} {y}") for x, y in pairs]
            return self.number(names, yes.dtype, True, "select", (condition, yes, no))

        return self.find_or_make(("select1", condition.key, yes.key, no.key), make)

    def _where(self, condition: Num, x: Num, is_true: bool) -> Num:
        """A truth value where a condition is known: the condition itself, or its opposite."""
        if x.serial == condition.serial:
            return self.const(is_true, "bool")
        is_opposite = x.op == "not" and x.args[0].serial == condition.serial
        return self.const(not is_true, "bool") if is_opposite else x

    def maximum(self, a: Num, b: Num, op: str = "gt") -> Num:
        """The larger (smaller) of two; NaN where one is NaN."""
        if a.value is not None and b.value is not None:
            return self._fold(np.maximum if op == "gt" else np.minimum, a, b)
        if not a.is_float:
            return self.select(self.compare(op, a, b), a, b)
        if b.value is not None:
            a, b = b, a
        # b where the comparison fails, so also where b is NaN.
        larger = self.select(self.compare(op, a, b), a, b)
        if a.value is not None and a.value == a.value:
            return larger
        return self.select(self.is_nan(a), a, larger)

    # --- types -----------------------------------------------------------------------------------

    def convert(self, a: Num, dtype: str) -> Num:
        if a.dtype == dtype:
            return a
        check_type(dtype)
        to_float = dtype in FLOATS
        if a.value is not None and (to_float or not a.is_float):
            structural = a.structural and to_float
            return self.const(np.asarray(a.value).astype(dtype), dtype, structural)
        if dtype == "bool":
            return self.compare("ne", a, self.const(0, a.dtype))
        if a.is_float and not to_float:
            return self._to_integer(a, dtype)
        bits, new_bits = (int(TYPES[d][1:]) if d not in FLOATS else 0 for d in (a.dtype, dtype))
        if a.is_float:
            word = "fpext" if dtype == "float64" else "fptrunc"
        elif to_float:
            word = "uitofp" if a.is_unsigned else "sitofp"
        elif new_bits == bits:
            word = "bitcast"
        else:
            word = "trunc" if new_bits < bits else "zext" if a.is_unsigned else "sext"
        out = self.type(dtype, a.vec)
        return self.op(f"to {word}", (a,), dtype, lambda kind, x: f"{word} {kind} {x} to {out}")

    def _to_integer(self, a: Num, dtype: str) -> Num:
        """Rounded towards zero, and to the nearest integer there is; NaN to 0."""
        word = "fptoui" if dtype.startswith("u") else "fptosi"
        source, out = self.type(a.dtype, a.vec), self.type(dtype, a.vec)
        full = f"llvm.{word}.sat.{self.suffix(dtype, a.vec)}.{self.suffix(a.dtype, a.vec)}"
        self.declare(f"{out} @{full}({source})")
        text = f"call {out} @{full}({source} "
        return self.op(f"to {dtype}", (a,), dtype, lambda _, x: f"{text}{x})")

    def bitcast(self, a: Num, dtype: str) -> Num:
        if a.value is not None:
            return self.const(np.asarray(a.value, a.dtype).view(dtype)[()], dtype)
        kind = self.type(dtype, a.vec)
        return self.op(f"as {dtype}", (a,), dtype, lambda t, x: f"bitcast {t} {x} to {kind}")

    def shift(self, op: str, a: Num, count: Num) -> Num:
        """Bits to the left or right; all bits are shifted out by their number or more."""
        bits, word = int(TYPES[a.dtype][1:]), _SHIFTS[op]
        if count.value is not None and 0 <= count.value < bits:
            if a.value is not None:
                return self._fold(functools.partial(_shift, word), a, count)
            return self.instruction(word, (a, count))
        largest = self.const(bits - 1, count.dtype)
        is_small = self.compare("le", count, largest)
        if not count.is_unsigned:
            is_positive = self.compare("ge", count, self.const(0, count.dtype))
            is_small = self.logic("and", is_small, is_positive)
        # LLVM leaves the result of a larger shift undefined.
        value = self.instruction(word, (a, self.select(is_small, count, largest)))
        return value if word == "ashr" else self.select(is_small, value, self.const(0, a.dtype))


def _shift(word: str, bits: Any, count: Any) -> Any:
    """A known integer after a shift, as LLVM's instruction of that name has it."""
    if word == "shl":
        return np.left_shift(bits, count)
    integer = np.asarray(bits).view(f"u{bits.dtype.itemsize}") if word == "lshr" else bits
    return np.right_shift(integer, integer.dtype.type(count)).view(bits.dtype)


def _write_differ(kind: str, x: str, y: str) -> str:
    """Whether two numbers differ; not where one is NaN."""
    return f"fcmp one {kind} {x}, {y}"


def is_power_of_two(x: Any) -> bool:
    """Whether a product with x is exact, but for subnormal numbers."""
    return abs(np.frexp(np.float64(x))[0]) == 0.5


def _has_exact_reciprocal(x: Any) -> bool:
    """Whether a product with 1/x is the quotient, subnormal results included."""
    return is_power_of_two(x) and 2.0**-100 <= abs(float(x)) <= 2.0**100
