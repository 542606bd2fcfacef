"""What a user may write, and what is refused with which words."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi


def H(t0, t1, q0, p1, args):
    return (jnp.sum(p1**2) + jnp.sum(q0**2)) / 2


def run(system, q0=(0.1, 0.2), p0=(0.3, 0.4), **kwargs):
    q0, p0 = np.asarray(q0), np.asarray(p0)
    return dvi.integrate(system, q0, p0, **{"h": 0.1, "num_steps": 2, **kwargs})


def test_four_arguments_are_sent_to_discretise():
    with pytest.raises(TypeError, match=r"five positional arguments.*dvi.discretise"):
        dvi.System(lambda t, q, p, args: 0.0)


def test_five_arguments_are_sent_past_discretise():
    with pytest.raises(TypeError, match=r"four positional arguments.*dvi.System directly"):
        dvi.discretise(H)


@pytest.mark.parametrize("name", ["H_D", "force", "perturbation"])
def test_each_function_is_checked_and_named(name):
    with pytest.raises(TypeError, match=f"{name} must take five"):
        dvi.System(**{"H_D": H, name: lambda q, p: 0.0})
    with pytest.raises(TypeError, match=f"{name} must be a function"):
        dvi.System(**{"H_D": H, name: 3.0})


def test_H_D_must_be_a_scalar():
    system = dvi.System(lambda t0, t1, q0, p1, args: p1**2)
    with pytest.raises(ValueError, match=r"H_D.*real scalar.*shape \(2,\).*jnp.sum"):
        run(system)


def test_H_D_must_return():
    with pytest.raises(TypeError, match="return missing"):
        run(dvi.System(lambda t0, t1, q0, p1, args: None))


def test_force_must_look_like_q():
    system = dvi.System(H, force=lambda t0, t1, q0, p1, args: q0[0])
    with pytest.raises(ValueError, match=r"force.*shaped like q0, \(2,\).*shape \(\)"):
        run(system)


def test_discretise_is_the_papers_rule():
    def continuous(t, q, p, args):
        return (1 + t) * jnp.sum(p**2) / 2 + args * jnp.sum(q**4)

    H_D = dvi.discretise(continuous)
    q, p = np.array([0.3]), np.array([0.7])
    assert H_D(0.5, 0.6, q, p, 2.0) == continuous(0.5, q, p, 2.0)


def test_perturbation_is_a_hamiltonian_disturbance():
    """ε·H1 with H1 = |q|²/2 is the force W = −q."""
    by_force = dvi.System(H, force=lambda t0, t1, q0, p1, args: -q0)
    by_energy = dvi.System(H, perturbation=lambda t0, t1, q0, p1, args: jnp.sum(q0**2) / 2)
    a, b = (run(s, epsilon=0.2, num_steps=20) for s in (by_force, by_energy))
    np.testing.assert_allclose(a.qs, b.qs, rtol=1e-14)
    undisturbed = run(by_force, epsilon=0.0, num_steps=20)
    assert np.max(np.abs(a.qs - undisturbed.qs)) > 1e-2


def test_slow_time_reaches_the_functions():
    def drive(t0, t1, q0, p1, args):
        return jnp.sin(t0) * jnp.ones_like(q0)

    slow = run(dvi.System(H, force=drive, slow_time=True), epsilon=0.5, t0=1.0, num_steps=1)
    kick = 0.1 * (-np.array([0.1, 0.2]) + 0.5 * np.sin(0.5 * 1.0))
    np.testing.assert_allclose(slow.ps[1], np.array([0.3, 0.4]) + kick, rtol=1e-14)


def test_linear_algebra_of_the_system():
    """System functions themselves, for those who build on them."""
    system = dvi.System(H, force=lambda t0, t1, q0, p1, args: -q0)
    q, p = jnp.array([1.0]), jnp.array([2.0])
    t = jnp.asarray(0.0)
    assert float(system.hamiltonian(t, t, q, p, jnp.asarray(0.1), None)) == 2.5
    np.testing.assert_allclose(system.disturbing_force(t, t, q, p, jnp.asarray(0.1), None), [-0.1])
