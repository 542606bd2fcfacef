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
