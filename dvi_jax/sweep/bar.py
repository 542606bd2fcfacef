"""The progress bar of a sweep."""

import math
from typing import Any

from ..base.progress import bar_of, reporter
from .cost import span
from .workers import SweepProgress


def _columns(p: SweepProgress) -> dict[str, Any]:
    return {
        "total": p.num_lanes,
        "completed": p.lanes_done,
        "done": f"{p.lanes_done / p.num_lanes:4.0%}",
        "rate": f"{p.rate:.3g} steps/s",
        "failed": f"[red]{p.failed} failed[/]" if p.failed else "none failed",
        "left": "" if math.isnan(p.seconds_left) else f"{span(p.seconds_left)} left",
    }


def shown(progress: Any) -> Any:
    """A context whose value is called with a `SweepProgress`, or is None."""
    return reporter(progress, bar_of("sweep", ("done", "rate", "failed", "left"), _columns))
