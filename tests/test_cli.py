"""The command line: help without JAX, JSON, errors in one block, completion, projects."""

import ast
import json
import os
import runpy
import subprocess
import sys
import time
import tomllib
from importlib import import_module

import numpy as np
import pytest
from cli import EXAMPLES, MAIN, ROOT, command, found, process, refuses, write
from rich.cells import cell_len
from typer.main import get_command

import dvi_jax as dvi
import dvi_jax_cli._names as known
from dvi_jax import systems, testing
from dvi_jax_cli import app
from dvi_jax_cli._new import notebook
from dvi_jax_cli._session import CODES, Session

COMMANDS = [
    "new",
    "systems",
    "schema",
    "run",
    "sweep",
    "fit",
    "discover",
    "bound",
    "report",
    "paper",
]
COMMANDS += ["certify", "verify", "info", "explore"]

CALLS = """
import contextlib, io, json, os, sys
from dvi_jax_cli import main
results = []
for words, environment in json.loads(sys.argv[1]):
    os.environ.update(environment)
    sys.argv, code = ["dvi-jax", *words], 0
    out, stderr = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(stderr):
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
    for name in environment:
        del os.environ[name]
    results.append((code, out.getvalue(), stderr.getvalue()))
heavy = sorted({"jax", "jaxlib", "numpy", "matplotlib", "dvi_jax"} & set(sys.modules))
print(json.dumps((results, heavy)))
"""


def ended(calls):
    """[(exit code, stdout, stderr) of each call], and what one process has imported for all."""
    done = process(CALLS, json.dumps(calls))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


LIGHT = {"--help": 0, "--version": 0, "sweep run --help": 0, "wlak": 2, "run --forse": 2}
COMPLETED = {
    "systems ke": ["kepler"],
    "certify --check ener": ["energy"],
    "certify --method Gauss": [f"GaussLegendre{s}" for s in (1, 2, 3, 4)],
    "sw": ["sweep"],
    "systems nothing": [],
}


def test_help_errors_and_completion_import_no_jax():
    calls = [(line.split(), {}) for line in LIGHT]
    for line in COMPLETED:
        words = {"COMP_WORDS": f"dvi-jax {line}", "COMP_CWORD": str(len(line.split(" ")))}
        calls.append(([], {"_DVI_JAX_COMPLETE": "complete_bash", **words}))
    results, heavy = ended(calls)
    assert heavy == []
    for (line, code), (status, out, stderr) in zip(LIGHT.items(), results, strict=False):
        assert status == code, line
        assert "Traceback" not in stderr
        assert out or stderr
        assert line != "--version" or out.strip() == f"dvi-jax {dvi.__version__}"
    for names, (status, out, _) in zip(COMPLETED.values(), results[len(LIGHT) :], strict=True):
        assert (status, sorted(out.split())) == (0, names)


@pytest.mark.slow
def test_a_command_at_work_imports_jax():
    """The control of the test above."""
    [(code, _, _)], heavy = ended([(["systems", "keppler"], {})])
    assert code == 2
    assert {"jax", "dvi_jax", "numpy"} <= set(heavy)


@pytest.mark.slow
def test_help_takes_a_fraction_of_what_jax_takes_to_import():
    """Measured in turn in one test, so that a busy machine slows all of them."""

    def seconds(code):
        began = time.perf_counter()
        process(code, "--help").check_returncode()
        return time.perf_counter() - began

    rounds = [[seconds(code) for code in ("pass", MAIN, "import jax")] for _ in range(3)]
    bare, help_, jax_ = np.min(rounds, axis=0)
    assert help_ - bare < 0.6 * (jax_ - bare)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_examples(name):
    assert set(get_command(app).commands) == set(COMMANDS)
    assert f" {name} " in command("--help").output
    shown = command(name, "--help")
    assert shown.exit_code == 0, shown.output
    if name == "sweep":  # a group: its commands have them
        return
    for text in ("Examples", f"dvi-jax {name}", "--json", "--verbose", "--debug"):
        assert text in shown.output
    examples = shown.output.partition("Examples")[2].strip().splitlines()
    assert all(line.strip().startswith("dvi-jax") for line in examples)  # no line is wrapped


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["sweeep"], "No such command 'sweeep' (did you mean sweep?)"),
        (["run", "x.toml", "--forse"], "(did you mean --force?)"),
        (["run"], "Missing argument"),
        (["schema", "swep"], "did you mean sweep?"),
        (["systems", "keppler"], "did you mean kepler?"),
    ],
)
def test_wrong_arguments_are_shown_in_one_block(words, message):
    result = command(*words)
    refuses(result, message)
    assert result.stderr.startswith("bad input: ")
    error = found(*words, code=2)["error"]
    assert error["kind"] == "bad input"
    assert message in error["message"]


def test_names_that_complete_are_those_of_the_package():
    assert tuple(systems.LIBRARY) == known.SYSTEMS
    assert tuple(testing.METHODS) == known.METHODS
    assert tuple(testing.CHECKS) == known.CHECKS
    assert tuple(import_module("dvi_jax_cli.work.schema").FILES) == known.FILES
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = set(project["optional-dependencies"]) - {"test", "docs", "peers"}
    assert set(known.EXTRAS) == extras
    assert dvi.__version__ == known.VERSION


@pytest.mark.parametrize("kind", [*known.FILES, None])
def test_the_json_schema_accepts_the_examples_and_no_unknown_key(kind):
    schema = json.loads(command("schema", *([kind] if kind else [])).stdout)
    validator = pytest.importorskip("jsonschema").Draft202012Validator
    validator.check_schema(schema)
    is_valid = validator(schema).is_valid
    for file in {"run": "kepler", None: "fit"}.get(kind, kind), "sweep":
        values = tomllib.loads((EXAMPLES / f"{file}.toml").read_text(encoding="utf-8"))
        assert is_valid(values) == (kind in (None, "sweep") or file != "sweep")
        assert not is_valid(values | {"stepps": 5})
        assert not is_valid(values | {"h": "large"})


def test_json_of_a_run_is_one_strict_object(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, 'system = "kepler"\nh = 0.1\nsteps = 20\n[output]\nplots = false\n')
    result = command("run", "file.toml", "--out", "out", "--json", "-v")
    report = json.loads(result.stdout, parse_constant=pytest.fail)
    assert report["status"]["result"] == "successful"
    assert report["folder"] == "out"
    assert set(report["files"]) == {"trajectory.npz", "report.json"}
    assert "error" not in report
    assert "double precision" in result.stderr
    assert "written to out" in result.stderr
    again = command("run", "file.toml", "--out", "out", "--json")
    assert again.exit_code == 2
    assert "is not empty" in json.loads(again.stdout)["error"]["message"]
    assert again.stderr == ""


def test_systems_as_json():
    kepler = found("systems", "kepler")
    assert kepler["name"] == "kepler"
    (parameter,) = kepler["tables"]["Parameters"]
    assert parameter["args"] == "K"
    every = found("systems")["tables"]["Systems of the library"]
    assert [row["name"] for row in every] == list(systems.LIBRARY)


@pytest.mark.parametrize("as_json", [False, True])
def test_an_unexpected_exception(monkeypatch, as_json):
    def broken(name):
        raise ZeroDivisionError("one by zero")

    monkeypatch.setattr(import_module("dvi_jax_cli.work.library"), "library_tables", broken)
    result = command("systems", *(["--json"] if as_json else []))
    assert result.exit_code == 1 == CODES["fault"]
    message = json.loads(result.stdout)["error"]["message"] if as_json else result.stderr
    for text in ("this is a fault of dvi_jax", "ZeroDivisionError: one by zero", "--debug"):
        assert text in message
    assert "Traceback" not in result.output
    with pytest.raises(ZeroDivisionError):  # the control: --debug raises it
        command("systems", "--debug", catch_exceptions=False)


@pytest.mark.slow
def test_debug_shows_the_traceback_and_has_the_same_exit_code():
    done = process(MAIN, "run", "nowhere.toml", "--debug", "--json")
    assert done.returncode == 2
    assert json.loads(done.stdout)["error"]["kind"] == "bad input"
    assert "Traceback (most recent call last)" in done.stderr
    assert done.stderr.rstrip().endswith("allowed: a TOML file in UTF-8")


@pytest.mark.slow
def test_closed_outputs_raise_no_error():
    """A pipe that is closed, and a standard output that is closed from the start."""
    words = ["sh", "-c", f'"{sys.executable}" -c "{MAIN}" info | head -n 1']
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    assert (done.stdout.strip(), done.stderr) == ("Versions", "")
    done = process(f"import sys; sys.stdout = None; {MAIN}", "--version")
    assert (done.returncode, done.stderr) == (0, "")


def test_no_control_codes_without_a_terminal_and_ascii():
    result = command("systems", env={"COLUMNS": "60"})
    assert "\x1b" not in result.output
    assert max(map(cell_len, result.stdout.splitlines())) <= 60
    wide = command("systems", env={"COLUMNS": "100"})  # the control
    assert max(map(cell_len, wide.stdout.splitlines())) > 60
    done = process(MAIN, "discover", "--help", PYTHONIOENCODING="ascii", COLUMNS="99")
    assert (done.returncode, done.stderr) == (0, "")
    assert "invariants in ? as formulas" in done.stdout
    text = "from dvi_jax_cli._show import print_json; print_json({'a': 'ε', 'b': float('nan')})"
    done = process(text, PYTHONIOENCODING="ascii")
    assert json.loads(done.stdout, parse_constant=pytest.fail) == {"a": "ε", "b": None}


def test_too_little_memory_is_a_failure_with_its_size():
    error = MemoryError("Unable to allocate 7.28 TiB")
    kind, message = Session(False, False, False).kind_and_message(error)
    assert kind == "failed"
    assert "does not have the memory for this: Unable to allocate 7.28 TiB" in message


def test_info(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") + " ")
    monkeypatch.setitem(known.EXTRAS, "export", ("a_module_that_is_not_there",))
    monkeypatch.setitem(known.EXTRAS, "bayes", ("jax",))
    info = found("info")
    assert info["versions"]["dvi-jax"] == dvi.__version__
    assert info["backend"] == "cpu"
    assert info["x64_of_this_process"] is True
    assert "XLA_FLAGS" in info["flags"]
    install = 'pip install "dvi-jax[export]"'
    missing = {"missing": ["a_module_that_is_not_there"], "install": install}
    assert info["extras"]["export"] == missing
    assert info["extras"]["bayes"] == {"missing": [], "install": None}
    assert install in command("info").output


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    folder = tmp_path_factory.mktemp("new") / "spring"
    assert command("new", folder).exit_code == 0
    return folder


@pytest.fixture
def inside(project, monkeypatch):
    monkeypatch.chdir(project)
    monkeypatch.syspath_prepend(project)
    return project


PROJECT = [kind for kind in known.FILES if kind != "bound"]  # which needs the extra `proof`


def test_new_writes_a_project_with_a_valid_notebook(project):
    assert {p.name for p in project.iterdir()} == {
        *("README.md", "system.py", "observations.csv", "explore.py", "explore.ipynb"),
        *(f"{kind}.toml" for kind in PROJECT),
    }
    readme = (project / "README.md").read_text(encoding="utf-8")
    assert readme.startswith("# spring\n")
    for path in project.iterdir():
        assert "{{" not in path.read_text(encoding="utf-8"), path
    for name in PROJECT:
        assert f"dvi-jax {name} {name}.toml" in readme
    nbformat = pytest.importorskip("nbformat")
    file = nbformat.read(project / "explore.ipynb", as_version=4)
    nbformat.validate(file)
    made = notebook((project / "explore.py").read_text(encoding="utf-8"))
    assert [c.source for c in file.cells] == ["".join(c["source"]) for c in made["cells"]]
    assert [cell.cell_type for cell in file.cells][:2] == ["markdown", "code"]
    assert file.cells[0].source.startswith("# spring")
    for cell in file.cells:
        if cell.cell_type == "code":
            ast.parse(cell.source)


@pytest.mark.slow
def test_its_run(inside):
    results = found("run", "run.toml")["results"]
    assert results["angular_momentum_drift"]["value"] < 1e-13
    assert results["energy_range"]["value"] > 1e-3  # the control: perturbed


@pytest.mark.slow
def test_its_sweep(inside):
    sweep = found("sweep", "sweep.toml")
    assert sweep["trajectories"] == {"successful": 384}
    assert sweep["observed"]["angular_momentum_drift"]["max"] < 1e-13
    assert sweep["observed"]["energy_drift"]["max"] > 1e-3
    assert found("sweep", "status", "results/sweep.zarr")["tasks"]["left"] == 0
    assert found("sweep", "verify", "results/sweep.zarr")["bad"] == {}
    assert found("sweep", "sweep.toml", "--dry-run")["lanes"] == 384


@pytest.mark.slow
def test_its_fit_and_discovery(inside):
    epsilon = found("fit", "fit.toml")["parameters"]["epsilon"]
    assert abs(epsilon["value"] - 0.05) < 3 * epsilon["error"]
    assert epsilon["error"] < 1e-3
    assert abs(epsilon["start"] - 0.05) > 3 * epsilon["error"]  # the control: where it began
    momentum, energy = found("discover", "discover.toml")["invariants"]
    assert momentum["formula"] == "−0.5 q1 p2 + 0.5 q2 p1"
    assert max(momentum["drift"]["drifts"]) < 1e-13
    assert energy["drift"]["slope"] == pytest.approx(2, abs=0.01)


@pytest.mark.slow
def test_its_notebook_runs(inside, monkeypatch):
    import matplotlib as mpl

    mpl.use("Agg")
    monkeypatch.delitem(sys.modules, "system", raising=False)
    run = runpy.run_path("explore.py")
    assert run["solution"].observed["angular momentum"] < 1e-13
    assert run["order"].slope == pytest.approx(1, abs=0.1)
    drifts = run["result"].to_xarray().energy_drift
    assert dict(drifts.sizes) == {"x": 24, "epsilon": 12}
    largest = drifts.max("x").values
    strengths = drifts["epsilon"].values  # large enough for the method's own error to be small
    assert largest[-1] / largest[-4] == pytest.approx(strengths[-1] / strengths[-4], rel=0.15)
    q = [run["last"](e) for e in (0.05 - 1e-5, 0.05 + 1e-5)]
    assert float(run["slope"]) == pytest.approx(float(q[1] - q[0]) / 2e-5, rel=1e-6)


def test_the_files_that_a_project_of_the_library_leaves_out_are_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own, library = command("new", "own"), command("new", "orbits", "--system", "kepler")
    names = set(os.listdir("own")) - set(os.listdir("orbits"))
    table = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
    (row,) = (line for line in table.splitlines() if line.startswith("| `new NAME`"))
    for name in names - {"observations.csv"}:  # the data of fit.toml
        assert library.stdout.count(name) == 1
        assert name in row
        assert own.stdout.count(name) == 1


@pytest.mark.parametrize("name", ["kepler", "fput"])
@pytest.mark.slow
def test_a_project_of_a_system_of_the_library(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    assert command("new", "orbits", "--system", name).exit_code == 0
    monkeypatch.chdir(tmp_path / "orbits")
    assert found("run", "run.toml")["results"]["energy_drift"]["value"] < 0.5
    assert found("sweep", "sweep.toml")["trajectories"] == {"successful": 8}
    assert runpy.run_path("explore.py")["solution"].status == "successful"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["there"], "there exists already"),
        (["a/../.."], "NAME"),
        (["-"], "NAME"),
        ([".hidden"], "letters and digits first"),
        (["nul.txt"], "NAME"),
        (["a:b"], "NAME"),
        (["ends."], "NAME"),
        ([""], "NAME"),
        (["new", "--system", "keppler"], "did you mean kepler?"),
        (["there/file/below"], "cannot be written"),
    ],
)
def test_invalid_names_of_projects(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    write(tmp_path / "there", "mine", "file")
    result = command("new", *words)
    assert result.exit_code == (1 if "cannot" in message else 2), result.output
    assert message in result.stderr
    assert [p.name for p in tmp_path.rglob("*")] == ["there", "file"]


def test_the_first_command_can_be_copied(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "cd 'a spring' &&" in command("new", "a spring").stdout


@pytest.mark.slow
def test_a_wheel_has_the_command_line_and_its_templates(tmp_path, monkeypatch):
    import zipfile

    hatchling = pytest.importorskip("hatchling.build")
    monkeypatch.chdir(ROOT)
    with zipfile.ZipFile(tmp_path / hatchling.build_wheel(str(tmp_path))) as file:
        files = set(file.namelist())
        (entry,) = (n for n in files if n.endswith("entry_points.txt"))
        assert "dvi-jax = dvi_jax_cli:main" in file.read(entry).decode()
    templates = (ROOT / "dvi_jax_cli" / "templates").rglob("*.*")
    wanted = {p.relative_to(ROOT).as_posix() for p in templates if p.suffix != ".pyc"}
    assert len(wanted) >= 12
    assert wanted <= files
    assert not any(n.startswith("tests") for n in files)
