r"""Full orbits in real space, and the guiding centres that belong to them.

B = ∇ψ × ∇θ + ι ∇ζ × ∇ψ is computed from the geometry alone: with X + iY = √s e^{iθ} and the
derivatives of the position x(X, Y, ζ)

    B = 2ψ_edge (∂x/∂ζ + ι (X ∂x/∂Y − Y ∂x/∂X))/(∂x/∂X · ∂x/∂Y × ∂x/∂ζ)

(X, Y, ζ) of a position are found by Newton's method from the axis. To first order in the gyroradius

    X_c = x − ρ,    ρ = b × v/Ω,    Ω = ZeB/m,
    u = v∥ − v∥ ρ·κ + (v⊥w + wv⊥):∇b/(4Ω) + v⊥²/(2Ω) b·∇×b,    w = v⊥ × b,    κ = b·∇b

and μ follows from the energy, u²/2 + μB(X_c) = v²/2: its correction is then that of the literature.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...base.checks import instance
from ...base.printing import printable
from ...engine.newton import Newton, find_root
from ...methods import Boris
from ...observe import Stop
from ...problem.discretise import discretise
from ...problem.system import System
from ._bounce import centre_of
from ._field import polynomial
from ._files import Geometry
from ._particles import GuidingCentres
from ._sums import total


@printable
class FullOrbits(eqx.Module):
    r"""Full orbits of the particles in Cartesian coordinates: q = x [m], p = v/v0.

        dx/dt = v,    dv/dt = v × B(x)/ρ,    ρ = m v0/(Ze),    t in m, as for `GuidingCentres`

    Run them with ``system``, ``method`` (`dvi.Boris`), ``h`` and ε = 1.

    **Arguments**

    - `particles`: `GuidingCentres` in a complete field. `geometry`: the `Geometry` of that field.

    **Raises** `TypeError` for other objects, `ValueError` for particles with `breaking`.

    **Accuracy** `from_centre` and `to_centre` have errors of second order in ε, gyroradius over
    scale length. B is divergence-free to round-off, and differs from the |B| of `particles.field`
    by the errors of both fits; |v| is conserved to round-off. Beyond s = 1 the polynomials are
    continued. Where no (s, θ, ζ) is found, B is NaN, and the status `not_finite`.

    **Source** Littlejohn 1983, *J. Plasma Phys.* 29, 111; Cary & Brizard 2009, *Rev. Mod. Phys.*
    81, 693, (5.22)–(5.33).
    """

    particles: GuidingCentres
    geometry: Geometry

    def __check_init__(self):
        instance("particles", self.particles, GuidingCentres, "GuidingCentres")
        instance("geometry", self.geometry, Geometry, "a Geometry, such as of read_geometry")
        if self.particles.breaking is not None:
            raise ValueError("particles must have a complete field: use particles.at_epsilon(ε).")

    def coordinates_of(self, x: Any) -> Array:
        """(s, θ, ζ) of one position x [m], shape (3,); NaN where they are not found."""
        X, Y, zeta = self._place(x)
        return jnp.stack([X * X + Y * Y, jnp.arctan2(Y, X), zeta])

    def _place(self, x: Any) -> Array:
        """(X, Y, ζ) of a position."""
        geometry = self.geometry
        R, phi = jnp.sqrt(x[0] ** 2 + x[1] ** 2), jnp.arctan2(x[1], x[0])
        guess = jnp.stack([0 * phi, 0 * phi, geometry.direction * phi])

        def defect(place):
            there, angle, height = self._cylindrical(place)
            return jnp.stack([there - R, height - x[2], angle - phi])

        place, info = find_root(defect, guess, jnp.ones_like(guess), Newton())
        return place * jnp.where(info.converged, 1.0, jnp.nan)

    def _cylindrical(self, place: Array) -> tuple[Array, Array, Array]:
        g = self.geometry
        R, Z, nu = (total(c, g.shape, *place) for c in (g.R, g.Z, g.nu))
        return R, g.direction * (place[2] - nu), Z

    def _position(self, place: Array) -> Array:
        R, phi, Z = self._cylindrical(place)
        return jnp.stack([R * jnp.cos(phi), R * jnp.sin(phi), Z])

    def field(self, x: Any) -> Array:
        """B [T] at one position x [m]: shape (3,)."""
        field, place = self.particles.field, self._place(x)
        by_x, by_y, by_zeta = jax.jacfwd(self._position)(place).T
        iota = polynomial(field.iota, place[0] ** 2 + place[1] ** 2)
        direction = by_zeta + iota * (place[0] * by_y - place[1] * by_x)
        return 2 * field.psi_edge * direction / jnp.sum(by_x * jnp.cross(by_y, by_zeta))

    @property
    def system(self) -> System:
        """The `System`: kinetic energy, and the Lorentz force as a force W."""
        return System(discretise(_kinetic), force=_Lorentz(self))

    @property
    def method(self) -> Boris:
        return Boris()

    @property
    def h(self) -> float:
        """1/64 of a gyration at the mean |B| of the axis [m]."""
        return float(2 * np.pi * abs(self.particles.rho) / self.particles.field.average / 64)

    @property
    def loss(self) -> Stop:
        """Ends a run where the particle itself reaches s = 1."""
        return Stop(_Outside(self))

    def _with_slopes(self, x: Any) -> tuple[Array, Array]:
        """B and ∂B_i/∂x_j at x."""
        slopes, B = jax.jacfwd(lambda x: (self.field(x),) * 2, has_aux=True)(x)
        return B, slopes

    def _local(self, B: Array, slopes: Array, u: Any, size: Any, phase: Any) -> tuple[Any, Any]:
        """ρ, and u − v∥ of first order, for v⊥ of this size and phase, in this field."""
        strength, (e1, e2) = jnp.sqrt(jnp.sum(B**2)), _frame(B)
        b, gyration = B / strength, strength / self.particles.rho
        matrix = (slopes - jnp.outer(b, b @ slopes)) / strength  # ∂b_i/∂x_j
        across = size * (jnp.cos(phase) * e1 + jnp.sin(phase) * e2)
        w, rho = jnp.cross(across, b), jnp.cross(b, across) / gyration
        shear = w @ matrix @ across + across @ matrix @ w
        # b·∇×b = e2·(e1·∇)b − e1·(e2·∇)b for b = e1 × e2.
        twist = e2 @ matrix @ e1 - e1 @ matrix @ e2
        correction = shear / (4 * gyration) + size**2 / (2 * gyration) * twist
        return rho, correction - u * (rho @ matrix @ b)

    @eqx.filter_jit
    def to_centre(self, x: Any, v: Any) -> tuple[Array, Array, dict, Array]:
        """(q, p, args) of the guiding centre of one particle at x [m] with v/v0, and the gyrophase:
        the angle of v⊥ from ẑ × b about b [rad]."""
        B, slopes = self._with_slopes(x)
        e1, e2 = _frame(B)
        parts = jnp.sum(v * e1), jnp.sum(v * e2), jnp.sum(v * jnp.cross(e1, e2))
        size, phase = jnp.sqrt(parts[0] ** 2 + parts[1] ** 2), jnp.arctan2(parts[1], parts[0])
        rho, correction = self._local(B, slopes, parts[2], size, phase)
        u, (s, theta, zeta) = parts[2] + correction, self.coordinates_of(x - rho)
        q, p, _ = self.particles.state(s, theta, zeta, u)
        strength = self.particles.field.strength(s, theta, zeta)
        return q, p, self.particles.args((jnp.sum(v**2) - u**2) / (2 * strength)), phase

    @eqx.filter_jit
    def from_centre(self, q: Any, p: Any, args: Any, phase: Any = 0.0) -> tuple[Array, Array]:
        """(x, v/v0) of one particle on the gyration of a guiding centre at a phase [rad]."""
        centre = centre_of(self.particles.chart, q, p, args, None)
        size = jnp.sqrt(2 * args["mu"] * centre.B)
        position = self.geometry.cartesian(centre.s, centre.theta, centre.zeta)
        B, slopes = self._with_slopes(position)
        rho, correction = self._local(B, slopes, centre.u, size, phase)
        x, parallel = position + rho, centre.u - correction
        B = self.field(x)
        e1, e2 = _frame(B)
        size = jnp.sqrt(2 * centre.energy - parallel**2)
        across = size * (jnp.cos(phase) * e1 + jnp.sin(phase) * e2)
        return x, parallel * jnp.cross(e1, e2) + across


def _frame(B: Array) -> tuple[Array, Array]:
    """Unit vectors e1 along ẑ × B and e2 = b × e1."""
    e1 = jnp.stack([-B[1], B[0], jnp.zeros_like(B[0])])
    e1 = e1 / jnp.sqrt(jnp.sum(e1**2))
    return e1, jnp.cross(B, e1) / jnp.sqrt(jnp.sum(B**2))


def _kinetic(q, p):
    return jnp.sum(p**2) / 2


class _Lorentz(eqx.Module):
    orbits: FullOrbits

    def __call__(self, t0, t1, q, p, args):
        return jnp.cross(p, self.orbits.field(q)) / self.orbits.particles.rho


class _Outside(eqx.Module):
    orbits: FullOrbits

    def __call__(self, t, q, p, args):
        return self.orbits.coordinates_of(q)[0] - 1
