"""The search for a certificate: boxes, bounds, levels. What it finds, the checker decides."""

import bisect
import heapq
import itertools
import math
import operator
import time
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from . import checker as exact

_DIGITS = (30, 45, 60, 80, 100, 130)
"""Binary digits after the point that are tried for the smallest terms."""

_POINTS = 64
"""Random points of a box at which a change is evaluated, for a lower estimate of its supremum."""


@dataclass
class Leaf:
    """A box and what was found there.

    - `failed`: why nothing is bounded there.
    - `bounds`, `seen`: for each invariant an upper bound of the change, and the largest one seen.
    - `rounding`, `moved`: changes by rounding, and how far a step moves each coordinate.
    - `remainders`: of the models of the changes. `blame`: the coordinates that a failure is due to.
    - `axis`, `parts`: of the cut, if there is one.
    """

    box: list
    failed: str = ""
    outside: bool = False
    bounds: list = field(default_factory=list)
    seen: list = field(default_factory=list)
    rounding: list = field(default_factory=list)
    moved: list = field(default_factory=list)
    remainders: list = field(default_factory=list)
    blame: set = field(default_factory=set)
    axis: int = 0
    parts: list = field(default_factory=list)


def examine(
    checker: exact.Checker, box: list, rng: Any, identities: frozenset = frozenset()
) -> Leaf:
    """Everything that is bounded on one box; `identities`: numbers of what is conserved exactly."""
    leaf = Leaf(box)
    try:
        algebra, x = checker.models(box)
        if checker.implicit:
            near = zip(checker.moved(x, algebra)[checker.n :], checker.spread, strict=True)
            if any(m > s for m, s in near):
                raise exact.Failed("p1 is further from p0 than `spread`")
            if not checker.contraction(box) < 1 / 3:
                raise exact.Failed("the equation of the implicit step is not a contraction")
        if checker.is_outside(algebra, checker.start(x, algebra)):
            leaf.outside = True
            return leaf
        moved = checker.moved(x, algebra)
        changes = checker.changes(x, algebra)
        leaf.bounds = [
            Fraction(0) if k in identities else algebra.bound(change)
            for k, change in enumerate(changes)
        ]
        leaf.remainders = [change[1] / algebra.one for change in changes]
        leaf.seen = [seen(algebra, change, box, rng) for change in changes]
        leaf.rounding, errors = checker.rounding(box)
        leaf.moved = [exact.up(m + Fraction(e)) for m, e in zip(moved, errors, strict=True)]
        if not all(map(math.isfinite, (*leaf.rounding, *leaf.moved))):
            raise exact.Failed("a value is not bounded")
    except (exact.Failed, OverflowError) as error:
        leaf.failed = str(error)
        leaf.blame = blamed(checker, box)
    return leaf


def blamed(checker: exact.Checker, box: list) -> set[int]:
    """The coordinates on which the operation depends at which the step fails on a box."""
    algebra, x = checker.models(box)
    inputs, operations = [*x, algebra.constant(checker.h)], checker.step["operations"]

    def fails(count):
        try:
            exact.run({"operations": operations[:count], "outputs": []}, inputs, algebra)
        except (exact.Failed, OverflowError):
            return True
        return False

    index = bisect.bisect_left(range(len(operations)), True, key=lambda i: fails(i + 1))
    needed, used = {index}, set()
    for i in range(min(index, len(operations) - 1), -1, -1):
        name, *operands = operations[i]
        if i in needed and name == "input":
            used.add(operands[0])
        elif i in needed and name != "constant":
            needed.update(operands[:1] if name == "power" else operands)
    return used


def resolve(checker: exact.Checker) -> None:
    """Choose below which size terms are dropped: remainders shall be small next to the changes.

    Large terms are faster; a change that nearly cancels needs small ones.
    """
    rng, box = np.random.default_rng(0), checker.root()
    for digits in _DIGITS:
        checker.tiny, checker.bits = Fraction(1, 2**digits), digits + 40
        leaf = examine(checker, box, rng)
        while leaf.failed:
            widths = [float(b - a) for a, b in box]
            if digits > _DIGITS[0] or max(widths) < 1e-3 * max(map(abs, (*box[0], 1))):
                return  # nothing is bounded there: `subdivide` says where
            # A part of the domain is enough here.
            box = [half(side, rng.random() < 0.5) for side in box]
            leaf = examine(checker, box, rng)
        pairs = zip(leaf.remainders, leaf.seen, strict=True)
        if leaf.remainders and all(r <= s / 10 for r, s in pairs):
            return


def half(side: tuple, upper: bool) -> tuple:
    """A half of an interval."""
    middle = (side[0] + side[1]) / 2
    return (middle, side[1]) if upper else (side[0], middle)


def seen(algebra: exact.Models, model: Any, box: list, rng: Any) -> float:
    """The largest |P| at random points of the box, less the remainder."""
    terms = model[0].to_dict()
    if not terms:
        return 0.0
    s = rng.choice([-1.0, -0.7, -0.3, 0.0, 0.3, 0.7, 1.0], (_POINTS, len(box)))
    s[:, -1] = 1.0 if box[-1][0] == 0 else s[:, -1]
    powers = np.array([[int(k) for k in powers] for powers in terms])
    values = np.array([float(Fraction(int(c), algebra.one)) for c in terms.values()])
    monomials = np.prod(s[:, None, :] ** powers[None], axis=2)
    error = float(Fraction(model[1], algebra.one))
    return max(0.0, float(np.max(np.abs(monomials @ values))) - error)


class _Rational:
    """Rational numbers for the `run` of the checker."""

    constant, multiply, divide = staticmethod(Fraction), operator.mul, operator.truediv

    @staticmethod
    def sum(*terms: Any) -> Any:
        return sum(terms)

    @staticmethod
    def apply(name: str, a: Any) -> Any:
        raise exact.Failed(f"{name} is no rational function")


def identities(checker: exact.Checker) -> frozenset:
    """The numbers of the functions that are conserved exactly: zero at points, then proved."""
    if checker.implicit:
        return frozenset()
    rng = np.random.default_rng(1)
    sides = [(checker.lower[i], checker.upper[i]) for i in range(2 * checker.n)]
    points = [
        [
            a + (b - a) * Fraction(int(rng.integers(1, 99)), 100)
            for a, b in [*sides, checker.epsilon]
        ]
        for _ in range(2)
    ]
    found = set(range(len(checker.invariants)))
    for x in points:
        for k in tuple(found):
            function = checker.invariants[k]
            try:
                end = exact.run(checker.step, [*x, checker.h], _Rational)
                after, before = (exact.run(function, [*z, x[-1]], _Rational) for z in (end, x[:-1]))
            except (exact.Failed, ZeroDivisionError):
                after, before = 1, 0
            if after != before:
                found.remove(k)
    return frozenset(k for k in found if checker.is_identity(k))


class TooMany(exact.Failed):
    """The subdivision reached its limit."""


@dataclass
class Found:
    """A subdivision: its tree of cuts, the number of its boxes, and the largest bounds."""

    tree: Any
    count: int
    bounds: list
    seen: list
    rounding: list
    moved: list


def subdivide(
    checker: exact.Checker,
    identities: frozenset,
    *,
    ratio: float,
    max_boxes: int,
    max_seconds: float,
) -> Found:
    """Cut the domain until no bound exceeds `ratio` times the largest change seen.

    The box with the worst bound is cut first, along the axis that leaves the smallest bounds.
    **Raises** `TooMany` where boxes on which nothing is bounded remain.
    """
    rng, began, order = np.random.default_rng(0), time.monotonic(), itertools.count()
    root = examine(checker, checker.root(), rng, identities)
    best = root.seen or [0.0] * len(checker.invariants)
    heap = [(_rank(root, best), next(order), root)]
    count = 1
    while -heap[0][0] > ratio and count < max_boxes and time.monotonic() - began < max_seconds:
        leaf = heapq.heappop(heap)[2]
        leaf.axis, leaf.parts = _cut(checker, leaf, rng, identities)
        count += 1
        old = best
        for part in leaf.parts:
            best = [max(b, s) for b, s in itertools.zip_longest(best, part.seen, fillvalue=0.0)]
            heapq.heappush(heap, (_rank(part, best), next(order), part))
        if best != old:
            heap = [(_rank(item[2], best), *item[1:]) for item in heap]
            heapq.heapify(heap)
    inner = [leaf for _, _, leaf in heap if not leaf.outside]
    failed = [leaf for leaf in inner if leaf.failed]
    if failed:
        raise TooMany(
            f"on {len(failed)} of {count} boxes nothing is bounded. The first is "
            f"{place(failed[0].box)}: {failed[0].failed}"
        )
    if not inner:
        raise exact.Failed("no state satisfies `inside`: the domain is empty")
    columns = (
        [max(column) for column in zip(*(getattr(leaf, name) for leaf in inner), strict=True)]
        for name in ("bounds", "rounding", "moved")
    )
    bounds, rounding, moved = columns
    return Found(_tree(root), count, bounds, best, rounding, moved)


def _tree(leaf: Leaf) -> Any:
    if leaf.parts:
        where = float(leaf.parts[0].box[leaf.axis][1]).hex()
        return ["cut", leaf.axis, where, *map(_tree, leaf.parts)]
    return "outside" if leaf.outside else "bounded"


def _rank(leaf: Leaf, best: list) -> float:
    """Minus the largest bound over the change seen: the smallest is cut first."""
    if leaf.failed or leaf.outside:
        return 0.0 if leaf.outside else -math.inf
    pairs = zip(leaf.bounds, best, strict=True)
    return -max((float(b) / s if s else math.inf) if b else 0.0 for b, s in pairs)


def _cut(
    checker: exact.Checker, leaf: Leaf, rng: Any, identities: frozenset
) -> tuple[int, list[Leaf]]:
    """The parts of a leaf along the axis that leaves the smallest bounds."""
    axes = [i for i, (a, b) in enumerate(leaf.box) if a < b]
    if leaf.failed:
        axes = [_widest(checker, leaf.box, leaf.blame)]
    tried = [
        (i, [examine(checker, part, rng, identities) for part in halves(leaf.box, i)]) for i in axes
    ]

    widest = _widest(checker, leaf.box)

    def cost(item):
        # The larger bound decides. Where no cut makes it much smaller, more than one is needed, and
        # the widest coordinate is cut: cutting one part again and again would go on for ever.
        rests = [_rest(leaf, part) for part in item[1]]
        return max(*rests, 0.9), item[0] != widest, sum(rests)

    return min(tried, key=cost)


def _rest(leaf: Leaf, part: Leaf) -> float:
    """The bound of a part over that of the whole, at most 10."""
    if part.outside or part.failed:
        return 0.0 if part.outside else 10.0
    pairs = zip(part.bounds, leaf.bounds, strict=False)  # a failed one has no bounds
    return max((float(a / b) for a, b in pairs if b), default=0.0)


def halves(box: list, axis: int, where: Fraction | None = None) -> list[list]:
    """The two parts of a box, cut in the middle or at `where`, a number of float64."""
    a, b = box[axis]
    c = Fraction(float((a + b) / 2)) if where is None else where
    return [[*box[:axis], part, *box[axis + 1 :]] for part in ((a, c), (c, b))]


def enclose(
    checker: exact.Checker, limits: list, reach: list, *, max_boxes: int, max_seconds: float
) -> tuple[Any, int]:
    """The tree of boxes around the domain on which no trajectory can be, and their number.

    **Raises** `TooMany` with a box on which no invariant excludes a trajectory.
    """
    began, count = time.monotonic(), 0

    def node(box, borders):
        nonlocal count
        claim = _claim(checker, box, limits, reach)
        if claim is not None:
            count += 1
            return claim
        if count > max_boxes or time.monotonic() - began > max_seconds:
            raise TooMany(f"no invariant excludes that a trajectory gets to {place(box)}")
        if borders:  # first the domain itself is cut out
            axis, where = borders[0]
        else:
            axis, where = _widest(checker, box), None
        first, second = halves(box, axis, where)
        cut = float(first[axis][1]).hex()
        if where is None:
            return ["cut", axis, cut, node(first, ()), node(second, ())]
        # A part outside of a border has no further ones.
        below = where == checker.lower[axis]
        parts = (first, ()), (second, borders[1:])
        if not below:
            parts = (first, borders[1:]), (second, ())
        return ["cut", axis, cut, *(node(*part) for part in parts)]

    around = zip(checker.root()[:-1], reach, strict=True)
    root = [*((a - w, b + w) for (a, b), w in around), checker.epsilon]
    sides = enumerate(zip(checker.lower, checker.upper, strict=True))
    borders = [(i, side) for i, pair in sides for side in pair]
    return node(root, tuple(borders)), count


def place(box: list) -> str:
    """A box as text."""
    return " × ".join(f"[{float(a):.4g}, {float(b):.4g}]" for a, b in box)


def _claim(checker: exact.Checker, box: list, limits: list, reach: list) -> Any:
    claims: list[Any] = ["inside", "unreachable"]
    claims += [[side, k] for k in range(len(limits)) for side in ("above", "below")]
    for claim in claims:
        if isinstance(claim, list) and math.isinf(limits[claim[1]][claim[0] == "above"]):
            continue
        try:
            exact.check_confined(checker, box, claim, limits, reach)
        except (exact.Failed, OverflowError):
            continue
        return claim
    return None


def _widest(checker: exact.Checker, box: list, of: Any = ()) -> int:
    """The widest coordinate, or the widest one `of` some, relative to the domain; ε counts less."""
    ends = zip(
        box, [*checker.lower, checker.epsilon[0]], [*checker.upper, checker.epsilon[1]], strict=True
    )
    widths = [float((b - a) / (high - low)) if high > low else 0.0 for (a, b), low, high in ends]
    widths[-1] /= 8
    return max([i for i in of if i < len(box)] or range(len(box)), key=widths.__getitem__)
