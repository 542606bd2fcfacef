"""Commands that work on a TOML file or its results: run, sweep, fit, discover, bound, report."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from ._group import INVERSE, RESULTS, RUNS, app
from ._session import RESUME_HINT, Session, command
from ._show import progress_bar

Config = Annotated[Path, typer.Argument(metavar="CONFIG", help="TOML file.")]
Force = Annotated[
    bool, typer.Option("--force", help="Write into a directory that has results already.")
]
Out = Annotated[Path | None, typer.Option(help="Directory for the results, instead of output.dir.")]
Resume = Annotated[
    bool,
    typer.Option("--resume", help="Continue with what an interrupted call has saved, if it has."),
]
StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="Directory of a sweep.")]
Store = Annotated[
    Path | None, typer.Option(help="Directory for the results, instead of output.store.")
]
Threads = Annotated[
    int | None,
    typer.Option(
        min=1, help="Threads; one for each processor or GPU if not given.", show_default=False
    ),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Show tasks, bytes and seconds only.")]


# One trajectory


@command(app, "run", RUNS)
def run(session: Session, config: Config, out: Out = None, force: Force = False) -> None:
    """Integrate what a TOML file describes; write the trajectory, a report and pictures.

    Exit code 0: done. 1: the trajectory failed (its results have been written). 2: bad input.

    Examples
        dvi-jax run run.toml
        dvi-jax run run.toml --out results/again --force
        dvi-jax run run.toml --json | jq .results
    """
    from .work.run import run_file

    session.note(f"reading {config}")
    with progress_bar("integrating") as bar:
        report = run_file(config, out=out, force=force, progress=bar)
    session.finish_report(report)


# Many trajectories


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
    help="Compute many trajectories: run the sweep of a TOML file, show or verify its store.",
)
app.add_typer(sweeps, name="sweep", rich_help_panel=RUNS)


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
    session.interruption, session.hint = "before anything was done", RESUME_HINT
    from .work.sweep import sweep_cost, sweep_file

    session.note(f"reading {config}")
    report = sweep_cost(config) if dry_run else sweep_file(config, store, resume, threads)
    session.finish_report(report)


@command(sweeps, "status", jax=False)
def sweep_status(session: Session, store: StorePath) -> None:
    """Show the state of a sweep: tasks, trajectories, rate, size, provenance.

    It may be running meanwhile. Exit code 0: done. 2: there is no store.

    Examples
        dvi-jax sweep status results/sweep.zarr
    """
    from .work.sweep import sweep_status

    session.finish_report(sweep_status(store))


@command(sweeps, "verify", jax=False)
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

    with progress_bar("verifying") as bar:
        report = verify_store(store, bar)
    session.finish_report(report)


# From data


@command(app, "fit", INVERSE)
def fit(
    session: Session, config: Config, out: Out = None, force: Force = False, resume: Resume = False
) -> None:
    """Find parameters of a system from observations in a CSV or npz file.

    Prints parameters with errors, correlations and residuals; writes fit.json, fit.npz, the
    fitted trajectory and pictures.

    Exit code 0: converged. 1: not converged, or the model does not describe the data: reduced chi²
    is above 10 (the results have been written). 2: bad input.
    130: Ctrl-C.

    Examples
        dvi-jax fit fit.toml
        dvi-jax fit fit.toml --resume      continues from its checkpoint, or begins
        dvi-jax fit fit.toml --json | jq .parameters
    """
    session.interruption = (
        "by Ctrl-C or SIGTERM; there is a checkpoint if the fit had run for some seconds"
    )
    session.hint = RESUME_HINT
    from .work.fit import fit_file

    session.note(f"reading {config}")
    session.finish_report(fit_file(config, out=out, force=force, resume=resume))


@command(app, "discover", INVERSE)
def discover(session: Session, config: Config, out: Out = None, force: Force = False) -> None:
    """Find what the discrete map conserves: invariants in ε as formulas, and their drifts.

    Writes invariants.json, discovery.npz and a picture of the drifts against ε.

    Exit code 0: done, with or without an invariant. 1: failed. 2: bad input.

    Examples
        dvi-jax discover discover.toml
        dvi-jax discover discover.toml --json | jq '.invariants[].formula'
    """
    from .work.discover import discover_file

    session.note(f"reading {config}")
    with progress_bar("discovering") as bar:
        report = discover_file(config, out=out, force=force, progress=bar)
    session.finish_report(report)


@command(app, "bound", INVERSE)
def bound(session: Session, config: Config, out: Out = None, force: Force = False) -> None:
    """Prove how much invariants change in a step of the map, and in how many steps at most.

    Writes bound.json and certificate.json, which `dvi-jax verify` checks.

    Exit code 0: proved. 1: nothing is proved, or failed. 2: bad input.

    Examples
        dvi-jax bound bound.toml
        dvi-jax bound bound.toml --json | jq .per_step
    """
    from .work.bound import bound_file

    session.note(f"reading {config}")
    session.finish_report(bound_file(config, out=out, force=force))


# Results of all kinds


@command(app, "report", RESULTS)
def report(
    session: Session,
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help="Folder of results, store, or saved file.")
    ],
    out: Annotated[Path | None, typer.Option(help="The page; PATH.html if not given.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the page if it exists.")] = False,
) -> None:
    """Write one HTML page about results: statuses, pictures, tables, how to repeat the work.

    PATH is what run, sweep, fit, discover or bound wrote, or a file of Solution.save. The page
    needs no other file and no server.

    Exit code 0: done, whatever the results are. 1: the page cannot be written. 2: there are no
    results, or they are damaged.

    Examples
        dvi-jax report results/kepler              writes results/kepler.html
        dvi-jax report results/sweep.zarr --out sweep.html
        dvi-jax report orbit.npz --force
    """
    session.unwritten = "the page cannot be written"
    from .work.html_report import html_report

    session.finish_report(html_report(path, out, force))
