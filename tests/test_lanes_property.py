"""Component form against arrays: every primitive, its variants, and functions made by chance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from jax import lax

from dvi_jax.engine.lanes import evaluate
from dvi_jax.engine.linear import solve_near_identity

OPTIONS = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""Much is compiled here, and hardly anything is run."""

LANES = 3
"""As many as the arrays have rows, so that an axis taken for another is no error of shapes."""


def by_components(function, args, on):
    """The outputs of ``function(*args)`` by components, lanes in front where there are any.

    `on` says which arguments have lanes; None means that nothing has, nor is there an axis.
    """
    lanes = None if on is None else LANES
    flags = [False] * len(args) if on is None else on
    one = [a[0] if o else a for a, o in zip(args, flags, strict=True)]
    closed = jax.make_jaxpr(function)(*one)
    tree = jax.tree.structure(jax.eval_shape(function, *one))

    def run(*args):
        args = [jnp.moveaxis(a, 0, -1) if o else a for a, o in zip(args, flags, strict=True)]
        outs = []
        for value in evaluate(closed, args, flags, lanes):
            array, has_lanes = value.array()
            array = jnp.asarray(array)
            if lanes and not has_lanes:
                array = jnp.broadcast_to(array[..., None], (*value.shape, lanes))
            outs.append(jnp.moveaxis(array, -1, 0) if lanes else array)
        return jax.tree.unflatten(tree, outs)

    return jax.jit(run, compiler_options=OPTIONS)(*args)


def assert_same(found, expected, rtol, what=""):
    paths = jax.tree_util.tree_flatten_with_path(expected)[0]
    for (path, b), a in zip(paths, jax.tree.leaves(found), strict=True):
        where = f"{what}{jax.tree_util.keystr(path)}"
        assert (a.shape, a.dtype) == (b.shape, b.dtype), where
        if jnp.issubdtype(b.dtype, jnp.inexact):
            wide = np.complex128 if jnp.issubdtype(b.dtype, jnp.complexfloating) else np.float64
            a, b = np.asarray(a).astype(wide), np.asarray(b).astype(wide)
            np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol, err_msg=where)
        else:
            np.testing.assert_array_equal(a, b, err_msg=where)


def check(function, *args, rtol=1e-12, patterns=None):
    """By components on lanes, on one, and where only some arguments have lanes, against vmap."""
    if patterns is None:
        patterns = [[True] * len(args), None]
        if len(args) > 1:
            patterns += [[i != k for i in range(len(args))] for k in range(len(args))]
    for on in patterns:
        mine = [a if on is None or o else a[1] for a, o in zip(args, on or args, strict=True)]
        if on is None:
            mine = [a[1] for a in args]
            expected = jax.jit(function, compiler_options=OPTIONS)(*mine)
        else:
            axes = [0 if o else None for o in on]
            expected = jax.jit(jax.vmap(function, axes), compiler_options=OPTIONS)(*mine)
        assert_same(by_components(function, mine, on), expected, rtol, f"{on}: ")


def some(*shape, dtype=np.float64, seed=0, low=-3, high=4):
    """Numbers of any dtype, lanes in front."""
    rng = np.random.default_rng(seed)
    if dtype is bool:
        return jnp.asarray(rng.integers(0, 2, (LANES, *shape)).astype(bool))
    if np.issubdtype(dtype, np.integer):
        return jnp.asarray(rng.integers(low, high, (LANES, *shape)).astype(dtype))
    x = rng.normal(size=(LANES, *shape))
    if np.issubdtype(dtype, np.complexfloating):
        x = x + 1j * rng.normal(size=x.shape)
    return jnp.asarray(x.astype(dtype))


NAN, INF = np.nan, np.inf
ODD = jnp.asarray([[NAN, 1.0, -0.0], [INF, NAN, 0.0], [-INF, -0.0, 2.0]])
INDEX = np.array([2, 0, 2])
FAR = np.array([-5, 1, 7])


def f64(*shape, seed=0):
    return some(*shape, seed=seed)


ARITHMETIC = {
    "add, sub, mul, neg, sign": lambda x, y: (x + y, x - y, x * y, -x, jnp.sign(x)),
    "constants": lambda x, y: (x + 2, 3 - x, x * 2, x * 1, x + 0, 0 * y, 1 * y - 0),
    "squares": lambda x, y: (lax.square(x), x**2, x**3, x**0),
    "equality": lambda x, y: (x == y, x != y, x == x),
    "products": lambda x, y: (jnp.dot(x, y), jnp.outer(x, y), x.sum(), x.prod(), jnp.cumsum(x)),
    "einsum": lambda x, y: (jnp.einsum("i,j->ij", x, y), jnp.einsum("i,i->", x, y)),
    "select": lambda x, y: (jnp.where(x == y, x, y), lax.select_n(x[0] == y[0], x, y)),
    "an integer selects": lambda x, y: lax.select_n(jnp.array([2, 0, 1]), x, y, x + y),
    "gather": lambda x, y: (x[INDEX], x.at[FAR].get(mode="fill"), x.at[FAR].get(mode="clip")),
    "gather with a fill": lambda x, y: x.at[FAR].get(mode="fill", fill_value=7),
    "scatter": lambda x, y: (x.at[INDEX[:2]].set(y[:2]), x.at[FAR].set(y), x.at[0].set(y[1])),
    "scatter-add": lambda x, y: (
        x.at[INDEX].add(y),
        x.at[FAR].add(y),
        x.at[FAR].add(y, mode="clip"),
        x.at[1:].add(y[0]),
    ),
    "scatter-mul": lambda x, y: (x.at[INDEX].mul(y), x.at[FAR].mul(y)),
    "pad": lambda x, y: (lax.pad(x, y[0], [(1, 2, 1)]), lax.pad(x, y[1], [(-1, 3, 2)])),
    "pad and crop": lambda x, y: (lax.pad(x, y[0], [(-2, -1, 3)]), lax.pad(x, y[0], [(2, -4, 1)])),
    "known slices": lambda x, y: (
        lax.dynamic_slice(x, (1,), (2,)),
        lax.dynamic_slice(x, (9,), (2,)),
        lax.dynamic_slice(x, (-1,), (2,)),
        lax.dynamic_update_slice(x, y[:2], (9,)),
    ),
    "moves": lambda x, y: (
        jnp.concatenate([x, y]),
        x[::-1],
        jnp.stack([x, y], 1).T,
        jnp.roll(x, 1),
        jnp.tile(x, 2),
        jnp.repeat(x, 2),
        x[:, None] + y[None],
        lax.rev(x, (0,)),
        jnp.split(x, [1, 1]),
    ),
    "what comes in goes out": lambda x, y: (x, x, y, 2, jnp.arange(3), x[:0], jnp.ones(2, bool)),
    "zeros of it": lambda x, y: (
        jnp.zeros_like(x) * y,
        jnp.zeros_like(x) + y,
        jnp.ones_like(x) * y,
    ),
}
"""On numbers of every kind."""

ORDERED = {
    "comparisons": lambda x, y: (
        x < y,
        x <= y,
        x > y,
        x >= y,
        jnp.maximum(x, y),
        jnp.minimum(x, y),
    ),
    "clamp": lambda x, y: (lax.clamp(y[0], x, y[1] + 5), jnp.clip(x, y, y + 1), jnp.clip(x, -1, 1)),
    "extrema": lambda x, y: (x.max(), x.min(), lax.cummax(x), lax.cummin(x, reverse=True)),
    "where they are": lambda x, y: (jnp.argmax(x), jnp.argmin(y), lax.argmax(x, 0, np.int32)),
    "sort": lambda x, y: (
        jnp.sort(x),
        jnp.argsort(-y),
        lax.sort((x, y), num_keys=1),
        lax.top_k(x, 2),
    ),
    "search": lambda x, y: jnp.searchsorted(jnp.sort(x), y),
    "segments": lambda x, y: jax.ops.segment_sum(x, np.array([1, 0, 1]), num_segments=3),
    "remainders": lambda x, y: (x % 3, lax.rem(x, jnp.asarray(2, x.dtype)), jnp.floor_divide(x, 2)),
    "scatter-min, -max": lambda x, y: (x.at[INDEX].min(y), x.at[FAR].max(y)),
    "to other types": lambda x, y: (
        x.astype(np.float32),
        x.astype(np.int32),
        x.astype(bool),
        x.astype(np.complex64),
        x.astype(jnp.bfloat16),
        x.astype(np.int8).astype(np.int16),
        x > True,
    ),
    "a traced slice": lambda x, y: (
        lax.dynamic_slice(x, (y[0].astype(int),), (2,)),
        x[y.astype(int)],
        lax.dynamic_update_slice(x, y[:2], (y[2].astype(int),)),
        x.at[y.astype(int)].add(1),
        x.at[y.astype(int)].get(mode="fill"),
        lax.dynamic_index_in_dim(x, y[0].astype(int)),
    ),
    "an index that does not vary": lambda x, y: x[jnp.argmax(jnp.asarray([1, 3, 2]))] + y,
    "integer division of what is known": lambda x, y: (
        x * (jnp.arange(3) // 2).astype(x.dtype) + (jnp.arange(3) % 2).astype(x.dtype)
    ),
}
"""On real numbers."""

WHOLE = {
    "bits": lambda x, y: (
        x & y,
        x | y,
        x ^ y,
        ~x,
        x << 2,
        x >> 1,
        lax.shift_right_logical(x, jnp.ones_like(x)),
        lax.population_count(x),
        lax.clz(x),
    ),
    "reduced bits": lambda x, y: (
        lax.reduce_and(x, (0,)),
        lax.reduce_or(x, (0,)),
        lax.reduce_xor(x, (0,)),
    ),
    "division": lambda x, y: (lax.div(x, jnp.full_like(x, 2)), x // 2, x % 2, jnp.abs(x), x**2),
    "mean of integers": lambda x, y: (jnp.mean(x), x / 2, x / y, jnp.sum(x, dtype=np.float32)),
    "histogram": lambda x, y: jnp.histogram(x, bins=3, range=(0, 3))[0],
    "bincount": lambda x, y: jnp.bincount(jnp.abs(x), length=4),
}
"""On integers."""

TRUTH = {
    "logic": lambda x, y: (x & y, x | y, x ^ y, ~x, jnp.logical_and(x, y[0]), x != y, x == y),
    "reduced": lambda x, y: (x.any(), x.all(), x.sum(), jnp.cumsum(x), x.mean(), jnp.argmax(x)),
    "as numbers": lambda x, y: (x * 2, x + 1.5, x.astype(np.float32), -x.astype(int), x * y),
    "selection": lambda x, y: (
        jnp.where(x, 1, 0),
        jnp.where(x, y, x),
        lax.select(x, y, x),
        x[::-1],
    ),
    "scatter": lambda x, y: (x.at[INDEX[:2]].set(y[:2]), x.at[FAR].get(mode="fill"), x[INDEX]),
    "slices": lambda x, y: (
        lax.dynamic_update_slice(x, y[:1], (1,)),
        lax.pad(x, y[0], [(1, 1, 0)]),
    ),
    "products": lambda x, y: (jnp.dot(x, y), jnp.outer(x, y), jnp.nonzero(x, size=3)),
}
"""On truth values."""

FLOATS = {
    "trigonometric": lambda x, y: (
        jnp.sin(x),
        jnp.cos(x),
        jnp.tan(x),
        jnp.arcsin(x / 9),
        jnp.arccos(x / 9),
        jnp.arctan(x),
        jnp.arctan2(x, y),
    ),
    "hyperbolic": lambda x, y: (
        jnp.sinh(x),
        jnp.cosh(x),
        jnp.tanh(x),
        jnp.arcsinh(x),
        jnp.arccosh(1 + x**2),
        jnp.arctanh(x / 9),
    ),
    "exponential": lambda x, y: (
        jnp.exp(x),
        jnp.exp2(x),
        jnp.expm1(x),
        jnp.log(x**2),
        jnp.log1p(x**2),
        jax.nn.sigmoid(x),
        jnp.logaddexp(x, y),
        jax.nn.logsumexp(x),
        lax.cumlogsumexp(x),
        jax.nn.softmax(x),
    ),
    "powers": lambda x, y: (
        jnp.abs(x) ** y,
        x**-2,
        x**-1,
        jnp.sqrt(jnp.abs(x)),
        lax.rsqrt(jnp.abs(x)),
        jnp.cbrt(x),
        jnp.abs(x) ** 1.5,
        2.0**x,
        jnp.float_power(jnp.abs(x), 2),
        lax.pow(x, jnp.array([2, 3, -1])),
    ),
    "special": lambda x, y: (
        lax.erf(x),
        lax.erfc(x),
        lax.erf_inv(x / 9),
        lax.lgamma(x),
        lax.digamma(x + 5),
        jnp.i0(x),
        lax.igamma(1 + x**2, 1 + y**2),
        jnp.sinc(x),
    ),
    "rounding": lambda x, y: (
        jnp.floor(x),
        jnp.ceil(x),
        jnp.round(x),
        lax.round(2 * x),
        jnp.trunc(x),
        jnp.modf(x),
        lax.reduce_precision(x, 5, 7),
        lax.nextafter(x, y),
        jnp.frexp(x),
        jnp.ldexp(x, 3),
        jnp.copysign(x, y),
        jnp.signbit(x),
        jnp.heaviside(x, y),
    ),
    "division": lambda x, y: (x / y, 1 / x, lax.rem(x, y), jnp.mod(x, y), jnp.hypot(x, y), x / 1),
    "what is finite": lambda x, y: (jnp.isfinite(x), jnp.isnan(x / 0), jnp.nan_to_num(x / 0)),
    "tables": lambda x, y: (
        jnp.interp(x, jnp.sort(y), y),
        jnp.polyval(x, y),
        jnp.interp(x, np.arange(3.0), y),
        jnp.interp(x, np.arange(3.0), np.ones(3), left=-1, right=7),
    ),
    "linear algebra": lambda x, y: (
        jnp.linalg.solve(jnp.diag(x) + jnp.outer(y, y), y),
        jnp.linalg.norm(x),
        jnp.cross(x, y),
        jnp.linalg.det(jnp.diag(x) + jnp.outer(y, y)),
        jnp.linalg.inv(jnp.eye(3) + jnp.outer(x, x)),
        jnp.linalg.cholesky(jnp.eye(3) + jnp.outer(x, x)),
        jnp.linalg.slogdet(jnp.outer(x, y) + jnp.eye(3)),
        jnp.linalg.eigvalsh(jnp.outer(x, x) + jnp.diag(y)),
        jnp.trace(jnp.outer(x, y)),
        jax.scipy.linalg.solve_triangular(jnp.triu(jnp.outer(x, y) + 3 * jnp.eye(3)), y),
    ),
    "Fourier": lambda x, y: (jnp.fft.fft(x), jnp.fft.irfft(jnp.fft.rfft(x), 3), jnp.convolve(x, y)),
    "complex": lambda x, y: (
        lax.complex(x, y),
        (x + 1j * y) ** 2,
        jnp.abs(x + 1j * y),
        jnp.real(jnp.exp(1j * x)),
        jnp.angle(x + 1j * y),
        (1j * x).imag,
        jnp.conj(x + 1j * y),
    ),
    "statistics": lambda x, y: (jnp.mean(x), jnp.std(x), jnp.median(x), jnp.var(x), jnp.diff(x)),
    "bits": lambda x, y: lax.bitcast_convert_type(
        x, np.int32 if x.dtype == np.float32 else np.int64
    ),
    "gradient": lambda x, y: jax.grad(lambda x: jnp.sum(jnp.sin(x * y)) / (1 + x @ x))(x),
    "a Hessian": lambda x, y: jax.hessian(lambda x: jnp.sum(jnp.sin(x * y)) / (1 + x @ x))(x),
    "a barrier": lambda x, y: lax.optimization_barrier((x, y)),
    "a barrier for one": lambda x, y: lax.optimization_barrier(x) * y,
    "stop_gradient": lambda x, y: lax.stop_gradient(x) * y,
    "custom roots": lambda x, y: lax.custom_root(
        lambda z: z**3 + z - x[0],
        x[1],
        lambda f, z: z - f(z) / 10,
        lambda g, b: b / g(jnp.ones_like(b)),
    ),
    "custom solves": lambda x, y: lax.custom_linear_solve(
        lambda z: x**2 * z + z, y, lambda _, b: b / (1 + x**2), symmetric=True
    ),
}
"""On floating-point numbers."""

MATRICES = {
    "products": lambda A, B: (
        A @ B,
        jnp.tensordot(A, B, 2),
        jnp.einsum("ij,kj->ki", A, B),
        jnp.einsum("ii->i", A),
        jnp.einsum("ij,ij->i", A, B),
        jnp.einsum("ij,ji->j", A, B),
        jnp.kron(A, B),
        jnp.einsum("ij,jk,kl->il", A, B, A),
        A @ B[0],
        A[1] @ B,
    ),
    "contractions": lambda A, B: (
        lax.dot_general(A, B, (((0,), (1,)), ((), ()))),
        lax.dot_general(A, B, (((), ()), ((0,), (0,)))),
        lax.dot_general(A, B, (((1,), (1,)), ((0,), (0,)))),
        lax.dot_general(A, B, (((0,), (1,)), ((1,), (0,)))),
        lax.dot_general(A, B, (((), ()), ((1, 0), (0, 1)))),
        lax.dot_general(A, B, (((), ()), ((), ()))),
        lax.dot_general(A, B, (((0, 1), (1, 0)), ((), ()))),
    ),
    "another precision": lambda A, B: (
        lax.dot_general(
            A.astype(np.float32),
            B.astype(np.float32),
            (((1,), (0,)), ((), ())),
            preferred_element_type=np.float64,
        ),
        lax.dot(A.astype(np.int8), B.astype(np.int8), preferred_element_type=np.int32),
    ),
    "reductions": lambda A, B: (
        A.sum((0, 1)),
        A.sum(1),
        A.prod(0),
        A.max(1),
        A.min(),
        B.any(0),
        lax.reduce_sum(A, axes=()),
        jnp.sum(A, axis=-1, keepdims=True),
        jnp.argmax(A),
        jnp.argmin(A, 1),
        (A > 0).all(1),
    ),
    "running": lambda A, B: (
        jnp.cumsum(A, 0),
        jnp.cumsum(A, 1),
        lax.cumprod(A, 1, reverse=True),
        lax.cummax(A, 0),
        lax.cumsum(B, 0, reverse=True),
        lax.cummin(A, 1),
    ),
    "places": lambda A, B: (
        A[0],
        A[:, 1],
        A[INDEX],
        A[INDEX, INDEX[::-1]],
        A[1:, :2],
        A.at[1].set(B[0]),
        A[::-1, ::2],
        A.at[INDEX[:2], INDEX[1:]].add(B[0, :2]),
        A.at[:, FAR].add(B),
        A.at[FAR].get(mode="fill"),
        A.at[FAR, 0].set(B[:, 0]),
        A.at[jnp.ix_(INDEX[:2], INDEX[:2])].set(B[:2, 1:]),
        A[..., None],
        jnp.take_along_axis(A, INDEX[None], 1),
        A.ravel()[FAR],
        jnp.take(A, FAR, axis=1),
    ),
    "moves": lambda A, B: (
        A.T,
        A.reshape(-1),
        jnp.swapaxes(A, 0, 1) * 2,
        jnp.concatenate([A, B], 1),
        jnp.rot90(A),
        jnp.stack([A, B], 2),
        lax.pad(A, B[0, 0], [(1, -1, 1), (-1, 2, 0)]),
        jnp.flip(A),
        jnp.triu(A),
        jnp.diag(A),
        jnp.diag(A[0]),
        jnp.vstack([A, B]),
        jnp.broadcast_to(A, (2, 3, 3)),
        jnp.squeeze(A[:1]),
        lax.broadcast_in_dim(A, (3, 2, 3), (2, 0)),
        jnp.split(A, 3, 1),
        jnp.array_split(A, 2),
        lax.transpose(A[None], (2, 0, 1)),
        jnp.moveaxis(A, 0, 1),
        A[[1], :],
    ),
    "a traced place": lambda A, B: (
        A[jnp.argmax(B[0])],
        A[jnp.argmax(B, 0), INDEX],
        lax.dynamic_slice(A, (jnp.argmax(B), 1), (2, 2)),
        lax.dynamic_update_slice(A, B[:1], (jnp.argmin(B[1]), -1)),
        A.at[:, jnp.argmax(B[0])].add(1.0),
        A.at[jnp.argmax(B, 1)].set(B[1, 1]),
        A.at[jnp.argmax(B, 1)].max(B),
    ),
    "three axes": lambda A, B: (
        (A[:, None] * B[None]).sum((0, 2)),
        (A[:, None] * B[None]).max((2, 0)),
        jnp.cumsum(A[:, None] * B[None], 1),
        jnp.einsum("ijk,kl->lij", A[:, None] * B[None], A),
        jnp.transpose(A[:, None] * B[None], (2, 0, 1)),
    ),
    "decompositions": lambda A, B: (
        jnp.linalg.inv(A + 3 * jnp.eye(3)),
        jnp.linalg.solve(A + 3 * jnp.eye(3), B),
        jnp.linalg.eigh(A + A.T)[0],
        jnp.linalg.det(A),
        jnp.linalg.qr(A)[1],
        jnp.linalg.svd(A)[1],
        jax.scipy.linalg.expm(A),
        jnp.linalg.cholesky(A @ A.T + jnp.eye(3)),
        jnp.linalg.pinv(A),
    ),
    "windows": lambda A, B: (
        lax.reduce_window(A, 0.0, lax.add, (2, 2), (1, 1), "VALID"),
        jnp.convolve(A[0], B[0], "same"),
        lax.conv_general_dilated(A[None, None], B[None, None], (1, 1), "SAME"),
        lax.associative_scan(jnp.multiply, A),
        lax.reduce(A, 0.0, lax.add, (1,)),
    ),
}
"""On two matrices."""


KNOWN = {
    "quotients": lambda x, y: (
        x * lax.div(of(4, 5, -7), of(2, 2, 2)),
        x * lax.rem(of(4, 5, -7), of(2, 2, 2)),
        x * lax.div(of(4, 5, -7) + 0j, of(2, 2, 2) + 0j),
        x * lax.div(of(1.0, 0.0), of(0.0, 0.0))[0],
    ),
    "others": lambda x, y: (
        x * lax.shift_left(of(4, 5, -7), of(2, 2, 2)),
        x * lax.integer_pow(of(2.0, 5, -7), -2),
        x * lax.max(of(1.0, NAN, 2), of(0.0, 1, 3)),
        x * jnp.logical_not(of(True, False, True)),
        x * jnp.argmax(of(1, 5, 2)),
        x * jnp.sort(of(3, 1, 2)),
        x * (of(1, 2, 3) == of(1, 0, 3)),
    ),
    "broadcast in another order": lambda x, y: lax.broadcast_in_dim(
        jnp.outer(x, of(1.0, 2, 3)), (3, 2, 3), (2, 0)
    ),
}
"""With numbers that are known while tracing."""


def of(*numbers):
    return np.array(numbers)


STRANGE = {
    "arithmetic": lambda x, y: (
        x + y,
        x - y,
        x * y,
        x / y,
        0 * x,
        x * 0.0,
        x - x,
        -x,
        x**2,
        x**0,
        x**y,
        x @ y,
        x % y,
        jnp.hypot(x, y),
        jnp.linalg.norm(x),
        jnp.sum(x),
        jnp.prod(x),
        jnp.cumsum(x),
        jnp.nansum(x),
    ),
    "order": lambda x, y: (
        jnp.maximum(x, y),
        jnp.minimum(x, y),
        x.max(),
        x.min(),
        jnp.argmax(x),
        jnp.argmin(x),
        x == y,
        jnp.sort(x),
        lax.cummax(x),
        lax.cummin(x),
        x < y,
        jnp.clip(x, -1, 1),
        jnp.clip(y, x, 2),
        jnp.nanmax(x),
        lax.top_k(x, 2),
        x.at[np.array([0, 0])].max(y[:2]),
        jnp.searchsorted(x, y),
    ),
    "selection": lambda x, y: (
        jnp.where(x > y, x, y),
        jnp.isnan(x),
        jnp.isfinite(x),
        jnp.any(x > y),
        jnp.nan_to_num(x),
        lax.cond(x[0] > 0, lambda: x, lambda: y),
        x.astype(int),
        x.astype(bool),
        jnp.sign(x),
    ),
    "functions": lambda x, y: (
        jnp.sqrt(x),
        jnp.sin(x),
        jnp.exp(x),
        jnp.log(x),
        jnp.arctan2(x, y),
        jnp.floor(x),
        jnp.arctan2(x, -jnp.abs(y)),
        jnp.round(x),
        jnp.abs(x),
        jnp.signbit(x),
        jnp.nextafter(x, y),
        jnp.arctan2(-x, -jnp.ones(3)),
        jnp.tanh(x),
        jnp.arctan(x),
        jnp.copysign(1.0, x),
    ),
    "gradients": lambda x, y: (
        jax.grad(lambda x: jnp.sum(jnp.where(x > 0, jnp.sqrt(x), y * x)))(x),
        jax.grad(lambda x: jnp.max(x) + jnp.linalg.norm(y * x))(x),
    ),
}
"""With NaN, infinities and both zeros."""


def kinds(cases, *dtypes):
    return [(cases, dtype) for dtype in dtypes]


TABLES = {
    "arithmetic": kinds(ARITHMETIC, np.float64, np.float32, np.int32, np.complex128),
    "ordered": kinds(ORDERED, np.float64, np.float32, np.int32),
    "whole": kinds(WHOLE, np.int32, np.uint8),
    "truth": kinds(TRUTH, bool),
    "floats": kinds(FLOATS, np.float64, np.float32),
}


def tolerance(dtype):
    return 3e-5 if dtype in (np.float32, np.complex64) else 1e-12


CONTROL = {
    "scan": lambda x, y: (
        lax.scan(lambda c, z: (c * y + z, c[0]), x, y, reverse=True),
        lax.scan(lambda c, z: (c + z, (c, z)), x, (jnp.arange(6.0)), unroll=4),
        lax.scan(lambda c, _: (c * y, None), x, None, 2),
        lax.scan(lambda c, _: (c, c[1]), x, None, 0),
        lax.scan(lambda c, z: (c, z * 2), None, x),
        lax.scan(lambda c, z: (c, z[0]), 1, y[:, None]),
        lax.scan(lambda c, z: (c, c * z), x, jnp.ones((1, 3))),
    ),
    "a scan of counters": lambda x, y: lax.scan(
        lambda c, z: ((c[0] + 1, c[1] + (z > 0), {"v": c[2]["v"] + z * c[0]}), c[0]),
        (0, jnp.zeros(3, int), {"v": x}),
        jnp.stack([y, x]),
    ),
    "a carry that comes to vary": lambda x, y: lax.scan(
        lambda c, z: ((c[1], c[2], c[0] + z), c[0]), (0.0, 1.0, 2.0), x
    ),
    "a large carry": lambda x, y: lax.scan(
        lambda c, z: (c.at[0].add(z) + jnp.cumsum(c)[::-1] / 200, c.sum()), jnp.arange(200.0), x
    ),
    "large constants": lambda x, y: lax.scan(
        lambda c, z: (c + jnp.sum(jnp.arange(200.0) * z), z), 0.0, x
    ),
    "large and small": lambda x, y: (
        jnp.sum(jnp.ones((5000,)) * x[0]) + y,
        jnp.outer(jnp.arange(50.0), x).T @ jnp.ones(50),
        (jnp.arange(4200.0) * x[1])[INDEX * 2000],
        jnp.concatenate([x, jnp.ones(129)])[2:5],
    ),
    "known arrays as carry and constant": lambda x, y: known_twice(x),
    "while": lambda x, y: (
        lax.while_loop(lambda c: c[0] < 40, lambda c: (c[0] * 2 + 1, c[1] + x), (y[0] ** 2, y)),
        lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] + x), (0, y)),
        lax.while_loop(lambda c: (c[0] < 3) & (y[0] > 0), lambda c: (c[0] + 1, c[1] + 1), (0, 2)),
        lax.while_loop(lambda c: jnp.any(c < 0), lambda c: c + 1, x)[::-1],
    ),
    "counted loops": lambda x, y: (
        lax.fori_loop(0, (jnp.abs(x[0]) * 3).astype(int), lambda i, c: c + i * y, x),
        lax.fori_loop((y[1]).astype(int), 4, lambda i, c: c * 0.5 + i, x),
        lax.fori_loop(2, 0, lambda i, c: c * 0.5 + i, x),
        jax.jvp(lambda x: lax.fori_loop(0, 3, lambda i, c: jnp.sin(c) * x[i], x), (x,), (y,)),
    ),
    "whiles under vmap": lambda x, y: jax.vmap(
        lambda a: lax.while_loop(
            lambda c: c[0] < 4, lambda c: (c[0] + a**2 + 0.3, c[1] * a + y), (a, y)
        )
    )(x),
    "whiles under two": lambda x, y: jax.vmap(
        lambda a: jax.vmap(
            lambda b: lax.while_loop(
                lambda c: c[0] < 4, lambda c: (c[0] + b**2 + 0.3, c[1] + a, c[2] + x), (a * b, b, y)
            )
        )(jnp.array([0.5, 2.0, 1.0, -1.0]))
    )(x),
    "a loop without lanes under one with": lambda x, y: jax.vmap(
        lambda b: lax.while_loop(lambda c: c[0] < b, lambda c: (c[0] + 1, c[1] * 0.5 + x), (0, y))
    )(jnp.array([3, 0, 1, 7])),
    "a loop in a loop": lambda x, y: lax.while_loop(
        lambda c: c[0] < 5,
        lambda c: (
            c[0] + 1 + y[0] ** 2,
            lax.while_loop(lambda d: jnp.sum(d) < c[0], lambda d: d + 1 + y**2, c[1]),
        ),
        (x[0], x),
    ),
    "branches": lambda x, y: (
        lax.cond(x[0] > 0, lambda a: (a, 1), lambda a: (a * y, 2), x),
        lax.cond(x[0] > 0, lambda: 1.0, lambda: x[1]),
        lax.cond(True, lambda: x, lambda: y),
        lax.switch((3 * y[0]).astype(int), [lambda a: a, lambda a: -a, lambda a: a * y], x),
        lax.switch(jnp.asarray(7), [lambda a: a, lambda a: -a], x),
        lax.cond(jnp.sum(jnp.arange(3)) > 2, lambda: x, lambda: y),
    ),
    "branches of large arrays": lambda x, y: lax.cond(
        x[0] > 0, lambda: jnp.arange(300.0) * x[1], lambda: jnp.ones(300)
    ),
    "a switch of large arrays": lambda x, y: lax.switch(
        (y[0] + 1).astype(int),
        [lambda: jnp.arange(300.0) * x[1], lambda: jnp.ones(300), lambda: jnp.zeros(300)],
    ),
    "branches under vmap": lambda x, y: jax.vmap(
        lambda a: lax.cond(a > 0, lambda: a * y, lambda: y[::-1])
    )(x),
    "branches in a scan": lambda x, y: lax.scan(
        lambda c, k: (lax.switch(k, [lambda: c + x, lambda: c * 2, lambda: y]), c),
        x,
        jnp.array([1, 0, 2]),
    ),
    "a loop in a branch": lambda x, y: lax.cond(
        x[0] > 0, lambda: lax.while_loop(lambda c: c[0] < 3, lambda c: c + 1 + x**2, y), lambda: x
    ),
    "branches in a loop": lambda x, y: lax.while_loop(
        lambda c: c[0] < 6, lambda c: lax.cond(c[1] > 0, lambda: c + 1, lambda: c + 2 + x**2), y
    ),
    "map": lambda x, y: (
        lax.map(lambda z: z * y, x),
        lax.map(lambda z: z[0] + y[z[1]], (x, jnp.arange(3))),
        jax.vmap(jnp.dot, (None, 0))(x, jnp.outer(x, y)),
        lax.map(jnp.sin, x, batch_size=2),
        jax.vmap(lambda a, b: a * b, (0, None), 1)(x, y),
        jax.vmap(lambda a: a, -1)(jnp.outer(x, y)),
        jax.vmap(jax.vmap(lambda a, b: a - b, (None, 0)), (0, None))(x, y),
    ),
    "rules of one's own": lambda x, y: (
        jax.nn.relu(x),
        jax.nn.gelu(x),
        jax.grad(lambda x: jnp.sum(jax.nn.silu(x) * y))(x),
        half(x),
        jax.grad(lambda x: jnp.sum(half(x) * y))(x),
        jax.jvp(third, (x,), (y,)),
    ),
    "checkpoint and jit": lambda x, y: (
        jax.checkpoint(lambda x: jnp.sin(x) * y)(x),
        jax.jit(lambda x: (x, x[0]))(x),
        jax.grad(jax.checkpoint(lambda x: jnp.sum(jnp.sin(jnp.sin(x) * y))))(x),
    ),
    "gradients of loops": lambda x, y: (
        jax.grad(lambda x: lax.scan(lambda c, z: (jnp.sin(c) * z, c), y, x)[0].sum())(x),
        jax.grad(lambda x: jnp.sum(lax.scan(lambda c, z: (c * y, c[0] * z), x, x)[1]))(x),
        jax.hessian(lambda x: lax.fori_loop(0, 3, lambda i, c: jnp.sin(c * x[i]), y).sum())(x),
        jax.jacfwd(lambda x: lax.while_loop(lambda c: c[0] < 9, lambda c: c * 1.5 + 1 + x**2, y))(
            x
        ),
        jax.grad(lambda x: lax.cond(x[0] > 0, lambda: x @ y, lambda: jnp.sum(x**3)))(x),
    ),
    "random numbers": lambda x, y: (
        jax.random.normal(jax.random.key(3), (3,)) * x,
        jax.random.uniform(jax.random.PRNGKey(1)) + y,
    ),
    "random numbers of a lane": lambda x, y: random_walk(
        jax.random.fold_in(jax.random.key(1), (100 * x[0]).astype(np.int32)), x
    ),
    "callbacks": lambda x, y: jax.pure_callback(
        lambda x: np.asarray(x) * 2,
        jax.ShapeDtypeStruct((3,), x.dtype),
        x,
        vmap_method="sequential",
    ),
}
"""Loops, branches and calls, on two vectors."""


def known_twice(x):
    """A loop that starts from a known array and closes over it as well."""
    table = np.arange(12.0).reshape(3, 4)

    def loop(a):
        return lax.while_loop(
            lambda c: (c[0].sum() + table[1, 1] < 60) & (c[1] < 5 + a),
            lambda c: (c[0] + table * a, c[1] + 1.0, c[2] + x),
            (table, 0.0, x),
        )

    return loop(x[0]), jax.vmap(loop)(x)


def random_walk(key, x):
    keys = jax.random.split(key, 3)
    x = x + jax.vmap(jax.random.normal)(keys) + jax.random.uniform(keys[1])
    key = lax.cond(x[0] > 0, lambda: keys[2], lambda: keys[0])

    def step(state):
        key, x = state
        key, now = jax.random.split(key)
        return key, x + jax.random.uniform(now)

    key, x = lax.while_loop(lambda s: jnp.sum(s[1]) < 9, step, (key, x))
    return lax.scan(lambda c, k: (c + jax.random.normal(k), jax.random.key_data(k)), x, keys)


@jax.custom_vjp
def half(x):
    return x / 2


half.defvjp(lambda x: (x / 2, x), lambda x, c: (7 * c * x,))


@jax.custom_jvp
def third(x):
    return x / 3


third.defjvp(lambda x, t: (third(*x), 5 * t[0] * x[0]))


GROUP = 6
"""Cases that are compiled together."""


def groups() -> list:
    """(name, cases, two arguments, tolerance) for some cases of a table and one dtype at a time."""
    made = []
    for name, table in TABLES.items():
        for cases, dtype in table:
            low = 0 if np.dtype(dtype).kind == "u" else -3
            pair = [some(3, dtype=dtype, seed=i, low=low) for i in range(2)]
            made += in_groups(f"{name}-{np.dtype(dtype).name}", cases, pair, tolerance(dtype))
    vectors = [f64(3), f64(3, seed=1)]
    return [
        *made,
        *in_groups("matrices", MATRICES, [f64(3, 3), f64(3, 3, seed=1)]),
        *in_groups("control", CONTROL, vectors),
        *in_groups("known", KNOWN, vectors),
        *in_groups("strange", STRANGE, [ODD, ODD[::-1]]),
    ]


def in_groups(name, cases, pair, rtol=1e-12):
    names = list(cases)
    for i in range(0, len(names), GROUP):
        chosen = {n: cases[n] for n in names[i : i + GROUP]}
        marks = [] if (name, i // GROUP) in QUICK else SLOW
        yield pytest.param(chosen, pair, rtol, marks=marks, id=f"{name}-{i // GROUP}")


SLOW = pytest.mark.slow
QUICK = (("known", 0), ("arithmetic-float32", 2), ("control", 0))


@pytest.mark.parametrize(("cases", "pair", "rtol"), groups())
@pytest.mark.slow
def test_primitives(cases, pair, rtol):
    # Which arguments have lanes matters to the shapes of a primitive, not to its dtype.
    patterns = None if pair[0].dtype == np.float64 else [[True, True], [False, True]]
    check(
        lambda x, y: {name: f(x, y) for name, f in cases.items()},
        *pair,
        rtol=rtol,
        patterns=patterns,
    )


@pytest.mark.parametrize("on", [[True, True], [False, True], None])
@pytest.mark.parametrize("pivot", [0.0, 1e-11, -1e-7])
def test_a_checked_solve_exchanges_rows_where_it_must(pivot, on):
    """A pivot next to nothing on one of the lanes: the digits of all, and of a NaN beside it."""
    A = (jnp.eye(3)[None] + 0.3 * some(3, 3)).at[1, 0, 0].set(pivot)
    b = some(3, seed=1)
    mine = (A[1], b) if on == [False, True] else (A, b) if on else (A[1], b[1])
    expected = np.linalg.solve(np.broadcast_to(mine[0], (*mine[1].shape, 3)), mine[1][..., None])

    def solution(checked):
        function = lambda A, b: solve_near_identity(A, b, checked)  # noqa: E731
        return by_components(function, mine, on)

    np.testing.assert_allclose(solution(True), expected[..., 0], rtol=1e-13)
    assert not np.allclose(solution(False), expected[..., 0], rtol=1e-12, atol=0)
    if on == [True, True]:
        mine = (A.at[0, 1, 1].set(NAN), b)
        found = solution(True)
        assert np.isnan(found[0]).any()
        np.testing.assert_allclose(found[1:], expected[1:, :, 0], rtol=1e-13)


# --- functions made by chance ------------------------------------------------------------------

UNARY = (
    jnp.sin,
    jnp.tanh,
    lambda x: x[::-1] * 0.5,
    lambda x: jnp.cumsum(x) / 3,
    lambda x: jnp.where(x > 0, x, -x / 2),
    lambda x: x.at[INDEX[1:]].add(x[:2]),
    lambda x: jnp.sort(x) - x,
    lambda x: jnp.pad(x, 1)[:3] + x[jnp.argmax(x)],
    lambda x: jnp.outer(x, x) @ x,
    lambda x: jnp.linalg.norm(x) * x,
    lambda x: jnp.floor(2 * x) / 2 + x.astype(np.float32),
    lambda x: lax.dynamic_slice(jnp.tile(x, 2), ((3 * jnp.abs(x[0])).astype(int),), (3,)),
)
BINARY = (
    jnp.add,
    jnp.multiply,
    jnp.maximum,
    lambda x, y: x / (1 + y**2),
    lambda x, y: jnp.where(x > y, x, y[::-1]),
    lambda x, y: jnp.einsum("i,j->ij", x, y).sum(0) / 3,
    lambda x, y: jnp.concatenate([x[1:], y[:1]]),
    lambda x, y: jnp.linalg.solve(4 * jnp.eye(3) + jnp.outer(x, x), y),
    lambda x, y: lax.select_n((jnp.abs(x * 3).astype(int) % 3), x, y, x + y),
    lambda x, y: jnp.interp(x, jnp.array([-1.0, 0, 1]), y),
)
STEPS = st.tuples(
    st.sampled_from(
        [
            "unary",
            "binary",
            "scan",
            "while",
            "cond",
            "switch",
            "map",
            "vmap while",
            "vmap cond",
            "grad",
        ]
    ),
    st.integers(0, 30),
    st.integers(0, 30),
    st.integers(0, 30),
)
PROGRAMS = st.lists(STEPS, min_size=1, max_size=4)


def random_function(program):
    """A function of two vectors: each step takes two of the values so far and makes a third.

    The bodies of its loops and branches are steps themselves. All values stay below one.
    """

    def function(x, y):
        values = [jnp.tanh(x), jnp.tanh(y)]
        for kind, i, j, k in program:
            a, b = values[i % len(values)], values[j % len(values)]
            values.append(jnp.tanh(step(kind, k, a, b)))
        return values[-1] * jnp.sum(values[len(values) // 2])

    return function


def step(kind, k, a, b):
    f, g = UNARY[k % len(UNARY)], BINARY[k % len(BINARY)]
    if kind == "unary":
        return f(a)
    if kind == "binary":
        return g(a, b)
    if kind == "scan":
        c, zs = lax.scan(lambda c, z: (jnp.tanh(g(c, a) + z), c[k % 3]), b, a, reverse=k % 2 == 0)
        return c + zs
    if kind == "while":
        return rises(lambda c: f(c) + b, a, 1 + jnp.abs(b[k % 3]))
    if kind == "cond":
        return lax.cond(a[k % 3] > b[0], lambda: f(a), lambda: g(a, b))
    if kind == "switch":
        which = (4 * jnp.abs(a[k % 3])).astype(int) - 1
        return lax.switch(which, [lambda: f(a), lambda: g(b, a), lambda: b])
    if kind == "map":
        return lax.map(lambda z: jnp.sum(g(a * z, b)), b)
    if kind == "vmap while":
        return jax.vmap(lambda z: jnp.sum(rises(lambda c: g(c, z * b), a, 1 + jnp.abs(z))))(b)
    if kind == "vmap cond":
        return jax.vmap(lambda z: lax.cond(z > a[0], lambda: jnp.sum(f(a * z)), lambda: z))(b)
    return jax.grad(lambda a: jnp.sum(jnp.tanh(g(a, b)) * b))(a)


def rises(change, x, most):
    """A loop whose length depends on the numbers, to be differentiated forwards."""

    def body(state):
        level, x = state
        return level + 0.2 + x[0] ** 2, jnp.tanh(change(x))

    return lax.while_loop(lambda state: state[0] < most, body, (x[1] ** 2, x))[1]


def with_derivatives(f):
    def function(x, y):
        slope, bend = jax.jvp(lambda x: jax.jvp(f, (x, y), (y, x)), (x,), (jnp.ones(3),))
        return slope, bend, jax.jacfwd(f)(x, y)

    return function


@pytest.mark.slow
@settings(max_examples=15, deadline=None, derandomize=True)
@given(program=PROGRAMS, seed=st.integers(0, 3))
def test_random_functions(program, seed):
    check(random_function(program), f64(3, seed=seed), f64(3, seed=seed + 9), rtol=1e-9)


@pytest.mark.slow
@settings(max_examples=5, deadline=None, derandomize=True)
@given(program=PROGRAMS, seed=st.integers(0, 3))
def test_derivatives_of_random_functions(program, seed):
    f = with_derivatives(random_function(program))
    check(f, f64(3, seed=seed), f64(3, seed=seed + 9), rtol=1e-7, patterns=[[True, True], None])


def test_a_loop_that_does_not_read_all_that_it_is_given():
    """The compiler would end the process over an input of its one function that is not read."""

    def function(x, y):
        is_positive = jnp.sin(x) > 0
        state = (jnp.zeros(3, int), jnp.sin(y))

        def body(state):
            return jnp.where(is_positive, state[0] + 1, 9), state[1]

        return lax.while_loop(lambda state: jnp.any(state[0] < 3), body, state)[0], x * 0

    check(function, f64(3), f64(3, seed=1), patterns=[[True, True]])
