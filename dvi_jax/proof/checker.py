"""The checker of drift certificates, short enough to be read completely: python checker.py FILE.

It needs Python and python-flint only. A certificate states, for a map Φ(x, t, ε) and functions
I_k(x, t, ε) of x = (q, p), given as lists of scalar operations, which also contain h:

1. |I_k(Φ(x, t, ε), t1, ε) − I_k(x, t, ε)| ≤ `per_step`[k] in exact arithmetic, in the domain, for
   all t and ε of their intervals, with t1 = t + h, or t + εh if t is a slow time;
2. a step that is computed in the `arithmetic` changes I_k by at most `rounding`[k] more, and moves
   no coordinate by more than `reach`;
3. trajectories that start in the domain with Σ w_k I_k ≤ c, where (w, c) is the `level`, stay in
   the domain for `steps` steps, exact or computed.

For 1 and 2 boxes cover the domain. On a box a function is a polynomial with integer coefficients
and a bound of the remainder (a Taylor model; Makino & Berz 2003); elementary functions are enclosed
by balls (Arb). For 3, boxes cover all places outside of the domain that one step can reach, and on
each Σ w_k I_k exceeds c by more than `steps` steps can change it: no trajectory gets there. A step
that is implicit in p1 is a function of (q0, p1): each (q0, p0) of the domain has one p1 within
`spread`, because p1 → p0 + h·rate maps this box into itself and is a contraction. If increments are
rounded to multiples of `quantum`, the step has one more input, the error of each of them.
"""

import hashlib
import json
import math
import pathlib
import sys
from fractions import Fraction
from typing import Any

from flint import arb, arb_series, ctx, fmpq, fmpq_mpoly_ctx, fmpz_mpoly_ctx

FORMAT = "dvi_jax drift bound 1"
FUNCTIONS = ("exp", "log", "sin", "cos", "tan", "atan", "asin", "acos", "sqrt", "inverse")
ULPS = {"sqrt": 1, "inverse": 1}  # errors of functions in units of round-off; 8 (4 ulp) for others
FORMAT_ERRORS = LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RecursionError
UNITS = {"float64": Fraction(1, 2**53), "pairs of float64": Fraction(1, 2**103)}  # round-off
LEVEL = 30  # bits for levels, where nothing cancels
SMALLEST = 2.0**-1000  # added to each error, for results below the normal numbers


class Failure(Exception):
    """What could not be shown, and where."""


def require(condition, message, box=()):
    if not condition:
        where = " × ".join(f"[{float(a):.6g}, {float(b):.6g}]" for a, b in box)
        raise Failure(f"{message} on the box {where}" if box else message)


def digest(certificate):
    """SHA-256 of everything in a certificate but the hash itself."""
    text = json.dumps({k: v for k, v in certificate.items() if k != "hash"}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def exact(texts) -> Any:
    """The numbers that hexadecimal floats stand for."""
    return Fraction(float.fromhex(texts)) if isinstance(texts, str) else [exact(x) for x in texts]


def round_up(value):
    """A fraction or a ball, rounded up to a float."""
    if isinstance(value, arb):
        value = value.upper()
        return math.nextafter(float(value), math.inf) if value.is_finite() else math.inf
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else math.nextafter(nearest, math.inf)


def ball(value, radius=0):
    """A fraction as a ball."""
    return arb(value.numerator) / value.denominator + arb(0, round_up(Fraction(radius)))


def series(name, point, length):
    """The Taylor coefficients of a function at a point, or balls of them on a ball."""
    ctx.cap = length
    x = arb_series([point, 1], length)
    return 1 / x if name == "inverse" else getattr(x, name)()


def difference(a, b, algebra):
    return algebra.sum(a, (-b[0], b[1]))


def run(program, inputs, algebra):
    """The outputs of a list of operations (name, operands): numbers of earlier operations."""
    values = []
    for name, *operands in program["operations"]:
        if name == "input":
            value = inputs[operands[0]]
        elif name == "constant":
            value = algebra.constant(exact(operands[0]))
        elif name in FUNCTIONS:
            value = algebra.apply(name, values[operands[0]])
        else:
            require(name in ("sum", "multiply"), f"unknown operation {name}")
            value = getattr(algebra, name)(*(values[i] for i in operands))
        values.append(value)
    return [values[i] for i in program["outputs"]]


class Models:
    """Taylor models in variables s with |s| ≤ 1.
    Functions that differ from P(s)/2^bits by at most E/2^bits are a model (P, E), with integers E
    and coefficients of P. Products are rounded towards zero, so that small terms vanish."""

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

    def range(self, a):
        """A lower and an upper bound of the value; an even power of s is not negative."""
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
        expansion = series(
            name, arb(int(low)).union(arb(int(high))) / self.unit, len(self.orders) + 1
        )
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
    """Values (ball, error): a computed number differs by at most `error` from one in the ball.
    Each operation has a relative error of at most `unit`, a quotient of two. If a product is
    contracted with a sum, there is one rounding less; a sum may be taken in any order."""

    def __init__(self, unit):
        self.unit = ball(Fraction(unit))

    def constant(self, value, error=0):
        return ball(value), ball(Fraction(error))

    def with_error(self, value, error, units=1):
        return value, arb((error + units * self.unit * (abs(value) + error) + SMALLEST).upper())

    def sum(self, *terms):
        error, size = sum(t[1] for t in terms), sum(abs(t[0]) + t[1] for t in terms)
        roundoff = len(terms) * self.unit * size + SMALLEST
        return sum(t[0] for t in terms), arb((error + roundoff).upper())

    def multiply(self, a, b):
        error = abs(a[0]) * b[1] + abs(b[0]) * a[1] + a[1] * b[1]
        return self.with_error(a[0] * b[0], error)

    def apply(self, name, a):
        derivatives = series(name, a[0] + arb(0, round_up(a[1])), 2)
        require(derivatives[1].is_finite(), f"{name} is singular")
        return self.with_error(derivatives[0], abs(derivatives[1]) * a[1], ULPS.get(name, 8))


class Identities:
    """Quotients (numerator, denominator) of polynomials with rational coefficients, in x and in
    each value f(a) of an elementary function, of which nothing else is used."""

    def __init__(self, size):
        self.ring = fmpq_mpoly_ctx.get([f"x{i}" for i in range(size + 40)], "lex")
        self.unit, self.values = self.ring.constant(1), {}
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
        key = name, str(a[0]), str(a[1])
        self.values[key] = self.values.get(key) or (self.free.pop(), self.unit)
        return self.values[key]


class Checker:
    """A certificate, and what is evaluated on a box of (q, p, t, ε)."""

    def __init__(self, certificate):
        self.step, self.invariants = certificate["step"], certificate["invariants"]
        self.inside, self.implicit = certificate["inside"], certificate["implicit"]
        self.lower, self.upper = exact(certificate["domain"])
        self.time, self.epsilon = exact(certificate["time"]), exact(certificate["epsilon"])
        self.n, self.slow = len(self.lower) // 2, certificate["slow"]
        numbers = (exact(certificate[name]) for name in ("h", "quantum", "accepted", "spread"))
        self.h, self.quantum, self.residual_limit, self.spread = numbers
        self.bits, self.orders = certificate["bits"], certificate["orders"]
        self.arithmetic, self.unit = certificate["arithmetic"], UNITS[certificate["arithmetic"]]
        has_grid = ["input", 2 * self.n + 3] in self.step["operations"]
        require(has_grid == (self.quantum > 0), "a grid is used or stated, but not both")
        ctx.prec = self.bits + 60

    def root(self):
        """The box of all boxes: the domain, where p1 may differ from p0 by `spread`."""
        wide = [Fraction(0)] * self.n + self.spread
        box = [(a - w, b + w) for a, b, w in zip(self.lower, self.upper, wide, strict=True)]
        return [*box, tuple(self.time), tuple(self.epsilon)]

    def models(self, box):
        """The coordinates of a box as Taylor models; ε from 0 keeps its orders apart."""
        algebra = Models(len(box), self.bits, self.orders)
        parts = [((a + b) / 2, (b - a) / 2) for a, b in box]
        parts[-1] = (Fraction(0), box[-1][1]) if box[-1][0] == 0 else parts[-1]
        gens = [(s * algebra.unit, 0) for s in algebra.ring.gens()]
        c = [[algebra.constant(value) for value in part] for part in parts]
        pairs = zip(gens, c, strict=True)
        return algebra, [algebra.sum(a, algebra.multiply(s, b)) for s, (a, b) in pairs]

    def is_outside(self, algebra, x):
        """Whether no state of these models is in the domain."""
        sides = zip(map(algebra.range, x), self.lower, self.upper, strict=False)
        is_separate = any(high < lower or low > upper for (low, high), lower, upper in sides)
        return is_separate or any(algebra.range(g)[1] < 0 for g in run(self.inside, x, algebra))

    def states_of_step(self, x, algebra):
        """(q, p, t, ε, h) before and after a step, from the coordinates of a box."""
        q0, p0, (t0, epsilon) = x[: self.n], x[self.n : -2], x[-2:]
        h, error = algebra.constant(self.h), algebra.constant(Fraction(0), self.quantum / 2)
        end = run(self.step, [*x, h, error], algebra)
        if self.implicit:  # (q0, p1) → (h·rate, q1)
            end, moves, p1 = [*end[self.n :], *p0], end[: self.n], p0
            p0 = [difference(p, m, algebra) for p, m in zip(p1, moves, strict=True)]
        t1 = algebra.sum(t0, algebra.multiply(epsilon, h) if self.slow else h)
        return [*q0, *p0, t0, epsilon, h], [*end, t1, epsilon, h]

    def change(self, k, step, algebra):
        """I_k(Φ(x)) − I_k(x), from x before and after a step."""
        start_value, end_value = (run(self.invariants[k], x, algebra)[0] for x in step)
        return difference(end_value, start_value, algebra)

    def displacement(self, step, algebra):
        """How far a step moves each coordinate, in exact arithmetic."""
        pairs = list(zip(*step, strict=True))[: 2 * self.n]
        return [algebra.bound(difference(b, a, algebra)) for a, b in pairs]

    def is_identity(self, k):
        """Whether I_k is conserved exactly, for all x, t and ε."""
        algebra = Identities(2 * self.n + 2)
        step = self.states_of_step([(x, algebra.unit) for x in algebra.x], algebra)
        numerator, denominator = self.change(k, step, algebra)
        return numerator == 0 and denominator != 0

    def rounding(self, box):
        """The changes of the I_k by the rounding of a step, and the errors of the coordinates.
        The solver accepts a p1 whose residual is at most `residual_limit`, as computed."""
        algebra, exactly, n = Rounding(self.unit), Rounding(0), self.n
        x = [(ball((a + b) / 2, (b - a) / 2), arb(0)) for a, b in box]
        x[-2] = x[-2][0], 2 * ball(UNITS["float64"]) * abs(x[-2][0])  # t = t0 + kh in float64
        start, end = self.states_of_step(x, algebra)
        if self.implicit:
            # A Lipschitz constant of p1 → h·rate(q0, p1) in the maximum norm: the effect of errors.
            momenta = [(p1, arb(2) ** -60) for p1, _ in x[n:-2]]
            inputs = [*x[:n], *momenta, *x[-2:], exactly.constant(self.h)]
            lipschitz = max(round_up(e) * 2.0**60 for _, e in run(self.step, inputs, exactly)[:n])
            require(lipschitz < 1 / 3, "the implicit step is not shown to be a contraction", box)
            residual = arb(round_up(self.residual_limit))
            error = max((e + residual for _, e in start[n : 2 * n]), key=round_up)
            x[n:-2] = [(p1, error / (1 - arb(lipschitz))) for p1, _ in momenta]
            end = self.states_of_step(x, algebra)[1]
        changes = [run(function, end, exactly)[0][1] for function in self.invariants]
        return list(map(round_up, changes)), [round_up(error) for _, error in end[: 2 * n]]


def leaves(box, node):
    """The boxes of a tree of cuts ["cut", axis, where, part, part], with what is claimed there."""
    if not (isinstance(node, list) and node[0] == "cut"):
        return (yield box, node)
    _, axis, where, *parts = node
    require(axis in range(len(box)) and len(parts) == 2, "a cut has no axis or part", box)
    (a, b), c = box[axis], exact(where)
    require(a <= c <= b, "a cut is outside of its box,", box)
    for side, part in zip(((a, c), (c, b)), parts, strict=True):
        yield from leaves([*box[:axis], side, *box[axis + 1 :]], part)


def check_step(checker, box, claim, limits):
    """Statements 1 and 2 on one box; `stated`: the numbers per_step, rounding and reach."""
    algebra, x = checker.models(box)
    if claim == "outside" and not checker.implicit:  # the step may be singular there
        return require(checker.is_outside(algebra, x), "not shown to be outside", box)
    step, (roundings, errors) = checker.states_of_step(x, algebra), checker.rounding(box)
    moves = checker.displacement(step, algebra)
    pairs = zip(moves[checker.n :], checker.spread, strict=True)
    require(not checker.implicit or all(m <= s for m, s in pairs), "p1 is far from p0", box)
    if claim == "outside":
        return require(checker.is_outside(algebra, step[0]), "not shown to be outside", box)
    changes = [checker.change(k, step, algebra) for k in range(len(checker.invariants))]
    changes = map(algebra.bound, changes)
    changes = [0 if limits[k] == 0 and checker.is_identity(k) else b for k, b in enumerate(changes)]
    moves = [m + Fraction(e) for m, e in zip(moves, errors, strict=True)]
    fits = [a <= b for a, b in zip([*changes, *roundings, *moves], limits, strict=True)]
    return require(all(fits), "a change, a rounding or a move is larger than stated", box)


def combination_model(checker, weights, box):
    """Σ w_k I_k as a model on a box."""
    algebra, x = checker.models(box)
    x, pairs = [*x, algebra.constant(checker.h)], zip(weights, checker.invariants, strict=True)
    terms = [algebra.multiply(algebra.constant(w), run(f, x, algebra)[0]) for w, f in pairs if w]
    return algebra, algebra.sum(*terms)


def check_confined(checker, box, claim, weights, limit, reach):
    """Statement 3 on one box: no trajectory gets there, or it is in the domain there."""
    if claim == "unreachable":
        wide = [(a - w, b + w) for (a, b), w in zip(box[:-2], reach, strict=True)]
        is_shown = checker.is_outside(*checker.models([*wide, *box[-2:]]))
    elif claim == "inside":
        sides = zip(box, checker.lower, checker.upper, strict=False)
        is_shown = all(low <= a and b <= high for (a, b), low, high in sides)
        algebra, x = checker.models(box)
        is_shown &= all(algebra.range(g)[0] >= 0 for g in run(checker.inside, x, algebra))
    else:
        algebra, value = combination_model(checker, weights, box)
        is_shown = algebra.range(value)[0] > limit
    require(is_shown, f"{claim} is not shown", box)


def check(certificate):
    """What a certificate proves, as a sentence. **Raises** `Failure` if it does not."""
    require(certificate["format"] == FORMAT, f"the format is not {FORMAT!r}")
    require(digest(certificate) == certificate["hash"], "the file was changed: its hash differs")
    checker = Checker(certificate)
    per_step, rounding, reach = (exact(certificate[x]) for x in ("per_step", "rounding", "reach"))
    boxes = list(leaves(checker.root(), certificate["boxes"]))
    for box, claim in boxes:
        check_step(checker, box, claim, [*per_step, *rounding, *reach])
    text = f"on {len(boxes)} boxes a step changes I by ≤ {[*map(float, per_step)]}"
    text += f", its rounding in {checker.arithmetic} by ≤ {[*map(float, rounding)]}"
    text += f" on a grid of {float(checker.quantum)}" * bool(checker.quantum)
    residual = float(checker.residual_limit)
    text += f" if a solver accepts residuals ≤ {residual:.3g}" * checker.implicit
    if certificate["level"] is None:
        return text
    (weights, value), steps = exact(certificate["level"]), certificate["steps"]
    rates = [abs(w) * (b + r) for w, b, r in zip(weights, per_step, rounding, strict=True)]
    *sides, time, epsilon = checker.root()
    sides = [(a - w, b + w) for (a, b), w in zip(sides, reach, strict=True)]
    t, lasts = ["input", 2 * checker.n], steps * checker.h * (epsilon[1] if checker.slow else 1)
    is_timed = any(t in program["operations"] for program in [checker.step, *checker.invariants])
    require(
        not is_timed or lasts <= time[1] - time[0], "the steps last longer than the time", [time]
    )
    checker.bits = LEVEL
    for box, claim in leaves([*sides, time, epsilon], certificate["shell"]):
        check_confined(checker, box, claim, weights, value + steps * sum(rates), reach)
    return text + f"; from Σ w_k I_k ≤ {float(value):.6g} the domain is not left in {steps} steps"


def main(path):
    """Check one file. Returns the exit code: 0 for a proof, 1 otherwise."""
    try:
        print("proved:", check(json.loads(pathlib.Path(path).read_text(encoding="utf-8"))))
    except (Failure, OSError, *FORMAT_ERRORS) as error:
        print(f"not proved: {type(error).__name__}: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
