"""Alpha particles that slow down: coefficients, pitch angle, distributions, energy, ends."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf
from scipy.stats import chi2, kstest

import dvi_jax as dvi
from dvi_jax.systems import boozer
from dvi_jax.systems.boozer._slowing import collide, rotate

slow = pytest.mark.slow
EV, ELECTRON, UNIT = 1.602176634e-19, 9.1093837015e-31, 1.66053906660e-27


def tokamak(**extra):
    """No particle leaves it in the short runs of these tests."""
    return boozer.from_modes(
        [0, 1], [0, 0], [[5.7], [-0.9]], psi_edge=8.0, iota=0.4, G=57.0, **extra
    )


def dense(particles, steps, electron=20e3, ion=1e3, **options):
    """A plasma in which τ_s is a number of steps, with cold ions and hot electrons."""
    plasma = boozer.Plasma(1e20, electron, ion)
    time = float(plasma.slowing_time(0.0, particles.mass, particles.charge))
    n = 1e20 * time * particles.speed / (steps * particles.h)
    return boozer.SlowingDown(particles, boozer.Plasma(n, electron, ion), **options)


def test_coefficients_are_those_of_the_definition():
    """Against Helander & Sigmar 2002, (3.45)–(3.48), in their own quantities."""
    mass, v = 6.6446573357e-27, np.array([2e5, 1e6, 5e6, 1.3e7])
    plasma = boozer.Plasma(3e19, 8e3, 5e3, ions=((2.0, 1.0, 0.6), (12.0, 6.0, 0.4 / 6)))

    def defined(v):
        nu, parallel, friction = np.zeros_like(v), np.zeros_like(v), np.zeros_like(v)
        species = [(ELECTRON, -1, 3e19, 8e3, 17.0), (2 * UNIT, 1, 1.8e19, 5e3, 20.0),
                   (12 * UNIT, 6, 0.2e19, 5e3, 20.0)]  # fmt: skip
        for m, Z, n, T, log in species:
            hat = n * (2 * Z * EV**2) ** 2 * log / (4 * np.pi * 8.8541878128e-12**2 * mass**2)
            x = v / np.sqrt(2 * T * EV / m)
            G = (erf(x) - x * 2 / np.sqrt(np.pi) * np.exp(-(x**2))) / (2 * x**2)
            nu += hat * (erf(x) - G) / v**3
            parallel += 2 * hat * G / v**3
            friction += hat * mass / (T * EV) * (1 + m / mass) * G / v * mass / (mass + m)
        return nu, v**2 * parallel / 2, v * friction

    rates = plasma.rates(jnp.full(4, 0.3), jnp.asarray(v), mass, 2.0)
    nu, D, F = defined(v)
    np.testing.assert_allclose(rates.scattering.sum(0), nu, rtol=1e-10)
    np.testing.assert_allclose(rates.diffusion.sum(0), D, rtol=1e-10)
    # L = −(v A + D) with the drift A = −F + D' + 2D/v of the equation of Itô for v.
    step = 1e-5 * v
    slope = (defined(v + step)[1] - defined(v - step)[1]) / (2 * step)
    np.testing.assert_allclose(rates.loss.sum(0), v * F - v * slope - 3 * D, rtol=1e-6)
    # At one temperature a Maxwellian plasma takes no energy from Maxwellian particles.
    T, v = 5e3, np.linspace(1.0, 4e6, 4001)
    even = boozer.Plasma(3e19, T, T).rates(jnp.full(4001, 0.3), jnp.asarray(v), mass, 2.0)
    weight = v**2 * np.exp(-mass * v**2 / (2 * T * EV))
    exchange = np.trapezoid(weight * np.asarray(even.loss), v)
    assert np.abs(exchange).max() < 1e-6 * np.trapezoid(weight * np.abs(even.loss), v).min()


def test_the_limits_are_those_of_slowing_down():
    """F = v/τ_s + v_c³/(τ_s v²), and Spitzer's numbers of the NRL formulary."""
    alphas = boozer.GuidingCentres(tokamak())
    plasma = boozer.Plasma(1e20, 11.5e3, 10.0)
    time = float(plasma.slowing_time(0.0, alphas.mass, 2.0))
    assert time == pytest.approx(6.27e8 * 4.0 * 11.5e3**1.5 / (4 * 17 * 1e14), rel=2e-2)
    v, cold = 0.2 * alphas.speed, boozer.Plasma(1e20, 2e3, 10.0)
    loss = cold.rates(0.0, v, alphas.mass, 2.0).loss
    time = float(cold.slowing_time(0.0, alphas.mass, 2.0))
    ratio = (float(cold.critical_speed(0.0)) / v) ** 3
    # The rest is 3D of the electrons, 3T/(mv²) of their part.
    np.testing.assert_allclose(loss * time / v**2, [1.0, ratio], rtol=0.03)


def moment(degree, xi, tau, nodes=120):
    """⟨P_degree(ξ)⟩ after one rotation: the normals in polar coordinates, by quadrature."""
    x, weights = np.polynomial.legendre.leggauss(nodes)
    # e from 0 to ∞ as −log u; u = w² smooths the end.
    w = (x + 1) / 2
    e, weights = -2 * np.log(w), weights / 2 * 2 * w
    phi = 2 * np.pi * (np.arange(64) + 0.5) / 64
    r = np.sqrt(2 * e)[:, None]
    z = jnp.asarray(r * np.cos(phi)), jnp.asarray(r * np.sin(phi))
    values = np.polynomial.legendre.Legendre.basis(degree)(np.asarray(rotate(xi, tau, z)))
    return float(weights @ values.mean(1))


def factor(degree, tau):
    """Π (k − j)/(k + j) with k = coth(τ/2)."""
    k, j = 1 / np.tanh(tau / 2), np.arange(1, degree + 1)
    return np.prod((k - j) / (k + j))


def test_the_pitch_decays_at_the_exact_rate():
    for tau in (1e-6, 0.05, 1.0, 6.0):
        assert moment(1, 0.6, tau) == pytest.approx(0.6 * np.exp(-tau), abs=2e-7)
        for degree in (2, 3):
            initial = np.polynomial.legendre.Legendre.basis(degree)(0.6)
            value = initial * factor(degree, tau)
            assert moment(degree, 0.6, tau) == pytest.approx(value, abs=2e-7)
    # Negative control: another rate.
    assert abs(moment(1, 0.6, 1.0) - 0.6 * np.exp(-0.9)) > 0.02
    for degree in (2, 3, 6):  # the factors of a Brownian motion to O(τ³)
        rate = degree * (degree + 1) / 2
        error = [abs(factor(degree, tau) - np.exp(-rate * tau)) for tau in (2e-3, 1e-3)]
        assert np.log2(error[0] / error[1]) == pytest.approx(3, abs=0.1)


CUT = 0.15


@functools.cache
def slowing_run(count, steps, observed=False):
    """Alphas in a tokamak until v = CUT v0, and v along the runs [v0]."""
    alphas = boozer.GuidingCentres(tokamak())
    slowing = dense(alphas, steps, thermal=CUT**2 * 3.5e6 / 1e3, base=dvi.GaussLegendre(1))
    q, p, args = slowing.start(0.25, 0.2, 0.4, 0.3)

    def run(key):
        sol = dvi.integrate(
            slowing.system, q, p, args=args, h=alphas.h, num_steps=int(1.4 * steps),
            method=slowing.method, path=dvi.Brownian(key), stop=slowing.end, throw=False,
            save=dvi.Save() if observed else dvi.Save(final=True),
        )  # fmt: skip
        energy = jax.vmap(lambda q, p: slowing._centre(q, p, args).energy)(sol.qs, sol.ps)
        return jnp.sqrt(2 * energy), sol.stop

    v, stop = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(1), count))
    v_c = float(slowing.plasma.critical_speed(0.0)) / alphas.speed
    return slowing, np.asarray(v), stop, v_c


def check_energy(count, steps, times, fractions):
    slowing, _, stop, v_c = slowing_run(count, steps)
    end = slowing.end_of(stop.q, stop.p)
    assert set(end.outcome) == {"thermal"}
    # The balance is closed up to the energy error of the motion.
    total = end.energy + end.to_electrons + end.to_ions
    np.testing.assert_allclose(total + end.error, 3.5e6, rtol=1e-12)
    assert np.abs(end.error).max() < 3e-4 * 3.5e6  # of the midpoint rule
    np.testing.assert_allclose(end.energy, CUT**2 * 3.5e6, rtol=1e-9)
    time = np.mean(np.asarray(stop.t)) / slowing.particles.h / steps
    assert time == pytest.approx(np.log((1 + v_c**3) / (CUT**3 + v_c**3)) / 3, rel=times)
    v = np.linspace(CUT, 1, 2001)
    to_ions = np.trapezoid(2 * v_c**3 * v / (v**3 + v_c**3), v)  # Stix 1972
    assert end.to_ions.mean() / 3.5e6 == pytest.approx(to_ions, rel=fractions)
    assert end.to_ions.mean() / 3.5e6 != pytest.approx(1.1 * to_ions, rel=fractions)


def test_the_energy_goes_to_electrons_and_ions():
    check_energy(128, 100, 0.05, 0.06)


@slow
def test_the_shares_and_the_time_of_slowing_down():
    check_energy(4096, 400, 0.02, 0.02)


@slow
def test_the_distribution_is_that_of_slowing_down():
    """f ∝ 1/(v³ + v_c³) within 2 %, from the time that particles spend in intervals of v."""
    _, v, _, v_c = slowing_run(8192, 400, True)
    bins, parts = np.linspace(CUT + 0.03, 0.97, 9), (np.arange(8) + 0.5) / 8
    fine = v[:, :-1, None] * (1 - parts) + v[:, 1:, None] * parts
    count, _ = np.histogram(fine[np.isfinite(fine)], bins)

    def share(cube):
        width = np.diff(np.log(bins**3 + cube))
        return width / width.sum()

    measured = count / count.sum()
    assert np.abs(measured / share(v_c**3) - 1).max() < 0.02
    for cube in (0.0, 0.5 * v_c**3, 2 * v_c**3):  # negative controls
        assert np.abs(measured / share(cube) - 1).max() > 0.05


@slow
def test_thermal_particles_are_maxwellian():
    T = 2e4
    ions = boozer.GuidingCentres(tokamak(), energy=3 * T)
    unit = boozer.Plasma(1e20, T, T)
    rate = float(jnp.sum(unit.rates(0.0, ions.speed, ions.mass, 2.0).scattering)) / ions.speed
    plasma = boozer.Plasma(1e20 * 0.02 / (rate * 2.0), T, T)
    slowing = boozer.SlowingDown(ions, plasma, base=dvi.GaussLegendre(1))
    q, p, args = slowing.start(0.25, 0.2, 0.4, 0.5)

    def last(key):
        sol = dvi.integrate(
            slowing.system, q, p, args=args, h=2.0, num_steps=500, method=slowing.method,
            path=dvi.Brownian(key), save=dvi.Save(final=True),
        )  # fmt: skip
        centre = slowing._centre(sol.qs[-1], sol.ps[-1], args)
        return centre.energy, centre.u

    energy, u = jax.jit(jax.vmap(last))(jax.random.split(jax.random.key(8), 4000))
    over_T = 2 * 3 * np.asarray(energy)
    assert over_T.mean() == pytest.approx(1.5, abs=0.06)
    assert kstest(2 * over_T, chi2(3).cdf).pvalue > 1e-3
    assert kstest(2.2 * over_T, chi2(3).cdf).pvalue < 1e-3  # 10 % colder
    assert kstest(np.asarray(u / np.sqrt(2 * energy)), "uniform", (-1, 2)).pvalue > 1e-3


@slow
def test_the_weak_order_is_two():
    """With profiles and motion: differences of the mean energy on the same Brownian paths."""
    ions, length, T = boozer.GuidingCentres(tokamak(), energy=1e5), 64.0, 1e4
    unit = boozer.Plasma(1e20, T, T)
    loss = float(jnp.sum(unit.rates(0.0, ions.speed, ions.mass, 2.0).loss)) / ions.speed**3
    n = 0.15e20 / (loss * length)
    slowing = boozer.SlowingDown(ions, boozer.Plasma(lambda s: n * (2 - s), T, T))
    q, p, args = slowing.start(0.25, 0.2, 0.4, 0.5)

    def energies(steps):
        def last(key):
            sol = dvi.integrate(
                slowing.system, q, p, args=args, h=length / steps, num_steps=steps,
                method=slowing.method, path=dvi.Brownian(key, 32 // steps),
                save=dvi.Save(final=True),
            )  # fmt: skip
            return slowing._centre(sol.qs[-1], sol.ps[-1], args).energy

        return np.asarray(jax.jit(jax.vmap(last))(keys))

    keys = jax.random.split(jax.random.key(3), 100_000)
    results = [energies(steps) for steps in (4, 8, 16, 32)]
    changes = [a - b for a, b in itertools.pairwise(results)]
    sizes = np.array([change.mean() for change in changes])
    errors = np.array([change.std() / np.sqrt(change.size) for change in changes])
    assert (sizes > 5 * errors).all()
    assert np.log2(sizes[0] / sizes[1]) == pytest.approx(2, abs=0.35)
    assert np.log2(sizes[1] / sizes[2]) == pytest.approx(2, abs=0.5)


@pytest.mark.parametrize("coordinates", ["regular", "angles"])
def test_collisions_keep_the_place(coordinates):
    """With a toroidal current p_θ changes as well; s, θ, ζ do not, and μ follows v and v∥."""
    field = tokamak(I=[0, 0.4])
    particles = boozer.GuidingCentres(field, coordinates=coordinates)
    slowing = dense(particles, 30)
    q, p, args = slowing.start(0.25, 0.2, 0.4, 0.3)
    dq, dp = collide(slowing.system.noise, args, None, 2.0, jnp.array([0.9, -1.2, 2.0]), q, p)
    before, after = slowing.coordinates_of(q, p), slowing.coordinates_of(q + dq, p + dp)
    np.testing.assert_allclose(after[:3], before[:3], rtol=1e-12)
    assert abs(after.v_parallel / before.v_parallel - 1) > 0.05
    ends = slowing.end_of(jnp.stack([q, q + dq]), jnp.stack([p, p + dp]))
    assert ends.energy[1] / ends.energy[0] < 0.995
    np.testing.assert_allclose(ends.error, 0, atol=1e-6)
    assert ends.to_electrons[1] > ends.to_ions[1] > 0


def test_a_loss_is_an_end():
    field = boozer.from_modes([0, 1], [0, 0], [[5.7], [-0.5]], psi_edge=8.0, iota=0.0, G=57.0)
    slowing = dense(boozer.GuidingCentres(field), 4000, base=dvi.GaussLegendre(1))
    q, p, args = slowing.start(0.7, 0.3, 0.0, 0.5)
    run = {"args": args, "h": 4.0, "method": slowing.method, "throw": False}
    sol = dvi.integrate(slowing.system, q, p, num_steps=400, path=7, stop=slowing.end, **run)
    end = slowing.end_of(sol.stop.q, sol.stop.p)
    assert (sol.status, str(end.outcome)) == ("stopped", "lost")
    assert float(end.s) == pytest.approx(1, abs=1e-9)
    assert 1e6 < float(end.energy) < 3.5e6
    assert str(slowing.end_of(q, p).outcome) == "slowing"
    nan = slowing.end_of(q * np.nan, p)
    assert str(nan.outcome) == "unknown"


@slow
def test_a_path_has_its_bits_in_pieces_and_in_a_batch():
    slowing = dense(boozer.GuidingCentres(tokamak()), 100)
    q, p, args = slowing.start(0.25, 0.2, 0.4, 0.3)
    run = {"args": args, "h": 2.0, "method": slowing.method}
    sol = dvi.integrate(slowing.system, q, p, num_steps=10, path=7, **run)
    rest = dvi.integrate(
        slowing.system, sol.qs[4], sol.ps[4], t0=sol.ts[4], num_steps=6,
        path=dvi.Brownian(7, first_step=4), **run,
    )  # fmt: skip
    np.testing.assert_array_equal(rest.ps, sol.ps[4:])
    batch = dvi.sweep(
        slowing.system, q, p, num_steps=10, path=dvi.Axis("seed", range(9)),
        observe={"moment": dvi.Last(lambda q, p: p[2])}, **run,
    )  # fmt: skip
    moments = np.ravel(batch["moment"]).tolist()
    assert moments[7] == float(sol.ps[-1][2])
    assert len(set(moments)) == 9


def test_wrong_requests_are_refused():
    slowing = dense(boozer.GuidingCentres(tokamak()), 100)
    with pytest.raises(ValueError, match="charge of the ions per electron"):
        boozer.Plasma(1e20, 1e4, 1e4, ions=((2.0, 1.0, 0.5),))
    q, p, args = slowing.start(0.25, 0.2, 0.4, 0.3)
    for method in (dvi.BAOAB(), dvi.StochasticMidpoint(), dvi.StochasticEuler()):
        with pytest.raises(ValueError, match=r"boozer\.SlowingDown"):
            dvi.integrate(
                slowing.system, q, p, args=args, h=1.0, num_steps=2, method=method, path=1
            )
    with pytest.raises(TypeError, match="GuidingCentres"):
        boozer.SlowingDown(tokamak(), slowing.plasma)
