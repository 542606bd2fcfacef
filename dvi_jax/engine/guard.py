"""Functions that are constants, for derivatives, where a trajectory has failed or ended.

After its end a trajectory is NaN, and so are the derivatives there. A loss that does not use them
has the cotangent zero, and zero times NaN would be NaN.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool

from lanewise.jaxprs.jaxapi import linear_map, manual_axes, with_equal_axes
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

    # The derivative is set to zero at the inputs: at the outputs it would be multiplied by NaN
    # afterwards. Values are the same on both sides of each choice, which costs nothing. (A rule of
    # its own for the derivative would be lost in second derivatives of a scan.)
    def selection(good: Any, inputs: Any) -> list[Any]:
        smooth, others = eqx.partition([*inputs], eqx.is_inexact_array)
        smooth = jax.tree.map(lambda x: jnp.where(good, x, lax.stop_gradient(x)), smooth)
        return eqx.combine(smooth, others)

    def guarded(good: Any, *inputs: Any) -> list[Any]:
        return trace(*selection(good, inputs))

    def result_of(outs: list[Any]) -> Any:
        return jax.tree.unflatten(trace.out_tree, outs)

    inputs = [*trace.outer, *leaves]
    if succeeds is None:
        return result_of(guarded(good, *inputs))
    value = jax.custom_jvp(guarded)

    # Inputs without a change, such as h in most runs, need no derivative: it would take time.
    @functools.partial(value.defjvp, symbolic_zeros=True)
    def _(primals, tangents):
        (good, *inputs), changes = primals, tangents[1:]
        values = selection(good, inputs)
        places = [i for i, x in enumerate(changes) if not isinstance(x, SymbolicZero)]

        def of_variables(*variables):
            new = dict(zip(places, variables, strict=True))
            return trace(*(new.get(i, x) for i, x in enumerate(values)))

        outs, push = jax.linearize(of_variables, *(values[i] for i in places))
        is_good = good & succeeds(result_of(outs))
        return outs, push(*(jnp.where(is_good, changes[i], 0) for i in places))

    return result_of(value(good, *inputs))


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
    smooth = _nan_if_used(smooth, eqx.filter(inputs, eqx.is_inexact_array))
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


def _any_of(condition: Callable, *trees: Any) -> Array:
    """Whether the condition is true of a number in the arrays of these trees."""
    parts = jax.tree.map(lambda *xs: jnp.any(condition(*xs)), *trees)
    return jnp.any(jnp.asarray(jax.tree.leaves(parts), bool))
