"""A short benchmark: four workloads and named references that take the same steps."""

import math
import os
import platform
import random
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from .._session import version
from .._show import Table

H = 0.05
EPSILON = 1e-3
LANES = 4096
_SETTING = (
    f"Kepler's problem under the perturbing force −εq, ε = {EPSILON}, h = {H}, double precision; "
    "pendulums for the implicit row"
)
_A = np.array([[0.25, 0.25 - math.sqrt(3) / 6], [0.25 + math.sqrt(3) / 6, 0.25]])
"""Butcher's matrix of the Gauss–Legendre method of order 4."""


class Side(NamedTuple):
    """One side of a row: its name, `call` () → final (q, p), steps of all trajectories."""

    name: str
    call: Callable[[], Any]
    steps: int


class Row(NamedTuple):
    """A workload: the package's side, its references, and how far they may differ."""

    name: str
    what: str
    own: Side
    references: list[Side]
    tolerance: float | None


# The problem, twice: for the package, and in NumPy


def _energy(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 - 1 / jnp.sqrt(q0 @ q0)


def _drag(t0, t1, q0, p1, args):
    return -q0


def _pendulum(t, q, p, args):
    return jnp.sum(p * p) / 2 - jnp.sum(jnp.cos(q))


_KEPLER = dvi.System(_energy, force=_drag)
_PENDULUM = dvi.System(dvi.discretise(_pendulum))


def _python_loop(q, p, steps: int):
    """The type II map of one trajectory, on Python's floats: p1 from q0, then q1 from p1."""
    (x, y), (u, v) = map(float, q), map(float, p)
    for _ in range(steps):
        r2 = x * x + y * y
        k = 1 / (r2 * math.sqrt(r2)) + EPSILON
        u, v = u - H * k * x, v - H * k * y
        x, y = x + H * u, y + H * v
    return np.array([x, y]), np.array([u, v])


def _numpy_loop(q, p, steps: int):
    """The same map for many trajectories at once, shape (lanes, 2), in NumPy."""
    q, p = q.T.copy(), p.T.copy()
    for _ in range(steps):
        r2 = q[0] * q[0] + q[1] * q[1]
        p -= H * (1 / (r2 * np.sqrt(r2)) + EPSILON) * q
        q += H * p
    return q.T, p.T


def _numpy_gauss(q, p, steps: int):
    """Gauss–Legendre of order 4 for many pendulums, shape (lanes, 1): stages by fixed point."""
    q, p = q[:, 0].copy(), p[:, 0].copy()
    force = -np.sin(q) * np.ones((2, 1))
    momenta = force
    for _ in range(steps):
        for _ in range(30):
            momenta = p + H * (_A @ force)
            positions = q + H * (_A @ momenta)
            new = -np.sin(positions)
            done = np.max(np.abs(new - force)) < 1e-15
            force = new
            if done:
                break
        q = q + H * (momenta[0] + momenta[1]) / 2
        p = p + H * (force[0] + force[1]) / 2
    return q[:, None], p[:, None]


# The rows


def _single() -> Row:
    steps = 20_000
    q, p = np.array([1.0, 0.0]), np.array([0.0, 1.1])
    run = jax.jit(_last(_KEPLER, dvi.TypeII(), steps))
    references = [Side("Python floats", lambda: _python_loop(q, p, steps), steps)]
    references += _diffrax(q, p, steps)
    what = f"one orbit, {steps} steps of TypeII; reference: the same map on Python's floats and, "
    what += "where it is installed, in diffrax (SemiImplicitEuler)"
    return Row("single", what, Side("", lambda: run(q, p), steps), references, 1e-6)


def _diffrax(q: np.ndarray, p: np.ndarray, steps: int) -> list[Side]:
    """Semi-implicit Euler of diffrax, which is this map; nothing where it is not installed."""
    try:
        import diffrax
    except ImportError:
        return []

    def pull(t, q, args):
        return -q / jnp.sqrt(q @ q) ** 3 - EPSILON * q

    def drift(t, p, args):
        return p

    # Its first part goes first: momenta with the old positions, positions with the new momenta.
    terms = diffrax.ODETerm(pull), diffrax.ODETerm(drift)

    @jax.jit
    def run(q, p):
        found = diffrax.diffeqsolve(
            terms, diffrax.SemiImplicitEuler(), 0.0, steps * H, H, (p, q), max_steps=steps + 8
        )
        momenta, positions = cast(Any, found.ys)
        return positions[-1], momenta[-1]

    return [Side("diffrax", lambda: run(q, p), steps)]


def _batch() -> Row:
    steps = 500
    q, p = _orbits()
    run = jax.jit(jax.vmap(_last(_KEPLER, dvi.TypeII(), steps)))
    reference = Side("NumPy", lambda: _numpy_loop(q, p, steps), LANES * steps)
    what = f"{LANES} orbits by vmap, {steps} steps of TypeII; reference: the same in NumPy"
    return Row("batch", what, Side("", lambda: run(q, p), LANES * steps), [reference], 1e-8)


def _implicit() -> Row:
    steps, lanes = 100, LANES // 4
    q = np.linspace(-1.5, 1.5, lanes)[:, None]
    p = np.zeros_like(q)
    run = jax.jit(jax.vmap(_last(_PENDULUM, dvi.GaussLegendre(2), steps, 0.0)))
    reference = Side("NumPy, fixed point", lambda: _numpy_gauss(q, p, steps), lanes * steps)
    what = f"{lanes} pendulums by vmap, {steps} steps of GaussLegendre(2); reference: NumPy"
    return Row("implicit", what, Side("", lambda: run(q, p), lanes * steps), [reference], 1e-9)


def _gradient() -> Row:
    steps = 20_000
    q, p = np.array([1.0, 0.0]), np.array([0.0, 1.1])
    last = _last(_KEPLER, dvi.TypeII(), steps)

    def size(q, p):
        q1, p1 = last(q, p)
        return q1 @ q1 + p1 @ p1

    forward, gradient = jax.jit(size), jax.jit(jax.grad(size, argnums=(0, 1)))
    what = f"gradient by the start, {steps} steps of TypeII; reference: the final state alone"
    reference = Side("forward pass", lambda: forward(q, p), steps)
    return Row("gradient", what, Side("", lambda: gradient(q, p), steps), [reference], None)


_ROWS = {"single": _single, "batch": _batch, "implicit": _implicit, "gradient": _gradient}


def _last(system: dvi.System, method: dvi.Method, steps: int, epsilon: float = EPSILON):
    """(q0, p0) → last state, by `dvi.integrate`."""

    def run(q0, p0):
        found = dvi.integrate(
            system, q0, p0, h=H, num_steps=steps, epsilon=epsilon, method=method,
            save=dvi.Save(final=True), throw=False,
        )  # fmt: skip
        return found.qs[-1], found.ps[-1]

    return run


def _orbits() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    angle = random.uniform(0, 2 * np.pi, LANES)
    speed = random.uniform(0.9, 1.15, LANES)
    q = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return q, speed[:, None] * np.stack([-np.sin(angle), np.cos(angle)], axis=1)


# Measuring


def measure(
    names: Sequence[str],
    rounds: int,
    progress: Callable[[int, int], None],
    note: Callable[[str], None],
) -> dict[str, Any]:
    """Each row: every side once in each round, in random order; ratios within a round."""
    rows = []
    for i, name in enumerate(names):
        progress(i, len(names))
        row = _ROWS[name]()
        note(f"{name}: {row.what}")
        rows += _timed(row, rounds)
    progress(len(names), len(names))
    return {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} processors, "
        f"JAX on {jax.local_devices()[0].device_kind}",
        "versions": {"dvi-jax": version(), "jax": jax.__version__, "numpy": np.__version__},
        "setting": _SETTING,
        "rounds": rounds,
        "rows": rows,
    }


def _timed(row: Row, rounds: int) -> list[dict[str, Any]]:
    sides = [row.own, *row.references]
    first, ends = [], []
    for side in sides:  # compilation and results
        began = time.perf_counter()
        ends.append(jax.tree.map(np.asarray, jax.block_until_ready(side.call())))
        first.append(time.perf_counter() - began)
    seconds = np.zeros((rounds, len(sides)))
    order = list(range(len(sides)))
    shuffled = random.Random(0)
    for k in range(rounds):
        shuffled.shuffle(order)
        for i in order:
            began = time.perf_counter()
            jax.block_until_ready(sides[i].call())
            seconds[k, i] = time.perf_counter() - began
    found = []
    for i, side in enumerate(sides[1:], 1):
        ratios = (row.own.steps / seconds[:, 0]) / (side.steps / seconds[:, i])
        low, _, high = statistics.quantiles(ratios.tolist(), n=4)
        differ = None if row.tolerance is None else _difference(ends[0], ends[i])
        agrees = differ is None or (row.tolerance is not None and differ <= row.tolerance)
        found.append({
            "row": row.name,
            "what": row.what,
            "reference": side.name,
            "steps_per_second": row.own.steps / float(np.median(seconds[:, 0])),
            "reference_steps_per_second": side.steps / float(np.median(seconds[:, i])),
            "ratio": float(np.median(ratios)),
            "quartiles": [low, high],
            "compilation_seconds": max(0.0, first[0] - float(np.median(seconds[:, 0]))),
            "largest_difference": differ,
            "agrees": agrees,
        })  # fmt: skip
    return found


def _difference(a: Any, b: Any) -> float:
    """The largest difference of two states; infinite where one is not finite."""
    found = float(np.max([np.max(np.abs(x - y)) for x, y in zip(a, b, strict=True)]))
    return found if math.isfinite(found) else math.inf


def tables(found: dict[str, Any]) -> list[Table]:
    """The measurements as tables."""
    rows = [
        [
            r["row"], r["reference"], f"{r['steps_per_second']:.3g}",
            f"{r['reference_steps_per_second']:.3g}",
            f"{r['ratio']:.3g}", f"{r['quartiles'][0]:.3g} … {r['quartiles'][1]:.3g}",
            f"{r['compilation_seconds']:.1f} s",
        ]
        for r in found["rows"]
    ]  # fmt: skip
    about = [[name, what] for name, what in {r["row"]: r["what"] for r in found["rows"]}.items()]
    return [
        Table("Workloads", ["row", "what it is"], about),
        Table(
            f"Speed and references, {found['rounds']} rounds (ratio above 1: dvi_jax is faster)",
            ["row", "reference", "steps/s", "theirs", "ratio", "quartiles", "compiling"],
            rows,
        ),
    ]
