"""The modules that need python-flint."""

from collections.abc import Sequence
from typing import Any


def tools() -> tuple[Any, Any]:
    try:
        from . import checker, search
    except ImportError as error:
        raise ImportError(
            f"proofs need the package python-flint, but the import failed ({error}). Install it "
            'with pip install "dvi-jax[proof]" or pip install python-flint.'
        ) from error
    return checker, search


def combination(weights: Sequence[float]) -> str:
    """Σ w_k I_k as text."""
    terms = [
        (w, f"{abs(w):.4g} ".removeprefix("1 ") + f"I_{k}") for k, w in enumerate(weights) if w
    ]
    text = "".join(f" {'−' if w < 0 else '+'} {term}" for w, term in terms)
    return text.removeprefix(" + ").replace(" − ", "−", int(terms[0][0] < 0))
