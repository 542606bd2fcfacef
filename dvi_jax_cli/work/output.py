"""The directory of results, what describes them, and the report for the reader."""

import json
import platform
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import dvi_jax as dvi
from dvi_jax import plot

from .._errors import InputError, reason
from .._show import Table, json_types


@dataclass
class Report:
    """What the work of a TOML file found.

    - `contents`: for programs; the JSON file of the results has it.
    - `tables`, `notes`, `summary`: for the reader.
    - `message`: why the work failed, or "". `folder`, `files`: where the results are.
    """

    contents: dict[str, Any]
    tables: list[Table] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    summary: str = ""
    message: str = ""
    folder: Path = Path()
    files: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether the work succeeded."""
        return not self.message


@dataclass(frozen=True)
class Output:
    """The directory of the results: `folder`, and the key or option that names it.

    - `force`: whether files of earlier results, those in `names`, may be replaced.
    """

    folder: Path
    key: str
    names: tuple[str, ...]
    force: bool = False

    @contextmanager
    def reserved(self) -> Iterator[None]:
        """Make the directory before the work, and remove it if the work fails and leaves it empty.

        **Raises** `InputError` where it cannot be made, or has files.
        """
        is_new = self._make()
        try:
            yield
        except BaseException:
            if is_new and not any(self.folder.iterdir()):
                self.folder.rmdir()
            raise

    def _make(self) -> bool:
        allowed = "a directory that does not exist or is empty; with --force, one to write into"
        seen, folder = "", self.folder
        try:
            if not folder.exists():
                folder.mkdir(parents=True)
                return True
            if not folder.is_dir():
                seen = f"{folder} is not a directory"
            elif any(folder.iterdir()) and not self.force:
                seen = f"{folder} exists and is not empty"
        except (OSError, ValueError) as error:
            seen = f"{folder}: {reason(error)}"
        if seen:
            raise InputError(self.key, seen, allowed)
        return False

    @contextmanager
    def writing(self, keep: str = "") -> Iterator[None]:
        """Results are written within this; files of earlier ones, except `keep`, are removed first.

        **Raises** `FileExistsError` where another process has written meanwhile, unless `force`;
        after Ctrl-C a `KeyboardInterrupt` that lists the files.
        """
        if not self.force and any(p.name != keep for p in self.folder.iterdir()):
            raise FileExistsError(
                f"{self.folder} was empty when this began, and another process has written there "
                "since; take another directory, or --force"
            )
        for name in self.names:
            if name != keep:
                (self.folder / name).unlink(missing_ok=True)
        try:
            yield
        except KeyboardInterrupt:
            there = ", ".join(sorted(file.name for file in self.folder.iterdir())) or "nothing"
            raise KeyboardInterrupt(
                f"by Ctrl-C while results were written to {self.folder}, where there is: {there}. "
                "The last file may be incomplete; the same with --force writes all of them again"
            ) from None

    def write_json(self, name: str, contents: dict[str, Any]) -> None:
        """A JSON file; numbers that are not finite are texts, to stay visible."""
        plain = json_types(contents, str)
        text = json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False)
        (self.folder / name).write_text(text + "\n", encoding="utf-8")

    def draw(self, pictures: dict[str, Any]) -> Iterable[str]:
        """Write pictures, file name → function that returns axes, and return their names."""
        with plot.style():
            for name, draw in pictures.items():
                plot.save(draw(), self.folder / name)
        return pictures


def watched(
    work: Callable[[Callable[[Any], None]], Any],
    bar: AbstractContextManager[Callable[[Any], None] | None],
    misfit: Callable[[Exception], InputError],
) -> tuple[Any, Any]:
    """What `work` returns, which is called with a function that takes its progress, and the last
    progress.

    **Raises** `misfit` of an exception before the first progress: until then it is the input.
    """
    last: list[Any] = []
    with bar as show:

        def report(now: Any) -> None:
            last[:] = [now]
            if show is not None:
                show(now)

        try:
            return work(report), last[0] if last else None
        except (dvi.StoreError, OSError):
            raise
        except Exception as error:
            if last:
                raise
            raise misfit(error) from error


def output_for(
    path: Path, out: str | Path | None, given: str | None, names: tuple[str, ...], force: bool
) -> Output:
    """The directory of the option --out, or of the file, or one named after the file."""
    key = "--out" if out is not None else "output.dir"
    return Output(Path(out or given or f"results/{path.stem}"), key, names, force)


def provenance(kind: str, path: Path, raw: dict[str, Any]) -> dict[str, Any]:
    """The file as it is, and the versions that it was run with."""
    versions = {name: version(name) for name in ("dvi-jax", "jax", "jaxlib", "numpy")}
    return {
        kind: str(path),
        "config": raw,
        "versions": versions | {"python": platform.python_version()},
    }
