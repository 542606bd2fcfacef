"""The plane pendulum, its solution by Jacobi's elliptic functions, and friction."""

import jax.numpy as jnp
import numpy as np

from ._elliptic import complete, first_kind, jacobi, swing
from ._problem import Parameter, Problem, Start, System, library_problem, over_times


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = p1²/2 − ω² cos q0, for unit mass and length."""
    return jnp.sum(p1**2) / 2 - args["omega"] ** 2 * jnp.sum(jnp.cos(q0))


def friction(t0, t1, q0, p1, args):
    """W = −p1: a friction εp."""
    return -p1


def modulus(q, p, args):
    """m = (E + ω²)/(2ω²) = sin²(q/2) + p²/(4ω²): libration below 1, rotation above 1."""
    return jnp.sum(jnp.sin(q / 2) ** 2 + (p / (2 * args["omega"])) ** 2)


def action(t0, t1, q0, p0, q1, p1, args):
    """J = ∮ p dq/2π = (8ω/π) (E(m) − (1 − m) K(m)) at t1, m ≤ 1; NaN for a rotation.

    E/ω to first order in m, dE/dJ the frequency πω/(2K(m)).
    """
    return 8 * args["omega"] / jnp.pi * swing(modulus(q1, p1, args))


def period(q, p, args):
    """Period: 4K(m)/ω of a libration, 2K(1/m)/(√m ω) of a rotation, infinite at m = 1."""
    m = modulus(q, p, args)
    swings = m < 1
    k, large = jnp.where(swings, m, 0.5), jnp.where(swings, 2.0, m)
    libration, rotation = 4 * complete(k)[0], 2 * complete(1 / large)[0] / jnp.sqrt(large)
    return jnp.where(swings, libration, rotation) / args["omega"]


@over_times((1,))
def exact(t, q0, p0, args):
    r"""The state [rad], [rad/time] at times t without friction.

        m < 1:  sin(q/2) = √m sn(ωt + u | m),    p = 2ω√m cn(ωt + u | m)
        m > 1:  q = ±2 am(√m ωt + u | 1/m),      p = ±2ω√m dn(√m ωt + u | 1/m)

    Angles are not taken modulo 2π. NaN on the separatrix, m = 1; elsewhere, also at rest,
    differentiable in t, q0, p0 and ω. **Source** Whittaker 1937, *Analytical Dynamics*, §44.
    """
    w, m = args["omega"], modulus(q0, p0, args)
    m = jnp.where(m == 1, jnp.nan, m)
    swings = m < 1
    turns = 2 * jnp.pi * jnp.round(q0 / (2 * jnp.pi))
    # Libration: sn, cn and dn of ωt + u by addition formulas. √m sn u, √m cn u and dn u are S, P
    # and D, so that neither √m nor u, which are not differentiable at rest, is needed.
    k, half = jnp.where(swings, m, 0.5), (q0 - turns) / 2
    S, P, D = jnp.sin(half), p0 / (2 * w), jnp.cos(half)
    sn, cn, dn, _ = jacobi(w * t, k)
    sine, cosine = S * cn * dn + sn * P * D, dn * D - sn * cn * S * P
    q_swing = turns + 2 * jnp.arctan2(sine, cosine)
    p_swing = 2 * w * (cn * P - sn * dn * S * D) / (cn**2 + (sn * D) ** 2)
    # Rotation. Each branch has a valid modulus also where the other applies: no NaN in gradients.
    large, sign = jnp.where(swings, 2.0, m), jnp.where(p0 < 0, -1.0, 1.0)
    root = jnp.sqrt(large)
    _, _, dn, am = jacobi(root * w * t + first_kind(sign * q0 / 2, 1 / large), 1 / large)
    q = jnp.where(swings, q_swing, 2 * sign * am)
    p = jnp.where(swings, p_swing, 2 * sign * w * root * dn)
    return q + 0 * m, p + 0 * m


def pendulum() -> Problem:
    """H = p²/2 − ω² cos q with the friction −εp, in a libration to 2.0 rad; dimensionless.

    ω = 1, mass and length 1; q is measured from the lowest point. Initial conditions and step are
    ours.

    **Source** Whittaker 1937, *A Treatise on the Analytical Dynamics of Particles and Rigid
    Bodies*, §44.
    """
    return library_problem(
        System(hamiltonian, friction),
        Start("the pendulum has one angle", (1,)),
        name="pendulum",
        q0_p0_h=(np.array([1.5]), np.array([1.0]), 0.1),
        parameters={"omega": Parameter(1.0, "frequency of small oscillations [1/time]")},
        observables=[action],
        units={"q": "rad", "p": "1", "t": "1", "energy": "1"},
        source="Whittaker 1937, Analytical Dynamics, §44",
        invariants=("action",),
        exact=exact,
    )
