r"""The sine-Gordon equation in one dimension: kinks and breathers, also damped and driven.

∂²u/∂t² = ∂²u/∂x² − sin u + ε (drive − damping ∂u/∂t)
"""

import jax.numpy as jnp
import numpy as np

from ..base.checks import finite, one_of, whole
from ._fields import (
    ends_of,
    field_energy,
    hamiltonian_of,
    observables_of,
    parameters_of,
    places,
    sech,
    start_of,
    step_size,
)
from ._problem import Parameter, Problem, System, interval, library_problem


def _hamiltonian(ends, t0, t1, q0, p1, args):
    r"""H_D = Σ_j p1_j²/(2 dx) + (q0_{j+1} − q0_j)²/(2 dx) + dx (1 − cos q0_j), p = ∂u/∂t dx."""
    return field_energy(q0, p1, args, ends, 1 - jnp.cos(q0))


def drive_force(t0, t1, q0, p1, args):
    """W = drive dx: a constant force on each cell."""
    return jnp.full_like(q0, args["drive"] * args["dx"])


def drive_and_friction(t0, t1, q0, p1, args):
    """W = drive dx − damping p1: a constant force and friction."""
    return drive_force(t0, t1, q0, p1, args) - args["damping"] * p1


def kink(t, x, velocity=0.0):
    r"""u and ∂u/∂t of a kink of the field equation, which goes from 0 to 2π.

        u = 4 arctan e^ξ,    ξ = γ (x − vt),    γ = 1/√(1 − v²)

    Its energy is 8γ, and its momentum 8γv. t and x: arrays that can be broadcast.
    """
    gamma = 1 / np.sqrt(1 - velocity**2)
    xi = gamma * (np.asarray(x) - velocity * np.asarray(t))
    # Both tails to full accuracy: the kink is 2π minus its mirror image.
    small = 4 * np.arctan(np.exp(-np.abs(xi)))
    return np.where(xi > 0, 2 * np.pi - small, small), -2 * gamma * velocity * sech(xi)


def breather(t, x, frequency=0.5, velocity=0.0):
    r"""u and ∂u/∂t of a breather of the field equation.

        u = 4 arctan[(s/ω) sin(ωτ)/cosh(sξ)],    s = √(1 − ω²)

    ξ = γ (x − vt), τ = γ (t − vx), γ = 1/√(1 − v²). Its energy is 16 s γ, its momentum 16 s γ v,
    and its action J = 16 arccos ω; at v = 0 it satisfies dE/dJ = ω.
    """
    x, t = np.asarray(x), np.asarray(t)
    gamma, s = 1 / np.sqrt(1 - velocity**2), np.sqrt(1 - frequency**2)
    xi, phase = gamma * (x - velocity * t), frequency * gamma * (t - velocity * x)
    size = s / frequency * sech(s * xi)
    F = size * np.sin(phase)
    rate = size * gamma * frequency * np.cos(phase)
    rate = rate + F * gamma * velocity * s * np.tanh(s * xi)
    return 4 * np.arctan(F), 4 * rate / (1 + F**2)


def breather_action(energy, momentum=0.0):
    """J = 16 arcsin(√(E² − P²)/16) of a breather, an adiabatic invariant; NaN if it has none."""
    return 16 * jnp.arcsin(jnp.sqrt(energy**2 - momentum**2) / 16)


def kink_velocity(t0, t1, q0, p0, q1, p1, args):
    """−Σ_j p_j/2π at t1: the velocity of a single kink, for its drift through any distance."""
    return -jnp.sum(p1) / (2 * np.pi)


def sine_gordon(
    n: int = 64, dx: float = 0.4, ends: str = "periodic", start: str = "breather", *,
    velocity: float = 0.2, frequency: float = 0.5, damping: float = 0.0, drive: float = 0.0,
) -> Problem:  # fmt: skip
    r"""The sine-Gordon equation on n sites: a moving breather, or a kink, also damped and driven.

        ∂²u/∂t² = ∂²u/∂x² − sin u + ε (drive − damping ∂u/∂t)

    Dimensionless: the velocity of waves and their smallest frequency are 1. The differences in
    space have order 2 in dx; q = u and p = ∂u/∂t dx.

    - `ends`: "periodic" (a ring), "free", or "fixed": u beyond the ends is ``args["left"]`` = 0 and
      ``args["right"]`` = 0, or 2π with a kink.
    - `start`: "breather" with this `velocity` and `frequency` ω < 1, or "kink" with this velocity.
      On a ring with a kink the winding number is 1: u is larger by 2π after one turn.
    - `damping`, `drive`: of the perturbing force ε (drive − damping ∂u/∂t), which the system has if
      one of them is not zero. A damping makes the steps implicit in p.

    The observables are `energy`, `field_momentum`, `kink_velocity` of a kink, and
    `topological_charge` at free ends. `kink`, `breather` and `breather_action` of the module are
    solutions of the field equation and their adiabatic invariant.

    **Raises** `ValueError` for fewer than three sites, unknown `ends` or `start`, a velocity not
    between −1 and 1, a frequency not between 0 and 1.

    **Source** McLaughlin & Scott 1978, *Phys. Rev. A* 18, 1652.
    """
    n = whole("n", n, 3, hint="The lattice has at least three sites.")
    ends_of_axis = ends_of(ends, 1)
    interval(-1.0, 1.0)("velocity", velocity)
    interval(0.0, 1.0)("frequency", frequency)
    is_kink = one_of("start", start, ("breather", "kink")) == "kink"
    parameters = parameters_of(dx, ends_of_axis, 0.0, 2 * np.pi if is_kink else 0.0)
    if is_kink and ends == "periodic":
        parameters["winding"] = Parameter(1.0, "turns of u along the ring [1]", finite)
    force = None
    if damping or drive:
        force = drive_force
        parameters["drive"] = Parameter(drive, "force density at ε = 1 [1]", finite)
    if damping:  # the steps are then implicit in p
        force = drive_and_friction
        parameters["damping"] = Parameter(damping, "rate of friction at ε = 1 [1/time]", finite)
    x = places(n, dx)
    u, rate = kink(0.0, x, velocity) if is_kink else breather(0.0, x, frequency, velocity)
    return library_problem(
        System(hamiltonian_of(_hamiltonian, ends_of_axis), force=force),
        start_of("the sine-Gordon equation", 1),
        parameters,
        [*observables_of(ends_of_axis, 2 * np.pi), *[kink_velocity] * is_kink],
        name="sine_gordon",
        q0_p0_h=(u, rate * dx, step_size(dx, 1)),
        source="McLaughlin & Scott 1978, Phys. Rev. A 18, 1652",
    )
