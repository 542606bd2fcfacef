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
from .output import Output, Report, output_for, provenance
from .schema import RunFile
from .system import Source, find_source
from .table import read_file

WRITTEN = (
    "trajectory.npz", "report.json",
    "invariants.png", "trajectory.png", "orbits.png", "ephemeris.png",
)  # fmt: skip
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
    path = Path(path)
    file, raw = read_file(path, RunFile)
    output = output_for(path, out, file.output.dir, WRITTEN, force)
    with output.reserved():
        source = find_source(file, path.parent)
        run = run_arguments(file, source)
        observables = {
            "own": read_observables(file.observables, source),
            "always": {} if source.jd is None else solar.conserved(),
        }
        began = time.perf_counter()
        solution = _integrate(source, run, observables, progress)
        seconds = time.perf_counter() - began
    observed = {
        part: observe(run, observables[part], solution.observed[part]) for part in observables
    }
    contents = provenance("run", path, raw) | _results(solution, observed["own"], seconds)
    report = Report(contents, message=_failure(contents["status"]), folder=output.folder)
    with output.writing():
        _write(report, output, source, run, solution, observed, file.output.plots)
    stats = contents["stats"]
    report.summary = f"{stats['num_steps']} steps in {seconds:.1f} s (compilation included)"
    return report


def run_arguments(file: RunFile, source: Source) -> dict[str, Any]:
    """The arguments of `dvi.integrate`, without observables.

    **Raises** `InputError`.
    """
    (q0, p0), args = source.state, source.args
    source.check_start(q0, p0, args)
    lattice, h, steps = source.times(file)
    if source.jd is not None:
        _check_dates(source.jd, lattice, h, steps)
    return {
        "system": source.system, "q0": q0, "p0": p0, "h": h, "num_steps": steps, "t0": file.t0,
        "epsilon": file.epsilon, "args": args, "method": parse_method(file.method),
        "lattice": lattice, "save": dvi.Save(every=file.output.every, final=True),
    }  # fmt: skip


def _check_dates(jd: float, lattice: dvi.Lattice, h: Any, steps: Any) -> None:
    """Reject, before the work, a run that leaves the ephemeris that it is compared with."""
    ts = lattice.ts if isinstance(lattice, dvi.Given) else (0.0, h * steps)
    span = float(ts[-1] - ts[0])
    try:
        check_covered(jd + span)
    except ValueError as error:
        seen = f"the run ends {span:g} days after its start: {error}"
        raise InputError("steps", seen, "fewer steps, a smaller h, or another date") from None


def _integrate(
    source: Source, run: dict[str, Any], observables: dict[str, Any], progress: Any
) -> dvi.Solution:
    try:
        solution = dvi.integrate(**run, observe=observables, throw=False, progress=progress)
        return jax.block_until_ready(solution)
    except Exception as error:  # also whatever a user's function raises while it is traced
        allowed = "functions, state and args that fit one another"
        raise source.misfit("system", "integrated", error, allowed) from error


def _results(
    solution: dvi.Solution, observed: dict[str, Observed], seconds: float
) -> dict[str, Any]:
    stats = {name: np.asarray(value) for name, value in solution.stats.items()}
    return {
        "status": {
            "result": solution.status,
            "message": dvi.RESULTS[solution.result],
            "failed_step": int(stats["failed_step"]),
            "failed_residual": float(stats["failed_residual"]),
            "num_steps": int(stats["num_steps"]),
        },
        "stats": stats | {"seconds": seconds, "saved": len(solution.ts)},
        "results": {name: found.summary() for name, found in observed.items()},
    }


def _failure(status: dict[str, Any]) -> str:
    if status["result"] == "successful":
        return ""
    return (
        f"the trajectory failed at step {status['failed_step']} of {status['num_steps']} with "
        f"{status['result']} (relative residual {status['failed_residual']:.3g}).\n"
        f"{status['message']}\nThe results up to that step have been written."
    )


def _write(
    report: Report,
    output: Output,
    source: Source,
    run: dict[str, Any],
    solution: dvi.Solution,
    observed: dict[str, dict[str, Observed]],
    plots: bool,
) -> None:
    own, always = observed["own"], observed["always"]
    arrays = {name: np.asarray(getattr(solution, name)) for name in ("ts", "qs", "ps", "hs")}
    values = {f"observed/{name}": np.asarray(solution.observed["own"][name]) for name in own}
    saved: Any = arrays | values
    np.savez(output.folder / "trajectory.npz", **saved)
    ts, qs, ps, _ = arrays.values()
    if own:
        report.tables.append(_table(own))
    if source.jd is None:
        pictures = _pictures(source, ts, qs, ps, own)
    else:
        found = solar.compare(source.jd + (ts - ts[0]), qs, ps, np.asarray(run["args"]["masses"]))
        share = solar.own_share(run, qs, ps)
        solar.report(report, found, always, share)
        pictures = solar.pictures(found, always, run)
    output.write_json("report.json", report.contents)
    report.files += ["trajectory.npz", "report.json"]
    if plots:  # after the numbers: a picture that fails costs no result
        report.files += output.draw(pictures)


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
    return Table(
        "Observables (changes: relative, where the start is not zero)",
        ["name", "reduction", "start", "end or value", "change"],
        rows,
    )


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
    unit = source.units.get("t", "")
    time = "t" if unit in ("", "1") else f"t [{unit}]"
    position, momentum = source.units.get("q"), source.units.get("p")
    title = source.name.replace("_", " ")
    drawn = {"trajectory.png": lambda: plot.trajectory(ts, qs, ps, time, position, momentum, title)}
    series = {_label(n, found): found.change() for n, found in observed.items()
              if not found.reduction}  # fmt: skip
    if series:
        drawn["invariants.png"] = lambda: plot.changes(ts, series, time, f"{title}: observables")
    return drawn


def _label(name: str, found: Observed) -> str:
    size = "" if found.values.ndim == 1 else "size of "
    kind = "relative change" if found.is_relative else "change"
    return f"{name.replace('_', ' ')}\n{size}{kind}"
