"""What is measured along a trajectory while it runs."""

from ._reductions import (
    Last as Last,
    MaxDrift as MaxDrift,
    Mean as Mean,
    Range as Range,
    Reduction as Reduction,
    Trend as Trend,
)
