"""One fit: read, fit, write."""

import json
import platform
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

import dvi_jax as dvi

from .. import plot
from ..fit.progress import shown as shown_bar
from ..fit.result import little_explained, numbers_in_words
from ._config import read_config
from ._errors import InputError
from ._fit_config import FIT_KEYS
from ._fit_setup import FitSetup, make_fit_setup
from ._report import Report, Table, plain
from ._run import reserve, writing
from ._setup import said

WRITTEN = (
    "fit.npz", "fit.json", "trajectory.npz", "checkpoint.npz",
    "data.png", "residuals.png", "parameters.png", "learning.png",
)  # fmt: skip
"""Every file that a fit may write; with `force` these are replaced and nothing else."""

CHECKPOINT = "checkpoint.npz"
_MOST = 20_000
"""Steps up to which every state of the fitted trajectory is written."""
_CORNER = 8
"""Parameters up to which pairs are drawn: the first ones."""
_MATRIX = 8
"""Parameters up to which the correlations are shown as a matrix; more: the strongest pairs."""


def fit_file(
    path: str | Path,
    out: str | Path | None = None,
    force: bool = False,
    resume: bool = False,
    progress: bool | Callable[[dvi.FitProgress], None] | None = None,
) -> Report:
    """The fit that a TOML file describes.

    - `path`: the file; its keys are in `FIT_KEYS` and in the documentation.
    - `out`: directory to write to instead of the file's ``output.dir``; either is relative to
      the working directory. It must not exist, or be empty.
    - `force`: replace what an earlier fit wrote there. `resume`: go on from the checkpoint that is
      there; begin where there is none.
    - `progress`: as for `dvi.fit`.

    Writes fit.npz (`FitResult.save`), fit.json, trajectory.npz (ts, qs, ps of the fitted
    trajectory) and pictures. A fit that does not converge is written all the same, and ``ok`` is
    False; its checkpoint stays.

    **Raises** `InputError` for input that cannot be meant; nothing is written then.
    """
    path = Path(path)
    values, raw = read_config(path, FIT_KEYS)
    folder = Path(out if out is not None else values["output.dir"] or f"results/{path.stem}")
    setup = make_fit_setup(values, path.parent)
    made = reserve(folder, "--out" if out is not None else "output.dir", force or resume)
    checkpoint = folder / CHECKPOINT
    if not resume:
        checkpoint.unlink(missing_ok=True)
    try:
        found = _fitted(setup, checkpoint, progress)
    except BaseException:
        if made and not any(folder.iterdir()):  # a checkpoint is worth keeping
            folder.rmdir()
        raise
    with writing(folder, force=True):  # its checkpoint is there
        return _write(setup, values, raw, found, folder, path)


def _fitted(setup: FitSetup, checkpoint: Path, progress: Any) -> dvi.FitResult:
    began = []
    with shown_bar(progress) as show:

        def tell(now: dvi.FitProgress) -> None:
            began[:] = [now]
            if show is not None:
                show(now)

        try:
            return dvi.fit(
                setup.model, setup.data, setup.params, **setup.options,
                checkpoint=checkpoint, progress=tell, throw=False,
            )  # fmt: skip
        except OSError:
            raise
        except Exception as error:
            if began:  # the work had begun: it is not the input
                raise
            raise InputError(
                "fit",
                f"{setup.name} cannot be fitted: {said(error, *setup.files)}",
                "functions, start, args and data that fit one another",
            ) from error


def _write(
    setup: FitSetup,
    values: dict[str, Any],
    raw: dict[str, Any],
    found: dvi.FitResult,
    folder: Path,
    path: Path,
) -> Report:
    for name in WRITTEN:  # of an earlier fit; no file of it must stay beside this one's
        if name != CHECKPOINT:
            (folder / name).unlink(missing_ok=True)
    found.save(folder / "fit.npz")
    trajectory, status = _trajectory(setup, found)
    np.savez(folder / "trajectory.npz", **trajectory)
    ok = found.status == "converged" and status == "successful"
    contents = _contents(setup, raw, found, path) | {"trajectory": status}
    text = json.dumps(plain(contents), indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "fit.json").write_text(text + "\n", encoding="utf-8")
    files = ["fit.npz", "trajectory.npz", "fit.json"]
    report = Report(ok, "" if ok else _failure(found, status), folder, files, contents)
    report.tables += _tables(found, contents)
    report.notes += _notes(found)
    if values["output.plots"]:
        # The numbers are on disk before anything is drawn: a picture that fails costs no result.
        report.files += _draw(found, folder, setup.columns)
    return report


def _trajectory(setup: FitSetup, found: dvi.FitResult) -> tuple[dict[str, Any], str]:
    """The fitted trajectory from the start to the last observation, and its status."""
    spec = setup.model(found.params)
    t0, h = setup.data.t0, spec["h"]
    assert t0 is not None
    steps = max(1, int(np.ceil((setup.data.ordered().ts[-1] - t0) / h - 1e-9)))
    every = -(-steps // _MOST)
    solution = dvi.integrate(
        **spec, t0=t0, num_steps=steps, save=dvi.Save(every=every, final=True), throw=False
    )
    return {n: np.asarray(getattr(solution, n)) for n in ("ts", "qs", "ps")}, solution.status


def _contents(
    setup: FitSetup, raw: dict[str, Any], found: dvi.FitResult, path: Path
) -> dict[str, Any]:
    start = _flat(setup.params)
    return {
        "fit": str(path),
        "config": raw,
        "versions": {n: version(n) for n in ("dvi-jax", "jax", "jaxlib", "numpy")}
        | {"python": platform.python_version()},
        "status": found.status,
        "message": str(dvi.FIT_RESULTS[found.result]),
        "parameters": {
            name: {"value": x, "error": s, "start": a}
            for name, x, s, a in zip(found.names, found.x, found.sigma, start, strict=True)
        },
        "correlations": {"names": found.names, "matrix": found.correlations},
        "chi2": found.chi2 if found.has_errors else None,
        "prior_chi2": found.prior_chi2,
        "reduced_chi2": found.reduced_chi2 if found.has_errors else None,
        "rms": found.rms,
        "explained": found.explained,
        "values": found.num_observed,
        "missing": int(np.isnan(setup.data.values).sum()),
        "degrees_of_freedom": found.degrees_of_freedom,
        "residuals": found.statistics(),
        "curvature": found.curvature,
        "undetermined": found.undetermined,
        "at_bounds": found.at_bounds,
        "steps": len(found.history["loss"]),
        "seconds": found.seconds,
        "columns": setup.columns,
    }


def _flat(params: Any) -> np.ndarray:
    """All numbers of the parameters in the order of their names: that of JAX's leaves."""
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(params)])


def _tables(found: dvi.FitResult, contents: dict[str, Any]) -> list[Table]:
    rows = [
        [name, words, f"{known['start']:.6g}"]
        for (name, known), words in zip(
            contents["parameters"].items(), numbers_in_words(found), strict=True
        )
    ]
    tables = [Table("Parameters, ± standard error", ["name", "value", "start"], rows)]
    if len(found.names) > 1:
        tables.append(_correlation_table(found))
    left = contents["residuals"]
    rows = [
        ["values", str(found.num_observed)],
        ["values missing", str(contents["missing"])],
        ["degrees of freedom", str(found.degrees_of_freedom)],
        ["rms [units of the data]", f"{found.rms:.4g}"],
        ["variance explained [%]", f"{100 * found.explained:.4g}"],
    ]
    if found.has_errors:
        rows.append(["chi²", f"{found.chi2:.6g}"])
        if found.prior_chi2:
            rows.append(["chi² of the priors", f"{found.prior_chi2:.4g}"])
        rows.append(["reduced chi²", f"{found.reduced_chi2:.4g}"])
        rows.append(["largest [standard errors]", f"{left['largest']:.3g}"])
    rows.append(["correlation of neighbours", f"{left['lag_one']:.3f}"])
    return [*tables, Table("What is left over", ["", "value"], rows)]


def _correlation_table(found: dvi.FitResult) -> Table:
    matrix, names = found.correlations, found.names
    if len(names) <= _MATRIX:
        rows = [
            [name, *(f"{matrix[i, j]:.2f}" if j < i else "" for j in range(len(names) - 1))]
            for i, name in enumerate(names)
            if i
        ]
        return Table("Correlations", ["", *names[:-1]], rows)
    pairs = [(i, j) for i in range(len(names)) for j in range(i)]
    strongest = sorted(pairs, key=lambda ij: -np.nan_to_num(abs(matrix[ij]), nan=-1))[:10]
    rows = [[names[i], names[j], f"{matrix[i, j]:.3f}"] for i, j in strongest]
    return Table("Strongest correlations", ["of", "and", "value"], rows)


def _notes(found: dvi.FitResult) -> list[str]:
    notes = [f"not determined by the data: {words}" for words in found.undetermined]
    if little := little_explained(found):
        notes.append(little[0].upper() + little[1:])
    if found.at_bounds:
        notes.append(f"at their bounds, where an error is not symmetric: "
                     f"{', '.join(found.at_bounds)}")  # fmt: skip
    if not found.has_errors:
        notes.append("Without sigma the size of the errors is that of the residuals.")
    lag = found.statistics()["lag_one"]
    if abs(lag) > max(0.2, 3 / np.sqrt(max(found.num_observed, 1))):
        notes.append(
            f"Neighbouring residuals are correlated ({lag:.2f}): the model lacks something, and "
            "the errors are too small."
        )
    if found.curvature is not None:
        off = found.curvature[np.isfinite(found.curvature)]
        if off.size and (off.min() < 0.5 or off.max() > 2):
            notes.append(
                f"Second derivatives are {off.min():.2g} … {off.max():.2g} of those that the "
                "errors assume: far from 1 they are not those of a quadratic minimum."
            )
    return notes


def _failure(found: dvi.FitResult, status: str) -> str:
    if found.status != "converged":
        return (
            f"the fit did not converge ({found.status} after {len(found.history['loss'])} steps). "
            f"{dvi.FIT_RESULTS[found.result]}\nWhat there is has been written."
        )
    return f"the fitted trajectory fails ({status}). What there is has been written."


def _draw(found: dvi.FitResult, folder: Path, columns: Sequence[str]) -> list[str]:
    """The pictures that this fit can have, by the names of their files."""
    pictures: dict[str, Callable[[Any], Any]] = {
        "data.png": lambda fit: plot.fit_against_data(fit, names=columns),
        "residuals.png": lambda fit: plot.fit_residuals(fit, names=columns),
        "learning.png": plot.learning_curve,
    }
    known = [n for n, s in zip(found.names, found.sigma, strict=True) if 0 < s < np.inf]
    if len(known) > 1:
        pictures["parameters.png"] = lambda fit: plot.fit_corner(fit, known[:_CORNER])
    files = []
    with plot.style():
        for name, draw in pictures.items():
            plot.save(draw(found), folder / name)
            files.append(name)
    return files
