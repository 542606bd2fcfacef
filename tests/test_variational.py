"""Steps that solve the lattice equation: exact balance of energy, where there is a root."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference

import dvi_jax as dvi
import lanewise
from dvi_jax import systems

KEPLER = systems.kepler()
PENDULUM = dvi.System(
    lambda t0, t1, q, p, args: jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q)),
    force=lambda t0, t1, q, p, args: -p + jnp.cos(t0),
)
DRIVEN = dvi.System(
    lambda t0, t1, q, p, args: jnp.sum(p**2) / 2 + (1 + 0.1 * jnp.sin(t0 + t1)) * jnp.sum(q**4),
    force=lambda t0, t1, q, p, args: -(1 + q**2) * p,
)
IMPLICIT = dvi.System(lambda t0, t1, q, p, args: jnp.sum((q**2 + 1) * (p**2 + 1)) / 2)


def midpoint(t0, t1, q0, p1, args):
    """The oscillator's H_D of the implicit midpoint rule, in closed form: order 2."""
    v = midpoint_velocity(t0, t1, q0, p1)
    middle = q0 + (t1 - t0) * v / 2
    return jnp.sum(p1 * v - v**2 / 2 + middle**2 / 2)


def midpoint_velocity(t0, t1, q0, p1):
    h = t1 - t0
    return (p1 + h * q0 / 2) / (1 - h**2 / 4)


DAMPED = dvi.System(midpoint, force=lambda t0, t1, q0, p1, args: -midpoint_velocity(t0, t1, q0, p1))


ARGS = KEPLER.args


def kepler(h, steps, policy="stop", **settings):
    given = {"args": ARGS, "throw": False, "lattice": dvi.Variational(policy), **settings}
    return dvi.integrate(KEPLER.system, KEPLER.q0, KEPLER.p0, h=h, num_steps=steps, **given)


def defects(system, solution, epsilon):
    """h r of `lattice_defect` at the inner points, from the saved states alone."""
    points = list(zip(solution.ts, solution.qs, solution.ps, strict=True))
    at = jax.jit(lambda *x: dvi.lattice_defect(system, x, epsilon) * (x[2][0] - x[1][0]))
    return np.array([at(*points[i : i + 3]) for i in range(len(points) - 2)])


@pytest.mark.parametrize(("h", "steps", "time"), [(0.1, 77, 30.9877), (0.01, 1796, 20.0735)])
def test_keplers_steps_end_where_the_equation_loses_its_root(h, steps, time):
    """As the closed form in the paper's verdict says; until then H_D is one number."""
    sol = kepler(h, 2000, observe=KEPLER.observables["mixed_energy"])
    assert sol.status == "no_root"
    assert int(sol.stats["failed_step"]) == steps
    assert abs(float(sol.ts[steps]) - time) < 1e-3
    for values in (sol.ts[1:], sol.hs, sol.qs[1:, 0], sol.ps[1:, 0]):
        assert np.isfinite(np.asarray(values)[:steps]).all()
        assert np.isnan(np.asarray(values)[steps:]).all()
    values = np.asarray(sol.observed)[:steps]
    assert np.ptp(values) <= 1e-14
    assert np.all(np.asarray(sol.hs)[:steps] > 0)
    fixed = kepler(h, steps, lattice=dvi.Uniform(), observe=KEPLER.observables["mixed_energy"])
    assert np.ptp(np.asarray(fixed.observed)) > 1e-3


@pytest.mark.parametrize(("system", "epsilon"), [(PENDULUM, 0.1), (DRIVEN, 0.2)])
@pytest.mark.slow
def test_energy_is_in_balance_with_the_work_of_a_force(system, epsilon):
    """With forces that depend on p and t, and an H_D that depends on both times."""
    settings = {"h": 0.02, "num_steps": 25, "epsilon": epsilon, "throw": False}
    sol = dvi.integrate(system, [0.3], [0.9], lattice=dvi.Variational(), **settings)
    assert sol.status == "successful"
    assert np.ptp(np.asarray(sol.hs)) > 1e-4  # the steps did adapt
    assert np.max(np.abs(defects(system, sol, epsilon))) <= 2e-15
    assert float(sol.stats["lattice_defect"]) <= 2e-15
    fixed = dvi.integrate(system, [0.3], [0.9], **settings)
    assert np.max(np.abs(defects(system, fixed, epsilon))) > 1e-5


@pytest.mark.slow
def test_balance_law_has_no_term_of_the_lattice():
    """(31): with ξ0 = 1 energy changes by nothing but the work of the force."""
    how = {"h": 0.02, "num_steps": 25, "epsilon": 0.1, "lattice": dvi.Variational()}
    sol = dvi.integrate(PENDULUM, [0.3], [0.9], **how)
    time = dvi.generators.time_translation()
    balance = dvi.noether_balance(PENDULUM, [time], [None], sol, epsilon=0.1)
    assert np.max(np.abs(balance.lattice)) <= 1e-12
    assert np.max(np.abs(balance.defect)) <= 1e-12
    assert np.max(np.abs(balance.work)) > 1e-3


@pytest.mark.slow
def test_policies_where_there_is_no_root():
    calls = []
    hold, least = kepler(0.1, 200, "hold"), kepler(0.1, 200, "minimise")
    reported = kepler(0.1, 200, "hold", progress=lambda done, of: calls.append(done))
    assert calls[-1] == 200
    np.testing.assert_array_equal(reported.ts, hold.ts)
    assert hold.status == least.status == "successful"
    assert int(hold.stats["lattice_misses"]) == 1
    k = 77  # where "stop" ends
    assert float(hold.hs[k]) == float(hold.hs[k - 1])
    np.testing.assert_array_equal(hold.hs[:k], least.hs[:k])

    def defect(sol):
        points = list(zip(sol.ts[k - 1 :], sol.qs[k - 1 :], sol.ps[k - 1 :], strict=True))[:3]
        r = dvi.lattice_defect(KEPLER.system, points, args=ARGS)
        return abs(float(r * (points[2][0] - points[1][0])))

    assert 1e-6 < defect(least) < defect(hold)
    assert float(hold.stats["lattice_defect"]) == pytest.approx(defect(hold), rel=1e-9)


@pytest.mark.slow
def test_minimum_is_one():
    """Steps a little to both sides of the one taken leave a larger defect."""
    k = 77
    least = kepler(0.1, k + 1, "minimise")
    before, here = ((least.ts[i], least.qs[i], least.ps[i]) for i in (k - 1, k))

    def defect(h):
        how = {"h": h, "num_steps": 1, "t0": here[0], "args": ARGS}
        one = dvi.integrate(KEPLER.system, here[1], here[2], **how)
        after = (one.ts[1], one.qs[1], one.ps[1])
        return abs(float(h * dvi.lattice_defect(KEPLER.system, (before, here, after), args=ARGS)))

    h = float(least.hs[k])
    assert defect(h) < min(defect(0.99 * h), defect(1.01 * h))


@pytest.mark.slow
def test_backwards_and_bounded():
    back = kepler(-0.1, 20)
    assert np.all(np.asarray(back.hs) < 0)
    narrow = kepler(0.1, 30, lattice=dvi.Variational(bounds=(0.5, 1.5)))
    assert narrow.status == "no_root"  # the steps of this orbit grow further than that
    taken = np.asarray(narrow.hs)[: int(narrow.stats["failed_step"])]
    assert taken.min() >= 0.05
    assert taken.max() <= 0.15
    assert np.max(np.asarray(kepler(0.1, 30).hs)) > 0.15


@pytest.mark.slow
def test_free_motion_keeps_its_step_and_implicit_systems_work():
    """Of free motion E⁺ does not depend on h: every h is a root."""
    free = dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2) / 2)
    sol = dvi.integrate(free, [0.1], [0.7], h=0.3, num_steps=50, lattice=dvi.Variational())
    np.testing.assert_array_equal(sol.hs, 0.3)
    sol = dvi.integrate(IMPLICIT, [0.3], [0.4], h=0.05, num_steps=10, lattice=dvi.Variational())
    assert int(sol.stats["newton_iterations"]) > 0
    assert np.max(np.abs(defects(IMPLICIT, sol, 0.0))) <= 2e-15


@pytest.mark.slow
def test_a_trajectory_without_a_root_leaves_others_unchanged():
    hs = jnp.asarray([0.1, 0.02, 0.05])
    batch = jax.vmap(lambda h: kepler(h, 90))(hs)
    assert list(batch.status) == ["no_root", "successful", "successful"]
    for i in (1, 2):
        np.testing.assert_allclose(batch.qs[i], kepler(hs[i], 90).qs, rtol=1e-9)
    assert np.isfinite(np.asarray(batch.qs[1:])).all()
    assert np.isnan(np.asarray(batch.qs[0, -1])).all()


def ends(x, lattice, adjoint):
    """A number that the end state, its time and all steps enter."""
    q, p, h, epsilon = x
    how = {"h": h, "num_steps": 12, "epsilon": epsilon, "lattice": lattice, "adjoint": adjoint}
    sol = dvi.integrate(PENDULUM, q, p, **how)
    return jnp.sum(sol.qs[-1] ** 2) + jnp.sum(sol.ps) + jnp.sum(sol.ts**2) + jnp.sum(sol.hs**3)


POINT = tuple(map(jnp.asarray, ([0.3], [0.9], 0.03, 0.1)))


@functools.cache
def gradient(adjoint):
    return jax.jit(jax.grad(lambda x: ends(x, dvi.Variational(), adjoint)))(POINT)


@pytest.mark.slow
def test_steps_that_are_solved_for_have_the_same_bits_in_a_batch():
    """With a force of p each candidate of (14) needs a solve of its own, each of other length."""
    system = dvi.System(
        lambda t0, t1, q, p, args: p @ p / 2 + q @ q / 2,
        force=lambda t0, t1, q, p, args: -p * (q @ q),
    )

    how = {"epsilon": 0.1, "h": 0.1, "num_steps": 5, "throw": False, "lattice": dvi.Variational()}

    def one(q, p):
        sol = dvi.integrate(system, q, p, **how)
        return sol.ts, sol.qs, sol.ps

    q, p = np.random.default_rng(1).normal(size=(2, 9, 2))
    assert "left to XLA" not in str(lanewise.explain(one, q[0], p[0]))
    batch, single = jax.jit(jax.vmap(one))(q, p), jax.jit(one)(q[4], p[4])
    for a, b in zip(batch, single, strict=True):
        np.testing.assert_array_equal(a[4], b)


@pytest.mark.slow
def test_gradient_equals_central_differences():
    value = jax.jit(lambda x: ends(x, dvi.Variational(), dvi.Direct()))
    ones = jax.tree.map(jnp.ones_like, POINT)
    slope = sum(float(jnp.sum(g)) for g in gradient(dvi.Direct()))
    expected = float(central_difference(value, POINT, ones, step=1e-4))
    assert slope == pytest.approx(expected, rel=1e-7)
    frozen = jax.jit(lambda x: ends(x, dvi.Uniform(), dvi.Direct()))
    assert central_difference(frozen, POINT, ones, step=1e-4) != pytest.approx(expected, rel=1e-2)


@pytest.mark.slow
def test_adjoints_and_forward_mode_agree():
    expected = gradient(dvi.Direct())
    for adjoint in (dvi.Checkpointed(), dvi.Reversible()):
        for a, b in zip(gradient(adjoint), expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10)
    forward = jax.jit(jax.jacfwd(lambda x: ends(x, dvi.Variational(), dvi.Direct())))(POINT)
    for a, b in zip(forward, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10)


@pytest.mark.slow
def test_gradient_through_a_step_that_minimises():
    oscillator = dvi.System(lambda t0, t1, q, p, args: (jnp.sum(p**2) + jnp.sum(q**2)) / 2)

    def run(h, policy="minimise"):
        how = {"num_steps": 6, "lattice": dvi.Variational(policy), "throw": False}
        return dvi.integrate(oscillator, [1.0], [0.5], h=h, **how)

    def value(h):
        sol = run(h)
        return sol.ts[-1] + jnp.sum(sol.qs[-1])

    assert int(run(0.1, "stop").stats["failed_step"]) == 3
    assert int(run(0.1).stats["lattice_misses"]) == 2
    step = 1e-6
    expected = (value(0.1 + step) - value(0.1 - step)) / (2 * step)
    slope = jax.jvp(value, (0.1,), (1.0,))[1]
    assert float(slope) == pytest.approx(float(expected), rel=1e-4)


def damped(h, steps, c):
    how = {"epsilon": c, "throw": False, "observe": dvi.LatticeCondition()}
    lattice = dvi.Variational()
    return dvi.integrate(DAMPED, [1.0], [0.5], h=h, num_steps=steps, lattice=lattice, **how)


@pytest.mark.slow
def test_steps_grow_under_damping():
    """From one half-period to the next, tens of times over the run; not without damping."""
    sol = damped(0.1, 350, 0.05)
    assert sol.status == "successful"
    half = np.pi * np.arange(1, int(sol.ts[-1] / np.pi))
    means = np.pi / np.diff(np.interp(half, sol.ts, np.arange(len(sol.ts))))
    assert np.all(np.diff(means) > 0)
    assert means[-1] > 3 * means[0]
    rest = damped(0.1, 350, 0.0)
    np.testing.assert_allclose(rest.hs, 0.1, rtol=1e-9)


@pytest.mark.slow
def test_condition_number_of_the_midpoint_rule():
    """Undamped, E⁺ = (p0² + q0²)/2/(1 + h²/4): κ = 2/(h · h/2/(1 + h²/4)) = 1 + 4/h²."""
    for h in (0.1, 0.05):
        # The size counts E⁺ and E⁻: twice the energy.
        np.testing.assert_allclose(damped(h, 5, 0.0).observed, 1 + 4 / h**2, rtol=1e-9)
    with pytest.raises(ValueError, match="has no system"):
        dvi.LatticeCondition()(0.0, 0.1, *[jnp.ones(1)] * 4, None)


def test_a_run_without_a_root_raises():
    with pytest.raises(dvi.IntegrationError, match=r"last h = 3\.07.*no root near the last step"):
        kepler(0.1, 80, throw=True)
