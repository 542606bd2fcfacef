"""`dvi.Implicit`: energies of quantities that an equation defines; perturbations that take ε."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi


def lorentz(v):
    return 1 / jnp.sqrt(1 - jnp.sum(v * v))


def energy(t, q, p, v, args):
    """γ + k q²/2 with p = γ v: the energy of a relativistic oscillator by its velocity."""
    return lorentz(v) + args["k"] * jnp.sum(q * q) / 2


def relation(t, q, p, v, args):
    return lorentz(v) * v - p


def guess(t, q, p, args):
    return p / jnp.sqrt(1 + jnp.sum(p * p))  # exact here; a worse one is tested below


def closed(t, q, p, args):
    return jnp.sqrt(1 + jnp.sum(p * p)) + args["k"] * jnp.sum(q * q) / 2


BY_VELOCITY = dvi.Implicit(energy, relation, lambda t, q, p, args: 0.9 * guess(t, q, p, args))
Q0, P0, ARGS = np.array([0.3, -0.2]), np.array([0.5, 0.4]), {"k": 2.0}


def run(H, method, k=2.0, steps=50, **how):
    system = dvi.System(dvi.discretise(H), **how)
    return dvi.integrate(
        system, Q0, P0, h=0.1, num_steps=steps, args={"k": k}, method=method,
        save=dvi.Save(final=True), epsilon=0.1 if how else None,
    )  # fmt: skip


SLOW = [pytest.param(m, marks=pytest.mark.slow) for m in (dvi.GaussLegendre(2), dvi.RungeKutta4())]


@pytest.mark.parametrize("method", [dvi.TypeII(), *SLOW])
def test_all_methods_agree_with_the_closed_form(method):
    a, b = run(BY_VELOCITY, method), run(closed, method)
    np.testing.assert_allclose(a.qs[-1], b.qs[-1], rtol=0, atol=2e-14)
    np.testing.assert_allclose(a.ps[-1], b.ps[-1], rtol=0, atol=2e-14)


def test_forces_and_perturbations():
    friction = {"force": lambda t0, t1, q0, p1, args: -p1}
    a, b = (run(H, dvi.GaussLegendre(2), **friction) for H in (BY_VELOCITY, closed))
    np.testing.assert_allclose(a.ps[-1], b.ps[-1], rtol=0, atol=1e-14)
    free = run(closed, dvi.GaussLegendre(2))
    assert np.abs(a.ps[-1] - free.ps[-1]).max() > 1e-3
    system = dvi.System(oscillator(1.0), perturbation=extra)
    for epsilon in (0.0, 0.3):
        a = dvi.integrate(system, [1.0], [0.2], h=0.1, num_steps=20, epsilon=epsilon)
        b = dvi.integrate(dvi.System(oscillator(1.0 + epsilon)), [1.0], [0.2], h=0.1, num_steps=20)
        np.testing.assert_allclose(a.qs, b.qs, atol=1e-13)


@pytest.mark.parametrize("method", [dvi.TypeII(), *SLOW])
def test_gradients(method):
    def last(H, k):
        return run(H, method, k, steps=5).qs[-1, 0]

    a, b = (jax.grad(last, argnums=1)(H, 2.0) for H in (BY_VELOCITY, closed))
    assert float(a) == pytest.approx(float(b), rel=1e-11)
    difference = (last(closed, 2.0 + 1e-5) - last(closed, 2.0 - 1e-5)) / 2e-5
    assert float(a) == pytest.approx(float(difference), rel=1e-7)


@pytest.mark.parametrize("method", [dvi.TypeII(), SLOW[0]])
def test_no_root_is_reported(method):
    nowhere = dvi.Implicit(energy, lambda t, q, p, y, args: y * y + 1.0 + p * p, guess)
    system = dvi.System(dvi.discretise(nowhere))
    sol = dvi.integrate(system, Q0, P0, h=0.1, num_steps=3, args=ARGS, method=method, throw=False)
    assert sol.status in ("not_converged", "not_finite")


def test_wrong_functions_are_refused():
    with pytest.raises(TypeError, match="relation"):
        dvi.Implicit(energy, lambda t, q: q, guess)
    with pytest.raises(TypeError, match="guess"):
        dvi.Implicit(energy, relation, energy)


def oscillator(omega):
    """H = (p² + ω²q²)/2."""
    return lambda t0, t1, q0, p1, args: (p1 @ p1 + omega**2 * (q0 @ q0)) / 2


def extra(t0, t1, q0, p1, args, epsilon):
    """What makes 1 + ε of ω = 1, which is not linear in ε."""
    return (2.0 + epsilon) * (q0 @ q0) / 2


@pytest.mark.slow
def test_discovery_takes_all_powers_of_epsilon_from_a_perturbation():
    """The modified energy of the oscillator 1 + ε."""
    system = dvi.System(oscillator(1.0), perturbation=extra)
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 60, 1))
    found = dvi.discover_invariants(system, dvi.Polynomials(2), order=2, h=0.1, samples=samples)
    assert len(found.invariants) == 1
    c = np.asarray(found.invariants[0].coefficients)
    # (p² + (1 + ε)² (q² − h q p))/2 times a series in ε: ratios of q² to p² up to ε².
    names = list(found.invariants[0].basis.names)
    q2, p2 = (c[:, names.index(n)] for n in ("q²", "p²"))
    ratio = np.array([q2[0], q2[1], q2[2]]) - p2[0] * np.array([1.0, 2.0, 1.0])
    ratio[1] -= p2[1]
    ratio[2] -= 2 * p2[1] + p2[2]
    assert np.abs(ratio).max() < 1e-9 * np.abs(p2[0])
