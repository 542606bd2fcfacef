"""Parts of cases that several modules use: samples, potentials, and forms that a map conserves."""

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi


def box(n, count, low=-1.0, high=1.0):
    """Uniform samples in a box of 2n dimensions."""
    return lambda rng: (rng.uniform(low, high, (count, n)), rng.uniform(low, high, (count, n)))


def sized(n, count, q, p):
    """Uniform samples, with |q_i| below `q` and |p_i| below `p`."""
    return lambda rng: (rng.uniform(-q, q, (count, n)), rng.uniform(-p, p, (count, n)))


def shell(n, count, inner=0.5, outer=2.0, speed=1.0):
    """Positions between two radii, uniform in the logarithm of the radius, and momenta in a box."""

    def draw(rng):
        way = rng.normal(size=(count, n))
        r = np.exp(rng.uniform(np.log(inner), np.log(outer), count))
        q = way * (r / np.linalg.norm(way, axis=1))[:, None]
        return q, rng.uniform(-speed, speed, (count, n))

    return draw


def timed(samples, low=0.0, high=10.0):
    """The samples, at uniform times."""

    def draw(rng):
        q, p = samples(rng)
        return q, p, rng.uniform(low, high, len(q))

    return draw


def potential(slope):
    """A function of one number that has this derivative. Only the derivative enters a map: its
    value is not computed (it is often a dilogarithm)."""

    @jax.custom_jvp
    def V(x):
        return jnp.zeros_like(x)

    @V.defjvp
    def _(primals, tangents):
        return jnp.zeros_like(primals[0]), slope(primals[0]) * tangents[0]

    return V


def separable(V):
    """The system with H_D = p1·p1/2 + V(q0)."""
    return dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q))


def additive(f, h=1.0):
    """The system with the map q₊ + q₋ = f(q) of one coordinate, and p = (q − q₋)/h."""
    V = potential(lambda q: (2 * q - f(q)) / h**2)
    return separable(lambda q: jnp.sum(V(q)))


def kicked(K, h):
    """The step p1 = p − h K q, q1 = q + h p1."""
    K = jnp.asarray(K, float)

    def step(q, p):
        p = p - h * (K @ q)
        return q + h * p, p

    return step


def area(step, times=1):
    """ω(z, Mᵏz) = q·p' − p·q' of a linear step M; M conserves it since M is symplectic:
    ω(Mz, Mᵏ⁺¹z) = ω(z, Mᵏz)."""

    def form(q, p):
        q1, p1 = q, p
        for _ in range(times):
            q1, p1 = step(q1, p1)
        return q @ p1 - p @ q1

    return form


def turning(i, j):
    """Angular momentum q_i p_j − q_j p_i."""
    return lambda q, p: q[i] * p[j] - q[j] * p[i]


def total(k):
    """Component k of the total momentum of particles, for p of shape (particles, dimensions)."""
    return lambda q, p: jnp.sum(p[:, k])


def component(k):
    """p_k."""
    return lambda q, p: p[k]
