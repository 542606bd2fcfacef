"""Batches on several threads have the same numbers; the import changes no flag of XLA."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
import lanewise

STEPS = 5


def one(q, p, k=1.0):
    system = dvi.System(lambda t0, t1, q, p, k: p @ p / 2 + k * jnp.sum(q**4) / 4)
    sol = dvi.integrate(system, q, p, h=0.1, num_steps=STEPS, args=k, throw=False)
    return {"qs": sol.qs, "result": sol.result}


def starts(lanes, axis=0):
    rng = np.random.default_rng(0)
    return (np.moveaxis(rng.normal(size=(lanes, 2)), 0, axis) for _ in range(2))


@pytest.fixture
def set_threads():
    count = lanewise.get_threads()
    yield lanewise.set_threads
    lanewise.set_threads(count)


@pytest.mark.parametrize(("lanes", "threads"), [(8, 2), (700, 3), (2, 5), (500, 2)])
def test_threads_change_no_number(set_threads, lanes, threads):
    q, p = starts(lanes)
    q[-1, 0] = np.nan
    batch = jax.jit(jax.vmap(one))
    set_threads(1)
    expected = jax.tree.map(np.asarray, batch(q, p))
    set_threads(threads)
    jax.tree.map(np.testing.assert_array_equal, batch(q, p), expected)
    failed = np.asarray(expected["result"] != dvi.RESULTS.successful)
    assert failed.tolist() == [False] * (lanes - 1) + [True]


IMPORT = """
import os, sys, dvi_jax, lanewise
print(os.environ.get("XLA_FLAGS"), "llvmlite" in sys.modules)
lanewise.set_threads(1)
print("llvmlite" in sys.modules)
"""


def test_importing_changes_no_flag_and_does_not_import_llvmlite():
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    command = [sys.executable, "-c", IMPORT]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["None", "False", "True"]
