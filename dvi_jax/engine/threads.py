"""A batch cut into pieces, each in a thread of its own."""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp

from lanewise.jaxapi import is_traced, x64_enabled


def over_threads(
    function: Callable[..., Any],
    threads: int | None = None,
    in_axes: int | Sequence[int | None] | None = 0,
    out_axes: int = 0,
) -> Callable[..., Any]:
    """The batched, jitted `function` on pieces of its batch at the same time, one to a thread.

    ``over_threads(jax.jit(jax.vmap(one)))(q0, p0)`` gives what ``jax.jit(jax.vmap(one))(q0, p0)``
    does: a compiled loop over steps runs on one core, this takes all of them.

    **Arguments**

    - `function`: compiled (`jax.jit`), with lanes that do not depend on each other. It is called
      with pieces of one size; the last is filled up with copies of the last lane.
    - `threads`: pieces, and threads; None means the processors that this process may use.
    - `in_axes`: the axis of lanes of all arguments, or of each; None where one has no lanes.
    - `out_axes`: that of every output array.

    **Returns** a function like `function`; it waits for the result.

    **Raises** `ValueError` for arguments without lanes or with different numbers of them, and
    under jit, vmap or grad, which belong inside of `function`; `TypeError` for settings of another
    type.

    **Example**

    ```python
    kepler = systems.kepler()
    def final(epsilon):
        return dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.1,
                             num_steps=1000, epsilon=epsilon, save=dvi.Save(final=True)).qs[-1]
    print(dvi.over_threads(jax.jit(jax.vmap(final)))(jnp.linspace(0.0, 0.01, 64)).shape)
    # (64, 2)
    ```
    """
    if not callable(function):
        raise TypeError(
            f"over_threads takes a function, e.g. jax.jit(jax.vmap(one)), got {function!r}."
        )
    if threads is None:
        threads = processors()
    if isinstance(threads, bool) or not isinstance(threads, int):
        raise TypeError(f"threads must be a whole number or None, got {threads!r}.")
    if threads < 1:
        raise ValueError(f"threads must be at least 1, got {threads}.")
    count = threads
    known: set[Any] = set()

    def call(*args: Any) -> Any:
        leaves, axes, tree = _with_axes(args, in_axes)
        lanes, x64 = _lanes(leaves, axes), x64_enabled()
        size = math.ceil(lanes / min(count, lanes))
        starts = range(0, lanes, size)

        def piece(start: int) -> Any:
            mine = [
                x if a is None else _cut(x, a, start, size)
                for x, a in zip(leaves, axes, strict=True)
            ]
            with jax.enable_x64(x64):  # a context of the caller's, which threads do not inherit
                return jax.block_until_ready(function(*jax.tree.unflatten(tree, mine)))

        like = (tree, size, tuple((jnp.shape(x), jnp.result_type(x)) for x in leaves))
        # What has not been compiled yet is compiled by one of the threads.
        first = [] if like in known else [piece(0)]
        known.add(like)
        with ThreadPoolExecutor(count) as pool:
            outs = [*first, *pool.map(piece, starts[len(first) :])]
        if len(outs) == 1:
            return outs[0]
        return jax.tree.map(lambda *xs: _joined(xs, out_axes, lanes), *outs)

    return call


def processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _with_axes(args: tuple, in_axes: Any) -> tuple[list[Any], list[int | None], Any]:
    """The leaves of the arguments, the axis of lanes of each, and the tree."""
    each = [in_axes] * len(args) if isinstance(in_axes, int | None) else list(in_axes)
    if len(each) != len(args):
        raise ValueError(
            f"in_axes has {len(each)} entries for {len(args)} arguments: give one for each, or "
            "one number for all."
        )
    for axis in each:
        if axis is not None and (isinstance(axis, bool) or not isinstance(axis, int)):
            raise TypeError(f"an axis of lanes is a whole number or None, got {axis!r}.")
    axes = []
    for argument, axis in zip(args, each, strict=True):
        axes += [axis] * len(jax.tree.leaves(argument))
    leaves, tree = jax.tree.flatten(args)
    if any(is_traced(x) for x in leaves):
        raise ValueError(
            "over_threads cuts arrays that are there, but was called under jit, vmap or grad: put "
            "those inside, over_threads(jax.jit(jax.vmap(jax.grad(loss))))."
        )
    return leaves, axes, tree


def _lanes(leaves: list[Any], axes: list[int | None]) -> int:
    found = {}
    for x, axis in zip(leaves, axes, strict=True):
        if axis is None:
            continue
        shape = jnp.shape(x)
        if not -len(shape) <= axis < len(shape):
            raise ValueError(
                f"in_axes says that lanes are along axis {axis}, but an argument has shape "
                f"{shape}: give None for arguments without lanes."
            )
        found[shape[axis]] = shape
    if len(found) != 1:
        raise ValueError(
            "the arguments must have one number of lanes, got "
            + (" and ".join(f"{n} (shape {s})" for n, s in found.items()) or "none with lanes")
            + "."
        )
    (lanes,) = found
    if lanes == 0:
        raise ValueError("there are no lanes: a batch must have at least one.")
    return lanes


def _cut(x: Any, axis: int, start: int, size: int) -> Any:
    """`size` lanes from number `start`, the last lane again where there are no more."""
    x = jnp.asarray(x)
    piece = jax.lax.slice_in_dim(x, start, min(start + size, x.shape[axis]), axis=axis)
    missing = size - piece.shape[axis]
    if not missing:
        return piece
    last = jax.lax.slice_in_dim(x, -1, None, axis=axis)
    return jnp.concatenate([piece, *[last] * missing], axis=axis)


def _joined(xs: Sequence[Any], axis: int, lanes: int) -> Any:
    if not -jnp.ndim(xs[0]) <= axis < jnp.ndim(xs[0]):
        raise ValueError(
            f"out_axes says that lanes are along axis {axis}, but an output has shape "
            f"{jnp.shape(xs[0])} for {lanes} lanes: give the axis along which function has them."
        )
    return jax.lax.slice_in_dim(jnp.concatenate(xs, axis), 0, lanes, axis=axis)
