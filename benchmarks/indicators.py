"""Cost of chaos indicators relative to a plain run, and of MEGNO relative to hand-written C.

    python benchmarks/indicators.py [--lanes 256] [--steps 20000] [--rounds 7]

The system is that of Hénon and Heiles under the leapfrog. Ratios of processor times, medians of
rounds in random order in one process; one thread does the work in each. The C code has the
variational equations by hand, vectorised by the compiler over trajectories; its numbers are ours
to 1e-9, which is checked first.
"""

import argparse
import ctypes
import os
import random
import shutil
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

jax.config.update("jax_enable_x64", True)

H = 0.05
STAR = systems.henon_heiles()
KINDS = {
    "MEGNO": dvi.MEGNO(),
    "SALI": dvi.SALI(),
    "LyapunovSpectrum(1)": dvi.LyapunovSpectrum(1),
    "LyapunovSpectrum(4)": dvi.LyapunovSpectrum(4),
    "GALI(4)": dvi.GALI(4),
}


def starts(lanes):
    """Points of x = 0 on the energy shell 1/12, shape (lanes, 2)."""
    y = np.linspace(-0.25, 0.3, lanes)
    px = np.sqrt(1 / 6 - y**2 + 2 * y**3 / 3)
    return np.stack([0 * y, y], 1), np.stack([px, 0 * y], 1)


def ours(observe, lanes, steps):
    """A call that runs all lanes with this observable."""
    q, p = (jnp.asarray(x) for x in starts(lanes))

    def one(q, p):
        return dvi.integrate(
            STAR.system,
            q,
            p,
            h=H,
            num_steps=steps,
            method=dvi.Strang(),
            observe=observe,
            save=dvi.Save(final=True),
            throw=False,
        )

    run = jax.jit(jax.vmap(lambda q, p: (one(q, p).observed, one(q, p).qs)))
    return lambda: jax.block_until_ready(run(q, p))


def in_c(folder, lanes, steps):
    """A call of indicators.c, or None where there is no C compiler."""
    compiler = next(
        filter(None, map(shutil.which, [os.environ.get("CC", ""), "gcc", "cc", "clang"])), None
    )
    if compiler is None:
        return None
    target = Path(folder) / "indicators.so"
    source = Path(__file__).with_suffix(".c")
    words = [compiler, "-O3", "-ffast-math", "-march=native", "-fPIC", "-shared", str(source)]
    subprocess.run([*words, "-o", str(target), "-lm"], check=True)
    print(" ".join(words[:-1]))
    function = ctypes.CDLL(str(target)).henon_megno
    q, p = (np.ascontiguousarray(x.T) for x in starts(lanes))
    first = np.array(dvi.MEGNO().start(jnp.zeros(4))[0][0])
    megno = np.zeros(lanes)
    array = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    function.argtypes = [array] * 4 + [ctypes.c_ssize_t] * 2 + [ctypes.c_double]
    function.restype = None

    def call():
        function(q, p, first, megno, lanes, steps, H)
        return megno

    return call


def main():
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lanes", type=int, default=256)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--rounds", type=int, default=7)
    given = parser.parse_args()
    if given.lanes % 64:
        parser.error("--lanes must be a multiple of 64, the block of the C code.")
    with tempfile.TemporaryDirectory(prefix="dvi_jax_indicators_") as folder:
        calls = {"plain run": ours(None, given.lanes, given.steps)}
        calls |= {name: ours(kind, given.lanes, given.steps) for name, kind in KINDS.items()}
        c = in_c(folder, given.lanes, given.steps)
        if c is not None:
            short = ours(dvi.MEGNO(), given.lanes, 2000)()[0]
            miss = np.max(np.abs(short - in_c(folder, given.lanes, 2000)()))
            if not miss < 1e-9:
                raise SystemExit(f"the C code gives other numbers, by {miss:.1e}")
            calls["MEGNO in C"] = c
        for call in calls.values():
            call()
        seconds = {name: [] for name in calls}
        for _ in range(given.rounds):
            for name in random.sample(list(calls), len(calls)):
                began = time.process_time()
                calls[name]()
                seconds[name].append(time.process_time() - began)
        middle = {name: statistics.median(s) for name, s in seconds.items()}
        work = given.lanes * given.steps
        print(f"{given.lanes} lanes, {given.steps} steps")
        for name, s in middle.items():
            times = s / middle["plain run"]
            print(f"{name:22s} {1e9 * s / work:7.2f} ns a step {times:7.2f} plain runs")
        if c is not None:
            ratios = [a / b for a, b in zip(seconds["MEGNO"], seconds["MEGNO in C"], strict=True)]
            print(f"MEGNO over MEGNO in C: {statistics.median(ratios):.2f}")


if __name__ == "__main__":
    main()
