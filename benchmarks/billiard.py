"""Reflections of a billiard relative to hand-written C.

    python benchmarks/billiard.py [--reflections 1000000] [--h 0.5] [--rounds 7]

Sinai's billiard with one trajectory, and with 64 in a batch. billiard.c has two programs: one makes
the same steps, checks and searches of a root; the other solves for the next wall in closed form,
which only a free flight allows. One processor core; medians of the ratios of processor times, in
random order. First the programs are compared: a few reflections agree to 1e-12 (later ones differ,
since the motion is chaotic), and the number of reflections of a long run to 1 %.
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

TABLE = systems.sinai_billiard(max_jumps=0)
RADIUS = 0.5
LANES = 64


def starts(lanes):
    angles = np.linspace(0.1, 1.4, lanes)
    q = np.tile([0.8, 0.1], (lanes, 1))
    return q, np.stack([np.cos(angles), np.sin(angles)], axis=1)


def ours(lanes, h, steps):
    """A call that runs all lanes, and returns the reflections of all, and the last states."""

    def one(q, p):
        sol = dvi.integrate(
            TABLE, q, p, h=h, num_steps=steps, method="TypeII", save=dvi.Save(final=True),
            throw=False,
        )  # fmt: skip
        return sol.jumps.count, sol.qs[-1], sol.ps[-1]

    run = jax.jit(one if lanes == 1 else jax.vmap(one))
    q, p = (jnp.asarray(x[0] if lanes == 1 else x) for x in starts(lanes))
    return lambda: jax.block_until_ready(run(q, p))


def in_c(folder):
    """Functions (name, lanes, h, steps) → a call with the same results, or None without C."""
    names = [os.environ.get("CC", ""), "gcc", "cc", "clang"]
    compiler = next(filter(None, map(shutil.which, names)), None)
    if compiler is None:
        return None
    target = Path(folder) / "billiard.so"
    words = [compiler, "-O3", "-march=native", "-fPIC", "-shared", "-o", str(target)]
    subprocess.run([*words, str(Path(__file__).with_suffix(".c")), "-lm"], check=True)
    library = ctypes.CDLL(str(target))
    library.steps.restype = library.exact.restype = ctypes.c_long

    def call(name, lanes, h, steps):
        number, array = ctypes.c_double, ctypes.POINTER(ctypes.c_double)

        def run():
            q, p = (np.ascontiguousarray(x) for x in starts(lanes))
            rest = [number(h), ctypes.c_long(steps)] if name == "steps" else [number(h * steps)]
            count = 0
            for i in range(lanes):
                state = [x[i].ctypes.data_as(array) for x in (q, p)]
                count += getattr(library, name)(*state, number(RADIUS), *rest)
            return count, q, p

        return run

    return call


def ratios(rounds, mine, theirs):
    """Ratios of processor times, and seconds of both."""
    order, samples = random.Random(0), []
    for call in (mine, theirs):
        call()
    for _ in range(rounds):
        seconds = {}
        for name, call in order.sample([("mine", mine), ("theirs", theirs)], 2):
            began = time.process_time()
            call()
            seconds[name] = time.process_time() - began
        samples.append((seconds["mine"] / seconds["theirs"], seconds["mine"], seconds["theirs"]))
    return [statistics.median(column) for column in zip(*samples, strict=True)]


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reflections", type=int, default=1_000_000)
    parser.add_argument("--h", type=float, default=0.5)
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        call = in_c(folder)
        if call is None:
            print("no C compiler: nothing to compare with")
            return 1
        q, p = ours(1, options.h, 12)()[1:]
        for name in ("steps", "exact"):
            _, q_c, p_c = call(name, 1, options.h, 12)()
            np.testing.assert_allclose(q, q_c[0], atol=1e-9)
            np.testing.assert_allclose(p, p_c[0], atol=1e-9)
        print(
            f"{'trajectories':>12} {'C program':>10} {'reflections':>12} {'ns each':>8} {'× C':>6}"
        )
        for lanes in (1, LANES):
            steps = round(options.reflections / lanes * 0.9 / options.h)
            mine = ours(lanes, options.h, steps)
            count = int(jnp.sum(mine()[0]))
            for name in ("steps", "exact"):
                theirs = call(name, lanes, options.h, steps)
                assert abs(theirs()[0] / count - 1) < 0.02
                ratio, seconds, _ = ratios(options.rounds, mine, theirs)
                row = f"{lanes:>12} {name:>10} {count:>12} {seconds / count * 1e9:>8.0f}"
                print(f"{row} {ratio:>6.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
