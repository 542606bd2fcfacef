"""The progress bar of a sweep."""

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Any

from .workers import SweepProgress


@contextlib.contextmanager
def shown(
    progress: bool | Callable[[SweepProgress], None] | None,
) -> Iterator[Callable[[SweepProgress], None] | None]:
    """A function that takes the progress: the user's, that of a bar, or None.

    **Raises** `TypeError` for anything else.
    """
    if callable(progress):
        yield progress
        return
    if not (progress is None or isinstance(progress, bool)):
        raise TypeError(f"progress must be True, False, None or a function, got {progress!r}.")
    from rich.console import Console

    console = Console(stderr=True)
    if progress is False or (progress is None and not (console.is_terminal or console.is_jupyter)):
        yield None
        return
    with _bar(console) as bar:
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


def _bar(console: Any) -> Any:
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
