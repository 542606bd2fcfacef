"""`integrate`: what it saves and observes, its failures, and the input that it rejects."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import SYSTEMS, non_separable

import dvi_jax as dvi
from dvi_jax.base import machine as _memory


def H(t0, t1, q0, p1, args):
    return (jnp.sum(p1**2) + jnp.sum(q0**2)) / 2


OSCILLATOR = dvi.System(H, force=lambda t0, t1, q0, p1, args: -q0, epsilon=0.0)
NON_SEPARABLE = dvi.System(non_separable)
START = ([0.3, 0.1], [0.4, -0.2])
FINAL = dvi.Save(final=True)


def run(**kwargs):
    return dvi.integrate(OSCILLATOR, *START, **{"h": 0.1, "num_steps": 23, **kwargs})


def position(t0, t1, q0, p0, q1, p1, args):
    return q1


def energy(t0, t1, q0, p0, q1, p1, args):
    return H(t1, t1, q1, p1, args)


@pytest.mark.parametrize(
    ("save", "kept"),
    [
        (dvi.Save(), range(24)),
        (dvi.Save(every=5), [0, 5, 10, 15, 20]),
        (dvi.Save(every=5, final=True), [0, 5, 10, 15, 20, 23]),
        (dvi.Save(every=23, final=True), [0, 23]),
        (FINAL, [0, 23]),
        (dvi.Save(every=40), [0]),
    ],
)
def test_save_policies(save, kept):
    full, sol = run(), run(save=save, observe=position)
    kept = np.array(kept)
    np.testing.assert_array_equal(sol.ts, full.ts[kept])
    np.testing.assert_allclose(sol.qs, full.qs[kept], rtol=1e-14)
    np.testing.assert_allclose(sol.ps, full.ps[kept], rtol=1e-14)
    np.testing.assert_array_equal(sol.hs, np.full(len(kept) - 1, 0.1))
    np.testing.assert_array_equal(sol.observed, sol.qs[1:])


def test_no_steps_returns_the_start():
    sol = run(num_steps=0, t0=2.0, observe={"last": dvi.Last(position), "all": position})
    np.testing.assert_array_equal(sol.ts, [2.0])
    np.testing.assert_array_equal(sol.qs, [START[0]])
    assert sol.observed["all"].shape == (0, 2)
    assert np.isnan(sol.observed["last"]).all()  # without a step there is no value
    assert sol.status == "successful"


@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 3)])
def test_states_of_any_shape(shape):
    q, p = np.full(shape, 0.3), np.full(shape, 0.4)
    one = dvi.integrate(NON_SEPARABLE, 0.3, 0.4, h=0.1, num_steps=5)
    sol = dvi.integrate(NON_SEPARABLE, q, p, h=0.1, num_steps=5)
    assert sol.qs.shape == (6, *shape)
    expected = np.broadcast_to(np.reshape(one.qs, (6, *(1 for _ in shape))), sol.qs.shape)
    np.testing.assert_allclose(sol.qs, expected, rtol=1e-14)


def test_late_times_and_invariants_do_not_accumulate_round_off():
    sol = run(num_steps=10_000, t0=5.0, save=dvi.Save(every=1000))
    np.testing.assert_array_equal(sol.ts, 5.0 + 0.1 * np.arange(0, 10_001, 1000))
    assert np.cumsum(np.full(10_000, 0.1))[-1] != 1000.0  # a running sum would
    # h reaches the step as it is, not as a difference of large times.

    def invariant(t0, t1, q0, p0, q1, p1, args):
        return jnp.sum(p1**2 + q1**2 - 0.1 * q1 * p1) / 2

    observe = {"range": dvi.Range(invariant), "mean": dvi.Mean(invariant)}
    sol = run(num_steps=10_000, t0=1e6, observe=observe, save=FINAL)
    assert sol.observed["range"] / sol.observed["mean"] < 5e-14


@pytest.mark.slow
def test_given_times():
    """Equal ones are the uniform grid; unequal ones against the map by hand."""
    a = run(epsilon=0.1)
    b = dvi.integrate(OSCILLATOR, *START, lattice=dvi.Given(0.1 * np.arange(24)), epsilon=0.1)
    np.testing.assert_allclose(a.qs, b.qs, atol=1e-14)
    np.testing.assert_allclose(b.hs, np.full(23, 0.1), atol=1e-14)
    ts = np.array([0.0, 0.1, 0.4, 0.45, 1.0])
    sol = dvi.integrate(OSCILLATOR, *START, lattice=dvi.Given(ts))
    q, p = np.array(START)
    for k, h in enumerate(np.diff(ts)):
        p = p - h * q
        q = q + h * p
        np.testing.assert_allclose(sol.qs[k + 1], q, rtol=1e-14)
    np.testing.assert_array_equal(sol.ts, ts)
    kepler, ts = dvi.systems.kepler(), np.array([0.0, 0.1, 0.3])
    assert dvi.integrate(kepler, lattice=dvi.Given(ts)).ts.tolist() == ts.tolist()
    whole = dvi.integrate(OSCILLATOR, *START, lattice=dvi.Given([0, 1, 2]))
    np.testing.assert_array_equal(whole.hs, [1.0, 1.0])


@pytest.mark.slow
def test_reductions_equal_numpy_on_the_full_record():
    record = run(observe={"q": position, "E": energy}, epsilon=0.2)
    E, q, t = record.observed["E"], record.observed["q"], record.ts[1:]
    observe = {
        "drift": dvi.MaxDrift(energy),
        "range": dvi.Range(energy),
        "trend": dvi.Trend(energy),
        "mean": [dvi.Mean(energy), dvi.Mean(position)],
        "last": dvi.Last(position),
    }
    sol = run(observe=observe, epsilon=0.2, save=dvi.Save(every=7))
    np.testing.assert_allclose(sol.observed["drift"], np.max(np.abs(E - E[0])), rtol=1e-13)
    np.testing.assert_allclose(sol.observed["range"], np.ptp(E), rtol=1e-13)
    np.testing.assert_allclose(sol.observed["trend"], np.polyfit(t, E, 1)[0], rtol=1e-9)
    np.testing.assert_allclose(sol.observed["mean"][0], np.mean(E), rtol=1e-13)
    np.testing.assert_allclose(sol.observed["mean"][1], np.mean(q, axis=0), rtol=1e-12)
    np.testing.assert_array_equal(sol.observed["last"], q[-1])


def test_observables_of_a_step():

    def seen(t0, t1, q0, p0, q1, p1, args):
        return jnp.stack([t0, t1, q0[0], p0[0], q1[0], p1[0], args["a"]])

    sol = run(observe=seen, save=dvi.Save(every=5), args={"a": 3.0})
    full = run()
    for row, k in zip(sol.observed, [5, 10, 15, 20], strict=True):
        expected = [full.ts[k - 1], full.ts[k], full.qs[k - 1, 0], full.ps[k - 1, 0]]
        np.testing.assert_allclose(row, [*expected, full.qs[k, 0], full.ps[k, 0], 3.0], rtol=1e-13)

    def right(t0, t1, q0, p0, q1, p1, args):
        return q1[0] > 0

    sol = run(observe=[right, dvi.Mean(right), dvi.Last(right)])
    assert sol.observed[0].dtype == bool
    np.testing.assert_allclose(sol.observed[1], np.mean(sol.observed[0]), rtol=1e-14)
    assert sol.observed[2] == sol.observed[0][-1]


@pytest.mark.slow
@pytest.mark.parametrize(("form", "few"), [("arrays", 100), ("auto", 1000)])
def test_streamed_reductions_need_no_memory_for_the_steps(form, few):
    def size(n):
        def final(q):
            how = {"save": FINAL, "observe": dvi.Range(energy), "layout": dvi.Layout(form=form)}
            return dvi.integrate(OSCILLATOR, q, q, h=0.1, num_steps=n, **how).observed

        compiled = jax.jit(final).lower(jnp.ones(2)).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    assert size(1000 * few) <= size(few) + 1024


@pytest.mark.slow
def test_batch_equals_loop_and_jit_equals_eager():
    """Of the other methods `test_certify.py` tests it."""
    system, q, p = SYSTEMS["double_pendulum"]

    def final(e):
        how = {"epsilon": e, "method": dvi.Strang(), "save": dvi.Save(every=10)}
        return dvi.integrate(system, q, p, h=0.1, num_steps=20, **how).qs

    es = jnp.array([0.0, 0.1, 0.2])
    together = jax.vmap(final)(es)
    np.testing.assert_allclose(together, jnp.stack([final(e) for e in es]), rtol=1e-12)
    assert np.max(np.abs(together[0] - together[2])) > 1e-3  # ε does something
    # Under jit the start is a constant that the compiler may fold: equal up to a rounding.
    np.testing.assert_allclose(jax.jit(final)(es[1]), final(es[1]), rtol=1e-14, atol=1e-16)


@pytest.mark.slow
def test_one_trace_per_shape_and_of_each_step():
    traces = []

    def counted(t0, t1, q0, p1, args):
        traces.append(1)
        return H(t0, t1, q0, p1, args)

    system = dvi.System(counted, force=lambda t0, t1, q0, p1, args: -q0)

    def go(q, h, epsilon, a):
        seen = len(traces)
        dvi.integrate(system, q, q, h=h, num_steps=5, epsilon=epsilon, args={"a": a})
        return len(traces) - seen

    assert go(np.ones(2), 0.1, 0.0, 1.0) > 1
    assert go(np.zeros(2), 0.2, 0.5, 2.0) <= 1  # the check of shapes
    assert go(np.ones(3), 0.1, 0.0, 1.0) > 1
    # For a forward run and for its gradient; H_D once for its shape and once for each half.
    calls = []

    def H_D(t0, t1, q0, p1, args):
        calls.append(1)
        return non_separable(t0, t1, q0, p1, args)

    system = dvi.System(H_D)

    def end(q, p):
        return dvi.integrate(system, q, p, h=0.1, num_steps=10, throw=False).qs[-1].sum()

    q = jnp.linspace(0.1, 0.4, 4)[:, None]
    jax.jit(jax.vmap(end))(q, q)
    assert len(calls) == 3
    jax.jit(jax.vmap(jax.grad(end)))(q, q)
    assert len(calls) <= 5  # newer releases of JAX use the trace of the forward run
    before = len(calls)
    for _ in range(3):  # alone, and again: the run is compiled once, and H_D is not called again
        dvi.integrate(system, q[0], q[0], h=0.1, num_steps=10)
    assert len(calls) <= before + 2


@pytest.mark.slow
def test_progress_reports_and_changes_nothing():
    calls = []
    kwargs = {
        "num_steps": 1037,
        "save": dvi.Save(every=5, final=True),
        "observe": [energy, dvi.Trend(energy)],
        "epsilon": 0.1,
    }
    plain = run(**kwargs)
    reported = run(**kwargs, progress=lambda done, total: calls.append((done, total)))
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(reported), strict=True):
        np.testing.assert_array_equal(a, b)
    assert 10 < len(calls) <= 101
    assert calls[-1] == (1037, 1037)
    assert [c[0] for c in calls] == sorted({c[0] for c in calls})


@pytest.mark.slow
def test_the_state_sets_the_precision():
    q, p = jnp.float32([0.3]), jnp.float32([0.4])
    sol = dvi.integrate(NON_SEPARABLE, q, p, h=0.01, num_steps=100)
    reference = dvi.integrate(NON_SEPARABLE, [0.3], [0.4], h=0.01, num_steps=100)
    assert sol.qs.dtype == sol.ts.dtype == jnp.float32
    np.testing.assert_allclose(sol.qs, reference.qs, atol=2e-5)
    force = dvi.System(H, force=lambda t0, t1, q0, p1, args: -args["k"] * q0)
    double = {"lattice": dvi.Given(np.linspace(0, 1, 11)), "args": {"k": np.array(1.0)}}
    sol = dvi.integrate(force, q, q, epsilon=0.1, **double)
    assert sol.qs.dtype == sol.ts.dtype == jnp.float32


@pytest.mark.slow
def test_failures_are_named_and_keep_the_states_before():
    match = r"step 0 of 10 .*residual .*did not converge"
    with pytest.raises(dvi.IntegrationError, match=match) as e:
        dvi.integrate(NON_SEPARABLE, [3.0], [4.0], h=10.0, num_steps=10)
    assert e.value.solution.status == "not_converged"
    assert float(e.value.solution.stats["failed_residual"]) > 1e-6
    lattice = dvi.Given(np.array([0.0, 0.001, 10.0]))
    with pytest.raises(dvi.IntegrationError, match=r"step 1 of 2 .*h = 9.999"):
        dvi.integrate(NON_SEPARABLE, [3.0], [4.0], lattice=lattice)
    # H = p²/2 + √(1/2 − q) ends at q = 1/2: the orbit until then is there, the rest is NaN.
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + jnp.sum(jnp.sqrt(0.5 - q)))
    how = {"h": 0.2, "num_steps": 9, "observe": dvi.Range(energy)}
    sol = dvi.integrate(system, [0.0], [1.0], throw=False, **how)
    assert sol.status == "not_finite"
    k = int(sol.stats["failed_step"])
    assert 0 < k < 8
    assert np.isfinite(sol.qs[: k + 1]).all()
    assert np.isnan(sol.qs[k + 1 :]).all()
    assert np.isnan(sol.observed)
    with pytest.raises(dvi.IntegrationError, match=rf"step {k} of 9 .*NaN or infinite"):
        dvi.integrate(system, [0.0], [1.0], **how)


@pytest.mark.slow
def test_a_failed_trajectory_leaves_the_others_of_a_batch_unchanged():
    def go(h):
        return dvi.integrate(NON_SEPARABLE, [3.0], [4.0], h=h, num_steps=10, throw=False)

    hs = jnp.array([0.001, 10.0, 0.002])
    sols = jax.vmap(go)(hs)
    assert list(sols.status) == ["successful", "not_converged", "successful"]
    np.testing.assert_array_equal(sols.result == dvi.RESULTS.successful, [True, False, True])
    np.testing.assert_array_equal(sols.stats["failed_step"], [-1, 0, -1])
    for i in (0, 2):
        np.testing.assert_allclose(sols.qs[i], go(hs[i]).qs, rtol=1e-14)
    assert np.isnan(sols.qs[1, 1:]).all()
    gradients = jax.vmap(jax.grad(lambda h: go(h).qs[-1, 0]))(hs)
    np.testing.assert_array_equal(np.isfinite(gradients), [True, False, True])


def test_failures_in_a_batch_are_an_error_or_a_status():

    def go(h):
        return dvi.integrate(NON_SEPARABLE, [3.0], [4.0], h=h, num_steps=10).qs

    with pytest.raises(Exception, match="did not converge"):
        jax.block_until_ready(jax.vmap(go)(jnp.array([0.001, 10.0])))

    def solve(q, h):
        return dvi.integrate(OSCILLATOR, [q], [0.1], h=h, num_steps=3, throw=False)

    q, h = jnp.array([0.3, 0.3, 0.3, jnp.nan]), jnp.array([0.1, 0.0, jnp.inf, 0.1])
    expected = ["successful", "bad_step_size", "bad_step_size", "not_finite"]
    assert list(jax.vmap(solve)(q, h).status) == expected


@pytest.mark.slow
def test_a_light_body_is_solved_for_as_well_as_alone():
    """Newton's test is made for each component: momenta of 1e-12 next to momenta of 1."""

    def H(t0, t1, q, p, m):
        return jnp.sum(p**2 / (2 * m)) + jnp.sum(m * q**2) / 2

    def drag(t0, t1, q, p, m):
        return -p * jnp.abs(p) / m * (m < 1)

    system, m = dvi.System(H, force=drag), np.array([1.0, 1e-12])
    how = {"h": 0.1, "num_steps": 100, "epsilon": 1.0}
    both = dvi.integrate(system, [1.0, 1.0], m, args=m, **how)
    alone = dvi.integrate(system, [1.0], m[1:], args=m[1:], **how)
    np.testing.assert_allclose(both.ps[:, 1], alone.ps[:, 0], rtol=1e-12)


def test_a_masked_array_without_a_masked_number_is_an_array():
    given = {"h": 0.1, "num_steps": 3, "args": {"k": np.ma.array([1.0, 2.0])}}
    found = dvi.integrate(OSCILLATOR, np.ma.array(START[0]), START[1], **given)
    same = dvi.integrate(OSCILLATOR, *START, h=0.1, num_steps=3)
    np.testing.assert_array_equal(found.qs, same.qs)


@pytest.mark.skipif(np.dtype(np.longdouble).itemsize == 8, reason="longdouble is float64 here")
def test_numbers_beyond_double_precision_are_named():
    ones = np.array([1.0, 2.0], np.longdouble)
    for call in (
        lambda: dvi.integrate(OSCILLATOR, ones, START[1], h=0.1, num_steps=3),
        lambda: dvi.integrate(OSCILLATOR, START[0], ones, h=0.1, num_steps=3),
        lambda: run(args={"k": ones}),
        lambda: dvi.Save(ts=ones),
        lambda: dvi.Given(ones),
    ):
        with pytest.raises(TypeError, match="at most double precision"):
            call()


@pytest.mark.slow
def test_double_precision_input_without_x64_is_rejected_with_the_line_to_add():
    code = """
import numpy as np, jax.numpy as jnp, dvi_jax as dvi
s = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2)
def run(q):
    return dvi.integrate(s, q, q, h=0.1, num_steps=1).qs.dtype
for make in (lambda: run(np.ones(1)), lambda: run([1.0]), lambda: dvi.Given(np.array([0.0, 0.1]))):
    try:
        make()
        print("accepted")
    except TypeError as error:
        print('jax.config.update("jax_enable_x64", True)' in str(error))
print(run(jnp.ones(1)))
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.split() == ["True", "True", "True", "float32"]


def final_position(q0, save=dvi.Save()):
    return dvi.integrate(OSCILLATOR, q0, START[1], h=0.1, num_steps=9, save=save).qs[-1]


def test_results_that_no_memory_can_hold_are_rejected_before_the_run(monkeypatch):
    """Ten saved states of two degrees of freedom: 10 · (2 + 2 + t + h) · 8 bytes = 480 bytes."""
    traces = []
    system = dvi.System(lambda *a: traces.append(1) or H(*a))
    monkeypatch.setattr(_memory, "machine_memory", lambda: 2.5 * 480 - 1)
    with pytest.raises(ValueError, match=r"need 4.47e-07 GiB .*\(10 saved states\).*dvi.Save\("):
        dvi.integrate(system, *START, h=0.1, num_steps=9)
    assert len(traces) == 1  # for its shape: nothing is compiled
    with pytest.raises(ValueError, match="GiB of memory"):
        run(num_steps=2**31 - 2)
    monkeypatch.setattr(_memory, "machine_memory", lambda: 2.5 * (480 + 10 * 16) - 1)
    with pytest.raises(ValueError, match="GiB of memory"):
        run(num_steps=9, observe=position)  # 10 · 2 · 8 bytes more


@pytest.mark.parametrize("count", [10, 25])
def test_the_steps_that_contain_requested_times_are_counted(monkeypatch, count):
    """Measured for 192 MB of requested states: 756 MB. A step is four numbers, q, p and its number:
    68 bytes."""
    save = dvi.Save(ts=np.linspace(0.0, 0.9, count))
    batch = jax.vmap(lambda q0: final_position(q0, save))
    needed = 3 * count * (2.5 * 48 + 68)
    monkeypatch.setattr(_memory, "machine_memory", lambda: needed - 1)
    with pytest.raises(ValueError, match=rf"{count} saved states of each of 3 trajectories"):
        batch(jnp.ones((3, 2)))
    with pytest.raises(ValueError, match="the run with its derivative"):
        jax.grad(lambda q0: batch(q0).sum())(jnp.ones((3, 2)))
    monkeypatch.setattr(_memory, "machine_memory", lambda: needed)
    assert jax.eval_shape(batch, jnp.ones((3, 2))).shape == (3, 2)


@pytest.mark.slow
def test_results_of_a_batch_are_counted_together(monkeypatch):
    monkeypatch.setattr(_memory, "machine_memory", lambda: 2.5 * 3 * 4 * 480 - 1)
    batch = jax.vmap(jax.vmap(final_position))
    gradient = jax.grad(lambda x: final_position(x).sum())
    for f in (
        batch,
        jax.jit(batch),
        jax.grad(lambda x: batch(x).sum()),
        jax.vmap(jax.vmap(gradient)),
    ):
        with pytest.raises(ValueError, match=r"10 saved states of each of 12 trajectories"):
            f(jnp.ones((3, 4, 2)))
    monkeypatch.setattr(_memory, "machine_memory", lambda: 2.5 * 4 * 480)
    assert jax.vmap(final_position)(jnp.ones((4, 2))).shape == (4, 2)
    monkeypatch.setattr(_memory, "machine_memory", lambda: 2.5 * 2 * 48)
    assert final_position(jnp.ones(2), FINAL).shape == (2,)
    monkeypatch.setattr(_memory, "machine_memory", lambda: None)  # not known
    assert final_position(jnp.ones(2)).shape == (2,)


@pytest.mark.slow
def test_the_memory_of_a_derivative_is_counted(monkeypatch):
    """Measured for 160 MB of saved states: 421 MB, and 741 MB with the reverse pass."""

    def steps_of(adjoint, save=dvi.Save()):
        def loss(x):
            how = {"h": 0.1, "num_steps": 999, "adjoint": adjoint, "save": save}
            return dvi.integrate(OSCILLATOR, x, START[1], **how).q_final.sum()

        return loss

    size = 1000 * 48
    for derivative in (jax.grad, jax.jacfwd, lambda f: jax.jit(jax.grad(f))):
        monkeypatch.setattr(_memory, "machine_memory", lambda: 4.5 * size - 1)
        with pytest.raises(ValueError, match=r"the run with its derivative .* are available"):
            derivative(steps_of(dvi.Reversible()))(jnp.ones(2))
    monkeypatch.setattr(_memory, "machine_memory", lambda: 4.5 * size)
    assert jax.eval_shape(jax.grad(steps_of(dvi.Reversible())), jnp.ones(2)).shape == (2,)
    # States of all steps are stored, however few are saved.
    for count, adjoint in ((1, dvi.Direct()), (0, dvi.Checkpointed()), (0, dvi.Reversible())):
        monkeypatch.setattr(_memory, "machine_memory", lambda: 20_000)
        loss = jax.grad(steps_of(adjoint, FINAL))
        if count:
            with pytest.raises(ValueError, match=r"Take adjoint=dvi\.Reversible\(\)"):
                loss(jnp.ones(2))
        else:
            assert jax.eval_shape(loss, jnp.ones(2)).shape == (2,)


def test_the_memory_of_reductions_and_of_checkpoints_is_counted(monkeypatch):
    """A section with room for many crossings, a large value, and states between save points."""
    monkeypatch.setattr(_memory, "machine_memory", lambda: 20_000)

    def crossings(count):
        return dvi.Section(lambda t, q, p, args: q[0], max_crossings=count)

    def last(x, observe=None, **options):
        how = {"h": 0.1, "num_steps": 1000, "save": FINAL, "observe": observe, **options}
        return dvi.integrate(OSCILLATOR, x, START[1], **how).q_final.sum()

    def shape_of(function):
        return jax.eval_shape(function, jnp.ones(2)).shape

    large = dvi.Last(lambda q, p: jnp.zeros(2000) + q[0])
    for observe in (crossings(200), large):
        with pytest.raises(ValueError, match=r"saved states and reductions.*max_crossings"):
            last(jnp.ones(2), observe)
    assert shape_of(lambda x: last(x, crossings(10))) == ()
    dense, sparse = (dvi.Reversible(checkpoint_every=n) for n in (1, 100))
    with pytest.raises(ValueError, match="Take a larger checkpoint_every"):
        shape_of(jax.grad(lambda x: last(x, adjoint=dense)))
    assert shape_of(jax.grad(lambda x: last(x, adjoint=sparse))) == (2,)
    assert shape_of(lambda x: last(x, adjoint=dense)) == ()


def test_limits_of_the_process_and_of_its_groups(monkeypatch, tmp_path):
    import resource

    statm, gigabyte = Path("/proc/self/statm").read_text().split(), 2**30
    page, limit = resource.getpagesize(), [10**15, 10**15]
    monkeypatch.setattr(
        resource, "getrlimit", lambda kind: (limit[kind == resource.RLIMIT_DATA], -1)
    )
    for kind, place in ((0, 0), (1, 5)):
        limit[:] = 10**15, 10**15
        limit[kind] = int(statm[place]) * page + gigabyte
        left = _memory.machine_memory()
        assert 0.5 * gigabyte < left < 1.5 * gigabyte
    limit[:] = 1000, 1000  # what is in use is more
    assert _memory.machine_memory() == 0
    with pytest.raises(ValueError, match="only 0 GiB are available"):
        run(num_steps=9)
    monkeypatch.undo()

    read = _memory.Path.read_text
    monkeypatch.setattr(_memory, "_CGROUPS", tmp_path)
    lines = "11:cpu,memory:/job/step\n1:name=systemd:/x\n0::/x\n"
    job = tmp_path / "memory/job"
    (job / "step").mkdir(parents=True)
    (tmp_path / "x").mkdir()
    (job / "memory.limit_in_bytes").write_text("2222\n")
    (job / "step/memory.limit_in_bytes").write_text("3333\n")
    (tmp_path / "x/memory.max").write_text("max\n")

    def read_text(path):
        return lines if str(path) == "/proc/self/cgroup" else read(path)

    monkeypatch.setattr(_memory.Path, "read_text", read_text)
    assert {2222, 3333} <= {*_memory._limits()}
    lines = lines.replace("job/step", "other:place")
    assert 2222 not in _memory._limits()


def test_the_memory_of_this_machine_and_of_devices(monkeypatch, tmp_path):
    found, read = _memory.machine_memory(), _memory.Path.read_text
    assert found is None or found > 2**28
    monkeypatch.setattr(_memory, "_CGROUPS", tmp_path)
    (tmp_path / "memory.max").write_text("12345678\n")

    def read_text(path):
        return "0::/job/step\n" if str(path) == "/proc/self/cgroup" else read(path)

    monkeypatch.setattr(_memory.Path, "read_text", read_text)
    assert 12345678 in _memory._limits()

    def device(limit):
        return SimpleNamespace(memory_stats=lambda: {"bytes_limit": limit} if limit else None)

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    for devices, expected in (([device(5), device(7)], 12), ([device(5), device(0)], None)):
        monkeypatch.setattr(jax, "devices", lambda found=devices: found)
        _memory._devices_memory.cache_clear()
        assert _memory.results_memory() == expected
    _memory._devices_memory.cache_clear()


COUPLED = dvi.System(non_separable)
OF_NO_TRAJECTORY = {
    "explicit": {},
    "status": {"throw": False},
    "arrays": {"layout": dvi.Layout(form="arrays")},
    "pairs": {"arithmetic": dvi.DoubleDouble()},
    "steps by (14)": {"lattice": dvi.Variational()},
    "times": {"save": dvi.Save(ts=jnp.array([0.05, 0.2]))},
    "stop": {"stop": dvi.Stop(lambda t, q, p, args: q[0] - 0.5)},
    "observables": {"observe": [dvi.MaxDrift(lambda q, p: q[0]), lambda q, p: q @ p, dvi.MEGNO()]},
}


@pytest.mark.slow
@pytest.mark.parametrize("options", OF_NO_TRAJECTORY.values(), ids=OF_NO_TRAJECTORY)
def test_a_batch_of_no_trajectories_has_arrays_of_length_zero(options):
    def run(q):
        sol = dvi.integrate(COUPLED, q, jnp.zeros(1), h=0.1, num_steps=3, **options)
        return sol.qs, sol.ts, sol.observed

    alone = jax.eval_shape(run, jnp.ones(1))
    for function, q in (
        (jax.vmap(run), jnp.ones((0, 1))),
        (jax.vmap(jax.jit(run)), jnp.ones((0, 1))),
        (jax.vmap(jax.vmap(run)), jnp.ones((2, 0, 1))),
    ):
        lead = q.shape[:-1]
        shapes = [x.shape for x in jax.tree.leaves(function(q))]
        assert shapes == [(*lead, *x.shape) for x in jax.tree.leaves(alone)]


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [dvi.Reversible(), dvi.Direct(), dvi.Checkpointed()])
def test_gradients_of_a_batch_of_no_trajectories(adjoint):
    def loss(h, q):
        def last(q):
            return dvi.integrate(COUPLED, q, q, h=h, num_steps=3, adjoint=adjoint).qs[-1, 0]

        return jnp.sum(jax.vmap(last)(q))

    of_h, of_q = jax.grad(loss, (0, 1))(0.1, jnp.ones((0, 1)))
    assert of_h == 0
    assert of_q.shape == (0, 1)
    # The control: of one trajectory it is not zero.
    assert abs(jax.grad(loss)(0.1, jnp.ones((1, 1)))) > 0.1


@pytest.mark.slow
def test_failures_in_batches_are_errors_also_inside_jit():
    def run(q):
        return dvi.integrate(COUPLED, q, q, h=0.1, num_steps=3).qs

    q = jnp.array([[1.0], [jnp.nan]])
    for function in (jax.vmap(run), jax.jit(jax.vmap(run)), jax.vmap(jax.jit(run))):
        with pytest.raises(Exception, match="became NaN or infinite"):
            jax.block_until_ready(function(q))
        assert np.isfinite(function(q[:1])).all()


def well(q):
    """1 − cos|q| for |q| < 1, else constant."""
    r = jnp.linalg.norm(q)
    return jnp.where(r < 1, 1 - jnp.cos(r), 1 - np.cos(1.0))


UNDEFINED = {
    "norm": (lambda q: jnp.linalg.norm(q) ** 2, [0.0, 0.0], "q"),
    "branch": (lambda q: jnp.where(q[0] > 0, jnp.sqrt(q[0]) ** 3, 0.0), [0.0, 1.0], "q"),
    "quotient": (lambda q: jnp.where(q[0] == 0, 1.0, jnp.sin(q[0]) / q[0]), [0.0, 1.0], "q"),
    "both sides": (well, [0.0, 0.0], "q"),
}


@pytest.mark.parametrize(("V", "q0", "name"), UNDEFINED.values(), ids=UNDEFINED)
def test_a_derivative_that_is_not_finite_is_named(V, q0, name):
    system = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + V(q0))
    run = {"h": 0.1, "num_steps": 4}
    with pytest.raises(dvi.IntegrationError, match=rf"∂H_D/∂{name} is not finite at t = 0.*double"):
        dvi.integrate(system, q0, [0.0, 0.1], **run)
    assert dvi.integrate(system, q0, [0.0, 0.1], throw=False, **run).status == "not_finite"
    # Where the motion begins elsewhere, the run is successful.
    assert dvi.integrate(system, [0.5, 0.5], [0.0, 0.1], **run).status == "successful"


@pytest.mark.slow
def test_other_causes_of_nan_are_not_called_derivatives():
    """A singularity of H_D itself, an orbit that escapes; and the remedy of the message works."""
    attraction = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 - 1 / jnp.sum(q0**2))
    escape = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 - jnp.sum(q0**6))
    for system, q0 in ((attraction, [0.0]), (escape, [2.0])):
        with pytest.raises(dvi.IntegrationError, match="NaN or infinite") as error:
            dvi.integrate(system, q0, [0.0], h=0.5, num_steps=20)
        assert "∂H_D" not in str(error.value)

    def V(q):
        r2 = q @ q
        r = jnp.sqrt(jnp.where(r2 > 0, r2, 1.0))
        return jnp.where(r2 > 0, 1 - jnp.cos(r), 0.0)

    safe = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + V(q0))
    assert dvi.integrate(safe, [0.0, 0.0], [0.0, 0.1], h=0.1, num_steps=4).status == "successful"
