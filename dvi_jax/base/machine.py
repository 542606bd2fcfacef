"""The processors and the memory of this process, which limits the size of results."""

import contextlib
import functools
import os
from pathlib import Path

import jax

_CGROUPS = Path("/sys/fs/cgroup")


def results_memory() -> int | None:
    """Bytes of memory for results of this program, on all its devices; None: not known."""
    if jax.default_backend() != "cpu":
        return _devices_memory()
    machine = machine_memory()
    # The memory of the other hosts is not known here; they usually are machines of the same kind.
    return None if machine is None else machine * jax.process_count()


@functools.cache
def machine_memory() -> int | None:
    """Bytes of memory that this process may use: the memory of the machine, or the limit of a
    container or of a queueing system; None: not known."""
    sizes = _limits()
    with contextlib.suppress(AttributeError, ValueError, OSError):  # Windows has no sysconf
        sizes.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min(sizes, default=None)


def _limits() -> list[int]:
    """The limits of the control groups of this process (Linux): its own and those above it."""
    files = [_CGROUPS / "memory/memory.limit_in_bytes"]  # version 1
    limits: list[int] = []
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            if line.startswith("0::/"):  # version 2
                group = _CGROUPS / line.removeprefix("0::/")
                files += [folder / "memory.max" for folder in (group, *group.parents)]
        for file in files:
            with contextlib.suppress(OSError, ValueError):  # no such limit, or the word "max"
                limits.append(int(file.read_text()))
    return limits


@functools.cache
def _devices_memory() -> int | None:
    sizes = [(device.memory_stats() or {}).get("bytes_limit") for device in jax.devices()]
    # A sum over some of the devices would reject results that all of them can hold.
    return None if None in sizes else sum(filter(None, sizes))


def processors() -> int:
    """The number of processors that this process may use."""
    # A container or `taskset` may allow fewer than the machine has; only Linux reports that.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
