"""Packages that the extra brings, imported when they are needed."""

import importlib
from typing import Any

import dvi_jax as dvi

from ..base.checks import instance
from ..problem.system import without_jumps
from ..systems import Problem


def require(package: str, user: str, extra: str = "interop") -> Any:
    """The module `package`. **Raises** `ImportError` with the line that installs it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        if error.name not in (None, package, package.partition(".")[0]):
            raise  # the package is installed, and something that it needs is not
        raise ImportError(
            f'{user} requires {package.partition(".")[0]}: pip install "dvi-jax[{extra}]".',
            name=package,
        ) from None


def system_of(problem: Any) -> dvi.System:
    """The `System` itself, or that of a `Problem`. **Raises** `TypeError` for anything else."""
    hint = "For a continuous Hamiltonian H give dvi.System(dvi.discretise(H))."
    problem = without_jumps(problem).system if isinstance(problem, Problem) else problem
    kinds = "a problem of dvi_jax.systems or a dvi.System"
    return instance("system", problem, dvi.System, kinds, hint)
