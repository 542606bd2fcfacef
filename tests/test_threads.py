"""Batches cut over threads: the same numbers, whatever the number of pieces."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

STEPS = 5


def one(q, p, k=1.0):
    system = dvi.System(lambda t0, t1, q, p, k: p @ p / 2 + k * jnp.sum(q**4) / 4)
    sol = dvi.integrate(system, q, p, h=0.1, num_steps=STEPS, args=k, throw=False)
    return {"qs": sol.qs, "result": sol.result}


def starts(lanes, axis=0):
    rng = np.random.default_rng(0)
    return (np.moveaxis(rng.normal(size=(lanes, 2)), 0, axis) for _ in range(2))


def assert_same(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("lanes", "threads"), [(8, 2), (7, 3), (2, 5), (5, 1), (6, None)])
def test_threads_change_no_number(lanes, threads):
    q, p = starts(lanes)
    q[-1, 0] = np.nan
    batch = jax.jit(jax.vmap(one))
    found = dvi.over_threads(batch, threads)(q, p)
    assert_same(found, batch(q, p))
    failed = np.asarray(found["result"] != dvi.RESULTS.successful)
    assert failed.tolist() == [False] * (lanes - 1) + [True]


def test_lanes_along_other_axes_and_arguments_without():
    q, p = starts(5, axis=1)
    batch = jax.jit(jax.vmap(one, in_axes=(1, 1, None), out_axes=-1))
    threads = dvi.over_threads(batch, 2, in_axes=(1, 1, None), out_axes=-1)
    found = threads(q, p, 2.0)
    assert found["qs"].shape == (STEPS + 1, 2, 5)
    assert_same(found, batch(q, p, 2.0))


def test_pieces_run_in_threads_of_their_own_and_at_the_same_time():
    """Each waits for the other: one after the other they would never meet."""
    meet = threading.Barrier(2, timeout=20)
    seen = []

    def function(x):
        seen.append((threading.get_ident(), x.shape))
        if len(seen) > 2:  # not the call of each size that compiles
            meet.wait()
        return x + 1

    threads = dvi.over_threads(function, 2)
    threads(jnp.arange(6.0))
    np.testing.assert_array_equal(threads(jnp.arange(6.0)), np.arange(6.0) + 1)
    assert {shape for _, shape in seen} == {(3,)}
    assert len({ident for ident, _ in seen[2:]}) == 2


def test_an_error_in_a_thread_is_raised():
    def function(x):
        if x[0] > 2:
            raise RuntimeError("no")
        return x

    with pytest.raises(RuntimeError, match="no"):
        dvi.over_threads(function, 2)(jnp.arange(6.0))


@pytest.mark.parametrize(
    ("settings", "args", "error", "match"),
    [
        ({"threads": 0}, None, ValueError, "at least 1, got 0"),
        ({"threads": 1.5}, None, TypeError, "whole number or None, got 1.5"),
        ({}, (jnp.ones(3), jnp.ones(4)), ValueError, r"one number of lanes, got 3 .* and 4"),
        ({}, (jnp.ones(3), 2.0), ValueError, r"axis 0, but .* shape \(\).*None"),
        ({"in_axes": None}, (jnp.ones(3), 2.0), ValueError, "none with lanes"),
        ({"in_axes": (0,)}, (jnp.ones(3), 2.0), ValueError, "1 entries for 2 arguments"),
        ({}, (jnp.ones((0, 2)),), ValueError, "at least one"),
        ({"threads": 2, "out_axes": 3}, (jnp.ones(4),), ValueError, "out_axes says .* axis 3"),
        ({"in_axes": "a"}, (jnp.ones(2),), TypeError, "whole number or None, got 'a'"),
    ],
)
def test_what_cannot_be_cut_is_refused(settings, args, error, match):
    with pytest.raises(error, match=match):
        dvi.over_threads(lambda *x: x, **settings)(*(args or ()))


def test_under_a_transformation_it_says_what_to_do():
    with pytest.raises(ValueError, match=r"under jit, vmap or grad: put those inside"):
        jax.jit(dvi.over_threads(jnp.sin, 2))(jnp.ones(4))
    with pytest.raises(TypeError, match="takes a function"):
        dvi.over_threads(jnp.ones(3))  # pyright: ignore[reportArgumentType]
