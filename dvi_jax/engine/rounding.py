"""A function whose operations are rounded one by one, however they are compiled.

A compiler may join a product and a sum into one operation that rounds once (FMA), or not, depending
on what stands around them: the same function then has other bits in another program.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .lanes import Evaluator
from .lanes._value import Entry, is_array, whole

_NEVER_JOINED = frozenset(
    ["abs", "add", "add_any", "convert_element_type", "max", "min", "neg", "select_n", "sub"]
)
"""Operations whose result may enter a sum as it is."""


def one_by_one(function: Callable[..., jax.Array], like: jax.Array, *args: Any) -> jax.Array:
    """``function(*args)``, an array, each of its operations on numbers rounded by itself.

    `like` is one of the arguments, real numbers not known while it is compiled.
    """
    arrays, rest = eqx.partition(args, eqx.is_array)
    leaves, tree = jax.tree.flatten(arrays)

    def flat(*leaves):
        return function(*eqx.combine(jax.tree.unflatten(tree, leaves), rest))

    closed = jax.make_jaxpr(flat)(*leaves)
    # Nought, which the compiler cannot know; a state that is NaN may lose its bits.
    nought = jnp.isnan(lax.stop_gradient(like).ravel()[0])
    (value,) = _OneByOne(nought).closed(closed, [whole(x, False) for x in leaves])
    return jnp.asarray(value.array()[0])


class _OneByOne(Evaluator):
    """Component form of a single lane, its products kept from being joined with sums."""

    def __init__(self, nought: jax.Array):
        super().__init__(None, {})
        self.in_kernel = True  # of what it is a part of
        self.nought = nought

    def _operate(self, eqn: Any, entries: list[Entry], dtypes: list[Any]) -> Entry:
        result = super()._operate(eqn, entries, dtypes)
        return result if eqn.primitive.name in _NEVER_JOINED else self._rounded(result)

    def _pairwise(self, operation: Callable, dtype: Any) -> Callable[[Entry, Entry], Entry]:
        combine = super()._pairwise(operation, dtype)
        if operation not in (lax.mul, lax.div):
            return combine
        return lambda a, b: self._rounded(combine(a, b))

    def _rounded(self, x: Entry) -> Entry:
        if is_array(x) and x.dtype in (np.float32, np.float64):
            return _as_bits(x, self.nought)
        return x


@jax.custom_jvp
def _as_bits(x: jax.Array, nought: jax.Array) -> jax.Array:
    """x, by way of its bits, among which no sum is looked for."""
    kind = jnp.int64 if x.dtype == jnp.float64 else jnp.int32
    bits = lax.bitcast_convert_type(x, kind) ^ nought.astype(kind)
    return lax.bitcast_convert_type(bits, x.dtype)


@_as_bits.defjvp
def _(primals: Sequence[jax.Array], tangents: Sequence[jax.Array]):
    return _as_bits(*primals), tangents[0]
