"""Discrete Hamiltonians of order 1 to 4 from a continuous one."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from generating import generating_terms
from helpers import symplectic_defect

import dvi_jax as dvi
from dvi_jax.discover.algebra.taylor import taylor_coefficients


def kepler(t, q, p, args):
    """H = |p|²/2 − 1/|q|."""
    return jnp.sum(p**2) / 2 - 1 / jnp.sqrt(jnp.sum(q**2))


def non_separable(t, q, p, args):
    """H = (q² + 1)(p² + 1)/2."""
    return jnp.sum((q**2 + 1) * (p**2 + 1)) / 2


def driven(t, q, p, args):
    """The same with a strength that oscillates in time, and a driving force."""
    return (1 + 0.3 * jnp.sin(2 * t)) * non_separable(t, q, p, args) + jnp.sum(q) * jnp.cos(t)


CASES = {
    "kepler": (kepler, [1.0, 0.1], [0.1, 1.1]),
    "non_separable": (non_separable, [0.3], [0.4]),
    "driven": (driven, [0.3], [0.4]),
}
T0 = 0.2


def stepper(H_D, method):
    """One jitted step (z, t0, h) → z of the unperturbed map."""
    system = dvi.System(H_D)

    @jax.jit
    def advance(z, t0, h):
        q, p = jnp.split(z, 2)
        sol = dvi.integrate(system, q, p, h=h, num_steps=1, t0=t0, method=method)
        return jnp.concatenate([sol.qs[-1], sol.ps[-1]])

    return advance


def end(advance, case, n, t_end=2.0):
    z = jnp.asarray([*CASES[case][1], *CASES[case][2]])
    for k in range(n):
        z = advance(z, T0 + k * t_end / n, t_end / n)
    return np.asarray(z)


@functools.cache
def exact(case):
    return end(stepper(dvi.discretise(CASES[case][0]), dvi.KahanLi(8)), case, 200)


def orders(H, order, case, method=dvi.TypeII(), numbers=(16, 32, 64, 128)):
    advance = stepper(dvi.discretise(H, order=order), method)
    errors = np.array([np.max(np.abs(end(advance, case, n) - exact(case))) for n in numbers])
    assert np.all(errors > 3e-12), errors
    return np.log2(errors[:-1] / errors[1:])


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize(
    "case",
    ["non_separable", *(pytest.param(x, marks=pytest.mark.slow) for x in ("kepler", "driven"))],
)
def test_order_is_the_one_requested(case, order):
    numbers = (64, 128, 256, 512) if (case, order) == ("driven", 3) else (16, 32, 64, 128)
    assert abs(orders(CASES[case][0], order, case, numbers=numbers)[-1] - order) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_strang_on_order_3_has_order_4(case):
    assert abs(orders(CASES[case][0], 3, case, dvi.Strang(), (8, 16, 32))[-1] - 4) < 0.2


def test_a_wrong_sign_costs_the_order():
    """The midpoint rule without its second term, H(t, q0 + h/2 ∂H/∂p, p1 + h/2 ∂H/∂q): order 1."""

    def H_D(t0, t1, q0, p1, args):
        h = t1 - t0
        dq, dp = jax.grad(non_separable, argnums=(1, 2))(t0, q0, p1, args)
        return non_separable(t0, q0 + h / 2 * dp, p1 + h / 2 * dq, args)

    advance, case = stepper(H_D, dvi.TypeII()), "non_separable"
    errors = [np.max(np.abs(end(advance, case, n) - exact(case))) for n in (64, 128)]
    assert abs(np.log2(errors[0] / errors[1]) - 1) < 0.2


@pytest.mark.parametrize("case", ["non_separable", "driven", "kepler"])
@pytest.mark.slow
def test_terms_are_those_of_the_hamilton_jacobi_recursion(case):
    """The series of H_D in h agrees with the exact generating function in r terms, not in r + 1."""
    H, q, p = CASES[case]
    q, p, t0 = jnp.asarray(q), jnp.asarray(p), jnp.asarray(T0)
    G = np.asarray(jax.jit(lambda q, p: generating_terms(H, 4, t0, q, p))(q, p))
    for order in (1, 2, 3, 4):
        H_D = dvi.discretise(H, order=order)

        def terms(q, p, H_D=H_D):
            return taylor_coefficients(lambda s: H_D(t0, t0 + s, q, p, None), jnp.zeros(()), 3)

        series = jax.jit(terms)(q, p)
        miss = np.abs(np.asarray(series) - G)
        assert np.max(miss[:order]) < 1e-14
        assert order == 4 or miss[order] > 1e-3


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.slow
def test_map_is_symplectic_and_its_adjoint_undoes_it(order):
    H_D, z = dvi.discretise(driven, order=order), jnp.array([0.3, 0.4])
    advance, adjoint = stepper(H_D, dvi.TypeII()), stepper(H_D, dvi.Adjoint())
    M = jax.jit(jax.jacfwd(lambda z: advance(z, 0.5, 0.2)))(z)
    assert symplectic_defect(np.asarray(M)) <= 1e-12
    there = advance(z, 0.5, 0.2)
    np.testing.assert_allclose(adjoint(there, 0.7, -0.2), z, atol=1e-13)
    assert np.max(np.abs(advance(there, 0.7, -0.2) - z)) > 1e-6  # it is not symmetric


@pytest.mark.parametrize(
    ("order", "flattening", "steps"), [(2, 0.0, 500), (4, 0.0, 500), (2, 0.01, 50)]
)
@pytest.mark.slow
def test_angular_momentum_is_conserved_unless_the_body_is_flattened(order, flattening, steps):
    def H(t, q, p, args):
        return kepler(t, q, p, args) + flattening * q[0] ** 2

    def L(t0, t1, q0, p0, q1, p1, args):
        return q1[0] * p1[1] - q1[1] * p1[0]

    system = dvi.System(dvi.discretise(H, order=order))
    how = {"h": 0.1, "num_steps": steps, "observe": dvi.Range(L), "save": dvi.Save(final=True)}
    spread = dvi.integrate(system, *CASES["kepler"][1:], **how).observed
    assert (spread > 1e-3) if flattening else (spread <= 1e-13)


@pytest.mark.slow
def test_times_may_coincide():
    """`test_system.py` tests that order 1 is the rule of the paper."""
    q, p = jnp.array([0.3]), jnp.array([0.4])
    for order in (1, 2, 3, 4):
        H_D = dvi.discretise(driven, order=order)
        np.testing.assert_allclose(H_D(0.5, 0.5, q, p, None), driven(0.5, q, p, None), rtol=1e-15)


def test_other_orders_and_a_slow_time_are_rejected():
    for bad in (0, 5, -1, 2.5, "2", True, None):
        with pytest.raises(ValueError, match=r"order must be an integer from 1 to 4, got "):
            dvi.discretise(kepler, order=bad)
    assert dvi.System(dvi.discretise(kepler), slow_time=True).slow_time
    with pytest.raises(ValueError, match="compute the step as t1 − t0"):
        dvi.System(dvi.discretise(kepler, order=2), slow_time=True)
