"""Discoveries from TOML files: what they find and write, what they refuse."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import dvi_jax as dvi
from dvi_jax.run import InputError
from dvi_jax_cli import app
from dvi_jax_cli.work.expressions import parse_basis
from dvi_jax_cli.work.loader import Loader
from dvi_jax_cli.work.schema import DiscoverFile
from dvi_jax_cli.work.table import Table

EXAMPLES = Path(__file__).parent.parent / "examples"

OWN = """
import jax.numpy as jnp
import dvi_jax as dvi

system = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2,
                    force=lambda t0, t1, q0, p1, args: -(q0 @ q0) * q0)

def squares(q, p):
    return q @ q

basis = [squares, lambda q, p: p @ p, lambda q, p: q @ p]
nothing = 3

def failing(t0, t1, q0, p1, args):
    return q0.nothing

broken = dvi.System(failing)
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
    (tmp_path / "own.py").write_text(OWN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(folder, text, name="discover.toml"):
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def command(*words):
    return CliRunner().invoke(app, ["discover", *(str(w) for w in words)])


@pytest.mark.slow
def test_a_small_discovery(folder):
    """What the undisturbed map of type II keeps, (p² + q² − h q p)/2, drifts by ε."""
    result = command(write(folder, SMALL), "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout, parse_constant=pytest.fail)
    (told,) = found["invariants"]
    assert told["formula"] == "0.5 q² − 0.05 q p + 0.5 p²"
    assert max(told["residuals"]) < 1e-13
    assert told["drift"]["slope"] == pytest.approx(1, abs=0.05)
    assert told["drift"]["floor"] < 1e-13 < min(told["drift"]["drifts"])
    assert told["reach"] is None  # infinite: there is no correction
    saved = dvi.Discovery.load(folder / "out" / "discovery.npz", dvi.Polynomials(2))
    np.testing.assert_array_equal(saved.coefficients[0], told["coefficients"])
    assert {p.name for p in (folder / "out").iterdir()} == {"discovery.npz", "invariants.json"}


def test_where_nothing_is_kept(folder):
    """The control: linear functions alone. That is a result, and no failure."""
    text = SMALL.replace("Polynomials(2)", "Polynomials(1)")
    result = command(write(folder, text))
    assert result.exit_code == 0, result.output
    assert "0 independent invariants" in result.output
    written = json.loads((folder / "out" / "invariants.json").read_text(encoding="utf-8"))
    assert written["invariants"] == []


@pytest.mark.slow
def test_the_example(folder):
    shutil.copy(EXAMPLES / "discover.toml", folder)
    result = command("discover.toml")
    assert result.exit_code == 0, result.output
    assert "I = 0.5 q² − 0.05 q p + 0.5 p² + ε (0.5 q² − 0.05 q p)" in result.output
    assert "exact at every ε tried" in result.output
    out = folder / "results" / "discover"
    assert {p.name for p in out.iterdir()} == {"discovery.npz", "invariants.json", "drifts.png"}


def test_a_basis_is_read_as_it_is_written(folder):
    loader = Loader(folder)
    made = parse_basis("Polynomials(2, ['q']) * Radial((-1,)) + Trigonometric(1, 'q')", loader)
    names = made.for_shape((1,)).names
    assert len(names) == 4
    assert "cos q" in names
    assert parse_basis("own.py:basis", loader).for_shape((1,)).size == 3


REFUSED = [
    ('"Polynomials(2)"', '"Polinomials(2)"', "basis: 'Polinomials'", "did you mean Polynomials?"),
    (
        '"Polynomials(2)"',
        '"Polynomials"',
        "'Polynomials' without its arguments in parentheses",
        "Polynomials",
    ),
    ('"Polynomials(2)"', '"Polynomials(0)"', "degree must be", "Polynomials"),
    ('"Polynomials(2)"', '"Polynomials("', "the syntax is not that of a call", "Polynomials"),
    ('"Polynomials(2)"', '"print(3)"', "basis: 'print'", "Polynomials"),
    ('"Polynomials(2)"', "\"__import__('os').system('ls')\"", "is not one of these", "Polynomials"),
    ('"Polynomials(2)"', '"own.py:nothing"', "basis: 'own.py:nothing'", "sums and products"),
    ('"Polynomials(2)"', "\"Chebyshev(3, 'q7')\"", "basis: ", "a q of shape (1,)"),
    ('basis = "Polynomials(2)"', "", "basis: the key is missing", "Polynomials"),
    ("order = 0", "order = -1", "order: -1", "not negative"),
    ("order = 0", "order = true", "order: true", "not negative"),
    ("low = {q = [-1.0], p = -1.0}", "", "samples.low: the key is missing", "a corner"),
    ("low = {q = [-1.0]", "low = {q = [2.0]", "samples.low: it is not below", "low < high"),
    ("low = {q = [-1.0]", "low = {q = [-1, -1]", "samples.low: shapes (1,), (2,)", "one shape"),
    ("low = {q = [-1.0]", "low = {x = [-1.0]", "samples.low.x: there is no such key", "q, p"),
    ("[drift]", "count = 3\n[drift]", "samples.count: 3", "10 at least"),
    ("[drift]", "times = [2, 1]\n[drift]", "samples.times: [2, 1]", "[first, last]"),
    ("[1e-4, 1e-3, 1e-2]", "[1e-4, 1e-3]", "drift.epsilons", "three numbers or more"),
    ("[1e-4, 1e-3, 1e-2]", "[1e-4, 0, 1e-2]", "drift.epsilons", "above zero"),
    ("[1e-4, 1e-3, 1e-2]", "{geomspac = [1, 2, 3]}", "epsilons.geomspac", "did you mean geom"),
    ("own.py:system", "own.py:broken", "cannot be searched: AttributeError", "functions"),
    ("own.py:system", "own.py:forced", "samples are of one time", "samples.times"),
    ("steps = 200", "step = 200", "drift.step: there is no such key", "did you mean steps?"),
]


@pytest.mark.parametrize(
    ("old", "new", "seen", "allowed"), REFUSED, ids=[f"{r[1][:30]}" for r in REFUSED]
)
def test_what_cannot_be_meant_is_refused(folder, old, new, seen, allowed):
    assert old in SMALL
    result = command(write(folder, SMALL.replace(old, new)))
    assert result.exit_code == 2, result.output
    assert seen in result.stderr, result.stderr
    assert allowed in result.stderr.partition("allowed: ")[2], result.stderr
    assert not (folder / "out").exists()  # nothing is left behind


def test_a_directory_that_has_something_is_left_alone(folder):
    (folder / "out").mkdir()
    (folder / "out" / "mine").write_text("mine", encoding="utf-8")
    result = command(write(folder, SMALL))
    assert result.exit_code == 2
    assert "is not empty" in result.stderr
    assert [p.name for p in (folder / "out").iterdir()] == ["mine"]


def test_every_key_is_shown_in_an_example():
    text = (EXAMPLES / "discover.toml").read_text(encoding="utf-8")
    for key, field in DiscoverFile.model_fields.items():
        if key not in ("state", "args", "t0"):  # those of a run
            assert f"{key} = " in text or f"[{key}]" in text, key
        kind = field.annotation
        is_table = isinstance(kind, type) and issubclass(kind, Table) and key != "state"
        for name in kind.model_fields if is_table else ():
            assert f"{name} = " in text or name == "plots", f"{key}.{name}"


def test_nothing_but_a_basis_is_made(folder):
    with pytest.raises(InputError, match="is not one of these"):
        parse_basis("(lambda: 3)()", Loader(folder))
