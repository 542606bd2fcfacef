"""Levels of a combination of invariants that a trajectory cannot leave."""

import math
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linprog

from .result import combination, tools

_LEVELS = (0.97, 0.9, 0.75, 0.5)
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
) -> tuple[tuple[tuple[float, ...], float] | None, float, str, int]:
    """Complete the certificate by a level below which trajectories stay in the domain.

    Returns (weights, level), the scale of the domain that satisfies it, the reason if no level is
    found, and the number of boxes.
    """
    exact, search = tools()
    checker.bits = exact.LEVEL
    names = ("per_step", "rounding", "reach")
    per_step, rounding, reach = ([exact.number(x) for x in certificate[name]] for name in names)
    start, limit = _start(checker)
    turns = [*zip(checker.angles, reach, checker.ends, strict=False)]
    rotations = [int((q - max(-a, b)) / m) for q, m, (a, b) in turns if q and m]
    certificate["start"] = start.hex()
    reason = "no combination of the invariants is larger all around the domain than inside"
    for weights, minimum, border, state in _candidates(
        checker, functions, inside, shape, reach, start
    ):
        w = [Fraction(x) for x in weights]
        rate = sum(abs(x) * (b + r) for x, b, r in zip(w, per_step, rounding, strict=True))
        steps = math.floor(Fraction(change) / rate) if rate else 2**62
        if certificate["timed"]:
            steps = min(steps, limit)
        steps = min(steps, *rotations, 2**62)
        if not steps:
            reason = f"{combination(weights)} may change by more than change={change:g} in one step"
            continue
        for part in _LEVELS:
            level = minimum + part * (border - minimum) - change
            if level <= minimum:
                reason = f"change={change:g} is larger than the range of {combination(weights)}"
                continue
            value, example = Fraction(level), [(Fraction(x),) * 2 for x in state]
            algebra, least = exact.combination_model(checker, w, example)
            if algebra.range(least)[1] > value:
                continue
            quick = _value(functions, weights, shape, float(checker.h))
            try:
                shell, count = search.enclose(
                    checker, w, value + steps * rate, reach, quick, **limits
                )
            except exact.Failure as error:
                reason = str(error)
                continue
            certificate |= {"level": [[x.hex() for x in weights], level.hex()]}
            certificate |= {"steps": steps, "shell": shell, "example": [x.hex() for x in state]}
            return (tuple(weights), level), _scale(checker, w, value), "", count
    return None, 0.0, reason, 0


def _start(checker: Any) -> tuple[float, int]:
    """The time at which trajectories start that stay longest in the interval of times, and the
    number of their steps."""
    begin, end = checker.time
    first, last = checker.times(Fraction(0), 1)
    if first == last:
        return float(begin), 2**62
    start = Fraction(float(begin + (end - begin) * first / (first - last)))
    limits = [(side - start) / rate for side, rate in ((end, last), (begin, first)) if rate]
    return float(start), max(0, math.floor(min(limits)))


def _value(functions: list, weights: list[float], shape: Any, h: float) -> Any:
    """Σ w_k I_k of an array of points (q, p, t, ε)."""
    terms = [(w, f) for w, (f, _) in zip(weights, functions, strict=True) if w]
    return jax.jit(
        jax.vmap(lambda x: sum(w * f(*_state(x[:-2], shape), x[-2], x[-1], h) for w, f in terms))
    )


def _candidates(
    checker: Any, functions: list, inside: Any, shape: Any, reach: list, start: float
) -> list[tuple]:
    """(weights, least value in the domain at the start, least value around it, the state
    (q, p, t, ε) of the former) of Σ w_k I_k where the latter is larger, those first that leave most
    of the domain; from random points."""
    inner, outer = _points(checker, inside, shape, [float(x) for x in reach])
    middle = (np.array(checker.lower, float) + np.array(checker.upper, float))[None] / 2
    starts = [(start, float(e)) for e in checker.epsilon]
    pairs = [(float(t), float(e)) for t in checker.time for e in checker.epsilon]
    h = float(checker.h)

    def values(z, pairs):
        evaluate = jax.jit(
            jax.vmap(
                lambda z, t, e: jnp.stack([f(*_state(z, shape), t, e, h) for f, _ in functions]),
                (0, None, None),
            )
        )
        rows = np.concatenate([np.asarray(evaluate(z, t, e)) for t, e in pairs])
        return np.where(np.isfinite(rows), rows, 0.0)  # candidates only: the checker decides

    inner_values, outer_values = values(inner, starts), values(outer, pairs)
    center = values(middle, starts)[0]
    weights = [sign * unit for unit in np.eye(len(functions)) for sign in (1, -1)]
    if len(functions) > 1:
        weights[:0] = _best_combination(inner_values - center, outer_values - center)
    candidates = []
    for w in weights:
        border, minimum = float(np.min(outer_values @ w)), float(np.min(inner_values @ w))
        if border > minimum:
            share = float(np.mean(inner_values @ w < border))
            lap, place = divmod(int(np.argmin(inner_values @ w)), len(inner))
            state = [*inner[place].tolist(), *starts[lap]]
            candidates.append((share, (w.tolist(), minimum, border, state)))
    return [item for _, item in sorted(candidates, key=lambda pair: -pair[0])]


def _best_combination(inner_values: np.ndarray, outer_values: np.ndarray) -> list[np.ndarray]:
    """The w whose least w·I around the domain is largest next to its mean inside: a linear program.
    Empty if no w·I is larger around the domain than at its middle, where I is 0 here."""
    mean = np.mean(inner_values, axis=0)
    n = len(mean)
    size = np.std(inner_values, axis=0) + 1e-300
    # max m  with  w·I(border) ≥ m  and  w·mean = 1.
    border = outer_values[:: max(1, len(outer_values) // 20000)]
    rows = np.column_stack([-border / size, np.ones(len(border))])
    solution = linprog(
        [*np.zeros(n), -1.0],
        A_ub=rows,
        b_ub=np.zeros(len(rows)),
        A_eq=[[*(mean / size), 0.0]],
        b_eq=[1.0],
        bounds=[(None, None)] * (n + 1),
    )
    if solution.status or solution.x[-1] <= 0:
        return []
    w = solution.x[:n] / size
    w = w / np.max(np.abs(w))
    return [np.where(np.abs(w) < 1e-6, 0.0, w)]


def _points(checker: Any, inside: Any, shape: Any, reach: list) -> tuple[np.ndarray, np.ndarray]:
    """Random states of the domain, and around it within `reach`."""
    rng, wide = np.random.default_rng(0), np.array(reach)
    low, high = (np.array([float(x) for x in side]) for side in (checker.lower, checker.upper))
    has_end = np.array([not q for q in checker.angles] + [True] * checker.n)  # a circle has none
    inner = rng.uniform(low, high, (4000, len(low)))
    border_points = rng.uniform(low, high, (40000, len(low)))
    axis = rng.choice(np.flatnonzero(has_end), len(border_points))
    rows = np.arange(len(border_points))
    side = rng.random(len(border_points)) < 0.5
    border_points[rows, axis] = np.where(side, low[axis], high[axis])
    outer = border_points + rng.uniform(0, 1, border_points.shape) * wide * np.where(
        border_points >= high, 1, -1
    ) * ((border_points <= low) | (border_points >= high))
    if inside is None:
        return inner, outer
    keep = jax.jit(jax.vmap(lambda z: jnp.all(inside(*_state(z, shape)) >= 0)))
    border_points = rng.uniform(low, high, (200000, len(low)))
    border_points = border_points[np.asarray(keep(border_points))]
    neighbours = border_points + rng.choice([-1.0, 1.0], border_points.shape) * wide
    is_outside = (((neighbours < low) | (neighbours > high)) & has_end).any(1)
    is_outside |= ~np.asarray(keep(neighbours))
    return border_points[:4000], neighbours[is_outside][:40000]


def _state(z: Any, shape: Any) -> tuple[Any, Any]:
    q, p = jnp.split(z, 2)
    return q.reshape(shape), p.reshape(shape)


def _scale(checker: Any, weights: list, level: Fraction) -> float:
    """The largest factor (to 1 %) by which the domain may be scaled about its middle so that
    Σ w_k I_k ≤ level in it. Angles are not scaled."""
    exact, search = tools()
    *sides, (begin, end), epsilon = checker.root()
    width = (end - begin) / 16
    spans = [(begin + i * width, begin + (i + 1) * width) for i in range(16 if width else 1)]
    good, bad = 0, 101
    while bad - good > 1:
        i = (good + bad) // 2
        box = [((a + b) / 2 - i * (b - a) / 200, (a + b) / 2 + i * (b - a) / 200) for a, b in sides]
        pairs = zip(checker.angles, checker.ends, box[: checker.n], strict=False)
        box[: checker.n] = [circle if q else part for q, circle, part in pairs]
        try:
            parts = [
                exact.combination_model(checker, weights, [*box, span, epsilon]) for span in spans
            ]
            fits = all(algebra.range(value)[1] <= level for algebra, value in parts)
        except search.SINGULAR:
            fits = False
        good, bad = (i, bad) if fits else (good, i)
    return good / 100
