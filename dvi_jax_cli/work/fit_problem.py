"""The arguments of `dvi.fit` that a TOML file describes."""

from typing import Any

import numpy as np

import dvi_jax as dvi

from .._errors import InputError, known, one_of, require, shown
from .columns import column, read_columns
from .expressions import parse_method
from .loader import Loader
from .schema import Data, FitFile
from .system import Source

_NAMED = ("positions", "momenta", "state")


def fit_problem(file: FitFile, source: Source) -> tuple[dict[str, Any], list[str]]:
    """The arguments of `dvi.fit`, and the names of the columns of the data.

    **Raises** `InputError`.
    """
    q0, p0, args = source.array("q0"), source.array("p0"), source.args
    source.check_start(q0, p0, args)
    start = {"epsilon": file.epsilon, "q0": q0, "p0": p0}
    params = _parameters(file.parameters, start, args)
    h, method, options = float(source.h), parse_method(file.method), file.options
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


# Parameters


def _parameters(names: list[str], start: dict[str, Any], args: Any) -> dict[str, Any]:
    """The parameters; the values of the file, or of the system, are the initial guess."""
    table = args if isinstance(args, dict) else {}
    values = start | {
        f"args.{name}": value
        for name, value in table.items()
        if np.issubdtype(np.asarray(value).dtype, np.number)
    }
    for name in names:
        known("parameters", name, values)
        require(names.count(name) == 1, "parameters", f"{name!r} is listed twice", "each name once")
    return _tree({name: np.asarray(values[name], float) for name in names})


def _tree(flat: dict[str, Any]) -> dict[str, Any]:
    """Values by ``q0`` and ``args.NAME`` as a table with a table of args in it."""
    args = {name.removeprefix("args."): x for name, x in flat.items() if "." in name}
    tree = {name: x for name, x in flat.items() if "." not in name}
    return tree | ({"args": args} if args else {})


def _pairs(file: FitFile, key: str, kind: Any) -> dict[str, Any] | None:
    """The pairs of a table in the structure of the parameters."""
    made = {}
    for name, pair in getattr(file, key).items():
        seen = "it is not among the parameters"
        known(f"{key}.{name}", name, file.parameters, seen=seen)
        made[name] = kind(*(np.asarray(x, float) if isinstance(x, list) else x for x in pair))
    return _tree(made) or None


# Observations


def _observations(
    given: Data, loader: Loader, shape: tuple[int, ...], t0: float | None
) -> tuple[dvi.Observations, list[str]]:
    """The data, and the names of their columns."""
    columns = read_columns(loader.folder / given.file)
    ts = column(columns, "data.time", given.time)
    sigma, used = given.sigma, []
    if isinstance(sigma, list):  # columns that have the standard errors
        used = sigma
        sigma = np.stack([column(columns, "data.sigma", name) for name in used], axis=-1)
    names = given.columns or [n for n in columns if n not in (given.time, *used)]
    require(names, "data.columns", "no column remains", f"out of {one_of(columns)}")
    observed = _joined(columns, names, len(ts))
    observe = _observe(given.observe, loader)
    if observe in _NAMED:
        wanted = (2 * int(np.prod(shape)),) if observe == "state" else shape
        size, needed = observed[0].size, int(np.prod(wanted))
        seen = f"{size} numbers for each time ({', '.join(names)})"
        allowed = f"{needed}: the {observe} of a state whose q has shape {shape}"
        require(size == needed, "data.columns", seen, allowed)
        observed = observed.reshape(len(observed), *wanted)
    if sigma is not None and np.ndim(sigma):  # one for all columns, or one for each
        flat = observed.reshape(len(observed), -1)
        fits = sigma.shape[-1] in (1, flat.shape[1])
        allowed = f"one for all, or {len(names)}, one for each column"
        require(fits, "data.sigma", f"{sigma.shape[-1]} of them", allowed)
        sigma = np.broadcast_to(sigma, flat.shape).reshape(observed.shape)
    fits, allowed = len(ts) > 1 or t0 is not None, "two times at least, or t0 before it"
    require(fits, "data.file", "one observation", allowed)
    try:
        return dvi.Observations(ts, observed, observe, sigma=sigma, t0=t0), names
    except (TypeError, ValueError) as error:
        key = "data.time" if str(error).startswith("ts") else "data"
        allowed = f"finite times in order in the column {given.time}, values that fit observe, "
        allowed += "positive standard errors"
        raise InputError(key, str(error), allowed) from None


def _observe(text: str, loader: Loader) -> Any:
    """The name of what was observed, or a function of the user's file."""
    if ":" not in text:
        known("data.observe", text, _NAMED, '{}; or "file.py:name"')
        return text
    function = loader.load("data.observe", text)
    require(callable(function), "data.observe", shown(text), "a function (t, q, p, args)")
    return function


def _joined(columns: dict[str, np.ndarray], names: list[str], rows: int) -> np.ndarray:
    """The columns next to one another; one of an npz alone has the shape of q."""
    parts = [column(columns, "data.columns", name) for name in names]
    for part, name in zip(parts, names, strict=True):
        allowed = f"as many as there are times, {rows}"
        require(len(part) == rows, "data.columns", f"{name} has {len(part)} rows", allowed)
    if len(parts) == 1 and parts[0].ndim > 1:
        return parts[0]
    return np.concatenate([part.reshape(rows, -1) for part in parts], axis=1)
