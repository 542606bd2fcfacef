"""Elementary functions of pairs of float64 numbers."""

# Exponential, sine and cosine are a table at multiples of a step with Taylor's series in between.
# The others are one Newton correction, by these, of the function in float64.

import functools
import math
from collections.abc import Sequence
from decimal import Decimal, localcontext
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from .pairs import Number, Pair, add, as_pair, div, magnitude, mul, negate, power, sqrt, sub, where

_UNIT, _TWO, _HALF = np.float64(1), np.float64(2), np.float64(0.5)

_PER_TURN, _PER_OCTAVE = 128, 64
"""Entries of the tables: sin and cos in 2π, 2^x from 0 to 1."""


def parts(x: Decimal | Fraction, count: int = 2) -> tuple[float, ...]:
    """A number as the sum of `count` float64 numbers, each of which is the remainder rounded."""
    # Fractions are exact; a difference of decimals would be rounded to the context's digits.
    remainder, terms = Fraction(x), []
    for _ in range(count):
        terms.append(float(remainder))
        remainder -= Fraction(terms[-1])
    return tuple(terms)


@functools.cache
def _tables() -> tuple[tuple[float, ...], np.ndarray, tuple[float, ...], np.ndarray]:
    """2π/128 in parts, rows (sin, its lo, cos, its lo) at its multiples; ln2/64 in parts, rows (hi,
    lo) of 2^(i/64)."""
    with localcontext() as context:
        context.prec = 60

        def arctan_of_inverse(n: int) -> Decimal:
            odd = range(1, 199, 2)
            return sum(((2 - k % 4) / (Decimal(k) * Decimal(n) ** k) for k in odd), Decimal(0))

        turn = 8 * (4 * arctan_of_inverse(5) - arctan_of_inverse(239))  # 2π (Machin)
        quarter, circle = _PER_TURN // 4, []
        for i in range(_PER_TURN):
            # sin x = sin(π − x), cos x = −cos(π − x): the series is summed for |x| ≤ π/2.
            is_mirrored = quarter < i < 3 * quarter
            k = 2 * quarter - i if is_mirrored else i if i <= quarter else i - _PER_TURN
            x, term, sums = turn * k / _PER_TURN, Decimal(1), [Decimal(0), Decimal(0)]
            for n in range(60):
                sums[n % 2] += term * (-1) ** (n // 2)
                term *= x / (n + 1)
            cosine = 0 if abs(k) == quarter else sums[0]
            circle.append((*parts(sums[1].quantize(Decimal("1e-50"))), *parts(Fraction(cosine))))
            circle[-1] = (*circle[-1][:2], *(-c if is_mirrored else c for c in circle[-1][2:]))
        step = Decimal(2).ln() / _PER_OCTAVE
        powers = [parts((step * i).exp()) for i in range(_PER_OCTAVE)]
        return parts(turn / _PER_TURN, 3), np.array(circle), parts(step, 3), np.array(powers)


def _constant(x: Decimal | Fraction) -> Number:
    hi, lo = map(np.float64, parts(x))
    return Pair(hi, lo) if lo else hi  # pyright: ignore[reportArgumentType]


def _reduce(x: Pair, step: Sequence[float]) -> tuple[Array, Pair]:
    """k and x − k·step, with the integer k nearest to x/step."""
    # The multiple is subtracted part by part: 159 bits of the step are enough for |k| < 2⁴⁵.
    k = jnp.round(x.hi * (1 / step[0]))
    for part in step:
        x = sub(x, mul(k, np.float64(part)))
    return k, x


def _row(table: np.ndarray, k: Array) -> Array:
    """The row number k modulo their count."""
    # In floating point, because k may be larger than an integer of 32 bits.
    index = (k - len(table) * jnp.floor(k * (1 / len(table)))).astype(jnp.int32)
    return jnp.asarray(table).at[index].get(mode="clip")


def _series(x: Pair, coefficients: Sequence[Fraction], in_pairs: int) -> Number:
    """Σ c_n xⁿ of a small x, the terms from n = `in_pairs` on in float64."""
    total: Number = jnp.zeros_like(x.hi)
    for c in reversed(coefficients[in_pairs:]):
        total = total * x.hi + float(c)
    for c in reversed(coefficients[:in_pairs]):
        total = add(mul(x, total), _constant(c))
    return total


# The last term is below 1e-33 of the sum, and so is the rounding of the terms in float64.
_SINE = [Fraction((-1) ** n, math.factorial(2 * n + 1)) for n in range(1, 8)]
_COSINE = [Fraction((-1) ** n, math.factorial(2 * n)) for n in range(1, 8)]
_EXPONENTIAL = [Fraction(1, math.factorial(n)) for n in range(2, 13)]


_LARGEST_ANGLE = 2.0**45
"""Of larger angles, the step in three parts is not accurate enough."""


def sin_cos(x: Number) -> tuple[Pair, Pair]:
    """sin x and cos x, NaN for |x| > 2⁴⁵."""
    step, circle, *_ = _tables()
    x = as_pair(x)
    x = Pair(jnp.where(jnp.abs(x.hi) <= _LARGEST_ANGLE, x.hi, jnp.nan), x.lo)
    k, r = _reduce(x, step)
    row = _row(circle, k)
    s, c = Pair(row[..., 0], row[..., 1]), Pair(row[..., 2], row[..., 3])
    square = mul(r, r)
    sine = add(r, mul(mul(r, square), _series(square, _SINE, 3)))
    cosine_less_one = mul(square, _series(square, _COSINE, 3))  # its digits do not cancel
    # The addition theorems, small terms first: their sum and the table share few digits.
    sum_of_sines = add(s, add(mul(c, sine), mul(s, cosine_less_one)))
    return sum_of_sines, add(c, sub(mul(c, cosine_less_one), mul(s, sine)))


def _exponential(x: Number) -> tuple[Pair, Pair]:
    """(2^(k/64), e^r − 1) with x = k ln2/64 + r."""
    *_, step, powers = _tables()
    k, r = _reduce(as_pair(x), step)
    row = _row(powers, k)
    octave = jnp.floor(k * (1 / _PER_OCTAVE))
    half = jnp.floor(octave * 0.5)
    # Two factors, so that each is a normal number.
    scale = [_power_of_two(half), _power_of_two(octave - half)]
    power = Pair(row[..., 0] * scale[0] * scale[1], row[..., 1] * scale[0] * scale[1])
    return power, add(r, mul(mul(r, r), _series(r, _EXPONENTIAL, 5)))


def _power_of_two(n: Array) -> Array:
    exponent = jnp.clip(n + 1023, 0, 2047).astype(jnp.int64)
    # The bits of the exponent: jnp.exp2 need not be exact.
    return lax.bitcast_convert_type(exponent << 52, jnp.float64)


def _multiple(x: Number, factor: Array) -> Any:
    """x times a power of two, which is exact: a product would lose the smallest numbers."""
    return jax.tree.map(lambda part: part * factor, x)


def exp(x: Number) -> Pair:
    power, change = _exponential(x)
    return _in_range(x, add(power, mul(power, change)), jnp.exp(as_pair(x).hi))


def expm1(x: Number) -> Pair:
    """eˣ − 1."""
    power, change = _exponential(x)
    value = add(sub(power, _UNIT), mul(power, change))
    return _in_range(x, value, jnp.expm1(as_pair(x).hi))


def _in_range(x: Number, value: Pair, plain: Array) -> Pair:
    """The pair, or the value in float64 where that is 0 or infinite, or x is."""
    good = jnp.isfinite(as_pair(x).hi) & jnp.isfinite(plain) & (plain != 0)
    return Pair(jnp.where(good, value.hi, plain), jnp.where(good, value.lo, 0.0))


def _logarithm(x: Number, excess: Number, guess: Array) -> Pair:
    """log x near a guess y, from x and `excess`, x − 1: y + log(1 + δ) with δ = x e⁻ʸ − 1."""
    # Where e⁻ʸ has too few digits, next to the smallest numbers, that of x/2^n, n = ±512.
    n = jnp.where(jnp.abs(guess) > 300, jnp.sign(guess) * 512, 0)
    octave = Pair(*(64 * n * part for part in _tables()[2][:2]))  # n ln 2
    x = _multiple(x, _power_of_two(-n))
    guess = jnp.where(jnp.isfinite(guess), guess - octave.hi, guess)
    power, change = _exponential(-guess)
    shrunk = add(sub(power, _UNIT), mul(power, change))  # e⁻ʸ − 1
    small = add(excess, mul(x, shrunk))  # near x = 1 the digits of x e⁻ʸ − 1 would cancel
    large = sub(mul(x, add(power, mul(power, change))), _UNIT)
    delta = where(jnp.abs(guess) < 0.5, small, large)
    d = delta.hi  # pyright: ignore[reportAttributeAccessIssue]
    # log(1 + δ) to third order: δ is the error of the guess, and may be 1e-16.
    value = add(octave, add(guess, add(delta, d * d * (d * (1 / 3) - 0.5))))
    good = jnp.isfinite(guess)
    return Pair(jnp.where(good, value.hi, guess), jnp.where(good, value.lo, 0.0))


def log(x: Number) -> Pair:
    return _logarithm(x, sub(x, _UNIT), jnp.log(as_pair(x).hi))


def log1p(x: Number) -> Pair:
    """log(1 + x)."""
    return _logarithm(add(x, _UNIT), x, jnp.log1p(as_pair(x).hi))


def exp2(x: Number) -> Pair:
    return _in_range(x, exp(mul(x, log(_TWO))), jnp.exp2(as_pair(x).hi))


def log2(x: Number) -> Pair:
    return div(log(x), log(_TWO))


def general_power(x: Number, y: Number) -> Pair:
    """xʸ = ± exp(y log |x|), NaN for x < 0 unless y is an integer."""
    plain = jnp.power(as_pair(x).hi, as_pair(y).hi)
    value = exp(mul(y, log(magnitude(x))))
    return _in_range(x, where(plain < 0, negate(value), value), plain)


def root_power(x: Number, n: int) -> Number:
    """x^(n/2)."""
    root = sqrt(x)
    return power(root, n) if abs(n) == 1 else mul(power(x, n // 2), root)


def cbrt(x: Number) -> Pair:
    # Products of small numbers would have too few digits.
    x = as_pair(x)
    is_small = jnp.abs(x.hi) < 2.0**-300
    root = _cube_root(_multiple(x, jnp.where(is_small, 2.0**600, 1.0)))
    return _multiple(root, jnp.where(is_small, 2.0**-200, 1.0))


def _cube_root(x: Pair) -> Pair:
    root = jnp.cbrt(x.hi)
    defect = as_pair(sub(x, power(root, 3))).hi / (3 * root * root)
    return add(root, jnp.where((root != 0) & jnp.isfinite(root), defect, 0.0))


def tan(x: Number) -> Pair:
    return div(*sin_cos(x))


def atan2(y: Number, x: Number) -> Pair:
    """The angle of the point (x, y)."""
    guess = jnp.arctan2(as_pair(y).hi, as_pair(x).hi)
    s, c = sin_cos(guess)
    # The remaining angle is across/along, with the point turned by −guess.
    sine, cosine = sub(mul(y, c), mul(x, s)), add(mul(x, c), mul(y, s)).hi
    return add(guess, jnp.where(cosine > 0, sine.hi / cosine, 0.0))


def _leg(x: Number) -> Pair:
    """√(1 − x²)."""
    return sqrt(mul(sub(_UNIT, x), add(_UNIT, x)))


def asin(x: Number) -> Pair:
    return atan2(x, _leg(x))


def acos(x: Number) -> Pair:
    return atan2(_leg(x), x)


def atan(x: Number) -> Pair:
    return atan2(x, _UNIT)


def _odd(of_magnitude: Number, x: Number) -> Number:
    """The value of an odd function from that at |x|."""
    return where(as_pair(x).hi < 0, negate(of_magnitude), of_magnitude)


def sinh(x: Number) -> Number:
    # (e + e/(e + 1))/2 with e = e^|x| − 1, whose digits do not cancel near x = 0.
    e = expm1(magnitude(x))
    return _odd(mul(add(e, div(e, add(e, _UNIT))), _HALF), x)


def cosh(x: Number) -> Number:
    e = exp(magnitude(x))
    return mul(add(e, div(_UNIT, e)), _HALF)


def tanh(x: Number) -> Number:
    # e/(e + 2) with e = e^(2|x|) − 1; it is 1 to 34 digits for larger x, where e would overflow.
    size = magnitude(x)
    e = expm1(mul(where(as_pair(size).hi > 40, np.float64(40), size), _TWO))
    return _odd(div(e, add(e, _TWO)), x)


def asinh(x: Number) -> Number:
    """arsinh x = log(x + √(1 + x²))."""
    size, unit = magnitude(x), _UNIT
    square = mul(size, size)
    return _odd(log1p(add(size, div(square, add(unit, sqrt(add(square, unit)))))), x)


def acosh(x: Number) -> Pair:
    """arcosh x = log(x + √(x² − 1))."""
    excess = sub(x, _UNIT)
    return log1p(add(excess, sqrt(mul(excess, add(x, _UNIT)))))


def atanh(x: Number) -> Number:
    """artanh x = log((1 + x)/(1 − x))/2."""
    size = magnitude(x)
    ratio = div(mul(size, _TWO), sub(_UNIT, size))
    return _odd(mul(log1p(ratio), _HALF), x)


def logistic(x: Number) -> Pair:
    """1/(1 + e⁻ˣ)."""
    return div(_UNIT, add(exp(negate(x)), _UNIT))
