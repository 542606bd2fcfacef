"""The TOML file of a fit: the keys of a run's system, data, what is fitted and what is known."""

import math
from typing import Any

import numpy as np

from ._config import KEYS, Key, Keys, array, boolean, count, number, text
from ._errors import InputError, shown

LOSSES = ("LeastSquares", "SoftL1", "Cauchy")


def _texts(value: Any) -> list[str]:
    if not isinstance(value, list) or not value:
        raise ValueError
    return [text(v) for v in value]


def _text_or_texts(value: Any) -> list[str]:
    return _texts(value if isinstance(value, list) else [value])


def _sigma(value: Any) -> Any:
    """A number, numbers for the columns, or names of columns."""
    if isinstance(value, str) or (isinstance(value, list) and value and isinstance(value[0], str)):
        return _text_or_texts(value)
    found = array(value) if isinstance(value, list) else number(value)
    if not np.all(np.asarray(found) > 0):
        raise ValueError
    return found


def _limit(value: Any) -> Any:
    """A number, infinite ones too, or an array of them."""
    if isinstance(value, list):
        return [_limit(v) for v in value]
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        raise ValueError
    return float(value)


def _pairs(key: str, read: Any, allowed: str) -> Key:
    """A table of pairs: name of a parameter → two numbers, or two arrays."""

    def pair(name: str, value: Any) -> tuple[Any, Any]:
        try:
            if not isinstance(value, list) or len(value) != 2:
                raise ValueError
            return read(value[0]), read(value[1])
        except ValueError:
            raise InputError(f"{key}.{name}", shown(value), allowed) from None

    def table(value: Any, prefix: str = "") -> dict[str, tuple[Any, Any]]:
        if not isinstance(value, dict):
            raise ValueError
        found = {}
        for name, inner in value.items():
            # [bounds] args.k = […] is a table in TOML, "args.k" = […] is none: both are meant.
            is_table = isinstance(inner, dict)
            found |= table(inner, f"{name}.") if is_table else {
                prefix + name: pair(prefix + name, inner)
            }  # fmt: skip
        return found

    return Key(table, f"a table: name of a parameter = {allowed}", {})


def _loss(value: Any) -> str:
    if value not in LOSSES:
        raise ValueError
    return value


def _horizons(value: Any) -> Any:
    if isinstance(value, list):
        return [number(v) for v in value]
    if value not in ("auto", "none"):
        raise ValueError
    return None if value == "none" else value


def _share(value: Any) -> float:
    if not 0 < number(value) < 1:
        raise ValueError
    return float(value)


def _of_run(name: str) -> Any:
    return KEYS[name]


FIT_KEYS: Keys = {
    "system": _of_run("system"),
    "state": _of_run("state"),
    "args": _of_run("args"),
    "h": _of_run("h"),
    "epsilon": _of_run("epsilon"),
    "method": _of_run("method"),
    "t0": Key(number, "a finite number: the time of [state]; that of the first observation if not "
              "given"),
    "parameters": Key(_texts, 'an array of names: "epsilon", "q0", "p0", "args.NAME"'),
    "bounds": _pairs("bounds", _limit, "[lower, upper], numbers or arrays; -inf, inf for none"),
    "priors": _pairs("priors", lambda v: array(v) if isinstance(v, list) else number(v),
                     "[mean, standard error], numbers or arrays"),
    "data": {
        "file": Key(text, "the path of a CSV or npz file, from the folder of this one"),
        "time": Key(text, "the name of the column with the times", "t"),
        "columns": Key(_texts, "an array of names of columns; all but time and sigma if not given"),
        "observe": Key(text, '"positions", "momenta", "state", or "file.py:name" of a function '
                       "(t, q, p, args)", "positions"),
        "sigma": Key(_sigma, "standard errors: a positive number, an array of them, one for each "
                     "column, or names of columns"),
    },
    "options": {
        "loss": Key(_loss, ", ".join(LOSSES), "LeastSquares"),
        "segments": Key(count, "a positive whole number: segments of multiple shooting"),
        "horizons": Key(_horizons, '"auto", "none", or an array of growing times', "auto"),
        "max_steps": Key(count, "a positive whole number"),
        "tolerance": Key(_share, "a number between 0 and 1", 1e-4),
        "curvature": Key(boolean, "true or false", True),
    },
    "output": {
        "dir": _of_run("output")["dir"],
        "plots": _of_run("output")["plots"],
    },
}  # fmt: skip
"""Every key that a fit file may hold."""
