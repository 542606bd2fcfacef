"""The TOML file of a sweep: the keys of a run, with axes for its numbers, starts and a store."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

import dvi_jax as dvi

from ..sweep.variables import RESERVED
from ._config import ARRAY, KEYS, Key, Keys, array, count, number, parameter, step_size, text
from ._errors import InputError, one_of, shown

_KINDS = ("linspace", "geomspace", "values")
_AXIS_KEYS = (*_KINDS, "axis", "units")
_AN_AXIS = "{linspace = [a, b, n]}, {geomspace = [a, b, n]} or {values = […]}"


def _is_axis(value: Any) -> bool:
    return isinstance(value, dict) and any(k in value for k in (*_KINDS, "axis"))


def read_axis(
    key: str, table: Mapping[str, Any], read: Callable[[Any], Any], name: str | None = None
) -> dvi.Axis:
    """The axis that a table at this key describes; `read` reads one of its values.

    `name` is that of the axis if the table gives none; None: it must give one.

    **Raises** `InputError`.
    """
    for word in table:
        if word not in _AXIS_KEYS:
            raise InputError(f"{key}.{word}", "there is no such key", one_of(_AXIS_KEYS, word))
    kinds = [k for k in _KINDS if k in table]
    if len(kinds) != 1:
        raise InputError(key, shown(dict(table)), f"one of {_AN_AXIS}")
    name = table.get("axis", name)
    if name is None:
        raise InputError(
            f"{key}.axis", "the key is missing", 'a name for this axis, such as axis = "x"'
        )
    if not isinstance(name, str) or not name.isidentifier() or name in RESERVED:
        raise InputError(
            f"{key}.axis", shown(name), f"a name such as x1, and none of {', '.join(RESERVED)}"
        )
    if not isinstance(units := table.get("units", ""), str):
        raise InputError(f"{key}.units", shown(units), 'text such as "m/s"')
    values = _values(f"{key}.{kinds[0]}", kinds[0], table[kinds[0]], read)
    try:
        return dvi.Axis(name, values, units)
    except (TypeError, ValueError) as error:
        raise InputError(f"{key}.{kinds[0]}", str(error), _AN_AXIS) from None


def _values(key: str, kind: str, given: Any, read: Callable[[Any], Any]) -> list[Any]:
    if kind != "values":
        given = _spaced(key, kind, given)
    elif not isinstance(given, list) or not given:
        raise InputError(key, shown(given), "an array of at least one value")
    found = []
    for i, value in enumerate(given):
        try:
            found.append(read(value))
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"{key}[{i}]", shown(value), "a value that this key takes where it is no axis"
            ) from None
    if len({np.shape(x) for x in found}) != 1:
        raise InputError(key, shown(given), "values of one shape")
    return found


def _spaced(key: str, kind: str, given: Any) -> list[float]:
    wanted = "[first, last, how many]"
    try:
        if not isinstance(given, list) or len(given) != 3:
            raise ValueError
        a, b, n = number(given[0]), number(given[1]), count(given[2])
    except ValueError:
        raise InputError(key, shown(given), f"{wanted}: two numbers and a whole one") from None
    if kind == "geomspace" and a * b <= 0:
        raise InputError(key, shown(given), f"{wanted}, both ends above zero or both below")
    return getattr(np, kind)(a, b, n).tolist()


# Readers of the keys that may be axes


def _or_axis(name: str, read: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: read_axis(name, value, read, name) if _is_axis(value) else read(value)


def _state(name: str) -> Callable[[Any], Any]:
    """Of q0 or p0: an array, one with axes among its components, or an axis of whole states."""
    key = f"state.{name}"

    def component(value: Any, where: str) -> Any:
        if isinstance(value, list):
            return [component(v, f"{where}[{i}]") for i, v in enumerate(value)]
        return read_axis(where, value, number) if _is_axis(value) else number(value)

    def read(value: Any) -> Any:
        if _is_axis(value):
            return read_axis(key, value, array)
        if not _holds_axis(value):
            return array(value)
        state = component(value, key)
        np.asarray(at(state, 0), float)  # ValueError for rows of unequal length
        return state

    return read


def _holds_axis(value: Any) -> bool:
    return isinstance(value, list) and any(isinstance(v, dict) or _holds_axis(v) for v in value)


def at(value: Any, which: int) -> Any:
    """An argument with every axis in it at one of its values."""
    if isinstance(value, dvi.Axis):
        return value.values[which]
    if isinstance(value, dict):
        return {name: at(v, which) for name, v in value.items()}
    return [at(v, which) for v in value] if isinstance(value, list) else value


def _argument(key: str, value: Any) -> Any:
    """A part of args. An axis in an array makes an axis of arrays."""
    name = key.rpartition(".")[2]
    if _is_axis(value):
        return read_axis(key, value, _leaf, name)
    if isinstance(value, dict):
        return {inner: _argument(f"{key}.{inner}", v) for inner, v in value.items()}
    if not _holds_axis(value):
        return parameter(value, key)
    axes: list[dvi.Axis] = []

    def component(v: Any, where: str) -> Any:
        if isinstance(v, list):
            return [component(w, f"{where}[{i}]") for i, w in enumerate(v)]
        if not _is_axis(v):
            return number(v)
        axes.append(read_axis(where, v, number))
        return axes[-1]

    whole = component(value, key)
    if len({(a.name, len(a)) for a in axes}) != 1:
        raise InputError(
            key, f"axes {', '.join(map(repr, axes))} in one array", "axes of one name and length"
        )
    rows = [np.asarray(at(whole, k), float) for k in range(len(axes[0]))]
    return dvi.Axis(axes[0].name, np.stack(rows), axes[0].units)


def _leaf(value: Any) -> Any:
    if isinstance(value, list):
        return array(value)
    number(value)
    return value  # whole numbers stay whole


def _arguments(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError
    return {name: _argument(f"args.{name}", v) for name, v in value.items()}


def _steps(value: Any) -> Any:
    def whole(v: Any) -> int:  # linspace makes 100.0
        return count(int(v) if isinstance(v, float) and v.is_integer() else v)

    return read_axis("steps", value, whole, "steps") if _is_axis(value) else count(value)


def _method(value: Any) -> Any:
    """One text, or an axis of them; the texts become methods in the setup."""
    if isinstance(value, list):
        value = {"values": value}
    return _or_axis("method", text)(value)


def _save(value: Any) -> dvi.Save:
    if isinstance(value, dict) and set(value) == {"every"}:
        return dvi.Save(every=count(value["every"]))
    if value != "final":
        raise ValueError
    return dvi.Save(final=True)


def pair(value: Any) -> Any:
    """A table {q, p} of numbers or arrays, as a pair."""
    if not isinstance(value, dict) or set(value) != {"q", "p"}:
        raise ValueError
    return tuple(array(value[k]) if isinstance(value[k], list) else number(value[k]) for k in "qp")


def _corner(value: Any) -> Any:
    return array(value) if isinstance(value, list) else pair(value)


def seed(value: Any) -> int:
    return 0 if value == 0 and isinstance(value, int) else count(value)


def _name(value: Any) -> str:
    if not isinstance(value, str) or not value.isidentifier() or value in RESERVED:
        raise ValueError
    return value


def _of_run(name: str) -> Any:
    return KEYS[name]


def _number_or_axis(name: str, read: Callable[[Any], Any]) -> Key:
    known = _of_run(name)
    return Key(_or_axis(name, read), f"{known.allowed}; or an axis, {_AN_AXIS}", known.default)


_STATE = f'{ARRAY}; numbers in it may be axes; or {{values = [[…], …], axis = "name"}}'
_CORNER = "{q = […], p = […]}; for energy_shell an array, of q alone"

SWEEP_KEYS: Keys = {
    "system": _of_run("system"),
    "state": {
        "q0": Key(_state("q0"), _STATE),
        "p0": Key(_state("p0"), _STATE),
        "date": _of_run("state")["date"],
    },
    "start": {
        "kind": Key(text, "halton, random, normal or energy_shell"),
        "count": Key(count, "a positive whole number"),
        "low": Key(_corner, _CORNER),
        "high": Key(_corner, _CORNER),
        "q0": Key(array, ARRAY),
        "p0": Key(array, ARRAY),
        "sigma": Key(pair, "{q = …, p = …}: standard deviations, numbers or arrays"),
        "energy": Key(number, "a finite number"),
        "H": Key(text, '"file.py:name", a function (t, q, p, args)'),
        "seed": Key(seed, "a whole number that is not negative"),
        "name": Key(_name, f"a name such as start, and none of {', '.join(RESERVED)}"),
    },
    "args": Key(_arguments, f"{_of_run('args').allowed}; a number may be an axis, {_AN_AXIS}"),
    "t0": _number_or_axis("t0", number),
    "h": _number_or_axis("h", step_size),
    "steps": Key(_steps, f"a positive whole number; or an axis, {_AN_AXIS} of such"),
    "epsilon": _number_or_axis("epsilon", number),
    "method": Key(_method, f"{_of_run('method').allowed}; or an array of such texts", "TypeII"),
    "lattice": _of_run("lattice"),
    "observables": _of_run("observables"),
    "save": Key(_save, '"final", or {every = n} with a positive whole number'),
    "output": {
        "store": Key(text, "the path of a directory that does not exist yet"),
        "lanes_per_task": Key(count, "a positive whole number: trajectories of one task"),
    },
}
"""Every key that a sweep file may hold."""
