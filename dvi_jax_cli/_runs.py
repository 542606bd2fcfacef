"""Commands of one TOML file: run, fit, discover."""

from pathlib import Path
from typing import Annotated

import typer

from ._group import INVERSE, RUNS, app
from ._session import AGAIN, Session, command

Config = Annotated[Path, typer.Argument(metavar="CONFIG", help="TOML file.")]
Force = Annotated[
    bool, typer.Option("--force", help="Write into a directory that has results already.")
]
Out = Annotated[Path | None, typer.Option(help="Directory for the results, instead of output.dir.")]
Resume = Annotated[
    bool, typer.Option("--resume", help="Continue from the checkpoint of an interrupted fit.")
]


@command(app, "run", RUNS)
def run(session: Session, config: Config, out: Out = None, force: Force = False) -> None:
    """Integrate what a TOML file describes; write the trajectory, a report and pictures.

    Exit code 0: done. 1: the trajectory failed (its results have been written). 2: bad input.

    Examples
        dvi-jax run run.toml
        dvi-jax run run.toml --out results/again --force
        dvi-jax run run.toml --json | jq .results
    """
    session.start_jax()
    from .work.run import run_file

    session.note(f"reading {config}")
    with session.bar("integrating") as bar:
        report = run_file(config, out=out, force=force, progress=bar.show)
    session.finish_report(report)


@command(app, "fit", INVERSE)
def fit(
    session: Session,
    config: Config,
    out: Out = None,
    force: Force = False,
    resume: Resume = False,
) -> None:
    """Find parameters of a system from observations in a CSV or npz file.

    Prints parameters with errors, correlations and residuals; writes fit.json, fit.npz, the
    fitted trajectory and pictures.

    Exit code 0: converged. 1: not converged (the results have been written). 2: bad input.
    130: Ctrl-C.

    Examples
        dvi-jax fit fit.toml
        dvi-jax fit fit.toml --resume      continues from its checkpoint, or begins
        dvi-jax fit fit.toml --json | jq .parameters
    """
    session.start_jax()
    session.stopped = "by Ctrl-C; there is a checkpoint if the fit had run for some seconds"
    session.hint = AGAIN
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
    session.start_jax()
    from .work.discover import discover_file

    session.note(f"reading {config}")
    with session.bar("discovering") as bar:
        report = discover_file(config, out=out, force=force, progress=bar.show)
    session.finish_report(report)
