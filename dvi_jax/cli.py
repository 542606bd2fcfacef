"""The command line."""

from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(
    name="dvi-jax",
    help="Differentiable variational integrators for disturbed Hamiltonian systems.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

BAD_INPUT = 2
FAILED = 1

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
    debug: Annotated[bool, typer.Option(help="Show the whole traceback of an error.")] = False,
) -> None:
    """Integrate what a TOML file describes; write the trajectory, a report and pictures.

    Exit code 0: done. 1: the trajectory failed (what there is has been written). 2: bad input.
    """
    _double_precision()
    from dvi_jax.run import InputError, run_file

    try:
        with _Bar() as bar:
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


def _print(report: Any) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False)
    for table in report.tables:
        console.print(table.title, style="bold", markup=False, soft_wrap=True)
        shown = Table()
        for i, column in enumerate(table.columns):
            shown.add_column(escape(column), justify="left" if i == 0 else "right", overflow="fold")
        for row in table.rows:
            shown.add_row(*(escape(cell) for cell in row))
        console.print(shown)
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

    def __enter__(self) -> "_Bar":
        self.progress = None
        return self

    def show(self, done: int, total: int) -> None:
        from rich.console import Console
        from rich.progress import Progress

        if self.progress is None:
            self.progress = Progress(console=Console(stderr=True), transient=True)
            self.progress.start()
            self.task = self.progress.add_task("integrating", total=total)
        self.progress.update(self.task, completed=done)

    def __exit__(self, *_: object) -> None:
        if self.progress is not None:
            self.progress.stop()
