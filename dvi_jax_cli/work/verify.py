"""The check of a certificate of `bound_drift`."""

import json
import runpy
from pathlib import Path
from typing import Any

CHECKER = Path(__file__).parents[2] / "dvi_jax" / "proof" / "checker.py"


def verify_certificate(path: Path) -> tuple[dict[str, Any], str]:
    """What a certificate proves, and why it proves nothing, or "".

    **Raises** `ModuleNotFoundError` without python-flint.
    """
    exact = runpy.run_path(str(CHECKER))  # as a file: the package itself would import JAX
    try:
        statement = exact["check"](json.loads(path.read_text(encoding="utf-8")))
    except (exact["Failure"], *exact["FORMAT_ERRORS"]) as error:
        return {"certificate": str(path), "proved": None}, f"not proved: {error}"
    return {"certificate": str(path), "proved": statement}, ""
