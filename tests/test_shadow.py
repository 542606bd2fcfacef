"""The shadow Hamiltonian of a discrete Hamiltonian, and the generating function of a flow."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from generating import generating_terms
from helpers import double_pendulum, measured_orders, non_separable, pendulum

import dvi_jax as dvi

Q, P = jnp.array([0.7]), jnp.array([-0.4])


def oscillator(t0, t1, q0, p1, args):
    return (p1 @ p1 + q0 @ q0) / 2


def driven(t, q, p, args):
    """A pendulum whose length changes: H depends on time and does not separate."""
    return jnp.sum(p**2) / 2 * (1 + jnp.sin(t) / 2) - jnp.cos(t) * jnp.sum(jnp.cos(q))


def midpoint_like(t0, t1, q0, p1, args):
    """Depends on h in every way: by t1 − t0, at a time between, and needs a solve."""
    h = t1 - t0
    return driven((t0 + t1) / 2, q0, p1, args) + h * jnp.sum(q0 * p1) / 3 + h**2 * jnp.sum(q0**4)


def terms_of(H_D, order, t=0.0, q=Q, p=P):
    shadow = dvi.ShadowHamiltonian(order, dvi.System(H_D))
    return jax.jit(shadow.terms)(t, q, p)


def drifts(system, observe, hs, q0, p0, **options):
    """The largest drift of each observable at every step size, arrays (len(hs),)."""

    observe = jax.tree.map(dvi.MaxDrift, observe, is_leaf=callable)
    run = {"num_steps": 2000, "save": dvi.Save(final=True), "observe": observe, **options}
    of = lambda h: dvi.integrate(system, q0, p0, h=h, **run).observed  # noqa: E731
    return jax.jit(jax.vmap(of))(jnp.asarray(hs))


@pytest.mark.slow
def test_oscillator_has_its_closed_form():
    """H̃ = 2 asin(h/2)/(h √(1 − h²/4)) (p² + q² − hqp)/2; the factor is Σ m!²/(2m+1)! h^{2m}."""
    series = [math.factorial(m) ** 2 / math.factorial(2 * m + 1) for m in range(3)]
    even, odd = float(Q[0] ** 2 + P[0] ** 2) / 2, float(-Q[0] * P[0]) / 2
    expected = [series[i // 2] * (odd if i % 2 else even) for i in range(5)]
    np.testing.assert_allclose(terms_of(oscillator, 4), expected, rtol=1e-12)

    shadow, h = dvi.ShadowHamiltonian(3, dvi.System(oscillator)), 0.05
    closed = 2 * np.arcsin(h / 2) / (h * np.sqrt(1 - h**2 / 4)) * (even + h * odd)
    assert shadow.evaluate(0.0, Q, P, h) == pytest.approx(closed, abs=h**4 / 50)


@pytest.mark.slow
def test_drift_falls_as_a_power_of_h_more_with_each_term():
    hs = 0.2 / 2 ** np.arange(4)
    shadows = [dvi.ShadowHamiltonian(order) for order in range(4)]
    full = dvi.ShadowHamiltonian(2, dvi.System(pendulum))

    def corrupted(t0, t1, q0, p0, q1, p1, args):
        """As of order 2, with the wrong sign before the last term."""
        h = t1 - t0
        terms = full.terms(t1, q1, p1)
        return terms[0] + h * terms[1] - h**2 * terms[2]

    def energy(t0, t1, q0, p0, q1, p1, args):
        return pendulum(t1, t1, q1, p1, args)

    found = drifts(dvi.System(pendulum), [*shadows, energy, corrupted], hs, [1.3], [0.5])
    for order in range(4):
        slopes = measured_orders(found[order], 2, 1e-13)
        assert slopes[-1] == pytest.approx(order + 1, abs=0.15), (order, slopes)
    np.testing.assert_allclose(found[4], found[0], rtol=1e-10)
    assert measured_orders(found[5], 2, 1e-13)[-1] == pytest.approx(2, abs=0.15)


@pytest.mark.slow
def test_two_degrees_of_freedom_and_an_implicit_step():
    hs = 0.08 / 2 ** np.arange(3)
    shadow = dvi.ShadowHamiltonian(2)
    drift = drifts(dvi.System(double_pendulum), shadow, hs, [0.5, -0.3], [0.2, 0.4])
    assert measured_orders(drift, 2, 1e-13)[-1] == pytest.approx(3, abs=0.2)


def test_first_two_terms_are_those_of_the_formula():
    t = jnp.asarray(0.3)
    at = (t, t, Q, P, None)
    value, (t0, t1, q, p) = jax.jit(jax.value_and_grad(midpoint_like, argnums=(0, 1, 2, 3)))(*at)
    expected = [value, t1 - (t0 + t1 + q @ p) / 2]
    np.testing.assert_allclose(terms_of(midpoint_like, 1, t), expected, rtol=1e-13)


def flow(H, t, z, h, small=32):
    """z = (q, p) at t → at t + h by Runge–Kutta in small steps; H(t, q, p)."""
    s = h / small

    def field(t, z):
        q, p = jax.grad(H, argnums=(1, 2))(t, *z)
        return jnp.stack([p, -q])

    def stage(carry, row):
        t, z, slope, total = carry
        slope = field(t + row[0] * s, z + row[0] * s * slope)
        return (t, z, slope, total + row[1] * slope), None

    table = jnp.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]])

    def step(z, k):
        start = (t + k * s, z, jnp.zeros_like(z), jnp.zeros_like(z))
        return z + s * jax.lax.scan(stage, start, table)[0][3], None

    return jax.lax.scan(step, z, jnp.arange(1.0 * small))[0]


@pytest.mark.parametrize(("H_D", "order"), [(non_separable, 2), (midpoint_like, 1)])
@pytest.mark.slow
def test_its_flow_is_the_map(H_D, order):
    system, t = dvi.System(H_D), 0.3
    shadow = dvi.ShadowHamiltonian(order, system)

    @jax.jit
    def misfit(h):
        save = dvi.Save(final=True)
        step = dvi.integrate(system, Q, P, h=h, num_steps=1, t0=t, save=save)
        exact = flow(lambda t, q, p: shadow.evaluate(t, q, p, h), t, jnp.stack([Q, P]), h)
        return jnp.max(jnp.abs(exact - jnp.stack([step.qs[-1], step.ps[-1]])))

    errors = [misfit(h) for h in 0.08 / 2 ** np.arange(4)]
    assert measured_orders(errors, 2, 1e-14)[-1] == pytest.approx(order + 2, abs=0.2)


@pytest.mark.parametrize("fraction", [0.5, pytest.param(0.0, marks=pytest.mark.slow)])
def test_time_is_a_coordinate_like_any_other(fraction):
    """H(t, q, p) is p_t + H(q_t, q, p) with t made a coordinate, and so is its shadow."""

    def with_time(t0, t1, q0, p1, args):
        return driven(t0 + fraction * (t1 - t0), q0, p1, args)

    def without(t0, t1, q0, p1, args):
        return p1[1] + driven(q0[1] + fraction * (t1 - t0), q0[:1], p1[:1], args)

    t, p_t = 0.3, 0.8
    expected = terms_of(without, 2, 0.0, jnp.append(Q, t), jnp.append(P, p_t))
    found = terms_of(with_time, 2, t)
    np.testing.assert_allclose(found, expected.at[0].add(-p_t), rtol=1e-12, atol=1e-14)


def test_generating_function_of_the_oscillator():
    """S = qP/cos s + (q² + P²) tan(s)/2."""

    def terms(q, p):
        return generating_terms(lambda t, q, p, args: oscillator(t, t, q, p, args), 4, 0.0, q, p)

    G = jax.jit(terms)(Q, P)
    q, p = float(Q[0]), float(P[0])
    even, odd = (q**2 + p**2) / 2, q * p
    expected = [even, odd / 2, even / 3, 5 / 24 * odd]
    np.testing.assert_allclose(G, expected, rtol=1e-14)


def test_generating_function_gives_a_discrete_hamiltonian_of_its_order():
    """The shadow of the first two terms begins with H and differs from it first at h²."""

    def H_D(t0, t1, q0, p1, args):
        G = generating_terms(driven, 2, t0, q0, p1, args)
        return G[0] + (t1 - t0) * G[1]

    terms = terms_of(H_D, 2, 0.3)
    left_out = jax.jit(lambda q, p: generating_terms(driven, 3, jnp.asarray(0.3), q, p))(Q, P)[2]
    np.testing.assert_allclose(terms, [driven(0.3, Q, P, None), 0, -left_out], atol=1e-14)


def quartic(t0, t1, q0, p1, args):
    return jnp.sum(q0**4) / 4


@pytest.mark.slow
def test_perturbation_is_included_with_the_epsilon_of_the_run():
    perturbed = dvi.System(oscillator, perturbation=quartic)
    cubic_force = dvi.System(oscillator, force=lambda t0, t1, q0, p1, args: -(q0**3))
    run = {"q0": [0.6], "p0": [0.2], "epsilon": 0.3}
    alone, folded = dvi.ShadowHamiltonian(1), dvi.ShadowHamiltonian(1, perturbed)
    by_perturbation = drifts(perturbed, alone, [0.05], **run)
    # The force −εq³ is the same perturbation, but only the user knows that it is a gradient.
    by_force = drifts(cubic_force, [alone, folded], [0.05], **run)
    assert by_force[1] < 1e-4
    assert by_force[0] > 1e-3
    np.testing.assert_allclose(by_force[1], by_perturbation, rtol=1e-6)


def test_slow_time_goes_slowly():
    slow = dvi.System(lambda t0, *rest: driven(t0, *rest[1:]), slow_time=True)
    fast = dvi.System(lambda t0, t1, q0, p1, args: driven(0.1 * t0, q0, p1, args))
    found = dvi.ShadowHamiltonian(2, slow, epsilon=0.1).terms(0.7, Q, P)
    np.testing.assert_allclose(found, dvi.ShadowHamiltonian(2, fast).terms(0.7, Q, P), rtol=1e-13)


def test_a_composed_method_has_another_one():
    """Negative control: Strang's map conserves energy to O(h²), not the shadow of one step."""
    shadow, hs = dvi.ShadowHamiltonian(1), 0.1 / 2 ** np.arange(3)
    found = drifts(dvi.System(pendulum), shadow, hs, [1.3], [0.5], method=dvi.Strang())
    assert measured_orders(found, 2, 1e-13)[-1] == pytest.approx(1, abs=0.1)


@pytest.mark.slow
def test_step_size_given_by_hand_keeps_its_digits():
    """At t = 1e9 the difference t1 − t0 has seven digits left; the oscillator's form is exact."""
    observe = [dvi.ShadowHamiltonian(1), dvi.ShadowHamiltonian(1, h=0.1)]
    found = drifts(dvi.System(oscillator), observe, [0.1], [1.0], [0.3], t0=1e9)
    assert found[1] < 1e-13
    assert found[0] > 1e-10


@pytest.mark.slow
def test_states_of_any_shape_and_precision_batches_and_gradients():
    shadow = dvi.ShadowHamiltonian(1, dvi.System(pendulum))
    terms = jax.jit(lambda q, p: shadow.terms(0.0, q, p))
    q, p = jnp.linspace(0.1, 0.6, 6), jnp.linspace(-0.5, 0.5, 6)
    expected = [jnp.sum(p**2 / 2 - jnp.cos(q)), -jnp.sum(p * jnp.sin(q)) / 2]
    np.testing.assert_allclose(terms(q.reshape(2, 3), p.reshape(2, 3)), expected, rtol=1e-13)
    one_by_one = jax.vmap(terms)(q, p)  # q, p of shape ()
    np.testing.assert_allclose(jnp.sum(one_by_one, 0), expected, rtol=1e-13)
    single = terms(q.astype("float32"), p.astype("float32"))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, expected, rtol=1e-5)
    slope = jax.jit(jax.grad(lambda q: shadow.evaluate(0.0, q, p, 0.1)))(q)
    np.testing.assert_allclose(slope, jnp.sin(q) - 0.05 * p * jnp.cos(q), rtol=1e-12)


def test_bad_input_is_refused():
    for order in (-1, 1.0, True, None):
        with pytest.raises(ValueError, match="order must be an integer of at least 0"):
            dvi.ShadowHamiltonian(order)
    with pytest.raises(TypeError, match=r"must be a dvi\.System or None, got the function"):
        dvi.ShadowHamiltonian(1, pendulum)
    for h in (0.0, np.nan, [0.1, 0.2]):
        with pytest.raises(ValueError, match="finite step size other than zero"):
            dvi.ShadowHamiltonian(1, h=h)
    with pytest.raises(ValueError, match=r"has no system yet.*bind"):
        dvi.ShadowHamiltonian(1).evaluate(0.0, Q, P, 0.1)
    shadow = dvi.ShadowHamiltonian(1, dvi.System(lambda t0, t1, q0, p1, args: q0 * p1))
    with pytest.raises(ValueError, match="must return a real scalar"):
        shadow.terms(0.0, Q, P)
    with pytest.raises(ValueError, match="the same shape"):
        shadow.terms(0.0, Q, jnp.zeros(2))
    shadow, point = dvi.ShadowHamiltonian(1, dvi.System(pendulum)), np.array([0.1])
    with jax.enable_x64(False), pytest.raises(TypeError, match="jax_enable_x64"):
        shadow.evaluate(0.0, point, point, 0.1)
