"""Order, symplecticity, reversal and inverse of every method, each with a negative control."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    ARGS,
    INVERTIBLE,
    METHODS,
    SYMPLECTIC,
    SYSTEMS,
    ExplicitEuler,
    flow,
    measured_orders,
    state,
    symplectic_defect,
)
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax._step import Equations, adjoint_step, inverse_step, step
from dvi_jax._types import Interval

TWO_SYSTEMS = ["non_separable", "double_pendulum"]


@functools.cache
def jacobian(system, method, epsilon=0.0):
    return jax.jit(jax.jacfwd(flow(SYSTEMS[system][0], METHODS[method], 0.1, epsilon=epsilon)))


LONG_COMPILE = {
    ("double_pendulum", m) for m in ("Yoshida4", "Composition", "Adjoint", "RungeKutta4")
}


def pairs(methods, names):
    """Every (system, method); those that take long to compile are marked slow."""
    return [
        pytest.param(s, m, marks=[pytest.mark.slow] if (s, m) in LONG_COMPILE else [])
        for s in names
        for m in methods
    ]


@pytest.mark.parametrize(("system", "method"), pairs(SYMPLECTIC, SYSTEMS))
def test_undisturbed_step_is_symplectic(system, method):
    M = np.asarray(jacobian(system, method)(state(system)))
    assert symplectic_defect(M) <= 1e-12


@pytest.mark.parametrize("system", SYSTEMS)
def test_explicit_euler_and_runge_kutta_are_not(system):
    f = flow(SYSTEMS[system][0], ExplicitEuler(), 0.1)
    assert symplectic_defect(np.asarray(jax.jacfwd(f)(state(system)))) > 1e-4
    assert symplectic_defect(np.asarray(jacobian(system, "RungeKutta4")(state(system)))) > 1e-9


def test_a_dissipative_force_contracts():
    """With the disturbance on, the same map is not symplectic: its determinant is below one."""
    M = np.asarray(jacobian("non_separable", "TypeII", 0.3)(state("non_separable")))
    assert np.linalg.det(M) < 0.99


@functools.cache
def reference(system, epsilon, t_end):
    """SciPy's DOP853 on the continuous equations."""
    s, q, p = SYSTEMS[system]
    t = jnp.asarray(0.0)
    dH = jax.jit(jax.grad(s.H_D, argnums=(2, 3)))
    W = jax.jit(s.force)

    def field(t, z):
        q, p = np.split(z, 2)
        dq, dp = dH(t, t, q, p, ARGS)
        return np.concatenate([dp, -dq + epsilon * W(t, t, q, p, ARGS)])

    del t
    z = solve_ivp(field, (0, t_end), [*q, *p], method="DOP853", rtol=1e-13, atol=1e-14)
    return z.y[:, -1]


@pytest.mark.parametrize(("system", "method"), pairs(METHODS, TWO_SYSTEMS))
def test_order_with_a_damped_and_driven_force(system, method):
    """The order is that named, on a non-separable, forced, implicit problem."""
    m, t_end, epsilon = METHODS[method], 1.0, 0.2
    f = jax.jit(lambda z, h, n: flow(SYSTEMS[system][0], m, h, n, epsilon)(z), static_argnums=2)
    steps = [16, 32, 64, 128]
    exact = reference(system, epsilon, t_end)
    errors = [np.max(np.abs(f(state(system), t_end / n, n) - exact)) for n in steps]
    orders = measured_orders(errors, 2, floor=3e-12)
    assert abs(orders[-1] - m.order) < 0.2, orders


@pytest.mark.parametrize(("system", "method"), pairs(INVERTIBLE, SYSTEMS))
def test_inverse_undoes_the_step_with_the_force_on(system, method):
    s, q, p = SYSTEMS[system]
    m = METHODS[method]

    @jax.jit
    def there_and_back(q, p):
        interval = Interval(jnp.asarray(0.2), jnp.asarray(0.3), jnp.asarray(0.1))
        equations = Equations(s, jnp.asarray(0.3), ARGS)
        q1, p1, one = m.step(equations, interval, q, p)
        q0, p0, two = m.inverse(equations, interval, q1, p1)
        good = (one.result == dvi.RESULTS.successful) & (two.result == dvi.RESULTS.successful)
        return q1, q0, p0, good

    q, p = jnp.asarray(q), jnp.asarray(p)
    q1, q0, p0, good = there_and_back(q, p)
    assert bool(good)
    assert np.max(np.abs(q0 - q)) < 1e-13
    assert np.max(np.abs(p0 - p)) < 1e-13
    assert np.max(np.abs(q1 - q)) > 1e-3  # it did move


@pytest.mark.parametrize(("system", "method"), pairs(METHODS, SYSTEMS))
def test_symmetric_methods_reverse_and_others_do_not(system, method):
    m = METHODS[method]
    s = SYSTEMS[system][0]
    there, back = flow(s, m, 0.1, epsilon=0.1), flow(s, m, -0.1, t0=0.1, epsilon=0.1)
    z = state(system)
    defect = np.max(np.abs(jax.jit(lambda z: back(there(z)))(z) - z))
    if m.is_symmetric:
        assert defect <= 1e-12
    else:
        assert defect > 1e-9


def test_adjoint_is_the_inverse_of_the_step_backwards():
    s, q, p = SYSTEMS["double_pendulum"]
    q, p = jnp.asarray(q), jnp.asarray(p)
    equations = Equations(s, jnp.asarray(0.3), ARGS)
    interval = Interval(jnp.asarray(0.2), jnp.asarray(0.3), jnp.asarray(0.1))
    q1, p1, _ = adjoint_step(equations, interval, q, p)
    q0, p0, _ = step(equations, interval.reversed(), q1, p1)
    np.testing.assert_allclose(q0, q, atol=1e-14)
    np.testing.assert_allclose(p0, p, atol=1e-14)
    plain, _, _ = step(equations, interval, q, p)
    assert np.max(np.abs(plain - q1)) > 1e-3  # and is another map


def test_discrete_equations_hold_for_the_step():
    """(12)–(13) as printed, evaluated by hand for H = (q² + 1)(p² + 1)/2 and W = −(1 + q²)p."""
    s = dvi.System(
        lambda t0, t1, q, p, args: jnp.sum((q**2 + 1) * (p**2 + 1)) / 2,
        force=lambda t0, t1, q, p, args: -(1 + q**2) * p,
    )
    q0, p0, h, e = 0.3, 0.4, 0.1, 0.2
    sol = dvi.integrate(s, [q0], [p0], h=h, num_steps=1, epsilon=e)
    q1, p1 = float(sol.qs[1, 0]), float(sol.ps[1, 0])
    assert abs((q1 - q0) / h - (q0**2 + 1) * p1) < 1e-14
    assert abs((p1 - p0) / h + q0 * (p1**2 + 1) + e * (1 + q0**2) * p1) < 1e-14


def test_inverse_step_solves_where_the_step_does_not():
    """H = p²(1 + q²)/2 − cos q: explicit in neither direction; H = p²/2 − cos q: in both."""
    separable = dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q)))
    q, p = jnp.array([0.3]), jnp.array([0.4])
    interval = Interval(jnp.asarray(0.0), jnp.asarray(0.1), jnp.asarray(0.1))
    for s, solves in ((separable, False), (SYSTEMS["non_separable"][0], True)):
        for f in (step, inverse_step):
            _, _, info = f(Equations(s, jnp.asarray(0.0)), interval, q, p)
            assert (int(info.iterations) > 0) == solves


def test_explicitness_is_read_from_the_system():
    spring = dvi.System(lambda t0, t1, q, p, args: args * (jnp.sum(p**2) + jnp.sum(q**2)) / 2)
    damped = dvi.System(spring.H_D, force=lambda t0, t1, q, p, args: -p)
    q = jnp.zeros(3)
    assert dvi.TypeII().is_explicit(spring, q, 1.0)
    assert dvi.Strang().is_explicit(spring, q, 1.0)
    assert not dvi.TypeII().is_explicit(damped, q, 1.0)
    assert dvi.Adjoint().is_explicit(damped, q, 1.0)  # the adjoint solves for q, where W has no say
    assert not dvi.Strang().is_explicit(damped, q, 1.0)
    assert dvi.TypeII().is_explicit(dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + q @ q))
    with pytest.raises(ValueError, match="Give an example"):
        dvi.TypeII().is_explicit(spring)


def test_strang_is_velocity_verlet_when_separable():
    s = dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q)))
    q, p, h = 0.5, 0.3, 0.1
    sol = dvi.integrate(s, [q], [p], h=h, num_steps=1, method=dvi.Strang())
    half = p - h / 2 * np.sin(q)
    q1 = q + h * half
    np.testing.assert_allclose(sol.qs[1], [q1], rtol=1e-15)
    np.testing.assert_allclose(sol.ps[1], [half - h / 2 * np.sin(q1)], rtol=1e-14)


@pytest.mark.parametrize("bad", [(), (0.5, 0.6), (np.nan, 1.0)])
def test_composition_refuses_inconsistent_coefficients(bad):
    with pytest.raises(ValueError, match="sum to 1"):
        dvi.Composition(bad)


def test_orders_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="order 4, got 6"):
        dvi.Yoshida(6)
    with pytest.raises(ValueError, match="no inverse step"):
        dvi.Adjoint(dvi.RungeKutta4())
    with pytest.raises(TypeError, match="takes a method"):
        dvi.Adjoint(dvi.TypeII)


def test_kepler_momentum_is_kept_to_round_off():
    s, q, p = SYSTEMS["kepler"]  # its disturbance is central: L survives it

    def L(t0, t1, q0, p0, q1, p1, args):
        return q1[0] * p1[1] - q1[1] * p1[0]

    def spread(method):
        sol = dvi.integrate(
            s,
            q,
            p,
            h=0.1,
            num_steps=10_000,
            epsilon=0.05,
            args=ARGS,
            method=method,
            observe=dvi.Range(L),
            save=dvi.Save(final=True),
        )
        return float(sol.observed) / 1.2

    assert spread(dvi.TypeII()) <= 1e-13
    assert spread(dvi.Strang()) <= 1e-13
    assert spread(dvi.RungeKutta4()) > 1e-6
