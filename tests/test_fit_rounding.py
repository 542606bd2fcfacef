"""Fits whose accuracy is bounded by the round-off of the predictions: they converge, and say so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.fit import _fit as fits
from dvi_jax.fit.roundoff import STIFFNESS, Evaluation, settle

STEP, STEPS, COUNT = 0.05, 4000, 40
TS = STEP * STEPS / COUNT * np.arange(1, COUNT + 1)
P0 = [0.0, 1.0]


def kepler(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 - args["mu"] / jnp.sqrt(q0 @ q0)


def reordered(t0, t1, q0, p1, args):
    """The same with another order of operations."""
    return 0.5 * (p1[1] * p1[1] + p1[0] * p1[0]) - args["mu"] * (q0[0] ** 2 + q0[1] ** 2) ** -0.5


MODEL = dvi.Model(dvi.System(kepler), h=STEP, q0=[1.0, 0.1], p0=P0, method=dvi.Strang())


def positions(system, arithmetic):
    """A compiled function of q0 and mu."""
    options = {"h": STEP, "num_steps": STEPS, "save": dvi.Save(every=STEPS // COUNT)}
    options |= {"method": dvi.Strang(), "arithmetic": arithmetic}
    return jax.jit(lambda q, mu: dvi.integrate(system, q, P0, args={"mu": mu}, **options).qs[1:])


def repeated(count, values, noise):
    """Fits of random orbits from a start that is 1e-7 off, and their errors over sigma."""
    random, found, off = np.random.default_rng(0), [], []
    for _ in range(count):
        q, mu = np.array([1.0, 0.1]) * random.uniform(0.95, 1.05, 2), random.uniform(0.95, 1.05)
        y = np.asarray(values(q, mu)) + noise * random.normal(size=(COUNT, 2))
        start = {"args": {"mu": mu * (1 + 1e-7)}, "q0": q * (1 + 1e-7)}
        data = dvi.Observations(TS, y, t0=0.0)
        fit = dvi.fit(MODEL, data, start, check_curvature=False, throw=False)
        found.append(fit)
        off.append((fit.x - [mu, *q]) / fit.sigma)
    return found, np.array(off)


@pytest.mark.slow
def test_residuals_of_pure_rounding():
    """4000 steps with another order of operations: 8 fits end at the truth, and report why."""
    found, off = repeated(8, positions(dvi.System(reordered), dvi.FloatingPoint()), 0.0)
    assert [fit.status for fit in found] == ["converged"] * 8
    assert max(fit.rms for fit in found) < 1e-11
    # Residuals of rounding are correlated, so that the errors are only about right.
    assert np.sqrt(np.mean(off**2)) < 2
    limited = [fit for fit in found if fit.rounding.any()]
    assert len(limited) == 8
    for fit in limited:
        assert "converged at the level of rounding" in str(fit)
        assert (fit.sigma > fit.rounding).all()


@pytest.mark.slow
def test_the_truth_is_within_the_errors_as_often_as_expected():
    """Noise of the size of the round-off, which is 2e-13: one standard error has 68 %."""
    found, off = repeated(200, positions(dvi.System(kepler), dvi.Compensated()), 5e-13)
    assert {fit.status for fit in found} == {"converged"}
    within = np.mean(np.abs(off) <= 1)
    print(f"within one standard error: {100 * within:.1f} %")
    assert abs(within - 0.68) < 0.07
    for factor in (0.5, 2.0):  # negative control: other errors
        assert abs(np.mean(np.abs(factor * off) <= 1) - 0.68) > 0.07


def test_a_fit_at_a_kink_is_stalled():
    """The loss is least at a kink, where its gradient is not zero."""

    def kinked(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + (1.3 + jnp.abs(args["k"] - 1.2)) * (q0 @ q0) / 2

    model = dvi.Model(dvi.System(kinked), h=STEP, q0=[1.0], p0=[0.0], method=dvi.Strang())
    ts = np.arange(1, 31) * 0.5
    data = dvi.Observations(ts, np.cos(np.sqrt(1.2) * ts), t0=0.0)
    found = dvi.fit(model, data, {"args": {"k": 1.25}}, throw=False, check_curvature=False)
    assert found.x[0] == pytest.approx(1.2, abs=0.01)
    assert found.status == "stalled"
    assert not found.rounding.any()
    assert "level of rounding" not in str(found)


NUMBERS = np.random.default_rng(1)
A, B = NUMBERS.normal(size=(30, 2)), NUMBERS.normal(size=30)
BEST = np.linalg.lstsq(A, B, rcond=None)[0]
NOISY = 1e-4


def scattered(x):
    """Numbers that look random, a function of the bits of x."""
    seed = np.frombuffer(np.asarray(x).tobytes(), np.uint32)
    return np.random.default_rng(seed).normal(size=30)


CASES = {
    "smooth": (lambda x: A @ x - B, 1.0),
    "round-off": (lambda x: A @ x - B + NOISY * scattered(x), 1.0),
    "derivative of a third": (lambda x: A @ x - B, 1 / 3),
    "derivative of the other sign": (lambda x: A @ x - B, -1.0),
    "kink": (lambda x: np.abs(A @ (x - BEST)) + 1.0, 1.0),
    "chaos": (scattered, 1e6),
    "no number nearby": (lambda x: (A @ x - B) * (1 if x[0] == BEST[0] + 0.1 else np.nan), 1.0),
}


@pytest.mark.parametrize("name", CASES)
def test_round_off_is_distinguished_from_other_causes(name):
    function, factor = CASES[name]

    def evaluate(x):
        sign = np.sign(A @ (x - BEST))[:, None] if name == "kink" else 1.0
        return Evaluation(function(x), factor * sign * A)

    x = BEST + 0.1
    scale = STIFFNESS / np.linalg.norm(evaluate(x).jacobian, axis=0)
    end = settle(evaluate, x, evaluate(x), scale, flat=1e-9, small=0.0)
    if name not in ("smooth", "round-off"):
        assert end is None
        return
    assert end is not None
    error = np.linalg.norm(end.u - BEST)
    if name == "smooth":
        assert len(end.shifts) == 0
        assert error < 1e-12
    else:
        assert error < 5 * NOISY
        # Changes of u are differences of two round-offs: twice the variance of J⁺ δ.
        expected = NOISY * np.sqrt(2 * np.trace(np.linalg.inv(A.T @ A)))
        assert np.sqrt(np.mean(np.sum(end.shifts**2, axis=1))) == pytest.approx(expected, rel=0.7)


@pytest.mark.slow
def test_differences_of_jacobians_give_the_exact_curvature(monkeypatch):
    """For data that the model does not describe: there the curvature is not 1."""

    def spring(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + args["k"] * (q0 @ q0) / 2

    model = dvi.Model(dvi.System(spring), h=STEP, p0=[0.0], method=dvi.Strang())
    ts = np.arange(1, 31) * 0.5
    data = dvi.Observations(ts, np.cos(ts) + 0.3 * np.sin(3 * ts), t0=0.0)
    start = {"args": {"k": 1.02}, "q0": np.array([1.0])}
    differences = dvi.fit(model, data, start).curvature
    monkeypatch.setattr(fits, "_SMALL", 0)
    exact = dvi.fit(model, data, start).curvature
    assert differences is not None
    assert exact is not None
    np.testing.assert_allclose(differences, exact, rtol=0, atol=1e-5)
    assert np.abs(exact - 1).max() > 1e-3
