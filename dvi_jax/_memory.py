"""The memory that there is for results, so that more are refused before they are computed."""

import contextlib
import functools
import os
from pathlib import Path

import jax

_CGROUPS = Path("/sys/fs/cgroup")


def results_memory() -> int | None:
    """Bytes where JAX puts the results of this program, on all its devices; None: not known."""
    if jax.default_backend() != "cpu":
        return _devices_memory()
    machine = machine_memory()
    return None if machine is None else machine * jax.process_count()


@functools.cache
def machine_memory() -> int | None:
    """Bytes of memory that this process may have: those of the machine or of a limit that a
    container or a queueing system sets; None: not known."""
    found = _limits()
    with contextlib.suppress(AttributeError, ValueError, OSError):  # Windows has no sysconf
        found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min(found, default=None)


def _limits() -> list[int]:
    """The limits of the control groups of this process (Linux): its own and those above it."""
    files = [_CGROUPS / "memory/memory.limit_in_bytes"]  # version 1
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return []
    for line in lines:
        if line.startswith("0::/"):  # version 2
            own = _CGROUPS / line.removeprefix("0::/")
            files += [folder / "memory.max" for folder in (own, *own.parents)]
    found = []
    for file in files:
        try:
            found.append(int(file.read_text()))
        except (OSError, ValueError):  # no such limit, or the word "max"
            continue
    return found


@functools.cache
def _devices_memory() -> int | None:
    limits = [(device.memory_stats() or {}).get("bytes_limit") for device in jax.devices()]
    known = [n for n in limits if n is not None]
    return sum(known) if known and len(known) == len(limits) else None
