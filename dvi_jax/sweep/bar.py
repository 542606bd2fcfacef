"""The progress bar of a sweep."""

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from .._progress import told
from .workers import SweepProgress


def shown(
    progress: bool | Callable[[SweepProgress], None] | None,
) -> AbstractContextManager[Callable[[SweepProgress], None] | None]:
    """A context whose value takes the progress: the user's function, a bar's, or None."""
    return told(progress, _bar)


@contextmanager
def _bar(console: Any) -> Iterator[Callable[[SweepProgress], None]]:
    with _columns(console) as bar:
        task = bar.add_task("sweep", total=None, rate="", failed="", left="")

        def show(p: SweepProgress) -> None:
            bar.update(
                task,
                total=p.num_lanes,
                completed=p.lanes_done,
                rate=f"{p.rate:.3g} steps/s",
                failed=f"[red]{p.failed} failed[/]" if p.failed else "none failed",
                left="" if math.isnan(p.seconds_left) else f"{_time(p.seconds_left)} left",
            )

        yield show


def _columns(console: Any) -> Any:
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    texts = ("{task.description}", "{task.fields[rate]}", "{task.fields[failed]}",
             "{task.fields[left]}")  # fmt: skip
    first, *others = (TextColumn(t) for t in texts)
    return Progress(first, BarColumn(), TaskProgressColumn(), *others, console=console)


def _time(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172800 else f"{seconds / 86400:.1f} days"
