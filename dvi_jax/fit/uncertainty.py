"""Uncertainty of parameters: covariance, correlations, undetermined directions."""

from typing import NamedTuple

import numpy as np

# Singular value of the scaled Jacobian, relative to the largest, below which a direction counts as
# not determined: derivatives have relative errors of about 1e-12.
_RANK = 1e-9


class Uncertainty(NamedTuple):
    """Covariance of the free variables, and principal directions of the scaled Jacobian.

    - `covariance`: (n, n); infinite for parameters that are not determined.
    - `directions`: columns in u, best determined first; `singular_values`: theirs.
    - `null_directions`: directions that the data do not determine, in scaled variables with unit
      length, shape (n, count).
    """

    covariance: np.ndarray
    directions: np.ndarray
    singular_values: np.ndarray
    null_directions: np.ndarray


def uncertainty(J: np.ndarray, variance: float, basis: np.ndarray | None = None) -> Uncertainty:
    r"""Gauss–Newton covariance s² (JᵀJ)⁻¹ by singular values of J with columns of unit length.

    - `J`: derivative of the whitened residuals, (R, n). `variance`: s², 1 for known errors.
    - `basis`: basis of the directions that satisfy constraints, (n, m), or None for all.

    A parameter with a component along an undetermined direction has infinite variance.
    """
    n = J.shape[1]
    Z = np.eye(n) if basis is None else basis
    scale = inverse_or(np.linalg.norm(J, axis=0), 1.0)
    if basis is not None:  # the same space, orthonormal in scaled variables
        Z = np.linalg.qr(Z / scale[:, None])[0]
    # QR first: the singular values of a small triangle.
    R = np.linalg.qr((J * scale) @ Z, mode="r")
    _, values, Vt = np.linalg.svd(R, full_matrices=True)
    values = np.concatenate([values, np.zeros(Z.shape[1] - len(values))])
    V = Z @ Vt.T
    good = values > _RANK * max(values.max(initial=0.0), np.finfo(float).tiny)
    inverse_root = V[:, good] / values[good]
    covariance = variance * (inverse_root @ inverse_root.T) * np.outer(scale, scale)
    free_directions = V[:, ~good]
    share = (np.abs(free_directions) > 1e-6).any(axis=1)
    covariance[share] = covariance[:, share] = np.nan
    covariance[share, share] = np.inf
    return Uncertainty(covariance, V * scale[:, None], values, free_directions)


def conflict_of_priors(J: np.ndarray, priors: np.ndarray, basis: np.ndarray | None = None) -> float:
    """χ² of the difference between priors and data at a minimum: that of the `priors`, their
    residuals, and what they add to that of the data, to first order."""
    n = len(priors)
    A, P = (x if basis is None else x @ basis for x in (J[:-n], J[-n:]))
    scale = inverse_or(np.linalg.norm(A, axis=0), 1.0)
    # At the minimum the derivatives of both sums are opposite.
    R = np.linalg.qr(A * scale, mode="r")
    y = np.linalg.lstsq(np.transpose(R), scale * (P.T @ priors), _RANK)[0]
    return float(priors @ priors + y @ y)


def inverse_or(x: np.ndarray, other: float, numerator: float = 1.0) -> np.ndarray:
    """over / x where x is positive, `other` elsewhere."""
    return np.where(x > 0, numerator / np.where(x > 0, x, 1.0), other)


def correlations(covariance: np.ndarray) -> np.ndarray:
    """Correlation matrix of a covariance, NaN where a variance is not finite."""
    sigma = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        matrix = covariance / np.outer(sigma, sigma)
    matrix[~np.isfinite(matrix)] = np.nan
    return matrix


def in_words(direction: np.ndarray, names: list[str], count: int = 4) -> str:
    """A direction as a sum of names, largest first: ``0.71 q0[0] − 0.71 mu``."""
    order = np.argsort(-np.abs(direction))
    threshold = 0.05 * np.abs(direction).max()
    order = [i for i in order[:count] if abs(direction[i]) > threshold]
    sign = 1 if direction[order[0]] >= 0 else -1
    parts = [f"{sign * direction[i]:+.2f} {names[i]}" for i in order]
    ellipsis = " + …" if (np.abs(direction) > threshold).sum() > count else ""
    return " ".join(parts).lstrip("+").replace("-", "−") + ellipsis


def null_space(C: np.ndarray) -> np.ndarray:
    """Orthonormal basis of the directions d with C d = 0, shape (n, n − rank)."""
    from scipy.linalg import null_space  # here, so that importing the package does not import it

    return null_space(C, rcond=1e-12)
