"""The command line ``dvi-jax``: help and completion without JAX, work with it."""

from typing import TYPE_CHECKING, Any

from ._main import main as main

if TYPE_CHECKING:
    from ._app import app as app


def __getattr__(name: str) -> Any:
    """`app`, imported at its first use: `main` guards its imports against Ctrl-C."""
    if name == "app":
        from ._app import app

        return app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
