"""The compiled function that computes one task."""

import collections
import contextlib
import dataclasses
import functools
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lanewise.jaxprs.jaxapi import ClosedJaxpr, x64_enabled

from ..base.reads import Reads, reads
from ..base.results import status_code
from ..integration.integrate import integrate
from ..lattices import Given
from ..observe.solution import Save
from .axes import is_axis, place
from .plan import SweepPlan, SweepTask
from .starts import Starts


@dataclasses.dataclass(frozen=True, eq=False)
class Sweep:
    """The definition of a sweep: the arguments of `integrate`, with axes in them.

    - `inputs`: h, t0, epsilon, args, and q0, p0 unless there is a `start`.
    - `options`: the other arguments. `method` and `num_steps` may be an `Axis`.
    """

    system: Any
    inputs: Mapping[str, Any]
    start: Starts | None
    method: Any
    num_steps: Any
    options: Mapping[str, Any]
    dims: Mapping[str, int]
    compiled_dims: int

    @property
    def of_grid(self) -> list[str]:
        """The dimensions of which the values are not compiled separately."""
        return list(self.dims)[self.compiled_dims :]

    def value(self, setting: Any, start: tuple[int, ...]) -> Any:
        """The method, or the number of steps, of the task that begins at this index."""
        if not is_axis(setting):
            return setting
        value = setting.values[start[list(self.dims).index(setting.name)]]
        return int(value) if isinstance(value, np.integer) else value

    @property
    def most_steps(self) -> int:
        num_steps = self.num_steps
        if num_steps is None:
            return len(self.options["lattice"].ts) - 1
        return max(int(v) for v in num_steps.values) if is_axis(num_steps) else num_steps


class AxisValues(eqx.Module):
    """The values of an axis in one task; `name` is that of its dimension."""

    values: Any
    name: str = eqx.field(static=True)


def _varies(x: Any) -> bool:
    return isinstance(x, AxisValues)


class Lanes(eqx.Module):
    """The trajectories of a task as one pytree: `AxisValues` in the inputs differ between them.

    - `names`: the dimensions of the task. It has one method and one number of steps.
    """

    system: Any
    inputs: dict[str, Any]
    start: Starts | None
    method: Any
    options: dict[str, Any]
    num_steps: int | None = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    reads: Reads = eqx.field(static=True)

    def one_trajectory(self, task_index: tuple, grid_index: tuple) -> dict[str, Any]:
        """The variables of one trajectory, from its index in each dimension of task and sweep."""
        index = dict(zip(self.names, task_index, strict=True))
        inputs = jax.tree.map(
            lambda x: x.values[index[x.name]] if _varies(x) else x, self.inputs, is_leaf=_varies
        )
        if self.start is None:
            q0, p0 = (state_of(inputs.pop(name)) for name in ("q0", "p0"))
        else:
            number = grid_index[self.names.index(self.start.name)]
            lattice = self.options["lattice"]
            t0 = lattice.ts[0] if isinstance(lattice, Given) else inputs["t0"]
            q0, p0, *start_args = self.start.at(number, t0, inputs["args"])
            inputs["args"] = start_args[0] if start_args else inputs["args"]
        save = self.options["save"]
        options = {**self.options, "save": save or Save(final=True)}
        options |= {"method": self.method, "num_steps": self.num_steps, "throw": False}
        solution = integrate(self.system, q0, p0, **inputs, **options)
        leaves = jax.tree.leaves_with_path(solution.observed)
        results = {place(path) or "observed": value for path, value in leaves}
        if save is not None:
            results |= {"t": solution.ts, "q": solution.qs, "p": solution.ps}
        if solution.stop is not None:
            results["stop_t"] = solution.stop.t
        jumps = {} if solution.jumps is None else vars(solution.jumps)
        # The states of jumps are saved where others are.
        results |= {f"jumps.{x}": jumps[x] for x in jumps if x == "count" or save is not None}
        return results | {
            "status": status_code(solution.result).astype(jnp.int8),
            "failed_step": solution.stats["failed_step"],
            "residual": solution.stats["max_residual"],
        }


def lanes_of(sweep: Sweep, task_start: tuple[int, ...], values: Any) -> Lanes:
    """The trajectories of the task that begins at this index; `values`: the rows of an axis."""

    def value_of(leaf: Any) -> Any:
        if not is_axis(leaf):
            return leaf
        if leaf.name in sweep.of_grid:
            return AxisValues(values(leaf), leaf.name)
        return leaf.values[task_start[list(sweep.dims).index(leaf.name)]]

    inputs = jax.tree.map(value_of, dict(sweep.inputs), is_leaf=is_axis)
    method, steps = (sweep.value(x, task_start) for x in (sweep.method, sweep.num_steps))
    values_read = reads(*sweep.options.values(), *functions_of(sweep.start))
    fields = dict(sweep.options), steps, tuple(sweep.of_grid), values_read
    return Lanes(sweep.system, inputs, sweep.start, method, *fields)


def functions_of(start: Starts | None) -> tuple[Any, ...]:
    """What `reads` has to follow for generated initial conditions."""
    return () if start is None else (start, type(start).at)


@eqx.filter_jit
def states_of(start: Starts, t0: Any, args: Any, values_read: Reads) -> tuple[Any, Any]:
    """All q0 and p0 of generated initial conditions; compiled again if `values_read` change."""
    return jax.vmap(lambda i: start.at(i, t0, args))(jnp.arange(start.count))[:2]


def _batch(lanes: Lanes, chunk: tuple[int, ...], begin: Any, last: Any) -> dict[str, Any]:
    """All trajectories of a task, in the order of its box. Those beyond the end of the grid repeat
    the last one, so that every task has the shape for which the program is compiled."""
    if not chunk:
        return jax.tree.map(lambda x: x[None], lanes.one_trajectory((), ()))
    count = stride = int(np.prod(chunk, dtype=int))
    task_index = []
    for c in chunk:
        stride //= c
        task_index.append((np.arange(count, dtype=np.int32) // stride) % c)
    grid_index = [jnp.minimum(i + b, e) for i, b, e in zip(task_index, begin, last, strict=True)]
    return jax.vmap(lanes.one_trajectory)(tuple(task_index), tuple(grid_index))


_compute: Any = eqx.filter_jit(_batch)


def state_of(state: Any) -> Any:
    """A state given component by component."""
    if not isinstance(state, list | tuple):
        return state
    return jnp.stack([jnp.asarray(state_of(x), jnp.result_type(float)) for x in state])


class SweepProgram:
    """Computes tasks of a sweep on some of the devices of this process, by default on all."""

    def __init__(self, sweep: Sweep, plan: SweepPlan, devices: Sequence[Any] | None = None):
        self.sweep, self.plan = sweep, plan
        self.devices = jax.local_devices() if devices is None else devices
        self._locks: dict[Any, threading.Lock] = collections.defaultdict(threading.Lock)
        self._compiled_programs: set[Any] = set()

    def __call__(self, task: SweepTask, device: Any) -> dict[str, np.ndarray]:
        """The variables of a task, each of shape (*task.size, …), computed on a device."""
        sweep, first = self.sweep, self.sweep.compiled_dims
        chunk, size = self.plan.chunk[first:], task.size[first:]

        def rows(axis: Any) -> Any:
            dim = sweep.of_grid.index(axis.name)
            begin = task.start[first + dim]
            values = np.asarray(axis.values[begin : begin + size[dim]])
            return np.concatenate([values, *[values[-1:]] * (chunk[dim] - size[dim])])

        lanes = lanes_of(sweep, task.start, rows)
        numbers = jax.tree.map(  # as arrays: another h then needs no other program
            lambda x: np.asarray(x) if isinstance(x, float | np.generic) else x, lanes.inputs
        )
        lanes = dataclasses.replace(lanes, inputs=numbers)
        begin = np.asarray(task.start[first:], np.int64 if x64_enabled() else np.int32)
        last = begin + np.asarray(size, begin.dtype) - 1
        program = (task.start[:first], device)
        # One thread compiles; the others wait for it, and compile nothing.
        free = program in self._compiled_programs
        with jax.default_device(device), contextlib.nullcontext() if free else self._locks[program]:
            results = jax.block_until_ready(_compute(lanes, chunk, begin, last))
        self._compiled_programs.add(program)
        cut = tuple(slice(n) for n in size)
        boxes = {n: np.asarray(x).reshape((*chunk, *x.shape[1:]))[cut] for n, x in results.items()}
        return {n: x.reshape((*task.size, *x.shape[len(size) :])) for n, x in boxes.items()}

    def steps(self, task: SweepTask) -> int:
        """The number of steps of each trajectory of a task."""
        steps = self.sweep.value(self.sweep.num_steps, task.start)
        return self.sweep.most_steps if steps is None else steps


def trace(sweep: Sweep) -> tuple[dict[str, Any], list[ClosedJaxpr]]:
    """Shape and dtype of each variable of a trajectory; its programs, by method and num_steps."""
    shapes: dict[str, Any] = {}
    programs, kinds = [], set()
    zeros = tuple(np.zeros((), np.int32) for _ in sweep.of_grid)
    for indices in np.ndindex(*list(sweep.dims.values())[: sweep.compiled_dims]):
        start = (*(int(k) for k in indices), *(0 for _ in sweep.of_grid))
        lanes = lanes_of(sweep, start, lambda axis: jnp.asarray(axis.values[:1]))
        trajectory = functools.partial(Lanes.one_trajectory, lanes)
        program, shapes = jax.make_jaxpr(trajectory, return_shape=True)(zeros, zeros)
        programs.append(program)
        kinds.add(tuple((name, str(x.shape), str(x.dtype)) for name, x in shapes.items()))
        if len(kinds) > 1:
            name, *_ = min(set.symmetric_difference(*map(set, kinds)))
            texts = sorted(" ".join(x[1:]) for kind in kinds for x in kind if x[0] == name)
            raise ValueError(
                f"{name!r} must have one shape and dtype for all values of method and num_steps, "
                f"got {' and '.join(texts)}: use dvi.Save(final=True) or dvi.Save(ts=...)."
            )
    return shapes, programs
