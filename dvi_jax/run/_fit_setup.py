"""From the values of a fit file to what `fit` takes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import dvi_jax as dvi

from ._data import check_times, column, read_columns
from ._errors import InputError, one_of, shown
from ._setup import (
    Loader,
    arguments_of,
    check_start,
    find_problem,
    lattice_of,
    parse_method,
    state_of,
)

_NAMED = ("positions", "momenta", "state")


@dataclass(frozen=True)
class FitSetup:
    """What `dvi.fit` gets; `start` is params as a table of the report names them."""

    name: str
    model: dvi.Model
    data: dvi.Observations
    params: dict[str, Any]
    options: dict[str, Any]
    source: str
    columns: list[str]
    units: dict[str, str]
    files: tuple[Path, ...] = ()


def make_fit_setup(values: dict[str, Any], folder: Path) -> FitSetup:
    """What a fit file means; files that it names are looked for from `folder`.

    **Raises** `InputError`.
    """
    loader = Loader(folder)
    problem, system, _ = find_problem(values, loader)
    args = arguments_of(values["args"], problem)
    known = dict(values, lattice="uniform", steps=1)
    _, h, _ = lattice_of(known, problem)
    q0, p0 = (state_of(values, name, getattr(problem, name, None)) for name in ("q0", "p0"))
    check_start(problem, q0, p0, args)
    params = _parameters(values["parameters"], values["epsilon"], q0, p0, args)
    data, columns = _observations(values, loader, np.shape(q0), float(h))
    _check_enough(data, params, values["priors"])
    segments = values["options.segments"]
    options = {
        "bounds": _nested(values["bounds"], "bounds", params, dvi.Bounds),
        "priors": _nested(values["priors"], "priors", params, dvi.Prior),
        "loss": getattr(dvi, values["options.loss"])(),
        "horizons": values["options.horizons"],
        "max_steps": values["options.max_steps"],
        "tolerance": values["options.tolerance"],
        "check_curvature": values["options.curvature"],
        "shooting": dvi.MultipleShooting(segments) if segments else dvi.SingleShooting(),
    }
    model = dvi.Model(
        system, h=float(h), q0=q0, p0=p0, epsilon=values["epsilon"], args=args,
        method=parse_method(values["method"]),
    )  # fmt: skip
    name = problem.name if problem is not None else values["system"]
    units = dict(problem.units) if problem is not None else {}
    return FitSetup(name, model, data, params, options, values["data.file"], columns, units,
                    tuple(loader.modules))  # fmt: skip


# What is fitted


def _parameters(names: Any, epsilon: float, q0: Any, p0: Any, args: Any) -> dict[str, Any]:
    """The parameters with the values that stand in the file, or are the system's, as a start."""
    table = args if isinstance(args, dict) else {}
    fittable = {n: v for n, v in table.items() if _is_numbers(v)}
    known = {"epsilon": epsilon, "q0": q0, "p0": p0}
    known |= {f"args.{name}": value for name, value in fittable.items()}
    if names is None:
        raise InputError("parameters", "the key is missing", f"an array out of {one_of(known)}")
    params: dict[str, Any] = {}
    for name in names:
        if name not in known:
            raise InputError("parameters", shown(name), one_of(known, name))
        if names.count(name) > 1:
            raise InputError("parameters", f"{name!r} stands there twice", "each name once")
        value = np.asarray(known[name], float)
        if name.startswith("args."):
            params.setdefault("args", {})[name[5:]] = value
        else:
            params[name] = value
    return params


def _is_numbers(value: Any) -> bool:
    if isinstance(value, bool | dict | str) or value is None:
        return False
    return np.issubdtype(np.asarray(value).dtype, np.number)


def _nested(pairs: dict[str, Any], key: str, params: dict[str, Any], kind: Any) -> Any:
    """The pairs of a table in the shape of the parameters."""
    names = [name for name in params if name != "args"]
    names += [f"args.{name}" for name in params.get("args", {})]
    found: dict[str, Any] = {}
    for name, (a, b) in pairs.items():
        if name not in names:
            raise InputError(f"{key}.{name}", "it is not among the parameters", one_of(names, name))
        made = kind(*(np.asarray(x, float) if isinstance(x, list) else x for x in (a, b)))
        if name.startswith("args."):
            found.setdefault("args", {})[name[5:]] = made
        else:
            found[name] = made
    return found or None


def _check_enough(data: dvi.Observations, params: dict[str, Any], priors: dict[str, Any]) -> None:
    """Refuse fewer values than there are parameters, unless something is known beforehand."""
    seen, wanted = int(np.isfinite(data.values).sum()), sum(np.size(x) for x in _leaves(params))
    if seen < wanted and not priors:
        raise InputError(
            "data.file", f"{seen} values for {wanted} parameters",
            "at least as many values as parameters, or priors",
        )  # fmt: skip


def _leaves(params: Any) -> list[Any]:
    if not isinstance(params, dict):
        return [params]
    return [leaf for value in params.values() for leaf in _leaves(value)]


# What was observed


def _observations(
    values: dict[str, Any], loader: Loader, shape: tuple[int, ...], h: float
) -> tuple[dvi.Observations, list[str]]:
    """The data, and the names of their columns."""
    if values["data.file"] is None:
        raise InputError("data.file", "the key is missing", "the path of a CSV or npz file")
    path = loader.folder / values["data.file"]
    columns = read_columns(path)
    ts = column(columns, "data.time", values["data.time"])
    check_times(ts, "data.time", values["data.time"])
    sigma, used = _errors(values, columns)
    names = values["data.columns"]
    if names is None:
        names = [n for n in columns if n not in (values["data.time"], *used)]
    if not names:
        raise InputError("data.columns", "no column is left", f"out of {one_of(columns)}")
    parts = [column(columns, "data.columns", name) for name in names]
    observed = _joined(parts, names, len(ts))
    observe = values["data.observe"]
    if observe in _NAMED:
        wanted = (2 * int(np.prod(shape)),) if observe == "state" else shape
        if observed[0].size != np.prod(wanted, dtype=int):
            raise InputError(
                "data.columns",
                f"{observed[0].size} numbers for each time ({', '.join(names)})",
                f"{int(np.prod(wanted))}: the {observe} of a state whose q has shape {shape}",
            )
        observed = observed.reshape(len(ts), *wanted)
    elif ":" in observe:
        function = loader.load("data.observe", observe)
        if not callable(function):
            raise InputError("data.observe", shown(observe), "a function (t, q, p, args)")
        observe = function
    else:
        raise InputError(
            "data.observe", shown(observe), f'{one_of(_NAMED, observe)}; or "file.py:name"'
        )
    if sigma is not None and np.ndim(sigma):
        sigma = _spread(sigma, observed, len(names))
    t0 = values["t0"]
    if len(ts) == 1 and t0 is None:
        raise InputError("data.file", "one observation", "two times at least, or t0 before it")
    if np.isnan(observed).all():
        raise InputError("data.columns", "no value in any row", "columns with numbers")
    try:
        data = dvi.Observations(ts, observed, observe, sigma=sigma, t0=t0)
    except (TypeError, ValueError) as error:
        raise InputError("data", str(error), "observations in the order of time") from None
    if (data.ordered().ts[-1] - data.t0) * h < 0:
        raise InputError(
            "h", f"{h:g}, which leads from t0 = {data.t0:g} away from the observations",
            f"{-h:g}, or a t0 on the other side of the observations",
        )  # fmt: skip
    return data, names


def _joined(parts: list[np.ndarray], names: list[str], rows: int) -> np.ndarray:
    for part, name in zip(parts, names, strict=True):
        if len(part) != rows:
            raise InputError(
                "data.columns",
                f"{name} has {len(part)} rows",
                f"as many as there are times, {rows}",
            )
        if np.isinf(part).any():
            raise InputError("data.columns", f"{name} holds an infinite value", "NaN if missing")
    if len(parts) == 1 and parts[0].ndim > 1:  # an array of an npz: its shape is that of q
        return parts[0]
    return np.concatenate([part.reshape(rows, -1) for part in parts], axis=1)


def _errors(values: dict[str, Any], columns: dict[str, np.ndarray]) -> tuple[Any, list[str]]:
    """Standard errors, and the columns that they stand in."""
    given = values["data.sigma"]
    if not (isinstance(given, list) and isinstance(given[0], str)):
        return given, []
    found = [column(columns, "data.sigma", name) for name in given]
    for name, part in zip(given, found, strict=True):
        bad = np.flatnonzero(~(part > 0) | ~np.isfinite(part))
        if bad.size:
            raise InputError(
                "data.sigma", f"row {bad[0] + 1} of {name} is {part.ravel()[bad[0]]}",
                "positive standard errors in every row",
            )  # fmt: skip
    return np.stack(found, axis=-1), given


def _spread(sigma: np.ndarray, observed: np.ndarray, names: int) -> np.ndarray:
    """Standard errors of one column for all, or of one for each, as the observations stand."""
    flat = observed.reshape(len(observed), -1)
    if sigma.shape[-1] not in (1, flat.shape[1]):
        raise InputError(
            "data.sigma", f"{sigma.shape[-1]} of them", f"one for all, or {names}, one a column"
        )
    return np.broadcast_to(sigma, flat.shape).reshape(observed.shape)
