"""Packages that the extra brings, imported when they are needed."""

import importlib
from typing import Any

import dvi_jax as dvi

from ..systems import Problem


def needed(package: str, by: str) -> Any:
    """The module `package`. **Raises** `ImportError` with the line that installs it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        if error.name not in (None, package, package.partition(".")[0]):
            raise  # the package is installed, and something that it needs is not
        raise ImportError(
            f"{by} requires the package {package.partition('.')[0]}, which cannot be imported. "
            'Install it: pip install "dvi-jax[interop]".',
            name=package,
        ) from None


def expect(name: str, value: Any, kind: Any, called: str, hint: str = "") -> Any:
    """The value, of a kind that the message calls `called`. **Raises** `TypeError`."""
    if not isinstance(value, kind):
        seen = f"{value!r:.100} of type {type(value).__name__}"
        seen = f"the class {value.__name__}" if isinstance(value, type) else seen
        raise TypeError(f"{name} must be {called}, got {seen}.{' ' * bool(hint)}{hint}")
    return value


def system_of(what: Any) -> dvi.System:
    """The `System` itself, or that of a `Problem`. **Raises** `TypeError` for anything else."""
    hint = "For a continuous Hamiltonian H give dvi.System(dvi.discretise(H))."
    what = what.system if isinstance(what, Problem) else what
    return expect("system", what, dvi.System, "a problem of dvi_jax.systems or a dvi.System", hint)
