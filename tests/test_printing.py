"""What `print` shows of problems and results: at most eight lines that say something."""

import inspect
import re
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import interop, rings, systems, testing
from dvi_jax.base.printing import first_lines, printable
from dvi_jax.systems import boozer


@pytest.mark.parametrize("name", systems.LIBRARY)
def test_a_problem_prints_what_one_gives_to_integrate(name):
    problem = systems.LIBRARY[name]()
    lines = repr(problem).splitlines()
    assert len(lines) <= 8
    assert problem.name in lines[0]
    assert f"h = {problem.h:.4g}"[:8] in lines[1]
    assert all(observable in repr(problem) for observable in problem.observables)


@pytest.mark.slow
def test_results_print_their_statuses_and_small_arrays():
    ts = np.arange(4096) * 0.05
    signals = jnp.array([np.cos(ts), np.full_like(ts, np.nan)])
    lines = dvi.frequencies(ts, signals, count=1, throw=False)
    text = repr(lines)
    assert text.splitlines()[0] == "Frequencies: 1 not_finite, 1 successful"
    assert "frequencies = [[ 1.], [nan]]" in text
    spring = systems.oscillator()
    section = dvi.poincare_section(
        spring.system,
        np.asarray(spring.q0)[None],
        np.asarray(spring.p0)[None],
        args=spring.args,
        g=lambda t, q, p, args: q[0],
        h=0.1,
        num_steps=400,
        crossings=20,
        throw=False,
    )
    assert len(repr(section).splitlines()) <= 8
    assert "''" not in repr(section)
    assert repr(section).startswith("PoincareSection: 1 ")


PACKAGES: list[ModuleType] = [dvi, systems, rings, boozer, testing, interop]
NUMBERS = re.compile(r"Array|ndarray|Float\[|State\b|dict\[|list\[")


def test_every_public_class_with_arrays_has_a_short_form():
    """The automatic form of a dataclass, a named tuple or a module shows every number."""
    public = [getattr(package, name) for package in PACKAGES for name in dir(package)]
    classes = {x for x in public if inspect.isclass(x) and x.__module__.startswith("dvi_jax")}
    assert len(classes) > 100
    long = []
    for kind in classes:
        annotations = [inspect.get_annotations(base) for base in kind.__mro__]
        hints = [str(hint) for hints in annotations for hint in hints.values()]
        # One that is written for the class, by hand or by the decorator.
        code = getattr(kind.__repr__, "__code__", None)
        is_own = code is not None and "dvi_jax" in code.co_filename
        if not is_own and sum(bool(NUMBERS.search(hint)) for hint in hints) > 2:
            long.append(f"{kind.__module__}.{kind.__name__}")
    assert ", ".join(sorted(long)) == ""


CELL = [rings.quadrupole("QF", 0.5, k1=0.6), rings.drift("<D>", 2.0)]
OBJECTS = {
    "ring": lambda: rings.Ring(CELL * 40),
    "element": lambda: CELL[0],
    "observations": lambda: dvi.Observations(np.arange(900.0), np.ones((900, 2)), "positions"),
    "model": lambda: dvi.Model(systems.kepler().system, h=0.1, q0=np.ones(2), p0=np.ones(2)),
    "tracked": lambda: rings.Tracked(*(np.ones(s) for s in ((50, 6), 50, 50, (50, 6), 50))),
    "optics": lambda: rings.Optics(*(jnp.ones((30, 6)) for _ in range(12))),
    "shell": lambda: dvi.starts.EnergyShell(9, lambda q, p: q @ q, 1.0, -np.ones(4), np.ones(4)),
    "map": lambda: rings.FrequencyMap(*(jnp.ones((9, 9, 2)) for _ in range(3))),
}


@pytest.mark.parametrize("name", OBJECTS)
def test_objects_print_in_eight_lines_and_as_a_table(name):
    thing = OBJECTS[name]()
    lines = repr(thing).splitlines()
    assert 2 <= len(lines) <= 8
    assert all(len(line) <= 140 for line in lines)
    assert type(thing).__name__ in lines[0]
    assert str(thing) == repr(thing)
    html = thing._repr_html_()
    assert html.count("<tr>") == html.count("</tr>")
    assert html.startswith(("<table>", "<pre>"))
    assert "<D>" not in html
    assert name != "ring" or "&lt;D&gt;" in html


@pytest.mark.parametrize("kind", [dvi.MaxDrift, dvi.Mean, dvi.Section, dvi.Stop])
def test_what_records_an_observable_of_the_library_prints_its_name(kind):
    energy = systems.magnetic_mirror().observables["energy"]
    assert repr(energy) == "<energy of the state>"
    assert repr(kind(energy)).startswith(f"{kind.__name__}(")
    assert "<energy of the state>" in repr(kind(energy))
    assert len(repr(kind(energy)).splitlines()) <= 8


def test_a_long_report_is_cut_and_small_numbers_are_shown():
    @printable
    class Report(NamedTuple):
        lines: int

        def __str__(self) -> str:
            return "\n".join(f"<line> {i}" for i in range(self.lines))

    assert repr(Report(8)) == str(Report(8))
    assert repr(Report(20)).splitlines()[-1] == "… and 13 more lines: print shows them"
    assert len(repr(Report(20)).splitlines()) == 8
    assert Report(20)._repr_html_().count("&lt;line&gt;") == 20
    assert len(first_lines("x" * 10_000)) < 600

    @printable
    class Numbers(NamedTuple):
        x: Any
        y: Any

    text = repr(Numbers(jnp.array([1.5, 2.0]), np.zeros((3, 4))))
    assert "x = [1.5, 2. ]" in text
    assert "y = float64 of shape (3, 4)" in text

    def traced(x):
        assert "f64[3]" in repr(Numbers(x, 1.0))
        return x

    jax.jit(traced)(jnp.ones(3))
