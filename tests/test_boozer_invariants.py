"""J∥ and bounce points, classes of orbits, and the momentum of a broken quasi-symmetry."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

import dvi_jax as dvi
from dvi_jax.systems import boozer

MODES = {(0, 0): (5.0, 0.1), (1, 0): (-0.6, 0.05), (2, 4): (0.1, 0.0)}
IOTA, G, CURRENT = (0.45, 0.1), 50.0, (0.0, -1.5)
POINT = (0.4, 0.3, 0.2, 0.5 / 5.05, 0.5)  # s, θ, ζ, μ, E
METHOD = dvi.GaussLegendre(2)


@functools.cache
def field(with_current=True):
    m, n = zip(*MODES, strict=True)
    return boozer.from_modes(
        m, n, list(MODES.values()), psi_edge=8.0, iota=IOTA, G=G, periods=4,
        I=CURRENT if with_current else None,
    )  # fmt: skip


def strength(s, alpha, zeta):
    theta = alpha + (IOTA[0] + IOTA[1] * s) * zeta
    return sum(
        s ** (m / 2) * (a + b * s) * np.cos(m * theta - n * zeta)
        for (m, n), (a, b) in MODES.items()
    )


def by_quad(s, theta, zeta, mu, energy):
    """J∥ by scipy, from modes and profiles written again."""
    iota = IOTA[0] + IOTA[1] * s
    alpha = theta - iota * zeta

    def kinetic(x):
        return energy - mu * strength(s, alpha, x)

    def end(direction):
        x = zeta
        while kinetic(x) > 0:
            x += direction * 0.01
        return brentq(kinetic, x, x - direction * 0.01, xtol=1e-15, rtol=1e-15)

    low, high = end(-1), end(1)
    middle, half = (low + high) / 2, (high - low) / 2

    def integrand(phi):
        x = middle + half * np.sin(phi)
        length = (G + iota * (CURRENT[1] * s)) / strength(s, alpha, x)
        return np.sqrt(max(2 * kinetic(x), 0)) * length * half * np.cos(phi)

    return 2 * quad(integrand, -np.pi / 2, np.pi / 2, epsabs=1e-13, epsrel=1e-13, limit=300)[0]


@functools.cache
def compiled():
    return jax.jit(jax.value_and_grad(boozer.second_invariant, argnums=(0, 1, 2, 3, 4, 5)))


@pytest.mark.slow
@pytest.mark.parametrize("B_bounce", [4.9, 5.05, 5.2])
def test_second_invariant_is_the_integral_of_scipy(B_bounce):
    s, theta, zeta, _, E = POINT
    at = (s, theta, zeta, E / B_bounce, E)
    assert float(compiled()(field(), *at)[0]) == pytest.approx(by_quad(*at), rel=1e-12)
    # A wrong moment by 1 %, as a control.
    wrong = by_quad(*at[:3], 1.01 * at[3], E)
    assert abs(wrong / by_quad(*at) - 1) > 0.02


def by_many_points(field, s, low, high, alpha, mu):
    """J∥ and the number of minima, by the midpoint rule with 20 000 points."""
    polynomial = np.polynomial.polynomial.polyval
    m, n = np.array(field.modes).T
    c = np.asarray(field.coefficients)[0].reshape(len(m), -1)
    I = np.zeros(1) if field.I is None else field.I  # noqa: E741
    iota, G, I = (polynomial(s, np.asarray(x)) for x in (field.iota, field.G, I))  # noqa: E741
    size = polynomial(s, c.T) * s ** (m / 2)

    def strength(zeta):
        return np.cos(np.outer(alpha + iota * zeta, m) - np.outer(zeta, n)) @ size

    phi = np.pi * ((np.arange(20_000) + 0.5) / 20_000 - 0.5)
    half = (high - low) / 2
    B = strength((low + high) / 2 + half * np.sin(phi))
    J = np.sum(np.sqrt(np.maximum(1 - 2 * mu * B, 0)) / B * np.cos(phi)) * abs(G + iota * I)
    change = np.diff(strength(np.linspace(low, high, 4001)))
    return 2 * half * J * np.pi / 20_000, int(np.sum((change[:-1] < 0) & (change[1:] > 0)))


@functools.cache
def wells():
    return jax.jit(lambda *a: (boozer.second_invariant(*a), boozer.well(*a)))


def ripple(n, size):
    """A banana in whose well there are about n/2 minima."""
    return boozer.from_modes(
        [0, 1, 0], [0, 0, n], [[5.0], [-0.6], [size]], psi_edge=8.0, iota=0.45, G=50.0
    )


MANY_MINIMA = [
    ((ripple, 20, 0.02), (0.4, 0.3, 0.2, 0.3)),
    pytest.param((ripple, 60, 0.003), (0.4, 0.3, 0.2, 0.3), marks=pytest.mark.slow),
    ((boozer.w7x,), (0.6487, 4.4, 2.2, 0.12)),
    ((boozer.w7x,), (0.3, 1.0, 0.3, -0.2)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("make", "point"), MANY_MINIMA)
def test_second_invariant_of_wells_with_many_minima(make, point):
    field, (s, theta, zeta, pitch) = make[0](*make[1:]), point
    mu = (1 - pitch**2) / (2 * float(field.strength(s, theta, zeta)))
    J, (low, high) = wells()(field, s, theta, zeta, mu)
    iota = np.polynomial.polynomial.polyval(s, np.asarray(field.iota))
    reference, minima = by_many_points(field, s, float(low), float(high), theta - iota * zeta, mu)
    assert float(J) == pytest.approx(reference, rel=1e-9)
    assert minima >= 4


@pytest.mark.slow
def test_gradient_of_the_second_invariant():
    """In the point, μ, E and the modes, against differences of fourth order of the integral of
    scipy, and for the modes of second order."""
    _, (of_field, *slopes) = compiled()(field(), *POINT)
    for i, slope in enumerate(slopes):
        d = 1e-3 if i < 3 else 1e-4 * POINT[i]

        def moved(k, i=i, d=d):
            return by_quad(*(x + k * d * (j == i) for j, x in enumerate(POINT)))

        difference = (8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * d)
        assert float(slope) == pytest.approx(difference, rel=1e-6)
    place = (0, 2, 2, 0)

    def with_mode(change):
        c = field().coefficients.at[place].add(change)
        other = eqx.tree_at(lambda f: f.coefficients, field(), c)
        return compiled()(other, *POINT)[0]

    difference = (with_mode(1e-5) - with_mode(-1e-5)) / 2e-5
    assert float(of_field.coefficients[place]) == pytest.approx(float(difference), rel=1e-7)


@pytest.mark.slow
def test_second_invariant_of_a_passing_particle_and_extremes_ignore_nan():
    assert np.isnan(compiled()(field(), 0.4, 0.3, 0.2, 0.3 / 5, 0.5)[0])
    well = jax.jit(boozer.well)
    assert np.isnan(well(field(), 0.4, 0.3, 0.2, 0.3 / 5, 0.5).low)
    low, high = well(field(), *POINT)
    alpha = POINT[1] - (IOTA[0] + IOTA[1] * POINT[0]) * POINT[2]
    for end in (low, high):
        assert strength(POINT[0], alpha, float(end)) == pytest.approx(5.05, rel=1e-13)
    assert low < POINT[2] < high
    reduction = boozer.Extremes(lambda q, p: q)
    memory = reduction.start(jnp.zeros(()))
    for k, value in enumerate([np.nan, 2.0, -1.0, np.nan]):
        memory = reduction.update(memory, jnp.asarray(k), 0.0, jnp.asarray(value))
    assert reduction.finish(memory).tolist() == [-1.0, 2.0]


@functools.cache
def centres():
    symmetric, breaking = field(False).split(0)
    return boozer.GuidingCentres(symmetric, 1e6, breaking=breaking)


def seen(h, epsilon):
    """Of a trapped, a transitional and a passing orbit: J∥ at their bounces, and margins."""
    return _seen(centres(), jnp.asarray(h), jnp.asarray(epsilon))


@eqx.filter_jit
def _seen(alphas, h, epsilon):
    alphas = alphas.at_epsilon(epsilon)
    q, p, args = alphas.state(*map(jnp.asarray, ([0.4] * 3, [0.0] * 3, [0.1] * 3, PITCH)))

    def one(q, p, mu):
        args = alphas.args(mu)
        found = dvi.integrate(
            alphas.system, q, p, args=args, h=h, num_steps=500, method=METHOD,
            observe=(alphas.bounces(20), boozer.Extremes(alphas.trapping)),
            save=dvi.Save(final=True), stop=alphas.loss,
        ).observed  # fmt: skip
        return alphas.second_invariant_at(found[0], args), found[1]

    return jax.vmap(one)(q, p, args["mu"])


PITCH = [0.2, 0.365, 0.8]


@functools.cache
def spreads(h, epsilon):
    trapped = np.asarray(seen(h, epsilon)[0])[0]
    assert np.isfinite(trapped).sum() >= 6
    return np.nanmax(trapped) / np.nanmin(trapped) - 1


@pytest.mark.slow
def test_classes_of_orbits_and_the_invariant_at_the_tips_of_bananas():
    """At a tip u = 0 and p_ζ = −χ(s)/ρ: all tips of an axisymmetric field are on one surface. The
    method leaves O(h⁴). Where the symmetry is broken J∥ varies."""
    coarse, fine = spreads(12.0, 0.0), spreads(6.0, 0.0)
    assert fine < 1e-6
    assert np.log2(coarse / fine) > 3.65
    assert spreads(6.0, 1.0) > 1e3 * fine
    J, margins = seen(6.0, 0.0)
    assert boozer.classify(margins).tolist() == ["trapped", "transitional", "passing"]
    assert np.isnan(J[2]).all()  # it does not bounce; the trapped one does: see `spreads`
    found = boozer.classify([[-1.0, 1.0], [np.nan, np.nan], [0.1, 0.2]])
    assert found.tolist() == ["transitional", "unknown", "passing"]
    with pytest.raises(ValueError, match="extremes must be"):
        boozer.classify(np.zeros(3))
    with pytest.raises(ValueError, match="at_epsilon"):
        _ = centres().trapping


def passing(alphas, count, width, seed):
    rng = np.random.default_rng(seed)
    s = 0.5 + rng.uniform(-width, width, count) * alphas.rho / alphas.field.psi_edge
    pitch = 0.8 + 0.03 * rng.uniform(-width, width, count)
    angles = rng.uniform(0, 2 * np.pi, (2, count))
    return alphas.state(*map(jnp.asarray, (s, *angles, pitch)))[:2]


def momentum_of_order(order, degree, poloidal, count, strengths):
    """The drift orders of the series cut at each order, and of one with half of a correction."""
    whole = boozer.from_modes(
        [0, 1, 1], [0, 0, 4], [[5.0], [-0.3], [0.2]], psi_edge=8.0, iota=[0.42, 0.02], G=50.0,
        periods=4,
    )  # fmt: skip
    symmetric, breaking = whole.split(0)
    alphas = boozer.GuidingCentres(symmetric, 1e5, breaking=breaking, coordinates="angles")
    args = alphas.args((1 - 0.8**2) / 10)
    found = dvi.discover_invariants(
        alphas.system, boozer.momentum_basis(symmetric, degree, poloidal, order), order, h=2.0,
        samples=passing(alphas, count, 1.2, 0), args=args, method=METHOD, tolerance=1e-5,
    )  # fmt: skip
    assert found.survivors == (1,) * (order + 1)
    series = found.invariants[0]
    c = series.coefficients / series.coefficients[0, 0]
    q, p = passing(alphas, 6, 0.2, 1)
    leading = jax.vmap(lambda q, p: c[0] @ series.basis(q, p))(q, p)
    assert np.ptp(leading - p[:, 1]) < 1e-4 * np.ptp(p[:, 1])  # it is p_ζ

    def slope(coefficients):
        cut = eqx.tree_at(lambda x: x.coefficients, series, coefficients)
        how = {"epsilons": strengths, "h": 2.0, "num_steps": 400, "args": args, "method": METHOD}
        return float(dvi.drift_order(alphas.system, cut, q, p, batched=True, **how).slope)

    slopes = [slope(c.at[z + 1 :].set(0)) for z in range(order + 1)]
    largest = jnp.argmax(jnp.abs(c[1, 1:])) + 1
    return slopes, slope(c.at[1, largest].multiply(0.5))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "poloidal", "count", "strengths", "error"),
    [(1, 3, 260, np.geomspace(0.3, 2, 4), 0.1), (2, 4, 600, np.geomspace(0.5, 3, 4), 0.2)],
)
def test_momentum_of_an_order(order, poloidal, count, strengths, error):
    slopes, wrong = momentum_of_order(order, 3, poloidal, count, strengths)
    assert slopes == pytest.approx(np.arange(1, order + 2), abs=error)
    assert wrong == pytest.approx(1, abs=0.3)


@pytest.mark.slow
def test_momentum_of_a_helical_symmetry():
    """With n = N h m in all modes p_ζ + N h p_θ is conserved, and p_ζ − N h p_θ is not."""
    helical = boozer.from_modes(
        [0, 1], [0, 4], [[5.0], [-0.3]], psi_edge=8.0, iota=0.9, G=50.0, periods=4, helicity=1
    )
    alphas = boozer.GuidingCentres(helical, 1e5, coordinates="angles")
    q, p, args = alphas.start(0.4, 0.3, 0.2, 0.5)

    def along(sign):
        return dvi.MaxDrift(lambda q, p: p[1] + sign * 4 * p[0])

    drifts = dvi.integrate(
        alphas.system, q, p, args=args, h=2.0, num_steps=300, method=METHOD,
        observe=[along(1), along(-1)], save=dvi.Save(final=True),
    ).observed  # fmt: skip
    assert drifts[0] < 1e-10 < 1e-2 < drifts[1]
    momentum = boozer.momentum_basis(helical).for_shape((2,))
    assert momentum.names[:2] == ("p2 + 4 p1", "cos(q1 − 4q2)")
    assert float(momentum(q, p)[0]) == pytest.approx(float(p[1] + 4 * p[0]))
