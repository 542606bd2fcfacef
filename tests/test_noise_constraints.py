"""Noise on constraints: canonical distributions on manifolds, and rigid bodies with noise.

Means are compared within three standard errors; p-values of Kolmogorov and Smirnov must be above
0.003, three standard deviations, where the distribution is right. The seeds are fixed.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import gradient_by_differences
from scipy import stats

import dvi_jax as dvi
from dvi_jax.systems import rigid

slow = pytest.mark.slow
T, RIGHT, WRONG = 0.5, 0.003, 1e-5


def ends(system, q0, p0, h, num_steps, paths, method=dvi.BAOAB(), seed=0):
    """Final states of independent paths."""

    def last(key):
        sol = dvi.integrate(system, q0, p0, h=h, num_steps=num_steps, method=method,
                            path=dvi.Brownian(key), save=dvi.Save(final=True))  # fmt: skip
        return sol.qs[-1], sol.ps[-1]

    keys = jax.random.split(jax.random.key(seed), paths)
    return [np.asarray(x) for x in jax.jit(jax.vmap(last))(keys)]


def p_value(x, density, low, high):
    """Of samples of a distribution with this density, not normalised."""
    grid = np.linspace(low, high, 4001)
    weight = density(grid)
    total = np.concatenate([[0.0], np.cumsum((weight[1:] + weight[:-1]) / 2)])
    return stats.kstest(x, lambda y: np.interp(y, grid, total / total[-1])).pvalue


def unit_sphere(q, args):
    return (q @ q - 1)[None] / 2


def weight_on_sphere(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + q0[2]


START = np.array([0.6, 0.0, -0.8]), np.array([0.4, 0.5, 0.3])
FIELD = dvi.System(weight_on_sphere, noise=dvi.Langevin(1.0, T), constraint=unit_sphere)


@pytest.mark.parametrize(
    ("method", "h", "paths"),
    [
        (dvi.BAOAB(), 0.2, 5000),
        pytest.param(dvi.BAOAB(geodesic_steps=3), 0.2, 20_000, marks=slow),
        pytest.param(dvi.BAOAB(base=dvi.Rattle()), 0.1, 20_000, marks=slow),
        pytest.param(dvi.OBABO(), 0.1, 20_000, marks=slow),
    ],
)
def test_a_spherical_pendulum_in_a_bath(method, h, paths):
    """The height has the density exp(−z/T), and |p|²/T two degrees of freedom."""
    q, p = ends(FIELD, *START, h, round(12 / h), paths, method)
    assert np.abs(np.sum(q**2, axis=1) - 1).max() < 1e-14
    assert np.abs(np.sum(q * p, axis=1)).max() < 1e-14
    assert p_value(q[:, 2], lambda z: np.exp(-z / T), -1, 1) > RIGHT
    assert p_value(q[:, 2], lambda z: np.exp(-z / (1.3 * T)), -1, 1) < WRONG
    energy = np.sum(p**2, axis=1)
    assert stats.kstest(energy / T, stats.chi2(2).cdf).pvalue > RIGHT
    assert stats.kstest(energy / (1.3 * T), stats.chi2(2).cdf).pvalue < WRONG
    assert stats.kstest(energy / T, stats.chi2(3).cdf).pvalue < WRONG


@slow
def test_an_ellipse_has_the_measure_of_arc_length():
    """That of the surface of g = 0, and not that of a stiff spring, which is divided by |∇g|."""
    free = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2, noise=dvi.Langevin(1.0, T),
                      constraint=lambda q, args: (q[0] ** 2 / 4 + q[1] ** 2 - 1)[None])  # fmt: skip
    q, _ = ends(free, np.array([2.0, 0.0]), np.zeros(2), 0.1, 400, 20_000)
    phi = np.arctan2(q[:, 1], q[:, 0] / 2) % (2 * np.pi)
    length = lambda x: np.sqrt(4 * np.sin(x) ** 2 + np.cos(x) ** 2)  # noqa: E731
    assert p_value(phi, length, 0, 2 * np.pi) > RIGHT
    # |∇g| = length(φ), so that the other measure is uniform in φ.
    assert p_value(phi, np.ones_like, 0, 2 * np.pi) < WRONG


MASSES = np.array([[1.0], [0.2], [1.0]])


def rods(q, args):
    """Two rods between three masses."""
    return (jnp.sum((q[1:] - q[:-1]) ** 2, axis=1) - 1) / 2


def free_masses(t0, t1, q0, p1, args):
    return jnp.sum(p1**2 / MASSES) / 2


# With one, RATTLE has no solution once in 4·10⁶ steps: the mass in the middle is light.
THREE = dvi.BAOAB(geodesic_steps=3)
UNEQUAL = np.array([[0.2], [8.0], [0.5]]) * np.ones((3, 3))


@slow
@pytest.mark.parametrize("friction", [1.0, UNEQUAL], ids=["equal friction", "other friction"])
def test_two_rods_in_a_bath(friction):
    """c, the cosine between the rods, has the density √det(G M⁻¹ Gᵀ) ∝ √(36 − 25c²) of the surface
    in the metric M, and not the uniform one of stiff springs (Fixman 1974)."""
    system = dvi.System(free_masses, noise=dvi.Langevin(friction, T, MASSES), constraint=rods)
    start = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    q, p = ends(system, start, np.zeros((3, 3)), 0.1, 200, 20_000, THREE)
    d = np.diff(q, axis=1)
    c = np.sum(d[:, 0] * d[:, 1], axis=1)
    assert p_value(c, lambda c: np.sqrt(36 - 25 * c**2), -1, 1) > RIGHT
    assert p_value(c, np.ones_like, -1, 1) < WRONG
    energy = np.sum(p**2 / MASSES, axis=(1, 2)) / T
    assert stats.kstest(energy, stats.chi2(7).cdf).pvalue > RIGHT
    assert stats.kstest(energy, stats.chi2(9).cdf).pvalue < WRONG


@slow
def test_unequal_friction_needs_its_weight_of_the_forces_of_constraint(monkeypatch):
    system = dvi.System(free_masses, noise=dvi.Langevin(UNEQUAL, T, MASSES), constraint=rods)
    start = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])

    def energies():
        _, p = ends(system, start, np.zeros((3, 3)), 0.1, 100, 20_000, THREE)
        return np.sum(p**2 / MASSES, axis=(1, 2)) / T

    right = energies()
    monkeypatch.setattr(dvi.Langevin, "reaction", lambda *args: 1)
    jax.clear_caches()
    wrong = energies()
    jax.clear_caches()
    error = np.sqrt(2 * 7 / 20_000)
    assert abs(right.mean() - 7) < 3 * error
    assert abs(wrong.mean() - 7) > 5 * error


WATER = np.array([[16.0], [1.0], [1.0]])
HALF = np.deg2rad(109.47 / 2)
MOLECULE = np.array(
    [[0.0, 0.0, 0.0], [np.sin(HALF), np.cos(HALF), 0.0], [-np.sin(HALF), np.cos(HALF), 0.0]]
)


def sides(q, args):
    """Two bonds and the distance of the hydrogen atoms."""
    lengths = jnp.array([1.0, 1.0, 2 * np.sin(HALF)])
    a = jnp.stack([q[1] - q[0], q[2] - q[0], q[2] - q[1]])
    return (jnp.sum(a**2, axis=1) - lengths**2) / 2


def water_in_field(t0, t1, q0, p1, args):
    """Charges (−2, 1, 1) in the unit field along z."""
    return jnp.sum(p1**2 / WATER) / 2 - (q0[1, 2] + q0[2, 2] - 2 * q0[0, 2])


def bath_of_water(mass=WATER, temperature=1.0):
    return dvi.System(water_in_field, noise=dvi.Langevin(2.0, temperature, mass), constraint=sides)


@slow
def test_rigid_water_in_a_bath():
    """Six degrees of freedom, and the function of Langevin coth x − 1/x of its dipole."""
    count, dipole = 20_000, 2 * np.cos(HALF)
    q, p = ends(bath_of_water(), MOLECULE, np.zeros((3, 3)), 0.1, 200, count)
    assert np.abs(jax.vmap(lambda q: sides(q, None))(q)).max() < 1e-14
    energy = np.sum(p**2 / WATER, axis=(1, 2))
    assert abs(energy.mean() - 6) < 3 * np.sqrt(12 / count)
    assert stats.kstest(energy, stats.chi2(6).cdf).pvalue > RIGHT
    cosine = (q[:, 1, 2] + q[:, 2, 2] - 2 * q[:, 0, 2]) / dipole
    mean = 1 / np.tanh(dipole) - 1 / dipole
    assert abs(cosine.mean() - mean) < 3 * cosine.std() / np.sqrt(count)
    assert p_value(cosine, lambda c: np.exp(dipole * c), -1, 1) > RIGHT
    # controls: another temperature, and noise of another mass than that of H
    assert p_value(cosine, lambda c: np.exp(dipole * c / 1.2), -1, 1) < WRONG
    _, p = ends(bath_of_water(mass=2.0), MOLECULE, np.zeros((3, 3)), 0.1, 50, count)
    energy = np.sum(p**2 / WATER, axis=(1, 2))
    assert stats.kstest(energy, stats.chi2(6).cdf).pvalue < WRONG


MOMENTS = np.array([1.0, 2.0, 2.5])


def top(t0, t1, q0, p1, args):
    return rigid.rotational_energy(p1, MOMENTS) - q0[2, 2]


@slow
@pytest.mark.parametrize("method", [dvi.BAOAB(), dvi.OBABO()])
def test_a_rigid_body_in_a_bath(method):
    """Each component of the angular momentum is normal with the variance T I_k, 2E/T has three
    degrees of freedom, and the axis has the density exp(c/T) in the field."""
    bath = dvi.Langevin(1.0, T, rigid.second_moments(MOMENTS))
    body = dvi.System(top, noise=bath, constraint=rigid.orthonormal)
    q, p = ends(body, np.eye(3), np.zeros((3, 3)), 0.1, 120, 20_000, method)
    pi = np.asarray(jax.vmap(rigid.body_momentum)(q, p))
    for k in range(3):
        scaled = pi[:, k] / np.sqrt(T * MOMENTS[k])
        assert stats.kstest(scaled, stats.norm.cdf).pvalue > RIGHT
        assert stats.kstest(scaled * 1.1, stats.norm.cdf).pvalue < WRONG
    twice = np.sum(pi**2 / MOMENTS, axis=1)
    assert stats.kstest(twice / T, stats.chi2(3).cdf).pvalue > RIGHT
    assert abs(twice.mean() / T - 3) < 3 * np.sqrt(6 / 20_000)
    assert p_value(q[:, 2, 2], lambda c: np.exp(c / T), -1, 1) > RIGHT
    assert p_value(q[:, 2, 2], np.ones_like, -1, 1) < WRONG
    # The mass of the noise is the second moments of the body: with another the test fails.
    other = dvi.System(top, noise=dvi.Langevin(1.0, T), constraint=rigid.orthonormal)
    q, p = ends(other, np.eye(3), np.zeros((3, 3)), 0.1, 120, 20_000, method)
    pi = np.asarray(jax.vmap(rigid.body_momentum)(q, p))
    assert stats.kstest(np.sum(pi**2 / MOMENTS, axis=1) / T, stats.chi2(3).cdf).pvalue < WRONG


def coupled(t0, t1, q0, p1, args):
    """Not separable."""
    return (1 + 0.3 * q0[0] ** 2) * (p1 @ p1) / 2 + q0[2]


STEPS = {
    "BAOAB": (weight_on_sphere, dvi.BAOAB(), 1.3),
    "three geodesic steps": (weight_on_sphere, dvi.BAOAB(geodesic_steps=3), 1.3),
    "OBABO": (weight_on_sphere, dvi.OBABO(), 1.3),
    "not separable": (coupled, dvi.BAOAB(), 1.3),
    "unequal friction": (weight_on_sphere, dvi.BAOAB(), jnp.array([0.5, 4.0, 1.0])),
}


@slow
@pytest.mark.parametrize("name", STEPS)
def test_a_step_back_along_the_path_undoes_a_step(name):
    H_D, method, friction = STEPS[name]
    system = dvi.System(H_D, noise=dvi.Langevin(friction, T), constraint=unit_sphere)
    increments = jnp.array([[0.1, -0.2, 0.3], [0.2, 0.1, 0.05]])[: method.increments]
    equations = dvi.Equations(system, jnp.zeros(()), increments=increments)
    interval = dvi.Interval(*map(jnp.asarray, (0.0, 0.1, 0.1)))
    q, p = map(jnp.asarray, START)
    q1, p1, info = jax.jit(lambda *state: method.step(equations, interval, *state))(q, p)
    assert info.result == dvi.RESULTS.successful
    assert abs(q1 @ q1 - 1) < 1e-15
    velocity = jax.grad(H_D, 3)(0.0, 0.0, q1, p1, None)
    assert abs(q1 @ velocity) < 1e-15
    back = jax.jit(lambda *state: method.inverse(equations, interval, *state))(q1, p1)
    assert np.abs(np.stack(back[:2]) - np.stack(START)).max() < 1e-14
    assert np.abs(q1 - q).max() > 0.01
    # The increments have an effect along the sphere.
    silent = dvi.Equations(system, jnp.zeros(()), increments=0 * increments)
    _, other, _ = jax.jit(lambda *state: method.step(silent, interval, *state))(q, p)
    assert np.abs(other - p1).max() > 0.01


@slow
def test_gradients_on_a_sphere_are_those_of_differences():
    def loss(v, adjoint):
        system = dvi.System(
            lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + args[0] * q0[2],
            noise=dvi.Langevin(lambda args: args[1], lambda args: args[2]), constraint=unit_sphere,
        )  # fmt: skip
        sol = dvi.integrate(system, *START, args=v[:3], h=v[3], num_steps=20, method=dvi.BAOAB(),
                            path=3, adjoint=adjoint, save=dvi.Save(every=10))  # fmt: skip
        return jnp.sum(sol.qs * jnp.cos(sol.ps))

    v = jnp.array([1.1, 0.3, 0.2, 0.05])
    slopes = jax.jit(jax.grad(lambda v: loss(v, dvi.Reversible(checkpoint_every=5))))(v)
    differences = gradient_by_differences(jax.jit(lambda v: loss(v, dvi.Direct())), v)
    np.testing.assert_allclose(slopes, differences, rtol=1e-7)


@slow
def test_equal_bits_alone_and_in_a_batch_with_a_constraint():
    def last(key):
        return dvi.integrate(FIELD, *START, h=0.1, num_steps=30, method=dvi.BAOAB(),
                             path=dvi.Brownian(key)).qs  # fmt: skip

    keys = jax.random.split(jax.random.key(2), 20)
    np.testing.assert_array_equal(jax.jit(jax.vmap(last))(keys)[7], last(keys[7]))


@slow
def test_without_noise_the_energy_is_conserved():
    quiet = dvi.System(weight_on_sphere, constraint=unit_sphere)
    widths = []
    for h in (0.1, 0.05):
        sol = dvi.integrate(quiet, *START, h=h, num_steps=2000, method=dvi.BAOAB())
        energy = np.sum(sol.ps**2, axis=1) / 2 + sol.qs[:, 2]
        widths.append(energy.max() - energy.min())
    assert widths[0] < 0.01
    assert np.log2(widths[0] / widths[1]) == pytest.approx(2, abs=0.2)


@slow
@pytest.mark.parametrize("method", [dvi.BAOAB(base=dvi.Strang()), dvi.StochasticMidpoint()])
def test_methods_that_do_not_fit_are_refused(method):
    with pytest.raises(ValueError, match=r"a system with a constraint needs .*dvi.BAOAB"):
        dvi.integrate(FIELD, *START, h=0.1, num_steps=2, method=method, path=0)


def test_what_needs_the_motion_without_noise_is_refused():
    run = {"h": 0.1, "num_steps": 2, "method": dvi.BAOAB()}
    force = dvi.ConstraintForce()
    for observable in (force, {"force": dvi.Running(dvi.Mean(force))}):
        with pytest.raises(ValueError, match="ConstraintForce cannot be used with noise"):
            dvi.integrate(FIELD, *START, observe=observable, path=0, **run)
    with pytest.raises(ValueError, match="invariant_diffusion requires a system without"):
        dvi.invariant_diffusion(FIELD, *START, invariant=lambda q, p: q[2], **run)
