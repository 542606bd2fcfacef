"""What is measured along a trajectory while it runs."""

from ._kept import (
    Crossings as Crossings,
    RequestedTimes as RequestedTimes,
    Section as Section,
)
from ._reductions import (
    Last as Last,
    MaxDrift as MaxDrift,
    Mean as Mean,
    Range as Range,
    Reduction as Reduction,
    Trend as Trend,
)
from ._stop import Stop as Stop, Stopped as Stopped
