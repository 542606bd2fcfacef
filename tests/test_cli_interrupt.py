"""Ctrl-C and SIGTERM end every command with exit code 130 or 143, no traceback, and nothing left.

They are sent at chosen places: during imports, in a callback, in a compilation, in a run.
"""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from cli import MAIN, ROOT, process, write

START = """
import gc, os, signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)  # children of tests may have it ignored
NUMBER = signal.NAME
"""
IN_AN_IMPORT = """
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), NUMBER)
sys.meta_path.insert(0, Finder())
"""
IN_THE_GARBAGE_COLLECTOR = """
sent = []
def callback(phase, info):
    if not sent and os.path.isdir("out"):  # the work has begun
        sent.append(1)
        threading.Timer(60, print).start()  # such as JAX has while it starts a device
        os.kill(os.getpid(), NUMBER)
gc.callbacks.append(callback)
"""
# A thread that still compiles when the interpreter ends: a segmentation fault in XLA without more.
IN_A_COMPILATION = """
import jax, jax.numpy as jnp
def compile(k):
    while True:
        k += 1
        jax.jit(lambda x: jnp.linalg.eigh(jnp.sin(x + k))[0] @ x)(jnp.ones((30, 30)))
import dvi_jax, time
def integrate(*args, **keywords):
    for k in range(4):
        threading.Thread(target=compile, args=(1000 * k,), daemon=True).start()
    time.sleep(1)
    os.kill(os.getpid(), NUMBER)
    time.sleep(20)
dvi_jax.integrate = integrate
"""
RUN = """
system = "kepler"
epsilon = 0.0
h = 0.1
steps = 20
[output]
dir = "a/b/out"
plots = false
"""
CODES = {"SIGINT": 130, "SIGTERM": 143, "SIGHUP": 129}


def interrupted(folder, when, name="SIGINT"):
    code = START.replace("NAME", name) + when.replace('"out"', '"a/b/out"') + MAIN
    done = process(code, "run", write(folder, RUN), folder=folder)
    assert done.returncode == CODES[name], done.stderr
    assert "Traceback" not in done.stderr
    assert [path.name for path in folder.iterdir()] == ["file.toml"], done.stderr
    return done.stderr


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("typer", "SIGINT"),
        ("numpy.matrixlib", "SIGINT"),
        ("jax._src.core", "SIGTERM"),
        ("dvi_jax_cli.work.run", "SIGHUP"),
    ],
)
def test_signals_during_the_imports(module, name, tmp_path):
    """NumPy is imported by an extension module, which makes an ImportError of any exception."""
    message = interrupted(tmp_path, IN_AN_IMPORT.format(module=module), name)
    assert module == "typer" or message.startswith("interrupted: by Ctrl-C or SIGTERM")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_signals_in_the_garbage_collector(name, tmp_path):
    """Python only reports an exception of its callbacks; without more the run would continue."""
    message = interrupted(tmp_path, IN_THE_GARBAGE_COLLECTOR, name)
    assert message.startswith("interrupted: by Ctrl-C or SIGTERM; nothing")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_signals_while_a_thread_compiles(name, tmp_path):
    for _ in range(2):
        assert interrupted(tmp_path, IN_A_COMPILATION, name).startswith("interrupted: by Ctrl-C")


def started(folder, text, *before, patience=None):
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "".join(before)
    if patience is not None:
        code += f"import dvi_jax_cli._main as m; m._PATIENCE = {patience}\n"
    words = [sys.executable, "-c", code + MAIN, "run", str(write(folder, text))]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(words, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True)


def wait_for(path):
    until = time.monotonic() + 60
    while not path.exists() and time.monotonic() < until:
        time.sleep(0.02)
    assert path.exists()


@pytest.mark.slow
def test_sigterm_ends_a_call_that_does_not_return_to_python(tmp_path):
    """A run in machine code takes longer than a batch system waits before it kills."""
    long = RUN.replace("steps = 20", "steps = 2_000_000_000")
    long = long.replace("[output]", "[output]\nevery = 1_000_000_000")
    process = started(tmp_path, long, patience=0.5)
    wait_for(tmp_path / "a/b/out")
    time.sleep(1.5)
    process.send_signal(signal.SIGTERM)
    _, message = process.communicate(timeout=30)
    assert process.returncode == 143, message
    assert message.startswith("interrupted: by ")
    assert not (tmp_path / "a").exists()


@pytest.mark.slow
def test_ignored_signals_stay_ignored(tmp_path):
    """As after nohup; and what ends in the same way otherwise is done."""
    ignored = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
    ignored += IN_AN_IMPORT.format(module="dvi_jax_cli.work.run")
    code = START.replace("NAME", "SIGHUP") + ignored + MAIN
    done = process(code, "run", write(tmp_path, RUN), "--json", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["folder"] == "a/b/out"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_folder_that_was_there_stays(name, tmp_path):
    (tmp_path / "a").mkdir()
    code = START.replace("NAME", name)
    code += IN_THE_GARBAGE_COLLECTOR.replace('"out"', '"a/b/out"') + MAIN
    done = process(code, "run", write(tmp_path, RUN), folder=tmp_path)
    assert done.returncode == CODES[name], done.stderr
    assert [*(tmp_path / "a").iterdir()] == []
