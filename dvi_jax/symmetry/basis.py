"""Bases of functions of a lattice point, in which symmetries and invariants are looked for."""

import abc
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import State


class AbstractBasis(eqx.Module):
    """A family of functions of (q, p); `for_shape` fixes it for states of one shape.

    Bases add (both families) and multiply (every product of two members).
    """

    @abc.abstractmethod
    def for_shape(self, shape: tuple[int, ...]) -> "BoundBasis":
        """The functions for states of this shape, with names and complexities."""

    def __add__(self, other: "AbstractBasis") -> "AbstractBasis":
        return Sum(self, other) if isinstance(other, AbstractBasis) else NotImplemented

    def __mul__(self, other: "AbstractBasis") -> "AbstractBasis":
        return Product(self, other) if isinstance(other, AbstractBasis) else NotImplemented


def bind_basis(basis: Any, shape: tuple[int, ...]) -> "BoundBasis":
    """`basis.for_shape(shape)`, after refusing what is no basis with a `TypeError`."""
    if not isinstance(basis, AbstractBasis):
        raise TypeError(
            "basis must be a basis such as dvi.Polynomials(4), dvi.Basis([f, g]), or a sum or "
            f"product of them; got {basis!r}."
        )
    return basis.for_shape(shape)


def check_step_size(h: Any) -> float:
    """h as a number, after refusing zero (a step that goes nowhere keeps everything)."""
    if not np.isfinite(h) or h == 0:
        raise ValueError(f"h must be a finite step size other than zero, got {h!r}.")
    return float(h)


class BoundBasis(eqx.Module):
    """A basis fixed for states of one shape.

    - `names`: one text for each function; `complexity`: how simple it is (polynomials: the
      degree), by which discovery prefers one representative to another.
    - ``basis(q, p)``: values, shape (size,).
    """

    function: Callable[[State, State], Array]
    names: tuple[str, ...] = eqx.field(static=True)
    complexity: tuple[int, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of functions."""
        return len(self.names)

    def __call__(self, q: State, p: State) -> Float[Array, " size"]:
        return self.function(q, p)

    def formula(self, coefficients: Any, digits: int = 6, drop: float = 1e-9) -> str:
        """The combination with these coefficients as text; tiny ones (relative) are left out."""
        c = np.asarray(coefficients, float)
        largest = np.max(np.abs(c), initial=0.0)
        terms = [
            (value, name)
            for value, name in zip(c, self.names, strict=True)
            if abs(value) > drop * largest
        ]
        if not terms:
            return "0"
        text = ""
        for value, name in terms:
            sign = "−" if value < 0 else "+"
            size = f"{abs(value):.{digits}g}"
            term = name if size == "1" else f"{size} {name}"
            text += f" {sign} {term}" if text else (f"−{term}" if value < 0 else term)
        return text


def coordinate_names(shape: tuple[int, ...]) -> tuple[str, ...]:
    """Names of the components of q, then of p: "q", "p", or "q1", "q2", …, counted from 1."""
    size = int(np.prod(shape, dtype=int))
    if size == 1:
        return ("q", "p")
    return tuple(f"{v}{i + 1}" for v in "qp" for i in range(size))


_RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


class Polynomials(AbstractBasis):
    """All monomials in the components of q and p of degree 1 to `degree`.

    - `degree`: the largest total degree.
    - `variables`: which components to use, by name ("q", "p", or "q1", "p2", … counted from 1 in
      the order of the flattened array); None for all.
    - `constant`: whether 1 is among them (for products with other bases).

    **Raises** `ValueError` for a degree that is not a positive integer, or names that the state
    does not have.
    """

    degree: int = eqx.field(static=True)
    variables: tuple[str, ...] | None = eqx.field(
        static=True, default=None, converter=lambda v: None if v is None else tuple(v)
    )
    constant: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if isinstance(self.degree, bool) or not isinstance(self.degree, int) or self.degree < 1:
            raise ValueError(f"degree must be a positive integer, got {self.degree!r}.")

    def for_shape(self, shape):
        every = coordinate_names(shape)
        chosen = every if self.variables is None else self.variables
        unknown = [v for v in chosen if v not in every]
        if unknown:
            raise ValueError(f"the state has no component {unknown[0]!r}; it has {list(every)}.")
        places = tuple(every.index(v) for v in chosen)
        exponents = [
            tuple(sorted(c))
            for d in range(0 if self.constant else 1, self.degree + 1)
            for c in itertools.combinations_with_replacement(range(len(chosen)), d)
        ]
        names = tuple(_monomial([chosen[i] for i in c]) for c in exponents)
        return BoundBasis(
            _Monomials(places, tuple(exponents)), names, tuple(len(c) for c in exponents)
        )


def _monomial(factors: Sequence[str]) -> str:
    counted = [(name, factors.count(name)) for name in dict.fromkeys(factors)]
    words = [n if k == 1 else n + str(k).translate(_RAISED) for n, k in counted]
    return " ".join(words) or "1"


class _Monomials(eqx.Module):
    places: tuple[int, ...] = eqx.field(static=True)
    exponents: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def __call__(self, q, p):
        flat = jnp.concatenate([jnp.ravel(q), jnp.ravel(p)])[np.array(self.places)]
        counts = np.array([[c.count(i) for i in range(len(self.places))] for c in self.exponents])
        powers = [jnp.ones_like(flat)]
        for _ in range(int(counts.max())):
            powers.append(powers[-1] * flat)
        table = jnp.stack(powers)  # (power, variable)
        return jnp.prod(table[counts, np.arange(len(self.places))], axis=-1)


class Basis(AbstractBasis):
    """Functions of the user's.

    - `functions`: a list of functions ``(q, p)`` → scalar, or a dict with their names as keys.
    - `complexity`: the complexity that they count for (see `BoundBasis`), default 1.

    **Raises** `ValueError` when there is none, `TypeError` for what is not callable.
    """

    functions: tuple[Callable[..., Any], ...]
    names: tuple[str, ...] = eqx.field(static=True)
    complexity: int = eqx.field(static=True)

    def __init__(
        self,
        functions: Sequence[Callable[..., Any]] | dict[str, Callable[..., Any]],
        complexity: int = 1,
    ):
        if isinstance(functions, dict):
            named = dict(functions)
        else:
            named = {_name(function, i): function for i, function in enumerate(tuple(functions))}
        if not named:
            raise ValueError("a basis needs at least one function (q, p) → scalar, got none.")
        for name, function in named.items():
            if not callable(function):
                raise TypeError(f"basis function {name!r} must be callable, got {function!r}.")
        self.functions, self.names = tuple(named.values()), tuple(named)
        self.complexity = complexity

    def for_shape(self, shape):
        del shape
        return BoundBasis(_Values(self.functions), self.names, (self.complexity,) * len(self.names))


class _Values(eqx.Module):
    functions: tuple[Callable[..., Any], ...]

    def __call__(self, q, p):
        return jnp.stack([jnp.asarray(f(q, p)) for f in self.functions])


def _name(function: Any, i: int) -> str:
    name = getattr(function, "__name__", "")
    return f"f{i + 1}" if name in ("", "<lambda>") else name


class Sum(AbstractBasis):
    """The functions of both bases."""

    first: AbstractBasis
    second: AbstractBasis

    def for_shape(self, shape):
        a, b = self.first.for_shape(shape), self.second.for_shape(shape)
        return BoundBasis(_Both(a, b), a.names + b.names, a.complexity + b.complexity)


class _Both(eqx.Module):
    first: BoundBasis
    second: BoundBasis

    def __call__(self, q, p):
        return jnp.concatenate([self.first(q, p), self.second(q, p)])


class Product(AbstractBasis):
    """Every product of a function of one basis and a function of the other."""

    first: AbstractBasis
    second: AbstractBasis

    def for_shape(self, shape):
        a, b = self.first.for_shape(shape), self.second.for_shape(shape)
        names = tuple(_product_name(m, n) for m, n in itertools.product(a.names, b.names))
        pairs = itertools.product(a.complexity, b.complexity)
        return BoundBasis(_Products(a, b), names, tuple(c + d for c, d in pairs))


class _Products(eqx.Module):
    first: BoundBasis
    second: BoundBasis

    def __call__(self, q, p):
        return jnp.outer(self.first(q, p), self.second(q, p)).ravel()


def _product_name(a: str, b: str) -> str:
    if a == "1" or b == "1":
        return b if a == "1" else a
    return f"{a} {b}"
