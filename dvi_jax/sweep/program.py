"""The compiled function that computes one task."""

import functools
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._compat import x64_enabled
from .._integrate import integrate
from .._results import status_code
from .._solution import Save, Solution
from ..engine.cpu import OPTIONS, takes_options
from ..observe import Reduction
from .axes import is_axis, place
from .plan import Plan, Task
from .starts import Starts

RESERVED = ("status", "failed_step", "residual", "t", "q", "p", "save", "q0", "p0")
"""Names in a result that are not the user's to give."""


@dataclass(frozen=True)
class Variable:
    """One array of a result: dtype and, behind the dimensions of the grid, its own."""

    dtype: str
    shape: tuple[int, ...] = ()
    dims: tuple[str, ...] = ()

    @property
    def bytes(self) -> int:
        """For one trajectory."""
        return int(np.dtype(self.dtype).itemsize * np.prod(self.shape, dtype=int))

    @property
    def fill(self) -> Any:
        """What stands where nothing has been computed."""
        return np.nan if np.dtype(self.dtype).kind in "fc" else -1


@dataclass(frozen=True, eq=False)
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


def lane(sweep: Sweep, method: Any, num_steps: int | None, values: Any, at: Any) -> dict[str, Any]:
    """One trajectory: the variables of its result. `at` are its indices, one for each dimension of
    `sweep.of_grid`: in `values` that of the task, for the starts that of the whole sweep."""
    inside, index = at
    where = dict(zip(sweep.of_grid, inside, strict=True))

    def pick(leaf: Any, value: Any) -> Any:
        if not is_axis(leaf):
            return leaf
        return value[where[leaf.name]] if leaf.name in where else value

    inputs = jax.tree.map(pick, dict(sweep.inputs), values, is_leaf=is_axis)
    if sweep.start is None:
        q0, p0 = (_stacked(inputs.pop(name)) for name in ("q0", "p0"))
    else:
        q0, p0 = sweep.start.at(index[sweep.of_grid.index(sweep.start.name)], inputs["t0"],
                                inputs["args"])  # fmt: skip
    save = sweep.options["save"]
    solution = integrate(
        sweep.system, q0, p0, **inputs, **{**sweep.options, "save": save or Save(final=True)},
        method=method, num_steps=num_steps, throw=False,
    )  # fmt: skip
    return outputs(solution, save is not None)


def _stacked(state: Any) -> Any:
    """A state given component by component."""
    if not isinstance(state, list | tuple):
        return state
    return jnp.stack([jnp.asarray(_stacked(x), jnp.result_type(float)) for x in state])


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
    """Computes tasks of a sweep. The functions are compiled once and for all threads."""

    def __init__(self, sweep: Sweep, plan: Plan):
        self.sweep, self.plan = sweep, plan
        self._functions: dict[Any, Any] = {}
        self._lock = threading.Lock()

    def __call__(self, task: Task, device: Any = None) -> dict[str, np.ndarray]:
        """The variables of a task, each of shape (*task.size, …), computed on a device."""
        sweep, first = self.sweep, self.sweep.compiled
        chunk, size = self.plan.chunk[first:], task.size[first:]
        names = sweep.of_grid

        def rows(leaf: Any) -> Any:
            if not is_axis(leaf):
                return None
            if leaf.name not in names:
                return leaf.values[task.start[list(sweep.dims).index(leaf.name)]]
            k = names.index(leaf.name)
            begin = task.start[first + k]
            values = np.asarray(leaf.values[begin : begin + size[k]])
            return np.concatenate([values, *[values[-1:]] * (chunk[k] - size[k])])

        values = jax.tree.map(rows, dict(sweep.inputs), is_leaf=is_axis)
        begin = np.asarray(task.start[first:], np.int64 if x64_enabled() else np.int32)
        last = begin + np.asarray(size, begin.dtype) - 1
        with jax.default_device(device):
            found = self._call(task, device, values, begin, last)
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

    def _call(self, task: Task, device: Any, *inputs: Any) -> Any:
        """The outputs of the compiled function; the first thread that needs one compiles it."""
        sweep = self.sweep
        which = task.start[: sweep.compiled]
        with self._lock:
            if which not in self._functions:
                method = sweep.value(sweep.method, task.start)
                steps = sweep.value(sweep.num_steps, task.start)
                one = functools.partial(lane, sweep, method, steps)
                function = functools.partial(_batch, one, self.plan.chunk[sweep.compiled :])
                options = OPTIONS if takes_options() else None
                compiled = jax.jit(function, compiler_options=options)
                self._functions[which] = compiled, threading.Lock(), set()
        function, lock, ready = self._functions[which]
        if device not in ready:
            with lock:
                found = jax.block_until_ready(function(*inputs))
                ready.add(device)
            return found
        return function(*inputs)


def shapes(sweep: Sweep) -> dict[str, Any]:
    """Shape and dtype of the variables of one trajectory, traced, not computed.

    **Raises** `ValueError` where they differ between methods or numbers of steps.
    """
    found: dict[str, Any] = {}
    for which in np.ndindex(*list(sweep.dims.values())[: sweep.compiled]):
        start = (*(int(k) for k in which), *(0 for _ in sweep.of_grid))
        method, steps = (sweep.value(x, start) for x in (sweep.method, sweep.num_steps))
        values = jax.tree.map(
            lambda leaf: _first(leaf, sweep.of_grid), dict(sweep.inputs), is_leaf=is_axis
        )
        one = functools.partial(lane, sweep, method, steps)
        zeros = tuple(np.zeros((), np.int32) for _ in sweep.of_grid)
        out = jax.eval_shape(one, values, (zeros, zeros))
        if found and {k: (v.shape, v.dtype) for k, v in out.items()} != {
            k: (v.shape, v.dtype) for k, v in found.items()
        }:
            raise ValueError(
                "the results of all values of method and num_steps must have one shape: with "
                "several num_steps keep the final state alone, save=dvi.Save(final=True), or "
                "times, Save(ts=...)."
            )
        found = out
    return found


def _first(leaf: Any, of_grid: list[str]) -> Any:
    if not is_axis(leaf):
        return None
    return leaf.values[:1] if leaf.name in of_grid else leaf.values[0]


def _batch(one: Any, chunk: tuple[int, ...], values: Any, begin: Any, last: Any) -> dict[str, Any]:
    """All lanes of a task, in the order of its box; lanes beyond its end are those at the end."""
    lanes = int(np.prod(chunk, dtype=int))
    inside, stride = [], lanes
    for c in chunk:
        stride //= c
        inside.append((np.arange(lanes, dtype=np.int32) // stride) % c)
    index = [jnp.minimum(i + b, e) for i, b, e in zip(inside, begin, last, strict=True)]
    if not chunk:
        return jax.tree.map(lambda x: x[None], one(values, ((), ())))
    return jax.vmap(one, in_axes=(None, 0))(values, (tuple(inside), tuple(index)))


def variables(sweep: Sweep, shapes: Mapping[str, Any]) -> dict[str, Variable]:
    """The arrays of a result, with names for their own dimensions.

    **Raises** `ValueError` for an observable with a name that is taken, `TypeError` for one that
    is not real or complex.
    """
    given = {
        place(path) or "observed"
        for path, _ in jax.tree.leaves_with_path(
            sweep.options["observe"], is_leaf=lambda x: isinstance(x, Reduction)
        )
    }
    taken = [n for n in given if n.split(".")[0] in RESERVED or n in sweep.dims]
    if taken:
        raise ValueError(
            f"the observable {taken[0]!r} has a name that the result needs for something else "
            f"({', '.join(dict.fromkeys((*RESERVED, *sweep.dims)))}): give it another."
        )
    found = {}
    alone = _alone(sweep)
    for name, x in shapes.items():
        dims: list[str] = []
        rest = x.shape
        if name in ("t", "q", "p"):
            dims, rest = ["save"], rest[1:]
        elif name in alone:
            dims, rest = [alone[name]], rest[1:]
        if name in ("q", "p"):
            dims += own_dims("component", rest)
        else:
            dims += own_dims(f"{name}_dim", rest)
        dtype = np.dtype(x.dtype)
        if dtype.kind not in "iufbc":
            raise TypeError(f"the observable {name!r} has dtype {dtype}: it must be a number.")
        found[name] = Variable("int8" if dtype.kind == "b" else dtype.name, x.shape, tuple(dims))
    return found


def _alone(sweep: Sweep) -> dict[str, str]:
    """The observables that stand alone, and the dimension of their rows: steps that end at a save
    point, one less than states but for ``Save(ts=...)``."""
    save = sweep.options["save"]
    rows = "save" if save is not None and save.ts is not None else "saved_step"
    leaves = jax.tree.leaves_with_path(
        sweep.options["observe"], is_leaf=lambda x: isinstance(x, Reduction)
    )
    return {place(path) or "observed": rows for path, f in leaves if not isinstance(f, Reduction)}


def own_dims(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names for the dimensions of an array that are not those of the grid."""
    return [name] if len(shape) == 1 else [f"{name}_{i}" for i in range(len(shape))]
