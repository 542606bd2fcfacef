"""Batches on a GPU and on the CPU of the same machine: time per step, and whether they agree.

    python benchmarks/gpu.py [--quick]
    python benchmarks/gpu.py --prepare [--carried DIR]
    python benchmarks/gpu.py --check [--carried DIR] [--out DIR] [--only STAGE ...]

`--check` checks and times the kernels of `lanewise` on a GPU in seven stages of at most 460 s in
all; its exit status is 0 if all hold, 69 if there is no GPU, and 1 otherwise. Each result is
printed at once, and also written to a file of the stage in the folder `--out` (by default $OUT, or
the current folder). `--prepare` writes what some stages require, on any machine, to `--carried`.

Two tasks in float64: Kepler orbits by Yoshida's method of order 4 (explicit), and alpha particles
in `boozer.precise_qa` by Gauss' method of order 4 (implicit, a Newton iteration in each step). The
number of trajectories is increased until a step of the whole batch takes longer. The agreement is
the largest relative difference of the final states of 64 trajectories.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import jax
import numpy as np
from _gpu_programs import alphas, kepler

import dvi_jax as dvi

jax.config.update("jax_enable_x64", True)


STEPS = 200


def timed(one, states, device):
    """(final states, seconds of compilation, seconds of a run)."""
    with jax.default_device(device):
        states = jax.device_put(states, device)
        begun = time.perf_counter()
        run = jax.jit(jax.vmap(one)).lower(*states).compile()
        compiled = time.perf_counter() - begun
        *final_states, _ = jax.block_until_ready(run(*states))
        begun = time.perf_counter()
        jax.block_until_ready(run(*states))
        return np.concatenate(final_states, axis=-1), compiled, time.perf_counter() - begun


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--prepare", action="store_true")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--stage", help="run one stage in this process")
    parser.add_argument("--only", nargs="*", default=(), help="stages of --check")
    parser.add_argument("--carried", type=Path, default=Path("build/carried"))
    parser.add_argument("--out", type=Path, default=Path(os.environ.get("OUT", "build/gpu")))
    options = parser.parse_args()
    if options.prepare or options.check or options.stage:
        import _gpu_check

        if options.prepare:
            return _gpu_check.prepare(options.carried)
        if options.stage:
            return _gpu_check.run_stage(options.stage, options.carried)
        return _gpu_check.check(options.carried, options.out, options.only)
    devices = {d.platform: d for d in (jax.devices("cpu")[0], jax.devices()[0])}
    print(", ".join(f"{name}: {d.device_kind}" for name, d in devices.items()), flush=True)
    for task in (kepler, alphas):
        few = {name: timed(*task(64, STEPS, dvi.Layout()), d)[0] for name, d in devices.items()}
        first, *others = few.values()
        scale = np.abs(first).max(0)
        for name, other in zip(list(few)[1:], others, strict=True):
            agreement = (np.abs(other - first) / scale).max()
            print(f"{task.__name__}: {name} and cpu agree to {agreement:.1e}", flush=True)
        for name, device in devices.items():
            for count in (1_000,) if options.quick else (1_000, 10_000, 100_000, 1_000_000):
                if name == "cpu" and count > 10_000:
                    continue
                _, compiled, seconds = timed(*task(count, STEPS, dvi.Layout()), device)
                print(
                    f"{task.__name__}, {name}, {count} trajectories: compilation {compiled:.1f} s, "
                    f"{seconds / STEPS * 1e6:.0f} µs a step of the batch, "
                    f"{count * STEPS / seconds:.2e} steps/s",
                    flush=True,
                )


if __name__ == "__main__":
    sys.exit(main())
