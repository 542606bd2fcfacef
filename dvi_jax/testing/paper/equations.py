"""The paper's numbered equations, rows of `equations.toml`, and the code of each."""

import pkgutil
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any


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

    def equation(row: dict[str, Any]) -> Equation:
        code = (f"dvi_jax.{part}" for name in row["code"] for part in short.get(name, [name]))
        return Equation(row["number"], row["what"], tuple(code), row.get("note", ""))

    return tuple(map(equation, table["equation"]))


EQUATIONS = _read()
"""All fifty, in order."""


resolve = pkgutil.resolve_name
"""Dotted name → object. Raises `ModuleNotFoundError` or `AttributeError` for an invalid name."""
