"""Discovery of adiabatic invariants on the map, and the measured order of their drift."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import systems

H_D = systems.oscillator().system.H_D
SPRING = dvi.System(H_D, force=lambda t0, t1, q, p, args: -q)
CUBIC = dvi.System(H_D, force=lambda t0, t1, q, p, args: -(q**3))
VAN_DER_POL = dvi.System(H_D, force=lambda t0, t1, q, p, args: (1 - q**2) * p)


def box(n, count, seed=0, low=-1.0, high=1.0):
    rng = np.random.default_rng(seed)
    return rng.uniform(low, high, (count, n)), rng.uniform(low, high, (count, n))


@functools.cache
def found(name, degree, order):
    system = {"spring": SPRING, "cubic": CUBIC, "van_der_pol": VAN_DER_POL}[name]
    return dvi.discover_invariants(
        system, dvi.Polynomials(degree), order, h=0.1, samples=box(1, 300)
    )


def test_undisturbed_map_keeps_its_quadratic_form():
    d = found("cubic", 8, 0)
    assert d.survivors == (4,)  # the form and its powers up to degree 8
    assert d.count == 1  # which are functions of it
    assert str(d.invariants[0]) == "0.5 q² − 0.05 q p + 0.5 p²"
    assert np.max(d.residuals) < 1e-12
    assert d.gap > 1e8


@pytest.mark.parametrize("order", [1, 2])
def test_cubic_disturbance_has_invariants_of_every_order(order):
    d = found("cubic", 8, order)
    assert d.survivors == (4, 3, 2)[: order + 1]
    assert d.count == 1
    assert np.max(d.residuals) < 1e-12
    # Leading part as before, and the potential q⁴/4 of the disturbance up to O(h).
    names = list(d.basis.names)
    assert d.coefficients[0, 0, names.index("p²")] == pytest.approx(0.5, abs=1e-10)
    assert d.coefficients[0, 1, names.index("q⁴")] == pytest.approx(0.25, abs=0.005)


@pytest.mark.parametrize(("order", "largest"), [(0, 0.03), (1, 0.1), (2, 0.5)])
def test_drift_has_the_order_promised(order, largest):
    series = found("cubic", 8, order).invariants[0]
    measured = dvi.drift_order(
        CUBIC,
        series,
        [0.4],
        [0.3],
        epsilons=np.geomspace(largest / 10, largest, 6),
        h=0.1,
        num_steps=5000,
    )
    assert measured.used.sum() >= 3
    assert abs(measured.slope - (order + 1)) < 0.1 + 2 * measured.stderr
    assert measured.successful.all()


def test_exact_invariant_of_the_disturbed_spring():
    """(p² + (1+ε)q² − h(1+ε)qp)/2, ε included and at every order after the first nothing."""
    d = found("spring", 4, 2)
    assert str(d.invariants[0]) == "0.5 q² − 0.05 q p + 0.5 p² + ε (0.5 q² − 0.05 q p)"
    measured = dvi.drift_order(
        SPRING, d.invariants[0], [0.4], [0.3], epsilons=[0.01, 0.1, 0.3], h=0.1, num_steps=2000
    )
    assert not measured.used.any()  # all on the round-off floor
    assert np.isnan(measured.slope)
    assert np.max(measured.drifts) < 1e-14


def test_van_der_pol_loses_the_amplitude_and_says_how():
    """Averaged: D(A) = εh(A − A²/2)-like in A = |z|²/2, so the limit cycle has amplitude 2."""
    d = found("van_der_pol", 6, 1)
    assert d.survivors == (3, 0)
    assert d.count == 0
    law = d.obstructions[0]
    assert law.order == 1
    assert law.leading == "0.5 q² − 0.05 q p + 0.5 p²"
    assert law.residual < 1e-10
    names = list(d.basis.names)
    at = lambda name: law.coefficients[names.index(name)]  # noqa: E731
    # on a circle of radius r: r²·0.05 − r⁴·0.0125 = 0 at r = 2, up to O(h²)
    radius = np.sqrt(-at("p²") / at("p⁴"))
    assert radius == pytest.approx(2.0, abs=0.01)
    assert "lost at order 1" in str(d)


def test_kepler_angular_momentum_is_exact_and_found_alone():
    k = systems.kepler()
    rng = np.random.default_rng(1)
    angle, r = rng.uniform(0, 2 * np.pi, 400), rng.uniform(0.8, 2.0, 400)
    q = np.stack([r * np.cos(angle), r * np.sin(angle)], 1)
    samples = (q, rng.uniform(-1, 1, (400, 2)))
    radius = dvi.Basis({"1/r": lambda q, p: 1 / jnp.sqrt(q @ q)})
    d = dvi.discover_invariants(
        k.system, dvi.Polynomials(2) + radius, 1, h=0.1, samples=samples, args=k.args
    )
    assert d.count == 1
    assert str(d.invariants[0]) in ("0.5 q1 p2 − 0.5 q2 p1", "−0.5 q1 p2 + 0.5 q2 p1")
    value = d.evaluate(np.array([0.0, 1.2]), np.array([-1.0, -0.6]), 0.3)
    np.testing.assert_allclose(np.abs(value), [0.6], rtol=1e-9)


def test_discovery_goes_through_an_implicit_composed_map():
    """Strang on H = (q² + 1)(p² + 1)/2 at small h: nothing exact in quadratics, and it says so."""
    system = dvi.System(lambda t0, t1, q, p, args: jnp.sum((q**2 + 1) * (p**2 + 1)) / 2)
    d = dvi.discover_invariants(
        system, dvi.Polynomials(2), h=0.1, samples=box(1, 60), method=dvi.Strang()
    )
    assert d.count == 0
    assert d.singular_values[-1] > 1e-4


def test_series_differentiates_batches_and_refuses_to_guess():
    series = found("cubic", 8, 1).invariants[0]
    q, p = jnp.array([0.4]), jnp.array([0.3])
    slope = jax.grad(series.evaluate, argnums=2)(q, p, 0.1)
    np.testing.assert_allclose(slope, series.coefficients[1] @ series.basis(q, p), rtol=1e-12)
    with pytest.raises(ValueError, match="know ε"):
        series(0.0, 0.1, q, p, q, p, None)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"samples": box(1, 12)}, "too few"),
        ({"samples": (np.ones((50, 1)), np.ones((50, 2)))}, "one shape"),
        ({"samples": (np.full((50, 1), np.nan), np.ones((50, 1)))}, "not finite"),
        ({"samples": 100}, "pair"),
        ({"order": -1}, "at least 0"),
        ({"basis": dvi.Polynomials(2) + dvi.Polynomials(1)}, "rank-deficient"),
        ({"basis": dvi.Basis([lambda q, p: 1 / (0 * q[0])])}, "'f1' is not finite"),
        ({"samples": (np.zeros((50, 1)), np.zeros((50, 1)))}, "rank-deficient"),
    ],
)
def test_bad_input_is_named(change, match):
    given = {"basis": dvi.Polynomials(3), "order": 0, "samples": box(1, 60), **change}
    with pytest.raises(ValueError, match=match):
        dvi.discover_invariants(
            SPRING, given["basis"], given["order"], h=0.1, samples=given["samples"]
        )


def test_a_step_that_fails_on_a_sample_is_reported():
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 - jnp.sum(jnp.sqrt(q)))
    with pytest.raises(ValueError, match="step fails at"):
        dvi.discover_invariants(system, dvi.Polynomials(2), h=0.1, samples=box(1, 60))


def test_drift_order_refuses_what_has_no_logarithm():
    with pytest.raises(ValueError, match="positive"):
        dvi.drift_order(SPRING, H_D, [0.1], [0.1], epsilons=[0.0, 0.1], h=0.1, num_steps=2)


@pytest.mark.slow
def test_henon_heiles_keeps_two_of_four_quadratics():
    """The isotropic oscillator has four quadratic invariants; at order 2 energy and L are left."""
    system = dvi.System(
        H_D, perturbation=lambda t0, t1, q, p, args: q[0] ** 2 * q[1] - q[1] ** 3 / 3
    )
    d = dvi.discover_invariants(
        system, dvi.Polynomials(4), 2, h=0.1, samples=box(2, 400, low=-1, high=1)
    )
    quadratic = np.array(d.basis.complexity) == 2
    above = np.array(d.basis.complexity) > 2

    def quadratics(leading):
        return len(leading) - np.linalg.matrix_rank(leading[:, above], tol=1e-8)

    assert d.survivors == (13, 4, 2)
    assert quadratics(d.leading_parts) == 2
    assert d.gap > 1e10
    assert d.count == 2
    assert np.max(d.residuals) < 1e-12
    momentum, energy = np.asarray(d.coefficients)[:, 0, quadratic]
    names = np.array(d.basis.names)[quadratic]
    L = {n: c for n, c in zip(names, momentum, strict=True) if abs(c) > 1e-10}
    E = {n: c for n, c in zip(names, energy, strict=True) if abs(c) > 1e-10}
    assert set(L) == {"q1 p2", "q2 p1"}
    assert L["q1 p2"] == pytest.approx(-L["q2 p1"], abs=1e-10)
    assert set(E) == {"q1²", "q1 p1", "q2²", "q2 p2", "p1²", "p2²"}
    assert E["q1 p1"] == pytest.approx(-0.05, abs=1e-10)


def test_what_is_no_basis_no_step_or_no_observable_is_refused():
    samples = box(1, 60)
    for nothing in (dvi.Polynomials, [lambda q, p: q[0]]):
        with pytest.raises(TypeError, match="must be a basis"):
            dvi.discover_invariants(SPRING, nothing, h=0.1, samples=samples)
    with pytest.raises(ValueError, match="other than zero"):
        dvi.discover_invariants(SPRING, dvi.Polynomials(2), h=0.0, samples=samples)
    with pytest.raises(TypeError, match="take one of its"):
        dvi.drift_order(
            SPRING, found("cubic", 8, 0), [0.1], [0.1], epsilons=[0.1], h=0.1, num_steps=2
        )
    for bad in ([], dvi.Generator()):
        with pytest.raises(ValueError, match="one Generator for each order"):
            dvi.solve_gauge(SPRING, bad, dvi.Polynomials(2), h=0.1, samples=samples)
