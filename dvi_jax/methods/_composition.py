"""Compositions of the map with its adjoint."""

import abc
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from .._step import (
    adjoint_step,
    inverse_step,
    no_step_yet,
    step,
)
from ._base import Method


class CompositionMethod(Method):
    """Base of the methods that alternate the map with its adjoint.

        Ψ_h = … ∘ Φ*_{c₄h} ∘ Φ_{c₃h} ∘ Φ*_{c₂h} ∘ Φ_{c₁h}        (c₁ acts first)

    The inverse undoes the parts in the opposite order.
    """

    is_invertible: ClassVar[bool] = True

    @abc.abstractmethod
    def fractions(self) -> tuple[float, ...]:
        """c₁, c₂, …: the map takes the odd ones, its adjoint the even ones; they sum to 1."""

    def step(self, equations, interval, q0, p0):
        def pair(state, parts):
            # the map on the first part, then its adjoint on the second
            q, p, info = state
            q, p, one = step(equations, parts[0], q, p)
            q, p, two = adjoint_step(equations, parts[1], q, p)
            return q, p, info.then(one).then(two)

        def single(state, part):
            q, p, info = state
            q, p, one = step(equations, part, q, p)
            return q, p, info.then(one)

        explicit = self._needs_no_solve(equations, interval, q0)
        state = (q0, p0, no_step_yet(q0))
        pairs, rest = self._parts(interval)
        state = _each(pair, state, pairs, unrolled=explicit)
        return single(state, rest) if rest is not None else state

    def inverse(self, equations, interval, q1, p1):
        def single(state, part):
            q, p, info = state
            q, p, one = inverse_step(equations, part, q, p)
            return q, p, info.then(one)

        def pair(state, parts):
            q, p, info = state
            q, p, one = step(equations, parts[1].reversed(), q, p)
            q, p, two = inverse_step(equations, parts[0], q, p)
            return q, p, info.then(one).then(two)

        explicit = self._needs_no_solve(equations, interval, q1)
        state = (q1, p1, no_step_yet(q1))
        pairs, rest = self._parts(interval)
        if rest is not None:
            state = single(state, rest)
        return _each(pair, state, pairs[::-1], unrolled=explicit)

    def _parts(self, interval):
        """The interval cut into pairs of parts, and the part that is left when they are odd."""
        fractions = self.fractions()
        start, parts = 0.0, []
        for i, c in enumerate(fractions):
            end = 1.0 if i + 1 == len(fractions) else start + c
            part = interval.part(start, end)
            parts.append(part._replace(h=c * interval.h))
            start = end
        pairs = list(zip(parts[0::2], parts[1::2], strict=False))
        return pairs, parts[-1] if len(parts) % 2 else None

    def _needs_no_solve(self, equations, interval, q) -> bool:
        forwards = equations.step_is_explicit(interval, q)
        return forwards and equations.inverse_is_explicit(interval, q)

    def _inverse_needs_no_solve(self, equations, interval, q) -> bool:
        return self._needs_no_solve(equations, interval, q)


def _each(body: Callable, state: Any, pairs: list, unrolled: bool) -> Any:
    """`body` on each pair in turn: written out when that lets the arithmetic fuse, else a scan.

    An implicit pair is a loop already, and writing out many of them only costs compile time.
    """
    if unrolled or len(pairs) < 2:
        for parts in pairs:
            state = body(state, parts)
        return state
    stacked = jax.tree.map(lambda *xs: jnp.stack(xs), *pairs)
    return lax.scan(lambda s, parts: (body(s, parts), None), state, stacked)[0]


def _as_coefficients(values: Sequence[float]) -> tuple[float, ...]:
    return tuple(float(c) for c in values)


class Composition(CompositionMethod):
    r"""A composition of the map with its adjoint, with coefficients of the user's.

        Ψ_h = … ∘ Φ*_{c₄h} ∘ Φ_{c₃h} ∘ Φ*_{c₂h} ∘ Φ_{c₁h}        (c₁ acts first)

    **Arguments**

    - `coefficients`: c₁, c₂, … summing to 1; the map at odd places, its adjoint at even ones.
    - `order`: the order that the coefficients are known to have; it is documentation, and
      not checked beyond consistency (order 1).

    Symmetric when the coefficients read the same from both ends and their number is even.

    **Raises** `ValueError` when they are empty, not finite, or do not sum to 1 (to 1e-12).

    **Source** Hairer, Lubich & Wanner 2006, II.4 (4.6), V.3.
    """

    coefficients: tuple[float, ...] = eqx.field(static=True, converter=_as_coefficients)
    order: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        c = self.coefficients
        if not c or not all(math.isfinite(x) for x in c) or abs(math.fsum(c) - 1) > 1e-12:
            raise ValueError(
                "the coefficients of a composition must be finite and sum to 1 (consistency); "
                f"got {c}" + (f", which sum to {math.fsum(c)!r}." if c else ".")
            )

    def fractions(self):
        return self.coefficients

    @property
    def is_symmetric(self) -> bool:
        c = self.coefficients
        return len(c) % 2 == 0 and c == c[::-1]

    @property
    def is_symplectic(self) -> bool:
        return True
