"""A batch in one GPU kernel beside the XLA scan, and beside what the device could do at most.

    python benchmarks/gpu.py [--out FILE] [--rows PATTERN] [--width LANES] [--rehearse]

Some minutes on a machine with an NVIDIA GPU and a JAX that knows it:
``pip install -e . && pip install "jax[cuda12]"``. For every row, of 2^20 lanes,

- the kernel is lowered for CUDA, and must be one call without a loop beside it;
- its numbers for some lanes are compared with those of the CPU (plain path, `form="arrays"`);
- it is timed, beside the XLA scan: `form="components"` and `form="arrays"`, the faster of the two,
  over fewer steps (per lane and step it costs the same).

*Limits*, measured here, on this device. Arithmetic: the operations of one step in component form
(additions and multiplications fused as far as there are pairs; divisions, roots, sines as often as
they occur; comparisons, selections and all books for nothing), each at the rate that a kernel
reaches which does nothing else. Bandwidth: the bytes of the saved states, at the rate of a large
copy. The larger of the two counts. Aims: at most 2.5 times the limit for Kepler in float64, and at
least 10 times as fast as the scan.

Exit status: 0 if all numbers agree (whether or not the aims are reached), 1 if something does not,
2 if there is no GPU: then only the lowering has been checked. `--rehearse` runs all of it on a few
lanes in the interpreter, to see that this file works; its times mean nothing.
"""

import argparse
import contextlib
import fnmatch
import functools
import json
import platform
import re
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _workloads import EPSILON, WORKLOADS
from jax import lax

import dvi_jax as dvi
from dvi_jax._compat import Literal, bodies, lowered_for_cuda, with_outputs
from dvi_jax._step import Equations
from dvi_jax._types import Interval
from dvi_jax.engine.lanes import evaluate
from dvi_jax.engine.newton import Newton, Trusted

LIMIT_AIM, SCAN_AIM = 2.5, 10.0
NEWTON_ITERATIONS = 2
CHECKED_LANES = 1024
CHECKED_STEPS = 100
AGREES_TO = {"float64": 1e-10, "float32": 2e-3}
"""Relative to the largest number of the result, after CHECKED_STEPS steps."""


class Row(NamedTuple):
    """A workload, its type, and what is done along the way; `steps` of the kernel, of the scan."""

    workload: str
    dtype: str = "float64"
    invariants: bool = False
    save_every: int | None = None
    steps: int = 10_000
    scan_steps: int = 500


ROWS = {
    "kepler": Row("kepler"),
    "kepler float32": Row("kepler", "float32"),
    "oscillator": Row("oscillator"),
    "implicit n=1": Row("product", steps=2_000, scan_steps=200),
    "implicit n=2": Row("chain2", steps=1_000, scan_steps=100),
    "pendulum n=2": Row("pendulum", steps=1_000, scan_steps=100),
    "kepler, invariants": Row("kepler", invariants=True),
    "kepler, save every 10": Row("kepler", save_every=10, steps=200, scan_steps=200),
}
NEEDED = "kepler"
"""The row that the aims are set for."""


class Size(NamedTuple):
    lanes: int
    width: int | None
    is_rehearsal: bool

    def steps(self, row: Row, form: str) -> int:
        wanted = row.steps if form == "kernel" else row.scan_steps
        return 20 if self.is_rehearsal else wanted


def batch(row: Row, form: str, steps: int, width: int | None) -> Callable:
    """The compiled function of q0, p0 (n, lanes): what the row asks for, lanes last."""
    work = WORKLOADS[row.workload]
    save = dvi.Save(final=True) if row.save_every is None else dvi.Save(every=row.save_every)
    observe = None
    if row.invariants:
        observe = {"drift": dvi.MaxDrift(work.energy), "trend": dvi.Trend(work.energy)}
    layout = dvi.Layout(form=form, width=width if form == "kernel" else None)  # pyright: ignore

    def one(q0, p0):
        sol = dvi.integrate(
            work.system, q0, p0, h=work.h, num_steps=steps, epsilon=EPSILON, args=work.args,
            save=save, observe=observe or {}, layout=layout, throw=False,
        )  # fmt: skip
        states = (sol.qs[-1], sol.ps[-1]) if row.save_every is None else (sol.qs[1:], sol.ps[1:])
        return *states, sol.observed, sol.stats["failed_step"]

    return jax.jit(jax.vmap(one, in_axes=-1, out_axes=-1))


def start(row: Row, lanes: int) -> tuple[jax.Array, ...]:
    return tuple(jnp.asarray(x, row.dtype) for x in WORKLOADS[row.workload].start(lanes))


# --- checks ---------------------------------------------------------------------------------------


def lowers(row: Row, width: int | None) -> str:
    """What is wrong with the program for CUDA, "" if nothing."""
    run = batch(row, "kernel", row.steps, width)
    program = lowered_for_cuda(run, *start(row, 512))
    calls, loops = len(re.findall(r"custom_call @\S*triton", program)), program.count("hlo.while")
    return "" if (calls, loops) == (1, 0) else f"{calls} Triton calls, {loops} loops beside"


def difference(row: Row, size: Size) -> float:
    """Largest difference between kernel and CPU, of the largest number of each result."""
    lanes, steps = min(size.lanes, CHECKED_LANES), size.steps(row, "check")
    steps = min(steps, CHECKED_STEPS)
    # lanes that the block does not divide
    begin = [x[:, : lanes - 1] for x in start(row, lanes)]
    ours = jax.device_get(batch(row, "kernel", steps, size.width)(*begin))
    with jax.default_device(jax.devices("cpu")[0]):
        plain = jax.device_get(batch(row, "arrays", steps, None)(*map(np.asarray, begin)))
    worst = 0.0
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(plain), strict=True):
        scale = np.max(np.abs(b), initial=np.finfo(row.dtype).tiny)
        worst = max(worst, float(np.max(np.abs(a - b), initial=0.0) / scale))
        if np.isnan(a).any() or np.isnan(b).any():
            return np.nan
    return worst


# --- limits ---------------------------------------------------------------------------------------

CHAINS: dict[str, Callable] = {
    "fma": lambda x: x * 0.999 + 0.001,
    "div": lambda x: 1.001 / x,
    "sqrt": jnp.sqrt,
    "rsqrt": lax.rsqrt,
    "sin": jnp.sin,
    "cos": jnp.cos,
    "exp": lambda x: jnp.exp(-x),
    "log": lambda x: jnp.log(x + 2.0),
}
"""Operations that are timed, each made many times of its own result."""

FREE = """abs and ceil clamp convert_element_type eq floor ge gt is_finite le lt max min ne neg not
or select_n sign xor broadcast_in_dim stop_gradient copy squeeze slice reshape stack""".split()  # noqa: SIM905


def operations(row: Row) -> dict[str, int]:
    """How many operations on real numbers one step of a lane is made of, in component form."""
    work = WORKLOADS[row.workload]
    like = jax.ShapeDtypeStruct((work.n,), row.dtype)
    h = np.asarray(work.h, row.dtype)

    def step(q0, p0, t0):
        newton: Any = Trusted(Newton(), NEWTON_ITERATIONS)  # pyright: ignore
        equations = Equations(work.system, np.asarray(EPSILON, row.dtype), work.args, newton)
        interval = Interval(t0, t0 + h, jnp.asarray(h))
        q1, p1, _ = dvi.TypeII().step(equations, interval, q0, p0)
        values = work.energy(t0, t0 + h, q0, p0, q1, p1, work.args) if row.invariants else None
        return q1, p1, values

    closed = jax.make_jaxpr(step)(like, like, jax.ShapeDtypeStruct((), row.dtype))
    lanes = 8
    shapes = [jax.ShapeDtypeStruct((work.n, lanes), row.dtype)] * 2
    shapes.append(jax.ShapeDtypeStruct((), row.dtype))

    def in_components(*args):
        values = evaluate(closed, args, [True, True, False], lanes)
        return [v.array()[0] for v in values]

    jaxpr = jax.make_jaxpr(in_components)(*shapes).jaxpr
    counts: dict[str, int] = {}
    _count(with_outputs(jaxpr, [True] * len(jaxpr.outvars))[0], lanes, 1, counts)
    fused = max(counts.pop("add", 0), counts.pop("mul", 0))
    return {"fma": fused} | {name: n for name, n in counts.items() if n}


def _count(jaxpr, lanes: int, times: int, counts: dict[str, int]) -> None:
    """Add the operations on lanes of real numbers, what is the same twice counted once."""

    def more(name: str, n: int) -> None:
        counts[name] = counts.get(name, 0) + times * n

    seen: dict[Any, list[Any]] = {}
    first: dict[Any, Any] = {}
    for eqn in jaxpr.eqns:
        name, params = eqn.primitive.name, eqn.params
        inputs = [repr(v.val) if isinstance(v, Literal) else first.get(v, v) for v in eqn.invars]
        key = name, tuple(inputs), str(params)
        if key in seen:
            first.update(zip(eqn.outvars, seen[key], strict=True))
            continue
        seen[key] = eqn.outvars
        inner = list(bodies(eqn))
        for body in inner:
            _count(body.jaxpr, lanes, times * params.get("length", 1), counts)
        out = eqn.outvars[0].aval
        is_real = jnp.issubdtype(out.dtype, jnp.floating) and out.shape == (lanes,)
        if inner or not is_real or name in FREE:
            continue
        if name in ("integer_pow", "square"):
            power = params.get("y", 2)
            more("mul", abs(power).bit_length() + abs(power).bit_count() - 2)
            more("div", int(power < 0))
        elif name == "div" and isinstance(eqn.invars[1], Literal):
            more("mul", 1)
        elif name in ("sub", "add_any"):
            more("add", 1)
        elif name in ("add", "mul") or name in CHAINS:
            more(name, 1)
        else:
            raise NotImplementedError(f"no rate is measured for {name}")


def rate(name: str, dtype: str, size: Size) -> float:
    """Operations a second of this device, all lanes together."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    operation, chains, rounds = CHAINS[name], 8, 4 if size.is_rehearsal else 2_000
    block, count = (8, 2) if size.is_rehearsal else (128, 8192)

    def kernel(x_ref, out_ref):
        x = x_ref[...]
        state = tuple(x + 0.01 * i for i in range(chains))
        state = lax.fori_loop(0, rounds, lambda _, s: tuple(map(operation, s)), state)
        out_ref[...] = functools.reduce(jnp.add, state)

    spec = pl.BlockSpec((block,), lambda b: (b,))
    run = pl.pallas_call(
        kernel, grid=(count,), in_specs=[spec], out_specs=spec,
        out_shape=jax.ShapeDtypeStruct((block * count,), dtype), interpret=size.is_rehearsal,
        compiler_params=triton.CompilerParams(num_warps=4),
    )  # fmt: skip
    x = jnp.linspace(0.5, 0.9, block * count, dtype=dtype)
    seconds, _ = timed(jax.jit(run), x)
    return block * count * chains * rounds / seconds


def bandwidth(size: Size) -> float:
    """Bytes a second that this device reads and writes in a copy."""
    x = jnp.zeros(2**10 if size.is_rehearsal else 2**28, jnp.float32)
    seconds, _ = timed(jax.jit(lambda x: x + 1), x)
    return 2 * x.nbytes / seconds


def limit(row: Row, rates: dict[tuple[str, str], float], bytes_per_second: float) -> float:
    """Least seconds for a step of a lane."""
    arithmetic = sum(n / rates[name, row.dtype] for name, n in operations(row).items())
    if row.save_every is None:
        return arithmetic
    state = 2 * WORKLOADS[row.workload].n * np.dtype(row.dtype).itemsize
    return max(arithmetic, state / row.save_every / bytes_per_second)


# --- times ----------------------------------------------------------------------------------------


def timed(run: Callable, *args: Any, rounds: int = 5) -> tuple[float, float]:
    """(median seconds of a call, seconds of the first one)."""
    began = time.perf_counter()
    jax.block_until_ready(run(*args))
    first, seconds = time.perf_counter() - began, []
    for _ in range(rounds):
        began = time.perf_counter()
        jax.block_until_ready(run(*args))
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds), first


def measured(row: Row, form: str, size: Size) -> tuple[float, float]:
    """(seconds for a step of a lane, seconds of the first call)."""
    steps = size.steps(row, form)
    run = batch(row, form, steps, size.width)
    seconds, first = timed(run, *start(row, size.lanes))
    return seconds / (steps * size.lanes), first


def report(row: Row, size: Size, rates, bytes_per_second: float) -> dict[str, Any]:
    found: dict[str, Any] = {"difference": difference(row, size)}
    kernel, first = measured(row, "kernel", size)
    scans = {form: measured(row, form, size)[0] for form in ("components", "arrays")}
    least = limit(row, rates, bytes_per_second)
    found |= {"kernel_ns": 1e9 * kernel, "first_call_s": first, "limit_ns": 1e9 * least}
    found |= {f"scan_{form}_ns": 1e9 * s for form, s in scans.items()}
    found |= {"kernel_over_limit": kernel / least, "scan_over_kernel": min(scans.values()) / kernel}
    return found


HEAD = (
    f"{'row':24}{'kernel':>10}{'limit':>10}{'scan':>10}   ratios: kernel/limit  scan/kernel   CPU"
)


def line(name: str, found: dict[str, Any]) -> str:
    scan = min(found["scan_components_ns"], found["scan_arrays_ns"])
    times = f"{found['kernel_ns']:10.4f}{found['limit_ns']:10.4f}{scan:10.4f}"
    ratios = f"{found['kernel_over_limit']:20.2f}{found['scan_over_kernel']:13.1f}"
    return f"{name:24}{times}{ratios}      {found['difference']:.0e}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--out", type=Path, help="write the results as JSON")
    parser.add_argument("--rows", default="*", help="pattern of names of rows")
    parser.add_argument("--lanes", type=int, default=2**20)
    parser.add_argument("--width", type=int, help="lanes of a block")
    parser.add_argument("--rehearse", action="store_true", help="a few lanes, interpreted")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)

    rows = {name: row for name, row in ROWS.items() if fnmatch.fnmatch(name, options.rows)}
    is_bad = False
    for name, row in rows.items():
        wrong = lowers(row, options.width)
        print(f"lowered for CUDA: {name}: {wrong or 'one call, no loop beside it'}", flush=True)
        is_bad = is_bad or bool(wrong)

    has_gpu = jax.default_backend() == "gpu"
    if not (has_gpu or options.rehearse):
        print("no GPU: JAX sees", ", ".join(str(d) for d in jax.devices()))
        print("Nothing was run or timed. The lowering says that Triton takes the kernels, no more.")
        return 1 if is_bad else 2
    size = Size(options.lanes, options.width, False)
    if not has_gpu:
        print("REHEARSAL in the interpreter: the times mean nothing.")
        size = Size(16, options.width or 8, True)

    device = jax.devices()[0]
    print(f"{device.device_kind}, jax {jax.__version__}, {size.lanes} lanes")
    bytes_per_second = bandwidth(size)
    print(f"copy: {bytes_per_second / 1e9:.0f} GB/s")
    needed = {(name, row.dtype) for row in rows.values() for name in operations(row)}
    rates = {}
    for name, dtype in sorted(needed):
        rates[name, dtype] = rate(name, dtype, size)
        print(f"{name} {dtype}: {rates[name, dtype] / 1e12:.3f}e12 a second", flush=True)

    print(f"\nns for a step of a lane\n{HEAD}")
    results = {}
    for name, row in rows.items():
        results[name] = found = report(row, size, rates, bytes_per_second)
        agrees = found["difference"] <= AGREES_TO[row.dtype]
        is_bad = is_bad or not agrees
        print(line(name, found) + ("" if agrees else "  DIFFERS"), flush=True)
    if NEEDED in results and has_gpu:
        found = results[NEEDED]
        for what, aim, ok in (
            ("kernel/limit", LIMIT_AIM, found["kernel_over_limit"] <= LIMIT_AIM),
            ("scan/kernel", SCAN_AIM, found["scan_over_kernel"] >= SCAN_AIM),
        ):
            print(f"aim for {NEEDED}: {what} {aim}: {'reached' if ok else 'MISSED'}")
    if options.out:
        with contextlib.suppress(FileExistsError):
            options.out.parent.mkdir(parents=True)
        options.out.write_text(
            json.dumps(
                {
                    "device": device.device_kind,
                    "is_rehearsal": size.is_rehearsal,
                    "jax": jax.__version__,
                    "python": platform.python_version(),
                    "lanes": size.lanes,
                    "width": options.width,
                    "bytes_per_second": bytes_per_second,
                    "rates": {f"{name} {dtype}": r for (name, dtype), r in rates.items()},
                    "operations": {name: operations(row) for name, row in rows.items()},
                    "rows": results,
                },
                indent=1,
            )
        )
    return 1 if is_bad else 0


if __name__ == "__main__":
    sys.exit(main())
