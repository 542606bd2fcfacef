"""Commands of many trajectories: sweep CONFIG, sweep status, sweep verify."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from ._group import RUNS, app
from ._runs import Config
from ._session import AGAIN, Session, command


class _RunFirst(TyperGroup):
    """Commands; `run` is the one where none is named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put `run` in front of other arguments."""
        if args and args[0] not in (*self.commands, "--help"):
            args = ["run", *args]
        return super().parse_args(ctx, args)


sweeps = typer.Typer(
    cls=_RunFirst,
    no_args_is_help=True,
    subcommand_metavar="CONFIG | status STORE | verify STORE",
    rich_markup_mode="rich",
    help="Many trajectories: run the sweep of a TOML file, show the state of its store, verify it.",
)
app.add_typer(sweeps, name="sweep", rich_help_panel=RUNS)

StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="Directory of a sweep.")]
Store = Annotated[
    Path | None, typer.Option(help="Directory for the results, instead of output.store.")
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Continue with a store that exists, if it does.")
]
Threads = Annotated[
    int | None,
    typer.Option(
        min=1, help="Threads; one for each processor or GPU if not given.", show_default=False
    ),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Show tasks, bytes and seconds only.")]


@command(sweeps, "run")
def sweep_run(
    session: Session,
    config: Config,
    store: Store = None,
    resume: Resume = False,
    threads: Threads = None,
    dry_run: DryRun = False,
) -> None:
    """Run the sweep of a TOML file; `sweep CONFIG` is short for this.

    Each task is in the store once it is done. After an interruption --resume continues from there.

    Exit code 0: done; trajectories that fail are results, and are counted in a table. 1: failed,
    such as by a full disk. 2: bad input, or a store of another sweep. 130: Ctrl-C.

    Examples
        dvi-jax sweep sweep.toml --dry-run      tasks, bytes and seconds that it would take
        dvi-jax sweep sweep.toml
        dvi-jax sweep sweep.toml --resume       continues, or begins
    """
    session.start_jax()
    session.stopped, session.hint = "before anything was done", AGAIN
    from .work.sweep import sweep_cost, sweep_file

    session.note(f"reading {config}")
    report = sweep_cost(config) if dry_run else sweep_file(config, store, resume, threads)
    session.finish_report(report)


@command(sweeps, "status")
def sweep_status(session: Session, store: StorePath) -> None:
    """Show the state of a sweep: tasks, trajectories, rate, size, provenance.

    It may be running meanwhile. Exit code 0: done. 2: there is no store.

    Examples
        dvi-jax sweep status results/sweep.zarr
    """
    from .work.sweep import sweep_status

    session.finish_report(sweep_status(store))


@command(sweeps, "verify")
def sweep_verify(session: Session, store: StorePath) -> None:
    """Read everything in a store again: checksums, and whether it can be decoded.

    Bad tasks are marked as not done; the sweep with --resume computes them again, to the same bits.

    Exit code 0: everything is correct. 1: something was bad, or cannot be read. 2: there is no
    store.

    Examples
        dvi-jax sweep verify results/sweep.zarr
    """
    session.unwritten = "the bad tasks cannot be marked as not done"
    from .work.sweep import verify_store

    with session.bar("verifying") as bar:
        report = verify_store(store, bar.show)
    session.finish_report(report)
