"""The order of a method, measured: global errors at a fixed time, round-off masked out."""

import numpy as np

from . import problems
from .candidate import Candidate
from .measured import Measured, near, not_measured

TOLERANCE = 0.2
FLOOR = 3e-13
"""Errors below are not looked at: round-off starts at some 1e-14."""

NUMBERS = tuple(round(8 * 2 ** (k / 4)) for k in range(25))
"""Steps that `SPAN` is cut into, 8 to 512, finer until the error is below the floor."""

POINTS = 6
"""The finest points above the floor that the order is read from; fewer are no measurement."""


def order(candidate: Candidate) -> Measured:
    """The order r in error ≈ C h^r, without the force."""
    return _measured_order(candidate, 0.0)


def forced_order(candidate: Candidate) -> Measured:
    """The same with damping and drive on, W a function of q, p and t."""
    return _measured_order(candidate, problems.FORCED)


def _measured_order(candidate: Candidate, epsilon: float) -> Measured:
    """r of log error = c + r log h + d h², by least squares.

    Where few steps reach round-off already the slope itself is that of too large an h: on
    McLachlan8 it is 8.2 still, with the next term of the error beside it 8.04.
    """
    claimed = candidate.method.order
    steps, errors, ended = errors_at(candidate, epsilon)
    allowed = f"{claimed:g} ± {TOLERANCE:g}"
    if len(errors) < POINTS or not np.all(np.isfinite(errors)):
        return not_measured(
            allowed, f"{len(errors)} points above round-off, at least {POINTS} needed; {ended}"
        )
    h, e = np.array(steps[-POINTS:]), np.array(errors[-POINTS:])
    terms = np.stack([np.ones_like(h), np.log(h), h**2], axis=1)
    found = np.linalg.lstsq(terms, np.log(e), rcond=None)[0]
    seen = f"errors {e[0]:.1e} to {e[-1]:.1e} for h = {h[0]:.3g} to {h[-1]:.3g}; {ended}"
    return near(float(found[1]), claimed, TOLERANCE, seen)


def errors_at(candidate: Candidate, epsilon: float) -> tuple[list[float], list[float], str]:
    """Steps h, largest error of a component at `SPAN` for each, and why the list ends.

    It ends at a trajectory that failed, with NaN.
    """
    exact, doubt = problems.reference(epsilon)
    floor = max(FLOOR, 100 * doubt)
    steps, errors = [], []
    for n in NUMBERS:
        h = problems.SPAN / n
        at = (*problems.TWO, 0.0, h, epsilon, problems.A, n)
        error = float(np.max(np.abs(candidate.flow(*at) - exact)))
        if error <= floor:
            return steps, errors, f"round-off from h = {h:.3g} on"
        steps.append(h)
        errors.append(error)
        if not np.isfinite(error):
            return steps, errors, f"the trajectory failed at h = {h:.3g}"
    return steps, errors, "no round-off met"
