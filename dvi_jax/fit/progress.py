"""What a fit shows while it runs."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._progress import told


@dataclass(frozen=True)
class FitProgress:
    """Where a fit stands: `step` of the optimiser of at most `max_steps`, the `stage` and its
    `horizon`, the `loss`, the parameters `x` with their `names`, `seconds` since the start."""

    step: int
    max_steps: int
    stage: int
    horizon: float
    loss: float
    x: np.ndarray
    names: list[str]
    seconds: float


def shown(
    progress: bool | Callable[[FitProgress], None] | None,
) -> AbstractContextManager[Callable[[FitProgress], None] | None]:
    """A context whose value takes the progress: the user's function, a bar's, or None."""
    return told(progress, _bar)


@contextmanager
def _bar(console: Any) -> Iterator[Callable[[FitProgress], None]]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    texts = ("{task.description}", "{task.fields[loss]}", "{task.fields[params]}")
    first, *others = (TextColumn(t) for t in texts)
    with Progress(first, BarColumn(), MofNCompleteColumn(), *others, console=console) as bar:
        task = bar.add_task("fit", total=None, loss="", params="")

        def show(p: FitProgress) -> None:
            values = zip(p.names[:3], p.x[:3], strict=True)
            bar.update(
                task,
                description=f"fit, stage {p.stage + 1}",
                total=p.max_steps,
                completed=p.step,
                loss=f"loss {p.loss:.5g}",
                params=", ".join(f"{n} {v:.7g}" for n, v in values)
                + (", …" if len(p.names) > 3 else ""),
            )

        yield show
