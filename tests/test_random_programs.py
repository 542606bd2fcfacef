"""Random systems and runs against plain arrays on XLA, with controls."""

import copy
import functools
import subprocess
import sys

import jax
import numpy as np
import pytest
from random_programs import checks, kind_checks, kinds, search
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
    command += ["--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=550)
    assert done.returncode == 0, done.stdout
    return [line for line in done.stdout.splitlines() if "of 5 traj" in line]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "count"),
    [(20, 3), *(pytest.param(*pair, marks=pytest.mark.slow) for pair in [(24, 16), (100, 70)])],
)
def test_random_programs_agree(tmp_path, seed, count):
    checked = searched(tmp_path, count, seed)
    assert sum(int(line.split()[0]) for line in checked) > count - max(count // 3, 2)
    has_gradient = any("gradient" in line and "no gradient" not in line for line in checked)
    assert has_gradient or count < 10


structure = functools.cache(kind_checks.structure)


@pytest.mark.parametrize(
    "number", [5, *(pytest.param(n, marks=pytest.mark.slow) for n in range(24) if n != 5)]
)
def test_random_structures_agree_with_plain_loops(number):
    """Stops, splittings, noise, constraints, pairs, rings, the library: see `kinds`, `library`."""
    compiled, is_quick = structure(number), number == 5
    if not is_quick:
        compiled.check_empty()
    for i in range(10):
        compiled.check(100_000 + i, slopes=not is_quick)


def test_requested_times_are_in_the_run_for_a_shared_step():
    """A batch shares the step of its first trajectory, and times after the end are a failure."""
    random, kind = np.random.default_rng(0), kinds.stop(np.random.default_rng(52700))
    assert ", ts " in kind.text
    lanes = [kind.draw(random) for _ in range(20)]
    for numbers in lanes:
        states = kind.loop({**numbers, "h": lanes[0]["h"], "c": np.array(100.0)})
        assert states["status"]
        assert np.isfinite(states["qs"]).all()


def test_a_wrong_loop_and_a_valid_number_are_reported():
    """Controls of the test above."""
    compiled = copy.copy(structure(5))
    kind = compiled.kind

    def wrong(numbers):
        values = kind.loop(numbers)
        return {**values, "z": values["z"] * (1 + 1e-8)}

    compiled.kind = kind._replace(loop=wrong)
    with pytest.raises(AssertionError, match="z of 0"):
        compiled.check(0, slopes=False)
    compiled.kind = kind._replace(invalid=[lambda numbers: {**numbers, "z": 0 * numbers["z"]}])
    with pytest.raises(AssertionError, match="successful"):
        compiled.check(0, slopes=False)


def test_a_small_program_passes():
    assert lanewise.generates()
    assert not jax.config.jax_disable_jit
    assert check(SMALL) == "2 of 2 trajectories, a gradient"


SIGN = "(1 if form == 'auto' else -1)"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("SYSTEM,", "dvi.System(lambda *at: H(*at) * (1 + 1e-11 * (form == 'auto'))),", "numbers"),
        ("SYSTEM, q,", "SYSTEM, q + (0.0 if form == 'auto' else jnp.nan),", "status"),
        *(pytest.param("h=0.1", f"h=0.1, {new}", message, marks=pytest.mark.slow) for new,
            message in [(f"stop=dvi.Stop(lambda t, q, p, a: t - 4.5 + 4.35 * {SIGN})", "status"),
            (f"observe=lambda *a: {SIGN} / (a[3][0] * 0)", "infinities"),
            ("observe=lambda t0, t1, q0, p0, q, p, a: bent(q[0])", "gradient")]),
    ],
)  # fmt: skip
def test_differences_are_found(old, new, message):
    """Controls: a map that differs between machine code and arrays, and a wrong derivative."""
    with pytest.raises(AssertionError, match=message):
        check(SMALL.replace(old, new))


def test_bits_that_depend_on_the_place_are_found():
    case = Case(load(SMALL))
    start = case.copies(2)
    found = jax.tree.map(np.array, case.batch(start))
    found["states"][1][0] = np.nextafter(found["states"][1][0], 9.0)
    with pytest.raises(AssertionError, match="bits at another place"):
        _same_bits_elsewhere(case, start, found, alone=True)


CHILD = """
import os, pathlib, sys, time
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
seed = int(sys.argv[sys.argv.index("--seed") + 1])
(out / "current.py").write_text("the program")
{} if seed == 5 else print("count: 60 programs")
"""


@pytest.mark.parametrize(
    ("fails", "message"),
    [("os.abort()", "exit status -6"), ("time.sleep(100)", "no end of a program after 1 s")],
)
def test_a_child_that_dies_or_does_not_end_is_reported(
    tmp_path, monkeypatch, capsys, fails, message
):
    """It is a failure with its program, and the search goes on with the next portion."""
    child = tmp_path / "child.py"
    child.write_text(CHILD.format(fails))
    monkeypatch.setattr(search, "__file__", str(child))
    monkeypatch.setattr(search, "LONGEST", 1)
    assert search.search(120, 1.0, 5, tmp_path / "out") == 1
    assert (tmp_path / "out" / "crash_5.py").read_text() == "the program"
    said = capsys.readouterr().out
    assert message in said
    assert "120 programs, 1 failures" in said


def test_a_failure_is_shrunk_to_a_script(tmp_path, monkeypatch, capsys):
    def fail(text, alone):
        assert "jnp" not in text, "a control"

    monkeypatch.setattr(checks, "check", fail)
    search.portion(3, 5, tmp_path)
    assert "failure: seed 3: AssertionError: a control" in capsys.readouterr().out
    script = (tmp_path / "failure_3_0.py").read_text()
    assert "return p @ p / 2 + " in script
    compile(script, "failure_3_0.py", "exec")
