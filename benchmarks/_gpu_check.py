"""The stages of `gpu.py --check`: each is a process of its own with a limit of time.

`prepare` writes PTX and the CPU's results where there is no GPU; the stages `load`, `bits` and
`variants` use them with NVIDIA's driver alone. The others run programs through JAX.
"""

import ctypes
import functools
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from _gpu_programs import (
    alphas,
    bodies,
    kepler,
    kepler_float32,
    kepler_saved,
    pendulum,
    pendulum_gradient,
)

import dvi_jax as dvi
from lanewise.llvm.ir import NotCompilable
from lanewise.native import cuda

jax.config.update("jax_enable_x64", True)

SECONDS = {
    "machine": 40, "load": 30, "bits": 30, "xla": 80, "time": 170, "variants": 50, "ways": 60,
}  # fmt: skip
NO_DEVICE = 69  # exit status
FP64_UNITS = {80: 32, 90: 64, 100: 64}
"""Ten times the compute capability → FP64 operations of a multiprocessor in a clock cycle."""


# Program: (trajectories, steps, steps by XLA, predicted steps per second on an H100, required).
TABLE = {
    kepler: (10**6, 10_000, 200, "7.5e10 to 1.0e11", 5e10),
    kepler_saved: (10**6, 1_000, 100, "6e10 to 1.0e11", 3e10),
    kepler_float32: (10**6, 10_000, 200, "1.1e11 to 1.5e11", None),
    pendulum: (300_000, 1_000, 50, "3e10 to 4.2e10", 2e10),
    pendulum_gradient: (100_000, 1_000, 50, "1.3e10 to 1.6e10", 8e9),
    bodies: (100_000, 500, 20, "1e9 to 3e9", 1e9),
    alphas: (100_000, 100, 5, "1e8 to 3e8", 1e8),
}
CARRIED_LANES, CARRIED_STEPS = 1024, 50


def batch_of(program, lanes, steps, form="auto"):
    """(the function of a batch, its inputs)."""
    one, inputs = program(lanes, steps, dvi.Layout(form=form))
    return jax.jit(jax.vmap(one)), inputs


# --- without a GPU --------------------------------------------------------------------------------

COSTS = {
    r"= f(add|sub|mul) double|@llvm\.(fma|minnum|maxnum)\.f64|fcmp \w+ double": 1,
    r"= fdiv double|@llvm\.sqrt\.f64": 8,
}
"""Instructions of PTX as LLVM IR → FP64 instructions of a GPU, of which a quotient and a root are
several. Those of the slow path for subnormal and huge numbers are not counted."""


def fp64_instructions(kernel, operands, shapes, lanes):
    """FP64 instructions that the trajectories execute, counted by running the PTX on the CPU."""
    import ptx_on_cpu

    from lanewise.native import machine

    blocks, lines, total = (
        re.split(r"(?m)^(\w+:)$", ptx_on_cpu.Translation(kernel.text).text),
        [],
        0,
    )
    for i, block in enumerate(blocks):
        lines.append(block)
        if block.endswith(":"):
            # Sums after the phis of a block, which this translator does not write except in
            # @launch.
            cost = sum(n * len(re.findall(p, blocks[i + 1])) for p, n in COSTS.items())
            if cost:
                total += 1
                name = f"%fp64.{total}"
                lines.append(
                    f"\n  {name} = load i64, ptr @fp64\n  {name}.new = add i64 {name}, {cost}\n"
                    f"  store i64 {name}.new, ptr @fp64"
                )
    llvm, (cpu, features) = machine.start_llvm(), machine.host()
    host = llvm.Target.from_default_triple().create_target_machine(
        cpu=cpu, features=features, opt=0, jit=True
    )
    module = llvm.parse_assembly("@fp64 = global i64 0\n" + "".join(lines))
    module.verify()
    engine = llvm.create_mcjit_compiler(module, host)
    engine.finalize_object()
    arrays = [np.ascontiguousarray(x) for x in operands]
    results = [np.zeros(x.shape, x.dtype) for x in shapes]
    addresses = [x.ctypes.data for x in (*arrays, *results)]
    params = np.asarray([*addresses, lanes, *kernel.values], np.int64)
    kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32)
    kind(engine.get_function_address("launch"))(params.ctypes.data, lanes, 1)
    return ctypes.c_int64.from_address(engine.get_global_value_address("fp64")).value


def prepare(folder, architecture=90):
    """Write the PTX of all programs, and the operands and results of the CPU."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from test_lanewise_threads import calls_of

    from lanewise.targets.threads import ptx_of

    folder.mkdir(parents=True, exist_ok=True)
    for program in TABLE:
        one, inputs = program(CARRIED_LANES, CARRIED_STEPS, dvi.Layout())
        for k, call in enumerate(calls_of(one, *map(jnp.asarray, inputs))):
            kernel = ptx_of(call.function, call.lane_flags, architecture)
            name = f"{program.__name__}.{k}"
            few = [
                x[:8] if flag else x for x, flag in zip(call.operands, call.lane_flags, strict=True)
            ]
            shapes = [jax.ShapeDtypeStruct((8, *x.shape[1:]), x.dtype) for x in call.results]
            count = fp64_instructions(kernel, few, shapes, 8) / 8 / CARRIED_STEPS
            (folder / f"{name}.ptx").write_text(kernel.text)
            arrays = {f"a{i:03}": x for i, x in enumerate(call.operands)}
            arrays |= {f"r{i:03}": x for i, x in enumerate(call.results)}
            numbers = {"values": kernel.values, "fp64": count, "flags": call.lane_flags}
            np.savez_compressed(folder / f"{name}.npz", allow_pickle=False, **arrays, **{
                key: np.asarray(value) for key, value in numbers.items()
            })  # fmt: skip
            say(name, f"{len(kernel.text)} bytes of PTX, {count:.0f} FP64 instructions a step")


# --- with a GPU -----------------------------------------------------------------------------------


def say(key, value):
    """Print a result at once, so that it is there even if the process ends."""
    print(json.dumps({key: value}), flush=True)


def attempt(key, function, *args):
    """Print what a function returns, or its error."""
    try:
        say(key, function(*args))
        return True
    except Exception as error:
        say(key, f"failed: {type(error).__name__}: {error}"[:600])
        return False


class Device:
    """Device 0 by the driver alone."""

    def __init__(self):
        self.driver = cuda.driver()
        self.number, context = ctypes.c_int(), ctypes.c_void_p()
        self.driver.call("cuDeviceGet", ctypes.byref(self.number), 0)
        self.driver.call("cuDevicePrimaryCtxRetain", ctypes.byref(context), self.number)
        self.driver.call("cuCtxSetCurrent", context)

    def attribute(self, which):
        value = ctypes.c_int()
        self.driver.call("cuDeviceGetAttribute", ctypes.byref(value), which, self.number)
        return value.value

    def limit(self, fp64):
        """Steps per second that the FP64 units allow."""
        units = FP64_UNITS.get(10 * self.attribute(75) + self.attribute(76), 2)
        clock = 1000.0 * self.attribute(13)
        return self.attribute(16) * units * clock / fp64

    def put(self, x):
        place, x = ctypes.c_uint64(), np.ascontiguousarray(x)
        self.driver.call("cuMemAlloc_v2", ctypes.byref(place), ctypes.c_size_t(max(x.nbytes, 1)))
        source, size = ctypes.c_void_p(x.ctypes.data), ctypes.c_size_t(x.nbytes)
        self.driver.call("cuMemcpyHtoD_v2", place, source, size)
        return place

    def get(self, place, like):
        out = np.empty_like(like)
        target, size = ctypes.c_void_p(out.ctypes.data), ctypes.c_size_t(out.nbytes)
        self.driver.call("cuMemcpyDtoH_v2", target, place, size)
        return out

    def run(self, kernel, lanes, pointers, values, threads=64):
        cells = [*pointers, ctypes.c_int64(lanes), *(ctypes.c_int64(int(v)) for v in values)]
        passed = (ctypes.c_void_p * len(cells))(*map(ctypes.addressof, cells))
        grid = -(-lanes // threads), 1, 1, threads, 1, 1, 0
        self.driver.call("cuLaunchKernel", ctypes.c_void_p(kernel), *grid, None, passed, None)
        self.driver.call("cuCtxSynchronize")


def carried(folder):
    """(name, PTX, operands, results, numbers) of each carried kernel."""
    for path in sorted(folder.glob("*.ptx")):
        data = dict(np.load(path.with_suffix(".npz")))
        arrays = [
            [data[key] for key in sorted(data) if key[0] == c and key[1:].isdigit()] for c in "ar"
        ]
        yield path.stem, path.read_text(), *arrays, data


def bytes_that_differ(x, y):
    """NaN has no sign and no payload that is promised."""
    x, y = (
        np.where(np.isnan(z), 0, z) if z.dtype.kind == "f" else z for z in map(np.asarray, (x, y))
    )
    return int(
        np.count_nonzero(np.ascontiguousarray(x).view("u1") != np.ascontiguousarray(y).view("u1"))
    )


def stage_machine(folder):
    query = "name,driver_version,clocks.sm,clocks.max.sm,memory.total"
    for command in (["nvidia-smi", "-L"], ["nvidia-smi", f"--query-gpu={query}", "--format=csv"]):
        attempt(" ".join(command), lambda c=command: subprocess.run(
            c, capture_output=True, text=True, check=True, timeout=20).stdout)  # fmt: skip
    say("python", sys.version.split()[0])
    for name in ("jax", "jaxlib", "llvmlite", "equinox"):
        attempt(name, lambda name=name: __import__(name).__version__)
    say("devices", [d.device_kind for d in jax.devices()])
    say("carried", [name for name, *_ in carried(folder)])


def stage_load(folder):
    device, fine = Device(), True

    def load(text):
        begun = time.perf_counter()
        kernel = device.driver.load(text, "lanewise_kernel")
        registers, local = device.driver.largest(kernel, [0])
        seconds = round(time.perf_counter() - begun, 3)
        return {"registers": registers, "local bytes": local, "seconds": seconds}

    for name, text, *_ in carried(folder):
        fine &= attempt(name, load, text)
    return fine


def stage_bits(folder):
    device, equal = Device(), []

    def compare(text, operands, results, data):
        kernel = device.driver.load(text, "lanewise_kernel")
        pointers = [device.put(x) for x in (*operands, *(np.full_like(x, 77) for x in results))]
        device.run(kernel, CARRIED_LANES, pointers, data["values"])
        computed = [
            device.get(*pair) for pair in zip(pointers[len(operands) :], results, strict=True)
        ]
        differ = [bytes_that_differ(*pair) for pair in zip(computed, results, strict=True)]
        equal.append(not any(differ))
        return {"bytes that differ": differ, "of": [x.nbytes for x in results]}

    fine = [attempt(name, compare, *rest) for name, *rest in carried(folder)]
    return all(fine) and all(equal)


def stage_xla(folder):
    """Through JAX: the bits of the GPU and of the CPU of the same process, and first calls."""
    equal = []

    def compare(program):
        results, seconds = [], []
        for platform in ("cpu", "gpu"):
            device = jax.devices(platform)[0]
            with jax.default_device(device):
                begun = time.perf_counter()
                batch, inputs = batch_of(program, 256, 50)
                outs = jax.block_until_ready(batch(*jax.device_put(inputs, device)))
                seconds.append(round(time.perf_counter() - begun, 2))
                results.append(jax.tree.leaves(outs))
        differ = [bytes_that_differ(*pair) for pair in zip(*results, strict=True)]
        equal.append(not any(differ))
        return {"bytes that differ": differ, "first call on CPU and GPU": seconds}

    statuses = [attempt(program.__name__, compare, program) for program in TABLE]
    return all(statuses) and all(equal)


def seconds_of(program, lanes, steps, form):
    """Median of five runs on the default device, after one that compiles."""
    batch, inputs = batch_of(program, lanes, steps, form)
    inputs = jax.device_put(inputs)
    jax.block_until_ready(batch(*inputs))
    seconds = []
    for _ in range(5):
        begun = time.perf_counter()
        jax.block_until_ready(batch(*inputs))
        seconds.append(time.perf_counter() - begun)
    return float(np.median(seconds))


def stage_time(folder):
    """Steps of all trajectories in a second: the kernel, XLA, the prediction and the limit."""
    fp64 = {}
    for name, _, _, _, data in carried(folder):
        program = name.rsplit(".", 1)[0]
        fp64[program] = fp64.get(program, 0) + float(data["fp64"])
    device = Device()

    def measure(program):
        lanes, steps, by_xla, predicted, required = TABLE[program]
        rates = {}
        for form, n in (("auto", steps), ("arrays", by_xla)):
            rates[form] = lanes * n / seconds_of(program, lanes, n, form)
            say(f"{program.__name__} {form}, {lanes} trajectories, steps/s", f"{rates[form]:.3g}")
        limit = device.limit(fp64[program.__name__]) if fp64.get(program.__name__) else np.nan
        return {
            "measured": f"{rates['auto']:.3g}", "predicted for an H100": predicted,
            "required on an H100": required, "times XLA": round(rates["auto"] / rates["arrays"], 1),
            "limit of FP64 units": f"{limit:.3g}",
            "fraction of it": round(rates["auto"] / limit, 3),
        }  # fmt: skip

    statuses = [attempt(program.__name__, measure, program) for program in TABLE]
    for lanes in (1, 1_000, 10_000, 100_000):
        attempt(f"kepler, {lanes} trajectories, steps/s", lambda n=lanes: (
            f"{n * 10_000 / seconds_of(kepler, n, 10_000, 'auto'):.3g}"))  # fmt: skip
    # Rows of a trajectory lie next to each other in memory: docs/gpu.md predicts what that costs.
    for every in (1, 2, 3, 5):
        saved, steps = functools.partial(kepler_saved, every=every), 100 * every
        attempt(f"kepler, saved every {every} steps, steps/s", lambda saved=saved, steps=steps: (
            f"{10**6 * steps / seconds_of(saved, 10**6, steps, 'auto'):.3g}"))  # fmt: skip
    return all(statuses)


def stage_variants(folder):
    """Threads of a block and bounds of registers, by the driver alone."""
    device, copies = Device(), 64

    def measure(text, threads, bound, operands, results, data):
        text = text.replace(".maxntid 128", f".maxntid {threads}")
        text = text if bound is None else text.replace(".minnctapersm 1", bound)
        kernel = device.driver.load(text, "lanewise_kernel")
        flags = [*map(bool, data["flags"]), *[True] * len(results)]
        pairs = zip((*operands, *results), flags, strict=True)
        pointers = [device.put(np.concatenate([x] * copies) if flag else x) for x, flag in pairs]
        seconds = []
        for _ in range(4):
            begun = time.perf_counter()
            device.run(kernel, CARRIED_LANES * copies, pointers, data["values"], threads)
            seconds.append(time.perf_counter() - begun)
        for pointer in pointers:
            device.driver.call("cuMemFree_v2", pointer)
        return {"seconds": min(seconds), "registers": device.driver.largest(kernel, [0])[0]}

    fine = True
    for name, text, *rest in carried(folder):
        for threads, bound in (
            (128, None),
            (64, None),
            (32, None),
            (128, ""),
            (128, ".maxnreg 128"),
        ):
            key = f"{name}, {threads} threads, {bound if bound is not None else 'as generated'}"
            fine &= attempt(key, measure, text, threads, bound, *rest)
    return fine


def stage_ways(folder):
    """The same batch again, from several threads, in a loop of XLA, and in `shard_map`."""
    begun = time.perf_counter()
    batch, (q, p) = batch_of(kepler, 256, 50)
    first = [np.asarray(x) for x in jax.tree.leaves(batch(q, p))]
    say("first call with the driver's cache, seconds", round(time.perf_counter() - begun, 2))
    answers = []

    def is_equal(outs):
        pairs = zip(jax.tree.leaves(outs), first, strict=True)
        answers.append(all(bytes_that_differ(*pair) == 0 for pair in pairs))
        return answers[-1]

    def in_threads():
        pool = [threading.Thread(target=lambda: is_equal(batch(q, p))) for _ in range(8)]
        for thread in pool:
            thread.start()
        for thread in pool:
            thread.join()
        return answers[-8:] if len(answers) >= 8 else answers.append(False)

    def in_a_loop():
        loop = jax.jit(lambda q, p: jax.lax.fori_loop(0, 20, lambda i, s: batch(*s)[:2], (q, p)))
        by_hand = (q, p)
        for _ in range(20):
            by_hand = batch(*by_hand)[:2]
        answers.append(
            all(bytes_that_differ(*pair) == 0 for pair in zip(loop(q, p), by_hand, strict=True))
        )
        return answers[-1]

    def sharded():
        mesh = jax.sharding.Mesh(np.array(jax.devices()), ("i",))
        spec = jax.sharding.PartitionSpec("i")
        f = jax.shard_map(batch, mesh=mesh, in_specs=spec, out_specs=spec)
        return is_equal(jax.jit(f)(q, p))

    ways = {"again": lambda: is_equal(batch(q, p)), "eight threads": in_threads,
            "in a loop": in_a_loop, "shard_map": sharded}  # fmt: skip
    statuses = [attempt(name, way) for name, way in ways.items()]
    return all(statuses) and all(answers)


def run_stage(name, folder):
    """The exit status of a stage."""
    try:
        count = ctypes.c_int()
        cuda.driver().call("cuDeviceGetCount", ctypes.byref(count))
        reason = "" if count.value else "the driver finds none"
    except NotCompilable as error:
        reason = str(error)
    if reason and name != "machine":
        say("no device", reason)
        return NO_DEVICE
    is_fine = globals()[f"stage_{name}"](folder)
    if reason:
        say("no device", reason)
        return NO_DEVICE
    return int(is_fine is False)


def check(folder, out, only=()):
    """Run all stages, each with its limit; the exit status is `NO_DEVICE` if there is no GPU."""
    out.mkdir(parents=True, exist_ok=True)
    statuses = {}
    for name in only or SECONDS:
        begun, log = time.perf_counter(), out / f"{name}.log"
        command = [sys.executable, str(Path(__file__).with_name("gpu.py")), "--stage", name]
        with log.open("w") as file:
            # A session of its own, so that a stage that hangs is ended with its children.
            child = subprocess.Popen(
                [*command, "--carried", str(folder)], stdout=subprocess.PIPE, text=True,
                stderr=subprocess.STDOUT, start_new_session=True,
                env={**os.environ, "LANEWISE_CUDA": "on"},
            )  # fmt: skip
            timer = threading.Timer(SECONDS[name], os.killpg, (child.pid, signal.SIGKILL))
            timer.start()
            for line in child.stdout:
                print(f"{name}: {line}", end="", flush=True)
                file.write(line)
                file.flush()
            statuses[name] = child.wait()
            timer.cancel()
        print(
            f"== {name}: status {statuses[name]} after {time.perf_counter() - begun:.0f} s",
            flush=True,
        )
    if all(status == NO_DEVICE for status in statuses.values()):
        return NO_DEVICE
    return int(any(statuses.values()))
