"""The arguments of `dvi.fit` that a TOML file describes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import dvi_jax as dvi

from .._errors import InputError, one_of, shown
from .columns import check_times, column, read_columns
from .expressions import parse_method
from .loader import Loader
from .schema import Data, FitFile
from .system import Source, find_source

_NAMED = ("positions", "momenta", "state")


@dataclass(frozen=True)
class FitProblem:
    """The arguments of `dvi.fit`, the names of the columns of the data, and the system's source."""

    model: dvi.Model
    data: dvi.Observations
    params: dict[str, Any]
    options: dict[str, Any]
    columns: list[str]
    source: Source


def fit_problem(file: FitFile, folder: Path) -> FitProblem:
    """The arguments of `dvi.fit` from a file whose Python files and data are in `folder`.

    **Raises** `InputError`.
    """
    source = find_source(file, folder)
    args, h, (q0, p0) = source.args, float(source.h), source.state
    source.check_start(q0, p0, args)
    params = _parameters(file, q0, p0, args)
    data, columns = _observations(file.data, source.loader, np.shape(q0), file.t0)
    _check_direction(data, h)
    _check_enough(data, params, file.priors)
    options, segments = file.options, file.options.segments
    model = dvi.Model(
        source.system, h=h, q0=q0, p0=p0, epsilon=file.epsilon, args=args,
        method=parse_method(file.method),
    )  # fmt: skip
    arguments = {
        "bounds": _nested(file.bounds, "bounds", params, dvi.Bounds),
        "priors": _nested(file.priors, "priors", params, dvi.Prior),
        "loss": getattr(dvi, options.loss)(),
        "horizons": None if options.horizons == "none" else options.horizons,
        "max_steps": options.max_steps,
        "tolerance": options.tolerance,
        "check_curvature": options.curvature,
        "shooting": dvi.MultipleShooting(segments) if segments else dvi.SingleShooting(),
    }
    return FitProblem(model, data, params, arguments, columns, source)


# Parameters


def _parameters(file: FitFile, q0: Any, p0: Any, args: Any) -> dict[str, Any]:
    """The parameters; the values of the file, or of the system, are the initial guess."""
    table = args if isinstance(args, dict) else {}
    known = {"epsilon": file.epsilon, "q0": q0, "p0": p0}
    known |= {f"args.{name}": value for name, value in table.items() if _is_numbers(value)}
    if file.parameters is None:
        allowed = f"an array out of {one_of(known)}"
        raise InputError("parameters", "the key is missing", allowed)
    params: dict[str, Any] = {}
    for name in file.parameters:
        if name not in known:
            raise InputError("parameters", shown(name), one_of(known, name))
        if file.parameters.count(name) > 1:
            raise InputError("parameters", f"{name!r} is listed twice", "each name once")
        _put(params, name, np.asarray(known[name], float))
    return params


def _put(tree: dict[str, Any], name: str, value: Any) -> None:
    """Add the value of ``q0`` or of ``args.NAME``."""
    table, _, inner = name.partition(".")
    if inner:
        tree.setdefault(table, {})[inner] = value
    else:
        tree[name] = value


def _is_numbers(value: Any) -> bool:
    if isinstance(value, bool | dict | str) or value is None:
        return False
    return np.issubdtype(np.asarray(value).dtype, np.number)


def _nested(pairs: dict[str, Any], key: str, params: dict[str, Any], kind: Any) -> Any:
    """The pairs of a table in the structure of the parameters."""
    names = [name for name in params if name != "args"]
    names += [f"args.{name}" for name in params.get("args", {})]
    found: dict[str, Any] = {}
    for name, pair in pairs.items():
        if name not in names:
            seen = "it is not among the parameters"
            raise InputError(f"{key}.{name}", seen, one_of(names, name))
        made = kind(*(np.asarray(x, float) if isinstance(x, list) else x for x in pair))
        _put(found, name, made)
    return found or None


def _check_enough(data: dvi.Observations, params: dict[str, Any], priors: dict[str, Any]) -> None:
    """Reject fewer values than parameters, unless there are priors."""
    seen = int(np.isfinite(data.values).sum())
    wanted = sum(np.size(x) for x in jax.tree.leaves(params))
    if seen < wanted and not priors:
        allowed = "at least as many values as parameters, or priors"
        raise InputError("data.file", f"{seen} values for {wanted} parameters", allowed)


# Observations


def _observations(
    given: Data, loader: Loader, shape: tuple[int, ...], t0: float | None
) -> tuple[dvi.Observations, list[str]]:
    """The data, and the names of their columns."""
    if given.file is None:
        raise InputError("data.file", "the key is missing", "the path of a CSV or npz file")
    columns = read_columns(loader.folder / given.file)
    ts = column(columns, "data.time", given.time)
    check_times(ts, "data.time", given.time)
    sigma, used = _sigma(given.sigma, columns)
    names = given.columns or [n for n in columns if n not in (given.time, *used)]
    if not names:
        raise InputError("data.columns", "no column remains", f"out of {one_of(columns)}")
    observed = _joined(columns, names, len(ts))
    observe = _observe(given.observe, loader)
    if observe in _NAMED:
        observed = _reshaped(observed, names, observe, shape)
    if sigma is not None and np.ndim(sigma):
        sigma = _spread(sigma, observed, len(names))
    if len(ts) == 1 and t0 is None:
        raise InputError("data.file", "one observation", "two times at least, or t0 before it")
    if np.isnan(observed).all():
        raise InputError("data.columns", "no value in any row", "columns with numbers")
    try:
        return dvi.Observations(ts, observed, observe, sigma=sigma, t0=t0), names
    except (TypeError, ValueError) as error:
        raise InputError("data", str(error), "observations in the order of time") from None


def _observe(text: str, loader: Loader) -> Any:
    """The name of what was observed, or a function of the user's file."""
    if ":" not in text:
        if text not in _NAMED:
            allowed = f'{one_of(_NAMED, text)}; or "file.py:name"'
            raise InputError("data.observe", shown(text), allowed)
        return text
    function = loader.load("data.observe", text)
    if not callable(function):
        raise InputError("data.observe", shown(text), "a function (t, q, p, args)")
    return function


def _reshaped(
    observed: np.ndarray, names: list[str], observe: str, shape: tuple[int, ...]
) -> np.ndarray:
    wanted = (2 * int(np.prod(shape)),) if observe == "state" else shape
    if observed[0].size != np.prod(wanted, dtype=int):
        seen = f"{observed[0].size} numbers for each time ({', '.join(names)})"
        allowed = f"{int(np.prod(wanted))}: the {observe} of a state whose q has shape {shape}"
        raise InputError("data.columns", seen, allowed)
    return observed.reshape(len(observed), *wanted)


def _check_direction(data: dvi.Observations, h: float) -> None:
    """Reject a step that leads from t0 away from the observations."""
    if (data.ordered().ts[-1] - data.t0) * h < 0:
        seen = f"{h:g}, which leads from t0 = {data.t0:g} away from the observations"
        raise InputError("h", seen, f"{-h:g}, or a t0 on the other side of the observations")


def _joined(columns: dict[str, np.ndarray], names: list[str], rows: int) -> np.ndarray:
    """The columns next to one another; one of an npz alone has the shape of q."""
    parts = [column(columns, "data.columns", name) for name in names]
    for part, name in zip(parts, names, strict=True):
        if len(part) != rows:
            allowed = f"as many as there are times, {rows}"
            raise InputError("data.columns", f"{name} has {len(part)} rows", allowed)
        if np.isinf(part).any():
            raise InputError("data.columns", f"{name} holds an infinite value", "NaN if missing")
    if len(parts) == 1 and parts[0].ndim > 1:
        return parts[0]
    return np.concatenate([part.reshape(rows, -1) for part in parts], axis=1)


def _sigma(given: Any, columns: dict[str, np.ndarray]) -> tuple[Any, list[str]]:
    """Standard errors, and the columns that have them."""
    if not isinstance(given, list):
        return given, []
    found = [column(columns, "data.sigma", name) for name in given]
    for name, part in zip(given, found, strict=True):
        bad = np.flatnonzero(~(part > 0) | ~np.isfinite(part))
        if bad.size:
            seen = f"row {bad[0] + 1} of {name} is {part.ravel()[bad[0]]}"
            raise InputError("data.sigma", seen, "positive standard errors in every row")
    return np.stack(found, axis=-1), given


def _spread(sigma: np.ndarray, observed: np.ndarray, names: int) -> np.ndarray:
    """Standard errors of one column for all, or of one for each, in the shape of the data."""
    flat = observed.reshape(len(observed), -1)
    if sigma.shape[-1] not in (1, flat.shape[1]):
        allowed = f"one for all, or {names}, one for each column"
        raise InputError("data.sigma", f"{sigma.shape[-1]} of them", allowed)
    return np.broadcast_to(sigma, flat.shape).reshape(observed.shape)
