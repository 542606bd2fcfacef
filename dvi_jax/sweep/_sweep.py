"""`sweep` and `sweep_cost`: from arguments to a grid, its tasks and its result."""

import dataclasses
import json
import os
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Unpack

import jax
import numpy as np

from ..base.checks import instance, one_of, whole
from ..base.keywords import checked_keywords
from ..base.reads import reads
from ..problem.system import System
from .axes import axes_in, is_axis
from .bar import progress_display
from .cost import SweepCost, cost
from .identity import description, digest, provenance
from .program import Sweep, functions_of, states_of
from .request import Request, SweepCostSettings, SweepSettings
from .result import SweepResult
from .store import MemorySink, Store
from .variables import check_names, own_dims
from .workers import SweepProgress, run_here

_MANY_STARTS = 100_000  # Initial conditions up to which they are written into the result


class SweepInterrupted(KeyboardInterrupt):
    """Raised by Ctrl-C during a sweep. `result` and the store, if any, have the finished tasks."""

    def __init__(self, message: str, result: SweepResult):
        super().__init__(message)
        self.result = result


@checked_keywords
def sweep(
    system: System,
    q0: Any = None,
    p0: Any = None,
    *,
    units: Mapping[str, str] | None = None,
    store: str | os.PathLike | None = None,
    client: Any = None,
    threads: int | None = None,
    progress: bool | Callable[[SweepProgress], None] | None = None,
    **settings: Unpack[SweepSettings],
) -> SweepResult:
    """Trajectories over a grid of ε, initial conditions, parameters, steps and methods.

    ``dvi.sweep(system, q0, p0, epsilon=np.geomspace(1e-4, 1e-1, 20), h=0.1, num_steps=10_000,
    observe={"drift": dvi.MaxDrift(energy)}).to_xarray()`` is a labelled array of 20 drifts.

    The grid is divided into tasks of one shape, which run on all processors or GPUs of this
    machine. Results are bit-for-bit independent of the number of workers and of interruptions.

    **What varies.** Any number in epsilon, h, t0, q0, p0 and args may be an `Axis`; for epsilon, h
    and t0 a one-dimensional array is an axis of that name. Axes of different names make a grid,
    those of one name vary together. `start` generates initial conditions: `Random`, `Halton`,
    `Normal`, `EnergyShell` in `dvi.starts`. `method` and `num_steps` may be an `Axis` of a list, or
    simply a list (for `method` the dimension is then "integrator"); each value is compiled.

    **Arguments** otherwise as for `integrate`, and

    - `observe`: pytree of observables and reductions. `save`: which states are stored; None: none.
      With a `jump`, `jumps.count` is stored, and with `save` all of `Jumps`, max_jumps rows each.
    - `units`: of observables (and of t, q, p), name → text, for labels; a store keeps those of
      the first call.
    - `store`: a directory. Each task is written there when it is done; the same call again resumes
      an interrupted sweep. Several processes may work on one store. Without one the results stay
      in memory.
    - `client`: a `distributed.Client`: its workers compute the tasks. If there is a store they
      write them there; all of them must see it under the same path.
    - `devices`: of this process, such as ``jax.devices("cpu")``; None: all of `jax.local_devices`.
    - `threads`: of this process; None: one for each processor, or two for each GPU.
    - `lanes_per_task`: trajectories at a time; None: chosen from the number of steps, and on GPUs
      also from the operations of a step and the memory.
    - `progress`: True or False for a bar; a function of a `SweepProgress`; None: a bar if stderr is
      a terminal.

    Failed trajectories are NaN with a status; other trajectories are unaffected.

    **Returns** a `SweepResult`.

    **Raises** `ValueError` or `TypeError` for invalid input; `StoreMismatch` for a store of another
    sweep, with the differences, and `StoreError` for one that cannot be used; `ClusterError` for a
    cluster that is lost; `SweepInterrupted`, a `KeyboardInterrupt`, after Ctrl-C, with the finished
    tasks.

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
    program, arrays, programs = Request(system, q0, p0, **settings).prepare()
    definition, coordinates = program.sweep, coordinates_of(program.sweep)
    check_names(definition.dims, arrays, coordinates)
    attributes: dict[str, Any] = provenance()
    if auxiliary := [name for name in coordinates if name not in definition.dims]:
        attributes["coordinates"] = " ".join(auxiliary)  # the attribute of the CF conventions
    if units is not None:
        attributes["units"] = json.dumps(_checked_units(units, arrays))
    if client is not None and not hasattr(client, "submit"):
        raise TypeError(f"client must be a distributed.Client, got {client!r:.200}.")
    if threads is not None:
        whole("threads", threads)
    for name, value in (("threads", threads), ("devices", settings.get("devices"))):
        if client is not None and value is not None:
            raise ValueError(f"{name}={value} has no effect with client: leave it out.")
    config = description(definition, program.plan, arrays, programs)
    if store is None:
        sink = MemorySink(program.plan, arrays)
        attributes |= {"config": json.dumps(config), "config_sha256": digest(config)}
    else:
        instance("store", store, str | os.PathLike, "the path of a directory or None")
        sink = Store.open_or_make(store, config, arrays, coordinates, attributes)
        attributes = dict(sink.attributes)
    result = SweepResult(sink, coordinates, attributes)
    with progress_display(progress) as report:
        if client is not None:
            from .cluster import run_on

            is_complete = run_on(client, definition, program.plan, sink, report)
        else:
            is_complete = run_here(program, sink, threads, report)
    if not is_complete:
        message = f"interrupted: {result.tasks_done} of {result.num_tasks} tasks are done"
        if store is None:
            message += "; their results are the attribute `result` of this exception."
        else:
            message += f" and stored in {result.path}; the same call continues from there."
        raise SweepInterrupted(message, result)
    return result


@checked_keywords
def sweep_cost(
    system: System, q0: Any = None, p0: Any = None, **settings: Unpack[SweepCostSettings]
) -> SweepCost:
    """Estimate the cost of a `sweep` with these arguments: tasks, bytes, seconds; with tables for
    larger ones. One task for each method and number of steps is computed for it and timed.

    **Arguments** as for `sweep`; `store`, `client`, `threads`, `progress` and `units` have no
    effect.

    **Returns** a `SweepCost`. **Raises** as `sweep` for invalid input.
    """
    names = [field.name for field in dataclasses.fields(Request)]
    options: dict[str, Any] = {name: x for name, x in settings.items() if name in names}
    program, arrays, _ = Request(system, q0, p0, **options).prepare()
    return cost(program, arrays)


def _checked_units(units: Any, names: Iterable[str]) -> dict[str, str]:
    instance("units", units, Mapping, 'a dict from names to text, such as {"drift": "J"}')
    for name, unit in units.items():
        instance(f"the unit of {name!r}", unit, str, 'text, such as "J"')
        one_of("each name in units", name, names)
    return dict(units)


def coordinates_of(definition: Sweep) -> dict[str, Any]:
    """name → (dims, values, attributes). If only one argument varies along a dimension, its values
    are those of the dimension; otherwise each argument is a coordinate of its own name."""
    dims, method, num_steps = definition.dims, definition.method, definition.num_steps
    coordinates: dict[str, Any] = {}
    arguments_of: dict[str, dict[str, tuple[np.ndarray, str]]] = {dim: {} for dim in dims}
    if is_axis(method):
        arguments_of[method.name]["method"] = np.asarray([*map(repr, method.values)]), ""
    if is_axis(num_steps):
        arguments_of[num_steps.name]["num_steps"] = np.asarray(num_steps.values), "steps"
    for argument, axis in axes_in(definition.inputs):
        arguments_of[axis.name][argument] = axis.values, axis.units
    for dim, arguments in arguments_of.items():
        rows = [name for name, (values, _) in arguments.items() if values.ndim == 1]
        main = dim if dim in rows else rows[0] if len(rows) == 1 else None
        if main is None and dims[dim] <= _MANY_STARTS:
            coordinates[dim] = ((dim,), np.arange(dims[dim]), {})
        for name, (values, units) in arguments.items():
            label = "component" if name in ("q0", "p0") else f"{name}_dim"
            all_dims = (dim, *own_dims(label, values.shape[1:]))
            attributes = {"units": units} if units else {}
            coordinates[dim if name == main else name] = (all_dims, values, attributes)
    start, inputs = definition.start, (definition.inputs["t0"], definition.inputs["args"])
    vary = any(map(is_axis, jax.tree.leaves(inputs, is_leaf=is_axis)))  # with another axis
    if start is not None and start.count <= _MANY_STARTS and not vary:
        states = states_of(start, *inputs, reads(*functions_of(start)))
        for name, values in zip(("q0", "p0"), map(np.asarray, states), strict=True):
            all_dims = (start.name, *own_dims("component", values.shape[1:]))
            coordinates[name] = (all_dims, values, {})
    return coordinates
