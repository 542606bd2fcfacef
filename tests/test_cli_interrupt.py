"""Ctrl-C ends every command with exit code 130 and no traceback, wherever it meets the process."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import dvi_jax as dvi

ROOT = Path(dvi.__file__).parent.parent

START = """
import gc, os, signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)  # children of tests may have it ignored
"""
MAIN = """
from dvi_jax_cli import main
main()
"""
IN_AN_IMPORT = """
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
"""
IN_THE_GARBAGE_COLLECTOR = """
sent = []
def callback(phase, info):
    if not sent and os.path.isdir("out"):  # the work has begun
        sent.append(1)
        threading.Timer(60, print).start()  # such as JAX has while it starts a device
        os.kill(os.getpid(), signal.SIGINT)
gc.callbacks.append(callback)
"""
RUN = """
system = "kepler"
h = 0.1
steps = 20
[output]
dir = "out"
plots = false
"""


def ended(code, *words, folder):
    return subprocess.run(
        [sys.executable, "-c", START + code + MAIN, *words], capture_output=True, text=True,
        check=False, cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, timeout=30,
    )  # fmt: skip


@pytest.mark.parametrize(
    "module", ["typer", "numpy.matrixlib", "jax._src.core", "dvi_jax_cli.work.run"]
)
def test_ctrl_c_during_the_imports(module, tmp_path):
    """NumPy is imported by an extension module, which makes an ImportError of any exception."""
    (tmp_path / "run.toml").write_text(RUN, encoding="utf-8")
    done = ended(IN_AN_IMPORT.format(module=module), "run", "run.toml", folder=tmp_path)
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr
    assert module == "typer" or done.stderr.startswith("interrupted: by Ctrl-C")
    assert not (tmp_path / "out").exists()


def test_ctrl_c_that_the_garbage_collector_swallows(tmp_path):
    """An exception of its callbacks is only reported: the run went on to its end, exit code 0."""
    (tmp_path / "run.toml").write_text(RUN, encoding="utf-8")
    done = ended(IN_THE_GARBAGE_COLLECTOR, "run", "run.toml", folder=tmp_path)
    assert done.returncode == 130, done.stderr
    assert done.stderr.startswith("interrupted: by Ctrl-C")
    assert "Traceback" not in done.stderr
