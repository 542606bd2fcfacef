"""Sampled points, at which symmetries and invariants are tested."""

from typing import Any, NamedTuple

import numpy as np

from .basis import BoundBasis


class Samples(NamedTuple):
    """Points (q, p) at times t: shapes (S, *shape), (S, *shape), (S,)."""

    q: np.ndarray
    p: np.ndarray
    t: np.ndarray

    @property
    def held_out(self) -> np.ndarray:
        """Which points are not fitted but judge the fit: every fourth."""
        return np.arange(len(self.q)) % 4 == 3


def as_samples(samples: Any, t0: float = 0.0) -> Samples:
    """(qs, ps) at the time t0, or (qs, ps, ts), after refusing what cannot be sampled points."""
    if isinstance(samples, Samples):
        return samples
    try:
        arrays = [np.asarray(x, float) for x in samples]
    except (TypeError, ValueError):
        arrays = []
    if len(arrays) not in (2, 3):
        raise ValueError(
            "samples must be a pair (qs, ps) of arrays with one row for each point, or (qs, ps, "
            "ts) with their times."
        )
    q, p = arrays[:2]
    if q.shape != p.shape or q.ndim < 1 or len(q) == 0:
        raise ValueError(
            f"samples (qs, ps) must have one shape (points, *q.shape), got {q.shape} and {p.shape}."
        )
    t = arrays[2] if len(arrays) == 3 else np.full(len(q), float(t0))
    if t.shape != (len(q),):
        raise ValueError(f"the times of {len(q)} samples must have shape ({len(q)},): {t.shape}.")
    if not all(np.isfinite(x).all() for x in (q, p, t)):
        raise ValueError("samples hold a value that is not finite: take points of the domain.")
    return Samples(q, p, t)


def require_enough(samples: Samples, unknowns: int, conditions: int = 1) -> None:
    """Refuse fewer samples than determine `unknowns`, with `conditions` from each one."""
    needed = int(np.ceil(2 * unknowns / conditions))
    if len(samples.q) < needed:
        raise ValueError(
            f"{len(samples.q)} samples are too few for {unknowns} basis functions (a quarter is "
            f"held out): give at least {needed}."
        )


def require_time(basis: BoundBasis, samples: Samples) -> None:
    """Refuse a basis with functions of time when all samples are of one time."""
    if basis.uses_time and np.ptp(samples.t) == 0:
        raise ValueError(
            "the basis has functions of time, and all samples are of one time: give samples=(qs, "
            "ps, ts)."
        )


def require_steps(good: Any, samples: Samples) -> None:
    """Refuse samples at which the map's step failed."""
    good = np.asarray(good)
    if not good.all():
        i = int(np.argmin(good))
        raise ValueError(
            f"the step fails at {int(np.sum(~good))} of {len(good)} samples, first at q = "
            f"{samples.q[i].tolist()}, p = {samples.p[i].tolist()}: take samples where the map is "
            "defined, or a smaller h."
        )
