"""Commands that list what may be written in a TOML file: systems, schema."""

from typing import Annotated

import typer

from ._errors import known
from ._group import START, app
from ._names import FILES, SYSTEMS, completer
from ._session import Session, command
from ._show import print_json


@command(app, "systems", START)
def systems(
    session: Session,
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="A system of the library.", **completer(SYSTEMS)),
    ] = None,
) -> None:
    """List the library of systems, or describe one of them.

    Exit code 0: done. 2: there is no such system.

    Examples
        dvi-jax systems                  all of them
        dvi-jax systems kepler           equations, parameters, what is conserved
        dvi-jax systems kepler --json    the same for programs
    """
    from .work.library import library_tables

    heading, tables = library_tables(name)
    if heading:
        session.line(heading)
    session.tables(tables, words=True)
    rows = {t.title: [dict(zip(t.columns, row, strict=True)) for row in t.rows] for t in tables}
    session.finish({"name": name, "about": heading, "tables": rows})


@command(app, "schema", START, jax=False)
def schema(
    session: Session,
    kind: Annotated[
        str | None,
        typer.Argument(
            metavar="KIND",
            help="run, sweep, fit or discover; a file of any kind if not given.",
            **completer(FILES),
        ),
    ] = None,
) -> None:
    """Print the JSON schema of the TOML files, by which an editor completes and checks them.

    Exit code 0: done. 2: there is no such kind of file.

    Examples
        dvi-jax schema sweep                    keys, types and ranges of a sweep file
        dvi-jax schema run > run.schema.json    for an editor
    """
    if kind is not None:
        known("KIND", kind, FILES)
    from .work.schema import json_schema

    print_json(json_schema(kind))
