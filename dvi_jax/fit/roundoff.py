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

# Length of the columns of the scaled Jacobian. Optimistix begins with a damping of 1, which then is
# Marquardt's 1e-3 of the squared columns.
STIFFNESS = 30.0
_STEPS = 4  # Undamped steps, each of which is a sample of the round-off
# Factor by which a step may increase the residuals, `small` changes apart: of residuals that are
# round-off themselves, those of the first point are the smallest by chance.
_WORSE = 2.0
# Size of the steps, over that of the round-off, that must change the predictions linearly.
_STEP_RATIO = 30.0
_LINEAR = 0.3  # Relative error of the derivative allowed there; of a round-off sample 0.03


class Evaluation(NamedTuple):
    """Residual vector (R,), its derivative (R, n), and what else was computed with them."""

    residual: Array | np.ndarray
    jacobian: Array | np.ndarray
    aux: Any = None


def undamped_step(evaluation: Evaluation, scale: np.ndarray) -> tuple[np.ndarray, float]:
    """The undamped step, and how much it changes the residuals. Parameters that have almost no
    effect any more (at a bound), and combinations that are not determined, are left out."""
    J = np.asarray(evaluation.jacobian) * scale
    length = np.linalg.norm(J, axis=0)
    effective = length > 1e-3 * STIFFNESS
    step = np.zeros(len(scale))
    if not effective.any():
        return step, 0.0
    U, s, Vt = np.linalg.svd(J[:, effective] / length[effective], full_matrices=False)
    good = s > 1e-7 * s[0]
    projection = U[:, good].T @ np.asarray(evaluation.residual)
    step[effective] = -(Vt[good].T @ (projection / s[good])) / length[effective]
    return step * scale, float(np.linalg.norm(projection))


class End(NamedTuple):
    """A minimum: u, the evaluation there, and changes of u by round-off, shape (samples, n); none
    if round-off is negligible."""

    u: np.ndarray
    evaluation: Evaluation
    shifts: np.ndarray


def settle(
    evaluate: Callable[[np.ndarray], Evaluation],
    u: np.ndarray,
    evaluation: Evaluation,
    scale: np.ndarray,
    flat: float,
    small: float,
) -> End | None:
    """The minimum near u, or None if the fit is stuck elsewhere.

    - `evaluation`: that at u. `scale`: of u. `flat`: change of the predictions by the undamped
      step below which the gradient is zero. `small`: one that round-off may cause.

    The steps are samples of the round-off if the predictions are linear in u over thirty times
    their size: there an undamped step leads to the minimum but for round-off. With a wrong
    derivative, a kink or a chaotic trajectory they are not linear.
    """
    limit, (step, size) = _WORSE * _norm(evaluation) + small, undamped_step(evaluation, scale)
    points, shifts = [(size, u, evaluation)], []
    while size > flat and len(shifts) < _STEPS:
        u = u + step
        evaluation = evaluate(u)
        if not (_norm(evaluation) <= limit and np.isfinite(evaluation.jacobian).all()):
            return None
        step, size = undamped_step(evaluation, scale)
        points.append((size, u, evaluation))
        shifts.append(step)
    if size <= flat:
        return End(u, evaluation, np.zeros((0, len(u))))
    noise = float(np.sqrt(np.mean([size**2 for size, *_ in points[1:]])))
    reach = max(_STEP_RATIO * noise, points[0][0])
    _, u, evaluation = min(points, key=lambda point: point[0])
    J = np.asarray(evaluation.jacobian)
    d = shifts[-1] * reach / np.linalg.norm(J @ shifts[-1])
    forward, backward = (np.asarray(evaluate(u + sign * d).residual) for sign in (1, -1))
    # The difference of both sides has no quadratic term.
    defect = evaluation._replace(residual=(forward - backward) / 2 - J @ d)
    if np.isfinite(defect.residual).all() and undamped_step(defect, scale)[1] <= _LINEAR * reach:
        return End(u, evaluation, np.array(shifts))
    return None


def _norm(evaluation: Evaluation) -> float:
    return float(np.linalg.norm(evaluation.residual))
