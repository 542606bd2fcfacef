"""The processors and the memory of this process, which limits the size of results."""

import contextlib
import functools
import os
from pathlib import Path

import jax

from lanewise.jaxprs.jaxapi import backends_are_initialized

_CGROUPS = Path("/sys/fs/cgroup")

_state = {"is_fork": False}


def _after_fork() -> None:
    # A child of a process in which JAX has not started may start it.
    _state["is_fork"] = backends_are_initialized()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def refuse_fork() -> None:
    """**Raises** `RuntimeError` in a process that was forked after JAX had started: the threads of
    JAX do not exist there, and the first compilation waits for them without end."""
    if _state["is_fork"]:
        raise RuntimeError(
            "this process was made by fork after JAX had started, so that JAX would not return. "
            "Start processes afresh: multiprocessing.get_context('spawn'), or mp_context= of "
            "ProcessPoolExecutor. Mostly none are needed: jax.vmap and dvi.sweep use all "
            "processors, dvi.sweep(client=...) a cluster."
        )


def results_memory() -> int | None:
    """Bytes of memory for results of this program, on all its devices; None: not known."""
    if jax.default_backend() != "cpu":
        return _devices_memory()
    machine = machine_memory()
    # The memory of the other hosts is not known here; they usually are machines of the same kind.
    return None if machine is None else machine * jax.process_count()


def machine_memory() -> int | None:
    """Bytes of memory that this process may use: the memory of the machine, or the limit of a
    container, of a queueing system or of the process (``ulimit -v``); None: not known."""
    sizes = [*_constant_limits(), *_process_limits()]
    return min(sizes, default=None)


@functools.cache
def _constant_limits() -> list[int]:
    sizes = _limits()
    with contextlib.suppress(AttributeError, ValueError, OSError):  # Windows has no sysconf
        sizes.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return sizes


def _process_limits() -> list[int]:
    """The unused part of the limits of this process, which a program may change."""
    try:
        import resource
    except ImportError:  # on Windows
        return []
    # The address space, and the data: places in statm. Programs of XLA and their threads take some
    # gigabytes of address space, so that what is in use counts.
    limits = {0: resource.getrlimit(resource.RLIMIT_AS)[0]}
    limits[5] = resource.getrlimit(resource.RLIMIT_DATA)[0]
    limits = {place: limit for place, limit in limits.items() if limit != resource.RLIM_INFINITY}
    # Without statm, as on macOS, the limits count whole.
    pages = [0] * 6
    if limits:
        with contextlib.suppress(OSError, ValueError):  # Linux has it
            pages = [int(x) for x in Path("/proc/self/statm").read_text().split()]
    page = resource.getpagesize()
    return [max(limit - pages[place] * page, 0) for place, limit in limits.items()]


def _limits() -> list[int]:
    """The limits of the control groups of this process (Linux): its own and those above it."""
    files = [_CGROUPS / "memory/memory.limit_in_bytes"]
    limits: list[int] = []
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, names, group = line.split(":", 2)
            if not names:  # version 2
                folder = _CGROUPS / group.strip("/")
                files += [part / "memory.max" for part in (folder, *folder.parents)]
            elif "memory" in names.split(","):  # version 1
                folder = _CGROUPS / "memory" / group.strip("/")
                files += [part / "memory.limit_in_bytes" for part in (folder, *folder.parents)]
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
