"""The library of systems, as tables."""

import inspect
from typing import Any

import jax
import numpy as np

from dvi_jax import systems

from .._errors import as_input_error, require_name
from .._show import TextTable


def library_tables(name: str | None = None) -> tuple[str, list[TextTable]]:
    """A heading and tables: all systems of the library, or what is known of one.

    **Raises** `InputError` for a name that is not in the library, or a system that cannot be made
    (an extra is missing).
    """
    if name is None:
        rows = [[key, _first_line(make)] for key, make in systems.LIBRARY.items()]
        return "", [TextTable("Systems of the library", ["name", "what it is"], rows)]
    require_name("NAME", name, systems.LIBRARY)
    make = systems.LIBRARY[name]
    rule = "a system whose extras are installed"
    with as_input_error("NAME", rule, ImportError, prefix=f"{name}: "):
        problem = make()
    heading = f"{inspect.getdoc(make)}\n\nEquations: {_first_line(problem.system.H_D)}"
    for kind in ("force", "perturbation"):
        if (function := getattr(problem.system, kind)) is not None:
            heading += f"\nPerturbation ε·{kind}: {_first_line(function)}"
    meanings, args = problem.parameters, problem.args or {}
    args = [[key, _short(x), meanings.get(key, "")] for key, x in args.items()]
    observables = problem.observables.items()
    observed = [[key, _conservation(problem, key), _first_line(f)] for key, f in observables]
    symmetries = [[key, "of the map and of the flow"] for key in problem.symmetries]
    symmetries += [[key, "of the flow"] for key in problem.flow_symmetries]
    start = [[key, _short(getattr(problem, key))] for key in ("q0", "p0", "h")]
    tables = [
        TextTable("Parameters", ["args", "value", "meaning [unit]"], args),
        TextTable("Observables", ["name", "", "what it is"], observed),
        TextTable("Symmetries at ε = 0", ["generator", ""], symmetries),
        TextTable("Start and step", ["", "value"], start),
    ]
    return heading, [table for table in tables if table.rows]


def _first_line(function: Any) -> str:
    return (inspect.getdoc(function) or "").partition("\n")[0]


def _conservation(problem: systems.Problem, name: str) -> str:
    if name in problem.adiabatic:
        adiabatic = problem.adiabatic[name]
        power = f" to power {adiabatic.power}" if adiabatic.power != 1 else ""
        return f"adiabatic: oscillates by {adiabatic.small}{power}"
    return "conserved by the unperturbed flow" if name in problem.invariants else ""


def _short(value: Any) -> str:
    leaves = jax.tree.leaves(value)
    array = np.asarray(leaves[0]) if len(leaves) == 1 else np.asarray(value)
    if array.size > 8:
        return f"array of shape {array.shape}"
    return np.array2string(array, precision=6, separator=", ").replace("\n", "")
