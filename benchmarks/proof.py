"""Proved bounds of the change of invariants in a step, next to the largest change that is found.

    python benchmarks/proof.py [--case NAME ...] [--check]
    python benchmarks/proof.py --long [--steps 10000000]

Each row: the bound of `bound_drift` for one system, the largest change at 100 000 random points of
the domain and around the largest of them (in 64-bit precision of `numpy.longdouble`), their ratio,
the number of boxes, seconds of the search and of the check of the certificate. `--check`: exit
status 1 if a bound is smaller than a change, more than 30 times larger, or larger than its limit,
or if a search takes more than its time.

`--long`: computed trajectories of 1 024 starts, and their proved lines.

`--soundness`: `--steps` computed steps (by default 10⁸) of ten programs in both ways of running,
machine code and XLA, against the proved rounding: the bound, the largest error, their ratio. The
exact step from each state is evaluated in long double, and that with the largest error in 50
digits. Exit status 1 if an error is larger than its bound.
"""

import argparse
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax.proof import checker as exact

MOST, SECONDS, FOUND = 30.0, 300.0, 100_000


class Case(NamedTuple):
    """Arguments of `bound_drift`; the largest allowed bound, and seconds; the least number of steps
    in which the domain is not left."""

    given: Callable[[], dict[str, Any]]
    limit: float = np.inf
    seconds: float = SECONDS
    steps: float = 0


def quadratic(t0, t1, q, p, args):
    return (p @ p + q @ q) / 2


CUBIC = dvi.System(quadratic, force=lambda t0, t1, q, p, args: -(q**3))
HENON_HEILES = dvi.System(
    quadratic,
    force=lambda t0, t1, q, p, args: -jnp.array([2 * q[0] * q[1], q[0] ** 2 - q[1] ** 2]),
)


def discovered(system: Any, degree: int, order: int, r: float, n: int) -> Any:
    samples = np.random.default_rng(0).uniform(-r, r, (2, 3000 if n == 1 else 800, n))
    basis = dvi.Polynomials(degree)
    return dvi.discover_invariants(system, basis, order=order, h=0.1, samples=samples)


def cubic(order: int) -> dict[str, Any]:
    found = discovered(CUBIC, 4 + 2 * order, order, 0.5, 1)
    return {"found": found, "system": CUBIC, "h": 0.1, "epsilon": 0.01, "domain": 0.5}


def henon_heiles() -> dict[str, Any]:
    found = discovered(HENON_HEILES, 5, 3, 0.3, 2)
    # The energy-like one; the other is conserved to a lower order.
    return {"found": found.invariants[-1], "system": HENON_HEILES, "h": 0.1, "epsilon": 0.01,
            "domain": np.full(2, 0.3), "ratio": 6.0}  # fmt: skip


def shadow(H: Callable, h: float) -> Callable:
    """H − (h/2) ∂H/∂q·∂H/∂p, which symplectic Euler conserves up to O(h²)."""

    def corrected(q, p, *more):
        Hq, Hp = jax.grad(H, 0)(q, p, *more), jax.grad(H, 1)(q, p, *more)
        return H(q, p, *more) - h / 2 * jnp.vdot(Hq, Hp)

    return corrected


def pendulum() -> dict[str, Any]:
    """Libration in a field that varies slowly: H = p²/2 − (1 + ε sin τ) cos q, τ = εt."""
    system = dvi.System(
        lambda t0, t1, q, p, args: p @ p / 2 - jnp.sum(jnp.cos(q)),
        force=lambda t0, t1, q, p, args: -jnp.sin(t0) * jnp.sin(q),
        slow_time=True,
    )

    def H(q, p, epsilon, t):
        return p @ p / 2 - (1 + epsilon * jnp.sin(t)) * jnp.sum(jnp.cos(q))

    return {"found": shadow(H, 0.05), "system": system, "h": 0.05, "epsilon": 0.01,
            "domain": np.array([0.8]), "time": (0.0, 6.3), "ratio": 4.0}  # fmt: skip


def kepler() -> dict[str, Any]:
    """An annulus in Cartesian coordinates, with the force −εq/|q|⁴; |L| is conserved exactly."""
    system = dvi.System(
        lambda t0, t1, q, p, args: p @ p / 2 - 1 / jnp.sqrt(q @ q),
        force=lambda t0, t1, q, p, args: -q / (q @ q) ** 2,
    )

    def H(q, p, epsilon):
        return p @ p / 2 - 1 / jnp.sqrt(q @ q) - epsilon / (2 * (q @ q))

    def momentum(q, p, epsilon):
        return q[0] * p[1] - q[1] * p[0]

    return {"found": [momentum, shadow(H, 0.01)], "system": system, "h": 0.01, "epsilon": 0.01,
            "domain": (np.full(2, 1.3), np.full(2, 1.5)), "ratio": 10.0,
            "inside": lambda q, p: jnp.stack([q @ q - 0.8**2, 1.3**2 - q @ q])}  # fmt: skip


def toda() -> dict[str, Any]:
    """Three bodies on a ring with V = Σ exp(q_i − q_{i+1}), and a perturbing force."""

    def V(q):
        return jnp.sum(jnp.exp(q - jnp.roll(q, -1)))

    def H(q, p, epsilon):
        return p @ p / 2 + V(q) + epsilon * jnp.sum((q - jnp.roll(q, -1)) ** 4) / 4

    def W(t0, t1, q, p, args):
        return -jax.grad(lambda q: jnp.sum((q - jnp.roll(q, -1)) ** 4) / 4)(q)

    def momentum(q, p, epsilon):
        return jnp.sum(p)

    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q), force=W)
    return {"found": [shadow(H, 0.1), momentum], "system": system, "h": 0.1, "epsilon": 0.01,
            "domain": np.full(3, 0.2), "ratio": 4.0}  # fmt: skip


def double_pendulum() -> dict[str, Any]:
    """Implicit steps with trigonometric functions, at low energy."""
    problem = dvi.systems.double_pendulum()
    H_D, args = problem.system.H_D, problem.args
    system = dvi.System(H_D, force=lambda t0, t1, q, p, args: -(q**3))

    def H(q, p, epsilon):
        return H_D(0.0, 0.0, q, p, args) + epsilon * jnp.sum(q**4) / 4

    return {"found": shadow(H, 0.02), "system": system, "h": 0.02, "epsilon": 0.01, "args": args,
            "domain": np.full(2, 0.1), "ratio": 4.0}  # fmt: skip


def standard_map() -> dict[str, Any]:
    """p1 = p + ε sin q, q1 = q + p1."""
    system = dvi.System(
        lambda t0, t1, q, p, args: p @ p / 2, force=lambda t0, t1, q, p, args: jnp.sin(q)
    )

    def H(q, p, epsilon):
        return p @ p / 2 + epsilon * jnp.sum(jnp.cos(q))

    return {"found": shadow(H, 1.0), "system": system, "h": 1.0, "epsilon": 0.1,
            "domain": (np.array([3.2]), np.array([0.5])), "ratio": 3.0}  # fmt: skip


def mcmillan() -> dict[str, Any]:
    """In x = q1 and y = q0: x' = −y + 2x/(1 + x²), with a biquadratic invariant."""
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + q @ q - jnp.sum(jnp.log(1 + q * q)))

    def invariant(q, p, epsilon):
        x, y = q[0], q[0] - p[0]
        return x**2 * y**2 + x**2 + y**2 - 2 * x * y

    return {"found": invariant, "system": system, "h": 1.0, "epsilon": 0.1,
            "domain": np.array([0.5])}  # fmt: skip


CASES = {
    "cubic, order 1": Case(lambda: cubic(1), 1.7e-7),
    "cubic, order 2": Case(lambda: cubic(2), 1.3e-9),
    "cubic, order 3": Case(lambda: cubic(3), 8e-12),
    "Hénon-Heiles, order 3": Case(henon_heiles, 1e-13, 60.0, 9e9),
    "pendulum, slow time": Case(pendulum),
    "Kepler, annulus": Case(kepler),
    "Toda, 3 bodies": Case(toda),
    "double pendulum": Case(double_pendulum),
    "standard map": Case(standard_map),
    "McMillan map": Case(mcmillan, 0.0),
}


class Extended:
    """The arithmetic of `numpy.longdouble` for the `run` of the checker."""

    @staticmethod
    def constant(value):
        return np.longdouble(value.numerator) / np.longdouble(value.denominator)

    @staticmethod
    def sum(*terms):
        return sum(terms[1:], terms[0])

    @staticmethod
    def multiply(a, b):
        return a * b

    @staticmethod
    def apply(name, a):
        if name == "inverse":
            return 1 / a
        return getattr(np, f"arc{name[1:]}" if name[0] == "a" else name)(a)


def changes(checker: Any, k: int, points: np.ndarray) -> np.ndarray:
    """|I_k(Φ(x)) − I_k(x)| at points (q, p, t, ε), or (q, p1, t, ε); 0 outside of the domain."""
    x, n, h = list(points.T.astype(np.longdouble)), checker.n, Extended.constant(checker.h)
    with np.errstate(all="ignore"):
        start, end = x[:-2], exact.run(checker.step, [*x, h], Extended)
        if checker.implicit:
            moves, p1 = end[:n], x[n:-2]
            end = [*end[n:], *p1]
            start = [*x[:n], *(a - b for a, b in zip(p1, moves, strict=True))]
        t1 = x[-2] + (h * x[-1] if checker.slow else h)
        before = exact.run(checker.invariants[k], [*start, *x[-2:], h], Extended)[0]
        after = exact.run(checker.invariants[k], [*end, t1, x[-1], h], Extended)[0]
        sides = zip(start, checker.lower, checker.upper, strict=True)
        inside = np.all([(a >= float(b)) & (a <= float(c)) for a, b, c in sides], axis=0)
        for g in exact.run(checker.inside, [*start, *x[-2:]], Extended):
            inside &= g >= 0
        change = np.abs(after - before)
    return np.where(inside & np.isfinite(change), change, 0).astype(float)


def largest_change(checker: Any, k: int, count: int = FOUND) -> float:
    """The largest change at random points, then in smaller and smaller neighbourhoods of the
    largest ones."""
    rng = np.random.default_rng(0)
    low, high = np.array(checker.root(), float).T
    points = rng.uniform(low, high, (count, len(low)))
    points[: count // 2, -1] = high[-1]
    corners = rng.choice([0.0, 0.5, 1.0], (count // 4, len(low)))
    points[: count // 4] = low + corners * (high - low)
    for scale in (0, *0.1 * 0.5 ** np.arange(12)):
        values = changes(checker, k, points)
        top = points[np.argsort(-values)[:50]]
        near = np.repeat(top, 40, axis=0)
        near = np.clip(near + scale * rng.normal(size=near.shape) * (high - low), low, high)
        points = np.concatenate([top, near])
    return float(np.max(changes(checker, k, points)))


def row(name: str) -> list[str]:
    """Measure and print one row. Returns what is wrong with it."""
    case, wrong = CASES[name], []
    given = case.given()
    began = time.perf_counter()
    bound = dvi.bound_drift(**given, max_seconds=case.seconds)
    taken = time.perf_counter() - began
    began = time.perf_counter()
    exact.check(bound.certificate)
    checked = time.perf_counter() - began
    checker = exact.Checker(bound.certificate)
    for k, b in enumerate(bound.per_step):
        seen = largest_change(checker, k)
        floor = 1e-18 if b == 0 else 0.0  # rounding of the extended precision
        ratio = b / seen if seen > floor else float(b > 0)
        steps = f"{bound.num_steps(bound.change, k):10.3g}"
        numbers = f"{b:10.3g} {seen:10.3g} {ratio:6.2f} {steps} {bound.boxes:6d}"
        confined = "yes" if bound.level else "no"
        print(f"{name:22} I_{k} {numbers} {taken:8.1f} {checked:7.1f} {confined:>8}", flush=True)
        if not (seen <= max(b, floor) and ratio <= MOST and b <= case.limit):
            wrong.append(f"{name}: bound {b:.3g} for a change of {seen:.3g}, limit {case.limit:g}")
    if bound.steps < case.steps:
        wrong.append(f"{name}: confined for {bound.steps:.3g} steps")
    if taken > case.seconds:
        wrong.append(f"{name}: {taken:.0f} s")
    return wrong


def exact_energy(q, p, epsilon):
    """Conserved exactly by the map of H = (p² + q²)/2 with h = 0.1."""
    return (p @ p + q @ q - 0.1 * (q @ p)) / 2


def long_run(name: str, steps: int) -> list[str]:
    """1 024 computed trajectories and their proved line, for an invariant of order 1 and for one
    that only the rounding changes."""
    given = cubic(1)
    if name == "rounding":
        spring = dvi.System(quadratic)
        given |= {"found": exact_energy, "system": spring, "domain": np.array([0.5])}
    bound = dvi.bound_drift(**given)
    r, found = 0.5 * bound.start, given["found"]
    quantity = (lambda q, p: found(q, p, 0)) if callable(found) else found.invariants[0]
    observe = {"I": dvi.MaxDrift(quantity)}
    how = {"h": 0.1, "num_steps": steps, "observe": observe, "save": dvi.Save(final=True)}
    how |= {} if callable(found) else {"epsilon": 0.01}

    @jax.jit
    @jax.vmap
    def run(q, p):
        sol = dvi.integrate(given["system"], q, p, **how)
        return sol.observed["I"], sol.result == dvi.RESULTS.successful

    began = time.perf_counter()
    drift, good = run(*np.random.default_rng(1).uniform(-r, r, (2, 1024, 1)))
    line = steps * (bound.per_step[0] + bound.rounding[0])
    print(f"{name}: largest drift of 1024 starts in {steps} steps {float(np.max(drift)):.3g}, "
          f"proved {line:.3g}, {time.perf_counter() - began:.0f} s", flush=True)  # fmt: skip
    fits = bool(np.all(good)) and float(np.max(drift)) < line
    return [] if fits else [f"{name}: a drift above the line"]


def soundness(steps: int) -> int:
    """Print a row for each program and way of running. Returns the exit status."""
    # Here, because tests run this file from another folder.
    from _soundness import LAYOUTS, ROUNDED, rounding

    wrong = []
    for name in ROUNDED:
        for way in LAYOUTS:
            text, faults = rounding(name, way, steps // (len(ROUNDED) * len(LAYOUTS)))
            print(text, flush=True)
            wrong += faults
    print(*wrong, sep="\n")
    return int(bool(wrong))


def main() -> int:
    """Measure, print a table."""
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--case", choices=CASES, action="append")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--soundness", action="store_true")
    parser.add_argument("--steps", type=int)
    options = parser.parse_args()
    if options.soundness:
        return soundness(options.steps or 10**8)
    if options.long:
        names, steps = ("rounding", "cubic, order 1"), options.steps or 10**7
        wrong = [text for name in names for text in long_run(name, steps)]
    else:
        print(f"{'':26} {'bound':>10} {'found':>10} {'ratio':>6} {'N(1e-3)':>10} {'boxes':>6} "
              f"{'search s':>8} {'check s':>7} {'confined':>8}")  # fmt: skip
        wrong = [text for name in options.case or CASES for text in row(name)]
    print(*wrong, sep="\n")
    return int(options.check and bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
