"""Forces of `dvi.forces` from the tables [[force]] of a TOML file."""

import functools
import inspect
import operator
from collections.abc import Mapping
from typing import Any

from dvi_jax.systems import Problem, forces

from .._errors import as_input_error, describe, one_of, require, require_name
from .loader import Loader
from .table import NO_KEY

CLASSES = {name: kind for name, kind in vars(forces).items() if isinstance(kind, type)}
del CLASSES["Force"]


def add_forces(
    problem: Problem, tables: list[dict[str, Any]], args: Mapping[str, Any], loader: Loader
) -> Problem:
    """The problem with the forces of the tables; `args`: those of the file, in which a parameter
    that is "args.NAME" is a key. **Raises** `InputError`."""
    parameters: dict[str, Any] = {}

    def value_of(key: str, value: Any) -> Any:
        if isinstance(value, dict):  # of harmonics: "2" is a degree, "2,1" a degree and an order
            parts = {f"{key}.{index}": index for index in value}
            return {
                _numbers(place, index): value_of(place, value[index])
                for place, index in parts.items()
            }
        if isinstance(value, list):
            return tuple(value_of(key, part) for part in value)
        if not isinstance(value, str):
            return value
        if ".py:" in value:
            return loader.load(key, value)
        prefix, _, name = value.partition(".")
        rule = 'numbers, "args.NAME" with a key NAME of [args], or "file.py:name"'
        require(prefix == "args" and name in args, key, describe(value), rule)
        parameters[name] = args[name]
        return lambda args: args[name]

    terms: list[Any] = []
    for number, table in enumerate(tables):
        key, name = f"force[{number}]", table.get("name", "")
        defect = NO_KEY if "name" not in table else ""
        require_name(f"{key}.name", name, CLASSES, defect=defect)
        names = inspect.signature(CLASSES[name]).parameters
        values = {option: value for option, value in table.items() if option != "name"}
        for option in values:
            require_name(f"{key}.{option}", option, names, defect=f"{name} has no such parameter")
        options = {option: value_of(f"{key}.{option}", values[option]) for option in values}
        with as_input_error(key, f"parameters of {name}: {one_of(names)}"):
            terms.append(CLASSES[name](**options))
    with as_input_error("force", "a system whose args are a table"):
        return functools.reduce(operator.add, terms).add_to(problem, args=parameters or None)


def _numbers(key: str, text: str) -> Any:
    with as_input_error(key, 'a degree, "2", or a degree and an order, "2,1"'):
        numbers = tuple(int(part) for part in text.split(","))
    return numbers[0] if len(numbers) == 1 else numbers
