"""The instructions that the roofline counts are those of programs that were counted by hand."""

import importlib
import json
import platform
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"
pytest.importorskip("matplotlib")
pytestmark = pytest.mark.skipif(
    (sys.platform, platform.machine()) != ("linux", "x86_64"),
    reason="the code with probes requires Linux and x86-64",
)


@pytest.fixture
def instructions(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module("_instructions")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("vfmadd231pd %zmm1, %zmm2, %zmm3", ("fma", "vector", 8, 0, 0, {"1", "2", "3"}, "3")),
        ("vfnmadd132sd 8(%rax), %xmm2, %xmm3", ("fma", "single", 1, 8, 0, {"2", "3"}, "3")),
        ("vmulpd 8(%rax){1to8}, %zmm2, %zmm3", ("mul", "vector", 8, 8, 0, {"2"}, "3")),
        ("vsubpd %ymm1, %ymm2, %ymm3", ("add", "vector", 4, 0, 0, {"1", "2"}, "3")),
        ("vaddpd %zmm1, %zmm2, %zmm3{%k1}", ("add", "vector", 8, 0, 0, {"1", "2", "3", "k1"}, "3")),
        ("vaddpd %zmm1, %zmm2, %zmm3{%k1}{z}", ("add", "vector", 8, 0, 0, {"1", "2", "k1"}, "3")),
        ("vdivpd 64(%rsp), %zmm2, %zmm3", ("div", "vector", 8, 64, 0, {"64(%rsp)", "2"}, "3")),
        ("vsqrtsd %xmm1, %xmm2, %xmm3", ("sqrt", "single", 1, 0, 0, {"1", "2"}, "3")),
        ("vcmpunordpd %zmm1, %zmm2, %k1", ("max", "vector", 8, 0, 0, {"1", "2"}, "k1")),
        ("vmovupd %zmm1, 64(%rsp)", ("none", "vector", 8, 0, 64, {"1"}, "64(%rsp)")),
        ("vmovntpd %zmm1, (%rax,%rcx)", ("none", "vector", 8, 0, 64, {"1"}, "")),
        ("vbroadcastsd 8(%rax), %zmm1", ("none", "vector", 8, 8, 0, set(), "1")),
        ("vxorpd %xmm1, %xmm1, %xmm1", ("none", "single", 2, 0, 0, set(), "1")),
        ("vpternlogq $4, %zmm1, %zmm2, %zmm3", ("other", "vector", 8, 0, 0, {"1", "2"}, "3")),
        ("call _ZGVeN8v_sin@PLT", ("sin", "vector", 8, 0, 0, {"0"}, "0")),
    ],
)
def test_an_instruction_is_read(instructions, text, expected):
    *values, sources, target = instructions.parsed(text)
    assert (*values, {s for s in sources if s}, target) == expected


def test_instructions_without_such_numbers_are_left_out(instructions):
    for text in ("addq $8, %rax", "jne .L3", "callq malloc", "vzeroupper", "ret"):
        assert instructions.parsed(text) is None


def test_the_chain_is_that_of_dependent_instructions(instructions):
    probes, latency = instructions.Probes(), {"vector fma": 2.0, "vector memory": 5.0}
    fma = "vfmadd231pd %zmm31, %zmm30, %zmm{}\n"

    def chain(text, rounds=1):
        number = len(probes.blocks)
        probes.into(text)
        return probes.chain([number] * rounds, latency)

    dependent, independent = fma.format(1) * 3, "".join(map(fma.format, range(3)))
    assert chain(dependent) == 6.0
    assert chain(independent) == 2.0
    assert chain(independent, 4) == 8.0  # of each register one after the other
    through_memory = "vmovupd %zmm1, 64(%rsp)\nvmovupd 64(%rsp), %zmm1\n"
    assert chain(fma.format(1) + through_memory, 2) == 14.0
    # All wait for the one that is WINDOW earlier, though they do not read its result.
    begins = "vxorpd %zmm1, %zmm1, %zmm1\n" + fma.format(1)
    assert chain(begins, instructions.WINDOW // 2) == 2.0
    assert chain(begins, instructions.WINDOW) == 4.0


CHILD = """
    import functools, json, sys
    import jax, jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    sys.path.insert(0, sys.argv[1])
    import roofline, speed
    from _workloads import WORKLOADS, linear_force

    import dvi_jax as dvi

    def larger(t0, t1, q0, p1, args):
        return jnp.sum(p1**2 + q0**2) / 2 + 0.25 * jnp.sum(q0)

    system = dvi.System(larger, force=linear_force)
    WORKLOADS["larger"] = WORKLOADS["oscillator"]._replace(system=system)
    rows = [
        speed.Row(name, None, functools.partial(speed.batch_row, name=name, lanes=64, steps=1))
        for name in ("oscillator", "larger", "kepler", "product")
    ]
    command = roofline.command_of(roofline.Baseline())
    print(json.dumps(roofline.count_rows(rows, {"vector fma": 1.0}, command)))
"""


@pytest.mark.slow
def test_the_operations_of_a_step_are_those_counted_by_hand(instructions, monkeypatch):
    """Steps of the package and of C, and a program with one operation more."""
    monkeypatch.setenv("DVI_JAX_CACHE", "off")
    try:
        instructions.find_compiler()
    except Exception as error:
        pytest.skip(str(error))
    command = [sys.executable, "-c", textwrap.dedent(CHILD), str(FOLDER)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    units = "fma", "mul", "add", "div", "sqrt"

    def operations(name, side):
        return [round(found[name][side].get(unit, 0), 1) for unit in units]

    # p1 = p0 + h (−q0 + ε W), q1 = q0 + h p1. C adds h and ε h before the loop.
    assert operations("oscillator", 0) == [3, 0, 0, 0, 0]
    assert operations("oscillator", 1) == [2, 0, 0, 0, 0]
    assert sum(operations("larger", 0)) == 4
    # C: r² (mul, fma), root, r² r (mul), h/r³ (div) + ε h (add), p and q (fma).
    assert operations("kepler", 1) == [5, 2, 1, 1, 1]
    # The package: r², root, 1/r, (1/r)² (mul), its product with m² and with 1/(2 r) (three mul),
    # 2 q (two add), ε W (two mul), the force (two fma), and p and q.
    assert operations("kepler", 0) == [7, 7, 2, 1, 1]
    # C divides once in each of two iterations; the package uses one Jacobian for all corrections.
    assert [operations("product", side)[3] for side in (0, 1)] == [1, 2]
    assert found["oscillator"][0]["chain"] > 0
