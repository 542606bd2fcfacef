"""Equations x' = f(x) identified from data: their terms, standard errors, and what is missing."""

import functools
import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2

import dvi_jax as dvi


def predator_prey(t, x):
    return [x[0] - 0.5 * x[0] * x[1], -0.8 * x[1] + 0.4 * x[0] * x[1]]


def lorenz(t, x):
    return [10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]]


def van_der_pol(t, x):
    return [x[1], -x[0] + 1.5 * (1 - x[0] ** 2) * x[1]]


def epidemic(t, x):
    return [-1.8 * x[0] * x[1], 1.8 * x[0] * x[1] - 0.5 * x[1]]


def damped_cubic(t, x):
    return [-0.1 * x[0] ** 3 + 2 * x[1] ** 3, -2 * x[0] ** 3 - 0.1 * x[1] ** 3]


PREDATOR_PREY = {"x1 e1": 1.0, "x2 e2": -0.8, "x1 x2 e1": -0.5, "x1 x2 e2": 0.4}
LORENZ = {
    **{"x1 e1": -10.0, "x2 e1": 10.0, "x1 e2": 28.0, "x2 e2": -1.0, "x1 x3 e2": -1.0},
    **{"x1 x2 e3": 1.0, "x3 e3": -8 / 3},
}
VAN_DER_POL = {"x2 e1": 1.0, "x1 e2": -1.0, "x2 e2": 1.5, "x1² x2 e2": -1.5}
EPIDEMIC = {"x1 x2 e1": -1.8, "x1 x2 e2": 1.8, "x2 e2": -0.5}
DAMPED_CUBIC = {"x1³ e1": -0.1, "x2³ e1": 2.0, "x1³ e2": -2.0, "x2³ e2": -0.1}

MODEL = dvi.Model.first_order(h=0.1)
QUADRATIC = dvi.ForceLibrary.monomials(2, 2, "x", constant=True)
SMALL = QUADRATIC.only([*PREDATOR_PREY, "x1² e1", "x2² e2"])
# Irregular times, none at a step of the model.
TIMES = np.sort(np.random.default_rng(1).uniform(0.0, 10.0, 60))


@functools.cache
def exact(field, start, ts):
    span = (0.0, ts[-1])
    accurate = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-11, "t_eval": ts}
    return solve_ivp(field, span, start, **accurate).y.T


def observed(field, start, ts, noise, seed, known=True):
    values = exact(field, tuple(start), tuple(ts))
    values = values + noise * np.random.default_rng(seed).normal(size=values.shape)
    return dvi.Observations(ts, values, sigma=noise if known else None)


def deviations(found, planted):
    return (found.coefficients - [planted[name] for name in found.terms]) / found.sigma


@pytest.mark.parametrize("stages", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_the_order_of_the_integrator(stages):
    """The equation of q is x' = f, and the auxiliary momenta stay exactly zero."""
    model = dvi.Model.first_order(
        lambda t, x, args: jnp.stack(predator_prey(t, x)),
        h=0.1, q0=[2.0, 1.0], method=dvi.GaussLegendre(stages),
    )  # fmt: skip
    reference = exact(predator_prey, (2.0, 1.0), (0.0, 4.0))[-1]
    errors = []
    for steps in (20, 40, 80):
        sol = dvi.integrate(**{**model({}), "h": 4.0 / steps}, num_steps=steps)
        assert not np.any(sol.ps)
        errors.append(np.abs(sol.qs[-1] - reference).max())
    assert np.diff(np.log2(errors)) == pytest.approx(-2 * stages, abs=0.35)


@pytest.mark.slow
def test_two_arcs_at_irregular_times_with_missing_values():
    """The initial states are not given: they begin at the first observations."""
    arcs = []
    for seed, start in enumerate([(2.0, 1.0), (3.0, 2.5)]):
        arc = observed(predator_prey, start, TIMES[seed::2], 0.03, seed)
        arc.values[5:9, 0] = np.nan
        arcs.append(dvi.Observations(arc.ts, arc.values, sigma=0.03))
    found = dvi.identify(MODEL, arcs, SMALL)
    assert set(found.terms) == set(PREDATOR_PREY)
    assert np.abs(deviations(found, PREDATOR_PREY)).max() < 4
    assert np.max(found.sigma / np.abs(found.coefficients)) < 0.02
    assert "contradict" not in str(found)
    assert found.fit.params["q0"].shape == (2, 2)
    assert "q0 fitted, p0 of the model" in str(found.fit)
    rate = jax.grad(found.system.hamiltonian, argnums=3)
    x = jnp.array([0.7, 1.3])
    expected = dict(zip(found.terms, found.coefficients, strict=True))
    # The identified system is the equation x' = f(x).
    f = rate(jnp.zeros(()), jnp.zeros(()), x, jnp.zeros(2), 0.0, None)
    first = expected["x1 e1"] * 0.7 + expected["x1 x2 e1"] * 0.7 * 1.3
    assert f[0] == pytest.approx(first, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_a_missing_term_is_reported(known):
    """Other terms cannot take its place silently, with and without errors of the data."""
    data = observed(predator_prey, (2.0, 1.0), TIMES, 0.03, 0, known)
    complete = dvi.identify(MODEL, data, QUADRATIC)
    assert set(complete.terms) == set(PREDATOR_PREY)
    incomplete = QUADRATIC.only([name for name in QUADRATIC.names if name != "x1 x2 e2"])
    found = dvi.identify(MODEL, data, incomplete, throw=False)
    message = "residuals contradict sigma" if known else "residuals of neighbouring times are corr"
    assert message not in str(complete)
    assert message in str(found)


@pytest.mark.slow
def test_standard_errors_over_noise():
    """Terms and errors for 20 noise realisations: exactly the planted terms, z of unit size."""
    total, inside = 0.0, []
    for seed in range(20):
        data = observed(predator_prey, (2.0, 1.0), TIMES, 0.03, seed)
        found = dvi.identify(MODEL, data, QUADRATIC)
        assert set(found.terms) == set(PREDATOR_PREY)
        z = deviations(found, PREDATOR_PREY)
        inside += [np.abs(z) < 1]
        indices = [found.fit.names.index(f"coefficients.{name}") for name in found.terms]
        total += z @ np.linalg.solve(found.fit.correlations[np.ix_(indices, indices)], z)
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 80)
    print(f"chi² of the deviations {total:.1f} for 80, {np.mean(inside):.2f} within one sigma")
    assert low < total < high
    assert 0.5 < np.mean(inside) < 0.85


CASES = {
    "van der Pol": (van_der_pol, VAN_DER_POL, (0.5, 0.0), np.arange(0, 12, 0.1), 3, 0.02),
    "epidemic": (epidemic, EPIDEMIC, (0.99, 0.01), np.arange(0, 15, 0.25), 2, 0.005),
    "damped cubic": (damped_cubic, DAMPED_CUBIC, (2.0, 0.0), np.arange(0, 10, 0.05), 3, 0.02),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_exactly_the_planted_terms(name):
    field, planted, start, ts, degree, noise = CASES[name]
    library = dvi.ForceLibrary.monomials(degree, 2, "x")
    found = dvi.identify(
        dvi.Model.first_order(h=0.05), observed(field, start, ts, noise, 0), library
    )
    assert set(found.terms) == set(planted)
    assert np.abs(deviations(found, planted)).max() < 4
    assert "contradict" not in str(found)


@pytest.mark.slow
def test_lorenz_by_multiple_shooting():
    """Over 3.6 Lyapunov times, after which the trajectory of a wrong guess is of no use."""
    ts = np.arange(0.0, 4.0, 0.02)
    data = observed(lorenz, (-8.0, 8.0, 27.0), ts, 0.1, 0)
    library = dvi.ForceLibrary.monomials(2, 3, "x", constant=True)
    segments = dvi.MultipleShooting(10)
    found = dvi.identify(dvi.Model.first_order(h=0.01), data, library, shooting=segments)
    assert set(found.terms) == set(LORENZ)
    assert np.abs(deviations(found, LORENZ)).max() < 4
    assert np.max(found.sigma / np.abs(found.coefficients)) < 0.02
    assert found.fit.status == "converged"


@pytest.mark.slow
def test_a_known_part_and_a_function_of_time():
    """x' = −x + 0.3 sin 2t + 0.8 with the first term known."""
    ts = np.arange(0.0, 12.0, 0.1)
    data = observed(lambda t, x: [-x[0] + 0.3 * np.sin(2 * t) + 0.8], (2.0,), ts, 0.01, 0)
    model = dvi.Model.first_order(lambda t, x, args: -x, h=0.1)
    library = dvi.ForceLibrary.monomials(2, 1, "x", constant=True) + dvi.ForceLibrary(
        {"sin 2t": lambda t0, t1, x, p, args: jnp.sin(2 * t0) * jnp.ones_like(x)}
    )
    found = dvi.identify(model, data, library)
    assert set(found.terms) == {"1", "sin 2t"}
    assert np.abs(deviations(found, {"1": 0.8, "sin 2t": 0.3})).max() < 4


def terms_with_coefficients():
    library = SMALL.only(PREDATOR_PREY)
    model = dvi.Model.first_order(library, h=0.1)
    start = [PREDATOR_PREY[name] for name in library.names]
    data = observed(predator_prey, (2.0, 1.0), TIMES[TIMES < 3], 0.03, 0)
    params = {"q0": np.array(data.values[0]), "args": {"coefficients": np.array(start)}}
    return model, data, params


def test_gradients_of_the_posterior():
    """Both modes of the gradient agree with differences, over identified terms and start."""
    model, data, params = terms_with_coefficients()
    posterior = dvi.Posterior(model, data, params, gradient="forward")
    u = jnp.asarray(posterior.start)
    slope = np.asarray(jax.grad(posterior.potential)(u))
    step = 1e-5  # the error of a central difference is about 1e-10 of the third derivative
    differences = [
        (posterior.potential(u + step * e) - posterior.potential(u - step * e)) / (2 * step)
        for e in np.eye(len(u))
    ]
    np.testing.assert_allclose(slope, differences, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_samples_of_the_posterior_have_the_errors_of_the_fit():
    pytest.importorskip("numpyro")
    model, data, params = terms_with_coefficients()
    fit = dvi.fit(model, data, params)
    options = {"num_samples": 400, "num_warmup": 200, "chains": 2, "explore": 0}
    samples = dvi.sample(model, data, fit.params, **options)
    assert samples.status == "mixed"
    np.testing.assert_allclose((samples.mean - fit.x) / fit.sigma, 0.0, atol=0.3)
    np.testing.assert_allclose(samples.sigma / fit.sigma, 1.0, atol=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Van der Pol", "Lotka–Volterra"])
def test_a_comparison_with_pysindy(name, monkeypatch):
    """A row of the table of docs/equations.md: no row of `identify` has a wrong term."""
    pytest.importorskip("pysindy")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    identification = importlib.import_module("identification")
    case = identification.CASES[name]
    scores = identification.compare(case, 0)
    missing, surplus, error = scores["identify"]
    assert (missing, surplus) == (0, 0)
    assert error < 0.5 * scores["best"][2]
    assert error < 0.5 * scores["default"][2]
    assert np.abs(deviations(scores["found"], case.terms)).max() < 4


TS, VALUES = [0.1, 0.2, 0.3, 0.4], np.ones((4, 2))
OF_P = dvi.ForceLibrary.monomials(1, 2)
WRONG_SHAPE = dvi.ForceLibrary({"f": lambda t0, t1, x, p, args: x[:1]})
INVALID = [
    (lambda: dvi.Observations(TS, VALUES[:3]), ValueError, "one row for each"),
    (lambda: dvi.Observations(TS, np.full((4, 2), np.nan)), ValueError, "at least one number"),
    (lambda: dvi.Observations([0.0, 0.2, 0.1, 0.3], VALUES), ValueError, "all increase or all"),
    (lambda: dvi.Model.first_order(lambda x: x, h=0.1), TypeError, r"\(t, x, args\)"),
    (lambda: run(library=OF_P), ValueError, "candidates of x, the first state, got one of p"),
    (lambda: run(library=WRONG_SHAPE), ValueError, "'f'.* must have shape"),
    (lambda: run(library=dvi.ForceLibrary.monomials(1, 3, "x")), ValueError, r"shape \(3,\)"),
    (lambda: run(params={"epsilon": 1.0}), ValueError, "epsilon"),
    (lambda: run(observe="state"), TypeError, "q0 is missing"),
    (lambda: run(values=[[np.nan, 1.0], *VALUES[1:]]), TypeError, "q0 is missing"),
    (lambda: run(params={"q0": np.ones(3)}), ValueError, r"q0 for .* must have shape \(2,\)"),
    (lambda: run(model=dvi.Model.first_order(h=0.1, q0=[1.0])), ValueError, r"q0 for .* shape \(2"),
    (lambda: run(values=np.ones((4, 3))), ValueError, r"q0 for .* must have shape \(2,\)"),
    (lambda: run(ts=[0.1], values=VALUES[:1]), ValueError, "observed values"),
]


def run(model=MODEL, ts=TS, values=VALUES, library=QUADRATIC, params=None, observe="positions"):
    return dvi.identify(model, dvi.Observations(ts, values, observe), library, params)


@pytest.mark.parametrize(("call", "error", "match"), INVALID)
def test_invalid_input(call, error, match):
    with pytest.raises(error, match=match):
        call()
