"""Packages that the extra brings, imported when they are needed."""

import importlib
from typing import Any

import dvi_jax as dvi

from ..systems import Problem


def require(package: str, user: str) -> Any:
    """The module `package`. **Raises** `ImportError` with the line that installs it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        if error.name not in (None, package, package.partition(".")[0]):
            raise  # the package is installed, and something that it needs is not
        raise ImportError(
            f"{user} requires the package {package.partition('.')[0]}, which cannot be imported. "
            'Install it: pip install "dvi-jax[interop]".',
            name=package,
        ) from None


def expect(name: str, value: Any, kind: Any, description: str, hint: str = "") -> Any:
    """The value, of a kind that the message calls `description`. **Raises** `TypeError`."""
    if not isinstance(value, kind):
        text = f"{value!r:.100} of type {type(value).__name__}"
        text = f"the class {value.__name__}" if isinstance(value, type) else text
        raise TypeError(f"{name} must be {description}, got {text}.{' ' * bool(hint)}{hint}")
    return value


def system_of(problem: Any) -> dvi.System:
    """The `System` itself, or that of a `Problem`. **Raises** `TypeError` for anything else."""
    hint = "For a continuous Hamiltonian H give dvi.System(dvi.discretise(H))."
    problem = problem.system if isinstance(problem, Problem) else problem
    return expect(
        "system", problem, dvi.System, "a problem of dvi_jax.systems or a dvi.System", hint
    )
