"""Multipoles in bends: Maxwell's equations, and trajectories in the field by DOP853."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from dvi_jax.systems import rings
from dvi_jax.systems.rings import _curved
from dvi_jax.systems.rings._maps import Particle

RHO, LENGTH = 7.5, 1.5
ANGLE = LENGTH / RHO


@jax.jit
@functools.partial(jnp.vectorize, excluded=(2, 3, 4), signature="(),()->(2)")
def field_at(x, y, b, a, h):
    """(B_x, B_y) from the kick."""
    par = {"h": h} | {f"b{n}": v for n, v in enumerate(b)} | {f"a{n}": v for n, v in enumerate(a)}
    kick = _curved.curved_kick(Particle(x, 0.0, y, 0.0, 0.0, 0.0), 1.0, par, len(b) - 1)
    return jnp.array([kick.py, -kick.px]) / (1 + h * x)


# Polynomials in R² and y that are fields without sources with rotational symmetry, (B_R, B_y):
# gradients of harmonic functions, upright and skew.
HARMONICS = (
    lambda R, y: (0 * R, 1 + 0 * R),
    lambda R, y: (2 * R * y, R * R - 2 * y * y),
    lambda R, y: (4 * R**3 * y - 16 / 3 * R * y**3, R**4 - 8 * R * R * y * y + 8 / 3 * y**4),
    lambda R, y: (2 * R, -4 * y),
    lambda R, y: (4 * R**3 - 16 * R * y * y, -16 * R * R * y + 32 / 3 * y**3),
)


def combination(b1, b3, a1):
    """The coefficients of HARMONICS with b_0 = a_0 = 0, and the multipoles b and a at R = RHO."""
    gamma, s4 = b3 / (4 * RHO), a1 / (8 * RHO**2)
    beta = (b1 - 4 * gamma * RHO**3) / (2 * RHO)
    s2 = -2 * s4 * RHO**2
    alpha = -(beta * RHO**2 + gamma * RHO**4)
    b = (0.0, b1, beta + 6 * gamma * RHO**2, 4 * gamma * RHO, gamma)
    a = (0.0, a1, 12 * s4 * RHO, 4 * s4, 0.0)
    return (alpha, beta, gamma, s2, s4), b, a


def exact_field(R, y, weights):
    pairs = [harmonic(R, y) for harmonic in HARMONICS]
    return [sum(w * p[i] for w, p in zip(weights, pairs, strict=True)) for i in (0, 1)]


def test_the_field_is_the_one_of_magnets_with_rotational_symmetry():
    weights, b, a = combination(-0.4, 0.3, 0.2)
    x, y = jnp.array([[0.01, -0.03, 0.2, 1.0], [0.02, 0.05, 0.1, -0.1]])
    ours = field_at(x, y, b, a, 1 / RHO)
    np.testing.assert_allclose(
        ours, np.stack(exact_field(RHO + x, y, weights), -1), rtol=1e-12, atol=1e-13
    )


def test_multipoles_of_each_order_satisfy_the_equations_of_maxwell():
    x, y = jnp.array([0.03, -0.05, 0.02]), jnp.array([0.04, 0.02, -0.06])
    b, a = jax.random.normal(jax.random.key(3), (2, 5)) * 30.0 ** np.tile(np.arange(5.0), (2, 1))

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, 0, None))
    def defects(x, y, h):
        """Curl and divergence, relative to the derivatives of the field."""

        def field(point):
            return field_at(*point, [*b], [*a], h)

        (B_x, _), J = field(jnp.stack([x, y])), jax.jacfwd(field)(jnp.stack([x, y]))
        divergence = (1 + h * x) * (J[0, 0] + J[1, 1]) + h * B_x
        return jnp.stack([J[1, 0] - J[0, 1], divergence]) / jnp.abs(J).max()

    for h in (0.0, 1 / RHO, -0.5):
        curl, divergence = jnp.abs(defects(x, y, h)).max(0)
        assert divergence < 1e-14
        assert curl < 1e-14 + (0.06 * h) ** 6
        wanted = np.stack([np.polyval(c[::-1], x) for c in (a, b)], -1)
        np.testing.assert_allclose(field_at(x, 0 * y, [*b], [*a], h), wanted, rtol=1e-13)
    z = np.polyval(np.asarray(b + 1j * a)[::-1], np.asarray(x + 1j * y))
    straight = field_at(x, y, [*b], [*a], 0.0)
    np.testing.assert_allclose(straight, np.stack([z.imag, z.real], -1), rtol=1e-13)


def flight(z, weights):
    """The particle behind a sector bend, in Cartesian coordinates (X, Y, height): DOP853."""
    (x, px, y, py, _, delta), h = z, 1 / RHO
    p = 1 + delta
    pz = np.sqrt(p * p - px * px - py * py)
    end = np.array([np.cos(ANGLE), np.sin(ANGLE)])
    ahead = np.array([-end[1], end[0]])

    def rate(s, u):
        R = np.hypot(u[0], u[1])
        B_R, B_y = exact_field(R, u[2], weights)
        B = np.array([B_R * u[0] / R, B_R * u[1] / R, B_y + h])
        return np.concatenate([u[3:], np.cross(B, u[3:]) / p])

    def beyond(s, u):
        return u[:2] @ ahead

    beyond.terminal = True
    start = np.array([RHO + x, 0.0, y, px / p, pz / p, py / p])
    found = solve_ivp(rate, (0, 2 * LENGTH), start, "DOP853", rtol=1e-12, atol=1e-14, events=beyond)
    u, path = found.y_events[0][0], found.t_events[0][0]
    R = u[:2] @ end
    return np.array([R - RHO, p * u[3:5] @ end, u[2], p * u[5], LENGTH - path, delta])


@pytest.mark.parametrize("multipoles", [(-0.4, 0.0, 0.0), (0.6, 0.02, 0.3)])
def test_exact_bends_agree_with_dop853(multipoles):
    """The paraxial model does not, by the square of the amplitude."""
    weights, b, a = combination(*multipoles)
    z = np.array([0.01, 1e-3, 0.012, -2e-3, 0.0, 0.01])
    wanted = flight(z, weights)

    def error(model):
        bend = rings.bend("B", LENGTH, ANGLE, b, a, model=model, scheme=6, slices=20)
        body = dataclasses.replace(bend, parts=tuple(p for p in bend.parts if "bend" in p.name))
        return np.abs(rings.one_turn(rings.Ring([body]), jnp.asarray(z)) - wanted).max()

    assert error("exact") < 1e-9
    assert error("paraxial") > 3e-6


def in_plane(x, px, delta, length, h, k1):
    """(x, px) behind a bend by integration in the plane y = 0, of the definition of k1."""

    def rate(s, u):
        pz = np.sqrt((1 + delta) ** 2 - u[1] ** 2)
        wide = 1 + h * u[0]
        return [wide * u[1] / pz, h * pz - wide * (h + k1 * u[0])]

    return solve_ivp(rate, (0, length), [x, px], "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]


@pytest.mark.slow
def test_the_chromaticity_of_combined_function_magnets():
    """As in the PS of CERN: bends with gradients of both signs, without other magnets."""
    length, h, k = 2.2, 0.0142, 0.057

    def cell(u, delta):
        return in_plane(*in_plane(*u, delta, length, h, k), delta, length, h, -k)

    def tune(delta):
        orbit, d = fsolve(lambda u: cell(u, delta) - u, [0.0, 0.0], xtol=1e-13), 1e-5
        columns = [(cell(orbit + e, delta) - cell(orbit - e, delta)) / (2 * d)
                   for e in d * np.eye(2)]  # fmt: skip
        return np.arccos(np.trace(columns) / 2) / (2 * np.pi)

    wanted = (tune(1e-3) - tune(-1e-3)) / 2e-3

    bends = [rings.bend("B", length, h * length, (0, s * k), model="exact") for s in (1, -1)]
    assert abs(rings.optics(rings.Ring(bends)).chromaticity[0] - wanted) < 1e-5


@pytest.mark.slow
def test_pole_faces_of_combined_function_magnets():
    """The part that is quadratic in y, behind soft edges of 3 mm: the field in the plane y = 0 and
    Maxwell's equations to order 4 in y, by DOP853."""
    edges, width, b, h, margin = (0.15, -0.1), 3e-3, (0.0, 0.4, 1.5), 1 / RHO, 0.1
    end = RHO * np.array([np.cos(ANGLE), np.sin(ANGLE)])
    outwards, ahead = end / RHO, np.array([-np.sin(ANGLE), np.cos(ANGLE)])

    def plane(point):
        x = jnp.hypot(*point) - RHO
        first = (point[1] - (point[0] - RHO) * jnp.tan(edges[0])) * jnp.cos(edges[0])
        last = (ahead + outwards * jnp.tan(edges[1])) @ (end - point) * jnp.cos(edges[1])
        shape = jax.nn.sigmoid(first / width) * jax.nn.sigmoid(last / width)
        return (h + jnp.polyval(jnp.array(b[::-1]), x)) * shape

    def laplacian(point):
        return jnp.trace(jax.hessian(plane)(point))

    @jax.jit
    @jax.vmap
    def rate(u):
        y, point = u[2], u[:2]
        across = y * jax.grad(plane)(point) - y**3 / 6 * jax.grad(laplacian)(point)
        B = jnp.append(across, plane(point) - y * y / 2 * laplacian(point))
        return jnp.concatenate([u[3:], jnp.cross(B, u[3:])])

    size = 4e-3
    starts = np.array([[RHO, -margin, y, 0.0, 1.0, 0.0] for y in (0.0, size)])
    found = solve_ivp(
        lambda s, u: np.asarray(rate(u.reshape(2, 6))).ravel(), (0, LENGTH + 2 * margin),
        starts.ravel(), "DOP853", rtol=1e-9, atol=1e-11, max_step=0.02,
    )  # fmt: skip
    place, direction = np.split(found.y[:, -1].reshape(2, 6), 2, axis=1)
    place -= (((place[:, :2] - end) @ ahead) / (direction[:, :2] @ ahead))[:, None] * direction
    x, px = (place[:, :2] - end) @ outwards, direction[:, :2] @ outwards
    wanted = np.array([x[1] - x[0], px[1] - px[0]]) / size**2

    def ours(name):
        bend = rings.bend(
            "B", LENGTH, ANGLE, b, model="exact", edge_in=edges[0], edge_out=edges[1],
            fringe_in=width, fringe_out=width,
        )  # fmt: skip
        parts = (p._replace(name=p.name.replace("wedge", name)) for p in bend.parts)
        ring = rings.Ring([dataclasses.replace(bend, parts=tuple(parts))])
        z = [rings.one_turn(ring, jnp.zeros(6).at[2].set(y)) for y in (0.0, size)]
        return np.asarray(z[1] - z[0])[:2] / size**2

    np.testing.assert_allclose(ours("wedge"), wanted, rtol=1e-3)
    assert np.abs(ours("at_wedge") - wanted).min() > 0.03  # without multipoles in the wedges
