"""Observations from CSV and npz files: columns of numbers, and the place of an invalid one."""

import csv
import zipfile
from pathlib import Path

import numpy as np

from .._errors import InputError, one_of, reason, shown

_MISSING = ("", "nan", "na", "null", "none", "-", "--")
"""Cells in which nothing was observed."""

_SEPARATORS = (",", ";", "\t")


def read_columns(path: Path, key: str = "data.file") -> dict[str, np.ndarray]:
    """The columns of a file by name: from a CSV each of shape (N,), from an npz of any shape.

    A CSV has a line of names, then numbers, separated by commas, semicolons or tabs; lines that
    begin with # are left out, and an empty cell, or ``nan``, is NaN.

    **Raises** `InputError` with the key, and the line and column of a cell that is not a number.
    """
    allowed = "the path of a CSV or npz file"
    try:
        is_file = path.is_file()
    except (OSError, ValueError) as error:  # a name that no file can have
        raise InputError(key, reason(error), allowed) from None
    if not is_file:
        raise InputError(key, f"there is no file {path}", allowed)
    try:
        return _npz(path, key) if path.suffix == ".npz" else _csv(path, key)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(key, f"{path} cannot be read: {error}", "a CSV file in UTF-8") from None


def _npz(path: Path, key: str) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        seen = f"{path} is not an npz file ({error})"
        raise InputError(key, seen, "a file that numpy.savez wrote") from None
    return {n: a for n, a in found.items() if a.ndim and np.issubdtype(a.dtype, np.number)}


def _csv(path: Path, key: str) -> dict[str, np.ndarray]:
    with open(path, encoding="utf-8-sig", newline="") as file:
        lines = [
            (i, line) for i, line in enumerate(file, 1) if line.strip() and line.lstrip()[0] != "#"
        ]
    if not lines:
        raise InputError(key, f"{path} is empty", "a line of names, then lines of numbers")
    separator = max(_SEPARATORS, key=lines[0][1].count)
    names = [name.strip() for name in next(csv.reader([lines[0][1]], delimiter=separator))]
    _check_names(path, key, names, lines[0][0])
    rows = []
    for number, line in lines[1:]:
        cells = next(csv.reader([line], delimiter=separator))
        if len(cells) != len(names):
            seen = f"{path.name}, line {number}: {len(cells)} cells"
            allowed = f"{len(names)}, one for each of the names {', '.join(names)}"
            raise InputError(key, seen, allowed)
        place = f"{path.name}, line {number}, column "
        rows.append([_number(x, place + n, key) for x, n in zip(cells, names, strict=True)])
    if not rows:
        raise InputError(key, f"{path} has names and no numbers", "at least one line of numbers")
    return dict(zip(names, np.array(rows).T, strict=True))


def _check_names(path: Path, key: str, names: list[str], line: int) -> None:
    """Reject a first line without names."""
    wanted = "different names, one for each column, such as t, x, y"
    numbers = [name for name in names if _is_number(name)]
    if numbers:
        raise InputError(key, f"{path.name}, line {line}: the number {numbers[0]}", wanted)
    twice = [name for i, name in enumerate(names) if name in names[:i] or not name]
    if twice:
        raise InputError(key, f"{path.name}, line {line}: the name {twice[0]!r} again", wanted)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return cell.lower() not in _MISSING


def _number(cell: str, where: str, key: str) -> float:
    text = cell.strip()
    if text.lower() in _MISSING:
        return np.nan
    try:
        found = np.inf if "_" in text else float(text)  # Python's 1_000 is not a number in a file
    except ValueError:
        found = np.inf
    if not np.isfinite(found):
        allowed = "a finite number; empty, or nan, where nothing was observed"
        raise InputError(key, f"{where}: {text!r}", allowed)
    return found


def column(columns: dict[str, np.ndarray], key: str, name: str) -> np.ndarray:
    """One of the columns.

    **Raises** `InputError` when there is none of that name.
    """
    if name not in columns:
        raise InputError(key, shown(name), f"a column of the file: {one_of(columns, name)}")
    return np.asarray(columns[name], float)


def check_times(ts: np.ndarray, key: str, name: str) -> None:
    """Reject times that are not in order, with the first place where they are not."""
    if ts.ndim != 1:
        raise InputError(key, f"{name} has shape {ts.shape}", "one time for each observation")
    bad = np.flatnonzero(~np.isfinite(ts))
    if bad.size:
        raise InputError(key, f"time number {bad[0] + 1} in {name} is {ts[bad[0]]}", "finite times")
    steps = np.diff(ts)
    direction = 1 if steps.size == 0 or ts[-1] >= ts[0] else -1
    bad = np.flatnonzero(steps * direction <= 0)
    if bad.size:
        i = bad[0]
        seen = f"in {name} the time number {i + 2}, {ts[i + 1]:.17g}, comes after {ts[i]:.17g}"
        raise InputError(key, seen, "times in order, no two alike")
