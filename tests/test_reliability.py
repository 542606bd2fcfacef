"""Files on disk: they execute nothing, and faults of a disk or a process do not falsify them."""

import ast
from pathlib import Path

import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.fit.result import read_npz
from dvi_jax.run import InputError
from dvi_jax.run._data import read_columns
from dvi_jax.run._setup import Loader

ROOT = Path(dvi.__file__).parent.parent
SOURCES = [
    p for name in ("dvi_jax", "dvi_jax_cli", "lanewise") for p in (ROOT / name).rglob("*.py")
]

# --- data files execute nothing ----------------------------------------------------------------

UNSAFE = {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}
"""Modules that run what is in a file."""

IMPORTING = {"import_module", "__import__", "exec_module", "eval", "exec", "compile"}

ALLOWED = {
    "dvi_jax/sweep/cluster.py": {"pickle", "cloudpickle"},  # between processes of one cluster
    "dvi_jax/run/_setup.py": {"exec_module"},  # the Python files that a TOML file names
    "dvi_jax/interop/extras.py": {"import_module"},  # names that are in the code
    "dvi_jax/paper/equations.py": {"import_module"},
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
    for read in (lambda p: read_npz(p, "fit"), dvi.FitResult.load, read_columns,
                 lambda p: dvi.Discovery.load(p, dvi.Polynomials(2))):  # fmt: skip
        with pytest.raises(ValueError, match="is no"):
            read(file)
    assert not trace.exists()


@pytest.mark.parametrize(
    "where", ["../own.py:system", "{folder}/own.py:system", "a/../../own.py:x"]
)
def test_a_toml_file_imports_only_from_its_own_folder(tmp_path, where):
    (tmp_path / "own.py").write_text("open(__file__ + '.trace', 'w')\n")
    (tmp_path / "runs").mkdir()
    with pytest.raises(InputError, match="leaves the folder of the TOML file"):
        Loader(tmp_path / "runs").load("system", where.format(folder=tmp_path))
    assert not (tmp_path / "own.py.trace").exists()
