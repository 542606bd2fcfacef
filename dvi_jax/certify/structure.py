"""Symplecticity, symmetry, the inverse, and what a long run keeps."""

import numpy as np

import dvi_jax as dvi

from . import problems
from .candidate import LONG, LONG_H, STEPS, Candidate, point
from .measured import Measured, at_most, not_measured

ROUND_OFF = 1e-12
SHARE = 0.05
"""Largest drift of the energy over a long run, as a part of its swing."""

QUIET = 1e-10
"""Swings of the energy below this part of it are taken for so large: they are round-off."""


def symplecticity(candidate: Candidate) -> Measured:
    """max |MᵀJM − J|, M = ∂Φ_h/∂(q, p)."""
    M = np.asarray(candidate.jacobian(np.concatenate(problems.TWO), np.asarray(0.1)))
    n = len(M) // 2
    J = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    defect = np.max(np.abs(M.T @ J @ M - J))
    return at_most(float(defect), ROUND_OFF, candidate.method.is_symplectic)


def reversal(candidate: Candidate) -> Measured:
    """max |Φ_{−h}(Φ_h(z)) − z| over ten steps there and ten back, force on."""
    h, n = 0.1, 10
    q, p = candidate.flow(*problems.TWO, 0.0, h, problems.FORCED, problems.A, n)
    back = candidate.flow(q, p, n * h, -h, problems.FORCED, problems.A, n)
    defect = np.max(np.abs(back - np.stack(problems.TWO)))
    return at_most(float(defect), ROUND_OFF, candidate.method.is_symmetric)


def adjoint(candidate: Candidate) -> Measured:
    """max |Φ*_{−h}(Φ_h(z)) − z|, force on: the adjoint over −h is the inverse."""
    if not candidate.method.is_invertible:
        return not_measured(f"≤ {ROUND_OFF:g}", "the method has no inverse", claimed=False)
    x = point()
    z, there = candidate.final(x)
    end = x["t0"] + STEPS * x["h"]
    back, again = candidate.undone(x | {"q0": z[0], "p0": z[1], "t0": end, "h": -x["h"]})
    if not (there and again):
        return not_measured(f"≤ {ROUND_OFF:g}", "a step or its inverse failed")
    moved = float(np.max(np.abs(z - np.stack([x["q0"], x["p0"]]))))
    defect = float(np.max(np.abs(back - np.stack([x["q0"], x["p0"]]))))
    return at_most(defect, ROUND_OFF, detail=f"the steps moved the state by {moved:.2g}")


def energy(candidate: Candidate) -> Measured:
    """Drift of the energy (its slope times the length of the run) as a part of its swing."""
    run, claimed = candidate.long_run, candidate.method.is_symplectic
    if run.status != "successful":
        return not_measured(f"≤ {SHARE:g}", _failed(run), claimed)
    drift = abs(float(run.observed["slope"])) * LONG * LONG_H
    swing = float(run.observed["range"])
    start = float(problems.central(0, 0, *problems.ROSETTE, problems.A))
    detail = f"over {LONG} steps drift {drift:.1e}, swing {swing:.1e}, energy {start:.2g}"
    return at_most(drift / max(swing, QUIET * start), SHARE, claimed, detail)


def momentum(candidate: Candidate) -> Measured:
    """Largest change of the angular momentum, as a part of it."""
    run, claimed = candidate.long_run, candidate.method.is_symplectic
    if run.status != "successful":
        return not_measured(f"≤ {ROUND_OFF:g}", _failed(run), claimed)
    q, p = problems.ROSETTE
    start = abs(q[0] * p[1] - q[1] * p[0])
    return at_most(float(run.observed["momentum"]) / start, ROUND_OFF, claimed)


def _failed(run: dvi.Solution) -> str:
    return f"the trajectory failed at step {int(run.stats['failed_step'])}: {run.status}"
