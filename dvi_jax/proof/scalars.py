"""Lists of scalar operations that are written by Python's operators on numbers."""

import math
import operator
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from .ways import MACHINE_CODE, XLA, exponentials_in_products

UNARY = ("exp", "log", "sin", "cos", "tan", "atan", "asin", "acos", "sqrt")
_MOST_EXPONENTIALS = 2**20


class NotAnalytic(ValueError):
    """A function that has no list of operations; the message says what is in it."""


class ScalarProgram:
    """Operations (name, operands), written one by one; equal ones are written once.

    `way`: `MACHINE_CODE` or `XLA`, the way of running whose rounding the list describes.
    `points`: rows of inputs, at which conditions are decided; None: these are not in the list.
    """

    def __init__(self, way: str = MACHINE_CODE, points: np.ndarray | None = None):
        self.way, self.points = way, points
        self.operations: list[list[Any]] = []
        self._numbers: dict[tuple, int] = {}
        self.constants: dict[int, float] = {}
        self.infinite: dict[int, float] = {}  # or NaN
        self._samples: list[Any] = []
        self._magnitudes: dict[int, ProgramNumber] = {}  # absolute values that are not decided
        self.guards: list[int] = []  # what must have a value, next to the outputs

    def write(self, name: str, *operands: Any) -> "ProgramNumber":
        key = (name, *operands)
        if key not in self._numbers:
            self._numbers[key] = len(self.operations)
            self.operations.append([name, *operands])
        return ProgramNumber(self, self._numbers[key])

    def constant(self, value: float) -> "ProgramNumber":
        if not math.isfinite(value):
            unknown = self.write("unknown", f"the constant {float(value)}")
            self.infinite[unknown.index] = float(value)
            return unknown
        scalar = self.write("constant", float(value).hex())
        self.constants[scalar.index] = float(value)
        return scalar

    def samples(self, x: "ProgramNumber") -> Any:
        """The values of a number at the points, in float64."""
        with np.errstate(all="ignore"):
            for i in range(len(self._samples), x.index + 1):
                self._samples.append(self._sample(i, *self.operations[i]))
        return self._samples[x.index]

    def _sample(self, i: int, name: str, *operands: Any) -> Any:
        if name == "input":
            return np.nan if self.points is None else self.points[:, operands[0]]
        if name in ("constant", "unknown"):
            return self.constants.get(i, self.infinite.get(i, np.nan))
        values = [self._samples[k] for k in _operands([name, *operands])]
        if name in ("sum", "multiply"):
            return sum(values) if name == "sum" else values[0] * values[1]
        if name in ("inverse", "inexact"):
            return 1 / values[0] if name == "inverse" else values[0]
        return getattr(np, f"arc{name[1:]}" if name[0] == "a" else name)(values[0])

    def sign(self, x: "ProgramNumber") -> float | None:
        """The sign of a number, if it is the same at all points: then √(sign x) is a guard."""
        if x.value is not None:
            return float(np.sign(x.value))
        for sign in (1.0, -1.0):
            if self.points is not None and np.all(sign * self.samples(x) > 0):
                self.guards.append((x * sign).apply("sqrt").index)
                return sign
        return None

    def magnitude(self, x: "ProgramNumber") -> "ProgramNumber":
        """|x| of an x with both signs: not in a list, but may be known to be below a number."""
        unknown = self.write("unknown", "abs", x.index)
        self._magnitudes[unknown.index] = x
        return unknown

    def order(self, a: "ProgramNumber", b: "ProgramNumber") -> float | None:
        """The sign of a − b, if it is the same at all points; a or b may be an infinite constant or
        NaN, or both the same number."""
        for x, y, sign in ((a, b, 1.0), (b, a, -1.0)):
            limit = 0.0 if a.index == b.index else sign * self.infinite.get(x.index, 0.0)
            if (limit or a.index == b.index) and np.all(np.isfinite(self.samples(y))):
                self.guards.append(y.index)
                return limit
            if (u := self._magnitudes.get(x.index)) is not None:
                return -sign if self.sign(y - u) == self.sign(y + u) == 1.0 else None
        return self.sign(a - b)

    def as_json(self, outputs: Sequence["ProgramNumber"]) -> dict[str, Any]:
        """With the operations that the outputs and guards need only."""
        indices = set()
        stack = [*(out.index for out in outputs), *self.guards]
        while stack:
            i = stack.pop()
            if i not in indices:
                indices.add(i)
                stack.extend(_operands(self.operations[i]))
        order = sorted(indices)
        primitives = {self.operations[i][1] for i in order if self.operations[i][0] == "unknown"}
        if primitives:
            names = ", ".join(sorted(primitives)).replace("select_n", "select_n (jnp.where)")
            raise NotAnalytic(
                f"a proof does not allow: {names} of JAX, only + − × /, powers, exp2, cbrt, atan2, "
                f"hyperbolic functions and {', '.join(UNARY)}. Compute constants by other "
                "functions before, outside of this one."
            )
        numbers, operations = {}, []
        exponentials = exponentials_in_products(self.operations) if self.way == XLA else 0
        if exponentials > _MOST_EXPONENTIALS:
            raise NotAnalytic("a product has too many exponentials, which XLA computes as one.")
        for i in order:
            name, *arguments = self.operations[i]
            count = len(_operands(self.operations[i]))
            operands = [numbers[j] for j in arguments[:count]]
            if name == "exp" and exponentials > 1:
                operations.append(["inexact", *operands, exponentials])
                operands = [len(operations) - 1]
            numbers[i] = len(operations)
            operations.append([name, *operands, *arguments[count:]])
        return {"operations": operations, "outputs": [numbers[out.index] for out in outputs]}


def _operands(operation: list[Any]) -> list[int]:
    name, *arguments = operation
    if name == "inexact":
        return arguments[:1]
    return [] if name in ("input", "constant", "unknown") else arguments


class ProgramNumber:
    """One number of a program, with Python's operators."""

    __slots__ = ("index", "program")

    def __init__(self, program: ScalarProgram, index: int):
        self.program, self.index = program, index

    @property
    def value(self) -> float | None:
        return self.program.constants.get(self.index)

    def _scalar(self, other: Any) -> "ProgramNumber":
        return other if isinstance(other, ProgramNumber) else self.program.constant(other)

    def _constant(self, operation: Callable, other: "ProgramNumber") -> "ProgramNumber | None":
        """The result for two constants, if it is a number of float64."""
        if self.value is None or other.value is None:
            return None
        value = operation(Fraction(self.value), Fraction(other.value))
        is_exact = abs(value) < 2**1000 and Fraction(float(value)) == value
        return self.program.constant(float(value)) if is_exact else None

    def __add__(self, other: Any) -> "ProgramNumber":
        other = self._scalar(other)
        if self.value == 0:
            return other
        if other.value == 0:
            return self
        constant = self._constant(operator.add, other)
        return constant or self.program.write("sum", self.index, other.index)

    def __neg__(self) -> "ProgramNumber":
        if self.value is not None:
            return self.program.constant(-self.value)
        return self * -1.0

    def __sub__(self, other: Any) -> "ProgramNumber":
        return self + -self._scalar(other)

    def __mul__(self, other: Any) -> "ProgramNumber":
        other = self._scalar(other)
        for a, b in ((self, other), (other, self)):
            if a.value == 0 or b.value == 1:
                return a
        constant = self._constant(operator.mul, other)
        return constant or self.program.write("multiply", self.index, other.index)

    def __truediv__(self, other: Any) -> "ProgramNumber":
        other = self._scalar(other)
        if self.value == 0 or other.value == 1:
            return self
        if other.value and math.frexp(other.value)[0] in (0.5, -0.5):
            return self * (1 / other.value)  # exact
        return self * other.apply("inverse")

    __radd__, __rmul__ = __add__, __mul__

    def __rsub__(self, other: Any) -> "ProgramNumber":
        return self._scalar(other) - self

    def __rtruediv__(self, other: Any) -> "ProgramNumber":
        return self._scalar(other) / self

    def power(self, n: int) -> "ProgramNumber":
        """selfⁿ: n − 1 products; for n < 0 of 1/self, as in machine code, which rounds more."""
        if n < 1:
            unit = self.program.constant(1.0)
            return (unit / self).power(-n) if n else unit
        if n == 1:
            return self
        square = (self * self).power(n // 2)
        return square * self if n % 2 else square

    def apply(self, name: str) -> "ProgramNumber":
        return self.program.write(name, self.index)

    def inexact(self, units: int) -> "ProgramNumber":
        """The same number, computed with an error of so many units of round-off."""
        return self.program.write("inexact", self.index, units)


def total(scalars: Sequence[Any]) -> Any:
    """The sum of several numbers as one operation, whose order is open."""
    parts = [s for s in scalars if not (isinstance(s, ProgramNumber) and s.value == 0)]
    if len(parts) < 2:
        return parts[0] if parts else scalars[0]
    return parts[0].program.write("sum", *(part.index for part in parts))
