"""Discoveries from TOML files: what they find and write, which input they reject."""

import shutil

import numpy as np
import pytest
from cli import EXAMPLES, command, found, names, read, refuses, write
from dvi_jax.run import InputError

import dvi_jax as dvi
from dvi_jax_cli.work.expressions import parse_basis
from dvi_jax_cli.work.loader import Loader

OWN = """
import jax.numpy as jnp
import dvi_jax as dvi

system = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2,
                    force=lambda t0, t1, q0, p1, args: -(q0 @ q0) * q0)

basis = [lambda q, p: q @ q, lambda q, p: p @ p, lambda q, p: q @ p]
nothing = 3

def failing(t0, t1, q0, p1, args):
    return q0.nothing

broken, ball = dvi.System(failing), dvi.systems.bouncing_ball()
forced = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2 + q0[0] * jnp.cos(t0))
"""

SMALL = """
system = "own.py:system"
h = 0.1
basis = "Polynomials(2)"
order = 0
[samples]
low = {q = [-1.0], p = -1.0}
high = {q = [1.0], p = 1.0}
[drift]
epsilons = [1e-4, 1e-3, 1e-2]
steps = 200
starts = 2
[output]
dir = "out"
plots = false
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    write(tmp_path, OWN, "own.py")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_a_small_discovery(folder):
    """The unperturbed map of type II conserves (p² + q² − h q p)/2; it drifts by O(ε)."""
    (invariant,) = found("discover", write(folder, SMALL))["invariants"]
    assert invariant["formula"] == "0.5 q² − 0.05 q p + 0.5 p²"
    assert max(invariant["residuals"]) < 1e-13
    drift = invariant["drift"]
    assert drift["slope"] == pytest.approx(1, abs=0.05)
    assert drift["floor"] < 1e-13 < min(drift["drifts"])
    assert invariant["reach"] is None  # infinite: there is no correction
    saved = dvi.Discovery.load("out/discovery.npz", dvi.Polynomials(2))
    np.testing.assert_array_equal(saved.coefficients[0], invariant["coefficients"])
    assert names("out") == {"discovery.npz", "invariants.json"}


def test_a_basis_without_invariants(folder):
    """The control: linear functions alone. That is a result, and no failure."""
    result = command("discover", write(folder, SMALL.replace("als(2)", "als(1)")))
    assert result.exit_code == 0, result.output
    assert "0 independent conserved quantities" in result.output
    assert read("out/invariants.json")["invariants"] == []


@pytest.mark.slow
def test_the_example(folder):
    shutil.copy(EXAMPLES / "discover.toml", folder)
    result = command("discover", "discover.toml")
    assert result.exit_code == 0, result.output
    assert "I = 0.5 q² − 0.05 q p + 0.5 p² + ε (0.5 q² − 0.05 q p)" in result.output
    assert "exact at every ε tried" in result.output
    assert names("results/discover") == {"discovery.npz", "invariants.json", "drifts.png"}


def test_a_basis_is_read_as_it_is_written(folder):
    loader = Loader(folder)
    made = parse_basis("Polynomials(2, ['q']) * Radial((-1,)) + Trigonometric(1, 'q')", loader)
    functions = made.for_shape((1,)).names
    assert len(functions) == 4
    assert "cos q" in functions
    assert parse_basis("own.py:basis", loader).for_shape((1,)).size == 3
    with pytest.raises(InputError, match="is not a name"):  # nothing else is called
        parse_basis("(lambda: 3)()", loader)
    with pytest.raises(InputError, match=r"argument with \*\*"):
        parse_basis("Polynomials(**{'degree': 3})", loader)


BASIS, LOW, SEVERAL = '"Polynomials(2)"', "low = {q = [-1.0]", "[1e-4, 1e-3, 1e-2]"
REJECTED = [
    (BASIS, '"Polinomials(2)"', "basis: 'Polinomials'", "did you mean Polynomials?"),
    (BASIS, '"Polynomials"', "requires arguments", "Poly"),
    (BASIS, '"Polynomials(0)"', "degree must be", "Polynomials"),
    (BASIS, '"Polynomials("', "is not a valid expression", "Polynomials"),
    (BASIS, '"print(3)"', "basis: 'print'", "Polynomials"),
    (BASIS, "\"__import__('os').system('ls')\"", "is not a name", "Polynomials"),
    (BASIS, "\"Chebyshev(3, 'q7')\"", "basis: ", "used for q of shape (1,)"),
    (LOW, "low = {q = [2.0]", "samples.low: it is not below", "low < high"),
    (LOW, "low = {q = [-1, -1]", "low and high have shapes (1,), (2,)", "the same shape"),
    ("[drift]", "count = 3\n[drift]", "samples.count: the value is 3", "at least 10"),
    ("[drift]", "times = [2, 1]\n[drift]", "samples.times: the value is [2, 1]", "[first, last]"),
    (SEVERAL, "[1e-4, 1e-3]", "drift.epsilons", "three numbers or more"),
    (SEVERAL, "[1e-4, 0, 1e-2]", "drift.epsilons", "above zero"),
    ("own.py:system", "own.py:broken", "cannot be searched: AttributeError", "functions"),
    ("own.py:system", "own.py:ball", "has jumps", "a system without jumps"),
    ("own.py:system", "own.py:forced", "depends on the time", "samples.times"),
]


@pytest.mark.parametrize(("old", "new", "seen", "allowed"), REJECTED)
def test_bad_input(folder, old, new, seen, allowed):
    assert old in SMALL
    refuses(command("discover", write(folder, SMALL.replace(old, new))), seen, allowed)
    assert not (folder / "out").exists()
