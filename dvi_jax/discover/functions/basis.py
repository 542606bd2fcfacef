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

from ...base.checks import function, instance
from ...base.types import Scalar, State


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
    """`basis.for_shape(shape)`, or a `TypeError` for any other object."""
    known = "a basis such as dvi.Polynomials(4), dvi.Basis([f, g]), or a sum or product of them"
    instance("basis", basis, AbstractBasis, known)
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
                f"q and p must have the shape {self.shape} for this basis, that of one state; got "
                f"q of shape {q.shape} and p of shape {p.shape}. For many states use jax.vmap."
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

    def formula(self, coefficients: Any, digits: Any = 6, drop: float = 1e-9) -> str:
        """The combination with these coefficients as text; tiny ones (relative) are left out."""
        c = np.asarray(coefficients, float)
        shown = np.abs(c) > drop * np.max(np.abs(c), initial=0.0)
        return linear_text(np.where(shown, c, 0), self.names, digits)

    def about(self, middle: np.ndarray, exactly: bool = False) -> "tuple[BoundBasis, np.ndarray]":
        """Functions ψ of z − middle that span the same space, and N with ψ = N φ + constants.

        - `middle`: of z = (q, p, t), shape (2n + 1,). Polynomials are taken about it, other
          functions stay as they are.
        - `exactly`: only if no constants are left over.
        """
        found = self.moved(middle)
        if found is None or (exactly and not found.closed):
            return self, np.eye(self.size)
        return dataclasses.replace(self, function=found.function, names=found.names), found.matrix

    def moved(self, middle: np.ndarray) -> "About | None":
        """The same as `About`; None where all functions stay as they are."""
        about = getattr(self.function, "about", None)
        return None if about is None else about(middle)


def linear_text(coefficients: np.ndarray, names: Sequence[str], digits: Any = 6) -> str:
    """A linear combination as text, without what has the coefficient 0; the name "1" is implied.
    `digits`: of all coefficients, or of each."""
    text, digits = "", np.broadcast_to(digits, len(names))
    for value, name, known in zip(coefficients, names, digits, strict=True):
        if value == 0:
            continue
        size = f"{abs(value):.{known}g}"
        term = size if name == "1" else name if size == "1" else f"{size} {name}"
        sign = "−" if value < 0 else "+"
        text += f" {sign} {term}" if text else term if value > 0 else f"−{term}"
    return text or "0"


class About(NamedTuple):
    """Functions ψ of z − middle; N with ψ = N φ + constants; whether no constants are left."""

    function: Callable[[State, State, Scalar], Array]
    names: tuple[str, ...]
    matrix: np.ndarray
    closed: bool


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

    def __init__(
        self,
        functions: Sequence[Callable[..., Any]] | dict[str, Callable[..., Any]],
        complexity: int = 1,
    ):
        if isinstance(functions, dict):
            named = dict(functions)
        else:
            named = {_name(each, i): each for i, each in enumerate(tuple(functions))}
        if not named:
            raise ValueError("functions is empty: give at least one function (q, p) → scalar.")
        for name, each in named.items():
            function(f"basis function {name!r}", each, "(q, p) or (q, p, t)")
            if not (_takes(each, 2) or _takes(each, 3)):
                seen = inspect.signature(each)
                raise TypeError(
                    f"the basis function {name!r} must take the arguments (q, p) or (q, p, t), got "
                    f"a function of {seen}."
                )
        self.functions, self.names = tuple(named.values()), tuple(named)
        self.complexity = complexity

    def for_shape(self, shape):
        timed = tuple(not _takes(f, 2) for f in self.functions)
        for name, each, with_time in zip(self.names, self.functions, timed, strict=True):
            _require_real_scalar(name, each, with_time, shape)
        complexity = (self.complexity,) * len(self.names)
        return BoundBasis(_Values(self.functions, timed), self.names, complexity, any(timed))


def _takes(function: Callable[..., Any], count: int) -> bool:
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:  # a builtin without a signature
        return count == 2
    return True


def _require_real_scalar(name, function, timed: bool, shape) -> None:
    """Reject a function whose value is not a real scalar, by tracing it once."""
    state, time = (jax.ShapeDtypeStruct(s, jnp.result_type(float)) for s in (shape, ()))
    try:
        out = eqx.filter_eval_shape(function, state, state, *([time] if timed else []))
    except Exception as error:
        error.add_note(f"(in the basis function {name!r}, called with q of shape {shape})")
        raise
    kind, dtype = np.shape(out), getattr(out, "dtype", type(out))
    real = np.issubdtype(dtype, np.floating) or np.issubdtype(dtype, np.integer)
    if out is None or kind != () or not real:
        seen = f"a value of type {type(out).__name__}"
        if hasattr(out, "dtype"):
            seen = f"an array of shape {kind}, type {dtype}"
        raise ValueError(
            f"the basis function {name!r} must return a real scalar; for q of shape {shape} it "
            f"returned {seen}. Return one real number, such as jnp.sum(q**2)."
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
        return _pair(self, shape, multiplied=False)


class Product(AbstractBasis):
    """Every product of a function of one basis and a function of the other."""

    first: AbstractBasis
    second: AbstractBasis

    def for_shape(self, shape):
        return _pair(self, shape, multiplied=True)


def _pair(basis: Sum | Product, shape: tuple[int, ...], multiplied: bool) -> BoundBasis:
    a, b = basis.first.for_shape(shape), basis.second.for_shape(shape)
    complexity = a.complexity + b.complexity
    if multiplied:
        complexity = tuple(c + d for c, d in itertools.product(a.complexity, b.complexity))
    names = _names_of_pair(a.names, b.names, multiplied)
    return BoundBasis(_Pair(a, b, multiplied), names, complexity, a.uses_time or b.uses_time)


class _Pair(eqx.Module):
    first: BoundBasis
    second: BoundBasis
    multiplied: bool = eqx.field(static=True)

    def __call__(self, q, p, t):
        a, b = self.first(q, p, t), self.second(q, p, t)
        return jnp.outer(a, b).ravel() if self.multiplied else jnp.concatenate([a, b])

    def about(self, middle: np.ndarray) -> About | None:
        parts = self.first, self.second
        found = [part.moved(middle) for part in parts]
        if self.multiplied:
            # A constant that remains of one part would be multiplied by functions of the other.
            found = [one if one and one.closed else None for one in found]
        if found[0] is None and found[1] is None:
            return None
        a, b = (
            one or About(part.function, part.names, np.eye(part.size), True)
            for one, part in zip(found, parts, strict=True)
        )
        first, second = (
            dataclasses.replace(part, function=one.function, names=one.names)
            for one, part in zip((a, b), parts, strict=True)
        )
        matrix = np.kron(a.matrix, b.matrix)
        if not self.multiplied:
            none = np.zeros((first.size, second.size))
            matrix = np.block([[a.matrix, none], [none.T, b.matrix]])
        names = _names_of_pair(a.names, b.names, self.multiplied)
        moved = _Pair(first, second, self.multiplied)
        return About(moved, names, matrix, a.closed and b.closed)


def _names_of_pair(a: tuple[str, ...], b: tuple[str, ...], multiplied: bool) -> tuple[str, ...]:
    if not multiplied:
        return a + tuple(name + "′" if name in a else name for name in b)
    words = ([w for w in pair if w != "1"] for pair in itertools.product(a, b))
    return tuple(" ".join(pair) or "1" for pair in words)
