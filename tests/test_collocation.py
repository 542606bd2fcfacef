"""Gauss–Legendre and Lobatto IIIA–IIIB methods: coefficients, stage equations, order, invariants.

`test_certify.py` tests order, symplecticity, reversal, momentum, gradients, batches and statuses of
all methods in the registry, which have up to four stages; here are those with more.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ARGS, SYSTEMS, flow, non_separable, pendulum, state, symplectic_defect
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax.methods import _gauss_legendre, _lobatto_pair

SLOW = pytest.mark.slow
GAUSS, LOBATTO = dvi.GaussLegendre, dvi.LobattoIIIAIIIB
EXACT = {GAUSS: _gauss_legendre._table, LOBATTO: _lobatto_pair._table}


def rounded_table(kind, stages):
    return [part.astype(float) for part in EXACT[kind](stages)]


R3, R15 = 3**0.5, 15**0.5
BY_HAND = {
    (GAUSS, 1): ([1 / 2], [1], [[1 / 2]]),
    (GAUSS, 2): ([1 / 2 - R3 / 6, 1 / 2 + R3 / 6], [1 / 2, 1 / 2],
                 [[1 / 4, 1 / 4 - R3 / 6], [1 / 4 + R3 / 6, 1 / 4]]),
    (GAUSS, 3): ([1 / 2 - R15 / 10, 1 / 2, 1 / 2 + R15 / 10], [5 / 18, 4 / 9, 5 / 18],
                 [[5 / 36, 2 / 9 - R15 / 15, 5 / 36 - R15 / 30],
                  [5 / 36 + R15 / 24, 2 / 9, 5 / 36 - R15 / 24],
                  [5 / 36 + R15 / 30, 2 / 9 + R15 / 15, 5 / 36]]),
    (LOBATTO, 2): ([0, 1], [1 / 2, 1 / 2], [[0, 0], [1 / 2, 1 / 2]], [[1 / 2, 0], [1 / 2, 0]]),
    (LOBATTO, 3): ([0, 1 / 2, 1], [1 / 6, 2 / 3, 1 / 6],
                   [[0, 0, 0], [5 / 24, 1 / 3, -1 / 24], [1 / 6, 2 / 3, 1 / 6]],
                   [[1 / 6, -1 / 6, 0], [1 / 6, 1 / 3, 0], [1 / 6, 5 / 6, 0]]),
}  # fmt: skip
"""c, b, a (and â of Lobatto IIIB) as printed: Hairer, Lubich & Wanner 2006, II.1.3 and II.1.4."""


def cases(*quick, slow=()):
    return [*quick, *(pytest.param(*case, marks=SLOW) for case in slow)]


def by_hand(kind, stages):
    """(c, b, a, â); Gauss' a serves both."""
    c, b, a, *a_hat = map(np.array, BY_HAND[kind, stages])
    return c, b, a, *(a_hat or [a])


@pytest.mark.parametrize(("kind", "stages"), BY_HAND)
def test_coefficients_are_those_in_print(kind, stages):
    for ours, printed in zip(rounded_table(kind, stages), BY_HAND[kind, stages], strict=False):
        np.testing.assert_allclose(ours, printed, rtol=0, atol=3e-16)


@pytest.mark.parametrize(
    ("kind", "stages"), [*((GAUSS, s) for s in range(1, 9)), *((LOBATTO, s) for s in range(2, 7))]
)
def test_order_conditions_hold_and_the_next_does_not(kind, stages):
    """B(order), C(s) (of IIIB C(s − 2)), and symplecticity, in the notation of the source."""
    c, b, a, *more = rounded_table(kind, stages)
    order = kind(stages).order

    def defect(k):
        return abs(b @ c ** (k - 1) - 1 / k)

    assert max(defect(k) for k in range(1, order + 1)) < (1e-15 if kind is GAUSS else 3e-16)
    for k in range(1, stages + 1):
        np.testing.assert_allclose(a @ c ** (k - 1), c**k / k, rtol=0, atol=1e-15)
    products = np.outer(b, b)
    a_hat = more[0] if more else a
    np.testing.assert_allclose(b[:, None] * a_hat + b * a.T, products, rtol=0, atol=5e-17)
    if kind is GAUSS:
        exact = np.prod([k**4 / ((2 * k - 1) * (2 * k)) ** 2 for k in range(1, stages + 1)])
        np.testing.assert_allclose(defect(order + 1), exact / (order + 1), atol=1e-15)
        return
    assert defect(order + 1) > 1e-6
    for k in range(1, stages - 1):
        np.testing.assert_allclose(a_hat @ c ** (k - 1), c**k / k, rtol=0, atol=3e-16)
    np.testing.assert_allclose(c + c[::-1], 1, rtol=0, atol=0)
    np.testing.assert_allclose(a + a[::-1, ::-1], np.tile(b, (stages, 1)), rtol=0, atol=3e-16)
    assert np.max(np.abs(b[:, None] * a + b * a.T - products)) > 1e-3  # IIIA alone is not
    np.testing.assert_array_equal([*a[0], *a_hat[:, -1]], 0)
    np.testing.assert_allclose(more[1] @ a_hat[:-1], a_hat[-1], rtol=0, atol=5e-16)


@pytest.mark.parametrize(
    ("kind", "range", "others"), [(GAUSS, "1 to 8", (0, 9)), (LOBATTO, "2 to 6", (0, 1, 7))]
)
def test_other_numbers_of_stages_are_rejected(kind, range, others):
    for stages in (*others, -1, 2.5, 2.0, True, None, "2"):
        with pytest.raises(ValueError, match=f"stages must be an integer from {range}"):
            kind(stages)


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
def advance(kind, stages, system="non_separable"):
    """One jitted step (z, t0, h, ε) → z."""
    s, method = SYSTEMS[system][0], kind(stages)
    return jax.jit(lambda z, t0, h, epsilon: flow(s, method, h, t0=t0, epsilon=epsilon)(z))


@pytest.mark.parametrize(
    ("kind", "stages"), cases((GAUSS, 2), (LOBATTO, 2), slow=[(GAUSS, 1), (GAUSS, 3), (LOBATTO, 3)])
)
def test_stage_equations_hold(kind, stages):
    z, t0, h, epsilon = jnp.array([0.3, 0.4]), 0.7, 0.1, 0.2
    ours = advance(kind, stages)(z, t0, h, epsilon)
    other = jax.jit(functools.partial(step_by_hand, by_hand(kind, stages)))
    np.testing.assert_allclose(ours, other(z, t0, h, epsilon), rtol=0, atol=1e-15)
    assert np.max(np.abs(ours - other(z, t0 + 1e-3, h, epsilon))) > 1e-8  # time does matter


def stationary_value(kind, stages):
    """The H_D whose variational map the method is, for the non-separable H."""
    _, b, a, _ = by_hand(kind, stages)

    def H_D(t0, t1, q0, p1, args):
        h, shape = t1 - t0, (stages, *q0.shape)

        def H(q, p):
            return non_separable(t0, t1, q, p, args)

        def improved(_, curve):
            q_falls, q_rates = jax.vmap(jax.grad(H, argnums=(0, 1)))(*curve)
            Q = q0[None] + h * jnp.tensordot(a, q_rates, 1)
            # Stationary in V: P_j = p1 + h Σ_i b_i a_ij / b_j ∂H/∂q_i.
            return Q, p1[None] + h * jnp.tensordot((b[:, None] * a / b).T, q_falls, 1)

        start = (jnp.broadcast_to(q0, shape), jnp.broadcast_to(p1, shape))
        Q, P = jax.lax.fori_loop(0, 25, improved, start)
        V = jax.vmap(jax.grad(H, argnums=1))(Q, P)
        return b @ (jax.vmap(H)(Q, P) - jnp.sum((P - p1[None]) * V, axis=1))

    return H_D


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "stages"), [(GAUSS, 2), (LOBATTO, 2), (LOBATTO, 3)])
def test_it_is_the_variational_map_of_a_stationary_value(kind, stages):
    z = state("non_separable")
    variational = flow(dvi.System(stationary_value(kind, stages)), dvi.TypeII(), 0.1)(z)
    ours = flow(dvi.System(non_separable), kind(stages), 0.1)(z)
    np.testing.assert_allclose(ours, variational, rtol=0, atol=1e-15)
    plain = flow(dvi.System(non_separable), dvi.TypeII(), 0.1)(z)
    assert np.max(np.abs(plain - ours)) > 1e-3


@pytest.mark.slow
def test_slow_time_and_perturbation_are_used_and_solves_only_where_needed():
    """ε t by hand, and the perturbation added to H_D by hand, give the same step."""

    def H(t0, t1, q0, p1, args):
        return pendulum(t0, t1, q0, p1, args) * (1 + jnp.sin(3 * t0) / 2)

    def push(t0, t1, q0, p1, args):
        return -p1 + jnp.cos(2 * t0)

    def bump(t0, t1, q0, p1, args):
        return jnp.sum(q0**4) * jnp.cos(t0)

    def total(t0, t1, q0, p1, args):
        s = 0.1 * t0
        return H(s, s, q0, p1, args) + 0.1 * bump(s, s, q0, p1, args)

    slow = dvi.System(H, push, bump, slow_time=True)
    manual = dvi.System(total, lambda t0, t1, *rest: push(0.1 * t0, 0.1 * t1, *rest))
    z, method = state("pendulum"), GAUSS(2)
    a, b = (flow(s, method, 0.2, t0=4.0, epsilon=0.1)(z) for s in (slow, manual))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)
    fast = flow(dvi.System(H, push, bump), method, 0.2, t0=4.0, epsilon=0.1)(z)
    assert np.max(np.abs(fast - a)) > 1e-3
    steps = {"h": 0.1, "num_steps": 3, "method": LOBATTO(2)}
    for system, epsilon in ((dvi.System(pendulum), 0.0), (dvi.System(pendulum, damped), 0.1)):
        sol = dvi.integrate(system, [0.4], [0.7], epsilon=epsilon, **steps)
        assert (int(sol.stats["newton_iterations"]) > 0) == (epsilon > 0)


@pytest.mark.parametrize("system", ["kepler", "non_separable"])
@pytest.mark.slow
def test_two_lobatto_stages_are_strang_forced_and_implicit_too(system):
    """Kick, drift, kick; drift, kick, drift is another map."""
    s, z = SYSTEMS[system][0], state(system)

    def end(method):
        return np.asarray(flow(s, method, 0.1, num_steps=10, epsilon=0.2)(z))

    ours = end(LOBATTO(2))
    np.testing.assert_allclose(ours, end(dvi.Strang()), rtol=0, atol=1e-14)
    assert np.max(np.abs(ours - end(dvi.Strang(base=dvi.Adjoint())))) > 1e-5


def damped(t0, t1, q0, p1, args):
    return -p1


def test_declared_properties():
    assert (GAUSS(3).order, LOBATTO(3).order) == (6, 4)
    assert dvi.Yoshida(4, base=GAUSS(1)).is_symplectic
    explicit = [dvi.TypeII(), LOBATTO(2)]
    for method in (*explicit, GAUSS(3), LOBATTO(3)):
        assert method.is_explicit(dvi.System(pendulum)) == (method in explicit)
        assert not method.is_explicit(dvi.System(non_separable))
        assert not method.is_explicit(dvi.System(pendulum, damped))


@pytest.mark.slow
@pytest.mark.parametrize("stages", [2, 4])
def test_lobatto_solves_for_momenta_alone_with_the_same_result(stages):
    """Adding 0·q·p makes ∂H/∂p depend on q, in the jaxpr only."""

    def coupled(t0, t1, q0, p1, args):
        return pendulum(t0, t1, q0, p1, args) + 0 * jnp.sum(q0 * p1)

    system, z = SYSTEMS["pendulum"][0], state("pendulum")
    ours = advance(LOBATTO, stages, "pendulum")
    full = flow(dvi.System(coupled, system.force), LOBATTO(stages), 0.2, t0=0.3, epsilon=0.2)(z)
    np.testing.assert_allclose(ours(z, 0.3, 0.2, 0.2), full, rtol=0, atol=2e-16)
    assert np.max(np.abs(ours(z, 0.3, 0.2, 0.2001) - full)) > 1e-6


T_END = 3.0
START = np.array([0.9, 0.8])
"""Of the non-separable problem: far enough out for the errors of order 10 to be seen."""
NUMBERS = {2: [32, 64, 128], 3: [16, 32, 64], 5: [12, 16, 20], 6: [10, 12, 14]}


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


@pytest.mark.parametrize("stages", [2, *(pytest.param(s, marks=SLOW) for s in (5, 6))])
def test_order_unperturbed_and_with_a_damped_and_driven_force(stages):
    for epsilon in (0.0, 0.2):
        found = measured_order(advance(LOBATTO, stages), epsilon, NUMBERS[stages])
        assert abs(found - LOBATTO(stages).order) < 0.2


def test_wrong_coefficients_cost_the_order_or_symplecticity():
    c, b, a, a_hat = by_hand(LOBATTO, 3)
    wrong = a_hat + np.array([[0, 0, 0], [0.01, -0.01, 0], [0, 0, 0]])

    def order(*table):
        return measured_order(jax.jit(functools.partial(step_by_hand, table)), 0.2, NUMBERS[3])

    assert abs(order(c, b, a, a_hat) - 4) < 0.2
    assert order([0, 0.51, 1], b, a, a_hat) < 1.5  # the driving force at a wrong time
    assert order(c, b, a, wrong) < 2.5
    # By hand on the non-separable problem: IIIA with IIIB is, IIIA or IIIB with itself is not.
    c, b, *both = (jnp.asarray(part, float) for part in by_hand(LOBATTO, 3))

    @jax.jit
    def jacobian(a, a_hat):
        return jax.jacfwd(lambda z: step_by_hand((c, b, a, a_hat), z, 0.0, 0.4, 0.0))(START)

    assert symplectic_defect(np.asarray(jacobian(*both))) <= 1e-12
    for a in both:
        assert symplectic_defect(np.asarray(jacobian(a, a))) > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("stages", [2, *(pytest.param(s, marks=SLOW) for s in (5, 6))])
def test_the_step_reverses_and_is_symplectic_unless_damped(stages):
    step, z = advance(LOBATTO, stages), state("non_separable")
    there = step(z, 0.0, 0.1, 0.1)
    assert np.max(np.abs(step(there, 0.1, -0.1, 0.1) - z)) <= 1e-14
    assert np.max(np.abs(step(there, 0.2, -0.1, 0.1) - z)) > 1e-9  # the force at another time
    jacobian = jax.jit(jax.jacfwd(lambda z, epsilon: step(z, 0.0, 0.1, epsilon)))
    assert symplectic_defect(np.asarray(jacobian(z, 0.0))) <= 1e-12
    assert np.linalg.det(jacobian(z, 0.3)) < 0.99


@pytest.mark.slow
@pytest.mark.parametrize(("method", "most"), [(GAUSS(2), 5), (LOBATTO(3), 3)])
def test_status_iterations_and_residual_are_reported(method, most):
    def one_step(system=SYSTEMS["non_separable"][0], q=0.3, h=0.1, newton=dvi.Newton()):
        at = {"h": h, "num_steps": 1, "epsilon": 0.0, "newton": newton, "throw": False}
        return dvi.integrate(system, [q], [0.4], method=method, **at)

    good = one_step()
    assert good.status == one_step(h=1.0).status == "successful"
    assert 1 <= int(good.stats["newton_iterations"]) <= most
    assert float(good.stats["max_residual"]) < 1e-14
    short = one_step(newton=dvi.Newton(max_steps=1), h=1.0)  # one Jacobian may be enough at h = 0.1
    assert short.status == "not_converged"
    assert float(short.stats["failed_residual"]) > 1e-12
    assert np.isnan(short.qs[-1]).all()
    rooted = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + jnp.sum(jnp.sqrt(q0)))
    assert one_step(rooted, -1.0).status == "not_finite"
    assert one_step(rooted, 1.0).status == "successful"
