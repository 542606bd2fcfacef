"""Elementary functions: errors in ulp over the whole range, hand-over, special values, slopes."""

import decimal
import functools
import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import primitives

from dvi_jax.engine import elementary

SINES = ("sin", "cos", "tan")
LIMIT = elementary.LIMIT
PRECISE = decimal.Context(prec=50)
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


def _root(x: Fraction) -> Fraction:
    shift = 2 * ((500 - x.numerator.bit_length() + x.denominator.bit_length()) // 2)
    return Fraction(math.isqrt(int(x * Fraction(2) ** shift))) / Fraction(2) ** (shift // 2)


def _exact_atan(x: Fraction) -> Fraction:
    """The angle of slope x ≥ 0, halved four times before the series."""
    if x > 1:
        return half_pi() - _exact_atan(1 / x)
    if x < Fraction(1, 2**40):
        return x - x**3 / 3 + x**5 / 5
    one = 1 << 200
    slope = round(x * one)
    for _ in range(4):
        slope = slope * one // (one + math.isqrt(one * one + slope * slope))
    total, power, m = 0, slope, 0
    while power:
        total += power // (2 * m + 1) * (-1) ** m
        power = power * slope // one * slope // one
        m += 1
    return Fraction(16 * total, one)


def exact(name: str, *xs: float) -> Fraction:
    """The function of that name to 100 binary digits at least."""
    x, *more = (Fraction(float(x)) for x in xs)
    if name in ("sin", "cos"):
        turns = round(x / half_pi())
        r = x - turns * half_pi()
        odd = (turns + (name == "cos")) % 4
        value = _series(r, 1 - odd % 2, 120 + max(0, -math.frexp(float(r))[1]))
        return -value if odd >= 2 else value
    if name == "tan":
        return exact("sin", x) / exact("cos", x)
    if name == "log":
        return Fraction(*decimal.Decimal(float(x)).ln(PRECISE).as_integer_ratio())
    if name == "pow":
        return _root(x ** int(2 * more[0]))
    if name == "acos":
        return 2 * _exact_atan(_root((1 - x) / (1 + x))) if x > -1 else 2 * half_pi()
    if name == "asin":
        angle = _exact_atan(_root(x * x / (1 - x * x))) if abs(x) < 1 else half_pi()
    elif name == "atan":
        angle = _exact_atan(abs(x))
    elif name == "atan2":
        angle = _exact_atan(abs(x / more[0])) if more[0] else half_pi()
        angle = 2 * half_pi() - angle if more[0] < 0 else angle
    else:
        raise ValueError(name)
    return -angle if x < 0 else angle


def errors(name: str, *xs_and_values) -> np.ndarray:
    """|value − exact|/ulp at each point."""
    out = []
    for *x, value in zip(*map(np.ravel, xs_and_values), strict=True):
        truth = exact(name, *x)
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


BOUNDS = {"sin": 0.9, "cos": 0.9, "tan": 1.6}
"""Largest error [ulp]. At 4 million points (`benchmarks/elementary.py`): 0.82, 0.85, 1.48."""


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


def derivatives(f, xs):
    """∂f/∂x_i reverse and forward, and ∂²f/∂x_i∂x_j forward over reverse, flat."""

    def of(*x):
        every = tuple(range(len(x)))
        back, forth = jax.grad(f, every), jax.jacfwd(f, every)
        return back(*x), forth(*x), jax.jacfwd(back, every)(*x)

    return np.concatenate([np.ravel(v) for v in jax.tree.leaves(jax.jit(jax.vmap(of))(*xs))])


@pytest.mark.parametrize("name", SINES)
def test_derivatives(name):
    function, library = getattr(elementary, name), getattr(jax.lax, name)
    xs = (jnp.array([0.3, -1.2, 2.9, 40.0]),)
    expected = derivatives(library, xs)
    for f in (function, function.pure):
        np.testing.assert_allclose(derivatives(f, xs), expected, rtol=1e-14)
    # Without the library: the slope beyond the limit is NaN as the value is.
    assert np.isnan(jax.grad(function.pure)(1e9))
    np.testing.assert_allclose(jax.grad(function)(1e9), jax.grad(library)(1e9), rtol=1e-15)


PLAIN = """
abs add sub mul div neg floor eq ne lt le gt ge xor select_n convert_element_type broadcast_in_dim
"""
"""What is one vector instruction each, with no call and no branch."""


def primitives_of(jaxpr):
    for equation in jaxpr.eqns:
        inner = [v for v in jax.tree.leaves(tuple(equation.params.values())) if hasattr(v, "jaxpr")]
        if not inner:
            yield equation.primitive.name
        for closed in inner:
            yield from primitives_of(closed.jaxpr)


@pytest.mark.parametrize("name", SINES)
def test_arithmetic_is_plain(name):
    """So a loop stays one over vectors, its derivative included; the hand-over would split it."""
    function, x = getattr(elementary, name), jnp.ones(3)

    def used(f):
        return set(primitives_of(jax.make_jaxpr(lambda x: jax.jvp(f, (x,), (x,)))(x).jaxpr))

    assert {"mul", "floor"} <= used(function.pure) <= set(PLAIN.split())
    assert used(function) - set(PLAIN.split())


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


# --- the others -------------------------------------------------------------------------------


def arguments(name):
    """Arguments over the whole range, dense where one form of the arithmetic ends."""
    rng = np.random.default_rng(3)
    signs = rng.choice([-1.0, 1.0], 1200)
    sizes = 10 ** rng.uniform(-300, 300, 300)
    if name in ("asin", "acos"):
        ones = [1.0, -1.0, 0.5, -0.5, np.nextafter(1, 0), np.nextafter(0.5, 1)]
        small, near_1 = 10 ** rng.uniform(-300, 0, 300), 1 - 10 ** rng.uniform(-16, -1, 300)
        xs = np.concatenate([rng.uniform(0, 1, 300), rng.uniform(0.45, 0.55, 300), small, near_1])
        return (np.append(signs * xs, ones),)
    if name == "atan":
        xs = np.concatenate([rng.uniform(0, 5, 400), rng.uniform(0.2, 1.3, 500), sizes])
        return (signs * xs,)
    if name == "log":
        near_1 = 1 + 10 ** rng.uniform(-16, -1, 300)
        return (
            np.concatenate([rng.uniform(0, 5, 300), rng.uniform(0.65, 1.5, 300), near_1, sizes]),
        )
    y, x = rng.uniform(-3, 3, (2, 900))
    extreme = 10 ** rng.uniform(300, 307.6, (2, 50))
    y = np.concatenate([y, signs[:300] * sizes, extreme[0], 1 / extreme[0]])
    x = np.concatenate([x, rng.permutation(sizes), -extreme[1], 1 / extreme[1]])
    keep = np.abs(np.log(np.abs(y)) - np.log(np.abs(x))) < 700  # y/x is a normal number
    return y[keep], x[keep]


OTHERS = {"asin": 1.7, "acos": 1.2, "atan": 1.5, "atan2": 1.7, "log": 0.9}
"""Largest error [ulp]. At 4 million points: 1.60, 1.09, 1.36, 1.56, 0.83."""


@pytest.mark.parametrize("name", OTHERS)
def test_error_of_the_others(name):
    xs = arguments(name)
    assert errors(name, *xs, getattr(elementary, name)(*xs)).max() < OTHERS[name]


@pytest.mark.parametrize(
    ("name", "table"), [("asin", "_ASIN"), ("atan", "_ATAN"), ("atan2", "_ATAN"), ("log", "_LOG")]
)
def test_oracle_sees_a_missing_coefficient_of_the_others(monkeypatch, name, table):
    monkeypatch.setattr(elementary, table, getattr(elementary, table)[:-1])
    xs = [x[::5] for x in arguments(name)]
    values = getattr(elementary, f"_{name}")(*map(jnp.asarray, xs))
    assert errors(name, *xs, values).max() > 3


@pytest.mark.parametrize("y", [0.5, 1.5, 2.5, 3.5, -0.5, -1.5, -2.5, -3.5])
def test_error_of_half_integer_powers(y):
    rng = np.random.default_rng(4)
    xs = np.concatenate([rng.uniform(0.1, 5, 300), 10 ** rng.uniform(-66, 66, 200)])
    ys = np.full_like(xs, y)
    # A rounding each for √, products and 1/·, of half to one ulp each.
    roundings = 1 + max(0, abs(y) - 0.5) + (y < 0)
    assert errors("pow", xs, ys, elementary.pow(xs, y)).max() < 0.5 + 0.7 * roundings
    specials = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, -1.0])
    np.testing.assert_array_equal(elementary.pow(specials, y), jax.lax.pow(specials, np.full(6, y)))
    slopes = jax.vmap(jax.grad(lambda x: elementary.pow(x, y)))(xs)
    np.testing.assert_allclose(slopes, y * xs ** (y - 1), rtol=2e-15)


def test_other_powers_are_those_of_the_library():
    x = jnp.array([0.3, 2.0])
    for y in (1.3, 4.5, 2, np.array([1.5, 0.5]), jnp.array(1.5)):
        np.testing.assert_array_equal(elementary.pow(x, y), jnp.power(x, y))
    assert " pow" not in str(jax.make_jaxpr(lambda x: elementary.pow(x, 1.5))(x))
    assert " pow" in str(jax.make_jaxpr(elementary.pow)(x, 1.5))


@pytest.mark.parametrize("name", OTHERS)
def test_special_values_are_those_of_the_library(name):
    special = np.array([0.0, -0.0, 1.0, -1.0, 2.0, -2.0, 1e300, np.inf, -np.inf, np.nan])
    xs = (special,)
    if name == "atan2":
        xs = tuple(np.ravel(g) for g in np.meshgrid(special, special))
    ours, expected = getattr(elementary, name)(*xs), getattr(jax.lax, name)(*xs)
    np.testing.assert_allclose(ours, expected, rtol=4e-16, atol=0)
    number = ~np.isnan(expected)
    np.testing.assert_array_equal(np.signbit(ours)[number], np.signbit(expected)[number])


@pytest.mark.parametrize("name", OTHERS)
def test_symmetry_derivatives_and_dtypes_of_the_others(name):
    function, library = elementary.VECTORISED[name], getattr(jax.lax, name)
    xs = [x[:200] for x in arguments(name)]
    if name in ("asin", "atan", "atan2"):
        np.testing.assert_array_equal(function(-xs[0], *xs[1:]), -function(*xs))
    at = (jnp.array([0.3, 0.9]), jnp.array([0.7, -0.2]))[: len(xs)]
    np.testing.assert_allclose(derivatives(function, at), derivatives(library, at), rtol=1e-14)
    single = [x.astype(jnp.float32) for x in at]
    assert function(*single).dtype == jnp.float32
    np.testing.assert_array_equal(function(*single), library(*single))


# --- where the coefficients come from ---------------------------------------------------------


def interpolated(series, length, n):
    """The polynomial through `series` at n points of [0, length], coefficients in float64.

    The points are the zeros of the Chebyshev polynomial of degree n + 1 in the variable that has
    its first zero at 0 and the end of its interval at `length`: there g(z) is multiplied by z.
    """
    cosines = [math.cos(math.pi * (2 * j + 1) / (2 * n + 2)) for j in range(n + 1)]
    first = cosines.pop()
    z = [Fraction(round(2**20 * length * (c - first) / (1 - first)), 2**20) for c in cosines]
    divided = [series(point) for point in z]
    for k in range(1, n):
        for i in range(n - 1, k - 1, -1):
            divided[i] = (divided[i] - divided[i - 1]) / (z[i] - z[i - k])
    total = [Fraction(0)] * n
    for i in range(n - 1, -1, -1):  # Horner's scheme in z − z_i
        shifted = [Fraction(0), *total[:-1]]
        total = [s - z[i] * t for s, t in zip(shifted, total, strict=True)]
        total[0] += divided[i]
    return tuple(map(float, total))


SERIES = {
    "_SIN": (0.625, lambda k: Fraction((-1) ** k, math.factorial(2 * k + 1)), 1, 18),
    "_COS": (0.625, lambda k: Fraction((-1) ** k, math.factorial(2 * k)), 2, 18),
    "_ATAN": (0.09, lambda k: Fraction((-1) ** k, 2 * k + 1), 1, 40),
    "_ASIN": (0.25, lambda k: Fraction(math.comb(2 * k, k), 4**k * (2 * k + 1)), 1, 90),
    "_LOG": (0.02945, lambda k: Fraction(2, 2 * k + 1), 1, 40),
}
"""Length of the interval, coefficient of z^k, first and last k: Σ a_k z^(k − first)."""


@pytest.mark.parametrize("table", SERIES)
def test_coefficients_are_interpolated(table):
    length, coefficient, first, last = SERIES[table]

    def series(z):
        return sum(coefficient(k) * z ** (k - first) for k in range(first, last))

    mine = getattr(elementary, table)
    assert interpolated(series, length, len(mine)) == mine


def test_parts_of_constants():
    """Each constant is the sum of its parts, short where products must be exact."""

    def is_short(x, bits):
        return Fraction(x).numerator.bit_length() <= bits

    parts = elementary._HALF_PI
    assert abs(sum(map(Fraction, parts)) - half_pi()) < Fraction(1, 2**157)
    assert all(is_short(p, 53 - 27) for p in parts[:4])
    assert not is_short(parts[4], 53 - 27)
    for pair, whole in [
        (elementary._PI_2, half_pi()),
        (elementary._ATAN_HALF, _exact_atan(Fraction(1, 2))),
        (elementary._LOG_2, exact("log", 2)),
    ]:
        assert abs(sum(map(Fraction, pair)) - whole) < Fraction(1, 2**93)
    assert is_short(elementary._LOG_2[0], 53 - 11)


def test_table_of_primitives():
    for name, function in elementary.VECTORISED.items():
        assert getattr(primitives, f"{name}_p").name == name
        assert function is getattr(elementary, name)
