"""One run: read, integrate, compare, write."""

import json
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

import dvi_jax as dvi

from .. import plot
from ..systems.n_body import OBSERVABLES
from ._config import KEYS, read_config
from ._errors import InputError, reason
from ._pictures import draw, draw_solar_system
from ._report import Report, plain, solar_contents, solar_tables, watched_table
from ._setup import Setup, make_setup, said
from ._solar import compare, own_share
from ._watched import watch

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

    - `path`: the file; its keys are in `KEYS` and in the documentation.
    - `out`: directory to write to instead of the file's ``output.dir``; either is relative to
      the working directory. It must not exist, or be empty.
    - `force`: replace what an earlier run wrote there.
    - `progress`: called as ``progress(steps_done, steps)``.

    Writes trajectory.npz (ts, qs, ps, hs and ``observed/<name>``), report.json and pictures. A
    trajectory that fails is written as far as it went, and ``ok`` is False.

    **Raises** `InputError` for input that cannot be meant; nothing is written then.
    """
    path = Path(path)
    values, raw = read_config(path, KEYS)
    folder = Path(out if out is not None else values["output.dir"] or f"results/{path.stem}")
    made = reserve(folder, "--out" if out is not None else "output.dir", force)
    try:
        setup = make_setup(values, path.parent)
        seconds = time.perf_counter()
        observables = {"own": setup.observables, "always": _always(setup)}
        solution = _integrate(setup, observables, progress)
        seconds = time.perf_counter() - seconds
    except BaseException:
        if made:
            folder.rmdir()
        raise
    with writing(folder, force):
        return _write(setup, values, raw, solution, observables, seconds, folder, path)


def reserve(folder: Path, key: str, force: bool) -> bool:
    """Make the directory before the work, or find why not; True when it is new."""
    allowed = "a directory that does not exist or is empty; with --force, one to write into"
    try:
        if folder.exists():
            if not folder.is_dir():
                raise InputError(key, f"{folder} is not a directory", allowed)
            if any(folder.iterdir()) and not force:
                raise InputError(key, f"{folder} exists and is not empty", allowed)
            return False
        folder.mkdir(parents=True)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(key, f"{folder}: {reason(error)}", allowed) from None
    return True


@contextmanager
def writing(folder: Path, force: bool) -> Iterator[None]:
    """Results are written inside of this.

    **Raises** `FileExistsError` where another process has been quicker, unless `force`; after
    Ctrl-C a `KeyboardInterrupt` that says what is there.
    """
    if not force and any(folder.iterdir()):
        raise FileExistsError(
            f"{folder} was empty when this began, and another process has written there since; "
            "take another directory, or --force"
        )
    try:
        yield
    except KeyboardInterrupt:
        there = ", ".join(sorted(file.name for file in folder.iterdir())) or "nothing"
        raise KeyboardInterrupt(
            f"by Ctrl-C while results were written to {folder}, where there is: {there}. The last "
            "may not be whole; the same with --force writes them anew"
        ) from None


def _always(setup: Setup) -> dict[str, Any]:
    """What is watched whatever the file says: of the solar system, all that is conserved."""
    if setup.jd is None:
        return {}
    return {**OBSERVABLES, **{f"{name}_drift": dvi.MaxDrift(f) for name, f in OBSERVABLES.items()}}


def _integrate(
    setup: Setup, observables: dict[str, Any], progress: Callable[[int, int], None] | None
) -> dvi.Solution:
    try:
        solution = dvi.integrate(
            setup.system,
            setup.q0,
            setup.p0,
            h=setup.h,
            num_steps=setup.steps,
            t0=setup.t0,
            epsilon=setup.epsilon,
            args=setup.args,
            method=setup.method,
            lattice=setup.lattice,
            save=dvi.Save(every=setup.every, final=True),
            observe=observables,
            throw=False,
            progress=progress,
        )
        return jax.block_until_ready(solution)
    except Exception as error:
        # Whatever a user's function raises while it is traced comes through here.
        raise InputError(
            "system",
            f"{setup.name} cannot be integrated: {said(error, *setup.files)}",
            "functions, state and args that fit one another",
        ) from error


def _write(
    setup: Setup,
    values: dict[str, Any],
    raw: dict[str, Any],
    solution: dvi.Solution,
    observables: dict[str, Any],
    seconds: float,
    folder: Path,
    path: Path,
) -> Report:
    for name in WRITTEN:  # of an earlier run; no file of it must stay beside this one's
        (folder / name).unlink(missing_ok=True)
    ts, qs, ps, hs = (np.asarray(x) for x in (solution.ts, solution.qs, solution.ps, solution.hs))
    arrays: dict[str, Any] = {"ts": ts, "qs": qs, "ps": ps, "hs": hs}
    for name in setup.observables:
        arrays[f"observed/{name}"] = np.asarray(solution.observed["own"][name])
    np.savez(folder / "trajectory.npz", **arrays)

    watched, always = (
        watch(setup, observables[part], solution.observed[part]) for part in ("own", "always")
    )
    comparison = None
    if setup.jd is not None:
        comparison = compare(setup.jd + (ts - ts[0]), qs, ps, np.asarray(setup.args["masses"]))

    ok, status = _status(solution)
    contents = {
        "run": str(path),
        "config": raw,
        "versions": {n: version(n) for n in ("dvi-jax", "jax", "jaxlib", "numpy")}
        | {"python": platform.python_version()},
        "status": status,
        "stats": {name: np.asarray(value) for name, value in solution.stats.items()}
        | {"seconds": seconds, "saved": len(ts)},
        "results": {name: w.summary() for name, w in watched.items()},
    }
    report = Report(ok, "" if ok else _failure(status), folder, ["trajectory.npz"], contents)
    if watched:
        report.tables.append(watched_table(watched))
    if comparison is not None:
        share = own_share(setup, qs, ps)
        contents["solar_system"] = solar_contents(comparison, always, share)
        solar_tables(report, comparison, always)
    # The numbers are on disk before anything is drawn: a picture that fails costs no result.
    text = json.dumps(plain(contents), indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "report.json").write_text(text + "\n", encoding="utf-8")
    report.files.append("report.json")
    if values["output.plots"]:
        with plot.style():
            if comparison is None:
                pictures = draw(setup, ts, qs, ps, watched)
            else:
                pictures = draw_solar_system(setup, comparison, always)
            for name, axes in pictures.items():
                plot.save(axes, folder / name)
                report.files.append(name)
    return report


def _status(solution: dvi.Solution) -> tuple[bool, dict[str, Any]]:
    return solution.status == "successful", {
        "result": solution.status,
        "message": dvi.RESULTS[solution.result],
        "failed_step": int(solution.stats["failed_step"]),
        "failed_residual": float(solution.stats["failed_residual"]),
        "num_steps": int(solution.stats["num_steps"]),
    }


def _failure(status: dict[str, Any]) -> str:
    return (
        f"the trajectory failed at step {status['failed_step']} of {status['num_steps']} with "
        f"{status['result']} (relative residual {status['failed_residual']:.3g}).\n"
        f"{status['message']}\nWhat there is up to that step has been written."
    )
