r"""A free rigid body in the canonical variables of Serret and Andoyer.

    q = (l, g, k),    p = (L, G, K)

G is the magnitude of the angular momentum, K its component along the fixed z axis, L that along
the third principal axis of the body; k is the longitude of the angular momentum, l the angle of
rotation about the third axis. g is the angle, in the plane normal to the angular momentum, from the
fixed xy plane to the plane of the first two principal axes. The angular momentum in the body is

    M = (√(G² − L²) sin l, √(G² − L²) cos l, L).

Unlike Euler's angles the variables are regular where the third axis is vertical. They are singular
at L = ±G (and k is undefined at K = ±G).
"""

import jax.numpy as jnp
import numpy as np

from ..discover.functions.generators import Generator
from ..discover.symmetries.library import scaling, space_translation
from ._elliptic import first_kind, jacobi, third_kind
from ._problem import Parameter, Problem, Start, library_problem, over_times


def hamiltonian(t0, t1, q0, p1, args):
    r"""Energy of rotation; not separable.

    H_D = (G² − L²)/2 (sin² l/I1 + cos² l/I2) + L²/(2 I3),    l of q0, L and G of p1
    """
    I1, I2, I3 = args["I1"], args["I2"], args["I3"]
    s, c = jnp.sin(q0[0]), jnp.cos(q0[0])
    return (p1[1] ** 2 - p1[0] ** 2) / 2 * (s**2 / I1 + c**2 / I2) + p1[0] ** 2 / (2 * I3)


def body_momentum(q, p):
    """Angular momentum on the principal axes of the body: shape (3,)."""
    transverse = jnp.sqrt(p[1] ** 2 - p[0] ** 2)
    return jnp.stack([transverse * jnp.sin(q[0]), transverse * jnp.cos(q[0]), p[0]])


def orientation(q, p):
    r"""The rotation matrix from axes of the body to fixed ones, shape (3, 3).

    R = R_z(k) R_x(J) R_z(g) R_x(σ) R_z(l),    cos J = K/G,  cos σ = L/G
    """
    (body, spin, node), (L, G, K) = q, p

    ones, zeros = jnp.ones_like(G), jnp.zeros_like(G)

    def about_z(angle):
        c, s = jnp.cos(angle), jnp.sin(angle)
        return jnp.stack([c, -s, zeros, s, c, zeros, zeros, zeros, ones]).reshape(3, 3)

    def about_x(c):
        s = jnp.sqrt(1 - c**2)
        return jnp.stack([ones, zeros, zeros, zeros, c, -s, zeros, s, c]).reshape(3, 3)

    return about_z(node) @ about_x(K / G) @ about_z(spin) @ about_x(L / G) @ about_z(body)


def angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """Angular momentum on fixed axes at t1, shape (3,): R M, conserved with G, K and k."""
    return orientation(q1, p1) @ body_momentum(q1, p1)


def body_angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """Angular momentum on the body's axes at t1, shape (3,), which is not constant."""
    return body_momentum(q1, p1)


@over_times((3,))
def exact(t, q0, p0, args):
    r"""Exact solution by elliptic functions: the state at times t, for I1 < I2 < I3.

        M = (a cn, b sn, c dn)(λt + u | m)    where G² > 2 E I2, else with 1 and 3 exchanged
        dg/dt = G (sin² l/I1 + cos² l/I2),    l = atan2(M1, M2), without jumps
        g = g0 + G [t/I3 + (1/I1 − 1/I3) ∫ dt/(1 − n sn²)],    1 − n = I2 (I3 − I1)/(I1 (I3 − I2))
            where G² > 2 E I2, else G²/M1² at sn = 0

    g is an integral of the third kind, with an error of about 1e-15 times its value. NaN on the
    separatrix, G² = 2 E I2, and for moments in another order.
    **Source** Landau & Lifshitz 1976, *Mechanics*, §37.
    """
    I = jnp.stack([jnp.asarray(args[name], p0.dtype) for name in ("I1", "I2", "I3")])  # noqa: E741
    G2, E2 = p0[1] ** 2, 2 * hamiltonian(0.0, 0.0, q0, p0, args)
    M0 = body_momentum(q0, p0)
    about_third = E2 * I[1] < G2
    # For rotations about the first axis, the first and the third axis are exchanged.
    order = jnp.where(about_third, jnp.arange(3), jnp.arange(3)[::-1])
    first, middle, last = I[order]
    M0 = M0[order]
    sign = jnp.where(M0[2] < 0, -1.0, 1.0)
    low, high = (E2 * last - G2) / (last - first), (G2 - E2 * first) / (last - first)
    wide = (E2 * last - G2) / (last - middle)
    a, b, c = jnp.sqrt(first * low), jnp.sqrt(middle * wide), sign * jnp.sqrt(last * high)
    rate = jnp.sqrt((last - middle) * (G2 - E2 * first) / (first * middle * last))
    m = (middle - first) * (E2 * last - G2) / ((last - middle) * (G2 - E2 * first))
    m = jnp.where((m < 1) & (I[0] <= I[1]) & (I[1] <= I[2]), m, jnp.nan)
    start = first_kind(jnp.arctan2(M0[1] / b, sign * M0[0] / a), m)

    sn, cn, dn, end = jacobi(rate * t + start, m)
    begin = jacobi(start, m)[3]
    along_a, along_b, along_c = sign * a * cn, b * sn, c * dn
    M1, M3 = jnp.where(about_third, along_a, along_c), jnp.where(about_third, along_c, along_a)

    def body_angle(am, M1, M2):
        """l without jumps: it increases with am for rotations about the third axis only."""
        turning = jnp.arctan2(b * jnp.sin(am), a * jnp.cos(am))
        turning = turning + 2 * jnp.pi * jnp.round((am - turning) / (2 * jnp.pi))
        return jnp.where(about_third, sign * (jnp.pi / 2 - turning), jnp.arctan2(M1, M2))

    at_start = body_angle(begin, jnp.where(about_third, M0[0], M0[2]), M0[1])
    turns = 2 * jnp.pi * jnp.round((q0[0] - at_start) / (2 * jnp.pi))
    complement = jnp.where(about_third, middle * wide / (first * low), G2 / c**2)
    time = (third_kind(end, complement, m) - third_kind(begin, complement, m)) / rate
    g = q0[1] + p0[1] * (t / I[2] + (1 / I[0] - 1 / I[2]) * time)
    angle = body_angle(end, M1, along_b) + turns
    q, p = jnp.stack([angle, g, q0[2]]), jnp.stack([M3, p0[1], p0[2]])
    return q + 0 * m, p + 0 * m  # NaN in all components if in one


def _possible(q, p, args):
    moments = [args["I1"], args["I2"], args["I3"]]
    if 2 * max(moments) > (1 + 1e-8) * sum(moments):  # of a flat body they may be rounded
        raise ValueError(f"I1, I2 and I3 must be at most the sum of the other two, got {moments}.")
    L, G, K = p
    if not (abs(L) < G and abs(K) <= G):
        raise ValueError(
            f"p0 = (L, G, K) must satisfy |L| < G and |K| ≤ G, got {p.tolist()}. G is the magnitude"
            " of the angular momentum, L and K are components."
        )


def rigid_body() -> Problem:
    """A free rigid body with moments 1, 2 and 2.5, in rotation about the unstable middle axis.

    Dimensionless. Initial conditions and step are ours.

    **Source** variables: Andoyer 1923, *Cours de mécanique céleste*, I; Deprit 1967, *Am. J. Phys.*
    35, 424; motion: Landau & Lifshitz 1976, *Mechanics*, §37.
    """
    return library_problem(
        hamiltonian,
        Start("the rigid body has angles (l, g, k) and momenta (L, G, K)", (3,), check=_possible),
        name="rigid_body",
        q0_p0_h=(np.array([0.1, 0.0, 0.4]), np.array([0.1, 1.0, 0.6]), 0.05),
        parameters={
            f"I{i}": Parameter(moment, f"moment of inertia about principal axis {i} [mass length²]")
            for i, moment in enumerate((1.0, 2.0, 2.5), 1)
        },
        observables=[angular_momentum, body_angular_momentum],
        units={"q": "rad", "p": "1", "t": "1", "energy": "1"},
        source="Deprit 1967, Am. J. Phys. 35, 424; Landau & Lifshitz 1976, Mechanics, §37",
        invariants=("angular_momentum",),
        symmetries={
            "turn_about_angular_momentum": space_translation([0.0, 1.0, 0.0]),
            "turn_about_z": space_translation([0.0, 0.0, 1.0]),
            "scaling": scaling(q=0.0, p=1.0, t=-1.0),
            # ∂/∂K: the energy is independent of the direction of the angular momentum.
            "tilt": Generator(eta=_tilt),
        },
        exact=exact,
    )


def _tilt(t, q, p, args):
    return jnp.zeros_like(p).at[2].set(1.0)
