"""Cost of a sweep relative to the bare kernel, in time and in memory, and scaling of Dask workers.

    python benchmarks/sweep.py rate [--lanes 1000000] [--steps 10000] [--rounds 3]
    python benchmarks/sweep.py dask [--tasks 128]
    python benchmarks/sweep.py cost

rate: trajectories of the perturbed Kepler problem with three streamed invariants, written to a
store, on all cores; for comparison the bare kernel, the same reductions of the same states without
sweep, store or starts: `jax.jit(jax.vmap(one))` on 2¹⁷ of these trajectories, its time scaled
to their number. Both once in each round, in random order, in one process; the sweep compiles in a
round before. The largest memory is that of the process, over all rounds.

cost: what `dvi.sweep_cost` says of that sweep and of larger ones.

dask: the same sweep, in tasks of the size that `sweep` chooses, on one worker of one thread and on
two, each a process of its own, started before; seconds from the call to the last commit, the
compilation in each worker included.
"""

import argparse
import random
import resource
import shutil
import statistics
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

KERNEL_LANES = 2**17
EPSILON = 1e-4
H = 0.05
LOW, HIGH = ([0.8, -0.1], [-0.1, 0.8]), ([1.2, 0.1], [0.1, 1.2])

KEPLER = systems.LIBRARY["kepler"]()


def eccentricity(t0, t1, q0, p0, q1, p1, args):
    """Laplace, Runge and Lenz's vector, its first component."""
    momentum = q1[0] * p1[1] - q1[1] * p1[0]
    return p1[1] * momentum - args["K"] * q1[0] / jnp.linalg.norm(q1)


OBSERVE = {
    "energy": dvi.MaxDrift(KEPLER.observables["energy"]),
    "angular_momentum": dvi.Range(KEPLER.observables["angular_momentum"]),
    "eccentricity": dvi.Mean(eccentricity),
}


def arguments(lanes: int, steps: int) -> dict:
    return {
        "system": KEPLER.system,
        "start": dvi.starts.Halton(lanes, LOW, HIGH),
        "epsilon": dvi.Axis("epsilon", [EPSILON]),
        "args": KEPLER.args,
        "h": H,
        "num_steps": steps,
        "observe": OBSERVE,
    }


def sweep(lanes: int, steps: int, store: str, **kw):
    return dvi.sweep(**arguments(lanes, steps), store=store, **kw)


def bare(steps: int):
    """The kernel and its states."""

    def one(q0, p0):
        sol = dvi.integrate(
            KEPLER.system,
            q0,
            p0,
            h=H,
            num_steps=steps,
            epsilon=EPSILON,
            args=KEPLER.args,
            observe=OBSERVE,
            save=dvi.Save(final=True),
            throw=False,
        )
        return sol.observed, sol.result

    start = dvi.starts.Halton(KERNEL_LANES, LOW, HIGH)
    states = jax.vmap(lambda i: start.at(i, 0.0, None))(jnp.arange(KERNEL_LANES))
    return jax.jit(jax.vmap(one)), states


def seconds(f, *args) -> float:
    began = time.perf_counter()
    jax.block_until_ready(f(*args))
    return time.perf_counter() - began


def rate(lanes: int, steps: int, rounds: int) -> None:
    kernel, states = bare(steps)
    seconds(kernel, *states)
    with tempfile.TemporaryDirectory() as folder:
        seconds(lambda: sweep(2**14, steps, f"{folder}/first").tasks_done)

        def whole():
            shutil.rmtree(f"{folder}/s", ignore_errors=True)
            found = sweep(lanes, steps, f"{folder}/s")
            assert found.status_counts() == {"successful": lanes}

        ratios, rng = [], random.Random(0)
        for _ in range(rounds):
            sides = {whole: (), kernel: states}
            order = list(sides)
            rng.shuffle(order)
            taken = {f: seconds(f, *sides[f]) for f in order}
            of_kernel = taken[kernel] * lanes / KERNEL_LANES
            ratios.append(of_kernel / taken[whole])
            print(
                f"sweep {taken[whole]:.2f} s ({lanes * steps / taken[whole]:.3g} steps/s), kernel "
                f"{of_kernel:.2f} s: {ratios[-1]:.2f} of its rate",
                flush=True,
            )
        size = sum(f.stat().st_size for f in Path(folder, "s").rglob("*") if f.is_file())
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"rate, median: {statistics.median(ratios):.2f} of the bare kernel (target 0.80)")
    print(f"memory, largest: {memory:.2f} GiB (target 2); store: {size / 2**20:.0f} MiB")


def dask(tasks: int) -> None:
    from distributed import Client, LocalCluster

    lanes, steps = 16384, 10_000
    taken = {}
    with tempfile.TemporaryDirectory() as folder:
        for workers in (1, 2, 1, 2):
            with (
                LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    host="127.0.0.1",
                    dashboard_address=None,
                ) as cluster,
                Client(cluster) as client,
            ):
                for i in range(2):  # the first compiles
                    n = (tasks if i else 2 * workers) * lanes
                    path = f"{folder}/{workers}-{i}"
                    shutil.rmtree(path, ignore_errors=True)
                    began = time.perf_counter()
                    sweep(n, steps, path, client=client, lanes_per_task=lanes)
                taken.setdefault(workers, []).append(time.perf_counter() - began)
            print(f"{workers} workers: {taken[workers][-1]:.2f} s for {tasks} tasks", flush=True)
    speedup = min(taken[1]) / min(taken[2])
    print(f"two workers: {speedup:.2f} times one (target 1.8)")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("rate", "dask", "cost"))
    parser.add_argument("--lanes", type=int, default=1_000_000)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--tasks", type=int, default=128)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}, NumPy {np.__version__}")
    if options.what == "rate":
        rate(options.lanes, options.steps, options.rounds)
    elif options.what == "cost":
        found = dvi.sweep_cost(**arguments(options.lanes, options.steps))
        print(found, found.table(), sep="\n\n")
    else:
        dask(options.tasks)


if __name__ == "__main__":
    main()
