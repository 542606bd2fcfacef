"""What a reader sees: tables and lines on stdout, errors, notes and bars on stderr, strict JSON."""

import json
import math
import sys
from collections.abc import Iterable, Mapping
from typing import Any


def stdout() -> Any:
    """A console of standard output: no control codes where it is no terminal or NO_COLOR is set."""
    from rich.console import Console

    return Console(highlight=False)


def stderr() -> Any:
    """A console of standard error."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def strict(value: Any) -> Any:
    """The same in types that JSON has; numbers that are not finite become null."""
    if isinstance(value, Mapping):
        return {str(k): strict(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [strict(v) for v in value]
    if hasattr(value, "tolist"):  # arrays and their numbers, without importing NumPy for it
        return strict(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


def print_json(contents: Mapping[str, Any]) -> None:
    """One object on standard output, and a line's end."""
    ascii_only = (sys.stdout.encoding or "").lower().replace("-", "") != "utf8"
    text = json.dumps(strict(contents), indent=2, ensure_ascii=ascii_only, allow_nan=False)
    sys.stdout.write(text + "\n")


def complain(what: str, message: str) -> None:
    """An error in one block on standard error: what kind, and what is to be known of it."""
    from rich.text import Text

    stderr().print(Text.assemble((f"{what}: ", "bold red"), message), soft_wrap=True)


def print_tables(console: Any, tables: Iterable[Any], words: bool = False) -> None:
    """Tables, their columns but the first to the right, where numbers stand; `words`: all left."""
    from rich.markup import escape
    from rich.table import Table

    for table in tables:
        console.print(table.title, style="bold", markup=False, soft_wrap=True)
        shown = Table()
        for i, column in enumerate(table.columns):
            side = "left" if words or i == 0 else "right"
            shown.add_column(escape(column), justify=side, overflow="fold")
        for row in table.rows:
            shown.add_row(*(escape(cell) for cell in row))
        console.print(shown)


class Bar:
    """A progress bar on stderr that appears with the first call, where that is a terminal."""

    def __init__(self, doing: str):
        self.doing = doing

    def __enter__(self) -> "Bar":
        self.progress = None
        return self

    def show(self, done: int, total: int) -> None:
        from rich.console import Console
        from rich.progress import Progress

        if self.progress is None:
            console = Console(stderr=True)
            self.progress = Progress(
                console=console, transient=True, disable=not console.is_terminal
            )
            self.progress.start()
            self.task = self.progress.add_task(self.doing, total=total)
        self.progress.update(self.task, completed=done)

    def __exit__(self, *_: object) -> None:
        if self.progress is not None:
            self.progress.stop()
