"""A linear map with a transpose of its own, compiled to machine code."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax import Array

from .jaxprs.jaxapi import (
    ClosedJaxpr,
    batch_in_front,
    drops_outputs,
    has_derivative,
    is_split,
    jaxpr_as_fun,
    linear_map,
    primitive,
    without_outputs,
)
from .primitive import AUTO, Layout, call


class LinearMap(NamedTuple):
    """The linear map L with L·x = ``push(*point, x)`` and Lᵀ·y = ``pull(*point, record, y)``.

    `push` and `pull` are functions of one trajectory. `point`: the arrays that L depends on;
    derivatives by them are those of `push`. `record`: what only the transpose needs, such as
    intermediate values.
    """

    push: Callable
    pull: Callable
    layout: Layout = AUTO

    def __call__(self, point: tuple, record: Any, x: Any) -> Any:
        """L·x, which JAX transposes by `pull`."""

        def definition(residuals, x):
            return self.push(*residuals[0], x)

        def push(residuals, x):
            return call(self.push, *residuals[0], x, layout=self.layout)

        def pull(residuals, y):
            return call(self.pull, *residuals[0], residuals[1], y, layout=self.layout)

        return linear_map(push, pull, definition, (point, record), x)


def with_change(value: Callable, change: Callable, pair: Callable, point: Any, x: Any) -> Any:
    """(y, L·x) with y = ``value(point)`` and L·x = ``change(point, y, x)``, linear in x.

    Forward mode computes them as ``pair(point, x)``, in one loop, where two calls would follow the
    trajectory twice. Reverse mode computes `value` alone, and the transpose of `change` later.
    """
    trees: list[Any] = []

    def flat(function: Callable, *structures: Any) -> Callable:
        def of_row(*arrays):
            row = iter(arrays)
            parts = [itertools.islice(row, structure.num_leaves) for structure in structures]
            out = function(*map(jax.tree.unflatten, structures, parts))
            leaves, tree = jax.tree.flatten(out)
            trees.append(tree)
            return leaves

        return of_row

    points, of_point = jax.tree.flatten(point)
    vectors, of_x = jax.tree.flatten(x)
    values = jax.make_jaxpr(flat(value, of_point))(*points)
    of_change = flat(change, of_point, trees[-1], of_x)
    functions = _Functions(values, of_change, flat(pair, of_point, of_x))
    selection = tuple(True for _ in jax.eval_shape(functions.pair, *points, *vectors))
    tree = trees[-1]
    outs = _with_change.bind(*points, *vectors, functions=functions, selection=selection)
    return jax.tree.unflatten(tree, outs)


class _Functions(NamedTuple):
    """Of rows of arrays: ``value(*points)``, ``change(*points, *values, *vectors)``, and
    ``pair(*points, *vectors)`` → values and changes."""

    value: ClosedJaxpr
    change: Callable
    pair: Callable


def _pair(*operands, functions: _Functions, selection: tuple[bool, ...]) -> list[Array]:
    pair = jax.make_jaxpr(functions.pair)(*operands)
    return jaxpr_as_fun(without_outputs(pair, [*selection]))(*operands)


def _apart(*operands, functions: _Functions, selection: tuple[bool, ...]) -> list[Array]:
    points = operands[: len(functions.value.in_avals)]
    values = jaxpr_as_fun(functions.value)(*points)
    changes = functions.change(*points, *values, *operands[len(points) :])
    return list(itertools.compress([*values, *changes], selection))


def _batch_rule(operands, axes, *, functions: _Functions, selection: tuple[bool, ...]):
    size, operands, axes = batch_in_front(operands, axes)
    value, change, pair = functions
    count, number = len(value.in_avals), len(value.out_avals)
    if all(axis is None for axis in axes[:count]):
        # Several directions at one point: the values are computed once.
        values = jaxpr_as_fun(value)(*operands[:count])
        of_change = jax.vmap(change, [*[None] * (count + number), *axes[count:]], axis_size=size)
        changes = of_change(*operands[:count], *values, *operands[count:])
        all_axes = [*[None] * number, *[0] * len(changes)]
        return [list(itertools.compress(row, selection)) for row in ([*values, *changes], all_axes)]
    values = jax.vmap(jaxpr_as_fun(value), axes[:count], axis_size=size)
    new = _Functions(
        jax.make_jaxpr(values)(*operands[:count]),
        jax.vmap(change, [*axes[:count], *[0] * number, *axes[count:]], axis_size=size),
        jax.vmap(pair, axes, axis_size=size),
    )
    outs = _with_change.bind(*operands, functions=new, selection=selection)
    return outs, [0] * len(outs)


def _derivative(operands, changes: dict[int, Array], **params):
    def of_moving(*moving):
        new = dict(zip(changes, moving, strict=True))
        return _apart(*(new.get(i, x) for i, x in enumerate(operands)), **params)

    outs, tangents = jax.jvp(of_moving, [operands[i] for i in changes], [*changes.values()])
    return outs, [None if t.dtype == jax.dtypes.float0 else t for t in tangents]


def _with_outputs(params: dict[str, Any], flags: list[bool]) -> dict[str, Any]:
    choices = iter(flags)
    return params | {"selection": tuple(flag and next(choices) for flag in params["selection"])}


def _values(functions: _Functions, selection: tuple[bool, ...]) -> ClosedJaxpr:
    return without_outputs(functions.value, [*selection[: len(functions.value.out_avals)]])


_with_change = primitive("with_change", _pair, _batch_rule, multiple=True)
has_derivative(_with_change, _derivative)
drops_outputs(_with_change, _with_outputs)
is_split(_with_change, _apart, _values)
