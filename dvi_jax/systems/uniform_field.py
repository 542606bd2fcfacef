"""A charged particle in uniform magnetic and electric fields."""

import jax.numpy as jnp
import numpy as np

from ..discover.functions.generators import Generator
from ._problem import Parameter, Problem, Start, bound, library_problem, nonzero, over_times, vector


def vector_potential(q, args):
    """A = B/2 (−y, x, 0), of B along z."""
    return args["B"] / 2 * jnp.stack([-q[1], q[0], jnp.zeros_like(q[2])])


def kinetic_momentum(q, p, args):
    """m v = p − e A(q): shape (3,)."""
    return p - args["charge"] * vector_potential(q, args)


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = |p1 − e A(q0)|²/(2m) − e E·q0, with canonical momenta p = mv + eA: not separable."""
    kinetic = jnp.sum(kinetic_momentum(q0, p1, args) ** 2) / (2 * args["mass"])
    return kinetic - args["charge"] * jnp.sum(jnp.asarray(args["E"], q0.dtype) * q0)


def drift(args):
    """E × B/B², the velocity of the guiding centre across B: shape (3,)."""
    E = jnp.asarray(args["E"])
    return jnp.stack([E[1], -E[0], jnp.zeros_like(E[0])]) / args["B"]


def magnetic_moment(t0, t1, q0, p0, q1, p1, args):
    """m |v⊥ − E × B/B²|²/(2B) at t1: exactly conserved in a uniform field."""
    turning = kinetic_momentum(q1, p1, args) / args["mass"] - drift(args).astype(q1.dtype)
    return args["mass"] * jnp.sum(turning[:2] ** 2) / (2 * args["B"])


def kinetic_energy(t0, t1, q0, p0, q1, p1, args):
    """m|v|²/2 at t1, which the electric field changes."""
    return jnp.sum(kinetic_momentum(q1, p1, args) ** 2) / (2 * args["mass"])


def pseudomomentum(t0, t1, q0, p0, q1, p1, args):
    """K = p + e B × q/2 − e E t1 at t1, shape (3,), conserved by magnetic translations."""
    half = args["charge"] * args["B"] / 2
    normal = jnp.stack([-q1[1], q1[0], jnp.zeros_like(q1[2])])
    return p1 + half * normal - args["charge"] * jnp.asarray(args["E"], q1.dtype) * t1


def _translation(axis):
    """ξ = a, η = e B × a/2: a translation with the change of gauge that A needs."""
    a = np.eye(3)[axis]
    return Generator(xi=bound(_xi, a), eta=bound(_eta, a))


def _xi(a, t, q, p, args):
    return jnp.asarray(a, q.dtype)


def _eta(a, t, q, p, args):
    return args["charge"] * args["B"] / 2 * jnp.asarray([-a[1], a[0], 0.0], p.dtype)


@over_times((3,))
def exact(t, q0, p0, args):
    r"""The state at times t, with w = v⊥ − E × B/B²:

        w(t) = w cos Ωt + (w × ẑ) sin Ωt,    z = z0 + v_z t + e E_z t²/(2m),    Ω = eB/m
        q⊥ = q⊥0 + (E × B/B²) t + [w sin Ωt + (w × ẑ)(1 − cos Ωt)]/Ω

    **Source** Jackson 1999, *Classical Electrodynamics*, 12.2–12.3.
    """
    m, turn = args["mass"], args["charge"] * args["B"] / args["mass"]
    push = args["charge"] * jnp.asarray(args["E"])[2] / m
    guide = drift(args)
    v = kinetic_momentum(q0, p0, args) / m
    w, c, s = v - guide, jnp.cos(turn * t), jnp.sin(turn * t)
    x = q0[0] + guide[0] * t + (w[0] * s + w[1] * (1 - c)) / turn
    y = q0[1] + guide[1] * t + (w[1] * s - w[0] * (1 - c)) / turn
    z = q0[2] + v[2] * t + push * t**2 / 2
    vx = guide[0] + w[0] * c + w[1] * s
    vy = guide[1] + w[1] * c - w[0] * s
    half = args["charge"] * args["B"] / 2
    p = jnp.stack([m * vx - half * y, m * vy + half * x, m * (v[2] + push * t)])
    return jnp.stack([x, y, z]), p


def uniform_field() -> Problem:
    """A charged particle in the fields B = ẑ and E = 0.1 x̂: gyration and drift; dimensionless.

    e = m = B = 1: gyrofrequency 1. Initial conditions and step are ours.

    **Source** Jackson 1999, *Classical Electrodynamics*, 12.2–12.3; pseudomomentum: Johnson &
    Lippmann 1949, *Phys. Rev.* 76, 828.
    """
    return library_problem(
        hamiltonian,
        Start("the field holds one particle in space", (3,)),
        name="uniform_field",
        q0_p0_h=(np.array([1.0, 0.0, 0.0]), np.array([0.0, -0.5, 0.2]), 0.1),
        parameters={
            "charge": Parameter(1.0, "e [charge]", nonzero),
            "mass": Parameter(1.0, "m [mass]"),
            "B": Parameter(1.0, "magnetic field along z [mass/(charge time)]", nonzero),
            "E": Parameter(
                np.array([0.1, 0.0, 0.0]), "electric field [mass length/(charge time²)]", vector(3)
            ),
        },
        observables=[magnetic_moment, pseudomomentum, kinetic_energy],
        units={"q": "1", "p": "1", "t": "1/gyrofrequency", "energy": "1"},
        source="Jackson 1999, Classical Electrodynamics, 12.2–12.3",
        invariants=("magnetic_moment", "pseudomomentum"),
        symmetries={f"magnetic_translation_{x}": _translation(i) for i, x in enumerate("xyz")},
        exact=exact,
    )
