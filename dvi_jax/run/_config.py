"""The TOML file of a run: its keys, their types, and nothing else; and how such files are read."""

import datetime
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ._errors import InputError, one_of, shown


@dataclass(frozen=True)
class Key:
    """One key: `read` makes the value or raises `ValueError`, `allowed` says what it takes."""

    read: Callable[[Any], Any]
    allowed: str
    default: Any = None


def text(value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise ValueError
    return value


def boolean(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError
    return value


def number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError
    try:
        found = float(value)
    except OverflowError:  # a whole number of more than 300 digits
        raise ValueError from None
    if not np.isfinite(found):
        raise ValueError
    return found


def step_size(value: Any) -> float:
    if number(value) == 0:
        raise ValueError
    return float(value)


def count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError
    return value


def array(value: Any) -> np.ndarray:
    """Nested arrays of finite numbers, all rows of one length."""
    if not isinstance(value, list) or not value:
        raise ValueError
    for item in value:
        array(item) if isinstance(item, list) else number(item)
    return np.asarray(value, float)  # ValueError for rows of unequal length


def _date(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, str | int | float | datetime.date):
        raise ValueError
    return value


def _lattice(value: Any) -> Any:
    if isinstance(value, dict):
        if set(value) != {"times"}:
            raise ValueError
        times = array(value["times"])
        steps = np.diff(times) if times.ndim == 1 else np.zeros(1)
        if not steps.size or not ((steps > 0).all() or (steps < 0).all()):
            raise ValueError
        return times
    if value != "uniform":
        raise ValueError
    return value


def parameter(value: Any, key: str = "args") -> Any:
    """A leaf of args, or a table of them. Arrays become float arrays; whole numbers stay whole.

    **Raises** `InputError` with the key of the leaf that is none.
    """
    if isinstance(value, dict):
        return {name: parameter(inner, f"{key}.{name}") for name, inner in value.items()}
    if isinstance(value, bool):
        return value
    try:
        if isinstance(value, list):
            return array(value)
        as_float = number(value)
    except ValueError:
        raise InputError(
            key, shown(value), f"a finite number, true or false, {ARRAY}, or a table of these"
        ) from None
    return value if isinstance(value, int) else as_float


_NOT_IN_NAMES = re.compile(r"[/\\\x00-\x1f]")


def _texts(value: Any) -> dict[str, str]:
    if not isinstance(value, dict):
        raise ValueError
    for name, inner in value.items():
        if _NOT_IN_NAMES.search(name):
            raise InputError(
                "observables", f"the name {name!r}",
                "a name without / and \\, for it becomes the name of a file in an archive",
            )  # fmt: skip
        if not isinstance(inner, str) or not inner.strip():
            raise InputError(
                f"observables.{name}", shown(inner), 'text such as "energy" or "MaxDrift(energy)"'
            )
    return value


ARRAY = "an array of finite numbers, or of such arrays with rows of one length"

Keys = Mapping[str, Key | Mapping[str, Key]]
"""The keys of a kind of file: name → key, or a table of keys."""

KEYS: Keys = {
    "system": Key(text, 'the name of a system in the library, or "file.py:name"'),
    "state": {
        "q0": Key(array, ARRAY),
        "p0": Key(array, ARRAY),
        "date": Key(_date, 'a day such as "1900-01-01" or a Julian date; for solar_system alone'),
    },
    "args": Key(
        lambda value: parameter(value) if isinstance(value, dict) else text(0),
        "a table of numbers, booleans, arrays of numbers, or tables of these",
    ),
    "t0": Key(number, "a finite number", 0.0),
    "h": Key(step_size, "a finite number that is not zero (negative runs backwards)"),
    "steps": Key(count, "a positive whole number"),
    "epsilon": Key(number, "a finite number", 0.0),
    "method": Key(text, 'text such as "TypeII", "Strang" or "Yoshida(4)"', "TypeII"),
    "lattice": Key(
        _lattice,
        '"uniform", or {times = [t0, t1, …]} with at least two times, all increasing or all '
        "decreasing",
        "uniform",
    ),
    "observables": Key(
        _texts,
        'a table of texts, such as energy = "energy" or drift = "MaxDrift(energy)"',
    ),
    "output": {
        "dir": Key(text, "the path of a directory that does not exist yet"),
        "every": Key(count, "a positive whole number: steps from one saved state to the next", 1),
        "plots": Key(boolean, "true or false", True),
    },
}
"""Every key that a run file may hold."""


def read_config(path: Path, keys: Keys) -> tuple[dict[str, Any], dict[str, Any]]:
    """The values of a file of these keys with defaults filled in, and the file as it was.

    Tables are flattened: ``"state.q0"``, ``"output.dir"``; a key that is absent is None.

    **Raises** `InputError` for a missing or unreadable file, TOML that does not parse, an
    unknown key and a value of the wrong type.
    """
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8-sig"))  # some editors begin with a BOM
    except FileNotFoundError:
        raise InputError(str(path), "there is no such file", "the path of a TOML file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(str(path), f"cannot be read: {error}", "a TOML file in UTF-8") from None
    except (ValueError, RecursionError) as error:  # also thousands of digits, of brackets
        raise InputError(str(path), f"is not TOML: {error}", "https://toml.io") from None
    values = _read_table(keys, raw, "")
    if values["system"] is None:
        key = keys["system"]
        assert isinstance(key, Key)
        raise InputError("system", "the key is missing", key.allowed)
    return values, raw


def _read_table(keys: Mapping[str, Any], table: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    for name in table:
        if name not in keys:
            raise InputError(prefix + name, "there is no such key", one_of(keys, name))
    values = {}
    for name, key in keys.items():
        full, value = prefix + name, table.get(name)
        if not isinstance(key, Key):
            if value is not None and not isinstance(value, dict):
                raise InputError(full, shown(value), f"a table with the keys {one_of(key)}")
            values |= _read_table(key, value or {}, full + ".")
        elif value is None:
            values[full] = key.default
        else:
            try:
                values[full] = key.read(value)
            except InputError:  # it knows better what is wrong
                raise
            except ValueError:
                raise InputError(full, shown(value), key.allowed) from None
    return values
