"""sin, cos, tan and their inverse functions."""

import itertools
import math

import numpy as np
from jax import Array, lax

from . import tables
from .parts import (
    FRACTION,
    LOW_HALF,
    SIGN,
    Real,
    bits_of,
    fast_two_sum,
    float_of,
    head_of,
    nearest,
    shift_right,
    split_polynomial,
    where,
    with_sign_of,
)

# Larger arguments are reduced in a branch: the products of k and the parts of π/2 are not exact.
_LIMIT_4, _LIMIT_5 = 2.0**21, 2.0**27


def _reduce(size: Array) -> tuple[Array, Array, Array]:
    r"""(r, y, bits): r + y = `size` − k π/2, |r| ≤ π/4, and k mod 4 in the last bits of `bits`.

    Cody & Waite 1980, ch. 8, with π/2 = P1 + P2 + P3 + P4 and k ≤ 2²¹,

        b = (x − k P1) − k P2  exactly,   r + e = b − k P3  exactly,   y = e − k P4

    with an error below 2^−117. No double except 0 is nearer than 2^−60.5 to a multiple of π/2 up to
    2²⁷ and than 2^−62 at all. Arguments beyond are reduced in a branch.
    """
    k, bits = nearest(size * (2 / math.pi))
    b = (size - k * tables.HALF_PI_4[0]) - k * tables.HALF_PI_4[1]
    part = k * tables.HALF_PI_4[2]
    r = b - part
    y = ((b - r) - part) - k * tables.HALF_PI_4[3]
    return lax.cond(size > _LIMIT_4, _reduce_large, lambda *args: args[1:], size, r, y, bits)


def _reduce_large(size: Array, *_: Array) -> tuple[Array, Array, Array]:
    """The same in five parts for k ≤ 2²⁷, with a further branch beyond."""
    k, bits = nearest(size * (2 / math.pi))
    b = (size - k * tables.HALF_PI_5[0]) - k * tables.HALF_PI_5[1]
    part = k * tables.HALF_PI_5[2]
    t = b - part
    e = (b - t) - part
    part = k * tables.HALF_PI_5[3]
    u = t - part
    f = (t - u) - part
    remainder = (e + f) - k * tables.HALF_PI_5[4]
    r = u + remainder
    y = (u - r) + remainder
    return lax.cond(size > _LIMIT_5, _reduce_huge, lambda *args: args[1:], size, r, y, bits)


def _reduce_huge(size: Array, *_: Array) -> tuple[Array, Array, Array]:
    r"""The same in integer arithmetic for all larger numbers (Payne & Hanek 1983).

    With x = m 2^e and an integer m < 2⁵³, the digits of 2/π before position e − 2 contribute
    multiples of 4 to x 2/π. m times the next 192 digits, modulo 2¹⁹², gives two bits of k and 190
    of a fraction, of which 137 are correct.
    """
    bits = bits_of(size)
    position = shift_right(bits, 52) - np.int64(1013)  # e − 2, and the 64 zeros of the table
    m = (bits & FRACTION) | np.int64(2**52)

    # Four words of the table from word position // 64 on, chosen by one binary digit after another.
    words = [np.uint64(word).astype(np.int64) for word in tables.TWO_OVER_PI]
    for step, length in ((16, 19), (8, 11), (4, 7), (2, 5), (1, 4)):
        is_set = (position & np.int64(64 * step)) != 0
        words = [
            lax.select(is_set, words[i + step], words[i]) if i + step < len(words) else words[i]
            for i in range(length)
        ]
    count = position & np.int64(63)
    digits = []
    for high, low in itertools.pairwise(words):
        word = (high << count) | shift_right(shift_right(low, 1), np.int64(63) - count)
        digits += [shift_right(word, 32), word & LOW_HALF]

    # Schoolbook multiplication with digits of 32 bits, from the last digit on; no sum overflows.
    m_low, m_high = m & LOW_HALF, shift_right(m, 32)
    carry = shift_right(m_low * digits[5], 32)
    columns = []
    for j in range(4, -1, -1):
        t, u = m_low * digits[j] + carry, m_high * digits[j + 1]
        column = (t & LOW_HALF) + (u & LOW_HALF)
        carry = shift_right(t, 32) + shift_right(u, 32) + shift_right(column, 32)
        columns.append(column & LOW_HALF)
    high, low = (columns[4] << 32) | columns[3], (columns[2] << 32) | columns[1]
    k = shift_right(high + np.int64(2**61), 62)

    # The fraction as a signed number of 126 bits. −x is computed as −1 − x: an error of 2^−126.
    high, low = (high << 2) | shift_right(low, 62), low << 2
    sign = high & SIGN
    is_negative = lax.neg(shift_right(high, 63))
    high, low = high ^ is_negative, low ^ is_negative
    a, b, c, d = (
        # The number 2^n with an ulp of 2^(n − 52), and the digit in its last places.
        float_of(digit | np.int64((1023 + n) << 52)) - 2.0**n
        for digit, n in (
            (shift_right(high, 32), 20),
            (high & LOW_HALF, -12),
            (shift_right(low, 32), -44),
            (low & LOW_HALF, -76),
        )
    )
    h, e = fast_two_sum(a, b)
    g, f = fast_two_sum(c, d)
    h, g = fast_two_sum(h, e + g)
    g = g + f

    # times π/2
    h_high = head_of(h)
    h_low = h - h_high
    first = h_high * tables.HALF_PI_3[0]
    second = (h_high * tables.HALF_PI_3[1] + h_low * tables.HALF_PI_3[0]) + (
        (h_low * tables.HALF_PI_3[1] + h_high * tables.HALF_PI_3[2]) + g * (math.pi / 2)
    )
    r, y = fast_two_sum(first, second)
    r = where(size < math.inf, r, math.nan)
    return float_of(bits_of(r) ^ sign), float_of(bits_of(y) ^ sign), k


def _sines(r: Array, y: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """sin and cos of r + y, each as a rounded value's two terms, the first the larger one."""
    z = r * r
    square = z * z
    ds = r * z * split_polynomial(z, square, tables.SIN) + y
    w = 1.0 - 0.5 * z
    dc = ((1.0 - w) - 0.5 * z) + (square * split_polynomial(z, square, tables.COS) - r * y)
    return (r, ds), (w, dc)


def _sine(s: Array, c: Array, bits: Array, x: Array) -> Array:
    """sin x from sin and cos of the reduced argument: s, c, −s, −c for k = 0, 1, 2, 3 mod 4."""
    # An odd quadrant exchanges sine and cosine; the second bit of k is the sign.
    value = lax.select((bits & np.int64(1)) != 0, c, s)
    return float_of(bits_of(value) ^ (((bits << 62) ^ bits_of(x)) & SIGN))


def _cosine(s: Array, c: Array, bits: Array) -> Array:
    """cos x: c, −s, −c, s."""
    value = lax.select((bits & np.int64(1)) != 0, s, c)
    return float_of(bits_of(value) ^ (((bits + np.int64(1)) << 62) & SIGN))


def _sine_and_cosine(x: Array) -> tuple[Array, Array, Array]:
    """sin and cos of the reduced argument, and the number of the quadrant."""
    r, y, bits = _reduce(lax.abs(x))
    (s, ds), (c, dc) = _sines(r, y)
    return s + ds, c + dc, bits


def sincos(x: Array) -> tuple[Array, Array]:
    """sin x and cos x, which share the reduction of the argument and both series."""
    s, c, bits = _sine_and_cosine(x)
    return _sine(s, c, bits, x), _cosine(s, c, bits)


def sin(x: Array) -> Array:
    """Sine."""
    s, c, bits = _sine_and_cosine(x)
    return _sine(s, c, bits, x)


def cos(x: Array) -> Array:
    """Cosine."""
    return _cosine(*_sine_and_cosine(x))


def tan(x: Array) -> Array:
    """Tangent, the quotient of sine and cosine with their rounding errors."""
    r, y, bits = _reduce(lax.abs(x))
    (s, ds), (c, dc) = (fast_two_sum(*pair) for pair in _sines(r, y))
    is_odd = (bits & np.int64(1)) != 0
    numerator, d_numerator = lax.select(is_odd, c, s), lax.select(is_odd, dc, ds)
    denominator, d_denominator = lax.select(is_odd, s, c), lax.select(is_odd, ds, dc)
    # Without the rounding errors of both, which enter in first order, the quotient has a larger
    # error.
    quotient = numerator / denominator
    value = quotient + (d_numerator - quotient * d_denominator) / denominator
    return float_of(bits_of(value) ^ (((bits << 63) ^ bits_of(x)) & SIGN))


def _angle(y: Array, x: Real) -> Array:
    """atan(y/x) for 0 ≤ x, y < ∞, not both 0: between 0 and π/2.

    In the first octant, n ≤ d,  atan(n/d) = atan c + atan t,  t = (n − c d)/(d + c n), with
    c = 0, 1/2 or 1, so that |t| ≤ 0.3; in the second π/2 − atan(d/n).
    """
    # Each angle in the first octant, where the series converges fast.
    is_steep = y > x
    n, d = where(is_steep, x, y), where(is_steep, y, x)
    low, high = n < 0.3 * d, n > 0.8345 * d

    def of_c(at_0, at_half, at_1):
        return where(low, at_0, where(high, at_1, at_half))

    c = of_c(0.0, 0.5, 1.0)
    t = (n - c * d) / (d + c * n)
    z = t * t
    series = t * z * split_polynomial(z, z * z, tables.ATAN)
    first = of_c(t, tables.ATAN_HALF[0], tables.PI_4[0])
    second = series + of_c(0.0, t + tables.ATAN_HALF[1], t + tables.PI_4[1])
    return where(is_steep, (tables.PI_2[0] - first) - (second - tables.PI_2[1]), first + second)


def atan(x: Array) -> Array:
    """Arc tangent."""
    size = lax.abs(x)
    # Beyond 2⁶⁰ the value is π/2 to rounding; ∞ would make quotients NaN.
    size = where(size > 2.0**60, 2.0**60, size)
    return with_sign_of(_angle(size, np.float64(1.0)), bits_of(x))


def atan2(y: Array, x: Array) -> Array:
    """Angle of the point (x, y), in [−π, π]."""
    n, d = lax.abs(y), lax.abs(x)
    # n − c d and d + c n must neither overflow nor lose digits.
    larger = where(n > d, n, d)
    is_ordinary = (larger < 2.0**1000) & (larger > 2.0**-900)

    def scale_sides(n, d):
        # The limits: ∞/∞ counts as 1, a quotient of a finite number and ∞ as 0 or ∞, 0/0 as 0/1.
        infinite = larger == math.inf
        n = where(infinite, where(n == math.inf, 1.0, 0.0 * n), n)
        d = where(infinite, where(d == math.inf, 1.0, 0.0 * d), d)
        d = where((n == 0.0) & (d == 0.0), 1.0, d)
        scale = where(larger > 2.0**100, 0.25, 2.0**100)
        return scale * n, scale * d

    n, d = lax.cond(is_ordinary, lambda n, d: (n, d), scale_sides, n, d)
    angle = _angle(n, d)
    angle = where(bits_of(x) < 0, 2 * tables.PI_2[0] - (angle - 2 * tables.PI_2[1]), angle)
    return with_sign_of(angle, bits_of(y))


def _arc(size: Array) -> tuple[Array, Array, Array]:
    """(size > 1/2, s, d): s + d = asin(size), or asin √((1 − size)/2) for size > 1/2."""
    is_steep = size > 0.5
    # Near 1 the slope of asin is infinite; asin x = π/2 − 2 asin √((1 − x)/2) moves the argument
    # away.
    half = 0.5 * (1.0 - size)
    z = where(is_steep, half, size * size)
    s = where(is_steep, lax.sqrt(half), size)
    return is_steep, s, s * z * split_polynomial(z, z * z, tables.ASIN)


def asin(x: Array) -> Array:
    """Arc sine."""
    is_steep, s, d = _arc(lax.abs(x))
    value = where(is_steep, tables.PI_2[0] - (2.0 * s - (tables.PI_2[1] - 2.0 * d)), s + d)
    return with_sign_of(value, bits_of(x))


def acos(x: Array) -> Array:
    """Arc cosine."""
    is_steep, s, d = _arc(lax.abs(x))
    sign = bits_of(x) & SIGN
    far = where(x < 0.0, 2 * tables.PI_2[0] - 2.0 * (s + (d - tables.PI_2[1])), 2.0 * (s + d))
    s, d = float_of(bits_of(s) ^ sign), float_of(bits_of(d) ^ sign)
    return where(is_steep, far, tables.PI_2[0] - (s - (tables.PI_2[1] - d)))
