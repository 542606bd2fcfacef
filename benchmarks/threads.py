"""Speed-up by several threads: wall-clock time of a batch on one thread over that on several.

    python benchmarks/threads.py [--threads N] [--rounds N]

Both sides run once in each round, in random order; the median of the ratios is shown, with the
quartiles. They give the same bits, which is checked. Other work on the machine shows up as a
smaller ratio: run it without other load.
"""

import argparse
import statistics

import jax
import jax.numpy as jnp
import numpy as np
from _workloads import WORKLOADS
from speed import Clock, batched, last_state

import lanewise

ROWS = (("kepler", 65536, 2000), ("oscillator", 65536, 10000), ("chain4", 8192, 500))


def measured(name: str, lanes: int, steps: int, threads: int, rounds: int) -> np.ndarray:
    """Ratios of wall-clock times, one thread over several."""
    w = WORKLOADS[name]
    inputs = [jnp.asarray(x) for x in w.start(lanes)]
    run = jax.jit(batched(last_state(w, steps)))

    def on(count: int):
        lanewise.set_threads(count)
        return jax.block_until_ready(run(*inputs))

    for a, b in zip(jax.tree.leaves(on(1)), jax.tree.leaves(on(threads)), strict=True):
        np.testing.assert_array_equal(a, b)
    wall = Clock(rounds, float("inf")).times(lambda: on(1), lambda: on(threads)).wall
    return wall[:, 0] / wall[:, 1]


def main():
    words = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    words.add_argument("--threads", type=int, default=0, help="how many (0: all)")
    words.add_argument("--rounds", type=int, default=15)
    given = words.parse_args()
    jax.config.update("jax_enable_x64", True)
    for name, lanes, steps in ROWS:
        ratios = measured(name, lanes, steps, given.threads, given.rounds)
        low, middle, high = statistics.quantiles(ratios, n=4)
        print(f"{name:12}{lanes:8} lanes {steps:6} steps   {middle:.2f} ({low:.2f}–{high:.2f})")


if __name__ == "__main__":
    main()
