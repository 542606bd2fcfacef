"""A sweep from a TOML file; and what is to be known of a store."""

import dataclasses
import json
import math
import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import dvi_jax as dvi

from ..sweep.bar import shown as shown_bar
from ..sweep.variables import RESERVED
from ._config import read_config
from ._errors import InputError
from ._report import Table, plain
from ._setup import said
from ._sweep_config import SWEEP_KEYS
from ._sweep_setup import SweepSetup, make_sweep_setup

_MOST = 10_000_000
"""Numbers up to which results are read again for the table at the end."""

_NOT_OURS = ("config", "config_sha256", "Conventions", "coordinates", "dvi_jax_sweep")
"""Attributes of a store that say how to read it, not where it comes from."""


@dataclass(frozen=True)
class SweepReport:
    """What there is to say of a sweep: contents for programs, tables and a summary for readers."""

    contents: dict[str, Any]
    tables: list[Table] = field(default_factory=list)
    summary: str = ""


def sweep_file(
    path: str | Path,
    store: str | Path | None = None,
    resume: bool = False,
    threads: int | None = None,
    progress: bool | Callable[[dvi.SweepProgress], None] | None = None,
) -> SweepReport:
    """The sweep that a TOML file describes, kept in a store.

    - `path`: the file; its keys are in `SWEEP_KEYS` and in the documentation.
    - `store`: directory to write to instead of the file's ``output.store``; either is relative to
      the working directory. It must not exist, or be empty, unless
    - `resume`: go on with what is there. If nothing is, begin.
    - `threads`, `progress`: as for `dvi.sweep`.

    **Raises** `InputError` for input that cannot be meant, nothing is written then; `StoreMismatch`
    for a store of another sweep, `StoreError` or `OSError` for one that cannot be written;
    `SweepInterrupted` after Ctrl-C.
    """
    path = Path(path)
    values, _ = read_config(path, SWEEP_KEYS)
    folder = Path(store if store is not None else values["output.store"] or _default(path))
    _check_folder(folder, "--store" if store is not None else "output.store", resume)
    setup = make_sweep_setup(values, path.parent)
    last: list[dvi.SweepProgress] = []
    with shown_bar(progress) as show:

        def tell(now: dvi.SweepProgress) -> None:
            last[:] = [now]
            if show is not None:
                show(now)

        try:
            result = dvi.sweep(**setup.arguments, store=folder, threads=threads, progress=tell)
        except (dvi.StoreError, OSError):
            raise
        except Exception as error:
            if last:  # the work had begun: it is not the input
                raise
            raise _unfit(path, setup, error) from error
    return _finished(result, last[0])


def sweep_cost(path: str | Path) -> SweepReport:
    """What the sweep of a TOML file would take, and larger ones: the summary has a table. One task
    is computed and timed for it, and nothing is written.

    **Raises** `InputError` for input that cannot be meant.
    """
    path = Path(path)
    values, _ = read_config(path, SWEEP_KEYS)
    setup = make_sweep_setup(values, path.parent)
    try:
        cost = dvi.sweep_cost(**setup.arguments)
    except Exception as error:
        raise _unfit(path, setup, error) from error
    contents = dataclasses.asdict(cost) | {"seconds": cost.seconds()}
    return SweepReport(contents, [], f"{cost}\n\n{cost.table()}")


def _unfit(path: Path, setup: SweepSetup, error: Exception) -> InputError:
    return InputError(
        str(path),
        f"{setup.name} cannot be swept: {said(error, *setup.files)}",
        "axes, functions, state and args that fit one another",
    )


def _default(path: Path) -> str:
    return f"results/{path.stem}.zarr"


def _check_folder(folder: Path, key: str, resume: bool) -> None:
    """Refuse, before the work, a place that holds something else, or this but nobody said so."""
    try:
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return
        result = dvi.open_sweep(folder)
    except (dvi.StoreError, OSError) as error:
        raise InputError(
            key, f"{folder} exists, and is no store of a sweep ({error})", "a new directory"
        ) from None
    except ValueError as error:  # a name that no directory can have
        raise InputError(key, f"{folder}: {error}", "a new directory") from None
    if not resume:
        raise InputError(
            key,
            f"{folder} exists already: {result.tasks_done} of {result.num_tasks} tasks are done",
            "--resume to go on with it, or another place, with --store PATH",
        )


def _finished(result: dvi.SweepResult, last: dvi.SweepProgress) -> SweepReport:
    counts = result.status_counts()
    contents = {
        "store": str(result.path),
        "dims": result.dims,
        "tasks": {"done": last.tasks_done, "all": last.num_tasks},
        "trajectories": counts,
        "seconds": last.seconds,
        "steps_per_second": last.rate,
    }
    tables = [_status_table(counts)]
    observed = _observed(result)
    if observed:
        contents["observed"] = observed
        tables.append(_observed_table(observed))
    speed = f"{last.seconds:.1f} s (compilation included), {last.rate:.3g} steps/s"
    summary = (
        f"{last.num_lanes} trajectories in {last.num_tasks} tasks; "
        f"{speed if last.rate else 'nothing was left to do'}; in {result.path}"
    )
    return SweepReport(contents, tables, summary)


def _observed(result: dvi.SweepResult) -> dict[str, dict[str, float]]:
    """Name → least, median and largest over the successful trajectories. Empty where there is
    nothing to say, or too much to read."""
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


def _observed_table(observed: dict[str, dict[str, float]]) -> Table:
    rows = [[name, *(f"{x:.6g}" for x in of.values())] for name, of in observed.items()]
    return Table(
        "Observables of the successful trajectories", ["name", "min", "median", "max"], rows
    )


def _status_table(counts: dict[str, int]) -> Table:
    total = sum(counts.values())
    rows = [[name, str(n), f"{100 * n / total:.4g} %"] for name, n in counts.items()]
    return Table("How the trajectories ended", ["status", "trajectories", "share"], rows)


# --- stores -----------------------------------------------------------------------------------


def _opened(store: str | Path) -> dvi.SweepResult:
    try:
        return dvi.open_sweep(store)
    except dvi.StoreError as error:
        raise InputError("STORE", str(error), "the directory of a sweep") from None


def sweep_status(store: str | Path) -> SweepReport:
    """How far a sweep is, from the records of its store; others may be working on it.

    **Raises** `InputError` where there is no store.
    """
    result = _opened(store)
    steps = _steps(result)
    statuses: Counter[str] = Counter()
    done, lanes, work, spans = 0, 0, 0, []
    for record in result.records():
        done += 1
        statuses.update(record["statuses"])
        lanes += (here := math.prod(record["size"]))
        work += here * steps(record["start"])
        spans.append((record["finished"] - record["seconds"], record["finished"]))
    seconds, left = _covered(spans), math.prod(result.dims.values()) - lanes
    rate = lanes / seconds if seconds else 0.0
    contents = {
        "store": str(result.path),
        "dims": result.dims,
        "tasks": {"done": done, "left": result.num_tasks - done, "all": result.num_tasks},
        "trajectories": ({"not_computed": left} if left else {}) | dict(statuses),
        "seconds": seconds,
        "trajectories_per_second": rate,
        "steps_per_second": None if math.isnan(work) else work / seconds if seconds else 0.0,
        "seconds_left": left / rate if rate else None,
        "bytes": _bytes(Path(store)),
        "provenance": {k: v for k, v in result.attributes.items() if k not in _NOT_OURS},
    }
    about = [[name, str(value)] for name, value in contents["provenance"].items()]
    tables = [
        _status_table(contents["trajectories"]),
        Table("Provenance", ["what", "value"], about),
    ]
    return SweepReport(plain(contents), tables, _status_summary(contents))


def _status_summary(contents: dict[str, Any]) -> str:
    tasks, left = contents["tasks"], contents["seconds_left"]
    grid = " × ".join(f"{name} {n}" for name, n in contents["dims"].items())
    speed = contents["steps_per_second"]
    rest = f", {tasks['left']} left" + (f" (about {left:.3g} s)" if left else "")
    return (
        f"{contents['store']}: {grid}; {tasks['done']} of {tasks['all']} tasks done"
        f"{rest if tasks['left'] else ''}; {contents['trajectories_per_second']:.3g} "
        f"trajectories/s{'' if speed is None else f', {speed:.3g} steps/s'}; "
        f"{contents['bytes'] / 1e6:.3g} MB"
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


def _bytes(folder: Path) -> int:
    return sum(_sizes(folder))


def _sizes(folder: Path) -> Iterator[int]:
    for root, _, names in os.walk(folder):
        for name in names:
            try:
                yield os.stat(Path(root, name)).st_size
            except FileNotFoundError:  # a temporary file of those who work on it
                continue


def verify_store(
    store: str | Path, progress: Callable[[int, int], None] | None = None
) -> SweepReport:
    """Read everything in a store again; tasks that are bad are open again after this.

    **Raises** `InputError` where there is no store, `OSError` where it cannot be changed.
    """
    found = _opened(store).verify(progress)
    contents = {"store": str(store), **found._asdict()}
    summary = f"{store}: {found.sound} tasks are sound, {len(found.bad)} bad, {found.todo} to do"
    if not found.bad:
        return SweepReport(contents, [], summary)
    rows = [[str(number), wrong] for number, wrong in found.bad.items()]
    return SweepReport(contents, [Table("Bad tasks", ["task", "what is wrong"], rows)], summary)
