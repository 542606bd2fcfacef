"""The library of systems, as tables."""

import inspect
from typing import Any

import jax
import numpy as np

from dvi_jax import systems

from .._errors import InputError, one_of
from .._show import Table


def library_tables(name: str | None = None) -> tuple[str, list[Table]]:
    """A heading and tables: all systems of the library, or what is known of one.

    **Raises** `InputError` for a name that is not in the library, or a system that cannot be made
    (an extra is missing).
    """
    if name is None:
        rows = [[key, _first_line(make)] for key, make in systems.LIBRARY.items()]
        return "", [Table("Systems of the library", ["name", "what it is"], rows)]
    if name not in systems.LIBRARY:
        raise InputError("NAME", f"{name!r}", one_of(systems.LIBRARY, name))
    make = systems.LIBRARY[name]
    try:
        problem = make()
    except ImportError as error:
        seen = f"{name}: {error}"
        raise InputError("NAME", seen, "a system whose extras are installed") from None
    heading = f"{inspect.getdoc(make)}\n\nEquations: {_first_line(problem.system.H_D)}"
    for what in ("force", "perturbation"):
        if (function := getattr(problem.system, what)) is not None:
            heading += f"\nPerturbation ε·{what}: {_first_line(function)}"
    tables = [_parameters(problem), _observables(problem), _symmetries(problem)]
    start = [[which, _short(getattr(problem, which))] for which in ("q0", "p0", "h")]
    tables.append(Table("Start and step", ["", "value"], start))
    return heading, [table for table in tables if table.rows]


def _first_line(function: Any) -> str:
    doc = inspect.getdoc(function) or ""
    return doc.splitlines()[0] if doc else ""


def _parameters(problem: systems.Problem) -> Table:
    args = problem.args or {}
    rows = [[key, _short(args[key]), problem.parameters.get(key, "")] for key in args]
    return Table("Parameters", ["args", "value", "meaning [unit]"], rows)


def _observables(problem: systems.Problem) -> Table:
    def conserved(name: str) -> str:
        if name in problem.adiabatic:
            known = problem.adiabatic[name]
            power = f"to power {known.power}" if known.power != 1 else ""
            return f"adiabatic: oscillates by {known.small} {power}".rstrip()
        return "conserved exactly at ε = 0" if name in problem.invariants else ""

    rows = [[name, conserved(name), _first_line(f)] for name, f in problem.observables.items()]
    return Table("Observables", ["name", "", "what it is"], rows)


def _symmetries(problem: systems.Problem) -> Table:
    rows = [[name, "of the map and of the flow"] for name in problem.symmetries]
    rows += [[name, "of the flow"] for name in problem.flow_symmetries]
    return Table("Symmetries at ε = 0", ["generator", ""], rows)


def _short(value: Any) -> str:
    leaves = jax.tree.leaves(value)
    array = np.asarray(leaves[0]) if len(leaves) == 1 else np.asarray(value)
    if array.size > 8:
        return f"array of shape {array.shape}"
    return np.array2string(array, precision=6, separator=", ").replace("\n", "")
