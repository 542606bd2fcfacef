"""The C side of the speed benchmark computes what the package does, and the table adds up."""

import functools
import importlib
import json
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

pytest.importorskip("matplotlib")
FOLDER = Path(__file__).parent.parent / "benchmarks"
LANES, STEPS, EVERY = 70, 20, 10
"""Lanes: more than a block of the C side, and no multiple of it."""

TOLERANCE = 1e-13


def module(name):
    """A file of the benchmarks, which import each other as scripts of one folder do."""
    sys.path.insert(0, str(FOLDER))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def baseline():
    made = module("_baseline")
    try:
        made.find_compiler()
    except made.NoCompilerError as error:
        pytest.skip(str(error))
    return made.Baseline()


@pytest.fixture(scope="module")
def speed():
    speed = module("speed")
    speed.plt.switch_backend("agg")
    return speed


@functools.cache
def expected(name):
    """The numbers of the package: saved states (S, n, lanes), and drift and slope of the energy."""
    w = module("_workloads").WORKLOADS[name]
    observe = None if w.energy is None else (dvi.MaxDrift(w.energy), dvi.Trend(w.energy))
    how = {"h": w.h, "num_steps": STEPS, "epsilon": module("_workloads").EPSILON, "args": w.args}
    how |= {"method": dvi.TypeII() if w.method is None else w.method, "throw": False}

    @functools.partial(jax.vmap, in_axes=-1, out_axes=-1)
    def run(q0, p0):
        save = dvi.Save(every=EVERY)
        sol = dvi.integrate(w.system, q0, p0, save=save, observe=observe, **how)
        return sol.qs, sol.ps, sol.observed

    return jax.tree.map(np.asarray, jax.jit(run)(*w.start(LANES)))


def settings(name):
    """The workload, its start, and the settings of the C side."""
    w = module("_workloads").WORKLOADS[name]
    epsilon = module("_workloads").EPSILON
    return w, w.start(LANES), {"h": w.h, "steps": STEPS, "epsilon": epsilon}


def defect(found, q, p):
    return max(np.max(np.abs(found["q"] - q)), np.max(np.abs(found["p"] - p)))


@pytest.mark.parametrize("lane", [slice(None), 3], ids=["batch", "one trajectory"])
@pytest.mark.parametrize("name", ["oscillator", "kepler"])
@pytest.mark.slow
def test_explicit_kernels_agree_with_the_package(baseline, name, lane):
    w, start, given = settings(name)
    qs, ps, (drift, slope) = (jax.tree.map(lambda x: x[..., lane], x) for x in expected(name))
    start, last = [x[:, lane] for x in start], (qs[-1], ps[-1])
    assert defect(baseline.final(w.kernel, *start, **given)(), *last) < TOLERANCE
    assert defect(baseline.saved(w.kernel, *start, every=EVERY, **given)(), qs, ps) < TOLERANCE
    streamed = baseline.streamed(w.kernel, *start, **given)()
    np.testing.assert_allclose(streamed["drift"], drift, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(streamed["slope"], slope, rtol=0, atol=TOLERANCE)
    if lane == 3:
        return
    assert defect(streamed, *last) < TOLERANCE
    assert np.min(drift) > 1e-4  # there was something to agree on
    other = given | {"epsilon": 2 * given["epsilon"]}
    assert defect(baseline.final(w.kernel, *start, **other)(), *last) > 1e6 * TOLERANCE


@pytest.mark.slow
def test_the_charged_particle_agrees_with_the_package(baseline):
    w, start, given = settings("mirror")
    qs, ps, _ = expected("mirror")
    last = qs[-1], ps[-1]
    assert defect(baseline.final("mirror", *start, **given)(), *last) < TOLERANCE * np.max(qs)
    one = baseline.final("mirror", *[x[:, 3] for x in start], **given)()
    assert defect(one, qs[-1, :, 3], ps[-1, :, 3]) < TOLERANCE * np.max(qs)
    half = given | {"h": w.h / 2, "steps": 2 * STEPS}
    assert defect(baseline.final("mirror", *start, **half)(), *last) > 1e6 * TOLERANCE


KERNELS = [
    *((name, name) for name in ("product", "pendulum", "pendulum_gauss", "pendulum_yoshida")),
    *((name, name) for name in ("chain2", "chain4", "chain10", "web10")),
    ("chain10", "chain10_tridiagonal"),
]


@pytest.mark.parametrize(("name", "kernel"), KERNELS)
@pytest.mark.slow
def test_implicit_kernels_agree_with_the_package(baseline, name, kernel):
    _, start, given = settings(name)
    qs, ps, _ = expected(name)
    iterations, correction = baseline.iterations_needed(kernel, *start, **given)
    assert correction < 1.5e-8  # √ε, so that the error is ε

    def run(start, iterations):
        return baseline.implicit(kernel, *start, iterations=iterations, **given)()

    assert defect(run(start, iterations), qs[-1], ps[-1]) < TOLERANCE
    assert defect(run(start, iterations + 1), qs[-1], ps[-1]) < TOLERANCE
    assert defect(run(start, iterations - 1), qs[-1], ps[-1]) > 10 * TOLERANCE
    one = run([x[:, 3] for x in start], iterations)
    assert defect(one, qs[-1, :, 3], ps[-1, :, 3]) < TOLERANCE


@pytest.mark.slow
def test_a_larger_step_takes_more_iterations(baseline):
    """And the library leaves subnormal numbers alone."""
    _, start, given = settings("product")
    few, _ = baseline.iterations_needed("product", *start, **given)
    many, _ = baseline.iterations_needed("product", *start, **(given | {"h": 0.2}))
    assert few < many
    with pytest.raises(RuntimeError, match="does not converge"):
        baseline.iterations_needed("product", *start, **(given | {"h": 4.0}))
    assert np.float64(2.0**-1040) / np.float64(2.0) == 2.0**-1041


def test_a_missing_compiler_is_reported(monkeypatch, tmp_path):
    compiled = module("_baseline")
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(compiled.NoCompilerError, match="Install one"):
        compiled.find_compiler()
    fails = f"{sys.executable} -c 'raise SystemExit(3)'"
    for compiler, fault in (("no-such-compiler", "does not start"), (fails, "does not compile")):
        monkeypatch.setenv("CC", compiler)
        with pytest.raises(compiled.NoCompilerError, match=fault):
            compiled.Baseline()


def test_the_table_has_every_row_of_the_targets(speed):
    rows = {row.name: row for row in speed.table()}
    kinds = "kepler, ", "oscillator", "implicit", "double pendulum", "charged particle"
    kinds += "one trajectory", "reverse gradient", "forward mode", "first call: ", "first call, "
    counts = [sum(name.startswith(kind) for name in rows) for kind in kinds]
    assert counts == [7, 3, 6, 2, 2, 4, 4, 2, 7, 7]
    assert len(rows) == len(speed.table())  # names are unique
    assert [name for name, row in rows.items() if row.at_least] == ["two cores, kepler"]
    assert [row.name for row in speed.chosen(["one*kepler"])] == ["one trajectory, kepler"]
    with pytest.raises(SystemExit, match="no row matches"):
        speed.chosen(["one*kepler", "no such row"])


def test_a_ratio_is_one_for_the_same_work_and_grows_with_it(speed):
    clock, x = speed.Clock(rounds=15, budget=20.0), jnp.linspace(0.1, 0.9, 4096)

    def work(count):
        step = jax.jit(lambda x: jax.lax.fori_loop(0, count, lambda _, y: jnp.sin(y + x), x))
        return lambda: step(x)

    same = speed.ratio(clock.times(work(100), work(100)))
    thrice = speed.ratio(clock.times(work(300), work(100)))
    assert 0.5 < float(same) < 2
    assert float(thrice) > 1.5 * float(same)
    by_work = speed.ratio(clock.times(work(300), work(100)), work=(3, 1))
    assert float(by_work) < float(thrice) / 1.5


def test_waiting_does_not_count_as_work(speed):
    def spin():
        began = time.process_time()
        while time.process_time() - began < 0.005:
            pass

    def wait():
        spin()
        time.sleep(0.05)

    measured = speed.ratio(speed.Clock(5, 10.0).times(wait, spin))
    assert 0.5 < float(measured) < 2
    assert measured.details["wall_ratio"] > 2 * float(measured)
    assert "wall" in speed.wall({"value": float(measured), **measured.details})
    assert speed.wall({"value": 2.0, "wall_ratio": 2.1}) == ""


def test_growing_ratios_are_found_and_set_the_exit_status(speed, tmp_path, capsys):
    before = {"a": 2.0, "b": 1.0, "flat": 0.0}
    for now, worse in (
        ({"a": 2.1, "b": 1.2, "flat": 1e-4}, []),
        ({"a": 2.7}, [("a", 2.7, 2.0)]),
        ({"a": None}, [("a", None, 2.0)]),
        ({"flat": 0.5}, [("flat", 0.5, 0.0)]),
    ):
        assert speed.worse(now, before, 1.3) == worse
    assert speed.worse({"a": float("nan")}, before, 1.3)
    with pytest.raises(ValueError, match="nothing was checked"):
        speed.worse({"new": 1.0}, before, 1.3)
    file = tmp_path / "ratios.json"
    file.write_text(json.dumps({"ratios": {"a": 1.0}}))

    def ratio(value):
        others = ({"row": "b", "unit": "s", "value": 9.0}, {"row": "c", "unit": "× faster"})
        return speed.ratios([{"row": "a", "unit": "×", "value": value}, *others])

    assert ratio(1.1) == {"a": 1.1}  # seconds depend on the machine
    for first, second, status in ((1.1, None, 0), (1.5, 1.2, 0), (1.5, 1.4, 1), (1.5, None, 1)):
        assert speed.check(ratio(first), file, 1.3, lambda rows, x=second: ratio(x)) == status
    assert "1.4   was 1" in capsys.readouterr().out
    file.write_text(json.dumps({"ratios": {"other": 1.0}}))
    assert speed.check(ratio(1.1), file, 1.3, lambda rows: ratio(1.1)) == 2


def test_the_status_of_a_row(speed):
    """Missed above a target, or below one that is a lower limit; failed with an error."""

    def status(value, **settings):
        row = speed.Row("any", 1.8, lambda bench: speed.Measured([value], {}), **settings)
        return speed.measured(row, None)["status"]

    assert (status(1.7), status(1.9)) == ("ok", "missed")
    assert (status(1.7, at_least=True), status(1.9, at_least=True)) == ("missed", "ok")

    def broken(bench):
        raise ZeroDivisionError("on purpose")

    result = speed.measured(speed.Row("broken", 1.0, broken), None)
    assert result["status"] == "failed"
    assert "on purpose" in result["error"]
    assert "FAILED" in speed.line(result)


@pytest.mark.parametrize("axis", [0, -1])
@pytest.mark.slow
def test_rows_are_measured_and_reported(baseline, speed, tmp_path, axis):
    bench = speed.Bench(speed.Clock(rounds=3, budget=1.0), axis)
    small = {"name": "kepler", "lanes": 64, "steps": 20}
    rows = [
        speed.measured(speed.Row("row", target, functools.partial(measure, **settings)), bench)
        for target, measure, settings in (
            (1e9, speed.batch_row, small),
            (1e9, speed.batch_row, small | {"what": "invariants"}),
            (1e9, speed.batch_row, small | {"what": "saved"}),
            (1e-9, speed.batch_row, small | {"name": "product"}),
            (None, speed.last_axis_row, small),
            (None, speed.one_row, {"name": "product", "steps": 20}),
            (None, speed.gradient_row, small),
            (None, speed.forward_mode_row, small),
            (None, speed.million_row, small | {"lanes": (128, 64)}),
            (None, speed.again_row, {"name": "kepler", "steps": 10, "calls": 1}),
        )
    ]
    assert [r["status"] for r in rows] == ["ok"] * 3 + ["missed"] + ["no target"] * 6, rows
    assert all(r["value"] > 0 for r in rows)
    assert rows[3]["c_iterations"] == 2
    assert "missed" in speed.as_text(rows)
    speed.picture(rows, tmp_path / "speed.png")
    assert (tmp_path / "speed.png").stat().st_size > 1000


@pytest.mark.slow
def test_fresh_processes_measure(baseline, speed):
    bench = speed.Bench(speed.Clock(rounds=3, budget=0.0), cores=speed.available_cores())
    small = {"name": "kepler", "lanes": 64, "steps": 20}
    assert 0 < float(speed.first_call_row(bench, on_disk=False, gradient=True, **small)) < 60
    from_disk = speed.first_call_row(bench, on_disk=True, **small)
    assert 0 < float(from_disk) < 60
    assert from_disk.details["filling_seconds"] > 0
    if len(bench.cores) > 1:
        assert 0 < float(speed.cores_row(bench, rounds=1, **small)) < 100
    if Path("/proc/self/clear_refs").exists():
        measured = float(speed.memory_row(bench, name="kepler", lanes=200_000, steps=2))
        assert 0.9 < measured < 20  # inputs and outputs at least
    with pytest.raises(RuntimeError, match="cores, not"):
        bench.fresh("wall_time", cores=len(bench.cores) + 1)
    with pytest.raises(RuntimeError, match="KeyError"):
        bench.fresh("wall_time", workload="no such workload", lanes=1, steps=1, rounds=1)


@pytest.mark.slow
def test_memory_of_adjoints_is_distinguished(baseline, speed):
    bench = speed.Bench(speed.Clock(rounds=3, budget=1.0))
    of = functools.partial(speed.gradient_memory_row, bench, "kepler", 4, (200, 1000))
    assert float(of(adjoint=dvi.Direct())) > 1  # stores what every step needs
    assert float(of(adjoint=dvi.Reversible())) < 0.1


@pytest.mark.slow
def test_a_peer_that_computes_something_else_is_not_timed(baseline, speed):
    pytest.importorskip("scipy")
    peers, clock = module("peers"), speed.Clock(rounds=3, budget=1.0)
    (honest,) = (p for p in peers.all_peers() if (p.package, p.task) == ("scipy", "one kepler"))

    def displaced(work):
        return peers.run_scipy(work._replace(q0=work.q0 * np.array([1.0, 1.01])))

    found, allowed = peers.agreement(honest, baseline)
    assert found < allowed
    wrong = peers.compared(honest._replace(prepare=displaced), baseline, clock)
    assert wrong["status"] == "DISAGREES"
    assert "value" not in wrong

    def absent(work):
        raise ImportError("no module named so")

    assert peers.compared(honest._replace(prepare=absent), baseline, clock)["status"] == (
        "not installed"
    )
