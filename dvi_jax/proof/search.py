"""The search for a certificate: boxes, bounds, levels. What it finds, the checker decides."""

import contextlib
import heapq
import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from flint import arb, ctx

from . import checker as exact

_BITS = (20, 26, 32, 40, 50, 60, 75, 90, 110, 140)
"""Binary digits of the models that are tried."""
SINGULAR = exact.Failure, ValueError, ArithmeticError
"""Errors of an evaluation on a box with a singularity."""
_POINTS = 64
"""Random points of a box at which a change is evaluated, for a lower estimate of its supremum."""
_BATCH = 32
"""Boxes that are examined at once, for any number of processors: the result is the same for all."""


@dataclass
class Leaf:
    """A box and what was found there.

    - `failure`: why nothing is bounded there.
    - `bounds`, `extremes`: for each invariant a bound of the change, and the largest one seen.
    - `rounding`, `displacement`: changes by rounding, and how far a step moves each coordinate.
    - `remainders`: of the models of the changes. `shares`: for each invariant and coordinate, by
      how much the bound would decrease if the coordinate were cut.
    - `axis`, `parts`: of the cut, if there is one. `number`: of the box in the tree; its halves
      have the numbers 2 `number` and 2 `number` + 1.
    """

    box: list
    number: int = 1
    failure: str = ""
    is_outside: bool = False
    bounds: list = field(default_factory=list)
    extremes: list = field(default_factory=list)
    rounding: list = field(default_factory=list)
    displacement: list = field(default_factory=list)
    remainders: list = field(default_factory=list)
    shares: list = field(default_factory=list)
    axis: int = 0
    parts: list = field(default_factory=list)


def examine(checker: Any, box: list, rng: Any, identities: frozenset = frozenset()) -> Leaf:
    """Everything that is bounded on one box; `identities`: numbers of what is conserved exactly."""
    leaf = Leaf(box)
    try:
        algebra, x = checker.models(box)
        if not checker.implicit and checker.is_outside(algebra, x):
            leaf.is_outside = True
            return leaf
        leaf.rounding, errors = checker.rounding(box)  # first: it takes little time, and may fail
        step = checker.states_of_step(x, algebra)
        moves = checker.displacement(step, algebra)
        if checker.implicit:
            pairs = zip(moves[checker.n :], checker.spread, strict=True)
            exact.require(all(m <= s for m, s in pairs), "p1 is further from p0 than `spread`")
            if checker.is_outside(algebra, step[0]):
                leaf.is_outside = True
                return leaf
        changes = [checker.change(k, step, algebra) for k in range(len(checker.invariants))]
        rows = enumerate(changes)
        leaf.bounds = [Fraction(0) if k in identities else algebra.bound(x) for k, x in rows]
        leaf.remainders = [change[1] / algebra.unit for change in changes]
        points = _points(box, rng)
        counts = _is_inside(checker, algebra, step[0], points)
        leaf.extremes = [_largest(algebra, change, points[counts]) for change in changes]
        corner = [(x := side[rng.integers(2)], x) for side in box]
        for k in identities:  # boxes are cut until the bound of the rounding is near that of points
            leaf.extremes[k] = checker.rounding(corner)[0][k]
        leaf.shares = [_shares(change, len(box)) for change in changes]
        pairs = zip(moves, errors, strict=True)
        leaf.displacement = [exact.round_up(m + Fraction(e)) for m, e in pairs]
        finite = all(map(math.isfinite, (*leaf.rounding, *leaf.displacement)))
        exact.require(finite, "a value is not bounded")
    except SINGULAR as error:
        leaf.failure = str(error) if isinstance(error, exact.Failure) else "a function is singular"
    return leaf


def _part(checker: Any, identities: frozenset, part: tuple[list, int]) -> Leaf:
    """A box with its number, which selects the random points."""
    leaf = examine(checker, part[0], np.random.default_rng(part[1]), identities)
    leaf.number = part[1]
    return leaf


def curved_axes(checker: Any) -> set[int]:
    """The coordinates on which the arguments of elementary functions in the step depend."""
    operations = checker.step["operations"]
    indices, inputs = set(), set()
    for i in reversed(range(len(operations))):
        name, *operands = operations[i]
        if name == "input" and i in indices:
            inputs.add(operands[0])
        elif name in exact.FUNCTIONS or (i in indices and name != "constant"):
            indices.update(operands[:1] if name == "inexact" else operands)
    return inputs & {*range(2 * checker.n + 2)}


def estimate(checker: Any) -> list[float]:
    """The largest change of each I_k at random points of the domain; 0 where all contain 0."""
    rng, algebra = np.random.default_rng(1), exact.Rounding(0)
    maxima = [0.0] * len(checker.invariants)
    for _ in range(_POINTS):
        x = [(exact.ball(a + (b - a) * Fraction(rng.random())), arb(0)) for a, b in checker.root()]
        x[-1] = (exact.ball(checker.epsilon[1]), arb(0))
        try:
            step = checker.states_of_step(x, algebra)
            sides = zip(step[0], checker.lower, checker.upper, strict=False)
            is_outside = any(not float(a) <= float(x[0]) <= float(b) for x, a, b in sides)
            if is_outside or any(g[0] < 0 for g in exact.run(checker.inside, step[0], algebra)):
                continue
            changes = [checker.change(k, step, algebra)[0] for k in range(len(maxima))]
        except SINGULAR:
            continue
        maxima = [max(s, float(abs(c).lower())) for s, c in zip(maxima, changes, strict=True)]
    return maxima


def resolve(checker: Any, changes: list[float], ratio: float) -> None:
    """Choose the number of bits: remainders shall be small next to the changes.

    Few bits are faster; a change that nearly cancels needs many.
    """
    rng, bits = np.random.default_rng(0), [*_BITS]
    checker.bits = bits.pop(0)
    leaf = _bounded_part(checker, rng, checker.root())
    while leaf is not None and bits:  # or nothing is bounded there: `subdivide` says where
        rows = enumerate(zip(leaf.remainders, changes, strict=True))
        open_invariants = [k for k, (r, s) in rows if s and r > s * min(ratio - 1, 4) / 5]
        if not open_invariants:
            return
        bits_before, checker.bits = checker.bits, bits[0]
        finer = examine(checker, leaf.box, rng)
        pairs = zip(finer.remainders, leaf.remainders, strict=False)  # none, if `finer` failed
        gains = [a <= b / 4 for a, b in pairs]
        if not gains or not all(gains[k] for k in open_invariants):
            # More bits do not help much: the box is too large.
            checker.bits = bits_before
            leaf = _bounded_part(checker, rng, [half(s, rng.random() < 0.5) for s in leaf.box])
        else:
            leaf = finer
            bits.pop(0)


def _bounded_part(checker: Any, rng: Any, root: list) -> Leaf | None:
    """A box or a part of it on which something is bounded; None if 60 parts have failed."""
    box = root
    for _ in range(60):
        leaf = examine(checker, box, rng)
        if not (leaf.failure or leaf.is_outside):
            return leaf
        box = root if leaf.is_outside else box
        box = [half(side, rng.random() < 0.5) for side in box]
    return None


def half(side: tuple, upper: bool) -> tuple:
    """A half of an interval."""
    middle = (side[0] + side[1]) / 2
    return (middle, side[1]) if upper else (side[0], middle)


def _points(box: list, rng: Any) -> np.ndarray:
    """Points s of a box, |s| ≤ 1, with the largest ε."""
    s = rng.choice([-1.0, -0.7, -0.3, 0.0, 0.3, 0.7, 1.0], (_POINTS, len(box)))
    s[:, -1] = 1.0 if box[-1][0] == 0 else s[:, -1]
    return s


def _values(algebra: exact.Models, model: Any, s: np.ndarray) -> np.ndarray:
    """The polynomial of a model at points s."""
    terms = model[0].to_dict()
    powers = np.array([[int(k) for k in powers] for powers in terms]).reshape(-1, s.shape[1])
    values = np.array([float(Fraction(int(c), algebra.unit)) for c in terms.values()])
    # Not by BLAS, whose rounding depends on the number of its threads.
    return np.einsum("ij,j->i", np.prod(s[:, None, :] ** powers[None], axis=2), values)


def _largest(algebra: exact.Models, model: Any, s: np.ndarray) -> float:
    """A lower bound of the largest |value| at points s."""
    values = np.abs(_values(algebra, model, s))
    return max(0.0, float(np.max(values, initial=0.0)) - float(Fraction(model[1], algebra.unit)))


def _is_inside(checker: Any, algebra: exact.Models, x: list, s: np.ndarray) -> Any:
    """Which of the points s are states of the domain; `x`: the state as models."""
    good = np.ones(len(s), bool)
    sides = zip(x, checker.lower, checker.upper, strict=False)
    for model, low, high in sides if checker.implicit else ():
        value = _values(algebra, model, s)
        good &= (value >= float(low)) & (value <= float(high))
    for model in exact.run(checker.inside, x, algebra):
        good &= _values(algebra, model, s) >= 0
    return good


def _shares(model: Any, size: int) -> list[float]:
    """By how much Σ |coefficients| would decrease if a coordinate of the box were half as wide."""
    terms = model[0].to_dict()
    powers = np.array([[int(k) for k in powers] for powers in terms]).reshape(-1, size)
    sizes = np.array([abs(float(c)) for c in terms.values()])
    return np.einsum("i,ij->j", sizes, 1 - 0.5**powers).tolist()


class TooMany(exact.Failure):
    """The subdivision reached its limit."""


@dataclass
class Subdivision:
    """A subdivision: its tree of cuts, the number of its boxes, and the largest bounds."""

    tree: Any
    count: int
    bounds: list
    extremes: list
    rounding: list
    displacement: list


def subdivide(
    checker: Any,
    identities: frozenset,
    best: list[float],
    *,
    ratio: float,
    max_boxes: int,
    max_seconds: float,
    workers: Any,
) -> Subdivision:
    """Cut the domain until no bound exceeds `ratio` times the largest change seen, at least `best`.

    The boxes with the worst bounds are cut first. **Raises** `TooMany` where boxes on which nothing
    is bounded remain.
    """
    end, order = time.monotonic() + max_seconds, itertools.count()
    root = _part(checker, identities, (checker.root(), 1))
    best = _larger(best, root.extremes)
    heap = [(_rank(root, best), next(order), root)]
    count = 1
    while -heap[0][0] > ratio and count < max_boxes and time.monotonic() < end:
        worst = []
        while heap and -heap[0][0] > ratio and len(worst) < min(_BATCH // 2, max_boxes - count):
            worst.append(heapq.heappop(heap)[2])
            worst[-1].axis = _axis(checker, worst[-1], best)
        parts = [
            (half, 2 * leaf.number + i)
            for leaf in worst
            for i, half in enumerate(halves(leaf.box, leaf.axis))
        ]
        leaves = workers.map(ctx.prec, partial(_part, checker, identities), parts)
        old = best
        for leaf in worst:
            if time.monotonic() < end:
                leaf.parts = [next(leaves), next(leaves)]
                count += 1
            for part in leaf.parts or [leaf]:
                best = _larger(best, part.extremes)
                heapq.heappush(heap, (_rank(part, best), next(order), part))
        if best != old:
            heap = [(_rank(item[2], best), *item[1:]) for item in heap]
            heapq.heapify(heap)
    inner = [leaf for _, _, leaf in heap if not leaf.is_outside]
    failures = [leaf for leaf in inner if leaf.failure]
    if failures:
        raise TooMany(
            f"no bound was found on {len(failures)} of {count} boxes, first for "
            f"{place(checker, failures[0].box)}: {failures[0].failure}. Exclude singularities; use "
            "a smaller domain, epsilon or h, or larger limits"
        )
    if not inner:
        raise exact.Failure(
            "inside(q, p) must be ≥ 0 somewhere in the domain, got negative values only"
        )
    bounds, rounding, moves = (
        [max(column) for column in zip(*(getattr(leaf, name) for leaf in inner), strict=True)]
        for name in ("bounds", "rounding", "displacement")
    )
    changes = [0.0 if k in identities else s for k, s in enumerate(best)]
    return Subdivision(_tree(root), count, bounds, changes, rounding, moves)


def _larger(best: list[float], extremes: list[float]) -> list[float]:
    return [max(b, s) for b, s in itertools.zip_longest(best, extremes, fillvalue=0.0)]


def _tree(leaf: Leaf) -> Any:
    if leaf.parts:
        where = float(leaf.parts[0].box[leaf.axis][1]).hex()
        return ["cut", leaf.axis, where, *map(_tree, leaf.parts)]
    return "outside" if leaf.is_outside else "bounded"


def _rank(leaf: Leaf, best: list) -> float:
    """Minus the largest bound over the change seen: the smallest is cut first."""
    if leaf.failure or leaf.is_outside:
        return 0.0 if leaf.is_outside else -math.inf
    return -max(_excesses(leaf, best))


def _excesses(leaf: Leaf, best: list) -> list[float]:
    rows = zip(leaf.bounds, leaf.rounding, best, strict=True)
    return [(float(b or r) / s if s else math.inf) if b or r else 0.0 for b, r, s in rows]


def _axis(checker: Any, leaf: Leaf, best: list) -> int:
    """The coordinate along which a box is cut: where the bound decreases most, but not far narrower
    than the others."""
    if leaf.failure:
        return _widest(leaf.box, checker.root(), curved_axes(checker))
    excesses = _excesses(leaf, best)
    k = max(range(len(excesses)), key=excesses.__getitem__)
    if not leaf.bounds[k]:
        return _widest(leaf.box, checker.root())
    if leaf.remainders[k] > 0.5 * float(leaf.bounds[k]):
        return _widest(leaf.box, checker.root(), curved_axes(checker))
    return max(range(len(leaf.box)), key=leaf.shares[k].__getitem__)


def halves(box: list, axis: int, where: Fraction | None = None) -> list[list]:
    """The two parts of a box, cut in the middle or at `where`, a number of float64."""
    a, b = box[axis]
    c = Fraction(float((a + b) / 2)) if where is None else where
    return [[*box[:axis], part, *box[axis + 1 :]] for part in ((a, c), (c, b))]


def enclose(
    checker: Any,
    weights: list,
    limit: Fraction,
    reach: list,
    value: Callable,
    *,
    max_boxes: int,
    max_seconds: float,
    workers: Any,
) -> tuple[Any, int]:
    """The tree of boxes around the domain on which no trajectory can be, and their number.

    `value`: Σ w_k I_k of an array of points (q, p, t, ε), a quick estimate. **Raises** `TooMany`
    with a box on which Σ w_k I_k does not exclude a trajectory.
    """
    end, count = time.monotonic() + max_seconds, 0
    *ranges, span, epsilon = checker.root()
    has_end = [not q for q in checker.angles] + [True] * checker.n  # a circle has none
    ranges = [(a - w * e, b + w * e) for (a, b), w, e in zip(ranges, reach, has_end, strict=True)]
    root, sides = [*ranges, span, epsilon], [*zip(checker.lower, checker.upper, strict=True)]
    domain = np.array(sides, float).T
    top: list = [None]
    heap: list = []

    def add(box, number, borders, *home):
        """`borders` of the domain to cut first, `home`: the list of the tree, and the place in it.
        The boxes with small values around the domain come first: there a failure is found soon."""
        points = _corners(box, np.random.default_rng(number))
        values = np.nan_to_num(value(points), nan=-math.inf, posinf=math.inf, neginf=-math.inf)
        is_outside = ((points[:, :-2] < domain[0]) | (points[:, :-2] > domain[1])).any(1)
        minimum, low = np.min(values[is_outside], initial=math.inf), values.min() <= float(limit)
        heapq.heappush(heap, (float(minimum), number, box, borders, bool(low), *home))

    borders = [(i, side) for i, pair in enumerate(sides) if has_end[i] for side in pair]
    add(root, 1, borders, top, 0)
    claim_on = partial(_claim, checker, (weights, limit, reach), root)
    while heap:
        batch = [heapq.heappop(heap) for _ in range(min(_BATCH, len(heap)))]
        claims = workers.map(ctx.prec, claim_on, [(row[2], row[4]) for row in batch])
        for (minimum, number, box, borders, _, *home), (claim, axis) in zip(
            batch, claims, strict=True
        ):
            tree, i = home
            if claim:
                tree[i] = claim
                count += 1
                continue
            late = count > max_boxes or time.monotonic() > end
            narrow = all(b - a <= (d - c) / 4096 for (a, b), (c, d) in zip(box, root, strict=True))
            if late or narrow or (minimum <= float(limit) and not checker.inside["outputs"]):
                raise TooMany(
                    f"the invariants do not exclude that a trajectory reaches "
                    f"{place(checker, box)}. Use a smaller epsilon or h, or larger limits"
                )
            left, right, where = [], [], None
            if borders:  # first the domain itself is cut out
                (axis, where), *borders_left = borders
                # The part outside of a border has no further ones.
                left, right = borders_left, []
                if where == checker.lower[axis]:
                    left, right = right, left
            first, second = halves(box, axis, where)
            tree[i] = ["cut", axis, float(first[axis][1]).hex(), None, None]
            add(first, 2 * number, left, tree[i], 3)
            add(second, 2 * number + 1, right, tree[i], 4)
    return top[0], count


def _claim(checker: Any, level: tuple, root: list, task: tuple[list, bool]) -> tuple[str, int]:
    """What is shown on a box, if anything, and the coordinate along which it would be cut. `task`:
    the box, and whether Σ w_k I_k is known to be too small at a point of it."""
    (box, low), (weights, limit, _) = task, level
    for claim in ("inside", "unreachable"):
        with contextlib.suppress(*SINGULAR):
            exact.check_confined(checker, box, claim, *level)
            return claim, 0
    if low:
        return "", _widest(box, root)
    try:
        algebra, value = exact.combination_model(checker, weights, box)
    except SINGULAR:
        return "", _widest(box, root)
    return "above" * (algebra.range(value)[0] > limit), int(np.argmax(_shares(value, len(box))))


def _corners(box: list, rng: Any) -> np.ndarray:
    """The middle and 15 random corners of a box."""
    low, high = np.array(box, float).T
    signs = rng.choice([-1.0, 1.0], (16, len(box)))
    signs[0] = 0.0
    return (low + high) / 2 + signs * (high - low) / 2


def place(checker: Any, box: list) -> str:
    """A box as text, without the coordinates that are constant."""
    names = [f"{x}{i + 1 if checker.n > 1 else ''}" for x in "qp" for i in range(checker.n)]
    sides = zip([*names, "τ" if checker.slow else "t", "ε"], box, strict=True)
    return ", ".join(f"{n} in [{float(a):.4g}, {float(b):.4g}]" for n, (a, b) in sides if a < b)


def _widest(box: list, root: list, axes: Any = ()) -> int:
    """The widest coordinate, or the widest one `of` some, relative to the box `whole`; t and ε
    count less."""
    widths = [
        float((b - a) / (high - low)) if high > low else 0.0
        for (a, b), (low, high) in zip(box, root, strict=True)
    ]
    widths[-2:] = [w / 8 for w in widths[-2:]]
    return max(axes or range(len(box)), key=widths.__getitem__)
