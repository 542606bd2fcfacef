"""Arithmetic of pairs of float64 numbers, x = hi + lo with |lo| ≤ ulp(hi)/2: about 31 digits."""

# Operations are those of Joldes, Muller & Popescu 2017, "Tight and rigorous error bounds for basic
# building blocks of double-word arithmetic", ACM TOMS 44, 15, with their numbers of algorithms. An
# array in place of a pair is exact, lo = 0, and takes fewer operations.

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lanewise.jaxprs.jaxapi import is_traced
from lanewise.rules.exact import exact_product, two_sum


class Pair(NamedTuple):
    """hi + lo; `hi` is the value rounded to float64."""

    hi: Array
    lo: Array


Number = Any
"""A `Pair`, or a float64 array or number, which is exact."""


def is_pair(x: Any) -> bool:
    """Whether x is a `Pair`, a leaf of pytrees of numbers."""
    return isinstance(x, Pair)


def rounded(tree: Any) -> Any:
    """The pytree with hi in place of each pair."""
    return jax.tree.map(lambda x: x.hi if isinstance(x, Pair) else x, tree, is_leaf=is_pair)


def as_pair(x: Any) -> Any:
    """A float64 array as a pair; anything else as it is."""
    if isinstance(x, Pair) or jnp.result_type(x) != jnp.float64:
        return x
    return Pair(jnp.asarray(x), jnp.zeros_like(x))


def fast_two_sum(a: Array, b: Array) -> Pair:
    """a + b exactly, where |a| ≥ |b| or a = 0."""
    s = a + b
    return Pair(s, b - (s - a))


# Compiled functions, so that each is traced once for each shape: a step has hundreds of them.
@jax.jit
def add(x: Number, y: Number) -> Pair:
    """x + y, relative error ≤ 3·2⁻¹⁰⁶."""
    if not isinstance(x, Pair):
        x, y = y, x
    if not isinstance(x, Pair):
        return Pair(*two_sum(x, y))
    if not isinstance(y, Pair):  # algorithm 4
        s, e = two_sum(x.hi, y)
        return fast_two_sum(s, x.lo + e)
    # Algorithm 6, and not the shorter 5: its error is relative to the result also where it cancels.
    s, e = two_sum(x.hi, y.hi)
    t, f = two_sum(x.lo, y.lo)
    s, e = fast_two_sum(s, e + t)
    return fast_two_sum(s, f + e)


@jax.jit
def _product(x: Number, y: Number) -> Pair:
    if not isinstance(x, Pair):
        x, y = y, x
    if not isinstance(x, Pair):
        return Pair(*exact_product(x, y))
    if not isinstance(y, Pair):  # algorithm 9
        p, e = exact_product(x.hi, y)
        return fast_two_sum(p, x.lo * y + e)
    # Algorithm 12. Rounded products go into sums only that no exact sum is made of: there they may
    # be contracted or not.
    p, e = exact_product(x.hi, y.hi)
    return fast_two_sum(p, e + ((x.hi * y.lo + x.lo * y.lo) + x.lo * y.hi))


@jax.jit
def div(x: Number, y: Number) -> Pair:
    """x/y, relative error ≤ 15·2⁻¹⁰⁶."""
    x, y = as_pair(x), as_pair(y)
    # Algorithm 17: the remainder of the quotient in float64, divided once more.
    first = x.hi / y.hi
    r = _product(y, first)
    return fast_two_sum(first, ((x.hi - r.hi) + (x.lo - r.lo)) / y.hi)


@jax.jit
def sqrt(x: Number) -> Pair:
    """√x."""
    x = as_pair(x)
    # One Newton step from the root in float64, whose square is known exactly.
    root = jnp.sqrt(x.hi)
    p, e = exact_product(root, root)
    # At 0 and ∞ the root is exact, and the quotient NaN.
    lo = (((x.hi - p) - e) + x.lo) / (2 * root)
    return fast_two_sum(root, jnp.where((root > 0) & (root < jnp.inf), lo, 0.0))


def negate(x: Number) -> Number:
    return Pair(-x.hi, -x.lo) if isinstance(x, Pair) else -x


def sub(x: Number, y: Number) -> Pair:
    return add(x, negate(y))  # a change of sign is exact


def mul(x: Number, y: Number) -> Number:
    """x·y, relative error ≤ 5·2⁻¹⁰⁶; exact where a factor is known as a power of two."""
    for a, b in ((x, y), (y, x)):
        # The derivatives that JAX writes are full of factors 1, −1 and 2.
        is_known = not isinstance(a, Pair) and not is_traced(a)
        if is_known and np.all(np.abs(np.frexp(np.asarray(a))[0]) == 0.5):
            return jax.tree.map(lambda part, a=a: part * a, b)
    return _product(x, y)


def power(x: Number, n: int) -> Number:
    """xⁿ by squaring."""
    if n < 0:
        return div(np.float64(1), power(x, -n))
    result, square = None, x
    while n:
        if n & 1:
            result = square if result is None else mul(result, square)
        n >>= 1
        square = mul(square, square) if n else square
    return jnp.ones_like(rounded(x)) if result is None else result


def compare(operation: Callable) -> Callable:
    """The comparison of pairs by one of numbers, such as `operator.lt`."""

    def comparison(x: Number, y: Number) -> Array:
        if not (isinstance(x, Pair) or isinstance(y, Pair)):
            return operation(x, y)
        x, y = as_pair(x), as_pair(y)
        if operation is operator.ne:
            return (x.hi != y.hi) | (x.lo != y.lo)
        # Upper parts decide, and lower ones where those are equal: pairs are normalised.
        strictly = operation(x.hi, y.hi) & (x.hi != y.hi)
        return strictly | ((x.hi == y.hi) & operation(x.lo, y.lo))

    return comparison


def where(condition: Array, x: Number, y: Number) -> Number:
    """x or y, elementwise."""
    if isinstance(x, Pair) or isinstance(y, Pair):
        return jax.tree.map(functools.partial(jnp.where, condition), as_pair(x), as_pair(y))
    return jnp.where(condition, x, y)


def larger(x: Number, y: Number) -> Number:
    """The larger of two; NaN where one is NaN."""
    return where(compare(operator.gt)(x, y) | jnp.isnan(rounded(x)), x, y)


def smaller(x: Number, y: Number) -> Number:
    """The smaller of two; NaN where one is NaN."""
    return where(compare(operator.lt)(x, y) | jnp.isnan(rounded(x)), x, y)


def magnitude(x: Number) -> Number:
    return where(rounded(x) < 0, negate(x), x)


def floor(x: Number) -> Number:
    """The largest integer that is not above x."""
    if not isinstance(x, Pair):
        return jnp.floor(x)
    integer = jnp.floor(x.hi)
    # The digits of lo decide only where hi is an integer itself.
    return fast_two_sum(integer, jnp.where(integer == x.hi, jnp.floor(x.lo), 0.0))


def reduce_axes(operation: Callable, x: Pair, axes: Sequence[int], neutral: float) -> Pair:
    """Elements along axes combined by an operation of two, by halves."""
    free = [i for i in range(x.hi.ndim) if i not in axes]
    shape = [x.hi.shape[i] for i in free]

    def first(part: Array) -> Array:
        return jnp.transpose(part, (*axes, *free)).reshape(-1, *shape)

    x = Pair(first(x.hi), first(x.lo))
    count = x.hi.shape[0]
    if count == 0:
        return Pair(jnp.full(shape, neutral), jnp.zeros(shape))
    # As a tree: few operations on long arrays, and an error that grows with the logarithm.
    while count > 1:
        half = count // 2
        ends = (slice(half), slice(half, 2 * half), slice(2 * half, None))
        a, b, odd = (Pair(x.hi[end], x.lo[end]) for end in ends)
        x = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), operation(a, b), odd)
        count -= half
    return jax.tree.map(lambda a: a[0], x)
