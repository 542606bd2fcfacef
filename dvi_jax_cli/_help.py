"""Help pages: paragraphs of a docstring, and examples as they are written."""

from collections.abc import Iterable
from typing import Any

from typer.core import TyperCommand

from ._show import console


def unwrapped(text: str) -> str:
    """Paragraphs each in one line: a terminal has another width than this file."""
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))


def shown_examples(lines: Iterable[str]) -> str | None:
    """Examples as a help page ends with: each on a line of its own."""
    lines = [f"   {line}" for line in lines]
    return "\n".join([" Examples", *lines]) if lines else None


class WithExamples:
    """A command whose epilog is shown line by line: Typer's versions differ in how they join it."""

    epilog: str | None

    def format_help(self, ctx: Any, formatter: Any) -> None:
        text, self.epilog = self.epilog, None
        try:
            super().format_help(ctx, formatter)  # type: ignore[misc]
        finally:
            self.epilog = text
        if text:
            console().print(text, markup=False, soft_wrap=True)


class Command(WithExamples, TyperCommand):
    """A command with examples below its help."""
