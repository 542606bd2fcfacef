"""Double precision, no silent rank promotion, run-time checked annotations."""

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

# Rooms whose callers are the package itself. The door checks what users give it, in its own words.
_CHECKED = ["_step", "_rollout", "engine.linear", "engine.dependence"]

with install_import_hook([f"dvi_jax.{room}" for room in _CHECKED], "beartype.beartype"):
    import dvi_jax  # noqa: F401  (the hook works on the first import)
