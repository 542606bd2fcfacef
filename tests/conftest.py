"""Double precision, no silent rank promotion, run-time checked annotations; long files first."""

import gc
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import compilation
import jax
import pytest
from jaxtyping import install_import_hook

compilation.set_flags()
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

MAPS = 20_000

# Modules that only the package itself calls. The public functions check their arguments themselves.
_CHECKED = [
    "dvi_jax.methods.step",
    "dvi_jax.integration.loop",
    "lanewise.linear",
    "lanewise.jaxprs.dependence",
]

with install_import_hook(_CHECKED, "beartype.beartype"):
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


SECONDS = {
    "test_notebooks": 200,
    "test_certify": 180,
    "test_fit": 150,
    "test_docs": 120,
    "test_fit_library": 100,
    "test_fit_real_data": 100,
    "test_lanewise_programs": 90,
    "test_lanewise_threads": 60,
    "test_library": 80,
    "test_docstrings": 60,
    "test_sweep_store": 80,
    "test_deviations": 80,
    "test_fit_statistics": 80,
    "test_systems": 70,
    "test_discovery": 70,
    "test_arithmetic": 70,
    "test_gradients": 70,
    "test_readme": 60,
    "test_methods": 50,
    "test_sections": 50,
    "test_lanewise": 40,
    "test_sweep_cluster": 40,
    "test_lobatto_pair": 40,
    "test_cli_sweep": 30,
    "test_paper": 30,
    "test_run": 30,
    "test_frequencies": 30,
    "test_speed_baseline": 30,
}
"""Processor seconds of the files that take longest, measured once; others follow by their tests."""


def in_parts(tests: Mapping[str, int], parts: int) -> list[list[str]]:
    """Files in parts that take about as long, given how many tests each has."""
    seconds = {file: SECONDS.get(file, count / 2) for file, count in tests.items()}
    found, totals = [[] for _ in range(parts)], [0.0] * parts
    for file in sorted(seconds, key=lambda file: (-seconds[file], file)):
        smallest = totals.index(min(totals))
        found[smallest].append(file)
        totals[smallest] += seconds[file]
    return found


def part_of(text: str) -> tuple[int, int]:
    """I and N of "I/N"."""
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise pytest.UsageError(
            f"--part must be I/N with I from 1 to N, such as 1/4, got {text!r}."
        )
    return int(found[1]), int(found[2])


def pytest_addoption(parser):
    parser.addoption(
        "--part",
        metavar="I/N",
        help="part I of N of the slow tests, whole files each, and no other",
    )


def pytest_configure(config):
    """xdist would begin with the files of many tests, and one worker end alone with a long file."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(config, items):
    """Files that take long before those that do not, so that all workers end at one time."""
    if chosen := config.getoption("--part"):
        part, parts = part_of(chosen)
        slow = [item for item in items if item.get_closest_marker("slow")]
        files = in_parts(Counter(item.path.stem for item in slow), parts)[part - 1]
        left_out = [item for item in items if item not in slow or item.path.stem not in files]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in slow if item.path.stem in files]
    tests = Counter(item.path for item in items)
    items.sort(key=lambda item: (-SECONDS.get(item.path.stem, 0), -tests[item.path]))
