"""Lagrange's top: a symmetric heavy body on a fixed point, in Euler's angles."""

import jax.numpy as jnp
import numpy as np

from .._system import System
from ..symmetry.library import space_translation, time_translation
from ._elliptic import first_kind, jacobi
from ._problem import Problem, check_positive, check_shape, over_times
from ._quadrature import integral_from_zero


def hamiltonian(t0, t1, q0, p1, args):
    r"""Energy in Euler's angles (φ, θ, ψ) = q0 and their momenta; not separable.

        H_D = p_θ²/(2A) + (p_φ − p_ψ cos θ)²/(2A sin² θ) + p_ψ²/(2C) + w cos θ

    A and C: moments of inertia about the fixed point, across and along the axis of the top; θ from
    the upward vertical; w = m g l.
    """
    A, C = args["A"], args["C"]
    c, s = jnp.cos(q0[1]), jnp.sin(q0[1])
    turning = p1[1] ** 2 / (2 * A) + p1[2] ** 2 / (2 * C)
    return turning + (p1[0] - p1[2] * c) ** 2 / (2 * A * s**2) + args["w"] * c


def energy(t0, t1, q0, p0, q1, p1, args):
    """The energy at t1."""
    return hamiltonian(t0, t1, q1, p1, args)


def vertical_momentum(t0, t1, q0, p0, q1, p1, args):
    """p_φ at t1: the angular momentum about the vertical."""
    return p1[0]


def axial_momentum(t0, t1, q0, p0, q1, p1, args):
    """p_ψ at t1: the angular momentum about the axis of the top."""
    return p1[2]


def height(t0, t1, q0, p0, q1, p1, args):
    """cos θ at t1, which nutates between two values."""
    return jnp.cos(q1[1])


def steady_precession(theta, p_psi, args):
    r"""Rates of the steady precessions at an angle, slow and fast [1/time]: shape (2,).

        A cos θ Ω² − p_ψ Ω + w = 0,    p_φ = A sin² θ Ω + p_ψ cos θ

    NaN where p_ψ² < 4 A w cos θ: too slow a top has none. At θ = π/2 the fast one is infinite.
    **Source** Goldstein, Poole & Safko 2002, *Classical Mechanics*, 5.7.
    """
    lift = args["A"] * jnp.cos(theta)
    root = jnp.sqrt(p_psi**2 - 4 * lift * args["w"])
    # the slow one without its cancellation
    larger = p_psi + jnp.where(p_psi < 0, -root, root)
    return jnp.stack([2 * args["w"] / larger, larger / (2 * lift)])


def _turning_points(E, p_phi, p_psi, args):
    r"""Roots u1 < u2 ≤ 1 ≤ u3 of (2/A)(E − wu)(1 − u²) − (p_φ − p_ψ u)²/A², shape (3,).

    By the trigonometric formula for three real roots, and three of Newton's steps each.
    """
    A, w = args["A"], args["w"]
    c3, c2 = 2 * w / A, -2 * E / A - (p_psi / A) ** 2
    c1, c0 = -2 * w / A + 2 * p_phi * p_psi / A**2, 2 * E / A - (p_phi / A) ** 2
    a, b, c = c2 / c3, c1 / c3, c0 / c3
    Q, R = (a**2 - 3 * b) / 9, (2 * a**3 - 9 * a * b + 27 * c) / 54
    angle = jnp.arccos(jnp.clip(R / jnp.sqrt(Q**3), -1, 1))
    turns = jnp.asarray([0.0, -2.0, 2.0]) * jnp.pi  # ascending for 0 ≤ angle ≤ π
    u = -2 * jnp.sqrt(Q) * jnp.cos((angle + turns) / 3) - a / 3
    for _ in range(3):
        u = u - (((u + a) * u + b) * u + c) / ((3 * u + 2 * a) * u + b)
    return u


@over_times
def exact(t, q0, p0, args):
    r"""The top at times t of one that is at (q0, p0) at t = 0.

        cos θ = u1 + (u2 − u1) sn²(κt + δ | m),    κ² = w (u3 − u1)/(2A),  m = (u2 − u1)/(u3 − u1)
        dφ/dt = (p_φ − p_ψ cos θ)/(A sin² θ),      dψ/dt = p_ψ/C − cos θ dφ/dt

    with u_i the roots of (du/dt)² = (2/A)(E′ − wu)(1 − u²) − (p_φ − p_ψ u)²/A², E′ = E − p_ψ²/(2C).
    φ and ψ are integrated numerically, to round-off for some 60 nutations.

    - `t`: times, any shape. `q0`, `p0`: shape (3,). Returns q, p of shape t.shape + (3,).

    NaN where two roots are one: a steady precession (see `steady_precession`) or a sleeping top.
    **Source** Whittaker 1937, *Analytical Dynamics*, §71.
    """
    A, C, w = args["A"], args["C"], args["w"]
    p_phi, p_psi = p0[0], p0[2]
    E = hamiltonian(0.0, 0.0, q0, p0, args) - p_psi**2 / (2 * C)
    u1, u2, u3 = _turning_points(E, p_phi, p_psi, args)
    rate, m = jnp.sqrt(w * (u3 - u1) / (2 * A)), (u2 - u1) / (u3 - u1)
    # sn² and sn cn of the start give sine and cosine of twice the phase
    square = (jnp.cos(q0[1]) - u1) / (u2 - u1)
    climb = -jnp.sin(q0[1]) * p0[1] / A
    dn = jnp.sqrt(1 - m * square)
    double = jnp.arctan2(climb / ((u2 - u1) * rate * dn), 1 - 2 * square)
    start = first_kind(double / 2, m)

    def height_and_climb(s):
        sn, cn, dn, _ = jacobi(rate * s + start, m)
        return u1 + (u2 - u1) * sn**2, 2 * (u2 - u1) * rate * sn * cn * dn

    def precession(s):
        u, _ = height_and_climb(s)
        return (p_phi - p_psi * u) / (A * (1 - u**2))

    u, climb = height_and_climb(t)
    phi = q0[0] + integral_from_zero(precession, t)
    spin = integral_from_zero(lambda s: height_and_climb(s)[0] * precession(s), t)
    psi = q0[2] + p_psi / C * t - spin
    p_theta = -A * climb / jnp.sqrt(1 - u**2)
    return jnp.stack([phi, jnp.arccos(u), psi]), jnp.stack([p_phi, p_theta, p_psi])


def check_start(q0, p0, args):
    """Refuse a start of another shape, an upright top, or moments that no body has.

    **Raises** `ValueError`.
    """
    check_shape(
        q0,
        p0,
        lambda shape: shape == (3,),
        "the top has Euler's angles (φ, θ, ψ): q0 and p0 of shape (3,)",
    )
    check_positive(args, "A", "C", "w")
    if not 0 < float(np.asarray(q0, float)[1]) < np.pi:
        raise ValueError(
            f"θ must lie between 0 and π, got {np.asarray(q0, float)[1]}: Euler's angles are "
            "singular where the axis is vertical."
        )


def spinning_top() -> Problem:
    """A top that leans by 0.6 rad and is let go with a slow push: it precesses and nutates.

    Dimensionless: A = w = 1, C = 1/2. Start and step are ours.

    **Source** Lagrange 1788, *Méchanique analitique*; Goldstein, Poole & Safko 2002, *Classical
    Mechanics*, 5.7.
    """
    return Problem(
        name="spinning_top",
        system=System(hamiltonian),
        q0=np.array([0.0, 0.6, 0.0]),
        p0=np.array([2.4, 0.1, 2.5]),
        h=0.02,
        args={"A": 1.0, "C": 0.5, "w": 1.0},
        observables={
            "energy": energy,
            "vertical_momentum": vertical_momentum,
            "axial_momentum": axial_momentum,
            "height": height,
        },
        units={"q": "rad", "p": "1", "t": "1", "energy": "1"},
        source="Goldstein, Poole & Safko 2002, Classical Mechanics, 5.7",
        check=check_start,
        parameters={
            "A": "moment of inertia about the fixed point, across the axis [mass length²]",
            "C": "moment of inertia along the axis [mass length²]",
            "w": "m g l, the weight times its distance from the fixed point [energy]",
        },
        invariants=("energy", "vertical_momentum", "axial_momentum"),
        symmetries={
            "time": time_translation(),
            "turn_about_vertical": space_translation([1.0, 0.0, 0.0]),
            "turn_about_axis": space_translation([0.0, 0.0, 1.0]),
        },
        exact=exact,
    )
