"""Batches on several threads have the same numbers; the import changes no flag of XLA."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
import lanewise
from lanewise.native.structures import STRUCTURES, offset

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


@pytest.mark.skipif(shutil.which("cc") is None, reason="requires a C compiler")
def test_structures_are_those_of_the_header_of_xla(tmp_path):
    xla = [name for name in STRUCTURES if name != "Job"]
    fields = {name: STRUCTURES[name].replace("+", " ").split() for name in xla}
    lines = [
        f'printf("%zu ", offsetof(XLA_FFI_{name}, {field}));'
        for name in xla
        for field in fields[name]
    ]
    source = tmp_path / "offsets.c"
    headers = "#include <stdbool.h>\n#include <stdio.h>\n#include <xla/ffi/api/c_api.h>\n"
    source.write_text(headers + "int main(void) {" + "\n".join(lines) + "}")
    program = str(tmp_path / "offsets")
    subprocess.run(["cc", "-I", jax.ffi.include_dir(), str(source), "-o", program], check=True)
    printed = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    assert [int(x) for x in printed.split()] == [
        offset(name, field) for name in xla for field in fields[name]
    ]


FORKS = """
import multiprocessing, os, select
from concurrent.futures import ProcessPoolExecutor
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import dvi_jax as dvi

SYSTEM = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2)
HOW = {"h": 0.1, "num_steps": 3}
TIMES = np.arange(64.0)
CALLS = {
    "integrate": lambda: dvi.integrate(SYSTEM, [1.0], [0.0], **HOW).status,
    "sweep": lambda: dvi.sweep(SYSTEM, [1.0], [0.0], epsilon=[0.1], **HOW, progress=False,
                               save=dvi.Save(final=True)).status,
    "search": lambda: dvi.discover_invariants(SYSTEM, dvi.Polynomials(2), order=0, h=0.1,
                                              samples=None),
    "drift": lambda: dvi.drift_order(SYSTEM, lambda q, p: p @ p, [1.0], [0.0], **HOW,
                                     epsilons=[0.1]),
    # without a system
    "signal": lambda: dvi.frequencies(TIMES, np.sin(TIMES)),
    "field": dvi.systems.boozer.precise_qa,
    "rates": lambda: dvi.from_lagrangian(lambda t0, q0, t1, q1: q1 @ q1),
    "object": lambda: str(dvi.Save(every=2).every),
}

def outcome(name):
    try:
        return CALLS[name]()
    except RuntimeError as error:
        return "refused: " + str("get_context('spawn')" in str(error))

def in_a_fork(name):
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(writer, outcome(name).encode())
        os._exit(0)
    answers, _, _ = select.select([reader], [], [], 20)
    os.kill(child, 9)  # one that waits must not outlive the test
    os.waitpid(child, 0)
    return os.read(reader, 100).decode() if answers else "waits"

if __name__ == "__main__":
    print(in_a_fork("integrate"))  # JAX has not started: right there
    print(outcome("integrate"))
    print(in_a_fork("integrate"))
    fork = multiprocessing.get_context("fork")
    with fork.Pool(1) as pool:
        print(pool.map_async(outcome, ["sweep"]).get(20)[0])
        print(pool.map_async(in_a_fork, ["drift"]).get(20)[0])  # the child of a child
    with ProcessPoolExecutor(1, mp_context=fork) as pool:
        print(pool.submit(outcome, "search").result(20))
    for name in ("signal", "field", "rates", "object"):
        print(in_a_fork(name))
"""


def test_a_fork_after_jax_has_started_is_refused_instead_of_waiting(tmp_path):
    (tmp_path / "forks.py").write_text(FORKS)
    out = subprocess.run(
        [sys.executable, "-W", "ignore", "forks.py"], cwd=tmp_path, capture_output=True, text=True,
        check=False, timeout=200, env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
    )  # fmt: skip
    assert out.returncode == 0, out.stderr[-2000:]
    assert out.stdout.split("\n")[:-1] == ["successful"] * 2 + ["refused: True"] * 7 + ["2"]
