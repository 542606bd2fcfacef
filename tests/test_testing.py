"""The checks as functions for user-defined tests: what they raise, return and accept."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import problem
from test_docs import examples

import dvi_jax as dvi
from dvi_jax import testing
from dvi_jax.testing import METHODS, altered, check_method, check_order, check_reversible

EXTENDING = Path(__file__).parents[1] / "docs" / "extending.md"


def test_every_check_is_a_function_with_a_remedy():
    functions = [f for name, f in vars(testing).items() if name.startswith("check_")]
    functions.remove(check_method)
    checks = testing.CHECKS.values()
    assert {" ".join(f.__doc__.split()) for f in functions} == {check.says for check in checks}
    assert all(check.remedy.endswith(".") for check in checks)


def test_a_failure_says_what_was_measured_what_is_required_and_what_to_do():
    method = altered(dvi.TypeII(), is_symmetric=True)
    said = r"reversal: measured 0\.0.*required ≤ 1e-12.*What is measured: .*What to do: Make"
    with pytest.raises(AssertionError, match=f"(?s){said}"):
        check_reversible(method)
    with pytest.raises(AssertionError, match=r"reversal: measured"):
        check_method(method, ["reversal"])
    results = check_method(METHODS["TypeII"], ["reversal", "symplecticity"])
    assert [result.verdict for result in results.values()] == ["not claimed", "pass"]


def test_another_problem_takes_the_place_of_the_own_one():
    assert check_reversible(dvi.Strang(), problem("kepler")).passed
    values = [check_reversible(dvi.TypeII(), made).value for made in (None, problem("kepler"))]
    assert values[0] != values[1]


def test_an_order_is_measured_on_its_own_problem():
    with pytest.raises(AssertionError, match=r"order: measured 1(\.\d*)?, required 2 ± 0.2"):
        check_order(altered(dvi.TypeII(), order=2))
    with pytest.raises(ValueError, match="order is measured on a fixed problem"):
        check_order(dvi.TypeII(), problem("double_pendulum"))


def test_an_identity_is_not_taken_for_a_step_with_an_inverse():
    def stay(method, equations, interval, q, p):
        return q, p, method.step(equations, interval, q, p)[2]

    with pytest.raises(AssertionError, match="moved the state by 0 only"):
        testing.check_inverse(altered(dvi.Strang(), stay, stay))


def test_unknown_checks_are_refused():
    for checks, error in ((["symmetry"], ValueError), ("order", TypeError)):
        with pytest.raises(error, match="check"):
            check_method(dvi.Strang(), checks)


def test_symplectic_defect():
    assert testing.symplectic_defect(np.eye(4)) == 0
    assert testing.symplectic_defect(np.diag([2.0, 1.0])) == 1


@pytest.mark.slow
def test_the_documented_test_file_passes(tmp_path):
    """The code of the page as a test file: a test for each check, and one of its own."""
    path = tmp_path / "test_mine.py"
    path.write_text(examples(EXTENDING)[0], encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", str(path)]
    out = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=tmp_path, timeout=500
    )
    assert out.returncode == 0, out.stdout[-3000:]
    assert f"{len(testing.CHECKS) + 1} passed" in out.stdout
