"""A sweep from a TOML file; the state of a store."""

import dataclasses
import json
import math
import os
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

import dvi_jax as dvi
from dvi_jax.sweep.bar import shown as shown_bar
from dvi_jax.sweep.variables import RESERVED

from .._errors import InputError, require
from .._show import Table
from .output import Report, recorded
from .schema import SweepFile
from .sweep_problem import sweep_problem
from .table import read_file

_MOST = 10_000_000
"""Numbers up to which results are read again for the table at the end."""

_NOT_OURS = ("config", "config_sha256", "Conventions", "coordinates", "dvi_jax_sweep")
"""Attributes of a store that say how to read it, not where it comes from."""

_ALLOWED = "axes, functions, state and args that fit one another"


def sweep_file(
    path: str | Path,
    store: str | Path | None = None,
    resume: bool = False,
    threads: int | None = None,
    progress: bool | Callable[[dvi.SweepProgress], None] | None = None,
) -> Report:
    """The sweep that a TOML file describes, saved in a store.

    - `path`: the file; its keys are in `SweepFile` and in the documentation.
    - `store`: directory to write to instead of the file's ``output.store``; either is relative to
      the working directory. It must not exist, or be empty, unless
    - `resume`: continue with the store there; begin where there is none.
    - `threads`, `progress`: as for `dvi.sweep`.

    **Raises** `InputError` for bad input, nothing is written then; `StoreMismatch`
    for a store of another sweep, `StoreError` or `OSError` for one that cannot be written;
    `SweepInterrupted` after Ctrl-C.
    """
    path = Path(path)
    file, _ = read_file(path, SweepFile)
    folder = Path(store or file.output.store or f"results/{path.stem}.zarr")
    _check_folder(folder, "--store" if store is not None else "output.store", resume)
    source, arguments = sweep_problem(file, path.parent)
    last: list[dvi.SweepProgress] = []
    with shown_bar(progress) as show, source.at_work(str(path), "swept", _ALLOWED, last):
        arguments |= {"store": folder, "threads": threads, "progress": recorded(last, show)}
        result = dvi.sweep(**arguments)
    return _finished(result, last[0])


def sweep_cost(path: str | Path) -> Report:
    """What the sweep of a TOML file would take, and larger ones: the summary has a table. One task
    is computed and timed for it, and nothing is written.

    **Raises** `InputError` for bad input.
    """
    file, _ = read_file(Path(path), SweepFile)
    source, arguments = sweep_problem(file, Path(path).parent)
    with source.at_work(str(path), "swept", _ALLOWED):
        cost = dvi.sweep_cost(**arguments)
    contents = dataclasses.asdict(cost) | {"seconds": cost.seconds()}
    return Report(contents, summary=f"{cost}\n\n{cost.table()}")


def _check_folder(folder: Path, key: str, resume: bool) -> None:
    """Fail early if the path holds other data, or this sweep without --resume."""
    try:
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return
        result = dvi.open_sweep(folder)
    except (dvi.StoreError, OSError) as error:
        seen = f"{folder} exists, and is not the store of a sweep ({error})"
        raise InputError(key, seen, "a new directory") from None
    except ValueError as error:  # a name that no directory can have
        raise InputError(key, f"{folder}: {error}", "a new directory") from None
    done = f"{result.tasks_done} of {result.num_tasks} tasks are done"
    allowed = "--resume to continue it, or another directory, with --store PATH"
    require(resume, key, f"{folder} exists already: {done}", allowed)


def _finished(result: dvi.SweepResult, last: dvi.SweepProgress) -> Report:
    counts, observed = result.status_counts(), _observed(result)
    report = Report(
        {
            "store": str(result.path),
            "dims": result.dims,
            "tasks": {"done": last.tasks_done, "all": last.num_tasks},
            "trajectories": counts,
            "seconds": last.seconds,
            "steps_per_second": last.rate,
        },
        [_status_table(counts)],
    )
    if observed:
        report.contents["observed"] = observed
        rows = [[name, *(f"{x:.6g}" for x in of.values())] for name, of in observed.items()]
        title = "Observables of the successful trajectories"
        report.tables.append(Table(title, ["name", "min", "median", "max"], rows))
    speed = f"{last.seconds:.1f} s (compilation included), {last.rate:.3g} steps/s"
    report.summary = (
        f"{last.num_lanes} trajectories in {last.num_tasks} tasks; "
        f"{speed if last.rate else 'all tasks were done already'}; in {result.path}"
    )
    return report


def _observed(result: dvi.SweepResult) -> dict[str, dict[str, float]]:
    """Name → least, median and largest over the successful trajectories. Empty without observables,
    and where there is too much to read."""
    data = result.to_xarray()
    names = [str(n) for n in data.data_vars if str(n).split(".")[0] not in RESERVED]
    if not names or sum(data[name].size for name in names) > _MOST:
        return {}
    good = result["status"] == 0
    found = {}
    for name in names:
        values = data[name].values[good]
        if np.iscomplexobj(values):
            name, values = f"|{name}|", np.abs(values)
        values = values[np.isfinite(values)]
        if values.size:
            of = {"min": np.min, "median": np.median, "max": np.max}
            found[name] = {word: float(f(values)) for word, f in of.items()}
    return found


def _status_table(counts: dict[str, int]) -> Table:
    total = sum(counts.values())
    rows = [[name, str(n), f"{100 * n / total:.4g} %"] for name, n in counts.items()]
    return Table("How the trajectories ended", ["status", "trajectories", "fraction"], rows)


# Stores


def _opened(store: str | Path) -> dvi.SweepResult:
    try:
        return dvi.open_sweep(store)
    except dvi.StoreError as error:
        raise InputError("STORE", str(error), "the directory of a sweep") from None


def sweep_status(store: str | Path) -> Report:
    """How far a sweep is, from the records of its store; others may be working on it.

    **Raises** `InputError` where there is no store.
    """
    result = _opened(store)
    steps, records = _steps(result), list(result.records())
    statuses = sum((Counter(record["statuses"]) for record in records), Counter())
    sizes = [math.prod(record["size"]) for record in records]
    work = sum(n * steps(record["start"]) for n, record in zip(sizes, records, strict=True))
    seconds = _covered([(r["finished"] - r["seconds"], r["finished"]) for r in records])
    done, lanes, whole = len(records), sum(sizes), math.prod(result.dims.values())
    left, rate = whole - lanes, lanes / seconds if seconds else 0.0
    speed = None if math.isnan(work) else work / seconds if seconds else 0.0
    contents = {
        "store": str(result.path),
        "dims": result.dims,
        "tasks": {"done": done, "left": result.num_tasks - done, "all": result.num_tasks},
        "trajectories": ({"not_computed": left} if left else {}) | dict(statuses),
        "seconds": seconds,
        "trajectories_per_second": rate,
        "steps_per_second": speed,
        "seconds_left": left / rate if rate else None,
        "bytes": _size(Path(store)),
        "provenance": {k: v for k, v in result.attributes.items() if k not in _NOT_OURS},
    }
    about = [[name, str(value)] for name, value in contents["provenance"].items()]
    grid = " × ".join(f"{name} {n}" for name, n in result.dims.items())
    more = f", {result.num_tasks - done} left" if done < result.num_tasks else ""
    more += f" (about {left / rate:.3g} s)" if left and rate else ""
    return Report(
        contents,
        [_status_table(contents["trajectories"]), Table("Provenance", ["what", "value"], about)],
        summary=f"{result.path}: {grid}; {done} of {result.num_tasks} tasks done{more}; "
        f"{rate:.3g} trajectories/s{'' if speed is None else f', {speed:.3g} steps/s'}; "
        f"{contents['bytes'] / 1e6:.3g} MB",
    )


def _steps(result: dvi.SweepResult) -> Callable[[list[int]], float]:
    """The number of steps of the task whose box begins at given indices; NaN where unknown."""
    config = json.loads(result.attributes["config"])
    steps = config["num_steps"]
    if not isinstance(steps, dict):
        return lambda _: math.nan if steps is None else steps
    coordinates, dim = result.to_xarray().coords, steps["axis"]
    values = coordinates["num_steps" if "num_steps" in coordinates else dim].values
    place = list(result.dims).index(dim)
    return lambda start: values[start[place]]


def _covered(spans: list[tuple[float, float]]) -> float:
    """Seconds in which some task was being done: pauses between runs do not count."""
    total, until = 0.0, -math.inf
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, until))
        until = max(until, end)
    return total


def _size(folder: Path) -> int:
    """Bytes of all files in a folder."""
    total = 0
    for root, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):  # a temporary file of a process that is working on it
                total += os.stat(Path(root, name)).st_size
    return total


def verify_store(store: str | Path, progress: Callable[[int, int], None] | None = None) -> Report:
    """Read everything in a store again; bad tasks are marked as not done.

    **Raises** `InputError` where there is no store, `OSError` where it cannot be changed.
    """
    found = _opened(store).verify(progress)
    contents = {"store": str(store), **found._asdict()}
    summary = f"{store}: {found.sound} tasks are correct, {len(found.bad)} bad, {found.todo} to do"
    report = Report(contents, summary=summary)
    if found.bad:
        rows = [[str(number), wrong] for number, wrong in found.bad.items()]
        report.tables.append(Table("Bad tasks", ["task", "error"], rows))
        report.message = (
            "bad tasks were found; they will be computed again. To repair the store, run the sweep "
            "again with --resume."
        )
    return report
