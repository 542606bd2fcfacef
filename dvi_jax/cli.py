"""The command line."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

app = typer.Typer(
    name="dvi-jax",
    help="Differentiable variational integrators for disturbed Hamiltonian systems.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

BAD_INPUT = 2
FAILED = 1
INTERRUPTED = 130
AGAIN = "On the command line: the same with --resume goes on from what is done."


class _RunFirst(TyperGroup):
    """Commands of which `run` is meant where none is named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, "--help"):
            args = ["run", *args]
        return super().parse_args(ctx, args)


sweeps = typer.Typer(
    cls=_RunFirst,
    no_args_is_help=True,
    subcommand_metavar="CONFIG | status STORE | verify STORE",
    help="Many trajectories: run the sweep of a TOML file, look at its store, verify it.",
)
app.add_typer(sweeps, name="sweep")

Debug = Annotated[bool, typer.Option("--debug", help="Show the whole traceback of an error.")]
StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="Directory of a sweep.")]
Force = Annotated[
    bool, typer.Option("--force", help="Write into a directory that has results already.")
]


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"dvi-jax {version('dvi-jax')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    pass


@app.command()
def run(
    config: Annotated[Path, typer.Argument(help="TOML file that describes the run.")],
    out: Annotated[
        Path | None, typer.Option(help="Directory for the results, instead of output.dir.")
    ] = None,
    force: Force = False,
    debug: Debug = False,
) -> None:
    """Integrate what a TOML file describes; write the trajectory, a report and pictures.

    Exit code 0: done. 1: the trajectory failed (what there is has been written). 2: bad input.
    """
    _double_precision()
    from dvi_jax.run import InputError, run_file

    try:
        with _Bar("integrating") as bar:
            report = run_file(config, out=out, force=force, progress=bar.show)
    except InputError as error:
        if debug:
            raise
        _complain("bad input", str(error))
        raise typer.Exit(BAD_INPUT) from None
    except OSError as error:  # a full disk, a directory that went away
        if debug:
            raise
        _complain("failed", f"the results cannot be written: {error}")
        raise typer.Exit(FAILED) from None
    _print(report)
    if not report.ok:
        _complain("failed", report.message)
        raise typer.Exit(FAILED)


@sweeps.command("run")
def sweep_run(
    config: Annotated[Path, typer.Argument(help="TOML file that describes the sweep.")],
    store: Annotated[
        Path | None, typer.Option(help="Directory for the results, instead of output.store.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a store that exists, if it does.")
    ] = False,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Threads; one for each processor or GPU if not given.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say what it would take: tasks, bytes, seconds.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Do the sweep that a TOML file describes; this is what CONFIG alone means.

    Each task is in the store once it is done. Whatever ends the sweep, --resume goes on from there.

    Exit code 0: done; trajectories that fail are results, and are counted in a table. 1: failed,
    such as by a full disk. 2: bad input, or a store of another sweep. 130: Ctrl-C.
    """
    _double_precision()
    from dvi_jax import StoreError, StoreMismatch
    from dvi_jax.run import InputError, sweep_cost, sweep_file

    try:
        if dry_run:
            typer.echo(sweep_cost(config))
            return
        report = sweep_file(config, store, resume, threads)
    except KeyboardInterrupt as error:
        what = str(error).removeprefix("interrupted: ") or "before anything was done"
        _complain("interrupted", f"{what}\n{AGAIN}")
        raise typer.Exit(INTERRUPTED) from None
    except (InputError, StoreMismatch) as error:
        if debug:
            raise
        _complain("bad input", str(error))
        raise typer.Exit(BAD_INPUT) from None
    except (StoreError, OSError) as error:
        if debug:
            raise
        _complain("failed", f"the results cannot be written: {error}\n{AGAIN}")
        raise typer.Exit(FAILED) from None
    _print_sweep(report)


@sweeps.command("status")
def sweep_status(
    store: StorePath,
    as_json: Annotated[bool, typer.Option("--json", help="JSON, for programs.")] = False,
    debug: Debug = False,
) -> None:
    """How far a sweep is: tasks, trajectories, rate, size, and what it was made with.

    It may be running meanwhile. Exit code 0: done. 2: there is no store.
    """
    from dvi_jax.run import InputError, sweep_status

    try:
        report = sweep_status(store)
    except InputError as error:
        if debug:
            raise
        _complain("bad input", str(error))
        raise typer.Exit(BAD_INPUT) from None
    if as_json:
        typer.echo(json.dumps(report.contents, indent=2, ensure_ascii=False, allow_nan=False))
    else:
        _print_sweep(report)


@sweeps.command("verify")
def sweep_verify(store: StorePath, debug: Debug = False) -> None:
    """Read everything in a store again: checksums, and that it can be decoded.

    Tasks that are bad are open again, and the sweep with --resume does them anew: in the same bits.

    Exit code 0: all is sound. 1: something was bad, or cannot be read. 2: there is no store.
    """
    from dvi_jax.run import InputError, verify_store

    try:
        with _Bar("verifying") as bar:
            report = verify_store(store, bar.show)
    except InputError as error:
        if debug:
            raise
        _complain("bad input", str(error))
        raise typer.Exit(BAD_INPUT) from None
    except OSError as error:
        if debug:
            raise
        _complain("failed", f"the bad tasks cannot be opened again: {error}")
        raise typer.Exit(FAILED) from None
    _print_sweep(report)
    if report.contents["bad"]:
        _complain("failed", "bad tasks were found; they are open again. To repair the store, do "
                  "the sweep again with --resume.")  # fmt: skip
        raise typer.Exit(FAILED)


@app.command()
def systems(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="A system of the library.")
    ] = None,
) -> None:
    """List the library of systems, or tell what is known of one.

    Exit code 0: done. 2: there is no such system.
    """
    _double_precision()
    from dvi_jax.run import InputError, library_tables

    try:
        heading, tables = library_tables(name)
    except InputError as error:
        _complain("bad input", str(error))
        raise typer.Exit(BAD_INPUT) from None
    console = _stdout()
    if heading:
        console.print(heading, markup=False, soft_wrap=True)
    _print_tables(console, tables, words=True)


@app.command()
def paper(
    out: Annotated[Path, typer.Option(help="Directory for figures and numbers.")],
    force: Force = False,
) -> None:
    """Reproduce the figures and numbers of the paper."""
    _double_precision()
    from dvi_jax.paper import reproduce

    try:
        reproduce(out, force)
    except (FileExistsError, NotADirectoryError, PermissionError) as error:
        _complain("bad input", f"--out: {error}")
        raise typer.Exit(BAD_INPUT) from None


@app.command()
def certify(
    method: Annotated[
        list[str] | None, typer.Option(help="A method to certify; may be repeated. All if none.")
    ] = None,
    check: Annotated[
        list[str] | None, typer.Option(help="A check to make; may be repeated. All if none.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Markdown file, or directory, for the certificate.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="One method of each kind only.")] = False,
) -> None:
    """Measure what the methods promise: order, structure, long runs, gradients, compilation.

    Each check is also shown to catch a method that is broken on purpose (the controls).

    Exit code 0: all promises kept, all controls caught. 1: not so. 2: bad input.
    """
    _double_precision()
    from dvi_jax.certify import QUICK, certify, page_for

    if quick and method:
        _complain("bad input", "give --quick or --method, not both.")
        raise typer.Exit(BAD_INPUT)
    try:
        page = None if out is None else page_for(out)
        with _Bar("certifying") as bar:
            certificate = certify(QUICK if quick else method or None, check or None, bar.show)
    except (ValueError, TypeError) as error:
        _complain("bad input", str(error))
        raise typer.Exit(BAD_INPUT) from None
    console = _stdout()
    _print_tables(console, certificate.tables())
    for name, tried, measured in certificate.failures:
        said = f"{name}, {tried}: {measured.verdict}, allowed {measured.allowed}. {measured.detail}"
        console.print(said, markup=False, soft_wrap=True)
    console.print(certificate.summary, markup=False, style="bold")
    if page is not None:
        try:
            page.parent.mkdir(parents=True, exist_ok=True)
            page.write_text(certificate.markdown(), encoding="utf-8")
        except OSError as error:
            _complain("failed", f"the certificate cannot be written: {error}")
            raise typer.Exit(FAILED) from None
        console.print(f"written to {page}", markup=False, soft_wrap=True)
    if not certificate.ok:
        raise typer.Exit(FAILED)


def main() -> None:
    """The entry point ``dvi-jax``."""
    app()


def _double_precision() -> None:
    import jax
    import matplotlib as mpl

    jax.config.update("jax_enable_x64", True)
    mpl.use("Agg")  # pictures go to files: no window, no display needed


def _complain(what: str, message: str) -> None:
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True, highlight=False)
    console.print(Text.assemble((f"{what}: ", "bold red"), message), soft_wrap=True)


def _stdout() -> Any:
    from rich.console import Console

    return Console(highlight=False)


def _print_tables(console: Any, tables: Any, words: bool = False) -> None:
    """Tables, their columns but the first to the right, where numbers stand; `words`: all left."""
    from rich.markup import escape
    from rich.table import Table

    for table in tables:
        console.print(table.title, style="bold", markup=False, soft_wrap=True)
        shown = Table()
        for i, column in enumerate(table.columns):
            side = "left" if words or i == 0 else "right"
            shown.add_column(escape(column), justify=side, overflow="fold")
        for row in table.rows:
            shown.add_row(*(escape(cell) for cell in row))
        console.print(shown)


def _print_sweep(report: Any) -> None:
    console = _stdout()
    _print_tables(console, report.tables)
    console.print(report.summary, markup=False, soft_wrap=True)


def _print(report: Any) -> None:
    console = _stdout()
    _print_tables(console, report.tables)
    for note in report.notes:
        console.print(note, markup=False, style="bold")
    stats = report.contents["stats"]
    console.print(
        f"{stats['num_steps']} steps in {stats['seconds']:.1f} s (compilation included); "
        f"written to {report.folder}: {', '.join(report.files)}",
        markup=False,
        soft_wrap=True,
    )


class _Bar:
    """A progress bar on stderr that appears with the first call."""

    def __init__(self, doing: str):
        self.doing = doing

    def __enter__(self) -> "_Bar":
        self.progress = None
        return self

    def show(self, done: int, total: int) -> None:
        from rich.console import Console
        from rich.progress import Progress

        if self.progress is None:
            self.progress = Progress(console=Console(stderr=True), transient=True)
            self.progress.start()
            self.task = self.progress.add_task(self.doing, total=total)
        self.progress.update(self.task, completed=done)

    def __exit__(self, *_: object) -> None:
        if self.progress is not None:
            self.progress.stop()
