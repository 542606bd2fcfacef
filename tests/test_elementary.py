"""Elementary functions: errors in ulp over the whole range, hand-over, special values, slopes."""

import functools
import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference
from jax.test_util import check_grads

from dvi_jax.engine import elementary

SINES = ("sin", "cos", "tan")
LIMIT = elementary.LIMIT
# Found by continued fractions of 2^e 2/π: nearest to a multiple of π/2 of all doubles up to 2²⁷,
# of those from 2²³ on, and (J.-M. Muller, Elementary Functions, 2006, ch. 9) of all.
NEAREST = (6411027962775774 * 2.0**-47, 7763785107565477 * 2.0**-29, 6381956970095103 * 2.0**797)


# --- what is exact ----------------------------------------------------------------------------


def _series(r: Fraction, first: int, bits: int) -> Fraction:
    """Σ (−1)^m r^(first + 2m)/(first + 2m)!, with `bits` binary digits behind the point."""
    x = round(r * 2**bits)
    square = x * x >> bits
    term = x if first else 1 << bits
    total, n = 0, first
    while term:
        total += term
        term = -(term * square >> bits) // ((n + 1) * (n + 2))
        n += 2
    return Fraction(total, 2**bits)


@functools.cache
def half_pi(bits=1400) -> Fraction:
    """π/2 = 8 atan(1/5) − 2 atan(1/239) (Machin)."""

    def atan_of_inverse(n):
        total = power = (1 << bits + 20) // n
        for m in range(1, bits):
            power //= n * n
            total += (-1) ** m * (power // (2 * m + 1))
        return total

    return Fraction(8 * atan_of_inverse(5) - 2 * atan_of_inverse(239), 1 << bits + 20)


def exact(name: str, x: float) -> Fraction:
    """sin, cos or tan to 100 binary digits at least."""
    if name == "tan":
        return exact("sin", x) / exact("cos", x)
    x = Fraction(float(x))
    k = round(x / half_pi())
    r = x - k * half_pi()
    odd = (k + (name == "cos")) % 4
    bits = 120 + max(0, -math.frexp(float(r))[1])
    value = _series(r, 1 - odd % 2, bits)
    return -value if odd >= 2 else value


def errors(name: str, xs, values) -> np.ndarray:
    """|value − exact|/ulp at each point."""
    out = []
    for x, value in zip(np.ravel(xs), np.ravel(values), strict=True):
        truth = exact(name, x)
        out.append(abs(Fraction(float(value)) - truth) / Fraction(math.ulp(float(truth))))
    return np.asarray(out, float)


def points(limit=LIMIT, seed=0):
    """Near 0, spread, of every size, near multiples of π/2; of both signs."""
    rng = np.random.default_rng(seed)
    near = np.concatenate([np.arange(1, 200), rng.integers(1, int(limit / 1.6), 200)]) * np.pi / 2
    xs = np.concatenate(
        [
            rng.uniform(0, 8, 700),
            rng.uniform(0.7, 0.9, 300),
            10 ** rng.uniform(-300, math.log10(limit), 500),
            rng.uniform(0, limit, 300),
            near,
            np.nextafter(near, 0),
            np.linspace(0, 2e-3, 50)[1:],
            NEAREST[:2],
            [limit],
        ]
    )
    return xs * rng.choice([-1.0, 1.0], xs.shape)


BOUNDS = {"sin": 0.8, "cos": 0.8, "tan": 1.5}
"""Largest error [ulp]. Measured: 0.76, 0.77, 1.36."""


@pytest.mark.parametrize("name", SINES)
def test_error_up_to_the_limit(name):
    xs = points()
    assert errors(name, xs, getattr(elementary, name).pure(xs)).max() < BOUNDS[name]


@pytest.mark.parametrize("name", SINES)
def test_error_beyond_the_limit_is_that_of_the_library(name):
    function = getattr(elementary, name)
    rng = np.random.default_rng(1)
    xs = 10 ** rng.uniform(math.log10(LIMIT), 308, 300)
    xs = np.append(xs, [np.nextafter(LIMIT, np.inf), np.finfo(float).max])
    assert np.all(np.isnan(function.pure(xs)))
    np.testing.assert_array_equal(function(xs), getattr(jnp, name)(xs))
    assert errors(name, xs, function(xs)).max() < 1.0
    # Where the library of the system itself may be off by some ulp (glibc 2.36: 14).
    nearest = NEAREST[2]
    np.testing.assert_array_equal(function(nearest), getattr(jnp, name)(nearest))
    assert float(function(nearest)) == pytest.approx(float(exact(name, nearest)), rel=1e-14)


def test_oracle_knows_a_published_value():
    """cos of the worst case is 4.687165924254624e-19 in size (Muller 2006)."""
    assert float(abs(exact("cos", NEAREST[2]))) == pytest.approx(4.687165924254624e-19, rel=1e-15)


def test_oracle_sees_a_reduction_in_two_parts(monkeypatch):
    parts = (*elementary._HALF_PI[:2], 0.0, 0.0, 0.0)
    monkeypatch.setattr(elementary, "_HALF_PI", parts)
    xs = points()
    assert errors("sin", xs, elementary._sin(jnp.asarray(xs))).max() > 1e6


@pytest.mark.parametrize("name", ["_SIN", "_COS"])
def test_oracle_sees_a_missing_coefficient(monkeypatch, name):
    monkeypatch.setattr(elementary, name, getattr(elementary, name)[:-1])
    xs = np.linspace(0.5, 2.0, 200)
    worst = max(
        errors(f, xs, getattr(elementary, f"_{f}")(jnp.asarray(xs))).max() for f in ("sin", "cos")
    )
    assert worst > 10


@pytest.mark.parametrize("name", SINES)
def test_symmetry_and_special_values(name):
    function = getattr(elementary, name)
    xs = np.append(points(), np.nextafter(LIMIT, np.inf) * np.array([1.0, -3.0, 1e200]))
    sign = 1 if name == "cos" else -1
    np.testing.assert_array_equal(function(-xs), sign * function(xs))
    assert np.all(np.isnan(function(np.array([np.nan, np.inf, -np.inf]))))
    zeros = np.array([0.0, -0.0])
    values = np.asarray(function(zeros))
    np.testing.assert_array_equal(values, np.ones(2) if name == "cos" else zeros)
    if name != "cos":
        np.testing.assert_array_equal(np.signbit(values), [False, True])


@pytest.mark.parametrize("name", SINES)
@pytest.mark.parametrize("size", [1, 7, 512])
def test_neighbours_of_a_huge_argument_keep_their_bits(name, size):
    function = jax.jit(getattr(elementary, name))
    xs = np.random.default_rng(2).uniform(-100, 100, size)
    alone = np.asarray(function(xs))
    for huge in (1e9, np.nan, np.inf):
        disturbed = xs.copy()
        disturbed[size // 2] = huge
        values = np.asarray(function(disturbed))
        np.testing.assert_array_equal(np.delete(values, size // 2), np.delete(alone, size // 2))
        expected = getattr(jnp, name)(huge)
        np.testing.assert_array_equal(values[size // 2], expected)
        assert np.isnan(expected) == (huge != 1e9)


def test_one_lane_of_a_vmap_is_handed_over():
    xs = jnp.array([0.3, 1e9, -2.0])
    np.testing.assert_array_equal(jax.vmap(elementary.sin)(xs), elementary.sin(xs))
    # One condition for the batch, not a selection that evaluates both.
    text = str(jax.make_jaxpr(jax.vmap(elementary.sin))(xs))
    assert "cond[" in text
    nested = jax.vmap(jax.vmap(jax.grad(elementary.sin)))(jnp.stack([xs, xs + 1]))
    np.testing.assert_array_equal(nested, elementary.cos(jnp.stack([xs, xs + 1])))


@pytest.mark.parametrize("name", SINES)
def test_derivatives(name):
    function = getattr(elementary, name)
    xs = jnp.array([0.3, -1.2, 2.9, 40.0])
    for f in (function, function.pure):
        check_grads(jax.jit(f), (xs,), order=2, modes=["fwd", "rev"], atol=1e-5, rtol=1e-5)
        np.testing.assert_allclose(
            jax.vmap(jax.grad(f))(xs), jax.vmap(jax.grad(getattr(jnp, name)))(xs), rtol=1e-15
        )
        second, expected = (jax.vmap(jax.grad(jax.grad(g)))(xs) for g in (f, getattr(jnp, name)))
        np.testing.assert_allclose(second, expected, rtol=1e-14)
    central = central_difference(function, xs, jnp.ones_like(xs))
    assert np.max(np.abs(central - jax.jvp(function, (xs,), (jnp.ones_like(xs),))[1])) < 1e-9


@pytest.mark.parametrize("name", SINES)
def test_shapes_and_dtypes(name):
    function, library = getattr(elementary, name), getattr(jnp, name)
    for shape in [(), (0,), (3,), (2, 1, 3)]:
        x = jnp.full(shape, 0.7)
        assert function(x).shape == shape
        np.testing.assert_allclose(function(x), library(x), rtol=4e-16)
    for x in (jnp.float32(0.7), jnp.float32(1e9), jnp.array([1, 2]), 2, 0.7):
        assert function(x).dtype == library(x).dtype
        np.testing.assert_allclose(function(x), library(x), rtol=4e-16)
