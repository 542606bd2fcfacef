"""An older name of `dvi_jax.discover`, for its part about symmetries."""

from .discover import *  # noqa: F403
from .discover.symmetries import library as library
