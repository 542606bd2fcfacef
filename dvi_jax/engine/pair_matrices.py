"""Sums and products of matrices of pairs of float64 numbers, in NumPy, with 31 digits."""

from typing import Any

import numpy as np

from .pairs import Pair

_DIGITS = 118


def exact(x: Any) -> Pair:
    """A float64 array as a pair; a pair as it is."""
    return x if isinstance(x, Pair) else Pair(x, np.zeros_like(x))


def zeros(rows: int, columns: int) -> Pair:
    """The matrix 0."""
    return exact(np.zeros((rows, columns)))


def plus(x: Any, y: Any) -> Pair:
    """x + y, with an error of 2⁻¹⁰⁴ (|x| + |y|)."""
    (a, c), (b, d) = exact(x), exact(y)
    # The rounding of a + b is known exactly, whichever of the two is larger; that of the sum of the
    # three small parts is in the last digits of the pair.
    s = a + b
    addend = s - a
    remainder = ((a - (s - addend)) + (b - addend)) + (c + d)
    total = s + remainder
    return Pair(total, remainder - (total - s))


class Left:
    """A matrix as the left factor of several products."""

    def __init__(self, x: Any):
        self.matrix, self.bits = exact(x), _bits(x)
        self.slices = _slices(self.matrix, 1, self.bits)

    def __matmul__(self, x: Any) -> Pair:
        """The product with an array or a pair, with errors of 2⁻¹⁰⁰ times the largest numbers of
        a row and of a column, times √n for sums of n products.

        Both factors are sums of slices with so few bits that BLAS multiplies slices without
        rounding, in whatever order it adds.

        **Source** Ozaki, Ogita, Oishi & Rump 2012, *Numerical Algorithms* 59, 95.
        """
        # Products of late slices are below the last digit of the result: they are left out.
        x = exact(x)
        columns, right = x.hi.shape[1], _slices(x, 0, self.bits)
        total, count = zeros(len(self.slices[0]), columns), _count(self.bits)
        for i, part in reversed(list(enumerate(self.slices))):
            factors = right[: count - i]
            terms = np.split(part @ np.hstack(factors), len(factors), axis=1)
            for term in reversed(terms):  # the smallest first
                total = plus(total, term)
        return total


def _bits(x: Any) -> int:
    """Bits of a slice: sums over the columns of products of two slices have at most 53."""
    columns = max(exact(x).hi.shape[1], 1)
    return (53 - int(np.ceil(np.log2(columns)))) // 2


def _count(bits: int) -> int:
    return -(-_DIGITS // (bits + 1))


def _slices(x: Pair, axis: int, bits: int) -> list[np.ndarray]:
    """x as a sum of arrays of integers of so many bits, each in units of a power of two for each
    row (`axis` 1) or column (0)."""
    (hi, lo), parts = x, []
    for _ in range(_count(bits)):
        largest = np.max(np.abs(hi), axis=axis, keepdims=True, initial=0.0)
        if parts and not largest.any():
            break
        # Adding a large number and subtracting it rounds to a multiple of its last digit.
        large = np.where(largest > 0, 0.75 * 2.0 ** (np.frexp(largest)[1] + 53 - bits), 0.0)
        part = (hi + large) - large
        parts.append(part)
        hi, lo = plus(hi - part, lo)
    return parts
