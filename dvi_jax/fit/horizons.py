"""Fitting horizon of each stage of a fit."""

import numpy as np

from .model import Group, weighed
from .problem import Problem

_FURTHER = 1.02
"""By how much a horizon grows at least where trajectories that fail do not let it double."""

_OFF = 0.5
"""Misfit, relative to the scatter of the data, up to which a fit of everything is trusted to find
the nearest minimum: half of it is a sixth of a period's phase."""


def full_horizon(problem: Problem) -> float:
    """The longest time between the start of an arc and one of its observations."""
    return max(float(_since(group).max()) for group in problem.groups)


def suitable_horizon(problem: Problem, rows: list[np.ndarray], at_least: float = 0.0) -> float:
    """The longest of full, full/2, full/4, … over which the misfit is small beside the scatter of
    the data; the shortest that has enough of them for the parameters where none is, but not beyond
    the first prediction that is not finite.

    - `rows`: whitened residuals (A, N, K) of each group. `at_least`: a horizon to go beyond.

    Infinite stands for everything.
    """

    def seen(of_groups):
        pairs = zip(of_groups, problem.groups, strict=True)
        return np.concatenate([np.broadcast_to(x, g.seen.shape)[g.seen] for x, g in pairs])

    full, shortest = full_horizon(problem), np.inf
    allowed = _OFF * np.sqrt(np.mean(seen(map(_scatter, problem.groups)) ** 2))
    since, misfit = seen(_since(g)[..., None] for g in problem.groups), seen(rows)
    enough = 2 * max(problem.size - problem.space.count_of_priors, 1)
    horizon = full
    while horizon > at_least:
        inside = since <= horizon * (1 + 1e-12)
        if inside.sum() < enough:
            break
        if np.isfinite(misfit[inside]).all() and np.sqrt(np.mean(misfit[inside] ** 2)) <= allowed:
            return np.inf if horizon == full else horizon
        shortest = horizon
        horizon /= 2
    lost = since[~np.isfinite(misfit)].min(initial=np.inf)
    if shortest >= lost > _FURTHER * at_least / 2:
        return lost * (1 - 1e-9)
    return np.inf if shortest >= full else shortest


def _since(group: Group) -> np.ndarray:
    return np.abs(group.ts - group.t0[:, None])


def _scatter(group: Group) -> np.ndarray:
    """Observed values minus their mean over the arc, in standard errors, (A, N, K)."""
    count = np.maximum(group.seen.sum(axis=1, keepdims=True), 1)
    mean = np.where(group.seen, group.values, 0).sum(axis=1, keepdims=True) / count
    return weighed(np.where(group.seen, group.values - mean, 0.0), group.whiten)
