"""The Lobatto IIIA–IIIB pair: coefficients, order, symplecticity, action, momentum, gradients."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    ARGS,
    SYSTEMS,
    central_difference,
    covering,
    flow,
    non_separable,
    pendulum,
    state,
    symplectic_defect,
)
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax.methods._lobatto_pair import _table

BY_HAND = {
    2: (
        [0, 1],
        [1 / 2, 1 / 2],
        [[0, 0], [1 / 2, 1 / 2]],
        [[1 / 2, 0], [1 / 2, 0]],
    ),
    3: (
        [0, 1 / 2, 1],
        [1 / 6, 2 / 3, 1 / 6],
        [[0, 0, 0], [5 / 24, 1 / 3, -1 / 24], [1 / 6, 2 / 3, 1 / 6]],
        [[1 / 6, -1 / 6, 0], [1 / 6, 1 / 3, 0], [1 / 6, 5 / 6, 0]],
    ),
}
"""c, b, a, â as printed: Hairer, Lubich & Wanner 2006, II.1.4."""

STAGES = range(2, 7)
IN_EVERY_RUN = (2, 4)


def some_slow(stages):
    """All of them, those that are not in every run marked slow."""
    marks = pytest.mark.slow
    return [s if s in IN_EVERY_RUN else pytest.param(s, marks=marks) for s in stages]


@pytest.mark.parametrize("stages", BY_HAND)
def test_coefficients_are_those_in_print(stages):
    for ours, printed in zip(_table(stages), BY_HAND[stages], strict=False):
        np.testing.assert_allclose(ours, printed, rtol=0, atol=2e-16)


@pytest.mark.parametrize("stages", STAGES)
def test_conditions_of_order_hold_and_the_next_does_not(stages):
    """B(2s − 2), C(s) of IIIA, C(s − 2) of IIIB, symmetry and symplecticity, to round-off."""
    c, b, a, a_hat, last = _table(stages)

    def defect(k):
        return abs(b @ c ** (k - 1) - 1 / k)

    assert max(defect(k) for k in range(1, 2 * stages - 1)) < 3e-16
    assert defect(2 * stages - 1) > 1e-6
    for k in range(1, stages + 1):
        np.testing.assert_allclose(a @ c ** (k - 1), c**k / k, rtol=0, atol=3e-16)
    for k in range(1, stages - 1):
        np.testing.assert_allclose(a_hat @ c ** (k - 1), c**k / k, rtol=0, atol=3e-16)
    np.testing.assert_allclose(c + c[::-1], 1, rtol=0, atol=0)
    np.testing.assert_allclose(a + a[::-1, ::-1], np.tile(b, (stages, 1)), rtol=0, atol=3e-16)
    products = np.outer(b, b)
    np.testing.assert_allclose(b[:, None] * a_hat + b * a.T, products, rtol=0, atol=5e-17)
    assert np.max(np.abs(b[:, None] * a + b * a.T - products)) > 1e-3  # IIIA alone is not
    np.testing.assert_array_equal([*a[0], *a_hat[:, -1]], 0)
    np.testing.assert_allclose(last @ a_hat[:-1], a_hat[-1], rtol=0, atol=5e-16)


def step_by_hand(table, z, t, h, epsilon):
    """A step for H = (q² + 1)(p² + 1)/2 and W = −(1 + q²)p + cos t, by fixed-point iteration."""
    c, b, a, a_hat = (jnp.asarray(part, float) for part in table)
    q, p = z

    def rates(known):
        dq, dp = known
        Q, P = q + h * a @ dq, p + h * a_hat @ dp
        return (Q**2 + 1) * P, -Q * (P**2 + 1) + epsilon * (-(1 + Q**2) * P + jnp.cos(t + c * h))

    zero = jnp.zeros(len(b))
    dq, dp = jax.lax.fori_loop(0, 60, lambda _, known: rates(known), (zero, zero))
    return jnp.stack([q + h * b @ dq, p + h * b @ dp])


@functools.cache
def advance(system, stages):
    """One jitted step (z, t0, h, ε) → z of the pair."""
    s, method = SYSTEMS[system][0], dvi.LobattoIIIAIIIB(stages)
    return jax.jit(lambda z, t0, h, epsilon: flow(s, method, h, t0=t0, epsilon=epsilon)(z))


@pytest.mark.parametrize("stages", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_stage_equations_hold(stages):
    z, t0, h, epsilon = jnp.array([0.3, 0.4]), 0.7, 0.1, 0.2
    ours = advance("non_separable", stages)(z, t0, h, epsilon)
    by_hand = jax.jit(functools.partial(step_by_hand, BY_HAND[stages]))
    np.testing.assert_allclose(ours, by_hand(z, t0, h, epsilon), rtol=0, atol=1e-15)
    assert np.max(np.abs(ours - by_hand(z, t0 + 1e-3, h, epsilon))) > 1e-8  # time does matter


T_END = 3.0
START = np.array([0.9, 0.8])
"""Of the non-separable problem: far enough out for the errors of order 10 to be seen."""


@functools.cache
def reference(epsilon):
    """SciPy's DOP853 on the continuous equations, non-separable, damped and driven."""
    s = SYSTEMS["non_separable"][0]
    dH, W = jax.jit(jax.grad(s.H_D, argnums=(2, 3))), jax.jit(s.force)

    def field(t, z):
        q, p = np.split(z, 2)
        dq, dp = dH(t, t, q, p, ARGS)
        return np.concatenate([dp, -dq + epsilon * W(t, t, q, p, ARGS)])

    return solve_ivp(field, (0, T_END), START, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


NUMBERS = {2: [32, 64, 128], 3: [16, 32, 64], 4: [16, 24, 32], 5: [12, 16, 20], 6: [10, 12, 14]}


def measured_order(step, epsilon, numbers):
    """The order between the two smallest steps, all of them with errors above round-off."""
    errors = []
    for n in numbers:
        z, h = jnp.asarray(START), T_END / n
        for k in range(n):
            z = step(z, k * h, h, epsilon)
        errors.append(np.max(np.abs(z - reference(epsilon))))
    assert min(errors) > 3e-13, f"round-off reached: {errors}"
    return np.log(errors[-2] / errors[-1]) / np.log(numbers[-1] / numbers[-2])


@pytest.mark.parametrize("epsilon", [0.0, 0.2])
@pytest.mark.parametrize("stages", some_slow(STAGES))
def test_order_undisturbed_and_with_a_damped_and_driven_force(stages, epsilon):
    found = measured_order(advance("non_separable", stages), epsilon, NUMBERS[stages])
    assert abs(found - dvi.LobattoIIIAIIIB(stages).order) < 0.2


def test_a_wrong_node_or_a_wrong_coefficient_costs_the_order():
    c, b, a, a_hat = BY_HAND[3]
    wrong = np.array(a_hat)
    wrong[1, :2] += [0.01, -0.01]

    def order(*table):
        return measured_order(jax.jit(functools.partial(step_by_hand, table)), 0.2, NUMBERS[3])

    assert abs(order(*BY_HAND[3]) - 4) < 0.2
    assert order([0, 0.51, 1], b, a, a_hat) < 1.5  # the driving force at a wrong time
    assert order(c, b, a, wrong) < 2.5


def cases(*in_every_run):
    """Every system and every number of stages, all but those named marked slow.

    Shifted, so that the double pendulum, which takes longest to compile, has two stages.
    """
    every = dict.fromkeys([*in_every_run, *covering(SYSTEMS, STAGES, shift=2)])
    slow = pytest.mark.slow
    return [c if c in in_every_run else pytest.param(*c, marks=slow) for c in every]


@pytest.mark.parametrize(("system", "stages"), cases(("non_separable", 2)))
@pytest.mark.slow
def test_undisturbed_step_is_symplectic_and_a_damped_one_is_not(system, stages):
    step = advance(system, stages)

    def jacobian(epsilon):
        return np.asarray(jax.jacfwd(lambda z: step(z, 0.0, 0.1, epsilon))(state(system)))

    assert symplectic_defect(jacobian(0.0)) <= 1e-12
    if system != "kepler":  # its force is a spring
        assert np.linalg.det(jacobian(0.3)) < 0.99


def test_one_family_for_both_is_not_symplectic():
    """By hand on the non-separable problem: IIIA with IIIB is, IIIA or IIIB with itself is not."""
    c, b, a, a_hat = (jnp.asarray(part, float) for part in BY_HAND[3])

    @jax.jit
    def jacobian(a, a_hat):
        return jax.jacfwd(lambda z: step_by_hand((c, b, a, a_hat), z, 0.0, 0.4, 0.0))(START)

    assert symplectic_defect(np.asarray(jacobian(a, a_hat))) <= 1e-12
    assert symplectic_defect(np.asarray(jacobian(a, a))) > 1e-4
    assert symplectic_defect(np.asarray(jacobian(a_hat, a_hat))) > 1e-4


@pytest.mark.parametrize(("system", "stages"), cases(("non_separable", 2), ("non_separable", 4)))
def test_step_there_and_back_with_the_force_on(system, stages):
    step, z = advance(system, stages), state(system)
    there = step(z, 0.0, 0.1, 0.1)
    assert np.max(np.abs(step(there, 0.1, -0.1, 0.1) - z)) <= 1e-14
    assert np.max(np.abs(step(there, 0.2, -0.1, 0.1) - z)) > 1e-9 or system == "kepler"  # time


@pytest.mark.parametrize("system", ["kepler", "non_separable"])
@pytest.mark.slow
def test_two_stages_are_strang_forced_and_implicit_too(system):
    """Kick, drift, kick; drift, kick, drift is another map."""
    s, z = SYSTEMS[system][0], state(system)

    def end(method):
        return np.asarray(flow(s, method, 0.1, num_steps=10, epsilon=0.2)(z))

    ours = end(dvi.LobattoIIIAIIIB(2))
    np.testing.assert_allclose(ours, end(dvi.Strang()), rtol=0, atol=1e-14)
    assert np.max(np.abs(ours - end(dvi.Strang(base=dvi.Adjoint())))) > 1e-5


@pytest.mark.slow
def test_it_is_explicit_for_two_stages_of_a_separable_system():
    def damped(t0, t1, q0, p1, args):
        return -p1

    two, three = dvi.LobattoIIIAIIIB(2), dvi.LobattoIIIAIIIB(3)
    assert two.is_explicit(dvi.System(pendulum))
    assert not three.is_explicit(dvi.System(pendulum))
    assert not two.is_explicit(dvi.System(pendulum, damped))
    assert not two.is_explicit(dvi.System(non_separable))
    steps = {"h": 0.1, "num_steps": 3, "method": two}
    sol = dvi.integrate(dvi.System(pendulum), [0.4], [0.7], **steps)
    assert int(sol.stats["newton_iterations"]) == 0
    sol = dvi.integrate(dvi.System(pendulum, damped), [0.4], [0.7], epsilon=0.1, **steps)
    assert int(sol.stats["newton_iterations"]) > 0


@pytest.mark.slow
@pytest.mark.parametrize("stages", [2, 4])
def test_solving_for_momenta_alone_gives_the_same_step(stages):
    """Adding 0·q·p makes ∂H/∂p depend on q, in the jaxpr only."""

    def coupled(t0, t1, q0, p1, args):
        return pendulum(t0, t1, q0, p1, args) + 0 * jnp.sum(q0 * p1)

    system, z = SYSTEMS["pendulum"][0], state("pendulum")
    full = dvi.System(coupled, system.force)
    ours = advance("pendulum", stages)(z, 0.3, 0.2, 0.2)
    method = dvi.LobattoIIIAIIIB(stages)
    np.testing.assert_allclose(
        ours, flow(full, method, 0.2, t0=0.3, epsilon=0.2)(z), rtol=0, atol=2e-16
    )
    assert np.max(np.abs(ours - advance("pendulum", stages)(z, 0.3, 0.2, 0.2001))) > 1e-6


@pytest.mark.parametrize("stages", [2, *(pytest.param(s, marks=pytest.mark.slow) for s in (3, 6))])
def test_angular_momentum_of_kepler_is_kept_to_round_off(stages):
    def momentum(t0, t1, q0, p0, q1, p1, args):
        return q1[0] * p1[1] - q1[1] * p1[0]

    def drift(method):
        final, observe = dvi.Save(final=True), dvi.MaxDrift(momentum)
        _, q, p = SYSTEMS["kepler"]
        at = {"h": 0.1, "num_steps": 1000, "args": ARGS, "method": method}
        return float(
            dvi.integrate(SYSTEMS["kepler"][0], q, p, save=final, observe=observe, **at).observed
        )

    assert drift(dvi.LobattoIIIAIIIB(stages)) < 1e-13
    assert stages > 2 or drift(dvi.RungeKutta4()) > 1e-6


def stationary_value(stages):
    """The H_D that the pair is the variational map of, for the non-separable H."""
    _, b, a, _ = (np.array(part) for part in BY_HAND[stages])

    def H_D(t0, t1, q0, p1, args):
        h, shape = t1 - t0, (stages, *q0.shape)

        def H(q, p):
            return non_separable(t0, t1, q, p, args)

        def improved(_, curve):
            q_falls, q_rates = jax.vmap(jax.grad(H, argnums=(0, 1)))(*curve)
            Q = q0[None] + h * jnp.tensordot(a, q_rates, 1)
            # where the value is stationary in V: P_j = p1 + h Σ_i b_i a_ij / b_j ∂H/∂q_i
            return Q, p1[None] + h * jnp.tensordot((b[:, None] * a / b).T, q_falls, 1)

        start = (jnp.broadcast_to(q0, shape), jnp.broadcast_to(p1, shape))
        Q, P = jax.lax.fori_loop(0, 25, improved, start)
        V = jax.vmap(jax.grad(H, argnums=1))(Q, P)
        return b @ (jax.vmap(H)(Q, P) - jnp.sum((P - p1[None]) * V, axis=1))

    return H_D


@pytest.mark.slow
@pytest.mark.parametrize("stages", BY_HAND)
def test_it_is_the_variational_map_of_a_stationary_value(stages):
    z = state("non_separable")
    variational = flow(dvi.System(stationary_value(stages)), dvi.TypeII(), 0.1)(z)
    ours = advance("non_separable", stages)(z, 0.0, 0.1, 0.0)
    np.testing.assert_allclose(ours, variational, rtol=0, atol=1e-15)
    other = advance("non_separable", 5 - stages)(z, 0.0, 0.1, 0.0)
    assert np.max(np.abs(other - ours)) > 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(("system", "stages"), [("pendulum", 2), ("non_separable", 3)])
def test_gradients_in_the_state_epsilon_and_h(system, stages):
    s, method = SYSTEMS[system][0], dvi.LobattoIIIAIIIB(stages)

    def value(x):
        of = flow(s, method, x[3], num_steps=3, epsilon=x[2], adjoint=dvi.Reversible())
        return jnp.sum(of(x[:2]) ** 3)

    x, direction = jnp.array([0.3, 0.4, 0.2, 0.1]), jnp.array([0.6, -0.8, 0.4, 0.3])
    reverse = jax.jit(jax.grad(value))(x)
    _, forward = jax.jit(lambda x, d: jax.jvp(value, (x,), (d,)))(x, direction)
    np.testing.assert_allclose(forward, reverse @ direction, rtol=1e-12)
    np.testing.assert_allclose(forward, central_difference(jax.jit(value), x, direction), rtol=1e-9)
    assert np.min(np.abs(reverse)) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("stages", [2, 3])
def test_a_batch_is_the_loop_over_its_lanes(stages):
    """Lanes that are lost spoil no other, and each is told."""

    def step(z):
        at = {"h": 0.1, "num_steps": 1, "epsilon": 0.3, "throw": False}
        method = dvi.LobattoIIIAIIIB(stages)
        sol = dvi.integrate(SYSTEMS["non_separable"][0], z[:1], z[1:], method=method, **at)
        return sol.qs[-1], sol.ps[-1], sol.result == dvi.RESULTS.successful

    zs = jnp.outer(jnp.array([0.5, 1.0, 3.0, jnp.nan, 1e3]), state("non_separable"))
    batch = jax.jit(jax.vmap(step))(zs)
    loop = [jnp.stack(part) for part in zip(*map(jax.jit(step), zs), strict=True)]
    np.testing.assert_allclose(batch[0], loop[0], rtol=1e-14)
    np.testing.assert_allclose(batch[1], loop[1], rtol=1e-14)
    np.testing.assert_array_equal(batch[2], [True, True, True, False, False])
    np.testing.assert_array_equal(loop[2], batch[2])
    assert np.isfinite(batch[0][:3]).all()
    assert np.isnan(batch[0][3:]).all()


@pytest.mark.slow
def test_status_iterations_and_residual_are_reported():
    def one_step(newton=dvi.Newton(), h=0.1):
        at = {"h": h, "num_steps": 1, "newton": newton, "throw": False}
        return dvi.integrate(dvi.System(non_separable), [0.3], [0.4], method=method, **at)

    method = dvi.LobattoIIIAIIIB(3)
    good = one_step()
    assert good.status == "successful"
    assert 1 <= int(good.stats["newton_iterations"]) <= 3
    assert float(good.stats["max_residual"]) < 1e-14
    assert one_step(h=1.0).status == "successful"
    short = one_step(dvi.Newton(max_steps=1), h=1.0)  # one Jacobian is enough at h = 0.1
    assert short.status == "not_converged"
    assert np.isnan(short.qs[-1]).all()


@pytest.mark.parametrize("stages", [0, 1, 7, -1, 2.5, 2.0, True, None, "2"])
def test_other_numbers_of_stages_are_refused(stages):
    with pytest.raises(ValueError, match="stages must be a whole number from 2 to 6"):
        dvi.LobattoIIIAIIIB(stages)
