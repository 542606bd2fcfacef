"""Progress of a fit."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.progress import bar_of, reporter


@dataclass(frozen=True)
class FitProgress:
    """Progress of a fit: `step` of the optimiser of at most `max_steps`, the `stage` and its
    `horizon`, the `loss`, the parameters `x` with their `names`, `seconds` since the start."""

    step: int
    max_steps: int
    stage: int
    horizon: float
    loss: float
    x: np.ndarray
    names: list[str]
    seconds: float


def _columns(p: FitProgress) -> dict[str, Any]:
    first = [f"{n} {v:.7g}" for n, v in zip(p.names[:3], p.x[:3], strict=True)]
    return {
        "description": f"fit, stage {p.stage + 1}",
        "total": p.max_steps,
        "completed": p.step,
        "steps": f"{p.step}/{p.max_steps}",
        "loss": f"loss {p.loss:.5g}",
        "params": ", ".join(first + ["…"] * (len(p.names) > 3)),
    }


def shown(progress: Any) -> Any:
    """A context whose value takes a `FitProgress`: the user's function, a bar's, or None."""
    return reporter(progress, bar_of("fit", ("steps", "loss", "params"), _columns))
