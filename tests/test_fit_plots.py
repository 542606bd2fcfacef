"""Pictures of fits: what is drawn, where, in which units, and what is refused."""

import types

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.patches import Ellipse
from pictures import closed, legend, lies_within, marked, refuses  # noqa: F401

import dvi_jax as dvi
from dvi_jax import plot

same, close = np.testing.assert_array_equal, np.testing.assert_allclose

NAMES = ["args.mu", "epsilon", "q0[0]"]
X = np.array([1.000632, -0.02, 3.2e-4])
SIGMA = np.array([2e-5, 4e-3, 5e-4])
RHO = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, -0.9996], [0.0, -0.9996, 1.0]])
RHO = np.where(np.eye(3, dtype=bool), 1.0, np.clip(RHO, -0.8, 0.8))
C = RHO * np.outer(SIGMA, SIGMA)


def made(arcs=1, sigma=0.1, n=60, components=2, **changes):
    """A `FitResult` of normal residuals, with two stages and a rejected step."""
    rng = np.random.default_rng(0)
    ts = [np.linspace(0, 10, n) + i for i in range(arcs)]
    predicted = [np.stack([np.sin(t + k) for k in range(components)], 1) for t in ts]
    whitened = [rng.normal(size=p.shape) for p in predicted]
    whitened[0][3, 0] = np.nan
    observed = [p + (sigma or 0.1) * w for p, w in zip(predicted, whitened, strict=True)]
    history = {
        "stage": np.array([0, 0, 1, 1, 1]), "horizon": np.array([5.0, 5.0, *[np.inf] * 3]),
        "loss": np.array([1e3, 40.0, 90.0, 90.0, 61.0]), "step": np.ones(5),
        "accepted": np.array([True, True, True, False, True]), "x": np.tile(X, (5, 1)),
    }  # fmt: skip
    fields = {
        "params": dict(zip(NAMES, X, strict=True)), "x": X, "names": NAMES, "covariance": C,
        "history": history, "result": dvi.FIT_RESULTS.converged, "ts": ts, "observed": observed,
        "predicted": predicted, "loss": 61.0, "degrees_of_freedom": 2 * n - 3,
        "whitened": whitened if sigma else [0.1 * w for w in whitened], "num_observed": 2 * n,
        "has_errors": sigma is not None,
        "errors": [np.full(p.shape, sigma or np.nan) for p in predicted],
    }  # fmt: skip
    return dvi.FitResult(**{**fields, **changes})


def points(axis):
    """What is drawn as dots, one array (N, 2) each."""
    return [np.asarray(line.get_xydata()) for line in axis.lines if line.get_marker() != "None"]


def test_residuals_are_drawn_at_their_times_next_to_their_distribution():
    fit = made()
    fit.whitened[0][7, 1] = -12.0  # an outlier stays in the picture
    axes = plot.fit_residuals(fit)
    for k, drawn in enumerate(points(axes[0])[:2]):
        same(drawn, np.stack([fit.ts[0], fit.whitened[0][:, k]], 1))
    assert sum(patch.get_width() for patch in axes[1].patches) == 119  # one is missing
    assert axes[-1].get_xlabel() == "count\n1 of 120\nnot finite"
    curve = next(line for line in axes[1].lines if len(line.get_xdata()) == 200)
    area = np.trapezoid(curve.get_xdata(), curve.get_ydata())
    assert area == pytest.approx(119 * axes[1].patches[0].get_height(), rel=1e-3)
    assert axes[0].get_ylim()[0] == axes[1].get_ylim()[0] < -12
    assert "[standard errors]" in axes[0].get_ylabel()


def test_residuals_of_unknown_errors_and_of_several_arcs():
    fit = made(sigma=None)
    axes = plot.fit_residuals(fit, component=1)
    s = np.sqrt(fit.reduced_chi2)
    close(points(axes[0])[0][:, 1], fit.whitened[0][:, 1] / s)
    assert f"s = {s:.3g}" in axes[0].get_ylabel()
    assert len(plot.fit_residuals(made(3))) == 4
    panel, _ = plot.fit_residuals(made(9))
    assert len(points(panel)) == 18
    panel, _ = plot.fit_residuals(made(9), arcs=[8])
    same(points(panel)[0][:, 0], np.linspace(0, 10, 60) + 8)


@pytest.mark.slow
def test_the_sign_that_the_label_says_is_that_of_a_real_fit():
    model = dvi.Model(dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2), h=0.1, p0=jnp.ones(1))
    data = dvi.Observations([0.0, 0.1, 0.2], np.array([[0.0], [0.1], [0.8]]), sigma=0.1)
    fit = dvi.fit(model, data, {"q0": np.zeros(1)})
    last = points(plot.fit_residuals(fit)[0])[0][-1, 1]
    close(last, (fit.observed[0] - fit.predicted[0])[-1, 0] / 0.1)
    assert last > 3


def edge(ellipse):
    """Points of an ellipse."""
    t = np.linspace(0, 2 * np.pi, 100)
    half = np.array([ellipse.width, ellipse.height]) / 2
    a = np.radians(ellipse.angle)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return (half * np.stack([np.cos(t), np.sin(t)], 1)) @ turn.T + np.array(ellipse.center)


def test_ellipses_and_marginals_are_those_of_the_covariance():
    axes = plot.fit_corner(made())
    # Units of the axes, read from their labels.
    labels = ["args.mu − 1.000632\n[$10^{-5}$]", "epsilon", "q0[0]\n[$10^{-3}$]"]
    assert [axis.get_xlabel() for axis in axes[2]] == labels
    scale = np.array([1e-5, 1.0, 1e-3])
    for i, j in ((1, 0), (2, 0), (2, 1)):
        pair = C[np.ix_([j, i], [j, i])]
        found = [p for p in axes[i, j].patches if isinstance(p, Ellipse)]
        for size, ellipse in zip((1, 2), found, strict=True):
            off = (edge(ellipse) - np.array(ellipse.center)) * scale[[j, i]]
            close(np.einsum("ni,ij,nj->n", off, np.linalg.inv(pair), off), size**2, rtol=1e-6)
    close(np.array(axes[2, 1].patches[0].center) * scale[[1, 2]], X[[1, 2]])
    assert [axes[i].texts[0].get_text() for i in ((0, 1), (1, 2))] == ["+0.60", "−0.80"]
    assert axes[0, 0].get_title() == "args.mu\n1.000632 ± 0.000020"
    for i in range(3):  # normal densities
        x, y = axes[i, i].lines[0].get_data()
        assert np.trapezoid(y, x) == pytest.approx(1, abs=3e-3)
        assert y.max() == pytest.approx(scale[i] / (SIGMA[i] * np.sqrt(2 * np.pi)), rel=1e-3)


def test_parameters_are_chosen_and_ordered_and_must_be_determined():
    axes = plot.fit_corner(made(), ["epsilon", "args.mu"], axes=plt.subplots(2, 2)[1])
    assert axes[1, 0].get_xlabel() == "epsilon"
    strong = C.copy()
    strong[0, 1] = strong[1, 0] = -0.9996 * SIGMA[0] * SIGMA[1]
    axes = plot.fit_corner(made(covariance=strong), NAMES[:2])
    assert axes[0, 1].texts[0].get_text() == "−0.9996"
    singular = C.copy()
    singular[1, :] = singular[:, 1] = np.nan
    singular[1, 1] = np.inf
    fit = made(covariance=singular)
    with pytest.raises(ValueError, match=r"of 'epsilon', got inf.*'args.mu', 'q0\[0\]'"):
        plot.fit_corner(fit)
    assert plot.fit_corner(fit, ["args.mu", "q0[0]"]).shape == (2, 2)


def test_draws_lie_under_the_ellipses():
    draws = np.random.default_rng(0).multivariate_normal(X, C, 2000).reshape(4, 500, 3)
    samples = {name: draws[..., i] for i, name in enumerate(NAMES)}
    axes = plot.fit_corner(made(), samples=samples)
    (cloud,) = [p for p in points(axes[2, 1]) if len(p) == 2000]
    close(cloud * [1.0, 1e-3], draws.reshape(-1, 3)[:, [1, 2]])
    bars = sum(p.get_height() * p.get_width() for p in axes[0, 0].patches)
    assert bars == pytest.approx(1)
    own = {"mean": draws.mean((0, 1)), "covariance": np.cov(draws.reshape(-1, 3).T)}
    own = types.SimpleNamespace(names=NAMES, x=draws, samples=samples, **own)
    assert plot.fit_corner(own, samples=own).shape == (3, 3)


def bars(axis):
    """Half lengths of the error bars of each set of data, without those that have none."""
    return [
        [np.ptp(s[:, 1]) / 2 for s in c[2][0].get_segments() if len(s)]
        for c in axis.containers
        if c[2]
    ]


def test_data_with_their_errors_beside_the_prediction():
    fit = made()
    axis = plot.fit_against_data(fit, component=1, names=("x", "y"))
    close(bars(axis)[0], 0.1)
    for line, values in zip(axis.lines, (fit.predicted[0], fit.observed[0]), strict=False):
        same(line.get_xydata(), np.stack([fit.ts[0], values[:, 1]], 1))
    assert legend(axis) == ["y: fit", "y: observed"]
    sizes = np.linspace(0.1, 0.2, 60)
    each = made(errors=[sizes[:, None] * np.ones(2)])
    lengths = bars(plot.fit_against_data(each, component=0))[0]
    close([b for b in lengths if np.isfinite(b)], np.delete(sizes, 3), atol=1e-12)
    fit = made(sigma=None)
    close(bars(plot.fit_against_data(fit, component=1))[0], np.sqrt(fit.reduced_chi2))


def test_predictions_that_do_not_show_the_curve_are_crosses():
    """Straight lines between twelve points of one and a half periods would be a polygon."""
    assert not marked(plot.fit_against_data(made(n=400, components=1)), "x")
    fit, t = made(n=12, components=1), np.linspace(0, 10, 500)
    assert marked(plot.fit_against_data(fit), "x")
    axis = plot.fit_against_data(fit, curve=(t, np.sin(t)))
    assert not marked(axis, "x")
    same(axis.lines[0].get_data(), [t, np.sin(t)])


def test_losses_by_stage_with_rejected_steps():
    fit, axis = made(), plot.learning_curve(made())
    same(axis.lines[0].get_xydata(), [[1, 1e3], [2, 40]])
    same(axis.lines[1].get_xdata(), [3, 4, 5])
    same(marked(axis, "x"), [[[4, 90]]])
    stages = ["stage 1: t ≤ t0 + 5", "stage 2: all data"]
    assert legend(axis) == [*stages, "step rejected"]
    assert axis.get_yscale() == "log"
    fit.history["loss"][3:] = np.inf, -3.0
    axis = plot.learning_curve(fit)
    assert axis.get_yscale() == "linear"
    assert legend(axis)[-1] == "1 of 5 losses are not finite (at the top)"


def test_legends_on_given_axes_are_within_them():
    figure, axes = plt.subplots(1, 3, layout="constrained", figsize=(13, 4))
    plot.learning_curve(made(), ax=axes[0])
    plot.fit_residuals(made(), axes=axes[1:])
    figure.canvas.draw()
    assert all(lies_within(axis.get_legend(), axis) for axis in axes[:2])


def test_invalid_input_is_rejected():
    bare, none = types.SimpleNamespace(x=X), np.full((3, 3), np.nan)
    many = made(names=[f"a{i}" for i in range(13)], x=np.ones(13), covariance=np.eye(13))
    still = made(history=dict.fromkeys(made().history, X[:0]))
    fit, three, four = made(), plt.subplots(1, 3)[1], plt.subplots(2, 2)[1]
    refuses(
        plot.fit_residuals,
        ((bare,), {}, "must be a FitResult.*whitened", TypeError),
        ((fit,), {"arcs": 1}, "arcs must be .* 0 to 0, got 1"),
        ((fit,), {"component": "q"}, "component must be .*'q'"),
        ((fit,), {"names": ["x"]}, r"2 names of components, got \['x'\]"),
        ((fit,), {"arcs": []}, "arcs is empty: choose"),
        ((fit,), {"axes": three}, r"needs 2 Axes, one for each panel.*got 3"),
    )
    refuses(
        plot.fit_corner,
        ((bare,), {}, "a FitResult.* names, covariance", TypeError),
        ((made(covariance=none),), {}, "positive and finite variance of 'args.mu', got nan"),
        ((fit, ["mu"]), {}, r"different names from \['args.mu', 'eps.*'mu'"),
        ((fit, ["epsilon"] * 2), {}, "different names"),
        ((fit, []), {}, "one or more"),
        ((many,), {}, r"13 parameters are too many.*params=\['a0'"),
        ((fit,), {"samples": {"mu": X}}, "draws of 'args.mu'"),
        ((fit,), {"samples": 3}, "a dvi.Samples or a dict", TypeError),
        ((fit,), {"axes": four}, r"shape \(3, 3\) for 3 parameters"),
    )
    refuses(
        plot.fit_against_data,
        ((bare,), {}, "must be a FitResult", TypeError),
        ((fit,), {"names": "xy"}, "2 names of components, got 'xy'"),
        ((fit,), {"arc": 2}, "arc must be .*got 2"),
        ((fit,), {"component": -1}, "component must be .*got -1"),
        ((fit,), {"curve": (X, X)}, "with 2 components"),
        ((made(components=9),), {}, "9 components are too"),
    )
    refuses(
        plot.learning_curve,
        ((bare,), {}, "must be a FitResult", TypeError),
        ((still,), {}, "took no step"),
    )
