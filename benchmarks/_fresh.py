"""A measurement that needs a process of its own: `speed.py` starts this file.

    python _fresh.py '{"measure": "first_call", "cores": [0], ...}'

It prints a number. The modules are imported and JAX has started before anything is measured.
"""

import ctypes
import json
import os
import re
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

if __name__ == "__main__":  # the cores that JAX finds when it starts
    given = json.loads(sys.argv[1])
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, given.pop("cores"))

import jax
import jax.numpy as jnp
from _workloads import WORKLOADS, batched, last_state, loss_of


def first_call(workload: str, lanes: int, steps: int, axis: int, gradient: bool) -> float:
    """Seconds until the first result of a batch, or of a gradient: tracing, compilation, run."""
    w = WORKLOADS[workload]
    inputs = jax.block_until_ready(w.inputs(lanes, axis))
    began = time.perf_counter()
    if gradient:
        f = jax.jit(jax.grad(loss_of(w, steps, axis=axis), argnums=(0, 1)))
    else:
        f = jax.jit(batched(last_state(w, steps), axis))
    jax.block_until_ready(f(*inputs))
    return time.perf_counter() - began


def wall_time(workload: str, lanes: int, steps: int, axis: int, rounds: int) -> float:
    """Median seconds of a batch, of the wall clock, after the first call."""
    w = WORKLOADS[workload]
    inputs = w.inputs(lanes, axis)
    f = jax.jit(batched(last_state(w, steps), axis))
    jax.block_until_ready(f(*inputs))
    taken = []
    for _ in range(rounds):
        began = time.perf_counter()
        jax.block_until_ready(f(*inputs))
        taken.append(time.perf_counter() - began)
    return statistics.median(taken)


def memory(workload: str, lanes: int, steps: int, axis: int) -> float:
    """Peak resident memory of a batch over that of its inputs and outputs, after the first call.

    Counted from the resident memory without either; Linux only.
    """
    w = WORKLOADS[workload]
    inputs = jax.block_until_ready(w.inputs(lanes, axis))
    f = jax.jit(batched(last_state(w, steps), axis))
    outputs = jax.block_until_ready(f(*inputs))
    sizes = [sum(x.nbytes for x in jax.tree.leaves(of)) for of in (inputs, outputs)]
    del outputs
    ctypes.CDLL(None).malloc_trim(0)
    before = _resident("VmRSS") - sizes[0]
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from here
    jax.block_until_ready(f(*inputs))
    return (_resident("VmHWM") - before) / sum(sizes)


def _resident(which: str) -> int:
    """Bytes, as Linux counts them: VmRSS now, VmHWM at most."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(re.findall(rf"{which}:\s+(\d+) kB", status)[0])


MEASURES: dict[str, Callable[..., float]] = {f.__name__: f for f in (first_call, wall_time, memory)}

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.block_until_ready(jnp.ones(2) + 1)
    print(MEASURES[given.pop("measure")](**given))
