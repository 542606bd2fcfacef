r"""Adiabatic invariants of a fast gyrating charge: moment, its first correction, bounce action.

The gyrofrequency is Ω = eB/m. With b = B/|B|, v∥ = v·b, v⊥ = v − v∥ b
and the position on the gyration ρ = b × v⊥/Ω, the moment μ0 = m v⊥²/(2|B|) changes as

    dμ0/dt = −(μ0/B) v⊥·∇B − (m v∥²/B) v⊥·κ − (m v∥/(2B)) (v⊥v⊥ − uu):∇b,    u = v⊥ × b,
    κ = (b·∇)b

(the other terms cancel by div B = 0). With dρ/dt = v⊥, dv⊥/dt = Ωu and du/dt = −Ωv⊥ to leading
order, each of the three is the derivative of a function that oscillates with the gyration. Minus
the sum of these functions is

    μ1 = (μ0/B) ρ·∇B + (m v∥²/B) ρ·κ − (m v∥/(4BΩ)) (v⊥u + uv⊥):∇b,

and μ0 + μ1 oscillates with an amplitude of second order in gyroradius over field scale length. This
requires b·(∇ × b) = 0, as in every axisymmetric field without an azimuthal component. A twisted
field adds a term −(μ0 v∥/Ω) b·(∇ × b), which does not oscillate.

**Source** derived here; the same terms: Littlejohn 1983, *J. Plasma Phys.* 29, 111; Cary & Brizard
2009, *Rev. Mod. Phys.* 81, 693.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ._problem import Adiabatic, Parameter, Problem, nonzero

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_HALVINGS = 54
"""Halvings of the interval that contains the mirror point, which give all its digits."""

PARTICLE = {"charge": Parameter(1.0, "e [charge]", nonzero), "mass": Parameter(1.0, "m [mass]")}


def adiabatic(small: str, smaller: Callable[[float], Problem]) -> dict[str, Adiabatic]:
    """The adiabatic invariants by name; `small`: gyroradius over field scale length, in words."""
    powers = {"magnetic_moment": 1, "corrected_moment": 2, "bounce_action": 2}
    return {name: Adiabatic(small, power, smaller) for name, power in powers.items()}


def parts(q: Any, mv: Any, field: Callable[[Any], Any], args: Any) -> tuple[Any, Any, Any, Any]:
    """|B|, b, v∥ and v⊥ of a particle at q with m v; `args` has its mass."""
    B = field(q)
    strength = jnp.sqrt(jnp.sum(B**2))
    b, v = B / strength, mv / args["mass"]
    parallel = jnp.sum(v * b)
    return strength, b, parallel, v - parallel * b


class ChargedParticle(NamedTuple):
    """A particle of ``args["charge"]`` and ``args["mass"]`` in a magnetic field B = ∇ × A with
    rotational symmetry about the axis z.

    - `potential_factor`: (q, args) → a of the vector potential A = a (−y, x, 0).
    - `B`: (q, args) → the field, shape (3,).
    """

    potential_factor: Callable[[Any, Any], Any]
    B: Callable[[Any, Any], Any]

    def vector_potential(self, q, args):
        """A = a (−y, x, 0): shape (3,)."""
        return _around_the_axis(self.potential_factor(q, args), q)

    def kinetic_momentum(self, q, p, args):
        """m v = p − e A(q): shape (3,)."""
        # Not e·A: the product of e with the zero of A would be computed.
        return p - _around_the_axis(args["charge"] * self.potential_factor(q, args), q)

    def hamiltonian(self, t0, t1, q0, p1, args):
        """H_D = |p1 − e A(q0)|²/(2m), with canonical momenta p = mv + eA: not separable."""
        return jnp.sum(self.kinetic_momentum(q0, p1, args) ** 2) / (2 * args["mass"])

    def magnetic_moment(self, t0, t1, q0, p0, q1, p1, args):
        """μ0 = m v⊥²/(2|B|) at t1, with B at the particle: the first adiabatic invariant.

        It oscillates at the gyrofrequency, by the order of gyroradius over field scale length.
        """
        strength, _, _, perpendicular = parts(q1, *self._momentum_and_field(q1, p1, args), args)
        return args["mass"] * jnp.sum(perpendicular**2) / (2 * strength)

    def corrected_moment(self, t0, t1, q0, p0, q1, p1, args):
        """μ0 + μ1 at t1, which oscillates by the second order in gyroradius over scale length."""
        return self.magnetic_moment(t0, t1, q0, p0, q1, p1, args) + first_correction(
            q1, *self._momentum_and_field(q1, p1, args), args
        )

    def centre(self, q, p, args):
        """The guiding centre q − ρ, shape (3,)."""
        mv, B = self.kinetic_momentum(q, p, args), self.B(q, args)
        return q - jnp.cross(B, mv) / (args["charge"] * jnp.sum(B**2))

    def _momentum_and_field(self, q, p, args):
        return self.kinetic_momentum(q, p, args), lambda q: self.B(q, args)


def _around_the_axis(size: Any, q: Any) -> Any:
    x, y, z = q
    return jnp.stack([-size * y, size * x, jnp.zeros_like(z)])


def first_correction(q: Any, mv: Any, field: Callable[[Any], Any], args: Any) -> Any:
    """μ1, as above [energy / field]; `field`: q → B, shape (3,); args: charge and mass."""
    m = args["mass"]
    strength, b, parallel, perpendicular = parts(q, mv, field, args)
    gyration = args["charge"] * strength / m
    u, rho = jnp.cross(perpendicular, b), jnp.cross(b, perpendicular) / gyration
    mu0 = m * jnp.sum(perpendicular**2) / (2 * strength)

    def strength_and_direction(x):
        B = field(x)
        size = jnp.sqrt(jnp.sum(B**2))
        return size, B / size

    def change(direction):
        return jax.jvp(strength_and_direction, (q,), (direction,))[1]

    (grow, _), (_, curvature) = change(rho), change(b)
    (_, change_across), (_, change_u) = change(perpendicular), change(u)
    shear = jnp.sum(u * change_across) + jnp.sum(perpendicular * change_u)
    return (
        mu0 * grow / strength
        + m * parallel**2 * jnp.sum(rho * curvature) / strength
        - m * parallel * shear / (4 * strength * gyration)
    )


def bounce_action(
    strength: Callable[[Any], Any], arc: Callable[[Any], Any], far: Any, E: Any, mu: Any, m: Any
) -> Any:
    r"""J = ∮ p∥ ds = 4 ∫_0^{s_m} √(2m (E − μB)) ds along a line that is symmetric about x = 0.

    - `strength`: |B| as a function of a coordinate x along the line, which increases from x = 0;
      `arc`: ds/dx. Both take arrays. `far`: an x beyond the mirror point, μB = E.
    - `E`: energy, `mu`: moment, `m`: mass.

    Relative error about 1e-12; zero where μB > E at x = 0. Not differentiable.
    **Source** Northrop 1963, *The Adiabatic Motion of Charged Particles*, 3.
    """
    limit = E / mu

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        is_inside = strength(middle) < limit
        return jnp.where(is_inside, middle, low), jnp.where(is_inside, high, middle)

    ends = (jnp.zeros_like(limit), far * jnp.ones_like(limit))
    mirror, _ = jax.lax.fori_loop(0, _HALVINGS, halve, ends)
    # With x = x_m sin θ the integrand is smooth at the mirror point, where p∥ has a root.
    theta = jnp.asarray(np.pi / 4 * (1 + _NODES), limit.dtype)
    weights = jnp.asarray(np.pi / 4 * _WEIGHTS, limit.dtype)
    x = mirror * jnp.sin(theta)
    momentum = jnp.sqrt(jnp.maximum(2 * m * (E - mu * strength(x)), 0.0))
    return 4 * jnp.sum(weights * momentum * arc(x) * mirror * jnp.cos(theta))
