"""One fit: read, fit, write."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.fit.progress import shown as shown_bar
from dvi_jax.fit.result import little_explained, numbers_in_words

from .._show import Table
from .fit_problem import fit_problem
from .output import Report, opened, recorded
from .system import find_source

CHECKPOINT = "checkpoint.npz"
_IMAGES = ("data.png", "residuals.png", "parameters.png", "learning.png")
WRITTEN = ("fit.npz", "fit.json", "trajectory.npz", CHECKPOINT, *_IMAGES)
"""Every file that a fit may write; with `force` these are replaced and nothing else."""

_MOST = 20_000
"""Steps up to which every state of the fitted trajectory is written."""
_CORNER = 8
"""Parameters up to which pairs are drawn: the first ones."""
_MATRIX = 8
"""Parameters up to which the correlations are shown as a matrix; more: the strongest pairs."""
_AS_THEY_ARE = ("prior_chi2", "rms", "explained", "degrees_of_freedom", "curvature")
_AS_THEY_ARE += ("undetermined", "at_bounds", "seconds")
"""Fields of a result that are in the report under their names."""


def fit_file(
    path: str | Path,
    out: str | Path | None = None,
    force: bool = False,
    resume: bool = False,
    progress: bool | Callable[[dvi.FitProgress], None] | None = None,
) -> Report:
    """The fit that a TOML file describes.

    - `path`: the file; its keys are in `FitFile` and in the documentation.
    - `out`: directory to write to, as for `run_file`.
    - `force`: replace the results of an earlier fit there. `resume`: continue from the checkpoint
      there; begin where there is none.
    - `progress`: as for `dvi.fit`.

    Writes fit.npz (`FitResult.save`), fit.json, trajectory.npz (ts, qs, ps of the fitted
    trajectory) and pictures. A fit that does not converge is written as well, and ``ok`` is
    False; its checkpoint remains.

    **Raises** `InputError` for bad input; nothing is written then.
    """
    file, report = opened("fit", Path(path), out, WRITTEN, force or resume)
    source = find_source(file, Path(path).parent)
    arguments, columns = fit_problem(file, source)
    checkpoint = report.folder / CHECKPOINT
    last: list[dvi.FitProgress] = []
    allowed = "functions, start, args and data that fit one another"
    with report.reserved():  # a checkpoint remains after an error
        if not resume:
            checkpoint.unlink(missing_ok=True)
        with shown_bar(progress) as show, source.at_work("fit", "fitted", allowed, last):
            options = {"checkpoint": checkpoint, "throw": False}
            found = dvi.fit(**arguments, **options, progress=recorded(last, show))
    with report.writing(keep=CHECKPOINT):
        found.save(report.path("fit.npz"))
        trajectory, status = _trajectory(arguments["model"], arguments["data"].ordered(), found)
        report.write_arrays("trajectory.npz", trajectory)
        report.contents |= _contents(arguments, found)
        report.contents |= {"columns": columns, "trajectory": status}
        report.write_contents("fit.json")
        if file.output.plots:
            report.draw(_pictures(columns, found))
    steps = f"{report.contents['steps']} steps"
    report.tables, report.notes = _tables(found, report.contents), _notes(found)
    seconds = f"{found.seconds:.1f} s (compilation included)"
    report.summary = f"{found.status} after {steps}, {seconds}"
    if found.status != "converged":
        report.message = (
            f"the fit did not converge ({found.status} after {steps}). "
            f"{report.contents['message']}\nIts results so far have been written."
        )
    elif status != "successful":
        report.message = f"the fitted trajectory fails ({status}). The results have been written."
    return report


def _trajectory(
    model: dvi.Model, data: dvi.Observations, found: dvi.FitResult
) -> tuple[dict[str, Any], str]:
    """The fitted trajectory from the start to the last observation, and its status."""
    spec = model(found.params)
    steps = max(1, int(np.ceil((data.ts[-1] - data.t0) / spec["h"] - 1e-9)))
    save = dvi.Save(every=-(-steps // _MOST), final=True)
    solution = dvi.integrate(**spec, t0=data.t0, num_steps=steps, save=save, throw=False)
    return {n: np.asarray(getattr(solution, n)) for n in ("ts", "qs", "ps")}, solution.status


def _contents(arguments: dict[str, Any], found: dvi.FitResult) -> dict[str, Any]:
    # The numbers of the start in the order of their names: that of JAX's leaves.
    start = np.concatenate([np.ravel(x) for x in jax.tree.leaves(arguments["params"])])
    return {
        "status": found.status,
        "message": str(dvi.FIT_RESULTS[found.result]),
        "parameters": {
            name: {"value": x, "error": s, "start": a}
            for name, x, s, a in zip(found.names, found.x, found.sigma, start, strict=True)
        },
        "correlations": {"names": found.names, "matrix": found.correlations},
        "chi2": found.chi2 if found.has_errors else None,
        "reduced_chi2": found.reduced_chi2 if found.has_errors else None,
        "values": found.num_observed,
        "missing": int(np.isnan(arguments["data"].values).sum()),
        "residuals": found.statistics(),
        "steps": len(found.history["loss"]),
        **{name: getattr(found, name) for name in _AS_THEY_ARE},
    }


def _tables(found: dvi.FitResult, contents: dict[str, Any]) -> list[Table]:
    values = zip(contents["parameters"].items(), numbers_in_words(found), strict=True)
    rows = [[name, words, f"{known['start']:.6g}"] for (name, known), words in values]
    tables = [Table("Parameters, ± standard error", ["name", "value", "start"], rows)]
    if len(found.names) > 1:
        tables.append(_correlation_table(found.names, found.correlations))
    has, residuals = found.has_errors, contents["residuals"]
    rows = [
        ["values", str(found.num_observed)],
        ["values missing", str(contents["missing"])],
        ["degrees of freedom", str(found.degrees_of_freedom)],
        ["rms [units of the data]", f"{found.rms:.4g}"],
        ["variance explained [%]", f"{100 * found.explained:.4g}"],
        ["chi²", f"{found.chi2:.6g}" if has else ""],
        ["chi² of the priors", f"{found.prior_chi2:.4g}" if has and found.prior_chi2 else ""],
        ["reduced chi²", f"{found.reduced_chi2:.4g}" if has else ""],
        ["largest [standard errors]", f"{residuals['largest']:.3g}" if has else ""],
        ["correlation of neighbours", f"{residuals['lag_one']:.3f}"],
    ]
    return [*tables, Table("Residuals", ["", "value"], [row for row in rows if row[1]])]


def _correlation_table(names: list[str], matrix: np.ndarray) -> Table:
    below = [(i, j) for i in range(len(names)) for j in range(i)]
    if len(names) > _MATRIX:
        strongest = sorted(below, key=lambda ij: -np.nan_to_num(abs(matrix[ij]), nan=-1))[:10]
        rows = [[names[i], names[j], f"{matrix[i, j]:.3f}"] for i, j in strongest]
        return Table("Strongest correlations", ["of", "and", "value"], rows)
    rows = [[name, *(f"{x:.2f}" for x in matrix[i, :i])] for i, name in enumerate(names)]
    return Table("Correlations", ["", *names[:-1]], rows[1:])


def _notes(found: dvi.FitResult) -> list[str]:
    notes = [f"not determined by the data: {words}" for words in found.undetermined]
    if little := little_explained(found):
        notes.append(little[0].upper() + little[1:])
    if found.at_bounds:
        at_bounds = ", ".join(found.at_bounds)
        notes.append(f"at their bounds, where an error is not symmetric: {at_bounds}")
    if not found.has_errors:
        notes.append("Without sigma the size of the errors is that of the residuals.")
    lag = found.statistics()["lag_one"]
    if abs(lag) > max(0.2, 3 / np.sqrt(max(found.num_observed, 1))):
        notes.append(
            f"Neighbouring residuals are correlated ({lag:.2f}): the model is incomplete, and the "
            "errors are too small."
        )
    curvature = np.empty(0) if found.curvature is None else found.curvature
    finite = curvature[np.isfinite(curvature)]
    if finite.size and (finite.min() < 0.5 or finite.max() > 2):
        notes.append(
            f"Second derivatives are {finite.min():.2g} … {finite.max():.2g} of those that the "
            "errors assume: far from 1 they are not those of a quadratic minimum."
        )
    return notes


def _pictures(columns: list[str], found: dvi.FitResult) -> dict[str, Callable[[], Any]]:
    """File name → function that draws, for the pictures that this fit can have."""
    pictures: dict[str, Callable[[], Any]] = {
        "data.png": partial(plot.fit_against_data, found, names=columns),
        "residuals.png": partial(plot.fit_residuals, found, names=columns),
        "learning.png": partial(plot.learning_curve, found),
    }
    known = [n for n, s in zip(found.names, found.sigma, strict=True) if 0 < s < np.inf]
    if len(known) > 1:
        pictures["parameters.png"] = partial(plot.fit_corner, found, known[:_CORNER])
    return pictures
