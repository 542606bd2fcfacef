r"""Coordinates of N bodies around a first one, in which each moves nearly on a Kepler orbit.

Row 0 is always the centre of mass. A body of mass 0 is allowed everywhere but in row 0.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array


class Jacobi(NamedTuple):
    """Row 0 is the centre of mass; row i is body i relative to that of the bodies before it."""

    masses: Array  # (bodies,)

    def from_bodies(self, x: Array) -> Array:
        """Positions, velocities or accelerations of the bodies in these coordinates."""
        eta = jnp.cumsum(self.masses)[:, None]
        centres = jnp.cumsum(self.masses[:, None] * x, axis=0) / eta
        return jnp.concatenate([centres[-1:], x[1:] - centres[:-1]])

    def to_bodies(self, X: Array) -> Array:
        """The inverse of `from_bodies`."""
        # The centre of mass of the bodies up to each, from the outermost one inwards.
        part = (self.masses / jnp.cumsum(self.masses))[1:, None]
        outer = jnp.cumsum((part * X[1:])[::-1], axis=0)[::-1]
        centres = X[:1] - jnp.concatenate([outer, jnp.zeros_like(X[:1])])
        return centres + jnp.concatenate([jnp.zeros_like(X[:1]), (1 - part) * X[1:]])

    def central_mass(self) -> Array:
        """The mass at the centre of the Kepler orbit of each row but the first."""
        return jnp.cumsum(self.masses)[1:]

    velocities_of, velocities_back = from_bodies, to_bodies

    def drift(self, V: Array) -> Array:
        """dQ/dt of the part B."""
        return jnp.zeros_like(V)


class Democratic(NamedTuple):
    """Row 0 is the centre of mass, others are heliocentric positions and barycentric velocities."""

    masses: Array

    def from_bodies(self, x: Array) -> Array:
        return Heliocentric(self.masses).from_bodies(x)

    def to_bodies(self, X: Array) -> Array:
        return Heliocentric(self.masses).to_bodies(X)

    def central_mass(self) -> Array:
        return jnp.broadcast_to(self.masses[0], self.masses[1:].shape)

    def velocities_of(self, v: Array) -> Array:
        centre = _centre(self.masses, v)
        return jnp.concatenate([centre, v[1:] - centre])

    def velocities_back(self, V: Array) -> Array:
        return jnp.concatenate([V[:1] - self._recoil(V), V[:1] + V[1:]])

    def _recoil(self, V: Array) -> Array:
        momentum = jnp.sum(self.masses[1:, None] * V[1:], axis=0, keepdims=True)
        return momentum / self.masses[0]

    def drift(self, V: Array) -> Array:
        # The first body moves against the others: all heliocentric positions change by it.
        recoil = jnp.broadcast_to(self._recoil(V), V[1:].shape)
        return jnp.concatenate([jnp.zeros_like(V[:1]), recoil])


class Heliocentric(NamedTuple):
    """Positions and velocities relative to the first body."""

    masses: Array

    def from_bodies(self, x: Array) -> Array:
        return jnp.concatenate([_centre(self.masses, x), x[1:] - x[:1]])

    def to_bodies(self, X: Array) -> Array:
        part = self.masses[1:, None] / jnp.sum(self.masses)
        sun = X[:1] - jnp.sum(part * X[1:], axis=0, keepdims=True)
        return jnp.concatenate([sun, sun + X[1:]])

    def central_mass(self) -> Array:
        return self.masses[0] + self.masses[1:]

    velocities_of, velocities_back = from_bodies, to_bodies


class Barycentric(NamedTuple):
    """Positions and velocities relative to the centre of mass of all."""

    masses: Array

    def from_bodies(self, x: Array) -> Array:
        centre = _centre(self.masses, x)
        return jnp.concatenate([centre, x[1:] - centre])

    def to_bodies(self, X: Array) -> Array:
        opposite = jnp.sum(self.masses[1:, None] * X[1:], axis=0, keepdims=True)
        return X[:1] + jnp.concatenate([-opposite / self.masses[0], X[1:]])

    def central_mass(self) -> Array:
        return jnp.broadcast_to(jnp.sum(self.masses), self.masses[1:].shape)

    velocities_of, velocities_back = from_bodies, to_bodies


def _centre(masses: Array, x: Array) -> Array:
    return jnp.sum(masses[:, None] * x, axis=0, keepdims=True) / jnp.sum(masses)
