"""Progress reports of long calls: to a function of the user, to a progress bar, or none."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.util import find_spec
from typing import Any, TypeVar

from .checks import instance

T = TypeVar("T")


def reporter(
    progress: bool | Callable[[T], None] | None,
    bar: Callable[[Any], AbstractContextManager[Callable[[T], None]]],
) -> AbstractContextManager[Callable[[T], None] | None]:
    """A context whose value is a function that receives the progress, or None for no reports.

    - `progress`: a function, which is used; True, a bar; False, no reports; None, a bar in a
      terminal, or in a notebook that has ipywidgets.
    - `bar`: a console of rich → a context that shows a bar.

    **Raises** `TypeError` for anything else.
    """
    if callable(progress):
        return nullcontext(progress)
    instance("progress", progress, bool | None, "True, False, None or a function")
    if progress is False:
        return nullcontext(None)
    from rich.console import Console  # not needed by `import dvi_jax`, whose time it would add to

    console = Console(stderr=True)
    if console.is_jupyter and find_spec("ipywidgets") is None:
        # Rich would warn at each line. Jupyter sets FORCE_COLOR, but cannot show a moving bar.
        console = Console(stderr=True, force_jupyter=False, force_terminal=False)
    if progress is None and not (console.is_terminal or console.is_jupyter):
        return nullcontext(None)
    return bar(console)


def bar_of(
    name: str, texts: Sequence[str], columns: Callable[[T], dict[str, Any]]
) -> Callable[[Any], AbstractContextManager[Callable[[T], None]]]:
    """A bar for `reporter`, followed by texts. `columns`: progress → keywords of rich's
    ``Progress.update``, `texts` among them."""

    @contextmanager
    def bar(console: Any) -> Iterator[Callable[[T], None]]:
        from rich.progress import BarColumn, Progress, TextColumn

        fields = (TextColumn(f"{{task.fields[{text}]}}") for text in texts)
        first = TextColumn("{task.description}"), BarColumn()
        with Progress(*first, *fields, console=console) as display:
            empty: dict[str, Any] = dict.fromkeys(texts, "")
            task = display.add_task(name, total=None, **empty)
            yield lambda progress: display.update(task, **columns(progress))

    return bar
