"""The certificate as text: tables for the terminal, a Markdown page."""

import math
import platform
import string
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import dvi_jax as dvi

from ..base.files import user_path
from .check import CHECKS, Measured
from .controls import Control

TITLE = "# Certificate of the methods"
"""First line of the page, by which a page is recognised."""

GROUPS = {
    "Order and structure": ("order", "forced-order", "symplecticity", "reversal", "adjoint"),
    "Long runs and derivatives": ("energy", "momentum", "gradient", "modes"),
    "Programs": ("jit", "vmap", "failure", "traces"),
}
"""The checks as tables show them together."""


def page_for(out: Path) -> Path:
    """The file that the page is written to: `out`, or ``certificate.md`` in it.

    **Raises** `ValueError` for a file that exists and is not a certificate.
    """
    out = user_path("--out", out)
    page = out if out.suffix == ".md" and not out.is_dir() else out / "certificate.md"
    fault = ""
    if out.exists() and not out.is_dir() and page != out:
        fault = f"{out} is neither a directory nor a .md file"
    elif page.exists():
        try:
            first = page.read_text(encoding="utf-8").partition("\n")[0]
            fault = "" if first == TITLE else f"{page} exists and is not a certificate"
        except (OSError, UnicodeDecodeError) as error:
            fault = f"{page} cannot be read: {error}"
    if fault:
        advice = "a new .md file, an earlier certificate, or a directory for the certificate."
        raise ValueError(f"--out: {fault}\n  allowed: {advice}")
    return page


class Sheet(NamedTuple):
    """A title, names of columns, rows of text."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


def tables(
    methods: Mapping[str, dvi.Method],
    rows: Mapping[str, Mapping[str, Measured]],
    controls: Sequence[tuple[Control, Measured]],
) -> list[Sheet]:
    """The methods under each group of checks, then the controls."""
    sheets = []
    for title, group in GROUPS.items():
        names = [n for n in group if all(n in row for row in rows.values())]
        columns = {"method": list(rows)}
        if "order" in names:
            columns["claims"] = [claims(methods[name]) for name in rows]
        columns |= {n: [cell(n, row[n]) for row in rows.values()] for n in names}
        if names:
            sheets.append(Sheet(title, list(columns), list(zip(*columns.values(), strict=True))))
    if controls:
        columns = ["check", "broken method", "measured", "allowed", "verdict"]
        body = []
        for control, result in controls:
            verdict = "caught" if result.verdict == "FAIL" else "MISSED"
            measured = cell(control.check, result), result.allowed
            body.append([control.check, control.name, *measured, verdict])
        sheets.append(Sheet("Controls", columns, body))
    return sheets


def claims(method: dvi.Method) -> str:
    """The properties that a method claims."""
    names = ("symmetric", "symplectic", "invertible")
    return ", ".join([f"order {method.order}", *(n for n in names if getattr(method, f"is_{n}"))])


def cell(check: str, result: Measured) -> str:
    """The verdict in words and the number."""
    if math.isnan(result.value):
        return result.verdict
    number = "0" if result.value == 0 else f"{result.value:{CHECKS[check].digits}}"
    if result.verdict == "not claimed":
        return f"not claimed ({number})"
    return f"{result.verdict} {number}"


def markdown(
    sheets: Sequence[Sheet], summary: str, failures: Sequence[tuple[str, str, Measured]]
) -> str:
    """The page, from the template `page.md`."""
    versions = ", ".join(f"{n} {version(n)}" for n in ("dvi-jax", "jax", "jaxlib", "numpy"))
    python = ".".join(platform.python_version_tuple()[:2])
    checks = {name for table in sheets for name in table.columns} & set(CHECKS)
    parts = [f"## {sheet.title}\n\n{markdown_table(sheet.columns, sheet.rows)}" for sheet in sheets]
    if failures:
        faults = [
            f"- {method}, {check}: {result.verdict}, allowed {result.allowed}. {result.detail}"
            for method, check, result in failures
        ]
        parts.append("\n".join(["## Failures\n", *faults]))
    template = Path(__file__).with_name("page.md").read_text(encoding="utf-8")
    return string.Template(template).substitute(
        title=TITLE,
        summary="\n".join(f"- {line}" for line in summary.splitlines()),
        versions=f"{versions}, Python {python}",
        tables="\n\n".join(parts),
        legend="\n".join(f"- **{n}**: {check.says}" for n, check in CHECKS.items() if n in checks),
    )


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table with these names of columns."""
    header, *body = ([cell.replace("|", "\\|") for cell in row] for row in (columns, *rows))
    lines = header, ["---"] * len(header), *body
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
