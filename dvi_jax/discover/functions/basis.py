"""Bases of functions of a lattice point, in which symmetries and invariants are sought."""

import abc
import dataclasses
import inspect
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.checks import array, function, instance
from ...base.signature import output_of
from ...base.types import Scalar, State

Function = Callable[..., Any]
_KINDS = "a basis such as dvi.Polynomials(4), dvi.Basis([f, g]), or a sum or product of them"


class AbstractBasis(eqx.Module):
    """A family of functions of (q, p, t); `for_shape` fixes it for states of one shape.

    t is the time, or the slow time τ = εt of a system with ``slow_time=True``.

    Bases add (both families) and multiply (every product of two members).
    """

    @abc.abstractmethod
    def for_shape(self, shape: tuple[int, ...]) -> "BoundBasis":
        """The functions for states of this shape, with names and complexities."""

    def __add__(self, other: "AbstractBasis") -> "AbstractBasis":
        return Sum(
            self, instance("the second part of a sum of bases", other, AbstractBasis, _KINDS)
        )

    def __mul__(self, other: "AbstractBasis") -> "AbstractBasis":
        return Product(
            self, instance("the second part of a product of bases", other, AbstractBasis, _KINDS)
        )


def bind_basis(basis: Any, shape: tuple[int, ...]) -> "BoundBasis":
    """`basis.for_shape(shape)`, or a `TypeError` for any other object."""
    instance("basis", basis, AbstractBasis, _KINDS)
    return dataclasses.replace(basis.for_shape(shape), shape=shape)


def check_step_size(h: Any) -> float:
    """h as a number other than zero: with h = 0 every function would be conserved."""
    try:
        number = np.nan if isinstance(h, str | bool) else float(h)
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number) or number == 0:
        raise ValueError(f"h must be one finite step size other than zero, got {h!r:.200}.")
    return number


class BoundBasis(eqx.Module):
    """A basis fixed for states of one shape.

    - `names`: one text for each function; `complexity`: how simple it is (polynomials: the
      degree), by which discovery prefers one representative to another.
    - `uses_time`: whether any of them depends on t.
    - `shape`: of the states, None where it is not checked.
    - ``basis(q, p, t)``: values, shape (size,).
    """

    function: Callable[[State, State, Scalar], Array]
    names: tuple[str, ...] = eqx.field(static=True)
    complexity: tuple[int, ...] = eqx.field(static=True)
    uses_time: bool = eqx.field(static=True, default=False)
    shape: tuple[int, ...] | None = eqx.field(static=True, default=None)

    @property
    def size(self) -> int:
        """Number of functions."""
        return len(self.names)

    def __call__(self, q: State, p: State, t: Any = 0.0) -> Float[Array, " size"]:
        q, p = jnp.asarray(q), jnp.asarray(p)
        if self.shape is not None and not q.shape == p.shape == self.shape:
            raise ValueError(
                f"q and p must have the shape {self.shape} of one state, got q of shape {q.shape} "
                f"and p of shape {p.shape}: for many states use jax.vmap."
            )
        return self.function(q, p, jnp.asarray(t, float))

    def without_names(self) -> "BoundBasis":
        """The same functions without names. Names contain the centre of the samples; without them,
        programs that were compiled for one set of samples are used for another."""

        def is_basis(part):
            return isinstance(part, BoundBasis)

        function = jax.tree.map(
            lambda x: x.without_names() if is_basis(x) else x, self.function, is_leaf=is_basis
        )
        return dataclasses.replace(self, function=function, names=("",) * self.size)

    def select(self, places: np.ndarray) -> "BoundBasis":
        """Some of the functions, by their numbers."""
        names, complexity = (tuple(x[j] for j in places) for x in (self.names, self.complexity))
        function = _Selection(self, tuple(places.tolist()))
        return dataclasses.replace(self, function=function, names=names, complexity=complexity)

    def formula(self, coefficients: Any, digits: Any = 6, drop: float = 1e-9) -> str:
        """The combination with these coefficients as text; tiny ones (relative) are left out."""
        c = np.asarray(coefficients, float)
        is_large = np.abs(c) > drop * np.max(np.abs(c), initial=0.0)
        return linear_text(np.where(is_large, c, 0), self.names, digits)

    def recentre(self, middle: np.ndarray, exactly=False) -> "tuple[BoundBasis, np.ndarray]":
        """Functions ψ of z − middle that span the same space, and N with ψ = N φ + constants.

        - `middle`: of z = (q, p, t), shape (2n + 1,). Polynomials are taken about it, other
          functions stay as they are.
        - `exactly`: only if no constants are left over.
        """
        shift = self.recentring(middle, exactly)
        return dataclasses.replace(self, function=shift.function, names=shift.names), shift.matrix

    def recentring(self, middle: np.ndarray, exactly: bool) -> "Recentring":
        """The same as `Recentring`: the identity where all functions stay as they are."""
        shift = getattr(self.function, "recentring", lambda _: None)(middle)
        if shift is None or (exactly and not shift.is_closed):
            return Recentring(self.function, self.names, np.eye(self.size), True)
        return shift


class _Selection(eqx.Module):
    basis: BoundBasis
    places: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, q, p, t):
        return self.basis(q, p, t)[np.array(self.places, int)]


def linear_text(coefficients: np.ndarray, names: Sequence[str], digits: Any = 6) -> str:
    """A linear combination as text, without zeros; `digits`: of all coefficients, or of each."""
    text, digits = "", np.broadcast_to(digits, len(names))
    for value, name, precision in zip(coefficients, names, digits, strict=True):
        if value == 0:
            continue
        size = f"{abs(value):.{precision}g}"
        term = size if name == "1" else name if size == "1" else f"{size} {name}"
        sign = "−" if value < 0 else "+"
        text += f" {sign} {term}" if text else term if value > 0 else f"−{term}"
    return text or "0"


class Recentring(NamedTuple):
    """Functions ψ of z − middle; N with ψ = N φ + constants; whether no constants are left."""

    function: Callable[[State, State, Scalar], Array]
    names: tuple[str, ...]
    matrix: np.ndarray
    is_closed: bool


class Basis(AbstractBasis):
    """A basis of user-defined functions.

    - `functions`: a list of functions ``(q, p)`` or ``(q, p, t)`` → scalar, or a dict with their
      names as keys.
    - `complexity`: of each of them, see `BoundBasis`; default 1.

    **Raises** `ValueError` for an empty list, `TypeError` for what is not callable or takes other
    arguments.
    """

    functions: tuple[Callable[..., Any], ...]
    names: tuple[str, ...] = eqx.field(static=True)
    complexity: int = eqx.field(static=True)

    def __init__(self, functions: Sequence[Function] | dict[str, Function], complexity: int = 1):
        members: dict[str, Function] = {}
        if isinstance(functions, dict):
            members |= functions
        else:
            members |= {_name(member, i): member for i, member in enumerate(tuple(functions))}
        if not members:
            raise ValueError("functions must have at least one function (q, p) → scalar.")
        for name, member in members.items():
            function(f"basis function {name!r}", member, "(q, p) or (q, p, t)")
            if not (_takes(member, 2) or _takes(member, 3)):
                signature = inspect.signature(member)
                raise TypeError(
                    f"the basis function {name!r} must take (q, p) or (q, p, t), got {signature}."
                )
        self.functions, self.names = tuple(members.values()), tuple(members)
        self.complexity = complexity

    def for_shape(self, shape):
        takes_time = tuple(not _takes(f, 2) for f in self.functions)
        for name, member, with_time in zip(self.names, self.functions, takes_time, strict=True):
            _require_real_scalar(name, member, with_time, shape)
        values, complexity = (
            _Values(self.functions, takes_time),
            (self.complexity,) * len(self.names),
        )
        return BoundBasis(values, self.names, complexity, any(takes_time))


def _takes(function: Callable[..., Any], count: int) -> bool:
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:  # a builtin without a signature
        return count == 2
    return True


def _require_real_scalar(name, function, with_time: bool, shape) -> None:
    """Reject a function whose value is not a real scalar, by tracing it once."""
    state, time = (jax.ShapeDtypeStruct(s, jnp.result_type(float)) for s in (shape, ()))
    subject, hint = f"the basis function {name!r}", "It must be a real scalar, as jnp.sum(q**2)."
    out = output_of(subject, function, state, state, *[time] * with_time, hint=hint)
    array(subject, out, (), verb="return", integers=True, hint=hint)


class _Values(eqx.Module):
    functions: tuple[Callable[..., Any], ...]
    takes_time: tuple[bool, ...] = eqx.field(static=True)

    def __call__(self, q, p, t):
        pairs = zip(self.functions, self.takes_time, strict=True)
        values = [call(q, p, t) if timely else call(q, p) for call, timely in pairs]
        return jnp.stack([jnp.asarray(value, float) for value in values])


def _name(function: Any, i: int) -> str:
    name = getattr(function, "__name__", "")
    return f"f{i + 1}" if name in ("", "<lambda>") else name


class Sum(AbstractBasis):
    """The functions of both bases."""

    first: AbstractBasis
    second: AbstractBasis

    def for_shape(self, shape):
        return _pair(self, shape, is_product=False)


class Product(AbstractBasis):
    """Every product of a function of one basis and a function of the other."""

    first: AbstractBasis
    second: AbstractBasis

    def for_shape(self, shape):
        return _pair(self, shape, is_product=True)


def _pair(basis: Sum | Product, shape: tuple[int, ...], is_product: bool) -> BoundBasis:
    a, b = basis.first.for_shape(shape), basis.second.for_shape(shape)
    complexity = a.complexity + b.complexity
    if is_product:
        complexity = tuple(c + d for c, d in itertools.product(a.complexity, b.complexity))
    names = _names_of_pair(a.names, b.names, is_product)
    return BoundBasis(_Combination(a, b, is_product), names, complexity, a.uses_time or b.uses_time)


class _Combination(eqx.Module):
    first: BoundBasis
    second: BoundBasis
    is_product: bool = eqx.field(static=True)

    def __call__(self, q, p, t):
        a, b = self.first(q, p, t), self.second(q, p, t)
        return jnp.outer(a, b).ravel() if self.is_product else jnp.concatenate([a, b])

    def recentring(self, middle: np.ndarray) -> Recentring:
        parts = self.first, self.second
        # A constant that remains of one part would be multiplied by functions of the other.
        a, b = (part.recentring(middle, exactly=self.is_product) for part in parts)
        first, second = (
            dataclasses.replace(part, function=shift.function, names=shift.names)
            for part, shift in zip(parts, (a, b), strict=True)
        )
        matrix = np.kron(a.matrix, b.matrix)
        if not self.is_product:
            zeros = np.zeros((first.size, second.size))
            matrix = np.block([[a.matrix, zeros], [zeros.T, b.matrix]])
        names = _names_of_pair(a.names, b.names, self.is_product)
        function = _Combination(first, second, self.is_product)
        return Recentring(function, names, matrix, a.is_closed and b.is_closed)


def _names_of_pair(a: tuple[str, ...], b: tuple[str, ...], is_product: bool) -> tuple[str, ...]:
    if not is_product:
        return a + tuple(name + "′" if name in a else name for name in b)
    words = ([w for w in pair if w != "1"] for pair in itertools.product(a, b))
    return tuple(" ".join(pair) or "1" for pair in words)
