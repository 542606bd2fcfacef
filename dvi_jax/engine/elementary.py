r"""Elementary functions from multiplications and additions, for loops over many lanes.

XLA calls the library lane by lane for sin, cos and others in float64 on a CPU, inside a loop that
is vectorised otherwise. sin, cos and tan are made here of additions, products, floor, comparisons
and selections (tan of a quotient too), so that the loop stays one over vectors; the others take a
quotient or a root, atan2 and log the bits of a number besides.

Errors are below 0.9 ulp for sin, cos and log, 1.2 for acos, 1.5 for atan, 1.7 for tan, asin and
atan2, 4 for half-integer powers. As everywhere in XLA on a CPU, numbers below 2⁻¹⁰²² count as 0.
From some eight lanes on they are faster than the library, not for one lane alone.

Coefficients are those of the polynomial through the function at Chebyshev nodes, pulled so that
one lies at 0 where the error is multiplied by 0; `tests/test_elementary.py` derives them anew.
"""

import functools
import math
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import custom_batching, lax
from jax.typing import ArrayLike
from jaxtyping import Array

Way = Callable[["Elementary"], Callable[..., Array]]
"""Of an elementary function: itself, or its arithmetic alone."""


class Elementary:
    """An elementary function of real arrays of one shape, applied element by element.

    In float64 by own arithmetic, in other dtypes by the library. Derivatives of all orders, forward
    and reverse. A call hands arguments beyond `limit` over to the library: an element that is
    handed over leaves the bits of the others alone, but while there is one, all are evaluated by
    the library too, which takes ten times as long.

    **Attributes**

    - `pure`: the arithmetic alone, NaN beyond `limit`. For kernels that see to large arguments
      themselves: the test for a hand-over splits the loop around it.
    - `limit`: the largest |x| of own arithmetic, inf where there is none.
    - `name`: that of the primitive of JAX.
    """

    name: str
    limit: float
    pure: Callable[..., Array]

    def __init__(
        self,
        name: str,
        arithmetic: Callable[..., Array],
        library: Callable[..., Array],
        slopes: Callable[..., Sequence[Array]],
        limit: float = math.inf,
    ):
        def pure(*xs):
            return arithmetic(*xs) if xs[0].dtype == jnp.float64 else library(*xs)

        def whole(*xs):
            if xs[0].dtype != jnp.float64 or limit == math.inf:
                return pure(*xs)
            return _handed_over(pure, library, limit, *xs)

        self.name, self.limit = name, limit
        self.pure = _differentiable(pure, slopes, attrgetter("pure"))
        self._whole = _differentiable(whole, slopes, lambda function: function)

    def __call__(self, *xs: ArrayLike) -> Array:
        return self._whole(*xs)

    def __repr__(self) -> str:
        return f"<elementary function {self.name}>"


def _differentiable(function, slopes, way: Way):
    """`function` of floating-point arrays of one shape, with its derivatives by `slopes`."""
    compiled = jax.custom_jvp(jax.jit(function, inline=True))

    def rule(primals, tangents):
        value = compiled(*primals)
        change: Any = None
        for slope, tangent in zip(slopes(way, value, *primals), tangents, strict=True):
            part = slope * tangent
            change = part if change is None else change + part
        return value, change

    compiled.defjvp(rule)

    def call(*xs):
        dtype = jnp.result_type(*xs, float)  # float: a whole number is taken for a real one
        return compiled(*jnp.broadcast_arrays(*(jnp.asarray(x, dtype) for x in xs)))

    return call


def _handed_over(pure, library, limit, x):
    """`pure`, and `library` where `limit` < |x| < ∞."""

    # One scalar test for all elements, under vmap as well: a batched condition would evaluate both.
    @custom_batching.custom_vmap
    def of(x):
        beyond = (jnp.abs(x) > limit) & (jnp.abs(x) < jnp.inf)

        def with_library():
            # The barrier: the same program as without the library, hence the same bits.
            return jnp.where(beyond, library(x), lax.optimization_barrier(pure(x)))

        return lax.cond(jnp.any(beyond), with_library, lambda: pure(x))

    @of.def_vmap
    def of_more(axis_size, in_batched, x):
        del axis_size
        return of(x), in_batched[0]

    return of(x)


def _polynomial(z: Array, coefficients: Sequence[float]) -> Array:
    """c0 + c1 z + c2 z² + …"""
    value = jnp.full_like(z, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * z + c
    return value


# --- sin, cos, tan ----------------------------------------------------------------------------

LIMIT = 2.0**27
"""The largest |x| of which sin, cos and tan are formed here; the library has those beyond."""

# π/2 in five parts. With k ≤ 2²⁷ the product of k and each of the first four is exact, so that it
# does not matter whether a compiler joins product and difference into one operation.
_HALF_PI = tuple(
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


def _turned(x: Array) -> tuple[tuple[Array, Array], tuple[Array, Array], Array, Array]:
    r"""(sin, cos, k odd, ⌊k/2⌋ odd) with sin and cos of r + y = |x| − k π/2, |r| ≤ π/4.

    Each of the two is a sum of two numbers, the second below round-off of the first.

    Cody & Waite 1980, ch. 8, in five parts,

        b = (|x| − k P1) − k P2  exactly,   t + e = b − k P3,   u + f = t − k P4,   e + f − k P5,

    t and u being rounded, e and f what rounding lost (Dekker 1971). Of all doubles up to 2²⁷ none
    other than 0 is nearer than 2^−60.5 to a multiple of π/2, where the error is below 2^−129.
    """
    size = jnp.abs(x)
    size = jnp.where(size <= LIMIT, size, jnp.nan)
    k = jnp.floor(size * (2 / math.pi) + 0.5)
    b = (size - k * _HALF_PI[0]) - k * _HALF_PI[1]
    part = k * _HALF_PI[2]
    t = b - part
    e = (b - t) - part
    part = k * _HALF_PI[3]
    u = t - part
    f = (t - u) - part
    rest = (e + f) - k * _HALF_PI[4]
    r = u + rest
    y = (u - r) + rest

    z = r * r
    ds = r * z * _polynomial(z, _SIN) + y
    s = r + ds
    w = 1 - 0.5 * z
    dc = ((1 - w) - 0.5 * z) + (z * z * _polynomial(z, _COS) - r * y)
    c = w + dc

    half = jnp.floor(0.5 * k)
    k_odd = k - 2 * half > 0.5
    half_odd = half - 2 * jnp.floor(0.5 * half) > 0.5
    return (s, (r - s) + ds), (c, (w - c) + dc), k_odd, half_odd


def _sin(x):
    (s, _), (c, _), k_odd, half_odd = _turned(x)
    value = jnp.where(k_odd, c, s)
    return jnp.where(x == 0, x, jnp.where(half_odd ^ (x < 0), -value, value))


def _cos(x):
    (s, _), (c, _), k_odd, half_odd = _turned(x)
    value = jnp.where(k_odd, s, c)
    return jnp.where(half_odd ^ k_odd, -value, value)


def _tan(x):
    (s, ds), (c, dc), k_odd, _ = _turned(x)
    above, d_above = jnp.where(k_odd, c, s), jnp.where(k_odd, dc, ds)
    below, d_below = jnp.where(k_odd, s, c), jnp.where(k_odd, ds, dc)
    quotient = above / below
    value = quotient + (d_above - quotient * d_below) / below
    return jnp.where(x == 0, x, jnp.where(k_odd ^ (x < 0), -value, value))


sin = Elementary("sin", _sin, lax.sin, lambda way, y, x: (way(cos)(x),), LIMIT)
cos = Elementary("cos", _cos, lax.cos, lambda way, y, x: (-way(sin)(x),), LIMIT)
tan = Elementary("tan", _tan, lax.tan, lambda way, y, x: (1 + y * y,), LIMIT)


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
# Each with what rounding lost.
_PI_2 = float.fromhex("0x1.921fb54442d18p+0"), float.fromhex("0x1.1a62633145c07p-54")
_PI_4 = _PI_2[0] / 2, _PI_2[1] / 2
_ATAN_HALF = float.fromhex("0x1.dac670561bb4fp-2"), float.fromhex("0x1.a2b7f222f65e2p-56")


def _is_negative(x: Array) -> Array:
    """The sign bit: true for −0 too."""
    return lax.bitcast_convert_type(x, jnp.int64) < 0


def _angle(y: Array, x: Array) -> Array:
    """atan(y/x) of 0 ≤ x, y < ∞, not both 0: between 0 and π/2.

    In the first octant, n ≤ d,  atan(n/d) = atan c + atan t,  t = (n − c d)/(d + c n), with
    c = 0, 1/2 or 1, so that |t| ≤ 0.3; in the second π/2 − atan(d/n).
    """
    is_steep = y > x
    n, d = jnp.where(is_steep, x, y), jnp.where(is_steep, y, x)
    low, high = n < 0.3 * d, n > 0.8345 * d

    def of_c(at_0, at_half, at_1):
        return jnp.where(low, at_0, jnp.where(high, at_1, at_half))

    c = of_c(0.0, 0.5, 1.0)
    t = (n - c * d) / (d + c * n)
    z = t * t
    series = t * z * _polynomial(z, _ATAN)
    first = of_c(t, _ATAN_HALF[0], _PI_4[0])
    second = series + of_c(0.0, t + _ATAN_HALF[1], t + _PI_4[1])
    return jnp.where(is_steep, (_PI_2[0] - first) - (second - _PI_2[1]), first + second)


def _atan(x):
    size = jnp.abs(x)
    far = size > 2.0**60  # ∞ too, where quotients would be NaN
    value = jnp.where(far, _PI_2[0], _angle(jnp.where(far, 1.0, size), jnp.ones_like(x)))
    return jnp.where(x == 0, x, jnp.where(x < 0, -value, value))


def _atan2(y, x):
    n, d = jnp.abs(y), jnp.abs(x)
    # The limits: a quotient of infinities is 1, of a finite number and infinity 0 or ∞; 0/0 is 0/1.
    infinite = jnp.maximum(n, d) == jnp.inf
    n = jnp.where(infinite, jnp.where(n == jnp.inf, 1.0, 0.0), n)
    d = jnp.where(infinite, jnp.where(d == jnp.inf, 1.0, 0.0), d)
    d = jnp.where((n == 0) & (d == 0), 1.0, d)
    larger = jnp.maximum(n, d)
    scale = jnp.where(larger > 2.0**1000, 0.25, jnp.where(larger < 2.0**-900, 2.0**100, 1.0))
    angle = _angle(scale * n, scale * d)
    angle = jnp.where(_is_negative(x), 2 * _PI_2[0] - (angle - 2 * _PI_2[1]), angle)
    return jnp.where(_is_negative(y), -angle, angle)


def _arc(x: Array) -> tuple[Array, Array, Array]:
    """(|x| > 1/2, s, d) with s + d = asin|x|, or asin √((1 − |x|)/2) where |x| > 1/2."""
    size = jnp.abs(x)
    steep = size > 0.5
    half = 0.5 * (1 - size)
    z = jnp.where(steep, half, size * size)
    s = jnp.where(steep, jnp.sqrt(half), size)
    return steep, s, s * z * _polynomial(z, _ASIN)


def _asin(x):
    steep, s, d = _arc(x)
    value = jnp.where(steep, _PI_2[0] - (2 * s - (_PI_2[1] - 2 * d)), s + d)
    return jnp.where(x == 0, x, jnp.where(x < 0, -value, value))


def _acos(x):
    steep, s, d = _arc(x)
    below = x < 0
    far = jnp.where(below, 2 * _PI_2[0] - 2 * (s + (d - _PI_2[1])), 2 * (s + d))
    s, d = jnp.where(below, -s, s), jnp.where(below, -d, d)
    return jnp.where(steep, far, _PI_2[0] - (s - (_PI_2[1] - d)))


atan = Elementary("atan", _atan, lax.atan, lambda way, y, x: (1 / (1 + x * x),))
asin = Elementary("asin", _asin, lax.asin, lambda way, y, x: (lax.rsqrt((1 - x) * (1 + x)),))
acos = Elementary("acos", _acos, lax.acos, lambda way, y, x: (-lax.rsqrt((1 - x) * (1 + x)),))


def _slopes_of_atan2(way, angle, y, x):
    square = y * y + x * x
    return x / square, -y / square


atan2 = Elementary("atan2", _atan2, lax.atan2, _slopes_of_atan2)


# --- log, powers ------------------------------------------------------------------------------

_LOG = (
    0.6666666666666734,
    0.3999999999941768,
    0.2857142874176449,
    0.22222198632414725,
    0.181835614921945,
    0.15314116931616362,
    0.14795345075993865,
)
# log 2: 42 bits, so that multiples of it are exact, and the rest.
_LOG_2 = float.fromhex("0x1.62e42fefa3p-1"), float.fromhex("0x1.3de6af278ece6p-42")
_ONE, _ROOT_HALF, _FRACTION = 0x3FF0_0000_0000_0000, 0x3FE6_A09E_667F_3BCD, 0x000F_FFFF_FFFF_FFFF
_TWO_52 = 0x4330_0000_0000_0000
"""Bits of 1.0 and √½, of a fraction, and of 2⁵²."""


def _log(x):
    r"""log x = k log 2 + log m, √½ ≤ m < √2, and with f = m − 1, s = f/(2 + f), z = s²

    log m = f − (f²/2 − s (f²/2 + z P(z))).
    """
    bits = lax.bitcast_convert_type(x, jnp.int64) + (_ONE - _ROOT_HALF)
    exponent = lax.shift_right_logical(bits, jnp.full_like(bits, 52))
    k = lax.bitcast_convert_type(exponent | _TWO_52, x.dtype) - (2.0**52 + 1023)
    f = lax.bitcast_convert_type((bits & _FRACTION) + _ROOT_HALF, x.dtype) - 1
    s = f / (2 + f)
    z = s * s
    half = 0.5 * f * f
    value = k * _LOG_2[0] - ((half - (s * (half + z * _polynomial(z, _LOG)) + k * _LOG_2[1])) - f)
    value = jnp.where(x > 0, jnp.where(x < jnp.inf, value, x), jnp.nan)
    return jnp.where(x == 0, -jnp.inf, value)


log = Elementary("log", _log, lax.log, lambda way, y, x: (1 / x,))


@functools.cache
def _half_power(twice: int) -> Elementary:
    """x^(twice/2) of odd `twice`, as a whole power times √x."""
    y = twice / 2
    k, is_inverse = int(abs(y)), y < 0
    at_infinity, at_0 = (0.0, math.inf) if is_inverse else (math.inf, 0.0)

    def arithmetic(x):
        value = jnp.sqrt(x) if k == 0 else lax.integer_pow(x, k) * jnp.sqrt(x)
        value = 1 / value if is_inverse else value
        # As the library has them, −0 and −∞ included.
        return jnp.where(x == 0, at_0, jnp.where(jnp.abs(x) == jnp.inf, at_infinity, value))

    def library(x):
        return lax.pow(x, jnp.full_like(x, y))

    return Elementary(f"pow {y}", arithmetic, library, lambda way, _, x: (y * pow(x, y - 1),))


def pow(x: ArrayLike, y: ArrayLike) -> Array:
    """x^y: by √x where y is an odd multiple of 1/2 up to 7/2 in size and no traced array.

    By the library for other y.
    """
    if isinstance(y, int | float | np.number | np.ndarray) and np.ndim(y) == 0:
        twice = 2 * float(y)
        if twice % 2 == 1 and abs(twice) <= 7:
            return _half_power(int(twice))(x)
    return jnp.power(x, y)


VECTORISED: dict[str, Callable[..., Array]] = {
    function.name: function for function in (sin, cos, tan, atan, atan2, asin, acos, log)
} | {"pow": pow}
"""From the name of a primitive of JAX to the function to take in its place on a CPU."""
