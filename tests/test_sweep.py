"""Sweeps: numbers of single runs, axes, generated initial conditions, failures, export, errors."""

import contextlib
import dataclasses
import signal
import threading
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from sweep_child import energy, friction, hamiltonian

import dvi_jax as dvi
from dvi_jax import starts
from dvi_jax.base.checks import argument_names
from dvi_jax.sweep import cluster, store as stores, workers
from dvi_jax.sweep.cost import span
from dvi_jax.sweep.plan import ON_CPU, SweepPlan, make_plan, on_devices
from dvi_jax.sweep.request import Request

SYSTEM = dvi.System(hamiltonian, force=friction, epsilon=0.0)
OBSERVE = {"drift": dvi.MaxDrift(energy), "mean": dvi.Mean(energy)}
LOW, HIGH = ([-1.0, 0.0], [0.0, 0.5]), ([1.0, 2.0], [0.0, 1.5])
Q, P = [0.5, -0.2], [0.1, 0.3]
FINAL = dvi.Save(final=True)
DEFAULTS = {"h": 0.1, "num_steps": 20, "args": {"k": 1.0}, "observe": OBSERVE, "q0": Q, "p0": P}


def sweep(**kw):
    kw = DEFAULTS | ({"q0": None, "p0": None} if "start" in kw else {}) | kw
    return dvi.sweep(SYSTEM, kw.pop("q0"), kw.pop("p0"), **kw)


def single(**kw):
    kw = DEFAULTS | kw
    q0, p0 = (jnp.asarray(kw.pop(n)) for n in ("q0", "p0"))
    return dvi.integrate(SYSTEM, q0, p0, save=FINAL, **kw)


def near(a, b):
    np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-16)


X, STATES = np.linspace(0.1, 0.5, 3), np.asarray([[0.5, -0.2], [0.4, 0.1]])
METHODS, START = [dvi.TypeII(), dvi.Strang()], starts.Halton(20, LOW, HIGH)
START_11 = dict(zip(("q0", "p0"), START.at(jnp.asarray(11), 0.0, None), strict=True))
SINGLE_RUNS = {
    "a grid": (
        {"epsilon": [0.0, 0.2], "h": [0.1, 0.05], "args": {"k": dvi.Axis("k", [1.0, 1.5])}},
        ("epsilon", "h", "k"),
        {(1, 0, 1): {"epsilon": 0.2, "args": {"k": 1.5}}, (0, 1, 0): {"h": 0.05}},
    ),
    "axes of one name": (
        {"epsilon": dvi.Axis("case", [0.0, 0.2]), "h": dvi.Axis("case", [0.1, 0.02])},
        ("case",),
        {(1,): {"epsilon": 0.2, "h": 0.02}},
    ),
    "components of a state": (
        {"q0": [dvi.Axis("x", X), -0.2], "p0": [0.1, dvi.Axis("py", [0.0, 0.3])]},
        ("x", "py"),
        {(1, 1): {"q0": [0.3, -0.2], "p0": [0.1, 0.3]}},
    ),
    "whole states": ({"q0": dvi.Axis("at", STATES)}, ("at",), {(1,): {"q0": STATES[1]}}),
    "methods and numbers of steps": (
        {"method": METHODS, "num_steps": dvi.Axis("h", [10, 20]), "h": dvi.Axis("h", [0.1, 0.05])},
        ("integrator", "h"),
        {
            (i, j): {"method": METHODS[i], "num_steps": n, "h": h}
            for i in (0, 1)
            for j, (n, h) in enumerate(((10, 0.1), (20, 0.05)))
        },
    ),
    "generated initial conditions": (
        {"start": START, "epsilon": [0.0, 0.1]},
        ("epsilon", "start"),
        {(1, 11): {"epsilon": 0.1, **START_11}},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", SINGLE_RUNS)
def test_a_sweep_has_the_numbers_of_single_runs(case):
    settings, dims, checks = SINGLE_RUNS[case]
    found = sweep(**settings, save=FINAL).to_xarray()
    assert found.drift.dims == dims
    assert (found.status == 0).all()
    assert (found.failed_step == -1).all()
    for index, given in checks.items():
        here, one = found.isel(dict(zip(dims, index, strict=True))), single(**given)
        for ours, theirs in zip((here.drift, here["mean"], here.q, here.t),
                                (*one.observed.values(), one.qs, one.ts), strict=True):  # fmt: skip
            near(ours, theirs)


@pytest.mark.slow
def test_coordinates_and_units():
    k = dvi.Axis("k", [1.0, 1.5], units="N/m")
    found = sweep(epsilon=[0.0, 0.2], args={"k": k}, units={"drift": "J"}).to_xarray()
    assert (found.k.attrs["units"], found.drift.attrs["units"]) == ("N/m", "J")
    near(found.epsilon, [0.0, 0.2])
    settings, *_ = SINGLE_RUNS["methods and numbers of steps"]
    found = sweep(**settings).to_xarray()
    assert list(found.integrator.values) == ["TypeII()", "Strang(base=TypeII())"]
    assert list(found.num_steps.values) == [10, 20]
    near(sweep(q0=dvi.Axis("at", STATES)).to_xarray().q0, STATES)
    near(sweep(start=START).to_xarray().q0[11], START_11["q0"])


@pytest.mark.slow
def test_observables_without_a_reduction_have_the_saved_steps():
    found = sweep(epsilon=[0.0, 0.1], observe=energy, save=dvi.Save(every=5)).to_xarray()
    assert found.observed.dims == ("epsilon", "saved_step")
    near(found.observed[1, -1], single(epsilon=0.1, observe=energy).observed[0])
    assert found.q.sizes["save"] == 5


@pytest.mark.slow
def test_the_bits_do_not_depend_on_the_number_of_threads():
    grid = {"epsilon": np.linspace(0, 0.3, 1000), "lanes_per_task": 128}
    one, *others = (sweep(**grid, threads=n) for n in (1, 2, 3))
    assert one.num_tasks == 8
    for other in others:
        for name in ("drift", "mean", "status"):
            np.testing.assert_array_equal(one[name], other[name])


@pytest.mark.slow
def test_threads_compute_in_the_precision_of_the_caller():
    """jax.enable_x64 as a context applies to its own thread only."""
    with jax.enable_x64(False):
        q, p = (jnp.asarray(x, jnp.float32) for x in (Q, P))
        one = sweep(epsilon=np.linspace(0, 0.1, 9, dtype=np.float32), q0=q, p0=p)
    assert one["drift"].dtype == np.float32
    double = sweep(epsilon=np.linspace(0, 0.1, 9))
    assert 0 < np.abs(one["drift"] - double["drift"]).max() < 1e-5


@pytest.mark.slow
def test_tasks_that_others_leave_unfinished_are_computed(monkeypatch):
    """Another process has claimed every third task, and finishes one of them."""
    claims, seen = [], []

    @contextlib.contextmanager
    def claim(self, task):
        first = task.number not in claims
        claims.append(task.number)
        if first and task.number == 6:
            self.commit(task, {"status": 0}, {})
        yield not (first and task.number % 3 == 0)

    monkeypatch.setattr(stores.MemorySink, "claim", claim)
    found = sweep(epsilon=np.linspace(0, 0.1, 100), lanes_per_task=10, progress=seen.append)
    assert found.is_complete
    assert seen[-1].tasks_done == 10
    assert (np.isnan(found["drift"]) == (np.arange(100) // 10 == 6)).all()


DEFAULTS_OF_RUN = {name: DEFAULTS[name] for name in ("h", "num_steps", "args", "observe")}


@pytest.mark.slow
def test_other_numbers_need_no_other_program():
    traces, counts = [], []

    def counting(t0, t1, q0, p1, args):
        traces.append(1)
        return friction(t0, t1, q0, p1, args)

    system = dvi.System(hamiltonian, force=counting, epsilon=0.0)
    for h in (0.1, 0.05, 0.02):
        before, options = len(traces), DEFAULTS_OF_RUN | {"h": h, "args": {"k": 1 + h}}
        dvi.sweep(system, Q, P, **options, epsilon=[0, h, h / 2])
        counts.append(len(traces) - before)
    assert counts[1] == counts[2] < counts[0] / 1.5  # those for shapes and the identity


def test_a_failed_trajectory_does_not_change_others():
    with_it, without = sweep(epsilon=[0.0, 1e200, 0.2]), sweep(epsilon=[0.0, 0.1, 0.2])
    assert with_it.status_counts() == {"successful": 2, "not_finite": 1}
    assert np.isnan(with_it["drift"][1])
    assert with_it["failed_step"][1] >= 0
    np.testing.assert_array_equal(with_it["drift"][::2], without["drift"][::2])


def test_progress_counts_tasks_and_trajectories():
    seen = []
    sweep(epsilon=np.linspace(0, 0.1, 100), lanes_per_task=30, progress=seen.append)
    assert np.isnan(seen[0].seconds_left)
    assert [p.tasks_done for p in seen] == [0, 1, 2, 3, 4]
    assert (seen[-1].lanes_done, seen[-1].num_lanes, seen[-1].failed) == (100, 100, 0)
    assert seen[-1].rate > 0


@pytest.mark.parametrize("in_store", [False, True])
def test_the_first_report_does_not_wait_for_a_list_of_tasks(in_store, tmp_path, monkeypatch):
    class FirstReportError(Exception):
        pass

    def first(progress):
        seen.append(progress)
        raise FirstReportError

    seen, made, make = [], [], SweepPlan.task
    monkeypatch.setattr(SweepPlan, "task", lambda self, i: made.append(i) or make(self, i))
    store = tmp_path / "s.zarr" if in_store else None
    with pytest.raises(FirstReportError):
        sweep(start=starts.Random(200_000, (Q, P), (Q, P)), num_steps=3, lanes_per_task=1,
              progress=first, store=store)  # fmt: skip
    assert seen[0].num_tasks == 200_000
    assert len(made) < 10


@pytest.fixture
def ctrl_c():
    """Ctrl-C raises, also if tests were started in the background, where it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_returns_the_finished_tasks():
    def interrupt(p):
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
    np.testing.assert_array_equal(np.isfinite(result["drift"]), result["status"] == 0)


@pytest.mark.slow
def test_the_cost_of_a_sweep():
    grid = {"epsilon": np.linspace(0, 0.1, 100), "method": METHODS, "lanes_per_task": 10}
    cost = dvi.sweep_cost(SYSTEM, Q, P, **DEFAULTS_OF_RUN, **grid, store="ignored")
    whole = sweep(**grid)
    assert (cost.lanes, cost.steps, cost.tasks) == (200, 4_000, whole.num_tasks)
    arrays = [whole[n] for n in ("drift", "mean", "status", "failed_step", "residual")]
    assert cost.bytes == sum(x.nbytes for x in arrays)
    assert 0 < cost.seconds_per_step < 1e-3
    assert cost.compilation > 0
    large = cost.scaled(1e9)
    assert (large.tasks, large.files) == (10**8, 6 * 10**8)
    assert large.bytes == cost.bytes * 5 * 10**6
    assert large.seconds(1) > 60 * large.seconds(64) > 0
    assert "20 tasks of 10 trajectories" in str(cost)
    texts = ["0.004 s", "70 s", "3.33 min", "2.78 h", "31.7 years"]
    assert [span(seconds) for seconds in (0.004, 70, 200, 1e4, 1e9)] == texts


@pytest.fixture(scope="module", params=["memory", "store"])
def result(request, tmp_path_factory):
    where = tmp_path_factory.mktemp("export") / "s.zarr" if request.param == "store" else None
    return sweep(start=starts.Halton(10, LOW, HIGH), epsilon=[0.0, 0.1, 1e200], lanes_per_task=4,
                 method=METHODS, save=FINAL, store=where)  # fmt: skip


@pytest.mark.slow
def test_stores_and_exported_files_are_the_dataset(result, tmp_path):
    wanted, file = result.to_xarray(), tmp_path / "s.nc"
    if result.path is not None:
        xr.testing.assert_identical(dvi.open_sweep(result.path).to_xarray(), wanted)
    result.to_netcdf(file)
    with xr.open_dataset(file, engine="h5netcdf") as found:
        xr.testing.assert_equal(found.load(), wanted)
        assert found.attrs["jax"] == jax.__version__
        assert found.status.attrs["flag_meanings"] == wanted.status.attrs["flag_meanings"]
    with pytest.raises(FileExistsError, match="force=True"):
        result.to_netcdf(file)
    result.to_netcdf(file, force=True)
    assert list(tmp_path.iterdir()) == [file]


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


def generated(start, indices):
    q, p = jax.vmap(lambda i: start.at(i, 0.0, None))(jnp.asarray(indices))
    return np.concatenate([q, p], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "error"), [(starts.Random, 0.03), (starts.Halton, 0.002)])
def test_generated_states_fill_their_box(kind, error):
    x = generated(kind(4096, LOW, HIGH, seed=3), np.arange(4096))
    low, high = np.concatenate(LOW), np.concatenate(HIGH)
    assert ((x >= low) & (x <= high)).all()
    assert (np.abs(x.mean(0) - (low + high) / 2) / np.maximum(high - low, 1)).max() < error
    assert len(np.unique(x[:, 0])) == 4096
    near(generated(kind(10, LOW, HIGH, seed=3), [7])[0], x[7])
    assert np.abs(generated(kind(10, LOW, HIGH, seed=4), [7])[0] - x[7]).max() > 1e-3


def test_halton_points_have_the_digits_in_reverse():
    """Point i − 1 is the radical inverse of i in the bases 2 and 3, plus a random shift."""
    indices = np.array([1, 5, 48, 12345])
    start = starts.Halton(12345, ([0.0], [0.0]), ([1.0], [1.0]))
    for points, base in zip(generated(start, indices - 1).T, (2, 3), strict=True):
        digits = [np.base_repr(i, base)[::-1] for i in indices]
        shifts = (points - [int(text, base) / base ** len(text) for text in digits]) % 1
        np.testing.assert_allclose(shifts, shifts[0], rtol=0, atol=1e-14)


def test_random_states_differ_beyond_32_bits():
    a, b = generated(starts.Random(2**40, LOW, HIGH), [5, 5 + 2**35])
    assert np.abs(a - b).max() > 1e-6


@pytest.mark.slow
def test_normal_states_have_their_spread():
    x = generated(starts.Normal(20000, [1.0, 2.0], [0.0, 0.0], ([0.1, 0.0], 0.3)), range(20000))
    near(x[:, 1], 2.0)
    np.testing.assert_allclose(np.std(x[:, [0, 2, 3]], axis=0), [0.1, 0.3, 0.3], rtol=0.03)


@pytest.mark.slow
def test_states_on_an_energy_shell():
    def H(t, q, p, args):
        return hamiltonian(t, t, q, p, args)

    box = ([-1.0, -1.0], [1.0, 1.0])
    found = sweep(start=starts.EnergyShell(500, H, 0.4, *box), save=FINAL, observe=None)
    q, p = found["q"][:, 0], found["p"][:, 0]
    at = jax.vmap(lambda q, p: H(0.0, q, p, {"k": 1.0}))(jnp.asarray(q), jnp.asarray(p))
    np.testing.assert_allclose(at, 0.4, rtol=1e-14)
    assert np.abs(np.mean(np.arctan2(p[:, 1], p[:, 0]))) < 0.3
    nowhere = starts.EnergyShell(4, H, -1.0, *box)
    assert sweep(start=nowhere).status_counts() == {"not_finite": 4}


def test_tasks_cover_the_grid_once():
    plan = make_plan({"method": 2, "a": 7, "b": 3, "c": 11}, 1, 100, 8, lanes=40)
    covered = np.zeros(plan.shape, int)
    for task in plan.tasks():
        covered[task.box] += 1
        assert plan.number(plan.place(task.number)) == task.number
    assert (covered == 1).all()
    assert plan.lanes_per_task <= 40
    assert plan.chunk[0] == 1


def test_the_size_of_a_task_depends_on_steps_and_bytes():
    for count, steps, size, least, most in (
        (10**6, 10_000, 32, 8192, 32768),
        (10**12, 10, 8, 1, 2**17),
        (10**9, 10**9, 8, 256, 256),
        (11, 1000, 8, 11, 11),
        (10**6, 100, 2**20, 1, 64),
    ):
        assert least <= make_plan({"start": count}, 0, steps, size).lanes_per_task <= most


def gpus(*sizes):
    """Substitutes for GPUs with so many bytes; None: unknown."""
    return [
        SimpleNamespace(
            platform="gpu",
            device_kind="none",
            memory_stats=lambda size=size: size and {"bytes_limit": size},
        )
        for size in sizes
    ]


def lanes_on(devices, operations, steps=10_000, size=8, count=2**30, largest=16):
    numbers = jnp.zeros(largest // 16)

    def one(x):
        for _ in range(max(operations // len(numbers), 1)):
            x = -x
        return x

    limits, weight = on_devices(devices, jax.make_jaxpr(one)(numbers).jaxpr)
    return make_plan({"start": count}, 0, weight * steps, size, limits=limits).lanes_per_task


def test_the_size_of_a_task_of_a_gpu():
    """It depends on the operations of a step, and on the smallest memory."""
    assert on_devices(jax.devices(), None) == (ON_CPU, 1)
    gpu = gpus(64 * 2**30)
    assert lanes_on(gpu, 256) == 2**18
    assert lanes_on(gpu, 512) == 2**17  # half a second of twice the work
    assert lanes_on(gpu, 9000) == 2**16  # fewer would leave the GPU idle
    assert lanes_on(gpu, 256, steps=1) == 2**20
    assert lanes_on(gpu, 256, size=2**14) == 2**14  # 256 MiB of results
    assert lanes_on(gpu, 256, count=2**17) == 2**16  # not in 32 tasks
    # Numbers of 8 bytes are an operand and a result, in two tasks of eight copies.
    much = 2**30
    assert lanes_on(gpus(much), 8, largest=2**12 + 16) == 2**13
    for largest, lanes in ((2**14, 2**12), (2**17, 2**9)):
        for sizes in ([much], [2 * much - 1], [2 * much, None, much]):
            assert lanes_on(gpus(*sizes), 8, largest=largest) == lanes
        assert lanes_on(gpus(None), 8, largest=largest) == 2 * lanes


def test_a_worker_of_a_cluster_uses_all_its_devices(monkeypatch):
    program = SimpleNamespace(devices="abc", plan=SimpleNamespace(task=int))
    monkeypatch.setattr(cluster, "_job", lambda job: (program, None, None, True))
    monkeypatch.setattr(cluster, "compute", lambda p, task, device: (device, {"statuses": {}}))
    assert "".join(cluster._task(b"", n)[0] for n in range(5)) == "abcab"


def test_results_of_a_gpu_are_copied_while_it_computes(monkeypatch):
    """Control: with one task at a time each waits for another until the barrier breaks."""
    devices, used, run = gpus(None, None), [], workers.compute

    def compute(program, task, device):
        used.append(device)
        # The first two tasks of a device; it may have an odd number of them in all.
        if used.count(device) <= 2:
            at_once[devices.index(device)].wait()
        return run(program, task, jax.devices()[0])

    monkeypatch.setattr(workers, "compute", compute)
    request = Request(SYSTEM, Q, P, epsilon=np.linspace(0, 0.1, 80), **DEFAULTS_OF_RUN)
    program, arrays, programs = dataclasses.replace(request, lanes_per_task=10).prepare()
    assert on_devices(devices, programs[0].jaxpr)[1] > 0
    program.devices = devices
    results = []
    for tasks_of_a_gpu, is_broken in ((2, False), (1, True)):
        used.clear()
        monkeypatch.setattr(workers, "_PER_GPU", tasks_of_a_gpu)
        at_once = [threading.Barrier(2, timeout=0.5 if is_broken else 60) for _ in devices]
        sink = stores.MemorySink(program.plan, arrays)
        with pytest.raises(threading.BrokenBarrierError) if is_broken else contextlib.nullcontext():
            assert workers.run_here(program, sink, None, None)
        results.append(sink)
    assert all(device in used for device in devices)
    assert [sink.done_tasks() for sink in results] == [{*range(8)}, set()]


# Others are in `test_mistakes`.
E, BOX, ALL_DEVICES = {"epsilon": [0.1]}, ([0.0], [1.0]), {"devices": jax.devices()}
STEPS = {"h": dvi.Axis("step", [0.1, 0.05]), "num_steps": dvi.Axis("step", [4, 8])}
GIVEN = {"lattice": dvi.Given([0.0, 0.1]), "h": None}
VALUE_ERRORS = {
    "nothing varies": {},
    r"got nan at index \[1\]": {"epsilon": [0.1, np.nan]},
    "the axis 'save' has a reserved name": {"epsilon": dvi.Axis("save", [0.1])},
    "'a b'": lambda: dvi.Axis("a b", [1.0]),
    "must be a list": lambda: dvi.Axis("a", np.asarray(3.0)),
    "'status' has a reserved name": E | {"observe": {"status": energy}},
    "'epsilon' has the name of an axis": E | {"observe": {"epsilon": energy}},
    "two observables": E | {"observe": {"a.b": energy, "a": {"b": energy}}},
    "'a/b' cannot be the name": E | {"observe": {"a/b": energy}},
    r"'\.\./x' cannot be the name": E | {"observe": {"../x": energy}},
    "'component' has the name of another": {"t0": dvi.Axis("component", X), "save": FINAL},
    "'h' has the name of another": STEPS | {"observe": {"h": dvi.Last(energy)}},
    "num_steps must be .* got None": E | {"num_steps": None},
    "at least 1, got 0": E | {"num_steps": 0},
    "one shape and dtype": {"num_steps": [2, 3], "save": dvi.Save(every=1)},
    "leave out the axis of t0": GIVEN | {"t0": [0.0, 1.0], "num_steps": None},
    "leave out num_steps": GIVEN | E,
    "threads must be": E | {"threads": 0},
    "number of devices must be": E | {"devices": []},
    "devices=.* has no effect with client": E | {"client": SimpleNamespace(submit=0)} | ALL_DEVICES,
    "lanes_per_task must be": E | {"lanes_per_task": 1.5},
    "each name in units must be": E | {"units": {"drft": "J"}},
    "be given together": E | {"method": METHODS[1], "integrator": dvi.Integrator()},
    "give both q0 and p0, .* got q0": E | {"p0": None},
    "give both q0 and p0, .* start": E | {"start": START, "q0": Q, "p0": P},
    "start has the name of an axis": E | {"start": starts.Random(4, LOW, HIGH, name="epsilon")},
    "identifier .* 'a/b'": E | {"start": starts.Random(4, LOW, HIGH, name="a/b")},
    "GiB of memory.*give store=": {"start": starts.Random(10**12, LOW, HIGH)},
    "count": lambda: starts.Random(0, LOW, HIGH),
    "low of Random must not exceed": lambda: starts.Random(3, HIGH, LOW),
    "must have one shape": lambda: starts.Random(3, LOW, ([1.0], [0.0])),
    "seed": lambda: starts.Halton(3, LOW, HIGH, seed=-1),
    "sigma of Normal must be zero": lambda: starts.Normal(3, [0.0], [0.0], (-1.0, 0.0)),
    "energy of EnergyShell": lambda: starts.EnergyShell(3, lambda q, p: p @ p, np.inf, *BOX),
}
TYPE_ERRORS = {
    "must be a list or array": lambda: dvi.Axis("a", 3.0),
    "path of a directory": E | {"store": 3},
    "progress must be": E | {"progress": 3},
    "units must be a dict": E | {"units": "J"},
    "of method must be a dvi.Method, got 'S": {"method": [dvi.TypeII(), "Strang"]},
    "one of dvi.starts": E | {"start": 3},
    "h must be": E | {"h": "x"},
    r"distributed\.Client": E | {"client": 3},
    "each of devices must be": E | {"devices": ["cpu"]},
    "sweep has no argument 'epsilom'. Did you mean 'epsilon'": E | {"epsilom": 1},
    "no argument 'newton'. Did you mean 'root_finder'": E | {"newton": None},
    "high of Random must be a pair": lambda: starts.Random(3, LOW, [0.0]),
    "sigma of Normal must be a pair": lambda: starts.Normal(3, [0.0], [0.0], 1.0),
    "H of EnergyShell": lambda: starts.EnergyShell(3, 1.0, 1.0, *BOX),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("errors", "error"), [(VALUE_ERRORS, ValueError), (TYPE_ERRORS, TypeError)]
)
def test_invalid_arguments(errors, error):
    for message, arguments in errors.items():
        with pytest.raises(error, match=message):
            sweep(**arguments) if isinstance(arguments, dict) else arguments()


def test_sweep_and_sweep_cost_list_their_keywords():
    for function in (dvi.sweep, dvi.sweep_cost):
        names = set(argument_names(function))
        assert {*DEFAULTS, "epsilon", "lattice", "start", "save", "store", "units"} <= names
        with pytest.raises(TypeError, match="has no argument 'stor'"):
            function(SYSTEM, Q, P, stor=3)


def test_the_memory_for_results_is_that_of_the_process(monkeypatch):
    monkeypatch.setattr(stores, "machine_memory", lambda: 1000)  # the limit of a container, say
    with pytest.raises(ValueError, match=r"GiB of memory.*give store="):
        sweep(start=starts.Random(100, LOW, HIGH))
