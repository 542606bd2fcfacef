"""What a check says of a method: a number, the bound it is held to, a verdict in words."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Measured:
    """One measured property of one method.

    - `value`: the number measured; NaN when nothing could be measured.
    - `allowed`: the bound in words, such as ``"≤ 1e-12"`` or ``"4 ± 0.2"``.
    - `passed`: whether the value meets the bound; never for a value that is NaN.
    - `claimed`: whether the method promises the property; what it does not promise is measured
      where that is possible, and is no failure.
    - `detail`: what else there is to say: the points of a fit, the status of a trajectory.
    """

    value: float
    allowed: str
    passed: bool
    claimed: bool = True
    detail: str = ""

    def __post_init__(self):
        if self.passed and not math.isfinite(self.value):
            raise ValueError(f"a value of {self.value} cannot have passed ({self.detail}).")

    @property
    def ok(self) -> bool:
        """Whether the method keeps what it promises here."""
        return self.passed or not self.claimed

    @property
    def verdict(self) -> str:
        """``"pass"``, ``"FAIL"``, ``"NOT MEASURED"`` (a failure too) or ``"not claimed"``."""
        if not self.claimed:
            return "not claimed"
        if self.passed:
            return "pass"
        return "NOT MEASURED" if math.isnan(self.value) else "FAIL"


def at_most(value: float, bound: float, claimed: bool = True, detail: str = "") -> Measured:
    """value ≤ bound."""
    passed = math.isfinite(value) and value <= bound
    return Measured(float(value), f"≤ {bound:g}", passed, claimed, detail)


def near(value: float, target: float, tolerance: float, detail: str = "") -> Measured:
    """|value − target| ≤ tolerance: too good is wrong as well."""
    passed = math.isfinite(value) and abs(value - target) <= tolerance
    return Measured(float(value), f"{target:g} ± {tolerance:g}", passed, True, detail)


def not_measured(allowed: str, detail: str, claimed: bool = True) -> Measured:
    """Nothing could be measured; a failure where the property is promised."""
    return Measured(math.nan, allowed, False, claimed, detail)
