r"""Elementary functions in float64 arithmetic, for a code generator that emits each of them once.

Every function takes and returns scalar float64 values of JAX and traces to a jaxpr of additions,
products, quotients, square roots, roundings, comparisons, selections, integer arithmetic on the
bits of a number, and `lax.cond` for rare arguments: the operands of a branch include the value for
ordinary ones. `jax.vmap` applies a function to arrays. Special values are those of C99, Annex F.

Largest errors in units in the last place (ulp) that we have seen over the whole range, subnormal
and huge numbers included, and the number of operations for ordinary arguments, a fused
multiply-add counting as one:

| function | error | operations | function | error | operations |
|---|---|---|---|---|---|
| sin | 0.88 | 41 | atanh | 1.56 | 56 |
| cos | 0.87 | 41 | logistic | 1.12 | 45 |
| tan | 1.52 | 52 | exp | 0.80 | 24 |
| asin | 1.55 | 30 | exp2 | 0.72 | 32 |
| acos | 1.08 | 37 | expm1 | 1.24 | 32 |
| atan | 1.35 | 40 | log | 0.83 | 28 |
| atan2 | 1.55 | 48 | log1p | 0.86 | 43 |
| sinh | 1.64 | 48 | pow | 0.72 | 106 |
| cosh | 0.83 | 37 | cbrt | 0.51 | 51 |
| tanh | 1.38 | 47 | erf | 0.96 | 17 |
| asinh | 1.21 | 51 | erfc | 1.58 | 24 |
| acosh | 1.70 | 49 | | | |

sin and cos together take 48 operations (`sincos`), erf and erfc some 130 for |x| > 3/4.
`tests/test_lanewise_elementary.py` asserts bounds of at most 1.1 times these errors and derives
all coefficients again.

The errors hold whether or not a compiler contracts a product and a sum into a fused multiply-add:
a product that must be exact has few enough bits. Sums must not be reassociated. XLA does this with
constants, (x + c) − d = x + (c − d), which the functions avoid; it replaces subnormal numbers by 0
on a CPU, which generated code must not do.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

Real = Any
"""An array or a constant of NumPy or Python."""

# --- bits and selections ----------------------------------------------------------------------

_SIGN = np.int64(-(2**63))
_FRACTION = np.int64(2**52 - 1)
_LOW_HALF = np.int64(2**32 - 1)
_ONE = np.int64(0x3FF0_0000_0000_0000)


def _bits(x: Array) -> Array:
    return lax.bitcast_convert_type(x, jnp.int64)


def _float(bits: Array) -> Array:
    return lax.bitcast_convert_type(bits, jnp.float64)


def _shift_right(bits: Array | np.int64, count: int | Array) -> Array:
    """Logical shift: zeros enter from the left."""
    return lax.shift_right_logical(bits, np.int64(count) if isinstance(count, int) else count)


def _where(condition: Array, x: Array | float, y: Array | float) -> Array:
    """`jnp.where` of float64 scalars as one primitive, without a nested jit."""
    return lax.select(
        condition,
        np.float64(x) if isinstance(x, int | float) else x,
        np.float64(y) if isinstance(y, int | float) else y,
    )


def _unless(is_ordinary: Array, ordinary: Array, extreme: Callable[..., Array], *args: Array):
    """`ordinary`, and `extreme(*args)` in a branch for the other arguments, NaN among them."""
    return lax.cond(
        is_ordinary,
        lambda ordinary, *_: ordinary,
        lambda _, *args: extreme(*args),
        ordinary,
        *args,
    )


def _nearest(x: Array) -> tuple[Array, Array]:
    """The integer k nearest to x, |x| < 2⁵¹, as a float and in the last bits of an integer.

    The sum of k and 1.5·2⁵² has k in its last bits, which saves a conversion to an integer. It
    would round as well, but XLA simplifies x + c − c to x for constants c.
    """
    k = lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN)
    return k, _bits(k + 1.5 * 2.0**52)


def _with_sign_of(value: Array, sign: Array) -> Array:
    """`value` ≥ 0 with the sign bit of the integer `sign`."""
    return _float(_bits(value) ^ (sign & _SIGN))


def _fast_two_sum(x: Real, y: Array) -> tuple[Array, Array]:
    """The rounded sum and its error, for |x| ≥ |y| or x = 0 (Dekker 1971)."""
    total = x + y
    return total, (x - total) + y


def _two_sum(x: Array, y: Real) -> tuple[Array, Array]:
    """The rounded sum and its error (Knuth 1969). A constant is y: XLA simplifies x + c − c."""
    total = x + y
    part = total - x
    return total, (x - (total - part)) + (y - part)


def _head(x: Array) -> Array:
    """x cut to its first 26 significant bits: products of two such numbers are exact."""
    return _float(_bits(x) & np.int64(-(2**27)))


def _polynomial(z: Array, coefficients: Sequence[float]) -> Array:
    """Value of c0 + c1 z + c2 z² + … by Horner's scheme."""
    value: Real = coefficients[-1]
    for c in coefficients[-2::-1]:
        value = value * z + c
    return value


def _split_polynomial(z: Array, square: Array, coefficients: Sequence[float]) -> Array:
    """The same from the even and the odd part in `square` = z², which halves the latency."""
    even = _polynomial(square, coefficients[::2])
    return _polynomial(square, coefficients[1::2]) * z + even


# --- sin, cos, tan ----------------------------------------------------------------------------

# π/2 as sums of parts. The product of each part except the last and of k is exact for k ≤ 2²¹ and
# k ≤ 2²⁷, so that a fused multiply-add gives the same result as a product and a sum.
_HALF_PI_4 = tuple(
    map(
        float.fromhex,
        ("0x1.921fb544p+0", "0x1.0b46p-34", "0x1.1a626330p-54", "0x1.45c06e0e68948p-86"),
    )
)
_HALF_PI_5 = tuple(
    map(
        float.fromhex,
        (
            "0x1.921fb5p+0",
            "0x1.110b46p-26",
            "0x1.1a6262p-54",
            "0x1.3145cp-78",
            "0x1.b839a252049c1p-104",
        ),
    )
)
# Parts of 26, 26 and 53 bits, for a product with a number of 26 bits.
_HALF_PI_3 = tuple(map(float.fromhex, ("0x1.921fb5p+0", "0x1.110b46p-26", "0x1.1a62633145c07p-54")))
_LIMIT_4, _LIMIT_5 = 2.0**21, 2.0**27
_TWO_OVER_PI = (
    0x0000000000000000,
    0xA2F9836E4E441529,
    0xFC2757D1F534DDC0,
    0xDB6295993C439041,
    0xFE5163ABDEBBC561,
    0xB7246E3A424DD2E0,
    0x06492EEA09D1921C,
    0xFE1DEB1CB129A73E,
    0xE88235F52EBB4484,
    0xE99C7026B45F7E41,
    0x3991D639835339F4,
    0x9C845F8BBDF9283B,
    0x1FF897FFDE05980F,
    0xEF2F118B5A0A6D1F,
    0x6D367ECF27CB09B7,
    0x4F463F669E5FEA2D,
    0x7527BAC7EBE5F17B,
    0x3D0739F78A5292EA,
    0x6BFB5FB11F8D5D08,
    0x56033046FC7B6BAB,
)
"""64 zeros and the first 1216 binary digits of 2/π."""
_SIN = (
    -0.1666666666666663,
    0.00833333333332168,
    -0.0001984126982919565,
    2.7557313472069933e-06,
    -2.5050722627765976e-08,
    1.5894682038342466e-10,
)
_COS = (
    0.041666666666666644,
    -0.00138888888888816,
    2.4801587294034566e-05,
    -2.755731562617328e-07,
    2.0875890271999794e-09,
    -1.1367964315369494e-11,
)


def _reduced(size: Array) -> tuple[Array, Array, Array]:
    r"""(r, y, bits): r + y = `size` − k π/2, |r| ≤ π/4, and k mod 4 in the last bits of `bits`.

    Cody & Waite 1980, ch. 8, with π/2 = P1 + P2 + P3 + P4 and k ≤ 2²¹,

        b = (x − k P1) − k P2  exactly,   r + e = b − k P3  exactly,   y = e − k P4

    with an error below 2^−117. No double except 0 is nearer than 2^−60.5 to a multiple of π/2 up to
    2²⁷ and than 2^−62 at all. Arguments beyond are reduced in a branch.
    """
    k, bits = _nearest(size * (2 / math.pi))
    b = (size - k * _HALF_PI_4[0]) - k * _HALF_PI_4[1]
    part = k * _HALF_PI_4[2]
    r = b - part
    y = ((b - r) - part) - k * _HALF_PI_4[3]
    return lax.cond(size > _LIMIT_4, _reduced_large, lambda *args: args[1:], size, r, y, bits)


def _reduced_large(size: Array, *_: Array) -> tuple[Array, Array, Array]:
    """The same in five parts for k ≤ 2²⁷, with a further branch beyond."""
    k, bits = _nearest(size * (2 / math.pi))
    b = (size - k * _HALF_PI_5[0]) - k * _HALF_PI_5[1]
    part = k * _HALF_PI_5[2]
    t = b - part
    e = (b - t) - part
    part = k * _HALF_PI_5[3]
    u = t - part
    f = (t - u) - part
    rest = (e + f) - k * _HALF_PI_5[4]
    r = u + rest
    y = (u - r) + rest
    return lax.cond(size > _LIMIT_5, _reduced_huge, lambda *args: args[1:], size, r, y, bits)


def _reduced_huge(size: Array, *_: Array) -> tuple[Array, Array, Array]:
    r"""The same in integer arithmetic for all larger numbers (Payne & Hanek 1983).

    With x = m 2^e and an integer m < 2⁵³, the digits of 2/π before position e − 2 contribute
    multiples of 4 to x 2/π. m times the next 192 digits, modulo 2¹⁹², gives two bits of k and 190
    of a fraction, of which 137 are correct.
    """
    bits = _bits(size)
    position = _shift_right(bits, 52) - np.int64(1013)  # e − 2, and the 64 zeros of the table
    m = (bits & _FRACTION) | np.int64(2**52)

    # Four words of the table from word position // 64 on, chosen by one binary digit after another.
    words = [np.uint64(word).astype(np.int64) for word in _TWO_OVER_PI]
    for step, needed in ((16, 19), (8, 11), (4, 7), (2, 5), (1, 4)):
        is_set = (position & np.int64(64 * step)) != 0
        words = [
            lax.select(is_set, words[i + step], words[i]) if i + step < len(words) else words[i]
            for i in range(needed)
        ]
    count = position & np.int64(63)
    digits = []
    for high, low in itertools.pairwise(words):
        word = (high << count) | _shift_right(_shift_right(low, 1), np.int64(63) - count)
        digits += [_shift_right(word, 32), word & _LOW_HALF]

    # Schoolbook multiplication with digits of 32 bits, from the last digit on; no sum overflows.
    m_low, m_high = m & _LOW_HALF, _shift_right(m, 32)
    carry = _shift_right(m_low * digits[5], 32)
    columns = []
    for j in range(4, -1, -1):
        t, u = m_low * digits[j] + carry, m_high * digits[j + 1]
        column = (t & _LOW_HALF) + (u & _LOW_HALF)
        carry = _shift_right(t, 32) + _shift_right(u, 32) + _shift_right(column, 32)
        columns.append(column & _LOW_HALF)
    high, low = (columns[4] << 32) | columns[3], (columns[2] << 32) | columns[1]
    k = _shift_right(high + np.int64(2**61), 62)

    # The fraction as a signed number of 126 bits; −1 − x stands for −x, an error of 2^−126.
    high, low = (high << 2) | _shift_right(low, 62), low << 2
    sign = high & _SIGN
    is_negative = lax.neg(_shift_right(high, 63))
    high, low = high ^ is_negative, low ^ is_negative
    a, b, c, d = (
        # The number 2^n with an ulp of 2^(n − 52), and the digit in its last places.
        _float(digit | np.int64((1023 + n) << 52)) - 2.0**n
        for digit, n in (
            (_shift_right(high, 32), 20),
            (high & _LOW_HALF, -12),
            (_shift_right(low, 32), -44),
            (low & _LOW_HALF, -76),
        )
    )
    h, e = _fast_two_sum(a, b)
    g, f = _fast_two_sum(c, d)
    h, g = _fast_two_sum(h, e + g)
    g = g + f

    # times π/2
    h_high = _head(h)
    h_low = h - h_high
    first = h_high * _HALF_PI_3[0]
    second = (h_high * _HALF_PI_3[1] + h_low * _HALF_PI_3[0]) + (
        (h_low * _HALF_PI_3[1] + h_high * _HALF_PI_3[2]) + g * (math.pi / 2)
    )
    r, y = _fast_two_sum(first, second)
    r = _where(size < math.inf, r, math.nan)
    return _float(_bits(r) ^ sign), _float(_bits(y) ^ sign), k


def _sines(r: Array, y: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """sin and cos of r + y, each as a rounded value's two terms, the first the larger one."""
    z = r * r
    square = z * z
    ds = r * z * _split_polynomial(z, square, _SIN) + y
    w = 1.0 - 0.5 * z
    dc = ((1.0 - w) - 0.5 * z) + (square * _split_polynomial(z, square, _COS) - r * y)
    return (r, ds), (w, dc)


def _sine(s: Array, c: Array, bits: Array, x: Array) -> Array:
    """sin x from sin and cos of the reduced argument: s, c, −s, −c for k = 0, 1, 2, 3 mod 4."""
    value = lax.select((bits & np.int64(1)) != 0, c, s)
    return _float(_bits(value) ^ (((bits << 62) ^ _bits(x)) & _SIGN))


def _cosine(s: Array, c: Array, bits: Array) -> Array:
    """cos x: c, −s, −c, s."""
    value = lax.select((bits & np.int64(1)) != 0, s, c)
    return _float(_bits(value) ^ (((bits + np.int64(1)) << 62) & _SIGN))


def sincos(x: Array) -> tuple[Array, Array]:
    """sin x and cos x, which share the reduction of the argument and both series."""
    r, y, bits = _reduced(lax.abs(x))
    (s, ds), (c, dc) = _sines(r, y)
    s, c = s + ds, c + dc
    return _sine(s, c, bits, x), _cosine(s, c, bits)


def sin(x: Array) -> Array:
    """Sine."""
    r, y, bits = _reduced(lax.abs(x))
    (s, ds), (c, dc) = _sines(r, y)
    return _sine(s + ds, c + dc, bits, x)


def cos(x: Array) -> Array:
    """Cosine."""
    r, y, bits = _reduced(lax.abs(x))
    (s, ds), (c, dc) = _sines(r, y)
    return _cosine(s + ds, c + dc, bits)


def tan(x: Array) -> Array:
    """Tangent, the quotient of sine and cosine with their rounding errors."""
    r, y, bits = _reduced(lax.abs(x))
    (s, ds), (c, dc) = (_fast_two_sum(*pair) for pair in _sines(r, y))
    is_odd = (bits & np.int64(1)) != 0
    above, d_above = lax.select(is_odd, c, s), lax.select(is_odd, dc, ds)
    below, d_below = lax.select(is_odd, s, c), lax.select(is_odd, ds, dc)
    quotient = above / below
    value = quotient + (d_above - quotient * d_below) / below
    return _float(_bits(value) ^ (((bits << 63) ^ _bits(x)) & _SIGN))


# --- atan, atan2, asin, acos ------------------------------------------------------------------

_ATAN = (
    -0.33333333333333015,
    0.19999999999857002,
    -0.14285714263682478,
    0.11111109443212991,
    -0.09090837443504039,
    0.07690440119007526,
    -0.0663643422706014,
    0.05582706848868187,
    -0.035563835426400764,
)
_ASIN = (
    0.16666666666666752,
    0.0749999999997315,
    0.04464285717236855,
    0.030381942815085945,
    0.022372211981667427,
    0.017351665596826066,
    0.013980183984790602,
    0.011404069067862555,
    0.010751650097614106,
    0.00381329457688195,
    0.021450180476919416,
    -0.020638891121157327,
    0.0324057719092103,
)
# Each constant with the error of its rounding.
_PI_2 = float.fromhex("0x1.921fb54442d18p+0"), float.fromhex("0x1.1a62633145c07p-54")
_PI_4 = _PI_2[0] / 2, _PI_2[1] / 2
_ATAN_HALF = float.fromhex("0x1.dac670561bb4fp-2"), float.fromhex("0x1.a2b7f222f65e2p-56")


def _angle(y: Array, x: Real) -> Array:
    """atan(y/x) for 0 ≤ x, y < ∞, not both 0: between 0 and π/2.

    In the first octant, n ≤ d,  atan(n/d) = atan c + atan t,  t = (n − c d)/(d + c n), with
    c = 0, 1/2 or 1, so that |t| ≤ 0.3; in the second π/2 − atan(d/n).
    """
    is_steep = y > x
    n, d = _where(is_steep, x, y), _where(is_steep, y, x)
    low, high = n < 0.3 * d, n > 0.8345 * d

    def of_c(at_0, at_half, at_1):
        return _where(low, at_0, _where(high, at_1, at_half))

    c = of_c(0.0, 0.5, 1.0)
    t = (n - c * d) / (d + c * n)
    z = t * t
    series = t * z * _split_polynomial(z, z * z, _ATAN)
    first = of_c(t, _ATAN_HALF[0], _PI_4[0])
    second = series + of_c(0.0, t + _ATAN_HALF[1], t + _PI_4[1])
    return _where(is_steep, (_PI_2[0] - first) - (second - _PI_2[1]), first + second)


def atan(x: Array) -> Array:
    """Arc tangent."""
    size = lax.abs(x)
    # Beyond 2⁶⁰ the value is π/2 to rounding; ∞ would make quotients NaN.
    size = _where(size > 2.0**60, 2.0**60, size)
    return _with_sign_of(_angle(size, np.float64(1.0)), _bits(x))


def atan2(y: Array, x: Array) -> Array:
    """Angle of the point (x, y), in [−π, π]."""
    n, d = lax.abs(y), lax.abs(x)
    larger = _where(n > d, n, d)
    is_ordinary = (larger < 2.0**1000) & (larger > 2.0**-900)

    def scaled(n, d):
        # The limits: ∞/∞ counts as 1, a quotient of a finite number and ∞ as 0 or ∞, 0/0 as 0/1.
        infinite = larger == math.inf
        n = _where(infinite, _where(n == math.inf, 1.0, 0.0 * n), n)
        d = _where(infinite, _where(d == math.inf, 1.0, 0.0 * d), d)
        d = _where((n == 0.0) & (d == 0.0), 1.0, d)
        scale = _where(larger > 2.0**100, 0.25, 2.0**100)
        return scale * n, scale * d

    n, d = lax.cond(is_ordinary, lambda n, d: (n, d), scaled, n, d)
    angle = _angle(n, d)
    angle = _where(_bits(x) < 0, 2 * _PI_2[0] - (angle - 2 * _PI_2[1]), angle)
    return _with_sign_of(angle, _bits(y))


def _arc(size: Array) -> tuple[Array, Array, Array]:
    """(size > 1/2, s, d): s + d = asin(size), or asin √((1 − size)/2) for size > 1/2."""
    is_steep = size > 0.5
    half = 0.5 * (1.0 - size)
    z = _where(is_steep, half, size * size)
    s = _where(is_steep, lax.sqrt(half), size)
    return is_steep, s, s * z * _split_polynomial(z, z * z, _ASIN)


def asin(x: Array) -> Array:
    """Arc sine."""
    is_steep, s, d = _arc(lax.abs(x))
    value = _where(is_steep, _PI_2[0] - (2.0 * s - (_PI_2[1] - 2.0 * d)), s + d)
    return _with_sign_of(value, _bits(x))


def acos(x: Array) -> Array:
    """Arc cosine."""
    is_steep, s, d = _arc(lax.abs(x))
    sign = _bits(x) & _SIGN
    far = _where(x < 0.0, 2 * _PI_2[0] - 2.0 * (s + (d - _PI_2[1])), 2.0 * (s + d))
    s, d = _float(_bits(s) ^ sign), _float(_bits(d) ^ sign)
    return _where(is_steep, far, _PI_2[0] - (s - (_PI_2[1] - d)))


# --- exp, exp2, expm1 and hyperbolic functions ------------------------------------------------

_EXP = (
    0.5000000000000013,
    0.16666666666666677,
    0.04166666666651114,
    0.008333333333321374,
    0.0013888888948162797,
    0.00019841269886854143,
    2.480148871974186e-05,
    2.7557243408231995e-06,
    2.7631729701439217e-07,
    2.510933783878345e-08,
)
# log 2 in 42 bits, so that multiples of it are exact, and in 26 bits, each with the rest.
_LOG_2 = float.fromhex("0x1.62e42fefa3p-1"), float.fromhex("0x1.3de6af278ece6p-42")
_LOG_2_HEAD = float.fromhex("0x1.62e42f8p-1"), float.fromhex("0x1.be8e7bcd5e4f2p-27")
_EXP_LIMIT = 708.0
"""For |x| below this number e^x is a normal number, and so is e^−x."""


def _exp_reduced(x: Array) -> tuple[Array, Array, Array]:
    """(r, y, bits): r + y = x − k log 2, |r| ≤ (log 2)/2, with k in the last bits of `bits`."""
    k, bits = _nearest(x * (1 / math.log(2)))
    high = x - k * _LOG_2[0]
    low = k * _LOG_2[1]
    r = high - low
    return r, (high - r) - low, bits


def _exp_terms(r: Array, y: Array | None = None) -> tuple[Array, Array]:
    """w + d = e^(r + y), |r| ≤ 0.35: the first term is 1 + r rounded, the second is small."""
    z = r * r
    w = 1.0 + r
    series = z * _split_polynomial(r, z, _EXP)
    return w, ((1.0 - w) + r) + (series if y is None else series + y)


def _power_of_two(bits: Array) -> Array:
    """2^k, |k| ≤ 1022, with k in the last bits of `bits`."""
    return _float((bits << 52) + _ONE)


def _scaled(value: Array, bits: Array) -> Array:
    """`value` 2^k for a normal result, with k in the last bits of `bits`."""
    return _float(_bits(value) + (bits << 52))


def _scaled_twice(value: Array, bits: Array) -> Array:
    """`value` 2^k for |k| ≤ 2000, with one rounding at the end if the result is subnormal."""
    half = _shift_right(bits, 1)  # k/2 in the last bits; those above are shifted out
    return (value * _power_of_two(half)) * _power_of_two(bits - half)


def exp(x: Array) -> Array:
    """Exponential function."""
    # The rounding error of the reduced argument is left out: 0.2 ulp for three operations.
    k, bits = _nearest(x * (1 / math.log(2)))
    w, d = _exp_terms((x - k * _LOG_2[0]) - k * _LOG_2[1])

    def extreme(x, value, bits):
        value = _where(x > 710.0, math.inf, _scaled_twice(value, bits))
        value = _where(x < -746.0, 0.0, value)
        return _where(x == x, value, x)

    value = w + d
    return _unless(lax.abs(x) < _EXP_LIMIT, _scaled(value, bits), extreme, x, value, bits)


def _exp2_terms(high: Array, low: Real) -> tuple[Array, Array]:
    """w + d = 2^(high + low), |high| ≤ 1/2, |low| below 2^−25 |high| or 2^−25."""
    head = _head(high)
    low = (high - head) + low
    # (head + low) log 2 as a rounded sum and its error; the first product is exact.
    r, y = _fast_two_sum(
        head * _LOG_2_HEAD[0], head * _LOG_2_HEAD[1] + low * (_LOG_2_HEAD[0] + _LOG_2_HEAD[1])
    )
    return _exp_terms(r, y)


def exp2(x: Array) -> Array:
    """Power of 2."""
    k, bits = _nearest(x)
    w, d = _exp2_terms(x - k, np.float64(0.0))

    def extreme(x, value, bits):
        value = _where(x >= 1024.0, math.inf, _scaled_twice(value, bits))
        value = _where(x < -1076.0, 0.0, value)
        return _where(x == x, value, x)

    value = w + d
    return _unless(lax.abs(x) < 1021.0, _scaled(value, bits), extreme, x, value, bits)


def _expm1_terms(x: Array) -> tuple[Array, Array]:
    r"""e^x − 1 as a rounded value's two terms, the first the larger one, for |x| < 708.

    e^x − 1 = (2^k − 1) + 2^k r + 2^k (e^r − 1 − r), where the first two terms are summed without
    error: 2^k − 1 is 0 or larger in size than the second, and exact where that matters.
    """
    r, y, bits = _exp_reduced(x)
    z = r * r
    scale = _power_of_two(bits)
    w, e = _fast_two_sum(scale - 1.0, scale * r)
    return w, e + scale * (z * _split_polynomial(r, z, _EXP) + y)


def expm1(x: Array) -> Array:
    """e^x − 1."""
    w, d = _expm1_terms(x)

    def extreme(x):
        value = _where(x > 0.0, exp(x), -1.0)
        return _where(x == x, value, x)

    value = _unless(lax.abs(x) < _EXP_LIMIT, w + d, extreme, x)
    return _where(x == 0.0, x, value)  # −0


def _exp_half(size: Array) -> Array:
    """e^size/2 for size ≥ 708."""
    r, y, bits = _exp_reduced(size)
    w, d = _exp_terms(r, y)
    value = _scaled_twice(w + d, bits - np.int64(1))
    value = _where(size > 711.0, math.inf, value)
    return _where(size == size, value, size)


def sinh(x: Array) -> Array:
    """Hyperbolic sine: with t = e^|x| − 1, (t + t/(t + 1))/2."""
    size = lax.abs(x)
    t, dt = _fast_two_sum(*_expm1_terms(size))
    n, dn = _two_sum(t, np.float64(1.0))
    quotient = t / n
    # 1/n to first order is 1 − quotient.
    rest = dt + (dt - quotient * (dn + dt)) * (1.0 - quotient)
    value = 0.5 * ((t + quotient) + rest)
    return _with_sign_of(_unless(size < _EXP_LIMIT, value, _exp_half, size), _bits(x))


def cosh(x: Array) -> Array:
    """Hyperbolic cosine: with E = e^|x|, (E + 1/E)/2."""
    size = lax.abs(x)
    r, y, bits = _exp_reduced(size)
    w, d = _exp_terms(r, y)
    scale = _power_of_two(bits)
    total, e = _fast_two_sum(scale * w, 1.0 / (scale * (w + d)))
    value = 0.5 * (total + (e + scale * d))
    return _unless(size < _EXP_LIMIT, value, _exp_half, size)


def tanh(x: Array) -> Array:
    """Hyperbolic tangent: with t = e^(2|x|) − 1, t/(t + 2)."""
    size = lax.abs(x)
    size = _where(size > 22.0, 22.0, size)  # where the value is 1 to rounding
    t, dt = _fast_two_sum(*_expm1_terms(2.0 * size))
    n, dn = _two_sum(t, np.float64(2.0))
    quotient = t / n
    # 1/n to first order is (1 − quotient)/2.
    value = quotient + (dt - quotient * (dn + dt)) * (0.5 - 0.5 * quotient)
    return _with_sign_of(value, _bits(x))


def logistic(x: Array) -> Array:
    """1/(1 + e^−x), as E/(1 + E) for x < 0, E = e^−|x|."""
    size = lax.abs(x)
    r, y, bits = _exp_reduced(-size)
    w, d = _exp_terms(r, y)
    scale = _power_of_two(bits)
    e, de = _fast_two_sum(scale * w, scale * d)
    n, dn = _fast_two_sum(np.float64(1.0), e)
    dn = dn + de
    is_negative = x < 0.0
    quotient = _where(is_negative, e, 1.0) / n
    inverse = _where(is_negative, 1.0 - quotient, quotient)  # 1/n to first order
    value = quotient + (_where(is_negative, de, 0.0) - quotient * dn) * inverse

    def extreme(x):
        return _where(x > 0.0, 1.0, exp(x))  # NaN too

    return _unless(size < _EXP_LIMIT, value, extreme, x)


# --- log, log1p and inverse hyperbolic functions ----------------------------------------------

_LOG = (
    0.6666666666666734,
    0.3999999999941768,
    0.2857142874176449,
    0.22222198632414725,
    0.181835614921945,
    0.15314116931616362,
    0.14795345075993865,
)
_ROOT_HALF = np.int64(0x3FE6_A09E_667F_3BCD)
_TINY = 2.0**-1022
"""The smallest normal number."""


def _normalised(x: Array) -> tuple[Array, Array]:
    """(k, m) with x = 2^k m, √½ ≤ m < √2, for a normal x > 0."""
    bits = _bits(x) + (_ONE - _ROOT_HALF)
    return _exponent(bits), _float((bits & _FRACTION) + _ROOT_HALF)


def _exponent(bits: Array) -> Array:
    """The exponent of a positive number as a float."""
    # In the last bits of 2⁵² it becomes a float without a conversion.
    exponent = _float(_shift_right(bits, 52) | np.int64(0x4330_0000_0000_0000))
    return exponent - (2.0**52 + 1023)


def _log_sum(x: Array, e: Array | None = None, shift: float = 0.0) -> Array:
    r"""log(x + e) + `shift` log 2 for a normal x and |e| of the size of its rounding error.

    With x = 2^k m, f = m − 1, s = f/(2 + f), z = s²,

        log x = k log 2 + f − (f²/2 − s (f²/2 + z P(z))),   log(1 + e/x) = 2^−k e/(1 + f)

    and 1/(1 + f) = (1 − s)/(1 + s) by the first terms of its series.
    """
    k, m = _normalised(x)
    k = k + shift if shift else k
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    half = 0.5 * f * f
    small = k * _LOG_2[1]
    if e is not None:
        inverse = _float((_bits(m) - _bits(x)) + _ONE)
        small = small + (e * inverse) * (1.0 - (2.0 * s) * (1.0 - s))
    series = s * (half + z * _split_polynomial(z, z * z, _LOG))
    return k * _LOG_2[0] - ((half - (series + small)) - f)


def log(x: Array) -> Array:
    """Natural logarithm."""

    def extreme(x):
        value = _log_sum(x * 2.0**54, shift=-54.0)
        value = _where(x >= _TINY, x, value)  # ∞
        value = _where(x > 0.0, value, math.nan)
        return _where(x == 0.0, -math.inf, value)

    return _unless((x >= _TINY) & (x < math.inf), _log_sum(x), extreme, x)


def log1p(x: Array) -> Array:
    """log(1 + x), from the rounded sum and its error."""

    def extreme(x):
        value = _where(x > 0.0, log(x), _where(x == -1.0, -math.inf, math.nan))
        return _where(x == x, value, x)

    value = _log_sum(*_two_sum(x, np.float64(1.0)))
    value = _unless((x > -1.0) & (x < 2.0**500), value, extreme, x)
    return _where(x == 0.0, x, value)  # −0


def _log1p_sum(z: Array, e: Array) -> Array:
    """log(1 + z + e), 0 ≤ z < 2⁶⁰⁰, |e| below the rounding error of z."""
    total, rest = _two_sum(z, np.float64(1.0))
    return _log_sum(total, rest + e)


def _log_double(x: Array) -> Array:
    """log(2x) for x ≥ 2⁵⁰⁰, NaN for NaN."""
    return _where(x < math.inf, _log_sum(x, shift=1.0), x)


def asinh(x: Array) -> Array:
    """Inverse hyperbolic sine: log(1 + z) with z = |x| + x²/(1 + √(1 + x²))."""
    size = lax.abs(x)
    square = size * size
    z, e = _fast_two_sum(size, square / (1.0 + lax.sqrt(1.0 + square)))
    value = _unless(size < 2.0**500, _log1p_sum(z, e), _log_double, size)
    return _with_sign_of(value, _bits(x))


def acosh(x: Array) -> Array:
    """Inverse hyperbolic cosine: log(1 + z) with t = x − 1, z = t + √(2t + t²)."""
    t = x - 1.0
    z, e = _fast_two_sum(lax.sqrt(2.0 * t + t * t), t)

    def extreme(x):
        return _where(x < 1.0, math.nan, _log_double(x))

    return _unless((x >= 1.0) & (x < 2.0**500), _log1p_sum(z, e), extreme, x)


def atanh(x: Array) -> Array:
    """Inverse hyperbolic tangent: log(1 + z)/2 with z = 2|x|/(1 − |x|)."""
    size = lax.abs(x)
    n, dn = _fast_two_sum(np.float64(1.0), -size)
    z = 2.0 * size / n
    # The error of n, with 1/n = 1 + z/2.
    value = 0.5 * _log1p_sum(z, -(z * dn) * (1.0 + 0.5 * z))
    value = _where(size == 1.0, math.inf, _where(size > 1.0, math.nan, value))
    return _with_sign_of(value, _bits(x))


# --- powers -----------------------------------------------------------------------------------

# 2/log 2 times 1, 1/3 (its first 26 bits and the rest), and (1/5, 1/7, …) joined in a polynomial.
_LOG2_1 = float.fromhex("0x1.71547652b82fep+1"), float.fromhex("0x1.777d0ffda0d24p-55")
_LOG2_3 = float.fromhex("0x1.ec709d8p-1"), float.fromhex("0x1.0e80ff5d27f05p-27")
_LOG2_5 = (
    0.5770780163555878,
    0.41219858310117996,
    0.3205989111330921,
    0.2623006008120142,
    0.22393777798638248,
)
# Where the interval of c begins, c, and log2 c to 40 bits after the point and the rest.
_LOG2_CENTRES = (
    (1.125, 1.265625, float.fromhex("0x1.5c01a39fbcp-2"), float.fromhex("0x1.6879fa00b120ap-42")),
    (1.42, 1.59375, float.fromhex("0x1.5848226988p-1"), float.fromhex("0x1.d33c38d8bd28dp-41")),
    (1.785, 2.0, 1.0, 0.0),
)


def _log2_terms(x: Array, shift: float = 0.0) -> tuple[Array, Array]:
    r"""log2 x + `shift` as a rounded value and its error, to 2^−67 of it, for a normal x > 0.

    x = 2^k m, 1 ≤ m < 2, and with c one of 1, 1.27, 1.59, 2 next to m, s = (m − c)/(m + c), z = s²

    log2 x = k + log2 c + s G,   G = 2/log 2 (1 + z/3 + z²/5 + …),   |s| < 0.06.

    s, G and products are sums of two numbers, the first of 26 bits, so that no product is rounded
    that matters.
    """
    bits = _bits(x)
    m = _float((bits & _FRACTION) | _ONE)
    c: Array | float = 1.0
    k: Array | float = 0.0
    dk: Array | float = 0.0
    for begin, centre, high, low in _LOG2_CENTRES:
        is_beyond = m > begin
        c = _where(is_beyond, centre, c)
        k, dk = _where(is_beyond, high, k), _where(is_beyond, low, dk)
    k = k + (_exponent(bits) + shift if shift else _exponent(bits))

    f = m - c
    n = m + c
    inverse = 1.0 / n
    n_head = _head(n)
    n_rest = (c - n_head) + m
    s = _head(f * inverse)
    ds = ((f - s * n_head) - s * n_rest) * inverse

    square = s * s
    z_head = _head(square)
    dz = (square - z_head) + ds * (s + s + ds)
    z = z_head + dz
    leading = z_head * _LOG2_3[0]
    rest = z * (_LOG2_3[1] + z * _polynomial(z, _LOG2_5)) + dz * _LOG2_3[0]
    g = _head(_LOG2_1[0] + leading)
    dg = ((_LOG2_1[0] - g) + leading) + (rest + _LOG2_1[1])

    value, e = _fast_two_sum(k, s * g)  # k is 0 or the larger one
    return _fast_two_sum(value, e + (dk + (s * dg + ds * (g + dg))))


def _product_terms(y: Array, log: tuple[Array, Array]) -> tuple[Array, Array]:
    """The product of y and the sum of two numbers: the first term has 52 bits, exactly."""
    y_head, log_head = _head(y), _head(log[0])
    rest = y_head * (log[0] - log_head) + (y - y_head) * log[0]
    return y_head * log_head, rest + y * log[1]


def pow(x: Array, y: Array) -> Array:
    """x^y = 2^(y log2 x), with the special values of C99."""
    high, low = _product_terms(y, _log2_terms(x))
    k, bits = _nearest(high)
    w, d = _exp2_terms(high - k, low)
    is_ordinary = (x >= _TINY) & (x < math.inf) & (lax.abs(high) < 1021.0)
    return _unless(is_ordinary, _scaled(w + d, bits), _pow_extreme, x, y)


def _pow_extreme(x: Array, y: Array) -> Array:
    """The same for every x and y."""
    size = lax.abs(x)
    is_0 = size == 0.0
    is_limit = is_0 | (size == math.inf)
    is_subnormal = size < _TINY
    # Beyond these limits of y and of the exponent the power is 0, 1 or ∞, and they avoid ∞ − ∞.
    bounded = _where(lax.abs(y) > 2.0**65, _where(y > 0.0, 2.0**65, -(2.0**65)), y)
    log, d_log = _log2_terms(_where(is_subnormal, size * 2.0**54, size))
    exact, e = _two_sum(log, _where(is_subnormal, -54.0, 0.0))
    high, low = _product_terms(bounded, _fast_two_sum(exact, e + d_log))
    is_far = lax.abs(high) > 2000.0
    high = _where(is_far, _where(high > 0.0, 2000.0, -2000.0), high)
    low = _where(is_far, 0.0, low)
    k, bits = _nearest(high)
    w, d = _exp2_terms(high - k, low)
    value = _scaled_twice(w + d, bits)

    value = _where(is_limit, _where(is_0 ^ (y < 0.0), 0.0, math.inf), value)
    is_integer = lax.floor(y) == y
    half = 0.5 * y
    is_odd = is_integer & (lax.floor(half) != half)
    value = _where(is_odd & (_bits(x) < 0), -value, value)
    value = _where((x < 0.0) & ~(is_limit | is_integer), math.nan, value)
    value = _where(x == x, _where(y == y, value, y), x)
    return _where((x == 1.0) | (y == 0.0), 1.0, value)


def half_integer_power(twice: int) -> Callable[[Array], Array]:
    """The function x^(twice/2) of odd `twice`: products, a root, and a quotient if negative.

    Errors grow by about one ulp per product. Intermediate results leave the range of normal numbers
    only if x^(|twice|/2) does.
    """
    if twice % 2 == 0:
        raise ValueError(f"half_integer_power: twice must be odd, got {twice}")
    count = abs(twice) // 2
    at_infinity, at_0 = (0.0, math.inf) if twice < 0 else (math.inf, 0.0)

    def power(x: Array) -> Array:
        value, factor, remaining = lax.sqrt(x), x, count
        while remaining:
            value = value * factor if remaining % 2 else value
            remaining //= 2
            factor = factor * factor if remaining else factor
        value = 1.0 / value if twice < 0 else value
        value = _where(x == 0.0, at_0, value)  # −0 and −∞ included, as in C99
        return _where(lax.abs(x) == math.inf, at_infinity, value)

    return power


_CBRT = (
    1.6662787377309156,
    -1.1623973573078166,
    0.6846527077322325,
    -0.21636185469244387,
    0.02778280101858424,
)
"""m^(−1/3) for 1 ≤ m ≤ 2, to 2^−14."""


def cbrt(x: Array) -> Array:
    r"""Cube root, without a quotient.

    |x| = 2^(3k) v, 1 ≤ v < 8. y ≈ v^(−1/3) from a polynomial is corrected once in third order,
    t = v y² is cut to 26 bits, and v − t³, whose products are exact, gives the rest.
    """
    size = lax.abs(x)

    def normal(size, shift):
        bits = _bits(size)
        m = _float((bits & _FRACTION) | _ONE)
        exponent = _exponent(bits)
        k, k_bits = _nearest(exponent * (1 / 3) - 1 / 3)
        j = exponent - 3.0 * k
        v = m * _where(j > 0.5, _where(j > 1.5, 4.0, 2.0), 1.0)
        start = _where(j > 0.5, _where(j > 1.5, 4.0 ** (-1 / 3), 2.0 ** (-1 / 3)), 1.0)
        y = _polynomial(m, _CBRT) * start
        h = 1.0 - (v * y) * (y * y)
        y = y + y * h * (1 / 3 + 2 / 9 * h)
        square = y * y
        t = v * square
        head = _head(t)
        cube = head * head
        cube_head = _head(cube)
        rest = (v - cube_head * head) - (cube - cube_head) * head
        value = head + rest * (square * (1 / 3)) * (1.0 + (t - head) * y)
        return _scaled(value, k_bits - np.int64(shift))

    def extreme(size):
        return _where((size > 0.0) & (size < _TINY), normal(size * 2.0**54, 18), size)

    value = _unless((size >= _TINY) & (size < math.inf), normal(size, 0), extreme, size)
    return _with_sign_of(value, _bits(x))


# --- error functions --------------------------------------------------------------------------

_ERF = (
    0.1283791670955126,
    -0.37612638903183715,
    0.11283791670952596,
    -0.026866170644428485,
    0.005223977615420539,
    -0.0008548326188759752,
    0.00012055289567541706,
    -1.4924196305569617e-05,
    1.643068417974155e-06,
    -1.5940066854661717e-07,
    1.1472499701094691e-08,
)
"""(erf x − x)/x in powers of x², |x| ≤ 3/4."""
_ERFC = (
    0.885637101864549,
    -0.47966144308433484,
    0.22387273334256394,
    -0.08762571665293113,
    0.0273179871925529,
    -0.005992101444580248,
    0.0005111598752947777,
    0.000205659832077786,
    -8.285365527091147e-05,
    2.220139044906247e-06,
    6.227296889502188e-06,
    -1.1155609585865108e-06,
    -4.445714915621324e-07,
    1.5282476354520886e-07,
    3.609493014579401e-08,
    -1.8602784890975483e-08,
    -3.861539904064324e-09,
    2.2184308431273025e-09,
    6.065013745818855e-10,
    -1.9632856778077817e-10,
    -1.0123904659623566e-10,
    -1.1886619779461667e-11,
)
"""(x + 3) e^(x²) erfc x in powers of 1 − 8/(x + 3), 3/4 ≤ x ≤ 28."""
_ERFC_0 = -1.4715825033880924e-17
"""The error of the rounding of the first of them."""


def _erf_rest(x: Array) -> Array:
    """erf x − x for |x| ≤ 3/4."""
    z = x * x
    return x * _split_polynomial(z, z * z, _ERF)


def _erfc_tail(x: Array) -> Array:
    r"""erfc x = e^(−x²) P(v)/(x + 3), v = 1 − 8/(x + 3), for x ≥ 3/4.

    The square is the sum of h² exactly, h being the first 26 bits of x, and (x − h)(x + h).
    """
    x = _where(x > 28.0, 28.0, x)  # where the value is 0 to rounding
    head = _head(x)
    square, d_square = head * head, (x - head) * (x + head)
    k, bits = _nearest(square * (-1 / math.log(2)))
    r, y = _two_sum(-square - k * _LOG_2[0], -(k * _LOG_2[1] + d_square))
    w, d = _exp_terms(r, y)

    n, dn = _two_sum(x, np.float64(3.0))
    n_head = _head(n)
    t = 1.0 / n
    t_head = _head(t)
    # 1/n − t, the products of heads being exact
    residual = (1.0 - t_head * n_head) - t_head * ((n - n_head) + dn)
    t_rest = residual * t
    v = 1.0 - 8.0 * t
    dv = -8.0 * (t_rest - (t - t_head))
    slope = _polynomial(v, [k * c for k, c in enumerate(_ERFC[:5])][1:])
    factor, rest = _fast_two_sum(_ERFC[0], v * _split_polynomial(v, v * v, _ERFC[1:]))
    factor_head = _head(factor)
    factor_rest = (factor - factor_head) + (rest + (_ERFC_0 + slope * dv))

    product = factor_head * t_head
    head = _head(product)
    rest = (product - head) + (factor_head * t_rest + factor_rest * t)
    w_head = _head(w)
    w_rest = (w - w_head) + d
    return _scaled_twice(w_head * head + (w_head * rest + w_rest * (head + rest)), bits)


def erf(x: Array) -> Array:
    """Error function."""
    size = lax.abs(x)
    centre = size + _erf_rest(size)
    value = _unless(size <= 0.75, centre, lambda size: 1.0 - _erfc_tail(size), size)
    return _with_sign_of(value, _bits(x))


def erfc(x: Array) -> Array:
    """Complementary error function."""

    total, e = _two_sum(-x, np.float64(1.0))
    centre = total + (e - _erf_rest(x))

    def tail(x):
        value = _erfc_tail(lax.abs(x))
        return _where(x < 0.0, 2.0 - value, value)

    return _unless(lax.abs(x) <= 0.75, centre, tail, x)


FUNCTIONS: dict[str, Callable[..., Array]] = {
    function.__name__: function
    for function in (
        *(sin, cos, tan, asin, acos, atan, atan2),
        *(sinh, cosh, tanh, asinh, acosh, atanh, logistic),
        *(exp, exp2, expm1, log, log1p, pow, cbrt, erf, erfc),
    )
}
"""From the name of a primitive of JAX to its function of float64 scalars.

For float32 the result of the float64 function is rounded.
"""
