"""Types of arrays and functions that all modules share."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

from jaxtyping import Array, Float, Inexact

from .printing import printable

Scalar: TypeAlias = Float[Array, ""]
State: TypeAlias = Inexact[Array, "..."]
Args: TypeAlias = Any

HamiltonianFn: TypeAlias = Callable[..., Any]
"""``H_D(t0, t1, q0, p1, args)`` → scalar, units of energy."""

ForceFn: TypeAlias = Callable[..., Any]
"""``W(t0, t1, q0, p1, args)`` → like q0, units of force."""

ConstraintFn: TypeAlias = Callable[..., Any]
"""``g(q, args)`` → shape (m,), zero for the positions allowed."""


@printable
class Interval(NamedTuple):
    """One interval of the time grid: its ends and its length."""

    # h is stored although it is t1 − t0: late in a run the difference of two large times has lost
    # digits, which an exact invariant would show.
    t0: Scalar
    t1: Scalar
    h: Scalar

    def reversed(self) -> "Interval":
        """The same interval from its end to its start."""
        return Interval(self.t1, self.t0, -self.h)

    def part(self, start: float, end: float) -> "Interval":
        """The part between the fractions `start` and `end` of this interval."""
        length = self.t1 - self.t0  # differs from h where t is a slow time
        # The ends stay bit for bit, so that the substeps of a composition join.
        t0 = self.t0 + start * length if start != 0 else self.t0
        t1 = self.t0 + end * length if end != 1 else self.t1
        return Interval(t0, t1, (end - start) * self.h)


# A protocol, not a base class: an observable may be any object of the user with this method.
@runtime_checkable
class Bindable(Protocol):
    """An observable that requires the system and ε of the run."""

    def bind(self, system: Any, epsilon: Any) -> Callable[..., Any]: ...
