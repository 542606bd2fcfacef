"""Actions and fundamental frequencies against tori that are known."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.dynamics import FrequencyError, actions, frequencies, fundamental_frequencies
from dvi_jax.dynamics.actions import combinations_up_to

N = 2048


def run(H, q0, p0, h, every, args=None, samples=N):
    return dvi.integrate(
        dvi.System(H), q0, p0, h=h, num_steps=every * (samples - 1), args=args,
        method=dvi.KahanLi(8), save=dvi.Save(every=every),
    )  # fmt: skip


def isochrone(t0, t1, q, p, args):
    """Hénon's isochrone potential, GM = b = 1."""
    return jnp.sum(p**2) / 2 - 1 / (1 + jnp.sqrt(1 + jnp.sum(q**2)))


def star(y, py, E):
    return [0.0, y], [np.sqrt(2 * E - py**2 - y**2 + 2 * y**3 / 3), py]


PLANE = ("isochrone", "kepler", "regular", "chaotic")


@functools.cache
def planar():
    """Times and q − i p of motions in the plane, in one batch."""
    hh = systems.henon_heiles().system.H_D
    sols = [
        run(isochrone, [1.0, 0.0], [0.2, 0.6], 0.2, 5),
        run(systems.kepler().system.H_D, [1.0, 0.0], [0.0, 1.1], 0.05, 8, {"K": 1.0}),
        run(hh, *star(0.3, 0.0, 1 / 8), 0.1, 5),
        run(hh, *star(-0.1, 0.0, 0.165), 0.1, 5),
    ]
    ts = np.stack([np.asarray(sol.ts) for sol in sols])
    return ts[:, None], np.stack([np.asarray(sol.qs - 1j * sol.ps).T for sol in sols])


@functools.cache
def found(num=2):
    return actions(*planar(), count=24, num=num, throw=False)


def lane(of, name):
    return jax.tree.map(lambda x: x[PLANE.index(name)], of)


def known_isochrone():
    """J_r, L and their frequencies: Binney & Tremaine 2008, 3.5.2."""
    E, L = 0.2 - 1 / (1 + np.sqrt(2.0)), 0.6
    root = np.sqrt(L**2 + 4)
    radial = (-2 * E) ** 1.5
    J = np.array([1 / np.sqrt(-2 * E) - (L + root) / 2, L])
    return J, np.array([radial, (1 + L / root) / 2 * radial])


def test_isochrone_has_its_radial_action_and_angular_momentum():
    torus = lane(found(), "isochrone")
    J, omega = known_isochrone()
    assert torus.status == "successful"
    options = [
        M
        for M in combinations_up_to(4, 4).reshape(-1, 2, 2)
        if abs(np.linalg.det(M)) > 0.5 and np.allclose(M @ omega, torus.frequencies)
    ]
    assert len(options) == 1
    ours = options[0].T @ torus.actions  # ω' = Mω, J' = M⁻ᵀ J
    allowed = np.abs(options[0].T) @ torus.errors
    np.testing.assert_allclose(options[0] @ omega, torus.frequencies, rtol=0, atol=1e-9)
    assert (np.abs(ours - J) < allowed).all()
    assert allowed.max() < 1e-5
    assert np.abs(torus.actions - J).max() > 0.1  # the control: the basis matters


def test_a_guess_chooses_the_basis():
    lines = lane(found(), "isochrone").lines
    _, omega = known_isochrone()
    torus = fundamental_frequencies(lines, guess=omega * [1.0005, 0.9998])
    np.testing.assert_allclose(torus.frequencies, omega, rtol=0, atol=1e-9)
    # x and y of a rotation: every line goes once around, forward or back.
    assert (np.abs(torus.combinations[..., 1]) == 1)[torus.matched].all()
    assert torus.matched.sum() > 30
    other = fundamental_frequencies(lines, guess=omega[::-1])
    np.testing.assert_array_equal(other.combinations[..., ::-1], torus.combinations)


def test_kepler_is_degenerate_and_has_one_action():
    two, one = lane(found(), "kepler"), lane(found(1), "kepler")
    assert two.status == "resonant"
    assert np.isnan(two.actions).all()
    axis = 1 / (2 - 1.1**2)
    assert one.status == "successful"
    assert one.frequencies[0] == pytest.approx(axis**-1.5, rel=1e-10)
    assert one.actions[0] == pytest.approx(np.sqrt(axis), rel=1e-9)
    assert abs(one.actions[0] - np.sqrt(axis)) < one.errors[0]


def test_chaos_has_no_actions_and_a_neighbour_keeps_its():
    regular, chaotic = lane(found(), "regular"), lane(found(), "chaotic")
    assert chaotic.status == "not_quasi_periodic"
    assert np.isnan(chaotic.actions).all()
    assert np.isnan(chaotic.frequencies).all()
    assert chaotic.residual > 0.1
    assert regular.status == "successful"
    assert regular.residual < 1e-4
    assert (regular.errors < 1e-8).all()
    assert regular.actions.sum() == pytest.approx(1 / 8, rel=0.02)  # E ≈ Σ ω J, ω ≈ 1
    with pytest.raises(FrequencyError, match=r"2 of 4.*resonant") as info:
        actions(*planar(), count=24)
    np.testing.assert_array_equal(info.value.found.actions[2], regular.actions)


def slow(t0, t1, q, p, args):
    """An oscillator whose frequency goes from 1 to 1.5 at a rate."""
    omega = 1.25 + 0.25 * jnp.tanh(args * (t0 - 300.0))
    return jnp.sum(p**2) / 2 + omega**2 * jnp.sum(q**2) / 2


def pendulum(t0, t1, q, p, args):
    return jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q))


RATES = np.array([0.1, 1.0, 30.0])


@functools.cache
def one_degree():
    """Windows of 500 samples: before and after the change at each rate, and a pendulum."""
    sols = jax.vmap(lambda rate: run(slow, [1.0], [0.0], 0.05, 8, rate, samples=1500))(RATES)
    swing = run(pendulum, [2.0], [0.0], 0.05, 8, samples=500)
    z = np.asarray(sols.qs - 1j * sols.ps)[..., 0]
    signals = [*z[:, :500], *z[:, -500:], np.asarray(swing.qs - 1j * swing.ps)[:, 0]]
    ts = [*sols.ts[:, :500], *sols.ts[:, -500:], swing.ts]
    return actions(np.stack(ts)[:, None], np.stack(signals)[:, None], count=14, throw=False)


def test_pendulum_has_the_action_of_the_elliptic_integrals():
    """J = (8/π) (E(k) − (1 − k²) K(k)), k = sin(q0/2)."""
    m = np.sin(1.0) ** 2
    J = 8 / np.pi * (special.ellipe(m) - (1 - m) * special.ellipk(m))
    torus = jax.tree.map(lambda x: x[-1], one_degree())
    assert torus.status == "successful"
    assert torus.actions[0] == pytest.approx(J, rel=1e-10)
    assert torus.frequencies[0] == pytest.approx(np.pi / 2 / special.ellipk(m), rel=1e-11)
    assert torus.residual > 1e-9  # what is left over counts squared
    few = np.abs(torus.lines.amplitudes[0, :2]) ** 2 @ [1, -1] / 2
    assert abs(few / J - 1) > 1e-3  # the control: the leading pair alone


def test_an_action_is_kept_where_the_change_is_slow():
    """E/ω is an adiabatic invariant; what a sudden change does to it, it does to J."""
    of = one_degree()
    assert (of.status == "successful").all()
    before, after = of.actions[:3, 0], of.actions[3:6, 0]
    np.testing.assert_allclose(before, 0.5, rtol=1e-9)
    np.testing.assert_allclose(of.frequencies[3:6, 0], 1.5, rtol=1e-8)
    change = np.abs(after / before - 1)
    assert change[0] < 1e-7  # slow
    assert change[1] > 1e-3
    assert change[2] > 0.1  # sudden, while E/J = ω in every case


@pytest.mark.slow
def test_a_chain_of_toda_has_one_frequency_less_than_particles():
    p0 = 2 * np.random.default_rng(0).standard_normal(4)
    sol = run(systems.toda(4).system.H_D, np.zeros(4), p0 - p0.mean(), 0.1, 4, samples=8192)
    lines = frequencies(sol.ts, sol.ps.T, count=16)
    three = fundamental_frequencies(lines, num=3, throw=False)
    two = fundamental_frequencies(lines, num=2, throw=False)
    assert three.status == "successful"
    assert three.unexplained < 1e-5
    assert two.status == "not_quasi_periodic"
    assert two.unexplained > 1e-2
    sparse = frequencies(sol.ts[::2], sol.ps[::2].T, count=16)
    folded = fundamental_frequencies(sparse, num=3, throw=False)
    assert folded.status == "not_quasi_periodic"  # a third harmonic is above π/0.8
    linear = 2 * np.sin(np.pi * np.array([1, 1, 2]) / 4)  # of small waves
    np.testing.assert_allclose(np.sort(np.abs(three.frequencies)), linear, rtol=0.05)
    assert np.abs(np.sort(np.abs(three.frequencies)) - linear).min() > 1e-3


TS = 0.5 * np.arange(256)


def planted(*lines):
    z = sum(size * np.exp(1j * omega * TS) for omega, size in lines)
    return frequencies(TS, np.stack([z, z]), count=4, throw=False)


def test_lines_that_are_no_basis_by_themselves():
    """2ω₁ leads; the basis is among the weaker lines."""
    a, b = 0.7, 0.7 * 0.3819660113
    torus = fundamental_frequencies(planted((2 * a, 1), (a + b, 0.4), (a, 0.3), (b, 0.1)))
    assert torus.unexplained == 0
    assert np.nanmax(np.abs(torus.misfits)) < 1e-10
    known = np.array([[2, 0], [1, 1], [1, 0], [0, 1]])  # in a and b, in the order of the lines
    M = np.rint(np.linalg.lstsq(torus.combinations[0], known, rcond=None)[0])
    assert abs(round(np.linalg.det(M))) == 1
    np.testing.assert_allclose(M @ [a, b], torus.frequencies, rtol=1e-9)


def test_a_line_that_is_no_combination_is_told():
    lines = planted((1.0, 1), (0.6180339887, 0.5), (0.7390851332, 0.2), (2.0, 0.1))
    with pytest.raises(FrequencyError, match="no sum of lines") as info:
        fundamental_frequencies(lines)
    assert info.value.found.unexplained == pytest.approx(0.04 / 1.3, rel=1e-3)
    torus = fundamental_frequencies(lines, num=3, order=4)
    np.testing.assert_allclose(np.sort(torus.frequencies), [0.6180339887, 0.7390851332, 1.0])


@pytest.mark.parametrize(
    ("give", "error", "words"),
    [
        (lambda: actions(TS, np.cos(TS)), TypeError, "the complex signal q − i p"),
        (lambda: actions(TS, np.exp(1j * TS), leftover=0), ValueError, "positive number, got 0"),
        (lambda: actions(TS, np.exp(1j * TS), num=0), ValueError, "must be positive, got 0"),
        (lambda: fundamental_frequencies(TS), TypeError, "what dvi.frequencies returned"),
        (lambda: fundamental_frequencies(planted((1.0, 1)), order=0), ValueError, "positive int"),
        (lambda: fundamental_frequencies(planted((1.0, 1)), guess=[np.nan]), ValueError, "finite"),
        (lambda: fundamental_frequencies(planted((1.0, 1)), tolerance=0), ValueError, "positive"),
        (lambda: fundamental_frequencies(planted((1.0, 1)), threshold=2), ValueError, "a share"),
        (lambda: jax.jit(lambda z: actions(TS, z))(TS + 0j), ValueError, "not under jit"),
    ],
)
def test_bad_input_is_refused_in_words(give, error, words):
    with pytest.raises(error, match=words):
        give()


def test_combinations_are_counted_right():
    """|k|₁ ≤ m in n dimensions: Delannoy's numbers."""
    assert len(combinations_up_to(1, 64)) == 129
    assert len(combinations_up_to(2, 20)) == 841
    assert len(combinations_up_to(3, 12)) == 2625
    table = combinations_up_to(3, 5)
    assert (np.diff(np.abs(table).sum(axis=1)) >= 0).all()
    assert not table[0].any()
