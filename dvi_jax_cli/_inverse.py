"""Commands that go from data to what is behind them: fit, discover."""

from pathlib import Path
from typing import Annotated

import typer

from ._group import INVERSE, app
from ._runs import Force, Out, show_report, written
from ._session import AGAIN, Session, command


@command(
    app,
    "fit",
    panel=INVERSE,
    examples=[
        "dvi-jax fit fit.toml",
        "dvi-jax fit fit.toml --resume      goes on from its checkpoint, or begins",
        "dvi-jax fit fit.toml --json | jq .parameters",
    ],
)
def fit(
    session: Session,
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG", help="TOML file that describes the fit.")
    ],
    out: Out = None,
    force: Force = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the checkpoint of a fit that was ended.")
    ] = False,
) -> None:
    """Find parameters of a system from observations in a CSV or npz file.

    Prints parameters with errors, correlations and what is left over; writes fit.json, fit.npz,
    the fitted trajectory and pictures.

    Exit code 0: converged. 1: not so (what there is has been written). 2: bad input. 130: Ctrl-C.
    """
    session.start_jax()
    session.stopped = "by Ctrl-C; there is a checkpoint if the fit had gone on for some seconds"
    session.hint = AGAIN
    from dvi_jax.run import fit_file

    session.note(f"reading {config}")
    report = fit_file(config, out=out, force=force, resume=resume)
    show_report(session, report)
    session.line(
        f"{report.contents['status']} after {report.contents['steps']} steps, "
        f"{report.contents['seconds']:.1f} s (compilation included); "
        f"written to {report.folder}: {', '.join(report.files)}"
    )
    session.finish(written(report), "" if report.ok else report.message)


@command(
    app,
    "discover",
    panel=INVERSE,
    examples=[
        "dvi-jax discover discover.toml",
        "dvi-jax discover discover.toml --json | jq '.invariants[].formula'",
    ],
)
def discover(
    session: Session,
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG", help="TOML file that describes the search.")
    ],
    out: Out = None,
    force: Force = False,
) -> None:
    """Find what the discrete map keeps: invariants in ε as formulas, and how they drift.

    Writes invariants.json, discovery.npz and a picture of the drifts against ε.

    Exit code 0: done, with or without an invariant. 1: failed. 2: bad input.
    """
    session.start_jax()
    from dvi_jax.run import discover_file

    session.note(f"reading {config}")
    with session.bar("discovering") as bar:
        report = discover_file(config, out=out, force=force, progress=bar.show)
    show_report(session, report)
    session.line(
        f"{report.contents['seconds']:.1f} s (compilation included); "
        f"written to {report.folder}: {', '.join(report.files)}"
    )
    session.finish(written(report))
