"""A discovery with 45 basis functions, order 3 and 2 000 samples: its time after compilation.

The cubic oscillator H_D = p²/2 + q²/2, W = −q³, monomials up to degree 8 in (q, p) with the
constant (45), h = 0.1. The reference in the same process is NumPy's singular values of a dense
block-Toeplitz matrix of the size that the problem has without the package's compression,
4 · 1 500 rows (the fitted samples) by 180 columns: what a straightforward script would spend on
the linear algebra alone.

Predictions, written down before this file was run: under 1 s on one core, most of it in the
singular values; below three times the reference.

Run: python benchmarks/discovery.py [--against FOLDER]

With `--against`, another checkout of the package does the same in processes of its own, in turn
with this one, and the ratio of the times is printed.
"""

import argparse
import os
import re
import statistics
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np

import dvi_jax as dvi

jax.config.update("jax_enable_x64", True)

ORDER, SAMPLES, ROUNDS = 3, 2_000, 7
CUBIC = dvi.System(
    lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2,
    force=lambda t0, t1, q0, p1, args: -(q0**3),
)
BASIS = dvi.Polynomials(8, constant=True)


def discover(seed):
    """The whole call, on fresh samples."""
    qs, ps = np.random.default_rng(seed).uniform(-1, 1, (2, SAMPLES, 1))
    return dvi.discover_invariants(CUBIC, BASIS, ORDER, h=0.1, samples=(qs, ps))


def reference(matrix):
    """Null vectors of the dense matrix."""
    return np.linalg.svd(matrix, full_matrices=False)


def seconds(function, *args):
    """Wall time of one call."""
    start = time.perf_counter()
    function(*args)
    return time.perf_counter() - start


def measure():
    """Print times and their ratio, interleaved in one process."""
    first = seconds(discover, 0)
    rows = (ORDER + 1) * SAMPLES * 3 // 4
    matrix = np.random.default_rng(0).normal(size=(rows, (ORDER + 1) * 45))
    ours, theirs = [], []
    for k in range(ROUNDS):
        ours.append(seconds(discover, k + 1))
        theirs.append(seconds(reference, matrix))
    found = discover(0)
    print(f"functions {found.basis.size}, order {ORDER}, samples {SAMPLES}")
    print(f"first call, with compilation: {first:.2f} s")
    print(f"after compilation: median {statistics.median(ours):.3f} s of {ROUNDS}")
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    print(f"over dense singular values alone ({rows} × {matrix.shape[1]}): ratio {ratio:.2f}")
    print(f"invariants per order {found.survivors}, largest residual {found.residuals.max():.1e}")


def compared(folder, rounds=3):
    """Print this checkout's times over those of another, medians of the rounds."""
    ratios = {"first call, with compilation": [], "after compilation: median": []}
    for _ in range(rounds):
        ours, theirs = (_times_of(where) for where in (Path(__file__).parents[1], folder))
        for what, found in ratios.items():
            found.append(ours[what] / theirs[what])
    for what, found in ratios.items():
        print(f"{what}: {statistics.median(found):.2f} × that of {folder}")


def _times_of(folder):
    """The times that this file prints with the package of a folder, without its cache of code."""
    environment = os.environ | {"PYTHONPATH": str(Path(folder).resolve()), "DVI_JAX_CACHE": "off"}
    printed = subprocess.run(
        [sys.executable, __file__], env=environment, capture_output=True, text=True, check=True
    ).stdout
    return {what: float(t) for what, t in re.findall(r"^(.*?):? ([0-9.]+) s", printed, re.M)}


def main():
    """One measurement, or two checkouts in turn."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--against", type=Path, help="folder of another checkout")
    folder = parser.parse_args().against
    if folder is None:
        measure()
    elif (folder / "dvi_jax" / "__init__.py").is_file():
        compared(folder)
    else:
        parser.error(f"{folder} has no dvi_jax/__init__.py: give the folder of a checkout.")


if __name__ == "__main__":
    main()
