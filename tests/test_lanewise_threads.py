"""Code for NVIDIA GPUs, run on the CPU: the bits of the CPU's machine code, and XLA's part."""

import ctypes
import dataclasses
import functools
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import ptx_on_cpu
import pytest
import test_lanewise_programs as programs
from jax import export, lax

import dvi_jax as dvi
import lanewise
from dvi_jax.systems.boozer import _sums
from lanewise import primitive
from lanewise.evaluator import RULES
from lanewise.jaxprs import jaxapi
from lanewise.jaxprs.extent import primitives_in
from lanewise.llvm import ptx
from lanewise.llvm.ir import NotCompilable
from lanewise.native import cuda, machine
from lanewise.rules import exact
from lanewise.targets import TARGETS, threads
from lanewise.targets.numbers import Numbers
from lanewise.targets.threads import Threads, ptx_of

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import _gpu_programs

ENTRY = """
define void @run(ptr %args, ptr %rets, ptr %params, ptr %scratch, i64 %blocks) {
  call void @lanewise_kernel(ptr %args, ptr %rets, ptr %params, ptr %scratch, i64 0, i64 %blocks)
  ret void
}
"""
_engines: list[Any] = []  # their machine code is called


def by_numbers(function, lane_flags, operands, lanes):
    """The results of the CPU's machine code, called without XLA, whose threads flush subnormal
    numbers."""
    code = Numbers().write(function, lane_flags, lanes, None)
    llvm, (cpu, features) = machine.start_llvm(), machine.host()
    host = llvm.Target.from_default_triple().create_target_machine(
        cpu=cpu, features=features, opt=2, jit=True
    )
    engine = llvm.create_mcjit_compiler(machine.optimise(code.text + ENTRY, host), host)
    engine.finalize_object()
    _engines.append(engine)
    arrays = [np.ascontiguousarray(x) for x in operands]
    results = [np.full((lanes, *a.shape), 77).astype(a.dtype) for a in function.out_avals]
    addresses = [np.asarray([x.ctypes.data for x in xs], np.int64) for xs in (arrays, results)]
    memory = np.zeros(code.scratch + 64, np.uint8)
    aligned = (memory.ctypes.data + 63) // 64 * 64
    pointers = [x.ctypes.data for x in (*addresses, code.params(lanes, function.out_avals))]
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4, ctypes.c_int64)
    run = kind(engine.get_function_address("run"))
    run(*pointers, aligned, -(-lanes // code.block))
    return results


def by_threads(function, lane_flags, operands, lanes, threads=64):
    kernel = ptx_of(function, lane_flags, 90)
    shapes = [jax.ShapeDtypeStruct((lanes, *a.shape), a.dtype) for a in function.out_avals]
    return ptx_on_cpu.run(kernel, operands, shapes, lanes, threads)


def assert_same_bits(found, expected):
    """Equal bits; a NaN has no sign that means anything."""
    for x, y in zip(found, expected, strict=True):
        assert x.dtype == y.dtype
        if x.dtype.kind == "f":
            np.testing.assert_array_equal(np.isnan(x), np.isnan(y))
            kind = f"u{x.dtype.itemsize}"
            x, y = (np.where(np.isnan(z), 0, z).astype(z.dtype).view(kind) for z in (x, y))
        np.testing.assert_array_equal(x, y)


class Call(NamedTuple):
    """One call of lanewise in a batch, with its operands and the results on the CPU."""

    function: Any
    lane_flags: tuple[bool, ...]
    lanes: int
    operands: list[np.ndarray]
    results: list[np.ndarray]


def calls_of(function, *args) -> list[Call]:
    """The calls of lanewise in a function of a batch, as the CPU computes them."""
    calls = []

    def lower(*operands, program, lanes, lane_flags):
        outs = primitive._lower(
            *operands, platform="cpu", program=program, lanes=lanes, lane_flags=lane_flags
        )

        def record(*arrays):
            arrays = [np.array(x) for x in arrays]
            results = arrays[len(operands) :]
            inputs = program.trace.all_inputs
            calls.append(Call(inputs, lane_flags, lanes, arrays[: len(operands)], results))
            return results

        return list(jax.pure_callback(record, program.shape_of(lanes), *operands, *outs))

    jaxapi.lower_on("cpu", primitive._lanewise, lower)
    try:
        jax.block_until_ready(jax.jit(jax.vmap(function))(*args))
    finally:
        normal = functools.partial(primitive._lower, platform="cpu")
        jaxapi.lower_on("cpu", primitive._lanewise, normal)
    return calls


# --- programs -------------------------------------------------------------------------------------


PROGRAMS = {
    "kepler": (60, 1), "kepler_saved": (60, 1), "kepler_float32": (60, 1), "pendulum": (40, 1),
    "pendulum_gradient": (40, 2), "alphas": (3, 1), "bodies": (10, 1),
}  # fmt: skip
"""Name in `_gpu_programs` → steps, and the number of calls of lanewise in it."""

LANES = 37
"""Not a multiple of a block: threads after the last trajectory must do nothing."""


def batch_of(name):
    """(the function of one trajectory, *inputs of a batch)."""
    one, inputs = getattr(_gpu_programs, name)(LANES, PROGRAMS[name][0], dvi.Layout())
    return one, *map(jnp.asarray, inputs)


@functools.cache
def calls_of_program(name):
    calls = calls_of(*batch_of(name))
    assert len(calls) == PROGRAMS[name][1]
    return calls


@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_have_the_bits_of_the_cpu(name):
    for call in calls_of_program(name):
        found = by_threads(call.function, call.lane_flags, call.operands, LANES)
        assert all(np.all(np.isfinite(x)) for x in call.results if x.dtype.kind == "f")
        assert_same_bits(found, call.results)


@pytest.mark.parametrize("modes", [(1, 6, 7, 4), (2, 9, 21, 5)])
def test_a_sum_over_modes_stores_no_powers(modes):
    """Neither on a GPU nor on a CPU: the loops over modes carry them."""
    coefficients, shape = np.random.default_rng(1).normal(size=modes), _sums.Shape(5, 1)
    sums = jax.make_jaxpr(lambda *at: _sums.derivatives(coefficients, shape, *at, 2))
    function, flags = sums(0.1, 0.2, 0.3), [True] * 3
    kernel = ptx_of(function, flags, 90)
    assert kernel.local_bytes == 0
    assert Numbers().write(function, flags, 64, None).scratch == 0
    # Several arrays of constants are read in vectors.
    assert (".v2." in kernel.text) == (modes[-1] == 4)
    assert compared(function, flags, list(np.random.default_rng(2).random((3, 24))), 24) == 10
    if ".v2." in kernel.text:
        wrong = dataclasses.replace(kernel, text=kernel.text.replace(".align 16", ".align 8"))
        with pytest.raises(AssertionError, match="multiple of the bytes"):
            ptx_on_cpu.run(wrong, [np.ones(24)] * 3, [np.ones(24)] * 10, 24)


# --- every rule, and random programs --------------------------------------------------------------


def solved(x, m):
    """Linear systems of every kind, well-conditioned where x is."""
    a = m[:, :2] @ m[:, :2].T + (3 + x[0] ** 2) * jnp.eye(2)
    push, value = jax.linearize(lambda v: jnp.sin(v) + a @ v, x)[1], x + 1
    columns = jax.vmap(push, out_axes=1)(lanewise.unit_vectors(2, x.dtype))
    lower = jnp.linalg.cholesky(a)
    return (
        lanewise.solve(columns, value),
        jnp.linalg.solve(a, value),
        lax.linalg.triangular_solve(lower, m[:, :2], left_side=True, lower=True),
    )


def root_of(x):
    def solve(function, guess):
        def improve(y, _):
            return y - function(y) / (1 + jnp.cos(y) / 2), None

        return lax.scan(improve, guess, None, length=9)[0], jnp.zeros(())

    y = programs.bounded(x)
    return lanewise.implicit_root(
        lambda z: z + jnp.sin(z) / 2 - y, y, solve, lambda linear, b: b / linear(jnp.ones_like(b))
    )[0]


def rare_branch(x):
    flag = lanewise.on_any(x > 1)
    return lax.cond(flag, lambda: jnp.where(x > 1, jnp.exp(-x), x), lambda: x)


def gradient(x, y):
    return jax.grad(lambda x: jnp.sum(programs.mixed(programs.bounded(x), y) ** 2))(x)


FUNCTIONS = """
    acos acosh asin asinh atanh cbrt cosh erf erf_inv erfc exp2 logistic sinh tan
    stop_gradient optimization_barrier
""".split()  # noqa: SIM905
OTHERS = {
    **{name: ("f", getattr(lax, name)) for name in FUNCTIONS},
    "order": ("f f", lambda x, y: (lax.lt_to_p.bind(x, y), lax.le_to_p.bind(x, y))),
    "sine and cosine": ("f", lambda x: (jnp.sin(x), jnp.cos(x))),
    "exact product": ("f f", exact.exact_product),
    "bits": ("f", lambda x: lax.bitcast_convert_type(x, jnp.int64) >> 3),
    "next": ("f f", jnp.nextafter),
    "reduced": ("f", lambda x: lax.reduce_precision(x, 11, 52)),
    "sorted": ("f23", lambda x: (jnp.sort(x, 1), jnp.argsort(x[0]))),
    "parts": ("f3", lambda x: jnp.split(x, [1])),
    "random": ("i i", lambda i, j: jaxapi.threefry2x32(jnp.stack([i, j]).astype("uint32"), i, j)),
    "platform": ("f", lambda x: lax.platform_dependent(x, tpu=jnp.sin, default=jnp.cos)),
    "xor of all": ("i3", lambda i: lax.reduce_xor(i, (0,))),
    "tiles": ("f3", lambda x: jnp.tile(x, 2)),
    "systems": ("f2 f23", solved),
    "root": ("f", root_of),
    "rare": ("f", rare_branch),
    "gradient": ("f2 f2", gradient),
    "own derivative": (
        "f", lambda x: lanewise.with_derivative(lambda x: [x * x], lambda x, dx: [dx[0]], [x])
    ),
    "custom": ("f", jax.nn.silu),
    "long truth": ("f", lambda x: lax.scan(lambda c, z: (c ^ z, c), x > 0, np.arange(150) % 3 > 0)),
    "bytes": ("f", lambda x: [jnp.asarray(np.resize(v, 150)) for v in (np.int8([-128, 127]),
                                                                       np.array([True, False]))]),
}  # fmt: skip


def of_table(table, needed):
    pick = lambda entry: entry[0] if isinstance(entry, tuple) else entry  # noqa: E731
    return {name: (needed, pick(entry)) for name, entry in table.items()}


def in_groups(table, size):
    items = list(table.items())
    return [dict(items[i : i + size]) for i in range(0, len(items), size)]


TABLES = {
    "unary": of_table(programs.UNARY, "f"),
    "binary": of_table(programs.BINARY, "f f"),
    "compared": of_table(programs.COMPARED, "f f"),
    "integers": of_table(programs.OF_INTEGERS, "i i"),
    "an integer": of_table(programs.OF_AN_INTEGER, "i"),
    "truth": of_table(programs.OF_TRUTH, "b b"),
    "types": {
        f"{a} to {b}": (a[0] if a != "uint8" else "i", lambda x, b=b: x.astype(b))
        for a in ("float64", "int32", "bool") for b in (*programs.AS, "uint64", "int16", "uint8")
    },
    "arrays": {name: (needed, function) for name, (needed, _, function) in programs.ARRAYS.items()},
    "loops": programs.LOOPS,
    "others": OTHERS,
}  # fmt: skip
GROUPS = {
    f"{name} {i}": group
    for name, table in TABLES.items()
    for i, group in enumerate(in_groups(table, 30))
}

SAME_OR_ABSENT = """
    conj copy copy_p empty empty2 log2 mesh_cast one_minus_square real reshard sharding_constraint
""".split()  # noqa: SIM905
"""Rules without arithmetic, or of primitives that this release of JAX does not make."""


def aval_of(needed):
    dtype = {"f": "float64", "F": "float64", "i": "int32", "b": "bool"}[needed[0]]
    shape = (3,) if needed == "F" else programs.SHAPE_OF[needed[1:]]
    return jax.ShapeDtypeStruct(shape, dtype)


def batch_for(needed, rng, lanes=24):
    """Numbers of a batch, special ones on all but the first trajectories."""
    shape = (lanes, *aval_of(needed).shape)
    if needed[0] == "b":
        return rng.integers(2, size=shape).astype(bool)
    if needed[0] == "i":
        x = rng.integers(-40, 60, size=shape)
        x[-4:] = rng.choice([0, 2**31 - 1, -(2**31), -1], size=x[-4:].shape)
        return x.astype("int32")
    x = rng.normal(size=shape) * 10.0 ** rng.integers(-3, 4, size=shape)
    far = rng.choice([-1, 1], size=shape) * 10.0 ** rng.uniform(-308, 308, size=shape)
    special = np.where(rng.random(shape) < 0.5, far, rng.choice(SPECIAL, size=shape))
    is_special = rng.random(shape) < 0.4
    is_special[: lanes // 3] = False
    return np.where(is_special, special, x)


SPECIAL = [*programs.SPECIAL, 5e-324, 1e22, 2.0**63, -(2.0**63), 0.5, 1.5]


def names_of(group):
    """What the functions of a group take."""
    return [name for needed, _ in GROUPS[group].values() for name in needed.split()]


def jaxpr_of(group):
    """The functions of a group as one."""

    def function(*args):
        remaining = iter(args)
        pairs = GROUPS[group].values()
        return [jax.tree.leaves(f(*(next(remaining) for _ in n.split()))) for n, f in pairs]

    return jax.make_jaxpr(function)(*map(aval_of, names_of(group)))


def compared(function, lane_flags, operands, lanes):
    """The number of results, which have equal bits from both targets."""
    found = by_threads(function, lane_flags, operands, lanes, 16)
    assert_same_bits(found, by_numbers(function, lane_flags, operands, lanes))
    return len(found)


@pytest.mark.parametrize("name", GROUPS)
def test_rules_have_the_bits_of_the_cpu(name):
    rng, names = np.random.default_rng(3), names_of(name)
    operands = [batch_for(n, rng) for n in names]
    count = compared(jaxpr_of(name), [True] * len(names), operands, len(operands[0]))
    assert count >= len(GROUPS[name])


def test_every_rule_is_compared():
    """Rules that are one function under several names count as one."""
    compared_names = set().union(*(primitives_in(jaxpr_of(name).jaxpr) for name in GROUPS))
    functions = {id(RULES[name]) for name in compared_names & RULES.keys()}
    others = {name for name in RULES.keys() - compared_names if id(RULES[name]) not in functions}
    # The pair is in no program by this name.
    assert others - {*SAME_OR_ABSENT} <= {"sine and cosine"}


def random_programs_are_equal(seed, count, length):
    values = programs.inputs(seed)
    first, second = len(programs.INPUTS), len(programs.INPUTS) + len(programs.ALIKE)
    constants = [jnp.asarray(x) for x in values[first:second]]
    operands = [*values[:first], *values[second:]]
    flags = [i < first for i in range(len(operands))]
    avals = [
        jax.ShapeDtypeStruct(x.shape[flag:], x.dtype)
        for x, flag in zip(operands, flags, strict=True)
    ]
    total = 0
    for nodes in programs.programs(seed, count, length):

        def function(*args, nodes=nodes):
            values = [*args[:first], *constants, *args[first:]]
            return programs.evaluate(nodes, values)[len(programs.ALL) :]

        closed = jax.make_jaxpr(function)(*avals)
        total += compared(closed, flags, operands, programs.LANES)
    return total


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_random_programs_have_the_bits_of_the_cpu(seed):
    assert random_programs_are_equal(seed, 50, 8) > 400


def test_a_few_random_programs_have_the_bits_of_the_cpu():
    assert random_programs_are_equal(100, 40, 3) > 120


# --- controls -------------------------------------------------------------------------------------


def product_and_sum(x, y):
    return lax.optimization_barrier(x * y) + y


def kernel_of(function, *avals, architecture=90):
    closed = jax.make_jaxpr(function)(*avals)
    return closed, ptx_of(closed, [True] * len(avals), architecture)


def test_another_rounding_is_found():
    """Control: one product is contracted with a sum; one sum has no word for its rounding."""
    x, y = np.random.default_rng(1).normal(size=(2, 100))
    closed, kernel = kernel_of(product_and_sum, 1.0, 1.0)
    expected = by_numbers(closed, [True] * 2, [x, y], 100)
    assert_same_bits(ptx_on_cpu.run(kernel, [x, y], [x], 100), expected)
    product = re.search(r"mul\.rn\.f64 \t(%rd\d+), (%rd\d+), (%rd\d+);", kernel.text)
    total = re.search(r"add\.rn\.f64 \t(%rd\d+), (%rd\d+), (%rd\d+);", kernel.text)
    assert product
    assert total
    assert product[1] == total[3]
    fused = f"fma.rn.f64 \t{total[1]}, {product[2]}, {product[3]}, {total[2]};"
    wrong = dataclasses.replace(kernel, text=kernel.text.replace(total[0], fused))
    assert np.any(ptx_on_cpu.run(wrong, [x, y], [x], 100)[0] != expected[0])
    wrong = dataclasses.replace(kernel, text=kernel.text.replace("add.rn.f64", "add.f64"))
    with pytest.raises(AssertionError, match=r"add\.f64"):
        ptx_on_cpu.run(wrong, [x, y], [x], 100)


def test_threads_beyond_the_last_trajectory_do_nothing():
    """Also in a batch of one; control: without the test of the bound they write."""
    _, kernel = kernel_of(lambda x: x + 1, 1.0)
    for lanes, block in ((1, 64), (64, 64), (65, 64), (3, 128)):
        x = np.arange(float(lanes))
        assert_same_bits(ptx_on_cpu.run(kernel, [x], [x], lanes, block), [x + 1])
    text = re.sub(r"\tsetp\.ge\.u64 .*\n\t@.*bra.*\n", "", kernel.text)
    x = np.arange(100.0)
    with pytest.raises(AssertionError):
        ptx_on_cpu.run(dataclasses.replace(kernel, text=text), [x], [x], 97, 3)


# --- the kernel -----------------------------------------------------------------------------------


def rows_of(x, m):
    return lax.scan(lambda c, r: (jnp.sqrt(c) + r, c), x, m)[1]


def test_parameters_and_text_of_a_kernel():
    def function(x, m):
        return rows_of(x, m), jnp.arange(300.0) * x

    closed, kernel = kernel_of(function, 1.0, jnp.zeros(200))
    names = re.findall(r"\.param \.u64 (?:\.ptr \.global \.align \d+ )?(\w+)", kernel.text)
    count = kernel.operands + kernel.results
    assert (kernel.operands, kernel.results) == (2, 2)
    assert len(names) == count + 1 + len(kernel.values)
    assert kernel.text.count(".ptr .global") in (count, 0)  # older releases of LLVM leave it out
    assert set(kernel.values) == {200, 300}
    assert kernel == ptx_of(closed, [True, True], 90)
    assert f".maxntid {kernel.threads}, 1, 1\n.minnctapersm 1\n" in kernel.text
    assert kernel.text.count(".maxntid") == 1
    # Another length needs no new code; a short loop is unrolled.
    long, longer, short = (kernel_of(rows_of, 1.0, jnp.zeros(n))[1] for n in (200, 900, 3))
    assert longer.text == long.text
    assert {*long.values, *longer.values} == {200, 900}
    assert short.values == ()
    assert short.text.count("bra") == 1 < long.text.count("bra")


def test_architectures_are_those_of_a_table():
    pairs = {79: None, 80: 80, 87: 86, 89: 89, 90: 90, 103: 100, 120: 120, 999: 120}
    assert {k: ptx.architecture_for(k) for k in pairs} == pairs
    for architecture in ptx.ARCHITECTURES:
        _, kernel = kernel_of(jnp.sin, 1.0, architecture=architecture)
        assert f".target sm_{architecture}" in kernel.text
    with pytest.raises(KeyError):  # LLVM would end the process
        kernel_of(jnp.sin, 1.0, architecture=95)
    assert [ptx.threads_for(n) for n in (32, 168, 169, 255)] == [128, 128, 64, 64]
    assert ptx.occupancy(68, 90) == 28 / 64
    assert ptx.occupancy(255, 80) == 8 / 64
    assert ptx.occupancy(32, 120) == 1


def test_text_comes_from_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DVI_JAX_CACHE", str(tmp_path))
    _, kernel = kernel_of(jnp.tanh, 1.0)
    (path,) = tmp_path.iterdir()
    calls, optimise = [], machine.optimise

    def counted(*args, **options):
        calls.append(args)
        return optimise(*args, **options)

    monkeypatch.setattr(machine, "optimise", counted)
    assert kernel_of(jnp.tanh, 1.0)[1] == kernel
    assert not calls
    path.write_bytes(path.read_bytes()[:-1])
    assert kernel_of(jnp.tanh, 1.0)[1] == kernel
    assert kernel_of(jnp.tanh, 1.0, architecture=80)[1] != kernel
    assert len(calls) == 2


# --- what stays with XLA --------------------------------------------------------------------------


def many_operations(x):
    return jnp.ones((30, 30)) @ (x * jnp.ones((30, 30)))


def memory_in_a_loop(x):
    rows = lax.scan(lambda c, _: (jnp.sin(c), c), x, None, length=3000)[1]
    return lax.scan(lambda c, r: (c * r + 1, None), x, rows, reverse=True)[0]


REFUSED = {
    "operations": (many_operations, 1.0, "the number of operations of a GPU thread"),
    "memory": (memory_in_a_loop, 1.0, "bytes of intermediate arrays of a thread .* at most 16384"),
    "long arrays": (
        lambda x: lax.fori_loop(0, 9, lambda _, c: jnp.sin(c) + 1, x),
        jnp.zeros(64),
        "arrays of a loop are too long for a GPU thread",
    ),
    "parameters": (
        lambda x: sum(jnp.sum(row) for row in x),
        [jnp.zeros(1)] * 511,
        "the number of parameters of a GPU kernel must be at most 512",
    ),
    "complex": (lambda x: jnp.abs(x + 1j), 1.0, "float64, float32, bool or integers"),
    "no rule": (lambda x: jnp.fft.rfft(x).real, jnp.zeros(4), "no rule|must be float64"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_stays_with_xla(name):
    function, x, reason = REFUSED[name]
    leaves, tree = jax.tree.flatten(x)
    with pytest.raises(NotCompilable, match=reason):
        kernel_of(lambda *leaves: function(jax.tree.unflatten(tree, leaves)), *leaves)
    (part,) = lanewise.explain(function, x, device="cuda").parts
    assert re.search(reason, part.reason)
    assert str(part).startswith("left to XLA: ")


def test_platform_of_a_branch():
    def function(x):
        return lax.platform_dependent(x, cpu=jnp.sin, cuda=jnp.cos, default=jnp.exp)

    x = np.linspace(-3, 3, 50)
    closed, kernel = kernel_of(function, 1.0)
    (found,) = ptx_on_cpu.run(kernel, [x], [x], 50)
    assert_same_bits([found], by_numbers(jax.make_jaxpr(jnp.cos)(1.0), [True], [x], 50))
    assert_same_bits(
        by_numbers(closed, [True], [x], 50),
        by_numbers(jax.make_jaxpr(jnp.sin)(1.0), [True], [x], 50),
    )


# --- lowering -------------------------------------------------------------------------------------


@pytest.fixture
def on_gpus(monkeypatch):
    """The switch, without an import again."""
    monkeypatch.setitem(TARGETS, "cuda", (Threads(),))
    for_cuda = functools.partial(primitive._lower, platform="cuda")
    jaxapi.lower_on("cuda", primitive._lanewise, for_cuda)
    yield
    jaxapi.lower_on("cuda", primitive._lanewise, primitive._through_xla)


def lowered(function, *args):
    """The text for CUDA of a batch."""
    traced = jax.jit(jax.vmap(function)).trace(*map(jnp.asarray, args))
    return traced.lower(lowering_platforms=("cuda",)).as_text()


def with_slow(names, fast):
    """All names, those that are not `fast` as slow tests."""
    return [name if name in fast else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.mark.parametrize("name", with_slow(PROGRAMS, ["kepler", "pendulum_gradient"]))
def test_a_program_is_one_custom_call(on_gpus, name):
    text = lowered(*batch_of(name))
    assert len(re.findall(r"custom_call @lanewise_cuda_\w+", text)) == PROGRAMS[name][1]
    assert "stablehlo.while" not in text


def test_lowering_of_what_stays_with_xla(on_gpus):
    text = lowered(lambda x: lanewise.call(jnp.fft.fft, x), np.zeros((5, 4)))
    assert "custom_call @lanewise" not in text
    nested = lowered(jax.vmap(lambda x: lanewise.call(jnp.sin, x)), np.zeros((5, 4)))
    assert len(re.findall(r"custom_call @lanewise_cuda_\w+", nested)) == 1
    arrays = lanewise.Layout(form="arrays")
    text = lowered(lambda x: lanewise.call(jnp.sin, x, layout=arrays), np.zeros(5))
    assert "custom_call" not in text
    text = lowered(lambda x: lanewise.call(jnp.sin, x), np.zeros(0))
    assert "custom_call" not in text


def test_export_is_refused(on_gpus):
    function = jax.jit(lanewise.batched(jnp.sin))
    shape = jax.ShapeDtypeStruct((9,), float)
    with pytest.raises(ValueError, match="custom calls"):
        export.export(function, platforms=["cuda"])(shape)


def test_the_oldest_gpu_decides(monkeypatch):
    old, new = (SimpleNamespace(compute_capability=c) for c in ("7.5", "12.1"))
    monkeypatch.setattr(threads.jax, "devices", lambda *_: [old, new])
    (part,) = lanewise.explain(jnp.sin, 1.0, device="cuda:0").parts
    assert str(part) == "left to XLA: the GPU is too old: sm_75, not sm_80"
    monkeypatch.setattr(threads.jax, "devices", lambda *_: [new])
    (part,) = lanewise.explain(jnp.sin, 1.0, device="cuda:0").parts
    assert part.architecture == 120


def test_a_kernel_is_loaded_on_the_gpus_of_this_process(monkeypatch):
    """The driver may also have one that JAX does not use, and for which the code is too new."""
    gpus = [
        SimpleNamespace(compute_capability="9.0", process_index=i % 2, local_hardware_id=i)
        for i in (0, 1, 4)
    ]
    monkeypatch.setattr(threads.jax, "devices", lambda *_: gpus)
    loads = []
    monkeypatch.setattr(cuda, "register", lambda kernel, numbers: loads.append(numbers))
    closed = jax.make_jaxpr(jnp.sin)(1.0)
    Threads().register(Threads().write(closed, [True], 1, None))
    assert loads == [[0, 4]]


SWITCHES = """
import os, sys, jax, jax.numpy as jnp, dvi_jax, lanewise
f = jax.jit(lanewise.batched(jnp.sin)).trace(jnp.zeros(5))
text = f.lower(lowering_platforms=("cuda",)).as_text()
maps = open("/proc/self/maps").read() if os.path.exists("/proc/self/maps") else ""
names = [n for n in sys.modules if n in ("lanewise.targets.threads", "lanewise.llvm.ptx")]
print("lanewise_cuda" in text, len(names), "libcuda" in maps)
"""


@pytest.mark.parametrize(
    ("switch", "printed"),
    [("maybe", "False 0 False"), pytest.param("on", "True 2 False", marks=pytest.mark.slow)],
)
def test_nothing_is_imported_without_the_switch(switch, printed):
    run = subprocess.run(
        [sys.executable, "-c", SWITCHES],
        env={**os.environ, "LANEWISE_CUDA": switch, "JAX_PLATFORMS": "cpu"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert run.stdout.split("\n")[0] == printed
    warning = "LANEWISE_CUDA='maybe' is neither on nor off: it has no effect, as LANEWISE_CUDA=off"
    assert (warning in run.stderr) == (switch == "maybe")


# --- explain, and CUDA's assembler ----------------------------------------------------------------


def test_explain_of_a_gpu(monkeypatch):
    monkeypatch.setattr(ptx, "ptxas", lambda: None)
    (part,) = lanewise.explain(jnp.sin, 1.0, device="cuda:0").parts
    assert part.target == "threads"
    assert part.architecture == 80
    assert part.registers == 0
    assert part.occupancy == 8 / 64
    assert part.assembly.count(".entry") == 1
    assert "sm_80" in str(part)
    assert "at most 255 registers" in str(part)
    assert lanewise.explain(jnp.sin, 1.0, device="cpu").parts[0].target == "numbers"
    for device in ("tpu:0", "cuda:", "cuda:x", "cuda:-1", "cpu0"):
        with pytest.raises(ValueError, match="device must be"):
            lanewise.explain(jnp.sin, 1.0, device=device)


def test_explain_of_a_device_that_does_not_exist(monkeypatch):
    assert not lanewise.explain(jnp.sin, 1.0, device="cpu").note
    text = str(lanewise.explain(jnp.sin, 1.0, device="cuda:99"))
    assert text.startswith("there is no device cuda:99 in this process: the report is for an assum")
    assert "an assumed GPU, sm_80\n1. code for GPUs, sm_80: " in text
    assert "cpu:99 in this process" in lanewise.explain(jnp.sin, 1.0, device="cpu:99").note
    gpu = SimpleNamespace(compute_capability="9.0")
    monkeypatch.setattr(threads.jax, "devices", lambda *_: [gpu, gpu])
    for number, count in ((1, 0), (2, 1)):
        note = lanewise.explain(jnp.sin, 1.0, device=f"CUDA:{number}").note
        assert note.count("the report is for those that exist") == count


needs_ptxas = pytest.mark.skipif(ptx.ptxas() is None, reason="nvidia-cuda-nvcc is not installed")


def spills(text, architecture):
    report = ptx.report_of_ptxas(text, architecture)
    assert report is not None
    return sum(map(int, re.findall(r"(\d+) bytes spill", report)))


@needs_ptxas
@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_ptxas_accepts_programs(name):
    for call in calls_of_program(name):
        for architecture in ptx.ARCHITECTURES:
            kernel = ptx_of(call.function, call.lane_flags, architecture)
            bytes_spilled = spills(kernel.text, architecture)
            assert bytes_spilled == 0 or name in ("alphas", "bodies")
            assert 0 < (ptx.registers_of(kernel.text, architecture) or 0) <= 255


@needs_ptxas
@pytest.mark.slow
@pytest.mark.parametrize("name", GROUPS)
def test_ptxas_accepts_rules(name):
    kernel = ptx_of(jaxpr_of(name), [True] * len(names_of(name)), 90)
    assert (ptx.registers_of(kernel.text, 90) or 0) > 0
