"""Measurements on the oscillator: Figures 1 to 3, the crossover, the sweep of (34)."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

from .numbers import Tick, crossing, run

SCALING = dvi.Generator(
    xi0=lambda t, q, p, args: jnp.ones_like(t),
    xi=lambda t, q, p, args: q,
    eta=lambda t, q, p, args: p,
)
"""The generator of (34) in both orders: a scaling with a shift of time, (33) corrected."""

STEPS = 10_000
"""Length of the paper's runs in steps."""

EPSILONS = (0.0, 1e-4, 1e-3, 1e-2, 1e-1)
"""Strengths of the perturbation; the paper does not print its values."""


@dataclass(frozen=True)
class FixedMesh:
    """The paper's run at its h = 0.1: 10 000 steps for five strengths of the perturbation.

    `epsilons` (E,), `ts` (N,), `mixed_energy` (E, N): (p_k² + q_{k−1}²)/2, `exact` (E, N): the
    invariant of the perturbed map, `rk4` (N,): (p² + q²)/2 along RK4 at ε = 0, `energy`: its
    initial value. Dimensionless, as all quantities of the paper.
    """

    h: float
    epsilons: np.ndarray
    ts: np.ndarray
    mixed_energy: np.ndarray
    exact: np.ndarray
    rk4: np.ndarray
    energy: float

    @property
    def printed(self) -> np.ndarray:
        """(34) as printed, (1+ε)(p_k² + q_{k−1}²)/2, shape (E, N)."""
        return (1 + self.epsilons[:, None]) * self.mixed_energy


@dataclass(frozen=True)
class Crossover:
    """When RK4's energy error outgrows the band of the variational method's energy.

    `hs` (H,); `bands` (H,): range of (p_k² + q_{k−1}²)/2 over 10 000 steps; `steps` (H,): RK4
    steps until its error is as large, measured (NaN: not within the run); `predicted` (H,):
    the same from a loss of h⁶/72 of the energy per step; `loss` and `loss_theory`: that loss at
    h = 0.1; `run_steps`, `run_errors` (S,): RK4's energy error at h = 0.1.
    """

    hs: np.ndarray
    bands: np.ndarray
    steps: np.ndarray
    predicted: np.ndarray
    loss: float
    loss_theory: float
    run_steps: np.ndarray
    run_errors: np.ndarray


@dataclass(frozen=True)
class SmallStep:
    """(34) as h → 0: order-4 composition, h = 0.01, t = 200.

    `epsilons` (E,); ranges (E,) relative to the initial energy at ε = 0, of (34) as
    printed and of (p² + (1+ε)q²)/2.
    """

    h: float
    epsilons: np.ndarray
    printed: np.ndarray
    corrected: np.ndarray


def _start(problem) -> float:
    """The energy of the initial conditions."""
    return float(np.sum(np.square(problem.q0) + np.square(problem.p0)) / 2)


def fixed_mesh(tick: Tick) -> FixedMesh:
    """The oscillator at the paper's h = 0.1, by the variational map and by RK4."""
    problem = systems.oscillator()
    h, epsilons = problem.h, np.array(EPSILONS)
    mixed_energy, energy = problem.observables["mixed_energy"], problem.observables["energy"]
    orbits = jax.vmap(lambda e: run(problem, h, STEPS, epsilon=e, observe=mixed_energy))
    variational = orbits(jnp.asarray(epsilons))
    tick(0.5)
    rk4 = run(problem, h, STEPS, method=dvi.RungeKutta4(), observe=energy)
    q, p = np.asarray(variational.qs)[..., 0], np.asarray(variational.ps)[..., 0]
    stiffness = 1 + epsilons[:, None]
    return FixedMesh(
        h=h,
        epsilons=epsilons,
        ts=np.asarray(variational.ts)[0, 1:],
        mixed_energy=np.asarray(variational.observed),
        # The perturbed map is the unperturbed one with stiffness 1 + ε, and so is its invariant.
        exact=((p**2 + stiffness * q**2 - h * stiffness * q * p) / 2)[:, 1:],
        rk4=np.asarray(rk4.observed)[1:],
        energy=_start(problem),
    )


def crossover(tick: Tick) -> Crossover:
    """RK4 until its energy error exceeds the variational band, for several h."""
    problem = systems.oscillator()
    start, hs = _start(problem), np.array([0.1, 0.2, 0.3, 0.4])

    def band(h):
        observe = dvi.Range(problem.observables["mixed_energy"])
        return run(problem, h, STEPS, save=dvi.Save(final=True), observe=observe).observed

    def rk4(h, num_steps, stride, progress=None):
        options: Any = {"save": dvi.Save(every=stride), "observe": problem.observables["energy"]}
        options |= {"method": dvi.RungeKutta4(), "progress": progress}
        return run(problem, h, num_steps, **options).observed[1:]

    bands = np.asarray(jax.vmap(band)(jnp.asarray(hs)))
    long, stride = 7_500_000, 2500
    first = rk4(hs[0], long, stride, lambda count, total: tick(0.9 * count / total))
    short, short_stride = 300_000, 20
    later = jax.vmap(lambda h: rk4(h, short, short_stride))(jnp.asarray(hs[1:]))

    def history(values, stride):
        values = np.asarray(values)
        return stride * np.arange(1, len(values) + 1), np.abs(values - start)

    runs = [history(first, stride), *(history(values, short_stride) for values in later)]
    return Crossover(
        hs=hs,
        bands=bands,
        steps=np.array([crossing(n, e, b) for (n, e), b in zip(runs, bands, strict=True)]),
        # E_N = E_0 (1 − h⁶/72)^N, and the error is E_0 − E_N.
        predicted=np.log1p(-bands / start) / np.log1p(-(hs**6) / 72),
        loss=-float(np.expm1(np.log(float(first[-1]) / start) / long)),
        loss_theory=hs[0] ** 6 / 72,
        run_steps=runs[0][0],
        run_errors=runs[0][1],
    )


def small_step(tick: Tick) -> SmallStep:
    """The drift of (34) and of its corrected form against ε as h → 0."""
    problem = systems.oscillator()
    h, epsilons = 0.01, np.array([1e-4, 2e-4, 1e-3, 1e-2, 1e-1])

    def of_print(t0, t1, q0, p0, q1, p1, args):
        return (1 + args["epsilon"]) * (jnp.sum(p1**2) + jnp.sum(q1**2)) / 2

    def correction(t0, t1, q0, p0, q1, p1, args):
        return (jnp.sum(p1**2) + (1 + args["epsilon"]) * jnp.sum(q1**2)) / 2

    def ranges(epsilon):
        observe = {"printed": dvi.Range(of_print), "corrected": dvi.Range(correction)}
        options = {"epsilon": epsilon, "args": {"epsilon": epsilon}, "observe": observe}
        options |= {"method": dvi.Yoshida(4), "save": dvi.Save(final=True)}
        return run(problem, h, round(200 / h), **options).observed

    spreads, start = jax.vmap(ranges)(jnp.asarray(epsilons)), _start(problem)
    pair = (np.asarray(spreads[name]) / start for name in ("printed", "corrected"))
    return SmallStep(h, epsilons, *pair)
