"""One run: read, integrate, compare, write."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.sweep.axes import place
from dvi_jax.systems.n_body import OBSERVABLES
from dvi_jax.systems.planets.solar_system import check_covered

from .._errors import as_input_error, user_path
from .._show import TextTable
from . import solar
from .observables import Observed, observe, read_observables, with_drifts
from .output import Report, open_report
from .schema import RunFile
from .system import Source, find_source

SOLAR_IMAGES = ("orbits.png", "ephemeris.png", "invariants.png")
"""Pictures of the comparison with an ephemeris."""

RESULT_FILES = ("trajectory.npz", "report.json", "trajectory.png", *SOLAR_IMAGES)
"""Every file that a run may write; with `force` these are replaced and nothing else."""


def run_file(
    path: str | Path,
    out: str | Path | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """The run that a TOML file describes.

    - `path`: the file; its keys are in `RunFile` and in the documentation.
    - `out`: directory to write to instead of the file's ``output.dir``; either is relative to
      the working directory. It must not exist, or be empty.
    - `force`: replace the results of an earlier run there.
    - `progress`: called as ``progress(steps_done, steps)``.

    Writes trajectory.npz (ts, qs, ps, hs, ``observed/<name>`` and ``jumps/<name>``), report.json
    and pictures. A trajectory that fails is written up to its failure, and ``ok`` is False.

    **Raises** `InputError` for bad input; nothing is written then.
    """
    path = user_path("CONFIG", path)
    file, report = open_report("run", path, out, RESULT_FILES, force)
    with report.reservation():
        source = find_source(file, path.parent)
        run = _arguments(file, source)
        # Those of the file come in the report; the ephemeris is compared with the same in each run.
        observables = {"own": read_observables(file.observables, source)}
        observables["always"] = {} if source.jd is None else with_drifts(OBSERVABLES)
        began = time.perf_counter()
        rule = "functions, state and args that fit one another"
        with source.at_work("system", "integrated", rule):
            result = dvi.integrate(**run, observe=observables, throw=False, progress=progress)
            jax.block_until_ready(result)
        seconds = time.perf_counter() - began
    with report.writing():
        changes = [observe(run, observables[x], result.observed[x]) for x in ("own", "always")]
        observed, conservation = changes
        units = dict(source.problem.units) if source.problem is not None else {}
        report.contents |= {"name": source.name, "units": units}
        _describe(report, result, observed, seconds)
        arrays = {name: np.asarray(getattr(result, name)) for name in ("ts", "qs", "ps", "hs")}
        leaves = jax.tree.leaves_with_path(result.observed["own"])  # several of a section
        values = {f"observed/{place(path)}": np.asarray(leaf) for path, leaf in leaves}
        jumps = {} if result.jumps is None else vars(result.jumps)
        values |= {f"jumps/{name}": np.asarray(value) for name, value in jumps.items()}
        report.write_arrays("trajectory.npz", arrays | values)
        ts, qs, ps, _ = arrays.values()
        if source.jd is None:
            pictures = run_pictures(report.contents, ts, qs, ps, observed)
        else:
            pictures = solar.report(report, source.jd + (ts - ts[0]), qs, ps, run, conservation)
        report.write_contents("report.json")
        if file.output.plots:
            report.draw(pictures)
    return report


def _arguments(file: RunFile, source: Source) -> dict[str, Any]:
    """The arguments of `dvi.integrate`, without observables."""
    q0, p0, args = source.array("q0"), source.array("p0"), source.args
    source.check_start(q0, p0, args)
    method, save = source.method(file.method), dvi.Save(every=file.output.every, final=True)
    run = {"system": source.system, "q0": q0, "p0": p0, "args": args, "method": method}
    run |= {"save": save, "jump": source.jump, **source.times(file)}
    if source.jd is not None:  # a run that is compared with the ephemeris must not leave it
        ts = file.lattice.times if run["h"] is None else (0.0, run["h"] * run["num_steps"])
        span = float(ts[-1] - ts[0])
        prefix = f"the run ends {span:g} days after its start: "
        with as_input_error("steps", "a shorter run or another date", prefix=prefix):
            check_covered(source.jd + span)
    return run


def _describe(
    report: Report, solution: dvi.Solution, observed: dict[str, Observed], seconds: float
) -> None:
    """Add status, statistics and observables to the report."""
    stats = {name: np.asarray(value) for name, value in solution.stats.items()}
    step, steps = int(stats["failed_step"]), int(stats["num_steps"])
    residual, message = float(stats["failed_residual"]), dvi.RESULTS[solution.result]
    status = {"result": solution.status, "message": message, "failed_step": step}
    report.contents |= {
        "status": status | {"failed_residual": residual, "num_steps": steps},
        "stats": stats | {"seconds": seconds, "saved": len(solution.ts)},
        "results": {name: entry.summary() for name, entry in observed.items()},
    }
    report.tables += run_tables(report.contents["results"])
    report.summary = f"{steps} steps in {seconds:.1f} s (compilation included)"
    if solution.status != "successful":
        report.message = (
            f"the trajectory failed at step {step} of {steps} with {solution.status} (relative "
            f"residual {residual:.3g}).\n{message}\nThe results up to that step have been written."
        )


def run_tables(results: dict[str, Any]) -> list[TextTable]:
    """The table of the observables, from their entries in the report; none without observables."""
    title = "Observables (changes: relative, where the start is not zero)"
    columns = ["name", "reduction", "start", "end or value", "change"]
    return [TextTable(title, columns, [_row(*x) for x in results.items()])] if results else []


def _row(name: str, summary: dict[str, Any]) -> list[str]:
    if "reduction" in summary:
        has_relative = "relative" in summary and summary["scale"] != 1.0
        relative = f"{summary['relative']:.2e}" if has_relative else ""
        return [name, summary["reduction"], "", _number(summary["value"], 4), relative]
    change = f"{summary['largest_saved_change']:.2e}"
    return [name, "", _number(summary["start"]), _number(summary["end"]), change]


def _number(value: Any, limit: int = 0) -> str:
    """A number, up to `most` of them one by one, or the size of an array."""
    value = np.asarray(value)
    if value.ndim == 0:
        return f"{float(value):.8g}"
    if value.ndim == 1 and value.size <= limit:
        return ", ".join(f"{x:.3g}" for x in value)
    return f"|…| = {np.linalg.norm(value):.3g}"


def run_pictures(
    contents: dict[str, Any],
    ts: np.ndarray,
    qs: np.ndarray,
    ps: np.ndarray,
    observed: dict[str, Observed],
) -> dict[str, Any]:
    """File name → function that draws: the trajectory, and the changes of the observables.

    - `contents`: of the report, with `name` and `units`.
    """
    units = contents["units"]
    unit, title = units.get("t", ""), contents["name"].replace("_", " ")
    time = "t" if unit in ("", "1") else f"t [{unit}]"
    of_state = units.get("q"), units.get("p")
    pictures = {"trajectory.png": lambda: plot.trajectory(ts, qs, ps, time, *of_state, title)}
    series = {}
    for name, observable in observed.items():
        if not observable.reduction:
            size = "" if observable.values.ndim == 1 else "size of "
            kind = "relative change" if observable.is_relative else "change"
            series[f"{name.replace('_', ' ')}\n{size}{kind}"] = observable.change()
    if series:
        pictures["invariants.png"] = lambda: plot.changes(ts, series, time, f"{title}: observables")
    return pictures
