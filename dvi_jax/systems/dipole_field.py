"""Störmer's problem: a charged particle in the field of a magnetic dipole."""

import jax.numpy as jnp
import numpy as np

from ..discover.symmetries.library import rotation
from . import _guiding_centre as guiding_centre
from ._problem import Parameter, Problem, Start, bound, library_problem, nonzero, positive


def potential_factor(q, args):
    """a = −B0 R³/r³ of A = a (−y, x, 0), of a dipole along −z, as the Earth's."""
    return -args["B0"] * args["radius"] ** 3 / jnp.sum(q**2) ** 1.5


def magnetic_field(q, args):
    """B = B0 R³ (q r² ∂z/∂q − 3 z q)/r⁵ = B0 R³ (−3xz, −3yz, r² − 3z²)/r⁵: B0 ẑ at r = R, z = 0."""
    r2 = jnp.sum(q**2)
    axis = jnp.stack([jnp.zeros_like(r2), jnp.zeros_like(r2), r2])
    return args["B0"] * args["radius"] ** 3 / r2**2.5 * (axis - 3 * q[2] * q)


_particle = guiding_centre.ChargedParticle(potential_factor, magnetic_field)
kinetic_momentum, hamiltonian = _particle.kinetic_momentum, _particle.hamiltonian
magnetic_moment, corrected_moment = _particle.magnetic_moment, _particle.corrected_moment


def stoermer_integral(t0, t1, q0, p0, q1, p1, args):
    """p_φ = x p_y − y p_x at t1: Störmer's integral, conserved by rotational symmetry."""
    return q1[0] * p1[1] - q1[1] * p1[0]


def bounce_action(t0, t1, q0, p0, q1, p1, args):
    r"""The longitudinal invariant at t1, the second adiabatic one [action].

        J = ∮ p∥ ds = 2 ∫ √(2m (E − μB)) ds,    from mirror point to mirror point and back

    along the field line r = L cos² λ of the guiding centre q − b × v/Ω, with
    B = |B0| (R/L)³ √(1 + 3 sin² λ)/cos⁶ λ, ds = L cos λ √(1 + 3 sin² λ) dλ and μ the
    `corrected_moment`. Zero where the mirror point is at the equator. Not differentiable.

    **Source** Northrop 1963, *The Adiabatic Motion of Charged Particles*, 3.
    """
    m, mv = args["mass"], kinetic_momentum(q1, p1, args)
    centre = _particle.centre(q1, p1, args)
    L = jnp.sum(centre**2) ** 1.5 / jnp.sum(centre[:2] ** 2)
    at_equator = jnp.abs(args["B0"]) * (args["radius"] / L) ** 3

    def strength(latitude):
        return at_equator * jnp.sqrt(1 + 3 * jnp.sin(latitude) ** 2) / jnp.cos(latitude) ** 6

    def arc(latitude):
        return L * jnp.cos(latitude) * jnp.sqrt(1 + 3 * jnp.sin(latitude) ** 2)

    E = jnp.sum(mv**2) / (2 * m)
    mu = corrected_moment(t0, t1, q0, p0, q1, p1, args)
    return guiding_centre.bounce_action(strength, arc, jnp.pi / 2, E, mu, m)


def dipole_field(radius: float = 50.0) -> Problem:
    """A charged particle trapped in a dipole field: it nonzero, bounces and drifts in longitude.

    Dimensionless: e = m = B0 = 1, so that gyrofrequency and gyroradius at the start are 1; it
    starts at the equator at r ≈ R with its velocity at 45° to the field.

    - `radius`: R over the gyroradius. In units of Störmer's length it appears only in the initial
      conditions.

    **Raises** `ValueError` for a radius that is not positive.

    **Source** Störmer 1907, *Arch. Sci. Phys. Nat.* 24, 5; Northrop 1963, *The Adiabatic Motion of
    Charged Particles*; field, initial conditions and step are ours.
    """
    radius = positive("radius", radius)
    v0, A = np.array([0.6, -0.8, 1.0]), np.array([0.0, -radius, 0.0])  # A at q0
    dipole = {"the dipole": (0, 0, 0)}
    return library_problem(
        hamiltonian,
        Start("the dipole field holds one particle in space", (3,), singular=dipole),
        name="dipole_field",
        q0_p0_h=(np.array([radius, 0.0, 0.0]), v0 + A, 0.1),
        parameters={
            **guiding_centre.PARTICLE,
            "B0": Parameter(1.0, "field at r = radius, equator [mass/(charge time)]", nonzero),
            "radius": Parameter(radius, "R, where the field is B0 [length]"),
        },
        observables=[stoermer_integral, magnetic_moment, corrected_moment, bounce_action],
        units={"q": "1", "p": "1", "t": "1/gyrofrequency", "energy": "1"},
        source="Störmer 1907, Arch. Sci. Phys. Nat. 24, 5; Northrop 1963",
        invariants=("stoermer_integral",),
        adiabatic=guiding_centre.adiabatic("gyroradius over R", bound(_smaller, radius)),
        symmetries={"rotation": rotation(0, 1)},
    )


def _smaller(radius, factor):
    return dipole_field(radius / factor)
