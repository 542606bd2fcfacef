"""Whether a list of operations is the function that it was read from: a comparison at points.

`components` reads the list from the jaxpr of a function, and a fault there would prove something
about another map. Here the function is evaluated by JAX, and the list by balls, which contain its
exact value, with a bound of the rounding of one evaluation. The two must agree within `SLACK` times
that bound at every point. A list that differs from its function on a share s of the domain passes
with the probability (1 − s)^n for n points; a difference below the rounding is not seen.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import jax
import numpy as np

from .components import NotAnalytic
from .result import tools

POINTS = 48
"""Points of a comparison: a difference on a tenth of the domain passes with probability 0.6 %."""

SLACK = 2.0**22
"""XLA's functions have errors of up to 500 units of round-off where the bound assumes 8; a
conversion to float32, the finest difference that matters, has up to 3e8."""

_CANDIDATES = 4096


class Mistranslated(NotAnalytic):
    """A list of operations that is not the function it was read from."""


def random_points(
    ends: Sequence[tuple[Any, Any]], condition: Callable | None = None
) -> list[np.ndarray]:
    """Points of the intervals (least, largest), each an array or a number, one array for each.

    Every fourth number is the middle or an end of its interval. `condition`: function of the
    arrays of one point → whether it counts; fewer than `POINTS` rows are returned, or none, if
    fewer are found.
    """
    rng = np.random.default_rng(0)
    columns = []
    for low, high in ends:
        low, high = np.broadcast_arrays(np.asarray(low, float), np.asarray(high, float))
        shares = rng.random((_CANDIDATES, *low.shape))
        special = rng.choice([0.0, 0.5, 1.0], shares.shape)
        shares = np.where(rng.random(shares.shape) < 0.25, special, shares)
        columns.append(low + shares * (high - low))
    counts = np.ones(_CANDIDATES, bool)
    if condition is not None:
        counts = np.asarray(jax.jit(jax.vmap(condition))(*columns))
    return [column[counts][:POINTS] for column in columns]


def compare(subject: str, function: Callable, program: dict, points: Sequence[np.ndarray]) -> int:
    """Compare a function with the list of operations that was read from it.

    `points`: for each argument of the function an array, whose first axis counts the points.

    Returns the number of points at which both have a value. **Raises** `Mistranslated` where they
    differ, or where only the list has a value.
    """
    exact, _ = tools()
    exact.ctx.prec = 160
    algebra = exact.Rounding(exact.UNITS["float64"])
    values = jax.jit(jax.vmap(function))(*points)
    rows = np.concatenate(
        [np.reshape(x, (len(points[0]), -1)) for x in jax.tree.leaves(values)], axis=1
    )
    inputs = np.concatenate([np.reshape(x, (len(x), -1)) for x in points], axis=1)
    count = 0
    for x, row in zip(inputs, rows, strict=True):
        try:
            start = [(exact.ball(Fraction(float(v))), exact.arb(0)) for v in x]
            enclosures = exact.run(program, start, algebra)
        except (exact.Failure, ValueError, ArithmeticError):
            continue  # a singularity, of which the proof speaks
        if not all(ball.is_finite() and error.is_finite() for ball, error in enclosures):
            continue
        for value, (ball, error) in zip(row, enclosures, strict=True):
            tolerance = SLACK * (float(ball.rad()) + float(error.upper()))
            if not abs(value - float(ball.mid())) <= tolerance:
                raise Mistranslated(
                    f"{subject} is {value:.17g} at {x.tolist()}, but the list of operations that "
                    f"was read from it gives {float(ball.mid()):.17g}. Nothing is proved. Please "
                    "report this: the list and the function have to be the same."
                )
        count += 1
    return count
