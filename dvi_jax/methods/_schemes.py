"""Coefficients of splitting methods: which part acts for which fraction of the step."""

import functools
import itertools
import math
from collections.abc import Iterable
from fractions import Fraction
from typing import Any

import numpy as np

from ._composition import CompositionMethod
from ._type_ii import TypeII

Flows = tuple[tuple[int, float], ...]
"""(part, fraction of h), the one that acts first in front."""

Orders = tuple[int, ...]

ORDERS_OF_CORRECTORS = (3, 5, 7, 11, 17)

_LARGEST = 10

# The first halves of a₁, a₂, … and of b₁, b₂, …, as in A(a₁h) B(b₁h) A(a₂h) B(b₂h) … A(a₁h). The
# middle coefficient is computed, so that the sums are 1 to the last digit.
_COEFFICIENTS: dict[Orders, tuple[tuple[float, ...], tuple[float, ...]]] = {
    (8, 4): ((0.0753469602698929, 0.5179168546882568), (0.1902259393736766, 0.8465240704435263)),
    (10, 4): (
        (0.04706710064597250613, 0.1847569354170881069, 0.2827060056798362053),
        (0.1188819173681970200, 0.2410504605515015657, -0.2732866667053238061),
    ),
    (8, 6, 4): (
        (0.0711334264982231178, 0.2411534279566400987, 0.5214117617728147892),
        (0.1830836874721972220, 0.3107828598985748695, -0.0265646185119588007),
    ),
    (10, 6, 4): (
        (
            *(0.0380944974224121955, 0.1452987161169137493),
            *(0.2076276957255412507, 0.4359097036515261592),
        ),
        (0.0958588808370752106, 0.2044461531429987807, 0.2170703479789911017),
    ),
}


@functools.cache
def near_integrable(orders: Orders) -> tuple[tuple[float, ...], ...] | None:
    """All a and b of the symmetric scheme of generalised orders, for A + εB; None if unknown."""
    if len(orders) == 2 and orders[1] == 2 and orders[0] in range(2, _LARGEST + 2, 2):
        # Gauss's quadrature of the perturbation: nodes and weights.
        x, w = np.polynomial.legendre.leggauss(orders[0] // 2)
        a, b = np.diff([0.0, *((x + 1) / 2), 1.0]), w / 2
        # Symmetric to the last bit, because the reversal of a step depends on it.
        return tuple(((a + a[::-1]) / 2).tolist()), tuple(((b + b[::-1]) / 2).tolist())
    if orders not in _COEFFICIENTS:
        return None
    a, b = _COEFFICIENTS[orders]
    # A has one coefficient more than B. The even number of the two has a pair in the middle.
    even, odd = (a, b) if len(a) == len(b) else (b, a)
    even, odd = (*even, 0.5 - math.fsum(even)), (*odd, 1 - 2 * math.fsum(odd))
    sequences = (*even, *even[::-1]), (*odd, *odd[-2::-1])
    return sequences if len(a) == len(b) else sequences[::-1]


def sequence_of(scheme: Any, parts: int) -> Flows:
    """The flows of a scheme. **Raises** `ValueError` if it is not for this number of parts."""
    if isinstance(scheme, tuple):
        coefficients = near_integrable(scheme)
        assert coefficients is not None
        if parts != 2:
            raise ValueError(
                f"the scheme {scheme} requires two parts, A + εB, got {parts}. Use "
                "dvi.Split(..., perturbed=1) or dvi.Strang()."
            )
        a, b = coefficients
        pairs = itertools.zip_longest(a, b)
        return tuple((i, c) for pair in pairs for i, c in enumerate(pair) if c is not None)
    # The map is one part after the other, the adjoint the opposite order.
    orders = itertools.cycle((range(parts), range(parts)[::-1]))
    pairs = zip(scheme.fractions(), orders, strict=False)
    return join_neighbours((i, c) for c, order in pairs for i in order)


def join_neighbours(stages: Iterable[tuple[int, float]]) -> Flows:
    """The same flows, with neighbouring flows of one part as one flow."""
    groups = itertools.groupby(stages, key=lambda stage: stage[0])
    return tuple((i, math.fsum(c for _, c in group)) for i, group in groups)


def as_scheme(scheme: Any) -> Any:
    return tuple(scheme) if isinstance(scheme, list) else scheme


def check_scheme(scheme: Any) -> None:
    """**Raises** `TypeError` or `ValueError` for a scheme that is not known."""
    schemes = [*((n, 2) for n in range(2, _LARGEST + 2, 2)), *_COEFFICIENTS]
    names = f"a tuple of generalised orders, one of {', '.join(map(str, schemes))}"
    if isinstance(scheme, tuple):
        if near_integrable(scheme) is None:
            raise ValueError(f"scheme must be {names}, got {scheme}.")
    elif not isinstance(scheme, CompositionMethod) or scheme.base != TypeII():
        raise TypeError(
            f"scheme must be a composition such as dvi.Strang(), or {names}, got {scheme!r}."
        )


@functools.cache
def corrector(order: int) -> tuple[tuple[float, float], ...]:
    r"""The pairs (a, b) of a symplectic corrector of leapfrog, C = Π Z(a h, b h), order 3, 5, … 17.

    With x = h ad_A the first-order error of A(½) B A(½) is ε (x/(2 sinh x/2) − 1) B. The product

        Z(a, b) = A(a) B(b) A(−2a) B(−b) A(a),    a = ±α, ±2α, …,  α = √(7/40)

    is exp(2ε b sinh(a x) B) to first order, and conjugation by it adds −2 b x sinh(a x) for each
    pair. b solves the linear equations by which the terms up to x^order vanish.
    """
    s, square = (order - 1) // 2, Fraction(7, 40)
    # x/(2 sinh x/2) − 1 = Σ_k B_2k(1/2) x^2k/(2k)!, from the reciprocal of the series of sinh.
    sinh = [Fraction(1, 4**k * math.factorial(2 * k + 1)) for k in range(s + 1)]
    error = [Fraction(1)]
    for k in range(1, s + 1):
        error.append(-sum((sinh[j] * error[k - j] for j in range(1, k + 1)), Fraction(0)))
    # Unknown β_i = b_i α: Σ_i 4 β_i i^(2k−1) α^(2k−2)/(2k − 1)! = error_k for k = 1, …, s
    rows = [
        [4 * Fraction(i) ** (2 * k - 1) * square ** (k - 1) / math.factorial(2 * k - 1)
         for i in range(1, s + 1)]
        for k in range(1, s + 1)
    ]  # fmt: skip
    beta = _solve(rows, error[1:])
    alpha = math.sqrt(square)
    half = [(i * alpha, float(x) / alpha) for i, x in enumerate(beta, 1)]
    return (*((-a, -b) for a, b in reversed(half)), *half)


def _solve(rows: list[list[Fraction]], right: list[Fraction]) -> list[Fraction]:
    """The solution of a small linear system in fractions."""
    full = [[*row, r] for row, r in zip(rows, right, strict=True)]
    n = len(full)
    for i in range(n):
        full[i] = [x / full[i][i] for x in full[i]]
        for j in range(n):
            if j != i:
                full[j] = [x - full[j][i] * y for x, y in zip(full[j], full[i], strict=True)]
    return [row[-1] for row in full]
