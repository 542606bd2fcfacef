"""Noise in the sense of Itô, and the strong order 3/2, against exact solutions and one fine path.

Means are compared within three standard errors. The seeds are fixed.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

slow = pytest.mark.slow
KEYS = jax.random.split(jax.random.key(0), 20_000)


def at_rest(t0, t1, q0, p1, args):
    return 0.0 * jnp.sum(p1)


def growth(t0, t1, q0, p1, args):
    return args["a"] * p1


def in_proportion(t, q, p, args):
    return args["s"] * p


RATES = {"a": 0.3, "s": 0.7}


def last_momentum(system, key, n=50, **more):
    sol = dvi.integrate(
        system, [0.0], [1.0], h=1.0 / n, num_steps=n, args=RATES, path=dvi.Brownian(key),
        method=dvi.StochasticMidpoint(), save=dvi.Save(final=True), **more,
    )  # fmt: skip
    return sol.ps[-1, 0]


def growing(noise):
    return dvi.System(at_rest, force=growth, noise=noise, epsilon=1.0)


def test_growth_with_noise_in_proportion():
    """dp = a p dt + s p dB: p = exp((a − s²/2) t + s B) for each path, with the mean e^{at}."""
    B = dvi.System(at_rest, noise=lambda t, q, p, args: jnp.ones(1))
    increments = jax.vmap(lambda key: last_momentum(B, key) - 1)(KEYS)
    ends = {
        name: jax.vmap(lambda key, noise=noise: last_momentum(growing(noise), key))(KEYS)
        for name, noise in (("Itô", dvi.Ito(in_proportion)), ("Stratonovich", in_proportion))
    }
    a, s = RATES["a"], RATES["s"]
    exact = np.exp(a - s**2 / 2 + s * increments)
    assert np.sqrt(np.mean((ends["Itô"] - exact) ** 2)) < 0.01
    error = float(ends["Itô"].std()) / np.sqrt(len(KEYS))
    assert abs(ends["Itô"].mean() - np.exp(a)) < 3 * error
    # Without the correction the mean is e^{(a + s²/2) t}.
    other = ends["Stratonovich"]
    assert abs(other.mean() - np.exp(a + s**2 / 2)) < 3 * other.std() / np.sqrt(len(KEYS))
    assert abs(other.mean() - np.exp(a)) > 30 * error


@pytest.mark.parametrize("is_diagonal", [pytest.param(True, marks=slow), False])
def test_the_correction_of_several_coordinates(is_diagonal):
    """½ Σ_jm σ_jm ∂σ_im/∂p_j, from the whole derivative of σ."""

    def sigma(t, q, p, args):
        if is_diagonal:
            return jnp.stack([p[0] * p[1], jnp.sin(p[0]) + p[1] ** 2])
        return jnp.outer(p, jnp.sin(p)) + q[0] * p[:, None]

    t, q, p = 0.0, jnp.array([0.3, 0.1]), jnp.array([0.7, -0.4])
    rates = jnp.array([0.2, 1.1])
    matrix = lambda p: jnp.diag(sigma(t, q, p, None)) if is_diagonal else sigma(t, q, p, None)  # noqa: E731
    derivative = jax.jacfwd(matrix)(p)  # of σ_im by p_j
    correction = jnp.einsum("jm,imj->i", matrix(p), derivative) / 2
    force = dvi.Ito(sigma).force(t, q, p, None, rates)
    np.testing.assert_allclose(force, matrix(p) @ rates - correction, rtol=1e-14)
    assert np.abs(correction).min() > 0.01


@slow
def test_a_factor_without_momenta_is_the_same_in_both_senses():
    sigma = lambda t, q, p, args: 1.0 + q**2  # noqa: E731
    ends = [
        dvi.integrate(dvi.System(at_rest, noise=noise), [0.4], [1.0], h=0.1, num_steps=20, path=1,
                      method=dvi.BAOAB()).ps
        for noise in (sigma, dvi.Ito(sigma))
    ]  # fmt: skip
    np.testing.assert_array_equal(*ends)
    with pytest.raises(ValueError, match="requires noise that does not depend on p"):
        dvi.integrate(growing(dvi.Ito(in_proportion)), [0.0], [1.0], h=0.1, num_steps=2, path=0,
                      args=RATES, method=dvi.BAOAB())  # fmt: skip
    with pytest.raises(TypeError, match=r"sigma of dvi.Ito must take the arguments"):
        dvi.Ito(lambda q: q)


@slow
def test_gradients_with_noise_of_ito():
    def loss(v):
        return dvi.integrate(
            growing(dvi.Ito(lambda t, q, p, args: args["s"] * jnp.sin(p))), [0.0], [1.0], h=0.05,
            num_steps=20, args={"a": v[0], "s": v[1]}, path=4, method=dvi.StochasticMidpoint(),
        ).ps[-1, 0]  # fmt: skip

    v = jnp.array([0.3, 0.7])
    slopes = jax.grad(loss)(v)
    for i, step in enumerate(1e-5 * np.eye(2)):
        difference = (loss(v + step) - loss(v - step)) / 2e-5
        assert float(slopes[i]) == pytest.approx(float(difference), rel=1e-7)


@slow
def test_the_drift_of_an_invariant_by_noise_of_ito():
    """I = p: the drift is 0 for Itô's equation, and s² p/2 for Stratonovich's."""
    for noise, drift in ((dvi.Ito(in_proportion), 0.0), (in_proportion, 0.7**2 / 2)):
        result = dvi.invariant_diffusion(
            dvi.System(at_rest, noise=noise), [0.0], [1.0], invariant=lambda q, p: p[0], h=0.01,
            num_steps=10, args=RATES, method=dvi.StochasticMidpoint(), num_paths=10_000,
        )  # fmt: skip
        assert float(result.predicted_drift) == pytest.approx(drift, abs=1e-14)
        assert abs(result.drift - drift) < 3 * result.drift_error + 0.01
