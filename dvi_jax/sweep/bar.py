"""The progress bar of a sweep."""

import math
from typing import Any

from ..base.progress import bar_of, reporter
from .cost import span
from .workers import SweepProgress


def _columns(progress: SweepProgress) -> dict[str, Any]:
    return {
        "total": progress.num_lanes,
        "completed": progress.lanes_done,
        "done": f"{progress.lanes_done / progress.num_lanes:4.0%}",
        "rate": f"{progress.rate:.3g} steps/s",
        "failed": f"[red]{progress.failed} failed[/]" if progress.failed else "none failed",
        "left": "" if math.isnan(progress.seconds_left) else f"{span(progress.seconds_left)} left",
    }


def progress_display(progress: Any) -> Any:
    """A context whose value is called with a `SweepProgress`, or is None."""
    return reporter(progress, bar_of("sweep", ("done", "rate", "failed", "left"), _columns))
