"""Runs from TOML files: what they write, what they refuse, how they fail."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.run import InputError, library_tables, run_file
from dvi_jax_cli import app
from dvi_jax_cli.work.expressions import parse_method
from dvi_jax_cli.work.output import Output
from dvi_jax_cli.work.schema import RunFile

EXAMPLES = Path(__file__).parent.parent / "examples"

OWN = """
import jax.numpy as jnp
import dvi_jax as dvi
from dvi_jax.systems import Problem

def H_D(t0, t1, q0, p1, args):
    return args["k"] * jnp.sum(q0**2) / 2 + jnp.sum(p1**2) / 2

system = dvi.System(H_D)
number = 3

def problem():
    return Problem("spring", system, q0=[1.0], p0=[0.0], h=0.1, args={"k": 1.0})

def failing():
    raise RuntimeError("no luck")

def energy(t0, t1, q0, p0, q1, p1, args):
    return H_D(t0, t1, q1, p1, args)

def too_few(t0, t1):
    return t0

def runaway(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 - jnp.sum(q0**4)

explosive = dvi.System(runaway)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "own.py").write_text(OWN, encoding="utf-8")
    (tmp_path / "broken.py").write_text("x = 1\nimport not_there_at_all\n", encoding="utf-8")
    (tmp_path / "syntax.py").write_text("def f(:\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def command(*words):
    return CliRunner().invoke(app, [str(w) for w in words])


def write(folder, text, name="run.toml"):
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


# What a run writes


@pytest.mark.slow
def test_kepler_example(folder):
    result = command("run", EXAMPLES / "kepler.toml")
    assert result.exit_code == 0, result.output
    out = folder / "results" / "kepler"
    names = {p.name for p in out.iterdir()}
    assert names == {"trajectory.npz", "report.json", "trajectory.png", "invariants.png"}
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["status"]["result"] == "successful"
    assert report["config"]["epsilon"] == 0.01
    assert report["results"]["angular_momentum_drift"]["relative"] < 1e-13
    assert report["results"]["energy"]["largest_saved_change"] > 0.01  # negative control

    problem = systems.kepler()
    alone = dvi.integrate(
        problem.system,
        problem.q0,
        problem.p0,
        h=0.1,
        num_steps=5000,
        epsilon=0.01,
        args=problem.args,
        save=dvi.Save(every=2, final=True),
        observe=problem.observables["energy"],
    )
    with np.load(out / "trajectory.npz") as saved:
        np.testing.assert_array_equal(saved["ts"], alone.ts)
        np.testing.assert_allclose(saved["qs"], alone.qs, rtol=0, atol=1e-9)
        np.testing.assert_allclose(saved["observed/energy"], alone.observed, rtol=0, atol=1e-9)
        assert saved["ps"].shape == (2501, 2)
        assert saved["hs"].shape == (2500,)


@pytest.mark.slow
def test_own_system_example(folder):
    result = command("run", EXAMPLES / "own_system.toml", "--out", folder / "pendulum")
    assert result.exit_code == 0, result.output
    report = json.loads((folder / "pendulum" / "report.json").read_text(encoding="utf-8"))
    results = report["results"]
    assert 1e-6 < results["energy_range"]["relative"] < 1e-3  # bounded, and not zero
    assert report["stats"]["newton_iterations"] > 4000  # it is implicit
    assert report["stats"]["max_residual"] < 1e-9  # the last correction; the residual is its square
    # The method is symmetric: steps back lead to the start, to what is left of all the roots.
    names = {}
    exec((EXAMPLES / "own_system.py").read_text(encoding="utf-8"), names)
    with np.load(folder / "pendulum" / "trajectory.npz") as saved:
        start, end = ([saved[x][i] for x in ("qs", "ps")] for i in (0, -1))
    args = {"mass": 1.0, "length": 1.0, "gravity": 9.81}
    run = {"h": -0.005, "num_steps": 4000, "args": args, "method": dvi.Strang()}
    back = dvi.integrate(names["system"], *end, save=dvi.Save(final=True), **run)
    np.testing.assert_allclose([back.qs[-1], back.ps[-1]], start, atol=1e-11)


@pytest.mark.parametrize("system", ["own.py:system", "own.py:problem"])
def test_systems_from_a_file(folder, system):
    state = "h = 0.1\n[state]\nq0 = [1.0]\np0 = [0.0]\n[args]\nk = 1.0\n" if "sys" in system else ""
    text = f'system = "{system}"\nsteps = 20\n{state}[output]\nplots = false\n'
    report = run_file(write(folder, text))
    with np.load(report.folder / "trajectory.npz") as saved:
        q, p = 1.0, 0.0
        for _ in range(20):
            p -= 0.1 * q
            q += 0.1 * p
        np.testing.assert_allclose(saved["qs"][-1], [q], rtol=1e-14)
    assert report.files == ["trajectory.npz", "report.json"]


def test_given_times_and_parameters(folder):
    times = [0.0, 0.1, 0.3, 0.35]
    text = f'system = "kepler"\nlattice = {{times = {times}}}\n[args]\nK = 2.0\n'
    report = run_file(write(folder, text + "[output]\nplots = false\n"))
    problem = systems.kepler()
    alone = dvi.integrate(
        problem.system, problem.q0, problem.p0, lattice=dvi.Given(times), args={"K": 2.0}
    )
    with np.load(report.folder / "trajectory.npz") as saved:
        np.testing.assert_allclose(saved["qs"], alone.qs, rtol=1e-13)
        np.testing.assert_array_equal(saved["ts"], times)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("TypeII", dvi.TypeII()),
        (" Strang() ", dvi.Strang()),
        ("Yoshida(4)", dvi.Yoshida(4)),
        ("Yoshida(order=4)", dvi.Yoshida(4)),
        ("Adjoint(TypeII)", dvi.Adjoint(dvi.TypeII())),
        ("Adjoint(Adjoint(Strang()))", dvi.Adjoint(dvi.Adjoint(dvi.Strang()))),
        ("Composition([0.5, 0.5], order=2)", dvi.Composition([0.5, 0.5], order=2)),
        ("Composition([-1.0, 2.0])", dvi.Composition([-1.0, 2.0])),
    ],
)
def test_methods_are_read(text, expected):
    assert parse_method(text) == expected


def test_nothing_in_a_method_is_run(tmp_path):
    target = tmp_path / "made"
    for text in (f"open('{target}', 'w')", f"Yoshida(open('{target}', 'w'))", "Strang().order"):
        with pytest.raises(InputError):
            parse_method(text)
    assert not target.exists()


# What is refused: the key, what was seen, what is allowed

KEPLER = 'system = "kepler"\n'
REFUSED = [
    ("steps = 5", "system: the key is missing", "file.py:name"),
    ('system = "keplr"', "system: 'keplr'", "did you mean kepler?"),
    ("system = 3", "system: 3 (a whole number)", "library"),
    (KEPLER + "stepps = 5", "stepps: there is no such key", "did you mean steps?"),
    (KEPLER, "steps: the key is missing", "positive whole number"),
    (KEPLER + "steps = 1.5", "steps: 1.5 (a number)", "positive whole number"),
    (KEPLER + "steps = true", "steps: true (a boolean)", "positive whole number"),
    (KEPLER + "steps = -1", "steps: -1 (a whole number)", "positive whole number"),
    (KEPLER + "steps = 5\nh = 0.0", "h: 0.0 (a number)", "not zero"),
    (KEPLER + "steps = 5\nh = inf", "h: inf (a number)", "finite"),
    (KEPLER + 'steps = 5\nepsilon = "big"', "epsilon: 'big' (text)", "finite number"),
    (KEPLER + 'steps = 5\nmethod = "Yosida(4)"', "method: 'Yosida'", "did you mean Yoshida?"),
    (KEPLER + 'steps = 5\nmethod = "Yoshida(5)"', "orders 4, 6 and 8, got 5", "Strang"),
    (KEPLER + 'steps = 5\nmethod = "3"', "method: '3'", "Strang"),
    (KEPLER + 'steps = 5\nlattice = "given"', "lattice: 'given' (text)", "uniform"),
    (
        KEPLER + "lattice = {times = [0.0, 1.0, 0.5]}",
        "lattice.times: [0.0, 1.0, 0.5]",
        "all increasing",
    ),
    (KEPLER + "steps = 5\nlattice = {times = [0.0, 1.0]}", "steps: 5", "lattice.times sets"),
    (KEPLER + "steps = 5\nstate = 1", "state: 1", "q0, p0, date"),
    (KEPLER + "steps = 5\n[state]\nq0 = [1, 2, 3]", "state.p0: shape (2,)", "(3,)"),
    (KEPLER + "steps = 5\n[state]\nq0 = [[1, 2], [3]]", "state.q0: [[1, 2], [3]]", "one length"),
    (KEPLER + "steps = 5\n[state]\nq0 = [1, nan]", "state.q0[1]: nan (a number)", "finite"),
    (KEPLER + 'steps = 5\n[state]\ndate = "1950-01-01"', "state.date:", "solar_system"),
    (KEPLER + "steps = 5\n[args]\nk = 1.0", "args.k: there is no such", "did you mean K?"),
    (KEPLER + 'steps = 5\n[args]\nK = "one"', "args.K: 'one' (text)", "numbers"),
    (
        KEPLER + "steps = 5\n[args]\nK = [1.0, 2.0]",
        "args: K must be a positive and finite number, got ",
        "args that fit",
    ),
    (KEPLER + "steps = 5\n[observables]\n'../x' = 'energy'", "the name '../x'", "without /"),
    (KEPLER + 'steps = 5\n[observables]\na = "enrgy"', "observables.a: 'enrgy'", "mean energy?"),
    (KEPLER + 'steps = 5\n[observables]\na = "Max(energy)"', "observables.a: 'Max(", "MaxDrift"),
    (KEPLER + 'steps = 5\n[observables]\na = "own.py:number"', "own.py:number' is int", "function"),
    (
        KEPLER + 'steps = 5\n[observables]\na = "own.py:too_few"',
        "too_few",
        "a function (t0, t1, q0",
    ),
    (KEPLER + "steps = 5\n[output]\nevery = 0", "output.every: 0", "positive whole number"),
    (KEPLER + "steps = 5\n[output]\nevrey = 1", "output.evrey: there is no", "mean every?"),
    ('system = "kepler', "is not TOML", "toml.io"),
    ('system = "nowhere.py:system"', "there is no file", "file.py:name"),
    ('system = "own.py:sistem"', "own.py has no 'sistem'", "did you mean system?"),
    ('system = "own.py:number"', "own.py:number' is int", "dvi.System"),
    ('system = "own.py:failing"', "RuntimeError: no luck (own.py, line 16)", "returns a system"),
    ('system = "broken.py:system"', "not_there_at_all' (broken.py, line 2)", "imports"),
    ('system = "syntax.py:system"', "SyntaxError", "imports"),
    ('system = "own.py:system"\nsteps = 5', "state.q0: the key is missing", "this system has none"),
    (
        'system = "own.py:system"\nsteps = 5\n[state]\nq0 = [1]\np0 = [0]',
        "h: the key is missing",
        "none of its own",
    ),
    (
        'system = "own.py:system"\nsteps = 5\nh = 0.1\n[state]\nq0 = [1]\np0 = [0]',
        "(own.py, line 7)",
        "state and args that fit",
    ),
    (
        'system = "n_body"\nsteps = 5\n[state]\nq0 = [[0, 0], [0, 0], [1, 1]]',
        "body 0 and body 1 are on top of one another",
        "start",
    ),
    ('system = "n_body"\nsteps = 5\n[args]\nmasses = [1, 0, 1]', "mass of body 1 is 0", "start"),
]


@pytest.mark.parametrize(("text", "seen", "allowed"), REFUSED)
def test_bad_input(folder, text, seen, allowed):
    result = command("run", write(folder, text), "--out", "out")
    assert result.exit_code == 2, result.output
    assert seen in result.stderr
    assert "allowed: " in result.stderr
    assert allowed in result.stderr.partition("allowed: ")[2]
    assert "Traceback" not in result.output
    assert isinstance(result.exception, SystemExit)
    assert not (folder / "out").exists()  # nothing is left behind


def test_missing_file(folder):
    result = command("run", "nowhere.toml")
    assert result.exit_code == 2
    assert "nowhere.toml: there is no such file" in result.stderr


def test_all_wrong_keys_of_a_file_are_named(folder):
    text = (
        'system = "kepler"\nstepps = 5\nh = 0.0\n[state]\nq0 = [1, nan]\nq1 = 1\n[args]\nK = "k"\n'
    )
    result = command("run", write(folder, text))
    assert result.exit_code == 2
    for seen in (
        "stepps: there is no such key",
        "h: 0.0",
        "state.q0[1]: nan",
        "args.K: 'k' (text)",
    ):
        assert seen in result.stderr
    assert "state.q1: there is no such key\n  allowed: q0, p0, date" in result.stderr
    assert result.stderr.count("allowed: ") == 5
    many = write(folder, f'system = "kepler"\n[state]\nq0 = {[True] * 20}\n'.replace("T", "t"))
    assert command("run", many).stderr.rstrip().endswith("… and 12 more")


def test_dates_outside_the_ephemeris(folder):
    pytest.importorskip("jplephem")
    for date, steps, said in (
        ("1850-01-01", 5, "covers 1899-07-29"),
        ("2053-10-01", 10_000, "the run ends 312.5 days after"),
    ):
        path = write(
            folder, f'system = "solar_system"\nsteps = {steps}\n[state]\ndate = "{date}"\n'
        )
        result = command("run", path, "--out", "out")
        assert result.exit_code == 2
        assert said in result.stderr


def test_results_are_not_overwritten(folder):
    path = write(folder, KEPLER + "steps = 5\n[output]\nplots = false\n")
    assert command("run", path, "--out", "out").exit_code == 0
    (folder / "out" / "notes.txt").write_text("mine", encoding="utf-8")
    (folder / "out" / "orbits.png").write_text("of another run", encoding="utf-8")
    before = (folder / "out" / "report.json").read_bytes()

    again = command("run", path, "--out", "out")
    assert again.exit_code == 2
    assert "out exists and is not empty" in again.stderr
    assert "--force" in again.stderr
    assert (folder / "out" / "report.json").read_bytes() == before

    longer = write(folder, KEPLER + "steps = 6\n[output]\nplots = false\n")
    assert command("run", longer, "--out", "out", "--force").exit_code == 0
    assert json.loads((folder / "out" / "report.json").read_bytes())["config"]["steps"] == 6
    assert (folder / "out" / "notes.txt").read_text(encoding="utf-8") == "mine"
    assert not (folder / "out" / "orbits.png").exists()  # it would belong to no run


def test_a_file_in_the_way(folder):
    path = write(folder, KEPLER + "steps = 5\n")
    result = command("run", path, "--out", "own.py")
    assert result.exit_code == 2
    assert "own.py is not a directory" in result.stderr


# How a trajectory fails


def test_a_failed_trajectory_is_written(folder):
    path = write(
        folder,
        'system = "own.py:explosive"\nh = 0.1\nsteps = 60\n[state]\nq0 = [1.0]\np0 = [1.0]\n'
        '[observables]\nenergy = "own.py:energy"\ndrift = "MaxDrift(own.py:energy)"\n'
        "[args]\nk = 1.0\n",
    )
    result = command("run", path, "--out", "out")
    assert result.exit_code == 1, result.output
    assert "failed at step" in result.stderr
    assert "not_finite" in result.stderr
    report = json.loads((folder / "out" / "report.json").read_text(encoding="utf-8"))
    step = report["status"]["failed_step"]
    assert 0 < step < 60
    with np.load(folder / "out" / "trajectory.npz") as saved:
        assert np.isfinite(saved["qs"][: step + 1]).all()
        assert np.isnan(saved["qs"][step + 1 :]).all()
    assert report["results"]["drift"]["value"] == "nan"  # not finite, and said so
    assert (folder / "out" / "trajectory.png").exists()


# The command line


def test_version_and_help():
    assert command("--version").output.strip() == f"dvi-jax {dvi.__version__}"
    shown = command("--help")
    assert shown.exit_code == 0
    assert "run" in shown.output
    assert "paper" in shown.output
    assert command("walk").exit_code == 2


@pytest.mark.slow
def test_entry_point_without_traceback(folder):
    path = write(folder, KEPLER + "steps = 0\n")
    code = "from dvi_jax_cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "run", str(path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("bad input: steps: 0")
    assert "Traceback" not in done.stderr


def test_every_key_is_shown_in_an_example():
    """A key that no example shows is one that nobody finds."""
    text = "".join(p.read_text(encoding="utf-8") for p in EXAMPLES.glob("*.toml"))
    for key in RunFile.model_fields:
        assert f"{key} = " in text or f"[{key}]" in text, key


@pytest.mark.slow
def test_solar_system_with_too_large_a_step_says_so(folder):
    pytest.importorskip("jplephem")
    path = write(
        folder,
        'system = "solar_system"\nh = 0.25\nsteps = 5840\nmethod = "Yoshida(4)"\n'
        "[state]\ndate = 1950-01-01\n[output]\nevery = 20\nplots = false\n",
    )
    result = command("run", path, "--out", "out")
    assert result.exit_code == 0, result.output
    report = json.loads((folder / "out" / "report.json").read_text(encoding="utf-8"))
    found = report["solar_system"]["mercury_perihelion"]
    share = found["integrators_share_arcsec_per_century"]
    slope = found["ephemeris_minus_integration_arcsec_per_century"]
    assert share < -100
    assert slope - share == pytest.approx(43.0, abs=1.0)
    assert "take a smaller h" in " ".join(result.output.split())


@pytest.mark.slow
def test_solar_system_example(folder):
    """A century: momenta to 1e-12, Mercury's perihelion short by 43″."""
    pytest.importorskip("jplephem")
    shutil.copy(EXAMPLES / "solar_system.toml", folder)
    result = command("run", "solar_system.toml")
    assert result.exit_code == 0, result.output
    assert "ephemeris minus integration: 42.96″ per century" in result.output
    assert "largest [km]" in result.output  # the unit is not taken for markup
    out = folder / "results" / "solar_system"
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))["solar_system"]
    assert report["years"] == 100
    assert all(x < 1e-12 for x in report["largest_relative_change"].values())  # measured 4e-13
    perihelion = report["mercury_perihelion"]
    assert perihelion["ephemeris_minus_integration_arcsec_per_century"] == pytest.approx(
        43.0, abs=0.1
    )
    assert perihelion["integrators_share_arcsec_per_century"] == pytest.approx(-0.04, abs=0.005)
    assert 1e4 < report["position_error"]["Mercury"]["largest_km"] < 4e4  # relativity again
    assert report["position_error"]["Saturn"]["largest_km"] < 30
    for name in ("orbits.png", "ephemeris.png", "invariants.png"):
        assert (out / name).stat().st_size > 10_000


def test_inputs_that_once_broke_through(folder):
    """A number beyond floats, a method that nests too deep, a file that exits, a flat start."""
    (folder / "leaves.py").write_text("import sys\nsys.exit(0)\n", encoding="utf-8")
    base = 'system = "oscillator"\nh = 0.1\nsteps = 2\n'
    for text, key in [
        (base + "epsilon = 1" + 400 * "0" + "\n", "epsilon"),
        (base + f'method = "{3000 * "-"}5"\n', "method"),
        ('system = "leaves.py:system"\nh = 0.1\nsteps = 2\n', "system"),
        ('system = "kepler"\nh = 0.1\nsteps = 2\n[state]\nq0 = [1.0]\np0 = [1.0]\n', "state"),
        ('system = "kepler"\nh = 0.1\nsteps = 2\n[state]\nq0 = [0, 0]\np0 = [1, 0]\n', "state"),
    ]:
        (folder / "bad.toml").write_text(text, encoding="utf-8")
        result = command("run", "bad.toml")
        assert result.exit_code == 2, text
        assert key in result.output


@pytest.mark.slow
def test_indicators_of_chaos(folder):
    """Written as in Python; they follow no observable."""
    base = 'system = "henon_heiles"\nh = 0.05\nsteps = 2000\nmethod = "Strang"\n[observables]\n'
    (folder / "chaos.toml").write_text(
        base + 'megno = "MEGNO()"\nl = "LyapunovSpectrum(2, seed=3)"\ng = "GALI(3, log10=True)"\n',
        encoding="utf-8",
    )
    result = command("run", "chaos.toml", "--out", "chaos")
    assert result.exit_code == 0, result.output
    report = json.loads((folder / "chaos" / "report.json").read_text(encoding="utf-8"))
    problem = systems.henon_heiles()
    direct = dvi.integrate(
        problem.system, problem.q0, problem.p0, h=0.05, num_steps=2000, method=dvi.Strang(),
        observe=dvi.LyapunovSpectrum(2, seed=3), save=dvi.Save(final=True),
    ).observed  # fmt: skip
    assert np.allclose(report["results"]["l"]["value"], direct, rtol=0, atol=1e-12)
    assert 0 < report["results"]["megno"]["value"] < 3
    for text in (
        "MEGNO(energy)", "GALI(1)", "GALI(", "MEGNOO()", "MEGNO() + SALI()", "MEGNO()(3)", "MEGNO",
    ):  # fmt: skip
        (folder / "bad.toml").write_text(base + f'x = "{text}"\n', encoding="utf-8")
        result = command("run", "bad.toml", "--out", "bad")
        assert result.exit_code == 2, text
        assert "observables.x" in result.output
    assert "MEGNO()" in result.output  # which parentheses were left out of


def test_systems_are_listed_and_told_of():
    result = command("systems")
    assert result.exit_code == 0, result.output
    for name in systems.LIBRARY:
        assert name in result.output
    result = command("systems", "magnetic_mirror")
    assert result.exit_code == 0, result.output
    for word in ("corrected_moment", "rotation", "length", "[charge]", "H_D ="):
        assert word in result.output
    _, tables = library_tables("magnetic_mirror")  # a terminal folds its lines
    observables = {row[0]: row[1] for row in tables[1].rows}
    assert (
        observables["corrected_moment"] == "adiabatic: oscillates by gyroradius over ℓ to power 2"
    )
    assert observables["energy"] == "conserved exactly at ε = 0"
    result = command("systems", "magnetic_miror")
    assert result.exit_code == 2
    assert "did you mean magnetic_mirror?" in result.output


LONG = "a" * 5000


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f'system = "{LONG}.py:system"', "system: .*File name too long"),
        ('system = "a\\u0000.py:system"', "system: .*null byte"),
        ('system = "kepler"\nsteps = 5\n[output]\ndir = "a\\u0000"', "output.dir: .*null byte"),
        ("h = 1" + "0" * 5000, "is not TOML"),
        ("h = " + "[" * 5000, "is not TOML"),
        ('system = "kepler"\n[args]\nK = 1' + "0" * 400, r"args\.K: 1000"),
        ('system = "kepler"\n[observables]\nE = 3', r"observables\.E: 3 \(a whole number\)"),
        (
            'system = "own.py:system"\nh = 0.1\nsteps = 5\n[observables]\nE = "own.py:too_few"\n'
            "[state]\nq0 = [1.0]\np0 = [0.0]",
            r"observables\.E: 'own.py:too_few' takes \(t0, t1\)",
        ),
    ],
    ids=["long", "null", "null out", "digits", "brackets", "huge", "observable", "two arguments"],
)
def test_what_no_file_can_mean_is_bad_input(folder, text, words):
    with pytest.raises(InputError, match=words):
        run_file(write(folder, text))


def test_a_file_may_begin_with_a_byte_order_mark(folder):
    (folder / "bom.toml").write_bytes(b"\xef\xbb\xbf" + b'system = "none"\r\n')
    with pytest.raises(InputError, match="system: 'none'"):
        run_file(folder / "bom.toml")


@pytest.mark.parametrize("line", ["return float(q0[0]) * q0", "return -q0 if q0[0] > 0 else q0"])
def test_functions_that_cannot_be_traced_are_told_what_to_do(folder, line):
    (folder / "own.py").write_text(f"{OWN}\ndef W(t0, t1, q0, p1, args):\n    {line}\n"
                                   "forced = dvi.System(H_D, force=W)\n")  # fmt: skip
    text = 'system = "own.py:forced"\nh = 0.1\nsteps = 5\n[state]\nq0 = [1.0]\np0 = [0.0]\n'
    with pytest.raises(
        InputError, match=r"jnp.where in place of if \(own.py, line \d+\)\n"
    ) as seen:
        run_file(write(folder, text + "[args]\nk = 1.0"))
    assert seen.value.seen.count("\n") == 0


def test_what_is_written_when_ctrl_c_comes_is_told(tmp_path):
    def interrupted():
        with Output(tmp_path, "--out", ("a.npz",)).writing():
            (tmp_path / "a.npz").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"where there is: a\.npz"):
        interrupted()
    with pytest.raises(FileExistsError, match="another process has written"):
        interrupted()
    with Output(tmp_path, "--out", ("a.npz",), force=True).writing():
        assert not list(tmp_path.iterdir())
