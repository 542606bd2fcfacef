"""The certificate as text: tables for the terminal, a Markdown page."""

import math
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import dvi_jax as dvi

from ..testing import CHECKS, Control, Measured

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
    out = Path(out)
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
        allowed = "a .md file that is new or a certificate, or a directory for one."
        raise ValueError(f"--out: {fault}\n  allowed: {allowed}")
    return page


class Table(NamedTuple):
    """A title, names of columns, rows of text."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


def tables(
    methods: Mapping[str, dvi.Method],
    rows: Mapping[str, Mapping[str, Measured]],
    controls: Sequence[tuple[Control, Measured]],
) -> list[Table]:
    """The methods under each group of checks, then the controls."""
    made = []
    for title, group in GROUPS.items():
        names = [n for n in group if all(n in row for row in rows.values())]
        columns = {"method": list(rows)}
        if "order" in names:
            columns["promises"] = [promises(methods[name]) for name in rows]
        columns |= {n: [cell(n, row[n]) for row in rows.values()] for n in names}
        if names:
            made.append(Table(title, list(columns), list(zip(*columns.values(), strict=True))))
    if controls:
        caught = {True: "caught", False: "MISSED"}
        body = [
            [c.check, c.name, cell(c.check, x), x.allowed, caught[x.verdict == "FAIL"]]
            for c, x in controls
        ]
        columns = ["check", "broken method", "measured", "allowed", "verdict"]
        made.append(Table("Controls", columns, body))
    return made


def promises(method: dvi.Method) -> str:
    """The properties that a method claims."""
    said = ("symmetric", "symplectic", "invertible")
    return ", ".join([f"order {method.order}", *(s for s in said if getattr(method, f"is_{s}"))])


def cell(check: str, measured: Measured) -> str:
    """The verdict in words and the number."""
    if math.isnan(measured.value):
        return measured.verdict
    number = "0" if measured.value == 0 else f"{measured.value:{CHECKS[check].digits}}"
    if measured.verdict == "not claimed":
        return f"not claimed ({number})"
    return f"{measured.verdict} {number}"


_PROBLEMS = """\
H is the Hamiltonian, W the disturbing force, ε its strength ([theory](theory.md)). Two problems,
a = 0.3 in both:

- coupled: H = (1 + |q|²)(1 + |p|²)/2 + a |p|² Σq, W = −(1 + |q|²) p + cos t. Not separable and not
  linear; the force damps and drives, and depends on q, p and t (ε = 0.2 where it is on). Of two
  degrees of freedom for order, symplecticity and reversal, of one for the rest.
- central: H = |p|²/2 + |q|²/2 + a |q|⁴/4, W = −q cos t, of two degrees of freedom.

The reference for orders is the Gauss method of order 16, whose own error is estimated and which the
tests compare with SciPy.\
"""

_OWN = """\
## Your own method

```python
import jax
jax.config.update("jax_enable_x64", True)
import dvi_jax as dvi
from dvi_jax.certify import certify

mine = dvi.Composition((0.2, 0.3, 0.3, 0.2), order=2)     # or an instance of your own dvi.Method
certificate = certify({"mine": mine})
print(certificate)                                        # a page such as this one
assert certificate.ok, certificate.failures
```

A method of the package is certified, and tested, by a line in `dvi_jax/testing/registry.py`.\
"""


def markdown(
    made: Sequence[Table], summary: str, failures: Sequence[tuple[str, str, Measured]]
) -> str:
    """The page: what was measured, the tables, the controls, what each check is."""
    versions = ", ".join(f"{n} {version(n)}" for n in ("dvi-jax", "jax", "jaxlib", "numpy"))
    python = ".".join(platform.python_version_tuple()[:2])
    shown = {name for table in made for name in table.columns} & set(CHECKS)
    parts = [
        TITLE,
        "Made by `dvi-jax certify --out FILE`. Methods are certified by measurement: each number "
        "below was measured on the method as it is shipped, and each check is shown to catch a "
        "method that is broken on purpose. *pass* and *FAIL*: the method promises the property and "
        "has it, or has it not. *not claimed*: it does not promise it; in brackets what was "
        "measured all the same. *NOT MEASURED* counts as a failure.",
        "\n".join(f"- {line}" for line in summary.splitlines()),
        f"With {versions}, Python {python}, in double precision. Digits of numbers near 1e-16 "
        "differ between machines.",
    ]
    for table in made:
        parts += [f"## {table.title}", _as_markdown(table)]
    if failures:
        said = [f"- {m}, {c}: {x.verdict}, allowed {x.allowed}. {x.detail}" for m, c, x in failures]
        parts += ["## Failures", "\n".join(said)]
    legend = [f"- **{n}**: {check.says}" for n, check in CHECKS.items() if n in shown]
    parts += ["## What each check is", _PROBLEMS, "\n".join(legend), _OWN]
    return "\n\n".join(parts) + "\n"


def _as_markdown(table: Table) -> str:
    rows = [table.columns, ["---"] * len(table.columns), *table.rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows
    )
