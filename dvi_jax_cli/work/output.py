"""The report of the work, and the directory of its results."""

import json
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from dvi_jax import plot
from dvi_jax.base.files import release, reserve

from .._errors import as_input_error, reason, require, user_path
from .._show import TextTable, json_types
from .schema import FILES
from .table import read_file


@dataclass
class Report:
    """The results of the work of a TOML file.

    - `contents`: for programs; the JSON file of the results has it.
    - `tables`, `notes`, `summary`: for the reader.
    - `message`: why the work failed, or "". `folder`, `files`: where the results are.
    """

    contents: dict[str, Any] = field(default_factory=dict)
    tables: list[TextTable] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    summary: str = ""
    message: str = ""
    folder: Path = Path()
    files: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether the work succeeded."""
        return not self.message


@dataclass(kw_only=True)
class FolderReport(Report):
    """A report with files in `folder`.

    - `key`: the key or option that names the folder.
    - `names`: every file that may be written; these are replaced with `force`, and no other.
    """

    key: str
    names: tuple[str, ...]
    force: bool = False

    @contextmanager
    def reservation(self) -> Iterator[None]:
        """Make the directory before the work, and remove it if the work fails and leaves it empty.

        **Raises** `InputError` where it cannot be made, or has files.
        """
        rule = "a directory that does not exist or is empty; with --force, one to write into"
        folder = self.folder
        try:
            kinds = OSError, ValueError
            with as_input_error(self.key, rule, *kinds, prefix=f"{folder}: ", text=reason):
                if not folder.exists():
                    reserve(folder)
                is_free = not folder.is_dir() or self.force or not any(folder.iterdir())
            require(folder.is_dir(), self.key, f"{folder} is not a directory", rule)
            require(is_free, self.key, f"{folder} exists and is not empty", rule)
            yield
        except BaseException:  # Ctrl-C may come on any line, also right after mkdir
            release(folder)
            raise

    @contextmanager
    def writing(self, keep: str = "") -> Iterator[None]:
        """Results are written within this; files of earlier ones, except `keep`, are removed first.

        **Raises** `FileExistsError` where another process has written meanwhile, unless `force`;
        after Ctrl-C a `KeyboardInterrupt` that lists the files.
        """
        new = [] if self.force else sorted({p.name for p in self.folder.iterdir()} - {keep})
        if new:
            raise FileExistsError(
                f"another process has written {new[0]} to {self.folder} meanwhile. Repeat with "
                f"another {self.key}, or with --force"
            )
        for name in self.names:
            if name != keep:
                (self.folder / name).unlink(missing_ok=True)
        try:
            yield
        except KeyboardInterrupt:
            names = ", ".join(sorted(file.name for file in self.folder.iterdir()))
            if not names:
                raise
            last = f" {self.files[-1]} may be incomplete." if self.files else ""
            raise KeyboardInterrupt(
                f"by Ctrl-C or SIGTERM while results were written. {self.folder} contains: "
                f"{names}.{last} --force writes all files again"
            ) from None
        finally:
            release(self.folder)

    def path(self, name: str) -> Path:
        """The path of a file that is about to be written."""
        self.files.append(name)
        return self.folder / name

    def write_arrays(self, name: str, arrays: dict[str, Any]) -> None:
        """An npz file."""
        np.savez(self.path(name), **arrays)

    def write_contents(self, name: str) -> None:
        """The contents as a JSON file; numbers that are not finite are texts, to stay visible."""
        plain = json_types(self.contents, str)
        text = json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False)
        self.path(name).write_text(text + "\n", encoding="utf-8")

    def draw(self, pictures: dict[str, Callable[[], Any]]) -> None:
        """Pictures, file name → function that returns axes; after the numbers, so that a picture
        that fails loses no result."""
        with plot.style():
            for name, draw in pictures.items():
                plot.save(draw(), self.path(name))


def open_report(
    kind: str, path: Path, out: str | Path | None, names: tuple[str, ...], force: bool
) -> tuple[Any, FolderReport]:
    """The values of a TOML file, and the directory of the results: of the option --out, or of the
    file, or one named after the file.

    **Raises** `InputError`.
    """
    model: Any = FILES[kind]
    file, raw = read_file(path, model)
    versions = {name: version(name) for name in ("dvi-jax", "jax", "jaxlib", "numpy")}
    versions["python"] = platform.python_version()
    contents = {kind: str(path), "config": raw, "versions": versions}
    key = "--out" if out is not None else "output.dir"
    folder = user_path(key, out or file.output.dir or f"results/{path.stem}")
    return file, FolderReport(contents, folder=folder, key=key, names=names, force=force)


def recorder(last: list[Any], show: Callable[[Any], None] | None) -> Callable[[Any], None]:
    """A function that takes the progress of work: it is stored in `last`, and shown."""

    def record(progress: Any) -> None:
        last[:] = [progress]
        if show is not None:
            show(progress)

    return record
