"""Output for the reader and for programs: tables, errors, progress bars, strict JSON."""

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple


class TextTable(NamedTuple):
    """A table for the reader: names of the columns, rows of texts."""

    title: str
    columns: list[str]
    rows: list[list[str]]


def console(stderr: bool = False) -> Any:
    """Standard output or error: no control codes without a terminal or with NO_COLOR."""
    from rich.console import Console

    return Console(stderr=stderr, highlight=False)


def json_types(value: Any, not_finite: Callable[[float], Any] = lambda x: None) -> Any:
    """The same in types that JSON has; numbers that are not finite become null, or `not_finite`."""
    if isinstance(value, Mapping):
        return {str(k): json_types(v, not_finite) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_types(v, not_finite) for v in value]
    if hasattr(value, "tolist"):  # arrays and their numbers, without importing NumPy for it
        return json_types(value.tolist(), not_finite)
    if isinstance(value, float):
        return value if math.isfinite(value) else not_finite(value)
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


def print_json(contents: Mapping[str, Any]) -> None:
    """One object on standard output, and the end of the line."""
    ascii_only = (sys.stdout.encoding or "").lower().replace("-", "") != "utf8"
    text = json.dumps(json_types(contents), indent=2, ensure_ascii=ascii_only, allow_nan=False)
    sys.stdout.write(text + "\n")


def print_error(kind: str, message: str, as_json: bool = False) -> None:
    """An error in one block on standard error, or as an object on standard output."""
    if as_json:
        print_json({"error": {"kind": kind, "message": message}})
        return
    from rich.text import Text

    console(stderr=True).print(Text.assemble((f"{kind}: ", "bold red"), message), soft_wrap=True)


def print_tables(tables: Iterable[Any], words: bool = False) -> None:
    """Tables; columns of numbers, all but the first, are aligned right unless they are `words`."""
    from rich.markup import escape
    from rich.table import Table as Grid

    out = console()
    for table in tables:
        out.print(table.title, style="bold", markup=False, soft_wrap=True)
        grid = Grid()
        for i, column in enumerate(table.columns):
            side = "left" if words or i == 0 else "right"
            grid.add_column(escape(column), justify=side, overflow="fold")
        for row in table.rows:
            grid.add_row(*map(escape, row))
        out.print(grid)


@contextmanager
def progress_bar(doing: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on stderr, if that is a terminal: a function of the parts done and of all."""
    from rich.progress import Progress

    out = console(stderr=True)
    with Progress(console=out, transient=True, disable=not out.is_terminal) as bar:
        task = bar.add_task(doing, total=None)
        yield lambda count, total: bar.update(task, completed=count, total=total)
