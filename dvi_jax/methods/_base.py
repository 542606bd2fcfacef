"""What every method is: a step, its inverse where there is one, and what is promised of it."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._checks import instance
from .._step import Equations, StepInfo
from .._system import System
from .._types import Args, Interval, State


class Method(eqx.Module):
    """Base of all methods. A final subclass names its order and properties and writes `step`."""

    order: eqx.AbstractVar[int]
    is_symmetric: eqx.AbstractVar[bool]
    is_symplectic: eqx.AbstractVar[bool]
    is_invertible: eqx.AbstractVar[bool]

    @abc.abstractmethod
    def step(
        self, equations: Equations, interval: Interval, q0: State, p0: State
    ) -> tuple[State, State, StepInfo]:
        """(q0, p0) at interval.t0 → (q1, p1) at interval.t1, with the status of the step."""

    @abc.abstractmethod
    def inverse(
        self, equations: Equations, interval: Interval, q1: State, p1: State
    ) -> tuple[State, State, StepInfo]:
        """(q1, p1) at interval.t1 → (q0, p0) at interval.t0: what `step` came from."""

    @abc.abstractmethod
    def needs_no_solve(self, equations: Equations, interval: Interval, q: State) -> bool:
        """Whether `step` is explicit for these equations; `Equations` has the parts to ask."""

    @abc.abstractmethod
    def inverse_needs_no_solve(self, equations: Equations, interval: Interval, q: State) -> bool:
        """Whether `inverse` is."""

    def substeps(self) -> tuple[float, ...]:
        """The fractions of a step over which its maps go; those below 0 go backwards in time."""
        return (1.0,)

    def is_made_of_the_map(self) -> bool:
        """Whether a step is made of the map (12)–(13) and its adjoint alone."""
        return False

    def is_explicit(self, system: System, q: State | None = None, args: Args = None) -> bool:
        """Whether a step of this method on `system` needs no solve; read from the jaxpr.

        `q` is an example position (values do not matter, the shape does; two components if
        left out), `args` example parameters for systems that need some.
        """
        if q is None:
            q = jnp.zeros(2)
        scalar = jax.ShapeDtypeStruct((), q.dtype)
        found: list[bool] = []

        def probe(t0, t1, q, epsilon):
            equations = Equations(system, epsilon, args)
            found.append(self.needs_no_solve(equations, Interval(t0, t1, t1), q))
            return t0

        try:
            jax.eval_shape(probe, scalar, scalar, q, scalar)
        except (TypeError, IndexError, KeyError, ValueError, AttributeError) as error:
            raise ValueError(
                f"could not trace the system for q of shape {q.shape} and args={args!r} ({error}). "
                "Give an example: is_explicit(system, q=jnp.zeros(shape), args=...)."
            ) from error
        return found[0]


def check_invertible(name: str, method: Any) -> None:
    """Refuse what is no method, or has no inverse step to make an adjoint of."""
    instance(name, method, Method, "a method such as dvi.TypeII()")
    if not method.is_invertible:
        raise ValueError(
            f"{method!r} has no inverse step, so it has no adjoint: take a variational method."
        )
