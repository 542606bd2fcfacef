"""Gravity beyond that of points: the shape of a body, other bodies, lost mass, relativity."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ...base.checks import function, whole
from ...problem.flows import value_of
from ._base import Central, bodies_of, vector


class Harmonics(Central):
    r"""The shape of the central body: zonal and tesseral harmonics of its potential.

        Φ = −(μ/r) Σ_{n≥2} (R/r)ⁿ Σ_m P_nm(sin φ) (C_nm cos mλ + S_nm sin mλ),    C_n0 = −J_n
        F_i = −m_i ∇Φ(x_i − x_0),    F_0 = −Σ F_i

    - `radius`: R [length]. `zonal`: {n: J_n}; `tesseral`: {(n, m): (C_nm, S_nm)}, not normalised
      (`normalised=True`: fully normalised, of both kinds). Numbers or functions of args.
    - `pole`: direction of the axis, shape (3,). `rate`: of the rotation [rad/time], and `angle` of
      the prime meridian at t = 0 [rad], from the node of the equator on the (x, y) plane, or from
      the x axis if the pole is z.

    `energy` is Σ m_i Φ as a discrete Hamiltonian, for a `System` with `perturbation=`, of bodies
    with a mass.

    **Raises** `ValueError` for a degree below 2, or an order above the degree.

    **Source** Pines 1973, *AIAA J.* 11, 1508 (the recursion).
    """

    radius: Any
    zonal: Mapping[int, Any] = eqx.field(default_factory=dict)
    tesseral: Mapping[tuple[int, int], Any] = eqx.field(default_factory=dict)
    pole: Any = (0.0, 0.0, 1.0)
    rate: Any = 0.0
    angle: Any = 0.0
    normalised: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        for n, m in [*((n, 0) for n in self.zonal), *self.tesseral]:
            whole("the degree of a harmonic", n, 2)
            whole("the order of a harmonic", m, 0, n)

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
        pole = vector("pole of Harmonics", self.pole, args, r)[0]
        z = pole / jnp.sqrt(jnp.sum(pole * pole))
        level = jnp.sqrt(z[0] * z[0] + z[1] * z[1])
        is_up = level == 0
        inverse = 1 / jnp.where(is_up, 1.0, level)
        node = jnp.stack(
            [jnp.where(is_up, 1.0, -z[1] * inverse), z[0] * inverse, jnp.zeros_like(inverse)]
        )
        angle = value_of(self.angle, args, r) + value_of(self.rate, args, r) * t
        cosine, sine, other = jnp.cos(angle), jnp.sin(angle), jnp.cross(z, node)
        return jnp.stack([cosine * node + sine * other, cosine * other - sine * node, z])

    def _potential(self, r: Array, axes: Array, mu: Array, args: Any) -> Array:
        x, y, z = axes @ r
        distance = jnp.sqrt(jnp.sum(r * r))
        s, ratio = z / distance, value_of(self.radius, args, r) / distance
        terms: dict[tuple[int, int], Any] = {}
        for n, J in self.zonal.items():
            terms[n, 0] = (-value_of(J, args, r), 0.0)
        for (n, m), pair in self.tesseral.items():
            C, S = value_of(pair, args, r)
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
    mu: Any

    has_recoil: ClassVar[bool] = False

    def __check_init__(self):
        function("path of ThirdBody", self.path, "(t, args)")

    def relative(self, t, r, v, mu, masses, args):
        d = vector("the value of path of ThirdBody", self.path(t, args), args, r)
        x = jnp.sum(r * (r - 2 * d), -1, keepdims=True) / jnp.sum(d * d, -1, keepdims=True)
        difference = x * (3 + x * (3 + x)) / (1 + (1 + x) * jnp.sqrt(1 + x))
        apart = jnp.sqrt(jnp.sum((r - d) ** 2, -1, keepdims=True))
        return -value_of(self.mu, args, r) / apart**3 * (r + difference * d)


class GalacticTide(Central):
    r"""The tide of a disk of stars, relative to the centre: a = −4πGρ (r·n) n.

    - `strength`: 4πGρ [1/time²], a number or a function of args. `pole`: n, normal to the disk.

    **Source** Heisler & Tremaine 1986, *Icarus* 65, 13: the largest of its terms.
    """

    strength: Any
    pole: Any = (0.0, 0.0, 1.0)

    has_recoil: ClassVar[bool] = False

    def relative(self, t, r, v, mu, masses, args):
        pole = vector("pole of GalacticTide", self.pole, args, r)
        n = pole / jnp.sqrt(jnp.sum(pole * pole, -1, keepdims=True))
        return -value_of(self.strength, args, r) * jnp.sum(r * n, -1, keepdims=True) * n


class MassLoss(Central):
    r"""A central mass that changes as m_0 e^{t/τ}: a = −μ (e^{t/τ} − 1) r/r³, next to Newton's law.

    - `timescale`: τ [time], negative for a loss; a number or a function of args.

    The mass leaves with the velocity of the centre, whose own motion does not change.

    **Source** Hadjidemetriou 1963, *Icarus* 2, 440.
    """

    timescale: Any

    has_recoil: ClassVar[bool] = False

    def relative(self, t, r, v, mu, masses, args):
        distance = jnp.sqrt(jnp.sum(r * r, -1, keepdims=True))
        return -mu * jnp.expm1(t / value_of(self.timescale, args, r)) / distance**3 * r


class Relativity(Central):
    r"""General relativity of the central mass in harmonic coordinates, to first order in 1/c².

        a = μ/(c² r³) [(4 μ/r − v²) r + 4 (r·v) v]

    - `c`: the velocity of light [length/time], a number or a function of args.

    The centre feels nothing: total momentum changes by a fraction m_i/m_0 of the force.

    **Source** see `dvi_jax.systems.planets.relativity.post_newtonian_force`.
    """

    c: Any

    has_recoil: ClassVar[bool] = False

    def relative(self, t, r, v, mu, masses, args):
        distance = jnp.sqrt(jnp.sum(r * r, -1, keepdims=True))
        rv, v2 = jnp.sum(r * v, -1, keepdims=True), jnp.sum(v * v, -1, keepdims=True)
        size = mu / (value_of(self.c, args, r) ** 2 * distance**3)
        return size * ((4 * mu / distance - v2) * r + 4 * rv * v)


class LenseThirring(Central):
    r"""The rotation of the central mass in general relativity: a = 2 Ω × v.

        Ω = (2/(c² r³)) [3 (J·r) r/r² − J]/2 · G

    - `momentum`: G J, G times the angular momentum of the centre [length⁵/time³], shape (3,).
    - `c`: the velocity of light [length/time]. Numbers or functions of args.

    **Source** IERS Conventions 2010, (10.12).
    """

    momentum: Any
    c: Any

    has_recoil: ClassVar[bool] = False

    def relative(self, t, r, v, mu, masses, args):
        J = vector("momentum of LenseThirring", self.momentum, args, r)
        r2 = jnp.sum(r * r, -1, keepdims=True)
        radial = 3 * jnp.sum(J * r, -1, keepdims=True) / r2 * r
        return 2 / (value_of(self.c, args, r) ** 2 * r2**1.5) * jnp.cross(radial - J, v)
