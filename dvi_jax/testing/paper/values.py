"""The numbers that the claims are judged by, under the names that `claims.toml` has for them."""

from typing import Any

import numpy as np

from .experiments import Measurements
from .kepler import METHODS
from .numbers import largest, relative_spread, slope


def _oscillator(m: Measurements) -> dict[str, float]:
    mesh, cross = m.fixed_mesh, m.crossover
    energies, rk4 = mesh.mixed_energy[0], mesh.rk4 - mesh.energy
    accuracy, exact = relative_spread(mesh.printed)[1:], relative_spread(mesh.exact)
    return {
        "mixed_range": float(np.ptp(energies)),
        "mixed_range_relative": float(relative_spread(energies)),
        "mixed_range_over_rk4": float(np.ptp(energies)) / largest(rk4),
        "mixed_drift": largest(energies - energies[0]),
        "rk4_error": largest(rk4),
        "rk4_error_at_end": float(rk4[-1]),
        "rk4_loss": cross.loss,
        "rk4_loss_theory": float(cross.loss_theory),
        "crossover_steps": float(cross.steps[0]),
        "crossover_gap": largest(cross.steps / cross.predicted - 1),
        "exact_range": float(exact[0]),
        "exact_range_disturbed": float(np.max(exact[1:])),
        "corrected_range": float(np.max(m.small_step.corrected)),
        "accuracy_ratio": float(accuracy[-1] / accuracy[0]),
        "accuracy_smallest": float(accuracy[0]),
        "accuracy_largest": float(accuracy[-1]),
    }


def _kepler_orbits(m: Measurements) -> dict[str, float]:
    rk4, variational, strang, yoshida = (m.long_runs[name] for name in METHODS)

    def growth(run):
        """Largest energy error of the whole run over that of its first half."""
        return run.error_at(1.0) / run.error_at(0.5)

    return {
        "rk4_energy_error": rk4.error_at(1.0),
        "rk4_growth": growth(rk4),
        "rk4_momentum_error": largest(rk4.momentum_errors),
        "rk4_width": rk4.width,
        "rk4_turn": rk4.turn,
        "variational_energy_error": variational.error_at(1.0),
        "variational_growth": growth(variational),
        "variational_momentum_error": largest(variational.momentum_errors),
        "variational_turn": variational.turn,
        "strang_energy_error": strang.error_at(1.0),
        "width_ratio": variational.width / rk4.width,
        "energy_ratio": variational.error_at(1.0) / rk4.error_at(1.0),
        "energy_ratio_order_4": yoshida.error_at(1.0) / rk4.error_at(1.0),
    }


def _kepler_sweeps(m: Measurements) -> dict[str, float]:
    sweep, small = m.mesh_sweep, m.small_step_sweep
    range_50 = dict(zip(sweep.hs, sweep.spread_50[:, 0], strict=True))
    return {
        "momentum_range": float(np.max(sweep.relative_49[:, 0])),
        "range_49": float(np.max(sweep.relative_49)),
        "range_50_coarse": float(range_50[0.1]),
        "range_50_fine": float(range_50[0.01]),
        "range_50_exponent": slope(sweep.hs, sweep.spread_50[:, 0]),
        "range_50_epsilon_exponent": slope(sweep.epsilons[1:], sweep.spread_50[0, 1:]),
        "range_50_relative": float(np.max(relative_spread(sweep.values_50[:-1]))),
        "drift_50_exponent": small.exponent(small.beyond_zero(small.attracting)),
        "drift_50_exponent_raw": small.exponent(small.attracting[1:]),
        "drift_50_exponent_repelling": small.exponent(small.beyond_zero(small.repelling)),
        "literal_drift": float(np.max(small.beyond_zero(small.literal))),
    }


PARTS = (_oscillator, _kepler_orbits, _kepler_sweeps)


def numbers(m: Measurements) -> dict[str, Any]:
    """Name → number, from the measurements alone."""
    values = m.repulsion | m.variational_mesh
    values |= m.limits | m.symmetries | m.identities | m.discoveries
    for part in PARTS:
        values |= part(m)
    return values
