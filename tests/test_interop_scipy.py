"""`interop.solve_ivp` compared with SciPy's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax import interop, systems

KEPLER = systems.kepler()


SYSTEM = dvi.System(
    lambda t0, t1, q0, p1, args: jnp.sum(p1**2) / 2 - args * jnp.sum(jnp.cos(q0)),
    force=lambda t0, t1, q0, p1, args: jnp.full_like(q0, jnp.cos(2 * t0)),
)
Y0, K, EPSILON = [0.9, 0.3], 1.3, 0.05
FIELD = jax.jit(interop.vector_field(SYSTEM, EPSILON))


def rate(t, y):
    return np.concatenate(FIELD(t, tuple(np.split(y, 2)), K))


def theirs(t_span, **options):
    return solve_ivp(rate, t_span, Y0, method="DOP853", rtol=1e-11, atol=1e-11, **options)


def ours(t_span, method="BlanesMoan6", h=0.05, **options):
    options = {"args": K, "epsilon": EPSILON, **options}
    return interop.solve_ivp(SYSTEM, t_span, Y0, method, h=h, **options)


def high(t, y):
    return y[0] - 0.3


def low(t, y, *rest):
    return y[0] + 0.2 + 0.01 * t


def marked(event, terminal=False, direction=0):
    """The event itself, so that all tests share what is compiled for it."""
    event.terminal, event.direction = terminal, direction
    return event


@pytest.mark.parametrize("t_span", [(0.0, 6.0), (2.0, -4.0)])
@pytest.mark.slow
def test_states_at_given_times(t_span):
    times = np.linspace(*t_span, 12)
    wanted, found = theirs(t_span, t_eval=times), ours(t_span, t_eval=times)
    assert np.array_equal(found.t, wanted.t)
    assert found.y.shape == wanted.y.shape == (2, 12)
    np.testing.assert_allclose(found.y, wanted.y, rtol=0, atol=2e-9)
    assert (found.status, found.success, found.sol) == (0, True, None)
    assert found.message == wanted.message
    coarse = ours(t_span, "Strang", t_eval=times)
    assert 1e-5 < np.abs(coarse.y - wanted.y).max() < 1e-2
    undriven = ours(t_span, t_eval=times, epsilon=0.0)
    assert np.abs(undriven.y - wanted.y).max() > 1e-3


@pytest.mark.slow
def test_lattice_points_and_many_crossings():
    found = ours((0.0, 1.0), h=0.3)
    np.testing.assert_allclose(found.t, [0, 0.25, 0.5, 0.75, 1], rtol=0, atol=1e-15)
    assert (found.num_steps, found.h) == (4, 0.25)
    assert ours((0.0, 1.0), h=0.1).num_steps == 10  # 1/0.1 is not quite 10
    run = {"h": 0.25, "num_steps": 4, "epsilon": EPSILON, "args": K}
    sol = dvi.integrate(SYSTEM, Y0[:1], Y0[1:], method=dvi.BlanesMoan(6), **run)
    assert np.array_equal(found.y, np.concatenate([sol.qs, sol.ps], axis=1).T)
    system = dvi.System(lambda t0, t1, q0, p1, args: 50 * jnp.sum(p1**2 + q0**2))
    options = {"h": 0.005, "events": lambda t, y: y[0]}
    found = interop.solve_ivp(system, (0.0, 8.9), [1.0, 0.0], dvi.Strang(), **options)
    # Half turns, 2 asin(1/4) of phase a step; 200 of them are stored at first.
    assert len(found.t_events[0]) == 286


@pytest.mark.slow
@pytest.mark.parametrize("t_span", [(0.0, 9.0), (2.0, -7.0)])
@pytest.mark.parametrize(
    "direction", [0, *(pytest.param(d, marks=pytest.mark.slow) for d in (1, -1))]
)
def test_events_are_where_those_of_scipy_are(t_span, direction):
    both = {"events": [marked(high, direction=direction), marked(low)]}
    wanted, found = theirs(t_span, **both), ours(t_span, **both)
    assert [len(t) for t in found.t_events] == [len(t) for t in wanted.t_events]
    assert len(wanted.t_events[1]) >= 2
    for name in ("t_events", "y_events"):
        for a, b in zip(found[name], wanted[name], strict=True):
            np.testing.assert_allclose(a, b.reshape(a.shape), rtol=0, atol=2e-8)


BACKWARDS = pytest.param(2, (2.0, -7.0), marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize(("terminal", "t_span"), [(True, (0.0, 9.0)), BACKWARDS])
def test_a_terminal_event_truncates_the_output(terminal, t_span):
    events = [marked(high, terminal), marked(low)]
    wanted, found = theirs(t_span, events=events), ours(t_span, events=events)
    assert found.status == wanted.status == 1
    assert (found.success, found.message) == (True, wanted.message)
    np.testing.assert_allclose(found.t[-1], wanted.t[-1], rtol=0, atol=2e-8)
    np.testing.assert_allclose(found.y[:, -1], wanted.y[:, -1], rtol=0, atol=2e-8)
    assert [len(t) for t in found.t_events] == [len(t) for t in wanted.t_events]
    assert len(found.t_events[0]) == int(terminal)


@pytest.mark.slow
@pytest.mark.parametrize("t_span", [(0.0, 9.0), (2.0, -7.0)])
def test_a_terminal_event_truncates_given_times(t_span):
    options = {"events": [marked(high, 2), marked(low)], "t_eval": np.linspace(*t_span, 40)}
    found = ours(t_span, **options)
    assert np.array_equal(found.t, theirs(t_span, **options).t)
    assert 0 < len(found.t) < 40


def collapse(t0, t1, q0, p1, args):
    """A force that is no longer defined at q < 0."""
    return jnp.sum(p1**2) / 2 + jnp.sum(q0**1.5)


def collapsing(**options):
    return interop.solve_ivp(
        dvi.System(collapse), (0.0, 4.0), [1.0, 0.0], "Strang", h=0.05, **options
    )


@pytest.mark.slow
def test_a_failure_is_reported_and_not_raised():
    found = collapsing()
    assert (found.status, found.success) == (-1, False)
    assert "Likely causes" in found.message
    assert found.solution.status == "not_finite"
    assert 20 < len(found.t) < 80
    assert np.isfinite(found.y).all()
    assert found.y.shape == (2, len(found.t))
    early = collapsing(t_eval=[1.0, 3.0])
    assert (early.status, list(early.t)) == (-1, [1.0])


@pytest.mark.slow
def test_successes_before_a_failure_and_events_with_numbers_of_numpy():
    found = collapsing(events=marked(lambda t, y: y[0] - 0.8, terminal=True))
    assert (found.status, found.success) == (1, True)
    np.testing.assert_allclose(found.y[0, -1], 0.8, rtol=1e-12)
    event = marked(lambda t, y: y[0] - 0.3, np.int64(1), np.float64(-1))
    found = ours((0.0, 2.0), "TypeII", events=event, shape=1)
    assert (found.status, found.y.shape[0]) == (1, 2)
    np.testing.assert_allclose(found.y[0, -1], 0.3, atol=1e-9)
    event.direction = np.float64(1)
    assert ours((0.0, 2.0), "TypeII", events=event, shape=1).status == 0


@pytest.mark.slow
def test_bodies_are_raveled():
    problem = systems.n_body()
    y0 = np.concatenate([np.ravel(problem.q0), np.ravel(problem.p0)])
    found = interop.solve_ivp(problem, (0.0, 0.1), y0, "Strang", h=0.01)
    assert found.y.shape == (12, 11)
    run = {"h": 0.01, "num_steps": 10, "args": problem.args, "method": dvi.Strang()}
    sol = dvi.integrate(problem.system, problem.q0, problem.p0, **run)
    np.testing.assert_allclose(found.y[:6, -1].reshape(3, 2), sol.qs[-1], rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match="shape"):
        interop.solve_ivp(problem, (0.0, 0.1), y0[:-2], "Strang", h=0.01)


def unit():
    return pytest.importorskip("astropy.units").min


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"rtol": 1e-3}, TypeError, "'rtol'. The size of the steps is fixed"),
        ({"dense_output": True}, TypeError, "t_eval"),
        ({"vectorized": True}, TypeError, "vmap"),
        ({"jac": None}, TypeError, "autodiff"),
        ({"foo": 1}, TypeError, "foo"),
        ({"method": "RK45"}, ValueError, "KahanLi8"),
        ({"t_eval": [0.0, 2.0]}, ValueError, "within t_span"),
        ({"t_eval": [0.5, 0.2]}, ValueError, "strictly increasing"),
        ({"events": 3}, TypeError, "event"),
        ({"events": marked(lambda t, y: y[0], terminal=-1)}, ValueError, "terminal"),
        ({"h": -0.1}, ValueError, "t_span gives the direction"),
        ({"h": [0.1, 0.1]}, ValueError, r"positive and finite .*, got \[0.1, 0.1\]"),
        ({"t_eval": unit}, TypeError, "has the unit 'min'"),
        ({"h": unit}, TypeError, "has the unit 'min'"),
    ],
    ids=lambda x: "",
)
def test_wrong_arguments(options, error, words):
    options = {name: [0, 0.01] * x() if x is unit else x for name, x in options.items()}
    with pytest.raises(error, match=words):
        ours((0.0, 1.0), **options)


def test_wrong_times_and_states():
    for t_span in ((0.0, 0.0), (0.0, np.inf), 1.0):
        with pytest.raises(ValueError, match="t_span"):
            ours(t_span)
    with pytest.raises(ValueError, match="all of q0 and then all of p0"):
        interop.solve_ivp(KEPLER, (0, 1), [1.0, 2.0, 3.0], h=0.1)
    with pytest.raises(TypeError, match=r"dvi\.System"):
        interop.solve_ivp(rate, (0, 1), Y0, h=0.1)
    with pytest.raises(TypeError, match="y0 has the unit 'min'"):
        interop.solve_ivp(SYSTEM, (0, 1), Y0 * unit(), h=0.1, args=K)


@pytest.mark.parametrize("t_span", [(3.0, 1 / 3), (0.1, 7.3)])
@pytest.mark.slow
def test_both_ends_are_those_of_t_span(t_span):
    """Although t0 + N h' differs from t1 by round-off."""
    found = interop.solve_ivp(SYSTEM, t_span, Y0, "TypeII", h=0.013, epsilon=0.0, args=K)
    assert (found.t[0], found.t[-1]) == t_span
    times = np.linspace(*t_span, 7)
    at = interop.solve_ivp(SYSTEM, t_span, Y0, "TypeII", h=0.013, epsilon=0.0, args=K, t_eval=times)
    assert at.status == 0
    np.testing.assert_array_equal(at.t, times)
    np.testing.assert_allclose(at.y[:, -1], found.y[:, -1], rtol=0, atol=1e-13)


@pytest.mark.slow
def test_events_with_default_values_and_with_args():
    """A default value of the third parameter is its own, unless it is called args."""
    events = [
        *(lambda t, y, c=c: y[0] - c for c in (0.0, 0.3)),
        lambda t, y, args: y[0] - (args - 1),
        lambda t, y, args=None: y[0] - (args - 1),
        lambda t, y, *rest: y[0] - (rest[0] - 1),
    ]
    states = ours((0.0, 3.0), "TypeII", events=events).y_events
    for level, state in zip((0.0, 0.3, 0.3, 0.3, 0.3), states, strict=True):
        np.testing.assert_allclose(state[:, 0], [level], rtol=0, atol=1e-9)
