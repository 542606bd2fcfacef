"""The command line: help without JAX, JSON, errors in one block, completion, projects."""

import ast
import json
import os
import runpy
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from rich.cells import cell_len
from typer.testing import CliRunner

import dvi_jax as dvi
import dvi_jax_cli._names as names
from dvi_jax import certify, systems
from dvi_jax_cli import app
from dvi_jax_cli._new import notebook
from dvi_jax_cli._session import CODES, Session

ROOT = Path(dvi.__file__).parent.parent
COMMANDS = [
    "new",
    "systems",
    "schema",
    "run",
    "sweep",
    "fit",
    "discover",
    "paper",
    "certify",
    "bench",
    "info",
]


def command(*words, **settings):
    return CliRunner().invoke(app, [str(w) for w in words], **settings)


def process(code, *words, **environment):
    """A process of its own, in which nothing has been imported."""
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, words)], capture_output=True, text=True,
        check=False, env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
    )  # fmt: skip


ONLY_HELP = """
import sys, time
began = time.perf_counter()
from dvi_jax_cli import main
sys.argv = ["dvi-jax", *sys.argv[1:]]
try:
    main()
except SystemExit as end:
    code = end.code or 0
seconds = time.perf_counter() - began
heavy = sorted({"jax", "jaxlib", "numpy", "matplotlib", "dvi_jax"} & set(sys.modules))
print("END", code, ",".join(heavy), seconds, file=sys.stderr)
"""


def ended(*words, **environment):
    """(exit code, what was imported, stdout, stderr) of a call that is not to need JAX."""
    done = process(ONLY_HELP, *words, **environment)
    said, _, last = done.stderr.rpartition("END ")
    code, heavy, _ = last.split(" ")
    return int(code), heavy, done.stdout, said


# Help, refusals and completion without JAX


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--help"], 0),
        (["--version"], 0),
        (["fit", "--help"], 0),
        (["sweep", "run", "--help"], 0),
        (["wlak"], 2),
        (["run", "--forse"], 2),
    ],
)
def test_help_and_refusals_import_no_jax(words, code):
    found, heavy, out, said = ended(*words)
    assert (found, heavy) == (code, "")
    assert "Traceback" not in said
    assert out or said


@pytest.mark.slow
def test_a_command_at_work_imports_jax():
    """The control of the test above: it would be seen."""
    code, heavy, _, _ = ended("systems", "keppler")
    assert code == 2
    assert {"jax", "dvi_jax", "numpy"} <= set(heavy.split(","))


@pytest.mark.slow
def test_help_takes_a_fraction_of_what_jax_takes_to_import():
    """Measured in turn in one test, so that a busy machine slows all of them."""
    import time

    def seconds(code):
        began = time.perf_counter()
        process(code, "--help").check_returncode()
        return time.perf_counter() - began

    rounds = [
        (seconds("pass"), seconds("from dvi_jax_cli import main; main()"), seconds("import jax"))
        for _ in range(3)
    ]
    bare, help_, jax_ = np.min(rounds, axis=0)
    assert help_ - bare < 0.6 * (jax_ - bare)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_examples(name):
    shown = command("--help")
    assert f" {name} " in shown.output
    shown = command(name, "--help")
    assert shown.exit_code == 0, shown.output
    if name != "sweep":  # a group: its commands have them
        assert "Examples" in shown.output
        assert f"dvi-jax {name}" in shown.output
        assert "--json" in shown.output
        assert "--verbose" in shown.output
        assert "--debug" in shown.output
        examples = shown.output.partition("Examples")[2].strip().splitlines()
        assert all(line.strip().startswith("dvi-jax") for line in examples)  # none is wrapped


def test_help_names_every_command_and_no_other():
    from typer.main import get_command

    assert set(get_command(app).commands) == set(COMMANDS)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["sweeep"], "No such command 'sweeep' (did you mean sweep?)"),
        (["run", "x.toml", "--forse"], "No such option: --forse (did you mean --force?)"),
        (["run"], "Missing argument"),
        (["bench", "--rounds", "1"], "--rounds"),
        (["bench", "--row", "doubel"], "allowed: single, batch"),
    ],
)
def test_wrong_words_are_told_in_one_block(words, message):
    result = command(*words)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith("bad input: ")
    assert message in result.stderr
    result = command(*words, "--json")
    assert result.exit_code == 2
    error = json.loads(result.stdout)["error"]
    assert error["kind"] == "bad input"
    assert message in error["message"]


def test_completion_without_jax():
    def complete(line):
        found = ended(
            _DVI_JAX_COMPLETE="complete_bash", COMP_WORDS=line,
            COMP_CWORD=str(len(line.split(" ")) - 1),
        )  # fmt: skip
        assert found[:2] == (0, ""), found
        return found[2].split()

    assert complete("dvi-jax systems ke") == ["kepler"]
    assert complete("dvi-jax certify --check ener") == ["energy"]
    assert set(complete("dvi-jax certify --method Gauss")) == {
        "GaussLegendre1", "GaussLegendre2", "GaussLegendre3", "GaussLegendre4",
    }  # fmt: skip
    assert complete("dvi-jax sw") == ["sweep"]
    assert complete("dvi-jax systems nothing") == []


def test_names_that_complete_are_those_that_there_are():
    assert tuple(systems.LIBRARY) == names.SYSTEMS
    assert tuple(certify.METHODS) == names.METHODS
    assert tuple(certify.CHECKS) == names.CHECKS
    assert tuple(import_module("dvi_jax_cli.work.bench")._ROWS) == names.WORKLOADS
    with open(ROOT / "pyproject.toml", "rb") as file:
        project = tomllib.load(file)["project"]
    extras = set(project["optional-dependencies"]) - {"test", "docs", "peers"}
    assert set(names.EXTRAS) == extras
    assert dvi.__version__ == names.VERSION


# Output for programs, and errors


@pytest.mark.parametrize("kind", [*names.FILES, None])
def test_the_json_schema_accepts_the_examples_and_no_unknown_key(kind):
    result = command("schema", *([kind] if kind else []))
    assert result.exit_code == 0, result.output
    schema = json.loads(result.stdout)
    validator = pytest.importorskip("jsonschema").Draft202012Validator
    validator.check_schema(schema)
    for file in {"run": "kepler", None: "fit"}.get(kind, kind), "sweep":
        text = (ROOT / "examples" / f"{file}.toml").read_text(encoding="utf-8")
        values = tomllib.loads(text)
        is_valid = validator(schema).is_valid
        assert is_valid(values) == (kind in (None, "sweep") or file != "sweep")
        assert not is_valid(values | {"stepps": 5})
        assert not is_valid(values | {"h": "large"})


def test_the_schema_of_an_unknown_kind():
    result = command("schema", "swep")
    assert result.exit_code == 2
    assert "KIND: 'swep'" in result.stderr
    assert "did you mean sweep?" in result.stderr
    assert tuple(import_module("dvi_jax_cli.work.schema").FILES) == names.FILES


def test_json_of_a_run_is_one_strict_object(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = 'system = "kepler"\nh = 0.1\nsteps = 20\n[output]\nplots = false\n'
    (tmp_path / "run.toml").write_text(text, encoding="utf-8")
    result = command("run", "run.toml", "--out", "out", "--json", "-v")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout, parse_constant=pytest.fail)
    assert found["status"]["result"] == "successful"
    assert found["folder"] == "out"
    assert set(found["files"]) == {"trajectory.npz", "report.json"}
    assert "error" not in found
    assert "double precision" in result.stderr
    assert "written to out" in result.stderr
    again = command("run", "run.toml", "--out", "out", "--json")
    assert again.exit_code == 2
    assert json.loads(again.stdout)["error"]["kind"] == "bad input"
    assert "is not empty" in json.loads(again.stdout)["error"]["message"]
    assert again.stderr == ""


def test_json_of_a_failed_run_has_its_numbers_and_the_error(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(
        "import jax.numpy as jnp\nimport dvi_jax as dvi\n"
        "system = dvi.System(lambda t0, t1, q0, p1, args: jnp.sum(p1**2) / 2 - jnp.sum(q0**4))\n"
        "def size(t0, t1, q0, p0, q1, p1, args):\n    return q1 @ q1\n",
        encoding="utf-8",
    )
    (tmp_path / "run.toml").write_text(
        'system = "own.py:system"\nh = 0.2\nsteps = 60\n[state]\nq0 = [1.0]\np0 = [0.0]\n'
        '[observables]\nsize = "own.py:size"\n[output]\nplots = false\n', encoding="utf-8",
    )  # fmt: skip
    result = command("run", "run.toml", "--json")
    assert result.exit_code == 1
    found = json.loads(result.stdout, parse_constant=pytest.fail)
    assert found["error"]["kind"] == "failed"
    assert "failed at step" in found["error"]["message"]
    assert found["status"]["result"] == "not_finite"
    assert found["results"]["size"]["end"] is None  # NaN, beside its status


def test_systems_as_json():
    found = json.loads(command("systems", "kepler", "--json").stdout)
    assert found["name"] == "kepler"
    (mu,) = found["tables"]["Parameters"]
    assert mu["args"] == "K"
    every = json.loads(command("systems", "--json").stdout)["tables"]["Systems of the library"]
    assert [row["name"] for row in every] == list(systems.LIBRARY)
    result = command("systems", "keppler", "--json")
    assert result.exit_code == 2
    assert "did you mean kepler?" in json.loads(result.stdout)["error"]["message"]


@pytest.mark.parametrize("as_json", [False, True])
def test_an_exception_that_nobody_foresaw(monkeypatch, as_json):
    def broken(name):
        raise ZeroDivisionError("one by nought")

    monkeypatch.setattr(import_module("dvi_jax_cli.work.library"), "library_tables", broken)
    result = command("systems", *(["--json"] if as_json else []))
    assert result.exit_code == 1 == CODES["fault"]
    said = json.loads(result.stdout)["error"]["message"] if as_json else result.stderr
    assert "this is a fault of dvi_jax" in said
    assert "ZeroDivisionError: one by nought" in said
    assert "--debug" in said
    assert "Traceback" not in result.output
    with pytest.raises(ZeroDivisionError):  # the control: with --debug it comes through
        command("systems", "--debug", catch_exceptions=False)


@pytest.mark.slow
def test_debug_shows_the_traceback_and_keeps_the_exit_code():
    code = "from dvi_jax_cli import main; main()"
    done = process(code, "run", "nowhere.toml", "--debug", "--json")
    assert done.returncode == 2
    assert json.loads(done.stdout)["error"]["kind"] == "bad input"
    assert "Traceback (most recent call last)" in done.stderr
    assert done.stderr.rstrip().endswith("allowed: the path of a TOML file")


def test_a_closed_pipe_is_silent():
    code = "from dvi_jax_cli import main; main()"
    done = subprocess.run(
        ["sh", "-c", f'"{sys.executable}" -c "{code}" info | head -n 1'],
        capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.stdout.strip() == "Versions"
    assert done.stderr == ""


def test_no_control_codes_where_there_is_no_terminal():
    result = command("systems", env={"COLUMNS": "60"})
    assert "\x1b" not in result.output
    assert max(map(cell_len, result.stdout.splitlines())) <= 60
    wide = command("systems", env={"COLUMNS": "100"})  # the control
    assert max(map(cell_len, wide.stdout.splitlines())) > 60


def test_an_output_that_knows_no_greek():
    code, heavy, out, said = ended("discover", "--help", PYTHONIOENCODING="ascii", COLUMNS="100")
    assert (code, heavy, said) == (0, "", "")
    assert "invariants in ? as formulas" in out
    done = process(
        "from dvi_jax_cli._show import print_json; print_json({'a': 'ε', 'b': float('nan')})",
        PYTHONIOENCODING="ascii",
    )
    assert json.loads(done.stdout, parse_constant=pytest.fail) == {"a": "ε", "b": None}


# info, bench


def test_info(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") + " ")
    monkeypatch.setitem(names.EXTRAS, "export", ("a_module_that_is_not_there",))
    monkeypatch.setitem(names.EXTRAS, "bayes", ("jax",))
    found = json.loads(command("info", "--json").stdout)
    assert found["versions"]["dvi-jax"] == dvi.__version__
    assert found["backend"] == "cpu"
    assert found["x64_of_this_process"] is True
    assert "XLA_FLAGS" in found["flags"]
    assert found["extras"]["export"] == {
        "missing": ["a_module_that_is_not_there"],
        "install": 'pip install "dvi-jax[export]"',
    }
    assert found["extras"]["bayes"] == {"missing": [], "install": None}
    shown = command("info")
    assert shown.exit_code == 0
    assert 'pip install "dvi-jax[export]"' in shown.output


@pytest.mark.slow
def test_bench_agrees_with_its_references():
    result = command("bench", "--rounds", "3", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert {r["row"] for r in found["rows"]} == set(names.WORKLOADS)
    for row in found["rows"]:
        assert row["quartiles"][0] <= row["ratio"] <= row["quartiles"][1]
        assert row["largest_difference"] is None or row["largest_difference"] < 1e-6
        assert row["compilation_seconds"] > 0


def test_bench_tells_when_the_two_sides_differ(monkeypatch):
    bench = import_module("dvi_jax_cli.work.bench")
    side = bench.Side("", lambda: (np.zeros(2), np.zeros(2)), 10)
    other = bench.Side("another", lambda: (np.zeros(2), np.full(2, np.nan)), 10)
    row = bench.Row("single", "nothing", side, [side, other], 1e-6)
    monkeypatch.setitem(bench._ROWS, "single", lambda: row)
    result = command("bench", "--row", "single", "--json")
    assert result.exit_code == 1
    found = json.loads(result.stdout, parse_constant=pytest.fail)
    assert [r["agrees"] for r in found["rows"]] == [True, False]
    assert "differ: single" in found["error"]["message"]


# new


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    folder = tmp_path_factory.mktemp("new") / "spring"
    result = command("new", folder)
    assert result.exit_code == 0, result.output
    return folder


@pytest.fixture
def inside(project, monkeypatch):
    monkeypatch.chdir(project)
    monkeypatch.syspath_prepend(project)
    return project


def test_new_writes_a_project(project):
    assert {p.name for p in project.iterdir()} == {
        "README.md", "system.py", "run.toml", "sweep.toml", "fit.toml", "discover.toml",
        "observations.csv", "explore.py", "explore.ipynb",
    }  # fmt: skip
    readme = (project / "README.md").read_text(encoding="utf-8")
    assert readme.startswith("# spring\n")
    for path in project.iterdir():
        assert "{{" not in path.read_text(encoding="utf-8"), path
    for name in ("run", "sweep", "fit", "discover"):
        assert f"dvi-jax {name} {name}.toml" in readme


def test_its_notebook_is_valid_and_is_its_script(project):
    nbformat = pytest.importorskip("nbformat")
    found = nbformat.read(project / "explore.ipynb", as_version=4)
    nbformat.validate(found)
    made = notebook((project / "explore.py").read_text(encoding="utf-8"))
    assert [c.source for c in found.cells] == ["".join(c["source"]) for c in made["cells"]]
    kinds = [cell.cell_type for cell in found.cells]
    assert kinds[:2] == ["markdown", "code"]
    assert found.cells[0].source.startswith("# spring")
    for cell in found.cells:
        if cell.cell_type == "code":
            ast.parse(cell.source)


def test_its_run(inside):
    result = command("run", "run.toml", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["results"]["angular_momentum_drift"]["value"] < 1e-13
    # The control: of the undisturbed energy the same trajectory loses hold.
    assert found["results"]["energy_range"]["value"] > 1e-3


@pytest.mark.slow
def test_its_sweep(inside):
    result = command("sweep", "sweep.toml", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["trajectories"] == {"successful": 384}
    assert found["observed"]["angular_momentum_drift"]["max"] < 1e-13
    assert found["observed"]["energy_drift"]["max"] > 1e-3
    status = json.loads(command("sweep", "status", "results/sweep.zarr", "--json").stdout)
    assert status["tasks"]["left"] == 0
    verified = json.loads(command("sweep", "verify", "results/sweep.zarr", "--json").stdout)
    assert verified["bad"] == {}
    cost = json.loads(command("sweep", "sweep.toml", "--dry-run", "--json").stdout)
    assert cost["lanes"] == 384


@pytest.mark.slow
def test_its_fit(inside):
    result = command("fit", "fit.toml", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)["parameters"]["epsilon"]
    assert abs(found["value"] - 0.05) < 3 * found["error"]
    assert found["error"] < 1e-3
    assert abs(found["start"] - 0.05) > 3 * found["error"]  # the control: where it began


@pytest.mark.slow
def test_its_discovery(inside):
    result = command("discover", "discover.toml", "--json")
    assert result.exit_code == 0, result.output
    momentum, energy = json.loads(result.stdout)["invariants"]
    assert momentum["formula"] == "−0.5 q1 p2 + 0.5 q2 p1"
    assert max(momentum["drift"]["drifts"]) < 1e-13
    assert energy["drift"]["slope"] == pytest.approx(2, abs=0.01)


@pytest.mark.slow
def test_its_notebook_runs(inside, monkeypatch):
    import matplotlib as mpl

    mpl.use("Agg")
    monkeypatch.delitem(sys.modules, "system", raising=False)
    found = runpy.run_path("explore.py")
    assert found["solution"].observed["angular momentum"] < 1e-13
    assert found["order"].slope == pytest.approx(1, abs=0.1)
    drifts = found["many"].to_xarray().energy_drift
    assert dict(drifts.sizes) == {"x": 24, "epsilon": 12}
    largest = drifts.max("x").values
    strengths = drifts["epsilon"].values  # large enough for the method's own error to be small
    assert largest[-1] / largest[-4] == pytest.approx(strengths[-1] / strengths[-4], rel=0.15)
    q = [found["last"](e) for e in (0.05 - 1e-5, 0.05 + 1e-5)]
    assert float(found["slope"]) == pytest.approx(float(q[1] - q[0]) / 2e-5, rel=1e-6)


@pytest.mark.parametrize("name", ["kepler", "fput"])
@pytest.mark.slow
def test_a_project_of_a_system_of_the_library(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    assert command("new", "orbits", "--system", name).exit_code == 0
    monkeypatch.chdir(tmp_path / "orbits")
    result = command("run", "run.toml", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["results"]["energy_drift"]["value"] < 0.5
    result = command("sweep", "sweep.toml", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["trajectories"] == {"successful": 8}
    found = runpy.run_path("explore.py")
    assert found["solution"].status == "successful"


@pytest.mark.parametrize(
    ("words", "said"),
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
def test_names_that_are_refused(tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").write_text("mine", encoding="utf-8")
    result = command("new", *words)
    assert result.exit_code == (1 if "cannot" in said else 2), result.output
    assert said in result.stderr
    assert [p.name for p in tmp_path.rglob("*")] == ["there", "file"]


@pytest.mark.slow
def test_a_wheel_has_the_command_line_and_its_templates(tmp_path):
    hatchling = pytest.importorskip("hatchling.build")
    import zipfile

    before = Path.cwd()
    try:
        os.chdir(ROOT)
        wheel = tmp_path / hatchling.build_wheel(str(tmp_path))
    finally:
        os.chdir(before)
    with zipfile.ZipFile(wheel) as file:
        inside = set(file.namelist())
        (entry,) = (n for n in inside if n.endswith("entry_points.txt"))
        assert "dvi-jax = dvi_jax_cli:main" in file.read(entry).decode()
    templates = ROOT / "dvi_jax_cli" / "templates"
    wanted = {p.relative_to(ROOT).as_posix() for p in templates.rglob("*.*") if p.suffix != ".pyc"}
    assert len(wanted) >= 12
    assert wanted <= inside
    assert not any(n.startswith("tests") for n in inside)


def test_a_standard_output_that_is_closed_is_no_fault():
    code = "import os, sys; sys.stdout = None\n" + ONLY_HELP
    done = process(code, "--version")
    assert "Traceback" not in done.stderr
    assert done.stderr.startswith("END 0 ")


def test_the_line_to_begin_with_can_be_copied(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "cd 'a spring' &&" in command("new", "a spring").stdout


def test_too_little_memory_is_a_failure_with_its_size():
    kind, said = Session(False, False, False).kind_and_message(
        MemoryError("Unable to allocate 7.28 TiB")
    )
    assert kind == "failed"
    assert "does not have the memory for this: Unable to allocate 7.28 TiB" in said
