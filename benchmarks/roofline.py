"""The rows of speed.py as fractions of the limits of this processor, and what takes their time.

    python benchmarks/roofline.py [--rows PATTERN] [--out DIR]

For each row that is a ratio of processor times, the command

1. counts the instructions of one step, those of the package and those of baseline.c. Both are
   compiled once more with a probe at the begin of each basic block, and run for a few steps. A
   second process does this, so that what is timed has no probes.
2. measures the limits of one core (limits.c) and both sides of the row, in turn, and takes the
   least time of each: of arithmetic, divisions, square roots, loads, stores and memory.
3. divides the times by the limit: the time that the busiest unit of the processor takes for the
   instructions of one step, if all units work at once and no instruction waits for another. For
   one trajectory every instruction waits, and the limit is the time of the longest chain of
   instructions that need each other's results.

It requires an x86-64 processor with AVX, Linux and gcc.
"""

import argparse
import ctypes
import functools
import itertools
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
import speed
from _baseline import Baseline
from _instructions import CALLS, UNITS, Probes, baseline_with_probes, with_probes
from _workloads import WORKLOADS

import lanewise
from dvi_jax import plot
from lanewise.native import machine

LIMITS = Path(__file__).with_name("limits.c")
KINDS = ("vector", "single")
SIDES = ("package", "reference")
LEVELS = {"L1": 16 << 10, "L2": 512 << 10, "memory": 96 << 20}
"""Bytes of the arrays from which the bandwidth of a level of memory is measured."""

NEW_BYTES = 32 << 20
"""Bytes of an array in memory that the system has just given to the process."""

COUNTED_STEPS = (320, 640)
"""The counts are differences of two runs. Portions of 32 steps and of 10 saved rows divide both."""

COUNTED_LANES = 64
MEASURES = speed.batch_row, speed.last_axis_row, speed.one_row
OWN_MEASURES = speed.gradient_row, speed.forward_mode_row
"""Rows relative to C, and rows relative to the package's own run without derivative."""

LEAST_WORK = 4_000_000
"""Steps of all trajectories in a call of these rows: of shorter calls, the start takes time."""

# Counting


class CountingClock(speed.Clock):
    """It counts the instructions of the calls in place of their time."""

    def __init__(self, probes: Probes, latency: dict[str, float]):
        super().__init__(1, 0.0)
        self.probes, self.latency = probes, latency
        self.counts: list[dict[str, float]] = []

    def times(self, *calls: Callable[[], Any]) -> speed.Times:
        traces = [self.probes.trace(call) for call in calls]
        self.counts = [
            {**self.probes.counts(trace), "chain": self.probes.chain(trace, self.latency)}
            for trace in traces
        ]
        return speed.Times(*np.ones((2, 1, len(calls))))


def measure_of(row: speed.Row) -> functools.partial:
    """The function that measures a row, with its settings."""
    assert isinstance(row.measure, functools.partial)
    return row.measure


def counted(row: speed.Row, bench: speed.Bench, clock: CountingClock) -> list[dict[str, float]]:
    """The counts of both sides of a row for one step of one trajectory."""
    measure, results = measure_of(row), []
    settings = measure.keywords
    lanes = {"lanes": COUNTED_LANES} if "lanes" in settings else {}
    for steps in COUNTED_STEPS:
        measure.func(bench, **(settings | lanes | {"steps": steps}))
        results.append(clock.counts)
    work = (COUNTED_STEPS[1] - COUNTED_STEPS[0]) * lanes.get("lanes", 1)
    return [
        {key: (many[key] - few.get(key, 0.0)) / work for key in many}
        for few, many in zip(*results, strict=True)
    ]


def count_rows(
    rows: list[speed.Row], latency: dict[str, float], command: list[str]
) -> dict[str, Any]:
    """{row: counts of both sides}. Code that this process compiles from now on has probes.

    `latency` is in nanoseconds by kind and unit; `command` compiles the code of C.
    """
    probes = Probes()
    machine.object_code = functools.partial(with_probes, probes)
    lanewise.set_threads(1)
    clock = CountingClock(probes, latency)
    bench = speed.Bench(clock, baseline=baseline_with_probes(probes, command))
    return {row.name: counted(row, bench, clock) for row in rows}


# Limits


class Limits:
    """The loops of limits.c as calls; `work` has the instructions, or the bytes, of a call."""

    def __init__(self, library: ctypes.CDLL, width: int):
        self.calls: dict[str, Callable[[], Any]] = {}
        self.work: dict[str, int] = {}
        units = "fma", "add", "mul", "mix", "max", "memory", "div", "sqrt", *CALLS
        for kind, loop, unit in itertools.product(KINDS, ("rate", "latency"), units):
            if not hasattr(library, name := f"{kind}_{loop}_{unit}"):
                continue
            is_slow = loop == "latency" or unit in ("div", "sqrt", *CALLS)
            together = 12 if loop == "rate" and unit not in CALLS else 1
            rounds = (120_000 if is_slow else 1_200_000) // together
            function = functools.partial(library[name], ctypes.c_long(rounds))
            self.calls[f"{kind} {loop} {unit}"] = function
            self.work[f"{kind} {loop} {unit}"] = rounds * together
        raw = np.zeros(LEVELS["memory"] // 8 + 8)
        self._memory = raw[-raw.ctypes.data % 64 // 8 :]
        ways = [*itertools.product(("read", "write"), LEVELS), ("stream", "memory")]
        for way, level in [*ways, ("write", "new memory"), ("stream", "new memory")]:
            size = LEVELS.get(level, NEW_BYTES)
            rounds = max(1, (32 << 20) // size)
            count = size // (8 * width)
            function = getattr(library, f"memory_{way}")
            call = functools.partial(self._through, function, rounds, count, level in LEVELS)
            self.calls[f"{way} {level}"], self.work[f"{way} {level}"] = call, rounds * size

    def _through(self, function: Any, rounds: int, count: int, is_old: bool) -> None:
        array = self._memory if is_old else np.empty(NEW_BYTES // 8 + 8)
        address = array.ctypes.data + (-array.ctypes.data % 64)
        function(ctypes.c_long(rounds), ctypes.c_long(count), ctypes.c_void_p(address))

    def costs(self, seconds: Iterable[float]) -> dict[str, float]:
        """Nanoseconds of an instruction, or of a byte, by name."""
        pairs = zip(self.work.items(), seconds, strict=True)
        return {name: 1e9 * second / work for (name, work), second in pairs}

    def only(self, pattern: str) -> None:
        """Leave out the loops whose name does not fit the pattern."""
        for name in [name for name in self.work if not re.search(pattern, name)]:
            del self.calls[name], self.work[name]


class LimitClock(speed.Clock):
    """A clock that measures the limits in each round, too, and takes the least of all rounds."""

    def __init__(self, limits: Limits, rounds: int, budget: float):
        super().__init__(rounds, budget)
        self.limits, self.least, self.bytes = limits, np.zeros(0), 0

    def times(self, *calls: Callable[[], Any]) -> speed.Times:
        both = super().times(*calls, *self.limits.calls.values())
        self.least = both.processor.min(axis=0)
        self.bytes = sum(x.nbytes for x in jax.tree.leaves(calls[0]()))
        return speed.Times(both.processor[:, : len(calls)], both.wall[:, : len(calls)])


def bounds(count: dict[str, float], cost: dict[str, float]) -> dict[str, float]:
    """Nanoseconds of a step for each unit, if it alone limited the time."""

    def time_of(units: Iterable[str], measured: str | None = None) -> float:
        return sum(
            count.get(f"{kind} {unit}", 0.0) * cost[f"{kind} rate {measured or unit}"]
            for kind, unit in itertools.product(KINDS, units)
            if count.get(f"{kind} {unit}")
        )

    calls = time_of(CALLS)
    arithmetic = ("fma", "mul", "add", "max", "other", "div", "sqrt")
    return {
        "arithmetic": calls
        + max(time_of(arithmetic, "mix"), time_of(("fma", "mul"), "fma"), time_of(("add",))),
        "division": calls + time_of(("div", "sqrt")),
        "loads": calls + count["read"] * cost["read L1"],
        "stores": calls + count["written"] * cost["write L1"],
    }


def compared(row: speed.Row, bench: speed.Bench, counts: list[dict[str, float]]) -> dict[str, Any]:
    """A row of the report: times, limits and counts of both sides for a step of a trajectory."""
    measure = measure_of(row)
    settings = dict(measure.keywords)
    if measure.func in OWN_MEASURES:
        settings["steps"] = max(settings["steps"], LEAST_WORK // settings["lanes"])
    measure.func(bench, **settings)
    clock = bench.clock
    assert isinstance(clock, LimitClock)
    lanes = settings.get("lanes", 1)
    work = settings["steps"] * lanes
    cost = clock.limits.costs(clock.least[2:])
    start = 16 * WORKLOADS[settings["name"]].n * lanes
    if clock.bytes > NEW_BYTES / 2:
        written = min(cost[f"{way} new memory"] for way in ("write", "stream"))
    else:
        written = cost["write L2"]
    memory = (start * cost["read L2"] + clock.bytes * written) / work
    sides = {}
    for side, count, seconds in zip(SIDES, counts, clock.least, strict=False):
        units = bounds(count, cost) | {"memory": memory}
        unit = max(units, key=lambda name: units[name])
        if lanes == 1 and count["chain"] > units[unit]:
            unit = "chain"
        units["chain"] = count["chain"]
        side_limit = {"limit": units[unit], "unit": unit, "bounds": units, "counts": count}
        sides[side] = {"time": 1e9 * seconds / work, **side_limit}
    return {
        "row": row.name,
        "is_to_c": measure.func not in OWN_MEASURES,
        "bytes": (start + clock.bytes) / work,
        "costs": cost,
        **sides,
    }


# The report

HEAD = (
    "| row | operations, C | dvi_jax | limit (ns) | unit | C / limit | dvi_jax / limit "
    "| dvi_jax / its limit | or its chain |\n|---|---|---|---|---|---|---|---|---|"
)


def operations(side: dict[str, Any]) -> float:
    """Operations on floating numbers of one step; a fused multiply-add is one."""
    return sum(side["counts"].get(unit, 0.0) for unit in (*UNITS, *CALLS))


def lowest(result: dict[str, Any]) -> dict[str, Any]:
    """The side with the lower limit: of both, or the package's if the reference is its own."""
    sides = [result["package"], *([result["reference"]] if result["is_to_c"] else [])]
    return min(sides, key=lambda side: side["limit"])


def line(result: dict[str, Any]) -> str:
    package, reference, limit = result["package"], result["reference"], lowest(result)
    cells = [result["row"], f"{operations(reference):.0f}", f"{operations(package):.0f}"]
    has_calls = any(limit["counts"].get(call) for call in CALLS)
    cells += [f"{limit['limit']:.3g}", limit["unit"] + ", sin, cos" * has_calls]
    cells += [
        f"{reference['time'] / limit['limit']:.2f}",
        f"{package['time'] / limit['limit']:.2f}",
    ]
    if not result["is_to_c"]:
        cells[1] = cells[5] = "–"
    longest = max(package["limit"], package["bounds"]["chain"])
    cells += [f"{package['time'] / slowest:.2f}" for slowest in (package["limit"], longest)]
    return "| " + " | ".join(cells) + " |"


def as_text(report: dict[str, Any]) -> str:
    """The limits of the processor and the table of the rows."""
    lines = ["| loop | cost |", "|---|---|"]
    for name, cost in report["costs"].items():
        is_memory = name.split()[0] in ("read", "write", "stream")
        value, unit = (1 / cost, "GB/s") if is_memory else (cost, "ns")
        lines.append(f"| {name} | {value:.3g} {unit} |")
    return "\n".join([*lines, "", HEAD, *map(line, report["rows"])])


def picture(report: dict[str, Any], path: Path) -> None:
    """Operations per second under the roofs, and times relative to the limit."""
    results = report["rows"]
    with plot.style():
        size = (10, 1.6 + 0.2 * len(results))
        figure, (left, right) = plt.subplots(1, 2, figsize=size, width_ratios=(4, 5))
        for side, look, name in (("reference", "C1o", "C"), ("package", "C0s", "dvi_jax")):
            shown = [r for r in results if side == "package" or r["is_to_c"]]
            ratios = [r[side]["time"] / lowest(r)["limit"] for r in shown]
            right.semilogx(ratios, [results.index(r) for r in shown], look, label=name)
            batches = [r for r in shown if not r["row"].startswith("one trajectory")]
            counts = np.array([operations(r[side]) for r in batches])
            bytes_, times = np.transpose([(r["bytes"], r[side]["time"]) for r in batches])
            left.loglog(counts / bytes_, counts / times, look, label=name)
        _roofs(left, report["costs"], report["width"])
        own = [r["package"]["limit"] / lowest(r)["limit"] for r in results]
        right.semilogx(own, range(len(own)), "k|", ms=9, label="limit of dvi_jax's operations")
        right.axvspan(1, 1.3, color="0.9", lw=0, zorder=0)
        right.set_yticks(range(len(results)), [r["row"] for r in results], fontsize=8)
        right.set(ylim=(len(results) - 0.4, -0.6), xlabel="time / limit")
        ticks = (1, 1.5, 2, 3, 5, 10)
        right.set_xticks(ticks, map(str, ticks))
        right.set_xticks([], minor=True)
        right.legend(loc="upper right", frameon=True)
        left.legend(loc="lower right", frameon=True)
        figure.savefig(path)
        plt.close(figure)


def _roofs(ax: Any, costs: dict[str, float], width: int) -> None:
    """The largest rate of operations for a number of operations per byte."""
    intensity = np.geomspace(0.2, 1e5, 400)
    top = width / costs["vector rate mix"]
    new = min(costs["write new memory"], costs["stream new memory"])
    for name, cost in (("L2 cache", costs["write L2"]), ("new memory", new)):
        ax.loglog(intensity, np.minimum(top, intensity / cost), color="0.4", lw=1)
        height = (0.75 if name == "L2 cache" else 0.45) * top
        white = {"fc": "white", "ec": "none", "pad": 1}
        ax.annotate(name, (1.2 * height * cost, height), va="top", fontsize=8, bbox=white)
    ax.annotate("multiply-adds of vectors", (intensity[-1], 1.03 * top), ha="right", fontsize=8)
    ax.set(ylim=(4, 1.2 * top), xlabel="operations per byte of inputs and outputs")
    ax.set_ylabel("operations per nanosecond")
    ax.set_yticks((5, 10, 20, 50), ("5", "10", "20", "50"))
    ax.set_yticks([], minor=True)


# The command


def rows_of(patterns: list[str] | None) -> list[speed.Row]:
    """The rows that are ratios of two runs of this process."""
    rows = speed.chosen(patterns)
    return [row for row in rows if measure_of(row).func in (*MEASURES, *OWN_MEASURES)]


def command_of(baseline: Baseline) -> list[str]:
    """The words that compile the code of C as this library was compiled."""
    return [*baseline.command, *(["-DHAVE_LIBMVEC"] if baseline.has_libmvec else [])]


def counts_of(*arguments: Any) -> dict[str, Any]:
    """The result of `count_rows` in a process of its own, in which the code has probes."""
    done = subprocess.run(
        [sys.executable, __file__, "--count", json.dumps(arguments)],
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="The rows of speed.py relative to their limit.")
    parser.add_argument("--rows", action="append", help="only rows whose name contains this")
    parser.add_argument("--rounds", type=int, default=40, help="of each row at most (default 40)")
    parser.add_argument("--budget", type=float, default=6.0, help="seconds of a row (default 6)")
    parser.add_argument(
        "--out", type=Path, help="folder for JSON and a picture; its other rows stay"
    )
    parser.add_argument("--counts", type=Path, help="the JSON whose counts are used again")
    parser.add_argument("--count", help=argparse.SUPPRESS)
    options = parser.parse_args(words)
    if platform.machine() != "x86_64" or sys.platform != "linux":
        raise SystemExit("the instructions are counted on x86-64 processors with Linux only.")
    os.environ["DVI_JAX_CACHE"] = "off"
    pinned = speed.pin(None)
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)
    if options.count:
        patterns, *others = json.loads(options.count)
        print(json.dumps(count_rows(rows_of(patterns), *others)))
        return 0
    bench = speed.Bench(speed.Clock(options.rounds, options.budget), baseline=Baseline(LIMITS))
    limits = Limits(bench.baseline.library, bench.baseline.width)
    alone = speed.Clock(options.rounds, options.budget).times(*limits.calls.values())
    costs = limits.costs(alone.processor.min(axis=0))
    latency = {
        name.replace("latency ", ""): cost for name, cost in costs.items() if "latency" in name
    }
    latency |= {f"{kind} {f}": costs[f"{kind} rate {f}"] for kind in KINDS for f in CALLS}
    speed.say(f"# {speed.processor()}, {pinned}; C: {bench.baseline}")
    if options.counts:
        rows = json.loads(options.counts.read_text(encoding="utf-8"))["rows"]
        counts = {r["row"]: [r[side]["counts"] for side in SIDES] for r in rows}
    else:
        counts = counts_of(options.rows, latency, command_of(bench.baseline))
    limits.only(r"rate|L[12]|new")
    bench.clock = LimitClock(limits, options.rounds, options.budget)
    report = {"machine": speed.processor(), "width": bench.baseline.width, "costs": costs}
    report["rows"] = []
    file = options.out / "roofline.json" if options.out else None
    if file and file.exists():
        before = json.loads(file.read_text(encoding="utf-8"))
        names = [row.name for row in rows_of(options.rows)]
        report["rows"] = [result for result in before["rows"] if result["row"] not in names]
        costs |= {name: min(cost, costs[name]) for name, cost in before["costs"].items()}
    for row in rows_of(options.rows):
        result = compared(row, bench, counts[row.name])
        report["rows"].append(result)
        speed.say(line(result))
        costs |= {name: min(cost, costs[name]) for name, cost in result["costs"].items()}
    order = [row.name for row in speed.table()]
    report["rows"].sort(key=lambda result: order.index(result["row"]))
    print(as_text(report))
    if file:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(report, indent=1), encoding="utf-8")
        picture(report, options.out / "roofline.png")
    return 0


if __name__ == "__main__":
    plt.switch_backend("agg")
    raise SystemExit(main())
