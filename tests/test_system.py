"""Systems that a user may write, and the messages for others; the shared checks of arguments."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.base import checks as _checks


def H(t0, t1, q0, p1, args):
    return (jnp.sum(p1**2) + jnp.sum(q0**2)) / 2


def run(system, q0=(0.1, 0.2), p0=(0.3, 0.4), **kwargs):
    q0, p0 = np.asarray(q0), np.asarray(p0)
    return dvi.integrate(system, q0, p0, **{"h": 0.1, "num_steps": 2, **kwargs})


def test_discretise_is_the_rule_of_the_paper():
    def continuous(t, q, p, args):
        return (1 + t) * jnp.sum(p**2) / 2 + args * jnp.sum(q**4)

    H_D = dvi.discretise(continuous)
    q, p = np.array([0.3]), np.array([0.7])
    assert H_D(0.5, 0.6, q, p, 2.0) == continuous(0.5, q, p, 2.0)


def test_a_perturbation_acts_as_the_force_of_its_gradient():
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


def test_methods_of_a_system():
    """System functions themselves, for those who build on them."""
    system = dvi.System(H, force=lambda t0, t1, q0, p1, args: -q0)
    q, p = jnp.array([1.0]), jnp.array([2.0])
    t = jnp.asarray(0.0)
    assert float(system.hamiltonian(t, t, q, p, jnp.asarray(0.1), None)) == 2.5
    np.testing.assert_allclose(system.disturbing_force(t, t, q, p, jnp.asarray(0.1), None), [-0.1])


@pytest.mark.parametrize(
    ("check", "good", "bad"),
    [
        (lambda x: _checks.whole("n", x), (1, np.int64(3)), (0, -1, 1.0, True, "2", None, np.nan)),
        (lambda x: _checks.whole("n", x, 0, 5), (0, 5), (6, -1)),
        (lambda x: _checks.positive("x", x), (0.5, 3, np.float32(1)), (0, -1.0, np.inf, np.nan)),
        (lambda x: _checks.positive("x", x, zero=True), (0, 2.0), (-1e-300, "1", None, True)),
        (lambda x: _checks.positive("x", x), (jnp.float32(2), np.array(1.0)), (np.ones(2), 1j)),
        (lambda x: _checks.finite("x", x), (-2, 0.0), (np.inf, "0", None, [1.0])),
        (lambda x: _checks.one_of("x", x, ["a", None]), ("a", None), ("b", 0, ["a"])),
    ],
)
def test_checks_of_values(check, good, bad):
    for value in good:
        assert check(value) == value
    for value in bad:
        with pytest.raises(ValueError, match=r"^[nx] must be .*, got "):
            check(value)
