"""Time per step of each root solver, relative to Newton's method.

    python benchmarks/root_solvers.py [--rows PATTERN] [--rounds N] [--out FILE]

In each round every solver runs the same trajectories once, in random order; times are processor
times of this process on one core, medians of the rounds. Layout and compiler options are those of
a plain `jax.jit(jax.vmap(integrate))`: machine code of `lanewise` if the functions are small
enough. Every row also has the iterations per step, whether all trajectories succeeded, and the
largest difference to Newton's states relative to the largest state.

Rows: ten bodies (the Sun and nine planets on circles; n = 30) with forces that depend a little on
the momenta: the first post-Newtonian Hamiltonian, and a drag of 1e-6 a day; chains with masses that
depend on the positions, tridiagonal Jacobian, n = 2 … 100; the same with all pairs coupled, a full
Jacobian; Gauss's method on the ten bodies and on three; and, as controls, pendulums with a drag so
strong that fixed-point iteration cannot converge.

Predictions, written before the first run, when Newton's method made one correction for each
Jacobian and XLA compiled all of it:

1. Ten bodies, one trajectory: a Newton iteration is some 30 directional derivatives of the rate (in
   one vectorised call), an LU of 30 × 30 and one residual; Picard's is one rate. Both make two
   iterations. Picard 5 to 10 times as fast as Newton, simplified Newton nearly twice.
2. Batch of ten bodies: arrays for all of them; LAPACK goes lane by lane, so 10 times and more.
3. Chains, one trajectory, h = 0.02: Picard needs five to six iterations to Newton's three; equal
   at n = 4 to 10, 3 times as fast at n = 30, 10 times at n = 100.
4. Chains in a batch, in components: Newton's two iterations with a band cost about as much
   as six of Picard's at any n: equal within 1.5. Full Jacobian: Picard faster from n = 10 on.
5. Simplified Newton goes through LAPACK above four unknowns: slower than Newton there.
6. Controls: Picard fails with status `not_converged`; the default, which tries it first for many
   unknowns, costs at most 1.3 times Newton's method.
"""

import argparse
import fnmatch
import json
import statistics
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _workloads import chain, web
from speed import Clock

import dvi_jax as dvi
from dvi_jax import systems

jax.config.update("jax_enable_x64", True)

SOLVERS = {
    "Newton": dvi.Newton(),
    "SimplifiedNewton": dvi.SimplifiedNewton(),
    "Picard": dvi.Picard(),
    "PicardThenNewton": dvi.PicardThenNewton(),
}

MASSES = np.array([
    2.959122e-4, 4.912550e-11, 7.243452e-10, 8.997011e-10, 9.549549e-11,
    2.825346e-7, 8.459706e-8, 1.292025e-8, 1.524359e-8, 2.178441e-12,
])  # fmt: skip
"""GM of the Sun and nine planets [au³/day²]."""

DISTANCES = np.array([0.0, 0.387, 0.723, 1.0, 1.524, 5.203, 9.537, 19.19, 30.07, 39.48])
LIGHT = 173.1446
"""au/day."""


def newtonian(t0, t1, q0, p1, args):
    """Kinetic energy and attraction of bodies with these GM."""
    m = jnp.asarray(MASSES, q0.dtype)
    _, weight = _pairs(q0, m)
    return jnp.sum(jnp.sum(p1**2, -1) / m) / 2 - jnp.sum(weight) / 2


def relativistic(t0, t1, q0, p1, args):
    r"""`newtonian` and the first post-Newtonian energy, with v = p/m and r̂ from body b to a.

    (1/c²) [−Σ m v⁴/8 − Σ_{a≠b} (G m_a m_b/r)(12 v_a² − 14 v_a·v_b − 2 (r̂·v_a)(r̂·v_b))/8
            + Σ_a m_a (Σ_{b≠a} G m_b/r)²/2]
    """
    m = jnp.asarray(MASSES, q0.dtype)
    v = p1 / m[:, None]
    unit, weight = _pairs(q0, m)
    square = jnp.sum(v**2, -1)
    along, along_other = jnp.einsum("abk,ak->ab", unit, v), jnp.einsum("abk,bk->ab", unit, v)
    mixed = 12 * square[:, None] - 14 * v @ v.T - 2 * along * along_other
    first = -jnp.sum(m * square**2) / 8 - jnp.sum(weight * mixed) / 8
    first += jnp.sum(jnp.sum(weight, 1) ** 2 / m) / 2
    return newtonian(t0, t1, q0, p1, args) + first / LIGHT**2


def _pairs(q, m):
    """Unit vectors (a, b, 3) and m_a m_b / r, zero for a body with itself."""
    itself = jnp.eye(len(m), dtype=bool)
    apart = q[:, None] - q[None]
    r = jnp.sqrt(jnp.where(itself, 1.0, jnp.sum(apart**2, -1)))
    return apart / r[..., None], jnp.where(itself, 0.0, m[:, None] * m / r)


def drag(t0, t1, q0, p1, args):
    """W = −p/(1 + |q|²) of each body."""
    return -p1 / (1 + jnp.sum(q0**2, -1, keepdims=True))


def separate_pendulums(t0, t1, q0, p1, args):
    """Σ (p²/2 − cos q)."""
    return jnp.sum(p1**2) / 2 - jnp.sum(jnp.cos(q0))


def strong_drag(t0, t1, q0, p1, args):
    """W = −p − p³ + cos t: at ε = 30 and h = 0.1 fixed-point iteration trebles each error."""
    return -p1 - p1**3 + jnp.cos(t0)


def planets(lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """Circles about the Sun, in somewhat other directions on each lane: (lanes, 10, 3)."""
    angle = np.linspace(0, 5, 10) + np.random.default_rng(7).uniform(0, 0.1, (lanes, 10))
    e = np.stack([np.cos(angle), np.sin(angle), 0.02 * np.sin(3 * angle)], -1)
    along = np.stack([-np.sin(angle), np.cos(angle), 0.06 * np.cos(3 * angle)], -1)
    speed = np.sqrt(MASSES[0] / np.maximum(DISTANCES, 0.1)) * (DISTANCES > 0)
    q, p = DISTANCES[:, None] * e, (MASSES * speed)[:, None] * along
    drift = p.sum(1, keepdims=True) / MASSES.sum()
    return q, p - MASSES[:, None] * drift


class Row(NamedTuple):
    """A system, its starts (lanes, *shape), and how it is run."""

    system: dvi.System
    q0: np.ndarray
    p0: np.ndarray
    h: float
    steps: int
    epsilon: float = 0.0
    method: dvi.Method = dvi.TypeII()


def _box(system, n: int, lanes: int, h: float, steps: int, width=0.3) -> Row:
    q, p = np.random.default_rng(5).uniform(-width, width, (2, lanes, n))
    return Row(system, q, p, h, steps)


def _name(of: str, lanes: int) -> str:
    return f"{of}, {lanes} " + ("trajectory" if lanes == 1 else "trajectories")


def rows() -> dict[str, Row]:
    """All rows by name."""
    of_planets = {
        "ten bodies, relativity": (dvi.System(relativistic), 0.0),
        "ten bodies, drag": (dvi.System(newtonian, force=drag), 1e-6),
    }
    made = {}
    for name, (system, epsilon) in of_planets.items():
        for lanes, steps in ((1, 1000), (64, 200)):
            made[_name(name, lanes)] = Row(system, *planets(lanes), 0.5, steps, epsilon)
    gauss = dvi.GaussLegendre(2)
    relativity = of_planets["ten bodies, relativity"][0]
    made["ten bodies, Gauss, 1 trajectory"] = Row(relativity, *planets(1), 0.5, 200, 0.0, gauss)
    for n in (2, 4, 10, 20, 30, 100):
        made[f"chain {n}, 1 trajectory"] = _box(
            dvi.System(chain), n, 1, 0.02, 2000 if n < 100 else 200
        )
    for n in (2, 4, 10, 20, 30):
        made[f"chain {n}, 256 trajectories"] = _box(dvi.System(chain), n, 256, 0.02, 400)
    for n in (10, 20):
        made[f"full {n}, 1 trajectory"] = _box(dvi.System(web), n, 1, 0.02, 2000)
        made[f"full {n}, 256 trajectories"] = _box(dvi.System(web), n, 256, 0.02, 400)
    two = systems.n_body()
    made["figure eight, Gauss, 1 trajectory"] = Row(
        two.system, two.q0[None], two.p0[None], 0.05, 1000, 0.0, gauss
    )
    pendulums = dvi.System(separate_pendulums, force=strong_drag)
    for n in (2, 20):
        for lanes, steps in ((1, 1000), (256, 400)):
            row = _box(pendulums, n, lanes, 0.1, steps)
            made[_name(f"control, drag {n}", lanes)] = row._replace(epsilon=30.0)
    return made


def runner(row: Row, solver: dvi.RootSolver, args: Any):
    """All lanes at once, and the arrays to call it with."""

    def one(q0, p0):
        sol = dvi.integrate(
            row.system,
            q0,
            p0,
            h=row.h,
            num_steps=row.steps,
            epsilon=row.epsilon,
            args=args,
            method=row.method,
            newton=solver,
            save=dvi.Save(final=True),
            throw=False,
        )
        good = sol.result == dvi.RESULTS.successful
        return sol.qs[-1], sol.ps[-1], good, sol.stats["newton_iterations"]

    start = jnp.asarray(row.q0), jnp.asarray(row.p0)
    if len(row.q0) == 1:
        call = jax.jit(one)
        start = (start[0][0], start[1][0])
    else:
        call = jax.jit(jax.vmap(one))
    return lambda: call(*start)


def measure(name: str, row: Row, clock: Clock) -> dict[str, Any]:
    """Ratios of time to Newton's method, and iterations."""
    args = systems.n_body().args if name.startswith("figure") else None
    calls = [runner(row, solver, args) for solver in SOLVERS.values()]
    outs = [jax.tree.map(np.asarray, call()) for call in calls]
    times = clock.times(*calls)
    lanes = len(row.q0)
    seconds = np.median(times.processor, axis=0)
    found = {"seconds_per_step": float(seconds[0] / row.steps / lanes), "solvers": {}}
    size = max(np.nanmax(np.abs(x)) for x in outs[0][:2])
    for i, key in enumerate(SOLVERS):
        q, p, good, iterations = outs[i]
        found["solvers"][key] = {
            "ratio": statistics.median((times.processor[:, i] / times.processor[:, 0]).tolist()),
            "iterations": float(np.mean(iterations) / row.steps),
            "failed": int(lanes - np.sum(good)),
            "difference": float(max(np.max(np.abs(q - outs[0][0])), np.max(np.abs(p - outs[0][1]))))
            / float(size),
        }
    return found


def table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown: time over Newton's (iterations per step) of each solver."""
    heads = ["", "Newton, µs", *(f"{s}" for s in SOLVERS)]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for name, found in results.items():
        cells = []
        for of in found["solvers"].values():
            text = f"{of['ratio']:.2f} ({of['iterations']:.1f})"
            cells.append("fails" if of["failed"] else text)
        micro = f"{found['seconds_per_step'] * 1e6:.3g}"
        lines.append("| " + " | ".join([name, micro, *cells]) + " |")
    return "\n".join(lines)


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--rows", default="*", help="pattern of names, such as 'chain*'")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--out", help="file for all figures as JSON")
    given = parser.parse_args(argv)
    clock = Clock(given.rounds, budget=20.0)
    results = {}
    for name, row in rows().items():
        if fnmatch.fnmatch(name, given.rows):
            results[name] = measure(name, row, clock)
            differences = [f"{of['difference']:.0e}" for of in results[name]["solvers"].values()]
            print(name, "differences:", *differences, file=sys.stderr)
    print(table(results))
    if given.out:
        with open(given.out, "w") as file:
            json.dump(results, file, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
