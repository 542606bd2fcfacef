"""Frequency analysis: synthetic tori, orders in the window, statuses, an outside reference."""

import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import dynamics, systems
from dvi_jax.dynamics import FREQUENCY_RESULTS, FrequencyError, frequencies, frequency_diffusion

N, COUNT = 2048, 5
TS = 3.0 + 0.5 * np.arange(N)
BIN = 2 * np.pi / (N * 0.5)
OMEGA = np.array([1.0, -0.61803398875, 2.3456, 0.0703])
AMPLITUDES = np.array([1.0, 0.3j, 0.1 + 0.05j, 1e-3])


def torus(ts=TS, omega=OMEGA, amplitudes=AMPLITUDES):
    return np.exp(1j * np.outer(ts, omega)) @ amplitudes


def pair(bins, ratio):
    """Two lines at a distance in units of the resolution, and a third one."""
    return torus(omega=[1, 1 + bins * BIN, -0.7], amplitudes=[1, ratio * np.exp(0.7j), 0.2])


SIGNALS = {
    "successful": 0.2 + 0.1j + torus(),
    "not_finite": np.where(np.arange(N) == 700, np.nan, torus()),
    "no_signal": np.full(N, 0.3 + 0.1j),
    "window_too_short": np.exp(2.5j * BIN * TS) + 1e-3 * np.exp(1j * TS),
    "aliased": np.exp(0.95j * np.pi / 0.5 * TS),
    "unresolved": pair(0.6, 0.5),
    "not_converged": np.exp(1j * (TS + 1e-3 * TS**2)),
    "zero": np.zeros(N, complex),
    "drift": TS + 0j,
    "noise": np.random.default_rng(3).standard_normal(N) + 0j,
    "noisy": torus() + 0.1 * np.random.default_rng(4).standard_normal((2, N)).T @ [1, 1j],
    "small": 1e-200 * torus(),
    **{f"pair {bins:g}": pair(bins, ratio) for bins, ratio in ((1.2, 1), (1.5, 0.01), (2, 0.5))},
    **{f"near {bins:g}": pair(bins, 1) for bins in (0.2, 0.4, 0.8)},
}
NAMES = list(SIGNALS)


@functools.cache
def analysed():
    """All signals in one batch."""
    return frequencies(TS, np.stack(list(SIGNALS.values())), count=COUNT, throw=False)


def of(name):
    return jax.tree.map(lambda x: x[NAMES.index(name)], analysed())


@functools.cache
def compiled():
    return jax.jit(lambda ts, z: frequencies(ts, z, count=COUNT, throw=False))


@pytest.mark.parametrize("name", ["successful", "small"])
@pytest.mark.slow
def test_lines_of_a_torus_have_errors_of_round_off(name):
    found, size = of(name), 1e-200 if name == "small" else 1.0
    assert found.status == "successful"
    np.testing.assert_allclose(found.frequencies[:4], OMEGA, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.amplitudes[:4] / size, AMPLITUDES, rtol=0, atol=1e-12)
    assert np.isnan(found.frequencies[4])  # there is no fifth
    assert np.isnan(found.amplitudes[4])
    assert found.residual < 1e-13
    assert found.resolution == pytest.approx(BIN)
    if name == "successful":
        assert abs(found.constant - (0.2 + 0.1j)) < 1e-14
        np.testing.assert_allclose(found.evaluate(TS), SIGNALS[name], rtol=0, atol=1e-12)


IRREGULAR = TS + 1e-3 * np.sin(TS)
WITH_STATUS = [(name, name) for name in dynamics.results.NAMES[1:8] if name != "irregular_times"]
WITH_STATUS += [("zero", "no_signal"), ("noise", "no_signal"), ("drift", "window_too_short")]


IN_JIT = pytest.param("irregular_times", "irregular_times", marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "status"), [*WITH_STATUS, IN_JIT])
def test_signals_without_reliable_frequencies_have_a_status_and_nan(name, status):
    # Outside jit irregular times are an error.
    found = compiled()(IRREGULAR, torus()) if name == "irregular_times" else of(name)
    assert found.status == status
    assert len(FREQUENCY_RESULTS[getattr(FREQUENCY_RESULTS, status)]) > 80
    lost = np.isnan(found.frequencies) & np.isnan(found.amplitudes)
    if name in ("unresolved", "not_converged"):
        assert 0 < lost.sum() < COUNT + (name == "not_converged")
    else:
        assert lost.all()
        assert np.isnan(found.residual)


def test_failed_signals_do_not_change_others_and_the_error_has_all():
    with pytest.raises(FrequencyError, match=r"12 of 18 .*index \(1,\), is not_finite") as info:
        frequencies(TS, np.stack(list(SIGNALS.values())), count=COUNT)
    assert list(info.value.found.status) == list(analysed().status)
    np.testing.assert_allclose(info.value.found.frequencies[0, :4], OMEGA, atol=1e-13)


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith("pair")])
def test_near_lines_do_not_bias_each_other(name):
    bins = float(name.split()[1])
    found = of(name)
    assert found.status == "successful"
    lines = np.sort(found.frequencies[:3])
    np.testing.assert_allclose(lines, [-0.7, 1, 1 + bins * BIN], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_near_lines_bias_each_other_without_joint_refinement():
    z = np.stack([SIGNALS["pair 2"], SIGNALS["pair 1.5"]])
    found = frequencies(TS, z, count=3, refine=False, throw=False)
    first = np.asarray(found.frequencies)[0, 0]
    assert np.isnan(first) or abs(first - 1) > 1e-5
    assert found.residual[0] > 1e-5


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith("near")])
def test_lines_closer_than_the_resolution_are_nan(name):
    found = of(name)
    assert found.status == "unresolved"
    given = np.asarray(found.frequencies)
    np.testing.assert_allclose(given[np.isfinite(given)], [-0.7], atol=1e-4)


def test_noise_is_in_the_residual():
    found = of("noisy")
    assert found.status == "successful"
    # Cramér–Rao: the variance of ω is 6 σ²/(A² h² N³); Hann's windows increase it slightly.
    sigma = np.sqrt(6 * 0.02 / 2 / (0.25 * N**3))
    error = np.abs(found.frequencies[:3] - OMEGA[:3]) * np.abs(AMPLITUDES[:3])
    assert (error < 8 * sigma).all()
    assert np.isnan(found.frequencies[3:]).all()  # the line of 1e-3 is below the noise
    total = np.sqrt(np.sum(np.abs(AMPLITUDES) ** 2) + 0.02)
    assert found.residual == pytest.approx(np.sqrt(0.02) / total, rel=0.1)


@pytest.mark.parametrize("window", [0, 1, 2])
@pytest.mark.slow
def test_the_bias_of_a_line_not_fitted_falls_with_the_window(window):
    """|δω| ∝ T^−(2·window + 2): Laskar 1999."""
    spans = np.repeat([1.0, 2.0, 4.0], 8)  # the spacing grows and the number of samples stays
    starts = np.tile(np.linspace(0, 7, 8), 3)
    ts = starts[:, None] + 0.125 * spans[:, None] * np.arange(1024)
    z = np.stack([torus(t, OMEGA[:3], AMPLITUDES[:3]) for t in ts])
    found = frequencies(ts, z, count=1, window=window)
    errors = np.abs(found.frequencies[:, 0] - 1).reshape(3, 8).max(axis=1)
    order = np.log2(errors[0] / errors[2]) / 2
    assert order == pytest.approx(2 * window + 2, abs=0.5)
    if window == 0:
        assert errors[-1] > 1e-7  # the control: without a window 1e-9 is not reached
    if window == 2:
        assert errors[-1] < 1e-11


@pytest.mark.slow
def test_a_real_signal_has_the_same_positive_frequencies_in_both_directions_of_time():
    x, expected = 0.7 + np.cos(TS + 0.3) + 0.2 * np.sin(2.2 * TS), [np.exp(0.3j), -0.2j]
    for way in (1, -1):
        found = frequencies(TS[::way], x[::way], count=3)
        np.testing.assert_allclose(found.frequencies[:2], [1, 2.2], rtol=0, atol=1e-13)
        np.testing.assert_allclose(found.amplitudes[:2], expected, rtol=0, atol=1e-12)
        assert found.constant == pytest.approx(0.7, abs=1e-13)
        np.testing.assert_allclose(found.evaluate(TS), x, rtol=0, atol=1e-12)
    wrong = frequencies(TS, x[::-1], count=3)  # the control: the phases are those of other times
    assert np.abs(wrong.amplitudes[:2] - np.array(expected)).min() > 0.01


def test_lines_evaluate_at_times_of_any_shape_or_to_nan():
    found, values = analysed(), analysed().evaluate(TS[:7].reshape(7, 1))
    assert values.shape == (len(NAMES), 7, 1)
    expected = SIGNALS["successful"][:7]
    np.testing.assert_allclose(values[0, :, 0], expected, rtol=0, atol=1e-12)
    for ts, shape in ((TS[0], ()), ([], (0,)), (TS[:512].reshape(2, 256), (2, 256))):
        for lines, batch in ((found, (len(NAMES),)), (of("successful"), ())):
            evaluation = jax.eval_shape(lambda f, ts=ts: f.evaluate(ts), lines)
            assert evaluation.shape == (*batch, *shape)
    assert np.isnan(found.evaluate(np.where(np.arange(7) == 3, np.nan, 0.0))[0]).sum() == 1
    values = np.asarray(analysed().evaluate(TS[:7]))
    assert values.shape == (len(NAMES), 7)
    lost = np.isnan(values)
    for name, status in zip(NAMES, analysed().status, strict=True):
        known = status in ("successful", "no_signal")  # missing lines are not unresolved
        assert (lost[NAMES.index(name)] == (not known)).all(), name
    assert np.isnan(of("noisy").frequencies).any()
    assert np.isfinite(of("unresolved").frequencies).any()  # which is not the whole signal
    np.testing.assert_allclose(values[NAMES.index("no_signal")], 0.3 + 0.1j, atol=1e-14)


@pytest.mark.parametrize("start", [0.0, 1000.0])
@pytest.mark.slow
def test_times_in_single_precision_are_uniform_to_their_rounding(start):
    h, k = float(np.float32(0.05)), np.arange(N)
    ts = (start + h * k).astype(np.float32)
    z = np.exp(2j * (start + h * k)).astype(np.complex64)
    found = frequencies(ts, z, count=COUNT, throw=False)
    assert found.frequencies.dtype == np.float64
    assert found.frequencies[0] == pytest.approx(2, rel=3e-8)
    np.testing.assert_allclose(found.amplitudes[0], 1, atol=1e-4)
    with pytest.raises(ValueError, match="equal steps"):  # in double precision they are not
        frequencies(ts.astype(float), z)
    with pytest.raises(ValueError, match="float32: give the times in float64"):
        frequencies(ts + 0.01 * (k % 2).astype(np.float32), z)


def test_against_the_frequency_analysis_of_rebound():
    rebound = pytest.importorskip("rebound")
    if not hasattr(rebound, "frequency_analysis"):
        pytest.skip("this rebound has no frequency_analysis")
    z, reach = torus(), np.pi * 0.99
    data = np.stack([z.real, z.imag], axis=1).ravel()
    omega, size, _ = rebound.frequency_analysis(
        data, type="fmft2", nfreq=4, minfreq=-reach, maxfreq=reach
    )
    found = of("successful")  # the same signal, and a constant
    ours = np.asarray(found.frequencies[:4])
    np.testing.assert_allclose(omega / 0.5, ours, rtol=0, atol=1e-8)
    np.testing.assert_allclose(size, np.abs(found.amplitudes[:4]), rtol=0, atol=1e-8)
    assert np.abs(ours - OMEGA).max() < 1e-3 * np.abs(omega / 0.5 - OMEGA).max()


@pytest.mark.slow
def test_jit_and_vmap_change_nothing_and_a_failure_is_an_error_too():
    z = np.stack([SIGNALS[name] for name in ("successful", "noisy", "pair 2")])
    eager = frequencies(TS, z, count=COUNT)
    single = [frequencies(TS, row, count=COUNT) for row in z]
    mapped = jax.vmap(lambda row: frequencies(TS, row, count=COUNT))(z)
    jitted = compiled()(TS, jnp.asarray(z[0]))
    for other in (mapped.frequencies, np.stack([s.frequencies for s in single])):
        np.testing.assert_allclose(other, eager.frequencies, rtol=0, atol=1e-13)
    np.testing.assert_allclose(jitted.frequencies, eager.frequencies[0], rtol=0, atol=1e-13)
    assert list(mapped.status) == ["successful"] * 3
    strict = jax.jit(lambda z: frequencies(TS, z, count=COUNT).frequencies)
    np.testing.assert_allclose(strict(torus())[:4], OMEGA, rtol=0, atol=1e-13)
    with pytest.raises(Exception, match="constant to round-off"):
        jax.block_until_ready(strict(np.zeros(N, complex)))


@pytest.mark.slow
def test_a_frequency_can_be_differentiated():
    ts = 0.5 * np.arange(256)

    def leading(a):
        z = jnp.exp(1j * a * ts) + 0.3 * jnp.exp(2j * a**2 * ts)
        return frequencies(ts, z, count=2).frequencies

    expected = [1.0, 4 * 1.1]
    np.testing.assert_allclose(jax.jacfwd(leading)(1.1), expected, rtol=1e-9)
    np.testing.assert_allclose(jax.jacrev(leading)(1.1), expected, rtol=1e-9)


def stars():
    """Five orbits of Hénon and Heiles: two regular, two chaotic, one that failed."""
    problem = systems.henon_heiles()

    def start(y, py, E):
        return [0.0, y], [np.sqrt(2 * E - py**2 - y**2 + 2 * y**3 / 3), py]

    starts = [start(0.1, 0.2, 1 / 12), start(0.3, 0.0, 1 / 8), start(-0.1, 0.0, 0.165),
              start(0.0, 0.1, 0.165), ([0.0, np.nan], [0.1, 0.1])]  # fmt: skip
    q, p = jnp.asarray(starts).transpose(1, 0, 2)
    return jax.vmap(
        lambda q, p: dvi.integrate(
            problem.system, q, p, h=0.1, num_steps=10 * N, method=dvi.KahanLi(6),
            save=dvi.Save(every=5), throw=False,
        )
    )(q, p)  # fmt: skip


@pytest.mark.slow
def test_frequency_diffusion_distinguishes_chaos_from_order():
    with pytest.raises(FrequencyError, match=r"2 of 10 signals.*\(4, 0\), is not_finite") as info:
        frequency_diffusion(stars())
    moved = info.value.found
    assert moved.rate.shape == (5, 2)
    assert (moved.status[:4] == "successful").all()
    assert (moved.rate[:2] < -7).all()
    assert (moved.rate[2:4] > -3).all()
    assert (moved.status[4] == "not_finite").all()
    assert np.isnan([moved.rate[4], moved.first[4], moved.second[4]]).all()


def resting():
    system = systems.oscillator().system
    return dvi.integrate(system, [0.0], [0.0], h=0.1, num_steps=2, save=dvi.Save(every=1))


ROUNDED = (1e6 + 0.05 * np.arange(N)).astype(np.float32)


VALUE_ERRORS = {
    "equal steps.*dvi.Uniform": lambda: frequencies(IRREGULAR, torus()),
    "equal steps, other than zero": lambda: frequencies(TS * 0, torus()),
    "equal steps.*float32": lambda: frequencies(ROUNDED, torus()),
    "at least 32 samples, got 20": lambda: frequencies(TS[:20], torus()[:20]),
    "at least 64": lambda: frequency_diffusion(TS[:60], torus()[:60]),
    r"time along its last .*\(2047,\)": lambda: frequencies(TS[:-1], torus()),
    r"time along its last .*\(2048, 1\)": lambda: frequencies(TS, torus()[:, None]),
    r"got ts of shape \(3, 2048\)": lambda: frequencies(np.stack([TS] * 3), torus()),
    r"give \(ts, signal\)": lambda: frequencies(TS),
    "Its signal is q": lambda: frequencies(resting(), torus()),
    "at least 1, got 0": lambda: frequencies(TS, torus(), count=0),
    "at least 1, got 2.0": lambda: frequencies(TS, torus(), count=2.0),
    "from 1 to 21, got 22": lambda: frequencies(TS[:64], torus()[:64], count=22),
    "from 0 to 5, got 6": lambda: frequencies(TS, torus(), window=6),
}
TYPE_ERRORS = {
    "refine must be True or False, got 'no'": lambda: frequencies(TS, torus(), refine="no"),
    "give the times first": lambda: frequencies(torus(), TS),
    "signal must be an array of numbers": lambda: frequencies(TS, ["a"] * N),
    "ts must be real, got dtype complex128": lambda: analysed().evaluate(1j),
    "ts must be an array of numbers": lambda: analysed().evaluate("a"),
}


@pytest.mark.parametrize(
    ("errors", "error"), [(VALUE_ERRORS, ValueError), (TYPE_ERRORS, TypeError)]
)
def test_invalid_arguments(errors, error):
    for message, call in errors.items():
        with pytest.raises(error, match=message):
            call()


def test_a_process_without_double_precision_is_an_error(monkeypatch):
    monkeypatch.setattr(sys.modules["dvi_jax.dynamics.frequencies"], "x64_enabled", lambda: False)
    with pytest.raises(TypeError, match="jax_enable_x64"):
        frequencies(TS.astype(np.float32), torus().astype(np.complex64))
