"""Keywords that `fit`, `sample` and `identify` share, as types of ``**settings``."""

from collections.abc import Callable, Mapping
from typing import Any, TypedDict

from jaxtyping import PyTree

from .losses import Likelihood, Loss
from .run import FitProgress


class LossSettings(TypedDict, total=False):
    """What is minimised, or the density that is sampled."""

    bounds: PyTree | None
    priors: PyTree | None
    loss: Loss | Likelihood


class OptimiserSettings(LossSettings, total=False):
    """The same, and how a fit ends, what is checked and what is shown."""

    max_steps: int | None
    tolerance: float
    check_units: bool
    check_curvature: bool
    progress: bool | Callable[[FitProgress], None] | None


class FitSettings(OptimiserSettings, total=False):
    """The same, and the arcs that optax draws for a step."""

    batch: int | None
    seed: int


class SampleSettings(LossSettings, total=False):
    """The loss, and the sampler."""

    gradient: str
    target_accept: float
    max_tree_depth: int
    explore: int
    progress: bool | None


def select(settings: Mapping[str, Any], kind: type) -> dict[str, Any]:
    """Those of the keywords that a `TypedDict` has."""
    return {name: settings[name] for name in kind.__annotations__ if name in settings}
