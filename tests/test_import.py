"""What importing the package costs: it takes JAX and Equinox, and leaves the rest for later."""

import re
import subprocess
import sys
from pathlib import Path

import dvi_jax as dvi
from dvi_jax._namespaces import ALIASES

LATER = (
    "optax", "optimistix", "lineax", "matplotlib", "scipy", "xarray", "zarr", "rich", "typer",
    "numpyro", "distributed", "diffrax", "rebound", "astropy", "arviz", "jplephem", "sympy",
    "pydantic",
)  # fmt: skip
"""Each of these is imported by the function that needs it."""


def imported(code):
    found = f"{code}; import sys; print(*[m for m in {LATER!r} if m in sys.modules])"
    out = subprocess.run(
        [sys.executable, "-c", found], capture_output=True, text=True, check=False, timeout=120
    )
    assert out.returncode == 0, out.stderr
    return out.stdout.split()


def test_importing_takes_only_what_every_program_needs():
    assert imported("import dvi_jax, dvi_jax.systems") == []
    assert imported("import dvi_jax.plot") == ["matplotlib"]  # and so it would be seen
    assert "pydantic" in imported("import dvi_jax.run")


def test_every_alias_is_listed_and_means_its_name():
    page = (Path(__file__).parents[1] / "docs" / "migration.md").read_text(encoding="utf-8")
    table = page.split("## Aliases")[1].split("##")[0]
    rows = [line.split("|")[1:3] for line in table.splitlines() if line.startswith("| `")]
    listed = {
        alias: re.findall(r"`dvi\.(\w+)`", meant)[0]
        for aliases, meant in rows
        for alias in re.findall(r"`dvi\.(\w+)`", aliases)
    }
    assert listed == ALIASES
    for alias, name in ALIASES.items():
        assert getattr(dvi, alias) is getattr(dvi, name)


def test_the_command_line_knows_names_that_are_imported_late():
    code = """
from dvi_jax_cli.work.expressions import public
from dvi_jax.discover import AbstractBasis
assert {"Polynomials", "Radial"} <= public(AbstractBasis).keys()
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
