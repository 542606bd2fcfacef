"""What lanes that run together agree upon: how long a loop runs, never what a lane computes."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._compat import primitive


def least_over_lanes(x: Int[Array, ""]) -> Int[Array, ""]:
    """The least x of the lanes that run together; x itself for one that runs alone.

    A result must not depend on it, or a lane would depend on its neighbours.
    """
    return _least.bind(x)


def on_any_lane(x: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether x is true on any of the lanes that run together."""
    return least_over_lanes(jnp.where(x, 0, 1)) == 0


def _batched(arrays, axes):
    (x,), (axis,) = arrays, axes
    return _least.bind(jnp.min(x, axis=axis)), None


_least = primitive("least_over_lanes", lambda x: x, _batched)

AGREED = frozenset(["least_over_lanes"])
"""Primitives whose result is the same on all lanes, whatever goes in."""
