"""Compositions of the map with its adjoint."""

import abc
import math
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx

from .._step import adjoint_step, inverse_is_explicit, inverse_step, step, step_is_explicit
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

    def step(self, system, interval, q0, p0, epsilon, args, newton):
        q, p, info = q0, p0, None
        for i, part in enumerate(self._parts(interval)):
            advance = step if i % 2 == 0 else adjoint_step
            q, p, part_info = advance(system, part, q, p, epsilon, args, newton)
            info = part_info if info is None else info.then(part_info)
        assert info is not None
        return q, p, info

    def inverse(self, system, interval, q1, p1, epsilon, args, newton):
        q, p, info = q1, p1, None
        for i, part in reversed(list(enumerate(self._parts(interval)))):
            if i % 2 == 0:
                q, p, part_info = inverse_step(system, part, q, p, epsilon, args, newton)
            else:
                q, p, part_info = step(system, part.reversed(), q, p, epsilon, args, newton)
            info = part_info if info is None else info.then(part_info)
        assert info is not None
        return q, p, info

    def _parts(self, interval):
        fractions = self.fractions()
        start, parts = 0.0, []
        for i, c in enumerate(fractions):
            end = 1.0 if i + 1 == len(fractions) else start + c
            part = interval.part(start, end)
            parts.append(part._replace(h=c * interval.h))
            start = end
        return parts

    def _needs_no_solve(self, system, interval, q, epsilon, args) -> bool:
        return step_is_explicit(system, interval, q, q, epsilon, args) and inverse_is_explicit(
            system, interval, q, q, epsilon, args
        )

    def _inverse_needs_no_solve(self, system, interval, q, epsilon, args) -> bool:
        return self._needs_no_solve(system, interval, q, epsilon, args)


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
