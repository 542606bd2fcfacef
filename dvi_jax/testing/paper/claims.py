"""The paper's claims, rows of `claims.toml`, with verdicts computed from the measurements."""

import math
import tomllib
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from .experiments import Measurements
from .values import numbers


class Verdict(Enum):
    """The outcome of the checks of a claim."""

    HOLDS = "holds"
    CORRECTED = "holds once corrected"
    FAILS = "does not hold"


_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def pretty(value: float) -> str:
    """The number with three digits as text, 1.39e-08 written as 1.39×10⁻⁸."""
    mantissa, _, exponent = f"{value:.3g}".partition("e")
    mantissa = mantissa.replace("-", "−")
    return f"{mantissa}×10{str(int(exponent)).translate(_SUPERSCRIPTS)}" if exponent else mantissa


@dataclass(frozen=True)
class NumberCheck:
    """A measured number and its allowed band, bounds included; NaN is never in it."""

    quantity: str
    value: float
    low: float = -math.inf
    high: float = math.inf

    @property
    def passes(self) -> bool:
        return bool(self.low <= self.value <= self.high)

    @property
    def decides(self) -> bool:
        """Whether there is a bound."""
        return self.low > -math.inf or self.high < math.inf

    @property
    def band(self) -> str:
        if self.low == math.inf:
            return "none"
        if math.isinf(self.low) or self.low == 0:  # an absolute value: 0 is not a bound
            return f"≤ {pretty(self.high)}"
        if math.isinf(self.high):
            return f"≥ {pretty(self.low)}"
        return f"{pretty(self.low)} … {pretty(self.high)}"


@dataclass(frozen=True)
class Claim:
    """A row of `claims.toml` with its numbers; `explanation` is that of the verdict `on_record`."""

    key: str
    where: str
    says: str
    printed: tuple[NumberCheck, ...]
    corrected: tuple[NumberCheck, ...]
    on_record: Verdict
    explanation: str
    context: tuple[NumberCheck, ...] = ()

    @property
    def verdict(self) -> Verdict:
        if all(check.passes for check in self.printed):
            return Verdict.HOLDS
        if self.corrected and all(check.passes for check in self.corrected):
            return Verdict.CORRECTED
        return Verdict.FAILS

    @property
    def is_expected(self) -> bool:
        return self.verdict is self.on_record

    @property
    def reason(self) -> str:
        if self.is_expected:
            return self.explanation
        return (
            f"Unexpected: the verdict on record is “{self.on_record.value}”. The package or its "
            "dependencies have changed; compare the numbers with their bands."
        )


def judge(measurements: Measurements) -> list[Claim]:
    """All claims of the paper, judged on these measurements."""
    values = numbers(measurements)
    rows = tomllib.loads(Path(__file__).with_name("claims.toml").read_text(encoding="utf-8"))

    def claim(row: dict[str, Any]) -> Claim:
        checks = {
            part: tuple(
                NumberCheck(quantity, values[name], *map(float, bounds))
                for quantity, name, *bounds in row.get(part, ())
            )
            for part in ("printed", "corrected", "context")
        }
        return Claim(**{**row, **checks, "on_record": Verdict(row["on_record"])})

    return [claim(row) for row in rows["claim"]]
