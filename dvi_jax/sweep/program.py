"""The compiled function that computes one task."""

import collections
import contextlib
import dataclasses
import functools
import threading
from collections.abc import Mapping
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
from .plan import Plan, Task
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
    compiled: int

    @property
    def of_grid(self) -> list[str]:
        """The dimensions of which the values are not compiled separately."""
        return list(self.dims)[self.compiled :]

    def value(self, which: Any, start: tuple[int, ...]) -> Any:
        """The method, or the number of steps, of the task that begins at this index."""
        if not is_axis(which):
            return which
        value = which.values[start[list(self.dims).index(which.name)]]
        return int(value) if isinstance(value, np.integer) else value

    @property
    def most_steps(self) -> int:
        n = self.num_steps
        if n is None:
            return len(self.options["lattice"].ts) - 1
        return max(int(v) for v in n.values) if is_axis(n) else n


class Rows(eqx.Module):
    """The values of an axis in one task; `name` is that of its dimension."""

    values: Any
    name: str = eqx.field(static=True)


def _is_rows(x: Any) -> bool:
    return isinstance(x, Rows)


class Lanes(eqx.Module):
    """The trajectories of a task as one pytree: `Rows` in the inputs differ between them.

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

    def one(self, inside: tuple[Any, ...], index: tuple[Any, ...]) -> dict[str, Any]:
        """The variables of one trajectory. `inside`: its index along each dimension of the task;
        `index`: that in the whole sweep."""
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
            q0, p0, *own = self.start.at(number, t0, inputs["args"])
            inputs["args"] = own[0] if own else inputs["args"]
        save = self.options["save"]
        options = {**self.options, "save": save or Save(final=True)}
        options |= {"method": self.method, "num_steps": self.num_steps, "throw": False}
        solution = integrate(self.system, q0, p0, **inputs, **options)
        leaves = jax.tree.leaves_with_path(solution.observed)
        found = {place(path) or "observed": value for path, value in leaves}
        if save is not None:
            found |= {"t": solution.ts, "q": solution.qs, "p": solution.ps}
        if solution.stop is not None:
            found["stop_t"] = solution.stop.t
        return found | {
            "status": status_code(solution.result).astype(jnp.int8),
            "failed_step": solution.stats["failed_step"],
            "residual": solution.stats["max_residual"],
        }


def lanes_of(sweep: Sweep, task_start: tuple[int, ...], values: Any) -> Lanes:
    """The trajectories of the task that begins at this index; `values`: the rows of an axis."""

    def known(leaf: Any) -> Any:
        if not is_axis(leaf):
            return leaf
        if leaf.name in sweep.of_grid:
            return Rows(values(leaf), leaf.name)
        return leaf.values[task_start[list(sweep.dims).index(leaf.name)]]

    inputs = jax.tree.map(known, dict(sweep.inputs), is_leaf=is_axis)
    method, steps = (sweep.value(x, task_start) for x in (sweep.method, sweep.num_steps))
    rest = dict(sweep.options), steps, tuple(sweep.of_grid), reads(*sweep.options.values())
    return Lanes(sweep.system, inputs, sweep.start, method, *rest)


def _batch(lanes: Lanes, chunk: tuple[int, ...], begin: Any, last: Any) -> dict[str, Any]:
    """All trajectories of a task, in the order of its box. Those beyond the end of the grid repeat
    the last one, so that every task has the shape for which the program is compiled."""
    if not chunk:
        return jax.tree.map(lambda x: x[None], lanes.one((), ()))
    count = stride = int(np.prod(chunk, dtype=int))
    inside = []
    for c in chunk:
        stride //= c
        inside.append((np.arange(count, dtype=np.int32) // stride) % c)
    index = [jnp.minimum(i + b, e) for i, b, e in zip(inside, begin, last, strict=True)]
    return jax.vmap(lanes.one)(tuple(inside), tuple(index))


_compiled: Any = eqx.filter_jit(_batch)


def stacked(state: Any) -> Any:
    """A state given component by component."""
    if not isinstance(state, list | tuple):
        return state
    return jnp.stack([jnp.asarray(stacked(x), jnp.result_type(float)) for x in state])


class Program:
    """Computes tasks of a sweep."""

    def __init__(self, sweep: Sweep, plan: Plan):
        self.sweep, self.plan = sweep, plan
        self._locks: dict[Any, threading.Lock] = collections.defaultdict(threading.Lock)
        self._compiled: set[Any] = set()

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
        numbers = jax.tree.map(  # as arrays: another h then needs no other program
            lambda x: np.asarray(x) if isinstance(x, float | np.generic) else x, lanes.inputs
        )
        lanes = dataclasses.replace(lanes, inputs=numbers)
        begin = np.asarray(task.start[first:], np.int64 if x64_enabled() else np.int32)
        last = begin + np.asarray(size, begin.dtype) - 1
        program = (task.start[:first], device)
        # One thread compiles; the others wait for it, and compile nothing.
        free = program in self._compiled
        with jax.default_device(device), contextlib.nullcontext() if free else self._locks[program]:
            found = jax.block_until_ready(_compiled(lanes, chunk, begin, last))
        self._compiled.add(program)
        cut = tuple(slice(n) for n in size)
        boxes = {n: np.asarray(x).reshape((*chunk, *x.shape[1:]))[cut] for n, x in found.items()}
        return {n: x.reshape((*task.size, *x.shape[len(size) :])) for n, x in boxes.items()}

    def steps(self, task: Task) -> int:
        """The number of steps of each trajectory of a task."""
        steps = self.sweep.value(self.sweep.num_steps, task.start)
        return self.sweep.most_steps if steps is None else steps


def traced(sweep: Sweep) -> tuple[dict[str, Any], list[ClosedJaxpr]]:
    """Shape and dtype of the variables of one trajectory, by tracing; and its program for each
    method and number of steps."""
    found: dict[str, Any] = {}
    programs, kinds = [], set()
    zeros = tuple(np.zeros((), np.int32) for _ in sweep.of_grid)
    for which in np.ndindex(*list(sweep.dims.values())[: sweep.compiled]):
        start = (*(int(k) for k in which), *(0 for _ in sweep.of_grid))
        lanes = lanes_of(sweep, start, lambda axis: jnp.asarray(axis.values[:1]))
        one = functools.partial(Lanes.one, lanes)
        program, out = jax.make_jaxpr(one, return_shape=True)(zeros, zeros)
        programs.append(program)
        kinds.add(tuple((name, x.shape, x.dtype) for name, x in out.items()))
        if len(kinds) > 1:
            differing = min(set.symmetric_difference(*map(set, kinds)))[0]
            seen = [f"shape {s} ({d})" for kind in kinds for n, s, d in kind if n == differing]
            raise ValueError(
                "each result must have the same shape and dtype for all values of method and "
                f"num_steps, but {differing!r} has {' and '.join(sorted(seen))}. For several "
                "values of num_steps use save=dvi.Save(final=True) or save=dvi.Save(ts=...). "
                "Otherwise call dvi.sweep separately for each value."
            )
        found = out
    return found, programs
