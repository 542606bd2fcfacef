"""The pole as measured, and the wobble's equations against closed forms and by hand."""

import datetime
import importlib.util
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivations import DERIVATIONS
from helpers import run_problem
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax.systems import polar_motion
from dvi_jax.systems.planets.polar_motion import (
    REFERENCE,
    YEAR,
    annual,
    exact,
    forced_pole,
    mean_pole,
    rates,
    read_polar_motion,
)

PROBLEM = polar_motion()
ARGS = PROBLEM.args
QUIET = ARGS | {name: np.zeros(2) for name in ("prograde", "retrograde", "mean", "drift")}
LOSSY = QUIET | {"inverse_Q": 0.1}
START = -8766.0  # 1976-01-01
MAS = 1e-3


@pytest.fixture(scope="module")
def measured():
    if importlib.util.find_spec("skyfield_data") is None:
        pytest.skip("the measured polar motion is not installed")
    with warnings.catch_warnings(action="error"):  # about the age of the files
        return read_polar_motion()


def run(args, h, num_steps, method=dvi.Yoshida(4), epsilon=1.0, q0=0.1, p0=0.2, **more):
    options = {"args": args, "h": h, "method": method, "epsilon": epsilon, "t0": START} | more
    return run_problem(PROBLEM, num_steps, q0=jnp.array([q0]), p0=jnp.array([p0]), **options)


def distance(solution, args, q0=0.1, p0=0.2):
    x, y = exact(solution.ts, START, q0, p0, args)
    return np.max(np.hypot(solution.qs[:, 0] - x, solution.ps[:, 0] - y))


def solved(args, t1, one_sided=False):
    """The end of Liouville's equation by SciPy; `one_sided`: with the damping in y only."""

    def field(t, state):
        if not one_sided:
            return DERIVATIONS["polar_motion"](t, *state, args, 1.0)
        x, y = DERIVATIONS["polar_motion"](t, *state, args | {"inverse_Q": 0.0}, 1.0)
        return x, y - 2 * rates(args)[1] * state[1]

    found = solve_ivp(field, (START, t1), [0.1, 0.2], "DOP853", rtol=1e-12, atol=1e-14)
    return found.y[:, -1]


C04 = [  # date, x, y, tolerance [arcsec], from IERS EOP 20 C04, another centre's own combination
    ("1977-01-01", -0.072400, 0.083200, 20 * MAS),
    ("1984-01-01", -0.133010, 0.091197, 2 * MAS),
    ("2000-01-01", 0.043261, 0.377991, 0.3 * MAS),
    ("2010-01-01", 0.098670, 0.192840, 0.1 * MAS),
    ("2016-01-01", 0.051172, 0.256788, 0.1 * MAS),
]


@pytest.mark.parametrize(("date", "x", "y", "tolerance"), C04)
def test_poles_are_those_of_another_centre(measured, date, x, y, tolerance):
    day = datetime.date.fromisoformat(date) - datetime.date(1858, 11, 17)  # where MJD counts from
    (i,) = np.flatnonzero(measured.mjd == day.days)
    assert abs(measured.x[i] - x) < tolerance
    assert abs(measured.y[i] - y) < tolerance
    error = np.hypot(measured.x_error[i], measured.y_error[i])
    assert np.hypot(measured.x[i] - x, measured.y[i] - y) < 3 * error
    assert abs(measured.x[i] - y) > tolerance  # negative control: the columns are not swapped


def test_every_day_is_there_once_with_an_error(measured):
    assert measured.mjd[0] == 41684.0  # 1973-01-02
    np.testing.assert_array_equal(np.diff(measured.mjd), 1.0)
    assert all(column.shape == measured.mjd.shape for column in measured)
    assert measured.mjd.size > 15000
    for error in (measured.x_error, measured.y_error):
        assert (error > 0).all()
        early, late = (np.median(error[abs(measured.mjd - m) < 180]) for m in (41864, 51544))
        assert early > 100 * late
    assert np.abs(measured.x).max() < 0.35  # the pole stays within twenty metres of its mean
    assert -0.05 < measured.y.min() < measured.y.max() < 0.65


LINE = "24 1 1 60310.00 {}  0.136621 0.000009  0.202010 0.000009  I-0.0087688 0.0000053"


def test_predictions_and_empty_lines_are_left_out_and_other_files_refused(tmp_path):
    path = tmp_path / "finals.all"
    path.write_text("\n".join([LINE.format("I"), LINE.format("P"), LINE[:16] + " " * 60, ""]))
    read = read_polar_motion(path)
    np.testing.assert_array_equal(np.stack(read).T, [[60310.0, 0.136621, 0.20201, 9e-6, 9e-6]])

    for text, said in (
        ("", "no measured pole"),
        (LINE.format("P"), "no measured pole"),
        (LINE.format("I")[:30], "line 1 of finals.all is not in the format"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=said):
            read_polar_motion(path)


def test_the_wobble_turns_as_the_sign_of_y_says(measured):
    """Prograde, from Greenwich to 90° east: in x − i y against the clock, once in 433 days."""
    t, z = measured.mjd - REFERENCE, measured.x - 1j * measured.y
    early = (t > -10 * YEAR) & (t < 0)
    z = z[early] - np.mean(z[early])
    at_chandler = np.abs([np.mean(z * np.exp(s * 2j * np.pi * t[early] / 433)) for s in (-1, 1)])
    assert at_chandler[0] > 0.12  # arcsec
    assert at_chandler[0] > 10 * at_chandler[1]


@pytest.mark.slow
def test_the_unperturbed_pole_moves_on_a_circle():
    solution = run(QUIET, 1.0, 433, epsilon=0.0)
    radius = np.hypot(solution.qs[:, 0], solution.ps[:, 0])
    np.testing.assert_allclose(radius, radius[0], rtol=1e-7)
    np.testing.assert_allclose([solution.qs[-1], solution.ps[-1]], [[0.1], [0.2]], atol=1e-7)
    ellipse = run(QUIET, 1.0, 433, dvi.TypeII(), epsilon=0.0)  # negative control: order 1
    assert np.ptp(np.hypot(ellipse.qs[:, 0], ellipse.ps[:, 0])) > 0.005 * radius[0]
    # the centre is the mean pole, also off the origin, but not where it drifts, or at ε = 1
    still = ARGS | {"drift": np.zeros(2)}
    cases = (still, 0.0, 0, 1e-6), (ARGS, 0.0, 1e-3, 1), (still, 1.0, 0.1, 1)
    for args, epsilon, least, most in cases:
        seen = run(args, 2.5, 400, epsilon=epsilon, observe=PROBLEM.observables["amplitude"])
        assert least <= np.ptp(seen.observed) / seen.observed[0] < most


@pytest.mark.slow
def test_damping_is_the_same_in_every_direction():
    """The spiral is exact, not an average over a turn, as with a force −2γp alone."""
    end = START + 100.0
    x, y = exact(end, START, 0.1, 0.2, LOSSY)
    np.testing.assert_allclose(solved(LOSSY, end), [x, y], atol=1e-11)
    one_sided = solved(LOSSY, end, one_sided=True)
    assert np.hypot(*(one_sided - np.array([x, y]))) > 0.03 * np.hypot(x, y)
    assert distance(run(LOSSY, 1.0, 100), LOSSY) < 1e-9


@pytest.mark.slow
def test_damping_is_that_of_q_times_epsilon():
    """e^{−επ/Q} in each turn."""
    for epsilon in (1.0, 0.5):
        solution = run(LOSSY, 1.0, 433 * 3, epsilon=epsilon, save=dvi.Save(every=433))
        radius = np.hypot(solution.qs[:, 0], solution.ps[:, 0])
        expected = -np.pi * 0.1 * epsilon * np.arange(4)
        np.testing.assert_allclose(np.log(radius / radius[0]), expected, rtol=1e-8, atol=1e-15)


@pytest.mark.slow
def test_response_is_the_resonance():
    sigma, omega = 2 * np.pi / 433.0, 2 * np.pi / YEAR
    lossless = QUIET | {"inverse_Q": 0.0}
    t = np.linspace(0, 2 * YEAR, 50)
    for name, gain in (("prograde", 1 - omega / sigma), ("retrograde", 1 + omega / sigma)):
        args = lossless | {name: np.array([0.01, 0.02])}
        np.testing.assert_allclose(forced_pole(t, args), np.stack(annual(t, args)) / gain)
    assert sigma / (sigma - omega) == pytest.approx(-5.39, abs=0.01)


@pytest.mark.slow
def test_a_pole_on_the_forced_path_stays_there():
    q0, p0 = (float(c) for c in forced_pole(START, ARGS))
    solution = run(ARGS, 5.0, 584, q0=q0, p0=p0, observe=PROBLEM.observables)
    for args, least, most in ((ARGS, 0, 0.01), (ARGS | {"period": 440.0}, 1, np.inf)):  # detuned
        x, y = forced_pole(solution.ts, args)
        off = np.max(np.hypot(solution.qs[:, 0] - x, solution.ps[:, 0] - y))
        assert least * MAS <= off < most * MAS
    assert np.max(solution.observed["free_amplitude"]) < 0.01 * MAS
    away = solution.observed["amplitude"]  # from the mean pole: the driven ellipse
    assert np.max(away) > 0.08
    assert np.max(away) - np.min(away) > 0.005
    solution = run(ARGS, 5.0, 584, observe=PROBLEM.observables)  # off the path: a decay to it
    _, gamma = rates(ARGS)
    free = solution.observed["free_amplitude"]
    ts = solution.ts[-len(free) :]
    np.testing.assert_allclose(free, free[0] * np.exp(-gamma * (ts - ts[0])), rtol=2e-4)


@pytest.mark.slow
def test_eight_years_are_exact_enough_to_fit():
    assert distance(run(ARGS, 5.0, 584), ARGS) < 0.02 * MAS
    strang = run(ARGS, 1.0, 2920, dvi.Strang())
    shorter = ARGS | {"period": ARGS["period"] - 0.0038}  # (σh)²/24 of it, as the docstring says
    assert distance(strang, shorter) < 0.01 * MAS < 0.03 * MAS < distance(strang, ARGS)


@pytest.mark.slow
def test_derivatives_by_the_parameters():
    """Forward and reverse mode through a run of two years agree with the closed form."""

    def integrated(args):
        solution = run(args, 1.0, 730, dvi.Strang(), save=dvi.Save(every=365))
        return jnp.concatenate([solution.qs[1:, 0], solution.ps[1:, 0]])

    def closed(args):
        ts = START + 365.0 * jnp.array([1.0, 2.0])
        return jnp.concatenate(exact(ts, START, 0.1, 0.2, args))

    args = jax.tree.map(lambda x: jnp.asarray(x, float), ARGS)
    wanted, got = jax.jacfwd(closed)(args), jax.jacfwd(integrated)(args)
    back = jax.jit(jax.grad(lambda args: jnp.sum(integrated(args) * jnp.arange(1.0, 5.0))))(args)
    for name in ARGS:
        size = float(jnp.max(jnp.abs(wanted[name])))
        assert size > 0
        # Strang: ((σ + ω)h)²/12 = 8e-5 in what drives, and 9e-5 in the phase after two years
        np.testing.assert_allclose(got[name], wanted[name], rtol=0, atol=5e-4 * size)
        along = jnp.tensordot(jnp.arange(1.0, 5.0), wanted[name], 1)
        np.testing.assert_allclose(back[name], along, rtol=0, atol=5e-3 * size)


def test_start_is_the_measured_one_and_the_mean_pole_drifts(measured):
    (i,) = np.flatnonzero(measured.mjd == REFERENCE)
    assert (PROBLEM.q0, PROBLEM.p0) == ([measured.x[i]], [measured.y[i]])
    PROBLEM.check(PROBLEM.q0, PROBLEM.p0, ARGS)
    assert mean_pole(0.0, ARGS) == (0.0550, 0.3205)
    wanted = 0.0550 + 0.01677, 0.3205 + 0.0346
    np.testing.assert_allclose(mean_pole(10 * YEAR, ARGS), wanted, rtol=1e-14)
