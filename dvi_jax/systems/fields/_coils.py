"""The field of Biot and Savart of thin coils: smooth curves and polygons."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...base.checks import array, whole
from ...base.printing import printable

_SCALE = 1e-7
"""μ0/4π [T m/A], the exact value of the SI before 2019, which differs by 1.3e-10 from the present
one; simsopt and makegrid have the same."""


def _displacement(q: Array, places: Array) -> Array:
    """q − r of all sources r: shape (3, coils, points)."""
    return jnp.stack([q[i] - places[..., i] for i in range(3)])


def _total(currents: Array, sources: Array) -> Array:
    """Σ I s over all coils and points, with the μ0/4π of the field: shape (3,)."""
    return _SCALE * jnp.tensordot(jnp.sum(sources, axis=-1), currents, 1)


@printable
class Filaments(eqx.Module):
    r"""Coils along smooth closed curves, by the trapezoidal rule (made by `from_fourier`).

        A(q) = μ0/4π Σ I Σ_k r'_k Δθ/|q − r_k|
        B(q) = μ0/4π Σ I Σ_k r'_k Δθ × (q − r_k)/|q − r_k|³

    B is ∇ × A, and has no divergence, for any number of points.

    **Arguments**

    - `points`: r_k [m], at equal distances in θ, and `tangents`: r'_k Δθ [m], both of shape
      (coils, points, 3).
    - `currents`: I [A], shape (coils,).

    All arrays are differentiable. Give the coils to H in `args`: the run is then differentiable
    with respect to them, too.

    **Raises** `ValueError` for other shapes.

    **Accuracy** the error relative to that of the smooth curve decreases as exp(−n d/R), with n
    points of a coil of radius R at the distance d from it: close to a coil many points are needed.

    **Source** Jackson 1999, *Classical Electrodynamics*, 5.
    """

    points: Float[Array, "coils points 3"] = eqx.field(converter=jnp.asarray)
    tangents: Float[Array, "coils points 3"] = eqx.field(converter=jnp.asarray)
    currents: Float[Array, " coils"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        count = array("points", self.points, ("coils", "points", 3)).shape[:2]
        array("tangents", self.tangents, (*count, 3))
        array("currents", self.currents, count[:1])

    def vector_potential(self, q: Any) -> Array:
        """A [T m] at a position [m], both of shape (3,)."""
        offset = _displacement(jnp.asarray(q), self.points)
        inverse = 1 / jnp.sqrt(jnp.sum(offset * offset, axis=0))
        return _total(self.currents, jnp.moveaxis(self.tangents, -1, 0) * inverse[None])

    def magnetic_field(self, q: Any) -> Array:
        """B [T] at a position [m], both of shape (3,)."""
        offset = _displacement(jnp.asarray(q), self.points)
        square = jnp.sum(offset * offset, axis=0)
        normal = jnp.cross(jnp.moveaxis(self.tangents, -1, 0), offset, axis=0)
        return _total(self.currents, normal * (1 / (square * jnp.sqrt(square)))[None])


def from_fourier(cosines: Any, sines: Any, currents: Any, num_points: int = 128) -> Filaments:
    r"""`Filaments` from Fourier series of coils,

        r(θ) = Σ_m [c_m cos mθ + s_m sin mθ],    θ = 2πk/num_points

    - `cosines`, `sines`: c_m and s_m [m] for m = 0, 1, …, shape (coils, orders, 3). s_0 is not
      used.
    - `currents`: [A], shape (coils,), in the direction of increasing θ.

    simsopt stores them as s_1, c_1, s_2, … after c_0, for each of x, y, z in turn.

    **Raises** `ValueError` for other shapes.
    """
    c, s, currents = (jnp.asarray(x, float) for x in (cosines, sines, currents))
    array("cosines", c, ("coils", "orders", 3))
    array("sines", s, c.shape)
    array("currents", currents, c.shape[:1])
    n = whole("num_points", num_points, 3)
    order = jnp.arange(c.shape[1], dtype=c.dtype)
    angles = order[:, None] * (2 * jnp.pi / n * jnp.arange(n, dtype=c.dtype))[None]
    cos, sin = jnp.cos(angles), jnp.sin(angles)
    slope = 2 * jnp.pi / n * order[:, None]

    def sums(of_cosines, of_sines):
        return jnp.einsum("cmi,mk->cki", c, of_cosines) + jnp.einsum("cmi,mk->cki", s, of_sines)

    return Filaments(sums(cos, sin), sums(-slope * sin, slope * cos), currents)


@printable
class Polylines(eqx.Module):
    r"""Coils of straight wires from point to point, whose field is known in closed form.

        A = μ0/4π Σ I e log((a + b + ℓ)/(a + b − ℓ)),    B = ∇ × A

    for each wire of the direction e and the length ℓ, at the distances a and b of its ends.

    **Arguments**

    - `points`: [m], shape (coils, points, 3). The last one is not joined to the first: repeat the
      first in a closed coil. (The B of an open one has a curl in the space outside the wires.)
    - `currents`: [A], shape (coils,).

    **Raises** `ValueError` for other shapes.

    **Accuracy** exact for wires. A polygon instead of a smooth curve has an error O(points⁻²).

    **Source** Hanson & Hirshman 2002, *Phys. Plasmas* 9, 4410, equations (8) and (9).
    """

    points: Float[Array, "coils points 3"] = eqx.field(converter=jnp.asarray)
    currents: Float[Array, " coils"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        array("points", self.points, ("coils", "points", 3))
        array("currents", self.currents, self.points.shape[:1])

    def _wires(self, q: Any) -> tuple[Array, ...]:
        offset = _displacement(jnp.asarray(q), self.points)
        distance = jnp.sqrt(jnp.sum(offset * offset, axis=0))
        wire = jnp.moveaxis(self.points[:, 1:] - self.points[:, :-1], -1, 0)
        length = jnp.sqrt(jnp.sum(wire * wire, axis=0))
        return wire, length, offset[..., :-1], distance[:, :-1], distance[:, 1:]

    def vector_potential(self, q: Any) -> Array:
        """A [T m] at a position [m], both of shape (3,)."""
        wire, length, _, start, end = self._wires(q)
        size = jnp.log1p(2 * length / (start + end - length)) / length
        return _total(self.currents, wire * size[None])

    def magnetic_field(self, q: Any) -> Array:
        """B [T] at a position [m], both of shape (3,)."""
        wire, length, offset, start, end = self._wires(q)
        path = start + end
        size = 2 * path / (start * end * (path**2 - length**2))
        return _total(self.currents, jnp.cross(wire, offset, axis=0) * size[None])
