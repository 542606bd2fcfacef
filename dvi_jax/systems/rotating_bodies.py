"""Rigid bodies in rotation matrices: heavy tops, and a satellite in a gravity gradient."""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from .._checks import one_of
from . import rigid
from ._problem import Parameter, Problem, Start, library_problem, over_times, vector
from .spinning_top import exact as exact_of_top


def _moments(name, value):
    vector(3)(name, value)
    if not 2 * np.max(value) < np.sum(value) or np.min(value) <= 0:
        raise ValueError(
            f"{name} must be three positive moments of inertia, each smaller than the sum of the "
            f"other two, got {value}."
        )


def _start(angles, pi, I):  # noqa: E741
    """R and P of Euler's angles and an angular momentum on the body's axes, as NumPy arrays."""
    with jax.ensure_compile_time_eval():  # also inside of jax.jit
        R = rigid.rotation(*angles)
        return np.array(R), np.array(rigid.momentum(R, pi, I))


def _top_energy(t0, t1, q0, p1, args):
    """H_D = tr(p1 D⁻¹ p1ᵀ)/2 + (R c)_z with R = q0, of which the third row is γ."""
    return rigid.rotational_energy(p1, args["I"]) + q0[2] @ args["c"]


def body_momentum(t0, t1, q0, p0, q1, p1, args):
    """π at t1, the angular momentum on the body's axes: shape (3,)."""
    return rigid.body_momentum(q1, p1)


def vertical_momentum(t0, t1, q0, p0, q1, p1, args):
    """π·γ at t1, the angular momentum about the vertical γ = Rᵀe_z."""
    return rigid.body_momentum(q1, p1) @ q1[2]


def axial_momentum(t0, t1, q0, p0, q1, p1, args):
    """π₃ at t1, conserved for Lagrange's top."""
    return rigid.body_momentum(q1, p1)[2]


def kovalevskaya_integral(t0, t1, q0, p0, q1, p1, args):
    """K = |(Ω1 + iΩ2)² − (c1/I3)(γ1 + iγ2)|² at t1: conserved for I1 = I2 = 2 I3, c2 = c3 = 0."""
    x, y, _ = rigid.body_momentum(q1, p1) / args["I"]
    scale = args["c"][0] / args["I"][2]
    return (x**2 - y**2 - scale * q1[2, 0]) ** 2 + (2 * x * y - scale * q1[2, 1]) ** 2


@over_times((3, 3))
def _exact_top(t, q0, p0, args):
    """The state at times t of Lagrange's top, by `spinning_top`; NaN where that is, and for other
    moments or centres of mass."""
    A, C, I = args["I"][1], args["I"][2], args["I"]  # noqa: E741
    angles, pi = rigid.euler_angles(q0), rigid.body_momentum(q0, p0)
    s, c = jnp.sin(angles[2]), jnp.cos(angles[2])
    momenta = jnp.stack([pi @ q0[2], pi[0] * c - pi[1] * s, pi[2]])
    top = {"A": A, "C": C, "w": args["c"][2]}
    (phi, theta, psi), (p_phi, p_theta, p_psi) = exact_of_top(t, angles, momenta, top)
    s, c, across = jnp.sin(psi), jnp.cos(psi), (p_phi - p_psi * jnp.cos(theta)) / jnp.sin(theta)
    R = rigid.rotation(phi, theta, psi)
    pi = jnp.stack([across * s + p_theta * c, across * c - p_theta * s, p_psi])
    is_symmetric = (args["I"][0] == A) & jnp.all(args["c"][:2] == 0)
    one = jnp.where(is_symmetric, 1.0, jnp.nan)
    return R * one, rigid.momentum(R, pi, I) * one


def heavy_top(kind: Literal["lagrange", "kovalevskaya"] = "lagrange") -> Problem:
    """A rigid body with a fixed point in a uniform gravity; dimensionless.

    "lagrange": I = (1, 1, 1/2), the centre of mass on the axis of symmetry, the motion of
    `spinning_top`; "kovalevskaya": I = (1, 1, 1/2), the centre of mass in the plane of the equal
    moments. Other args are in general not integrable. q0 is the rotation matrix from body axes to
    fixed ones, z up. Initial conditions and step are ours.

    **Raises** `ValueError` for another kind.

    **Source** Hairer, Lubich & Wanner 2006, VII.5; Kowalevski 1889, *Acta Math.* 12, 177; Audin
    1996, *Spinning Tops*.
    """
    lagrange = one_of("kind", kind, ("lagrange", "kovalevskaya")) == "lagrange"
    I = np.array([1.0, 1.0, 0.5])  # noqa: E741
    q0, p0 = _start((0.2, 0.6, 0.4), np.array([0.2, 0.3, 2.5 if lagrange else 0.6]), I)
    integral, name = (
        (axial_momentum, "axial_momentum")
        if lagrange
        else (kovalevskaya_integral, "kovalevskaya_integral")
    )
    return library_problem(
        _top_energy,
        Start("the heavy top has a rotation matrix", (3, 3)),
        name="heavy_top",
        q0=q0,
        p0=p0,
        h=0.01,
        parameters={
            "I": Parameter(I, "principal moments about the fixed point [mass length²]", _moments),
            "c": Parameter(
                np.array([0.0, 0.0, 1.0] if lagrange else [1.0, 0.0, 0.0]),
                "weight times the centre of mass on the body's axes [energy]",
                vector(3),
            ),
        },
        observables=[body_momentum, vertical_momentum, integral],
        source="Hairer, Lubich & Wanner 2006, Geometric Numerical Integration, VII.5",
        invariants=("vertical_momentum", name),
        constraint=rigid.orthonormal,
        exact=_exact_top if lagrange else None,
    )


def _satellite_energy(t0, t1, q0, p1, args):
    """H_D = tr(p1 D⁻¹ p1ᵀ)/2 − (3ω²/2) Σ d_k u_k², u = Rᵀe_r(t0) from the centre of attraction."""
    angle, d = args["omega"] * t0, rigid.second_moments(args["I"])
    u = jnp.cos(angle) * q0[0] + jnp.sin(angle) * q0[1]
    return rigid.rotational_energy(p1, args["I"]) - 1.5 * args["omega"] ** 2 * jnp.sum(d * u**2)


def jacobi_integral(t0, t1, q0, p0, q1, p1, args):
    """H − ω (Rπ)_z at t1: the energy in the frame that turns with the orbit."""
    spin = rigid.body_momentum(q1, p1) @ q1[2]
    return _satellite_energy(t1, t1, q1, p1, args) - args["omega"] * spin


def satellite() -> Problem:
    """The attitude of a satellite on a circular orbit in the gravity gradient; it librates.

    q0 is the rotation matrix from body axes to fixed ones; the orbit is in the xy plane. It is
    stable with the axis of I1 along the radius and that of I3 along the normal of the orbit, for
    I1 < I2 < I3 (Lagrange's region). Dimensionless; initial conditions and step are ours.

    **Source** Beletsky 1966, *Motion of an Artificial Satellite about its Center of Mass*; Hughes
    1986, *Spacecraft Attitude Dynamics*, 9.
    """
    I = np.array([1.0, 1.6, 2.0])  # noqa: E741
    q0, p0 = _start((0.1, 0.2, 0.3), I * np.array([0.2, 0.1, 1.1]), I)
    return library_problem(
        _satellite_energy,
        Start("the satellite has a rotation matrix", (3, 3)),
        name="satellite",
        q0=q0,
        p0=p0,
        h=0.02,
        parameters={
            "I": Parameter(I, "principal moments of inertia [mass length²]", _moments),
            "omega": Parameter(1.0, "angular velocity of the orbit [1/time]"),
        },
        observables=[jacobi_integral, body_momentum],
        source="Hughes 1986, Spacecraft Attitude Dynamics, 9",
        invariants=("jacobi_integral",),
        autonomous=False,
        constraint=rigid.orthonormal,
    )
