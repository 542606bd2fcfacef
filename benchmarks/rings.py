"""Storage rings against pyAT: time of tracking and of gradients on the same cores.

    python benchmarks/rings.py [--particles 10000] [--turns 100] [--check]

The ring is the hybrid multi-bend achromat that pyAT ships (hmba.mat, one cell of 121 elements a
turn). pyAT tracks in its compiled code on one core, and on all cores with its own processes; the
wheels of pyAT have no OpenMP. Each time is the least of three. The first call is that of a fresh
process, without the import and without machine code of an earlier process; first optics are
processor time, also of dba.mat (145 elements) and of 1297 cells (10 376 elements). `--optics` only
measures these. `--check` exits with 1 if a limit is exceeded. Requires the extra rings.
"""

import argparse
import importlib
import os
import resource
import subprocess
import sys
import time
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dvi_jax.systems import rings
from dvi_jax.systems.rings._readers import to_at

jax.config.update("jax_enable_x64", True)
warnings.simplefilter("ignore")
STRENGTHS = "b0", "b1", "b2", "b3", "a0"


def lattice(name="hmba.mat"):
    at = importlib.import_module("at")
    data = importlib.import_module("machine_data")
    found = at.load_lattice(os.path.join(next(iter(data.__path__)), name))
    found.disable_6d()
    return found


def large_ring(cells=1297):
    half = np.pi / cells / 2
    bend = rings.bend("B", 1.5, angle=2 * half, edge_in=half, edge_out=half)
    cell = [
        rings.quadrupole("QF", 0.4, k1=1.3), rings.sextupole("SF", 0.2, b2=0.5), bend,
        rings.drift("D", 0.2),
        rings.quadrupole("QD", 0.4, k1=-1.3), rings.sextupole("SD", 0.2, b2=-0.5), bend,
        rings.drift("D", 0.2),
    ]  # fmt: skip
    return rings.Ring(cells * cell)


def particles(count):
    sizes = np.array([1e-4, 1e-5, 1e-4, 1e-5, 1e-3, 1e-3])
    return np.random.default_rng(0).normal(size=(count, 6)) * sizes


def least(function, times=3):
    found = []
    for _ in range(times):
        begin = time.perf_counter()
        jax.block_until_ready(function())
        found.append(time.perf_counter() - begin)
    return min(found)


def theirs(cell, z, turns, processes):
    def run():
        r = to_at(z).copy(order="F")
        cell.track(r, nturns=turns, refpts=None, in_place=True, use_mp=processes)

    return least(run, 1 if processes or len(z) > 100 else 3)


def gradient(ring, z, turns):
    """The function of all strengths, and its gradient."""
    columns = {name: ring.columns[name] for name in STRENGTHS}

    def final(columns):
        changed = eqx.tree_at(lambda r: r.columns, ring, {**ring.columns, **columns})
        return rings.track(changed, z, turns).z

    backward = jax.jit(jax.grad(lambda c: jnp.sum(final(c) ** 2)))
    return columns, jax.jit(final), backward


def memory(turns):
    """Peak memory of this process in MiB after one gradient over `turns` turns."""
    ring = rings.from_at(lattice())
    columns, _, backward = gradient(ring, jnp.asarray(particles(64)), turns)
    jax.block_until_ready(backward(columns))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def fresh(*what):
    """A number that a new process of this file prints."""
    out = subprocess.run(
        [sys.executable, __file__, *what],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "DVI_JAX_CACHE": "off"},
    )
    return float(out.stdout.split()[-1])


def first_call():
    ring, z = rings.from_at(lattice()), particles(100)
    begin = time.perf_counter()
    jax.block_until_ready(rings.track(ring, z, 10))
    return time.perf_counter() - begin


OPTICS = {
    "121 elements": (2, lambda: rings.from_at(lattice()), {}),
    "121 elements, no chromaticities": (2, lambda: rings.from_at(lattice()), {"chromatic": False}),
    "145 elements": (2, lambda: rings.from_at(lattice("dba.mat")), {}),
    "10 376 elements": (4, large_ring, {}),
    "10 376 elements, second call": (0.3, large_ring, {}),
}


def optics_time(case):
    """Processor time [s] of the first call of `rings.optics`, or of the second one."""
    _, make, settings = OPTICS[case]
    ring = make()
    for _ in range(1 + case.endswith("second call")):
        begin = time.process_time()
        jax.block_until_ready(rings.optics(ring, **settings))
    return time.process_time() - begin


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--particles", type=int, default=10_000)
    parser.add_argument("--turns", type=int, default=100)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--first-call", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--optics", action="store_true")
    parser.add_argument("--optics-of", choices=OPTICS, help=argparse.SUPPRESS)
    parser.add_argument("--memory", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.first_call:
        return print(first_call())
    if options.optics_of:
        return print(optics_time(options.optics_of))
    if options.memory:
        return print(memory(options.memory))
    rows = []

    def row(name, value, limit, below=True):
        fine = value <= limit if below else value >= limit
        rows.append(fine)
        sign = "≤" if below else "≥"
        print(
            f"{name:58} | {sign} {limit:<4g} | {value:.3g} {'' if fine else 'missed'}", flush=True
        )

    for case, (limit, *_) in OPTICS.items():
        row(f"first optics: {case} [s]", fresh("--optics-of", case), limit)
    if options.optics:
        sys.exit(int(options.check and not all(rows)))
    cell = lattice()
    ring, z, turns = rings.from_at(cell), particles(options.particles), options.turns
    jax.block_until_ready(rings.track(ring, z, turns))
    ours = least(lambda: rings.track(ring, z, turns))
    print(f"# {len(z)} particles × {turns} turns of 121 elements, {os.cpu_count()} cores")
    print(f"# ours {ours / len(z) / turns * 1e6:.3g} µs per particle and turn")
    one = theirs(cell, z, turns, False)
    all_cores = theirs(cell, z, turns, True)
    row("pyAT's time on one core over ours on all", one / ours, 3, False)
    row("pyAT's time with its processes over ours", all_cores / ours, 3, False)
    single = particles(1)
    jax.block_until_ready(rings.track(ring, single, 1000))
    alone = least(lambda: rings.track(ring, single, 1000))
    row("one particle: our time over pyAT's", alone / theirs(cell, single, 1000, False), 1)
    row("first call [s]", fresh("--first-call"), 3)
    few = jnp.asarray(particles(1000))
    columns, forward, backward = gradient(ring, few, turns)
    jax.block_until_ready((forward(columns), backward(columns)))
    count = sum(c.size for c in columns.values())
    ratio = least(lambda: backward(columns)) / least(lambda: forward(columns))
    row(f"gradient by {count} strengths over the forward run", ratio, 4)
    row("memory of a gradient, 10 000 turns over 100", fresh("--memory", "10000")
        / fresh("--memory", "100"), 1.05)  # fmt: skip
    if options.check and not all(rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
