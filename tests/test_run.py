"""Runs from TOML files: what they write, which input they reject, how they fail."""

import shutil

import numpy as np
import pytest
from cli import EXAMPLES, command, found, keys_not_in, names, read, refuses, write
from dvi_jax.run import InputError, library_tables, run_file

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax_cli.work.expressions import parse_method
from dvi_jax_cli.work.output import FolderReport
from dvi_jax_cli.work.schema import FILES

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

def branch(t0, t1, q0, p1, args):
    return -q0 if q0[0] > 0 else q0

def number_of(t0, t1, q0, p1, args):
    return float(q0[0]) * q0

forced, numbered = dvi.System(H_D, force=branch), dvi.System(H_D, force=number_of)
ball = dvi.systems.bouncing_ball(0.8)
walls = list(ball.jumps)
explosive = dvi.System(lambda t0, t1, q0, p1, args: jnp.sum(p1**2) / 2 - jnp.sum(q0**4))
"""
KEPLER = 'system = "kepler"\n'
FIVE = KEPLER + "steps = 5\n"
BARE = "[output]\nplots = false\n"
STATE = "[state]\nq0 = [1.0]\np0 = [0.0]\n"
SPRING = 'system = "own.py:system"\nsteps = 5\n'
FULL = f"steps = 5\nh = 0.1\n{STATE}[args]\nk = 1.0"
N_BODY = 'system = "n_body"\nsteps = 5\n'
CHAOS = 'system = "henon_heiles"\nh = 0.05\nmethod = "Strang"\nsteps = 2000\n[observables]\n'
BAD_INDICATORS = "MEGNO(energy)", "GALI(1)", "GALI(", "MEGNOO()", "MEGNO() + SALI()", "MEGNO()(3)"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    write(tmp_path, OWN, "own.py")
    write(tmp_path, "x = 1\nimport not_there_at_all\n", "broken.py")
    write(tmp_path, "def f(:\n", "syntax.py")
    write(tmp_path, "import sys\nsys.exit(0)\n", "leaves.py")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_kepler_example(folder):
    """The files, the report, and the numbers of `dvi.integrate`."""
    assert command("run", EXAMPLES / "kepler.toml").exit_code == 0
    out = folder / "results" / "kepler"
    assert names(out) == {"trajectory.npz", "report.json", "trajectory.png", "invariants.png"}
    report = read(out / "report.json")
    assert report["status"]["result"] == "successful"
    assert report["config"]["epsilon"] == 0.01
    assert report["results"]["angular_momentum_drift"]["relative"] < 1e-13
    assert report["results"]["energy"]["largest_saved_change"] > 0.01  # negative control
    k = systems.kepler()
    run = {"h": 0.1, "num_steps": 5000, "epsilon": 0.01, "args": k.args}
    run |= {"save": dvi.Save(every=2, final=True), "observe": k.observables["energy"]}
    alone = dvi.integrate(k.system, k.q0, k.p0, **run)
    with np.load(out / "trajectory.npz") as saved:
        np.testing.assert_array_equal(saved["ts"], alone.ts)
        np.testing.assert_allclose(saved["qs"], alone.qs, rtol=0, atol=1e-9)
        np.testing.assert_allclose(saved["observed/energy"], alone.observed, rtol=0, atol=1e-9)
        assert saved["ps"].shape == (2501, 2)
        assert saved["hs"].shape == (2500,)
    assert command("report", "results/kepler").exit_code == 0
    assert (folder / "results" / "kepler.html").exists()


@pytest.mark.slow
def test_own_system_example(folder):
    """An implicit symmetric method: steps back lead to the start."""
    result = command("run", EXAMPLES / "own_system.toml", "--out", "pendulum")
    assert result.exit_code == 0, result.output
    report = read("pendulum/report.json")
    assert 1e-6 < report["results"]["energy_range"]["relative"] < 1e-3  # bounded, and not zero
    assert report["stats"]["newton_iterations"] > 4000  # it is implicit
    assert report["stats"]["max_residual"] < 1e-9  # the last correction; the residual is its square
    own = {}
    exec((EXAMPLES / "own_system.py").read_text(encoding="utf-8"), own)
    with np.load("pendulum/trajectory.npz") as saved:
        start, end = ([saved[x][i] for x in ("qs", "ps")] for i in (0, -1))
    args = {"mass": 1.0, "length": 1.0, "gravity": 9.81}
    run = {"h": -0.005, "num_steps": 4000, "epsilon": 0.0, "args": args, "method": dvi.Strang()}
    back = dvi.integrate(own["system"], *end, save=dvi.Save(final=True), **run)
    np.testing.assert_allclose([back.qs[-1], back.ps[-1]], start, atol=1e-11)


@pytest.mark.parametrize("system", ["own.py:system", "own.py:problem"])
def test_systems_from_a_file(folder, system):
    state = f"h = 0.1\n{STATE}[args]\nk = 1.0\n" if "sys" in system else ""
    text = f'system = "{system}"\nsteps = 20\n{state}{BARE}'
    report = run_file(write(folder, text))
    q, p = 1.0, 0.0
    for _ in range(20):
        p -= 0.1 * q
        q += 0.1 * p
    with np.load(report.folder / "trajectory.npz") as saved:
        np.testing.assert_allclose(saved["qs"][-1], [q], rtol=1e-14)
    assert report.files == ["trajectory.npz", "report.json"]


def test_jumps_of_a_system_and_of_a_file(folder):
    """A ball with its floor; the same from a list in the file."""
    text = f'system = "own.py:ball"\nh = 0.1\nsteps = 40\nmethod = "Strang"\n{BARE}'
    jumps = dvi.integrate(systems.bouncing_ball(0.8), h=0.1, num_steps=40, method="strang").jumps
    assert jumps.count == 2
    for i, line in enumerate(("", 'jump = "own.py:walls"\n')):
        report = run_file(write(folder, line + text), out=f"run{i}")
        with np.load(report.folder / "trajectory.npz") as saved:
            for name, values in vars(jumps).items():
                np.testing.assert_allclose(saved[f"jumps/{name}"], values, rtol=1e-13)
    refuses(command("run", write(folder, 'jump = "own.py:energy"\n' + text)), "jump:", "dvi.Jump")


def test_given_times_and_parameters(folder):
    times = [0.0, 0.1, 0.3, 0.35]
    text = f"{KEPLER}lattice = {{times = {times}}}\n[args]\nK = 2.0\n{BARE}"
    report = run_file(write(folder, text))
    k = systems.kepler()
    alone = dvi.integrate(k.system, k.q0, k.p0, lattice=dvi.Given(times), args={"K": 2.0})
    with np.load(report.folder / "trajectory.npz") as saved:
        np.testing.assert_allclose(saved["qs"], alone.qs, rtol=1e-13)
        np.testing.assert_array_equal(saved["ts"], times)


def test_methods_are_read_and_their_text_cannot_call_other_functions(tmp_path):
    for text, expected in (
        ("TypeII", dvi.TypeII()),
        (" Strang() ", dvi.Strang()),
        ("Yoshida(order=4)", dvi.Yoshida(4)),
        ("Adjoint(Adjoint(Strang()))", dvi.Adjoint(dvi.Adjoint(dvi.Strang()))),
        ("Composition([0.5, 0.5], order=2)", dvi.Composition([0.5, 0.5], order=2)),
        ("Composition([-1.0, 2.0])", dvi.Composition([-1.0, 2.0])),
    ):
        assert parse_method(text) == expected
    target = tmp_path / "made"
    for text in (f"open('{target}', 'w')", f"Yoshida(open('{target}', 'w'))", "Strang().order"):
        with pytest.raises(InputError):
            parse_method(text)
    assert not target.exists()


LONG = "a" * 5000
REJECTED = [
    ("steps = 5", "system: the key is missing", "file.py:name"),
    ('system = "keplr"', "system: the value is 'keplr'", "did you mean kepler?"),
    ("system = 3", "system: the value is 3 (a whole number)", "library"),
    (KEPLER + "stepps = 5", "stepps: there is no such key", "did you mean steps?"),
    (KEPLER, "steps: the key is missing", "positive whole number"),
    (KEPLER + "steps = 1.5", "steps: the value is 1.5 (a number)", "positive whole number"),
    (KEPLER + "steps = true", "steps: the value is true (a boolean)", "positive whole number"),
    (FIVE + "h = 0.0", "h: the value is 0.0 (a number)", "not zero"),
    (FIVE + 'epsilon = "big"', "epsilon: the value is 'big' (text)", "finite number"),
    (FIVE + "epsilon = 1" + 400 * "0", "epsilon: the value is 1000", "finite number"),
    (FIVE + 'method = "Yosida(4)"', "method: 'Yosida'", "did you mean Yoshida?"),
    (FIVE + 'method = "Yoshida(5)"', "order of Yoshida must be one of 4, 6, 8, got 5", "Strang"),
    (FIVE + f'method = "{3000 * "-"}5"', "method: ", "Strang"),
    (KEPLER + "lattice = {times = [0, 1, 0.5]}", "lattice.times", "all increasing"),
    (FIVE + "lattice = {times = [0.0, 1.0]}", "steps: the value is 5", "lattice.times gives"),
    (FIVE + "state = 1", "state: the value is 1", "q0, p0, date"),
    (FIVE + "[state]\nq0 = [1, 2, 3]", "state.p0: p0 has shape (2,)", "(3,)"),
    (FIVE + "[state]\nq0 = [1.0]\np0 = [1.0]", "state: ", ""),
    (FIVE + "[state]\nq0 = [0, 0]\np0 = [1, 0]", "state: ", ""),
    (FIVE + "[state]\nq0 = [[1, 2], [3]]", "state.q0: the value is [[1, 2], [3]]", "one length"),
    (FIVE + "[state]\nq0 = [1, nan]", "state.q0[1]: the value is nan (a number)", "finite"),
    (FIVE + '[state]\ndate = "1950-01-01"', "state.date:", "solar_system"),
    (FIVE + "[args]\nk = 1.0", "args.k: there is no such", "did you mean K?"),
    (FIVE + '[args]\nK = "one"', "args.K: the value is 'one' (text)", "numbers"),
    (FIVE + "[args]\nK = [1.0, 2.0]", "args: K must be a positive and finite", "args that fit"),
    (FIVE + "[observables]\n'../x' = 'energy'", "the name is '../x'", "without /"),
    (FIVE + '[observables]\na = "enrgy"', "observables.a: 'enrgy'", "mean energy?"),
    (FIVE + '[observables]\na = "Max(energy)"', "observables.a: 'Max'", "MaxDrift"),
    (FIVE + '[observables]\na = "own.py:number"', "own.py:number' has the type int", "function"),
    (FIVE + '[observables]\na = "own.py:too_few"', "too_few(t0, t1)", "a function"),
    (FIVE + "[output]\nevery = 0", "output.every: the value is 0", "positive whole number"),
    ('system = "kepler', "is not TOML", "toml.io"),
    ("h = 1" + "0" * 5000, "is not TOML", "toml.io"),
    (f'system = "{LONG}.py:system"', "File name too long", ""),
    ('system = "a\\u0000.py:system"', "null ", ""),
    ('system = "nowhere.py:system"', "there is no file", "file.py:name"),
    ('system = "own.py:sistem"', "own.py has no 'sistem'", "did you mean system?"),
    ('system = "own.py:number"', "own.py:number' is an object of type int", "dvi.System"),
    ('system = "own.py:failing"', "RuntimeError: no luck (own.py, line 16)", "returns a system"),
    ('system = "broken.py:system"', "not_there_at_all' (broken.py, line 2)", "can import"),
    ('system = "syntax.py:system"', "SyntaxError", "can import"),
    ('system = "leaves.py:system"', "SystemExit", "can import"),
    (SPRING, "state.q0: the key is missing", "the system has no default"),
    (SPRING + STATE, "h: the key is missing", "the system has no default"),
    (SPRING + "h = 0.1\n" + STATE, "(own.py, line 7)", "state and args that fit"),
    ('system = "own.py:forced"\n' + FULL, "epsilon: the key is missing", "a force"),
    ('system = "own.py:forced"\nepsilon = 0.1\n' + FULL, "of if (own.py, line 25)", "fit"),
    ('system = "own.py:numbered"\nepsilon = 0.1\n' + FULL, "of if (own.py, line 28)", "fit"),
    (N_BODY + "[state]\nq0 = [[0, 0], [0, 0], [1, 1]]", "body 1 must have different", "start"),
    (N_BODY + "[args]\nmasses = [1, 0, 1]", "mass of body 1 must be positive", "start"),
    *((f'{CHAOS}x = "{x}"\n', "observables.x: ", "MEGNO") for x in BAD_INDICATORS),
    (f'{CHAOS}x = "MEGNO"\n', "observables.x: ", "MEGNO()"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "seen", "allowed"), REJECTED)
def test_bad_input(folder, text, seen, allowed):
    refuses(command("run", write(folder, text), "--out", "out"), seen, allowed)
    assert not (folder / "out").exists()


def test_bad_paths(folder):
    refuses(command("run", "nowhere.toml"), "nowhere.toml: there is no such file")
    path = write(folder, FIVE)
    refuses(command("run", path, "--out", "own.py"), "own.py is not a directory")
    path = write(folder, FIVE + '[output]\ndir = "a\\u0000"')
    refuses(command("run", path), "output.dir: ")
    (folder / "bom.toml").write_bytes(b"\xef\xbb\xbf" + b'system = "none"\r\n')
    refuses(command("run", "bom.toml"), "system: the value is 'none'")  # the mark is allowed


def test_all_wrong_keys_of_a_file_are_named(folder):
    text = KEPLER + 'stepps = 5\nh = 0.0\n[state]\nq0 = [1, nan]\nq1 = 1\n[args]\nK = "k"\n'
    result = command("run", write(folder, text))
    for seen in (
        "stepps: there is",
        "h: the value is 0.0",
        "state.q0[1]: the value is nan",
        "args.K: the value is 'k' (text)",
    ):
        refuses(result, seen)
    assert "state.q1: there is no such key\n  allowed: q0, p0, date" in result.stderr
    assert result.stderr.count("allowed: ") == 5
    many = write(folder, f"{KEPLER}[state]\nq0 = [{'true,' * 20}]\n")
    assert command("run", many).stderr.rstrip().endswith("… and 12 more")


def test_dates_outside_the_ephemeris(folder):
    pytest.importorskip("jplephem")
    for date, steps, seen in (
        ("1850-01-01", 5, "1899-07-29 to 2053-10-09"),
        ("2053-10-01", 10_000, "the run ends 312.5 days after"),
    ):
        text = f'system = "solar_system"\nsteps = {steps}\n[state]\ndate = "{date}"\n'
        refuses(command("run", write(folder, text)), seen)


def test_results_are_not_overwritten(folder):
    """Only --force replaces results, and of other files nothing."""
    path = write(folder, FIVE + BARE)
    assert command("run", path, "--out", "out").exit_code == 0
    write(folder / "out", "mine", "notes.txt")
    write(folder / "out", "of another run", "orbits.png")
    refuses(command("run", path, "--out", "out"), "out exists and is not empty", "--force")
    assert read("out/report.json")["config"]["steps"] == 5
    longer = write(folder, FIVE.replace("5", "6") + BARE)
    assert command("run", longer, "--out", "out", "--force").exit_code == 0
    assert read("out/report.json")["config"]["steps"] == 6
    assert (folder / "out" / "notes.txt").read_text(encoding="utf-8") == "mine"
    assert not (folder / "out" / "orbits.png").exists()  # it would belong to no run


def test_a_failed_trajectory_is_written(folder):
    """Up to its failure, with NaN after it; in JSON for programs NaN is null, in files a text."""
    text = f'system = "own.py:explosive"\nh = 0.1\nsteps = 60\n{STATE.replace("0.0", "1.0")}'
    text += '[observables]\nenergy = "own.py:energy"\ndrift = "MaxDrift(own.py:energy)"\n'
    report = found("run", write(folder, text + "[args]\nk = 1.0\n"), "--out", "out", code=1)
    assert report["error"]["kind"] == "failed"
    assert "failed at step" in report["error"]["message"]
    assert report["status"]["result"] == "not_finite"
    assert report["results"]["energy"]["end"] is None
    step = report["status"]["failed_step"]
    assert 0 < step < 60
    with np.load("out/trajectory.npz") as saved:
        assert np.isfinite(saved["qs"][: step + 1]).all()
        assert np.isnan(saved["qs"][step + 1 :]).all()
    assert read("out/report.json")["results"]["drift"]["value"] == "nan"
    assert (folder / "out" / "trajectory.png").exists()


@pytest.mark.parametrize("kind", FILES)
def test_the_examples_show_every_key(kind):
    """Those of a run in several examples."""
    paths = EXAMPLES.glob("*.toml" if kind == "run" else f"{kind}.toml")
    text = "".join(path.read_text(encoding="utf-8") for path in paths)
    assert keys_not_in(text, FILES[kind]) == []
    assert keys_not_in("steps = 3", FILES[kind])  # the control


@pytest.mark.slow
def test_solar_system_with_too_large_a_step(folder):
    """The integrator's contribution is reported, and without it relativity's is correct."""
    pytest.importorskip("jplephem")
    text = 'system = "solar_system"\nh = 0.25\nsteps = 5840\nmethod = "Yoshida(4)"\n'
    text += "[state]\ndate = 1950-01-01\n[output]\nevery = 20\nplots = false\n"
    result = command("run", write(folder, text), "--out", "out")
    assert result.exit_code == 0, result.output
    mercury = read("out/report.json")["solar_system"]["mercury_perihelion"]
    share = mercury["integrators_share_arcsec_per_century"]
    slope = mercury["ephemeris_minus_integration_arcsec_per_century"]
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
    report = read(out / "report.json")["solar_system"]
    assert report["years"] == 100
    assert all(x < 1e-12 for x in report["largest_relative_change"].values())  # measured 4e-13
    mercury = report["mercury_perihelion"]
    slope = mercury["ephemeris_minus_integration_arcsec_per_century"]
    assert slope == pytest.approx(43.0, abs=0.1)
    share = mercury["integrators_share_arcsec_per_century"]
    assert share == pytest.approx(-0.04, abs=0.005)
    assert 1e4 < report["position_error"]["Mercury"]["largest_km"] < 4e4  # relativity again
    assert report["position_error"]["Saturn"]["largest_km"] < 30
    for name in ("orbits.png", "ephemeris.png", "invariants.png"):
        assert (out / name).stat().st_size > 10_000


@pytest.mark.slow
def test_indicators_of_chaos(folder):
    text = CHAOS + 'megno = "MEGNO()"\nl = "LyapunovSpectrum(2, seed=3)"\ng = "GALI(3)"\n'
    results = found("run", write(folder, text))["results"]
    k = systems.henon_heiles()
    run = {"h": 0.05, "num_steps": 2000, "method": dvi.Strang(), "save": dvi.Save(final=True)}
    observe = dvi.LyapunovSpectrum(2, seed=3)
    direct = dvi.integrate(k.system, k.q0, k.p0, observe=observe, **run).observed
    assert np.allclose(results["l"]["value"], direct, rtol=0, atol=1e-12)
    assert 0 < results["megno"]["value"] < 3


def test_systems_are_listed_and_described():
    result = command("systems")
    assert all(name in result.output for name in systems.LIBRARY)
    result = command("systems", "magnetic_mirror")
    for word in ("corrected_moment", "rotation", "length", "[charge]", "H_D ="):
        assert word in result.output
    _, tables = library_tables("magnetic_mirror")  # a terminal folds its lines
    kinds = {row[0]: row[1] for row in tables[1].rows}
    assert kinds["corrected_moment"].startswith("adiabatic")
    assert kinds["energy"].startswith("conserved")
    refuses(command("systems", "magnetic_miror"), "NAME: ", "did you mean magnetic_mirror?")


def test_ctrl_c_while_results_are_written_lists_the_files(tmp_path):
    def output(force=False):
        return FolderReport(folder=tmp_path, key="--out", names=("a.npz",), force=force).writing()

    def interrupted():
        with output():
            (tmp_path / "a.npz").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"contains: a\.npz"):
        interrupted()
    with pytest.raises(FileExistsError, match="another process has written"):
        interrupted()
    with output(force=True):
        assert not list(tmp_path.iterdir())


def test_the_error_in_python(folder):
    with pytest.raises(InputError, match=r"h: the value is 0.0 .*\n  allowed: ") as error:
        run_file(write(folder, FIVE + "h = 0.0"))
    assert (error.value.key, error.value.seen) == ("h", "the value is 0.0 (a number)")
