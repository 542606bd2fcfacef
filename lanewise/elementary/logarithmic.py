"""log, log1p, inverses of hyperbolic functions and of erf, pow, half-integer powers, cbrt."""

import math
from collections.abc import Callable

import numpy as np
from jax import Array, lax

from . import tables
from .exponential import exp2_terms, scale_by_power, scale_in_two_steps
from .parts import (
    FRACTION,
    ONE_BITS,
    TINY,
    bits_of,
    branch_unless,
    exponent_of,
    fast_two_sum,
    float_of,
    head_of,
    nearest,
    polynomial,
    split_polynomial,
    two_sum,
    where,
    with_sign_of,
)

_ROOT_HALF = np.int64(0x3FE6_A09E_667F_3BCD)  # the bits of √½


def _normal_form(x: Array) -> tuple[Array, Array]:
    """(k, m) with x = 2^k m, √½ ≤ m < √2, for a normal x > 0."""
    bits = bits_of(x) + (ONE_BITS - _ROOT_HALF)
    return exponent_of(bits), float_of((bits & FRACTION) + _ROOT_HALF)


def _log_sum(x: Array, e: Array | None = None, shift: float = 0.0) -> Array:
    r"""log(x + e) + `shift` log 2 for a normal x and |e| of the size of its rounding error.

    With x = 2^k m, f = m − 1, s = f/(2 + f), z = s²,

        log x = k log 2 + f − (f²/2 − s (f²/2 + z P(z))),   log(1 + e/x) = 2^−k e/(1 + f)

    and 1/(1 + f) = (1 − s)/(1 + s) by the first terms of its series.
    """
    # m near 1 on both sides, so that k log 2 and log m do not cancel.
    k, m = _normal_form(x)
    k = k + shift if shift else k
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    half = 0.5 * f * f
    small = k * tables.LOG_2[1]
    if e is not None:
        inverse = float_of((bits_of(m) - bits_of(x)) + ONE_BITS)
        small = small + (e * inverse) * (1.0 - (2.0 * s) * (1.0 - s))
    series = s * (half + z * split_polynomial(z, z * z, tables.LOG))
    return k * tables.LOG_2[0] - ((half - (series + small)) - f)


def log(x: Array) -> Array:
    """Natural logarithm."""

    def extreme(x):
        value = _log_sum(x * 2.0**54, shift=-54.0)
        value = where(x >= TINY, x, value)  # ∞
        value = where(x > 0.0, value, math.nan)
        return where(x == 0.0, -math.inf, value)

    return branch_unless((x >= TINY) & (x < math.inf), _log_sum(x), extreme, x)


def log1p(x: Array) -> Array:
    """log(1 + x), from the rounded sum and its error."""

    def extreme(x):
        value = where(x > 0.0, log(x), where(x == -1.0, -math.inf, math.nan))
        return where(x == x, value, x)

    value = _log_sum(*two_sum(x, np.float64(1.0)))
    value = branch_unless((x > -1.0) & (x < 2.0**500), value, extreme, x)
    return where(x == 0.0, x, value)  # −0


def _log1p_sum(z: Array, e: Array) -> Array:
    """log(1 + z + e), 0 ≤ z < 2⁶⁰⁰, |e| below the rounding error of z."""
    total, error = two_sum(z, np.float64(1.0))
    return _log_sum(total, error + e)


def _log_double(x: Array) -> Array:
    """log(2x) for x ≥ 2⁵⁰⁰, NaN for NaN."""
    return where(x < math.inf, _log_sum(x, shift=1.0), x)


def asinh(x: Array) -> Array:
    """Inverse hyperbolic sine: log(1 + z) with z = |x| + x²/(1 + √(1 + x²))."""
    size = lax.abs(x)
    square = size * size
    z, e = fast_two_sum(size, square / (1.0 + lax.sqrt(1.0 + square)))
    value = branch_unless(size < 2.0**500, _log1p_sum(z, e), _log_double, size)
    return with_sign_of(value, bits_of(x))


def acosh(x: Array) -> Array:
    """Inverse hyperbolic cosine: log(1 + z) with t = x − 1, z = t + √(2t + t²)."""
    t = x - 1.0
    z, e = fast_two_sum(lax.sqrt(2.0 * t + t * t), t)

    def extreme(x):
        return where(x < 1.0, math.nan, _log_double(x))

    return branch_unless((x >= 1.0) & (x < 2.0**500), _log1p_sum(z, e), extreme, x)


def atanh(x: Array) -> Array:
    """Inverse hyperbolic tangent: log(1 + z)/2 with z = 2|x|/(1 − |x|)."""
    size = lax.abs(x)
    n, dn = fast_two_sum(np.float64(1.0), -size)
    z = 2.0 * size / n
    # The error of n, with 1/n = 1 + z/2.
    value = 0.5 * _log1p_sum(z, -(z * dn) * (1.0 + 0.5 * z))
    value = where(size == 1.0, math.inf, where(size > 1.0, math.nan, value))
    return with_sign_of(value, bits_of(x))


# --- powers -----------------------------------------------------------------------------------


def _log2_terms(x: Array, shift: float = 0.0) -> tuple[Array, Array]:
    r"""log2 x + `shift` as a rounded value and its error, to 2^−67 of it, for a normal x > 0.

    x = 2^k m, 1 ≤ m < 2, and with c one of 1, 1.27, 1.59, 2 next to m, s = (m − c)/(m + c), z = s²

    log2 x = k + log2 c + s G,   G = 2/log 2 (1 + z/3 + z²/5 + …),   |s| < 0.06.

    s, G and products are sums of two numbers, the first of 26 bits, so that no product is rounded
    that matters.
    """
    bits = bits_of(x)
    m = float_of((bits & FRACTION) | ONE_BITS)
    c: Array | float = 1.0
    k: Array | float = 0.0
    dk: Array | float = 0.0
    for begin, centre, high, low in tables.LOG2_CENTRES:
        is_beyond = m > begin
        c = where(is_beyond, centre, c)
        k, dk = where(is_beyond, high, k), where(is_beyond, low, dk)
    k = k + (exponent_of(bits) + shift if shift else exponent_of(bits))

    f = m - c
    n = m + c
    inverse = 1.0 / n
    n_head = head_of(n)
    n_rest = (c - n_head) + m
    s = head_of(f * inverse)
    ds = ((f - s * n_head) - s * n_rest) * inverse

    square = s * s
    z_head = head_of(square)
    dz = (square - z_head) + ds * (s + s + ds)
    z = z_head + dz
    leading = z_head * tables.LOG2_3[0]
    error = z * (tables.LOG2_3[1] + z * polynomial(z, tables.LOG2_5)) + dz * tables.LOG2_3[0]
    g = head_of(tables.LOG2_1[0] + leading)
    dg = ((tables.LOG2_1[0] - g) + leading) + (error + tables.LOG2_1[1])

    value, e = fast_two_sum(k, s * g)  # k is 0 or the larger one
    return fast_two_sum(value, e + (dk + (s * dg + ds * (g + dg))))


def _product_terms(y: Array, log: tuple[Array, Array]) -> tuple[Array, Array]:
    """The product of y and the sum of two numbers: the first term has 52 bits, exactly."""
    y_head, log_head = head_of(y), head_of(log[0])
    error = y_head * (log[0] - log_head) + (y - y_head) * log[0]
    return y_head * log_head, error + y * log[1]


def pow(x: Array, y: Array) -> Array:
    """x^y = 2^(y log2 x), with the special values of C99."""
    high, low = _product_terms(y, _log2_terms(x))
    k, bits = nearest(high)
    w, d = exp2_terms(high - k, low)
    is_ordinary = (x >= TINY) & (x < math.inf) & (lax.abs(high) < 1021.0)
    return branch_unless(is_ordinary, scale_by_power(w + d, bits), _pow_extreme, x, y)


def _pow_extreme(x: Array, y: Array) -> Array:
    """The same for every x and y."""
    size = lax.abs(x)
    is_0 = size == 0.0
    is_limit = is_0 | (size == math.inf)
    is_subnormal = size < TINY
    # Beyond these limits of y and of the exponent the power is 0, 1 or ∞, and they avoid ∞ − ∞.
    exponent = where(lax.abs(y) > 2.0**65, where(y > 0.0, 2.0**65, -(2.0**65)), y)
    log, d_log = _log2_terms(where(is_subnormal, size * 2.0**54, size))
    exact, e = two_sum(log, where(is_subnormal, -54.0, 0.0))
    high, low = _product_terms(exponent, fast_two_sum(exact, e + d_log))
    is_far = lax.abs(high) > 2000.0
    high = where(is_far, where(high > 0.0, 2000.0, -2000.0), high)
    low = where(is_far, 0.0, low)
    k, bits = nearest(high)
    w, d = exp2_terms(high - k, low)
    value = scale_in_two_steps(w + d, bits)

    value = where(is_limit, where(is_0 ^ (y < 0.0), 0.0, math.inf), value)
    is_integer = lax.floor(y) == y
    half = 0.5 * y
    # A negative x to an odd power is negative; to a power that is not an integer it is NaN.
    is_odd = is_integer & (lax.floor(half) != half)
    value = where(is_odd & (bits_of(x) < 0), -value, value)
    value = where((x < 0.0) & ~(is_limit | is_integer), math.nan, value)
    value = where(x == x, where(y == y, value, y), x)
    return where((x == 1.0) | (y == 0.0), 1.0, value)


def half_integer_power(numerator: int) -> Callable[[Array], Array]:
    """The function x^(`numerator`/2): products, a root, and a quotient if it is negative.

    Errors grow by about one ulp per product. Intermediate results leave the range of normal numbers
    only if x^(|numerator|/2) does.
    """
    if numerator % 2 == 0:
        raise ValueError(f"numerator must be odd, got {numerator}.")
    count = abs(numerator) // 2
    at_infinity, at_0 = (0.0, math.inf) if numerator < 0 else (math.inf, 0.0)

    def power(x: Array) -> Array:
        value, factor, exponent = lax.sqrt(x), x, count
        while exponent:
            value = value * factor if exponent % 2 else value
            exponent //= 2
            factor = factor * factor if exponent else factor
        value = 1.0 / value if numerator < 0 else value
        value = where(x == 0.0, at_0, value)  # −0 and −∞ included, as in C99
        return where(lax.abs(x) == math.inf, at_infinity, value)

    return power


def cbrt(x: Array) -> Array:
    r"""Cube root, without a quotient.

    |x| = 2^(3k) v, 1 ≤ v < 8. y ≈ v^(−1/3) from a polynomial is corrected once in third order,
    t = v y² is cut to 26 bits, and v − t³, whose products are exact, gives the rest.
    """
    size = lax.abs(x)

    def normal(size, shift):
        bits = bits_of(size)
        m = float_of((bits & FRACTION) | ONE_BITS)
        exponent = exponent_of(bits)
        k, k_bits = nearest(exponent * (1 / 3) - 1 / 3)
        j = exponent - 3.0 * k
        v = m * where(j > 0.5, where(j > 1.5, 4.0, 2.0), 1.0)
        start = where(j > 0.5, where(j > 1.5, 4.0 ** (-1 / 3), 2.0 ** (-1 / 3)), 1.0)
        y = polynomial(m, tables.CBRT) * start
        # One step of third order takes the 14 bits of the polynomial to some 40.
        h = 1.0 - (v * y) * (y * y)
        y = y + y * h * (1 / 3 + 2 / 9 * h)
        square = y * y
        t = v * square
        head = head_of(t)
        cube = head * head
        cube_head = head_of(cube)
        residual = (v - cube_head * head) - (cube - cube_head) * head
        value = head + residual * (square * (1 / 3)) * (1.0 + (t - head) * y)
        return scale_by_power(value, k_bits - np.int64(shift))

    def extreme(size):
        return where((size > 0.0) & (size < TINY), normal(size * 2.0**54, 18), size)

    value = branch_unless((size >= TINY) & (size < math.inf), normal(size, 0), extreme, size)
    return with_sign_of(value, bits_of(x))


def erf_inv(x: Array) -> Array:
    r"""Inverse of the error function, x P(w) with w = −log(1 − x²).

    The function erf⁻¹(x)/x of w is smooth; from w = 25/4 on, |x| > 0.999, it is one of √w.
    **Source** of this variable: Giles 2012, *GPU Computing Gems*, Jade Edition, 10.
    """
    w = -log((1.0 - x) * (1.0 + x))  # 1 − x² would lose the digits of x near 1
    v = w - 3.125

    def tail(x, w):
        value = x * polynomial(1.0 - 6.0 / (lax.sqrt(w) + 2.0), tables.ERF_INV_TAIL)
        return where(lax.abs(x) == 1.0, x * math.inf, value)

    return branch_unless(w < 6.25, x * split_polynomial(v, v * v, tables.ERF_INV), tail, x, w)
