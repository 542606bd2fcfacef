"""exp, exp2, expm1, hyperbolic functions, erf and erfc."""

import math

import numpy as np
from jax import Array, lax

from . import tables
from .parts import (
    ONE_BITS,
    Real,
    bits_of,
    branch_unless,
    fast_two_sum,
    float_of,
    head_of,
    nearest,
    polynomial,
    shift_right,
    split_polynomial,
    two_sum,
    where,
    with_sign_of,
)

LIMIT = 708.0  # for |x| below it e^x is a normal number, and so is e^−x


def exp_reduced(x: Array) -> tuple[Array, Array, Array]:
    """(r, y, bits): r + y = x − k log 2, |r| ≤ (log 2)/2, with k in the last bits of `bits`."""
    k, bits = nearest(x * (1 / math.log(2)))
    high = x - k * tables.LOG_2[0]
    low = k * tables.LOG_2[1]
    r = high - low
    return r, (high - r) - low, bits


def exp_terms(r: Array, y: Array | None = None) -> tuple[Array, Array]:
    """w + d = e^(r + y), |r| ≤ 0.35: the first term is 1 + r rounded, the second is small."""
    z = r * r
    w = 1.0 + r
    series = z * split_polynomial(r, z, tables.EXP)
    return w, ((1.0 - w) + r) + (series if y is None else series + y)


def _power_of_two(bits: Array) -> Array:
    """2^k, |k| ≤ 1022, with k in the last bits of `bits`."""
    return float_of((bits << 52) + ONE_BITS)


def scale_by_power(value: Array, bits: Array) -> Array:
    """`value` 2^k for a normal result, with k in the last bits of `bits`."""
    return float_of(bits_of(value) + (bits << 52))


def scale_in_two_steps(value: Array, bits: Array) -> Array:
    """`value` 2^k for |k| ≤ 2000, with one rounding at the end if the result is subnormal."""
    # In two steps, because 2^k itself may be outside of the range.
    half = shift_right(bits, 1)  # k/2 in the last bits; those above are shifted out
    return (value * _power_of_two(half)) * _power_of_two(bits - half)


def exp(x: Array) -> Array:
    """Exponential function."""
    # The rounding error of the reduced argument is left out: 0.2 ulp for three operations.
    k, bits = nearest(x * (1 / math.log(2)))
    w, d = exp_terms((x - k * tables.LOG_2[0]) - k * tables.LOG_2[1])

    def extreme(x, value, bits):
        value = where(x > 710.0, math.inf, scale_in_two_steps(value, bits))
        value = where(x < -746.0, 0.0, value)
        return where(x == x, value, x)

    value = w + d
    return branch_unless(lax.abs(x) < LIMIT, scale_by_power(value, bits), extreme, x, value, bits)


def exp2_terms(high: Array, low: Real) -> tuple[Array, Array]:
    """w + d = 2^(high + low), |high| ≤ 1/2, |low| below 2^−25 |high| or 2^−25."""
    head = head_of(high)
    low = (high - head) + low
    # (head + low) log 2 as a rounded sum and its error; the first product is exact.
    r, y = fast_two_sum(
        head * tables.LOG_2_HEAD[0],
        head * tables.LOG_2_HEAD[1] + low * (tables.LOG_2_HEAD[0] + tables.LOG_2_HEAD[1]),
    )
    return exp_terms(r, y)


def exp2(x: Array) -> Array:
    """Power of 2."""
    k, bits = nearest(x)
    w, d = exp2_terms(x - k, np.float64(0.0))

    def extreme(x, value, bits):
        value = where(x >= 1024.0, math.inf, scale_in_two_steps(value, bits))
        value = where(x < -1076.0, 0.0, value)
        return where(x == x, value, x)

    value = w + d
    return branch_unless(lax.abs(x) < 1021.0, scale_by_power(value, bits), extreme, x, value, bits)


def _expm1_terms(x: Array) -> tuple[Array, Array]:
    r"""e^x − 1 as a rounded value's two terms, the first the larger one, for |x| < 708.

    e^x − 1 = (2^k − 1) + 2^k r + 2^k (e^r − 1 − r), where the first two terms are summed without
    error: 2^k − 1 is 0 or larger in size than the second, and exact where that matters.
    """
    r, y, bits = exp_reduced(x)
    z = r * r
    scale = _power_of_two(bits)
    w, e = fast_two_sum(scale - 1.0, scale * r)
    return w, e + scale * (z * split_polynomial(r, z, tables.EXP) + y)


def expm1(x: Array) -> Array:
    """e^x − 1."""
    w, d = _expm1_terms(x)

    def extreme(x):
        value = where(x > 0.0, exp(x), -1.0)
        return where(x == x, value, x)

    value = branch_unless(lax.abs(x) < LIMIT, w + d, extreme, x)
    return where(x == 0.0, x, value)  # −0


def _exp_half(size: Array) -> Array:
    """e^size/2 for size ≥ 708."""
    r, y, bits = exp_reduced(size)
    w, d = exp_terms(r, y)
    value = scale_in_two_steps(w + d, bits - np.int64(1))
    value = where(size > 711.0, math.inf, value)
    return where(size == size, value, size)


def sinh(x: Array) -> Array:
    """Hyperbolic sine: with t = e^|x| − 1, (t + t/(t + 1))/2."""
    size = lax.abs(x)
    # From e^x − 1 and not from e^x, which would cancel for small x.
    t, dt = fast_two_sum(*_expm1_terms(size))
    n, dn = two_sum(t, np.float64(1.0))
    quotient = t / n
    # 1/n to first order is 1 − quotient.
    error = dt + (dt - quotient * (dn + dt)) * (1.0 - quotient)
    value = 0.5 * ((t + quotient) + error)
    return with_sign_of(branch_unless(size < LIMIT, value, _exp_half, size), bits_of(x))


def cosh(x: Array) -> Array:
    """Hyperbolic cosine: with E = e^|x|, (E + 1/E)/2."""
    size = lax.abs(x)
    r, y, bits = exp_reduced(size)
    w, d = exp_terms(r, y)
    scale = _power_of_two(bits)
    total, e = fast_two_sum(scale * w, 1.0 / (scale * (w + d)))
    value = 0.5 * (total + (e + scale * d))
    return branch_unless(size < LIMIT, value, _exp_half, size)


def tanh(x: Array) -> Array:
    """Hyperbolic tangent: with t = e^(2|x|) − 1, t/(t + 2)."""
    size = lax.abs(x)
    size = where(size > 22.0, 22.0, size)  # where the value is 1 to rounding
    t, dt = fast_two_sum(*_expm1_terms(2.0 * size))
    n, dn = two_sum(t, np.float64(2.0))
    quotient = t / n
    # 1/n to first order is (1 − quotient)/2.
    value = quotient + (dt - quotient * (dn + dt)) * (0.5 - 0.5 * quotient)
    return with_sign_of(value, bits_of(x))


def logistic(x: Array) -> Array:
    """1/(1 + e^−x), as E/(1 + E) for x < 0, E = e^−|x|."""
    size = lax.abs(x)
    r, y, bits = exp_reduced(-size)
    w, d = exp_terms(r, y)
    scale = _power_of_two(bits)
    e, de = fast_two_sum(scale * w, scale * d)
    n, dn = fast_two_sum(np.float64(1.0), e)
    dn = dn + de
    is_negative = x < 0.0
    quotient = where(is_negative, e, 1.0) / n
    inverse = where(is_negative, 1.0 - quotient, quotient)  # 1/n to first order
    value = quotient + (where(is_negative, de, 0.0) - quotient * dn) * inverse

    def extreme(x):
        return where(x > 0.0, 1.0, exp(x))  # NaN too

    return branch_unless(size < LIMIT, value, extreme, x)


# --- error functions --------------------------------------------------------------------------


def _erf_rest(x: Array) -> Array:
    """erf x − x for |x| ≤ 3/4."""
    z = x * x
    return x * split_polynomial(z, z * z, tables.ERF)


def _erfc_tail(x: Array) -> Array:
    r"""erfc x = e^(−x²) P(v)/(x + 3), v = 1 − 8/(x + 3), for x ≥ 3/4.

    The square is the sum of h² exactly, h being the first 26 bits of x, and (x − h)(x + h).
    """
    x = where(x > 28.0, 28.0, x)  # where the value is 0 to rounding
    head = head_of(x)
    square, d_square = head * head, (x - head) * (x + head)
    k, bits = nearest(square * (-1 / math.log(2)))
    r, y = two_sum(-square - k * tables.LOG_2[0], -(k * tables.LOG_2[1] + d_square))
    w, d = exp_terms(r, y)

    n, dn = two_sum(x, np.float64(3.0))
    n_head = head_of(n)
    t = 1.0 / n
    t_head = head_of(t)
    # 1/n − t, the products of heads being exact
    residual = (1.0 - t_head * n_head) - t_head * ((n - n_head) + dn)
    t_rest = residual * t
    v = 1.0 - 8.0 * t
    dv = -8.0 * (t_rest - (t - t_head))
    slope = polynomial(v, [k * c for k, c in enumerate(tables.ERFC[:5])][1:])
    factor, low = fast_two_sum(tables.ERFC[0], v * split_polynomial(v, v * v, tables.ERFC[1:]))
    factor_head = head_of(factor)
    factor_rest = (factor - factor_head) + (low + (tables.ERFC_0 + slope * dv))

    product = factor_head * t_head
    head = head_of(product)
    low = (product - head) + (factor_head * t_rest + factor_rest * t)
    w_head = head_of(w)
    w_rest = (w - w_head) + d
    return scale_in_two_steps(w_head * head + (w_head * low + w_rest * (head + low)), bits)


def erf(x: Array) -> Array:
    """Error function."""
    size = lax.abs(x)
    centre = size + _erf_rest(size)
    value = branch_unless(size <= 0.75, centre, lambda size: 1.0 - _erfc_tail(size), size)
    return with_sign_of(value, bits_of(x))


def erfc(x: Array) -> Array:
    """Complementary error function."""

    total, e = two_sum(-x, np.float64(1.0))
    centre = total + (e - _erf_rest(x))

    def tail(x):
        value = _erfc_tail(lax.abs(x))
        return where(x < 0.0, 2.0 - value, value)

    return branch_unless(lax.abs(x) <= 0.75, centre, tail, x)
