"""What all forces on bodies have in common: the bodies, sums, factors."""

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...base.checks import array, instance, one_of, whole
from ...base.types import Args, Scalar, State
from ...problem.flows import value_of
from ...problem.system import System
from .._problem import Problem, parameter
from ..n_body import masses_of


class Bodies(NamedTuple):
    """Positions and velocities of all bodies, (bodies, dim), masses (0 of a test particle), p/v."""

    x: Array
    v: Array
    masses: Array
    scale: Array


def bodies_of(q: State, p: State, args: Args) -> Bodies:
    """The bodies of a state. G is in the masses: they are G m [length³/time²]."""
    if q.ndim == 1:  # a satellite: a body without mass, and the centre at the origin
        masses = jnp.asarray([parameter(args, "mu"), 0.0], q.dtype)
        x, v = (jnp.stack([jnp.zeros_like(x), x]) for x in (q, p))
        return Bodies(x, v, masses, jnp.ones_like(masses))
    masses = jnp.asarray(parameter(args, "masses"), q.dtype)
    tests = (0, len(q) - len(masses))
    masses_of(q[: len(masses)], args)
    scale = jnp.pad(masses, tests, constant_values=1.0)
    return Bodies(q, p / scale[:, None], args.get("G", 1.0) * jnp.pad(masses, tests), scale)


def vector(name: str, value: Any, args: Args, like: Array) -> Array:
    """The value of a parameter that is a vector, for each row of `like`. **Raises** `ValueError`
    for another shape."""
    value = value_of(value, args, like)
    return jnp.broadcast_to(array(name, value, like.shape[-1:])[None], like.shape)


class Force(eqx.Module):
    """A force W(t0, t1, q0, p1, args) on N bodies, or on a satellite.

    - N bodies: q and p have the shape (bodies, dim), and args has ``"masses"`` and ``"G"`` (1
      without it), as for `systems.n_body`, with test particles or without.
    - A satellite: q and p have the shape (dim,), p is the velocity, the attracting body is at the
      origin, and ``args["mu"]`` is G times its mass.

    ``f + g`` is the sum of two forces and ``a * f`` a force with a strength a, a number or a
    function of args. `add_to` adds a force to a problem.
    """

    @abc.abstractmethod
    def accelerations(self, t: Scalar, bodies: Bodies, args: Args) -> Array:
        """The accelerations of all bodies, shape (bodies, dim)."""

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> State:
        state = bodies_of(q0, p1, args)
        force = state.scale[:, None] * self.accelerations(t0, state, args)
        return force[1] if q0.ndim == 1 else force

    def __add__(self, other: Any) -> "Force":
        return NotImplemented if not isinstance(other, Force) else Sum((self, other))

    def __rmul__(self, strength: Any) -> "Force":
        return Multiple(strength, self)

    def add_to(self, problem: Problem, epsilon: float = 1.0) -> Problem:
        """The problem with this force, next to the forces that it has; ε of its runs is `epsilon`.

        Its known invariants and symmetries are those without this force.

        **Raises** `TypeError` for another object than a problem.
        """
        instance("problem", problem, Problem, "a problem of dvi_jax.systems")
        system = problem.system
        force = self if system.force is None else _Pair(system.force, system.epsilon, self)
        fields = {"perturbation": system.perturbation, "slow_time": system.slow_time}
        new_system = System(system.H_D, force=force, epsilon=epsilon, **fields)
        return dataclasses.replace(problem, system=new_system)


class Sum(Force):
    """The sum of forces."""

    terms: tuple[Force, ...]

    def accelerations(self, t, bodies, args):
        first, *others = (term.accelerations(t, bodies, args) for term in self.terms)
        return sum(others, first)


class Multiple(Force):
    """A force times a strength, which is a number or a function of args."""

    strength: Any
    force: Force

    def accelerations(self, t, bodies, args):
        factor = value_of(self.strength, args, bodies.x)
        return factor * self.force.accelerations(t, bodies, args)


class _Pair(eqx.Module):
    first: Any
    epsilon: Any
    second: Force

    def __call__(self, *step: Any) -> State:
        return self.epsilon * self.first(*step) + self.second(*step)


class Central(Force):
    """A force on bodies that depends on their motion relative to one of them, the centre.

    - `centre`: index of that body. `on_bodies`: indices of the bodies that the force acts on; None:
      all others.
    """

    centre: int = eqx.field(static=True, default=0, kw_only=True)
    on_bodies: tuple[int, ...] | None = eqx.field(static=True, default=None, kw_only=True)

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
        others = np.array([one_of("each of on_bodies", i, all_others) for i in indices])
        r, v = (x[others] - x[c][None] for x in (bodies.x, bodies.v))
        masses = bodies.masses[others]
        a = self.relative(t, r, v, bodies.masses[c], masses, args)
        result = jnp.zeros_like(bodies.x).at[others].set(a)
        if not self.has_recoil:
            return result
        return result.at[c].set(-jnp.sum(masses[:, None] * a, axis=0) / bodies.masses[c])
