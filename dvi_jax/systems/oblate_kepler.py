"""A satellite of an oblate planet: the Kepler problem in space with J2."""

import jax.numpy as jnp
import numpy as np

from ..discover.symmetries.library import rotation
from ..problem.elements import Keplerian
from ._problem import Parameter, Problem, Start, finite, library_problem


def hamiltonian(t0, t1, q0, p1, args):
    r"""Energy for unit mass; the planet's axis is z.

    H_D = |p1|²/2 − μ/r + μ J2 R²/(2 r³) (3 z²/r² − 1),    q0 = (x, y, z), r = |q0|
    """
    r2 = jnp.sum(q0**2)
    r = jnp.sqrt(r2)
    bulge = args["J2"] * args["R"] ** 2 / (2 * r2) * (3 * q0[2] ** 2 / r2 - 1)
    return jnp.sum(p1**2) / 2 - args["mu"] / r * (1 - bulge)


def axial_angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """L_z = x p_y − y p_x at t1, conserved by symmetry about the planet's axis."""
    return q1[0] * p1[1] - q1[1] * p1[0]


def angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """q × p at t1, shape (3,), which precesses about the axis."""
    return jnp.cross(q1, p1)


def osculating_elements(t0, t1, q0, p0, q1, p1, args):
    """(a, e, i, Ω, ω) of `dvi.elements.Keplerian` at t1, shape (5,)."""
    return jnp.stack(Keplerian.from_state(q1, p1, args["mu"])[:5])


def secular_rates(a, e, i, args):
    r"""Mean rates of node and perigee to first order in J2 [rad/time].

        dΩ/dt = −(3/2) n J2 (R/P)² cos i,    dω/dt = (3/4) n J2 (R/P)² (5 cos² i − 1),
        n = √(μ/a³),    P = a (1 − e²)

    a, e, i are mean elements; osculating ones differ by O(J2), the rates then by O(J2²).

    **Source** Kozai 1959, *Astron. J.* 64, 367.
    """
    n = jnp.sqrt(args["mu"] / a**3)
    size = n * args["J2"] * (args["R"] / (a * (1 - e**2))) ** 2
    return -1.5 * size * jnp.cos(i), 0.75 * size * (5 * jnp.cos(i) ** 2 - 1)


def _above_surface(q, p, args):
    if (radius := float(np.linalg.norm(q))) < args["R"]:
        raise ValueError(f"|q0| must be at least R = {args['R']}, of the planet, got {radius}.")


def oblate_kepler() -> Problem:
    """A satellite of the oblate Earth: a = 8000 km, e = 0.1, i = 50°, at perigee on the node.

    km, s and unit mass: p is the velocity. Node and perigee precess by `secular_rates`, −3.0° and
    +2.5° per day. Initial conditions and step are ours.

    **Source** Kozai 1959, *Astron. J.* 64, 367; μ, R and J2: EGM96 (Lemoine et al. 1998,
    NASA/TP-1998-206861).
    """
    mu, a, e, i = 398600.4415, 8000.0, 0.1, np.deg2rad(50)
    v = np.sqrt(mu / a * (1 + e) / (1 - e)) * np.array([0.0, np.cos(i), np.sin(i)])
    return library_problem(
        hamiltonian,
        Start("the satellite is one body in space", (3,), check=_above_surface),
        name="oblate_kepler",
        q0_p0_h=(np.array([a * (1 - e), 0.0, 0.0]), v, 10.0),
        parameters={
            "mu": Parameter(mu, "G times the mass of the planet [km³/s²]"),
            "R": Parameter(6378.1363, "equatorial radius of the planet [km]"),
            "J2": Parameter(1.0826267e-3, "quadrupole of the planet [1]", finite),
        },
        observables=[axial_angular_momentum, angular_momentum, osculating_elements],
        units={"q": "km", "p": "km/s", "t": "s", "energy": "km²/s²"},
        source="Kozai 1959, Astron. J. 64, 367; EGM96",
        invariants=("axial_angular_momentum",),
        symmetries={"rotation": rotation(0, 1)},
    )
