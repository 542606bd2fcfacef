"""From the values of a sweep file to what `sweep` takes."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from .. import systems
from ._errors import InputError, one_of, shown
from ._setup import (
    Loader,
    arguments_of,
    check_start,
    find_problem,
    lattice_of,
    observables_of,
    parse_method,
    said,
    state_of,
)
from ._sweep_config import SWEEP_KEYS, at

_START = {
    "halton": (dvi.starts.Halton, ("count", "low", "high")),
    "random": (dvi.starts.Random, ("count", "low", "high")),
    "normal": (dvi.starts.Normal, ("count", "q0", "p0", "sigma")),
    "energy_shell": (dvi.starts.EnergyShell, ("count", "H", "energy", "low", "high")),
}
"""kind → what makes the starts, and the keys that it needs."""


@dataclass(frozen=True)
class SweepSetup:
    """The arguments of `dvi.sweep`, but for where the results go; `files` are the user's."""

    name: str
    arguments: dict[str, Any]
    files: tuple[Path, ...] = ()


def make_sweep_setup(values: dict[str, Any], folder: Path) -> SweepSetup:
    """What a sweep file means; files that it names are looked for from `folder`.

    **Raises** `InputError`.
    """
    loader = Loader(folder)
    problem, system, _ = find_problem(values, loader)
    args = arguments_of(values["args"], problem)
    lattice, h, steps = lattice_of(values, problem)
    arguments = {
        "system": system,
        "h": h,
        "num_steps": steps,
        "t0": values["t0"],
        "epsilon": values["epsilon"],
        "args": args,
        "method": _method(values["method"]),
        "lattice": lattice,
        "save": values["save"],
        "observe": _observe(values, problem, loader),
        "lanes_per_task": values["output.lanes_per_task"],
    } | _states(values, problem, loader, args)
    if not any(_varies(x) for x in arguments.values()):
        raise InputError(
            "epsilon",
            "nothing varies, neither this nor another number",
            "an axis for some number, or [start]; for one trajectory there is dvi-jax run",
        )
    name = problem.name if problem is not None else values["system"]
    return SweepSetup(name, arguments, tuple(loader.modules))


def _varies(argument: Any) -> bool:
    kinds = (dvi.Axis, dvi.starts.Starts)
    leaves = jax.tree.leaves(argument, is_leaf=lambda x: isinstance(x, kinds))
    return any(isinstance(x, kinds) for x in leaves)


def _method(given: Any) -> Any:
    if not isinstance(given, dvi.Axis):
        return parse_method(given)
    return dvi.Axis(given.name, [parse_method(text) for text in given.values], given.units)


def _observe(
    values: dict[str, Any], problem: systems.Problem | None, loader: Loader
) -> dict[str, Any] | None:
    """The observables; one without a reduction is that of the last step."""
    found = observables_of(values["observables"], problem, loader)
    if not found and values["save"] is None:
        raise InputError(
            "observables", "nothing would be kept", 'an observable at least, or save = "final"'
        )
    return {
        name: f if isinstance(f, dvi.Reduction) else dvi.Last(f) for name, f in found.items()
    } or None


# Where the trajectories start


def _states(
    values: dict[str, Any], problem: systems.Problem | None, loader: Loader, args: Any
) -> dict[str, Any]:
    """`start`, or `q0` and `p0`; checked at one of the starts."""
    given = {
        key.removeprefix("start."): value
        for key, value in values.items()
        if key.startswith("start.") and value is not None
    }
    if not given:
        q0, p0 = (state_of(values, name, getattr(problem, name, None)) for name in ("q0", "p0"))
        _check(problem, {"q0": q0, "p0": p0, "args": args})
        return {"q0": q0, "p0": p0}
    for name in ("q0", "p0", "date"):
        if values[f"state.{name}"] is not None:
            raise InputError(f"state.{name}", "given beside [start]", "[state] or [start]")
    start = _start(given, problem, loader)
    t0, some = at(values["t0"], 0), at(args, 0)
    try:
        q0, p0 = (np.asarray(x) for x in start.at(jnp.zeros((), jnp.int32), t0, some))
    except Exception as error:  # whatever a user's H raises
        raise InputError(
            "start", said(error, *loader.modules), "an H (t, q, p, args) that fits the box and args"
        ) from error
    check_start(problem, q0, p0, some)
    return {"start": start}


def _check(problem: systems.Problem | None, axes: dict[str, Any]) -> None:
    """Refuse states of which neither the first nor the last is a start: one that is none would be
    a trajectory that fails, a result like others."""
    try:
        check_start(problem, **_arrays(axes, 0))
    except InputError:
        check_start(problem, **_arrays(axes, -1))


def _arrays(axes: dict[str, Any], which: int) -> dict[str, Any]:
    found = at(axes, which)
    return found | {name: np.asarray(found[name], float) for name in ("q0", "p0")}


def _start(
    given: dict[str, Any], problem: systems.Problem | None, loader: Loader
) -> dvi.starts.Starts:
    keys = SWEEP_KEYS["start"]
    assert isinstance(keys, Mapping)
    kind = given.pop("kind", None)
    if kind not in _START:
        seen = "the key is missing" if kind is None else repr(kind)
        raise InputError("start.kind", seen, one_of(_START, kind or ""))
    make, needed = _START[kind]
    allowed = (*needed, "seed", "name")
    for name in given:
        if name not in allowed:
            raise InputError(f"start.{name}", f"kind = {kind} has no such key", one_of(allowed))
    if kind == "normal" and problem is not None:
        given = {name: np.asarray(getattr(problem, name), float) for name in ("q0", "p0")} | given
    for name in needed:
        if name not in given:
            raise InputError(f"start.{name}", "the key is missing", keys[name].allowed)
        if name in ("low", "high") and isinstance(given[name], tuple) == (kind == "energy_shell"):
            raise InputError(f"start.{name}", shown(given[name]), keys[name].allowed)
    if "H" in given:
        given["H"] = loader.load("start.H", given["H"])
    try:
        return make(**given)
    except (TypeError, ValueError) as error:
        raise InputError("start", str(error), f"keys that fit kind = {kind}") from None
