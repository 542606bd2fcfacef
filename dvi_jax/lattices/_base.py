"""The base of all lattices (time grids): the interval of step k."""

import abc
import operator
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree

from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import require, whole
from ..base.printing import printable
from ..base.results import RESULTS
from ..base.signature import output_of
from ..base.types import Args, Interval, Scalar, State
from ..methods.step import Equations
from ..observe import Jump, Stop
from ..observe.solution import Save, Solution
from ..problem.system import System


@printable
class Place(NamedTuple):
    """A trajectory before step k: initial time t0, initial step size h, k, and the state."""

    t0: Scalar
    h: Scalar
    k: Int[Array, ""]
    q: State
    p: State


class Run(NamedTuple):
    """A run: a system with initial conditions, observables, saved states and an end."""

    system: System
    t0: Scalar
    q0: State
    p0: State
    epsilon: Scalar
    args: Args
    observe: PyTree
    save: Save
    stop: Stop | None
    jumps: tuple[Jump, ...] = ()


class Lattice(eqx.Module):
    """Base class of all lattices (time grids).

    Most know every interval in advance, by `interval`. A lattice that chooses its steps during the
    run sets ``has_memory = True``: its `next` computes the interval from the state and a memory.
    """

    # Not decided from `next`: runs on lattices without a memory have loops without one, and states
    # that can be rebuilt backwards.
    has_memory: ClassVar[bool] = False

    takes_h: ClassVar[bool] = True
    """Whether the steps depend on the h of the call."""

    @abc.abstractmethod
    def prepare(self, t0: Any, h: Any, num_steps: Any) -> tuple[Any, Any, int]:
        """(t0, h, num_steps) with defaults filled in. **Raises** for values that do not fit."""

    def steps_to(self, t0: Any, h: Any, num_steps: Any, t1: Any, duration: Any) -> int:
        """Number of steps to the time t1, or over a duration. **Raises** `ValueError`."""
        raise ValueError(
            f"t1 and duration must be left out with lattice={self!r}, whose steps have different "
            f"sizes, got t1={t1!r}, duration={duration!r}. "
            f"{'Give num_steps' if self.takes_h else 'ts determines the end'}, or "
            "save=dvi.Save(ts=[t])."
        )

    @abc.abstractmethod
    def interval(self, t0: Scalar, h: Scalar, k: Int[Array, ""]) -> Interval:
        """The interval of step k = 0, 1, … (with a memory: of step 0)."""

    def check(self, method: Any, arithmetic: Any) -> None:
        """**Raises** `ValueError` for a method or an arithmetic that does not fit these steps."""

    def transform(self, run: Run) -> tuple[Run, Callable[[Solution], Solution]]:
        """The run in the variables of the steps, and the inverse transformation of a solution."""
        return run, lambda solution: solution

    def begin(self, t0: Scalar, h: Scalar) -> Any:
        """The memory before the first step."""
        return None

    # The status is None, not `successful`, where steps always exist: no loop has to carry it.
    def next(
        self, memory: Any, equations: Equations, place: Place
    ) -> tuple[Interval, Any, RESULTS | None]:
        """The interval of the next step, the memory after it, and whether it exists (None: yes)."""
        return self.interval(place.t0, place.h, place.k), memory, None

    def report(self, memory: Any, equations: Equations, place: Place) -> dict[str, Any]:
        """Statistics of the lattice at the end, for ``solution.stats``."""
        return {}

    @abc.abstractmethod
    def is_usable(self, t0: Scalar, h: Scalar) -> Bool[Array, ""]:
        """Whether every step size is finite, non-zero and of one sign."""


class StepSizes(Lattice):
    """Base of the lattices with a given step size, at least of the first step, and their number."""

    def prepare(self, t0, h, num_steps):
        # A lattice takes a tenth of a millisecond to print, which only the error needs.
        if h is None or num_steps is None:
            hint = "dvi.Uniform() also accepts t1 or duration." if num_steps is None else ""
            require(f"lattice={self!r}", {"h": h, "num_steps": num_steps}, hint=hint)
        return t0, h, check_num_steps(num_steps)

    def is_usable(self, t0, h):
        return jnp.isfinite(t0) & jnp.isfinite(h) & (h != 0)


def check_rounding(owner: str, arithmetic: Any) -> None:
    """**Raises** `ValueError` for an arithmetic that undoes steps bit for bit."""
    if arithmetic.undoes_steps:
        raise ValueError(
            f"arithmetic={arithmetic!r} cannot be used with lattice=dvi.{owner}(...), whose step "
            "sizes are rounded: use dvi.Compensated(), or dvi.Uniform()."
        )


def check_speed(owner: str, speed: Callable[..., Any], run: Run) -> None:
    """**Raises** `ValueError` for a speed that is not a positive scalar at the start of a run."""
    # At the start only: values at later states are checked by the status of the run.
    arguments = run.t0, run.q0, run.p0, run.args
    output_of(f"speed(t, q, p, args) of {owner}", speed, *arguments)
    value = jnp.asarray(speed(*arguments))
    if value.shape != () or (not is_traced(value) and not float(value) > 0):
        raise ValueError(
            f"speed of {owner} must return one positive number, but at the initial state it "
            f"returns {value if value.shape == () else f'an array of shape {value.shape}'}."
        )


def check_num_steps(num_steps: object) -> int:
    """`num_steps` as an int. **Raises** `TypeError` or `ValueError`."""
    if isinstance(num_steps, float) and num_steps.is_integer():
        num_steps = int(num_steps)
    try:
        count = None if isinstance(num_steps, bool) else operator.index(num_steps)  # pyright: ignore
    except Exception:  # JAX raises an error of its own for a traced number
        count = None
    if count is None:
        raise TypeError(
            f"num_steps must be an integer, in jax.jit a static argument, got {num_steps!r}."
        )
    hint = "A negative h runs backwards in time."
    return whole("num_steps", count, 0, 2**31 - 2, hint)  # steps are counted in 32 bits
