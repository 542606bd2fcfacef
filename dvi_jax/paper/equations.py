"""The paper's numbered equations, rows of `equations.toml`, and the code of each."""

import pkgutil
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Equation:
    """One numbered equation.

    `number`; `what` it says; `code`: dotted names of what implements it; `note`: how the print
    differs from what is right, empty where it does not.
    """

    number: int
    what: str
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
            tuple(f"dvi_jax.{one}" for name in row["code"] for one in short.get(name, [name])),
            row.get("note", ""),
        )
        for row in table["equation"]
    )


EQUATIONS = _read()
"""All fifty, in order."""


def resolve(name: str) -> Any:
    """The object of a dotted name.

    **Raises** `ModuleNotFoundError` or `AttributeError` when there is none.
    """
    return pkgutil.resolve_name(name)
