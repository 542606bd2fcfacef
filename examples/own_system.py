"""A user-defined system: the double pendulum, whose steps are implicit."""

import jax.numpy as jnp

import dvi_jax as dvi


def hamiltonian(t, q, p, args):
    """H(t, q, p) of two equal masses on rods of equal length [energy].

        H = (p1² + 2 p2² − 2 p1 p2 cos(q1 − q2)) / (2 m l² (1 + sin²(q1 − q2)))
            − m g l (2 cos q1 + cos q2)

    q: angles from the vertical [rad]; p: angular momenta. The kinetic energy depends on q, so
    the step is implicit: dvi_jax solves it, and differentiates through the solve.
    """
    mass, length, g = args["mass"], args["length"], args["gravity"]
    between = q[0] - q[1]
    kinetic = (p[0] ** 2 + 2 * p[1] ** 2 - 2 * p[0] * p[1] * jnp.cos(between)) / (
        2 * mass * length**2 * (1 + jnp.sin(between) ** 2)
    )
    return kinetic - mass * g * length * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


def friction(t0, t1, q0, p1, args):
    """W: the perturbing force, here −p at both joints. `epsilon` is its strength [1/time]."""
    return -p1


# From a continuous Hamiltonian to a discrete one. A discrete one of your own,
# H_D(t0, t1, q0, p1, args), goes into dvi.System directly.
system = dvi.System(dvi.discretise(hamiltonian), force=friction)


# An observable is a function of one step: both ends of it, and args.
def energy(t0, t1, q0, p0, q1, p1, args):
    return hamiltonian(t1, q1, p1, args)
