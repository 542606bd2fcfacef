"""Signals that decay or grow: the frequency of the strongest line is there for every `count`."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

T = np.arange(300)
RATES = {"fast decay": 0.01, "decay": 0.005, "slow decay": 0.002, "growth": -0.006}


@pytest.mark.parametrize("count", [pytest.param(2, marks=pytest.mark.slow), 8])
@pytest.mark.parametrize("is_real", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_strongest_line_of_a_damped_signal(count, is_real):
    """Against the frequency and the amplitude that it was made with; a weak line is far off."""
    omega, bin = 2 * np.pi * 0.2137, 2 * np.pi / len(T)
    rates = np.array(list(RATES.values()))
    z = 27 * np.exp((1j * omega - rates[:, None]) * T + 0.3j) + 1e-3 * np.exp(2.5j * T)
    found = dvi.frequencies(T, z.real if is_real else z, count=count, throw=False)
    assert set(found.status) <= {"unresolved", "successful"}
    first = np.asarray(found.frequencies)[:, 0]
    np.testing.assert_allclose(first, omega, rtol=0, atol=1e-3 * bin)
    middle = 27 * np.exp(-rates * T[-1] / 2)
    is_decaying = np.asarray(found.status) == "unresolved"
    sizes = np.abs(np.asarray(found.amplitudes)[:, 0])
    np.testing.assert_allclose(sizes[is_decaying], middle[is_decaying], rtol=1e-3)
    assert is_decaying.any()


def test_a_pair_that_is_not_resolved_is_no_damped_line():
    """Negative controls: equal lines at 0.5 and 0.6 of the resolution, with various phases."""
    distance, phase = np.meshgrid([0.5, 0.6], [0.0, 1.0, 2.0])
    second = 1.0 + distance.ravel()[:, None] * 2 * np.pi / len(T)
    z = np.exp(1j * T) + np.exp(1j * (second * T + phase.ravel()[:, None]))
    found = dvi.frequencies(T, z, count=8, throw=False)
    given = np.asarray(found.frequencies)[:, 0]
    middle = (1 + second[:, 0]) / 2
    assert set(found.status) == {"unresolved"}
    assert np.all(np.isnan(given) | (np.abs(given - middle) < 0.5 * 2 * np.pi / len(T)))
    assert np.isnan(given).any()


@pytest.mark.slow
def test_a_pendulum_with_friction():
    """Its frequency is near 1 and increases as it slows down."""
    system = dvi.System(
        lambda t0, t1, q, p, args: p @ p / 2 - jnp.sum(jnp.cos(q)),
        force=lambda t0, t1, q, p, args: -p,
    )
    run = {"h": 0.1, "num_steps": 3000, "epsilon": 0.01, "method": dvi.Strang()}
    sol = dvi.integrate(system, [0.3], [0.0], **run)
    found = dvi.frequencies(sol, throw=False)
    assert 0.994 < abs(float(found.frequencies[0, 0])) < 1.001
