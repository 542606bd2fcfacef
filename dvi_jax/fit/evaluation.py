"""Residuals with their derivative, and the step of Gauss and Newton."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array

STIFFNESS = 30.0
"""Length of the columns of the scaled Jacobian. Optimistix begins with a damping of 1, which then
is Marquardt's 1e-3 of the squared columns."""


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
