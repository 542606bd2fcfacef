"""The multipoles of a bend in its own, curved coordinates."""

import math
from collections.abc import Sequence
from typing import Any

from ._maps import Parameters, Particle

HIGHEST = 5
"""Highest power of h y/(1 + h x) in the potential."""

# V(x, y) is a potential of the kicks: ∂V/∂x = (1 + h x) B_y, ∂V/∂y = −(1 + h x) B_x. Without
# sources
#
#     ∂²V/∂y² = −∂²V/∂x² + h/r ∂V/∂x,   r = 1 + h x,
#
# which turns the coefficient h^m r^(1 − m) F(x) of a power of y into that of the next but one,
#
#     −h^m r^(1 − m) F″ + (2m − 1) h^(m + 1) r^(−m) F′ + (1 − m²) h^(m + 2) r^(−1 − m) F.
#
# B_y and B_x in the plane y = 0 are Σ b_n x^n and Σ a_n x^n. They give the first coefficients,
# −r B_x of y and −r ∂B_y/∂x of y²/2. Our own; exact in x.


def _coefficients(count: int) -> tuple[list[list[int]], list[list[int]]]:
    """c of V = … + Σ_km c[k][m] h^m r^(1 − m) (B_x^(2k − m) y^(2k + 1)/(2k + 1)! + …), and those of
    its derivative by x."""
    rows = [[-1]]
    for _ in range(count):
        c = [0, 0, *rows[-1], 0, 0]
        terms = zip(c[2:], c[1:], c, strict=False)
        rows.append([-x + (2 * m - 3) * y + (1 - (m - 2) ** 2) * z
                     for m, (x, y, z) in enumerate(terms)])  # fmt: skip
    rows = [c[: HIGHEST + 1] for c in rows]  # in both: the kick is a gradient, to round-off
    slopes = [
        [x + (2 - m) * y for m, (x, y) in enumerate(zip([*c, 0], [0, *c], strict=True))]
        for c in rows
    ]
    return rows, slopes


_ROWS, _SLOPES = _coefficients(40)


def _derivative(coefficients: Sequence[Any], j: int, x: Any) -> Any:
    """The derivative number j of Σ c_n x^n, 0.0 beyond the last."""
    total = 0.0
    for n in reversed(range(j, len(coefficients))):
        total = total * x + math.perm(n, j) * coefficients[n]
    return total


def curved_kick(z: Particle, length: Any, par: Parameters, order: int) -> Particle:
    """The kick −∇V of the multipoles of a bend over a length [m]. Its divergence is zero, its curl
    up to the power `HIGHEST` of h y/(1 + h x)."""
    r = 1 + par["h"] * z.x
    u = par["h"] * z.y / r
    b, a = ([par[f"{key}{n}"] for n in range(order + 1)] for key in "ba")
    gradient = [r * _derivative(b, 0, z.x), 0.0]
    power = r
    for j in range(order + 1):
        normal, skew = _derivative(b, j + 1, z.x), _derivative(a, j, z.x)
        for i, rows in enumerate((_SLOPES, _ROWS)):
            of_b = of_a = 0.0
            for m in reversed(range((j + 1 - i) % 2, HIGHEST + 2 - i, 2)):
                c = rows[(j + m) // 2][m]
                of_b = of_b * u * u + c / math.factorial(j + m + 1)
                of_a = of_a * u * u + c / math.factorial(j + m)
            first = u if (j + 1 - i) % 2 else 1.0
            gradient[i] = gradient[i] + first * power * (of_a * skew + of_b * normal * z.y)
        power = power * z.y
    return z.plus(px=-length * gradient[0], py=-length * gradient[1])
