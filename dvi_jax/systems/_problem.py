"""A system of the library: parameters, initial conditions, known properties, and checks of them."""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import all_finite, array, finite as finite, positive as positive
from ..base.printing import first_lines
from ..base.tables import Table
from ..discover.functions.generators import Generator
from ..discover.symmetries.library import time_translation
from ..observe import AtEnd, InSlowTime as InSlowTime, Jump, OfState
from ..problem.noise import Langevin
from ..problem.system import System as System

DIMENSIONLESS = {"q": "1", "p": "1", "t": "1", "energy": "1"}
"""Units of a dimensionless system."""


@dataclass(frozen=True)
class Adiabatic:
    """Metadata of an adiabatic invariant: it oscillates with amplitude O(small^power).

    It has no secular drift.

    - `small`: the small parameter, in words. `power`: its power in the amplitude.
    - `smaller`: function of a factor → the `Problem` whose small parameter is multiplied by it;
      None where the small parameter is ε itself.
    """

    small: str
    power: int
    smaller: Callable[[float], "Problem"] | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """A system with parameters, initial conditions, a step size and its known properties.

    - `system`: the `System`; its H_D is H by the paper's rule, H_D(t0, t1, q0, p1) = H(t0, q0, p1),
      with H the energy of the unperturbed system. `args`: its parameters.
    - `q0`, `p0`, `h`: initial conditions and a suitable step size.
    - `observables`: name → function of the state ``(t, q, p, args)`` or of one step
      ``(t0, t1, q0, p0, q1, p1, args)``; those of the library accept both.
    - `units`: units of q, p, t and energy.
    - `source`: reference for equations and values.
    - `check`: function ``(q0, p0, args)`` that raises `ValueError` for invalid initial
      conditions or parameters; or None.

    Known properties, of the differential equations without perturbation (ε = 0):

    - `parameters`: name in args → meaning [unit].
    - `invariants`: names of the observables that are conserved exactly.
    - `adiabatic`: name of an observable → `Adiabatic`.
    - `symmetries`: name → `Generator` of the discrete equations of the type II map, at every step
      size, and so of the differential equations.
    - `flow_symmetries`: name → `Generator` of the differential equations alone; a step map has it
      up to the order of the map.
    - `exact`: function ``(t, q0, p0, args)`` → (q, p), the state at times t [unit of t] of any
      shape from initial conditions at t = 0, shapes t.shape + q0.shape; or None.
    - `jumps`: the `dvi.Jump` that `integrate` makes where it receives no other; what is known is
      known of the motion between them.
    - `exact_epsilon`: the ε at which `exact` holds, 0 for the unperturbed system.

    **Raises** `ValueError` for a property of an observable or a parameter that does not exist.
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
    jumps: tuple[Jump, ...] = ()

    def __repr__(self) -> str:
        """What a user gives to `integrate`, and what is known, in at most eight lines."""

        def short(x: Any) -> str:
            x = np.asarray(x)
            few = x.size <= 6
            text = np.array2string(x, precision=6, separator=", ") if few else f"shape {x.shape}"
            return " ".join(text.split())

        args = self.args if isinstance(self.args, Mapping) else {}
        lines = [
            f"Problem {self.name!r}: {self.source}",
            f"  q0 = {short(self.q0)}, p0 = {short(self.p0)}, h = {short(self.h)}",
        ]
        lines += [f"  args: {', '.join(f'{n} = {short(x)}' for n, x in args.items())}"] * bool(args)
        for label, names in (
            ("observables", self.observables),
            ("conserved for ε = 0", self.invariants),
            ("symmetries", [*self.symmetries, *self.flow_symmetries]),
        ):
            lines += [f"  {label}: {', '.join(names)}"] * bool(names)
        return first_lines("\n".join(lines), "")

    def __post_init__(self):
        if self.system.epsilon is None:  # what is known is known of the unperturbed motion
            object.__setattr__(self, "system", replace(self.system, epsilon=0.0))
        for name in ("q0", "p0"):
            value = getattr(self, name)
            if isinstance(value, list | tuple):
                array = np.asarray(value, jnp.result_type(float))
                object.__setattr__(self, name, array)
        tables = ("observables", "units", "parameters", "adiabatic", "symmetries")
        for name in (*tables, "flow_symmetries"):
            object.__setattr__(self, name, Table(getattr(self, name)))
        args = self.args if isinstance(self.args, Mapping) else {}
        for field_name, names, kind in (
            ("invariants", self.observables, "observables"),
            ("adiabatic", self.observables, "observables"),
            ("parameters", args, "the dict args"),
        ):
            for name in set(getattr(self, field_name)) - set(names):
                raise ValueError(
                    f"{field_name} of {self.name!r} must be names in {kind}, {sorted(names)}, got "
                    f"{name!r}."
                )


def bound(function: Callable[..., Any], *values: Any) -> Callable[..., Any]:
    """The function with its first arguments fixed. Unlike a local function it can be pickled; it
    has the name, without underscores in front, and the docstring of the function."""
    fixed = functools.partial(function, *values)
    fixed.__dict__.update(__name__=function.__name__.lstrip("_"), __doc__=function.__doc__)
    return fixed


Check = Callable[[str, Any], Any]
"""Function of a parameter's name and value that raises `ValueError`."""


class ParameterError(ValueError):
    """An invalid parameter in args."""


@dataclass(frozen=True)
class Start:
    """A check of initial conditions and parameters: a function of (q0, p0, args).

    - `system`: the system in words, for messages.
    - `shape`: of q0 and of p0, with None for any number from `smallest` on; None for any shape.
    - `parameters`: name in args → check of its value.
    - `singular`: name of a singular point → the point, or a function of args.
    - `check`: a further check, function of q0, p0 (NumPy arrays) and args.

    **Raises** `ValueError` that shows what was seen; `ParameterError` for a parameter.
    """

    system: str
    shape: tuple[int | None, ...] | None
    parameters: Mapping[str, Check] = field(default_factory=dict)
    singular: Mapping[str, Any] = field(default_factory=dict)
    check: Callable[[Any, Any, Any], None] | None = None
    smallest: int = 1

    def __call__(self, q0: Any, p0: Any, args: Any) -> None:
        check_shape(q0, p0, self._fits, f"{self.system}: q0 and p0 must have {self._shape_rule}")
        for name, check in self.parameters.items():
            check_parameter(args, name, check)
        if not (self.singular or self.check):
            return
        q, p = np.asarray(q0, float), np.asarray(p0, float)
        for name_of_point, place in self.singular.items():
            point: Any = place(args) if callable(place) else place
            if (q == point).all():
                values = np.asarray(point, float).tolist()
                raise ValueError(
                    f"q0 must not be at {name_of_point} {values}: the system is singular there."
                )
        if self.check is not None:
            self.check(q, p, args)

    def _fits(self, state_shape: tuple[int, ...]) -> bool:
        if self.shape is None:
            return True
        pairs = zip(state_shape, self.shape, strict=False)
        return len(state_shape) == len(self.shape) and all(
            n >= self.smallest if m is None else n == m for n, m in pairs
        )

    @property
    def _shape_rule(self) -> str:
        if self.shape is None:
            return "the same shape"
        range_of_n = f" with the same n ≥ {self.smallest}" if None in self.shape else ""
        return f"shape {self.shape}{range_of_n}".replace("None", "n")


def check_shape(q0: Any, p0: Any, fits: Callable[[tuple[int, ...]], bool], rule: str) -> None:
    """Require q0 and p0 of one shape for which `fits` holds; `rule`: these shapes, a sentence."""
    q, p = np.shape(q0), np.shape(p0)
    if q != p or not fits(q):
        raise ValueError(f"{rule}, got q0 of shape {q} and p0 of shape {p}.")


def parameter(args: Any, name: str) -> Any:
    """The parameter of this name. **Raises** `ParameterError`, with the names that args has."""
    if not isinstance(args, Mapping) or name not in args:
        keys = list(args) if isinstance(args, Mapping) else args
        raise ParameterError(
            f"the parameter {name} is missing: args must be a dict with it, got {keys!r:.200}."
        )
    return args[name]


def check_parameter(args: Any, name: str, check: Check) -> None:
    """Apply a check to the parameter of this name. **Raises** `ParameterError`."""
    value = parameter(args, name)
    try:
        check(name, value)
    except ValueError as error:
        raise ParameterError(str(error)) from None


def nonzero(name: str, value: Any) -> None:
    """A check such as for a charge or a magnetic field, by which a particle gyrates."""
    if finite(name, value) == 0:
        raise ValueError(f"{name} must not be zero, got {value}.")


def interval(low: float, high: float) -> Check:
    """A check for a number in the open interval."""
    return bound(_check_interval, low, high)


def _check_interval(low: float, high: float, name: str, value: Any) -> None:
    if not low < finite(name, value) < high:
        raise ValueError(f"{name} must be between {low} and {high} (both excluded), got {value}.")


def vector(size: int) -> Check:
    """A check for `size` finite numbers."""
    return bound(_check_vector, size)


def _check_vector(size: int, name: str, value: Any) -> None:
    try:
        array(name, np.asarray(value, float), (size,), integers=True)
    except TypeError as error:
        raise ValueError(f"{name}: {error}.") from None
    all_finite(name, value)


@dataclass(frozen=True)
class Parameter:
    """A parameter of a library system: its value, its meaning with [unit], its check."""

    value: Any
    meaning: str
    check: Check = positive


def library_problem(
    system: System | Callable[..., Any],
    start: Start,
    parameters: Mapping[str, Parameter] = MappingProxyType({}),
    observables: Sequence[Callable[..., Any]] = (),
    *,
    q0_p0_h: tuple[Any, Any, float],
    autonomous: bool = True,
    of_steps: Sequence[str] = (),
    **fields: Any,
) -> Problem:
    """A `Problem` of the library.

    - `system`: the `System`, or its Hamiltonian.
    - `start`: check of initial conditions; those of `parameters` are added to it.
    - `of_steps`: names of the observables that depend on more than the end of a step.
    - `q0_p0_h`: initial conditions and step size. `fields`: the other fields of `Problem`.
    - `autonomous`: whether H is independent of time at ε = 0. The energy is then an observable and
      an invariant, and the translation in time a symmetry, though not one of a system with a slow
      time or a constraint: symmetries are those of the type II map.
    """
    for name, entry in parameters.items():
        if not is_traced(entry.value):
            entry.check(name, entry.value)
    system = system if isinstance(system, System) else System(system)
    q0, p0, h = q0_p0_h
    fields = {"units": DIMENSIONLESS, "q0": q0, "p0": p0, "h": h, **fields}
    if autonomous:
        observables = (at_end(system.H_D), *observables)
        fields["invariants"] = ("energy", *fields.get("invariants", ()))
    if autonomous and not system.slow_time and system.constraint is None:
        fields["symmetries"] = {"time": time_translation(), **fields.get("symmetries", {})}
    return Problem(
        system=system,
        args={name: entry.value for name, entry in parameters.items()} or None,
        check=replace(start, parameters={name: entry.check for name, entry in parameters.items()}),
        parameters={name: entry.meaning for name, entry in parameters.items()},
        observables={
            f.__name__: f if f.__name__ in of_steps else of_state(f, system.slow_time)
            for f in observables
        },
        **fields,
    )


def of_state(function: Callable[..., Any], slow_time: bool = False) -> Callable[..., Any]:
    """A function of a step that depends on its end alone, as an observable of the state."""
    observable = AtEnd(function)
    return InSlowTime(observable) if slow_time else OfState(observable, True)


def over_times(
    shape: tuple[int, ...] | None = None,
) -> Callable[[Callable[..., tuple[Any, Any]]], Callable[..., tuple[Any, Any]]]:
    """A decorator that makes the solution at one time a function of times of any shape.

    - `shape`: of q0 and of p0; None for any shape, the same for both.

    It takes ``(t, q0, p0, args)`` → (q, p) for a number t. The results of the new function have the
    shape t.shape + q0.shape and the dtype of the initial conditions. It **raises** `ValueError` for
    initial conditions of another shape.
    """
    rule = (
        "exact requires one initial condition (for several use jax.vmap(exact, (None, 0, 0, "
        f"None))): q0 and p0 must have {'the same shape' if shape is None else f'shape {shape}'}"
    )

    def decorate(at_time):
        @functools.wraps(at_time)
        def exact(t, q0, p0, args):
            t, q0, p0 = jnp.asarray(t), jnp.asarray(q0), jnp.asarray(p0)
            check_shape(q0, p0, lambda state_shape: shape in (None, state_shape), rule)
            dtype = jnp.result_type(q0, p0, float)
            q0, p0 = q0.astype(dtype), p0.astype(dtype)
            q, p = jax.vmap(lambda s: at_time(s, q0, p0, args))(t.ravel())
            return tuple(x.astype(dtype).reshape(t.shape + q0.shape) for x in (q, p))

        return exact

    return decorate


@functools.cache  # observables are compared by identity: another function would compile again
def at_end(hamiltonian: Callable[..., Any]) -> Callable[..., Any]:
    """The observable `energy` of a Hamiltonian."""
    return bound(_energy, hamiltonian)


def _energy(hamiltonian, t0, t1, q0, p0, q1, p1, args):
    """H(t1, q1, p1) at the end of the step: the energy of the continuous system."""
    return hamiltonian(t1, t1, q1, p1, args)


_THERMAL = Langevin(lambda args: args["friction"], lambda args: args["temperature"])


def thermal(
    H_D: Callable[..., Any], friction: float, temperature: float | None, **parameters: Parameter
) -> tuple[System, dict[str, Parameter]]:
    """A system of unit masses and its parameters, without noise if there is no temperature."""
    if temperature is None:
        return System(H_D), parameters
    parameters["friction"] = Parameter(friction, "rate of friction γ [1/time]")
    parameters["temperature"] = Parameter(temperature, "k_B T [energy]")
    return System(H_D, noise=_THERMAL), parameters


@functools.cache
def configurational(hamiltonian: Callable[..., Any]) -> Callable[..., Any]:
    """The observable `configurational`, from which a temperature follows."""
    return bound(_configurational, hamiltonian)


def _configurational(hamiltonian, t0, t1, q0, p0, q1, p1, args):
    """(|∂V/∂q|², ∂²V/∂q·∂q) at t1, shape (2,); the ratio of their canonical means is T."""
    slope, curvature = (
        d(lambda q: hamiltonian(t1, t1, q, jnp.zeros_like(q), args))(q1)
        for d in (jax.grad, jax.hessian)
    )
    return jnp.stack([jnp.sum(slope**2), jnp.trace(curvature)])
