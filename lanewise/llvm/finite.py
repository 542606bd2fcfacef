"""Whether numbers are finite, with as few tests as are enough for several of them."""

from collections.abc import Sequence

import numpy as np

from .ir import Num, Writer, call_of

# Operations whose result is not finite where an operand is not.
_HANDED_ON = frozenset(["add", "sub", "mul", "fma", "neg", "sqrt", "same"])
_MOST_SEEN = 300  # operations that are followed back: more would take longer than what they save
_MOST_COMPARED = 12  # with more numbers than this each of them is checked


class Finiteness(Writer):
    """Tests of the numbers of a function."""

    def is_nan(self, a: Num) -> Num:
        return self.op("isnan", (a,), "bool", lambda kind, x: f"fcmp uno {kind} {x}, {x}")

    def is_finite(self, a: Num) -> Num:
        if not a.is_float:
            return self.const(True, "bool")
        if a.value is not None:
            return self.const(np.isfinite(a.value), "bool")
        return self.all_finite([a])

    def all_finite(self, terms: Sequence[Num], start: int = 1) -> Num:
        """Whether all numbers, of one type, are finite: whether Σ 0·x is not NaN.

        A number is left out if another one cannot be finite without it. The first `start` numbers
        are not compared with each other.
        """
        terms = list({x.serial: x for x in terms}.values())
        tests = terms if len(terms) > _MOST_COMPARED else terms[:start]
        for x in terms[len(tests) :]:
            if not self.finite_where(frozenset([x.serial]), tests):
                implications = self.finite_where(frozenset(y.serial for y in tests), [x])
                tests = [*(y for y in tests if y.serial not in implications), x]
        zero = self.const(0, terms[0].dtype)
        total = self.instruction("fmul", (zero, tests[0]), "0·x")

        def write_fma(kind: str, *names: str) -> str:
            suffix = self.suffix(zero.dtype, kind.startswith("<"))
            return call_of(f"@llvm.fma.{suffix}", kind, names)

        for vec in (False, True) if len(tests) > 1 else ():
            kind = self.type(zero.dtype, vec)
            self.declare(f"{kind} @llvm.fma.{self.suffix(zero.dtype, vec)}({kind}, {kind}, {kind})")
        for x in tests[1:]:
            total = self.op("Σ 0·x", (zero, x, total), zero.dtype, write_fma)
        return self.op("finite", (total,), "bool", lambda t, x: f"fcmp ord {t} {x}, {x}")

    def finite_terms(self, flag: Num) -> tuple[Num, ...]:
        """The numbers that a result of `is_finite` or `all_finite` is about."""
        terms, (total,) = [], flag.args
        while total.op == "Σ 0·x":
            terms.append(total.args[1])
            total = total.args[2]
        return (total.args[1], *reversed(terms))

    def finite_where(self, targets: frozenset[int], premises: Sequence[Num]) -> frozenset[int]:
        """Which of `targets`, serials of numbers, are finite for certain where all
        `premises` are: those numbers themselves, what they are a sum or a product of, and so on."""
        answers: dict[int, frozenset[int]] = {}
        # A stack of our own: chains of operations are longer than the stack of Python allows.
        stack = [(x, False) for x in premises]
        while stack:
            x, is_seen = stack.pop()
            if x.value is not None or x.serial in answers:
                continue
            parts = x.args if x.op in _HANDED_ON else x.args[1:] if x.op == "select" else ()
            if parts and not is_seen and len(answers) + len(stack) < _MOST_SEEN:
                stack.append((x, True))
                stack += [(a, False) for a in parts]
                continue
            mine = [answers.get(a.serial, frozenset()) for a in parts] or [frozenset()]
            # A selection takes one operand, and it is not known which: only what both show counts.
            of_parts = mine[0].intersection if x.op == "select" else mine[0].union
            answers[x.serial] = of_parts(*mine[1:]) | (frozenset([x.serial]) & targets)
        return frozenset().union(*(answers.get(x.serial, frozenset()) for x in premises))
