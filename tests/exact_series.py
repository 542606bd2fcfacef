"""How many invariants of each order a map has in a basis, by exact arithmetic modulo a prime.

It shares no code with the search. Numbers are integers modulo a prime, so that a rank is exact:
the truncated power series in ε of a step is computed at random points, and the linear equations of
an invariant of order z are solved by elimination. Functions that have no value modulo a prime
(sines, cosines, square roots) are computed in double precision, and ranks by singular values.
"""

import math
from fractions import Fraction
from itertools import combinations_with_replacement
from typing import Any

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax.discover.functions.basis import Product, Sum
from dvi_jax.discover.functions.families import coordinate_names

PRIME = 2**31 - 1
"""A rank modulo this prime is less than that of the rational numbers by chance of 1e-6 or so."""

FLOAT_RANK = 1e-10
"""Singular values below this share of the largest are zero in double precision."""


def _of_either(name: str):
    """A function of a number of JAX, or of this module."""
    return lambda x: getattr(x, name)() if isinstance(x, Number) else getattr(jnp, name)(x)


cos, sin, log = map(_of_either, ("cos", "sin", "log"))


def vector(*components: Any) -> Any:
    """An array of these components, of JAX or of numbers of this module."""
    if any(isinstance(x, Number) for x in components):
        return objects(components)
    return jnp.stack(components)


class Number:
    """What follows from `of`, a sum, a product, −x and powers."""

    def __sub__(self, other):
        return NotImplemented if self.above(other) else self + -self.of(other)

    def __rsub__(self, other):
        return self.of(other) + -self

    def __truediv__(self, other):
        return NotImplemented if self.above(other) else self * self.of(other) ** -1

    def __rtruediv__(self, other):
        return self.of(other) * self**-1

    def __radd__(self, other):
        return self + other

    def __rmul__(self, other):
        return self * other


class Series(Number):
    """Σ ε^m c_m, cut off after ε^z, at many points: `c` of shape (z + 1, points).

    `prime`: integers modulo it, or None for double precision.
    """

    def __init__(self, c: np.ndarray, prime: int | None):
        self.c, self.prime = c, prime

    @staticmethod
    def above(other) -> bool:
        """Whether the other one does the operation."""
        return isinstance(other, Dual | np.ndarray)

    def of(self, value: Any) -> "Series":
        """A series, also of a constant. A float counts as the decimal number that it prints."""
        if isinstance(value, Series):
            return value
        c = np.zeros_like(self.c)
        if self.prime is None:
            c[0] = float(value)
        else:
            fraction = Fraction(repr(float(value)))
            c[0] = fraction.numerator * pow(fraction.denominator, -1, self.prime) % self.prime
        return Series(c, self.prime)

    def made(self, c: np.ndarray) -> "Series":
        return Series(c if self.prime is None else c % self.prime, self.prime)

    def __add__(self, other):
        return NotImplemented if self.above(other) else self.made(self.c + self.of(other).c)

    def __neg__(self):
        return self.made(-self.c)

    def __mul__(self, other):
        if self.above(other):
            return NotImplemented
        a, b = self.c, self.of(other).c
        out = np.zeros_like(a)
        for k in range(len(a)):
            for m in range(k + 1):
                out[k] = self.made(out[k] + self.made(a[m] * b[k - m]).c).c
        return self.made(out)

    def inverse(self) -> "Series":
        first = np.zeros_like(self.c)
        first[0] = 1 / self.c[0] if self.prime is None else _power(self.c[0], -1, self.prime)
        start, out = Series(first, self.prime), Series(first, self.prime)
        for _ in range(len(self.c)):
            out = out + start * (1 - self * out)
        return out

    def __pow__(self, power):
        if power == int(power):
            base = self if power >= 0 else self.inverse()
            out = self.of(1)
            for _ in range(abs(int(power))):
                out = out * base
            return out
        return self.through(lambda x, k: np.prod(power - np.arange(k)) * x ** (power - k))

    def cos(self):
        return self.through(lambda x, k: np.cos(x + k * np.pi / 2))

    def sin(self):
        return self.through(lambda x, k: np.sin(x + k * np.pi / 2))

    def log(self):
        return self.through(
            lambda x, k: np.log(x) if k == 0 else -math.factorial(k - 1) * (-x) ** -k
        )

    def through(self, derivative) -> "Series":
        """f of the series, from derivative(x, k), the k-th derivative of f at x."""
        if self.prime is not None:
            raise ValueError("this function has no value modulo a prime")
        first, rest = self.c[0], self.c.copy()
        rest[0] = 0
        out, power = self.of(0), self.of(1)
        for k in range(len(self.c)):
            scaled = np.zeros_like(self.c)
            scaled[0] = derivative(first, k) / math.factorial(k)
            out, power = out + power * Series(scaled, None), power * Series(rest, None)
        return out


class Dual(Number):
    """value + slope δ with δ² = 0: the derivative of a function of a Series."""

    def __init__(self, value: Series, slope: Any):
        self.value, self.slope = value, slope

    @staticmethod
    def above(other) -> bool:
        return isinstance(other, np.ndarray)

    def of(self, other):
        return other if isinstance(other, Dual) else Dual(self.value.of(other), self.value.of(0))

    def __add__(self, other):
        if self.above(other):
            return NotImplemented
        other = self.of(other)
        return Dual(self.value + other.value, self.slope + other.slope)

    def __neg__(self):
        return Dual(-self.value, -self.slope)

    def __mul__(self, other):
        if self.above(other):
            return NotImplemented
        other = self.of(other)
        return Dual(self.value * other.value, self.value * other.slope + self.slope * other.value)

    def __pow__(self, power):
        if power == 0:
            return self.of(1)
        return Dual(self.value**power, self.value ** (power - 1) * self.slope * power)

    def cos(self):
        return Dual(self.value.cos(), -(self.value.sin() * self.slope))

    def sin(self):
        return Dual(self.value.sin(), self.value.cos() * self.slope)

    def log(self):
        return Dual(self.value.log(), self.slope / self.value)


def _power(x: np.ndarray, power: int, prime: int) -> np.ndarray:
    power %= prime - 1
    out = np.ones_like(x)
    while power:
        if power & 1:
            out = out * x % prime
        x, power = x * x % prime, power >> 1
    return out


def objects(values: Any) -> np.ndarray:
    out = np.empty(len(values), object)
    out[:] = list(values)
    return out


def gradient(function, place: int, arguments: list) -> np.ndarray:
    """∂function/∂arguments[place], an array of Series."""
    zero = arguments[place][0].of(0)
    out = []
    for i in range(len(arguments[place])):
        dual = list(arguments)
        slopes = [zero.of(float(i == j)) for j in range(len(arguments[place]))]
        dual[place] = objects([Dual(x, s) for x, s in zip(arguments[place], slopes, strict=True)])
        value = function(*dual)
        out.append(value.slope if isinstance(value, Dual) else zero)
    return objects(out)


def step(system: dvi.System, h: Any, epsilon: Series, q: Any, p: Any, t: Series) -> tuple:
    """The map (q, p, t) → (q1, p1, t1) of type II, from its generating function."""
    t1 = t + (epsilon * h if system.slow_time else epsilon.of(h))

    def energy(q, p):
        H = system.H_D(t, t1, q, p, None)
        if system.perturbation is not None:
            H = H + system.perturbation(t, t1, q, p, None) * epsilon
        return H

    before = p1 = p
    for _ in range(len(epsilon.c) + 3 if epsilon.prime else 60):
        before = p1
        p1 = p - gradient(energy, 0, [q, p1]) * h
        if system.force is not None:
            p1 = p1 + objects(list(system.force(t, t1, q, before, None))) * epsilon * h
    for a, b in zip(before, p1, strict=True):
        off = np.max(np.abs(a.c - b.c))
        if off > (0 if epsilon.prime else 1e-10):
            raise ValueError(f"p1 of the step is not found by iteration: {off:.1e}")
    return q + gradient(energy, 1, [q, p1]) * h, p1, t1


def functions_of(basis: Any, n: int) -> list:
    """The functions (q, p, t) of a basis, for q and p of n components."""
    names = coordinate_names((n,))
    match basis:
        case Sum():
            return functions_of(basis.first, n) + functions_of(basis.second, n)
        case Product():
            first, second = functions_of(basis.first, n), functions_of(basis.second, n)
            return [lambda *z, f=f, g=g: f(*z) * g(*z) for f in first for g in second]
        case dvi.Polynomials():
            chosen = [_component(name, names) for name in basis.variables or names]
            powers = range(0 if basis.constant else 1, basis.degree + 1)
            every = [c for d in powers for c in combinations_with_replacement(chosen, d)]
            return [lambda q, p, t, c=c: _product(t, [x(q, p, t) for x in c]) for c in every]
        case dvi.Trigonometric():
            x, rate = _component(basis.variable, names), 2 * np.pi / basis.period
            waves = [
                lambda q, p, t, f=f, k=k: f(x(q, p, t) * (rate * k))
                for k in range(1, basis.count + 1)
                for f in (cos, sin)
            ]
            return [lambda q, p, t: t.of(1)] * basis.constant + waves
        case dvi.Radial():
            return [lambda q, p, t, k=k: (q @ q) ** (k / 2) for k in basis.powers]
        case dvi.Basis():
            return [_of_time(f) for f in basis.functions]
    raise TypeError(f"no functions of {basis!r}")


def _component(name: str, names: tuple[str, ...]):
    if name in ("t", "τ"):
        return lambda q, p, t: t
    i, n = names.index(name), len(names) // 2
    return (lambda q, p, t: q[i]) if i < n else (lambda q, p, t: p[i - n])


def _product(t, factors):
    out = t.of(1)
    for factor in factors:
        out = out * factor
    return out


def _of_time(function):
    return function if function.__code__.co_argcount == 3 else lambda q, p, t: function(q, p)


def toeplitz(terms: np.ndarray, z: int) -> np.ndarray:
    """[A_0; A_1 A_0; …] up to A_z, from terms of shape (z + 1, rows, columns)."""
    _, rows, columns = terms.shape
    blocks = np.zeros((z + 1, rows, z + 1, columns), terms.dtype)
    for k in range(z + 1):
        for m in range(k + 1):
            blocks[k, :, m] = terms[k - m]
    return blocks.reshape((z + 1) * rows, (z + 1) * columns)


def _start(samples, modular, points, powers):
    """q, p and t as series with so many powers of ε, at the samples or, modulo a prime, anywhere;
    and a function that makes a series with one coefficient."""
    rng, zero = np.random.default_rng(0), np.zeros((powers, points), np.int64 if modular else float)
    qs, ps = (np.reshape(x, (len(x), -1)) for x in samples[:2])
    ts = samples[2] if len(samples) == 3 else np.zeros(len(qs))

    def number(values, power=0):
        c = zero.copy()
        c[power] = values
        return Series(c, PRIME if modular else None)

    def start(values):
        return number(rng.integers(1, PRIME, points) if modular else values[:points])

    q, p = (objects([start(x) for x in values.T]) for values in (qs, ps))
    return q, p, start(ts), number


def rref(matrix: np.ndarray, prime: int) -> tuple[np.ndarray, list[int]]:
    """The reduced echelon form and its pivots, modulo a prime."""
    matrix, pivots = matrix.copy() % prime, []
    for j in range(matrix.shape[1]):
        row = len(pivots)
        below = np.flatnonzero(matrix[row:, j]) if row < len(matrix) else []
        if len(below) == 0:
            continue
        matrix[[row, row + below[0]]] = matrix[[row + below[0], row]]
        matrix[row] = matrix[row] * pow(int(matrix[row, j]), -1, prime) % prime
        factors = matrix[:, j].copy()
        factors[row] = 0
        some = np.flatnonzero(factors)
        matrix[some] = (matrix[some] - factors[some, None] * matrix[row] % prime) % prime
        pivots.append(j)
    return matrix[: len(pivots)], pivots


def null_columns(matrix: np.ndarray, prime: int | None) -> np.ndarray:
    """The null space, as columns."""
    size = matrix.shape[1]
    if prime is None:
        scale = np.linalg.norm(matrix, axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        singular, V = np.linalg.svd(matrix / scale)[1:]
        rank = int(np.sum(singular > FLOAT_RANK * max(singular[0], 1e-300)))
        return np.linalg.qr(V[rank:].T / scale[:, None])[0]
    reduced, pivots = rref(matrix, prime)
    free = [j for j in range(size) if j not in set(pivots)]
    out = np.zeros((size, len(free)), np.int64)
    for k, j in enumerate(free):
        out[j, k] = 1
        out[pivots, k] = -reduced[:, j] % prime
    return out


def rank_of(columns: np.ndarray, prime: int | None) -> int:
    """The rank; in double precision that of columns whose length is about one."""
    if columns.size == 0:
        return 0
    if prime is None:
        singular = np.linalg.svd(columns, compute_uv=False)
        return int(np.sum(singular > 1e-7))
    return len(rref(columns, prime)[1])


class Count:
    """The leading-order terms of invariants of order 0 … z in a basis.

    - `survivors`: how many of each order, without constants.
    - `reaches(function)`: the highest order of an invariant with this leading-order term; −1 for a
      function that is not conserved at order 0, or not in the basis.
    """

    def __init__(self, system, basis, order, h, samples, modular=True):
        """`samples`: points (qs, ps) or (qs, ps, ts), of which only the shape is used in exact
        arithmetic."""
        n = int(np.prod(np.shape(samples[0])[1:]))
        functions = functions_of(basis, n)
        size, self.prime = len(functions), PRIME if modular else None
        points = 2 * size + 10 if modular else len(samples[0])
        q, p, t, number = _start(samples, modular, points, order + 1)
        there = step(system, h, number(1, 1) if order else number(0), q, p, t)
        before = np.stack([f(q, p, t).c for f in functions], axis=-1)
        after = np.stack([f(*there).c for f in functions], axis=-1)
        self.values, terms = before[0], after - before
        if modular:
            terms %= PRIME
        self.point = q, p, t
        ones = null_columns(np.column_stack([self.values, np.ones_like(t.c[0])]), self.prime)
        constants = ones[:size]
        self.spaces = [
            np.column_stack([null_columns(toeplitz(terms, z), self.prime)[:size], constants])
            for z in range(order + 1)
        ]
        self.survivors = tuple(
            rank_of(x, self.prime) - rank_of(constants, self.prime) for x in self.spaces
        )

    def reaches(self, function) -> int:
        values = function(*self.point).c[0]
        if self.prime is None:
            values = values / np.linalg.norm(values)
        matrix = np.column_stack([self.values, np.ones_like(values), values])
        c = null_columns(matrix, self.prime)
        c = c[:, np.flatnonzero(np.abs(c[-1]) > 1e-9)[:1]]
        if c.shape[1] == 0:
            return -1
        last = -1
        for z, space in enumerate(self.spaces):
            c_0 = c[:-2] if self.prime else c[:-2] / np.linalg.norm(c[:-2])
            both = np.column_stack([space, c_0])
            if rank_of(both, self.prime) > rank_of(space, self.prime):
                break
            last = z
        return last


class Symmetries:
    """The symmetries of order 0 … z in a basis, from X(Φ(z)) = DΦ X(z).

    With ξ0, times move too: DΦ has the derivatives by t and by h, which changes by the difference
    of ξ0. With K = z + 1, ε is η and a nilpotent δ is η^K, in series cut off after η^{2K − 1}.

    - `survivors`: how many leading-order terms, for order 0 … z. `hamiltonian`: of the last
      order, how many can have ξ0 = 0 and Hamiltonian vector fields at all orders.
    - `independent`, `independent_hamiltonian`: the rank of them as vectors at both points of a
      step, at generic points: how many do not depend on one another with invariants for
      coefficients.
    """

    def __init__(self, system, basis, order, h, samples, time, modular=True):
        shape = np.shape(samples[0])[1:]
        n, K = int(np.prod(shape)), order + 1
        functions = functions_of(basis, n)
        self.prime, size = PRIME if modular else None, len(functions)
        points = min(len(samples[0]), 2 * (2 * n + 1) * size // n + 10)
        q, p, t, number = _start(samples, modular, points, 2 * K)
        epsilon, delta = number(1.0, 1) if order else number(0.0), number(1.0, K)
        flat = [*q, *p, t, number(0.0).of(h)]
        shaped = _shaped(system, shape)

        def moved(j):
            z = list(flat)
            if j is not None:
                z[j] = z[j] + delta
            q, p, t1 = step(shaped, z[-1], epsilon, objects(z[:n]), objects(z[n:-2]), z[-2])
            return q, p, t1

        there = moved(None)
        jacobian = []
        for at in map(moved, range(2 * n + 2)):
            pairs = zip((*at[0], *at[1]), (*there[0], *there[1]), strict=True)
            slopes = [(x - y).c[K:] for x, y in pairs]  # without ε^K and higher powers
            jacobian.append([Series(np.concatenate([c, 0 * c]), self.prime) for c in slopes])
        before = [f(q, p, t) for f in functions]
        after = [f(*there) for f in functions]
        components = range(0 if time else 1, 2 * n + 1)
        rows = []  # (component, function): a list of 2n Series
        for j in components:
            for here, later in zip(before, after, strict=True):
                row = [x * here for x in jacobian[j - 1 if j else 2 * n]]
                if j:
                    row[j - 1] = row[j - 1] - later
                else:
                    row = [x + y * (later - here) for x, y in zip(row, jacobian[-1], strict=True)]
                rows.append(row)
        terms = np.array([[x.c[:K] for x in row] for row in rows])  # (unknown, 2n, K, points)
        terms = terms.transpose(2, 1, 3, 0).reshape(K, -1, len(rows))
        slopes = [[f(*_at(flat, j, delta, n)).c[K] for f in functions] for j in range(2 * n)]
        curl = self._curl(np.array(slopes), list(components), n, size)
        self.survivors, self.hamiltonian = (), 0
        for z in range(K):
            matrix = toeplitz(terms, z)
            null = null_columns(matrix, self.prime)[: len(rows)]
            self.survivors += (rank_of(null, self.prime),)
            if z == order:
                curls = np.kron(np.eye(z + 1, dtype=curl.dtype), curl)
                both = null_columns(np.vstack([matrix, curls]), self.prime)[: len(rows)]
                self.hamiltonian = rank_of(both, self.prime)
                self.null, self.values = null, np.array([x.c[0] for x in before])
                here, later = (np.array([x.c[0] for x in v]) for v in (before, after))
                self.independent, self.independent_hamiltonian = (
                    rank_of(self._at_pair(x, here, later), self.prime) for x in (null, both)
                )

    def _curl(self, slopes, components, n, size):
        """Rows that vanish for a Hamiltonian vector field: ∂(η, −ξ) is symmetric, and ξ0 = 0."""
        points, rows = slopes.shape[2], []
        place = {j: k for k, j in enumerate(components)}
        ones = np.ones((2 * n,), slopes.dtype)
        for a in range(2 * n):
            for b in range(a):
                row = np.zeros((points, len(components), size), slopes.dtype)
                for sign, i, j in ((1, a, b), (-1, b, a)):  # ∂_i of the form's component j
                    other, s = (j + n, 1) if j < n else (j - n, -1)
                    row[:, place[other + 1]] += sign * s * ones[0] * slopes[i].T
                rows.append(row.reshape(points, -1))
        if 0 in place:
            row = np.zeros((size, len(components), size), slopes.dtype)
            row[np.arange(size), 0, np.arange(size)] = 1
            rows.append(row.reshape(size, -1))
        out = np.concatenate(rows)
        return out % self.prime if self.prime else out

    def _at_pair(self, null, here, later):
        """Vectors at both ends of one step, as columns."""
        blocks = null.reshape(len(null) // len(here), len(here), null.shape[1])
        point = 3
        out = []
        for values in (here, later):
            row = np.zeros((blocks.shape[0], null.shape[1]), null.dtype)
            for b in range(len(here)):
                product = blocks[:, b] * values[b, point]
                row = row + (product % self.prime if self.prime else product)
            out.append(row)
        columns = np.concatenate(out)
        if self.prime:
            return columns % self.prime
        lengths = np.linalg.norm(columns, axis=0)
        return columns / np.where(lengths > 0, lengths, 1.0)

    def holds(self, vectors) -> bool:
        """Whether a generator is a leading-order term; its components at the points, (components,
        points), in double precision."""
        shares = np.linalg.lstsq(self.values.T, vectors.T, rcond=None)[0]
        left = self.values.T @ shares - vectors.T
        if np.max(np.abs(left)) > 1e-8 * np.max(np.abs(vectors)):
            return False
        c = shares.T.ravel()[:, None] / np.linalg.norm(shares)
        return rank_of(np.column_stack([self.null, c]), None) == rank_of(self.null, None)


def _at(flat, j, delta, n):
    z = list(flat)
    z[j] = z[j] + delta
    return objects(z[:n]), objects(z[n : 2 * n]), z[-2]


def _shaped(system: dvi.System, shape: tuple[int, ...]) -> dvi.System:
    """The same for states as vectors."""

    def of(function: Any) -> Any:
        return lambda t0, t1, q, p, a: function(t0, t1, q.reshape(shape), p.reshape(shape), a)

    def force(*arguments):
        return objects(list(of(system.force)(*arguments).ravel()))

    return dvi.System(
        of(system.H_D),
        None if system.force is None else force,
        None if system.perturbation is None else of(system.perturbation),
    )
