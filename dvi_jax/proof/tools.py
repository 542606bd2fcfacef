"""The modules that need python-flint."""

from typing import Any


def tools() -> tuple[Any, Any]:
    try:
        from . import checker, search
    except ImportError as error:
        raise ImportError(
            "bound_drift computes with python-flint, which is not installed: "
            'pip install "dvi-jax[proof]", or pip install python-flint.'
        ) from error
    return checker, search
