"""Double precision, no silent rank promotion, run-time checked annotations."""

from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

MAPS = 20_000

# Rooms whose callers are the package itself. The door checks what users give it, in its own words.
_CHECKED = ["_step", "_rollout", "engine.linear", "engine.dependence"]

with install_import_hook([f"dvi_jax.{room}" for room in _CHECKED], "beartype.beartype"):
    import dvi_jax  # noqa: F401  (the hook works on the first import)


@pytest.fixture(autouse=True, scope="module")
def no_more_programs_than_a_process_can_map():
    """Compiled programs map memory, of which Linux allows a process some 65 000 pieces."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > MAPS:
        jax.clear_caches()
