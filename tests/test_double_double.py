"""Pairs of float64 numbers: operations, functions, steps and observables against mpmath."""

import functools
import operator
import time

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from helpers import pendulum

import dvi_jax as dvi
import lanewise
from dvi_jax import systems
from dvi_jax.engine import pair_functions as functions, pairs
from dvi_jax.engine.in_pairs import in_pairs
from dvi_jax.engine.pairs import Pair

RNG = np.random.default_rng(0)
FINAL = dvi.Save(final=True)
KEPLER = systems.kepler()


@pytest.fixture(autouse=True)
def many_digits():
    with mp.workdps(60):
        yield


def coupled(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 * (1 + jnp.sum(q0**2) / 8) + jnp.sum(q0**2) / 2


def drawn(low, high, count=100):
    """Random pairs, evenly by logarithm where the bounds have one sign."""
    if low * high > 0:
        x = np.sign(low) * np.exp(RNG.uniform(*np.log(np.abs([low, high])), count))
    else:
        x = RNG.uniform(low, high, count)
    return Pair(jnp.asarray(x), jnp.asarray(x * 2.0**-54 * RNG.uniform(-1, 1, count)))


def exact(x):
    return [
        mp.mpf(float(a)) + mp.mpf(float(b)) for a, b in zip(x.hi.ravel(), x.lo.ravel(), strict=True)
    ]


def worst(function, reference, *args, by=lanewise.batched):
    """The largest relative error of a function of pairs."""
    out = pairs.as_pair(jax.jit(by(function))(*args))
    true = [reference(*x) for x in zip(*map(exact, args), strict=True)]
    return float(max(abs(a - b) / abs(b) for a, b in zip(exact(out), true, strict=True)))


ONES = (drawn(-3, 3), drawn(-2, 2))
OPERATIONS = {
    "add": (pairs.add, operator.add, ONES),
    "a difference that cancels": (pairs.sub, operator.sub, (drawn(1, 1.1), drawn(1.0001, 1.2))),
    "mul": (pairs.mul, operator.mul, ONES),
    "div": (pairs.div, operator.truediv, ONES),
    "sqrt": (pairs.sqrt, mp.sqrt, (drawn(1e-9, 1e9),)),
    "power": (lambda x: pairs.power(x, -5), lambda x: x**-5, ONES[:1]),
    "sum with a number": (lambda x: pairs.add(x, 0.1), lambda x: x + mp.mpf(0.1), ONES[:1]),
    "times a number": (lambda x: pairs.mul(x, 0.1), lambda x: x * mp.mpf(0.1), ONES[:1]),
    "times two": (lambda x: pairs.mul(x, 2.0), lambda x: x * 2, ONES[:1]),
}
FUNCTIONS = {
    "sin": (lambda x: functions.sin_cos(x)[0], mp.sin, [(-10, 10), (1e-12, 0.1), (1, 1e9)]),
    "cos": (lambda x: functions.sin_cos(x)[1], mp.cos, [(-10, 10), (1, 1e9)]),
    "tan": (functions.tan, mp.tan, [(-1.5, 1.5)]),
    "exp": (functions.exp, mp.exp, [(-20, 20), (-600, 600)]),
    "expm1": (functions.expm1, mp.expm1, [(-5, 5), (1e-12, 1)]),
    "log": (functions.log, mp.log, [(1e-9, 1e9), (0.999, 1.001)]),
    "log1p": (functions.log1p, mp.log1p, [(-0.9, 5), (1e-12, 1)]),
    "exp2": (functions.exp2, lambda x: mp.mpf(2) ** x, [(-20, 20)]),
    "log2": (functions.log2, lambda x: mp.log(x, 2), [(1e-3, 1e3)]),
    "cbrt": (functions.cbrt, mp.cbrt, [(1e-6, 1e6)]),
    "asin": (functions.asin, mp.asin, [(-1, 1)]),
    "acos": (functions.acos, mp.acos, [(-0.99, 0.99)]),
    "atan": (functions.atan, mp.atan, [(-10, 10)]),
    "sinh": (functions.sinh, mp.sinh, [(-3, 3), (1e-9, 1)]),
    "cosh": (functions.cosh, mp.cosh, [(-3, 3)]),
    "tanh": (functions.tanh, mp.tanh, [(-5, 5), (1e-9, 1), (30, 50)]),
    "asinh": (functions.asinh, mp.asinh, [(-5, 5)]),
    "acosh": (functions.acosh, mp.acosh, [(1.01, 5)]),
    "atanh": (functions.atanh, mp.atanh, [(-0.95, 0.95)]),
    "logistic": (functions.logistic, lambda x: 1 / (1 + mp.exp(-x)), [(-5, 5)]),
    "x^-1.5": (lambda x: functions.root_power(x, -3), lambda x: x ** mp.mpf(-1.5), [(0.1, 9)]),
}


@pytest.mark.parametrize("name", OPERATIONS)
@pytest.mark.parametrize(
    "by",
    [lanewise.batched, pytest.param(jax.vmap, marks=pytest.mark.slow)],
    ids=["machine code", "XLA"],
)
def test_operations_have_31_digits(name, by):
    """Contraction of a product with a sum would leave 16. The control leaves out the lower part."""
    function, reference, args = OPERATIONS[name]
    assert worst(function, reference, *args, by=by) < 1e-30
    plain = worst(lambda *x: function(*pairs.rounded(x)), reference, *args, by=by)
    assert plain > 1e-18


SLOW_METHODS = dvi.KahanLi(8), dvi.GaussLegendre(2), dvi.LobattoIIIAIIIB(3), dvi.GaussLegendre(8)
QUICK = ("sin", "expm1", "log", "atan", "tanh", "x^-1.5")


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in FUNCTIONS]
)
def test_functions_have_30_digits(name):
    function, reference, ranges = FUNCTIONS[name]
    for low, high in ranges:
        assert worst(function, reference, drawn(low, high)) < 5e-31, (low, high)


EXTREMES = {
    "sin": [(1e9, 1e12), (1e12, 3.5e13)],
    "tan": [(1e9, 3.5e13)],
    "log": [(1e300, 1e308), (1e-306, 1e-290), (1e100, 1e200)],
    "log2": [(1e300, 1e308)],
    "log1p": [(1e300, 1e308)],
    "cbrt": [(1e290, 1e308), (1e-306, 1e-80)],
}


@pytest.mark.parametrize(
    "name", [n if n == "log" else pytest.param(n, marks=pytest.mark.slow) for n in EXTREMES]
)
def test_functions_of_large_and_small_numbers(name):
    """Digits next to the limits of float64 (the cube root of XLA has an error of 1e-14)."""
    function, reference, _ = FUNCTIONS[name]
    for low, high in EXTREMES[name]:
        x = Pair(drawn(low, high).hi, jnp.zeros(100))
        assert worst(function, reference, x, by=jax.vmap) < (1e-27 if name == "cbrt" else 1e-30)


@pytest.mark.slow
def test_powers_of_large_and_small_and_negative_numbers():
    third = Pair(jnp.full(100, 0.3), jnp.zeros(100))
    for low, high in ((1e300, 1e308), (1e-306, 1e-290)):
        x = Pair(drawn(low, high).hi, jnp.zeros(100))
        assert worst(functions.general_power, lambda x, y: x**y, x, third, by=jax.vmap) < 1e-29
    cube = functions.general_power(Pair(-2 - jnp.ones(1) / 3, jnp.zeros(1)), jnp.asarray(3.0))
    exact_cube = mp.mpf(float(-2 - 1 / 3)) ** 3
    assert abs(exact(cube)[0] / exact_cube - 1) < 1e-29


@pytest.mark.parametrize("size", [4e13, 1e16, 1e25, 1e300])
def test_angles_without_digits_are_nan(size):
    """No number of a wrong size: of |x| > 2⁴⁵ the functions of an angle are NaN."""
    x = Pair(jnp.array([size, -size]), jnp.zeros(2))
    for value in (*functions.sin_cos(x), functions.tan(x)):
        assert np.isnan(value.hi).all()


def test_products_in_xla_and_functions_of_two_pairs():
    assert worst(pairs.mul, operator.mul, *ONES, by=jax.vmap) < 1e-30
    x, y = drawn(-3, 3), drawn(-2, 2)
    assert worst(functions.atan2, mp.atan2, x, y) < 1e-30
    assert worst(functions.general_power, lambda x, y: x**y, drawn(0.1, 10), y) < 1e-30


@pytest.mark.slow
def test_special_values_are_those_of_float64():
    x = jnp.array([0.0, jnp.inf, jnp.nan, -jnp.inf])
    for ours, plain in (
        (functions.exp, jnp.exp),
        (functions.log, jnp.log),
        (functions.expm1, jnp.expm1),
    ):
        np.testing.assert_array_equal(ours(x).hi, plain(x))
    np.testing.assert_array_equal(pairs.sqrt(x[:2]).hi, x[:2])
    assert functions.atan2(jnp.zeros(1), jnp.zeros(1)).hi == 0


def of_arrays(x):
    """Structure: products of matrices, indices, loops, branches, solves, comparisons."""
    A = jnp.outer(x, jnp.sin(x)) + 3 * jnp.eye(4)
    at = jnp.array([0, 2, 2, 1])
    moved = jnp.zeros(4).at[at].add(x / 3) + jnp.roll(x, 1) * x[at]
    total, sums = jax.lax.scan(lambda c, y: (c + y / 7, c * y), 1.0, x)
    least = jax.lax.while_loop(lambda c: c > 0.1, lambda c: c / 3, total)
    chosen = jax.lax.cond(x[0] > 0, lambda y: y / 3, lambda y: y * 3, least)
    ends = jnp.stack([jnp.max(x), jnp.min(x), chosen, jnp.mod(10 * x[1], 1.0)])
    return A @ moved + lanewise.solve(A, x) + jnp.cumsum(sums) + jnp.floor(3 * x) + ends


@pytest.mark.slow
def test_arrays_loops_and_solves_have_30_digits():
    """Against the same function of float64 numbers with half as many digits in each."""
    x = jnp.array([0.7, -1.3, 0.2, 1.1])
    found = np.array(exact(jax.jit(functools.partial(in_pairs, of_arrays))(x)))

    def outer(x):
        A = mp.matrix(4, 4)
        for i in range(4):
            for j in range(4):
                A[i, j] = x[i] * mp.sin(x[j]) + (3 if i == j else 0)
        return A

    z = [mp.mpf(float(y)) for y in x]
    A, at = outer(z), [0, 2, 2, 1]
    moved = [z[i - 1] * z[at[i]] for i in range(4)]
    for i, k in enumerate(at):
        moved[k] += z[i] / 3
    c, sums = mp.mpf(1), []
    for y in z:
        sums.append(c * y)
        c += y / 7
    while c > mp.mpf(0.1):
        c /= 3
    ends = [max(z), min(z), c / 3, (10 * z[1]) % 1]
    first, solved = A * mp.matrix(moved), mp.lu_solve(A, mp.matrix(z))
    true = [
        first[i] + solved[i] + sum(sums[: i + 1]) + mp.floor(3 * z[i]) + ends[i] for i in range(4)
    ]
    assert max(abs(a - b) for a, b in zip(found, true, strict=True)) < 1e-29
    plain = np.asarray(of_arrays(x))
    assert max(abs(mp.mpf(float(a)) - b) for a, b in zip(plain, true, strict=True)) > 1e-17


def strang(q, p, h, num_steps):
    for _ in range(num_steps):
        p -= h / 2 * mp.sin(q)
        q += h * p
        p -= h / 2 * mp.sin(q)
    return q, p


def gauss(q, p, h, num_steps):
    r = mp.sqrt(3) / 6
    a, half = [[mp.mpf(1) / 4, mp.mpf(1) / 4 - r], [mp.mpf(1) / 4 + r, mp.mpf(1) / 4]], h / 2
    rates = [(p, -mp.sin(q))] * 2
    for _ in range(num_steps):
        change = mp.mpf(1)
        while change > mp.mpf(10) ** -38:
            at = [[z + h * (x * k + y * m) for z, k, m in zip((q, p), *rates, strict=True)]
                  for x, y in a]  # fmt: skip
            new = [(P, -mp.sin(Q)) for Q, P in at]
            change = max(abs(new[i][j] - rates[i][j]) for i in (0, 1) for j in (0, 1))
            rates = new
        q, p = (z + half * (k + m) for z, k, m in zip((q, p), *rates, strict=True))
    return q, p


RUNS = {
    "Strang": (dvi.Strang(), strang, 1000, dvi.Newton()),
    "GaussLegendre": (dvi.GaussLegendre(2), gauss, 200, dvi.Newton()),
    "Picard": (dvi.GaussLegendre(2), gauss, 200, dvi.Picard()),
}


@pytest.mark.parametrize(
    "name",
    ["Strang", *(pytest.param(n, marks=pytest.mark.slow) for n in list(RUNS)[1:])],
)
def test_a_run_agrees_with_many_digits(name):
    """Observables are of the pairs, so that they show the lower part of the last state."""
    method, reference, num_steps, newton = RUNS[name]
    h = mp.mpf(1) / 8
    true = reference(mp.mpf(1), mp.mpf(1) / 2, h, num_steps)
    near = [float(x) for x in true]
    rest = dvi.Last(lambda q, p: jnp.concatenate([q, p]) - jnp.array(near))

    def errors(arithmetic):
        how = {"h": float(h), "num_steps": num_steps, "method": method, "newton": newton}
        how |= {"observe": rest, "save": FINAL, "arithmetic": arithmetic}
        sol = dvi.integrate(dvi.System(pendulum), [1.0], [0.5], **how)
        assert sol.status == "successful"
        pairs_of = zip(sol.observed, near, true, strict=True)
        return float(max(abs(mp.mpf(float(r)) + mp.mpf(x) - y) for r, x, y in pairs_of))

    assert errors(dvi.DoubleDouble()) < 1e-28
    assert errors(dvi.FloatingPoint()) > 1e-16


@pytest.mark.parametrize(
    "method",
    [dvi.Strang(), *(pytest.param(method, marks=pytest.mark.slow) for method in SLOW_METHODS)],
    ids=repr,
)
def test_an_exact_invariant_has_no_drift(method):
    """Angular momentum, which every one of these methods conserves."""

    def drift(arithmetic, method=method):
        sol = dvi.integrate(
            KEPLER.system, KEPLER.q0, KEPLER.p0, args=KEPLER.args, h=0.1, num_steps=200,
            epsilon=0.0, method=method, arithmetic=arithmetic, save=FINAL,
            observe=dvi.MaxDrift(KEPLER.observables["angular_momentum"]),
        )  # fmt: skip
        return sol.observed

    assert drift(dvi.DoubleDouble()) < 1e-29
    assert drift(dvi.FloatingPoint()) > 1e-17
    if isinstance(method, dvi.Strang):  # a drift that is there is measured
        assert 1e-8 < drift(dvi.DoubleDouble(), dvi.RungeKutta4()) < 1e-4


def test_the_invariant_of_a_quadratic_map():
    """x² + y² + h x y of the map of the oscillator, over 10⁴ steps."""
    h = 2.0**-3
    system = dvi.System(lambda t0, t1, q0, p1, args: jnp.sum(p1**2 + q0**2) / 2)

    def drift(arithmetic):
        invariant = dvi.MaxDrift(lambda q, p: (q**2 + p**2 - h * q * p)[0])
        how = {"h": h, "num_steps": 10_000, "method": dvi.TypeII(), "save": FINAL}
        how |= {"observe": invariant, "arithmetic": arithmetic}
        return dvi.integrate(system, [0.3], [0.7], **how).observed

    assert drift(dvi.DoubleDouble()) < 1e-27
    assert drift(dvi.FloatingPoint()) > 1e-15


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvi.Strang(), dvi.GaussLegendre(2)], ids=repr)
def test_a_batch_has_the_bits_of_single_runs(method):
    def one(q, p):
        sol = dvi.integrate(
            dvi.System(coupled), q, p, h=0.1, num_steps=30, method=method, save=FINAL,
            arithmetic=dvi.DoubleDouble(), observe=dvi.Last(lambda q, p: q - 0.25),
        )  # fmt: skip
        return sol.qs[-1], sol.ps[-1], sol.observed

    q, p = jnp.linspace(0.3, 0.9, 5)[:, None], jnp.full((5, 1), 0.4)
    batch, single = jax.jit(jax.vmap(one))(q, p), jax.jit(one)
    for i in (0, 4):
        for a, b in zip(batch, single(q[i], p[i]), strict=True):
            np.testing.assert_array_equal(a[i], b)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method", "most"),
    [
        ("pendulum", dvi.Strang(), 25),
        ("kepler", dvi.Strang(), 25),
        # Most of this step in float64 is fused multiply-adds, which take 25 operations in pairs:
        # 17 to 21 on one kind of processor, 32 to 38 on another (the same commit on both).
        ("henon_heiles", dvi.Strang(), 45),
        ("kepler", dvi.GaussLegendre(2), 25),
    ],
)
def test_cost_of_a_step(name, method, most):
    """In a batch, relative to float64: the least of some runs of each, in turn."""
    problem = systems.LIBRARY[name]()

    def program(arithmetic):
        def one(q):
            how = {"args": problem.args, "h": 1e-3, "num_steps": 5000, "epsilon": 0.0}
            how |= {"method": method, "arithmetic": arithmetic, "save": FINAL}
            return dvi.integrate(problem.system, q, problem.p0, **how).qs[-1]

        return jax.jit(jax.vmap(one))

    q = jnp.linspace(0.9, 1.1, 256)[:, None] * jnp.asarray(problem.q0)[None]
    programs = [program(dvi.DoubleDouble()), program(dvi.FloatingPoint())]
    times: list[list[float]] = [[], []]
    for _ in range(6):  # the first run compiles
        for run, seconds in zip(programs, times, strict=True):
            before = time.process_time()
            run(q).block_until_ready()
            seconds.append(time.process_time() - before)
    pairs, floats = (min(seconds[1:]) for seconds in times)
    ratio = pairs / floats
    print(f"{name}, {method!r}: a step in pairs takes {ratio:.1f} times as long")
    assert 2 < ratio < most


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [dvi.Reversible(), dvi.Checkpointed(), dvi.Direct()], ids=repr)
@pytest.mark.parametrize("method", [dvi.TypeII(), dvi.Strang()], ids=repr)
def test_gradients_are_those_of_float64(adjoint, method):
    system = dvi.System(coupled, force=lambda t0, t1, q0, p1, args: -(q0**3) * jnp.cos(t1))

    def loss(x, arithmetic):
        sol = dvi.integrate(
            system, x[:1], x[1:2], h=x[2], epsilon=x[3], num_steps=23, method=method,
            arithmetic=arithmetic, adjoint=adjoint, save=dvi.Save(every=10, final=True),
            observe={"drift": dvi.MaxDrift(lambda q, p: q[0] ** 2 + p[0])},
        )  # fmt: skip
        return jnp.sum(sol.qs**3) + sol.observed["drift"]

    x = jnp.array([0.3, 0.4, 0.1, 0.2])
    plain, ours = (
        jax.jit(jax.grad(functools.partial(loss, arithmetic=a)))(x)
        for a in (dvi.FloatingPoint(), dvi.DoubleDouble())
    )
    assert np.min(np.abs(plain)) > 1e-3
    np.testing.assert_allclose(ours, plain, rtol=1e-12)
    if isinstance(adjoint, dvi.Direct):
        forward = jax.jit(jax.jacfwd(functools.partial(loss, arithmetic=dvi.DoubleDouble())))(x)
        np.testing.assert_allclose(forward, plain, rtol=1e-12)


def test_constants_have_the_digits_of_the_operations_that_make_them():
    x = jnp.ones(1)
    (third,) = exact(in_pairs(lambda x: x * (jnp.asarray(1.0) / 3), x))
    (rounded,) = exact(in_pairs(lambda x: x * (1 / 3), x))
    assert abs(third - mp.mpf(1) / 3) < 1e-31
    assert rounded == mp.mpf(1 / 3)


@pytest.mark.slow
def test_the_derivative_of_a_function_in_pairs_is_that_of_float64():
    def plain(x):
        return jnp.sin(x) / (1 + x**2)

    x = jnp.array([0.3, 2.0])
    expected = jax.grad(lambda x: jnp.sum(plain(x)))(x)
    for derivative in (jax.grad, jax.jacfwd):
        found = derivative(lambda x: jnp.sum(in_pairs(plain, x).hi))(x)
        np.testing.assert_allclose(found, expected, rtol=1e-14)


@pytest.mark.slow
def test_other_parts_of_a_run_accept_pairs():
    """Sections, running values, deviation vectors, a Stop and pieces, as in float64."""
    L = KEPLER.observables["angular_momentum"]
    observe = {
        "section": dvi.Section(lambda t, q, p, args: q[1], 0, max_crossings=3),
        "running": dvi.Running(dvi.MaxDrift(L)),
        "trend": dvi.Trend(KEPLER.observables["energy"]),
        "lyapunov": dvi.LyapunovSpectrum(2),
    }
    stop = dvi.Stop(lambda t, q, p, args: t - 3.55)

    def run(arithmetic, **more):
        return dvi.integrate(
            KEPLER.system, KEPLER.q0, KEPLER.p0, args=KEPLER.args, h=0.1, num_steps=60,
            epsilon=0.0, method=dvi.Strang(), arithmetic=arithmetic, save=dvi.Save(every=10),
            **more,
        )  # fmt: skip

    plain, ours = (run(a, observe=observe) for a in (dvi.FloatingPoint(), dvi.DoubleDouble()))
    for a, b in zip(jax.tree.leaves(plain.observed), jax.tree.leaves(ours.observed), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
    assert np.max(ours.observed["running"]) < 1e-30
    assert run(dvi.DoubleDouble(), stop=stop).status == "stopped"
    pieces = run(dvi.DoubleDouble(), progress=lambda done, of: None)
    np.testing.assert_array_equal(pieces.qs, ours.qs)


def test_what_has_no_rule_is_an_error():
    def run(H, q0=(0.1,)):
        how = {"h": 0.1, "num_steps": 2, "arithmetic": dvi.DoubleDouble()}
        return dvi.integrate(dvi.System(H), q0, np.ones_like(q0), **how)

    with pytest.raises(ValueError, match="float64, got float32"):
        run(pendulum, np.array([0.1], np.float32))
    with pytest.raises(NotImplementedError, match="erf"):
        run(lambda t0, t1, q, p, args: jnp.sum(p**2) / 2 + jnp.sum(jax.scipy.special.erf(q)))


@pytest.mark.parametrize(("wrong_by", "converged"), [(0.0, True), (1e-4, False)])
def test_a_root_with_too_few_digits_has_not_converged(wrong_by, converged):
    """The cube root of 2; with a wrong derivative corrections shrink by that factor only."""

    def divide(linear, rhs):
        return rhs / linear(jnp.ones_like(rhs)) * (1 + wrong_by)

    def solve(F, x):
        for _ in range(6):
            x = x - F(x) / (3 * x**2)
        return x, jnp.asarray(True)

    def root(two):
        return lanewise.implicit_root(lambda x: x**3 - two, jnp.ones(1), solve, divide)

    x, good = jax.jit(functools.partial(in_pairs, root))(jnp.full(1, 2.0))
    assert good == converged
    assert (abs(exact(x)[0] - mp.cbrt(2)) < 1e-31) == converged
