"""The checker of drift certificates, short enough to be read completely: python checker.py FILE.

It needs Python and python-flint, no other part of the package. A certificate states, for a map
Φ(x, ε) and functions I_k(x, ε) given as lists of scalar operations, with x = (q, p):

1. |I_k(Φ(x, ε), ε) − I_k(x, ε)| ≤ `per_step`[k] in exact arithmetic, in the domain and for all ε;
2. a step that is computed with the unit round-off `unit` changes I_k by at most `rounding`[k] more,
   and moves no coordinate by more than `reach`;
3. trajectories that start in the domain with `levels`[k][0] ≤ I_k ≤ `levels`[k][1] for all k
   stay in the domain for `steps` steps, exact or computed.

For 1 and 2 boxes cover the domain. On a box a function is a polynomial in the coordinates of the
box with integer coefficients, and a bound of the remainder (a Taylor model; Makino & Berz 2003);
elementary functions are enclosed by balls (Arb). For 3, boxes cover all places outside of the
domain that one step can reach, and on each some I_k differs from its levels by more than `steps`
steps can change it. By induction no trajectory gets there.

A step that is implicit in p1 is a function of (q0, p1), on boxes of those. Each (q0, p0) of the
domain has a p1 within `spread` of p0, because p1 → p0 + h·rate maps this box into itself (Brouwer),
and only one, because it is a contraction there.
"""

import hashlib
import json
import math
import operator
import pathlib
import sys
from fractions import Fraction

from flint import arb, arb_series, ctx, fmpq, fmpq_mpoly_ctx, fmpz_mpoly_ctx

FORMAT = "dvi_jax drift bound 1"
FUNCTIONS = ("exp", "log", "sin", "cos", "tan", "atan", "asin", "acos", "sqrt")
ORDERS = 24  # the largest order of the expansion of an elementary function
ULPS = {"sqrt": 1}  # errors of computed functions in units of round-off; 8 (4 ulp) for others
MALFORMED = (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RecursionError)
LEAST = 2.0**-1000  # added to each error, for results below the normal numbers


class Failed(Exception):
    """What could not be shown, and where."""


def digest(certificate):
    """SHA-256 of everything in a certificate but the hash itself."""
    text = json.dumps({k: v for k, v in certificate.items() if k != "hash"}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def exact(text):
    """The number that a hexadecimal float stands for."""
    return Fraction(float.fromhex(text))


def up(value):
    """A fraction or a ball, rounded up to a float."""
    if isinstance(value, arb):
        value = value.upper()
        return math.nextafter(float(value), math.inf) if value.is_finite() else math.inf
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else math.nextafter(nearest, math.inf)


def ball(value, radius=0):
    """A fraction as a ball."""
    return arb(value.numerator) / value.denominator + arb(0, up(Fraction(radius)))


def balls(box):
    return [ball((a + b) / 2, (b - a) / 2) for a, b in box]


def series(name, at, length):
    """The Taylor coefficients of a function at a point, or balls of them on a ball."""
    ctx.cap = length
    x = arb_series([at, 1], length)
    try:
        return 1 / x if name == "inverse" else getattr(x, name)()
    except (ValueError, ZeroDivisionError) as error:
        raise Failed(f"{name} is singular ({error})") from None


def negative(a):
    return -a[0], a[1]


def power(a, n, algebra):
    """aⁿ by n − 1 products, in any order."""
    if n < 1:
        one = algebra.constant(Fraction(1))
        return algebra.divide(one, power(a, -n, algebra)) if n else one
    if n == 1:
        return a
    square = power(algebra.multiply(a, a), n // 2, algebra)
    return algebra.multiply(square, a) if n % 2 else square


def run(program, inputs, algebra):
    """The outputs of a program: each operation is (name, operands), an operand is the number of an
    earlier operation. `algebra` has the arithmetic of the values."""
    values = []
    for name, *operands in program["operations"]:
        if name == "input":
            values.append(inputs[operands[0]])
        elif name == "constant":
            values.append(algebra.constant(exact(operands[0])))
        elif name == "power":
            values.append(power(values[operands[0]], operator.index(operands[1]), algebra))
        elif name in ("sum", "multiply", "divide"):
            values.append(getattr(algebra, name)(*(values[i] for i in operands)))
        elif name in FUNCTIONS:
            values.append(algebra.apply(name, values[operands[0]]))
        else:
            raise Failed(f"unknown operation {name}")
    return [values[i] for i in program["outputs"]]


class Models:
    """Taylor models in variables s with |s| ≤ 1.

    A model (P, E) stands for functions that differ from P(s)/2^bits by at most E/2^bits. P has
    integer coefficients; those below `tiny` are moved to E, an integer.
    """

    def __init__(self, size, bits, tiny):
        self.bits, self.one, self.tiny = bits, 1 << bits, max(1, int(Fraction(tiny) * 2**bits))
        self.ring = fmpz_mpoly_ctx.get([f"s{i}" for i in range(size)], "lex")

    def constant(self, value):
        scaled = value * self.one
        return self.ring.constant(math.floor(scaled)), int(scaled.denominator != 1)

    def sum(self, *terms):
        return sum((t[0] for t in terms[1:]), terms[0][0]), sum(t[1] for t in terms)

    def multiply(self, a, b):
        norm = [int(sum(map(abs, x[0].coeffs()))) for x in (a, b)]  # |P| is not larger
        error = norm[0] * b[1] + norm[1] * a[1] + a[1] * b[1]
        kept = {}
        for powers, c in (a[0] * b[0]).to_dict().items():
            rounded = c >> self.bits
            if abs(rounded) < self.tiny:
                error += abs(c)
            else:
                kept[powers] = rounded
                error += c - (rounded << self.bits)
        return self.ring.from_dict(kept), (int(error) >> self.bits) + 1

    def divide(self, a, b):
        return self.multiply(a, self.apply("inverse", b))

    def range(self, a):
        """A lower and an upper bound of the value; an even power of s is not negative."""
        low, high = -a[1], a[1]
        for powers, c in a[0].to_dict().items():
            if any(powers):
                even = not any(k % 2 for k in powers)
                low -= -min(c, 0) if even else abs(c)
                high += max(c, 0) if even else abs(c)
            else:
                low, high = low + c, high + c
        return Fraction(int(low), self.one), Fraction(int(high), self.one)

    def bound(self, a):
        return max(map(abs, self.range(a)))

    def apply(self, name, a):
        """f(c + r) = Σ f⁽ᵏ⁾(c)/k! rᵏ, with Lagrange's remainder on the range of c + r."""
        low, high = (value * self.one for value in self.range(a))
        middle = int(low + high) // 2
        ahead = series(name, arb(int(low)).union(arb(int(high))) / self.one, ORDERS + 2)
        radius = arb(int(max(high - middle, middle - low))) / self.one
        left = [abs(ahead[k + 1]) * radius ** (k + 1) * self.one for k in range(ORDERS + 1)]
        if not all(remainder.is_finite() for remainder in left):
            raise Failed(f"{name} is singular, or varies too much")
        small = (k for k in range(ORDERS + 1) if left[k] < self.tiny)
        order = next(small, min(range(ORDERS + 1), key=lambda k: up(left[k])))
        terms = series(name, arb(middle) / self.one, order + 1)
        rest, result = (a[0] - middle, a[1]), self.constant(Fraction(0))
        for k in range(order, -1, -1):
            scaled = terms[k] * self.one
            whole = int(scaled.mid().floor().unique_fmpz() or 0)
            coefficient = self.ring.constant(whole), math.ceil(up(abs(scaled - whole)))
            result = self.sum(self.multiply(result, rest), coefficient)
        return result[0], result[1] + math.ceil(up(left[order]))


class Rounding:
    """Values (ball, error): a computed number differs by at most `error` from one in the ball.

    Each operation has a relative error of at most `unit`. If a product is contracted with a sum,
    there is one rounding less; a sum may be taken in any order.
    """

    def __init__(self, unit):
        self.unit = ball(Fraction(unit))

    def constant(self, value):
        return ball(value), arb(0)

    def rounded(self, value, error, operations=1):
        return value, arb((error + operations * self.unit * (abs(value) + error) + LEAST).upper())

    def sum(self, *terms):
        error, size = sum(t[1] for t in terms), sum(abs(t[0]) + t[1] for t in terms)
        made = len(terms) * self.unit * size + LEAST
        return sum(t[0] for t in terms), arb((error + made).upper())

    def multiply(self, a, b):
        error = abs(a[0]) * b[1] + abs(b[0]) * a[1] + a[1] * b[1]
        return self.rounded(a[0] * b[0], error)

    def divide(self, a, b):
        value, least = a[0] / b[0], b[0].abs_lower() - b[1]
        if not least > 0:
            raise Failed("a divisor can be zero")
        # A compiler may multiply by the inverse of a constant: two roundings.
        return self.rounded(value, (a[1] + abs(value) * b[1]) / least, 2)

    def apply(self, name, a):
        near = series(name, a[0] + arb(0, up(a[1])), 2)
        return self.rounded(near[0], abs(near[1]) * a[1], ULPS.get(name, 8))


class Identities:
    """Quotients (numerator, denominator) of polynomials with rational coefficients."""

    def __init__(self, size):
        self.ring = fmpq_mpoly_ctx.get([f"x{i}" for i in range(size)], "lex")
        self.one = self.ring.constant(1)

    def constant(self, value):
        return self.ring.constant(fmpq(value.numerator, value.denominator)), self.one

    def sum(self, *terms):
        (a, b), *others = terms
        for c, d in others:
            a, b = (a + c, b) if b == d else (a * d + c * b, b * d)
        return a, b

    def multiply(self, a, b):
        return a[0] * b[0], a[1] * b[1]

    def divide(self, a, b):
        return a[0] * b[1], a[1] * b[0]

    def apply(self, name, a):
        raise Failed(f"an identity with {name} is not proved")


class Checker:
    """A certificate with its numbers read, and what is evaluated on a box of it."""

    def __init__(self, certificate):
        self.step, self.invariants = certificate["step"], certificate["invariants"]
        self.inside, sides = certificate["inside"], certificate["domain"]
        self.lower, self.upper = ([exact(x) for x in side] for side in sides)
        self.n, self.implicit = len(self.lower) // 2, certificate["implicit"]
        self.spread = [exact(x) for x in certificate["spread"]]
        self.epsilon = tuple(exact(x) for x in certificate["epsilon"])
        self.unit, self.accepted = exact(certificate["unit"]), exact(certificate["accepted"])
        self.bits, self.tiny = certificate["bits"], exact(certificate["tiny"])
        self.h = exact(certificate["h"])
        require(self.unit >= Fraction(1, 2**53), "the unit is not that of float64", self.root())
        ctx.prec = self.bits + 60

    def root(self):
        """The box of all boxes: the domain, where p1 may differ from p0 by `spread`; and ε."""
        wide = [Fraction(0)] * self.n + self.spread
        box = zip(self.lower, self.upper, wide, strict=True)
        return [(a - w, b + w) for a, b, w in box] + [self.epsilon]

    def models(self, box):
        """The coordinates of a box and ε as Taylor models; ε from 0 keeps its orders apart."""
        algebra = Models(len(box), self.bits, self.tiny)
        parts = [((a + b) / 2, (b - a) / 2) for a, b in box]
        if box[-1][0] == 0:
            parts[-1] = Fraction(0), box[-1][1]
        x = []
        for s, (middle, radius) in zip(algebra.ring.gens(), parts, strict=True):
            moved = algebra.multiply((s * algebra.one, 0), algebra.constant(radius))
            x.append(algebra.sum(algebra.constant(middle), moved))
        return algebra, x

    def is_outside(self, algebra, state):
        """Whether no state of these models is in the domain."""
        for x, lower, upper in zip(state, self.lower, self.upper, strict=True):
            low, high = algebra.range(x)
            if high < lower or low > upper:
                return True
        return any(algebra.range(g)[1] < 0 for g in run(self.inside, state, algebra))

    def start(self, x, algebra):
        """The state before a step, from the coordinates of a box and ε."""
        return self.stepped(x, algebra)[0] if self.implicit else x[:-1]

    def stepped(self, x, algebra):
        """The states before and after a step."""
        out, n = run(self.step, [*x, algebra.constant(self.h)], algebra), self.n
        if not self.implicit:
            return x[:-1], out
        # (q0, p1) → (h·rate, q1), and p0 = p1 − h·rate.
        p0 = [algebra.sum(p1, negative(r)) for p1, r in zip(x[n:-1], out[:n], strict=True)]
        return [*x[:n], *p0], [*out[n:], *x[n:-1]]

    def changes(self, x, algebra):
        """I_k(Φ(x)) − I_k(x) for each k."""
        start, end = self.stepped(x, algebra)
        changes = []
        for function in self.invariants:
            before, after = (run(function, [*z, x[-1]], algebra)[0] for z in (start, end))
            changes.append(algebra.sum(after, negative(before)))
        return changes

    def is_identity(self, k):
        """Whether I_k is conserved exactly, for all x and ε: as a rational function."""
        algebra = Identities(2 * self.n + 1)
        x = [(gen, algebra.one) for gen in algebra.ring.gens()]
        numerator, denominator = self.changes(x, algebra)[k]
        return numerator == 0 and denominator != 0

    def moved(self, x, algebra):
        """How far a step moves each coordinate, in exact arithmetic."""
        pairs = zip(*self.stepped(x, algebra), strict=True)
        return [algebra.bound(algebra.sum(b, negative(a))) for a, b in pairs]

    def contraction(self, box):
        """A Lipschitz constant of p1 → h·rate(q0, p1) in the maximum norm."""
        x, small = balls(box), arb(2) ** -60
        z = [(value, small * (self.n <= i < 2 * self.n)) for i, value in enumerate(x)]
        out = run(self.step, [*z, Rounding(0).constant(self.h)], Rounding(0))
        return max(up(change / small) for _, change in out[: self.n])

    def rounding(self, box):
        """The changes of the I_k by the rounding of a step, and the errors of the coordinates."""
        algebra, n = Rounding(self.unit), self.n
        x = [(value, arb(0)) for value in balls(box)]
        start, end = self.stepped(x, algebra)
        if self.implicit:
            # The solver accepts a p1 whose residual is `accepted` and as computed.
            factor = 1 / (1 - arb(self.contraction(box)))
            error = max((e + arb(up(self.accepted)) for _, e in start[n:]), key=up) * factor
            p1 = [(value, error) for value, _ in x[n:-1]]
            end = self.stepped([*x[:n], *p1, x[-1]], algebra)[1]
        exactly = Rounding(0)
        changes = [run(function, [*end, x[-1]], exactly)[0][1] for function in self.invariants]
        return list(map(up, changes)), [up(error) for _, error in end]


def leaves(box, node):
    """The boxes of a tree of cuts ["cut", axis, where, part, part], with what is claimed there."""
    if not (isinstance(node, list) and node[0] == "cut"):
        yield box, node
        return
    _, axis, where, *parts = node
    require(axis in range(len(box)) and len(parts) == 2, "a cut has no axis or part", box)
    (a, b), c = box[axis], exact(where)
    require(a <= c <= b, "a cut is outside of its box,", box)
    for side, part in zip(((a, c), (c, b)), parts, strict=True):
        yield from leaves([*box[:axis], side, *box[axis + 1 :]], part)


def require(condition, what, box):
    if not condition:
        where = ", ".join(f"[{float(a):.6g}, {float(b):.6g}]" for a, b in box)
        raise Failed(f"{what} on the box {where}")


def check_step(checker, box, claim, per_step, rounding, reach):
    """Statements 1 and 2 on one box."""
    algebra, x = checker.models(box)
    if checker.implicit:
        near = zip(checker.moved(x, algebra)[checker.n :], checker.spread, strict=True)
        solved = all(m <= s for m, s in near) and checker.contraction(box) < 1 / 3
        require(solved, "p1 is not shown to be near p0", box)
    if claim == "outside":
        outside = checker.is_outside(algebra, checker.start(x, algebra))
        require(outside, "not shown to be outside of the domain", box)
        return
    rounded, errors = checker.rounding(box)
    bounds = [
        Fraction(0) if limit == 0 and checker.is_identity(k) else algebra.bound(change)
        for k, (change, limit) in enumerate(zip(checker.changes(x, algebra), per_step, strict=True))
    ]
    moved = [m + Fraction(e) for m, e in zip(checker.moved(x, algebra), errors, strict=True)]
    for found, stated in (bounds, per_step), (rounded, rounding), (moved, reach):
        fits = all(value <= limit for value, limit in zip(found, stated, strict=True))
        require(fits, "a change, a rounding or a move is larger than stated", box)


def check_confined(checker, box, claim, limits, reach):
    """Statement 3 on one box: no trajectory gets there, or it is in the domain there."""
    wide = [(a - w, b + w) for (a, b), w in zip(box, reach, strict=False)]
    algebra, x = checker.models([*wide, box[-1]] if claim == "unreachable" else box)
    if claim == "unreachable":
        require(checker.is_outside(algebra, x[:-1]), "one step can reach", box)
    elif claim == "inside":
        sides = zip(box[:-1], checker.lower, checker.upper, strict=True)
        inside = [low <= a and b <= high for (a, b), low, high in sides]
        inside += [algebra.range(g)[0] >= 0 for g in run(checker.inside, x[:-1], algebra)]
        require(all(inside), "not shown to be in the domain", box)
    else:
        side, k = claim
        low, high = algebra.range(run(checker.invariants[k], x, algebra)[0])
        off = low > limits[k][1] if side == "above" else high < limits[k][0]
        require(off, f"I_{k} does not exclude a trajectory", box)


def check(certificate):
    """What a certificate proves, as a sentence. **Raises** `Failed` if it does not."""
    if certificate.get("format") != FORMAT:
        raise Failed(f"the format is {certificate.get('format')!r}, not {FORMAT!r}")
    if digest(certificate) != certificate["hash"]:
        raise Failed("the hash is not that of the content: the file was changed")
    checker = Checker(certificate)
    per_step, rounding, reach = (
        [exact(x) for x in certificate[name]] for name in ("per_step", "rounding", "reach")
    )
    boxes = list(leaves(checker.root(), certificate["boxes"]))
    for box, claim in boxes:
        check_step(checker, box, claim, per_step, rounding, reach)
    text = f"on {len(boxes)} boxes a step changes I by ≤ {[*map(float, per_step)]}"
    text += f", its rounding by ≤ {[*map(float, rounding)]}"
    text += f" if a solver accepts residuals ≤ {float(checker.accepted):.3g}" * checker.implicit
    if certificate["shell"] is None:
        return text
    steps, limits = certificate["steps"], []
    for (low, high), b, r in zip(certificate["levels"], per_step, rounding, strict=True):
        change = steps * (b + r)
        above = math.inf if high is None else exact(high) + change
        limits.append((-math.inf if low is None else exact(low) - change, above))
    around = [(a - w, b + w) for (a, b), w in zip(checker.root()[:-1], reach, strict=True)]
    for box, claim in leaves([*around, checker.epsilon], certificate["shell"]):
        check_confined(checker, box, claim, limits, reach)
    return text + f"; from the given levels the domain is not left in {steps} steps"


def main(path):
    """Check one file. Returns the exit code: 0 for a proof, 1 otherwise."""
    try:
        print("proved:", check(json.loads(pathlib.Path(path).read_text(encoding="utf-8"))))
    except (Failed, OSError, *MALFORMED) as error:
        print(f"not proved: {type(error).__name__}: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
