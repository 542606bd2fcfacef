"""Lagrange's top: a symmetric heavy body with a fixed point, in Euler's angles."""

import jax.numpy as jnp
import numpy as np

from ..discover.symmetries.library import space_translation
from ._elliptic import first_kind, jacobi, third_kind
from ._problem import Parameter, Problem, Start, interval, library_problem, over_times


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

    NaN for p_ψ² < 4 A w cos θ, where no steady precession exists. The fast one is infinite at
    θ = π/2.
    **Source** Goldstein, Poole & Safko 2002, *Classical Mechanics*, 5.7.
    """
    lift = args["A"] * jnp.cos(theta)
    root = jnp.sqrt(p_psi**2 - 4 * lift * args["w"])
    # the slow one without cancellation
    larger = p_psi + jnp.where(p_psi < 0, -root, root)
    return jnp.stack([2 * args["w"] / larger, larger / (2 * lift)])


def _turning_points(E, p_phi, p_psi, args):
    r"""Roots u1 < u2 ≤ 1 ≤ u3 of (2/A)(E − wu)(1 − u²) − (p_φ − p_ψ u)²/A², as these three:

        1 + u1,    1 − u2,    1 + u3

    Computed by the trigonometric formula for three real roots, and Newton's steps in the results:
    1 + u1 and 1 − u2 are accurate also where the axis comes close to the vertical.
    """
    A, w = args["A"], args["w"]
    c3, c2 = 2 * w / A, -2 * E / A - (p_psi / A) ** 2
    c1, c0 = -2 * w / A + 2 * p_phi * p_psi / A**2, 2 * E / A - (p_phi / A) ** 2
    a, b, c = c2 / c3, c1 / c3, c0 / c3
    Q, R = (a**2 - 3 * b) / 9, (2 * a**3 - 9 * a * b + 27 * c) / 54
    angle = jnp.arccos(jnp.clip(R / jnp.sqrt(Q**3), -1, 1))

    def root(turns):  # ascending for 0 ≤ angle ≤ π and turns 0, −2, 2
        return -2 * jnp.sqrt(Q) * jnp.cos((angle + turns * jnp.pi) / 3) - a / 3

    def polish(x, sign):
        """A root x = 1 + sign u: the same cubic in x, times A²."""
        P, free = p_phi + sign * p_psi, E + sign * w
        cubic = 2 * sign * A * w, -4 * sign * A * w - 2 * A * free - p_psi**2
        cubic = (*cubic, 4 * A * free + 2 * sign * P * p_psi, -(P**2))
        for _ in range(4):
            value, slope = cubic[0], 0.0
            for coefficient in cubic[1:]:
                value, slope = value * x + coefficient, slope * x + value
            x = x - value / slope
        return x

    return polish(1 + root(0), 1), polish(1 - root(-2), -1), polish(1 + root(2), 1)


@over_times((3,))
def exact(t, q0, p0, args):
    r"""The state at times t.

        cos θ = u1 + (u2 − u1) sn² x,   x = κt + δ,  κ² = w (u3 − u1)/(2A),  m = (u2 − u1)/(u3 − u1)
        A dφ/dt = P₊ + P₋,    A dψ/dt = (A/C − 1) p_ψ + P₊ − P₋,    2 P± = (p_φ ± p_ψ)/(1 ± cos θ)

    with u_i the roots of (du/dt)² = (2/A)(E′ − wu)(1 − u²) − (p_φ − p_ψ u)²/A², E′ = E − p_ψ²/(2C).
    φ and ψ are integrals of the third kind, of n = (u1 − u2)/(1 + u1) and (u2 − u1)/(1 − u1).

    Angles have an error of about 1e-15 times their value, and one of 1e-16/(u2 − u1) by rounding of
    u1 and u2, which matters for small nutations. NaN for a double root, that is for a steady
    precession (see `steady_precession`) and a sleeping top; and where the axis passes through the
    vertical, with p_φ = p_ψ and E′ ≥ w above or p_φ = −p_ψ below: Euler's angles jump there.
    **Source** Whittaker 1937, *Analytical Dynamics*, §71.
    """
    A, C, w = (jnp.asarray(args[name], p0.dtype) for name in ("A", "C", "w"))
    p_phi, p_psi = p0[0], p0[2]
    minus, plus = p_phi - p_psi, p_phi + p_psi  # p_φ − p_ψ cos θ at θ = 0 and π
    s2, c2 = jnp.sin(q0[1] / 2) ** 2, jnp.cos(q0[1] / 2) ** 2
    leaning = (minus + 2 * p_psi * s2) ** 2 / (8 * A * s2 * c2)
    E = p0[1] ** 2 / (2 * A) + leaning + w * (c2 - s2)
    x1, v2, x3 = _turning_points(E, p_phi, p_psi, {"A": A, "w": w})  # 1 + u1, 1 − u2, 1 + u3
    x2, v1, spread = 2 - v2, 2 - x1, 2 - x1 - v2
    is_vertical = ((minus == 0) & (w <= E)) | (plus == 0)
    spread = jnp.where((spread > 0) & ~is_vertical, spread, jnp.nan)
    rate, m = jnp.sqrt(w * (x3 - x1) / (2 * A)), spread / (x3 - x1)
    # sn² and sn cn at t = 0 give sine and cosine of twice the phase
    sn2, cn2 = (2 * c2 - x1) / spread, (2 * s2 - v2) / spread
    climb = -jnp.sin(q0[1]) * p0[1] / A
    dn = jnp.sqrt(cn2 + (1 - m) * sn2)
    start = first_kind(jnp.arctan2(climb / (spread * rate * dn), cn2 - sn2) / 2, m)
    sn, cn, dn, end = jacobi(rate * t + start, m)
    begin = jacobi(start, m)[3]

    def integral(P, base, complement):
        """∫ P/2A over 1 ± u, which is base (1 − n sn²)."""
        difference = third_kind(end, complement, m) - third_kind(begin, complement, m)
        return P / (2 * A * base * rate) * difference

    minus_angle, plus_angle = integral(minus, v1, v2 / v1), integral(plus, x1, x2 / x1)
    phi = q0[0] + plus_angle + minus_angle
    psi = q0[2] + (1 / C - 1 / A) * p_psi * t + plus_angle - minus_angle
    # 1 − u and 1 + u, each without cancellation
    from_top, from_bottom = v2 + spread * cn**2, x1 + spread * sn**2
    theta = 2 * jnp.arctan2(jnp.sqrt(from_top), jnp.sqrt(from_bottom))
    climb = 2 * spread * rate * sn * cn * dn
    p_theta = -A * climb / jnp.sqrt(from_top * from_bottom)
    q, p = jnp.stack([phi, theta, psi]), jnp.stack([p_phi, p_theta, p_psi])
    return q + 0 * m, p + 0 * m  # NaN in all components if in one


def _leans(q, p, args):
    interval(0.0, np.pi)("q0[1], the angle θ,", q[1])  # Euler's angles are singular at 0 and π
    if args["C"] > 2 * (1 + 1e-8) * args["A"]:
        raise ValueError(
            f"C must be at most 2 A, as for every rigid body, got C = {args['C']}, A = {args['A']}."
        )


def spinning_top() -> Problem:
    """A top inclined by 0.6 rad that precesses and nutates.

    Dimensionless: A = w = 1, C = 1/2. Initial conditions and step are ours.

    **Source** Lagrange 1788, *Méchanique analitique*; Goldstein, Poole & Safko 2002, *Classical
    Mechanics*, 5.7.
    """
    return library_problem(
        hamiltonian,
        Start("the top has Euler's angles (φ, θ, ψ)", (3,), check=_leans),
        name="spinning_top",
        q0_p0_h=(np.array([0.0, 0.6, 0.0]), np.array([2.4, 0.1, 2.5]), 0.02),
        parameters={
            "A": Parameter(
                1.0, "moment of inertia about the point, across the axis [mass length²]"
            ),
            "C": Parameter(0.5, "moment of inertia along the axis [mass length²]"),
            "w": Parameter(1.0, "m g l, weight times its distance from the fixed point [energy]"),
        },
        observables=[vertical_momentum, axial_momentum, height],
        units={"q": "rad", "p": "1", "t": "1", "energy": "1"},
        source="Goldstein, Poole & Safko 2002, Classical Mechanics, 5.7",
        invariants=("vertical_momentum", "axial_momentum"),
        symmetries={
            "turn_about_vertical": space_translation([1.0, 0.0, 0.0]),
            "turn_about_axis": space_translation([0.0, 0.0, 1.0]),
        },
        exact=exact,
    )
