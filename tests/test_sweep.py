"""Sweeps: the numbers of single runs, axes, starts, failures, what is refused."""

import contextlib
import signal
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import dvi_jax as dvi
from dvi_jax import starts
from dvi_jax.sweep import _sweep
from dvi_jax.sweep.cost import span
from dvi_jax.sweep.plan import Plan, make_plan
from dvi_jax.sweep.starts import _radical_inverse
from dvi_jax.sweep.store import Memory


def hamiltonian(t0, t1, q0, p1, args):
    return 0.5 * p1 @ p1 + args["k"] * (0.5 * q0 @ q0 + 0.25 * jnp.sum(q0**4))


def friction(t0, t1, q0, p1, args):
    return -p1


def energy(t0, t1, q0, p0, q1, p1, args):
    return hamiltonian(t0, t1, q1, p1, args)


SYSTEM = dvi.System(hamiltonian, force=friction)
OBSERVE = {"drift": dvi.MaxDrift(energy), "mean": dvi.Mean(energy)}
LOW, HIGH = ([-1.0, 0.0], [0.0, 0.5]), ([1.0, 2.0], [0.0, 1.5])
Q, P = [0.5, -0.2], [0.1, 0.3]


def sweep(*, q0=Q, p0=P, **kw):
    kw = {"h": 0.1, "num_steps": 20, "args": {"k": 1.0}, "observe": OBSERVE} | kw
    if "start" in kw:
        q0 = p0 = None
    return dvi.sweep(SYSTEM, q0, p0, **kw)


def single(**kw):
    kw = {"h": 0.1, "num_steps": 20, "args": {"k": 1.0}, "observe": OBSERVE, "q0": Q, "p0": P} | kw
    q0, p0 = (jnp.asarray(kw.pop(n)) for n in ("q0", "p0"))
    return dvi.integrate(SYSTEM, q0, p0, save=dvi.Save(final=True), **kw)


def near(a, b):
    np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-16)


@pytest.mark.slow
def test_a_grid_has_the_numbers_of_single_runs_and_their_names():
    eps, k = np.linspace(0, 0.2, 4), [1.0, 1.5, 2.0]
    found = sweep(
        epsilon=eps,
        units={"drift": "J"},
        args={"k": dvi.Axis("k", k, units="N/m")},
        h=[0.1, 0.05],
        save=dvi.Save(final=True),
    ).to_xarray()
    assert dict(found.sizes) == {"epsilon": 4, "h": 2, "k": 3, "save": 2, "component": 2}
    assert found.k.attrs["units"] == "N/m"
    assert found.drift.attrs["units"] == "J"
    for e in eps:
        for h in (0.1, 0.05):
            one = single(epsilon=e, h=h, args={"k": 1.5})
            here = found.sel(epsilon=e, h=h, k=1.5)
            near(here.drift, one.observed["drift"])
            near(here["mean"], one.observed["mean"])
            near(here.q, one.qs)
            near(here.t, one.ts)
    assert (found.status == 0).all()
    assert (found.failed_step == -1).all()


@pytest.mark.slow
def test_axes_of_one_name_go_together():
    found = sweep(
        epsilon=dvi.Axis("case", [0.0, 0.1, 0.2]), h=dvi.Axis("case", [0.1, 0.05, 0.02])
    ).to_xarray()
    assert found.drift.dims == ("case",)
    near(found.epsilon, [0.0, 0.1, 0.2])
    near(found.drift[2], single(epsilon=0.2, h=0.02).observed["drift"])


@pytest.mark.slow
def test_components_of_the_start_and_whole_states_are_axes():
    x = np.linspace(0.1, 0.5, 3)
    found = sweep(q0=[dvi.Axis("x", x), -0.2], p0=[0.1, dvi.Axis("py", [0.0, 0.3])]).to_xarray()
    assert found.drift.dims == ("x", "py")
    near(found.drift.sel(x=x[1], py=0.3), single(q0=[0.3, -0.2], p0=[0.1, 0.3]).observed["drift"])
    states = np.asarray([[0.5, -0.2], [0.4, 0.1]])
    found = sweep(q0=dvi.Axis("start", states)).to_xarray()
    near(found.q0, states)
    near(found.drift[1], single(q0=states[1]).observed["drift"])


@pytest.mark.slow
def test_methods_and_numbers_of_steps_are_axes():
    methods = [dvi.TypeII(), dvi.Strang()]
    steps = dvi.Axis("h", [10, 20])
    found = sweep(method=methods, num_steps=steps, h=dvi.Axis("h", [0.1, 0.05])).to_xarray()
    assert found.drift.dims == ("integrator", "h")
    assert list(found.integrator.values) == ["TypeII()", "Strang(base=TypeII())"]
    assert list(found.num_steps.values) == [10, 20]
    for i, method in enumerate(methods):
        for j, (n, h) in enumerate(((10, 0.1), (20, 0.05))):
            near(found.drift[i, j], single(method=method, num_steps=n, h=h).observed["drift"])


@pytest.mark.slow
def test_observables_that_stand_alone_have_the_saved_steps():
    found = sweep(epsilon=[0.0, 0.1], observe=energy, save=dvi.Save(every=5)).to_xarray()
    assert found.observed.dims == ("epsilon", "saved_step")
    one = single(epsilon=0.1, observe=energy)
    near(found.observed[1, -1], one.observed[0])
    assert found.q.sizes["save"] == 5


@pytest.mark.slow
def test_the_same_bits_whatever_the_threads():
    eps = np.linspace(0, 0.3, 1000)
    results = [sweep(epsilon=eps, threads=n, lanes_per_task=128) for n in (1, 2, 3)]
    assert results[0].num_tasks == 8
    for other in results[1:]:
        for name in ("drift", "mean", "status"):
            np.testing.assert_array_equal(results[0][name], other[name])
    near(results[0]["drift"][999], single(epsilon=0.3).observed["drift"])


@pytest.mark.slow
def test_threads_compute_in_the_precision_of_the_caller():
    """jax.enable_x64 as a context holds in its own thread alone."""
    with jax.enable_x64(False):
        assert jnp.zeros(()).dtype == jnp.float32
        q, p = (jnp.asarray(x, jnp.float32) for x in (Q, P))
        single = sweep(epsilon=np.linspace(0, 0.1, 9, dtype=np.float32), q0=q, p0=p)
    assert single["drift"].dtype == np.float32
    double = sweep(epsilon=np.linspace(0, 0.1, 9))
    assert 0 < np.abs(single["drift"] - double["drift"]).max() < 1e-5


class Busy(Memory):
    """A sink of which every third task is another's when it is first asked for."""

    def __init__(self, plan, variables):
        super().__init__(plan, variables)
        self.asked: list[int] = []

    @contextlib.contextmanager
    def claimed(self, task):
        first = task.number not in self.asked
        self.asked.append(task.number)
        if first and task.number == 6:  # which it finishes
            self.arrays["status"][task.box], self._done = 0, {*self._done, 6}
        yield not (first and task.number % 3 == 0)


@pytest.mark.slow
def test_what_others_leave_undone_is_done(monkeypatch):
    monkeypatch.setattr(_sweep, "Memory", Busy)
    seen = []
    found = sweep(epsilon=np.linspace(0, 0.1, 100), lanes_per_task=10, progress=seen.append)
    assert found.is_complete
    assert seen[-1].tasks_done == 10
    computed = np.isfinite(found["drift"])
    assert computed[:60].all()
    assert not computed[60:70].any()
    assert computed[70:].all()


@pytest.mark.slow
def test_other_numbers_need_no_other_program():
    sweep(epsilon=np.linspace(0, 0.1, 7), h=0.1)
    traced = []

    def watched(t0, t1, q0, p1, args):
        traced.append(h)
        return friction(t0, t1, q0, p1, args)

    system = dvi.System(hamiltonian, force=watched)
    counts = []
    for h in (0.1, 0.05, 0.02):
        before = len(traced)
        dvi.sweep(system, Q, P, epsilon=np.linspace(0, h, 7), h=h, num_steps=4,
                  args={"k": 1 + h}, observe=OBSERVE)  # fmt: skip
        counts.append(len(traced) - before)
    assert counts[1] == counts[2] < counts[0] / 1.5  # shapes and identity alone


@pytest.mark.slow
def test_a_failing_lane_costs_itself_alone():
    eps = np.asarray([0.0, 0.1, 1e200, 0.2])
    with_it, without = sweep(epsilon=eps), sweep(epsilon=[0.0, 0.1, 0.15, 0.2])
    assert with_it.status_counts() == {"successful": 3, "not_finite": 1}
    assert np.isnan(with_it["drift"][2])
    assert with_it["failed_step"][2] >= 0
    keep = [0, 1, 3]
    np.testing.assert_array_equal(with_it["drift"][keep], without["drift"][keep])


def test_progress_counts_everything():
    seen = []
    sweep(epsilon=np.linspace(0, 0.1, 100), lanes_per_task=30, progress=seen.append)
    assert seen[0].tasks_done == 0
    assert np.isnan(seen[0].seconds_left)
    assert [p.tasks_done for p in seen] == [0, 1, 2, 3, 4]
    assert (seen[-1].lanes_done, seen[-1].num_lanes, seen[-1].failed) == (100, 100, 0)
    assert seen[-1].rate > 0


@pytest.mark.parametrize("in_store", [False, True])
def test_the_start_of_a_sweep_takes_no_longer_for_more_tasks(in_store, tmp_path, monkeypatch):
    """The first report comes before the work; the tasks are not listed or counted for it."""

    class FirstReportError(Exception):
        pass

    def first(progress):
        seen.append(progress)
        raise FirstReportError

    seen, made, make = [], [], Plan.task
    monkeypatch.setattr(Plan, "task", lambda self, i: made.append(i) or make(self, i))
    start = dvi.starts.Random(100_000, (Q, P), (Q, P))
    with pytest.raises(FirstReportError):
        dvi.sweep(
            SYSTEM, start=start, h=0.1, num_steps=3, args={"k": 1.0}, observe=OBSERVE,
            lanes_per_task=1, progress=first, store=tmp_path / "s.zarr" if in_store else None,
        )  # fmt: skip
    assert seen[0].num_tasks == 100_000
    assert len(made) < 10


@pytest.fixture
def ctrl_c():
    """Ctrl-C raises, also where tests were started in the background, with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_keeps_what_is_finished():
    seen = []

    def interrupt(p):
        seen.append(p)
        if p.tasks_done == 3:
            signal.raise_signal(signal.SIGINT)
            time.sleep(0.5)

    assert threading.current_thread() is threading.main_thread()
    with pytest.raises(dvi.SweepInterrupted, match="tasks are done") as caught:
        sweep(epsilon=np.linspace(0, 0.1, 400), lanes_per_task=10, progress=interrupt, threads=1)
    result = caught.value.result
    done = result.status_counts()["successful"]
    assert 30 <= done < 400
    assert result.status_counts()["not_computed"] == 400 - done
    computed = result["status"] == 0
    assert np.isfinite(result["drift"][computed]).all()
    assert np.isnan(result["drift"][~computed]).all()


# --- what it takes ---------------------------------------------------------------------------


@pytest.mark.slow
def test_the_cost_of_a_sweep():
    settings = {"h": 0.1, "num_steps": 50, "args": {"k": 1.0}, "observe": OBSERVE}
    grid = {"epsilon": np.linspace(0, 0.1, 100), "method": [dvi.TypeII(), dvi.Strang()]}
    cost = dvi.sweep_cost(SYSTEM, Q, P, **settings, **grid, lanes_per_task=10, store="ignored")
    whole = sweep(**grid, num_steps=50, lanes_per_task=10)
    assert (cost.lanes, cost.steps, cost.tasks) == (200, 10_000, whole.num_tasks)
    arrays = [whole[n] for n in ("drift", "mean", "status", "failed_step", "residual")]
    assert cost.bytes == sum(x.nbytes for x in arrays)
    assert 0 < cost.seconds_per_step < 1e-3
    assert cost.compilation > 0
    large = cost.scaled(1e9)
    assert (large.tasks, large.files) == (10**8, 6 * 10**8)
    assert large.bytes == cost.bytes * 5 * 10**6
    assert large.seconds(1) > 60 * large.seconds(64) > 0
    assert "| 1e+12 | 1e+11 |" in cost.table()
    assert "20 tasks of 10 trajectories" in str(cost)
    with pytest.raises(ValueError, match="nothing varies"):
        dvi.sweep_cost(SYSTEM, Q, P, **settings)


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(0.004, "0.004 s"), (70, "70 s"), (200, "3.33 min"), (1e4, "2.78 h"), (1e9, "31.7 years")],
)
def test_times_in_words(seconds, said):
    assert span(seconds) == said


# --- export ----------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["memory", "store"])
def result(request, tmp_path_factory):
    where = tmp_path_factory.mktemp("export") / "s.zarr" if request.param == "store" else None
    return sweep(
        start=starts.Halton(10, LOW, HIGH), epsilon=[0.0, 0.1, 1e200], lanes_per_task=4,
        method=[dvi.TypeII(), dvi.Strang()], save=dvi.Save(final=True), store=where,
    )  # fmt: skip


@pytest.mark.slow
def test_a_store_opened_again_is_the_same(result):
    if result.path is not None:
        again = dvi.open_sweep(result.path)
        xr.testing.assert_identical(again.to_xarray(), result.to_xarray())


@pytest.mark.slow
def test_netcdf_is_the_dataset(result, tmp_path):
    result.to_netcdf(tmp_path / "s.nc")
    with xr.open_dataset(tmp_path / "s.nc", engine="h5netcdf") as found:
        wanted = result.to_xarray()
        xr.testing.assert_equal(found.load(), wanted)
        assert found.attrs["jax"] == jax.__version__
        assert found.status.attrs["flag_meanings"] == wanted.status.attrs["flag_meanings"]
    with pytest.raises(FileExistsError, match="force=True"):
        result.to_netcdf(tmp_path / "s.nc")


@pytest.mark.slow
def test_parquet_has_a_row_for_each_trajectory(result, tmp_path):
    result.to_parquet(tmp_path / "s.parquet")
    table = pd.read_parquet(tmp_path / "s.parquet")
    assert len(table) == 60
    assert set(table.status) == {"successful", "not_finite"}
    one = table[(table.epsilon == 0.1) & (table.start == 7) & (table.integrator == "TypeII()")]
    found = result.to_xarray().sel(epsilon=0.1, start=7, integrator="TypeII()")
    near(one.drift, [found.drift])
    near(one.q_1_0, [found.q[1, 0]])
    near(one.p0_1, [found.p0[1]])
    result.to_parquet(tmp_path / "s.parquet", force=True)
    assert [f.name for f in tmp_path.iterdir()] == ["s.parquet"]


# --- starts ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [starts.Random, starts.Halton])
@pytest.mark.slow
def test_starts_fill_their_box(kind):
    start = kind(4096, LOW, HIGH, seed=3)
    q, p = jax.vmap(lambda i: start.at(i, 0.0, None))(jnp.arange(4096))
    x = np.concatenate([q, p], axis=1)
    low, high = np.concatenate(LOW), np.concatenate(HIGH)
    assert (x >= low).all()
    assert (x <= high).all()
    error = np.abs(x.mean(0) - (low + high) / 2) / np.maximum(high - low, 1)
    assert error.max() < (0.002 if kind is starts.Halton else 0.03)
    assert len(np.unique(x[:, 0])) == 4096
    again = kind(10, LOW, HIGH, seed=3)
    near(again.at(jnp.asarray(7), 0.0, None)[0], q[7])
    other = kind(10, LOW, HIGH, seed=4)
    assert np.abs(np.asarray(other.at(jnp.asarray(7), 0.0, None)[0] - q[7])).max() > 1e-3


def test_radical_inverse_against_digits_written_backwards():
    for base in (2, 3, 7):
        for n in (1, 5, 48, 12345):
            digits, k, m = 0.0, 1, n
            while m:
                m, d = divmod(m, base)
                digits, k = digits + d * base**-k, k + 1
            near(_radical_inverse(jnp.asarray(n), base, 12345, jnp.float64), digits)


def test_random_starts_differ_beyond_32_bits():
    start = starts.Random(2**40, LOW, HIGH)
    a, b = (start.at(jnp.asarray(i), 0.0, None)[0] for i in (5, 5 + 2**35))
    assert np.abs(np.asarray(a - b)).max() > 1e-6


def test_normal_starts_have_their_spread():
    start = starts.Normal(20000, [1.0, 2.0], [0.0, 0.0], ([0.1, 0.0], 0.3))
    q, p = jax.vmap(lambda i: start.at(i, 0.0, None))(jnp.arange(20000))
    near(q[:, 1], 2.0)
    np.testing.assert_allclose(np.std(q[:, 0]), 0.1, rtol=0.03)
    np.testing.assert_allclose(np.std(p, axis=0), 0.3, rtol=0.03)


@pytest.mark.slow
def test_the_energy_shell():
    def H(t, q, p, args):
        return hamiltonian(t, t, q, p, args)

    start = starts.EnergyShell(500, H, 0.4, [-1.0, -1.0], [1.0, 1.0])
    found = sweep(start=start, save=dvi.Save(final=True), observe=None, args={"k": 1.3})
    q, p = found["q"][:, 0], found["p"][:, 0]
    args = {"k": 1.3}
    at = jax.vmap(lambda q, p: H(0.0, q, p, args))(jnp.asarray(q), jnp.asarray(p))
    np.testing.assert_allclose(at, 0.4, rtol=1e-14)
    assert np.abs(np.mean(np.arctan2(p[:, 1], p[:, 0]))) < 0.3
    nowhere = starts.EnergyShell(4, H, -1.0, [-1.0, -1.0], [1.0, 1.0])
    assert sweep(start=nowhere).status_counts() == {"not_finite": 4}


@pytest.mark.slow
def test_starts_are_a_dimension_of_their_own():
    start = starts.Halton(20, LOW, HIGH)
    found = sweep(start=start, epsilon=[0.0, 0.1]).to_xarray()
    assert found.drift.dims == ("epsilon", "start")
    q, p = start.at(jnp.asarray(11), 0.0, None)
    near(found.q0[11], q)
    near(found.drift[1, 11], single(epsilon=0.1, q0=q, p0=p).observed["drift"])


# --- tasks -----------------------------------------------------------------------------------


def test_tasks_cover_the_grid_once():
    plan = make_plan({"method": 2, "a": 7, "b": 3, "c": 11}, 1, 100, 8, lanes=40)
    covered = np.zeros(plan.shape, int)
    for task in plan.tasks():
        covered[task.box] += 1
        assert plan.number(plan.place(task.number)) == task.number
    assert (covered == 1).all()
    assert plan.lanes_per_task <= 40
    assert plan.chunk[0] == 1


def test_tasks_suit_the_work():
    assert make_plan({"start": 10**6}, 0, 10_000, 32).lanes_per_task in range(8192, 32769)
    assert make_plan({"start": 10**12}, 0, 10, 8).lanes_per_task <= 2**17
    assert make_plan({"start": 10**9}, 0, 10**9, 8).lanes_per_task == 256
    assert make_plan({"epsilon": 11}, 0, 1000, 8) == Plan({"epsilon": 11}, (11,))
    assert make_plan({"start": 10**6}, 0, 100, 2**20).lanes_per_task <= 64


# --- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "error", "said"),
    [
        ({}, ValueError, "nothing varies"),
        ({"epsilon": [0.1, np.nan]}, ValueError, r"holds nan at index \[1\]"),
        ({"epsilon": ["a"]}, TypeError, "epsilon takes numbers"),
        ({"epsilon": [0.1], "observe": None}, ValueError, "nothing would be kept"),
        ({"epsilon": []}, ValueError, "no values"),
        ({"epsilon": np.zeros((2, 2))}, ValueError, r"epsilon must be .* shape \(2, 2\)"),
        ({"epsilon": [0.1], "num_steps": None}, ValueError, "num_steps is missing"),
        ({"epsilon": [0.1], "store": 3}, TypeError, "path of a directory"),
        ({"epsilon": [0.1], "observe": {"status": energy}}, ValueError, "give it another"),
        ({"epsilon": [0.1], "observe": {"epsilon": energy}}, ValueError, "give it another"),
        ({"epsilon": [0.1], "threads": 0}, ValueError, "threads must be"),
        ({"epsilon": [0.1], "lanes_per_task": 1.5}, ValueError, "lanes_per_task must be"),
        ({"epsilon": [0.1], "progress": 3}, TypeError, "progress must be"),
        ({"epsilon": [0.1], "units": {"drft": "J"}}, ValueError, "'drft', which is none"),
        ({"epsilon": [0.1], "units": "J"}, TypeError, "units must be a table"),
        ({"epsilon": dvi.Axis("save", [0.1])}, ValueError, "the axis 'save' has a name"),
        ({"method": [dvi.TypeII(), "Strang"]}, TypeError, "'Strang', which is none"),
        ({"epsilon": [0.1], "start": 3}, TypeError, "one of dvi.starts"),
        ({"epsilon": [0.1], "p0": None}, ValueError, "give q0 and p0, or start"),
        (
            {"epsilon": dvi.Axis("a", [0.1]), "h": dvi.Axis("a", [0.1, 0.2])},
            ValueError,
            "1 values in epsilon and 2 in h",
        ),
        (
            {"num_steps": dvi.Axis("n", [2, 3]), "save": dvi.Save(every=1)},
            ValueError,
            "must have one shape",
        ),
        ({"epsilon": [0.1], "h": "x"}, TypeError, "h must be"),
    ],
)
def test_refused(settings, error, said):
    with pytest.raises(error, match=said):
        sweep(**settings)


@pytest.mark.parametrize(
    ("make", "error", "said"),
    [
        (lambda: dvi.Axis("no name", [1.0]), ValueError, "identifier"),
        (lambda: dvi.Axis("a", 3.0), TypeError, "sequence"),
        (lambda: dvi.Axis("a", np.asarray(3.0)), ValueError, "sequence"),
        (lambda: starts.Random(0, LOW, HIGH), ValueError, "count"),
        (lambda: starts.Random(3, HIGH, LOW), ValueError, "low of Random must not lie above"),
        (lambda: starts.Random(3, [0.0], HIGH), TypeError, "a pair"),
        (lambda: starts.Halton(3, LOW, HIGH, seed=-1), ValueError, "seed"),
        (lambda: starts.Normal(3, [0.0], [0.0], (-1.0, 0.0)), ValueError, "not negative"),
        (lambda: starts.EnergyShell(3, 1.0, 1.0, [0.0], [1.0]), TypeError, "H of EnergyShell"),
        (lambda: starts.EnergyShell(3, energy, np.inf, [0.0], [1.0]), ValueError, "finite"),
    ],
)
def test_refused_axes_and_starts(make, error, said):
    with pytest.raises(error, match=said):
        make()


def test_more_than_memory_holds_needs_a_store():
    start = starts.Random(10**12, LOW, HIGH)
    with pytest.raises(ValueError, match=r"GiB of memory.*give store="):
        sweep(start=start)


def test_the_memory_for_results_is_that_of_the_process(monkeypatch):
    monkeypatch.setattr(_sweep, "machine_memory", lambda: 1000)  # the limit of a container, say
    with pytest.raises(ValueError, match=r"GiB of memory.*give store="):
        sweep(start=starts.Random(100, LOW, HIGH))
