"""Fits from TOML files: what they find and write, how they resume, which input they reject."""

import shutil
from importlib import import_module
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from cli import EXAMPLES, command, found, names, read, refuses, write

import dvi_jax as dvi
from dvi_jax_cli.work.columns import read_columns
from dvi_jax_cli.work.fit import fit_problem
from dvi_jax_cli.work.schema import FitFile
from dvi_jax_cli.work.system import find_source
from dvi_jax_cli.work.table import read_file

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


@pytest.fixture(scope="module")
def data():
    """Times and positions for ε = 0.05 and k = 1.3, with errors of 0.01."""

    def H_D(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + 1.3 * (q0 @ q0) / 2

    system = dvi.System(H_D, force=lambda t0, t1, q0, p1, args: -p1)
    run = {"h": 0.1, "num_steps": 120, "epsilon": 0.05, "method": dvi.Strang()}
    state = jnp.array([1.0]), jnp.array([0.0])
    seen = dvi.integrate(system, *state, save=dvi.Save(every=3), **run)
    noise = 0.01 * np.random.default_rng(5).normal(size=40)
    return np.asarray(seen.ts)[1:], np.asarray(seen.qs)[1:, 0] + noise


def csv(ts, xs):
    rows = [f"{t:.6g},{x:.6f}" for t, x in zip(ts, xs, strict=True)]
    return "\n".join(["t,x", *rows]) + "\n"


@pytest.fixture
def folder(tmp_path, monkeypatch, data):
    write(tmp_path, OWN, "own.py")
    write(tmp_path, csv(*data), "seen.csv")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def setup(folder, text):
    file, _ = read_file(write(folder, text), FitFile)
    return fit_problem(file, find_source(file, folder))


@pytest.mark.slow
def test_a_small_fit(folder, data):
    """Parameters within their errors; the files agree; the order of the rows has no effect."""
    fitted = found("fit", write(folder, SMALL))
    assert fitted["status"] == "converged"
    parameters = fitted["parameters"]
    for name, truth in (("epsilon", 0.05), ("k", 1.3)):
        (p,) = (p for key, p in parameters.items() if key.endswith(name))
        assert abs(p["value"] - truth) < 3.5 * p["error"], name
        assert p["error"] < 0.01
        assert abs(p["start"] - truth) > 3.5 * p["error"]  # the control: where it began
    assert 0.5 < fitted["reduced_chi2"] < 1.6
    assert names("out") == {"fit.npz", "fit.json", "trajectory.npz"}
    saved = dvi.FitResult.load("out/fit.npz")
    written = [p["value"] for p in read("out/fit.json")["parameters"].values()]
    np.testing.assert_array_equal(saved.x, written)
    with np.load("out/trajectory.npz") as file:
        assert file["ts"].shape == (121,)
        residuals = np.abs(file["qs"][3::3, 0] - saved.observed[0][:, 0])
    assert np.sqrt(np.mean(residuals**2)) == pytest.approx(saved.rms, rel=1e-9)

    write(folder, csv(*(x[::-1] for x in data)), "seen.csv")
    assert found("fit", "file.toml", "--force")["parameters"] == parameters
    assert np.load("out/trajectory.npz")["ts"][-1] == pytest.approx(data[0][-1])


@pytest.mark.slow
def test_a_model_that_does_not_describe_the_data_fails(folder):
    """The optimiser has converged, but chi² shows that the force is not this one."""
    text = SMALL.replace('["epsilon", "args.k"]', '["args.k"]')
    contents = found("fit", write(folder, text.replace("sigma = 0.01", "sigma = 1e-4")), code=1)
    assert contents["status"] == "converged"
    assert contents["reduced_chi2"] > 10
    assert "residuals contradict sigma" in contents["remarks"][0]
    assert "does not describe the data" in contents["error"]["message"]
    result = command("fit", "file.toml", "--force")
    assert result.exit_code == 1
    assert "converged, but the residuals contradict sigma (reduced chi² " in result.stdout


def test_an_epsilon_that_is_left_out_warns(folder):
    text = SMALL.replace('"own.py:system"', '"kepler"').replace("epsilon = 0.0\n", "")
    text = text.replace('["epsilon", "args.k"]', '["q0"]').replace("[args]\nk = 1.1\n", "")
    text = text.replace("[state]\nq0 = [1.0]\np0 = [0.0]\n", "")
    file, _ = read_file(write(folder, text), FitFile)
    with pytest.warns(UserWarning, match="the key epsilon is missing, so .* kepler without"):
        assert find_source(file, folder).epsilon == 0.0
    refuses(command("fit", write(folder, SMALL.replace("epsilon = 0.0\n", "").replace(
        '["epsilon", "args.k"]', '["args.k"]'))), "epsilon: the key is missing")  # fmt: skip


@pytest.mark.slow
def test_the_example(folder):
    shutil.copy(EXAMPLES / "fit.toml", folder)
    shutil.copy(EXAMPLES / "observations.csv", folder)
    result = command("fit", "fit.toml")
    assert result.exit_code == 0, result.output
    assert "Correlations" in result.output
    fitted = read("results/fit/fit.json")
    truth = {"epsilon": 0.01, "q0[0]": 1.02, "q0[1]": 0, "p0[0]": 0, "p0[1]": 0.95}
    for name, value in truth.items():
        p = fitted["parameters"][name]
        assert abs(p["value"] - value) < 3.5 * p["error"], name
    assert fitted["missing"] == 1
    assert 0.7 < fitted["reduced_chi2"] < 1.4
    for name in ("data.png", "residuals.png", "parameters.png", "learning.png"):
        assert Path("results/fit", name).stat().st_size > 5_000


@pytest.mark.slow
def test_a_fit_that_does_not_converge_is_written_and_resumes(folder, monkeypatch):
    """To the same bits as without the interruption, and only for the same fit."""
    monkeypatch.setattr(import_module("dvi_jax.fit.run"), "_INTERVAL", -1.0)  # at every step
    short = write(folder, SMALL.replace("[options]", "[options]\nmax_steps = 1"))
    result = command("fit", short)
    assert result.exit_code == 1, result.output
    assert "did not converge (max_steps_reached" in result.stderr
    assert (folder / "out" / "checkpoint.npz").exists()
    another = write(folder, SMALL.replace("k = 1.1", "k = 1.2"), "another.toml")
    refuses(command("fit", another, "--resume"), "is of another fit")
    path = write(folder, SMALL)
    refuses(command("fit", path), "is not empty", "--force")  # the control: without --resume
    resumed = found("fit", path, "--resume")
    assert resumed["steps"] > 1
    assert not (folder / "out" / "checkpoint.npz").exists()
    assert found("fit", path, "--out", "whole")["parameters"] == resumed["parameters"]


def test_ctrl_c(folder, monkeypatch):
    def stopped(*_, checkpoint, **__):
        Path(checkpoint).write_bytes(b"something")
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(dvi, "fit", stopped)
        result = command("fit", write(folder, SMALL))
    assert result.exit_code == 130
    assert result.stderr.startswith("interrupted: ")
    assert "--resume" in result.stderr
    assert names("out") == {"checkpoint.npz"}


def test_an_error_during_the_work_is_a_fault_and_not_bad_input(folder, monkeypatch):
    def broken(*_, progress, **__):
        progress(dvi.FitProgress(1, 2, 0, 1.0, 1.0, np.ones(1), ["x"], 1.0))
        raise ValueError("during the work")

    monkeypatch.setattr(dvi, "fit", broken)
    result = command("fit", write(folder, SMALL))
    assert result.exit_code == 1
    assert "a fault of dvi_jax" in result.stderr
    assert not (folder / "out").exists()


def test_columns_of_a_csv(tmp_path):
    """Comments, separators, missing values."""
    path = write(tmp_path, "# first\n\n t ; x;y\n0;1.5;\n1;nan;-2e3\n", "a.csv")
    columns = read_columns(path)
    assert list(columns) == ["t", "x", "y"]
    np.testing.assert_array_equal(columns["x"], [1.5, np.nan])
    np.testing.assert_array_equal(columns["y"], [np.nan, -2000.0])


def test_columns_observables_and_errors(folder, data):
    ts, xs = data
    rows = "".join(f"{t:.6g},{x:.6f},0.02\n" for t, x in zip(ts, xs, strict=True))
    write(folder, "time,x,s\n" + rows, "seen.csv")
    named = SMALL.replace("sigma = 0.01", 'sigma = "s"\ntime = "time"\nobserve = "own.py:square"')
    arguments, columns = setup(folder, named)
    assert columns == ["x"]  # neither the time nor the errors
    np.testing.assert_array_equal(arguments["data"].sigma, np.full((40, 1), 0.02))
    assert callable(arguments["data"].observe)
    np.savez(folder / "seen.npz", ts=ts, qs=xs[:, None])
    of_npz = SMALL.replace('"seen.csv"', '"seen.npz"\ntime = "ts"\ncolumns = ["qs"]')
    np.testing.assert_array_equal(setup(folder, of_npz)[0]["data"].values, xs[:, None])


@pytest.mark.parametrize(
    ("columns", "key", "period"),
    [
        ("x", "360", [360.0]),
        ("x", "[360]", [360.0]),
        ("x,y", "6.5", [6.5, 6.5]),
        ("x,y", "[6.5, inf]", [6.5, np.inf]),
        ("x", None, None),
    ],
)
def test_periods(folder, columns, key, period):
    """Of one column or of all, in the shape of one value."""
    count = len(columns.split(","))
    write(folder, f"t,{columns}\n0.3{',1' * count}\n0.6{',2' * count}\n", "seen.csv")
    text = SMALL.replace("q0 = [1.0]", f"q0 = {[1.0] * count}")
    text = text.replace("p0 = [0.0]", f"p0 = {[0.0] * count}")
    arguments, _ = setup(folder, text.replace(SIGMA, f"{SIGMA}\nperiod = {key}" if key else SIGMA))
    result = arguments["data"].period
    assert (result is None) if period is None else result.tolist() == period


def test_bounds_priors_and_options(folder):
    text = SMALL.replace("curvature = false", 'loss = "Cauchy"\nsegments = 3\nhorizons = "none"')
    text += "[bounds]\nepsilon = [-0.1, inf]\n[bounds.args]\nk = [0.5, 2]\n"
    arguments, _ = setup(folder, text + '[priors]\n"args.k" = [1.2, 0.5]\n')
    bounds = {"epsilon": dvi.Bounds(-0.1, np.inf), "args": {"k": dvi.Bounds(0.5, 2.0)}}
    assert arguments["bounds"] == bounds
    assert arguments["priors"] == {"args": {"k": dvi.Prior(1.2, 0.5)}}
    assert isinstance(arguments["loss"], dvi.Cauchy)
    assert arguments["shooting"] == dvi.MultipleShooting(3)
    assert arguments["horizons"] is None
    assert set(arguments["params"]) == {"epsilon", "args"}


HEAD = "t,x\n"
AWAY = "but h = 0.1 leads to later times. Give h = -0.1, or"
BAD_DATA = [
    ("", "data.file: ", "a line of names"),
    (HEAD, "has names but no numbers", "at least one line"),
    (HEAD + "0.3,1\n0.6,abc\n", "seen.csv, line 3, column x: the cell is 'abc'", "a finite number"),
    (HEAD + "0.3,1\n0.6,inf\n", "the cell is 'inf'", "a finite number"),
    (HEAD + "0.3,1\n0.6\n", "line 3: it has 1 cells", "2 cells, one for each"),
    (HEAD + "0.3,1\n,2\n", "data.time: ts must be finite, got nan", "in order in the column t"),
    (HEAD + "0.3,1\n0.9,2\n0.6,2\n", "no two be equal, got ts[1] = 0.9", "in order"),
    (HEAD + "0.3,1\n0.3,2\n", "ts must all increase", "in order"),
    (HEAD + "0.3,1\n", "at least 2 observed values", "data that fit"),
    (HEAD + "0.3,\n0.6,nan\n", "data: values must have at least one number", "values that fit"),
    ("0.3,1\n0.6,2\n", "line 1: 0.3 is a number", "different names"),
    ("t,t\n0.3,1\n", "'t' is empty or repeated", "different names"),
    ("t,x,y\n0.3,1,2\n0.6,1,2\n", "the columns x, y have 2", "1 for each time"),
    ("time,x\n0.3,1\n", "data.time: the file has no column 't'", "a column of the file: time, x"),
    ("t\n0.3\n0.6\n", "no column is left", "one or more of t"),
    (HEAD + "-0.3,1\n0.6,2\n", "ts must be on one side of t0 = 0.0", "in order"),
    (HEAD + "-0.3,1\n-0.6,2\n", AWAY, "data that fit"),
    (HEAD + "-0.6,1\n-0.3,2\n", AWAY, "data that fit"),
]


@pytest.mark.parametrize(("text", "seen", "allowed"), BAD_DATA)
def test_bad_data(folder, text, seen, allowed):
    write(folder, text, "seen.csv")
    refuses(command("fit", write(folder, SMALL)), seen, allowed)
    assert not (folder / "out").exists()


NAMES, SIGMA, CURVATURE, OPTIONS = '"args.k"]', "sigma = 0.01", "curvature = false", "[options]"
REJECTED = [
    (NAMES, '"args.K"]', "parameters: it contains 'args.K'", "did you mean args.k?"),
    (NAMES, '"epsilon"]', "is listed twice", "each name once"),
    ('["epsilon", "args.k"]', "[]", "parameters: the value is []", "an array of names"),
    ("seen.csv", "sen.csv", "data.file: there is no file", "a CSV or npz file"),
    (SIGMA, "sigma = [0.01, 0.02]", "data.sigma: it has 2 columns", "one column for all"),
    (SIGMA, 'sigma = "s"', "data.sigma: the file has no column 's'", "a column of the file"),
    (SIGMA, "period = 0", "data.period: the value is 0", "a positive number"),
    (SIGMA, "period = [nan]", "data.period", "a positive number"),
    (SIGMA, "period = []", "data.period: the value is []", "a positive number"),
    (SIGMA, "period = [1, inf]", "data.period: it has 2 numbers", "one number, or 1"),
    (SIGMA, 'observe = "position"', "data.observe", "did you mean positions?"),
    (SIGMA, 'observe = "own.py:too_few"', "data: observe", "values that fit observe"),
    (CURVATURE, "tolerance = 2", "options.tolerance: the value is 2", "between 0 and 1"),
    (OPTIONS, "[bounds]\nepsilon = 3\n[options]", "bounds.epsilon", "[lower, upper]"),
    (OPTIONS, "[bounds]\nq0 = [0, 1]\n[options]", "bounds.q0: it is not among", "epsilon"),
    (OPTIONS, "[bounds]\nepsilon = [1, 2]\n[options]", "not between its bounds", "start"),
    (OPTIONS, "[priors]\nepsilon = [1, nan]\n[options]", "priors.epsilon", "[mean"),
    ("k = 1.1", "K = 1.1", "KeyError: 'k'", "args"),
]


@pytest.mark.parametrize(("old", "new", "seen", "allowed"), REJECTED)
def test_bad_input(folder, old, new, seen, allowed):
    assert old in SMALL
    text = SMALL.replace(old, new)
    if "K = 1.1" in new:  # so that the system's own functions raise the error
        text = text.replace('"args.k"', '"args.K"')
    refuses(command("fit", write(folder, text)), seen, allowed)
    assert not (folder / "out").exists()
