"""A sweep from a TOML file; the state of a store."""

import dataclasses
import json
import math
import os
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax.base.files import publish
from dvi_jax.sweep.bar import progress_display as shown_bar
from dvi_jax.sweep.variables import RESERVED_NAMES

from .._errors import InputError, as_input_error, describe, require, user_path
from .._show import TextTable, json_types
from .expressions import parse_method
from .observables import read_observables
from .output import Report, recorder
from .schema import ARRAY, StatePair, SweepFile
from .system import Source, find_source
from .table import AN_AXIS, NO_KEY, AxisTable, axes_in, read_file, select

_MAX_NUMBERS = 10_000_000
"""Numbers up to which results are read again for the table at the end."""

REQUEST = ".toml.json"
"""File of a store with the path and the values of the TOML file that it is computed from."""

_NOT_OURS = ("config", "config_sha256", "Conventions", "coordinates", "dvi_jax_sweep")
"""Attributes of a store that say how to read it, not where it comes from."""

_KEYS = {"num_steps": "steps"}
"""Argument of `dvi.sweep` → key of the file, where they differ."""

_RULE = "axes, functions, state and args that fit one another"


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
    - `resume`: continue with the store there; begin a new one if there is no store.
    - `threads`, `progress`: as for `dvi.sweep`.

    **Raises** `InputError` for bad input, nothing is written then; `StoreMismatch`
    for a store of another sweep, `StoreError` or `OSError` for one that cannot be written;
    `SweepInterrupted` after Ctrl-C.
    """
    path = user_path("CONFIG", path)
    file, raw = read_file(path, SweepFile)
    key = "--store" if store is not None else "output.store"
    folder = user_path(key, store or file.output.store or f"results/{path.stem}.zarr")
    _check_folder(folder, key, resume)
    source, arguments = sweep_problem(file, path.parent)
    last: list[dvi.SweepProgress] = []
    with shown_bar(progress) as show, source.at_work(str(path), "swept", _RULE, last):
        arguments |= {"store": folder, "threads": threads, "progress": recorder(last, show)}
        try:
            result = dvi.sweep(**arguments)
        finally:  # also after Ctrl-C: a store of its own sweep has progress
            if last:
                contents = json_types({"sweep": str(path), "config": raw}, str)
                publish(folder / REQUEST, json.dumps(contents, ensure_ascii=False).encode())
    return _report(result, last[0])


def sweep_cost(path: str | Path) -> Report:
    """Estimated cost of the sweep of a TOML file, and a table for larger ones. One task is computed
    and timed; nothing is written.

    **Raises** `InputError` for bad input.
    """
    path = user_path("CONFIG", path)
    file, _ = read_file(path, SweepFile)
    source, arguments = sweep_problem(file, path.parent)
    with source.at_work(str(path), "swept", _RULE):
        cost = dvi.sweep_cost(**arguments)
    contents = dataclasses.asdict(cost) | {"seconds": cost.seconds()}
    return Report(contents, summary=f"{cost}\n\n{cost.table()}")


def _check_folder(folder: Path, key: str, resume: bool) -> None:
    """Fail early if the path holds other data, or this sweep without --resume."""

    kinds = dvi.StoreError, OSError, ValueError  # of a name that no directory can have
    prefix = f"{folder} is not the store of a sweep: "
    with as_input_error(key, "a new directory", *kinds, prefix=prefix):
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return
        result = dvi.open_sweep(folder)
    progress = f"{result.tasks_done} of {result.num_tasks} tasks are done"
    rule = "--resume to continue it, or another directory, with --store PATH"
    require(resume, key, f"{folder} exists already: {progress}", rule)


def _report(result: dvi.SweepResult, last: dvi.SweepProgress) -> Report:
    counts, observed = result.status_counts(), statistics_of(result)
    tasks = {"done": last.tasks_done, "all": last.num_tasks}
    contents = {"store": str(result.path), "dims": result.dims, "tasks": tasks}
    contents |= {"trajectories": counts, "seconds": last.seconds, "steps_per_second": last.rate}
    report = Report(contents, [_status_table(counts)])
    if observed:
        report.contents["observed"] = observed
    report.tables += observed_tables(observed)
    speed = f"{last.seconds:.1f} s (compilation included), {last.rate:.3g} steps/s"
    report.summary = (
        f"{last.num_lanes} trajectories in {last.num_tasks} tasks; "
        f"{speed if last.rate else 'all tasks were done already'}; in {result.path}"
    )
    return report


def statistics_of(result: dvi.SweepResult) -> dict[str, dict[str, float]]:
    """Name → least, median and largest over the successful trajectories. Empty without observables,
    and where there is too much to read."""
    data = result.to_xarray()
    names = [str(n) for n in data.data_vars if str(n).split(".")[0] not in RESERVED_NAMES]
    if not names or sum(data[name].size for name in names) > _MAX_NUMBERS:
        return {}
    good = result["status"] == 0
    statistics = {}
    for name in names:
        values = data[name].values[good]
        if np.iscomplexobj(values):
            name, values = f"|{name}|", np.abs(values)
        values = values[np.isfinite(values)]
        if values.size:
            words = ("min", "median", "max")
            statistics[name] = {word: float(getattr(np, word)(values)) for word in words}
    return statistics


def observed_tables(statistics: dict[str, dict[str, float]]) -> list[TextTable]:
    """The table of `statistics_of`; none without observables."""
    rows = [[name, *(f"{x:.6g}" for x in values.values())] for name, values in statistics.items()]
    title = "Observables of the successful trajectories"
    return [TextTable(title, ["name", "min", "median", "max"], rows)] if rows else []


def _status_table(counts: dict[str, int]) -> TextTable:
    total = sum(counts.values())
    rows = [[name, str(n), f"{100 * n / total:.4g} %"] for name, n in counts.items()]
    return TextTable("How the trajectories ended", ["status", "trajectories", "fraction"], rows)


# The arguments of `dvi.sweep`


def sweep_problem(file: SweepFile, folder: Path) -> tuple[Source, dict[str, Any]]:
    """The source of the system, and the arguments of `dvi.sweep` except for the store.

    **Raises** `InputError`.
    """
    source = find_source(file, folder)
    times = source.times(file)
    stride = getattr(file.save, "every", None)  # None of "final"
    save = dvi.Save(every=stride) if stride else dvi.Save(final=True)
    arguments = {
        "system": source.system,
        "lattice": times.pop("lattice"),
        "args": _parameters(source.args),
        "method": _methods(file.method, source),
        "save": None if file.save is None else save,
        "observe": _observe(file, source),
        "stop": _stop(file, source),
        "jump": source.jump,
        "lanes_per_task": file.output.lanes_per_task,
    }
    arguments |= {name: _for_sweep(_KEYS.get(name, name), value) for name, value in times.items()}
    arguments |= _initial_conditions(file, source)
    kinds = (dvi.Axis, dvi.starts.Starts)
    leaves = jax.tree.leaves(arguments, is_leaf=lambda x: isinstance(x, kinds))
    defect = "neither epsilon nor another number varies"
    rule = "an axis for some number, or [start]; for one trajectory use dvi-jax run"
    require(any(isinstance(x, kinds) for x in leaves), "epsilon", defect, rule)
    return source, arguments


def _for_sweep(key: str, value: Any) -> Any:
    """A value with its axes as those of `dvi.sweep`; one without a name has that of the key."""
    if isinstance(value, list):
        return [_for_sweep(f"{key}[{i}]", part) for i, part in enumerate(value)]
    return _axis(key, value, value.elements) if isinstance(value, AxisTable) else value


def _axis(key: str, axis: AxisTable, values: Any) -> dvi.Axis:
    with as_input_error(f"{key}.{axis.kind}", AN_AXIS):
        return dvi.Axis(axis.axis or key.rpartition(".")[2], values, axis.units)


def _parameters(value: Any, key: str = "args") -> Any:
    """The parameters; an array with axes in it becomes an axis of arrays."""
    if isinstance(value, dict):
        return {name: _parameters(inner, f"{key}.{name}") for name, inner in value.items()}
    axes = axes_in(value) if isinstance(value, list) else []
    if not axes:
        return _for_sweep(key, value)
    defect = [f"{axis.axis} with {len(axis.elements)} values" for axis in axes]
    rule = "axes of the same name and length"
    require(len({*defect}) == 1, key, f"one array contains the axes {', '.join(defect)}", rule)
    arrays = [np.asarray(select(value, k), float) for k in range(len(axes[0].elements))]
    return _axis(key, axes[0], np.stack(arrays))


def _methods(methods: Any, source: Source) -> Any:
    if isinstance(methods, str):
        return source.method(methods)
    if isinstance(methods, list):
        return dvi.Axis("method", [parse_method(text) for text in methods])
    return _axis("method", methods, [parse_method(text) for text in methods.elements])


def _observe(file: SweepFile, source: Source) -> dict[str, Any] | None:
    """The observables; one without a reduction is that of the last step."""
    observables = read_observables(file.observables, source)
    fits, rule = observables or file.save is not None, 'at least one observable, or save = "final"'
    require(fits, "observables", "nothing would be saved", rule)
    reductions = {
        name: function if isinstance(function, dvi.Reduction) else dvi.Last(function)
        for name, function in observables.items()
    }
    return reductions or None


def _stop(file: SweepFile, source: Source) -> dvi.Stop | None:
    if file.stop is None:
        return None
    stop = source.loader.load("stop", file.stop)
    require(isinstance(stop, dvi.Stop), "stop", describe(stop), "a dvi.Stop")
    return stop


def _initial_conditions(file: SweepFile, source: Source) -> dict[str, Any]:
    """`start`, or `q0` and `p0`, checked for one of the trajectories at least."""
    if file.start is None:
        q0, p0 = source.array("q0"), source.array("p0")
        try:
            _check(source, q0, p0, 0)
        except InputError:  # a single one is a trajectory that fails, which is a result
            _check(source, q0, p0, -1)
        return {"q0": _for_sweep("state.q0", q0), "p0": _for_sweep("state.p0", p0)}
    start = _start(file.start, source)
    t0, args = select(file.t0, 0), select(source.args, 0)
    rule = "an H (t, q, p, args) that fits the box and args"
    with as_input_error("start", rule, Exception, text=source.error_line):
        q0, p0, *start_args = start.at(jnp.zeros((), jnp.int32), t0, args)
    source.check_start(np.asarray(q0), np.asarray(p0), start_args[0] if start_args else args)
    return {"start": start}


def _check(source: Source, q0: Any, p0: Any, index: int) -> None:
    """Reject a state of which the first trajectory, or the last, cannot start."""
    q0, p0 = (np.asarray(select(x, index), float) for x in (q0, p0))
    source.check_start(q0, p0, select(source.args, index))


def _start(table: Any, source: Source) -> dvi.starts.Starts:
    """Generated initial conditions; normally distributed ones are by default about the system's."""
    if table.kind == "own":
        starts = source.loader.load("start.starts", table.starts)
        rule = "a dvi.starts.Starts, such as boozer.Births(...)"
        require(isinstance(starts, dvi.starts.Starts), "start.starts", describe(starts), rule)
        return starts
    options = {name: getattr(table, name) for name in table.model_fields_set - {"kind"}}
    for name, value in options.items():
        if isinstance(value, StatePair):
            options[name] = (value.q, value.p)
    for name in ("q0", "p0") if table.kind == "normal" else ():
        if name not in options:
            require(source.problem, f"start.{name}", NO_KEY, ARRAY)
            options[name] = np.asarray(getattr(source.problem, name), float)
    if "H" in options:
        options["H"] = source.loader.load("start.H", options["H"])
    starts = getattr(dvi.starts, table.kind.title().replace("_", ""))  # energy_shell → EnergyShell
    rule = f'arguments of dvi.starts.{starts.__name__}, because kind = "{table.kind}"'
    with as_input_error("start", rule):
        return starts(**options)


# Stores


def open_store(store: str | Path) -> dvi.SweepResult:
    """The results in a store. **Raises** `InputError` for another directory."""
    with as_input_error("STORE", "the directory of a sweep", dvi.StoreError):
        return dvi.open_sweep(store)


def sweep_status(store: str | Path) -> Report:
    """Progress of a sweep, from the records of its store; other processes may still write to it.

    **Raises** `InputError` where there is no store.
    """
    result = open_store(store)
    assert result.path is not None
    steps, records = _steps(result), list(result.records())
    statuses = sum((Counter(record["statuses"]) for record in records), Counter())
    sizes = [math.prod(record["size"]) for record in records]
    work = sum(n * steps(record["start"]) for n, record in zip(sizes, records, strict=True))
    seconds = _busy_seconds([(r["finished"] - r["seconds"], r["finished"]) for r in records])
    tasks_done, lanes, total = len(records), sum(sizes), math.prod(result.dims.values())
    left, rate = total - lanes, lanes / seconds if seconds else 0.0
    speed = None if math.isnan(work) else work / seconds if seconds else 0.0
    tasks_left, size = result.num_tasks - tasks_done, _size(result.path)
    tasks = {"done": tasks_done, "left": tasks_left, "all": result.num_tasks}
    counts = ({"not_computed": left} if left else {}) | dict(statuses)
    origin = {k: v for k, v in result.attributes.items() if k not in _NOT_OURS}
    contents = {"store": str(result.path), "dims": result.dims, "tasks": tasks}
    contents |= {"trajectories": counts, "seconds": seconds, "trajectories_per_second": rate}
    contents |= {"steps_per_second": speed, "seconds_left": left / rate if rate else None}
    contents |= {"bytes": size, "provenance": origin}
    rows = [[name, str(value)] for name, value in origin.items()]
    grid = " × ".join(f"{name} {n}" for name, n in result.dims.items())
    remainder = f", {tasks_left} left" if tasks_left > 0 else ""
    remainder += f" (about {left / rate:.3g} s)" if left and rate else ""
    tables = [_status_table(counts), TextTable("Provenance", ["what", "value"], rows)]
    summary = (
        f"{result.path}: {grid}; {tasks_done} of {result.num_tasks} tasks done{remainder}; "
        f"{rate:.3g} trajectories/s{'' if speed is None else f', {speed:.3g} steps/s'}; "
        f"{size / 1e6:.3g} MB"
    )
    return Report(contents, tables, summary=summary)


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


def _busy_seconds(spans: list[tuple[float, float]]) -> float:
    """Seconds in which some task was being done: pauses between runs do not count."""
    total, latest = 0.0, -math.inf
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, latest))
        latest = max(latest, end)
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
    verification = open_store(store).verify(progress)
    contents = {"store": str(store), **verification._asdict()}
    counts = f"{verification.sound} tasks are correct, {len(verification.bad)} bad"
    summary = f"{store}: {counts}, {verification.todo} to do"
    report = Report(contents, summary=summary)
    if verification.bad:
        rows = [[str(number), wrong] for number, wrong in verification.bad.items()]
        report.tables.append(TextTable("Bad tasks", ["task", "error"], rows))
        report.message = (
            "bad tasks were found; they will be computed again. To repair the store, run the sweep "
            "again with --resume."
        )
    return report
