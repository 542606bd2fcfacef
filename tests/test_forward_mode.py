"""Forward mode follows a trajectory once; reverse mode and checkpoints take its parts apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, pendulum
from jax import lax

import dvi_jax as dvi

Q, P = jnp.array([0.7, -0.4]), jnp.array([0.2, 0.5])


def end(k, q=Q, p=P):
    """A number of a run that depends on a parameter: states of two save points."""

    def H(t0, t1, q, p, k):
        return pendulum(t0, t1, q, k * p, None)

    sol = dvi.integrate(dvi.System(H), q, p, h=0.1, num_steps=8, args=k, save=dvi.Save(every=4))
    return sol.qs[-1] @ sol.ps[1]


def loops_of(function, *args):
    """The number of compiled loops that a function runs."""
    return jax.jit(function).lower(*args).as_text().count("stablehlo.custom_call @lanewise")


def test_forward_mode_is_one_loop():
    def value_and_change(k):
        return jax.jvp(end, (k,), (1.0,))

    assert loops_of(end, 1.1) == 1
    assert loops_of(value_and_change, 1.1) == 1
    assert loops_of(jax.value_and_grad(end), 1.1) == 2
    value, change = jax.jit(value_and_change)(1.1)
    assert value == jax.jit(end)(1.1)
    np.testing.assert_allclose(change, central_difference(end, 1.1, 1.0), rtol=1e-8)


def test_several_directions_share_the_values():
    """The values are those of one trajectory, not of one for each direction."""

    def jacobian(q):
        pushes = jax.vmap(lambda x: jax.jvp(lambda q: end(1.1, q), (q,), (x,)), out_axes=(None, 0))
        return pushes(jnp.eye(2))

    value, slopes = jax.jit(jacobian)(Q)
    assert value.shape == ()
    np.testing.assert_allclose(slopes, jax.jit(jax.grad(lambda q: end(1.1, q)))(Q), rtol=1e-12)


def test_values_that_nobody_uses_are_not_computed():
    """Times, sizes of steps and the other states of a run whose last position is needed."""

    def run(q):
        system = dvi.System(pendulum)
        return dvi.integrate(system, q, P, h=0.1, num_steps=8, save=dvi.Save(every=4), throw=False)

    def results_of(function):
        text = jax.jit(function).lower(Q).as_text()
        (call,) = (line for line in text.splitlines() if "custom_call @lanewise" in line)
        return call.rpartition("->")[2].count("tensor<")

    assert results_of(lambda q: run(q).qs[-1]) == 1
    assert results_of(run) > 5


def in_scan(body):
    return lambda k: lax.scan(lambda k, _: (k + 0.1 * body(k), None), k, None, length=2)[0]


OUTSIDE = {
    "checkpoint": lambda f: jax.checkpoint(lambda k: jnp.sin(f(jnp.cos(k)))),
    "scan": in_scan,
    "checkpoint in a scan": lambda f: in_scan(jax.checkpoint(f)),
    "saved by a policy": lambda f: jax.checkpoint(
        lambda k: jnp.sin(f(jnp.cos(k))), policy=jax.checkpoint_policies.everything_saveable
    ),
    "condition": lambda f: lambda k: lax.cond(k > 0, f, lambda k: k, k),
    "forward mode": lambda f: lambda k: jax.jvp(f, (k,), (1.0,))[1],
    "checkpoint of forward mode": lambda f: jax.checkpoint(lambda k: jax.jvp(f, (k,), (1.0,))[1]),
}


@pytest.mark.parametrize("name", ["checkpoint in a scan", *(
    pytest.param(name, marks=pytest.mark.slow) for name in OUTSIDE if name != "checkpoint in a scan"
)])  # fmt: skip
def test_derivatives_of_what_is_around_a_run(name):
    function = OUTSIDE[name](end)
    expected = central_difference(function, 1.1, 1.0)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(derivative(function))(1.1), expected, rtol=2e-8)


@pytest.mark.slow
def test_second_derivatives_of_a_checkpointed_run():
    function = OUTSIDE["checkpoint"](end)
    expected = central_difference(jax.jit(jax.grad(function)), 1.1, 1.0)
    for outer in (jax.grad, jax.jacfwd):
        for inner in (jax.grad, jax.jacfwd):
            np.testing.assert_allclose(jax.jit(outer(inner(function)))(1.1), expected, rtol=2e-8)
