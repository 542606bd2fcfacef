"""Gradients through a trajectory: against difference quotients, and against one another."""

import numpy as np

from .candidate import POINT, Candidate, point
from .measured import Measured, at_most

DIFFERENCES = 1e-6
MODES = 1e-10


def differences(candidate: Candidate) -> Measured:
    """The worst relative difference of ∂loss/∂x from a central difference quotient.

    x: each of q0, p0, t0, h, ε, args. Reverse mode as it is by default (`Reversible`).
    """
    gradient = candidate.gradients[0]["Reversible"]
    quotient = np.array([_quotient(candidate, name) for name in POINT])
    error = np.abs(gradient - quotient) / np.abs(quotient)
    worst = int(np.argmax(np.where(np.isnan(error), np.inf, error)))
    return at_most(float(error[worst]), DIFFERENCES, detail=f"worst in {list(POINT)[worst]}")


def modes(candidate: Candidate) -> Measured:
    """The largest relative difference of a derivative by a reverse mode from that by forward mode.

    Along (1, …, 1): the sum of the gradient.
    """
    backward, forward = candidate.gradients
    error = {name: abs(float(np.sum(g)) / forward - 1) for name, g in backward.items()}
    worst = max(error, key=lambda name: np.inf if np.isnan(error[name]) else error[name])
    return at_most(error[worst], MODES, detail=f"worst with {worst}")


def _quotient(candidate: Candidate, name: str) -> float:
    """Central differences with steps of 1e-3 and 2e-3, extrapolated: errors of 1e-11 or so."""

    def loss(shift):
        x = point()
        z, _ = candidate.final(x | {name: x[name] + shift})
        return float(np.sum(z**2) + z[0] - z[1])

    def slope(s):
        return (loss(s) - loss(-s)) / (2 * s)

    return (4 * slope(1e-3) - slope(2e-3)) / 3
