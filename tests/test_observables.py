"""Observables of the state: (q, p) and (t, q, p, args), with their values at the initial state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import systems

SYSTEM = dvi.System(
    lambda t0, t1, q0, p1, args: p1 @ p1 / 2 - args * jnp.sum(jnp.cos(q0)),
    force=lambda t0, t1, q0, p1, args: -p1,
)
REDUCTIONS = {
    "MaxDrift": lambda f, t: np.abs(f - f[0]).max(),
    "Range": lambda f, t: np.ptp(f),
    "Mean": lambda f, t: f.mean(),
    "Last": lambda f, t: f[-1],
    "Trend": lambda f, t: np.polyfit(t, f, 1)[0],
}


def energy(q, p):
    return p @ p / 2 - jnp.sum(jnp.cos(q))


def run(q=1.0, mu=1.0, epsilon=0.1, **how):
    how = {"h": 0.1, "num_steps": 12, **how}
    return dvi.integrate(SYSTEM, [q], [0.3], epsilon=epsilon, args=mu, **how)


@pytest.fixture(scope="module")
def plain():
    sol = run()
    return sol, np.asarray(jax.vmap(energy)(sol.qs, sol.ps))


def test_reductions_begin_at_the_initial_state(plain):
    sol, E = plain
    observe = {name: getattr(dvi, name)(energy) for name in REDUCTIONS}
    found = run(observe=observe | {"relative": dvi.MaxDrift(energy, relative=True)}).observed
    for name, of in REDUCTIONS.items():
        assert found[name] == pytest.approx(of(E, np.asarray(sol.ts)), rel=1e-12), name
    assert found["relative"] == pytest.approx(np.abs(E / E[0] - 1).max(), rel=1e-12)
    # Control: a function of a step has no value before the first step.
    of_step = run(observe=dvi.MaxDrift(lambda t0, t1, q0, p0, q1, p1, args: energy(q1, p1)))
    assert of_step.observed == pytest.approx(np.abs(E[1:] - E[1]).max(), rel=1e-12)
    assert abs(of_step.observed / found["MaxDrift"] - 1) > 1e-3


def test_values_have_a_row_for_each_saved_state(plain):
    sol, E = plain
    observe = {"E": energy, "t": lambda t, q, p, args: t * args, "step": lambda *step: step[1]}
    found = run(observe=observe, mu=2.0).observed
    assert found["E"].shape == found["t"].shape == (13,)
    assert found["step"].shape == (12,)
    np.testing.assert_allclose(found["t"], 2 * sol.ts, rtol=1e-15)
    every = run(observe=energy, save=dvi.Save(every=4))
    np.testing.assert_allclose(every.observed, E[::4], rtol=1e-14)
    at_times = run(observe=energy, save=dvi.Save(ts=[0.1, 0.25]))
    assert at_times.observed.shape == (2,)
    batch = jax.vmap(lambda q: run(q, observe=energy).observed)(jnp.array([1.0, 0.5]))
    np.testing.assert_allclose(batch[0], E, rtol=1e-14)


def test_time_transformed_runs_have_them_too():
    lattice = dvi.TimeTransformed(lambda t, q, p, args: 1 + q[0] ** 2)
    observe = {"E": energy, "drift": dvi.MaxDrift(energy), "t": lambda t, q, p, args: t}
    sol = run(lattice=lattice, observe=observe)
    E = np.asarray(jax.vmap(energy)(sol.qs, sol.ps))
    np.testing.assert_allclose(sol.observed["E"], E, rtol=1e-14)
    np.testing.assert_allclose(sol.observed["t"], sol.ts, rtol=1e-14)
    assert sol.observed["drift"] == pytest.approx(np.abs(E - E[0]).max(), rel=1e-12)


def loss(x, adjoint):
    observe = {name: getattr(dvi, name)(energy) for name in REDUCTIONS}
    observe |= {"relative": dvi.MaxDrift(energy, relative=True), "E": energy}
    found = run(x[0], x[1], x[2], observe=observe, adjoint=adjoint, throw=False).observed
    return sum((i + 1) * jnp.sum(v) for i, v in enumerate(jax.tree.leaves(found)))


X = jnp.array([1.0, 1.2, 0.1])


def test_gradients_go_through_the_initial_value():
    both = jax.jit(jax.value_and_grad(lambda x: loss(x, dvi.Reversible())))
    differences = [(both(X + d)[0] - both(X - d)[0]) / 2e-5 for d in 1e-5 * jnp.eye(3)]
    np.testing.assert_allclose(both(X)[1], differences, rtol=1e-7)


@pytest.mark.slow
def test_gradients_of_all_adjoints_agree():
    forward = jax.jacfwd(loss)(X, dvi.Direct())
    for adjoint in (dvi.Reversible(), dvi.Checkpointed()):
        np.testing.assert_allclose(jax.grad(loss)(X, adjoint), forward, rtol=1e-10)


def test_a_solution_reads_well(plain):
    assert "Solution: successful; 12 steps, 13 saved states of shape (1,)" in repr(plain[0])
    batch = jax.vmap(lambda q: run(q, throw=False))(jnp.array([1.0, 0.5]))
    assert "2 trajectories, 2 successful" in repr(batch)
    assert (batch.q_final.shape, batch.t_final.shape) == ((2, 1), (2,))


LARGE = 2**53


def count(t, q, p, args):
    """2⁵³ + 2k + 1 at step k: float64 has no odd numbers of this size."""
    return jnp.int64(LARGE + 1) + 2 * jnp.floor(t / 0.1 + 0.5).astype(jnp.int64)


INTEGERS = {
    "last": dvi.Last(count),
    "drift": dvi.MaxDrift(count),
    "range": dvi.Range(count),
    "running": dvi.Running(dvi.Last(count)),
    "is_positive": dvi.Last(lambda q, p: jnp.stack([q[0] > 0, q[0] < 0])),
    "change": dvi.MaxDrift(lambda q, p: q > 0.5),
    "fraction": dvi.Mean(lambda q, p: q[0] > 0.5),
    # 200, 140, 80, 20, then modulo 256: a difference of unsigned numbers has no sign
    "unsigned": dvi.Range(
        lambda t, q, p, args: (
            jnp.uint8(200) - jnp.uint8(60) * jnp.asarray(t / 0.1 + 0.5).astype(jnp.uint8)
        )
    ),
    # 3·2⁶² − 1 is above the largest integer
    "wide": dvi.Range(
        lambda t, q, p, args: jnp.where(t < 0.05, -jnp.int64(2**63 - 1), jnp.int64(2**62))
    ),
}


@pytest.mark.parametrize("adjoint", [dvi.Direct(), dvi.Reversible()])
def test_integers_and_booleans_stay_what_they_are(adjoint):
    observe = {n: f for n, f in INTEGERS.items() if n != "running" or adjoint == dvi.Direct()}
    found = run(num_steps=3, observe=observe, adjoint=adjoint).observed
    assert found["last"].dtype == jnp.int64
    assert int(found["last"]) == LARGE + 7
    assert float(found["drift"]) == float(found["range"]) == 6
    assert found["is_positive"].dtype == bool
    assert found["is_positive"].tolist() == [True, False]
    assert float(found["change"][0]) == 0
    assert float(found["fraction"]) == 1
    assert float(found["unsigned"]) == 180
    assert float(found["wide"]) == pytest.approx(3 * 2.0**62, rel=1e-15)
    if "running" in found:
        assert found["running"].tolist() == [LARGE + 3, LARGE + 5, LARGE + 7]
    # The control: as a real number the last value is another one.
    as_real = dvi.Last(lambda t, q, p, args: count(t, q, p, args) * 1.0)
    assert int(run(num_steps=3, observe=as_real).observed) != LARGE + 7


EMPTY = {
    "last": dvi.Last(lambda q, p: q[:0]),
    "mean": dvi.Mean(lambda q, p: jnp.zeros((3, 0))),
    "each": lambda q, p: jnp.sort(jnp.zeros((0, 3), jnp.int32), axis=0),
    "running": dvi.Running(dvi.Range(lambda q, p: p[:0])),
}


@pytest.mark.parametrize(
    "adjoint",
    [dvi.Checkpointed(), dvi.Direct(), pytest.param(dvi.Reversible(), marks=pytest.mark.slow)],
)
def test_observables_without_entries(adjoint):
    """A run in segments divided by their number of entries."""

    def final(mu):
        found = run(mu=mu, observe=EMPTY, adjoint=adjoint, num_steps=9, save=dvi.Save(every=1))
        shapes = {name: x.shape for name, x in found.observed.items()}
        assert shapes == {"last": (0,), "mean": (3, 0), "each": (10, 0, 3), "running": (9, 0)}
        return found.qs[-1].sum() + found.observed["last"].sum()

    slope = (final(1.1 + 1e-6) - final(1.1 - 1e-6)) / 2e-6
    assert jax.grad(final)(1.1) == pytest.approx(float(slope), rel=1e-6)


def test_integers_next_to_a_gradient_and_after_a_failure():
    observe = {"n": dvi.Last(count), "E": dvi.Last(energy), "r": dvi.Range(count)}

    def of_energy(mu, adjoint):
        found = run(mu=mu, observe=observe, adjoint=adjoint, num_steps=4).observed
        return found["E"] + found["r"] + found["n"].astype(float)

    slopes = [jax.grad(of_energy)(1.1, dvi.Reversible()), jax.jacfwd(of_energy)(1.1, dvi.Direct())]
    assert slopes[0] == pytest.approx(float(slopes[1]), rel=1e-10)
    with pytest.raises(dvi.IntegrationError) as error:
        run(mu=np.nan, observe=dvi.Running(dvi.Last(count)), num_steps=2)
    # An integer has no NaN.
    assert error.value.solution.observed.tolist() == [np.iinfo(np.int64).min] * 2


def slow_energy(tau0, tau1, q0, p0, q1, p1, args):
    return p1 @ p1 / 2 + (1 + tau1) * (q1 @ q1) / 2


OF_SLOW_TIME = {
    "step": systems.InSlowTime(slow_energy),
    "state": systems.InSlowTime(lambda tau, q, p, args: p @ p / 2 + (1 + tau) * (q @ q) / 2),
    "largest": dvi.MaxDrift(systems.InSlowTime(lambda tau, q, p, args: tau)),
    "last": dvi.Last(systems.InSlowTime(lambda q, p: q[0])),
    "q": systems.InSlowTime(lambda q, p: q[0]),
    "running": dvi.Running(dvi.Last(systems.InSlowTime(lambda tau, q, p, args: tau))),
    "time": lambda t, q, p, args: t,
}


@pytest.mark.parametrize("lattice", [dvi.Uniform(), dvi.TimeTransformed(lambda t, q, p, args: 1.0)])
def test_observables_in_slow_time_have_all_forms(lattice):
    """H_D receives τ = εt, observables receive t; those of InSlowTime receive τ."""
    slow = dvi.System(
        lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + (1 + t0) * (q0 @ q0) / 2, slow_time=True
    )
    observe = dict(OF_SLOW_TIME)
    if lattice != dvi.Uniform():
        del observe["running"]
    options = {"h": 0.1, "num_steps": 10, "epsilon": 0.3, "lattice": lattice}
    sol = dvi.integrate(slow, [1.0], [0.2], observe=observe, **options)
    ts, q, p = np.asarray(sol.ts), np.asarray(sol.qs[:, 0]), np.asarray(sol.ps[:, 0])
    energies = p**2 / 2 + (1 + 0.3 * ts) * q**2 / 2
    np.testing.assert_allclose(sol.observed["state"], energies, rtol=1e-13)
    np.testing.assert_allclose(sol.observed["step"], energies[1:], rtol=1e-13)
    np.testing.assert_allclose(sol.observed["time"], ts, rtol=1e-13)
    np.testing.assert_allclose(sol.observed["q"], q, rtol=1e-13)
    assert sol.observed["largest"] == pytest.approx(0.3 * ts[-1], rel=1e-13)
    assert sol.observed["last"] == q[-1]
    if "running" in observe:
        np.testing.assert_allclose(sol.observed["running"], 0.3 * ts[1:], rtol=1e-13)
    # Called by a user, with the arguments of a step.
    step = (0.0, 0.1, *(jnp.ones(1) * x for x in (1.0, 0.2, q[1], p[1])), None)
    for name in ("step", "state"):
        assert observe[name].bind(slow, 0.3)(*step) == pytest.approx(energies[1], rel=1e-13)
        with pytest.raises(ValueError, match="needs the value of epsilon"):
            observe[name](*step)


def test_an_argument_tau_that_would_receive_t_is_refused():
    slow = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + (1 + t0) * q @ q / 2, slow_time=True)
    of_tau = lambda tau, q, p, args: (1 + tau) * q[0]  # noqa: E731
    inputs = {"h": 0.1, "num_steps": 3, "epsilon": 0.3}
    for options in (
        {"observe": of_tau},
        {"observe": {"E": slow_energy}},
        {"observe": dvi.Running(dvi.MaxDrift(of_tau))},
        {"observe": dvi.Section(of_tau)},
        {"stop": dvi.Stop(of_tau)},
        {"save": dvi.Save(ts=[0.2], clock=of_tau)},
        {"lattice": dvi.TimeTransformed(of_tau)},
        {"lattice": dvi.AdaptiveReversible(of_tau), "method": dvi.Strang()},
    ):
        with pytest.raises(TypeError, match="is the time t, not τ"):
            dvi.integrate(slow, [1.0], [0.2], **inputs, **options)
    # These places do not receive ε.
    f = systems.InSlowTime(of_tau)
    for options in (
        {"observe": {"x": dvi.Section(f)}},
        {"stop": dvi.Stop(f)},
        {"save": dvi.Save(ts=[0.2], clock=f)},
        {"lattice": dvi.TimeTransformed(f)},
    ):
        with pytest.raises(ValueError, match="do not receive ε"):
            dvi.integrate(slow, [1.0], [0.2], **inputs, **options)
    data = dvi.Observations([0.1, 0.2], [1.0, 1.0], t0=0.0, observe=of_tau)
    model = dvi.Model(slow, h=0.1, p0=[0.2], epsilon=0.3)
    with pytest.raises(TypeError, match="is the time t, not τ"):
        dvi.fit(model, data, {"q0": [1.0]})
    data = dvi.Observations([0.1], [1.0], t0=0.0, observe=systems.InSlowTime(of_tau))
    with pytest.raises(ValueError, match="do not receive ε"):
        dvi.fit(model, data, {"q0": [1.0]})
    # A system without a slow time has no τ = εt.
    fast = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + q @ q / 2)
    dvi.integrate(fast, [1.0], [0.2], h=0.1, num_steps=3, observe=of_tau)


def test_the_reverse_gradient_of_a_run_whose_observable_is_a_number():
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + q @ q / 2)
    observe = (dvi.Section(lambda q, p: p[0], max_crossings=2), lambda *step: 0.7)

    def loss(q):
        run = {"h": 0.1, "num_steps": 3, "observe": observe, "save": dvi.Save(final=True)}
        sol = dvi.integrate(system, q, q, method=dvi.TypeII(), adjoint=dvi.Reversible(), **run)
        return sol.q_final[0] + jnp.sum(sol.observed[1])

    assert jax.grad(loss)(jnp.ones(1))[0] == pytest.approx(
        float(loss(jnp.ones(1)) - 0.7), rel=1e-12
    )


def test_a_drift_stays_nan():
    """A NaN stays, whatever comes after it; an infinite value is a drift without bound."""
    drift, nan, inf = dvi.MaxDrift(lambda q, p: q), np.nan, np.inf
    cases = [([1, 3, 0], 2), ([1, nan, 5], nan), ([nan, 1, 1], nan), ([1, inf, 2], inf)]
    for values, expected in [*cases, ([1, -inf, nan], nan), ([inf, 1, 1], nan), ([], nan)]:
        memory = drift.start(jnp.asarray(0.0))
        for k, value in enumerate(values):
            memory = drift.update(
                memory, jnp.asarray(k, jnp.int32), 0.1 * k, jnp.asarray(1.0 * value)
            )
        np.testing.assert_array_equal(drift.finish(memory), expected)
