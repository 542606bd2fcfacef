"""Bases of functions of a lattice point, in which symmetries and invariants are looked for."""

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

from .._types import Scalar, State


class AbstractBasis(eqx.Module):
    """A family of functions of (q, p, t); `for_shape` fixes it for states of one shape.

    t is the time, or the slow time τ = εt of a system with ``slow_time=True``.

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
    return dataclasses.replace(basis.for_shape(shape), shape=shape)


def check_step_size(h: Any) -> float:
    """h as a number, after refusing zero (a step that goes nowhere keeps everything)."""
    try:
        number = np.nan if isinstance(h, str | bool) else float(h)
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number) or number == 0:
        raise ValueError(f"h must be one finite step size other than zero, got {h!r}.")
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
                f"these basis functions are of states of shape {self.shape}; got q of shape "
                f"{q.shape} and p of shape {p.shape}."
            )
        return self.function(q, p, jnp.asarray(t, float))

    def unnamed(self) -> "BoundBasis":
        """The same functions without names. Names contain the centre of the samples; without them,
        programs that were compiled for one set of samples are used for another."""

        def is_basis(x):
            return isinstance(x, BoundBasis)

        def without(x):
            return x.unnamed() if is_basis(x) else x

        function = jax.tree.map(without, self.function, is_leaf=is_basis)
        return dataclasses.replace(self, function=function, names=("",) * self.size)

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
            term = size if name == "1" else name if size == "1" else f"{size} {name}"
            text += f" {sign} {term}" if text else (f"−{term}" if value < 0 else term)
        return text

    def about(self, middle: np.ndarray, exactly: bool = False) -> "tuple[BoundBasis, np.ndarray]":
        """Functions ψ of z − middle that span the same space, and N with ψ = N φ + constants.

        - `middle`: of z = (q, p, t), shape (2n + 1,). Polynomials are taken about it, other
          functions stay as they are.
        - `exactly`: only if no constants are left over.
        """
        found = _about(self.function, middle)
        if found is None or (exactly and not found.closed):
            return self, np.eye(self.size)
        return dataclasses.replace(self, function=found.function, names=found.names), found.matrix


class About(NamedTuple):
    """Functions ψ of z − middle; N with ψ = N φ + constants; whether no constants are left."""

    function: Callable[[State, State, Scalar], Array]
    names: tuple[str, ...]
    matrix: np.ndarray
    closed: bool


def _about(function: Any, middle: np.ndarray) -> About | None:
    """As `BoundBasis.about`; None where all functions stay as they are."""
    if isinstance(function, BoundBasis):
        function = function.function
    return function.about(middle) if hasattr(function, "about") else None


def _parts_about(parts: "tuple[BoundBasis, BoundBasis]", middle: np.ndarray, exactly: bool):
    """Of both parts of a sum or product; None where both stay as they are."""
    found = [_about(part, middle) for part in parts]
    found = [None if exactly and one and not one.closed else one for one in found]
    if found[0] is None and found[1] is None:
        return None
    return [
        one or About(part.function, part.names, np.eye(part.size), True)
        for one, part in zip(found, parts, strict=True)
    ]


class Basis(AbstractBasis):
    """Functions of the user's.

    - `functions`: a list of functions ``(q, p)`` or ``(q, p, t)`` → scalar, or a dict with their
      names as keys.
    - `complexity`: the complexity that they count for (see `BoundBasis`), default 1.

    **Raises** `ValueError` when there is none, `TypeError` for what is not callable or takes
    other arguments.
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
            if not (_takes(function, 2) or _takes(function, 3)):
                raise TypeError(f"basis function {name!r} must take (q, p) or (q, p, t).")
        self.functions, self.names = tuple(named.values()), tuple(named)
        self.complexity = complexity

    def for_shape(self, shape):
        timed = tuple(not _takes(f, 2) for f in self.functions)
        for name, function, with_time in zip(self.names, self.functions, timed, strict=True):
            _require_real_scalar(name, function, with_time, shape)
        complexity = (self.complexity,) * len(self.names)
        return BoundBasis(_Values(self.functions, timed), self.names, complexity, any(timed))


def _takes(function: Callable[..., Any], count: int) -> bool:
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:  # a builtin without a signature: calling it will tell
        return count == 2
    return True


def _require_real_scalar(name, function, timed: bool, shape) -> None:
    """Refuse a function whose value is no real scalar, by tracing it once."""
    state, time = (jax.ShapeDtypeStruct(s, jnp.result_type(float)) for s in (shape, ()))
    try:
        out = eqx.filter_eval_shape(function, state, state, *([time] if timed else []))
    except Exception as error:
        error.add_note(f"(in the basis function {name!r}, called with q of shape {shape})")
        raise
    kind, dtype = np.shape(out), getattr(out, "dtype", type(out))
    real = np.issubdtype(dtype, np.floating) or np.issubdtype(dtype, np.integer)
    if out is None or kind != () or not real:
        seen = "None" if out is None else f"shape {kind}, type {np.dtype(dtype).name}"
        raise ValueError(
            f"the basis function {name!r} must return a real scalar; for q of shape {shape} it "
            f"returned {seen}. Take one component, e.g. q[0]."
        )


class _Values(eqx.Module):
    functions: tuple[Callable[..., Any], ...]
    timed: tuple[bool, ...] = eqx.field(static=True)

    def __call__(self, q, p, t):
        pairs = zip(self.functions, self.timed, strict=True)
        values = [f(q, p, t) if timed else f(q, p) for f, timed in pairs]
        return jnp.stack([jnp.asarray(value, float) for value in values])


def _name(function: Any, i: int) -> str:
    name = getattr(function, "__name__", "")
    return f"f{i + 1}" if name in ("", "<lambda>") else name


class Sum(AbstractBasis):
    """The functions of both bases."""

    first: AbstractBasis
    second: AbstractBasis

    def for_shape(self, shape):
        a, b = self.first.for_shape(shape), self.second.for_shape(shape)
        return BoundBasis(
            _Both(a, b),
            _names_of_sum(a.names, b.names),
            a.complexity + b.complexity,
            a.uses_time or b.uses_time,
        )


def _names_of_sum(a: tuple[str, ...], b: tuple[str, ...]) -> tuple[str, ...]:
    return a + tuple(name + "′" if name in a else name for name in b)


def _with(basis: BoundBasis, moved: About) -> BoundBasis:
    return dataclasses.replace(basis, function=moved.function, names=moved.names)


class _Both(eqx.Module):
    first: BoundBasis
    second: BoundBasis

    def __call__(self, q, p, t):
        return jnp.concatenate([self.first(q, p, t), self.second(q, p, t)])

    def about(self, middle: np.ndarray) -> About | None:
        parts = _parts_about((self.first, self.second), middle, exactly=False)
        if parts is None:
            return None
        a, b = parts
        matrix = np.zeros((self.first.size + self.second.size,) * 2)
        matrix[: self.first.size, : self.first.size] = a.matrix
        matrix[self.first.size :, self.first.size :] = b.matrix
        moved = _Both(_with(self.first, a), _with(self.second, b))
        return About(moved, _names_of_sum(a.names, b.names), matrix, a.closed and b.closed)


class Product(AbstractBasis):
    """Every product of a function of one basis and a function of the other."""

    first: AbstractBasis
    second: AbstractBasis

    def for_shape(self, shape):
        a, b = self.first.for_shape(shape), self.second.for_shape(shape)
        names = _names_of_product(a.names, b.names)
        pairs = itertools.product(a.complexity, b.complexity)
        complexity = tuple(c + d for c, d in pairs)
        return BoundBasis(_Products(a, b), names, complexity, a.uses_time or b.uses_time)


class _Products(eqx.Module):
    first: BoundBasis
    second: BoundBasis

    def __call__(self, q, p, t):
        return jnp.outer(self.first(q, p, t), self.second(q, p, t)).ravel()

    def about(self, middle: np.ndarray) -> About | None:
        # A constant that is left over would be multiplied by functions.
        parts = _parts_about((self.first, self.second), middle, exactly=True)
        if parts is None:
            return None
        a, b = parts
        moved = _Products(_with(self.first, a), _with(self.second, b))
        return About(moved, _names_of_product(a.names, b.names), np.kron(a.matrix, b.matrix), True)


def _names_of_product(a: tuple[str, ...], b: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(_product_name(m, n) for m, n in itertools.product(a, b))


def _product_name(a: str, b: str) -> str:
    if a == "1" or b == "1":
        return b if a == "1" else a
    return f"{a} {b}"
