"""Measurements on the Kepler problem: Figures 4 and 5, the sweeps of (49) and (50)."""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

from .numbers import Tick, largest, relative_spread, run, slope

DURATION = 200.0
"""Time over which ranges and drifts are taken; about five revolutions."""


def _quarter_turn(v):
    return jnp.stack([-v[1], v[0]])


_TURN: Any = {
    "xi": lambda t, q, p, args: _quarter_turn(q),
    "eta": lambda t, q, p, args: _quarter_turn(p),
}

ROTATION = dvi.Generator(**_TURN)
"""The rotation (40); its series in ε, (46), has it twice."""

CLOCKED_ROTATION = dvi.Generator(xi0=lambda t, q, p, args: jnp.ones_like(t), **_TURN)
"""The rotation with a shift of time (41)."""


def gauge(t, q, p, args):
    """−|q|²/2, the paper's gauge of order 1 for (47), per ε."""
    return -jnp.sum(q**2) / 2


INVARIANT_49 = dvi.AdiabaticInvariant([ROTATION, ROTATION], [None, None])
INVARIANT_50 = dvi.AdiabaticInvariant([CLOCKED_ROTATION, CLOCKED_ROTATION], [None, gauge])
"""(50) as printed, with (1+ε) before the energy: ξ0 = 1 + ε, although (47) says ξ0 = 1."""


@dataclass(frozen=True)
class MeshSweep:
    """(42), (43), (49) and (50) by the variational map, t = 200, over h and ε.

    `hs` (H,), `epsilons` (E,) with 0 first. Ranges (H, E): `spread_50`; `relative_49`, relative
    to the initial value. ε = 0 is (43) and (42). `ts`, `values_50` (E, N): the run at the first h.
    """

    hs: np.ndarray
    epsilons: np.ndarray
    spread_50: np.ndarray
    relative_49: np.ndarray
    ts: np.ndarray
    values_50: np.ndarray


@dataclass(frozen=True)
class SmallStepSweep:
    """(50) as h → 0: order-4 composition, h = 0.01, t = 200, against ε.

    Largest distances from the first value (E,), ε = 0 first: `attracting` for the force −εq,
    `repelling` for +εq (NaN where the orbit becomes unbound), `literal` for
    (1+ε)L − H − ε|q|²/2 under −εq, the invariant for ξ0 = 1 of (47). `ts`, `values` (E, N): (50)
    along the runs under −εq.
    """

    h: float
    epsilons: np.ndarray
    attracting: np.ndarray
    repelling: np.ndarray
    literal: np.ndarray
    ts: np.ndarray
    values: np.ndarray

    def beyond_zero(self, drifts: np.ndarray) -> np.ndarray:
        """Drift minus that of ε = 0, which is the error of the method, not of the invariant."""
        return drifts[1:] - drifts[0]

    def exponent(self, drifts: np.ndarray) -> float:
        """Exponent of ε in drifts (E − 1,), between ε = 1e-4 and 2e-4."""
        low, high = (list(self.epsilons[1:]).index(e) for e in (1e-4, 2e-4))
        return slope(self.epsilons[1:][[low, high]], drifts[[low, high]])


@dataclass(frozen=True)
class LongRun:
    """10⁵ steps of one method at the paper's h = 0.1, ε = 0.

    `qs` (N, 2); `energy_errors` (N,) relative; `momentum_errors` (N,) absolute;
    `apocentre_radii` (R,): where the orbit crosses the direction in which the exact orbit has
    its apocentre, once per revolution; `turn`: angle by which the ellipse turns per revolution
    [rad].
    """

    name: str
    ts: np.ndarray
    qs: np.ndarray
    energy_errors: np.ndarray
    momentum_errors: np.ndarray
    apocentre_radii: np.ndarray
    turn: float

    @property
    def width(self) -> float:
        """Width of the drawn loop at the apocentre."""
        return float(np.ptp(self.apocentre_radii))

    def error_at(self, part: float) -> float:
        """Largest relative energy error in the first `part` of the run."""
        return largest(self.energy_errors[: int(part * len(self.energy_errors))])


def mesh_sweep(tick: Tick) -> MeshSweep:
    """The ranges of (49) and (50) on fixed meshes."""
    problem = systems.kepler()
    hs = np.array([0.1, 0.05, 0.02, 0.01])
    epsilons = np.array([0.0, 1e-4, 1e-3, 1e-2, 1e-1])
    observe = {"49": INVARIANT_49, "50": INVARIANT_50}
    runs = []
    for i, h in enumerate(hs):
        run_of = functools.partial(run, problem, h, round(DURATION / h), observe=observe)
        runs.append(jax.vmap(lambda e, run_of=run_of: run_of(epsilon=e))(jnp.asarray(epsilons)))
        tick((i + 1) / len(hs))
    return MeshSweep(
        hs=hs,
        epsilons=epsilons,
        spread_50=np.stack([np.ptp(run.observed["50"], axis=-1) for run in runs]),
        relative_49=np.stack([relative_spread(run.observed["49"]) for run in runs]),
        ts=np.asarray(runs[0].ts)[0, 1:],
        values_50=np.asarray(runs[0].observed["50"]),
    )


def small_step_sweep(tick: Tick) -> SmallStepSweep:
    """The drift of (50) against ε as h → 0, for both signs of the force."""
    problem = systems.kepler()
    h, epsilons = 0.01, np.array([0.0, 5e-5, 1e-4, 2e-4, 1e-3, 1e-2])
    momentum, energy = problem.observables["angular_momentum"], problem.observables["energy"]

    # The energy is the continuous one: H_{k−1} over a step of six parts has an error O(h).
    def of_print(*step):
        epsilon, q1 = step[-1]["epsilon"], step[4]
        return (1 + epsilon) * (momentum(*step) - energy(*step)) - epsilon * jnp.sum(q1**2) / 2

    def literal(*step):
        epsilon, q1 = step[-1]["epsilon"], step[4]
        return (1 + epsilon) * momentum(*step) - energy(*step) - epsilon * jnp.sum(q1**2) / 2

    def orbit(strength, epsilon):
        drifts = {"printed": dvi.MaxDrift(of_print), "literal": dvi.MaxDrift(literal)}
        options = {"epsilon": strength, "args": {**problem.args, "epsilon": epsilon}}
        options |= {"observe": {"values": of_print, **drifts}, "save": dvi.Save(every=10)}
        return run(problem, h, round(DURATION / h), method=dvi.Yoshida(4), **options)

    # W = −q: a negative ε is the force +|ε|q, while the formulas have |ε|.
    strengths = np.concatenate([epsilons, -epsilons])
    runs = jax.vmap(orbit)(jnp.asarray(strengths), jnp.asarray(np.abs(strengths)))
    drifts = np.asarray(runs.observed["printed"])
    repelling = drifts[len(epsilons) :]
    farthest = np.max(np.linalg.norm(np.asarray(runs.qs), axis=-1), axis=-1)[len(epsilons) :]
    return SmallStepSweep(
        h=h,
        epsilons=epsilons,
        attracting=drifts[: len(epsilons)],
        repelling=np.where(farthest < 100, repelling, np.nan),
        literal=np.asarray(runs.observed["literal"])[: len(epsilons)],
        ts=np.asarray(runs.ts)[0, 1:],
        values=np.asarray(runs.observed["values"])[: len(epsilons)],
    )


METHODS: dict[str, Any] = {
    "RK4": dvi.RungeKutta4(),
    "variational (order 1)": dvi.TypeII(),
    "variational (order 2, Strang)": dvi.Strang(),
    "variational (order 4, Yoshida)": dvi.Yoshida(4),
}


def long_runs(tick: Tick) -> dict[str, LongRun]:
    """Figure 4: 10⁵ steps by RK4, by the paper's map, and by its compositions."""
    problem = systems.kepler()
    q0, p0 = np.array(problem.q0), np.array(problem.p0)
    energy0 = p0 @ p0 / 2 - 1 / np.linalg.norm(q0)
    momentum0 = q0[0] * p0[1] - q0[1] * p0[0]
    pericentre = _eccentricity_vector(q0[None], p0[None])[0]
    apocentre = np.arctan2(-pericentre[1], -pericentre[0])
    runs = {}
    for i, (name, method) in enumerate(METHODS.items()):
        observe = {k: problem.observables[k] for k in ("energy", "angular_momentum")}
        solution = run(problem, problem.h, 100_000, method=method, observe=observe)
        ts, qs, ps = (np.asarray(x) for x in (solution.ts, solution.qs, solution.ps))
        angle = np.unwrap(np.arctan2(qs[:, 1], qs[:, 0]))
        first = np.ceil((angle[0] - apocentre) / (2 * np.pi))
        last = np.floor((angle[-1] - apocentre) / (2 * np.pi))
        passages = apocentre + 2 * np.pi * np.arange(first, last + 1)
        axis = _eccentricity_vector(qs, ps)
        direction = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]))
        revolutions = (angle[-1] - angle[0]) / (2 * np.pi)
        runs[name] = LongRun(
            name=name,
            ts=ts,
            qs=qs,
            energy_errors=(np.asarray(solution.observed["energy"])[1:] - energy0) / abs(energy0),
            momentum_errors=np.asarray(solution.observed["angular_momentum"])[1:] - momentum0,
            apocentre_radii=np.interp(passages, angle, np.linalg.norm(qs, axis=1)),
            turn=float(np.polyfit(ts, direction, 1)[0] * ts[-1] / revolutions),
        )
        tick((i + 1) / len(METHODS))
    return runs


def _eccentricity_vector(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The vector to the pericentre, p × L − q/|q| for K = 1, shape (N, 2)."""
    momentum = q[:, :1] * p[:, 1:] - q[:, 1:] * p[:, :1]
    return np.hstack([p[:, 1:], -p[:, :1]]) * momentum - q / np.linalg.norm(q, axis=1)[:, None]


def repulsion(tick: Tick) -> dict[str, float]:
    """Largest distance from the centre for the sign of K²/r in (37), and for the opposite one."""
    problem = systems.kepler()

    def hamiltonian(t0, t1, q0, p1, args):
        return jnp.sum(p1**2) / 2 + args["K"] ** 2 / jnp.sqrt(jnp.sum(q0**2))

    distances = {}
    for key, system in {"printed": dvi.System(hamiltonian), "corrected": problem.system}.items():
        variant = dataclasses.replace(problem, system=system)
        solution = run(variant, problem.h, round(DURATION / problem.h))
        distances[f"distance_{key}"] = largest(np.linalg.norm(np.asarray(solution.qs), axis=1))
        tick(len(distances) / 2)
    return distances


def variational_mesh(tick: Tick) -> dict[str, float]:
    """For how many steps, and until when, (14) has real solutions, from two first steps.

    Infinite where all of 5000 steps are real. H_D is of first order, without perturbation.
    """
    problem, ends = systems.kepler(), []
    for first in (0.1, 0.01):
        solution = run(problem, first, 5000, lattice=dvi.Variational(), throw=False)
        k = int(solution.stats["failed_step"])
        ends.append((np.inf, np.inf) if k < 0 else (float(k), float(solution.ts[k])))
        tick(len(ends) / 2)
    (first_steps, first_end), (second_steps, second_end) = ends
    return {
        "mesh_fewest_steps": min(first_steps, second_steps),
        "mesh_end_first": first_end,
        "mesh_end_second": second_end,
    }
