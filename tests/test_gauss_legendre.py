"""Gauss–Legendre methods: coefficients, stage equations, quadratic invariants, gradients, status.

Order, symplecticity, reversal and inverse are tested with those of the other methods.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import SYSTEMS, central_difference, flow, non_separable, pendulum, state

import dvi_jax as dvi
from dvi_jax.methods._gauss_legendre import _table
from dvi_jax.systems import figure_eight
from dvi_jax.systems.figure_eight import PERIOD
from dvi_jax.systems.n_body import angular_momentum, energy

R3, R15 = 3**0.5, 15**0.5
BY_HAND = {
    1: ([1 / 2], [1], [[1 / 2]]),
    2: (
        [1 / 2 - R3 / 6, 1 / 2 + R3 / 6],
        [1 / 2, 1 / 2],
        [[1 / 4, 1 / 4 - R3 / 6], [1 / 4 + R3 / 6, 1 / 4]],
    ),
    3: (
        [1 / 2 - R15 / 10, 1 / 2, 1 / 2 + R15 / 10],
        [5 / 18, 4 / 9, 5 / 18],
        [
            [5 / 36, 2 / 9 - R15 / 15, 5 / 36 - R15 / 30],
            [5 / 36 + R15 / 24, 2 / 9, 5 / 36 - R15 / 24],
            [5 / 36 + R15 / 30, 2 / 9 + R15 / 15, 5 / 36],
        ],
    ),
}
"""c, b, a as printed: Hairer, Lubich & Wanner 2006, II.1.3."""


@pytest.mark.parametrize("stages", BY_HAND)
def test_coefficients_are_those_in_print(stages):
    for ours, printed in zip(_table(stages), BY_HAND[stages], strict=True):
        np.testing.assert_allclose(ours, printed, rtol=0, atol=3e-16)


@pytest.mark.parametrize("stages", range(1, 9))
def test_conditions_of_order_2s_hold_and_the_next_does_not(stages):
    """B(2s), C(s) and the condition of symplecticity, in the notation of the source."""
    c, b, a = _table(stages)

    def defect(k):
        return abs(b @ c ** (k - 1) - 1 / k)

    assert max(defect(k) for k in range(1, 2 * stages + 1)) < 1e-15
    exact = np.prod([k**4 / ((2 * k - 1) * (2 * k)) ** 2 for k in range(1, stages + 1)])
    np.testing.assert_allclose(defect(2 * stages + 1), exact / (2 * stages + 1), atol=1e-15)
    for k in range(1, stages + 1):
        np.testing.assert_allclose(a @ c ** (k - 1), c**k / k, rtol=0, atol=1e-15)
    np.testing.assert_allclose(b[:, None] * a + b * a.T, np.outer(b, b), rtol=0, atol=5e-17)


def step_by_hand(stages, q, p, t, h, epsilon):
    """A step for H = (q² + 1)(p² + 1)/2 and W = −(1 + q²)p + cos t, by fixed-point iteration."""
    c, b, a = (np.array(x) for x in BY_HAND[stages])
    dq = dp = np.zeros(stages)
    for _ in range(60):
        Q, P = q + h * a @ dq, p + h * a @ dp
        dq = (Q**2 + 1) * P
        dp = -Q * (P**2 + 1) + epsilon * (-(1 + Q**2) * P + np.cos(t + c * h))
    return q + h * b @ dq, p + h * b @ dp


@pytest.mark.parametrize("stages", [2, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 3))])
def test_stage_equations_hold(stages):
    z = jnp.array([0.3, 0.4])
    system, t0, h, epsilon = SYSTEMS["non_separable"][0], 0.7, 0.1, 0.2
    ours = flow(system, dvi.GaussLegendre(stages), h, t0=t0, epsilon=epsilon)(z)
    np.testing.assert_allclose(ours, step_by_hand(stages, *z, t0, h, epsilon), rtol=0, atol=1e-15)
    later = np.array(step_by_hand(stages, *z, t0 + 1e-3, h, epsilon))
    assert np.max(np.abs(ours - later)) > 1e-8  # the time of the force does matter


def stationary_value(t0, t1, q0, p1, args):
    """The H_D that `GaussLegendre(2)` is the variational map of, for the non-separable H."""
    _, b, a = (np.array(x) for x in BY_HAND[2])
    h, shape = t1 - t0, (2, *q0.shape)

    def H(q, p):
        return non_separable(t0, t1, q, p, args)

    def improved(_, curve):
        q_falls, q_rates = jax.vmap(jax.grad(H, argnums=(0, 1)))(*curve)
        Q = q0[None] + h * jnp.tensordot(a, q_rates, 1)
        return Q, p1[None] + h * jnp.tensordot(b[None] - a, q_falls, 1)

    start = (jnp.broadcast_to(q0, shape), jnp.broadcast_to(p1, shape))
    Q, P = jax.lax.fori_loop(0, 25, improved, start)
    V = jax.vmap(jax.grad(H, argnums=1))(Q, P)
    return b @ (jax.vmap(H)(Q, P) - jnp.sum((P - p1[None]) * V, axis=1))


@pytest.mark.slow
def test_it_is_the_variational_map_of_a_stationary_value():
    z = state("non_separable")
    variational = flow(dvi.System(stationary_value), dvi.TypeII(), 0.1)(z)
    ours = flow(dvi.System(non_separable), dvi.GaussLegendre(2), 0.1)(z)
    np.testing.assert_allclose(ours, variational, rtol=0, atol=1e-15)
    plain = flow(dvi.System(non_separable), dvi.TypeII(), 0.1)(z)
    assert np.max(np.abs(plain - ours)) > 1e-3


@pytest.mark.slow
def test_slow_time_and_perturbation_are_honoured():
    """ε t by hand, and what is added to H_D by hand, give the same step."""

    def H(t0, t1, q0, p1, args):
        return pendulum(t0, t1, q0, p1, args) * (1 + jnp.sin(3 * t0) / 2)

    def push(t0, t1, q0, p1, args):
        return -p1 + jnp.cos(2 * t0)

    def bump(t0, t1, q0, p1, args):
        return jnp.sum(q0**4) * jnp.cos(t0)

    def of_slow_time(f):
        return lambda t0, t1, q0, p1, args: f(0.1 * t0, 0.1 * t1, q0, p1, args)

    def total(t0, t1, q0, p1, args):
        s = 0.1 * t0
        return H(s, s, q0, p1, args) + 0.1 * bump(s, s, q0, p1, args)

    slow = dvi.System(H, push, bump, slow_time=True)
    by_hand = dvi.System(total, of_slow_time(push))
    z, method = state("pendulum"), dvi.GaussLegendre(2)
    a, b = (flow(s, method, 0.2, t0=4.0, epsilon=0.1)(z) for s in (slow, by_hand))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)
    fast = flow(dvi.System(H, push, bump), method, 0.2, t0=4.0, epsilon=0.1)(z)
    assert np.max(np.abs(fast - a)) > 1e-3


def drift(system, observable, method, h):
    """Largest change of an observable over 2000 steps, from angular momentum 1.2."""
    return float(
        dvi.integrate(
            system,
            [0.0, 1.2],
            [-1.0, -0.6],
            h=h,
            num_steps=2000,
            args={"K": 1.0},
            method=method,
            save=dvi.Save(final=True),
            observe=dvi.MaxDrift(observable),
        ).observed
    )


@pytest.mark.slow
def test_energy_of_oscillators_is_kept_to_round_off():
    """Quadratic, of value 2.12; RungeKutta4 loses it."""

    def oscillators(t0, t1, q0, p1, args):
        return (p1 @ p1 + q0[0] ** 2 + 2 * q0[1] ** 2 + q0[0] * p1[1]) / 2

    def their_energy(t0, t1, q0, p0, q1, p1, args):
        return oscillators(t1, t1, q1, p1, args)

    system = dvi.System(oscillators)
    assert drift(system, their_energy, dvi.GaussLegendre(2), 0.3) < 1e-13
    assert drift(system, their_energy, dvi.RungeKutta4(), 0.3) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("stages", [1, 2, 3])
def test_angular_momentum_of_kepler_is_kept_to_round_off(stages):
    def momentum(t0, t1, q0, p0, q1, p1, args):
        return q1[0] * p1[1] - q1[1] * p1[0]

    kepler = SYSTEMS["kepler"][0]
    assert drift(kepler, momentum, dvi.GaussLegendre(stages), 0.1) < 1e-13


@pytest.mark.slow
def test_figure_eight_comes_back():
    problem = figure_eight()
    solution = dvi.integrate(
        problem.system,
        problem.q0,
        problem.p0,
        h=PERIOD / 1000,
        num_steps=1000,
        args=problem.args,
        method=dvi.GaussLegendre(2),
        save=dvi.Save(final=True),
        observe={"L": dvi.MaxDrift(angular_momentum), "H": dvi.MaxDrift(energy)},
    )
    np.testing.assert_allclose(solution.qs[-1], problem.q0, rtol=0, atol=2e-7)  # digits as printed
    assert float(solution.observed["L"]) < 1e-14
    start = energy(0, 0, None, None, problem.q0, problem.p0, problem.args)
    end = energy(0, 0, None, None, solution.qs[-1], solution.ps[-1], problem.args)
    assert abs(end / start - 1) < 1e-14  # back after a period of a symmetric orbit
    assert 1e-12 < float(solution.observed["H"]) < 1e-10  # on the way it wavers, as h⁴


@pytest.mark.slow
@pytest.mark.parametrize("stages", [1, 2])
def test_gradients(stages):
    """Reverse, forward and reversible against a difference quotient, in q, p, args, ε and h."""

    def H(t0, t1, q0, p1, args):
        return non_separable(t0, t1, q0, p1, None) + args * jnp.sum(q0**4)

    system = dvi.System(H, SYSTEMS["non_separable"][0].force)

    def value(adjoint):
        def of(x):
            q, p, a, epsilon, h = jnp.split(x, 5)
            sol = dvi.integrate(
                system,
                q,
                p,
                h=h[0],
                num_steps=3,
                epsilon=epsilon[0],
                args=a[0],
                method=dvi.GaussLegendre(stages),
                save=dvi.Save(final=True),
                adjoint=adjoint,
            )
            return jnp.sum(sol.qs[-1] ** 3) + jnp.sum(sol.ps[-1])

        return of

    x = jnp.array([0.3, 0.4, 0.5, 0.2, 0.1])
    direction = jnp.array([0.6, -0.8, 0.5, 0.4, 0.3])
    direct = value(dvi.Direct())
    reverse = jax.jit(jax.grad(direct))(x)
    _, forward = jax.jit(lambda x, d: jax.jvp(direct, (x,), (d,)))(x, direction)
    np.testing.assert_allclose(forward, reverse @ direction, rtol=1e-12)
    quotient = central_difference(jax.jit(direct), x, direction)
    np.testing.assert_allclose(forward, quotient, rtol=1e-9)
    assert np.min(np.abs(reverse)) > 1e-3
    if stages == 1:
        rebuilt = jax.jit(jax.grad(value(dvi.Reversible())))(x)
        np.testing.assert_allclose(rebuilt, reverse, rtol=1e-12)


def one_step(system, q, newton=dvi.Newton()):
    """A step that does not raise."""
    method = dvi.GaussLegendre(2)
    return dvi.integrate(
        system, q, [0.4], h=0.1, num_steps=1, method=method, newton=newton, throw=False
    )


@pytest.mark.slow
def test_status_iterations_and_residual_are_reported():
    system, q, _ = SYSTEMS["non_separable"]
    good = one_step(system, q)
    assert good.status == "successful"
    assert 2 <= int(good.stats["newton_iterations"]) <= 5
    assert float(good.stats["max_residual"]) < 1e-14
    short = one_step(system, q, dvi.Newton(max_steps=1))
    assert short.status == "not_converged"
    assert float(short.stats["failed_residual"]) > 1e-12
    assert np.isnan(short.qs[-1]).all()


@pytest.mark.slow
def test_a_force_that_is_not_finite_is_told():
    def rooted(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + jnp.sum(jnp.sqrt(q0))

    assert one_step(dvi.System(rooted), [-1.0]).status == "not_finite"
    assert one_step(dvi.System(rooted), [1.0]).status == "successful"


@pytest.mark.parametrize("stages", [0, 9, -1, 1.5, 2.0, True, None, "2"])
def test_other_numbers_of_stages_are_refused(stages):
    with pytest.raises(ValueError, match="stages must be a whole number from 1 to 8"):
        dvi.GaussLegendre(stages)


def test_what_is_promised():
    method = dvi.GaussLegendre(3)
    assert method.order == 6
    assert not method.is_explicit(dvi.System(pendulum))  # where TypeII is
    assert dvi.TypeII().is_explicit(dvi.System(pendulum))
    assert dvi.Yoshida(4, base=dvi.GaussLegendre(1)).is_symplectic
