"""The fraction of particles that are lost, with its statistical error."""

from typing import Any, NamedTuple

import numpy as np

from ...base.checks import known, positive
from ...base.printing import printable


@printable
class LossFraction(NamedTuple):
    """Fraction of lost particles at times: the estimate, and the ends of its interval."""

    t: np.ndarray
    fraction: np.ndarray
    low: np.ndarray
    high: np.ndarray


def loss_fraction(stop_t: Any, times: Any, sigmas: float = 1.0) -> LossFraction:
    r"""Fraction of the particles that are lost up to each time, with Wilson's interval.

        (p + z²/2N ± z √(p(1 − p)/N + z²/4N²)) / (1 + z²/N)

    - `stop_t`: times of the losses, NaN for particles that are not lost: the variable ``stop_t`` of
      a sweep, or ``solution.stop.t``. Trajectories that failed must be left out or counted before.
    - `times`: in the same unit. `sigmas`: z, 1 for an interval of 68 %.

    **Raises** `ValueError` without particles, or for z ≤ 0.

    **Source** Wilson 1927, *J. Am. Stat. Assoc.* 22, 209.
    """
    z = positive("sigmas", sigmas)
    stops, times = known("stop_t", stop_t, float).ravel(), known("times", times, float)
    if stops.size == 0:
        raise ValueError("stop_t must have an entry for each particle, got none.")
    losses = np.sort(stops[np.isfinite(stops)])
    p, N = np.searchsorted(losses, times, side="right") / stops.size, stops.size
    middle = (p + z**2 / (2 * N)) / (1 + z**2 / N)
    half = z * np.sqrt(p * (1 - p) / N + z**2 / (4 * N**2)) / (1 + z**2 / N)
    return LossFraction(times, p, np.maximum(middle - half, 0), np.minimum(middle + half, 1))
