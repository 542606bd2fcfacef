"""The plane pendulum, solved by Jacobi's elliptic functions, disturbed by friction."""

import jax.numpy as jnp
import numpy as np

from .._system import System
from ._elliptic import complete, first_kind, jacobi, swing
from ._problem import Parameter, Problem, library_problem, over_times
from ._start import Start


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = p1²/2 − ω² cos q0, for unit mass and length."""
    return jnp.sum(p1**2) / 2 - args["omega"] ** 2 * jnp.sum(jnp.cos(q0))


def friction(t0, t1, q0, p1, args):
    """W = −p1: a friction εp."""
    return -p1


def modulus(q, p, args):
    """m = (E + ω²)/(2ω²) = sin²(q/2) + p²/(4ω²): below 1 it swings, above 1 it turns over."""
    return jnp.sum(jnp.sin(q / 2) ** 2 + (p / (2 * args["omega"])) ** 2)


def action(t0, t1, q0, p0, q1, p1, args):
    """J = ∮ p dq/2π = (8ω/π) (E(m) − (1 − m) K(m)) at t1, m ≤ 1; NaN where it turns over.

    E/ω to first order in m, dE/dJ the frequency πω/(2K(m)).
    """
    return 8 * args["omega"] / jnp.pi * swing(modulus(q1, p1, args))


def period(q, p, args):
    """4K(m)/ω of a swing, 2K(1/m)/(√m ω) of a full turn: the time after which it repeats.

    Infinite on the separatrix, m = 1.
    """
    m = modulus(q, p, args)
    swings = m < 1
    k, over = jnp.where(swings, m, 0.5), jnp.where(swings, 2.0, m)
    to_and_fro, turn = complete(k)[0], complete(1 / over)[0]
    return jnp.where(swings, 4 * to_and_fro, 2 * turn / jnp.sqrt(over)) / args["omega"]


@over_times((1,))
def exact(t, q0, p0, args):
    r"""The pendulum at times t of one that is at (q0, p0) at t = 0, without friction.

        m < 1:  sin(q/2) = √m sn(ωt + u | m),    p = 2ω√m cn(ωt + u | m)
        m > 1:  q = ±2 am(√m ωt + u | 1/m),      p = ±2ω√m dn(√m ωt + u | 1/m)

    - `t`: times, any shape. `q0` [rad], `p0` [rad/time]: shape (1,).

    Returns q, p of shape t.shape + (1,). Angles are not taken modulo 2π. At m = 1, on the
    separatrix, it is NaN; elsewhere, at rest too, it carries gradients in t, q0, p0 and ω.
    **Source** Whittaker 1937, *Analytical Dynamics*, §44.
    """
    w, m = args["omega"], modulus(q0, p0, args)
    m = jnp.where(m == 1, jnp.nan, m)
    swings = m < 1
    turns = 2 * jnp.pi * jnp.round(q0 / (2 * jnp.pi))
    # where it swings, sn, cn and dn of ωt + u by their sums: √m sn u, √m cn u and dn u are these,
    # and neither √m nor u, which have a corner at rest, is needed
    k, half = jnp.where(swings, m, 0.5), (q0 - turns) / 2
    S, P, D = jnp.sin(half), p0 / (2 * w), jnp.cos(half)
    sn, cn, dn, _ = jacobi(w * t, k)
    sine, cosine = S * cn * dn + sn * P * D, dn * D - sn * cn * S * P
    q_swing = turns + 2 * jnp.arctan2(sine, cosine)
    p_swing = 2 * w * (cn * P - sn * dn * S * D) / (cn**2 + (sn * D) ** 2)
    # where it turns over; either branch is given a modulus that it can live with
    over, sign = jnp.where(swings, 2.0, m), jnp.where(p0 < 0, -1.0, 1.0)
    root = jnp.sqrt(over)
    _, _, dn, am = jacobi(root * w * t + first_kind(sign * q0 / 2, 1 / over), 1 / over)
    q, p = (
        jnp.where(swings, q_swing, 2 * sign * am),
        jnp.where(swings, p_swing, 2 * sign * w * root * dn),
    )
    return q + 0 * m, p + 0 * m


def pendulum() -> Problem:
    """H = p²/2 − ω² cos q with the friction −εp, swinging to 2.0 rad; dimensionless.

    ω = 1, mass and length 1; q is measured from the lowest point. Start and step are ours.

    **Source** Whittaker 1937, *A Treatise on the Analytical Dynamics of Particles and Rigid
    Bodies*, §44.
    """
    return library_problem(
        System(hamiltonian, force=friction),
        Start("the pendulum is one angle", (1,)),
        name="pendulum",
        q0=np.array([1.5]),
        p0=np.array([1.0]),
        h=0.1,
        parameters={
            "omega": Parameter(1.0, "frequency of small swings [1/time]"),
        },
        observables=[action],
        units={"q": "rad", "p": "1", "t": "1", "energy": "1"},
        source="Whittaker 1937, Analytical Dynamics, §44",
        invariants=("action",),
        exact=exact,
    )
