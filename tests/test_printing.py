"""What `print` shows of problems and results: at most eight lines that say something."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import systems


@pytest.mark.parametrize("name", systems.LIBRARY)
def test_a_problem_prints_what_one_gives_to_integrate(name):
    problem = systems.LIBRARY[name]()
    lines = repr(problem).splitlines()
    assert len(lines) <= 8
    assert problem.name in lines[0]
    assert f"h = {problem.h:.4g}"[:8] in lines[1]
    assert all(observable in repr(problem) for observable in problem.observables)


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
