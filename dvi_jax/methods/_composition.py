"""Compositions of the map with its adjoint."""

import abc
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ..base.checks import array, instance, known, whole
from ._base import Method, check_invertible
from ._order_conditions import order_defects
from ._type_ii import TypeII
from .step import no_step_yet

# The conditions of order n have 2^(n − 1) words: above order 12 the check takes longer than a run.
_MOST_CHECKED = 12

# Coefficients that are printed to 12 digits should pass as well.
_DEFECT = 1e-11


class CompositionMethod(Method):
    """Base of the methods that alternate a map Φ with its adjoint, as `Composition` does.

    The inverse undoes the substeps in the opposite order. Φ is any invertible method, forced and
    implicit ones too; a substep with a negative coefficient goes backwards in time.
    """

    base: eqx.AbstractVar[Method]

    is_invertible: ClassVar[bool] = True

    # A type checker would require an abstract variable as an argument of every subclass.
    if TYPE_CHECKING:
        is_symplectic: ClassVar[bool]
    else:

        @property
        def is_symplectic(self):
            return self.base.is_symplectic

    @abc.abstractmethod
    def fractions(self) -> tuple[float, ...]:
        """c₁, c₂, …: the map takes the odd ones, its adjoint the even ones; they sum to 1."""

    def __check_init__(self):
        check_invertible("base", self.base)

    def substeps(self) -> tuple[float, ...]:
        parts = self.base.substeps()
        return tuple(c * part for c in self.fractions() for part in parts)

    def is_made_of_the_map(self) -> bool:
        return self.base.is_made_of_the_map()

    def check(self, equations, first_interval, q, p):
        self.base.check(equations, first_interval, q, p)

    def is_double_only(self, equations) -> bool:
        return self.base.is_double_only(equations)

    def needs_constraint(self) -> bool:
        return self.base.needs_constraint()

    def in_coordinates(self, equations, interval, q):
        inner = self.base.in_coordinates(equations, interval, q)
        return inner and inner.of_part(self, "base")

    @property
    def has_negative_substeps(self) -> bool:
        """Whether a substep goes backwards in time, where a dissipative force increases motion."""
        return min(self.substeps()) < 0

    def step(self, equations, interval, q0, p0):
        def pair(state, parts):
            q, p, info = state
            q, p, first = self.base.step(equations, parts[0], q, p)
            if len(parts) == 1:
                return q, p, info.then(first)
            # The adjoint of a step is the inverse of the step with −h: no method writes it itself.
            q, p, second = self.base.inverse(equations, parts[1].reversed(), q, p)
            return q, p, info.then(first).then(second)

        pairs, single = self._parts(interval)
        state = _in_turn(pair, pairs)((q0, p0, no_step_yet(q0)))
        return state if single is None else pair(state, (single,))

    def inverse(self, equations, interval, q1, p1):
        def pair(state, parts):
            q, p, info = state
            second = no_step_yet(q)
            if len(parts) == 2:
                q, p, second = self.base.step(equations, parts[1].reversed(), q, p)
            q, p, first = self.base.inverse(equations, parts[0], q, p)
            return q, p, info.then(second).then(first)

        pairs, single = self._parts(interval)
        q, p, info = q1, p1, no_step_yet(q1)
        if single is not None:
            q, p, last = self.base.inverse(equations, single, q, p)
            info = info.then(last)
        return _in_turn(pair, pairs[::-1])((q, p, info))

    def _parts(self, interval):
        """The substeps in pairs, and the last one if their number is odd."""
        fractions = self.fractions()
        # The last end is 1 by definition; the sum of the fractions is 1 only to round-off.
        ends = [0.0, *itertools.accumulate(fractions[:-1]), 1.0]
        # h is c h, not a difference of ends, in which digits cancel: invariants would show it.
        parts = [
            interval.part(start, end)._replace(h=c * interval.h)
            for c, start, end in zip(fractions, ends[:-1], ends[1:], strict=True)
        ]
        if self.base.is_symmetric and len(parts) > 2:
            # The base is its own adjoint: a loop over single steps is half as long to compile.
            return [(part,) for part in parts], None
        pairs = list(zip(parts[0::2], parts[1::2], strict=False))
        return pairs, parts[-1] if len(parts) % 2 else None

    def needs_no_solve(self, equations, interval, q) -> bool:
        # Steps and inverse steps alternate, so that both have to be explicit.
        forwards = self.base.needs_no_solve(equations, interval, q)
        return forwards and self.base.inverse_needs_no_solve(equations, interval, q)


def _in_turn(body: Callable, pairs: list) -> Callable:
    """state → state after `body` on each pair in turn."""
    # A scan, because several pairs written out make a loop over steps that is too large to be
    # compiled as one piece. One trajectory of order 4 then takes five times as long (a batch a
    # seventh less), and twice as long to compile.
    if len(pairs) == 1:
        return functools.partial(body, parts=pairs[0])
    if not pairs:
        return lambda state: state
    stack = jax.tree.map(lambda *xs: jnp.stack(xs), *pairs)
    return lambda state: lax.scan(lambda carry, parts: (body(carry, parts), None), state, stack)[0]


def of_strang(*outer: float) -> tuple[float, ...]:
    """The fractions of S_{γ₁h} ∘ … ∘ S_{γ_sh}, S = `Strang`, from γ₁, … before the middle one."""
    # Consistency (Σγ = 1) holds to the last digit if the middle one is computed, not printed.
    middle = 1.0 - 2.0 * math.fsum(outer)
    return tuple(c / 2 for c in (*outer, middle, *outer[::-1]) for _ in range(2))


def _as_coefficients(values: Sequence[float]) -> tuple[float, ...]:
    name = "coefficients of Composition, a sequence of numbers,"
    numbers = known(name, list(instance(name, values, Iterable, "one")), float)
    return tuple(array(name, numbers, ("n",), empty=True).tolist())


class Composition(CompositionMethod):
    r"""A composition of a map and its adjoint with user-defined coefficients.

        Ψ_h = … ∘ Φ*_{c₄h} ∘ Φ_{c₃h} ∘ Φ*_{c₂h} ∘ Φ_{c₁h}        (c₁ acts first)

    **Arguments**

    - `coefficients`: c₁, c₂, … summing to 1; the map at odd places, its adjoint at even ones.
    - `order`: their order, at most 12. The order conditions are checked, to 1e-11 of what cancels.
    - `base`: Φ, any method with an inverse; `TypeII` when left out. A base of higher order, or a
      symmetric one, has fewer conditions to meet.

    Symmetric if the coefficients are, and their number is even or the base is symmetric.

    **Raises** `ValueError` when the coefficients are empty, not finite, or do not sum to 1 (to
    1e-12), when they do not have the order claimed (their order is named), and for a base without
    an inverse; `TypeError` for a base that is not a method and coefficients that are not numbers.

    **Source** Hairer, Lubich & Wanner 2006, II.4 (4.6), V.3; the conditions: `order_defects`.

    **Example**

    ```python
    mine = dvi.Composition((0.2, 0.3, 0.3, 0.2), order=2)    # the map and its adjoint alternate
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
        check_invertible("base", base)  # the defects below depend on the base
        if not c or not all(math.isfinite(x) for x in c) or abs(math.fsum(c) - 1) > 1e-12:
            raise ValueError(
                f"coefficients of Composition must be finite, sum to 1, got {c}, sum {sum(c)!r}."
            )
        hint = "Conditions of higher orders cannot be checked."
        whole("order", order, high=_MOST_CHECKED, hint=hint)
        defects = order_defects(c, order, base.order, base.is_symmetric)
        actual = next((n for n, defect in enumerate(defects) if defect > _DEFECT), order)
        if actual < order:
            raise ValueError(
                f"order must be at most {actual}, that of the coefficients, got {order}: the "
                f"conditions of order {actual + 1} have the defect {defects[actual]:.1e}, above "
                f"{_DEFECT}."
            )

    def fractions(self):
        return self.coefficients

    @property
    def is_symmetric(self) -> bool:
        """Whether the map is its own adjoint."""
        # An odd number has one step of the base in the middle, which has to be symmetric itself.
        is_even = len(self.coefficients) % 2 == 0
        is_palindrome = self.coefficients == self.coefficients[::-1]
        return is_palindrome and (is_even or self.base.is_symmetric)
