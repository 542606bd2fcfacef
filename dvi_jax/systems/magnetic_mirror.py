"""A charged particle between two magnetic mirrors."""

import jax.numpy as jnp

from .._system import System
from ..discover.library import rotation, time_translation
from . import _guiding_centre as guiding_centre
from ._problem import Adiabatic, Problem, check_finite, check_nonzero, check_positive, check_shape


def vector_potential(q, args):
    r"""A with B = ∇ × A, of an axisymmetric field that grows along its axis.

    A = B0/2 (1 + z²/ℓ²) (−y, x, 0)
    """
    x, y, z = q
    return args["B0"] / 2 * (1 + (z / args["length"]) ** 2) * jnp.stack([-y, x, jnp.zeros_like(z)])


def magnetic_field(q, args):
    r"""B at q: shape (3,).

        B = B0 (−x z/ℓ², −y z/ℓ², 1 + z²/ℓ²)

    Its divergence is zero everywhere; its curl is not, so currents flow where the particle is.
    """
    x, y, z = q
    square = args["length"] ** 2
    return args["B0"] * jnp.stack([-x * z / square, -y * z / square, 1 + z**2 / square])


def kinetic_momentum(q, p, args):
    """m v = p − e A(q): shape (3,)."""
    return p - args["charge"] * vector_potential(q, args)


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = |p1 − e A(q0)|²/(2m), with canonical momenta p = mv + eA: not separable."""
    return jnp.sum(kinetic_momentum(q0, p1, args) ** 2) / (2 * args["mass"])


def energy(t0, t1, q0, p0, q1, p1, args):
    """m|v|²/2 at t1: the continuous energy."""
    return hamiltonian(t0, t1, q1, p1, args)


def canonical_angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """p_φ = x p_y − y p_x at t1, which turns about the axis keep."""
    return q1[0] * p1[1] - q1[1] * p1[0]


def magnetic_moment(t0, t1, q0, p0, q1, p1, args):
    """μ = m v⊥²/(2|B|) at t1, B taken at the particle: the adiabatic invariant.

    It wavers in each turn by the order of gyroradius over ℓ, and does not drift.
    """
    return guiding_centre.magnetic_moment(
        q1, kinetic_momentum(q1, p1, args), lambda q: magnetic_field(q, args), args
    )


def corrected_moment(t0, t1, q0, p0, q1, p1, args):
    """μ + μ1 at t1, which wavers by the second order in gyroradius over ℓ: `_guiding_centre`."""
    return magnetic_moment(t0, t1, q0, p0, q1, p1, args) + guiding_centre.first_correction(
        q1, kinetic_momentum(q1, p1, args), lambda q: magnetic_field(q, args), args
    )


def bounce_action(t0, t1, q0, p0, q1, p1, args):
    r"""The longitudinal invariant at t1, the second adiabatic one [action].

        J = ∮ p∥ ds = 4 ∫ √(2m (E − μ|B|)) ds,    from the middle to the mirror point

    along the field line of the guiding centre, (x² + y²)(1 + z²/ℓ²) = a², with μ the
    `corrected_moment`. Near the axis 2πmℓ (E − μ|B0|)/√(2mμ|B0|). Zero where the particle mirrors
    in the middle. Not differentiable. **Source** Northrop 1963, 3.
    """
    m, mv, length = args["mass"], kinetic_momentum(q1, p1, args), args["length"]
    x, y, z = guiding_centre.centre(q1, mv, lambda q: magnetic_field(q, args), args)
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


def check_start(q0, p0, args):
    """Refuse a start that is not in space, no field, or a mass or length that is not positive.

    **Raises** `ValueError`.
    """
    check_shape(
        q0,
        p0,
        lambda shape: shape == (3,),
        "the magnetic mirror holds one particle in space: q0 and p0 of shape (3,)",
    )
    check_positive(args, "mass", "length")
    check_nonzero(args, "the particle does not gyrate. Take another system.", "charge", "B0")


def magnetic_mirror(length: float = 20.0, distance: float = 2.0) -> Problem:
    """A particle that bounces in B = B0 (1 + z²/ℓ²) on the axis; dimensionless.

    e = m = B0 = 1: gyroradius and gyrofrequency 1 at the start, on the middle plane with its
    guiding centre at (`distance`, 0, 0). With v_{∥} = 0.8 v_{⊥} it turns where |B| is 1.64 times
    that, near z = 0.8 ℓ. Field, start and step are ours.

    - `length`: ℓ, and `distance` from the axis, both over the gyroradius.

    - args: `charge` e, `mass` m, `B0`, `length` ℓ.

    **Raises** `ValueError` for a length that is not positive, or a distance that is not finite.

    **Source** equations and adiabatic invariant: Northrop 1963, *The Adiabatic Motion of Charged
    Particles*.
    """
    given = {"length": length, "distance": distance}
    check_positive(given, "length")
    check_finite(given, "distance")
    x, vy, vz = distance + 1, -1.0, 0.8
    return Problem(
        name="magnetic_mirror",
        system=System(hamiltonian),
        q0=[x, 0.0, 0.0],
        p0=[0.0, vy + x / 2, vz],  # A = (0, x/2, 0) there
        h=0.1,
        args={"charge": 1.0, "mass": 1.0, "B0": 1.0, "length": float(length)},
        observables={
            "energy": energy,
            "canonical_angular_momentum": canonical_angular_momentum,
            "magnetic_moment": magnetic_moment,
            "corrected_moment": corrected_moment,
            "bounce_action": bounce_action,
        },
        units={"q": "1", "p": "1", "t": "1", "energy": "1"},
        source="our own choice of field; Northrop 1963, The Adiabatic Motion of Charged Particles",
        check=check_start,
        parameters={
            "charge": "e [charge]",
            "mass": "m [mass]",
            "B0": "field in the middle [mass/(charge time)]",
            "length": "ℓ, over which it doubles along the axis [length]",
        },
        invariants=("energy", "canonical_angular_momentum"),
        adiabatic={
            name: Adiabatic(
                "gyroradius over ℓ",
                power,
                smaller=lambda factor: magnetic_mirror(length / factor, distance / factor),
            )
            for name, power in (
                ("magnetic_moment", 1),
                ("corrected_moment", 2),
                ("bounce_action", 2),
            )
        },
        symmetries={"time": time_translation(), "rotation": rotation(0, 1)},
    )
