"""The end of a fit whose loss no longer decreases: at its minimum up to round-off, or stuck.

Round-off of the predictions, δ(u), is a function of the parameters without a derivative. It bounds
what a step can gain: of two losses close to the minimum the smaller one is a matter of chance. The
gradient is then still accurate. An undamped Gauss–Newton step from any point near the minimum
x* ends at x* − J⁺ δ, with the δ of the point where it began, so that a few such steps either lead
to a gradient of zero, or they measure J⁺ δ.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array

STIFFNESS = 30.0
"""Length of the columns of the scaled Jacobian. Optimistix begins with a damping of 1, which then
is Marquardt's 1e-3 of the squared columns."""

_STEPS = 4
"""Undamped steps, each of which is a sample of the round-off."""

_WORSE = 2.0
"""Factor by which a step may increase the residuals, `small` changes apart: of residuals that are
round-off themselves, those of the first point are the smallest by chance."""

_ABOVE = 30.0
"""Size of the steps, over that of the round-off, that must change the predictions linearly."""

_LINEAR = 0.3
"""Relative error of the derivative allowed there. That of a sample of the round-off is 0.03."""


class Evaluation(NamedTuple):
    """Residual vector (R,), its derivative (R, n), and what else was computed with them."""

    residual: Array | np.ndarray
    jacobian: Array | np.ndarray
    aux: Any = None


def undamped(at: Evaluation, scale: np.ndarray) -> tuple[np.ndarray, float]:
    """The undamped step, and how much it changes the residuals. Parameters that have almost no
    effect any more (at a bound), and combinations that are not determined, are left out."""
    J = np.asarray(at.jacobian) * scale
    length = np.linalg.norm(J, axis=0)
    has = length > 1e-3 * STIFFNESS
    step = np.zeros(len(scale))
    if not has.any():
        return step, 0.0
    U, s, Vt = np.linalg.svd(J[:, has] / length[has], full_matrices=False)
    good = s > 1e-7 * s[0]
    along = U[:, good].T @ np.asarray(at.residual)
    step[has] = -(Vt[good].T @ (along / s[good])) / length[has]
    return step * scale, float(np.linalg.norm(along))


class End(NamedTuple):
    """A minimum: u, the evaluation there, and changes of u by round-off, shape (samples, n); none
    if round-off is negligible."""

    u: np.ndarray
    at: Evaluation
    shifts: np.ndarray


def settle(
    evaluate: Callable[[np.ndarray], Evaluation],
    u: np.ndarray,
    at: Evaluation,
    scale: np.ndarray,
    flat: float,
    small: float,
) -> End | None:
    """The minimum near u, or None if the fit is stuck elsewhere.

    - `at`: the evaluation at u. `scale`: of u. `flat`: change of the predictions by the undamped
      step below which the gradient is zero. `small`: one that round-off may cause.

    The steps are samples of the round-off if the predictions are linear in u over thirty times
    their size: there an undamped step leads to the minimum but for round-off. With a wrong
    derivative, a kink or a chaotic trajectory they are not linear.
    """
    limit, (step, size) = _WORSE * _norm(at) + small, undamped(at, scale)
    points, shifts = [(size, u, at)], []
    while size > flat and len(shifts) < _STEPS:
        u = u + step
        at = evaluate(u)
        if not (_norm(at) <= limit and np.isfinite(at.jacobian).all()):
            return None
        step, size = undamped(at, scale)
        points.append((size, u, at))
        shifts.append(step)
    if size <= flat:
        return End(u, at, np.zeros((0, len(u))))
    noise = float(np.sqrt(np.mean([size**2 for size, *_ in points[1:]])))
    reach = max(_ABOVE * noise, points[0][0])
    _, u, at = min(points, key=lambda point: point[0])
    J = np.asarray(at.jacobian)
    d = shifts[-1] * reach / np.linalg.norm(J @ shifts[-1])
    ahead, back = (np.asarray(evaluate(u + sign * d).residual) for sign in (1, -1))
    # The difference of both sides has no quadratic term.
    off = at._replace(residual=(ahead - back) / 2 - J @ d)
    if not (np.isfinite(off.residual).all() and undamped(off, scale)[1] <= _LINEAR * reach):
        return None
    return End(u, at, np.array(shifts))


def _norm(at: Evaluation) -> float:
    return float(np.linalg.norm(at.residual))
