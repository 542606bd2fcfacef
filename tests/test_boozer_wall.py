"""First walls: points and angles of hits, heat loads, and files of triangles."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.systems import boozer
from dvi_jax.systems.boozer._sums import Shape

R0, A = 6.0, 2.0


def torus():
    """R = R0 + a√s cos θ, Z = a√s sin θ, φ = −ζ."""
    R, zero = np.zeros((2, 2, 1, 1)), jnp.zeros((2, 2, 1, 1))
    R[0, :, 0, 0] = R0, A
    Z = np.zeros((2, 2, 1, 1))
    Z[1, 1, 0, 0] = A
    return boozer.Geometry(jnp.asarray(R), jnp.asarray(Z), zero, Shape(1, 0), -1)


def distance(x, a=A):
    """From the torus with the minor radius a."""
    x = np.asarray(x)
    return np.hypot(np.hypot(x[..., 0], x[..., 1]) - R0, x[..., 2]) - a


def rays(count, seed=0):
    """Segments from points inside of the torus to points far away."""
    random = np.random.default_rng(seed)
    phi, theta, r = random.uniform(0, [2 * np.pi, 2 * np.pi, 1.5], (count, 3)).T
    R = R0 + r * np.cos(theta)
    start = np.stack([R * np.cos(phi), R * np.sin(phi), r * np.sin(theta)], -1)
    direction = random.normal(size=(count, 3))
    return start, start + 25 * direction / np.linalg.norm(direction, axis=1, keepdims=True)


def test_hits_on_a_torus():
    start, end = rays(40)
    # The first crossing of the torus itself, by bisection between samples.
    t = np.linspace(0, 1, 20001)
    outside = distance(start[:, None] + t[:, None] * (end - start)[:, None]) > 0
    low = t[np.argmax(outside, axis=1) - 1]
    high = low + t[1]
    for _ in range(40):
        middle = (low + high) / 2
        is_out = distance(start + middle[:, None] * (end - start)) > 0
        low, high = np.where(is_out, low, middle), np.where(is_out, middle, high)
    exact = start + low[:, None] * (end - start)
    radial = exact * [1, 1, 0]
    axis = R0 * radial / np.linalg.norm(radial, axis=1, keepdims=True)
    normal, along = (exact - axis) / A, (end - start) / 25
    angle = np.arccos(np.abs(np.sum(normal * along, -1)))
    errors = []
    for n in (24, 48):
        wall = boozer.wall_of_surface(torus(), 1.0, (n, 2 * n))
        hits = wall.hits(np.stack([start, end], 1))
        assert (hits.triangle >= 0).all()  # no ray passes between two triangles
        steep = angle < 1.2
        errors.append(np.linalg.norm(hits.point - exact, axis=1)[steep].max())
        assert np.abs(hits.angle - angle)[steep].max() < 8 / n
        assert -(A * (np.pi / n) ** 2 + R0 * (np.pi / 2 / n) ** 2) < distance(hits.point).min()
    assert errors[1] < 0.1
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.5)
    turned = np.abs(np.sum(normal * np.roll(along, 1, axis=1), -1))  # negative control
    assert np.abs(hits.angle - np.arccos(turned)).max() > 0.5


def test_paths_end_at_their_first_hit():
    square = np.array(
        [[[1.0, -1, -1], [1, 1, -1], [1, 1, 1]], [[1, -1, -1], [1, 1, 1], [1, -1, 1]]]
    )
    wall = boozer.Wall(square)
    back = [[0, 0, 0], [0.5, 0, 0], [1.5, 0, 0], [0.5, 0.2, 0], [2, 0.2, 0]]
    missed = [[0, 0, 0], [0.5, 0, 0], [0.9, 0, 0], [0.9, 4, 0], [2, 4, 0]]
    stopped = [[0, 0, 0], [0.5, 0, 0], [np.nan] * 3, [0.5, 0, 0], [2, 0, 0]]
    on_edge = [[0, 0, 0], [0.5, 0.5, 0.5], [2, 2, 2], [0, 0, 0], [0, 0, 0]]
    hits = wall.hits(np.array([back, missed, stopped, on_edge]))
    np.testing.assert_array_equal(hits.step, [1, -1, -1, 1])
    np.testing.assert_allclose(hits.point[0], [1, 0, 0])
    np.testing.assert_allclose(hits.point[3], [1, 1, 1])
    assert np.isnan(hits.point[1:3]).all()
    assert np.isnan(hits.angle[1:3]).all()
    np.testing.assert_allclose(hits.fraction[0], 0.5)
    np.testing.assert_allclose(hits.angle[[0, 3]], [0, np.arccos(1 / np.sqrt(3))], atol=1e-7)
    load = wall.heat_load(hits, np.array([3.0, 9.0, 9.0, 5.0]))
    assert np.sum(load * wall.areas) == pytest.approx(8.0, rel=1e-14)
    np.testing.assert_allclose(wall.areas, 2.0)
    with pytest.raises(ValueError, match="triangles must be"):
        boozer.Wall(np.zeros((4, 3)))


def test_a_curved_path_is_within_the_stated_error():
    """A circle of radius 1 about (0, 1, 0) that meets the plane x = 0.9, in steps of 0.1."""
    wall = boozer.Wall([[[0.9, -9.0, -9], [0.9, 9, -9], [0.9, 0, 9]]])
    phase = 0.1 * np.arange(20)
    hits = wall.hits(np.stack([np.sin(phase), 1 - np.cos(phase), 0 * phase], -1))
    exact = np.array([0.9, 1 - np.sqrt(1 - 0.81), 0.0])
    off = np.linalg.norm(hits.point - exact)
    assert float(hits.error) == pytest.approx(0.1**2 / 8, rel=1e-2)
    # The distance to the chord; along the wall it is larger by the angle of incidence.
    assert 0.05 * hits.error < off < hits.error / np.cos(hits.angle)


@pytest.mark.slow
def test_lost_particles_reach_a_wall_beyond_the_plasma():
    """The place where guiding centres meet triangles at s = 1.21 is where their s is 1.21."""
    field = boozer.from_modes([0, 1], [0, 0], [[5.7], [-0.5]], psi_edge=8.0, iota=0.0, G=57.0)
    alphas = boozer.GuidingCentres(field)
    q, p, args = alphas.start(0.9, 0.3, 0.0, 0.5)
    run = {"args": args, "h": 1.0, "num_steps": 4000, "method": dvi.GaussLegendre(2)}
    sol = dvi.integrate(alphas.system, q, p, stop=alphas.loss_at(1.3), **run)
    assert sol.status == "stopped"
    at = alphas.coordinates_of(sol.qs, sol.ps)
    path = np.asarray(torus().cartesian(at.s, at.theta, at.zeta))
    hits = boozer.wall_of_surface(torus(), 1.21, (96, 256)).hits(path)
    end = alphas.coordinates_of(
        *dvi.integrate(alphas.system, q, p, stop=alphas.loss_at(1.21), **run).stop[1:]
    )
    there = np.asarray(torus().cartesian(end.s, end.theta, end.zeta))
    assert abs(distance(there, 1.1 * A)) < 1e-9
    assert abs(distance(hits.point, 1.1 * A)) < 3e-3
    assert np.linalg.norm(hits.point - there) < 3e-3 / np.cos(hits.angle)


def test_walls_from_files(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    wall = boozer.wall_of_surface(torus(), 1.0, (8, 12))
    corners = np.asarray(wall.triangles).reshape(-1, 3)
    mesh = trimesh.Trimesh(1e3 * corners, np.arange(len(corners)).reshape(-1, 3))
    mesh.export(tmp_path / "wall.stl")
    again = boozer.read_wall(tmp_path / "wall.stl", scale=1e-3)
    np.testing.assert_allclose(np.sort(again.areas), np.sort(wall.areas), rtol=1e-5)
