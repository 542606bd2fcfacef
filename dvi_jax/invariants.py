"""An older name of `dvi_jax.discover`, for its part about invariants."""

from .discover import *  # noqa: F403
