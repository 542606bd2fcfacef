"""Forces of `dvi.forces` from the tables [[force]] of a TOML file."""

import inspect
import operator
from collections.abc import Mapping
from functools import reduce
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
    own: dict[str, Any] = {}

    def value_of(key: str, value: Any) -> Any:
        if isinstance(value, dict):  # of harmonics: "2" is a degree, "2,1" a degree and an order
            return {_numbers(f"{key}.{k}", k): value_of(f"{key}.{k}", v) for k, v in value.items()}
        if isinstance(value, list):
            return tuple(value_of(key, v) for v in value)
        if not isinstance(value, str):
            return value
        if ".py:" in value:
            return loader.load(key, value)
        prefix, _, name = value.partition(".")
        rule = 'numbers, "args.NAME" with a key NAME of [args], or "file.py:name"'
        require(prefix == "args" and name in args, key, describe(value), rule)
        own[name] = args[name]
        return lambda args: args[name]

    terms: list[Any] = []
    for i, table in enumerate(tables):
        key, name = f"force[{i}]", table.get("name", "")
        defect = NO_KEY if "name" not in table else ""
        require_name(f"{key}.name", name, CLASSES, defect=defect)
        names = inspect.signature(CLASSES[name]).parameters
        for k in table.keys() - {"name"}:
            require_name(f"{key}.{k}", k, names, defect=f"{name} has no such parameter")
        options = {k: value_of(f"{key}.{k}", v) for k, v in table.items() if k != "name"}
        with as_input_error(key, f"parameters of {name}: {one_of(names)}"):
            terms.append(CLASSES[name](**options))
    with as_input_error("force", "a system whose args are a table"):
        return reduce(operator.add, terms).add_to(problem, args=own or None)


def _numbers(key: str, text: str) -> Any:
    with as_input_error(key, 'a degree, "2", or a degree and an order, "2,1"'):
        numbers = tuple(int(part) for part in text.split(","))
    return numbers[0] if len(numbers) == 1 else numbers
