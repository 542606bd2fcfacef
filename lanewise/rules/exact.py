"""Products without rounding: a·b as the sum of two floating-point numbers."""

from typing import Any

import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from ..evaluator import Evaluator
from ..jaxprs.jaxapi import broadcast_in_front, primitive
from ..llvm.arithmetic import is_power_of_two
from ..llvm.ir import Num


def exact_product(a: ArrayLike, b: ArrayLike) -> tuple[Array, Array]:
    r"""(p, e) with a·b = p + e for float64 arrays: p is a·b rounded, |e| ≤ 2⁻⁵³ |p|.

    In machine code e is the result of one fused multiply-add, and p + e is a·b exactly. Elsewhere
    the factors are split into halves of 26 bits, whose products are exact, and the relative error
    of p + e is at most 2⁻¹⁰⁶. No operation that uses p or e is contracted with the product. Not
    below 1e-290, where e is subnormal. It has no derivative.

    **Source** Dekker 1971, *Numerische Mathematik* 18, 224; the halves by bits are our own.
    """
    a, b = jnp.broadcast_arrays(a, b)
    return _product.bind(a, b), _error.bind(a, b)


def _halves(x: Array) -> tuple[Array, Array]:
    bits = lax.bitcast_convert_type(x, jnp.uint64)
    # By bits: a compiler could contract the product of Veltkamp's splitting, and lose the lower
    # half.
    upper = (bits + jnp.uint64(1 << 26)) & jnp.uint64((1 << 64) - (1 << 27))
    high = lax.bitcast_convert_type(upper, x.dtype)
    return high, x - high


def _by_halves(a: Array, b: Array) -> tuple[Array, Array]:
    (a1, a0), (b1, b0) = _halves(a), _halves(b)
    # All four products are exact, so that contraction with a sum changes nothing.
    middle, low = two_sum(a1 * b0, a0 * b1)
    middle, lower = two_sum(middle, a0 * b0)
    high = a1 * b1
    p = high + middle
    return p, (middle - (p - high)) + (low + lower)


def two_sum(a: ArrayLike, b: ArrayLike) -> tuple[Array, Array]:
    """(s, e) with s = fl(a + b) and s + e = a + b exactly. Neither may be a rounded product."""
    # Knuth's six operations, not Dekker's three, which require |a| ≥ |b|. No compiler here
    # reassociates floating-point sums.
    a, b = jnp.asarray(a), jnp.asarray(b)
    s = a + b
    b_seen = s - a
    return s, (a - (s - b_seen)) + (b - b_seen)


def _in_batches(operation):
    def batch_rule(arrays: Any, axes: Any):
        return operation().bind(*broadcast_in_front(arrays, axes)[1]), 0

    return batch_rule


_product = primitive(
    "rounded_product", lambda a, b: _by_halves(a, b)[0], _in_batches(lambda: _product)
)
_error = primitive("lost_by_product", lambda a, b: _by_halves(a, b)[1], _in_batches(lambda: _error))


def product_rule(evaluator: Evaluator, _: Any, a: Num, b: Num) -> Num:
    """The rule of the rounded product in machine code."""
    # Opaque: it is not contracted with a sum after it.
    return evaluator.b.opaque(evaluator.b.mul(a, b))


def error_rule(evaluator: Evaluator, _: Any, a: Num, b: Num) -> Num:
    """The rule of the error of the rounded product in machine code."""
    if any(x.value is not None and (x.value == 0 or is_power_of_two(x.value)) for x in (a, b)):
        return evaluator.b.const(0, a.dtype)
    return evaluator.b.fma(a, b, evaluator.b.neg(evaluator.b.mul(a, b)))
