"""Whole runs with long arrays: machine code against XLA, number by number."""

import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from random_programs.arrays import recorded

import dvi_jax as dvi
import lanewise
from dvi_jax import systems

slow = pytest.mark.slow
XLA = dvi.Layout(form="arrays")
N = 70
RNG = np.random.default_rng(4)
Q, P = 0.4 * RNG.normal(size=(2, N))


def assert_near(found, expected, tolerance=1e-11):
    """Equal integers, NaN at the same places, and numbers relative to the largest of an array."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        if y.dtype.kind != "f":
            np.testing.assert_array_equal(x, y)
            continue
        size = np.max(np.abs(y), initial=1e-3, where=np.isfinite(y))
        units = tolerance * (2.0**29 if y.dtype == np.float32 else 1)
        np.testing.assert_allclose(x, y, rtol=0, atol=units * size)


def compiled_by_elements(function, *args):
    """The results of a function that is compiled as a whole to loops over elements."""
    with recorded() as record:
        out = jax.jit(function)(*args)
    assert record.way == "elements", (record.way, record.reasons)
    return out


def call_and_compare(function, *args, tolerance=1e-11):
    assert_near(
        compiled_by_elements(lambda *args: lanewise.call(function, *args), *args),
        jax.jit(function)(*args),
        tolerance,
    )


# Single operations


@pytest.mark.parametrize(("length", "shift"), [(8, 3), (5, 1), (2, 1)])
def test_a_few_elements_that_change_places_keep_their_values(length, shift):
    """A row that one loop computes and another one reads, turned in between in its own place."""

    def function(x, short):
        turned = jnp.roll(jnp.cumprod(short), shift)
        return jnp.pad(lax.cumsum(turned, reverse=True), (0, N - length)) + x

    call_and_compare(function, Q, 1 + Q[:length])


def collatz(x):
    return lax.while_loop(lambda s: s[1] > 1e-3, lambda s: (s[0] + s[1], 0.5 * s[1]), (0.0, x))


def squares(x):
    """A state with axes of its own, and a loop in the loop."""

    def body(s):
        i, z = s
        inner = lax.while_loop(lambda t: jnp.max(t) > 1.0, lambda t: 0.6 * t, z * z + i)
        return i + 1, jnp.roll(inner, 1) + 0.3

    return lax.while_loop(lambda s: s[0] < 3 + 5 * jnp.abs(x[0]), body, (0, x))


@pytest.mark.parametrize("function", [collatz, squares])
def test_a_while_loop_with_a_condition_for_each_element(function):
    x = 2 * Q if function is collatz else np.stack([Q, P, Q * P], 1)
    x[3] = np.nan
    call_and_compare(jax.vmap(function), x)
    # The control: the elements need different numbers of rounds.
    assert len(np.unique(jax.vmap(function)(x)[0])) > 3


def test_memory_that_cannot_be_had_is_an_error():
    """2⁴⁹ bytes are more than a process can address. Without the test the process would end."""

    def function(x):
        def step(c, _):
            return 1.01 * c + x, None

        return jnp.sum(lax.scan(step, jnp.zeros((2**23, 2**23)) + x, None, length=5)[0])

    with pytest.raises(Exception, match="not enough memory for the arrays"):
        jax.jit(lambda x: lanewise.call(function, x))(1.0)
    with pytest.raises(Exception, match="not enough memory for the arrays"):
        jax.jit(lanewise.batched(function))(jnp.arange(3.0))
    assert float(jnp.sum(lanewise.call(jnp.sin, Q))) == pytest.approx(np.sum(np.sin(Q)))


def test_a_small_cube_is_compiled_in_seconds():
    """Not element by element, which took 200 s."""
    problem = systems.phi4((8, 8, 8), 0.4, ("periodic",) * 3, start="thermal")

    def end(q, p, layout=None):
        sol = dvi.integrate(problem, q, p, h=problem.h, num_steps=5, layout=layout)
        return sol.qs, sol.ps

    start = time.process_time()
    found = compiled_by_elements(end, problem.q0, problem.p0)
    assert time.process_time() - start < 20
    assert_near(found, jax.jit(functools.partial(end, layout=XLA))(problem.q0, problem.p0))


# Whole runs


def outputs(system, layout=None, **options):
    """A function of (q0, p0, args): states, status and observed values, without counts of
    iterations, which depend on round-off."""
    options = {"num_steps": 24, "h": 0.05, "throw": False, "method": dvi.Strang()} | options

    def function(q, p, args):
        sol = dvi.integrate(system, q, p, args=args, layout=layout, **options)
        return sol.ts, sol.qs, sol.ps, jnp.asarray(sol.result._value), sol.observed

    return function


def run_and_compare(system, q=Q, p=P, args=None, tolerance=1e-10, **options):
    found = jax.jit(outputs(system, **options))(q, p, args)
    assert_near(found, jax.jit(outputs(system, XLA, **options))(q, p, args), tolerance)
    return found


def potential(V):
    return dvi.System(lambda t0, t1, q0, p1, args: jnp.sum(p1**2) / 2 + V(q0, args))


def spring(q):
    return jnp.sum((jnp.roll(q, -1) - q) ** 2) / 2


PAIRS = RNG.integers(0, N, size=(2, 90))
POTENTIALS = {
    "slices": lambda q, a: jnp.sum((q[2:] - 2 * q[1:-1] + q[:-2]) ** 2) + a * jnp.sum(q[::3] ** 4),
    "masks": lambda q, a: a * jnp.sum(jnp.where(q > 0.2, jnp.sqrt(jnp.where(q > 0.2, q, 1)), q**2)),
    "triu": lambda q, a: a * jnp.sum(jnp.triu(1 / (1 + (q[:, None] - q[None]) ** 2), 1)),
    "gather": lambda q, a: a * jnp.sum(jnp.cos(q[PAIRS[0]] - q[PAIRS[1]])),
    "scatter": lambda q, a: a * jnp.sum(jnp.zeros(20).at[PAIRS[0] % 20].add(q[PAIRS[1]] ** 2) ** 2),
    "cumulative": lambda q, a: (
        a * jnp.sum(jnp.cumsum(q) ** 2) / N + jnp.sum(jnp.cumprod(1 + q / N))
    ),
    "argument": lambda q, a: a * (q[jnp.argmin(q)] - 1) ** 2 + q[jnp.argmax(jnp.abs(q))] ** 2,
    "cond": lambda q, a: lax.cond(jnp.sum(q) > 0, spring, lambda q: a * jnp.sum(q**4), q),
    "switch": lambda q, a: lax.switch(
        jnp.int32(jnp.sum(jnp.abs(q))) % 3, [spring, lambda q: a * jnp.sum(q**2), jnp.sum], q
    ),
    "slices in a loop": lambda q, a: lax.fori_loop(
        0, 20, lambda i, s: s + a * jnp.sum(lax.dynamic_slice(q, (3 * i,), (5,)) ** 2), 0.0
    ),
    "einsum": lambda q, a: a * jnp.einsum("i,ij,j", q, np.outer(Q, P), q) + jnp.sum(q**2),
    "fft": lambda q, a: a * jnp.sum(jnp.abs(jnp.fft.rfft(q)) ** 4) / N,
    "convolution": lambda q, a: a * jnp.sum(jnp.convolve(q, P[:7], mode="same") ** 2),
    "sort": lambda q, a: a * jnp.sum(jnp.sort(q) * np.arange(N)) / N + spring(q),
    "integers": lambda q, a: jnp.sum((jnp.int32(10 * q) % 3) * q) + a * jnp.sum(q**2),
    "per element": lambda q, a: a * jnp.sum(jax.vmap(collatz)(lax.stop_gradient(q))[0] * q),
}
QUICK = ("scatter", "fft")


@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=() if k in QUICK else slow) for k in POTENTIALS]
)
def test_potentials_of_a_user(name):
    V = POTENTIALS[name]
    q = run_and_compare(potential(V), args=0.3, observe=lambda t, q, p, a: V(q, a))[1]
    assert np.max(np.abs(q[-1] - Q - 1.2 * P)) > 1e-3  # the control: there is a force


def root(q, args):
    """Its derivative becomes NaN where a site is beyond 1."""
    return spring(q) - args * jnp.sum(jnp.sqrt(1 - q**2))


FALLS = np.where(np.arange(N) == 17, 0.9, 0.5 * Q), np.where(np.arange(N) == 17, 0.3, P)
REDUCTIONS = {
    "drift": dvi.MaxDrift(lambda q, p: jnp.sum(q**2)),
    "mean": dvi.Mean(lambda q, p: q),
    "last": dvi.Last(lambda q, p: q * p),
    "largest": lambda q, p: jnp.max(q),
}


@pytest.mark.parametrize(
    "save",
    [dvi.Save(every=5), *(pytest.param(s, marks=slow) for s in
     (dvi.Save(), dvi.Save(final=True), dvi.Save(ts=np.linspace(0.0, 2.0, 7))))],
)  # fmt: skip
def test_a_run_fails_at_the_step_at_which_that_of_xla_fails(save):
    options = {"save": save, "num_steps": 40, "observe": REDUCTIONS}
    found = run_and_compare(potential(root), *FALLS, 0.1, **options)
    assert int(found[3]) != 0
    if save.every == 5:  # not at once
        assert 1 < np.sum(np.isfinite(found[1]).all(axis=1)) < 9


def pendulums(t0, t1, q0, p1, args):
    """Not separable."""
    masses = 1 + 0.1 * jnp.cos(q0)
    return jnp.sum(p1**2 * masses) / 2 + spring(q0) + args * (1 + jnp.sin(t0)) * jnp.sum(q0**4) / 4


FPUT = systems.fput(N, 0.25, 0.3)
PICARD = {"root_finder": dvi.Picard()}
RUNS = {
    "KahanLi": {"method": dvi.KahanLi(8), "observe": dvi.MEGNO()},
    "backwards": {"h": -0.05, "t0": 2.0, "method": dvi.Yoshida(4)},
    "compensated": {"arithmetic": dvi.Compensated()},
    "double-double": {"arithmetic": dvi.DoubleDouble(), "num_steps": 6},
    "integers": {"arithmetic": dvi.FixedPoint(2.0**-40), "observe": REDUCTIONS},
    "stop": {"stop": dvi.Stop(lambda q, p: jnp.sum(p**2) - 0.7 * jnp.sum(q**2))},
    "section": {"observe": dvi.Section(lambda q, p: q[5], max_crossings=9), "num_steps": 200},
    "exponents": {"observe": dvi.LyapunovSpectrum(3)},
    "alignment": {"observe": dvi.GALI(4)},
    "no steps": {"num_steps": 0, "observe": REDUCTIONS},
    "adaptive": {"lattice": dvi.AdaptiveReversible(lambda q, p: 1 / (1 + jnp.sum(q**2)))},
    "GaussLegendre": {"method": dvi.GaussLegendre(2), **PICARD},
    "Lobatto": {"method": dvi.LobattoIIIAIIIB(2), **PICARD},
    "RungeKutta4": {"method": dvi.RungeKutta4()},
    "implicit": {"method": dvi.Strang(), **PICARD},
    "implicit, fails": {"method": dvi.Strang(), "h": 3.0, **PICARD},
}
NOT_SEPARABLE = list(RUNS)[-5:]


@slow
@pytest.mark.parametrize("name", RUNS)
def test_methods_arithmetics_and_observables(name):
    if name in NOT_SEPARABLE:
        run_and_compare(dvi.System(pendulums), args=0.3, **RUNS[name])
    else:
        run_and_compare(FPUT, args=FPUT.args, **RUNS[name])


TEST_PARTICLES = systems.n_body(
    np.repeat([0.2, 0.0], [5, 30]), *RNG.normal(size=(2, 35, 2)), softening=0.2
)
LIBRARY = {
    "bodies": systems.n_body(np.ones(20) / 20, *RNG.normal(size=(2, 20, 3)), softening=0.2),
    "test particles": TEST_PARTICLES,
    "field": systems.phi4((6, 9, 7), 0.4, ("fixed", "periodic", "free")),
    "fluid": systems.lennard_jones(27),
    "sine-Gordon": systems.sine_gordon(96, 0.2, start="kink"),
}


@slow
@pytest.mark.parametrize("name", LIBRARY)
def test_systems_of_the_library(name):
    made = LIBRARY[name]
    options = {"h": made.h, "method": dvi.KahanLi(6), "save": dvi.Save(every=6)}
    run_and_compare(made, made.q0, made.p0, made.args, observe=made.observables, **options)


# Gradients


def loss(system, layout, **options):
    def function(q, p, args):
        _, qs, ps, _, observed = outputs(system, layout, **options)(q, p, args)
        return (
            jnp.sum(jnp.sin(qs[-1]))
            + jnp.sum(ps**2) / 100
            + sum(jnp.sum(x) for x in jax.tree.leaves(observed))
        )

    return function


GRADIENTS = {
    "reverse": {"observe": {"drift": REDUCTIONS["drift"], "mean": REDUCTIONS["mean"]}},
    "final": {"save": dvi.Save(final=True), "method": dvi.KahanLi(6)},
    "times": {"save": dvi.Save(ts=np.linspace(0, 1, 5))},
    "implicit": {**PICARD, "num_steps": 8},
    "failing": {"h": 3.0},
}


@pytest.mark.parametrize(
    "name", ["final", *(pytest.param(k, marks=slow) for k in GRADIENTS if k != "final")]
)
def test_gradients_in_both_modes(name):
    system = dvi.System(pendulums) if name == "implicit" else potential(
        lambda q, a: spring(q) + a * jnp.sum(q**4)
    )  # fmt: skip
    found, expected = (
        jax.jit(lambda *x, f=loss(system, layout, **GRADIENTS[name]): (
            jax.value_and_grad(f, (0, 1, 2))(*x), jax.jvp(f, x, (P, Q, 1.0))
        ))(Q, P, 0.3)
        for layout in (None, XLA)
    )  # fmt: skip
    assert_near(found, expected, 1e-9)
    if name == "final":  # the control: differences
        f, d = loss(system, None, **GRADIENTS[name]), 1e-5
        slope = (f(Q + d * P, P + d * Q, 0.3 + d) - f(Q - d * P, P - d * Q, 0.3 - d)) / (2 * d)
        assert float(found[1][1]) == pytest.approx(float(slope), rel=1e-6)


@slow
@pytest.mark.parametrize("name", ["gather", "cond", "masks"])
def test_second_derivatives(name):
    system = potential(POTENTIALS[name])
    found, expected = (
        jax.jit(lambda q, f=loss(system, layout, num_steps=6): jax.jvp(
            jax.grad(lambda q: f(q, P, 0.3)), (q,), (P,)
        ))(Q)
        for layout in (None, XLA)
    )  # fmt: skip
    assert_near(found, expected, 1e-9)


# Batches


@pytest.mark.parametrize(
    "options", [{"method": dvi.BAOAB(), "path": 3}, pytest.param({**PICARD}, marks=slow)]
)
def test_bits_are_those_of_each_trajectory_alone_with_any_number_of_threads(options):
    noise = dvi.Langevin(lambda args: args, lambda args: 0.2) if "path" in options else None
    H_D = (lambda *x: jnp.sum(x[3] ** 2) / 2 + spring(x[2])) if noise else pendulums
    one = outputs(dvi.System(H_D, noise=noise), num_steps=2000, save=dvi.Save(every=500), **options)
    q, p = 0.3 * RNG.normal(size=(2, 5, N))
    q[2, 9] = np.nan
    batch, alone = jax.jit(jax.vmap(one, (0, 0, None))), jax.jit(one)
    before = lanewise.get_threads()
    results = []
    try:
        for count in (1, 2):
            lanewise.set_threads(count)
            results.append(batch(q, p, 0.3))
    finally:
        lanewise.set_threads(before)
    jax.tree.map(np.testing.assert_array_equal, *results)
    for i in range(5):
        of_batch = jax.tree.map(lambda x, i=i: x[i], results[0])
        jax.tree.map(np.testing.assert_array_equal, of_batch, alone(q[i], p[i], 0.3))
    np.testing.assert_array_equal(np.asarray(results[0][3]) != 0, np.arange(5) == 2)
