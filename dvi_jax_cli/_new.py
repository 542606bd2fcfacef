"""The command that writes a project to begin with: new NAME."""

import json
import re
import shlex
import sys
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import typer

from ._group import START, app
from ._names import SYSTEMS, completer
from ._session import Refused, Session, command

_NAME = re.compile(r"[^\W_][\w. -]{0,99}")
_RESERVED = {"con", "prn", "aux", "nul", *(f"{x}{i}" for x in ("com", "lpt") for i in range(1, 10))}
"""Names that Windows has taken for devices."""


@command(
    app,
    "new",
    panel=START,
    examples=[
        "dvi-jax new spring && cd spring && dvi-jax run run.toml",
        "dvi-jax new orbits --system kepler",
    ],
)
def new(
    session: Session,
    name: Annotated[
        Path, typer.Argument(metavar="NAME", help="Directory to make, which must not exist yet.")
    ],
    system: Annotated[
        str | None,
        typer.Option(
            help="Begin with a system of the library instead of one of your own.",
            autocompletion=completer(SYSTEMS),
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a project to begin with: a system, TOML files, a notebook, that run as they are.

    Exit code 0: done. 1: it cannot be written. 2: a name that is taken, or that is none.
    """
    session.unwritten = "the project cannot be written"
    _check(name, system)
    words = {"title": name.name, "system": system or ""}
    files = dict(_files("own" if system is None else "library", words))
    files["explore.ipynb"] = json.dumps(notebook(files["explore.py"]), indent=1,
                                        ensure_ascii=False) + "\n"  # fmt: skip
    name.mkdir(parents=True)
    for file, text in files.items():
        session.note(f"writing {name / file}")
        (name / file).write_text(text, encoding="utf-8")
    session.line(f"{name}: {', '.join(sorted(files))}")
    session.line(
        f"Begin with: cd {shlex.quote(str(name))} && dvi-jax run run.toml; README.md goes on from "
        "there."
    )
    session.finish({"folder": str(name), "files": sorted(files), "system": system})


def _check(name: Path, system: str | None) -> None:
    last = name.name
    if not _NAME.fullmatch(last) or last.split(".")[0].lower() in _RESERVED or last[-1] in " .":
        raise Refused(
            "bad input",
            f"NAME: {str(name)!r}\n  allowed: letters and digits first, then also . _ - and spaces",
        )
    if name.exists() or name.is_symlink():
        raise Refused("bad input", f"NAME: {name} exists already\n  allowed: a new directory")
    if system is not None and system not in SYSTEMS:
        import difflib

        near = difflib.get_close_matches(system, SYSTEMS, n=1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        raise Refused("bad input", f"--system: {system!r}\n  allowed: {', '.join(SYSTEMS)}{hint}")


def _files(kind: str, words: dict[str, str]) -> Any:
    """(name, text) of each template, with {{word}} filled in."""
    for file in sorted((resources.files("dvi_jax_cli") / "templates" / kind).iterdir(), key=str):
        if not file.is_file():
            continue
        text = file.read_text(encoding="utf-8")
        for word, value in words.items():
            text = text.replace("{{" + word + "}}", value)
        yield file.name, text


def notebook(script: str) -> dict[str, Any]:
    """A notebook (format 4.5) out of a script in cells, which begin with ``# %%``."""
    cells = []
    for i, part in enumerate(re.split(r"^# %%", script, flags=re.MULTILINE)[1:]):
        head, _, body = part.partition("\n")
        body = body.strip("\n")
        cell: dict[str, Any] = {"id": f"cell-{i}", "metadata": {}}
        if "[markdown]" in head:
            body = re.sub(r"^# ?", "", body, flags=re.MULTILINE)
            cell |= {"cell_type": "markdown"}
        else:
            cell |= {"cell_type": "code", "execution_count": None, "outputs": []}
        cells.append(cell | {"source": body.splitlines(keepends=True)})
    return {
        "cells": cells,
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python", "version": sys.version.split()[0]},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }
