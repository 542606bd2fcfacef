"""Batches on several threads: the same numbers on any number of them; the older name for that."""

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
    jax.tree.map(np.testing.assert_array_equal, found, expected)


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
    """Also along other axes, and with arguments without one."""
    axes = {"in_axes": (1, 1, None), "out_axes": -1}
    q, p = starts(5, axis=1)
    batch = jax.jit(jax.vmap(one, **axes))
    found = dvi.over_threads(batch, threads, **axes)(q, p, 2.0)
    assert found["qs"].shape == (STEPS + 1, 2, 5)
    assert_same(found, batch(q, p, 2.0))


def test_an_error_of_the_function_is_raised():
    with pytest.raises(ZeroDivisionError):
        dvi.over_threads(lambda x: 1 / 0, 2)(jnp.arange(6.0))


@pytest.mark.parametrize(
    ("function", "threads", "error", "match"),
    [
        (jnp.sin, 0, ValueError, "integer of at least 1, got 0"),
        (jnp.sin, -2, ValueError, "integer of at least 1, got -2"),
        (jnp.sin, 1.5, TypeError, "positive integer or None, got 1.5"),
        (jnp.sin, True, ValueError, "integer of at least 1, got True"),
        (jnp.ones(3), None, TypeError, "argument of over_threads must be a function"),
    ],
)
def test_invalid_arguments_are_rejected(function, threads, error, match):
    with pytest.raises(error, match=match):
        dvi.over_threads(function, threads)
