"""Fits: what they find, what they say of its errors, how they go on."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest

import dvi_jax as dvi
from dvi_jax.fit import run
from dvi_jax.fit.observations import as_arcs
from dvi_jax.fit.parameters import make_space
from dvi_jax.fit.problem import Problem
from dvi_jax.fit.uncertainty import correlations, null_space, uncertainty


def H(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 + args["k"] * jnp.sum(q0**2) / 2


def W(t0, t1, q0, p1, args):
    return -p1


SYSTEM = dvi.System(H, force=W)
STRANG = dvi.Strang()
H_STEP = 0.05
TRUE = {"epsilon": 0.02, "args": {"k": 1.3}, "q0": np.array([1.0])}
START = {"epsilon": 0.0, "args": {"k": 1.2}, "q0": np.array([0.9])}
MODEL = dvi.Model(SYSTEM, h=H_STEP, p0=[0.0], args={"k": 1.0}, method=STRANG)
REGULAR = np.arange(1, 61) * 0.5
IRREGULAR = np.sort(np.random.default_rng(5).uniform(0, 30, 60))
NOISE = 0.01


def states_at(ts, **of):
    """Positions of the true system at times, by `Save(ts=...)`, which fits do not use."""
    given = {"q0": TRUE["q0"], "p0": [0.0], "epsilon": 0.02, "args": {"k": 1.3}, **of}
    steps = int(np.ceil(ts[-1] / H_STEP))
    return dvi.integrate(
        SYSTEM, given["q0"], given["p0"], h=H_STEP, num_steps=steps, epsilon=given["epsilon"],
        args=given["args"], method=STRANG, save=dvi.Save(ts=ts),
    )  # fmt: skip


def noisy(ts, seed, **of):
    y = np.asarray(states_at(ts, **of).qs)
    return y + NOISE * np.random.default_rng(seed).normal(size=y.shape)


@pytest.fixture(scope="module")
def regular():
    data = dvi.Observations(REGULAR, noisy(REGULAR, 1), sigma=NOISE, t0=0.0)
    return data, dvi.fit(MODEL, data, START)


def problem_of(data, params=START, model=MODEL, **options):
    arcs, many = as_arcs(data)
    made = Problem(model, arcs, many, params, **options)
    return made, made.space.to_u(made.start)


def test_the_truth_is_found(regular):
    data, found = regular
    assert found.status == "converged"
    assert found.names == ["args.k", "epsilon", "q0[0]"]
    off = (found.x - [1.3, 0.02, 1.0]) / found.sigma
    assert np.abs(off).max() < 3
    assert (found.sigma < [1e-3, 2e-3, 1e-2]).all()
    assert float(found.params["epsilon"]) == found.x[1]
    assert 0.5 < found.reduced_chi2 < 1.6
    assert abs(found.statistics()["lag_one"]) < 0.4
    assert "args.k" in str(found)
    assert "±" in str(found)
    np.testing.assert_allclose(found.predicted[0] + found.residuals[0], data.values, atol=1e-14)


@pytest.mark.slow
def test_what_is_predicted_between_lattice_points_is_of_the_method(regular):
    """The same as `Save(ts=...)` to the order of the method, and not to a lower one."""
    errors = []
    for h in (0.05, 0.025):
        model = dvi.Model(SYSTEM, h=h, p0=[0.0], method=STRANG)
        data = dvi.Observations(IRREGULAR, np.zeros((60, 1)), sigma=1.0, t0=0.0)
        problem, u = problem_of(data, {**TRUE}, model)
        (found, _), = problem.whitened(u)[1]  # fmt: skip
        omega, gamma = np.sqrt(1.3 - 0.01**2), 0.01
        exact = np.exp(-gamma * IRREGULAR) * (
            np.cos(omega * IRREGULAR) + gamma / omega * np.sin(omega * IRREGULAR)
        )
        errors.append(np.abs(np.asarray(found)[0, :, 0] - exact).max())
    assert errors[0] < 5e-3
    assert 3.4 < errors[0] / errors[1] < 4.6


@pytest.mark.slow
def test_lattice_points_are_picked():
    problem, u = problem_of(dvi.Observations(REGULAR, np.zeros((60, 1)), sigma=1.0, t0=0.0), TRUE)
    assert problem.groups[0].block == 10
    (found, _), = problem.whitened(u)[1]  # fmt: skip
    steps = dvi.integrate(
        SYSTEM, TRUE["q0"], [0.0], h=H_STEP, num_steps=600, epsilon=0.02, args={"k": 1.3},
        method=STRANG, save=dvi.Save(every=10),
    )  # fmt: skip
    np.testing.assert_allclose(np.asarray(found)[0], np.asarray(steps.qs)[1:], atol=1e-13)


@pytest.mark.parametrize("ts", [REGULAR, IRREGULAR], ids=["regular", "irregular"])
@pytest.mark.slow
def test_jacobian_against_differences(ts):
    problem, u = problem_of(dvi.Observations(ts, np.zeros((60, 1)), sigma=1.0, t0=0.0))
    J = np.asarray(problem.evaluate(u).jacobian)
    for i in range(problem.size):
        # Differences of fourth order at 1e-3: truncation 1e-12 of it, rounding 1e-13.
        step = 1e-3 * np.eye(problem.size)[i]
        r = [np.asarray(problem.evaluate(u + k * step).residual) for k in (-2, -1, 1, 2)]
        differences = (r[0] - 8 * r[1] + 8 * r[2] - r[3]) / 12e-3
        assert np.abs(J[:, i] - differences).max() < 1e-8 * np.abs(J[:, i]).max()
    wrong = problem.evaluate(u + 1e-5).jacobian
    assert np.abs(wrong - J).max() > 1e-8 * np.abs(J).max()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ts", "adjoints"),
    [
        (REGULAR, (dvi.Reversible(), dvi.Checkpointed(), dvi.Direct())),
        (IRREGULAR, (dvi.Reversible(),)),
    ],
    ids=["regular", "irregular"],
)
def test_adjoints_agree(ts, adjoints):
    """Reverse mode by each adjoint against the Jacobian by forward mode."""
    data = dvi.Observations(ts, np.cos(ts)[:, None], sigma=1.0, t0=0.0)
    problem, u = problem_of(data)
    r, J, _ = problem.evaluate(u)
    forward = np.asarray(J).T @ np.asarray(r)
    for adjoint in adjoints:
        model = dvi.Model(SYSTEM, h=H_STEP, p0=[0.0], method=STRANG, adjoint=adjoint)
        problem, _ = problem_of(data, model=model)
        backward = np.asarray(jax.jit(jax.grad(problem.core.scalar))(jnp.asarray(u)))
        np.testing.assert_allclose(backward, forward, rtol=1e-8, atol=1e-8 * np.abs(forward).max())


@pytest.mark.slow
def test_covariance_is_the_inverse_of_the_exact_hessian_at_a_perfect_fit():
    exact = np.asarray(states_at(REGULAR).qs)
    data = dvi.Observations(REGULAR, exact, sigma=NOISE, t0=0.0)
    found = dvi.fit(MODEL, data, START)
    np.testing.assert_allclose(found.x, [1.3, 0.02, 1.0], atol=1e-9)
    problem, _ = problem_of(data, found.params)
    H_exact = np.asarray(problem.hessian(found.x))
    np.testing.assert_allclose(np.linalg.inv(H_exact), found.covariance, rtol=1e-6)
    np.testing.assert_allclose(found.curvature, 1.0, atol=1e-6)


def test_curvature_tells_a_bent_valley():
    """Far from the data's model the exact curvature is not Gauss–Newton's."""
    bent = noisy(REGULAR, 2) + 0.5 * np.sign(np.sin(1.14 * REGULAR))[:, None]
    found = dvi.fit(MODEL, dvi.Observations(REGULAR, bent, sigma=NOISE, t0=0.0), START)
    assert np.abs(found.curvature - 1).max() > 0.02


def test_errors_found_from_the_residuals():
    y = noisy(REGULAR, 3)
    known = dvi.fit(MODEL, dvi.Observations(REGULAR, y, sigma=NOISE, t0=0.0), START)
    unknown = dvi.fit(MODEL, dvi.Observations(REGULAR, y, t0=0.0), START)
    np.testing.assert_allclose(unknown.x, known.x, atol=1e-6)
    spread = np.sqrt(known.reduced_chi2)
    np.testing.assert_allclose(unknown.sigma, known.sigma * spread, rtol=1e-5)


@pytest.mark.slow
def test_a_direction_that_is_not_determined_is_named():
    def model(params):
        return MODEL({"epsilon": params["a"] + 2 * params["b"], "q0": params["q0"]}) | {
            "args": {"k": 1.3}
        }

    data = dvi.Observations(REGULAR, noisy(REGULAR, 4), sigma=NOISE, t0=0.0)
    found = dvi.fit(model, data, {"a": 0.0, "b": 0.0, "q0": np.array([0.95]), "c": 1.0})
    assert found.status == "converged"
    assert len(found.undetermined) == 2
    words = " | ".join(found.undetermined)
    assert "a" in words
    assert "b" in words
    assert "1.00 c" in words
    named = dict(zip(found.names, found.sigma, strict=True))
    assert np.isinf([named["a"], named["b"], named["c"]]).all()
    assert named["q0[0]"] < 0.01
    assert np.isnan(found.correlations[0, 1])
    assert "not determined" in str(found)


@pytest.mark.slow
def test_bounds_hold_and_are_named():
    data = dvi.Observations(REGULAR, noisy(REGULAR, 4), sigma=NOISE, t0=0.0)
    inside = dvi.fit(MODEL, data, START)
    wide = {"epsilon": dvi.Bounds(-1, 1), "args": {"k": dvi.Bounds(0.0)}}
    same = dvi.fit(MODEL, data, START, bounds=wide)
    np.testing.assert_allclose(same.x, inside.x, atol=1e-7)
    np.testing.assert_allclose(same.covariance, inside.covariance, rtol=1e-3)
    assert same.at_bounds == []
    tight = {"epsilon": dvi.Bounds(upper=0.01)}
    held = dvi.fit(MODEL, data, START, bounds=tight, throw=False)
    assert held.x[1] <= 0.01
    assert held.x[1] > 0.00999
    assert held.at_bounds == ["epsilon"]
    assert "its bound: no symmetric error" in str(held)


def test_a_parameter_at_its_bound_is_neither_undetermined_nor_of_unknown_error():
    """Far beyond the bound dx/du vanishes, and no covariance is found."""
    data = dvi.Observations(REGULAR, noisy(REGULAR, 4), sigma=NOISE, t0=0.0)
    model = dvi.Model(SYSTEM, h=H_STEP, q0=[1.0], p0=[0.0], epsilon=0.02, method=STRANG)
    found = dvi.fit(
        model, data, {"args": {"k": 0.8}}, bounds={"args": {"k": dvi.Bounds(0.0, 1.0)}},
        check_curvature=False,
    )  # fmt: skip
    assert found.at_bounds == ["args.k"]
    assert found.undetermined == []
    assert "args.k  1 at its bound: no symmetric error" in str(found)
    for words in ("nan", "not determined", "no errors"):
        assert words not in str(found)


def test_a_bounded_parameter_without_a_finite_error_is_at_a_bound_only_if_it_is_on_it():
    space, _ = make_space([0.5] * 3, [dvi.Bounds(0.0, 1.0)] * 3)
    x, sigma = np.array([0.5, 1e-170, 1 - 1e-16]), np.array([np.inf, np.nan, np.nan])
    assert space.at_bounds(x, sigma) == ["[1]", "[2]"]


def test_a_model_no_better_than_a_constant_is_reported(regular):
    """A minimum in k far from the true one, from which nothing leads away."""
    data, good = regular
    without = dvi.Observations(REGULAR, data.values, t0=0.0)
    start = {**START, "args": {"k": 9.0}}
    bad = dvi.fit(MODEL, without, start, horizons=None, throw=False)
    assert bad.explained < 0.1
    assert "better than constants do" in str(bad)
    assert 0.99 < good.explained < 1
    assert "constants" not in str(good)


def test_the_explained_variance_is_that_of_its_definition(regular):
    """With errors of each value, a missing one, and a mean for each component."""
    random = np.random.default_rng(0)
    seen, model, errors = random.normal(size=(3, 9, 2))
    seen[4, 1], errors = np.nan, np.abs(errors) + 0.1
    given = {"observed": [seen], "predicted": [model], "errors": [errors]}
    left = total = 0.0
    for k in range(2):
        good = np.isfinite(seen[:, k])
        y, w = seen[good, k], errors[good, k] ** -2.0
        left += np.sum(w * (y - model[good, k]) ** 2)
        total += np.sum(w * (y - np.average(y, weights=w)) ** 2)
    found = dataclasses.replace(regular[1], **given)
    np.testing.assert_allclose(found.explained, 1 - left / total, rtol=1e-12)


def test_a_prior_weighs_as_a_measurement():
    data = dvi.Observations(REGULAR, noisy(REGULAR, 6), sigma=NOISE, t0=0.0)
    free = dvi.fit(MODEL, data, START)
    mean = float(free.x[0] + 2 * free.sigma[0])
    prior = {"args": {"k": dvi.Prior(mean, float(free.sigma[0]))}}
    both = dvi.fit(MODEL, data, START, priors=prior)
    # Half way, with √½ of the error: exact up to the bend over one standard error.
    np.testing.assert_allclose((both.x[0] - free.x[0]) / free.sigma[0], 1.0, rtol=0.02)
    np.testing.assert_allclose(both.sigma[0], free.sigma[0] / np.sqrt(2), rtol=0.02)
    assert both.degrees_of_freedom == free.degrees_of_freedom + 1


@pytest.mark.slow
def test_outliers_pull_a_robust_loss_less():
    y = noisy(REGULAR, 7)
    y[[5, 20, 21, 40]] += 1.0
    data = dvi.Observations(REGULAR, y, sigma=NOISE, t0=0.0)
    off = {}
    for loss in (dvi.LeastSquares(), dvi.SoftL1(), dvi.Cauchy()):
        found = dvi.fit(MODEL, data, START, loss=loss, throw=False)
        off[type(loss).__name__] = np.abs(found.x - [1.3, 0.02, 1.0])[1]
    assert off["SoftL1"] < off["LeastSquares"] / 2
    assert off["Cauchy"] < off["LeastSquares"] / 4


@pytest.mark.parametrize("loss", [dvi.SoftL1(2.0), dvi.Cauchy(2.0)])
def test_robust_losses_are_what_they_say(loss):
    r = np.array([0.0, 1e-9, 1e-4, 0.1, 1.0, 30.0])
    k, s = loss.scale, (r / loss.scale) ** 2
    small = isinstance(loss, dvi.SoftL1)
    rho = 2 * k**2 * (np.sqrt(1 + s) - 1) if small else k**2 * np.log1p(s)
    np.testing.assert_allclose(
        np.asarray(loss.root(jnp.asarray(r))) ** 2, rho, rtol=1e-7, atol=1e-15
    )
    slope = jax.vmap(jax.grad(loss.root))(jnp.asarray(r))
    assert np.isfinite(slope).all()
    assert abs(float(slope[0]) - 1) < 1e-12


@pytest.mark.slow
def test_a_likelihood_with_an_unknown_noise_level():
    """Normal errors of fitted size: the maximum and its Hessian are known in closed form."""

    def density(predicted, observed, sigma, params):
        size = jnp.exp(params["log_noise"])
        return ((predicted - observed) / size) ** 2 / 2 + params["log_noise"]

    def model(params):
        return MODEL({"epsilon": params["epsilon"], "q0": [1.0], "args": {"k": params["k"]}})

    data = dvi.Observations(REGULAR, noisy(REGULAR, 8), t0=0.0)
    start = {"epsilon": 0.01, "k": 1.29, "log_noise": -3.0}
    found = dvi.fit(model, data, start, loss=dvi.Likelihood(density), tolerance=1e-3)
    least = dvi.fit(model, data, {"epsilon": 0.01, "k": 1.29})
    np.testing.assert_allclose(found.x[:2], least.x, atol=1e-6)
    rms = np.sqrt(np.mean(least.residuals[0] ** 2))
    np.testing.assert_allclose(np.exp(found.x[2]), rms, rtol=1e-4)
    np.testing.assert_allclose(found.sigma[2], 1 / np.sqrt(2 * 60), rtol=1e-3)


@pytest.mark.slow
def test_arcs_of_unlike_length_share_parameters():
    rng = np.random.default_rng(9)
    starts, arcs = rng.uniform(0.5, 1.5, (3, 1)), []
    for i, n in enumerate((12, 60, 9)):
        ts = np.sort(rng.uniform(0, 0.5 * n, n))
        y = np.asarray(states_at(ts, q0=starts[i]).qs) + NOISE * rng.normal(size=(n, 1))
        arcs.append(dvi.Observations(ts + 100 * i, y, sigma=NOISE, t0=100.0 * i))
    model = dvi.Model(SYSTEM, h=H_STEP, p0=np.zeros((3, 1)), method=STRANG)
    found = dvi.fit(model, arcs, {**START, "q0": np.ones((3, 1))})
    assert found.names[2:4] == ["q0[0, 0]", "q0[1, 0]"]
    off = (found.x - np.concatenate([[1.3, 0.02], starts[:, 0]])) / found.sigma
    assert np.abs(off).max() < 3.5
    assert [len(t) for t in found.ts] == [12, 60, 9]
    alone = dvi.fit(
        dvi.Model(SYSTEM, h=H_STEP, p0=[0.0], method=STRANG), arcs[1], {**START, "q0": np.ones(1)}
    )
    assert (found.sigma[:2] < alone.sigma[:2]).all()


@pytest.mark.slow
def test_momenta_states_and_functions_are_observed():
    sol = states_at(REGULAR)
    both = np.concatenate([sol.qs, sol.ps], 1)
    energy = np.asarray(sol.ps[:, 0] ** 2 / 2 + 1.3 * sol.qs[:, 0] ** 2 / 2)
    for observe, values in (
        ("momenta", np.asarray(sol.ps)),
        ("state", both),
        (lambda t, q, p, args: p[0] ** 2 / 2 + args["k"] * q[0] ** 2 / 2, energy),
    ):
        data = dvi.Observations(REGULAR, values, observe, sigma=NOISE, t0=0.0)
        found = dvi.fit(MODEL, data, START)
        np.testing.assert_allclose(found.x, [1.3, 0.02, 1.0], atol=1e-6)


@pytest.mark.slow
def test_backwards_in_time():
    back = -REGULAR
    sol = dvi.integrate(
        SYSTEM, TRUE["q0"], [0.0], h=-H_STEP, num_steps=600, epsilon=0.02, args={"k": 1.3},
        method=STRANG, save=dvi.Save(ts=back),
    )  # fmt: skip
    model = dvi.Model(SYSTEM, h=-H_STEP, p0=[0.0], method=STRANG)
    data = dvi.Observations(back, np.asarray(sol.qs), sigma=NOISE, t0=0.0)
    np.testing.assert_allclose(dvi.fit(model, data, START).x, [1.3, 0.02, 1.0], atol=1e-6)


def test_results_have_the_order_of_the_given_observations(regular):
    """Newest first: the same parameters, and rows of the result that belong to the given times."""
    data, known = regular
    newest_first = dvi.Observations(REGULAR[::-1], data.values[::-1], sigma=NOISE, t0=0.0)
    found = dvi.fit(MODEL, newest_first, START)
    np.testing.assert_array_equal(found.x, known.x)
    for name in ("ts", "observed", "predicted", "whitened", "errors", "residuals"):
        of_one, of_other = getattr(found, name)[0], getattr(known, name)[0]
        np.testing.assert_array_equal(of_one, of_other[::-1])


def test_horizons_lead_where_everything_at_once_misleads():
    """A start that is wrong by several periods at the end of the arc."""
    data = dvi.Observations(REGULAR, noisy(REGULAR, 10), sigma=NOISE, t0=0.0)
    start = {**START, "args": {"k": 0.7}}
    led = dvi.fit(MODEL, data, start)
    assert np.abs((led.x - [1.3, 0.02, 1.0]) / led.sigma).max() < 3.5
    assert led.history["horizon"][0] < 30
    assert led.history["horizon"][-1] == np.inf
    misled = dvi.fit(MODEL, data, start, horizons=None, throw=False)
    assert misled.loss > 10 * led.loss
    given = dvi.fit(MODEL, data, start, horizons=[2.0, 8.0])
    np.testing.assert_allclose(given.x, led.x, atol=1e-6)
    assert sorted(set(given.history["horizon"])) == [2.0, 8.0, np.inf]


@pytest.mark.parametrize(
    "optimiser",
    [
        optx.Dogleg(rtol=1e-12, atol=1e-12),
        optx.GaussNewton(rtol=1e-12, atol=1e-12),
        optx.BFGS(rtol=1e-9, atol=1e-9),
        optax.adam(0.01),
    ],
    ids=["dogleg", "gauss-newton", "bfgs", "adam"],
)
@pytest.mark.slow
def test_other_optimisers_find_the_same(regular, optimiser):
    data, found = regular
    is_optax = isinstance(optimiser, optax.GradientTransformation)
    other = dvi.fit(
        MODEL, data, found.params if is_optax else START, optimiser=optimiser,
        max_steps=300 if is_optax else None, tolerance=1e-4,
    )  # fmt: skip
    assert other.status == ("steps_done" if is_optax else "converged")
    close = 0.5 if is_optax else 0.01
    assert np.abs((other.x - found.x) / found.sigma).max() < close


@pytest.mark.slow
def test_batches_draw_arcs():
    arcs = [
        dvi.Observations(REGULAR, noisy(REGULAR, 20 + i, q0=[q]), sigma=NOISE, t0=0.0)
        for i, q in enumerate((0.6, 0.8, 1.0, 1.2))
    ]
    q0 = np.array([[0.6], [0.8], [1.0], [1.2]])
    model = dvi.Model(SYSTEM, h=H_STEP, q0=q0, p0=np.zeros((4, 1)), method=STRANG)
    start = {"epsilon": 0.0, "args": {"k": 1.29}}
    options = {"optimiser": optax.adam(2e-3), "max_steps": 200, "batch": 2}
    found = dvi.fit(model, arcs, start, **options)
    again = dvi.fit(model, arcs, start, **options)
    other = dvi.fit(model, arcs, start, **options, seed=1)
    np.testing.assert_allclose(found.x, [1.3, 0.02], atol=5e-3)
    np.testing.assert_array_equal(found.history["x"], again.history["x"])
    assert not np.array_equal(found.history["loss"], other.history["loss"])


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
    with pytest.raises(ValueError, match="has the parameters"):
        dvi.FitResult.load(tmp_path / "fit.npz", {"other": 1.0})
    with pytest.raises(FileNotFoundError, match="no directory"):
        found.save(tmp_path / "nowhere" / "fit.npz")
    (tmp_path / "bad.npz").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="is no fit"):
        dvi.FitResult.load(tmp_path / "bad.npz")


class Interrupted(Exception):
    pass


@pytest.mark.parametrize(
    "kind",
    [
        "least squares",
        pytest.param("adam", marks=pytest.mark.slow),
        pytest.param("segments", marks=pytest.mark.slow),
    ],
)
def test_resumed_with_the_same_bits(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "_EVERY", 0.0)
    data = dvi.Observations(REGULAR, noisy(REGULAR, 11), sigma=NOISE, t0=0.0)
    start = {**START, "args": {"k": 0.9}}
    options = {
        "least squares": {},
        "adam": {"optimiser": optax.adam(1e-3), "max_steps": 40},
        "segments": {"shooting": dvi.MultipleShooting(4)},
    }[kind]
    whole = dvi.fit(MODEL, data, start, **options)
    file, steps = tmp_path / "fit.npz", len(whole.history["loss"])
    assert steps > 6
    for stop in range(1, steps + 1):  # the last of each stage among them

        def interrupt(p, stop=stop):
            if p.step == stop:
                raise Interrupted

        with pytest.raises(Interrupted):
            dvi.fit(MODEL, data, start, **options, checkpoint=file, progress=interrupt)
        assert file.exists()
    again = dvi.fit(MODEL, data, start, **options, checkpoint=file)
    assert not file.exists()
    for name in ("x", "loss", "stage", "accepted"):
        np.testing.assert_array_equal(again.history[name], whole.history[name])
    np.testing.assert_array_equal(again.x, whole.x)
    np.testing.assert_array_equal(again.covariance, whole.covariance)


@pytest.mark.slow
def test_a_checkpoint_of_another_fit_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "_EVERY", 0.0)
    data = dvi.Observations(REGULAR, noisy(REGULAR, 11), sigma=NOISE, t0=0.0)
    file = tmp_path / "fit.npz"

    def interrupt(p):
        raise Interrupted

    with pytest.raises(Interrupted):
        dvi.fit(MODEL, data, START, checkpoint=file, progress=interrupt)
    other = dvi.Observations(REGULAR, noisy(REGULAR, 12), sigma=NOISE, t0=0.0)
    with pytest.raises(ValueError, match="is of another fit"):
        dvi.fit(MODEL, other, START, checkpoint=file)

    def stiffer(t0, t1, q0, p1, args):
        return H(t0, t1, q0, p1, args) + jnp.sum(q0**4)

    system = dvi.System(stiffer, force=W)
    model = dvi.Model(system, h=H_STEP, p0=[0.0], args={"k": 1.0}, method=STRANG)
    with pytest.raises(ValueError, match="is of another model"):
        dvi.fit(model, data, START, checkpoint=file)
    assert file.exists()


def test_a_checkpoint_of_other_settings_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "_EVERY", 0.0)
    data = dvi.Observations(REGULAR, noisy(REGULAR, 11), sigma=NOISE, t0=0.0)
    file = tmp_path / "fit.npz"

    def interrupt(p):
        raise Interrupted

    with pytest.raises(Interrupted):
        dvi.fit(MODEL, data, START, checkpoint=file, progress=interrupt)
    moved = dvi.Model(SYSTEM, h=H_STEP, p0=[0.5], args={"k": 1.0}, method=STRANG)
    prior = {"epsilon": dvi.Prior(0.5, 1e-3)}
    for model, options in (
        (MODEL, {"loss": dvi.Cauchy()}), (MODEL, {"priors": prior}), (moved, {}),
        (MODEL, {"tolerance": 1e-3}),
    ):  # fmt: skip
        with pytest.raises(ValueError, match="is of another fit"):
            dvi.fit(model, data, START, checkpoint=file, **options)
    with pytest.raises(FileNotFoundError, match="no directory"):
        dvi.fit(MODEL, data, START, checkpoint=tmp_path / "nowhere" / "fit.npz")


def test_more_steps_go_on_from_the_checkpoint(regular, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "_EVERY", 0.0)
    data, found = regular
    file = tmp_path / "fit.npz"
    with pytest.raises(dvi.FitError):
        dvi.fit(MODEL, data, START, max_steps=3, checkpoint=file)
    assert file.exists()
    more = dvi.fit(MODEL, data, START, checkpoint=file)
    assert not file.exists()
    np.testing.assert_array_equal(more.history["x"], found.history["x"])


# --- statuses and errors that must not lie: each of these once said otherwise --------------------


@pytest.mark.slow
def test_nearly_collinear_parameters_are_followed_to_the_minimum():
    small = 1e-5

    def model(params):
        q0 = (params["a"] + params["b"])[None]
        return MODEL({"q0": q0, "epsilon": 0.02, "args": {"k": 1.3}}) | {
            "p0": small * params["b"][None]
        }  # fmt: skip

    y = np.asarray(states_at(REGULAR, p0=[small]).qs)
    y = y + small * NOISE * np.random.default_rng(0).normal(size=y.shape)
    data = dvi.Observations(REGULAR, y, sigma=small * NOISE, t0=0.0)
    found = dvi.fit(model, data, {"a": 0.9, "b": -0.5}, check_curvature=False)
    assert found.status == "converged"
    assert np.abs((found.x - [0.0, 1.0]) / found.sigma).max() < 4


@pytest.mark.parametrize(("lower", "upper"), [(1.1, 2.0), (-2.0, -1.1), (0.0, 1e-300), (-3.0, 0.0)])
def test_numbers_stay_strictly_between_their_bounds(lower, upper):
    ends = [-800.0, 800.0]
    for bounds in (dvi.Bounds(lower), dvi.Bounds(None, upper), dvi.Bounds(lower, upper)):
        space, _ = make_space([(lower + upper) / 2] * 2, [bounds] * 2)
        x = np.asarray(space.to_x(jnp.array(ends)))
        assert ((x > space.lower) & (x < space.upper) | ~np.isfinite(x)).all()
        make_space(list(x[np.isfinite(x)]), [bounds] * int(np.isfinite(x).sum()))  # as a start


@pytest.mark.parametrize("bounds", [dvi.Bounds(0.0), dvi.Bounds(0.0, 1.0)], ids=["one", "two"])
@pytest.mark.slow
def test_a_start_next_to_a_bound(bounds, regular):
    data, found = regular
    near = dvi.fit(MODEL, data, {**START, "epsilon": 1e-6}, bounds={"epsilon": bounds})
    assert np.abs((near.x - found.x) / found.sigma).max() < 0.01
    assert near.at_bounds == []


@pytest.mark.slow
def test_a_small_parameter_is_not_at_its_bound():
    data = dvi.Observations(REGULAR, np.asarray(states_at(REGULAR).qs), sigma=1e-7, t0=0.0)

    def model(params):
        return MODEL({"q0": [1.0], "epsilon": 1e4 * params["small"], "args": {"k": 1.3}})

    found = dvi.fit(model, data, {"small": 1e-6}, bounds={"small": dvi.Bounds(0.0)})
    np.testing.assert_allclose(found.x, 2e-6, rtol=1e-4)
    assert found.at_bounds == []


def test_a_piece_that_converged_is_not_the_whole():
    data = dvi.Observations(REGULAR, noisy(REGULAR, 10), sigma=NOISE, t0=0.0)
    start = {**START, "args": {"k": 0.7}}
    for steps in range(4, 9):
        cut = dvi.fit(
            MODEL, data, start, horizons=[2.0, 8.0], max_steps=steps, throw=False,
            check_curvature=False,
        )  # fmt: skip
        whole = cut.history["horizon"][-1] == np.inf
        assert whole or cut.status == "max_steps_reached"
        assert cut.sigma[0] < 2e-3  # of all the data


@pytest.mark.slow
def test_undetermined_parameters_take_no_degree_of_freedom():
    few = dvi.Observations(REGULAR[:6], noisy(REGULAR, 14)[:6], t0=0.0)

    def model(params):
        return MODEL({"q0": [1.0], "epsilon": params["e"], "args": {"k": params["k"]}})

    plain = dvi.fit(model, few, {"e": 0.0, "k": 1.3}, check_curvature=False)
    idle = dvi.fit(model, few, {"e": 0.0, "k": 1.3, "z": np.zeros(3)}, check_curvature=False)
    assert len(idle.undetermined) == 3
    assert idle.degrees_of_freedom == plain.degrees_of_freedom == 4
    np.testing.assert_allclose(idle.sigma[:2], plain.sigma, rtol=1e-5)


@pytest.mark.slow
def test_a_likelihood_of_small_noise_with_an_idle_parameter_and_a_prior():
    def density(predicted, observed, sigma, params):
        return ((predicted - observed) / NOISE) ** 2 / 2

    def model(params):
        return MODEL({"q0": [1.0], "epsilon": params["e"], "args": {"k": params["k"]}})

    y = noisy(REGULAR, 8)
    start = {"e": 0.01, "k": 1.29, "idle": 0.0}
    found = dvi.fit(
        model, dvi.Observations(REGULAR, y, t0=0.0), start, loss=dvi.Likelihood(density),
        priors={"k": dvi.Prior(1.3, 1e-4)},
    )  # fmt: skip
    data = dvi.Observations(REGULAR, y, sigma=NOISE, t0=0.0)
    least = dvi.fit(model, data, start, priors={"k": dvi.Prior(1.3, 1e-4)})
    np.testing.assert_allclose(found.x[[0, 2]], least.x[[0, 2]], atol=1e-5)
    np.testing.assert_allclose(found.sigma[[0, 2]], least.sigma[[0, 2]], rtol=1e-2)
    assert found.names[1] == "idle"
    assert np.isinf(found.sigma[1])
    np.testing.assert_allclose(found.loss, least.loss, rtol=1e-6)


def test_rows_for_arcs_are_counted():
    data = dvi.Observations(REGULAR, noisy(REGULAR, 1), sigma=NOISE, t0=0.0)
    for rows in (2, 4):
        model = dvi.Model(SYSTEM, h=H_STEP, q0=np.ones((rows, 1)), p0=np.zeros((3, 1)))
        with pytest.raises(ValueError, match=r"list of .*arcs.*row"):
            dvi.fit(model, [data] * 3, {"epsilon": 0.0, "args": {"k": 1.3}})


def test_what_is_masked_is_missing():
    y = noisy(REGULAR, 1)
    masked = np.ma.masked_array(y, np.arange(60)[:, None] == 5)
    values = dvi.Observations(REGULAR, masked).values
    assert np.isnan(values[5, 0])
    assert np.isfinite(np.delete(values, 5)).all()


class Drag(eqx.Module):
    """A force with a size that is no parameter."""

    size: int
    weight: jax.Array

    def __call__(self, t0, t1, q0, p1, args):
        return sum(-self.weight * p1 for _ in range(self.size))


def with_drag(force):
    return {
        "system": dvi.System(H, force=force), "q0": [1.0], "p0": [0.0], "h": H_STEP,
        "epsilon": 1.0, "args": {"k": 1.3}, "method": STRANG,
    }  # fmt: skip


@pytest.mark.slow
def test_sizes_in_a_module_are_not_fitted():
    data = dvi.Observations(REGULAR, noisy(REGULAR, 1), sigma=NOISE, t0=0.0)
    found = dvi.fit(
        with_drag, data, Drag(2, jnp.array(0.0)), bounds=Drag(None, dvi.Bounds(-1.0, 1.0)),
        check_curvature=False,
    )  # fmt: skip
    assert found.names == ["weight"]
    np.testing.assert_allclose(found.x, 0.01, atol=1e-3)


def test_progress_is_reported(regular):
    data, found = regular
    seen = []
    dvi.fit(MODEL, data, START, progress=seen.append)
    assert [p.step for p in seen] == list(range(1, len(found.history["loss"]) + 1))
    np.testing.assert_array_equal([p.loss for p in seen], found.history["loss"])
    assert seen[-1].names == found.names
    assert seen[-1].seconds > 0


def test_one_compilation_for_many_fits(regular):
    from dvi_jax.fit.problem import _evaluate

    before = _evaluate._cached._cache_size()
    for seed in (30, 31):
        data = dvi.Observations(REGULAR, noisy(REGULAR, seed), sigma=NOISE, t0=0.0)
        model = dvi.Model(SYSTEM, h=H_STEP, p0=[0.1 * seed - 3], args={"k": 1.0}, method=STRANG)
        dvi.fit(model, data, START, throw=False)
    assert _evaluate._cached._cache_size() == before


def test_too_few_steps_raise_and_keep_what_was_found(regular):
    data, _ = regular
    with pytest.raises(dvi.FitError, match="max_steps_reached after 2 steps") as error:
        dvi.fit(MODEL, data, START, max_steps=2)
    kept = error.value.fit
    assert len(kept.history["loss"]) == 2
    assert kept.loss < kept.history["loss"][0] * 1.0001
    quiet = dvi.fit(MODEL, data, START, max_steps=2, throw=False)
    assert quiet.result == dvi.FIT_RESULTS.max_steps_reached


@pytest.mark.slow
def test_a_failed_trajectory_far_off_does_not_end_the_fit():
    """A trial step that leaves the region where the model has an answer is taken back."""

    def well(t0, t1, q0, p1, args):
        return jnp.sum(p1**2) / 2 + jnp.sum(jnp.sqrt(args["k"]) * q0**2)

    data = dvi.Observations(REGULAR, noisy(REGULAR, 13), sigma=NOISE, t0=0.0)
    model = dvi.Model(dvi.System(well), h=H_STEP, q0=[1.0], p0=[0.0], method=STRANG)
    found = dvi.fit(model, data, {"args": {"k": 3.0}}, horizons=[1.0], throw=False)
    assert np.isfinite(found.x).all()
    np.testing.assert_allclose(np.sqrt(found.x[0]) * 2, 1.3, rtol=0.02)


@pytest.mark.slow
def test_multiple_shooting_agrees_with_single(regular):
    data, found = regular
    apart = dvi.fit(MODEL, data, START, shooting=dvi.MultipleShooting(6))
    assert np.abs((apart.x - found.x) / found.sigma).max() < 1e-3
    np.testing.assert_allclose(apart.covariance, found.covariance, rtol=1e-3)
    assert apart.trajectories == ["successful"]


@pytest.mark.slow
def test_multiple_shooting_where_single_is_lost():
    """A chaotic orbit over some twenty of its e-folding times, from a poor start."""

    def henon_heiles(t0, t1, q0, p1, args):
        cubic = q0[0] ** 2 * q0[1] - q0[1] ** 3 / 3
        return (p1 @ p1 + q0 @ q0) / 2 + args["lam"] * cubic

    system = dvi.System(henon_heiles)
    q0, p0 = np.array([0.0, -0.25]), np.array([0.42, 0.0])
    ts = np.arange(0.5, 200.5, 0.5)
    sol = dvi.integrate(
        system, q0, p0, h=0.1, num_steps=2000, args={"lam": 1.0}, method=STRANG,
        save=dvi.Save(every=5),
    )  # fmt: skip
    exact = np.concatenate([sol.qs, sol.ps], 1)[1:]
    y = exact + 1e-3 * np.random.default_rng(0).normal(size=exact.shape)
    data = dvi.Observations(ts, y, "state", sigma=1e-3, t0=0.0)
    model = dvi.Model(system, h=0.1, method=STRANG)
    start = {"q0": q0 + 0.05, "p0": p0 - 0.05, "args": {"lam": 0.8}}
    found = dvi.fit(model, data, start, shooting=dvi.MultipleShooting(25))
    truth = np.concatenate([[1.0], p0, q0])
    assert np.abs((found.x - truth) / found.sigma).max() < 3.5
    assert 0.85 < found.reduced_chi2 < 1.15
    lost = dvi.fit(model, data, start, horizons=None, throw=False)
    assert lost.reduced_chi2 > 10 * found.reduced_chi2
    only = dvi.Observations(ts, y[:, :2], sigma=1e-3, t0=0.0)
    from_positions = dvi.fit(model, only, start, shooting=dvi.MultipleShooting(25))
    assert np.abs((from_positions.x - truth) / from_positions.sigma).max() < 3.5


@pytest.mark.slow
def test_multiple_shooting_from_the_models_own_trajectory(regular):
    """Segments that meet from the first step on must not hold the parameters fast."""
    data, found = regular
    apart = dvi.fit(MODEL, data, START, shooting=dvi.MultipleShooting(6, guess="model"))
    assert np.abs((apart.x - found.x) / found.sigma).max() < 1e-2


@pytest.mark.slow
def test_a_guess_may_be_given_or_refused(regular):
    data, found = regular

    def guess(t):
        return [np.cos(1.14 * t)], [-1.14 * np.sin(1.14 * t)]

    apart = dvi.fit(MODEL, data, START, shooting=dvi.MultipleShooting(6, guess=guess))
    assert np.abs((apart.x - found.x) / found.sigma).max() < 1e-2
    energy = dvi.Observations(REGULAR, np.ones(60), lambda t, q, p, a: q[0] ** 2, sigma=1.0, t0=0.0)
    with pytest.raises(ValueError, match=r'"positions" or of the "state"'):
        dvi.fit(MODEL, energy, START, shooting=dvi.MultipleShooting(6, guess="data"))
    with pytest.raises(ValueError, match="segments must be a whole number from 2 on"):
        dvi.MultipleShooting(1)


def test_uncertainty_of_a_known_matrix():
    J = np.array([[3.0, 0.0], [0.0, 0.5], [0.0, 0.0]])
    about = uncertainty(J, 4.0)
    np.testing.assert_allclose(about.covariance, np.diag([4 / 9, 16.0]))
    np.testing.assert_allclose(correlations(about.covariance), np.eye(2))
    C = np.array([[1.0, 1.0, 0.0]])
    assert np.abs(C @ null_space(C)).max() < 1e-15
    assert null_space(C).shape == (3, 2)
    # x + y known exactly: what is left of y is what is known of −x.
    tied = uncertainty(np.eye(3), 1.0, null_space(C))
    np.testing.assert_allclose(tied.covariance[:2, :2], [[0.5, -0.5], [-0.5, 0.5]], atol=1e-12)
