"""Libraries of candidate terms for an unknown force."""

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..base.checks import instance, one_of, whole
from ..base.signature import with_time
from ..base.types import Args, Scalar, State
from ..problem.discretise import discretise
from ..problem.system import System
from .checks import require_shape
from .first_order import LibraryField, VectorField, field_of

KEY = "coefficients"  # Key of the coefficients in args and parameters
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


class ForceLibrary(eqx.Module):
    r"""Candidates for an unknown force, and their sum.

        W(t0, t1, q0, p1) = Σ c_i f_i(t0, t1, q0, p1, args)

    - `candidates`: ``{name: function}``; each function ``(t0, t1, q0, p1, args)`` returns an
      array like q0 [unit of the force, over that of its coefficient]. For `Model.first_order`, q0
      is the state x, p1 must not be used, and the sum is the rate of change x'.
    - `coefficients`: c, shape (M,) in the order of the names; None (the default) reads them from
      ``args["coefficients"]``, where they can be fitted.

    The library is a force: ``dvi.System(H_D, force=library)``. Two libraries are added with +.

    **Raises** `TypeError` if it is not a dict of such functions; `ValueError` for an empty dict and
    for coefficients of another shape; and when called for args without coefficients, and for a
    candidate whose value is not require_shape like q0.
    """

    functions: tuple[Callable[..., Any], ...]
    names: tuple[str, ...] = eqx.field(static=True)
    coefficients: Array | None

    def __init__(self, candidates: Mapping[str, Callable[..., Any]], coefficients: Any = None):
        a_dict = "a dict {name: function (q0, p1) or (t0, t1, q0, p1, args)}"
        instance("the candidates of a dvi.ForceLibrary", candidates, Mapping, a_dict)
        if not candidates:
            raise ValueError("a dvi.ForceLibrary must have at least one candidate, got {}.")
        for name in candidates:
            instance("the name of a candidate", name, str, "a string")
        arguments = "(t0, t1, q0, p1, args)"
        self.functions = tuple(
            with_time(f"the candidate {name!r}", f, arguments) for name, f in candidates.items()
        )
        self.names = tuple(candidates)
        if coefficients is not None:
            coefficients = jnp.asarray(coefficients, float)
            self._check_shape(coefficients, "coefficients")
        self.coefficients = coefficients

    @classmethod
    def monomials(
        cls, degree: int, n: int, variables: str = "qp", constant: bool = False
    ) -> "ForceLibrary":
        r"""All monomials up to a degree, in each of n components.

        - `degree`: the largest total degree. `n`: q0 has shape (n,).
        - `variables`: ``"q"``, ``"p"``, or ``"qp"`` for monomials in both; ``"x"`` for those in the
          state x of equations of first order. `constant`: add the constant ones.

        For one degree of freedom names are ``"q³"``, ``"q² p"``; for more ``"q1 q2 e2"`` is the
        force q1 q2 along the second coordinate. ``monomials(5, 1)`` has 20 candidates,
        ``monomials(2, 2)`` 28, ``monomials(3, 2, "q")`` 18.

        **Raises** `ValueError` for invalid arguments.
        """
        degree, n = whole("degree", degree), whole("n", n)
        one_of("variables", variables, ("q", "p", "qp", "x"))
        places = [(v, i) for v in variables for i in range(n)]
        forces = [
            _Monomial(tuple(Counter(factors).items()), k, n)
            for total in range(0 if constant else 1, degree + 1)
            for factors in itertools.combinations_with_replacement(places, total)
            for k in range(n)
        ]
        return cls({force.name: force for force in forces})

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> State:
        """Σ c_i f_i: an array like q0."""
        c = self._coefficients(args)
        total = jnp.zeros_like(q0)
        for i, (name, function) in enumerate(zip(self.names, self.functions, strict=True)):
            value = function(t0, t1, q0, p1, args)
            require_shape(f"the value of the candidate {name!r}, like q0,", value, q0.shape)
            total = total + c[i] * value
        return total

    def _coefficients(self, args: Args) -> Array:
        if self.coefficients is not None:
            return self.coefficients
        if not (isinstance(args, Mapping) and KEY in args):
            is_dict = isinstance(args, Mapping)
            keys = f"the keys {list(args)}" if is_dict else f"the type {type(args).__name__}"
            raise ValueError(
                f'args["{KEY}"] must be the {len(self)} coefficients of the dvi.ForceLibrary, but '
                f"args has {keys}."
            )
        coefficients = jnp.asarray(args[KEY])
        self._check_shape(coefficients, f'args["{KEY}"]')
        return coefficients

    def _check_shape(self, c: Array, name: str) -> None:
        hint = f"The candidates are {', '.join(self.names[:4])}{', …' * (len(self) > 4)}."
        require_shape(name, c, (len(self),), hint=hint)

    def __len__(self) -> int:
        return len(self.names)

    def __add__(self, other: "ForceLibrary") -> "ForceLibrary":
        if not isinstance(other, ForceLibrary):
            return NotImplemented
        duplicates = sorted(set(self.names) & set(other.names))
        if duplicates:
            raise ValueError(
                f"both libraries have a candidate {duplicates[0]!r}: rename one, or select the "
                "others by library.only(names)."
            )
        if (self.coefficients is None) != (other.coefficients is None):
            raise ValueError(
                "both libraries must have coefficients, or neither, got only those of the "
                f"{'second' if self.coefficients is None else 'first'}."
            )
        coefficients = None
        if self.coefficients is not None and other.coefficients is not None:
            coefficients = jnp.concatenate([self.coefficients, other.coefficients])
        return ForceLibrary({**self._candidates(), **other._candidates()}, coefficients)

    def only(self, names: Iterable[str]) -> "ForceLibrary":
        """The library of some of the candidates, in the order of this one.

        **Raises** `ValueError` for an unknown name.
        """
        names = self._require(names)
        indices = np.array([i for i, name in enumerate(self.names) if name in names], int)
        coefficients = None if self.coefficients is None else self.coefficients[indices]
        return ForceLibrary({self.names[i]: self.functions[i] for i in indices}, coefficients)

    def with_coefficients(self, coefficients: Any) -> "ForceLibrary":
        """The same with coefficients: an array in the order of names, or a dict of the nonzero
        ones."""
        if isinstance(coefficients, Mapping):
            self._require(coefficients)
            coefficients = [coefficients.get(name, 0.0) for name in self.names]
        return ForceLibrary(self._candidates(), coefficients)

    def _require(self, names: Iterable[str]) -> tuple[str, ...]:
        hint = " Give a list of names, not one string." if isinstance(names, str) else ""
        names = tuple(names)
        for name in names:
            if name not in self.names:
                listing = ", ".join(map(repr, self.names[:8])) + ", …" * (len(self) > 8)
                raise ValueError(f"unknown candidate {name!r}: the library has {listing}.{hint}")
        return names

    def _candidates(self) -> dict[str, Callable[..., Any]]:
        return dict(zip(self.names, self.functions, strict=True))


class _Monomial(eqx.Module):
    """A product of components of q and p along coordinate k."""

    powers: tuple[tuple[tuple[str, int], int], ...] = eqx.field(static=True)
    k: int = eqx.field(static=True)
    n: int = eqx.field(static=True)

    def __call__(self, t0, t1, q0, p1, args):
        del t0, t1, args
        require_shape(f"q0 for dvi.ForceLibrary.monomials(degree, {self.n})", q0, (self.n,))
        value = jnp.ones((), q0.dtype)
        for (v, i), power in self.powers:
            value = value * (p1 if v == "p" else q0)[i] ** power
        return jnp.stack([value if j == self.k else jnp.zeros_like(value) for j in range(self.n)])

    @property
    def name(self) -> str:
        """``q1² p2 e1``."""
        parts = []
        for (v, i), power in self.powers:
            base = v if self.n == 1 else f"{v}{i + 1}"
            parts.append(base if power == 1 else base + str(power).translate(_SUPERSCRIPTS))
        return " ".join([*(parts or ["1"]), *([] if self.n == 1 else [f"e{self.k + 1}"])])


class _ForceSum(eqx.Module):
    """A known force and an unknown one."""

    force: Callable[..., Any]
    library: ForceLibrary

    def __call__(self, t0, t1, q0, p1, args):
        return self.force(t0, t1, q0, p1, args) + self.library(t0, t1, q0, p1, args)


def with_force(system: System, library: ForceLibrary) -> System:
    """The system with the library's force added to its own, or to x' = f for one of first order."""
    if field := field_of(system):
        return replace(system, H_D=discretise(VectorField((*field.parts, LibraryField(library)))))
    force = library if system.force is None else _ForceSum(system.force, library)
    return replace(system, force=force)
