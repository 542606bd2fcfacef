"""What a fit shows while it runs."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np


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


@contextlib.contextmanager
def shown(
    progress: bool | Callable[[FitProgress], None] | None,
) -> Iterator[Callable[[FitProgress], None] | None]:
    """A function that takes the progress: the user's, that of a bar, or None.

    None shows a bar where there is a terminal or a notebook.

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
