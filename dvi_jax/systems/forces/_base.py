"""What all forces on bodies have in common: the bodies, sums, factors."""

import abc
import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import array, finite, function, instance, known, one_of, positive, whole
from ...base.types import Args, Scalar, State
from ...problem.flows import value_of
from ...problem.system import System
from .._problem import Problem, nonzero, parameter
from ..n_body import masses_of


class Bodies(NamedTuple):
    """Positions and velocities of all bodies, (bodies, dim), masses (0 of a test particle), p/v."""

    x: Array
    v: Array
    masses: Array
    scale: Array


def quantity(check: Callable[[str, Any], Any], **options: Any) -> Any:
    """The field of a parameter, a number or a function of args; `check`: of each of its values that
    is not traced, at construction."""
    return eqx.field(metadata={"check": check}, **options)


def check_values(name: str, value: Any, check: Callable[[str, Any], Any]) -> None:
    """`check` of each number of a parameter. **Raises** `ValueError` or `TypeError`."""
    if callable(value):
        function(name, value, "(args)", hint="Or give a number.")
    elif not any(map(is_traced, jax.tree.leaves(value))):
        for x in known(name, value).ravel().tolist():
            check(name, x)


def time_scale(name: str, value: Any) -> None:
    """A number that is not zero; infinite: no change."""
    nonzero(name, 1.0 if value in (math.inf, -math.inf) else value)


not_negative = partial(positive, zero=True)


def bodies_of(q: State, p: State, args: Args) -> Bodies:
    """The bodies of a state. G is in the masses: they are G m [length³/time²]."""
    one_of("the last axis of q", q.shape[-1:], ((2,), (3,)))
    if q.ndim == 1:  # a satellite: a body without mass, and the centre at the origin
        masses = jnp.asarray([parameter(args, "mu"), 0.0], q.dtype)
        x, v = (jnp.stack([jnp.zeros_like(x), x]) for x in (q, p))
        return Bodies(x, v, masses, jnp.ones_like(masses))
    masses = jnp.asarray(parameter(args, "masses"), q.dtype)
    tests = (0, len(q) - len(masses))
    masses_of(q[: len(masses)], args)
    scale = jnp.pad(masses, tests, constant_values=1.0)
    return Bodies(q, p / scale[:, None], args.get("G", 1.0) * jnp.pad(masses, tests), scale)


class Force(eqx.Module):
    """A force W(t0, t1, q0, p1, args) on N bodies, or on a satellite.

    - N bodies: q and p have the shape (bodies, dim), and args has ``"masses"`` and ``"G"`` (1
      without it), as for `systems.n_body`, with test particles or without.
    - A satellite: q and p have the shape (dim,), p is the velocity, the attracting body is at the
      origin, and ``args["mu"]`` is G times its mass.

    ``f + g`` is the sum of two forces and ``a * f`` a force with a strength a, a number or a
    function of args. `add_to` adds a force to a problem.

    **Raises** `ValueError` for a parameter that is not finite, has a wrong sign, or (in a run) a
    wrong shape, if its value is not traced by JAX; `TypeError` for what is not a number.
    """

    # An array of NumPy that is multiplied by a force leaves the product to it.
    __array_ufunc__: ClassVar[None] = None

    def __check_init__(self):
        for field in dataclasses.fields(self):
            if "check" in field.metadata:
                name = self._label(field.name)
                check_values(name, getattr(self, field.name), field.metadata["check"])

    def _label(self, name: str) -> str:
        return f"{name} of forces.{type(self).__name__}"

    def value(self, name: str, args: Args, like: Array, *shapes: tuple[int, ...]) -> Array:
        """The value of a parameter in the precision of `like`, of one of the shapes, by default a
        number. **Raises** `ValueError` for another shape."""
        value = value_of(getattr(self, name), args, like)
        return array(self._label(name), value, *(shapes or ((),)))

    def each(self, name: str, args: Args, like: Array) -> Array:
        """The value of a parameter of all bodies or of each, shape (bodies, 1)."""
        bodies = like.shape[:1]
        return jnp.broadcast_to(self.value(name, args, like, (), bodies), bodies)[:, None]

    @abc.abstractmethod
    def accelerations(self, t: Scalar, bodies: Bodies, args: Args) -> Array:
        """The accelerations of all bodies, shape (bodies, dim)."""

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> State:
        state = bodies_of(q0, p1, args)
        force = state.scale[:, None] * self.accelerations(t0, state, args)
        return force[1] if q0.ndim == 1 else force

    def __add__(self, other: Any) -> "Force":
        return NotImplemented if not isinstance(other, Force) else Sum((self, other))

    def __radd__(self, other: Any) -> "Force":
        return self if isinstance(other, int) and other == 0 else NotImplemented  # sum([f, g])

    def __mul__(self, strength: Any) -> "Force":
        return NotImplemented if isinstance(strength, Force) else Multiple(self, strength)

    __rmul__ = __mul__

    def add_to(self, problem: Problem, epsilon: float = 1.0, args: Any = None) -> Problem:
        """The problem with this force, next to the forces that it has; ε of its runs is `epsilon`.

        `args`: dict of parameters of the force, stored next to those of the problem. Its known
        invariants and symmetries are those without this force.

        **Raises** `TypeError` for another object than a problem.
        """
        instance("problem", problem, Problem, "a problem of dvi_jax.systems")
        system = problem.system
        force = self if system.force is None else _Pair(system.force, system.epsilon, self)
        fields = {"perturbation": system.perturbation, "slow_time": system.slow_time}
        new_system = System(system.H_D, force=force, epsilon=epsilon, **fields)
        if args is not None:
            own = {} if problem.args is None else problem.args
            args = {**own, **instance("args", args, Mapping, "a dict of parameters")}
        return dataclasses.replace(problem, system=new_system, args=args or problem.args)


class Sum(Force):
    """The sum of forces."""

    terms: tuple[Force, ...]

    def accelerations(self, t, bodies, args):
        first, *others = (term.accelerations(t, bodies, args) for term in self.terms)
        return sum(others, first)


class Multiple(Force):
    """A force times a strength, which is a number or a function of args."""

    force: Force
    strength: Any = quantity(finite)

    def accelerations(self, t, bodies, args):
        factor = self.value("strength", args, bodies.x)
        return factor * self.force.accelerations(t, bodies, args)


class _Pair(eqx.Module):
    first: Any
    epsilon: Any
    second: Force

    def __call__(self, *step: Any) -> State:
        return self.epsilon * self.first(*step) + self.second(*step)


def _indices(on_bodies: Any) -> tuple[int, ...] | None:
    if on_bodies is None:
        return None
    entries = np.atleast_1d(known("on_bodies", on_bodies)).tolist()
    return tuple(dict.fromkeys(whole("each of on_bodies", i, 0) for i in entries))


class Central(Force):
    """A force on bodies that depends on their motion relative to one of them, the centre.

    - `centre`: index of that body. `on_bodies`: indices of the bodies that the force acts on; None:
      all others.
    """

    centre: int = eqx.field(static=True, default=0, kw_only=True)
    on_bodies: Any = eqx.field(static=True, default=None, converter=_indices, kw_only=True)

    has_recoil: ClassVar[bool] = True
    """Whether the centre feels the opposite force."""

    def __check_init__(self):
        whole("centre", self.centre, 0)

    @abc.abstractmethod
    def relative(self, t: Any, r: Array, v: Array, mu: Array, masses: Array, args: Args) -> Array:
        """Accelerations, (k, dim), of bodies at r with velocities v relative to the centre; `mu`
        and `masses` are G times the mass of the centre and of the bodies (k,)."""

    def accelerations(self, t, bodies, args):
        count, c = len(bodies.x), whole("centre", self.centre, 0, len(bodies.x) - 1)
        all_others = [i for i in range(count) if i != c]
        indices = all_others if self.on_bodies is None else self.on_bodies
        others = np.array([one_of("each of on_bodies", i, all_others) for i in indices], int)
        r, v = (x[others] - x[c][None] for x in (bodies.x, bodies.v))
        masses = bodies.masses[others]
        a = self.relative(t, r, v, bodies.masses[c], masses, args)
        result = jnp.zeros_like(bodies.x).at[others].set(a)
        if not self.has_recoil:
            return result
        return result.at[c].set(-jnp.sum(masses[:, None] * a, axis=0) / bodies.masses[c])
