"""Actions and fundamental frequencies against tori that are known."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import pendulum
from scipy import special

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.dynamics import FrequencyError, actions, frequencies, fundamental_frequencies
from dvi_jax.dynamics.torus import combinations_up_to

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
    kepler, heiles = systems.kepler().system.H_D, systems.henon_heiles().system.H_D
    sols = [
        run(isochrone, [1.0, 0.0], [0.2, 0.6], 0.2, 5),
        run(kepler, [1.0, 0.0], [0.0, 1.1], 0.05, 8, {"K": 1.0}),
        *(run(heiles, *star(y, 0.0, E), 0.1, 5) for y, E in ((0.3, 1 / 8), (-0.1, 0.165))),
    ]
    signals = np.stack([np.asarray(sol.qs - 1j * sol.ps).T for sol in sols])
    return np.stack([sol.ts for sol in sols])[:, None], signals


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


@pytest.mark.slow
def test_isochrone_has_its_radial_action_and_angular_momentum():
    torus = lane(found(), "isochrone")
    J, omega = known_isochrone()
    assert torus.status == "successful"
    matrices = combinations_up_to(4, 4).reshape(-1, 2, 2)
    matrices = matrices[np.abs(np.linalg.det(matrices)) > 0.5]
    (M,) = [M for M in matrices if np.allclose(M @ omega, torus.frequencies)]
    np.testing.assert_allclose(M @ omega, torus.frequencies, rtol=0, atol=1e-9)
    errors = np.abs(M.T) @ torus.errors  # ω' = Mω, J' = M⁻ᵀ J
    assert (np.abs(M.T @ torus.actions - J) < errors).all()
    assert errors.max() < 1e-5
    assert np.abs(torus.actions - J).max() > 0.1  # the control: the basis matters


@pytest.mark.slow
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


@pytest.mark.slow
def test_kepler_is_degenerate_and_has_one_action():
    two, one = lane(found(), "kepler"), lane(found(1), "kepler")
    assert two.status == "resonant"
    assert np.isnan(two.actions).all()
    axis = 1 / (2 - 1.1**2)
    assert one.status == "successful"
    assert one.frequencies[0] == pytest.approx(axis**-1.5, rel=1e-10)
    assert one.actions[0] == pytest.approx(np.sqrt(axis), rel=1e-9)
    assert abs(one.actions[0] - np.sqrt(axis)) < one.errors[0]


@pytest.mark.slow
def test_chaotic_motion_has_no_actions_and_does_not_change_others():
    regular, chaotic = lane(found(), "regular"), lane(found(), "chaotic")
    assert chaotic.status == "not_quasi_periodic"
    assert np.isnan([*chaotic.actions, *chaotic.frequencies]).all()
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


RATES = np.array([0.1, 1.0, 30.0])
SCALES = np.array([1.0, 1e7, 1e-7])
M_SWING = np.sin(1.0) ** 2  # the square of k = sin(q0/2)
J_SWING = 8 / np.pi * (special.ellipe(M_SWING) - (1 - M_SWING) * special.ellipk(M_SWING))


@functools.cache
def one_degree():
    """Windows of 500 samples: before and after the change at each rate, and a pendulum as it is
    and in other units: its actions, times and signals."""
    sols = jax.vmap(lambda rate: run(slow, [1.0], [0.0], 0.05, 8, rate, samples=1500))(RATES)
    swing = run(pendulum, [2.0], [0.0], 0.05, 8, samples=500)
    z = np.asarray(sols.qs - 1j * sols.ps)[..., 0]
    swings = [np.asarray(s * swing.qs - 1j / s * swing.ps)[:, 0] for s in SCALES]
    signals = np.stack([*z[:, :500], *z[:, -500:], *swings])[:, None]
    ts = np.stack([*sols.ts[:, :500], *sols.ts[:, -500:], *[swing.ts] * 3])[:, None]
    return actions(ts, signals, count=14, throw=False), ts, signals


@pytest.mark.slow
def test_pendulum_has_the_action_of_the_elliptic_integrals():
    """J = (8/π) (E(k) − (1 − k²) K(k)), k = sin(q0/2)."""
    m, J = M_SWING, J_SWING
    torus = jax.tree.map(lambda x: x[6], one_degree()[0])
    assert torus.status == "successful"
    assert torus.actions[0] == pytest.approx(J, rel=1e-10)
    assert torus.frequencies[0] == pytest.approx(np.pi / 2 / special.ellipk(m), rel=1e-11)
    odd = torus.lines.frequencies[0, :5] / torus.frequencies[0]
    np.testing.assert_allclose(odd, [1, -1, 3, -3, 5], rtol=1e-7)
    assert torus.residual > 1e-9  # its square is the error of the action
    few = np.abs(torus.lines.amplitudes[0, :2]) ** 2 @ [1, -1] / 2
    assert abs(few / J - 1) > 1e-3  # the control: the leading pair alone


@pytest.mark.slow
def test_an_action_is_conserved_if_the_frequency_changes_slowly():
    """E/ω is an adiabatic invariant; a sudden change changes it, and J."""
    of = one_degree()[0]
    assert (of.status == "successful").all()
    before, after = of.actions[:3, 0], of.actions[3:6, 0]
    np.testing.assert_allclose(before, 0.5, rtol=1e-9)
    np.testing.assert_allclose(of.frequencies[3:6, 0], 1.5, rtol=1e-8)
    change = np.abs(after / before - 1)
    assert change[0] < 1e-7  # slow
    assert change[1] > 1e-3
    assert change[2] > 0.1  # sudden, while E/J = ω in every case


@pytest.mark.slow
def test_an_action_is_the_same_in_all_units():
    """q → sq, p → p/s is canonical."""
    of, ts, z = one_degree()
    scaled = jax.tree.map(lambda x: x[6:], of)
    assert list(scaled.status) == ["successful"] * 3
    np.testing.assert_allclose(scaled.actions[:, 0], J_SWING, rtol=1e-10)
    np.testing.assert_allclose(scaled.errors[:, 0], scaled.errors[0, 0], rtol=1e-3)
    assert scaled.errors.max() < 1e-9
    np.testing.assert_allclose(scaled.residual, scaled.residual[0], rtol=1e-3)
    np.testing.assert_allclose(scaled.scales[:, 0], scaled.scales[0, 0] * SCALES, rtol=1e-10)
    raw = frequencies(ts, z, count=14, throw=False)  # the control: lines of q − i p as it is
    omega, A = np.asarray(raw.frequencies[6:, 0]), np.asarray(raw.amplitudes[6:, 0])
    k = np.rint(omega / of.frequencies[6])
    bare = np.nansum(k * np.abs(A) ** 2, axis=1) / 2
    assert abs(bare[0] / J_SWING - 1) < 1e-8
    assert (np.abs(bare[1:] / J_SWING - 1) > 1e-4).all()


@pytest.mark.parametrize(("weak", "status"), [(1e-2, "successful"), (1e-3, "not_quasi_periodic")])
@pytest.mark.slow
def test_an_action_below_its_error_is_nan(weak, status):
    """A line of 9e-4 that is not a combination may contribute 8e-7 to either action."""
    z = [np.exp(1j * TS) + 9e-4 * np.exp(2.718j * TS), weak * np.exp(0.6180339887j * TS)]
    torus = actions(TS, np.stack(z), count=4, order=4, throw=False)
    assert torus.status == status
    assert torus.residual == pytest.approx(9e-4, rel=0.1)
    if status == "successful":
        np.testing.assert_allclose(torus.actions, [0.5, weak**2 / 2], rtol=1e-5)
        np.testing.assert_allclose(torus.errors, 9e-4**2, rtol=0.1)
    else:
        assert np.isnan([*torus.actions, *torus.errors, *torus.frequencies]).all()


@pytest.mark.slow
def test_a_degree_of_freedom_at_rest_does_not_contribute_to_an_action():
    z = np.stack([np.exp(1j * TS), np.full(256, 3.0 - 2j)])
    torus = actions(TS, z, count=4, num=1)
    np.testing.assert_allclose(torus.actions, 0.5, rtol=1e-12)
    np.testing.assert_allclose(torus.scales, 1.0, rtol=0.01)
    assert torus.scales[1] == 1


@pytest.mark.slow
def test_a_toda_chain_has_one_frequency_less_than_particles():
    p0 = 2 * np.random.default_rng(0).standard_normal(4)
    sol = run(systems.toda(4).system.H_D, np.zeros(4), p0 - p0.mean(), 0.1, 4, samples=8192)
    lines = frequencies(sol.ts, sol.ps.T, count=16)
    sparse = frequencies(sol.ts[::2], sol.ps[::2].T, count=16)
    three, two, folded = (
        fundamental_frequencies(lines, num=num, throw=False)
        for lines, num in ((lines, 3), (lines, 2), (sparse, 3))
    )
    assert (three.status, two.status) == ("successful", "not_quasi_periodic")
    assert three.unexplained < 1e-5 < 1e-2 < two.unexplained
    assert folded.status == "not_quasi_periodic"  # a third harmonic is above π/0.8
    linear = 2 * np.sin(np.pi * np.array([1, 1, 2]) / 4)  # of small waves
    np.testing.assert_allclose(np.sort(np.abs(three.frequencies)), linear, rtol=0.05)
    assert np.abs(np.sort(np.abs(three.frequencies)) - linear).min() > 1e-3


TS = 0.5 * np.arange(256)


def as_solution(z):
    """A trajectory (or a batch) with q − i p = z, shape (*batch, N, *state), at the times TS."""
    batch = z.shape[: z.shape.index(256)]
    ts = jnp.broadcast_to(jnp.asarray(TS), (*batch, 256))
    q, p = jnp.asarray(z.real), jnp.asarray(-z.imag)
    return dvi.Solution(ts, q, p, jnp.diff(ts), None, dvi.RESULTS.successful, {})


@pytest.mark.slow
def test_axes_of_the_state_are_distinguished_from_those_of_a_batch():
    """Two frequencies: of one torus, or of two trajectories of one degree of freedom."""
    w = np.array([1.0, 0.6180339887])
    x, y = np.exp(1j * np.outer(TS, w)).T
    z = np.stack([x + 0.3 * y, y - 0.3 * x], axis=1)  # (N, 2)
    for state in ((2,), (2, 1), (1, 2)):
        sol = as_solution(z.reshape(256, *state))
        lines = frequencies(sol, count=4)
        assert lines.frequencies.shape == (*state, 4)
        torus = fundamental_frequencies(lines)
        np.testing.assert_allclose(torus.frequencies, w, rtol=1e-12)
        assert torus.combinations.shape == (2, 4, 2)
        of = actions(sol, count=4)
        np.testing.assert_allclose(of.actions, [0.545, 0.545], rtol=1e-9)
        np.testing.assert_array_equal(of.lines.frequencies.shape, (2, 4))
    for state in ((), (1,)):
        sol = as_solution(np.stack([x, y]).reshape(2, 256, *state))
        lines = frequencies(sol, count=4)
        assert lines.frequencies.shape == (2, *state, 4)
        torus = fundamental_frequencies(lines)
        assert torus.frequencies.shape == (2, 1)
        np.testing.assert_allclose(torus.frequencies[:, 0], w, rtol=1e-12)
        assert list(torus.status) == ["successful"] * 2
        assert actions(sol, count=4).actions.shape == (2, 1)
    # The control: as an array of shape (2, N) they are the two degrees of freedom of one torus.
    one = fundamental_frequencies(frequencies(TS, np.stack([x, y]), count=4))
    np.testing.assert_allclose(one.frequencies, w, rtol=1e-12)


@pytest.mark.slow
def test_shapes_of_batches():
    rows, sols = TS + 0j * np.ones((2, 1)), as_solution(np.ones((2, 256), complex))
    each = jax.eval_shape(jax.vmap(lambda row: frequencies(TS, row, throw=False)), rows)
    assert each.frequencies.shape == (2, 8)
    assert each.state_axes == 0
    assert jax.eval_shape(lambda z: frequencies(TS, z, throw=False), rows).state_axes == 1
    assert jax.eval_shape(lambda s: frequencies(s, throw=False), sols).state_axes == 0
    none = np.zeros((0, 2, 256), complex)
    torus = fundamental_frequencies(frequencies(TS, none, count=4))
    assert torus.frequencies.shape == (0, 2)
    assert torus.combinations.shape == (0, 2, 4, 2)
    assert (torus.combinations.dtype, torus.matched.dtype) == (int, bool)
    of = actions(TS, none, count=4, leftover=np.float32(0.1))
    assert of.actions.shape == of.errors.shape == of.scales.shape == (0, 2)
    assert len(of.status) == 0


def planted(*lines):
    z = sum(size * np.exp(1j * omega * TS) for omega, size in lines)
    return frequencies(TS, np.stack([z, z]), count=4, throw=False)


def test_lines_that_are_not_a_basis_or_no_combination():
    """2ω₁ leads; the basis is among the weaker lines."""
    a, b = 0.7, 0.7 * 0.3819660113
    torus = fundamental_frequencies(planted((2 * a, 1), (a + b, 0.4), (a, 0.3), (b, 0.1)))
    assert torus.unexplained == 0
    assert np.nanmax(np.abs(torus.misfits)) < 1e-10
    known = np.array([[2, 0], [1, 1], [1, 0], [0, 1]])  # in a and b, in the order of the lines
    M = np.rint(np.linalg.lstsq(torus.combinations[0], known, rcond=None)[0])
    assert abs(round(np.linalg.det(M))) == 1
    np.testing.assert_allclose(M @ [a, b], torus.frequencies, rtol=1e-9)
    lines = planted((1.0, 1), (0.6180339887, 0.5), (0.7390851332, 0.2), (2.0, 0.1))
    with pytest.raises(FrequencyError, match="not a sum of lines") as info:
        fundamental_frequencies(lines)
    assert info.value.found.unexplained == pytest.approx(0.04 / 1.3, rel=1e-3)
    torus = fundamental_frequencies(lines, num=3, order=4)
    np.testing.assert_allclose(np.sort(torus.frequencies), [0.6180339887, 0.7390851332, 1.0])


def of_one_line(**options):
    return fundamental_frequencies(planted((1.0, 1)), **options)


WAVE = np.exp(1j * TS)
VALUE_ERRORS = {
    "finite number, got 0": lambda: actions(TS, WAVE, leftover=0),
    "finite number, got 'a": lambda: actions(TS, WAVE, leftover="a"),
    "num must be .* got 0": lambda: actions(TS, WAVE, num=0),
    "degrees of freedom, got 0": lambda: actions(TS, np.zeros((0, 256), complex), count=4),
    "outside of jit": lambda: jax.jit(lambda z: actions(TS, z))(WAVE),
    "order must be .* at least 1": lambda: of_one_line(order=0),
    "guess must be a finite number, got .*nan": lambda: of_one_line(guess=[np.nan]),
    "guess must be a finite number, got .*'a'": lambda: of_one_line(guess="a"),
    "guess must have the length num = 2": lambda: of_one_line(guess=[1.0], num=2),
    "positive and finite number, got 0": lambda: of_one_line(tolerance=0),
    "positive and finite number, got 'a'": lambda: of_one_line(tolerance="a"),
    "threshold must be at most 1": lambda: of_one_line(threshold=2),
}
TYPE_ERRORS = {
    "must be complex": lambda: actions(TS, np.cos(TS)),
    "a result of dvi.frequencies": lambda: fundamental_frequencies(TS),
}


@pytest.mark.parametrize(
    ("errors", "error"), [(VALUE_ERRORS, ValueError), (TYPE_ERRORS, TypeError)]
)
def test_invalid_arguments(errors, error):
    for message, call in errors.items():
        with pytest.raises(error, match=message):
            call()


def test_the_number_of_combinations():
    """|k|₁ ≤ m in n dimensions: Delannoy's numbers."""
    for n, m, count in ((1, 64, 129), (2, 20, 841), (3, 12, 2625)):
        assert len(combinations_up_to(n, m)) == count
    table = combinations_up_to(3, 5)
    assert (np.diff(np.abs(table).sum(axis=1)) >= 0).all()
    assert not table[0].any()
