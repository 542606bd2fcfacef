"""Ctrl-C ends every command with exit code 130 and no traceback, also while it is imported."""

import pytest
from cli import MAIN, process, write

START = """
import gc, os, signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)  # children of tests may have it ignored
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
RUN = 'system = "kepler"\nh = 0.1\nsteps = 20\n[output]\ndir = "out"\nplots = false\n'


def interrupted(folder, when):
    done = process(START + when + MAIN, "run", write(folder, RUN), folder=folder)
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr


@pytest.mark.parametrize(
    "module", ["typer", "numpy.matrixlib", "jax._src.core", "dvi_jax_cli.work.run"]
)
def test_ctrl_c_during_the_imports(module, tmp_path):
    """NumPy is imported by an extension module, which makes an ImportError of any exception."""
    message = interrupted(tmp_path, IN_AN_IMPORT.format(module=module))
    assert module == "typer" or message.startswith("interrupted: by Ctrl-C")
    assert not (tmp_path / "out").exists(), message


def test_ctrl_c_in_the_garbage_collector(tmp_path):
    """Python only reports an exception of its callbacks; without more the run would continue."""
    assert interrupted(tmp_path, IN_THE_GARBAGE_COLLECTOR).startswith("interrupted: by Ctrl-C")
