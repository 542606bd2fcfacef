"""Invalid observations, models and options of `dvi.fit`, and missing values."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.fit.problem import FitProblem


def H(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 + args["k"] * jnp.sum(q0**2) / 2


SYSTEM = dvi.System(H, force=lambda t0, t1, q0, p1, args: -p1, epsilon=0.0)
TS = np.arange(1, 21) * 0.5
VALUES = np.cos(TS)[:, None]
START = {"q0": [1.0], "p0": [0.0], "args": {"k": 1.0}}
MODEL = dvi.Model(SYSTEM, h=0.1, **START)
DATA = dvi.Observations(TS, VALUES, sigma=0.1, t0=0.0)
WITHOUT = dvi.Observations(TS, VALUES, t0=0.0)
PARAMS = {"epsilon": 0.0}
LONG = np.dtype(np.longdouble)  # the same as float64 on some machines
MASKED = np.ma.array([1.0], mask=[True])


def put(x, i, value):
    x = np.array(x, float)
    x[i] = value
    return x


VALUE_ERRORS = [
    ({"ts": put(TS, 3, np.nan)}, r"ts must be finite, got nan at index \[3\]"),
    ({"ts": put(TS, 3, np.inf)}, "ts must be finite, got inf"),
    ({"ts": put(TS, [4, 5], TS[[5, 4]])}, r"increase .* ts\[4\].*argsort"),
    ({"ts": put(TS, 4, TS[3])}, r"equal, got ts\[3\] = 2.0 and ts\[4\] = 2.0"),
    ({"t0": 0.75}, "one side of t0 = 0.75, got times from 0.5 to 10"),
    ({"t0": np.nan}, "t0 must be a finite number"),
    ({"ts": TS[:5]}, r"one row for each, got shapes \(5,\)"),
    ({"ts": TS[:, None]}, "one-dimensional"),
    ({"ts": np.zeros(0), "values": np.zeros((0, 1))}, "one-dimensional"),
    ({"values": put(VALUES, (2, 0), np.inf)}, r"got inf at index \[2, 0\]"),
    ({"values": VALUES * np.nan}, "at least one number"),
    ({"sigma": 0.0}, "positive .* got 0.0"),
    ({"sigma": -1.0}, "positive"),
    ({"sigma": np.nan}, "sigma must be .* got nan"),
    ({"sigma": np.ma.array(VALUES, mask=TS[:, None] == 2)}, r"index \[3, 0\]"),
    ({"ts": np.ma.array(TS, mask=TS == 2)}, r"ts .*masked .* index \[3\]"),
    ({"t0": np.ma.masked}, "t0 .*masked number"),
    ({"sigma": 1e-200}, r"values of up to 0.99.* got 1e-200"),
    ({"sigma": 1e200}, "in the units of the values"),
    ({"sigma": np.ones((20, 2))}, "broadcast to the shape"),
    ({"sigma": None, "covariance": np.zeros((1, 1))}, "positive definite"),
    ({"sigma": None, "covariance": -np.eye(1)}, "positive definite"),
    ({"sigma": None, "covariance": np.eye(2)}, r"shape \(1, 1\) or \(20, 1, 1\)"),
    ({"covariance": np.eye(1)}, "one of sigma and covariance"),
]
TYPE_ERRORS = [
    ({"values": VALUES * 1j}, "real numbers, got dtype complex"),
    ({"values": [["a"]] * 20}, "real numbers"),
    ({"observe": "velocities"}, '"positions", "momenta", "state"'),
    ({"observe": lambda q: q}, r"\(t, q, p, args\)"),
]


@pytest.mark.parametrize(
    ("error", "wrong", "says"),
    [(ValueError, *case) for case in VALUE_ERRORS] + [(TypeError, *case) for case in TYPE_ERRORS],
)
def test_observations_are_checked(error, wrong, says):
    with pytest.raises(error, match=says):
        dvi.Observations(**{"ts": TS, "values": VALUES, "sigma": 0.1, "t0": 0.0, **wrong})


@pytest.mark.parametrize("h", ["0.1", None, 0.0, np.inf, True])
def test_the_step_of_a_model_is_a_number(h):
    with pytest.raises(ValueError, match="h must be one finite step size"):
        dvi.Model(SYSTEM, h=h)


def test_covariances_of_two_components():
    values = np.stack([np.cos(TS), np.sin(TS)], 1)
    with pytest.raises(ValueError, match="known exactly"):
        dvi.Observations(TS, values, covariance=np.ones((2, 2)))
    full = np.tile(np.eye(2), (20, 1, 1))
    full[7, 0, 1] = 0.5
    with pytest.raises(ValueError, match="observation 7 must be symmetric"):
        dvi.Observations(TS, values, covariance=full)
    C = np.array([[2.0, 0.9], [0.9, 1.0]])
    values = np.stack([np.cos(TS), np.sin(TS)], 1)
    values[4, 0] = np.nan
    weights = dvi.Observations(TS, values, covariance=C).whitening()
    np.testing.assert_allclose(weights[0].T @ weights[0], np.linalg.inv(C), rtol=1e-12)
    np.testing.assert_allclose(weights[4], [[0, 0], [0, 1.0]], rtol=1e-12)


@pytest.mark.parametrize("sign", [1, -1], ids=["after t0", "before t0"])
@pytest.mark.parametrize("of", ["sigma", "covariance"])
def test_the_order_of_the_observations_does_not_matter(sign, of):
    """Errors and values are reordered together, and all arrays of a fit are the same."""
    error = np.linspace(0.1, 0.2, 20).reshape((20, 1) if of == "sigma" else (20, 1, 1))
    model = dvi.Model(SYSTEM, h=0.1 * sign, **START)
    groups = []
    for rows in (slice(None), slice(None, None, -1)):
        data = dvi.Observations(sign * TS[rows], VALUES[rows], t0=0.0, **{of: error[rows]})
        groups += FitProblem(model, [data], False, PARAMS).groups
    for of_one, of_other in zip(*(vars(group).values() for group in groups), strict=True):
        np.testing.assert_array_equal(of_one, of_other)


def fit(model=MODEL, data=DATA, params=PARAMS, **options):
    return dvi.fit(model, data, params, **options)


def returning(**changes):
    """A model as a function that returns other arguments of `integrate`."""
    return lambda params: {**MODEL(params), **changes}


def fails_at_start(params):
    return {**MODEL(params), "args": {"k": jnp.sqrt(params["epsilon"] - 1)}}


def starting(**changes):
    return dvi.Model(SYSTEM, h=0.1, **{**START, **changes})


def data(values=VALUES, ts=TS, **options):
    return dvi.Observations(ts, values, **{"sigma": 1.0, "t0": 0.0, **options})


VARIATIONAL = dvi.Model(SYSTEM, h=-0.1, **START, lattice=dvi.Variational(), num_steps=99)
TRANSFORMED = starting(lattice=dvi.TimeTransformed(lambda t, q, p, args: 1 + q @ q))
PRIORS = {"epsilon": dvi.Prior(0, 1)}
LATER = r"\(t = 0.5 to 10\) lie after t0 = 0, but h = -0.1 leads to earlier"
EARLIER = r"\(t = -10 to -0.5\) lie before t0 = 0, but h = 0.1 leads to later.*Give h = -0.1"
DIVERGES = (
    r"\(args.k = -30\) the model gives 2.*e\+03 for arc 0 at t = 1.5.* "
    r"at the start, t = 0, the model gives 1, later at most .* the trajectory diverges"
)
REFUSED = {
    ValueError: [
        ({"model": lambda params: {"system": SYSTEM}}, "'q0' is missing"),
        ({"model": returning(num_steps=3)}, "the model must not set 'num_steps'"),
        ({"model": returning(t0=0.0)}, r"Observations\(\.\.\., t0"),
        ({"model": returning(h=0.0)}, "other than zero"),
        ({"model": returning(h=-0.1)}, LATER + ".*Give h = 0.1"),
        ({"data": data(ts=-TS[::-1])}, EARLIER),
        ({"model": VARIATIONAL}, "lie after t0 = 0, but h = -0.1 leads to earlier"),
        ({"model": TRANSFORMED}, "num_steps .* other than dvi.Uniform"),
        ({"model": returning(h=1e-12)}, "times in one unit"),
        ({"model": returning(h=1e3)}, "times in one unit"),
        ({"model": lambda p: {**MODEL(p), "h": p["epsilon"] + 0.1}}, "not a JAX array"),
        ({"data": []}, "at least one"),
        ({"data": [DATA, WITHOUT]}, r"not for data\[1\]"),
        ({"data": data(1e6 * VALUES)}, "same units"),
        ({"data": data(1e-6 * VALUES)}, "same units"),
        ({"data": WITHOUT, "loss": dvi.Cauchy()}, "a robust loss .*sigma or covariance"),
        ({"data": WITHOUT, "priors": PRIORS}, "priors .*sigma or covariance"),
        ({"params": {}}, "that can be fitted"),
        ({"params": {"epsilon": np.nan}}, "epsilon starts at nan"),
        ({"params": {"args": {"k": np.ones(40)}}}, "scalar|at least"),
        ({"params": {"epsilon": np.ma.masked}}, "the parameter epsilon .*masked"),
        ({"params": {"q0": MASKED}}, r"q0 .*masked .*index \[0\]"),
        ({"bounds": {"epsilon": dvi.Bounds(np.ma.masked, 1)}}, "lower of epsilon .*masked"),
        ({"model": starting(q0=MASKED)}, "q0 .*masked"),
        ({"bounds": {"epsilon": dvi.Bounds([np.nan], 1)}}, "lower of epsilon must have"),
        ({"bounds": {"epsilon": dvi.Bounds(0.5, 1)}}, "not between"),
        ({"bounds": {"eps": dvi.Bounds(0.5, 1)}}, "got 'eps'"),
        ({"shooting": dvi.MultipleShooting(300)}, "from 2 to 100, got 300"),
        ({"batch": 3}, "batch requires an optimiser of optax"),
        ({"max_steps": 0}, "max_steps"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"horizons": [2.0, 1.0]}, "increasing positive times"),
        ({"horizons": "all"}, "auto"),
        ({"model": fails_at_start}, r"\(epsilon = 0\) the model gives (nan|inf) for the first"),
        ({"params": {"args": {"k": -30.0}}}, DIVERGES),
    ],
    TypeError: [
        ({"model": 3}, "model must be a dvi.Model"),
        ({"model": lambda params: 3}, "must be a dict of the arguments of dvi.integrate"),
        ({"data": (TS, VALUES)}, "dvi.Observations"),
        ({"params": 0.1}, "a dict with keys among"),
        ({"params": {"k": 1.0}}, "the key 'k'.* into args"),
        ({"model": starting(p0=np.array([0.0], object))}, "p0 .* dtype object"),
        ({"model": starting(q0=np.array(["2000"], "M8[D]"))}, "q0 .* dtype datetime64"),
        ({"model": starting(args={"k": np.array(1.0, object)})}, "args .* dtype object"),
        ({"bounds": {"epsilon": (0, 1)}}, r"dvi.Bounds\(...\)"),
        ({"bounds": {"epsilon": dvi.Bounds("a", 1)}}, "lower of epsilon must be"),
        ({"loss": "huber"}, "dvi.SoftL1"),
        ({"shooting": "multiple"}, "MultipleShooting"),
        ({"optimiser": "adam"}, "optimistix"),
        ({"progress": 3}, "progress"),
    ],
    IsADirectoryError: [({"checkpoint": "."}, "is a directory")],
    dvi.FitError: [
        (
            {"data": dvi.Observations(TS, VALUES, covariance=[[1e-310]], t0=0.0)},
            "status: not_finite, steps: 0, loss: inf.* the sum of their squares",
        )
    ],
}
if LONG.itemsize > 8:
    long = starting(p0=np.array([0.0], LONG))
    REFUSED[TypeError].append(({"model": long}, f"p0 has the type {LONG}"))


@pytest.mark.parametrize(
    ("error", "wrong", "says"), [(e, *case) for e, cases in REFUSED.items() for case in cases]
)
@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")  # the case of squares beyond range
def test_invalid_input_of_a_fit(error, wrong, says):
    with pytest.raises(error, match=says):
        fit(**wrong)


def test_masked_values_of_models_and_single_precision():
    assert type(starting(q0=np.ma.array([1.0]))(PARAMS)["q0"]) is np.ndarray
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        fit()


@pytest.mark.parametrize("loss", [dvi.SoftL1, dvi.Cauchy])
def test_a_robust_loss_has_a_positive_scale(loss):
    with pytest.raises(ValueError, match=r"scale must be a positive .*standard error"):
        loss(-1.0)


@pytest.mark.slow
def test_numbers_of_values():
    few, params = data(VALUES[:1], TS[:1]), {"epsilon": 0.0, "args": {"k": 1.0}}
    with pytest.raises(ValueError, match=r"at least 2 observed .*, got 1"):
        fit(data=few, params=params)
    priors = {"epsilon": dvi.Prior(0.0, 0.1)}
    assert fit(data=few, params=params, priors=priors).degrees_of_freedom == 0
    found = fit(data=data(1e4 * VALUES), check_units=False, throw=False)
    assert found.status in ("converged", "stalled", "max_steps_reached")


@pytest.mark.slow
def test_missing_values_do_not_count():
    holes = VALUES.copy()
    holes[::3] = np.nan
    found, left = fit(data=data(holes)), ~np.isnan(holes[:, 0])
    same = fit(data=data(holes[left], TS[left]))
    assert found.num_observed == left.sum()
    np.testing.assert_allclose(found.x, same.x, atol=1e-9)
    np.testing.assert_allclose(found.covariance, same.covariance, rtol=1e-6)
    assert np.isnan(found.whitened[0][::3]).all()
    assert np.isnan(found.residuals[0][::3]).all()


def turning(t0, t1, q0, p1, args):
    return p1 @ p1 / 2


TURN = dvi.System(turning)
# Unit of the angle, period → angles in (−P/2, P/2] or [0, P).
BRANCHES = {
    "radians": (2 * np.pi, lambda x: (x + np.pi) % (2 * np.pi) - np.pi),
    "degrees": (360.0, lambda x: x % 360.0),
    "hours": (24.0, lambda x: x % 24.0),
}


@pytest.mark.parametrize("name", BRANCHES)
def test_angles_that_cross_the_end_of_their_range(name):
    """With a period the fit is that of a straight line through the unwrapped angles."""
    period, wrap = BRANCHES[name]
    ts, sigma = np.arange(1.0, 41.0), 2e-3 * period
    line = 0.45 * period + 0.07 * period * ts + sigma * np.random.default_rng(2).normal(size=40)
    values = wrap(line)
    assert np.abs(np.diff(values)).max() > 0.9 * period
    model = dvi.Model(TURN, h=0.5)
    start = {"q0": np.array([0.44 * period]), "p0": np.array([0.0705 * period])}
    options = {"check_curvature": False}
    data = dvi.Observations(ts, values, sigma=sigma, t0=0.0, period=period)
    fit = dvi.fit(model, data, start, **options)
    slope, offset = np.polyfit(ts, line, 1)
    np.testing.assert_allclose(fit.x, [slope, offset], rtol=1e-7)
    np.testing.assert_allclose(
        fit.residuals[0].ravel(), line - offset - slope * ts, atol=1e-7 * period
    )
    assert 0.5 < fit.reduced_chi2 < 1.6
    assert fit.status == "converged"
    # Without a period the same data contradict their errors, and the result says so.
    naive = dvi.fit(model, dataclasses.replace(data, period=None), start, throw=False, **options)
    assert "contradict sigma" in str(naive).splitlines()[0]
    assert ("period=" in str(naive)) == (name != "hours")


def test_a_period_of_one_component_and_a_hint_without():
    ts = np.arange(1.0, 31.0)
    angle = 0.9 * np.pi + 0.3 * np.sin(ts)
    states = np.stack([(angle + np.pi) % (2 * np.pi) - np.pi, 0.3 * np.cos(ts)], axis=1)
    states += 1e-3 * np.random.default_rng(0).normal(size=states.shape)
    swing = dvi.System(lambda t0, t1, q, p, args: (p @ p + (q - args["c"]) @ (q - args["c"])) / 2)
    model = dvi.Model(swing, h=0.05, q0=[0.9 * np.pi], p0=[0.3], method=dvi.KahanLi(8))
    start = {"args": {"c": 2.8}}
    options = {"observe": "state", "t0": 0.0, "sigma": 1e-3}
    data = dvi.Observations(ts, states, period=[2 * np.pi, np.inf], **options)
    fit = dvi.fit(model, data, start, check_curvature=False)
    assert abs(fit.x[0] - 0.9 * np.pi) < 4 * fit.sigma[0]
    assert "period" not in str(fit)
    # A few angles on the other branch, where the fit is otherwise right.
    other = dataclasses.replace(fit, observed=[states], predicted=[fit.predicted[0] * 1.0])
    other.predicted[0][:, 0] = np.where(angle < np.pi, angle, angle - 2 * np.pi)
    other.predicted[0][3, 0] += 2 * np.pi
    assert "1 residuals are near ±2π: if the values are angles" in str(other)


@pytest.mark.parametrize(
    ("period", "match"),
    [
        (0.0, "period must be positive"),
        (-1.0, "period must be positive"),
        (np.nan, "period must be positive"),
        ([1.0, 2.0, 3.0], "period must broadcast"),
    ],
)
def test_invalid_periods(period, match):
    with pytest.raises(ValueError, match=match):
        dvi.Observations(np.arange(3.0), np.zeros((3, 2)), period=period)


@pytest.mark.parametrize(
    ("values", "period", "match"),
    [
        ((3,), -1.0, r"got -1.0\. An infinite"),
        ((3, 2), [1.0, -1.0], r"got -1.0 at index \[1\]\."),
        ((3, 2, 2), [[1.0, 2.0], [0.0, 1.0]], r"got 0.0 at index \[1, 0\]\."),
    ],
)
def test_the_place_of_an_invalid_period(values, period, match):
    """A single number has no index."""
    with pytest.raises(ValueError, match=match):
        dvi.Observations(np.arange(3.0), np.zeros(values), period=period)


@pytest.mark.slow
def test_multiple_shooting_of_angles():
    """States at the cuts are interpolated between neighbouring branches."""
    ts = np.arange(0.0, 40.0, 0.5)
    line = 7.0 + 0.8 * ts + 1e-3 * np.random.default_rng(1).normal(size=ts.shape)
    values = ((line + np.pi) % (2 * np.pi) - np.pi)[:, None]
    data = dvi.Observations(ts, values, sigma=1e-3, period=2 * np.pi, t0=0.0)
    start = {"q0": np.array([6.9]), "p0": np.array([0.81])}
    fit = dvi.fit(dvi.Model(TURN, h=0.5), data, start, shooting=dvi.MultipleShooting(4))
    np.testing.assert_allclose(fit.x, np.polyfit(ts, line, 1), rtol=1e-6)


@pytest.mark.parametrize("values", [VALUES[:, 0], VALUES])
def test_values_of_shape_n_and_n_1_have_the_same_residuals(values):
    """Rows are in the order of the data, whichever shape an observable of one component has."""
    data = dvi.Observations(TS, values + 0.01 * TS.reshape(-1, *[1] * (values.ndim - 1)), t0=0.0)
    fit = dvi.fit(MODEL, data, PARAMS, check_curvature=False)
    exact = np.exp(-fit.x[0] * TS / 2) * np.cos(np.sqrt(1 - fit.x[0] ** 2 / 4) * TS)
    np.testing.assert_allclose(fit.predicted[0].ravel(), exact, atol=0.05)
    np.testing.assert_allclose(fit.whitened[0].ravel(), fit.residuals[0].ravel())
