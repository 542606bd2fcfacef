"""Batches use all cores: the same numbers on any number of threads, and the older name for that."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
import lanewise

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


@pytest.fixture
def set_threads():
    before = lanewise.get_threads()
    yield lanewise.set_threads
    lanewise.set_threads(before)


@pytest.mark.parametrize(("lanes", "threads"), [(8, 2), (700, 3), (2, 5), (500, 2)])
def test_threads_change_no_number(set_threads, lanes, threads):
    q, p = starts(lanes)
    q[-1, 0] = np.nan
    batch = jax.jit(jax.vmap(one))
    set_threads(1)
    expected = jax.tree.map(np.asarray, batch(q, p))
    set_threads(threads)
    assert_same(batch(q, p), expected)
    failed = np.asarray(expected["result"] != dvi.RESULTS.successful)
    assert failed.tolist() == [False] * (lanes - 1) + [True]


@pytest.mark.parametrize("threads", [None, 1, 3])
def test_the_older_name_changes_no_number(threads):
    q, p = starts(7)
    batch = jax.jit(jax.vmap(one))
    assert_same(dvi.over_threads(batch, threads)(q, p), batch(q, p))


def test_lanes_along_other_axes_and_arguments_without():
    q, p = starts(5, axis=1)
    batch = jax.jit(jax.vmap(one, in_axes=(1, 1, None), out_axes=-1))
    threads = dvi.over_threads(batch, 2, in_axes=(1, 1, None), out_axes=-1)
    found = threads(q, p, 2.0)
    assert found["qs"].shape == (STEPS + 1, 2, 5)
    assert_same(found, batch(q, p, 2.0))


def test_an_error_is_raised():
    def function(x):
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        dvi.over_threads(function, 2)(jnp.arange(6.0))


@pytest.mark.parametrize(
    ("threads", "error", "match"),
    [
        (0, ValueError, "whole number from 1 on, got 0"),
        (-2, ValueError, "whole number from 1 on, got -2"),
        (1.5, TypeError, "positive integer or None, got 1.5"),
        (True, ValueError, "whole number from 1 on, got True"),
    ],
)
def test_an_invalid_number_of_threads_is_refused(threads, error, match):
    with pytest.raises(error, match=match):
        dvi.over_threads(lambda *x: x, threads)


def test_something_that_is_no_function_is_refused():
    with pytest.raises(TypeError, match="takes must be a function"):
        dvi.over_threads(jnp.ones(3))  # pyright: ignore[reportArgumentType]
