"""The checker of drift certificates, short enough to be read completely: python checker.py FILE.

It needs python-flint only. A certificate states, for a map Φ and functions I_k of x = (q, p), t and
ε, given as lists of scalar operations, which also contain h:
1. |I_k(Φ(x, t, ε), t1, ε) − I_k(x, t, ε)| ≤ `per_step`[k] in exact arithmetic, in the domain, for
   all t and ε of their intervals, with t1 = t + h, or t + εh if t is a slow time;
2. a step computed in the `arithmetic` by the `way` changes I_k by ≤ `rounding`[k] more, and moves
   no coordinate by more than `reach`; no intermediate number overflows;
3. trajectories that start in the domain at the time `start` with Σ w_k I_k ≤ c, where (w, c) is the
   `level`, stay in the domain for `steps` steps, exact or computed; the state `example` is one.
A turn of an angle q_i, 2π, has no effect but a turn after the step. The domain contains one turn of
it, and 1 to 3 hold for all turns, for computed steps while |q_i| is at most `angles`[i].

For 1 and 2 boxes cover the domain. On a box a function is a polynomial with integer coefficients
and a bound of the remainder (a Taylor model; Makino & Berz 2003); balls (Arb) enclose elementary
functions. For 3, boxes cover all that a step can reach outside of the domain; on each Σ w_k I_k
exceeds c by more than `steps` steps can change it. An implicit step is a function of (q0, p1): each
(q0, p0) of the domain has one p1 within `spread`, as p1 → p0 + h·rate is a contraction of this box
into itself. If increments are multiples of `quantum`, their error is one more input of the step.
"""

import hashlib
import json
import math
import pathlib
import sys
from fractions import Fraction

from flint import arb, arb_series, ctx, fmpq, fmpq_mpoly_ctx, fmpz_mpoly_ctx

FORMAT = "dvi_jax drift bound 3"
FUNCTIONS = ("exp", "log", "sin", "cos", "tan", "atan", "asin", "acos", "sqrt", "inverse")
UNITS = {"float64": Fraction(1, 2**53), "pairs of float64": Fraction(1, 2**103)}  # round-off
LEVEL = 30  # bits for levels, where nothing cancels
LARGEST = 2.0**990  # of a number that is computed: its product with 2^27, in pairs, is finite
# Error of tiny results, and largest number. XLA regroups products: those of seven shall be finite.
WAYS = {"machine code": (2.0**-1000, LARGEST), "XLA": (2.0**-400, 2.0**128)}


class Failure(Exception):
    """What could not be shown, and where."""


def require(condition, message, box=()):
    if not condition:
        where = " × ".join(f"[{float(a):.6g}, {float(b):.6g}]" for a, b in box)
        raise Failure(f"{message} on the box {where}" if box else message)


def digest(certificate):  # SHA-256 of everything in it but the hash itself
    text = json.dumps({k: v for k, v in certificate.items() if k != "hash"}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def number(text, low=-LARGEST):
    value = float.fromhex(text) if isinstance(text, str) and len(text) < 64 else math.nan
    require(low <= value <= LARGEST, f"{text!r:.64} is no hexadecimal float, or out of range")
    return Fraction(value)


def numbers(texts, count, low=-LARGEST):
    require(isinstance(texts, list) and len(texts) == count, f"not {count} numbers: {texts!r:.64}")
    return [number(text, low) for text in texts]


def whole(high, *values, low=0):
    fits = all(type(value) is int and low <= value <= high for value in values)
    require(fits, f"{values!r:.64} are not whole numbers from {low} to {high}")
    return values


def round_up(value):  # a fraction or a ball, rounded up to a float
    if isinstance(value, arb):
        return math.nextafter(float(value.upper()), math.inf) if value.is_finite() else math.inf
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else math.nextafter(nearest, math.inf)


def ball(value, radius=0):
    return arb(value.numerator) / value.denominator + arb(0, round_up(Fraction(radius)))


def series(name, point, length):  # of Taylor coefficients at a point, or balls of them on a ball
    ctx.cap = length
    x = arb_series([point, 1], length)
    return 1 / x if name == "inverse" else getattr(x, name)()


def run(program, inputs, algebra):  # the outputs of a list of operations (name, operands)
    values = []
    for name, *operands in program["operations"]:
        if name == "input":
            value = inputs[whole(len(inputs) - 1, *operands)[0]]
        elif name == "constant":
            value = algebra.constant(number(*operands))
        elif name == "inexact":  # a number that is computed with an error of so many units
            a, units = values[whole(len(values) - 1, operands[0])[0]], whole(2**30, *operands[1:])
            value = algebra.inexact(a, *units) if isinstance(algebra, Rounding) else a
        else:
            require(name in ("sum", "multiply", *FUNCTIONS), f"unknown operation {name!r:.64}")
            a = [values[k] for k in whole(len(values) - 1, *operands)]
            value = algebra.apply(name, *a) if name in FUNCTIONS else getattr(algebra, name)(*a)
        values.append(value)
    return [values[k] for k in whole(len(values) - 1, *program["outputs"])]


class Models:
    """Taylor models in variables s with |s| ≤ 1.
    (P, E) contains the functions that differ from P(s)/2^bits by at most E/2^bits; E and the
    coefficients of P are integers. Products are rounded towards zero: small terms vanish."""

    def __init__(self, size, bits, orders):
        self.bits, self.unit, self.orders = bits, 1 << bits, range(orders + 1)
        self.ring = fmpz_mpoly_ctx.get([f"s{i}" for i in range(size)], "lex")

    def constant(self, value, error=0):  # exact arithmetic has no error
        multiple = value * self.unit
        return self.ring.constant(math.floor(multiple)), int(multiple.denominator != 1)

    def sum(self, *terms):
        return sum((t[0] for t in terms[1:]), terms[0][0]), sum(t[1] for t in terms)

    def multiply(self, a, b):
        norm = [int(sum(map(abs, x[0].coeffs()))) for x in (a, b)]  # |P| is not larger
        error = norm[0] * b[1] + norm[1] * a[1] + a[1] * b[1]
        product = a[0] * b[0]
        signs = product // (norm[0] * norm[1] + 1)  # rounded down: −1 where a coefficient is < 0
        integers = (product - (self.unit - 1) * signs) // self.unit
        error += int(sum(map(abs, (product - self.unit * integers).coeffs())))
        return integers, (error >> self.bits) + 1

    def range(self, a):  # bounds of the value; an even power of s is not negative
        low, high = -a[1], a[1]
        for powers, c in a[0].to_dict().items():
            span = (0, c) if any(powers) else (c, c)
            span = (-c, c) if any(k % 2 for k in powers) else span
            low, high = low + min(span), high + max(span)
        return Fraction(int(low), self.unit), Fraction(int(high), self.unit)

    def bound(self, a):
        return max(map(abs, self.range(a)))

    def apply(self, name, a):
        """f(c + r) = Σ f⁽ᵏ⁾(c)/k! rᵏ, with Lagrange's remainder on the range of c + r."""
        low, high = (value * self.unit for value in self.range(a))
        middle = int(low + high) // 2
        values = arb(int(low)).union(arb(int(high))) / self.unit
        expansion = series(name, values, len(self.orders) + 1)
        radius = arb(int(max(high - middle, middle - low))) / self.unit
        remainders = [abs(expansion[k + 1]) * radius ** (k + 1) * self.unit for k in self.orders]
        require(all(x.is_finite() for x in remainders), f"{name} is singular, or varies too much")
        small = (k for k in self.orders if remainders[k] < 1)
        order = next(small, min(self.orders, key=lambda k: round_up(remainders[k])))
        terms = series(name, arb(middle) / self.unit, order + 1)
        deviation, result = (a[0] - middle, a[1]), self.constant(Fraction(0))
        for k in range(order, -1, -1):
            multiple = terms[k] * self.unit
            integer = int(multiple.mid().floor().unique_fmpz() or 0)
            coefficient = self.ring.constant(integer), math.ceil(round_up(abs(multiple - integer)))
            result = self.sum(self.multiply(result, deviation), coefficient)
        return result[0], result[1] + math.ceil(round_up(remainders[order]))


class Rounding:
    """Values (ball, error): a computed number differs by at most `error` from one in the ball. Each
    operation has a relative error of at most `unit`, a quotient of two. A sum has any order."""

    def __init__(self, unit, limits=WAYS["machine code"]):
        self.unit, (self.smallest, self.largest) = ball(Fraction(unit)), limits

    def constant(self, value, error=0):
        return self.inexact((ball(value), ball(Fraction(error))), 0)

    def inexact(self, a, units, size=0):  # size: of all numbers on the way to the value
        size = size or abs(a[0]) + a[1]
        require(self.unit == 0 or size < self.largest, "an intermediate number may overflow")
        return a[0], arb((a[1] + units * self.unit * size + self.smallest).upper())

    def sum(self, *terms):
        value, error = sum(t[0] for t in terms), sum(t[1] for t in terms)
        return self.inexact((value, error), len(terms), sum(abs(t[0]) + t[1] for t in terms))

    def multiply(self, a, b):
        error = abs(a[0]) * b[1] + abs(b[0]) * a[1] + a[1] * b[1]
        return self.inexact((a[0] * b[0], error), 1)

    def apply(self, name, a):
        derivatives = series(name, a[0] + arb(0, round_up(a[1])), 2)
        require(derivatives[1].is_finite(), f"{name} is singular")
        units = {"sqrt": 1, "inverse": 2 if self.unit < 2.0**-60 else 1}.get(name, 8)  # 8: 4 ulp
        return self.inexact((derivatives[0], abs(derivatives[1]) * a[1]), units)


class Identities:
    """Quotients (numerator, denominator) of polynomials with rational coefficients, in x and in
    each value f(a) of an elementary function, of which only the period in x_angle is used."""

    def __init__(self, size, programs, angle=None):  # each of these runs at most twice
        count = size + 2 * sum(op[0] in FUNCTIONS[:-1] for f in programs for op in f["operations"])
        self.ring = fmpq_mpoly_ctx.get([f"x{i}" for i in range(count)], "lex")
        self.unit, self.values, self.angle = self.ring.constant(1), {}, angle
        self.x, self.free = self.ring.gens()[:size], list(self.ring.gens()[size:])

    def constant(self, value, error=0):
        return self.ring.constant(fmpq(value.numerator, value.denominator)), self.unit

    def sum(self, *terms):
        (a, b), *addends = terms
        for c, d in addends:
            a, b = (a + c, b) if b == d else (a * d + c * b, b * d)
        return a, b

    def multiply(self, a, b):
        return a[0] * b[0], a[1] * b[1]

    def apply(self, name, a):
        if name == "inverse":
            return a[1], a[0]
        for k in self.turns(a).coeffs() if self.angle is not None else ():
            require(k.q == 1 and name in ("sin", "cos"), f"{name} is not periodic")
        key = name, str(a[0]), str(a[1])
        self.values[key] = self.values.get(key) or (self.free.pop(), self.unit)
        return self.values[key]

    def turns(self, a):  # of a value by one turn of the angle: its derivative, if that is a number
        slope = a[0].derivative(self.angle) * a[1] - a[0] * a[1].derivative(self.angle)
        turns = slope // (a[1] * a[1])
        require(turns.is_constant() and slope == turns * a[1] * a[1], "a value is not periodic")
        return turns


class Checker:
    """A certificate, and what is evaluated on a box of (q, p, t, ε)."""

    def __init__(self, certificate):
        c, lower = certificate, certificate["domain"][0]
        self.n, self.slow, self.implicit = len(lower) // 2, c["slow"], c["implicit"]
        self.lower, self.upper = (numbers(side, 2 * self.n) for side in c["domain"])
        self.time, self.epsilon = numbers(c["time"], 2), numbers(c["epsilon"], 2)
        self.ends = [*zip(self.lower, self.upper, strict=True), self.time, self.epsilon]
        fits = self.n > 0 and all(a <= b for a, b in self.ends)
        require(fits, "the domain has no q and p, or a lower end is larger than an upper end")
        self.h, self.spread = number(c["h"]), numbers(c["spread"], self.n, 0)
        fits = self.h != 0 and {type(self.slow), type(self.implicit)} == {bool}
        require(fits, "h is zero, or slow or implicit are not true or false")
        self.quantum, self.residual_limit = (number(c[x], 0) for x in ("quantum", "accepted"))
        self.bits, self.orders = whole(400, c["bits"], low=8) + whole(60, c["orders"], low=1)
        self.arithmetic, self.way = c["arithmetic"], c["way"]
        self.unit, self.limits = UNITS[self.arithmetic], WAYS[self.way]
        self.step, self.invariants, self.inside = c["step"], c["invariants"], c["inside"]
        self.programs = [self.step, *self.invariants, self.inside]
        used = [operation[1] for operation in self.inside["operations"] if operation[0] == "input"]
        has_grid = ["input", 2 * self.n + 3] in self.step["operations"]
        fits = has_grid == (self.quantum > 0) and all(k < 2 * self.n for k in used)
        require(fits, "inside depends on t or ε, or a grid is used or stated, but not both")
        ctx.prec = self.bits + 60
        self.angles = numbers(c.get("angles", [(0.0).hex()] * self.n), self.n, 0)
        for i in [i for i, largest in enumerate(self.angles) if largest]:
            self.require_angle(i)

    def require_angle(self, i):  # a turn of q_i is one after a step, too, without other effects
        algebra = Identities(2 * self.n + 2, self.programs, i)
        (a, b), q = self.ends[i], self.angles[i]
        fits = ball(b - a) > 2 * arb.pi() and -q <= a and b <= q
        require(fits, "the domain has less than a turn of an angle, or more than stated")
        step = self.states_of_step([(x, algebra.unit) for x in algebra.x], algebra)
        values = [v for f in self.programs[1:] for v in run(f, step[0], algebra)]
        fits = all(algebra.turns(v) == int(k == i) for x in step for k, v in enumerate(x))
        require(fits and not any(map(algebra.turns, values)), f"a turn changes more than q{i + 1}")

    def root(self):  # the box of all boxes: the domain, where p1 may differ from p0 by `spread`
        wide = [Fraction(0)] * self.n + self.spread
        box = [(a - w, b + w) for a, b, w in zip(self.lower, self.upper, wide, strict=True)]
        return [*box, tuple(self.time), tuple(self.epsilon)]

    def models(self, box):  # its coordinates as Taylor models; ε from 0 keeps its orders apart
        algebra = Models(len(box), self.bits, self.orders)
        parts = [((a + b) / 2, (b - a) / 2) for a, b in box]
        parts[-1] = (Fraction(0), box[-1][1]) if box[-1][0] == 0 else parts[-1]
        x, parts = algebra.ring.gens(), [map(algebra.constant, part) for part in parts]
        pairs = zip([(s * algebra.unit, 0) for s in x], parts, strict=True)
        return algebra, [algebra.sum(a, algebra.multiply(s, b)) for s, (a, b) in pairs]

    def is_inside(self, box):  # whether all its states are shown to be in the domain
        is_between = all(c <= a and b <= d for (a, b), (c, d) in zip(box, self.ends, strict=True))
        algebra, x = self.models(box)
        return is_between and all(algebra.range(g)[0] >= 0 for g in run(self.inside, x, algebra))

    def is_outside(self, algebra, x):  # whether no state of these models is in the domain
        sides = zip(map(algebra.range, x), self.lower, self.upper, strict=False)
        is_separate = any(high < lower or low > upper for (low, high), lower, upper in sides)
        return is_separate or any(algebra.range(g)[1] < 0 for g in run(self.inside, x, algebra))

    def states_of_step(self, x, algebra):  # (q, p, t, ε, h) before and after, from x in a box
        q0, p0, (t0, epsilon) = x[: self.n], x[self.n : -2], x[-2:]
        h, error = algebra.constant(self.h), algebra.constant(Fraction(0), self.quantum / 2)
        end = run(self.step, [*x, h, error], algebra)
        if self.implicit:  # (q0, p1) → (h·rate, q1)
            end, moves, p1 = [*end[self.n :], *p0], end[: self.n], p0
            p0 = [algebra.sum(p, (-m[0], m[1])) for p, m in zip(p1, moves, strict=True)]
        t1 = algebra.sum(t0, algebra.multiply(epsilon, h) if self.slow else h)
        return [*q0, *p0, t0, epsilon, h], [*end, t1, epsilon, h]

    def change(self, k, step, algebra):  # I_k(Φ(x)) − I_k(x)
        start_value, end_value = (run(self.invariants[k], x, algebra)[0] for x in step)
        return algebra.sum(end_value, (-start_value[0], start_value[1]))

    def times(self, start, steps):
        rates = [self.h * e for e in self.epsilon] if self.slow else [self.h]
        return start + steps * min(0, *rates), start + steps * max(0, *rates)

    def displacement(self, step, algebra):  # how far it moves each coordinate, if it is exact
        changes = [algebra.sum(b, (-a[0], a[1])) for a, b in zip(*step, strict=True)]
        return [algebra.bound(change) for change in changes[: 2 * self.n]]

    def is_identity(self, k):  # whether I_k is conserved exactly, for all x, t and ε
        algebra = Identities(2 * self.n + 2, self.programs)
        pairs = zip(algebra.x, self.ends, strict=True)
        x = [(s, algebra.unit) if a < b else algebra.constant(a) for s, (a, b) in pairs]
        numerator, denominator = self.change(k, self.states_of_step(x, algebra), algebra)
        return numerator == 0 and denominator != 0

    def rounding(self, box):  # changes of the I_k by that of a step; errors of the coordinates
        algebra, exactly, n = Rounding(self.unit, self.limits), Rounding(0), self.n
        x = [algebra.inexact((ball((a + b) / 2, (b - a) / 2), arb(0)), 0) for a, b in box]
        x[:n] = [(arb(0, float(q)), v[1]) if q else v for q, v in zip(self.angles, x, strict=False)]
        x[-2] = x[-2][0], ball(4 * UNITS["float64"] * max(map(abs, self.time)))  # t = t0 + kh
        start, end = self.states_of_step(x, algebra)
        if self.implicit:  # the solver accepts a p1 whose residual is `accepted` and as computed
            # A Lipschitz constant of p1 → h·rate(q0, p1) in the maximum norm: the effect of errors.
            momenta = [(p1, arb(2) ** -60) for p1, _ in x[n:-2]]
            inputs = [*x[:n], *momenta, (x[-2][0], arb(0)), x[-1], exactly.constant(self.h)]
            lipschitz = max(round_up(e) * 2.0**60 for _, e in run(self.step, inputs, exactly)[:n])
            require(lipschitz < 1 / 3, "the implicit step is not shown to be a contraction", box)
            error = max((e for _, e in start[n : 2 * n]), key=round_up) + ball(self.residual_limit)
            x[n:-2] = [(p1, error / (1 - arb(lipschitz))) for p1, _ in momenta]
            end = self.states_of_step(x, algebra)[1]
        changes = [run(function, end, exactly)[0][1] for function in self.invariants]
        return list(map(round_up, changes)), [round_up(error) for _, error in end[: 2 * n]]


def leaves(box, node):  # of a tree of cuts ["cut", axis, where, part, part], with the claims there
    if isinstance(node, str):
        return (yield box, node)
    cut, axis, where, *parts = node
    (a, b), c = box[whole(len(box) - 1, axis)[0]], number(where)
    require(cut == "cut" and len(parts) == 2 and a <= c <= b, "not a cut in two parts", box)
    for side, part in zip(((a, c), (c, b)), parts, strict=True):
        yield from leaves([*box[:axis], side, *box[axis + 1 :]], part)


def check_step(checker, box, claim, limits):  # 1 and 2; the limits per_step, rounding and reach
    require(claim in ("bounded", "outside"), f"{claim:.64} is no claim", box)
    algebra, x = checker.models(box)
    if claim == "outside" and not checker.implicit:  # the step may be singular there
        return require(checker.is_outside(algebra, x), "not shown to be outside", box)
    step, (roundings, errors) = checker.states_of_step(x, algebra), checker.rounding(box)
    moves = checker.displacement(step, algebra)
    pairs = zip(moves[checker.n :], checker.spread, strict=True)
    require(not checker.implicit or all(m <= s for m, s in pairs), "p1 is far from p0", box)
    if claim == "outside":
        return require(checker.is_outside(algebra, step[0]), "not shown to be outside", box)
    changes = [algebra.bound(checker.change(k, step, algebra)) for k in range(len(roundings))]
    changes = [0 if limits[k] == 0 and checker.is_identity(k) else b for k, b in enumerate(changes)]
    moves = [m + Fraction(e) for m, e in zip(moves, errors, strict=True)]
    fits = all(a <= b for a, b in zip([*changes, *roundings, *moves], limits, strict=True))
    return require(fits, "a change, a rounding or a move is larger than stated", box)


def combination_model(checker, weights, box):  # Σ w_k I_k as a model on a box
    algebra, x = checker.models(box)
    x, pairs = [*x, algebra.constant(checker.h)], zip(weights, checker.invariants, strict=True)
    terms = [algebra.multiply(algebra.constant(w), run(f, x, algebra)[0]) for w, f in pairs if w]
    return algebra, algebra.sum(*terms)


def check_confined(checker, box, claim, weights, limit, reach):  # 3: why no trajectory leaves there
    if claim == "unreachable":
        wide = [(a - w, b + w) for (a, b), w in zip(box[:-2], reach, strict=True)]
        is_shown = checker.is_outside(*checker.models([*wide, *box[-2:]]))
    elif claim == "inside":
        is_shown = checker.is_inside(box)
    else:
        algebra, value = combination_model(checker, weights, box)
        is_shown = claim == "above" and algebra.range(value)[0] > limit
    require(is_shown, f"{claim:.64} is not shown", box)


def check(certificate):  # what is proved, as text; raises `Failure` if it is not
    c = certificate
    require(c["format"] == FORMAT, f"the format is not {FORMAT!r}")
    require(digest(c) == c["hash"], "the file was changed: its hash differs")
    checker, count = Checker(c), len(c["invariants"])
    per_step, rounding = numbers(c["per_step"], count, 0), numbers(c["rounding"], count, 0)
    reach = numbers(c["reach"], 2 * checker.n, 0)
    boxes = list(leaves(checker.root(), c["boxes"]))
    for box, claim in boxes:
        check_step(checker, box, claim, [*per_step, *rounding, *reach])
    example = [(x, x) for x in numbers(c["example"], 2 * checker.n + 2)]
    require(count > 0 and checker.is_inside(example), "no invariant, or no state of the domain")
    text = statement(checker, len(boxes), per_step, rounding)
    if c["level"] is None:
        return text
    (weights, value), (steps,) = c["level"], whole(2**200, c["steps"], low=1)
    weights, value, start = numbers(weights, count), number(value), number(c["start"])
    rates = [abs(w) * (b + r) for w, b, r in zip(weights, per_step, rounding, strict=True)]
    is_timed = any(["input", 2 * checker.n] in f["operations"] for f in checker.programs)
    first, last = checker.times(start, steps)
    is_long = is_timed and (first < checker.time[0] or last > checker.time[1])
    require(not is_long, "the steps last longer than the time", [checker.time])
    checker.bits = LEVEL
    algebra, least = combination_model(checker, weights, example)
    require(example[-2][0] == start and algebra.range(least)[1] <= value, "the example is no start")
    triples = [*zip(checker.angles, reach, checker.ends, strict=False)]
    fits = all(not q or q >= max(-a, b) + steps * m for q, m, (a, b) in triples)
    require(fits, "an angle may be larger than stated")
    wide = [*(0 if q else m for q, m, _ in triples), *reach[checker.n :], 0, 0]
    sides = [(a - w, b + w) for (a, b), w in zip(checker.root(), wide, strict=True)]
    for box, claim in leaves(sides, c["shell"]):
        check_confined(checker, box, claim, weights, value + steps * sum(rates), reach)
    text += f"\n- trajectories from there{f' and t = {float(start)!r}' * is_timed} with Σ w_k I_k ≤"
    return f"{text} {float(value)!r}, w = {[*map(float, weights)]}, stay there for {steps} steps"


def statement(checker, count, *bounds):  # what 1 and 2 say, and what they assume
    rows = checker.lower, checker.upper, *checker.ends[-2:], *bounds
    lower, upper, time, epsilon, per_step, rounding = ([*map(float, row)] for row in rows)
    return (
        f"on {count} boxes, with h = {float(checker.h)!r}, for all (q, p) "
        f"from {lower} to {upper}{' with inside ≥ 0' * bool(checker.inside['outputs'])}, all t"
        f"{', which is ε times the time,' * checker.slow} in {time} and all ε in {epsilon}:"
        f"\n- a step changes I by ≤ {per_step} in exact arithmetic"
        f"\n- its rounding in {checker.arithmetic} by {checker.way} changes I by ≤ {rounding} more"
        f"{f', of increments to multiples of {float(checker.quantum)!r}' * bool(checker.quantum)}"
        f"{f', for residuals ≤ {float(checker.residual_limit):.3g}' * checker.implicit}"
        f"{f', q are angles up to {[*map(float, checker.angles)]}' * any(checker.angles)}"
        "\n- not checked: that a program has these operations (holds_for), with functions to 4 ulp"
    )


def main(path):  # check one file; the exit code is 0 for a proof, 1 otherwise
    try:
        print("proved:", check(json.loads(pathlib.Path(path).read_text(encoding="utf-8"))))
    except Exception as error:  # whatever is wrong with a file, nothing is proved
        return print(f"not proved: {type(error).__name__}: {error}") or 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
