"""Point masses and rods with constraints: pendulum on a sphere, chain, slider-crank, dumbbell.

Positions are Cartesian. A rod of the vector a and the length l is the constraint (|a|² − l²)/2 = 0.
"""

import jax.numpy as jnp
import numpy as np

from ..base.checks import whole
from ._problem import Parameter, Problem, Start, System, finite, library_problem, over_times
from .spinning_top import exact as exact_of_top

_SI = {"q": "m", "p": "kg m/s", "t": "s", "energy": "J"}
_GRAVITY = Parameter(9.81, "gravity [m/s²]", finite)


def _excess(a, length):
    return (jnp.sum(a**2, axis=-1) - length**2) / 2


def _weights(t0, t1, q0, p1, args):
    """H_D = Σ |p_i|²/(2m) + m g Σ z_i of equal masses; z is the last coordinate."""
    return jnp.sum(p1**2) / (2 * args["m"]) + args["m"] * args["g"] * jnp.sum(q0[..., -1])


def _links(q, args):
    """Rods from the origin to the first mass, and on to the next ones."""
    q = jnp.atleast_2d(q)
    return _excess(q - jnp.pad(q[:-1], ((1, 0), (0, 0))), args["l"])


def vertical_momentum(t0, t1, q0, p0, q1, p1, args):
    """x p_y − y p_x at t1: the angular momentum about the vertical."""
    return q1[0] * p1[1] - q1[1] * p1[0]


@over_times((3,))
def _exact_on_sphere(t, q0, p0, args):
    """The state at times t, by `spinning_top` with p_ψ = 0: the axis of that top is a spherical
    pendulum. NaN for a motion through the vertical or on a horizontal circle."""
    m, l, g = args["m"], args["l"], args["g"]  # noqa: E741

    def frame(phi, theta):  # the direction e = q/l, ∂e/∂φ and ∂e/∂θ
        (s, c), (u, v) = ((jnp.sin(x), jnp.cos(x)) for x in (theta, phi))
        return jnp.array([[s * v, s * u, c], [-s * u, s * v, 0], [c * v, c * u, -s]])

    phi, theta = jnp.arctan2(q0[1], q0[0]), jnp.arctan2(jnp.hypot(q0[0], q0[1]), q0[2])
    angles, momenta = jnp.stack([phi, theta, 0]), jnp.append(l * frame(phi, theta)[1:] @ p0, 0)
    top = {"A": m * l**2, "C": 1.0, "w": m * g * l}
    (phi, theta, _), (p_phi, p_theta, _) = exact_of_top(t, angles, momenta, top)
    e, of_phi, of_theta = frame(phi, theta)
    return l * e, (p_theta * of_theta + p_phi / jnp.sin(theta) ** 2 * of_phi) / l


def spherical_pendulum() -> Problem:
    """A mass of 1 kg on a rod of 1 m, around q = 0; z points up.

    Initial state and step are our choice.

    **Source** Whittaker 1937, *Analytical Dynamics*, §55; Hairer, Lubich & Wanner 2006, VII.1.
    """
    return library_problem(
        System(_weights, constraint=_links),
        Start("the spherical pendulum is a point in space", (3,)),
        {"m": Parameter(1.0, "mass [kg]"), "l": Parameter(1.0, "length of the rod [m]"),
         "g": _GRAVITY},
        [vertical_momentum], name="spherical_pendulum", invariants=("vertical_momentum",),
        q0_p0_h=(np.array([0.8, 0.0, -0.6]), np.array([0.3, 1.0, 0.4]), 0.01), units=_SI,
        exact=_exact_on_sphere,
        source="Whittaker 1937, Analytical Dynamics, §55",
    )  # fmt: skip


def chain(links: int = 20) -> Problem:
    """A hanging chain of point masses of 1 kg on links of 0.1 m, released 0.4 rad to the side.

    In the plane or in space: q0 has the shape (n, 2) or (n, 3). Initial state and step are our
    choice.

    **Raises** `ValueError` for a number of links that is not a positive integer.

    **Source** Leimkuhler & Reich 2004, *Simulating Hamiltonian Dynamics*, 7.
    """
    distances = 0.1 * np.arange(1, whole("links", links) + 1)[:, None]
    return library_problem(
        System(_weights, constraint=_links),
        Start("the chain has positions of n masses", (None, None)),
        {"m": Parameter(1.0, "mass of each link [kg]"),
         "l": Parameter(0.1, "length of each link [m]"), "g": _GRAVITY}, name="chain", units=_SI,
        q0_p0_h=(distances * np.array([np.sin(0.4), -np.cos(0.4)]), np.zeros((links, 2)), 0.002),
        source="Leimkuhler & Reich 2004, Simulating Hamiltonian Dynamics, 7",
    )  # fmt: skip


def _inertia(args):
    """M_AA, M_AB and M_BB of the pin A and the slider B, with uniform rods."""
    crank, rod, slider = args["m1"], args["m2"], args["m3"]
    return (crank + rod) / 3, rod / 6, rod / 3 + slider


def _crank_energy(t0, t1, q0, p1, args):
    """H_D = tr(p1ᵀ M⁻¹ p1)/2 + g [(m1 + m2) y_A/2 + (m2/2 + m3) y_B]."""
    (a, b, c), (A, B) = _inertia(args), p1
    kinetic = (c * A @ A - 2 * b * A @ B + a * B @ B) / (2 * (a * c - b * b))
    weights = jnp.stack([(args["m1"] + args["m2"]) / 2, args["m2"] / 2 + args["m3"]])
    return kinetic + args["g"] * weights @ q0[:, 1]


def _rods_and_rail(q, args):
    lengths = jnp.stack([args["l1"], args["l2"]])
    return jnp.append(_excess(jnp.stack([q[0], q[1] - q[0]]), lengths), q[1, 1])


def slider_crank() -> Problem:
    """A slider-crank mechanism: crank, connecting rod, and a slider on a horizontal rail.

    q0 = (A, B): the pin between crank and rod, and the slider; the axle is at the origin. One
    degree of freedom, which starts at 60° with 5 rad/s. Values are ours.

    **Source** natural coordinates: García de Jalón & Bayo 1994, *Kinematic and Dynamic Simulation
    of Multibody Systems*, 2 and 4.
    """
    parameters = {
        "m1": Parameter(1.0, "mass of the crank [kg]"),
        "m2": Parameter(2.0, "mass of the connecting rod [kg]"),
        "m3": Parameter(1.5, "mass of the slider [kg]"),
        "l1": Parameter(0.3, "length of the crank [m]"),
        "l2": Parameter(0.8, "length of the connecting rod [m]"),
        "g": _GRAVITY,
    }
    args = {name: entry.value for name, entry in parameters.items()}
    (a, b, c), l1 = _inertia(args), args["l1"]
    x, y, rate = l1 / 2, l1 * np.sqrt(3) / 2, 5.0
    reach = np.sqrt(args["l2"] ** 2 - y**2)
    A, B = rate * np.array([[-y, x], [-y - x * y / reach, 0.0]])  # velocities
    q0, p0 = np.array([[x, y], [x + reach, 0.0]]), np.array([a * A + b * B, b * A + c * B])
    return library_problem(
        System(_crank_energy, constraint=_rods_and_rail),
        Start("the slider-crank has positions (A, B) in the plane", (2, 2)),
        parameters, name="slider_crank", units=_SI, q0_p0_h=(q0, p0, 0.002),
        source="García de Jalón & Bayo 1994, Kinematic and Dynamic Simulation, 2 and 4",
    )  # fmt: skip


def _dumbbell_energy(t0, t1, q0, p1, args):
    """H_D = Σ [|p_i|²/(2m_i) − μ m_i/|q_i|]."""
    m = jnp.stack([args["m1"], args["m2"]])
    kinetic = jnp.sum(p1**2, axis=1) / (2 * m)
    return jnp.sum(kinetic - args["mu"] * m / jnp.sqrt(jnp.sum(q0**2, axis=1)))


def _rod(q, args):
    return _excess(q[1:] - q[:1], args["l"])


def angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """Σ q_i × p_i at t1, shape (3,)."""
    return jnp.sum(jnp.cross(q1, p1), axis=0)


def dumbbell() -> Problem:
    """Two masses on a rigid rod in the gravity of a fixed centre; the rod librates in its orbit.

    Dimensionless; the rod is a tenth of the distance, so that its attitude changes the orbit. Start
    and step are ours.

    **Source** Beletsky 1966, *Motion of an Artificial Satellite about its Center of Mass*; Celletti
    & Sidorenko 2008, *Celest. Mech. Dyn. Astr.* 101, 105.
    """
    c, s = np.cos(0.5), np.sin(0.5)
    sides = np.array([[-1 / 3], [2 / 3]])  # of the centre of mass, as parts of the rod
    place = np.array([1.0, 0.0, 0.0]) + sides * np.array([0.1 * c, 0.1 * s, 0.0])
    turning = np.array([0.0, 1.05, 0.1]) + sides * np.array([-0.12 * s, 0.12 * c, 0.06])
    return library_problem(
        System(_dumbbell_energy, constraint=_rod),
        Start("the dumbbell has positions of two masses in space", (2, 3)),
        {"m1": Parameter(1.0, "first mass [mass]"), "m2": Parameter(0.5, "second mass [mass]"),
         "l": Parameter(0.1, "length of the rod [length]"),
         "mu": Parameter(1.0, "strength of the centre [length³/time²]")},
        [angular_momentum], name="dumbbell", invariants=("angular_momentum",),
        q0_p0_h=(place, np.array([[1.0], [0.5]]) * turning, 0.02),
        source="Celletti & Sidorenko 2008, Celest. Mech. Dyn. Astr. 101, 105",
    )  # fmt: skip
