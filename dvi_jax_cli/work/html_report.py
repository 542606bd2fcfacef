"""One HTML page about the results in a folder, a store or a file."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dvi_jax.base.files import publish

from .._errors import as_input_error, reason, require, user_path
from . import chapters
from .output import Report
from .page import MAX_BYTES, Chapter, page

_FOLDERS: dict[str, Callable[[Path], Chapter]] = {
    "report.json": chapters.run_chapter,
    "fit.json": chapters.fit_chapter,
    "invariants.json": chapters.discover_chapter,
    "bound.json": chapters.bound_chapter,
    "zarr.json": chapters.sweep_chapter,
}
"""File that a folder of results has → what makes the chapter."""

_FILES = [
    ({"stats", "observed"}, chapters.solution_chapter),
    ({"arcs", "result"}, chapters.saved_fit_chapter),
    ({"per_step", "domain", "boxes"}, chapters.certificate_chapter),
]
"""Entries of the header of a single file → what makes the chapter."""

_RULE = (
    "the folder of a run, fit, discover or bound, the store of a sweep, or a file of "
    "Solution.save, FitResult.save or DriftBound.save"
)
_MAX_NAMES = 8


def html_report(path: str | Path, out: str | Path | None = None, force: bool = False) -> Report:
    """Write one HTML page about results: statuses, pictures, tables, how to repeat the work.

    - `path`: the folder of a run, fit, discover or bound; the store of a sweep; or a file of
      `Solution.save`, `FitResult.save` or `DriftBound.save`.
    - `out`: the page; by default next to the results, with their name and ``.html``. `force`:
      replace it if it exists.

    The page has at most 5 MB and refers to no other file.

    **Raises** `InputError` where there are no results or they are damaged.
    """
    path = user_path("PATH", path)
    parts = chapters_of(path)
    place = path.resolve()
    is_plain = place.is_dir() and place.suffix != ".zarr"
    default = place.with_name(f"{place.name if is_plain else place.stem}.html")
    default = default if path.is_absolute() else path.parent / default.name
    file = default if out is None else user_path("--out", out)
    rule = "a file that does not exist yet, or --force to replace it"
    require(not file.is_dir(), "--out", f"{file} is a directory", "the name of a file")
    require(force or not file.exists(), "--out", f"{file} exists already", rule)
    require(file.parent.is_dir(), "--out", f"there is no directory {file.parent}", rule)
    content = page(", ".join(f"{part.kind} {part.title}" for part in parts), parts)
    rule = f"results of which a page has at most {MAX_BYTES / 1e6:g} MB"
    require(len(content) <= MAX_BYTES, "PATH", f"the page has {len(content)} bytes", rule)
    publish(file, content)
    contents: dict[str, Any] = {"file": str(file), "bytes": len(content), "chapters": []}
    for part in parts:
        entry = {"kind": part.kind, "title": part.title, "verdict": part.verdict}
        counts = {"statuses": part.statuses, "failures": part.num_failures}
        contents["chapters"].append(entry | counts | {"command": part.command})
    verdicts = "; ".join(f"{part.kind} {part.title}: {part.verdict}" for part in parts)
    return Report(contents, summary=f"{verdicts}; written to {file} ({len(content) / 1e6:.2g} MB)")


def chapters_of(path: Path) -> list[Chapter]:
    """A chapter for each kind of result there. **Raises** `InputError`."""
    require(path.exists(), "PATH", f"there is no {path}", _RULE)
    if path.is_file() and path.name in _FOLDERS:
        path = path.parent
    if path.is_file():
        return [_read(_kind_of(path), path)]
    with as_input_error("PATH", _RULE, OSError, prefix=f"{path}: ", text=reason):
        names = {entry.name for entry in path.iterdir()}
    kinds = [kind for name, kind in _FOLDERS.items() if name in names]
    inner = sorted(str(path / n) for n in names if any((path / n / f).is_file() for f in _FOLDERS))
    rule = f"one of the results in it, such as {inner[0]}" if inner else _RULE
    contents = ", ".join(sorted(names)[:_MAX_NAMES]) or "nothing"
    excess = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    defect = f"{path} has no results of dvi-jax; it contains {contents}{excess}"
    require(kinds, "PATH", defect, rule)
    return [_read(kind, path) for kind in kinds]


def _kind_of(path: Path) -> Callable[[Path], Chapter]:
    """The kind of a single file. **Raises** `InputError`."""
    key, header = str(path), {}
    if path.suffix == ".json":
        header = chapters.read_json(path)
    elif path.suffix == ".npz":
        rule = "a file of Solution.save or FitResult.save"
        with (
            as_input_error(key, rule, Exception, prefix="it is damaged or cannot be read: "),
            np.load(path, allow_pickle=False) as file,
        ):
            header = json.loads(str(file["about"])) if "about" in file.files else {}
    kinds = [kind for names, kind in _FILES if names <= header.keys()]
    require(kinds, key, "it is not a file of results that can be shown alone", _RULE)
    return kinds[0]


def _read(kind: Callable[[Path], Chapter], path: Path) -> Chapter:
    """The chapter. **Raises** `InputError` for files that lack something."""
    kinds = AttributeError, LookupError, TypeError, ValueError
    prefix = "the results are damaged or of another version: "
    rule = "files as dvi-jax wrote them; repeat the command with --force"
    with as_input_error(str(path), rule, *kinds, prefix=prefix, text=_defect):
        return kind(path)


def _defect(error: BaseException) -> str:
    is_gap = isinstance(error, KeyError)
    return f"there is no {error.args[0]!r}" if is_gap else f"{type(error).__name__}: {error}"
