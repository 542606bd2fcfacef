"""Seconds of the first fit of two parameters to 100 observations, and of the second one.

    python benchmarks/fit.py [--rounds 5] [--check]

The first fit traces and compiles its programs; each round is a process of its own, and imports are
not counted. Medians, wall and processor time. `--check`: exit status 1 if the first fit takes more
than 3 s of processor time.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time

MOST = 3.0  # s

ROWS = {"first fit": [], "first fit, check_curvature=False": ["--unchecked"]}


def one(check_curvature: bool) -> list[float]:
    """(wall, processor) of the first fit, wall of the second."""
    import jax
    import numpy as np

    import dvi_jax as dvi

    jax.config.update("jax_enable_x64", True)

    def H_D(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + args["k"] * (q0 @ q0) / 2

    system = dvi.System(H_D, force=lambda t0, t1, q0, p1, args: -p1)
    model = dvi.Model(system, h=0.05, q0=[1.0], p0=[0.0], method=dvi.Strang())
    ts = np.linspace(0.5, 30, 100)
    noise = 0.01 * np.random.default_rng(0).normal(size=100)
    seen = np.exp(-0.01 * ts) * np.cos(1.14 * ts) + noise
    data = dvi.Observations(ts, seen[:, None], sigma=0.01, t0=0.0)
    taken = []
    for _ in range(2):
        before = time.perf_counter(), time.process_time()
        start = {"epsilon": 0.0, "args": {"k": 1.2}}
        found = dvi.fit(model, data, start, check_curvature=check_curvature, progress=False)
        taken += [time.perf_counter() - before[0], time.process_time() - before[1]]
        assert found.status == "converged"
    return taken[:3]


def main() -> int:
    """Measure, print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--unchecked", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(one(not options.unchecked)))
        return 0
    print("| | first, wall s | first, processor s | second, wall s |\n| --- | --- | --- | --- |")
    late = False
    for name, extra in ROWS.items():
        runs = []
        for _ in range(options.rounds):
            command = [sys.executable, __file__, "--one", *extra]
            out = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            runs.append(json.loads(out.stdout.splitlines()[-1]))
        wall, processor, second = (statistics.median(column) for column in zip(*runs, strict=True))
        print(f"| {name} | {wall:.2f} | {processor:.2f} | {second:.3f} |", flush=True)
        late |= processor > MOST
    return int(options.check and late)


if __name__ == "__main__":
    sys.exit(main())
