"""A claim, the checks that decide it, and the verdict."""

import math
from dataclasses import dataclass
from enum import Enum

ROUND_OFF = 1e-12
"""What counts as exact, relative: a few thousand units in the last place, for long runs."""


class Verdict(Enum):
    """What became of a claim."""

    HOLDS = "holds"
    MENDED = "holds once mended"
    FAILS = "does not hold"


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def pretty(value: float) -> str:
    """The number with three digits as text, 1.39e-08 written as 1.39×10⁻⁸."""
    mantissa, _, exponent = f"{value:.3g}".partition("e")
    mantissa = mantissa.replace("-", "−")
    return f"{mantissa}×10{str(int(exponent)).translate(_RAISED)}" if exponent else mantissa


@dataclass(frozen=True)
class Check:
    """A measured number and the band in which it has to lie, bounds included; NaN never does."""

    what: str
    value: float
    low: float = -math.inf
    high: float = math.inf

    @property
    def passes(self) -> bool:
        return bool(self.low <= self.value <= self.high)

    @property
    def band(self) -> str:
        if self.low == math.inf:
            return "none"
        if math.isinf(self.low) or self.low == 0:  # sizes: 0 is no bound
            return f"≤ {pretty(self.high)}"
        if math.isinf(self.high):
            return f"≥ {pretty(self.low)}"
        return f"{pretty(self.low)} … {pretty(self.high)}"


@dataclass(frozen=True)
class Claim:
    """One claim and how it is judged.

    `printed`: checks of the claim as the paper has it; if all pass it holds. `mended`: checks
    of the claim once put right; if all pass (and there are some) it holds once mended. `why`
    explains the verdict `on_record`; when a measurement leads elsewhere, the row says so
    in place of it. `also`: numbers worth showing that decide nothing.
    """

    key: str
    where: str
    says: str
    printed: tuple[Check, ...]
    mended: tuple[Check, ...]
    on_record: Verdict
    why: str
    also: tuple[Check, ...] = ()

    @property
    def verdict(self) -> Verdict:
        if all(check.passes for check in self.printed):
            return Verdict.HOLDS
        if self.mended and all(check.passes for check in self.mended):
            return Verdict.MENDED
        return Verdict.FAILS

    @property
    def is_expected(self) -> bool:
        return self.verdict is self.on_record

    @property
    def reason(self) -> str:
        if self.is_expected:
            return self.why
        return (
            f"Unexpected: on record is “{self.on_record.value}”. Something has changed, in the "
            "package or in what it runs on; compare the numbers with their bands."
        )
