"""Observations from CSV and npz files: columns of numbers, and the place of an invalid one."""

import csv
import zipfile
from pathlib import Path

import numpy as np

from .._errors import InputError, as_input_error, require, require_file, require_name

_EMPTY = ("", "nan", "na", "null", "none", "-", "--")
"""Cells in which nothing was observed."""


def read_columns(path: Path, key: str = "data.file") -> dict[str, np.ndarray]:
    """The columns of a file by name: from a CSV each of shape (N,), from an npz of any shape.

    A CSV has a line of names, then numbers, separated by commas, semicolons or tabs; lines that
    begin with # are left out, and an empty cell, or ``nan``, is NaN.

    **Raises** `InputError` with the key, and the line and column of a cell that is not a number.
    """
    require_file(key, path, "the path of a CSV or npz file")
    rule = "a CSV file in UTF-8, or an npz file that numpy.savez wrote"
    kinds = OSError, ValueError, EOFError, csv.Error, zipfile.BadZipFile
    with as_input_error(key, rule, *kinds, prefix=f"{path} cannot be read: "):
        return _npz(path) if path.suffix == ".npz" else _csv(path, key)


def _npz(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return {name: x for name, x in arrays.items() if x.ndim and np.issubdtype(x.dtype, np.number)}


def _csv(path: Path, key: str) -> dict[str, np.ndarray]:
    text = path.read_text(encoding="utf-8-sig")
    lines = [(i, line) for i, line in enumerate(text.split("\n"), 1) if line.strip()]
    lines = [(f"{path.name}, line {i}", line) for i, line in lines if line.lstrip()[0] != "#"]
    require(lines, key, f"the file {path} is empty", "a line of names, then lines of numbers")
    separator = max(",;\t", key=lines[0][1].count)
    (first, names), *rows = [
        (place, [cell.strip() for cell in next(csv.reader([line], delimiter=separator))])
        for place, line in lines
    ]
    rule = "different names, one for each column, such as t, x, y"
    for i, name in enumerate(names):
        require(not np.isfinite(_number(name)), key, f"{first}: {name} is a number", rule)
        fits = name and name not in names[:i]
        require(fits, key, f"{first}: the name {name!r} is empty or repeated", rule)
    require(rows, key, f"the file {path} has names but no numbers", "at least one line of numbers")
    for place, cells in rows:
        rule = f"{len(names)} cells, one for each of the names {', '.join(names)}"
        require(len(cells) == len(names), key, f"{place}: it has {len(cells)} cells", rule)
    table = np.array([[_number(cell) for cell in cells] for _, cells in rows])
    for i, j in np.argwhere(np.isinf(table))[:1]:
        place, cells = rows[i]
        rule = "a finite number such as -1000.5; empty, or nan, where nothing was observed"
        raise InputError(key, f"{place}, column {names[j]}: the cell is {cells[j]!r}", rule)
    return dict(zip(names, table.T, strict=True))


def _number(cell: str) -> float:
    """The number in a cell: NaN where nothing was observed, infinite where it is not a number."""
    if cell.lower() in _EMPTY:
        return np.nan
    try:
        return np.inf if "_" in cell else float(cell)  # Python's 1_000 is not a number in a file
    except ValueError:
        return np.inf


def column(columns: dict[str, np.ndarray], key: str, name: str) -> np.ndarray:
    """One of the columns. **Raises** `InputError` when no column has that name."""
    require_name(key, name, columns, "a column of the file: {}", f"the file has no column {name!r}")
    return np.asarray(columns[name], float)
