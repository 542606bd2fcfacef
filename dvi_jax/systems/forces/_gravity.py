"""Gravity beyond that of points: the shape of a body, other bodies, lost mass."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import array, finite, instance, known, positive, whole
from ...base.signature import check_takes, notes_of
from ...problem.flows import value_of
from ._base import Central, bodies_of, check_values, not_negative, quantity, time_scale


def _direction(name: str, force: Any, args: Any, r: Array) -> Array:
    """The unit vector along a parameter, in the dimensions of r."""
    vector = force.value(name, args, r, r.shape[-1:])
    return vector / jnp.sqrt(jnp.sum(vector * vector))


def _check_direction(name: str, vector: Any) -> None:
    if not (callable(vector) or any(map(is_traced, jax.tree.leaves(vector)))):
        positive(f"the length of {name}", np.sum(np.abs(known(name, vector, float))))


class Harmonics(Central):
    r"""The shape of the central body: zonal and tesseral harmonics of its potential.

        Φ = −(μ/r) Σ_{n≥2} (R/r)ⁿ Σ_m P_nm(sin φ) (C_nm cos mλ + S_nm sin mλ),    C_n0 = −J_n
        F_i = −m_i ∇Φ(x_i − x_0),    F_0 = −Σ F_i

    - `radius`: R [length]. `zonal`: {n: J_n}; `tesseral`: {(n, m): (C_nm, S_nm)}, not normalised
      (`normalised=True`: fully normalised, of both kinds). Numbers or functions of args.
    - `pole`: direction of the axis, shape (3,). `rate`: of the rotation [rad/time], and `angle` of
      the prime meridian at t = 0 [rad], from the node of the equator on the (x, y) plane, or from
      the x axis if the pole is z.

    In the plane the pole has two components, the equator contains the normal of the plane, and
    there are no tesseral harmonics.

    `energy` is Σ m_i Φ as a discrete Hamiltonian, for a `System` with `perturbation=`, of bodies
    with a mass.

    **Raises** `ValueError` for a degree below 2, or an order above the degree.

    **Source** Pines 1973, *AIAA J.* 11, 1508 (the recursion).
    """

    radius: Any = quantity(positive)
    zonal: Mapping[int, Any] = eqx.field(default_factory=dict)
    tesseral: Mapping[tuple[int, int], Any] = eqx.field(default_factory=dict)
    pole: Any = quantity(finite, default=(0.0, 0.0, 1.0))
    rate: Any = quantity(finite, default=0.0)
    angle: Any = quantity(finite, default=0.0)
    normalised: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        instance("zonal", self.zonal, Mapping, "a dict {n: J_n}")
        instance("tesseral", self.tesseral, Mapping, "a dict {(n, m): (C_nm, S_nm)}")
        for key in self.tesseral:
            array("each key (n, m) of tesseral", known("tesseral", key), (2,), integers=True)
        for n, m in [*((n, 0) for n in self.zonal), *self.tesseral]:
            whole("the degree of a harmonic", n, 2)
            whole("the order of a harmonic", m, 0, n)
        for key, value in [*self.zonal.items(), *self.tesseral.items()]:
            check_values(f"harmonic {key}", value, finite)
        _check_direction("pole of forces.Harmonics", self.pole)

    def relative(self, t, r, v, mu, masses, args):
        axes = self._axes(t, r, args)
        return -jax.vmap(jax.grad(lambda r: self._potential(r, axes, mu, args)))(r)

    def energy(self, t0, t1, q0, p1, args):
        """Σ m_i Φ(x_i − x_0) [mass length²/time²]."""
        state = bodies_of(q0, p1, args)
        r = jnp.delete(state.x, self.centre, axis=0) - state.x[self.centre][None]
        axes, mu = self._axes(t0, r, args), state.masses[self.centre]
        potentials = jax.vmap(lambda r: self._potential(r, axes, mu, args))(r)
        return jnp.sum(jnp.delete(state.scale, self.centre) * potentials)

    def _axes(self, t: Any, r: Array, args: Any) -> Array:
        """The axes of the body, as rows."""
        z = _direction("pole", self, args, r)
        z = jnp.pad(z, (0, 3 - len(z)))
        level = jnp.sqrt(z[0] * z[0] + z[1] * z[1])
        is_up = level == 0
        inverse = 1 / jnp.where(is_up, 1.0, level)
        node = jnp.stack(
            [jnp.where(is_up, 1.0, -z[1] * inverse), z[0] * inverse, jnp.zeros_like(inverse)]
        )
        angle = self.value("angle", args, r) + self.value("rate", args, r) * t
        cosine, sine, other = jnp.cos(angle), jnp.sin(angle), jnp.cross(z, node)
        return jnp.stack([cosine * node + sine * other, cosine * other - sine * node, z])

    def _potential(self, r: Array, axes: Array, mu: Array, args: Any) -> Array:
        x, y, z = axes[:, : len(r)] @ r
        distance = jnp.sqrt(jnp.sum(r * r))
        s, ratio = z / distance, self.value("radius", args, r) / distance
        terms: dict[tuple[int, int], Any] = {}
        for n, J in self.zonal.items():
            terms[n, 0] = (-array(f"harmonic {n}", value_of(J, args, r), ()), 0.0)
        for (n, m), pair in self.tesseral.items():
            array("positions with tesseral harmonics", r, (3,))
            C, S = array(f"harmonic {(n, m)}", value_of(pair, args, r), (2,))
            of_zonal, _ = terms.get((n, m), (0.0, 0.0))
            terms[n, m] = (of_zonal + C, S)
        total = jnp.zeros_like(distance)
        for m in sorted({m for _, m in terms}):
            # cos^m φ (cos mλ, sin mλ) = (x + iy)^m/r^m, without the angle λ
            real, imaginary = jnp.ones_like(s), jnp.zeros_like(s)
            for _ in range(m):
                real, imaginary = (x * real - y * imaginary, x * imaginary + y * real)
                real, imaginary = real / distance, imaginary / distance
            P = _legendre(s, m, max(n for n, k in terms if k == m))
            for n in sorted(n for n, k in terms if k == m):
                C, S = terms[n, m]
                unit = _norm(n, m) if self.normalised else 1.0
                total = total + unit * ratio**n * P[n] * (C * real + S * imaginary)
        return -mu / distance * total


def _legendre(s: Array, m: int, degree: int) -> dict[int, Array]:
    """P_nm(s)/cosᵐ φ for n up to `degree`."""
    P = {m - 1: jnp.zeros_like(s), m: jnp.full_like(s, math.prod(range(1, 2 * m, 2)))}
    for n in range(m + 1, degree + 1):
        P[n] = ((2 * n - 1) * s * P[n - 1] - (n + m - 1) * P[n - 2]) / (n - m)
    return P


def _norm(n: int, m: int) -> float:
    ratio = math.factorial(n - m) / math.factorial(n + m)
    return math.sqrt((2 - (m == 0)) * (2 * n + 1) * ratio)


class ThirdBody(Central):
    r"""The attraction of a body with a known path, on bodies around the centre.

        a = μ [(d − r)/|d − r|³ − d/|d|³]

    - `path`: function ``(t, args)`` → d, the position relative to the centre, shape (dim,).
    - `mu`: G times its mass [length³/time²], a number or a function of args.

    **Source** Battin 1999, *Mathematics and Methods of Astrodynamics*, 8.4: the form without
    cancellation.
    """

    path: Any
    mu: Any = quantity(not_negative)

    has_recoil: ClassVar[bool] = False

    def __check_init__(self):
        check_takes("path of ThirdBody", self.path, "(t, args)")

    def relative(self, t, r, v, mu, masses, args):
        with notes_of("path of ThirdBody"):
            d = jnp.asarray(self.path(t, args), r.dtype)
        d = jnp.broadcast_to(array("path of ThirdBody", d, r.shape[-1:], verb="return"), r.shape)
        x = jnp.sum(r * (r - 2 * d), -1, keepdims=True) / jnp.sum(d * d, -1, keepdims=True)
        difference = x * (3 + x * (3 + x)) / (1 + (1 + x) * jnp.sqrt(1 + x))
        apart = jnp.sqrt(jnp.sum((r - d) ** 2, -1, keepdims=True))
        return -self.value("mu", args, r) / apart**3 * (r + difference * d)


class GalacticTide(Central):
    r"""The tide of a disk of stars, relative to the centre: a = −4πGρ (r·n) n.

    - `strength`: 4πGρ [1/time²], a number or a function of args. `pole`: n, normal to the disk.

    **Source** Heisler & Tremaine 1986, *Icarus* 65, 13: the largest of its terms.
    """

    strength: Any = quantity(not_negative)
    pole: Any = quantity(finite, default=(0.0, 0.0, 1.0))

    has_recoil: ClassVar[bool] = False

    def __check_init__(self):
        _check_direction("pole of forces.GalacticTide", self.pole)

    def relative(self, t, r, v, mu, masses, args):
        n = _direction("pole", self, args, r)[None]
        return -self.value("strength", args, r) * jnp.sum(r * n, -1, keepdims=True) * n


class MassLoss(Central):
    r"""A central mass that changes as m_0 e^{t/τ}: a = −μ (e^{t/τ} − 1) r/r³, next to Newton's law.

    - `timescale`: τ [time], negative for a loss; a number or a function of args.

    The mass leaves with the velocity of the centre, whose own motion does not change.

    **Source** Hadjidemetriou 1963, *Icarus* 2, 440.
    """

    timescale: Any = quantity(time_scale)

    has_recoil: ClassVar[bool] = False

    def relative(self, t, r, v, mu, masses, args):
        distance = jnp.sqrt(jnp.sum(r * r, -1, keepdims=True))
        return -mu * jnp.expm1(t / self.value("timescale", args, r)) / distance**3 * r
