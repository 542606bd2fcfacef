"""How fast the package is beside hand-written C: every row of the target table, in one command.

    python benchmarks/speed.py [--rows PATTERN] [--out DIR] [--check FILE | --write FILE]
    python benchmarks/speed.py --scaling --out DIR

A row is a ratio of times, one thread both, pinned to one core. In each round the two sides run
once, in random order; of the ratios of all rounds the median is shown, and the quartiles. Times
are processor times of this process, so that waiting for other work on that core does not count;
where the ratio of wall-clock times differs by more than WALL_DIFFERS it is shown too.

- The C side is baseline.c, compiled here for this machine: arrays with the lanes last, a few
  vectors of lanes in registers over the whole time loop, outputs into memory that is there already;
  saved states, which a caller keeps, into new memory on each call, as the package's: where pages
  of memory are dear, as on virtual machines, that is most of the time of both.
  Implicit steps: explicit guess, then the least number of Newton iterations whose last correction
  is below √ε (it is measured, and shown; two at these steps).
- The package's side is the public one: `jax.jit(jax.vmap(one, in_axes=-1, out_axes=-1))` with `one`
  a call of `dvi.integrate`, `throw=False`, which returns states and status. Lanes last is the
  layout of the C side; for saved states it is the one without a transposition at the end. The row
  "lanes first" has vmap's own axes instead.
- Column "plain": a process without any flag, and `compiler_options` on that jit (JIT_OPTIONS;
  `--no-jit-options` leaves them out). Column "configured": a process that calls
  `dvi.configure_cpu()` first, or has its flags in XLA_FLAGS where there is no such function.
- Gradients and forward mode are beside their own forward pass; 10⁶ lanes beside 65 536, per lane.
  Memory is what the compiler says a gradient needs, at two numbers of steps, in states (q, p) of a
  lane per step: backpropagation that stores every step needs at least 1.
- Compile times are those of a first call, tracing included, in seconds; not part of `--check`.

`--check FILE` compares ratios with those of a file that `--write FILE` wrote, and exits with
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
from _workloads import EPSILON, WORKLOADS, Workload, chain, linear_force

import dvi_jax as dvi

COLUMNS = ("plain", "configured")
JIT_OPTIONS = {"plain": {"xla_cpu_prefer_vector_width": 512}, "configured": None}
"""What a user has to give to the outermost jit in each column."""

FLAGS = (
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000 "
    "--xla_cpu_prefer_vector_width=512"
)
"""XLA_FLAGS of the column "configured" for a package without `configure_cpu`."""

LEAST_ROUNDS = 3
WALL_DIFFERS = 1.2
SAVE_EVERY = 10


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
    """Samples of a row's value, and what else is worth knowing about it."""

    samples: list[float]
    details: dict[str, Any]

    def __float__(self):
        return float(statistics.median(self.samples))


def ratio(times: Times, work: tuple[float, float] = (1.0, 1.0), **details) -> Measured:
    """The first call's time over the second's, each by its work."""
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


# The package's side


def run_of(w: Workload, steps: int, *, save=None, observe=None, epsilon=EPSILON, **settings):
    """(q0, p0) → solution: what a user writes for one trajectory."""

    def one(q0, p0, epsilon=epsilon):
        return dvi.integrate(
            w.system,
            q0,
            p0,
            h=w.h,
            num_steps=steps,
            epsilon=epsilon,
            args=w.args,
            save=dvi.Save(final=True) if save is None else save,
            observe=observe,
            throw=False,
            **settings,
        )

    return one


def last_state(w: Workload, steps: int, **settings):
    """(q0, p0) → state after the last step, and status."""
    one = run_of(w, steps, **settings)

    def final(*inputs):
        sol = one(*inputs)
        return sol.qs[-1], sol.ps[-1], sol.result

    return final


def last_and_invariants(w: Workload, steps: int):
    """(q0, p0) → state after the last step, drift and trend of the energy, status."""
    one = run_of(w, steps, observe=(dvi.MaxDrift(w.energy), dvi.Trend(w.energy)))

    def final(*inputs):
        sol = one(*inputs)
        return sol.qs[-1], sol.ps[-1], sol.observed, sol.result

    return final


def saved_states(w: Workload, steps: int):
    """(q0, p0) → every tenth state, and status."""
    one = run_of(w, steps, save=dvi.Save(every=SAVE_EVERY))

    def final(*inputs):
        sol = one(*inputs)
        return sol.qs, sol.ps, sol.result

    return final


def batched(one, axis: int = -1):
    return jax.vmap(one, in_axes=axis, out_axes=axis)


class Bench:
    """What rows measure with: a clock, the C library, and the options of jit."""

    def __init__(self, clock: Clock, jit_options: dict[str, Any] | None):
        self.clock, self.jit_options = clock, jit_options
        self.baseline = Baseline()

    def jit(self, f):
        return jax.jit(f, compiler_options=self.jit_options)

    def against_c(self, f, inputs, c_run, **details) -> Measured:
        """Time of the jitted f over that of the kernel, and the first call of f."""
        f = self.jit(f)
        inputs = [jnp.asarray(x) for x in inputs]
        first = first_call(lambda: f(*inputs))
        times = self.clock.times(lambda: f(*inputs), c_run.timed)
        return ratio(times, first_call_seconds=first, **details)


# Rows


class Row(NamedTuple):
    """A line of the table: its targets in the two columns (None: none), and how it is measured."""

    name: str
    targets: tuple[float | None, float | None]
    measure: Callable[[Bench], Measured]
    unit: str = "×"


def explicit_row(bench: Bench, name: str, lanes: int, steps: int, what: str) -> Measured:
    """An explicit batch against C: to its last state, with invariants, or with saved states."""
    w = WORKLOADS[name]
    q0, p0 = w.start(lanes)
    common = {"h": w.h, "steps": steps, "epsilon": EPSILON}
    match what:
        case "final":
            f, run = last_state(w, steps), bench.baseline.final(w.kernel, q0, p0, **common)
        case "invariants":
            f = last_and_invariants(w, steps)
            run = bench.baseline.streamed(w.kernel, q0, p0, **common)
        case "saved":
            f = saved_states(w, steps)
            run = bench.baseline.saved(w.kernel, q0, p0, every=SAVE_EVERY, **common)
        case _:
            raise ValueError(what)
    return bench.against_c(batched(f), (q0, p0), run, lanes=lanes, steps=steps)


def lanes_first_row(bench: Bench, name: str, lanes: int, steps: int) -> Measured:
    """As `explicit_row` to the last state, by vmap with the axes that it has by itself."""
    w = WORKLOADS[name]
    q0, p0 = w.start(lanes)
    run = bench.baseline.final(w.kernel, q0, p0, h=w.h, steps=steps, epsilon=EPSILON)
    inputs = np.ascontiguousarray(q0.T), np.ascontiguousarray(p0.T)
    f = batched(last_state(w, steps), axis=0)
    return bench.against_c(f, inputs, run, lanes=lanes, steps=steps)


def implicit_row(bench: Bench, name: str, lanes: int, steps: int) -> Measured:
    """An implicit batch against C with as many iterations as round-off takes."""
    w = WORKLOADS[name]
    q0, p0 = w.start(lanes)
    common = {"h": w.h, "steps": steps, "epsilon": EPSILON}
    iterations, correction = bench.baseline.iterations_needed(w.kernel, q0, p0, **common)
    run = bench.baseline.implicit(w.kernel, q0, p0, iterations=iterations, **common)
    return bench.against_c(
        batched(last_state(w, steps)), (q0, p0), run, lanes=lanes, steps=steps,
        c_iterations=iterations, c_last_correction=correction,
    )  # fmt: skip


def one_row(bench: Bench, name: str, steps: int) -> Measured:
    """One trajectory against scalar C."""
    w = WORKLOADS[name]
    q0, p0 = w.start()
    common = {"h": w.h, "steps": steps, "epsilon": EPSILON}
    details = {}
    if w.is_explicit:
        run = bench.baseline.final(w.kernel, q0, p0, **common)
    else:
        iterations, correction = bench.baseline.iterations_needed(w.kernel, q0, p0, **common)
        details = {"c_iterations": iterations, "c_last_correction": correction}
        run = bench.baseline.implicit(w.kernel, q0, p0, iterations=iterations, **common)
    return bench.against_c(last_state(w, steps), (q0, p0), run, steps=steps, **details)


def loss_of(w: Workload, steps: int, adjoint=None):
    """(q0, p0) → Σ over lanes of (|q|² + |p|²)/2 after the last step."""
    f = batched(last_state(w, steps, adjoint=adjoint or dvi.Reversible()))

    def loss(q0, p0):
        q1, p1, _ = f(q0, p0)
        return (jnp.sum(q1**2) + jnp.sum(p1**2)) / 2

    return loss


def gradient_row(bench: Bench, name: str, lanes: int, steps: int) -> Measured:
    """The reversible gradient of a final-state loss over its own forward pass."""
    w = WORKLOADS[name]
    q0, p0 = map(jnp.asarray, w.start(lanes))
    loss = loss_of(w, steps)
    forward, backward = bench.jit(loss), bench.jit(jax.grad(loss, argnums=(0, 1)))
    first = first_call(lambda: backward(q0, p0))
    times = bench.clock.times(lambda: backward(q0, p0), lambda: forward(q0, p0))
    return ratio(times, first_call_seconds=first, lanes=lanes, steps=steps)


def temporary_bytes(f, *inputs) -> int:
    """The memory beside inputs and outputs that the compiled f asks for."""
    analysis = jax.jit(f).lower(*inputs).compile().memory_analysis()
    if analysis is None:
        raise RuntimeError("this backend does not say how much memory a program needs.")
    return int(analysis.temp_size_in_bytes)


def memory_row(
    bench: Bench, name: str, lanes: int, steps: tuple[int, int], adjoint=None
) -> Measured:
    """What a gradient's memory grows by with the number of steps: states of a lane per step."""
    w = WORKLOADS[name]
    q0, p0 = map(jnp.asarray, w.start(lanes))
    few, many = (
        temporary_bytes(jax.grad(loss_of(w, count, adjoint), argnums=(0, 1)), q0, p0)
        for count in steps
    )
    state = 2 * w.n * lanes * q0.dtype.itemsize
    growth = (many - few) / (steps[1] - steps[0]) / state
    return Measured([growth], {"lanes": lanes, "steps": steps, "bytes": (few, many)})


def forward_mode_row(bench: Bench, name: str, lanes: int, steps: int) -> Measured:
    """State and its derivative in ε over the state alone."""
    w = WORKLOADS[name]
    q0, p0 = map(jnp.asarray, w.start(lanes))
    final = jax.vmap(last_state(w, steps), in_axes=(-1, -1, None), out_axes=-1)

    def derivative(q0, p0, epsilon):
        return jax.jvp(
            lambda e: final(q0, p0, e), (epsilon,), (jnp.ones_like(epsilon),), has_aux=False
        )

    epsilon = jnp.asarray(EPSILON)
    alone, both = bench.jit(final), bench.jit(derivative)
    first = first_call(lambda: both(q0, p0, epsilon))
    times = bench.clock.times(lambda: both(q0, p0, epsilon), lambda: alone(q0, p0, epsilon))
    return ratio(times, first_call_seconds=first, lanes=lanes, steps=steps)


def million_row(bench: Bench, name: str, lanes: tuple[int, int], steps: int) -> Measured:
    """Time per lane of many lanes over that of fewer."""
    w = WORKLOADS[name]
    f = bench.jit(batched(last_state(w, steps)))
    starts = [[jnp.asarray(x) for x in w.start(count)] for count in lanes]
    times = bench.clock.times(*(functools.partial(f, *start) for start in starts))
    return ratio(times, work=lanes, lanes=lanes, steps=steps)


def first_call_of(bench: Bench, name: str, lanes: int = 1024, steps: int = 3) -> float:
    """Seconds of a first call of a small batch that JAX has not seen."""
    w = WORKLOADS[name]
    inputs = [jnp.asarray(x) for x in w.start(lanes)]
    jax.clear_caches()
    f = bench.jit(batched(last_state(w, steps)))
    return first_call(lambda: f(*inputs))


def compile_row(bench: Bench, names: tuple[str, ...]) -> Measured:
    """First calls in seconds: the slowest of the systems, in each of a few repetitions."""
    samples: dict[str, list[float]] = {name: [] for name in names}
    began = time.perf_counter()
    for _ in range(LEAST_ROUNDS):
        for name in names:
            samples[name].append(first_call_of(bench, name))
        if time.perf_counter() - began > 2 * bench.clock.budget:
            break
    slowest = max(names, key=lambda name: statistics.median(samples[name]))
    return Measured(samples[slowest], {"slowest": slowest, "first_calls": samples})


def table() -> list[Row]:
    """The rows of the target table; steps such that the C side takes some milliseconds."""
    row, of = functools.partial, []

    def add(name, plain, configured, measure, unit="×"):
        of.append(Row(name, (plain, configured), measure, unit))

    for lanes, steps in ((1024, 8000), (8192, 1000), (65536, 200)):
        measure = row(explicit_row, name="kepler", lanes=lanes, steps=steps, what="final")
        add(f"kepler, {lanes} lanes", 1.7, 1.3, measure)
    measure = row(lanes_first_row, name="kepler", lanes=65536, steps=200)
    add("kepler, 65536 lanes, lanes first", 1.7, 1.3, measure)
    measure = row(explicit_row, name="oscillator", lanes=65536, steps=1000, what="final")
    add("oscillator, 65536 lanes", 2.2, 1.8, measure)
    for name, steps in (("kepler", 200), ("oscillator", 500)):
        measure = row(explicit_row, name=name, lanes=65536, steps=steps, what="invariants")
        add(f"{name}, invariants", 3.0, 2.0, measure)
    for name, steps in (("kepler", 200), ("oscillator", 500)):
        measure = row(explicit_row, name=name, lanes=65536, steps=steps, what="saved")
        add(f"{name}, every 10th saved", 2.3, 1.8, measure)

    for name, title, lanes, steps in (
        ("product", "n = 1", 65536, 200),
        ("pendulum", "pendulum, n = 2", 65536, 40),
        ("chain2", "chain, n = 2", 65536, 60),
        ("chain4", "chain, n = 4", 8192, 100),
    ):
        measure = row(implicit_row, name=name, lanes=lanes, steps=steps)
        add(f"implicit {title}", 3.0, 1.7, measure)
    measure = row(implicit_row, name="web10", lanes=1024, steps=100)
    add("implicit dense, n = 10", 2.5, 1.3, measure)
    measure = row(implicit_row, name="chain10", lanes=1024, steps=200)
    add("implicit tridiagonal, n = 10", None, None, measure)

    add("one kepler", 1.6, 1.5, row(one_row, name="kepler", steps=400_000))
    for name in ("product", "pendulum", "chain2"):
        add(f"one {name}", 4.0, 1.8, row(one_row, name=name, steps=100_000))

    for name, lanes, counts in (("kepler", 1024, (300, 3000)), ("chain2", 512, (100, 1000))):
        for steps in counts:
            measure = row(gradient_row, name=name, lanes=lanes, steps=steps)
            add(f"gradient {name}, {steps} steps", 3.0, 3.0, measure)
        measure = row(memory_row, name=name, lanes=16, steps=(2000, 20_000))
        add(f"gradient {name}, memory", 0.02, 0.02, measure, "states/step")
        measure = row(forward_mode_row, name=name, lanes=lanes, steps=counts[1])
        add(f"forward mode {name}", 2.7, 2.7, measure)
    measure = row(million_row, name="kepler", lanes=(1_000_000, 65536), steps=100)
    add("kepler, 1000000 lanes / 65536", 1.3, 1.3, measure)

    small = ("kepler", "product", "pendulum", "chain2", "chain4")
    add("compile, n ≤ 4", 1.0, 1.0, row(compile_row, names=small), "s")
    add("compile, n = 10", 3.0, 3.0, row(compile_row, names=("web10", "chain10")), "s")
    return of


def chosen(patterns: list[str] | None) -> list[Row]:
    """The rows whose name holds one of the patterns (* and ? as in a shell)."""
    rows = table()
    if not patterns:
        return rows
    for pattern in patterns:
        if not any(fnmatch.fnmatch(row.name, f"*{pattern}*") for row in rows):
            names = "\n  ".join(row.name for row in rows)
            raise SystemExit(f"no row matches {pattern!r}; there are\n  {names}")
    return [row for row in rows if any(fnmatch.fnmatch(row.name, f"*{p}*") for p in patterns)]


def measured(row: Row, column: str, bench: Bench) -> dict[str, Any]:
    """One row of one column as it goes into the report; an error is a result too."""
    target = row.targets[COLUMNS.index(column)]
    base = {"row": row.name, "column": column, "unit": row.unit, "target": target}
    began = time.perf_counter()
    try:
        result = row.measure(bench)
    except Exception as error:
        return base | {"status": "failed", "error": f"{type(error).__name__}: {error}"[:500]}
    value = float(result)
    low, _, high = np.quantile(result.samples, [0.25, 0.5, 0.75])
    if target is None:
        status = "no target"
    else:
        status = "ok" if value <= target else "missed"
    return base | {
        "value": value,
        "quartiles": [float(low), float(high)],
        "status": status,
        "taken": time.perf_counter() - began,
        **result.details,
    }


# Scaling


def scaling_lanes(bench: Bench) -> list[dict[str, Any]]:
    """Nanoseconds per lane and step against the number of lanes: Kepler, package and C."""
    w, points = WORKLOADS["kepler"], []
    for lanes in (1, 8, 64, 512, 4096, 32_768, 262_144, 1_000_000):
        steps = int(np.clip(2**23 // lanes, 20, 100_000))
        q0, p0 = w.start(lanes)
        run = bench.baseline.final(w.kernel, q0, p0, h=w.h, steps=steps, epsilon=EPSILON)
        result = bench.against_c(batched(last_state(w, steps)), (q0, p0), run)
        points.append(_point(result, "lanes", lanes, lanes * steps))
    return points


def scaling_steps(bench: Bench) -> list[dict[str, Any]]:
    """The same against the number of steps, 1 024 lanes; and the memory of the gradient."""
    w, points, lanes = WORKLOADS["kepler"], [], 1024
    q0, p0 = w.start(lanes)
    for steps in (10, 100, 1000, 10_000):
        run = bench.baseline.final(w.kernel, q0, p0, h=w.h, steps=steps, epsilon=EPSILON)
        result = bench.against_c(batched(last_state(w, steps)), (q0, p0), run)
        gradient = jax.grad(loss_of(w, steps), argnums=(0, 1))
        memory = temporary_bytes(gradient, jnp.asarray(q0), jnp.asarray(p0))
        points.append(
            _point(result, "steps", steps, lanes * steps) | {"gradient_temporary_bytes": memory}
        )
    return points


LONGEST_COMPILE = 60.0
"""Seconds of a first call after which larger n are left out."""


def scaling_n(bench: Bench) -> list[dict[str, Any]]:
    """Time per lane and step, first call and memory against n: the implicit chain."""
    points, lanes, steps = [], 512, 20
    kernels = {2: "chain2", 4: "chain4", 10: "chain10_tridiagonal"}
    for n in (1, 2, 4, 8, 10, 16, 32, 64):
        w = Workload(
            kernels.get(n, ""), dvi.System(chain, force=linear_force), n, 0.02, np.zeros(n),
            np.zeros(n), (0.3, 0.3),
        )  # fmt: skip
        q0, p0 = w.start(lanes)
        f = bench.jit(batched(last_state(w, steps)))
        inputs = jnp.asarray(q0), jnp.asarray(p0)
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
        point["temporary_bytes"] = temporary_bytes(batched(last_state(w, steps)), *inputs)
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


# Processes: a column is measured in one of its own, since XLA reads its flags once


def say(*words) -> None:
    """Progress, to stderr."""
    print(*words, file=sys.stderr, flush=True)


def work(column: str, options) -> dict[str, Any]:
    """One column, in this process: results of rows, or curves."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)
    configure = getattr(dvi, "configure_cpu", None)
    if column == "configured" and configure is not None:
        configure()
    jit_options = None if options.no_jit_options else JIT_OPTIONS[column]
    bench = Bench(Clock(options.rounds, options.budget), jit_options)
    how = (
        "dvi.configure_cpu()"
        if column == "configured" and configure is not None
        else f"XLA_FLAGS={os.environ.get('XLA_FLAGS', '')!r}"
    )
    how += f", jit options {jit_options}"
    say(f"# {column}: {how}")
    say(f"# C: {bench.baseline}")
    report: dict[str, Any] = {"how": how, "c": str(bench.baseline)}
    jax.block_until_ready(jnp.ones(2) + 1)  # JAX itself has started
    if options.scaling:
        report["curves"] = {}
        for name, curve in SCALINGS.items():
            report["curves"][name] = curve(bench)
            say(f"  {column}: {name}")
    else:
        report["rows"] = []
        for row in chosen(options.rows):
            result = measured(row, column, bench)
            report["rows"].append(result)
            say(f"  {column}: {line(result)}")
    return report


def line(result: dict[str, Any]) -> str:
    """A row in words."""
    if result["status"] == "failed":
        return f"{result['row']}: FAILED, {result['error']}"
    low, high = result["quartiles"]
    target = "–" if result["target"] is None else f"{result['target']:g}"
    return (
        f"{result['row']:34s} {result['value']:8.3g} ({low:.3g} – {high:.3g}) {result['unit']}, "
        f"target {target}: {result['status']}{wall(result)}"
    )


def wall(result: dict[str, Any]) -> str:
    """The ratio of wall-clock times where it is another one."""
    value, other = result["value"], result.get("wall_ratio", result["value"])
    differs = max(value, other) > WALL_DIFFERS * min(value, other)
    return f" (wall {other:.3g})" if differs else ""


def column_in_process(column: str, words: list[str]) -> dict[str, Any]:
    """A fresh process with the environment of the column."""
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    environment["JAX_PLATFORMS"] = "cpu"
    if column == "configured" and not hasattr(dvi, "configure_cpu"):
        environment["XLA_FLAGS"] = FLAGS
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "report.json"
        command = [sys.executable, __file__, *words, "--worker", column, "--json", str(path)]
        subprocess.run(command, env=environment, check=True)
        return json.loads(path.read_text(encoding="utf-8"))


def pin(core: int | None) -> str:
    """This process and those it starts on one core; what was done, in words."""
    if not hasattr(os, "sched_setaffinity"):
        return "not pinned to a core: this system cannot"
    allowed = sorted(os.sched_getaffinity(0))
    core = allowed[-1] if core is None else core
    if core not in allowed:
        raise SystemExit(f"core {core} is not among those this process may use: {allowed}.")
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


# Reports


def as_text(report: dict[str, Any]) -> str:
    """The table, a line for each row, a pair of columns for each process."""
    columns = list(report["columns"])
    by_name: dict[str, dict[str, Any]] = {}
    for column in columns:
        for result in report["columns"][column]["rows"]:
            by_name.setdefault(result["row"], {})[column] = result
    head = ["row", *(f"{c}: target | measured (quartiles) | status" for c in columns)]
    lines = [" | ".join(head)]
    for name, results in by_name.items():
        cells = [f"{name:33s}"]
        for column in columns:
            r = results[column]
            if r["status"] == "failed":
                cells.append(f"FAILED {r['error'][:60]}")
                continue
            target = "–" if r["target"] is None else f"≤ {r['target']:g}"
            low, high = r["quartiles"]
            value = f"{r['value']:.3g} ({low:.3g}–{high:.3g}) {r['unit']}"
            cells.append(f"{target:6s} | {value:32s} | {r['status'] + wall(r):9s}")
        lines.append(" | ".join(cells))
    return "\n".join(lines)


def picture(report: dict[str, Any], path: Path) -> None:
    """Horizontal bars of the measured ratios on a logarithmic axis; targets are black marks."""
    columns = list(report["columns"])
    rows = [
        {c: r for c in columns for r in report["columns"][c]["rows"] if r["row"] == name}
        for name in dict.fromkeys(
            r["row"] for c in columns for r in report["columns"][c]["rows"] if r["unit"] == "×"
        )
    ]
    figure, ax = plt.subplots(figsize=(8, 1 + 0.34 * len(rows)), layout="constrained")
    height = 0.8 / len(columns)
    for i, column in enumerate(columns):
        label = column
        for at, results in enumerate(rows):
            r = results[column]
            if r["status"] == "failed":
                continue
            y = at + (i - (len(columns) - 1) / 2) * height
            ax.barh(y, r["value"], height, color=f"C{i}", label=label)
            label = None
            ax.plot(r["quartiles"], [y, y], color="0.3", lw=1)
            if r["target"] is not None:
                ax.plot([r["target"]] * 2, [y - height / 2, y + height / 2], color="k", lw=2)
            right = max(r["quartiles"][1], r["target"] or 0)
            color = "C3" if r["status"] == "missed" else "0.2"
            ax.annotate(f" {r['value']:.3g}", (right, y), va="center", fontsize=7, color=color)
    ax.plot([], [], color="k", lw=2, label="target")
    ax.set_xscale("log")
    ax.axvline(1, color="0.6", lw=0.8, zorder=0)
    ax.set_yticks(range(len(rows)), [next(iter(r.values()))["row"] for r in rows], fontsize=8)
    ax.invert_yaxis()
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.set_xlabel("time beside the reference (hand-written C, or the forward pass); less is better")
    ax.margins(x=0.1)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def scaling_picture(report: dict[str, Any], path: Path) -> None:
    """Time per lane and step against lanes, steps and n; first calls and memory."""
    figure, axes = plt.subplots(2, 3, figsize=(11, 6.4), layout="constrained")
    for i, (column, result) in enumerate(report["columns"].items()):
        curves, color = result["curves"], f"C{i}"
        for ax, name in zip(axes[0], SCALINGS, strict=True):
            points = curves[name]
            ax.loglog(
                [p[name] for p in points], [p["nanoseconds"] for p in points], "o-", color=color,
                label=column, ms=4,
            )  # fmt: skip
            if i == 0:
                in_c = [(p[name], p["c_nanoseconds"]) for p in points if "c_nanoseconds" in p]
                ax.loglog(*np.transpose(in_c), "k.--", label="C", ms=4)
            ax.set_ylabel("ns per lane and step")
        for ax, name in zip(axes[1], SCALINGS, strict=True):
            points = curves[name]
            match name:
                case "lanes":
                    key, label, power = "ratio", "time beside C", 1.0
                case "steps":
                    key, label, power = "gradient_temporary_bytes", "gradient's memory [MiB]", 2**20
                case _:
                    key, label, power = "first_call_seconds", "first call [s]", 1.0
            ax.loglog(
                [p[name] for p in points], [p[key] / power for p in points], "o-", color=color, ms=4
            )
            ax.set_ylabel(label)
            ax.set_xlabel({"lanes": "lanes", "steps": "steps", "n": "degrees of freedom"}[name])
    axes[0, 0].set_title("Kepler", fontsize=9)
    axes[0, 1].set_title("Kepler, 1024 lanes", fontsize=9)
    axes[0, 2].set_title("implicit chain, 512 lanes", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)


# The regression check


def ratios(report: dict[str, Any]) -> dict[str, dict[str, float | None]]:
    """{row: {column: ratio}}; None for a row that failed. Seconds are left out."""
    of: dict[str, dict[str, float | None]] = {}
    for column, result in report["columns"].items():
        for r in result["rows"]:
            if r["unit"] != "s":
                of.setdefault(r["row"], {})[column] = r.get("value")
    return of


GROWTH_FROM = 0.01
"""Below this a ratio is as good as zero (memory that does not grow): no factor is asked of it."""


def worse(now: dict, before: dict, tolerance: float) -> list[tuple[str, str, float | None, float]]:
    """(row, column, ratio now, ratio before) of all that is worse than before by the tolerance.

    **Raises** `ValueError` if there is nothing to compare.
    """
    common = [(row, c) for row in now for c in now[row] if c in before.get(row, {})]
    if not common:
        raise ValueError("the two tables have no row in common: nothing was checked.")
    found = []
    for row, column in common:
        value, old = now[row][column], before[row][column]
        if old is None:
            continue  # it failed before: no worse now
        limit = tolerance * max(old, GROWTH_FROM)
        if value is None or not math.isfinite(value) or value > limit:
            found.append((row, column, value, old))
    return found


def better(one: dict, other: dict) -> dict[str, dict[str, float | None]]:
    """The smaller ratio of each row and column of both; a row that failed once has failed."""
    both: dict[str, dict[str, float | None]] = {row: dict(of) for row, of in one.items()}
    for row, of in other.items():
        for column, value in of.items():
            old = both.get(row, {}).get(column, value)
            least = None if value is None or old is None else min(value, old)
            both.setdefault(row, {})[column] = least
    return both


def check(now: dict, path: Path, tolerance: float, again: Callable[[list[str]], dict]) -> int:
    """Exit status of the comparison with a committed table, which is printed.

    What is worse is measured a second time by `again`, and the better of the two counts: what
    slows one side for some seconds is not a regression.
    """
    before = json.loads(path.read_text(encoding="utf-8"))["ratios"]
    try:
        found = worse(now, before, tolerance)
    except ValueError as error:
        print(f"{path}: {error}")
        return 2
    if found:
        rows = list(dict.fromkeys(row for row, *_ in found))
        say(f"# worse, measured again: {'; '.join(rows)}")
        found = worse(better(now, again(rows)), before, tolerance)
    if not found:
        print(f"no ratio is more than {tolerance:g} times that of {path}.")
        return 0
    print(f"worse than {path} by more than a factor {tolerance:g}, twice:")
    for row, column, value, old in found:
        shown = "failed" if value is None else f"{value:.3g}"
        print(f"  {row:34s} {column:10s} {shown:>8s}   was {old:.3g}")
    return 1


# The command


def options_of(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="The package's speed beside hand-written C.")
    parser.add_argument(
        "--rows", action="append", help="only rows whose name holds this (* and ?); may be repeated"
    )
    parser.add_argument("--rounds", type=int, default=15, help="of each row at most (default 15)")
    parser.add_argument("--budget", type=float, default=6.0, help="seconds of a row (default 6)")
    parser.add_argument("--plain", action="store_true", help="only the column without flags")
    parser.add_argument("--configured", action="store_true", help="only that with configure_cpu()")
    parser.add_argument("--no-jit-options", action="store_true", help="a jit without options")
    parser.add_argument("--core", type=int, help="to run on (default: the last one allowed)")
    parser.add_argument("--scaling", action="store_true", help="curves in lanes, steps and n")
    parser.add_argument("--out", type=Path, help="folder for JSON and pictures")
    parser.add_argument("--check", type=Path, help="compare with the ratios in this file")
    parser.add_argument("--write", type=Path, help="write the ratios to this file")
    parser.add_argument("--tolerance", type=float, default=1.3, help="of --check (default 1.3)")
    parser.add_argument("--list", action="store_true", help="the names of the rows")
    parser.add_argument("--worker", choices=COLUMNS, help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, help=argparse.SUPPRESS)
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
    words = sys.argv[1:] if words is None else words
    options = options_of(words)
    if options.list:
        print("\n".join(row.name for row in chosen(options.rows)))
        return 0
    if options.worker:
        report = work(options.worker, options)
        options.json.write_text(json.dumps(report, default=float), encoding="utf-8")
        return 0
    chosen(options.rows)  # refuse a wrong pattern before anything is compiled
    if os.environ.get("XLA_FLAGS"):
        say(f"# XLA_FLAGS={os.environ['XLA_FLAGS']!r} is not used: the columns set their own.")
    both = options.plain == options.configured
    columns = COLUMNS if both else ("plain",) if options.plain else ("configured",)
    pinned = pin(options.core)
    say(f"# {processor()}, {pinned}")
    try:
        Baseline()
    except NoCompilerError as error:
        raise SystemExit(str(error)) from None
    machine = {"processor": processor(), "pinned": pinned, "jax": jax.__version__}

    def measure(more: list[str]) -> dict[str, Any]:
        return {"columns": {column: column_in_process(column, more) for column in columns}}

    report = {"machine": machine, **measure(words)}
    if not options.scaling:
        print(as_text(report))
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        name = "scaling" if options.scaling else "speed"
        (options.out / f"{name}.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
        draw = scaling_picture if options.scaling else picture
        draw(report, options.out / f"{name}.png")
        say(f"# {options.out / name}.json, .png")
    elif options.scaling:
        print(json.dumps(report, indent=1))
    if options.write:
        kept = {"machine": report["machine"], "ratios": ratios(report)}
        options.write.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    if options.check is None:
        return 0

    def again(rows: list[str]) -> dict:
        same = ["--rounds", str(options.rounds), "--budget", str(2 * options.budget)]
        same += ["--no-jit-options"] if options.no_jit_options else []
        return ratios(measure([*same, *(word for row in rows for word in ("--rows", row))]))

    return check(ratios(report), options.check, options.tolerance, again)


if __name__ == "__main__":
    plt.switch_backend("agg")
    raise SystemExit(main())
