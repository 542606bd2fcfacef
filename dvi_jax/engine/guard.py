"""Functions that are constants, for derivatives, where a trajectory has failed or ended.

After its end a trajectory is NaN, and so are the derivatives there. A loss that does not use them
has the cotangent zero, and zero times NaN would be NaN.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from lanewise.jaxprs.jaxapi import linear_map, with_equal_axes
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
    def variable(x: Any) -> Any:
        is_variable = jnp.issubdtype(jnp.result_type(x), jnp.inexact)
        return jnp.where(good, x, lax.stop_gradient(x)) if is_variable else x

    def result_of(outs: list[Any]) -> Any:
        return jax.tree.unflatten(trace.out_tree, outs)

    inputs = list(map(variable, [*trace.outer, *leaves]))
    if succeeds is None:
        return result_of(trace(*inputs))
    value = jax.custom_jvp(trace.__call__)

    @value.defjvp
    def _(inputs, changes):
        outs, push = jax.linearize(trace, *inputs)
        is_good = succeeds(result_of(outs))

        def guarded(change: Any) -> Any:
            is_variable = change.dtype != jax.dtypes.float0
            return jnp.where(is_good, change, jnp.zeros_like(change)) if is_variable else change

        return outs, push(*map(guarded, changes))

    return result_of(value(*inputs))


def all_finite(values: Any) -> Bool[Array, ""]:
    """Whether all arrays of a tree are finite."""
    finite = jax.tree.map(lambda x: jnp.all(jnp.isfinite(x)), values)
    return jax.tree.reduce(jnp.logical_and, finite)


def nan_if_used(values: Any, inputs: Any) -> Any:
    """The floating-point arrays `values`. If a loss depends on one of them that is NaN, its
    gradient by all `inputs` is NaN: zero would hide that the loss is not a number."""

    @jax.custom_jvp
    def same(values, inputs):
        return values

    def push(values, changes):
        return changes[0]

    def pull(values, cotangents):
        uses = jax.tree.map(lambda x, c: jnp.any(jnp.isnan(x) & (c != 0)), values, cotangents)
        is_nan = jnp.any(jnp.asarray(jax.tree.leaves(uses), bool))
        of_inputs = [jnp.where(is_nan, jnp.full_like(x, jnp.nan), 0) for x in like]
        return cotangents, jax.tree.unflatten(tree, of_inputs)

    values, inputs = with_equal_axes((values, inputs))
    leaves, tree = jax.tree.flatten(inputs)
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]

    @same.defjvp
    def _(primals, tangents):
        return primals[0], linear_map(push, pull, push, primals[0], tangents)

    return same(values, inputs)
