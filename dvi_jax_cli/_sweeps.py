"""Commands of many trajectories: sweep CONFIG, sweep status, sweep verify."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from ._group import RUNS, app
from ._session import AGAIN, Session, command


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
    rich_markup_mode="rich",
    help="Many trajectories: run the sweep of a TOML file, look at its store, verify it.",
)
app.add_typer(sweeps, name="sweep", rich_help_panel=RUNS)

StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="Directory of a sweep.")]


@command(
    sweeps,
    "run",
    examples=[
        "dvi-jax sweep sweep.toml --dry-run      tasks, bytes and seconds that it would take",
        "dvi-jax sweep sweep.toml",
        "dvi-jax sweep sweep.toml --resume       goes on, or begins",
    ],
)
def sweep_run(
    session: Session,
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG", help="TOML file that describes the sweep.")
    ],
    store: Annotated[
        Path | None, typer.Option(help="Directory for the results, instead of output.store.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a store that exists, if it does.")
    ] = False,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Threads; one for each processor or GPU if not given.",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say what it would take: tasks, bytes, seconds.")
    ] = False,
) -> None:
    """Do the sweep that a TOML file describes; this is what CONFIG alone means.

    Each task is in the store once it is done. Whatever ends the sweep, --resume goes on from there.

    Exit code 0: done; trajectories that fail are results, and are counted in a table. 1: failed,
    such as by a full disk. 2: bad input, or a store of another sweep. 130: Ctrl-C.
    """
    session.start_jax()
    session.stopped, session.hint = "before anything was done", AGAIN
    from dvi_jax.run import sweep_cost, sweep_file

    session.note(f"reading {config}")
    if dry_run:
        _show(session, sweep_cost(config))
    else:
        _show(session, sweep_file(config, store, resume, threads))


@command(sweeps, "status", examples=["dvi-jax sweep status results/sweep.zarr"])
def sweep_status(session: Session, store: StorePath) -> None:
    """How far a sweep is: tasks, trajectories, rate, size, and what it was made with.

    It may be running meanwhile. Exit code 0: done. 2: there is no store.
    """
    from dvi_jax.run import sweep_status

    _show(session, sweep_status(store))


@command(sweeps, "verify", examples=["dvi-jax sweep verify results/sweep.zarr"])
def sweep_verify(session: Session, store: StorePath) -> None:
    """Read everything in a store again: checksums, and that it can be decoded.

    Tasks that are bad are open again, and the sweep with --resume does them anew: in the same bits.

    Exit code 0: all is sound. 1: something was bad, or cannot be read. 2: there is no store.
    """
    session.unwritten = "the bad tasks cannot be opened again"
    from dvi_jax.run import verify_store

    with session.bar("verifying") as bar:
        report = verify_store(store, bar.show)
    bad = (
        "bad tasks were found; they are open again. To repair the store, do the sweep again with "
        "--resume."
    )
    _show(session, report, bad if report.contents["bad"] else "")


def _show(session: Session, report: Any, failed: str = "") -> None:
    session.tables(report.tables)
    session.line(report.summary)
    session.finish(report.contents, failed)
