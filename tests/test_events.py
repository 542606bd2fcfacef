"""Sections, requested times and stops: points of a trajectory inside of its steps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, measured_orders, pendulum
from scipy.integrate import solve_ivp

import dvi_jax as dvi

E = 0.6
START = [1 - E, 0.0], [0.0, np.sqrt((1 + E) / (1 - E))]
KEPLER = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 - 1 / jnp.sqrt(q @ q))
SPRING = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2)


def on_axis(t, q, p, args):
    return q[1]


def first_component(t, q, p, args):
    return q[0]


def radius(t, q, p, args):
    return jnp.sqrt(q @ q)


def too_far(t, q, p, args):
    return radius(t, q, p, args) - 1.5


def momentum(t0, t1, q0, p0, q1, p1, args):
    return q1[0] * p1[1] - q1[1] * p1[0]


def kepler(h=0.02, num_steps=700, **settings):
    given = {"method": dvi.Strang(), "save": dvi.Save(final=True), **settings}
    return dvi.integrate(KEPLER, *START, h=h, num_steps=num_steps, **given)


@functools.cache
def exact(end=14.0, g=None, direction=0):
    """SciPy's DOP853 with its own event location."""

    def rates(t, y):
        return [*y[2:], *(-y[:2] / np.hypot(*y[:2]) ** 3)]

    def event(t, y):
        return float(g(t, y[:2], y[2:], None))

    event.direction = direction
    y0, events = [*START[0], *START[1]], [event] if g else None
    options = {"rtol": 1e-13, "atol": 1e-13, "dense_output": True}
    return solve_ivp(rates, (0, end), y0, "DOP853", events=events, **options)


def crossings_of(order, direction, h):
    method = dvi.Strang() if order == 2 else dvi.Yoshida(order)
    section = dvi.Section(on_axis, direction, max_crossings=6)
    return kepler(h, round(14 / h), method=method, observe=section).observed


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, 4])
def test_crossings_converge_with_the_order_of_the_method(order):
    known = exact(14.0, on_axis, 1)
    times, states = known.t_events[0][-2:], known.y_events[0][-2:]
    errors = []
    for h in (0.01, 0.005, 0.0025):
        found = crossings_of(order, 1, h)
        assert int(found.count) == 2
        np.testing.assert_allclose(found.qs[:2, 1], 0.0, atol=1e-14)
        assert np.isnan(np.asarray(found.ts[2:])).all()
        state = np.concatenate([found.qs[:2], found.ps[:2]], axis=1)
        errors.append(max(np.abs(found.ts[:2] - times).max(), np.abs(state - states).max()))
    orders = measured_orders(errors, 2.0, 1e-12)
    np.testing.assert_allclose(orders, order, atol=0.2)


@pytest.mark.slow
def test_directions_and_the_capacity_of_sections():
    up, down, both = (crossings_of(2, d, 0.01) for d in (1, -1, 0))
    assert (int(up.count), int(down.count), int(both.count)) == (2, 2, 4)
    assert np.all(np.asarray(up.ps[:2, 1]) > 0)
    assert np.all(np.asarray(down.ps[:2, 1]) < 0)
    together = np.sort(np.concatenate([up.ts[:2], down.ts[:2]]))
    np.testing.assert_array_equal(together, both.ts[:4])
    sol = kepler(observe=dvi.Section(on_axis, 0, max_crossings=3))
    assert int(sol.observed.count) == 4
    assert np.isfinite(np.asarray(sol.observed.ts)).all()


@pytest.mark.slow
def test_batches_and_gradients_of_sections():
    """Hénon and Heiles' surface of section; a trajectory that fails does not affect the others."""
    system, section = (
        dvi.systems.henon_heiles().system,
        dvi.Section(first_component, 1, max_crossings=10),
    )
    options = {"h": 0.05, "num_steps": 800, "throw": False, "method": dvi.Strang()}

    def run(y):
        p0 = jnp.stack([jnp.sqrt(2 * (1 / 12 - y**2 / 2 + y**3 / 3)), 0.0])
        save = dvi.Save(final=True)
        return dvi.integrate(system, jnp.stack([0.0, y]), p0, save=save, observe=section, **options)

    batch = jax.vmap(run)(jnp.asarray([0.1, jnp.nan, -0.2]))
    assert list(batch.status) == ["successful", "not_finite", "successful"]
    found = batch.observed
    assert int(found.count[1]) == 0
    for i, y in ((0, 0.1), (2, -0.2)):
        alone = run(jnp.asarray(y)).observed
        n = int(alone.count)
        assert n == int(found.count[i]) > 4
        np.testing.assert_allclose(found.qs[i, :n], alone.qs[:n], atol=1e-11)
        np.testing.assert_allclose(found.qs[i, :n, 0], 0.0, atol=1e-14)
    # Time and state of the crossing, in forward and both ways of reverse mode.
    x = (jnp.asarray(START[1]), jnp.asarray(0.03))
    ones = jax.tree.map(jnp.ones_like, x)
    value = jax.jit(lambda x: section_loss(x, dvi.Direct()))
    expected = float(central_difference(value, x, ones))
    forward = float(jax.jvp(value, (x,), (ones,))[1])
    assert forward == pytest.approx(expected, rel=1e-6)
    for adjoint in (dvi.Direct(), dvi.Reversible(checkpoint_every=10)):
        back = jax.tree.leaves(jax.grad(lambda x, a=adjoint: section_loss(x, a))(x))
        assert sum(float(jnp.sum(g)) for g in back) == pytest.approx(forward, rel=1e-9)


def section_loss(x, adjoint):
    p, h = x
    options = {"num_steps": 150, "method": dvi.Strang(), "save": dvi.Save(final=True)}
    section = dvi.Section(on_axis, 0, max_crossings=4)
    sol = dvi.integrate(KEPLER, START[0], p, h=h, adjoint=adjoint, observe=section, **options)
    found = sol.observed
    return found.ts[0] ** 2 + found.qs[0, 0] * found.ps[0, 1]


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, 6])
def test_requested_times_have_the_order_of_the_method(order):
    """Between lattice points too, where a polynomial of low degree would lose it."""
    ts = np.array([0.0, 1.237, 1.238, 5.55, 9.999])
    known = exact(14.0).sol(ts).T
    errors = []
    for n in (500, 1000, 2000) if order == 2 else (250, 500, 1000):
        method = dvi.Strang() if order == 2 else dvi.Yoshida(6)
        sol = kepler(10 / n, n, method=method, save=dvi.Save(ts=ts))
        assert sol.status == "successful"
        np.testing.assert_array_equal(sol.ts, ts)
        errors.append(np.abs(np.concatenate([sol.qs, sol.ps], axis=1) - known).max())
    np.testing.assert_allclose(measured_orders(errors, 2.0, 1e-12), order, atol=0.3)


@pytest.mark.slow
def test_requested_times_on_the_grid_and_several_in_one_step():
    observe = {"L": momentum, "max": dvi.MaxDrift(momentum)}
    every = kepler(save=dvi.Save(every=100), observe=observe)
    asked = kepler(save=dvi.Save(ts=every.ts), observe=observe)
    np.testing.assert_allclose(asked.qs, every.qs, atol=1e-12)
    np.testing.assert_allclose(asked.observed["L"][1:], every.observed["L"], atol=1e-13)
    # Two programs: the last bit of the round-off that the drift is may differ.
    np.testing.assert_allclose(asked.observed["max"], every.observed["max"], rtol=0, atol=1e-14)
    np.testing.assert_allclose(asked.hs[1:], every.hs, rtol=1e-9)
    ts = np.array([-0.001, -0.002, -0.0021, -0.5])
    back = kepler(-0.02, 30, save=dvi.Save(ts=ts))
    ahead = kepler(0.02, 30, save=dvi.Save(ts=-ts))
    np.testing.assert_allclose(np.asarray(back.qs) * [1, -1], ahead.qs, atol=1e-13)
    assert np.abs(np.diff(np.asarray(ahead.qs[:, 1]))).min() > 1e-5


@pytest.mark.slow
def test_times_outside_of_the_run_and_those_between_grid_points():
    late = kepler(num_steps=50, save=dvi.Save(ts=[0.5, 1.0, 1.01]), throw=False)
    assert late.status == "not_reached"
    assert np.isfinite(np.asarray(late.qs[:2])).all()
    assert np.isnan(np.asarray(late.qs[2])).all()
    with pytest.raises(dvi.IntegrationError, match=r"lies outside of the run"):
        kepler(num_steps=50, save=dvi.Save(ts=[-0.5, 1.0]))
    sol = kepler(num_steps=4, method=dvi.TypeII(), save=dvi.Save(ts=np.linspace(0.01, 0.07, 5)))
    with pytest.raises(ValueError, match="at requested times"):
        dvi.noether_balance(KEPLER, [dvi.generators.time_translation()], [None], sol)


@pytest.mark.slow
def test_clocks_and_the_gradient_in_the_requested_times():

    def at(t, adjoint):
        return kepler(num_steps=100, save=dvi.Save(ts=t[None]), adjoint=adjoint).qs[0]

    t = jnp.asarray(1.2345)
    p = kepler(num_steps=100, save=dvi.Save(ts=t[None])).ps[0]
    for adjoint in (dvi.Direct(), dvi.Reversible()):
        slope = jax.jacobian(lambda t, a=adjoint: at(t, a))(t)
        np.testing.assert_allclose(slope, p, rtol=1e-3)  # of the map's curve: order h²
    # States at given angles of the pendulum that turns over.
    angles = np.linspace(0.1, 30.0, 7)
    save = dvi.Save(ts=angles, clock=lambda t, q, p, args: q[0])
    options = {"h": 0.05, "num_steps": 400, "method": dvi.Yoshida(4)}
    sol = dvi.integrate(dvi.System(pendulum), [0.1], [2.5], save=save, **options)
    np.testing.assert_allclose(sol.qs[:, 0], angles, atol=1e-13)
    energy = 2.5**2 / 2 - np.cos(0.1)
    np.testing.assert_allclose(sol.ps[:, 0] ** 2 / 2 - np.cos(angles), energy, atol=1e-4)


def test_escape_ends_a_run():
    known = exact(14.0, lambda t, q, p, args: np.hypot(*q) - 1.5, 1)
    given = {"stop": dvi.Stop(too_far), "save": dvi.Save(), "observe": dvi.MaxDrift(momentum)}
    sol = kepler(0.005, 1000, method=dvi.Yoshida(4), **given)
    assert sol.status == "stopped"
    assert int(sol.stats["failed_step"]) == -1
    assert float(sol.stop.t) == pytest.approx(known.t_events[0][0], abs=1e-6)
    assert float(jnp.linalg.norm(sol.stop.q)) == pytest.approx(1.5, abs=1e-14)
    before = np.asarray(sol.ts) < float(sol.stop.t)
    assert np.isfinite(np.asarray(sol.qs)[before]).all()
    assert np.isnan(np.asarray(sol.qs)[~before]).all()
    assert 0 < float(sol.observed) < 1e-13  # over the steps before, no NaN


@pytest.mark.slow
def test_stops_of_a_batch_and_their_gradient():
    options = {"h": 0.02, "num_steps": 150, "method": dvi.Strang(), "stop": dvi.Stop(too_far)}

    def run(p):
        return dvi.integrate(KEPLER, START[0], jnp.stack([0.0, p]), **options)

    batch = jax.vmap(run)(jnp.asarray([START[1][1], 1.0]))
    assert list(batch.status) == ["stopped", "successful"]
    assert np.isfinite(np.asarray(batch.qs[1])).all()
    assert np.isnan(np.asarray(batch.stop.t)[1])
    value = jax.jit(lambda p: run(p).stop.t + run(p).stop.q[0])
    p = jnp.asarray(START[1][1])
    expected = central_difference(value, p, jnp.ones(()))
    assert float(jax.grad(value)(p)) == pytest.approx(float(expected), rel=1e-6)


@pytest.mark.slow
def test_starts_beyond_a_stop_and_clocks_that_jump_have_a_status():
    sol = kepler(num_steps=5, stop=dvi.Stop(lambda t, q, p, args: 1 - radius(t, q, p, args)))
    assert sol.status == "stopped"
    assert float(sol.stop.t) == 0.0
    np.testing.assert_array_equal(sol.stop.q, START[0])
    sol = kepler(num_steps=20, stop=dvi.Stop(lambda t, q, p, args: t - 10.0))
    assert sol.status == "successful"
    assert np.isnan(float(sol.stop.t))
    assert kepler(num_steps=20).stop is None
    save = dvi.Save(ts=[0.0, 0.5], clock=lambda t, q, p, args: jnp.arctan2(-p[0], q[0]))
    options = {"h": 0.1, "num_steps": 100, "throw": False, "save": save}
    sol = dvi.integrate(SPRING, [np.cos(1.0)], [-np.sin(1.0)], **options)
    assert sol.status == "not_reached"
    assert np.isnan(np.asarray(sol.qs)).all()


@pytest.mark.slow
def test_transformed_time_implicit_steps_and_progress():
    """Sections, times and stops use t, not the fictitious time."""
    ts, section = np.array([0.0, 1.0, 3.3, 7.7]), dvi.Section(on_axis, 1, max_crossings=2)
    settings = {"lattice": dvi.TimeTransformed(radius), "method": dvi.Yoshida(6)}
    sol = kepler(0.05, 200, save=dvi.Save(ts=ts), observe=section, **settings)
    np.testing.assert_allclose(sol.ts, ts, atol=1e-12)
    known = exact(14.0, on_axis, 1)
    np.testing.assert_allclose(sol.qs, known.sol(ts)[:2].T, atol=1e-5)
    np.testing.assert_allclose(sol.observed.ts[0], known.t_events[0][-2], atol=1e-5)
    end = kepler(0.05, 200, stop=dvi.Stop(too_far), **settings)
    assert end.status == "stopped"
    far = exact(14.0, lambda t, q, p, args: np.hypot(*q) - 1.5, 1)
    assert float(end.stop.t) == pytest.approx(far.t_events[0][0], abs=1e-5)
    system = dvi.System(pendulum, force=lambda t0, t1, q, p, args: -p + jnp.cos(t0))
    options = {"h": 0.05, "num_steps": 200, "epsilon": 0.1, "method": dvi.Strang()}
    options |= {"save": dvi.Save(ts=[0.33, 6.66]), "observe": dvi.Section(first_component, 0)}
    calls = []
    sol, shown = (
        dvi.integrate(system, [0.4], [0.7], progress=progress, **options)
        for progress in (None, lambda done, of: calls.append(done))
    )
    assert calls[-1] == 200
    assert int(sol.observed.count) >= 2
    np.testing.assert_array_equal(sol.qs, shown.qs)
    np.testing.assert_array_equal(sol.observed.ts, shown.observed.ts)


@pytest.mark.slow
def test_slope_at_the_start_and_round_off_at_the_end():
    def positions(ts, t0=0.0, **settings):
        given = {"h": 0.1, "num_steps": 40, "throw": False, **settings}
        sol = dvi.integrate(SPRING, [1.0], [0.3], t0=t0, save=dvi.Save(ts=ts), **given)
        return sol.qs[:, 0]

    ts = jnp.asarray([0.0, 0.5, 0.55])
    for mode in (jax.jacrev, jax.jacfwd):
        np.testing.assert_allclose(jnp.diag(mode(positions)(ts))[0], 0.3, atol=1e-6)
        np.testing.assert_allclose(mode(lambda t0: positions(ts, t0))(0.0)[0], -0.3, atol=1e-6)
    assert float(positions(ts)[0]) == 1.0
    for n in (49, 98, 103, 107):  # n·(1/n) < 1 for some of them
        assert np.isfinite(positions(np.linspace(0, 1, 5), h=1 / n, num_steps=n)).all()
    assert np.isnan(positions(np.array([1.0 + 1e-12]), h=1 / 49, num_steps=49)).all()


@pytest.mark.slow
def test_memory_does_not_grow_with_the_steps():
    """Neither that of a run nor that of its gradient: as with Save(final=True)."""

    def size(save, steps):
        def loss(q):
            sol = dvi.integrate(KEPLER, q, START[1], h=0.01, num_steps=steps, save=save)
            return jnp.sum(sol.qs[-1])

        compiled = jax.jit(jax.grad(loss)).lower(jnp.asarray(START[0])).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    asked, final = size(dvi.Save(ts=[0.5, 0.7]), 10_000), size(dvi.Save(final=True), 10_000)
    assert asked < final + 20_000
    assert size(dvi.Save(), 10_000) > 3 * final


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.slow
def test_every_grid_time_is_reached_in_spite_of_rounding(dtype):
    """t0 + k h in a compiled loop may differ by rounding from the times that a user computes.

    For 600 spans, in both directions and across zero, the given end, the end that the run reports
    and all grid times between are reached; a time a tenth of a step behind the end is not.
    """
    rng = np.random.default_rng(0)
    first, length = rng.uniform(-3, 3, 600), rng.choice([-1, 1], 600) * rng.uniform(0.5, 4, 600)
    spans = jnp.asarray(np.stack([first, first + length], 1), dtype)
    start = jnp.ones(1, dtype), jnp.zeros(1, dtype)

    def run(span, save):
        options = {"h": (span[1] - span[0]) / 25, "num_steps": 25, "save": save, "throw": False}
        return dvi.integrate(SPRING, *start, t0=span[0], **options)

    @jax.jit
    @jax.vmap
    def both(span):
        whole = run(span, dvi.Save())
        h = (span[1] - span[0]) / 25
        ends = jnp.stack([span[0], span[1]])
        asked = [whole.ts, ends, ends + jnp.stack([0 * h, h / 10])]
        return whole, [run(span, dvi.Save(ts=ts)) for ts in asked]

    whole, (at_all, at_ends, beyond) = both(spans)
    assert np.all(at_all.result._value == 0)
    assert np.all(at_ends.result._value == 0)
    assert not np.any(beyond.result._value == 0)
    close = 200 * np.finfo(dtype).eps
    assert np.abs(at_all.qs - whole.qs).max() < close
    assert np.abs(at_ends.qs[:, 1] - whole.qs[:, -1]).max() < close
