"""One run: read, integrate, compare, write."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.systems.solar_system import check_covered

from .._errors import InputError
from .._show import Table
from . import solar
from .expressions import parse_method
from .observables import Observed, observe, read_observables
from .output import Report, opened
from .schema import RunFile
from .system import Source, find_source

_IMAGES = ("invariants.png", "trajectory.png", "orbits.png", "ephemeris.png")
WRITTEN = ("trajectory.npz", "report.json", *_IMAGES)
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

    Writes trajectory.npz (ts, qs, ps, hs and ``observed/<name>``), report.json and pictures. A
    trajectory that fails is written up to its failure, and ``ok`` is False.

    **Raises** `InputError` for bad input; nothing is written then.
    """
    file, output = opened("run", Path(path), out, WRITTEN, force)
    with output.reserved():
        source = find_source(file, Path(path).parent)
        run = run_arguments(file, source)
        observe_own = read_observables(file.observables, source)
        always = {} if source.jd is None else solar.conserved()
        began = time.perf_counter()
        asked = {"own": observe_own, "always": always}
        try:
            found = dvi.integrate(**run, observe=asked, throw=False, progress=progress)
            jax.block_until_ready(found)
        except Exception as error:  # also whatever a user's function raises while it is traced
            allowed = "functions, state and args that fit one another"
            raise source.misfit("system", "integrated", error, allowed) from error
        seconds = time.perf_counter() - began
    with output.writing():
        own = observe(run, observe_own, found.observed["own"])
        contents = output.about | _results(found, own, seconds)
        arrays = {name: np.asarray(getattr(found, name)) for name in ("ts", "qs", "ps", "hs")}
        values = {f"observed/{name}": np.asarray(found.observed["own"][name]) for name in own}
        output.write_arrays("trajectory.npz", arrays | values)
        report = Report(contents, [_table(own)] if own else [], folder=output.folder)
        ts, qs, ps, _ = arrays.values()
        if source.jd is None:
            pictures = _pictures(source, ts, qs, ps, own)
        else:
            observed = observe(run, always, found.observed["always"])
            pictures = solar.report(report, source.jd + (ts - ts[0]), qs, ps, run, observed)
        output.write_json("report.json", contents)
        if file.output.plots:
            output.draw(pictures)
    report.files, report.message = output.files, _failure(contents["status"])
    steps = contents["stats"]["num_steps"]
    report.summary = f"{steps} steps in {seconds:.1f} s (compilation included)"
    return report


def run_arguments(file: RunFile, source: Source) -> dict[str, Any]:
    """The arguments of `dvi.integrate`, without observables.

    **Raises** `InputError`.
    """
    (q0, p0), args = source.state, source.args
    source.check_start(q0, p0, args)
    method, save = parse_method(file.method), dvi.Save(every=file.output.every, final=True)
    run = {"system": source.system, "q0": q0, "p0": p0, "args": args, "method": method}
    run |= {"save": save, **source.times(file)}
    if source.jd is not None:  # a run that is compared with the ephemeris must not leave it
        ts = file.lattice.times if run["h"] is None else (0.0, run["h"] * run["num_steps"])
        span = float(ts[-1] - ts[0])
        try:
            check_covered(source.jd + span)
        except ValueError as error:
            seen = f"the run ends {span:g} days after its start: {error}"
            raise InputError("steps", seen, "fewer steps, a smaller h, or another date") from None
    return run


def _results(found: dvi.Solution, own: dict[str, Observed], seconds: float) -> dict[str, Any]:
    stats = {name: np.asarray(value) for name, value in found.stats.items()}
    return {
        "status": {
            "result": found.status,
            "message": dvi.RESULTS[found.result],
            "failed_step": int(stats["failed_step"]),
            "failed_residual": float(stats["failed_residual"]),
            "num_steps": int(stats["num_steps"]),
        },
        "stats": stats | {"seconds": seconds, "saved": len(found.ts)},
        "results": {name: observed.summary() for name, observed in own.items()},
    }


def _failure(status: dict[str, Any]) -> str:
    if status["result"] == "successful":
        return ""
    return (
        f"the trajectory failed at step {status['failed_step']} of {status['num_steps']} with "
        f"{status['result']} (relative residual {status['failed_residual']:.3g}).\n"
        f"{status['message']}\nThe results up to that step have been written."
    )


def _table(observed: dict[str, Observed]) -> Table:
    rows = []
    for name, found in observed.items():
        s = found.summary()
        if found.reduction:
            relative = f"{s['relative']:.2e}" if "relative" in s and found.is_relative else ""
            rows.append([name, found.reduction, "", _number(s["value"], 4), relative])
        else:
            change = f"{s['largest_saved_change']:.2e}"
            rows.append([name, "", _number(s["start"]), _number(s["end"]), change])
    title = "Observables (changes: relative, where the start is not zero)"
    return Table(title, ["name", "reduction", "start", "end or value", "change"], rows)


def _number(value: Any, most: int = 0) -> str:
    """A number, up to `most` of them one by one, or the size of an array."""
    value = np.asarray(value)
    if value.ndim == 0:
        return f"{float(value):.8g}"
    if value.ndim == 1 and value.size <= most:
        return ", ".join(f"{x:.3g}" for x in value)
    return f"|…| = {np.linalg.norm(value):.3g}"


def _pictures(
    source: Source, ts: np.ndarray, qs: np.ndarray, ps: np.ndarray, observed: dict[str, Observed]
) -> dict[str, Any]:
    """File name → function that draws: the trajectory, and the changes of the observables."""
    unit, title = source.units.get("t", ""), source.name.replace("_", " ")
    time = "t" if unit in ("", "1") else f"t [{unit}]"
    units = source.units.get("q"), source.units.get("p")
    drawn = {"trajectory.png": lambda: plot.trajectory(ts, qs, ps, time, *units, title)}
    series = {}
    for name, found in observed.items():
        if not found.reduction:
            size = "" if found.values.ndim == 1 else "size of "
            kind = "relative change" if found.is_relative else "change"
            series[f"{name.replace('_', ' ')}\n{size}{kind}"] = found.change()
    if series:
        drawn["invariants.png"] = lambda: plot.changes(ts, series, time, f"{title}: observables")
    return drawn
