"""Elementary functions of generated code: errors in ulp, special values, constants.

They are evaluated in two ways: as generated code, where products and sums become fused
multiply-adds, and by an interpreter of their jaxprs in NumPy, which rounds each product. The second
is what constants in generated code have.
"""

import functools
import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax import lax
from jax.extend.core import primitives
from mpmath import mpf

import lanewise
from lanewise import elementary
from lanewise.elementary import logarithmic, tables
from lanewise.rules.elementary import _at_known as at_known_arguments


def _shift_right(x, count):
    return (np.asarray(x).view(np.uint64) >> np.asarray(count).view(np.uint64)).view(np.int64)


OPERATIONS = {
    **{name: getattr(np, name) for name in ("abs", "sqrt", "floor")},
    **{"add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative,
       "round": np.rint, "lt": np.less, "le": np.less_equal, "gt": np.greater,
       "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal, "and": np.bitwise_and,
       "or": np.bitwise_or, "xor": np.bitwise_xor, "not": np.bitwise_not,
       "shift_left": np.left_shift, "shift_right_logical": _shift_right,
       "select_n": lambda condition, at_false, at_true: np.where(condition, at_true, at_false)},
}  # fmt: skip
CONVERSIONS = {
    "bitcast_convert_type": lambda x, dtype: np.ascontiguousarray(x).view(dtype),
    "convert_element_type": lambda x, dtype: x.astype(dtype),
}
"""All that generated code has for these functions, besides branches."""


def evaluate(closed, arguments):
    """Values of a jaxpr on arrays."""
    jaxpr = closed.jaxpr
    values = dict(zip(jaxpr.constvars, map(np.asarray, closed.consts), strict=True))
    values |= dict(zip(jaxpr.invars, arguments, strict=True))

    def value(v):
        return np.asarray(v.val) if hasattr(v, "val") else values[v]

    for e in jaxpr.eqns:
        name, xs = e.primitive.name, [value(v) for v in e.invars]
        if name == "cond":
            at_0, at_1 = (evaluate(b, xs[1:]) for b in e.params["branches"])
            out = [np.where(xs[0] != 0, y, x) for x, y in zip(at_0, at_1, strict=True)]
        elif name in CONVERSIONS:
            out = [CONVERSIONS[name](xs[0], e.params["new_dtype"])]
        else:
            out = [OPERATIONS[name](*xs)]
        values.update(zip(e.outvars, out, strict=True))
    return [value(v) for v in jaxpr.outvars]


def run(function, *xs):
    """The function of scalars on arrays, as constants in generated code are computed."""
    closed = jax.make_jaxpr(function)(*[1.0] * len(xs))
    with np.errstate(all="ignore"):
        out = evaluate(closed, [np.asarray(x, float) for x in xs])
    return out[0] if len(out) == 1 else out


def exact(name, *xs):
    """The function of that name with 100 correct bits at least."""
    xs = [float(x) for x in xs]
    # The bits that small arguments of 1 + x and large ones of sin take.
    mpmath.mp.prec = 150 + 2 * max(abs(math.frexp(x)[1]) for x in xs)
    xs = [mpf(x) for x in xs]
    if name == "erf_inv" and abs(xs[0]) < 1e-30:  # where mpmath has no relative accuracy
        return xs[0] * mpmath.sqrt(mpmath.pi) / 2
    others = {
        "logistic": lambda x: 1 / (1 + mpmath.exp(-x)), "exp2": lambda x: mpf(2) ** x,
        "pow": mpmath.power, "cbrt": lambda x: mpmath.sign(x) * mpmath.cbrt(abs(x)),
        "erf_inv": mpmath.erfinv,
    }  # fmt: skip
    return (others.get(name) or getattr(mpmath, name))(*xs)


def errors(name, xs, values):
    """|value − exact|/ulp at each point."""
    out = []
    for *x, value in zip(*xs, values, strict=True):
        truth = exact(name, *x)
        assert np.isfinite(value), (name, x)
        out.append(abs(mpf(float(value)) - truth) / mpf(math.ulp(float(truth))))
    return np.asarray(out, float)


# Found by continued fractions of 2^e 2/π: nearest to a multiple of π/2 of all doubles up to 2²⁷,
# of those from 2²³ on, and (J.-M. Muller, Elementary Functions, 2006, ch. 9) of all.
NEAREST = [6411027962775774 * 2.0**-47, 7763785107565477 * 2.0**-29, 6381956970095103 * 2.0**797]
BOUNDS = {
    "sin": 0.95, "cos": 0.95, "tan": 1.65, "asin": 1.65, "acos": 1.15, "atan": 1.45, "atan2": 1.65,
    "sinh": 1.75, "cosh": 0.9, "tanh": 1.5, "asinh": 1.3, "acosh": 1.8, "atanh": 1.65,
    "logistic": 1.2, "exp": 0.87, "exp2": 0.78, "expm1": 1.35, "log": 0.9, "log1p": 0.94,
    "pow": 0.78, "cbrt": 0.52, "erf": 1.05, "erfc": 1.7, "erf_inv": 4.1,
}  # fmt: skip
"""Largest error [ulp]; the docstring of the module has the largest one seen."""


def points(name, n=250, seed=0):
    """Arguments over the whole range, dense near zeros and where one form of arithmetic ends."""
    rng = np.random.default_rng(seed)

    def of_both_signs(*parts):
        xs = np.concatenate(parts)
        return xs * rng.choice([-1.0, 1.0], xs.size)

    def around(*places):
        return np.concatenate(
            [p + 10 ** rng.uniform(-16, -1, n // 4) * s for p in places for s in (-1, 1)]
        )

    def spread(low, high, count=n):
        return rng.uniform(low, high, count)

    tiny = np.append(10 ** rng.uniform(-323.3, -1, n), [5e-324, 2.0**-1022, 2.0**-1022 * 1.5])
    huge = np.append(10 ** rng.uniform(1, 308.2, n), np.finfo(float).max)
    if name in ("sin", "cos", "tan"):
        near = np.append(np.arange(1, n // 2), rng.integers(1, 2**40, n // 2)) * np.pi / 2
        ends = np.nextafter([2.0**21, 2.0**27], [[0.0], [np.inf]]).ravel()
        regions = spread(0, 8), spread(2**20, 2**28), near, np.array(NEAREST), ends
        return (of_both_signs(tiny, huge, *regions),)
    if name in ("asin", "acos", "atanh", "erf_inv"):
        ones = np.nextafter([1.0, 0.5], 0)
        xs = of_both_signs(spread(0, 1), tiny, 1 - 10 ** rng.uniform(-16, -1, n), ones)
        return (np.append(xs, around(0.5)),)
    if name in ("atan2", "pow"):
        x, y = spread(-3, 3, 2 * n), spread(-3, 3, 2 * n)
        if name == "pow":
            near_1 = 1 + of_both_signs(10 ** rng.uniform(-15.5, -1, n))
            x = np.concatenate([np.abs(x), 10 ** rng.uniform(-323.3, 308, n), near_1])
            slow, fast = 10 ** rng.uniform(-5, 2.5, n), 10 ** rng.uniform(1, 17, n)
            y = np.concatenate([y * 30, of_both_signs(slow), of_both_signs(fast)])
            size = y * np.log(x)
            keep = (size > -744) & (size < 709)
        else:
            y = np.append(y, of_both_signs(tiny, huge))
            x = np.append(x, of_both_signs(rng.permutation(np.append(tiny, huge))))
            keep = np.abs(np.log(np.abs(y)) - np.log(np.abs(x))) < 700  # y/x is a normal number
        return (x[keep], y[keep]) if name == "pow" else (y[keep], x[keep])
    if name in ("log", "acosh"):
        xs = np.concatenate([spread(0, 5), around(1.0), spread(0.65, 1.5), huge, tiny])
        return (xs[xs >= 1] if name == "acosh" else xs[xs > 0],)
    if name == "log1p":
        xs = np.append(of_both_signs(spread(0, 1), tiny, 1 - tiny[tiny > 1e-16]), huge)
        return (xs[xs > -1],)
    if name in ("atan", "asinh", "cbrt"):
        return (of_both_signs(spread(0, 5), tiny, huge, spread(0.2, 1.3)),)
    if name == "erfc":
        return (
            np.concatenate([spread(-6, 6), of_both_signs(tiny), spread(0.3, 1.5), spread(1, 26.6)]),
        )
    # Functions with e^x.
    low, high = {"exp": (-745, 709.7), "expm1": (-60, 709.7), "exp2": (-1074, 1023.9)}.get(
        name, {"erf": (-6, 6), "tanh": (-25, 25), "logistic": (-745, 50)}.get(name, (-710.4, 710.4))
    )
    breaks = np.log(2) * np.array([-0.5, 0.5, 1.5]) if name != "exp2" else np.array([-0.5, 0.5])
    return (
        np.concatenate([spread(low, high), spread(-2, 2), of_both_signs(tiny), around(*breaks)]),
    )


@pytest.mark.parametrize("name", elementary.FUNCTIONS)
def test_error(name):
    xs = points(name)
    assert errors(name, xs, run(elementary.FUNCTIONS[name], *xs)).max() < BOUNDS[name]


def of_xla(of):
    return {name: jax.vmap(elementary.FUNCTIONS[name])(*xs) for name, xs in of.items()}


def of_generated_code(of):
    one = lanewise.batched(lambda of: {name: getattr(lax, name)(*xs) for name, xs in of.items()})
    size = max(len(xs[0]) for xs in of.values())
    return one({name: [jnp.resize(x, size) for x in xs] for name, xs in of.items()})


@functools.cache
def compiled(by, seed, n):
    """Arguments and results of all functions, in one program."""
    of = {name: points(name, n, seed) for name in elementary.FUNCTIONS}
    found = jax.jit(by)(of)
    return {name: (xs, np.asarray(found[name])[: len(xs[0])]) for name, xs in of.items()}


@pytest.mark.parametrize(
    ("by", "n"), [(of_generated_code, 250), pytest.param(of_xla, 40, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name", elementary.FUNCTIONS)
def test_error_when_compiled(name, by, n):
    """With fused multiply-adds; XLA simplifies sums of several constants, which must not spoil an
    error-free sum. Both run with subnormal numbers replaced by zero."""
    xs, values = compiled(by, 1, n)[name]
    keep = (np.abs(values) > 1e-300) & (np.min(np.abs(xs), axis=0) > 1e-290)
    assert keep.sum() > 80
    assert errors(name, [x[keep] for x in xs], values[keep]).max() < BOUNDS[name]


@pytest.mark.parametrize("name", elementary.FUNCTIONS)
def test_known_arguments_have_the_value_of_the_interpreter(name):
    """Also where the result is subnormal, which XLA would replace by zero."""
    xs = [x[::9] for x in points(name)]
    expected = run(elementary.FUNCTIONS[name], *xs)
    values = [at_known_arguments(name, tuple(args)) for args in np.stack(xs, 1).tolist()]
    np.testing.assert_array_equal(values, expected)


def pairs_of_all_sizes(count, dtype):
    """Dividends and divisors: of any bits, of similar sizes, near multiples, and special ones."""
    rng = np.random.default_rng(6)
    word, ends = np.dtype(f"u{np.dtype(dtype).itemsize}"), np.finfo(dtype)
    of_bits = rng.integers(0, np.iinfo(word).max, (2, 2 * count), dtype=word).view(dtype)
    x, y = of_bits[:, np.isfinite(of_bits).all(axis=0)]
    close = x[:count] * rng.uniform(-2, 2, count) * 10.0 ** rng.integers(-18, 2, count)
    divisor = x[:count] / rng.integers(1, 2**40, count)
    multiple = y[:count] * rng.integers(1, 2**30, count)
    largest = np.asarray(4 * ends.tiny, dtype).view(word)
    tiny = rng.integers(0, largest, (2, count), dtype=word).view(dtype)
    special = [0.0, ends.smallest_subnormal, ends.tiny, ends.tiny * (2 - 2 * ends.eps), 1.0, 3.0]
    special = np.array([*special, 2.0**53, ends.max, INF, NAN])
    grid = [g.ravel() for g in np.meshgrid(*[np.append(special, -special)] * 2)]
    first = [x[:count], x[:count], x[:count], multiple, tiny[0], x[:count], grid[0]]
    second = [y[:count], close, divisor, y[:count], tiny[1], tiny[1], grid[1]]
    return (np.concatenate(parts).astype(dtype) for parts in (first, second))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.filterwarnings("ignore:overflow|invalid|divide")
def test_remainder_is_that_of_c(dtype):
    """Exact for all arguments, quotients of 2000 bits included; subnormal numbers are zero."""
    with np.errstate(all="ignore"):
        x, y = pairs_of_all_sizes(20_000, dtype)
        expected = np.fmod(x, y)
    assert np.isfinite(expected).sum() > 1e5
    smallest = np.finfo(dtype).tiny
    normal = [(np.abs(z) >= smallest) | (z == 0) | ~np.isfinite(z) for z in (x, y, expected)]
    x, y, expected = (z[np.logical_and.reduce(normal)] for z in (x, y, expected))
    assert np.isfinite(expected).sum() > 7e4
    assert np.sum(np.abs(x / 2.0**53) > np.maximum(np.abs(y), smallest)) > 1e4
    values = np.asarray(jax.jit(lanewise.batched(lax.rem))(x, y))
    number = ~np.isnan(expected)
    np.testing.assert_array_equal(values, expected)
    np.testing.assert_array_equal(np.signbit(values)[number], np.signbit(expected)[number])
    known = jax.jit(lanewise.batched(lambda z: z * 0 + lax.rem(dtype(-5.3), dtype(0.7))))
    assert known(np.zeros(2, dtype))[1] == np.fmod(dtype(-5.3), dtype(0.7))


def test_sincos_and_the_oracle():
    (xs,) = points("sin")
    for value, name in zip(run(elementary.sincos, xs), ("sin", "cos"), strict=True):
        np.testing.assert_array_equal(value, run(elementary.FUNCTIONS[name], xs))
    # cos of the worst case is 4.687165924254624e-19 in size (Muller 2006).
    assert float(abs(exact("cos", NEAREST[2]))) == pytest.approx(4.687165924254624e-19, rel=1e-15)


ODD = ["sin", "tan", "asin", "atan", "sinh", "tanh", "asinh", "atanh", "cbrt", "erf", "erf_inv"]


@pytest.mark.parametrize("name", [*ODD, "cos", "cosh"])
def test_symmetry(name):
    function, (xs,) = elementary.FUNCTIONS[name], points(name)
    values = run(function, xs)
    np.testing.assert_array_equal(run(function, -xs), -values if name in ODD else values)


@pytest.fixture
def defect(monkeypatch):
    """Replaces a table; JAX must not reuse what it traced before, nor this afterwards."""

    def replaced(table, values):
        monkeypatch.setattr(tables, table, values)
        jax.clear_caches()

    yield replaced
    jax.clear_caches()


DEFECTS = """
    SIN sin, COS cos, ATAN atan, ATAN atan2, ASIN asin, EXP exp, EXP expm1, LOG log, LOG asinh,
    LOG2_5 pow, CBRT cbrt, ERF erf, ERFC erfc, HALF_PI_4 sin, HALF_PI_5 cos, LOG_2 exp,
    LOG_2_HEAD exp2, LOG2_1 pow, LOG2_3 pow, ERF_INV erf_inv, ERF_INV_TAIL erf_inv
"""


@pytest.mark.parametrize(("table", "name"), [pair.split() for pair in DEFECTS.split(",")])
def test_error_without_the_last_coefficient(defect, table, name):
    defect(table, (*getattr(tables, table)[:-1], 0.0))
    xs = points(name)
    assert errors(name, xs, run(elementary.FUNCTIONS[name], *xs)).max() > 1.2 * BOUNDS[name]


@pytest.mark.parametrize("count", [10, 17])
def test_error_with_fewer_digits_of_two_over_pi(defect, count):
    table = tables.TWO_OVER_PI
    defect("TWO_OVER_PI", table[:count] + (0,) * (len(table) - count))
    largest = np.random.default_rng(0).uniform(1e308, 1.7e308, 50)
    assert errors("sin", [largest], run(elementary.sin, largest)).max() > 100


INF, NAN, PI, TINY = math.inf, math.nan, math.pi, 5e-324
SPECIAL = {
    "sin": {0.0: 0.0, INF: NAN, TINY: TINY},
    "cos": {0.0: 1.0, INF: NAN, -INF: NAN, TINY: 1.0},
    "tan": {0.0: 0.0, INF: NAN, TINY: TINY},
    "asin": {0.0: 0.0, 1.0: PI / 2, 1 + 2**-52: NAN, INF: NAN, TINY: TINY},
    "acos": {0.0: PI / 2, 1.0: 0.0, -1.0: PI, 2.0: NAN, -2.0: NAN, INF: NAN},
    "atan": {0.0: 0.0, 1.0: PI / 4, INF: PI / 2, TINY: TINY},
    "sinh": {0.0: 0.0, INF: INF, 711.0: INF, TINY: TINY},
    "cosh": {0.0: 1.0, INF: INF, -INF: INF, 711.0: INF, -711.0: INF},
    "tanh": {0.0: 0.0, INF: 1.0, 30.0: 1.0, 1e300: 1.0, TINY: TINY},
    "asinh": {0.0: 0.0, INF: INF, TINY: TINY},
    "acosh": {1.0: 0.0, 0.5: NAN, 0.0: NAN, -2.0: NAN, INF: INF, -INF: NAN},
    "atanh": {0.0: 0.0, 1.0: INF, 1 + 2**-52: NAN, INF: NAN, TINY: TINY},
    "logistic": {0.0: 0.5, INF: 1.0, -INF: 0.0, 800.0: 1.0, -800.0: 0.0},
    "exp": {0.0: 1.0, INF: INF, -INF: 0.0, 709.8: INF, -745.2: 0.0, -745.1: TINY},
    "exp2": {0.0: 1.0, INF: INF, -INF: 0.0, 1024.0: INF, -1074.0: TINY, -1075.5: 0.0}
    | {float(k): 2.0**k for k in range(-1073, 1024, 99)},
    "expm1": {0.0: 0.0, INF: INF, -INF: -1.0, 709.8: INF, -800.0: -1.0, TINY: TINY},
    "log": {1.0: 0.0, 0.0: -INF, INF: INF, -INF: NAN, -1.0: NAN, -TINY: NAN},
    "log1p": {0.0: 0.0, -1.0: -INF, -1.5: NAN, INF: INF, -INF: NAN, -TINY: -TINY},
    "cbrt": {0.0: 0.0, INF: INF} | {k**3: k for k in (1.0, 3.0, 1e5, 123457.0, 2.0**-358)},
    "erf": {0.0: 0.0, INF: 1.0, 7.0: 1.0, 1e300: 1.0, TINY: TINY},
    "erf_inv": {0.0: 0.0, 1.0: INF, 1 + 2**-52: NAN, INF: NAN},
    "erfc": {0.0: 1.0, INF: 0.0, -INF: 2.0, 28.0: 0.0, 1e300: 0.0, -9.0: 2.0},
}
"""As in C99, Annex F; those of odd functions for one sign, and of 0 for that of +0."""
AT_MINUS_0 = {"expm1": -0.0, "log1p": -0.0}


@pytest.mark.parametrize("name", SPECIAL)
def test_special_values(name):
    xs, expected = np.array(list(SPECIAL[name].items())).T
    if name in ODD:
        xs, expected = np.append(xs, -xs), np.append(expected, -expected)
    elif 0.0 in SPECIAL[name]:
        at_0 = SPECIAL[name][0.0]
        xs, expected = np.append(xs, -0.0), np.append(expected, at_0 if at_0 else AT_MINUS_0[name])
    xs, expected = np.append(xs, NAN), np.append(expected, NAN)
    values = run(elementary.FUNCTIONS[name], xs)
    np.testing.assert_array_equal(values, expected)
    number = ~np.isnan(expected)
    np.testing.assert_array_equal(np.signbit(values)[number], np.signbit(expected)[number])


@pytest.mark.parametrize(
    ("name", "library"), [("pow", np.power), ("atan2", np.arctan2)], ids=["pow", "atan2"]
)
def test_special_values_of_two_arguments(name, library):
    """On a grid, against the C library, which has those of C99."""
    half = [0.0, TINY, 1e-310, 0.3, 0.5, 1 - 2**-53, 1.0, 1 + 2**-52, 2.0, 3.0, 2.0**53 - 1]
    half = [*half, 2.0**53, 1e300, np.finfo(float).max, INF]
    grid = np.array([*half, *(-x for x in half), NAN])
    xs = [g.ravel() for g in np.meshgrid(grid, grid)]
    with np.errstate(all="ignore"):
        expected = library(*xs)
    values = run(elementary.FUNCTIONS[name], *xs)
    exceptional = (expected == 0) | ~np.isfinite(expected)
    if name == "pow":
        exceptional |= (np.abs(xs[0]) == 1) | (xs[1] == 0)
    np.testing.assert_array_equal(values[exceptional], expected[exceptional])
    np.testing.assert_allclose(values, expected, rtol=4.5e-16, atol=TINY)
    number = ~np.isnan(expected)
    np.testing.assert_array_equal(np.signbit(values)[number], np.signbit(expected)[number])


@pytest.mark.parametrize("twice", [-7, -5, -3, -1, 1, 3, 5, 7])
def test_half_integer_powers(twice):
    rng = np.random.default_rng(4)
    xs = np.concatenate([rng.uniform(0.1, 5, 200), 10 ** rng.uniform(-66, 66, 200)])
    ys = np.full_like(xs, twice / 2)
    roundings = 1 + abs(twice) // 2 + (twice < 0)
    values = run(logarithmic.half_integer_power(twice), xs)
    assert errors("pow", (xs, ys), values).max() < 0.5 + 0.7 * roundings
    special = np.array([0.0, -0.0, INF, -INF, NAN, -1.0])
    at_0, at_infinity = (0.0, INF) if twice > 0 else (INF, 0.0)
    expected = [at_0, at_0, at_infinity, at_infinity, NAN, NAN]
    values = run(logarithmic.half_integer_power(twice), special)
    np.testing.assert_array_equal(values, expected)
    assert not np.any(np.signbit(values[:4]))


def test_half_integer_power_rejects_an_integer():
    with pytest.raises(ValueError, match="must be odd, got 4"):
        logarithmic.half_integer_power(4)


def primitives_of(jaxpr):
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for branch in equation.params.get("branches", ()):
            assert not branch.consts
            yield from primitives_of(branch.jaxpr)


@pytest.mark.parametrize("name", elementary.FUNCTIONS)
def test_primitives(name):
    """Each is a primitive of JAX, and made of scalar operations that generated code has."""
    count = 2 if name in ("pow", "atan2") else 1
    assert getattr(primitives, f"{name}_p").name == name
    closed = jax.make_jaxpr(elementary.FUNCTIONS[name])(*[1.0] * count)
    assert set(primitives_of(closed.jaxpr)) <= {*OPERATIONS, *CONVERSIONS, "cond"}
    assert all(v.aval.shape == () for e in closed.eqns for v in (*e.invars, *e.outvars))
    assert [v.aval.dtype for v in closed.jaxpr.outvars] == [np.dtype(float)]


def interpolated(function, nodes):
    """Coefficients of the polynomial through the function at the nodes, by Newton's form."""
    n = len(nodes)
    divided = [function(z) for z in nodes]
    for k in range(1, n):
        for i in range(n - 1, k - 1, -1):
            divided[i] = (divided[i] - divided[i - 1]) / (nodes[i] - nodes[i - k])
    total = [mpf(0)] * n
    for i in range(n - 1, -1, -1):  # Horner's scheme in z − z_i
        shifted = [mpf(0), *total[:-1]]
        total = [s - nodes[i] * t for s, t in zip(shifted, total, strict=True)]
        total[0] += divided[i]
    return total


def chebyshev(low, high, n):
    """Zeros of the Chebyshev polynomial of degree n on an interval."""
    cosines = [mpmath.cos(mpmath.pi * (2 * j + 1) / (2 * n)) for j in range(n)]
    return [(low + high) / 2 + (high - low) / 2 * c for c in cosines]


def one_sided(length, n, bits=None):
    """Zeros of that of degree n + 1 whose first zero is 0, without it: for g(z) in z g(z)."""
    *cosines, first = (mpmath.cos(mpmath.pi * (2 * j + 1) / (2 * n + 2)) for j in range(n + 1))
    nodes = [length * (c - first) / (1 - first) for c in cosines]
    return nodes if bits is None else [mpmath.nint(z * 2**bits) / 2**bits for z in nodes]


def series(coefficient, first):
    """Σ a_k z^(k − first), of 120 terms."""
    return lambda z: mpmath.fsum(coefficient(k) * z ** (k - first) for k in range(first, 120))


def _erfc_factor(v):
    x = 8 / (1 - v) - 3
    return (x + 3) * mpmath.exp(x * x) * mpmath.erfc(x)


def _erf_inv_factor(w):
    x = mpmath.sqrt(-mpmath.expm1(-w))
    return mpmath.erfinv(x) / x


def _exp_nodes(n):
    """Of both signs, and for g in r² g: a double zero at 0."""
    roots = [mpmath.sqrt(z) for z in one_sided(mpf("0.3475") ** 2, n // 2)]
    return [sign * root for root in roots for sign in (-1, 1)]


# Tables of coefficients a_k in Σ a_k z^(k − first): k → a_k, first, largest z, bits of the nodes.
SERIES = {
    "SIN": (lambda k: mpf((-1) ** k) / mpmath.factorial(2 * k + 1), 1, 0.625, 20),
    "COS": (lambda k: mpf((-1) ** k) / mpmath.factorial(2 * k), 2, 0.625, 20),
    "ATAN": (lambda k: mpf((-1) ** k) / (2 * k + 1), 1, 0.09, 20),
    "ASIN": (lambda k: mpmath.binomial(2 * k, k) / mpf(4) ** k / (2 * k + 1), 1, 0.25, 20),
    "LOG": (lambda k: mpf(2) / (2 * k + 1), 1, 0.02945, 20),
    "LOG2_5": (lambda k: 2 / mpmath.log(2) / (2 * k + 1), 2, "0.00348", None),
}
# Other tables: the function, and the ends of the interval whose Chebyshev nodes are taken.
FITTED = {
    "CBRT": (lambda m: 1 / mpmath.cbrt(m), lambda: (mpf(1), mpf(2))),
    "ERF": (lambda z: mpmath.erf(mpmath.sqrt(z)) / mpmath.sqrt(z) - 1, lambda: (0, mpf(9) / 16)),
    "ERF_INV": (lambda v: _erf_inv_factor(v + mpf(25) / 8), lambda: (-mpf(25) / 8, mpf(25) / 8)),
    "ERF_INV_TAIL": (
        lambda v: _erf_inv_factor((6 / (1 - v) - 2) ** 2),
        lambda: (1 - 6 / mpf("4.49"), 1 - 6 / mpf("8.02")),
    ),
    "ERFC": (_erfc_factor, lambda: (1 - 8 / mpf(3.75), 1 - 8 / mpf(31))),
}


def derivation(table):
    """The function that a table approximates, and the nodes for n coefficients."""
    if table in SERIES:
        of, first, length, bits = SERIES[table]
        return series(of, first), lambda n: one_sided(mpf(length), n, bits)
    if table == "EXP":
        return lambda r: (mpmath.expm1(r) - r) / r**2, _exp_nodes
    function, ends = FITTED[table]
    return function, lambda n: chebyshev(*ends(), n)


@pytest.mark.parametrize("table", [*SERIES, *FITTED, "EXP"])
def test_coefficients_are_interpolated(table):
    mine = getattr(tables, table)
    with mpmath.workprec(1500 if table == "ERFC" else 400):
        function, nodes = derivation(table)
        derived = interpolated(function, nodes(len(mine)))
        assert tuple(map(float, derived)) == mine
        if table == "ERFC":
            assert float(derived[0] - mine[0]) == tables.ERFC_0


def is_short(x, bits):
    return Fraction(x).numerator.bit_length() <= bits


def test_parts_and_digits_of_constants():
    """Each constant is the sum of its parts, which are short where products must be exact."""
    with mpmath.workprec(400):
        log_2, half_pi = mpmath.log(2), mpmath.pi / 2
        for parts, whole, bits, correct in [
            (tables.HALF_PI_4, half_pi, 53 - 21, 138),
            (tables.HALF_PI_5, half_pi, 53 - 27, 157),
            (tables.HALF_PI_3, half_pi, 26, 105),
            (tables.PI_2, half_pi, 53, 107),
            (tables.ATAN_HALF, mpmath.atan(mpf(0.5)), 53, 107),
            (tables.LOG_2, log_2, 53 - 11, 94),
            (tables.LOG_2_HEAD, log_2, 26, 78),
            (tables.LOG2_1, 2 / log_2, 53, 105),
            (tables.LOG2_3, 2 / log_2 / 3, 26, 78),
        ]:
            assert abs(mpmath.fsum(parts) - whole) < mpf(2) ** -correct
            assert all(is_short(part, bits) for part in parts[:-1])
        last = mpf(1)
        for begin, centre, high, low in tables.LOG2_CENTRES:
            assert is_short(centre, 8)
            assert (Fraction(high) * 2**40).denominator == 1
            assert abs(mpf(high) + low - mpmath.log(centre, 2)) < mpf(2) ** -93
            assert begin == pytest.approx(float(mpmath.sqrt(last * centre)), abs=5e-4)
            last = mpf(centre)
    zeros, *words = tables.TWO_OVER_PI
    with mpmath.workprec(64 * len(words) + 64):
        digits = int(mpmath.floor(2 / mpmath.pi * mpf(2) ** (64 * len(words))))
    assert zeros == 0
    assert digits == int("".join(f"{word:016x}" for word in words), 16)
