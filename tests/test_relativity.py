"""Relativity and the oblate Sun: equations by hand, and the orbits they turn."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import needs_ephemeris, run_problem
from scipy.interpolate import CubicSpline

import dvi_jax as dvi
from dvi_jax.systems import solar_system
from dvi_jax.systems.n_body import hamiltonian
from dvi_jax.systems.planets.relativity import (
    SPEED_OF_LIGHT,
    SUN_J2,
    SUN_POLE,
    SUN_RADIUS,
    hamiltonian_with_oblateness,
    momenta_from_velocities,
    oblateness,
    post_newtonian_force,
    post_newtonian_hamiltonian,
    velocities_from_momenta,
)
from dvi_jax.systems.planets.solar_system import BODIES, GM, to_ecliptic
from dvi_jax_cli.work.solar import compare

LIGHT = 1e-12  # mass of a planet here: effects of order m/M are then below the tolerances
TURN = 2 * np.pi


def test_constants_of_the_sun():
    assert abs(SPEED_OF_LIGHT - 173.144633) < 1e-6
    a, e, days = 0.3870983, 0.2056307, 87.9691  # Mercury
    century = 36525 * 3600 * 180 / np.pi / days
    advance = 6 * np.pi * GM[0] / (SPEED_OF_LIGHT**2 * a * (1 - e**2)) * century
    assert advance == pytest.approx(42.98, abs=0.01)
    assert abs(SUN_RADIUS - 0.00465247) < 1e-8  # au
    # The solar equator on the ecliptic: inclination 7.25°, ascending node at 75.77°.
    x, y, z = to_ecliptic(SUN_POLE)
    assert np.hypot(np.hypot(x, y), z) == pytest.approx(1, abs=1e-15)
    assert np.rad2deg(np.arccos(z)) == pytest.approx(7.25, abs=0.01)
    assert np.rad2deg(np.arctan2(x, -y)) == pytest.approx(75.77, abs=0.05)


G = 2.0
MASSES = np.array([0.6, LIGHT, 3 * LIGHT])
Q = np.array([[0.3, -0.2, 0.1], [1.4, 0.5, -0.3], [-0.8, 1.9, 0.6]])
V = np.array([[0.05, 0.02, -0.03], [-0.4, 0.9, 0.2], [-0.6, -0.3, 0.25]])


def acceleration(q, v, c2, quadratic=4.0):
    """a(r, v) of relativity about body 0, by hand, shape (bodies − 1, 3)."""
    mu, r, u = G * MASSES[0], q[1:] - q[0], v[1:] - v[0]
    d = np.linalg.norm(r, axis=1, keepdims=True)
    uu, ru = (np.sum(x * u, axis=1, keepdims=True) for x in (u, r))
    return mu / (c2 * d**3) * ((quadratic * mu / d - uu) * r + 4 * ru * u)


def test_force_is_mass_times_acceleration():
    args = {"masses": MASSES, "G": G}
    at = (0.0, 0.0, jnp.asarray(Q), MASSES[:, None] * V)
    force = post_newtonian_force(*at, args | {"c": 7.0})
    np.testing.assert_array_equal(force[0], 0)
    by_hand, wrong = (MASSES[1:, None] * acceleration(Q, V, 49.0, x) for x in (4.0, 3.0))
    np.testing.assert_allclose(force[1:], by_hand, rtol=1e-13)
    assert not np.allclose(force[1:], wrong, rtol=1e-2, atol=0)
    default = post_newtonian_force(*at, args)
    np.testing.assert_allclose(default * SPEED_OF_LIGHT**2, force * 49.0, rtol=1e-13)


@jax.jit
def of_hamilton(q, p, args):
    """dq/dt and d²q/dt² by Hamilton's equations of Newton and relativity."""

    def flow(q, p):
        def H(q, p):
            at = (0.0, 0.0, q, p, args)
            return hamiltonian(*at) + post_newtonian_hamiltonian(*at)

        dq, dp = jax.grad(H, argnums=(0, 1))(q, p)
        return dp, -dq

    rates = flow(q, p)
    return rates[0], jax.jvp(flow, (q, p), rates)[1][0]


def test_hamiltonian_accelerates_as_the_force_does():
    """To O(1/c⁴), from the momenta that belong to V; negative controls are off by O(1/c²)."""
    q, left = jnp.asarray(Q), []
    r = Q[1:] - Q[0]
    newton = -G * MASSES[0] * r / np.linalg.norm(r, axis=1, keepdims=True) ** 3
    for c2 in (100.0, 200.0, 400.0):
        args = {"masses": MASSES, "G": G, "c": c2**0.5}
        rate, second = map(np.asarray, of_hamilton(q, momenta_from_velocities(Q, V, args), args))
        naive = np.asarray(of_hamilton(q, MASSES[:, None] * V, args)[0])
        felt = second[1:] - second[0] - newton
        right, wrong = (felt - acceleration(Q, V, c2, x) for x in (4.0, 3.0))
        left.append([np.abs(x).max() for x in (rate - V, right, naive - V, wrong)])
    orders = np.log2(np.divide(left[:-1], left[1:]))
    np.testing.assert_allclose(orders, [[2, 2, 1, 1]] * 2, atol=0.1)


@pytest.mark.slow
def test_velocities_are_those_of_hamiltons_equations():
    masses = np.array([0.6, 0.1, 0.03])  # with a Sun that recoils
    args = {"masses": masses, "G": G, "c": 9.0}
    p = masses[:, None] * V
    velocities = velocities_from_momenta(Q, p, args)
    rate, _ = of_hamilton(jnp.asarray(Q), jnp.asarray(p), args)
    np.testing.assert_allclose(velocities, rate, rtol=0, atol=1e-15)
    assert np.abs(rate - V).max() > 1e-2
    total = np.sum(momenta_from_velocities(Q, V, args), axis=0)
    np.testing.assert_allclose(total, masses @ V, rtol=0, atol=1e-15)
    # Translations leave H1 as it is, so total momentum is kept: the forces sum to zero.
    pull = jax.grad(post_newtonian_hamiltonian, argnums=2)(0.0, 0.0, jnp.asarray(Q), p, args)
    assert np.abs(np.sum(pull, axis=0)).max() < 1e-15 < 1e-4 < np.abs(pull).max()


# Orbits. One planet about a Sun of GM = 1, a = 1, from its pericentre.


def start(e, inclination, node, turn):
    """Position and velocity at pericentre (ω = 0) on the axes that are the columns of `turn`."""
    ci, si, cn, sn = np.cos(inclination), np.sin(inclination), np.cos(node), np.sin(node)
    q = np.array([cn, sn, 0.0]) * (1 - e)
    v = np.array([-sn * ci, cn * ci, si]) * np.sqrt((1 + e) / (1 - e))
    return np.stack([0 * q, turn @ q]), np.stack([0 * v, turn @ v])


def per_turn(qs, vs, turn):
    """Advance of node and argument of pericentre per revolution [rad].

    The elements of the osculating orbits at the first and the last pericentre, r·v = 0, where the
    Laplace vector and r are parallel for every perturbation; splines through the steps.
    """
    r, v = ((np.asarray(x)[:, 1] - np.asarray(x)[:, 0]) @ turn for x in (qs, vs))
    passage = CubicSpline(np.arange(len(r)), np.sum(r * v, axis=1))
    at = passage.roots(extrapolate=False)
    at = at[passage(at, 1) > 0]
    orbit = dvi.elements.Keplerian.from_state(r, v, 1.0)
    node, peri = orbit.Omega, orbit.omega
    angles = CubicSpline(np.arange(len(r)), np.unwrap([node, peri]), axis=1)(at)
    return (angles[:, -1] - angles[:, 0]) / (len(at) - 1)


ECCENTRICITY = 0.2
MERCURY_LIKE = np.array([1.0, LIGHT])


STRENGTHS = [1.0, 0.5, 0.0]


@functools.cache
def relativistic(form):
    """Five turns at c = 100 and each strength, then each from p = m v: positions and p/m."""
    system = {
        "force": dvi.System(hamiltonian, force=post_newtonian_force),
        "hamiltonian": dvi.System(hamiltonian, perturbation=post_newtonian_hamiltonian),
    }[form]
    q0, v0 = start(ECCENTRICITY, 0.4, 0.7, np.eye(3))
    m = MERCURY_LIKE[:, None]
    own = [
        momenta_from_velocities(q0, v0, {"masses": MERCURY_LIKE, "c": 100 / max(s, 1e-30) ** 0.5})
        for s in STRENGTHS
    ]
    p0 = ([m * v0] * 3 if form == "force" else own) + [m * v0] * 3

    options = {"h": TURN / 120, "num_steps": 605, "method": dvi.GaussLegendre(3)}
    options |= {"args": {"masses": MERCURY_LIKE, "c": 100.0}}

    @jax.jit
    @jax.vmap
    def run(epsilon, p0):
        sol = dvi.integrate(system, q0, p0, epsilon=epsilon, **options)
        return sol.qs, sol.ps / m[None]

    return [np.asarray(x) for x in run(jnp.array(STRENGTHS * 2), jnp.stack(p0))]


@pytest.mark.parametrize("form", ["force", "hamiltonian"])
@pytest.mark.slow
def test_perihelion_advances_as_einstein_says(form):
    qs, vs = relativistic(form)
    turned = np.array([per_turn(q, v, np.eye(3)) for q, v in zip(qs[:3], vs[:3], strict=True)])
    expected = 6 * np.pi * 1e-4 / (1 - ECCENTRICITY**2)
    once, half, none = turned[:, 1]
    assert once == pytest.approx(expected, rel=2e-3)
    # The residual, some 4e-4, is the next order in 1/c²; extrapolation removes it.
    assert 4 * half - once == pytest.approx(expected, rel=2e-6)
    assert np.abs(turned[:, 0]).max() < 1e-11  # the plane stays
    assert abs(none) < 6e-10  # negative control: Newton; 4e-10 is the method's, of order h⁶


@pytest.mark.slow
def test_both_forms_are_one_orbit():
    """Apart by O(1/c⁴) when H1 starts from its own momenta, else by O(1/c²)."""
    force, canonical = (
        (qs[:, :, 1] - qs[:, :, 0]).reshape(2, 3, -1)
        for qs, _ in map(relativistic, ("force", "hamiltonian"))
    )
    own, naive = np.abs(canonical - force).max(axis=2)
    assert np.log2(own[0] / own[1]) == pytest.approx(2, abs=0.1)
    assert np.log2(naive[0] / naive[1]) == pytest.approx(1, abs=0.1)
    assert own[0] < 1e-4 < 0.05 < naive[0]
    assert max(own[2], naive[2]) < 1e-11  # Newton


OBLATE = dvi.System(hamiltonian_with_oblateness)
POLE = np.array([0.3, -0.5, 0.8])
J2_R2 = 1e-4


def axes(pole):
    """A rotation whose third column is the pole."""
    z = pole / np.linalg.norm(pole)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


@pytest.mark.slow
def test_oblateness_is_minus_gm_j2_p2():
    args = {"masses": MASSES, "G": G, "J2": 0.02, "R": 0.4, "pole": 5 * POLE}
    r = Q[1:] - Q[0]
    d = np.linalg.norm(r, axis=1)
    s = r @ POLE / (d * np.linalg.norm(POLE))
    by_hand = G * MASSES[0] * np.sum(MASSES[1:] / d * 0.02 * (0.4 / d) ** 2 * (3 * s**2 - 1) / 2)
    assert float(oblateness(jnp.asarray(Q), args)) == pytest.approx(by_hand, rel=1e-14)
    # A ring of matter about the equator, by summation: it attracts more in its plane.
    angle, side = TURN * np.arange(400) / 400, axes(POLE)
    ring = 0.01 * (np.cos(angle)[:, None] * side[:, 0] + np.sin(angle)[:, None] * side[:, 1])
    for where in (0.6 * side[:, 0] + 0.9 * side[:, 2], side[:, 1], side[:, 2]):
        beyond = 1 / np.linalg.norm(where) - np.mean(1 / np.linalg.norm(where - ring, axis=1))
        # A ring of radius s has J2 R² = s²/2.
        mine = {"masses": np.ones(2), "J2": 0.5, "R": 0.01, "pole": POLE}
        q = jnp.asarray(np.stack([np.zeros(3), where]))
        assert float(oblateness(q, mine)) == pytest.approx(beyond, rel=1e-3)
        mine["pole"] = np.sum(side, axis=1)
        assert float(oblateness(q, mine)) != pytest.approx(beyond, rel=0.1)


def test_defaults_are_the_suns_and_no_j2_is_newton():
    at, args = (0.0, 0.0, jnp.asarray(Q), MASSES[:, None] * V), {"masses": MASSES, "G": G}
    suns = args | {"J2": SUN_J2, "R": SUN_RADIUS, "pole": SUN_POLE}
    U = oblateness(at[2], args | {"J2": SUN_J2})
    assert float(U) == float(oblateness(at[2], suns)) != 0
    assert hamiltonian_with_oblateness(*at, args | {"J2": 0.0}) == hamiltonian(*at, args)
    big = args | {"J2": 0.1, "R": 1.0}
    assert hamiltonian_with_oblateness(*at, big) != hamiltonian(*at, args)
    slope = jax.grad(lambda J2: hamiltonian_with_oblateness(*at, args | {"J2": J2}))(SUN_J2)
    assert float(slope) == pytest.approx(float(U) / SUN_J2, rel=1e-14)


@functools.cache
def oblate(inclination):
    """Per turn (node, pericentre) at J2 R² = 1e-4, 5e-5, 0, −1e-4."""
    turn = axes(POLE)
    q0, v0 = start(ECCENTRICITY, inclination, 0.7, turn)
    m = jnp.asarray(MERCURY_LIKE[:, None])
    options = {"h": TURN / 200, "num_steps": 2020, "method": dvi.KahanLi(8)}

    def run(j2):
        args = {"masses": MERCURY_LIKE, "J2": j2, "R": 0.1, "pole": POLE}
        sol = dvi.integrate(OBLATE, q0, m * v0, args=args, **options)
        return sol.qs, sol.ps / m[None]

    runs = jax.jit(jax.vmap(run))(100 * J2_R2 * jnp.array([1.0, 0.5, 0.0, -1.0]))
    return np.array([per_turn(q, v, turn) for q, v in zip(*map(np.asarray, runs), strict=True)])


@pytest.mark.parametrize(
    "inclination", [pytest.param(0.4, marks=pytest.mark.slow), 1.3]
)  # below and above 63.4°, where ω is constant
def test_oblateness_turns_node_and_pericentre(inclination):
    ci = np.cos(inclination)
    p2 = (1 - ECCENTRICITY**2) ** 2
    expected = TURN * J2_R2 / p2 * np.array([-1.5 * ci, 0.75 * (5 * ci**2 - 1)])
    once, half, none, prolate = oblate(inclination)
    assert np.sign(expected[1]) == (1 if inclination < 1 else -1)
    np.testing.assert_allclose(once, expected, rtol=5e-3)
    np.testing.assert_allclose(4 * half - once, expected, rtol=2e-6)  # without the next order
    np.testing.assert_allclose(none, 0, atol=1e-10)  # negative controls
    np.testing.assert_allclose(prolate, -expected, rtol=5e-3)


@pytest.mark.slow
def test_a_run_is_differentiable_in_j2():
    q0, v0 = start(ECCENTRICITY, 0.4, 0.7, axes(POLE))

    def where(J2):
        args = {"masses": MERCURY_LIKE, "J2": J2, "R": 0.1, "pole": POLE}
        options = {"h": 0.05, "num_steps": 20, "method": dvi.TypeII(), "args": args}
        return dvi.integrate(OBLATE, q0, MERCURY_LIKE[:, None] * v0, **options).qs[-1, 1, 2]

    # One program for values and slope; centred differences: error s² and rounding 1e-16/s.
    both, s = jax.jit(lambda J2: jax.jvp(where, (J2,), (1.0,))), 1e-4
    slope = (both(0.01 + s)[0] - both(0.01 - s)[0]) / (2 * s)
    assert float(both(0.01)[1]) == pytest.approx(float(slope), rel=1e-7)
    assert abs(float(slope)) > 1e-4


@needs_ephemeris
@pytest.mark.slow
def test_mercury_follows_the_ephemeris():
    """Ten years: relativity and oblateness are what `n_body` lacks of DE421, 43″ a century."""
    made = solar_system("1900-01-01")
    made = dataclasses.replace(made, system=dvi.System(OBLATE.H_D, force=post_newtonian_force))
    options = {"h": 0.5, "method": dvi.GaussLegendre(3), "save": dvi.Save(every=10)}

    def beside(J2):
        sol = run_problem(made, 7200, epsilon=1.0, args=made.args | {"J2": J2}, **options)
        jd = 2415020.5 + np.asarray(sol.ts)
        seen = compare(jd, np.asarray(sol.qs), np.asarray(sol.ps), GM)
        return seen.slope, seen.errors.max(axis=0)

    slope, errors = beside(SUN_J2)
    # The error of the method, of order h⁶, is −0.0037″ a century.
    assert slope == pytest.approx(-0.0025, abs=2e-3)
    assert (errors[[BODIES.index("Mercury"), BODIES.index("Venus")]] < [0.5, 1.5]).all()  # km
    # Negative control: the round Sun lacks 0.025″.
    assert beside(0.0)[0] - slope == pytest.approx(0.0253, abs=1e-3)


def test_shapes_that_do_not_agree():
    args = {"masses": np.ones(3), "J2": 0.1}
    of_step = hamiltonian, post_newtonian_force, post_newtonian_hamiltonian
    for function in (*of_step, hamiltonian_with_oblateness, momenta_from_velocities,
                     velocities_from_momenta):  # fmt: skip
        times = (0.0, 0.0) * function.__name__.startswith(("hamiltonian", "post"))
        for q in (jnp.asarray(Q[:2]), jnp.ones(3)):
            with pytest.raises(ValueError, match=r"(positions|masses) must be"):
                function(*times, q, q, args)
    with pytest.raises(ValueError, match=r"pole.*\(2,\).*got shape \(3,\)"):
        oblateness(jnp.asarray(Q[:, :2]), args)
    oblateness(jnp.asarray(Q[:, :2]), args | {"pole": np.array([0.0, 1.0])})
