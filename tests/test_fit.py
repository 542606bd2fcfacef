"""Fits: estimates, standard errors and statuses, bounds, priors, losses, horizons, checkpoints."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from scipy import stats

import dvi_jax as dvi
from dvi_jax.fit import problem as problems, run
from dvi_jax.fit.observations import as_arcs
from dvi_jax.fit.parameters import make_space
from dvi_jax.fit.uncertainty import correlations, null_space, uncertainty


def H(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 + args["k"] * jnp.sum(q0**2) / 2


def W(t0, t1, q0, p1, args):
    return -p1


SYSTEM = dvi.System(H, force=W)
STEP, NOISE = 0.05, 0.01
TRUE = {"epsilon": 0.02, "args": {"k": 1.3}, "q0": np.array([1.0])}
TRUTH = np.array([1.3, 0.02, 1.0])  # as one vector
START = {"epsilon": 0.0, "args": {"k": 1.2}, "q0": np.array([0.9])}
FAR = {**START, "args": {"k": 0.7}}
REGULAR = np.arange(1, 61) * 0.5
IRREGULAR = np.sort(np.random.default_rng(5).uniform(0, 30, 60))
UNCHECKED = {"check_curvature": False}


def model_of(system=SYSTEM, **known):
    given = {"h": STEP, "p0": [0.0], "args": {"k": 1.0}, "method": dvi.Strang(), **known}
    return dvi.Model(system, **given)


MODEL = model_of()


def named(params):
    """The model with parameters e and k, and others that it ignores."""
    return MODEL({"q0": [1.0], "epsilon": params["e"], "args": {"k": params["k"]}})


def states_at(ts, **of):
    """States of the true system at times, by `Save(ts=...)`, which fits do not use."""
    given = {**TRUE, "p0": [0.0], "h": STEP, **of}
    steps = int(np.ceil(ts[-1] / given["h"]))
    options = {"num_steps": steps, "method": dvi.Strang(), "save": dvi.Save(ts=ts)}
    return dvi.integrate(SYSTEM, given.pop("q0"), given.pop("p0"), **given, **options)


def noisy(ts, seed, **of):
    y = np.asarray(states_at(ts, **of).qs)
    return y + NOISE * np.random.default_rng(seed).normal(size=y.shape)


def observed(values, ts=REGULAR, sigma=NOISE, **options):
    return dvi.Observations(ts, values, sigma=sigma, t0=0.0, **options)


def seen(seed, **of):
    """Positions at regular times with noise."""
    return observed(noisy(REGULAR, seed, **of))


def off(found, truth=TRUTH):
    """The largest error in standard errors."""
    return np.abs((found.x - truth) / found.sigma).max()


@pytest.fixture(scope="module")
def regular():
    data = seen(1)
    return data, dvi.fit(MODEL, data, START)


def problem_of(data, params=START, model=MODEL, **options):
    arcs, many = as_arcs(data)
    made = problems.FitProblem(model, arcs, many, params, **options)
    return made, made.space.to_u(made.start)


def test_the_truth_is_found(regular):
    data, found = regular
    assert found.status == "converged"
    assert found.names == ["args.k", "epsilon", "q0[0]"]
    assert off(found) < 3
    assert (found.sigma < [1e-3, 2e-3, 1e-2]).all()
    assert float(found.params["epsilon"]) == found.x[1]
    assert 0.5 < found.reduced_chi2 < 1.6
    assert abs(found.statistics()["lag_one"]) < 0.4
    assert {"args.k", "±"} <= set(str(found).split())
    assert "initial state at t0 = 0: q0 fitted, p0 of the model" in str(found)
    np.testing.assert_allclose(found.predicted[0] + found.residuals[0], data.values, atol=1e-14)


@pytest.mark.slow
def test_predictions_at_and_between_grid_points():
    errors, omega, gamma = [], np.sqrt(1.3 - 0.01**2), 0.01
    t = IRREGULAR
    exact = np.exp(-gamma * t) * (np.cos(omega * t) + gamma / omega * np.sin(omega * t))
    for h in (0.05, 0.025):
        problem, u = problem_of(observed(np.zeros((60, 1)), t), TRUE, model_of(h=h))
        ((found, _),) = problem.weighted_residuals(u)[1]
        errors.append(np.abs(np.asarray(found)[0, :, 0] - exact).max())
    assert errors[0] < 5e-3
    assert 3.4 < errors[0] / errors[1] < 4.6
    problem, u = problem_of(observed(np.zeros((60, 1))), TRUE)
    assert problem.groups[0].block == 10
    ((found, _),) = problem.weighted_residuals(u)[1]
    np.testing.assert_allclose(np.asarray(found)[0], states_at(REGULAR).qs, atol=1e-12)


@pytest.mark.parametrize("ts", [REGULAR, IRREGULAR], ids=["regular", "irregular"])
@pytest.mark.slow
def test_jacobian_against_differences_and_reverse_mode(ts):
    """Reverse mode by each adjoint against the Jacobian by forward mode."""
    data = observed(np.cos(ts)[:, None], ts, 1.0)
    problem, u = problem_of(data)
    r, J, _ = map(np.asarray, (*problem.evaluate(u)[:2], 0))
    for i in range(problem.size):
        # Differences of fourth order at 1e-3: truncation 1e-12 of it, rounding 1e-13.
        step = 1e-3 * np.eye(problem.size)[i]
        at = [np.asarray(problem.evaluate(u + k * step).residual) for k in (-2, -1, 1, 2)]
        differences = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / 12e-3
        assert np.abs(J[:, i] - differences).max() < 1e-8 * np.abs(J[:, i]).max()
    wrong = problem.evaluate(u + 1e-5).jacobian
    assert np.abs(wrong - J).max() > 1e-8 * np.abs(J).max()
    adjoints = (dvi.Reversible(), dvi.Checkpointed(), dvi.Direct())
    for adjoint in adjoints if ts is REGULAR else adjoints[:1]:
        problem, _ = problem_of(data, model=model_of(adjoint=adjoint))
        backward = np.asarray(jax.jit(jax.grad(problem.core.scalar))(jnp.asarray(u)))
        np.testing.assert_allclose(backward, J.T @ r, rtol=1e-8, atol=1e-8 * np.abs(J.T @ r).max())


@pytest.mark.slow
def test_covariance_is_the_inverse_of_the_exact_hessian_at_a_perfect_fit():
    data = observed(np.asarray(states_at(REGULAR).qs))
    found = dvi.fit(MODEL, data, START)
    np.testing.assert_allclose(found.x, TRUTH, atol=1e-9)
    problem, _ = problem_of(data, found.params)
    hessian = np.asarray(problem.hessian(found.x))
    np.testing.assert_allclose(np.linalg.inv(hessian), found.covariance, rtol=1e-6)
    np.testing.assert_allclose(found.curvature, 1.0, atol=1e-6)


def test_errors_from_residuals_and_curvature(regular):
    data, known = regular
    unknown = dvi.fit(MODEL, observed(data.values, sigma=None), START)
    np.testing.assert_allclose(unknown.x, known.x, atol=1e-6)
    spread = np.sqrt(known.reduced_chi2)
    np.testing.assert_allclose(unknown.sigma, known.sigma * spread, rtol=1e-5)
    bent = noisy(REGULAR, 2) + 0.5 * np.sign(np.sin(1.14 * REGULAR))[:, None]
    assert np.abs(dvi.fit(MODEL, observed(bent), START).curvature - 1).max() > 0.02


@pytest.mark.slow
def test_undetermined_directions_are_named_and_take_no_degree_of_freedom():
    def model(params):
        given = {"epsilon": params["a"] + 2 * params["b"], "q0": params["q0"]}
        return MODEL({**given, "args": {"k": 1.3}})

    start = {"a": 0.0, "b": 0.0, "q0": np.array([0.95]), "c": 1.0}
    found = dvi.fit(model, seen(4), start)
    assert found.status == "converged"
    assert len(found.undetermined) == 2
    words = " | ".join(found.undetermined)
    assert all(text in words for text in ("a", "b", "1.00 c"))
    sigma = dict(zip(found.names, found.sigma, strict=True))
    assert np.isinf([sigma["a"], sigma["b"], sigma["c"]]).all()
    assert sigma["q0[0]"] < 0.01
    assert np.isnan(found.correlations[0, 1])
    assert "not determined" in str(found)
    few = observed(noisy(REGULAR, 14)[:6], REGULAR[:6], None)
    plain = dvi.fit(named, few, {"e": 0.0, "k": 1.3}, **UNCHECKED)
    idle = dvi.fit(named, few, {"e": 0.0, "k": 1.3, "z": np.zeros(3)}, **UNCHECKED)
    assert len(idle.undetermined) == 3
    assert idle.degrees_of_freedom == plain.degrees_of_freedom == 4
    np.testing.assert_allclose(idle.sigma[:2], plain.sigma, rtol=1e-5)


def test_uncertainty_and_explained_variance_are_those_of_their_definitions(regular):
    about = uncertainty(np.array([[3.0, 0.0], [0.0, 0.5], [0.0, 0.0]]), 4.0)
    np.testing.assert_allclose(about.covariance, np.diag([4 / 9, 16.0]))
    np.testing.assert_allclose(correlations(about.covariance), np.eye(2))
    C = np.array([[1.0, 1.0, 0.0]])
    assert np.abs(C @ null_space(C)).max() < 1e-15
    assert null_space(C).shape == (3, 2)
    # x + y is known exactly: y has the error of −x.
    tied = uncertainty(np.eye(3), 1.0, null_space(C))
    np.testing.assert_allclose(tied.covariance[:2, :2], [[0.5, -0.5], [-0.5, 0.5]], atol=1e-12)
    # With errors of each value, a missing one, and a mean for each component.
    random = np.random.default_rng(0)
    values, model, errors = random.normal(size=(3, 9, 2))
    values[4, 1], errors = np.nan, np.abs(errors) + 0.1
    given = {"observed": [values], "predicted": [model], "errors": [errors]}
    left = total = 0.0
    for k in range(2):
        good = np.isfinite(values[:, k])
        y, w = values[good, k], errors[good, k] ** -2.0
        left += np.sum(w * (y - model[good, k]) ** 2)
        total += np.sum(w * (y - np.average(y, weights=w)) ** 2)
    found = dataclasses.replace(regular[1], **given)
    np.testing.assert_allclose(found.explained, 1 - left / total, rtol=1e-12)


def test_a_model_no_better_than_a_constant_is_reported(regular):
    """A minimum in k far from the true one, which is a local minimum."""
    data, good = regular
    start = {**START, "args": {"k": 9.0}}
    without = observed(data.values, sigma=None)
    bad = dvi.fit(MODEL, without, start, horizons=None, throw=False)
    assert bad.explained < 0.1
    assert "better than constants do" in str(bad)
    assert 0.99 < good.explained < 1
    assert "constants" not in str(good)


@pytest.mark.parametrize("degrees", [3, 57, 2000])
def test_residuals_contradict_sigma_beyond_the_quantiles_of_chi2(regular, degrees):
    """The rule is that of scipy's χ² distribution on both sides, at a probability of 1e-4."""
    fit = regular[1]
    for quantile, side in ((stats.chi2.isf(1e-4, degrees), 1), (stats.chi2.ppf(1e-4, degrees), -1)):
        for factor in (0.999, 1.001):
            total = quantile * factor
            r = fit.whitened[0] * np.sqrt(total / fit.chi2)
            fields = {"whitened": [r], "loss": total / 2, "degrees_of_freedom": degrees}
            text = str(dataclasses.replace(fit, **fields))
            assert ("contradict sigma" in text) == ((factor > 1) == (side > 0))
            assert ("sigma is too large" in text) == (factor < 1 and side < 0)


def test_residuals_that_contradict_sigma(regular):
    data, fit = regular
    assert "contradict" not in str(fit)
    small, large = (observed(data.values, sigma=NOISE * s) for s in (0.5, 3.0))
    assert "or sigma is too small" in str(dvi.fit(MODEL, small, START))
    assert "sigma is too large" in str(dvi.fit(MODEL, large, START))
    incomplete = dvi.fit(
        MODEL,
        data,
        {"q0": np.array([0.9]), "args": {"k": 1.2}, "epsilon": 0.0},
        bounds={"epsilon": dvi.Bounds(-0.005, 0.005)},
    )
    assert incomplete.status == "converged"
    assert "the model is incomplete" in str(incomplete)
    unknown = dvi.fit(MODEL, observed(data.values, sigma=None), START)
    assert "contradict" not in str(unknown)
    outliers = data.values.copy()
    outliers[::10] += 0.5
    assert "contradict" in str(dvi.fit(MODEL, observed(outliers), START))
    assert "contradict" not in str(dvi.fit(MODEL, observed(outliers), START, loss=dvi.Cauchy()))


PRIORS = {  # mean and sigma, in standard errors of the fit without priors, relative to its result
    "agrees": (2.0, 3.0),
    "wide and far": (600.0, 100.0),
    "narrow": (15.0, 2.0),
    "narrower than the errors": (6.0, 0.1),
    "far below": (-8.0, 1.0),
}


@pytest.mark.parametrize("name", PRIORS)
def test_priors_that_contradict_the_data(regular, name):
    """One prior among many values hardly changes their χ²: its own χ² decides, by the difference
    of two independent estimates, the prior and the fit without it."""
    data, free = regular
    index = free.names.index("args.k")
    distance, width = np.array(PRIORS[name]) * free.sigma[index]
    prior = {"args": {"k": dvi.Prior(free.x[index] + distance, width)}}
    fit = dvi.fit(MODEL, data, START, priors=prior, check_curvature=False)
    expected = distance**2 / (width**2 + free.covariance[index, index])
    assert abs(fit.conflict / expected - 1) < 0.05
    assert ("priors contradict the data" in str(fit)) == (name != "agrees")
    assert str(fit).startswith("converged, but the" if name != "agrees" else "converged after")
    assert fit.priors == ["args.k"]


@pytest.mark.slow
def test_bounds_hold_and_are_named():
    data = seen(4)
    inside = dvi.fit(MODEL, data, START)
    wide = {"epsilon": dvi.Bounds(-1, 1), "args": {"k": dvi.Bounds(0.0)}}
    same = dvi.fit(MODEL, data, START, bounds=wide)
    np.testing.assert_allclose(same.x, inside.x, atol=1e-7)
    np.testing.assert_allclose(same.covariance, inside.covariance, rtol=1e-3)
    assert same.at_bounds == []
    tight = {"epsilon": dvi.Bounds(upper=0.01)}
    held = dvi.fit(MODEL, data, START, bounds=tight, throw=False)
    assert 0.00999 < held.x[1] <= 0.01
    assert held.at_bounds == ["epsilon"]
    assert "its bound: no symmetric error" in str(held)
    for bounds in (dvi.Bounds(0.0), dvi.Bounds(0.0, 1.0)):  # a start next to a bound
        near = dvi.fit(MODEL, data, {**START, "epsilon": 1e-6}, bounds={"epsilon": bounds})
        assert np.abs((near.x - inside.x) / inside.sigma).max() < 0.01
        assert near.at_bounds == []
    data = observed(np.asarray(states_at(REGULAR).qs), sigma=1e-7)

    def model(params):
        return named({"e": 1e4 * params["small"], "k": 1.3})

    found = dvi.fit(model, data, {"small": 1e-6}, bounds={"small": dvi.Bounds(0.0)})
    np.testing.assert_allclose(found.x, 2e-6, rtol=1e-4)
    assert found.at_bounds == []


def test_parameters_at_their_bounds():
    """Far beyond the bound dx/du vanishes, and no covariance is found."""
    model, bounds = model_of(q0=[1.0], epsilon=0.02), {"args": {"k": dvi.Bounds(0.0, 1.0)}}
    found = dvi.fit(model, seen(4), {"args": {"k": 0.8}}, bounds=bounds, **UNCHECKED)
    assert found.at_bounds == ["args.k"]
    assert found.undetermined == []
    assert "args.k  1 at its bound: no symmetric error" in str(found)
    for words in ("nan", "not determined", "no errors"):
        assert words not in str(found)
    space, _ = make_space([0.5] * 3, [dvi.Bounds(0.0, 1.0)] * 3)
    x, sigma = np.array([0.5, 1e-170, 1 - 1e-16]), np.array([np.inf, np.nan, np.nan])
    assert space.at_bounds(x, sigma) == ["[1]", "[2]"]


@pytest.mark.parametrize(("lower", "upper"), [(1.1, 2.0), (-2.0, -1.1), (0.0, 1e-300), (-3.0, 0.0)])
def test_numbers_stay_strictly_between_their_bounds(lower, upper):
    for bounds in (dvi.Bounds(lower), dvi.Bounds(None, upper), dvi.Bounds(lower, upper)):
        space, _ = make_space([(lower + upper) / 2] * 2, [bounds] * 2)
        x = np.asarray(space.to_x(jnp.array([-800.0, 800.0])))
        assert ((x > space.lower) & (x < space.upper) | ~np.isfinite(x)).all()
        make_space(list(x[np.isfinite(x)]), [bounds] * int(np.isfinite(x).sum()))  # as a start


def test_a_prior_has_the_weight_of_a_measurement(regular):
    data, free = regular
    mean = float(free.x[0] + 2 * free.sigma[0])
    prior = {"args": {"k": dvi.Prior(mean, float(free.sigma[0]))}}
    both = dvi.fit(MODEL, data, START, priors=prior)
    # Half way, with √½ of the error: exact up to the curvature over one standard error.
    np.testing.assert_allclose((both.x[0] - free.x[0]) / free.sigma[0], 1.0, rtol=0.02)
    np.testing.assert_allclose(both.sigma[0], free.sigma[0] / np.sqrt(2), rtol=0.02)
    assert both.degrees_of_freedom == free.degrees_of_freedom + 1


@pytest.mark.slow
def test_outliers_have_less_influence_on_a_robust_loss():
    y = noisy(REGULAR, 7)
    y[[5, 20, 21, 40]] += 1.0
    least, soft, cauchy = (
        abs(dvi.fit(MODEL, observed(y), START, loss=loss, throw=False).x[1] - 0.02)
        for loss in (dvi.LeastSquares(), dvi.SoftL1(), dvi.Cauchy())
    )
    assert soft < least / 2
    assert cauchy < least / 4


@pytest.mark.parametrize("loss", [dvi.SoftL1(2.0), dvi.Cauchy(2.0)])
def test_robust_losses_are_those_of_their_definition(loss):
    r = jnp.array([0.0, 1e-9, 1e-4, 0.1, 1.0, 30.0])
    k, s = loss.scale, (np.asarray(r) / loss.scale) ** 2
    is_soft = isinstance(loss, dvi.SoftL1)
    rho = 2 * k**2 * (np.sqrt(1 + s) - 1) if is_soft else k**2 * np.log1p(s)
    np.testing.assert_allclose(np.asarray(loss.root(r)) ** 2, rho, rtol=1e-7, atol=1e-15)
    slope = jax.vmap(jax.grad(loss.root))(r)
    assert np.isfinite(slope).all()
    assert abs(float(slope[0]) - 1) < 1e-12


def density(predicted, observed, sigma, params):
    """Normal errors of a size that may be fitted."""
    log_noise = params.get("log_noise", jnp.log(NOISE))
    return ((predicted - observed) / jnp.exp(log_noise)) ** 2 / 2 + log_noise


@pytest.mark.slow
def test_likelihoods():
    """The maximum and its Hessian are known in closed form."""
    data, start = observed(noisy(REGULAR, 8), sigma=None), {"e": 0.01, "k": 1.29}
    given = {"loss": dvi.Likelihood(density), "tolerance": 1e-3}
    found = dvi.fit(named, data, {**start, "log_noise": -3.0}, **given)
    least = dvi.fit(named, data, start)
    np.testing.assert_allclose(found.x[:2], least.x, atol=1e-6)
    rms = np.sqrt(np.mean(least.residuals[0] ** 2))
    np.testing.assert_allclose(np.exp(found.x[2]), rms, rtol=1e-4)
    np.testing.assert_allclose(found.sigma[2], 1 / np.sqrt(2 * 60), rtol=1e-3)
    y, start = noisy(REGULAR, 8), {"e": 0.01, "k": 1.29, "idle": 0.0}
    priors = {"k": dvi.Prior(1.3, 1e-4)}
    options = {"loss": dvi.Likelihood(density), "priors": priors}
    found = dvi.fit(named, observed(y, sigma=None), start, **options)
    least = dvi.fit(named, observed(y), start, priors=priors)
    np.testing.assert_allclose(found.x[[0, 2]], least.x[[0, 2]], atol=1e-5)
    np.testing.assert_allclose(found.sigma[[0, 2]], least.sigma[[0, 2]], rtol=1e-2)
    assert found.names[1] == "idle"
    assert np.isinf(found.sigma[1])
    np.testing.assert_allclose(found.loss - 60 * np.log(NOISE), least.loss, rtol=1e-6)


@pytest.mark.slow
def test_arcs_of_different_lengths_share_parameters():
    rng = np.random.default_rng(9)
    starts, arcs = rng.uniform(0.5, 1.5, (3, 1)), []
    for i, n in enumerate((12, 60, 9)):
        ts = np.sort(rng.uniform(0, 0.5 * n, n))
        y = np.asarray(states_at(ts, q0=starts[i]).qs) + NOISE * rng.normal(size=(n, 1))
        arcs.append(dvi.Observations(ts + 100 * i, y, sigma=NOISE, t0=100.0 * i))
    found = dvi.fit(model_of(p0=np.zeros((3, 1))), arcs, {**START, "q0": np.ones((3, 1))})
    assert found.names[2:4] == ["q0[0, 0]", "q0[1, 0]"]
    assert off(found, np.concatenate([[1.3, 0.02], starts[:, 0]])) < 3.5
    assert [len(t) for t in found.ts] == [12, 60, 9]
    alone = dvi.fit(MODEL, arcs[1], {**START, "q0": np.ones(1)})
    assert (found.sigma[:2] < alone.sigma[:2]).all()


@pytest.mark.slow
@pytest.mark.parametrize("observe", ["momenta", "state", "energy", "positions before t0"])
def test_observables(observe):
    def energy(t, q, p, args):
        return p[0] ** 2 / 2 + args["k"] * q[0] ** 2 / 2

    ts, h, of = REGULAR, STEP, observe.partition(" ")[0]
    if observe == "positions before t0":
        ts, h = -REGULAR, -STEP
    sol = states_at(ts, h=h)
    q, p = np.asarray(sol.qs), np.asarray(sol.ps)
    values = {
        "positions": q, "momenta": p, "state": np.concatenate([q, p], 1),
        "energy": p[:, 0] ** 2 / 2 + 1.3 * q[:, 0] ** 2 / 2,
    }[of]  # fmt: skip
    data = observed(values, ts, observe=energy if of == "energy" else of)
    np.testing.assert_allclose(dvi.fit(model_of(h=h), data, START).x, TRUTH, atol=1e-6)


def test_rows_of_results_and_of_arcs(regular):
    """Newest first: the same parameters, and rows of the result that belong to the given times."""
    data, known = regular
    found = dvi.fit(MODEL, observed(data.values[::-1], REGULAR[::-1]), START)
    np.testing.assert_array_equal(found.x, known.x)
    for name in ("ts", "observed", "predicted", "whitened", "errors", "residuals"):
        of_one, of_other = getattr(found, name)[0], getattr(known, name)[0]
        np.testing.assert_array_equal(of_one, of_other[::-1])
    for rows in (2, 4):
        model = model_of(q0=np.ones((rows, 1)), p0=np.zeros((3, 1)))
        with pytest.raises(ValueError, match="one row for each arc"):
            dvi.fit(model, [regular[0]] * 3, {"epsilon": 0.0, "args": {"k": 1.3}})
    masked = np.ma.masked_array(regular[0].values, np.arange(60)[:, None] == 5)
    values = dvi.Observations(REGULAR, masked).values
    assert np.isnan(values[5, 0])
    assert np.isfinite(np.delete(values, 5)).all()


class Drag(eqx.Module):
    """A force with a size that is not a parameter."""

    size: int
    weight: jax.Array

    def __call__(self, t0, t1, q0, p1, args):
        return sum(-self.weight * p1 for _ in range(self.size))


@pytest.mark.slow
def test_sizes_in_a_module_are_not_fitted():
    def model(force):
        known = MODEL({"q0": [1.0], "epsilon": 1.0, "args": {"k": 1.3}})
        return known | {"system": dvi.System(H, force=force)}

    bounds = Drag(None, dvi.Bounds(-1.0, 1.0))
    found = dvi.fit(model, seen(1), Drag(2, jnp.array(0.0)), bounds=bounds, **UNCHECKED)
    assert found.names == ["weight"]
    np.testing.assert_allclose(found.x, 0.01, atol=1e-3)


def test_horizons_lead_to_the_minimum_that_all_data_miss():
    """A start that is wrong by several periods at the end of the arc."""
    data = seen(10)
    led = dvi.fit(MODEL, data, FAR)
    assert off(led) < 3.5
    assert led.history["horizon"][0] < 30
    assert led.history["horizon"][-1] == np.inf
    misled = dvi.fit(MODEL, data, FAR, horizons=None, throw=False)
    assert misled.loss > 10 * led.loss
    given = dvi.fit(MODEL, data, FAR, horizons=[2.0, 8.0])
    np.testing.assert_allclose(given.x, led.x, atol=1e-6)
    assert sorted(set(given.history["horizon"])) == [2.0, 8.0, np.inf]
    # A piece that has converged is not the whole.
    for steps in range(4, 9):
        options = {"horizons": [2.0, 8.0], "max_steps": steps, "throw": False, **UNCHECKED}
        cut = dvi.fit(MODEL, data, FAR, **options)
        assert cut.history["horizon"][-1] == np.inf or cut.status == "max_steps_reached"
        assert cut.sigma[0] < 2e-3  # of all the data


OPTIMISERS = {
    "dogleg": optx.Dogleg(rtol=1e-12, atol=1e-12),
    "gauss-newton": optx.GaussNewton(rtol=1e-12, atol=1e-12),
    "bfgs": optx.BFGS(rtol=1e-9, atol=1e-9),
    "adam": optax.adam(0.01),
}


@pytest.mark.parametrize("name", OPTIMISERS)
@pytest.mark.slow
def test_other_optimisers_find_the_same(regular, name):
    data, found = regular
    is_optax, options = name == "adam", {"optimiser": OPTIMISERS[name], "tolerance": 1e-4}
    start, steps = (found.params, 300) if is_optax else (START, None)
    other = dvi.fit(MODEL, data, start, max_steps=steps, **options)
    assert other.status == ("steps_done" if is_optax else "converged")
    assert np.abs((other.x - found.x) / found.sigma).max() < (0.5 if is_optax else 0.01)


@pytest.mark.slow
def test_batches_draw_arcs():
    q0 = np.array([[0.6], [0.8], [1.0], [1.2]])
    arcs = [seen(20 + i, q0=q) for i, q in enumerate(q0)]
    model, start = model_of(q0=q0, p0=np.zeros((4, 1))), {"epsilon": 0.0, "args": {"k": 1.29}}
    options = {"optimiser": optax.adam(2e-3), "max_steps": 200, "batch": 2}
    found, again = (dvi.fit(model, arcs, start, **options) for _ in range(2))
    other = dvi.fit(model, arcs, start, **options, seed=1)
    np.testing.assert_allclose(found.x, [1.3, 0.02], atol=5e-3)
    np.testing.assert_array_equal(found.history["x"], again.history["x"])
    assert not np.array_equal(found.history["loss"], other.history["loss"])


@pytest.mark.slow
def test_difficult_ways_to_the_minimum():
    small = 1e-5

    def model(params):
        known = MODEL({"q0": (params["a"] + params["b"])[None], "epsilon": 0.02, **K})
        return known | {"p0": small * params["b"][None]}

    K = {"args": {"k": 1.3}}
    y = np.asarray(states_at(REGULAR, p0=[small]).qs)
    y = y + small * NOISE * np.random.default_rng(0).normal(size=y.shape)
    found = dvi.fit(model, observed(y, sigma=small * NOISE), {"a": 0.9, "b": -0.5}, **UNCHECKED)
    assert found.status == "converged"
    assert off(found, [0.0, 1.0]) < 4
    # A trial step that leaves the region where the model has an answer is taken back.

    def well(t0, t1, q0, p1, args):
        return jnp.sum(p1**2) / 2 + jnp.sum(jnp.sqrt(args["k"]) * q0**2)

    model = model_of(dvi.System(well), q0=[1.0])
    found = dvi.fit(model, seen(13), {"args": {"k": 3.0}}, horizons=[1.0], throw=False)
    assert np.isfinite(found.x).all()
    np.testing.assert_allclose(np.sqrt(found.x[0]) * 2, 1.3, rtol=0.02)


def test_too_few_steps_raise_with_the_result(regular):
    data, _ = regular
    with pytest.raises(dvi.FitError, match="status: max_steps_reached, steps: 2") as error:
        dvi.fit(MODEL, data, START, max_steps=2)
    kept = error.value.fit
    assert len(kept.history["loss"]) == 2
    assert kept.loss < kept.history["loss"][0] * 1.0001
    quiet = dvi.fit(MODEL, data, START, max_steps=2, throw=False)
    assert quiet.result == dvi.FIT_RESULTS.max_steps_reached


def test_one_compilation_for_many_fits_and_progress(regular):
    data, found = regular
    shown, programs = [], problems._evaluate._cached._cache_size
    before = programs()
    dvi.fit(MODEL, data, START, progress=shown.append)
    for seed in (30, 31):
        dvi.fit(model_of(p0=[0.1 * seed - 3]), seen(seed), START, throw=False)
    assert programs() == before
    assert [p.step for p in shown] == list(range(1, len(found.history["loss"]) + 1))
    np.testing.assert_array_equal([p.loss for p in shown], found.history["loss"])
    assert shown[-1].names == found.names
    assert shown[-1].seconds > 0


def test_saved_and_loaded(regular, tmp_path):
    _, found = regular
    found.save(tmp_path / "fit.npz")
    loaded = dvi.FitResult.load(tmp_path / "fit.npz")
    assert jax.tree.structure(loaded.params) == jax.tree.structure(found.params)
    for name in ("x", "covariance", "singular_values", "curvature"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(found, name))
    for name in ("ts", "observed", "predicted", "whitened"):
        np.testing.assert_array_equal(getattr(loaded, name)[0], getattr(found, name)[0])
    np.testing.assert_array_equal(loaded.history["x"], found.history["x"])
    assert loaded.status == "converged"
    assert str(loaded) == str(found)
    with pytest.raises(ValueError, match="must have the same parameters as the fit"):
        dvi.FitResult.load(tmp_path / "fit.npz", {"other": 1.0})
    with pytest.raises(FileNotFoundError, match="no directory"):
        found.save(tmp_path / "nowhere" / "fit.npz")
    (tmp_path / "bad.npz").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="damaged, or not the file of a fit"):
        dvi.FitResult.load(tmp_path / "bad.npz")


class Interrupted(Exception):
    pass


def interrupt(stop):
    """A progress function that ends the fit at a step."""

    def progress(p):
        if p.step == stop:
            raise Interrupted

    return progress


KINDS = {
    "least squares": {},
    "adam": {"optimiser": optax.adam(1e-3), "max_steps": 40},
    "segments": {"shooting": dvi.MultipleShooting(4)},
}


@pytest.mark.parametrize(
    "kind", ["least squares", *(pytest.param(k, marks=pytest.mark.slow) for k in list(KINDS)[1:])]
)
def test_resumed_with_the_same_bits(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "_INTERVAL", 0.0)
    data, options, start = seen(11), KINDS[kind], {**START, "args": {"k": 0.9}}
    whole = dvi.fit(MODEL, data, start, **options)
    file, steps = tmp_path / "fit.npz", len(whole.history["loss"])
    assert steps > 6
    for stop in range(1, steps + 1):  # the last of each stage among them
        with pytest.raises(Interrupted):
            dvi.fit(MODEL, data, start, **options, checkpoint=file, progress=interrupt(stop))
        assert file.exists()
    again = dvi.fit(MODEL, data, start, **options, checkpoint=file)
    assert not file.exists()
    for name in ("x", "loss", "stage", "accepted"):
        np.testing.assert_array_equal(again.history[name], whole.history[name])
    np.testing.assert_array_equal(again.x, whole.x)
    np.testing.assert_array_equal(again.covariance, whole.covariance)


def test_a_checkpoint_of_another_fit_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "_INTERVAL", 0.0)
    data, file = seen(11), tmp_path / "fit.npz"
    with pytest.raises(Interrupted):
        dvi.fit(MODEL, data, START, checkpoint=file, progress=interrupt(1))
    other = model_of(
        dvi.System(lambda t0, t1, q0, p1, args: H(t0, t1, q0, p1, args) + jnp.sum(q0**4), force=W)
    )
    for change in (
        {"loss": dvi.Cauchy()},
        {"priors": {"epsilon": dvi.Prior(0.5, 1e-3)}},
        {"tolerance": 1e-3},
        {"model": model_of(p0=[0.5])},
        {"data": seen(12)},
        {"model": other},
    ):
        what = "models" if change.get("model") is other else "settings"
        with pytest.raises(ValueError, match=f"another fit: .*{what}"):
            dvi.fit(**{"model": MODEL, "data": data, "params": START, **change}, checkpoint=file)
    assert file.exists()
    with pytest.raises(FileNotFoundError, match="no directory"):
        dvi.fit(MODEL, data, START, checkpoint=tmp_path / "nowhere" / "fit.npz")


def test_more_steps_continue_from_the_checkpoint(regular, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "_INTERVAL", 0.0)
    data, found = regular
    file = tmp_path / "fit.npz"
    with pytest.raises(dvi.FitError):
        dvi.fit(MODEL, data, START, max_steps=3, checkpoint=file)
    assert file.exists()
    more = dvi.fit(MODEL, data, START, checkpoint=file)
    assert not file.exists()
    np.testing.assert_array_equal(more.history["x"], found.history["x"])


GUESSES = {
    "data": None,
    "model": "model",  # segments that meet from the first step on must not fix the parameters
    "function": lambda t: ([np.cos(1.14 * t)], [-1.14 * np.sin(1.14 * t)]),
}


@pytest.mark.slow
@pytest.mark.parametrize("guess", GUESSES)
def test_multiple_shooting_agrees_with_single(regular, guess):
    data, found = regular
    shooting = dvi.MultipleShooting(6, guess=GUESSES[guess])
    apart = dvi.fit(MODEL, data, START, shooting=shooting)
    assert np.abs((apart.x - found.x) / found.sigma).max() < (1e-3 if guess == "data" else 1e-2)
    np.testing.assert_allclose(apart.covariance, found.covariance, rtol=1e-3)
    assert apart.trajectories == ["successful"]


def test_invalid_multiple_shooting():
    energy = observed(np.ones(60), sigma=1.0, observe=lambda t, q, p, a: q[0] ** 2)
    with pytest.raises(ValueError, match='observe="positions" or observe="state"'):
        dvi.fit(MODEL, energy, START, shooting=dvi.MultipleShooting(6, guess="data"))
    with pytest.raises(ValueError, match="segments must be an integer of at least 2"):
        dvi.MultipleShooting(1)


@pytest.mark.slow
def test_multiple_shooting_of_a_chaotic_orbit():
    """Over some twenty of its e-folding times, from a poor start, where single shooting fails."""

    def henon_heiles(t0, t1, q0, p1, args):
        cubic = q0[0] ** 2 * q0[1] - q0[1] ** 3 / 3
        return (p1 @ p1 + q0 @ q0) / 2 + args["lam"] * cubic

    system, q0, p0 = dvi.System(henon_heiles), np.array([0.0, -0.25]), np.array([0.42, 0.0])
    options = {"h": 0.1, "method": dvi.Strang()}
    about = {"num_steps": 2000, "args": {"lam": 1.0}, "save": dvi.Save(every=5), **options}
    sol = dvi.integrate(system, q0, p0, **about)
    y = np.concatenate([sol.qs, sol.ps], 1)[1:]
    y = y + 1e-3 * np.random.default_rng(0).normal(size=y.shape)
    ts, model = np.arange(0.5, 200.5, 0.5), dvi.Model(system, **options)
    start = {"q0": q0 + 0.05, "p0": p0 - 0.05, "args": {"lam": 0.8}}
    data = observed(y, ts, 1e-3, observe="state")
    found = dvi.fit(model, data, start, shooting=dvi.MultipleShooting(25))
    truth = np.concatenate([[1.0], p0, q0])
    assert off(found, truth) < 3.5
    assert 0.85 < found.reduced_chi2 < 1.15
    lost = dvi.fit(model, data, start, horizons=None, throw=False)
    assert lost.reduced_chi2 > 10 * found.reduced_chi2
    positions = observed(y[:, :2], ts, 1e-3)
    only = dvi.fit(model, positions, start, shooting=dvi.MultipleShooting(25))
    assert off(only, truth) < 3.5
