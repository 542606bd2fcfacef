"""A drift sweep of 64 ε × 64 starts: memory that does not grow with the steps, and its speed.

The cubic oscillator H_D = p²/2 + q²/2, W = −q³, with the map's invariant (p² + q² − h q p)/2 as
the observable and h = 0.1, through `drift_order` (4160 trajectories with those at ε = 0). The
reference is the same arithmetic in a bare `fori_loop` over arrays of the lanes: no status, no
Newton's method, no observables of the user.

Predictions, written down before this file was run (from a trial at 2 000 steps):

1. Peak memory at 20 000 steps is within 10 MB of that at 2 000 (a saved trajectory would need
   4160 × 18 000 × 16 B = 1.2 GB more).
2. `drift_order` takes 2 to 4 times as long as the reference: it carries a status, a residual and
   the last step together with the state.
3. Drifts agree to 1e-13, and the slope is 1 to within 0.02.

Run: python benchmarks/drift.py
"""

import resource
import statistics
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

jax.config.update("jax_enable_x64", True)

H = 0.1
EPSILONS = np.geomspace(1e-4, 1e-1, 64)
STARTS = 64
NUM_STEPS = (2_000, 20_000)
ROUNDS = 7

OSCILLATOR = systems.oscillator()
CUBIC = dvi.System(OSCILLATOR.system.H_D, force=lambda t0, t1, q0, p1, args: -(q0**3))
INVARIANT = OSCILLATOR.observables["map_invariant"]


def starts():
    """Positions and momenta, shape (2, STARTS, 1)."""
    return np.random.default_rng(0).uniform(-0.5, 0.5, (2, STARTS, 1))


def sweep(num_steps):
    """The sweep of the package."""
    q, p = starts()
    return dvi.drift_order(
        CUBIC, INVARIANT, q, p, batched=True, epsilons=EPSILONS, h=H, num_steps=num_steps
    )


@jax.jit
def _bare(epsilon, q, p, num_steps):
    def step(q, p):
        p = p - H * q - H * epsilon * q**3
        q = q + H * p
        return q, p, (p * p + q * q - H * (q * p)) / 2

    def body(_, carry):
        q, p, drift = carry
        q, p, value = step(q, p)
        return q, p, jnp.maximum(drift, jnp.abs(value - first))

    q, p, first = step(q, p)
    return jax.lax.fori_loop(1, num_steps, body, (q, p, jnp.zeros_like(q)))[2]


def bare(num_steps):
    """The reference: the largest drift over the starts at each ε, shape (E + 1,)."""
    q, p = starts()[..., 0]
    shape = len(EPSILONS) + 1, STARTS
    epsilon = np.broadcast_to(np.append(EPSILONS, 0)[:, None], shape)
    drifts = _bare(epsilon, np.broadcast_to(q, shape), np.broadcast_to(p, shape), num_steps)
    return np.asarray(drifts).max(axis=1)


def peak_memory(num_steps):
    """Largest resident memory of a fresh process that runs the sweep once [MB]."""
    command = [sys.executable, __file__, "--memory", str(num_steps)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def seconds(function, num_steps):
    """Wall time of one call [s]."""
    begin = time.perf_counter()
    function(num_steps)
    return time.perf_counter() - begin


def main():
    """Print the three results and the predictions."""
    memory = [peak_memory(n) for n in NUM_STEPS]
    for n, used in zip(NUM_STEPS, memory, strict=True):
        print(f"peak memory at {n:6d} steps: {used:7.1f} MB")
    print(f"  growth {memory[1] - memory[0]:+.1f} MB (predicted: within 10)")

    n = NUM_STEPS[-1]
    print(f"first call, compilation included: {seconds(sweep, n):.2f} s")
    seconds(bare, n)
    times = [(seconds(sweep, n), seconds(bare, n)) for _ in range(ROUNDS)]
    ours, reference = (statistics.median(column) for column in zip(*times, strict=True))
    ratio = statistics.median(a / b for a, b in times)
    lane_steps = (len(EPSILONS) + 1) * STARTS * n
    print(
        f"drift_order {ours:.3f} s ({ours / lane_steps * 1e9:.2f} ns a step), bare loop "
        f"{reference:.3f} s; ratio {ratio:.2f} (predicted: 2 to 4)"
    )

    measured = sweep(n)
    difference = np.max(np.abs(measured.drifts - bare(n)[:-1]))
    print(f"largest difference of the drifts: {difference:.1e} (predicted: below 1e-13)")
    print(measured)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--memory"]:
        sweep(int(sys.argv[2]))
        # Kilobytes on Linux, bytes on macOS.
        unit = 1024**2 if sys.platform == "darwin" else 1024
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)
    else:
        main()
