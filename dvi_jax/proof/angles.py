"""Angles: coordinates q_i whose domain is a circle, so that no trajectory leaves it there."""

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from .result import tools

_LARGEST = 2.0**30
"""Largest angle of a proof: sin and cos of such numbers are computed without a loss of digits."""


def angles_of(periodic: Any, shape: tuple[int, ...]) -> list[bool]:
    """Which of the raveled q are angles; `periodic`: None, a boolean, or an array of them like q.

    **Raises** `ValueError` for another type or shape.
    """
    flags = np.asarray(False if periodic is None else periodic)
    if flags.dtype != bool or flags.shape not in ((), shape):
        raise ValueError(
            f"periodic must be True or a boolean array like q, of shape {shape}, got {periodic!r}."
        )
    return np.broadcast_to(flags, shape).ravel().tolist()


def circles(
    sides: tuple[list[float], list[float]], flags: Sequence[bool]
) -> tuple[list[float], list[float]]:
    """The domain with one whole turn of each angle, about the middle of its interval.

    A turn is 2π, which is not a number of float64: the next larger interval is taken. **Raises**
    `ValueError` for an interval of less than a turn, where the domain would not be the circle.
    """
    lower, upper = map(list, sides)
    half = math.nextafter(math.pi, 4.0)
    for i in np.flatnonzero(flags):
        width = upper[i] - lower[i]
        if width < 2 * math.pi - 1e-9:
            raise ValueError(
                f"domain of the angle q{i + 1} must be a whole turn, such as the half-width np.pi, "
                f"got [{lower[i]!r}, {upper[i]!r}]. Without periodic it may be a part of it."
            )
        lower[i] = float((lower[i] + upper[i]) / 2 - half)
        upper[i] = float(lower[i] + 2 * half)
        while Fraction(upper[i]) - Fraction(lower[i]) < 2 * Fraction(half):
            upper[i] = math.nextafter(upper[i], math.inf)
    return lower, upper


def largest_angles(
    checker: Any, flags: Sequence[bool], changes: Sequence[float], change: float
) -> list[str]:
    """The largest |q_i| of computed states for which the rounding is bounded; 0 for no angle.

    An angle that rotates grows by `move` in a step, and its rounding grows with it. N steps need
    |q_i| ≤ N·move. With N = change/s, where s is the largest change in a step, a larger angle would
    be of no use; with N = √(change/(u·move)), where u is the unit round-off, rounding alone changes
    an invariant by `change`.
    """
    exact, search = tools()
    rng, algebra = np.random.default_rng(2), exact.Rounding(0)
    moves = np.zeros(checker.n)
    for _ in range(64 if any(flags) else 0):
        point = [a + (b - a) * Fraction(rng.random()) for a, b in checker.root()]
        try:
            start, end = checker.states_of_step(
                [(exact.ball(v), exact.arb(0)) for v in point], algebra
            )
        except search.SINGULAR:
            continue
        pairs = zip(start[: checker.n], end, strict=False)
        values = np.array([float(abs(b[0] - a[0]).upper()) for a, b in pairs])
        moves = np.maximum(moves, np.where(np.isfinite(values), values, 0))
    smallest = min((s for s in changes if s), default=0.0)
    largest = []
    for i, move in enumerate(1.2 * moves):
        steps = math.sqrt(change / (float(checker.unit) * move)) if move else 0.0
        steps = min(steps, change / smallest) if smallest else steps
        border = max(-checker.lower[i], checker.upper[i])
        value = float(border) + min(steps * move, _LARGEST)
        largest.append(math.nextafter(value, math.inf) if flags[i] else 0.0)
    return [value.hex() for value in largest]
