"""The chapters of a report: each kind of result in words, tables and pictures."""

import itertools
import json
import shlex
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.base.results import STATUS_NAMES
from dvi_jax.plot.style import with_unit

from .._errors import as_input_error, require
from .bound import bound_tables
from .discover import discovery_tables
from .fit import fit_notes, fit_pictures, fit_tables
from .observables import Observed
from .page import Chapter
from .repeat import plain, repetition
from .run import SOLAR_IMAGES, run_pictures, run_tables
from .sweep import REQUEST, observed_tables, open_store, statistics_of, sweep_status
from .verify import verify_certificate

_SERIES, _MAPS, _ORBITS, _FAILURES = 12, 8, 12, 10
"""Observables of a run, variables of a sweep and trajectories of a batch that are drawn; failures
that are named: the first ones."""
_MAX_NUMBERS = 50_000_000
"""Numbers of a variable up to which a map of it is drawn."""
_CHECK_SECONDS = 60.0
"""Time for the check of a certificate."""
_GOOD = ("successful", "stopped")

# Facts that all kinds share


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file of results. **Raises** `InputError`."""
    rule = "a file as dvi-jax wrote it; to write it again, repeat the command with --force"
    kinds = OSError, ValueError, RecursionError
    with as_input_error(str(path), rule, *kinds, prefix="it is damaged or cannot be read: "):
        contents = json.loads(path.read_text(encoding="utf-8"))
        require(isinstance(contents, dict), str(path), "it is damaged: it has no table", rule)
    return plain(contents)


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    rule = "an npz file as dvi-jax wrote it; repeat the command with --force"
    with (
        as_input_error(str(path), rule, Exception, prefix="it is damaged or cannot be read: "),
        np.load(path, allow_pickle=False) as file,
    ):
        return {name: file[name] for name in file.files}


def _in_words(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.8g}"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name} = {_in_words(x)}' for name, x in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_in_words, value))}]"
    return str(value)


def _facts(contents: dict[str, Any], *tables: str) -> dict[str, str]:
    """The values of a TOML file that are not tables, and those of some tables."""
    config = contents["config"]
    values = {name: x for name, x in config.items() if not isinstance(x, dict)}
    for table in ("state", "args", *tables):
        values |= {f"{table}.{name}": x for name, x in config.get(table, {}).items()}
    return {name: _in_words(x) for name, x in values.items()}


def _origin(contents: dict[str, Any]) -> dict[str, str]:
    return {name: _in_words(x) for name, x in contents.get("versions", {}).items()}


def _chapter(kind: str, contents: dict[str, Any], folder: Path, *tables: str) -> Chapter:
    """A chapter about the work of a TOML file, without its results."""
    title = str(contents.get("name") or contents["config"]["system"]).replace("_", " ")
    options = {"facts": _facts(contents, *tables), "origin": _origin(contents)}
    return Chapter(kind, title, "", "open", **options, **repetition(kind, contents, folder))


# One chapter for each kind


def run_chapter(folder: Path) -> Chapter:
    """A chapter from report.json and trajectory.npz."""
    contents, arrays = read_json(folder / "report.json"), _read_arrays(folder / "trajectory.npz")
    chapter = _chapter("run", contents, folder)
    _add_outcome(chapter, [contents["status"]["result"]], [contents["status"]])
    if message := contents["status"]["message"]:
        chapter.notes.append(message)
    stats = contents["stats"]
    chapter.facts |= {"saved states": str(stats["saved"]), "seconds": f"{stats['seconds']:.3g}"}
    chapter.tables, observed = run_tables(contents["results"]), {}
    for name, entry in contents["results"].items():
        if "reduction" not in entry:
            values = arrays[f"observed/{name}"]
            # A function of a step has no value in the file for the start; the report has it.
            if len(values) < len(arrays["ts"]):
                values = np.concatenate([np.asarray(entry["start"], float)[None], values])
            observed[name] = Observed(values[0], values, entry["scale"], "")
    drawn = dict(itertools.islice(observed.items(), _SERIES))
    ts, qs, ps = (arrays[name] for name in ("ts", "qs", "ps"))
    pictures = run_pictures({"units": {}, "name": chapter.title} | contents, ts, qs, ps, drawn)
    title = "Observables: change since the start"
    if len(observed) > _SERIES:
        title += f" (the first {_SERIES} of {len(observed)})"
    captions = {"trajectory.png": "Trajectory", "invariants.png": title}
    images = [folder / name for name in SOLAR_IMAGES if contents["config"]["system"] == _SOLAR]
    chapter.pictures = {path.stem: path.read_bytes() for path in images if path.is_file()}
    if not chapter.pictures:
        chapter.pictures = {captions[name]: draw for name, draw in pictures.items()}
    return chapter


_SOLAR = "solar_system"


def _add_outcome(chapter: Chapter, names: Any, entries: Any) -> None:
    """Verdict, statuses and failures of trajectories: `names` of their statuses, and for each its
    number of steps and the step that failed."""
    names = [str(name) for name in names]
    chapter.statuses = dict(Counter(names))
    bad = [i for i, name in enumerate(names) if name not in _GOOD]
    chapter.num_failures = len(bad)
    for i in bad[:_FAILURES]:
        where = f"trajectory {i}: " if len(names) > 1 else ""
        chapter.failures.append(
            f"{where}{names[i].replace('_', ' ')} at step {entries[i]['failed_step']} of "
            f"{entries[i]['num_steps']} (relative residual {entries[i]['failed_residual']:.3g})"
        )
    chapter.grade = "bad" if bad else "good"
    many = f"{len(bad)} of {len(names)} trajectories failed" if bad else "all successful"
    chapter.verdict = many if len(names) > 1 else names[0].replace("_", " ")


def solution_chapter(path: Path) -> Chapter:
    """A chapter from a file of `Solution.save`."""
    rule = "a file as Solution.save wrote it"
    with as_input_error(str(path), rule):
        solution = dvi.Solution.load(path)
    *batch, states = np.shape(solution.ts)
    chapter = Chapter("saved solution", path.name, "", "open")
    names = np.ravel(solution.status)
    fields = ("failed_step", "failed_residual", "num_steps")
    numbers = (np.ravel(np.broadcast_to(solution.stats[n], batch)) for n in fields)
    rows = zip(*(x.tolist() for x in numbers), strict=True)
    _add_outcome(chapter, names, [dict(zip(fields, row, strict=True)) for row in rows])
    shape = np.shape(solution.qs)[len(batch) + 1 :]
    first = np.reshape(solution.ts, (-1, states))[0]
    chapter.facts = {
        "trajectories": " × ".join(map(str, batch)) or "1",
        "shape of q": str(shape),
        "saved states": str(states),
        "steps": _in_words(np.max(solution.stats["num_steps"]).item()),
        "t": f"{first[0]:.8g} … {first[-1]:.8g}",
    }
    flat = jax.tree.map(lambda x: np.reshape(x, (-1, *np.shape(x)[len(batch) :])), solution)
    is_many = bool(batch)
    part = jax.tree.map(lambda x: x[:_ORBITS] if is_many else x[0], flat)
    few = f" (the first {_ORBITS} of {len(names)} trajectories)" if len(names) > _ORBITS else ""
    view = plot.trajectory
    if is_many:
        view = plot.phase_portrait if int(np.prod(shape)) == 1 else plot.orbit
    chapter.pictures[f"Trajectory{few}"] = lambda: view(part)
    if isinstance(solution.observed, dict) and solution.observed:
        chapter.pictures[f"Observables{few}"] = lambda: plot.invariants(part, change="value")
    code = f"import dvi_jax as dvi; print(dvi.Solution.load({str(path)!r}))"
    chapter.command = "JAX_ENABLE_X64=1 " + shlex.join(["python", "-c", code])
    chapter.remarks = ["The file has states and statuses, but not the call that computed them."]
    chapter.remarks.append("The command reads the file.")
    return chapter


def fit_chapter(folder: Path) -> Chapter:
    """A chapter from fit.json and fit.npz."""
    contents, rule = read_json(folder / "fit.json"), "a file as dvi-jax wrote it"
    with as_input_error(str(folder / "fit.npz"), rule, ValueError, OSError):
        result = dvi.FitResult.load(folder / "fit.npz")
    chapter = _chapter("fit", contents, folder, "data")
    _add_fit(chapter, result, contents["columns"])
    chapter.tables = fit_tables(result, contents)
    if contents["trajectory"] != "successful":
        chapter.failures.append(f"the fitted trajectory: {contents['trajectory']}")
        chapter.grade = "bad"
    return chapter


def _add_fit(chapter: Chapter, result: dvi.FitResult, columns: Any) -> None:
    chapter.verdict = result.status.replace("_", " ")
    chapter.grade = "good" if result.status == "converged" else "bad"
    chapter.facts |= {"steps": str(len(result.history["loss"])), "seconds": f"{result.seconds:.3g}"}
    chapter.statuses = dict(Counter(result.trajectories))
    if message := str(dvi.FIT_RESULTS[result.result]):
        chapter.failures.append(f"{chapter.verdict}: {message}")
    bad = [(i, s) for i, s in enumerate(result.trajectories) if s not in _GOOD]
    chapter.failures += [f"trajectory of arc {i}: {s.replace('_', ' ')}" for i, s in bad]
    chapter.num_failures = len(chapter.failures)
    chapter.notes = fit_notes(result)
    titles = {
        "data.png": "Observations and the fitted model",
        "residuals.png": "Residuals",
        "learning.png": "Loss against the step of the optimiser",
        "parameters.png": "Fitted parameters with their errors, in pairs",
    }
    pictures = fit_pictures(columns, result)
    chapter.pictures = {title: pictures[n] for n, title in titles.items() if n in pictures}


def saved_fit_chapter(path: Path) -> Chapter:
    """A chapter from a file of `FitResult.save` alone."""
    with as_input_error(str(path), "a file as FitResult.save wrote it", ValueError, OSError):
        result = dvi.FitResult.load(path)
    chapter = Chapter("saved fit", path.name, "", "open")
    _add_fit(chapter, result, None)
    missing = sum(int(np.isnan(x).sum()) for x in result.observed)
    parameters = {name: {"start": np.nan} for name in result.names}
    contents = {"parameters": parameters, "residuals": result.statistics(), "missing": missing}
    chapter.tables = fit_tables(result, contents)
    chapter.remarks = ["The file has the result of the fit, but not the call that computed it."]
    return chapter


def discover_chapter(folder: Path) -> Chapter:
    """A chapter from invariants.json."""
    contents = read_json(folder / "invariants.json")
    chapter = _chapter("discover", contents, folder, "samples", "drift")
    invariants = contents["invariants"]
    chapter.verdict = f"{len(invariants)} invariant{'s' * (len(invariants) != 1)}"
    chapter.grade = "good" if invariants else "open"
    chapter.facts["samples"] = str(contents["samples"])
    chapter.facts["functions of the basis"] = str(len(contents["functions"]))
    chapter.facts["seconds"] = f"{contents['seconds']:.3g}"
    chapter.tables = discovery_tables(contents)
    chapter.formulas = [f"I{i} = {x['formula']}" for i, x in enumerate(invariants, 1)]
    for key, words in (("dependent", "a function of these"), ("lost", "not conserved")):
        chapter.formulas += [f"{words}: {text}" for text in contents[key]]
    orders = {}
    for i, invariant in enumerate(invariants, 1):
        if drift := invariant.get("drift"):
            _add_drift(chapter, f"invariant {i}", drift)
            arrays = {n: np.asarray(drift[n]) for n in ("epsilons", "drifts", "used", "excluded")}
            orders[f"invariant {i}"] = SimpleNamespace(**{**drift, **arrays})
    chapter.num_failures = len(chapter.failures)
    slopes = [None if x["exact"] else contents["order"] + 1 for x in invariants]
    if orders:
        title = "Largest drift of each invariant against ε"
        chapter.pictures[title] = lambda: plot.drift_orders(orders, slopes)
    return chapter


def _add_drift(chapter: Chapter, name: str, drift: dict[str, Any]) -> None:
    """Points of a measured drift that do not count, as statuses and failures."""
    reasons = [f"ε: {x or 'used in the fit'}" for x in drift["excluded"]]
    chapter.statuses = dict(Counter(chapter.statuses) + Counter(reasons))
    pairs = zip(drift["epsilons"], drift["excluded"], strict=True)
    lines = [f"{name}: trajectories failed at ε = {e:.4g}" for e, x in pairs if x == "failed"]
    chapter.failures += lines
    if lost := drift["starts"] - drift["starts_kept"]:
        chapter.failures.append(f"{name}: {lost} of {drift['starts']} trajectories do not count")


def bound_chapter(folder: Path) -> Chapter:
    """A chapter from bound.json, and certificate.json if something is proved."""
    contents = read_json(folder / "bound.json")
    chapter = _chapter("bound", contents, folder, "domain", "bound")
    if "per_step" not in contents:
        chapter.verdict, chapter.grade, chapter.num_failures = "nothing is proved", "bad", 1
        chapter.failures = [contents.get("message") or "nothing is proved"]
        return chapter
    chapter.tables = bound_tables(contents)
    chapter.formulas = [f"I_{k} = {text}" for k, text in enumerate(contents["formulas"])]
    chapter.facts["boxes of the proof"] = str(contents["boxes"])
    _check(chapter, folder / "certificate.json")
    if contents["level"] is None:
        note = f"It is not shown that trajectories stay in the domain: {contents['reason']}"
        chapter.notes.append(note)
    _add_line(chapter, contents)
    return chapter


def _add_line(chapter: Chapter, contents: dict[str, Any]) -> None:
    """A picture of the proved change against the number of steps, for each invariant."""
    bound, steps = SimpleNamespace(**contents), np.geomspace(1, 1e12, 49)
    for k in range(len(contents["per_step"]))[:_MAPS]:
        draw = _drawing(plot.drift_bound, bound, steps, np.zeros((0, 49)), k, f"Invariant I_{k}")
        chapter.pictures[f"Proved change of I_{k} against the number of steps"] = draw


def _drawing(function: Callable[..., Any], *values: Any, **options: Any) -> Callable[[], Any]:
    return lambda: function(*values, **options)


def certificate_chapter(path: Path) -> Chapter:
    """A chapter from a file of `DriftBound.save` alone."""
    c, number = read_json(path), float.fromhex
    sides = list(zip(*([number(x) for x in side] for side in c["domain"]), strict=True))
    low, high = map(number, c["epsilon"])
    chapter = Chapter("certificate", path.name, "", "open")
    chapter.facts = {
        "h": f"{number(c['h']):.8g}",
        "ε": f"{low:.6g} … {high:.6g}",
        "domain of (q, p)": ", ".join(f"[{a:.6g}, {b:.6g}]" for a, b in sides),
        "arithmetic": f"{c['arithmetic']}, {c['way']}",
        "steps inside the domain": f"{c['steps']:.4g}",
    }
    bounds = {name: [number(x) for x in c[name]] for name in ("per_step", "rounding")}
    contents: dict[str, Any] = {**bounds, "change": 1e-3, "level": c["level"], "steps": c["steps"]}
    chapter.tables = bound_tables(contents)
    _check(chapter, path)
    _add_line(chapter, contents)
    chapter.command = chapter.command or shlex.join(["dvi-jax", "verify", str(path)])
    return chapter


def _check(chapter: Chapter, path: Path) -> None:
    """The verdict of the checker on a certificate, at the time when the page is made."""
    rule = "the file that dvi-jax bound wrote; repeat the command with --force"
    require(path.is_file(), str(path), "there is no such file", rule)
    try:
        contents, message = verify_certificate(path, _CHECK_SECONDS)
    except ImportError:
        chapter.verdict = "not checked: python-flint is not installed"
        return
    chapter.verdict, chapter.grade = ("not proved", "bad") if message else ("proved", "good")
    if message:
        chapter.failures, chapter.num_failures = [message], 1
    else:
        chapter.notes.append(f"The certificate was checked for this page: {contents['proved']}.")


def sweep_chapter(folder: Path) -> Chapter:
    """A chapter from the store of a sweep, which may be unfinished."""
    result, report = open_store(folder), sweep_status(folder)
    state, data = report.contents, result.to_xarray()
    counts = state["trajectories"]
    bad = {name: n for name, n in counts.items() if name not in (*_GOOD, "not_computed")}
    total, tasks = sum(counts.values()), state["tasks"]
    chapter = Chapter(
        "sweep", folder.name, f"{sum(bad.values())} of {total} trajectories failed", "bad"
    )
    if not bad:
        chapter.verdict, chapter.grade = f"all {total} trajectories successful", "good"
        chapter.verdict = chapter.verdict if counts.keys() <= {"successful"} else "no failure"
    if tasks["left"]:
        chapter.verdict += f"; {tasks['left']} of {tasks['all']} tasks left"
        chapter.grade = "bad" if bad else "open"
    chapter.statuses, chapter.num_failures = counts, sum(bad.values())
    chapter.failures = _failures(result, data)
    chapter.facts = {
        "grid": " × ".join(f"{name} {n}" for name, n in result.dims.items()),
        "tasks done": f"{tasks['done']} of {tasks['all']}",
        "seconds": f"{state['seconds']:.3g}",
        "trajectories per second": f"{state['trajectories_per_second']:.3g}",
        "size": f"{state['bytes'] / 1e6:.3g} MB",
    }
    for name in result.dims:
        values = np.ravel(data[name].values) if name in data.coords else np.arange(0)
        if values.size:
            ends = f"{_in_words(values[0].item())} … {_in_words(values[-1].item())}"
            chapter.facts[name] = f"{ends} ({values.size} values)"
    chapter.tables = observed_tables(statistics_of(result))
    chapter.origin = {name: str(x) for name, x in state["provenance"].items()}
    if len(counts) > 1:
        chapter.pictures["Status of each trajectory"] = _drawing(
            plot.failure_map, data, over=_rest(data["status"])
        )
    _add_maps(chapter, data)
    if (folder / REQUEST).is_file():
        contents = read_json(folder / REQUEST)
        chapter.title = str(contents["config"]["system"]).replace("_", " ")
        chapter.facts = _facts(contents) | chapter.facts
        fields = repetition("sweep", contents, folder)
        chapter.command, chapter.remarks, chapter.config = fields.values()
    else:
        chapter.command = chapter.origin.pop("command", "")
        chapter.remarks = ["This is the command of the Python program that called dvi.sweep."]
    return chapter


def _rest(array: Any) -> list[str]:
    """Components, and dimensions after the first two: a map has no place for them."""
    dims = [*map(str, array.dims)]
    return [dim for dim in dims if dim in dims[2:] or dim.startswith("component")]


def _failures(result: dvi.SweepResult, data: Any) -> list[str]:
    """The first trajectories that failed, with their place in the grid; reads their tasks only."""
    lines: list[str] = []
    for record in result.records():
        if len(lines) >= _FAILURES or not record["statuses"].keys() - {*_GOOD}:
            continue
        box = {
            dim: slice(a, a + n)
            for dim, a, n in zip(result.dims, record["start"], record["size"], strict=True)
        }
        part = data[["status", "failed_step"]].isel(box).load()
        codes = [STATUS_NAMES.index(name) for name in _GOOD]
        for place in np.argwhere(~np.isin(part["status"].values, [-1, *codes])):
            entry = part.isel(dict(zip(result.dims, place, strict=True)))
            where = [
                f"{dim} = {_label(entry, dim, k + box[dim].start)}"
                for dim, k in zip(result.dims, place, strict=True)
            ]
            name = STATUS_NAMES[int(entry["status"])].replace("_", " ")
            lines.append(f"{', '.join(where)}: {name} at step {int(entry['failed_step'])}")
    return lines[:_FAILURES]


def _label(entry: Any, dim: str, index: int) -> str:
    return _in_words(entry[dim].item()) if dim in entry.coords else str(index)


def _add_maps(chapter: Chapter, data: Any) -> None:
    """Maps of the observables and last states; what is left out is said in a note."""
    if "save" in data.dims:
        data = data.isel(save=-1).drop_vars("t")
    names = [str(n) for n in data.data_vars if str(n) not in ("status", "failed_step", "residual")]
    names = [n for n in names if data[n].dtype.kind in "biuf"]
    large = [n for n in names if data[n].size > _MAX_NUMBERS]
    drawn = [n for n in names if n not in large][:_MAPS]
    for name in drawn:
        status = data["status"] if data[name].ndim <= 2 else None
        options = {"over": _rest(data[name]), "status": status}
        label = with_unit(name.replace("_", " "), data[name].attrs.get("units"))
        chapter.pictures[f"Map of {label}"] = _drawing(plot.sweep_map, data[name], **options)
    if excess := [n for n in names if n not in drawn]:
        text = f"Not drawn, because they are too many or too large: {', '.join(excess)}."
        chapter.notes.append(text)
