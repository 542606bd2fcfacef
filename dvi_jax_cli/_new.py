"""The command that writes a new project: new NAME."""

import json
import re
import shlex
import sys
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import typer

from ._errors import require, require_name
from ._group import START, app
from ._names import SYSTEMS, completer
from ._session import Session, command

_NAME = re.compile(r"[^\W_][\w. -]{0,99}")
_DEVICES = {"con", "prn", "aux", "nul", *(f"{x}{i}" for x in ("com", "lpt") for i in range(1, 10))}
"""Names of devices on Windows."""


@command(app, "new", START, jax=False)
def new(
    session: Session,
    name: Annotated[
        Path, typer.Argument(metavar="NAME", help="Directory to make, which must not exist yet.")
    ],
    system: Annotated[
        str | None,
        typer.Option(
            help="Begin with a system of the library instead of one of your own.",
            **completer(SYSTEMS),
        ),
    ] = None,
) -> None:
    """Write a new project: a system, TOML files and a notebook that run without changes.

    Exit code 0: done. 1: it cannot be written. 2: the name exists already, or is not allowed.

    Examples
        dvi-jax new spring && cd spring && dvi-jax run run.toml
        dvi-jax new orbits --system kepler
    """
    session.unwritten = "the project cannot be written"
    _check(name, system)
    templates = resources.files("dvi_jax_cli") / "templates" / ("library" if system else "own")
    files = {}
    for file in sorted(filter(lambda file: file.is_file(), templates.iterdir()), key=str):
        text = file.read_text(encoding="utf-8").replace("{{title}}", name.name)
        files[file.name] = text.replace("{{system}}", system or "")
    cells = notebook(files["explore.py"])
    files["explore.ipynb"] = json.dumps(cells, indent=1, ensure_ascii=False) + "\n"
    name.mkdir(parents=True)
    for file, text in files.items():
        session.note(f"writing {name / file}")
        (name / file).write_text(text, encoding="utf-8")
    session.line(f"{name}: {', '.join(sorted(files))}")
    first = f"cd {shlex.quote(str(name))} && dvi-jax run run.toml"
    session.line(f"Begin with: {first}; README.md has the next steps.")
    if system:
        session.line("Only without --system: fit.toml, discover.toml and system.py, as examples.")
    session.finish({"folder": str(name), "files": sorted(files), "system": system})


def _check(name: Path, system: str | None) -> None:
    last = name.name
    fits = _NAME.fullmatch(last) and last.split(".")[0].lower() not in _DEVICES
    rule = "letters and digits first, then also . _ - and spaces"
    require(fits and last[-1] not in " .", "NAME", f"{str(name)!r} is not a valid name", rule)
    is_new = not (name.exists() or name.is_symlink())
    require(is_new, "NAME", f"{name} exists already", "a new directory")
    if system is not None:
        require_name("--system", system, SYSTEMS)


def notebook(script: str) -> dict[str, Any]:
    """A notebook (format 4.5) from a script whose cells begin with ``# %%``."""
    cells = []
    for i, part in enumerate(re.split(r"^# %%", script, flags=re.MULTILINE)[1:]):
        head, _, body = part.partition("\n")
        body = body.strip("\n")
        kind: dict[str, Any] = {"cell_type": "code", "execution_count": None, "outputs": []}
        if "[markdown]" in head:
            kind, body = {"cell_type": "markdown"}, re.sub(r"^# ?", "", body, flags=re.MULTILINE)
        source = body.splitlines(keepends=True)
        cells.append({"id": f"cell-{i}", "metadata": {}, **kind, "source": source})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    language = {"name": "python", "version": sys.version.split()[0]}
    metadata = {"kernelspec": kernel, "language_info": language}
    return {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}
