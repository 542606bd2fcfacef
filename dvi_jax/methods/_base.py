"""The base of all methods: a step, its inverse, and the properties that tests verify."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..base.checks import instance
from ..base.types import Args, Interval, State
from ..problem.system import System
from .step import Equations, StepInfo


class InLoop(NamedTuple):
    """Functions as `Method.step`: last ∘ stepⁿ ∘ first is n steps; of equal length if they are
    joined, so that neighbours have a part in common."""

    first: Callable
    step: Callable
    last: Callable
    is_joined: bool = True


class Method(eqx.Module):
    """Base class of all methods: order and properties are declared, `step` is implemented."""

    order: eqx.AbstractVar[int]
    is_symmetric: eqx.AbstractVar[bool]
    is_symplectic: eqx.AbstractVar[bool]
    is_invertible: eqx.AbstractVar[bool]

    increments: ClassVar[int] = 0
    """Increments of noise that a step takes; 0: no method for systems with noise."""

    needs_areas: ClassVar[bool] = False
    """Whether a step takes the areas of the increments as well, see `BrownianPath`."""

    largest_increment: ClassVar[float | None] = None
    """Limit of the increments of `Brownian`, in standard deviations; None: no limit."""

    is_the_map: ClassVar[bool] = False
    """Whether `step` is the map (12)–(13) itself, whose only unknown is p1."""

    @abc.abstractmethod
    def step(
        self, equations: Equations, interval: Interval, q0: State, p0: State
    ) -> tuple[State, State, StepInfo]:
        """(q0, p0) at interval.t0 → (q1, p1) at interval.t1, with the status of the step."""

    @abc.abstractmethod
    def inverse(
        self, equations: Equations, interval: Interval, q1: State, p1: State
    ) -> tuple[State, State, StepInfo]:
        """(q1, p1) at interval.t1 → (q0, p0) at interval.t0: the state that `step` maps to it."""

    @abc.abstractmethod
    def needs_no_solve(self, equations: Equations, interval: Interval, q: State) -> bool:
        """Whether `step` is explicit for these equations; see `Equations.step_is_explicit`."""

    def inverse_needs_no_solve(self, equations: Equations, interval: Interval, q: State) -> bool:
        """Whether `inverse` is explicit for these equations; by default where `step` is."""
        return self.needs_no_solve(equations, interval, q)

    def in_loop(self, equations: Equations, interval: Interval, q: State) -> InLoop | None:
        """The same steps with less work, where they have some in common (None: nowhere)."""
        return None

    def in_coordinates(
        self, equations: Equations, interval: Interval, q: State
    ) -> "Coordinates | None":
        """The method in the coordinates that it computes in; None: (q, p)."""
        return None

    def in_equal_steps(
        self, equations: Equations, interval: Interval, q: State
    ) -> "Coordinates | None":
        """The same for steps of one length, without what two neighbours undo."""
        return self.in_coordinates(equations, interval, q)

    def count(
        self, equations: Equations, interval: Interval, q0: State, p0: State, q1: State, p1: State
    ) -> dict[str, Array]:
        """Integers for a step, whose sums over the run are in ``solution.stats``."""
        return {}

    def check(
        self, equations: Equations, first_interval: Callable[[], Interval], q: State, p: State
    ) -> None:
        """**Raises** for a system or a state that this method cannot advance; before a run.

        `first_interval()` is the interval of the first step: most methods do not need it, and its
        evaluation takes a third of a short run.
        """

    def is_double_only(self, equations: Equations) -> bool:
        """Whether a step has the accuracy of float64 also where its operations have more digits."""
        return False

    # Known without equations: a warning about substeps backwards comes before anything is compiled.
    def substeps(self) -> tuple[float, ...]:
        """The lengths of the substeps as fractions of h; negative ones go backwards in time."""
        return (1.0,)

    def is_made_of_the_map(self) -> bool:
        """Whether a step consists of the map (12)–(13) and its adjoint alone."""
        return False

    def needs_constraint(self) -> bool:
        """Whether it is a method for systems with a constraint, and for no others."""
        return False

    def takes(self, has_constraint: bool) -> bool:
        """Whether it is a method for systems with, or without, a constraint."""
        return type(self).needs_constraint(self) == has_constraint

    def is_explicit(self, system: System, q: State | None = None, args: Args = None) -> bool:
        """Whether a step of this method on `system` needs no solve; read from the jaxpr.

        `q` is an example position (only its shape matters; two components by default), `args`
        example parameters for systems that need some.
        """
        q = jnp.zeros(2) if q is None else q
        scalar = jax.ShapeDtypeStruct((), q.dtype)
        answers: list[bool] = []

        # Traced, not evaluated: at zeros a potential may be singular, and nothing is compiled.
        def probe(t0, t1, q, epsilon):
            equations = Equations(system, epsilon, args)
            answers.append(self.needs_no_solve(equations, Interval(t0, t1, t1), q))
            return t0

        try:
            jax.eval_shape(probe, scalar, scalar, q, scalar)
        # The errors that a function raises for a q or args of another structure than it expects.
        except (TypeError, IndexError, KeyError, ValueError, AttributeError) as error:
            raise ValueError(
                f"the system cannot be evaluated for q of shape {q.shape} and args={args!r:.200}. "
                f"{type(error).__name__}: {error}"
            ) from error
        return answers[0]


class Coordinates(NamedTuple):
    """A method in other coordinates, and the maps from (q, p) and back, functions as `step`."""

    enter: Callable
    method: Method
    leave: Callable

    def of_part(self, whole: Method, name: str) -> "Coordinates":
        """`whole`, which has the method as its field `name`, in these coordinates."""
        method = eqx.tree_at(lambda method: getattr(method, name), whole, self.method)
        return self._replace(method=method)


def check_invertible(name: str, method: Any) -> None:
    """**Raises** `TypeError` for an object of another type, `ValueError` without an inverse step,
    from which an adjoint is made."""
    instance(name, method, Method, "a method such as dvi.TypeII()")
    if not method.is_invertible:
        raise ValueError(
            f"{name} must be a method with an inverse step, such as dvi.TypeII(), got {method!r}."
        )
