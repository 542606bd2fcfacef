"""The Kepler problem in the plane with the perturbing force −εq."""

import jax.numpy as jnp
from jax import lax

from ..discover.library import rotation, scaling
from ._problem import Parameter, Problem, Start, library_problem, over_times


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = |p1|²/2 − K²/|q0|, unit mass, attraction (the paper's (37) prints +K²)."""
    return jnp.sum(p1**2) / 2 - args["K"] ** 2 / jnp.sqrt(jnp.sum(q0**2))


def linear_force(t0, t1, q0, p1, args):
    """W = −q0 (the paper, before (44))."""
    return -q0


def mixed_energy(t0, t1, q0, p0, q1, p1, args):
    """H_{k−1}: H_D on the step that ends at t1; the E⁻ of (26) and (29)."""
    return hamiltonian(t0, t1, q0, p1, args)


def angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """L = x p_y − y p_x at t1, the paper's (42)."""
    return q1[0] * p1[1] - q1[1] * p1[0]


@over_times((2,))
def exact(t, q0, p0, args):
    r"""The state at times t on an ellipse at ε = 0.

        q = f q0 + g p0,    f = 1 − a (1 − cos x)/r0,  g = t − (x − sin x)/n,    n = K/a^(3/2)

    with x the increase of the eccentric anomaly, n t = x − e cos E0 sin x + e sin E0 (1 − cos x),
    solved by Newton's method. NaN for an unbound orbit, of energy ≥ 0. Elsewhere, also on a circle,
    differentiable in t, q0, p0 and K.
    **Source** Danby 1988, *Fundamentals of Celestial Mechanics*, 6.
    """
    mu, r0 = args["K"] ** 2, jnp.sqrt(jnp.sum(q0**2))
    inverse = 2 / r0 - jnp.sum(p0**2) / mu
    a = jnp.where(inverse > 0, 1 / inverse, jnp.nan)
    n = jnp.sqrt(mu / a**3)
    # e cos E0 and e sin E0
    ec, es = 1 - r0 / a, jnp.sum(q0 * p0) / jnp.sqrt(mu * a)
    whole = jnp.round(n * t / (2 * jnp.pi))
    mean = n * t - 2 * jnp.pi * whole
    # Only the first guess uses E0 and e, which are not differentiable on a circle.
    x = lax.stop_gradient(_first_guess(mean, ec, es))
    for _ in range(12):
        past = x - ec * jnp.sin(x) + es * (1 - jnp.cos(x)) - mean
        x = x - past / (1 - ec * jnp.cos(x) + es * jnp.sin(x))
    r = a * (1 - ec * jnp.cos(x) + es * jnp.sin(x))
    f, g = 1 - a / r0 * (1 - jnp.cos(x)), (mean - x + jnp.sin(x)) / n
    f_rate, g_rate = -jnp.sqrt(mu * a) / (r * r0) * jnp.sin(x), 1 - a / r * (1 - jnp.cos(x))
    return f * q0 + g * p0, f_rate * q0 + g_rate * p0


def _first_guess(mean, ec, es):
    """Increase of the eccentric anomaly from which Newton's method converges."""
    E0, e = jnp.arctan2(es, ec), jnp.sqrt(ec**2 + es**2)
    M = mean + E0 - es
    # On this side of M the equation is convex towards its root.
    return M + 0.85 * e * jnp.sign(jnp.sin(M)) - E0


def kepler() -> Problem:
    """The paper's Kepler problem with its initial conditions and h = 0.1; dimensionless, K = 1."""
    return library_problem(
        hamiltonian,
        Start(
            "the Kepler problem is in the plane (for more dimensions or bodies take n_body)",
            (2,),
            singular={"the centre": (0, 0)},
        ),
        name="kepler",
        q0=[0.0, 1.2],
        p0=[-1.0, -0.6],
        h=0.1,
        parameters={
            "K": Parameter(1.0, "root of the strength of attraction, K² = GM [length^(3/2)/time]"),
        },
        force=linear_force,
        observables=[mixed_energy, angular_momentum],
        source="the paper, Section 5.2",
        invariants=("angular_momentum",),
        symmetries={"rotation": rotation(), "scaling": scaling(q=1.0, p=-0.5, t=1.5)},
        exact=exact,
    )
