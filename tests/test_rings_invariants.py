"""Invariants of rings: Courant & Snyder, McMillan, Danilov & Nagaitsev, and proved bounds."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import dvi_jax as dvi
from dvi_jax.systems import rings

AMPLITUDE = 0.01


def thin(name, k):
    return rings.multipole(name, 0.0, (0.0, k))


def cell(first, k=0.3):
    """A FODO cell of thin quadrupoles, symmetric, so that α = 0 at `first`."""
    half, space = thin("QF", k / 2), rings.drift("D", 2.0)
    return rings.Ring([first, half, space, thin("QD", -k), space, half])


def linear(k=0.3):
    """Phase advance and β of the cell in x."""
    o = rings.optics(cell(rings.marker("M"), k), chromatic=False)
    return 2 * np.pi * float(o.tune[0]), float(o.beta[0, 0])


def samples(beta, count=300, amplitude=AMPLITUDE):
    unit = np.random.default_rng(0).uniform(-1, 1, (2, count, 1))
    return unit * np.array([amplitude, amplitude / beta])[:, None, None]


def with_sextupole(k=0.3, b2=1.0):
    ring = cell(rings.multipole("S", 0.0, (0.0, 0.0, b2)), k).perturbed("S", "b2")
    return rings.problem(ring, planes="x")


def invariants(problem, beta, degree, order=0):
    return dvi.discover_invariants(
        problem.system, dvi.Polynomials(degree), order, h=1.0, samples=samples(beta),
        args=problem.args,
    ).invariants  # fmt: skip


@functools.cache
def series(order):
    return invariants(with_sextupole(), linear()[1], order + 2, order)[0]


def slope(order, epsilons, turns=5000):
    """The order of the drift in ε; it is resolved."""
    problem = with_sextupole()
    drift = dvi.drift_order(
        problem.system, series(order), [0.003], [0.0], epsilons=epsilons, h=1.0, num_steps=turns,
        args=problem.args,
    )  # fmt: skip
    assert drift.resolved, drift
    return drift.slope


@pytest.mark.slow
def test_invariant_of_the_linear_map_is_that_of_courant_and_snyder():
    """With α not zero: the cell begins in the middle of a drift."""
    space = rings.drift("D", 1.0)
    ring = rings.Ring([space, thin("QF", 0.3), space, space, thin("QD", -0.3), space])
    o, problem = rings.optics(ring, chromatic=False), rings.problem(ring, planes="x")
    beta, alpha = float(o.beta[0, 0]), float(o.alpha[0, 0])
    assert abs(alpha) > 0.5
    found = invariants(problem, beta, 2)[0]
    c = dict(zip(found.basis.names, np.asarray(found.coefficients[0]), strict=True))
    gamma = (1 + alpha**2) / beta
    ratios = np.array([c["q p"], c["p²"]]) / c["q²"]
    np.testing.assert_allclose(ratios, np.array([2 * alpha, beta]) / gamma, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_the_drift_of_an_invariant_is_of_the_next_order(order):
    if order < 2:
        assert abs(slope(order, np.geomspace(0.05, 1, 6)) - order - 1) < 0.1
    else:
        assert abs(slope(order, np.geomspace(0.2, 3, 7), turns=20_000) - order - 1) < 0.15


def strength_for(tune):
    """k of the quadrupoles of the cell with a phase advance: sin(μ/2) = k L/2, L = 2 m."""
    return np.sin(np.pi * tune) * 2 / 2.0


@pytest.mark.slow
def test_the_correction_grows_without_bound_at_the_third_order_resonance():
    """|ε I_1| over I_0 is proportional to 1/(distance of the tune from 1/3)."""
    sizes = []
    for distance in (0.02, 0.01, 0.005):
        k = strength_for(1 / 3 - distance)
        mu, beta = linear(k)
        np.testing.assert_allclose(mu / 2 / np.pi, 1 / 3 - distance, rtol=1e-10)
        found = invariants(with_sextupole(k), beta, 3, 1)[0]
        values = jax.vmap(found.basis)(*samples(beta, 50)) @ found.coefficients.T
        sizes.append(float(jnp.linalg.norm(values[:, 1]) / jnp.linalg.norm(values[:, 0])))
    ratios = np.array(sizes[1:]) / sizes[:-1]
    assert ((ratios > 1.7) & (ratios < 2.1)).all(), sizes
    # On the resonance there is no invariant of order 1 that begins with that of the linear map.
    k = strength_for(1 / 3)
    for s in invariants(with_sextupole(k), linear(k)[1], 3, 1):
        c = dict(zip(s.basis.names, np.asarray(s.coefficients[0]), strict=True))
        assert abs(c["q³"]) * AMPLITUDE > 1e-3 * abs(c["q²"]), s


@pytest.mark.slow
@pytest.mark.parametrize(("order", "least"), [(1, 500), (3, 1e8)])
def test_a_proved_bound_of_the_drift_of_a_cell_with_one_sextupole(order, least):
    """Turns for which |x| ≤ 3 mm, in which the invariant changes by 1 % of its largest value."""
    pytest.importorskip("flint")
    problem, beta, r = with_sextupole(), linear()[1], 0.003
    bound = dvi.bound_drift(
        series(order), problem.system, h=1.0, epsilon=0.1, args=problem.args,
        method=rings.Turn(losses=False), domain=(np.array([r]), np.array([r / beta])),
        change=0.01 * r**2 / 2, ratio=4.0, max_boxes=64, max_seconds=20.0,
    )  # fmt: skip
    assert bound.seen[0] <= bound.per_step[0] < 4 * bound.seen[0]
    assert bound.steps > least


@pytest.mark.slow
def test_a_bound_requires_a_domain_without_losses():
    """Where no state is lost the map with losses has the bound of that without; else an error."""
    pytest.importorskip("flint")
    problem, beta = with_sextupole(), linear()[1]

    def bound(r, losses):
        return dvi.bound_drift(
            series(1), problem.system, h=1.0, epsilon=0.1, args=problem.args,
            domain=(np.array([r]), np.array([r / beta])), method=rings.Turn(losses=losses),
            ratio=8.0, max_boxes=64,
        )  # fmt: skip

    assert bound(0.003, True).per_step == bound(0.003, False).per_step
    with pytest.raises(ValueError, match="does not allow: cond"):
        bound(1.5, True)


def mcmillan(x, y, par):
    """Potential of the kick (F(x) − 2 cos μ x)/(β sin μ), F(x) = 2 g x/(1 + x²/a²)."""
    whole = par["g"] * par["a"] ** 2 * jnp.log1p((x / par["a"]) ** 2) - jnp.cos(par["mu"]) * x * x
    return -whole / (par["beta"] * jnp.sin(par["mu"]))


def mcmillan_ring(g=0.3, a=0.01, wrong=0.0):
    mu, beta = linear()
    values = {"g": g, "a": a, "mu": mu + wrong, "beta": beta}
    return cell(rings.lens("M", mcmillan, **values))


def mcmillan_invariant(z, g=0.3, a=0.01):
    """x² X² /a² + x² + X² − 2 g x X, X the position at the lens one turn before."""
    mu, beta = linear()
    x, X = z[..., 0], np.cos(mu) * z[..., 0] - beta * np.sin(mu) * z[..., 1]
    return (x * X / a) ** 2 + x**2 + X**2 - 2 * g * x * X


def test_mcmillan_ring_conserves_its_invariant_to_round_off():
    z = jnp.zeros((5, 6)).at[:, 0].set(np.linspace(1e-3, 2e-2, 5))

    def change(wrong):
        out = rings.track(mcmillan_ring(wrong=wrong), z, 1000, every=1).z
        values = mcmillan_invariant(np.asarray(out))
        return np.ptp(values, axis=1) / values[:, 0]

    assert change(0.0).max() < 1e-12
    assert change(1e-3).min() > 1e-4  # a control: a lens for a wrong phase advance


@pytest.mark.slow
def test_mcmillan_invariant_is_found():
    problem = rings.problem(mcmillan_ring(), planes="x")
    _, beta = linear()
    (found,) = invariants(problem, beta, 4)
    q, p = samples(beta, 100)
    values = jax.vmap(lambda q, p: found.evaluate(q, p, 0.0))(q, p)
    z = np.zeros((100, 6))
    z[:, 0], z[:, 1] = q[:, 0], p[:, 0]
    ratio = np.asarray(values) / mcmillan_invariant(z)
    assert np.ptp(ratio) < 1e-9 * abs(ratio[0])
    # A control: a wrong phase advance.
    problem = rings.problem(mcmillan_ring(wrong=1e-3), planes="x")
    assert not invariants(problem, beta, 4)


LENGTH, K, STRENGTH, C = 2.0, 0.9, -0.3, 0.01
"""Length of the insert [m]; focusing of the lens after it [1/m]; t and c [m^½] of the potential."""


def elliptic(x, y):
    """−Re(z arcsin(z)/√(1 − z²)), z = x + i y, in elliptic coordinates ξ, η."""
    A = x * x + y * y - 1
    D = jnp.sqrt(A * A + 4 * y * y)  # ξ² − η²
    w = jnp.where(A < 0, 2 * y * y / (D - A), (A + D) / 2)  # ξ² − 1
    xi = jnp.sqrt(1 + w)
    eta, small = x / xi, w < 1e-3
    v = jnp.where(small, 1.0, w)
    terms = 1 + w * (-1 / 6 + w * (3 / 40 + w * (-15 / 336 + w * (105 / 3456 - w * 945 / 42240))))
    f = xi * w * jnp.where(small, terms, jnp.arcsinh(jnp.sqrt(v)) / jnp.sqrt(v))
    return (f - eta * jnp.sqrt(1 - eta * eta) * jnp.arcsin(eta)) / D


def insert_potential(x, y, par):
    r = C * jnp.sqrt(par["beta"])
    return par["t"] * par["dpsi"] * C**2 * elliptic(x / r, y / r)


def round_lens(x, y, par):
    return (par["kx"] * x * x + par["ky"] * y * y) / 2


def nagaitsev(slices, t=STRENGTH, unequal=0.0, phase=0.0):
    """An insert with the potential between lenses; errors: K_x ≠ K_y, and of the arc's phase."""
    root = np.sqrt(1 - (1 - LENGTH * K / 2) ** 2)

    def beta(s):
        return (LENGTH - s * K * (LENGTH - s)) / root

    half = rings.lens("K", round_lens, kx=K / 2 * (1 + unequal), ky=K / 2 * (1 - unequal))
    step, row = LENGTH / slices, []
    for i in range(slices):
        dpsi = quad(lambda s: 1 / beta(s), i * step, (i + 1) * step)[0]
        at = beta((i + 0.5) * step)
        lens = rings.lens("N", insert_potential, beta=at, dpsi=dpsi, t=t)
        row += [rings.drift("D", step / 2), lens, rings.drift("D", step / 2)]
    # A rotation by `phase` in the phase plane of x and y, where α = 0.
    turn = rings.lens("P", round_lens, **dict.fromkeys(("kx", "ky"), np.tan(phase / 2) / beta(0)))
    arc = [turn, rings.drift("A", beta(0) * np.sin(phase)), turn] if phase else []
    return rings.Ring([half, *row, half, *arc]), beta(0)


def two_invariants(z, beta, t=STRENGTH):
    """H, and the second invariant of Danilov & Nagaitsev 2010, in units of c."""
    x, y = (np.asarray(z[..., i]) / C / np.sqrt(beta) for i in (0, 2))
    px, py = (np.asarray(z[..., i]) / C * np.sqrt(beta) for i in (1, 3))
    a, b = np.hypot(x + 1, y), np.hypot(x - 1, y)
    xi, eta = (a + b) / 2, (a - b) / 2
    f = xi**2 * (xi**2 - 1) / 2 + t * xi * np.sqrt(xi**2 - 1) * np.arccosh(xi)
    g = eta**2 * (1 - eta**2) / 2 - t * eta * np.sqrt(1 - eta**2) * np.arcsin(eta)
    H = (px**2 + py**2) / 2 + (f + g) / (xi**2 - eta**2)
    second = (x * py - y * px) ** 2 + px**2 + 2 * (xi**2 * g + eta**2 * f) / (xi**2 - eta**2)
    return H, second


def changes(ring, beta, turns=500, delta=0.0):
    """Largest relative changes of both invariants, for amplitudes up to one half of c."""
    unit = C * np.random.default_rng(1).uniform(-0.5, 0.5, (8, 4))
    z = np.zeros((8, 6))
    z[:, :4] = unit * np.sqrt([beta, 1 / beta, beta, 1 / beta])
    z[:, 5] = delta
    out = rings.track(ring, z, turns, every=1)
    assert not out.lost.any()
    found = two_invariants(out.z, beta)
    return np.array([(np.ptp(each, axis=1) / np.abs(each[:, 0])).max() for each in found])


def test_elliptic_potential_is_that_of_multipoles():
    """z arcsin(z)/√(1 − z²) = Σ 2^{2n−1} n! (n−1)!/(2n)! z^{2n}: a field without sources."""
    b, term = np.zeros(40), 1.0
    for n in range(1, 21):
        b[2 * n - 1] = -2 * n * term
        term *= 2 * n / (2 * n + 1)
    scale = C ** (2 - np.arange(1, 41.0))
    values = {"beta": 1.0, "dpsi": 1.0, "t": 1.0}
    z = np.zeros((20, 6))
    z[:, (0, 2)] = C * np.random.default_rng(0).uniform(-0.35, 0.35, (20, 2))
    z[0, 2] = 0.0
    end = rings.drift("D", 1.0)
    by_lens = rings.Ring([rings.lens("N", insert_potential, **values), end])
    by_poles = rings.Ring([rings.multipole("N", 0.0, b * scale), end])
    found = rings.one_turn(by_lens, z), rings.one_turn(by_poles, z)
    np.testing.assert_allclose(*found, rtol=1e-9, atol=1e-14)


@pytest.mark.slow
def test_danilov_nagaitsev_optics_conserve_both_invariants_up_to_the_slices():
    errors = np.array([changes(*nagaitsev(n)) for n in (8, 16, 32)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert np.abs(orders[-1] - 2).max() < 0.1, orders
    assert errors[-1].max() < 2e-4


@pytest.mark.slow
def test_what_breaks_the_invariants_of_danilov_and_nagaitsev():
    ring, beta = nagaitsev(32)
    right = changes(ring, beta)
    unequal = [changes(nagaitsev(32, unequal=e)[0], beta) for e in (0.01, 0.02)]
    phase = [changes(nagaitsev(32, phase=2 * np.pi * e)[0], beta) for e in (0.001, 0.002)]
    chromatic = [changes(ring, beta, delta=d) for d in (0.005, 0.01)]
    for small, large in (unequal, phase, chromatic):
        assert (small > 10 * right).all()
        assert (large / small > 1.6).all()
        assert (large / small < 2.4).all()


@pytest.mark.slow
def test_lens_is_differentiable_by_its_parameters():
    ring, _ = nagaitsev(2)
    z = jnp.asarray([3e-3, 1e-3, 2e-3, -1e-3, 0.0, 0.01])

    def end(t):
        return jnp.sum(rings.track(ring.set("N", t=t), z, 20).z[:4])

    both = jax.jit(jax.value_and_grad(end))
    difference = (both(STRENGTH + 1e-5)[0] - both(STRENGTH - 1e-5)[0]) / 2e-5
    np.testing.assert_allclose(both(STRENGTH)[1], difference, rtol=1e-6)


@pytest.mark.slow
def test_optics_of_planes_with_equal_tunes():
    ring, beta = nagaitsev(4, t=0.0)
    o = rings.optics(ring, chromatic=False)
    assert o.tune[0] == o.tune[1]
    np.testing.assert_allclose(o.beta[0], beta, rtol=1e-12)

    def tunes(k):
        return rings.optics(ring.set("K", kx=k, ky=k), chromatic=False).tune

    exact = jax.jacfwd(lambda k: jnp.arccos(1 - LENGTH * k) / (2 * np.pi))(K / 2)
    np.testing.assert_allclose(jax.jacfwd(tunes)(K / 2), [exact, exact], rtol=1e-10)
