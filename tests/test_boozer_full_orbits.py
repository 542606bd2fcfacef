"""Full orbits and their guiding centres, and equilibria of VMEC, in an exact field."""

import dataclasses
import functools
import sys
import tempfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.io import netcdf_file

import dvi_jax as dvi
from dvi_jax.systems import boozer

slow = pytest.mark.slow
R0, B0, EDGE, NODES = 6.0, 5.7, 0.3, 64


def vacuum(s, last=10):
    """B = B0 R0/R in Boozer coordinates, with circles about R0 as surfaces: ψ = B0 R0² y.

    With ε = r/R0 = √(y(2 − y)) the angle is that of tan(θ/2) = √((1 − ε)/(1 + ε)) tan(ϑ/2), ϑ the
    angle of the circle. **Returns** ψ_edge, the modes of |B|, and those of R and Z.
    """
    y = (1 - np.sqrt(1 - EDGE**2)) * s
    ratio = np.sqrt(y * (2 - y))
    B = B0 / (1 - y) ** 2
    theta = 2 * np.pi * np.arange(NODES) / NODES
    e = ratio[:, None]
    R = R0 * (1 - e**2) / (1 - e * np.cos(theta))
    Z = R0 * e * np.sqrt(1 - e**2) * np.sin(theta) / (1 - e * np.cos(theta))
    scale = 2 / NODES / np.where(np.arange(last + 1) == 0, 2, 1)
    R, Z = (scale * np.fft.rfft(x, axis=1)[:, : last + 1] for x in (R, Z))
    psi = B0 * R0**2 * (1 - np.sqrt(1 - EDGE**2))
    return psi, np.stack([B, -B * ratio], 1), R.real, -Z.imag


@functools.cache
def device():
    """Field and geometry of a file of booz_xform, which has left-handed angles."""
    count = 25
    s = (np.arange(1, count) - 0.5) / (count - 1)
    psi, B, R, Z = vacuum(s)
    full = np.zeros_like(R)
    full[:, :2] = B
    zero = np.zeros(count)
    arrays = {
        "nfp_b": 1, "ns_b": count, "jlist": np.arange(2, count + 1), "ixm_b": np.arange(11),
        "ixn_b": np.zeros(11, int), "iota_b": zero, "bvco_b": zero + B0 * R0, "buco_b": zero,
        "phi_b": 2 * np.pi * psi * np.linspace(0, 1, count), "bmnc_b": full, "rmnc_b": R,
        "zmns_b": Z, "pmns_b": 0 * Z,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "boozmn.nc"
        write(path, arrays)
        return boozer.read_booz_xform(path, degree=8), boozer.read_geometry(path, degree=8)


def write(path, arrays):
    with netcdf_file(path, "w") as file:
        for name, x in arrays.items():
            x = np.asarray(x, "i4" if np.asarray(x).dtype.kind == "i" else "f8")
            dims = [f"{name}_{i}" for i in range(x.ndim)]
            for dim, size in zip(dims, x.shape, strict=True):
                file.createDimension(dim, size)
            file.createVariable(name, x.dtype, dims)[...] = x


def orbits(scale=1.0, iota=0.0):
    """Alphas in the field times a factor, which is 1/ε; `iota` twists it, in the same geometry."""
    field, geometry = device()
    field = dataclasses.replace(
        field, psi_edge=field.psi_edge * scale, coefficients=field.coefficients * scale,
        G=field.G * scale, iota=0 * field.iota + iota,
    )  # fmt: skip
    return boozer.FullOrbits(boozer.GuidingCentres(field), geometry)


@slow
def test_the_field_in_real_space_is_the_exact_one():
    orbit = orbits()
    place = jnp.array([0.4, 0.7, 0.9])
    x = orbit.geometry.cartesian(*place)
    np.testing.assert_allclose(orbit.coordinates_of(x), place, rtol=1e-12)
    R = np.hypot(x[0], x[1])
    toroidal = np.array([-x[1], x[0], 0.0]) / R * orbit.geometry.direction
    np.testing.assert_allclose(orbit.field(x), B0 * R0 / R * toroidal, atol=1e-7)
    assert float(orbit.particles.field.strength(*place)) == pytest.approx(B0 * R0 / R, abs=1e-7)
    symmetric, breaking = orbit.particles.field.split()
    broken = boozer.GuidingCentres(symmetric, breaking=breaking)
    with pytest.raises(ValueError, match="complete field"):
        boozer.FullOrbits(broken, orbit.geometry)


@slow
def test_the_round_trip_is_of_second_order():
    """In a twisted field: x_c, u and μ with errors ∝ ε², and the phase exactly."""
    changes = []
    for scale in (1.0, 2.0, 4.0):
        orbit = orbits(scale, 0.7)
        q, p, args = orbit.particles.start(0.3, 0.7, 0.9, 0.4)
        x, v = orbit.from_centre(q, p, args, 1.1)
        assert float(jnp.linalg.norm(v)) == pytest.approx(1, abs=1e-12)
        *again, phase = orbit.to_centre(x, v)
        assert float(phase) == pytest.approx(1.1, abs=1e-12)
        a, b = (orbit.particles.coordinates_of(*z[:2]) for z in ((q, p), again))
        shift = orbit.geometry.cartesian(*a[:3]) - orbit.geometry.cartesian(*b[:3])
        speed = (a.v_parallel - b.v_parallel) / orbit.particles.speed
        changes.append([jnp.linalg.norm(shift), speed, again[2]["mu"] / args["mu"] - 1])
    sizes = np.abs(np.array(changes, float))
    np.testing.assert_allclose(np.log2(sizes[:-1] / sizes[1:]), 2, atol=0.1)
    assert (sizes[0] < 1e-3).all()


@eqx.filter_jit
def follow(orbit, start):
    """Guiding centres of a full orbit of 4.7 m, and those of the guiding-centre run."""
    h, particles = 4.7 / 2048, orbit.particles
    q, p, args = particles.state(*start)
    x, v = orbit.from_centre(q, p, args, 1.1)
    sol = dvi.integrate(
        orbit.system, x, v, h=h, num_steps=2048, epsilon=1.0, method=orbit.method,
        save=dvi.Save(every=128), throw=False,
    )  # fmt: skip
    qs, ps, at, _ = jax.vmap(orbit.to_centre)(sol.qs, sol.ps)
    run = dvi.integrate(
        particles.system, q, p, args=args, h=128 * h, num_steps=16, method=dvi.GaussLegendre(3),
        throw=False,
    )  # fmt: skip
    a, b = particles.coordinates_of(qs, ps), particles.coordinates_of(run.qs, run.ps)
    places = [orbit.geometry.cartesian(*z[:3]) for z in (a, b)]
    return *places, sol.qs, sol.ps, at["mu"] / args["mu"]


@slow
def test_a_full_orbit_follows_its_guiding_centre():
    errors, moments, plain = [], [], []
    start = [jnp.asarray(x) for x in (0.3, 0.7, 0.9, 0.4)]
    for scale in (1.0, 2.0, 4.0):
        full, centre, x, v, mu = map(np.asarray, follow(orbits(scale), start))
        assert np.ptp(np.linalg.norm(v, axis=1)) < 1e-12
        errors.append(np.linalg.norm(full - centre, axis=1).max())
        moments.append(np.abs(mu - 1).max())
        plain.append(np.linalg.norm(x - centre, axis=1).max())
    # O(ε) is required; without the correction it is the gyroradius.
    order = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    assert (order > 0.9).all()
    assert errors[0] < 0.1 * plain[0]
    np.testing.assert_allclose(np.array(plain)[:-1] / np.array(plain)[1:], 2, rtol=0.05)
    assert (np.log2(np.array(moments)[:-1] / np.array(moments)[1:]) > 1.7).all()


def test_an_equilibrium_of_vmec(tmp_path):
    """The wout file of the exact field: R = R0 + r cos ϑ, with λ = θ − ϑ."""
    pytest.importorskip("booz_xform")
    count, last = 21, 10
    grid = np.linspace(0, 1, count)
    y = (1 - np.sqrt(1 - EDGE**2)) * np.stack([grid, np.append(0, (grid[1:] + grid[:-1]) / 2)])
    ratio, half = np.sqrt(y * (2 - y))
    angle = 2 * np.pi * np.arange(NODES) / NODES
    e = half[:, None]
    wave = np.arctan2(np.sqrt(1 - e**2) * np.sin(angle), np.cos(angle) + e)
    shift = (wave - angle + np.pi) % (2 * np.pi) - np.pi
    lam = -2 / NODES * np.fft.rfft(shift, axis=1).imag[:, : last + 1]
    scale = 2 / NODES / np.where(np.arange(last + 1) == 0, 2, 1)
    B = scale * np.fft.rfft(B0 / (1 + e * np.cos(angle)), axis=1).real[:, : last + 1]
    m, zero, none = np.arange(last + 1), np.zeros(count), np.zeros((count, last + 1))
    R, Z, bv = none.copy(), none.copy(), none.copy()
    R[:, 0], R[:, 1], Z[:, 1], bv[1:, 0] = R0, R0 * ratio, R0 * ratio, B0 * R0
    psi = vacuum(grid[1:])[0]
    write(tmp_path / "wout.nc", {
        "lasym__logical__": 0, "nfp": 1, "ns": count, "mpol": last + 1, "ntor": 0, "mnmax": 11,
        "mnmax_nyq": 11, "xm": 1.0 * m, "xn": 0.0 * m, "xm_nyq": 1.0 * m, "xn_nyq": 0.0 * m,
        "iotas": zero, "iotaf": zero, "phi": 2 * np.pi * psi * grid, "phipf": zero + psi,
        "phips": zero + psi, "chi": zero, "pres": zero, "beta_vol": zero, "buco": zero,
        "bvco": zero + B0 * R0, "rmnc": R, "zmns": Z, "lmns": lam, "bmnc": B, "bsubumnc": none,
        "bsubvmnc": bv, "aspect": 1 / EDGE, "Aminor_p": R0 * EDGE, "rmax_surf": R0 * (1 + EDGE),
        "rmin_surf": R0 * (1 - EDGE), "betaxis": 0.0,
    })  # fmt: skip
    field, geometry = boozer.read_vmec(tmp_path / "wout.nc", modes=(24, 0), degree=8)
    exact = orbits()
    s, theta, zeta = (np.array(x) for x in ([0.1, 0.4, 0.9], [0.7, 3.0, -1.2], [0.2, 0.9, 2.0]))
    R, _, Z = geometry.cylindrical(s, theta, zeta)
    np.testing.assert_allclose(np.hypot(R - R0, Z) / R0, np.sqrt(1 - (1 - y[0, -1] * s) ** 2),
                               rtol=1e-6)  # fmt: skip
    np.testing.assert_allclose(field.strength(s, theta, zeta), B0 * R0 / R, rtol=1e-6)
    there = exact.geometry.cylindrical(s, theta, zeta)
    np.testing.assert_allclose(R, there[0], rtol=1e-6)
    assert float(field.psi_edge) == pytest.approx(psi, rel=1e-12)


def test_optional_packages_are_named(monkeypatch, tmp_path):

    for name, read in {"booz_xform": boozer.read_vmec, "trimesh": boozer.read_wall}.items():
        monkeypatch.setitem(sys.modules, name, None)
        (tmp_path / name).write_text("")
        with pytest.raises(ImportError, match=f"pip install {name}"):
            read(tmp_path / name)
