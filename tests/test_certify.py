"""Every method under every check, the methods that are broken on purpose, and the command."""

import functools
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import problem
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

import dvi_jax as dvi
from dvi_jax.testing import (
    CHECKS,
    CONTROLS,
    METHODS,
    QUICK,
    Candidate,
    Control,
    Measured,
    altered,
    certificate as certificate_module,
    certify,
    page_for,
    problems,
)
from dvi_jax.testing.page import GROUPS, TITLE
from dvi_jax_cli import app

PAGE = Path(__file__).parent.parent / "docs" / "certificate.md"


@functools.cache
def candidate(name):
    return Candidate(METHODS[name])


IN_EVERY_RUN = {
    *(("KahanLi8", check) for check in ("order", "forced-order", "reversal")),
    ("GaussLegendre2", "forced-order"),
    ("RungeKutta4", "order"),
    *(("Yoshida4", check) for check in ("energy", "momentum")),
    *(("TypeII", check) for check in CHECKS if check not in ("gradient", "modes", "jit")),
}


OF_THE_CLASS = {"gradient", "modes", *GROUPS["Programs"]}
"""Checks of code that all methods of a class share: here on the first of each, which saves half of
the time; `dvi-jax certify` makes them on all."""

FIRST = {type(METHODS[m]): m for m in reversed(METHODS)}


@pytest.mark.parametrize(
    ("method", "check"),
    [
        pytest.param(m, c, marks=[] if (m, c) in IN_EVERY_RUN else [pytest.mark.slow])
        for m in METHODS
        for c in CHECKS
        if c not in OF_THE_CLASS or FIRST[type(METHODS[m])] == m
    ],
)
def test_method_keeps_what_it_promises(method, check):
    measured = CHECKS[check](candidate(method))
    assert measured.ok, measured


SLOW_CHECKS = ("forced-order", "gradient", "modes", "vmap", "jit")
FIRST_CONTROL = {c.check: c for c in reversed(CONTROLS)}


def is_quick(control):
    """Whether the control takes a second, and is the first of its check."""
    return control.check not in SLOW_CHECKS and control is FIRST_CONTROL[control.check]


@pytest.mark.parametrize(
    "control",
    [pytest.param(c, marks=[] if is_quick(c) else [pytest.mark.slow]) for c in CONTROLS],
    ids=lambda c: f"{c.check}-{c.name}".replace(" ", "-"),
)
def test_broken_method_is_caught_by_a_number(control):
    """Not by an exception: its verdict is FAIL, with something measured."""
    measured = CHECKS[control.check](Candidate(control.method))
    assert measured.claimed
    assert measured.verdict == "FAIL", measured


def test_checks_controls_and_the_page_are_complete():
    assert {c.check for c in CONTROLS} == set(CHECKS)
    assert [name for group in GROUPS.values() for name in group] == list(CHECKS)
    assert set(QUICK) <= set(METHODS)
    # If not, run `dvi-jax certify --out docs/certificate.md`.
    page = PAGE.read_text(encoding="utf-8")
    head, *sections = re.split(r"^## ", page, flags=re.MULTILINE)
    assert head.startswith(TITLE)
    assert f"methods: {len(METHODS)} of {len(METHODS)}" in head
    assert f"controls: {len(CONTROLS)} of {len(CONTROLS)} caught" in head
    by_title = {section.partition("\n")[0]: section for section in sections}
    assert "Failures" not in by_title
    for title, checks in GROUPS.items():
        columns, _, *rows = [
            [cell.strip() for cell in line.strip("|").split("|")]
            for line in by_title[title].splitlines()
            if line.startswith("|")
        ]
        assert [c for c in columns if c in CHECKS] == list(checks)
        assert [row[0] for row in rows] == list(METHODS)
        for row in rows:
            for name, cell in zip(columns, row, strict=True):
                assert name not in CHECKS or cell.startswith(("pass", "not claimed")), row
    assert by_title["Controls"].count("| caught |") == len(CONTROLS)


@pytest.mark.slow
def test_order_of_the_force_alone_can_be_wrong():
    """The control of the forced order passes without the force: that check sees what this does."""
    (control,) = (c for c in CONTROLS if c.check == "forced-order")
    assert CHECKS["order"](Candidate(control.method)).passed


@pytest.mark.parametrize("epsilon", [0.0, problems.STRENGTH])
@pytest.mark.parametrize(
    "problem",
    [
        problems.COUPLED,
        pytest.param(problem("double_pendulum", h=0.05), marks=pytest.mark.slow),
    ],
)
def test_reference_agrees_with_scipy(problem, epsilon):
    system, args = problem.system, problem.args
    gradient = jax.jit(jax.grad(system.H_D, argnums=(2, 3)))

    def field(t, z):
        q, p = np.split(z, 2)
        dq, dp = gradient(t, t, q, p, args)
        return np.concatenate([dp, -dq + epsilon * system.force(t, t, q, p, args)])

    start = np.concatenate([problem.q0, problem.p0])
    end = problems.SPAN * problem.h
    by_scipy = solve_ivp(field, (0, end), start, "DOP853", rtol=1e-13, atol=1e-14)
    ours, doubt = problems.reference(problem, epsilon)
    assert doubt < 1e-13
    np.testing.assert_allclose(ours.ravel(), by_scipy.y[:, -1], rtol=0, atol=2e-12)


def _nan(method, equations, interval, q, p):
    q, p, info = method.step(equations, interval, q, p)
    return q * jnp.nan, p, info


NAN = altered(dvi.TypeII(), _nan, is_symmetric=True)
FAST = ("order", "forced-order", "reversal", "adjoint", "energy", "momentum")


@pytest.fixture(scope="module")
def nan_candidate():
    return Candidate(NAN)


@pytest.mark.parametrize(
    "check",
    [pytest.param(c, marks=[] if c in FAST else [pytest.mark.slow]) for c in CHECKS],
)
def test_nan_never_passes(check, nan_candidate):
    measured = CHECKS[check](nan_candidate)
    if check == "traces":  # no number of the state enters
        assert measured.passed
    else:
        assert measured.verdict == "NOT MEASURED"
        assert not measured.ok


def test_measurements_that_fail_or_are_not_promised():
    """The Gauss method of order 16 is there after a few steps."""
    accurate = Candidate(dvi.GaussLegendre(8))
    accurate.__dict__["flow"] = problems.most_accurate(problems.COUPLED)
    measured = CHECKS["order"](accurate)
    assert measured.verdict == "NOT MEASURED"
    assert re.search(r"^\d points above round-off, at least 6 needed", measured.detail)
    measured = CHECKS["reversal"](Candidate(altered(dvi.Strang(), _broken)))
    assert (measured.verdict, measured.detail) == ("NOT MEASURED", "RuntimeError: no luck")
    measured, adjoint = (CHECKS[c](candidate("RungeKutta4")) for c in ("reversal", "adjoint"))
    assert measured.verdict == adjoint.verdict == "not claimed"
    assert 1e-9 < measured.value < 1e-4
    assert (measured.ok, measured.passed) == (True, False)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_passed_value_is_a_number(value):
    with pytest.raises(ValueError, match="passed must be False"):
        Measured(value, "≤ 1", True)


def _broken(method, equations, interval, q, p):
    raise RuntimeError("no luck\nat all")


LIAR = altered(dvi.TypeII(), is_symmetric=True)


def test_certify_methods_of_ones_own():
    mine, seen = dvi.Composition((0.2, 0.3, 0.3, 0.2), order=2), []
    methods = {"mine": mine, "liar": LIAR, "honest": dvi.TypeII()}
    found = certify(methods, ["reversal"], lambda done, total: seen.append((done, total)))
    assert seen == [(k, 4) for k in range(1, 5)]
    assert found.rows["mine"]["reversal"].value <= 1e-12
    assert not found.ok
    ((method, check, measured),) = found.failures
    assert (method, check) == ("liar", "reversal")
    assert measured.value > 1e-3
    methods, controls = found.summary.splitlines()
    assert methods.startswith("methods: 2 of 3")
    assert controls == "controls: 1 of 1 caught"
    page = str(found)
    assert page.startswith(TITLE)
    for said in ("| mine | pass ", "| liar | FAIL", "| honest | not claimed (", "## Failures"):
        assert said in page
    assert "TypeII declared to be symmetric" in page
    assert "symplecticity" not in page.split("## Your own method")[0].split("## What")[0]


def test_a_control_that_passes_is_missed(monkeypatch):
    tried = (
        Control("Strang as it is", "reversal", dvi.Strang()),
        Control("one that raises", "reversal", altered(dvi.TypeII(), _broken, is_symmetric=True)),
    )
    monkeypatch.setattr(certificate_module, "CONTROLS", tried)
    found = certify(["RungeKutta4"], ["reversal"])
    assert (found.ok, found.failures) == (False, [])
    assert [c.name for c in found.missed] == ["Strang as it is", "one that raises"]
    assert "controls: 0 of 2 caught" in found.summary
    assert str(found).count("| MISSED |") == 2


@pytest.mark.parametrize(
    ("methods", "checks", "error", "said"),
    [
        (["yoshida4"], None, ValueError, r"got 'yoshida4' \(did you mean Yoshida4\?\)"),
        (None, ["symmetry"], ValueError, "some of order, forced.*got 'symmetry'"),
        ([], None, ValueError, "methods is empty: give"),
        ({}, None, ValueError, "methods is empty: give"),
        (None, [], ValueError, "checks is empty: give"),
        ("TypeII", None, TypeError, "must be a list of names"),
        (dvi.TypeII(), None, TypeError, "methods must be a dict"),
        ({"mine": dvi.TypeII}, None, TypeError, r"'mine'\] must be a method such as"),
        ({"m": altered(dvi.TypeII(), order="2")}, None, TypeError, "order must be an int or"),
        ({"m": altered(dvi.TypeII(), order=0)}, None, ValueError, "order must be a positive"),
    ],
)
def test_bad_input(methods, checks, error, said):
    with pytest.raises(error, match=said):
        certify(methods, checks)


def test_single_precision_is_refused():
    with jax.enable_x64(False), pytest.raises(ValueError, match="x64 is off"):
        certify(["TypeII"], ["reversal"])


def command(*words):
    return CliRunner().invoke(app, ["certify", *map(str, words)], env={"COLUMNS": "150"})


@pytest.mark.slow
def test_the_page_is_written_and_its_example_runs(tmp_path):
    page = tmp_path / "sub" / "page.md"
    result = command("--method", "RungeKutta4", "--check", "reversal", "--out", page)
    assert result.exit_code == 0, result.output
    for said in ("not claimed", "caught", "controls: 1 of 1 caught", f"written to {page}"):
        assert said in result.output.replace("\n", " ")
    assert page.read_text(encoding="utf-8").startswith(TITLE)
    assert page_for(page) == page  # a certificate may be replaced by a newer one
    assert page_for(tmp_path) == page_for(tmp_path / "new").parent.parent / "certificate.md"
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    scope = {}
    exec(code, scope)
    assert scope["certificate"].ok


@pytest.mark.slow
def test_commands(monkeypatch):
    monkeypatch.setitem(METHODS, "Liar", LIAR)
    result = command("--method", "Liar", "--check", "reversal")
    assert result.exit_code == 1
    assert "Liar, reversal: FAIL, allowed ≤ 1e-12" in result.output
    assert "methods: 0 of 1" in result.output
    result = command("--quick", "--check", "order")
    assert result.exit_code == 0, result.output
    assert "methods: 5 of 5" in result.output
    assert "controls: 3 of 3 caught" in result.output


def test_command_refuses_bad_input(tmp_path):
    other = tmp_path / "README.md"
    other.write_text("# My notes\n", encoding="utf-8")
    (tmp_path / "file").write_text("", encoding="utf-8")
    for words, said in [
        (("--method", "strang"), "did you mean Strang"),
        (("--check", "energies"), "did you mean energy"),
        (("--quick", "--method", "Strang"), "--quick: it is given together with --method"),
        (("--out", other), "exists and is not a certificate"),
        (("--out", tmp_path / "file"), "neither a directory nor a .md file"),
    ]:
        result = command(*words)
        assert result.exit_code == 2, words
        assert said in result.output.replace("\n", " ")
    assert other.read_text(encoding="utf-8") == "# My notes\n"
