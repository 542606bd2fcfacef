"""Invariants of order 6 to 8 in ε, two degrees of freedom: time of the search, drift in a step.

Cubic oscillators of two degrees of freedom at h = 0.1, with the force of Hénon and Heiles,
W = −(2 q1 q2, q1² − q2²), and the squares 1 and `w` of the frequencies: w = 1 is the system of
Hénon and Heiles, and w = 2 has two independent invariants. A term of order m is a polynomial of
degree m + 2, so that order z requires Polynomials(z + 2): 494 functions at order 6, 714 at order 7,
1000 at order 8. `--pairs` computes the null space in pairs of numbers, with 31 digits.

Each search runs in a process of its own, and its time includes compilation. The change of each
series in one step is then computed in exact arithmetic at ε = 1 and 1/2: it has to scale as
ε^(z+1). In a control, a coefficient of order ⌊z/2⌋ is wrong by 10 %, and the power at ε = 1/8 and
1/16 has to fall to ⌊z/2⌋. The leading-order term is compared with the energies of the two
oscillators of the map at ε = 0, E_i = p_i²/2 + w_i q_i²/2 − h w_i q_i p_i/2.

With `--damping RATE` the force is W − RATE · p, and nothing is conserved at order 1. In float64 a
rate of 1e-14 is not seen.

Run: python benchmarks/discovery_order.py [--order 6] [--pairs] [--damping 1e-14] [--check]

`--check` exits with 1 if a search takes 10 s or more (300 s in pairs), is undecided, or finds
nothing (something, with damping), or if a power differs by 0.3 or more. Other work on the same
processors makes the times several times longer, unless the linear algebra has one thread:
OPENBLAS_NUM_THREADS=1.
"""

import argparse
import json
import subprocess
import sys
import time
from fractions import Fraction

import numpy as np

LIMIT, IN_PAIRS, WITHIN, H = 10.0, 300.0, 0.3, 0.1
SYSTEMS = {"Hénon–Heiles": 1.0, "frequencies 1 and √2": 2.0}
EPSILONS = Fraction(1), Fraction(1, 2)
SMALLER = Fraction(1, 8), Fraction(1, 16)  # for the control, whose change is far above rounding


def search(w, order, in_pairs, damping):
    """Print time, invariants per order and coefficients as JSON."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    import dvi_jax as dvi

    squares = jnp.array([1.0, w])
    system = dvi.System(
        lambda t0, t1, q0, p1, args: (p1 @ p1 + squares @ q0**2) / 2,
        force=lambda t0, t1, q0, p1, args: (
            -jnp.array([2 * q0[0] * q0[1], q0[0] ** 2 - q0[1] ** 2]) - damping * p1
        ),
    )
    arithmetic = dvi.DoubleDouble() if in_pairs else dvi.FloatingPoint()
    basis = dvi.Polynomials(order + 2)
    count = 2 * basis.for_shape((2,)).size + 20
    samples = np.random.default_rng(0).uniform(-0.3, 0.3, (2, count, 2))
    start = time.perf_counter()
    found = dvi.discover_invariants(
        system, basis, order, h=H, samples=samples, arithmetic=arithmetic
    )
    seconds = time.perf_counter() - start
    result = {
        "seconds": seconds,
        "survivors": found.survivors,
        "gap": found.gap,
        "undecided": found.undecided,
        "residual": float(np.max(found.residuals, initial=0.0)),
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


def power(series, powers, w, epsilons):
    """The power of ε with which the change scales."""
    large, small = (change(series, powers, w, e) for e in epsilons)
    return float(np.log2(float(large / small)))


def leading(series, powers, w):
    """The leading-order term as a combination of E_1 and E_2, and the rest of it."""
    energies = np.zeros((2, len(powers)))
    for i, square in enumerate((1.0, w)):
        q, p = np.eye(4, dtype=int)[[i, i + 2]]
        for term, c in ((2 * q, square / 2), (2 * p, 0.5), (q + p, -H * square / 2)):
            energies[i, powers.index(term.tolist())] = c
    found = np.linalg.lstsq(energies.T, series[0])[0]
    return found, np.linalg.norm(found @ energies - series[0])


def main(arguments=None):
    """A line for each system and each invariant; 1 if a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--order", type=int, default=6)
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--damping", type=float, default=0.0)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--search", type=float, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.search is not None:
        return search(given.search, given.order, given.pairs, given.damping)
    missed, order = False, given.order
    for name, w in SYSTEMS.items():
        command = [sys.executable, __file__, "--order", str(order), "--search", str(w)]
        command += ["--damping", str(given.damping), *(["--pairs"] if given.pairs else [])]
        printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        found = json.loads(printed)
        missed |= found["seconds"] >= (IN_PAIRS if given.pairs else LIMIT)
        missed |= bool(found["series"]) == bool(given.damping) or bool(found["undecided"])
        print(
            f"{name}: {len(found['powers'])} functions, {found['seconds']:.1f} s with compilation"
        )
        print(f"  conserved up to each order: {found['survivors']}, gap {found['gap']:.1e}")
        print(f"  undecided: {found['undecided']}, largest residual {found['residual']:.1e}")
        for warning in found["warnings"]:
            print(f"  warning: {warning}")
        for series in found["series"]:
            (a, b), rest = leading(series, found["powers"], w)
            print(f"  leading-order term {a:.6f} E1 + {b:.6f} E2, the rest of it is {rest:.1e}")
            wrong, m = np.array(series), order // 2
            wrong[m, np.argmax(np.abs(wrong[m]))] *= 1.1
            of_found = power(series, found["powers"], w, EPSILONS)
            of_wrong = power(wrong.tolist(), found["powers"], w, SMALLER)
            missed |= abs(of_found - order - 1) >= WITHIN or abs(of_wrong - m) >= WITHIN
            print(
                f"  change in a step ∝ ε^{of_found:.2f}; with a wrong coefficient ε^{of_wrong:.2f}"
            )
    return int(missed and given.check)


if __name__ == "__main__":
    sys.exit(main())
