"""Functions made orthonormal on samples, and conditions on them weighed: the start of a search."""

from typing import Generic, NamedTuple, TypeVar

import numpy as np

from .motion import FieldMotion, Motion
from .nullspace import epsilon_scale, in_units_of, triangle

M = TypeVar("M", Motion, FieldMotion)
# Samples at which functions are so many times larger than at three quarters of them count less.
_RARE = 100.0


def typical_sizes(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root mean squares of functions on samples, shape (size,), and weights of the samples, (S,):
    1, and less where functions are larger than at nearly all others. `values`: (S, size)."""
    units = np.median(np.abs(values), axis=0)
    units = np.where(units > 0, units, np.max(np.abs(values), axis=0))
    units = np.where(units > 0, units, 1.0)
    relative = values / units
    size = np.max(np.abs(relative), axis=1)
    weights = np.minimum(1, _RARE * np.quantile(size, 0.75) / np.maximum(size, 1.0))
    return units * np.sqrt(np.mean((weights[:, None] * relative) ** 2, axis=0)), weights


class WeightedConditions(NamedTuple, Generic[M]):
    """Conditions A_0 … A_z on S samples, in functions that are orthonormal on the fitted ones:
    singular values then measure functions, not their scaling.

    - `R`: shape (size, size), of the QR decomposition of the functions φ/`units` on the fitted
      samples. The orthonormal functions are the columns of (φ/units) R⁻¹ = φ · `orthonormal`.
    - `units`: of φ, shape (size,). `rms`, `calm`: sizes of φ, and weights of the samples in them,
      see `typical_sizes`.
    - `motion`: of the orthonormal functions; `weights`: of the rows of each sample, (S,).
    - `scale`: see `epsilon_scale`. `terms`: A of the orthonormal functions in ε · scale, shape
      (S, z + 1, …, size).
    """

    R: np.ndarray
    units: np.ndarray
    rms: np.ndarray
    calm: np.ndarray
    orthonormal: np.ndarray
    motion: M
    weights: np.ndarray
    scale: float
    terms: np.ndarray

    def shares(self, columns: np.ndarray) -> np.ndarray:
        """Coefficients of φ/rms, from those of the orthonormal functions: any number of blocks of
        `size` rows, one below the other."""
        size = len(self.R)
        blocks = columns.reshape(len(columns) // size, size, columns.shape[1])
        sizes = (self.rms / self.units)[:, None]
        return (np.linalg.solve(self.R, blocks) * sizes).reshape(columns.shape)


def weigh(values, terms, motion: M, fit: np.ndarray, in_sizes=True) -> WeightedConditions[M]:
    """From `values` of φ, shape (S, size), and `terms` A, shape (S, z + 1, …, size); `fit`: which
    samples are fitted, (S,). `in_sizes`: whether the units of φ are `rms`, or 1."""
    rms, calm = typical_sizes(values)
    units = rms if in_sizes else np.ones(len(rms))
    R = triangle((calm[:, None] * values)[fit] / units) / np.sqrt(np.sum(fit))
    terms = of_orthonormal(terms, units, R)
    orthonormal = np.linalg.inv(R) / units[:, None]
    motion = motion.in_functions(orthonormal)
    weights = motion.weights()
    rows = terms
    if terms.ndim > 3:  # (S, z + 1, rows, …) with the rows of a sample next to it
        rows = np.moveaxis(terms.reshape(*terms.shape[:3], -1), 1, 2)
    rows = times_weights(rows, weights)[fit]
    scale = epsilon_scale(rows.reshape(-1, *rows.shape[-2:]))
    terms = in_units_of(scale, terms)
    return WeightedConditions(R, units, rms, calm, orthonormal, motion, weights, scale, terms)


def times_weights(terms: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Terms of each sample times its weight."""
    return weights.reshape(-1, *[1] * (terms.ndim - 1)) * terms


def of_orthonormal(terms: np.ndarray, units: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Terms of the orthonormal functions, from those of φ, in the last axis."""
    return np.linalg.solve(R.T, (terms / units).reshape(-1, len(R)).T).T.reshape(terms.shape)
