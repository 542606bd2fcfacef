"""One fit: read, fit, write."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.fit.result import contradiction, numbers_in_words, remarks, verdict
from dvi_jax.fit.run import progress_display as shown_bar

from .._errors import InputError, in_toml, one_of, require, require_name, user_path
from .._show import TextTable
from .columns import column, read_columns
from .loader import Loader
from .output import Report, open_report, recorder
from .schema import Data, FitFile
from .system import Source, find_source

_QUANTITIES = ("positions", "momenta", "state")
CHECKPOINT = "checkpoint.npz"
_IMAGES = ("data.png", "residuals.png", "parameters.png", "learning.png")
RESULT_FILES = ("fit.npz", "fit.json", "trajectory.npz", CHECKPOINT, *_IMAGES)
"""Every file that a fit may write; with `force` these are replaced and nothing else."""

_MAX_STATES = 20_000
"""Steps up to which every state of the fitted trajectory is written."""
_LARGEST = 10.0
"""Reduced chi² above which a fit whose residuals contradict sigma counts as failed."""
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
      there; begin a new fit without one.
    - `progress`: as for `dvi.fit`.

    Writes fit.npz (`FitResult.save`), fit.json, trajectory.npz (ts, qs, ps of the fitted
    trajectory) and pictures. A fit that does not converge is written as well, and ``ok`` is
    False; its checkpoint remains.

    **Raises** `InputError` for bad input; nothing is written then.
    """
    path = user_path("CONFIG", path)
    file, report = open_report("fit", path, out, RESULT_FILES, force or resume)
    source = find_source(file, path.parent)
    arguments, columns = fit_problem(file, source)
    checkpoint = report.folder / CHECKPOINT
    last: list[dvi.FitProgress] = []
    rule = "functions, start, args and data that fit one another"
    with report.reservation():  # a checkpoint remains after an error
        if not resume:
            checkpoint.unlink(missing_ok=True)
        with shown_bar(progress) as show, source.at_work("fit", "fitted", rule, last):
            options = {"checkpoint": checkpoint, "throw": False}
            result = dvi.fit(**arguments, **options, progress=recorder(last, show))
    with report.writing(keep=CHECKPOINT):
        result.save(report.path("fit.npz"))
        data = arguments["data"].in_time_order()
        trajectory, status = _trajectory(arguments["model"], data, result)
        report.write_arrays("trajectory.npz", trajectory)
        report.contents |= _contents(arguments, result)
        report.contents |= {"columns": columns, "trajectory": status}
        report.write_contents("fit.json")
        if file.output.plots:
            report.draw(fit_pictures(columns, result))
    steps = f"{report.contents['steps']} steps"
    report.tables, report.notes = fit_tables(result, report.contents), fit_notes(result)
    seconds = f"{result.seconds:.1f} s (compilation included)"
    report.summary = f"{verdict(result)} after {steps}, {seconds}"
    if result.status != "converged":
        report.message = (
            f"the fit did not converge ({result.status} after {steps}). "
            f"{report.contents['message']}\nIts results so far have been written."
        )
    elif status != "successful":
        report.message = f"the fitted trajectory fails ({status}). The results have been written."
    elif result.reduced_chi2 > _LARGEST and contradiction(result):
        report.message = (
            "the fitted model does not describe the data: reduced chi² is "
            f"{result.reduced_chi2:.4g}. The results have been written."
        )
    return report


# The arguments of `dvi.fit`


def fit_problem(file: FitFile, source: Source) -> tuple[dict[str, Any], list[str]]:
    """The arguments of `dvi.fit`, and the names of the columns of the data.

    **Raises** `InputError`.
    """
    q0, p0, args = source.array("q0"), source.array("p0"), source.args
    source.check_start(q0, p0, args)
    is_fitted = file.epsilon is None and "epsilon" in file.parameters
    start = {"epsilon": 0.0 if is_fitted else source.epsilon, "q0": q0, "p0": p0}
    params = _parameters(file.parameters, start, args)
    h, method, options = float(source.h), source.method(file.method), file.options
    data, columns = _observations(file.data, source.loader, np.shape(q0), file.t0)
    segments = options.segments
    arguments = {
        "model": dvi.Model(source.system, h=h, args=args, method=method, **start),
        "data": data,
        "params": params,
        "bounds": _pairs(file, "bounds", dvi.Bounds),
        "priors": _pairs(file, "priors", dvi.Prior),
        "loss": getattr(dvi, options.loss)(),
        "horizons": None if options.horizons == "none" else options.horizons,
        "max_steps": options.max_steps,
        "tolerance": options.tolerance,
        "check_curvature": options.curvature,
        "shooting": dvi.MultipleShooting(segments) if segments else dvi.SingleShooting(),
    }
    return arguments, columns


def _parameters(names: list[str], start: dict[str, Any], args: Any) -> dict[str, Any]:
    """The parameters; the values of the file, or of the system, are the initial guess."""
    table = args if isinstance(args, dict) else {}
    values = start | {
        f"args.{name}": value
        for name, value in table.items()
        if np.issubdtype(np.asarray(value).dtype, np.number)
    }
    for name in names:
        require_name("parameters", name, values, defect=f"it contains {name!r}")
        require(names.count(name) == 1, "parameters", f"{name!r} is listed twice", "each name once")
    return _tree({name: np.asarray(values[name], float) for name in names})


def _tree(flat: dict[str, Any]) -> dict[str, Any]:
    """Values by ``q0`` and ``args.NAME`` as a table with a table of args in it."""
    args = {name.removeprefix("args."): x for name, x in flat.items() if "." in name}
    tree = {name: x for name, x in flat.items() if "." not in name}
    return tree | ({"args": args} if args else {})


def _pairs(file: FitFile, key: str, kind: Any) -> dict[str, Any] | None:
    """The pairs of a table in the structure of the parameters."""
    pairs = {}
    for name, pair in getattr(file, key).items():
        defect = "it is not among the parameters"
        require_name(f"{key}.{name}", name, file.parameters, defect=defect)
        pairs[name] = kind(*(np.asarray(x, float) if isinstance(x, list) else x for x in pair))
    return _tree(pairs) or None


def _observations(
    table: Data, loader: Loader, shape: tuple[int, ...], t0: float | None
) -> tuple[dvi.Observations, list[str]]:
    """The data, and the names of their columns."""
    columns = read_columns(loader.folder / user_path("data.file", table.file))
    ts = column(columns, "data.time", table.time)
    sigma, sigma_columns = table.sigma, []
    if isinstance(sigma, list):  # columns that have the standard errors
        sigma_columns = sigma
        sigma = np.stack([column(columns, "data.sigma", name) for name in sigma_columns], axis=-1)
    names = table.columns or [n for n in columns if n not in (table.time, *sigma_columns)]
    require(names, "data.columns", "no column is left", f"one or more of {one_of(columns)}")
    observed = _stack(columns, names, len(ts))
    observe = _observe(table.observe, loader)
    if observe in _QUANTITIES:
        value_shape = (2 * int(np.prod(shape)),) if observe == "state" else shape
        size, required_size = observed[0].size, int(np.prod(value_shape))
        defect = f"the columns {', '.join(names)} have {size} numbers for each time"
        rule = f"{required_size} for each time: the {observe} of a state whose q has shape {shape}"
        require(size == required_size, "data.columns", defect, rule)
        observed = observed.reshape(len(observed), *value_shape)
    if sigma is not None and np.ndim(sigma):  # one for all columns, or one for each
        flat = observed.reshape(len(observed), -1)
        fits = sigma.shape[-1] in (1, flat.shape[1])
        rule = f"one column for all, or {len(names)}, one for each column of values"
        require(fits, "data.sigma", f"it has {sigma.shape[-1]} columns", rule)
        sigma = np.broadcast_to(sigma, flat.shape).reshape(observed.shape)
    period = table.period
    if isinstance(period, list):
        size, required_size = len(period), observed[0].size
        defect, rule = f"it has {size} numbers", f"one number, or {required_size}, one a column"
        require(size == required_size, "data.period", defect, rule)
        period = np.reshape(period, observed.shape[1:])
    fits, rule = len(ts) > 1 or t0 is not None, "at least two, or an earlier time t0"
    require(fits, "data.file", "there is only one observation", rule)
    try:
        options = {"sigma": sigma, "t0": t0, "period": period}
        return dvi.Observations(ts, observed, observe, **options), names
    except (TypeError, ValueError) as error:
        key = "data.time" if str(error).startswith("ts") else "data"
        rule = (
            f"finite times in order in the column {table.time}, values that fit observe, sigma > 0"
        )
        raise InputError(key, in_toml(error), rule) from None


def _observe(text: str, loader: Loader) -> Any:
    """The name of what was observed, or a function of the user's file."""
    if ":" not in text:
        require_name("data.observe", text, _QUANTITIES, '{}; or "file.py:name"')
        return text
    function = loader.load("data.observe", text)
    defect = f"{text!r} is not a function"
    require(callable(function), "data.observe", defect, "a function (t, q, p, args)")
    return function


def _stack(columns: dict[str, np.ndarray], names: list[str], rows: int) -> np.ndarray:
    """The columns next to one another; one of an npz alone has the shape of q."""
    parts = [column(columns, "data.columns", name) for name in names]
    for part, name in zip(parts, names, strict=True):
        rule = f"as many rows as there are times, {rows}"
        require(len(part) == rows, "data.columns", f"{name} has {len(part)} rows", rule)
    if len(parts) == 1 and parts[0].ndim > 1:
        return parts[0]
    return np.concatenate([part.reshape(rows, -1) for part in parts], axis=1)


# Results


def _trajectory(
    model: dvi.Model, data: dvi.Observations, result: dvi.FitResult
) -> tuple[dict[str, Any], str]:
    """The fitted trajectory from the start to the last observation, and its status."""
    spec = model(result.params)
    steps = max(1, int(np.ceil((data.ts[-1] - data.t0) / spec["h"] - 1e-9)))
    save = dvi.Save(every=-(-steps // _MAX_STATES), final=True)
    solution = dvi.integrate(**spec, t0=data.t0, num_steps=steps, save=save, throw=False)
    return {n: np.asarray(getattr(solution, n)) for n in ("ts", "qs", "ps")}, solution.status


def _contents(arguments: dict[str, Any], result: dvi.FitResult) -> dict[str, Any]:
    # The numbers of the start in the order of their names: that of JAX's leaves.
    start = np.concatenate([np.ravel(x) for x in jax.tree.leaves(arguments["params"])])
    return {
        "status": result.status,
        "message": str(dvi.FIT_RESULTS[result.result]),
        "remarks": [in_toml(words) for words in remarks(result)],
        "parameters": {
            name: {"value": x, "error": s, "start": a}
            for name, x, s, a in zip(result.names, result.x, result.sigma, start, strict=True)
        },
        "correlations": {"names": result.names, "matrix": result.correlations},
        "chi2": result.chi2 if result.has_errors else None,
        "reduced_chi2": result.reduced_chi2 if result.has_errors else None,
        "values": result.num_observed,
        "missing": int(np.isnan(arguments["data"].values).sum()),
        "residuals": result.statistics(),
        "steps": len(result.history["loss"]),
        **{name: getattr(result, name) for name in _AS_THEY_ARE},
    }


def fit_tables(result: dvi.FitResult, contents: dict[str, Any]) -> list[TextTable]:
    """Parameters, correlations and residuals; `contents`: those of fit.json."""
    values = zip(contents["parameters"].items(), numbers_in_words(result), strict=True)
    rows = [[name, words, f"{p['start']:.6g}"] for (name, p), words in values]
    tables = [TextTable("Parameters, ± standard error", ["name", "value", "start"], rows)]
    if len(result.names) > 1:
        tables.append(_correlation_table(result.names, result.correlations))
    has_errors, prior, residuals = result.has_errors, result.prior_chi2, contents["residuals"]
    rows = [
        ["values", str(result.num_observed)],
        ["values missing", str(contents["missing"])],
        ["degrees of freedom", str(result.degrees_of_freedom)],
        ["rms [units of the data]", f"{result.rms:.4g}"],
        ["variance explained [%]", f"{100 * result.explained:.4g}"],
        ["chi²", f"{result.chi2:.6g}" if has_errors else ""],
        ["chi² of the priors", f"{prior:.4g}" if has_errors and prior else ""],
        ["reduced chi²", f"{result.reduced_chi2:.4g}" if has_errors else ""],
        ["largest [standard errors]", f"{residuals['largest']:.3g}" if has_errors else ""],
        ["correlation of neighbours", f"{residuals['lag_one']:.3f}"],
    ]
    return [*tables, TextTable("Residuals", ["", "value"], [row for row in rows if row[1]])]


def _correlation_table(names: list[str], matrix: np.ndarray) -> TextTable:
    pairs = [(i, j) for i in range(len(names)) for j in range(i)]
    if len(names) > _MATRIX:
        strongest = sorted(pairs, key=lambda ij: -np.nan_to_num(abs(matrix[ij]), nan=-1))[:10]
        rows = [[names[i], names[j], f"{matrix[i, j]:.3f}"] for i, j in strongest]
        return TextTable("Strongest correlations", ["of", "and", "value"], rows)
    rows = [[name, *(f"{x:z.2f}" for x in matrix[i, :i])] for i, name in enumerate(names)]
    return TextTable("Correlations", ["", *names[:-1]], rows[1:])


def fit_notes(result: dvi.FitResult) -> list[str]:
    """What a reader must know before using the numbers."""
    notes = [f"not determined by the data: {words}" for words in result.undetermined]
    notes += [words[0].upper() + words[1:] for words in map(in_toml, remarks(result))]
    if result.at_bounds:
        at_bounds = ", ".join(result.at_bounds)
        notes.append(f"at their bounds, where an error is not symmetric: {at_bounds}")
    if not result.has_errors:
        notes.append("Without sigma the size of the errors is that of the residuals.")
    lag = result.statistics()["lag_one"]
    if abs(lag) > max(0.2, 3 / np.sqrt(max(result.num_observed, 1))):
        notes.append(
            f"Neighbouring residuals are correlated ({lag:.2f}): the model is incomplete, and the "
            "errors are too small."
        )
    curvature = np.empty(0) if result.curvature is None else result.curvature
    finite = curvature[np.isfinite(curvature)]
    if finite.size and (finite.min() < 0.5 or finite.max() > 2):
        notes.append(
            f"Second derivatives are {finite.min():.2g} … {finite.max():.2g} of those that the "
            "errors assume: far from 1 they are not those of a quadratic minimum."
        )
    return notes


def fit_pictures(columns: list[str], result: dvi.FitResult) -> dict[str, Callable[[], Any]]:
    """File name → function that draws, for the pictures that this fit can have."""
    pictures: dict[str, Callable[[], Any]] = {
        "data.png": partial(plot.fit_against_data, result, names=columns),
        "residuals.png": partial(plot.fit_residuals, result, names=columns),
        "learning.png": partial(plot.learning_curve, result),
    }
    finite = [n for n, s in zip(result.names, result.sigma, strict=True) if 0 < s < np.inf]
    if len(finite) > 1:
        pictures["parameters.png"] = partial(plot.fit_corner, result, finite[:_CORNER])
    return pictures
