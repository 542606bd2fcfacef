"""`sweep` and `sweep_cost`: from arguments to a grid, its tasks and its result."""

import json
import os
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from lanewise import Layout
from lanewise.jaxapi import x64_enabled

from .._arithmetic import Arithmetic
from .._checks import instance, whole
from .._integrator import Integrator, chosen
from .._memory import machine_memory
from .._solution import Save
from .._system import System, check_system
from ..engine.names import both_names
from ..engine.newton import RootSolver
from ..lattices import Given, Lattice
from ..methods import Method
from ..observe import Stop
from .axes import Axis, as_axis, is_axis, leaves_with_axes, lengths
from .bar import shown
from .cost import SweepCost, cost
from .identity import description, digest, provenance
from .plan import make_plan
from .program import Program, Sweep, traced
from .result import SweepResult
from .sinks import Memory
from .starts import Starts
from .store import Store
from .variables import RESERVED, check_names, own_dims, variables
from .workers import SweepProgress, run_here

_SHARE = 0.5
"""Of the memory of the machine, for results that are kept there."""

_MANY_STARTS = 100_000
"""Starts up to which they are written into the result."""


class SweepInterrupted(KeyboardInterrupt):
    """Ctrl-C during a sweep: what was finished is in `result`, and in the store if there is one."""

    def __init__(self, message: str, result: SweepResult):
        super().__init__(message)
        self.result = result


@both_names
def sweep(
    system: System,
    q0: Any = None,
    p0: Any = None,
    *,
    start: Starts | None = None,
    h: Any = None,
    num_steps: Any = None,
    t0: Any = 0.0,
    epsilon: Any = 0.0,
    args: Any = None,
    method: Any = None,
    lattice: Lattice | None = None,
    save: Save | None = None,
    observe: Any = None,
    units: Mapping[str, str] | None = None,
    newton: RootSolver | None = None,
    arithmetic: Arithmetic | None = None,
    layout: Layout | None = None,
    integrator: Integrator | None = None,
    stop: Stop | None = None,
    store: str | os.PathLike | None = None,
    client: Any = None,
    threads: int | None = None,
    lanes_per_task: int | None = None,
    progress: bool | Callable[[SweepProgress], None] | None = None,
) -> SweepResult:
    """Trajectories over a grid of ε, initial conditions, parameters, steps and methods.

    ``dvi.sweep(system, q0, p0, epsilon=np.geomspace(1e-4, 1e-1, 20), h=0.1, num_steps=10_000,
    observe={"drift": dvi.MaxDrift(energy)}).to_xarray()`` is a labelled array of 20 drifts.

    The grid is cut into tasks of one shape, which run on all processors or GPUs of this machine.
    Results do not depend on how many there are, nor on when a run was interrupted: not in one bit.

    **What varies.** Any number in epsilon, h, t0, q0, p0 and args may be an `Axis`; for epsilon, h
    and t0 a one-dimensional array is one, of that name. Axes of different names make a grid, of one
    name they go together. `start` generates initial conditions: `Random`, `Halton`, `Normal`,
    `EnergyShell` in `dvi.starts`. An `Axis` of a list may stand for `method` (or simply the list;
    the dimension is then "integrator") and for `num_steps`, e.g. together with h; each value is
    compiled.

    **Arguments** otherwise as for `integrate`, and

    - `observe`: pytree of observables and reductions. `save`: which states are kept; None: none.
    - `units`: of observables (and of t, q, p), name → text, for labels; those of a store are given
      when it is made.
    - `store`: a directory. Each task is written there when it is done; the same call again goes on
      where a former one ended, however it ended. Several processes may work on one store. Without
      one the results stay in memory.
    - `client`: a `distributed.Client`: its workers compute the tasks, and write them where there is
      a store, which all of them must see under the same path.
    - `threads`: of this process; None: one for each processor, or GPU.
    - `lanes_per_task`: trajectories at a time; None: chosen from the number of steps.
    - `progress`: True or False for a bar; a function of a `SweepProgress`; None: a bar where
      somebody looks.

    A trajectory that fails has a status and NaN, and its neighbours are as they were.

    **Returns** a `SweepResult`.

    **Raises** `ValueError` or `TypeError` for input that cannot be meant; `StoreMismatch` for a
    store of another sweep, with what differs, and `StoreError` for one that cannot be used;
    `ClusterError` for a cluster that is lost;
    `SweepInterrupted`, a `KeyboardInterrupt`, after Ctrl-C, with what was finished.

    **Example**

    ```python
    kepler = systems.kepler()
    result = dvi.sweep(kepler.system, kepler.q0, [dvi.Axis("p_x", [-1.0, -0.9]), -0.6],
                       epsilon=np.geomspace(1e-4, 1e-2, 3), args=kepler.args, h=0.1, num_steps=500,
                       observe={"drift": dvi.MaxDrift(kepler.observables["energy"])})
    print(dict(result.to_xarray().drift.sizes), result.status_counts())
    # {'epsilon': 3, 'p_x': 2} {'successful': 6}
    ```
    """
    made = make_sweep(
        system, q0, p0, start=start, h=h, num_steps=num_steps, t0=t0, epsilon=epsilon, args=args,
        method=method, lattice=lattice, save=save, observe=observe, newton=newton,
        arithmetic=arithmetic, layout=layout, integrator=integrator, stop=stop,
    )  # fmt: skip
    program, found, programs = prepare(made, lanes_per_task)
    coordinates = coordinates_of(made)
    check_names(made.dims, found, coordinates)
    about: dict[str, Any] = provenance()
    if beside := [name for name in coordinates if name not in made.dims]:
        about["coordinates"] = " ".join(beside)  # what a reader by CF looks for
    if units is not None:
        _check_units(units, found)
        about["units"] = json.dumps(dict(units))
    if client is not None and not hasattr(client, "submit"):
        raise TypeError(f"client must be a distributed.Client, got {client!r}.")
    if threads is not None:
        whole("threads", threads)
        if client is not None:
            raise ValueError("threads are of this process: with a client its workers have theirs.")
    config = description(made, program.plan, found, programs)
    if store is None:
        _check_memory(program.plan.lanes * sum(v.bytes for v in found.values()))
        sink: Any = Memory(program.plan, found)
        about |= {"config": json.dumps(config), "config_sha256": digest(config)}
    else:
        instance("store", store, str | os.PathLike, "the path of a directory or None")
        sink = Store.open_or_make(store, config, found, coordinates, about)
        about = sink.attributes
    result = SweepResult(sink, coordinates, about)
    with shown(progress) as report:
        if client is not None:
            from .cluster import run_on

            is_whole = run_on(client, made, program.plan, sink, report)
        else:
            is_whole = run_here(program, sink, threads, report)
    if not is_whole:
        done = f"{result.tasks_done} of {result.num_tasks} tasks are done"
        where = "; they are the `result` of this exception."
        if store is not None:
            where = f" and kept in {result.path}; the same call goes on from there."
        raise SweepInterrupted(f"interrupted: {done}{where}", result)
    return result


def sweep_cost(
    system: System,
    q0: Any = None,
    p0: Any = None,
    *,
    lanes_per_task: int | None = None,
    **settings: Any,
) -> SweepCost:
    """What `sweep` would take with these arguments: tasks, bytes, seconds; with tables for larger
    ones. One task for each method and number of steps is computed for it and timed.

    **Arguments** as for `sweep`; `store`, `client`, `threads` and `progress` are not needed.

    **Returns** a `SweepCost`. **Raises** as `sweep` for input that cannot be meant.
    """
    for name in ("store", "client", "threads", "progress", "units"):
        settings.pop(name, None)
    made = make_sweep(system, q0, p0, **settings)
    program, found, _ = prepare(made, lanes_per_task)
    return cost(made, program.plan, found)


def _check_units(units: Any, found: Mapping[str, Any]) -> None:
    if not isinstance(units, Mapping) or not all(isinstance(u, str) for u in units.values()):
        raise TypeError(f'units must be a table such as {{"drift": "J"}}, got {units!r}.')
    if unknown := [name for name in units if name not in found]:
        raise ValueError(
            f"units are given for {unknown[0]!r}, which is none of the results: {', '.join(found)}."
        )


def make_sweep(
    system: Any,
    q0: Any,
    p0: Any,
    *,
    start: Any = None,
    h: Any = None,
    num_steps: Any = None,
    t0: Any = 0.0,
    epsilon: Any = 0.0,
    args: Any = None,
    method: Any = None,
    integrator: Integrator | None = None,
    newton: RootSolver | None = None,
    save: Save | None = None,
    observe: Any = None,
    stop: Stop | None = None,
    **of_integrator: Any,
) -> Sweep:
    """The sweep that these arguments of `sweep` describe, checked."""
    check_system(system)
    given = {"epsilon": epsilon, "h": h, "t0": t0}
    inputs = {name: as_axis(name, _number(value)) for name, value in given.items()}
    inputs |= {"args": args, **_states(q0, p0, start)}
    if observe is None and save is None:
        raise ValueError(
            "nothing would be kept: give observe={...}, or save=dvi.Save(final=True) for the last "
            "states."
        )
    varied = is_axis(method) or isinstance(method, list | tuple)
    of_integrator |= {"root_finder": newton, "method": None if varied else method}
    integrator = chosen(integrator, **of_integrator)
    method = _static("method", method if varied else integrator.method_for(system), Method)
    num_steps = _static("num_steps", num_steps, int | np.integer)
    leaves = leaves_with_axes(inputs)
    compiled = [
        (x.name, len(x), where)
        for where, x in (("method", method), ("num_steps", num_steps))
        if is_axis(x)
    ]
    axes = [*compiled, *((leaf.axis.name, len(leaf.axis), leaf.name) for leaf in leaves)]
    if start is not None:
        Axis(start.name, [0])  # raises for a name that is no identifier
        if start.name in (name for name, *_ in axes):
            raise ValueError(f"the name {start.name!r} of the start is that of an axis too.")
        axes.append((start.name, start.count, "start"))
    dims = lengths(axes)
    _check_dims(dims)
    _check_steps(num_steps, integrator.lattice, inputs)
    options = {
        "save": save,
        "observe": observe,
        "stop": stop,
        "lattice": integrator.lattice,
        "newton": integrator.root_finder,
        "arithmetic": integrator.arithmetic,
        "layout": integrator.layout,
    }
    count = len({name for name, *_ in compiled})
    return Sweep(system, inputs, start, method, num_steps, options, dims, count)


def _states(q0: Any, p0: Any, start: Any) -> dict[str, Any]:
    """q0 and p0, unless they come from a `start`."""
    if start is None:
        if q0 is None or p0 is None:
            raise ValueError("give q0 and p0, or start=dvi.starts.Random(...) or another of those.")
        return {"q0": q0, "p0": p0}
    if q0 is not None or p0 is not None:
        raise ValueError("give q0 and p0 or a start, not both.")
    hint = 'States of your own are q0=dvi.Axis("start", ...), p0=dvi.Axis("start", ...).'
    instance("start", start, Starts, "one of dvi.starts, such as Random(...)", hint)
    return {}


def _check_dims(dims: Mapping[str, int]) -> None:
    if taken := [name for name in dims if name in RESERVED]:
        raise ValueError(
            f"the axis {taken[0]!r} has a name that the result needs for something else "
            f"({', '.join(RESERVED)}): give it another."
        )
    if not dims:
        raise ValueError(
            'nothing varies: give an array for epsilon or h, a dvi.Axis("name", values) anywhere, '
            "or a start. For one trajectory there is dvi.integrate."
        )
    if not x64_enabled() and max(dims.values()) >= 2**31:
        raise ValueError(
            "more than 2³¹ values along one axis are counted with 64 bits: put\n"
            '    jax.config.update("jax_enable_x64", True)\nbefore the first array is made.'
        )


def _check_steps(num_steps: Any, lattice: Lattice, inputs: Mapping[str, Any]) -> None:
    if isinstance(lattice, Given):
        if num_steps is not None:
            raise ValueError("the times of dvi.Given are the steps: leave num_steps out.")
        if any(is_axis(inputs[name]) for name in ("h", "t0")):
            raise ValueError("the times of dvi.Given replace h and t0: there is no axis of them.")
    elif num_steps is None:
        raise ValueError("num_steps is missing: how many steps each trajectory takes.")
    elif any(n < 1 for n in (num_steps.values if is_axis(num_steps) else [num_steps])):
        raise ValueError(f"num_steps must be at least 1, got {num_steps!r}.")


def _number(value: Any) -> Any:
    """A whole number of Python's as the number that it is."""
    return float(value) if type(value) is int else value


def _static(name: str, value: Any, kind: Any) -> Any:
    """One value, or an axis of values that are compiled one by one."""
    if isinstance(value, list | tuple):
        # Not "method", which xarray's sel takes for something else.
        value = Axis({"method": "integrator"}.get(name, name), value)
    for x in value.values if is_axis(value) else ():
        if isinstance(x, bool) or not isinstance(x, kind):
            raise TypeError(f"the axis {value.name!r} of {name} holds {x!r}, which is none.")
    return value


def prepare(made: Sweep, lanes_per_task: int | None) -> tuple[Program, dict[str, Any], list[Any]]:
    """The program of a sweep, cut into tasks, the variables of its result, and the jaxprs."""
    shapes, programs = traced(made)
    found = variables(made, shapes)
    size = sum(v.bytes for v in found.values())
    plan = make_plan(made.dims, made.compiled, made.most_steps, size, lanes_per_task)
    return Program(made, plan), found, programs


def coordinates_of(made: Sweep) -> dict[str, Any]:
    """name → (dims, values, attributes). Where one argument alone runs along a dimension, its
    values are the dimension's; else they stand beside it under the argument's name."""
    found: dict[str, Any] = {}
    along: dict[str, dict[str, tuple[np.ndarray, str]]] = {dim: {} for dim in made.dims}
    if is_axis(made.method):
        names = np.asarray([repr(m) for m in made.method.values])
        along[made.method.name]["method"] = names, ""
    if is_axis(made.num_steps):
        along[made.num_steps.name]["num_steps"] = np.asarray(made.num_steps.values), "steps"
    for leaf in leaves_with_axes(made.inputs):
        along[leaf.axis.name][leaf.name] = leaf.axis.values, leaf.axis.units
    for dim, arguments in along.items():
        rows = [name for name, (values, _) in arguments.items() if values.ndim == 1]
        main = dim if dim in rows else rows[0] if len(rows) == 1 else None
        if main is None and made.dims[dim] <= _MANY_STARTS:
            found[dim] = ((dim,), np.arange(made.dims[dim]), {})
        for name, (values, units) in arguments.items():
            own = own_dims("component" if name in ("q0", "p0") else f"{name}_dim", values.shape[1:])
            about = {"units": units} if units else {}
            found[dim if name == main else name] = ((dim, *own), values, about)
    if made.start is not None and made.start.count <= _MANY_STARTS:
        states = _starts(made)
        for name, x in zip(("q0", "p0"), states, strict=False):  # none where they vary
            found[name] = ((made.start.name, *own_dims("component", x.shape[1:])), x, {})
    return found


def _starts(made: Sweep) -> list[np.ndarray]:
    """All starts, where they do not depend on what else varies."""
    start, of = made.start, (made.inputs["t0"], made.inputs["args"])
    if start is None or any(map(is_axis, jax.tree.leaves(of, is_leaf=is_axis))):
        return []
    at = jax.jit(jax.vmap(lambda i: start.at(i, *of)))
    return [np.asarray(x) for x in at(np.arange(start.count))]


def _check_memory(needed: int) -> None:
    there = machine_memory() or 8 * 2**30
    if needed > _SHARE * there:
        raise ValueError(
            f"the results need {needed / 2**30:.1f} GiB of memory, and this machine has "
            f"{there / 2**30:.1f} GiB: give store=..., a directory, of which one task at a time is "
            "in memory."
        )
