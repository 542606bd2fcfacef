"""The examples in docstrings and in docs/examples.md run, and print what they show."""

import ast
import contextlib
import inspect
import io
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import _namespaces, plot, systems
from dvi_jax.systems import rings

sys.path.append(str(Path(__file__).parents[1] / "docs/_ext"))
import usage

KNOWN = {"jax": jax, "jnp": jnp, "np": np, "dvi": dvi}
KNOWN |= {"systems": systems, "plot": plot, "rings": rings}
PAGE = usage.page()

DOCSTRINGS = {
    f"dvi.{name}": usage.BLOCK.findall(inspect.getdoc(getattr(dvi, name)) or "")
    for name in _namespaces.names()
    if inspect.isclass(getattr(dvi, name)) or inspect.isfunction(getattr(dvi, name))
}
DOCSTRINGS |= {
    f"{space}.{name}": usage.BLOCK.findall(inspect.getdoc(thing) or "")
    for space, module in {"rings": rings, "elements": dvi.elements, "forces": dvi.forces}.items()
    for name, thing in vars(module).items()
    if inspect.isclass(thing) or inspect.isfunction(thing)
}
DOCSTRINGS = {name: blocks for name, blocks in DOCSTRINGS.items() if blocks}

FAST = ("dvi.Given", "generators.rotation", "plot.orbit")


def wanted(code):
    """What an example says that it prints: its comments that are lines of their own."""
    return "\n".join(line[2:] for line in code.splitlines() if line.startswith("# "))


def agrees(printed, expected):
    """… stands for anything."""
    return re.fullmatch(".*".join(map(re.escape, expected.split("…"))), printed, re.S) is not None


def run(code, known):
    """What an example prints; it sees `known` alone."""
    assert any(isinstance(x, ast.Call) for x in ast.walk(ast.parse(code)))
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(code, dict(known))
    return out.getvalue().rstrip("\n")


# ArviZ speaks of its next version at the first import of each day.
WITHOUT_WARNINGS = pytest.mark.filterwarnings(
    "error::FutureWarning", "error::UserWarning", r"ignore:\nArviZ is undergoing:FutureWarning"
)


@pytest.mark.slow
@WITHOUT_WARNINGS
@pytest.mark.parametrize("name", DOCSTRINGS)
def test_it_runs_and_prints_what_it_says(name):
    for code in DOCSTRINGS[name]:
        assert wanted(code), "an example ends with what it prints, as a comment below"
        printed = run(code, KNOWN)
        assert agrees(printed, wanted(code)), printed


@pytest.fixture(scope="module")
def known():
    """code → the names that it may use: those of the imports, and of the lines that the reference
    shows before it. Each of these lines is executed once."""
    made = {}

    def names(code):
        seen = dict(KNOWN)
        for statement in PAGE.lines_before(code):
            if statement not in made:
                after = dict(seen)
                exec(statement, after)
                made[statement] = {x: after[x] for x in after.keys() - seen.keys()}
            seen |= made[statement]
        return seen

    return names


@WITHOUT_WARNINGS
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in FAST else pytest.mark.slow) for n in PAGE.code]
)
def test_the_example_of_the_page_prints_what_it_says(name, known, tmp_path, monkeypatch):
    code = PAGE.code[name]
    for package in re.findall(r"^(?:import|from) (diffrax|rebound|astropy|interpax)\b", code, re.M):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("Agg")
    printed = run(code, known(code))
    figures = [plt.figure(number) for number in plt.get_fignums()]
    plt.close("all")
    assert wanted(code) or any(axis.has_data() for f in figures for axis in f.axes)
    assert agrees(printed, wanted(code)), printed


def test_an_example_sees_the_names_that_the_reference_shows_and_no_others(known):
    assert [x.split(" =")[0] for x in PAGE.lines_before("print(fitted)")] == [
        *("elastic", "model", "ts", "noise", "data", "fitted")
    ]
    assert run("print(spring is not None)", known("spring")) == "True"
    with pytest.raises(NameError, match="spring"):
        run("print(spring)", known("x"))


def without(things, page):
    """Names of the reference that a user calls, and that have no example."""
    left = []
    for name, thing in things.items():
        is_class = inspect.isclass(thing)
        made_by_others = is_class and (
            issubclass(thing, BaseException) or hasattr(thing, "_name_to_item")
        )
        is_there = "```python" in (inspect.getdoc(thing) or "")
        if not (made_by_others or is_there or name in page.code or name in page.origins):
            left.append(name)
    return left


@pytest.fixture(scope="module")
def entries():
    """Name → thing, of the whole reference except for the library of systems."""
    pytest.importorskip("sphinx")
    import reference

    pages = reference.entries()
    del pages["systems"]
    return {shown: thing for page in pages.values() for shown, thing in page.values()}


def test_every_name_has_one_example(entries):
    assert without(entries, PAGE) == []
    code = {name: text for name, text in PAGE.code.items() if name != "plot.orbit"}
    assert without(entries, PAGE._replace(code=code)) == ["plot.orbit"]
    assert without({"dvi.planted": lambda x: x}, PAGE) == ["dvi.planted"]
    # An entry with an example in its docstring keeps that; an object that users do not make is a
    # class, whose entry names a function or a class that is in the reference.
    listed = [*DOCSTRINGS, *PAGE.code, *PAGE.origins]
    assert len(listed) == len(set(listed)) > 200
    assert set(listed) - set(entries) == {"systems", "plot"}
    for name, origin in PAGE.origins.items():
        assert inspect.isclass(entries[name]), name
        found = re.findall(
            r"`((?:dvi|rings|interop|starts|lanewise|systems\.boozer)\.\w+)`", origin
        )
        assert found or "all generated" in origin, name
        assert set(found) <= set(entries), name


def test_the_reference_shows_the_example_once_with_the_lines_that_it_needs(entries):
    import reference

    def shown(name):
        return reference._entry(name.replace("dvi.", "dvi_jax."), name, entries[name])

    assert "\nkepler = systems.kepler()\norbit = dvi.integrate(" in shown("plot.orbit")
    assert PAGE.code["plot.orbit"] in shown("plot.orbit")
    assert "Returned by `dvi.fit`." in shown("dvi.FitResult")
    for name in ("plot.orbit", "dvi.Save"):
        assert shown(name).count("**Example**") == 1


def test_what_people_call_first_has_an_example_in_its_docstring():
    first = {
        "System", "discretise", "integrate", "Save", "MaxDrift", "Section", "Stop", "MEGNO",
        "find_symmetries", "discover_invariants", "drift_order", "noether_balance", "sweep", "fit",
        "poincare_section", "frequencies",
    }  # fmt: skip
    assert {f"dvi.{name}" for name in first} <= set(DOCSTRINGS)


def test_a_wrong_number_is_seen():
    assert wanted("print(1)\n# 1 and more\nprint(2)  # no line of its own\n# 2") == "1 and more\n2"
    assert agrees("1 and more\n2", "1 …\n2")
    assert not agrees("1 and more\n3", "1 …\n2")
    assert not agrees("", "1")
