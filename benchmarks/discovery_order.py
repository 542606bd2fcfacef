"""Invariants of order 6 in ε with two degrees of freedom: time of the search, and drift in a step.

Cubic oscillators of two degrees of freedom at h = 0.1, with the force of Hénon and Heiles,
W = −(2 q1 q2, q1² − q2²), and the squares 1 and `w` of the frequencies: w = 1 is the system of
Hénon and Heiles, and w = 2 has two independent invariants. A term of order m is a polynomial of
degree m + 2, so that order z requires Polynomials(z + 2): 494 functions at order 6.

Each search runs in a process of its own, and its time includes compilation. The change of each
series in one step is then computed in exact arithmetic at ε = 1/2 and 1/4: it has to scale as
ε^(z+1). In a control, a coefficient of order ⌊z/2⌋ is wrong by 1 %, and the power has to fall to
⌊z/2⌋.

Run: python benchmarks/discovery_order.py [--order 6] [--check]

`--check` exits with 1 if a search takes 10 s or more, or a power differs by 0.3 or more. Other work
on the same processors makes the times several times longer, unless the linear algebra has one
thread: OPENBLAS_NUM_THREADS=1.
"""

import argparse
import json
import subprocess
import sys
import time
from fractions import Fraction

import numpy as np

LIMIT, WITHIN, H = 10.0, 0.3, 0.1
SYSTEMS = {"Hénon–Heiles": 1.0, "frequencies 1 and √2": 2.0}
EPSILONS = Fraction(1, 2), Fraction(1, 4)


def search(w, order):
    """Print time, invariants per order and coefficients as JSON."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    import dvi_jax as dvi

    squares = jnp.array([1.0, w])
    system = dvi.System(
        lambda t0, t1, q0, p1, args: (p1 @ p1 + squares @ q0**2) / 2,
        force=lambda t0, t1, q0, p1, args: -jnp.array([2 * q0[0] * q0[1], q0[0] ** 2 - q0[1] ** 2]),
    )
    basis = dvi.Polynomials(order + 2)
    count = 2 * basis.for_shape((2,)).size + 20
    samples = np.random.default_rng(0).uniform(-0.3, 0.3, (2, count, 2))
    start = time.perf_counter()
    found = dvi.discover_invariants(system, basis, order, h=H, samples=samples)
    seconds = time.perf_counter() - start
    result = {
        "seconds": seconds,
        "survivors": found.survivors,
        "series": np.asarray(found.coefficients).tolist(),
        "powers": found.basis.function.counts.tolist(),
        "warnings": found.warnings,
    }
    print(json.dumps(result))


def change(series, powers, w, epsilon):
    """The largest change of a series in one step over four states, exact."""
    h, squares = Fraction(H), (1, Fraction(w))

    def value(x):
        monomials = [
            np.prod([Fraction(y) ** k for y, k in zip(x, ks, strict=True)]) for ks in powers
        ]
        return sum(
            epsilon**m * sum(Fraction(c) * y for c, y in zip(cs, monomials, strict=True) if c)
            for m, cs in enumerate(series)
        )

    largest = Fraction(0)
    for numerators in np.random.default_rng(1).integers(-40, 40, (4, 4)).tolist():
        q1, q2, p1, p2 = (Fraction(n, 128) for n in numerators)
        force = -2 * q1 * q2, q2**2 - q1**2
        P = [
            p + h * (-s * q + epsilon * f)
            for p, s, q, f in zip((p1, p2), squares, (q1, q2), force, strict=True)
        ]
        Q = [q1 + h * P[0], q2 + h * P[1]]
        largest = max(largest, abs(value((*Q, *P)) - value((q1, q2, p1, p2))))
    return largest


def power(series, powers, w):
    """The power of ε with which the change scales."""
    large, small = (change(series, powers, w, e) for e in EPSILONS)
    return float(np.log2(float(large / small)))


def main(arguments=None):
    """A line for each system and each invariant; 1 if a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--order", type=int, default=6)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--search", type=float, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.search is not None:
        return search(given.search, given.order)
    missed, order = False, given.order
    for name, w in SYSTEMS.items():
        command = [sys.executable, __file__, "--order", str(order), "--search", str(w)]
        printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        found = json.loads(printed)
        missed |= found["seconds"] >= LIMIT or not found["series"]
        print(
            f"{name}: {len(found['powers'])} functions, {found['seconds']:.1f} s with compilation"
        )
        print(f"  conserved up to each order: {found['survivors']}")
        for warning in found["warnings"]:
            print(f"  warning: {warning}")
        for series in found["series"]:
            wrong, m = np.array(series), order // 2
            wrong[m, np.argmax(np.abs(wrong[m]))] *= 1.01
            of_found, of_wrong = (power(s, found["powers"], w) for s in (series, wrong.tolist()))
            missed |= abs(of_found - order - 1) >= WITHIN or abs(of_wrong - m) >= WITHIN
            print(
                f"  change in a step ∝ ε^{of_found:.2f}; with a wrong coefficient ε^{of_wrong:.2f}"
            )
    return int(missed and given.check)


if __name__ == "__main__":
    sys.exit(main())
