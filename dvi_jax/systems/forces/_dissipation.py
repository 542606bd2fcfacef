"""Forces that change energies: tides, radiation, drag, migration, outgassing."""

import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from ...base.checks import array, finite, positive
from ...base.signature import check_takes, notes_of
from ._base import Central, not_negative, quantity, time_scale


class Tides(Central):
    r"""Tides that the bodies raise on the central one, with a constant time lag.

        a_i = −3 G m_i k₂ R⁵/r⁸ [r + 3 τ (r·v) r/r² + τ (v_⊥ − Ω × r)],    v_⊥ = v − (r·v) r/r²

    and the opposite force on the centre.

    - `k2`: Love number of the potential; `lag`: τ [time]; `radius`: R [length], of the centre.
    - `spin`: Ω of the centre [rad/time], shape (3,). Numbers or functions of args.

    **Source** Hut 1981, *Astron. Astrophys.* 99, 126; Bolmont et al. 2015, *Astron. Astrophys.*
    583, A116.
    """

    k2: Any = quantity(not_negative)
    lag: Any = quantity(not_negative)
    radius: Any = quantity(positive)
    spin: Any = quantity(finite, default=(0.0, 0.0, 0.0))

    def relative(self, t, r, v, mu, masses, args):
        k2, lag, radius = (self.value(name, args, r) for name in ("k2", "lag", "radius"))
        r2, rv = (jnp.sum(r * x, -1, keepdims=True) for x in (r, v))
        size = 3 * masses[:, None] * k2 * radius**5 / r2**4
        spin = jnp.broadcast_to(self.value("spin", args, r, (3,)), (len(r), 3))
        if r.shape[-1] == 2:  # a plane orbit: the spin about z
            turn = spin[:, 2:] * jnp.stack([-r[:, 1], r[:, 0]], -1)
        else:
            turn = jnp.cross(spin, r)
        return -size * (r + lag * (2 * rv / r2 * r + v - turn))


class Radiation(Central):
    r"""Pressure of radiation and Poynting–Robertson drag.

        a = β μ/r² [(1 − ṙ/c) r/r − v/c]

    - `beta`: pressure over attraction, of all bodies or of each, shape (k,). `c`: the velocity of
      light [length/time]. Numbers or functions of args.

    **Source** Burns, Lamy & Soter 1979, *Icarus* 40, 1, (5).
    """

    beta: Any = quantity(not_negative)
    c: Any = quantity(positive)

    has_recoil: ClassVar[bool] = False

    def relative(self, t, r, v, mu, masses, args):
        beta, c, r2 = (
            self.each("beta", args, r),
            self.value("c", args, r),
            jnp.sum(r * r, -1, keepdims=True),
        )
        unit = r / jnp.sqrt(r2)
        rate = jnp.sum(unit * v, -1, keepdims=True)
        return beta * mu / r2 * ((1 - rate / c) * unit - v / c)


class Damping(Central):
    r"""Migration and damping: relative acceleration v/(2 τ_a) + 2 (v·r) r/(r² τ_e) + 2 v_z/τ_i.

    - `tau_a`, `tau_e`, `tau_inc`: e-folding times [time] of semi-major axis, eccentricity and
      inclination to the (x, y) plane, of all bodies or of each, shape (k,). They are negative where
      the element decreases, as in REBOUNDx. Numbers or functions of args; infinite: no change.

    The centre feels the opposite force, so that the centre of mass stays at rest. The rates hold
    for small e and i, averaged over an orbit.

    **Source** Papaloizou & Larwood 2000, *MNRAS* 315, 823; Kostov et al. 2016, *Astrophys. J.* 832,
    183.
    """

    tau_a: Any = quantity(time_scale, default=math.inf)
    tau_e: Any = quantity(time_scale, default=math.inf)
    tau_inc: Any = quantity(time_scale, default=math.inf)

    def relative(self, t, r, v, mu, masses, args):
        names = "tau_a", "tau_e", "tau_inc"
        of_a, of_e, of_inc = (1 / self.each(name, args, r) for name in names)
        rv, r2 = jnp.sum(r * v, -1, keepdims=True), jnp.sum(r * r, -1, keepdims=True)
        a = of_a / 2 * v + 2 * rv / r2 * of_e * r
        a = a.at[:, 2:].add(2 * of_inc * v[:, 2:])
        # The share of the body in the relative acceleration; the centre has the rest.
        return (mu / (mu + masses))[:, None] * a


class Drag(Central):
    r"""Drag of an atmosphere that rotates with the centre: a = −B ρ |w| w/2, w = v − ω × r.

    - `density`: function ``(r, args)`` → ρ [mass/length³] at r, shape (dim,), from the centre.
    - `ballistic`: B = C_d A/m [length²/mass]. `rate`: ω about z [rad/time]. Numbers or functions of
      args.

    **Source** Montenbruck & Gill 2000, *Satellite Orbits*, 3.5.
    """

    density: Any
    ballistic: Any = quantity(not_negative)
    rate: Any = quantity(finite, default=0.0)

    has_recoil: ClassVar[bool] = False

    def __check_init__(self):
        check_takes("density of Drag", self.density, "(r, args)")

    def relative(self, t, r, v, mu, masses, args):
        def density(r):
            with notes_of("density of Drag"):
                value = jnp.asarray(self.density(r, args), r.dtype)
            return array("density of Drag", value, (), verb="return")

        rate, rho = self.value("rate", args, r), jax.vmap(density)(r)[:, None]
        wind = jnp.zeros_like(r).at[:, 0].set(-rate * r[:, 1]).at[:, 1].set(rate * r[:, 0])
        w = v - wind
        speed = jnp.sqrt(jnp.sum(w * w, -1, keepdims=True))
        return -self.value("ballistic", args, r) / 2 * rho * speed * w


class Outgassing(Central):
    r"""Non-gravitational acceleration of comets and asteroids, Yarkovsky's effect.

        a = (r₀/r)ⁿ (A₁ r̂ + A₂ t̂ + A₃ n̂),    n̂ along r × v, t̂ = n̂ × r̂

    - `A1`, `A2`, `A3` [length/time²] at the distance `r0` [length]; `power`: n, 2 for radiation.
      Numbers or functions of args. Yarkovsky's effect is A₂ with n = 2.

    **Source** Marsden, Sekanina & Yeomans 1973, *Astron. J.* 78, 211; Farnocchia et al. 2013,
    *Icarus* 224, 1.
    """

    A1: Any = quantity(finite, default=0.0)
    A2: Any = quantity(finite, default=0.0)
    A3: Any = quantity(finite, default=0.0)
    r0: Any = quantity(positive, default=1.0)
    power: Any = quantity(finite, default=2.0)

    has_recoil: ClassVar[bool] = False

    def relative(self, t, r, v, mu, masses, args):
        names = "A1", "A2", "A3", "r0", "power"
        A1, A2, A3, r0, power = (self.value(name, args, r) for name in names)
        if r.shape[-1] == 2:
            zeros = jnp.zeros_like(r[:, :1])
            r3, v3 = (jnp.concatenate([x, zeros], -1) for x in (r, v))
        else:
            r3, v3 = r, v
        distance = jnp.sqrt(jnp.sum(r3 * r3, -1, keepdims=True))
        L = jnp.cross(r3, v3)
        radial, normal = r3 / distance, L / jnp.sqrt(jnp.sum(L * L, -1, keepdims=True))
        size = (r0 / distance) ** power
        a = A1 * radial + A2 * jnp.cross(normal, radial) + A3 * normal
        return (size * a)[:, : r.shape[-1]]
