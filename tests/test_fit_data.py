"""What `dvi.fit` refuses, and what it says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.fit.problem import Problem


def H(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 + args["k"] * jnp.sum(q0**2) / 2


def W(t0, t1, q0, p1, args):
    return -p1


SYSTEM = dvi.System(H, force=W)
TS = np.arange(1, 21) * 0.5
VALUES = np.cos(TS)[:, None]
MODEL = dvi.Model(SYSTEM, h=0.1, q0=[1.0], p0=[0.0], args={"k": 1.0})
DATA = dvi.Observations(TS, VALUES, sigma=0.1, t0=0.0)
PARAMS = {"epsilon": 0.0}
START = {"q0": [1.0], "p0": [0.0], "args": {"k": 1.0}}
LONG = np.dtype(np.longdouble)  # the same as float64 on some machines


def swapped(x, i, j):
    x = np.array(x)
    x[[i, j]] = x[[j, i]]
    return x


def put(x, i, value):
    x = np.array(x, float)
    x[i] = value
    return x


@pytest.mark.parametrize(
    ("wrong", "error", "says"),
    [
        ({"ts": put(TS, 3, np.nan)}, ValueError, r"ts\[3\] is nan"),
        ({"ts": put(TS, 3, np.inf)}, ValueError, r"ts\[3\] is inf"),
        ({"ts": swapped(TS, 4, 5)}, ValueError, r"not in order: ts\[4\].*argsort"),
        ({"ts": put(TS, 4, TS[3])}, ValueError, r"ts\[3\] and ts\[4\] are the same time"),
        ({"t0": 0.75}, ValueError, "t0 = 0.75.* lies between the times .*0.5 to 10.*h < 0"),
        ({"t0": np.nan}, ValueError, "t0 must be one finite number"),
        ({"ts": TS[:5]}, ValueError, r"one row for each time: ts has shape \(5,\)"),
        ({"ts": TS[:, None]}, ValueError, "one-dimensional array of times"),
        ({"ts": np.zeros(0), "values": np.zeros((0, 1))}, ValueError, "one-dimensional"),
        ({"values": put(VALUES, (2, 0), np.inf)}, ValueError, r"infinite at index \[2, 0\]"),
        ({"values": VALUES * np.nan}, ValueError, "nothing was observed"),
        ({"values": VALUES * 1j}, TypeError, "real numbers, got dtype complex"),
        ({"values": [["a"]] * 20}, TypeError, "real numbers"),
        ({"sigma": 0.0}, ValueError, "sigma is 0.0 .* positive"),
        ({"sigma": -1.0}, ValueError, "positive"),
        ({"sigma": np.nan}, ValueError, "sigma is nan"),
        ({"sigma": np.ma.array(VALUES, mask=TS[:, None] == 2)}, ValueError, r"index \[3, 0\]"),
        ({"ts": np.ma.array(TS, mask=TS == 2)}, ValueError, r"ts is a masked .* index \[3\]"),
        ({"t0": np.ma.masked}, ValueError, "t0 is a masked array with a masked number, which"),
        ({"sigma": 1e-200}, ValueError, r"1e-200 .*values are up to 0.99.*double precision"),
        ({"sigma": 1e200}, ValueError, "in the units of the values"),
        ({"sigma": np.ones((20, 2))}, ValueError, "does not broadcast"),
        ({"sigma": None, "covariance": np.zeros((1, 1))}, ValueError, "not positive definite"),
        ({"sigma": None, "covariance": -np.eye(1)}, ValueError, "not positive definite"),
        ({"sigma": None, "covariance": np.eye(2)}, ValueError, r"shape \(1, 1\) or \(20, 1, 1\)"),
        ({"covariance": np.eye(1)}, ValueError, "sigma or covariance, not both"),
        ({"observe": "velocities"}, TypeError, '"positions", "momenta", "state"'),
        ({"observe": lambda q: q}, TypeError, r"\(t, q, p, args\)"),
    ],
)
def test_observations_are_checked(wrong, error, says):
    with pytest.raises(error, match=says):
        dvi.Observations(**{"ts": TS, "values": VALUES, "sigma": 0.1, "t0": 0.0, **wrong})


@pytest.mark.parametrize("h", ["0.1", None, 0.0, np.inf, True])
def test_the_step_of_a_model_is_a_number(h):
    with pytest.raises(ValueError, match="h must be one finite step size"):
        dvi.Model(SYSTEM, h=h)


def test_a_covariance_of_correlation_one_is_refused():
    values = np.stack([np.cos(TS), np.sin(TS)], 1)
    C = np.array([[1.0, 1.0], [1.0, 1.0]])
    with pytest.raises(ValueError, match="known exactly"):
        dvi.Observations(TS, values, covariance=C)
    full = np.tile(np.eye(2), (20, 1, 1))
    full[7, 0, 1] = 0.5
    with pytest.raises(ValueError, match="observation 7 is not symmetric"):
        dvi.Observations(TS, values, covariance=full)


@pytest.mark.parametrize("sign", [1, -1], ids=["after t0", "before t0"])
def test_the_order_of_the_observations_does_not_matter(sign):
    """Errors and values are moved together, and all that a fit computes with is the same."""
    errors = {
        "sigma": np.linspace(0.1, 0.2, 20)[:, None],
        "covariance": np.linspace(0.1, 0.2, 20)[:, None, None],
    }
    model = dvi.Model(SYSTEM, h=0.1 * sign, q0=[1.0], p0=[0.0], args={"k": 1.0})
    for name, error in errors.items():
        groups = []
        for rows in (slice(None), slice(None, None, -1)):
            data = dvi.Observations(sign * TS[rows], VALUES[rows], t0=0.0, **{name: error[rows]})
            groups += Problem(model, [data], False, PARAMS).groups
        for of_one, of_other in zip(*(vars(group).values() for group in groups), strict=True):
            np.testing.assert_array_equal(of_one, of_other)


def fit(model=MODEL, data=DATA, params=PARAMS, **options):
    return dvi.fit(model, data, params, **options)


def fails_at_start(params):
    k = jnp.sqrt(params["epsilon"] - 1)
    return {"system": SYSTEM, "q0": [1.0], "p0": [0.0], "h": 0.1, "args": {"k": k}}


@pytest.mark.parametrize(
    ("wrong", "error", "says"),
    [
        ({"model": 3}, TypeError, "model must be a dvi.Model"),
        ({"model": lambda params: 3}, TypeError, "must return the arguments of dvi.integrate"),
        ({"model": lambda params: {"system": SYSTEM}}, ValueError, "lack 'q0'"),
        ({"model": lambda p: {**MODEL(p), "num_steps": 3}}, ValueError, "must not set 'num_steps'"),
        ({"model": lambda p: {**MODEL(p), "t0": 0.0}}, ValueError, r"Observations\(\.\.\., t0"),
        ({"model": lambda p: {**MODEL(p), "h": 0.0}}, ValueError, "finite and not zero"),
        (
            {"model": lambda p: {**MODEL(p), "h": -0.1}},
            ValueError,
            r"\(t = 0.5 to 10\) lie after t0 = 0, but h = -0.1 leads to earlier.*Give h = 0.1",
        ),
        (
            {"data": dvi.Observations(-TS[::-1], VALUES, sigma=0.1, t0=0.0)},
            ValueError,
            r"\(t = -10 to -0.5\) lie before t0 = 0, but h = 0.1 leads to later.*Give h = -0.1",
        ),
        (
            {
                "model": dvi.Model(
                    SYSTEM,
                    h=-0.1,
                    q0=[1.0],
                    p0=[0.0],
                    args={"k": 1.0},
                    lattice=dvi.Variational(),
                    num_steps=99,
                )
            },
            ValueError,
            "lie after t0 = 0, but h = -0.1 leads to earlier",
        ),
        (
            {
                "model": dvi.Model(
                    SYSTEM,
                    h=0.1,
                    q0=[1.0],
                    p0=[0.0],
                    args={"k": 1.0},
                    lattice=dvi.TimeTransformed(lambda t, q, p, args: 1 + q @ q),
                )
            },
            ValueError,
            "on the lattice TimeTransformed.* num_steps",
        ),
        ({"model": lambda p: {**MODEL(p), "h": 1e-12}}, ValueError, "Are the times"),
        ({"model": lambda p: {**MODEL(p), "h": 1e3}}, ValueError, "Are the times"),
        ({"model": lambda p: {**MODEL(p), "h": p["epsilon"] + 0.1}}, ValueError, "not a parameter"),
        ({"data": (TS, VALUES)}, TypeError, "dvi.Observations"),
        ({"data": []}, ValueError, "empty"),
        (
            {"data": [DATA, dvi.Observations(TS, VALUES, t0=0.0)]},
            ValueError,
            r"data\[1\] has neither sigma",
        ),
        ({"data": dvi.Observations(TS, VALUES[:, 0], sigma=1.0)}, ValueError, r"returns \(1,\)"),
        ({"data": dvi.Observations(TS, 1e6 * VALUES, sigma=1.0)}, ValueError, "same units"),
        ({"data": dvi.Observations(TS, 1e-6 * VALUES, sigma=1.0)}, ValueError, "same units"),
        (
            {"data": dvi.Observations(TS, VALUES, t0=0.0), "loss": dvi.Cauchy()},
            ValueError,
            "robust",
        ),
        (
            {"data": dvi.Observations(TS, VALUES, t0=0.0), "priors": {"epsilon": dvi.Prior(0, 1)}},
            ValueError,
            "priors can only be weighed",
        ),
        ({"params": {}}, ValueError, "no number that could be fitted"),
        ({"params": 0.1}, TypeError, "a dict with keys among"),
        ({"params": {"k": 1.0}}, TypeError, "{\"args\": {'k': ...}}"),
        ({"params": {"epsilon": np.nan}}, ValueError, "epsilon starts at nan"),
        ({"params": {"args": {"k": np.ones(40)}}}, ValueError, "scalar|parameters cannot follow"),
        ({"params": {"epsilon": np.ma.masked}}, ValueError, "the parameter epsilon is a masked"),
        (
            {"params": {"q0": np.ma.array([1.0], mask=[True])}},
            ValueError,
            r"the parameter q0 is a masked array with a masked number at index \[0\]",
        ),
        ({"bounds": {"epsilon": dvi.Bounds(np.ma.masked, 1)}}, ValueError, "lower of epsilon is a"),
        *(
            (
                {"model": dvi.Model(SYSTEM, h=0.1, **{**START, **start})},
                error,
                says,
            )
            for start, error, says in (
                ({"q0": np.ma.array([1.0], mask=[True])}, ValueError, "q0 is a masked array"),
                *(
                    [({"p0": np.array([0.0], LONG)}, TypeError, f"p0 is {LONG}")]
                    if LONG.itemsize > 8
                    else []
                ),
                ({"p0": np.array([0.0], object)}, TypeError, "p0 .* dtype object"),
                ({"q0": np.array(["2000"], "M8[D]")}, TypeError, "q0 .* dtype datetime64"),
                ({"args": {"k": np.array(1.0, object)}}, TypeError, "args .* dtype object"),
            )
        ),
        ({"bounds": {"epsilon": dvi.Bounds(1, 0)}}, ValueError, "lower one must be less"),
        ({"bounds": {"epsilon": dvi.Bounds(0.5, 1)}}, ValueError, "not between"),
        ({"bounds": {"eps": dvi.Bounds(0.5, 1)}}, ValueError, "given for 'eps'"),
        ({"bounds": {"epsilon": (0, 1)}}, TypeError, r"dvi.Bounds\(...\)"),
        ({"priors": {"epsilon": dvi.Prior(0.0, 0.0)}}, ValueError, "positive sigma"),
        ({"loss": "huber"}, TypeError, "dvi.SoftL1"),
        ({"bounds": {"epsilon": dvi.Bounds("a", 1)}}, TypeError, "lower of epsilon must be"),
        ({"checkpoint": "."}, IsADirectoryError, "is a directory"),
        ({"shooting": "multiple"}, TypeError, "MultipleShooting"),
        ({"shooting": dvi.MultipleShooting(300)}, ValueError, "fewer segments"),
        ({"optimiser": "adam"}, TypeError, "optimistix"),
        ({"batch": 3}, ValueError, "stochastic"),
        ({"max_steps": 0}, ValueError, "max_steps"),
        ({"tolerance": 0.0}, ValueError, "tolerance"),
        ({"horizons": [2.0, 1.0]}, ValueError, "growing"),
        ({"horizons": "all"}, ValueError, "auto"),
        ({"progress": 3}, TypeError, "progress"),
        ({"model": fails_at_start}, ValueError, r"\(epsilon = 0\) the model gives no number"),
        (
            {"params": {"args": {"k": -30.0}}},
            ValueError,
            r"\(args.k = -30\) the model gives 2.*e\+03 for arc 0 at t = 1.5 "
            r"\(at its start, t = 0, 1; largest .* the trajectory diverges",
        ),
        (
            {"data": dvi.Observations(TS, VALUES, covariance=[[1e-310]], t0=0.0)},
            dvi.FitError,
            "not_finite after 0 steps, loss inf.* the sum of their squares",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")  # the case of squares beyond range
def test_fit_refuses(wrong, error, says):
    with pytest.raises(error, match=says):
        fit(**wrong)


def test_a_model_takes_a_masked_array_without_a_masked_number():
    model = dvi.Model(SYSTEM, h=0.1, **{**START, "q0": np.ma.array([1.0])})
    assert type(model(PARAMS)["q0"]) is np.ndarray


@pytest.mark.parametrize("loss", [dvi.SoftL1, dvi.Cauchy])
def test_a_robust_loss_has_a_positive_scale(loss):
    with pytest.raises(ValueError, match=r"scale must be a positive .*standard errors"):
        loss(-1.0)


@pytest.mark.slow
def test_fewer_values_than_parameters():
    few = dvi.Observations(TS[:1], VALUES[:1], sigma=0.1, t0=0.0)
    params = {"epsilon": 0.0, "args": {"k": 1.0}}
    with pytest.raises(ValueError, match="2 parameters cannot follow from 1 observed values"):
        fit(data=few, params=params)
    priors = {"epsilon": dvi.Prior(0.0, 0.1)}
    assert fit(data=few, params=params, priors=priors).degrees_of_freedom == 0


@pytest.mark.slow
def test_a_wrong_unit_can_be_meant():
    found = fit(
        data=dvi.Observations(TS, 1e4 * VALUES, sigma=1.0, t0=0.0), check_units=False, throw=False
    )
    assert found.status in ("converged", "stalled", "max_steps_reached")


def test_single_precision_is_refused():
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        fit()


@pytest.mark.slow
def test_missing_values_do_not_count():
    holes = VALUES.copy()
    holes[::3] = np.nan
    found = fit(data=dvi.Observations(TS, holes, sigma=0.1, t0=0.0))
    left = ~np.isnan(holes[:, 0])
    same = fit(data=dvi.Observations(TS[left], holes[left], sigma=0.1, t0=0.0))
    assert found.num_observed == left.sum()
    np.testing.assert_allclose(found.x, same.x, atol=1e-9)
    np.testing.assert_allclose(found.covariance, same.covariance, rtol=1e-6)
    assert np.isnan(found.whitened[0][::3]).all()
    assert np.isnan(found.residuals[0][::3]).all()


def test_a_missing_component_leaves_the_others_their_covariance():
    C = np.array([[2.0, 0.9], [0.9, 1.0]])
    values = np.stack([np.cos(TS), np.sin(TS)], 1)
    values[4, 0] = np.nan
    weights = dvi.Observations(TS, values, covariance=C).whitening()
    np.testing.assert_allclose(weights[0].T @ weights[0], np.linalg.inv(C), rtol=1e-12)
    np.testing.assert_allclose(weights[4], [[0, 0], [0, 1.0]], rtol=1e-12)
