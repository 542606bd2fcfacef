"""Levels of an invariant that a trajectory cannot leave."""

import math
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .tools import tools

_LEVELS = (0.99, 0.95, 0.8, 0.6, 0.4)
"""Fractions of the range between the least value in the domain and that at its border that are
tried as the level below which trajectories stay in the domain."""


def confine(
    checker: Any,
    certificate: dict[str, Any],
    functions: list,
    inside: Any,
    shape: Any,
    change: float,
    limits: dict[str, Any],
) -> tuple[tuple[int, int, float] | None, float, str, int]:
    """Complete the certificate by a level below which trajectories stay in the domain.

    Returns (k, sign, level), the scale of the domain that satisfies it, the reason if no level is
    found, and the number of boxes.
    """
    exact, search = tools()
    reach = [exact.exact(x) for x in certificate["reach"]]
    candidates = _candidates(checker, functions, inside, shape, reach)
    reason = "no invariant is larger all around the domain than somewhere inside"
    for k, sign, least, border in candidates:
        each = exact.exact(certificate["per_step"][k]) + exact.exact(certificate["rounding"][k])
        steps = math.floor(Fraction(change) / each) if each else 2**62
        if not steps:
            reason = f"I_{k} may change by more than change={change:g} in one step"
            continue
        for part in _LEVELS:
            level = least + part * (border - least) - change
            if level <= least:
                reason = f"change={change:g} is larger than the range of I_{k} in the domain"
                continue
            ends = [(-math.inf, math.inf)] * len(functions)
            drift = steps * each
            value = Fraction(level)
            ends[k] = (-math.inf, value + drift) if sign > 0 else (-value - drift, math.inf)
            try:
                shell, count = search.enclose(checker, ends, reach, **limits)
            except exact.Failed as error:
                reason = str(error)
                continue
            certificate["levels"][k] = [None, level.hex()] if sign > 0 else [(-level).hex(), None]
            certificate |= {"steps": steps, "shell": shell}
            return (k, sign, level), _scale(checker, k, sign, value), "", count
    return None, 0.0, reason, 0


def _candidates(checker: Any, functions: list, inside: Any, shape: Any, reach: list) -> list[tuple]:
    """(k, sign, least value in the domain, least value around it) of sign·I_k where the latter is
    larger, those first that leave most of the domain; from random points."""
    rng = np.random.default_rng(0)
    low, high = (np.array([float(x) for x in side]) for side in (checker.lower, checker.upper))
    wide = np.array([float(x) for x in reach])
    inner = rng.uniform(low, high, (4000, len(low)))
    near = rng.uniform(low, high, (40000, len(low)))
    axis = rng.integers(0, len(low), len(near))
    rows = np.arange(len(near))
    side = rng.random(len(near)) < 0.5
    near[rows, axis] = np.where(side, low[axis], high[axis])
    outer = near + rng.uniform(0, 1, near.shape) * wide * np.where(near >= high, 1, -1) * (
        (near <= low) | (near >= high)
    )
    if inside is not None:
        keep = jax.jit(jax.vmap(lambda z: jnp.all(inside(*_state(z, shape)) >= 0)))
        near = rng.uniform(low, high, (200000, len(low)))
        near = near[np.asarray(keep(near))]
        moved = near + rng.choice([-1.0, 1.0], near.shape) * wide
        off = ~np.asarray(keep(moved)) | (moved < low).any(1) | (moved > high).any(1)
        inner, outer = near[:4000], moved[off][:40000]
    epsilons = [float(x) for x in checker.epsilon]
    found = []
    for k, (function, _) in enumerate(functions):
        value = jax.jit(jax.vmap(lambda z, e, f=function: f(*_state(z, shape), e), (0, None)))
        around = np.concatenate([np.asarray(value(outer, e)) for e in epsilons])
        within = np.concatenate([np.asarray(value(inner, e)) for e in epsilons])
        for sign in (1, -1):
            border, least = float(np.min(sign * around)), float(np.min(sign * within))
            if border > least:
                share = float(np.mean(sign * within < border))
                found.append((share, (k, sign, least, border)))
    return [item for _, item in sorted(found, key=lambda pair: -pair[0])]


def _state(z: Any, shape: Any) -> tuple[Any, Any]:
    q, p = jnp.split(z, 2)
    return q.reshape(shape), p.reshape(shape)


def _scale(checker: Any, k: int, sign: int, level: Fraction) -> float:
    """The largest factor (to 1 %) by which the domain may be scaled about its middle so that
    sign·I_k ≤ level in it."""
    exact, _ = tools()
    sides = list(zip(checker.lower, checker.upper, strict=True))
    good = 0.0
    for i in range(1, 101):
        s = Fraction(i, 100)
        box = [((a + b) / 2 - s * (b - a) / 2, (a + b) / 2 + s * (b - a) / 2) for a, b in sides]
        algebra, x = checker.models([*box, checker.epsilon])
        low, high = algebra.range(exact.run(checker.invariants[k], x, algebra)[0])
        if (high if sign > 0 else -low) > level:
            break
        good = i / 100
    return good
