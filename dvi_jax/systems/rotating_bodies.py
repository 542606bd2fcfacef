"""Rigid bodies in rotation matrices: heavy tops, and a satellite in a gravity gradient."""

from typing import Literal

import jax.numpy as jnp
import numpy as np

from ..base.checks import one_of
from . import rigid
from ._problem import Parameter, Problem, Start, System, library_problem, over_times, vector
from .spinning_top import exact as exact_of_top


def _moments(name, value):
    vector(3)(name, value)
    if not 2 * np.max(value) <= (1 + 1e-8) * np.sum(value) or np.min(value) <= 0:
        raise ValueError(
            f"{name} must be three positive moments, each at most the sum of the others, got "
            f"{value}."
        )


def _body(name, energy, parameters, state, observables, source, **properties) -> Problem:
    """The problem of a rotation matrix; `state`: Euler's angles, π on the body's axes, and h."""
    angles, pi, h = state
    # As `rigid.rotation` and `rigid.momentum`, but in NumPy: making a problem starts no device.
    (a, b, c), (x, y, z), I = np.cos(angles), np.sin(angles), parameters["I"].value  # noqa: E741
    q0 = np.array([[a * c - x * b * z, -a * z - x * b * c, x * y],
                   [x * c + a * b * z, a * b * c - x * z, -a * y],
                   [y * z, y * c, b]])  # fmt: skip
    p0 = q0 @ np.cross(np.eye(3), pi / I) * (np.sum(I) / 2 - I)
    start = Start(f"the {name.replace('_', ' ')} has a rotation matrix", (3, 3))
    properties |= {"name": name, "q0_p0_h": (q0, p0, h), "source": source}
    system = System(energy, constraint=rigid.orthonormal)
    return library_problem(system, start, parameters, observables, **properties)


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
    I, c, angles = args["I"], args["c"], rigid.euler_angles(q0)  # noqa: E741
    # On axes that do not turn with ψ: π = (p_θ, (p_φ − p_ψ cos θ)/sin θ, p_ψ).
    pi = rigid.body_momentum(q0, p0)
    p_theta, _, p_psi = rigid.rotation(angles[2], 0.0, 0.0) @ pi
    momenta, top = jnp.stack([pi @ q0[2], p_theta, p_psi]), {"A": I[1], "C": I[2], "w": c[2]}
    (phi, theta, psi), (p_phi, p_theta, p_psi) = exact_of_top(t, angles, momenta, top)
    pi = jnp.stack([p_theta, (p_phi - p_psi * jnp.cos(theta)) / jnp.sin(theta), p_psi])
    R = rigid.rotation(phi, theta, psi)
    mask = jnp.where((I[0] == I[1]) & jnp.all(c[:2] == 0), 1.0, jnp.nan)
    return R * mask, rigid.momentum(R, pi @ rigid.rotation(psi, 0.0, 0.0), I) * mask


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
    centre, spin, integral = [1.0, 0.0, 0.0], 0.6, kovalevskaya_integral
    if lagrange:
        centre, spin, integral = [0.0, 0.0, 1.0], 2.5, axial_momentum
    weight = "weight times the centre of mass on the body's axes [energy]"
    return _body(
        "heavy_top", _top_energy,
        {"I": Parameter(I, "principal moments about the fixed point [mass length²]", _moments),
         "c": Parameter(np.array(centre), weight, vector(3))},
        ((0.2, 0.6, 0.4), np.array([0.2, 0.3, spin]), 0.01),
        [body_momentum, vertical_momentum, integral],
        "Hairer, Lubich & Wanner 2006, Geometric Numerical Integration, VII.5",
        invariants=("vertical_momentum", integral.__name__), exact=_exact_top if lagrange else None,
    )  # fmt: skip


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
    return _body(
        "satellite", _satellite_energy,
        {"I": Parameter(I, "principal moments of inertia [mass length²]", _moments),
         "omega": Parameter(1.0, "angular velocity of the orbit [1/time]")},
        ((0.1, 0.2, 0.3), I * np.array([0.2, 0.1, 1.1]), 0.02), [jacobi_integral, body_momentum],
        "Hughes 1986, Spacecraft Attitude Dynamics, 9",
        invariants=("jacobi_integral",), autonomous=False,
    )  # fmt: skip
