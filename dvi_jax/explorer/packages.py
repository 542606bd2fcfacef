"""Panel and bokeh, imported when a page is shown."""

import importlib
from typing import Any


def require_panel() -> Any:
    """The module panel. **Raises** `ImportError` with the line that installs it."""
    try:
        importlib.import_module("bokeh")
        return importlib.import_module("panel")
    except ImportError as error:
        if error.name not in ("panel", "bokeh"):
            raise  # it is installed, and something that it needs is not
        raise ImportError(
            'explore requires panel and bokeh: pip install "dvi-jax[explore]".', name=error.name
        ) from None
