"""Packages of `dvi_jax` as attributes, imported at their first use."""

import importlib
import sys
from types import ModuleType

# Together they import matplotlib, pydantic and other libraries, which most programs do not need.
NAMESPACES = {
    **{name: name for name in ("certify", "interop", "paper", "plot", "run", "systems", "testing")},
    # The functions `dvi.sweep` and `dvi.fit` have the names of their packages.
    "fitting": "fit",
    "sweeps": "sweep",
}
"""Attribute of `dvi_jax` → the package that it stands for."""


def namespace(name: str) -> ModuleType:
    """`dvi_jax.__getattr__`. **Raises** `AttributeError` for an unknown name."""
    if name not in NAMESPACES:
        raise AttributeError(f"module 'dvi_jax' has no attribute {name!r}", name=name)
    return importlib.import_module(f"dvi_jax.{NAMESPACES[name]}")


def names() -> list[str]:
    """`dvi_jax.__dir__`."""
    return sorted({*vars(sys.modules["dvi_jax"]), *NAMESPACES})
