"""Compositions of the map with its adjoint."""

import abc
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from .._checks import whole
from .._step import no_step_yet
from ._base import Method, check_invertible
from ._order_conditions import order_defects
from ._type_ii import TypeII

_MOST_CHECKED = 12
"""Highest order whose conditions are checked: 2^(order − 1) words of that degree."""

_DEFECT = 1e-11
"""Largest defect of an order condition that passes: coefficients printed to 12 digits do."""


class CompositionMethod(Method):
    """Base of the methods that alternate a map with its adjoint.

        Ψ_h = … ∘ Φ*_{c₄h} ∘ Φ_{c₃h} ∘ Φ*_{c₂h} ∘ Φ_{c₁h}        (c₁ acts first)

    The inverse undoes the parts in the opposite order. Φ is any invertible method, forced and
    implicit ones too; a part with negative c goes backwards in time.
    """

    base: eqx.AbstractVar[Method]

    orders: ClassVar[Sequence[int]] = ()
    """Those that there are coefficients of, where they are in a table."""
    is_invertible: ClassVar[bool] = True

    if TYPE_CHECKING:  # there the abstract variable would stay an argument of every subclass
        is_symplectic: ClassVar[bool]
    else:

        @property
        def is_symplectic(self):
            return self.base.is_symplectic

    @abc.abstractmethod
    def fractions(self) -> tuple[float, ...]:
        """c₁, c₂, …: the map takes the odd ones, its adjoint the even ones; they sum to 1."""

    def __check_init__(self):
        if self.orders and self.order not in self.orders:
            *most, last = self.orders
            which = f"orders {', '.join(map(str, most))} and {last}" if most else f"order {last}"
            raise ValueError(
                f"{type(self).__name__} knows {which}, got {self.order!r}. For order 2 use "
                "dvi.Strang(); for coefficients of your own, dvi.Composition(coefficients, "
                "order=...)."
            )
        check_invertible("base", self.base)

    def substeps(self) -> tuple[float, ...]:
        parts = self.base.substeps()
        return tuple(c * part for c in self.fractions() for part in parts)

    def is_made_of_the_map(self) -> bool:
        return self.base.is_made_of_the_map()

    @property
    def has_negative_substeps(self) -> bool:
        """Whether some part goes backwards in time, where a dissipative force makes motion grow."""
        return min(self.substeps()) < 0

    def step(self, equations, interval, q0, p0):
        def pair(state, parts):
            """The map on the first part, then its adjoint on the second."""
            q, p, info = state
            q, p, first = self.base.step(equations, parts[0], q, p)
            q, p, second = self.base.inverse(equations, parts[1].reversed(), q, p)
            return q, p, info.then(first).then(second)

        pairs, rest = self._parts(interval)
        q, p, info = _in_turn(pair, pairs)((q0, p0, no_step_yet(q0)))
        if rest is None:
            return q, p, info
        q, p, last = self.base.step(equations, rest, q, p)
        return q, p, info.then(last)

    def inverse(self, equations, interval, q1, p1):
        def pair(state, parts):
            q, p, info = state
            q, p, second = self.base.step(equations, parts[1].reversed(), q, p)
            q, p, first = self.base.inverse(equations, parts[0], q, p)
            return q, p, info.then(second).then(first)

        pairs, rest = self._parts(interval)
        q, p, info = q1, p1, no_step_yet(q1)
        if rest is not None:
            q, p, last = self.base.inverse(equations, rest, q, p)
            info = info.then(last)
        return _in_turn(pair, pairs[::-1])((q, p, info))

    def _parts(self, interval):
        """The interval cut into pairs of parts, and the part that is left when they are odd."""
        fractions = self.fractions()
        ends = [0.0, *itertools.accumulate(fractions[:-1]), 1.0]
        parts = [
            interval.part(start, end)._replace(h=c * interval.h)
            for c, start, end in zip(fractions, ends[:-1], ends[1:], strict=True)
        ]
        pairs = list(zip(parts[0::2], parts[1::2], strict=False))
        return pairs, parts[-1] if len(parts) % 2 else None

    def needs_no_solve(self, equations, interval, q) -> bool:
        forwards = self.base.needs_no_solve(equations, interval, q)
        return forwards and self.base.inverse_needs_no_solve(equations, interval, q)

    def inverse_needs_no_solve(self, equations, interval, q) -> bool:
        return self.needs_no_solve(equations, interval, q)


def _in_turn(body: Callable, pairs: list) -> Callable:
    """state → state after `body` on each pair in turn, by a scan.

    Written out, several pairs make a loop over steps that is too large to be compiled as one piece:
    one trajectory of order 4 then takes five times as long (a batch a seventh less), and twice as
    long to compile.
    """
    if len(pairs) == 1:
        return functools.partial(body, parts=pairs[0])
    if not pairs:
        return lambda state: state
    stacked = jax.tree.map(lambda *xs: jnp.stack(xs), *pairs)
    return lambda state: lax.scan(lambda s, parts: (body(s, parts), None), state, stacked)[0]


def of_strang(outer: Sequence[float]) -> tuple[float, ...]:
    """The fractions of S_{γ₁h} ∘ … ∘ S_{γ_sh}, s odd and γ symmetric, S = `Strang`.

    `outer` are γ₁, …, up to but not with the middle one, which makes the sum 1. Each S_{γh} is
    the map and its adjoint, over γh/2 each.
    """
    middle = 1.0 - 2.0 * math.fsum(outer)
    return tuple(c / 2 for c in (*outer, middle, *outer[::-1]) for _ in range(2))


def _as_coefficients(values: Sequence[float]) -> tuple[float, ...]:
    try:
        return tuple(float(c) for c in values)
    except (TypeError, ValueError):
        raise TypeError(
            f"the coefficients of a composition are a sequence of numbers, got {values!r}."
        ) from None


class Composition(CompositionMethod):
    r"""A composition of a map with its adjoint, with coefficients of the user's.

        Ψ_h = … ∘ Φ*_{c₄h} ∘ Φ_{c₃h} ∘ Φ*_{c₂h} ∘ Φ_{c₁h}        (c₁ acts first)

    **Arguments**

    - `coefficients`: c₁, c₂, … summing to 1; the map at odd places, its adjoint at even ones.
    - `order`: the order that is claimed for them, at most 12; its conditions are checked, to
      1e-11 of the terms that cancel.
    - `base`: Φ, any method with an inverse; `TypeII` when left out. A base of higher order, or a
      symmetric one, has fewer conditions to meet.

    Symmetric when the coefficients read the same from both ends and either their number is even
    or the base is symmetric.

    **Raises** `ValueError` when the coefficients are empty, not finite, or do not sum to 1 (to
    1e-12), when they do not have the order claimed (the order that they have is named), and for a
    base without an inverse; `TypeError` for a base that is no method and
    for coefficients that are no numbers.

    **Source** Hairer, Lubich & Wanner 2006, *Geometric Numerical Integration*, II.4 (4.6), V.3;
    the conditions: `order_defects`.

    **Example**

    ```python
    mine = dvi.Composition((0.2, 0.3, 0.3, 0.2), order=2)    # in turn the adjoint and the map
    sol = dvi.integrate(systems.oscillator().system, [1.0], [0.0], h=0.1, num_steps=63, method=mine)
    print(mine.order, mine.is_symmetric)
    # 2 True
    ```
    """

    coefficients: tuple[float, ...] = eqx.field(static=True, converter=_as_coefficients)
    order: int = eqx.field(static=True, default=1)
    base: Method = eqx.field(default_factory=TypeII)

    def __check_init__(self):
        c, order, base = self.coefficients, self.order, self.base
        check_invertible("base", base)
        if not c or not all(math.isfinite(x) for x in c) or abs(math.fsum(c) - 1) > 1e-12:
            raise ValueError(
                "the coefficients of a composition must be finite and sum to 1 (consistency); "
                f"got {c}" + (f", which sum to {math.fsum(c)!r}." if c else ".")
            )
        hint = "The conditions of higher orders are not checked."
        whole("order", order, most=_MOST_CHECKED, hint=hint)
        defects = order_defects(c, order, base.order, base.is_symmetric)
        found = next((n for n, defect in enumerate(defects) if defect > _DEFECT), order)
        if found < order:
            raise ValueError(
                f"these coefficients have order {found}, not {order}: their defect in the "
                f"conditions of order {found + 1} is {defects[found]:.1e}, of the terms that "
                f"cancel there. Claim order={found}, or give more digits."
            )

    def fractions(self):
        return self.coefficients

    @property
    def is_symmetric(self) -> bool:
        """Whether the map is its own adjoint."""
        c = self.coefficients
        return c == c[::-1] and (len(c) % 2 == 0 or self.base.is_symmetric)
