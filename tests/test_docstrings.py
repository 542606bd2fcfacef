"""The examples in docstrings run, and print the output that is shown below them."""

import ast
import contextlib
import inspect
import io
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import _namespaces, systems

BLOCK = re.compile(r"^```python\n(.*?)^```", re.S | re.M)

EXAMPLES = {
    name: BLOCK.findall(inspect.getdoc(getattr(dvi, name)) or "")
    for name in _namespaces.names()
    if inspect.isclass(getattr(dvi, name)) or inspect.isfunction(getattr(dvi, name))
}
EXAMPLES = {name: blocks for name, blocks in EXAMPLES.items() if blocks}


def wanted(code):
    """What an example says that it prints: its comments that are lines of their own."""
    return "\n".join(line[2:] for line in code.splitlines() if line.startswith("# "))


def agrees(printed, expected):
    """… stands for anything."""
    return re.fullmatch(".*".join(map(re.escape, expected.split("…"))), printed, re.S) is not None


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_it_runs_and_prints_what_it_says(name):
    for code in EXAMPLES[name]:
        assert any(isinstance(x, ast.Call) for x in ast.walk(ast.parse(code)))
        assert wanted(code), "an example ends with what it prints, as a comment below"
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(code, {"jax": jax, "jnp": jnp, "np": np, "dvi": dvi, "systems": systems})
        assert agrees(out.getvalue().rstrip("\n"), wanted(code)), out.getvalue()


def test_what_people_call_first_has_an_example():
    first = {
        "System", "discretise", "integrate", "Save", "MaxDrift", "Section", "Stop", "MEGNO",
        "find_symmetries", "discover_invariants", "drift_order", "noether_balance", "sweep", "fit",
        "poincare_section", "frequencies", "over_threads",
    }  # fmt: skip
    assert first <= set(EXAMPLES)


def test_a_wrong_number_is_seen():
    assert wanted("print(1)\n# 1 and more\nprint(2)  # no line of its own\n# 2") == "1 and more\n2"
    assert agrees("1 and more\n2", "1 …\n2")
    assert not agrees("1 and more\n3", "1 …\n2")
    assert not agrees("", "1")
