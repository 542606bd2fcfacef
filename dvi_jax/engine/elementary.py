r"""Elementary functions from multiplications and additions, for loops over many lanes.

XLA calls the library lane by lane for sin, cos and others in float64 on a CPU, inside a loop that
is vectorised otherwise. These need adds, multiplications, floor, comparisons and selections only,
so the loop stays one loop over vectors; sin, cos and tan also go into a Pallas kernel.

Coefficients are those of the polynomial through the function at Chebyshev nodes, pulled so that
one lies at 0 where the error is multiplied by 0; `tests/test_elementary.py` derives them anew.
"""

import math
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any

import jax
import jax.numpy as jnp
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

    - `pure`: the arithmetic alone, without the test for a hand-over, which would split a loop in
      two: NaN beyond `limit`. For kernels that see to large arguments themselves.
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
