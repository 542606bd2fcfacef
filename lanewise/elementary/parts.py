"""The bits of a number, selections, sums with their errors, and polynomials."""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

Real = Any  # an array or a constant of NumPy or Python

SIGN = np.int64(-(2**63))
FRACTION = np.int64(2**52 - 1)
LOW_HALF = np.int64(2**32 - 1)
ONE_BITS = np.int64(0x3FF0_0000_0000_0000)  # the bits of 1.0
TINY = 2.0**-1022  # the smallest normal number


def bits_of(x: Array) -> Array:
    return lax.bitcast_convert_type(x, jnp.int64)


def float_of(bits: Array) -> Array:
    return lax.bitcast_convert_type(bits, jnp.float64)


def shift_right(bits: Array | np.int64, count: int | Array) -> Array:
    """Logical shift: zeros enter from the left."""
    return lax.shift_right_logical(bits, np.int64(count) if isinstance(count, int) else count)


def where(condition: Array, x: Array | float, y: Array | float) -> Array:
    """`jnp.where` of float64 scalars as one primitive, without a nested jit."""
    return lax.select(
        condition,
        np.float64(x) if isinstance(x, int | float) else x,
        np.float64(y) if isinstance(y, int | float) else y,
    )


def branch_unless(is_ordinary: Array, ordinary: Array, extreme: Callable[..., Array], *args: Array):
    """`ordinary`, and `extreme(*args)` in a branch for the other arguments, NaN among them."""
    return lax.cond(
        is_ordinary, lambda ordinary, *_: ordinary, lambda _, *args: extreme(*args), ordinary, *args
    )


def nearest(x: Array) -> tuple[Array, Array]:
    """The integer k nearest to x, |x| < 2⁵¹, as a float and in the last bits of an integer.

    The sum of k and 1.5·2⁵² has k in its last bits, which saves a conversion to an integer. It
    would round as well, but XLA simplifies x + c − c to x for constants c.
    """
    k = lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN)
    return k, bits_of(k + 1.5 * 2.0**52)


def with_sign_of(value: Array, sign: Array) -> Array:
    """`value` ≥ 0 with the sign bit of the integer `sign`."""
    return float_of(bits_of(value) ^ (sign & SIGN))


def fast_two_sum(x: Real, y: Array) -> tuple[Array, Array]:
    """The rounded sum and its error, for |x| ≥ |y| or x = 0 (Dekker 1971)."""
    total = x + y
    return total, (x - total) + y


def two_sum(x: Array, y: Real) -> tuple[Array, Array]:
    """The rounded sum and its error (Knuth 1969). A constant is y: XLA simplifies x + c − c."""
    total = x + y
    part = total - x
    return total, (x - (total - part)) + (y - part)


def head_of(x: Array) -> Array:
    """x cut to its first 26 significant bits: products of two such numbers are exact."""
    return float_of(bits_of(x) & np.int64(-(2**27)))


def polynomial(z: Array, coefficients: Sequence[float]) -> Array:
    """Value of c0 + c1 z + c2 z² + … by Horner's scheme."""
    value: Real = coefficients[-1]
    for c in coefficients[-2::-1]:
        value = value * z + c
    return value


def split_polynomial(z: Array, square: Array, coefficients: Sequence[float]) -> Array:
    """The same from the even and the odd part in `square` = z², which halves the latency."""
    even = polynomial(square, coefficients[::2])
    return polynomial(square, coefficients[1::2]) * z + even


def exponent_of(bits: Array) -> Array:
    """The exponent of a positive number as a float."""
    # In the last bits of 2⁵² it becomes a float without a conversion.
    exponent = float_of(shift_right(bits, 52) | np.int64(0x4330_0000_0000_0000))
    return exponent - (2.0**52 + 1023)
