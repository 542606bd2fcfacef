"""Names that a shell completes, read from the source of the package: importing it imports JAX.

`tests/test_cli.py` compares them with the package.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def _names_in(file: str, pattern: str) -> tuple[str, ...]:
    source = Path(__file__).parent.parent / "dvi_jax" / file
    return tuple(re.findall(pattern, source.read_text(encoding="utf-8"), re.MULTILINE))


VERSION = _names_in("__init__.py", r'^__version__ = "(.*)"')[0]

SYSTEMS = tuple(", ".join(_names_in("systems/__init__.py", r"^        \*\((.+)\),$")).split(", "))
"""Systems of the library."""

METHODS = _names_in("testing/registry.py", r'^    "(\w+)": ')
"""Methods that are certified, as `dvi-jax certify --method` takes them."""

CHECKS = _names_in("testing/checks.py", r'^@check\(\s*"([\w-]+)"')
"""Checks of a certificate, as `dvi-jax certify --check` takes them."""

FILES = ("run", "sweep", "fit", "discover", "bound")
"""Kinds of TOML files."""

EXTRAS = {
    "cuda12": ("jax_cuda12_plugin",),
    "cuda13": ("jax_cuda13_plugin",),
    "distributed": ("distributed",),
    "bayes": ("numpyro",),
    "export": ("h5netcdf", "h5py", "pyarrow"),
    "proof": ("flint",),
    "explore": ("panel", "bokeh"),
    "ephemeris": ("jplephem", "skyfield_data"),
    "stellarator": ("qsc",),
    "fields": ("interpax",),
    "rings": ("at",),
    "interop": ("astropy", "diffrax", "rebound", "scipy"),
}
"""Extra of the package → modules that it brings."""


def completer(names: Sequence[str]) -> dict[str, Any]:
    """The arguments of an option of typer that takes one of these names, or none."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names if name.startswith(incomplete)]

    return {"autocompletion": complete, "show_default": False}
