"""What every lattice is: the interval of step k."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
from jaxtyping import Array, Bool, Int

from .._results import RESULTS
from .._step import Equations
from .._types import Interval, Scalar, State


class Place(NamedTuple):
    """Where a trajectory stands before step k: the state, and the step and time it began with."""

    t0: Scalar
    h: Scalar
    k: Int[Array, ""]
    q: State
    p: State


class Lattice(eqx.Module):
    """Base of all lattices.

    Most know every interval beforehand, by `interval`. One that finds its steps along the way says
    ``has_memory = True``: its `next` chooses the interval from the state and from a memory that
    `begin` makes.
    """

    has_memory: ClassVar[bool] = False

    @abc.abstractmethod
    def prepare(self, t0: Any, h: Any, num_steps: Any) -> tuple[Any, Any, int]:
        """(t0, h, num_steps) with defaults filled in, after refusing what does not fit."""

    @abc.abstractmethod
    def interval(self, t0: Scalar, h: Scalar, k: Int[Array, ""]) -> Interval:
        """The interval of step k = 0, 1, … (with a memory: of step 0)."""

    def begin(self, t0: Scalar, h: Scalar) -> Any:
        """The memory before the first step."""
        return None

    def next(
        self, memory: Any, equations: Equations, place: Place
    ) -> tuple[Interval, Any, RESULTS | None]:
        """The interval of the next step, the memory after it, and whether it exists (None: yes)."""
        return self.interval(place.t0, place.h, place.k), memory, None

    def report(self, memory: Any) -> dict[str, Any]:
        """What there is to say of the lattice at the end, for ``solution.stats``."""
        return {}

    @abc.abstractmethod
    def is_usable(self, t0: Scalar, h: Scalar) -> Bool[Array, ""]:
        """Whether every step size is finite, non-zero and of one sign."""


MAX_STEPS = 2**31 - 1


def check_num_steps(num_steps: object) -> int:
    """`num_steps` as an int, after refusing what cannot count steps."""
    if hasattr(num_steps, "__index__") and not isinstance(num_steps, bool):
        try:
            count = num_steps.__index__()  # pyright: ignore[reportAttributeAccessIssue]
        except Exception:
            count = None
        if count is not None:
            if count < 0:
                raise ValueError(
                    f"num_steps must not be negative, got {count}. To go backwards in time give "
                    "a negative h."
                )
            if count >= MAX_STEPS:
                raise ValueError(
                    f"num_steps must be below 2³¹ (steps are counted in 32 bits), got {count}. Run "
                    "in pieces, each from the end of the one before."
                )
            return count
    raise TypeError(
        f"num_steps must be a Python integer (it sets array shapes), got {num_steps!r}. Under jit "
        "mark it static."
    )
