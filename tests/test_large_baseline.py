"""The functions of benchmarks/large.c make the steps of the package."""

import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import dvi_jax as dvi

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import _large_cases as cases
import large
from _baseline import NoCompilerError, find_compiler

try:
    find_compiler()
except NoCompilerError as error:
    pytest.skip(str(error), allow_module_level=True)

PICARD = {"method": dvi.GaussLegendre(2), "root_finder": dvi.Picard()}
SMALL = {
    "fput": lambda: cases.fput(7),
    "toda": lambda: cases.toda(7),
    "sine-Gordon": lambda: cases.field(7),
    "phi4, 2D": lambda: cases.lattice(5, 2),
    "phi4, 3D": lambda: cases.lattice(4, 3),
    "bodies": lambda: cases.n_body(5),
    "half of the pairs": lambda: cases.n_body(5, "n_body_half"),
    "nls": lambda: cases.nls(7),
    "Gauss": lambda: cases.fput(7, "fput_gauss", 6, **PICARD),
    "nls, tested": lambda: cases.nls(7, "nls_tested", 5),
    "Gauss, tested": lambda: cases.fput(7, "fput_gauss_tested", 18, **PICARD),
    "band": lambda: cases.newton(7),
}


@pytest.fixture(scope="module")
def bench():
    return large.Bench(large.Clock(3, 0.1))


def states(case):
    one = case.final(10, layout=dvi.Layout(form="arrays"))
    return [np.asarray(x) for x in jax.jit(one)(*case.start())[:2]]


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_states_agree(bench, name):
    case = SMALL[name]()
    iterations, worst = large.iterations_needed(bench, case, states(case))
    assert worst < large.AGREEMENT
    assert (iterations > 0) == case.is_iterated


def test_the_chain_agrees_and_another_coupling_is_found(bench):
    case = SMALL["fput"]()
    found = states(case)
    assert large.iterations_needed(bench, case, found)[1] < 1e-14
    with pytest.raises(ValueError, match="differ"):
        large.iterations_needed(bench, case._replace(constants=(0.0, 0.5001)), found)


def test_each_row_has_a_name_of_its_own():
    names = [row.name for row in large.table()]
    assert len(set(names)) == len(names) > 50
