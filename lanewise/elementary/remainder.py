"""The remainder of a division of floating-point numbers, without rounding."""

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from .exponential import scale_in_two_steps
from .parts import FRACTION, TINY, bits_of, branch_unless, shift_right, where, with_sign_of

_DIGITS = 10  # bits by which a positive integer below 2⁵³ may be shifted to the left in 64 bits


def rem(x: Array, y: Array) -> Array:
    """x − n y with the integer n = x/y rounded towards zero, as `fmod` of C: it is exact.

    It requires that the product and the sum in x − n y are contracted, as generated code does.
    """
    a, b = lax.abs(x), lax.abs(y)
    quotient = a / b
    n = lax.floor(quotient)
    # The rounded quotient may be the integer above the true one; the remainder is exact for both,
    # because it is a multiple of the last bit of b and not larger than b.
    r = a - n * b
    r = where(r < 0.0, r + b, r)
    # Its last bit must not be subnormal: a CPU may replace such a number by zero.
    is_ordinary = (quotient < 2.0**53) & (b >= TINY * 2.0**53) & (b < jnp.inf)
    return with_sign_of(branch_unless(is_ordinary, r, _by_digits, a, b), bits_of(x))


def _by_digits(a: Array, b: Array) -> Array:
    """The remainder of positive numbers by division of integers, some bits after the other."""
    (m, e), (m_b, e_b) = _integer_and_exponent(a), _integer_and_exponent(b)

    def next_digits(state: tuple[Array, Array]) -> tuple[Array, Array]:
        r, left = state
        count = lax.min(left, np.int64(_DIGITS))
        return lax.rem(lax.shift_left(r, count), m_b), left - count

    # A shift by all digits at once would need an integer of 2000 bits.
    start = lax.rem(m, m_b), e - e_b
    r, _ = lax.while_loop(lambda state: state[1] > 0, next_digits, start)
    value = scale_in_two_steps(lax.convert_element_type(r, jnp.float64), e_b - 1075)
    # A smaller dividend is the remainder itself; that of infinity, or by zero, is NaN.
    is_number = (a < jnp.inf) & (b > 0.0) & (b == b)
    return where(is_number, where(a < b, a, value), jnp.nan)


def _integer_and_exponent(a: Array) -> tuple[Array, Array]:
    """(m, e) with a = m 2^(e − 1075) for a ≥ 0, m < 2⁵³ and e ≥ 1."""
    bits = bits_of(a)
    field = shift_right(bits, 52)
    is_normal = field > 0
    m = (bits & FRACTION) | lax.select(is_normal, np.int64(2**52), np.int64(0))
    return m, lax.select(is_normal, field, np.int64(1))
