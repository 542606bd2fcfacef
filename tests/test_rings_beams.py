"""Beam-beam kicks and space charge: fields, symplecticity, tune shifts, crossing angles."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special

import lanewise
from dvi_jax.systems import rings
from dvi_jax.systems.rings._beams import beam_field, faddeeva

S = np.kron(np.eye(3), [[0, 1], [-1, 0]])
FIELD = jax.jit(jnp.vectorize(beam_field))
Z = np.array([1.3e-4, 2e-4, -0.4e-4, 1e-4, 3e-3, 1e-3])


def jacobian(ring, z):
    return np.asarray(jax.jacfwd(lambda z: rings.one_turn(ring, z))(z))


def test_the_faddeeva_function():
    """Against SciPy in the upper half-plane, from 10⁻⁸ to 10⁶, next to the real axis as well; its
    derivative is −2zw + 2i/√π."""
    rng = np.random.default_rng(0)
    z = 10 ** rng.uniform(-8, 6, 4000) * np.exp(1j * rng.uniform(0, np.pi, 4000))
    z = np.append(z, rng.uniform(-12, 12, 4000) + 1j * 10 ** rng.uniform(-16, 0, 4000))
    w = jax.jit(faddeeva)(z.real, z.imag)
    wanted = special.wofz(z)
    assert (np.abs(w[0] + 1j * np.asarray(w[1]) - wanted) / np.abs(wanted)).max() < 1e-13
    z = z[np.abs(z) < 3]
    w, slope = jax.jit(lambda x, y: jax.jvp(faddeeva, (x, y), (np.ones(len(z)), 0 * y)))(
        z.real, z.imag
    )
    w, slope = (a + 1j * np.asarray(b) for a, b in (w, slope))
    assert np.abs(slope + 2 * z * w - 2j / np.sqrt(np.pi)).max() < 1e-13


def by_integral(x, y, sx, sy):
    """f_x by adaptive quadrature."""
    a = sx * sx + sy * sy
    kappa = (sx * sx - sy * sy) / a

    def integrand(t):
        exponent = -t / a * (x * x / (1 + kappa * t) + y * y / (1 - kappa * t))
        return np.exp(exponent) / ((1 + kappa * t) ** 1.5 * (1 - kappa * t) ** 0.5)

    ends = 0.0, 0.01, 0.1, 1.0
    pairs = itertools.pairwise(ends)
    parts = [integrate.quad(integrand, *pair, epsabs=0, epsrel=1e-13)[0] for pair in pairs]
    return x / a * sum(parts)


RATIOS = [1.0, 1 + 1e-12, 1.001, 1.3, 1.36, 1.37, 3.0, 40.0]


@pytest.mark.parametrize("ratio", RATIOS)
def test_fields_of_round_and_flat_beams(ratio):
    """On both sides of the ratio of 1.363 where the method changes, wide and tall."""
    for sx, sy in ((ratio, 1.0), (1.0, ratio)):
        for x, y in ((1e-3, 2e-3), (0.7, -1.2), (-2.5, 3.0), (0.0, 4.0), (9.0, 5.0)):
            of_x, of_y = (float(f) for f in FIELD(x, y, sx, sy))
            wanted = by_integral(x, y, sx, sy), by_integral(y, x, sy, sx)
            np.testing.assert_allclose([of_x, of_y], wanted, rtol=2e-12, atol=1e-15)


def test_limits_of_the_field():
    """Round beams exactly, any beam at small and at large distances."""
    r = np.array([1e-6, 0.1, 1.0, 5.0, 9.0, 30.0, 1e4])
    of_x, of_y = FIELD(0.6 * r, 0.8 * r, 1.0, 1.0)
    wanted = -np.expm1(-r * r / 2) / r
    np.testing.assert_allclose(of_x, 0.6 * wanted, rtol=1e-13)
    np.testing.assert_allclose(of_y, 0.8 * wanted, rtol=1e-13)
    for sx, sy in ((1.0, 1.1), (1.0, 5.0), (5.0, 1.0)):
        of_x, of_y = FIELD(1e-7, 2e-7, sx, sy)
        assert of_x == pytest.approx(1e-7 / (sx * (sx + sy)), rel=1e-8)
        assert of_y == pytest.approx(2e-7 / (sy * (sx + sy)), rel=1e-8)
        of_x, of_y = FIELD(3e5, -4e5, sx, sy)
        assert of_x == pytest.approx(3 / 25e5, rel=1e-9)
        assert of_y == pytest.approx(-4 / 25e5, rel=1e-9)


def test_derivatives_by_the_size_of_a_round_beam():
    """By differences, inside and far outside, where no digits of a small σ_x − σ_y may be lost."""
    for x, y in ((0.3, 0.5), (6.0, 3.0)):
        slope = jax.grad(lambda s, x=x, y=y: beam_field(x, y, s, 1.0)[0])(1.0)
        h = 1e-4
        above, below = (by_integral(x, y, 1.0 + d, 1.0) for d in (h, -h))
        assert slope == pytest.approx((above - below) / (2 * h), rel=1e-6, abs=1e-10)


def test_machine_code_is_the_same_function():
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(2, 50)) * 3
    for sigma in ((1.0, 1.1), (3.0, 0.5)):
        code = jax.vmap(lambda x, y, s=sigma: lanewise.call(beam_field, x, y, *map(jnp.asarray, s)))
        for a, b in zip(code(x, y), FIELD(x, y, *sigma), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-16)


ELEMENTS = {
    "round": rings.beam_beam("IP", 1e-8, (1e-4, 1e-4)),
    "flat": rings.beam_beam("IP", 1e-8, (2e-4, 2e-5), offset=(1e-5, -2e-5)),
    "crossing": rings.beam_beam(
        "IP", 1e-8, (1e-4, 2e-5), offset=(1e-5, 0), sigma_z=5e-3, crossing=0.02, slices=3
    ),
    "vertical": rings.beam_beam(
        "IP", -1e-8, (1e-4, 1e-4), sigma_z=5e-3, crossing=0.1, slices=2
    ).placed(tilt=np.pi / 2),
    "space charge": rings.space_charge("SC", 1e-8, (1e-4, 3e-4), offset=(0, 1e-5)),
}


QUICK = ("flat",)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in ELEMENTS]
)
def test_kicks_are_symplectic_and_have_inverses(name):
    """Also the boosts of a crossing angle together, each of which changes areas."""
    ring = rings.Ring([ELEMENTS[name]])
    J = jacobian(ring, Z)
    assert np.abs(J.T @ S @ J - S).max() < 1e-13
    assert np.abs(J - np.eye(6)).max() > 0.01
    weights = np.arange(1.0, 7.0)
    backward = jax.grad(lambda z: rings.track(ring, z).z @ weights)(Z)
    np.testing.assert_allclose(backward, J.T @ weights, rtol=1e-9)


ARC = [
    rings.quadrupole("QF", 0.5, 0.6, slices=1, scheme=6), rings.drift("D", 2.0),
    rings.quadrupole("QD", 0.5, -0.6, slices=1, scheme=6), rings.drift("D", 2.0),
]  # fmt: skip


@pytest.mark.slow
def test_tune_shifts():
    """cos 2π(Q + ΔQ) = cos 2πQ − 2πξ sin 2πQ, and ΔQ = ξ for small ξ; space charge defocuses."""
    sigma = np.array([2e-4, 3e-5])
    ring = rings.Ring([*ARC, rings.beam_beam("IP", 1e-10, tuple(sigma))])
    off = rings.optics(ring.set("IP", strength=0.0), chromatic=False)
    for strength in (1e-11, -3e-10):
        tune = rings.optics(ring.set("IP", strength=strength), chromatic=False).tune
        xi = strength * off.beta[0] / (4 * np.pi * sigma * sigma.sum())
        angle = 2 * np.pi * off.tune
        wanted = np.arccos(np.cos(angle) - 2 * np.pi * xi * np.sin(angle)) / (2 * np.pi)
        np.testing.assert_allclose(tune, wanted, rtol=1e-10)
        np.testing.assert_allclose(tune - off.tune, xi, rtol=0.02 if strength > 0 else 1)
    sc = rings.Ring([*ARC, rings.space_charge("SC", 1e-10, tuple(sigma))])
    minus = rings.optics(ring.set("IP", strength=-1e-10), chromatic=False).tune
    np.testing.assert_allclose(rings.optics(sc, chromatic=False).tune, minus, rtol=1e-14)


def test_the_tune_shift_with_a_crossing_angle():
    """σ_x² + σ_z² tan² of half of the angle in place of σ_x², for a bunch that is short compared
    with β; Piwinski 1977."""
    sx, sy, sz, angle, strength = 1e-4, 5e-5, 5e-3, 0.03, 1e-9
    element = rings.beam_beam("IP", strength, (sx, sy), sigma_z=sz, crossing=angle, slices=24)
    J = jacobian(rings.Ring([element]), np.zeros(6))
    wide = np.hypot(sx, sz * np.tan(angle))
    assert -J[1, 0] == pytest.approx(strength / (wide * (wide + sy)), rel=2e-3)
    assert -J[3, 2] == pytest.approx(strength / (sy * (wide + sy)), rel=2e-3)


def test_slices_of_a_short_beam_are_one_kick_at_the_collision_point():
    """Half of the way to the particle: x + ζ/2 px. Without a strength there is no change."""
    one = rings.Ring([rings.beam_beam("IP", 1e-9, (1e-4, 5e-5))])
    many = rings.Ring([rings.beam_beam("IP", 1e-9, (1e-4, 5e-5), sigma_z=1e-12, slices=5)])
    start = Z * [1, 1, 1, 1, 1, 0]
    moved = start.copy()
    moved[:3:2] += start[4] / 2 * start[1:4:2]
    wanted = np.asarray(rings.track(one, moved).z)
    z = np.asarray(rings.track(many, start).z)
    np.testing.assert_allclose(z[1:4:2], wanted[1:4:2], rtol=1e-9)
    np.testing.assert_allclose(z[:3:2], wanted[:3:2] - start[4] / 2 * wanted[1:4:2], rtol=1e-9)
    off = rings.Ring([rings.beam_beam("IP", 0.0, (1, 1), sigma_z=0.01, crossing=0.1, slices=1)])
    np.testing.assert_allclose(rings.track(off, Z).z, Z, rtol=1e-12, atol=1e-17)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rings.beam_beam("IP", 1e-9, (1e-4, 0.0)), "sigma_y of 'IP' must be a positive"),
        (lambda: rings.beam_beam("IP", 1e-9, (1e-4,)), r"sigma of 'IP' must be .*\(2,\)"),
        (lambda: rings.beam_beam("IP", 1e-9, (1e-4, 1e-4), crossing=0.01), "crossing need slices"),
        (lambda: rings.space_charge("SC", np.nan, (1e-4, 1e-4)), "strength of 'SC' must be"),
        (lambda: rings.resonance_driving_terms(rings.Ring([*ARC, ELEMENTS["round"]])), "of a beam"),
    ],
)
def test_what_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
