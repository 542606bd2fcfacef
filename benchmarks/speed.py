"""Speed of the package relative to hand-written C, and its other speed targets, in one command.

    python benchmarks/speed.py [--rows PATTERN] [--out DIR] [--check FILE | --write FILE]
    python benchmarks/speed.py --scaling --out DIR

Each row of the table has a target, the measured value, its quartiles and "missed" where the target
is missed. A row with the unit × is a ratio of processor times, both sides on one thread, pinned to
one core. In each round the two sides run once, in random order; the median of the ratios of all
rounds is shown. Where the ratio of wall-clock times differs by more than WALL_DIFFERS, it is shown
too.

- The C side is baseline.c, compiled here for this machine: arrays with the trajectories last, a few
  vectors of them in registers over the whole time loop, outputs into memory that is already there;
  saved states into new memory on each call, as the package's: on virtual machines new pages of
  memory can take most of the time of both. Implicit steps: explicit guess, then the least number of
  Newton iterations whose last correction is below √ε (it is measured, and is in the report).
- The package's side is what a user writes, `jax.jit(jax.vmap(one))`, with no flags and no compiler
  options; `one` calls `dvi.integrate` with `throw=False` and returns states and status. The
  trajectories are on the first axis, or on the last with `--axis -1`.
- Gradients and forward mode are relative to their own forward pass; 10⁶ trajectories to 65 536, per
  trajectory. The memory of a gradient is what the compiler reports at two numbers of steps, in
  states (q, p) of a trajectory per step: backpropagation that stores every step needs at least 1.
- First calls (tracing, compilation, run), two cores, and the memory of a batch are measured in
  fresh processes, see _fresh.py: with DVI_JAX_CACHE=off, and "from disk", which is the second
  process with DVI_JAX_CACHE set to a new folder.

`--check FILE` compares the ratios with those of a file that `--write FILE` wrote, and exits with
status 1 if one has grown by more than `--tolerance`, and still has when measured again.
"""

import argparse
import fnmatch
import functools
import json
import math
import os
import platform
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from _baseline import Baseline, NoCompilerError
from _workloads import (
    EPSILON,
    SAVE_EVERY,
    WORKLOADS,
    Workload,
    batched,
    chain,
    last_and_invariants,
    last_state,
    linear_force,
    loss_of,
    saved_states,
)

import dvi_jax as dvi

LEAST_ROUNDS = 3
WALL_DIFFERS = 1.2
LONGEST_PROCESS = 300.0
"""Seconds after which a fresh process is stopped, and its row has failed."""


# Timing


def first_call(f: Callable[[], Any]) -> float:
    """Seconds that f takes, compilation included."""
    began = time.perf_counter()
    jax.block_until_ready(f())
    return time.perf_counter() - began


class Times(NamedTuple):
    """Seconds of each call in each round, shape (rounds, calls): of the processor, of the wall."""

    processor: np.ndarray
    wall: np.ndarray


class Clock:
    """Interleaved timing: rounds in random order, within a budget of seconds for a row."""

    def __init__(self, rounds: int, budget: float, seed: int = 0):
        self.rounds, self.budget = rounds, budget
        self._random = random.Random(seed)

    def times(self, *calls: Callable[[], Any]) -> Times:
        """Each of the calls once in each round, in random order, after one call to warm up."""
        rounds, began = [], time.perf_counter()
        for call in calls:
            jax.block_until_ready(call())
        while len(rounds) < self.rounds:
            taken = np.zeros((2, len(calls)))
            order = list(range(len(calls)))
            self._random.shuffle(order)
            for i in order:
                start = time.process_time(), time.perf_counter()
                jax.block_until_ready(calls[i]())
                taken[:, i] = time.process_time() - start[0], time.perf_counter() - start[1]
            rounds.append(taken)
            spent = time.perf_counter() - began
            if len(rounds) >= LEAST_ROUNDS and spent > self.budget:
                break
        return Times(*np.stack(rounds, axis=1))


class Measured(NamedTuple):
    """Samples of a row's value, and details for the report."""

    samples: list[float]
    details: dict[str, Any]

    def __float__(self):
        return float(statistics.median(self.samples))


def ratio(times: Times, work: tuple[float, float] = (1.0, 1.0), **details) -> Measured:
    """Ratio of the first call's time to the second's, each divided by its work."""
    by_work = [x / np.array(work) for x in times]
    samples, wall = (x[:, 0] / x[:, 1] for x in by_work)
    seconds = np.median(times.processor, axis=0)
    details |= {
        "seconds": seconds[0],
        "reference_seconds": seconds[1],
        "wall_ratio": float(np.median(wall)),
        "rounds": len(samples),
    }
    return Measured([float(x) for x in samples], details)


class Bench:
    """A clock, the C library, the axis of the trajectories and the cores: shared by the rows."""

    def __init__(
        self,
        clock: Clock,
        axis: int = 0,
        cores: tuple[int, ...] = (0,),
        baseline: Baseline | None = None,
    ):
        self.clock, self.axis, self.cores = clock, axis, cores
        self.baseline = Baseline() if baseline is None else baseline

    def against_c(self, f, inputs, c_run, **details) -> Measured:
        """Time of the jitted f over that of the kernel, and the first call of f."""
        f = jax.jit(f)
        first = first_call(lambda: f(*inputs))
        times = self.clock.times(lambda: f(*inputs), c_run.timed)
        return ratio(times, first_call_seconds=first, **details)

    def fresh(self, measure: str, cores: int = 1, cache: str = "off", **settings) -> float:
        """A number that _fresh.py measures in a process of its own."""
        if cores > len(self.cores):
            raise RuntimeError(f"this process may use {len(self.cores)} cores, not {cores}.")
        file = Path(__file__).with_name("_fresh.py")
        given = {"measure": measure, "cores": self.cores[-cores:], "axis": self.axis, **settings}
        ignored = ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR")
        environment = {k: v for k, v in os.environ.items() if k not in ignored}
        environment |= {"JAX_PLATFORMS": "cpu", "DVI_JAX_CACHE": cache}
        done = subprocess.run(
            [sys.executable, str(file), json.dumps(given)],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=LONGEST_PROCESS,
        )
        if done.returncode:
            raise RuntimeError(f"{measure} failed in its process: {done.stderr[-400:]}")
        return float(done.stdout.splitlines()[-1])

    def samples(self, one: Callable[[], float]) -> list[float]:
        """At most LEAST_ROUNDS numbers, fewer where they take more than twice the budget."""
        found, began = [one()], time.perf_counter()
        while len(found) < LEAST_ROUNDS and time.perf_counter() - began < 2 * self.clock.budget:
            found.append(one())
        return found


# Rows


class Row(NamedTuple):
    """A line of the table: its target (None: none), an upper limit unless `at_least`."""

    name: str
    target: float | None
    measure: Callable[[Bench], Measured]
    unit: str = "×"
    at_least: bool = False


def batch_row(bench: Bench, name: str, lanes: int, steps: int, what: str = "final") -> Measured:
    """A batch against C: to its last state, with two invariants, or with saved states."""
    w = WORKLOADS[name]
    of_package = {"final": last_state, "invariants": last_and_invariants, "saved": saved_states}
    run, details = c_run(bench.baseline, w, w.start(lanes), steps, what)
    f = batched(of_package[what](w, steps), bench.axis)
    inputs = w.inputs(lanes, bench.axis)
    return bench.against_c(f, inputs, run, lanes=lanes, steps=steps, **details)


def one_row(bench: Bench, name: str, steps: int) -> Measured:
    """One trajectory against scalar C."""
    w = WORKLOADS[name]
    run, details = c_run(bench.baseline, w, w.start(), steps)
    inputs = [jnp.asarray(x) for x in w.start()]
    return bench.against_c(last_state(w, steps), inputs, run, steps=steps, **details)


def last_axis_row(bench: Bench, name: str, lanes: int, steps: int) -> Measured:
    """As `batch_row`, with the trajectories on the last axis, as in C."""
    w = WORKLOADS[name]
    run, details = c_run(bench.baseline, w, w.start(lanes), steps)
    f = batched(last_state(w, steps))
    return bench.against_c(f, w.inputs(lanes, -1), run, lanes=lanes, steps=steps, **details)


def c_run(baseline: Baseline, w: Workload, start, steps: int, what: str = "final"):
    """The run of C, with as many iterations as round-off takes, and details of these."""
    common = {"h": w.h, "steps": steps, "epsilon": EPSILON}
    if what == "invariants":
        return baseline.streamed(w.kernel, *start, **common), {}
    if what == "saved":
        return baseline.saved(w.kernel, *start, every=SAVE_EVERY, **common), {}
    if w.is_explicit:
        return baseline.final(w.kernel, *start, **common), {}
    iterations, correction = baseline.iterations_needed(w.kernel, *start, **common)
    run = baseline.implicit(w.kernel, *start, iterations=iterations, **common)
    return run, {"c_iterations": iterations, "c_last_correction": correction}


def gradient_row(bench: Bench, name: str, lanes: int, steps: int) -> Measured:
    """The reverse gradient of a final-state loss over its own forward pass."""
    w = WORKLOADS[name]
    q0, p0 = w.inputs(lanes, bench.axis)
    loss = loss_of(w, steps, axis=bench.axis)
    forward, backward = jax.jit(loss), jax.jit(jax.grad(loss, argnums=(0, 1)))
    first = first_call(lambda: backward(q0, p0))
    times = bench.clock.times(lambda: backward(q0, p0), lambda: forward(q0, p0))
    return ratio(times, first_call_seconds=first, lanes=lanes, steps=steps)


def temporary_bytes(f, *inputs) -> int:
    """The memory in addition to inputs and outputs that the compiled f requires."""
    analysis = jax.jit(f).lower(*inputs).compile().memory_analysis()
    if analysis is None:
        raise RuntimeError("this backend does not report how much memory a program needs.")
    return int(analysis.temp_size_in_bytes)


def gradient_memory_row(
    bench: Bench, name: str, lanes: int, steps: tuple[int, int], adjoint=None
) -> Measured:
    """Growth of a gradient's memory with the number of steps: states of a trajectory per step."""
    w = WORKLOADS[name]
    q0, p0 = w.inputs(lanes, bench.axis)
    few, many = (
        temporary_bytes(jax.grad(loss_of(w, count, adjoint, bench.axis), argnums=(0, 1)), q0, p0)
        for count in steps
    )
    state = 2 * w.n * lanes * q0.dtype.itemsize
    growth = (many - few) / (steps[1] - steps[0]) / state
    return Measured([growth], {"lanes": lanes, "steps": steps, "bytes": (few, many)})


def forward_mode_row(bench: Bench, name: str, lanes: int, steps: int) -> Measured:
    """State and its derivative in ε over the state alone."""
    w, axis = WORKLOADS[name], bench.axis
    q0, p0 = w.inputs(lanes, axis)
    final = jax.vmap(last_state(w, steps), in_axes=(axis, axis, None), out_axes=axis)

    def derivative(q0, p0, epsilon):
        return jax.jvp(lambda e: final(q0, p0, e), (epsilon,), (jnp.ones_like(epsilon),))

    epsilon = jnp.asarray(EPSILON)
    alone, both = jax.jit(final), jax.jit(derivative)
    first = first_call(lambda: both(q0, p0, epsilon))
    times = bench.clock.times(lambda: both(q0, p0, epsilon), lambda: alone(q0, p0, epsilon))
    return ratio(times, first_call_seconds=first, lanes=lanes, steps=steps)


def million_row(bench: Bench, name: str, lanes: tuple[int, int], steps: int) -> Measured:
    """Time per trajectory of many trajectories over that of fewer."""
    w = WORKLOADS[name]
    f = jax.jit(batched(last_state(w, steps), bench.axis))
    starts = [w.inputs(count, bench.axis) for count in lanes]
    times = bench.clock.times(*(functools.partial(f, *start) for start in starts))
    return ratio(times, work=lanes, lanes=lanes, steps=steps)


def again_row(bench: Bench, name: str, steps: int, calls: int = 10) -> Measured:
    """Milliseconds of a call of `integrate`, not under jit, that has been made before."""
    w = WORKLOADS[name]
    q0, p0 = w.start()
    settings = {"h": w.h, "num_steps": steps, "epsilon": EPSILON, "args": w.args}

    def again():
        return [dvi.integrate(w.system, q0, p0, **settings).qs for _ in range(calls)]

    taken = bench.clock.times(again).processor[:, 0] / calls * 1e3
    return Measured([float(x) for x in taken], {"calls": calls, "steps": steps})


def first_call_row(
    bench: Bench, name: str, lanes: int, steps: int, gradient: bool = False, *, on_disk: bool
) -> Measured:
    """Seconds of a first call in a fresh process."""
    details = {"lanes": lanes, "steps": steps}
    settings = {"workload": name, "gradient": gradient, **details}
    if not on_disk:
        return Measured(bench.samples(lambda: bench.fresh("first_call", **settings)), details)
    with tempfile.TemporaryDirectory(prefix="dvi_jax_cache_") as folder:
        call = functools.partial(bench.fresh, "first_call", cache=folder, **settings)
        details["filling_seconds"] = call()
        return Measured(bench.samples(call), details)


def cores_row(bench: Bench, name: str, lanes: int, steps: int, rounds: int = 7) -> Measured:
    """Wall-clock time of a batch on one core over that on two, each in processes of its own."""
    settings = {"workload": name, "lanes": lanes, "steps": steps, "rounds": rounds}

    def sample():
        one, two = (bench.fresh("wall_time", cores=cores, **settings) for cores in (1, 2))
        return one / two

    return Measured(bench.samples(sample), {"lanes": lanes, "steps": steps})


def memory_row(bench: Bench, name: str, lanes: int, steps: int) -> Measured:
    """Peak resident memory of a batch over that of its inputs and outputs."""
    settings = {"workload": name, "lanes": lanes, "steps": steps}
    return Measured(bench.samples(lambda: bench.fresh("memory", **settings)), settings)


def table() -> list[Row]:
    """The rows with their targets; steps such that the C side takes some milliseconds."""
    rows: list[Row] = []

    def add(title, target, measure, unit="×", at_least=False, /, **settings):
        rows.append(Row(title, target, functools.partial(measure, **settings), unit, at_least))

    of: dict[str, Any]
    many: dict[str, Any] = {"lanes": 65536}
    for lanes, steps in ((1024, 8000), (8192, 1000), (65536, 200)):
        of = {"name": "kepler", "lanes": lanes, "steps": steps}
        add(f"kepler, {lanes} trajectories", 1.3, batch_row, **of)
    add("kepler, last axis", 1.3, last_axis_row, name="kepler", steps=200, **many)
    add("oscillator", 1.3, batch_row, name="oscillator", steps=1000, **many)
    for what, title in (("invariants", "two invariants"), ("saved", "every 10th step saved")):
        for name, steps in (("kepler", 200), ("oscillator", 500)):
            add(f"{name}, {title}", 1.5, batch_row, name=name, steps=steps, what=what, **many)

    for name, title, lanes, steps, target in (
        ("product", "n = 1", 65536, 200, 1.5),
        ("pendulum", "double pendulum", 65536, 40, 2.0),
        ("chain2", "chain, n = 2", 65536, 60, 1.5),
        ("chain4", "chain, n = 4", 8192, 100, 1.5),
        ("web10", "dense, n = 10", 1024, 100, 1.5),
        ("chain10", "tridiagonal, n = 10", 1024, 200, None),
    ):
        add(f"implicit, {title}", target, batch_row, name=name, lanes=lanes, steps=steps)
    for name, title in (("pendulum_gauss", "GaussLegendre(2)"), ("pendulum_yoshida", "Yoshida(4)")):
        add(f"double pendulum, {title}", 2.0, batch_row, name=name, lanes=16384, steps=40)
    add("charged particle in a mirror", 2.0, batch_row, name="mirror", steps=200, **many)
    add("charged particle in a mirror, Boris", 1.5, batch_row, name="boris", steps=200, **many)

    add("one trajectory, kepler", 1.2, one_row, name="kepler", steps=400_000)
    for name, title in (("product", "n = 1"), ("pendulum", "double pendulum"), ("chain2", "chain")):
        add(f"one trajectory, implicit, {title}", 1.5, one_row, name=name, steps=100_000)

    for name, lanes, steps in (
        ("kepler", 64, 3000),
        ("kepler", 1024, 300),
        ("kepler", 65536, 20),
        ("chain2", 512, 100),
    ):
        title = f"reverse gradient, {name}, {lanes} trajectories"
        add(title, 2.5, gradient_row, name=name, lanes=lanes, steps=steps)
    for name, lanes, steps in (("kepler", 1024, 300), ("chain2", 512, 100)):
        add(f"forward mode, {name}", 2.0, forward_mode_row, name=name, lanes=lanes, steps=steps)
        of = {"name": name, "lanes": 16, "steps": (2000, 20_000)}
        add(f"memory of a gradient, {name}", 0.02, gradient_memory_row, "states/step", **of)
    of = {"name": "kepler", "lanes": (1_000_000, 65536), "steps": 100}
    add("kepler, 10⁶ trajectories over 65536", 1.3, million_row, **of)
    of = {"name": "kepler", "steps": 2000, **many}
    add("two cores, kepler", 1.8, cores_row, "× faster", True, **of)
    of = {"name": "kepler", "lanes": 1_000_000, "steps": 20}
    add("memory, 10⁶ trajectories", 1.1, memory_row, "× inputs and outputs", **of)
    add("integrate, ten steps again", 0.4, again_row, "ms", name="kepler", steps=10)
    for on_disk, start in ((False, "first call"), (True, "first call, from disk")):
        for title, targets, name, lanes, steps, gradient in (
            ("kepler", (0.35, 0.15), "kepler", 1024, 100, False),
            ("kepler, reverse gradient", (0.8, 0.35), "kepler", 1024, 100, True),
            ("GaussLegendre(2)", (1.0, 0.4), "pendulum_gauss", 1024, 100, False),
            ("KahanLi(8)", (1.0, 0.4), "pendulum_kahan_li", 1024, 100, False),
            ("8 bodies", (1.5, None), "bodies", 1024, 100, False),
            ("chain, n = 1000", (2.0, None), "chain1000", 1, 10, False),
            ("chain, n = 1000, 64 trajectories", (2.0, None), "chain1000", 64, 10, False),
        ):
            of = {"name": name, "lanes": lanes, "steps": steps, "gradient": gradient}
            title = f"{start}: {title}"
            add(title, targets[on_disk], first_call_row, "s", on_disk=on_disk, **of)
    return rows


def chosen(patterns: list[str] | None) -> list[Row]:
    """The rows whose name contains one of the patterns (* and ? as in a shell)."""
    rows = table()
    if not patterns:
        return rows
    for pattern in patterns:
        if not any(fnmatch.fnmatch(row.name, f"*{pattern}*") for row in rows):
            names = "\n  ".join(row.name for row in rows)
            raise SystemExit(f"no row matches {pattern!r}; there are\n  {names}")
    return [row for row in rows if any(fnmatch.fnmatch(row.name, f"*{p}*") for p in patterns)]


def measured(row: Row, bench: Bench) -> dict[str, Any]:
    """One row as it goes into the report; an error is a result too."""
    base = {"row": row.name, "unit": row.unit, "target": row.target, "at_least": row.at_least}
    began = time.perf_counter()
    try:
        result = row.measure(bench)
    except Exception as error:
        return base | {"status": "failed", "error": f"{type(error).__name__}: {error}"[:500]}
    value = float(result)
    low, _, high = np.quantile(result.samples, [0.25, 0.5, 0.75])
    if row.target is None:
        status = "no target"
    else:
        status = (
            "ok" if (value >= row.target if row.at_least else value <= row.target) else "missed"
        )
    return base | {
        "value": value,
        "quartiles": [float(low), float(high)],
        "status": status,
        "taken": time.perf_counter() - began,
        **result.details,
    }


# Scaling


def scaling_lanes(bench: Bench) -> list[dict[str, Any]]:
    """Nanoseconds per trajectory and step against the number of trajectories: Kepler."""
    points = []
    for lanes in (1, 8, 64, 512, 4096, 32_768, 262_144, 1_000_000):
        steps = int(np.clip(2**23 // lanes, 20, 100_000))
        result = batch_row(bench, "kepler", lanes, steps)
        points.append(_point(result, "lanes", lanes, lanes * steps))
    return points


def scaling_steps(bench: Bench) -> list[dict[str, Any]]:
    """The same against the number of steps, 1 024 trajectories; and the memory of the gradient."""
    w, points, lanes = WORKLOADS["kepler"], [], 1024
    for steps in (10, 100, 1000, 10_000):
        result = batch_row(bench, "kepler", lanes, steps)
        gradient = jax.grad(loss_of(w, steps, axis=bench.axis), argnums=(0, 1))
        memory = temporary_bytes(gradient, *w.inputs(lanes, bench.axis))
        points.append(
            _point(result, "steps", steps, lanes * steps) | {"gradient_temporary_bytes": memory}
        )
    return points


LONGEST_COMPILE = 60.0
"""Seconds of a first call after which larger n are left out."""


def scaling_n(bench: Bench) -> list[dict[str, Any]]:
    """Time per trajectory and step, first call and memory against n: the implicit chain."""
    points, lanes, steps = [], 512, 20
    kernels = {2: "chain2", 4: "chain4", 10: "chain10_tridiagonal"}
    for n in (1, 2, 4, 8, 10, 16, 32, 64):
        w = Workload(
            kernels.get(n, ""),
            dvi.System(chain, force=linear_force),
            n,
            0.02,
            np.zeros(n),
            np.zeros(n),
            (0.3, 0.3),
        )
        q0, p0 = w.start(lanes)
        f = jax.jit(batched(last_state(w, steps), bench.axis))
        inputs = w.inputs(lanes, bench.axis)
        first = first_call(functools.partial(f, *inputs))
        calls: list[Callable[[], Any]] = [functools.partial(f, *inputs)]
        if w.kernel:
            calls.append(
                bench.baseline.implicit(
                    w.kernel, q0, p0, h=w.h, steps=steps, epsilon=EPSILON, iterations=2
                ).call
            )
        times = bench.clock.times(*calls).processor
        seconds = np.median(times, axis=0) / (lanes * steps) * 1e9
        point = {"n": n, "nanoseconds": seconds[0], "first_call_seconds": first}
        point["temporary_bytes"] = temporary_bytes(f, *inputs)
        points.append(point | ({"c_nanoseconds": seconds[1]} if w.kernel else {}))
        if first > LONGEST_COMPILE:
            break
    return points


def _point(result: Measured, name: str, count: int, work: int) -> dict[str, Any]:
    return {
        name: count,
        "ratio": float(result),
        "nanoseconds": result.details["seconds"] / work * 1e9,
        "c_nanoseconds": result.details["reference_seconds"] / work * 1e9,
        "first_call_seconds": result.details["first_call_seconds"],
    }


SCALINGS = {"lanes": scaling_lanes, "steps": scaling_steps, "n": scaling_n}


# Process and report


def say(*words) -> None:
    """Progress, to stderr."""
    print(*words, file=sys.stderr, flush=True)


def measure_rows(bench: Bench, patterns: list[str] | None) -> list[dict[str, Any]]:
    """The results of the rows that were chosen, reported as they come."""
    results = []
    for row in chosen(patterns):
        results.append(measured(row, bench))
        say(f"  {line(results[-1])}")
    return results


def line(result: dict[str, Any]) -> str:
    """A row of the table, with a mark if its target is missed."""
    if result["status"] == "failed":
        return f"{result['row']:54s} | FAILED {result['error']}"
    low, high = result["quartiles"]
    sign = "≥" if result["at_least"] else "≤"
    target = "–" if result["target"] is None else f"{sign} {result['target']:g}"
    value = f"{result['value']:.3g} ({low:.3g}–{high:.3g}) {result['unit']}"
    return f"{result['row']:54s} | {target:6s} | {value:40s} | {result['status']}{wall(result)}"


def wall(result: dict[str, Any]) -> str:
    """The ratio of wall-clock times where it differs."""
    value, other = result["value"], result.get("wall_ratio", result["value"])
    differs = max(value, other) > WALL_DIFFERS * min(value, other)
    return f" (wall {other:.3g})" if differs else ""


def available_cores() -> tuple[int, ...]:
    """The cores that this process may use."""
    if not hasattr(os, "sched_getaffinity"):
        return (0,)
    return tuple(sorted(os.sched_getaffinity(0)))


def pin(core: int | None) -> str:
    """This process and those it starts on one core; what was done, in words."""
    if not hasattr(os, "sched_setaffinity"):
        return "not pinned to a core: this system cannot"
    allowed = available_cores()
    core = allowed[-1] if core is None else core
    if core not in allowed:
        raise SystemExit(f"core {core} is not among those that this process may use: {allowed}.")
    os.sched_setaffinity(0, {core})
    return f"pinned to core {core}"


def processor() -> str:
    """The processor's name, for the report."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for text in info.read_text().splitlines():
            if text.startswith("model name"):
                return text.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def as_text(rows: list[dict[str, Any]]) -> str:
    """The table, a line for each row."""
    return "\n".join(["row | target | measured (quartiles) | status", *map(line, rows)])


def picture(rows: list[dict[str, Any]], path: Path) -> None:
    """Horizontal bars of the measured ratios on a logarithmic axis; targets are black marks."""
    rows = [r for r in rows if r["unit"] == "×" and r["status"] != "failed"]
    figure, ax = plt.subplots(figsize=(8, 1 + 0.25 * len(rows)), layout="constrained")
    for y, r in enumerate(rows):
        missed = r["status"] == "missed"
        ax.barh(y, r["value"], 0.8, color="C3" if missed else "C0")
        ax.plot(r["quartiles"], [y, y], color="0.3", lw=1)
        if r["target"] is not None:
            ax.plot([r["target"]] * 2, [y - 0.4, y + 0.4], color="k", lw=2)
        right = max(r["quartiles"][1], r["target"] or 0)
        ax.annotate(f" {r['value']:.3g}", (right, y), va="center", fontsize=7)
    ax.set_xscale("log")
    ax.axvline(1, color="0.6", lw=0.8, zorder=0)
    ax.set_yticks(range(len(rows)), [r["row"] for r in rows], fontsize=8)
    ax.invert_yaxis()
    ax.set_xlabel("time relative to the reference (hand-written C, or the forward pass)")
    ax.set_title("targets: black lines; targets missed: red bars", fontsize=8)
    ax.margins(x=0.1)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def scaling_picture(curves: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Time per trajectory and step against trajectories, steps and n; first calls and memory."""
    figure, axes = plt.subplots(2, 3, figsize=(11, 6.4), layout="constrained")
    lower = {
        "lanes": ("ratio", "time relative to C", 1.0, "trajectories"),
        "steps": ("gradient_temporary_bytes", "memory of the gradient [MiB]", 2.0**20, "steps"),
        "n": ("first_call_seconds", "first call [s]", 1.0, "degrees of freedom"),
    }
    for (above, below), (name, points) in zip(axes.T, curves.items(), strict=True):
        key, label, unit, abscissa = lower[name]
        at = [p[name] for p in points]
        in_c = [(p[name], p["c_nanoseconds"]) for p in points if "c_nanoseconds" in p]
        above.loglog(at, [p["nanoseconds"] for p in points], "o-", label="dvi_jax", ms=4)
        above.loglog(*np.transpose(in_c), "k.--", label="C", ms=4)
        above.set_ylabel("ns per trajectory and step")
        below.loglog(at, [p[key] / unit for p in points], "o-", ms=4)
        below.set(ylabel=label, xlabel=abscissa)
    titles = ("Kepler", "Kepler, 1024 trajectories", "implicit chain, 512 trajectories")
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=9)
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)


# The regression check


def ratios(rows: list[dict[str, Any]]) -> dict[str, float | None]:
    """{row: ratio}, None for a row that failed; without rows in seconds or of fresh processes."""
    return {r["row"]: r.get("value") for r in rows if r["unit"] in ("×", "states/step")}


GROWTH_FROM = 0.01
"""A ratio below this counts as this: memory that does not grow has no meaningful factor."""


def worse(now: dict, before: dict, tolerance: float) -> list[tuple[str, float | None, float]]:
    """(row, ratio now, ratio before) of all that is worse than before by the tolerance.

    **Raises** `ValueError` if there is nothing to compare.
    """
    common = [row for row in now if row in before]
    if not common:
        raise ValueError("the two tables have no row in common: nothing was checked.")
    found = []
    for row in common:
        value, old = now[row], before[row]
        if old is None:
            continue  # it failed before: no worse now
        limit = tolerance * max(old, GROWTH_FROM)
        if value is None or not math.isfinite(value) or value > limit:
            found.append((row, value, old))
    return found


def better(one: dict, other: dict) -> dict[str, float | None]:
    """The smaller ratio of each row of both; a row that failed once has failed."""
    both = dict(one)
    for row, value in other.items():
        old = both.get(row, value)
        both[row] = None if value is None or old is None else min(value, old)
    return both


def check(now: dict, path: Path, tolerance: float, again: Callable[[list[str]], dict]) -> int:
    """Exit status of the comparison with a committed table, which is printed.

    A row that is worse is measured a second time by `again`, and the better result counts: other
    work on the machine for some seconds is not a regression.
    """
    before = json.loads(path.read_text(encoding="utf-8"))["ratios"]
    try:
        found = worse(now, before, tolerance)
    except ValueError as error:
        print(f"{path}: {error}")
        return 2
    if found:
        rows = [row for row, *_ in found]
        say(f"# worse, measured again: {'; '.join(rows)}")
        found = worse(better(now, again(rows)), before, tolerance)
    if not found:
        print(f"no ratio is more than {tolerance:g} times that of {path}.")
        return 0
    print(f"worse than {path} by more than a factor {tolerance:g}, twice:")
    for row, value, old in found:
        shown = "failed" if value is None else f"{value:.3g}"
        print(f"  {row:54s} {shown:>8s}   was {old:.3g}")
    return 1


# The command


def options_of(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Speed of the package relative to C.")
    parser.add_argument(
        "--rows",
        action="append",
        help="only rows whose name contains this (* and ?); may be repeated",
    )
    parser.add_argument("--rounds", type=int, default=15, help="of each row at most (default 15)")
    parser.add_argument("--budget", type=float, default=6.0, help="seconds of a row (default 6)")
    parser.add_argument(
        "--axis", type=int, choices=(0, -1), default=0, help="of the trajectories (default 0)"
    )
    parser.add_argument("--core", type=int, help="to run on (default: the last one allowed)")
    parser.add_argument("--scaling", action="store_true", help="curves in trajectories, steps, n")
    parser.add_argument("--out", type=Path, help="folder for JSON and pictures")
    parser.add_argument("--check", type=Path, help="compare with the ratios in this file")
    parser.add_argument("--write", type=Path, help="write the ratios to this file")
    parser.add_argument("--tolerance", type=float, default=1.3, help="of --check (default 1.3)")
    parser.add_argument("--list", action="store_true", help="the names of the rows")
    options = parser.parse_args(words)
    if options.rounds < LEAST_ROUNDS:
        parser.error(f"--rounds must be at least {LEAST_ROUNDS}, got {options.rounds}.")
    if options.tolerance <= 1:
        parser.error(f"--tolerance is a factor above 1, got {options.tolerance:g}.")
    if options.scaling and (options.check or options.write):
        parser.error("--check and --write are for the table, not for --scaling.")
    return options


def main(words: list[str] | None = None) -> int:
    """Measure, print, write; the exit status."""
    options = options_of(words)
    if options.list:
        print("\n".join(row.name for row in chosen(options.rows)))
        return 0
    chosen(options.rows)  # reject a wrong pattern before anything is compiled
    if flags := os.environ.pop("XLA_FLAGS", ""):
        say(f"# XLA_FLAGS={flags!r} is not used.")
    os.environ["DVI_JAX_CACHE"] = "off"
    cores = available_cores()
    pinned = pin(options.core)
    if options.core is not None:  # the last one is the one in use
        cores = (*(c for c in cores if c != options.core), options.core)
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        bench = Bench(Clock(options.rounds, options.budget), options.axis, cores)
    except NoCompilerError as error:
        raise SystemExit(str(error)) from None
    machine = {"processor": processor(), "pinned": pinned, "jax": jax.__version__}
    say(f"# {machine['processor']}, {pinned}")
    say(f"# C: {bench.baseline}")
    report: dict[str, Any] = {"machine": machine, "c": str(bench.baseline), "axis": options.axis}
    if options.scaling:
        report["curves"] = {name: curve(bench) for name, curve in SCALINGS.items()}
    else:
        report["rows"] = measure_rows(bench, options.rows)
        print(as_text(report["rows"]))
    text = json.dumps(report, indent=1, default=float)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        name = "scaling" if options.scaling else "speed"
        (options.out / f"{name}.json").write_text(text, encoding="utf-8")
        draw, data = (scaling_picture, "curves") if options.scaling else (picture, "rows")
        draw(report[data], options.out / f"{name}.png")
        say(f"# {options.out / name}.json, .png")
    elif options.scaling:
        print(text)
    if options.write:
        written = {"machine": machine, "ratios": ratios(report["rows"])}
        options.write.write_text(json.dumps(written, indent=1) + "\n", encoding="utf-8")
    if options.check is None:
        return 0

    def again(rows: list[str]) -> dict:
        bench.clock.budget *= 2
        return ratios([measured(row, bench) for row in table() if row.name in rows])

    return check(ratios(report["rows"]), options.check, options.tolerance, again)


if __name__ == "__main__":
    plt.switch_backend("agg")
    raise SystemExit(main())
