"""Functions that are constants, for derivatives, where a trajectory has failed or ended.

After its end a trajectory is NaN, and so are the derivatives there. A loss that does not use them
has the cotangent zero, and zero times NaN would be NaN.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from lanewise.jaxprs.jaxapi import (
    broadcast_in_front,
    has_derivative,
    jaxpr_as_fun,
    linear_map,
    manual_axes,
    primitive,
    with_equal_axes,
)
from lanewise.jaxprs.traced import Trace


def constant_unless(
    good: Bool[Array, ""], function: Callable, *args: Any, succeeds: Callable | None = None
) -> Any:
    """``function(*args)``, whose derivative is zero where `good` is False: by the arguments and by
    all that the function closes over.

    With `succeeds` the first derivative is also zero where ``succeeds(result)`` is False.
    """
    leaves, tree = jax.tree.flatten(args)
    trace = Trace.from_function(function, leaves, tree)
    inputs = [*trace.outer, *leaves]

    def result_of(outs: list[Any]) -> Any:
        return jax.tree.unflatten(trace.out_tree, outs)

    def is_good(good, outs):
        return good if succeeds is None else good & succeeds(result_of(outs))

    # A primitive of its own: loops and checkpoints lose the rule of a `custom_jvp` when they split
    # a program, in second derivatives too.
    program = jax.make_jaxpr(lambda good, *inputs: trace(*inputs))(good, *inputs)
    return result_of(_guarded.bind(good, *inputs, program=program, is_good=is_good))


def _values(*operands: Array, program: Any, is_good: Callable) -> list[Array]:
    return jaxpr_as_fun(program)(*operands)


def _batch_rule(operands, axes, *, program: Any, is_good: Callable):
    # The batch is formed now: in a derivative that is taken later `lax.cond` is a selection. (JAX
    # forms the batch of a `custom_jvp` rule after it, and has no transpose of the result.)
    size, operands = broadcast_in_front(operands, axes)
    of_batch = jax.make_jaxpr(jax.vmap(jaxpr_as_fun(program), axis_size=size))(*operands)
    outs = _guarded.bind(*operands, program=of_batch, is_good=jax.vmap(is_good))
    return outs, [0] * len(outs)


def _derivative(operands, changes: dict[int, Array], *, program: Any, is_good: Callable):
    def where(good: Array, x: Array, other: Any) -> Array:
        return jnp.where(jnp.expand_dims(good, range(good.ndim, x.ndim)), x, other)

    # Inputs without a change, such as h in most runs, need no derivative: it would take time.
    def of_variables(*variables):
        new = dict(zip(changes, variables, strict=True))
        return jaxpr_as_fun(program)(*(new.get(i, x) for i, x in enumerate(operands)))

    # The derivative is set to zero at the inputs: at the outputs it would be multiplied by NaN
    # afterwards. Second derivatives need constants at the point itself.
    good, points = operands[0], [operands[i] for i in changes]
    points = [where(good, x, lax.stop_gradient(x)) for x in points]
    outs, push = jax.linearize(of_variables, *points)
    good = is_good(good, outs)
    return outs, push(*(where(good, change, 0) for change in changes.values()))


_guarded = primitive("constant_unless", _values, _batch_rule, multiple=True)
has_derivative(_guarded, _derivative)


def all_finite(values: Any) -> Bool[Array, ""]:
    """Whether all arrays of a tree are finite."""
    finite = jax.tree.map(lambda x: jnp.all(jnp.isfinite(x)), values)
    return jax.tree.reduce(jnp.logical_and, finite)


def nan_where_used(function: Callable, *args: Any) -> Any:
    """``function(*args)``. If a loss depends on a value of it that is not finite, its gradient by
    all inputs is NaN, by what the function closes over too, and so is the derivative of this value
    in forward mode: zero would hide that the loss is not a number."""
    leaves, tree = jax.tree.flatten(args)
    trace = Trace.from_function(function, leaves, tree)
    inputs = [*trace.outer, *leaves]
    # The trace is that of one device: inside of `jax.shard_map` types of results depend on others.
    values = jax.tree.leaves(function(*args)) if manual_axes(*inputs) else trace(*inputs)
    smooth, others = eqx.partition(values, eqx.is_inexact_array)
    # Each value for itself: those that nobody uses are not computed.
    inputs = eqx.filter(inputs, eqx.is_inexact_array)
    smooth = jax.tree.map(lambda value: _nan_if_used(value, inputs), smooth)
    return jax.tree.unflatten(trace.out_tree, eqx.combine(smooth, others))


def _nan_if_used(values: Any, inputs: Any) -> Any:
    """The floating-point `values`, with the derivative of `nan_where_used` by `inputs`."""

    @jax.custom_jvp
    def same(values, inputs):
        return values

    def push(values, changes):
        of_values, of_inputs = changes
        moves = _any_of(lambda x: x != 0, of_inputs)
        return jax.tree.map(
            lambda x, c: jnp.where(jnp.isfinite(x) | ~moves, c, jnp.nan), values, of_values
        )

    def pull(values, cotangents):
        is_used = _any_of(lambda x, c: ~jnp.isfinite(x) & (c != 0), values, cotangents)
        of_input = lambda x: jnp.where(is_used, jnp.full(x.shape, jnp.nan, x.dtype), 0)  # noqa: E731
        return cotangents, jax.tree.map(of_input, like)

    def define(values, changes):
        return changes[0]

    values, inputs = with_equal_axes((values, inputs))
    like = jax.eval_shape(lambda: inputs)

    @same.defjvp
    def _(primals, tangents):
        return primals[0], linear_map(push, pull, define, primals[0], tangents)

    return same(values, inputs)


def without_derivative(values: Any) -> Any:
    """The floating-point `values`; a loss that depends on them has the gradient NaN, and a change
    of them in forward mode is NaN."""

    def nan_unless_zero(_, changes):
        return jax.tree.map(lambda c: jnp.where(c == 0, c, jnp.nan), changes)

    def define(_, changes):
        return changes

    same = jax.custom_jvp(lambda values: values)

    @same.defjvp
    def _(primals, tangents):
        return primals[0], linear_map(nan_unless_zero, nan_unless_zero, define, (), tangents[0])

    return same(values)


def _any_of(condition: Callable, *trees: Any) -> Array:
    """Whether the condition is true of a number in the arrays of these trees."""
    parts = jax.tree.map(lambda *xs: jnp.any(condition(*xs)), *trees)
    return jnp.any(jnp.asarray(jax.tree.leaves(parts), bool))
