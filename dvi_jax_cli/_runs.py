"""Commands of one trajectory and of the library: run, systems."""

from pathlib import Path
from typing import Annotated

import typer

from ._group import RUNS, START, app
from ._names import SYSTEMS, completer
from ._session import Session, command

Force = Annotated[
    bool, typer.Option("--force", help="Write into a directory that has results already.")
]
Out = Annotated[Path | None, typer.Option(help="Directory for the results, instead of output.dir.")]


@command(
    app,
    "systems",
    panel=START,
    examples=[
        "dvi-jax systems                  all of them",
        "dvi-jax systems kepler           equations, parameters, what is conserved",
        "dvi-jax systems kepler --json    the same for programs",
    ],
)
def systems(
    session: Session,
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME",
            help="A system of the library.",
            autocompletion=completer(SYSTEMS),
            show_default=False,
        ),
    ] = None,
) -> None:
    """List the library of systems, or tell what is known of one.

    Exit code 0: done. 2: there is no such system.
    """
    session.start_jax()
    from dvi_jax.run import library_tables

    heading, tables = library_tables(name)
    if heading:
        session.line(heading)
    session.tables(tables, words=True)
    session.finish({
        "name": name,
        "about": heading,
        "tables": {t.title: [dict(zip(t.columns, row, strict=True)) for row in t.rows]
                   for t in tables},
    })  # fmt: skip


@command(
    app,
    "run",
    panel=RUNS,
    examples=[
        "dvi-jax run run.toml",
        "dvi-jax run run.toml --out results/again --force",
        "dvi-jax run run.toml --json | jq .results",
    ],
)
def run(
    session: Session,
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG", help="TOML file that describes the run.")
    ],
    out: Out = None,
    force: Force = False,
) -> None:
    """Integrate what a TOML file describes; write the trajectory, a report and pictures.

    Exit code 0: done. 1: the trajectory failed (what there is has been written). 2: bad input.
    """
    session.start_jax()
    from dvi_jax.run import run_file

    session.note(f"reading {config}")
    with session.bar("integrating") as bar:
        report = run_file(config, out=out, force=force, progress=bar.show)
    show_report(session, report)
    stats = report.contents["stats"]
    session.line(
        f"{stats['num_steps']} steps in {stats['seconds']:.1f} s (compilation included); "
        f"written to {report.folder}: {', '.join(report.files)}"
    )
    session.finish(written(report), "" if report.ok else report.message)


def show_report(session: Session, report) -> None:
    """The tables and notes of a report."""
    session.tables(report.tables)
    for note in report.notes:
        session.line(note, style="bold")


def written(report) -> dict:
    """The contents of a report, and where its files are."""
    return {"folder": str(report.folder), "files": report.files, **report.contents}
