"""Posteriors and samples of them: densities, gradients, bounds, agreement with the fit."""

import dataclasses
import sys
import types
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import dvi_jax as dvi
from dvi_jax.fit import bayes, maxima, posterior as posterior_module
from dvi_jax.fit.parameters import make_space
from dvi_jax.fit.posterior import Posterior

N, H = 12, 0.1


def free(t0, t1, q0, p1, args):
    return p1 @ p1 / 2


def kepler(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 - args["mu"] / jnp.linalg.norm(q0)


def cubic(t0, t1, q0, p1, args):
    return (p1 @ p1 + args["k"] * q0 @ q0) / 2


LINE = dvi.Model(dvi.System(free), h=H)
PAIR = {"q0": np.array([0.1]), "p0": np.array([0.9])}


def on_a_line(sigma=0.05, count=N, seed=0):
    """Noisy places of q = 0.1 + 0.9 t, of which the map of a free particle is exact."""
    ts = H * np.arange(count)
    noise = (sigma or 0.05) * np.random.default_rng(seed).normal(size=(count, 1))
    return dvi.Observations(ts, 0.1 + 0.9 * ts[:, None] + noise, sigma=sigma)


def line_by_hand(data, sigma):
    """Mean and covariance of (p0, q0), as the straight line's normal equations have them."""
    A = np.stack([data.ts, np.ones(len(data.ts))], axis=1) / sigma
    C = np.linalg.inv(A.T @ A)
    return C @ A.T @ data.values[:, 0] / sigma, C


OSCILLATOR = dvi.Model(
    dvi.System(cubic, force=lambda t0, t1, q0, p1, args: -(q0**3)), h=H, p0=jnp.array([0.3])
)
NEAR = {"epsilon": 0.03, "q0": np.array([0.8]), "args": {"k": 1.1}}
LIMITS = {"epsilon": dvi.Bounds(0.0, 0.2), "args": {"k": dvi.Bounds(lower=0.5)}}


def swinging(sigma=0.01, steps=40, seed=0):
    given = {"h": H, "num_steps": steps, "epsilon": 0.05, "args": {"k": 1.0}}
    sol = dvi.integrate(
        OSCILLATOR.settings["system"], [0.8], [0.3], save=dvi.Save(every=4), **given
    )
    noise = 0.01 * np.random.default_rng(seed).normal(size=sol.qs.shape)
    return dvi.Observations(sol.ts, np.asarray(sol.qs) + noise, sigma=sigma)


def student(predicted, observed, sigma, params):
    return 2.5 * jnp.log1p(((predicted - observed) / sigma) ** 2 / 4)


LOSSES = {
    "least squares": (dvi.LeastSquares(), 0.01),
    "unknown errors": (dvi.LeastSquares(), None),
    "Cauchy": (dvi.Cauchy(), 0.01),
    "likelihood": (dvi.Likelihood(student), 0.01),
}


@pytest.mark.parametrize(("loss", "sigma"), LOSSES.values(), ids=LOSSES)
@pytest.mark.slow
def test_slopes_against_differences(loss, sigma):
    data = swinging(sigma)
    about = {"bounds": LIMITS, "loss": loss, "priors": {"args": {"k": dvi.Prior(1.0, 0.02)}}}
    posterior = dvi.Posterior(OSCILLATOR, data, NEAR, **about)
    forward = dvi.Posterior(OSCILLATOR, data, NEAR, gradient="forward", **about)
    u = jnp.asarray(posterior.start)
    slope = np.asarray(jax.grad(posterior.potential)(u))
    # Central differences of order six: their own error is some h⁶, round-off some 1e-16 U/h.
    h, at, weights = 2e-4, np.array([-3, -2, -1, 1, 2, 3]), np.array([-1, 9, -45, 45, -9, 1]) / 60
    moved = u[None, None] + h * at[:, None, None] * np.eye(3)[None]
    values = np.asarray(jax.vmap(jax.vmap(posterior.potential))(moved))
    by_differences = weights @ values / h
    np.testing.assert_allclose(slope, by_differences, rtol=1e-8)
    np.testing.assert_allclose(jax.grad(forward.potential)(u), slope, rtol=1e-9)
    assert not np.allclose(slope * (1 + 3e-8), by_differences, rtol=1e-8, atol=0)


@pytest.mark.slow
def test_derivatives_and_failing_trajectories():
    posterior = dvi.Posterior(OSCILLATOR, swinging(), NEAR, gradient="forward")
    u, d = jnp.asarray(posterior.start), jnp.array([1.0, -2.0, 0.5])
    slope = jax.grad(posterior.potential)
    pushed = jax.jvp(posterior.potential, (u,), (d,))[1]
    np.testing.assert_allclose(pushed, slope(u) @ d, rtol=1e-12)
    h = 1e-5
    by_differences = (slope(u + h * d) - slope(u - h * d)) / (2 * h)
    np.testing.assert_allclose(jax.jvp(slope, (u,), (d,))[1], by_differences, rtol=1e-6)

    def explosive(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 - jnp.sum(jnp.exp(args["b"] * q0))

    ts = H * np.arange(30)
    data = dvi.Observations(ts, np.ones((30, 1)), sigma=0.1)
    model = dvi.Model(dvi.System(explosive), h=H, q0=jnp.ones(1), p0=jnp.ones(1))
    for gradient in ("reverse", "forward"):
        posterior = dvi.Posterior(model, data, {"args": {"b": 0.01}}, gradient=gradient)
        value, slope = jax.vmap(jax.value_and_grad(posterior.potential))(jnp.array([[0.01], [9.0]]))
        assert np.isfinite(value[0])
        assert value[1] == np.inf
        assert slope[0] != 0
        assert slope[1] == 0
        assert posterior.log_density(jnp.array([9.0])) == -np.inf
    with pytest.raises(ValueError, match=r"got 0 at args.b = 9"):
        posterior.laplace([9.0])


@pytest.mark.slow
def test_priors_and_bounds_are_densities_of_x():
    """∫ exp(−U(u)) du over a part of u is the mass of the density of x there."""
    limits = {"p0": dvi.Bounds(0.8, 1.0), "q0": dvi.Bounds(lower=0.05)}
    priors = {"q0": dvi.Prior(0.12, 0.02)}
    data = on_a_line()
    posterior = dvi.Posterior(LINE, data, PAIR, bounds=limits, priors=priors)
    (p, q), C = line_by_hand(data, 0.05)

    def density(x):  # of (p0, q0)
        off = x - np.array([p, q])
        normal = np.exp(-np.einsum("...i,ij,...j", off, np.linalg.inv(C), off) / 2)
        return normal * np.exp(-(((x[..., 1] - 0.12) / 0.02) ** 2) / 2)

    u = np.linspace(-6, 1.5, 7)[:, None] * [1.0, 0.6] + [0.0, -2.0]
    x = np.asarray(jax.vmap(posterior.to_x)(jnp.asarray(u)))
    stretch = np.prod([np.diag(jax.jacfwd(posterior.to_x)(jnp.asarray(v))) for v in u], axis=1)
    values = np.asarray(jax.vmap(posterior.potential)(jnp.asarray(u)))
    found, want = np.exp(-values), density(x) * stretch
    np.testing.assert_allclose(found / found[0], want / want[0], rtol=1e-7)
    assert not np.allclose(found / found[0], density(x) / density(x)[0], rtol=0.1)
    assert posterior.names == ["p0[0]", "q0[0]"]
    params = posterior.to_params(jnp.asarray(u[0]))
    np.testing.assert_allclose(np.concatenate([params["p0"], params["q0"]]), x[0])


def test_unknown_errors_are_integrated_out():
    """A straight line with errors of unknown size: Student's distribution, N − 2 degrees."""
    data = on_a_line(sigma=None, count=8)
    posterior = dvi.Posterior(LINE, data, PAIR)
    centre, C = line_by_hand(data, 1.0)
    residual = data.values[:, 0] - centre[1] - centre[0] * data.ts
    square = residual @ residual
    off = np.random.default_rng(1).normal(size=(20, 2)) * 0.1
    u = jnp.asarray(centre + off)
    found = np.asarray(jax.vmap(posterior.potential)(u))
    nu = 6
    distance = np.einsum("ni,ij,nj->n", off, np.linalg.inv(C), off) / (square / nu)
    want = (nu + 2) / 2 * np.log1p(distance / nu)
    np.testing.assert_allclose(found - found[0], want - want[0], rtol=1e-8, atol=1e-9)
    plug_in = distance / 2  # the size taken for known, at its estimate
    assert np.abs(found - found[0] - plug_in + plug_in[0]).max() > 0.1


@pytest.mark.slow
def test_the_mode_and_its_covariance():
    data = on_a_line()
    posterior = dvi.Posterior(LINE, data, {"q0": np.array([3.0]), "p0": np.array([-2.0])})
    mode, root = posterior.laplace()
    centre, C = line_by_hand(data, 0.05)
    np.testing.assert_allclose(mode, centre, atol=3e-4 * np.sqrt(C[1, 1]))
    np.testing.assert_allclose(root @ root.T, C, rtol=1e-6)
    student_t = dvi.Posterior(LINE, data, PAIR, loss=dvi.Likelihood(student))
    mode, root = student_t.laplace()
    assert np.abs(jax.grad(student_t.potential)(jnp.asarray(mode)) @ root).max() < 1e-2


@pytest.mark.slow
def test_samples_say_that_a_prior_contradicts_the_data():
    """The speed of the data is 0.9, and residuals hardly show the difference."""
    options = {"num_samples": 20, "num_warmup": 20, "chains": 2, "explore": 0}
    for speed, is_wrong in ((2.5, True), (1.0, False)):
        priors = {"p0": dvi.Prior(speed, 0.2)}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # so few draws hardly agree
            found = dvi.sample(LINE, on_a_line(), PAIR, priors=priors, **options)
        text = "\n".join(found.warnings)
        assert ("priors contradict the data" in text) == is_wrong


@pytest.mark.slow
def test_draws_of_a_linear_problem_have_the_mean_and_sigma_of_the_fit(monkeypatch):
    data = on_a_line()
    fit = dvi.fit(LINE, data, PAIR)
    asked = []
    monkeypatch.setattr(bayes, "fit", lambda *args, **options: asked.append(options) or fit)
    found = dvi.sample(LINE, data, PAIR, num_samples=1000, num_warmup=200, chains=2)
    assert asked[0]["throw"] is False
    assert found.status == "mixed"
    assert found.warnings == []
    assert found.divergences == 0
    ess = np.array([found.ess[n] for n in fit.names])
    assert (ess > 500).all()
    np.testing.assert_array_less(np.abs(found.mean - fit.x), 4 * fit.sigma / np.sqrt(ess))
    np.testing.assert_array_less(np.abs(found.sigma / fit.sigma - 1), 4 / np.sqrt(ess))
    assert abs(found.correlations[0, 1] - fit.correlations[0, 1]) < 0.03
    # Contents and layout.
    assert found.x.shape == (2, 1000, 2)
    np.testing.assert_array_equal(found.samples["q0[0]"], found.params["q0"][..., 0])
    assert list(found.r_hat) == fit.names
    assert "q0[0]" in str(found)
    tree = found.to_xarray()
    assert tree["posterior"]["p0[0]"].dims == ("chain", "draw")
    np.testing.assert_array_equal(tree["sample_stats"]["lp"], -found.potential)
    look = jax.vmap(dvi.Posterior(LINE, data, PAIR).potential)
    np.testing.assert_allclose(look(jnp.asarray(found.x[1, :5])), found.potential[1, :5])


NEAR_0 = dvi.Model(dvi.System(free), h=H, p0=jnp.zeros(1))
EDGE = {"q0": dvi.Bounds(0.0, 1.0)}


def truncated():
    """Data whose mean lies 0.5 of its error below the lower bound 0, and (mean, sd) of q0 by
    quadrature: ∫ x f dx / ∫ f dx."""
    sigma, count = 0.2, 4
    values = np.array([[-0.2], [0.0], [-0.05], [0.05]])
    data = dvi.Observations(H * np.arange(count), values, sigma=sigma)
    error = sigma / np.sqrt(count)
    x = np.linspace(0, 1, 200_001)
    f = np.exp(-(((x + 0.05) / error) ** 2) / 2)
    mean = (x * f).sum() / f.sum()
    return data, mean, np.sqrt(((x - mean) ** 2 * f).sum() / f.sum())


@pytest.mark.parametrize("is_right", [True, False], ids=["right", "log-Jacobian left out"])
@pytest.mark.slow
def test_a_parameter_at_its_bound_has_the_truncated_distribution(monkeypatch, is_right):
    data, mean, sigma = truncated()
    start = {"q0": np.array([0.1])}
    options = {"bounds": EDGE, "num_warmup": 300, "chains": 2, "seed": 3, "start": start}
    if is_right:
        found = dvi.sample(NEAR_0, data, start, num_samples=1500, **options)
        assert found.x.min() > 0
        assert found.divergences == 0
        assert abs(found.mean[0] - mean) < 4 * sigma / np.sqrt(found.ess["q0[0]"])
        assert abs(found.sigma[0] / sigma - 1) < 0.1
        return
    # A density of u that is flat towards the bound, where chains do not converge.
    monkeypatch.setattr(posterior_module, "log_slope", lambda space, u: jnp.zeros_like(u))
    with pytest.warns(UserWarning, match="the chains do not agree"):
        found = dvi.sample(NEAR_0, data, start, num_samples=300, max_tree_depth=6, **options)
    assert found.status == "not_mixed"
    assert not abs(found.mean[0] - mean) < 8 * sigma / np.sqrt(found.ess["q0[0]"])
    assert abs(found.sigma[0] / sigma - 1) > 0.5


ABOVE_1 = {"q0": dvi.Bounds(1.0, 2.0)}


def beyond_1():
    """The data of `truncated` with the bound at 1: where a number is rounded onto it."""
    data, mean, sigma = truncated()
    return dataclasses.replace(data, values=data.values + 1), mean + 1, sigma


@pytest.mark.slow
def test_a_fit_that_ended_at_a_bound_is_a_start():
    """There u is infinite: the number starts where `params` has it, inside of the bounds."""
    data, _, _ = beyond_1()
    params = {"q0": np.array([1.1])}
    found = dvi.fit(NEAR_0, data, params, bounds=ABOVE_1, check_curvature=False)
    assert found.at_bounds == ["q0[0]"]
    dvi.Posterior(NEAR_0, data, found.params, bounds=ABOVE_1)  # its numbers are within bounds
    made = dvi.Posterior(NEAR_0, data, params, bounds=ABOVE_1)
    u = bayes.start_of(made, found, ABOVE_1, None)
    np.testing.assert_allclose(made.to_x(u), 1.1, rtol=1e-12)
    with pytest.raises(ValueError, match="not between its bounds"):
        bayes.start_of(made, {"q0": np.ones(1)}, ABOVE_1, None)


@pytest.mark.slow
def test_an_optimum_beyond_a_bound_is_sampled_from_a_fit_of_its_own():
    data, mean, sigma = beyond_1()
    params = {"q0": np.array([1.1])}
    found = dvi.sample(NEAR_0, data, params, bounds=ABOVE_1, chains=2, seed=4)
    assert found.x.min() > 1
    assert abs(found.mean[0] - mean) < 4 * sigma / np.sqrt(found.ess["q0[0]"])


@pytest.mark.slow
def test_epsilon_of_a_perturbed_orbit_is_recovered():
    system = dvi.System(kepler, force=lambda t0, t1, q0, p1, args: -q0)
    model = dvi.Model(system, h=0.05, p0=jnp.array([-1.0, -0.1]), args={"mu": 1.0})
    truth = {"epsilon": 0.02, "q0": np.array([0.0, 1.0])}
    sol = dvi.integrate(**model(truth), num_steps=400, save=dvi.Save(every=20))
    noise = 0.01 * np.random.default_rng(1).normal(size=sol.qs.shape)
    data = dvi.Observations(sol.ts, np.asarray(sol.qs) + noise, sigma=0.01)
    start = {"epsilon": 0.0, "q0": np.array([0.01, 1.01])}
    options = {"num_samples": 500, "num_warmup": 200, "chains": 2, "seed": 1}
    found = dvi.sample(model, data, start, start=start, **options)
    assert found.status == "mixed"
    i = found.names.index("epsilon")
    assert abs(found.mean[i] - 0.02) < 3 * found.sigma[i]
    assert abs(found.mean[i]) > 10 * found.sigma[i]  # ε = 0 is excluded
    assert found.params["q0"].shape == (2, 500, 2)


@pytest.mark.slow
def test_errors_of_unknown_size_with_bounds_and_a_prior_from_a_fit_of_its_own():
    """The fit before the chains uses no prior there; the posterior does."""
    about = {"bounds": {"args": LIMITS["args"]}, "num_samples": 500, "chains": 2}
    start = {"q0": NEAR["q0"], "args": NEAR["args"]}  # epsilon and k change one frequency alike
    known = {"h": H, "p0": jnp.array([0.3]), "epsilon": 0.05, "args": {"k": 1.0}}
    model, truth = dvi.Model(OSCILLATOR.settings["system"], **known), {"args.k": 1.0, "q0[0]": 0.8}
    sigma = []
    for priors in (None, {"args": {"k": dvi.Prior(1.0, 1e-3)}}):
        found = dvi.sample(model, swinging(None), start, priors=priors, **about)
        assert found.status == "mixed"
        off = (found.mean - [truth[n] for n in found.names]) / found.sigma
        assert np.abs(off).max() < 4
        sigma.append(found.sigma[found.names.index("args.k")])
    assert sigma[0] > 2e-3
    assert 0.7e-3 < sigma[1] < 1.05e-3


class Bumps(Posterior):
    """A density in place of that of data: exp(−potential) of one or two numbers."""

    def __init__(self, params, value, bounds=None, priors=None):
        self.space, x = make_space(params, bounds, priors)
        self.names, self.size = list(self.space.names), self.space.size
        self.start = self.space.to_u(x)
        self._value = lambda u: value(self.space.to_x(u)) + self._log_prior(u)
        self._slopes = jax.value_and_grad(self._value)
        self._potential = jax.jit(self._value)
        self._local = jax.jit(self._exact)


def alias(x):
    """Maxima of equal height at 1.1 and 2π − 1.1, of a frequency observed at whole times."""
    ts = jnp.arange(1.0, 21.0)
    return jnp.sum((jnp.cos(1.1 * ts) - jnp.cos(x * ts)) ** 2) / (2 * 0.05**2)


def either_sign(x):
    return jnp.sum((x**2 - 1) ** 2) / (2 * 0.1**2)


WIDE = dvi.Bounds(0.1, 7.0)
# Density, start, bounds, priors → maxima.
SEVERAL = {
    "alias": (alias, [1.08], WIDE, None, [[1.1], [2 * np.pi - 1.1]]),
    "prior": (either_sign, [0.9], None, dvi.Prior(0.0, 1.0), [[-1.0], [1.0]]),
    "near the start": (either_sign, [0.9], None, None, [[-1.0], [1.0]]),
    "four": (
        either_sign,
        [0.9, 1.1],
        dvi.Bounds(-3.0, 3.0),
        None,
        [[-1, -1], [-1, 1], [1, -1], [1, 1]],
    ),
    "one": (lambda x: jnp.sum((x - 1) ** 2) * 50, [0.9], WIDE, None, [[1.0]]),
    "low": (
        lambda x: either_sign(x) + 10 * jnp.sum(x < 0),
        [0.9],
        None,
        dvi.Prior(0.0, 1.0),
        [[1.0]],
    ),
}


@pytest.mark.parametrize("name", SEVERAL)
def test_maxima_besides_the_start_are_explored(name):
    value, start, bounds, priors, expected = SEVERAL[name]
    posterior = Bumps(np.array(start), value, bounds, priors)
    mode, root = posterior.laplace()
    first = maxima.Maximum(mode, root, posterior.look(mode)[0])
    listing, text = maxima.explored(posterior, first, 64, 0)
    x = np.array(sorted(posterior.to_x(m.u).tolist() for m in listing))
    np.testing.assert_allclose(x, expected, atol=0.02)
    assert sum(m.share for m in listing) == pytest.approx(1, abs=1e-3)
    assert text.startswith(f"{len(expected)} maxim")
    assert ("drawn near the start only: params" in text) == (name == "near the start")


@pytest.mark.slow
def test_two_maxima_of_equal_height_are_not_mixed():
    """Observed at whole times, the frequencies w and 2π − w fit equally well: whichever the start,
    there are chains at both, and the result says so."""
    ts = np.arange(1.0, 21.0)
    values = np.cos(1.1 * ts) + 0.05 * np.random.default_rng(3).normal(size=20)
    data = dvi.Observations(ts, values[:, None], sigma=0.05, t0=0.0)
    spring = dvi.System(lambda t0, t1, q, p, args: (p @ p + args["w"] ** 2 * (q @ q)) / 2)
    model = dvi.Model(spring, h=0.1, q0=[1.0], p0=[0.0], method=dvi.KahanLi(8))
    options = {"num_samples": 60, "num_warmup": 60, "chains": 2, "bounds": {"args": {"w": WIDE}}}
    with pytest.warns(UserWarning, match="the density has 2 maxima"):
        it = dvi.sample(model, data, {"args": {"w": 1.08}}, **options)
    assert it.status == "not_mixed"
    np.testing.assert_allclose(np.sort(it.x.mean(axis=(1, 2))), [1.1, 2 * np.pi - 1.1], atol=0.02)
    assert "2 maxima from 64 draws of priors and bounds" in str(it)
    alone = {**options, "bounds": {"args": {"w": dvi.Bounds(0.1, 3.0)}}}
    one = dvi.sample(model, data, {"args": {"w": 1.08}}, **alone)
    assert len(one.maxima) == 1
    assert "explored: 1 maximum" in str(one)


def test_more_maxima_than_chains_are_not_mixed():
    good = fake(np.random.default_rng(0).normal(size=(1, 500)))
    assert good.status == "mixed"
    assert dataclasses.replace(good, maxima=np.zeros((2, 1))).status == "not_mixed"


def test_the_warning_of_several_maxima_names_the_parameters_that_differ():
    """Five parameters, of which the text has room for three; the last one differs."""
    posterior = Bumps(np.zeros(5), either_sign)
    points = np.array([[1e-6, 40.0, 3.0, 2.0, x] for x in (-1.0, 1.0)])
    found = [maxima.Maximum(x, np.eye(5), 0.0, 0.5) for x in points]
    x = np.random.default_rng(0).normal(size=(1, 40, 5))
    about = {"potential_energy": x[..., 0], "diverging": x[..., 0] > 9, "num_steps": x[..., 0]}
    samples = bayes.collect(posterior, x, about | {"mean_accept_prob": x[..., 0]}, [], 99, found)
    (text,) = [note for note in samples.warnings if "2 maxima" in note]
    assert "params[4] = -1, " in text
    assert "params[4] = 1, " in text


def fake(x, diverging=0, steps=3):
    """`Samples` of draws x (chains, draws) of one parameter, as `sample` collects them."""
    posterior = dvi.Posterior(NEAR_0, truncated()[0], {"q0": 0.1 * np.ones(1)})
    posterior.names = ["a"]
    lost = np.zeros(x.shape, bool)
    lost.flat[:diverging] = True
    about = {
        "potential_energy": x**2 / 2, "diverging": lost, "num_steps": np.full(x.shape, steps),
        "mean_accept_prob": np.full(x.shape, 0.8),
    }  # fmt: skip
    return bayes.collect(posterior, x[..., None], about, [], 1023)


def test_warnings():
    good = np.random.default_rng(0).normal(size=(4, 500))
    assert fake(good).status == "mixed"
    assert fake(good).warnings == []
    apart = fake(good + np.arange(4)[:, None])
    assert apart.status == "not_mixed"
    assert "the chains do not agree" in apart.warnings[0]
    assert "a 1." in apart.warnings[0] or "a 2." in apart.warnings[0]
    stuck = fake(np.ones((4, 500)))
    assert stuck.status == "not_mixed"
    assert np.isnan(stuck.r_hat["a"])
    lost = fake(good, diverging=3)
    assert (lost.status, lost.divergences) == ("diverging", 3)
    assert "3 of 2000 draws diverged" in lost.warnings[0]
    assert "diverged" in str(lost)
    assert "100 % of the paths were truncated" in fake(good, steps=1023).warnings[0]


def test_packages_that_are_old_or_missing(monkeypatch):
    found = fake(np.random.default_rng(0).normal(size=(2, 50)))
    new = types.SimpleNamespace(__version__="1.0.0")
    old = types.SimpleNamespace(__version__="0.22.0", InferenceData=lambda **groups: groups)
    monkeypatch.setitem(sys.modules, "arviz", new)
    assert isinstance(found.to_arviz(), xr.DataTree)
    monkeypatch.setitem(sys.modules, "arviz", old)
    assert set(found.to_arviz()) == {"posterior", "sample_stats"}
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(ImportError, match="pip install arviz"):
        found.to_arviz()
    monkeypatch.setitem(sys.modules, "numpyro.infer", None)
    with pytest.raises(ImportError, match=r"dvi-jax\[bayes\]"):
        dvi.sample(LINE, on_a_line(), PAIR)
    assert np.isfinite(dvi.Posterior(LINE, on_a_line(), PAIR).potential(jnp.ones(2)))


ONE = dvi.Observations([0.0], np.zeros((1, 1)), sigma=0.1)
IDLE = {"p0": np.ones(1), "args": {"unused": 1.0}}
RESTING = dvi.Model(dvi.System(free), h=H, q0=jnp.zeros(1))
OUTSIDE = {"bounds": {"q0": dvi.Bounds(0, 1)}, "start": {"q0": np.ones(1) * 2, "p0": np.ones(1)}}
INVALID_POSTERIORS = [
    (ONE, {}, ValueError, r"at least 2 observed values.* got 1"),
    (on_a_line(None, 2), {}, ValueError, r"size of the errors .*got 2"),
    (ONE, {"gradient": "both"}, ValueError, "'forward', got"),
    (np.ones(3), {}, TypeError, "dvi.Observations"),
    (on_a_line(None), {"loss": dvi.SoftL1()}, ValueError, "a robust loss .*sigma or covariance"),
]
INVALID_SAMPLES = [
    ({"num_samples": 2}, ValueError, "num_samples must be an integer of at least 4, got 2"),
    ({"chains": 0}, ValueError, "chains must be"),
    ({"target_accept": 1.0}, ValueError, "target_accept must be between 0 and 1"),
    ({"progress": 3}, TypeError, "progress must be"),
    ({"start": {"q0": np.zeros(1)}}, ValueError, r"Missing: p0\[0\]\. Unknown: none"),
    (OUTSIDE, ValueError, "not between its bounds"),
]


@pytest.mark.parametrize(("data", "options", "error", "said"), INVALID_POSTERIORS)
def test_invalid_posteriors(data, options, error, said):
    with pytest.raises(error, match=said):
        dvi.Posterior(LINE, data, PAIR, **options)


@pytest.mark.parametrize(("options", "error", "said"), INVALID_SAMPLES)
def test_invalid_samples(options, error, said):
    with pytest.raises(error, match=said):
        dvi.sample(LINE, on_a_line(), PAIR, **options)


def test_a_parameter_without_effect_or_prior_is_refused():
    with pytest.raises(ValueError, match=r"neither the data nor priors determine 1.00 args.unused"):
        dvi.sample(RESTING, on_a_line(), IDLE, start=IDLE)
