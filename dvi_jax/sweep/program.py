"""The compiled function that computes one task."""

import dataclasses
import functools
import threading
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lanewise.jaxapi import ClosedJaxpr, x64_enabled

from .._integrate import integrate
from .._results import status_code
from .._solution import Save, Solution
from ..engine.reads import Reads, reads
from ..lattices import Given
from .axes import is_axis, place
from .plan import Plan, Task
from .starts import Starts


@dataclasses.dataclass(frozen=True, eq=False)
class Sweep:
    """All that defines a sweep: what `integrate` takes, with axes in it.

    - `inputs`: h, t0, epsilon, args, and q0, p0 unless there is a `start`.
    - `options`: what else `integrate` takes. `method` and `num_steps` may be an `Axis`.
    """

    system: Any
    inputs: Mapping[str, Any]
    start: Starts | None
    method: Any
    num_steps: Any
    options: Mapping[str, Any]
    dims: Mapping[str, int]
    compiled: int

    @property
    def of_grid(self) -> list[str]:
        """The dimensions that are not compiled one value at a time."""
        return list(self.dims)[self.compiled :]

    def value(self, which: Any, start: tuple[int, ...]) -> Any:
        """The method, or the number of steps, of the task that begins there."""
        if not is_axis(which):
            return which
        value = which.values[start[list(self.dims).index(which.name)]]
        return int(value) if isinstance(value, np.integer) else value

    @property
    def most_steps(self) -> int:
        n = self.num_steps
        steps = max(int(v) for v in n.values) if is_axis(n) else n
        if steps is None:
            steps = len(self.options["lattice"].ts) - 1
        return steps


class Rows(eqx.Module):
    """The values of an axis in one task; `name` is that of its dimension."""

    values: Any
    name: str = eqx.field(static=True)


def _is_rows(x: Any) -> bool:
    return isinstance(x, Rows)


class Lanes(eqx.Module):
    """What the trajectories of a task have in common, as one pytree: `Rows` in the inputs vary.

    - `names`: the dimensions of the task. Its method and number of steps are one each.
    """

    system: Any
    inputs: dict[str, Any]
    start: Starts | None
    method: Any
    options: dict[str, Any]
    num_steps: int | None = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    reads: Reads = eqx.field(static=True)

    def one(self, inside: tuple[Any, ...], index: tuple[Any, ...]) -> dict[str, Any]:
        """One trajectory: the variables of its result. For each dimension `inside` is its index in
        the task, `index` that in the whole sweep."""
        where = dict(zip(self.names, inside, strict=True))
        inputs = jax.tree.map(
            lambda x: x.values[where[x.name]] if _is_rows(x) else x, self.inputs, is_leaf=_is_rows
        )
        if self.start is None:
            q0, p0 = (stacked(inputs.pop(name)) for name in ("q0", "p0"))
        else:
            number = index[self.names.index(self.start.name)]
            lattice = self.options["lattice"]
            t0 = lattice.ts[0] if isinstance(lattice, Given) else inputs["t0"]
            q0, p0 = self.start.at(number, t0, inputs["args"])
        save = self.options["save"]
        options = {**self.options, "save": save or Save(final=True)}
        options |= {"method": self.method, "num_steps": self.num_steps, "throw": False}
        return outputs(integrate(self.system, q0, p0, **inputs, **options), save is not None)


def lanes_of(sweep: Sweep, task_start: tuple[int, ...], values: Any) -> Lanes:
    """The trajectories of the task that begins there; `values` makes Rows of an axis."""

    def known(leaf: Any) -> Any:
        if not is_axis(leaf):
            return leaf
        if leaf.name in sweep.of_grid:
            return Rows(values(leaf), leaf.name)
        return leaf.values[task_start[list(sweep.dims).index(leaf.name)]]

    return Lanes(
        sweep.system,
        jax.tree.map(known, dict(sweep.inputs), is_leaf=is_axis),
        sweep.start,
        sweep.value(sweep.method, task_start),
        dict(sweep.options),
        sweep.value(sweep.num_steps, task_start),
        tuple(sweep.of_grid),
        reads(*sweep.options.values()),
    )


def _batch(lanes: Lanes, chunk: tuple[int, ...], begin: Any, last: Any) -> dict[str, Any]:
    """All lanes of a task, in the order of its box; lanes beyond its end are those at the end."""
    if not chunk:
        return jax.tree.map(lambda x: x[None], lanes.one((), ()))
    count = stride = int(np.prod(chunk, dtype=int))
    inside = []
    for c in chunk:
        stride //= c
        inside.append((np.arange(count, dtype=np.int32) // stride) % c)
    index = [jnp.minimum(i + b, e) for i, b, e in zip(inside, begin, last, strict=True)]
    return jax.vmap(lanes.one)(tuple(inside), tuple(index))


_filter_jit: Any = eqx.filter_jit  # its annotations leave out what goes on to jax.jit
_compiled = _filter_jit(_batch)


def stacked(state: Any) -> Any:
    """A state given component by component."""
    if not isinstance(state, list | tuple):
        return state
    return jnp.stack([jnp.asarray(stacked(x), jnp.result_type(float)) for x in state])


def outputs(solution: Solution, with_states: bool) -> dict[str, Any]:
    found = {
        place(path) or "observed": value
        for path, value in jax.tree.leaves_with_path(solution.observed)
    }
    if with_states:
        found |= {"t": solution.ts, "q": solution.qs, "p": solution.ps}
    return found | {
        "status": status_code(solution.result).astype(jnp.int8),
        "failed_step": solution.stats["failed_step"],
        "residual": solution.stats["max_residual"],
    }


class Program:
    """Computes tasks of a sweep; a function is compiled once, by the thread that needs it first."""

    def __init__(self, sweep: Sweep, plan: Plan):
        self.sweep, self.plan = sweep, plan
        self._ready: dict[Any, tuple[threading.Lock, list[bool]]] = {}
        self._lock = threading.Lock()

    def __call__(self, task: Task, device: Any = None) -> dict[str, np.ndarray]:
        """The variables of a task, each of shape (*task.size, …), computed on a device."""
        sweep, first = self.sweep, self.sweep.compiled
        chunk, size = self.plan.chunk[first:], task.size[first:]

        def rows(axis: Any) -> Any:
            k = sweep.of_grid.index(axis.name)
            begin = task.start[first + k]
            values = np.asarray(axis.values[begin : begin + size[k]])
            return np.concatenate([values, *[values[-1:]] * (chunk[k] - size[k])])

        lanes = lanes_of(sweep, task.start, rows)
        numbers = jax.tree.map(  # not compiled in: another h needs no other program
            lambda x: np.asarray(x) if isinstance(x, float | np.generic) else x, lanes.inputs
        )
        lanes = dataclasses.replace(lanes, inputs=numbers)
        begin = np.asarray(task.start[first:], np.int64 if x64_enabled() else np.int32)
        last = begin + np.asarray(size, begin.dtype) - 1
        with jax.default_device(device):
            found = self._call((task.start[:first], device), lanes, chunk, begin, last)
        cut = tuple(slice(n) for n in size)
        results = {}
        for name, x in found.items():
            own = x.shape[1:]
            box = np.asarray(x).reshape((*chunk, *own))[cut]
            results[name] = box.reshape((*task.size, *own))
        return results

    def steps(self, task: Task) -> int:
        """Of each trajectory of a task."""
        steps = self.sweep.value(self.sweep.num_steps, task.start)
        return self.sweep.most_steps if steps is None else steps

    def _call(self, which: Any, *inputs: Any) -> Any:
        function = _compiled
        with self._lock:
            first, ready = self._ready.setdefault(which, (threading.Lock(), []))
        if not ready:
            with first:
                found = jax.block_until_ready(function(*inputs))
                ready.append(True)
            return found
        return function(*inputs)


def traced(sweep: Sweep) -> tuple[dict[str, Any], list[ClosedJaxpr]]:
    """Shape and dtype of the variables of one trajectory, traced, not computed; and the programs
    of one, for each method and number of steps.

    **Raises** `ValueError` where they differ between methods or numbers of steps.
    """
    found: dict[str, Any] = {}
    programs = []
    zeros = tuple(np.zeros((), np.int32) for _ in sweep.of_grid)
    for which in np.ndindex(*list(sweep.dims.values())[: sweep.compiled]):
        start = (*(int(k) for k in which), *(0 for _ in sweep.of_grid))
        lanes = lanes_of(sweep, start, lambda axis: jnp.asarray(axis.values[:1]))
        one = functools.partial(_one, lanes)
        program, out = jax.make_jaxpr(one, return_shape=True)(zeros, zeros)
        programs.append(program)
        if found and {k: (v.shape, v.dtype) for k, v in out.items()} != {
            k: (v.shape, v.dtype) for k, v in found.items()
        }:
            raise ValueError(
                "the results of all values of method and num_steps must have one shape: with "
                "several num_steps keep the final state alone, save=dvi.Save(final=True), or "
                "times, Save(ts=...)."
            )
        found = out
    return found, programs


def _one(lanes: Lanes, inside: Any, index: Any) -> dict[str, Any]:
    return lanes.one(inside, index)
