"""Random systems and runs against plain arrays on XLA, with controls."""

import subprocess
import sys

import jax
import numpy as np
import pytest
from random_programs import checks, search
from random_programs.checks import Case, _same_bits_elsewhere, check, load
from random_programs.programs import HEAD

import lanewise

SMALL = (
    HEAD
    + """

def H(t0, t1, q, p, args):
    return p @ p / 2 + args["k"] * jnp.sum(jnp.cos(q))


SYSTEM = dvi.System(H)


def run(q, p, epsilon, args, form="auto"):
    return dvi.integrate(SYSTEM, q, p, epsilon=epsilon, args=args, h=0.1, num_steps=3,
                         throw=False, layout=dvi.Layout(form=form))


SHARED = ["args"]
START = {"q": np.array([[0.5], [np.nan]]), "p": np.array([[0.1], [0.2]]),
         "epsilon": np.zeros(2), "args": {"k": np.array(1.0)}}
SMOOTH = True
"""
)


def searched(tmp_path, count, seed):
    command = [sys.executable, search.__file__, "--count", str(count), "--seed", str(seed)]
    done = subprocess.run(
        [*command, "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        timeout=550,
    )
    assert done.returncode == 0, done.stdout
    return sum(int(line.split()[0]) for line in done.stdout.splitlines() if "of 5 traj" in line)


def test_60_programs(tmp_path):
    assert searched(tmp_path, 60, 20) > 50


@pytest.mark.slow
def test_60_more_programs(tmp_path):
    assert searched(tmp_path, 60, 100) > 50


def test_a_small_program_passes():
    assert check(SMALL) == "2 of 2 trajectories, a gradient"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("SYSTEM,", "dvi.System(lambda *at: H(*at) * (1 + 1e-11 * (form == 'auto'))),", "numbers"),
        ("num_steps=3", "num_steps=3, stop=STOP if form == 'auto' else NEVER", "status"),
        (
            "num_steps=3",
            "num_steps=3, observe=lambda *a: (1 if form == 'auto' else -1) / (a[3][0] * 0)",
            "infinities",
        ),
        ("SYSTEM, q,", "SYSTEM, q + (0.0 if form == 'auto' else jnp.nan),", "status"),
    ],
)
def test_differences_are_found(old, new, message):
    """Controls: a map that differs between machine code and arrays is a failure."""
    stops = (
        "STOP = dvi.Stop(lambda t, q, p, a: t - 0.15)\n"
        "NEVER = dvi.Stop(lambda t, q, p, a: t - 9.0)\n\n\ndef run("
    )
    with pytest.raises(AssertionError, match=message):
        check(SMALL.replace(old, new).replace("def run(", stops))


def test_a_wrong_gradient_is_found():
    observed = "observe=lambda t0, t1, q0, p0, q, p, a: bent(q[0]), num_steps=3"
    text = SMALL.replace("num_steps=3", observed)
    with pytest.raises(AssertionError, match="gradient"):
        check(text)


def test_bits_that_depend_on_the_place_are_found():
    case = Case(load(SMALL))
    start = case.copies(2)
    found = jax.tree.map(np.array, case.batch(start))
    found["states"][1][0] = np.nextafter(found["states"][1][0], 9.0)
    with pytest.raises(AssertionError, match="bits at another place"):
        _same_bits_elsewhere(case, start, found)


def test_a_crash_is_reported_and_the_search_goes_on(tmp_path, monkeypatch, capsys):
    """A child process that dies is a failure with its program, and the next portion is run."""
    dying = tmp_path / "dying.py"
    dying.write_text(
        "import os, pathlib, sys\n"
        "out = pathlib.Path(sys.argv[sys.argv.index('--out') + 1])\n"
        "seed = int(sys.argv[sys.argv.index('--seed') + 1])\n"
        "(out / 'current.py').write_text('the program')\n"
        "os.abort() if seed == 5 else print('count: 50 programs')\n"
    )
    monkeypatch.setattr(search, "__file__", str(dying))
    assert search.search(100, 1.0, 5, tmp_path / "out") == 1
    assert (tmp_path / "out" / "crash_5.py").read_text() == "the program"
    assert "100 programs, 1 failures" in capsys.readouterr().out


def test_a_program_without_an_end_is_reported(tmp_path, monkeypatch, capsys):
    stuck = tmp_path / "stuck.py"
    stuck.write_text(
        "import pathlib, sys, time\n"
        "out = pathlib.Path(sys.argv[sys.argv.index('--out') + 1])\n"
        "(out / 'current.py').write_text('the program')\n"
        "time.sleep(100)\n"
    )
    monkeypatch.setattr(search, "__file__", str(stuck))
    monkeypatch.setattr(search, "LONGEST", 1)
    assert search.search(50, 1.0, 7, tmp_path / "out") == 1
    assert (tmp_path / "out" / "crash_7.py").read_text() == "the program"
    assert "no end of a program after 1 s" in capsys.readouterr().out


def test_a_failure_is_shrunk_to_a_script(tmp_path, monkeypatch, capsys):
    def fail(text):
        assert "jnp" not in text, "a control"

    monkeypatch.setattr(checks, "check", fail)
    search.portion(3, 5, tmp_path)
    assert "failure: seed 3: AssertionError: a control" in capsys.readouterr().out
    script = (tmp_path / "failure_3_0.py").read_text()
    assert "return p @ p / 2 + " in script
    compile(script, "failure_3_0.py", "exec")


def test_code_is_generated_for_these_programs():
    assert lanewise.generates()
    assert not jax.config.jax_disable_jit
