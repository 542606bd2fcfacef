"""The Kepler problem with the kinetic energy of special relativity: a precessing ellipse."""

import jax.numpy as jnp
import numpy as np

from ..discover.symmetries.library import rotation
from ._problem import Parameter, Problem, Start, at_end, library_problem
from .kepler import angular_momentum


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = √(c⁴ + c²|p1|²) − c² − K²/|q0|, unit mass; separable."""
    square = jnp.sum(p1**2)
    # √(…) − c² without cancellation
    kinetic = square / (1 + jnp.sqrt(1 + square / args["c"] ** 2))
    return kinetic - args["K"] ** 2 / jnp.sqrt(jnp.sum(q0**2))


energy = at_end(hamiltonian)


def precession(q, p, args):
    r"""Exact advance of the perihelion per revolution [rad], positive in the sense of the motion.

        Δ = 2π (1/Γ − 1),    Γ² = 1 − K⁴/(c² L²),    L = q × p

    For the orbit 1/r = C (1 + e cos Γ(θ − θ0)). To first order in 1/c² it is πK⁴/(c²L²), a sixth
    of the value of general relativity. NaN for K² > c L: the orbit then reaches the centre.

    **Source** Sommerfeld 1916, *Ann. Phys.* 356, 1; Landau & Lifshitz, *The Classical Theory of
    Fields*, §39.
    """
    L = q[0] * p[1] - q[1] * p[0]
    return 2 * jnp.pi * (1 / jnp.sqrt(1 - args["K"] ** 4 / (args["c"] * L) ** 2) - 1)


def perihelion_angle(t0, t1, q0, p0, q1, p1, args):
    r"""Direction of the perihelion at t1 [rad], between −π and π, which advances steadily.

        The orbit has dr/dθ and 1/r with e cos ψ = 1/(Cr) − 1 and e sin ψ = p_r/(LΓC),
        ψ = Γ(θ − θ0),  C = K² (E + c²)/(c² L² Γ²);  the nearest perihelion, the last or the
        next, is at θ0 = θ − ψ/Γ, |ψ| ≤ π

    Constant except for a jump at each aphelion, by `precession` for L > 0 and by −`precession` for
    L < 0.
    """
    r = jnp.sqrt(jnp.sum(q1**2))
    L = angular_momentum(t0, t1, q0, p0, q1, p1, args)
    turn = jnp.sqrt(1 - args["K"] ** 4 / (args["c"] * L) ** 2)
    E = energy(t0, t1, q0, p0, q1, p1, args)
    C = args["K"] ** 2 * (1 + E / args["c"] ** 2) / (L * turn) ** 2
    psi = jnp.arctan2(jnp.sum(q1 * p1) / (r * L * turn * C), 1 / (C * r) - 1)
    angle = jnp.arctan2(q1[1], q1[0]) - psi / turn
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def _misses_the_centre(q, p, args):
    L = q[0] * p[1] - q[1] * p[0]
    if abs(L) * args["c"] <= args["K"] ** 2:
        raise ValueError(
            f"the angular momentum of q0 and p0 must satisfy |L| > K²/c = "
            f"{args['K'] ** 2 / args['c']}, got L = {L}: the orbit falls into the centre."
        )


def relativistic_kepler() -> Problem:
    """Relativistic Kepler problem: e ≈ 0.35, K = 1, c = 10, from perihelion; dimensionless.

    It precesses by 2.2° per revolution. Initial conditions and step are ours. General relativity:
    `relativity`, with `n_body`.

    **Source** Sommerfeld 1916, *Ann. Phys.* 356, 1.
    """
    rule = "the relativistic Kepler problem is in the plane"
    return library_problem(
        hamiltonian,
        Start(rule, (2,), singular={"the centre": (0, 0)}, check=_misses_the_centre),
        name="relativistic_kepler",
        q0_p0_h=(np.array([0.6, 0.0]), np.array([0.0, 1.5]), 0.02),
        parameters={
            "K": Parameter(1.0, "root of the strength of attraction, K² = GM [length^(3/2)/time]"),
            "c": Parameter(10.0, "speed of light [length/time]"),
        },
        observables=[angular_momentum, perihelion_angle],
        source="Sommerfeld 1916, Ann. Phys. 356, 1",
        invariants=("angular_momentum",),
        symmetries={"rotation": rotation()},
    )
