"""A weight on a spring in the plane whose stiffness grows a little with its length.

Replace the functions by your own; each is plain JAX. The TOML files refer to the objects of this
file as "system.py:system", "system.py:energy".
"""

import jax.numpy as jnp

import dvi_jax as dvi


def H_D(t0, t1, q0, p1, args):
    """The discrete Hamiltonian of a step from t0 to t1 [energy]: here H at (q0, p1).

    q0: position at the start of the step, shape (2,) [m]; p1: momentum at its end [kg m/s].
    """
    return p1 @ p1 / (2 * args["mass"]) + args["stiffness"] * (q0 @ q0) / 2


def W(t0, t1, q0, p1, args):
    """The perturbing force, which epsilon multiplies: −|q|² q, a stiffer spring.

    For friction write -p1; a perturbation with a potential can be System(..., perturbation=).
    """
    return -jnp.sum(q0**2) * q0


system = dvi.System(H_D, force=W)


# An observable is a function of the state: (q, p), or (t, q, p, args) if it needs t or args.
def energy(t, q, p, args):
    """The energy without the perturbation [J]."""
    return p @ p / (2 * args["mass"]) + args["stiffness"] * (q @ q) / 2


def angular_momentum(q, p):
    """q × p [kg m²/s]: conserved to round-off, because the system has no preferred direction."""
    return q[0] * p[1] - q[1] * p[0]
