"""Component form: the numbers of the arrays, lane by lane, and nothing of the neighbours."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import covering
from hypothesis import given, settings, strategies as st
from jax import lax

import dvi_jax as dvi
from dvi_jax._compat import jaxpr_as_fun, without_outputs
from dvi_jax.engine.lanes import evaluate, in_arrays, operation_count
from dvi_jax.engine.linear import solve_near_identity, unit_vectors
from dvi_jax.engine.together import least_over_lanes, on_any_lane

LANES = 5


def in_components(function, lanes, *args, replacements=None):
    """The function by components, its arguments with lanes in front (or without: None)."""
    on = lanes is not None
    one = [a[0] for a in args] if on else args
    closed = jax.make_jaxpr(function)(*one)

    def run(*args):
        args = [jnp.moveaxis(a, 0, -1) for a in args] if on else args
        outs = []
        for value in evaluate(closed, args, [on] * len(args), lanes, replacements):
            array, has_lanes = value.array()
            if on and not has_lanes:
                array = jnp.broadcast_to(jnp.asarray(array)[..., None], (*value.shape, lanes))
            outs.append(jnp.moveaxis(array, -1, 0) if on else jnp.asarray(array))
        return outs

    return run, jax.make_jaxpr(run)(*args)


def check(function, *args, rtol=1e-13):
    """By components on many lanes, and on one, against vmap."""
    expected = jax.tree.leaves(jax.jit(jax.vmap(function))(*args))
    run, _ = in_components(function, len(args[0]), *args)
    for a, b in zip(jax.jit(run)(*args), expected, strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)
    alone = [a[1] for a in args]
    run, _ = in_components(function, None, *alone)
    for a, b in zip(jax.jit(run)(*alone), expected, strict=True):
        np.testing.assert_allclose(a, b[1], rtol=rtol, atol=rtol)


def numbers(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(LANES, *shape)))


def chain(q):
    return jnp.sum(jnp.diff(jnp.pad(q, 1)) ** 2 / 2 + jnp.diff(jnp.pad(q, 1)) ** 4 / 4)


FUNCTIONS = {
    "indexing": lambda x: (x[-1], x[1:], x[::2], x[::-1], x[jnp.array([0, 2, -1])]),
    "a traced index": lambda x: x[jnp.argmax(x)],
    "updates": lambda x: x.at[1].set(3.0).at[0].add(x[2]).at[jnp.array([0, 2])].mul(2.0),
    "reductions": lambda x: (x.sum(), x.prod(), x.max(), x.min(), x.mean(), (x > 0).any()),
    "running": lambda x: (jnp.cumsum(x), jnp.cumprod(x), lax.cummax(x, reverse=True)),
    "products": lambda x: (x @ x, jnp.outer(x, x) @ x, jnp.einsum("i,j,k->j", x, x, x)),
    "norm": lambda x: jnp.linalg.norm(x) ** -3 * x,
    "where": lambda x: jnp.where(x > 0, x, jnp.sqrt(-x)) + jnp.clip(x, -0.5, 0.5),
    "shapes": lambda x: jnp.stack([x, 2 * x]).T.reshape(-1)[1:4] + jnp.roll(x, 1),
    "concatenate": lambda x: jnp.concatenate([x, jnp.zeros(2), x[:1]]),
    "padding": lambda x: (jnp.pad(x, 2), lax.pad(x, 0.0, [(1, -2, 2)])),
    "elementary": lambda x: (jnp.sin(x) * jnp.exp(-(x**2)), jnp.arctan2(x, 2 + x[0])),
    "powers": lambda x: (x**3, jnp.abs(x) ** 1.5, (x**2 + 1) ** -2),
    "integers": lambda x: x * jnp.arange(3) + (x > 0) + jnp.floor(x).astype(int),
    "a known table": lambda x: jnp.interp(x, jnp.linspace(-3, 3, 30), jnp.linspace(-3, 3, 30) ** 2),
    "sorting": lambda x: (jnp.sort(x), jnp.argsort(x), jnp.median(x)),
    "solving": lambda x: jnp.linalg.solve(4 * jnp.eye(3) + jnp.outer(x, x), x),
    "gradient": jax.grad(chain),
    "second derivative": jax.hessian(lambda x: chain(x) + x[0] * x[1] * jnp.sin(x[2])),
    "scan": lambda x: lax.scan(lambda c, y: (0.9 * c + y, c), x, jnp.arange(4.0)),
    "scan over what varies": lambda x: lax.scan(lambda c, y: (c * y, c + y), 1.0, x),
    "scan of scans": lambda x: lax.scan(
        lambda c, _: lax.scan(lambda c, _: (0.9 * c, c), c, None, 2), x, None, 3
    ),
    "what scans leave": lambda x: (
        lax.scan(lambda c, _: (0.9 * c, c), x, None, 4)[1][::-1].sum(0) * x
    ),
    "while": lambda x: lax.while_loop(lambda c: jnp.sum(c**2) < 10, lambda c: 1.5 * c, x),
    "while together": lambda x: lax.fori_loop(0, 3, lambda i, c: c + i * x[i], x),
    "whiles, each to its own end": jax.vmap(
        lambda x: lax.while_loop(
            lambda c: c[0] < 9, lambda c: (c[0] * 1.5 + 0.1, c[1] + c[0]), (x**2, x)
        )
    ),
    "whiles of vectors": lambda x: jax.vmap(
        lambda s: lax.while_loop(lambda c: c[0].max() < 3, lambda c: (c[0] + x**2 + s, s), (x, s))
    )(jnp.linspace(0.1, 2.0, 33)),
    "whiles of large arrays": lambda x: jax.vmap(
        lambda s: lax.while_loop(
            lambda c: c.max() < 3, lambda c: c + x[0] ** 2 + s, s + jnp.ones(9)
        )
    )(jnp.linspace(0.1, 2.0, 150)),
    "whiles of what does not vary": lambda x: (
        x
        * jax.vmap(lambda s: lax.while_loop(lambda c: c < 3, lambda c: c + s, s))(
            jnp.array([0.1, 0.4, 2.0])
        )
    ),
    "cond": lambda x: lax.cond(x[0] > 0, lambda x: x, lambda x: x**2, x),
    "cond together": lambda x: lax.cond(jnp.sum(jnp.ones(2)) > 1, lambda x: x, lambda x: x**2, x),
    "jit, custom rules, checkpoint": jax.checkpoint(jax.jit(jax.nn.softplus)),
    "two lengths": lambda x: (x[:0], jnp.sum(x[:0]), jnp.ones(200) * x[0]),
    "what does not vary": lambda x: (jnp.arange(3.0), jnp.ones((2, 2)), x),
}


def rows(x, count=4):
    """What a scan puts out, of shape (count, *x.shape)."""
    return lax.scan(lambda c, _: (0.9 * c, c), x, None, count)[1]


def grown(x):
    """Half as large again, until it is large."""
    return lax.while_loop(lambda c: jnp.sum(c**2) < 10, lambda c: 1.5 * c, x)


FUNCTIONS |= {
    "rows carried by a loop": lambda x: grown(rows(x)),
    "rows of rows carried": lambda x: grown(rows(rows(x)[0])) * lax.map(grown, rows(x)),
    "rows, each to its own end": lambda x: jax.vmap(grown)(rows(x)),
    "rows of rows, each to its own end": lambda x: (
        jax.vmap(jax.vmap(grown))(rows(jnp.outer(x, x))),
        jax.vmap(jax.vmap(grown))(rows(lax.map(jnp.sin, rows(x)))),
    ),
    "rows mixed with others": lambda x: lax.while_loop(
        lambda c: jnp.sum(c[0] ** 2) < 10, lambda c: (1.5 * c[0], c[1] + 1), (x, rows(x))
    ),
    "rows that a loop replaces": lambda x: lax.while_loop(
        lambda c: jnp.sum(c[0] ** 2) < 10, lambda c: (1.5 * c[0], rows(c[0])[::-1]), (x, rows(x))
    ),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_operations(name):
    check(FUNCTIONS[name], numbers(3))


def test_matrices():
    A, x = numbers(3, 3), numbers(3, seed=1)
    check(lambda A, x: jnp.tensordot(A, A, 2) * x + A @ x + jnp.trace(A), A, x)
    check(lambda A, x: jnp.sum(A[:, None, :] * A[None], (0, 1)) + jnp.diag(A), A, x)
    check(lambda A, x: jax.vmap(jnp.dot)(A, A) * x, A, x)


UNARY = (jnp.sin, jnp.tanh, jnp.exp, lambda x: x**2, lambda x: jnp.sqrt(1 + x**2), jnp.negative)
BINARY = (jnp.add, jnp.subtract, jnp.multiply, lambda x, y: x / (2 + y**2), jnp.maximum)
MOVES = (
    lambda x: x[::-1],
    jnp.cumsum,
    lambda x: jnp.roll(x, 1),
    lambda x: x - jnp.mean(x),
    lambda x: jnp.where(x > 0.3, x, 0.3),
    lambda x: x * jnp.linalg.norm(x),
    lambda x: jnp.concatenate([x[1:], x[:1] * x[-1]]),
)
STEPS = st.tuples(st.integers(0, 20), st.integers(0, 20), st.integers(0, 20))


def random_function(program):
    """A function made of the steps drawn: each takes two of the values so far."""

    def function(x):
        values = [x, x / 2]
        for kind, i, j in program:
            a, b = values[i % len(values)], values[j % len(values)]
            table = (UNARY, BINARY, MOVES)[kind % 3]
            new = table[(i + j + kind) % len(table)](*((a, b) if table is BINARY else (a,)))
            values.append(jnp.tanh(new))
        return jnp.sum(values[-1] * values[len(values) // 2])

    return function


@settings(max_examples=5, deadline=None, derandomize=True)
@given(program=st.lists(STEPS, min_size=1, max_size=6), n=st.integers(1, 4))
@pytest.mark.slow
def test_random_functions(program, n):
    f = random_function(program)
    check(lambda x: (f(x), jax.grad(f)(x)), numbers(n), rtol=1e-12)


@pytest.mark.slow
@settings(max_examples=15, deadline=None, derandomize=True)
@given(program=st.lists(STEPS, min_size=1, max_size=8), n=st.integers(1, 4))
def test_random_functions_and_their_second_derivatives(program, n):
    f = random_function(program)
    check(lambda x: (f(x), jax.grad(f)(x), jax.hessian(f)(x)), numbers(n), rtol=1e-11)


# --- structure -------------------------------------------------------------------------------


def primitives(jaxpr, name):
    return sum(eqn.primitive.name == name for eqn in jaxpr.jaxpr.eqns)


def newton_step(force):
    def step(x):
        _, push = jax.linearize(lambda x: x - 0.1 * force(x), x)
        matrix = jax.vmap(push, out_axes=1)(unit_vectors(x.size, x.dtype))
        return matrix, solve_near_identity(matrix, x)

    return step


@pytest.mark.slow
def test_band_of_a_jacobian_is_found():
    """A chain's Jacobian is tridiagonal: elimination costs O(n), and gives the solution."""
    band = newton_step(jax.grad(chain))
    dense = newton_step(jax.grad(lambda x: chain(x) + jnp.sum(x) ** 3))
    counts = []
    for n in (8, 16):
        x = 0.3 * numbers(n)
        run, jaxpr = in_components(lambda x: band(x)[1], LANES, x)
        counts.append(primitives(jaxpr, "sub"))
        matrix = jax.vmap(lambda x: band(x)[0])(x)
        expected = np.linalg.solve(matrix, x[..., None])[..., 0]
        np.testing.assert_allclose(jax.jit(run)(x)[0], expected, rtol=1e-12)
        _, full = in_components(lambda x: dense(x)[1], LANES, x)
        assert primitives(full, "sub") > n**3 / 4 > counts[-1]
    assert counts[1] < 2.6 * counts[0]


def test_a_zero_that_is_a_number_still_meets_nan():
    """Only zeros by structure are left out: 0 · NaN of the user's stays NaN."""
    run, _ = in_components(lambda x: 0.0 * x, LANES, numbers(2))
    assert np.isnan(run(jnp.full((LANES, 2), jnp.nan))[0]).all()


def test_structural_operations_vanish():
    _, jaxpr = in_components(jax.grad(chain), LANES, numbers(6))
    names = {e.primitive.name for e in jaxpr.jaxpr.eqns}
    assert not names & {"pad", "dot_general", "gather", "scatter-add", "reduce_sum"}


def reciprocals(x):
    def body(_, c):
        return c + 0.5 / x + c**-2

    return 0.5 / x, x**-2, -1 / x, x**-1, x**-3, lax.fori_loop(0, 3, body, x), 4 / x, 3 / x, 1 / x


def test_a_reciprocal_is_computed_once():
    """Where its use is exact or a power; within a loop anew, and none of the loop's outside."""
    check(reciprocals, numbers(), rtol=4 * np.finfo(float).eps)
    _, jaxpr = in_components(reciprocals, LANES, numbers())
    assert primitives(jaxpr, "div") == 2  # 1/x and 3/x
    assert str(jaxpr).count("= div") == 2 + 2


def multiples(x, s):
    """Several times −x, in products one after the other and in sums, with s the same on all."""
    pull = -x + s * -x
    sums = 0.1 * pull, pull + pull, x + 3 * x, pull + 2.0 * x, lax.neg(-x), x @ (2 * x)
    loop = lax.fori_loop(0, 3, lambda _, c: c + 0.1 * (-x - x), x)
    return *sums, loop, (2.0 * x) * x, s * (s * x), 1e-200 * (1e200 * (1e200 * (1e-300 * x))), x + x


def test_multiples_of_a_number_are_one_product():
    few_ulp = 4 * np.finfo(float).eps
    check(multiples, numbers(2), numbers(seed=1), rtol=few_ulp)
    check(lambda x: multiples(x, 0.7), numbers(2), rtol=few_ulp)

    def step(x, y):  # by a quadratic energy, and a weak force of its kind
        pull = -x + 1e-4 * -x
        return y + 0.1 * pull

    _, jaxpr = in_components(step, LANES, numbers(1), numbers(1))
    used = re.findall(r"^ *[a-z]+:f64\[5\] = (\w+)", str(jaxpr), re.MULTILINE)
    assert [name for name in used if name in ("mul", "neg", "add")] == ["mul", "add"]


def test_large_arrays_are_not_taken_apart():
    _, jaxpr = in_components(lambda x: jnp.sum(jnp.sin(x) ** 2), LANES, numbers(5000))
    assert len(jaxpr.jaxpr.eqns) < 20


def test_rows_that_a_loop_carries_are_not_taken_apart():
    """Their program is as long for 100 rows as for 10, where they had become 100 numbers each."""

    def carried(x, count):
        begin = jnp.sum(x), rows(x, count)
        return lax.while_loop(lambda c: c[0] < 9, lambda c: (c[0] * 2, jnp.flip(c[1])), begin)

    for lanes, x in ((LANES, numbers(2)), (None, numbers(2)[0])):
        few, many = (
            in_components(functools.partial(carried, count=n), lanes, x)[1] for n in (10, 100)
        )
        assert str(few).count("\n") == str(many).count("\n") < 100


def test_a_long_loop_over_a_single_number():
    """The compiler would give its body to threads, which there are none of inside of a function."""

    def body(x, _):
        for _ in range(6):
            x = x + 0.1 * (1 + 1e-4 * x) * (1 - 1e-3 * x**2)
        return x, None

    x = jnp.linspace(0.1, 0.2, 2048)
    run, _ = in_components(lambda x: lax.scan(body, x, None, 25)[0], 2048, x)
    np.testing.assert_allclose(jax.jit(run)(x)[0], lax.scan(body, x, None, 25)[0], rtol=1e-12)


@pytest.mark.parametrize(
    ("used", "carried"), [("01000", 2), ("00100", 3), ("10001", 2), ("00010", 2), ("00000", 0)]
)
def test_a_loop_carries_what_is_asked_for(used, carried):
    """Its other outputs are not, unless the test or one of those needs them."""

    def loop(x, y):
        def body(state):
            k, a, b, c, d = state
            return k + 1, a * x, b + a * y, c + 1, jnp.sin(d)

        return lax.while_loop(lambda state: state[0] < 3 + x, body, (0.0, x, y, x, y))

    used = [u == "1" for u in used]
    less = without_outputs(jax.make_jaxpr(loop)(2.0, 3.0), used)
    loops = [e for e in less.jaxpr.eqns if e.primitive.name == "while"]
    assert sum(len(e.outvars) for e in loops) == carried
    wanted = [v for v, u in zip(loop(2.0, 3.0), used, strict=True) if u]
    assert jaxpr_as_fun(less)(2.0, 3.0) == wanted


def test_operation_count_grows_with_what_is_written():
    def pairs(x):
        return jnp.sum(1 / (1 + (x[:, None] - x[None]) ** 2))

    few, many = (
        operation_count(jax.make_jaxpr(jax.grad(pairs))(jnp.ones(n)).jaxpr) for n in (10, 100)
    )
    assert 100 < few < 2000
    assert 80 * few < many < 120 * few


def test_replacements_are_called_on_lanes():
    seen = []

    def sine(x):
        seen.append(x.shape)
        return 2 * x

    run, _ = in_components(jnp.sin, LANES, numbers(2), replacements={"sin": sine})
    np.testing.assert_array_equal(run(numbers(2))[0], 2 * numbers(2))
    assert set(seen) == {(LANES,)}


def test_what_is_left_in_arrays():
    check(in_arrays(lambda x: (x[::-1] * 2, jnp.sum(x))), numbers(3))
    _, jaxpr = in_components(in_arrays(jnp.sin), LANES, numbers(30))
    assert len(jaxpr.jaxpr.eqns) < 40


def test_lanes_agree():
    x = jnp.array([5, 3, 4])
    assert (jax.vmap(least_over_lanes)(x) == 3).all()
    assert least_over_lanes(x[0]) == 5
    run, _ = in_components(lambda x: (least_over_lanes(x), on_any_lane(x > 4)), 3, x)
    least, there = run(x)
    assert (least == 3).all()
    assert there.all()
    run, _ = in_components(lambda x: on_any_lane(x > 5), 3, x)
    assert not run(x)[0].any()


# --- trajectories ----------------------------------------------------------------------------

COMPONENTS, ARRAYS = dvi.Layout(form="components"), dvi.Layout(form="arrays")
KEPLER = dvi.System(
    lambda t0, t1, q0, p1, args: p1 @ p1 / 2 - 1 / jnp.linalg.norm(q0),
    force=lambda t0, t1, q0, p1, args: -q0 - args * p1 * jnp.cos(t0),
)
COUPLED = dvi.System(
    lambda t0, t1, q0, p1, args: (1 + q0 @ q0) * (1 + p1 @ p1) / 2 + q0[0] * p1[1],
    force=lambda t0, t1, q0, p1, args: -args * p1 * jnp.cos(t0),
)
SYSTEMS = {"kepler": KEPLER, "coupled": COUPLED}
WATCH = {
    "drift": dvi.MaxDrift(lambda t0, t1, q0, p0, q1, p1, a: p1 @ p1 / 2),
    "trend": dvi.Trend(lambda t0, t1, q0, p0, q1, p1, a: q1),
    "step": lambda t0, t1, q0, p0, q1, p1, a: q0 * p1,
}
SAVES = {
    "final": dvi.Save(final=True),
    "every": dvi.Save(every=7),
    "both": dvi.Save(every=7, final=True),
    "all": dvi.Save(),
}


def starts(lanes=37, seed=0):
    rng = np.random.default_rng(seed)
    q = np.array([1.0, 0.2]) + 0.05 * rng.normal(size=(lanes, 2))
    p = np.array([0.1, 1.0]) + 0.05 * rng.normal(size=(lanes, 2))
    return jnp.asarray(q), jnp.asarray(p)


@functools.cache
def runner(system, layout, save="final", method=dvi.TypeII(), num_steps=150, **settings):
    def one(q, p, h, args):
        sol = dvi.integrate(
            SYSTEMS[system], q, p, h=h, num_steps=num_steps, t0=0.3, epsilon=0.01, args=args,
            save=SAVES[save], observe=WATCH, method=method, layout=layout, throw=False, **settings,
        )  # fmt: skip
        stats = {k: sol.stats[k] for k in ("failed_step", "failed_residual")}
        codes = [sol.result == getattr(dvi.RESULTS, n) for n in ("successful", "not_finite")]
        return sol.ts, sol.qs, sol.ps, sol.hs, sol.observed, stats, codes

    return jax.jit(jax.vmap(one, (0, 0, None, None)))


def assert_same(a, b, rtol=1e-12):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        np.testing.assert_allclose(x, y, rtol=rtol, atol=rtol)


SLOW = pytest.mark.slow


@pytest.mark.parametrize(("system", "save"), covering(SYSTEMS, SAVES))
@pytest.mark.slow
def test_components_give_the_numbers_of_arrays(system, save):
    arguments = (*starts(), 0.02, 0.5)
    assert_same(
        runner(system, COMPONENTS, save)(*arguments), runner(system, ARRAYS, save)(*arguments)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "method"),
    covering(
        SYSTEMS,
        [dvi.Adjoint(), dvi.Strang(), dvi.Yoshida(4), dvi.GaussLegendre(2), dvi.RungeKutta4()],
    ),
    ids=repr,
)
def test_every_method_goes_by_components(system, method):
    arguments = (*starts(), 0.02, 0.5)
    a, b = (
        runner(system, x, method=method, num_steps=20)(*arguments) for x in (COMPONENTS, ARRAYS)
    )
    assert_same(a, b)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {"arithmetic": dvi.Compensated()},
        {"adjoint": dvi.Direct()},
        {"adjoint": dvi.Checkpointed()},
        {"adjoint": dvi.Reversible(checkpoint_every=13)},
        {"lattice": dvi.Variational(on_no_root="hold")},
    ],
    ids=str,
)
def test_everything_else_goes_by_components(settings):
    system = "coupled" if "lattice" in settings else "kepler"
    arguments = (*starts(), 0.02, 0.5)
    num_steps = 15 if "lattice" in settings else 40  # its steps amplify round-off
    runs = [runner(system, x, num_steps=num_steps, **settings) for x in (COMPONENTS, ARRAYS)]
    assert_same(*(r(*arguments) for r in runs), rtol=1e-11)


@pytest.mark.slow
def test_large_steps_take_more_iterations_and_lose_no_digit():
    q, p = starts()
    a, b = (runner("coupled", x, num_steps=30)(q, p, 0.15, 0.5) for x in (COMPONENTS, ARRAYS))
    good = np.asarray(b[-1][0])
    assert good.sum() > 0
    assert_same(jax.tree.map(lambda x: x[good], a), jax.tree.map(lambda x: x[good], b), 1e-11)
    np.testing.assert_array_equal(a[-1][0], b[-1][0])
    np.testing.assert_array_equal(a[5]["failed_step"], b[5]["failed_step"])


@pytest.mark.slow
def test_a_lane_that_fails_is_told_and_leaves_the_others_alone():
    """The same step, status and NaN as by arrays; the neighbours' bits are what they were."""
    q, p = starts()
    bad_q = q.at[3].set(0.0).at[20].set(jnp.nan).at[9].set(jnp.array([1e-9, 0.0]))
    for system in SYSTEMS:
        run, plain = (runner(system, x) for x in (COMPONENTS, ARRAYS))
        h = 0.02
        bad_p = p.at[30].set(60.0)  # beyond what an implicit step can solve for
        a, b, fine = run(bad_q, bad_p, h, 0.5), plain(bad_q, bad_p, h, 0.5), run(q, p, h, 0.5)
        assert_same(a, b, rtol=1e-9)
        failed = ~np.asarray(a[-1][0])
        assert 2 <= failed.sum() <= 4
        assert failed[20]
        others = np.ones(len(q), bool)
        others[[3, 20, 9, 30]] = False
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(fine), strict=True):
            np.testing.assert_array_equal(x[others], y[others])


@pytest.mark.parametrize("width", [16, pytest.param(8, marks=SLOW)])
@pytest.mark.slow
def test_tiles_do_not_matter(width):
    """37 lanes in tiles of 8 or 16 (the last one filled up), the bits of one tile."""
    tiles = runner("kepler", dvi.Layout(form="components", width=width), num_steps=20)
    one = runner("kepler", COMPONENTS, num_steps=20)
    arguments = (*starts(), 0.02, 0.5)
    assert_same(tiles(*arguments), one(*arguments), rtol=1e-15)


@pytest.mark.slow
def test_several_axes_of_lanes():
    q, p = starts(6)
    args = jnp.linspace(0, 1, 3)
    both = [
        jax.vmap(lambda a, x=x: runner("kepler", x, num_steps=20)(q, p, 0.02, a))(args)
        for x in (COMPONENTS, ARRAYS)
    ]
    assert_same(*both)


@pytest.mark.slow
@pytest.mark.parametrize("system", ["coupled"])  # tests/test_lanes_runs.py has explicit ones
def test_gradients_by_components(system):
    q, p = starts(9)

    def loss(q, p, epsilon, args, h, layout):
        sol = dvi.integrate(
            SYSTEMS[system], q, p, h=h, num_steps=60, epsilon=epsilon, args=args, layout=layout,
            save=dvi.Save(every=7), observe=WATCH["drift"], adjoint=dvi.Reversible(20),
        )  # fmt: skip
        return jnp.sum(sol.qs**2) + jnp.sum(sol.observed)

    def total(x, layout):
        return jnp.sum(jax.vmap(lambda q, p: loss(q, p, *x[2:], layout))(*x[:2]))

    x = (q, p, 0.01, 0.5, 0.02)
    a, b = (jax.jit(jax.grad(lambda x, w=w: total(x, w)))(x) for w in (COMPONENTS, ARRAYS))
    assert_same(a, b, rtol=1e-10)
    each = jax.jit(jax.vmap(jax.grad(lambda q, p: loss(q, p, *x[2:], COMPONENTS))))(q, p)
    np.testing.assert_allclose(each, b[0], rtol=1e-10)
    pushed = jax.jit(jax.jacfwd(lambda e: total((q, p, e, 0.5, 0.02), COMPONENTS)))(0.01)
    np.testing.assert_allclose(pushed, b[2], rtol=1e-10)


def test_layout_refuses_what_it_does_not_know():
    with pytest.raises(ValueError, match="components"):
        dvi.Layout(form="lanes")
    with pytest.raises(ValueError, match="width must be a positive integer"):
        dvi.Layout(width=0)
    with pytest.raises(TypeError, match="layout must be a Layout"):
        dvi.integrate(KEPLER, jnp.ones(2), jnp.ones(2), h=0.1, num_steps=1, layout="components")
