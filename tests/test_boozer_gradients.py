"""Measures of Boozer fields for optimisation: formulas, gradients, a descent."""

import dataclasses
import functools
import importlib.util
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference

from dvi_jax.systems import boozer

MODES = {(0, 0): 5.7, (1, 0): -0.9, (0, 2): 0.12, (1, 2): 0.06, (2, -2): 0.05}
ENERGY = 3.5e4
STEPS = 250


def field_of(modes, **options):
    (m, n), B = zip(*modes, strict=True), np.array(list(modes.values()))[:, None]
    given = {"psi_edge": 7.8, "iota": [0.42, -0.05], "G": 62.0, "periods": 2} | options
    return boozer.from_modes(m, n, B, **given)


@pytest.fixture(scope="module")
def broken():
    return field_of(MODES)


@pytest.fixture(scope="module")
def starts():
    """Mostly trapped particles."""
    r = np.random.default_rng(0)
    s, angles = r.uniform(0.1, 0.6, 8), r.uniform(0, 6, (2, 8))
    return jnp.asarray(np.stack([s, *angles, r.uniform(-0.4, 0.4, 8)], axis=-1))


@jax.jit
@jax.value_and_grad
def drift_with_gradient(field, starts):
    particles = boozer.GuidingCentres(field, energy=ENERGY)
    return boozer.mean_drift(particles, starts, num_steps=STEPS, h=8.0)


def drift(field, starts):
    return drift_with_gradient(field, starts)[0]


def gradient_of_drift(field, starts):
    return drift_with_gradient(field, starts)[1]


def directions(field):
    """Changes of one kind of number of the field each."""
    zero, (_, breaking) = jax.tree.map(jnp.zeros_like, field), field.split()
    noise = jnp.asarray(np.random.default_rng(1).normal(size=breaking.shape))
    changes = {
        "coefficients": jnp.where(breaking != 0, noise, 0),
        "iota": jnp.asarray([1.0, 0.5]),
        "psi_edge": jnp.asarray(1.0),
        "G": jnp.asarray([10.0]),
    }
    return {name: dataclasses.replace(zero, **{name: change}) for name, change in changes.items()}


def along(gradient, direction):
    return jax.tree.reduce(jnp.add, jax.tree.map(lambda a, b: jnp.sum(a * b), gradient, direction))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param("coefficients", marks=pytest.mark.slow), "iota", "psi_edge", "G"]
)
def test_gradient_of_the_drift_equals_differences(broken, starts, name):
    direction = directions(broken)[name]
    found = along(gradient_of_drift(broken, starts), direction)
    expected = central_difference(lambda f: drift(f, starts), broken, direction, step=1e-5)
    assert abs(expected) > 1e-4
    assert abs(found - expected) < 1e-6 * abs(expected)


@pytest.mark.slow
def test_gradient_of_the_symmetry_error_equals_differences(broken):
    error = jax.jit(jax.value_and_grad(boozer.symmetry_error))
    gradient, direction = error(broken)[1], directions(broken)["coefficients"]
    expected = central_difference(lambda field: error(field)[0], broken, direction)
    assert abs(along(gradient, direction) - expected) < 1e-8 * abs(expected)
    # It depends on the spectrum alone.
    assert not any(jnp.any(x) for x in (gradient.iota, gradient.psi_edge, gradient.G))


@pytest.mark.slow
@pytest.mark.parametrize("helicity", [0, 1])
def test_the_symmetry_error_is_the_measure_of_two_terms(helicity):
    field = field_of(MODES, I=[0.0, 3.0])
    s, n = 0.6, 64
    angles = 2 * jnp.pi * jnp.arange(n) / n
    theta, zeta = (x.ravel() for x in jnp.meshgrid(angles, angles / 2))
    iota, G, I = 0.42 - 0.05 * s, 62.0, 3.0 * s  # noqa: E741
    B = field.strength(s, theta, zeta)
    of = jax.vmap(jax.grad(lambda *x: field.strength(s, *x), argnums=(0, 1)))
    B_theta, B_zeta = of(theta, zeta)
    per_volume = B**2 / (G + iota * I)  # ∇ψ·∇θ×∇ζ
    across = per_volume * (I * B_zeta - G * B_theta)  # B×∇B·∇ψ
    along_B = per_volume * (B_zeta + iota * B_theta)  # B·∇B
    N = 2 * helicity
    terms = ((N - iota) * across - (G + N * I) * along_B) / B**3
    expected = jnp.sum(terms**2 / B**2) / jnp.sum(1 / B**2)
    found = boozer.symmetry_error(field, [s], helicity, (n, n))
    assert abs(found / expected - 1) < 1e-12


@pytest.mark.slow
def test_a_symmetric_field_has_no_drift_and_no_symmetry_error(broken, starts):
    symmetric, _ = broken.split()
    assert boozer.symmetry_error(symmetric) < 1e-28
    assert boozer.symmetry_error(broken) > 1e-4
    assert boozer.symmetry_error(symmetric, helicity=1) > 1e-3  # of the wrong symmetry
    # The bounce oscillations are averaged out as the run becomes long against a bounce.

    def drifts(field):
        particles = boozer.GuidingCentres(field, energy=ENERGY)
        one = lambda x: boozer.radial_drift(particles, x, num_steps=4 * STEPS, h=8.0)[0]  # noqa: E731
        return jnp.abs(jax.jit(jax.vmap(one))(starts))

    assert jnp.max(drifts(symmetric)) < 1e-4
    assert jnp.median(drifts(broken)) > 1e-2


@pytest.mark.slow
def test_isotropic_particles_change_p_zeta_by_the_symmetry_error(broken):
    """Mean of (dp_ζ/dt)² = (∂H/∂ζ)² is (7/15) f."""
    particles = boozer.GuidingCentres(broken)
    s, n = 0.4, 24
    angles = 2 * np.pi * np.arange(n) / n
    pitch, weights = np.polynomial.legendre.leggauss(6)
    grid = np.meshgrid([s], angles, angles / 2, pitch, indexing="ij")

    @jax.vmap
    def squared(*x):
        q, p, args = particles.state(*x)
        H = functools.partial(particles.system.hamiltonian, 0.0, 0.0, epsilon=0.0, args=args)
        return jax.grad(H)(q, p)[1] ** 2

    points = [jnp.asarray(x.ravel()) for x in grid]
    volume = 1 / broken.strength(*points[:3]) ** 2
    weight = volume * jnp.asarray(np.broadcast_to(weights, grid[0].shape).ravel())
    mean = jnp.sum(weight * squared(*points)) / jnp.sum(weight)
    expected = 7 / 15 * boozer.symmetry_error(broken, [s], points=(n, n))
    assert abs(mean / expected - 1) < 1e-6


@pytest.mark.slow
def test_a_descent_lowers_the_drift_and_losses_have_times(broken, starts):
    """Only the breaking modes change."""
    _, breaking = broken.split()
    field, first = broken, drift(broken, starts)
    for _ in range(5):
        slope = jnp.where(breaking != 0, gradient_of_drift(field, starts).coefficients, 0)
        step = -0.01 * slope / jnp.linalg.norm(slope)
        field = eqx.tree_at(lambda f: f.coefficients, field, field.coefficients + step)
    assert drift(field, starts) < 0.8 * first
    inside, at_edge = [0.1, 0.3, 0.0, 0.9], [0.99, 1.5, 0.3, 0.1]
    time = functools.partial(boozer.lost_at, boozer.GuidingCentres(broken), num_steps=200)
    times = jax.jit(jax.vmap(time))(jnp.asarray([inside, at_edge]))
    assert times[0] == np.inf
    assert 0 < times[1] < 1e-4


@pytest.mark.slow
def test_a_step_that_is_too_large_for_the_field_gives_no_time_of_a_loss():
    """As `radial_drift`: the energy changes by far more than by the step of the field."""
    m, n, B = [0, 1, 3], [0, 0, 12], [[5.7], [-0.6], [0.3]]
    ripple = boozer.from_modes(m, n, B, psi_edge=8.0, iota=0.4, G=57.0, periods=12)
    particles = boozer.GuidingCentres(ripple)
    start = jnp.asarray([0.5, 0.3, 0.1, 0.6])
    for h, is_accurate in ((particles.h, True), (6.0, False)):
        drift, success = boozer.radial_drift(particles, start, num_steps=100, h=h)
        time = boozer.lost_at(particles, start, num_steps=100, h=h)
        assert (bool(success), not np.isnan(time)) == (is_accurate, is_accurate), (h, drift)


def test_wrong_inputs_are_refused(broken, starts):
    with pytest.raises(TypeError, match="field must be a Field"):
        boozer.symmetry_error(broken.coefficients)
    with pytest.raises(ValueError, match="width"):
        boozer.mean_drift(boozer.GuidingCentres(broken), starts, width=0.0)
    with pytest.raises(TypeError, match="GuidingCentres"):
        boozer.radial_drift(broken, starts[0])


@pytest.mark.slow
def test_the_example_runs(tmp_path, capsys):
    path = Path(__file__).parents[1] / "examples" / "alpha_optimise.py"
    spec = importlib.util.spec_from_file_location("alpha_optimise", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.main(["--quick", str(tmp_path)])
    assert "with its gradient" in capsys.readouterr().out
    assert (tmp_path / "alpha_optimise.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_step_that_is_too_large_for_the_field_is_no_success():
    """The default step is that of smooth fields; W7-X with its coil ripple requires a smaller one:
    the energy error of a run with the default would be 0.1 and more."""
    alphas = boozer.GuidingCentres(boozer.w7x(), energy=3.5e4)
    lows, highs = [0.2, 0, 0, -1], [0.8, 6, 6, 1]
    starts = jnp.asarray(np.random.default_rng(0).uniform(lows, highs, (16, 4)))
    run = jax.jit(
        jax.vmap(lambda x, h: boozer.radial_drift(alphas, x, num_steps=300, h=h), in_axes=(0, None))
    )
    drift, is_success = run(starts, 4.0)
    assert 0 < is_success.sum() < 12
    assert (drift[~is_success] == 0).all()
    assert run(starts, alphas.h)[1].all()
