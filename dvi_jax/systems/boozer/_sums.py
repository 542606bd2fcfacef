r"""|B| and its derivatives as a sum over Fourier modes, without a singularity on the axis.

With w = x + iy = √s e^{iθ}, s = x² + y², the sum over the modes of a field is

    B(x, y, ζ) = Re Σ_m w^m A_m(s, ζ),    A_m = Σ_k C_mk(s) e^{−inζ},    n = N (k + hm),

with N field periods, the helicity h, k = −K…K and polynomials C_mk(s) = Σ_d c_mkd s^d. In real
terms C = b − i b' stands for s^{m/2} [b cos(mθ − nζ) + b' sin(mθ − nζ)]. It is a polynomial in x
and y, and so smooth on the axis.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

Coefficients = Float[Array, "parts m k d"]
"""b, and b' in a second part if the field is not symmetric under (θ, ζ) → (−θ, −ζ)."""

# A complex number is a pair of real ones here: machine code is generated for real numbers only.
Complex = tuple[Any, Any]


class Shape(NamedTuple):
    """Integers of the sum: N field periods, and the helicity h."""

    periods: int
    helicity: int


def _times(a: Complex, b: Complex) -> Complex:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _plus(a: Complex, b: Complex) -> Complex:
    return a[0] + b[0], a[1] + b[1]


def _scale(number: Any, a: Complex) -> Complex:
    return number * a[0], number * a[1]


def _rotate(number: Any, a: Complex) -> Complex:
    """−i·number·a."""
    return number * a[1], -number * a[0]


def _phase(angle: Any) -> Complex:
    """e^{−i·angle}."""
    return jnp.cos(angle), -jnp.sin(angle)


def _polynomials(c: Float[Array, " d"], s: Any, order: int) -> list[Any]:
    """Σ_d c_d s^d and its first `order` derivatives."""
    value: list[Any] = [c[-1], *[None] * order]
    for d in range(c.shape[0] - 2, -1, -1):
        for j in range(order, 0, -1):
            if value[j - 1] is not None:
                value[j] = j * value[j - 1] + (0 if value[j] is None else value[j] * s)
        value[0] = value[0] * s + c[d]
    return [0.0 if v is None else v for v in value]


# Both loops carry powers next to the sums: arrays of powers would not fit into the registers.
def _over_k(
    c: Any, s: Any, first: Complex, factor: Complex, n_of: Callable, order: int
) -> tuple[Complex, ...]:
    """A_m and its derivatives up to `order`, in the order of `derivatives`; the phases of the terms
    are first · factor^j, their n is n_of(k)."""
    zero = jnp.zeros_like(s)

    def add(carry, row):
        (sums, phase), (c_k, k) = carry, row
        n = n_of(k)
        real = _polynomials(c_k[0], s, order)
        terms = [_scale(value, phase) for value in real]
        if c_k.shape[0] == 2:
            imaginary = _polynomials(c_k[1], s, order)
            rotations = [_rotate(term, phase) for term in imaginary]
            terms = [_plus(*pair) for pair in zip(terms, rotations, strict=True)]
        if order >= 1:
            terms += [_rotate(n, term) for term in terms[:order]]
        if order == 2:
            terms.append(_rotate(n, terms[3]))
        sums = tuple(_plus(*pair) for pair in zip(sums, terms, strict=True))
        return (sums, _times(phase, factor)), None

    start = tuple((zero, zero) for _ in range((1, 3, 6)[order]))
    # The same loop on all devices, so that a GPU computes the same bits.
    count = c.shape[0]
    k = np.arange(count, dtype=s.dtype) - count // 2
    return lax.scan(add, (start, first), (c, k))[0][0]


# Jitted, so that all calls in a step share one trace.
@functools.partial(jax.jit, static_argnames=("shape", "order"))
def derivatives(c: Coefficients, shape: Shape, x: Any, y: Any, zeta: Any, order: int) -> tuple:
    """B and its derivatives up to `order` (0, 1, 2): B; B_x, B_y, B_ζ; B_xx, B_xy, B_xζ, B_yy,
    B_yζ, B_ζζ."""
    s, w, (N, h) = x * x + y * y, (x, y), shape
    _, M, K2, _ = c.shape  # M + 1, 2K + 1
    unit, zero = jnp.ones_like(s), jnp.zeros_like(s)
    lowest, factor = _phase(-N * (K2 // 2) * zeta), _phase(N * zeta)
    helix = _phase(N * h * zeta) if h else None

    def add(carry, row):
        (sums, w0, w1, w2, turn), (c_m, m) = carry, row  # w^m, w^{m−1}, w^{m−2}
        A, *tail = _over_k(c_m, s, lowest, factor, lambda k: N * (k + h * m), order)
        following = _times(w0, w), w0, w1, _times(turn, helix) if helix else None
        if h:
            A, *tail = (_times(turn, a) for a in (A, *tail))
        terms = [_times(w0, A)[0]]
        A_s = A_ss = A_zeta = lower = A  # replaced below, where they are used
        if order >= 1:
            A_s, *tail = tail
            if order == 2:
                A_ss, *tail = tail
            A_zeta, *tail = tail
            lower = _scale(m, w1)  # m w^{m−1}
            terms += [_times(w0, A_s)[0], *_times(lower, A), _times(w0, A_zeta)[0]]
        if order == 2:
            A_szeta, A_zetazeta = tail
            down_twice = _scale(m * (m - 1), w2)
            terms += [_times(w0, A_ss)[0], *_times(lower, A_s), *_times(down_twice, A)]
            terms += [_times(w0, A_szeta)[0], *_times(lower, A_zeta), _times(w0, A_zetazeta)[0]]
        sums = tuple(a + b for a, b in zip(sums, terms, strict=True))
        return (sums, *following), None

    one, none = (unit, zero), (zero, zero)
    sums = tuple(zero for _ in range((1, 5, 14)[order]))
    start = sums, one, none, none, one if h else None
    # In the order of the loops, so that no row is copied.
    rows = jnp.transpose(c, (1, 2, 0, 3)), np.arange(M, dtype=s.dtype)
    (B, *tail), *_ = lax.scan(add, start, rows)[0]
    if order == 0:
        return (B,)
    S, Tr, Ti, Z, *tail = tail
    # ∂x Re(w^m A) = Re(m w^{m−1} A) + 2x Re(w^m A_s), ∂y the same with i w^{m−1} and 2y.
    first = (B, 2 * x * S + Tr, 2 * y * S - Ti, Z)
    if order == 1:
        return first
    SS, TSr, TSi, Ur, Ui, SZ, TZr, TZi, ZZ = tail
    xx, xy = 2 * S + 4 * x * (x * SS + TSr) + Ur, 4 * x * y * SS + 2 * (y * TSr - x * TSi) - Ui
    xz, yy = 2 * x * SZ + TZr, 2 * S + 4 * y * (y * SS - TSi) - Ur
    return (*first, xx, xy, xz, yy, 2 * y * SZ - TZi, ZZ)


# With derivatives by autodiff each order would be a new sum over all modes, and a step would have
# too many operations for machine code. One sum returns a value and the derivatives that its own
# derivative needs. Third derivatives are those of autodiff.
@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def total(c: Coefficients, shape: Shape, x: Any, y: Any, zeta: Any) -> Any:
    """B(x, y, ζ), of arrays of one shape. Differentiable to any order, also in `c`."""
    return derivatives(c, shape, x, y, zeta, order=0)[0]


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _with_gradient(c: Coefficients, shape: Shape, x: Any, y: Any, zeta: Any) -> tuple:
    return derivatives(c, shape, x, y, zeta, order=1)


def _sum_of_products(factors: tuple, changes: tuple) -> Any:
    """Σ factor·change, without the changes that are zero by construction."""
    parts = [f * d for f, d in zip(factors, changes, strict=True) if d is not None]
    return functools.reduce(jnp.add, parts) if parts else jnp.zeros_like(factors[0])


def _nonzero(changes: Any) -> list[Any]:
    return [None if isinstance(change, SymbolicZero) else change for change in changes]


def _total_jvp(shape, primals, changes):
    c, x, y, zeta = primals
    B, *slopes = _with_gradient(c, shape, x, y, zeta)
    of_c, *of_point = _nonzero(changes)
    change = _sum_of_products(tuple(slopes), tuple(of_point))
    if of_c is not None:  # B is linear in its coefficients
        change = change + total(of_c, shape, x, y, zeta)
    return B, change


def _with_gradient_jvp(shape, primals, changes):
    c, x, y, zeta = primals
    B, b_x, b_y, b_z, xx, xy, xz, yy, yz, zz = derivatives(c, shape, x, y, zeta, order=2)
    of_c, *of_point = _nonzero(changes)
    rows = ((b_x, b_y, b_z), (xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    out = tuple(_sum_of_products(row, tuple(of_point)) for row in rows)
    if of_c is not None:
        extra = _with_gradient(of_c, shape, x, y, zeta)
        out = tuple(a + b for a, b in zip(out, extra, strict=True))
    return (B, b_x, b_y, b_z), out


total.defjvp(_total_jvp, symbolic_zeros=True)
_with_gradient.defjvp(_with_gradient_jvp, symbolic_zeros=True)
