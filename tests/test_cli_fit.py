"""Fits from TOML files: what they find and write, how they go on, what they refuse."""

import json
import shutil
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import dvi_jax as dvi
from dvi_jax.run import InputError, fit_file
from dvi_jax_cli import app
from dvi_jax_cli.work.columns import read_columns
from dvi_jax_cli.work.fit_problem import fit_problem
from dvi_jax_cli.work.schema import FitFile
from dvi_jax_cli.work.table import Table, read_file

EXAMPLES = Path(__file__).parent.parent / "examples"

OWN = """
import jax.numpy as jnp
import dvi_jax as dvi

def H_D(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + args["k"] * (q0 @ q0) / 2

system = dvi.System(H_D, force=lambda t0, t1, q0, p1, args: -p1)

def square(t, q, p, args):
    return q[:1] ** 2

def too_few(t, q):
    return q

nothing = 3
"""

SMALL = """
system = "own.py:system"
h = 0.1
method = "Strang"
parameters = ["epsilon", "args.k"]
epsilon = 0.0
t0 = 0.0
[state]
q0 = [1.0]
p0 = [0.0]
[args]
k = 1.1
[data]
file = "seen.csv"
sigma = 0.01
[options]
curvature = false
[output]
dir = "out"
plots = false
"""

TRUTH = {"epsilon": 0.05, "args.k": 1.3}


def observed():
    """(times, positions) with errors of 0.01, of `TRUTH`."""
    import jax.numpy as jnp

    def H_D(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + 1.3 * (q0 @ q0) / 2

    system = dvi.System(H_D, force=lambda t0, t1, q0, p1, args: -p1)
    found = dvi.integrate(
        system, jnp.array([1.0]), jnp.array([0.0]), h=0.1, num_steps=120, epsilon=0.05,
        method=dvi.Strang(), save=dvi.Save(every=3),
    )  # fmt: skip
    noise = 0.01 * np.random.default_rng(5).normal(size=40)
    return np.asarray(found.ts)[1:], np.asarray(found.qs)[1:, 0] + noise


@pytest.fixture(scope="module")
def data():
    return observed()


def csv(ts, xs, head="t,x", row="{:.6g},{:.6f}"):
    return "\n".join([head, *(row.format(t, x) for t, x in zip(ts, xs, strict=True))]) + "\n"


@pytest.fixture
def folder(tmp_path, monkeypatch, data):
    (tmp_path / "own.py").write_text(OWN, encoding="utf-8")
    (tmp_path / "seen.csv").write_text(csv(*data), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(folder, text, name="fit.toml"):
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def command(*words):
    return CliRunner().invoke(app, ["fit", *(str(w) for w in words)])


def setup(folder, text):
    return fit_problem(read_file(write(folder, text), FitFile)[0], folder)


# What a fit finds and writes


@pytest.mark.slow
def test_a_small_fit(folder):
    result = command(write(folder, SMALL), "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout, parse_constant=pytest.fail)
    assert found["status"] == "converged"
    for name, truth in TRUTH.items():
        (key,) = (k for k in found["parameters"] if k.endswith(name.split(".")[-1]))
        told = found["parameters"][key]
        assert abs(told["value"] - truth) < 3.5 * told["error"], name
        assert told["error"] < 0.01
        assert abs(told["start"] - truth) > 3.5 * told["error"]  # the control: where it began
    assert 0.5 < found["reduced_chi2"] < 1.6
    assert {p.name for p in (folder / "out").iterdir()} == {"fit.npz", "fit.json", "trajectory.npz"}
    saved = dvi.FitResult.load(folder / "out" / "fit.npz")
    written = json.loads((folder / "out" / "fit.json").read_text(encoding="utf-8"))
    values = [p["value"] for p in written["parameters"].values()]
    np.testing.assert_array_equal(saved.x, values)
    with np.load(folder / "out" / "trajectory.npz") as file:
        assert file["ts"].shape == (121,)
        seen = np.abs(file["qs"][3::3, 0] - saved.observed[0][:, 0])
    assert np.sqrt(np.mean(seen**2)) == pytest.approx(saved.rms, rel=1e-9)


@pytest.mark.slow
def test_a_file_with_the_newest_observation_first(folder, data):
    oldest = command(write(folder, SMALL), "--json")
    (folder / "seen.csv").write_text(csv(*(x[::-1] for x in data)), encoding="utf-8")
    newest = command(write(folder, SMALL), "--json", "--force")
    assert newest.exit_code == 0, newest.output
    first, second = (json.loads(r.stdout)["parameters"] for r in (oldest, newest))
    assert first == second
    assert np.load(folder / "out" / "trajectory.npz")["ts"][-1] == pytest.approx(data[0][-1])


@pytest.mark.slow
def test_the_example(folder):
    shutil.copy(EXAMPLES / "fit.toml", folder)
    shutil.copy(EXAMPLES / "observations.csv", folder)
    result = command("fit.toml")
    assert result.exit_code == 0, result.output
    assert "Correlations" in result.output
    found = json.loads((folder / "results" / "fit" / "fit.json").read_text(encoding="utf-8"))
    truth = {"epsilon": 0.01, "q0[0]": 1.02, "q0[1]": 0, "p0[0]": 0, "p0[1]": 0.95}
    for name, value in truth.items():
        told = found["parameters"][name]
        assert abs(told["value"] - value) < 3.5 * told["error"], name
    assert found["missing"] == 1
    assert 0.7 < found["reduced_chi2"] < 1.4
    for name in ("data.png", "residuals.png", "parameters.png", "learning.png"):
        assert (folder / "results" / "fit" / name).stat().st_size > 5_000


@pytest.mark.slow
def test_a_fit_that_does_not_converge_is_written_and_goes_on(folder, monkeypatch):
    text = SMALL.replace("[options]", "[options]\nmax_steps = 1")
    monkeypatch.setattr(import_module("dvi_jax.fit.run"), "_EVERY", -1.0)  # at every step
    result = command(write(folder, text))
    assert result.exit_code == 1, result.output
    assert "did not converge (max_steps_reached" in result.stderr
    assert (folder / "out" / "checkpoint.npz").exists()
    path = write(folder, SMALL)
    assert command(path).exit_code == 2  # the control: nothing is gone on with unasked
    result = command(path, "--resume", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["steps"] > 1
    assert not (folder / "out" / "checkpoint.npz").exists()
    whole = command(path, "--out", "whole", "--json")
    first, again = (json.loads(r.stdout)["parameters"] for r in (result, whole))
    assert first == again  # the same bits as without the interruption


@pytest.mark.slow
def test_a_checkpoint_of_another_fit_is_refused(folder, monkeypatch):
    monkeypatch.setattr(import_module("dvi_jax.fit.run"), "_EVERY", -1.0)
    command(write(folder, SMALL.replace("[options]", "[options]\nmax_steps = 1")))
    result = command(write(folder, SMALL.replace("k = 1.1", "k = 1.2")), "--resume")
    assert result.exit_code == 2
    assert "is of another fit" in result.stderr


def test_ctrl_c(folder, monkeypatch):
    def stopped(*_, checkpoint, **__):
        Path(checkpoint).write_bytes(b"something")
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(dvi, "fit", stopped)
        result = command(write(folder, SMALL))
    assert result.exit_code == 130
    assert result.stderr.startswith("interrupted: ")
    assert "--resume" in result.stderr
    assert [p.name for p in (folder / "out").iterdir()] == ["checkpoint.npz"]


def test_an_error_amid_the_work_is_a_fault_and_no_bad_input(folder, monkeypatch):
    def broken(*_, progress, **__):
        progress(dvi.FitProgress(1, 2, 0, 1.0, 1.0, np.ones(1), ["x"], 1.0))
        raise ValueError("amid")

    monkeypatch.setattr(dvi, "fit", broken)
    result = command(write(folder, SMALL))
    assert result.exit_code == 1
    assert "a fault of dvi_jax" in result.stderr
    assert not (folder / "out").exists()


# What the data may be


def test_columns_of_a_csv(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("# first\n\n t ; x;y\n0;1.5;\n1;nan;-2e3\n", encoding="utf-8")
    found = read_columns(path)
    assert list(found) == ["t", "x", "y"]
    np.testing.assert_array_equal(found["x"], [1.5, np.nan])
    np.testing.assert_array_equal(found["y"], [np.nan, -2000.0])


def test_columns_observables_and_errors(folder, data):
    ts, xs = data
    rows = zip(ts, xs, 0 * ts + 0.02, strict=True)
    text = "time,x,s\n" + "".join(f"{t:.6g},{x:.6f},{s}\n" for t, x, s in rows)
    (folder / "seen.csv").write_text(text, encoding="utf-8")
    named = SMALL.replace("sigma = 0.01", 'sigma = "s"\ntime = "time"\nobserve = "own.py:square"')
    found = setup(folder, named)
    assert found.columns == ["x"]  # neither the time nor the errors
    np.testing.assert_array_equal(found.data.sigma, np.full((40, 1), 0.02))
    assert callable(found.data.observe)
    np.savez(folder / "seen.npz", ts=ts, qs=xs[:, None])
    of_npz = SMALL.replace('"seen.csv"', '"seen.npz"\ntime = "ts"\ncolumns = ["qs"]')
    np.testing.assert_array_equal(setup(folder, of_npz).data.values, xs[:, None])


def test_bounds_priors_and_options(folder):
    text = SMALL.replace("curvature = false", 'loss = "Cauchy"\nsegments = 3\nhorizons = "none"')
    text += "[bounds]\nepsilon = [-0.1, inf]\n[bounds.args]\nk = [0.5, 2]\n"
    text += '[priors]\n"args.k" = [1.2, 0.5]\n'
    found = setup(folder, text)
    assert found.options["bounds"]["epsilon"] == dvi.Bounds(-0.1, np.inf)
    assert found.options["bounds"]["args"]["k"] == dvi.Bounds(0.5, 2.0)
    assert found.options["priors"]["args"]["k"] == dvi.Prior(1.2, 0.5)
    assert isinstance(found.options["loss"], dvi.Cauchy)
    assert found.options["shooting"] == dvi.MultipleShooting(3)
    assert found.options["horizons"] is None
    assert set(found.params) == {"epsilon", "args"}


# What is refused: the key, what was seen, what is allowed

HEAD = "t,x\n"
BAD_DATA = [
    ("", "is empty", "a line of names"),
    (HEAD, "has names and no numbers", "at least one line"),
    (HEAD + "0.3,1\n0.6,abc\n", "seen.csv, line 3, column x: 'abc'", "a finite number"),
    (HEAD + "0.3,1\n0.6,1_000\n", "seen.csv, line 3, column x: '1_000'", "a finite number"),
    (HEAD + "0.3,1\n0.6,inf\n", "line 3, column x: 'inf'", "nan, where nothing was observed"),
    (HEAD + "0.3,1\n0.6\n", "line 3: 1 cells", "2, one for each"),
    (HEAD + "0.3,1\n,2\n", "time number 2 in t is nan", "finite times"),
    (HEAD + "0.3,1\n0.9,2\n0.6,2\n", "time number 3, 0.5", "times in order"),
    (HEAD + "0.3,1\n0.3,2\n", "time number 2, 0.29", "no two alike"),
    (HEAD + "0.3,1\n", "1 values for 2 parameters", "at least as many"),
    (HEAD + "0.3,\n0.6,nan\n", "no value in any row", "columns with numbers"),
    ("0.3,1\n0.6,2\n", "line 1: the number 0.3", "different names"),
    ("t,t\n0.3,1\n", "the name 't' again", "different names"),
    ("t,x,y\n0.3,1,2\n0.6,1,2\n", "2 numbers for each time (x, y)", "1: the positions"),
    ("time,x\n0.3,1\n", "'t' (text)", "a column of the file: time, x"),
    ("t\n0.3\n0.6\n", "no column remains", "out of t"),
    (HEAD + "-0.3,1\n0.6,2\n", "between the times", "in the order of time"),
    (HEAD + "-0.3,1\n-0.6,2\n", "0.1, which leads from t0 = 0 away", "-0.1, or a t0"),
    (HEAD + "-0.6,1\n-0.3,2\n", "0.1, which leads from t0 = 0 away", "-0.1, or a t0"),
]


@pytest.mark.parametrize(("text", "seen", "allowed"), BAD_DATA, ids=[b[1][:30] for b in BAD_DATA])
def test_bad_data_are_refused(folder, text, seen, allowed):
    (folder / "seen.csv").write_text(text, encoding="utf-8")
    result = command(write(folder, SMALL))
    assert result.exit_code == 2, result.output
    assert seen in result.stderr, result.stderr
    assert allowed in result.stderr.partition("allowed: ")[2]
    assert not (folder / "out").exists()  # nothing is left behind


REFUSED = [
    (
        "parameters = [",
        "parameter = [",
        "parameter: there is no such key",
        "did you mean parameters?",
    ),
    ('"args.k"]', '"args.K"]', "parameters: 'args.K'", "did you mean args.k?"),
    ('"args.k"]', '"epsilon"]', "is listed twice", "each name once"),
    ('["epsilon", "args.k"]', "[]", "parameters: []", "an array of names"),
    ('parameters = ["epsilon", "args.k"]', "", "parameters: the key is missing", '"epsilon", "q0"'),
    ("seen.csv", "sen.csv", "data.file: there is no file", "a CSV or npz file"),
    ('file = "seen.csv"', "", "data.file: the key is missing", "the path"),
    ("sigma = 0.01", "sigma = 0.0", "data.sigma: 0.0", "a positive number"),
    ("sigma = 0.01", "sigma = [0.01, 0.02]", "data.sigma: 2 of them", "one for all"),
    ("sigma = 0.01", 'sigma = "s"', "data.sigma: 's'", "a column of the file"),
    ("sigma = 0.01", 'columns = ["X"]', "data.columns: 'X'", "did you mean x?"),
    ("sigma = 0.01", 'observe = "position"', "data.observe: 'position'", "did you mean positions?"),
    ("sigma = 0.01", 'observe = "own.py:nothing"', "data.observe", "a function (t, q, p, args)"),
    ("sigma = 0.01", 'observe = "own.py:too_few"', "observe must be", "in the order of time"),
    ("curvature = false", 'loss = "SoftL2"', "options.loss: 'SoftL2'", "SoftL1"),
    ("curvature = false", "segments = 0", "options.segments: 0", "a positive whole number"),
    ("curvature = false", "tolerance = 2", "options.tolerance: 2", "between 0 and 1"),
    ("[options]", "[bounds]\nepsilon = 3\n[options]", "bounds.epsilon: 3", "[lower, upper]"),
    ("[options]", "[bounds]\nq0 = [0, 1]\n[options]", "bounds.q0: it is not among", "epsilon"),
    ("[options]", "[bounds]\nepsilon = [1, 2]\n[options]", "not between its bounds", "start"),
    ("[options]", "[priors]\nepsilon = [1, nan]\n[options]", "priors.epsilon", "[mean"),
    ("h = 0.1", "", "h: the key is missing", "a number"),
    ("k = 1.1", "K = 1.1", "KeyError: 'k'", "args"),
]


@pytest.mark.parametrize(
    ("old", "new", "seen", "allowed"), REFUSED, ids=[r[2][:35] for r in REFUSED]
)
def test_what_cannot_be_meant_is_refused(folder, old, new, seen, allowed):
    assert old in SMALL
    text = SMALL.replace(old, new)
    if "K = 1.1" in new:  # then the system's own functions are to say so
        text = text.replace('"args.k"', '"args.K"')
    result = command(write(folder, text))
    assert result.exit_code == 2, result.output
    assert seen in result.stderr, result.stderr
    assert allowed in result.stderr.partition("allowed: ")[2], result.stderr
    assert not (folder / "out").exists()


def test_toml_is_told_with_its_line(folder):
    result = command(write(folder, "system = 'kepler'\nh = = 3\n"))
    assert result.exit_code == 2
    assert "line 2" in result.stderr


def test_every_key_is_shown_in_an_example():
    """A key that no example shows is one that nobody finds."""
    text = (EXAMPLES / "fit.toml").read_text(encoding="utf-8")
    for key, field in FitFile.model_fields.items():
        assert f"{key} = " in text or f"[{key}]" in text or key == "args", key
        kind = field.annotation
        is_table = isinstance(kind, type) and issubclass(kind, Table) and key != "state"
        for name in kind.model_fields if is_table else ():
            assert f"{name} = " in text or name == "plots", f"{key}.{name}"


def test_in_python_too(folder):
    with pytest.raises(InputError, match="there is no such file"):
        fit_file("nowhere.toml")
