"""Point masses and rods with constraints: pendulum on a sphere, chain, slider-crank, dumbbell.

The positions are Cartesian, and the constraints fix lengths, |a|² = l², or coordinates.
"""

import jax.numpy as jnp
import numpy as np

from .._checks import whole
from ._problem import Parameter, Problem, Start, finite, library_problem, over_times
from .spinning_top import exact as exact_of_top

_SI = {"q": "m", "p": "kg m/s", "t": "s", "energy": "J"}
_MASS, _LENGTH = Parameter(1.0, "mass [kg]"), Parameter(1.0, "length [m]")
_GRAVITY = Parameter(9.81, "gravity [m/s²]", finite)


def _sphere_energy(t0, t1, q0, p1, args):
    """H_D = |p1|²/(2m) + m g z."""
    return jnp.sum(p1**2) / (2 * args["m"]) + args["m"] * args["g"] * q0[2]


def _on_sphere(q, args):
    """(|q|² − l²)/2."""
    return (jnp.sum(q**2) - args["l"] ** 2)[None] / 2


def vertical_momentum(t0, t1, q0, p0, q1, p1, args):
    """x p_y − y p_x at t1: the angular momentum about the vertical."""
    return q1[0] * p1[1] - q1[1] * p1[0]


def tension(t0, t1, q0, p0, q1, p1, args):
    """(|p|²/m − m g z)/l at t1: the force of the rod on the mass, towards the centre."""
    return (jnp.sum(p1**2) / args["m"] - args["m"] * args["g"] * q1[2]) / args["l"]


@over_times((3,))
def _exact_on_sphere(t, q0, p0, args):
    """The state at times t, by the top of `spinning_top` with p_ψ = 0: its axis is a spherical
    pendulum. NaN for a motion through the vertical or on a horizontal circle."""
    l, A = args["l"], args["m"] * args["l"] ** 2  # noqa: E741

    def frame(theta, phi):  # l ∂e/∂θ and l ∂e/∂φ of the direction e = q/l
        (s, c), (u, v) = ((jnp.sin(x), jnp.cos(x)) for x in (theta, phi))
        zero = jnp.zeros_like(s)
        e = jnp.stack([s * v, s * u, c])
        return e, l * jnp.stack([c * v, c * u, -s]), l * jnp.stack([-s * u, s * v, zero])

    angles = jnp.arctan2(jnp.hypot(q0[0], q0[1]), q0[2]), jnp.arctan2(q0[1], q0[0])
    _, of_theta, of_phi = frame(*angles)
    start = jnp.stack([angles[1], angles[0], 0 * l])
    momenta = jnp.stack([p0 @ of_phi, p0 @ of_theta, 0 * l])
    top = {"A": A, "C": 1.0, "w": args["m"] * args["g"] * l}
    (phi, theta, _), (p_phi, p_theta, _) = exact_of_top(t, start, momenta, top)
    e, of_theta, of_phi = frame(theta, phi)
    s = jnp.sin(theta)
    return l * e, (p_theta * of_theta + p_phi / s**2 * of_phi) / l**2


def spherical_pendulum() -> Problem:
    """A mass of 1 kg on a rod of 1 m that moves on a sphere.

    q = 0 is the centre, z points up. Initial conditions and step are ours.

    **Source** Whittaker 1937, *Analytical Dynamics*, §55; Hairer, Lubich & Wanner 2006, VII.1.
    """
    return library_problem(
        _sphere_energy,
        Start("the spherical pendulum is a point in space", (3,)),
        name="spherical_pendulum",
        q0=np.array([0.8, 0.0, -0.6]),
        p0=np.array([0.3, 1.0, 0.4]),
        h=0.01,
        parameters={"m": _MASS, "l": _LENGTH, "g": _GRAVITY},
        observables=[vertical_momentum, tension],
        units=_SI,
        source="Whittaker 1937, Analytical Dynamics, §55",
        invariants=("vertical_momentum",),
        constraint=_on_sphere,
        exact=_exact_on_sphere,
    )


def _chain_energy(t0, t1, q0, p1, args):
    """H_D = Σ |p_i|²/(2m) + m g Σ y_i; y is the last coordinate."""
    return jnp.sum(p1**2) / (2 * args["m"]) + args["m"] * args["g"] * jnp.sum(q0[:, -1])


def _links(q, args):
    """(|q_i − q_{i−1}|² − l²)/2 with q_0 = 0."""
    ends = q - jnp.pad(q[:-1], ((1, 0), (0, 0)))
    return (jnp.sum(ends**2, axis=1) - args["l"] ** 2) / 2


def chain(links: int = 20) -> Problem:
    """A hanging chain of n point masses of 1 kg on links of 0.1 m, released 0.4 rad to the side.

    In the plane or in space: q0 has the shape (n, 2) or (n, 3), and gravity acts along the last
    coordinate. With two links it is `double_pendulum`. Initial conditions and step are ours.

    **Raises** `ValueError` for a number of links that is not a positive integer.

    **Source** Leimkuhler & Reich 2004, *Simulating Hamiltonian Dynamics*, 7.
    """
    along = 0.1 * np.arange(1, whole("links", links) + 1)[:, None]
    return library_problem(
        _chain_energy,
        Start("the chain has positions of n masses", (None, None)),
        name="chain",
        q0=along * np.array([np.sin(0.4), -np.cos(0.4)]),
        p0=np.zeros((links, 2)),
        h=0.002,
        parameters={
            "m": Parameter(1.0, "mass of each link [kg]"),
            "l": Parameter(0.1, "length of each link [m]"),
            "g": _GRAVITY,
        },
        units=_SI,
        source="Leimkuhler & Reich 2004, Simulating Hamiltonian Dynamics, 7",
        constraint=_links,
    )


def _inertia(args):
    """M_AA, M_AB and M_BB of the pin A and the slider B, with uniform rods."""
    crank, rod, slider = args["m1"], args["m2"], args["m3"]
    return (crank + rod) / 3, rod / 6, rod / 3 + slider


def _crank_energy(t0, t1, q0, p1, args):
    """H_D = tr(p1ᵀ M⁻¹ p1)/2 + g [(m1 + m2) y_A/2 + (m2/2 + m3) y_B]."""
    a, b, c = _inertia(args)
    A, B = p1
    kinetic = (c * A @ A - 2 * b * A @ B + a * B @ B) / (2 * (a * c - b * b))
    crank, rod, slider = args["m1"], args["m2"], args["m3"]
    heights = (crank + rod) / 2 * q0[0, 1] + (rod / 2 + slider) * q0[1, 1]
    return kinetic + args["g"] * heights


def _rods_and_rail(q, args):
    """(|A|² − l1²)/2, (|B − A|² − l2²)/2, y_B."""
    A, B = q
    rod = B - A
    lengths = A @ A - args["l1"] ** 2, rod @ rod - args["l2"] ** 2
    return jnp.stack([lengths[0] / 2, lengths[1] / 2, B[1]])


def crank_angle(t0, t1, q0, p0, q1, p1, args):
    """The angle of the crank from the rail at t1 [rad]."""
    return jnp.arctan2(q1[0, 1], q1[0, 0])


def slider_crank() -> Problem:
    """A slider-crank mechanism: a crank, a connecting rod and a slider on a horizontal rail.

    q0 = (A, B), the pin between crank and rod, and the slider: shape (2, 2); the axle of the crank
    is at the origin. One degree of freedom; it starts at 60° with 5 rad/s. Values are ours.

    **Source** natural coordinates: García de Jalón & Bayo 1994, *Kinematic and Dynamic Simulation
    of Multibody Systems*, 2 and 4; mechanism: Haug 1989, *Computer Aided Kinematics and Dynamics*.
    """
    masses, l1, l2, rate = {"m1": 1.0, "m2": 2.0, "m3": 1.5}, 0.3, 0.8, 5.0
    x, y = l1 / 2, l1 * np.sqrt(3) / 2
    reach = np.sqrt(l2**2 - y**2)
    A, B = rate * np.array([[-y, x], [-y - x * y / reach, 0.0]])  # velocities
    a, b, c = _inertia(masses)
    names = {"m1": "crank", "m2": "connecting rod", "m3": "slider"}
    parameters = {key: Parameter(m, f"mass of the {names[key]} [kg]") for key, m in masses.items()}
    parameters["l1"] = Parameter(l1, "length of the crank [m]")
    parameters["l2"] = Parameter(l2, "length of the connecting rod [m]")
    return library_problem(
        _crank_energy,
        Start("the slider-crank has positions (A, B) in the plane", (2, 2)),
        name="slider_crank",
        q0=np.array([[x, y], [x + reach, 0.0]]),
        p0=np.array([a * A + b * B, b * A + c * B]),
        h=0.002,
        parameters=parameters | {"g": _GRAVITY},
        observables=[crank_angle],
        units=_SI,
        source="García de Jalón & Bayo 1994, Kinematic and Dynamic Simulation, 2 and 4",
        constraint=_rods_and_rail,
    )


def _dumbbell_energy(t0, t1, q0, p1, args):
    """H_D = Σ |p_i|²/(2m_i) − μ Σ m_i/|q_i|."""
    m = jnp.stack([args["m1"], args["m2"]])
    distances = jnp.sqrt(jnp.sum(q0**2, axis=1))
    return jnp.sum(jnp.sum(p1**2, axis=1) / (2 * m)) - args["mu"] * jnp.sum(m / distances)


def _rod(q, args):
    """(|q2 − q1|² − l²)/2."""
    return (jnp.sum((q[1] - q[0]) ** 2) - args["l"] ** 2)[None] / 2


def angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """Σ q_i × p_i at t1, shape (3,)."""
    return jnp.sum(jnp.cross(q1, p1), axis=0)


def dumbbell() -> Problem:
    """Two masses on a rigid rod in the gravity of a fixed centre: it librates and moves in orbit.

    Dimensionless, μ = 1; the rod is a tenth of the distance, so that the gravity gradient and the
    effect of the attitude on the orbit are large. Initial conditions and step are ours.

    **Source** Beletsky 1966, *Motion of an Artificial Satellite about its Center of Mass*; Celletti
    & Sidorenko 2008, *Celest. Mech. Dyn. Astr.* 101, 105.
    """
    rod = 0.1 * np.array([np.cos(0.5), np.sin(0.5), 0.0])
    turning = 1.2 * np.array([-rod[1], rod[0], 0.5 * 0.1])
    m, centre, velocity = np.array([[1.0], [0.5]]), np.array([1.0, 0, 0]), np.array([0, 1.05, 0.1])
    sides = np.array([[-0.5], [1.0]]) / 1.5
    return library_problem(
        _dumbbell_energy,
        Start("the dumbbell has positions of two masses in space", (2, 3)),
        name="dumbbell",
        q0=centre + sides * rod,
        p0=m * (velocity + sides * turning),
        h=0.02,
        parameters={
            "m1": Parameter(1.0, "first mass [mass]"),
            "m2": Parameter(0.5, "second mass [mass]"),
            "l": Parameter(0.1, "length of the rod [length]"),
            "mu": Parameter(1.0, "strength of the centre [length³/time²]"),
        },
        observables=[angular_momentum],
        source="Celletti & Sidorenko 2008, Celest. Mech. Dyn. Astr. 101, 105",
        invariants=("angular_momentum",),
        constraint=_rod,
    )
