"""Sweeps from TOML files: axes, resuming a store, rejected input, Ctrl-C."""

import re
import shutil
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
from cli import EXAMPLES, MAIN, command, found, refuses, write
from dvi_jax.run import InputError, sweep_file, sweep_status
from jax._src import pretty_printer

import dvi_jax as dvi
from dvi_jax.sweep import store
from dvi_jax_cli.work.loader import Loader
from dvi_jax_cli.work.schema import SweepFile
from dvi_jax_cli.work.sweep import sweep_problem
from dvi_jax_cli.work.table import read_file

OWN = """
import jax.numpy as jnp
import dvi_jax as dvi

def H_D(t0, t1, q0, p1, args):
    return args["k"] * jnp.sum(q0**2) / 2 + jnp.sum(p1**2) / 2

system = dvi.System(H_D, force=lambda t0, t1, q0, p1, args: -p1)

def H(t, q, p, args):
    return H_D(t, t, q, p, args)

def failing(t, q, p, args):
    return q.nothing

def energy(t0, t1, q0, p0, q1, p1, args):
    return H_D(t0, t1, q1, p1, args)

def both(t0, t1, q0, p0, q1, p1, args):
    return jnp.concatenate([q1, p1])
"""

SMALL = """
system = "own.py:system"
h = 0.1
steps = 30
epsilon = {linspace = [0.0, 0.2, 12]}
[state]
q0 = [0.5]
p0 = [0.1]
[args]
k = 1.0
[observables]
energy = "own.py:energy"
drift = "MaxDrift(own.py:energy)"
[output]
store = "out.zarr"
lanes_per_task = 4
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    write(tmp_path, OWN, "own.py")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The store of `SMALL`, made once."""
    place = tmp_path_factory.mktemp("finished")
    write(place, OWN, "own.py")
    sweep_file(write(place, SMALL), store=place / "out.zarr")
    return place / "out.zarr"


@pytest.fixture
def small(folder, finished):
    """The file `SMALL` next to its store, in which all tasks are done."""
    shutil.copytree(finished, folder / "out.zarr")
    return write(folder, SMALL)


def arguments(folder, text):
    return sweep_problem(read_file(write(folder, text), SweepFile)[0], folder)[1]


def contents(path):
    """Every number in a store, by name."""
    data = dvi.open_sweep(path).to_xarray()
    return {name: data[name].values for name in data.data_vars}


def assert_same(a, b):
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])


@pytest.mark.slow
def test_the_same_sweep_in_python(folder):
    """A store is resumed only by the same sweep: axes, methods, functions, to the last bit."""
    text = """
        system = "own.py:system"
        h = {values = [0.1, 0.05], axis = "size"}
        steps = {linspace = [10, 20, 2], axis = "size"}
        epsilon = {geomspace = [1e-4, 1e-1, 3]}
        method = {values = ["TypeII", "Adjoint(TypeII)"], axis = "size"}
        save = "final"
        [state]
        q0 = [{linspace = [-0.2, 0.2, 3], axis = "x", units = "m"}, 1.2]
        p0 = [0.1, 0.2]
        [args]
        k = {values = [1.0, 1.1]}
        [observables]
        last = "own.py:energy"
        drift = "MaxDrift(own.py:energy)"
    """
    report = sweep_file(write(folder, text), store="here.zarr")
    assert report.contents["trajectories"] == {"successful": 36}
    own = Loader(folder)
    energy = own.load("", "own.py:energy")
    again = dvi.sweep(
        own.load("", "own.py:system"),
        [dvi.Axis("x", np.linspace(-0.2, 0.2, 3)), 1.2],
        np.asarray([0.1, 0.2]),
        h=dvi.Axis("size", [0.1, 0.05]),
        num_steps=dvi.Axis("size", [10, 20]),
        epsilon=np.geomspace(1e-4, 1e-1, 3),
        args={"k": dvi.Axis("k", [1.0, 1.1])},
        method=dvi.Axis("size", [dvi.TypeII(), dvi.Adjoint(dvi.TypeII())]),
        save=dvi.Save(final=True),
        observe={"last": dvi.Last(energy), "drift": dvi.MaxDrift(energy)},
        store="here.zarr",
        progress=lambda p: pytest.fail("not all was done") if p.tasks_done < p.num_tasks else None,
    ).to_xarray()
    assert again.drift.dims == ("size", "epsilon", "k", "x")
    assert dvi.open_sweep("here.zarr").to_xarray().x.attrs["units"] == "m"
    assert report.contents["observed"]["drift"]["max"] == again.drift.values.max()


def test_axes_in_arrays(folder):
    masses = "masses = [1.0, {values = [0.1, 0.2], axis = 'm'}, 2.0]"
    text = f'system = "n_body"\nsteps = 3\n[args]\n{masses}\n'
    axis = arguments(folder, text)["args"]["masses"]
    assert axis.name == "m"
    np.testing.assert_array_equal(axis.values, [[1.0, 0.1, 2.0], [1.0, 0.2, 2.0]])
    method = arguments(folder, 'method = ["TypeII", "Yoshida(4)"]' + SMALL)["method"]
    assert (method.name, method.values) == ("method", [dvi.TypeII(), dvi.Yoshida(4)])
    states = SMALL.replace("q0 = [0.5]", 'q0 = {values = [[0.5], [0.6]], axis = "start"}')
    np.testing.assert_array_equal(arguments(folder, states)["q0"].values, [[0.5], [0.6]])


SIDES = "low = [-1]\nhigh = [1]\n"
CORNERS = "low = {q = [0], p = [0]}\nhigh = {q = [1], p = [2]}\n"


@pytest.mark.parametrize(
    ("kind", "keys", "made"),
    [
        ("halton", CORNERS + "seed = 3", dvi.starts.Halton),
        ("random", CORNERS + 'name = "s"', dvi.starts.Random),
        ("normal", "q0 = [1]\np0 = [0]\nsigma = {q = 1, p = [2]}", dvi.starts.Normal),
        ("energy_shell", f"energy = 1.0\n{SIDES}H = 'own.py:H'", dvi.starts.EnergyShell),
    ],
)
def test_generated_initial_conditions(folder, kind, keys, made):
    head, _, tail = SMALL.partition("[state]")
    table = f'[start]\nkind = "{kind}"\ncount = 20\n{keys}\n[args]'
    start = arguments(folder, head + table + tail.partition("[args]")[2])["start"]
    assert isinstance(start, made)
    seed, name = 3 if "seed" in keys else 0, "s" if "name" in keys else "start"
    assert (start.count, start.seed, start.name) == (20, seed, name)
    q, p = start.at(np.int32(4), 0.0, {"k": 1.0})
    assert q.shape == p.shape == (1,)


@pytest.mark.slow
def test_the_example(folder):
    result = command("sweep", EXAMPLES / "sweep.toml")
    assert result.exit_code == 0, result.output
    assert "3072 trajectories in" in result.output
    assert "median" in result.output
    data = dvi.open_sweep("results/sweep.zarr").to_xarray()
    assert data.energy_drift.dims == ("epsilon", "start")
    assert data.angular_momentum_drift.max() < 1e-12
    assert data.energy_drift.min() > 1e-3  # negative control


@pytest.mark.slow
def test_observables_of_several_numbers_on_given_times(folder):
    text = SMALL.replace('"own.py:energy"\n', '"own.py:both"\n', 1)
    text = text.replace("h = 0.1\nsteps = 30", "lattice = {times = [0.0, 0.1, 0.3]}")
    report = sweep_file(write(folder, text), threads=1)
    assert "trajectories/s; " in sweep_status("out.zarr").summary  # without steps
    energy = contents("out.zarr")["energy"]
    assert energy.shape == (12, 2)
    assert report.contents["observed"]["energy"]["max"] == energy.max()


OF_A_FILE = """
import jax.numpy as jnp
import dvi_jax as dvi

class Stiffness(dvi.starts.Seeded):
    \"\"\"From q = 1 at rest; the stiffness of number i is (1 + i)².\"\"\"
    def at(self, index, t0, args):
        k = (1.0 + index) ** 2
        return jnp.ones(1), jnp.zeros(1), {**args, "k": k}

starts = Stiffness(3, (1,), 0, "start")
at_zero = dvi.Stop(lambda t, q, p, args: -q[0])
wall = dvi.Jump(at_zero.g, lambda q, p: (q, -p))
"""


def test_starts_with_parameters_and_a_stop_from_a_file(folder):
    """An oscillator of frequency ω = 1 + i is at q = 0 after a quarter of its period."""
    write(folder, OF_A_FILE, "file.py")
    text = SMALL
    for old, new in {
        "epsilon = {linspace = [0.0, 0.2, 12]}": 'epsilon = 0.0\nstop = "file.py:at_zero"',
        "[state]\nq0 = [0.5]\np0 = [0.1]": '[start]\nkind = "own"\nstarts = "file.py:starts"',
        "h = 0.1\nsteps = 30": 'h = 0.02\nmethod = "Yoshida(4)"\nsteps = 100',
    }.items():
        text = text.replace(old, new)
    report = sweep_file(write(folder, text), threads=1)
    assert report.contents["trajectories"]["stopped"] == 3
    np.testing.assert_allclose(
        contents("out.zarr")["stop_t"], np.pi / 2 / np.arange(1, 4), rtol=1e-6
    )
    bounces = text.replace('stop = "file.py:at_zero"', 'jump = "file.py:wall"')
    bounces = bounces.replace("own.py:energy", "own.py:H")
    sweep_file(write(folder, bounces, "jump.toml"), store=folder / "jump.zarr", threads=1)
    np.testing.assert_array_equal(contents("jump.zarr")["jumps.count"], [1, 1, 2])
    for name, bad in (("stop", "starts"), ("starts", "at_zero")):
        wrong = re.sub(f'{name} = "file.py:\\w+"', f'{name} = "file.py:{bad}"', text)
        with pytest.raises(InputError, match=name):
            sweep_file(write(folder, wrong, "wrong.toml"), store=folder / "other.zarr")


@pytest.mark.slow
def test_a_store_is_resumed_only_with_resume(folder, small):
    """And only by the same sweep; --store takes the place of output.store."""
    before = contents("out.zarr")
    refuses(command("sweep", small), "3 of 3 tasks are done", "--resume")
    other = SMALL.replace("h = 0.1", "h = 0.2").replace("k = 1.0", "k = 1.5")
    result = command("sweep", write(folder, other, "other.toml"), "--resume")
    for seen in ("holds another sweep", "args.k: ", "h: "):
        refuses(result, seen)
    assert "epsilon: " not in result.stderr
    assert_same(contents("out.zarr"), before)

    dvi.open_sweep("out.zarr")._source.record_path(1).unlink()
    status = found("sweep", "status", "out.zarr")
    assert status["tasks"] == {"done": 2, "left": 1, "all": 3}
    assert status["trajectories"] == {"not_computed": 4, "successful": 8}
    assert status["steps_per_second"] == pytest.approx(30 * status["trajectories_per_second"])
    resumed = command("sweep", "run", small, "--resume", "--threads", 1)
    assert resumed.exit_code == 0, resumed.output
    assert_same(contents("out.zarr"), before)
    shown = command("sweep", "status", "out.zarr")
    assert "3 of 3 tasks done" in shown.stdout
    assert "dvi-jax" in shown.stdout
    assert "all tasks were done already" in command("sweep", small, "--resume").output

    assert command("sweep", small, "--store", "other.zarr", "--resume").exit_code == 0
    assert_same(contents("other.zarr"), before)


def test_a_batch_job_is_resumed_in_a_terminal(small, monkeypatch):
    """Where JAX sees a terminal it prints in colours; the sweep is the same."""
    monkeypatch.setattr(pretty_printer, "CAN_USE_COLOR", True)
    before = jax.config.jax_pprint_use_color
    jax.config.update("jax_pprint_use_color", True)
    try:
        result = command("sweep", small, "--resume")
    finally:
        jax.config.update("jax_pprint_use_color", before)
    assert result.exit_code == 0, result.stderr


def test_a_dry_run_writes_nothing_and_a_place_without_a_store(folder):
    result = command("sweep", write(folder, SMALL), "--dry-run")
    assert result.exit_code == 0, result.stderr
    assert "3 tasks of 4 trajectories" in result.stdout
    assert "| 1e+12 | 2.5e+11 |" in result.stdout
    assert not (folder / "out.zarr").exists()
    path = write(folder, SMALL)
    for place in (folder, "own.py"):
        result = command("sweep", path, "--resume", "--store", place)
        refuses(result, "is not the store of a sweep")
    for word in ("status", "verify"):
        refuses(command("sweep", word, "nowhere.zarr"), "there is no sweep here")


@pytest.mark.slow
def test_a_flipped_byte_is_found_and_repaired(folder, small):
    before = contents("out.zarr")
    assert command("sweep", "verify", "out.zarr").exit_code == 0
    shard = folder / "out.zarr" / "drift" / "c" / "1"
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    result = command("sweep", "verify", "out.zarr")
    assert result.exit_code == 1, result.output
    assert "the shard of drift has another checksum" in result.stdout
    assert "2 tasks are correct, 1 bad" in result.stdout
    assert "--resume" in result.stderr
    assert sweep_status("out.zarr").contents["tasks"]["left"] == 1
    assert command("sweep", small, "--resume").exit_code == 0
    assert command("sweep", "verify", "out.zarr").exit_code == 0
    assert_same(contents("out.zarr"), before)


def test_failed_trajectories_are_results(folder):
    text = SMALL.replace("{linspace = [0.0, 0.2, 12]}", "{values = [0.1, 1e200]}")
    result = command("sweep", write(folder, text))
    assert result.exit_code == 0, result.output
    assert "not_finite" in result.output
    assert "50 %" in result.output


def test_a_full_disk(folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(store, "publish", full)
        result = command("sweep", write(folder, SMALL))
    assert result.exit_code == 1
    assert "cannot be written (No space left on device)" in result.stderr
    assert "--resume" in result.stderr
    assert sweep_status("out.zarr").contents["tasks"]["left"] == 3


@pytest.mark.slow
def test_ctrl_c_leaves_a_store_that_can_be_resumed(folder):
    text = SMALL.replace("0.2, 12]", "0.2, 24]").replace("steps = 30", "steps = 400_000")
    path = write(folder, text.replace("lanes_per_task = 4", "lanes_per_task = 1"))
    # Started in the background, tests and their children have Ctrl-C ignored: here it raises.
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    words = [sys.executable, "-c", code + MAIN, "sweep", str(path), "--threads", "1"]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 60
    while not list(folder.glob("out.zarr/.tasks/*/*.json")) and time.monotonic() < until:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=60)
    assert process.returncode == 130, message
    assert message.startswith("interrupted: ")
    assert re.search(r"tasks are done and stored in \S+out\.zarr;", message)
    assert "--resume" in message
    assert "Traceback" not in message
    tasks = sweep_status("out.zarr").contents["tasks"]
    assert 1 <= tasks["done"] < 24, tasks
    sweep_file(path, resume=True)
    sweep_file(path, store="whole.zarr")
    assert_same(contents("out.zarr"), contents("whole.zarr"))


KEPLER = 'system = "kepler"\nsteps = 5\n'
EPS = KEPLER + "epsilon = {values = [0.1]}\n"
E, K, Q = KEPLER + "epsilon = ", KEPLER + "[args]\nK = ", KEPLER + "[state]\nq0 = "
HALTON = KEPLER + '[start]\nkind = "halton"\ncount = 3\n'
BOX = "low = {q = [0, 1], p = [0, 0]}\nhigh = {q = [1, 2], p = [1, 1]}\n"
SHELL = "[start]\nkind = 'energy_shell'\ncount = 2\nenergy = -1\nlow = [0, 1]\nhigh = [1, 2]\n"
IN_A = "{values = [1], axis = 'a'}"
REJECTED = [
    (KEPLER, "epsilon: neither epsilon nor another number varies", "[start]"),
    (E + "[0.1, 0.2]", "epsilon: the value is [0.1, 0.2] (an array)", "{values = […]}"),
    (E + "{lin = 3}", "epsilon.lin: there is no such key", "linspace, geomspace, values"),
    (E + "{linspace = [0, 1, 2], values = [1]}", "epsilon: ", "one of {linspace"),
    (E + "{linspace = [0, 1, 2.5]}", "epsilon.linspace: the value is [0, 1, 2.5]", "whole"),
    (E + "{geomspace = [0, 1, 3]}", "epsilon.geomspace: the value is [0, 1, 3]", "above zero"),
    (E + "{linspace = [0, 1, 10_000_001]}", "epsilon.linspace[2]", "at most 10000000"),
    (E + "{values = [0.1, nan]}", "epsilon.values[1]: the value is nan", "without an axis"),
    (E + "{values = [1], axis = 'a b'}", "epsilon.axis: the value is 'a b'", "a name"),
    (E + "{values = [1], axis = 'status'}", "epsilon.axis: the value is 'status'", "except status"),
    (E + "{values = [1, 2], axis = 'a'}\nh = " + IN_A, "2 values in epsilon and 1", "axes"),
    (EPS + "[observables]\n'zarr.json' = 'energy'", "the observable 'zarr.json'", "fit"),
    (EPS + "[observables]", "observables: nothing would be saved", 'save = "final"'),
    (EPS + "[observables]\nepsilon = 'energy'", "has the name of an axis", "fit one another"),
    (EPS + "save = 'all'", "save: the value is 'all' (text)", "{every = n}"),
    (KEPLER + "h = {linspace = [-1, 1, 3]}", "h.linspace[1]: the value is 0.0", "without an axis"),
    ("system = 'kepler'\nsteps = {values = [1, 2.5]}", "steps.values[1]", "without an axis"),
    (Q + "[{values = [1.0]}, 0.0]", "state.q0[0].axis: the key is missing", 'axis = "x"'),
    (Q + f"[{IN_A}]", "state.p0: p0 has shape (2,)", "(1,)"),
    (Q + "{values = [[0, 0], [0, 0]], axis = 'x'}", "state: q0 must not be at the centre", "start"),
    (K + "{linspce = [1, 2, 3]}", "args.K: the value is {'linspce'", "in a sweep also an axis"),
    (K + "{values = [1, [2]]}", "args.K.values: the value is [1, [2]]", "one shape"),
    (K + f"[{IN_A}, {{values = [1], axis = 'b'}}]", "args.K: one array", "same name"),
    (KEPLER + "method = ['TypeII', 'Strng']", "method: 'Strng'", "did you mean Strang?"),
    (KEPLER + "[start]\ncount = 3", "start.kind: the key is missing", "normal"),
    (HALTON + BOX.replace("low = {q", "low = {x"), "start.low.x: there is no such key", "q, p"),
    (HALTON + "low = [0, 0]\nhigh = [1, 1]", "start.low", "the keys q, p"),
    (HALTON + BOX.replace("[1, 1]", "[-1, 1]"), "start: low of Halton must not", "halton"),
    (HALTON + BOX + "[state]\nq0 = [0, 1]", "state.q0", "[start]"),
    (HALTON + CORNERS, "state: the Kepler problem is in the plane", "start"),
    (KEPLER + SHELL + "H = 'own.py:failing'", "(own.py, line 14)", "H (t, q, p, args)"),
]


@pytest.mark.parametrize(("text", "seen", "allowed"), REJECTED)
def test_bad_input(folder, text, seen, allowed):
    refuses(command("sweep", write(folder, text), "--store", "out"), seen, allowed)
    assert not (folder / "out").exists()


def test_the_command_line_itself(folder):
    assert "status" in command("sweep", "--help").output
    for words in ([], [write(folder, SMALL), "--threads", 0], ["--stor", "x"]):
        assert command("sweep", *words).exit_code == 2
    with pytest.raises(InputError, match="there is no such file"):
        command("sweep", "x.toml", "--debug", catch_exceptions=False)
