"""The paper's invariants, gauges and orders as the package's own tools find them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

from .kepler import CLOCKED_ROTATION, ROTATION, gauge
from .numbers import Tick, largest, run, slope
from .oscillator import SCALING

H = 0.1


def discoveries(tick: Tick) -> dict[str, Any]:
    """Results of discovery, gauge solving and drift measurement, without prior knowledge."""
    rng = np.random.default_rng(0)
    numbers = _on_oscillator(rng, lambda part: tick(0.5 * part))
    return numbers | _on_kepler(rng, lambda part: tick(0.5 + 0.5 * part))


def _on_oscillator(rng, tick: Tick) -> dict[str, Any]:
    """Invariants found for the oscillator with h = 0.1 and the perturbing force −εq.

    `oscillator`: the invariant of order 1 that is found in quadratics, as text; `oscillator_off`:
    distance of its coefficients from those of (p² + (1+ε)q² − h(1+ε)qp)/2; `oscillator_residual`:
    held-out; `oscillator_exact`: 1 when it is conserved at any ε. `gauge_34_left_0`, `_1`: relative
    residuals of the identities of order 0 and 1 for (34) with the best gauges of degree 4.
    `drift_34_exponent`: exponent in ε of the drift of (1+ε)(p² + q²)/2 as h → 0.
    """
    spring = systems.oscillator()
    line = tuple(rng.uniform(-1, 1, (2, 200, 1)))
    invariants = dvi.discover_invariants(spring.system, dvi.Polynomials(2), 1, h=H, samples=line)
    names = list(invariants.basis.names)

    def series(*coefficients):
        rows = np.zeros((2, len(names)))
        for order, name, value in coefficients:
            rows[order, names.index(name)] = value
        return rows

    exact = series((0, "q²", 0.5), (1, "q²", 0.5), (0, "q p", -H / 2), (1, "q p", -H / 2))
    exact += series((0, "p²", 0.5))
    distance = (
        largest(np.asarray(invariants.coefficients[0]) - exact) if invariants.count == 1 else np.inf
    )
    tick(0.4)
    gauges = dvi.solve_gauge(spring.system, [SCALING] * 2, dvi.Polynomials(4), h=H, samples=line)
    tick(0.6)
    printed = series(*((order, name, 0.5) for order in (0, 1) for name in ("q²", "p²")))
    printed = dvi.InvariantSeries(invariants.basis, jnp.asarray(printed))
    options: Any = {"h": 0.01, "num_steps": 20_000, "method": dvi.Yoshida(4)}
    options["epsilons"] = [1e-4, 2e-4, 1e-3, 1e-2, 1e-1]
    order = dvi.drift_order(spring.system, printed, spring.q0, spring.p0, **options)
    tick(1.0)
    return {
        "oscillator": str(invariants.invariants[0]) if invariants.count else "",
        "oscillator_off": distance,
        "oscillator_residual": float(np.max(invariants.residuals, initial=0.0)),
        "oscillator_exact": float(all(invariants.exact) and invariants.count == 1),
        "gauge_34_left_0": float(gauges.residuals[0]),
        "gauge_34_left_1": float(gauges.residuals[1]),
        "drift_34_exponent": order.slope,
    }


def _on_kepler(rng, tick: Tick) -> dict[str, Any]:
    """With −εq, in polynomials of degree 3 and 1/r: `kepler`, … as for the oscillator.

    `kepler_count` invariants found, at h = 0.1. `gauge_50_left`: what the best gauge of degree 4
    leaves of the identity of order 1 for (50), with its exponent in h. `balance_gap_by_tool`:
    largest gap of the balance law of (50) over 200 steps, relative to its causes. Without
    perturbation, symmetries in polynomials of degree 1: `variational_count`; `found_rotation`,
    distance of (40) from the span of all; `found_residual`, of the determining equations, held-out.
    """
    kepler = systems.kepler()
    rotations = [CLOCKED_ROTATION] * 2
    samples: Any = {"samples": _ring(rng, 400), "args": kepler.args}
    basis = dvi.Polynomials(3) + dvi.Radial()
    invariants = dvi.discover_invariants(kepler.system, basis, 1, h=H, **samples)
    tick(0.6)
    hs = np.array([0.1, 0.05, 0.025])
    inputs = kepler.system, rotations, dvi.Polynomials(4)
    left = [dvi.solve_gauge(*inputs, h=float(h), **samples).residuals[1] for h in hs]
    tick(0.9)
    linear = dvi.Polynomials(1, constant=True)
    symmetries = dvi.find_symmetries(kepler.system, linear, h=H, **samples)
    orbit = run(kepler, H, 200, epsilon=0.01)
    causes = dvi.noether_balance(
        kepler.system, rotations, [None, gauge], orbit, epsilon=0.01, args=kepler.args
    )
    tick(1.0)
    scale = max(largest(c) for c in (causes.symmetry, causes.work, causes.lattice))
    return {
        "kepler": str(invariants.invariants[0]) if invariants.count else "",
        "kepler_count": float(invariants.count),
        "kepler_residual": float(np.max(invariants.residuals, initial=0.0)),
        "kepler_exact": float(all(invariants.exact) and invariants.count == 1),
        "gauge_50_left": float(left[0]),
        "gauge_50_exponent": slope(hs, np.array(left)),
        "balance_gap_by_tool": largest(causes.defect) / scale,
        "variational_count": float(len(symmetries.variational)),
        "found_rotation": _distance_from_span(symmetries, samples["samples"]),
        "found_residual": max((float(np.max(s.residuals)) for s in symmetries), default=np.inf),
    }


def _ring(rng, count):
    """Positions at 0.8 < r < 2, momenta below 1 in size in each component: (qs, ps)."""
    angle, r = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.8, 2.0, count)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], 1), rng.uniform(-1, 1, (count, 2))


def _distance_from_span(fields: dvi.Symmetries, samples) -> float:
    """How far the rotation (40) is outside of the span of what was found, relative."""

    def at_samples(generator):
        def at_sample(q, p):
            point = dvi.LatticePoint(jnp.zeros(()), q, p)
            return jnp.concatenate([jnp.ravel(x) for x in generator(point)])

        return np.asarray(jax.vmap(at_sample)(*samples)).ravel()

    target = at_samples(ROTATION)
    if not fields.count:
        return np.inf
    columns = np.stack([at_samples(s.generators[0]) for s in fields], axis=1)
    residual = target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0]
    return float(np.linalg.norm(residual) / np.linalg.norm(target))
