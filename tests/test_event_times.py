"""Fits to observed times of events: transits, eclipses, passages of an apsis."""

import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import elements, systems
from dvi_jax.fit.observations import as_arcs
from dvi_jax.fit.problem import FitProblem


def spring(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + args["k"] * (q0 @ q0) / 2


SPRING = dvi.System(spring)
K, SIGMA = 1.21, 1e-3
ROOT = K**0.5
PHASE = np.arctan2(-0.3 * ROOT, 1.0)  # of q = A sin(ωt + φ), from q0 = −0.3, p0 = 1
MODEL = dvi.Model(SPRING, h=0.05, q0=[-0.3], p0=[1.0], method=dvi.Yoshida(4))
EPOCHS = np.array([0, 1, 3, 4, 7, 8])
START = {"args": {"k": 1.0}}


def one_start(params):
    """The model for all arcs, from one initial state."""
    return MODEL(params)


def rising(q, p):
    return q[0]


def turning(q, p):
    return p[0]


def rises(epochs=EPOCHS, seed=0, sigma=SIGMA, origin=100):
    """Times at which q increases through zero, with gaps."""
    times = (2 * np.pi * EPOCHS - PHASE) / ROOT
    times += SIGMA * np.random.default_rng(seed).normal(size=times.size)
    numbers = None if epochs is None else epochs + origin
    return dvi.EventTimes(rising, times, sigma=sigma, epochs=numbers, max_events=30)


def crests(sigma=SIGMA):
    """Times at which q is largest."""
    times = (2 * np.pi * EPOCHS[1:] + np.pi / 2 - PHASE) / ROOT
    times += SIGMA * np.random.default_rng(7).normal(size=times.size)
    return dvi.EventTimes(turning, times, sigma=sigma, direction=-1)


def of(*events, **options):
    return dvi.Observations(events=events, t0=0.0, **options)


def exact_sigma(times, sigma):
    """Standard error of k from times (c − φ(ω))/ω, by differences of the formula."""

    def computed(k):
        root = k**0.5
        turns = np.rint((times * ROOT + PHASE) / (2 * np.pi) * 4) / 4
        return (2 * np.pi * turns - np.arctan2(-0.3 * root, 1.0)) / root

    slope = (computed(K + 1e-5) - computed(K - 1e-5)) / 2e-5
    return sigma / np.sqrt(slope @ slope)


def test_a_frequency_from_times_with_gaps():
    """Epochs with gaps and any origin; without them the nearest event; a wrong assignment."""
    data = rises()
    fit = dvi.fit(MODEL, of(data), START, check_curvature=False)
    assert fit.status == "converged"
    assert fit.trajectories == ["successful"]
    assert abs(fit.x[0] - K) < 3 * fit.sigma[0]
    np.testing.assert_allclose(fit.sigma[0], exact_sigma(data.times, SIGMA), rtol=1e-3)
    assert 0.02 < fit.reduced_chi2 < 3
    np.testing.assert_array_equal(fit.observed[0][:, 0], data.times)
    # The same from a far start, in which the last observed event is the computed one before it.
    far = dvi.fit(MODEL, of(data), {"args": {"k": 0.7}}, check_curvature=False)
    np.testing.assert_allclose(far.x, fit.x, atol=1e-3 * fit.sigma[0])
    # One event with the number of another one.
    wrong = of(rises(np.array([0, 2, 3, 4, 7, 8])))
    spoiled = dvi.fit(MODEL, wrong, START, throw=False, check_curvature=False)
    assert "contradict sigma" in str(spoiled)
    assert np.abs(spoiled.residuals[0]).max() > 1.0


@pytest.mark.slow
def test_the_nearest_event():
    """Without epochs: right from a near start, whole periods off from a far one, and it says so."""
    data = of(rises(None))
    near = dvi.fit(MODEL, data, {"args": {"k": 1.2}}, check_curvature=False)
    with_epochs = dvi.fit(MODEL, of(rises()), START, check_curvature=False)
    np.testing.assert_allclose(near.x, with_epochs.x, atol=1e-3 * near.sigma[0])
    assert near.history["horizon"].min() == np.inf
    # Half of the distance between events: the fit begins with the first ones.
    further = dvi.fit(MODEL, data, {"args": {"k": 1.07}}, check_curvature=False)
    assert further.history["horizon"].min() < 30
    np.testing.assert_allclose(further.x, with_epochs.x, atol=1e-3 * near.sigma[0])
    lost = dvi.fit(MODEL, data, {"args": {"k": 4.0}}, throw=False, check_curvature=False)
    assert abs(lost.x[0] - K) > 0.1
    assert "contradict sigma" in str(lost)


def test_invalid_input():
    times = np.arange(3.0) + 1

    def refused(match, **options):
        with pytest.raises((ValueError, TypeError), match=match):
            dvi.EventTimes(**{"g": rising, "times": times, **options})

    refused("times must all increase", times=[1.0, 1.0, 2.0])
    refused("times must be finite", times=[1.0, np.nan])
    refused(r"times must have shape \(3,\)", times=times[:, None])
    refused(r"times must have shape \(1,\), got shape \(0,\)", times=[])
    refused("sigma must be positive", sigma=-1.0)
    refused("sigma must broadcast", sigma=np.ones(2))
    refused(r"epochs must have shape \(3,\)", epochs=[0, 1])
    refused("epochs must be integers, got 0.5", epochs=[0, 0.5, 1])
    refused("in the order of times, got 1.0 at index", epochs=[0, 1, 1])
    refused("in the order of times", epochs=[2, 1, 0])
    refused("direction must be", direction=2)
    refused("max_events must be", max_events=0)
    refused("g of EventTimes", g=3.0)
    event, values = dvi.EventTimes(rising, times), {"ts": times, "values": times}
    for match, options in {
        "requires t0, got None": {},
        r"a time other than t0, got t0 = 1\.0": {"t0": 1.0},
        "one side of t0": {"t0": 1.5},
        r"requires ts and values \(dvi.EventTimes": {"t0": 0.0, "sigma": 1.0},
        "requires sigma of all": {"t0": 0.0, "sigma": 1.0, **values},
        "sigma of all of them, got": {"t0": 0.0, **values},
    }.items():
        with pytest.raises(ValueError, match=match):
            dvi.Observations(events=event, **options)
    with pytest.raises(TypeError, match=r"events\[0\] must be a dvi.EventTimes"):
        dvi.Observations(events=[times], t0=0.0)


@pytest.mark.slow
def test_an_event_that_does_not_exist():
    """No event at the start is an error; none at a later time is a status."""
    never = dvi.EventTimes(lambda q, p: q[0] - 50.0, rises().times, sigma=SIGMA)
    with pytest.raises(ValueError, match=r"gives nan .* there is no such event"):
        dvi.fit(MODEL, of(never), START)
    # With places for three events the others are not known: not the last of the three.
    few = of(replace(rises(), max_events=3))
    cut = dvi.fit(MODEL, few, START, horizons=None, throw=False)
    assert (cut.status, cut.trajectories) == ("not_finite", ["not_reached"])
    np.testing.assert_array_equal(np.isnan(cut.residuals[0][:, 0]), EPOCHS >= 3)
    cut = dvi.fit(MODEL, of(replace(rises(None), max_events=3)), START, horizons=None, throw=False)
    assert (cut.status, cut.trajectories) == ("not_finite", ["not_reached"])
    # A number far behind the end of the run; the other arc does not notice.
    pair = [of(rises(np.array([0, 1, 3, 4, 7, 60]))), of(rises())]
    problem = FitProblem(one_start, *as_arcs(pair), START)
    u = problem.space.to_u(problem.start)
    _, residuals, names = problem.by_arc(*problem.weighted_residuals(u))
    assert [int(np.isnan(r).sum()) for r in residuals] == [1, 0]
    assert names == ["not_reached", "successful"]


@pytest.mark.slow
def test_events_of_two_kinds_with_positions():
    """The information of all of them, by whitening; a wrong sigma contradicts them."""
    ts = np.linspace(0.5, 50.0, 30)
    amplitude, random = np.hypot(0.3, 1 / ROOT), np.random.default_rng(1)
    seen = amplitude * np.sin(ROOT * ts + PHASE) + 0.002 * random.normal(size=30)
    kinds = {"ts": ts, "observe": lambda t, q, p, args: q[0]}
    positions = dvi.Observations(values=seen, sigma=0.002, **kinds, t0=0.0)
    parts = of(rises()), of(crests()), positions
    alone = [dvi.fit(MODEL, data, START, check_curvature=False) for data in parts]
    everything = of(rises(), crests(), values=seen, sigma=0.002, **kinds)
    fit = dvi.fit(MODEL, everything, START, check_curvature=False)
    assert fit.observed[0].shape == (fit.ts[0].size, 3)
    assert fit.num_observed == 30 + 6 + 5
    weight = sum(f.sigma[0] ** -2 for f in alone)
    np.testing.assert_allclose(fit.sigma[0], weight**-0.5, rtol=1e-3)
    mean = sum(f.x[0] / f.sigma[0] ** 2 for f in alone) / weight
    np.testing.assert_allclose(fit.x[0], mean, atol=0.01 * fit.sigma[0])
    # The same with covariances, shape (N,) or (N, 1), a period of the values, and in columns.
    variants = [
        {"values": seen[:, None], "ts": ts, "covariance": [[4e-6]]},
        {"values": seen[:, None], "ts": ts, "sigma": 0.002, "period": 20.0},
        {"values": seen[::-1], "sigma": 0.002, **kinds, "ts": ts[::-1]},
    ]
    for options in variants:
        same = dvi.fit(MODEL, of(rises(), crests(), **options), START, check_curvature=False)
        np.testing.assert_allclose(same.x, fit.x, rtol=1e-9)
        np.testing.assert_allclose(same.sigma, fit.sigma, rtol=1e-6)
    # The control: a frequency that the positions exclude contradicts the prior.
    prior = {"args": {"k": dvi.Prior(K + 0.01, 1e-4)}}
    conflict = dvi.fit(MODEL, everything, START, priors=prior, check_curvature=False)
    assert "the priors contradict the data" in str(conflict)


@pytest.mark.slow
def test_arcs_against_the_time_and_a_time_transformed_grid():
    """Epochs before t0 on an arc with h < 0; two arcs of one model; steps that are not equal."""
    before = (-2 * np.pi * (EPOCHS + 1) - PHASE) / ROOT

    backward = dvi.Model(SPRING, h=-0.05, q0=[-0.3], p0=[1.0], method=dvi.Yoshida(4))
    for order in (1, -1):
        data = dvi.EventTimes(rising, before[::order], sigma=SIGMA, epochs=-EPOCHS[::order])
        fit = dvi.fit(backward, of(data), START, check_curvature=False)
        assert abs(fit.x[0] - K) < 1e-5
        assert np.abs(fit.residuals[0]).max() < 1e-5
    steps = {"lattice": dvi.TimeTransformed(lambda t, q, p, args: 1.0), "num_steps": 1400}
    other = dvi.Model(SPRING, h=0.05, q0=[-0.3], p0=[1.0], method=dvi.Yoshida(4), **steps)
    fits = [dvi.fit(m, of(rises()), START, check_curvature=False) for m in (MODEL, other)]
    np.testing.assert_allclose(fits[0].x, fits[1].x, rtol=1e-9)
    arcs = [of(rises(seed=0)), of(rises(seed=1))]
    both = dvi.fit(one_start, arcs, START, check_curvature=False)
    single = [dvi.fit(MODEL, arc, START, check_curvature=False) for arc in arcs]
    np.testing.assert_allclose(both.x, np.mean([f.x for f in single], 0), rtol=1e-8)
    np.testing.assert_allclose(both.sigma, single[0].sigma / 2**0.5, rtol=1e-3)
    with pytest.raises(ValueError, match="MultipleShooting requires observations without events"):
        dvi.fit(MODEL, arcs[0], START, shooting=dvi.MultipleShooting(3))


ORBIT = {"a": 1.1, "e": 0.2, "mean": -1.0}
PASSAGES = np.array([0.0, 1.0, 2.0, 5.0])


def orbit(params, *, method=dvi.KahanLi(8), h=0.02):
    """A Kepler orbit from its elements."""
    start = elements.Keplerian(params["a"], params["e"], 0.0, 0.0, 0.3, params["mean"])
    q0, v0 = start.state(1.0, dim=2)
    kepler = systems.kepler()
    run = {"system": kepler.system, "args": kepler.args, "q0": q0, "p0": v0}
    return {**run, "h": h, "method": method}


def pericentre(params):
    """Times of the passages from Kepler's third law."""
    period = 2 * jnp.pi * params["a"] ** 1.5
    return period * (PASSAGES - params["mean"] / (2 * jnp.pi))


def problem_of(model, params=ORBIT):
    """Residuals in time units at parameters."""
    times = np.asarray(pericentre(ORBIT))
    event = dvi.EventTimes(lambda q, p: q @ p, times, sigma=1.0, epochs=PASSAGES)
    problem = FitProblem(model, *as_arcs(of(event)), params)
    return problem, problem.space.to_u(problem.start)


@pytest.mark.slow
def test_times_and_derivatives_of_pericentre_passages():
    """Those of a method of order 8 with short steps are Kepler's."""
    problem, u = problem_of(orbit)
    residual, jacobian, _ = problem.evaluate(u)
    assert np.abs(residual).max() < 1e-11
    exact = jax.jacfwd(pericentre)({k: jnp.asarray(x) for k, x in ORBIT.items()})
    columns = np.stack([exact[name] for name in sorted(ORBIT)], axis=1)
    np.testing.assert_allclose(jacobian[: PASSAGES.size], columns, rtol=0, atol=1e-9)
    assert np.abs(columns).max() > 40
    # The control: apocentres, of which the first is the nearest, are half a period away.
    apocentre = replace(problem.arcs[0].kinds[0], direction=-1)
    other = FitProblem(orbit, *as_arcs(of(apocentre)), ORBIT)
    late = other.evaluate(u)[0][: PASSAGES.size]
    np.testing.assert_allclose(np.abs(late), np.pi * 1.1**1.5, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvi.Strang(), dvi.GaussLegendre(2)], ids=["first", "second"])
def test_derivatives_of_the_map(method):
    """Long steps: the derivatives are those of the discrete map, by differences of order 4."""
    problem, u = problem_of(lambda params: orbit(params, method=method, h=0.15))
    residual, jacobian, _ = problem.evaluate(u)
    assert 1e-4 < np.abs(residual).max() < 0.5  # Kepler's times are others
    bound = 1e-8 * np.abs(jacobian).max()
    for i in range(3):
        # Short differences: the derivative jumps where an event passes from one step to the next.
        step = 5e-5 * np.eye(3)[i]
        ends = [np.asarray(problem.evaluate(u + k * step).residual) for k in (-2, -1, 1, 2)]
        near, far = (ends[2] - ends[1]) / 1e-4, (ends[3] - ends[0]) / 2e-4
        np.testing.assert_allclose(jacobian[:, i], (4 * near - far) / 3, rtol=0, atol=bound)


@pytest.mark.slow
def test_gradient_and_hessian_of_the_loss():
    """By reverse mode, and forward over reverse, as a sampler and a likelihood use them."""
    problem, u = problem_of(lambda params: orbit(params, method=dvi.Strang(), h=0.15))

    def gradient(u):
        residual, jacobian, _ = problem.evaluate(u)
        return np.asarray(jacobian).T @ residual

    slope = jax.grad(problem.core.scalar)(jnp.asarray(u))
    np.testing.assert_allclose(slope, gradient(u), rtol=1e-9, atol=1e-11)
    H = np.asarray(problem.hessian(u))
    for i, d in enumerate(1e-5 * np.eye(3)):
        second = (gradient(u + d) - gradient(u - d)) / 2e-5
        np.testing.assert_allclose(H[i], second, rtol=1e-6, atol=1e-6 * np.abs(H).max())


# --- two planets near a resonance

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))


def conjunctions(sim, count, end):
    """Times at which x of a planet relative to the star decreases through zero, by REBOUND."""
    bodies, times, step = sim.particles, [[] for _ in range(count)], 1.0

    def offset(s, i):
        return s.particles[i].x - s.particles[0].x

    while sim.t < end:
        start = sim.copy()
        before = [offset(sim, i + 1) for i in range(count)]
        sim.integrate(start.t + step)
        for i, x in enumerate(before):
            if x > 0 >= bodies[i + 1].x - bodies[0].x:
                s, change = start.copy(), 1.0
                while abs(change) > 1e-12:
                    change = -offset(s, i + 1) / (s.particles[i + 1].vx - s.particles[0].vx)
                    s.integrate(s.t + change)
                times[i].append(s.t)
    return [np.array(t) for t in times]


@pytest.mark.slow
def test_masses_and_eccentricities_from_transits_near_a_resonance():
    """Times of REBOUND with a noise of six seconds and missed transits; a transit miscounted."""
    rebound = pytest.importorskip("rebound")
    import transit_times as example

    q0, p0, args = example.state(example.TRUTH)
    sim = rebound.Simulation()
    sim.integrator = "ias15"
    for m, q, p in zip(*(np.asarray(x) for x in (args["masses"], q0, p0)), strict=True):
        sim.add(m=m, x=q[0], y=q[1], vx=p[0] / m, vy=p[1] / m)
    times, sigma = conjunctions(sim, 2, 280.0), 6 / 86400  # days
    gaps = [np.delete(np.arange(times[0].size), [3, 4, 11, 20]), np.delete(np.arange(13), [6])]
    functions = [lambda t, q, p, args, i=i: q[i, 0] - q[0, 0] for i in (1, 2)]

    def data_of(noise, seed=0, miscount=0):
        random, kinds = np.random.default_rng(seed), []
        for i, epochs in enumerate(gaps):
            seen = times[i][epochs] + noise * random.normal(size=epochs.size)
            numbers = epochs - miscount * (epochs > 4) * (i == 0)  # in the first gap
            options = {"epochs": numbers, "direction": -1, "max_events": 40}
            kinds.append(dvi.EventTimes(functions[i], seen, sigma=sigma, **options))
        return of(*kinds)

    def model(params):
        return {**example.model(params), "h": 0.25, "method": dvi.KahanLi(8)}

    problem = FitProblem(model, *as_arcs(data_of(0.0)), example.TRUTH)
    _, [(computed, _)] = problem.weighted_residuals(problem.space.to_u(problem.start))
    difference = np.asarray(computed[0]) - problem.data[0].values
    assert np.nanmax(np.abs(difference)) < 1e-7  # days
    starting = example.starting(times)
    options = {"bounds": {"mass": dvi.Bounds(0.0, 1e-3)}, "check_curvature": False}
    options["priors"] = {"ecos": dvi.Prior(0.0, 0.05), "esin": dvi.Prior(0.0, 0.05)}
    truth, chi2 = np.concatenate([example.TRUTH[key] for key in sorted(example.TRUTH)]), 0.0
    for seed in (3, 4, 5):
        fit = dvi.fit(model, data_of(sigma, seed), starting, **options)
        assert "contradict" not in str(fit)
        error = fit.x - truth
        assert np.abs(error / fit.sigma).max() < 3.5
        chi2 += error @ np.linalg.solve(fit.covariance, error)
    assert 11 < chi2 < 60  # of 30 numbers: 0.1 % and 99.9 %
    mass = fit.names.index("mass[1]")
    assert fit.sigma[mass] < 0.03 * fit.x[mass]
    wrong = dvi.fit(model, data_of(sigma, miscount=1), starting, **options, throw=False)
    assert wrong.status != "converged" or "contradict sigma" in str(wrong)
    assert np.sqrt(wrong.chi2 / wrong.num_observed) > 100
