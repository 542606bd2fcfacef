"""Rates of orbits under perturbing forces against formulas of the literature; a fit of drag."""

from math import comb

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import legendre

import dvi_jax as dvi
from dvi_jax import elements, forces, systems

SUN, LIGHT = 2.959122082855911e-4, 173.1446326846693  # [au³/day²], [au/day]
EARTH, RADIUS = 398600.4415, 6378.1363  # [km³/s²], [km]
ZONAL = {2: 1.0826356e-3, 3: -2.5324105e-6, 4: -1.6198976e-6, 5: -2.277536e-7, 6: 5.406658e-7}
LAGEOS = elements.Keplerian(12270.0, 0.0045, np.radians(109.84), 1.0, 0.7, 0.3)
DAY = 86400.0


@pytest.mark.slow
def test_the_pericentre_of_mercury_over_ten_thousand_orbits():
    """3 n μ/(c² p) is the first order in 1/c². The rest is the second: 5e-7 of it for the Sun, and
    extrapolation from two velocities of light removes it."""
    a, e = 0.38709893, 0.20563069
    masses = np.array([1.0, 1e-13]) * SUN
    start = elements.Keplerian([a], [e], [0.1], [0.8], [0.5], [0.0])
    problem = systems.n_body(masses, *elements.to_bodies(start, masses))
    problem = forces.Relativity(lambda args: args["c"]).add_to(problem)
    n = np.sqrt(SUN / a**3)
    run = {"h": 2 * np.pi / n / 40, "num_steps": 400_000, "save": dvi.Save(every=37)}

    @jax.jit
    @jax.vmap
    def orbit(c):
        args = problem.args | {"c": c}
        sol = dvi.integrate(problem, args=args, method=dvi.WisdomHolman(scheme=(8, 4)), **run)
        orbit = sol.elements(masses)
        return sol.ts, (orbit.Omega + orbit.omega)[:, 0], orbit.M[:, 0]

    errors = []
    for c, ts, angle, M in zip((LIGHT, 2 * LIGHT), *map(np.asarray, orbit(
        LIGHT * jnp.array([1.0, 2.0]))), strict=True):  # fmt: skip
        # Within an orbit the angle oscillates by as much as it advances in it.
        waves = [f(k * M) for k in range(1, 13) for f in (np.cos, np.sin)]
        columns = np.stack([np.ones_like(ts), ts / ts[-1], *waves], 1)
        slope = np.linalg.lstsq(columns, np.unwrap(angle), rcond=None)[0][1] / ts[-1]
        errors.append(slope / (3 * n * SUN / (c**2 * a * (1 - e * e))) - 1)
    assert abs(errors[0]) < 1e-6
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.02)
    assert abs(4 * errors[1] - errors[0]) / 3 < 3e-9


def test_the_potential_with_the_precession_of_mercury():
    """The advance in each revolution is that of a central force, and 43 arcseconds a century."""
    a, e, turns = 0.38709893, 0.20563069, 10
    period, p = 2 * np.pi * np.sqrt(a**3 / SUN), a * (1 - e * e)
    start = a * (1 - e), np.sqrt(SUN * (1 + e) / (a * (1 - e)))
    turning = dvi.Section(lambda q, p: q @ p, max_crossings=turns)  # pericentres
    system = dvi.System(kepler, force=forces.PrecessionPotential(lambda args: args["c"]))
    run = {
        "h": period / 200,
        "num_steps": 200 * turns + 20,
        "method": dvi.KahanLi(8),
        "epsilon": 1.0,
    }

    @jax.vmap
    def angle(c):
        args, q0, p0 = {"mu": SUN, "c": c}, [start[0], 0.0], [0.0, start[1]]
        sol = dvi.integrate(
            system, q0, p0, args=args, observe=turning, save=dvi.Save(final=True), **run
        )
        q = sol.observed.qs[-1]
        return jnp.arctan2(q[1], q[0])

    light = LIGHT * np.array([1.0, 1e-2])  # the second: where the second order is large
    exact = 2 * np.pi * ((1 - 6 * SUN / (light**2 * p)) ** -0.5 - 1)
    np.testing.assert_allclose(angle(jnp.asarray(light)), turns * exact, rtol=0, atol=1e-11)
    assert abs(exact[1] / (6 * np.pi * SUN / (light[1] ** 2 * p)) - 1) > 1e-3
    assert np.degrees(exact[0]) * 3600 * 36525 / period == pytest.approx(42.98, abs=0.005)


def disturbing(degree, a, e, inc):
    """−J_n times the mean of the potential over M and the node, for J_n = 1: Kaula 1966, (3.71)."""
    u = 2 * np.pi * np.arange(64) / 64
    inclination = legendre.legval(np.sin(inc) * np.sin(u), [0.0] * degree + [1.0]).mean()
    sums = sum(comb(degree - 1, 2 * d) * comb(2 * d, d) * (e / 2) ** (2 * d)
               for d in range(degree // 2))  # fmt: skip
    return -EARTH / a * (RADIUS / a) ** degree * inclination * sums * (1 - e * e) ** (0.5 - degree)


@pytest.mark.parametrize("degree", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 6))])
@pytest.mark.parametrize("orbit", [LAGEOS, LAGEOS._replace(a=26560.0, e=0.7, inc=1.1)])
def test_mean_rates_of_node_and_perigee(degree, orbit):
    """Lagrange's equations of the mean potential, against the mean of the force on one orbit."""
    force = forces.Harmonics(RADIUS, {degree: 1.0})

    @jax.jit
    @jax.vmap
    def rates(M, omega):
        q, v = orbit._replace(M=M, omega=omega).state(EARTH)
        W = force(0.0, 0.0, q, v, {"mu": EARTH})
        of_v = jax.jvp(lambda v: elements.Keplerian.from_state(q, v, EARTH), (v,), (W,))
        return jnp.stack(of_v[1])

    M, omega = np.meshgrid(*(2 * np.pi * np.arange(n) / n for n in (1024, 16)))
    mean = np.asarray(rates(M.ravel(), omega.ravel())).mean(axis=0)
    a, e, inc = orbit.a, orbit.e, orbit.inc
    node, perigee = rates_of({degree: 1.0}, orbit)
    np.testing.assert_allclose(mean[3:5], [node, perigee], rtol=2e-9)
    np.testing.assert_allclose(mean[:3] / [a, 1, 1], 0, atol=1e-12 * abs(node))
    if degree == 2:  # Kozai 1959, (20): the formulas of textbooks
        size = 1.5 * np.sqrt(EARTH / a**3) * (RADIUS / (a * (1 - e * e))) ** 2
        kozai = -size * np.cos(inc), size * (2 - 2.5 * np.sin(inc) ** 2)
        np.testing.assert_allclose(mean[3:5], kozai, rtol=1e-9)


def rates_of(terms, orbit):
    """Node and perigee by Lagrange's equations of the mean potential, first order [rad/s]."""
    a, e, inc = orbit.a, orbit.e, orbit.inc
    x = 1e-4

    def slope(R):
        return (8 * (R(x) - R(-x)) - R(2 * x) + R(-2 * x)) / (12 * x)

    scale = np.sqrt(EARTH * a * (1 - e * e))
    total = np.zeros(2)
    for degree, J in terms.items():
        of_e = slope(lambda x, n=degree: disturbing(n, a, e + x, inc))
        of_inc = slope(lambda x, n=degree: disturbing(n, a, e, inc + x))
        node = of_inc / (scale * np.sin(inc))
        perigee = (1 - e * e) / (scale * e) * of_e - np.cos(inc) * node
        total += J * np.array([node, perigee])
    return total


@pytest.mark.slow
def test_node_and_perigee_of_lageos():
    """60 days with J2 to J6. The second order in J2, and the mean axis, are 1e-3 of the rates."""
    q, v = LAGEOS.state(EARTH)
    run = {"h": 120.0, "num_steps": 720 * 60, "save": dvi.Save(every=7)}
    force = forces.Harmonics(RADIUS, {n: lambda args, n=n: args[f"J{n}"] for n in ZONAL})
    system = dvi.System(kepler, force=force, epsilon=1.0)

    @jax.jit
    @jax.vmap
    def orbit(zonal):
        args = {"mu": EARTH} | {f"J{n}": J for n, J in zip(ZONAL, zonal, strict=True)}
        sol = dvi.integrate(system, q, v, args=args, method=dvi.KahanLi(8), **run)
        return sol.ts, elements.Keplerian.from_state(sol.qs, sol.ps, EARTH)

    J = np.array(list(ZONAL.values()))
    some = np.array([[1, 0, 0, 0, 0], [1, 0, 1, 0, 0], [1, 0, 1, 0, 1], [1, 1, 1, 1, 1]])
    ts, runs = orbit(jnp.asarray(some * J))
    days = np.asarray(ts[0]) / DAY
    nodes = [np.polyfit(days, np.degrees(np.unwrap(x)), 1)[0] for x in runs.Omega]
    wanted = {n: np.degrees(rates_of({n: ZONAL[n]}, LAGEOS)) * DAY for n in (2, 4, 6)}
    assert nodes[0] == pytest.approx(wanted[2][0], rel=2e-3)  # 0.342 degrees a day
    assert nodes[1] - nodes[0] == pytest.approx(wanted[4][0], rel=2e-3)
    assert nodes[2] - nodes[1] == pytest.approx(wanted[6][0], rel=5e-3)
    assert abs(nodes[3] - nodes[2]) < 1e-5  # odd zonals turn no node
    # Odd zonals force an eccentricity, about which e cos ω and e sin ω turn.
    rate = sum(x[1] for x in wanted.values())
    e, omega, M = (np.asarray(x)[3] for x in (runs.e, runs.omega, runs.M))
    z, turn = e * np.exp(1j * omega), np.exp(1j * np.radians(rate) * days)
    waves = [np.exp(1j * k * (M + omega)) for k in range(-4, 5) if k]
    columns = np.stack([np.ones_like(z), turn, days * turn, *waves], 1)
    fit = np.linalg.lstsq(columns, z, rcond=None)[0]
    perigee = rate + np.degrees((fit[2] / fit[1]).imag)
    assert perigee == pytest.approx(rate, rel=1e-2)  # −0.214 degrees a day


def kepler(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 - args["mu"] / jnp.sqrt(q0 @ q0)


@pytest.mark.slow
def test_a_fit_recovers_the_drag_of_a_satellite():
    """From distances to a station with an error of 5 cm, along a day."""
    orbit = elements.Keplerian(RADIUS + 400.0, 0.002, 1.2, 0.4, 0.2, 0.1)
    station = RADIUS * np.array([np.cos(0.7), 0.0, np.sin(0.7)])

    def density(r, args):
        return 3e-12 * jnp.exp(-(jnp.sqrt(r @ r) - RADIUS - 400.0) / 60.0) * 1e9  # [kg/km³]

    drag = forces.Drag(density, 2.2 * 4e-6 / 500.0, rate=7.292115e-5)
    full = forces.Harmonics(RADIUS, {2: ZONAL[2]}) + (lambda args: args["drag"]) * drag
    system = dvi.System(kepler, force=full, epsilon=1.0)
    q, v = map(np.asarray, orbit.state(EARTH))
    model = dvi.Model(system, h=60.0, args={"mu": EARTH}, method=dvi.GaussLegendre(3))
    ts = np.arange(1, 361) * 240.0

    def distance(t, q, p, args):
        return jnp.sqrt(jnp.sum((q - station) ** 2))[None]

    exact = model({"q0": q, "p0": v, "args": {"drag": 1.0}})
    sol = dvi.integrate(**exact, num_steps=1440, save=dvi.Save(every=4), observe=distance)
    noise = 5e-5 * np.random.default_rng(3).normal(size=(360, 1))
    data = dvi.Observations(ts, np.asarray(sol.observed)[1:] + noise, distance, sigma=5e-5, t0=0.0)
    found = dvi.fit(model, data, {"q0": q + 1e-3, "p0": v - 1e-6, "args": {"drag": 0.5}})
    value = found.params["args"]["drag"]
    (error,) = (s for name, s in zip(found.names, found.sigma, strict=True) if "drag" in name)
    assert abs(value - 1) < 3 * error < 0.03
    assert found.reduced_chi2 == pytest.approx(1, abs=0.2)
