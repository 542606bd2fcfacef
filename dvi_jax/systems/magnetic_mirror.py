"""A charged particle between two magnetic mirrors."""

import jax.numpy as jnp

from ..discover.symmetries.library import rotation
from . import _guiding_centre as guiding_centre
from ._problem import (
    Parameter,
    Problem,
    Start,
    at_end,
    bound,
    finite,
    library_problem,
    nonzero,
    positive,
)


def potential_factor(q, args):
    r"""a of A = a (−y, x, 0) with B = ∇ × A, of an axisymmetric field that grows along its axis.

    a = B0/2 (1 + z²/ℓ²)
    """
    return args["B0"] / 2 * (1 + (q[2] / args["length"]) ** 2)


def magnetic_field(q, args):
    r"""B at q: shape (3,).

        B = B0 (−x z/ℓ², −y z/ℓ², 1 + z²/ℓ²)

    Its divergence is zero everywhere; its curl is not, so that currents flow where the particle is.
    """
    x, y, z = q
    square = args["length"] ** 2
    return args["B0"] * jnp.stack([-x * z / square, -y * z / square, 1 + z**2 / square])


_particle = guiding_centre.ChargedParticle(potential_factor, magnetic_field)
vector_potential, kinetic_momentum = _particle.vector_potential, _particle.kinetic_momentum
hamiltonian = _particle.hamiltonian
magnetic_moment, corrected_moment = _particle.magnetic_moment, _particle.corrected_moment
energy = at_end(hamiltonian)


def canonical_angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """p_φ = x p_y − y p_x at t1, conserved by the rotational symmetry about the axis."""
    return q1[0] * p1[1] - q1[1] * p1[0]


def bounce_action(t0, t1, q0, p0, q1, p1, args):
    r"""The longitudinal invariant at t1, the second adiabatic one [action].

        J = ∮ p∥ ds = 4 ∫ √(2m (E − μ|B|)) ds,    from the middle to the mirror point

    along the field line of the guiding centre, (x² + y²)(1 + z²/ℓ²) = a², with μ the
    `corrected_moment`. Near the axis 2πmℓ (E − μ|B0|)/√(2mμ|B0|). Zero where the particle mirrors
    in the middle. Not differentiable. **Source** Northrop 1963, 3.
    """
    m, length = args["mass"], args["length"]
    x, y, z = _particle.centre(q1, p1, args)
    a = (x**2 + y**2) * (1 + (z / length) ** 2) / length**2
    E = energy(t0, t1, q0, p0, q1, p1, args)
    mu = corrected_moment(t0, t1, q0, p0, q1, p1, args)
    in_middle = jnp.abs(args["B0"])  # of either sign

    def strength(u):  # of u = z/ℓ
        return in_middle * jnp.sqrt((1 + u**2) ** 2 + a * u**2 / (1 + u**2))

    def arc(u):
        return length * jnp.sqrt(1 + a * u**2 / (1 + u**2) ** 3)

    far = jnp.sqrt(jnp.maximum(E / (mu * in_middle) - 1, 0.0))  # where it turns on the axis
    return guiding_centre.bounce_action(strength, arc, far, E, mu, m)


def magnetic_mirror(length: float = 20.0, distance: float = 2.0) -> Problem:
    """A charged particle in a magnetic mirror, B = B0 (1 + z²/ℓ²) on the axis; dimensionless.

    e = m = B0 = 1: gyroradius and gyrofrequency 1 at the start, on the middle plane with its
    guiding centre at (`distance`, 0, 0). With v_{∥} = 0.8 v_{⊥} it turns where |B| is 1.64 times
    that, near z = 0.8 ℓ. Field, initial conditions and step are ours.

    - `length`: ℓ, and `distance` from the axis, both over the gyroradius.

    **Raises** `ValueError` for a length that is not positive, or a distance that is not finite.

    **Source** equations and adiabatic invariant: Northrop 1963, *The Adiabatic Motion of Charged
    Particles*.
    """
    length, distance = positive("length", length), finite("distance", distance)
    x, vy, vz = distance + 1, -1.0, 0.8  # where A = (0, x/2, 0)
    return library_problem(
        hamiltonian,
        Start("the magnetic mirror holds one particle in space", (3,)),
        name="magnetic_mirror",
        q0_p0_h=([x, 0.0, 0.0], [0.0, vy + x / 2, vz], 0.1),
        parameters={
            **guiding_centre.PARTICLE,
            "B0": Parameter(1.0, "field in the middle [mass/(charge time)]", nonzero),
            "length": Parameter(length, "ℓ, over which it doubles along the axis [length]"),
        },
        observables=[canonical_angular_momentum, magnetic_moment, corrected_moment, bounce_action],
        source="our own choice of field; Northrop 1963, The Adiabatic Motion of Charged Particles",
        invariants=("canonical_angular_momentum",),
        adiabatic=guiding_centre.adiabatic("gyroradius over ℓ", bound(_smaller, length, distance)),
        symmetries={"rotation": rotation(0, 1)},
    )


def _smaller(length, distance, factor):
    return magnetic_mirror(length / factor, distance / factor)
