"""Noise in the sense of Itô, and the strong order 3/2, against exact solutions and one fine path.

Means are compared within three standard errors. The seeds are fixed.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import gradient_by_differences

import dvi_jax as dvi
import lanewise

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


@slow
@pytest.mark.parametrize("is_diagonal", [True, False])
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


# --- strong order 3/2 -----------------------------------------------------------------------------


def increments_and_areas(path, k, h, count=3):
    interval = dvi.Interval(*map(jnp.asarray, (k * h, (k + 1) * h, h)))
    k = jnp.asarray(k, jnp.int32)
    return path.increments(k, interval, 1, count)[0], path.areas(k, interval, 1, count)[0]


WORDS = jax.random.key_data(jax.random.key(5))


def test_areas_of_a_step_are_those_of_its_parts():
    """The integral of the path over a step is the sum of those over its four parts."""
    dB, area = increments_and_areas(dvi.Brownian(WORDS, substeps=4), 3, 0.4)
    fine = [increments_and_areas(dvi.Brownian(WORDS), 12 + i, 0.1) for i in range(4)]
    start, integral = jnp.zeros(3), jnp.zeros(3)
    for w, a in fine:
        integral, start = integral + 0.1 * (start + w / 2 + a), start + w
    np.testing.assert_allclose(dB, start, rtol=1e-14)
    np.testing.assert_allclose(area, integral / 0.4 - start / 2, rtol=1e-13, atol=1e-15)
    # The numbers of the increments are those of methods without areas: normals 0 to m − 1.
    z = jax.random.normal(jax.random.fold_in(jax.random.key(5), 12), (6,))
    np.testing.assert_allclose(fine[0][0], np.sqrt(0.1) * z[:3], rtol=1e-14)
    np.testing.assert_allclose(fine[0][1], np.sqrt(0.1 / 12) * z[3:], rtol=1e-14)


@pytest.mark.parametrize("substeps", [1, pytest.param(3, marks=slow)])
def test_the_integral_of_a_path_has_its_covariance(substeps):
    """Z = ∫ B dt over a step: ⟨Z²⟩ = h³/3 and ⟨Z ΔB⟩ = h²/2, within three standard errors."""
    h, count = 0.7, 40_000
    dB, area = map(np.asarray, increments_and_areas(dvi.Brownian(WORDS, substeps), 2, h, count))
    Z = h * (dB / 2 + area)
    for product, mean in ((Z * Z, h**3 / 3), (Z * dB, h**2 / 2), (area * dB, 0.0)):
        assert abs(product.mean() - mean) < 3 * product.std() / np.sqrt(count)
    # Without the area the variance is h³/4.
    assert abs(np.mean((h * dB / 2) ** 2) - h**3 / 3) > 10 * np.std(Z * Z) / np.sqrt(count)


def quartic(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 + jnp.sum(q0**4) / 4 - jnp.sum(q0**2) / 2


def relativistic(t0, t1, q0, p1, args):
    return jnp.sum(jnp.sqrt(1 + p1**2)) + jnp.sum(q0**4) / 4


def coupled(t0, t1, q0, p1, args):
    """Not separable."""
    return jnp.sum(p1**2 * (2 + jnp.sin(3 * q0))) / 4 + jnp.sum(q0**2) / 2


def on_sphere(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + q0[2]


ON_SPHERE = dvi.System(on_sphere, noise=dvi.Langevin(0.7, 0.5),
                       constraint=lambda q, args: (q @ q - 1)[None] / 2)  # fmt: skip
CASES = {
    "Langevin": (dvi.System(quartic, noise=dvi.Langevin(0.7, 0.5)), 2.0),
    "additive, relativistic": (dvi.System(relativistic, noise=dvi.Langevin(0.7, 0.5)), 1.5),
    "a factor of time": (
        dvi.System(quartic, noise=lambda t, q, p, args: 0.7 + 0 * q + 0.5 * jnp.sin(3 * t)), 2.0,
    ),
    "a factor of position": (
        dvi.System(quartic, noise=lambda t, q, p, args: 0.8 * jnp.cos(2 * q)), 1.5,
    ),
    "not separable": (dvi.System(coupled, noise=dvi.Langevin(0.2, 8.0)), 1.5),
    "on a sphere": (ON_SPHERE, 1.5),
}  # fmt: skip
STARTS = {"on a sphere": ([0.6, 0.0, -0.8], [0.4, 0.5, 0.3])}
FINEST = 256


def states(name, method, num_steps, paths):
    """(q, p) after a time 1, from one path for every number of steps."""
    system, _ = CASES[name]
    q0, p0 = STARTS.get(name, ([1.0], [0.2]))

    def one(words):
        sol = dvi.integrate(system, q0, p0, h=1.0 / num_steps, num_steps=num_steps, method=method,
                            path=dvi.Brownian(words, FINEST // num_steps),
                            save=dvi.Save(final=True))  # fmt: skip
        return jnp.concatenate([sol.qs[-1], sol.ps[-1]])

    return np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(1), paths)))


def distance(a, b):
    """Root mean square, and its standard error."""
    squares = np.sum((a - b) ** 2, axis=1)
    root = np.sqrt(squares.mean())
    return root, squares.std() / (2 * root * np.sqrt(len(a)))


@slow
@pytest.mark.parametrize("name", CASES)
def test_strong_order(name):
    """By regression of the distance from a fine solution on the same path."""
    method, steps, paths = dvi.StrongSplitting(), np.array([8, 16, 32]), 2000
    fine = states(name, method, FINEST, paths)
    errors, spread = np.transpose(
        [distance(states(name, method, n, paths), fine) for n in steps.tolist()]
    )
    x, y = -np.log(steps), np.log(errors)
    order = np.polyfit(x, y, 1)[0]
    # Of the slope of three points at distance log 2: that of the outer two.
    error = np.hypot(spread[0] / errors[0], spread[2] / errors[2]) / np.log(4)
    assert order == pytest.approx(CASES[name][1], abs=0.15 + 3 * error)
    # The solution of another method on the same path: that of order 1 approaches it.
    coarse, near = (distance(states(name, dvi.BAOAB(), n, paths), fine)[0] for n in (32, FINEST))
    assert near < coarse / 6
    assert errors[-1] < coarse / 4
    # On another path the distance does not decrease.
    other = np.roll(fine, 1, axis=0)
    assert distance(states(name, method, 32, paths), other)[0] > 100 * errors[-1]


class WithoutAreas(dvi.Brownian):
    def areas(self, k, interval, parts, count):
        return jnp.zeros((parts, count))


@slow
def test_without_areas_the_order_is_one():
    system, _ = CASES["Langevin"]

    def last(words, num_steps, path):
        return dvi.integrate(system, [1.0], [0.2], h=1.0 / num_steps, num_steps=num_steps,
                             path=path(words, FINEST // num_steps), method=dvi.StrongSplitting(),
                             save=dvi.Save(final=True)).qs[-1]  # fmt: skip

    words = jax.random.key_data(jax.random.split(jax.random.key(1), 2000))
    fine, *coarse = (
        jax.vmap(lambda words, n=n, path=path: last(words, n, path))(words)
        for n, path in ((FINEST, dvi.Brownian), (8, WithoutAreas), (32, WithoutAreas))
    )
    errors = [distance(x, fine)[0] for x in coarse]
    assert np.log(errors[0] / errors[1]) / np.log(4) == pytest.approx(1, abs=0.1)


@slow
@pytest.mark.parametrize("name", ["Langevin", "a factor of position", "on a sphere"])
def test_a_step_back_undoes_a_step_of_strong_order(name):
    system, _ = CASES[name]
    q, p = (jnp.array(x) for x in STARTS.get(name, ([1.0], [0.2])))
    rows = jnp.array([[0.2, -0.1, 0.3], [0.05, 0.02, -0.1]])[:, : q.size]
    equations = dvi.Equations(system, jnp.zeros(()), increments=rows)
    interval = dvi.Interval(*map(jnp.asarray, (0.0, 0.1, 0.1)))
    method = dvi.StrongSplitting()
    q1, p1, _ = jax.jit(lambda *state: method.step(equations, interval, *state))(q, p)
    back = jax.jit(lambda *state: method.inverse(equations, interval, *state))(q1, p1)
    assert np.abs(np.stack(back[:2]) - np.stack([q, p])).max() < 1e-14
    assert np.abs(p1 - p).max() > 0.01
    if name == "Langevin":  # areas shrink by e^{−γh}
        step = lambda z: jnp.concatenate(method.step(equations, interval, z[:1], z[1:])[:2])  # noqa: E731
        area = jnp.linalg.det(jax.jacfwd(step)(jnp.concatenate([q, p])))
        assert float(area) == pytest.approx(np.exp(-0.7 * 0.1), abs=1e-14)


@slow
def test_gradients_of_strong_order():
    def loss(v, adjoint):
        system = dvi.System(quartic, noise=dvi.Langevin(lambda args: args[0], lambda args: args[1]))
        sol = dvi.integrate(system, [1.0], [0.2], args=v[:2], h=v[2], num_steps=20, path=3,
                            method=dvi.StrongSplitting(), adjoint=adjoint)  # fmt: skip
        return jnp.sum(sol.qs * jnp.cos(sol.ps))

    v = jnp.array([0.3, 0.2, 0.05])
    slopes = jax.jit(jax.grad(lambda v: loss(v, dvi.Reversible(checkpoint_every=5))))(v)
    differences = gradient_by_differences(jax.jit(lambda v: loss(v, dvi.Direct())), v)
    np.testing.assert_allclose(slopes, differences, rtol=1e-7)


@slow
def test_a_run_of_strong_order_is_machine_code_and_needs_areas():
    run = {"h": 0.1, "num_steps": 3, "method": dvi.StrongSplitting()}
    system, _ = CASES["Langevin"]

    def last(words):
        return dvi.integrate(system, [1.0], [0.2], path=dvi.Brownian(words), **run).qs[-1]

    assert [part.ir is not None for part in lanewise.explain(last, WORDS).parts] == [True]

    class Smooth(dvi.BrownianPath):
        def increments(self, k, interval, parts, count):
            return jnp.ones((parts, count))

    with pytest.raises(ValueError, match=r"Smooth\(\) must have areas.*StrongSplitting"):
        dvi.integrate(system, [1.0], [0.2], path=Smooth(), **run)
    twisted = dvi.System(quartic, noise=dvi.NoiseHamiltonians(lambda q, p: q * p))
    with pytest.raises(ValueError, match=r"StrongSplitting.* require noise on the momenta"):
        dvi.integrate(twisted, [1.0], [0.2], path=0, **run)
