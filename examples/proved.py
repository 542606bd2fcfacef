"""A system and its adiabatic invariant, of whose change `dvi-jax bound` proves a bound."""

import numpy as np

import dvi_jax as dvi


def quadratic(t0, t1, q0, p1, args):
    """H_D = (p1² + q0²)/2."""
    return (p1 @ p1 + q0 @ q0) / 2


def cubic_force(t0, t1, q0, p1, args):
    """W = −q0³; `epsilon` is its strength."""
    return -(q0**3)


system = dvi.System(quadratic, force=cubic_force)
samples = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 400, 1))
found = dvi.discover_invariants(system, dvi.Polynomials(8), order=2, h=0.1, samples=samples)
