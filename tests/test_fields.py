"""Fields of coils and on grids: circular loops, polygons, splines, runs with them, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.systems import fields

RADIUS, CURRENT = 0.7, 3e5
LOOP = fields.from_fourier(
    [[[0, 0, 0], [RADIUS, 0, 0]]], [[[0, 0, 0], [0, RADIUS, 0]]], [CURRENT], num_points=256
)
PLACES = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3))


def of_a_loop(q):
    """(A, B) by elliptic integrals (Jackson, 5.5)."""
    special = pytest.importorskip("scipy.special")
    (x, y, z), r = q, np.hypot(q[0], q[1])
    far, near = (RADIUS + r) ** 2 + z**2, (RADIUS - r) ** 2 + z**2
    k2 = 4 * RADIUS * r / far
    K, E = special.ellipk(k2), special.ellipe(k2)
    A = 4e-7 * CURRENT * np.sqrt(RADIUS / (k2 * r)) * ((1 - k2 / 2) * K - E)
    scale = 2e-7 * CURRENT / np.sqrt(far)
    B_r = scale * z / r * (-K + (RADIUS**2 + r**2 + z**2) / near * E)
    B_z = scale * (K + (RADIUS**2 - r**2 - z**2) / near * E)
    return A / r * np.array([-y, x, 0.0]), np.array([B_r * x / r, B_r * y / r, B_z])


def curl(field, q):
    J = jax.jacfwd(field)(jnp.asarray(q))
    return jnp.stack([J[2, 1] - J[1, 2], J[0, 2] - J[2, 0], J[1, 0] - J[0, 1]])


def errors(coils):
    exact = np.array([of_a_loop(q) for q in PLACES])
    field = jax.vmap(lambda q: jnp.stack([coils.vector_potential(q), coils.magnetic_field(q)]))
    return np.abs(field(PLACES) - exact).max(axis=(0, 2)) / np.abs(exact).max(axis=(0, 2))


def polygon(points):
    angle = np.linspace(0, 2 * np.pi, points + 1)
    corners = RADIUS * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return fields.Polylines(corners[None], [CURRENT])


def test_a_circular_loop_against_elliptic_integrals():
    assert errors(LOOP).max() < 1e-14
    few = errors(fields.from_fourier(*([[[0, 0, 0], x]] for x in ([RADIUS, 0, 0], [0, RADIUS, 0])),
                                     [CURRENT], num_points=24))  # fmt: skip
    assert (few > 1e-9).all()
    coarse, fine = errors(polygon(64)), errors(polygon(128))
    assert np.abs(np.log2(coarse / fine) - 2).max() < 0.02


@pytest.mark.parametrize("coils", [pytest.param(LOOP, marks=pytest.mark.slow), polygon(12)])
def test_the_field_is_the_curl_of_the_potential(coils):
    for q in PLACES[:3]:
        defect = curl(coils.vector_potential, q) - coils.magnetic_field(q)
        assert jnp.abs(defect).max() < 1e-14 * jnp.abs(coils.magnetic_field(q)).max()


@pytest.mark.slow
def test_coils_of_simsopt():
    """Three-dimensional curves of order 3, through the coefficients that simsopt stores."""
    geo, simsopt = (pytest.importorskip(f"simsopt.{name}") for name in ("geo", "field"))
    rng, order, points = np.random.default_rng(1), 3, 160
    curves = [geo.CurveXYZFourier(points, order) for _ in range(3)]
    for curve in curves:
        curve.x = 0.1 * rng.normal(size=3 * (2 * order + 1))
        curve.set("xc(1)", 1.0)
        curve.set("ys(1)", 1.0)
    currents = [1e5, -2e5, 3e5]
    peer = simsopt.BiotSavart(
        [simsopt.Coil(c, simsopt.Current(i)) for c, i in zip(curves, currents, strict=True)]
    )
    series = np.stack([curve.x.reshape(3, -1).T for curve in curves])
    sines = np.concatenate([np.zeros_like(series[:, :1]), series[:, 1::2]], axis=1)
    coils = fields.from_fourier(series[:, ::2], sines, currents, num_points=points)
    places = rng.normal(scale=0.3, size=(50, 3))
    peer.set_points(places)
    for ours, theirs in ((coils.magnetic_field, peer.B()), (coils.vector_potential, peer.A())):
        assert np.abs(jax.vmap(ours)(places) - theirs).max() < 1e-12 * np.abs(theirs).max()


def H(t, q, p, args):
    return jnp.sum((p - args.vector_potential(q)) ** 2) / 2


def lorentz(t0, t1, q, p, args):
    return jnp.cross(p, args.magnetic_field(q))


OF_A = dvi.System(dvi.discretise(H))
OF_B = dvi.System(dvi.discretise(lambda q, p: p @ p / 2), force=lorentz)
Q, V = jnp.asarray([0.1, 0.2, 0.05]), jnp.asarray([0.02, 0.01, 0.03])


@pytest.mark.slow
def test_a_particle_in_coils_and_the_gradient_by_currents():
    """From A, and from B in a force; the gradient against a difference."""
    run = {"h": 0.1, "num_steps": 40, "method": dvi.Boris(), "throw": False}
    coils = fields.Filaments(LOOP.points[:, ::4], 4 * LOOP.tangents[:, ::4], 10 * LOOP.currents)

    def ends(scale):
        args = fields.Filaments(coils.points, coils.tangents, scale * coils.currents)
        return dvi.integrate(OF_B, Q, V, epsilon=1.0, args=args, **run).qs[-1]

    of_A = dvi.integrate(OF_A, Q, V + coils.vector_potential(Q), args=coils, **run).qs[-1]
    assert jnp.abs(of_A - ends(1.0)).max() < 1e-14 < jnp.abs(of_A - ends(0.9)).max()
    _, slope = jax.jvp(ends, (1.0,), (1.0,))
    gradient = jax.grad(lambda scale: ends(scale) @ Q)(1.0)
    difference = (ends(1 + 1e-4) - ends(1 - 1e-4)) / 2e-4
    assert jnp.abs(slope - difference).max() < 1e-6 * jnp.abs(difference).max()
    assert abs(gradient - slope @ Q) < 1e-12 * jnp.abs(slope).max()


def test_coils_of_other_shapes_are_refused():
    with pytest.raises(ValueError, match="sines must be"):
        fields.from_fourier(np.zeros((1, 2, 3)), np.zeros((1, 3, 3)), [1.0])
    with pytest.raises(ValueError, match="currents must be"):
        fields.from_fourier(np.zeros((2, 2, 3)), np.zeros((2, 2, 3)), [1.0])
    with pytest.raises(ValueError, match="currents must be"):
        fields.Polylines(np.zeros((2, 4, 3)), [1.0])
    for shapes, name in (((4, 3), (4, 3), 1), "points"), (((1, 4, 3), (1, 5, 3), 1), "tangents"):
        with pytest.raises(ValueError, match=f"{name} must be"):
            fields.Filaments(*map(np.ones, shapes))


def potential(q):
    x, y, z = q
    return jnp.stack([-y * jnp.cos(z / 4), x * jnp.cos(z / 4) * (1 + 0.1 * x), jnp.sin(x * y / 9)])


def on_a_grid(function, n):
    axes = [np.linspace(-4, 4, n), np.linspace(-4.5, 4.5, n), np.linspace(-5, 5, n)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = np.asarray(jax.vmap(function)(places))
    return fields.Spline(axes, values.reshape(n, n, n, *values.shape[1:]))


@pytest.mark.slow
def test_splines_of_a_potential_and_of_its_field():
    pytest.importorskip("interpax")
    places = np.random.default_rng(0).uniform(-3, 3, (50, 3))

    def field(q):
        return curl(potential, q)

    def largest(function):
        return np.abs(jax.vmap(function)(places)).max()

    rows = []
    for n in (16, 32):
        A, B = on_a_grid(potential, n), on_a_grid(field, n)
        rows.append([
            largest(lambda q, A=A: A(q) - potential(q)),
            largest(lambda q, A=A: curl(A, q) - field(q)),
            largest(lambda q, B=B: B(q) - field(q)),
            largest(lambda q, B=B: jnp.trace(jax.jacfwd(B)(q))),
        ])  # fmt: skip
        assert largest(lambda q, A=A: jnp.trace(jax.jacfwd(lambda q: curl(A, q))(q))) < 1e-14
    orders = np.log2(np.divide(*rows))
    assert (orders > [3.7, 2.7, 3.7, 2.5]).all(), orders


@pytest.mark.slow
def test_a_cylindrical_grid_with_two_periods():
    pytest.importorskip("interpax")

    def A(q):
        x, y, z = q
        wave = 1 + 0.1 * (x * x - y * y) / (x * x + y * y)
        along = jnp.stack([-y, x, 0 * z]) * wave * jnp.cos(z / 4)
        return along + 0.05 * jnp.stack([x * z, y * z, x * x + y * y])

    axes = [
        np.linspace(1, 6, 40),
        np.linspace(0, np.pi, 32, endpoint=False),
        np.linspace(-4, 4, 40),
    ]
    R, phi, Z = np.meshgrid(*axes, indexing="ij")
    places = np.stack([R * np.cos(phi), R * np.sin(phi), Z], axis=-1)
    x, y, z = np.moveaxis(
        np.asarray(jax.vmap(A)(places.reshape(-1, 3))).reshape(places.shape), -1, 0
    )
    cos, sin = np.cos(phi), np.sin(phi)
    values = np.stack([x * cos + y * sin, y * cos - x * sin, z], axis=-1)
    spline = fields.Spline(axes, values, cylindrical=True, period=np.pi)
    angle = np.random.default_rng(0).uniform(-np.pi, np.pi, 50)
    q = np.stack([3 * np.cos(angle), 3 * np.sin(angle), angle], axis=-1)
    assert np.abs(jax.vmap(spline)(q) - jax.vmap(A)(q)).max() < 5e-6


@pytest.mark.slow
def test_a_particle_that_leaves_a_grid_has_a_status():
    """Also if it is inside again at the end: A is used by its derivatives alone."""
    pytest.importorskip("interpax")
    spline = on_a_grid(potential, 12)

    def in_spline(t, q, p, args):
        return jnp.sum((p - args(q)) ** 2) / 2

    system = dvi.System(dvi.discretise(in_spline))

    def run(speed, spline):
        p = jnp.asarray([0.1, 0.0, speed]) + spline(Q)
        run = {"h": 0.1, "num_steps": 100, "save": dvi.Save(final=True), "throw": False}
        return dvi.integrate(system, Q, p, args=spline, method=dvi.Boris(), **run)

    assert run(0.1, spline).status == "successful"
    assert run(1.0, spline).status == "not_finite"
    assert jnp.isnan(jax.jacfwd(spline)(jnp.asarray([9.0, 0.0, 0.0]))).all()
    # The values on the grid are differentiable, in compiled code as well.
    slope = jax.jit(jax.grad(lambda spline: spline(Q).sum()))(spline)
    assert 0 < jnp.abs(slope.arrays.f).max() + jnp.abs(slope.arrays._fstack).max() < jnp.inf


def test_a_grid_without_the_package_says_what_to_install(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "interpax", None)
    with pytest.raises(ImportError, match=r"dvi-jax\[fields\]"):
        fields.Spline([np.arange(4.0)] * 3, np.zeros((4, 4, 4)))
    with pytest.raises(ValueError, match="values must be"):
        fields.Spline([np.arange(4.0)] * 3, np.zeros((4, 4, 4, 2)))
    with pytest.raises(ValueError, match="number of axes must be 3"):
        fields.Spline([np.arange(4.0)] * 2, np.zeros((4, 4)))
    with pytest.raises(ValueError, match="axis y must be"):
        fields.Spline(
            [np.arange(4.0), -((np.arange(4.0) ** 2 - 2) ** 2), np.arange(4.0)], np.zeros((4, 4, 4))
        )
