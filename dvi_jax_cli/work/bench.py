"""A short benchmark: four workloads and named references that take the same steps."""

import importlib.util
import math
import os
import platform
import random
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from .._names import VERSION
from .._show import Table

H = 0.05
EPSILON = 1e-3
TRAJECTORIES = 4096
_SETTING = (
    f"Kepler's problem under the perturbing force −εq, ε = {EPSILON}, h = {H}, double precision; "
    "pendulums for the implicit row"
)
_A = np.array([[0.25, 0.25 - math.sqrt(3) / 6], [0.25 + math.sqrt(3) / 6, 0.25]])
"""Butcher's matrix of the Gauss–Legendre method of order 4."""

State = tuple[Any, Any]


class Row(NamedTuple):
    """A workload: functions of the start that return (q, p), and how far these may differ.

    - `steps`: of all trajectories, the same for the package and for each reference.
    """

    what: str
    start: State
    steps: int
    own: Callable[..., Any]
    references: dict[str, Callable[..., Any]]
    tolerance: float | None


# The problem, twice: for the package, and in NumPy


def _energy(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 - 1 / jnp.sqrt(q0 @ q0)


def _pendulum(t, q, p, args):
    return jnp.sum(p * p) / 2 - jnp.sum(jnp.cos(q))


_KEPLER = dvi.System(_energy, force=lambda t0, t1, q0, p1, args: -q0)
_PENDULUM = dvi.System(dvi.discretise(_pendulum))


def _last(system: dvi.System, method: dvi.Method, steps: int, epsilon: float = EPSILON):
    """(q0, p0) → last state, by `dvi.integrate`."""
    options: dict[str, Any] = {"h": H, "num_steps": steps, "epsilon": epsilon, "method": method}

    def run(q0, p0):
        found = dvi.integrate(system, q0, p0, save=dvi.Save(final=True), throw=False, **options)
        return found.qs[-1], found.ps[-1]

    return run


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
    """The same map for many trajectories at once, shape (trajectories, 2), in NumPy."""
    q, p = q.T.copy(), p.T.copy()
    for _ in range(steps):
        r2 = q[0] * q[0] + q[1] * q[1]
        p -= H * (1 / (r2 * np.sqrt(r2)) + EPSILON) * q
        q += H * p
    return q.T, p.T


def _numpy_gauss(q, p, steps: int):
    """Gauss–Legendre of order 4 for many pendulums, shape (trajectories, 1): stages by fixed
    point."""
    q, p = q[:, 0].copy(), p[:, 0].copy()
    force = -np.sin(q) * np.ones((2, 1))
    momenta = force
    for _ in range(steps):
        for _ in range(30):
            momenta = p + H * (_A @ force)
            before, force = force, -np.sin(q + H * (_A @ momenta))
            if np.max(np.abs(force - before)) < 1e-15:
                break
        q = q + H * (momenta[0] + momenta[1]) / 2
        p = p + H * (force[0] + force[1]) / 2
    return q[:, None], p[:, None]


def _diffrax(steps: int) -> Callable[..., Any]:
    """Semi-implicit Euler of diffrax, which is this map."""
    import diffrax

    # Its first part goes first: momenta with the old positions, positions with the new momenta.
    terms = (
        diffrax.ODETerm(lambda t, q, args: -q / jnp.sqrt(q @ q) ** 3 - EPSILON * q),
        diffrax.ODETerm(lambda t, p, args: p),
    )
    method, end = diffrax.SemiImplicitEuler(), steps * H

    @jax.jit
    def run(q, p):
        found = diffrax.diffeqsolve(terms, method, 0.0, end, H, (p, q), max_steps=steps + 8)
        momenta, positions = cast(Any, found.ys)
        return positions[-1], momenta[-1]

    return run


# The rows

_ONE: State = np.array([1.0, 0.0]), np.array([0.0, 1.1])
_STEPS = 20_000


def _single() -> Row:
    references: dict[str, Any] = {"Python floats": lambda q, p: _python_loop(q, p, _STEPS)}
    if importlib.util.find_spec("diffrax"):
        references["diffrax"] = _diffrax(_STEPS)
    what = f"one orbit, {_STEPS} steps of TypeII; reference: the same map on Python's floats and, "
    what += "where it is installed, in diffrax (SemiImplicitEuler)"
    own = jax.jit(_last(_KEPLER, dvi.TypeII(), _STEPS))
    return Row(what, _ONE, _STEPS, own, references, 1e-6)


def _batch() -> Row:
    steps, size, random = 500, TRAJECTORIES, np.random.default_rng(0)
    angle, speed = random.uniform(0, 2 * np.pi, size), random.uniform(0.9, 1.15, size)
    q = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    p = speed[:, None] * np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    own = jax.jit(jax.vmap(_last(_KEPLER, dvi.TypeII(), steps)))
    references = {"NumPy": lambda q, p: _numpy_loop(q, p, steps)}
    what = f"{size} orbits by vmap, {steps} steps of TypeII; reference: the same in NumPy"
    return Row(what, (q, p), size * steps, own, references, 1e-8)


def _implicit() -> Row:
    steps, size = 100, TRAJECTORIES // 4
    q = np.linspace(-1.5, 1.5, size)[:, None]
    own = jax.jit(jax.vmap(_last(_PENDULUM, dvi.GaussLegendre(2), steps, 0.0)))
    references = {"NumPy, fixed point": lambda q, p: _numpy_gauss(q, p, steps)}
    what = f"{size} pendulums by vmap, {steps} steps of GaussLegendre(2); reference: NumPy"
    return Row(what, (q, np.zeros_like(q)), size * steps, own, references, 1e-9)


def _gradient() -> Row:
    last = _last(_KEPLER, dvi.TypeII(), _STEPS)

    def size(q, p):
        q1, p1 = last(q, p)
        return q1 @ q1 + p1 @ p1

    own = jax.jit(jax.grad(size, argnums=(0, 1)))
    what = f"gradient by the start, {_STEPS} steps of TypeII; reference: the final state alone"
    return Row(what, _ONE, _STEPS, own, {"forward pass": jax.jit(size)}, None)


ROWS = {"single": _single, "batch": _batch, "implicit": _implicit, "gradient": _gradient}


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
        row = ROWS[name]()
        note(f"{name}: {row.what}")
        rows += [{"row": name, "what": row.what, **found} for found in _timed(row, rounds)]
    progress(len(names), len(names))
    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} processors"
    return {
        "machine": f"{machine}, JAX on {jax.local_devices()[0].device_kind}",
        "versions": {"dvi-jax": VERSION, "jax": jax.__version__, "numpy": np.__version__},
        "setting": _SETTING,
        "rounds": rounds,
        "rows": rows,
    }


def _timed(row: Row, rounds: int) -> list[dict[str, Any]]:
    """The package compared with each of the references of a row."""

    def call(side: Callable[..., Any]) -> tuple[float, Any]:
        began = time.perf_counter()
        result = jax.block_until_ready(side(*row.start))
        return time.perf_counter() - began, result

    sides, shuffled = [row.own, *row.references.values()], random.Random(0)
    # The first call of each compiles, and gives the results that are compared.
    first, ends = zip(*map(call, sides), strict=True)
    seconds = np.zeros((rounds, len(sides)))
    order = list(range(len(sides)))
    for k in range(rounds):
        shuffled.shuffle(order)
        for i in order:
            seconds[k, i], _ = call(sides[i])
    typical, found = np.median(seconds, axis=0), []
    for i, name in enumerate(row.references, 1):
        ratios = seconds[:, i] / seconds[:, 0]
        low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75], method="weibull").tolist()
        differ, agrees = None, True
        if row.tolerance is not None:
            both = zip(ends[0], ends[i], strict=True)
            differ = float(np.max([np.max(np.abs(x - y)) for x, y in both]))
            agrees = differ <= row.tolerance  # NaN does not
        found.append(
            {
                "reference": name,
                "steps_per_second": row.steps / typical[0],
                "reference_steps_per_second": row.steps / typical[i],
                "ratio": middle,
                "quartiles": [low, high],
                "compilation_seconds": max(0.0, first[0] - typical[0]),
                "largest_difference": differ,
                "agrees": agrees,
            }
        )
    return found


def tables(found: dict[str, Any]) -> list[Table]:
    """The measurements as tables."""
    names, rows = ("steps_per_second", "reference_steps_per_second", "ratio"), []
    for r in found["rows"]:
        speeds = [f"{r[name]:.3g}" for name in names]
        quartiles = " … ".join(f"{x:.3g}" for x in r["quartiles"])
        compiling = f"{r['compilation_seconds']:.1f} s"
        rows.append([r["row"], r["reference"], *speeds, quartiles, compiling])
    about = [[name, what] for name, what in {r["row"]: r["what"] for r in found["rows"]}.items()]
    title = f"Speed and references, {found['rounds']} rounds (ratio above 1: dvi_jax is faster)"
    columns = ["row", "reference", "steps/s", "theirs", "ratio", "quartiles", "compiling"]
    return [Table("Workloads", ["row", "what it is"], about), Table(title, columns, rows)]
