"""Guiding centres in Boozer coordinates: fields, equations of motion, files, initial conditions."""

import contextlib
import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.io import netcdf_file

import dvi_jax as dvi
from dvi_jax.systems import boozer

slow = pytest.mark.slow
EDGE = 5.7 * 1.7**2 / 2


def axisymmetric(current=True):
    """A tokamak-like field; with `current` its I and the profile of G are not constant."""
    return boozer.from_modes(
        [0, 1, 2], [0, 0, 0], [[5.7, 0.05], [-0.9, 0.1], [0.05, 0.0]],
        psi_edge=EDGE, iota=[0.42, 0.05],
        G=[57.0, -0.5] if current else 57.0, I=[0, 0.4, -0.1] if current else None,
    )  # fmt: skip


def helical():
    """Two periods, with modes that trap particles in helical wells."""
    return boozer.from_modes(
        [0, 1, 1, 0], [0, 0, 2, 4], [[5.7, 0.05], [-0.3, 0.0], [-0.9, 0.0], [0.02, 0.01]],
        psi_edge=EDGE, iota=[0.42, 0.05], G=57.0, I=[0, 0.2], periods=2, helicity=1,
    )  # fmt: skip


FIELDS = {f.__name__: f for f in (axisymmetric, helical, boozer.precise_qa, boozer.w7x)}


@functools.cache
def rates_of_literature(name):
    """dψ/dt, dθ/dt, dζ/dt and dρ∥/dt of White & Chance 1984, eqs. (15)–(18), with K = 0.

    ρ∥ = v∥/Ω in place of momenta. Written from the field alone, without our Lagrangian.
    """
    field = FIELDS[name]()
    slopes = jax.value_and_grad(lambda x: field.strength(x[0], x[1], x[2]))

    def profile(c, s):
        value = functools.partial(jnp.polyval, jnp.asarray(c)[::-1])
        return value(s), jax.grad(value)(s) / field.psi_edge

    @jax.jit
    def rates(z, mu, rho):
        psi, theta, zeta, parallel = z
        s = psi / field.psi_edge
        B, (Bs, Bt, Bz) = slopes(jnp.stack([s, theta, zeta]))
        Bpsi = Bs / field.psi_edge
        G, Gp = profile(field.G, s)
        I, Ip = (0.0, 0.0) if field.I is None else profile(field.I, s)  # noqa: E741
        iota, _ = profile(field.iota, s)
        # In units with m = v0 = 1 and the charge 1/ρ.
        D = G + iota * I + parallel * (G * Ip - I * Gp)
        by_B = mu * rho + parallel**2 * B / rho
        u = parallel * B / rho
        return jnp.stack([
            (I * Bz - G * Bt) * by_B / D,
            (u * B * (iota - parallel * Gp) + G * by_B * Bpsi) / D,
            (u * B * (1 + parallel * Ip) - I * by_B * Bpsi) / D,
            -((1 + parallel * Ip) * Bz + (iota - parallel * Gp) * Bt) * by_B / D,
        ])  # fmt: skip

    return rates


def orbit_of_literature(name, particles, s, theta, zeta, pitch, mu, t):
    """(s, θ, ζ, v∥/v0) at t by SciPy's DOP853."""
    field, rho = particles.field, particles.rho
    rates = rates_of_literature(name)
    start = [s * field.psi_edge, theta, zeta, rho * pitch / field.strength(s, theta, zeta)]
    found = solve_ivp(
        lambda _, z: np.asarray(rates(z, mu, rho)), (0, t), np.asarray(start, float),
        method="DOP853", rtol=1e-12, atol=1e-13,
    )  # fmt: skip
    psi, theta, zeta, parallel = found.y[:, -1]
    s = psi / field.psi_edge
    return np.array([s, theta, zeta, parallel * field.strength(s, theta, zeta) / rho])


BLOCK = 500
"""Steps of one compiled run."""


def integrate(particles, q, p, args, h, num_steps, **options):
    options = {"method": dvi.GaussLegendre(2), "save": dvi.Save(final=True), **options}
    return dvi.integrate(particles.system, q, p, args=args, h=h, num_steps=num_steps, **options)


@functools.cache
def _run(name, coordinates, stages, charge=2.0):
    particles = boozer.GuidingCentres(FIELDS[name](), charge=charge, coordinates=coordinates)
    args = particles.args(0.0)
    system = particles.system

    def energy(t0, t1, q0, p0, q1, p1, args):
        return 2 * system.hamiltonian(t1, t1, q1, p1, 0.0, args)

    observed = {"drift": dvi.MaxDrift(energy), "last": dvi.Last(energy)}

    def run(q, p, mu, h):
        options = {"observe": observed, "method": dvi.GaussLegendre(stages), "throw": False}
        sol = integrate(particles, q, p, {**args, "mu": mu}, h, BLOCK, **options)
        return sol.qs[-1], sol.ps[-1], sol.observed

    return particles, jax.jit(jax.vmap(run, in_axes=(0, 0, 0, None)))


class Final(NamedTuple):
    """Coordinates (s, θ, ζ, v∥/v0) and momenta at the end, drift of 2H, momenta and μ at first."""

    z: np.ndarray
    p: np.ndarray
    drift: np.ndarray
    p0: np.ndarray
    mu: np.ndarray


def final(name, start, h, blocks=1, stages=3, coordinates="regular", charge=2.0):
    """A batch of orbits after ``blocks · BLOCK`` steps."""
    particles, run = _run(name, coordinates, stages, charge)
    q, p, args = particles.start(*(np.asarray(x, float) for x in start))
    p0, drifts, before = np.asarray(p), [], np.ones(len(p))
    for _ in range(blocks):
        q, p, of_block = run(q, p, args["mu"], h)
        drifts.append(np.asarray(of_block["drift"]) + np.abs(before - 1))
        before = np.asarray(of_block["last"])
    at = particles.coordinates_of(q, p)
    z = np.stack([at.s, at.theta, at.zeta, at.v_parallel / particles.speed], axis=-1)
    return Final(z, np.asarray(p), np.max(drifts, axis=0), p0, np.asarray(args["mu"]))


def difference(z, reference):
    """The largest difference of orbits, angles modulo 2π."""
    d = np.asarray(z) - reference
    d[..., 1] = (d[..., 1] + np.pi) % (2 * np.pi) - np.pi
    return np.abs(d).max()


# Passing, banana, and trapped in a helical well (where there is one): s, θ, ζ, pitch.
ORBITS = {
    "axisymmetric": ([0.3, 0.3, 0.5], [0.3, 0.2, 2.0], [0.1, 0.4, 0.2], [0.8, 0.3, -0.6]),
    "helical": ([0.3, 0.209, 0.171], [0.3, 1.876, 3.014], [0.1, 0.782, 4.871],
                [-0.9, 0.023, 0.174]),
    "precise_qa": ([0.3, 0.25], [0.3, 0.2], [0.1, 0.4], [0.8, -0.25]),
    "w7x": ([0.3, 0.25], [0.3, 0.0], [0.1, 0.1], [0.9, 0.1]),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "h", "blocks"),
    [
        ("axisymmetric", 0.8, 5),
        pytest.param("helical", 0.5, 6, marks=slow),
        pytest.param("precise_qa", 1.0, 6, marks=slow),
        pytest.param("w7x", 0.125, 7, marks=slow),
    ],
)
def test_orbits_agree_with_the_equations_of_the_literature(name, h, blocks):
    start = [np.array(x) for x in ORBITS[name]]
    found = final(name, start, h, blocks)
    particles, _ = _run(name, "regular", 3)
    t = h * blocks * BLOCK
    for i, z in enumerate(found.z):
        at = [x[i] for x in start]
        reference = orbit_of_literature(name, particles, *at, found.mu[i], t)
        assert difference(z, reference) < 1e-8
        if i == 0:  # negative control: with a smaller moment it is another orbit
            moved = orbit_of_literature(name, particles, *at, found.mu[i] * (1 - 1e-6), t)
            assert difference(z, moved) > 1e-7
    assert found.drift.max() < 1e-9


@slow
@pytest.mark.parametrize("charge", [-1.0, -2.0])
def test_orbits_of_a_negative_charge_agree_with_the_literature(charge):
    start = [np.array(x) for x in ORBITS["axisymmetric"]]
    orbits = final("axisymmetric", start, 0.8, 2, charge=charge)
    particles, _ = _run("axisymmetric", "regular", 3, charge)
    for i, z in enumerate(orbits.z):
        at = [x[i] for x in start]
        args = particles, *at, orbits.mu[i], 1.6 * BLOCK
        assert difference(z, orbit_of_literature("axisymmetric", *args)) < 1e-8
    assert orbits.drift.max() < 1e-9
    near = np.array([0.0, 1e-14]), np.zeros(2), np.zeros(2), np.array([0.7, 0.7])
    across = final("axisymmetric", near, 0.8, charge=charge)
    assert difference(across.z[0], across.z[1]) < 1e-5
    assert 0 < across.z[0, 0] < 0.05


@pytest.mark.parametrize("charge", [-2.0, -1.0, 1.0])
@pytest.mark.parametrize("with_current", [True, False])
def test_the_regular_chart_for_charges_of_both_signs(charge, with_current):
    """It has the coordinates and the energy of the start, and Y, X are canonical as θ, p_θ are."""
    point = 0.3, 2.1, -0.4, 0.6
    regular, angles = (
        boozer.GuidingCentres(axisymmetric(with_current), charge=charge, coordinates=name)
        for name in ("regular", "angles")
    )
    q, p, args = regular.start(*point)
    at = regular.coordinates_of(q, p)
    assert [float(x) for x in at[:3]] == pytest.approx(point[:3], rel=1e-13)
    assert float(at.v_parallel / regular.speed) == pytest.approx(point[3], rel=1e-13)
    assert float(regular.system.hamiltonian(0.0, 0.0, q, p, 0.0, args)) == pytest.approx(0.5)
    (theta, _), (p_theta, p_zeta), _ = angles.start(*point)
    assert np.sign(p_theta) == np.sign(charge)

    def chart(z):
        q, p = regular.chart.state(z[0], -0.4, z[1], p_zeta)
        return jnp.stack([q[0], p[0]])

    slopes = jax.jacfwd(chart)(jnp.stack([theta, p_theta]))
    assert float(jnp.linalg.det(slopes)) == pytest.approx(1, rel=1e-13)


@slow
def test_both_charts_and_the_nested_solve_give_one_orbit():
    start = [np.array(x) for x in ORBITS["axisymmetric"]]
    a = final("axisymmetric", start, 0.5).z
    b = final("axisymmetric", start, 0.5, coordinates="angles").z
    assert difference(a, b) < 1e-9
    # RungeKutta4 evaluates H with its inner solve; GaussLegendre takes s among its unknowns.
    particles, _ = _run("axisymmetric", "regular", 3)
    q, p, args = particles.start(*(x[1] for x in start))
    sol = integrate(particles, q, p, args, 0.25, 1000, method=dvi.RungeKutta4())
    at = particles.coordinates_of(sol.qs[-1], sol.ps[-1])
    c = np.array([at.s, at.theta, at.zeta, at.v_parallel / particles.speed])
    assert difference(c, a[1]) < 1e-8


@slow
def test_energy_error_scales_with_the_order_and_does_not_grow():
    start = [np.array(x)[1:2] for x in ORBITS["axisymmetric"]]
    coarse, fine = (
        final("axisymmetric", start, h, blocks, stages=2).drift[0] for h, blocks in ((8, 1), (4, 2))
    )
    assert np.log2(coarse / fine) == pytest.approx(4, abs=0.4)
    short, long = (final("axisymmetric", start, 8.0, n, stages=2).drift[0] for n in (5, 50))
    assert long < 1.3 * short  # ten times as long: the energy oscillates


@pytest.mark.slow
def test_the_toroidal_momentum_is_conserved_in_an_axisymmetric_field():
    found = final("axisymmetric", [np.array(x) for x in ORBITS["axisymmetric"]], 0.8)
    change = np.abs(found.p / found.p0 - 1).max(axis=0)
    assert change[1] < 1e-12
    assert change[0] > 1e-3  # of the poloidal one: |B| depends on θ


@slow
def test_a_step_is_symplectic():
    particles, _ = _run("helical", "regular", 3)
    q, p, args = particles.start(0.3, 0.2, 0.1, 0.4)

    def step(z):
        sol = integrate(particles, z[:2], z[2:], args, 2.0, 1)
        return jnp.concatenate([sol.qs[-1], sol.ps[-1]])

    A = np.asarray(jax.jit(jax.jacfwd(step))(jnp.concatenate([q, p])))
    J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    # Relative to the entries of A, which has units.
    assert np.abs(A.T @ J @ A - J).max() < 1e-13 * np.abs(A).max() ** 2
    assert np.abs(A.T @ J @ A * 1.001 - J).max() > 1e-4


def test_orbits_cross_the_magnetic_axis():
    """A start on the axis, one next to it, and one without parallel velocity."""
    start = np.array([0.0, 1e-14, 0.3]), np.zeros(3), np.zeros(3), np.array([0.7, 0.7, 0.0])
    found = final("axisymmetric", start, 0.8)
    assert np.isfinite(found.z).all()
    assert found.drift.max() < 1e-10  # as that of other orbits
    assert found.z[0, 0] < 0.05
    assert difference(found.z[:1], found.z[1]) < 1e-5
    assert abs(found.z[2, 3]) > 1e-3  # it is accelerated along the field


@slow
def test_orbits_that_are_lost():
    particles = boozer.GuidingCentres(axisymmetric(current=False))
    q, p, args = particles.start(1.0, 0.1, 0.0, 0.5)
    sol = integrate(particles, q, p, args, 2.0, 10, stop=particles.loss)
    assert (sol.status, float(sol.stop.t)) == ("stopped", 0.0)
    field = boozer.from_modes([0, 1], [0, 0], [[5.7], [-0.5]], psi_edge=EDGE, iota=0.0, G=57.0)
    particles = boozer.GuidingCentres(field)
    q, p, args = particles.start(0.2, 0.3, 0.0, 0.5)
    sol = integrate(particles, q, p, args, 4.0, 400, stop=particles.loss)
    # Without ι the vertical drift is not averaged: it leaves, at constant p_ζ.
    assert sol.status == "stopped"
    at = particles.coordinates_of(sol.stop.q, sol.stop.p)
    assert float(at.s) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize(("parts", "helicity"), [(1, 0), (2, -1)])
@slow
def test_sums_and_their_derivatives(parts, helicity):
    """Against the definition with powers, cosines and sines, to the third derivative."""
    c = np.random.default_rng(1).normal(size=(parts, 3, 3, 3))

    def defined(c, x, y, zeta):
        s, theta, total = x * x + y * y, jnp.arctan2(y, x), 0.0
        for m in range(3):
            for k in (-1, 0, 1):
                angle = m * theta - 4 * (k + helicity * m) * zeta
                waves = jnp.cos(angle), jnp.sin(angle)
                for part, wave in zip(c[:, m, k + 1], waves, strict=False):
                    total += s ** (m / 2) * (part[0] + s * (part[1] + s * part[2])) * wave
        return total

    def all_of(f):
        slopes = jax.grad(f, argnums=(0, 1, 2, 3))
        second = jax.jacfwd(lambda *a: slopes(*a)[1:], argnums=(1, 2, 3))
        third = jax.jvp(lambda x: second(c, x, 0.3, 0.7), (0.4,), (1.0,))[1]
        at = (jnp.asarray(c), 0.4, 0.3, 0.7)
        return jax.tree.leaves((f(*at), slopes(*at), second(*at), third))

    field = modes([0], [0], [[1.0]], periods=4, helicity=helicity)

    def strength(c, *point):
        return dataclasses.replace(field, coefficients=c).at(*map(jnp.asarray, point))

    ours = all_of(strength)
    for a, b in zip(ours, all_of(defined), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12 * np.abs(b).max())


# |B| [T] of the equilibria in real space, computed by DESC 0.17.3 at points (s, θ, ζ).
DESC = {
    "precise_qa": (3e-4, [
        (0.702, 2.49045163, 0.0788524218, 6.13753427),
        (0.304, 0.335845496, 2.33264812, 5.42868165),
        (0.05, 4.42149705, 1.5911114, 5.7818621),
        (0.304, 3.71553328, 0.527013261, 6.02145407),
        (0.95, 4.90191066, 2.93871249, 5.58311071),
    ]),
    "w7x": (3e-2, [
        (0.702, -6.24692483, -0.011179643, 5.49970743),
        (0.95, -5.79044646, -0.711939686, 5.57677502),
        (0.05, -3.9138894, -0.67249337, 5.35825211),
        (0.702, -1.08437384, -1.14233985, 5.63751466),
        (0.304, -0.256524107, -0.0850196739, 5.60595212),
    ]),
}  # fmt: skip


@pytest.mark.parametrize("name", DESC)
def test_shipped_fields_against_the_equilibria(name):
    """The angles of DESC are right-handed with ψ > 0 for precise_QA. For W7-X its toroidal flux is
    negative, and the angles were converted."""
    tolerance, rows = DESC[name]
    s, theta, zeta, B = np.array(rows).T
    found = np.asarray(FIELDS[name]().strength(s, theta, zeta))
    assert np.abs(found - B).max() < tolerance
    # Negative control: the angles of the other handedness.
    assert np.abs(np.asarray(FIELDS[name]().strength(s, theta, -zeta)) - B).max() > 2 * tolerance


def written(path, sign=1, drop=(), B00=5.7, surfaces=11):
    """A file as booz_xform writes it; `sign`: of the toroidal flux."""
    modes = [(0, 0), (0, 4), (1, -4), (1, 0), (2, 4)]
    s = (np.arange(2, surfaces + 1) - 1.5) / (surfaces - 1)
    B = np.array([B00 + 0 * s, 0.02 * s, 0.03 * s**0.5, -0.5 * s**0.5, 0.1 * s]).T
    profile = np.concatenate([[0.0], 0.4 + 0.1 * s])
    arrays = {
        "nfp_b": 4, "ns_b": surfaces, "jlist": np.arange(2, surfaces + 1),
        "ixm_b": [m for m, _ in modes], "ixn_b": [n for _, n in modes], "iota_b": -profile,
        "bvco_b": 57.0 + 0 * profile, "buco_b": np.concatenate([[0.0], -0.3 * s]),
        "phi_b": sign * np.linspace(0, 2 * np.pi * EDGE, surfaces), "bmnc_b": B,
        "rmnc_b": 0 * B + np.array([10.0, 0, 0, 0, 0]), "zmns_b": 0 * B, "pmns_b": 0 * B,
    }  # fmt: skip
    with netcdf_file(path, "w") as file:
        for name, x in arrays.items():
            if name in drop:
                continue
            x = np.asarray(x, "i4" if np.asarray(x).dtype.kind == "i" else "f8")
            dims = [f"{name}_{i}" for i in range(x.ndim)]
            for dim, size in zip(dims, x.shape, strict=True):
                file.createDimension(dim, size)
            file.createVariable(name, x.dtype, dims)[...] = x
    return path


@pytest.mark.parametrize("sign", [1, -1])
def test_reading_a_file_of_booz_xform(tmp_path, sign):
    field = boozer.read_booz_xform(written(tmp_path / "boozmn.nc", sign), degree=3)
    assert float(field.psi_edge) == pytest.approx(EDGE)
    np.testing.assert_allclose(field.iota[:2], [0.4, 0.1], atol=1e-9)
    np.testing.assert_allclose(field.I[:2], [0, 0.3 * sign], atol=1e-9)
    assert float(field.G[0]) == pytest.approx(57 * sign)
    s, theta, zeta = 0.4, 0.7, 0.3
    # cos(mθ − nζ) of the file, of −θ or of −ζ: of the same |B|.
    t, z = (-theta, zeta) if sign > 0 else (theta, -zeta)
    expected = (
        5.7 + 0.02 * s * np.cos(4 * z) + 0.03 * s**0.5 * np.cos(t + 4 * z)
        - 0.5 * s**0.5 * np.cos(t) + 0.1 * s * np.cos(2 * t - 4 * z)
    )  # fmt: skip
    assert float(field.strength(s, theta, zeta)) == pytest.approx(expected, abs=1e-9)
    geometry = boozer.read_geometry(tmp_path / "boozmn.nc", degree=3)
    R, phi, Z = geometry.cylindrical(s, theta, zeta)
    assert (float(R), float(Z)) == (pytest.approx(10), 0)
    assert float(phi) == pytest.approx(sign * zeta)
    boozer.save_field(field, tmp_path / "field.json", "a test")
    again = boozer.load_field(tmp_path / "field.json")
    assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), field, again))


SPACINGS = {
    "even": lambda count: np.linspace(0.02, 0.96, count),
    "half mesh": lambda count: (np.arange(count) + 0.2) / (count - 0.6),
    "dense at the axis": lambda count: 0.01 + 0.98 * np.linspace(0, 1, count) ** 2,
}


def spectrum(parts):
    """Modes up to m = 14 that are no polynomials, with the irregularities of an equilibrium."""
    m, k = (x.ravel() for x in np.meshgrid(np.arange(15), np.arange(-3, 4), indexing="ij"))
    m, k = (x[(m > 0) | (k >= 0)] for x in (m, k))
    random = np.random.default_rng(parts)
    size, rate, phase = random.uniform([[-1], [0], [0]], [[1], [4], [6]], (3, parts * len(m)))
    size, rate, phase = (x.reshape(parts, 1, -1) for x in (size, rate, phase))

    def values(s):
        s = np.asarray(s)[:, None]
        B = size * np.exp(-0.7 * m - np.abs(k)) * s ** (m / 2) * np.exp(-rate * s)
        B = B + 1e-5 * size * s ** np.minimum(m / 2, 2) * np.sin(40 * s + phase)
        B[..., (m == 0) & (k == 0)] = 5.0
        B[1:, ..., m == 0] = 0.0
        return B if parts == 2 else B[0]

    return m, 3 * k, values


@pytest.mark.parametrize("parts", [1, 2])
@pytest.mark.parametrize("spacing", SPACINGS)
def test_fields_between_the_surfaces_of_a_file(parts, spacing):
    """Against the functions of s themselves, also at the axis and the edge: with few surfaces a
    polynomial of degree 6 passes through all values and oscillates in between."""
    m, n, values = spectrum(parts)
    s = np.linspace(0, 1, 21)
    theta, zeta = np.random.default_rng(0).uniform(0, 6, (2, 20, 1))
    waves = np.stack([np.cos(m * theta - n * zeta), np.sin(m * theta - n * zeta)])[:parts]
    true = np.einsum("pam,psm->as", waves, np.atleast_3d(values(s)).reshape(parts, 21, -1))
    error = {}
    for count in (3, 6, 7, 9, 12, 25):
        given = SPACINGS[spacing](count)
        profiles = {"iota": 0.4 + 0.3 * np.exp(-given), "G": 50 + np.cos(given), "psi_edge": 8.0}
        # Three are refused, and this message would fail for any other reason.
        refusal = pytest.raises(ValueError, match="with 3 surfaces")
        with refusal if count == 3 else contextlib.nullcontext():
            made = boozer.from_surfaces(given, m, n, values(given), periods=3, **profiles)
        if count > 3:
            error[count] = np.abs(np.asarray(made.strength(s, theta, zeta)) / true - 1).max()
            iota = np.polynomial.polynomial.polyval(s, made.iota)
            np.testing.assert_allclose(iota, 0.4 + 0.3 * np.exp(-s), atol=7e-3)
    assert max(error.values()) < 1e-2
    assert error[25] < 1e-3


@pytest.mark.parametrize(
    ("given", "centre", "message"),
    [
        ([0.01, 0.4, 0.6, 0.75, 0.9, 1.0], 0.45, "with 6 surfaces"),
        ([0.01, 0.4, 0.6, 0.8, 1.0], 0.45, "with 5 surfaces"),
        ([0.01, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0], 0.3, "with 8 surfaces"),
        ([0.01, 0.82, 0.88, 0.94, 1.0], 0.4, r"gap of more than 0\.4"),
        ([0.5, 0.6, 0.7, 0.8, 0.9, 1.0], 0.4, r"gap of more than 0\.4"),
    ],
)
def test_wide_gaps_between_surfaces_are_refused(given, centre, message):
    """Each surface is predicted by the others, with the one before a gap as an end."""
    given = np.array(given)
    modes = 5 + 0.6 * np.exp(-(((given - centre) / 0.3) ** 2)) + 0.3 * given**2
    profiles = {"iota": 0.4 + 0 * given, "G": 50 + 0 * given, "psi_edge": 8.0}
    with pytest.raises(ValueError, match=message):
        boozer.from_surfaces(given, [0], [0], modes[:, None], **profiles)


@pytest.mark.parametrize(
    ("gap", "width", "size"),
    [((0.14, 0.34), 0.11, 0.039), ((0.578, 0.778), 0.128, 0.029), ((0.107, 0.307), 0.112, 0.041),
     ((0.155, 0.355), 0.132, 0.035)],
)  # fmt: skip
def test_degrees_that_differ_in_a_gap_are_an_error(gap, width, size):
    """A bump in a gap: two degrees that predict the surfaces nearly as well differ there."""
    even = np.linspace(0.03, 1.0, 13)
    given = np.array([*even[even < gap[0] - 0.02], *gap, *even[even > gap[1] + 0.02]])
    profiles = {"iota": 0.4 + 0.1 * given, "G": 5 + 0 * given, "psi_edge": 1.0}

    def field(size):
        bump = 5 * size * np.exp(-(((given - np.mean(gap)) / width) ** 2))
        modes = np.stack([5 + 0 * given, -0.3 * np.sqrt(given) * (1 + 0.2 * given), bump], -1)
        return boozer.from_surfaces(given, [0, 1, 0], [0, 0, 1], modes, **profiles)

    with pytest.raises(ValueError, match=r"with 1[12] surfaces"):
        field(size)
    field(size / 10)


NEAR_AXIS = ["precise QA", *(pytest.param(x, marks=slow) for x in ("precise QH", "r2 section 5.5"))]


@pytest.mark.parametrize("name", NEAR_AXIS)
def test_near_axis_expansions(name):
    """Against |B| as the package qsc computes it."""
    qsc = pytest.importorskip("qsc", reason='pip install "dvi-jax[stellarator]"')
    stellarator = qsc.Qsc.from_paper(name)
    field = boozer.from_near_axis(stellarator, minor_radius=0.1)
    s, theta, zeta = np.random.default_rng(0).uniform([0, 0, 0], [1, 6, 3], (20, 3)).T
    points = zip(0.1 * np.sqrt(s), theta, zeta, strict=True)
    expected = [stellarator.B_mag(*point, Boozer_toroidal=True) for point in points]
    np.testing.assert_allclose(field.strength(s, theta, zeta), expected, rtol=1e-6)
    assert float(field.G[0]) == pytest.approx(stellarator.G0)
    particles = boozer.GuidingCentres(field.scaled())
    assert float(particles.field.average) == pytest.approx(5.7)
    q, p, args = particles.start(0.2, 0.3, 0.1, 0.3)
    assert float(particles.system.hamiltonian(0.0, 0.0, q, p, 0.0, args)) == pytest.approx(0.5)


def test_bad_files(tmp_path):
    (tmp_path / "b.nc").write_text("not netCDF, and long enough to look at")
    (tmp_path / "d.json").write_text("{}")
    files = [
        (written(tmp_path / "a.nc", drop=["bmnc_b"]), r"it has no bmnc_b\.$"),
        (tmp_path / "b.nc", "not a file of netCDF version 3"),
        (written(tmp_path / "c.nc", sign=0), r"psi_edge=.*read_wout\(path, True\)"),
        (tmp_path / "d.json", "not a field that save_field has written"),
    ]
    for path, message in files:
        with pytest.raises(ValueError, match=message):
            boozer.load_field(path) if path.suffix == ".json" else boozer.read_booz_xform(path)


def modes(m, n, B, **options):
    return boozer.from_modes(m, n, B, **{"psi_edge": 1.0, "iota": 0.4, "G": 10.0, **options})


def surfaces(s=np.linspace(0.01, 0.99, 20), **options):
    ones = np.ones(len(s))
    options = {"psi_edge": 1.0, "iota": ones, "G": ones, **options}
    return boozer.from_surfaces(s, [0], [0], ones[:, None], **options)


ERRORS = [
    (lambda _: modes([1], [0], [[1.0]]), ValueError, "mode m = n = 0"),
    (lambda _: modes([0, 1], [0, 0], [[1.0], [1.5]]), ValueError, r"\|B\| must be positive"),
    (lambda _: modes([0], [0], [[1.0]], G=[1.0, -2.0]), ValueError, "G must not be zero"),
    (lambda _: modes([0], [0], [[1.0]], I=[0.1]), ValueError, "zero on the axis"),
    (lambda _: modes([0, 1], [0, 1], [[1.0], [0.1]], periods=2), ValueError, "of periods=2"),
    (lambda _: modes([0], [0], [[np.nan]]), ValueError, "B must be finite, got nan"),
    (lambda _: modes([0, 1.5], [0, 0], [[1.0], [0.1]]), ValueError, "m must be integers.* 1.5"),
    (lambda _: modes([0], [0, 1], [[1.0]]), ValueError, "one entry for each mode"),
    (lambda _: surfaces(np.array([0.1, 0.95])), ValueError, "at least 3 surfaces, got 2"),
    (lambda _: surfaces(np.array([0.1, 0.5, 0.95]), iota=[0.4, 0.9, 0.1]), ValueError,
     "iota must be determined .* with 3 surfaces.*more surfaces"),
    (lambda _: surfaces(G=np.arange(20) % 2 + 1.0), ValueError, "G must be determined"),
    (lambda _: surfaces(I=0.2 * np.arange(20) % 2), ValueError, "I must be determined"),
    (lambda _: surfaces(np.linspace(0.05, 0.8, 20)), ValueError, "to the edge"),
    (lambda _: surfaces(iota=np.ones(3)), ValueError, r"iota must be .* got shape \(3,\)"),
    (lambda _: surfaces(box=3), TypeError, "box must be a pair"),
    (lambda _: surfaces(period=2), TypeError, "no argument 'period'. Did you mean 'periods'"),
    (lambda x: x.start([0.5, 1.2], 0.0, 0.0, 0.1), ValueError, "s must be between 0 and 1.* 1.2"),
    (lambda x: x.start(0.5, 0.0, 0.0, np.nan), ValueError, "pitch must be between -1 and 1.*nan"),
    (lambda x: boozer.GuidingCentres(x.field, charge=np.nan), ValueError, "charge must be a fin"),
    (lambda x: boozer.GuidingCentres(x.field, charge=0.0), ValueError, r"charge\| must be between"),
    (lambda x: boozer.GuidingCentres(x.field, breaking=np.zeros((1, 1, 1, 1))), ValueError,
     "breaking must be .*shape"),
    (lambda x: boozer.Births(10, x, rate=lambda s: s - 0.5), ValueError, "rate"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "kind", "message"), ERRORS)
def test_bad_fields_and_particles(make, kind, message):
    with pytest.raises(kind, match=message):
        make(boozer.GuidingCentres(axisymmetric()))


# Tables of the modes (1, 0), (1, 12) and (3, −12), and ι: the ripple is in all of the field, only
# between the axis and the edge, and where ι is large at the edge only.
RIPPLES = {
    "everywhere": ([[-0.6, 0.0], [0.1, 0.0], [0.0, 0.0]], [0.42, 0.05]),
    "not at the edge": ([[-0.6, 0.0], [0.4, -0.4], [0.0, 0.0]], [0.42, 0.05]),
    "with shear": ([[-0.6, 0.0], [0.0, 0.0], [0.1, 0.05]], [0.05, 2.5]),
}


def rippled(name):
    table, iota = RIPPLES[name]
    return boozer.from_modes(
        [0, 1, 1, 3], [0, 0, 12, -12], [[5.7, 0.05], *table], psi_edge=EDGE, iota=iota, G=57.0,
        periods=4,
    )  # fmt: skip


@functools.cache
def _energy_error():
    """Largest change of the energy at ε, in a field and modes that break its symmetry."""

    @jax.jit
    def error(field, breaking, h, epsilon):
        alphas = boozer.GuidingCentres(field, breaking=breaking)
        q, p, args = alphas.state(*map(jnp.asarray, (0.75, 0.7, 0.1, 0.7)))

        def energy(q, p):
            at = alphas.coordinates_of(q, p, epsilon)
            return (at.v_parallel / alphas.speed) ** 2 / 2 + args["mu"] * at.B

        options = {"epsilon": epsilon, "observe": dvi.MaxDrift(energy), "throw": False}
        return integrate(alphas, q, p, args, h, 200, **options).observed

    return error


def split(name):
    symmetric, breaking = rippled(name).split()
    return boozer.GuidingCentres(symmetric, breaking=breaking)


@pytest.mark.parametrize(("name", "m", "n"), [*zip(RIPPLES, (1, 1, 3), (12, 12, -12), strict=True)])
def test_the_step_is_that_of_all_modes_and_surfaces(name, m, n):
    """Also of the modes of `breaking`, of those inside of the edge, and of ι there."""
    alphas, table = split(name), RIPPLES[name][0][1 if m == 1 else 2]
    assert alphas.h == boozer.GuidingCentres(rippled(name)).h == alphas.at_epsilon(1.0).h
    assert alphas.at_epsilon(0.0).h > 2.5 * alphas.h
    s = np.linspace(0, 1, 2001)
    B, iota = 5.7 + 0.05 * s, RIPPLES[name][1][0] + RIPPLES[name][1][1] * s
    size = s ** (m / 2) * (table[0] + table[1] * s)
    waves = np.abs(m * iota - n) * (size / B) ** 0.2 * B / 57
    assert alphas.h == pytest.approx(0.4 / waves.max(), rel=1e-3)


@slow
@pytest.mark.parametrize("name", RIPPLES)
def test_the_step_keeps_the_energy_with_modes_that_break_the_symmetry(name):
    alphas, error = split(name), _energy_error()
    right, wrong = (
        error(alphas.field, alphas.breaking, h, 1.0) for h in (alphas.h, alphas.at_epsilon(0.0).h)
    )
    assert right < 1e-4
    assert wrong > 20 * right  # with the step of the field without these modes


@pytest.mark.parametrize("coordinates", ["regular", "angles"])
def test_coordinates_with_modes_that_break_the_symmetry(coordinates):
    """v∥ and |B| at an ε are those of the complete field, and H is the energy of the system."""
    alphas = dataclasses.replace(split("everywhere"), coordinates=coordinates)
    q, p, args = alphas.start(0.5, 0.7, 0.1, 0.4)
    for epsilon in (0.0, 0.5, 2.0):
        at = alphas.coordinates_of(q, p, epsilon)
        complete = alphas.at_epsilon(epsilon)
        for a, b in zip(at, complete.coordinates_of(q, p), strict=True):
            assert float(a) == pytest.approx(float(b), rel=1e-13)
        assert float(at.B) == pytest.approx(float(complete.field.strength(*at[:3])), rel=1e-13)
        energy = (at.v_parallel / alphas.speed) ** 2 / 2 + args["mu"] * at.B
        system = alphas.system
        H = system.hamiltonian(0.0, 0.0, q, p, 0.0, args)
        H = H + epsilon * system.perturbation(0.0, 0.0, q, p, args, epsilon)
        assert float(energy) == pytest.approx(float(H), rel=1e-13)
    for function in (alphas.coordinates_of, lambda q, p: alphas.second_invariant(q, p, args)):
        with pytest.raises(ValueError, match=r"epsilon must be that of the run, .* got None"):
            function(q, p)


@slow
def test_births_have_the_distribution_of_the_reactions():
    particles = boozer.GuidingCentres(helical())
    births = boozer.Births(4000, particles, seed=3)
    q, p, args = jax.jit(jax.vmap(lambda i: births.at(i, 0.0, None)))(jnp.arange(4000))
    at = particles.coordinates_of(q, p)
    s, pitch = np.asarray(at.s), np.asarray(at.v_parallel) / particles.speed
    nodes = np.linspace(0, 1, 400)
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    B = np.asarray(particles.field.strength(nodes[:, None, None], angles[:, None], angles / 2))
    I = 0.2 * nodes * (0.42 + 0.05 * nodes)  # noqa: E741
    density = np.asarray(boozer.fusion_rate(nodes)) * (57 + I) * (B**-2).mean((1, 2))
    share = np.cumsum(density) / density.sum()
    # Kolmogorov–Smirnov at 1 %, and negative controls.
    limit = 1.63 / np.sqrt(4000)

    def distance(x, cumulated):
        return np.abs(np.sort(cumulated(x)) - (np.arange(x.size) + 0.5) / x.size).max()

    assert distance(s, lambda x: np.interp(x, nodes, share)) < limit
    assert distance(s, lambda x: x) > limit
    assert distance(pitch, lambda x: (x + 1) / 2) < limit
    B_there = np.asarray(at.B)
    assert np.mean(B_there**2) < np.mean(B[40] ** 2)  # more births where B is small
    np.testing.assert_allclose(args["mu"], (1 - pitch**2) / (2 * B_there), rtol=1e-9)
    alone = births.at(jnp.asarray(17), 0.0, None)
    np.testing.assert_allclose(alone[0], q[17], rtol=1e-12)
    on = boozer.Births(5, particles, surface=0.25, seed=1).at(jnp.asarray(2), 0.0, None)
    assert float(particles.coordinates_of(*on[:2]).s) == pytest.approx(0.25)


def test_loss_fractions_have_wilsons_interval():
    found = boozer.loss_fraction([0.1, np.nan, 0.3, np.nan], [0.2, 1.0], sigmas=1.0)
    np.testing.assert_allclose(found.fraction, [0.25, 0.5])
    # (p + 1/2N ± √(p(1−p)/N + 1/4N²))/(1 + 1/N) with N = 4
    half = np.sqrt(0.25 * 0.75 / 4 + 1 / 64) / 1.25
    np.testing.assert_allclose(found.low[0], (0.25 + 0.125) / 1.25 - half)
    np.testing.assert_allclose(found.high[1], 1 - found.low[1])
    with pytest.raises(ValueError, match="got none"):
        boozer.loss_fraction([], [1.0])


@slow
def test_a_sweep_over_births():
    """Each particle has its own μ; losses at the times of single runs."""
    field = boozer.from_modes(
        [0, 1, 1], [0, 0, 2], [[5.7], [-0.8], [0.3]], psi_edge=2.0, iota=0.42, G=57.0, periods=2
    )
    particles = boozer.GuidingCentres(field)
    births = boozer.Births(16, particles, seed=2)
    result = dvi.sweep(
        particles.system, start=births, args=particles.args(0.0), h=2.0, num_steps=400,
        method=dvi.GaussLegendre(2), stop=particles.loss, observe={"last": dvi.Last(_time)},
    )  # fmt: skip
    stops = np.asarray(result["stop_t"])
    counts = result.status_counts()
    assert 0 < counts["stopped"] == np.isfinite(stops).sum() < 16
    i = int(np.nanargmin(stops))
    q, p, args = births.at(jnp.asarray(i), 0.0, None)
    alone = integrate(particles, q, p, args, 2.0, 400, stop=particles.loss)
    assert float(alone.stop.t) == pytest.approx(stops[i], rel=1e-9)


def _time(t0, t1, q0, p0, q1, p1, args):
    return t1
