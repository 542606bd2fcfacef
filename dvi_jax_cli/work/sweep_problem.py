"""The arguments of `dvi.sweep` that a TOML file describes."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from .._errors import InputError, require
from .expressions import parse_method
from .observables import read_observables
from .schema import ARRAY, Pair, SweepFile
from .system import Source, find_source
from .table import AN_AXIS, MISSING, Axis, at, axes_in

_KEYS = {"num_steps": "steps"}
"""Argument of `dvi.sweep` → key of the file, where they differ."""


def sweep_problem(file: SweepFile, folder: Path) -> tuple[Source, dict[str, Any]]:
    """The source of the system, and the arguments of `dvi.sweep` except for the store.

    **Raises** `InputError`.
    """
    source = find_source(file, folder)
    times = source.times(file)
    every = getattr(file.save, "every", None)  # None of "final"
    save = dvi.Save(every=every) if every else dvi.Save(final=True)
    arguments = {
        "system": source.system,
        "lattice": times.pop("lattice"),
        "args": _parameters(source.args),
        "method": _methods(file.method),
        "save": None if file.save is None else save,
        "observe": _observe(file, source),
        "lanes_per_task": file.output.lanes_per_task,
    }
    arguments |= {name: _for_sweep(_KEYS.get(name, name), value) for name, value in times.items()}
    arguments |= _initial_conditions(file, source)
    kinds = (dvi.Axis, dvi.starts.Starts)
    leaves = jax.tree.leaves(arguments, is_leaf=lambda x: isinstance(x, kinds))
    seen = "nothing varies, neither this nor another number"
    allowed = "an axis for some number, or [start]; for one trajectory there is dvi-jax run"
    require(any(isinstance(x, kinds) for x in leaves), "epsilon", seen, allowed)
    return source, arguments


# Axes


def _for_sweep(key: str, value: Any) -> Any:
    """A value with its axes as those of `dvi.sweep`; one without a name has that of the key."""
    if isinstance(value, list):
        return [_for_sweep(f"{key}[{i}]", part) for i, part in enumerate(value)]
    return _axis(key, value, value.all) if isinstance(value, Axis) else value


def _axis(key: str, given: Axis, values: Any) -> dvi.Axis:
    try:
        return dvi.Axis(given.axis or key.rpartition(".")[2], values, given.units)
    except (TypeError, ValueError) as error:
        raise InputError(f"{key}.{given.kind}", str(error), AN_AXIS) from None


def _parameters(value: Any, key: str = "args") -> Any:
    """The parameters; an array with axes in it becomes an axis of arrays."""
    if isinstance(value, dict):
        return {name: _parameters(inner, f"{key}.{name}") for name, inner in value.items()}
    axes = axes_in(value) if isinstance(value, list) else []
    if not axes:
        return _for_sweep(key, value)
    seen = [f"{axis.axis} with {len(axis.all)} values" for axis in axes]
    allowed = "axes of one name and length"
    require(len({*seen}) == 1, key, f"axes {', '.join(seen)} in one array", allowed)
    arrays = [np.asarray(at(value, k), float) for k in range(len(axes[0].all))]
    return _axis(key, axes[0], np.stack(arrays))


def _methods(given: Any) -> Any:
    if isinstance(given, str):
        return parse_method(given)
    if isinstance(given, list):
        return dvi.Axis("method", [parse_method(text) for text in given])
    return _axis("method", given, [parse_method(text) for text in given.all])


def _observe(file: SweepFile, source: Source) -> dict[str, Any] | None:
    """The observables; one without a reduction is that of the last step."""
    found = read_observables(file.observables, source)
    fits, allowed = found or file.save is not None, 'an observable at least, or save = "final"'
    require(fits, "observables", "nothing would be saved", allowed)
    reduced = {n: f if isinstance(f, dvi.Reduction) else dvi.Last(f) for n, f in found.items()}
    return reduced or None


# Initial conditions


def _initial_conditions(file: SweepFile, source: Source) -> dict[str, Any]:
    """`start`, or `q0` and `p0`, checked for one of the trajectories at least."""
    if file.start is None:
        q0, p0 = source.array("q0"), source.array("p0")
        try:
            _check(source, q0, p0, 0)
        except InputError:  # a single one is a trajectory that fails, which is a result
            _check(source, q0, p0, -1)
        return {"q0": _for_sweep("state.q0", q0), "p0": _for_sweep("state.p0", p0)}
    start = _start(file.start, source)
    t0, args = at(file.t0, 0), at(source.args, 0)
    try:
        q0, p0 = (np.asarray(x) for x in start.at(jnp.zeros((), jnp.int32), t0, args))
    except Exception as error:  # whatever a user's H raises
        allowed = "an H (t, q, p, args) that fits the box and args"
        raise InputError("start", source.reported(error), allowed) from error
    source.check_start(q0, p0, args)
    return {"start": start}


def _check(source: Source, q0: Any, p0: Any, which: int) -> None:
    """Reject a state of which the first trajectory, or the last, cannot start."""
    q0, p0 = (np.asarray(at(x, which), float) for x in (q0, p0))
    source.check_start(q0, p0, at(source.args, which))


def _start(given: Any, source: Source) -> dvi.starts.Starts:
    """Generated initial conditions; normally distributed ones are by default about the system's."""
    options = {name: getattr(given, name) for name in given.model_fields_set - {"kind"}}
    for name, value in options.items():
        if isinstance(value, Pair):
            options[name] = (value.q, value.p)
    for name in ("q0", "p0") if given.kind == "normal" else ():
        if name not in options:
            require(source.problem, f"start.{name}", MISSING, ARRAY)
            options[name] = np.asarray(getattr(source.problem, name), float)
    if "H" in options:
        options["H"] = source.loader.load("start.H", options["H"])
    made = getattr(dvi.starts, given.kind.title().replace("_", ""))  # energy_shell → EnergyShell
    try:
        return made(**options)
    except (TypeError, ValueError) as error:
        raise InputError("start", str(error), f"keys that fit kind = {given.kind}") from None
