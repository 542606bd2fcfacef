"""Operations of the random array programs: functions of arrays, by family.

An operation gets two arrays u, v of one shape and three whole numbers k, m, n ≥ 0, which choose
axes, distances and variants; and `i`, a whole number that may be traced. It returns one array. All
keep numbers of order 1 at order 1, so that errors do not grow, and compare with numbers such as
0.3137 that no value has up to round-off.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

LARGEST = 6000
"""Elements of an array at most: a result that has more is not made."""


def constant(shape: tuple[int, ...], dtype, seed: int) -> jax.Array:
    """A known array; small ones and some with more than 256 elements occur."""
    return jnp.asarray(np.random.default_rng(seed % 97).uniform(-1, 1, shape), dtype)


def fit(x: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """x as an array of another shape, by broadcasting, reshaping, slices and pads."""
    size = int(np.prod(shape))
    if x.shape == shape:
        return x
    if x.size == size:
        return x.reshape(shape)
    if x.ndim <= len(shape) and x.shape == shape[: x.ndim]:
        return jnp.broadcast_to(x.reshape(x.shape + (1,) * (len(shape) - x.ndim)), shape)
    if x.ndim <= len(shape) and x.shape == shape[len(shape) - x.ndim :]:
        return jnp.broadcast_to(x.reshape((1,) * (len(shape) - x.ndim) + x.shape), shape)
    if x.ndim != len(shape):
        return fit(fit(x.reshape(-1), (size,)), shape)
    for axis, n in enumerate(shape):
        length = x.shape[axis]
        if length > n:
            x = lax.slice_in_dim(x, length - n, length, axis=axis)
        elif length < n:
            widths = [(0, n - length if a == axis else 0, 0) for a in range(x.ndim)]
            x = lax.pad(x, jnp.zeros((), x.dtype), widths)
    return x


def _axis(u, k):
    return k % u.ndim


def _window(u, v, k, m, n, i):
    axis = _axis(u, n)
    w = u.shape[axis]
    return lax.slice_in_dim(jnp.concatenate([v, u], axis), m % w, m % w + w, axis=axis)


def _part(u, v, k, m, n, i):
    axis = _axis(u, n)
    w = u.shape[axis]
    cut = max(w // 3, 1)
    return lax.slice_in_dim(u, k % cut, max(w - m % cut, k % cut + 1), axis=axis)


def _pad(u, v, k, m, n, i):
    widths = []
    for axis, w in enumerate(u.shape):
        low, high = (k + axis) % 5 - 2, (m + axis) % 5 - 2
        inner = int((n + axis) % 3 == 0)
        if low + high + w + inner * (w - 1) < 1:
            low = high = 0
        widths.append((low, high, inner))
    return lax.pad(u, jnp.asarray(0.3 * (k % 2), u.dtype), widths)


def _differences(u, v, k, m, n, i):
    axis = _axis(u, n)
    end = jnp.zeros_like(lax.slice_in_dim(u, 0, 1, axis=axis))
    x = jnp.concatenate([end, u] if k % 2 else [u, end], axis)
    return jnp.diff(x, axis=axis)


def _joined(u, v, k, m, n, i):
    axis = _axis(u, n)
    half = max(u.shape[axis] // 2, 1)
    parts = lax.slice_in_dim(u, 0, half, axis=axis), lax.slice_in_dim(v, half - 1, None, axis=axis)
    return jnp.concatenate(parts[:: 1 - 2 * (k % 2)], axis)


def _stack(u, v, k, m, n, i):
    x = jnp.stack([u, v, 0.5 * u][: 2 + k % 2], m % (u.ndim + 1))
    return x if n % 2 else jnp.take(x, k % 2, m % (u.ndim + 1))


def _reshape(u, v, k, m, n, i):
    divisors = [d for d in range(2, 9) if u.size % d == 0]
    if not divisors or m % 2:
        return u.reshape(-1)
    d = divisors[k % len(divisors)]
    return u.reshape((d, u.size // d) if n % 2 else (u.size // d, d))


def _spread(u, v, k, m, n, i):
    if u.ndim > 2:
        return u
    axis = k % (u.ndim + 1)
    x = jnp.expand_dims(u, axis)
    return jnp.broadcast_to(x, (*x.shape[:axis], 2 + m % 2, *x.shape[axis + 1 :]))


MOVES = {
    "roll": lambda u, v, k, m, n, i: jnp.roll(u, m % 7 - 3, _axis(u, n)),
    "roll all": lambda u, v, k, m, n, i: jnp.roll(u, (k % 5 - 2, 1), (0, -1)),
    "roll flat": lambda u, v, k, m, n, i: jnp.roll(u, k % 9 - 4),
    "flip": lambda u, v, k, m, n, i: jnp.flip(u, _axis(u, n)),
    "window": _window,
    "part": _part,
    "stride": lambda u, v, k, m, n, i: lax.slice_in_dim(
        u, k % 2 if u.shape[_axis(u, n)] > 1 else 0, None, 2 + m % 2, _axis(u, n)
    ),
    "pad": _pad,
    "differences": _differences,
    "join": _joined,
    "transpose": lambda u, v, k, m, n, i: jnp.moveaxis(u, 0, -1),
    "stack": _stack,
    "reshape": _reshape,
    "spread": _spread,
    "expand": lambda u, v, k, m, n, i: jnp.squeeze(
        0.5 * jnp.expand_dims(u, k % (u.ndim + 1)), k % (u.ndim + 1)
    ),
    "concatenate": lambda u, v, k, m, n, i: jnp.concatenate([u, v], _axis(u, n)),
}

NUMBERS = {
    "mul": lambda u, v, k, m, n, i: u * v,
    "sub": lambda u, v, k, m, n, i: u - v,
    "mix": lambda u, v, k, m, n, i: 0.37 * u + 0.61 * v,
    "sin": lambda u, v, k, m, n, i: jnp.sin(u) + v,
    "cos": lambda u, v, k, m, n, i: jnp.cos(u) * jnp.cos(v),
    "div": lambda u, v, k, m, n, i: u / (1 + v * v),
    "tanh": lambda u, v, k, m, n, i: jnp.sqrt(1 + u * u) * jnp.tanh(v),
    "exp": lambda u, v, k, m, n, i: jnp.exp(-u * u) - v,
    "log1p": lambda u, v, k, m, n, i: jnp.log1p(u * u) * v,
    "cube": lambda u, v, k, m, n, i: (u / (1 + jnp.abs(u))) ** (2 + k % 3),
    "atan2": lambda u, v, k, m, n, i: jnp.arctan2(u, 1 + v * v),
    "neg": lambda u, v, k, m, n, i: -u,
    "known": lambda u, v, k, m, n, i: u * constant(u.shape, u.dtype, k),
    "known row": lambda u, v, k, m, n, i: u + fit(constant(u.shape[-1:], u.dtype, k), u.shape),
}

CHOICES = {
    "where": lambda u, v, k, m, n, i: jnp.where(u > v + 0.0137, u, 0.5 * v),
    "max": lambda u, v, k, m, n, i: jnp.maximum(u, v),
    "min": lambda u, v, k, m, n, i: jnp.minimum(u, 0.2137 + v),
    "abs": lambda u, v, k, m, n, i: jnp.abs(u + 0.1137),
    "clip": lambda u, v, k, m, n, i: jnp.clip(u, -0.7137, 0.9137),
    "some": lambda u, v, k, m, n, i: jnp.where(
        lax.broadcasted_iota(jnp.int32, u.shape, _axis(u, n)) < m % u.shape[_axis(u, n)], u, v
    ),
    "mask": lambda u, v, k, m, n, i: jnp.where(
        np.random.default_rng(k % 97).random(u.shape) < 0.5, u, 0.25
    ),
    "triangle": lambda u, v, k, m, n, i: (
        (jnp.triu if k % 2 else jnp.tril)(u, m % 3 - 1)
        if u.ndim == 2
        else jnp.where(v > 0.3137, u, 0.0)
    ),
    "and": lambda u, v, k, m, n, i: jnp.where((u > 0.1137) & ~(v < -0.4137), u * v, v),
}


def _axes(u, k):
    axes = [a for a in range(u.ndim) if (k >> a) & 1]
    return tuple(axes or range(u.ndim))


def _count(u, axes):
    return int(np.prod([u.shape[a] for a in axes]))


def _reduction(function: Callable) -> Callable:
    """A reduction over some axes; half of the time added to the array again."""

    def values(u, v, k, m, n, i):
        axes = _axes(u, k)
        x = function(u, axes, _count(u, axes))
        return x if m % 2 else 0.5 * v + jnp.broadcast_to(x, u.shape)

    def alone(u, v, k, m, n, i):
        if m % 2:
            axes = _axes(u, k)
            x = function(u, axes, _count(u, axes))
            return jnp.squeeze(x, axes) if n % 2 else x
        return values(u, v, k, m, n, i)

    return alone


def _as_floats(x, u):
    return x.astype(u.dtype) * jnp.asarray(0.5, u.dtype)


REDUCTIONS = {
    "sum": _reduction(lambda u, a, c: jnp.sum(u, a, keepdims=True) / c),
    "sum of products": _reduction(lambda u, a, c: jnp.sum(u * jnp.sin(u), a, keepdims=True) / c),
    "prod": _reduction(lambda u, a, c: jnp.prod(1 + jnp.sin(u) / (4 * c), a, keepdims=True)),
    "largest": _reduction(lambda u, a, c: jnp.max(u, a, keepdims=True)),
    "least": _reduction(lambda u, a, c: jnp.min(u, a, keepdims=True)),
    "any": _reduction(lambda u, a, c: _as_floats(jnp.any(u > 0.8137, a, keepdims=True), u)),
    "all": _reduction(lambda u, a, c: _as_floats(jnp.all(u > -0.9137, a, keepdims=True), u)),
    "finite": _reduction(lambda u, a, c: _as_floats(jnp.isfinite(u).all(a, keepdims=True), u)),
    "norm": _reduction(lambda u, a, c: jnp.sqrt(1 + jnp.sum(u * u, a, keepdims=True) / c)),
    "softmax": lambda u, v, k, m, n, i: jnp.exp(u - jnp.max(u)) - v,
}


def _square(u, seed):
    w = u.shape[0]
    return constant((w, w), u.dtype, seed) / w


def _matrices(u, v, k, m, n, i):
    x, y = u.reshape(u.shape[0], -1), v.reshape(v.shape[0], -1)
    return x.T @ y / u.shape[0] if k % 2 or x.shape[0] > 70 else x @ y.T / x.shape[1]


def _outer(u, v, k, m, n, i):
    x, y = u.reshape(-1)[:60], v.reshape(-1)[-(3 + k % 20) :]
    return jnp.outer(x, y) if m % 2 else jnp.outer(x, y) @ y / y.size


PRODUCTS = {
    "dot": lambda u, v, k, m, n, i: jnp.vdot(u, v) / u.size - 0.5 * v,
    "known matrix": lambda u, v, k, m, n, i: jnp.tensordot(_square(u, k), u, (m % 2, 0)),
    "matrices": _matrices,
    "rows": lambda u, v, k, m, n, i: (
        jnp.sum(u * v, -1) / u.shape[-1]
        if k % 2
        else jnp.einsum("...i,...i->...", u, v) / u.shape[-1]
    ),
    "outer": _outer,
}


def _pairs(function: Callable) -> Callable:
    """A sum over pairs of rows (of numbers, or of vectors): of more rows where u has many."""

    def values(u, v, k, m, n, i):
        rows = (17, 33, 66)[k % 3] if u.size > 2000 else 9
        x = u.reshape(u.shape[0], -1)[:rows, : 1 + k % 3]
        d = x[:, None] - x[None]
        return function(d, jnp.sum(d * d, -1), m, n) / len(x)

    return values


def _repulsion(d, r2, m, n):
    terms = 1 / jnp.sqrt(r2 + 0.3)
    return jnp.sum(jnp.triu(terms, 1), m % 2)


def _forces(d, r2, m, n):
    same = jnp.eye(len(r2), dtype=bool)
    weights = jnp.where(same, 0.0, 1 / (1 + jnp.where(same, 1.0, r2)))
    return jnp.sum(d * weights[..., None], m % 2)


PAIRS = {
    "repulsion": _pairs(_repulsion),
    "forces": _pairs(_forces),
    "long range": _pairs(lambda d, r2, m, n: jnp.sum(jnp.cos(d[..., 0]), m % 2)),
    "softened": _pairs(lambda d, r2, m, n: jnp.sum(d / (r2 + 0.2)[..., None] ** 1.5, m % 2)),
    "both sides": _pairs(
        lambda d, r2, m, n: jnp.sum(jnp.sin(d), 0) + jnp.sum(jnp.tanh(d), 1) * (n % 2)
    ),
}

CUMULATIVE = {
    "cumsum": lambda u, v, k, m, n, i: (
        lax.cumsum(u, _axis(u, n), reverse=bool(k % 2)) / u.shape[_axis(u, n)]
    ),
    "cummax": lambda u, v, k, m, n, i: lax.cummax(u, _axis(u, n), reverse=bool(k % 2)),
    "cummin": lambda u, v, k, m, n, i: lax.cummin(u, _axis(u, n)),
    "cumprod": lambda u, v, k, m, n, i: lax.cumprod(
        1 + jnp.sin(u) / (4 * u.shape[_axis(u, n)]), _axis(u, n)
    ),
}


def _known_places(u, k, count):
    return np.random.default_rng(k % 97).integers(0, u.shape[0], count)


def _flat(u):
    return u.reshape(u.shape[0], -1)[:, 0] if u.ndim > 1 else u


def _pair_list(u, v, k, m, n, i):
    x = _flat(u)[:12]
    first, second = np.triu_indices(len(x), 1)
    force = jnp.sin(x[first] - x[second]) / len(x)
    return jnp.zeros_like(x).at[first].add(force).at[second].add(-force)


def _interior(u, v, k, m, n, i):
    if u.shape[0] < 3:
        return u
    return (u.at[1:-1].add(0.3 * v[2:] - 0.1 * v[:-2])) if k % 2 else u.at[1:-1].set(v[1:-1])


INDICES = {
    "take known": lambda u, v, k, m, n, i: u[_known_places(u, k, 3 + m % 70)],
    "take": lambda u, v, k, m, n, i: u[(i + np.arange(4 + m % 9)) % u.shape[0]],
    "take one": lambda u, v, k, m, n, i: u[i % u.shape[0]] + 0.5 * v[0],
    "take outside": lambda u, v, k, m, n, i: u.at[i + 1].get(mode="clip") + v[-1],
    "add at known": lambda u, v, k, m, n, i: u.at[_known_places(u, k, 5)].add(0.1 * v[k % 3]),
    "add at": lambda u, v, k, m, n, i: u.at[(i + np.arange(3)) % u.shape[0]].add(0.1 * v[0]),
    "set at": lambda u, v, k, m, n, i: u.at[i % u.shape[0]].set(v[m % v.shape[0]]),
    "set end": lambda u, v, k, m, n, i: u.at[-(k % 2)].set(0.25),
    "interior": _interior,
    "pair list": _pair_list,
    "slice at": lambda u, v, k, m, n, i: lax.dynamic_slice_in_dim(
        u, i, max(u.shape[_axis(u, n)] - 2, 1), _axis(u, n)
    ),
    "update at": lambda u, v, k, m, n, i: lax.dynamic_update_slice_in_dim(
        u, lax.slice_in_dim(v, 0, (v.shape[_axis(u, n)] + 1) // 2, axis=_axis(u, n)), i, _axis(u, n)
    ),
    "update row": lambda u, v, k, m, n, i: lax.dynamic_update_index_in_dim(
        u, 0.5 * v[0], i % u.shape[0], 0
    ),
}


def _whole(u):
    """Small whole numbers made of an array."""
    return (u > 0.1137).astype(jnp.int32) + 3 * (u > -0.4137) + jnp.asarray(u < 0.6137, jnp.int32)


def _integers(u, v, k, m, n, i):
    a, b = _whole(u), _whole(v) + 1
    c = [a * b - i, a // b + (a % b), (a << 2) >> 1, a ^ (b | 4), jnp.maximum(a, b) & 6, -a * 7][
        k % 6
    ]
    if m % 3 == 0:
        c = jnp.roll(c, 1) + jnp.sum(c, dtype=jnp.int32) % 5
    return (c % 11).astype(u.dtype) * jnp.asarray(0.1, u.dtype)


def _truth(u, v, k, m, n, i):
    a, b = u > 0.1137, v > 0.2137
    c = [a & b, a | b, a ^ b, ~a, jnp.roll(a, 1) & b, jnp.flip(a, 0) | (b == a)][k % 6]
    return jnp.where(c if m % 2 else c & (i % 2 == 0), u, 0.5 * v)


def _rounded(u, v, k, m, n, i):
    other = jnp.float32 if u.dtype == jnp.float64 else jnp.float64
    return (jnp.sin(u.astype(other)) + v.astype(other)).astype(u.dtype)


TYPES = {
    "integers": _integers,
    "truth": _truth,
    "rounded": _rounded,
    "integer cumsum": lambda u, v, k, m, n, i: (
        lax.cumsum(_whole(u), _axis(u, n)) % 7
    ).astype(u.dtype),
    "place": lambda u, v, k, m, n, i: (
        jnp.argmax(_whole(u).reshape(-1) * 31 % 17).astype(u.dtype) / u.size
        + 0.5 * v
    ),
}  # fmt: skip

CALLS = {
    "jit": lambda u, v, k, m, n, i: jax.jit(lambda x, y: jnp.roll(x, 1) * y)(u, v),
    "checkpoint": lambda u, v, k, m, n, i: jax.checkpoint(lambda x: jnp.sin(x) * x)(u) - v,
    "softplus": lambda u, v, k, m, n, i: jax.nn.softplus(u) - 0.5 * v,
    "relu": lambda u, v, k, m, n, i: jax.nn.relu(u + 0.0137) - 0.5 * v,
}

FAMILIES: dict[str, dict[str, Callable]] = {
    "moves": MOVES,
    "numbers": NUMBERS,
    "choices": CHOICES,
    "reductions": REDUCTIONS,
    "products": PRODUCTS,
    "pairs": PAIRS,
    "cumulative": CUMULATIVE,
    "indices": INDICES,
    "types": TYPES,
    "calls": CALLS,
}
