"""Commands of benchmarks/ find what they import; those of figures keep their bounds."""

import importlib.util
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"


def load(name, monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", sorted(p.stem for p in FOLDER.glob("[a-z]*.py")))
def test_it_finds_what_it_imports(name, monkeypatch):
    assert load(name, monkeypatch).__doc__


@pytest.mark.slow
def test_figures_of_dynamics_keep_their_bounds(monkeypatch, capsys):
    bench = load("dynamics", monkeypatch)
    assert bench.main(["--quick", "--check"]) == 0
    assert capsys.readouterr().out.count("| holds |") == 8


@pytest.mark.slow
def test_figures_of_encounters_keep_their_bounds(monkeypatch, capsys):
    """Energy errors and MEGNOs; escapes from a few systems, in less time than the whole row."""
    pytest.importorskip("rebound")
    bench = load("encounters", monkeypatch)
    assert bench.main(["--rows", "energy", "megno", "--check"]) == 0
    assert capsys.readouterr().out.count("  ok ") == 3 + 16
    text, is_good = next(bench.escapes(32, 4000))
    assert is_good, text
    # The control: times that are a third as long.
    times = bench.times_of_rebound(32, 3, 4000)
    assert bench.ks_2samp(times, times / 3).pvalue < 0.01


def test_a_bound_that_is_missed_is_told(monkeypatch, capsys):
    bench = load("dynamics", monkeypatch)
    monkeypatch.setattr(bench, "ROWS", {"one": lambda: iter([("x", "2", "1", False)])})
    assert bench.main(["--check"]) == 1
    assert bench.main([]) == 0
    assert "MISSED" in capsys.readouterr().out
