"""Batches in one GPU kernel: lowered for CUDA without a GPU, and interpreted on the CPU.

That a program is lowered says that Triton takes it, not that a GPU has run it.
"""

import functools
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import dvi_jax as dvi
from dvi_jax import certify, systems
from dvi_jax._compat import lowered_for_cuda
from dvi_jax.engine.kernel import LOWERED, NotInKernelError, run_in_kernel
from dvi_jax.engine.linear import solve_dense
from dvi_jax.engine.tiles import lanewise
from dvi_jax.engine.together import on_any_lane

LANES, BLOCK = 11, 4
"""The last block has a lane too few."""


def kinetic(t0, t1, q0, p0, q1, p1, args):
    return jnp.sum(p1**2) / 2


def pendulum(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 - jnp.sum(jnp.cos(q0))


def product(t0, t1, q0, p1, args):
    """H = (q² + 1)(p² + 1)/2: implicit."""
    return jnp.sum((q0**2 + 1) * (p1**2 + 1)) / 2


def chain(t0, t1, q0, p1, args):
    """Implicit, tridiagonal."""
    d = jnp.diff(jnp.pad(q0, 1))
    return jnp.sum(p1**2) / 2 + jnp.sum(d**2 / 2 + d**4 / 4) + 0.05 * jnp.sum(p1**2 * q0**2)


def sorted_positions(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 + jnp.sum(jnp.sort(q0) ** 2 * jnp.arange(1.0, 1 + q0.size)) / 2


SYSTEMS = {
    "kepler": (systems.kepler().system, [0.0, 1.2], [-1.0, -0.6]),
    "pendulum": (dvi.System(pendulum, force=lambda *a: -(1 + a[2] ** 2) * a[3]), [0.4], [0.7]),
    "product": (dvi.System(product), [0.3], [0.4]),
    "chain": (dvi.System(chain), [0.3, -0.2], [0.4, 0.1]),
    "chain of 10": (dvi.System(chain), 0.3 * np.cos(np.arange(10)), np.zeros(10)),
    "sorting": (dvi.System(sorted_positions), [0.3, 0.1], [0.4, 0.0]),
}
INVARIANTS = {"drift": dvi.MaxDrift(kinetic), "trend": dvi.Trend(kinetic)}


def batch(name, form="kernel", dtype=jnp.float64, lanes=LANES, **settings):
    """(the compiled function, q0, p0) of a batch: its states, status and what is observed."""
    system, q, p = SYSTEMS[name]
    noise = 0.01 * np.random.default_rng(0).normal(size=(2, lanes, len(q)))
    settings = {"h": 0.05, "num_steps": 30, "epsilon": 0.01, "args": {"K": 1.0}} | settings
    layout = dvi.Layout(form=form, width=BLOCK)

    @jax.jit
    @jax.vmap
    def run(q0, p0):
        sol = dvi.integrate(system, q0, p0, layout=layout, throw=False, **settings)
        return sol.qs, sol.ps, sol.observed, sol.stats["failed_step"]

    return run, jnp.asarray(q + noise[0], dtype), jnp.asarray(p + noise[1], dtype)


def calls_and_loops(program):
    """How many Triton calls, and loops outside of them."""
    return len(re.findall(r"custom_call @\S*triton", program)), program.count("stablehlo.while")


def same(a, b, dtype=np.float64, ulps=64):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        tolerance = ulps * np.finfo(dtype).eps
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


# --- runs -----------------------------------------------------------------------------------------

RUNS = {
    "kepler, float32": ("kepler", {"dtype": jnp.float32, "save": dvi.Save(every=10)}),
    "product, invariants": (
        "product",
        {"observe": INVARIANTS, "save": dvi.Save(final=True)},
    ),
}
MORE_RUNS = {
    "kepler": ("kepler", {}),
    "pendulum": ("pendulum", {"save": dvi.Save(every=7, final=True)}),
    "pendulum, float32": ("pendulum", {"dtype": jnp.float32, "observe": INVARIANTS}),
    "chain": ("chain", {"save": dvi.Save(every=3), "observe": {"T": kinetic} | INVARIANTS}),
    "chain of 10": ("chain of 10", {"save": dvi.Save(final=True)}),
    "long blocks": (
        "kepler",
        {"save": dvi.Save(every=300), "num_steps": 650, "observe": {"T": kinetic}},
    ),
    "compensated": ("product", {"arithmetic": dvi.Compensated()}),
    "direct": ("product", {"adjoint": dvi.Direct(), "save": dvi.Save(every=5)}),
    "checkpointed": ("product", {"adjoint": dvi.Checkpointed(), "save": dvi.Save(every=5)}),
}
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in MORE_RUNS]
RUNS_ALL = RUNS | MORE_RUNS


@pytest.mark.parametrize("name", [*RUNS, *SLOW])
@pytest.mark.slow
def test_one_kernel_and_its_numbers(name):
    """One call on CUDA, no loop beside it; interpreted it gives the numbers of arrays."""
    system, settings = RUNS_ALL[name]
    run, *start = batch(system, **settings)
    assert calls_and_loops(lowered_for_cuda(run, *start)) == (1, 0)
    plain, *_ = batch(system, "arrays", **settings)
    ulps = 512 if "long" in name else 64
    same(run(*start), plain(*start), start[0].dtype, ulps)


TOO_LARGE = ("GaussLegendre3", "GaussLegendre4", "LobattoIIIAIIIB4")
"""Methods of 12 to 16 unknowns on two bodies, of which the elimination is written out."""


@pytest.mark.slow
@pytest.mark.parametrize(("name", "newton"), [
    *((name, dvi.PicardThenNewton()) for name in certify.METHODS),
    *((name, dvi.Picard()) for name in TOO_LARGE),
])  # fmt: skip
def test_methods(name, newton):
    """Every method goes into a kernel or is left to XLA, known before it is compiled."""
    settings = {"method": certify.METHODS[name], "num_steps": 12, "save": dvi.Save(every=4)}
    settings["newton"] = newton
    run, *start = batch("chain", **settings)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        calls, loops = calls_and_loops(lowered_for_cuda(run, *start))
    left = [w for w in seen if "left to XLA" in str(w.message)]
    assert (calls, bool(loops), bool(left)) in ((1, False, False), (0, True, True))
    by_elimination = name in TOO_LARGE and newton != dvi.Picard()
    assert bool(calls) != by_elimination
    assert all(re.search(r"it has some \d{5} operations", str(w.message)) for w in left)
    if calls:
        plain, *_ = batch("chain", "arrays", **settings)
        same(run(*start), plain(*start), ulps=256)


def test_what_does_not_go_into_a_kernel_is_left_to_xla():
    run, *start = batch("sorting", num_steps=8)
    with pytest.warns(UserWarning, match="left to XLA: sort is applied to an array"):
        calls, loops = calls_and_loops(lowered_for_cuda(run, *start))
    assert (calls, loops > 0) == (0, True)


def test_other_forms_make_no_kernel_without_a_gpu():
    run, *start = batch("kepler", "components", save=dvi.Save(final=True))
    assert calls_and_loops(lowered_for_cuda(run, *start))[0] == 0
    assert dvi.Layout(form="kernel").in_kernel
    assert dvi.Layout().in_kernel == (jax.default_backend() == "gpu")
    with pytest.raises(ValueError, match='"kernel"'):
        dvi.Layout(form="gpu")  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_auto_takes_the_kernel_on_cuda():
    """From 100 000 lanes × steps on; with as few as here it does not pay."""
    run, q, p = batch("kepler", "auto", save=dvi.Save(final=True), num_steps=10_000)
    assert calls_and_loops(lowered_for_cuda(run, q, p)) == (1, 0)
    run, q, p = batch("kepler", "auto", save=dvi.Save(final=True), num_steps=10)
    assert calls_and_loops(lowered_for_cuda(run, q, p))[0] == 0


@pytest.mark.slow
def test_failing_lanes():
    """A lane that fails has the status of the plain path, and leaves its neighbours their bits."""
    system = dvi.System(lambda t0, t1, q0, p1, args: jnp.sum(p1**2) / 2 - jnp.sum(q0**4) / 4)

    def run_in(form):
        def one(q0, p0):
            sol = dvi.integrate(
                system, q0, p0, h=0.1, num_steps=200, save=dvi.Save(every=50), throw=False,
                layout=dvi.Layout(form=form, width=BLOCK),
            )  # fmt: skip
            return sol.qs, sol.stats["failed_step"], sol.result == dvi.RESULTS.successful

        return jax.jit(jax.vmap(one))

    q = jnp.linspace(-0.05, 0.05, LANES)[:, None]
    p = -0.01 * q
    bad = q.at[2].set(3.0).at[5].set(jnp.nan)
    kernel, plain = run_in("kernel"), run_in("arrays")
    qs, failed_step, good = kernel(bad, p)
    expected = plain(bad, p)
    np.testing.assert_array_equal(failed_step, expected[1])
    np.testing.assert_array_equal(good, expected[2])
    assert failed_step[2] > 0
    assert not good[2]
    assert not good[5]
    assert np.isnan(qs[2, -1]).all()
    assert np.isfinite(qs[2, 0]).all()
    alone, _, all_good = kernel(q, p)
    others = np.delete(np.arange(LANES), [2, 5])
    np.testing.assert_array_equal(qs[others], alone[others])
    assert all_good.all()


def gradient(form, name, save, **settings):
    """The gradient of a function of what a batch saves, compiled, and its inputs."""
    run, *start = batch(name, form, save=save, adjoint=dvi.Reversible(20), **settings)
    return jax.jit(jax.grad(lambda q, p: jnp.sum(run(q, p)[0] ** 2), (0, 1))), start


@pytest.mark.parametrize(
    ("name", "save", "steps"),
    [
        ("product", dvi.Save(every=7, final=True), 4_000),
        ("kepler", dvi.Save(final=True), 20_000),
        ("chain", dvi.Save(every=30), 4_000),
    ],
)
@pytest.mark.slow
def test_gradients_in_two_kernels(name, save, steps):
    """One there and one back; the loops beside them are those of a linear map never applied."""
    back, start = gradient("kernel", name, save, num_steps=steps)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # nothing is left to XLA
        assert calls_and_loops(lowered_for_cuda(back, *start))[0] == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "save", "steps"),
    [
        ("product", dvi.Save(every=7, final=True), 160),
        ("kepler", dvi.Save(final=True), 1_500),
        ("chain", dvi.Save(every=45), 140),
    ],
)
def test_gradients(name, save, steps):
    back, start = gradient("kernel", name, save, num_steps=steps)
    plain, _ = gradient("arrays", name, save, num_steps=steps)
    for a, b in zip(back(*start), plain(*start), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())


# --- functions ------------------------------------------------------------------------------------


def in_kernel(function, *args, shared=(), **options):
    """The function in a kernel, as a jitted function of arguments with lanes in front."""
    shapes = [a if i in shared else a[0] for i, a in enumerate(args)]
    closed = jax.make_jaxpr(function)(*shapes)
    on = [i not in shared for i in range(len(args))]
    lanes = next(len(a) for a, o in zip(args, on, strict=True) if o)

    def run(interpret, *args):
        arrays, flags = [*closed.consts, *args], [None] * len(closed.consts) + on
        return run_in_kernel(
            closed.jaxpr, arrays, flags, lanes, block=BLOCK, interpret=interpret, **options
        )

    return jax.jit(functools.partial(run, False)), jax.jit(functools.partial(run, True))


def check(function, *args, dtype=np.float64, **options):
    lowered, interpreted = in_kernel(function, *args, **options)
    assert calls_and_loops(lowered_for_cuda(lowered, *args)) == (1, 0)
    axes = [None if i in options.get("shared", ()) else 0 for i in range(len(args))]
    expected = jax.jit(jax.vmap(function, axes))(*args)
    same(interpreted(*args), jax.tree.leaves(expected), dtype)


SAMPLES = (-2.0, -0.5, -0.0, 0.0, 0.25, 0.9, 1.0, 3.5, np.inf, -np.inf, np.nan)
_UNARY = """abs acos acosh asin asinh atan atanh cbrt ceil cos cosh exp exp2 expm1 floor is_finite
log log1p logistic neg rsqrt sign sin sinh sqrt square tan tanh"""
_BINARY = "add sub mul div pow atan2 eq ne lt le gt ge max min"
UNARY, BINARY = _UNARY.split(), _BINARY.split()
OF_INTEGERS = {
    "and": lax.bitwise_and,
    "or": lax.bitwise_or,
    "xor": lax.bitwise_xor,
    "rem": lax.rem,
    "shift_left": lax.shift_left,
    "shift_right_arithmetic": lax.shift_right_arithmetic,
    "shift_right_logical": lax.shift_right_logical,
} | {name: getattr(lax, name) for name in BINARY if name not in ("pow", "atan2")}
OTHERS = {"add_any", "integer_pow", "broadcast_in_dim", "convert_element_type", "select_n"}


def real_operations(x, y):
    """All that goes into a kernel of one and of two real numbers."""
    ones = [getattr(lax, name)(x) for name in UNARY]
    twos = [getattr(lax, name)(x, y) for name in BINARY]
    cube, inverse = lax.integer_pow(x, 3), lax.integer_pow(x, -2)
    several = lax.clamp(jnp.zeros_like(x), x, jnp.ones_like(x)), jnp.where(x > 0, x, y)
    return *ones, *twos, cube, inverse, *several, (x > 0).astype(x.dtype)


@pytest.mark.parametrize(
    "dtype",
    [np.float64, pytest.param(np.float32, marks=pytest.mark.slow)],
    ids=lambda d: d.__name__,
)
def test_operations_on_real_numbers(dtype):
    """NaN, infinities and signed zeros among them, each with each."""
    x, y = (jnp.asarray(a.ravel(), dtype) for a in np.meshgrid(SAMPLES, SAMPLES))
    check(real_operations, x, y, dtype=dtype)
    named = {*UNARY, *BINARY, *OTHERS} - {"max", "min"}  # those are made of others: NaN stays
    assert LOWERED["f"] == named


@pytest.mark.slow
def test_operations_on_integers_and_truth_values():
    x, y = (jnp.asarray(a.ravel(), jnp.int32) for a in np.meshgrid((-5, 0, 1, 4), (1, 2, 3)))

    def function(x, y):
        a, b = x > y, x > 0
        logic = a & b, a | b, a ^ b, ~a, a == b, a != b
        ones = abs(x), -x, lax.sign(x), ~x, x**3, lax.square(x), jnp.clip(x, 0, 1)
        return *(f(x, y) for f in OF_INTEGERS.values()), *ones, *logic, x.astype(float)

    check(function, x, y)
    ones = {"abs", "neg", "sign", "not", "square", "clamp", "reduce_max", "reduce_min"}
    assert LOWERED["i"] == {*OF_INTEGERS, *ones, *OTHERS}


FUNCTIONS = {
    "a scan that saves": lambda x: lax.scan(lambda c, _: (0.9 * c, (c, c.sum())), x, None, 6),
    "backwards": lambda x: lax.scan(lambda c, _: (0.9 * c, c), x, None, 6, reverse=True),
    "a scan in a scan that saves": lambda x: lax.scan(
        lambda c, _: lax.scan(lambda c, _: (0.9 * c, c), c, None, 3), x, None, 4
    ),
    "rows used afterwards": lambda x: (
        x * lax.scan(lambda c, _: (0.9 * c, c), x, None, 9)[1][::-1].sum(0)
    ),
    "a table": lambda x: lax.scan(lambda c, y: (c * y, None), x, jnp.arange(1.0, 18.0) / 9)[0],
    "no step": lambda x: lax.scan(lambda c, _: (c, c), x, None, 0),
    "what is known among what is not": lambda x: (
        -(jnp.stack([x[0], 0.5 + 0 * x[1] ** 0]) ** 2),
        lax.fori_loop(0, x.shape[0] + 4, lambda i, c: (x[0] + c[0], -2.0, True), (1.0, -2.0, True)),
        lax.cond(on_any_lane(x[0] > 9), lambda: (1.0, True), lambda: (2.0, False)),
        lax.while_loop(lambda c: c[0] < 9, lambda c: (c[0] * 2 + 1, 7), (x[0] ** 2, 7)),
    ),
    "a row of a table": lambda x: lax.fori_loop(
        0, 5, lambda i, c: c + x[i % 3] * jnp.arange(4.0)[c[0].astype(int)], x
    ),
    "one step": lambda x: lax.scan(lambda c, y: (c * y, c), x, jnp.ones(1)),
    "a loop per lane": lambda x: lax.while_loop(
        lambda c: jnp.sum(c**2) < 10, lambda c: 1.5 * c, x + 2 + x**2
    ),
    "a choice per lane": lambda x: lax.switch(
        (x[0] > 0).astype(int) + (x[1] > 0), [lambda x: x, lambda x: x**2, jnp.negative], x
    ),
    "a choice for all": lambda x: lax.cond(on_any_lane(x[0] > 9), lambda x: x, jnp.square, x),
    "pivoting": lambda x: solve_dense(jnp.outer(x, x) - jnp.diag(x) + jnp.eye(3)[::-1], x),
    "a large solve": lambda x: solve_dense(jnp.eye(6)[::-1] + x[0] / 9, jnp.arange(6.0)),
    "truth values": lambda x: (x > 0, jnp.any(x > 1), lax.cummax(x)),
    "what does not vary": lambda x: (jnp.arange(3.0), jnp.zeros(0), x),
}


LONG = ("a large solve", "pivoting")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in FUNCTIONS]
)
def test_functions(name):
    check(FUNCTIONS[name], jnp.asarray(np.random.default_rng(0).normal(size=(LANES, 3))))


@pytest.mark.slow
def test_large_inputs_are_read_row_by_row():
    """By one loop, two, backwards, shifted by a row, with a row in front."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(LANES, 6, 4, 9)))
    y, shared = x.reshape(LANES, 72, 3), jnp.linspace(0, 1, 300).reshape(150, 2)

    def function(x, y, shared):
        def add(c, row):
            return 0.9 * c + row, c[0]

        def outer(c, rows):
            return lax.scan(add, c, rows, reverse=True)

        last, saved = lax.scan(outer, x[-1][2], x)
        shifted, _ = lax.scan(add, y[3], jnp.concatenate([y[:1], y[:-1]]))
        sums, _ = lax.scan(add, jnp.zeros(2), shared[1:])
        looked_up = lax.fori_loop(140, 153, lambda i, c: c + shared[i], jnp.zeros(2))
        return last, saved, shifted, sums, looked_up

    check(function, x, y, shared, shared=(2,))


def test_shared_and_other_inputs():
    x = jnp.asarray(np.random.default_rng(0).normal(size=(LANES, 2)))
    table, which, flag = jnp.arange(3.0), jnp.arange(LANES), x[:, 0] > 0

    def function(x, table, which, flag):
        return jnp.where(flag, x * table[1], x + table.sum()), which + 1, ~flag

    check(function, x, table, which, flag, shared=(1,))


REFUSED = {
    "sort is applied to an array": jnp.sort,
    "float16": lambda x: x.astype(jnp.float16).astype(x.dtype) ** 2,
    "erf": lax.erf,
    "gather is applied to an array": lambda x: x[x.astype(int)],
    "what a loop saves": lambda x: lax.scan(
        lambda c, y: (c + y, None), x, lax.scan(lambda c, _: (c / 2, c), x, None, 9)[1]
    )[0],
    "saves rows within": lambda x: lax.cond(
        x[0] > 0, lambda x: lax.scan(lambda c, _: (c / 2, c), x, None, 9)[1].sum(0), jnp.square, x
    ),
    "a large table": lambda x: lax.scan(lambda c, y: (c + y, None), x, jnp.ones((99, 3)))[0],
    "a large input is used other than row by row": lambda x: x[0] + x.sum(),
    "an input has 600 entries": lambda x: x[0, 0],
}


@pytest.mark.parametrize("reason", REFUSED)
def test_refused_before_it_is_compiled(reason):
    shapes = {"a large input": (200,), "an input": (3, 200)}
    shape = next((s for key, s in shapes.items() if reason.startswith(key)), (3,))
    x = jnp.ones((LANES, *shape))
    lowered, _ = in_kernel(REFUSED[reason], x)
    with pytest.raises(NotInKernelError, match=reason):
        lowered.trace(x)


def test_unwanted_outputs_are_neither_computed_nor_written():
    x = jnp.ones((LANES, 3))

    def function(x):
        return jnp.sort(x), 2 * x, lax.scan(lambda c, _: (0.9 * c, c), x, None, 6)

    @jax.jit
    def batch(x):
        layout = dvi.Layout(form="kernel")
        return jax.vmap(lambda x: lanewise(function, x, layout=layout, steps=1, entries=3)[1])(x)

    # The sort alone would keep it out of a kernel.
    assert calls_and_loops(lowered_for_cuda(batch, x)) == (1, 0)
    np.testing.assert_array_equal(batch(x), 2 * x)
    lowered, _ = in_kernel(function, x)
    with pytest.raises(NotInKernelError):
        lowered.trace(x)


def test_a_run_writes_what_is_asked_for():
    """Of a default run (with checkpoints for a gradient) start and end alone are written."""
    system, q, p = SYSTEMS["kepler"]

    def one(q0, p0):
        sol = dvi.integrate(
            system, q0, p0, h=0.01, num_steps=5000, args={"K": 1.0}, throw=False,
            save=dvi.Save(final=True), layout=dvi.Layout(form="kernel", width=BLOCK),
        )  # fmt: skip
        return sol.qs[-1], sol.ps[-1]

    start = jnp.tile(jnp.asarray(q), (8, 1)), jnp.tile(jnp.asarray(p), (8, 1))
    program = lowered_for_cuda(jax.jit(jax.vmap(one)), *start)
    (call,) = re.findall(r"custom_call @\S*triton.*-> (.*)", program)
    assert re.findall(r"tensor<\S*>", call) == ["tensor<8xf64>"] * 8
