"""Families of basis functions: polynomials, Chebyshev, trigonometric, powers of the radius."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ...base.checks import positive, whole
from .basis import AbstractBasis, BoundBasis, Recentring

TIME = ("t", "τ")  # Names of the time, which is the slow time of a system with ``slow_time=True``
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def coordinate_names(shape: tuple[int, ...]) -> tuple[str, ...]:
    """Names of the components of q, then of p: "q", "p", or "q1", "q2", …, counted from 1."""
    size = int(np.prod(shape, dtype=int))
    if size == 1:
        return ("q", "p")
    return tuple(f"{v}{i + 1}" for v in "qp" for i in range(size))


def _places(variables: Sequence[str], shape: tuple[int, ...]) -> tuple[int, ...]:
    """Places of the named variables in (q, p, t) flattened."""
    names = coordinate_names(shape)
    strangers = [v for v in variables if v not in names + TIME]
    if strangers:
        n = len(names) // 2
        choices = ", ".join(names) if n < 4 else f"q1 to q{n}, p1 to p{n}"
        raise ValueError(
            f"the basis has the variable {strangers[0]!r}, but for states of shape {shape} these "
            f"are {choices}, and t for the time."
        )
    return tuple(len(names) if v in TIME else names.index(v) for v in variables)


def _components(places: tuple[int, ...], q: Any, p: Any, t: Any) -> Any:
    return jnp.concatenate([jnp.ravel(q), jnp.ravel(p), jnp.ravel(t)])[np.array(places)]


class _ComponentFunctions(eqx.Module):
    """The functions of a family at some components of (q, p, t)."""

    family: Any
    places: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, q, p, t):
        return self.family.values(_components(self.places, q, p, t))


def _bound(family: Any, variables: Sequence[str], shape, names, complexity) -> BoundBasis:
    """A family of functions of these variables, for states of this shape."""
    function = _ComponentFunctions(family, _places(variables, shape))
    uses_time = any(name in TIME for name in variables)
    return BoundBasis(function, tuple(names), tuple(complexity), uses_time)


def _names(values: Any) -> tuple[str, ...] | None:
    if values is None:
        return None
    return (values,) if isinstance(values, str) else tuple(values)


def power_text(name: str, k: int) -> str:
    """The k-th power of a name, k ≥ 1."""
    return name if k == 1 else name + str(k).translate(_SUPERSCRIPTS)


_MOST_MONOMIALS = 10_000  # Of a basis: singular values are of dense matrices of this width


class Polynomials(AbstractBasis):
    """All monomials in the components of q and p of degree 1 to `degree`.

    - `degree`: the largest total degree.
    - `variables`: which to use, by name ("q", "p", or "q1", "p2", … counted from 1 in the order
      of the flattened array; "t" or "τ" for the time); None for all components of q and p.
    - `constant`: whether 1 is among them (for generators, and for products with other bases).

    **Raises** `ValueError` for a degree that is not a positive integer, names that the state does
    not have, or more than 10 000 monomials (the null space would be too expensive).
    """

    degree: int = eqx.field(static=True)
    variables: tuple[str, ...] | None = eqx.field(static=True, default=None, converter=_names)
    constant: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        whole("degree", self.degree)

    def for_shape(self, shape):
        variables = coordinate_names(shape) if self.variables is None else self.variables
        places = _places(variables, shape)
        size = math.comb(len(variables) + self.degree, self.degree)
        if size > _MOST_MONOMIALS:
            raise ValueError(
                f"Polynomials({self.degree}) of {len(variables)} variables has {size:.6g} "
                f"monomials, but at most {_MOST_MONOMIALS} are allowed: use a lower degree, or "
                "fewer variables."
            )
        exponents = [
            tuple(sorted(c))
            for d in range(0 if self.constant else 1, self.degree + 1)
            for c in itertools.combinations_with_replacement(range(len(variables)), d)
        ]
        names = tuple(_monomial([variables[i] for i in c]) for c in exponents)
        function = _Monomials(places, tuple(exponents), variables)
        uses_time = any(v in TIME for v in variables)
        return BoundBasis(function, names, tuple(map(len, exponents)), uses_time)


def _monomial(factors: Sequence[str]) -> str:
    powers = [(name, factors.count(name)) for name in dict.fromkeys(factors)]
    return " ".join(power_text(name, k) for name, k in powers) or "1"


class _Monomials(eqx.Module):
    places: tuple[int, ...] = eqx.field(static=True)
    exponents: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    variables: tuple[str, ...] = eqx.field(static=True)
    middle: Any = None

    @property
    def counts(self) -> np.ndarray:
        """The power of each variable in each monomial."""
        return np.array([[c.count(i) for i in range(len(self.places))] for c in self.exponents])

    def __call__(self, q, p, t):
        flat = _components(self.places, q, p, t)
        if self.middle is not None:
            flat = flat - self.middle
        counts, powers = self.counts, [jnp.ones_like(flat)]
        for _ in range(int(counts.max())):
            powers.append(powers[-1] * flat)
        table = jnp.stack(powers)  # (power, variable)
        return jnp.prod(table[counts, np.arange(len(self.places))], axis=-1)

    def recentring(self, middle: np.ndarray) -> Recentring | None:
        """Π (x_i − m_i)^{k_i} = Π Σ_j binomial(k_i, j) (−m_i)^{k_i − j} x_i^j: all of them are
        combinations of those of lower degree, which this basis has, up to the constant."""
        shift = middle[list(self.places)]
        if not shift.any():
            return None
        place = {c: i for i, c in enumerate(self.exponents)}
        matrix = np.zeros((len(place), len(place)))
        for row, counts in enumerate(self.counts.tolist()):
            lower = (range(k + 1) if m else (k,) for k, m in zip(counts, shift, strict=True))
            for powers in itertools.product(*lower):
                column = place.get(tuple(i for i, j in enumerate(powers) for _ in range(j)))
                if column is not None:
                    terms = zip(counts, powers, shift, strict=True)
                    factors = (math.comb(k, j) * (-m) ** (k - j) for k, j, m in terms)
                    matrix[row, column] = math.prod(factors)
        words = [_distance(v, m) for v, m in zip(self.variables, shift, strict=True)]
        names = tuple(_monomial([words[i] for i in c]) for c in self.exponents)
        function = _Monomials(self.places, self.exponents, self.variables, shift)
        return Recentring(function, names, matrix, () in place)


def _distance(variable: str, middle: float) -> str:
    """The name of a variable less the middle, such as "(q − 3)"."""
    if middle == 0:
        return variable
    sign = "−" if middle > 0 else "+"
    return f"({variable} {sign} {np.format_float_positional(abs(middle), trim='-')})"


def _pair(ends: Any) -> Any:
    """A list as a tuple, which can be hashed."""
    return tuple(ends) if isinstance(ends, list) else ends


class Chebyshev(AbstractBasis):
    r"""Chebyshev polynomials T_0 … T_{count−1} of one variable, scaled from `domain` to [−1, 1].

        T_k(cos θ) = cos kθ,    cos θ = (2x − a − b)/(b − a)

    - `count`: how many, T_0 = 1 included. `variable`: a name as in `Polynomials`.
    - `domain`: (a, b), where the samples lie.

    **Raises** `ValueError` for a count that is not a positive integer or an empty domain.
    """

    count: int = eqx.field(static=True)
    variable: str = eqx.field(static=True)
    domain: tuple[float, float] = eqx.field(static=True, converter=_pair, default=(-1.0, 1.0))

    def __check_init__(self):
        whole("count", self.count)
        ends = np.asarray(self.domain, float)
        if ends.shape != (2,) or not np.isfinite(ends).all() or not ends[0] < ends[1]:
            raise ValueError(
                f"domain must be two finite numbers (a, b) with a < b, got {self.domain!r}."
            )

    def for_shape(self, shape):
        names = ("1", *(f"T{k}({self.variable})" for k in range(1, self.count)))
        return _bound(self, [self.variable], shape, names, range(self.count))

    def values(self, x):
        """T_0 … T_{count−1}, by their recursion."""
        a, b = self.domain
        x = (2 * x[0] - a - b) / (b - a)
        values = [jnp.ones_like(x), x]
        for _ in range(self.count - 2):
            values.append(2 * x * values[-1] - values[-2])
        return jnp.stack(values[: self.count])


class Trigonometric(AbstractBasis):
    r"""cos kωx and sin kωx of one variable x, k = 1 … `count`, with ω = 2π/period.

    - `variable`: a name as in `Polynomials`. `period`: default 2π.
    - `constant`: whether 1 is among them (for products with other bases).

    **Raises** `ValueError` for a count that is not a positive integer or a period that is not
    positive.
    """

    count: int = eqx.field(static=True)
    variable: str = eqx.field(static=True)
    period: float = eqx.field(static=True, default=2 * np.pi)
    constant: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        whole("count", self.count)
        positive("period", self.period)

    def for_shape(self, shape):
        omega = 2 * np.pi / self.period
        multiples = [f"{omega * k:.6g}" for k in range(1, self.count + 1)]
        angles = [f"{'' if m == '1' else m}{self.variable}" for m in multiples]
        names = [f"{f} {angle}" for angle in angles for f in ("cos", "sin")]
        complexity = [k for k in range(1, self.count + 1) for _ in range(2)]
        if self.constant:
            names, complexity = ["1", *names], [0, *complexity]
        return _bound(self, [self.variable], shape, names, complexity)

    def values(self, x):
        """1 if it is among them, then cos and sin of each multiple."""
        x = 2 * np.pi / self.period * jnp.arange(1, self.count + 1) * x[0]
        waves = jnp.stack([jnp.cos(x), jnp.sin(x)], axis=1).ravel()
        return jnp.append(1.0, waves) if self.constant else waves


def _of_radius(k: int) -> str:
    if k == 0:
        return "1"
    return power_text("r", k) if k > 0 else f"1/{power_text('r', -k)}"


class Radial(AbstractBasis):
    r"""Powers r^k of the radius r = √(q·q), of all components of q, or of chosen ones.

    - `powers`: integers k, default (−1,): 1/r. 0 stands for the constant 1.
    - `variables`: names of the components that r is made of; None for all of q.

    **Raises** `ValueError` for powers that are not integers. At r = 0 negative powers are
    infinite: keep samples off it.
    """

    powers: tuple[int, ...] = eqx.field(static=True, converter=tuple, default=(-1,))
    variables: tuple[str, ...] | None = eqx.field(static=True, default=None, converter=_names)

    def __check_init__(self):
        is_integer = all(isinstance(k, int) and not isinstance(k, bool) for k in self.powers)
        if not self.powers or not is_integer:
            raise ValueError(f"powers must be one or more integers, got {self.powers!r}.")

    def for_shape(self, shape):
        names = coordinate_names(shape)
        variables = names[: len(names) // 2] if self.variables is None else self.variables
        return _bound(self, variables, shape, map(_of_radius, self.powers), map(abs, self.powers))

    def values(self, x):
        """r^k for each power."""
        r = jnp.sqrt(jnp.sum(x**2))
        return jnp.stack([r**k for k in self.powers])
