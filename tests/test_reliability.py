"""Files on disk: they execute nothing, and faults of a disk or a process do not falsify them."""

import ast
import re
import threading
from pathlib import Path
from types import SimpleNamespace

import faults
import numpy as np
import pytest
from dvi_jax.run import InputError

import dvi_jax as dvi
from dvi_jax.base.files import publish_npz, read_npz
from dvi_jax.fit import run
from dvi_jax.fit.optimise import Position, Record
from dvi_jax_cli.work.columns import read_columns
from dvi_jax_cli.work.loader import Loader

ROOT = Path(dvi.__file__).parent.parent
SOURCES = [
    p for name in ("dvi_jax", "dvi_jax_cli", "lanewise") for p in (ROOT / name).rglob("*.py")
]


UNSAFE = {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}
"""Modules that run what is in a file."""

IMPORTING = {"import_module", "__import__", "exec_module", "eval", "exec", "compile"}

ALLOWED = {
    "dvi_jax/proof/workers.py": {"pickle", "import_module"},  # between processes of one search
    "dvi_jax/sweep/cluster.py": {"pickle", "cloudpickle"},  # between processes of one cluster
    "dvi_jax_cli/work/loader.py": {"exec_module"},  # the Python files that a TOML file names
    "dvi_jax/interop/extras.py": {"import_module"},  # names that are in the code
    "dvi_jax/_namespaces.py": {"import_module"},  # names that are in the code
    "dvi_jax/explorer/packages.py": {"import_module"},  # names that are in the code
    "dvi_jax/fit/checks.py": {"import_module"},  # names that are in the code
    "dvi_jax_cli/work/verify.py": {"import_module"},  # names that are in the code
    "dvi_jax/sweep/export.py": {"__import__"},
}


def executing(tree):
    """The names in a module by which a file could be executed."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.split(".")[0] in UNSAFE)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in UNSAFE:
            yield node.module
        elif isinstance(node, ast.Call):
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            of = getattr(getattr(node.func, "value", None), "id", "")
            if name in IMPORTING and of != "re":
                yield name
            pickled = [k.value for k in node.keywords if k.arg == "allow_pickle"]
            is_refused = pickled and getattr(pickled[0], "value", True) is False
            if (of, name) in {("np", "load"), ("numpy", "load")} and not is_refused:
                yield "np.load without allow_pickle=False"


@pytest.mark.slow
def test_no_data_file_can_execute_code():
    found = {
        str(p.relative_to(ROOT)): {*executing(ast.parse(p.read_text("utf-8")))} for p in SOURCES
    }
    assert {file: names for file, names in found.items() if names} == ALLOWED


class Payload:
    """Something whose unpickling leaves a trace."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


def test_a_pickle_in_a_file_of_arrays_is_refused_and_not_run(tmp_path):
    trace, file = tmp_path / "trace", tmp_path / "found.npz"
    np.savez(file, about=np.array(Payload(trace), dtype=object))
    for read in (lambda p: read_npz(p, 1, "fit"), dvi.FitResult.load, read_columns,
                 lambda p: dvi.Discovery.load(p, dvi.Polynomials(2))):  # fmt: skip
        with pytest.raises(ValueError, match=r"damaged|cannot be read"):
            read(file)
    assert not trace.exists()


@pytest.mark.parametrize(
    "where", ["../own.py:system", "{folder}/own.py:system", "a/../../own.py:x"]
)
def test_a_toml_file_imports_only_from_its_own_folder(tmp_path, where):
    (tmp_path / "own.py").write_text("open(__file__ + '.trace', 'w')\n")
    (tmp_path / "runs").mkdir()
    with pytest.raises(InputError, match="is not in the folder of the TOML file"):
        Loader(tmp_path / "runs").load("system", where.format(folder=tmp_path))
    assert not (tmp_path / "own.py.trace").exists()


OLD, NEW = np.arange(5.0), np.arange(50.0)


@pytest.fixture
def file(tmp_path):
    publish_npz(tmp_path / "found.npz", 1, {"name": "old"}, {"x": OLD})
    return tmp_path / "found.npz"


def read(path):
    about, arrays = read_npz(path, 1, "fit")
    return about["name"], arrays["x"].tolist()


@pytest.mark.parametrize("length", [0, 1, 300, 10**6])
@pytest.mark.parametrize("how", ["full", "killed", "permission"])
def test_a_write_that_ends_at_any_byte_leaves_the_file_as_it_was(file, monkeypatch, how, length):
    with monkeypatch.context() as patched:
        faults.in_write(patched, how, length)
        with pytest.raises((OSError, faults.KilledError)) as caught:
            publish_npz(file, 1, {"name": "new"}, {"x": NEW})
    assert how == "killed" or "found.npz" in str(caught.value)
    assert how == "killed" or "give another path" in str(caught.value)
    assert len(list(file.parent.iterdir())) == 1 + (how == "killed")  # with the temporary file
    assert read(file) == ("old", OLD.tolist())
    publish_npz(file, 1, {"name": "new"}, {"x": NEW})
    assert read(file) == ("new", NEW.tolist())


def test_every_flipped_bit_and_every_cut_of_a_file_is_found(file):
    whole, said = file.read_bytes(), set()
    for i in range(len(whole)):
        for damaged in (whole[:i], whole[:i] + bytes([whole[i] ^ 16]) + whole[i + 1 :]):
            file.write_bytes(damaged)
            try:
                found = read(file)
            except ValueError as error:
                said.add(re.sub(r".*(damaged|format).*", r"\1", str(error)))
            else:  # a date, which says nothing
                assert found == ("old", OLD.tolist())
                assert len(damaged) == len(whole)
    assert "damaged" in said
    assert said <= {"damaged", "format"}


def test_a_file_of_another_version_is_refused_with_what_to_do(tmp_path):
    publish_npz(tmp_path / "fit.npz", 0, {}, {})
    with pytest.raises(ValueError, match=r"format 0, but .* reads 1: use the version that"):
        dvi.FitResult.load(tmp_path / "fit.npz")


def test_two_writers_of_one_file_never_mix(file):
    values = [np.full(1000, float(k)) for k in range(2)]
    seen = []

    def write(k):
        for _ in range(20):
            publish_npz(file, 1, {"name": str(k)}, {"x": values[k]})
            seen.append(read(file))

    threads = [threading.Thread(target=write, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(seen) == 40
    assert all(x == values[int(name)].tolist() for name, x in seen)


def a_run(file):
    """The part of a fit that writes its checkpoint."""
    problem = SimpleNamespace(size=1, space=SimpleNamespace(to_x=lambda x: x, names=["k"]))
    return run.FitRun(problem, 10, 1e-8, None, 0.0, file, "identity")  # pyright: ignore


def take_step(of, value):
    one = np.ones(1)
    of.watch(Record(0, np.inf, value, 1.0, True, one), Position(0, np.inf, 1, one, one, one, []))


@pytest.mark.parametrize("how", ["full", "permission"])
def test_a_fit_goes_on_where_its_checkpoint_cannot_be_written(tmp_path, monkeypatch, how):
    monkeypatch.setattr(run, "_INTERVAL", 0.0)
    file = tmp_path / "checkpoint.npz"
    fit = a_run(file)
    take_step(fit, 3.0)
    with monkeypatch.context() as patched:
        faults.in_write(patched, how, 100)
        with pytest.warns(UserWarning, match=r"checkpoint\.npz.*The fit continues and tries again"):
            take_step(fit, 2.0)
    assert [r.loss for r in a_run(file).records] == [3.0]
    take_step(fit, 1.0)
    assert [r.loss for r in a_run(file).records] == [3.0, 2.0, 1.0]


def test_a_damaged_checkpoint_is_refused_and_stays(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "_INTERVAL", 0.0)
    file = tmp_path / "checkpoint.npz"
    take_step(a_run(file), 3.0)
    damaged = file.read_bytes()[:-30]
    file.write_bytes(damaged)
    with pytest.raises(ValueError, match=r"checkpoint\.npz' is damaged"):
        a_run(file)
    assert file.read_bytes() == damaged


@pytest.mark.slow
def test_every_test_that_the_page_on_reliability_names_exists():
    page = (ROOT / "docs" / "reliability.md").read_text("utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    of_faults = [row for row in rows if row.count("|") == 4 and "fault | what" not in row]
    named = {row: re.findall(r"`(test_\w+)`", row.split("|")[3]) for row in of_faults}
    assert len(named) > 30
    assert all(named.values()), [row for row, names in named.items() if not names]
    trees = [ast.parse(p.read_text("utf-8")) for p in (ROOT / "tests").glob("test_*.py")]
    there = {f.name for tree in trees for f in tree.body if isinstance(f, ast.FunctionDef)}
    assert {n for names in named.values() for n in names} <= there
