"""Networks as forces: potential and damping, and fits by least squares and by gradients."""

import importlib.util
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings, strategies as st

import dvi_jax as dvi

H = 0.1


def H_D(t0, t1, q0, p1, args):
    return (p1 @ p1 + q0 @ q0) / 2


def network(n=1, seed=0, **options):
    return dvi.NetworkForce(n, key=jax.random.key(seed), **options)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    size=st.sampled_from([1e-3, 1.0, 30.0]),
    of=st.sampled_from(["q", "qp"]),
)
@pytest.mark.slow
def test_damping_never_does_positive_work(seed, size, of):
    """Whatever the weights are, with the velocity of a metric that mixes momenta."""
    M = jnp.array([[2.0, 0.3], [0.3, 0.5]])
    net = network(
        2, seed % 3, width=4, depth=1, damping_of=of, velocity=lambda q, p: M @ p, initial=1.0
    )
    rng = np.random.default_rng(seed)
    net = jax.tree.map(
        lambda x: jnp.asarray(size * rng.normal(size=x.shape)) if eqx.is_array(x) else x, net
    )
    q, p = jnp.asarray(rng.normal(size=(2, 2)))
    power, D = net.power(q, p), net.damping(q, p)
    assert power <= 0
    np.testing.assert_allclose(power, -(M @ p) @ D @ (M @ p), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(D, D.T)
    assert np.linalg.eigvalsh(D).min() >= -1e-12 * np.abs(D).max()


@pytest.mark.slow
def test_parts_of_a_network():
    net = network(3, width=5)
    q, p = jnp.array([0.3, -0.2, 0.5]), jnp.array([0.1, 0.4, -0.3])
    d = 1e-5 * np.eye(3)
    slopes = [(net.potential(q + e) - net.potential(q - e)) / 2e-5 for e in d]
    np.testing.assert_allclose(net.conservative(q), -np.array(slopes), rtol=1e-6)
    assert net.potential(jnp.zeros(3)) == 0
    np.testing.assert_allclose(
        net(0.0, H, q, p, None), net.conservative(q) + net.dissipation(q, p), rtol=1e-14
    )
    # A force of q alone that has work in a closed loop would show in an asymmetric Jacobian.
    J = jax.jacobian(net.conservative)(q)
    np.testing.assert_allclose(J, J.T, atol=1e-14)
    assert np.abs(J).max() > 1e-4
    q, p = jnp.array([0.3]), jnp.array([0.4])
    still, free = network(dissipative=False), network(conservative=False)
    assert np.all(still.dissipation(q, p) == 0)
    assert np.all(still.damping(q, p) == 0)
    assert still.conservative(q) != 0
    assert free.conservative(q) == 0
    assert free.potential(q) == 0
    assert free.power(q, p) < 0
    assert still.size + free.size == network().size
    assert network(width=6, depth=1).size == 37
    with pytest.raises(ValueError, match=r"\(2,\), got shape \(1,\)"):
        network(2).conservative(jnp.array([1.0]))


@pytest.mark.slow
def test_an_undamped_network_keeps_its_energy_and_damping_loses_it():
    options = {"h": 0.05, "num_steps": 2000, "epsilon": 1.0, "method": dvi.Strang()}

    def energies(net):
        sol = dvi.integrate(dvi.System(H_D, force=net), [0.8], [0.0], **options)
        E = (sol.qs**2 + sol.ps**2).sum(axis=1) / 2 + jax.vmap(net.potential)(sol.qs)
        return np.asarray(E)

    kept, lost = energies(network(dissipative=False)), energies(network())
    assert np.ptp(kept) < 1e-3 * np.abs(kept[0])
    assert abs(np.mean(kept[-500:]) - np.mean(kept[:500])) < 1e-5
    assert lost[-1] - lost[0] < -0.1


TRUTH = dvi.System(H_D, force=lambda t0, t1, q, p, args: -0.4 * q**3 - 0.1 * p)


KNOWN = {"q0": [1.2], "p0": [0.0], "h": H, "epsilon": 1.0, "method": dvi.Strang()}


def observed():
    sol = dvi.integrate(system=TRUTH, num_steps=40, **KNOWN)
    values = np.concatenate([sol.qs, sol.ps], axis=1)
    values = values + 0.01 * np.random.default_rng(0).normal(size=values.shape)
    return dvi.Observations(np.asarray(sol.ts), values, observe="state", sigma=0.01)


def model(net):
    return {"system": dvi.System(H_D, force=net), **KNOWN}


OPTIONS = {"priors": dvi.Prior(0.0, 1.0), "throw": False, "check_curvature": False}


@pytest.mark.slow
def test_a_network_is_fitted_by_least_squares_and_by_gradients():
    net = network(width=4, depth=1)
    least = dvi.fit(model, observed(), net, horizons=[1.0, 2.0], max_steps=80, **OPTIONS)
    assert isinstance(least.params, dvi.NetworkForce)
    assert least.params.velocity is net.velocity
    assert least.params.potential_net.activation is net.potential_net.activation
    assert least.names[0].startswith("potential_net.layers[0].weight")
    assert len(least.x) == net.size
    at = (0.0, H, jnp.array([1.0]), jnp.array([0.0]), None)
    assert np.abs(least.params(*at) + 0.4) < np.abs(net(*at) + 0.4)
    start = least.history["loss"][least.history["horizon"] == np.inf][0]
    assert least.loss < start
    given = {"horizons": None, "max_steps": 150, "optimiser": optax.adam(1e-2), **OPTIONS}
    adam = dvi.fit(model, observed(), network(width=4, depth=1), **given)
    assert isinstance(adam.params, dvi.NetworkForce)
    assert adam.status == "steps_done"
    assert adam.history["loss"][-1] < adam.history["loss"][0] / 4


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"n": 0}, ValueError, "n must be"),
        ({"width": 2.0}, ValueError, "width must be"),
        ({"depth": True}, ValueError, "depth must be"),
        ({"scale_q": -1.0}, ValueError, "scale_q must be"),
        ({"initial": 0.0}, ValueError, "initial must be"),
        ({"damping_of": "p"}, ValueError, "damping_of"),
        ({"conservative": False, "dissipative": False}, ValueError, "both False"),
        ({"activation": 3}, TypeError, "activation must be a function"),
        ({"velocity": 3}, TypeError, "velocity must be a function"),
    ],
)
def test_invalid_networks(change, error, match):
    with pytest.raises(error, match=match):
        network(**change)


def benchmark():
    path = Path(__file__).parent.parent / "benchmarks" / "network_force.py"
    spec = importlib.util.spec_from_file_location("network_force", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_structure_generalises_beyond_the_arc():
    """After the training arc and from other initial conditions; median over five realisations of
    the noise and of the initial weights."""
    compare = benchmark().compare  # of one module: its programs are compiled for the first noise
    each = [compare(seed, 80, 4)[0] for seed in range(10, 15)]
    ours, general = (np.array([e[name] for e in each]) for name in ("ours", "RK4, general"))
    assert np.median(ours[:, 1]) < np.median(general[:, 1])
    assert np.median(ours[:, 2]) < np.median(general[:, 2])
    assert (ours[:, 1] < general[:, 1]).sum() >= 4
