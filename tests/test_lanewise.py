"""Generated code: equal bits wherever a trajectory is computed, and everything around the code."""

import contextlib
import ctypes
import errno
import functools
import inspect
import os
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import llvmlite.binding as llvm
import numpy as np
import pytest
from helpers import SYSTEMS, pendulum
from jax import export, lax

import dvi_jax as dvi
import lanewise
from lanewise import primitive
from lanewise.jaxprs import extent
from lanewise.jaxprs.traced import Trace
from lanewise.llvm.ir import NotCompilable
from lanewise.native import cache, machine, switches
from lanewise.rules import moves, rounds
from lanewise.targets import TARGETS, Code
from lanewise.targets.target import compiled_by

RNG = np.random.default_rng(0)


def assert_same(found, expected):
    """The same numbers, NaN equal to NaN, −0 not equal to 0."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
        if np.issubdtype(a.dtype, np.floating):
            number = ~np.isnan(a)
            np.testing.assert_array_equal(np.signbit(a)[number], np.signbit(b)[number])


def assert_close(found, expected, rtol=1e-13):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)


@pytest.fixture
def left(monkeypatch):
    """The reasons for which calls were left to XLA."""
    reasons, original = [], primitive._through_xla

    def counted(*operands, **params):
        reasons.append(sys.exc_info()[1])
        return original(*operands, **params)

    monkeypatch.setattr(primitive, "_through_xla", counted)
    return reasons


@pytest.fixture
def threads():
    before = lanewise.get_threads()
    yield
    lanewise.set_threads(before)


def hostile(x, k):
    """Sines, divisions, products below the smallest normal number, a loop, rows."""

    def step(c, _):
        q, p = c
        p = p - 0.1 * jnp.sin(q)
        q = q + 0.1 * p / (1 + q * q)
        return (q, p), (q * p, q * 1e-30 * 1e-30)

    def halve(c):
        n, y = c
        return n + 1, 0.5 * y + jnp.sin(y) / 3

    end, rows = lax.scan(step, (x, x / 3), None, length=60)
    n, y = lax.while_loop(lambda c: (jnp.abs(c[1]) > 0.01 * (k + 1)) & (c[0] < 30), halve, (0, x))
    return end, rows, n, y, x * 3e-17 * x


def starts(dtype, count=1000):
    x = np.linspace(-3, 3, count) ** 3
    x[1::50], x[3::70], x[5::90] = 1e-154, 1e18, -np.inf
    return x.astype(dtype), np.arange(count) % 5


def cut(tree, where):
    return jax.tree.map(lambda a: np.asarray(a)[where], tree)


def assert_bits_do_not_depend_on_the_batch(function, args, places):
    """On one and two threads, of parts and repetitions of a batch, alone, in nested batches, with
    neighbours that fail. Returns the results of the batch."""
    batch, count = jax.jit(jax.vmap(function)), len(args[0])
    lanewise.set_threads(1)
    every = jax.tree.map(np.asarray, batch(*args))
    lanewise.set_threads(2)
    for _ in range(3):
        assert_same(batch(*args), every)
    for where in (*places, np.random.default_rng(1).integers(0, count, 1000)):
        assert_same(batch(*cut(args, where)), cut(every, where))
    alone = jax.jit(function)
    for i in (0, 1, 3, 5, count // 2 + 1):
        assert_same(alone(*cut(args, i)), cut(every, i))
    square = [a[:64].reshape(4, 16, *a.shape[1:]) for a in args]
    nested = jax.jit(jax.vmap(jax.vmap(function)))(*square)
    assert_same(jax.tree.map(lambda a: a.reshape(64, *a.shape[2:]), nested), cut(every, slice(64)))
    fails = np.arange(count) % 3 == 0
    for a in args:
        if np.issubdtype(a.dtype, np.floating):
            a[fails] = np.nan
    assert_same(cut(batch(*args), ~fails), cut(every, ~fails))
    return every


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_bits_do_not_depend_on_the_batch(left, threads, dtype):
    x, k = starts(dtype)
    places = [slice(64), slice(13, 77), slice(993, 1000), slice(1, 8), slice(1), slice(5, 6)]
    function = functools.partial(lanewise.call, hostile)
    every = assert_bits_do_not_depend_on_the_batch(function, (x, k), places)
    x, k = starts(dtype, 64)
    along_1 = jax.jit(jax.vmap(lanewise.batched(hostile), (1, None), 1))
    found = along_1(x.reshape(8, 8), k[:8])
    expected = jax.jit(lanewise.batched(hostile))(x.reshape(8, 8)[:, 3], k[:8])
    assert_same(cut(found, (slice(None), 3)), expected)
    x, k = starts(dtype)
    assert_same(lanewise.batched(hostile)(x[:7], k[:7]), cut(every, slice(7)))
    assert not left


def test_numbers_below_the_normal_ones(left, threads):
    """They are replaced by zero on all threads, or on none."""

    def function(x):
        y, _ = lax.scan(lambda c, _: (c * 0.5 + x, None), x, None, length=300)
        return x * 1e-10, y * 1e-10, (x * 1e-10) * 1e10, jnp.exp(x - 740), x * 0.5**40

    x = np.linspace(1, 2, 20_000) * 1e-300
    batch = jax.jit(lanewise.batched(function))
    lanewise.set_threads(1)
    every = jax.tree.map(np.asarray, batch(x))
    lanewise.set_threads(0)
    for found in (*(batch(x) for _ in range(5)), *in_threads(lambda _: batch(x), 1)):
        assert_same(found, every)
    rows = lax.map(lanewise.batched(function), x.reshape(20, 1000))
    assert_same(jax.tree.map(lambda a: np.asarray(a).reshape(-1), rows), every)
    assert not left


def kepler_energy(t0, t1, q0, p0, q1, p1, args):
    return p1 @ p1 / 2 - args["K"] / jnp.sqrt(q1 @ q1)


def cubic(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + q0 @ q0 / 2 + jnp.sum(q0**3) / 6


def implicit_cubic(t0, t1, q0, p1, args):
    return (1 + 0.3 * q0 @ q0) * (p1 @ p1) / 2 + q0 @ q0 / 2 + jnp.sum(q0**3) / 6


def pendulum_energy(q, p, t, args):
    return p @ p / 2 - jnp.sum(jnp.cos(q))


KEPLER = {"system": SYSTEMS["kepler"][0], "args": {"K": 1.0}}
DOUBLE = {"system": SYSTEMS["double_pendulum"][0], "h": 0.05, "epsilon": 0.1}
PENDULUM = {"system": dvi.System(pendulum), "h": 0.1}
LAST = {"save": dvi.Save(final=True)}
RUNS = {
    "explicit": KEPLER | {"h": 0.02, "num_steps": 40, "method": dvi.Strang(),
        "save": dvi.Save(every=10), "observe": {"E": dvi.MaxDrift(kepler_energy)}},
    "streamed": KEPLER | LAST | {"h": 0.02, "num_steps": 100,
        "observe": [of(kepler_energy) for of in (dvi.MaxDrift, dvi.Trend, dvi.Mean)]},
    # Rows that wait in fast memory: more than two portions of them, and a rest.
    "all rows": PENDULUM | {"num_steps": 75},
    "implicit": DOUBLE | {"num_steps": 12},
    "Gauss": DOUBLE | {"num_steps": 5, "method": dvi.GaussLegendre(2)},
    "fixed point": PENDULUM | LAST | {"h": 0.05, "num_steps": 20, "method": dvi.Strang(),
        "arithmetic": dvi.FixedPoint(2.0**-40)},
    "stopped": KEPLER | LAST | {"h": 0.05, "num_steps": 60, "method": dvi.Strang(),
        "stop": dvi.Stop(lambda t, q, p, a: q[0] - 0.5),
        "observe": dvi.Section(lambda t, q, p, a: q[1], 0, max_crossings=2)},
    "single precision": PENDULUM | {"num_steps": 70},
    "Variational": {"system": dvi.System(dvi.discretise(pendulum_energy, order=2)), "h": 0.05,
        "num_steps": 12, "lattice": dvi.Variational()},
    "TimeTransformed": KEPLER | {"h": 0.05, "num_steps": 40,
        "lattice": dvi.TimeTransformed(lambda t, q, p, args: jnp.sqrt(q @ q))},
    "AdaptiveReversible": KEPLER | {"h": 0.05, "num_steps": 40, "method": dvi.Strang(),
        "lattice": dvi.AdaptiveReversible(lambda t, q, p, args: jnp.sqrt(q @ q))},
    # Trajectories that escape to infinity, each at a step of its own.
    "escape": {"system": dvi.System(cubic), "h": 0.1, "num_steps": 90, "save": dvi.Save(every=30)},
    "implicit escape": {"system": dvi.System(implicit_cubic), "h": 0.1, "num_steps": 90} | LAST,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_bits_of_runs(left, threads, name):
    def run(q, p):
        sol = dvi.integrate(q0=q, p0=p, throw=False, **RUNS[name])
        stats = {k: sol.stats[k] for k in ("failed_step", "newton_iterations") if k in sol.stats}
        return sol.qs, sol.ps, sol.ts, sol.result, sol.stop, sol.observed, stats

    dtype = "float32" if name == "single precision" else "float64"
    q, p = np.random.default_rng(1).uniform(0.3, 1.3, (2, 64, 2)).astype(dtype)
    q[:, 0] -= 0.9
    every = assert_bits_do_not_depend_on_the_batch(run, (q, p), [slice(30, 37)])
    failed = every[-1]["failed_step"]
    if "escape" in name:  # at different steps, which is what this run is for; and some do not
        steps = failed[failed >= 0]
        assert len(steps) < 64
        assert len(set(steps.tolist())) > 5
    else:
        assert np.all(np.isfinite(every[0][:5, 0]))
    if name != "fixed point":  # see `test_derivative_of_a_call_inside_of_generated_code`
        assert not left, left


def test_the_last_block_is_computed_after_the_one_that_it_overlaps(threads):
    """Results of this run are read again before they are final: by two threads at once, 24 of 1000
    trajectories were wrong in three calls of a hundred."""

    def times(q, p):
        return dvi.integrate(q0=q, p0=p, throw=False, **RUNS["AdaptiveReversible"]).ts

    q, p = np.random.default_rng(1).uniform(0.3, 1.3, (2, 64, 2))
    q, p = np.tile(q - [0.9, 0.0], (16, 1))[:1000], np.tile(p, (16, 1))[:1000]
    batch = jax.jit(jax.vmap(times))
    lanewise.set_threads(1)
    alone = np.asarray(batch(q, p))
    lanewise.set_threads(2)
    different = sum(not np.array_equal(batch(q, p), alone, equal_nan=True) for _ in range(500))
    assert different == 0


def looping(x, rare=True):
    """A state, its sum of distances, and when it first left a circle, a test of each round; 1/r and
    the sine and cosine of the new state are those of the next round."""

    def step(carry, k):
        q, total, left_at = carry
        r = jnp.sqrt(q @ q)
        s, c = jnp.sin(q[0]), jnp.cos(q[0])
        q = q + 0.05 * jnp.stack([c, s]) / r + 0.02 * x
        outside = jnp.sqrt(q @ q) > 2.5

        def note():
            return jnp.where(outside & (left_at < 0), k, left_at)

        left_at = lax.cond(lanewise.on_any(outside, rare=rare), note, lambda: left_at)
        total = total + jnp.where(k == 0, 0.0, 1 / jnp.sqrt(q @ q)) + jnp.sin(q[0]) * jnp.cos(q[0])
        return (q, total, left_at), q

    start = jnp.stack([jnp.cos(x), jnp.sin(x)]), jnp.zeros_like(x), jnp.asarray(-1)
    return lax.scan(step, start, jnp.arange(100))


def test_rounds_without_rare_branches(left):
    """The same bits with rounds that are run on assumptions and without; XLA's to round-off."""
    x, found = np.linspace(-2.0, 2.0, 37), []
    for rare in (False, True):
        function = functools.partial(looping, rare=rare)
        found.append(jax.tree.leaves(jax.jit(lanewise.batched(function))(x)))
    assert "store volatile" in lanewise.explain(looping, 1.0).parts[0].ir  # the state, to repeat
    assert_same(*found)
    expected = jax.tree.leaves(jax.jit(jax.vmap(looping))(x))
    assert 5 < np.sum(expected[2] < 0) < 32  # some trajectories need the branch, some do not
    np.testing.assert_array_equal(found[0][2], expected[2])
    assert_close(found[0], expected, 1e-11)
    assert not left


def exchanging(x, length=20):
    """A loop with branches: the functions of one number are needed a round later, of another one;
    of q, in the middle of a long sum, in a branch only and in an inner loop."""

    def step(carry, _):
        q, p = carry
        force = sum([jnp.sin(q) / jnp.sqrt(1 + q * q)] + [p / (k + 1.5) for k in range(length)])
        inner = lax.fori_loop(0, 3, lambda _, y: 0.5 * y + jnp.cos(q), p)
        p = p - 0.1 * lax.cond(lanewise.on_any(q > 0.5, rare=False), lambda: force, lambda: q)
        new = lax.cond(p > 0, lambda: jnp.cos(p) + inner, lambda: 0.5 * q)
        return (p, new + jnp.sin(new) + 1 / jnp.sqrt(1 + p * p)), new

    return lax.scan(step, (x, 0.3 * x), None, length=30)


@pytest.mark.parametrize(
    "function",
    [
        functools.partial(looping, rare=False),
        exchanging,
        pytest.param(functools.partial(exchanging, length=1200), marks=pytest.mark.slow),
    ],
)
def test_numbers_that_are_carried_to_the_next_round(monkeypatch, function):
    """The same bits as where each round computes them."""
    x = np.linspace(-2.0, 2.0, 37)
    carried = jax.tree.leaves(jax.jit(lanewise.batched(function))(x))
    ir = lanewise.explain(function, 1.0).parts[0].ir
    monkeypatch.setattr(rounds, "carried_over", lambda *_: [])
    jax.clear_caches()
    assert_same(jax.tree.leaves(jax.jit(lanewise.batched(function))(x)), carried)
    # In a round of more than 2000 numbers none is looked for.
    is_long = getattr(function, "keywords", {}).get("length", 0) > 1000
    assert (lanewise.explain(function, 1.0).parts[0].ir == ir) == is_long


@pytest.mark.parametrize("factor", [2.0, -0.5, 3.0])
def test_products_with_a_power_of_two_have_the_bits_of_a_batch(factor):
    """Alone the parameters are known before the loop, in a batch they are not."""

    def run(x, k):
        def step(x, _):
            inner = (k[1] * jnp.sin(x)) / factor + factor * (k[0] * x)
            outer = jax.grad(lambda x: k[0] * x * x / 2 - k[1] * factor * jnp.exp(-x * x))(x)
            x = x - 0.1 * (k[0] * x + inner) + 0.05 * (outer + factor * (k[1] * x))
            return x, x

        return lax.scan(step, x, None, length=30)[1]

    rng = np.random.default_rng(1)
    x, k = rng.normal(size=20), rng.uniform(0.5, 1.5, (20, 2))
    batch = lanewise.batched(run)(x, k)
    for i in range(20):
        np.testing.assert_array_equal(lanewise.call(run, x[i], k[i]), batch[i])
        np.testing.assert_array_equal(lanewise.batched(run, (0, None))(x, k[i])[i], batch[i])


def test_an_equation_without_a_use_takes_no_code():
    """The derivative of a cosine is computed with the cosine itself, which needs no code."""
    code = lanewise.explain(jax.jit(jax.grad(lambda x: jnp.cos(x) ** 2)), 1.0).parts[0].ir
    assert "@sincos" in code  # both are needed
    code = lanewise.explain(jax.jit(jax.grad(jnp.cos)), 1.0).parts[0].ir
    assert "@sin_" in code
    assert "cos" not in code


TABLE = np.sin(np.arange(300.0))


def rows_of(x, length, reverse=False):
    """(end, rows) of a well-conditioned recursion."""

    def step(c, _):
        c = 0.5 * jnp.sin(c) + 0.1 * x
        return c, jnp.stack([c, c * c])

    return lax.scan(step, x, None, length=length, reverse=reverse)


def with_start_and_tail(x):
    end, rows = rows_of(x, 200)
    return jnp.concatenate([jnp.stack([x, x])[None], rows, jnp.stack([end, end])[None]])


def start_at_the_end(x):
    _, rows = rows_of(x, 200, reverse=True)
    return jnp.concatenate([rows, jnp.stack([x, x])[None]])


def one_array_several_times(x):
    end, rows = rows_of(x, 150)
    twice = jnp.concatenate([rows, rows])
    return rows, rows, rows[::-1], rows.T, twice, rows.reshape(-1), rows[3:140:2], end


def saved_in_blocks(x):
    """As a run that saves every tenth step, the start in front."""

    def block(c, _):
        c, inner = rows_of(c, 10)
        return c, (c, inner)

    end, (ends, rows) = lax.scan(block, x, None, length=30)
    return jnp.concatenate([x[None], ends]), rows, end


def nested_and_reversed(x):
    def outer(c, k):
        c, inner = rows_of(c, 7, reverse=True)
        return c + 0.1 * k, (inner, c, k)

    return lax.scan(outer, x, jnp.arange(40), reverse=True)


def swapped_carry(x):
    def step(c, _):
        a, b, n = c
        return (b, 0.5 * a + 0.1 * b, n + 1), (a, b > a, n)

    return lax.scan(step, (x, 2 * x, 0), None, length=200)


def rows_that_do_not_vary(x):
    (_, total), rows = lax.scan(
        lambda c, k: ((c[0] + 1, c[1] + k * x), (c[0], k)), (0, x), jnp.asarray(TABLE)
    )
    return total, rows, jnp.asarray(TABLE), jnp.arange(200), jnp.zeros((5, 40))


def used_after_saving(x):
    end, rows = rows_of(x, 100)
    return rows, jnp.sum(rows, 0), rows[50] + end, jnp.max(rows)


def table(x):
    k = (jnp.abs(x) * 90).astype(int)
    values = jnp.asarray(TABLE)
    return values[k], lax.dynamic_slice(values, (k,), (5,)), jnp.sum(jnp.sin(values * x))


def index(x, count):
    return (x[0, 0] * count).astype(int)


LONG = RNG.normal(size=(9, 200))
WIDE = RNG.normal(size=(9, 20, 30))
VALUES = np.append(np.linspace(-2, 2, 8), 0.3)

CASES = {
    "start and tail": (with_start_and_tail, VALUES),
    "start at the end": (start_at_the_end, VALUES),
    "one array several times": (one_array_several_times, VALUES),
    "saved in blocks": (saved_in_blocks, VALUES),
    "nested and reversed": (nested_and_reversed, VALUES),
    "reversed": (lambda x: rows_of(x, 200, reverse=True), VALUES),
    "1000 rows": (lambda x: rows_of(x, 1000), VALUES),
    "old carry": (lambda x: lax.scan(lambda c, k: (0.9 * c + k, c), x, jnp.asarray(TABLE)), VALUES),
    "swapped carry": (swapped_carry, VALUES),
    "rows that do not vary": (rows_that_do_not_vary, VALUES),
    "used after saving": (used_after_saving, VALUES),
    "one trajectory": (lambda x: rows_of(x, 9), VALUES[:1]),
    "table": (table, VALUES),
    "long": (lambda x: (x, x + 1, jnp.sin(x) * x[3], x[::-1], jnp.where(x > 0, x, 2 * x)), LONG),
    "long and scanned": (lambda x: lax.scan(lambda c, z: (0.5 * c + z, c > z), 0.0, x), LONG),
    "long and indexed": (lambda x: (x[(x[0] * 60).astype(int)], x[5:9], x.reshape(20, 10).T), LONG),
    "long, joined": (lambda x: jnp.concatenate([x[:7], 2 * x, TABLE, x[None, 0]]), LONG),
    "wide": (lambda x: (x.T, x[3], x.reshape(30, 20), x.reshape(-1), x[:, 4] * x[2, 0]), WIDE),
    "wide and scanned": (lambda x: lax.scan(lambda c, z: (c + z[0], z[1:4] * c), 0.0, x.T), WIDE),
    "wide and sliced": (lambda x: lax.dynamic_slice(x, (index(x, 9), 3), (2, 10)), WIDE),
    "wide, turned and indexed": (
        lambda x: (x.T.reshape(-1)[::7], jnp.take(x.T, index(x, 600), mode="clip")), WIDE),
    "wide sum": (lambda x: (jnp.sum(x[:, :7], 0), jnp.max(x[:7, ::2], 1)), WIDE),
    "array of truth": (
        lambda x: (x & ~x[::-1], jnp.any(x), x[None].T, x.astype(float)), LONG[:, :5] > 0),
    "long truth": (lambda x: (~x, lax.scan(lambda c, z: (c ^ z, c), True, x)), LONG > 0),
    "int64": (lambda n: (n * n, n // 3, n % 7, n << 3, n > 2**40), np.arange(9) * 2**40 - 2**41),
    "uint32": (lambda n: (n * n, n // 3, n - 5, n > 2**31, n.astype(float)),
        (np.arange(9) * 2**29).astype("uint32")),
    "int8": (lambda n: (n * n, -n, n.astype("uint8"), n.astype(int)),
        (np.arange(9) * 31 - 128).astype("int8")),
    "no step": (lambda x: lax.scan(lambda c, _: (c + 1, c), x, None, length=0), VALUES),
    "empty": (lambda x: (x[None][:0], jnp.zeros((3, 0)), x), VALUES),
    "an empty operand": (lambda x: (x * 2, 1.0), np.zeros((9, 0))),
    "nothing to sort": (
        lambda x: (jnp.sort(x), jnp.argsort(x[None], axis=1), jnp.cumsum(x)), np.zeros((9, 0))
    ),
    "unsigned, inverted": (lambda n: ~n, np.arange(9, dtype="uint32")),
    "constants only": (lambda x: (1.0, jnp.arange(3), True), VALUES),
    "a call in a call": (
        lambda x: lanewise.call(lambda y: lanewise.call(jnp.sin, y) + y, x) * 2, VALUES),
    "a dictionary": (lambda x: {"a": x, "b": [x + 1, {"c": x * 2}]}, VALUES),
}  # fmt: skip


def shared_operands(wrap):
    def function(x, shared, small):
        c, rows = lax.scan(lambda c, z: (0.5 * c + z, c), 0.0, shared)
        return x * c, rows, shared[::-1], small[1] * x, shared * x, small

    return wrap(function, (0, None, None))(VALUES, TABLE, np.arange(3.0))


def other_axes(wrap):
    x, y = LONG[:2, :20].reshape(2, 4, 5), LONG[:2, :4]
    return jax.vmap(wrap(lambda x, y: (x * y[1], jnp.sin(x) @ y), (1, None)), (0, 0), 1)(x, y)


def closed_over(wrap):
    """A value that varies, one that does not, one that is known."""

    def function(x, outer):
        known = np.arange(3.0)
        return wrap(lambda y: jnp.sin(y) * x + outer[1] * known)(2 * x[None])

    return jax.vmap(function, (0, None))(VALUES, np.arange(4.0))


def loop_of_xla(wrap):
    def step(c, _):
        c = wrap(lambda x: 0.5 * jnp.sin(x) + 0.1)(c)
        return c, c[0]

    return lax.scan(step, VALUES, None, length=50)


def eight_calls(wrap):
    x = VALUES
    for k in range(8):
        x = wrap(lambda y, k=k: jnp.tanh(y * (k + 1)))(x)
    return x


@pytest.mark.parametrize("of", [shared_operands, other_axes, closed_over, loop_of_xla, eight_calls])
def test_batched_is_vmap(left, of):
    assert_close(*(jax.jit(lambda wrap=wrap: of(wrap))() for wrap in (lanewise.batched, jax.vmap)))
    assert not left


def test_calls_without_numbers_or_trajectories():
    assert jax.jit(lanewise.batched(lambda x: ()))(VALUES) == ()
    end, rows = jax.jit(lanewise.batched(lambda x: rows_of(x, 3)))(VALUES[:0])
    assert (end.shape, rows.shape) == ((0,), (0, 3, 2))
    assert float(lanewise.call(lambda x, k: x * k, 1.5, 2)) == 3.0  # numbers of Python


def test_single_precision_with_x64_switched_off(left):
    def function(x):
        return rows_of(x, 9), jnp.exp(x), x > 0, jnp.arange(3)

    with jax.enable_x64(False):
        found = jax.jit(lanewise.batched(function))(jnp.asarray(VALUES))
    assert (found[1].dtype, found[3].dtype) == (jnp.float32, jnp.int32)
    np.testing.assert_allclose(found[1], np.exp(VALUES), rtol=3e-7)
    np.testing.assert_allclose(found[0][1][0], rows_of(jnp.asarray(VALUES[0]), 9)[1], rtol=1e-5)
    assert not left


@jax.custom_vjp
def with_a_rule(x):
    return jnp.sin(x)


with_a_rule.defvjp(lambda x: (jnp.sin(x), x), lambda x, g: (2 * g * jnp.cos(x),))


def late_to_vary(x):
    """A number that varies between trajectories reaches a carry after several rounds."""

    def step(c, _):
        a, b, d, n = c
        return (b, d, x * 0.5, n), (a, b, n)

    return lax.scan(step, (0.0, 0.0, 0.0, 3), None, length=6)


def same_number_of_rounds(x):
    def body(c):
        k, y, _ = c
        return k + 1, y * 0.5 + x, lax.cond(k > 2, lambda: y + 1, lambda: 0.0)

    return lax.while_loop(lambda c: c[0] < 5, body, (0, 0.0, 0.0))


def rows_in_a_branch(x):
    def rows(x):
        return lax.scan(lambda c, _: (c * 0.5 + 1, c), x, None, length=5)

    return lax.cond(x > 0, rows, lambda x: (x, jnp.zeros(5)), x)


def on_any_in_a_branch(x):
    def positive(x):
        return jnp.where(x > 0, jnp.sin(x), x)

    return lax.cond(lanewise.on_any(x > 0), positive, lambda x: x, x)


def rows_in_a_while_loop(x):
    def body(c):
        k, rows, y = c
        return k + 1, rows.at[k].set(y), jnp.sin(y) + 1

    return lax.while_loop(lambda c: (c[0] < 6) & (c[2] < 1.9), body, (0, jnp.zeros(6), x))


def of_truth(x):
    a, b = x > 0, x > 1
    rows = jnp.stack([a, x < 1])
    return a * 2.0, a + b, a == b, a < b, jnp.maximum(a, b), jnp.sum(rows), jnp.cumsum(rows)


def a_root(x):
    def newton(f, start):
        return lax.fori_loop(0, 20, lambda _, y: y - (y**3 - x) / (3 * y * y + 1e-9), start + 2)

    return lax.custom_root(lambda y: y**3 - x, x, newton, lambda g, y: y / g(1.0))


def tables(x):
    """Look-ups in a table, at its nodes and outside too."""
    nodes = np.array([-1.0, 0.0, 0.5, 2.0])
    return (
        jnp.interp(x, nodes, nodes**2),
        jnp.interp(x, nodes, nodes**2, left=-7.0, right=7.0),
        jnp.searchsorted(nodes, x),
        jnp.searchsorted(nodes, x, side="right"),
        jnp.digitize(x, nodes),
    )


def orders(x):
    """Ties, zeros of both signs, NaN and infinities among what is sorted."""
    row = jnp.stack([x, -x, x / 2, x * 0, jnp.abs(x), jnp.ones(())])
    whole = jnp.round(row).astype(jnp.int32)
    return (
        jnp.sort(row),
        jnp.argsort(row),
        jnp.sort(row, descending=True),
        jnp.argsort(whole, stable=True),
        jnp.lexsort((row, whole)),
        jnp.median(row),
    )


def neighbours(x):
    return [jnp.nextafter(x, y) for y in (0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, x)]


def small_systems(m):
    """Factors and solutions of small systems, exchanges of rows included."""
    positive = m @ m.T + jnp.eye(3)
    return (
        jnp.linalg.inv(m),
        jnp.linalg.solve(m, m[0]),
        jnp.linalg.solve(m.T, m),
        jax.scipy.linalg.lu_factor(m),
        jnp.linalg.cholesky(positive),
        jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(positive), True), m[1]),
        jax.scipy.linalg.solve_triangular(m, m[2], trans=1, unit_diagonal=True),
        jax.grad(lambda y: jnp.linalg.solve(y, y[0] ** 2).sum())(m),
        jnp.linalg.slogdet(m),
    )


def stacks_of_systems(m):
    """As many small systems at once as there are stages of a method."""
    two = jnp.stack([m, m.T])
    return (
        jnp.linalg.solve(two, m[:2, :, None]),
        jnp.linalg.cholesky(two @ jnp.swapaxes(two, 1, 2) + jnp.eye(3)[None]),
        jax.vmap(jnp.linalg.inv)(two),
        jnp.linalg.det(two[None]),
    )


def rounds_of_each_row(m):
    """While loops under vmap: their condition is an array."""

    def halved(row, most):
        def proceed(state):
            return (jnp.abs(state[0]).max() > most) & (state[1] < 9)

        return lax.while_loop(proceed, lambda state: (state[0] / 2, state[1] + 1), (row, 0))

    def inner(row):  # in a loop whose condition is an array too
        x, n = halved(row, 0.3)
        return jax.vmap(halved, (None, 0))(x, jnp.array([0.2, 0.01])), n

    bounds = jnp.array([0.1, 0.5, 9.0])
    return jax.vmap(halved)(m, bounds), jax.vmap(halved, (None, 0))(m[0], bounds), inner(m[1])


def used_twice(x):
    """Written out, it has 2^40 operands: what one round shares with the next took for ever."""

    def step(y, _):
        z = y
        for _ in range(40):
            z = jnp.sqrt(0.25 + 0.5 * z * z)
        z = lax.cond(lanewise.on_any(z > 9.0), lambda: 0.5 * z, lambda: z)
        return 0.5 * z, z

    return lax.scan(step, x, None, length=9)


def energy_like(x, y, n):
    end, rows = rows_of(x[0], 5)
    return jnp.sum(rows) * y + jnp.sin(x[1]) / y + n * end


MATRICES = RNG.normal(size=(9, 3, 3))
FUNCTIONS = {
    "sine of a literal": (lambda x: lax.sin(0.3) * lax.cos(x) + lax.sin(x) + lax.cos(0.3), VALUES),
    "tables": (tables, VALUES),
    "orders": (orders, VALUES),
    "neighbours": (neighbours, VALUES),
    "small systems": (small_systems, np.append(MATRICES, np.eye(3)[[[1, 2, 0], [2, 1, 0]]], 0)),
    "stacks of systems": (stacks_of_systems, MATRICES),
    "determinant of four": (
        lambda m: jax.value_and_grad(jnp.linalg.det)(jnp.pad(m, (0, 1)) + jnp.eye(4)), MATRICES),
    "a derivative's rule": (jax.grad(with_a_rule), VALUES),
    "late to vary": (late_to_vary, VALUES),
    "same number of rounds": (same_number_of_rounds, VALUES),
    "rows in a branch": (rows_in_a_branch, VALUES),
    "on_any": (on_any_in_a_branch, VALUES),
    "rows in a while loop": (rows_in_a_while_loop, VALUES),
    "truth": (of_truth, VALUES),
    "root": (a_root, np.abs(VALUES)),
    "matrices": (
        lambda m: (jnp.einsum("ij,jk->ki", m, m), jnp.kron(m[0], m[1]), jnp.tensordot(m, m, 2),
            lax.dot(m.astype(jnp.float32), m, preferred_element_type=jnp.float64), m.std(),
            jnp.linalg.norm(m[0]), jnp.cross(m[0], m[1]), jnp.tril(m), jnp.roll(m, 1)), MATRICES),
    "along axes": (
        lambda m: (jnp.diff(m), jnp.cumsum(m), jnp.prod(m, 0), m.argmax(), jnp.repeat(m, 2, 0)),
        MATRICES),
    "axes in another order": (
        lambda m: (jax.vmap(jnp.prod, in_axes=1)(m), jax.vmap(jax.grad(jnp.prod), in_axes=1)(m),
            lax.reshape(m, (9,), dimensions=(1, 0)),
            jax.jacfwd(jax.vmap(lambda z: jnp.prod(z[0])))(jnp.stack([m[:2], m[1:]]))), MATRICES),
    "rounds of each row": (rounds_of_each_row, MATRICES),
    "map": (lambda m: lax.map(lambda r: jnp.sin(r).sum(), m), MATRICES),
    "hessian": (lambda m: jax.hessian(lambda y: jnp.sum(jnp.sin(y) * y[0]))(m[0]), MATRICES),
    "derivatives inside": (
        lambda x: (jax.grad(energy_like)(x, 1.5, 2), jax.jacfwd(lambda x: jnp.sin(x) * x[0])(x)),
        MATRICES[:, 0, :2]),
    "derivative of a call": (
        jax.grad(lambda x: lanewise.call(lambda z: jnp.sin(z) * z, x)), VALUES),
    "used twice": (used_twice, VALUES),
    "bits": (lambda x: lax.bitcast_convert_type(x, jnp.int64), VALUES),
    "product with an empty sum": (
        lambda x: lax.dot(jnp.zeros(0), jnp.zeros(0)) * x, np.full(9, np.nan)),
}  # fmt: skip


QUICK = {
    "start and tail", "saved in blocks", "rows that do not vary", "table", "long and scanned",
    "wide sum", "long truth", "uint32", "int8", "no step", "an empty operand", "a call in a call",
    "tables", "stacks of systems", "late to vary", "rows in a branch", "rows in a while loop",
    "truth", "root", "along axes", "used twice", "rounds of each row", "derivatives inside",
    "product with an empty sum",
}  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in (*CASES, *FUNCTIONS)],
)
def test_functions(left, name):
    function, x = CASES.get(name) or FUNCTIONS[name]
    found, expected = jax.jit(lanewise.batched(function))(x), jax.jit(jax.vmap(function))(x)
    assert_close(found, expected, 1e-13 if name in CASES else 1e-12)
    assert not left, left


def test_constants_give_short_code_and_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        least = jax.device_put(np.int32(-(2**31)))
        found = jax.jit(lanewise.batched(lambda x: (-least) * x))(np.arange(9, dtype="int32"))
    np.testing.assert_array_equal(found[:3], [0, -(2**31), 0])
    (part,) = lanewise.explain(lambda x: jnp.full((128,), x), 1.0).parts
    assert max(block.count("\n") for block in part.ir.split(":\n")) < 3000


@pytest.mark.slow
def test_derivatives():
    x, y, n = RNG.normal(size=(9, 2)), RNG.uniform(1, 2, 9), np.arange(9)

    def total(wrap):
        return lambda x, y: jnp.sum(wrap(energy_like)(x, y, n) ** 2)

    for wrap in (lanewise.batched, lambda f: jax.vmap(lambda *a: lanewise.call(f, *a))):
        found = jax.jit(jax.grad(total(wrap), (0, 1)))(x, y)
        assert_close(found, jax.jit(jax.grad(total(jax.vmap), (0, 1)))(x, y), 1e-12)
    direction = (np.ones((9, 2)), np.linspace(0, 1, 9))
    found = jax.jit(lambda *a: jax.jvp(total(lanewise.batched), a, direction))(x, y)
    assert_close(found, jax.jit(lambda *a: jax.jvp(total(jax.vmap), a, direction))(x, y), 1e-12)
    one = jax.grad(lambda x: lanewise.call(energy_like, x, y[0], n[0]))(x[0])
    assert_close(one, jax.grad(energy_like)(jnp.asarray(x[0]), y[0], n[0]), 1e-12)


@pytest.mark.parametrize(
    "n", [1, 3, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 6, 20))]
)
def test_an_exchange_of_rows_on_one_trajectory(left, n):
    """It does not change a bit of the others, and is needed for the right result."""
    rng = np.random.default_rng(n)
    A, b = rng.normal(size=(16, n, n)) + 6 * np.eye(n), rng.normal(size=(16, n))
    solve = jax.jit(lanewise.batched(lanewise.solve))
    plain = np.asarray(solve(A, b))
    np.testing.assert_allclose(plain, np.linalg.solve(A, b[..., None])[..., 0], rtol=1e-12)
    if n == 1:
        return
    A[5] = A[5][::-1]
    A[5, 0, 0] = 0.0
    found = np.asarray(solve(A, b))
    others = np.arange(16) != 5
    assert_same(found[others], plain[others])
    np.testing.assert_allclose(found[5], np.linalg.solve(A[5], b[5]), rtol=1e-11)
    A[5, 0] = 0.0
    assert not np.any(np.isfinite(solve(A, b)[5]))
    A[5] = np.nan
    assert_same(np.asarray(solve(A, b))[others], plain[others])
    assert not left


def test_several_right_hand_sides_share_the_elimination_of_their_matrix(left):
    """Of two matrices on each trajectory, in generated code and in XLA."""
    A, B = RNG.normal(size=(9, 6, 6)), RNG.normal(size=(9, 6, 5))

    def columns(A, B):
        return jax.vmap(lanewise.solve, (None, 1), 1)(A, B)

    def both(A, B):
        return jax.vmap(columns, (0, None))(jnp.stack([A, A.T]), B)

    expected = np.linalg.solve(np.stack([A, A.swapaxes(1, 2)], 1), B[:, None])
    assert_close(jax.jit(lanewise.batched(both))(A, B), jnp.asarray(expected), 1e-11)
    assert not left
    assert_close(jax.jit(jax.vmap(both))(A, B), jnp.asarray(expected), 1e-11)
    one, five = (operations(columns, A[0], B[0, :, :k]) for k in (1, 5))
    assert five - one <= 4 * (2 * 6**2)


def test_an_unknown_parameter_is_left_to_xla():
    """Of a primitive that moves numbers: a rule that does not know it might move them wrongly."""
    of = {"new_sizes": (4,), "dimensions": None, "sharding": None}
    x = np.arange(4.0).reshape(2, 2)
    np.testing.assert_array_equal(moves.move_entries("reshape", of, x)[0], [0, 1, 2, 3])
    of["dimensions"] = (1, 0)
    np.testing.assert_array_equal(moves.move_entries("reshape", of, x)[0], [0, 2, 1, 3])
    with pytest.raises(NotCompilable, match="unknown parameters: order"):
        moves.move_entries("reshape", {**of, "order": "F"}, x)


def operations(function, *args):
    (part,) = lanewise.explain(function, *args).parts
    return part.operations


def refusing(name, is_suited=True):
    """A target that has no code for anything."""

    def write(closed, on, lanes, width):
        raise NotCompilable(f"refused by {name}")

    return SimpleNamespace(name=name, suits=lambda closed: is_suited, write=write)


def test_targets_and_their_parameters():
    program = primitive.Callee(Trace.from_function(jnp.sin, [1.0], jax.tree.structure((1.0,))))
    targets = [refusing("unsuited", False), refusing("first"), *TARGETS["cpu"], refusing("last")]
    result = compiled_by(targets, program, [True], 8)
    assert result.target is TARGETS["cpu"][-1]  # no long arrays
    assert result.reasons == {"first": "refused by first"}
    with pytest.raises(NotCompilable, match="refused by a; refused by b"):
        compiled_by([refusing("a"), refusing("b")], program, [True], 8)
    code = Code("", 8, values=(100, 7), operations=5)
    outs = [jax.ShapeDtypeStruct((3,), np.float64), jax.ShapeDtypeStruct((), np.int32)]
    # Trajectories, operations × longest loop, bytes of each result, values.
    np.testing.assert_array_equal(code.params(16, outs), [16, 500, 24, 4, 100, 7])


def newton(residual):
    def step(x):
        value, push = jax.linearize(residual, x)
        return lanewise.solve(
            jax.vmap(push, out_axes=1)(lanewise.unit_vectors(x.size, x.dtype)), value
        )

    return step


def tridiagonal(x):
    inside = jnp.concatenate([jnp.zeros(1), x, jnp.zeros(1)])
    return x + 0.1 * jnp.sin(inside[2:] - x) + 0.1 * jnp.sin(inside[:-2] - x)


def dense(x):
    return x + 0.01 * jnp.sum(jnp.sin(x)) * x


def test_a_band_takes_fewer_operations():
    x = np.linspace(0, 1, 8)
    band, full = operations(newton(tridiagonal), x), operations(newton(dense), x)
    assert 2 * band < full
    found = jax.jit(lanewise.batched(newton(tridiagonal)))(np.stack([x, 2 * x]))
    right = np.linalg.solve(jax.jacfwd(tridiagonal)(x), tridiagonal(x))
    np.testing.assert_allclose(found[0], right, rtol=1e-12)


CODE = "define i64 @number() {\n  ret i64 NUMBER\n}\n"


def number(value):
    """What compiled code gives that gives this number."""
    engine = machine.load(CODE.replace("NUMBER", str(value)))
    return ctypes.CFUNCTYPE(ctypes.c_int64)(engine.get_function_address("number"))()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    where = tmp_path / "code"
    monkeypatch.setenv(cache.VARIABLE, str(where))
    return where


@pytest.fixture
def made(monkeypatch):
    """The modules that were compiled, not read."""
    texts, original = [], machine.object_code

    def counted(ir, *more):
        texts.append(ir)
        return original(ir, *more)

    monkeypatch.setattr(machine, "object_code", counted)
    return texts


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_cache_is_read(folder, made):
    assert number(41) == 41
    first = names(folder)
    assert (number(41), names(folder), len(made)) == (41, first, 1)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert number(42) == 42
    assert len(names(folder)) == 2


@pytest.mark.parametrize("damage", ["cut", "changed", "empty", "of other code"])
def test_a_damaged_file_is_replaced(folder, made, damage):
    number(42)
    (other,) = folder.iterdir()
    number(41)
    (file,) = (p for p in folder.iterdir() if p != other)
    good = file.read_bytes()
    bad = {"cut": good[:-9], "changed": good[:50] + b"?" + good[51:], "empty": b""}
    file.write_bytes(bad.get(damage, other.read_bytes()))
    assert number(41) == 41
    assert (file.read_bytes(), len(made)) == (good, 3)


@pytest.mark.parametrize("length", [0, 20, 200])
def test_a_disk_that_is_full_at_any_byte_leaves_no_file(folder, made, monkeypatch, length):
    @contextlib.contextmanager
    def cut(handle, mode):
        def write(content):
            file.write(content[:length])
            raise OSError(errno.ENOSPC, "No space left on device")

        with open(handle, mode) as file:
            yield SimpleNamespace(write=write)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fdopen", cut)
        assert (number(41), names(folder)) == (41, [])
    (folder / ".new-left-by-a-dead-process").write_bytes(b"some of it")
    assert (number(41), number(41), len(made)) == (41, 41, 2)


def test_default_folder_and_cache_switched_off(tmp_path, monkeypatch, made):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv(cache.VARIABLE, raising=False)
    assert cache.folder() == tmp_path / ".cache" / "dvi_jax"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.folder() == tmp_path / "dvi_jax"
    monkeypatch.chdir(tmp_path)
    for off in ("off", "OFF", "0"):
        monkeypatch.setenv(cache.VARIABLE, off)
        assert number(41) == number(41) == 41
    assert (len(made), list(tmp_path.iterdir())) == (6, [])


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702])
def test_a_folder_that_others_can_write_to_is_not_read(folder, made, mode):
    number(41)
    (file,) = folder.iterdir()
    folder.chmod(mode)
    assert (number(41), len(made)) == (41, 2)
    number(42)
    assert names(folder) == [file.name]


def test_folders_that_cannot_be_made_or_trusted(tmp_path, monkeypatch, made):
    (tmp_path / "file").write_text("")
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs").chmod(0o777)
    (tmp_path / "link").symlink_to(tmp_path / "theirs")
    for where in ("file/code", "link"):
        monkeypatch.setenv(cache.VARIABLE, str(tmp_path / where))
        assert number(41) == number(41) == 41
    assert (len(made), names(tmp_path / "theirs")) == (4, [])


def test_the_oldest_files_are_removed(folder, monkeypatch):
    number(41)
    (file,) = folder.iterdir()
    size = file.stat().st_size
    monkeypatch.setattr(cache, "LARGEST", 8 * size + size // 2)
    order = [file.name]
    for k in range(7):
        os.utime(file, (1, 1))
        number(100 + k)
        for path in folder.iterdir():
            if path.name not in order:
                order.append(path.name)
                os.utime(path, (k + 2, k + 2))
    number(41)  # its use makes it the newest
    number(200)
    kept = names(folder)
    assert len(kept) == 6
    assert order[0] in kept
    assert not {*order[1:4]} & {*kept}
    assert sum(p.stat().st_size for p in folder.iterdir()) <= 0.75 * cache.LARGEST


PROGRAM = """
import jax, jax.numpy as jnp, numpy as np, lanewise
jax.config.update("jax_enable_x64", True)
found = jax.jit(lanewise.batched(lambda x: jnp.sin(x) + x))(np.arange(9.0))
np.testing.assert_allclose(found, np.sin(np.arange(9.0)) + np.arange(9.0), rtol=1e-15)
print("correct")
"""


def finished(count, **environment):
    """Run PROGRAM in `count` processes at once."""
    run = [sys.executable, "-c", PROGRAM]
    how = {"env": {**os.environ, "JAX_PLATFORMS": "cpu", **environment}, "text": True}
    how |= {"cwd": Path(__file__).parent.parent, "stdout": subprocess.PIPE}
    for one in [subprocess.Popen(run, stderr=subprocess.STDOUT, **how) for _ in range(count)]:
        out, _ = one.communicate(timeout=200)
        assert (one.returncode, "correct" in out) == (0, True), out


@pytest.mark.slow
def test_processes_share_the_cache(tmp_path):
    """Two at once make the same files; a third one makes no new file."""
    found = []
    for count in (2, 1):
        finished(count, DVI_JAX_CACHE=str(tmp_path))
        found.append({p.name: p.stat().st_ino for p in tmp_path.iterdir()})
    assert len(found[0]) == 2  # the runtime and the kernel
    assert found[0] == found[1]


@pytest.mark.slow
def test_compilation_cache_of_jax(tmp_path):
    """A program that JAX reads from its own cache finds our handler."""
    settings = {
        "DVI_JAX_CACHE": str(tmp_path / "ours"), "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }  # fmt: skip
    found = []
    for _ in range(2):
        finished(1, **settings)
        found.append([p for p in names(tmp_path / "jax") if not p.endswith("-atime")])
    assert found[0] == found[1] != []


def test_switched_off(left, monkeypatch):
    found = jax.jit(lanewise.batched(table))(VALUES)
    layout = lanewise.Layout(form="arrays")
    assert_close(jax.jit(lanewise.batched(table, layout=layout))(VALUES), found)
    monkeypatch.setenv("LANEWISE", "off")
    assert not lanewise.generates()
    assert_close(jax.jit(lanewise.batched(table))(VALUES), found)
    assert len(left) == 2


@pytest.mark.parametrize(
    ("setting", "is_on"), [("", True), (" On ", True), ("NO", False), ("0", False), ("1", True)]
)
def test_words_of_the_switch(monkeypatch, setting, is_on):
    monkeypatch.setenv("LANEWISE", setting)
    with warnings.catch_warnings(action="error"):
        assert lanewise.generates() == is_on


@pytest.mark.parametrize("default", [True, False])
def test_a_wrong_word_of_a_switch_warns_once(monkeypatch, default):
    monkeypatch.setenv("LANEWISE_TEST", f"maybe{default}")
    with pytest.warns(UserWarning, match="neither on nor off.*as LANEWISE_TEST=o[nf]") as seen:
        assert [switches.is_on("LANEWISE_TEST", default) for _ in range(2)] == [default] * 2
    assert len(seen) == 1


def test_one_warning_where_code_cannot_be_generated(left, monkeypatch):
    monkeypatch.setitem(sys.modules, "llvmlite.binding", None)  # as if it were not installed
    for module, name in ((machine, "start_llvm"), (primitive, "_can_start")):  # not called before
        monkeypatch.setattr(module, name, machine.once(getattr(module, name).__wrapped__))
    with pytest.warns(UserWarning, match="machine code") as seen:
        found = [jax.jit(lanewise.batched(lambda x, s=s: s * x))(VALUES) for s in (2, 3)]
    np.testing.assert_array_equal(found, [2 * VALUES, 3 * VALUES])
    (warning,) = seen
    assert "ImportError: " in str(warning.message)
    assert "pip install --force-reinstall llvmlite" in str(warning.message)
    assert len(left) == 2


def called_back(x):
    return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), float), x, vmap_method="expand_dims")


LEFT = {
    "sort": lambda x: jnp.sort(x * jnp.arange(20.0)),
    "callback": called_back,
    "fft": lambda x: jnp.abs(jnp.fft.fft(jnp.stack([x, 2 * x]))),
    "complex": lambda x: jnp.stack([x + 1j, x]).real,
    "eigvalsh": lambda x: jnp.linalg.eigvalsh(jnp.diag(jnp.stack([x, 2 * x]))),
    "random": lambda x: jax.random.uniform(jax.random.key(0)) * x,
    "callback in scan": lambda x: lax.scan(lambda c, _: (c, called_back(c)), x, None, length=3),
    "bfloat16": lambda x: x.astype(jnp.bfloat16).astype(float),
    "batch": lambda x: lanewise.batched(lambda y: y + jnp.sin(y))(jnp.stack([x, 2 * x])),
}


@pytest.mark.parametrize("name", LEFT)
def test_what_is_left_to_xla(left, name):
    found = jax.jit(lanewise.batched(LEFT[name]))(VALUES)
    assert left
    assert_close(found, jax.jit(jax.vmap(LEFT[name]))(VALUES))


def loops_around_a_callback(x, y):
    """Two loops, what is between them, and results that are not computed."""
    first = lax.fori_loop(0, 20, lambda _, z: 0.9 * z + 0.1 * jnp.sin(z + y), x)
    between = jax.jit(lambda z: called_back(z) + lax.fori_loop(0, 3, lambda _, u: u * z, z))(first)
    last = lax.fori_loop(0, 20, lambda _, z: 0.9 * z, between)
    return last, called_back(last) + 1.0, x, 3.0, y


def test_loops_around_a_callback_or_a_sort_are_compiled(left):
    found = jax.jit(lanewise.batched(loops_around_a_callback, in_axes=(0, None)))(VALUES, 0.3)
    expected = jax.jit(jax.vmap(loops_around_a_callback, in_axes=(0, None)))(VALUES, 0.3)
    assert_close(found, expected)
    assert len(left) == 2  # one for each callback
    alone = jax.jit(lambda x: lanewise.call(loops_around_a_callback, x, 0.3))(VALUES[1])
    assert_close(alone, [x[1] for x in found])
    parts = lanewise.explain(loops_around_a_callback, 1.0, 0.3).parts
    kinds = ["code" if p.reason is None else p.reason.split()[-1] for p in parts]
    assert kinds == ["code", "pure_callback", "code", "code", "pure_callback"]

    def function(x):
        row = jnp.sort(lax.fori_loop(0, 5, lambda _, z: 0.9 * z, x * jnp.arange(20.0)))
        return lax.fori_loop(0, 5, lambda _, z: jnp.sin(z), row[-1])

    found = jax.jit(jax.vmap(jax.grad(lambda x: lanewise.call(function, x))))(VALUES[:5])
    assert_close(found, jax.jit(jax.vmap(jax.grad(function)))(VALUES[:5]))


def test_loops_that_are_too_large_together_end_in_xla(left, monkeypatch):
    """Each loop could be compiled, the function of both cannot: no search without an end."""
    monkeypatch.setattr(extent, "MOST_OPERATIONS", 12)
    monkeypatch.setattr(extent, "FOR_AN_EQUATION", 0)

    def loop(x):
        return lax.fori_loop(0, 3, lambda _, y: jnp.sin(jnp.sin(jnp.sin(y) + x) + x), x)

    def function(x):
        return loop(loop(loop(x)))

    assert_close(jax.jit(lanewise.batched(function))(VALUES), jax.jit(jax.vmap(function))(VALUES))
    assert len(left) == 1


PROCESSORS = [
    ("x86_64", "haswell", "+avx2,+fma", 62),
    ("x86_64", "skylake-avx512", "+avx512f,+avx512dq,+avx512vl,-prefer-256-bit", 62),
    ("x86_64", "x86-64", "", 62),
    ("aarch64", "neoverse-n1", "", 183),
]


@pytest.mark.slow
@pytest.mark.parametrize("width", [2, 4, 8])
def test_code_for_other_processors(width):
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()

    def function(x, k):
        q = jnp.where(k > 2, jnp.sin(x), x / 3)
        return rows_of(q, 200), jnp.any(x > 0), jnp.asarray(TABLE)[k], k.astype("float32")

    (part,) = lanewise.explain(function, 1.0, np.int32(3), batch=width).parts
    for kind, cpu, features, code in PROCESSORS:
        target = machine.target_machine(f"{kind}-unknown-linux-gnu", cpu, features)
        made = machine.object_code(part.ir, target)
        assert made[:4] == b"\x7fELF"
        assert int.from_bytes(made[18:20], "little") == code


def test_export_refuses():
    """A handler lives in this process only."""
    function = jax.jit(lanewise.batched(jnp.sin))
    with pytest.raises(ValueError, match="custom call"):
        export.export(function)(jax.ShapeDtypeStruct((9,), float)).serialize()


def in_threads(work, count=8):
    """What ``work(i)`` gives in thread i, all of which begin at once."""
    found, barrier = [None] * count, threading.Barrier(count, timeout=60)

    def begin(i):
        barrier.wait()
        found[i] = jax.tree.map(np.asarray, work(i))

    workers = [threading.Thread(target=begin, args=(i,)) for i in range(count)]
    for w in workers:
        w.start()
    for w in workers:
        w.join(100)
    return found


def test_a_choice_between_an_array_and_itself_copies_nothing():
    table = jnp.linspace(0.0, 1.0, 4096)

    def jumps(other):
        def lookup(x, table):
            return jnp.where(x > 0.5, table, other(table))[jnp.int32(x * 4000)]

        return lanewise.explain(lookup, 0.3, table).parts[0].ir.count("br label")

    assert jumps(lax.stop_gradient) == 2  # the loop over the blocks
    assert jumps(lambda table: 2 * table) > 2  # the control, with loops over the table


def test_threads_that_begin_together_start_llvm_once():
    """Two devices of a sweep began together, and one of them got XLA's digits."""
    starts = []

    @machine.once
    def start():
        time.sleep(0.05)
        starts.append(threading.get_ident())
        return starts

    assert in_threads(lambda i: id(start())) == [id(starts)] * 8
    assert len(starts) == 1


def test_eight_python_threads(left, threads):
    for count in (1, 2, 64, 0):
        lanewise.set_threads(count)
        assert lanewise.get_threads() == count
    function = jax.jit(lanewise.batched(lambda x: rows_of(x, 300)))
    x = RNG.normal(size=(8, 200))
    expected = [jax.tree.map(np.asarray, function(row)) for row in x]
    found = in_threads(lambda i: [jax.block_until_ready(function(x[i])) for _ in range(5)][-1])
    assert_same(found, expected)
    compiled = in_threads(lambda i: jax.jit(lanewise.batched(lambda x: x * (i // 2) + 1))(VALUES))
    assert_same(compiled, [VALUES * (i // 2) + 1 for i in range(8)])
    assert not left


def test_constant_arrays_of_every_type(left):
    """Numbers that are known while the code is made."""

    values = [np.array([0.1, np.inf, -np.inf, np.nan, -0.0, 5e-324, 1e308])]
    values += [np.array([0.1, np.inf, np.nan, 1e-45, 3e38], "float32")]
    values += [np.array([-(2**63), 2**63 - 1]), np.array([2**64 - 1, 0], "uint64")]
    values += [np.array([True, False]), np.array([-128, 127], "int8")]
    values += [np.resize(v, 150) for v in values]
    found = jax.jit(lanewise.batched(lambda x: [jnp.asarray(v) for v in values]))(VALUES[:3])
    for a, b in zip(found, values, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, np.broadcast_to(b, a.shape))
    assert not left


def test_long_chains_of_operations_need_no_deep_stack():
    """A trace within traces has little of Python's stack left."""

    def step(x, _):
        z = x
        for _ in range(90):
            z = z + 0.1 * z * z
        return lax.cond(lanewise.on_any(~jnp.isfinite(z)), lambda: x, lambda: z), None

    before = sys.getrecursionlimit()
    try:
        sys.setrecursionlimit(len(inspect.stack()) + 160)
        (part,) = lanewise.explain(lambda x: lax.scan(step, x, None, length=5)[0], 1.0).parts
    finally:
        sys.setrecursionlimit(before)
    assert "store volatile" in part.ir  # rounds on assumptions, which need to know what is finite


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_quotients_by_a_parameter_of_a_loop_are_rounded_to_the_nearest(left, dtype):
    """They are made by products with the reciprocal; NumPy divides."""
    info, unsigned = np.finfo(dtype), {"float64": np.uint64, "float32": np.uint32}[dtype]
    most = -info.minexp // 3
    rng, shape = np.random.default_rng(3), (40, 3000)

    def numbers(*shape):
        sign, exponent = rng.choice([-1, 1], shape), rng.integers(-most, most + 1, shape)
        return np.ldexp(sign * rng.uniform(1, 2, shape), exponent).astype(dtype)

    x, b = numbers(*shape), numbers(shape[0])
    ends = [0.0, -0.0, np.inf, -np.inf, np.nan, 1.0, -3.0]
    x[:, : len(ends)] = ends
    b[: len(ends)] = ends
    # Quotients that leave the range.
    x[:, 8:12] = [info.max, -info.max, info.tiny * 1e6, -info.tiny * 1e6]

    def divided(x, b):
        return lax.scan(lambda _, x: (0.0, (x / b, x * (1 / b))), 0.0, x)[1]

    found, naive = map(np.asarray, jax.jit(lanewise.batched(divided))(x, b))
    with np.errstate(all="ignore"):
        expected = x / b[:, None]
    # Subnormal numbers are zero, and a bound of the range is not exact.
    normal = (expected == 0) | (np.abs(expected) > info.tiny) | np.isnan(expected)
    differs = (found.view(unsigned) != expected.view(unsigned)) & ~(
        np.isnan(found) & np.isnan(expected)
    )
    assert not np.any(differs & normal)
    assert np.mean(naive != expected) > 0.2  # a product with the reciprocal is often the neighbour
    assert np.all(normal | (found == 0) | (np.abs(found) <= info.tiny))
    assert not left
