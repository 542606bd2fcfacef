"""Commands that look things up and check: systems, schema, verify, paper, certify, info."""

import json
from pathlib import Path
from typing import Annotated

import typer

from ._errors import as_input_error, require, require_file, require_name
from ._group import CHECKING, START, app
from ._names import CHECKS, FILES, METHODS, SYSTEMS, completer
from ._runs import Force
from ._session import FAILURE, Session, command
from ._show import console, print_json, progress_bar


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
            help="run, sweep, fit, discover or bound; a file of any kind if not given.",
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
        require_name("KIND", kind, FILES)
    from .work.schema import json_schema

    print_json(json_schema(kind))


@command(app, "verify", CHECKING, jax=False)
def verify(
    session: Session,
    certificate: Annotated[
        Path, typer.Argument(metavar="CERTIFICATE", help="A file of DriftBound.save.")
    ],
    max_seconds: Annotated[
        float, typer.Option(min=0.0, help="Time after which the check is given up.")
    ] = 60.0,
    system: Annotated[
        str, typer.Option(metavar="FILE.py:NAME", help="A system that the proof must be about.")
    ] = "",
    method: Annotated[str, typer.Option(help="The method of this system.")] = "",
    invariants: Annotated[
        str, typer.Option(metavar="FILE.py:NAME", help="Invariants that it must be about.")
    ] = "",
) -> None:
    """Check a certificate of `bound_drift` with a small program of its own.

    It evaluates every box of the proof again, with python-flint and without JAX, in at most 1 GiB.
    With --system the map of this system is read again, and compared with that of the certificate.
    Exit code 0: the bounds are proved. 1: they are not, or for another system; the message says
    where. 2: there is no such file, or it is not a certificate.

    Examples
        dvi-jax verify bound.json
        dvi-jax verify bound.json --system model.py:pendulum --method Strang
        dvi-jax verify bound.json --system model.py:pendulum --invariants model.py:energy
    """
    require_file("CERTIFICATE", certificate, "a file that DriftBound.save wrote")
    from .work.verify import verify_certificate

    contents, message = verify_certificate(certificate, max_seconds)
    if not message:
        session.line(f"proved: {contents['proved']}")
    if system and not message:
        session.start_jax()
        from .work.verify import compare_system

        binding, message = compare_system(certificate, system, method, invariants)
        session.line(binding["text"])
        contents["system"] = binding
    session.finish(contents, message)


@command(app, "paper", CHECKING)
def paper(
    session: Session,
    out: Annotated[Path, typer.Option(help="Directory for figures and numbers.")] = Path(
        "paper-out"
    ),
    force: Force = False,
) -> None:
    """Reproduce the figures and numbers of the paper.

    Exit code 0: done, whatever the verdicts are. 1: failed. 2: bad input.

    Examples
        dvi-jax paper                    figures, tables, verdicts in ./paper-out
        dvi-jax paper --out DIR --json   the verdicts on stdout as well
    """
    from dvi_jax.testing.paper import reproduce

    kinds = FileExistsError, NotADirectoryError, PermissionError
    with as_input_error("--out", "a new directory, or --force", *kinds):
        reproduction = reproduce(out, force, console(stderr=session.as_json))
    verdicts = json.loads((reproduction.out / "verdicts.json").read_text(encoding="utf-8"))
    session.finish({"folder": str(reproduction.out), **verdicts})


@command(app, "certify", CHECKING)
def certify(
    session: Session,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="A method to certify; may be repeated. All if none.", **completer(METHODS)
        ),
    ] = None,
    check: Annotated[
        list[str] | None,
        typer.Option(help="A check to make; may be repeated. All if none.", **completer(CHECKS)),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Markdown file, or directory, for the certificate.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="One method of each kind only.")] = False,
) -> None:
    """Measure order, structure, long runs, gradients and compilation of the methods.

    Each check is also applied to a method with a known defect, which it must find (the controls).

    Exit code 0: all requirements met, all controls found. 1: not all. 2: bad input.

    Examples
        dvi-jax certify --quick
        dvi-jax certify --method Strang --check order --check energy
        dvi-jax certify --out docs/certificate.md
    """
    session.unwritten = "the certificate cannot be written"
    from dvi_jax.testing import QUICK, certify, page_for

    is_single = not (quick and method)
    require(is_single, "--quick", "it is given together with --method", "only one of the two")
    rule = "names as in dvi-jax certify --help, and a page that can be written"
    with as_input_error("certify", rule):
        page = None if out is None else page_for(out)
        with progress_bar("certifying") as bar:
            certificate = certify(QUICK if quick else method or None, check or None, bar)
    failures = [
        f"{name}, {quantity}: {result.verdict}, allowed {result.allowed}. {result.detail}"
        for name, quantity, result in certificate.failures
    ]
    tables = certificate.tables()
    session.tables(tables)
    for failure in failures:
        session.line(failure)
    session.line(certificate.summary, style="bold")
    if page is not None:
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(certificate.markdown(), encoding="utf-8")
        session.line(f"written to {page}")
    contents = {
        "summary": certificate.summary,
        "failures": failures,
        "tables": [{"title": t.title, "columns": t.columns, "rows": t.rows} for t in tables],
        "file": page and str(page),
    }
    if certificate.ok or session.as_json:
        session.finish(contents, "" if certificate.ok else certificate.summary)
    else:  # the summary is on the screen already
        raise typer.Exit(FAILURE)


@command(app, "info", CHECKING, jax=False)
def info(session: Session) -> None:
    """Print versions, devices, precision, flags and extras (attach it to bug reports).

    Exit code 0: done. 1: JAX cannot be started.

    Examples
        dvi-jax info
        dvi-jax info --json > machine.json
    """
    from ._info import gather, tables

    information = gather()
    session.tables(tables(information), words=True)
    session.finish(information, information["failed"])
