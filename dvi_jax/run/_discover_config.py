"""The TOML file of a discovery: the keys of a run's system, a basis, samples, drifts."""

from typing import Any

from ._config import KEYS, Key, Keys, boolean, count, number, text
from ._errors import InputError, shown
from ._sweep_config import pair, read_axis, seed


def _order(value: Any) -> int:
    return 0 if value == 0 and not isinstance(value, bool | float) else count(value)


def _span(value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError
    a, b = number(value[0]), number(value[1])
    if not a < b:
        raise ValueError
    return a, b


def _epsilons(value: Any) -> list[float]:
    """Strengths: an array, or spaced as an axis of a sweep is."""
    if isinstance(value, dict):
        found = list(read_axis("drift.epsilons", value, number, "epsilon").values)
    elif isinstance(value, list):
        found = [number(v) for v in value]
    else:
        raise ValueError
    if len(found) < 3 or min(found) <= 0 or len(set(found)) < len(found):
        raise InputError(
            "drift.epsilons", shown(value), "three numbers or more above zero, no two the same"
        )
    return [float(x) for x in found]


def _share(value: Any) -> float:
    if not 0 < number(value) < 1:
        raise ValueError
    return float(value)


def _kind(value: Any) -> str:
    if value not in ("least", "simplest"):
        raise ValueError
    return value


def _of_run(name: str) -> Any:
    return KEYS[name]


_BOX = "{q = […], p = […]}: numbers, or arrays of the shape of q"

DISCOVER_KEYS: Keys = {
    "system": _of_run("system"),
    "state": _of_run("state"),
    "args": _of_run("args"),
    "h": _of_run("h"),
    "method": _of_run("method"),
    "t0": _of_run("t0"),
    "basis": Key(text, 'text such as "Polynomials(4)", "Polynomials(2) + Radial((-1,))", or '
                 '"file.py:name" of a basis'),
    "order": Key(_order, "a whole number that is not negative", 1),
    "tolerance": Key(_share, "a number between 0 and 1; not given: exact invariants alone"),
    "representative": Key(_kind, '"least" or "simplest"', "least"),
    "samples": {
        "count": Key(count, "a positive whole number; not given: four for each function"),
        "low": Key(pair, _BOX),
        "high": Key(pair, _BOX),
        "times": Key(_span, "[first, last]: times of the samples, all at t0 if not given"),
        "seed": Key(seed, "a whole number that is not negative", 0),
    },
    "drift": {
        "epsilons": Key(_epsilons, "an array of numbers, or {geomspace = [a, b, n]}",
                        [1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2]),
        "steps": Key(count, "a positive whole number", 1000),
        "starts": Key(count, "a positive whole number: trajectories from the box", 8),
        "measure": Key(boolean, "true or false: whether drifts are measured", True),
    },
    "output": {
        "dir": _of_run("output")["dir"],
        "plots": _of_run("output")["plots"],
    },
}  # fmt: skip
"""Every key that a discovery file may hold."""
