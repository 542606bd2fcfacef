"""Double precision, no silent rank promotion, run-time checked annotations; long files first."""

import gc
from collections import Counter
from pathlib import Path

import compilation
import jax
import pytest
from jaxtyping import install_import_hook

compilation.set_flags()
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

MAPS = 20_000

# Rooms whose callers are the package itself. The door checks what users give it, in its own words.
_CHECKED = ["_step", "_rollout", "engine.linear", "engine.dependence"]

with install_import_hook([f"dvi_jax.{room}" for room in _CHECKED], "beartype.beartype"):
    import dvi_jax  # noqa: F401  (the hook works on the first import)

# Tracing makes small objects by the million, most of which stay: up to an eighth of the processor
# time of a file went into looking among them for cycles.
gc.collect()
gc.freeze()
gc.set_threshold(50_000, 10, 10)


@pytest.fixture(autouse=True, scope="module")
def no_more_programs_than_a_process_can_map():
    """Compiled programs map memory, of which Linux allows a process some 65 000 pieces."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > MAPS:
        jax.clear_caches()


FIRST = [
    "test_fit_real_data.py",
    "test_notebooks.py",
    "test_lanes_property.py",
    "test_lanes_runs.py",
    "test_sweep_store.py",
    "test_speed_baseline.py",
    "test_fit_statistics.py",
    "test_docs.py",
]
"""Files of minutes and few tests, the longest first."""


def pytest_configure(config):
    """xdist would begin with the files of many tests: a worker ended with a century, alone."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items):
    """Files that take long before those that do not, so that all workers end at one time."""
    tests = Counter(item.path for item in items)
    rank = {name: i for i, name in enumerate(FIRST)}
    items.sort(key=lambda item: (rank.get(item.path.name, len(FIRST)), -tests[item.path]))
