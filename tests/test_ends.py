"""Runs that end early, and evaluations between the steps: gradients and statuses."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference

import dvi_jax as dvi

ADJOINTS = dvi.Reversible(), dvi.Checkpointed(), dvi.Direct()
OSCILLATOR = dvi.System(dvi.discretise(lambda t, q, p, k: p @ p / 2 + k * q @ q / 2))
# ∇H_D is NaN for q < 0, where H_D is NaN.
HALF = dvi.System(lambda t0, t1, q, p, k: p @ p / 2 + k * jnp.sum(jnp.sqrt(q)))
FREE = dvi.System(lambda t0, t1, q, p, args: p @ p / 2)
STARTS = jnp.array([[1.0], [0.2], [2.0]])


def of_batch(system, k, adjoint, num_steps, **options):
    def run(q):
        options_of_all = {"h": 0.05, "num_steps": num_steps, "args": k, "throw": False}
        return dvi.integrate(system, q, 0 * q, adjoint=adjoint, **options_of_all, **options)

    return jax.vmap(run)(STARTS)


def stopped(k, adjoint, num_steps):
    """Of three trajectories one ends at q = 0.3 after 25 steps, one at its start."""
    end = dvi.Stop(lambda t, q, p, args: 0.3 - q[0])
    method, save = dvi.Strang(), dvi.Save(every=3)
    return of_batch(OSCILLATOR, k, adjoint, num_steps, stop=end, method=method, save=save)


def of_time(k, *run):
    t = stopped(k, *run).stop.t
    return jnp.sum(jnp.where(jnp.isfinite(t), t, 0.0))


def of_states(k, *run):
    q = stopped(k, *run).qs
    return jnp.sum(jnp.where(jnp.isfinite(q), q, 0.0))


def failed(k, adjoint, omits):
    """The second of three trajectories fails in its step 12."""
    sol = of_batch(HALF, k, adjoint, 30, save=dvi.Save(every=3), observe=lambda q, p: q[0] ** 2)
    values = sol.qs[:, :, 0] + sol.observed
    good = sol.result == dvi.RESULTS.successful
    kept = {"trajectories": good[:, None], "values": jnp.isfinite(values), "none": True}[omits]
    return jnp.sum(jnp.where(kept, values, 0.0))


@pytest.mark.slow
@pytest.mark.parametrize("loss", [of_time, of_states])
@pytest.mark.parametrize("adjoint", ADJOINTS[1:], ids=lambda a: type(a).__name__)
def test_gradients_of_runs_that_stop(loss, adjoint):
    function = jax.jit(lambda k: loss(k, adjoint, 27))
    assert int(jnp.sum(stopped(1.0, adjoint, 27).result == dvi.RESULTS.stopped)) == 2
    reverse = jax.jit(jax.grad(function))(1.0)
    np.testing.assert_allclose(reverse, jax.jit(jax.jacfwd(function))(1.0), rtol=1e-10)
    np.testing.assert_allclose(reverse, central_difference(function, 1.0, 1.0), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("loss", [of_time, of_states])
def test_second_derivatives_of_runs_that_stop(loss):
    function = lambda k: loss(k, dvi.Direct(), 27)  # noqa: E731
    slope = jax.jit(jax.grad(function))
    for second in (jax.jacfwd(jax.grad(function)), jax.grad(jax.grad(function))):
        np.testing.assert_allclose(
            jax.jit(second)(1.0), central_difference(slope, 1.0, 1.0), rtol=1e-6
        )


@pytest.mark.slow
@pytest.mark.parametrize("omits", ["trajectories", "values", "none"])
@pytest.mark.parametrize("adjoint", ADJOINTS, ids=lambda a: type(a).__name__)
def test_gradients_of_a_batch_in_which_one_fails(omits, adjoint):
    function = jax.jit(lambda k: failed(k, adjoint, omits))
    reverse = jax.jit(jax.grad(function))(1.0)
    if omits == "none":  # NaN is not hidden where the loss uses it
        assert np.isnan(reverse)
    else:
        np.testing.assert_allclose(reverse, central_difference(function, 1.0, 1.0), rtol=1e-6)


# --- statuses -----------------------------------------------------------------------------------


def away_from(place):
    """A flow that is not defined in a small interval of q."""

    def flow(h, q, p, args):
        q1 = q + h * p
        return jnp.where(jnp.abs(q1 - place) < 0.02, jnp.nan, q1), p

    free = lambda t0, t1, q0, p1, args: jnp.sum(p1**2) / 2  # noqa: E731
    weak = lambda t0, t1, q0, p1, args: 0.01 * jnp.sum(q0**2) / 2  # noqa: E731
    return free, weak, flow


def run(place, first, **options):
    free, weak, flow = away_from(place)
    flows = {free: flow, weak: None}
    parts = [free, weak] if first else [weak, free]
    system = dvi.System(dvi.Split(parts, flows=[flows[part] for part in parts]))
    return dvi.integrate(system, [0.0], [1.0], h=0.1, num_steps=10, throw=False, **options)


@pytest.mark.parametrize("options", [{}, {"save": dvi.Save(every=5)}, {"observe": {"q": "range"}}])
def test_a_flow_that_closes_a_joined_step_and_fails(options):
    if "observe" in options:  # reductions read every state: no steps are joined
        options = {"observe": {"q": dvi.Range(lambda q, p: q[0])}}
    sol = run(0.5, first=True, **options)
    assert sol.status == "not_finite"
    assert sol.stats["failed_step"] == 4
    has_failed = np.asarray(sol.ts) > 0.45
    np.testing.assert_array_equal(np.isnan(sol.qs[:, 0]), has_failed)


@pytest.mark.slow
def test_points_between_the_steps_that_fail():
    saved = run(0.55, first=False, save=dvi.Save(ts=[0.3, 0.55, 0.8]))
    assert saved.status == "not_finite"
    np.testing.assert_array_equal(np.isnan(saved.qs[:, 0]), [False, True, False])
    crossed = run(0.55, first=False, observe=dvi.Section(lambda t, q, p, args: q[0] - 0.55))
    ended = run(0.55, first=False, stop=dvi.Stop(lambda t, q, p, args: q[0] - 0.55))
    assert crossed.status != "successful"
    assert ended.status != "stopped"
    # The controls: the same points where the flow is defined.
    far = {"first": False, "save": dvi.Save(ts=[0.3, 0.55, 0.8])}
    assert run(2.0, **far).status == "successful"
    assert (
        run(2.0, first=False, stop=dvi.Stop(lambda t, q, p, args: q[0] - 0.55)).status == "stopped"
    )


class Unjudged(dvi.Strang):
    """A method of a user that reports success, also where its state is not finite."""

    value: float = np.nan
    fails: str = "last step"

    def step(self, equations, interval, q0, p0):
        q, p, info = super().step(equations, interval, q0, p0)
        is_short = jnp.abs(interval.h) < 0.099
        has_failed = is_short if self.fails == "part of a step" else interval.t1 > 0.95
        return jnp.where(has_failed, self.value, q), p, info


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_method_that_does_not_report_its_failures(value):
    def go(fails, **options):
        run = {"method": Unjudged(value=value, fails=fails), "h": 0.1, "num_steps": 10}
        return dvi.integrate(FREE, [0.0], [1.0], throw=False, **run, **options)

    last = go("last step")
    assert (last.status, int(last.stats["failed_step"])) == ("not_finite", 9)
    assert go("part of a step").status == "successful"  # the control: whole steps are good
    for options in (
        {"save": dvi.Save(ts=[0.25])},
        {"stop": dvi.Stop(lambda q, p: q[0] - 0.25)},
        {"observe": dvi.Section(lambda q, p: q[0] - 0.25)},
    ):
        assert go("part of a step", **options).status == "not_finite"


@pytest.mark.slow
@pytest.mark.parametrize("h", [0.1, -0.1])
def test_an_event_that_is_nan(h):
    def g(t, q, p, args):
        return jnp.sqrt(0.5 - jnp.abs(q[0])) - 0.4

    def go(**options):
        return dvi.integrate(FREE, [0.0], [1.0], h=h, num_steps=10, throw=False, **options)

    sol = go(stop=dvi.Stop(lambda *point: g(*point) - 1))
    assert sol.status == "event_not_finite"
    assert sol.stats["failed_step"] == 5
    sol = go(observe=dvi.Section(g, 0))
    assert sol.status == "event_not_finite"
    np.testing.assert_allclose(sol.observed.ts[0], 0.34 * np.sign(h))
    with pytest.raises(dvi.IntegrationError, match="The function g of"):
        dvi.integrate(FREE, [0.0], [1.0], h=h, num_steps=10, observe=dvi.Section(g, 0))


def slow(value):
    return pytest.param(value, marks=pytest.mark.slow)


def name_of(value):
    return type(value).__name__


# What a run computes after its loop, between the steps and at the start. The times that a clock
# moves are not those of the steps, where the state between the steps has a kink.
BETWEEN = {
    "times": {"save": dvi.Save(ts=[0.3, 0.55]), "observe": lambda t, q, p, k: k * q[0] ** 2},
    "clock": {"save": dvi.Save(ts=[0.32, 0.57], clock=lambda t, q, p, k: k * t)},
    "section": {"observe": dvi.Section(lambda t, q, p, k: t + k - 1.32)},
    "stop": {"stop": dvi.Stop(lambda t, q, p, k: t + k - 1.32)},
    "start": {"observe": lambda t, q, p, k: k * q[0] ** 2},
}
# The second of three trajectories has no step: (q0, h) and the power of q in H_D.
WITHOUT_STEPS = {
    "q0 is NaN": (np.nan, 0.05),
    "h is NaN": (0.2, np.nan),
    "∇H_D is NaN": (-0.2, 0.05),
}


@pytest.mark.slow
@pytest.mark.parametrize("fails", ["q0 is NaN", *map(slow, [*WITHOUT_STEPS][1:])])
@pytest.mark.parametrize("name", ["times", *map(slow, [*BETWEEN][1:])])
@pytest.mark.parametrize("adjoint", [ADJOINTS[1], slow(ADJOINTS[0])], ids=name_of)
def test_a_trajectory_without_a_step_and_shared_gradients(adjoint, name, fails):
    """Its derivatives are not those of the others, which have points between the steps."""
    q, h = (jnp.array([a, b, a]) for a, b in zip((1.0, 0.05), WITHOUT_STEPS[fails], strict=True))

    def run(k, q, h):
        options = {"h": h, "num_steps": 12, "args": k, "throw": False, "adjoint": adjoint}
        return dvi.integrate(HALF, q[None], 0 * q[None], **options, **BETWEEN[name])

    def loss(k):
        sol = jax.vmap(run, (None, 0, 0))(k, q, h)
        values = [sol.qs, sol.observed, sol.stop.t if sol.stop else 0.0]
        leaves = [x for x in map(jnp.asarray, jax.tree.leaves(values)) if x.dtype.kind == "f"]
        return sum(jnp.sum(jnp.where(jnp.isfinite(x), x, 0.0)) for x in leaves)

    function = jax.jit(loss)
    reverse = jax.jit(jax.grad(loss))(1.0)
    np.testing.assert_allclose(reverse, central_difference(function, 1.0, 1.0), rtol=1e-5)


# Divisions and roots of args, at the start of the run and in each step.
OF_ARGS = {
    "quotient": {"stop": dvi.Stop(lambda t, q, p, a: 0.1 + a / 3 - q[0])},
    "root": {"stop": dvi.Stop(lambda t, q, p, a: jnp.sqrt(a) / 2 - q[0])},
    "drift": {"observe": dvi.MaxDrift(lambda t, q, p, a: p @ p / a + a / 3)},
    "section": {"observe": dvi.Section(lambda t, q, p, a: p[0] + 1 / a, direction=0)},
}


@pytest.mark.parametrize("name", ["quotient", *map(slow, [*OF_ARGS][1:])])
def test_divisions_of_numbers_that_do_not_change(name):
    """A number that is computed before the loop is not one that a step carries to the next."""

    def run(q, a, form):
        options = {"h": 0.05, "num_steps": 30, "throw": False, "save": dvi.Save(every=3)}
        layout = dvi.Layout(form=form)
        method = dvi.Strang()
        return dvi.integrate(
            OSCILLATOR, q, 0 * q, args=a, method=method, layout=layout, **options, **OF_ARGS[name]
        )

    batch = jax.vmap(run, (0, 0, None))
    results = (batch(STARTS, jnp.array([1.0, 1.1, 1.2]), form) for form in ("auto", "arrays"))
    for a, b in zip(*map(jax.tree.leaves, results), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.parametrize(
    "adjoint", [dvi.Direct(), *(pytest.param(x, marks=pytest.mark.slow) for x in (
        dvi.Checkpointed(), dvi.Reversible()))],
)  # fmt: skip
def test_observables_of_an_invalid_start_have_no_derivative(adjoint):
    """Those of the state begin at the initial one. It, or a parameter, may be NaN or infinite."""
    system = dvi.System(lambda t0, t1, q, p, a: a["m"] * p @ p / 2 + a["k"] * q @ q / 2)
    q = jnp.array([[0.5], [np.nan], [0.5], [0.5]])
    p = jnp.array([[0.3], [0.3], [np.inf], [0.3]])
    m = jnp.array([1.0, 1.0, 1.0, np.nan])

    def energy(t, q, p, a):
        return a["m"] * p @ p / 2 + a["k"] * q @ q

    @jax.jit
    @functools.partial(jax.grad, argnums=(0, 1))
    def gradient(z, k):
        def one(q, p, m):
            sol = dvi.integrate(
                system, q, p, args={"k": k, "m": m}, h=0.1, num_steps=2, adjoint=adjoint,
                observe=(dvi.Mean(energy), energy), save=dvi.Save(final=True), throw=False,
            )  # fmt: skip
            mean, values = sol.observed
            ok = sol.result == dvi.RESULTS.successful
            return jnp.where(ok, mean + jnp.sum(values), 0.0)

        return jnp.sum(jax.vmap(one)(*z))

    own, of_k = gradient((q, p, m), 2.0)
    assert of_k > 0.1
    for slope in own:
        np.testing.assert_array_equal(slope[1:], 0)
        assert abs(jnp.ravel(slope)[0]) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ADJOINTS, ids=lambda a: type(a).__name__)
def test_an_observable_that_is_nan_at_a_valid_state_has_no_derivative(adjoint):
    """The explicit step leaves the domain of H; the next one fails, and the loss omits the run."""

    def energy(t, q, p, k):
        return p @ p / 2 + k * jnp.sum(jnp.sqrt(q))

    def loss(k):
        observe = dvi.MaxDrift(energy), energy
        sol = of_batch(HALF, k, adjoint, 30, save=dvi.Save(every=3), observe=observe)
        good = sol.result == dvi.RESULTS.successful
        total = sol.observed[0] + jnp.sum(sol.observed[1], axis=1)
        return jnp.sum(jnp.where(good, total, 0.0)), good

    slope, good = jax.jit(jax.grad(loss, has_aux=True))(1.0)
    assert list(good) == [True, False, True]
    values = [jax.jit(loss)(k)[0] for k in (1 + 1e-5, 1 - 1e-5)]
    np.testing.assert_allclose(slope, (values[0] - values[1]) / 2e-5, rtol=1e-7)


def test_a_loss_that_uses_nan_has_no_number_as_gradient_by_closed_over_values():
    """Zero, the derivative of a failed step, would hide that the loss is not a number."""

    @jax.jit
    @jax.grad
    def slope(k, start, uses_end):
        system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + k * jnp.sqrt(q[0]))
        how = {"h": 0.1, "num_steps": 1, "adjoint": dvi.Direct(), "throw": False}
        q = dvi.integrate(system, start, 0 * start + 0.1, **how).qs[-1, 0]
        return jnp.where(uses_end | jnp.isfinite(q), q, 0.0)

    failing, good = jnp.array([-0.2]), jnp.array([0.2])
    assert jnp.isnan(slope(1.0, failing, True))
    assert slope(1.0, failing, False) == 0
    assert abs(slope(1.0, good, True)) > 1e-3


# Values that a run does not have: the loss uses one of the trajectory that has no such value.
MISSING = {
    "stop": ({"stop": dvi.Stop(lambda q, p: 0.4 - q[0])}, lambda sol: sol.stop.q[0]),
    "time": ({"stop": dvi.Stop(lambda q, p: 0.4 - q[0])}, lambda sol: sol.stop.t),
    "section": (
        {"observe": dvi.Section(lambda q, p: q[0] - 0.4, 0)},
        lambda s: s.observed.qs[0, 0],
    ),
    "requested": ({"save": dvi.Save(ts=[0.4, 1.2])}, lambda sol: sol.qs[1, 0]),
    "state": ({}, lambda sol: sol.qs[-1, 0]),
    "observed": ({"observe": lambda t, q, p, k: k * q[0]}, lambda sol: sol.observed[-1]),
    "root": ({"observe": lambda q, p: jnp.sqrt(q[0] - 0.1)}, lambda sol: sol.observed[5]),
    "mean": ({"observe": dvi.Mean(lambda q, p: jnp.sqrt(q[0] - 0.1))}, lambda sol: sol.observed),
    "infinite": ({"observe": lambda q, p: jnp.exp(1e4 * p[0] ** 2)}, lambda sol: sol.observed[20]),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "form"), [*((n, "auto") for n in MISSING), ("stop", "arrays")])
@pytest.mark.parametrize("adjoint", ADJOINTS, ids=name_of)
def test_a_value_that_does_not_exist_has_no_number_as_derivative(adjoint, name, form):
    """In reverse and forward mode, of its own trajectory only, and of none if it is left out."""
    options, value_of = MISSING[name]
    k = jnp.array([1.0, np.nan, 1.1, 0.2])
    q = jnp.array([1.0, 1.0, 0.05, 0.05 if name in ("root", "mean") else 3.0])

    def value(k, q, omits):
        run = {"h": 0.05, "num_steps": 24, "throw": False, "args": k, "adjoint": adjoint}
        layout = dvi.Layout(form=form)
        x = value_of(
            dvi.integrate(OSCILLATOR, q[None], 0 * q[None], layout=layout, **run, **options)
        )
        return jnp.where(jnp.isfinite(x) | ~omits, x, 0.0)

    plain = jax.jit(jax.vmap(value, (0, 0, None)))(k, q, False)
    has_value = np.isfinite(np.asarray(plain))
    assert has_value.any()
    assert not has_value[1]
    for mode in (jax.grad, jax.jacfwd):
        slopes = jax.jit(jax.vmap(mode(value, (0, 1)), (0, 0, None)))
        for used, omitted in zip(slopes(k, q, False), slopes(k, q, True), strict=True):
            np.testing.assert_array_equal(np.isfinite(used), has_value)
            np.testing.assert_array_equal(omitted[~has_value], 0)
            np.testing.assert_array_equal(omitted[has_value], used[has_value])
    # The derivatives of the others in the batch.
    batch = jax.vmap(value, (0, 0, None))
    of_all = jax.jit(jax.grad(lambda k: jnp.sum(batch(k, q, False))))(k)
    expected = slopes(k, q, False)[0]
    np.testing.assert_allclose(of_all, expected, rtol=1e-9, atol=1e-12)
    near = [jax.jit(batch)(k + d, q, False) for d in (1e-5, -1e-5)]
    np.testing.assert_allclose(
        np.where(has_value, (near[0] - near[1]) / 2e-5, 0), np.where(has_value, expected, 0),
        rtol=1e-5, atol=1e-6 * float(np.nanmax(np.abs(plain[has_value]))),
    )  # fmt: skip
