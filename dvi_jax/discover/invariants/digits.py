"""Digits of the coefficients that a search finds: rounding, known digits, and closed forms."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from ..algebra.block_triangular import BlockTriangular, larger_than
from ..algebra.nullspace import DENSE, NULL, series_changes, toeplitz, triangle

# Coefficients below such shares of the largest may be rounding; the first that held-out samples
# confirm counts.
_LEVELS = 10.0 ** -np.arange(7.0, 13.0)
_GROWS = 2.0  # A series with fewer terms may change by so many times more, or by rounding
_ROUND_OFF = 1e-13
_DETERMINACY = 1e-6  # Coefficients are solved for again along directions determined so well
_PROBES = 64  # Random residuals by which errors are estimated beyond
_MOST_DIGITS = 6  # Digits that a formula shows
_SAFETY = 3.0  # Errors of a coefficient within which a closed form has to agree
_BY_CHANCE = 1e-4  # Largest probability that a random number agrees with a closed form
_LARGEST = 1000  # The largest numerator and denominator
_TIMES = {"": 1.0, "√2": 2**0.5, "√3": 3**0.5, "√5": 5**0.5, "π": np.pi, "/π": 1 / np.pi}


class LinearConditions(NamedTuple):
    """The linear conditions on a series, with rows weighted by the typical change in a step, for
    functions scaled to one size on the samples. `terms`: A_0 … A_z, shape (rows, z + 1, size); up
    to `DENSE` coefficients their Toeplitz matrix as one order."""

    terms: np.ndarray

    @classmethod
    def from_terms(cls, terms: np.ndarray) -> "LinearConditions":
        """From A_0 … A_z, shape (rows, z + 1, size)."""
        _, orders, size = terms.shape
        if orders * size > DENSE:
            return cls(terms)
        return cls(triangle(toeplitz(terms, orders - 1))[:, None])

    def _free(self, shares: np.ndarray) -> np.ndarray:
        """The coefficients that are not zero, without the largest, which is the unit."""
        free = shares != 0
        free[0, np.argmax(np.abs(shares[0]))] = False
        return free

    def _solver(self, free: np.ndarray, share: float) -> BlockTriangular:
        return BlockTriangular(self.terms, larger_than(share), free.reshape(self.terms.shape[1:]))

    def _residual(self, shares: np.ndarray) -> np.ndarray:
        """The left sides, shape (orders, rows, 1)."""
        return np.moveaxis(series_changes(self.terms, shares.reshape(-1, 1)), 1, 0)

    def nearest_solution(self, shares: np.ndarray) -> np.ndarray:
        """The nearest solution with the same coefficients equal to zero."""
        solver = self._solver(self._free(shares), _DETERMINACY)
        return shares - solver.solve(self._residual(shares)).reshape(shares.shape)

    def without_rounding(self, shares: np.ndarray, change: Callable) -> np.ndarray:
        """The series without the coefficients that are rounding: it changes no more without them;
        `change`: that of a series on the held-out samples."""
        size, limit, count = np.abs(shares), None, np.count_nonzero(shares)
        for level in _LEVELS:
            is_kept = size > level * np.max(size)
            if np.count_nonzero(is_kept) == count:
                continue
            count = np.count_nonzero(is_kept)
            if count == np.count_nonzero(shares):
                break
            limit = limit or max(_GROWS * change(shares), _ROUND_OFF)
            candidate = self.nearest_solution(np.where(is_kept, shares, 0.0))
            if change(candidate) <= limit:
                return candidate
        return shares

    def errors(self, shares: np.ndarray, tolerance: float | None = None) -> np.ndarray:
        """Errors of the coefficients, as large as the residual makes them along the directions that
        the conditions determine; `tolerance`: of approximate invariants."""
        residual = np.linalg.norm(self._residual(shares))
        residual = max(residual, np.finfo(float).eps * np.max(np.abs(shares)))
        solver = self._solver(self._free(shares), max(NULL, tolerance or 0.0))
        rows, orders, _ = self.terms.shape
        right = np.eye(rows)[None]
        if orders > 1:  # the root mean square over random residuals of length one in each row
            right = np.random.default_rng(0).normal(size=(orders, rows, _PROBES)) / _PROBES**0.5
        return residual * np.linalg.norm(solver.solve(right), axis=2).reshape(shares.shape)


def digits_of(values: np.ndarray, errors: Any, largest: int = _MOST_DIGITS) -> np.ndarray:
    """How many digits of each value its error leaves, from 2 to `largest`."""
    if errors is None:
        return np.full(np.shape(values), largest)
    size = np.maximum(np.abs(values), np.finfo(float).tiny)
    relative = np.maximum(2 * errors / size, 1e-300)
    return np.clip(np.floor(-np.log10(relative)), 2, largest).astype(int)


def closed_form(value: float, error: float) -> str | None:
    """The simplest p/q, or multiple of √2, √3, √5, π or 1/π by it, that agrees with a number to
    all its digits, as text; None where a random number would as likely.

    Fractions with |p|, |q| ≤ n are about n² numbers: with p q = n² a random number is as near to
    one of them as `error` with a probability of about 2 n² `error`/|value|, for each factor.
    """
    if not np.isfinite(value) or value == 0:
        return None
    tolerance = max(_SAFETY * abs(error / value), 4 * np.finfo(float).eps)
    best: tuple[int, str] | None = None
    for name, factor in _TIMES.items():
        for p, q in _convergents(abs(value) / factor):
            if max(p, q) > _LARGEST or (best and p * q >= best[0]):
                break
            if p and abs(p / q * factor - abs(value)) <= tolerance * abs(value):
                best = p * q, _text(p, q, name)
                break
    if best is None or 2 * len(_TIMES) * best[0] * tolerance > _BY_CHANCE:
        return None
    return ("−" if value < 0 else "") + best[1]


def _convergents(x: float) -> Iterator[tuple[int, int]]:
    """Convergents p, q of the continued fraction of x ≥ 0."""
    p, q, previous = 1, 0, (0, 1)
    for _ in range(30):
        integer = int(np.floor(x))
        (p, q), previous = (integer * p + previous[0], integer * q + previous[1]), (p, q)
        yield p, q
        if x - integer < 1e-12 or q > _LARGEST:
            return
        x = 1 / (x - integer)


def _text(p: int, q: int, name: str) -> str:
    if name == "/π":
        return f"{p}/π" if q == 1 else f"{p}/({q}π)"
    top = f"{p}" if not name else name if p == 1 else f"{p}{name}"
    return top if q == 1 else f"{top}/{q}"
