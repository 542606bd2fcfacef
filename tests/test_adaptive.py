"""Adaptive steps of explicit methods: the controller, its reversibility, and what runs with it."""

import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dvi_jax as dvi
import lanewise
from dvi_jax import systems
from dvi_jax.systems.n_body import encounter_time

KEPLER = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 - 1 / jnp.sqrt(q @ q))
DRIVEN = dvi.System(
    lambda t0, t1, q, p, args: (p @ p + (1 + 0.3 * jnp.cos(t0)) * (q @ q)) / 2,
    force=lambda t0, t1, q, p, args: -p + jnp.sin(2 * t0) * q,
)
LAST = dvi.Save(final=True)


def radius_32(t, q, p, args):
    r = jnp.sqrt(q @ q)
    return r * jnp.sqrt(r)


CLOSE = dvi.AdaptiveReversible(radius_32)


def energy(q, p):
    return p @ p / 2 - 1 / jnp.sqrt(q @ q)


def start(e):
    return np.array([1 - e, 0.0]), np.array([0.0, np.sqrt((1 + e) / (1 - e))])


def run(q, p, h=0.1, num_steps=60, system=KEPLER, lattice=CLOSE, **settings):
    settings = {"method": dvi.Strang(), "throw": False} | settings
    return dvi.integrate(system, q, p, h=h, num_steps=num_steps, lattice=lattice, **settings)


def test_steps_obey_the_rule_of_the_controller():
    """1/h_{k+1/2} = 1/h_{k-1/2} + G_k with G = -3/2 q·p/r² written by hand; times are sums."""
    q, p = start(0.7)
    sol = run(q, p, h=0.05)
    qs, ps, hs = (np.asarray(x) for x in (sol.qs, sol.ps, sol.hs))
    G = -1.5 * np.sum(qs * ps, 1) / np.sum(qs**2, 1)
    first = 1 / (0.05 * 0.3**1.5) + G[0] / 2
    np.testing.assert_allclose(1 / hs, first + np.cumsum([0, *G[1:-1]]), rtol=1e-13)
    np.testing.assert_allclose(sol.ts[1:], np.cumsum(hs), rtol=1e-15)
    assert sol.stats["last_h"] == hs[-1]
    end = (1 / hs[-1] + G[-1] / 2) * np.linalg.norm(qs[-1]) ** 1.5
    assert sol.stats["resume_h"] == pytest.approx(1 / end, rel=1e-13)
    # Within second order in δ of δ g halfway, although g changes by a factor of seven.
    middle = 0.05 * (np.linalg.norm((qs[1:] + qs[:-1]) / 2, axis=1)) ** 1.5
    assert np.max(np.abs(hs / middle - 1)) < 4e-3
    assert hs.max() > 7 * hs.min()


@pytest.mark.slow
def test_the_map_is_reversible_and_can_be_resumed():
    """Back from the end, with −p or with −δ; and in two parts as in one."""
    q, p = start(0.9)
    there = run(q, p, num_steps=120)
    end, h = (there.qs[-1], there.ps[-1]), there.stats["resume_h"]
    back = run(end[0], -end[1], h=h, num_steps=120)
    np.testing.assert_allclose(back.qs[::-1], there.qs, atol=1e-9)
    np.testing.assert_allclose(back.hs[::-1], there.hs, rtol=1e-9)
    undone = run(*end, h=-h, num_steps=120, t0=there.ts[-1])
    np.testing.assert_allclose(undone.ps[::-1], there.ps, atol=1e-8)
    np.testing.assert_allclose(undone.ts[::-1], there.ts, atol=1e-10)
    half = run(there.qs[60], there.ps[60], h=run(q, p).stats["resume_h"])
    np.testing.assert_allclose(half.qs[-1], end[0], atol=1e-10)
    # Controls: another start of the controller; and a g that knows the direction of the motion.
    away = run(end[0], -end[1], h=0.1, num_steps=120)
    assert np.max(np.abs(away.qs[-1] - q)) > 1e-4
    oblique = dvi.AdaptiveReversible(lambda t, q, p, args: radius_32(t, q, p, args) + 0.1 * q @ p)
    there = run(q, p, num_steps=60, lattice=oblique)
    back = run(there.qs[-1], -there.ps[-1], h=there.stats["resume_h"], lattice=oblique)
    assert np.max(np.abs(back.qs[-1] - q)) > 1e-4


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("kind", "method", "rtol"),
    [
        (dvi.AdaptiveReversible, dvi.Strang(), 3e-14),
        pytest.param(dvi.TimeTransformed, dvi.Strang(), 1e-11, marks=SLOW),
        pytest.param(dvi.TimeTransformed, dvi.TypeII(), 1e-11, marks=SLOW),
    ],
)
def test_a_constant_speed_is_a_uniform_grid(kind, method, rtol):
    """Also with a force and an explicit time; the step is then g δ."""
    how = {"system": DRIVEN, "num_steps": 50, "epsilon": 0.2, "t0": 0.3, "method": method}
    how["observe"] = lambda t0, t1, q0, p0, q1, p1, args: t1 * q1[0] * p0[1] - t0 * q0[1]
    plain = run([0.4, 0.1], [0.3, -0.2], h=0.1, lattice=dvi.Uniform(), **how)
    two = kind(lambda t, q, p, args: 2.0)
    slowed = run([0.4, 0.1], [0.3, -0.2], h=0.05, lattice=two, **how)
    for name in ("ts", "qs", "ps", "hs", "observed"):
        np.testing.assert_allclose(
            getattr(plain, name), getattr(slowed, name), rtol=rtol, atol=rtol / 10
        )


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvi.Strang(), pytest.param(dvi.McLachlan(4), marks=SLOW)])
def test_the_order_is_that_of_the_method(method):
    """With a force, a g that depends on time and momentum, at requested times, against DOP853."""

    def speed(t, q, p, args):
        return 1 / (1 + args["b"] * (q @ q) + 0.3 * (p @ p) + 0.2 * jnp.cos(t))

    def field(t, z):
        q, p = z
        return [p, -(1 + 0.3 * np.cos(t)) * q + 0.3 * (-p + np.sin(2 * t) * q)]

    times = np.array([0.7, 3.9, 4.1])
    exact = solve_ivp(field, (0, 5), [0.8, 0.3], "DOP853", times, rtol=1e-12, atol=1e-13).y
    how = {"system": DRIVEN, "epsilon": 0.3, "args": {"b": 0.5}, "method": method}
    how |= {"lattice": dvi.AdaptiveReversible(speed), "save": dvi.Save(ts=times)}
    errors = []
    for n in (80, 160, 320):
        sol = run([0.8], [0.3], h=8.0 / n, num_steps=320, **how)  # one program for all h
        errors.append(np.max(np.abs(np.concatenate([sol.qs, sol.ps], 1) - exact.T)))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, method.order, atol=0.25)


@pytest.mark.slow
def test_events_and_observables():
    """Against Kepler's equation: crossings of the minor axis, and a stop; a trend in t."""
    e = 0.6
    q, p = start(e)
    section = dvi.Section(lambda t, q, p, args: q[0] + e, direction=1, max_crossings=3)
    fall = dvi.Stop(lambda t, q, p, args: t - 15.0)
    observe = {"E": dvi.MaxDrift(energy), "s": section, "trend": dvi.Trend(energy)}
    how = {"h": 0.1, "num_steps": 200, "method": dvi.BlanesMoan(6), "stop": fall}
    sol = run(q, p, observe=observe, **how)
    assert sol.status == "stopped"
    assert sol.stop.t == pytest.approx(15.0, rel=1e-14)
    u = np.array([1.5 * np.pi, 3.5 * np.pi])  # rising through the minor axis
    np.testing.assert_allclose(sol.observed["s"].ts[:2], u - e * np.sin(u), atol=2e-6)
    assert sol.observed["s"].count == 2
    assert float(sol.observed["E"]) < 1e-6
    assert abs(float(sol.observed["trend"])) < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lattice", "adjoint"),
    [
        (CLOSE, dvi.Reversible()),
        *(pytest.param(CLOSE, x(), marks=SLOW) for x in (dvi.Checkpointed, dvi.Direct)),
        pytest.param(dvi.TimeTransformed(radius_32), dvi.Reversible(), marks=SLOW),
    ],
)
def test_gradients_and_batches(lattice, adjoint):
    def last(e):
        q = jnp.stack([1 - e, 0.0 * e])
        p = jnp.stack([0.0 * e, jnp.sqrt((1 + e) / (1 - e))])
        how = {"h": 0.1 + 0.05 * e, "num_steps": 30, "save": LAST, "adjoint": adjoint}
        sol = run(q, p, lattice=lattice, **how)
        return sol.qs[-1, 0] + sol.ts[-1] + sol.stats.get("resume_h", 0.0)

    e, step, value = jnp.asarray(0.5), 1e-5, jax.jit(last)
    expected = (value(e + step) - value(e - step)) / (2 * step)
    slope = jax.jit(jax.grad(last))(e)
    assert slope == pytest.approx(float(expected), rel=1e-7)
    tangent = jax.jit(lambda e: jax.jvp(value, (e,), (jnp.ones(()),))[1])(e)
    assert tangent == pytest.approx(float(slope), rel=1e-9)
    batch = jax.jit(jax.vmap(last))(jnp.array([0.3, 0.5]))
    assert batch[1] == value(e)  # to the bit


@pytest.mark.slow
def test_steps_that_cannot_follow_are_reported():
    """A δ too large; a g that becomes negative; and the other trajectory of the batch is intact."""
    q, p = (jnp.asarray(x) for x in start(0.9))
    sol = run(q, p, h=1.2)
    assert sol.status == "step_control_failed"
    k = int(sol.stats["failed_step"])
    assert 0 < k < 60
    assert np.isfinite(sol.qs[k]).all()
    assert np.isnan(sol.qs[k + 1 :]).all()
    with pytest.raises(dvi.IntegrationError, match=r"last h = .*no longer follow g"):
        run(q, p, h=1.2, throw=True)

    def both(h):
        sol = run(q, p, h=h)
        return sol.result, sol.qs, sol.hs

    result, qs, hs = jax.jit(jax.vmap(both))(jnp.array([0.1, 1.2]))
    assert list(result == dvi.RESULTS.step_control_failed) == [False, True]
    alone = run(q, p, h=0.1)
    np.testing.assert_array_equal(qs[0], alone.qs)
    np.testing.assert_array_equal(hs[0], alone.hs)
    negative = dvi.AdaptiveReversible(lambda t, q, p, args: jnp.where(q[0] > -0.5, 1.0, -1.0))
    assert run(q, p, h=0.1, lattice=negative).status == "step_control_failed"
    # On a limit cycle the errors of h have one sign: a long run loses g, and says so.
    cycle = dvi.System(
        lambda t0, t1, q, p, args: (p @ p + q @ q) / 2 + (q @ q) ** 2 / 4,
        force=lambda t0, t1, q, p, args: (1 - q @ q) * p,
    )
    narrow = dvi.AdaptiveReversible(lambda t, q, p, args: 1 / (1 + q @ q))
    how = {"system": cycle, "epsilon": 0.5, "lattice": narrow, "save": LAST, "num_steps": 10_000}
    assert run([1.0], [0.0], **how).status == "step_control_failed"


@pytest.mark.slow
def test_machine_code_for_the_whole_run():
    def both(q, p):
        return run(q, p, save=LAST, observe=dvi.MaxDrift(energy), method=dvi.KahanLi(8)).qs

    found = lanewise.explain(both, *start(0.6))
    assert "XLA" not in str(found), str(found)


@SLOW
def test_the_pythagorean_problem_after_its_closest_encounter():
    """At t = 20, with the speed of N bodies; the place is that of the Taylor series below."""
    problem, lattice = systems.pythagorean(), dvi.AdaptiveReversible(encounter_time)
    how = {"method": dvi.KahanLi(8), "save": dvi.Save(ts=[20.0]), "lattice": lattice}
    observe = dvi.MaxDrift(problem.observables["angular_momentum"])
    sol = dvi.integrate(problem, h=0.1, num_steps=1500, observe=observe, **how)
    np.testing.assert_allclose(sol.qs[0, 0], [3.0042926367, 0.5119252350], atol=1e-6)
    assert float(sol.observed) < 1e-11
    assert float(sol.stats["resume_h"]) == pytest.approx(0.1, rel=0.1)
    t, q, p = 0.0, np.array([[1.0, 0.0], [-1.0, 2.0]]), np.zeros((2, 2))
    two = encounter_time(t, q, p, {"masses": [1.0, 3.0], "G": 2.0})
    assert two == pytest.approx(8**0.75 / np.sqrt(2 * 4), rel=1e-14)  # r^{3/2}/√(GM) by hand


@pytest.fixture(scope="module")
def bench():
    """benchmarks/adaptive_steps.py, whose tables are in the documentation."""
    pytest.importorskip("flint")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
        return importlib.import_module("adaptive_steps")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most"), [("Strang", 0.04), ("KahanLi(8)", 1e-5)])
def test_energy_over_a_hundred_thousand_revolutions(bench, name, most):
    """e = 0.99: no drift, and constant steps need more than 20 times the forces."""
    method, n = bench.METHODS[name]
    ranges = np.array(bench.tenths(method, n, 100_000))
    assert ranges.max() < most
    assert np.ptp(ranges) < 1e-4 * ranges.max()
    constant = bench.run(method, 20 * n, 3, lattice=None)  # as many forces in each step
    assert float(constant.observed) > 10 * ranges.max()


@pytest.mark.slow
def test_time_next_to_implicit_adaptive_steps(bench):
    """At most half of the time, with the same number of steps and for equal errors."""
    method, n = bench.METHODS["Strang"]
    (ours, error), (theirs, wanted) = (
        bench.measured(method, n, lattice) for lattice in (bench.EXPLICIT, bench.IMPLICIT)
    )
    assert error < wanted
    assert ours < 0.5 * theirs


@pytest.mark.slow
@pytest.mark.parametrize("name", ["figure eight, 10 periods", "figure eight, half velocities"])
def test_encounters_agree_with_ias15(bench, name):
    """Periodic, and with distances down to 5e-5; IAS15 with two tolerances as its own control."""
    pytest.importorskip("rebound")
    make, times, h, arithmetic = bench.CASES[name]
    found, _ = bench.encounters(make(), times, h, getattr(dvi, arithmetic)())
    exact, other = (bench.ias15(make(), times, epsilon) for epsilon in (1e-9, 1e-11))
    assert np.max(np.abs(exact - other)) < 1e-8
    assert np.max(np.abs(found - exact)) < 1e-6
    coarse, _ = bench.encounters(make(), times, 2.5 * h)
    assert np.max(np.abs(coarse - exact)) > 1e-6  # the control


@pytest.mark.slow
def test_the_pythagorean_problem_until_the_escape(bench):
    """Against Taylor series with 24 digits until t = 60, and IAS15 as long as it has six digits."""
    pytest.importorskip("rebound")
    make, times, h, arithmetic = bench.CASES["Pythagorean"]
    exact = bench.taylor(make(), times)
    found, _ = bench.encounters(make(), times, h, getattr(dvi, arithmetic)())
    assert np.max(np.abs(found - exact)) < 1e-6
    ias15 = bench.ias15(make(), times)
    np.testing.assert_allclose(found[:2], ias15[:2], rtol=0, atol=1e-6)  # t = 20 and 40
    assert 1e-5 < np.max(np.abs(ias15[-1] - exact[-1])) < 1e-2  # rounding, magnified by the chaos
    # The lightest body escapes: at t = 70 it is far away, and faster than the escape velocity.
    problem = make()
    end = dvi.integrate(
        problem.system, problem.q0, problem.p0, args=problem.args, h=h, num_steps=20_000,
        method=dvi.KahanLi(8), lattice=bench.ENCOUNTERS, arithmetic=dvi.DoubleDouble(),
        save=dvi.Save(ts=[70.0]),
    )  # fmt: skip
    q, p = np.asarray(end.qs[0]), np.asarray(end.ps[0])
    away = q[0] - (4 * q[1] + 5 * q[2]) / 9
    speed = p[0] / 3 - (p[1] + p[2]) / 9
    assert np.linalg.norm(away) > 25
    assert away @ speed > 0
    assert speed @ speed / 2 > 12 / np.linalg.norm(away)
