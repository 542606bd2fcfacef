"""The paper's numbered equations, rows of `equations.toml`, and the code of each."""

import pkgutil
import tomllib
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Equation:
    """A numbered equation; `code`: names of its implementation; `note`: error of the print."""

    number: int
    statement: str
    code: tuple[str, ...]
    note: str = ""


def _read() -> tuple[Equation, ...]:
    path = Path(__file__).with_name("equations.toml")
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    short: dict[str, list[str]] = table["names"]
    return tuple(
        Equation(
            row["number"],
            row["what"],
            tuple(f"dvi_jax.{part}" for name in row["code"] for part in short.get(name, [name])),
            row.get("note", ""),
        )
        for row in table["equation"]
    )


EQUATIONS = _read()
"""All fifty, in order."""


resolve = pkgutil.resolve_name
"""Dotted name → object. Raises `ModuleNotFoundError` or `AttributeError` for an invalid name."""
