r"""Elementary functions in float64 arithmetic, for a code generator that emits each of them once.

Every function takes and returns scalar float64 values of JAX and traces to a jaxpr of additions,
products, quotients, square roots, comparisons, selections, integer arithmetic on the bits of a
number, and `lax.cond` for rare arguments. `jax.vmap` applies it to arrays.

The stated errors hold whether or not a compiler contracts a product and a sum into a fused
multiply-add: a product that must be exact has few enough bits. They also assume that sums are not
reassociated, and that subnormal numbers are not replaced by zero.
"""

import itertools
import math
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

# --- bits and selections ----------------------------------------------------------------------

_SIGN = np.int64(-(2**63))
_FRACTION = np.int64(2**52 - 1)
_LOW_HALF = np.int64(2**32 - 1)
_ONE = np.int64(0x3FF0_0000_0000_0000)


def _bits(x: Array) -> Array:
    return lax.bitcast_convert_type(x, jnp.int64)


def _float(bits: Array) -> Array:
    return lax.bitcast_convert_type(bits, jnp.float64)


def _shift_right(bits: Array, count: int | Array) -> Array:
    """Logical shift: zeros enter from the left."""
    return lax.shift_right_logical(bits, np.int64(count) if isinstance(count, int) else count)


def _where(condition: Array, x: Array | float, y: Array | float) -> Array:
    """`jnp.where` of float64 scalars as one primitive, without a nested jit."""
    return lax.select(
        condition,
        np.float64(x) if isinstance(x, int | float) else x,
        np.float64(y) if isinstance(y, int | float) else y,
    )


def _nearest(x: Array) -> tuple[Array, Array]:
    """The integer k nearest to x, |x| < 2⁵¹, as a float and in the last bits of an integer.

    The sum of k and 1.5·2⁵² has k in its last bits, which saves a conversion to an integer. It
    would round as well, but XLA simplifies x + c − c to x.
    """
    k = lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN)
    return k, _bits(k + 1.5 * 2.0**52)


def _with_sign_of(value: Array, sign: Array) -> Array:
    """`value` ≥ 0 with the sign bit of the integer `sign`."""
    return _float(_bits(value) ^ (sign & _SIGN))


def _polynomial(z: Array, coefficients: Sequence[float]) -> Array:
    """Value of c0 + c1 z + c2 z² + … by Horner's scheme."""
    value = coefficients[-1]
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
    h_high = _float(_bits(h) & np.int64(-(2**27)))
    h_low = h - h_high
    first = h_high * _HALF_PI_3[0]
    second = (h_high * _HALF_PI_3[1] + h_low * _HALF_PI_3[0]) + (
        (h_low * _HALF_PI_3[1] + h_high * _HALF_PI_3[2]) + g * (math.pi / 2)
    )
    r, y = _fast_two_sum(first, second)
    r = _where(size < math.inf, r, math.nan)
    return _float(_bits(r) ^ sign), _float(_bits(y) ^ sign), k


def _fast_two_sum(x: Array, y: Array) -> tuple[Array, Array]:
    """The rounded sum and its error, for |x| ≥ |y| or x = 0 (Dekker 1971)."""
    total = x + y
    return total, (x - total) + y


def _sines(r: Array, y: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """sin and cos of r + y, each as a rounded value's two terms, the first the larger one."""
    z = r * r
    square = z * z
    ds = r * z * _split_polynomial(z, square, _SIN) + y
    w = 1.0 - 0.5 * z
    dc = ((1.0 - w) - 0.5 * z) + (square * _split_polynomial(z, square, _COS) - r * y)
    return (r, ds), (w, dc)


def sincos(x: Array) -> tuple[Array, Array]:
    """sin x and cos x, which share the reduction of the argument."""
    r, y, bits = _reduced(lax.abs(x))
    (r, ds), (w, dc) = _sines(r, y)
    s, c = r + ds, w + dc
    is_odd = (bits & np.int64(1)) != 0
    sine = _float(_bits(lax.select(is_odd, c, s)) ^ (((bits << 62) ^ _bits(x)) & _SIGN))
    turned = (bits + np.int64(1)) << 62  # cos x is −sin, −cos for k = 1, 2 mod 4
    cosine = _float(_bits(lax.select(is_odd, s, c)) ^ (turned & _SIGN))
    return sine, cosine


def sin(x: Array) -> Array:
    """Sine."""
    return sincos(x)[0]


def cos(x: Array) -> Array:
    """Cosine."""
    return sincos(x)[1]


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


def _angle(y: Array, x: Array) -> Array:
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


# --- exp --------------------------------------------------------------------------------------

_EXP = (
    0.5000000000000001,
    0.16666666666666669,
    0.041666666666624164,
    0.008333333333330065,
    0.0013888888917196719,
    0.00019841269863040545,
    2.4801521322368692e-05,
    2.7557268480310024e-06,
    2.7620075879983367e-07,
    2.5100375832561234e-08,
)
# log 2: 42 bits, so that multiples of it are exact, and the rest.
_LOG_2 = float.fromhex("0x1.62e42fefa3p-1"), float.fromhex("0x1.3de6af278ece6p-42")
_EXP_LIMIT = 708.0
"""The largest |x| whose exponential needs no care: e^x is a normal number."""


def _exp_reduced(x: Array) -> tuple[Array, Array, Array]:
    """(r, y, bits): r + y = x − k log 2, |r| ≤ (log 2)/2, with k in the last bits of `bits`."""
    k, bits = _nearest(x * (1 / math.log(2)))
    high = x - k * _LOG_2[0]
    low = k * _LOG_2[1]
    r = high - low
    return r, (high - r) - low, bits


def _exp_terms(r: Array, y: Array) -> tuple[Array, Array]:
    """w + d = e^(r + y), |r| ≤ 0.35: the first term is 1 + r rounded, the second is small."""
    z = r * r
    w = 1.0 + r
    return w, ((1.0 - w) + r) + (z * _split_polynomial(r, z, _EXP) + y)


def _scaled(value: Array, bits: Array) -> Array:
    """`value` 2^k for a normal result, with k in the last bits of `bits`."""
    return _float(_bits(value) + (bits << 52))


def _scaled_twice(value: Array, bits: Array) -> Array:
    """`value` 2^k for |k| ≤ 2000, with one rounding at the end if the result is subnormal."""
    half = _shift_right(bits, 1)  # k/2 in the last bits; those above are shifted out
    first, second = (half << 52) + _ONE, ((bits - half) << 52) + _ONE
    return (value * _float(first)) * _float(second)


def exp(x: Array) -> Array:
    """Exponential function."""
    r, y, bits = _exp_reduced(x)
    w, d = _exp_terms(r, y)
    value = w + d

    def extreme(x, value, bits):
        value = _where(x > 710.0, math.inf, _scaled_twice(value, bits))
        value = _where(x < -746.0, 0.0, value)
        return _where(x == x, value, x)

    def ordinary(x, value, bits):
        del x
        return _scaled(value, bits)

    return lax.cond(lax.abs(x) < _EXP_LIMIT, ordinary, extreme, x, value, bits)


# --- log --------------------------------------------------------------------------------------

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
    # An exponent in the last bits of 2⁵² becomes a float without a conversion.
    exponent = _float(_shift_right(bits, 52) | np.int64(0x4330_0000_0000_0000))
    return exponent - (2.0**52 + 1023), _float((bits & _FRACTION) + _ROOT_HALF)


def _log_normal(x: Array, shift: float = 0.0) -> Array:
    r"""log x + `shift` log 2 = k log 2 + log m, and with f = m − 1, s = f/(2 + f), z = s²

    log m = f − (f²/2 − s (f²/2 + z P(z))).
    """
    k, m = _normalised(x)
    k = k + shift if shift else k
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    half = 0.5 * f * f
    series = s * (half + z * _split_polynomial(z, z * z, _LOG))
    return k * _LOG_2[0] - ((half - (series + k * _LOG_2[1])) - f)


def log(x: Array) -> Array:
    """Natural logarithm."""

    def extreme(x, value):
        del value
        value = _log_normal(x * 2.0**54, -54.0)
        value = _where(x >= _TINY, x, value)  # ∞
        value = _where(x > 0.0, value, math.nan)
        return _where(x == 0.0, -math.inf, value)

    is_ordinary = (x >= _TINY) & (x < math.inf)
    return lax.cond(is_ordinary, lambda x, value: value, extreme, x, _log_normal(x))


FUNCTIONS: dict[str, Callable[..., Array]] = {
    function.__name__: function for function in (sin, cos, tan, atan, atan2, asin, acos, exp, log)
}
"""From the name of a primitive of JAX to its function of float64 scalars."""
