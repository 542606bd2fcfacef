"""Speed of one trajectory with many coordinates relative to hand-written C, in one command.

    python benchmarks/large.py [--rows PATTERN] [--out DIR] [--check] [--list]

Each row has a target, the measured ratio with its quartiles, and "missed" where the target is
missed; `--check` exits with status 1 if one is. Ratios are those of processor times on one core, as
in speed.py: both sides once in each round, in random order, and the median of all rounds.

- The C side is large.c, compiled here for this machine. Implicit steps make the least number of
  iterations with which the states agree with those of the package to round-off; it is in the
  report. C has no test of convergence; "with the test of convergence" it has that of dvi.Picard.
- The package's side is what a user writes: `jax.jit` of `dvi.integrate` with status and
  `throw=False`, of a system of the library or of an own H_D.
- Before the times, the states of both sides after ten steps are compared.
- "Against XLA": the time over that of `Layout(form="arrays")`. "Against numba": loops as a user
  writes them, if numba is installed. Gradients and forward mode are relative to the forward run.
- First calls: processor time of tracing, compilation and run, in a fresh process without a cache.
"""

import argparse
import ctypes
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _baseline import NoCompilerError, compile_source
from _large_cases import CASES, Case, fput, fput_energy
from speed import (
    LEAST_ROUNDS,
    LONGEST_PROCESS,
    Clock,
    Measured,
    Row,
    as_text,
    line,
    measured,
    pin,
    processor,
    ratio,
    say,
)

import dvi_jax as dvi

SOURCE = Path(__file__).with_name("large.c")
AGREEMENT = 1e-11
"""Largest relative difference of the states after ten steps."""

CONVERGED = 2e-15
"""The same where the iterations of an implicit step have converged to round-off."""


# Measurements


class Bench:
    """A clock and the functions of large.c: shared by the rows."""

    def __init__(self, clock: Clock):
        self.clock = clock
        self._folder = tempfile.TemporaryDirectory(prefix="dvi_jax_large_")
        library = Path(self._folder.name) / "large.so"
        self.command = compile_source(SOURCE, library)
        self._library = ctypes.CDLL(str(library))

    def kernel(
        self, case: Case, steps: int, second: int = 0, saves: int = 0, name: str = ""
    ) -> Callable[[], list[np.ndarray]]:
        """The run in C: q, p and, where some are saved, all of them; `second`: the second size,
        iterations or every how many steps."""
        function = getattr(self._library, name or case.kernel)
        function.restype = None
        q0, p0 = case.start()
        n = q0.shape[0]
        sizes = (ctypes.c_long * 2)(n, second)
        constants = np.asarray([*case.constants, 0.0])
        memory = np.zeros(max(case.work * n, 1))

        def run() -> list[np.ndarray]:
            q, p = q0.copy(), p0.copy()
            work = np.empty((2, saves, n)) if saves else memory
            real, whole = ctypes.c_double(case.h), ctypes.c_long(steps)
            addresses = [ctypes.c_void_p(x.ctypes.data) for x in (q, p, constants, work)]
            function(*addresses[:2], sizes, whole, real, *addresses[2:])
            return [q, p, work]

        return run


def compare(found: Any, expected: Any, most: float = AGREEMENT) -> float:
    """Largest difference relative to the largest number. **Raises** `ValueError` if too large."""
    worst = max(
        float(np.max(np.abs(np.asarray(x) - y)) / np.max(np.abs(y)))
        for x, y in zip(found, expected, strict=True)
    )
    if not worst <= most:
        raise ValueError(f"after ten steps the states of both sides differ by {worst:.1e}.")
    return worst


def iterations_needed(bench: Bench, case: Case, states: Any) -> tuple[int, float]:
    """The least number of iterations of an implicit step in C with which the states after ten steps
    are those of the package to round-off, and their difference; 0 for an explicit step, and where C
    tests convergence."""
    if not case.is_iterated:
        return 0, compare(states, bench.kernel(case, 10)()[:2])
    for iterations in range(1, 20):
        try:
            states_of_c = bench.kernel(case, 10, iterations)()[:2]
            return iterations, compare(states, states_of_c, CONVERGED)
        except ValueError:
            continue
    raise ValueError("the states of both sides after ten steps differ with any iterations.")


def against_c(bench: Bench, name: str, steps: int | None = None, **settings) -> Measured:
    """The run to the last state."""
    case = CASES[name][0]()
    steps, start = steps or case.steps, case.start()
    found = jax.jit(case.final(10))(*start)[:2]
    iterations, worst = iterations_needed(bench, case, found)
    f = jax.jit(case.final(steps))
    times = bench.clock.times(lambda: f(*start), bench.kernel(case, steps, iterations))
    details = {"steps": steps, "iterations": iterations, "difference": worst}
    return ratio(times, **details)


def saved_row(bench: Bench, n: int, steps: int) -> Measured:
    """Each step saved, into new memory on both sides."""
    case, start = fput(n), fput(n).start()

    def rows(steps):
        def one(*start):
            solution = case.integrate(*start, steps, save=dvi.Save())
            return solution.qs, solution.ps, solution.result

        return jax.jit(one)

    compare(rows(10)(*start)[:2], bench.kernel(case, 10, 1, 11)()[2])
    f = rows(steps)
    times = bench.clock.times(lambda: f(*start), bench.kernel(case, steps, 1, steps + 1))
    return ratio(times, steps=steps)


def drift_row(bench: Bench, n: int, steps: int) -> Measured:
    """With the largest drift of the energy."""
    case, start = fput(n), fput(n).start()

    def with_drift(steps):
        def one(*start):
            solution = case.integrate(*start, steps, observe=dvi.MaxDrift(fput_energy))
            return solution.qs[-1], solution.ps[-1], solution.observed, solution.result

        return jax.jit(one)

    q, p, work = bench.kernel(case, 10, name="fput_drift")()
    *state, drift, _ = with_drift(10)(*start)
    compare(state, [q, p])
    energy = float(fput_energy(0.0, *start, case.args))
    if not abs(float(drift) - work[0]) < 1e-12 * energy:
        raise ValueError(f"the drifts are {float(drift)} and {work[0]}.")
    f = with_drift(steps)
    times = bench.clock.times(lambda: f(*start), bench.kernel(case, steps, name="fput_drift"))
    return ratio(times, steps=steps)


def xla_row(bench: Bench, name: str, steps: int) -> Measured:
    """Over the time of XLA for the same program."""
    case = CASES[name][0]()
    start = case.start()
    ours = jax.jit(case.final(steps))
    xla = jax.jit(case.final(steps, layout=dvi.Layout(form="arrays")))
    times = bench.clock.times(lambda: ours(*start), lambda: xla(*start))
    return ratio(times, steps=steps)


def gradient_row(bench: Bench, name: str, steps: int) -> Measured:
    """The reverse gradient of a loss of the final state over its forward run."""
    case = CASES[name][0]()
    start, loss = case.start(), case.loss(steps)
    forward, backward = jax.jit(loss), jax.jit(jax.grad(loss, (0, 1)))
    return ratio(bench.clock.times(lambda: backward(*start), lambda: forward(*start)), steps=steps)


def forward_mode_row(bench: Bench, name: str, steps: int) -> Measured:
    """The state and its derivative in one direction over the state alone."""
    case = CASES[name][0]()
    start, final = case.start(), case.final(steps)

    def state(q0, p0):
        return final(q0, p0)[:2]

    def both(q0, p0):
        return jax.jvp(state, (q0, p0), (jnp.ones_like(q0), jnp.ones_like(p0)))

    alone, both = jax.jit(state), jax.jit(both)
    return ratio(bench.clock.times(lambda: both(*start), lambda: alone(*start)), steps=steps)


def numba_row(bench: Bench, name: str, steps: int) -> Measured:
    """Over the time of loops in numba."""
    from _large_numba import LOOPS  # raises ImportError without numba

    case = CASES[name][0]()
    start, loop = case.start(), LOOPS[case.kernel]

    def run(steps):
        q, p = (x.copy() for x in start)
        loop(q, p, steps, case.h, *case.constants)
        return q, p

    compare(run(10), bench.kernel(case, 10)()[:2])
    f = jax.jit(case.final(steps))
    return ratio(bench.clock.times(lambda: f(*start), lambda: run(steps)), steps=steps)


def first_call(name: str, gradient: bool) -> float:
    """Seconds of the processor until the first result, in this process."""
    case = CASES[name][0]()
    start = [jnp.asarray(x) for x in case.start()]
    jax.block_until_ready(jnp.ones(2) + 1)
    began = time.process_time()
    f = jax.grad(case.loss(10), (0, 1)) if gradient else case.final(10)
    jax.block_until_ready(jax.jit(f)(*start))
    return time.process_time() - began


def first_call_row(bench: Bench, name: str, gradient: bool = False) -> Measured:
    """The same in fresh processes."""
    command = [sys.executable, __file__, "--child", json.dumps([name, gradient])]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "DVI_JAX_CACHE": "off"}
    samples = []
    for _ in range(LEAST_ROUNDS):
        done = subprocess.run(
            command,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=LONGEST_PROCESS,
        )
        if done.returncode:
            raise RuntimeError(f"the process failed: {done.stderr[-400:]}")
        samples.append(float(done.stdout.splitlines()[-1]))
    return Measured(samples, {})


def table() -> list[Row]:
    """The rows with their targets."""
    rows: list[Row] = []

    def add(title, target, measure, unit="×", /, **settings):
        rows.append(Row(title, target, functools.partial(measure, **settings), unit))

    for name, (_, target) in CASES.items():
        add(f"{name}, against C", target, against_c, name=name)
    add("FPUT 1000, every step saved, against C", 1.6, saved_row, n=1000, steps=2000)
    add("FPUT 1000, drift of the energy, against C", 1.6, drift_row, n=1000, steps=10_000)
    pairs = (("FPUT 1024", 2000), ("phi4 64²", 500), ("N-body 100", 100), ("Toda 1000", 2000))
    for name, steps in pairs:
        add(f"{name}, reverse gradient over forward run", 3.0, gradient_row, name=name, steps=steps)
        add(f"{name}, forward mode", 2.0, forward_mode_row, name=name, steps=steps)
    implicit = ("NLS 512, Picard", 100), ("FPUT 1000, GaussLegendre(2)", 100)
    others = ("FPUT 32", 20_000), ("FPUT 10⁶", 20), ("sine-Gordon 1000", 2000), ("phi4 32³", 50)
    more = ("chain 1000, Newton with a band", 5), ("FPUT 16384", 500)
    for name, steps in (*pairs, *others, *implicit, *more):
        add(f"{name}, against XLA", 1.1, xla_row, name=name.replace("10⁶", "1000000"), steps=steps)
    for name, steps in pairs[:3]:
        add(f"{name}, against numba", None, numba_row, name=name, steps=steps)
    for name in ("FPUT 1024", "FPUT 16384", "phi4 64²", "N-body 100", "Toda 1000"):
        add(f"{name}, first call", 0.5, first_call_row, "s", name=name)
        add(f"{name}, first gradient", 1.0, first_call_row, "s", name=name, gradient=True)
    return rows


# The command


def main() -> int:
    parser = argparse.ArgumentParser(description="Many coordinates: speed relative to C.")
    parser.add_argument("--rows", action="append", help="only rows whose name contains this")
    parser.add_argument("--rounds", type=int, default=15, help="of each row at most (default 15)")
    parser.add_argument("--budget", type=float, default=6.0, help="seconds of a row (default 6)")
    parser.add_argument("--core", type=int, help="to run on (default: the last one allowed)")
    parser.add_argument("--out", type=Path, help="folder for the report, large.json")
    parser.add_argument("--check", action="store_true", help="exit status 1 if a target is missed")
    parser.add_argument("--list", action="store_true", help="the names of the rows")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)
    if options.child:
        print(first_call(*json.loads(options.child)))
        return 0
    patterns = options.rows or [""]
    rows = [row for row in table() if any(p.lower() in row.name.lower() for p in patterns)]
    if options.list or not rows:
        print("\n".join(row.name for row in rows) or "no row has such a name; see --list.")
        return 0 if rows else 2
    os.environ.pop("XLA_FLAGS", None)
    os.environ["DVI_JAX_CACHE"] = "off"
    pinned = pin(options.core)
    try:
        bench = Bench(Clock(options.rounds, options.budget))
    except NoCompilerError as error:
        raise SystemExit(str(error)) from None
    say(f"# {processor()}, {pinned}\n# C: {' '.join(bench.command)}")
    results = []
    for row in rows:
        result = measured(row, bench)
        if "No module named 'numba'" in result.get("error", ""):
            say(f"  {row.name}: skipped, numba is not installed")
            continue
        results.append(result)
        say(f"  {line(result)}")
        jax.clear_caches()
    print(as_text(results))
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        report = {"processor": processor(), "pinned": pinned, "rows": results}
        text = json.dumps(report, indent=1, default=float)
        (options.out / "large.json").write_text(text, encoding="utf-8")
    bad = [result for result in results if result["status"] in ("missed", "failed")]
    return int(options.check and bool(bad))


if __name__ == "__main__":
    raise SystemExit(main())
