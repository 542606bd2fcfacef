"""What the library knows of a system besides its equations."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._system import System
from ..discover.generators import Generator
from ._start import check_shape

DIMENSIONLESS = {"q": "1", "p": "1", "t": "1", "energy": "1"}
"""Units of a dimensionless system."""


@dataclass(frozen=True)
class Adiabatic:
    """What is known of a quantity that is nearly kept.

    Over long times it wavers about a constant by an amount that goes with `small` to the `power`,
    and does not drift.

    - `small`: what is small, in words.
    - `power`: the power of it that the quantity wavers by.
    - `smaller`: function of a factor → the `Problem` in which what is small is so many times its
      size; None where it is ε itself.
    """

    small: str
    power: int
    smaller: Callable[[float], "Problem"] | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """A system with parameters, a start, a step size and what is known of it.

    - `system`: the `System`; its H_D is H by the paper's rule, H_D(t0, t1, q0, p1) = H(t0, q0, p1),
      but for H the energy of the undisturbed system. `args` its parameters.
    - `q0`, `p0`, `h`: a start and a step size that suit it.
    - `observables`: name → function of one step ``(t0, t1, q0, p0, q1, p1, args)``.
    - `units`: what q, p, t and energy are measured in.
    - `source`: where equations and values come from.
    - `check`: function ``(q0, p0, args)`` that raises `ValueError` for a start that the system
      cannot go on from; or None.

    What is known, as data, of the differential equations without disturbance (ε = 0):

    - `parameters`: name in args → meaning [unit].
    - `invariants`: names of the observables that they keep exactly.
    - `adiabatic`: name of an observable → an `Adiabatic`, what it is nearly kept by.
    - `symmetries`: name → `Generator` of the discrete equations of the type II map, at every step
      size; of the differential equations a fortiori.
    - `flow_symmetries`: name → `Generator` of the differential equations alone, which a step map
      keeps up to its order.
    - `exact`: function ``(t, q0, p0, args)`` → (q, p), the state at times t [unit of t] of any
      shape after a start at t = 0, shapes t.shape + q0.shape; or None.
    - `exact_epsilon`: the ε at which `exact` holds, 0 where it is of the undisturbed system.

    **Raises** `ValueError` for facts about an observable or a parameter that is not there.
    """

    name: str
    system: System
    q0: Any
    p0: Any
    h: float
    args: Any = None
    observables: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    source: str = ""
    check: Callable[[Any, Any, Any], None] | None = None
    parameters: Mapping[str, str] = field(default_factory=dict)
    invariants: tuple[str, ...] = ()
    adiabatic: Mapping[str, Adiabatic] = field(default_factory=dict)
    symmetries: Mapping[str, Generator] = field(default_factory=dict)
    flow_symmetries: Mapping[str, Generator] = field(default_factory=dict)
    exact: Callable[..., tuple[Any, Any]] | None = None
    exact_epsilon: float = 0.0

    def __post_init__(self):
        if self.system.epsilon is None:  # what is known is known of the unperturbed motion
            object.__setattr__(self, "system", replace(self.system, epsilon=0.0))
        known = set(self.args or ()) if isinstance(self.args, Mapping | None) else set()
        for what, names, allowed, of in (
            ("invariants", self.invariants, set(self.observables), "observables"),
            ("adiabatic", self.adiabatic, set(self.observables), "observables"),
            ("parameters", self.parameters, known, "args"),
        ):
            for name in names:
                if name not in allowed:
                    raise ValueError(
                        f"{self.name}: {what} names {name!r}, which is none of its {of}: "
                        f"{', '.join(sorted(allowed)) or 'there are none'}."
                    )


class InSlowTime(eqx.Module):
    """An observable of a system with ``slow_time=True``, handed ε·t0 and ε·t1 as its times.

    - `function`: ``(τ0, τ1, q0, p0, q1, p1, args)`` → array, τ = εt.

    `integrate` tells it ε; by hand: ``observable.bind(system, epsilon)(...)``.

    **Raises** `ValueError` when called before it knows ε.
    """

    function: Callable[..., Any]
    epsilon: Any = None

    def bind(self, system: Any, epsilon: Any) -> "InSlowTime":
        """The same observable, for this ε."""
        return InSlowTime(self.function, epsilon)

    def __call__(self, t0, t1, q0, p0, q1, p1, args):
        if self.epsilon is None:
            raise ValueError(
                "an observable in slow time has to know ε: call observable.bind(system, epsilon)"
                "(...), or give it to dvi.integrate(observe=...)."
            )
        return self.function(self.epsilon * t0, self.epsilon * t1, q0, p0, q1, p1, args)


def over_times(
    shape: tuple[int, ...] | None = None,
) -> Callable[[Callable[..., tuple[Any, Any]]], Callable[..., tuple[Any, Any]]]:
    """A decorator that makes the solution at one time a function of times of any shape.

    - `shape`: of q0 and of p0; None where any will do, if only they have the same.

    It takes ``(t, q0, p0, args)`` → (q, p), shaped like q0, for a number t, and gives a function of
    the same arguments, whose results have the shape t.shape + q0.shape and the dtype of the start.
    That **raises** `ValueError` for a start of another shape.
    """
    wanted = "q0 and p0 of one shape" if shape is None else f"q0 and p0 of shape {shape}"

    def decorate(at_time):
        @functools.wraps(at_time)
        def exact(t, q0, p0, args):
            t, q0, p0 = jnp.asarray(t), jnp.asarray(q0), jnp.asarray(p0)
            check_shape(
                q0,
                p0,
                lambda seen: shape is None or seen == shape,
                f"an exact solution is that of one start, with {wanted} (for many starts: "
                "jax.vmap(exact, (None, 0, 0, None)))",
            )
            dtype = jnp.result_type(q0, p0, float)
            q0, p0 = q0.astype(dtype), p0.astype(dtype)
            q, p = jax.vmap(lambda s: at_time(s, q0, p0, args))(t.ravel())
            return tuple(x.astype(dtype).reshape(t.shape + q0.shape) for x in (q, p))

        return exact

    return decorate


def at_end(hamiltonian: Callable[..., Any]) -> Callable[..., Any]:
    """The observable `energy` of a Hamiltonian."""

    def energy(t0, t1, q0, p0, q1, p1, args):
        """H(t1, q1, p1) at the end of the step: the energy of the continuous system."""
        return hamiltonian(t1, t1, q1, p1, args)

    return energy


def named(*observables: Callable[..., Any]) -> dict[str, Callable[..., Any]]:
    """Observables by the names of their functions."""
    return {getattr(f, "function", f).__name__: f for f in observables}
