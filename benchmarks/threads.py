"""What `dvi.over_threads` gains: wall-clock time of a batch on one thread over that on several.

    python benchmarks/threads.py [--threads N] [--rounds N]

Both sides run once in each round, in random order; the median of the ratios is shown, with the
quartiles. They give the same bits, which is checked. Other work on the machine shows up as a
smaller ratio: run it when there is none.
"""

import argparse
import random
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np
from _workloads import EPSILON, WORKLOADS

import dvi_jax as dvi

ROWS = (("kepler", 65536, 2000), ("oscillator", 65536, 10000), ("chain4", 8192, 500))


def batch_of(name: str, steps: int):
    """A jitted batch, lanes last, to its last states and status."""
    w = WORKLOADS[name]

    def one(q0, p0):
        sol = dvi.integrate(
            w.system,
            q0,
            p0,
            h=w.h,
            num_steps=steps,
            epsilon=EPSILON,
            args=w.args,
            save=dvi.Save(final=True),
            throw=False,
        )
        return sol.qs[-1], sol.ps[-1], sol.result

    options = {"xla_cpu_prefer_vector_width": 512}
    return jax.jit(jax.vmap(one, in_axes=-1, out_axes=-1), compiler_options=options)


def seconds(f, *args) -> float:
    began = time.perf_counter()
    jax.block_until_ready(f(*args))
    return time.perf_counter() - began


def measured(name: str, lanes: int, steps: int, threads: int | None, rounds: int) -> list[float]:
    """Ratios of wall-clock times, one thread over several."""
    inputs = [jnp.asarray(x) for x in WORKLOADS[name].start(lanes)]
    one = batch_of(name, steps)
    several = dvi.over_threads(one, threads, in_axes=-1, out_axes=-1)
    for a, b in zip(jax.tree.leaves(one(*inputs)), jax.tree.leaves(several(*inputs)), strict=True):
        np.testing.assert_array_equal(a, b)
    ratios = []
    for _ in range(rounds):
        sides = [one, several]
        random.shuffle(sides)
        taken = {f: seconds(f, *inputs) for f in sides}
        ratios.append(taken[one] / taken[several])
    return ratios


def main():
    words = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    words.add_argument("--threads", type=int, help="how many (all that this process may use)")
    words.add_argument("--rounds", type=int, default=15)
    given = words.parse_args()
    jax.config.update("jax_enable_x64", True)
    for name, lanes, steps in ROWS:
        ratios = measured(name, lanes, steps, given.threads, given.rounds)
        low, middle, high = statistics.quantiles(ratios, n=4)
        print(f"{name:12}{lanes:8} lanes {steps:6} steps   {middle:.2f} ({low:.2f}–{high:.2f})")


if __name__ == "__main__":
    main()
